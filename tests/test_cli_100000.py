"""Runs of very many stations."""

import time

import numpy as np
import pytest

from cli_support import SERVO_NOISE, channels, mwdcal, stations, write_csv
from simulation import Tool


@pytest.mark.parametrize("count", [8_000, pytest.param(100_000, marks=pytest.mark.study)])
def test_a_hundred_thousand_stations_take_two_minutes(tmp_path, count):
    """And fewer take a share of that: nothing grows faster than the stations."""
    rng = np.random.default_rng(3)
    inc = np.arccos(rng.uniform(-1, 1, count))
    azi, face = rng.uniform(0, 2 * np.pi, (2, count))
    g, b = (v[0] for v in Tool.random(3, noise=SERVO_NOISE).readings(rng, 1, inc, azi, face))
    run = {**stations(inc, azi, face), **channels(g, b)}
    start = time.process_time()
    path = write_csv(tmp_path / "run.csv", run)
    ran = mwdcal("calibrate", path, "--tool", "servo", "-o", tmp_path / "cal.json")
    assert ran.code == 0
    assert f"{count} stations" in ran.out
    assert time.process_time() - start < 120 * count / 100_000
