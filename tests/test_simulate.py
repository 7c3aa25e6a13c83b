"""Simulated runs: each effect against its own physics, and what a calibration makes of them against the truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_changes

import mwdcal
from cli_support import mwdcal as command
from cli_support import refused
from mwdcal.calibration import results
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.files.profiles import built_in, load_profile
from mwdcal.planning.plans import (
    EarthEffects,
    Effects,
    SensorEffects,
    StandEffects,
    TemperatureEffects,
    drawn,
    load_effects,
    load_plan,
    simulated,
)
from mwdcal.planning.session import Session, tool_facts
from mwdcal.sensor.models import factor_parts
from mwdcal.sensor.profile import StandProfile
from simulation import DEG, attitude

SERVO = load_profile("servo")[0]
EXACT = with_changes(SERVO, stand=StandProfile())
DIP = 63 * DEG
NAMES = ("inclination", "azimuth", "toolface")


def stations(inclination, azimuth, toolface, temperature=25.0, **sd):
    """What is wanted of a session, angles in degrees, without any error unless `sd` states one."""
    angles = np.broadcast_arrays(*(np.radians(a) for a in (inclination, azimuth, toolface)))
    count = len(angles[0])
    earth = {"gravity": 1.0, "field": 48_000.0, "dip": DIP}
    known = dict(zip(NAMES, angles, strict=True))
    known |= {name: np.full(count, value) for name, value in earth.items()}
    blank = np.zeros((count, 3))
    exact = {"accelerometer": blank, "magnetometer": blank}
    warmth = np.broadcast_to(np.asarray(temperature, float), (count,))
    return Readings(blank, blank, warmth, known, exact | sd)


def tools(count, seed=0, order=0):
    return drawn(np.random.default_rng(seed), SERVO, order, (count,))


def nominal(count):
    """Tools that read the fields as they are."""
    factors = np.zeros((count, 12))
    factors[:, :3] = 1.0
    return replace(tools(count), accelerometer=factors, magnetometer=factors)


def forward(factors, field):
    """Readings of order-0 factors: SF ((I - m)⁻¹ field + B), tool by tool."""
    read = []
    for one in factors:
        scale, bias, turns = one[:3], one[3:6], np.zeros((3, 3))
        turns[~np.eye(3, dtype=bool)] = one[6:]
        read.append(scale * (field @ np.linalg.inv(np.eye(3) - turns).T + bias))
    return np.stack(read)


def angles_of(g):
    """Inclination and toolface by their definition."""
    return np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2]), np.arctan2(-g[..., 0], -g[..., 1])


# --------------------------------------------------------------------------------------- tools


def test_tools_are_drawn_within_the_tolerances():
    """Uniform distributions: the standard deviation is the tolerance, the limit √3 of it."""
    many = tools(20_000, order=3)
    sheet = SERVO.accelerometer.datasheet
    wanted = {
        "accelerometer": (sheet.scale, sheet.bias, np.radians(sheet.misalignment_deg), sheet.scale_per_c,
                          sheet.bias_per_c),
        "magnetometer": np.array([0.02, 500.0, 4e-3, 100e-6, 2.0]) / np.sqrt(3),
    }  # fmt: skip
    for name, (scale_sd, bias_sd, turn_sd, scale_drift, bias_drift) in wanted.items():
        scale, bias, turns = factor_parts(getattr(many, name))
        turns = turns[:, ~np.eye(3, dtype=bool)]
        each = (
            (scale[..., 0] - 1, scale_sd), (bias[..., 0], bias_sd), (turns, turn_sd),
            (scale[..., 1], scale_drift), (bias[..., 1], bias_drift),
        )  # fmt: skip
        for values, sd in each:
            assert np.abs(values).max() <= np.sqrt(3) * sd * (1 + 1e-12)
            np.testing.assert_allclose(values.std(0), sd, rtol=0.02)  # 4.5 σ of 20,000
            assert np.abs(values.mean(0)).max() < 5 * sd / np.sqrt(20_000)


def test_a_tolerance_that_the_datasheet_leaves_out_is_that_of_moosavis_table():
    sheet = with_changes(SERVO.accelerometer.datasheet, bias=None)
    profile = with_changes(SERVO, accelerometer=with_changes(SERVO.accelerometer, datasheet=sheet))
    _, bias, _ = factor_parts(drawn(np.random.default_rng(1), profile, 0, (5000,)).accelerometer)
    assert 0.0099 < np.abs(bias).max() <= 0.010 * (1 + 1e-12)


def test_the_same_tool_at_every_order():
    parts = (factor_parts(tools(3, order=order).accelerometer) for order in (0, 2))
    for low, high in zip(*parts, strict=True):
        np.testing.assert_array_equal(low, high[..., : low.shape[-1]])


def test_readings_are_those_of_the_factors():
    session = stations([10, 60, 110, 170], [0, 100, 200, 300], [5, 95, 185, 275])
    many = tools(4)
    got = simulated(many, session, np.random.default_rng(0)).readings
    fields = attitude(*(session.known[name] for name in NAMES))(1.0, 48_000.0, DIP)
    for name, field in zip(("accelerometer", "magnetometer"), fields, strict=True):
        wanted = forward(getattr(many, name), field)
        np.testing.assert_allclose(
            getattr(got, name), wanted, rtol=0, atol=1e-12 * np.abs(wanted).max()
        )


CURVED = with_changes(
    EXACT,
    accelerometer=with_changes(EXACT.accelerometer, nonlinearity=0.002, axes=("-x", "+z", "+y")),
)


def test_a_declared_nonlinearity_bends_each_axis():
    seen = stations([90, 90], 0, [90, 270])  # gravity along -x and +x of the tool
    tool = replace(nominal(1), curves=(np.array([[[3e-3, 4e-3], [0, 0], [0, 0]]]), None))
    read = simulated(tool, seen, np.random.default_rng(0)).readings
    expected = [-1 + 3e-3 - 4e-3, 1 + 3e-3 + 4e-3]
    np.testing.assert_allclose(np.sort(read.accelerometer[0, :, 0]), expected, atol=1e-15)
    straight = simulated(nominal(1), seen, np.random.default_rng(0)).readings
    np.testing.assert_array_equal(read.magnetometer, straight.magnetometer)


def test_own_axis_terms_are_drawn_as_large_as_their_prior_takes_them():
    """A fit with the declared terms leaves the noise alone; one without does not."""
    session, rng = Session.of(load_plan("acceptance-104"), CURVED), np.random.default_rng(5)
    truth = drawn(rng, CURVED, 0, (40,))
    assert np.std(truth.curves[0]) == pytest.approx(0.002, rel=0.15)
    assert truth.curves[1] is None
    readings = session.measured(truth, rng).readings
    with_terms, without = (
        fit(readings, Options(order=0, nonlinearity=terms)).analysis.variance_factor[:, 0]
        for terms in ({"accelerometer": 0.002}, {})
    )
    assert with_terms.mean() == pytest.approx(1, abs=0.05)
    assert without.mean() > 5


def test_the_truth_file_has_the_nonlinearity_of_the_channels(tmp_path):
    profile = tmp_path / "curved.toml"
    triads = "[accelerometer]\nscale = 3.0\nnoise = 3e-4\nnonlinearity = 0.002\n[magnetometer]\nnoise = 15.0\n"
    profile.write_text(f"name = 'curved'\n{triads}", encoding="utf-8")
    truth = tmp_path / "truth.json"
    command("simulate", "--tool", profile, "-o", tmp_path / "run.csv", "--truth", truth)
    document = json.loads(truth.read_text(encoding="utf-8"))
    assert np.shape(document["accelerometer"]["nonlinearity"]) == (3, 2)
    assert "nonlinearity" not in document["magnetometer"]


def test_a_channel_against_its_axis_has_the_square_of_the_other_sign():
    """What a channel reads, from the curve stated for it, is what the tool's axis gives it."""
    tool = replace(drawn(np.random.default_rng(1), CURVED, 0), magnetometer=None)
    curve = np.array(tool_facts(tool, CURVED)["accelerometer"]["nonlinearity"])
    straight = replace(tool, curves=())
    vectors, warm = (np.random.default_rng(2).normal(size=(5, 3)),) * 2, np.full(5, 25.0)
    bent, plain = (
        each.readings(vectors, warm)["accelerometer"] @ CURVED.accelerometer.permutation
        for each in (tool, straight)
    )
    np.testing.assert_allclose(
        bent, plain + curve[:, 0] * plain**2 + curve[:, 1] * plain**3, atol=1e-12
    )


def test_ten_thousand_tools_in_one_call():
    session = stations(*np.radians(np.ones((3, 6))))
    assert simulated(
        tools(10_000), session, np.random.default_rng(0)
    ).readings.accelerometer.shape == (10_000, 6, 3)


# -------------------------------------------------------------------------------------- effects


def with_effects(session, seed=0, count=1, minutes=None, **effects):
    """The session of nominal tools with some effects."""
    rng = np.random.default_rng(seed)
    times = None if minutes is None else np.asarray(minutes, float)
    return simulated(nominal(count), session, rng, Effects(**effects), minutes=times)


def test_backlash_lags_behind_the_direction_of_approach():
    session = stations([0, 30, 60, 45, 45, 50], [350, 10, 0, 300, 340, 20], [0, 0, 0, 10, 5, 355])
    play = StandEffects(
        backlash_inclination_deg=0.2, backlash_azimuth_deg=0.4, backlash_toolface_deg=0.6
    )
    got = with_effects(session, stand=play).angles
    lag = {
        "inclination": 0.1 * np.array([1, 1, 1, -1, -1, 1]),
        "azimuth": 0.2 * np.array([1, 1, -1, -1, 1, 1]),  # 350 to 10 goes up, 0 to 300 down
        "toolface": 0.3 * np.array([1, 1, 1, 1, -1, -1]),
    }
    for name in NAMES:
        np.testing.assert_allclose(
            np.degrees(session.known[name] - got[name][0]), lag[name], atol=1e-12
        )


def test_zeros_of_the_stand():
    """Reading = value in the earth's frame + zero, at every station alike; the spread as stated."""
    zeros = StandEffects(inclination_zero_deg=0.1, azimuth_zero_deg=0.2, toolface_zero_deg=0.3)
    session = stations([40, 80], [10, 20], [30, 40], **{"azimuth-zero": np.full(2, 0.4 * DEG)})
    got = with_effects(session, count=4000, stand=zeros).angles
    for name, sd in zip(NAMES, (0.1, np.hypot(0.2, 0.4), 0.3), strict=True):
        zero = np.degrees(session.known[name] - got[name])
        np.testing.assert_allclose(zero[:, 0], zero[:, 1], atol=1e-9)
        assert zero[:, 0].std() == pytest.approx(sd, rel=0.06)


def test_a_tilt_turns_the_frame_of_the_stand():
    """A reading of inclination at azimuth A is too large by tilt · cos(A - towards)."""
    session = stations(60.0, np.arange(0, 360, 30.0), 20.0)
    tilt, towards = 1e-5, 0.7
    turn = {"stand-north": -tilt * np.sin(towards), "stand-east": tilt * np.cos(towards)}
    lean = {name: np.array([value]) for name, value in turn.items()}
    result = simulated(nominal(1), session, np.random.default_rng(0), common=lean).readings
    inclination, _ = angles_of(result.accelerometer[0])
    wanted = tilt * np.cos(session.known["azimuth"] - towards)
    np.testing.assert_allclose(60 * DEG - inclination, wanted, atol=1e-9)
    # it is one turn of gravity and field together: their angle stays
    dip = np.einsum("ni,ni->n", result.accelerometer[0], result.magnetometer[0]) / 48_000
    np.testing.assert_allclose(dip, np.sin(DIP), atol=1e-12)


def test_a_tilt_has_the_size_that_is_declared():
    lean = StandEffects(tilt_deg=0.1)
    got = with_effects(stations([90.0] * 2, [0.0, 90.0], 0.0), count=4000, stand=lean).readings
    off = 90 - np.degrees(angles_of(got.accelerometer)[0])
    assert np.sqrt((off**2).sum(-1).mean()) == pytest.approx(0.1, rel=0.05)


def test_a_turn_on_bias_stays_for_the_session():
    session = stations([10, 50, 90], [0, 120, 240], [0, 90, 180])
    sensor = SensorEffects(turn_on=2e-3)
    clean = with_effects(session).readings.accelerometer[0]
    result = with_effects(session, count=5000, accelerometer=sensor)
    bias = result.readings.accelerometer - clean
    np.testing.assert_allclose(bias, np.broadcast_to(bias[:, :1], bias.shape), atol=1e-15)
    np.testing.assert_allclose(bias[:, 0], result.turn_on["accelerometer"], atol=1e-15)
    assert bias.std() == pytest.approx(2e-3, rel=0.03)
    np.testing.assert_array_equal(
        result.readings.magnetometer[0], with_effects(session).readings.magnetometer[0]
    )


def test_a_wandering_bias_forgets_with_its_time_constant():
    session = stations(45.0, 0.0, np.zeros(4))
    minutes = [10.0, 25.0, 70.0, 400.0]
    sensor = SensorEffects(instability=30.0, instability_minutes=60.0)
    result = with_effects(session, count=8000, minutes=minutes, magnetometer=sensor)
    bias = (result.readings.magnetometer - with_effects(session).readings.magnetometer)[..., 0]
    times = np.array(minutes)
    wanted = 900 * np.exp(-np.abs(times[:, None] - times) / 60.0)
    np.testing.assert_allclose(np.cov(bias.T), wanted, atol=900 * 5 * np.sqrt(2 / 8000))


def test_the_converter_rounds_and_cuts():
    session = stations([0, 45, 90, 180], 0.0, 0.0)
    sensor = SensorEffects(resolution=0.01, saturation=0.9)
    got = with_effects(session, accelerometer=sensor).readings.accelerometer[0]
    clean = attitude(*(session.known[name] for name in NAMES))(1.0, 48_000.0, DIP)[0]
    np.testing.assert_allclose(got * 100, np.round(got * 100), atol=1e-9)
    assert np.abs(got - np.clip(clean, -0.9, 0.9)).max() <= 0.005 + 1e-12
    assert got[0, 2] == pytest.approx(0.9)


def test_sensors_and_thermometer_follow_the_oven_each_with_its_lag():
    """The response to a step is 1 - exp(-t/τ), from the moment when the oven is set to a temperature.

    A station is measured at the end of its own interval: the oven is set when the one before has been read.
    """
    session = stations(45.0, 0.0, np.zeros(5), temperature=[60, 60, 60, 100, 100])
    minutes = np.array([30.0, 35.0, 50.0, 80.0, 81.0])
    lag = TemperatureEffects(sensor_minutes=20.0, thermometer_minutes=5.0, drift_c_per_hour=1.2)
    result = with_effects(session, minutes=minutes, temperature=lag)
    drift = 0.02 * (minutes - 30)
    for got, constant in ((result.temperature, 20.0), (result.readings.temperature, 5.0)):
        first = 60 + (25 - 60) * np.exp(-minutes[:3] / constant)
        second = 100 + (first[-1] - 100) * np.exp(-(minutes[3:] - 50) / constant)
        np.testing.assert_allclose(got - drift, np.concatenate([first, second]), atol=1e-12)


def test_the_field_of_the_earth_wanders_and_gravity_does_not():
    session = stations([30, 30, 120], [0, 80, 200], [10, 20, 130])
    earth = EarthEffects(variation_nt=20.0, variation_minutes=60.0)
    result = with_effects(session, count=5000, minutes=[1.0, 2.0, 900.0], earth=earth).readings
    clean = with_effects(session).readings
    np.testing.assert_array_equal(result.accelerometer[0], clean.accelerometer[0])
    change = result.magnetometer - clean.magnetometer
    np.testing.assert_allclose(change.std(0), 20.0, rtol=0.05)
    # in the earth's frame the first two stations, a minute apart, see nearly the same change
    axes = [np.stack([attitude(*(a[k : k + 1] for a in (session.known[n] for n in NAMES)))(1.0, 1.0, d)[1][0]
                      for d in (0.0, np.pi / 2)]) for k in range(3)]  # fmt: skip
    north, down = (np.stack([change[:, k] @ axes[k][i] for k in range(3)]) for i in (0, 1))
    for component in (north, down):
        together = np.corrcoef(component)
        assert together[0, 1] == pytest.approx(np.exp(-1 / 60), abs=0.005)
        assert abs(together[0, 2]) < 0.08


def test_references_for_gravity_field_and_dip_are_off_as_stated():
    sd = {"gravity": np.full(2, 1e-3), "field": np.full(2, 50.0), "dip": np.full(2, 1e-3)}
    result = with_effects(stations([30, 70], [0, 90], [0, 90], **sd), count=4000).readings
    g, b = result.accelerometer, result.magnetometer
    strength, field = np.linalg.norm(g, axis=-1), np.linalg.norm(b, axis=-1)
    dip = np.arcsin(np.einsum("bni,bni->bn", g, b) / strength / field)
    for values, mean, spread in ((strength, 1.0, 1e-3), (field, 48_000.0, 50.0), (dip, DIP, 1e-3)):
        np.testing.assert_allclose(values[:, 0], values[:, 1], rtol=1e-9)
        assert values[:, 0].std() == pytest.approx(spread, rel=0.06)
        assert values[:, 0].mean() == pytest.approx(mean, abs=5 * spread / np.sqrt(4000))


def test_noise_and_settings_have_the_size_that_the_profile_states():
    session = Session.of(load_plan("six-state"), SERVO)
    many = replace(nominal(3000), reference=30.0)
    result = session.measured(many, np.random.default_rng(3))
    for name, sd in zip(NAMES, (0.01, 0.05, 0.02), strict=True):
        off = np.degrees(result.angles[name] - session.readings.known[name])
        np.testing.assert_allclose(off.std(0), sd, rtol=0.07)
    exact = Session.of(load_plan("six-state"), EXACT).measured(many, np.random.default_rng(3))
    for name, sd in (("accelerometer", 1e-4), ("magnetometer", 15.0)):
        np.testing.assert_allclose(getattr(exact.readings, name).std(0), sd, rtol=0.07)


def test_times_of_stations_are_moves_and_soaks():
    """90 minutes for each soak but the first at room temperature; 30 s to settle, 5 °/s."""
    table = load_plan("six-state")
    session = Session.of(table, EXACT)
    angles = [np.asarray(table.columns[f"ref_{name}_deg"]) for name in NAMES]
    turns = np.stack([np.abs(np.diff(a)) for a in angles])
    turns[1:] = np.minimum(turns[1:], 360 - turns[1:])
    np.testing.assert_allclose(np.diff(session.minutes), (turns.max(0) / 5 + 30) / 60)
    assert session.minutes[0] == pytest.approx(0.5)
    warm = Session.of(load_plan("laboratory-thermal"), EXACT).minutes
    assert warm[0] == pytest.approx(90.5)
    assert np.count_nonzero(np.diff(warm) > 90) == 3


# ----------------------------------------------------------------------- against a calibration


def affine(factors):
    """Twelve parameters of field = A raw + c, by NumPy alone."""
    scale, bias, turns = factors[..., :3], factors[..., 3:6], np.zeros((len(factors), 3, 3))
    turns[:, ~np.eye(3, dtype=bool)] = factors[..., 6:]
    matrix = (np.eye(3) - turns) / scale[:, None]
    offset = -np.einsum("bij,bj->bi", np.eye(3) - turns, bias)
    return np.concatenate([matrix.reshape(-1, 9), offset], -1)


@pytest.mark.parametrize(("profile", "count"), [(EXACT, 400), (SERVO, 80)])
def test_a_calibration_recovers_the_truth_within_its_uncertainty(profile, count):
    """χ² of 24 parameters over many tools, with the covariance from the declared noise alone."""
    session = Session.of(load_plan("moosavi-12"), profile)
    many = tools(count, seed=8)
    result = fit(session.measured(many, np.random.default_rng(9)).readings, Options(order=0))
    turn = results.to_file(result, 30.0)
    estimate = np.einsum("bkp,bp->bk", turn, result.state.params)
    off = estimate - np.concatenate([affine(many.accelerometer), affine(many.magnetometer)], -1)
    covariance = turn @ result.analysis.covariance @ turn.mT
    square = np.einsum("bk,bk->b", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    assert square.mean() == pytest.approx(24, abs=4 * np.sqrt(48 / count))


def simulate(folder, name, *options, plan="moosavi-12", seed=1):
    """The files of a simulated run."""
    run, truth = folder / f"{name}.csv", folder / f"{name}.json"
    ran = command("simulate", "--plan", plan, "--seed", seed, "-o", run, "--truth", truth, *options)
    assert ran.code == 0, ran
    return ran, run, truth


def test_a_run_without_noise_gives_back_the_truth(tmp_path):
    """In the notation of the truth file, by calibrate and convert; warm, at order 2."""
    tool = tmp_path / "tool.toml"
    tool.write_text(
        'name = "quiet"\n[accelerometer]\naxes = ["-y", "+x", "+z"]\nscale = 3.0\nnoise = 1e-11\n'
        '[magnetometer]\naxes = ["+x", "-z", "+y"]\nscale = 5e-5\nnoise = 1e-12\n'
    )
    _, run, truth = simulate(tmp_path, "run", "--tool", tool, plan="moosavi-30")
    calibration = tmp_path / "cal.json"
    ran = command(
        "calibrate", run, "--tool", tool, "-o", calibration, "--order", 3, "--model", "factors"
    )
    assert ran.code == 0, ran
    got = command("convert", calibration, "--notation", "factors", "--json").json
    wanted = json.loads(truth.read_text())
    assert (wanted["order"], wanted["notation"]) == (3, "factors")
    for triad in ("accelerometer", "magnetometer"):
        for name, value in wanted[triad].items():
            size = np.abs(np.array(value)).max(0)
            error = np.abs(np.array(got[triad][name]) - value).max(0)
            assert (error <= 1e-6 * size + 1e-12).all(), (triad, name, error / size)


def test_the_same_seed_gives_the_same_files(tmp_path):
    first, second = (simulate(tmp_path, name) for name in ("a", "b"))
    other = simulate(tmp_path, "c", seed=2)
    assert first[1].read_bytes() == second[1].read_bytes() != other[1].read_bytes()
    truths = [json.loads(each[2].read_text()) for each in (first, second)]
    for truth in truths:
        del truth["output"], truth["truth"]
    assert truths[0] == truths[1]


def test_simulated_runs_are_labelled(tmp_path):
    ran, run, truth = simulate(tmp_path, "run")
    assert "SIMULATED DATA" in ran.out
    assert "# simulated = true" in run.read_text().splitlines()
    written = json.loads(truth.read_text())
    assert written["simulated"] is True
    assert (written["serial"], written["seed"]) == ("SIM-1", 1)
    assert mwdcal.read_run(run, "servo").metadata["simulated"] is True
    printed = command("simulate", "-o", tmp_path / "other.csv", "--json").json
    assert printed["simulated"] is True


def test_the_truth_file_says_where_the_stations_were(tmp_path):
    """The stated errors of the stand explain the difference of angle and reference."""
    effects = tmp_path / "effects.toml"
    effects.write_text("[stand]\nazimuth_zero_deg = 1.0\n[magnetometer]\nturn_on = 20.0\n")
    tool = tmp_path / "tool.toml"
    tool.write_text(
        'name = "t"\n[accelerometer]\nscale = 1.0\nnoise = 1e-6\n[magnetometer]\nscale = 1.0\nnoise = 1.0\n'
    )
    _, run, truth = simulate(tmp_path, "run", "--tool", tool, "--effects", effects)
    written = json.loads(truth.read_text())
    zero = written["stand"]["azimuth_zero_deg"]
    stated = mwdcal.read_run(run, tool).known["azimuth"]
    exact = [station["azimuth_deg"] for station in written["stations"]]
    np.testing.assert_allclose(np.degrees(stated) - exact, zero, atol=1e-9)
    assert len(written["turn_on"]["magnetometer"]) == 3
    assert written["effects"]["stand"]["azimuth_zero_deg"] == 1.0
    assert len(written["effects_sha256"]) == 64


def test_the_tool_of_a_calibration(tmp_path):
    """Its readings, corrected by itself, are at the references; a roll test of it passes."""
    _, run, _ = simulate(tmp_path, "run")
    calibration, roll = tmp_path / "cal.json", tmp_path / "roll.csv"
    assert command("calibrate", run, "--tool", "servo", "-o", calibration).code == 0
    ran = command("simulate", "--plan", "roll-test", "--calibration", calibration, "-o", roll)
    assert ran.code == 0, ran
    assert command("verify", calibration, roll).code == 0


def lasting(temperature):
    """Without noise, a tool whose accelerometer's z axis drifts by 100 µg/√3 for each degree from 30 °C."""
    factors = np.zeros((2, 30))
    factors[:, 0:12:4] = 1.0
    factors[0, 21] = 100e-6 / np.sqrt(3)
    steps = {"inclination_deg": (10, 50, 90, 130), "toolfaces": 6, "tool": tuple(factors)}
    return mwdcal.simulate(**steps, temperature=(temperature,), noise=(1e-9, 1e-4))


@pytest.mark.parametrize("apart", [0.9, 2.0, 4.9])
def test_the_drift_with_temperature_that_1σ_lacks_is_as_large_as_apply_says(apart):
    """The true error at 90° is the bias itself; below 1 °C it is not named."""
    result = mwdcal.apply(mwdcal.calibrate(lasting(25.0)), lasting(25.0 + apart))
    level = np.isclose(result.columns["inclination_deg"], 90, atol=0.1)
    error = np.abs(result.columns["inclination_deg"][level] - 90)
    assert error.max() > 100 * result.columns["sd_inclination_deg"][level].max()
    told = [f.text for f in result.findings if f.id == "outside-temperature"]
    assert bool(told) is (apart > 1)
    assert all(f"about {error.max():.4f}° of inclination" in text for text in told)


def place_of_tool(known):
    """A calibration at 47 µT, 0.998 g and a dip of -70°, of which the run states what is `known`."""
    place = {"field_nt": 47_000.0, "gravity_g": 0.998, "dip_deg": -70.0}
    columns = mwdcal.plan("servo").columns
    true = {f"ref_{name}": np.full(24, value) for name, value in place.items()}
    run = mwdcal.simulate({**columns, **true}, seed=3)
    hidden = {"field": "field_nt", "gravity": "gravity_g", "dip": "dip_deg"}.keys() - {*known}
    return mwdcal.calibrate(
        replace(run, known={n: v for n, v in run.known.items() if n not in hidden})
    )


@pytest.mark.parametrize("way", ["tool", "calibration"])
def test_a_simulated_run_is_at_the_place_of_the_calibration_unless_the_plan_states_one(way):
    """The dip, which no station states, is the one that the run estimated."""
    made = place_of_tool(["field", "gravity"])
    earth = mwdcal.simulate("twenty-four-state", **{way: made}).truth["earth"]
    assert earth["dip_deg"] == pytest.approx(-70, abs=0.1)
    assert (earth["gravity_g"], earth["field_nt"]) == pytest.approx((0.998, 47_000.0))
    stated = {**mwdcal.plan("servo").columns, "ref_dip_deg": np.full(24, 20.0)}
    earth = mwdcal.simulate(stated, **{way: made}).truth["earth"]
    assert tuple(earth.values()) == pytest.approx((0.998, 47_000.0, 20.0))


def test_the_roll_test_of_a_repetition_is_at_the_place_of_its_plan():
    """It has that of the calibration, or else what the plan states; a blank column states nothing."""
    made = place_of_tool(["field", "gravity", "dip"])
    roll = load_plan("roll-test").columns
    blank = {**roll, "ref_dip_deg": np.full(12, np.nan)}
    for dip, plan in ((-70.0, "twenty-four-state"), (20.0, None)):
        stated = plan or {**mwdcal.plan("servo").columns, "ref_dip_deg": np.full(24, dip)}
        for rolltest in ("roll-test", blank):
            many = mwdcal.simulate(stated, calibration=made, repeat=1, rolltest=rolltest)
            for session in (many.procedure.calibrating, many.procedure.testing):
                np.testing.assert_allclose(np.degrees(session.readings.known["dip"]), dip)
                np.testing.assert_allclose(session.readings.known["field"], 47_000.0)


@pytest.mark.parametrize(
    "line", [("plan", "--tool"), ("simulate", "--tool"), ("simulate", "--calibration")]
)
def test_a_calibration_without_nanotesla_says_what_a_plan_needs(tmp_path, line):
    made = place_of_tool(["dip", "gravity"])
    mwdcal.save(made, path := tmp_path / "relative.json")
    message = refused(command(*line, path, "-o", tmp_path / "out.csv"), 2)
    assert "calibrated to field = 1, and plans and simulations need nT" in message
    assert (
        "Add ref_field_nt to the run and calibrate again, or name a tool profile by --tool."
        in message
    )


def test_the_tool_of_a_warm_calibration_is_written_as_convert_writes_it(tmp_path):
    """One that is linear in its parameters over temperature has no factors."""
    _, run, _ = simulate(tmp_path, "run", plan="moosavi-30")
    calibration = tmp_path / "cal.json"
    fit_options = ("--order", 2, "--model", "polynomial", "-o", calibration)
    assert command("calibrate", run, "--tool", "servo", *fit_options).code == 0
    truth = tmp_path / "again.json"
    ran = command(
        "simulate", "--calibration", calibration, "-o", tmp_path / "r.csv", "--truth", truth
    )
    assert ran.code == 0, ran
    written = json.loads(truth.read_text())
    assert written["notation"] == "affine"
    line = ("convert", calibration, "--notation", "affine", "--temperature", "course", "--json")
    wanted = command(*line).json
    for triad in ("accelerometer", "magnetometer"):
        np.testing.assert_allclose(written[triad]["M"], wanted[triad]["M"], rtol=1e-9)
        np.testing.assert_allclose(written[triad]["b"], wanted[triad]["b"], rtol=1e-9)


def test_plans_give_a_truth_of_the_order_that_their_soaks_carry(tmp_path):
    for plan, order in (("six-state", 0), ("laboratory-thermal", 2), ("moosavi-30", 3)):
        _, _, truth = simulate(tmp_path, plan, plan=plan)
        written = json.loads(truth.read_text())
        assert written["order"] == order
        assert np.shape(written["accelerometer"]["SF"]) == (3, order + 1)


@pytest.mark.parametrize("extra", ["", ",temperature_c", ",ref_gravity_g,ref_field_nt,ref_dip_deg"])
def test_a_plan_without_temperatures_or_place_is_carried_out(tmp_path, extra):
    plan, run = tmp_path / "plan.csv", tmp_path / "run.csv"
    blank = "," * extra.count(",")
    rows = [f"{i},{a},{t}{blank}" for i, a, t in ((0, 0, 0), (90, 40, 30), (120, 80, 200))]
    plan.write_text(
        "\n".join([f"ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg{extra}", *rows])
    )
    document = command("simulate", "--plan", plan, "-o", run, "--json").json
    assert document["earth"] == {"gravity_g": 1.0, "field_nt": 48_000.0, "dip_deg": 63.0}
    assert document["order"] == 0
    assert mwdcal.read_run(run).count == 3


def test_built_in_effects_are_none():
    assert built_in("effects") == ["none"]
    assert load_effects("none")[0] == Effects()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--plan", "seven-state"), "plan must be a built-in name"),
        (("--tool", "generic"), "does not state the noise of the accelerometer"),
        (("--effects", "nothing"), "file of effects must be a built-in name"),
        (("--effects", "[stand]\nbacklash_deg = 1\n"), "unknown field `backlash_deg`"),
        (("--effects", "[magnetometer]\nturn_on = -3\n"), "key 'magnetometer.turn_on': must be at least 0"),
        (("--effects", "[earth]\nvariation_minutes = 0\n"), "must be above 0"),
        (("--effects", "[accelerometer]\nsaturation = nan\n"), "must be above 0"),
        (("--calibration", "cal.json", "--tool", "servo"), "brings its own profile and order"),
        (("--calibration", "cal.json"), "cannot be read"),
    ],
)  # fmt: skip
def test_bad_input_ends_in_a_sentence(tmp_path, options, word):
    name, value, *rest = options
    if "\n" in value:
        (tmp_path / "effects.toml").write_text(value)
        value = tmp_path / "effects.toml"
    ran = command(
        "simulate", name, value, *rest, "-o", tmp_path / "run.csv", "--truth", tmp_path / "t.json"
    )
    message = refused(ran, 2).replace("got None", "")
    assert word in message
    assert not [p for p in tmp_path.iterdir() if p.suffix in (".csv", ".json")]


def test_an_output_of_a_strange_kind_is_refused(tmp_path):
    ran = command("simulate", "-o", tmp_path / "run.doc", "--truth", tmp_path / "t.json")
    assert "the suffix of a table must be one of" in refused(ran, 2)
    assert not list(tmp_path.iterdir())
