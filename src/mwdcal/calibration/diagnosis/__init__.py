"""When a fit is refused, and what is reported of one that is not."""
