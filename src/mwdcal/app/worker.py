"""What a worker process has loaded: imported once by a process that is then copied.

A small fit brings in what is loaded at first use.
"""

from __future__ import annotations

import contextlib

import numpy as np

from mwdcal.core.vectors import reference_vectors
from mwdcal.estimate import fit
from mwdcal.files.fleet_parts import solve
from mwdcal.readings import Readings


def warm() -> None:
    """Fit a perfect tool at twelve attitudes."""
    place = np.arange(12.0)
    angles = {"inclination": 0.3 + 0.2 * place, "azimuth": place, "toolface": 2.0 * place}
    known = {**angles, **{n: np.full(12, v) for n, v in (("gravity", 1), ("field", 1), ("dip", 1))}}
    g, b = reference_vectors(**angles, dip=1.0)
    sd = {name: np.full((12, 3), 1e-3) for name in ("accelerometer", "magnetometer")}
    with contextlib.suppress(Exception):
        fit(Readings(g, b, known=known, sd=sd))


warm()

__all__ = ["solve", "warm"]
