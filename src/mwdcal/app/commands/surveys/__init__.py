"""Commands for surveys and the references they need."""
