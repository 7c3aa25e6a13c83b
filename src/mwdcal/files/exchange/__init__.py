"""Formats of other programs: WITSML trajectories and LAS logs."""
