"""Ugly files: whatever a user hands in, one InputError that says where and what to do."""

import os
import time
import zipfile
import zlib

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mwdcal.errors import InputError
from mwdcal.files.formats import text as text_tables
from mwdcal.files.formats.table import Table, write
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import read_run

HEADER = (
    "station,group,temperature_c,ax,ay,az,mx,my,mz,ref_inclination_deg,ref_azimuth_deg,"
    "ref_toolface_deg,ref_gravity_g,ref_field_nt,ref_dip_deg,sd_ax,sd_ref_dip_deg"
)
ROW = "1,A,25,0.1,0.2,2.9,1.1,0.3,2.2,45,120,30,1,50000,65,0.001,0.1"
GENERIC = load_profile("servo")[0]


def put(folder, content, name="run.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refusal(path, decimal="."):
    """The message of the one InputError that reading the file ends in."""
    with pytest.raises(InputError) as caught:
        read_run(path, GENERIC, decimal=decimal)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 1000
    return message


def with_cell(column, text):
    """A run of two stations, the second with `text` in `column`."""
    cells = dict(zip(HEADER.split(","), ROW.split(","), strict=True))
    cells[column] = text
    return f"{HEADER}\n{ROW}\n{','.join(cells.values())}\n"


def test_the_run_that_the_ugly_ones_are_made_of_is_fine(tmp_path):
    readings, _ = read_run(put(tmp_path, with_cell("ax", "0.11")), GENERIC)
    assert readings.count == 2


CONTENTS = {
    "empty": (b"", "run.csv: the file is empty"),
    "blank": (b" \r\n\n  ", "run.csv: the file is empty"),
    "mark only": (b"\xef\xbb\xbf", "run.csv: the file is empty"),
    "header only": (b"ax,ay,az\n", "column names but no stations"),
    "metadata only": (b"# serial = 1\n", "expected the column names"),
    "binary": (bytes(range(256)) * 40, "line 1: expected text; got a NUL byte"),
    "picture": (b"\x89PNG\r\n\x1a\n" + b"\0" * 50, "a PNG picture"),
    "workbook": (b"PK\x03\x04rest", "A workbook must be named .xlsx"),
    "parquet": (b"PAR1rest", "Name it .parquet"),
    "compressed": (zlib.compress(b"ax,ay,az\n1,2,3\n", wbits=31), "Unpack it first"),
    "old workbook": (b"\xd0\xcf\x11\xe0\xa1\xb1", "Save it as .xlsx"),
    "document": (b"%PDF-1.7", "a PDF document"),
    "UTF-16": ("ax,ay,az\n1,2,3\n".encode("utf-16"), "UTF-16 text. Save it as UTF-8"),
    "UTF-16 without mark": ("ax,ay,az\n1,2,3\n".encode("utf-16-le"), "binary or UTF-16"),
    "Latin-1": (b"ax,ay,az\n1,2,3 \xb0\n", "line 2: expected UTF-8 text; got byte 0xB0"),
    "NUL": (b"ax,ay,az\n1,2,\x003\n", "line 2: expected text; got a NUL byte"),
    "short row": (b"ax,ay,az\n1,2,3\n1,2\n", "line 3: expected 3 cells"),
    "long row": (b"ax,ay,az\n1,2,3\n1,2,3,4\n", "line 3: expected 3 cells"),
    "decimal commas": (b"ax,ay,az\n0,1,0,2,0,9\n", "a decimal comma needs ';'"),
    "late comment": (b"ax,ay,az\n# a = 1\n1,2,3\n", "belong above the column names"),
    "semicolons": (
        b"ax;ay;az\n0,998;0;0\n",
        "line 2, column 'ax': expected a number; got '0,998'.",
    ),
    "missing": (b"station,gx,ay\n1,2,3\n", "'ax', 'az' are missing; found 'station', 'gx', 'ay'"),
    "close": (b"axx,ay,az\n1,2,3\n", "Did you mean 'axx' for 'ax'?"),
    "prose": (b"Dear all\nplease find the run\n", "must be present"),
    "near miss": (b"Ax,ay,az\n1,2,3\n", "column 'Ax' must be spelled exactly"),
    "unit miss": (b"ax,ay,az,ref_inclination\n1,2,3,4\n", "Did you mean 'ref_inclination_deg'"),
    "radians": (b"ax,ay,az,ref_dip_rad\n1,2,3,4\n", "Did you mean 'ref_dip_deg'"),
    "spaced": (b"ax,ay,az,Sd AX [V]\n1,2,3,4\n", "Did you mean 'sd_ax'"),
    "duplicate": (b"ax,ay,ax,az\n1,2,3,4\n", "line 1: column names must be unique; got 'ax'"),
    "unnamed": (b"ax,ay,az,\n1,2,3,4\n", "column 4 has none"),
    "headless": (b"1.0,2,3\n1,2,3\n", "line 1: expected the column names; got numbers"),
    "half a triad": (b"ax,ay,az,mx,mz\n1,2,3,4,5\n", "'my' is missing"),
    "many columns": (b",".join(b"c%d" % i for i in range(2000)), "at most 1000 columns; got 2000"),
    "quoted newline": (b'ax,ay,az,n\n1,2,3,"a\nb"\n', "line 2: a cell in quotes must end"),
    "open quote": (b'ax,ay,az,n\n1,2,3,4\n1,2,3,"a\n', "line 3: a cell in quotes must end"),
    "loose quote": (b'ax,ay,az,n\n1,2,3,"a"b\n', "line 2: a cell in quotes must end"),
    "endless quote": (b'ax,ay,az,n\n1,2,3,"' + b"a\n" * 60_000, "line 2: a cell in quotes"),
    "comment": (b"# made by hand\nax,ay,az\n1,2,3\n", "line 1: a line that starts with '#'"),
    "no key": (b"# = 3\nax,ay,az\n1,2,3\n", "must read `# key = value`"),
    "spaced key": (b"# a b = 3\nax,ay,az\n1,2,3\n", "must read `# key = value`"),
    "no value": (b"# a =\nax,ay,az\n1,2,3\n", "must read `# key = value`"),
    "open string": (b'# a = "b\nax,ay,az\n1,2,3\n', "must read `# key = value`"),
    "open list": (b"# a = [1, 2\nax,ay,az\n1,2,3\n", "must read `# key = value`"),
    "section": (b"# [a]\nax,ay,az\n1,2,3\n", "must read `# key = value`"),
    "deep list": (b"# a = " + b"[" * 90_000 + b"\nax\n1\n", "must read `# key = value`"),
    "repeated key": (
        b"# a = 1\n# a = 2\nax,ay,az\n1,2,3\n",
        "line 2: metadata keys must be unique",
    ),
    "partly blank": (
        b"temperature_c,ax,ay,az\n20,1,2,3\n,1,2,3\n",
        "line 3, column 'temperature_c'",
    ),
    "partial sd": (b"ax,ay,az,sd_ax\n1,2,3,0\n1,2,3,-1e-9\n", "line 3, column 'sd_ax'"),
}


@pytest.mark.parametrize(("content", "part"), CONTENTS.values(), ids=CONTENTS)
def test_ugly_text(tmp_path, content, part):
    assert part in refusal(put(tmp_path, content))


@pytest.mark.parametrize(("rows", "refused"), [(1000, False), (1001, True)])
def test_a_text_table_has_no_more_than_a_million_rows(tmp_path, monkeypatch, rows, refused):
    """A thousand here, by the same check, which counts the lines after the first."""
    assert text_tables._MAX_LINES == 1_000_000
    monkeypatch.setattr(text_tables, "_MAX_LINES", 1000)
    told = refusal(put(tmp_path, b"ax\n" + b"1\n" * rows))
    assert ("a text table must have at most 1000 lines" in told) is refused


CELLS = [
    ("ax", "", "must be filled in; got a blank cell"),
    ("mz", "  ", "must be filled in; got a blank cell"),
    ("ax", "nan", "expected a number; got 'nan'. Every number must be finite"),
    ("ax", "NaN", "leave_out = {'ax' = ['NaN']}. Leave the cell blank where another"),
    ("ax", "-inf", "Every number must be finite"),
    ("ax", "Infinity", "Every number must be finite"),
    ("ax", "n/a", "Where a channel has no value, leave such rows out by leave_out"),
    ("ax", "1e400", "expected a finite number; got '1e400', which is too large"),
    ("ax", "1e308", "must be between -1e+15 and 1e+15; got 1e+308"),
    ("ax", "0x1F", "Write decimal numbers"),
    ("ax", "1_000", "Write numbers without thousands separators"),
    ("ax", "12 545", "Write numbers without thousands separators"),
    ("ax", "12'545.5", "Write numbers without thousands separators"),
    ("ax", '"1,234.5"', "Write numbers without thousands separators"),
    (
        "ax",
        '"0,998"',
        "got '0,998'. Other cells of the column have the other decimal sign. Correct this one.",
    ),
    ("ax", "1.2.3", "Write a plain number"),
    ("ax", "0.98 g", "Write the number without its unit"),
    ("ax", "0.98g", "Write the number without its unit"),
    ("ax", "0.98 m/s2", "Write the number without its unit"),
    ("ax", "12e4x", "Write a plain number"),
    (
        "ax",
        "n/a?",
        "leave such rows out by leave_out in [table] of the tool profile: leave_out = {'ax' = ['n/a?']}.",
    ),
    ("ax", "--1", "Write a plain number"),
    ("ax", "١٢", "Write a plain number"),
    ("ax", "true", "Write a plain number"),
    ("ax", "=A1", "Write a plain number"),
    ("ax", "x" * 5000, "xxx…'"),
    ("ref_inclination_deg", "1000", "must be between 0 and 180 °; got 1000 °"),
    ("ref_inclination_deg", "-0.1", "must be between 0 and 180 °; got -0.1 °"),
    ("ref_azimuth_deg", "361", "must be between -360 and 360 °; got 361 °"),
    ("ref_toolface_deg", "-400", "must be between -360 and 360 °; got -400 °"),
    ("ref_dip_deg", "91", "must be between -90 and 90 °; got 91 °"),
    ("ref_dip_deg", "nan", "expected a number; got 'nan'"),
    ("temperature_c", "-400", "must be between -273.15 and 1000 °C; got -400 °C"),
    ("temperature_c", "1001", "got 1001 °C"),
    ("temperature_c", "", "or leave the whole column blank"),
    ("ref_gravity_g", "0", "must be above 0 and at most 2 g; got 0 g"),
    ("ref_gravity_g", "9.81", "at most 2 g; got 9.81 g"),
    ("ref_gravity_g", "-1", "got -1 g"),
    ("ref_field_nt", "0", "must be above 0 and at most 200000 nT; got 0 nT"),
    ("ref_field_nt", "-50000", "got -50000 nT"),
    ("ref_field_nt", "200001", "got 200001 nT"),
    ("sd_ax", "-1e-3", "must be between 0 and 1e+15; got -0.001"),
    ("sd_ax", "0", "must be above 0; got 0"),
    ("sd_ref_dip_deg", "-1", "must be between 0 and 180 °; got -1 °"),
]


@pytest.mark.parametrize(
    ("column", "text", "part"), CELLS, ids=[f"{c} {t[:9]}" for c, t, _ in CELLS]
)
def test_ugly_cells_are_named_by_file_line_and_column(tmp_path, column, text, part):
    message = refusal(put(tmp_path, with_cell(column, text)))
    assert message.startswith(f"run.csv, line 3, column '{column}': ")
    assert part in message


def test_a_point_where_the_decimal_sign_is_the_comma(tmp_path):
    path = put(tmp_path, "ax;ay;az\n1,5;0.5;1\n")
    assert "Is the point intended? Use `decimal` '.'" in refusal(path, ",")


@pytest.mark.parametrize(
    ("line", "part"),
    [
        (
            "# azimuth_reference = true north",
            "must be one of magnetic, true, grid; got 'true north'",
        ),
        ("# azimuth_reference = true", "true azimuths need the metadata 'declination_deg'"),
        ("# azimuth_reference = false", "must be one of magnetic, true, grid; got False"),
        ('# azimuth_reference = "true"', "need the metadata 'declination_deg'"),
        ('# azimuth_reference = "grid"', "need the metadata 'declination_deg'"),
        ("# declination = 3", "Did you mean 'declination_deg'"),
        ("# Azimuth_Reference = magnetic", "Did you mean 'azimuth_reference'"),
        ("# declination_deg = 3,5", "must be a number between -180 and 180 °; got '3,5'"),
        ("# declination_deg = 200", "got 200"),
        ("# declination_deg = true", "got True"),
        ("# convergence_deg = nan", "got 'nan'"),
    ],
)
def test_ugly_azimuth_metadata(tmp_path, line, part):
    assert part in refusal(put(tmp_path, f"{line}\n{HEADER}\n{ROW}\n"))


def test_a_folder_a_missing_file_and_unknown_suffixes(tmp_path):
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder" in refusal(tmp_path / "folder.csv")
    assert "no such file" in refusal(tmp_path / "missing.csv")
    assert "no such file" in refusal(tmp_path / "nul\0.csv")
    valid = "must be one of .csv, .tsv, .parquet, .xlsx"
    for name in ("run.csv.gz", "run"):
        assert valid in refusal(put(tmp_path, ROW, name))
    assert "mwdcal profile" in refusal(put(tmp_path, ROW, "run.xls"))


@pytest.mark.skipif(os.name == "nt", reason="POSIX devices")
def test_a_device_is_no_run(tmp_path):
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    assert "not a regular file" in refusal(tmp_path / "zero.csv")


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    path = put(tmp_path, ROW)

    def refuse(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(type(path), "read_bytes", refuse)
    assert "Permission denied. Check that the file may be read" in refusal(path)


def test_a_file_beyond_every_run(tmp_path):
    with (tmp_path / "run.csv").open("wb") as stream:
        stream.truncate(10**12)
    assert "must have at most 50000000 bytes; got 1000000000000" in refusal(tmp_path / "run.csv")


@pytest.mark.parametrize(
    "content",
    [b"," * 3_000_000 + b"\n1\n", b"ax,ay,az\n" + b"1" * 49_000_000, b"ax\n" + b"1," * 24_000_000],
    ids=["3 million columns", "49 MB cell", "48 MB line"],
)
def test_long_lines_are_refused_at_once(tmp_path, content):
    path = put(tmp_path, content)
    start = time.process_time()
    assert "a line must have at most 100000 characters" in refusal(path)
    assert time.process_time() - start < 5.0


RUN = Table({"station": ["1", "2"], "ax": ["1", "2"], "ay": ["1", "2"], "az": ["1", "2"]})


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_files(tmp_path, suffix, share):
    path = tmp_path / f"run{suffix}"
    write(path, RUN)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    assert "reading it failed" in refusal(path)


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
def test_a_foreign_file_under_a_typed_suffix(tmp_path, suffix):
    assert "reading it failed" in refusal(put(tmp_path, HEADER, f"run{suffix}"))


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
def test_rows_are_named_in_typed_files(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    write(path, Table({"ax": ["1", "oops"], "ay": ["1", "2"], "az": ["1", "2"]}))
    place = "row 2" if suffix == ".parquet" else "cell A3"
    assert f"run{suffix}, {place}, column 'ax': expected a number; got 'oops'" in refusal(path)


def test_parquet_with_odd_contents(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "run.parquet"
    for columns, metadata, part in [
        ({"ax": [1.0, float("inf")], "ay": [1, 2], "az": [1, 2]}, {}, "row 2, column 'ax'"),
        ({"ax": [], "ay": [], "az": []}, {}, "no stations"),
        ({"ax": [[1]], "ay": [1], "az": [1]}, {}, "expected a number; got '[1]'"),
        ({"ax": [True], "ay": [1], "az": [1]}, {}, "expected a number; got 'true'"),
        ({"ax": [1], "ay": [1], "az": [1]}, {"mwdcal": "[1]"}, "must be a JSON object"),
        ({"ax": [1], "ay": [1], "az": [1]}, {"mwdcal": b"\xff"}, "must be a JSON object"),
        ({"ax": arrow.nulls(150_000_000, arrow.bool_())}, {}, "at most 1000000 rows"),
    ]:
        table = arrow.table(columns).replace_schema_metadata(metadata)
        parquet.write_table(table, path)
        assert part in refusal(path)
    parquet.write_table(arrow.table([[1], [2]], names=["ax", "ax"]), path)
    assert "must be unique" in refusal(path)
    parquet.write_table(arrow.table({}), path)
    assert "expected the column names" in refusal(path)


def test_a_workbook_that_unpacks_to_too_much(tmp_path):
    with zipfile.ZipFile(tmp_path / "run.xlsx", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b" " * 201_000_000)
    assert "must unpack to at most" in refusal(tmp_path / "run.xlsx")


def sheet_file(path, rows):
    """A workbook whose sheet holds the XML `rows`."""
    write(path, RUN)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = "xl/worksheets/sheet1.xml"
    start, end = parts[name].index(b"<sheetData>"), parts[name].index(b"</sheetData>")
    parts[name] = parts[name][:start] + b"<sheetData>" + rows + parts[name][end:]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, content in parts.items():
            archive.writestr(part, content)


@pytest.mark.parametrize(
    ("rows", "part"),
    [
        (b"", "expected the column names"),
        (b'<row r="999999999"><c r="A999999999"><v>1</v></c></row>', "at most 1048576 rows"),
        (b'<row r="1"><c r="XFD1"><v>1</v></c></row>', "at most 1000 columns"),
        (b'<row r="1"><c r="A1"><v>x</v></c></row>', "reading it failed"),
        (b"<row", "reading it failed"),
    ],
)
def test_ugly_sheets(tmp_path, rows, part):
    sheet_file(tmp_path / "run.xlsx", rows)
    start = time.process_time()
    assert part in refusal(tmp_path / "run.xlsx")
    assert time.process_time() - start < 5.0


quick = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
PIECES = st.sampled_from(
    [
        *(b"ax", b"ay", b"az", b"sd_ax", b"ref_azimuth_deg", b"ax,ay,az\n", b"mx,my,mz"),
        *(b",", b";", b"\t", b"\n", b"\r\n", b'"', b"'", b" ", b"[", b"#", b"# a = "),
        *(b"1", b"-.5e3", b"nan", b"1,2,3\n", b"\xef\xbb\xbf", b"\0", b"\xff", b"\xc3\xa9"),
    ]
)


def outcome(path, decimal="."):
    """What reading the file ends in: number of stations, or message of an InputError."""
    try:
        return read_run(path, GENERIC, decimal=decimal)[0].count
    except InputError as error:
        return str(error)


def read_or_refuse(path, decimal="."):
    """Read the file: a run, or an InputError of one line; anything else is a fault."""
    result = outcome(path, decimal)
    assert "\n" not in result if isinstance(result, str) else result >= 1


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".xlsx"])
@quick
@given(content=st.binary(max_size=200) | st.lists(PIECES, max_size=30).map(b"".join))
@example(content=b'"#\n')
def test_arbitrary_bytes_give_a_run_or_an_input_error(tmp_path, suffix, content):
    read_or_refuse(put(tmp_path, content, f"run{suffix}"))


@quick
@given(
    cells=st.lists(
        st.text(max_size=6)
        | st.floats().map(repr)
        | st.integers(-400, 400).map(str)
        | st.sampled_from(["", " "]),
        min_size=17,
        max_size=17,
    ),
    decimal=st.sampled_from(".,"),
)
def test_arbitrary_cells_give_a_run_or_an_input_error(tmp_path, cells, decimal):
    content = f"{HEADER}\n{ROW}\n{','.join(cells)}\n".encode("utf-8", "replace")
    read_or_refuse(put(tmp_path, content), decimal)


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
@quick
@given(position=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255))
def test_a_damaged_byte_gives_a_run_or_an_input_error(tmp_path, suffix, position, byte):
    path = tmp_path / f"run{suffix}"
    write(path, RUN)
    data = bytearray(path.read_bytes())
    data[int(position * len(data))] = byte
    path.write_bytes(data)
    read_or_refuse(path)


CELLS = {
    "no value": ('<c r="J2"><f>5+20*0</f></c>', True),
    "an empty one": ('<c r="J2"><f>5+20*0</f><v></v></c>', True),
    "of text": ('<c r="J2" t="str"><f>"a"</f><v></v></c>', False),  # its value is an empty text
    "a number": ('<c r="J2"><f>5+20*0</f><v>5</v></c>', False),
    "of others": ('<c r="J2"><f t="shared" si="0"/></c>', True),
}


@pytest.mark.parametrize("name", CELLS)
def test_formulas_that_nobody_has_calculated_are_refused_by_their_cells(tmp_path, name):
    """Programs that write workbooks leave the value out; read as blank, a reference would be unknown."""
    cell, lost = CELLS[name]
    cells = [*zip(HEADER.split(","), ROW.split(","), strict=True)]
    columns = {name: [value] for name, value in cells if not name.startswith("sd_")}
    write(tmp_path / "run.xlsx", Table(columns))
    with zipfile.ZipFile(tmp_path / "run.xlsx") as book:
        parts = {each: book.read(each) for each in book.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    text = parts[sheet].decode()
    start = text.index('<c r="J2"')
    end = text.index("</c>", start) + len("</c>")
    parts[sheet] = (text[:start] + cell + text[end:]).encode()
    with zipfile.ZipFile(tmp_path / "run.xlsx", "w") as book:
        for each, content in parts.items():
            book.writestr(each, content)
    if lost:
        assert "run.xlsx: formulas without a value, in the cells J2 (=" in refusal(
            tmp_path / "run.xlsx"
        )
    else:
        assert read_run(tmp_path / "run.xlsx", GENERIC)[0].count == 1
