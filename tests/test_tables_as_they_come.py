"""What a laboratory's table says beside its readings: references, marks, adjustments, mistyped cells and names."""

import csv
import datetime
import json
import re

import msgspec
import numpy as np
import openpyxl
import pandas
import pytest

import mwdcal as library
from cli_support import channels, mwdcal, refused, servo_run, stations, write_csv
from mwdcal.errors import FitError
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.title_references import doubtful_in, references_in
from mwdcal.files.formats.titles import titles
from mwdcal.identification.columns import is_numbering, meanings_of
from simulation import Tool, plan

NAMES = {
    "station": "Pos", "temperature_c": "Temp (C)", "ax": "Gx (V)", "ay": "Gy (V)", "az": "Gz (V)",
    "mx": "Hx (V)", "my": "Hy (V)", "mz": "Hz (V)", "ref_inclination_deg": "Inc (deg)",
    "ref_azimuth_deg": "Azi (deg)", "ref_toolface_deg": "TF (deg)", "ref_gravity_g": "Local G (g)",
    "ref_field_nt": "Btotal (nT)", "ref_dip_deg": "Dip (deg)",
}  # fmt: skip


def table(**others):
    """The columns of a sound run as a laboratory calls them; None takes one away, more come behind."""
    run = {NAMES[name]: values for name, values in servo_run().items()}
    run |= {NAMES.get(name, name): values for name, values in others.items()}
    return {name: values for name, values in run.items() if values is not None}


def written(path, columns, *above, encoding="utf-8", delimiter=","):
    """A text table with lines above its names."""
    write_csv(path, columns, delimiter=delimiter)
    path.write_text("\n".join([*above, path.read_text("utf-8")]), encoding)
    return path


def read(path, **answers):
    """The run that the proposed profile makes of a table."""
    return library.read_run(path, library.propose_profile(path, **answers).profile)


def calibrated(folder, path, *options):
    """What `calibrate` says and stores of a table, by the profile proposed for it."""
    tool, cal = folder / "tool.toml", folder / "cal.json"
    ran = mwdcal("profile", path, "-o", tool, "--replace", *options)
    assert ran.code == 0, ran
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", cal)
    assert ran.code == 0, ran
    return ran, json.loads(cal.read_text())


# ------------------------------------------------------------------------------ title blocks

PLACE = {"ref_field_nt": 48_912.0, "ref_dip_deg": 66.25, "ref_gravity_g": 9.8123 / 9.80665}
TITLES = {
    "English": [["Local field: 48912 nT", "Dip 66.25 deg", "g = 9.8123 m/s2"]],
    "scales": [
        ["Skalierung Magnetfeld", "0,5 Digit/nT"],
        ["Feldstärke", "48912 nT"],
        ["Feldneigung", "66-15-00"],
        ["g", "9,8123 m/s²"],
    ],
    "sentences": [
        [
            "Accelerometer scale 2.5 V/g nominal. 1 V = 20 uT. Field 48912 nT, dip 66.25 deg, g = 9.8123 m/s2."
        ],
    ],
    "cells": [["Total field", 48.912, "µT"], ["Dip", "66°15'"], ["Gravity", 981.23, "gal"]],
    "German": [["Erdfeld 48,912 µT; Inklination 66,25°; Fallbeschleunigung 9,8123 m/s²"]],
    "Norwegian": [
        ["Totalfelt:", "48 912", "nT"],
        ["Feltinklinasjon", "66,25 °"],
        ["Tyngde 9,8123 m/s²"],
    ],
    "Spanish": [
        ["Campo total (nT): 48.912"],
        ["Inclinación magnética 66,25°"],
        ["Gravedad local", 9.8123, "m/s2"],
    ],
    "Portuguese": [
        ["Intensidade total 489,12 mG", "Mergulho magnético 66,25 °", "Gravidade 981230 mGal"]
    ],
    "French": [
        ["Champ total F", "0.48912 gauss"],
        ["Inclinaison magnétique I", 66.25, "°"],
        ["g", "9,8123 m/s²"],
    ],
    "Russian": [["Т = 48,912 мкТл, наклонение 66,25°, g = 9,8123 м/с²"]],
    "Norwegian, of the field": [
        ["Feltstyrke:", "48912 nT"],
        ["Felthelning:", "66,25°"],
        ["Tyngde:", "9,8123 m/s2"],
    ],
    "Chinese": [["总磁场强度", 48912, "nT", "磁倾角", "66.25°", "重力加速度", 9.8123, "m/s²"]],
}
NO_REFERENCES = (
    [["local field 48.9 uT nominal"], ["field uncertainty 50 nT"], ["Dip tolerance 0.3 deg"]],
    [["Fluxgate: 2.5 V at 50 000 nT"], ["Field range ±70 µT"], ["Magnetic field tool, model 45"]],
    [
        ["Operator: G. Field", 12],
        ["Tool", "F 45-12"],
        ["Gravity toolface 90 deg"],
        ["Max. field 48912 nT"],
    ],
)


@pytest.mark.parametrize("language", TITLES)
def test_a_title_block_states_the_references_of_the_run(language):
    assert references_in(TITLES[language]) == pytest.approx(PLACE, rel=1e-12)


@pytest.mark.parametrize("rows", NO_REFERENCES)
def test_what_is_nominal_a_range_or_a_name_is_no_reference(rows):
    assert references_in(rows) == {}


def test_two_values_of_one_reference_are_none():
    assert references_in([["Field 48912 nT"], ["Field 49001 nT"]]) == {}


def test_a_calibration_by_references_above_the_names_is_that_by_columns(tmp_path):
    """The same values in columns of the table: the same parameters."""
    run = servo_run()
    place = {name: float(run[name][0]) for name in PLACE}
    field, dip, gravity = place.values()
    above = [f"Local field;{field!r} nT", f"Dip;{dip!r} deg", f"Local gravity;{gravity!r} g"]
    titled = written(tmp_path / "a.csv", table(**dict.fromkeys(PLACE)), *above, delimiter=";")
    whole = written(tmp_path / "b.csv", table(), delimiter=";")
    ran = mwdcal("profile", titled, "-o", tmp_path / "shown.toml")
    assert re.search(rf"ref_field_nt +above the names +{field:.8g} nT", ran.out)
    (_, one), (_, two) = (calibrated(tmp_path, path) for path in (titled, whole))
    for kind in ("accelerometer", "magnetometer"):
        np.testing.assert_allclose(
            one[kind]["parameters"], two[kind]["parameters"], rtol=1e-11, atol=0
        )


def test_a_column_counts_before_the_title(tmp_path):
    path = written(tmp_path / "a.csv", table(), "Local field,12345 nT,Local field,51000 nT")
    assert read(path).reference("field") == pytest.approx(servo_run()["ref_field_nt"])


def test_a_cover_sheet_states_serial_and_references(tmp_path):
    columns = table(**dict.fromkeys(PLACE))
    book = openpyxl.Workbook()
    for row in (["Tool S/N", "DM-17"], ["Total field", 50_000, "nT"], ["Dip", 65, "deg"]):
        book.active.append(row)
    sheet = book.create_sheet("Data")
    for row in ([*columns], *zip(*columns.values(), strict=True)):
        sheet.append([v.item() if hasattr(v, "item") else v for v in row])
    book.save(tmp_path / "run.xlsx")
    run = read(tmp_path / "run.xlsx")
    assert run.metadata["serial"] == "DM-17"
    assert run.reference("field") == pytest.approx(np.full(run.count, 50_000.0))
    assert np.degrees(run.reference("dip")) == pytest.approx(np.full(run.count, 65.0))


def test_two_serials_on_two_sheets_are_asked_about(tmp_path):
    book, columns = openpyxl.Workbook(), table()
    book.active.append(["Serial number", "AK-4471"])
    sheet = book.create_sheet("Data")
    for row in (["Tool SN: AK-4417"], [], [*columns], *zip(*columns.values(), strict=True)):
        sheet.append([v.item() if hasattr(v, "item") else v for v in row])
    path = tmp_path / "run.xlsx"
    book.save(path)
    with pytest.raises(FitError, match=r"'AK-4417' and 'AK-4471'.*serial='AK-4471'"):
        library.propose_profile(path)
    assert library.propose_profile(path, serial="AK-4471").profile.name == "AK-4471"
    assert "'AK-4417' is taken unless" in " ".join(read(path, serial="AK-4471").remarks)
    book["Sheet"]["B1"] = "AK-441"
    book.save(path)
    assert "'AK-4417' is taken unless" in " ".join(read(path, serial="AK-4417").remarks)
    book["Sheet"]["B1"] = "SN ak 4417"
    book.save(path)
    assert not any("another sheet" in each for each in read(path).remarks)


@pytest.mark.parametrize(
    ("cells", "day"),
    [
        (["Fecha: 21 de mayo de 2024"], "2024-05-21"), (["Data", "12 de Junho de 2024"], "2024-06-12"),
        (["Calibration date", "August 22, 2024"], "2024-08-22"), (["Dátum:", "2024. 02. 21."], "2024-02-21"),
        (["дата 28.08.2023"], "2023-08-28"), (["Дата", "3 грудня 2023 р."], "2023-12-03"),
        (["Logged 2024-08-22"], "2024-08-22"), (["교정일", "2024년 4월 2일"], "2024-04-02"),
        (["Ngày", "28 tháng 11 năm 2023"], "2023-11-28"), (["Data: 5 marca 2024"], "2024-03-05"),
        (["Tarih", "9 Şubat 2024"], "2024-02-09"), (["Date :", "1er août 2023"], "2023-08-01"),
        (["Päivämäärä", "7. kesäkuuta 2024"], "2024-06-07"), (["Datum", "5. märz 2024"], "2024-03-05"),
        (["Date", "31 June 2024"], None), (["Date", "12 temp 2024"], None), (["Set 2, 2024"], None),
    ],
)  # fmt: skip
def test_a_day_with_its_month_in_words_of_other_languages(cells, day):
    assert titles([cells]).metadata.get("date") == day


@pytest.mark.parametrize(
    ("cells", "serial"),
    [
        (["Ferramenta", "MWD-BR 0092"], "MWD-BR 0092"), (["Verktøy nr. BG 114"], "BG 114"),
        (["Calibrare senzori, seria RO-58, Ploiești"], "RO-58"), (["Số máy (S/N)", "VT-0065"], "VT-0065"),
        (["Gyári szám:", "HU-0238"], "HU-0238"), (["일련번호", "KR-D 014"], "KR-D 014"),
        (["Заводський номер", "4471"], "4471"), (["Seria 2"], None), (["Stand (S/N)", "44"], None),
        (["Tool May 2024"], None),
    ],
)  # fmt: skip
def test_a_serial_behind_words_of_other_languages(cells, serial):
    assert titles([cells]).metadata.get("serial") == serial


@pytest.mark.parametrize("title", ["copy of 2022 - do not use", "kopia, nie używać", "veraltet"])
def test_a_copy_of_the_channels_that_does_not_count_is_not_read(tmp_path, title):
    columns = table()
    names = [*columns]
    copied = [NAMES[c] for c in ("ax", "ay", "az", "mx", "my", "mz")]
    rows = [[*names, "", *copied]]
    for k in range(48):
        cells = [columns[name][k] for name in names]
        rows.append([*cells, "", *(1.02 * columns[name][k] + 0.01 for name in copied)])
    book = openpyxl.Workbook()
    book.active.append([""] * (len(names) + 1) + [title])
    for row in rows:
        book.active.append([v.item() if hasattr(v, "item") else v or None for v in row])
    book.save(tmp_path / "run.xlsx")
    whole = read(written(tmp_path / "run.csv", columns)).accelerometer
    assert read(tmp_path / "run.xlsx").accelerometer == pytest.approx(whole)
    assert "are not read" in " ".join(read(tmp_path / "run.xlsx").remarks)


def test_means_below_the_readings_of_a_station_are_no_readings_however_spelt(tmp_path):
    rows = list[str]()
    for k in range(4):
        rows += [f"{30 * k},{90 * k},{n},0.{k},0.{n},0.9,{k}00{n},2{k}00,48000" for n in (1, 2, 3)]
        rows.append(f"{30 * k},{90 * k},Avarage,0.{k},0.2,0.9,{k}002,2{k}00,48000")
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["Inc,Azi,Reading,Gx,Gy,Gz,Hx,Hy,Hz", *rows]) + "\n")
    (only,) = tables.every_table(path)
    assert only.texts[2] == ["1", "2", "3"] * 4


NOMINAL = {
    "Nominal field;48 500 nT": "ref_field_nt",
    "Total field, approx.;48.5 µT": "ref_field_nt",
    "Dip (nominal);66.2 deg": "ref_dip_deg",
}


@pytest.mark.parametrize("line", NOMINAL)
def test_a_nominal_reference_is_named_where_the_run_has_no_other(tmp_path, line):
    column = NOMINAL[line]
    path = written(tmp_path / "a.csv", table(**{column: None}), line, delimiter=";")
    findings = {f.id: f.text for f in library.propose_profile(path).findings}
    assert f"'{column}'" in findings["reference-not-taken"]
    assert line.split(";")[0] in findings["reference-not-taken"]
    whole = written(tmp_path / "b.csv", table(), line, delimiter=";")
    assert "reference-not-taken" not in {f.id for f in library.propose_profile(whole).findings}


@pytest.mark.parametrize(
    ("line", "listed"),
    [
        ("Feldstärke;48.0 µT", False), ("B total (uT);48.0", False), ("Totalfelt [nT];48000", False),
        ("地磁场强度(nT);48000", False), ("Reference dip;63 deg", False), ("Gravty;9.80665", True),
    ],
)  # fmt: skip
def test_a_line_that_is_read_is_no_misspelling_of_another_reference(tmp_path, line, listed):
    """The run states no gravity: a line is near it by a letter, and another reference by its words."""
    references = ("ref_gravity_g", "ref_field_nt", "ref_dip_deg")
    path = written(tmp_path / "a.csv", table(**dict.fromkeys(references)), line, "", delimiter=";")
    ids = [finding.id for finding in library.propose_profile(path).findings]
    assert ("reference-not-taken" in ids) == listed


TWO_PLACES = {
    "Dip 65.0 Aberdeen, 58.1 Houston": ("ref_dip_deg", 65.0),
    "Field in hut A;50 000 nT;Field in hut B;49 100 nT": ("ref_field_nt", 50_000.0),
}


@pytest.mark.parametrize("line", TWO_PLACES)
def test_two_values_of_a_reference_are_asked_about_and_a_number_answers(tmp_path, line):
    column, value = TWO_PLACES[line]
    path = written(tmp_path / "a.csv", table(**{column: None}), line, delimiter=";")
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml")
    assert ran.code == 3
    assert f"--column {column}={value}" in ran.err
    assert f"--column {column}= " in ran.err or ran.err.rstrip().endswith(f"--column {column}=.")
    _, stored = calibrated(tmp_path, path, "--column", f"{column}={value}")
    assert stored["earth"]["dip_deg" if "dip" in column else "field"] == pytest.approx(value)
    calibrated(tmp_path, path, "--column", f"{column}=")


# -------------------------------------------------------------------------- sheets of one run


def workbook_of(path, columns, sheets, *above):
    """A workbook with the rows of a table in equal shares on these sheets."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    rows = [*zip(*columns.values(), strict=True)]
    share = len(rows) // len(sheets)
    for place, name in enumerate(sheets):
        sheet = book.create_sheet(name)
        for row in (*above, [*columns], *rows[place * share : (place + 1) * share]):
            sheet.append([v.item() if hasattr(v, "item") else v for v in row])
    book.save(path)
    return path


@pytest.mark.parametrize(
    ("sheets", "first"),
    [
        (("25C", "80 °C", "-10 degC"), 1),
        (("Inc 5", "Inc 45", "Inc 90"), 1),
        (("kalt", "Raumtemperatur", "heiß"), 1),
        (("Sheet1", "Sheet2", "Sheet3"), 0),
    ],
)
def test_sheets_that_are_parts_of_one_run_are_joined(tmp_path, sheets, first):
    """Named as settings, with stations that begin anew, or numbered on from sheet to sheet."""
    numbers = [k % 16 + 1 for k in range(48)] if first else [*range(1, 49)]
    columns = table(station=numbers, temperature_c=np.repeat([25.0, 80.0, -10.0], 16))
    path = workbook_of(tmp_path / "a.xlsx", columns, sheets, ["Tool S/N", "DM-17"])
    run = read(path)
    whole = read(written(tmp_path / "b.csv", table()))
    for kind in ("accelerometer", "magnetometer"):
        np.testing.assert_allclose(getattr(run, kind), getattr(whole, kind), rtol=0, atol=1e-9)
    ran, _ = calibrated(tmp_path, path)
    assert "48 stations" in ran.out
    ran = mwdcal("profile", path, "-o", tmp_path / "c.toml")
    assert f"'{sheets[1]}' and '{sheets[2]}' joined as one run" in ran.out
    assert read(path, sheet=sheets[0]).count == 16


ABOVE_PAGES = ["Field", "50,000 nT", "Dip", "65.0°", "Tool S/N", "DM-17"]


def pages_of(path, sheets, line, numbers=range(1, 49)):
    """A workbook of two pages of a run: a title block with the place on the first, and a line on the other."""
    references = dict.fromkeys(("ref_gravity_g", "ref_field_nt", "ref_dip_deg"))
    workbook_of(path, table(station=[*numbers], **references), sheets)
    book = openpyxl.load_workbook(path)
    for sheet, above in zip(book, (ABOVE_PAGES, line), strict=True):
        sheet.insert_rows(1)
        for column, value in enumerate(above, 1):
            sheet.cell(1, column, value)
    book.save(path)
    return path


@pytest.mark.parametrize(
    ("sheets", "line"),
    [
        (("Page 1", "Page 2"), []),
        (("стр.1", "стр.2"), ["Протокол, стр. 2 из 2 (продолжение)"]),
        (("Seite 1", "Seite 2"), ["Tool S/N", "DM-17"]),
        (("Run A", "Run B"), ["Calibration sheet (continued)"]),
    ],
)
def test_a_further_page_without_a_title_block_is_of_the_run_that_it_numbers_on(
    tmp_path, sheets, line
):
    path = pages_of(tmp_path / "a.xlsx", sheets, line)
    whole = read(written(tmp_path / "b.csv", table()))
    np.testing.assert_allclose(read(path).accelerometer, whole.accelerometer, rtol=0, atol=1e-9)
    ran = mwdcal("profile", path, "-o", tmp_path / "c.toml")
    assert f"'{sheets[0]}' and '{sheets[1]}' joined as one run" in ran.out


@pytest.mark.parametrize(
    ("sheets", "line", "numbers"),
    [
        (("Page 1", "Page 2"), [], [*range(1, 25), *range(1, 25)]),
        (("Page 1", "Page 2"), [], [*range(1, 25), *range(20, 44)]),
        (("Page 1", "Page 2"), ["Tool S/N", "DM-18"], range(1, 49)),
        (("Page 1", "Page 2"), ["Field", "51,000 nT"], range(1, 49)),
        (("Page 1", "Page 2"), ["another tool"], range(1, 49)),
        (("DM-17", "DM-18"), [], range(1, 49)),
        (("Page 1", "Page 2"), ["page 2, as left"], range(1, 49)),
    ],
)
def test_a_further_page_that_may_be_of_another_run_is_asked_about(tmp_path, sheets, line, numbers):
    path = pages_of(tmp_path / "a.xlsx", sheets, line, numbers=numbers)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert all(f'--sheet "{name}"' in message or f"--sheet {name}" in message for name in sheets)


def test_a_further_page_of_verification_is_no_part_of_the_run(tmp_path):
    path = pages_of(tmp_path / "a.xlsx", ("Page 1", "Page 2"), ["Verification, page 2"])
    assert read(path).count == 24


@pytest.mark.parametrize(
    ("sheets", "numbers"),
    [
        (("as found", "as left"), range(1, 49)),
        (("Run 1", "Run 2"), [*range(1, 25), *range(1, 25)]),
        (("DM-1187", "DM-1203"), [*range(1, 25), *range(1, 25)]),
    ],
)
def test_sheets_that_may_be_two_runs_are_asked_about(tmp_path, sheets, numbers):
    path = workbook_of(tmp_path / "a.xlsx", table(station=[*numbers]), sheets)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert all(f'--sheet "{name}"' in message or f"--sheet {name}" in message for name in sheets)


def test_sheets_whose_names_contradict_their_temperatures_are_asked_about(tmp_path):
    """25 and 80 °C by the sheets, and 25 in both columns."""
    path = workbook_of(tmp_path / "a.xlsx", table(station=[*range(1, 49)]), ("25C", "80C"))
    assert "2 tables of like columns" in refused(
        mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3
    )


def test_a_question_that_a_command_has_no_option_for_names_the_profile_that_answers_it(tmp_path):
    """`calibrate` has no --sheet: the profile says which sheet is meant."""
    columns, profile = table(station=[*range(1, 49)]), tmp_path / "t.toml"
    one = workbook_of(tmp_path / "one.xlsx", columns, ("25C",))
    assert mwdcal("profile", one, "-o", profile).code == 0
    two = workbook_of(tmp_path / "two.xlsx", columns, ("25C", "80C"))
    message = refused(mwdcal("calibrate", two, "--tool", profile, "-o", tmp_path / "t.json"), 2, 3)
    assert "mwdcal profile TABLE --sheet 25C -o TOOL.toml), and give --tool TOOL.toml" in message


def test_a_sheet_that_repeats_a_row_of_another_is_no_part_of_its_run(tmp_path):
    columns = table(station=[1] * 48)
    columns = {name: [*values[:24], *values[:24]] for name, values in columns.items()}
    path = workbook_of(tmp_path / "a.xlsx", columns, ("25C", "80C"))
    assert "2 tables of like columns" in refused(
        mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3
    )


def test_a_bad_cell_of_a_joined_sheet_is_named_with_its_sheet(tmp_path):
    columns = table(station=[*range(1, 49)])
    columns["Gy (V)"] = [*columns["Gy (V)"][:30], "see note", *columns["Gy (V)"][31:]]
    path = workbook_of(tmp_path / "a.xlsx", columns, ("Inc 5", "Inc 80"))
    letter = openpyxl.utils.get_column_letter([*columns].index("Gy (V)") + 1)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert f"sheet 'Inc 80', cell {letter}8, column 'Gy (V)'" in message


def test_a_number_of_a_workbook_has_no_separators_whatever_the_sign_of_its_texts(tmp_path):
    """1.234 in a cell of numbers is no 1234, though a column of texts has decimal commas."""
    columns = table()
    columns["Gx (V)"] = np.round(columns["Gx (V)"], 3)
    whole = read(written(tmp_path / "b.csv", columns))
    columns["Temp (C)"] = [f"{v:.1f}".replace(".", ",") for v in columns["Temp (C)"]]
    run = read(workbook_of(tmp_path / "a.xlsx", columns, ["Data"]))
    np.testing.assert_allclose(run.accelerometer, whole.accelerometer, rtol=0, atol=1e-9)


# ------------------------------------------------------------ answers that the readings give


def findings_of(proposal):
    """The texts of the findings on a proposal by id."""
    texts = {}
    for each in proposal.findings:
        texts[each.id] = f"{texts.get(each.id, '')} {each.text}".strip()
    return texts


def mixed(columns, seed=1):
    """The rows of a table in another order: toolfaces in equal steps may be numbers of rows."""
    order = np.random.default_rng(seed).permutation(48)
    return {name: [*np.asarray(values)[order]] for name, values in columns.items()}


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("unit", [1.0, 400 / 360, np.pi / 180])
def test_of_two_columns_of_one_angle_the_readings_do_not_choose(tmp_path, sense, unit):
    """One may be the stand's, in a unit or sense that no name tells, and the one that fits the tool's own."""
    columns = mixed(table())
    toolface = np.asarray(columns.pop("TF (deg)"), float)
    columns["TF"] = [*np.round(unit * (sense * toolface % 360), 4)]
    columns["TF 2"] = [*np.round(toolface + np.random.default_rng(3).normal(0, 0.5, 48), 2)]
    with pytest.raises(FitError, match="TF 2"):
        library.propose_profile(written(tmp_path / "a.csv", columns))


@pytest.mark.parametrize("name", ["Kolbo (°)", "Tollface (°)"])
def test_a_toolface_of_another_name_is_told_by_the_readings_and_named(tmp_path, name):
    columns = {(name if n == "TF (deg)" else n): v for n, v in mixed(table()).items()}
    path = written(tmp_path / "a.csv", columns)
    proposal = library.propose_profile(path)
    assert f"ref_toolface_deg={name}" in findings_of(proposal)["told-by-readings"]
    toolface = np.degrees(library.read_run(path, proposal.profile).reference("toolface"))
    assert toolface == pytest.approx(columns[name])
    plain = written(tmp_path / "b.csv", mixed(table()))
    assert "told-by-readings" not in findings_of(library.propose_profile(plain))


def test_what_the_readings_do_not_fit_is_asked(tmp_path):
    """Rolls that have nothing to do with the readings, and two columns that fit as well."""
    columns = mixed(table())
    face = np.array(columns.pop("TF (deg)"))
    for others in (
        {"Kolbo (°)": np.random.default_rng(3).permutation(face)},
        {"Kolbo (°)": face, "Kolbu (°)": face + 0.01},
    ):
        path = written(tmp_path / "a.csv", {**columns, **others})
        message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
        assert "no column is 'ref_toolface_deg' by its name" in message


@pytest.mark.parametrize("name", ["Kolbo (°)", "Azmi (deg)"])
def test_an_azimuth_of_another_name_is_told_by_the_readings_where_its_north_is_magnetic(
    tmp_path, name
):
    columns = {(name if n == "Azi (deg)" else n): v for n, v in mixed(table()).items()}
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert f"ref_azimuth_deg={name}" in findings_of(proposal)["told-by-readings"]
    columns[name] = [azimuth + 5.0 for azimuth in columns[name]]
    path = written(tmp_path / "b.csv", columns)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "no column is 'ref_azimuth_deg' by its name" in message


@pytest.mark.parametrize(("declination", "asked"), [(5.0, True), (-4.0, True), (0.5, False)])
def test_azimuths_from_another_north_are_asked_about_by_the_readings(tmp_path, declination, asked):
    """True azimuth is magnetic azimuth plus declination: magnetic north is at that azimuth."""
    columns = table()
    columns["Azi (deg)"] = (np.asarray(columns["Azi (deg)"]) + declination) % 360
    path = written(tmp_path / "a.csv", columns)
    if not asked:
        library.propose_profile(path)
        return
    with pytest.raises(FitError, match="by the readings magnetic north is at") as error:
        library.propose_profile(path)
    seen = float(re.search(r"north is at (\S+)°", str(error.value))[1])
    assert seen == pytest.approx(declination, abs=0.3)
    run = read(path, north="true", declination_deg=declination)
    plain = read(written(tmp_path / "b.csv", table()))
    assert run.reference("azimuth") == pytest.approx(plain.reference("azimuth"))


def test_radians_under_degrees_are_told_by_the_readings(tmp_path):
    columns = table(ref_toolface_deg=np.radians(servo_run()["ref_toolface_deg"]))
    path = written(tmp_path / "a.csv", columns)
    proposal = library.propose_profile(path)
    assert "TF (deg) (rad)" in findings_of(proposal)["told-by-readings"]
    toolface = np.degrees(library.read_run(path, proposal.profile).reference("toolface"))
    assert toolface == pytest.approx(servo_run()["ref_toolface_deg"])


@pytest.mark.parametrize("line", ["Fluxgate (V/µT),0.05", "Fluxgates 20 µT/V"])
@pytest.mark.parametrize(("field", "contradicted"), [("50000", False), ("56000", True)])
def test_a_sensitivity_above_the_names_shows_a_field_that_is_mistyped(
    tmp_path, line, field, contradicted
):
    """The channels give 5e-5 V a nT in a field of 50,000 nT: in one of 56,000 nT a ninth less."""
    columns = table(ref_field_nt=None)
    path = written(tmp_path / "a.csv", columns, line, f"Total field (nT),{field}")
    findings = findings_of(library.propose_profile(path))
    assert ("unit-contradicted" in findings) == contradicted
    assert not contradicted or "is the field 56000 nT?" in findings["unit-contradicted"]


@pytest.mark.parametrize(("factor", "contradicted"), [(1.0, False), (1e-3, True), (0.9, True)])
def test_a_unit_that_the_readings_contradict_is_named(tmp_path, factor, contradicted):
    """Under nT there are µT, or a field that is a tenth too small."""
    run = servo_run()
    names = {"Hx (V)": None, "Hy (V)": None, "Hz (V)": None}
    channels = {f"B{i} (nT)": run[f"m{i}"] / 5e-5 * factor for i in "xyz"}
    columns = {n: v for n, v in table().items() if n not in names} | channels
    findings = findings_of(library.propose_profile(written(tmp_path / "a.csv", columns)))
    assert ("unit-contradicted" in findings) == contradicted
    if contradicted:
        assert (
            "magnetometer: by its names nT, of which 1 make a nT" in findings["unit-contradicted"]
        )


def test_a_total_that_is_computed_in_another_unit_is_no_reference(tmp_path):
    run = servo_run()
    total = 1000 * np.linalg.norm([run[n] for n in ("ax", "ay", "az")], axis=0) / 3
    path = written(
        tmp_path / "a.csv", table(ref_gravity_g=None, **{"|G| (mg)": np.round(total, 2)})
    )
    proposal = library.propose_profile(path)
    assert "'|G| (mg)' is not used: it is computed" in findings_of(proposal)["not-used"]


def test_channels_too_large_for_a_norm_are_no_total(tmp_path):
    """Cells of 1e200 are refused in words, without a warning of NumPy."""
    path = written(tmp_path / "a.csv", table(ax=[1e200] * 48, ay=[-1e200, 1e200] * 24))
    assert mwdcal("profile", path, "-o", tmp_path / "t.toml").code in (2, 3)


# ---------------------------------------------------------------------- rows and cells of a run


def test_a_number_too_large_for_a_mean_is_named(tmp_path):
    """Without a warning of NumPy's, which the test session turns into an error."""
    columns = table()
    cells = [*map(str, columns["Gx (V)"])]
    cells[3] = cells[-1] = "1e309"
    columns["Gx (V)"] = cells
    message = refused(
        mwdcal("profile", written(tmp_path / "a.csv", columns), "-o", tmp_path / "t"), 2, 3
    )
    assert "Gx (V)" in message


@pytest.mark.parametrize(
    ("line", "unit"),
    [
        ("Temperatura en grados Fahrenheit", "°F"),
        ("G's in g, temp deg C.", "°C"),
        ("Temp 77 °F", ""),
    ],
)
def test_a_line_above_says_the_unit_of_temperatures(tmp_path, line, unit):
    """Not where it is the unit of a number: 76.6 may then be of either, and is asked about."""
    warm = table(**{"Temp (C)": None, "Temp": np.linspace(76.0, 77.5, 48)})
    path = written(tmp_path / "a.csv", warm, line, "")
    if not unit:
        with pytest.raises(FitError, match="whether it is in °C or °F"):
            library.propose_profile(path)
        return
    given = np.linspace(76.0, 77.5, 48)
    expected = (given - 32) / 1.8 if unit == "°F" else given
    assert np.allclose(read(path).temperature, expected)


def test_a_number_of_nines_among_others_like_it_is_a_reading(tmp_path):
    """999 mg beside 998 and 1001 mg; 999 far from all others stands for no reading."""
    mg = {n: np.round(servo_run()[n] / 3 * 1000, 2) for n in ("ax", "ay", "az")}
    mg["az"][np.argsort(np.abs(mg["az"] - 999))[0]] = 999
    mg["az"][np.argmax(mg["az"])] = 1003
    path = written(tmp_path / "a.csv", table(**mg))
    assert read(path).count == 48
    mg["az"][np.argmax(mg["az"])] = 999.99  # beyond the others by little
    assert read(written(tmp_path / "c.csv", table(**mg))).count == 48
    mg["az"][5] = 9999
    path = written(tmp_path / "b.csv", table(**mg))
    assert read(path).count == 47


def test_blank_angles_of_the_stand_are_named(tmp_path):
    cells = [f"{v:.2f}" for v in servo_run()["ref_inclination_deg"]]
    path = written(tmp_path / "a.csv", table(ref_inclination_deg=[*cells[:7], "", *cells[8:]]))
    assert "line 9 ('Inc (deg)')" in findings_of(library.propose_profile(path))["marked-rows"]


def of_seconds(angle, form):
    """An angle in degrees, minutes and seconds."""
    minutes, seconds = divmod(round(angle * 3600), 60)
    return form.format(minutes // 60, minutes % 60, seconds)


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ("{}-{:02}-{:02}", ""),
        ("{}:{:02}:{:02}", ""),
        ("{} {:02} {:02}", ""),
        ("{}d{:02}m{:02}s", ""),
        ("{}.{:02}{:02}", "Angles are D.MMSS"),
    ],
)
def test_degrees_minutes_and_seconds_with_other_signs(tmp_path, form, said):
    columns = table()
    names = ["Inc (deg)", "Azi (deg)", "TF (deg)"]
    exact = {name: np.round(np.asarray(columns[name]) * 3600) / 3600 for name in names}
    typed = {name: [of_seconds(angle, form) for angle in exact[name]] for name in names}
    path = written(tmp_path / "a.csv", columns | typed, said)
    run = read(path)
    for angle, name in zip(("inclination", "azimuth", "toolface"), names, strict=True):
        np.testing.assert_allclose(np.degrees(run.reference(angle)), exact[name], atol=1e-9)


def test_degrees_and_minutes_that_a_workbook_keeps_as_times(tmp_path):
    path = workbook_of(tmp_path / "a.xlsx", table(), ["run"])
    book = openpyxl.load_workbook(path)
    place = [*table()].index("Inc (deg)") + 1
    for (cell,) in book["run"].iter_rows(min_row=2, min_col=place, max_col=place):
        cell.value = datetime.timedelta(hours=cell.value)
        cell.number_format = "[h]:mm:ss"
    book.save(path)
    inclination = np.degrees(read(path).reference("inclination"))
    np.testing.assert_allclose(inclination, servo_run()["ref_inclination_deg"], atol=1e-9)


def test_a_title_block_beside_the_table(tmp_path):
    path = workbook_of(tmp_path / "a.xlsx", table(), ["run"])
    book = openpyxl.load_workbook(path)
    beside = [("Tool:", "DM"), ("Serial:", "DM-17"), ("Ref. dip:", "66.25 deg")]
    first = book["run"].max_column + 2
    for row, cells in enumerate(beside, 1):
        for column, cell in enumerate(cells, first):
            book["run"].cell(row, column, cell)
    book.save(path)
    proposal = library.propose_profile(path)
    run = library.read_run(path, proposal.profile)
    assert (run.count, run.metadata["serial"]) == (48, "DM-17")


def test_rows_that_are_struck_out_are_left_out(tmp_path):
    path = workbook_of(tmp_path / "a.xlsx", table(), ["run"])
    book = openpyxl.load_workbook(path)
    for row in (2, 7):
        for cell in book["run"][row]:
            cell.font = openpyxl.styles.Font(strike=True)
    book.save(path)
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 46
    assert "row 7 (struck out" in proposal.summary()


def test_a_table_on_a_hidden_sheet_is_not_read(tmp_path):
    run = table(station=[*range(1, 25)] * 2)
    path = workbook_of(tmp_path / "a.xlsx", run, ["2023", "2024"])
    with pytest.raises(FitError, match="2 tables of like columns"):
        library.propose_profile(path)
    book = openpyxl.load_workbook(path)
    book["2023"].sheet_state = "hidden"
    book.save(path)
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 24
    assert "sheet '2024'" in proposal.summary()
    assert "hidden sheets are not read: '2023'" in findings_of(proposal)["marked-rows"]


def test_sheets_of_few_rows_each_are_one_run(tmp_path):
    run = servo_run(inclinations=(20, 60, 100, 140), toolfaces=6)
    names = [f"Inc {inc}" for inc in (20, 60, 100, 140)]
    columns = {NAMES[name]: values for name, values in run.items()}
    del columns["Inc (deg)"]
    path = workbook_of(tmp_path / "a.xlsx", columns, names)
    inclination = np.degrees(read(path).reference("inclination"))
    np.testing.assert_allclose(inclination, run["ref_inclination_deg"])


def test_a_unit_of_temperatures_in_a_line(tmp_path):
    run = table()
    warm = np.asarray(run.pop("Temp (C)"), float)
    path = written(
        tmp_path / "a.csv", run | {"Temp": warm * 1.8 + 32}, "All temperatures in degrees F"
    )
    np.testing.assert_allclose(read(path).temperature, warm)


def test_sheets_of_temperatures_beside_one_of_a_roll_test(tmp_path):
    run = table(station=[*range(1, 49)])
    run["Temp (C)"] = np.repeat([20.0, 60.0, 40.0], 16)
    path = workbook_of(tmp_path / "a.xlsx", run, ["20 C", "60 C", "Rulletest"])
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 32
    assert "\nroll test: sheet 'Rulletest', 16 rows below row 1; not part" in proposal.summary()


def test_toolfaces_to_the_right_and_left_of_the_high_side(tmp_path):
    columns = table()
    exact = np.asarray(columns["TF (deg)"], float) % 360
    columns["TF (deg)"] = [f"{t}R" if t <= 180 else f"{360 - t}L" for t in exact.tolist()]
    path = write_csv(tmp_path / "a.csv", columns)
    np.testing.assert_allclose(np.degrees(read(path).reference("toolface")) % 360, exact, atol=1e-9)


@pytest.mark.parametrize("mark", ["superseded by line 12", "replaced by shot 7", "ersetzt durch 8"])
def test_a_row_in_whose_place_another_one_stands_is_left_out(tmp_path, mark):
    path = write_csv(tmp_path / "a.csv", table(Remarks=["", mark, *[""] * 46]))
    assert read(path).count == 47


@pytest.mark.parametrize("tools", [("Tool 4091", "Tool 4092"), ("Sonde A", "Sonde B")])
def test_pages_of_two_tools_are_no_one_run(tmp_path, tools):
    names, *rows = write_csv(tmp_path / "a.csv", table()).read_text().splitlines()
    path = tmp_path / "b.csv"
    path.write_text("\n".join([tools[0], names, *rows[:24], "", tools[1], names, *rows[24:]]))
    with pytest.raises(FitError, match="2 tables of like columns"):
        library.propose_profile(path)


@pytest.mark.parametrize("below_names", [False, True])
def test_rows_of_two_tools_below_lines_with_their_serials_are_asked_about(tmp_path, below_names):
    names, *rows = write_csv(tmp_path / "a.csv", table()).read_text().splitlines()
    other = [line.replace(line.split(",")[1], "20.0", 1) for line in rows[:24]]
    first = [names, "Tool S/N DM-17"] if below_names else ["Tool S/N DM-17", names]
    path = tmp_path / "b.csv"
    path.write_text("\n".join([*first, *rows, "Tool S/N ZZ-2", *other]))
    with pytest.raises(FitError, match="rows of 2 tools"):
        library.propose_profile(path)
    tool = tmp_path / "tool.toml"
    for serial, count in (("DM-17", 48), ("ZZ-2", 24)):
        assert mwdcal("profile", path, "-o", tool, "--replace", "--serial", serial).code == 0
        ran = mwdcal(
            "calibrate", path, "--tool", tool, "--serial", serial, "-o", tmp_path / "c.json"
        )
        assert f"{count} stations" in ran.out


@pytest.mark.parametrize(
    "heading", ["Roll test after calibration", "Контрольное вращение", "Verifikation"]
)
def test_a_roll_test_below_the_run_is_set_aside_and_named(tmp_path, heading):
    lines = write_csv(tmp_path / "a.csv", table()).read_text().splitlines()
    path = tmp_path / "b.csv"
    path.write_text("\n".join(["Calibration", *lines, "", heading, *lines[:13]]))
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 48
    assert "roll test: 12 rows below line " in proposal.summary()


@pytest.mark.parametrize(
    "remark", ["проверен уровень", "checked the bubble", "check of the bubble"]
)
@pytest.mark.parametrize("station", ["Pos", None])
def test_a_remark_on_a_check_between_rows_begins_no_roll_test(tmp_path, remark, station):
    columns = table(**({} if station else {"Pos": None, "station": None}))
    lines = write_csv(tmp_path / "a.csv", columns).read_text().splitlines()
    path = tmp_path / "b.csv"
    path.write_text("\n".join(["Calibration", *lines[:25], remark, *lines[25:]]), "utf-8")
    assert read(path).count == 48


def test_a_line_of_endless_words_states_nothing(tmp_path):
    """It would take minutes to be searched."""
    path = written(tmp_path / "a.csv", table(), "# " + "a." * 50_000)
    assert read(path).count == 48


def test_a_sheet_of_a_roll_test_is_set_aside_and_named(tmp_path):
    path = workbook_of(
        tmp_path / "a.xlsx", table(station=[*range(1, 49)]), ["Calibration", "Roll test"]
    )
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 24
    assert "sheet 'Calibration'" in proposal.summary()
    aside = "roll test: sheet 'Roll test', 24 rows below row 1; not part of the run"
    assert f"\n{aside}\n" in proposal.summary()
    tool = tmp_path / "tool.toml"
    proposal.save(tool)
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "a.json", "--rolltest", path)
    assert ", sheet 'Roll test'   24 stations" in ran.out.splitlines()[0], ran


def test_a_table_of_one_inclination_says_what_a_calibration_lacks(tmp_path):
    columns = {name: values[:12] for name, values in table().items()}
    ran = mwdcal("profile", write_csv(tmp_path / "a.csv", columns), "-o", tmp_path / "a.toml")
    assert "! all stations are at inclination 5°: mwdcal calibrate will refuse this run." in ran.err
    assert "next: add stations at other inclinations" in ran.out
    whole = mwdcal("profile", write_csv(tmp_path / "b.csv", table()), "-o", tmp_path / "b.toml")
    assert "all stations" not in whole.err
    assert "next: mwdcal calibrate" in whole.out


def test_a_proposed_profile_says_which_practice_of_the_stand_is_assumed(tmp_path):
    text = library.propose_profile(write_csv(tmp_path / "a.csv", table())).to_toml()
    explained, line = text.partition("# toolface_deg =\n")[2].splitlines()[:2]
    assert line.startswith(
        '# settings = "per-direction"   # set once, then the tool is rolled; assumed'
    )
    assert explained.endswith('If you set the stand again at every station, write "per-station":')


@pytest.mark.parametrize(("other", "named"), [("Roll test", True), ("Old void", False)])
def test_the_next_commands_name_a_roll_test_in_the_file_of_the_run(tmp_path, other, named):
    path = workbook_of(tmp_path / "a.xlsx", table(station=[*range(1, 49)]), ["Calibration", other])
    tool, page = tmp_path / "tool.toml", tmp_path / "cal.html"
    ran = mwdcal("profile", path, "-o", tool)
    assert (f"--rolltest {path}" in ran.out) == named, ran
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "cal.json", "--report", page)
    verify = f"mwdcal verify {tmp_path / 'cal.json'} {path if named else 'ROLLTEST.csv'}"
    assert f"next: {verify}\n" in ran.out, ran
    assert f"mwdcal verify cal.json {'a.xlsx' if named else 'ROLLTEST.csv'}" in page.read_text()


def test_verify_and_diagnose_take_the_roll_test_in_the_file_of_the_run(tmp_path):
    """The verdict is that of `calibrate --rolltest` and of the sheet alone; a file without one is refused."""
    whole, channels = table(station=[*range(1, 49)]), ["Calibration", "Roll test"]
    path = workbook_of(tmp_path / "a.xlsx", whole, channels)
    half = {name: cells[24:] for name, cells in whole.items()}
    alone = workbook_of(tmp_path / "roll.xlsx", half, ["Roll test"])
    calibrated(tmp_path, path)
    tool, cal = tmp_path / "tool.toml", tmp_path / "cal.json"
    at_once = mwdcal("calibrate", path, "--tool", tool, "-o", cal, "--rolltest", path, "--json")
    rows = [mwdcal("verify", cal, file, "--json").json["rows"] for file in (path, alone)] + [
        at_once.json["verification"]["rows"]
    ]
    assert rows[0] == rows[1] == rows[2]
    faults = [mwdcal("diagnose", cal, file, "--json").json["likelihoods"] for file in (path, alone)]
    assert faults[0] == faults[1]
    assert library.verify(cal, path).to_dict()["stations"] == 24
    first = workbook_of(tmp_path / "b.xlsx", {n: c[:24] for n, c in whole.items()}, ["Calibration"])
    assert "24 of 24 stations were in the fit" in refused(mwdcal("verify", cal, first), 2)


def formulas(columns, name):
    """Formulas in a column that no spreadsheet program has calculated."""
    return {**columns, name: [f"=C{k + 2}+1" for k in range(48)]}


def test_formulas_without_a_value_matter_only_where_they_are_needed(tmp_path):
    path = workbook_of(tmp_path / "a.xlsx", formulas(table(), "Gtot"), ["Data"])
    proposal = library.propose_profile(path)
    assert "'Gtot' is not used: its formulas have no value" in findings_of(proposal)["not-used"]
    assert library.read_run(path, proposal.profile).count == 48
    one = table()
    one["Gy (V)"] = [*one["Gy (V)"][:9], "=C2+1", *one["Gy (V)"][10:]]
    path = workbook_of(tmp_path / "b.xlsx", one, ["Data"])
    assert "got '=C2+1'" in refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    path = workbook_of(tmp_path / "c.xlsx", formulas(table(), "Gx (V)"), ["Data"])
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "could not tell which columns are the accelerometers (ax)" in message


def test_az_beside_az_g_is_the_azimuth_in_calibrate_too(tmp_path):
    run = servo_run()
    columns = {n: v for n, v in table().items() if n[0] not in "GA"}
    columns |= {"az": run["ref_azimuth_deg"], **{f"a{i}_g": run[f"a{i}"] for i in "xyz"}}
    path = written(tmp_path / "a.csv", columns)
    ran, _ = calibrated(tmp_path, path)
    assert "48 stations" in ran.out
    azimuth = np.degrees(read(path).reference("azimuth"))
    assert (azimuth - run["ref_azimuth_deg"] + 180) % 360 - 180 == pytest.approx(
        np.zeros(48), abs=1e-9
    )


def test_components_that_the_stand_states_are_no_channels(tmp_path):
    """Beside reference vectors the channels are those that the tool has measured."""
    run = servo_run()
    channels = {f"meas_{'gb'[n[0] == 'm']}{n[1]}": run[n] for n in channels_of(run)}
    vectors = {f"ref_{n[5:]}": np.round(v / 3, 2) for n, v in channels.items() if n[5] == "g"}
    others = {n: v for n, v in table().items() if n[0] not in "GH"}
    vectors.popitem()  # two components are no vector
    run = read(written(tmp_path / "a.csv", {**vectors, **others, **channels}))
    whole = read(written(tmp_path / "b.csv", table()))
    np.testing.assert_array_equal(run.accelerometer, whole.accelerometer)
    np.testing.assert_array_equal(run.magnetometer, whole.magnetometer)


@pytest.mark.parametrize(("unit", "per_nt"), [("nT", 1.0), ("A/m", 1 / (400 * np.pi))])
def test_reference_vectors_are_the_angles_and_strengths_of_the_stand(tmp_path, unit, per_nt):
    """Components along the tool axes, by the definition of inclination, azimuth and toolface."""
    run = servo_run()
    i, a, t = (np.radians(run[n]) for n in ANGLES)
    dip = np.radians(run["ref_dip_deg"])
    down = np.array([-np.sin(i) * np.sin(t), -np.sin(i) * np.cos(t), np.cos(i)])
    ca, sa, ct, st = np.cos(a), np.sin(a), np.cos(t), np.sin(t)
    north = np.array([ca * np.cos(i) * st + sa * ct, ca * np.cos(i) * ct - sa * st, ca * np.sin(i)])
    gravity = run["ref_gravity_g"] * down
    field = run["ref_field_nt"] * (np.cos(dip) * north + np.sin(dip) * down)
    vectors = {f"ref_g{n} (g)": gravity[k] for k, n in enumerate("xyz")}
    vectors |= {f"ref_b{n} ({unit})": field[k] * per_nt for k, n in enumerate("xyz")}
    stand = dict.fromkeys((*ANGLES, *PLACE))
    vectored = read(written(tmp_path / "a.csv", table(**stand, **vectors)))
    whole = read(written(tmp_path / "b.csv", table()))
    for name in ("inclination", "azimuth", "toolface", "gravity", "field", "dip"):
        difference = vectored.reference(name) - whole.reference(name)
        turned = (difference + np.pi) % (2 * np.pi) - np.pi
        off = difference if name in ("gravity", "field") else turned
        assert np.abs(off).max() < 1e-9 * max(1.0, np.abs(whole.reference(name)).max()), name


def test_a_comment_behind_a_unit_says_nothing_else(tmp_path):
    columns = {("Roll (deg, highside)" if n == "TF (deg)" else n): v for n, v in table().items()}
    run = read(written(tmp_path / "a.csv", columns))
    assert np.degrees(run.reference("toolface")) == pytest.approx(servo_run()["ref_toolface_deg"])


MORE_TITLES = (
    ([["Inclinazione magnetica (gon)", "68,000"], ["g locale (m/s2)", "9,80665"]],
     {"ref_dip_deg": 61.2, "ref_gravity_g": 1.0}),
    ([["地磁总场nT", "50110"]], {"ref_field_nt": 50_110.0}),
    ([["Feld (µT)", 48.77]], {"ref_field_nt": 48_770.0}),
    ([["field 50050 nT, dip 67.8 deg, nominal 2500 mV/g"]], {"ref_field_nt": 50_050.0, "ref_dip_deg": 67.8}),
)  # fmt: skip


@pytest.mark.parametrize(("rows", "place"), MORE_TITLES)
def test_more_words_of_a_title_block(rows, place):
    assert references_in(rows) == pytest.approx(place, rel=1e-12)


DECLINATIONS = (
    (["Declination: -1.62 deg"], -1.62),
    (["Declination", -1.62, "deg (E +)"], -1.62),
    (["Declination 3.4 W"], -3.4),
    (["Deklination 3,4° W"], -3.4),
    (["Магнитное склонение: +13,30° (восточное)"], 13.3),
    (["Déclinaison (°, est +)", "", 1.42], 1.42),
    (["Declination (° W +)", 1.42], -1.42),
)


@pytest.mark.parametrize(("row", "east"), DECLINATIONS)
def test_a_declination_keeps_its_sign(row, east):
    assert titles([row]).metadata["declination_deg"] == pytest.approx(east)


def test_grid_azimuths_are_turned_by_the_title(tmp_path):
    """grid = magnetic + declination - convergence."""
    run = servo_run()
    grid = (run["ref_azimuth_deg"] - 1.62 - 0.38) % 360
    columns = {("Azi grid (deg)" if n == "Azi (deg)" else n): v for n, v in table().items()}
    columns["Azi grid (deg)"] = grid
    path = written(
        tmp_path / "a.csv",
        columns,
        "Declination,-1.62 deg (E +)",
        "Grid convergence,0.38 deg (E +)",
    )
    difference = np.degrees(read(path).reference("azimuth")) - run["ref_azimuth_deg"]
    assert np.abs((difference + 180) % 360 - 180).max() < 1e-9


# --------------------------------------------------------------------------------- marked rows


def marked(name, cells, usual=""):
    """A column with texts at some stations, by number from 1."""
    return {name: [cells.get(k + 1, usual) for k in range(48)]}


REJECTED = {
    "Status": {7: "REJECT", 20: "reject"},
    "Merknad": {7: "FORKASTET - truck utenfor", 20: "ikke OK"},
    "Bewertung": {7: "n.i.O.", 20: "nicht OK"},
    "Observaciones": {7: "rechazada", 20: "anulado, mal contacto"},
    "Obs.": {7: "rejeitado", 20: "descartada"},
    "Примечание": {7: "брак", 20: "не годен"},
    "备注": {7: "作废", 20: "剔除"},
    "Not": {7: "GEÇERSİZ – araç geçti", 20: "kullanılmayacak"},
    "Uwagi": {7: "zakłócenie (wózek) – odrzucić", 20: "BŁĘDNA"},
    "Catatan": {7: "ditolak", 20: "getaran, tidak dipakai"},
    "Note": {7: "da scartare", 20: "à exclure"},
    "Obs": {7: "linha repetida, desconsiderar", 20: "row repeated, ignore"},
    "Opmerking": {7: "niet gebruiken", 20: "respins"},
    "Poznámka": {7: "neplatný", 20: "жарамсыз"},
    "Reject": {7: "x", 20: "x"},
}


@pytest.mark.parametrize("name", REJECTED)
def test_a_rejected_row_is_left_out_and_named(tmp_path, name):
    """The calibration is that of the table without the rows."""
    usual = "OK" if name in ("Status", "Bewertung") else ""
    path = written(tmp_path / "a.csv", table(**marked(name, REJECTED[name], usual)))
    keep = [k for k in range(48) if k + 1 not in REJECTED[name]]
    less = {n: [v[k] for k in keep] for n, v in table().items()}
    other = write_csv(tmp_path / "b.csv", less)
    (ran, one), (_, two) = (calibrated(tmp_path, each) for each in (path, other))
    assert one["accelerometer"]["parameters"] == two["accelerometer"]["parameters"]
    assert "left out: line 8 (" in ran.err
    assert "line 21 (" in ran.err
    assert "marked-rows" in [each["id"] for each in one["findings"]]


def roll_test(seed=5):
    """Twelve stations of the same tool at an inclination of its own."""
    inc, azi, face = plan((40,), 12)
    tool = Tool.random(1, noise=(1e-4, 15.0))
    g, b = (v[0] for v in tool.readings(np.random.default_rng(seed), 1, inc, azi, face))
    earth = (tool.gravity, tool.field, np.degrees(tool.dip))
    warmth = np.full(len(inc), 25.0)
    return {**stations(inc, azi, face, earth=earth, temperature_c=warmth), **channels(g, b)}


def test_a_verification_leaves_rejected_rows_out_too(tmp_path):
    calibrated(tmp_path, written(tmp_path / "a.csv", table()))
    rows = roll_test()
    rows["ax"][6] += 0.5
    columns = {NAMES[n]: v for n, v in rows.items()}
    columns["Status"] = ["REJECT" if k == 6 else "OK" for k in range(12)]
    ran = mwdcal("verify", tmp_path / "cal.json", written(tmp_path / "roll.csv", columns))
    assert ran.code == 0
    assert "11 stations" in ran.out
    assert "line 8 ('Status': REJECT)" in ran.err


@pytest.mark.parametrize(
    ("name", "cells", "usual", "text"),
    [
        ("Status", {7: "N"}, "OK", "N"), ("Flag", {7: "1"}, "0", "1"),
        ("Remarks", {7: "repeat of rejected 6"}, "", "repeat of rejected 6"),
        ("Obs", {7: "Fehler"}, "", "Fehler"), ("Result", {7: "FAIL"}, "PASS", "FAIL"),
    ],
)  # fmt: skip
def test_a_doubtful_mark_is_asked_about(tmp_path, name, cells, usual, text):
    path = written(tmp_path / "a.csv", table(**marked(name, cells, usual)))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert f"line 8: '{name}' says '{text}'" in message
    assert "--leave-out" in message
    assert "--keep" in message
    assert read(path, keep={name: [text]}).count == 48
    assert read(path, leave_out={name: [text]}).count == 47


@pytest.mark.parametrize(
    "text", ["stand levelled again", "ny måling av 21", "checked", "see logbook"]
)
def test_other_remarks_mark_nothing(tmp_path, text):
    assert read(written(tmp_path / "a.csv", table(**marked("Remarks", {7: text})))).count == 48


REMARKS = {
    7: "batu jatuh, lihat buku",
    20: "a truck went by and the whole hut shook for a long while, see page 12",
}


def test_remarks_that_are_not_understood_are_named_in_one_line(tmp_path):
    """In words that no list has: the rows count, and the reader decides."""
    said = "rows with remarks that mwdcal does not understand are used"
    path = written(tmp_path / "a.csv", table(**marked("Catatan", {3: "-", **REMARKS})))
    ran, _ = calibrated(tmp_path, path)
    assert "48 stations" in ran.out
    (line,) = (each for each in ran.err.split("! ") if said in " ".join(each.split()))
    plain = " ".join(line.split())
    assert f"line 8 ('Catatan': {REMARKS[7]}), line 21 ('Catatan': a truck went by" in plain
    assert "page 12" not in plain
    assert "leave_out or keep" in plain
    ran, _ = calibrated(tmp_path, path, "--leave-out", f"Catatan={REMARKS[7]}")
    assert "47 stations" in ran.out
    keep = [part for text in REMARKS.values() for part in ("--keep", f"Catatan={text}")]
    ran, _ = calibrated(tmp_path, path, *keep)
    assert said not in " ".join(ran.err.split())


def test_a_remark_is_named_once_where_its_rows_are_used_and_a_word_for_the_first_row_is_none(
    tmp_path,
):
    """Profile and calibrate name it once each; a row that is left out and the words start and end are not named."""
    remarks = {1: "Start", 8: "lihat buku", 9: "rejected", 48: "(end)"}
    path = written(tmp_path / "a.csv", table(**marked("Note", remarks)))
    tool, said = tmp_path / "tool.toml", "used: line 9 ('Note': lihat buku). To leave them out"
    for command in (("profile", path, "-o", tool), ("calibrate", path, "--tool", tool)):
        ran = mwdcal(
            *command, *(("-o", tmp_path / "cal.json") if command[0] == "calibrate" else ())
        )
        assert " ".join(ran.err.split()).count("lihat buku") == 1, ran
        assert said in " ".join(ran.err.split())


def of_two_days(first, second, form="%Y-%m-%d", temperatures=(25.0, 25.0)):
    """The runs of one tool on two days, one below the other, each with stations from 1."""
    tool = Tool.random(1, noise=(1e-4, 15.0))
    runs = [servo_run(k, temperatures=(t,), tool=tool) for k, t in enumerate(temperatures)]
    days = [
        f"{datetime.date.fromisoformat(day):{form}}" for day in (first, second) for _ in range(48)
    ]
    both = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    return table(**both, Date=days)


@pytest.mark.parametrize("form", ["%Y-%m-%d", "%d.%m.%Y 08:15"])
def test_two_runs_of_different_years_below_one_heading_are_named(tmp_path, form):
    """In the profile and in the calibration, with the row at which the second begins, and both days."""
    columns = of_two_days("2025-03-14", "2026-03-25", form)
    path, tool = written(tmp_path / "a.csv", columns), tmp_path / "tool.toml"
    said = "'Pos' begins again at line 50, and the date goes from 2025-03-14 to 2026-03-25."
    for command in (
        ("profile", path, "-o", tool),
        ("calibrate", path, "--tool", tool, "-o", tmp_path / "c"),
    ):
        assert said in " ".join(mwdcal(*command).err.split())
    columns["Date"] = [day if k in (0, 48) else "" for k, day in enumerate(columns["Date"])]
    assert said in " ".join(read(written(tmp_path / "once.csv", columns)).remarks)
    del columns["Pos"]
    (remark,) = read(written(tmp_path / "bare.csv", columns)).remarks
    assert "'Inc (deg)' begins again at line 50" in remark


@pytest.mark.parametrize("case", ["temperatures", "numbers go on", "a serial each"])
def test_days_of_one_run_are_not_two_runs(tmp_path, case):
    """Numbers that begin again at each temperature; numbers that go on after a summer; a table of two tools."""
    columns = of_two_days("2026-03-14", "2026-03-25", temperatures=(25.0, 80.0))
    if case != "temperatures":
        columns = of_two_days("2026-03-14", "2026-08-25")
    said = {}
    if case == "numbers go on":
        columns["Pos"] = np.arange(1, 97)
    if case == "a serial each":
        columns, said = {**columns, "Serial": ["A-1"] * 48 + ["A-2"] * 48}, {"serial": "A-2"}
    proposed = library.propose_profile(written(tmp_path / "a.csv", columns), **said)
    assert "begins again" not in " ".join(each.text for each in proposed.findings)


@pytest.mark.parametrize(
    "cells",
    [
        ["P1", "P2", "P3", "P4"] * 12, ["J. Ruiz"] * 48, ["08:15", *[""] * 47],
        ["OK", "ok", "gut", "bra", "bien", "bom"] * 8,
    ],
)  # fmt: skip
def test_labels_operators_times_and_judgements_are_no_remarks(tmp_path, cells):
    ran, _ = calibrated(tmp_path, written(tmp_path / "a.csv", table(Catatan=cells)))
    assert "does not understand" not in " ".join(ran.err.split())


def test_a_rejected_row_can_be_kept(tmp_path):
    path = written(tmp_path / "a.csv", table(**marked("Status", {7: "REJECT"}, "OK")))
    ran, _ = calibrated(tmp_path, path, "--keep", "Status=REJECT")
    assert "48 stations" in ran.out
    assert 'keep = {Status = ["REJECT"]}' in (tmp_path / "tool.toml").read_text()


def test_a_row_that_repeats_another_in_every_cell_counts_once(tmp_path):
    columns = {n: np.append(v, v[10]) for n, v in table().items()}
    ran, one = calibrated(tmp_path, written(tmp_path / "a.csv", columns))
    _, two = calibrated(tmp_path, written(tmp_path / "b.csv", table()))
    assert one["magnetometer"]["parameters"] == two["magnetometer"]["parameters"]
    assert "left out: line 50 (every cell as in line 12)" in ran.err


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_apply_marks_utf_8_at_its_start_alone(tmp_path, mark):
    """A spreadsheet needs the mark for the degree; in front of a name it would hide the column from a reader."""
    columns = table()
    columns["Temp (°C)"] = columns.pop("Temp (C)")
    path = written(tmp_path / "a.csv", columns, delimiter=";")
    path.write_bytes(mark + path.read_bytes())
    calibrated(tmp_path, path)
    out = tmp_path / "out.csv"
    assert mwdcal("apply", tmp_path / "cal.json", path, "-o", out).code == 0
    content = out.read_bytes()
    assert content.startswith(b"\xef\xbb\xbf")
    assert content.count(b"\xef\xbb\xbf") == 1
    names = [*pandas.read_csv(out, comment="#", sep=";")]
    assert names[: len(columns)] == [*columns]


def test_apply_keeps_every_row(tmp_path):
    calibrated(tmp_path, written(tmp_path / "a.csv", table()))
    path = written(tmp_path / "b.csv", table(**marked("Status", {7: "REJECT"}, "OK")))
    assert mwdcal("apply", tmp_path / "cal.json", path, "-o", tmp_path / "out.csv").code == 0
    lines = (tmp_path / "out.csv").read_text("utf-8-sig").splitlines()
    assert sum(not line.startswith("#") for line in lines) == 49


@pytest.mark.parametrize(
    "words", [("as found", "as left"), ("校准前", "校准后"), ("før justering", "etter justering")]
)
def test_runs_before_and_after_an_adjustment_are_two(tmp_path, words):
    if words[0] == "as found":
        words = ("before adjustment", "after adjustment")
    columns = {n: np.concatenate([v, v]) for n, v in table().items()}
    columns["State"] = [words[0]] * 48 + [words[1]] * 48
    path = written(tmp_path / "a.csv", columns)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "holds 2 runs, of which 'State' says" in message
    assert read(path, leave_out={"State": [words[0]]}).count == 48


def test_a_second_table_below_is_taken_by_its_row_in_every_command(tmp_path):
    lines = write_csv(tmp_path / "a.csv", table()).read_text().splitlines()
    path = tmp_path / "b.csv"
    path.write_text("\n".join(["BEFORE ADJUSTMENT", *lines, "", "AFTER ADJUSTMENT", *lines]))
    assert "2 tables of like columns" in refused(
        mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3
    )
    ran, _ = calibrated(tmp_path, path, "--header-row", "53")
    assert "48 stations" in ran.out


# ------------------------------------------------------------------------- names, units, cells


def test_names_that_stand_twice_are_told_apart(tmp_path):
    names = ["Pos", "T", "X", "Y", "Z", "X", "Y", "Z", "Inc", "Azi", "TF"]
    run = servo_run()
    columns = [
        run[n] for n in ("station", "temperature_c", "ax", "ay", "az", "mx", "my", "mz", *ANGLES)
    ]
    path = tmp_path / "a.csv"
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([names, *zip(*columns, strict=True)])
    proposal = library.propose_profile(path)
    assert "ax=X, ay=Y, az=Z" in findings_of(proposal)["told-by-readings"]
    assert "mx=X (2), my=Y (2), mz=Z (2)" in findings_of(proposal)["told-by-readings"]
    answers = dict(zip(channels_of(run), ["X", "Y", "Z", "X (2)", "Y (2)", "Z (2)"], strict=True))
    result = read(path, column=answers)
    assert result.magnetometer is not None
    assert result.temperature == pytest.approx(run["temperature_c"])


ANGLES = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")


def channels_of(run):
    return [name for name in ("ax", "ay", "az", "mx", "my", "mz") if name in run]


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("Dpi", "ref_dip_deg"), ("Inklinatoin", "ref_dip_deg"), ("Btotall", "ref_field_nt"),
        ("Totalfedl", "ref_field_nt"), ("Tmep", "temperature_c"), ("Garvity", "ref_gravity_g"),
    ],
)  # fmt: skip
def test_a_mistyped_name_is_asked_about(tmp_path, name, meant):
    columns = {(name if n == NAMES[meant] else n): v for n, v in table().items()}
    path = written(tmp_path / "a.csv", columns)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert f"no column is '{meant}' by its name" in message
    assert f"--column {meant}={name}" in message


@pytest.mark.parametrize("name", ["Shift", "Stand no", "Trip", "Setup", "Tip", "Depth"])
def test_other_names_are_none_of_them(tmp_path, name):
    path = written(
        tmp_path / "a.csv", table(**{"ref_dip_deg": None, name: np.tile([1.0, 2.0], 24)})
    )
    unused = [f.text for f in library.propose_profile(path).findings if f.id == "unused-columns"]
    if name != "Tip":
        assert unused == [f"columns not used: '{name}'."]


@pytest.mark.parametrize("above", [(), ("Serial,4711",)])
def test_a_first_column_headed_by_its_sign_alone_is_called_so(tmp_path, above):
    """As rows are numbered below '#': no message calls it 'column 1', which is for a heading without a name."""
    for heading, called in (("#", "#"), ("", "column 1"), ("# Shot", "Shot")):
        columns = {heading: np.arange(1, 49) % 7, **table()}
        del columns["Pos"]
        path = written(tmp_path / "a.csv", columns, *above)
        proposal = library.propose_profile(path)
        unused = findings_of(proposal).get("unused-columns", "")
        taken = {source.name for source in proposal.profile.columns.values()}
        assert called in taken or unused == f"columns not used: '{called}'."


def test_units_that_contradict_each_other_are_both_named(tmp_path):
    columns = {("Btotal (µT)" if n == "Btotal (nT)" else n): v for n, v in table().items()}
    units = {"Btotal (µT)": "nT", "Gx (V)": "V", "Gy (V)": "V", "Gz (V)": "V"}
    names, *rows = write_csv(tmp_path / "a.csv", columns).read_text().splitlines()
    path = tmp_path / "b.csv"
    path.write_text("\n".join([names, ",".join(units.get(n, "") for n in columns), *rows]))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "'Btotal (µT)' is in µT and nT" in message
    run = read(path, column={"ref_field_nt": "Btotal (µT) (nT)"})
    assert run.reference("field") == pytest.approx(servo_run()["ref_field_nt"])


@pytest.mark.parametrize(
    ("column", "factor", "stated", "fits"),
    [
        ("ref_field_nt", 1e-3, "nT", "µT"),
        ("ref_gravity_g", 9.80665, "g", "m/s²"),
    ],
)
def test_values_that_contradict_their_unit_are_asked_about(tmp_path, column, factor, stated, fits):
    path = written(tmp_path / "a.csv", table(**{column: servo_run()[column] * factor}))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert f"is in {stated}, and its values" in message
    assert f"are those of {fits}" in message


@pytest.mark.parametrize("text", ["#N/A", "74..95", "see note"])
@pytest.mark.parametrize("column", ["ref_azimuth_deg", "ay"])
def test_a_cell_without_a_reading_is_named_with_the_option_that_leaves_its_row_out(
    tmp_path, column, text
):
    cells = [repr(float(v)) for v in servo_run()[column]]
    path = written(tmp_path / "a.csv", table(**{column: [*cells[:9], text, *cells[10:]]}))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert f"line 11, column '{NAMES[column]}'" in message
    assert f'--leave-out "{NAMES[column]}={text}"' in message
    assert read(path, leave_out={NAMES[column]: [text]}).count == 47


def test_a_lost_decimal_point_is_asked_about(tmp_path):
    cells = [f"{v:.5f}" for v in servo_run()["az"]]
    wrong = cells[9].replace(".", "")
    path = written(tmp_path / "a.csv", table(az=[*cells[:9], wrong, *cells[10:]]))
    assert f"got '{wrong}'" in refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)


def test_a_wrong_cell_of_a_workbook_is_named_as_the_program_names_it(tmp_path):
    columns = table()
    book = openpyxl.Workbook()
    book.active.title = "Roll test"
    for row in (["Title"], [], [*columns], *zip(*columns.values(), strict=True)):
        book.active.append([v.item() if hasattr(v, "item") else v for v in row])
    place = f"{openpyxl.utils.get_column_letter([*columns].index('Gy (V)') + 1)}9"
    book.active[place] = "see note"
    book.save(tmp_path / "run.xlsx")
    message = refused(mwdcal("profile", tmp_path / "run.xlsx", "-o", tmp_path / "t.toml"), 3)
    assert f"sheet 'Roll test', cell {place}, column 'Gy (V)'" in message


def test_magnetometers_of_unknown_names_with_an_offset_are_told_and_named(tmp_path):
    """The norm of channels that read 2.5 V at no field is not steady; their distance from the middle is."""
    run = servo_run()
    others = {f"CH{k} (V)": run[n] + 2.5 for k, n in enumerate(("mx", "my", "mz"), 5)}
    path = written(tmp_path / "a.csv", table(mx=None, my=None, mz=None, **others))
    proposal = library.propose_profile(path)
    assert "mx=CH5 (V), my=CH6 (V), mz=CH7 (V)" in findings_of(proposal)["told-by-readings"]
    rows = read(path, column={"mx": "CH5 (V)", "my": "CH6 (V)", "mz": "CH7 (V)"})
    np.testing.assert_array_equal(
        library.read_run(path, proposal.profile).magnetometer, rows.magnetometer
    )


WORDS = {
    "cp1250": [
        "Kąt odchylenia [°]",
        "Azymut [°]",
        "Kąt ustawienia narzędzia [°]",
        "Przysp. {} [V]",
        "Pole magn. {} [V]",
    ],
    "cp1254": ["Eğim (°)", "Azimut (°)", "Takım yüzü (°)", "İvme {} (V)", "Manyetik {} (V)"],
    "cp932": ["傾斜角[deg]", "方位角[deg]", "ツールフェース[deg]", "加速度{}[V]", "磁気{}[V]"],
}


@pytest.mark.parametrize("encoding", WORDS)
def test_encodings_without_a_mark_are_told_by_words_of_the_field(tmp_path, encoding):
    run, words = servo_run(), WORDS[encoding]
    columns = dict(zip(words[:3], (run[n] for n in ANGLES), strict=True))
    for name, triad in zip(words[3:], ("a", "m"), strict=True):
        columns |= {name.format(axis.upper()): run[f"{triad}{axis}"] for axis in "xyz"}
    path = written(tmp_path / "a.csv", columns, encoding=encoding)
    result = read(path)
    assert np.degrees(result.reference("inclination")) == pytest.approx(run["ref_inclination_deg"])
    assert result.magnetometer is not None


def test_az_is_the_azimuth_where_another_column_is_the_channel(tmp_path):
    names = {"ref_azimuth_deg": "AZ", "ax": "AX", "ay": "AY", "az": "AZ_"}
    columns = {names.get(n, NAMES[n]): v for n, v in servo_run().items()}
    run = read(written(tmp_path / "a.csv", columns))
    assert np.degrees(run.reference("azimuth")) == pytest.approx(servo_run()["ref_azimuth_deg"])


def test_rows_numbered_under_s_n_are_stations(tmp_path):
    columns = {("S/N" if n == "Pos" else n): v for n, v in table().items()}
    assert read(written(tmp_path / "a.csv", columns)).count == 48


# ------------------------------------------------------------------------------- after a FAIL


def test_a_failed_roll_test_leads_on(tmp_path):
    calibrated(tmp_path, written(tmp_path / "a.csv", table()))
    rows = roll_test()
    rows["ax"] = rows["ax"] + 0.06
    roll = written(tmp_path / "roll.csv", {NAMES[n]: v for n, v in rows.items()})
    cal = tmp_path / "cal.json"
    ran = mwdcal("verify", cal, roll)
    assert ran.code == 1
    assert re.search(r"^measure again: station \d+; station \d+$", ran.out, re.MULTILINE)
    assert f"next: mwdcal diagnose {cal} {roll}" in ran.out
    machine = mwdcal("verify", cal, roll, "--json").json["findings"][-1]
    assert machine["id"] == "next-step"
    assert "mwdcal diagnose cal.json roll.csv" in machine["text"]
    both = mwdcal(
        "calibrate",
        tmp_path / "a.csv",
        "--tool",
        tmp_path / "tool.toml",
        "-o",
        cal,
        "--rolltest",
        roll,
        "--json",
    )
    assert both.code == 1
    assert both.json["verification"]["findings"][-1]["id"] == "next-step"


def test_a_fleet_leaves_rejected_rows_out_too_and_says_so(tmp_path):
    """A folder of two runs: the one with the rejected row has as many stations less."""
    folder = tmp_path / "runs"
    folder.mkdir()
    run = servo_run()
    write_csv(folder / "A1.csv", {**run, **marked("Status", {7: "REJECT"}, "OK")})
    write_csv(folder / "A2.csv", run)
    ran = mwdcal("fleet", folder, "-o", tmp_path / "cals.parquet", "--tool", "servo", "--json")
    assert ran.code == 0, ran
    assert ran.json["stations"] == 95
    assert "A1.csv: rows that are rejected" in ran.err
    assert "line 8 ('Status': REJECT)" in ran.err


def test_a_profile_of_a_workbook_reads_it_once(tmp_path, monkeypatch):
    opened, whole = [], openpyxl.load_workbook
    tables.write(tmp_path / "run.xlsx", tables.read("examples/servo/run.csv"))
    monkeypatch.setattr(
        openpyxl, "load_workbook", lambda *a, **k: opened.append(a) or whole(*a, **k)
    )
    assert library.propose_profile(tmp_path / "run.xlsx").profile.table == msgspec.UNSET
    assert len(opened) == 1


@pytest.mark.parametrize("columns", [("ref_azimuth_deg", "ref_field_nt", "ref_dip_deg"), ()])
def test_a_triad_of_unknown_names_is_told_by_the_readings(tmp_path, columns):
    """With or without a reference of the field: magnetometers are never left out in silence."""
    renamed = {"Hx (V)": "Kolbo 1", "Hy (V)": "Kolbo 2", "Hz (V)": "Kolbo 3"}
    whole = mixed(table(**dict.fromkeys(columns)))
    unknown = {renamed.get(name, name): values for name, values in whole.items()}
    path = written(tmp_path / "a.csv", unknown)
    if columns:
        assert "Are these the magnetometers" in refused(
            mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3
        )
    else:
        np.testing.assert_allclose(
            read(path).magnetometer, read(written(tmp_path / "b.csv", whole)).magnetometer
        )


def test_toolfaces_in_steps_from_another_start_each_time_are_no_numbers_of_rows(tmp_path):
    starts = np.repeat([0.0, 7.0, 14.0, 21.0], 12)
    face = (np.asarray(servo_run()["ref_toolface_deg"]) + starts) % 360
    assert is_numbering(np.arange(1.0, 49))
    assert is_numbering(np.tile(np.arange(1.0, 11), 5))
    assert not is_numbering(face)


@pytest.mark.parametrize("total", ["Betrag", "Kolbo", "Summe"])
def test_a_total_in_whatever_words_is_no_reference_of_the_field(tmp_path, total):
    run = servo_run()
    norm = np.linalg.norm([run[n] for n in ("mx", "my", "mz")], axis=0) / 5e-5
    columns = table(ref_field_nt=None, **{f"{total} (nT)": np.round(norm, 1)})
    assert (
        "ref_field_nt"
        not in library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    )


def test_a_column_that_turns_is_no_gravity_by_a_name_that_is_near(tmp_path):
    columns = {
        ("Stand gtf (deg)" if n == "TF (deg)" else n): v
        for n, v in mixed(table(ref_gravity_g=None)).items()
    }
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert proposal.profile.columns["ref_toolface_deg"].name == "Stand gtf (deg)"


def test_columns_that_old_programs_frame_and_number(tmp_path):
    plain = read(written(tmp_path / "a.csv", table()))
    lines = (tmp_path / "a.csv").read_text().splitlines()
    numbers = ",".join(str(k + 1) for k in range(lines[0].count(",") + 1))
    rows = [lines[0], numbers, *lines[1:]]
    drawn = ["! " + " ! ".join(row.split(",")) + " !" for row in rows]
    (tmp_path / "b.txt").write_text("\n".join(["=" * 80, *drawn, "=" * 80]))
    framed = read(tmp_path / "b.txt")
    np.testing.assert_array_equal(framed.accelerometer, plain.accelerometer)
    np.testing.assert_array_equal(framed.magnetometer, plain.magnetometer)


def test_degrees_and_minutes_in_chinese_are_angles(tmp_path):
    columns = table()
    face = np.round(np.asarray(columns["TF (deg)"])).astype(int)
    columns["TF (deg)"] = [f"{value}度30分" for value in face]
    run = read(written(tmp_path / "a.csv", columns))
    np.testing.assert_allclose(np.degrees(run.reference("toolface")), face + 0.5)


def test_an_angle_whose_cells_are_not_understood_is_asked_about(tmp_path):
    columns = table()
    columns["TF (deg)"] = [f"{value:.0f} and a bit" for value in columns["TF (deg)"]]
    path = written(tmp_path / "a.csv", columns)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "'TF (deg)' is called 'ref_toolface_deg', and its cells" in message


@pytest.mark.parametrize("sense", [1, -1])
def test_a_dip_that_turns_is_that_of_the_hole(tmp_path, sense):
    """Up or down: the sense is the one by which the channels are a right-handed set."""
    columns = table(ref_dip_deg=None)
    inclination = np.asarray(columns.pop("Inc (deg)"))
    path = written(tmp_path / "a.csv", {**columns, "Dip": sense * (90 - inclination)})
    run, plain = read(path), read(written(tmp_path / "b.csv", table()))
    np.testing.assert_allclose(run.reference("inclination"), plain.reference("inclination"))


@pytest.mark.parametrize("heading", ["Тест вращением (только контроль)", "Айналдыру сынағы"])
def test_rows_below_a_heading_of_a_roll_test_are_none_of_the_run(tmp_path, heading):
    columns = table()
    path = written(tmp_path / "a.csv", columns)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, "", heading, lines[0], *lines[1:13]]))
    assert len(read(path)) == len(lines) - 1


def test_channels_by_axes_in_turn_are_told_by_the_readings(tmp_path):
    """Acc, Mag, Acc, Mag: each second column, in whatever words."""
    columns, turned = mixed(table()), {}
    for axis in "xyz":
        turned |= {f"Voie {axis} ga": columns.pop(f"G{axis} (V)")}
        turned |= {f"Voie {axis} ma": columns.pop(f"H{axis} (V)")}
    run = read(written(tmp_path / "a.csv", {**turned, **columns}))
    plain = read(written(tmp_path / "b.csv", mixed(table())))
    np.testing.assert_array_equal(run.accelerometer, plain.accelerometer)
    np.testing.assert_array_equal(run.magnetometer, plain.magnetometer)


def test_three_names_of_one_stem_and_a_unit_of_one_triad_are_its_channels():
    names = ["acx mg", "acy mg", "acz mg", "Kolbo-x [nT]", "Kolbo-y [nT]", "Kolbo-z [nT]"]
    found = {name: m.column for name, m in meanings_of(names, [""] * len(names)).items()}
    assert found == dict(zip(names, ("ax", "ay", "az", "mx", "my", "mz"), strict=True))
    others = ["Density g", "Delta x g", "Delta y g", "Delta z g"]
    assert not meanings_of(others, [""] * len(others))


def test_drift_is_the_inclination_where_no_other_column_is(tmp_path):
    columns = {("DRIFT" if n == "Inc (deg)" else n): v for n, v in table().items()}
    assert (
        library.propose_profile(written(tmp_path / "a.csv", columns))
        .profile.columns["ref_inclination_deg"]
        .name
        == "DRIFT"
    )


def test_a_mean_in_a_title_is_named_as_no_reference():
    assert doubtful_in([["mean dip 65.9 degrees"]]) == {"ref_dip_deg": "mean dip 65.9 degrees"}


def test_a_reference_standard_is_no_standard_deviation():
    stated = references_in([["Ref. std.: g = 978.86 Gal, F = 459.2 mGauss"]])
    assert stated == pytest.approx({"ref_gravity_g": 9.7886 / 9.80665, "ref_field_nt": 45_920.0})


def test_a_reference_field_of_each_row_is_no_total(tmp_path):
    """It follows no norm of channels, though it is its own norm beside small numbers."""
    drift = 48_000 + 3 * np.sin(np.arange(48) / 5)
    columns = table(ref_field_nt=None, **{"F_ref (nT)": np.round(drift, 1)})
    path = written(tmp_path / "a.csv", columns)
    assert library.propose_profile(path).profile.columns["ref_field_nt"].name == "F_ref (nT)"


def test_of_two_temperatures_the_panel_of_the_logger_is_not_the_tool(tmp_path):
    columns = {("ToolTemp_Avg" if n == "Temp (C)" else n): v for n, v in table().items()}
    path = written(tmp_path / "a.csv", {"PTemp_C": np.linspace(20, 21, 48), **columns})
    assert library.propose_profile(path).profile.columns["temperature_c"].name == "ToolTemp_Avg"


def test_letters_of_series_below_a_serial_are_no_tools(tmp_path):
    columns = {"Serie": np.repeat([*"ABCD"], 12), **table()}
    path = written(tmp_path / "a.csv", columns, "Serienummer 4410-N")
    assert len(read(path)) == 48
    with pytest.raises(FitError, match="Are these tools"):
        read(written(tmp_path / "b.csv", columns))


def test_triads_on_two_sheets_with_axes_in_chinese_are_one_run(tmp_path):
    columns, book = table(), openpyxl.Workbook()
    book.remove(book.active)
    stand = {
        "编号": "Pos",
        "井斜角 °": "Inc (deg)",
        "方位角 °": "Azi (deg)",
        "工具面 °": "TF (deg)",
        "Btotal (nT)": "Btotal (nT)",
        "Dip (deg)": "Dip (deg)",
    }
    for sheet, letter, unit in (("加表", "G", "mV"), ("磁表", "H", "V")):
        page = book.create_sheet(sheet)
        axes = {f"{axis.upper()}轴 {unit}": f"{letter}{axis} (V)" for axis in "xyz"}
        names = {**stand, **axes}
        page.append([*names])
        for row in zip(*(columns[each] for each in names.values()), strict=True):
            page.append([v.item() if hasattr(v, "item") else v for v in row])
    book.save(tmp_path / "a.xlsx")
    run, plain = read(tmp_path / "a.xlsx"), read(written(tmp_path / "b.csv", columns))
    np.testing.assert_allclose(run.magnetometer, plain.magnetometer, rtol=1e-12)


def test_a_sheet_whose_title_is_a_roll_test_is_none_of_the_run(tmp_path):
    columns, book = table(), openpyxl.Workbook()
    book.remove(book.active)
    for sheet, title, count in (
        ("Calibração", "Planilha", 48),
        ("Rolagem", "TESTE DE ROLAGEM (verificação)", 12),
    ):
        page = book.create_sheet(sheet)
        for row in (
            [title],
            ["Ferramenta no berço"],
            [*columns],
            *[*zip(*columns.values(), strict=True)][:count],
        ):
            page.append([v.item() if hasattr(v, "item") else v for v in row])
    book.save(tmp_path / "a.xlsx")
    assert len(read(tmp_path / "a.xlsx")) == 48


def test_blanks_and_bars_part_columns_and_the_last_units_stand_right(tmp_path):
    run = table(ref_gravity_g=None, ref_field_nt=None, ref_dip_deg=None)
    names = [each.split()[0] for each in run]
    rows = [
        f"│ {k + 1:>2} │ " + " ".join(f"{value:9.4f}" for value in row)
        for k, row in enumerate(zip(*[*run.values()][1:], strict=True))
    ]
    head = "│  N │ " + " ".join(f"{name:>9}" for name in names[1:])
    (tmp_path / "a.txt").write_text("\n".join([head, "├────┼─────", *rows]))
    found = read(tmp_path / "a.txt")
    np.testing.assert_allclose(
        found.accelerometer, read(written(tmp_path / "b.csv", run)).accelerometer, atol=1e-4
    )


def test_channels_of_unknown_words_are_in_the_order_of_their_letters(tmp_path):
    columns = mixed(table())
    for axis in "yxz":
        columns[f"Kolbo. {axis.upper()}"] = columns.pop(f"H{axis} (V)")
    found = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [found[f"m{axis}"].name for axis in "xyz"] == ["Kolbo. X", "Kolbo. Y", "Kolbo. Z"]


@pytest.mark.parametrize(
    "line", ["Feld etwa 49,5 µT", "Campo 460 mG aprox.", "campo 460 mG (valores nominales)"]
)
def test_a_rough_value_is_no_reference_and_is_named(line):
    assert references_in([[line]]) == {}
    assert [*doubtful_in([[line]])] == ["ref_field_nt"]


def test_a_count_of_stations_below_the_last_is_no_station_that_was_cut(tmp_path):
    columns = {n.split()[0]: v for n, v in table(ref_gravity_g=None).items()}
    path = written(tmp_path / "a.txt", columns, delimiter=" ")
    path.write_text(path.read_text() + "\n48 POINTS ACCEPTED 0 REJECTED\n")
    assert len(read(path)) == 48


@pytest.mark.parametrize(("remark", "asked"), [("ausgeschlossen", False), ("gestört", True)])
def test_rejections_in_german(tmp_path, remark, asked):
    remarks = [remark if row == 7 else "" for row in range(48)]
    path = written(tmp_path / "a.csv", {**table(), "Bemerkung": remarks})
    if asked:
        with pytest.raises(FitError, match="rejected station"):
            read(path)
    else:
        assert len(read(path)) == 47


@pytest.mark.parametrize("column", [True, False])
def test_a_temperature_above_the_names_alone_is_named_as_not_used(tmp_path, column):
    columns = table(**({} if column else {"temperature_c": None}))
    path = written(tmp_path / "a.csv", columns, "Stand temperature,22.5 degC")
    texts = findings_of(library.propose_profile(path))
    assert ("22.5 degC' is not used" in texts.get("not-used", "")) == (not column)


def test_blanks_between_thousands_part_no_column(tmp_path):
    """Names with a comma before their unit, and counts as people write them: -32 011."""
    codes = {n: np.round(1e5 * v) for n, v in table().items() if n[0] in "GH"}
    grouped = {
        f"АЦП {'a' if n[0] == 'G' else 'm'}{n[1]}, код": [f"{v:,.0f}".replace(",", " ") for v in c]
        for n, c in codes.items()
    }
    others = {n: v for n, v in table().items() if n[0] not in "GH"}
    one = read(written(tmp_path / "a.csv", {**others, **grouped}, delimiter=";"))
    other = read(written(tmp_path / "b.csv", {**others, **codes}))
    np.testing.assert_array_equal(one.accelerometer, other.accelerometer)
    np.testing.assert_array_equal(one.magnetometer, other.magnetometer)
