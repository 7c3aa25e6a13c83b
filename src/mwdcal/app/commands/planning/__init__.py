"""Commands for what comes before a measurement."""
