"""Tables whose columns are named in several rows, whose cells are merged or written once, and what is said of them."""

import csv
import json

import numpy as np
import openpyxl
import pytest

import mwdcal
from cli_support import EXAMPLE
from cli_support import mwdcal as command
from mwdcal.errors import Answer, QuestionError, QuestionsError
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.titles import titles
from mwdcal.files.runs import read_export, run_table

COLUMNS = [
    *("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg"),
    *("ax", "ay", "az", "mx", "my", "mz", "temperature_c"),
]
TITLES = [["Field (nT)", 50000, "", "Dip (deg)", 63, "", "Serial", "AB-12"], []]


def stations():
    """Rows of a simulated run, in the order of COLUMNS: numbers."""
    lines = (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [[float(row[name]) for name in COLUMNS] for row in rows if all(row.values())]


def workbook(path, rows, merged=()):
    """A workbook of one sheet with these rows, and cells that are merged."""
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append([None if cell == "" else cell for cell in row])
    for cells in merged:
        book.active.merge_cells(cells)
    book.save(path)
    return path


def text(path, rows):
    """A text table of these rows."""
    path.write_text("\n".join(",".join(map(str, row)) for row in rows), "utf-8")
    return path


def taken(path, **answers):
    """The table under the names of a run file, by the profile proposed for it."""
    profile = mwdcal.propose_profile(path, **answers).profile
    return run_table(read_export(path, profile), profile)


def same(run, rows):
    """Whether a run has all numbers of these rows."""
    return all(
        np.allclose(tables.numbers(run, name), cells, rtol=1e-12)
        for name, cells in zip(COLUMNS, zip(*rows, strict=True), strict=True)
    )


HEADS = {
    "triads in the lower row": [
        ["Inc", "Azi", "TF", "Accelerometer (V)", "", "", "Magnetometer (V)", "", "", "Temp C"],
        ["", "", "", "Gx", "Gy", "Gz", "Bx", "By", "Bz"],
    ],
    "names, symbols, units": [
        *[["Neigung", "Azimut", "Toolface", "Beschleunigung", "", "", "Magnetfeld", "", ""]],
        *[["I", "A", "TF", "ax", "ay", "az", "mx", "my", "mz", "T"]],
        ["°", "°", "°", "V", "V", "V", "V", "V", "V", "°C"],
    ],
    "in words and in short": [
        *[["Inclinación", "Azimut", "Cara de herramienta", "Acelerómetro", "", ""]],
        *[["Inc (°)", "Az (°)", "TF (°)", "Gx (V)", "Gy (V)", "Gz (V)"]],
    ],
}
HEADS["names, symbols, units"][0].append("Temperatur")
HEADS["in words and in short"][0] += ["Campo magnético", "", "", "Temperatura"]
HEADS["in words and in short"][1] += ["Bx (V)", "By (V)", "Bz (V)", "T (°C)"]


@pytest.mark.parametrize("head", HEADS)
def test_a_column_is_named_by_all_rows_above_it(tmp_path, head):
    """Unmerged cells; the rows of a run come back by the names of both rows together."""
    rows = stations()
    assert same(taken(text(tmp_path / "run.csv", [*TITLES, *HEADS[head], *rows])), rows)


def test_names_merged_over_the_units_of_a_group_go_no_further(tmp_path):
    """Cells of names merged downwards, titles over three columns each; the rolls of a series share merged angles."""
    rows = stations()
    upper, lower = HEADS["triads in the lower row"]
    table, merged = [*TITLES, upper, lower], ["D3:F3", "G3:I3", *(f"{c}3:{c}4" for c in "ABCJ")]
    begun = 0
    for place, row in enumerate([*rows, [None] * len(COLUMNS)]):
        if row[:2] != rows[begun][:2]:
            merged += [f"{c}{begun + 5}:{c}{place + 4}" for c in "AB" if place - begun > 1]
            begun = place
        table.append(row if place == begun else ["", "", *row[2:]])
    path = workbook(tmp_path / "run.xlsx", table, merged)
    assert same(taken(path), rows)


def test_a_line_above_names_is_not_of_them(tmp_path):
    """A title block right above the names, of texts alone, changes no name."""
    rows = stations()
    names = ["Inc", "Azi", "TF", "Gx (V)", "Gy (V)", "Gz (V)", "Bx (V)", "By (V)", "Bz (V)", "T C"]
    above = ["Operator", "A. Smith", "Customer", "Acme Ltd", "Tool S/N", "AB-12"]
    path = text(tmp_path / "run.csv", [["Field 50000 nT, dip 63 deg"], above, names, *rows])
    where = tables.laid_out(path)
    assert where.names == names
    assert where.titles.metadata["serial"] == "AB-12"


def test_toolfaces_round_a_turn_are_offered_as_such(tmp_path):
    """Rolls in equal steps are no numbers of rows: a column without a name is offered as the toolface."""
    rows = [[*row[:2], 45.0 * (n % 8), *row[3:]] for n, row in enumerate(stations())]
    names = ["Inc", "Azi", "q", "Gx (V)", "Gy (V)", "Gz (V)", "Bx (V)", "By (V)", "Bz (V)", "T C"]
    with pytest.raises(mwdcal.FitError) as error:
        mwdcal.propose_profile(text(tmp_path / "run.csv", [*TITLES, names, *rows]))
    questions = getattr(error.value, "questions", (error.value,))
    offered = [a for each in questions for answer in each.answers for a in answer.arguments]
    assert ("column", "ref_toolface_deg=q") in offered


def in_series(rows):
    """Rows sorted to series of rolls, with the angles of each direction in its first row alone."""
    rows = sorted(rows, key=lambda row: row[:2])
    return rows, [
        row if not n or row[:2] != rows[n - 1][:2] else ["", "", *row[2:]]
        for n, row in enumerate(rows)
    ]


CHANNELS = ["Gx", "Gy", "Gz", "Bx", "By", "Bz"]
NAMES = ["Inc", "Azi", "TF", "Gx (V)", "Gy (V)", "Gz (V)", "Bx (V)", "By (V)", "Bz (V)", "T C"]


def test_angles_written_once_for_a_series_are_those_of_the_row_above(tmp_path):
    """The readings fit them; the profile says so, and calibrate reads the same table, each naming how many."""
    rows, once = in_series(stations())
    path = text(tmp_path / "run.csv", [*TITLES, NAMES, *once])
    proposed = mwdcal.propose_profile(path)
    blank = sum(row[0] == "" for row in once)
    said = [each.text for each in proposed.findings if "from the row above" in each.text]
    assert [each.split(" rows")[0] for each in said] == [f"{blank} of {len(rows)}"] * 2
    assert proposed.profile.table.fill_down == ("Inc", "Azi")
    run = taken(path)
    assert same(run, rows)
    assert [each for each in run.remarks if "from the row above" in each] == said


def test_blank_angles_that_the_readings_do_not_fit_are_unknown_and_counted(tmp_path):
    """Angles in a few rows that do not hold for the rows below: mwdcal fills none in, and says how many lack one."""
    rows = sorted(stations(), key=lambda row: row[2])
    some = [row if n % 4 == 0 else ["", "", *row[2:]] for n, row in enumerate(rows)]
    proposed = mwdcal.propose_profile(text(tmp_path / "run.csv", [*TITLES, NAMES, *some]))
    blank = sum(row[0] == "" for row in some)
    texts = [each.text for each in proposed.findings]
    for name in ("Inc", "Azi"):
        assert f"{blank} of {len(rows)} stations have no '{name}': it is unknown there." in texts
    assert not any("from the row above" in each for each in texts)


def listing(path, names, units, rows, remarks=()):
    """A listing of columns one below the other, each filled up with blanks, and remarks behind some rows."""
    lines = ["".join(f"{cell:>14}" for cell in row) for row in [names, units, *rows]]
    for row, remark in remarks:
        lines[row + 2] += f"   {remark}"
    path.write_text("\n".join(["FIELD 50000 NT  DIP 63 DEG", "", *lines]), "utf-8")
    return path


WORDS = ["INC", "AZI", "HS", "GX", "GY", "GZ", "HX", "HY", "HZ", "TEMP"]


def test_a_unit_of_two_words_is_that_of_the_column_above_it(tmp_path):
    """With a blank unit before it the units are as many words as there are columns."""
    rows = [[n + 1, *row] for n, row in enumerate(stations())]
    units = ["", "DEG", "DEG", "DEG", *["VOLTS"] * 6, "DEG C"]
    path = listing(tmp_path / "run.txt", ["STN", *WORDS], units, rows)
    assert tables.laid_out(path).units == units
    assert same(taken(path), stations())


def test_words_behind_the_last_column_are_one_remark(tmp_path):
    """A question on it names its column, of which there is no name."""
    units = ["DEG", "DEG", "DEG", *["V"] * 6, "DEGC"]
    remarks = [(3, "bad contact here")]
    path = listing(tmp_path / "run.txt", WORDS, units, stations(), remarks)
    with pytest.raises(mwdcal.FitError, match="'column 11' says 'bad contact here'") as error:
        mwdcal.propose_profile(path)
    first, *_ = error.value.questions[0].answers[0].arguments
    assert first == ("keep", "column 11=bad contact here")
    assert same(taken(path, keep={"column 11": ["bad contact here"]}), stations())


@pytest.mark.parametrize("answers", [{}, {"column": {"ref_toolface_deg": "TF (°)"}}])
def test_a_unit_that_an_answer_corrects_holds_when_the_table_is_read_again(tmp_path, answers):
    """Toolfaces under V: told by the readings or the user, and read with the profile of the answer."""
    units = ["°", "°", "V", "V", "V", "V", "V", "V", "V", "°C"]
    names = ["Inc", "Azi", "TF", "Gx", "Gy", "Gz", "Bx", "By", "Bz", "Temp"]
    path = text(tmp_path / "run.csv", [*TITLES, names, units, *stations()])
    profile = mwdcal.propose_profile(path, **answers).profile
    assert profile.columns["ref_toolface_deg"].instead_of == "V"
    assert same(taken(path, **answers), stations())


@pytest.mark.parametrize(
    ("form", "unit"),
    [("Temperature: {} °C", 1.0), ("温度点：{}℃", 1.0), ("Oven at {} ± 2 F", 5 / 9)],
)
def test_temperatures_in_lines_between_the_rows_are_those_of_the_rows_below(tmp_path, form, unit):
    """Said with their rows, in whatever order names and the first of them stand."""
    rows = [row[:9] for row in stations()]
    half = len(rows) // 2
    blocks = [[form.format(20)], *rows[:half], [form.format(80)], *rows[half:]]
    stated = [unit * (t - (32 if unit < 1 else 0)) for t in (20, 80)]
    expected = [stated[n >= half] for n in range(len(rows))]
    above, names, units = blocks[:1], [["Inc", "Azi", "TF", *CHANNELS]], [["°"] * 3 + ["V"] * 6]
    for head in ([*names, *units, *above], [*above, *names, *units]):
        path = text(tmp_path / "run.csv", [*TITLES, *head, *blocks[1:]])
        run = taken(path)
        assert np.allclose(tables.numbers(run, "temperature_c"), expected)
        assert any(f"({half} rows)" in each for each in run.remarks)


def test_lines_of_temperatures_beside_a_column_of_them_are_not_taken(tmp_path):
    rows, half = stations(), len(stations()) // 2
    table = [NAMES, ["Oven 20 °C"], *rows[:half], ["Oven 80 °C"], *rows[half:]]
    assert same(taken(text(tmp_path / "run.csv", [*TITLES, *table])), rows)


def two_sheets(path, rows, first=NAMES, other=NAMES):
    """A workbook with the accelerometers of the stations on one sheet and the magnetometers on another."""
    book = openpyxl.Workbook()
    book.active.append(["Field (nT)", 50000, "", "Dip (deg)", 63, "", "Serial", "AB-12"])
    for title, names, (start, end) in (("Acc", first, (3, 6)), ("Mag", other, (6, 9))):
        page = book.create_sheet(title)
        page.append([*names[:3], *names[start:end], names[9]])
        for row in rows:
            page.append([*row[:3], *row[start:end], row[9]])
    book.save(path)
    return path


def test_two_triads_on_two_sheets_of_the_same_stations_are_one_table(tmp_path):
    """Joined and said, in profile and calibrate; the one sheet that is named says what is not read."""
    rows = stations()
    path = two_sheets(tmp_path / "run.xlsx", rows)
    run = taken(path)
    assert same(run, rows)
    assert any("'Acc' and 'Mag' are one table" in each for each in run.remarks)
    one = mwdcal.propose_profile(path, sheet="Acc")
    found = {each.id: each.text for each in one.findings}
    assert "on 'Mag' are not read" in found["marked-rows"]
    assert found["no-magnetometer"].startswith("field and dip of the field are stated")
    again = mwdcal.calibrate(path, one.profile)
    assert {"marked-rows", "no-magnetometer"} <= {each.id for each in again.findings}


def test_an_answer_is_given_in_python_as_the_error_says_it(tmp_path):
    """Answers are named as keyword arguments; strings in the form of the command equal a mapping."""
    rows = stations()
    for row in rows:
        row[1] = (row[1] + 8) % 360
    path = text(tmp_path / "run.csv", [[COLUMNS[0], "Lage 2", *COLUMNS[2:]], *rows])
    with pytest.raises(mwdcal.FitError) as error:
        mwdcal.propose_profile(path)
    assert "Answer by column='ref_azimuth_deg=Lage 2' or column='ref_azimuth_deg='." in str(
        error.value
    )
    north = {"north": "true", "declination_deg": 8.0}
    said = {"ref_azimuth_deg": "Lage 2"}
    profile = mwdcal.propose_profile(path, column=said, **north).profile
    for each in ("ref_azimuth_deg=Lage 2", ["ref_azimuth_deg=Lage 2"]):
        assert mwdcal.propose_profile(path, column=each, **north).profile == profile
    with pytest.raises(mwdcal.InputError, match="`column` 'ax': expected OURS=THEIRS"):
        mwdcal.propose_profile(path, column="ax")
    with pytest.raises(mwdcal.InputError, match="`keep` 3: expected COLUMN=TEXT"):
        mwdcal.propose_profile(path, keep=3)


def test_the_answers_of_a_choice_are_one_call_or_one_command():
    """Two columns in one list for Python, a row as a number; each its own option for a shell."""
    several = Answer("A", (("column", "ax=A x"), ("column", "ay=A y"), ("serial", "17")))
    row = Answer("7", (("header_row", "7"),), ("declination_deg",))
    question = QuestionError("Which?", [several, row])
    called = "column=['ax=A x', 'ay=A y'], serial='17' or header_row=7, declination_deg=NUMBER"
    typed = (
        '--column "ax=A x" --column "ay=A y" --serial 17 or --header-row 7 --declination-deg NUMBER'
    )
    assert str(question) == f"Which? Answer by {called}."
    assert question.with_options == f"Which? Answer by {typed}."
    both = QuestionsError("run.csv", [question, QuestionError("And?")])
    assert str(both) == f"run.csv: 2 questions are open. (1) {question} (2) And?"
    assert both.with_options.startswith(
        f"run.csv: 2 questions are open. (1) Which? Answer by {typed}"
    )


def test_sheets_of_other_stations_are_not_joined(tmp_path):
    """One angle that differs: another station."""
    rows = stations()
    path = two_sheets(tmp_path / "run.xlsx", rows)
    book = openpyxl.load_workbook(path)
    book["Mag"]["A3"] = book["Mag"]["A3"].value + 1
    book.save(path)
    with pytest.raises(mwdcal.FitError, match="holds 2 tables of like columns"):
        mwdcal.propose_profile(path)


def test_a_roll_test_on_another_sheet_of_the_run_is_that_of_the_run(tmp_path):
    """It was no part of the fit, and the verdict is that of the same rows in a file of their own."""
    rows = stations()
    path = workbook(tmp_path / "run.xlsx", [*TITLES, NAMES, *rows[:32]])
    book = openpyxl.load_workbook(path)
    page = book.create_sheet("Roll test")
    for row in [*TITLES, NAMES, *rows[32:]]:
        page.append(row)
    book.save(path)
    alone = workbook(tmp_path / "alone.xlsx", [*TITLES, NAMES, *rows[32:]])
    command("profile", path, "-o", tmp_path / "tool.toml")
    both = [
        command(
            *("calibrate", path, "--tool", tmp_path / "tool.toml", "--json"),
            *("-o", tmp_path / f"{test.stem}.json", "--rolltest", test),
        )
        for test in (path, alone)
    ]
    verdicts = [json.loads(each.out)["verification"] for each in both]
    assert verdicts[0]["stations"] == verdicts[1]["stations"] == 16
    assert verdicts[0]["rows"] == verdicts[1]["rows"]


@pytest.mark.parametrize(
    ("cells", "stated"),
    [
        (["Serienummer:", "BHX-72 / 0091"], {"serial": "BHX-72 / 0091"}),
        (["Serial no BHX-72 / 0091"], {"serial": "BHX-72 / 0091"}),
        (["Serial:", "A-17 / 14.03.2025"], {"serial": "A-17", "date": "2025-03-14"}),
        (["S/N", "SD-9, 112"], {"serial": "SD-9, 112"}),
        (["Gerät-Nr.:", "RS2-0175"], {"serial": "RS2-0175"}),
        (["Probe number", 41], {"serial": "41"}),
        (["Herramienta N/S:", "MX-4471"], {"serial": "MX-4471"}),
        (["Sonden-Nr. 880214"], {"serial": "880214"}),
        (["Kalibrering sonde nr. 27"], {"serial": "27"}),
        (["Прибор: 1200417"], {"serial": "1200417"}),
        (["Номер прибора", "МК-17"], {"serial": "МК-17"}),
        (["Equipo", "MX-12"], {"serial": "MX-12"}),
        (["Roll stand cal. Tool S/N: HT-0092. Field 46510 nT"], {"serial": "HT-0092"}),
        (["Sensor: 24 V"], {}),
        (["MWD sonde T-2209 tumble. Field 49830 nT"], {"serial": "T-2209"}),
        (["Tool: DS 5 / 071  Tech: Ph. Ayre"], {"serial": "DS 5 / 071"}),
        (["Журнал калибровки прибора ТС-12/3"], {"serial": "ТС-12/3"}),
        (["Kalibrering H-90, Oslo"], {"serial": "H-90"}),
        (["Calibration of tool MWD 2026"], {}),
        (["Calibration, tool serial MWD-5533, stand B"], {"serial": "MWD-5533"}),
    ],
)
def test_a_serial_is_whole(cells, stated):
    """Of two numbers, and behind whatever word for the number of a tool; a day beside it is the date."""
    assert titles([cells]).metadata == stated


@pytest.mark.parametrize("in_turn", [False, True])
@pytest.mark.parametrize(
    ("name", "asked"),
    [("Série", "Are these tools"), ("仪器号", "2 tools"), ("Serial", "2 tools")],
)
def test_tools_in_the_rows_of_one_table_are_asked_about(tmp_path, name, asked, in_turn):
    """The serial that is stated takes its rows, whatever the column is called and in whatever order they stand."""
    rows = stations()
    both = [[tool, *row] for tool in ("A-101", "A-102") for row in rows]
    both = (
        [row for pair in zip(both[: len(rows)], both[len(rows) :], strict=True) for row in pair]
        if in_turn
        else both
    )
    path = text(tmp_path / "run.csv", [TITLES[0][:5], [], [name, *NAMES], *both])
    with pytest.raises(mwdcal.FitError, match=asked) as error:
        mwdcal.propose_profile(path)
    assert [each.arguments for each in error.value.answers][:2] == [
        (("serial", "A-101"),),
        (("serial", "A-102"),),
    ]
    profile = mwdcal.propose_profile(path, serial="A-102").profile
    run = run_table(read_export(path, profile, statements={"serial": "A-102"}), profile)
    assert same(run, rows)
    assert len(rows) == run.count


def test_two_triads_one_below_the_other_are_one_table(tmp_path):
    """Each with the angles of the stand; the names are an axis and its unit alone."""
    rows = stations()
    angles = ["Pos.", "Neigung °", "Toolface °", "Azimut °"]
    parts = [
        [[n, inc, face, azimuth, *triad] for n, (inc, azimuth, face, *triad) in enumerate(half, 1)]
        for half in ([[*r[:6], r[9]] for r in rows], [[*r[:3], *r[6:9]] for r in rows])
    ]
    path = workbook(
        tmp_path / "run.xlsx",
        [
            *(
                TITLES[0],
                [],
                ["A. Beschleunigung"],
                [*angles, "X V", "Y V", "Z V", "Temp °C"],
                *parts[0],
            ),
            *([], ["B. Magnetometer"], [*angles, "X nT", "Y nT", "Z nT"], *parts[1]),
        ],
    )
    assert same(taken(path), rows)


def test_one_blank_between_names_over_columns_parts_them(tmp_path):
    """Of right-aligned columns: `Neigung Toolface` are two names where two columns stand below."""
    widths = [8, 9, 9, *[12] * 6, 7]
    names = ["Neigung", "Azimut", "Toolface", *("Gx", "Gy", "Gz", "Bx", "By", "Bz"), "Temp"]
    lines = [
        "".join(f"{c:>{w}}" for c, w in zip(row, widths, strict=True))
        for row in [names, *stations()]
    ]
    lines[0] = lines[0].replace("  Toolface", " Toolface")
    path = tmp_path / "run.txt"
    path.write_text("\n".join(["FIELD 50000 NT  DIP 63 DEG", "", *lines]), "utf-8")
    assert "Azimut Toolface" in path.read_text("utf-8")
    assert same(taken(path), stations())


def test_a_row_of_dashes_with_one_remark_parts_no_table(tmp_path):
    """A station without a reading is left out, and the rows below it are read."""
    rows = stations()
    gap = ["–"] * len(NAMES) + ["power cut, no reading"]
    path = workbook(
        tmp_path / "run.xlsx", [TITLES[0], [], [*NAMES, "Remark"], *rows[:20], gap, *rows[20:]]
    )
    assert same(taken(path), rows)


@pytest.mark.parametrize("name", ["temp", "T"])
def test_units_below_the_names_of_other_columns_widths_are_theirs(tmp_path, name):
    """Left-aligned names and units, the last of which does not stand above its numbers."""
    rows = [[n, *row] for n, row in enumerate(stations(), 1)]
    names = ["est", "inc", "azim", "face", "Gx", "Gy", "Gz", "Bx", "By", "Bz", name]
    units = ["", "graus", "graus", "graus", *["V"] * 6, "C"]
    width = [6, *[13] * 9, 0]
    lines = (
        [f"{cell:<{w}}" for w, cell in zip(width, names, strict=True)],
        [f"{c:<{w}}" for w, c in zip(width, units, strict=True)],
    )
    body = [
        "".join(f"{cell:<{w}}" for w, cell in zip([*width[:-2], 17, 0], row, strict=True))
        for row in rows
    ]
    head = ["".join(line) for line in lines]
    path = tmp_path / "run.txt"
    path.write_text("\n".join(["FIELD 50000 NT  DIP 63 DEG", "", *head, *body]), "utf-8")
    assert tables.laid_out(path).units == units
    assert same(taken(path), stations())


def test_a_triad_on_a_sheet_of_its_own_is_that_of_the_same_stations(tmp_path):
    """Angles and one triad on one sheet, the station and the other triad on the next."""
    rows = stations()
    book = openpyxl.Workbook()
    book.active.append(["Field (nT)", 50000, "", "Serial", "AB-12"])
    first, other = book.create_sheet("Acc"), book.create_sheet("Mag")
    other.append(["Dip (deg)", 63])  # of the references one sheet states one
    first.append(
        ["Station", "Inc (°)", "Azi (°)", "TF (°)", "Gx (V)", "Gy (V)", "Gz (V)", "Temp (°C)"]
    )
    other.append(["Station", "Bx (V)", "By (V)", "Bz (V)"])
    for n, row in enumerate(rows, 1):
        first.append([n, *row[:6], row[9]])
    for n, row in reversed([*enumerate(rows, 1)]):
        other.append([n, *row[6:9]])
    book.save(tmp_path / "run.xlsx")
    run = taken(tmp_path / "run.xlsx")
    assert run.metadata["ref_dip_deg"] == 63
    order = np.argsort(tables.numbers(run, "station"))
    assert np.allclose(
        [tables.numbers(run, name)[order] for name in COLUMNS],
        [*zip(*rows, strict=True)],
        rtol=1e-12,
    )


RECORDS = {
    "time": (
        "ST={n:02d} TIME=08:17:{n:02d} Inc={0} Azi={1} TF={2} Gx={3} Gy={4} Gz={5} Bx={6} By={7} Bz={8} T={9}",
    ),
    "label": ("P{n:02d}: Inc={0},Azi={1},TF={2},Gx={3},Gy={4},Gz={5},Bx={6},By={7},Bz={8},T={9}",),
    "lines": (
        *("Station {n}", "  Inclination: {0} deg", "  Azimuth: {1} deg", "  Toolface: {2} deg"),
        *("  Accel (V):  X {3}  Y {4}  Z {5}", "  Magnetometer (V): X {6}  Y {7}  Z {8}"),
        *("  Temperature: {9} C", ""),
    ),
}


@pytest.mark.parametrize("form", RECORDS)
def test_records_of_stations_are_rows(tmp_path, form):
    """A label before the names of a line, or a block of lines with three axes in one; a title may share a name."""
    block = "\n".join(RECORDS[form])
    each = [block.format(*row, n=n) for n, row in enumerate(stations(), 1)]
    titled = ["// Probe: A-17", "// Field: 50000 nT, Dip: 63 deg", "Azimuth: magnetic", ""]
    path = tmp_path / "run.txt"
    path.write_text("\n".join([*titled, *each, "End"]), "utf-8")
    assert same(taken(path), stations())
    assert mwdcal.propose_profile(path).proposal.metadata["serial"] == "A-17"


@pytest.mark.parametrize("title", ["Toolface", "Visier (Toolface)"])
@pytest.mark.parametrize("signs", [("°", "'", '"'), ("grader °", "min '", 'sek "')])
def test_minutes_below_a_title_are_those_of_its_angle(tmp_path, title, signs):
    """In columns below °, ', ": brackets behind the title are no unit."""
    seconds = [[round(3600 * angle) for angle in row[:3]] for row in stations()]
    channels_of = [row[3:] for row in stations()]
    parts = [
        [part for s in each for part in (s // 3600, s // 60 % 60, s % 60)] + channels
        for each, channels in zip(seconds, channels_of, strict=True)
    ]
    rows = [[s / 3600 for s in e] + c for e, c in zip(seconds, channels_of, strict=True)]
    channels = ["Gx (V)", "Gy (V)", "Gz (V)", "Bx (V)", "By (V)", "Bz (V)", "T (°C)"]
    head = [
        [w for name in ("Inc", "Azi", title) for w in (name, "", "")] + channels,
        [*signs] * 3,
    ]
    path = workbook(tmp_path / "run.xlsx", [TITLES[0], [], *head, *parts])
    assert same(taken(path), rows)


@pytest.mark.parametrize("suffix", [".csv", ".xlsx"])
def test_a_table_is_missed_by_calibrate_with_what_to_do_first(tmp_path, suffix):
    """Not by its delimiters: a profile is to be proposed."""
    write = text if suffix == ".csv" else workbook
    path = write(tmp_path / f"run{suffix}", [*TITLES, NAMES, *stations()])
    ran = command("calibrate", path, "-o", tmp_path / "tool.json")
    assert ran.code == 2
    assert f"mwdcal profile run{suffix} -o tool.toml" in ran.err
    assert "3, not written as a run file" in ran.err


@pytest.mark.parametrize("units", [True, False])
@pytest.mark.parametrize("write", [text, workbook])
def test_stations_in_columns_are_turned(tmp_path, units, write):
    """Said; a fault names the column of its station."""
    rows = stations()
    bare = [name.partition(" (")[0] for name in NAMES]
    table = [["Station", *NAMES], *([n + 1, *row] for n, row in enumerate(rows))]
    if units:
        table[:1] = [["Station", *bare], ["", "°", "°", "°", *["V"] * 6, "°C"]]
    turned = [[*column] for column in zip(*table, strict=True)]
    path = write(tmp_path / f"run.{'csv' if write is text else 'xlsx'}", [*TITLES, *turned])
    run = taken(path)
    assert same(run, rows)
    assert any("stations stand in columns" in each for each in run.remarks)
    turned[4][9] = "0.1x"
    write(path, [*TITLES, *turned])
    with pytest.raises((mwdcal.InputError, mwdcal.FitError), match="column 10, column "):
        mwdcal.propose_profile(path)


def test_labels_of_axes_in_front_of_rows_are_no_names(tmp_path):
    """A table of six positions, called by the axis that is up, goes down the sheet as any other."""
    rows = stations()
    labelled = [[("+X", "-Y", "+Z")[n % 3], *row] for n, row in enumerate(rows)]
    path = text(tmp_path / "run.csv", [*TITLES, ["Up", *NAMES], *labelled])
    assert same(taken(path), rows)


def test_angles_under_two_titles_are_offered_by_their_names(tmp_path):
    """Neither title is understood: each question offers the two columns that end in its angle, and no others."""
    rows = [[*row[:3], *(value + 0.2 for value in row[:3]), *row[3:]] for row in stations()]
    names = [f"{title} {angle}" for title in ("Qq", "Zz") for angle in ("Inc", "Azi", "TF")]
    path = text(tmp_path / "run.csv", [*TITLES, [*names, *NAMES[3:]], *rows])
    with pytest.raises(mwdcal.FitError, match="behind a title that is not understood") as error:
        mwdcal.propose_profile(path)
    offered = [[a.arguments[0][1] for a in each.answers] for each in error.value.questions]
    assert offered == [
        [f"{column}={title} {angle}" for title in ("Qq", "Zz")] + [f"{column}="]
        for column, angle in zip(
            (COLUMNS[0], COLUMNS[2], COLUMNS[1]), ("Inc", "TF", "Azi"), strict=True
        )
    ]


def test_one_question_asks_which_of_two_tools_side_by_side_is_meant(tmp_path):
    """Its answers take the tool's own temperature and serial; the sheet says no other."""
    rows = [[*row, *row[3:]] for row in stations()]
    names = [f"Cradle S/N {tool} {end}" for tool in (11, 12) for end in [*CHANNELS, "Temp"]]
    path = text(tmp_path / "run.csv", [TITLES[0][:5], [], ["Inc", "Azi", "TF", *names], *rows])
    with pytest.raises(mwdcal.FitError, match="2 tools stand side by side") as error:
        mwdcal.propose_profile(path)
    (question,) = error.value.questions
    assert {("column", "temperature_c=Cradle S/N 12 Temp"), ("serial", "12")} < {
        *question.answers[1].arguments
    }


@pytest.mark.parametrize(
    ("first", "second", "warm", "taken"),
    [
        ("DUT", "Check standard", "Temp (C)", ["DUT Temp (C)", "Check standard Temp (C)"]),
        ("DUT", "check std", "T (°C)", ["DUT T (°C)", "check std T (°C)"]),
        ("DUT SN 118", "Check standard", "T C", ["DUT SN 118 T C", "Check standard T C"]),
        ("Bloco A", "Bloco B (padrão)", "T (°C)", ["Bloco A T (°C)", "Bloco B (padrão) T (°C)"]),
        ("DUT", "Golden tool", "Sensor temp (C)", ["DUT Sensor temp (C)", "Golden tool Sensor temp (C)"]),
        ("DUT", "Check standard", "", ["DUT Temp (C)", ""]),
    ],
)  # fmt: skip
def test_of_a_tool_beside_a_check_standard_one_question_asks(tmp_path, first, second, warm, taken):
    """Its answers take the temperature of each: of the one that has none, beside one that has, no other's."""
    rows = [
        [*row, *(1.02 * cell + 0.0007 * (-1) ** n for cell in row[3:9]), row[9] + 1]
        for n, row in enumerate(stations())
    ]
    names = [f"{first} {end}" for end in [*CHANNELS, warm or "Temp (C)"]]
    names += [f"{second} {end}" for end in [*CHANNELS, *filter(None, [warm])]]
    head = ["Inc", "Azi", "TF", *names]
    path = text(tmp_path / "run.csv", [*TITLES, head, *(row[: len(head)] for row in rows)])
    with pytest.raises(mwdcal.FitError, match="2 tools stand side by side") as error:
        mwdcal.propose_profile(path)
    (question,) = error.value.questions
    answers = [
        dict(text.split("=") for name, text in each.arguments if name == "column")
        for each in question.answers
    ]
    assert [each["az"] for each in answers] == [f"{first} Gz", f"{second} Gz"]
    assert [each["temperature_c"] for each in answers] == taken


def pairs_of_channels(first, second, name):
    """A table of channels as measured and, behind them, corrected: in other values, under these words."""
    names = [*NAMES[:3], *(name.format(word, end) for word in (first, second) for end in CHANNELS)]
    return [
        names,
        *([*row[:9], *(1.02 * value + 0.01 for value in row[3:9])] for row in stations()),
    ]


CORRECTIONS = [
    ("Uncorrected", "Corrected with previous coefficients"),
    ("Raw", "Calibrated"),
    ("Before correction", "After correction"),
    ("Roh", "Kalibriert"),
    ("Unkorrigierte", "Korrigierte"),
    ("Rå", "Korrigert"),
    ("Ukompensert", "Kompensert"),
    ("Crudo", "Corregido"),
    ("Sin corregir", "Corregido"),
    ("Bruto", "Corrigido"),
    ("Sem correção", "Com correção"),
    ("Non corrigé", "Corrigé"),
    ("Сырые", "Скорректированные"),
    ("Без поправок", "С поправками"),
    ("原始值", "修正值"),
    ("校正前", "校正后"),
]


@pytest.mark.parametrize(("first", "second"), CORRECTIONS)
@pytest.mark.parametrize("name", ["{0} {1}", "{1} {0}"])
def test_channels_called_raw_are_taken_beside_those_called_corrected(tmp_path, first, second, name):
    path = text(tmp_path / "run.csv", [*TITLES, *pairs_of_channels(first, second, name)])
    proposal = mwdcal.propose_profile(path)
    columns = [proposal.profile.columns[c].name for c in ("ax", "ay", "az", "mx", "my", "mz")]
    assert columns == [name.format(first, end) for end in CHANNELS]
    assert "columns not used" in proposal.findings[-1].text
    assert name.format(second, CHANNELS[0]) in proposal.findings[-1].text


@pytest.mark.parametrize("name", ["{0} {1}", "{1} {0}"])
def test_neither_of_two_triads_is_taken_by_unknown_words(tmp_path, name):
    path = text(tmp_path / "run.csv", [*TITLES, *pairs_of_channels("Foo", "Bar", name)])
    with pytest.raises(mwdcal.FitError) as error:
        mwdcal.propose_profile(path)
    offered = [a.arguments[0][1] for a in error.value.questions[0].answers]
    assert offered[:2] == [f"ax={name.format(word, CHANNELS[0])}" for word in ("Foo", "Bar")]
