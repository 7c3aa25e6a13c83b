"""A tool profile from a table as it comes: which column is what, its unit, axes and nominal scales."""
