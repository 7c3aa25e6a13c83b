"""The session at the stand, live: where to turn the tool, whether it stands still, and what each station tells."""
