"""`mwdcal verify`: a knocked tool fails on the limit that its knock moves, and only independent data count."""

import dataclasses
import json
import re
from html import unescape

import numpy as np
import pytest

from cli_support import (
    SCALE,
    calibrated,
    channels,
    mwdcal,
    refused,
    servo_run,
    stations,
    write_csv,
)
from mwdcal.planning import plans

SEED = 11
PLAN = plans.grid([5, 45, 90, 135], 12, [0, 90, 180, 270], [25.0])
ROLL = plans.grid([45], 12, [60], [25.0])
DEG = np.pi / 180


def columns(readings, plan, truth):
    """The columns of a simulated run of `simulate`, by a writer of the tests."""
    earth = (truth.gravity, truth.field, float(np.degrees(truth.dip)))
    run = stations(plan.inclination, plan.azimuth, plan.toolface, earth=earth)
    raw = channels(readings.accelerometer, readings.magnetometer)
    return {**run, "temperature_c": plan.temperature, **raw}


def simulated(plan, seed):
    truth = plans.servo(np.random.default_rng(SEED))
    return columns(plans.run(truth, plan, np.random.default_rng(seed)), plan, truth)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A calibration of the sound tool, and the run of its fit."""
    folder = tmp_path_factory.mktemp("fit")
    run = simulated(PLAN, 1)
    return calibrated(folder, run), run


def roll(folder, *metadata, name="roll.csv", **changes):
    """A roll test at 45° with channels changed by functions of all of its columns."""
    run = simulated(ROLL, 2)
    changed = {k: v(run) for k, v in changes.items()}
    return write_csv(folder / name, {**run, **changed}, *metadata)


def test_rows_fit_a_page_where_no_terminal_folds_them(fitted, tmp_path):
    """Notes go on below; nothing is cut."""
    (calibration, _), few = fitted, {k: v[:4] for k, v in simulated(ROLL, 2).items()}
    shown = mwdcal("verify", calibration, write_csv(tmp_path / "few.csv", few)).out
    assert max(map(len, shown.splitlines())) <= 120
    assert "…" not in shown
    assert shown.split().count("toolfaces") >= 5


def judged(calibration, run, *options):
    ran = mwdcal("verify", calibration, run, "--json", *options)
    assert ran.code in (0, 1), ran
    result = ran.json
    assert result["passed"] == (ran.code == 0) == all(r["passed"] for r in result["rows"])
    return {row["name"]: row for row in result["rows"]}


def failed(rows):
    return {name for name, row in rows.items() if not row["passed"]}


def limits(folder, text):
    path = folder / "limits.toml"
    path.write_text(f'name = "own"\n{text}')
    return path


def turned(axis, degrees):
    """Channels of both triads on a sensor block turned by a small angle about a tool axis."""
    angle = degrees * DEG
    i, j = [k for k in range(3) if k != axis]
    matrix = np.eye(3)
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)

    def channel(names, index):
        return lambda run: np.stack([run[n] for n in names], -1) @ matrix[index]

    groups = (("ax", "ay", "az"), ("mx", "my", "mz"))
    return {names[k]: channel(names, k) for names in groups for k in range(3)}


def test_an_unchanged_tool_passes(tmp_path, fitted):
    rows = judged(fitted[0], roll(tmp_path))
    assert set(rows) == {
        *("spread of inclination", "spread of azimuth", "spread of gravity"),
        *("error of inclination", "error of azimuth"),
    }
    assert all(0 < row["uncertainty"] < row["limit"] / 4 for row in rows.values())


def test_accelerometer_bias_of_5_mg_on_x(tmp_path, fitted):
    """Along x, gravity is -sin I sin T: inclination moves by ∓5 mg·cos I, |g| by ∓5 mg·sin I.

    At 45° both amplitudes are 3.54e-3: a spread of 0.405° and 7.07 mg, an error of 0.203°.
    """
    rows = judged(fitted[0], roll(tmp_path, ax=lambda r: r["ax"] + 5e-3 * SCALE[0]))
    assert {"spread of inclination", "spread of gravity"} <= failed(rows)
    assert "error of inclination" not in failed(rows)
    assert rows["spread of inclination"]["value"] == pytest.approx(0.405, abs=0.04)
    assert rows["spread of gravity"]["value"] == pytest.approx(7.07e-3, abs=0.6e-3)


def readbacks(size):
    """Reference columns as an encoder shows them, to four decimals: uniform within ± size degrees."""
    rng = np.random.default_rng(5)
    names = ("ref_inclination_deg", "ref_azimuth_deg")
    return {
        n: lambda r, n=n: np.round(r[n] + rng.uniform(-size, size, len(r[n])), 4) for n in names
    }


@pytest.mark.parametrize("bias_g", [0.0, 5e-3])
def test_readbacks_of_an_encoder_judge_as_exact_references_do(tmp_path, fitted, bias_g):
    """A bias of 5 mg across the axis spreads the inclination by 2 · 5 mg · cos 45° = 0.41°."""
    biased = {"ax": lambda r: r["ax"] + bias_g * SCALE[0]}
    exact = mwdcal("verify", fitted[0], roll(tmp_path, **biased), "--json")
    path = roll(tmp_path, name="read.csv", **biased, **readbacks(0.02))
    read = mwdcal("verify", fitted[0], path, "--json")
    assert read.code == exact.code == int(bias_g > 0)
    rows, others = ({row["name"]: row for row in each.json["rows"]} for each in (read, exact))
    assert rows.keys() == others.keys()
    assert rows["spread of inclination"]["value"] == pytest.approx(
        np.degrees(2 * bias_g * np.cos(np.pi / 4)), abs=0.04
    )
    for name, row in rows.items():
        assert row["value"] == pytest.approx(others[name]["value"], abs=3 * row["uncertainty"])


def test_a_verdict_names_limits_that_were_not_judged_and_states_no_risk(tmp_path, fitted):
    """Readbacks too far apart are no roll set: a bias of 5 mg passes the limits on errors alone."""
    apart = roll(tmp_path, ax=lambda r: r["ax"] + 4e-3 * SCALE[0], **readbacks(0.15))
    verdict, page = tmp_path / "verdict.json", tmp_path / "page.html"
    shown = mwdcal("verify", fitted[0], apart, "-o", verdict, "--report", page).out
    names = "spread of inclination, spread of azimuth, spread of gravity"
    document = json.loads(verdict.read_text())
    assert document["not_judged"] == names.split(", ")
    assert document["risk"] is None
    assert f"(not judged: {names})" in shown.splitlines()[0]
    assert "together: not stated, as limits were not judged" in shown
    assert "3 not judged" in page.read_text()
    issued = mwdcal("certificate", fitted[0], "--verification", verdict, "-o", tmp_path / "c.json")
    assert f"(not judged: {names})" in issued.out
    assert (
        json.loads((tmp_path / "c.json").read_text())["as_left"]["not_judged"]
        == document["not_judged"]
    )


def test_no_risk_is_stated_where_one_station_was_disturbed(tmp_path, fitted):
    """A sound tool fails by one wrong reading: no figure of the readings says how likely that is."""

    def disturbed(run):
        return run["ax"] + 0.01 * SCALE[0] * (np.arange(len(run["ax"])) == 3)

    verdict = mwdcal("verify", fitted[0], roll(tmp_path, ax=disturbed), "--json")
    assert verdict.code == 1
    assert verdict.json["risk"] is None
    raw = [row for row in verdict.json["rows"] if "raw figure judged" in row["note"]]
    assert raw
    assert {row["probability_within"] for row in raw} == {None}


def test_magnetometer_bias_of_1500_nt_on_x(tmp_path, fitted):
    """Azimuth moves by 1500 nT over the horizontal 48000·cos 63° nT, times x's part to the east.

    x turns in the plane across the tool axis, whose part to the east at azimuth 60° is
    √(cos²60° + cos²45°·sin²60°) = 0.79: 3.12° of error, a spread of 6.2°.
    """
    rows = judged(fitted[0], roll(tmp_path, mx=lambda r: r["mx"] + 1500 * SCALE[1]))
    assert failed(rows) == {"spread of azimuth", "error of azimuth"}
    assert rows["spread of azimuth"]["value"] == pytest.approx(6.23, abs=0.4)
    assert rows["error of azimuth"]["value"] == pytest.approx(3.12, abs=0.3)


def test_accelerometer_scale_of_z_by_one_percent(tmp_path, fitted):
    """At every toolface alike: no spread, but an error of 0.01·sin 45°·cos 45° rad = 0.286°.

    |g| grows by 0.01·cos²45° = 5 mg, which only a limit on its error can see.
    """
    run = roll(tmp_path, az=lambda r: 1.01 * r["az"])
    rows = judged(fitted[0], run)
    assert failed(rows) == {"error of inclination"}
    assert rows["error of inclination"]["value"] == pytest.approx(0.286, abs=0.02)
    rows = judged(fitted[0], run, "--limits", limits(tmp_path, "[error]\ngravity_g = 0.003"))
    assert failed(rows) == {"error of gravity"}
    assert rows["error of gravity"]["value"] == pytest.approx(5.0e-3, abs=0.5e-3)


def test_sensor_block_turned_by_half_a_degree_about_x(tmp_path, fitted):
    """The axis leans by 0.5° in the plane y-z: inclination ±0.5°, azimuth ±0.5°/sin 45°; |g| stays."""
    rows = judged(fitted[0], roll(tmp_path, **turned(0, 0.5)))
    assert failed(rows) == {"spread of inclination", "error of inclination", "spread of azimuth"}
    assert rows["spread of inclination"]["value"] == pytest.approx(1.0, abs=0.05)
    assert rows["error of inclination"]["value"] == pytest.approx(0.5, abs=0.03)
    assert rows["spread of azimuth"]["value"] == pytest.approx(1.414, abs=0.2)


def test_sensor_block_turned_about_the_tool_axis(tmp_path, fitted):
    """Only toolface moves: the roll-test limits cannot see it, a limit on toolface does."""
    run = roll(tmp_path, **turned(2, 0.5))
    assert not failed(judged(fitted[0], run))
    rows = judged(fitted[0], run, "--limits", limits(tmp_path, "[error]\ntoolface_deg = 0.25"))
    assert rows["error of toolface"]["value"] == pytest.approx(0.5, abs=0.04)
    assert failed(rows) == {"error of toolface"}


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("bias_g", [0.0, 5e-3])
def test_tables_to_a_verdict_in_one_command_are_the_two_commands(tmp_path, fitted, bias_g):
    run = write_csv(tmp_path / "run.csv", fitted[1])
    test = roll(tmp_path, ax=lambda r: r["ax"] + bias_g * SCALE[0])
    alone, both = tmp_path / "alone.json", tmp_path / "both.json"
    mwdcal("calibrate", run, "--tool", "servo", "-o", alone)
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", both, "--rolltest", test, "--json",
                 "--report", tmp_path / "page.html")  # fmt: skip
    verdict = mwdcal("verify", both, test, "--json", "--report", tmp_path / "verified.html")
    assert ran.code == verdict.code == int(bias_g > 0)
    stated = ran.json["verification"]
    assert stated == {name: verdict.json[name] for name in stated}
    first, second = (json.loads(path.read_text()) for path in (alone, both))
    assert {**first, "time": "", "sha256": ""} == {**second, "time": "", "sha256": ""}
    assert (tmp_path / "page.html").read_bytes() == (tmp_path / "verified.html").read_bytes()
    shown = mwdcal("calibrate", run, "--tool", "servo", "-o", both, "--rolltest", test)
    assert ("FAIL" in shown.out) == ("next: mwdcal diagnose" in shown.out) == (bias_g > 0)
    assert shown.out.startswith("FAIL" if bias_g else "PASS")
    assert shown.out.rstrip().splitlines()[-1].startswith("next: " if bias_g else "wrote ")


def test_a_toolface_zero_that_is_left_open_stands_in_the_table_of_a_pass(tmp_path, fitted):
    bare = {n: v for n, v in fitted[1].items() if n != "ref_toolface_deg"}
    run = write_csv(tmp_path / "run.csv", bare)
    command = ("--tool", "servo", "-o", tmp_path / "a.json", "--rolltest", roll(tmp_path))
    ran = mwdcal("calibrate", run, *command)
    assert ran.code == 0
    assert re.search(r"^toolface .* open +zero undetermined$", ran.out, re.MULTILINE)
    assert "zero undetermined" not in mwdcal("calibrate", write_csv(run, fitted[1]), *command).out


def test_a_roll_test_of_the_fit_itself_leaves_no_file(tmp_path, fitted):
    run = write_csv(tmp_path / "run.csv", fitted[1])
    ran = mwdcal("calibrate", run, "-o", tmp_path / "c.json", "--rolltest", run)
    assert "all its stations are of the run" in refused(ran, 2)
    assert not (tmp_path / "c.json").exists()


def test_the_guarded_rule_takes_twice_the_uncertainty_off(tmp_path, fitted):
    """A value just under its limit passes the simple rule and fails the guarded one."""
    run = roll(tmp_path)
    row = judged(fitted[0], run)["error of azimuth"]
    limit = f"[error]\nazimuth_deg = {row['value'] + row['uncertainty']:.9f}"
    assert not failed(judged(fitted[0], run, "--limits", limits(tmp_path, limit)))
    guarded = limits(tmp_path, f'rule = "guarded"\n{limit}')
    assert failed(judged(fitted[0], run, "--limits", guarded)) == {"error of azimuth"}


NUMBERS = ("raw", "value", "uncertainty", "limit")


@pytest.mark.parametrize(("knock", "asked"), [(40e-3, True), (3.5e-3, False)])
def test_a_tool_far_beyond_its_limits_is_doubted_before_the_readings(
    tmp_path, fitted, knock, asked
):
    """Across the axis at 45°: a spread of 2 · 40 mg · cos 45° = 3.2°, or 0.28°, where the limit is 0.1°."""
    said = mwdcal("verify", fitted[0], roll(tmp_path, ax=lambda r: r["ax"] + knock * SCALE[0]))
    first = next(line for line in said.out.splitlines() if "measure again: " in line)
    assert said.code == 1
    assert first.startswith("first check: is it this tool") is asked


@pytest.mark.parametrize(("toolfaces", "more"), [(4, True), (6, False)])
def test_too_few_toolfaces_are_not_asked_for_again(tmp_path, fitted, toolfaces, more):
    """Four do not show the second harmonic; the six that are asked for instead do."""
    run = simulated(plans.grid([45], toolfaces, [60], [25.0]), 2)
    run["ax"] = run["ax"] + 5e-3 * SCALE[0]
    said = mwdcal("verify", fitted[0], write_csv(tmp_path / "roll.csv", run))
    (again,) = (line for line in said.out.splitlines() if "measure again: " in line)
    assert again.endswith(", at six or more toolfaces, evenly spread") is more
    assert ("add toolfaces between them" in said.err) is more


def test_the_text_holds_the_numbers_of_the_json(tmp_path, fitted):
    run = roll(tmp_path, ax=lambda r: r["ax"] + 5e-3 * SCALE[0])
    said = mwdcal("verify", fitted[0], run)
    assert said.code == 1
    assert said.out.startswith("FAIL   roll.csv   12 stations")
    shown = " ".join(said.out.split())  # notes go on below
    for name, row in judged(fitted[0], run).items():
        gap = "" if row["unit"] == "°" else " "
        numbers = [f"{row[k]:.3g}{gap}{row['unit']}" for k in NUMBERS]
        places = 1 - int(f"{row['uncertainty']:.1e}".partition("e")[2])
        for where, key in enumerate(NUMBERS[:3]):  # two digits of the uncertainty
            numbers[where] = f"{row[key]:.{places}f}{gap}{row['unit']}"
        numbers.insert(3, "∞")  # degrees of freedom of a declared noise
        word = "pass" if row["passed"] else "FAIL"
        assert f"{name} {' '.join(numbers)} {word} {row['note']}" in shown


@pytest.mark.parametrize("toolfaces", [[40] * 12, [0, 5, 10]], ids=["one", "three close ones"])
@pytest.mark.parametrize("references", [True, False], ids=["references", "group"])
def test_a_knocked_tool_that_was_not_rolled_never_exits_with_0(
    tmp_path, fitted, toolfaces, references
):
    """Knocked by 8 mg and 600 nT along x: rolled it fails, at one toolface it looks good."""
    still = plans.StationPlan(
        *(np.full(len(toolfaces), v) for v in (45 * DEG, 60 * DEG, 0.0, 25.0))
    )
    run = simulated(dataclasses.replace(still, toolface=np.array(toolfaces) * DEG), 5)
    run = {**run, "ax": run["ax"] + 8e-3 * SCALE[0], "mx": run["mx"] + 600 * SCALE[1]}
    if not references:
        run = {k: v for k, v in run.items() if not k.startswith("ref_")}
        run["group"] = ["A"] * len(toolfaces)
    ran = mwdcal("verify", fitted[0], write_csv(tmp_path / "still.csv", run))
    assert ran.code == 1
    assert ran.out.startswith("FAIL ")
    shown = " ".join(ran.out.split())
    assert shown.count("cannot be passed") == (5 if references else 3)
    assert "Add toolfaces there" in shown
    assert "nan" not in shown


COPIES = {
    "the run itself": lambda run: run,
    "other labels": lambda run: {**run, "station": [f"new {i}" for i in range(48)]},
    "other order": lambda run: {k: v[::-1] for k, v in run.items()},
    "other references": lambda run: {**run, "ref_azimuth_deg": run["ref_azimuth_deg"] + 7},
    "no references": lambda run: {k: v for k, v in run.items() if not k.startswith("ref_")},
    "a column more": lambda run: {**run, "sd_ax": np.full(48, 1e-3), "note": ["x"] * 48},
    "other temperatures": lambda run: {**run, "temperature_c": np.full(48, 25.5)},
    "a part": lambda run: {k: v[20:30] for k, v in run.items()},
    "other digits": lambda run: {k: [f"{x:+.17e}" for x in v] for k, v in run.items()},
}


@pytest.mark.parametrize("copy", COPIES.values(), ids=COPIES)
def test_data_of_the_fit_cannot_verify_it(tmp_path, fitted, copy):
    message = refused(
        mwdcal("verify", fitted[0], write_csv(tmp_path / "c.csv", copy(fitted[1]))), 2
    )
    assert "were in the fit" in message


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx", ".tsv"])
def test_data_of_the_fit_in_another_format_cannot_verify_it(tmp_path, fitted, suffix):
    path = tmp_path / f"copy{suffix}"
    if suffix == ".parquet":
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(arrow.table(fitted[1]), path)
    elif suffix == ".xlsx":
        book = pytest.importorskip("openpyxl").Workbook()
        book.active.append(list(fitted[1]))
        for row in zip(*(np.asarray(v).tolist() for v in fitted[1].values()), strict=True):
            book.active.append(row)
        book.save(path)
    else:
        write_csv(path, fitted[1], delimiter="\t")
    assert "48 of 48 stations were in the fit" in refused(mwdcal("verify", fitted[0], path), 2)


def test_data_of_the_fit_with_decimal_commas_cannot_verify_it(tmp_path, fitted):
    text = {k: [repr(x.item()).replace(".", ",") for x in v] for k, v in fitted[1].items()}
    path = write_csv(tmp_path / "copy.csv", text, delimiter=";")
    assert "48 of 48" in refused(mwdcal("verify", fitted[0], path, "--decimal", ","), 2)


def test_one_common_station_is_one_too_many(tmp_path, fitted):
    fresh = simulated(ROLL, 3)
    mixed = {k: np.concatenate([fresh[k], fitted[1][k][17:18]]) for k in fresh}
    message = refused(mwdcal("verify", fitted[0], write_csv(tmp_path / "m.csv", mixed)), 2)
    assert "1 of 13 stations were in the fit" in message
    assert "station 18" in message


def test_data_of_the_fit_without_magnetometer_cannot_verify_it(tmp_path, fitted):
    bare = {k: v for k, v in fitted[1].items() if not k.startswith("m")}
    refused(mwdcal("verify", fitted[0], write_csv(tmp_path / "m.csv", bare)), 2)


def test_a_limit_on_an_undetermined_direction_cannot_be_passed(tmp_path):
    """No toolface reference: the zero of toolface is free, whatever the roll test shows.

    The spread of the error of toolface does not move with that zero and passes.
    """
    run = simulated(PLAN, 1)
    run["ref_toolface_deg"] = np.full(48, np.nan)
    calibration = calibrated(tmp_path, run)
    entries = json.loads(calibration.read_bytes())["accelerometer"]["undetermined"]
    assert [e["id"] for e in entries] == ["toolface-zero"]
    test = write_csv(tmp_path / "roll.csv", simulated(ROLL, 8))
    names = ("inclination", "azimuth", "toolface", "dip")
    kinds = "\n".join(
        [f"[{kind}]\n" + "\n".join(f"{n}_deg = 90" for n in names) for kind in ("spread", "error")]
    )
    rows = judged(calibration, test, "--limits", limits(tmp_path, kinds))
    assert failed(rows) == {"error of toolface"}
    row = rows["error of toolface"]
    assert row["uncertainty"] is None
    assert "cannot be passed" in row["note"]
    assert row["value"] < 5
    assert rows["spread of toolface"]["uncertainty"] > 0
    said = mwdcal("verify", calibration, test, "--limits", tmp_path / "limits.toml")
    assert said.code == 1
    assert "! accelerometer and magnetometer: toolface zero is undetermined" in said.err
    assert said.err.count("toolface zero is undetermined") == 1
    assert "not stated" in next(s for s in said.out.splitlines() if s.startswith("error of toolf"))
    opened = "FAIL: nothing wrong was found; the calibration leaves toolface zero open   roll.csv"
    assert said.out.startswith(opened)
    assert "measure again" not in said.out
    advice = "not determined: toolface zero. Give reference toolfaces in the calibration run"
    assert (
        f"{advice}\nnext: mwdcal calibrate RUN -o {calibration}   (with these references)"
        in said.out
    )
    machine = mwdcal(
        "verify", calibration, test, "--limits", tmp_path / "limits.toml", "--json"
    ).json
    assert machine["passed"] is False
    assert advice[1:] in machine["findings"][-1]["text"]


def test_a_calibration_without_reference_inclinations_leaves_rotations_open(tmp_path):
    """The first line does not call the tool bad; a bad tool fails as before."""
    run = simulated(PLAN, 1)
    for name in ("inclination", "azimuth", "toolface"):
        run[f"ref_{name}_deg"] = np.full(48, np.nan)
    calibration = calibrated(tmp_path, run)
    opened = json.loads(calibration.read_bytes())["accelerometer"]["undetermined"]
    assert {"rotation-x", "rotation-y"} <= {entry["id"] for entry in opened}
    assert "each with a name in the column 'group'" in opened[0]["text"]
    roll = simulated(ROLL, 8)
    said = mwdcal("verify", calibration, write_csv(tmp_path / "roll.csv", roll))
    assert said.code == 1
    assert said.out.startswith(
        "FAIL: nothing wrong was found; the calibration leaves rotation about x and y open"
    )
    shown = " ".join(said.out.split())
    assert "cannot be passed: the calibration does not determine rotation about x and y" in shown
    assert "not determined: rotation about x and y. Give reference inclinations in the" in said.out
    knocked = {**roll, "ax": roll["ax"] + 30e-3 * SCALE[0]}
    said = mwdcal("verify", calibration, write_csv(tmp_path / "k.csv", knocked))
    assert said.out.startswith("FAIL   k.csv")
    assert "next: mwdcal diagnose" in said.out


LIMITS = {
    "unknown name": ("roll-tset", "Did you mean 'roll-test'?"),
    "no limit": ('name = "x"\n', "sets no limit"),
    "unknown key": ('name = "x"\n[spread]\ninclination = 1\n', "is not a limits profile"),
    "unknown rule": ('name = "x"\nrule = "kind"\n[spread]\ndip_deg = 1\n', "not a limits profile"),
    "zero": ('name = "x"\n[spread]\ndip_deg = 0\n', "must be positive"),
    "nan": ('name = "x"\n[spread]\ndip_deg = nan\n', "must be positive"),
    "infinite": ('name = "x"\n[spread]\ndip_deg = inf\n', "must be positive"),
    "no TOML": ("\x00\xff", "is not a limits profile"),
    "a folder": (".", "is not a limits profile"),
}


@pytest.mark.parametrize(("text", "part"), LIMITS.values(), ids=LIMITS)
def test_limits_that_cannot_be_meant(tmp_path, fitted, text, part):
    path = tmp_path / "limits.toml"
    path.write_text(text, "latin-1")
    named = path if len(text) > 9 or "\x00" in text else text
    ran = mwdcal("verify", fitted[0], roll(tmp_path), "--limits", named)
    assert part in refused(ran, 2)


def test_a_test_that_no_limit_applies_to_is_refused(tmp_path, fitted):
    run = {k: v[:2] for k, v in simulated(ROLL, 2).items() if not k.startswith("ref_")}
    message = refused(mwdcal("verify", fitted[0], write_csv(tmp_path / "r.csv", run)), 2)
    assert "no limit of 'roll-test' applies" in message


def test_a_test_of_the_same_soak_is_not_refused(tmp_path, fitted):
    """The calibration has no temperature terms and was made at 25 °C."""
    run = {**simulated(ROLL, 2), "temperature_c": np.full(12, 27.5)}
    ran = mwdcal("verify", fitted[0], write_csv(tmp_path / "r.csv", run))
    assert ran.code == 0
    assert "12 of 12 stations (27.5 °C) lie outside the calibrated range 25.0 °C" in ran.err
    out = tmp_path / "o.csv"
    warned = mwdcal("apply", fitted[0], tmp_path / "r.csv", "-o", out).err
    assert warned.count("!") == 2
    assert "no serial in the calibration and r.csv" in warned
    assert "12 of 12 rows lie outside the calibrated range 25.0…25.0 °C by up to 2.5 °C" in warned


def test_a_test_outside_the_calibrated_temperatures_is_refused(tmp_path, fitted):
    run = {**simulated(ROLL, 2), "temperature_c": np.full(12, 40.0)}
    message = refused(mwdcal("verify", fitted[0], write_csv(tmp_path / "r.csv", run)), 2)
    assert "outside the calibrated range, good for 20.0…30.0 °C" in message


def test_a_roll_test_outside_the_calibrated_temperatures_leaves_the_calibration(tmp_path, fitted):
    """The file and the screen are those of the fit alone; the reason ends the command, and is in page and JSON."""
    run = write_csv(tmp_path / "run.csv", fitted[1])
    test = write_csv(tmp_path / "r.csv", {**simulated(ROLL, 2), "temperature_c": np.full(12, 40.0)})
    alone, both, page = (tmp_path / name for name in ("alone.json", "both.json", "page.html"))
    fit = mwdcal("calibrate", run, "--tool", "servo", "-o", alone)
    command = ("calibrate", run, "--tool", "servo", "-o", both, "--rolltest", test)
    ran = mwdcal(*command, "--report", page)
    verified = mwdcal("verify", both, test)
    assert ran.code == verified.code == 2
    reason = verified.err.strip().removeprefix("mwdcal: ")
    assert f"mwdcal: not verified: {reason}" in ran.err
    assert "good for 20.0…30.0 °C" in ran.out
    assert "good for 20.0…30.0 °C" in reason
    assert fit.out.partition("\nwrote")[0] == ran.out.partition("\nwrote")[0]
    assert f"Not verified: {reason}" in unescape(page.read_text("utf-8"))
    first, second = (json.loads(path.read_text()) for path in (alone, both))
    assert {**first, "time": "", "sha256": ""} == {**second, "time": "", "sha256": ""}
    document = mwdcal(*command, "--json")
    assert document.code == 2
    assert "verification" not in document.json
    assert {"id": "not-verified", "text": f"not verified: {reason}"} in [
        {key: finding[key] for key in ("id", "text")} for finding in document.json["findings"]
    ]


def test_limits_that_cannot_be_read_are_refused_before_the_fit(tmp_path, fitted):
    run, out = write_csv(tmp_path / "run.csv", fitted[1]), tmp_path / "c.json"
    command = ("--tool", "servo", "-o", out, "--rolltest", roll(tmp_path), "--limits", "no.toml")
    assert "no.toml" in refused(mwdcal("calibrate", run, *command), 2)
    assert not out.exists()


def test_a_test_without_temperatures_cannot_verify_temperature_terms(tmp_path):
    calibration = calibrated(tmp_path, servo_run(temperatures=(0.0, 50.0)), "--order", 1)
    run = {k: v for k, v in servo_run(seed=2, inclinations=(45,)).items() if k != "temperature_c"}
    message = refused(mwdcal("verify", calibration, write_csv(tmp_path / "r.csv", run)), 2)
    assert "'temperature_c' is missing" in message


def test_a_report_does_not_replace_what_it_reports_on(tmp_path, fitted):
    run = roll(tmp_path)
    for path in (run, fitted[0]):
        before = path.read_bytes()
        refused(mwdcal("verify", fitted[0], run, "--report", path), 2)
        assert path.read_bytes() == before
