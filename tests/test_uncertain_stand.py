"""A stand of known, uncertain angles: the short way comes to the minimum and the noise of the general one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from mwdcal.calibration.automatic import drift as automatic
from mwdcal.calibration.automatic.drift import with_drift
from mwdcal.calibration.diagnosis import structure
from mwdcal.calibration.diagnosis.plausibility import toolface_agreement
from mwdcal.calibration.estimate import fit, refitted
from mwdcal.calibration.options import Options
from mwdcal.estimation import drift, uncertainty
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form, uncertain_stand
from mwdcal.estimation.solvers import stepped
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
    vectors = uncertain_stand.StandRuns.of(problem).vectors(errors.mT)[0]
    state = replace(closed_form.start(problem), errors=errors)
    for index, target in enumerate(problem.targets(state)):
        np.testing.assert_allclose(
            np.moveaxis(vectors[index, :3], 0, -1), target, rtol=0, atol=1e-9
        )


DRIFTING = [[], [True, False], [False, True], [True, True]]


def drifting(seed, triads, **changes):
    """Fits of tools, with a drift of some triads."""
    result = fit(on_stand(seed, 5, **changes), OPTIONS)
    return with_drift(result, OPTIONS, np.array(triads)) if triads else result


@pytest.mark.parametrize("triads", DRIFTING, ids=str)
def test_no_step_of_the_general_way_leads_further(triads):
    ours = drifting(9, triads, size=2.0)
    problem, state = ours.problem, ours.state
    assert uncertain_stand.applies(problem)
    moved = stepped(problem, state, ours.analysis.determined)
    sd = np.sqrt(np.einsum("bii->bi", ours.analysis.covariance))
    np.testing.assert_allclose((moved.params - state.params) / sd, 0, atol=1e-6)
    np.testing.assert_allclose(moved.errors, state.errors, atol=1e-9)
    if triads:
        size = np.stack([constant.sd for constant in problem.evidence.constants], -1)
        np.testing.assert_allclose((moved.constants - state.constants) / size, 0, atol=1e-6)


@pytest.mark.parametrize("triads", DRIFTING, ids=str)
def test_its_analysis_is_the_general_one(triads, monkeypatch):
    monkeypatch.setattr(uncertain_stand, "NUMBERS_AT_ONCE", 10_000)  # five tools in pieces
    ours = drifting(9, triads)
    problem, state, mine = ours.problem, ours.state, ours.analysis
    other = uncertainty.analyse(problem, state, mine.determined)
    other = uncertainty.completed(problem, state, other)
    for name in vars(other):
        if name not in ("determined", "influence"):
            a, b = getattr(mine, name), getattr(other, name)
            size = np.abs(b).max(initial=0.0)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * size, err_msg=name)


def test_scores_of_drifts_are_the_general_ones():
    result = fit(on_stand(10, 4), OPTIONS)
    given = result.problem, result.state
    mine = drift.walk_scores(*given, result.analysis)
    other = drift.walk_scores(*given, replace(result.analysis, squares=None))
    for name, places in mine.places.items():
        some = np.ix_(np.arange(4), places, places)
        theirs = other.of([name])
        size = np.abs(theirs.information).max()
        np.testing.assert_allclose(mine.score[:, places], theirs.score, atol=1e-9 * np.sqrt(size))
        np.testing.assert_allclose(mine.information[some], theirs.information, atol=1e-9 * size)
        np.testing.assert_allclose(mine.alone()[some], theirs.alone(), rtol=1e-9, atol=1e-9 * size)
        np.testing.assert_allclose(mine.shown(name), other.shown(name), rtol=1e-7)
    apart = [*mine.places][::2]
    mine, theirs = drift.walk_scores(*given, result.analysis, apart).of(apart), other.of(apart)
    size = np.abs(theirs.information).max()
    np.testing.assert_allclose(mine.score, theirs.score, atol=1e-9 * np.sqrt(size))
    np.testing.assert_allclose(mine.information, theirs.information, atol=1e-9 * size)


def test_what_a_huge_drift_leaves_is_not_lost_in_rounding():
    """A drift of 10 000 times the noise: by orthogonal columns, of which the drift's precision is a row each."""
    result = fit(on_stand(11, 2), OPTIONS)
    size = np.full((2, 2), 1.0)
    walking = drift.with_walks(result.problem, result.state, {"accelerometer-drift": size})
    ours = refitted(result, *walking, np.ones((2, 2)), OPTIONS)
    linear = ours.problem.linear(ours.state)
    root = np.linalg.cholesky(linear.weight).mT
    columns = (root @ linear.design).reshape(2, -1, linear.prior.shape[-1])
    prior = np.sqrt(np.einsum("bii->bi", linear.prior))[..., None] * np.eye(linear.prior.shape[-1])
    whole = np.concatenate([columns, prior], 1)
    length = np.linalg.norm(whole, axis=1, keepdims=True)
    basis, triangle = np.linalg.qr(whole / length)
    back = np.linalg.inv(triangle)[:, :24] / length.mT[:, :24]
    sd = np.sqrt(np.sum(back**2, -1))
    stated = np.sqrt(np.einsum("bii->bi", ours.analysis.covariance))
    np.testing.assert_allclose(stated, sd, rtol=1e-6)
    basis = basis[:, : columns.shape[1]].reshape(2, 48, 6, -1)
    expected = root.mT @ (np.eye(6) - basis @ basis.mT) @ root
    np.testing.assert_allclose(ours.analysis.spread, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("declared", [True, False])
def test_the_first_look_leaves_out_no_effect(declared, monkeypatch):
    """Hysteresis from none to what is plain, at the same references: tools of chances about the limit."""
    known = replace(imperfect(runs(12, 48)), settings="per-station")
    moved = np.sign(np.diff(known.magnetometer, axis=1, prepend=known.magnetometer[:, :1]))
    raw = known.magnetometer + np.linspace(0.0, 30.0, 48)[:, None, None] * moved
    angles = {name: np.radians(sd) for name, sd in STAND.items()}
    readings = replace(known, magnetometer=raw, sd=angles | (NOISE if declared else {}))
    result = fit(readings, OPTIONS)
    ours, looked_at = structure.shown_effects(result, {}), structure.on_stand_may_show(result)
    monkeypatch.setattr(structure, "on_stand_may_show", lambda *a: np.ones(48, bool))
    theirs = structure.shown_effects(result, {})
    assert [[*each] for each in ours] == [[*each] for each in theirs]
    assert any(theirs)
    assert not looked_at.all()


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


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("stand", [True, False])
def test_no_constant_error_is_taken_for_a_drift(declared, stand, monkeypatch):
    """Dips that are off, each other tool with a bad station: the same drifts as if all tools were searched."""
    alike = replace(imperfect(runs(21, 12)), sd=NOISE if declared else {})
    raw = alike.magnetometer.copy()
    raw[::2, 7] += 300.0
    readings = replace(alike, magnetometer=raw)
    if stand:
        angles = {name: np.radians(sd) for name, sd in STAND.items()}
        readings = replace(readings, sd=readings.sd | angles, settings="per-station")
    look = "on_stand_may_show" if stand else "may_show"
    for off in (0.0, 0.01, 0.02, 0.04, 0.4):
        dip = readings.known["dip"] + np.radians(off)
        result = fit(replace(readings, known=readings.known | {"dip": dip}), OPTIONS)
        looked_at = getattr(structure, look)(result, structure.CONSTANT_ERRORS)
        with monkeypatch.context() as patch:
            patch.setattr(structure, look, lambda result, _: np.ones(len(result.status), bool))
            searched = automatic.drifting(result, OPTIONS)
        for ours, theirs in zip(automatic.drifting(result, OPTIONS), searched, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert not looked_at[1::2].all() or off
    drifted, wrong = searched
    assert not drifted.any()
    assert wrong[1::2].all()


@pytest.mark.parametrize("by", ["station", "direction", "toolface"])
@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
def test_toolfaces_that_were_set_less_often_than_at_every_station_are_named(by, practice):
    """The chance is that of SciPy's analysis of variance of the errors that were put in, 0.3° at noise of 0.006°."""
    tools, sd = 20, np.radians(0.3)
    alike, rng = runs(41, tools), np.random.default_rng(41)
    number = {
        "station": np.arange(48),
        "direction": np.arange(48) // 12,
        "toolface": np.arange(48) % 12,
    }
    errors = sd * rng.normal(size=(tools, 48))[:, number[by]]
    turn = (
        Rotation.from_rotvec(errors.ravel()[:, None] * [0, 0, -1.0])
        .as_matrix()
        .reshape(tools, 48, 3, 3)
    )
    raw = [(turn @ v[..., None])[..., 0] for v in (alike.accelerometer, alike.magnetometer)]
    angles = {"inclination": 1e-5, "azimuth": 1e-5, "toolface": sd}
    readings = replace(alike, accelerometer=raw[0], magnetometer=raw[1], sd=angles | NOISE)
    result = fit(replace(readings, settings=practice), OPTIONS)
    for kind in ("direction", "toolface"):
        chance, count = toolface_agreement(result, kind)
        assert set(count[by != "station" :]) <= {0, 4, 12}
        if kind == by:
            assert np.all(chance < 1e-9)
        elif by == "station" and kind == "direction":
            expected = [
                stats.f_oneway(*np.split(error, 4)).pvalue
                for error in errors - errors.mean(-1)[:, None]
            ]
            known = chance < 1
            assert known.any()
            assert np.all(np.abs(np.log(chance / expected)[known]) < 0.7)


@pytest.mark.parametrize("noise", [1e-7, 1e-8])
def test_steps_that_run_away_go_the_general_way(noise, general):
    """Noise of 1e-7 g, and a scale that grows by 1 % meanwhile: steps get longer until squares overflow."""
    readings = on_stand(3, 6)
    sd = {**readings.sd, "accelerometer": np.full(3, noise)}
    warmed = readings.accelerometer * np.linspace(1, 1.01, 48)[:, None]
    readings = replace(readings, accelerometer=warmed, sd=sd)
    ours = fit(readings, OPTIONS)
    general()
    theirs = fit(readings, OPTIONS)
    factors = ours.analysis.variance_factor, theirs.analysis.variance_factor
    assert np.sqrt(factors[1][:, 0]).min() > 1e3
    np.testing.assert_allclose(*factors, rtol=1e-3)
