"""Formats of other programs: WITSML, LAS, axis conventions of tool makers."""
