"""One BLAS thread per test process: many processes of many threads only wait for each other.

A job in the background ignores Ctrl-C, and so would the commands that the tests start.
"""

import os
import signal

import pytest

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: takes seconds; `make test-quick` leaves it out")
    config.addinivalue_line(
        "markers", "study: the large version of a test that always runs; `make test-studies`"
    )


def pytest_collection_modifyitems(config, items):
    """Leaves the studies out, unless `-m` names them."""
    if "study" not in config.option.markexpr:
        config.hook.pytest_deselected(
            items=[each for each in items if each.get_closest_marker("study")]
        )
        items[:] = [each for each in items if not each.get_closest_marker("study")]


@pytest.fixture
def without_pictures(monkeypatch):
    """Pages with empty pictures: drawing takes most of the time of a page that is read for its text."""
    drawing = "mwdcal.app.pages.pictures.picture"
    monkeypatch.setattr(drawing, lambda figure, suffix: b"<svg></svg>")
