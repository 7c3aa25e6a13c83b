"""A batch gives what its members give alone, and the closed forms the general minimum."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.minimisers import closed_form
from simulation import Tool, plan
from test_calibrate import NOISE

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
    warmth = np.tile([20.0, 60.0, 100.0], 16) if "temperature" in lacking else None
    if "soaks" in lacking:
        warmth = np.random.default_rng(4).permutation(np.repeat([20.0, 60.0, 100.0, 140.0], 12))
    return Readings(
        a,
        None if "magnetometer" in lacking else m,
        warmth,
        {k: v for k, v in known.items() if k not in lacking},
        sd,
        np.repeat(np.arange(4), 12) if "group" in lacking else None,
    )


@pytest.mark.parametrize("case", CASES)
def test_a_member_of_a_batch_is_fitted_as_it_is_alone(case):
    options, lacking = CASES[case]
    data = runs(lacking, 6)
    whole, alone = fit(data, options), fit(runs_of(data, [4]), options)
    assert whole.status[4] == alone.status[0]
    assert whole.analysis.determined.rank[4] == alone.analysis.determined.rank[0]
    for ours, theirs in zip(
        whole.problem.fields(whole.state), alone.problem.fields(alone.state), strict=True
    ):
        size = np.nanmax(np.abs(theirs), initial=1.0)
        np.testing.assert_allclose(ours[[4]], theirs, atol=1e-8 * size)
    for name in ("covariance", "variance_factor", "freedom", "residual", "spread"):
        ours, theirs = (getattr(f.analysis, name) for f in (whole, alone))
        size = np.abs(theirs).max(initial=1e-300)
        np.testing.assert_allclose(ours[[4]], theirs, atol=1e-6 * size, err_msg=name)


EXACT = {
    "all exact": (Options(), ()),
    "noise estimated": (Options(), ("noise",)),
    "accelerometer alone": (Options(), ("magnetometer", "azimuth")),
    "accelerometer alone, no field": (Options(), ("magnetometer", "azimuth", "field", "dip")),
    "least-squares, uncertain stand": (Options("least-squares"), ("angles",)),
    "noise by axis and station": (Options(), ("uneven",)),
    "factors": (Options(model="factors"), ()),
    "factors of order 2 and 1": (Options(order=(2, 1)), ("soaks",)),
    "factors of order 3": (Options(order=3), ("soaks", "uneven")),
    "factors, noise estimated": (Options(order=1), ("soaks", "noise")),
    "gains of order 0 and factors": (Options(order=(0, 2)), ("soaks",)),
}


@pytest.mark.parametrize("part", [1, 40], ids=["one", "many"])
@pytest.mark.parametrize("case", EXACT)
def test_the_closed_form_is_the_general_minimum(case, part, monkeypatch):
    options, lacking = EXACT[case]
    data = runs(lacking, part)
    if "angles" in lacking:
        sd = {n: np.full(48, 3e-4) for n in ("inclination", "azimuth", "toolface")}
        data = replace(data, sd={**data.sd, **sd})
    if "uneven" in lacking:
        rng = np.random.default_rng(3)
        uneven = {n: sd * rng.uniform(0.5, 2.0, (48, 3)) for n, sd in NOISE.items()}
        data = replace(data, sd=uneven)
    include = np.ones((part, 48))
    include[:, 5] = 0
    assert closed_form.applies(fit(data, options, include).problem)
    closed = fit(data, options, include)
    assert (closed.iterations == 1).all()
    monkeypatch.setattr(closed_form, "applies", lambda problem: False)
    general = fit(data, options, include)
    np.testing.assert_array_equal(closed.status, general.status)
    scale = np.sqrt(np.diagonal(general.analysis.covariance, axis1=-2, axis2=-1))
    assert (np.abs(closed.state.params - general.state.params) < 1e-5 * scale).all()
    np.testing.assert_allclose(closed.noise, general.noise, rtol=1e-3)
    for name in ("covariance", "variance_factor", "freedom", "residual", "spread"):
        ours, theirs = (getattr(f.analysis, name) for f in (closed, general))
        if name == "covariance":
            ours, theirs = (m / (scale[:, :, None] * scale[:, None, :]) for m in (ours, theirs))
        loose = 3e-3 if "noise" in lacking else 1e-6
        np.testing.assert_allclose(ours, theirs, atol=loose * np.abs(theirs).max(), err_msg=name)
    ours, theirs = closed.analysis.determined, general.analysis.determined
    np.testing.assert_allclose(ours.values, theirs.values, rtol=2e-3)
    np.testing.assert_allclose(ours.norms, theirs.norms, rtol=2e-3)
    information = np.linalg.inv(general.analysis.covariance)
    undone = ours.inverse(information) / (scale[:, :, None] * scale[:, None, :])
    expected = general.analysis.covariance / (scale[:, :, None] * scale[:, None, :])
    np.testing.assert_allclose(undone, expected, atol=1e-6)


def test_factors_are_found_from_readings_of_other_scales():
    data, scale = runs(("soaks",)), np.array([0.3, 2.0, 1.4])
    sd = {**data.sd, "accelerometer": data.sd["accelerometer"] * scale}
    far = fit(replace(data, accelerometer=data.accelerometer * scale, sd=sd), Options(order=2))
    near = fit(data, Options(order=2))
    assert (far.iterations == 1).all()
    ours, theirs = (f.problem.fields(f.state)[0] for f in (far, near))
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_factors_are_found_under_offsets_of_several_fields(monkeypatch):
    data = runs(("soaks",), 20)
    data = replace(data, accelerometer=data.accelerometer + np.array([3.0, -5.0, 0.0]))
    closed = fit(data, Options(order=2))
    assert (closed.iterations == 1).all()
    monkeypatch.setattr(closed_form, "applies", lambda problem: False)
    general = fit(data, Options(order=2))
    ours, theirs = (f.problem.fields(f.state)[0] for f in (closed, general))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_the_closed_form_is_not_taken_where_stations_are_too_few():
    data = runs(())
    few = np.zeros(48)
    few[:3] = 1
    assert not fit(data, include=np.tile(few, (90, 1))).analysis.determined.keep.all()


@pytest.mark.parametrize("kind", ["polynomial", "factors"])
def test_a_dead_member_does_not_stop_the_others(kind):
    data, options = runs(("sd",), 20), Options(model=kind)
    raw = data.accelerometer.copy()
    raw[3] = 0.0
    broken = fit(replace(data, accelerometer=raw), options)
    whole = fit(data, options)
    others = np.arange(20) != 3
    assert (broken.status[others] == 0).all()
    np.testing.assert_allclose(
        broken.state.params[others], whole.state.params[others], rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("lacking", [("soaks",), ("soaks", "noise")], ids=["declared", "estimated"])
@pytest.mark.parametrize("options", [Options(), Options(order=2)], ids=["polynomial", "factors"])
def test_a_member_that_determines_less_does_not_change_the_others(options, lacking):
    data, include = runs(lacking, 20), np.ones((20, 48))
    include[3] = np.arange(48) % 12 == 0  # one toolface
    include[7, 4:] = 0
    others = ~np.isin(np.arange(20), (3, 7))
    mixed, whole = fit(data, options, include), fit(data, options)
    assert not mixed.analysis.determined.keep.all(-1)[~others].any()
    assert (mixed.iterations[others] == 1).all()
    assert (mixed.iterations[~others] > 1).all()
    for name in ("params", "attitude"):
        ours, theirs = (getattr(f.state, name) for f in (mixed, whole))
        np.testing.assert_array_equal(ours[others], theirs[others])
    for name in ("covariance", "variance_factor", "residual"):
        ours, theirs = (getattr(f.analysis, name) for f in (mixed, whole))
        np.testing.assert_array_equal(ours[others], theirs[others])
    np.testing.assert_array_equal(mixed.noise[others], whole.noise[others])
    for member in (3, 7):
        part = fit(runs_of(data, [member]), options, include[[member]])
        np.testing.assert_array_equal(mixed.state.params[[member]], part.state.params)
        np.testing.assert_array_equal(mixed.noise[[member]], part.noise)


def runs_of(data, members):
    field = None if data.magnetometer is None else data.magnetometer[members]
    return replace(data, accelerometer=data.accelerometer[members], magnetometer=field)
