"""Directions: vectors of gravity and field in the tool's frame, and the angles read from them."""
