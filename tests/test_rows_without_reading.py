"""Rows of a table that hold no reading: a station that the logger lost, and a line that names a series."""

import pytest

import mwdcal as mc
from cli_support import EXAMPLE
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.titles import titles
from test_headers import COLUMNS, TITLES, same, stations, taken, workbook

NAMES = [
    *("Time", "Stn", "Inc (deg)", "Azi (deg)", "TF (deg)"),
    *("Ax (g)", "Ay (g)", "Az (g)", "Mx (nT)", "My (nT)", "Mz (nT)", "Temp (C)"),
]


UNLIKE = ["Azi", "TF", "Gx (g)", "Gy (g)", "Gz (g)", "Bx (nT)", "By (nT)", "Bz (nT)", "T (C)"]


def numbered():
    return [[f"09:{n:02}:00", n, *row] for n, row in enumerate(stations(), 1)]


def layout(path, rows):
    return tables.laid_out(workbook(path, [*TITLES, *rows]))


@pytest.mark.parametrize("word", ["NaN", "-", "ERR", "n/a", "#N/A"])
@pytest.mark.parametrize("temperature", [21.5, ""])
@pytest.mark.parametrize("place", [0, 9, -1])
def test_a_station_of_words_without_value_is_left_out_and_said(tmp_path, word, temperature, place):
    rows = numbered()
    lost = ["09:59:00", 99, 5.0, 120.0, 180.0, *[word] * 6, temperature or word]
    place = place if place >= 0 else len(rows)
    read = layout(tmp_path / "run.xlsx", [NAMES, *rows[:place], lost, *rows[place:]])
    assert read.names == NAMES
    assert len(read.lines) == len(rows)
    line = len(TITLES) + 1 + place + 1
    assert line not in read.lines
    assert any(n == line and said.startswith("09:59:00 99") for n, said in read.left_out)


@pytest.mark.parametrize("places", [(0,), (8,), (0, 8, 16)])
def test_a_line_that_numbers_a_series_is_no_end_of_the_table(tmp_path, places):
    rows, units = stations(), ["deg"] * 3 + ["g"] * 3 + ["nT"] * 3 + ["C"]
    for n, place in reversed([*enumerate(places, 1)]):
        rows.insert(place, [f"Serie {n}: Neigung 15°, Sonde 360° gerollt"])
    read = layout(tmp_path / "run.xlsx", [COLUMNS, units, *rows])
    assert len(read.lines) == len(rows) - len(places)
    assert read.titles.metadata["serial"] == "AB-12"


@pytest.mark.parametrize(
    ("line", "serial"),
    [
        ("Serie 1: Neigung", None),
        ("Série 2", None),
        ("Serie: 12", "12"),
        ("Serie 0447/19", "0447/19"),
    ],
)
def test_the_number_of_a_series_is_no_serial(line, serial):
    assert titles([[line]]).metadata.get("serial") == serial


@pytest.mark.parametrize(
    "name",
    ["Elevação", "Elevación", "Élévation", "Elevazione", "Høydevinkel", "Elewacja", "Elevasi"],
)
def test_an_elevation_is_one_in_the_languages_of_the_laboratories(tmp_path, name):
    rows = [[90 - inclination, *rest] for inclination, *rest in stations()]
    file = workbook(tmp_path / "run.xlsx", [*TITLES, [f"{name} (°)", *UNLIKE], *rows])
    assert same(taken(file), stations())


def test_the_remedy_of_a_cell_that_is_no_number_leaves_its_row_out(tmp_path):
    """The entry that the message has is pasted into the tool profile as it is."""
    run, tool = tmp_path / "run.csv", tmp_path / "tool.toml"
    lines = (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    cells = lines[start + 5].split(",")
    cells[lines[start].split(",").index("mx")] = "n/a?"
    lines[start + 5] = ",".join(cells)
    run.write_text("\n".join(lines), "utf-8")
    profile = (EXAMPLE / "tool.toml").read_text("utf-8")
    with pytest.raises(mc.InputError, match=r"'n/a\?'") as refusal:
        mc.read_run(run, EXAMPLE / "tool.toml")
    tool.write_text(f"{profile}\n[table]\n{str(refusal.value).rpartition(': ')[2].rstrip('.')}\n")
    read, whole = mc.read_run(run, tool), mc.read_run(EXAMPLE / "run.csv", tool)
    assert read.count == whole.count - 1
