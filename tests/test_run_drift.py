"""Slow drift within a run: seen, of the right size, in the uncertainty, and not seen in noise."""

from dataclasses import replace

import numpy as np
import pytest

from cli_support import calibrated, mwdcal, servo_run, write_csv
from mwdcal.calibration.automatic.drift import by_drift, chances
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import StatedCovariance, drifts
from mwdcal.estimation.drift import terms_of, walk_scores
from mwdcal.geometry.vectors import earth_field, earth_gravity, tool_from_earth
from mwdcal.sensor.profile import Profile

COUNT = 48


def runs(seed, tools, field=0.0, offset=0.0, straight=False, noise=(1e-4, 15.0)):
    """Nominal tools at four directions, each rolled through twelve toolfaces, that drift away from their start.

    `field`, nT, and `offset` of the accelerometer, g: 1σ on each axis of what a walk reaches, or the slope.
    """
    rng = np.random.default_rng(seed)
    inc, azi = np.repeat(np.radians([[5, 45, 90, 135], [0, 90, 180, 270]]), 12, axis=1)
    face = np.tile(np.arange(12) * np.pi / 6, 4)
    attitude = tool_from_earth(inc, azi, face)

    def path():
        steps = rng.normal(size=(tools, COUNT, 3)) / np.sqrt(COUNT)
        walk = np.linspace(0, 1, COUNT)[:, None] * rng.normal(size=(tools, 1, 3))
        whole = walk if straight else np.cumsum(steps, 1)
        return whole - whole.mean(1, keepdims=True)

    moved = earth_field(np.full(COUNT, 48_000.0), np.full(COUNT, 1.1)) + field * path()
    g = np.einsum("nij,nj->ni", attitude, earth_gravity(np.ones(COUNT))) + offset * path()
    b = np.einsum("nij,bnj->bni", attitude, moved)
    raw = [v + s * rng.normal(size=(tools, COUNT, 3)) for v, s in zip((g, b), noise, strict=True)]
    known = {"inclination": inc, "azimuth": azi, "toolface": face, "gravity": np.ones(COUNT),
             "field": np.full(COUNT, 48_000.0), "dip": np.full(COUNT, 1.1)}  # fmt: skip
    return Readings(*raw, known=known, sd={})


def covered(readings):
    """Share of the parameters' 95 % intervals that hold the truth, of nominal tools: accelerometer, magnetometer."""
    shares, options = [], Options(order=0)
    for _, result in by_drift(fit(readings, options), options):
        for triad, where in zip(result.problem.triads, result.problem.slices(), strict=True):
            true = triad.model.start(
                np.broadcast_to(np.eye(3), (len(result.status), 3, 3)),
                np.zeros((len(result.status), 3)),
            )
            sd = np.sqrt(np.diagonal(StatedCovariance(result).total, axis1=1, axis2=2))[:, where]
            shares.append(np.abs(result.state.params[:, where] - true) < 1.96 * sd)
    return np.concatenate([s.mean(-1) for s in shares[::2]]), np.concatenate(
        [s.mean(-1) for s in shares[1::2]]
    )


def test_the_walk_is_that_of_brown():
    """Covariance of a walk less its mean: min(s, t) - s + s²/2 - t + t²/2 + 1/3."""
    values, (_, variance) = terms_of(400)
    place = (np.arange(400) + 0.5) / 400
    s, t = place[:, None], place
    exact = np.minimum(s, t) - s + s**2 / 2 - t + t**2 / 2 + 1 / 3
    part = (values[:, 2:] * variance[2:]) @ values[:, 2:].T
    assert np.abs(part - exact).max() < 0.026  # what cosines beyond the eighth hold: Σ 2/(πk)²
    assert variance[0] == pytest.approx(1 / 3)


def test_noise_is_seldom_taken_for_drift():
    result = fit(runs(0, 400), Options(order=0))
    share = (chances(result)[0] < 0.1).mean(0)
    assert np.all(share < 0.1 + 3 * np.sqrt(0.09 / 400))
    assert np.all(share > 0.02)


@pytest.mark.parametrize("straight", [False, True], ids=["walk", "straight"])
def test_intervals_include_a_drift_of_the_field(straight):
    """40 nT: without it in the model the gains' intervals cover three quarters."""
    readings = runs(1, 40, field=40.0, straight=straight)
    acc, mag = covered(readings)
    assert acc.mean() > 0.92
    assert mag.mean() > 0.92


def test_the_size_of_a_drift_is_stated():
    """0.6 mg along one axis from end to end, with noise of 0.02 mg; the magnetometer did not drift."""
    readings = runs(3, 1, noise=(2e-5, 15.0))
    slope = 6e-4 * np.linspace(-0.5, 0.5, COUNT)[:, None] * np.array([0.0, 1.0, 0.0])
    raw = readings.accelerometer[0] + slope
    one = Readings(raw, readings.magnetometer[0], known=readings.known, sd={})
    record = calibrate(one, Profile(name="x"), Options(order=0))
    (drift,) = [each for each in record.drift if each.name == "accelerometer"]
    assert drift.unit == "mg"
    assert abs(drift.change - 0.6) < 3 * drift.standard_uncertainty < 0.2
    (finding,) = [f for f in record.findings if f.id == "accelerometer-drift"]
    assert "uncertainty includes it" in finding.text
    assert "drift of the accelerometer during the run" in {row.source for row in record.budget}


def test_a_member_of_a_batch_drifts_as_it_does_alone():
    readings, options = runs(4, 12, field=40.0), Options(order=0)
    each = {}
    for places, result in by_drift(fit(readings, options), options):
        change = drifts(result).get("field-drift", (np.zeros(len(places)),))[0]
        each |= dict(zip(places.tolist(), change.tolist(), strict=True))
    for place in (0, 5, 11):
        one = Readings(
            readings.accelerometer[[place]],
            readings.magnetometer[[place]],
            known=readings.known,
            sd={},
        )
        [(_, result)] = by_drift(fit(one, options), options)
        alone = drifts(result).get("field-drift", (np.zeros(1),))[0]
        np.testing.assert_allclose(each[place], alone[0], rtol=1e-9)


def test_a_large_drift_is_no_error_against_the_references():
    """20 mg from end to end, two hundred times the noise: the errors of gravity are those of the drift."""
    readings = runs(5, 1)
    slope = 0.02 * np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.0, 1.0, 0.0])
    raw = readings.accelerometer[0] + slope
    declared = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    one = Readings(raw, readings.magnetometer[0], known=readings.known, sd=declared)
    record = calibrate(one, Profile(name="x"), Options(order=0))
    assert {finding.id for finding in record.findings} >= {"accelerometer-drift"}


@pytest.mark.parametrize(
    ("places", "said"),
    [(np.arange(COUNT), True), (np.r_[0:COUNT:2, COUNT - 1 : 0 : -2], False)],
    ids=["one direction after the other", "there and back"],
)
def test_steadiness_that_no_residual_tests_is_said(places, said):
    readings = runs(2, 1)
    known = {name: value[places] for name, value in readings.known.items()}
    raw = (values[0, places] for values in (readings.accelerometer, readings.magnetometer))
    record = calibrate(Readings(*raw, known=known, sd={}), Profile(name="x"), Options(order=0))
    assert ("steady accelerometer offsets" in record.assumed_exact) == said


def test_the_share_of_a_trend_is_that_of_a_regression():
    """Second formula: regression of accelerometer trends on the sensors' parameters, at exact attitudes."""
    result = fit(runs(2, 1), Options(order=0))
    attitude = result.state.attitude[0]
    g = attitude[..., 2]
    trend = (np.arange(COUNT) + 0.5) / COUNT - 0.5
    known = np.column_stack([g, np.ones(COUNT)])
    left = trend - known @ np.linalg.lstsq(known, trend, rcond=None)[0]
    scores = walk_scores(result.problem, result.state, result.analysis)
    share = scores.shown("accelerometer-drift")[0]
    assert share == pytest.approx(left @ left / (trend @ trend), rel=1e-3)


def test_a_wrong_prior_is_no_drift(tmp_path):
    """The calibration of another tool leaves residuals that go with attitude, and so with the order of stations."""
    previous = calibrated(tmp_path, servo_run(1))
    run = write_csv(tmp_path / "later.csv", servo_run(3))
    given = ("--tool", "servo", "--prior", previous, "-o", tmp_path / "later.json")
    made = mwdcal("calibrate", run, *given, "--json")
    assert made.code == 0, made
    found = {finding["id"] for finding in made.json["findings"]}
    assert "prior-conflict" in found
    assert not found & {"accelerometer-drift", "magnetometer-drift", "field-drift"}


def test_what_held_parameters_leave_is_no_drift():
    """A misaligned tool that is fitted with scales and biases alone: its residuals follow the attitudes."""
    readings = runs(5, 1)
    tilted = np.eye(3) + np.array([[0, 0.01, 0], [0, 0, -0.008], [0.005, 0, 0]])
    bent = replace(readings, accelerometer=readings.accelerometer @ tilted)
    options = Options(order=0, parameters=6)
    [(_, result)] = by_drift(fit(bent, options), options)
    assert not result.problem.walks
    assert chances(result)[0][0, 0] < 1e-6
