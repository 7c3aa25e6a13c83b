"""Tables whose settings, channels or stations stand elsewhere than in columns of their own.

Each is the same run in another arrangement: its numbers come back in the order of its rows.
"""

import json

import openpyxl
import pytest

import mwdcal
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.title_references import stated_above
from test_headers import COLUMNS, same, stations, taken

TITLE = ["Probe S/N;AB-12", "Total field;50000 nT", "Dip;63 deg", ""]
CHANNELS = ["Gx (V)", "Gy (V)", "Gz (V)", "Bx (V)", "By (V)", "Bz (V)"]
NAMES = ["Inc (deg)", "Azi (deg)", "TF (deg)", *CHANNELS, "Temp (C)"]


def lines_of(rows, names=NAMES):
    """The lines of a table of these names and rows."""
    return [";".join(names), *(";".join(map(str, row)) for row in rows)]


def written(path, lines):
    """A text of these lines below a title block."""
    path.write_text("\n".join([*TITLE, *lines]), "utf-8")
    return path


def settings_above(rows, line):
    """A table of rolls alone, with a line above the rows of each setting."""
    lines = []
    for row in rows:
        lines += [line.format(*row)] * (row[2] == 0)
        lines.append(";".join(map(str, row[2:])))
    return lines


@pytest.mark.parametrize(
    "line",
    [
        "Inclination {0:.0f}°, Azimuth {1:.0f}°",
        "Inc = {0}; Azi = {1}",
        "## INC {0:.0f} AZ {1:.0f}",
        "Neigung: {0:.1f} grad; Azimut: {1:.1f} grad",
        "Rolls at {0:.0f}° inclination and {1:.0f}° azimuth",
        "INCLINATION = {0:.0f} DEG\n AZIMUTH = {1:.0f} DEG",
    ],
)
def test_a_setting_is_that_of_the_line_above_its_rows(tmp_path, line):
    rows = stations()
    table = [";".join(NAMES[2:]), *settings_above(rows, line)]
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


def test_a_line_of_settings_above_names_that_repeat(tmp_path):
    """The first line stands above the first names, as each other does."""
    rows = stations()
    names = ";".join(NAMES[2:])
    table = settings_above(rows, "Inc;{0:.0f};°;;Azi;{1:.0f};°\n" + names)
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


def test_lines_between_rows_give_way_to_columns(tmp_path):
    """A column of inclinations overrides the nominal ones in lines."""
    rows = stations()
    head, *table = lines_of(rows)
    for place in range(0, len(table), 13):
        table.insert(place, f"Inclination {place + 1}°, Azimuth {place + 2}°")
    assert same(taken(written(tmp_path / "run.csv", [head, *table])), rows)


def test_a_setting_is_that_of_the_sheet(tmp_path):
    """Sheets 'Inc 5', 'Inc 45': no column states the inclination."""
    rows, book = stations(), openpyxl.Workbook()
    book.remove(book.active)
    for inclination in dict.fromkeys(row[0] for row in rows):
        page = book.create_sheet(f"Inc {inclination:.0f}")
        page.append(["Total field", 50000, "nT", "Dip", 63, "deg"])
        page.append(NAMES[1:])
        for row in (row for row in rows if row[0] == inclination):
            page.append(row[1:])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


@pytest.mark.parametrize(
    "code", ["I{0:.0f}A{1:03.0f}T{2:03.0f}", "inc{0:.0f}_azi{1:.0f}_tf{2:.0f}"]
)
def test_a_code_of_a_station_states_its_setting(tmp_path, code):
    rows = stations()
    table = lines_of([[code.format(*row), *row[3:]] for row in rows], ["Station", *NAMES[3:]])
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


def test_cells_of_several_numbers_are_columns(tmp_path):
    rows = stations()
    cells = [
        [f"{a:.0f}/{b:.0f}/{c:.0f}", f"({x}, {y}, {z})", *rest] for a, b, c, x, y, z, *rest in rows
    ]
    names = ["Inc/Azi/TF (deg)", "G xyz (V)", *NAMES[6:]]
    assert same(taken(written(tmp_path / "run.csv", lines_of(cells, names))), rows)


def test_a_name_with_its_unit_behind_a_comma_is_one_column(tmp_path):
    """Decimal commas, as in 'Temp, °C' 21,5, separate no numbers."""
    rows = [[round(value, 3) for value in row] for row in stations()]
    cells = [[str(value).replace(".", ",") for value in row] for row in rows]
    names = [name.replace(" (", ", ").replace(")", "") for name in NAMES]
    assert same(taken(written(tmp_path / "run.csv", lines_of(cells, names))), rows)


@pytest.mark.parametrize("form", ["TF {1:.0f} {0}", "Roll {1:.0f}° {0}", "{0}_{1:.0f}"])
def test_groups_of_columns_for_each_roll_are_rows(tmp_path, form):
    rows = stations()
    sets = [rows[k : k + 12] for k in range(0, len(rows), 12)]
    channels = [name.partition(" ")[0] for name in CHANNELS]
    names = [form.format(channel, row[2]) for row in sets[0] for channel in [*channels, "Temp"]]
    wide = [[*each[0][:2], *(cell for row in each for cell in row[3:])] for each in sets]
    table = lines_of(wide, ["Inc", "Azi", *names])
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


def test_columns_of_two_tools_are_no_settings(tmp_path):
    """Numbers of tools in headings: which one is meant is asked."""
    rows = stations()
    names = [f"Tool 0{n} {name}" for n in (71, 74) for name in CHANNELS]
    table = lines_of([[*row[:3], *row[3:9], *row[3:9]] for row in rows], [*NAMES[:3], *names])
    with pytest.raises(mwdcal.FitError, match="side by side"):
        mwdcal.propose_profile(written(tmp_path / "run.csv", table))


def test_triads_in_rows_of_their_own(tmp_path):
    rows, table = stations(), []
    for n, row in enumerate(rows, 1):
        table += [[n, *row[:3], row[9], "Acc", *row[3:6]], [n, *row[:3], row[9], "Mag", *row[6:9]]]
    names = ["Stn", *NAMES[:3], "Temp (C)", "Sensor", "X", "Y", "Z"]
    assert same(taken(written(tmp_path / "run.csv", lines_of(table, names))), rows)


def test_angles_and_channels_on_two_sheets_are_joined_by_station(tmp_path):
    """In another order of stations; rows are those of the tool."""
    rows, book = stations(), openpyxl.Workbook()
    book.active.append(["Total field", 50000, "nT", "Dip", 63, "deg"])
    stand, tool = book.create_sheet("Stand"), book.create_sheet("Tool")
    stand.append(["Station", *NAMES[:3]])
    tool.append(["Station", *NAMES[3:]])
    for n, row in enumerate(rows, 1):
        tool.append([n, *row[3:]])
    for n, row in sorted(enumerate(rows, 1), reverse=True):
        stand.append([n, *row[:3]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


def pairs(row):
    """A row as names with values."""
    keys = ["INC", "AZI", "TF", "GX", "GY", "GZ", "BX", "BY", "BZ", "TEMP"]
    return dict(zip(keys, row, strict=True))


RECORDS = {
    "json": lambda row: json.dumps(pairs(row)),
    "one line": lambda row: " ".join(f"{key}={value}" for key, value in pairs(row).items()),
    "lines": lambda row: "\n".join(f"{key}: {value}" for key, value in pairs(row).items()) + "\n",
}


@pytest.mark.parametrize("form", RECORDS)
def test_records_of_names_with_values(tmp_path, form):
    rows = stations()
    path = tmp_path / "run.txt"
    lines = ["field 50000 nT, dip 63 deg", *map(RECORDS[form], rows)]
    path.write_text("\n".join(lines), "utf-8")
    assert same(taken(path), rows)


def page(rows):
    """A page of HTML."""
    head = "<tr>" + "".join(f"<th>{name}</th>" for name in NAMES) + "</tr>"
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    title = "<p>field 50000 nT, dip 63 deg</p>"
    return f"<html><body>{title}<table>{head}{body}</table></body></html>"


def spreadsheet(rows):
    """A workbook in Excel's XML of 2003."""
    space = "urn:schemas-microsoft-com:office:spreadsheet"
    cells = ["".join(f"<Cell><Data ss:Type='String'>{n}</Data></Cell>" for n in NAMES)]
    cells += ["".join(f"<Cell><Data ss:Type='Number'>{c}</Data></Cell>" for c in r) for r in rows]
    title = "<Row><Cell><Data ss:Type='String'>field 50000 nT, dip 63 deg</Data></Cell></Row>"
    table = title + "".join(f"<Row>{each}</Row>" for each in cells)
    return (
        f"<?xml version='1.0'?><Workbook xmlns='{space}' xmlns:ss='{space}'>"
        f"<Worksheet ss:Name='Run'><Table>{table}</Table></Worksheet></Workbook>"
    )


def listing(rows):
    """A text with tabs."""
    lines = ["field 50000 nT, dip 63 deg", *lines_of(rows)]
    return "\n".join(lines).replace(";", "\t")


@pytest.mark.parametrize("form", [page, spreadsheet, listing])
def test_what_programs_write_under_the_name_of_a_workbook(tmp_path, form):
    rows = stations()
    (tmp_path / "run.xls").write_text(form(rows), "utf-8")
    assert same(taken(tmp_path / "run.xls"), rows)


def test_entities_of_xml_are_refused(tmp_path):
    text = spreadsheet(stations()).replace(
        "<Workbook", "<!DOCTYPE a [<!ENTITY b 'c'>]><Workbook", 1
    )
    (tmp_path / "run.xls").write_text(text, "utf-8")
    with pytest.raises(mwdcal.InputError, match="document type"):
        mwdcal.propose_profile(tmp_path / "run.xls")


def test_points_of_the_compass_are_azimuths(tmp_path):
    rows = [row for row in stations() if row[1] % 90 == 0]
    cells = [[row[0], "NESW"[int(row[1] // 90)], *row[2:]] for row in rows]
    assert same(taken(written(tmp_path / "run.csv", lines_of(cells))), rows)


def test_names_in_a_comment(tmp_path):
    """A mark of a comment is no name, and a line 'columns:' gives those of a text without."""
    rows = stations()
    for head in (
        "# " + " ".join(n.replace(" ", "") for n in NAMES),
        "% columns: " + " ".join(NAMES),
    ):
        lines = ["% field 50000 nT, dip 63 deg", head, *(" ".join(map(str, row)) for row in rows)]
        (tmp_path / "run.txt").write_text("\n".join(lines), "utf-8")
        assert same(taken(tmp_path / "run.txt"), rows)


def test_a_toolface_that_counts_anticlockwise_by_a_note(tmp_path):
    """By a note above; looking up the hole the same word says nothing, and the readings tell."""
    rows = stations()
    cells = [[*row[:2], -row[2] % 360, *row[3:]] for row in rows]
    note = "Note: toolface counts anticlockwise"
    run = taken(written(tmp_path / "run.csv", [note, *lines_of(cells)]))
    turned = [[*row[:2], -(-row[2] % 360), *row[3:]] for row in rows]
    assert same(run, turned)
    upwards = [f"{note} looking up the hole", *lines_of(cells)]
    proposal = mwdcal.propose_profile(written(tmp_path / "up.csv", upwards))
    assert "told-by-readings" in {each.id for each in proposal.findings}


def test_a_row_that_was_measured_again_counts(tmp_path):
    """Where no other row is of its setting; beside one it is asked which counts."""
    rows = stations()
    remarks = ["repeat - bumped stand" if n == 7 else "" for n in range(len(rows))]
    table = [[*row, remark] for row, remark in zip(rows, remarks, strict=True)]
    names = [*NAMES, "Remarks"]
    assert same(taken(written(tmp_path / "run.csv", lines_of(table, names))), rows)
    twice = [*table[:7], [*rows[7], ""], *table[7:]]
    with pytest.raises(mwdcal.FitError, match="repeat - bumped stand"):
        mwdcal.propose_profile(written(tmp_path / "twice.csv", lines_of(twice, names)))


@pytest.mark.parametrize("state", ["SUPERSEDED", "veraltet"])
def test_a_superseded_run_is_not_meant(tmp_path, state):
    rows, book = stations(), openpyxl.Workbook()
    book.remove(book.active)
    for name, word, by in (("2021", state, 1.1), ("2024", "CURRENT", 1.0)):
        page = book.create_sheet(name)
        page.append(["Total field", 50000, "nT", "Dip", 63, "deg", word])
        page.append(NAMES)
        for row in rows:
            page.append([*row[:3], *(by * value for value in row[3:9]), row[9]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


MINUTES = [
    ["Inclination", "deg", "min", "sec"],
    ["Neigung", "Grad", "Min", "Sek"],
    ["Зенитный угол", "град", "мин", "сек"],
    ["井斜角", "度", "分", "秒"],
    ["Inc.", "°", "'", '"'],
]


@pytest.mark.parametrize("words", MINUTES, ids=lambda words: words[0])
@pytest.mark.parametrize("parts", [2, 3])
def test_degrees_minutes_and_seconds_below_merged_names(tmp_path, words, parts):
    """0.26° is 15' 36\", and 0.25° is 15'."""
    share, below = (0.26, [15, 36]) if parts == 3 else (0.25, [15])
    rows = [[row[0] // 1 + share, *row[1:]] for row in stations()]
    book = openpyxl.Workbook()
    page = book.active
    page.append(
        ["No.", words[0], *[""] * (parts - 1), *NAMES[1:3], *(n.split()[0] for n in NAMES[3:])]
    )
    page.append(["", *words[1 : parts + 1], "", "", *["V"] * 6, "C"])
    page.merge_cells(start_row=1, start_column=2, end_row=1, end_column=1 + parts)
    for number, row in enumerate(rows, 1):
        page.append([number, row[0] // 1, *below, *row[1:]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


@pytest.mark.parametrize(
    ("names", "below"),
    [
        (["Inc (°)", "min", "sec"], None),
        (["Inc", "min", "sec"], None),
        (["Inc deg", "Inc arcmin", "Inc arcsec"], None),
        (["deg Inc", "min Inc", "sec Inc"], None),
        (["Inc_D", "Inc_M", "Inc_S"], None),
        (["Inc", "", ""], ["[deg]", "[min]", "[s]"]),
        (["Inclinaison", "", ""], ["degrés", "minutes", "secondes"]),
        (["Зенит", "", ""], ["гр.", "мин.", "сек."]),
    ],
    ids=lambda words: words and words[0],
)
def test_degrees_minutes_and_seconds_of_one_angle_alone(tmp_path, names, below):
    """All other columns have their names in the upper row: 0.26° is 15' 36\"."""
    rows = [[row[0] // 1 + 0.26, *row[1:]] for row in stations()]
    book = openpyxl.Workbook()
    page = book.active
    page.append([*names, *NAMES[1:]])
    if below:
        page.append(below)
        page.merge_cells("A1:C1")
    for row in rows:
        page.append([row[0] // 1, 15, 36, *row[1:]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


@pytest.mark.parametrize("form", ["{}-15-36", "{} 15 36", "{}:15:36"])
@pytest.mark.parametrize(("angles", "delimiter"), [(1, ";"), (3, "\t")])
def test_degrees_minutes_and_seconds_in_a_cell_without_their_signs(
    tmp_path, form, angles, delimiter
):
    rows = [[*(a // 1 + 0.26 for a in row[:angles]), *row[angles:]] for row in stations()]
    cells = [[*(form.format(int(a)) for a in row[:angles]), *row[angles:]] for row in rows]
    lines = [line.replace(";", delimiter) for line in lines_of(cells)]
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


def test_a_line_says_what_each_channel_is(tmp_path):
    """Of a logger, whose names are those of its inputs."""
    rows = stations()
    inputs = [f"CH{k}" for k in range(1, 8)]
    said = ["Gx", "Gy", "Gz", "Bx", "By", "Bz", "Temp (C)"]
    line = ", ".join(f"{one} = {other}" for one, other in zip(inputs, said, strict=True))
    names = [*NAMES[:3], *(f"{each} (V)" for each in inputs[:6]), "CH7"]
    assert same(taken(written(tmp_path / "run.csv", [line, *lines_of(rows, names)])), rows)


def test_lines_of_a_log_begin_with_their_time(tmp_path):
    rows = stations()
    stamp = "2024-05-21 08:00:02.000"
    lines = [f"{stamp} [INFO] columns: inc azi tf gx(V) gy(V) gz(V) bx(V) by(V) bz(V) temp(C)"]
    lines += [f"{stamp} [DATA] {' '.join(map(str, row))}" for row in rows]
    path = tmp_path / "run.log"
    path.write_text("\n".join(["tool SN AB-12, B = 50000 nT, dip 63 deg", *lines]), "utf-8")
    assert same(taken(path), rows)


@pytest.mark.parametrize("fact", ["仪器编号;CD-131", "# units: deg;g;nT;C"])
def test_a_fact_right_above_names_of_axes_is_no_title_of_theirs(tmp_path, fact):
    rows = stations()
    names = [
        *NAMES[:3],
        "加速度计X",
        "加速度计Y",
        "加速度计Z",
        "磁通门X",
        "磁通门Y",
        "磁通门Z",
        "n",
    ]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["Field 50000 nT", fact, *lines_of(rows, names)]), "utf-8")
    assert {*names[3:9]} <= {s.name for s in mwdcal.propose_profile(path).profile.columns.values()}


def test_a_time_behind_an_angle_is_no_part_of_it(tmp_path):
    rows = stations()
    names = [*NAMES[:3], "min", *NAMES[3:]]
    table = lines_of([[*row[:3], k % 50 + 1, *row[3:]] for k, row in enumerate(rows)], names)
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


def test_a_least_and_a_largest_value_are_no_minutes(tmp_path):
    rows = stations()
    names = ["Inc (deg)", "Inc min", "Inc max", *NAMES[1:]]
    table = lines_of([[row[0], row[0] - 1, row[0] + 1, *row[1:]] for row in rows], names)
    assert same(taken(written(tmp_path / "run.csv", table)), rows)


PLACES = [
    ["Reference", "Total field (nT)", "Dip (°)"],
    ["Stavanger", 50948, 72.61],
    ["Trondheim", 51904, 74.12],
]


def test_references_of_a_list_of_places():
    """Those of the place that the title block names, or of the one that still holds; else none."""
    here = {"ref_field_nt": 51904.0, "ref_dip_deg": 74.12}
    assert stated_above([["Site", "Trondheim"], *PLACES]).metadata == here
    assert stated_above(PLACES, (), "Site Trondheim").metadata == here
    old = [PLACES[0], ["Stavanger (old stand)", 50948, 72.61], PLACES[2]]
    assert stated_above(old).metadata == here
    open_list = stated_above(PLACES)
    assert open_list.metadata == {}
    assert {*open_list.not_taken} == {*here}


def test_limits_and_former_calibrations_are_no_references():
    rows = [["Previous cal", "Bref 50391 nT"], ["Bref", 50480, "nT", "", "Dip", 70.0, "deg"]]
    limits = [["Limits"], ["Btotal", 300, "nT"], ["Dip", 0.3, "deg"]]
    assert stated_above(rows, limits).metadata == {"ref_field_nt": 50480.0, "ref_dip_deg": 70.0}


@pytest.mark.parametrize(
    "rows",
    [
        [["Local gravity", 9.79285, "m/s²", "(= 0.99859 g, 1 g = 9.80665 m/s²)"]],
        [["Gravedad local:", 9.79285, "m/s²", "(1 g = 9,80665 m/s²)"]],
        [["Local gravity", 9.79285 / 9.80665, "g (9.80665 m/s²)"]],
        [["g ref.", 9.79285, "m/s²"], ["Unidad g = 9,80665 m/s²"]],
        [["Ускорение свободного падения, м/с²:", 9.79285], ["1 g = 9,80665 м/с²"]],
    ],
)
def test_what_a_unit_is_states_no_reference(rows):
    """Standard gravity defines the unit; a second value is one that differs."""
    gravity = 9.79285 / 9.80665
    assert stated_above(rows).metadata == {"ref_gravity_g": pytest.approx(gravity, rel=1e-12)}
    assert stated_above(rows[1:]).metadata == {}
    assert stated_above([["Local gravity 9.81 m/s² (= 9.83 m/s²)"]]).metadata == {}


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [
        (["B = 500,10 mGs"], "ref_field_nt", 50010.0),
        (["Sudut dip", -31.3, "derajat"], "ref_dip_deg", -31.3),
        (["Dalım açısı", "57,60°"], "ref_dip_deg", 57.6),
    ],
)
def test_references_in_words_and_units_of_other_laboratories(row, column, value):
    beside = [] if column == "ref_field_nt" else [["Total field", "50010 nT"]]
    metadata = stated_above([*beside, row]).metadata
    assert metadata[column] == pytest.approx(value, rel=1e-12)


def test_a_station_is_no_unit():
    rows = [["Station 1 g = 9.79285 m/s²"]]
    assert stated_above(rows).metadata["ref_gravity_g"] == pytest.approx(9.79285 / 9.80665)


def test_field_and_dip_of_components():
    """A right triangle of 30, 40 and 50 µT; the tangent of its dip is 4/3."""
    line = "Field: horizontal component 30000 nT, vertical component 40000 nT"
    metadata = stated_above([[line]]).metadata
    assert metadata["ref_field_nt"] == pytest.approx(50000)
    assert metadata["ref_dip_deg"] == pytest.approx(53.13010235415598)


@pytest.mark.parametrize(
    ("language", "names"),
    [
        (
            "Finnish",
            "Kallistuma (°);Atsimuutti (°);Kiertokulma (°);Kiiht. {} (V);Magn. {} (V);Lämpötila (°C)",
        ),
        ("Czech", "Sklon [°];Azimut [°];Natočení [°];Zrychlení {} [V];Pole {} [V];Teplota [°C]"),
        ("Korean", "경사각 (°);방위각 (°);툴페이스 (°);가속도 {} (V);자기장 {} (V);온도 (°C)"),
        ("Dutch", "helling;azimut;rol;versn. {} (V);magn. {} (V);temp (C)"),
    ],
)
def test_words_of_languages(tmp_path, language, names):
    rows = stations()
    every = [
        each.format(axis) for each in names.split(";") for axis in ("XYZ" if "{}" in each else "X")
    ]
    assert len(every) == len(COLUMNS), language
    where = tables.laid_out(written(tmp_path / "run.csv", lines_of(rows, every)))
    assert where.names == every
    assert same(taken(tmp_path / "run.csv"), rows)
