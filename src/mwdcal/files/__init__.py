"""Formats: runs, logs, profiles, limits, calibration files. Units and axes are converted here."""
