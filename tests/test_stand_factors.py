"""Factors over temperature on a stand of uncertain angles: the way by axis comes to what the general one comes to."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.automatic import courses
from mwdcal.calibration.automatic.auto import choose_orders
from mwdcal.calibration.automatic.drift import with_drift
from mwdcal.calibration.diagnosis import findings
from mwdcal.calibration.estimate import fit, with_all
from mwdcal.calibration.options import AUTO, Options
from mwdcal.estimation import drift, uncertainty
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import stand_factors
from mwdcal.estimation.solvers import Determined, stepped
from simulation import DEG
from test_courses import NOISE, read, tools

SOAKS = (25.0, 65.0, 105.0, 145.0)
STAND = {"inclination": 0.01, "azimuth": 0.05, "toolface": 0.02}
INCLINATIONS = np.array([0.3, 45.0, 90.0, 135.0])
ORDERS = [(2, 2), (3, 1), (2, 0), (0, 1)]
DRIFTING = [[], [True, False], [False, True], [True, True]]


def on_stand(seed, count=4, practice="per-station", declared=True, size=1.0, order=3, noise=NOISE):
    """Runs of six toolfaces at each of four directions and temperatures; the stand errs by its σ times a size."""
    rng, stations = np.random.default_rng(seed), 24 * len(SOAKS)
    direction = np.tile(np.repeat(np.arange(4), 6), len(SOAKS))
    toolface = np.tile(np.arange(6) * 60.0, 4 * len(SOAKS))
    aimed = [INCLINATIONS[direction] * DEG, (40.0 + 77.0 * direction) * DEG, toolface * DEG]
    # a setting errs as a whole, a toolface by itself
    setting = np.arange(stations) // (6 if practice == "per-direction" else 1)
    errors = [size * rng.normal(size=stations)[setting] for _ in range(2)]
    errors.append(size * rng.normal(size=stations))
    known = [a + sd * DEG * e for a, sd, e in zip(aimed, STAND.values(), errors, strict=True)]
    factors, warmth = tools(count, seed, order), np.repeat(SOAKS, 24)
    readings = read(factors, known, warmth, seed, declared, noise=noise)
    shape = (count, stations)
    stated = {n: np.broadcast_to(v, shape) for n, v in zip(STAND, aimed, strict=True)}
    sd = {name: np.full(shape, sd * DEG) for name, sd in STAND.items()}
    known, sd = readings.known | stated, readings.sd | sd
    return replace(readings, known=known, sd=sd, settings=practice)


@pytest.fixture
def general(monkeypatch):
    """Lets every tool go the general way from now on."""
    return lambda: monkeypatch.setattr(stand_factors, "comes_apart", lambda problem: False)


def sigma(result):
    return np.sqrt(np.einsum("bii->bi", result.analysis.covariance))


def assert_alike(ours, theirs, share):
    """Analyses agree, to a share of the largest element of each part."""
    for name in vars(theirs):
        mine, other = getattr(ours, name), getattr(theirs, name)
        if name != "determined" and other is not None:
            size = np.abs(other).max(initial=0.0)
            np.testing.assert_allclose(mine, other, rtol=0, atol=share * size, err_msg=name)


@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_it_is_the_general_minimum(order, practice, general):
    readings, options = on_stand(1, practice=practice), Options(order=order)
    ours = fit(readings, options)
    assert stand_factors.applies(ours.problem)
    assert ours.state.settings.shape[-1] == (32 if practice == "per-direction" else 0)
    general()
    theirs = fit(readings, options)
    np.testing.assert_allclose(
        (ours.state.params - theirs.state.params) / sigma(theirs), 0, atol=1e-5
    )
    np.testing.assert_allclose(ours.state.errors, theirs.state.errors, atol=1e-8)
    np.testing.assert_allclose(ours.state.settings, theirs.state.settings, atol=1e-6)
    np.testing.assert_array_equal(ours.status, theirs.status)
    assert_alike(ours.analysis, theirs.analysis, 1e-5)


@pytest.mark.parametrize("size", [0.0, 1.0, 20.0])
def test_noise_that_is_not_declared_is_the_general_one(size, general):
    readings, options = on_stand(2, declared=False, size=size), Options(order=(2, 1))
    ours = fit(readings, options)
    general()
    theirs = fit(readings, options)
    np.testing.assert_allclose(ours.noise, theirs.noise, rtol=1e-5)
    np.testing.assert_allclose(
        (ours.state.params - theirs.state.params) / sigma(theirs), 0, atol=1e-4
    )


def drifting(triads, practice="per-station"):
    """Fits of tools, with a drift of some triads."""
    options = Options(order=(2, 1))
    result = fit(on_stand(9, practice=practice, size=2.0), options)
    return with_drift(result, options, np.array(triads)) if triads else result


@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
@pytest.mark.parametrize("triads", DRIFTING, ids=str)
def test_no_step_of_the_general_way_leads_further(triads, practice):
    ours = drifting(triads, practice)
    problem, state = ours.problem, ours.state
    assert stand_factors.applies(problem)
    moved = stepped(problem, state, ours.analysis.determined)
    np.testing.assert_allclose((moved.params - state.params) / sigma(ours), 0, atol=1e-8)
    np.testing.assert_allclose(moved.errors, state.errors, atol=1e-10)
    np.testing.assert_allclose(moved.settings, state.settings, atol=1e-7)
    if triads:
        size = np.stack([constant.sd for constant in problem.evidence.constants], -1)
        np.testing.assert_allclose((moved.constants - state.constants) / size, 0, atol=1e-6)


@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
@pytest.mark.parametrize("triads", DRIFTING, ids=str)
def test_its_analysis_is_the_general_one(triads, practice):
    ours = drifting(triads, practice)
    problem, state = ours.problem, ours.state
    known = Determined.of(problem, state)
    other = uncertainty.analyse(problem, state, known)
    assert_alike(with_all(ours).analysis, uncertainty.completed(problem, state, other), 1e-9)
    for name in ("values", "norms"):
        mine = getattr(ours.analysis.determined, name)
        np.testing.assert_allclose(mine, getattr(known, name), rtol=1e-9)


@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
def test_scores_of_drifts_are_the_general_ones(practice, general):
    result = fit(on_stand(10, practice=practice), Options(order=(2, 1)))
    given = result.problem, result.state, result.analysis
    mine = drift.walk_scores(*given)
    general()
    other = drift.walk_scores(*given)
    assert [*mine.places] == [*other.places]
    pairs = ("score", mine.score, other.score), ("information", mine.information, other.information)
    for name, ours, theirs in (*pairs, ("alone", mine.alone(), other.alone())):
        size = np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * size, err_msg=name)


@pytest.mark.parametrize("practice", ["per-station", "per-direction"])
@pytest.mark.parametrize("order", [(1, 1), (2, 1), (0, 1)], ids=str)
def test_further_terms_are_the_general_ones(order, practice, general):
    result = fit(on_stand(11, practice=practice), Options(order=order))
    mine = courses.terms_beyond(result)
    general()
    result.problem.memo.clear()
    other = courses.terms_beyond(result)
    for name, theirs in vars(other).items():
        np.testing.assert_allclose(getattr(mine, name), theirs, rtol=1e-6, atol=1e-12, err_msg=name)


def test_terms_beyond_order_0_at_exact_angles_are_the_general_ones(general):
    readings = on_stand(14, 3)
    exact = replace(readings, sd={n: sd for n, sd in readings.sd.items() if n not in STAND})
    mine = courses.terms_beyond(fit(exact, Options(order=0)))
    general()
    other = courses.terms_beyond(fit(exact, Options(order=0)))
    assert_alike(mine, other, 1e-6)


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("declared", [True, False])
def test_the_orders_are_those_of_the_general_way(order, declared, general):
    readings = on_stand(20 + order, count=8, order=order, declared=declared)
    ours = choose_orders(readings, Options(order=AUTO))
    general()
    np.testing.assert_array_equal(choose_orders(readings, Options(order=AUTO)), ours)


def test_a_tool_does_not_depend_on_its_fleet():
    readings, options = on_stand(5, count=7), Options(order=(2, 1))
    whole, alone = fit(readings, options), fit(take(readings, np.array([4])), options)
    np.testing.assert_array_equal(whole.state.params[[4]], alone.state.params)


def test_stations_that_do_not_determine_all_go_the_general_way(general):
    readings, options = on_stand(6), Options(order=(1, 1))
    upright = np.repeat(np.array([[True], [False], [False], [False]]), 96, 1)
    include = np.where(upright & (np.arange(96) % 24 >= 6), 0.0, 1.0)
    ours = fit(readings, options, include)
    assert ours.analysis.determined.keep.all(-1).tolist() == [False, True, True, True]
    general()
    theirs = fit(readings, options, include)
    rank = ours.analysis.determined.rank
    np.testing.assert_array_equal(rank, theirs.analysis.determined.rank)
    np.testing.assert_allclose(
        ours.state.params, theirs.state.params, atol=1e-4 * sigma(theirs).max()
    )


def test_copies_are_found_among_stations_that_happen_to_lie_close():
    readings = on_stand(7)
    raw = readings.accelerometer.copy(), readings.magnetometer.copy()
    for each in raw:
        each[2, 70] = each[2, 10]
    copied = replace(readings, accelerometer=raw[0], magnetometer=raw[1])
    found = findings.copies(fit(copied, Options(order=(2, 1))))
    assert np.argwhere(found).tolist() == [[2, 70]]


def inverse_of(matrix):
    """An inverse (u, u) in long arithmetic: Gauss and Jordan, rows of the largest pivot first."""
    scale = np.sqrt(np.diag(matrix))
    whole = np.concatenate([matrix / scale[:, None] / scale, np.eye(len(matrix))], 1)
    for k in range(len(matrix)):
        pivot = k + np.argmax(np.abs(whole[k:, k]))
        whole[[k, pivot]] = whole[[pivot, k]]
        whole[k] /= whole[k, k]
        others = np.arange(len(matrix)) != k
        whole[others] -= whole[others, k, None] * whole[k]
    return whole[:, len(matrix) :] / scale[:, None] / scale


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no long arithmetic here")
def test_residuals_of_large_drifts_spread_as_long_arithmetic_has_it():
    readings, options = on_stand(12, count=2), Options(order=(3, 3))
    rng = np.random.default_rng(12)
    walk = 100 * np.cumsum(rng.normal(size=(2, 96, 6)), 1) / np.sqrt(96) * np.repeat(NOISE, 3)
    drifted = replace(
        readings,
        accelerometer=readings.accelerometer + walk[..., :3],
        magnetometer=readings.magnetometer + walk[..., 3:],
    )
    ours = with_drift(fit(drifted, options), options, np.array([True, True]))
    assert stand_factors.applies(ours.problem)
    assert ours.analysis.determined.clear.all()
    linear = ours.problem.linear(ours.state)
    for tool, spread in enumerate(ours.analysis.spread):
        private, rows = (x[tool].astype(np.longdouble) for x in (linear.private, linear.design))
        core = [inverse_of(np.eye(3) + g.mT @ g) for g in private]
        weight = np.eye(6) - private @ np.array(core) @ private.mT
        flat = (weight @ rows).reshape(-1, rows.shape[-1])
        whole = inverse_of(rows.reshape(flat.shape).mT @ flat + linear.prior[tool])
        exact = weight - (weight @ rows) @ whole @ (weight @ rows).mT
        np.testing.assert_allclose(spread, exact.astype(float), rtol=0, atol=2e-3)
