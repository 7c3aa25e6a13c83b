"""Use of a calibration: correction of readings, roll test, conversion to other notations, figures."""
