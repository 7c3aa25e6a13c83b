"""A laboratory's later table is laid out otherwise: no command that reads tables by a profile minds."""

import csv
import json
import shutil

import openpyxl
import pytest

from cli_support import ROOT, mwdcal

EXAMPLES = ROOT / "examples" / "laboratories"


def with_text(change):
    """A change of the lines of a text of semicolons, whose names stand in line 6."""

    def changed(path):
        lines = path.read_text("cp1252").split("\n")
        path.write_text("\n".join(change(lines)), "cp1252")

    return changed


def with_rows(change):
    """A change of the workbook."""

    def changed(path):
        book = openpyxl.load_workbook(path)
        change(book)
        book.save(path)

    return changed


def column_in_front(lines):
    return [
        *lines[:5],
        "Halle;" + lines[5],
        *(f"B;{each}" if each[:1].isdigit() else each for each in lines[6:]),
    ]


def first_sheet_last(book):
    book.move_sheet(book.worksheets[0], len(book.worksheets))


def sheet_in_front(book):
    book.create_sheet("Weather", 0).append(["Rain", "since", "Monday"])


def column_behind(book):
    sheet = book.worksheets[1]
    sheet.cell(8, sheet.max_column + 1, "Shift")
    for row in range(10, sheet.max_row + 1):
        if sheet.cell(row, 2).value is not None:
            sheet.cell(row, sheet.max_column, "A")


CHANGES = {
    "remark line": ("celle_c1187", ".csv", with_text(lambda lines: ["Strom fiel aus", *lines])),
    "column in front": ("celle_c1187", ".csv", with_text(column_in_front)),
    "remark row": (
        "aberdeen_job_0117",
        ".xlsx",
        with_rows(lambda b: b.worksheets[1].insert_rows(2)),
    ),
    "column behind": ("aberdeen_job_0117", ".xlsx", with_rows(column_behind)),
    "other order of sheets": ("aberdeen_job_0117", ".xlsx", with_rows(first_sheet_last)),
    "one more sheet": ("aberdeen_job_0117", ".xlsx", with_rows(sheet_in_front)),
}
RESULTS = ("inclination", "toolface", "azimuth")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Of each laboratory its profile and calibration."""
    folder = tmp_path_factory.mktemp("laboratories")
    for name, suffix in {(name, suffix) for name, suffix, _ in CHANGES.values()}:
        tool, cal = folder / f"{name}.toml", folder / f"{name}.json"
        assert mwdcal("profile", EXAMPLES / f"{name}{suffix}", "-o", tool).code == 0
        assert (
            mwdcal("calibrate", EXAMPLES / f"{name}{suffix}", "--tool", tool, "-o", cal).code == 0
        )
    return folder


def angles(path):
    lines = [line for line in path.read_text("latin-1").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ","))
    results = [name for name in rows[0] if name.startswith(RESULTS)]
    assert len(results) >= len(RESULTS)
    return [[row[name] for name in results] for row in rows if row[results[0]]]


def outputs(command, tool, cal, table, folder):
    """What a command makes of a table, but for its name."""
    out = (
        folder
        / f"{table.parent.name}-{command}{'.csv' if command in ('apply', 'survey') else '.json'}"
    )
    arguments = {
        "calibrate": ("calibrate", table, "--tool", tool, "-o", out),
        "verify": ("verify", cal, table, "--json"),
        "apply": ("apply", cal, table, "-o", out),
        "survey": ("survey", cal, table, "-o", out, "--error-model", "none"),
    }[command]
    ran = mwdcal(*arguments)
    assert ran.code in (0, 1), ran
    if command == "verify":
        return json.loads(ran.out)["rows"]
    if command == "calibrate":
        document = json.loads(out.read_text())
        return [document[kind]["parameters"] for kind in ("accelerometer", "magnetometer")]
    return angles(out)


@pytest.mark.parametrize("command", ["calibrate", "verify", "apply", "survey"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_moved_layout_makes_no_difference(calibrated, tmp_path, command, change):
    name, suffix, changed = CHANGES[change]
    source = EXAMPLES / f"{name}{'_roll' if command != 'calibrate' else ''}{suffix}"
    tables = [tmp_path / place / source.name for place in ("as it was", "moved")]
    for table in tables:
        table.parent.mkdir()
        shutil.copy(source, table)
    changed(tables[1])
    assert tables[0].read_bytes() != tables[1].read_bytes()
    tool, cal = calibrated / f"{name}.toml", calibrated / f"{name}.json"
    before, after = (outputs(command, tool, cal, table, tmp_path) for table in tables)
    assert before
    assert before == after
