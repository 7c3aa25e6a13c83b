"""Many tools at once: calibration of a table of runs, in parts that survive an interruption."""
