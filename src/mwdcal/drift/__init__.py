"""How a tool changes from calibration to calibration, and when the next one is due."""
