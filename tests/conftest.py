"""One BLAS thread per test process: many processes of many threads only wait for each other."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: takes seconds; `make test-quick` leaves it out")
