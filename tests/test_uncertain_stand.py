"""A stand of known, uncertain angles: the short way comes to the minimum and the noise of the general one."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form, stand_linear, uncertain_stand
from mwdcal.estimation.uncertainty import TESTED, left_out_residual, station_misfit
from test_common_columns import imperfect
from test_run_drift import runs

OPTIONS = Options(order=0)
STAND = {"inclination": 0.01, "azimuth": 0.05, "toolface": 0.02}
NOISE = {"accelerometer": np.full(3, 1e-4), "magnetometer": np.full(3, 15.0)}


def on_stand(seed, tools, declared=True, size=1.0):
    """Tools whose stand errs by its σ, in degrees, times a size at every station."""
    readings, rng = imperfect(runs(seed, tools)), np.random.default_rng(seed)
    angles = {name: np.radians(sd) for name, sd in STAND.items()}
    known = {
        name: readings.known[name] + size * sd * rng.normal(size=(tools, 48))
        for name, sd in angles.items()
    }
    return replace(
        readings,
        known=readings.known | known,
        sd=angles | (NOISE if declared else {}),
        settings="per-station",
    )


@pytest.fixture
def general(monkeypatch):
    """Lets every tool go the general way from now on."""
    return lambda: monkeypatch.setattr(uncertain_stand, "applies", lambda problem: False)


@pytest.mark.parametrize("size", [0.0, 1.0, 20.0])
def test_it_is_the_general_minimum(size, general):
    readings = on_stand(3, 5, size=size)
    ours = fit(readings, OPTIONS)
    assert uncertain_stand.applies(ours.problem)
    general()
    theirs = fit(readings, OPTIONS)
    sd = np.sqrt(np.einsum("bii->bi", theirs.analysis.covariance))
    np.testing.assert_allclose((ours.state.params - theirs.state.params) / sd, 0, atol=1e-6)
    np.testing.assert_allclose(ours.state.errors, theirs.state.errors, atol=1e-11)
    np.testing.assert_array_equal(ours.status, theirs.status)
    for name in ("covariance", "variance_factor", "freedom", "residual", "spread"):
        mine, other = (getattr(f.analysis, name) for f in (ours, theirs))
        np.testing.assert_allclose(mine, other, atol=1e-6 * np.abs(other).max(), err_msg=name)
    for name in ("values", "norms"):
        mine, other = (getattr(f.analysis.determined, name) for f in (ours, theirs))
        np.testing.assert_allclose(mine, other, rtol=1e-9)


@pytest.mark.parametrize("size", [0.3, 1.0])
def test_its_noise_leaves_s_at_one(size, general):
    readings = on_stand(4, 6, declared=False, size=size)
    ours = fit(readings, OPTIONS)
    np.testing.assert_allclose(ours.analysis.variance_factor, 1, atol=3e-5)
    general()
    theirs = fit(readings, OPTIONS)
    np.testing.assert_allclose(ours.noise, theirs.noise, rtol=1e-3)  # where the general way ends
    sd = np.sqrt(np.einsum("bii->bi", theirs.analysis.covariance))
    np.testing.assert_allclose((ours.state.params - theirs.state.params) / sd, 0, atol=5e-3)


def test_a_tool_does_not_depend_on_its_fleet():
    readings = on_stand(5, 7, declared=False)
    whole, alone = fit(readings, OPTIONS), fit(take(readings, np.array([4])), OPTIONS)
    sd = np.sqrt(np.einsum("bii->bi", alone.analysis.covariance))
    np.testing.assert_allclose((whole.state.params[[4]] - alone.state.params) / sd, 0, atol=1e-8)
    np.testing.assert_allclose(whole.noise[[4]], alone.noise, rtol=1e-11)


def test_angles_err_as_the_problem_has_it():
    problem = fit(on_stand(6, 2), OPTIONS).problem
    errors = np.random.default_rng(0).normal(size=(2, 48, 3)) * 0.01
    vectors = stand_linear.StandRuns.of(problem).vectors(errors.mT)[0]
    state = replace(closed_form.start(problem), errors=errors)
    for index, target in enumerate(problem.targets(state)):
        np.testing.assert_allclose(
            np.moveaxis(vectors[index, :3], 0, -1), target, rtol=0, atol=1e-9
        )


def test_too_weak_attitudes_go_the_general_way(general):
    readings = on_stand(7, 2).select(np.arange(48) < 12)  # one inclination
    ours = fit(readings, OPTIONS)
    general()
    theirs = fit(readings, OPTIONS)
    assert not ours.analysis.determined.keep.all()
    np.testing.assert_array_equal(ours.state.params, theirs.state.params)


@pytest.mark.parametrize("least", [(0.1 * TESTED, 0.0), (-0.5, -0.1)])
def test_misfit_counts_what_is_tested_alone(least):
    analysis = fit(on_stand(8, 2), OPTIONS).analysis
    spread = analysis.spread.copy()
    values, vectors = np.linalg.eigh(spread[0, 5])
    values[:2] = least
    spread[0, 5] = vectors * values @ vectors.T
    analysis = replace(analysis, spread=spread)
    square, freedom = station_misfit(analysis)
    every, axes = np.linalg.eigh(spread)
    every = np.where(every > TESTED, every, np.inf)
    back = axes / every[..., None, :] @ np.swapaxes(axes, -1, -2)
    left = np.einsum("bnij,bnj->bni", back, analysis.residual)
    np.testing.assert_allclose(left_out_residual(analysis), left, atol=1e-8)
    np.testing.assert_allclose(square, np.sum(left * analysis.residual, -1), rtol=1e-8)
    assert freedom[0, 5] == 4
    assert (np.delete(freedom.ravel(), 5) == 6).all()
