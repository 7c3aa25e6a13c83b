"""Closed forms, Newton's method and the particle swarm: other ways to the same minimum."""
