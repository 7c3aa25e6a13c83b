"""Inputs that a technician gets wrong: each answer names what is wrong and what to do, or nothing is said to be right.

The tables are those of a laboratory under names of its own, made by the forward model of `simulation`.
"""

from dataclasses import replace

import numpy as np
import openpyxl
import pytest

import mwdcal as library
from cli_support import (
    SCALE,
    SERVO_NOISE,
    channels,
    mwdcal,
    read_csv,
    refused,
    servo_run,
    stations,
    write_csv,
)
from mwdcal.use.roll_test import RollTest
from simulation import DEG, Tool, plan

NAMES = {
    "station": "Pos.", "temperature_c": "Temp (°C)", "ax": "Accel X (V)", "ay": "Accel Y (V)", "az": "Accel Z (V)",
    "mx": "Fluxgate X (V)", "my": "Fluxgate Y (V)", "mz": "Fluxgate Z (V)",
    "ref_inclination_deg": "Gimbal tilt (°)", "ref_azimuth_deg": "Gimbal heading (°)",
    "ref_toolface_deg": "Gimbal roll (°)", "ref_gravity_g": "Local G (g)", "ref_field_nt": "Btotal (nT)",
    "ref_dip_deg": "Dip (°)",
}  # fmt: skip


def named(columns, **others):
    """A table under the laboratory's names; None takes a column away, another name changes it."""
    names = {**NAMES, **others}
    return {names[n]: column for n, column in columns.items() if names[n]}


def measured(inclinations, toolfaces, noise=2, scatter=0.0, azimuth=None, tool=None):
    """A run of the tool of `servo_run`, with other noise; `scatter` of the stand's inclinations, degrees."""
    tool = tool or Tool.random(1, noise=SERVO_NOISE)
    inc, azi, face = plan(inclinations, toolfaces)
    azi = azi if azimuth is None else np.full(len(inc), azimuth)
    rng = np.random.default_rng(noise)
    shown = inc + np.radians(scatter) * rng.normal(size=len(inc))
    g, b = (v[0] for v in tool.readings(rng, 1, shown, azi, face))
    earth = (tool.gravity, tool.field, tool.dip / DEG)
    warmth = np.full(len(inc), 25.0)
    return {**stations(inc, azi, face, earth=earth, temperature_c=warmth), **channels(g, b)}


def rolled(noise=2, scatter=0.0):
    """A roll test in one direction."""
    return measured((60,), 24, noise, scatter, azimuth=1.0)


def workbook(path, **sheets):
    """A workbook with a table on each sheet."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, columns in sheets.items():
        sheet = book.create_sheet(name)
        sheet.append([*columns])
        for row in zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True):
            sheet.append(row)
    book.save(path)
    return path


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder with a run, the profile proposed for it, its calibration and a table of readings of a well."""
    folder = tmp_path_factory.mktemp("laboratory")
    run = write_csv(folder / "run.csv", named(servo_run()))
    assert mwdcal("profile", run, "-o", folder / "tool.toml").code == 0
    ran = mwdcal("calibrate", run, "--tool", folder / "tool.toml", "-o", folder / "cal.json")
    assert ran.code == 0, ran
    well = {n: c for n, c in measured((5, 30, 60), 8).items() if not n.startswith("ref_")}
    write_csv(folder / "well.csv", {**named(well), "Depth (m)": np.arange(24) * 10.0})
    return folder


def changed(folder, name, **columns):
    """The table of the well with other columns; None takes one away, a text renames it."""
    table = {n: np.array(c, float) for n, c in read_csv(folder / "well.csv").items()}
    for column, new in columns.items():
        old = table.pop(NAMES.get(column, column))
        if isinstance(new, str):
            table[new] = old
        elif new is not None:
            table[NAMES.get(column, column)] = new
    return write_csv(folder / f"{name}.csv", table)


def test_a_reference_in_a_thousandth_of_its_unit_is_remarked(tmp_path):
    """As a workbook keeps µT below a heading in nT: the tool is sound, and its field is 50,000 nT."""
    run = {n: c for n, c in servo_run().items() if n != "ref_field_nt"}
    for stated, remarked in (("50.123", True), ("50123", False), ("50.123 uT", False)):
        path = workbook(tmp_path / "run.xlsx", Cal=named(run))
        book = openpyxl.load_workbook(path)
        book["Cal"].insert_rows(1)
        in_micro = stated.endswith("uT")
        book["Cal"]["A1"] = "Magnetic field" if in_micro else "Magnetic field (nT)"
        book["Cal"]["B1"] = stated if in_micro else float(stated)
        book.save(path)
        ran = mwdcal("profile", path, "-o", tmp_path / f"{remarked}{stated}.toml", "--json")
        said = findings(ran)
        assert ("reference-rescaled" in said) is remarked
        if remarked:
            assert "50.123" in said["reference-rescaled"]
            assert "50123 nT" in said["reference-rescaled"]


def test_a_text_among_readings_of_a_well_is_asked_about_with_what_to_do(laboratory, tmp_path):
    well = {n: [*c] for n, c in read_csv(laboratory / "well.csv").items()}
    well = {n.replace("Accel", "Accelerometer"): c for n, c in well.items()}
    cal, output = laboratory / "cal.json", ("-o", tmp_path / "o.csv")
    well["Accelerometer Y (V)"][5] = "spike"
    message = refused(mwdcal("survey", cal, write_csv(tmp_path / "w.csv", well), *output), 2, 3)
    assert "got 'spike'" in message
    assert "Or empty it: --missing blank then leaves the results of its row blank." in message
    well["Accelerometer Y (V)"][5] = ""
    table = write_csv(tmp_path / "w.csv", well)
    ran = mwdcal("survey", cal, table, *output, "--missing", "blank", "--json")
    assert ran.code == 0, ran
    assert "1 of 24 rows lack a reading" in ran.err


# ------------------------------------------------------------------------------- a channel is missing


def test_a_number_of_the_row_is_never_proposed_as_a_channel(tmp_path):
    run = write_csv(tmp_path / "run.csv", named(servo_run(), az=None))
    message = refused(mwdcal("profile", run, "-o", tmp_path / "t.toml"), 3)
    assert "accelerometers (az)" in message
    assert "the channel is missing" in message
    assert "--column" not in message
    message = refused(mwdcal("profile", run, "-o", tmp_path / "t.toml", "--column", "az=Pos."), 3)
    assert "'Pos.' as az cannot be" in message
    assert not (tmp_path / "t.toml").exists()


@pytest.mark.parametrize("noise", [300.0, 0.01])
def test_a_channel_that_was_said_is_tested_by_the_strength_of_gravity(tmp_path, noise):
    """Neither large nor small random numbers are on a sphere with the other two; the channel itself is."""
    run = servo_run()
    other = np.random.default_rng(1).normal(size=48) * noise
    run = write_csv(tmp_path / "run.csv", {**named(run, az="Third"), "Fourth": other})
    said = ("--column", "az=Fourth")
    assert "cannot be" in refused(mwdcal("profile", run, "-o", tmp_path / "t.toml", *said), 3)
    ran = mwdcal("profile", run, "-o", tmp_path / "t.toml", "--column", "az=Third")
    assert ran.code == 0, ran
    assert library.load_profile(tmp_path / "t.toml").columns["az"].name == "Third"


@pytest.mark.parametrize("command", ["survey", "apply"])
def test_a_missing_channel_of_a_well_is_named_with_the_other_columns(laboratory, command):
    well = changed(laboratory, "lacking", ax=None)
    message = refused(mwdcal(command, laboratory / "cal.json", well, "-o", laboratory / "o.csv"), 3)
    assert "no column for ax (in the run 'Accel X (V)')" in message
    assert "its others are 'Depth (m)'" in message
    assert "Accel Y" not in message


@pytest.mark.parametrize("command", ["survey", "apply"])
def test_a_channel_of_another_name_in_a_well_is_read_and_named(laboratory, command):
    well = changed(laboratory, "renamed", ax="Gx [V]")
    ran = mwdcal(command, laboratory / "cal.json", well, "-o", laboratory / "o.csv")
    assert ran.code == 0, ran
    assert "ax = 'Gx [V]'" in ran.err


# ------------------------------------------------------- what a table lacks without being refused


def findings(ran):
    assert ran.code in (0, 1), ran
    return {each["id"]: each["text"] for each in ran.json["findings"]}


@pytest.mark.parametrize("command", ["survey", "apply", "verify"])
def test_a_table_without_temperatures_is_not_in_the_calibrated_range_for_sure(laboratory, command):
    cal, output = laboratory / "cal.json", ("-o", laboratory / "o.csv")
    write_csv(laboratory / "roll.csv", named(rolled()))
    for warm in (True, False):
        table = changed(laboratory, "cold", **({} if warm else {"temperature_c": None}))
        if command == "verify":
            table = write_csv(
                laboratory / "cold.csv", named(rolled(), **({} if warm else {"temperature_c": ""}))
            )
        ran = mwdcal(command, cal, table, *(() if command == "verify" else output), "--json")
        assert ("temperature-unknown" in findings(ran)) is not warm
        assert warm or "25.0" in findings(ran)["temperature-unknown"]


def test_a_well_without_depths_is_said_to_have_no_path(laboratory):
    for name, lacks in (("whole", False), ("flat", True)):
        well = changed(laboratory, name, **({"Depth (m)": None} if lacks else {}))
        ran = mwdcal("survey", laboratory / "cal.json", well, "-o", laboratory / "o.csv", "--json")
        assert ("no-path" in findings(ran)) is lacks
    assert "measured depth" in findings(ran)["no-path"]


# ------------------------------------------------------------------------------------- left-handed


@pytest.mark.parametrize(
    ("signs", "said"),
    [((-1, -1, -1), False), ((1, 1, -1), True), (None, True)],
    ids=["upwards", "one reversed", "exchanged"],
)
def test_a_left_handed_accelerometer_alone_is_said_unless_it_counts_upwards(tmp_path, signs, said):
    run = servo_run()
    if signs is None:
        run["ax"], run["ay"] = run["ay"], run["ax"]
    else:
        for axis, sign in zip("xyz", signs, strict=True):
            run[f"a{axis}"] = sign * run[f"a{axis}"]
    ran = mwdcal("profile", write_csv(tmp_path / "r.csv", run), "-o", tmp_path / "t.toml", "--json")
    assert ("left-handed" in findings(ran)) is said


def test_azimuths_half_a_turn_off_are_a_cause_beside_the_sign_of_the_dip(tmp_path):
    """A field turned by 180° of azimuth and of opposite dip is the field reversed; the table's azimuths are off."""
    run = servo_run()
    run["ref_azimuth_deg"] = (run["ref_azimuth_deg"] + 180) % 360
    out = "-o", tmp_path / "t.toml"
    message = refused(mwdcal("profile", write_csv(tmp_path / "r.csv", run), *out), 3)
    assert "all azimuths of the stand are 180° off, or the sign of the dip is wrong" in message
    run["ref_dip_deg"] = -run["ref_dip_deg"]
    ran = mwdcal("profile", write_csv(tmp_path / "s.csv", run), *out, "--json")
    assert "all azimuths of the stand are 180° off" in findings(ran)["left-handed"]


@pytest.mark.parametrize(
    ("turn", "names", "said"),
    [
        (0, NAMES, False),
        (180, NAMES, True),
        (90, NAMES, False),
        (180, {"ax": "Accel 1 (V)"}, False),
    ],
)
def test_a_tool_turned_in_the_stand_is_named_where_channels_say_their_axes(
    tmp_path, turn, names, said
):
    """The stand's toolface is `turn` less than the tool's."""
    run = servo_run()
    run["ref_toolface_deg"] = (run["ref_toolface_deg"] - turn) % 360
    table = write_csv(tmp_path / "r.csv", named(run, **names))
    answers = ["--column", "ax=Accel 1 (V)"] if "1" in names["ax"] else []
    ran = mwdcal("profile", table, "-o", tmp_path / "t.toml", "--json", *answers)
    found = findings(ran)
    assert ("turned-about-z" in found) is said
    assert not said or "turned by 180°" in found["turned-about-z"]


@pytest.mark.parametrize("name", ["ref_toolface_deg", "ref_azimuth_deg"])
@pytest.mark.parametrize(("first", "last"), [(8, 15), (0, 2)])
def test_an_angle_half_a_turn_off_at_some_stations_is_named_with_their_rows(
    tmp_path, name, first, last
):
    """Names stand in line 1 of the file, station 0 in line 2."""
    run = servo_run()
    run[name][first : last + 1] = (run[name][first : last + 1] + 180) % 360
    table = write_csv(tmp_path / "r.csv", named(run))
    message = refused(mwdcal("profile", table, "-o", tmp_path / "t.toml"), 3)
    where = f"'{NAMES[name]}' is 180° off from line {first + 2} to line {last + 2}, and fits"
    assert where in message


# --------------------------------------------------------------------------------------- roll test


@pytest.mark.parametrize("inclinations", [(5, 30, 60), (60,)], ids=["well", "azimuths"])
def test_stations_of_several_directions_are_no_roll_test(laboratory, inclinations):
    table = {n: c for n, c in measured(inclinations, 9).items() if not n.startswith("ref_")}
    table = write_csv(laboratory / "several.csv", named(table))
    message = refused(mwdcal("verify", laboratory / "cal.json", table), 2)
    assert "several.csv is no roll test" in message
    assert "60." in message


def test_a_well_is_no_roll_test_whatever_its_temperatures_and_a_part_of_a_turn_neither(laboratory):
    """In each soak the inclination changes by little; over the well it goes from 20 to 60°."""
    well = measured((20, 24, 28, 52, 56, 60), 8)
    warmth = np.repeat([20.0, 30.0], 24)
    part = {n: c[:12] for n, c in rolled().items()}
    for name, table, said in (
        ("well", {**well, "temperature_c": warmth}, "several directions"),
        ("part", part, "the toolfaces leave a gap of 195°"),
    ):
        table = {n: c for n, c in table.items() if not n.startswith("ref_")}
        file = write_csv(laboratory / f"{name}-of-a-turn.csv", named(table))
        message = refused(mwdcal("verify", laboratory / "cal.json", file), 2)
        assert "is no roll test, in which the tool is rolled all round" in message
        assert said in message


def test_vectors_of_a_rolled_tool_lie_in_a_plane_whatever_one_reading_says():
    """Scales, biases and exchanged axes keep them there; a single wrong reading is not the set's."""
    roll = rolled()
    g, b = (np.stack([roll[f"{kind}{axis}"] for axis in "xyz"], -1) for kind in "am")
    g, b = g / SCALE[0], b / SCALE[1]
    g[4], b[4] = -g[4], -b[4]
    for matrix in (np.eye(3), np.diag([1.3, 0.9, 1.0])[[2, 0, 1]]):
        test = RollTest(None, library.readings(g @ matrix, b))
        test.__dict__["fields"] = g @ matrix + 0.2, b @ matrix + 5000
        assert test.off_plane(np.arange(24)) < 0.001
    assert np.linalg.svd(g - g.mean(0), compute_uv=False)[2] > 0.2


def test_the_declared_error_of_settings_counts_where_no_angle_is_given(tmp_path):
    """Settings drawn with the 0.2° declared: spread and 1σ are those of the same readings with angles."""
    tool, cal = tmp_path / "tool.toml", tmp_path / "cal.json"
    axes = 'axes = ["+x", "+y", "+z"]'
    tool.write_text(
        f'name = "servo"\n[accelerometer]\n{axes}\nscale = 3.0\nnoise = 3e-4\n[magnetometer]\n{axes}\n'
        'scale = 5e-5\nnoise = 7.5e-4\n[stand]\nsettings = "per-station"\ninclination_deg = 0.2\n'
    )
    run = write_csv(tmp_path / "run.csv", servo_run())
    assert mwdcal("calibrate", run, "--tool", tool, "-o", cal).code == 0
    roll = rolled(scatter=0.2)
    rows = []
    for known in (True, False):
        lacks = () if known else ("ref_inclination_deg", "ref_azimuth_deg")
        table = {n: c for n, c in roll.items() if n not in lacks}
        ran = mwdcal("verify", cal, write_csv(tmp_path / "roll.csv", table), "--json")
        assert ran.code in (0, 1), ran
        rows += [r for r in ran.json["rows"] if r["name"] == "spread of inclination"]
    given, unknown = rows
    assert "raw figure" not in unknown["note"]
    for each in ("value", "uncertainty", "raw"):
        assert unknown[each] == pytest.approx(given[each], rel=1e-6)
    assert 0.2 * np.sqrt(5 / 24) / 2 < unknown["uncertainty"] < 2 * 0.2 * np.sqrt(5 / 24)


def test_the_only_other_sheet_like_that_of_the_run_is_its_roll_test(tmp_path):
    book = workbook(tmp_path / "a.xlsx", Cal=named(servo_run()), Sheet2=named(rolled()))
    tool, cal = tmp_path / "tool.toml", tmp_path / "cal.json"
    assert "--sheet" in refused(mwdcal("profile", book, "-o", tool), 3)
    assert mwdcal("profile", book, "--sheet", "Cal", "-o", tool).code == 0
    ran = mwdcal("calibrate", book, "--tool", tool, "--rolltest", book, "-o", cal, "--json")
    assert ran.code == 0, ran
    assert ran.json["verification"]["stations"] == 24
    more = workbook(
        tmp_path / "b.xlsx", Cal=named(servo_run()), A=named(rolled()), B=named(rolled(noise=3))
    )
    both = ("calibrate", more, "--tool", tool, "--rolltest", more, "-o", cal)
    ran = mwdcal(*both)
    assert ran.code == 2, ran
    assert "--rolltest-sheet A or --rolltest-sheet B" in ran.err
    assert "If it is not among them, name another file." in ran.err
    said = mwdcal("profile", more, "--sheet", "Cal", "-o", tmp_path / "more.toml").err
    assert "with --rolltest b.xlsx --rolltest-sheet A." in said
    assert mwdcal(*both, "--rolltest-sheet", "A").code == 0


# -------------------------------------------------------------------------- one file for another


def test_a_file_of_another_kind_is_named_with_what_is_wanted(laboratory, tmp_path):
    run, tool, cal = (laboratory / name for name in ("run.csv", "tool.toml", "cal.json"))
    output = ("-o", tmp_path / "out.json")
    book = workbook(tmp_path / "book.xlsx", Cal=named(servo_run()))
    asked = {
        ("calibrate", run, tool, *output): "Is it the tool profile? --tool",
        ("calibrate", run, run, *output): "Is it the roll test? --rolltest",
        ("plan", "four-by-six"): "Is it a plan? --plan",
        ("calibrate", book, "--tool", book, *output): "mwdcal profile book.xlsx -o tool.toml",
        ("calibrate", run, "--tool", cal, *output): "cal.json is no tool profile",
        ("apply", tool, run, "-o", tmp_path / "o.csv"): "Calibrate a run with it first",
        ("verify", cal, run): "on another sheet of this one",
        ("survey", cal, run, "--date", "28.11.2026", "-o", tmp_path / "o.csv"): "such as 2026-11-28",
    }  # fmt: skip
    for arguments, words in asked.items():
        assert words in refused(mwdcal(*arguments), 2, 3), arguments


def test_a_file_that_no_profile_reads_is_no_matter_of_the_profile(laboratory, tmp_path):
    tool, output = laboratory / "tool.toml", ("-o", tmp_path / "out.json")
    whole = (laboratory / "well.csv").read_text("utf-8")
    book = workbook(tmp_path / "book.xlsx", Cal=named(servo_run())).read_bytes()
    (tmp_path / "cut.xlsx").write_bytes(book[:3000])
    (tmp_path / "cut.csv").write_text(whole[: len(whole) // 2], "utf-8")
    (tmp_path / "page.xls").write_text("<html></html>")
    for name in ("absent.csv", "cut.xlsx", "cut.csv", "page.xls"):
        message = refused(mwdcal("calibrate", tmp_path / name, "--tool", tool, *output), 2)
        assert "[columns]" not in message, name


def test_what_both_triads_leave_free_is_said_once(tmp_path):
    run = {n: c for n, c in servo_run().items() if n != "ref_toolface_deg"}
    run, cal = write_csv(tmp_path / "run.csv", run), tmp_path / "cal.json"
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", cal).code == 0
    ran = mwdcal("verify", cal, write_csv(tmp_path / "roll.csv", rolled()))
    assert ran.err.count("toolface zero is undetermined") == 1
    assert "accelerometer and magnetometer: toolface zero" in ran.err


def test_gravity_that_nobody_states_is_no_fault(tmp_path):
    """The laboratory's gravity is 1.4 mg above 1 g, and the table of the well states none: the tool is sound."""
    tool = replace(Tool.random(1, noise=SERVO_NOISE), gravity=1.0014)
    run = write_csv(tmp_path / "run.csv", servo_run(tool=tool))
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json").code == 0
    well = measured((5, 30, 60, 90), 6, tool=tool)
    well = {n: c for n, c in well.items() if not n.startswith("ref_")}
    ran = mwdcal(
        "diagnose", tmp_path / "cal.json", write_csv(tmp_path / "well.csv", well), "--json"
    )
    assert ran.code == 0, ran
    assert "1.0014 g" in findings(ran)["assumed-gravity"]


def test_a_channel_that_stands_still_is_named(tmp_path):
    run = write_csv(tmp_path / "run.csv", named({**servo_run(), "ay": np.full(48, 0.125)}))
    message = refused(mwdcal("profile", run, "-o", tmp_path / "t.toml"), 3)
    assert "ay of the accelerometer" in message
    assert "48 stations" in message
