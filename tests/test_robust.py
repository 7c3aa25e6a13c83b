"""Robust weights: little lost with good stations, nothing won by bad ones; stations left out."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.residuals import Residuals
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.solvers import consistency, inflation, weight
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.sensor.profile import Profile
from simulation import DEG, Tool, bound, plan
from test_calibrate import NOISE, PROFILE, make
from test_efficiency import affine, sensitivity

TOOL = Tool.random(7)
PLAN = plan()
SEEDS = 100
LIMIT = bound(TOOL, *PLAN)
NAMES = ("gravity", "inclination", "azimuth", "field", "dip", "toolface")


def runs(bad, declared=True):
    """Runs of which `bad` stations each have a kicked sensor or a misread stand."""
    rng = np.random.default_rng(11)
    a, m = TOOL.readings(rng, SEEDS, *PLAN)
    inc, azi, face = (np.tile(x, (SEEDS, 1)) for x in PLAN)
    for member in range(SEEDS):
        for station in rng.choice(48, bad, replace=False):
            kind = rng.integers(3)
            if kind == 0:
                a[member, station] += rng.normal(size=3) * 0.01
            elif kind == 1:
                m[member, station] += rng.normal(size=3) * 3000
            else:
                face[member, station] += 10 * DEG
    constants = {"dip": np.full(48, TOOL.dip), "field": np.full(48, TOOL.field)}
    known = {"inclination": inc, "azimuth": azi, "toolface": face, **constants}
    return Readings(a, m, known=known, sd=NOISE if declared else {})


def compared(result):
    """Root mean square error over the Cramér-Rao bound of 48 good stations, and coverage of 95 %."""
    params, covariance = affine(result)
    gains = [np.linalg.inv(m) for m in TOOL.matrix]
    pairs = zip(gains, TOOL.offset, strict=True)
    true = np.concatenate([np.concatenate([k.ravel(), -k @ o]) for k, o in pairs])
    spread = np.sqrt(np.repeat(result.analysis.variance_factor, 12, -1))
    covariance = covariance * spread[:, :, None] * spread[:, None, :]
    ratios, covered = [], []
    for name in NAMES:
        rows, forward = sensitivity(TOOL, name)
        error = (params - true) @ rows.T
        allowed = np.sqrt(np.einsum("ni,ij,nj->n", forward, LIMIT, forward))
        stated = np.sqrt(np.einsum("ni,bij,nj->bn", rows, covariance, rows))
        ratios.append(np.mean((error / allowed) ** 2))
        covered.append(np.mean(np.abs(error) < 1.98 * stated))
    return np.sqrt(np.mean(ratios)), np.mean(covered)


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "estimated"])
@pytest.mark.parametrize(("loss", "lost"), [("huber", 1.02), ("student-t", 1.08)])
def test_good_stations_lose_little_and_intervals_cover(loss, lost, declared):
    readings = runs(0, declared)
    ratio, covered = compared(fit(readings, Options(robust=loss)))
    assert ratio / compared(fit(readings))[0] < lost  # of the same draws with full weights
    assert 0.93 < covered < 0.97


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "estimated"])
def test_three_bad_stations_of_48_do_not_matter_to_student_t(declared):
    ratio, covered = compared(fit(runs(3, declared), Options(robust="student-t")))
    assert ratio < 1.15
    assert 0.93 < covered < 0.98
    assert compared(fit(runs(3, declared)))[0] > 10


def test_huber_keeps_a_bounded_pull():
    assert compared(fit(runs(3), Options(robust="huber")))[0] < 1.3


@pytest.mark.parametrize("loss", ["huber", "student-t"])
@pytest.mark.parametrize("k", [1, 3, 6])
def test_constants_of_the_weights_by_simulation(loss, k):
    """Location of a k-vector by the weights, over many samples: its variance and its scale."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(4000, 60, k))
    centre = np.zeros((4000, 1, k))
    for _ in range(60):
        w = weight(loss, np.sum((x - centre) ** 2, -1), np.full(60, float(k)))
        centre = np.sum(w[..., None] * x, 1, keepdims=True) / w.sum(1)[:, None, None]
    predicted = inflation(loss, k) / np.mean(w.sum(1))
    assert np.mean(centre**2) == pytest.approx(predicted, rel=0.06 / np.sqrt(k) + 0.02)
    square = np.sum(rng.normal(size=(400_000, k)) ** 2, -1)
    mean = np.mean(weight(loss, square, np.full(400_000, float(k))) ** 2 * square) / k
    assert consistency(loss, k) == pytest.approx(mean, rel=5e-3)


@pytest.mark.parametrize("unknown", [(), ("dip",), ("azimuth",), ("toolface", "dip")])
def test_left_out_residuals_are_those_of_the_fit_without_the_station(unknown):
    data = make(3, unknown=unknown)
    kicked = data.accelerometer.copy()
    kicked[7] += [0.002, 0, 0.001]
    data = replace(data, accelerometer=kicked)
    result, without = fit(data), fit(data, include=1 - np.eye(data.count))
    own = np.arange(data.count)
    theirs = [v[own, own] for v in without.problem.fields(without.state)]
    residuals = Residuals(data, result)
    for name in ("gravity", "inclination", "field", "dip"):
        value = OBSERVABLES[name].value
        after = value(*residuals.after)
        change = value(*theirs) - after
        np.testing.assert_allclose(
            value(*residuals.left_out) - after, change, atol=3e-3 * np.abs(change).max()
        )


def test_influence_is_the_largest_change_that_a_station_makes():
    data = make(5)
    result, without = fit(data), fit(data, include=1 - np.eye(data.count))
    inclination = OBSERVABLES["inclination"].value
    moved = inclination(*without.problem.fields(without.state))
    moved = np.abs(moved - inclination(*result.problem.fields(result.state))).max(-1)
    stated = Residuals(data, result).influence["inclination"][0]
    np.testing.assert_allclose(stated, moved, rtol=2e-3)


def test_a_misread_station_is_named_with_its_left_out_error_and_gets_no_weight():
    data = make(4)
    face = np.array(data.known["toolface"])
    face[20] += 2 * DEG
    data = replace(data, known={**data.known, "toolface": face})
    plain = calibrate(data, PROFILE)
    found = [f for f in plain.findings if f.id == "reshoot" and f.station == "21"]
    row = plain.station_rows[20]
    assert found
    assert "left out of the fit" in found[0].text
    assert abs(row.errors_left_out["toolface"]) > abs(row.errors["toolface"])
    robust = calibrate(data, PROFILE, Options(robust="student-t"))
    assert robust.station_rows[20].weight < 1e-3
    assert any(f.id == "distrusted" and "21" in f.text for f in robust.findings)
    assert robust.station_rows[20].reshoot
    assert robust.options.robust == "student-t"


def test_a_run_spoilt_by_one_station_is_refused_with_its_name_and_saved_by_weights():
    data = make(4)
    face = np.array(data.known["toolface"])
    face[20] += 10 * DEG
    data = replace(data, known={**data.known, "toolface": face})
    with pytest.raises(FitError, match="Station 21 alone.*`exclude` 21"):
        calibrate(data, PROFILE)
    saved = calibrate(data, PROFILE, Options(robust="student-t"))
    good = calibrate(make(4).select(np.arange(48) != 20), PROFILE)
    difference = np.subtract(saved.accelerometer.parameters, good.accelerometer.parameters)
    assert np.abs(difference / np.array(good.accelerometer.standard_uncertainties)).max() < 1


@pytest.mark.parametrize("method", ["swarm", "newton"])
def test_robust_needs_the_common_estimator(method):
    with pytest.raises(InputError, match="`robust`"):
        calibrate(make(), PROFILE, Options(method, robust="huber"))


@pytest.mark.parametrize("loss", ["huber", "student-t"])
def test_one_misread_toolface_leaves_what_is_stated_as_it_is(loss):
    """An error of 80° at one station: s, expected errors and accuracy of the run without it."""
    inc, azi, face = plan()
    tool = Tool.random(5)
    raw = [v[0] for v in tool.readings(np.random.default_rng(5), 1, inc, azi, face)]
    known = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(48, tool.field), "dip": np.full(48, tool.dip),
    }  # fmt: skip
    sd = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    sd |= {n: np.full(48, s * DEG) for n, s in zip(known, (0.01, 0.05, 0.02), strict=False)}
    misread = {**known, "toolface": face + 80 * DEG * (np.arange(48) == 17)}
    labels = tuple(map(str, range(48)))
    good, bad = (
        calibrate(
            Readings(*raw, known=k, sd=sd, station=labels), Profile(name="x"), Options(robust=loss)
        )
        for k in (known, misread)
    )
    for one, other in zip(good.triads, bad.triads, strict=True):
        assert other.variance_factor == pytest.approx(one.variance_factor, rel=0.3)
    for one, other in zip(good.errors, bad.errors, strict=True):
        assert other.expected == pytest.approx(one.expected, rel=0.05)
    for one, other in zip(
        np.diag(good.parameter_covariance), np.diag(bad.parameter_covariance), strict=True
    ):
        assert other == pytest.approx(one, rel=0.5)
