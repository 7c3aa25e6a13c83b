"""Calibration of directional sensors for measurement while drilling."""

__version__ = "0.1.0"
