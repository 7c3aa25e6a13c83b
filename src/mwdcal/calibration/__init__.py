"""From readings to a calibration: readings, options, the fit, its uncertainty, the record."""
