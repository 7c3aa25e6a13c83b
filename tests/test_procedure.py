"""Many repetitions of a procedure: each tool as if alone, shares by an authority, the same result for the same seed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace as with_changes
from scipy import stats

import mwdcal
from cli_support import EXAMPLE, process, refused, write_csv
from cli_support import mwdcal as command
from mwdcal.calibration.options import Options
from mwdcal.files.limits import load_limits
from mwdcal.files.profiles import load_profile
from mwdcal.planning import procedure as procedures
from mwdcal.planning.plans import Effects, SensorEffects, StandEffects, drawn, load_plan
from mwdcal.planning.procedure import Procedure, Share, summarised
from mwdcal.sensor.profile import StandProfile
from mwdcal.use.verification import Bounds, Limits

SERVO = load_profile("servo")[0]
EXACT = with_changes(SERVO, stand=StandProfile())
LIMITS = Limits(
    name="all",
    spread=Bounds(
        inclination_deg=0.02, azimuth_deg=0.1, toolface_deg=0.03, gravity_g=2e-4, field_nt=30.0
    ),
    error=Bounds(inclination_deg=0.02, azimuth_deg=0.06, toolface_deg=0.03, dip_deg=0.03),
)


def procedure(
    plan="twelve-state", profile=SERVO, limits=LIMITS, seed=5, test="roll-test", **others
):
    return Procedure.of(
        load_plan(plan), load_plan(test), profile, Options(), limits, seed, **others
    )


def sessions(wanted, count):
    """The readings of both sessions, tool by tool, in the order in which the procedure draws."""
    rng = np.random.default_rng([wanted.seed, 3, 0])
    tools = drawn(rng, wanted.calibrating.profile, wanted.order, (count,))
    common = wanted.calibrating.common(rng, (count,))
    both = [s.measured(tools, rng, common).readings for s in (wanted.calibrating, wanted.testing)]
    for k in range(count):
        yield [
            replace(
                r, accelerometer=r.accelerometer[k], magnetometer=r.magnetometer[k], source=name
            )
            for r, name in zip(both, ("run", "roll test"), strict=True)
        ]


@pytest.mark.parametrize("stand", [{}, {"azimuth_zero_deg": 0.02, "inclination_zero_deg": 0.005}])
def test_each_tool_is_calibrated_and_judged_as_if_alone(stand):
    """Parameters as `calibrate` gives them, and every row of `verify`."""
    profile = with_changes(SERVO, stand=with_changes(SERVO.stand, **stand))
    wanted, count = procedure(profile=profile), 4
    columns = wanted.repeated((0, count))
    for k, (run, test) in enumerate(sessions(wanted, count)):
        calibration = mwdcal.calibrate(run, profile, order=0)
        for triad in calibration.triads:
            for name, value in zip(triad.parameter_names, triad.parameters, strict=True):
                got = columns[procedures.column(triad.name, name)][k]
                assert got == pytest.approx(value, rel=1e-7, abs=1e-7)
        verdict = mwdcal.verify(calibration, test, LIMITS)
        assert [row.name for row in verdict.rows] == [
            f"{j.kind} of {j.name}" for j in wanted.judged
        ]
        for row, judged in zip(verdict.rows, wanted.judged, strict=True):
            assert columns[judged.column()][k] == pytest.approx(row.value, rel=1e-4, abs=1e-8)
            assert columns[judged.column("sd")][k] == pytest.approx(row.uncertainty, rel=1e-3)
        assert columns["passed"][k] == verdict.passed


def test_what_is_true_of_a_tool_is_seen_without_noise():
    """The true figures are those of a roll test of very many readings by `mwdcal.apply`, 24 toolfaces, no noise."""
    wanted = procedure(profile=EXACT)
    columns = wanted.repeated((0, 2))
    rng = np.random.default_rng([wanted.seed, 3, 0])
    tools = drawn(rng, EXACT, 0, (2,))
    toolface = np.arange(360) * np.pi / 180
    inc, azi = np.full(360, np.pi / 4), np.zeros(360)
    from simulation import attitude

    vectors = attitude(inc, azi, toolface)(1.0, 48_000.0, np.radians(63))
    for k, (run, _) in enumerate(sessions(wanted, 2)):
        calibration = mwdcal.calibrate(run, EXACT, order=0)
        raws = [r[k] for r in tools.readings(vectors, np.full(360, 25.0)).values()]
        got = mwdcal.apply(calibration, mwdcal.Readings(*raws, np.full(360, 25.0)))
        off = np.degrees((got.azimuth + np.pi) % (2 * np.pi) - np.pi)
        # the curve of the package has 120 points: at most 0.14 % less
        assert columns["error_azimuth_true_deg"][k] == pytest.approx(np.abs(off).max(), rel=2e-3)
        assert columns["spread_azimuth_true_deg"][k] == pytest.approx(np.ptp(off), rel=2e-3)
        strength = np.linalg.norm(got.gravity, axis=-1)
        assert columns["spread_gravity_true_g"][k] == pytest.approx(np.ptp(strength), rel=2e-3)


def test_parameters_scatter_as_their_uncertainty_says():
    """Error over stated standard uncertainty, all 24 parameters, the truth by NumPy: Student's t of 72 degrees."""
    columns = procedure("moosavi-12", EXACT).repeated((0, 200))

    def true(triad, name):
        return columns[f"true_{triad}_{name}"]

    ratios = []
    for triad in ("accelerometer", "magnetometer"):
        scale = np.stack([true(triad, f"scale_{i}") for i in "xyz"], -1)
        bias = np.stack([true(triad, f"bias_{i}") for i in "xyz"], -1)
        for p, i in enumerate("xyz"):
            row = np.stack(
                [np.ones(200) if i == j else -true(triad, f"misalignment_{i}{j}") for j in "xyz"],
                -1,
            )
            exact = {f"gain_{i}{j}": row[:, q] / scale[:, q] for q, j in enumerate("xyz")}
            exact[f"offset_{'xyz'[p]}"] = -np.sum(row * bias, -1)
            for name, value in exact.items():
                got, sd = columns[f"{triad}_{name}"], columns[f"{triad}_{name}_sd"]
                ratios.append((got - value) / sd)
    square = np.mean(np.square(ratios))
    freedom = 3 * 48 - 12
    assert square == pytest.approx(freedom / (freedom - 2), abs=0.07)


def test_an_undeclared_error_of_the_stand_makes_good_tools_rare():
    """A toolface zero turns both triads about the tool axis: no residual moves, and the roll test passes."""
    zero = Effects(stand=StandEffects(toolface_zero_deg=0.5))
    limits = Limits(name="toolface", error=Bounds(toolface_deg=0.3))
    columns = procedure(profile=EXACT, limits=limits, effects=zero).repeated((0, 200))
    assert columns["passed"].all()
    chance = 2 * stats.norm.cdf(0.6) - 1  # |N(0, 0.5°)| below 0.3°
    assert columns["good"].mean() == pytest.approx(
        chance, abs=4 * np.sqrt(chance * (1 - chance) / 200)
    )


def test_the_guarded_rule_accepts_less():
    simple = procedure(profile=EXACT).repeated((0, 100))
    guarded = procedure(profile=EXACT, limits=with_changes(LIMITS, rule="guarded")).repeated(
        (0, 100)
    )
    np.testing.assert_array_equal(simple["good"], guarded["good"])
    assert not (guarded["passed"] & ~simple["passed"]).any()
    judged = procedure(profile=EXACT).judged
    wanted = np.all(
        [guarded[j.column()] + 2 * guarded[j.column("sd")] <= j.limit for j in judged], 0
    )
    np.testing.assert_array_equal(guarded["passed"], wanted)


@pytest.mark.parametrize(("count", "total"), [(0, 50), (3, 50), (25, 50), (50, 50), (7, 10_000)])
def test_shares_have_wilsons_interval(count, total):
    got = Share.of(np.arange(total) < count)
    wanted = stats.binomtest(count, total).proportion_ci(method="wilson")
    assert (got.count, got.share) == (count, count / total)
    assert (got.low, got.high) == pytest.approx((wanted.low, wanted.high), abs=1e-12)


def test_shares_are_counted_over_all_tools():
    columns = {
        "status": np.array(["ok"] * 5 + ["gain"], object),
        "passed": np.array([1, 1, 0, 0, 1, 0], bool),
        "good": np.array([1, 0, 1, 0, 1, 1], bool),
        "inclination_error_rms_deg": np.arange(6.0), "inclination_error_max_deg": np.arange(6.0),
        "inclination_sd_deg": np.arange(6.0),
    }  # fmt: skip
    found = summarised(columns, [], 0.0)
    assert (found.calibrated.count, found.refused) == (5, {"gain": 1})
    assert [s.count for s in (found.passed, found.good, found.wrong_pass, found.wrong_fail)] == [
        3,
        3,
        1,
        1,
    ]
    assert found.wrong_pass.share == pytest.approx(1 / 6)
    assert found.errors_deg["inclination"]["max"]["p50"] == 2.0  # of those calibrated


def test_where_no_tool_is_calibrated_there_are_no_percentiles():
    columns = procedure(profile=EXACT).repeated((0, 3))
    columns["status"] = np.array(["gain"] * 3, object)
    found = summarised(columns, procedure(profile=EXACT).judged, 0.0)
    assert found.calibrated.count == 0
    assert set(found.limits[0].value.values()) == {None}
    assert found.limits[0].wrong.count == 0


def repeat(folder, name, *options, count=30, plan="six-state"):
    output = folder / f"{name}.parquet"
    return command("simulate", "--plan", plan, "--repeat", count, "-o", output, *options), output


def test_the_table_and_the_screen(tmp_path):
    picture = tmp_path / "tools.png"
    ran, output = repeat(tmp_path, "a", "--workers", 1, "--plot", picture)
    assert ran.code == 0, ran
    assert "SIMULATED DATA" in ran.out
    assert "consumer's risk" in ran.out
    table = pq.read_table(output)
    assert json.loads(table.schema.metadata[b"mwdcal"])["simulated"] is True
    assert table.num_rows == 30
    assert table.column("tool").to_pylist() == list(range(1, 31))
    assert picture.read_bytes().startswith(b"\x89PNG")
    found = repeat(tmp_path, "b", "--workers", 1, "--json")[0].json
    assert found["simulated"] is True
    assert found["repetition"]["passed"]["count"] == sum(table.column("passed").to_pylist())
    errors = np.sort(table.column("azimuth_error_max_deg").to_numpy())
    assert found["repetition"]["errors_deg"]["azimuth"]["max"]["p95"] == pytest.approx(
        np.percentile(errors, 95)
    )


@pytest.mark.slow
def test_the_same_result_whatever_the_number_of_processes(tmp_path):
    files = []
    for workers in (1, 3):
        output = tmp_path / f"{workers}.parquet"
        line = (
            "simulate",
            "--plan",
            "six-state",
            "--repeat",
            450,
            "--seed",
            4,
            "-o",
            output,
            "--workers",
            workers,
        )
        if workers == 1:
            assert command(*line).code == 0
        else:
            done = process(*line)
            assert done.returncode == 0, done.stderr
        files.append(output.read_bytes())
    assert files[0] == files[1]


def test_a_tool_without_magnetometer_is_judged_by_what_it_has():
    """As `verify` judges it: a limit of azimuth neither passes nor fails it."""
    tool = replace(drawn(np.random.default_rng(1), SERVO, 0), magnetometer=None)
    limits = Limits(name="both", spread=Bounds(inclination_deg=1.0, azimuth_deg=1.0))
    wanted = Procedure.of(
        load_plan("twelve-state"), load_plan("roll-test"), SERVO, Options(), limits, 1, tool=tool
    )
    assert [each.name for each in wanted.judged] == ["inclination"]
    columns = wanted.repeated((0, 20))
    assert columns["passed"].all()
    assert columns["good"].all()


def test_another_seed_gives_other_tools(tmp_path):
    first, second = (
        repeat(tmp_path, str(seed), "--seed", seed, "--workers", 1)[1] for seed in (1, 2)
    )
    assert first.read_bytes() != second.read_bytes()


def test_one_tool_again_and_again(tmp_path):
    run, calibration = tmp_path / "run.csv", tmp_path / "cal.json"
    assert command("simulate", "--plan", "moosavi-12", "-o", run).code == 0
    assert command("calibrate", run, "--tool", "servo", "-o", calibration).code == 0
    ran, output = repeat(tmp_path, "a", "--calibration", calibration, "--workers", 1)
    assert ran.code == 0, ran
    table = pq.read_table(output)
    record = json.loads(calibration.read_bytes())["accelerometer"]
    gain = record["parameters"][record["parameter_names"].index("gain-xx")]
    assert set(table.column("true_accelerometer_gain_xx").to_pylist()) == {gain}
    assert np.mean(table.column("accelerometer_gain_xx").to_numpy()) == pytest.approx(
        gain, abs=2e-4
    )


@pytest.mark.parametrize(
    ("options", "word", "code"),
    [
        (("--truth", "t.json"), "the table holds what is true of each tool", 2),
        (("--rolltest", "seven"), "plan must be a built-in name", 2),
        (("--rolltest", "still.csv"), "cannot be passed", 2),
        (("--limits", "none"), "limits profile must be a built-in name", 2),
        (("--method", "newton", "--plan", "moosavi-12"), "leaves a direction undetermined", 3),
        (("--order", "3"), "", 3),
    ],
)
def test_bad_procedures_end_in_a_sentence(tmp_path, options, word, code):
    still = {"inclination": 45, "azimuth": 60, "toolface": 40}
    columns = {f"ref_{name}_deg": np.full(6, value) for name, value in still.items()}
    write_csv(tmp_path / "still.csv", columns)
    options = [tmp_path / each if each == "still.csv" else each for each in options]
    ran, output = repeat(tmp_path, "a", *options, "--workers", 1)
    assert word in refused(ran, code)
    assert not output.exists()


def test_options_of_the_fit_are_not_for_a_single_run(tmp_path):
    ran = command("simulate", "-o", tmp_path / "run.csv", "--method", "newton")
    assert "--method goes with --repeat" in refused(ran, 2)


def test_ten_thousand_calibrations_are_judged_by_the_shipped_limits():
    """The default procedure has limits that can be judged."""
    names = [f"{j.kind} {j.name}" for j in procedure("moosavi-12", limits=load_limits()[0]).judged]
    assert names == [
        "spread inclination",
        "spread azimuth",
        "spread gravity",
        "error inclination",
        "error azimuth",
    ]


def test_a_turn_on_is_no_error_of_the_calibration_and_is_one_of_the_roll_test():
    """20 mg at each switching on: stated accuracy is met, true parameters hold it, and the roll test sees the next."""
    wild = with_changes(Effects(), accelerometer=SensorEffects(turn_on=0.02))
    calm = procedure(limits=LIMITS).repeated((0, 20))
    shaken = procedure(limits=LIMITS, effects=wild).repeated((0, 20))
    for name in ("inclination", "toolface"):
        assert np.median(shaken[f"{name}_error_rms_deg"] / calm[f"{name}_error_rms_deg"]) < 2
    assert shaken["good"].sum() < calm["good"].sum()
    true = shaken["error_inclination_true_deg"]
    assert np.median(true) > np.degrees(
        0.02
    )  # two switchings on, of which 20 mg each turn gravity by 1.1°


def test_a_field_in_volts_without_a_scale_states_no_uncertainty_lost_in_rounding(tmp_path):
    """Warnings are errors here."""
    tool = tmp_path / "tool.toml"
    tool.write_text((EXAMPLE / "tool.toml").read_text().replace("scale = 5e-5", "# "))
    ran = command(
        "simulate", "--tool", tool, "-o", tmp_path / "tools.csv", "--repeat", 20, "--limits", "moradi",
        "--workers", 1, "--model", "factors",
    )  # fmt: skip
    assert ran.code == 0, ran.err
