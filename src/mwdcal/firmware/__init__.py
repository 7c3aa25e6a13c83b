"""A calibration for firmware: C sources, in double and in fixed-point numbers, with test vectors."""
