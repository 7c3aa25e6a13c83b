"""Faults: their physics against finite differences, the evidence against a dense normal density, names and rates."""

from dataclasses import replace
from functools import cache
from importlib import resources

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal

import mwdcal
from cli_support import SERVO_NOISE, read_csv, refused, servo_run, write_csv
from cli_support import mwdcal as command
from mwdcal.calibration.options import Options
from mwdcal.calibration.results import raw_reading
from mwdcal.faults import likelihood
from mwdcal.faults.diagnosis import diagnose
from mwdcal.faults.likelihood import (
    DEPARTURES,
    FAULTS,
    NONE,
    SIZE,
    Damage,
    FaultEvidence,
    Suspect,
    explained,
    padded,
    raw_of,
    repeated,
)
from mwdcal.geometry.vectors import reference_vectors, tool_from_earth
from mwdcal.planning import plans
from mwdcal.planning.plans import Effects, FaultEffect, load_effects
from mwdcal.presentation.diagnosis import is_fine, screen
from mwdcal.sensor.profile import Datasheet, Profile, TriadProfile
from simulation import DEG, Tool

PLAN = plans.grid([5, 45, 90, 135], 6, [0, 90, 180, 270], [20.0, 90.0])
ROLL = plans.grid([5, 45, 90], 4, [0, 120, 240], [90.0])
SOAKS = plans.grid([5, 45, 90], 4, [0, 120, 240], [30.0, 90.0])


def noise(count):
    return {
        "accelerometer": np.full((count, 3), 1e-4),
        "magnetometer": np.full((count, 3), 15.0),
    }


NOISE = noise(ROLL.count)
ANGLES = ROLL.inclination, ROLL.azimuth, ROLL.toolface
DIP = np.radians(63.0)


@cache
def tool(number):
    """A tool and its calibration, of a run of its own with the noise declared."""
    rng = np.random.default_rng([77, number])
    tolerances = TriadProfile(datasheet=Datasheet())
    truth = plans.drawn(rng, Profile(name="servo", magnetometer=tolerances), order=1)
    run = plans.run(truth, PLAN, rng)
    sd = {name: np.resize(value[0], (PLAN.count, 3)) for name, value in NOISE.items()}
    return mwdcal.calibrate(
        replace(run, sd=sd), options=Options(order=1, nonlinearity="none")
    ), truth


def later(number, seed=0, known=None, plan=ROLL, **fault):
    """A roll test of a tool that may be at fault."""
    _, truth = tool(number)
    references = {name: getattr(plan, name) for name in ("inclination", "azimuth", "toolface")}
    references |= {"gravity": np.ones(plan.count), "field": np.full(plan.count, truth.field)}
    references |= {"dip": np.full(plan.count, truth.dip)}
    blank = np.zeros((plan.count, 3))
    session = mwdcal.Readings(blank, blank, plan.temperature, references, noise(plan.count))
    rng, effects = np.random.default_rng([78, number, seed]), Effects(fault=FaultEffect(**fault))
    result = plans.simulated(truth, session, rng, effects)
    kept = references if known is None else {name: references[name] for name in known}
    return replace(result.readings, known=kept), result.damage


def test_every_kind_of_fault_has_the_size_of_its_own_forms():
    """Also those that are far behind the best one: a rival's size was that of another fault, or of none."""
    calibration, _ = tool(0)
    readings, _ = later(0, kind="magnetised", size=40.0)
    forms = likelihood.hypotheses(likelihood.faults(calibration.profile))
    evidence = FaultEvidence.of(Suspect.of(calibration, readings), forms)
    for kind in {form.kind for form in forms}:
        form, sizes, _ = evidence.sizes(kind)
        assert form.kind == kind
        assert np.isfinite(sizes).all()


# Physics


def read(departures, raw, vectors, attitude, temperature, gain=1.0):
    """Readings of a tool with departures, whose channels have gains (6,) in their fields and no cross terms."""
    damage = Damage(departures, np.zeros(6, bool), np.zeros(6))
    field = likelihood.changed_field(damage, vectors[:, 3:], attitude)
    whole = np.concatenate([vectors[:, :3], field], -1)
    return likelihood.changed_readings(
        damage, raw + gain * (whole - vectors), whole, temperature, 30.0, gain
    )


def test_columns_are_derivatives_of_the_physics():
    vectors = np.concatenate(reference_vectors(*ANGLES, 1.0, 48_000.0, DIP), -1)
    attitude, raw = tool_from_earth(*ANGLES), 1.01 * vectors
    warmth, gain = ROLL.temperature - 30.0, np.array([1.02, 0.97, 1.1, 0.9, 1.05, 1.0])
    gain, by_field = (
        np.broadcast_to(gain, raw.shape),
        np.broadcast_to(np.diag(gain[3:]), attitude.shape),
    )
    columns = likelihood.columns(raw, vectors, attitude, warmth, gain, by_field)
    for place in range(SIZE):
        step = 1e-6 * np.eye(SIZE)[place]
        up, down = (read(s * step, raw, vectors, attitude, ROLL.temperature, gain) for s in (1, -1))
        np.testing.assert_allclose((up - down) / 2e-6, columns[..., place], atol=2e-4, rtol=1e-6)


def test_what_turns_with_the_tool_and_what_stays_in_the_earth():
    attitude = tool_from_earth(*ANGLES)
    field = reference_vectors(*ANGLES, 1.0, 48_000.0, DIP)[1]
    departures = np.zeros(SIZE)
    departures[DEPARTURES["disturbance"]] = 300.0, -200.0, 100.0
    damage = Damage(departures, np.zeros(6, bool), np.zeros(6))
    strength = np.linalg.norm(likelihood.changed_field(damage, field, attitude), axis=-1)
    level, down = 48_000 * np.cos(DIP) + 300, 48_000 * np.sin(DIP) + 100
    np.testing.assert_allclose(strength, np.sqrt(level**2 + 200**2 + down**2))
    departures[:] = 0.0
    departures[DEPARTURES["iron"]] = 10.0, 20.0, 200.0
    changed = (
        likelihood.changed_field(Damage(departures, *[np.zeros(6)] * 2), field, attitude) - field
    )
    np.testing.assert_allclose(changed, np.tile([10.0, 20.0, 200.0], (ROLL.count, 1)), atol=1e-9)


def test_a_turned_axis_keeps_its_gain():
    """Turned by 3 and 4 units a unit vector points along (1, 3, 4) / √26."""
    departures = np.zeros(SIZE)
    departures[DEPARTURES["turn"]][:2] = 3.0, 4.0
    damage = Damage(departures, np.zeros(6, bool), np.zeros(6))
    vectors = np.eye(3, 6)
    read = likelihood.changed_readings(damage, vectors, vectors, np.full(3, 30.0), 30.0)
    np.testing.assert_allclose(read[:, 0], np.array([1.0, 3.0, 4.0]) / np.sqrt(26))


def test_a_channel_dies_of_heat():
    damage = Damage(np.zeros(SIZE), np.arange(6) == 2, np.full(6, 0.3), above=80.0)
    raw = np.ones((2, 6))
    read = likelihood.changed_readings(damage, raw, raw, np.array([79.0, 81.0]), 30.0)
    np.testing.assert_allclose(read, [[1] * 6, [1, 1, 0.3, 1, 1, 1]])


# Evidence


def test_the_evidence_is_that_of_a_normal_density():
    """With exact attitudes the readings are normal: their covariance by finite differences, dense."""
    calibration, _ = tool(0)
    readings, _ = later(0, kind="turn-on", size=0.3)
    suspect = Suspect.of(calibration, readings)
    forms = likelihood.faults(calibration.profile)
    each = repeated(suspect, np.zeros(len(forms), int))
    none = explained(suspect, np.zeros((1, SIZE, 0)), suspect.start())
    best = explained(each, padded(forms), each.start())
    vectors = reference_vectors(*ANGLES, 1.0, 48_000.0, DIP)
    ends = np.cumsum([0, *(len(t.parameters) for t in calibration.triads)])

    def forward(params):
        parts = [
            raw_reading(t.functions(30.0), params[a:b], v, ROLL.temperature)
            for t, v, a, b in zip(calibration.triads, vectors, ends, ends[1:], strict=False)
        ]
        return np.concatenate(parts, -1)

    params = calibration.parameters
    sd = np.sqrt(np.diag(calibration.parameter_covariance))
    slopes = [(forward(params + s) - forward(params - s)).ravel() / 2 for s in np.diag(sd)]
    jacobian = np.stack(slopes, -1) / sd
    mean = forward(params)
    noise = np.concatenate([NOISE["accelerometer"], NOISE["magnetometer"]], -1).ravel() ** 2
    sound = np.diag(noise) + jacobian @ calibration.parameter_covariance @ jacobian.T
    scale = np.sqrt(noise)
    difference = (raw_of(suspect.problem)[0] - mean).ravel() / scale

    def density(covariance):
        return multivariate_normal(cov=covariance / np.outer(scale, scale)).logpdf(difference)

    attitude = tool_from_earth(*ANGLES)
    slopes = [
        t.functions(30.0).slope(np.array(t.parameters), part, ROLL.temperature)
        for t, part in zip(calibration.triads, np.split(mean, 2, -1), strict=True)
    ]
    gain = np.concatenate([1 / np.diagonal(s, axis1=-2, axis2=-1) for s in slopes], -1)
    warmth, whole = ROLL.temperature - 30, np.concatenate(vectors, -1)
    seen = likelihood.columns(mean, whole, attitude, warmth, gain, np.linalg.inv(slopes[1]))
    for form, evidence in zip(forms, best.evidence - none.evidence, strict=True):
        change = (seen @ form.mixing).reshape(-1, form.mixing.shape[1])
        expected = density(sound + change @ change.T) - density(sound)
        assert evidence == pytest.approx(expected, abs=0.02, rel=2e-3), form


def test_a_sound_tool_gives_an_alarm_no_more_often_than_stated():
    """Of 30 chances the smallest tenth holds no more than its binomial share, and 1 % alarms hardly any."""
    chances = [
        diagnose(tool(n)[0], later(n, s)[0], draws=199).probability
        for n in range(6)
        for s in range(5)
    ]
    assert np.count_nonzero(np.array(chances) <= 0.1) <= binom.ppf(0.999, 30, 0.1)
    assert np.count_nonzero(np.array(chances) <= 0.01) <= binom.ppf(0.999, 30, 0.01)
    assert 0.3 < np.mean(chances) < 0.5 + 5 * 0.29 / np.sqrt(30)


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_of_the_usual_size_are_named(kind):
    named, scores = [], []
    for number in range(6):
        plan = SOAKS if kind == "heat" else ROLL  # one temperature shows no heat
        readings, damage = later(number, plan=plan, kind=kind, reading=0.2)
        result = diagnose(tool(number)[0], readings, draws=199)
        named.append(result.fault)
        if kind in ("magnetised", "casing") and result.fault == kind:
            where = "iron" if kind == "magnetised" else "disturbance"
            names = ["x", "y", "z"] if kind == "magnetised" else ["north", "east", "down"]
            for row in result.parameters:
                true = damage.part(where)[0, names.index(row.parameter.split()[-1])]
                scores.append((row.size - true) / row.uncertainty)
    assert named.count(kind) >= 5
    assert np.sum(np.square(scores)) < 45  # of 18: chance 4e-4


@pytest.mark.parametrize("channel", ["ax", "az", "my"])
def test_an_impact_names_its_channel_and_size(channel):
    calibration, _ = tool(1)
    readings, damage = later(1, kind="impact", channel=channel)
    result = diagnose(calibration, readings)
    assert (result.fault, result.channel) == ("impact", channel)
    place = ("ax", "ay", "az", "mx", "my", "mz").index(channel)
    bias = next(row for row in result.parameters if row.parameter == "bias")
    true = damage.part("bias")[0, place] * (1e3 if place < 3 else 1.0)
    assert abs(bias.size - true) < 4 * bias.uncertainty
    assert bias.unit == ("mg" if place < 3 else "nT")


def test_a_dead_channel_is_named_without_references_too():
    for known in (None, ("field", "dip")):
        readings, _ = later(2, known=known, kind="dead-channel", channel="my", reading=12_345.0)
        result = diagnose(tool(2)[0], readings)
        assert (result.fault, result.channel, result.unit) == ("dead-channel", "my", "nT")
        assert result.size == pytest.approx(12_345.0, abs=5 * result.size_uncertainty)


def interfered(number, field, known=None, seed=0):
    """A roll test of a sound tool in a field (3,) that is fixed in it, nT."""
    _, truth = tool(number)
    readings, _ = later(number, seed, known)
    model = truth.triads["magnetometer"][0]
    slope = model.slope(truth.magnetometer, readings.magnetometer, ROLL.temperature)
    moved = readings.magnetometer + np.linalg.solve(slope, np.array(field, float))
    return replace(readings, magnetometer=moved)


@pytest.mark.parametrize("size", [-150.0, 800.0, 2000.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("known", [None, ("field", "dip")])
def test_interference_of_the_string_and_a_bias_are_one_thing_at_any_attitude(axis, size, known):
    """A field along a tool axis is a bias of that channel: both are reported, the one that condemns no sensor first,
    each with the true size; and no attitude tells them apart, only the tool without its string."""
    result = diagnose(tool(3)[0], interfered(3, size * np.eye(3)[axis], known, axis))
    assert (result.fault, result.confounded_with) == ("magnetised", ["impact"])
    (rival,) = result.rivals
    assert (rival.fault, rival.channel) == ("impact", ("mx", "my", "mz")[axis])
    assert result.tell_apart[0].reading.startswith("six stations without string")
    for each in (result, rival):
        assert each.size == pytest.approx(size, abs=4 * each.size_uncertainty)
    assert result.surveys == (known is not None)


def test_a_sensor_whose_axis_turned_is_no_interference():
    """The shift turns with the field: no constant in the tool, however large, explains it."""
    readings = interfered(3, (0.0, 0.0, 300.0))
    field = reference_vectors(*ANGLES, 1.0, 48_000.0, DIP)[1]
    knocked = readings.magnetometer + 4e-3 * field[:, :1] * np.array([0.0, 0.0, 1.0])
    result = diagnose(tool(3)[0], replace(readings, magnetometer=knocked))
    assert (result.fault, result.channel, result.confounded_with) == ("impact", "mz", [])


def test_one_temperature_shows_no_heat():
    """Bias and scale of every channel moved: at one temperature that is not heat, at two it is."""
    one = diagnose(tool(0)[0], later(0, kind="heat")[0])
    assert one.fault != "heat"
    assert one.likelihoods["heat"] == 0
    assert "heat" in one.unseen
    assert {"one-temperature", "unexplained"} <= {finding.id for finding in one.findings}
    assert diagnose(tool(0)[0], later(0, plan=SOAKS, kind="heat")[0]).fault == "heat"


# Readings that say little


def test_one_station_without_references_names_nothing():
    readings, _ = later(4, known=())
    one = readings.select(np.arange(ROLL.count) == 0)
    result = diagnose(tool(4)[0], one)
    assert result.fault == NONE
    assert {"magnetised", "casing"} <= {*result.unseen}
    assert result.likelihoods[NONE] < 0.5


def test_an_accelerometer_alone_and_no_temperature():
    readings, _ = later(4, kind="impact", channel="ax")
    result = diagnose(tool(4)[0], replace(readings, magnetometer=None))
    assert (result.fault, result.channel) == ("impact", "ax")
    assert "no-magnetometer" in {finding.id for finding in result.findings}
    assert result.likelihoods["casing"] == 0  # an accelerometer says nothing of it: no candidate
    with pytest.raises(mwdcal.InputError, match="temperature_c"):
        diagnose(tool(4)[0], replace(readings, temperature=None))


def test_a_relative_field():
    _, truth = tool(5)
    run = plans.run(truth, PLAN, np.random.default_rng(1))
    known = {name: value for name, value in run.known.items() if name != "field"}
    calibration = mwdcal.calibrate(
        replace(run, known=known), options=Options(order=1, nonlinearity="none")
    )
    for fault in ("none", "casing"):
        result = diagnose(calibration, later(5, kind=fault)[0])
        assert result.fault == fault
        assert "relative-field" in {finding.id for finding in result.findings}


def test_readings_of_another_unit_do_not_look_fine():
    readings, _ = later(4)
    result = diagnose(tool(4)[0], replace(readings, magnetometer=readings.magnetometer / 1000))
    assert result.fault != NONE
    assert "unexplained" in {finding.id for finding in result.findings}


# The command


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnose")
    assert command("example", folder / "demo").code == 0
    demo = folder / "demo"
    fit = ("calibrate", demo / "run.csv", "--tool", demo / "tool.toml", "-o", folder / "tool.json")
    assert command(*fit).code == 0
    return folder


def test_the_command_says_still_fine(files):
    ran = command("diagnose", files / "tool.json", files / "demo" / "rolltest.csv")
    assert ran.code == 0
    assert ran.out.startswith("no change found: ")
    assert "SIMULATED" in ran.out


def test_the_command_names_a_fault_in_raw_units(files, tmp_path):
    columns = read_csv(files / "demo" / "rolltest.csv")
    columns["ay"] = [float(value) + 0.03 for value in columns["ay"]]  # 10 mg at 3 V/g
    write_csv(tmp_path / "knocked.csv", columns)
    ran = command("diagnose", files / "tool.json", tmp_path / "knocked.csv", "--json")
    assert ran.code == 1
    assert (ran.json["fault"], ran.json["channel"], ran.json["unit"]) == ("impact", "ay", "mg")
    assert abs(ran.json["size"] - 10) < 4 * ran.json["size_uncertainty"]
    assert sum(ran.json["likelihoods"].values()) == pytest.approx(1)
    assert command("diagnose", files / "tool.json", tmp_path / "knocked.csv").out.startswith(
        "impact on channel ay: bias moved by "
    )


def test_the_command_condemns_no_tool_for_interference_of_its_string(files, tmp_path):
    """Surveys in a hole, no attitude known: a constant of mz is interference or a bias."""
    columns = read_csv(files / "demo" / "rolltest.csv")
    columns["mz"] = [float(value) + 0.04 for value in columns["mz"]]  # 800 nT at 5e-5 V/nT
    surveys = {
        k: v for k, v in columns.items() if not k.startswith(("ref_inc", "ref_azi", "ref_too"))
    }
    for name, table, step in (
        ("stand.csv", columns, "without string"),
        ("well.csv", surveys, "--msa"),
    ):
        write_csv(tmp_path / name, table)
        out = command("diagnose", files / "tool.json", tmp_path / name).out
        assert out.startswith("cannot tell magnetised: field along z moved by ")
        assert " from impact on channel mz: bias moved by " in out
        assert "do not use" not in out
        assert step in out[out.index("next: ") :]


def test_the_command_refuses_what_says_nothing(files, tmp_path):
    demo = files / "demo"
    assert "own fit" in refused(command("diagnose", files / "tool.json", demo / "run.csv"), 2)
    columns = read_csv(demo / "rolltest.csv")
    write_csv(tmp_path / "other.csv", columns, 'serial = "another"')
    assert "tool another" in refused(
        command("diagnose", files / "tool.json", tmp_path / "other.csv"), 2
    )


def test_channels_have_their_own_names_and_signs(tmp_path):
    """A tool whose ay measures -x: a step of +6 mg of that channel is one, whatever its axis."""
    (tmp_path / "odd.toml").write_text(
        'name = "odd"\n[accelerometer]\naxes = ["+z", "-x", "+y"]\nscale = 1.0\nnoise = 1e-4\n'
        '[magnetometer]\naxes = ["+x", "+y", "+z"]\nscale = 1.0\nnoise = 15.0\n', "utf-8")  # fmt: skip
    (tmp_path / "plan.toml").write_text(
        'name = "p"\n[[stations]]\ninclination_deg = [5, 45, 90, 135]\ntoolface_deg = [0, 90, 180, 270]\n', "utf-8"
    )  # fmt: skip
    (tmp_path / "fault.toml").write_text('[fault]\nkind = "impact"\nchannel = "ay"\n', "utf-8")
    run = (
        "simulate",
        "--plan",
        tmp_path / "plan.toml",
        "--tool",
        tmp_path / "odd.toml",
        "--order",
        "0",
    )
    assert command(*run, "--seed", "1", "-o", tmp_path / "run.csv").code == 0
    fit = (
        "calibrate",
        tmp_path / "run.csv",
        "--tool",
        tmp_path / "odd.toml",
        "-o",
        tmp_path / "cal.json",
    )
    assert command(*fit, "--order", "0").code == 0
    again = (
        "simulate",
        "--plan",
        tmp_path / "plan.toml",
        "--calibration",
        tmp_path / "cal.json",
        "--seed",
        "2",
    )
    effects = ("--effects", tmp_path / "fault.toml", "-o", tmp_path / "later.csv", "--json")
    truth = command(*again, *effects).json
    ran = command("diagnose", tmp_path / "cal.json", tmp_path / "later.csv", "--json")
    assert (ran.code, ran.json["fault"], ran.json["channel"]) == (1, "impact", "ay")
    bias = next(row for row in ran.json["parameters"] if row["parameter"] == "bias")
    assert abs(bias["size"] + 1e3 * truth["fault"]["bias"][0]) < 4 * bias["uncertainty"]


def test_a_turned_axis_is_named_by_the_channel_towards_which_it_turned(tmp_path):
    """A tool whose ax measures y and whose ay measures -x: ay then reads a part of what ax reads."""
    profile = (resources.files("mwdcal.profiles") / "servo.toml").read_text("utf-8")
    odd = profile.replace('axes = ["+x", "+y", "+z"]', 'axes = ["+y", "-x", "+z"]', 1)
    (tmp_path / "odd.toml").write_text(odd, "utf-8")
    tool, share = Tool.random(1, noise=SERVO_NOISE), np.sin(0.5 * DEG)

    def exchanged(columns, turn=0.0):
        ax, ay = columns["ay"], -columns["ax"]
        return {**columns, "ax": ax, "ay": ay + turn * ax}

    write_csv(tmp_path / "run.csv", exchanged(servo_run(1, tool=tool)), "serial = A")
    later = exchanged(servo_run(2, (30, 80), 6, tool=tool), share)
    write_csv(tmp_path / "later.csv", later, "serial = A")
    fit = ("calibrate", tmp_path / "run.csv", "--tool", tmp_path / "odd.toml")
    assert command(*fit, "-o", tmp_path / "cal.json").code == 0
    ran = command("diagnose", tmp_path / "cal.json", tmp_path / "later.csv", "--json")
    turned = {row["parameter"]: row["size"] for row in ran.json["parameters"]}
    assert (ran.json["fault"], ran.json["channel"]) == ("impact", "ay")
    assert turned["axis turned towards ax"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    "text", ['kind = "heat"\nchannel = "ax"', 'kind = "dead-channel"\nchannel = "accelerometer"']
)
def test_effects_refuse_a_channel_that_the_fault_lacks(text, tmp_path):
    (tmp_path / "odd.toml").write_text(f"[fault]\n{text}\n", "utf-8")
    with pytest.raises(mwdcal.InputError, match="fault.channel"):
        load_effects(str(tmp_path / "odd.toml"))


def test_a_run_of_the_tests_own_model_is_still_fine(tmp_path):
    """Readings by the formulas of the tests, not of the package; those of another tool are not explained."""
    sound = Tool.random(1, noise=SERVO_NOISE)
    write_csv(tmp_path / "run.csv", servo_run(1, tool=sound), "serial = A")
    write_csv(tmp_path / "later.csv", servo_run(2, (30, 80), 6, tool=sound), "serial = A")
    fit = ("calibrate", tmp_path / "run.csv", "--tool", "servo", "-o", tmp_path / "cal.json")
    assert command(*fit).code == 0
    ran = command("diagnose", tmp_path / "cal.json", tmp_path / "later.csv")
    assert (ran.code, ran.err.count("!")) == (0, 1)
    assert ran.err.startswith("! all readings are at one temperature: ")
    write_csv(tmp_path / "other.csv", servo_run(2, (30, 80), 6))
    ran = command("diagnose", tmp_path / "cal.json", tmp_path / "other.csv")
    assert ran.code == 1
    assert ran.out.startswith("no single fault explains these readings; closest: ")
    assert "±" not in ran.out.partition("\n")[0]
    assert "none fits; the closest first" in ran.out
    assert "100.0 %" not in ran.out
    assert "do not use" not in ran.out
    assert "no single fault explains" in ran.err


OFFSETS = {"inclination": 0.4, "azimuth": -0.6, "toolface": 0.5}


def on_uncertain_stand(readings, size, zero=0.0):
    """The readings of a stand whose settings of direction, set once for a roll, have this standard uncertainty."""
    sd = {n: np.full(readings.count, size * DEG) for n in ("inclination", "azimuth")}
    sd |= {"inclination-zero": np.full(readings.count, zero * DEG)} if zero else {}
    return replace(readings, sd={**readings.sd, **sd}, settings="per-direction")


@pytest.mark.parametrize("angle", OFFSETS)
def test_an_offset_of_the_stand_is_named_with_its_size_and_never_still_fine(angle):
    """Three rolls set to 0.1°: a common offset is known to 0.1°/√3, toolface to the noise."""
    readings, _ = later(3)
    known = {**readings.known, angle: readings.known[angle] + OFFSETS[angle] * DEG}
    result = diagnose(tool(3)[0], on_uncertain_stand(replace(readings, known=known), 0.1))
    offset = result.stand_offset
    assert offset.parameter == angle
    assert abs(offset.size - OFFSETS[angle]) < 3 * max(offset.uncertainty, 0.01)
    assert offset.uncertainty == pytest.approx(0.1 / np.sqrt(3), rel=0.15) or angle == "toolface"
    assert not is_fine(result)
    assert f"offset of the stand's {angle}" in screen(result)


def test_an_offset_within_the_stands_uncertainty_is_no_change_and_may_fail_a_limit():
    """An offset of 0.5°, twice the limit of the error of inclination, on a stand of 0.3°."""
    readings, _ = later(3)
    known = {**readings.known, "inclination": readings.known["inclination"] + 0.5 * DEG}
    coarse = on_uncertain_stand(replace(readings, known=known), 0.3)
    assert not mwdcal.verify(tool(3)[0], coarse).passed
    shown = screen(diagnose(tool(3)[0], coarse))
    assert shown.startswith("no change found: noise and uncertainty explain")
    assert "if these readings fail verify" in shown


@pytest.mark.parametrize("zero", [0.0, 0.3])
def test_a_sound_roll_test_has_no_offset_and_a_stated_zero_of_the_stand_counts(zero):
    readings, _ = later(3)
    shift = {"inclination": readings.known["inclination"] + zero * DEG}
    later_on = replace(readings, known={**readings.known, **shift})
    assert is_fine(diagnose(tool(3)[0], on_uncertain_stand(later_on, 0.1, zero)))


def test_a_blow_is_no_offset_of_the_stand():
    readings, _ = later(3, kind="impact", channel="ax", size=3.0)
    result = diagnose(tool(3)[0], on_uncertain_stand(readings, 0.01))
    assert (result.fault, result.stand_offset) == ("impact", None)


def test_the_command_blames_the_stand_for_a_roll_test_that_fails(files, tmp_path):
    columns = read_csv(files / "demo" / "rolltest.csv")
    angles = [float(value) + 0.4 for value in columns["ref_inclination_deg"]]
    write_csv(tmp_path / "high.csv", columns | {"ref_inclination_deg": angles})
    assert "FAIL" in command("verify", files / "tool.json", tmp_path / "high.csv").out
    ran = command("diagnose", files / "tool.json", tmp_path / "high.csv")
    assert ran.code == 1
    assert ran.out.startswith("an offset of the stand's inclination of 0.39")
    assert "next: check the zero of the stand" in ran.out
