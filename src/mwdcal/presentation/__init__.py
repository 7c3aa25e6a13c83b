"""Screens, JSON and pages of results, by capability; pages need no network."""
