"""The temperature order and its errors at temperatures left out. All drift here is simulated."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from cli_support import mwdcal, servo_run, write_csv
from mwdcal.calibration.automatic import drift
from mwdcal.calibration.automatic.auto import choose_order, order_errors
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.record import Calibration, OrderScore
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning.plans import StationPlan, grid, run, servo
from mwdcal.sensor.profile import Profile

PROFILE = Profile(name="test tool")
NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
SOAKS = [20.0, 45.0, 70.0, 95.0, 120.0]
STATIONS = grid([5, 45, 90, 135], 6, [0, 90, 180, 270], SOAKS)


def drifting(rng, orders):
    """A servo whose scales and biases drift by 0.15 to 0.3 % of the field in each power up to an
    order, at the ends of the range."""
    truth, triads = servo(rng), []
    for params, order, unit in zip(
        (truth.accelerometer, truth.magnetometer), orders, (1.0, 48e3), strict=True
    ):
        params = params.copy()
        course = params[:24].reshape(2, 3, 4)
        course[..., 1:] = 0.0
        for power in range(1, order + 1):
            size = 0.003 * np.array([[1.0], [unit]]) / 50.0**power
            course[..., power] = size * rng.uniform(0.5, 1, (2, 3)) * rng.choice([-1, 1], (2, 3))
        triads.append(params)
    return replace(truth, accelerometer=triads[0], magnetometer=triads[1], reference=70.0)


def made(seed=0, orders=(2, 1), sd=NOISE, stand=(0.0, 0.0, 0.0), unknown=()):
    """A run, and the vectors that a perfect tool would have read at its true attitudes."""
    rng = np.random.default_rng(seed)
    truth = drifting(rng, orders)
    angles = ("inclination", "azimuth", "toolface")
    off = {
        n: getattr(STATIONS, n) + s * rng.normal(size=120)
        for n, s in zip(angles, stand, strict=True)
    }
    data = run(truth, StationPlan(**off, temperature=STATIONS.temperature), rng)
    stated = {n: getattr(STATIONS, n) for n in angles}
    known = {k: v for k, v in {**data.known, **stated}.items() if k not in unknown}
    spread = {n: np.array(s) for n, s in zip(angles, stand, strict=True)}
    data = replace(data, known=known, sd={**sd, **spread}, station=())
    return data, reference_vectors(*off.values(), truth.gravity, truth.field, truth.dip)


def quiet(text):
    pass


def against_truth(data, vectors, order, scale=(1e3, 1.0)):
    """Rms per axis of what calibrations without one soak make of it: (triad, whole and across,
    inside and ends), in the unit shown and degrees, by the record that is applied to readings."""
    squares = np.zeros((2, 2, len(SOAKS)))
    for part, temperature in enumerate(SOAKS):
        held = data.temperature == temperature
        record = calibrate(data.select(~held), PROFILE, Options(order=order))
        for triad, found in enumerate(record.fields(data.select(held))):
            true = vectors[triad][held] * (
                1 if record.field_unit == "nT" or not triad else 1 / 48e3
            )
            error = found - true
            turned = np.cross(true, error) / np.sum(true**2, -1, keepdims=True)
            squares[triad, 0, part] = np.mean(error**2) * scale[triad] ** 2
            squares[triad, 1, part] = np.mean(turned**2) * 3 / 2 * np.degrees(1) ** 2
    ends = np.array([True, False, False, False, True])
    return np.sqrt(np.stack([squares[..., ~ends].mean(-1), squares[..., ends].mean(-1)], -1))


def stated(scores):
    """The same of a table with one order: (triad, whole and across, inside and ends)."""
    return np.array(
        [
            [[s.error_inside, s.error_ends], [s.error_inside_deg, s.error_ends_deg]]
            for s in scores
        ]
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("orders", [(0, 1), (1, 2), (2, 3), (3, 0)])
def test_the_order_of_the_truth_is_chosen(orders):
    """Each triad's own, over 6 seeds of each of 4 pairs; never too low, rarely too high."""
    found = np.array(
        [choose_order(made(seed, orders)[0], Options(), quiet)[0] for seed in range(6)]
    )
    assert (found >= orders).all()
    assert (found == orders).sum() >= 11


@pytest.fixture
def undrifted(monkeypatch):
    """No drift within a run is fitted: in one run of ten noise alone looks like one, and an error changes by 3 %."""
    monkeypatch.setattr(drift, "ORDER_CHANCE", 0.0)
    monkeypatch.setattr(drift, "HIDDEN_CHANCE", 0.0)


@pytest.mark.parametrize("order", [0, 1, 3])
def test_errors_are_those_against_the_truth(undrifted, order):
    data, vectors = made(1)
    found = stated(order_errors(data, Options(order=order), quiet))
    np.testing.assert_allclose(found, against_truth(data, vectors, order), rtol=0.01)


def test_errors_without_declared_noise_are_the_same():
    data, vectors = made(2, sd={})
    scores = order_errors(data, Options(order=2), quiet)
    np.testing.assert_allclose(stated(scores), against_truth(data, vectors, 2), rtol=0.01)
    assert scores[0].noise == pytest.approx(0.1, rel=0.1)
    assert scores[1].noise == pytest.approx(15.0, rel=0.1)


def test_errors_of_a_relative_field_are_shares_of_it():
    data, vectors = made(3, unknown=("field", "dip"))
    scores = order_errors(data, Options(order=2), quiet)
    wanted = against_truth(data, vectors, 2, scale=(1e3, 1e3))
    np.testing.assert_allclose(stated(scores), wanted, rtol=0.03)
    assert [s.unit for s in scores] == ["mg", "‰ of the field"]
    assert scores[1].noise == pytest.approx(15.0 / 48, rel=0.1)


def test_errors_of_the_stand_are_not_the_tools():
    """Stand angles off by 0.01°, twice the noise: they would triple the error if they counted."""
    data, vectors = made(4, stand=(2e-4, 2e-4, 2e-4))
    found = stated(order_errors(data, Options(order=(2, 1)), quiet))
    np.testing.assert_allclose(found, against_truth(data, vectors, (2, 1)), rtol=0.15)


def test_noise_is_part_of_the_error():
    """With the true order the errors are hardly more than the noise; χ² is their ratio squared."""
    scores = order_errors(made(5, (1, 1))[0], Options(order=1), quiet)
    for score, noise in zip(scores, (0.1, 15.0), strict=True):
        assert score.noise == pytest.approx(noise, rel=0.05)
        assert score.error_inside == pytest.approx(score.noise, rel=0.15)
        assert score.error_ends == pytest.approx(score.noise, rel=0.25)
        assert score.inside == pytest.approx((score.error_inside / score.noise) ** 2, rel=0.02)
        assert score.noise_deg == pytest.approx(
            np.degrees(score.noise / (1e3 if score.unit == "mg" else 48e3)), rel=0.02
        )


def test_too_high_an_order_errs_at_the_ends():
    _, scores = choose_order(made(6, (1, 0))[0], Options(), quiet)
    tables = {n: [s for s in scores if s.triad == n] for n in ("accelerometer", "magnetometer")}
    for rows in tables.values():
        assert [row.order for row in rows] == [0, 1, 2, 3]
        assert rows[3].error_ends > 1.5 * rows[3].error_inside
        assert rows[3].error_ends > 1.5 * rows[1].error_ends
    assert tables["accelerometer"][1].chosen
    assert tables["magnetometer"][0].chosen


def test_accelerometer_alone():
    """Of a run no part of which seems to drift: calibrations look for a drift, errors of orders do not."""
    data, vectors = made(9)
    data = replace(data, magnetometer=None)
    (score,) = order_errors(data, Options(order=(2, 0)), quiet)
    assert (score.triad, score.order, score.unit) == ("accelerometer", 2, "mg")
    both = against_truth(made(9)[0], vectors, 2)
    np.testing.assert_allclose(stated([score])[0], both[0], rtol=0.01)


def test_strengths_alone_say_nothing_across_the_field():
    scores = order_errors(made(8)[0], Options(order=1, method="scalar"), quiet)
    assert scores[1].error_inside == pytest.approx(15.0, rel=0.3)
    assert scores[1].error_inside_deg is None
    assert scores[1].error_ends_deg is None


def test_a_given_order_needs_soaks_to_leave_out():
    data, _ = made(9)
    few = data.select(data.temperature < 80)
    assert [s.order for s in order_errors(few, Options(order=(1, 0)), quiet)] == [1, 0]
    assert order_errors(few, Options(order=2), quiet) == []
    assert order_errors(data.select(data.temperature < 50), Options(order=0), quiet) == []
    assert order_errors(replace(data, temperature=None), Options(), quiet) == []


def test_the_given_order_has_the_errors_of_the_table():
    data, _ = made(10)
    _, scores = choose_order(data, Options(), quiet)
    alone = order_errors(data, Options(order=1), quiet)
    for score in alone:
        (row,) = (s for s in scores if (s.triad, s.order) == (score.triad, 1))
        assert replaced(row, chosen=True, chance=None) == score


def replaced(row, **changes):
    return msgspec.structs.replace(row, **changes)


def test_the_record_keeps_the_table():
    data, _ = made(11)
    order, scores = choose_order(data, Options(), quiet)
    record = calibrate(data, PROFILE)
    assert msgspec.json.decode(msgspec.json.encode(record), type=Calibration) == record
    assert [s.order for s in calibrate(data, PROFILE, Options(order=order)).orders] == [*order]
    for kept, score in zip(record.orders, scores, strict=True):
        assert isinstance(kept, OrderScore)
        assert kept.error_ends == float(f"{score.error_ends:.11e}")


@pytest.mark.parametrize("order", ["auto", "0", "1"])
def test_command_writes_prints_and_reports_it(tmp_path, order):
    source = write_csv(
        tmp_path / "run.csv", servo_run(toolfaces=6, temperatures=(20.0, 60.0, 90.0))
    )
    target = tmp_path / "cal.json"
    options = (source, "--tool", "servo", "--order", order, "-o", target)
    told = mwdcal("calibrate", *options, "--json").json["orders"]
    record = msgspec.json.decode(target.read_bytes(), type=Calibration)
    assert msgspec.to_builtins(record.orders) == told
    assert {s["order"] for s in told} == ({0, 1, 2} if order == "auto" else {int(order)})
    printed = mwdcal("calibrate", *options).out
    assert "interpolation" in printed
    assert f"{told[0]['error_ends']:.3g} mg" in printed
    assert ("chosen" in printed) == (order == "auto")
