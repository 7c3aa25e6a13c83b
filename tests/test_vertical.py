"""Roll sets at vertical: starts, shared and private turns, and the spread of inclination there."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.refusals import fit_refusals
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.sensor.profile import Profile
from simulation import DEG, Tool, attitude, plan

NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
PROFILE = Profile(name="test tool")
FIELD = 48_000.0
ROLLS = 8


def roll_sets(inclinations, known, seed, count=50, off=0.0):
    """Readings (count, n) of roll sets in random azimuths and dips, and the tools (S, o).

    `off` is how far from vertical, in degrees, the first set stands.
    """
    rng = np.random.default_rng(seed)
    inc = np.repeat(inclinations, ROLLS) * DEG + np.zeros((count, 1))
    inc[:, :ROLLS] = np.abs(inc[:, :ROLLS] - off * DEG)
    azi = np.repeat(rng.uniform(0, 2 * np.pi, (count, len(inclinations))), ROLLS, -1)
    face = np.tile(np.arange(ROLLS) * 2 * np.pi / ROLLS, len(inclinations)) + 0 * inc
    dip = rng.uniform(-75, 75, (count, 1)) * DEG + 0 * inc
    vectors = attitude(inc, azi, face)
    north, down = (vectors(1.0, FIELD, d)[1] for d in (0.0, np.pi / 2))
    field = np.cos(dip)[..., None] * north + np.sin(dip)[..., None] * down
    matrix = np.eye(3) * (1 + 0.05 * rng.uniform(-1, 1, (count, 2, 3, 3)))
    matrix = matrix + 3e-3 * rng.uniform(-1, 1, (count, 2, 3, 3))
    offset = rng.uniform(-1, 1, (count, 2, 3)) * np.array([[0.01], [500.0]])
    raw = [
        np.einsum("bij,bnj->bni", matrix[:, t], v)
        + offset[:, t, None]
        + sd * rng.normal(size=v.shape)
        for t, (v, sd) in enumerate(((vectors(1.0, FIELD, 0.0)[0], 1e-4), (field, 15.0)))
    ]
    values = {"inclination": inc, "azimuth": azi, "toolface": face, "dip": dip}
    values["field"] = np.full(inc.shape, FIELD)
    group = np.repeat(np.arange(len(inclinations)), ROLLS) + np.zeros((count, 1), int)
    made = Readings(raw[0], raw[1], known={k: values[k] for k in known}, sd=NOISE, group=group)
    return made, matrix, offset


def normalised_error(result, matrix, offset, strength=FIELD):
    """χ² (B,) of the errors of both triads with the covariance stated, over 24."""
    errors, rows = [], []
    size = result.state.params.shape[-1]
    points, cold = np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.zeros((len(matrix), 4))
    pairs = zip(result.problem.triads, result.problem.slices(), strict=True)
    for t, (triad, where) in enumerate(pairs):
        raw = np.einsum("bij,nj->bni", matrix[:, t], points * (1.0, strength)[t])
        raw, params = raw + offset[:, t, None], result.state.params[:, where]
        unit = (1.0, strength)[t] * 1e-3
        error = triad.model.fields(params, raw, cold) - points * (1.0, strength)[t]
        errors.append(error.reshape(-1, 12) / unit)
        row = np.zeros((len(raw), 12, size))
        row[..., where] = triad.model.jacobian(params, raw, cold).reshape(len(raw), 12, -1) / unit
        rows.append(row)
    error, row = np.concatenate(errors, -1), np.concatenate(rows, -2)
    spread = row @ result.analysis.covariance @ np.swapaxes(row, -1, -2)
    return np.einsum("bi,bi->b", error, np.linalg.solve(spread, error[..., None])[..., 0]) / 24


CASES = [
    ((0, 45, 90, 135), ("inclination", "toolface", "field")),
    ((180, 45, 90, 135), ("inclination", "toolface", "field")),
    ((0, 45, 90, 135), ("toolface", "field")),
]


@pytest.mark.parametrize(("inclinations", "known"), CASES)
def test_roll_sets_at_vertical_are_neither_refused_nor_wrong(inclinations, known):
    """Azimuth blank and shared, dip unknown: over true azimuths and dips of both hemispheres."""
    squares = []
    for seed, off in enumerate((0.0, 0.001, 0.01)):
        made, matrix, offset = roll_sets(inclinations, known, seed, off=off)
        result = fit(made)
        assert (result.status == 0).all()
        fitted = FittedRuns(made, PROFILE, Options(), result, alone=lambda _: None)
        assert not any(refusal.members.any() for refusal in fit_refusals(fitted))
        squares.append(normalised_error(result, matrix, offset))
    whole = np.concatenate(squares)
    assert whole.max() < 3.0  # 24 times it is χ² of 24, which exceeds 72 once in a million
    np.testing.assert_allclose(whole.mean(), 1.0, atol=0.08)


@pytest.mark.parametrize("grouped", [True, False])
def test_toolfaces_at_vertical_without_inclination_do_not_bias_toolface_zero(grouped):
    """One set exactly vertical with toolfaces alone; the others with all references but azimuth."""
    made, matrix, offset = roll_sets((0, 45, 90, 135), ("inclination", "toolface", "field"), 7)
    inclination = made.known["inclination"].copy()
    inclination[:, :ROLLS] = np.nan
    group = made.group if grouped else None
    result = fit(replace(made, known={**made.known, "inclination": inclination}, group=group))
    assert (result.status == 0).all()
    whole = normalised_error(result, matrix, offset)
    assert whole.max() < 3.0
    np.testing.assert_allclose(whole.mean(), 1.0, atol=0.15)
    turn = []
    for t, where in enumerate(result.problem.slices()):
        triad, params = result.problem.triads[t], result.state.params[:, where]
        gain = triad.model.slope(params, triad.raw[:, :1], result.problem.temperature[:, :1])[:, 0]
        gain = gain @ matrix[:, t]
        turn.append((gain[:, 1, 0] - gain[:, 0, 1]) / 2)
    # the mean of 50 tools has a seventh of the deviation of one
    assert (np.abs(np.mean(turn, -1)) < 0.6 * np.std(turn, -1)).all()


def test_nearly_vertical_stations_of_unknown_turn_settle():
    """At 0.001° azimuth and toolface cannot be told apart: steps along that shrink slowly."""
    inc, azi, face = plan((0.001, 45, 90, 135), ROLLS)
    tool = Tool.random(3)
    a, m = tool.readings(np.random.default_rng(3), 40, inc, azi, face)
    blank = np.where(np.arange(len(inc)) < ROLLS, np.nan, 1.0)
    known = {"inclination": inc, "azimuth": azi * blank, "toolface": face * blank}
    known |= {"field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip)}
    result = fit(Readings(a, m, known=known, sd=NOISE))
    assert (result.status == 0).all()
    assert (result.iterations == 60).any()
    true = [tool.matrix + np.zeros((40, 1, 1, 1)), tool.offset + np.zeros((40, 1, 1))]
    square = normalised_error(result, *(v * 1.0 for v in true), strength=tool.field)
    np.testing.assert_allclose(square.mean(), 1.0, atol=0.15)


def test_95_percent_of_inclinations_near_vertical_are_within_what_is_stated():
    """Tools drawn from what a calibration says of itself read tilts of 0 to 8 of its σ.

    The declared noise agrees with the residuals and counts as known: no spread of Student's t.
    """
    inc, azi, face = plan((5, 45, 90, 135), 4)
    tool = Tool.random(7)
    a, m = tool.readings(np.random.default_rng(0), 1, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip)}
    record = calibrate(Readings(a[0], m[0], known=known, sd=NOISE), PROFILE)
    rng, count, size = np.random.default_rng(1), 8000, 12
    covariance = record.parameter_covariance[:size, :size]
    freedom = record.accelerometer.freedom_of_noise
    assert freedom > 1e5
    drawn = rng.multivariate_normal(np.zeros(size), covariance, count)
    drawn *= np.sqrt(freedom / rng.chisquare(freedom, count))[:, None]
    params = np.array(record.accelerometer.parameters) + drawn
    gain, shift = params[:, :9].reshape(-1, 3, 3), params[:, 9:]
    found = []
    for down in (1.0, -1.0):
        up = Readings(tool.clean(0.0 if down > 0 else np.pi, 0.0, 0.0)[0][None])
        sigma = float(record.uncertainty("inclination", up)[0])
        for tilt in (0.0, 0.7, 1.5, 3.0, 5.0, 8.0):
            lean = tilt * sigma
            g = np.array([np.sin(lean) * 0.6, -np.sin(lean) * 0.8, down * np.cos(lean)])
            raw = np.linalg.solve(gain, (g - shift)[..., None])[..., 0]
            own, _ = record.fields(Readings(raw))
            error = np.arctan2(np.hypot(own[:, 0], own[:, 1]), down * own[:, 2]) - lean
            found.append(
                np.mean(np.abs(error) < record.expanded_uncertainty("inclination", Readings(raw)))
            )
    assert min(found) > 0.943  # 8000 draws: 0.95 with a deviation of 0.0024
    assert max(found) < 0.99
    assert found[5] < 0.957
    assert found[11] < 0.957
