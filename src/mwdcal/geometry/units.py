"""Exact factors between units."""

STANDARD_GRAVITY = 9.80665
"""Acceleration of 1 g, m/s²."""
FOOT = 0.3048
"""Metres of an international foot."""
LENGTH_UNITS = {"m": 1.0, "ft": FOOT, "usft": 1200 / 3937}
"""Metres of each unit of length, by the name that options and columns have: usft is the US survey foot."""
USUAL_COURSES = {"m": 30.0, "ft": 100.0, "usft": 100.0}
"""Lengths, in their unit, over which dogleg severity is stated."""
