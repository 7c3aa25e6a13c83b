"""Compiled loops give what NumPy gives, for every model and every kind of evidence."""

import numpy as np
import pytest

from mwdcal.core import fast
from mwdcal.estimate import fit
from mwdcal.options import Options
from mwdcal.readings import Readings
from simulation import Tool, plan
from test_calibrate import NOISE

pytest.importorskip("numba")

CASES = {
    "exact": (Options(), ()),
    "uncertain stand": (Options(), ("sd",)),
    "toolface and dip unknown": (Options(), ("toolface", "dip", "sd")),
    "groups": (Options(), ("inclination", "azimuth", "group")),
    "field unknown": (Options(), ("field",)),
    "accelerometer alone": (Options(), ("magnetometer",)),
    "least-squares": (Options("least-squares"), ()),
    "scalar": (Options("scalar"), ("azimuth", "sd")),
    "toolface-inclination": (Options("toolface-inclination"), ("sd",)),
    "newton": (Options("newton"), ("sd",)),
    "tilt": (Options(estimate=("tilt", "azimuth-zero")), ("sd",)),
    "noise estimated": (Options(), ("noise",)),
    "nine parameters": (Options(parameters=9), ()),
    "own-axis terms": (Options(nonlinearity={"magnetometer": 0.005}), ()),
    "factors": (Options(model="factors"), ("sd",)),
    "factors of order 2 and 1": (Options(order=(2, 1)), ("temperature",)),
    "polynomial of order 1": (Options(model="polynomial", order=1), ("temperature",)),
}


def runs(lacking, count=90):
    """Many runs of one tool, with what the case has and lacks."""
    tool, (inc, azi, face) = Tool.random(7), plan()
    a, m = tool.readings(np.random.default_rng(2), count, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    sd = {} if "noise" in lacking else dict(NOISE)
    if "sd" in lacking:
        sd |= {n: np.full(48, 3e-4) for n in ("inclination", "azimuth", "toolface")}
        sd |= {"field": np.full(48, 20.0), "dip": np.full(48, 1e-4)}
    return Readings(
        a,
        None if "magnetometer" in lacking else m,
        np.tile([20.0, 60.0, 100.0], 16) if "temperature" in lacking else None,
        {k: v for k, v in known.items() if k not in lacking},
        sd,
        np.repeat(np.arange(4), 12) if "group" in lacking else None,
    )


@pytest.mark.parametrize("case", CASES)
def test_a_large_batch_is_fitted_as_a_small_one(case, monkeypatch):
    options, lacking = CASES[case]
    data = runs(lacking)
    monkeypatch.setattr(fast, "ENOUGH", 10**9)
    plain = fit(data, options)
    monkeypatch.setattr(fast, "ENOUGH", 1)
    compiled = fit(data, options)
    np.testing.assert_array_equal(plain.status, compiled.status)
    np.testing.assert_array_equal(
        plain.analysis.determined.rank, compiled.analysis.determined.rank
    )
    for ours, theirs in zip(
        compiled.problem.fields(compiled.state), plain.problem.fields(plain.state), strict=True
    ):
        size = np.nanmax(np.abs(theirs), initial=1.0)
        np.testing.assert_allclose(ours, theirs, atol=1e-8 * size)
    for name in ("covariance", "variance_factor", "freedom", "residual", "spread"):
        ours, theirs = (getattr(f.analysis, name) for f in (compiled, plain))
        size = np.abs(theirs).max(initial=1e-300)
        np.testing.assert_allclose(ours, theirs, atol=1e-6 * size, err_msg=name)


def test_loops_can_be_turned_off(monkeypatch):
    monkeypatch.setenv("MWDCAL_NUMPY", "1")
    assert not fast.pays(np.zeros((10_000, 48)))
    monkeypatch.delenv("MWDCAL_NUMPY")
    assert fast.pays(np.zeros((10_000, 48)))
    assert not fast.pays(np.zeros((1, 48)))
