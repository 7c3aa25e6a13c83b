"""The way of a table through a tool profile to plan, simulation and correction, and where a name goes wrong."""

import json

import numpy as np
import pytest

import mwdcal as library
from cli_support import mwdcal, refused, servo_run, write_csv
from test_tables_as_they_come import NAMES, table, written

ABSENT = NAMES["ref_toolface_deg"]


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A folder with a laboratory's table, the profile proposed for it, and the calibration."""
    folder = tmp_path_factory.mktemp("own")
    written(folder / "a.csv", table())
    assert mwdcal("profile", folder / "a.csv", "-o", folder / "t.toml").code == 0
    files = ("--tool", folder / "t.toml", "-o", folder / "c.json")
    assert mwdcal("calibrate", folder / "a.csv", *files).code == 0
    return folder


def test_a_proposed_profile_reads_run_files_with_documented_names(own, tmp_path):
    """Expected: the calibration of the same readings in the laboratory's table."""
    run = servo_run()
    write_csv(tmp_path / "run.csv", run)
    ran = mwdcal(
        "calibrate", tmp_path / "run.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json"
    )
    assert ran.code == 0, ran.err
    theirs, ours = library.load(own / "c.json"), library.load(tmp_path / "c.json")
    assert ours.accelerometer.parameters == pytest.approx(theirs.accelerometer.parameters, rel=1e-9)
    raw = {name: values for name, values in run.items() if not name.startswith("ref_")}
    write_csv(tmp_path / "well.csv", raw)
    assert (
        mwdcal("apply", own / "c.json", tmp_path / "well.csv", "-o", tmp_path / "o.csv").code == 0
    )


def test_the_north_of_a_profile_is_not_that_of_a_documented_run_file(tmp_path):
    written(tmp_path / "a.csv", table())
    said = ("--north", "true", "--declination-deg", "10")
    mwdcal("profile", tmp_path / "a.csv", "-o", tmp_path / "t.toml", *said)
    write_csv(tmp_path / "run.csv", servo_run())
    tool = tmp_path / "t.toml"
    ours, theirs = (
        library.read_run(tmp_path / n, tool).known["azimuth"] for n in ("run.csv", "a.csv")
    )
    turned = np.degrees(ours - theirs) % 360.0
    assert turned == pytest.approx(10.0)


def test_a_table_unlike_the_profile_and_the_documented_form_is_refused_with_what_to_do(
    own, tmp_path
):
    written(tmp_path / "b.csv", {f"{name} 2": values for name, values in table().items()})
    message = refused(
        mwdcal(
            "calibrate", tmp_path / "b.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json"
        ),
        2,
    )
    assert "mwdcal profile" in message


@pytest.mark.parametrize("name", ["TF(deg)", "tf [deg]"])
def test_a_column_of_the_profile_under_almost_its_name_is_refused(own, tmp_path, name):
    columns = {name if each == ABSENT else each: values for each, values in table().items()}
    written(tmp_path / "b.csv", columns)
    message = refused(
        mwdcal(
            "calibrate", tmp_path / "b.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json"
        ),
        2,
    )
    assert (
        f"column '{ABSENT}' (ref_toolface_deg) is not in the table. Did you mean '{name}'?"
        in message
    )


@pytest.mark.parametrize(
    ("name", "meant"), [("FT (deg)", " Did you mean 'FT (deg)'?"), ("Remark", "")]
)
def test_an_angle_of_the_profile_that_is_not_in_the_table_is_named(own, tmp_path, name, meant):
    columns = {name if each == ABSENT else each: values for each, values in table().items()}
    written(tmp_path / "b.csv", columns)
    ran = mwdcal(
        "calibrate", tmp_path / "b.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json"
    )
    assert (
        f"! the tool profile's column '{ABSENT}' (ref_toolface_deg) is not in the table.{meant}\n"
        in ran.err
    )
    findings = json.loads((tmp_path / "c.json").read_text())["findings"]
    assert any(ABSENT in finding["text"] for finding in findings)


def test_a_calibration_as_the_tool_of_a_plan_brings_the_noise_that_it_estimated(own, tmp_path):
    """Expected: the plan by the profile with that noise written into it, at one place."""
    cal, text = json.loads((own / "c.json").read_text()), (own / "t.toml").read_text()
    for kind in ("accelerometer", "magnetometer"):
        noise = cal[kind]["noise"] * cal["profile"][kind]["scale"]
        text = text.replace(f"[{kind}]", f"[{kind}]\nnoise = {noise!r}")
    (tmp_path / "t.toml").write_text(text)
    plan = tmp_path / "place.toml"
    plan.write_text(
        'name = "here"'
        "\nfield_nt = 50000.0\ndip_deg = 66.0\n\n[[stations]]\ninclination_deg = [30, 90, 120]\n"
        "azimuth_deg = [0, 120]\ntoolface_deg = [0, 90, 180, 270]\n",
        "utf-8",
    )
    ours, theirs = (
        mwdcal("plan", "--plan", plan, "--tool", tool, "--json").json
        for tool in (own / "c.json", tmp_path / "t.toml")
    )
    for angle, value in theirs["accuracy_deg"].items():
        assert ours["accuracy_deg"][angle] == pytest.approx(value, rel=1e-6)


def test_a_proposed_profile_has_lines_for_noise_and_stand_and_says_that_the_stand_counts_as_exact(
    own, tmp_path
):
    """The lines filled in and without their marks are a profile with these values."""
    ran = mwdcal("profile", own / "a.csv", "-o", tmp_path / "t.toml")
    assert "The angles of the stand count as exact until [stand] in" in ran.out
    text = (tmp_path / "t.toml").read_text().replace("# [stand]", "[stand]")
    for name in ("noise", "inclination_deg", "azimuth_deg", "toolface_deg"):
        assert f"# {name} =" in text
        text = text.replace(f"# {name} =", f"{name} = 0.01 #")
    (tmp_path / "t.toml").write_text(text)
    profile = library.load_profile(tmp_path / "t.toml")
    assert (profile.accelerometer.noise, profile.stand.azimuth_deg) == (0.01, 0.01)
    (tmp_path / "mwdcal.toml").write_text("[stand]\nazimuth_deg = 0.05\n")
    written(tmp_path / "b.csv", table())
    ran = mwdcal("profile", tmp_path / "b.csv", "-o", tmp_path / "u.toml")
    assert (ran.code, "count as exact" in ran.out) == (0, False)


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("calibrate a.csv --tool t.toml -o a.xlsx", "Write to 'a.json'."),
        ("calibrate a.csv --tool t.toml -o x.json --report a.pdf", "Write to 'a.html'."),
        ("verify c.json a.csv -o v.html", "Write to 'v.json'."),
        ("profile a.csv -o a.json", "Write to 'a.toml'."),
        ("apply c.json a.csv -o c.xls", "Write to 'c.csv', for example."),
        ("apply c.json a.csv -o c", ".csv, .tsv, .parquet, .xlsx"),
        ("apply a.csv c.json -o o.csv", "CALIBRATION comes first"),
        ("verify a.csv c.json", "CALIBRATION comes first"),
        ("calibrate a.csv --tool few.toml -o x.json", "there is no file 'few.toml'"),
        ("calibrate a.csv --raport r.html -o x.json", "Did you mean '--report'?"),
        ("calibrate a.csv b.csv -o x.json", "--rolltest b.csv"),
        ("help", "mwdcal --help"),
        ("correct", "mwdcal apply"),
        ("report", "--report R.html"),
        ("calibrat a.csv", "Did you mean calibrate?"),
    ],
)  # fmt: skip
def test_a_slip_on_the_command_line_is_refused_with_what_to_type(own, monkeypatch, typed, message):
    monkeypatch.chdir(own)
    before = sorted(own.iterdir())
    ran = mwdcal(*typed.split())
    assert (ran.code, ran.out) == (2, "")
    assert message in ran.err
    assert sorted(own.iterdir()) == before


def test_a_file_in_whose_place_a_calibration_comes_is_said(own, tmp_path):
    said = [
        mwdcal("calibrate", own / "a.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json").out
        for _ in range(2)
    ]
    assert ["in place of an earlier file" in each for each in said] == [False, True]


def test_a_single_cell_with_the_other_decimal_sign_is_not_that_of_the_table(tmp_path):
    write_csv(tmp_path / "a.csv", servo_run())
    lines = (tmp_path / "a.csv").read_text().splitlines()
    cells = lines[9].split(",")
    cells[lines[0].split(",").index("ay")] = '"0,13472"'
    lines[9] = ",".join(cells)
    (tmp_path / "a.csv").write_text("\n".join(lines))
    message = refused(mwdcal("calibrate", tmp_path / "a.csv", "-o", tmp_path / "c.json"), 2)
    assert "line 10" in message
    assert "Correct this one" in message
    assert "--decimal" not in message


def test_a_table_without_any_angle_of_the_profile_is_said_to_have_none(own, tmp_path):
    columns = {
        name: values for name, values in table().items() if name[:2] not in ("In", "Az", "TF")
    }
    assert len(table()) - len(columns) == 3
    written(tmp_path / "b.csv", columns)
    ran = mwdcal(
        "calibrate", tmp_path / "b.csv", "--tool", own / "t.toml", "-o", tmp_path / "c.json"
    )
    assert "! the table has no angles of the stand: the tool profile's columns" in ran.err
    assert ABSENT in ran.err.partition("no angles of the stand")[2].partition("\n")[0]
