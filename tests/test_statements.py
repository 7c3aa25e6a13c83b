"""Statements of a user about a run, and one table for run and roll test, into a registry."""

import json

import numpy as np
import pytest

import mwdcal as library
from cli_support import EXAMPLE, mwdcal, refused, servo_run, write_csv

SAID = ("--serial", "MWD-17", "--date", "2026-03-14", "--operator", "A. Borg")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A run, a roll test and readings of one tool, of which the tables say nothing."""
    folder = tmp_path_factory.mktemp("files")
    run = write_csv(folder / "run.csv", servo_run(1))
    roll = write_csv(folder / "roll.csv", servo_run(1, (30,)))
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", folder / "cal.json", *SAID)
    assert ran.code == 0, ran
    return folder / "cal.json", run, roll


def test_calibrate_records_what_is_said(files):
    record = library.load(files[0])
    assert record.serial == "MWD-17"
    assert (record.tool["date"], record.tool["operator"]) == ("2026-03-14", "A. Borg")
    assert "no-serial" not in [finding.id for finding in record.findings]


def test_verify_apply_and_survey_take_it(files, tmp_path):
    cal, _, roll = files
    ran = mwdcal("verify", cal, roll, *SAID, "--json")
    assert ran.json["date"] == "2026-03-14"
    assert "no-serial" not in [finding["id"] for finding in ran.json["findings"]]
    out = tmp_path / "out.csv"
    for command in ("apply", "survey"):
        ran = mwdcal(command, cal, roll, "-o", out, *SAID, "--json")
        assert ran.code == 0, ran
        assert ran.json["serial"] == "MWD-17"
        assert '# operator = "A. Borg"' in out.read_text("utf-8")
    long = write_csv(
        tmp_path / "long.csv", {k: np.tile(v, 1500) for k, v in servo_run(1, (30,)).items()}
    )
    assert long.stat().st_size > 1_000_000, "taken in parts"
    ran = mwdcal("apply", cal, long, "-o", out, *SAID)
    assert ran.code == 0, ran
    assert '# serial = "MWD-17"' in out.read_text("utf-8")[:2000]


def test_the_table_states_otherwise(files, tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(1), 'serial = "OTHER"', "date = 2026-03-14")
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json", *SAID)
    assert library.load(tmp_path / "cal.json").serial == "MWD-17"
    assert "run.csv states the serial OTHER; MWD-17, as given, is used." in ran.err
    assert "states the date" not in ran.err


def test_of_two_tools_in_one_table_the_one_named_is_taken(tmp_path):
    first, second = servo_run(1), servo_run(2)
    both = {name: np.concatenate([first[name], second[name]]) for name in first}
    count = len(first["ax"])
    table = write_csv(tmp_path / "both.csv", {"serial": ["A-1"] * count + ["B-2"] * count, **both})
    assert "more than one tool" in refused(
        mwdcal("calibrate", table, "--tool", "servo", "-o", tmp_path / "c.json"), 2
    )
    for serial, alone in (("A-1", first), ("B-2", second)):
        cal, clean = tmp_path / f"{serial}.json", tmp_path / "clean.json"
        ran = mwdcal("calibrate", table, "--tool", "servo", "-o", cal, "--serial", serial)
        assert ran.code == 0, ran
        plain = write_csv(tmp_path / "alone.csv", alone)
        mwdcal("calibrate", plain, "--tool", "servo", "-o", clean)
        for one, other in zip(library.load(cal).triads, library.load(clean).triads, strict=True):
            assert one.parameters == other.parameters
        assert library.load(cal).serial == serial
    none = mwdcal("calibrate", table, "--tool", "servo", "-o", tmp_path / "c.json", "--serial", "C")
    assert "has 'A-1', 'B-2'" in refused(none, 2)


MARKS = {
    "a column of that name": ("Roll test", "", "yes"),
    "crosses": ("rolltest", "", "x"),
    "a kind": ("Purpose", "cal", "roll test"),
    "German": ("Art", "Kalibrierung", "Prüfung"),
    "numbers": ("Verification", "0", "1"),
}


@pytest.mark.parametrize("case", MARKS)
def test_a_column_marks_the_roll_test(tmp_path, case):
    """The verdict is that of two tables; no station of the roll test is in the fit."""
    name, no, yes = MARKS[case]
    run, roll = servo_run(1), servo_run(1, (30,))
    counts = len(run["ax"]), len(roll["ax"])
    both = {k: np.concatenate([run[k], roll[k]]) for k in run}
    table = write_csv(tmp_path / "all.csv", {**both, name: [no] * counts[0] + [yes] * counts[1]})
    ran = mwdcal(
        "calibrate",
        table,
        "--tool",
        "servo",
        "-o",
        tmp_path / "a.json",
        "--rolltest",
        table,
        "--json",
    )
    assert ran.code == 0, ran
    parts = [write_csv(tmp_path / f"{k}.csv", each) for k, each in enumerate((run, roll))]
    apart = mwdcal(
        "calibrate",
        parts[0],
        "--tool",
        "servo",
        "-o",
        tmp_path / "b.json",
        "--rolltest",
        parts[1],
        "--json",
    )
    later = mwdcal("verify", tmp_path / "a.json", table, "--json")
    assert later.json["rows"] == ran.json["verification"]["rows"]
    assert ran.json["stations"] == counts[0]
    assert ran.json["verification"]["stations"] == counts[1]
    rows = [
        [(r["name"], r["value"]) for r in each.json["verification"]["rows"]]
        for each in (ran, apart)
    ]
    assert rows[0] == rows[1]


def test_a_table_without_marks_is_no_roll_test_of_itself(files, tmp_path):
    run = files[1]
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "c.json", "--rolltest", run)
    assert "no column marks a roll test in it" in refused(ran, 2)
    columns = {**servo_run(1), "Check": ["x", *[""] * 47], "Use": ["cal", "check", *["cal"] * 46]}
    table = write_csv(tmp_path / "two.csv", columns)
    ran = mwdcal(
        "calibrate", table, "--tool", "servo", "-o", tmp_path / "c.json", "--rolltest", table
    )
    assert "'Check' and 'Use' mark different rows" in refused(ran, 2)


@pytest.mark.parametrize("by", ["option", "settings"])
def test_one_command_to_the_entry_in_a_registry(tmp_path, by):
    pytest.importorskip("sqlalchemy")
    for name in ("run.csv", "rolltest.csv", "tool.toml"):
        (tmp_path / name).write_bytes((EXAMPLE / name).read_bytes())
    database = tmp_path / "tools.sqlite"
    line = ("calibrate", tmp_path / "run.csv", "--tool", tmp_path / "tool.toml", "-o", tmp_path / "tool.json",
            "--rolltest", tmp_path / "rolltest.csv")  # fmt: skip
    if by == "settings":
        (tmp_path / "mwdcal.toml").write_text('registry = "tools.sqlite"\n', "utf-8")
    option = ("--registry", database) if by == "option" else ()
    assert "no such file" in refused(mwdcal(*line, *option), 2)
    assert not (tmp_path / "tool.json").exists()
    assert mwdcal("registry", "--registry", database, "init").code == 0
    ran = mwdcal(*line, *option)
    assert ran.code == 0, ran
    with library.registry(database) as tools:
        kinds = [row.kind for row in tools.history("SIM-0001").rows]
        assert sorted(kinds) == ["calibration", "run", "run", "verification"]
        assert (
            tools.latest("SIM-0001").sha256
            == json.loads((tmp_path / "tool.json").read_text("utf-8"))["sha256"]
        )
        assert tools.check().findings == []
