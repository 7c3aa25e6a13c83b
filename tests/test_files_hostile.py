"""Files made to mislead a reader or to exhaust it: read back as written, or refused in one sentence."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tomllib
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cli_support import calibrated, mwdcal, refused, servo_run
from mwdcal.app import correction
from mwdcal.errors import InputError
from mwdcal.files import metadata, profiles
from mwdcal.files.formats import workbook as workbook_limits
from mwdcal.files.formats.columns import plain_names
from mwdcal.files.formats.table import Table, numbers, read, write
from mwdcal.files.limits import load_limits
from mwdcal.planning.plans import load_plan

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

READING = {"ax": 0.1, "ay": 0.3, "az": 2.9, "mx": 0.1, "my": 0.3, "mz": 2.0}
NOTES = ["plain", " leading", "=1+1", "-2+3", "@x", "+", "-1.5", 'a "quoted", b', "", "0:30;1"]
quick = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("fit"), servo_run())


def table(rows=1, **columns):
    """An Arrow table of readings and other columns."""
    readings = {name: np.full(rows, value) for name, value in READING.items()}
    return pa.table({**readings, "temperature_c": np.full(rows, 25.0), **columns})


def others_read(path):
    """Header and rows as Python's own reader has them, without the lines of comments."""
    with path.open(encoding="utf-8", newline="") as stream:
        lines = [line for line in stream if not line.startswith("#")]
    header, *rows = csv.reader(lines)
    return header, rows


def applied(calibration, folder, source, name="out.csv", *options):
    ran = mwdcal("apply", calibration, source, "-o", folder / name, *options)
    assert ran.code == 0, ran.err
    return ran


NAME = st.text(st.sampled_from("ab #\n\r\t\x85\u2028\ufeff\",;'=xy(2)"), min_size=1, max_size=6)


@quick
@given(st.lists(NAME, min_size=1, max_size=6, unique=True), st.sampled_from([".csv", ".tsv"]))
def test_any_names_are_read_back_as_they_are_written(tmp_path, names, suffix):
    path = tmp_path / f"t{suffix}"
    columns = {name: [str(i), f" {i}"] for i, name in enumerate(names)} | {"ax": ["1", "2"]}
    write(path, Table(columns))
    back = read(path).columns
    assert list(back.values()) == list(columns.values())
    assert list(back) == plain_names([*columns])
    with path.open(encoding="utf-8", newline="") as stream:
        header = next(csv.reader(stream, delimiter="," if suffix == ".csv" else "\t"))
    assert header == list(back)


@quick
@given(st.lists(NAME, min_size=1, max_size=6, unique=True))
def test_plain_names_are_one_line_each_and_kept_where_they_were_plain(names):
    plain = plain_names(names)
    assert len({*plain}) == len(names)
    assert plain_names(plain) == plain
    for old, new in zip(names, plain, strict=True):
        assert len(new.splitlines()) == 1
        assert new == new.strip()
        if old == old.strip() and old.isalnum():
            assert new == old


@quick
@given(st.lists(st.text(st.sampled_from(' ax",;#=-1'), max_size=6), min_size=1, max_size=5))
def test_cells_keep_every_character_blanks_before_them_too(tmp_path, cells):
    path = tmp_path / "t.csv"
    columns = {"ax": ["1"] * len(cells), "note": cells, "more": cells[::-1]}
    write(path, Table(columns))
    assert read(path).columns == columns


def test_blanks_between_delimiter_and_quote_are_not_of_the_cell(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text('ax, "a b", c\n1, "x, ""y""", z\n2,"p, ""q""",  "r"\n')
    back = read(path).columns
    assert back == {"ax": ["1", "2"], "a b": ['x, "y"', 'p, "q"'], "c": [" z", "r"]}


@pytest.mark.parametrize(
    ("name", "written"),
    [("Temp\n(C)", "Temp (C)"), (" #x", "x"), (" ", "column 1"), ("note ", "note (2)")],
)
@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".xlsx", ".parquet"])
def test_apply_of_a_table_with_odd_names(calibration, tmp_path, name, written, suffix):
    odd = pa.table({name: ["x"], "note": ["y"]})
    for column in table().column_names:
        odd = odd.append_column(column, table().column(column))
    pq.write_table(odd, tmp_path / "in.parquet")
    ran = applied(calibration, tmp_path, tmp_path / "in.parquet", f"out{suffix}")
    back = read(tmp_path / f"out{suffix}").columns
    kept = name if suffix == ".parquet" else written
    assert list(back)[:2] == [kept, "note"]
    assert (back[kept], back["note"]) == (["x"], ["y"])
    assert ("columns renamed" in ran.err) == (suffix != ".parquet")
    if suffix == ".csv":
        header, rows = others_read(tmp_path / "out.csv")
        assert header == list(back)
        assert rows == [list(row) for row in zip(*back.values(), strict=True)]


@pytest.mark.parametrize("parts", [False, True])
def test_text_cells_are_written_as_they_are_and_formulas_are_reported(
    calibration, tmp_path, monkeypatch, parts
):
    count = len(NOTES)
    write(
        tmp_path / "in.csv",
        Table({**{n: [str(v)] * count for n, v in READING.items()}, "note": NOTES, "-x": NOTES[:1] * count}),
    )  # fmt: skip
    monkeypatch.setattr(correction, "TABLE_SIZES", {".csv": 0} if parts else {})
    ran = applied(calibration, tmp_path, tmp_path / "in.csv", "out.csv", "--json")
    header, rows = others_read(tmp_path / "out.csv")
    assert [row[header.index("note")] for row in rows] == NOTES
    assert read(tmp_path / "out.csv").columns["note"] == NOTES
    texts = {each["id"]: each["text"] for each in ran.json["findings"]}
    assert texts["formula-cells"].endswith("'note', '-x'.")


def test_numbers_with_a_sign_are_no_formulas(calibration, tmp_path):
    pq.write_table(table(2, note=["-1.5", "+2e3 "]), tmp_path / "in.parquet")
    assert "formulas" not in applied(calibration, tmp_path, tmp_path / "in.parquet").err


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".xlsx"])
@pytest.mark.parametrize("stated", [["old"], "old"])
def test_findings_stand_once_those_of_the_input_first(calibration, tmp_path, suffix, stated):
    bare = table().drop_columns(["mx", "my", "mz"])
    described = {b"mwdcal": json.dumps({"findings": stated}).encode()}
    pq.write_table(bare.replace_schema_metadata(described), tmp_path / "in.parquet")
    applied(calibration, tmp_path, tmp_path / "in.parquet", f"out{suffix}")
    first, _, second = read(tmp_path / f"out{suffix}").metadata["findings"]
    assert first == "old"
    assert "no columns mx, my, mz" in second


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def workbook(path, sheet=b"", part="xl/worksheets/sheet1.xml", head=b""):
    """A workbook of which a part is replaced: the rows of the sheet, or all of another one."""
    write(path, Table({"ax": ["1"], "ay": ["2"], "az": ["3"]}))
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    namespace = b"http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    if part.startswith("xl/worksheets"):
        sheet = (
            b'<worksheet xmlns="'
            + namespace
            + b'"><sheetData>'
            + sheet
            + b"</sheetData></worksheet>"
        )
    parts[part] = head + sheet
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


def test_a_sheet_that_names_a_text_that_is_not_there_is_damaged(tmp_path):
    row = (
        b'<row r="1">'
        + b"".join(b'<c r="%cl" t="s"><v>99</v></c>' % c for c in b"ABCD")
        + b"</row>"
    )
    path = workbook(tmp_path / "run.xlsx", row.replace(b'l"', b'1"'))
    for arguments in (("profile", path), ("calibrate", path)):
        ran = mwdcal(*arguments, "-o", tmp_path / "out")
        assert "expected an Excel workbook" in refused(ran, 2)


FLOOD = b"".join(b' a%d=""' % i for i in range(200_000))


@pytest.mark.parametrize(
    ("sheet", "part"),
    [
        (b'<row r="1"><c r="A1"><v>1</v></c><c r="XFD1"><v>1</v></c></row>', "at most 1000 columns"),
        (b"<row" + FLOOD + b"/>", "bytes in an element"),
        (b"".join(b"<n%d/>" % i for i in range(20_000)), "names"),
        (b"<n/>" * 600_000, "other elements"),
        (b'<row><c t="str"><v>' + b"x" * 2_000_000 + b"</v></c></row>", "characters in a cell"),
        (b'<row><c><is>' + b"<r><t>xxx</t></r>" * 30_000 + b"</is></c></row>", "characters in a cell"),
        (b"<row><c><is>" + b"<rPr/>" * 600_000 + b"</is></c></row>", "at most 500002 parts in 1 cells"),
        (b"<row><c>" + b"<v/>" * 600_000 + b"</c></row>", "parts in 1 cells"),
        (b'<row r="1"/><row r="900000"/>', "blank rows"),
        (b'<row r="1048577"/>', "1048576 rows"),
        (b'<row><c t="s"><v>7</v></c></row>', "reading it failed"),
        (b'<row><c r="ABCD1"><v>7</v></c></row>', "at most 1000 columns"),
    ],
)  # fmt: skip
def test_sheets_that_no_program_writes(tmp_path, sheet, part):
    assert part in refusal(workbook(tmp_path / "t.xlsx", sheet))


LONG_KEYS = {
    "dotted": ".".join(["a"] * 45_000) + " = 1",
    "quoted": '."b c" . '.join(["a"] * 45_000) + " = 1",
    "section": "[" + ".".join(["a"] * 45_000) + "]",
    "within": "x = {" + ".".join(["a"] * 45_000) + " = 1}",
}


@pytest.mark.parametrize("text", LONG_KEYS.values(), ids=LONG_KEYS)
@pytest.mark.parametrize("where", ["profile", "limits", "plan", "metadata"])
def test_a_key_of_many_parts_is_refused_before_it_takes_memory(tmp_path, where, text):
    """tomllib holds every beginning of such a key: 45,000 parts are 1e9 references, 8 GB."""
    path = tmp_path / f"{where}.toml"
    path.write_text(f'name = "x"\n{text}\n', encoding="utf-8")
    load = {
        "profile": lambda: profiles.load_profile(str(path)),
        "limits": lambda: load_limits(str(path)),
        "plan": lambda: load_plan(str(path)),
        "metadata": lambda: metadata.parse([(1, f"# {text}")], "run.csv"),
    }[where]
    tracemalloc.start()
    with pytest.raises(InputError) as refused:
        load()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50_000_000
    assert len(str(refused.value)) < 400
    assert where == "metadata" or "at most 20 parts" in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 20) + " = 1",
        'x = "' + "a." * 50 + '"',
        "x = [" + "1.5, " * 50 + "]",
        "# " + "a." * 50,
        "x = '" + "." * 50 + "'",
    ],
)
def test_dots_elsewhere_are_no_keys(text):
    assert metadata.load_toml(text) == tomllib.loads(text)


def test_parts_whose_names_have_commas_are_checked_too(tmp_path):
    part = "xl/notes, old, 2.xml"
    path = workbook(tmp_path / "t, 1.xlsx", b"<n/>", part=part)
    assert list(read(path).columns) == ["ax", "ay", "az"]
    workbook(path, b"<row" + FLOOD + b"/>", part=part)
    assert refusal(path).startswith(
        f"t, 1.xlsx, {part}: a workbook must have at most 1048576 bytes"
    )


def test_a_workbook_that_defines_entities_is_refused(tmp_path):
    head = b'<!DOCTYPE x [<!ENTITY a "<row/>">]>'
    path = workbook(tmp_path / "t.xlsx", b"&a;" * 9, head=head)
    assert "must not define a document type" in refusal(path)


def test_more_cells_than_any_run_has(tmp_path, monkeypatch):
    monkeypatch.setitem(workbook_limits.MAX_COUNTS, "c", (5, "cells"))
    path = tmp_path / "t.xlsx"
    write(path, Table({"ax": ["1", "2"], "ay": ["1", "2"]}))
    assert "at most 5 cells" in refusal(path)


def test_a_whole_number_of_400_digits_in_a_workbook_is_too_large(tmp_path):
    cells = b"".join(b'<c t="inlineStr"><is><t>%b</t></is></c>' % n for n in (b"ax", b"note"))
    long = b"9" * 400
    path = workbook(
        tmp_path / "t.xlsx",
        b"<row>" + cells + b"</row><row><c><v>" + long + b"</v></c><c><v>" + long + b"</v></c></row>",
    )  # fmt: skip
    found = read(path)
    assert found.columns["note"] == ["9" * 400]
    with pytest.raises(InputError, match="column 'ax': expected a finite number; got '9999"):
        numbers(found, "ax")


def test_phonetic_signs_and_formats_of_text_are_left_out(tmp_path):
    runs = b'<r><t>a</t></r><rPh sb="0" eb="1"><t>zz</t></rPh><r><rPr><b/></rPr><t>x</t></r>'
    path = workbook(
        tmp_path / "t.xlsx",
        b'<row><c t="inlineStr"><is>' + runs + b"</is></c></row><row><c><v>1</v></c></row>",
    )
    assert list(read(path).columns) == ["ax"]


def test_lists_in_a_column_are_read_while_they_are_short(calibration, tmp_path):
    pq.write_table(table(2, wave=[[1.5, 2.0], []]), tmp_path / "in.parquet")
    applied(calibration, tmp_path, tmp_path / "in.parquet", "out.parquet")
    back = pq.read_table(tmp_path / "out.parquet").column("wave")
    assert back.to_pylist() == [[1.5, 2.0], []]


def short_lists(path):
    """One row of two million values."""
    wave = pa.ListArray.from_arrays([0, 2_000_000], pa.array(np.zeros(2_000_000, np.int8)))
    pq.write_table(table(1, wave=wave), path)


def long_texts(path):
    """A text of 100 kB in each of 20 000 rows, stored once."""
    texts = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(20_000, np.int32)), pa.array(["x" * 100_000])
    )
    pq.write_table(table(20_000, note=texts), path, store_schema=False)


def dense_texts(path):
    """The same 400 MB, stored row by row and compressed."""
    pq.write_table(
        table(4_000, note=["x" * 100_000] * 4_000), path, use_dictionary=False, compression="zstd"
    )


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (short_lists, "column 'wave': expected one value in each cell"),
        (long_texts, "texts of rows that are read at once must have at most"),
        (dense_texts, "a row group must unpack to at most"),
    ],
)
def test_small_parquet_files_that_would_be_large_in_memory(calibration, tmp_path, make, part):
    path = tmp_path / "in.parquet"
    make(path)
    assert part in refusal(path)
    ran = mwdcal("apply", calibration, path, "-o", tmp_path / "o.csv")
    assert (ran.code, part in ran.err) == (2, True)


def test_apply_of_such_a_file_takes_less_than_half_a_gigabyte(calibration, tmp_path):
    long_texts(tmp_path / "in.parquet")
    command = ["-m", "mwdcal", "apply", str(calibration), "in.parquet", "-o", "o.parquet"]
    measure = (
        "import resource, subprocess, sys\n"
        f"code = subprocess.run([sys.executable, *{command!r}], capture_output=True).returncode\n"
        "print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", measure], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    code, kilobytes = map(int, ran.stdout.split())
    assert code == 2
    assert kilobytes < 500_000


def test_text_that_is_not_utf_8_in_a_parquet_file_is_refused(calibration, tmp_path):
    note = pa.Array.from_buffers(
        pa.string(), 1, [None, pa.py_buffer(np.array([0, 1], np.int32)), pa.py_buffer(b"\xff")]
    )
    pq.write_table(table(1, note=note), tmp_path / "in.parquet")
    for suffix in (".csv", ".parquet"):
        ran = mwdcal("apply", calibration, tmp_path / "in.parquet", "-o", tmp_path / f"o{suffix}")
        assert (ran.code, "reading it failed" in ran.err) == (2, True)


def test_a_run_has_at_most_as_many_rows_as_a_text_table(tmp_path):
    ones = pa.DictionaryArray.from_arrays(pa.array(np.zeros(1_000_001, np.int32)), pa.array([1.0]))
    pq.write_table(pa.table(dict.fromkeys(("ax", "ay", "az"), ones)), tmp_path / "run.parquet")
    ran = mwdcal("calibrate", tmp_path / "run.parquet", "-o", tmp_path / "c.json")
    assert (ran.code, "at most 1000000 rows; got 1000001" in ran.err) == (2, True)


def test_a_log_has_a_limit_of_cells(tmp_path):
    pq.write_table(pa.table({"ax": pa.nulls(150_000_000, pa.bool_())}), tmp_path / "log.parquet")
    assert "at most 100000000 cells" in refusal(tmp_path / "log.parquet")


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (2**60, pa.timestamp("us"), str(2**60)),
        (5, pa.timestamp("us", "Nowhere/Bad"), "1970-01-01T00:00:00.000005"),
        (2**31 - 1, pa.date32(), str(2**31 - 1)),
    ],
)
def test_times_that_python_does_not_have(calibration, tmp_path, value, kind, text):
    pq.write_table(table(1, when=pa.array([value], kind)), tmp_path / "in.parquet")
    applied(calibration, tmp_path, tmp_path / "in.parquet")
    assert read(tmp_path / "out.csv").columns["when"] == [text]


def test_a_decimal_sign_that_is_none_is_refused_for_every_format(calibration, tmp_path):
    pq.write_table(table(), tmp_path / "in.parquet")
    ran = mwdcal("apply", calibration, tmp_path / "in.parquet", "-o", "o.csv", "--decimal", ";")
    assert (ran.code, "--decimal must be '.' or ','; got ';'." in ran.err) == (2, True)


def test_decimal_commas_part_by_part_are_those_of_a_short_table(calibration, tmp_path, monkeypatch):
    lines = ["station;ax;ay;az;note"] + [f"{i};0,1;0,3;2,9;{i},5" for i in range(50)]
    (tmp_path / "in.csv").write_text("\n".join(lines))
    for name, long in (("short.csv", {}), ("long.csv", {".csv": 0})):
        monkeypatch.setattr(correction, "TABLE_SIZES", long)
        applied(calibration, tmp_path, tmp_path / "in.csv", name, "--decimal", ",")
    short, long = (read(tmp_path / name).columns for name in ("short.csv", "long.csv"))
    assert short == long
    assert (long["ax"][7], long["note"][7]) == ("0.1", "7.5")


DEEP = "[" * 400 + "]" * 400


@pytest.mark.parametrize(
    ("text", "part"),
    [(f'name = "a"\nspread = {"[" * 20_000}{"]" * 20_000}', "nested too deeply"),
     (f'name = "a"\n[spread]\ninclination_deg = {"9" * 5000}', "more than 4300 digits")],
)  # fmt: skip
def test_profiles_that_are_nested_or_have_endless_numbers(tmp_path, text, part):
    path = tmp_path / "t.toml"
    path.write_text(text)
    for load in (load_limits, profiles.load_profile):
        with pytest.raises(InputError, match=part) as caught:
            load(str(path))
        assert "sys." not in str(caught.value)


@pytest.mark.parametrize("value", [DEEP, "{a = " * 30 + "1" + "}" * 30])
def test_nested_metadata_are_refused(value):
    with pytest.raises(InputError, match="nested at most 20 deep|must read `# key = value`"):
        metadata.parse([(1, f"# a = {value}")], "run.csv")


def test_nested_metadata_of_a_parquet_file_are_refused(tmp_path):
    described = {b"mwdcal": b'{"a": ' + b"[" * 400 + b"]" * 400 + b"}"}
    pq.write_table(table().replace_schema_metadata(described), tmp_path / "in.parquet")
    assert "metadata 'a': values must be nested at most 20 deep" in refusal(tmp_path / "in.parquet")


@pytest.mark.parametrize("digits", [30, 300])
def test_long_whole_numbers_in_metadata_become_text(tmp_path, digits):
    number = "9" * digits
    described = {b"mwdcal": f'{{"code": {number}}}'.encode()}
    pq.write_table(table().replace_schema_metadata(described), tmp_path / "in.parquet")
    assert read(tmp_path / "in.parquet").metadata == {"code": number}
    assert metadata.parse([(1, f"# code = [{number}]")], "run.csv") == {"code": [number]}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".xlsx"])
def test_pipes_are_no_tables(calibration, tmp_path, suffix):
    os.mkfifo(tmp_path / f"in{suffix}")
    ran = mwdcal("apply", calibration, tmp_path / f"in{suffix}", "-o", tmp_path / "o.csv")
    assert (ran.code, "is not a regular file" in ran.err) == (2, True)
