"""The north and the references of a stand: they turn its run and its roll test, and never a well."""

from __future__ import annotations

import json
import re

import numpy as np
import openpyxl
import pandas as pd
import pytest

import mwdcal as library
from cli_support import SERVO_NOISE, mwdcal, read_csv, refused, servo_run, write_csv
from simulation import Tool
from test_roll_test_tables import run_in_gauss
from test_wrong_inputs import measured

DECLINATION = 5.2
OF_PLACE = ("ref_gravity_g", "ref_field_nt", "ref_dip_deg")


def at_the_stand(rows):
    """Columns with azimuths from true north, without gravity, field and dip."""
    kept = {name: cells for name, cells in rows.items() if name not in OF_PLACE}
    kept["Azi true [°]"] = (np.asarray(kept.pop("ref_azimuth_deg")) + DECLINATION) % 360
    return kept


def surveys(field=50_000.0):
    """Surveys of a well without references, in a field of so many nT."""
    rows = measured((30, 60), 12, tool=Tool.random(1, noise=SERVO_NOISE, field=field))
    kept = {name: cells for name, cells in rows.items() if not name.startswith(("ref_", "sd_"))}
    return {"md_m": 30.0 * np.arange(1, 25), **kept}


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    """A folder with a run, its profile, which states the place of the stand, and the calibration."""
    folder, rows = tmp_path_factory.mktemp("stand"), servo_run()
    run = write_csv(folder / "run.csv", at_the_stand(rows))
    numbers = [("--column", f"{column}={rows[column][0]:.6f}") for column in OF_PLACE]
    north = ("--north", "true", "--declination-deg", DECLINATION)
    options = (*north, *(word for pair in numbers for word in pair))
    ran = mwdcal("profile", run, "-o", folder / "tool.toml", *options)
    assert ran.code == 0, ran
    ran = mwdcal("calibrate", run, "--tool", folder / "tool.toml", "-o", folder / "cal.json")
    assert ran.code == 0, ran
    write_csv(folder / "well.csv", surveys())
    return folder


def test_the_declination_of_the_stand_does_not_reach_a_well(stand, tmp_path):
    out = tmp_path / "out.csv"
    ran = mwdcal("survey", stand / "cal.json", stand / "well.csv", "-o", out)
    assert ran.code == 0, ran
    assert "azimuths from magnetic north" in ran.out
    assert "gravity, field, dip, declination, convergence: none" in ran.out
    head = [line for line in out.read_text().splitlines() if line.startswith("#")]
    assert '# north = "magnetic"' in head
    assert not any("azimuth_reference" in line or "declination_deg" in line for line in head)


def test_the_reference_of_the_well_counts(stand, tmp_path):
    place = tmp_path / "place.json"
    options = ("--latitude", 60, "--longitude", 5, "--altitude-m", 0, "--date", "2026-06-01")
    place.write_text(mwdcal("reference", *options, "--json").out)
    out = tmp_path / "out.csv"
    options = ("-o", out, "--reference", place, "--json")
    ran = mwdcal("survey", stand / "cal.json", stand / "well.csv", *options)
    expected = json.loads(place.read_text())["declination_deg"]
    assert ran.json["declination_deg"] == pytest.approx(expected)
    sources = ran.json["reference_sources"]
    assert {sources[name] for name in ("field", "dip", "declination")} == {"reference"}
    assert not [f for f in ran.json["findings"] if "well.csv states" in f["text"]]


def test_python_does_not_take_it_either(stand):
    cal = library.load(stand / "cal.json")
    table = pd.read_csv(stand / "well.csv")
    read = [
        stand / "well.csv",
        table,
        library.read_run(stand / "well.csv", cal.profile),
        library.read_run(table, cal.profile, metadata={"date": "2026-01-01"}),
    ]
    for readings in read:
        surveyed = library.survey(cal, readings)
        assert "azimuth_true_deg" not in surveyed.columns
        assert np.isnan(surveyed.columns.get("ref_field_nt", np.nan)).all()
    own = library.read_run(stand / "well.csv", cal.profile, metadata={"declination_deg": 5.2})
    turned = library.survey(cal, own).columns
    off = turned["azimuth_true_deg"] - turned["azimuth_magnetic_deg"]
    np.testing.assert_allclose((off + 180) % 360 - 180, 5.2, atol=1e-9)


def test_apply_and_diagnose_do_not_judge_a_well_by_the_field_of_the_stand(stand, tmp_path):
    well = write_csv(tmp_path / "well.csv", surveys(60_000.0))
    out = tmp_path / "out.csv"
    ran = mwdcal("apply", stand / "cal.json", well, "-o", out)
    assert ran.code == 0, ran
    assert "azimuth_reference" not in out.read_text()
    cal = library.load(stand / "cal.json")
    library.apply(cal, well)
    library.apply(cal, library.read_run(well, cal.profile))
    assert library.diagnose(cal, well).fault == "none"
    assert mwdcal("diagnose", stand / "cal.json", well).code == 0


def test_a_table_in_memory_is_turned_as_its_file_is(stand):
    table = pd.read_csv(stand / "run.csv")
    by_file = library.read_run(stand / "run.csv", stand / "tool.toml")
    in_memory = library.read_run(table, stand / "tool.toml")
    expected = np.asarray(table["Azi true [°]"]) - DECLINATION
    for readings in (by_file, in_memory):
        off = np.degrees(readings.reference("azimuth")) - expected
        np.testing.assert_allclose((off + 180) % 360 - 180, 0.0, atol=1e-9)


def test_a_run_is_written_with_the_north_of_its_stand(stand, tmp_path):
    library.save(library.read_run(stand / "run.csv", stand / "tool.toml"), tmp_path / "again.csv")
    again = library.read_run(tmp_path / "again.csv", "servo")
    assert again.metadata["declination_deg"] == DECLINATION
    written = np.array(read_csv(tmp_path / "again.csv")["ref_azimuth_deg"], float)
    np.testing.assert_allclose(written, np.asarray(pd.read_csv(stand / "run.csv")["Azi true [°]"]))


ANGLES = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
NAMES = {
    **dict(zip(ANGLES, ("Inc (deg)", "Azi (true) (deg)", "TF (deg)"), strict=True)),
    "temperature_c": "Temp (°C)", **{f"a{i}": f"G{i} (g)" for i in "xyz"},
    **{f"m{i}": f"B{i} (nT)" for i in "xyz"},
}  # fmt: skip
OTHERS = {
    **NAMES, **dict(zip(ANGLES, ("Incl [deg]", "Heading [deg]", "Roll [deg]"), strict=True)),
    **{f"a{i}": f"Acc {i.upper()} (g)" for i in "xyz"}, **{f"m{i}": f"Mag {i.upper()} (nT)" for i in "xyz"},
}  # fmt: skip
TITLE = (
    ("Serial", "A7"),
    ("Date", "2026-05-04"),
    ("Declination", "5.20 deg E"),
    ("Total field", "50000 nT"),
    ("Dip", "65.00 deg"),
)


def sheet_of(book, title, rows, names, above=(), offset=DECLINATION):
    """A sheet with lines above a table, whose azimuths are so much more than magnetic ones."""
    sheet = book.create_sheet(title)
    rows = {**rows, "ref_azimuth_deg": (np.asarray(rows["ref_azimuth_deg"]) + offset) % 360}
    for line in (*above, [*names.values()]):
        sheet.append(line)
    for cells in zip(*(run_in_gauss(rows, names)[name] for name in names.values()), strict=True):
        sheet.append([float(cell) for cell in cells])


def book_of(path, **sheets):
    """A workbook of sheets as of `sheet_of`."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, arguments in sheets.items():
        sheet_of(book, title, *arguments)
    book.save(path)
    return path


def in_a_workbook(folder, names=OTHERS, above=(), offset=DECLINATION, title="Roll test"):
    """A workbook with a run and its roll test, its profile and its calibration."""
    test = measured((45,), 12, noise=3, azimuth=1.0)
    run = (servo_run(), NAMES, TITLE)
    book = book_of(folder / "A7.xlsx", Run=run, **{title: (test, names, above, offset)})
    ran = mwdcal("profile", book, "-o", folder / "tool.toml")
    assert ran.code == 0, ran
    ran = mwdcal("calibrate", book, "--tool", folder / "tool.toml", "-o", folder / "cal.json")
    assert ran.code == 0, ran
    return book


ROLLS = {
    "other names": (OTHERS, (), DECLINATION),
    "names of the run": (NAMES, (), DECLINATION),
    "its own declination": (OTHERS, (("Declination", "4.10 deg E"),), 4.1),
    "magnetic": ({**OTHERS, "ref_azimuth_deg": "Magnetic azimuth [deg]"}, (), 0.0),
}


@pytest.mark.parametrize("case", ROLLS)
def test_a_roll_test_takes_from_its_run_what_its_sheet_does_not_state(tmp_path, case):
    names, above, offset = ROLLS[case]
    book = in_a_workbook(tmp_path, names, above, offset)
    options = ("--tool", tmp_path / "tool.toml", "-o", tmp_path / "cal.json", "--rolltest", book)
    ran = mwdcal("calibrate", book, *options, "--json")
    assert ran.code == 0, ran
    for result in (
        ran.json["verification"],
        mwdcal("verify", tmp_path / "cal.json", book, "--json").json,
        mwdcal("verify", tmp_path / "cal.json", book, "--sheet", "Roll test", "--json").json,
        library.verify(library.load(tmp_path / "cal.json"), book).to_dict(),
    ):
        (worst,) = [r["value"] for r in result["rows"] if r["name"] == "error of azimuth"]
        assert worst < 0.5
        said = " ".join(f["text"] for f in result["findings"])
        assert ("declination_deg 5.2" in said) == (offset == DECLINATION)
        assert "ref_field_nt 50000" in said
        assert result["passed"]


def test_a_roll_test_of_its_own_file_takes_it_too(tmp_path):
    in_a_workbook(tmp_path)
    test = measured((45,), 12, noise=3, azimuth=1.0)
    roll = book_of(tmp_path / "roll.xlsx", Sheet=(test, OTHERS))
    options = ("--tool", tmp_path / "tool.toml", "-o", tmp_path / "cal.json", "--rolltest", roll)
    ran = mwdcal("calibrate", tmp_path / "A7.xlsx", *options)
    assert ran.code == 0, ran
    assert mwdcal("verify", tmp_path / "cal.json", roll).code == 0


def test_a_true_azimuth_without_a_declination_names_its_sheet(tmp_path):
    rows = servo_run()
    book = book_of(tmp_path / "A7.xlsx", Run=(rows, NAMES, TITLE), Later=(rows, NAMES))
    ran = mwdcal("profile", book, "--sheet", "Run", "-o", tmp_path / "tool.toml")
    assert ran.code == 0, ran
    text = (tmp_path / "tool.toml").read_text().replace('"Run"', '"Later"')
    (tmp_path / "tool.toml").write_text(text)
    said = mwdcal("calibrate", book, "--tool", tmp_path / "tool.toml", "-o", tmp_path / "c.json")
    assert "A7.xlsx, sheet 'Later': true azimuths need" in refused(said, 2)


def test_the_declination_that_was_used_is_shown(stand, tmp_path):
    book = in_a_workbook(tmp_path)
    ran = mwdcal("profile", book, "-o", tmp_path / "tool.toml")
    assert re.search(r"\ndeclination_deg +above the names +5\.2° E\n", ran.out)
    page = tmp_path / "page.html"
    options = ("--tool", tmp_path / "tool.toml", "-o", tmp_path / "cal.json")
    ran = mwdcal("calibrate", book, *options, "--rolltest", book, "--report", page)
    assert "azimuths of the run from true north: declination 5.2° E (run)" in ran.out
    assert ", magnetic azimuth 57.296°" in " ".join(ran.out.split())  # rows fold
    text = page.read_text("utf-8")
    assert '<td>declination</td><td>5.2° E</td><td class="text">run: turns' in text
    assert "<th>magnetic azimuth</th>" in text
    again = ("--tool", stand / "tool.toml", "-o", tmp_path / "again.json")
    ran = mwdcal("calibrate", stand / "run.csv", *again)
    assert "azimuths of the run from true north: declination 5.2° E (tool profile)" in ran.out


def test_a_plan_says_that_its_azimuths_are_magnetic(tmp_path):
    options = ("--stations", 24, "--tool", "servo", "-o", tmp_path / "plan.csv")
    ran = mwdcal("plan", *options, "--report", tmp_path / "plan.html")
    assert ran.code == 0, ran
    assert re.search(r"inclination, ° +magnetic azimuth, ° +toolface, °", ran.out)
    assert "<th>magnetic azimuth, °</th>" in (tmp_path / "plan.html").read_text("utf-8")
    assert "ref_azimuth_deg" in read_csv(tmp_path / "plan.csv")
