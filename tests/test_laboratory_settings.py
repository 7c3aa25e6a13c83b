"""`mwdcal.toml` and `mwdcal init`: what commands take from it, what comes first, what they record."""

import hashlib
import json
import os
import tomllib

import numpy as np
import pytest

import mwdcal as library
from cli_support import EXAMPLE, mwdcal, read_csv, refused, servo_run, write_csv
from terminal import at_terminal

SETTINGS = """
tool = "tools/servo.toml"
limits = "limits.toml"
decision = "guarded"
[stand]
inclination_deg = 0.013
azimuth_deg = 0.07
settings = "per-station"
[[standards]]
quantity = "stand"
name = "Rotary table 3"
certificate = "C-118"
due = 2027-01-31
"""
PROFILE = """
name = "a servo tool"
[accelerometer]
scale = 3.0
noise = 3e-4
[magnetometer]
scale = 5e-5
noise = 7.5e-4
[stand]
azimuth_deg = 0.02
"""
LIMITS = 'name = "ours"\n[error]\ninclination_deg = 0.1\n'


@pytest.fixture
def laboratory(tmp_path, monkeypatch):
    """The folder of a laboratory, with a run and a roll test in a folder below; commands run elsewhere."""
    home, job = tmp_path / "laboratory", tmp_path / "laboratory" / "2026" / "job"
    (home / "tools").mkdir(parents=True)
    job.mkdir(parents=True)
    (home / "mwdcal.toml").write_text(SETTINGS, "utf-8")
    (home / "tools" / "servo.toml").write_text(PROFILE, "utf-8")
    (home / "limits.toml").write_text(LIMITS, "utf-8")
    write_csv(job / "run.csv", servo_run(1), 'serial = "T1"', "date = 2026-05-01")
    write_csv(job / "roll.csv", servo_run(1, (30,)), 'serial = "T1"', "date = 2027-05-01")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return home


def line_of(ran):
    """The one line on the settings."""
    (line,) = [each for each in ran.err.splitlines() if each.startswith("settings of ")]
    return line


def test_a_calibration_takes_and_records_the_settings_above_its_table(laboratory, tmp_path):
    run, cal = laboratory / "2026" / "job" / "run.csv", tmp_path / "cal.json"
    ran = mwdcal("calibrate", run, "-o", cal, "--json")
    assert ran.code == 0, ran
    record, path = library.load(cal), laboratory / "mwdcal.toml"
    assert (record.profile.name, record.profile.accelerometer.scale) == ("a servo tool", 3.0)
    stand = record.profile.stand
    assert (stand.inclination_deg, stand.azimuth_deg, stand.settings) == (
        0.013,
        0.02,
        "per-station",
    )
    assert record.profile.standards[0].certificate == "C-118"
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    for place in (json.loads(cal.read_text("utf-8")), ran.json):
        assert (place["settings_file"], place["settings_sha256"]) == (str(path), digest)
    said = line_of(ran)
    assert str(path) in said
    assert "tool, stand.inclination_deg, stand.settings, standards" in said
    assert "not stand.azimuth_deg (the tool profile's own)" in said
    assert "limits" not in said


def test_a_verdict_takes_limits_and_rule(laboratory, tmp_path):
    job, cal = laboratory / "2026" / "job", tmp_path / "cal.json"
    mwdcal("calibrate", job / "run.csv", "-o", cal)
    ran = mwdcal("verify", cal, job / "roll.csv", "--json")
    assert "settings_file" not in ran.json, "the calibration lies elsewhere"
    cal.rename(job / "cal.json")
    ran = mwdcal("verify", job / "cal.json", job / "roll.csv", "--json")
    assert (ran.json["limits"], ran.json["rule"][:7]) == ("ours", "guarded")
    assert "standard-overdue" in [finding["id"] for finding in ran.json["findings"]]
    assert ran.json["settings_file"] == str(laboratory / "mwdcal.toml")
    typed = mwdcal("verify", job / "cal.json", job / "roll.csv", "--limits", "moradi", "--json")
    assert (typed.json["limits"], typed.json["rule"][:7]) == ("moradi", "guarded")
    assert "not limits (given as --limits)" in line_of(typed)
    own = laboratory / "own.toml"
    own.write_text(LIMITS.replace("[error]", 'rule = "simple"\n[error]'), "utf-8")
    typed = mwdcal("verify", job / "cal.json", job / "roll.csv", "--limits", own, "--json")
    assert typed.json["rule"].startswith("simple")
    assert "decision (the limits profile's own)" in line_of(typed)


def test_the_stand_decides_how_honest_the_numbers_are(laboratory, tmp_path):
    run = laboratory / "2026" / "job" / "run.csv"
    with_stand = mwdcal("calibrate", run, "-o", tmp_path / "a.json", "--json").json
    (laboratory / "mwdcal.toml").unlink()
    without = mwdcal("calibrate", run, "-o", tmp_path / "b.json", "--tool", "servo", "--json").json
    assert (
        with_stand["accuracy_1sigma_deg"]["inclination"]
        > without["accuracy_1sigma_deg"]["inclination"]
    )
    assert "settings_file" not in without


def test_an_overdue_reference_is_a_finding(laboratory, tmp_path):
    text = SETTINGS.replace("2027-01-31", "2026-04-30")
    (laboratory / "mwdcal.toml").write_text(text, "utf-8")
    run = laboratory / "2026" / "job" / "run.csv"
    ran = mwdcal("calibrate", run, "-o", tmp_path / "cal.json")
    assert "the stand standard Rotary table 3 was due on 2026-04-30, before 2026-05-01" in ran.err


def test_settings_of_the_current_folder_serve_commands_without_a_table(laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    ran = mwdcal("plan", "--plan", "moosavi-12", "--order", "0", "--json")
    assert ran.json["settings_file"] == str(laboratory / "mwdcal.toml")
    assert "tool, stand.inclination_deg" in line_of(ran)


def test_python_reads_no_settings(laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    assert library.load_profile("generic").stand.azimuth_deg == 0.0


def test_keys_are_not_trusted_because_they_come_with_the_data(laboratory, tmp_path, monkeypatch):
    ran = mwdcal("certificate", "key", "create", "-o", laboratory / "lab.key", "--owner", "L")
    assert ran.code == 0, ran
    (laboratory / "mwdcal.toml").write_text('keys = ["lab.key.pub"]\n', "utf-8")
    job = laboratory / "2026" / "job"
    mwdcal("calibrate", job / "run.csv", "-o", job / "cal.json")
    assert (
        mwdcal("certificate", "sign", job / "cal.json", "--key", laboratory / "lab.key").code == 0
    )
    assert mwdcal("certificate", "verify", job / "cal.json").code == 2
    monkeypatch.chdir(job)
    assert mwdcal("certificate", "verify", "cal.json").code == 0


def test_units_that_nothing_else_tells(laboratory, tmp_path):
    """Depths of a column MD in feet, and temperatures that may be of either scale."""
    (laboratory / "mwdcal.toml").write_text(
        'length_unit = "ft"\ntemperature_unit = "°F"\n', "utf-8"
    )
    job = laboratory / "2026" / "job"
    run = dict(read_csv(EXAMPLE / "run.csv"))
    warm = np.full(len(run["ax"]), 77.0)
    run = {"Temp": warm, **{k: v for k, v in run.items() if k != "temperature_c"}}
    write_csv(job / "warm.csv", run)
    ran = mwdcal("profile", job / "warm.csv", "-o", tmp_path / "tool.toml")
    assert ran.code == 0, ran
    assert (
        tomllib.loads((tmp_path / "tool.toml").read_text("utf-8"))["columns"]["temperature_c"][
            "unit"
        ]
        == "°F"
    )
    assert "temperature_unit" in line_of(ran)
    mwdcal(
        "calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", "-o", job / "cal.json"
    )
    well = dict(read_csv(EXAMPLE / "well.csv"))
    metres = np.array([float(cell) for cell in well["md_m"]])
    feet = {
        ("MD" if k == "md_m" else k): (metres / 0.3048 if k == "md_m" else v)
        for k, v in well.items()
    }
    write_csv(job / "feet.csv", feet, "simulated = true")
    write_csv(job / "metres.csv", well, "simulated = true")
    for name in ("feet", "metres"):
        ran = mwdcal("survey", job / "cal.json", job / f"{name}.csv", "-o", job / f"{name}_out.csv")
        assert ran.code == 0, ran
    one, other = (read_csv(job / f"{name}_out.csv")["tvd_ft"] for name in ("feet", "metres"))
    np.testing.assert_allclose([float(x) for x in one], [float(x) for x in other], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense = 1", "unknown field `nonsense`"),
        ("[stand]\nazimuth_deg = -1", "must be between 0 and 180"),
        ('[[standards]]\nquantity = "stand"\nname = " "', "must have a name"),
        ("= 1", "not a settings file"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_their_file(laboratory, tmp_path, text, said):
    (laboratory / "mwdcal.toml").write_text(text, "utf-8")
    run = laboratory / "2026" / "job" / "run.csv"
    message = refused(mwdcal("calibrate", run, "-o", tmp_path / "cal.json"), 2)
    assert "mwdcal.toml" in message
    assert said in message


ANSWERS = (
    *("--stand", "inclination_deg=0.01,azimuth_deg=0.04,toolface_deg=0.02"),
    *("--settings", "per-station", "--decision", "guarded", "--limits", "moradi"),
    *("--reference", "stand=Rotary table 3,C-118,2027-01-31; field=Proton,F-2,2026-12-01"),
    *("--tool", "servo", "--registry", "tools.sqlite", "--key", "a.pub,b.pub"),
    *("--length-unit", "ft", "--temperature-unit", "°F"),
)


def test_init_writes_what_options_answer(tmp_path):
    ran = mwdcal("init", tmp_path, *ANSWERS, "--json")
    assert ran.code == 0, ran
    written = tomllib.loads((tmp_path / "mwdcal.toml").read_text("utf-8"))
    assert written["stand"] == {
        "inclination_deg": 0.01, "azimuth_deg": 0.04, "toolface_deg": 0.02, "settings": "per-station"
    }  # fmt: skip
    assert [each["name"] for each in written["standards"]] == ["Rotary table 3", "Proton"]
    assert (written["keys"], written["registry"]) == (["a.pub", "b.pub"], "tools.sqlite")
    assert ran.json["settings"]["limits"] == "moradi"
    assert "exists" in refused(mwdcal("init", tmp_path, *ANSWERS), 2)
    assert mwdcal("init", tmp_path, "--defaults", "--replace").code == 0


def test_init_prints_all_questions_without_a_terminal(tmp_path):
    ran = mwdcal("init", tmp_path, "--tool", "servo")
    assert ran.code == 3
    assert "9 questions are open" in ran.err
    for option in ("--stand", "--settings", "--reference", "--limits", "--temperature-unit"):
        assert f"\n{option} " in ran.err
    assert not (tmp_path / "mwdcal.toml").exists()


@pytest.mark.parametrize(
    ("option", "text"),
    [("--decision", "maybe"), ("--stand", "azimuth=1"), ("--reference", "stand"), ("--tool", "nix"),
     ("--reference", "moon=A,B,2027-01-01"), ("--reference", "stand=A,B,soon"), ("--stand", "azimuth_deg=-1")],
)  # fmt: skip
def test_init_refuses_an_impossible_answer(tmp_path, option, text):
    refused(mwdcal("init", tmp_path, option, text, "--defaults"), 2)
    assert not (tmp_path / "mwdcal.toml").exists()


@pytest.mark.skipif(os.name == "nt", reason="a pseudo-terminal")
def test_init_asks_on_a_terminal(tmp_path):
    """Ten questions: an impossible answer is asked again, the return key takes the default."""
    typed = ["azimuth_deg=x", "azimuth_deg=0.3", "", "", "", "guarded", "", "", "", "ft", ""]
    code, screen = at_terminal(["init", str(tmp_path)], typed)
    assert code == 0, screen
    written = tomllib.loads((tmp_path / "mwdcal.toml").read_text("utf-8"))
    assert written["stand"] == {"azimuth_deg": 0.3, "settings": "per-direction"}
    assert (written["decision"], written["length_unit"], written["temperature_unit"]) == (
        "guarded",
        "ft",
        "°C",
    )
    assert "expected one of inclination_deg" in screen


def test_a_certificate_takes_a_verification_that_was_made_by_the_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in (
        "example demo",
        "init --defaults",
        "calibrate demo/run.csv --tool demo/tool.toml -o tool.json",
    ):
        assert mwdcal(*line.split()).code == 0
    verdict = mwdcal("verify", "tool.json", "demo/rolltest.csv", "--json")
    assert json.loads(verdict.out)["settings_file"]
    (tmp_path / "test.json").write_text(verdict.out, "utf-8")
    order = ("--verification", "test.json", "--laboratory", "demo/laboratory.toml", "-o", "C.json")
    assert mwdcal("certificate", "tool.json", *order).code == 0
