"""Exact factors between units."""

STANDARD_GRAVITY = 9.80665
"""Acceleration of 1 g, m/s²."""
FOOT = 0.3048
"""Metres of an international foot."""
