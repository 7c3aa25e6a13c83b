"""Sixty factors over temperature: errors against an independent Cramér-Rao bound, and coverage."""

import numpy as np
import pytest
from scipy.special import stdtrit

from mwdcal.calibration import results
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.sensor.profile import Profile
from simulation import (
    DEG,
    attitude,
    complex_steps,
    factor_fields,
    factor_readings,
    factors_within_limits,
    plan,
)
from test_observables import complex_value

NOISE = np.repeat([1e-4, 15.0], 3)
FIELD, DIP = 50_000.0, 65 * DEG
ANGLES = np.tile(np.stack(plan((0, 45, 90, 135), 9)), 5)
WARMTH = np.repeat(np.linspace(25.0, 150.0, 5), 36)
STANDS = {"exact stand": (0.0, 0.0, 0.0), "stand of the servo profile": (0.01, 0.05, 0.02)}
"""Standard uncertainty of inclination, azimuth and toolface, degrees."""
NAMES = ("inclination", "azimuth", "toolface", "gravity", "field", "dip")
OPTIONS = Options(order=3, model="factors")


def elsewhere(rng, count=60):
    """Attitudes (3, count) and temperatures between those of the run."""
    inclination = np.arccos(rng.uniform(np.cos(170 * DEG), np.cos(10 * DEG), count))
    return np.stack([inclination, *rng.uniform(0, 360, (2, count)) * DEG]), rng.uniform(
        30, 145, count
    )


OTHER, WARM = elsewhere(np.random.default_rng(60))


def vectors(angles):
    return np.concatenate(attitude(*angles)(1.0, FIELD, DIP), -1)


def bound(tools, stand):
    """Covariance (tools, 60, 60) below which no unbiased estimate of the factors can be."""
    by_factor = complex_steps(lambda x: factor_readings(x, WARMTH, vectors(ANGLES)), tools)
    turns = [vectors(ANGLES + 1e-30j * e[:, None]).imag / 1e-30 for e in np.eye(3)]
    zero = factor_readings(tools, WARMTH, np.zeros((len(WARMTH), 6)))
    by_angle = np.stack([factor_readings(tools, WARMTH, t) - zero for t in turns], -1)
    spread = np.diag(NOISE**2) + by_angle * stand**2 @ np.swapaxes(by_angle, -1, -2)
    size = np.sqrt(np.sum(by_factor**2, (1, 2)))
    scaled = by_factor / size[:, None, None, :]
    whole = np.einsum("tnip,tniq->tpq", scaled, np.linalg.solve(spread, scaled), optimize=True)
    return np.linalg.inv(whole) / (size[:, :, None] * size[:, None, :])


def predicted(tools, limit):
    """Covariance (tools, k, k) of the k = 6 x 60 observables elsewhere, from the bound."""
    raw = factor_readings(tools, WARM, vectors(OTHER))

    def observed(factors):
        fields = factor_fields(factors, WARM, raw)
        return np.concatenate([complex_value(name, fields) for name in NAMES], -1)

    rows = complex_steps(observed, tools)
    return rows @ limit @ np.swapaxes(rows, -1, -2)


def simulated(stand, count):
    rng = np.random.default_rng([16, int(stand.any())])
    tools = factors_within_limits(rng, count)
    true = ANGLES + stand[:, None] * rng.normal(size=(count, 3, len(WARMTH)))
    pair = np.moveaxis(true, 1, 0)
    raw = factor_readings(tools, WARMTH, vectors(pair))
    raw = raw + NOISE * rng.normal(size=raw.shape)
    known = dict(zip(NAMES[:3], ANGLES, strict=True))
    known |= {"field": np.full(len(WARMTH), FIELD), "dip": np.full(len(WARMTH), DIP)}
    sd = {"accelerometer": NOISE[:3], "magnetometer": NOISE[3:]}
    sd |= {name: np.array(s) for name, s in zip(NAMES, stand, strict=False)}
    return tools, Readings(raw[..., :3], raw[..., 3:], WARMTH, known, sd)


def found(result, raw):
    """Fields (tools, 60, 6) elsewhere, and their derivative by the fit's own parameters."""
    triads = list(zip(result.problem.triads, result.problem.slices(), strict=True))
    fields, slopes = [], np.zeros((*raw.shape, 60))
    for t, (triad, where) in enumerate(triads):
        own, params = slice(3 * t, 3 * t + 3), result.state.params[:, where]
        fields.append(triad.model.fields(params, raw[..., own], WARM))
        slopes[:, :, own, where] = triad.model.jacobian(params, raw[..., own], WARM)
    return np.concatenate(fields, -1), slopes


def stated(result, fields, slopes):
    """Half widths (tools, 6 x 60) of the 95 % intervals, with the residuals' s² where it is above one.

    What the stand does has that of both triads together, what noise does that of each.
    """
    squares, freedom = result.analysis.variance_factor, result.analysis.freedom
    together = np.maximum((squares * freedom).sum(-1) / freedom.sum(-1), 1.0)
    spread = np.repeat(np.sqrt(np.maximum(squares, 1.0)), 30, -1)
    linear, whole = result.problem.linear(result.state), result.analysis.covariance
    weighed = np.einsum("tpq,tnmq->tnpm", whole, linear.weigh(linear.design))
    of_stand = weighed @ linear.private
    of_stand = np.sum(of_stand @ of_stand.mT, 1)
    covariance = (whole - of_stand) * spread[:, :, None] * spread[:, None, :]
    covariance += of_stand * together[:, None, None]
    widths = []
    for name in NAMES:
        gradient = OBSERVABLES[name].gradient(fields[..., :3], fields[..., 3:])
        rows = np.einsum("tni,tnip->tnp", gradient, slopes)
        widths.append(1.96 * np.sqrt(np.einsum("tnp,tpq,tnq->tn", rows, covariance, rows)))
    return np.concatenate(widths, -1)


def deviation(covariance):
    """Standard deviation of the ratio of rms error to prediction, over all tools and rows."""
    size = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (size[:, :, None] * size[:, None, :])
    return np.sqrt(2 * np.sum(correlation**2)) / (2 * size.size)


def ratio(error, covariance):
    return np.sqrt(np.mean(error**2 / np.diagonal(covariance, axis1=-2, axis2=-1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "within"), [(40, 0.06), pytest.param(160, 0.03, marks=pytest.mark.study)]
)
@pytest.mark.parametrize("name", STANDS)
def test_errors_meet_the_bound_and_intervals_cover(name, count, within):
    """Pooled within 6 %, or 3 %, more than three standard deviations; each observable within four of its."""
    stand = np.array(STANDS[name]) * DEG
    tools, readings = simulated(stand, count)
    result = fit(readings, OPTIONS)
    assert (result.status == 0).all()
    raw = factor_readings(tools, WARM, vectors(OTHER))
    fields, slopes = found(result, raw)
    true = np.concatenate([*OTHER, *np.repeat([[1.0], [FIELD], [DIP]], len(WARM), 1)])
    error = np.concatenate([complex_value(n, fields + 0j).real for n in NAMES], -1) - true
    angles = np.s_[:, : 3 * len(WARM)]
    error[angles] = np.angle(np.exp(1j * error[angles]))

    covariance = predicted(tools, bound(tools, stand))
    print(f"{name}: pooled {ratio(error, covariance):.4f} ± {deviation(covariance):.4f}")
    assert 3 * deviation(covariance) < within
    assert abs(ratio(error, covariance) - 1) < within
    half = stated(result, fields, slopes)
    for observable, own in zip(NAMES, np.split(np.arange(error.shape[-1]), 6), strict=True):
        block = covariance[:, own][:, :, own]
        covered = np.mean(np.abs(error[:, own]) < half[:, own])
        print(f"{observable} {ratio(error[:, own], block):.3f}, covered {covered:.4f}")
        assert abs(ratio(error[:, own], block) - 1) < 4 * deviation(block)
        assert 0.93 < covered < 0.97
    for tool in (0, 37):
        _calibrate_states_the_same(readings, raw, half, tool)


def _calibrate_states_the_same(readings, raw, half, tool):
    """The intervals of `calibrate` are no wider than Student's t makes them.

    Less what it adds for the order: a course that takes all temperatures may have a next power.
    """
    pair = (readings.accelerometer[tool], readings.magnetometer[tool])
    one = Readings(*pair, WARMTH, readings.known, readings.sd)
    probe = Readings(raw[tool, :, :3], raw[tool, :, 3:], WARM)

    def widened():
        record = calibrate(one, Profile(name="servo"), OPTIONS)
        own = [record.expanded_uncertainty(name, probe) for name in NAMES]
        return np.concatenate(own) / half[tool], record

    assert (widened()[0] > 1 - 1e-4).all()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "misfit_covariance", lambda r: 0 * r.analysis.covariance)
        wider, record = widened()
    freedom = min(triad.degrees_of_freedom for triad in record.triads)
    assert (wider > 1 - 1e-4).all()
    assert (wider < stdtrit(freedom, 0.975) / 1.96 + 1e-4).all()


def in_a_plane(away):
    """Twelve inclinations of a plane at two azimuths, and four stations `away` degrees off it."""
    roll = [(15 * k + 5, azimuth, 0) for azimuth in (0, 180) for k in range(12)]
    return [*roll, (60, 0, away), (120, 0, -away), (60, 180, away), (90, 10, away)]


def about_horizontal(away):
    """Three inclinations about 90°."""
    return [(90 + step * away, 65 * k, 55 * k) for step in (-1, 0, 1) for k in range(7)]


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(("stations", "away"), [
    (in_a_plane, 1), (in_a_plane, 3), (about_horizontal, 0.6), (about_horizontal, 2),
])  # fmt: skip
def test_an_axis_that_sees_little_of_the_field_is_found(stations, away, order):
    rng, tools = np.random.default_rng(order), 60
    warmth = np.linspace(10.0, 90.0, order + 1)
    stated = np.array(stations(away), float).T * DEG
    angles = np.tile(stated, order + 1)
    times = np.repeat(warmth, stated.shape[1])
    stand = np.array([0.01, 0.05, 0.02]) * DEG
    true = angles[:, None] + stand[:, None, None] * rng.normal(size=(3, tools, len(times)))
    raw = factor_readings(factors_within_limits(rng, tools), times, vectors(true))
    raw += NOISE * rng.normal(size=raw.shape)
    noise = {"accelerometer": np.full(3, NOISE[0]), "magnetometer": np.full(3, NOISE[3])}
    sigma = {n: np.full(len(times), s) for n, s in zip(NAMES, stand, strict=False)}
    found = []
    for known, spread in ((angles[:, None] + np.zeros_like(true), sigma), (true, {})):
        place = dict(zip(NAMES, known, strict=False))
        place |= {"field": np.full(len(times), FIELD), "dip": np.full(len(times), DIP)}
        sd = {n: np.broadcast_to(s, (len(times), 3)) for n, s in noise.items()} | spread
        data = Readings(raw[..., :3], raw[..., 3:], times, place, sd)
        found.append(fit(data, Options(order=order)))
    ours, closed = found
    assert (closed.iterations == 1).all()  # at the true attitudes there is no start to go wrong
    assert (ours.status == 0).all()
    assert ours.analysis.determined.keep.all()
    sd = np.sqrt(np.diagonal(ours.analysis.covariance, axis1=-2, axis2=-1))
    assert np.sqrt(np.mean(((ours.state.params - closed.state.params) / sd) ** 2)) < 1.1
    assert np.mean(ours.analysis.variance_factor) == pytest.approx(1.0, abs=0.1)
