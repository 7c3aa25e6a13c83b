"""The estimator on plain arrays: evidence, residual, steps, rank, uncertainty, robust weights."""
