"""The modules of a worker process: imported once by a process that is then copied.

A small part brings in what is loaded at first use.
"""

from __future__ import annotations

import contextlib
import gc

import numpy as np

from mwdcal.app.cli import without_pandas
from mwdcal.calibration.options import Options
from mwdcal.files.contract import CHANNELS, REFERENCES
from mwdcal.files.formats import parquet
from mwdcal.fleet.parts import Plan, calibrations, packed
from mwdcal.fleet.sources import SERIAL
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.sensor.profile import Profile, StandProfile, TriadProfile


def warm() -> None:
    """Calibrate a perfect tool at twelve attitudes: on an exact stand, and on an uncertain one."""
    place = np.arange(12.0)
    angles = {"inclination": 0.3 + 0.2 * place, "azimuth": place % 6, "toolface": 2.0 * place % 6}
    known = {**angles, **dict.fromkeys(("gravity", "field", "dip"), np.ones(12))}
    vectors = reference_vectors(**angles, dip=1.0)
    columns = {REFERENCES[n].column: v / REFERENCES[n].factor for n, v in known.items()}
    for names, vector in zip(CHANNELS.values(), vectors, strict=True):
        columns |= dict(zip(names, vector.transpose(), strict=True))
    triad = TriadProfile(scale=1.0, noise=1e-3)
    with contextlib.suppress(Exception):
        arrow, _ = parquet.modules("")
        serial = arrow.array(["1"] * 12).dictionary_encode()
        loaded = packed(arrow.table({SERIAL: serial, **columns, "#row": np.arange(12)}))
        for sd in (0.0, 0.1):
            stand = StandProfile(inclination_deg=sd, azimuth_deg=sd, toolface_deg=sd)
            profile = Profile(name="", accelerometer=triad, magnetometer=triad, stand=stand)
            plan = Plan("", {}, tuple(columns), profile, Options(nonlinearity={}))
            packed(calibrations(plan, loaded))


without_pandas()
warm()
gc.freeze()  # copies then share this memory: collecting garbage would write to all of it
