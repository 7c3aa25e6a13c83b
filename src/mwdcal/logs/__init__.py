"""Continuous logs: standstills as stations, and sensor noise from the Allan deviation."""
