"""A run of a hundred thousand stations; in a file of its own to be the first to start."""

import time

import numpy as np

from cli_support import SERVO_NOISE, channels, mwdcal, stations, write_csv
from simulation import Tool


def test_a_hundred_thousand_stations(tmp_path):
    rng = np.random.default_rng(3)
    count = 100_000
    inc = np.arccos(rng.uniform(-1, 1, count))
    azi, face = rng.uniform(0, 2 * np.pi, (2, count))
    g, b = (v[0] for v in Tool.random(3, noise=SERVO_NOISE).readings(rng, 1, inc, azi, face))
    run = {**stations(inc, azi, face), **channels(g, b)}
    start = time.process_time()
    path = write_csv(tmp_path / "run.csv", run)
    ran = mwdcal("calibrate", path, "--tool", "servo", "-o", tmp_path / "cal.json")
    assert ran.code == 0
    assert "100000 stations" in ran.out
    assert time.process_time() - start < 120
