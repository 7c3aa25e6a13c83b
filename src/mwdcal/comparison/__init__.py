"""All methods on one run, side by side."""
