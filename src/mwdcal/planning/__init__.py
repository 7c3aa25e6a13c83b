"""Simulated tools and runs."""
