"""`mwdcal plan`: what it says of a plan, the sheet that it writes, and what it refuses."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest

import mwdcal as library
from cli_support import EXAMPLE, RAW, SCALE, SERVO_NOISE, mwdcal, refused, servo_run, write_csv
from simulation import DEG, Tool

ATTITUDE = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
ONE_ATTITUDE = "name = 'one'\n[[stations]]\ninclination_deg = [45, 45, 45, 45, 45, 45]\n"
MILLION = "name = 'million'\n[[stations]]\n" + "".join(
    f"{angle}_deg = {list(range(100))}\n" for angle in ("inclination", "azimuth", "toolface")
)


def filled(sheet, seed):
    """A run sheet with the readings of a simulated tool, which its profile says nothing of."""
    with sheet.open(encoding="utf-8") as stream:
        lines = stream.readlines()
    head = [line for line in lines if line.startswith("#")]
    rows = list(csv.DictReader(lines[len(head) :]))
    angles = np.radians([[float(row[name]) for name in ATTITUDE] for row in rows]).T
    tool = Tool.random(seed, noise=SERVO_NOISE, field=48_000.0, dip=63 * DEG)
    rng = np.random.default_rng(seed)
    # the stand of the profile: 0.01 and 0.05° of a setting, which neighbours in one direction share, and 0.02°
    setting = np.cumsum(np.any(np.diff(angles[:2], prepend=np.nan) != 0, axis=0)) - 1
    off = np.array([[0.01], [0.05], [0.02]]) * DEG * rng.normal(size=angles.shape)
    off = angles + np.concatenate([off[:2, setting], off[2:]])
    for triad, (readings, scale) in enumerate(zip(tool.readings(rng, 1, *off), SCALE, strict=True)):
        for row, reading in zip(rows, readings[0] * scale, strict=True):
            row.update(
                zip(RAW[3 * triad : 3 * triad + 3], map(repr, reading.tolist()), strict=True)
            )
            row |= {"ref_field_nt": "48000", "ref_dip_deg": "63"}
    run = sheet.with_name("run.csv")
    with run.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(["# simulated = 'yes'\n".replace("'", '"')])
        writer = csv.DictWriter(stream, [*rows[0]])
        writer.writeheader()
        writer.writerows(rows)
    return run


@pytest.mark.parametrize("seed", range(3))
def test_a_filled_sheet_gives_the_accuracy_that_the_plan_stated(tmp_path, seed):
    sheet = tmp_path / "plan.csv"
    planned = mwdcal("plan", "--stations", 24, "--tool", "servo", "-o", sheet, "--json").json
    run = filled(sheet, seed)
    arguments = (run, "--tool", "servo", "--order", 0, "-o", tmp_path / "cal.json", "--json")
    made = mwdcal("calibrate", *arguments).json
    for kind in ("accelerometer", "magnetometer"):
        triad = made["triads"][kind]
        assert (triad["rank"], triad["size"]) == (planned[kind]["rank"], planned[kind]["size"])
    scale = [
        made["triads"][kind]["variance_factor"] ** 0.5 for kind in ("accelerometer", "magnetometer")
    ]
    for angle, stated in planned["accuracy_deg"].items():
        # s is not known better than to 1 / √(2 · 60), and the tool departs from nominal by 5 %
        low, high = 0.85 * min(scale), 1.15 * max(scale)
        assert low < made["accuracy_1sigma_deg"][angle] / stated < high


def test_a_plan_names_what_it_leaves_free():
    shown = mwdcal("plan", "--plan", "roll-test", "--tool", "servo", "--method", "scalar")
    assert shown.code == 3
    document = mwdcal(
        "plan", "--plan", "moosavi-12", "--tool", "servo", "--method", "scalar", "--json"
    ).json
    assert document["rank"] < document["size"]
    assert {entry["id"] for entry in document["undetermined"]} >= {"toolface-zero"}
    assert document["accuracy_deg"]["azimuth"] is None


def test_plans_side_by_side():
    names = ("six-state", "twelve-state")
    plans = [word for name in names for word in ("--plan", name)]
    document = mwdcal("plan", *plans, "--tool", "servo", "--json").json
    both = [document, *document["others"]]
    assert [each["stations"] for each in both] == [6, 12]
    assert [each["plan"] for each in both] == list(names)
    assert 0 < both[0]["efficiency_bound"] <= 1
    shown = mwdcal("plan", *plans, "--tool", "servo").out
    assert "six-state" in shown
    assert "nothing measured" in shown


def test_the_fewest_stations_for_an_accuracy():
    wanted = ("--accuracy", "azimuth_deg=0.04", "--accuracy", "inclination_deg=0.02")
    document = mwdcal("plan", *wanted, "--tool", "servo", "--json").json
    reached = document["accuracy_by_inclination_deg"]
    assert max(reached["azimuth"]) <= 0.04
    assert max(reached["inclination"]) <= 0.02
    count = document["stations"]
    assert document["fewest_stations"] <= count
    said = {finding["id"] for finding in document["findings"]}
    assert ("fewer-may-do" in said) is (document["fewest_stations"] < count)
    fewer = mwdcal("plan", "--stations", count - 1, "--tool", "servo", "--json").json
    assert max(fewer["accuracy_by_inclination_deg"]["azimuth"]) > 0.04


def test_a_plan_shows_its_redundancy(tmp_path):
    """On the screen, in the document and on the sheet: 15 equations for 12 parameters are 3 degrees of freedom."""
    arguments = ("plan", "--stations", 5, "--tool", "servo")
    shown = mwdcal(*arguments, "--report", tmp_path / "sheet.html")
    assert "degrees of freedom" in shown.out
    assert "calibrate cannot trace" in shown.err
    document = mwdcal(*arguments, "--json").json
    assert document["accelerometer"]["degrees_of_freedom"] < 3
    errors = {each["observable"]: each for each in document["detectable_errors"]}
    assert set(errors) == {"inclination", "azimuth", "toolface", "gravity", "field", "dip"}
    assert errors["inclination"]["named"] is None
    assert errors["inclination"]["noticed"] > 0.05
    assert "calibrate cannot trace" in (tmp_path / "sheet.html").read_text("utf-8")


def test_a_search_keeps_to_what_the_stand_reaches(tmp_path):
    sheet = tmp_path / "plan.csv"
    reach = ("--reach", "inclination_deg=0:90", "--reach", "azimuth_deg=0:0")
    limited = mwdcal(
        "plan", "--stations", 12, *reach, "--tool", "servo", "-o", sheet, "--json"
    ).json
    with sheet.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert len(rows) == 12
    assert {float(row["ref_azimuth_deg"]) for row in rows} == {0.0}
    assert max(float(row["ref_inclination_deg"]) for row in rows) <= 90
    free = mwdcal("plan", "--stations", 12, "--tool", "servo", "--json").json
    squares = [
        {angle: np.square(sd) for angle, sd in each["accuracy_by_inclination_deg"].items()}
        for each in (limited, free)
    ]
    # The search minimises the mean of the angles' variances: one angle alone may gain by less reach.
    assert np.mean([sd.mean() / squares[1][angle].mean() for angle, sd in squares[0].items()]) > 1
    for angle in ("inclination", "azimuth"):
        assert squares[0][angle].max() > squares[1][angle].max()


def test_the_next_stations_of_a_run_are_better_than_others(tmp_path):
    run = tmp_path / "run.csv"
    mwdcal("plan", "--plan", "six-state", "--tool", "servo", "-o", run)
    arguments = ("--measured", run, "--tool", "servo", "--criterion", "D", "--json")
    more = mwdcal("plan", "--stations", 6, *arguments).json
    again = mwdcal("plan", "--plan", "twelve-state", "--tool", "servo", "--json").json
    sd = [
        np.array(list(each["accelerometer"]["standard_uncertainties"].values()))
        for each in (more, again)
    ]
    assert more["stations"] == 6
    assert np.log(sd[0]).sum() < np.log(sd[1]).sum()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--plan", "nine-state"), 2, "twelve-state"),
        (("--plan", "one.toml"), 3, "would read the same at all 6 stations"),
        (("--plan", "empty.toml"), 2, "this one has 0"),
        (("--plan", "bare.toml"), 2, "'toolface_deg' belongs below a line [[stations]]."),
        (("--plan", "million.toml"), 2, "this one has 1000000"),
        (("--plan", "million.toml", "--stations", 24), 2, "this one has 1000000"),
        (
            ("--plan", "moosavi-12", "--reach", "inclination_deg=0:100"),
            2,
            "station 37, 38, 39, 40, 41 and 7 more lie",
        ),
        (
            ("--plan", "moosavi-12", "--reach", "azimuth_deg=0:0"),
            2,
            "the stand reaches azimuth 0:0°",
        ),
        (("--stations", 12, "--reach", "inclination_deg=7:8"), 2, "no candidate is within"),
        (("--stations", 200, "--reach", "azimuth_deg=0:0"), 2, "the 84 candidates"),
        (("--reach", "inclination_deg=120"), 2, "such as inclination_deg=0:120"),
        (("--reach", "roll=0:1"), 2, "--reach must be of inclination"),
        (("--measured", "accelerometer.csv"), 2, "no column mx"),
        (("--accuracy", "inclination_deg=1", "--method", "scalar"), 2, "undetermined"),
        (("--stations", 505), 2, "between 1 and the 504 candidates"),
        (("--stations", 3), 3, "stations"),
        (("--stations", 12, "--plan", "six-state", "--plan", "moosavi-12"), 2, "Name it alone"),
        (("--accuracy", "azimuth_deg=0"), 2, "such as azimuth_deg=0.1"),
        (("--accuracy", "roll=1"), 2, "inclination, toolface, azimuth"),
        (("--accuracy", "azimuth_deg=0.0001"), 2, "do not give the wanted accuracy"),
        (("--speed", 0), 2, "--speed"),
        (("--measured", "nothing.csv"), 2, "nothing.csv"),
    ],
)
def test_what_cannot_be_planned_ends_in_one_sentence(tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.toml").write_text(ONE_ATTITUDE)
    (tmp_path / "empty.toml").write_text("name = 'empty'\nstations = []\n")
    (tmp_path / "bare.toml").write_text("toolface_deg = [0, 90, 180, 270]\n")
    (tmp_path / "million.toml").write_text(MILLION)
    (tmp_path / "accelerometer.csv").write_text("ref_inclination_deg,ax,ay,az\n10,0,0,0\n")
    message = refused(mwdcal("plan", *arguments, "--tool", "servo", "-o", "plan.csv"), code)
    assert words in message
    assert not (tmp_path / "plan.csv").exists()


@pytest.mark.parametrize(
    "options", [("--stations", 24), ("--criterion", "D", "--json"), ("--parameters", 6)]
)
@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [
        ("magnetometer", "scale = 5e-5", "scale = 2e4"),
        ("magnetometer", "noise = 7.5e-4", "noise = 1e9"),
        ("accelerometer", "scale = 3.0", "scale = 1e12"),
    ],
)
def test_noise_that_no_sensor_has_is_refused(tmp_path, options, kind, old, new):
    """As where the scale is upside down: 7.5e-4 V at 2e4 V per nT are 4e-8 nT."""
    text = (EXAMPLE / "tool.toml").read_text("utf-8")
    assert old in text
    tool = tmp_path / "tool.toml"
    tool.write_text(text.replace(old, new), "utf-8")
    message = refused(mwdcal("plan", "--tool", tool, *options), 2)
    assert f"[{kind}]" in message
    assert "is it upside down" in message


@pytest.mark.parametrize("name", ["inclination", "azimuth", "toolface"])
def test_a_plan_without_an_attitude_is_refused(tmp_path, name):
    columns = {
        f"ref_{each}_deg": [10.0 * k for k in range(8)]
        for each in ("inclination", "azimuth", "toolface")
        if each != name
    }
    plan = write_csv(tmp_path / "p.csv", {"station": list(range(8)), **columns})
    for options in ((), ("--report", tmp_path / "p.html"), ("--stations", 6)):
        ran = mwdcal("plan", "--plan", plan, "--tool", "servo", *options)
        assert f"station 1 has no ref_{name}_deg" in refused(ran, 2)


def test_a_profile_without_noise_cannot_be_planned_with():
    assert "'noise'" in refused(mwdcal("plan", "--tool", "generic"), 2)


def test_a_plan_says_its_temperatures_and_what_it_lacks_of_the_calibration(tmp_path):
    """Of order 1 over 30…70 °C, as the plan file that the finding names has it again."""
    run = write_csv(tmp_path / "run.csv", servo_run(temperatures=(30.0, 50.0, 70.0)))
    cal = tmp_path / "cal.json"
    assert mwdcal("calibrate", run, "--tool", "servo", "--order", 1, "-o", cal).code == 0
    sheet = tmp_path / "sheet.html"
    ran = mwdcal("plan", "--tool", cal, "--report", sheet)
    said = "the calibration that {} names has temperature terms"
    assert said.format("--tool") in sheet.read_text("utf-8")
    library.plan(cal).report(sheet)
    assert said.format("&#39;tool&#39;") in sheet.read_text("utf-8")
    assert "\nplanned at 25 °C; the calibration will be good for 20…30 °C\n" in ran.out
    assert ran.out.count("D-efficiency: how close the plan is to the best possible one") == 1
    assert "30.0…70.0 °C, and this plan gives none" in ran.err
    assert ran.out.startswith(
        "example servo tool   expected of the tool from its calibration of 20"
    )
    levels = re.search(r"temperature_c = \[.*?\]", ran.err)[0]
    assert levels == "temperature_c = [30, 50, 70]"
    plan = tmp_path / "mine.toml"
    stations = (
        "inclination_deg = [30, 90, 150]\nazimuth_deg = [0, 90]\ntoolface_deg = [0, 90, 180, 270]"
    )
    plan.write_text(f'name = "mine"\n{levels}\n[[stations]]\n{stations}\n', "utf-8")
    again = mwdcal("plan", "--tool", cal, "--plan", plan, "--order", 1, "--report", sheet)
    assert "\nplanned at 30, 50, 70 °C; the calibration will be good for 29…71 °C\n" in again.out
    page = sheet.read_text("utf-8")
    assert "<br>Planned at 30, 50, 70 °C; the calibration will be good for 29…71 °C.<br>" in page
    [share] = re.findall(r"\nD-efficiency, at least +(\d+ %)\n", again.out)
    assert f"<br>D-efficiency, at least {share}: how close the plan is to the best" in page
    assert "Planned – expected of the tool from its calibration of 20" in page
    assert "<br>Place, from the calibration: field " in page
    assert "gives none" not in again.err
    single = calibrated(tmp_path)
    assert "gives none" not in mwdcal("plan", "--tool", single).err


def calibrated(tmp_path):
    """A calibration without temperature terms."""
    run, cal = write_csv(tmp_path / "cold.csv", servo_run()), tmp_path / "cold.json"
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", cal).code == 0
    return cal
