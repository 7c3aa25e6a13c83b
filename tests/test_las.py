"""LAS: raw channels by depth are read by their header, nothing is lost on the way out and back."""

import re
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cli_support import mwdcal
from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.exchange import description, las
from mwdcal.files.formats.table import Table, numbers, read, rendered, write
from simulation import attitude
from test_witsml import ideal_calibration, same

lasio = pytest.importorskip("lasio")
quick = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
# The sections of the example in the standard (CWLS, LAS 2.0), with the channels of a survey tool.
LAS = """\
~VERSION INFORMATION
 VERS.          2.0 :   CWLS LOG ASCII STANDARD -VERSION 2.0
 WRAP.          NO  :   ONE LINE PER DEPTH STEP
~WELL INFORMATION
 STRT  .FT      1000.0 : START DEPTH
 STOP  .FT      2000.0 : STOP DEPTH
 STEP  .FT         0.0 : STEP
 NULL  .       -999.25 : NULL VALUE
 COMP  .   ANY OIL COMPANY INC. : COMPANY
 WELL  .   AAAAA_2 : WELL
# a comment
~PARAMETER INFORMATION
 SERIAL.   77 : TOOL
 DECL  .DEG  -4.5 : DECLINATION
~CURVE INFORMATION
 DEPT  .FT     : DEPTH
 GX    .G      : ACCELEROMETER X
 GY    .G      : ACCELEROMETER Y
 GZ    .G      : ACCELEROMETER Z
 BX    .UT     : MAGNETOMETER X
 BY    .UT     : MAGNETOMETER Y
 BZ    .UT     : MAGNETOMETER Z
 TEMP  .DEGF   : TEMPERATURE
 GR    .GAPI   : GAMMA RAY
~A  DEPT GX GY GZ BX BY BZ TEMP GR
 1000.0  0.1 -0.2 0.97  20.5 -1.5 44.25 212.0 -999.25
 2000.0 -0.1  0.2 0.97 -20.5  1.5 44.25 32.0 55
"""


def put(folder, content, name="log.las"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_header_names_and_units(tmp_path):
    table = read(put(tmp_path, LAS))
    assert list(table.columns) == [
        "md_m",
        "ax",
        "ay",
        "az",
        "mx",
        "my",
        "mz",
        "temperature_c",
        "GR",
    ]
    np.testing.assert_allclose(table.columns["md_m"], [304.8, 609.6], rtol=1e-15)
    np.testing.assert_allclose(table.columns["temperature_c"], [100.0, 0.0], atol=1e-12)
    assert table.columns["mz"].tolist() == [44.25, 44.25]  # raw: as it is in the file
    assert np.isnan(table.columns["GR"][0])
    assert table.metadata == {
        "las COMP": "ANY OIL COMPANY INC.",
        "well": "AAAAA_2",
        "serial": "77",
        "las DECL (DEG)": -4.5,
        "accelerometer_unit": "g",
        "magnetometer_unit": "µT",
    }
    assert list(table.lines) == [26, 27]


def test_wrapped_values_and_other_line_ends(tmp_path):
    wrapped = LAS.replace("WRAP.          NO", "WRAP.          YES")
    for value in ("20.5", "-20.5"):
        wrapped = wrapped.replace(f"  {value}", f"\n  {value}")
    whole = read(put(tmp_path, LAS))
    for content in (wrapped, LAS.replace("\n", "\r\n"), LAS.replace("\n", "\r"), "\ufeff" + LAS):
        table = read(put(tmp_path, content))
        for name, column in whole.columns.items():
            np.testing.assert_array_equal(table.columns[name], column)


@pytest.mark.parametrize("unit", ["", "M/S", "FATHOM"])
def test_a_depth_of_unknown_unit_is_refused(tmp_path, unit):
    with pytest.raises(InputError, match=r"unit of 'DEPT' must be M or FT"):
        read(put(tmp_path, LAS.replace("DEPT  .FT", f"DEPT  .{unit}")))


def test_a_temperature_of_unknown_unit_keeps_its_name(tmp_path):
    assert "TEMP" in read(put(tmp_path, LAS.replace("TEMP  .DEGF", "TEMP  ."))).columns


def test_a_triad_is_taken_whole_or_not_at_all(tmp_path):
    table = read(put(tmp_path, LAS.replace("GZ    .G", "GT    .G")))
    assert [*table.columns][1:4] == ["GX", "GY", "GT"]
    assert "accelerometer_unit" not in table.metadata


def test_a_unit_that_may_be_two_is_not_stated(tmp_path):
    """MG may be milli-g or milligauss."""
    content = LAS.replace(".G ", ".V ").replace(".UT", ".MG")
    assert {"accelerometer_unit", "magnetometer_unit"}.isdisjoint(
        read(put(tmp_path, content)).metadata
    )


def test_a_value_that_is_no_number_is_refused_with_its_row(tmp_path):
    table = read(put(tmp_path, LAS.replace("-0.2", "1_0")))
    with pytest.raises(InputError, match=r"log\.las, line 26, column 'ay'"):
        numbers(table, "ay")


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (LAS.replace("2.0 :", "3.0 :"), "must be LAS 2.0 or 1.2"),
        (LAS.replace(" VERS.", " VARS."), "must be LAS 2.0 or 1.2"),
        (LAS.replace("~CURVE", "~KURVE"), "no section ~Curve"),
        (LAS.partition("~A")[0], "no stations"),
        (LAS.replace("-0.2", ""), "line 26: expected 9 values"),
        (LAS.replace("-0.2", "1 2"), "line 26: expected 9 values"),
        (LAS.replace("NO  :", "YES :").replace("-0.2", ""), "9 values for each depth; got 17"),
        (LAS.replace(" GY ", " GX "), "must be unique"),
        (LAS.replace("GR    .", "      ."), "must have a name"),
        (
            LAS.replace("~PARAM", "~PARAM\n" + "\n".join(f"A{k}. 1 : x" for k in range(4001))),
            "4000 lines",
        ),
        (LAS.replace("AAAAA_2", "A" * 3000), "2000 characters"),
        (LAS.replace("~PARAM", "~PARAM\n" + "X. 1 : x\n" * 3900), "at most 50 repeated mnemonics"),
        (LAS.replace("~PARAM", "~PARAM\n" + " : x\n" * 3900), "at most 50 repeated mnemonics"),
        (LAS.replace("WELL  .   AAAAA_2 : WELL", "no item"), "header of a LAS"),
        ("LASF" + "\1" * 300, "no section ~Curve"),
        (b"LASF" + bytes(300), "NUL byte"),
        (b"%PDF-1.7", "PDF"),
        ("", "no section ~Curve"),
        ("http://127.0.0.1:9/x.las", "no section ~Curve"),
        ("/etc/passwd", "no section ~Curve"),
        (
            LAS.replace(" GR ", "".join(f" C{k} . :\n" for k in range(1100)) + " GR "),
            "at most 1000 columns",
        ),
    ],
)
def test_what_is_refused_in_one_sentence(tmp_path, content, part):
    begun = time.process_time()
    with pytest.raises(InputError) as refusal:
        read(put(tmp_path, content))
    assert part in str(refusal.value)
    assert str(refusal.value).isprintable()
    assert time.process_time() - begun < 5.0


def test_nothing_is_fetched(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
    url = "http://127.0.0.1:9/x.las\n"
    assert read(put(tmp_path, url + LAS)).count == 2
    with pytest.raises(InputError):
        read(put(tmp_path, url))


def test_a_large_file_takes_bounded_memory(tmp_path):
    path = put(tmp_path, LAS + "1 " * 20_000_000)
    wide = put(tmp_path, LAS + "1 1 1 1 1 1 1 1 1\n" * 2_000_000, "wide.las")
    code = (
        "import sys\nfrom mwdcal.errors import InputError\nfrom mwdcal.files.formats.table import read\n"
        "try: read(sys.argv[1])\nexcept InputError as error: print(error)\n"
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    )
    for file in (path, wide):
        ran = subprocess.run(
            [sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True
        )
        message, peak = ran.stdout.splitlines()
        assert file.name in message
        assert int(peak) * 1024 < 1_200_000_000


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lasio", None)
    with pytest.raises(InputError, match=re.escape(extras.command("survey"))):
        read(put(tmp_path, LAS))


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8) | st.sampled_from(
    ["", " a ", "a\nb", "~A", "~Curve", "#", '"""', "\x85", "\u2028", "007", "𝔸", "\\", "\x00\x1b"]
)
words = texts.filter(lambda text: not text.strip() or text.strip("0123456789+-eE._, "))
finite = st.floats(allow_nan=False, allow_infinity=False)
NAMES = [
    "ax",
    "ay",
    "az",
    "gx_g",
    "azimuth_deg",
    "sd_field_nt",
    "temperature_c",
    "note: x.y",
    "~A",
    "é",
    "a b",
    "GX",
    "MD",
]
states = st.dictionaries(
    st.sampled_from(["code", "well", "accelerometer_unit"]) | st.text(min_size=1, max_size=8).filter(str.isprintable),
    st.sampled_from(["g", "m/s²", "A: b", "~A"]) | st.integers(-9, 9) | finite
    | st.text(max_size=9).filter(str.isprintable),
)  # fmt: skip


@st.composite
def tables(draw):
    count = draw(st.integers(1, 4))

    def column(values):
        return draw(st.lists(values, min_size=count, max_size=count))

    columns = {"md_m": np.array(column(finite))}
    for name in draw(st.lists(st.sampled_from(NAMES), unique=True)):
        columns[name] = np.array(column(finite | st.just(np.nan) | st.sampled_from(las._NULLS[:4])))
    for name in draw(st.lists(st.sampled_from(["station", "group", "serial"]), unique=True)):
        columns[name] = column(texts)
    for name in draw(st.lists(st.sampled_from(["finding", "remark"]), unique=True)):
        columns[name] = [*column(words)[1:], "x"]
    order = draw(st.permutations(list(columns)))
    return Table({name: columns[name] for name in order}, draw(states))


@quick
@given(tables())
def test_what_is_written_is_read(tmp_path, table):
    path = tmp_path / "t.las"
    write(path, table)
    same(table, read(path))
    content = path.read_bytes()
    assert content == rendered(path, table)
    assert content.isascii()


def test_other_programs_read_what_is_written(tmp_path):
    """lasio's own reader of values, which is the one of others."""
    depths = np.array([1.0 / 3.0, 100.5, 1000.1])
    columns = {"ax": np.array([0.1, np.nan, -999.25]), "md_m": depths, "station": ["a", "b", "c"]}
    path = tmp_path / "t.las"
    write(path, Table(columns, {"well": "A: 1", "serial": "X-7", "accelerometer_unit": "g"}))
    with path.open() as stream:
        file = lasio.read(stream)
    assert file.keys() == ["DEPT", "AX"]
    np.testing.assert_array_equal(file["DEPT"], depths)
    np.testing.assert_array_equal(file["AX"], columns["ax"])
    assert [curve.unit for curve in file.curves] == ["M", "g"]
    assert [file.well[n].value for n in ("STRT", "STOP", "STEP", "NULL")] == [
        depths[0],
        1000.1,
        0,
        -9999,
    ]
    assert file.well["STRT"].unit == "M"
    assert file.well["WELL"].value == "A 1"
    assert file.params["SERIAL"].value == "X-7"


@pytest.mark.parametrize(
    ("columns", "part"),
    [
        ({"ax": np.ones(1)}, "must have a measured depth"),
        ({"md_m": ["deep"], "ax": np.ones(1)}, "must have a measured depth"),
        ({"md_m": np.array([np.nan])}, "must have a measured depth"),
        ({"md_m": np.ones(1), "ax": np.array([np.inf])}, "finite"),
        ({"md_m": np.ones(1), "note": ["a\ud800b"]}, "valid Unicode"),
        ({"md_m": np.ones(5), "ax": np.array(las._NULLS)}, "blank cell"),
    ],
)
def test_what_cannot_be_written(tmp_path, columns, part):
    with pytest.raises(InputError, match=part):
        write(tmp_path / "t.las", Table(columns))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("DEPT.M", "DEPT.FT"),
        ("ax  .", "ay  ."),
        ('texts = ["station"]', "texts = []"),
        ('"a", "b"', '"a"'),
    ],
)
def test_a_file_that_was_changed_by_another_program(tmp_path, old, new):
    columns = {"md_m": np.ones(2), "ax": np.ones(2), "station": ["a", "b"]}
    content = rendered("t.las", Table(columns)).decode()
    assert old.lower() in content.lower()
    path = put(tmp_path, content.replace(old, new).replace(old.lower(), new.lower()))
    with pytest.raises(InputError, match="another program has changed"):
        read(path)


@quick
@given(st.binary(max_size=100), st.integers(0, len(LAS)))
def test_damaged_files_are_refused_or_read(tmp_path, noise, place):
    whole = LAS.encode()
    path = put(tmp_path, whole[:place] + noise + whole[place + len(noise) :])
    try:
        table = read(path)
    except InputError:
        return
    assert table.count > 0


def test_a_table_that_is_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(description, "MAX_VALUES", 10)
    with pytest.raises(InputError, match="at most 10 values"):
        read(put(tmp_path, LAS))


@pytest.mark.parametrize("suffix", [".csv", ".las", ".xml", ".parquet", ".xlsx"])
def test_apply_to_a_log_of_surveys(tmp_path, suffix):
    inc, azi, face = np.radians([[10.0, 45.0], [45.0, 120.0], [30.0, 200.0]])
    g, b = attitude(inc, azi, face)(1.0, 50_000.0, np.radians(60.0))
    header = (
        LAS.partition("~A")[0].replace(" TEMP  .DEGF   : TEMPERATURE\n", "").replace("UT", "NT")
    )
    rows = zip([1000, 2500.5], *g.T.tolist(), *b.T.tolist(), [50, 60], strict=True)
    content = header + "~A\n" + "".join(" ".join(map(repr, row)) + "\n" for row in rows)
    surveys, out = put(tmp_path, content), tmp_path / f"out{suffix}"
    ran = mwdcal("apply", ideal_calibration(tmp_path), surveys, "-o", out)
    assert ran.code == 0, ran.err
    result = read(out)
    np.testing.assert_allclose(
        np.array(result.columns["md_m"], float), [304.8, 762.1524], rtol=1e-15
    )
    for name, angle in (("inclination_deg", inc), ("azimuth_deg", azi), ("toolface_deg", face)):
        np.testing.assert_allclose(
            np.array(result.columns[name], float), np.degrees(angle), atol=1e-6
        )
    assert np.array(result.columns["GR"], float).tolist() == [50.0, 60.0]
    assert result.metadata["well"] == "AAAAA_2"
