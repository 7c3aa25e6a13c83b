"""Tables part by part: the same results, findings and refusals as when they are read whole."""

import decimal
import io
import json
import signal
import subprocess
import sys
import threading
import time
from datetime import date, datetime

import numpy as np
import pytest

from cli_support import (
    calibrated,
    channels,
    mwdcal,
    numbers,
    process,
    read_csv,
    refused,
    servo_run,
    write_csv,
)
from mwdcal.app import correction, messages
from mwdcal.app.correction import apply_to_table
from mwdcal.errors import InputError
from mwdcal.files import documents, streams
from mwdcal.files.formats import sinks, table
from mwdcal.geometry.observables import EXTRAPOLATED, RESULTS, UNCERTAINTIES
from simulation import Tool

arrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

TOOL = Tool.random(4, noise=(1e-12, 1e-7))
PARTS = {"numpy": sys.maxsize, "compiled": 0}


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """A calibration of order 1 over 0…50 °C."""
    run = servo_run(tool=TOOL, temperatures=(0.0, 50.0))
    path = calibrated(tmp_path_factory.mktemp("warm"), run, "--order", 1)
    return path, documents.read(path)


@pytest.fixture(scope="module")
def cold(tmp_path_factory):
    """A calibration without temperature terms."""
    path = calibrated(tmp_path_factory.mktemp("cold"), servo_run(tool=TOOL))
    return path, documents.read(path)


@pytest.fixture
def small_pieces(monkeypatch):
    """Every text table is long, and read in pieces of a few lines."""
    monkeypatch.setattr(correction, "TABLE_SIZES", dict.fromkeys(correction.TABLE_SIZES, 0))
    monkeypatch.setattr(streams, "PIECE", 3000)


CORRECTED = (*RESULTS, *UNCERTAINTIES)


def log(count=5000, seed=0, low=-5.0, high=55.0):
    """Columns of a log, some of it outside the calibrated temperatures, some of it vertical."""
    rng = np.random.default_rng(seed)
    inc, azi, face = np.arccos(rng.uniform(-1, 1, count)), *rng.uniform(0, 2 * np.pi, (2, count))
    inc[:3] = 0.0
    g, b = TOOL.clean(inc, azi, face)
    time_s = np.arange(count) * 0.01
    warmth = rng.uniform(low, high, count)
    return {"time_s": time_s, "temperature_c": warmth, **channels(g, b)}


def write_parquet(path, columns, metadata=None, **options):
    described = {b"mwdcal": json.dumps(metadata or {}).encode()}
    found = arrow.table(dict(columns)).replace_schema_metadata(described)
    parquet.write_table(found, path, **options)
    return path


def whole(calibration, path, outside="blank", missing="refuse"):
    """What the small path makes of the file."""
    result, _, findings = apply_to_table(calibration, table.read(path), outside, missing)
    return result, findings


def assert_same(path, wanted):
    """The file has the columns of a corrected table, input to the digit and results to 1e-12."""
    found = table.read(path)
    assert list(found.columns) == list(wanted.columns)
    assert {**found.metadata, "findings": 0} == {**wanted.metadata, "findings": 0}
    assert found.metadata.get("findings", []) == wanted.metadata.get("findings", [])
    for name in wanted.columns:
        if name == EXTRAPOLATED:
            assert found.columns[name] == [str(mark).lower() for mark in wanted.columns[name]]
        elif name in CORRECTED or not isinstance(wanted.columns[name], list):
            theirs, ours = table.numbers(wanted, name), table.numbers(found, name)
            np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs), err_msg=name)
            size = 1e5 if name.endswith("_nt") else 360.0
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-9 * size, err_msg=name)
        else:
            assert found.columns[name] == wanted.columns[name]


@pytest.mark.parametrize("least", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("group", [7, 1000, 10**6])
def test_parts_of_any_size_give_the_whole(tmp_path, warm, least, group):
    made = warm[1]
    metadata = {"serial": "X1", "note": "täst"}
    source = write_parquet(tmp_path / "log.parquet", log(), metadata, row_group_size=group)
    wanted, findings = whole(made, source)
    out = tmp_path / "out.parquet"
    seen = []
    told = correction.apply_to_file(
        made, source, out, "blank", lambda *done: seen.append(done), rows=321, least=least
    )
    assert (told[0].rows, told[1]) == (5000, findings)
    assert [f.id for f in findings] == ["no-serial", "outside-temperature"]
    assert seen[-1] == (5000, 5000)
    assert_same(out, wanted)
    assert out.stat().st_size < 2 * 5000 * 8 * 28 + 50_000
    assert parquet.read_table(out).schema.metadata[b"mwdcal"]  # for readers that are not ours


@pytest.mark.parametrize("outside", ["extrapolate", "refuse"])
@pytest.mark.parametrize("least", PARTS.values(), ids=PARTS)
def test_rows_outside_the_temperatures(tmp_path, warm, outside, least):
    source, out = write_parquet(tmp_path / "log.parquet", log()), tmp_path / "out.parquet"
    arguments = (warm[1], source, out, outside)
    if outside == "refuse":
        with pytest.raises(InputError) as wanted:
            whole(warm[1], source, outside)
        with pytest.raises(InputError) as found:
            correction.apply_to_file(*arguments, rows=300, least=least)
        assert str(found.value) == str(wanted.value)
        assert [f.name for f in tmp_path.iterdir()] == ["log.parquet"]
    else:
        correction.apply_to_file(*arguments, rows=300, least=least)
        assert_same(out, whole(warm[1], source, outside)[0])


def test_columns_of_every_type_are_carried_through(tmp_path, cold):
    columns = log(600, low=10, high=40)
    strings = arrow.array([None if i % 5 == 0 else f"S {i}" for i in range(600)])
    kinds = {
        "ax": arrow.array(columns["ax"], arrow.float32()),
        "az": arrow.array([decimal.Decimal(f"{v:.6f}") for v in columns["az"]]),
        "my": arrow.array([f"{v:.9e}" for v in columns["my"]]),
        "mz": arrow.array(columns["mz"], arrow.float64()).dictionary_encode(),
        "temperature_c": arrow.array(columns["temperature_c"].astype(int), arrow.int16()),
        "count": arrow.array(2**60 + np.arange(600)),
        "depth": arrow.array([None, 1.5] * 300),
        "place": strings.dictionary_encode(),
        "label": strings,
        "when": arrow.array([datetime(2026, 1, 2, 3, 4, 5)] * 600),
        "good": arrow.array([True, None, False] * 200),
        "list.of": arrow.array([[1, 2], []] * 300),
        "none": arrow.nulls(600),
    }
    columns = {**{k: arrow.array(v) for k, v in columns.items()}, **kinds}
    source = write_parquet(tmp_path / "log.parquet", columns, row_group_size=100)
    for least in PARTS.values():
        out = tmp_path / "out.parquet"
        correction.apply_to_file(cold[1], source, out, "blank", rows=64, least=least)
        before, after = parquet.read_table(source), parquet.read_table(out)
        assert after.schema.names == [*columns, *CORRECTED]
        for name in columns:
            assert after.schema.field(name).type == before.schema.field(name).type
            assert after.column(name).to_pylist() == before.column(name).to_pylist()
        wanted, _ = whole(cold[1], source)
        for name in CORRECTED:
            np.testing.assert_allclose(after[name].to_numpy(), wanted.columns[name], atol=1e-6)
    text = tmp_path / "out.csv"
    correction.apply_to_file(cold[1], source, text, "blank", rows=64)
    table.write(tmp_path / "whole.csv", wanted)
    ours, theirs = (read_csv(p) for p in (text, tmp_path / "whole.csv"))
    for name in ("label", "place", "when", "good", "none"):
        assert ours[name] == theirs[name]
    assert ours["count"][1] == str(2**60 + 1)


def carried(count):
    """Columns of every type that a user's own columns may have, some cells null."""
    holes = np.arange(count) % 3 == 1
    ids = 2**60 + 1 + np.arange(count)
    steps = arrow.array(np.arange(count) * 10**9 + 7)
    texts = [("", "007", "1e5", None, "x")[i % 5] for i in range(count)]
    return {
        "id": arrow.array(ids),
        "serial": arrow.array(ids.astype("u8") + 2**63),
        "flag": arrow.array(holes, mask=~holes),
        "count": arrow.array(np.arange(count, dtype="i4"), mask=holes),
        "single": arrow.array(np.arange(count, dtype="f4") / 10, mask=holes),
        "price": arrow.array([decimal.Decimal("1.10")] * count, arrow.decimal128(9, 2)),
        "when": steps.cast(arrow.timestamp("ns", "Europe/Oslo")),
        "day": arrow.array([date(2026, 1, 2)] * count),
        "note": arrow.array(texts),
        "long": arrow.array(texts, arrow.large_string()),
        "lot": arrow.array(texts).dictionary_encode(),
        "bytes": arrow.array([b"\xff\x00", None, b""] * count, arrow.binary())[:count],
        "list": arrow.array([[1, None], [], None] * count)[:count],
        "record": arrow.array([{"a": 1, "b": ["x"]}] * count),
        "none": arrow.nulls(count),
    }


@pytest.mark.parametrize("count", [1, 5, 1000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_what_is_carried_along_is_untouched_at_any_length(tmp_path, cold, count):
    own = carried(count)
    schema = arrow.schema([arrow.field(n, c.type, nullable=n != "id") for n, c in own.items()])
    columns = {**own, **{k: arrow.array(v) for k, v in log(count, low=10, high=40).items()}}
    schema = arrow.schema([*schema, *((n, arrow.float64()) for n in log(1))])
    parquet.write_table(arrow.table(columns, schema=schema), tmp_path / "log.parquet")
    before = parquet.read_table(tmp_path / "log.parquet")
    for decimal_sign in ".,":
        options = ("-o", tmp_path / "out.parquet", "--decimal", decimal_sign)
        assert mwdcal("apply", cold[0], tmp_path / "log.parquet", *options).code == 0
        after = parquet.read_table(tmp_path / "out.parquet").select(before.column_names)
        assert after.schema.equals(before.schema)
        assert after.equals(before)


def test_a_short_table_that_becomes_text_keeps_every_digit(tmp_path, cold):
    columns = {"id": arrow.array(2**60 + np.arange(4)), **log(4, low=10, high=40)}
    source = write_parquet(tmp_path / "log.parquet", columns, {"serial": "X1"})
    assert mwdcal("apply", cold[0], source, "-o", tmp_path / "out.csv").code == 0
    assert read_csv(tmp_path / "out.csv")["id"] == [str(2**60 + i) for i in range(4)]
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert all(line.rstrip("# ") for line in lines)  # no room is left where nothing is told


def test_nanoseconds_become_text(tmp_path, cold):
    when = arrow.array([1, 1_000_000_000, None], arrow.int64())
    zones = {"when": None, "there": "UTC"}
    times = {name: when.cast(arrow.timestamp("ns", zone)) for name, zone in zones.items()}
    source = write_parquet(tmp_path / "log.parquet", {**times, **log(3, low=10, high=40)})
    for out in ("out.csv", "out.xlsx"):
        assert mwdcal("apply", cold[0], source, "-o", tmp_path / out).code == 0
        found = table.read(tmp_path / out).columns
        assert found["when"] == [
            "1970-01-01T00:00:00.000000001",
            "1970-01-01T00:00:01.000000000",
            "",
        ]
        assert [cell.removesuffix("Z") for cell in found["there"]] == found["when"]


def gappy(count, holes):
    """A log with blank cells: of each column some rows; and which rows are whole."""
    columns, sound = log(count), np.ones(count, bool)
    for name, rows in holes.items():
        columns[name] = columns[name].copy()
        columns[name][rows] = np.nan
        sound[rows] = False
    return columns, sound


HOLES = {
    "here and there": {"ax": [5, 280, 281], "mz": [281, 800], "temperature_c": [0, 1199]},
    "a whole part": {"my": slice(400, 600)},
    "the first part": {"mx": slice(0, 240), "my": slice(0, 240), "mz": slice(0, 240)},
    "its temperatures": {"temperature_c": slice(0, 240)},
}


@pytest.mark.parametrize(
    ("outside", "least", "suffix"),
    [
        ("blank", "numpy", ".parquet"),
        ("blank", "compiled", ".csv"),
        ("extrapolate", "numpy", ".csv"),
        ("extrapolate", "compiled", ".parquet"),
    ],
)
@pytest.mark.parametrize("holes", HOLES.values(), ids=HOLES)
def test_rows_that_lack_a_reading(tmp_path, warm, small_pieces, holes, outside, least, suffix):
    """Every two of the ways together; more than two have no rule of their own."""
    columns, sound = gappy(1200, holes)
    source = (write_parquet if suffix == ".parquet" else write_csv)(
        tmp_path / f"l{suffix}", columns
    )
    out, options = tmp_path / f"out{suffix}", {"rows": 200, "least": PARTS[least]}
    with pytest.raises(InputError, match="blank"):
        correction.apply_to_file(warm[1], source, out, outside, **options)
    told = correction.apply_to_file(warm[1], source, out, outside, missing="blank", **options)
    wanted, findings = whole(warm[1], source, outside, "blank")
    assert (told[0].rows, told[1]) == (1200, findings)
    assert_same(out, wanted)
    text = f"{(~sound).sum()} of 1200 rows lack a reading: their results are blank."
    assert text in [finding.text for finding in findings]
    # the rest is what it is without the others
    alone = {name: values[sound] for name, values in columns.items()}
    rest, _ = whole(warm[1], write_csv(tmp_path / "rest.csv", alone), outside)
    hot = (alone["temperature_c"] < -1) | (alone["temperature_c"] > 51)
    for name in RESULTS:
        found = table.numbers(wanted, name)
        assert np.isnan(found[~sound]).all()
        np.testing.assert_array_equal(found[sound], rest.columns[name])
        assert np.isnan(found[sound][hot]).all() == (outside == "blank")
    if outside == "extrapolate":
        np.testing.assert_array_equal(wanted.columns[EXTRAPOLATED][sound], hot)
        assert not wanted.columns[EXTRAPOLATED][~sound].any()


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".xlsx"])
def test_missing_readings_by_the_command(tmp_path, cold, suffix):
    columns, sound = gappy(40, {"ay": [3], "mx": [3, 8]})
    text = write_csv(tmp_path / "log.csv", columns)
    source = tmp_path / f"log{suffix}"
    if suffix != ".csv":
        table.write(source, table.read(text))
    command = ("apply", cold[0], source, "-o", tmp_path / "out.csv")
    assert "column 'ay': must be filled in; got a blank cell." in refused(mwdcal(*command), 2)
    ran = mwdcal(*command, "--missing", "blank", "--outside", "extrapolate", "--json")
    assert [f["id"] for f in ran.json["findings"]] == [
        *("no-serial", "missing-reading", "outside-temperature"),
    ]
    found = read_csv(tmp_path / "out.csv")
    np.testing.assert_array_equal(np.isnan(numbers(found["gz_g"])), ~sound)
    assert list(found)[-2:] == ["sd_magnetic_toolface_deg", "extrapolated"]
    low, high = cold[1].temperature_c
    beyond = 5.0  # °C: an order of 0 holds for its soak
    warmth = columns["temperature_c"]
    hot = (warmth < low - beyond) | (warmth > high + beyond)
    assert found["extrapolated"] == [str(mark).lower() for mark in hot & sound]


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_what_is_wrong_is_not_missing(tmp_path, warm, small_pieces, suffix):
    columns, _ = gappy(3000, {"ax": [2500, 2510]})
    columns["az"][2600] = np.inf if suffix == ".parquet" else 1e300
    write = write_parquet if suffix == ".parquet" else write_csv
    source, out = write(tmp_path / f"log{suffix}", columns), tmp_path / "out.parquet"
    with pytest.raises(InputError) as found:
        correction.apply_to_file(warm[1], source, out, "blank", rows=500, missing="blank")
    with pytest.raises(InputError) as wanted:
        whole(warm[1], source, "blank", "blank")
    assert str(found.value) == str(wanted.value)
    assert "column 'az'" in str(found.value)


def test_where_every_row_lacks_a_reading_nothing_is_written(tmp_path, warm):
    columns, _ = gappy(30, {"ax": slice(0, 20), "mz": slice(20, 30)})
    for source in (
        write_csv(tmp_path / "log.csv", columns),
        write_parquet(tmp_path / "log.parquet", columns),
    ):
        out = tmp_path / "out.csv"
        message = refused(mwdcal("apply", warm[0], source, "-o", out, "--missing", "blank"), 2)
        assert "every row lacks a reading" in message
        assert not out.exists()


def test_wholly_blank_columns_are_absent_and_not_missing(tmp_path, cold):
    names = ("mx", "my", "mz", "temperature_c")
    columns, _ = gappy(3000, dict.fromkeys(names, slice(0, 3000)))
    source, out = write_parquet(tmp_path / "log.parquet", columns), tmp_path / "out.parquet"
    ran = mwdcal("apply", cold[0], source, "-o", out, "--missing", "blank", "--json")
    ids = [f["id"] for f in ran.json["findings"]]
    assert ids == ["no-serial", "no-magnetometer", "temperature-unknown"]
    assert_same(out, whole(cold[1], source)[0])


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
def test_marks_are_truth_values_where_the_format_has_them(tmp_path, warm, suffix):
    out = tmp_path / "out.parquet"
    text = write_csv(tmp_path / "log.csv", log(50))
    source = tmp_path / f"log{suffix}"
    table.write(source, table.read(text))
    assert mwdcal("apply", warm[0], source, "-o", out, "--outside", "extrapolate").code == 0
    column = parquet.read_table(out)[EXTRAPOLATED]
    assert column.type == arrow.bool_()
    assert 0 < sum(column.to_pylist()) < 50
    taken = mwdcal("apply", warm[0], source, "-o", tmp_path / "b.csv")
    assert taken.code == 0
    write_csv(tmp_path / "taken.csv", {**log(5), EXTRAPOLATED: ["no"] * 5})
    again = ("apply", warm[0], tmp_path / "taken.csv", "-o", out)
    assert mwdcal(*again).code == 0
    message = refused(mwdcal(*again, "--outside", "extrapolate"), 2)
    assert "the column 'extrapolated' is there already" in message


def test_the_index_of_pandas_is_left_out(tmp_path, cold):
    source = write_parquet(tmp_path / "l.parquet", {**log(50), "__index_level_0__": np.arange(50)})
    correction.apply_to_file(cold[1], source, tmp_path / "out.parquet", "blank")
    assert "__index_level_0__" not in parquet.read_schema(tmp_path / "out.parquet").names


def spoilt(column, row, value, count=80_000):
    columns = log(count, low=10, high=40)
    columns[column][row] = value
    return columns


WRONG = {
    "blank reading": ("ax", 70_000, np.nan),
    "endless reading": ("mz", 70_000, np.inf),
    "huge reading": ("ay", 70_000, 1e300),
    "blank temperature": ("temperature_c", 70_000, np.nan),
    "impossible temperature": ("temperature_c", 70_000, -400.0),
}


@pytest.mark.parametrize("least", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_one_wrong_cell_far_down_is_named_and_nothing_is_left(tmp_path, warm, wrong, least):
    source = write_parquet(tmp_path / "log.parquet", spoilt(*wrong))
    with pytest.raises(InputError) as wanted:
        whole(warm[1], source)
    out = tmp_path / "out.parquet"
    out.write_bytes(b"old")
    with pytest.raises(InputError) as found:
        correction.apply_to_file(warm[1], source, out, "blank", least=least)
    assert str(found.value) == str(wanted.value)
    assert f"row 70001, column '{wrong[0]}'" in str(found.value)
    assert out.read_bytes() == b"old"
    assert {f.name for f in tmp_path.iterdir()} == {"log.parquet", "out.parquet"}


@pytest.mark.parametrize("names", [("mx", "my", "mz"), ("temperature_c",)], ids=lambda n: n[0])
@pytest.mark.parametrize("how", ["all", "beginning", "end"])
def test_columns_that_are_blank_for_a_while(tmp_path, cold, names, how):
    columns = log(3000, low=10, high=40)
    rows = {"all": slice(None), "beginning": slice(0, 2000), "end": slice(2000, None)}[how]
    for name in names:
        columns[name][rows] = np.nan
    source = write_parquet(tmp_path / "log.parquet", columns)
    out = tmp_path / "out.parquet"
    for least in PARTS.values():
        if how == "all":
            told = correction.apply_to_file(cold[1], source, out, "blank", rows=500, least=least)
            assert told[1] == whole(cold[1], source)[1]
            assert_same(out, whole(cold[1], source)[0])
        else:
            with pytest.raises(InputError) as wanted:
                whole(cold[1], source)
            with pytest.raises(InputError) as found:
                correction.apply_to_file(cold[1], source, out, "blank", rows=500, least=least)
            assert str(found.value) == str(wanted.value)


@pytest.mark.parametrize(("column", "value"), [("ref_dip_deg", 200.0), ("sd_ax", -1.0)])
def test_references_are_checked_too(tmp_path, cold, column, value):
    columns = log(3000, low=10, high=40)
    columns[column] = np.full(3000, 0.5)
    columns[column][2500] = value
    source = write_parquet(tmp_path / "log.parquet", columns)
    with pytest.raises(InputError) as wanted:
        whole(cold[1], source)
    with pytest.raises(InputError) as found:
        correction.apply_to_file(cold[1], source, tmp_path / "o.parquet", "blank", rows=500)
    assert str(found.value) == str(wanted.value)


REFUSED = {
    "no temperature": lambda c: c.pop("temperature_c"),
    "half a magnetometer": lambda c: c.pop("my"),
    "no ax": lambda c: c.pop("ax"),
    "near miss": lambda c: c.update(Temperature=c.pop("temperature_c")),
    "taken": lambda c: c.update(dip_deg=c["ax"]),
}


@pytest.mark.parametrize("change", REFUSED.values(), ids=REFUSED)
@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_headers_that_are_refused(tmp_path, warm, small_pieces, change, suffix):
    columns = log(50)
    change(columns)
    source = tmp_path / f"log{suffix}"
    (write_parquet if suffix == ".parquet" else write_csv)(source, columns)
    with pytest.raises(InputError) as wanted:
        whole(warm[1], source)
    out = tmp_path / "out.csv"
    assert refused(mwdcal("apply", warm[0], source, "-o", out), 2) == f"mwdcal: {wanted.value}"
    assert not out.exists()


def test_files_that_cannot_be_read_or_written(tmp_path, warm, small_pieces):
    source = write_parquet(tmp_path / "log.parquet", log(50))
    before = source.read_bytes()
    for out in (source, warm[0], tmp_path / "no" / "out.parquet", tmp_path):
        refused(mwdcal("apply", warm[0], source, "-o", out), 2)
    (tmp_path / "cut.parquet").write_bytes(before[:-100])
    (tmp_path / "torn.parquet").write_bytes(before[:20] + bytes(2000) + before[2020:])
    write_parquet(tmp_path / "empty.parquet", log(50) and {k: v[:0] for k, v in log(50).items()})
    for name in ("cut", "torn", "empty"):
        out = tmp_path / "out.parquet"
        refused(mwdcal("apply", warm[0], tmp_path / f"{name}.parquet", "-o", out), 2)
        assert not out.exists()
    assert source.read_bytes() == before


@pytest.mark.parametrize("when", ["write", "finish"])
def test_interrupted_it_leaves_the_old_file(tmp_path, warm, monkeypatch, small_pieces, when):
    source, out = write_parquet(tmp_path / "log.parquet", log()), tmp_path / "out.parquet"
    out.write_bytes(b"old")

    def interrupt(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(correction.ParquetSink, when, interrupt)
    assert mwdcal("apply", warm[0], source, "-o", out).code == 130
    assert out.read_bytes() == b"old"
    assert {f.name for f in tmp_path.iterdir()} == {"log.parquet", "out.parquet"}


def caught_writing(folder, calibration):
    """A process that applies `log.parquet` and sleeps before it writes the first part.

    In many short sleeps: a signal that comes just before one does not wake from it.
    """
    slow = (
        f"import sys, time, {correction.__name__} as streaming\nfrom mwdcal.app.cli import main\n"
        "def write(*given):\n    print('writing', flush=True)\n"
        "    for _ in range(2000):\n        time.sleep(0.01)\n"
        "streaming.ParquetSink.write = write\nmain(sys.argv[1:])\n"
    )
    names = [str(folder / name) for name in ("log.parquet", "out.parquet")]
    command = [sys.executable, "-c", slow, "apply", str(calibration), names[0], "-o", names[1]]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "writing\n"
    return child


ENDED = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminated"}


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize(("name", "word"), ENDED.items())
def test_ended_in_the_middle_of_a_long_table(tmp_path, warm, name, word):
    number = getattr(signal, name)
    write_parquet(tmp_path / "log.parquet", log(70_000))
    child = caught_writing(tmp_path, warm[0])
    child.send_signal(number)
    _, err = child.communicate(timeout=30)
    assert child.returncode == 128 + number
    assert err.strip() == f"mwdcal: {word}. Files are as they were before."
    assert [f.name for f in tmp_path.iterdir()] == ["log.parquet"]


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_what_a_killed_command_left_is_removed_by_the_next_one(tmp_path, warm):
    write_parquet(tmp_path / "log.parquet", log(250))
    killed, alive = (caught_writing(tmp_path, warm[0]) for _ in range(2))
    killed.kill()
    killed.communicate()
    assert len(list(tmp_path.glob(".mwdcal-*.tmp"))) == 2
    done = process("apply", warm[0], tmp_path / "log.parquet", "-o", tmp_path / "new.parquet")
    assert done.returncode == 0, done
    (left,) = tmp_path.glob(".mwdcal-*.tmp")
    alive.terminate()
    alive.communicate(timeout=30)
    assert not left.exists()


TEXTS = {
    "plain": lambda s: s,
    "carriage returns": lambda s: s.replace("\n", "\r\n"),
    "old Macintosh": lambda s: s.replace("\n", "\r"),
    "no last line end": lambda s: s.rstrip("\n"),
    "byte order mark": lambda s: "\ufeff" + s,
    "quotes": lambda s: s.replace("S 77,", '"S, ""77""",'),
    "blanks before cells": lambda s: s.replace("S 77,", "S 77,   "),
    "blank before a line": lambda s: s.replace("S 77,", "  S 77,"),
    "blank rows": lambda s: s.replace("S 77,", ",,,,,,,,\n\nS 77,") + "\n,,,,,,,,\n",
    "semicolons": lambda s: s.replace(",", ";"),
    "cells with the other delimiter": lambda s: s.replace(",", ";").replace("S 77;", "S, 77;"),
    "no cell in the first column": lambda s: s.replace("S 77,", ","),
    "signs and blanks": lambda s: s.replace("S 77,0.77,", "S 77,+7.7e-1 ,"),
}


def text(folder, change=lambda s: s, count=120):
    """A text table, written by the standard library and then changed."""
    columns = {"station": [f"S {i}" for i in range(count)], **log(count)}
    path = write_csv(folder / "log.csv", columns, 'serial = "A 7"', "note = 1.5")
    path.write_bytes(change(path.read_text("utf-8")).encode())
    return path


@pytest.mark.parametrize("least", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("change", TEXTS.values(), ids=TEXTS)
@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet"])
def test_text_in_pieces_gives_the_whole(tmp_path, warm, small_pieces, change, suffix, least):
    source, out = text(tmp_path, change), tmp_path / f"out{suffix}"
    wanted, findings = whole(warm[1], source)
    told = correction.apply_to_file(warm[1], source, out, "blank", least=least)
    assert (told[0].rows, told[1]) == (120, findings)
    table.write(tmp_path / f"whole{suffix}", wanted)
    found = table.read(out)
    for name, cells in table.read(tmp_path / f"whole{suffix}").columns.items():
        if name in ("station", "time_s") or (name in wanted.columns and name not in CORRECTED):
            ours = found.columns[name]
            if isinstance(ours, list) == isinstance(cells, list):
                np.testing.assert_array_equal(ours, cells)
    if suffix != ".parquet":
        assert_same(out, wanted)


def line(number, old, new):
    def change(content):
        lines = content.split("\n")
        lines[number - 1] = lines[number - 1].replace(old, new, 1)
        return "\n".join(lines)

    return change


BAD_TEXTS = {
    "word": line(80, ",0.7", ",x0.7"),
    "reading is a word": line(80, "S 76,0.76,", "S 76,0.76,hot,"),
    "nan": line(80, "S 76,0.76,", "S 76,0.76,nan,"),
    "decimal comma": line(80, "S 76,0.76,", 'S 76,0.76,"1,5",'),
    "ragged": line(80, "S 76,0.76,", "S 76,0.76,1,"),
    "short": line(80, "S 76,0.76,", "S 76,"),
    "comment": line(80, "S 76", "# S 76"),
    "NUL": line(80, "S 76", "S\0 76"),
    "open quote": line(80, "S 76", '"S 76'),
    "blank cell": lambda s: s.replace("\n", "\n\n") + "1,1,1,,1,1,1,1,1\n",
    "quote": line(80, "S 76", 'S "76"'),
}


@pytest.mark.parametrize("least", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("change", BAD_TEXTS.values(), ids=BAD_TEXTS)
def test_text_that_is_refused_is_refused_alike(tmp_path, warm, small_pieces, change, least):
    source = text(tmp_path, change)
    outcomes = []
    for run in (
        lambda: whole(warm[1], source),
        lambda: correction.apply_to_file(warm[1], source, tmp_path / "o.csv", "blank", least=least),
    ):
        try:
            run()
            outcomes.append("accepted")
        except InputError as error:
            outcomes.append(str(error))
    assert outcomes[0] == outcomes[1]
    assert (tmp_path / "o.csv").exists() == (outcomes[0] == "accepted")
    assert not list(tmp_path.glob(".mwdcal-*"))


def test_a_byte_that_is_no_text_is_named_with_its_line(tmp_path, warm, small_pieces):
    source = text(tmp_path)
    lines = source.read_bytes().split(b"\n")
    lines[79] = b"\xb0" + lines[79]
    source.write_bytes(b"\n".join(lines))
    message = refused(mwdcal("apply", warm[0], source, "-o", tmp_path / "o.csv"), 2)
    assert "log.csv, line 80: expected UTF-8 text; got byte 0xB0" in message


def test_text_without_stations_and_without_lines(tmp_path, warm, small_pieces):
    header = ",".join(log(1))
    source = tmp_path / "log.csv"
    for content in ("", "\n\n", header, f"{header}\n\n,,,,,,,\n", header + "\n" + "\n" * 9000):
        source.write_text(content)
        refused(mwdcal("apply", warm[0], source, "-o", tmp_path / "o.csv"), 2)
    source.write_text(header + "\n" + "1," * 3_000_000)
    refused(mwdcal("apply", warm[0], source, "-o", tmp_path / "o.csv"), 2)
    assert not (tmp_path / "o.csv").exists()


def test_findings_of_a_long_text_table_stand_above_its_header(tmp_path, small_pieces):
    run = servo_run(tool=TOOL)
    del run["ref_toolface_deg"]
    calibration = calibrated(tmp_path, run)
    source = write_csv(tmp_path / "log.csv", {k: v for k, v in log().items() if k[0] != "m"})
    ran = mwdcal("apply", calibration, source, "-o", tmp_path / "out.csv", "--json")
    assert [f["id"] for f in ran.json["findings"]] == [
        *("no-serial", "no-magnetometer", "outside-temperature", "undetermined"),
    ]
    found = table.read(tmp_path / "out.csv")
    assert found.metadata["findings"] == [f["text"] for f in ran.json["findings"]]
    assert list(found.columns)[-20:] == list(CORRECTED)


@pytest.mark.parametrize("count", [5, 5000])
@pytest.mark.parametrize("low", [10.0, -30.0])
def test_a_corrected_table_has_one_line_of_findings(tmp_path, warm, small_pieces, count, low):
    columns = log(count, low=low, high=low + 20)
    source = write_parquet(tmp_path / "log.parquet", columns, {"findings": ["old"], "lab": "B"})
    ran = mwdcal("apply", warm[0], source, "-o", tmp_path / "out.csv", "--json")
    written = (tmp_path / "out.csv").read_text().splitlines()
    assert sum(line.startswith("# findings = ") for line in written) == 1
    said = [finding["text"] for finding in ran.json["findings"]]
    assert [text for text in said if "no serial" in text] == said[:1]
    assert (said[1:] == []) == (low == 10.0)
    found = table.read(tmp_path / "out.csv").metadata
    assert (found["findings"], found["lab"]) == (["old", *said], "B")
    assert_same(tmp_path / "out.csv", whole(warm[1], source)[0])


def test_parquet_and_long_text_are_taken_in_parts_where_the_formats_allow_it(tmp_path, monkeypatch):
    short = write_csv(tmp_path / "a.csv", log(50))
    packed = write_parquet(tmp_path / "a.parquet", log(1))
    assert not correction.in_parts(short, tmp_path / "o.csv")
    assert correction.in_parts(packed, tmp_path / "o.csv")
    monkeypatch.setattr(correction, "TABLE_SIZES", dict.fromkeys(correction.TABLE_SIZES, 100))
    for source in (short, packed):
        assert correction.in_parts(source, tmp_path / "o.csv")
        assert not correction.in_parts(source, tmp_path / "o.xlsx")
    assert not correction.in_parts(tmp_path / "none.parquet", tmp_path / "o.csv")
    assert not correction.in_parts(tmp_path, tmp_path / "o.csv")
    monkeypatch.setattr(streams, "find_spec", lambda name: None)  # without PyArrow
    assert not correction.in_parts(short, tmp_path / "o.csv")


def test_work_overlaps_keeps_its_order_and_stops_at_an_error():
    taken, alive = [], []

    def items():
        for i in range(50):
            taken.append(i)
            yield i

    def work(i):
        alive.append(i)
        time.sleep(0.001 * (i % 3))
        if i == 30:
            raise InputError("thirty")
        return i * i

    found = []
    with pytest.raises(InputError, match="thirty"):
        found.extend(correction.overlapped(items(), work))
    assert found == [] or found == [i * i for i in range(30)]
    assert max(taken) < 45
    stopped = correction.overlapped(items(), work)
    assert [next(stopped), next(stopped)] == [0, 1]
    stopped.close()


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "patience", "seen"), [
    (Terminal, 0.0, True), (Terminal, 60.0, False), (io.StringIO, 0.0, False),
])  # fmt: skip
def test_progress_is_shown_on_a_terminal_and_only_to_the_patient(
    monkeypatch, stream, patience, seen
):
    monkeypatch.setattr(messages, "PATIENCE", patience)
    monkeypatch.setattr(sys, "stderr", shown := stream())
    limit, before = time.monotonic() + 20, {*threading.enumerate()}
    with messages.bar("correcting") as advance:  # nothing is told, as while a workbook is written
        while seen and "correcting" not in shown.getvalue() and time.monotonic() < limit:
            time.sleep(0.01)
        advance(2, 4)
    assert ("correcting" in shown.getvalue()) == seen
    assert ("50%" in shown.getvalue()) == seen
    assert all(thread.daemon for thread in {*threading.enumerate()} - before)


@pytest.mark.parametrize("patience", [0.0, 60.0])
def test_without_a_terminal_a_line_says_what_is_being_done(monkeypatch, patience):
    monkeypatch.setattr(messages, "LINE_AFTER", patience)
    monkeypatch.setattr(sys, "stderr", shown := io.StringIO())
    limit = time.monotonic() + 20
    with messages.bar("planning") as advance:
        advance(1, 4)
        while not patience and not shown.getvalue() and time.monotonic() < limit:
            time.sleep(0.01)
    assert shown.getvalue().startswith("planning") == (not patience)
    assert shown.getvalue().count("\n") == (not patience)


def test_progress_begins_with_what_was_told_before_it_was_seen(monkeypatch):
    monkeypatch.setattr(messages, "PATIENCE", 0.1)
    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    limit = time.monotonic() + 20
    with messages.bar("correcting") as advance:
        advance(2, 4)
        while "50%" not in shown.getvalue() and time.monotonic() < limit:
            time.sleep(0.01)
        assert "50%" in shown.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "most"), [(6, 0.4e9), pytest.param(12, 0.6e9, marks=pytest.mark.study)]
)
def test_memory_does_not_grow_with_the_table(tmp_path, warm, parts, most):
    """The corrected table alone would take 0.35e9 bytes, or 0.7e9; the larger one meets the compiled loops."""
    resource = pytest.importorskip("resource")
    part = arrow.table(log(250_000, low=10, high=40))
    with parquet.ParquetWriter(tmp_path / "log.parquet", part.schema) as writer:
        for _ in range(parts):
            writer.write_table(part)
    # from a small process: the peak of a command begins with the size of who starts it
    launch = (
        "import resource, subprocess, sys\nsubprocess.run(sys.argv[1:], check=True)\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)\n"
    )
    out = tmp_path / "out.parquet"
    mwdcal = [sys.executable, "-m", "mwdcal"]
    arguments = ["apply", str(warm[0]), str(tmp_path / "log.parquet"), "-o", str(out)]
    done = subprocess.run(
        [sys.executable, "-c", launch, *mwdcal, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    assert parquet.read_metadata(out).num_rows == parts * part.num_rows
    unit = 1 if sys.platform == "darwin" else 1024
    peak = int(done.stderr.split()[-1]) * unit
    assert peak < most
    assert resource is not None


QUOTED = {3: 'say "x"', 57: "a, b", 58: "tab\there", 119: 'end "'}


@pytest.fixture
def exact(monkeypatch):
    """Numbers of rows that went through the exact parser, and through the writer of short tables."""
    seen = {"rows": 0, "render": 0}
    rows, render = streams.text.rows, streams.text.render

    def counted_rows(data, *others):
        seen["rows"] += data.count(b"\n")
        return rows(data, *others)

    def counted_render(columns, *others):
        seen["render"] += len(next(iter(columns.values())))
        return render(columns, *others)

    monkeypatch.setattr(streams.text, "rows", counted_rows)
    monkeypatch.setattr(streams.text, "render", counted_render)
    return seen


@pytest.mark.parametrize("delimiter", [",", "\t"])
@pytest.mark.parametrize("remarks", [QUOTED, dict.fromkeys(range(120), 'all ",\t'), {}])
def test_rows_that_need_quotes_are_written_as_a_short_table_has_them(exact, delimiter, remarks):
    count = 120
    texts = [remarks.get(i, "" if i % 7 else "plain") for i in range(count)]
    values = np.random.default_rng(0).uniform(1, 100, count)
    values[::11] = np.nan
    own = {"note": texts, "id": [str(i) for i in range(count)], "x": values.tolist()}
    carried_along = arrow.table(
        {"note": [t or None for t in texts], "id": np.arange(count), "x": values}
    )
    schema = arrow.schema([("r", arrow.float64()), (EXTRAPOLATED, arrow.bool_())])
    stream = io.BytesIO()
    stream.name = "out.csv"
    sink = sinks.TextSink(stream, carried_along.schema, schema, {}, [], delimiter)
    sink.write(sink.render(carried_along, [values, values > 50], True))
    sink.finish([])
    needed = sum(any(mark in text for mark in ('"', delimiter)) for text in texts)
    assert exact["render"] == needed  # before the next line renders the whole
    marks = [str(mark).lower() for mark in values > 50]
    whole_table = {**own, "x": values, "r": values, EXTRAPOLATED: marks}
    assert stream.getvalue().decode() == streams.text.render(whole_table, {}, delimiter)


def test_only_unusual_lines_go_through_the_exact_parser(tmp_path, warm, small_pieces, exact):
    def change(content):
        return content.replace("S 77,", '"S, ""77""",').replace("\nS 40,", "\n S 40,  ")

    source = text(tmp_path, change)
    wanted, findings = whole(warm[1], source)
    tally, said = correction.apply_to_file(warm[1], source, tmp_path / "o.csv", "blank")
    assert (tally.rows, said) == (120, findings)
    assert exact["rows"] == 2
    assert_same(tmp_path / "o.csv", wanted)
    assert table.read(tmp_path / "o.csv").columns["station"][77] == 'S, "77"'


def test_a_row_is_spelled_alike_whatever_stands_beside_it(tmp_path, cold):
    found = []
    for word in ("plain", "a, b"):
        columns = {"note": ["", word, ""], "tiny": [5e-5, -3e-7, 2e20], **log(3, low=10, high=40)}
        source = write_parquet(tmp_path / "log.parquet", columns)
        correction.apply_to_file(cold[1], source, tmp_path / "out.csv", "extrapolate")
        found.append((tmp_path / "out.csv").read_text("utf-8").replace('"a, b"', "plain"))
    assert found[0] == found[1]


def test_findings_are_in_the_schema_that_readers_take(tmp_path, warm):
    source = write_parquet(tmp_path / "log.parquet", log())
    _, findings = correction.apply_to_file(warm[1], source, tmp_path / "out.parquet", "blank")
    read = parquet.read_table(tmp_path / "out.parquet").schema.metadata[b"mwdcal"]
    assert json.loads(read)["findings"] == [finding.text for finding in findings]
    assert findings


def test_long_whole_numbers_keep_their_digits_in_a_workbook(tmp_path, cold):
    pytest.importorskip("openpyxl")
    ids = {"short": arrow.array([10**14, None]), "long": arrow.array([2**60 + 1, None])}
    source = write_parquet(tmp_path / "log.parquet", {**ids, **log(2, low=10, high=40)})
    assert mwdcal("apply", cold[0], source, "-o", tmp_path / "out.xlsx").code == 0
    found = table.read(tmp_path / "out.xlsx").columns
    assert found["long"] == [str(2**60 + 1), ""]
    assert found["short"][0] == 1e14


SERIALS = {
    "ours": (["A 7"], None),
    "ours, with blanks": (["A 7", "", " A 7 "], None),
    "another": (["B"], "B"),
    "among ours": (["A 7", "A 7", "B"], "A 7, B"),
    "many": ([f"T{i}" for i in range(40)], "T0, T1, …"),
    "odd": (["\x01é\N{SNAKE}" * 20, "\x02" * 50], "\x01é\N{SNAKE}" * 20 + ", " + "\x02" * 50),
}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("length", ["short", "long"])
@pytest.mark.parametrize(("cells", "told"), SERIALS.values(), ids=SERIALS)
def test_rows_of_another_tool_are_told(tmp_path, monkeypatch, cells, told, suffix, length):
    run = write_csv(tmp_path / "run.csv", servo_run(tool=TOOL), 'serial = "A 7"')
    command = ("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json", "--order", 0)
    assert mwdcal(*command).code == 0
    if length == "long":
        monkeypatch.setattr(correction, "TABLE_SIZES", dict.fromkeys(correction.TABLE_SIZES, 0))
        monkeypatch.setattr(streams, "PIECE", 3000)
    columns = {"serial": [cells[i * len(cells) // 120] for i in range(120)]}
    columns |= log(120, low=24, high=26)
    path = tmp_path / f"log{suffix}"
    (write_csv if suffix == ".csv" else write_parquet)(path, columns)
    out = tmp_path / f"out{suffix}"
    ran = mwdcal("apply", tmp_path / "cal.json", path, "-o", out, "--json")
    found = [f["text"] for f in ran.json["findings"] if f["id"] == "other-tool"]
    word = "the readings are of tool {}, the calibration of tool A 7: is it the right one?"
    assert found == ([] if told is None else [word.format(told)])
    assert table.read(out).metadata.get("findings", []) == [f["text"] for f in ran.json["findings"]]
    assert "serial" not in table.read(out).metadata


@pytest.mark.parametrize("name", ["ax", "mz", "temperature_c"])
@pytest.mark.parametrize("suffix", [".csv", ".long.csv", ".parquet"])
def test_a_blank_reading_is_refused_with_the_way_out(tmp_path, warm, monkeypatch, name, suffix):
    if "long" in suffix:
        monkeypatch.setattr(correction, "TABLE_SIZES", dict.fromkeys(correction.TABLE_SIZES, 0))
    columns = log(100, low=10, high=40)
    columns[name] = columns[name].copy()
    columns[name][50] = np.nan
    path = tmp_path / f"log{suffix}"
    if suffix == ".parquet":
        write_parquet(path, columns | {name: arrow.array(columns[name], from_pandas=True)})
    else:
        write_csv(path, columns)
    command = ("apply", warm[0], path, "-o", tmp_path / "out.csv")
    message = refused(mwdcal(*command), 2)
    assert f"column '{name}': must be filled in; got a blank cell." in message
    assert message.endswith("Or leave the results of such rows blank: --missing blank.")
    assert mwdcal(*command, "--missing", "blank").code == 0


@pytest.mark.parametrize("suffix", [".csv", ".long.csv", ".parquet"])
@pytest.mark.parametrize("outside", ["blank", "extrapolate"])
def test_rows_without_results_are_counted(tmp_path, warm, monkeypatch, suffix, outside):
    if "long" in suffix:
        monkeypatch.setattr(correction, "TABLE_SIZES", dict.fromkeys(correction.TABLE_SIZES, 0))
    columns, _ = gappy(400, {"ax": range(5), "mz": range(3, 9)})
    path = tmp_path / f"log{suffix}"
    if suffix == ".parquet":
        arrays = {n: arrow.array(c, from_pandas=True) for n, c in columns.items()}
        write_parquet(path, arrays)
    else:
        write_csv(path, columns)
    command = ("apply", warm[0], path, "-o", tmp_path / "out.csv", "--missing", "blank")
    ran = mwdcal(*command, "--outside", outside, "--json")
    blank = int(np.isnan(numbers(read_csv(tmp_path / "out.csv")["gravity_g"])).sum())
    assert (ran.json["rows"], ran.json["blank"]) == (400, blank)
    assert (blank > 9) == (outside == "blank")
    said = mwdcal(*command, "--outside", outside)
    assert said.out.startswith(f"400 rows corrected, {blank} of them blank   wrote ")
