"""Tables: the four formats hold the same cells, and numbers are read as written."""

import hashlib
import re
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.formats import atomic
from mwdcal.files.formats import columns as columns_module
from mwdcal.files.formats.table import (
    SUFFIXES,
    Table,
    labels,
    numbers,
    read,
    rendered,
    streamed,
    write,
)

quick = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

CSV = """\
# serial = MWD-123
# declination_deg = 3.5   # east
# date = 2026-02-03
# axes = ["+x", 2, true]
station,ax,note
A1,0.5,"one, two"
A2,-1e-3,
"""


def put(folder, content, name="run.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_text_is_kept_as_read(tmp_path):
    path = put(tmp_path, CSV)
    table = read(path)
    assert table.columns == {
        "station": ["A1", "A2"],
        "ax": ["0.5", "-1e-3"],
        "note": ["one, two", ""],
    }
    assert table.metadata == {
        "serial": "MWD-123",
        "declination_deg": 3.5,
        "date": "2026-02-03",
        "axes": ["+x", 2, True],
    }
    assert table.source == "run.csv"
    assert list(table.lines) == [6, 7]
    assert table.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    np.testing.assert_array_equal(numbers(table, "ax"), [0.5, -1e-3])


@pytest.mark.parametrize("newline", ["\r\n", "\r", "\n\n"])
@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
def test_newlines_and_byte_order_mark_do_not_matter(tmp_path, newline, bom):
    table = read(put(tmp_path, bom + CSV.replace("\n", newline).encode()))
    assert table.columns["station"] == ["A1", "A2"]
    assert table.metadata["serial"] == "MWD-123"


def test_metadata_survive_a_spreadsheet(tmp_path):
    saved = '"# lab = ""Hall 3, oven""",,\n# serial = MWD-7,,\nax,ay,az\n1,2,3\n,,\n'
    assert read(put(tmp_path, saved)).metadata == {"lab": "Hall 3, oven", "serial": "MWD-7"}


@pytest.mark.parametrize("line", ["#", "# ", "", "   "])
def test_empty_comments_say_nothing(tmp_path, line):
    assert read(put(tmp_path, f"{line}\nax\n1\n")).metadata == {}


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("# k = 10:30 on Monday", "10:30 on Monday"),
        ("# k = nan", "nan"),
        ("# k = -inf", "-inf"),
        ("# k = [inf]", ["inf"]),
        ("# k = 007", "007"),
        ("# k = 99999999999999999999", "99999999999999999999"),
        ("# k = Room #3", "Room #3"),
        ("#k=1", 1),
        ("# k = {a = 10:30:00}", {"a": "10:30:00"}),
        ('# "k" = 2026-02-03T10:00:00Z', "2026-02-03T10:00:00+00:00"),
    ],
)
def test_metadata_values(tmp_path, line, value):
    assert read(put(tmp_path, f"{line}\nax\n1\n")).metadata == {"k": value}


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_the_header_tells_the_delimiter(tmp_path, delimiter):
    path = put(tmp_path, delimiter.join(["ax", "ay"]) + "\n" + delimiter.join("12"))
    assert list(read(path).columns) == ["ax", "ay"]


def test_blank_cells_at_the_end_of_a_tab_separated_line(tmp_path):
    table = read(put(tmp_path, "ax\tay\taz\n1\t\t\n2\t\t\n", "run.tsv"))
    assert table.columns["az"] == ["", ""]


def test_decimal_comma(tmp_path):
    path = put(tmp_path, "station;ax\n1,5;0,998\n2;-1e-2\n")
    table = read(path, decimal=",")
    np.testing.assert_array_equal(numbers(table, "ax"), [0.998, -0.01])
    for suffix in SUFFIXES:
        write(tmp_path / f"out{suffix}", table)
        again = read(tmp_path / f"out{suffix}")
        np.testing.assert_array_equal(numbers(again, "ax"), [0.998, -0.01])
        assert labels(again, "station") == ["1,5", "2"]


def test_blank_is_nan_in_every_format(tmp_path):
    table = Table({"station": ["", "2", "007"], "ax": np.array([1.5, np.nan, -0.0])})
    for suffix in SUFFIXES:
        write(tmp_path / f"out{suffix}", table)
        again = read(tmp_path / f"out{suffix}")
        np.testing.assert_array_equal(numbers(again, "ax"), [1.5, np.nan, -0.0])
        assert labels(again, "station") == ["", "2", "007"]


def test_text_numbers_become_numbers_in_typed_formats_but_codes_do_not(tmp_path):
    table = Table(
        {
            "ax": ["1", " ", "2.5"],
            "badge": ["007", "8", "9"],
            "id": ["1152921504606846977", "8", "9"],
            "station": ["1", "2", "3"],
        }
    )
    for suffix in (".parquet", ".xlsx"):
        write(tmp_path / f"out{suffix}", table)
        again = read(tmp_path / f"out{suffix}")
        np.testing.assert_array_equal(again.columns["ax"], [1.0, np.nan, 2.5])
        assert again.columns["badge"] == ["007", "8", "9"]
        assert again.columns["id"] == ["1152921504606846977", "8", "9"]
        assert again.columns["station"] == ["1", "2", "3"]


def test_unusual_blanks_around_numbers(tmp_path):
    table = read(put(tmp_path, "ax\n\u00a01.5\u00a0\n\u2003\n+2.\n.5\n"))
    assert table.count == 3
    np.testing.assert_array_equal(numbers(table, "ax"), [1.5, 2.0, 0.5])


def test_parquet_of_other_programs(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {
        "station": arrow.array([1, 2]),
        "ax": arrow.array([1, None], arrow.int16()),
        "ay": arrow.array([1.5, float("nan")], arrow.float32()),
        "az": arrow.array(["a", "a"]).dictionary_encode(),
        "ok": arrow.array([True, None]),
        "when": arrow.array([0, 1], arrow.date32()),
        "price": arrow.array([1, 2]).cast(arrow.decimal128(21, 1)),
        "nothing": arrow.nulls(2),
        "__index_level_0__": arrow.array([7, 8]),
    }
    table = arrow.table(columns).replace_schema_metadata({"pandas": "{}"})
    parquet.write_table(table, tmp_path / "run.parquet")
    got = read(tmp_path / "run.parquet")
    assert got.metadata == {}
    assert got.columns["station"] == ["1", "2"]
    np.testing.assert_array_equal(got.columns["ax"], [1.0, np.nan])
    np.testing.assert_array_equal(got.columns["ay"], [1.5, np.nan])
    np.testing.assert_array_equal(got.columns["price"], [1.0, 2.0])
    assert got.columns["az"] == ["a", "a"]
    assert got.columns["ok"] == ["true", ""]
    assert got.columns["when"] == ["1970-01-01", "1970-01-02"]
    assert got.columns["nothing"] == ["", ""]
    assert "__index_level_0__" not in got.columns


def test_a_workbook_with_gaps_types_and_a_second_sheet(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet["A1"] = "# serial = MWD-9"
    for row, cells in {3: ["station", "ax", "ay"], 4: [1, 2, "3.5"], 7: [2, None, 4]}.items():
        for column, value in enumerate(cells, 1):
            sheet.cell(row, column, value)
    book.create_sheet("other")["A1"] = "noise"
    book.save(tmp_path / "run.xlsx")
    table = read(tmp_path / "run.xlsx")
    assert table.metadata == {"serial": "MWD-9"}
    assert list(table.lines) == [4, 7]
    assert labels(table, "station") == ["1", "2"]
    np.testing.assert_array_equal(numbers(table, "ax"), [2.0, np.nan])
    np.testing.assert_array_equal(numbers(table, "ay"), [3.5, 4.0])


def test_text_in_a_workbook_is_no_formula(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    write(tmp_path / "run.xlsx", Table({"station": ["=1+1", "#N/A"], "ax": ["1", "2"]}))
    cells = openpyxl.load_workbook(tmp_path / "run.xlsx").active
    assert [cells["A2"].data_type, cells["A3"].data_type] == ["s", "s"]
    assert labels(read(tmp_path / "run.xlsx"), "station") == ["=1+1", "#N/A"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_table_gives_the_same_bytes(tmp_path, monkeypatch, suffix):
    table = Table({"station": ["1", "2"], "ax": np.array([0.1, np.nan])}, {"serial": "é"})
    write(tmp_path / f"a{suffix}", table)
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2030, 1, 1, 1, 1, 1, 0, 0, 0))
    write(tmp_path / f"b{suffix}", table)
    first, second = (tmp_path / f"{name}{suffix}" for name in "ab")
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("module", "suffix"), [("pyarrow.parquet", "parquet"), ("openpyxl", "xlsx")]
)
def test_a_missing_extra_is_named(tmp_path, monkeypatch, module, suffix):
    path = put(tmp_path, b"PK\x03\x04", f"run.{suffix}")
    monkeypatch.setitem(sys.modules, module, None)
    library = module.split(".")[0]
    remedy = (
        f"file needs {library}, which is not installed. Install it with: {extras.command(suffix)}"
    )
    with pytest.raises(InputError, match=re.escape(remedy)):
        read(path)
    with pytest.raises(InputError, match=re.escape(remedy)):
        write(path, Table({"ax": ["1"]}))


@pytest.mark.parametrize(
    ("columns", "name", "message"),
    [
        ({}, "a.csv", "expected the column names"),
        ({"ax": ["1\n2"]}, "a.csv", "must be one line"),
        ({"ax": ["1\0"]}, "a.xlsx", "must be plain text"),
        (
            {"ax": ["1"]},
            "a.json",
            "must be one of .csv, .tsv, .parquet, .xlsx, .xml, .las; got '.json'",
        ),
        ({"ax": ["1"]}, "a", "got 'none'"),
    ],
)
def test_a_table_that_cannot_be_written(tmp_path, columns, name, message):
    with pytest.raises(InputError, match=message):
        write(tmp_path / name, Table(columns))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"decimal": "x"}, {"decimal": ""}])
def test_options_are_checked(tmp_path, options):
    with pytest.raises(InputError, match=r"`de(cimal|limiter)` must be"):
        read(put(tmp_path, CSV), **options)


names = st.lists(
    st.text("abcxyz_%é ", min_size=1, max_size=8).map(str.strip).filter(bool),
    min_size=1,
    max_size=5,
    unique=True,
)
cell_text = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Cn", "Zl", "Zp"]), max_size=12
).map(str.strip)
real = st.floats(allow_nan=True, allow_infinity=False)
values = st.recursive(
    st.booleans()
    | st.integers(-(2**62), 2**62)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8", exclude_characters="\0\ufffe\uffff"), max_size=9).filter(
        str.isprintable
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab c"), inner, max_size=2),
    max_leaves=4,
)


@st.composite
def tables(draw):
    """Tables of one label column, text and numbers, every row with some content."""
    count = draw(st.integers(1, 4))
    columns = {"station": [f"s{i}" for i in range(count)]}
    for name in draw(names):
        if draw(st.booleans()):
            columns[name] = np.array([draw(real) for _ in range(count)])
        else:
            columns[name] = [f"t{draw(cell_text)}" for _ in range(count)]
    keys = st.from_regex(r"[A-Za-z0-9_-]{1,9}", fullmatch=True)
    return Table(columns, draw(st.dictionaries(keys, values, max_size=3)))


@pytest.mark.parametrize("suffix", SUFFIXES)
@quick
@given(table=tables())
def test_what_is_written_is_read(tmp_path, suffix, table):
    path = tmp_path / f"run{suffix}"
    write(path, table)
    again = read(path)
    assert list(again.columns) == list(table.columns)
    assert again.metadata == table.metadata
    for name, column in table.columns.items():
        if isinstance(column, list):
            assert labels(again, name) == column
        else:
            got = numbers(again, name)
            assert got.tobytes() == np.where(np.isnan(column), np.nan, column).tobytes()


@quick
@given(value=st.floats(allow_nan=False, allow_infinity=False), form=st.sampled_from(["r", ".17e"]))
def test_numbers_as_printed_are_read_exactly(value, form):
    text = repr(value) if form == "r" else format(value, form)
    assert numbers(Table({"ax": [f" {text} "]}), "ax")[0] == value
    comma = Table({"ax": [text.replace(".", ",")]}, decimal=",")
    assert numbers(comma, "ax")[0] == value


def test_text_in_pieces_is_the_text_at_once(tmp_path):
    """A table of more rows than a piece, each number as alone, and no file where a cell cannot be written."""
    values = np.random.default_rng(1).normal(size=10_000)
    values[[0, 4096, 9_999]] = np.nan
    columns = {"number": values, "text": [f"S{row}" for row in range(10_000)]}
    table = Table(columns, {"serial": "T-1"}, "t.csv")
    atomic.write_all([(tmp_path / "t.csv", streamed(tmp_path / "t.csv", table))])
    rows = [f"{columns_module.number(v)},S{row}" for row, v in enumerate(values)]
    expected = "\n".join(['# serial = "T-1"', "number,text", *rows, ""])
    assert (tmp_path / "t.csv").read_text("utf-8") == expected
    assert rendered(tmp_path / "t.csv", table) == expected
    columns["text"][9_000] = "two\nlines"
    with pytest.raises(InputError, match="must be one line"):
        atomic.write_all([(tmp_path / "u.csv", streamed(tmp_path / "u.csv", table))])
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]
