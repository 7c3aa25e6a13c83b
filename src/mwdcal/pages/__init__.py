"""Pages that need no network, and their figures."""
