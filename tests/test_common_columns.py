"""What tools at the same exact references have in common gives what each of them gives by itself."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.automatic import drift
from mwdcal.calibration.automatic.drift import by_drift, chances, with_drift
from mwdcal.calibration.diagnosis import structure
from mwdcal.calibration.diagnosis.plausibility import freedom_of
from mwdcal.calibration.diagnosis.structure import may_show
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.estimation.minimisers import closed_form_drift
from test_run_drift import runs

OPTIONS = Options(order=0)


def imperfect(readings):
    """The readings of tools with gains, axes and offsets of their own."""
    rng = np.random.default_rng(1)
    size = len(readings.accelerometer)
    raw = [
        vectors @ (np.eye(3) + rng.uniform(-0.03, 0.03, (size, 3, 3))) + rng.uniform(-at, at, 3)
        for vectors, at in ((readings.accelerometer, 0.01), (readings.magnetometer, 500.0))
    ]
    return replace(readings, accelerometer=raw[0], magnetometer=raw[1])


@pytest.fixture
def apart(monkeypatch):
    """Lets every tool go the general way from now on."""

    def general():
        for module in (closed_form_drift, closed_form_drift):
            monkeypatch.setattr(module, "are_common", lambda problem: False)
        monkeypatch.setattr(
            structure, "may_show", lambda result, _: np.ones(len(result.status), bool)
        )

    return general


@pytest.mark.parametrize("triads", [[True, False], [False, True], [True, True]], ids=str)
def test_a_drift_in_closed_form_is_the_general_minimum(triads, apart):
    result = fit(imperfect(runs(3, 6, field=40.0, offset=1e-4)), OPTIONS)
    ours = with_drift(result, OPTIONS, np.array(triads))
    assert closed_form_drift.applies(ours.problem)
    freedom = freedom_of(ours)
    apart()
    theirs = with_drift(result, OPTIONS, np.array(triads))
    sd = np.sqrt(np.einsum("bii->bi", theirs.analysis.covariance))
    np.testing.assert_allclose((ours.state.params - theirs.state.params) / sd, 0, atol=1e-7)
    np.testing.assert_allclose(freedom, freedom_of(theirs), rtol=1e-7)
    np.testing.assert_array_equal(ours.status, theirs.status)
    for name in ("covariance", "variance_factor", "freedom", "residual", "spread", "effects"):
        mine, other = (getattr(f.analysis, name) for f in (ours, theirs))
        size = np.abs(other).max()
        np.testing.assert_allclose(mine, other, atol=1e-7 * size, err_msg=name)


@pytest.mark.parametrize("error", [0.0, 5e-4, 2e-3])
def test_the_first_look_leaves_out_no_effect(error, apart):
    readings = imperfect(runs(8, 40))
    steps = np.sign(np.diff(readings.known["inclination"], prepend=0.0))
    readings.known["inclination"] = readings.known["inclination"] + error * steps
    result = fit(readings, OPTIONS)
    fits = [each for _, each in by_drift(result, OPTIONS)]
    assert any(each.problem.walks for each in fits)
    ours = [shown for each in fits for shown in structure.shown_effects(each, {})]
    looked_at = np.concatenate([may_show(each) for each in fits])
    assert looked_at.mean() < 0.25 or error
    apart()
    theirs = [shown for each in fits for shown in structure.shown_effects(each, {})]
    assert [[*shown] for shown in ours] == [[*shown] for shown in theirs]
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose([*mine.values()], [*other.values()], rtol=1e-9)


@pytest.mark.parametrize("error", [0.0, 1e-4, 2e-4, 1e-3])
def test_what_a_bound_leaves_out_would_not_show(error, monkeypatch):
    """Every gain worked out says the same; sensors that differ fivefold in their noise have no bound."""
    readings = imperfect(runs(9, 120))
    turn = np.where(np.arange(readings.count) % 2, error, -error)
    readings.known["inclination"] = readings.known["inclination"] + turn
    raw = readings.magnetometer.copy()
    raw[::10] += 60.0 * np.random.default_rng(2).normal(size=raw[::10].shape)
    result = fit(replace(readings, magnetometer=raw), OPTIONS)
    asked, bounded, shown = [], structure._may_be_enough, structure.may_show(result)
    monkeypatch.setattr(
        structure, "_may_be_enough", lambda *a: asked.append(bounded(*a)) or np.ones(120, bool)
    )
    np.testing.assert_array_equal(structure.may_show(result), shown)
    (near,) = asked
    assert near[::10].sum() >= 11
    if error == 0.0:
        assert np.delete(near, slice(None, None, 10)).mean() < 0.1
    elif error == 1e-3:
        assert shown.mean() > 0.5


def test_scores_of_long_runs_are_those_of_each_residual(monkeypatch):
    result = fit(imperfect(runs(8, 4, field=40.0)), OPTIONS)
    by_units, *flags = chances(result)
    monkeypatch.setattr(drift, "MOST_UNITS", 0)
    np.testing.assert_allclose(chances(result)[0], by_units, rtol=1e-7)
    np.testing.assert_array_equal(chances(result)[1:], flags)


def test_memory_of_a_drift_search_grows_with_the_stations_not_with_their_square():
    short = imperfect(runs(8, 1))
    times = 25
    long = replace(
        short,
        accelerometer=np.tile(short.accelerometer, (1, times, 1)),
        magnetometer=np.tile(short.magnetometer, (1, times, 1)),
        known={name: np.tile(values, times) for name, values in short.known.items()},
    )
    result = fit(long, OPTIONS)
    tracemalloc.start()
    chances(result)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    residuals = result.analysis.residual.size
    assert residuals > drift.MOST_UNITS
    assert peak < residuals**2 * 8 / 3
