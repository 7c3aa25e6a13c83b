"""Faults of a tool that comes back from a well: their physics, and which of them readings show."""
