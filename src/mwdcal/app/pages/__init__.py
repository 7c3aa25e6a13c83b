"""Reports: templates and their figures."""
