"""A serial and a date are text: they come out of every command as they stand in the file that states them."""

import json
import shutil
import string
import tempfile
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import mwdcal
from cli_support import EXAMPLE
from cli_support import mwdcal as command
from mwdcal.calibration.diagnosis.identity import dated
from mwdcal.calibration.readings import check_day, future_day, stated_day
from mwdcal.errors import InputError
from mwdcal.files import metadata
from mwdcal.files.formats import table as tables

NUMBERS = st.from_regex(
    r"[-+]?[0-9]{1,6}([.,][0-9]{1,4})?([eE][-+]?[0-9]{1,3})?|0[xob][0-9]{1,5}", fullmatch=True
)
WORDS = st.sampled_from(
    ["true", "nan", "inf", "None", "2026-01-01", "12:30:00", "=1+1", "'7'", '"7"', "7 # 8", "[7]"]
)
TEXTS = st.text(
    st.sampled_from(string.ascii_letters + string.digits + " #'\"./\\-_=,;{}[]äß№ⅷ測\u00a0"),
    min_size=1, max_size=12,
)  # fmt: skip
SERIALS = (NUMBERS | WORDS | TEXTS).filter(
    lambda text: text.strip() == text and str(Path(f"a#{text}")) == f"a#{text}"
)
"""Of those with '//' the command line takes the file of the calibration, not `cals.parquet#SERIAL`."""
DATES = st.dates(date(1990, 1, 1), date(2025, 12, 31)).map(str) | st.just(
    "2024-02-29T23:30:00+01:00"
)


def typed(key, text):
    """A metadata line: bare where it can be, else in quotes."""
    bare = text[0] not in "\"'[{" and text.isprintable()
    return f"# {key} = {text if bare else json.dumps(text, ensure_ascii=False)}"


def stated(folder, name, serial, day):
    """A bundled file with another serial and date."""
    lines = (EXAMPLE / name).read_text("utf-8").splitlines()
    rest = [line for line in lines if not line.startswith(("# serial", "# date"))]
    path = folder / name
    path.write_text("\n".join([typed("serial", serial), typed("date", day), *rest, ""]), "utf-8")
    return path


def done(*arguments):
    ran = command(*arguments)
    assert ran.code == 0, ran.err
    return ran


@pytest.mark.slow
@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(serial=SERIALS, day=DATES)
@example("12.10", "2024-03-01")
@example("1e5", "2024-03-01")
@example("Ä/ B#1", "2024-03-01")
def test_a_serial_and_a_date_go_through_every_command_unchanged(serial, day):
    folder = Path(tempfile.mkdtemp())
    try:
        through(folder, serial, day)
    finally:
        shutil.rmtree(folder)


def through(folder, serial, day):
    run, test = (stated(folder, name, serial, day) for name in ("run.csv", "rolltest.csv"))
    made = folder / "made.json"
    shown = done("calibrate", run, "--tool", EXAMPLE / "tool.toml", "-o", made, "--json").json
    fields = json.loads(made.read_text("utf-8"))
    assert (shown["serial"], fields["serial"], fields["tool"]["date"]) == (serial, serial, day)
    verdict = done("verify", made, test, "--json").json
    assert (verdict["serial"], verdict["date"]) == (serial, day)
    assert not {"no-serial", "future-date"} & {each["id"] for each in verdict["findings"]}
    for suffix in (".csv", ".tsv", ".parquet", ".xlsx"):
        out = folder / f"out{suffix}"
        assert done("apply", made, test, "-o", out, "--json").json["serial"] == serial
        again = tables.read(out).metadata
        assert (again["serial"], again["date"]) == (serial, day)
    (folder / "v.json").write_text(json.dumps(verdict), "utf-8")
    done("certificate", made, "--verification", folder / "v.json", "-o", folder / "C.json")
    paper = json.loads((folder / "C.json").read_text("utf-8"))
    assert (paper["serial"], paper["item"]["serial"], paper["calibrated"]) == (
        serial,
        serial,
        day[:10],
    )
    assert done("convert", made, "--notation", "forward", "--json").json["serial"] == serial
    place = ("--registry", folder / "r.sqlite")
    done("registry", *place, "init")
    done("registry", *place, "add", run, made, folder / "v.json", folder / "C.json")
    (tool,) = done("registry", *place, "list", "--json").json["tools"]
    assert (tool["serial"], tool["calibrated"]) == (serial, day[:10])
    (folder / "runs").mkdir()
    shutil.copy(run, folder / "runs" / "1.csv")
    fleet = folder / "cals.parquet"
    done("fleet", folder / "runs", "--tool", EXAMPLE / "tool.toml", "--workers", 1, "-o", fleet)
    (cell,) = tables.read(fleet).columns["serial"]
    assert cell == serial
    for source in (fleet, folder / "r.sqlite"):
        record = done("convert", f"{source}#{serial}", "--notation", "forward", "--json").json
        assert record["serial"] == serial


@settings(deadline=None, max_examples=200)
@given(serial=SERIALS, day=DATES)
@example("true", "2024-03-01")
@example("0x1F", "2024-03-01")
def test_lines_of_metadata_keep_the_spelling(serial, day):
    stated = {"serial": serial, "operator": serial, "date": day, "tool": serial}
    bare = [typed(key, value) for key, value in stated.items()]
    assert metadata.parse(enumerate(bare, 1), "run.csv") == stated
    assert metadata.parse(enumerate(metadata.render(stated), 1), "run.csv") == stated


@pytest.mark.parametrize(
    ("line", "got"),
    [("serial = [12, 10]", "[12, 10]"), ('"serial" = 12.10', "12.1"), ('"serial" = true', "True")],
)
def test_a_serial_whose_spelling_is_lost_is_refused(line, got):
    with pytest.raises(mwdcal.InputError, match="run.csv, line 1.*'serial' must be text"):
        metadata.parse([(1, f"# {line}")], "run.csv")
    with pytest.raises(mwdcal.InputError, match="the readings, metadata: 'serial' must be text"):
        mwdcal.readings(np.eye(3), metadata={"serial": 12.10})


@pytest.mark.parametrize(
    "day",
    [
        "31.12.2025",
        "2025-02-29",
        "01/02/2025",
        "2025",
        "2025-13-01",
        "yesterday",
        "2025-1-2",
        "2026-W05",
        "12:30:00",
    ],
)
@pytest.mark.parametrize("quote", ["", '"'])
def test_a_date_that_cannot_be_read_is_named_with_the_form_expected(day, quote):
    kept = metadata.parse([(3, f"# date = {quote}{day}{quote}")], "run.csv")
    assert kept == {"date": day}
    (found,) = dated(kept, "run.csv")
    assert found.id == "unreadable-date"
    assert "run.csv: 'date' must be" in found.text
    assert f"such as 2026-01-31; got {day!r}" in found.text
    with pytest.raises(mwdcal.InputError, match="year-month-day"):
        check_day(kept, "the calibration")


@pytest.mark.parametrize(
    ("stated_as", "day"),
    [("2024-02-29", date(2024, 2, 29)), ("20240229", date(2024, 2, 29)), ("", None),
     ("2024-02-29T10:00:00Z", date(2024, 2, 29)), ("2024-02-29 10:00", date(2024, 2, 29)),
     (date(2024, 2, 29), date(2024, 2, 29)), (None, None)],
)  # fmt: skip
def test_days_that_can_be_read(stated_as, day):
    kept = mwdcal.readings(np.eye(3), metadata={"date": stated_as}).metadata
    assert stated_day(kept) == day


def test_a_day_is_of_the_future_where_it_has_begun_nowhere():
    today = datetime.now(UTC).date()
    assert future_day({"date": today}) is None
    assert future_day({"date": today.replace(year=today.year + 1, day=1)}) is not None


@pytest.fixture(scope="module")
def tool():
    return mwdcal.load_profile(EXAMPLE / "tool.toml")


@pytest.fixture(scope="module")
def run(tool):
    return mwdcal.read_run(EXAMPLE / "run.csv", tool)


@pytest.fixture(scope="module")
def test_run(tool):
    return mwdcal.read_run(EXAMPLE / "rolltest.csv", tool)


def of(readings, **stated):
    """Readings that state a serial or date of their own; None: none."""
    known = {**readings.metadata, **stated}
    return replace(readings, metadata={k: v for k, v in known.items() if v is not None})


def ids(result):
    return {each.id for each in result.findings}


@pytest.mark.parametrize("lacking", ["both", "calibration", "run", "none"])
def test_data_without_a_serial_are_said_to_be_wherever_serials_are_compared(run, test_run, lacking):
    first = of(run, serial=None) if lacking in ("both", "calibration") else run
    other = of(test_run, serial=None) if lacking in ("both", "run") else test_run
    calibration = mwdcal.calibrate(first)
    assert ("no-serial" in ids(calibration)) == (lacking in ("both", "calibration"))
    for result in (
        mwdcal.verify(calibration, other), mwdcal.apply(calibration, other), mwdcal.diagnose(calibration, other),
        mwdcal.calibrate(other, prior=calibration, order=0),
    ):  # fmt: skip
        texts = [each.text for each in result.findings if each.id == "no-serial"]
        assert len(texts) == (lacking != "none"), type(result)
        assert all(("rolltest.csv" in text) == (lacking in ("both", "run")) for text in texts)
        assert all("same tool" in text for text in texts)


def test_a_day_that_is_to_come_is_said_wherever_readings_are_used(run, test_run):
    later = of(test_run, date="2999-01-01")
    calibration = mwdcal.calibrate(of(run, date="2999-01-01"))
    for result in (
        calibration, mwdcal.verify(calibration, later), mwdcal.apply(calibration, later),
        mwdcal.diagnose(calibration, later),
    ):  # fmt: skip
        assert "future-date" in ids(result), type(result)
    assert "future-date" not in ids(mwdcal.verify(calibration, test_run))


def test_a_registry_says_which_records_are_of_no_tool_or_of_a_day_to_come(tmp_path, run):
    for name, stated in {"none": {"serial": None}, "late": {"date": "2999-01-01"}}.items():
        mwdcal.save(mwdcal.calibrate(of(run, **stated)), tmp_path / f"{name}.json")
    place = ("--registry", tmp_path / "r.sqlite")
    done("registry", *place, "init")
    ran = done("registry", *place, "add", tmp_path / "none.json", tmp_path / "late.json", "--json")
    said = {each["id"]: each["text"] for each in ran.json["findings"]}
    assert "such as none.json" in said["no-serial"]
    assert "such as late.json" in said["future-date"]
    assert "none.json" in ran.err


# ------------------------------------------------------------------ formats


@pytest.mark.parametrize(
    ("value", "form", "serial"),
    [(12.1, "0.00", "12.10"), (123, "00000", "00123"), (12.1, "General", "12.1"), (7, "General", "7"),
     ("12.10", "@", "12.10"), (12.1, "0.0%", None), (1e5, "0.00E+00", None), (True, "General", None),
     (date(2026, 12, 10), "yyyy-mm-dd", None)],
)  # fmt: skip
@pytest.mark.parametrize("heading", ["serial", "S/N"])
def test_serials_of_a_workbook_are_read_as_it_shows_them(
    tmp_path, tool, value, form, serial, heading
):
    openpyxl = pytest.importorskip("openpyxl")
    from mwdcal.files import runs
    from mwdcal.sensor.profile import ColumnSource, TableFormat

    book = openpyxl.Workbook()
    names = (
        {"ax": "Gx", "ay": "Gy", "az": "Gz"}
        if heading != "serial"
        else dict.fromkeys(("ax", "ay", "az"))
    )
    book.active.append([heading, *(theirs or ours for ours, theirs in names.items())])
    for row in range(2, 5):
        book.active.append([value, 0.1, 0.2, 3.0])
        book.active.cell(row, 1).number_format = form
    book.save(tmp_path / "run.xlsx")
    if heading != "serial":
        import msgspec

        columns = {
            ours: ColumnSource(name=theirs) for ours, theirs in {**names, "serial": heading}.items()
        }
        tool = msgspec.structs.replace(tool, table=TableFormat(), columns=columns)
    if serial is None:
        with pytest.raises(mwdcal.InputError, match="row 2, column .*a serial must be text"):
            runs.read_run(tmp_path / "run.xlsx", tool)
    else:
        assert runs.read_run(tmp_path / "run.xlsx", tool)[0].metadata["serial"] == serial


@pytest.mark.parametrize("serial", ["12.10", "1e5", "00123", "0x1F", "A 7"])
def test_serials_of_the_header_of_a_log_keep_their_spelling(tmp_path, serial):
    pytest.importorskip("lasio")
    lines = ["~Version", "VERS. 2.0 :", "WRAP. NO :", "~Well", "NULL. -999.25 :", "~Parameter"]
    lines += [f"SERIAL. {serial} : serial", "~Curve", "DEPT.M :", "AX.G :", "~A", "1.0 0.5", ""]
    (tmp_path / "log.las").write_text("\n".join(lines))
    assert tables.read(tmp_path / "log.las").metadata["serial"] == serial


@pytest.mark.parametrize(
    ("cells", "serial"), [([7.0] * 48, "7"), ([12.1] * 48, None), (["12.10"] * 48, "12.10")]
)
def test_serials_of_a_parquet_file_that_are_numbers_with_decimals_are_refused(
    tmp_path, cells, serial
):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = tables.read(EXAMPLE / "run.csv")
    numbers = {name: tables.numbers(table, name) for name in table.columns if name != "station"}
    arrow = pytest.importorskip("pyarrow").table({**numbers, "serial": cells})
    parquet.write_table(arrow, tmp_path / "run.parquet")
    ran = command(
        "calibrate",
        tmp_path / "run.parquet",
        "--tool",
        EXAMPLE / "tool.toml",
        "-o",
        tmp_path / "c.json",
        "--json",
    )
    if serial is None:
        assert ran.code == 2
        assert "whose spelling is lost" in ran.err
    else:
        assert ran.json["serial"] == serial


@pytest.mark.parametrize("way", ["columns", "pandas", "pyarrow"])
@pytest.mark.parametrize(
    ("cells", "serial"), [([7.0, 7.0], "7"), ([7, 7], "7"), ([12.1, 12.1], None)]
)
def test_a_serial_that_lost_its_spelling_is_refused(way, cells, serial):
    """12.10 and 12.1 are two tools; a table of numbers has one of them."""
    columns = {n: np.ones(2) for n in ("ax", "ay", "az")} | {"serial": np.array(cells)}
    if way == "pandas":
        columns = pytest.importorskip("pandas").DataFrame(columns)
    elif way == "pyarrow":
        columns = pytest.importorskip("pyarrow").table(columns)
    if serial:
        assert mwdcal.read_run(columns).metadata["serial"] == serial
    else:
        with pytest.raises(InputError, match=r"'serial': must be text; got the number 12\.1"):
            mwdcal.read_run(columns)


@pytest.mark.parametrize(
    ("name", "cells", "dtype", "expected"),
    [("serial", ["1e5", None], "string", "1e5"), ("simulated", [True, None], "boolean", True)],
)
def test_a_missing_cell_of_pandas_is_blank(name, cells, dtype, expected):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({n: np.ones(2) for n in ("ax", "ay", "az")})
    frame[name] = pandas.array(cells, dtype=dtype)
    assert mwdcal.read_run(frame).metadata[name] == expected


FRAMES = {"pandas": "DataFrame", "polars": "DataFrame"}


@pytest.mark.parametrize("library", [*FRAMES, "dictionary"])
@pytest.mark.parametrize("way", ["columns", "metadata", "attrs"])
def test_tables_in_memory_keep_serial_and_simulated(library, way, tool):
    run = tables.read(EXAMPLE / "run.csv")
    columns = {
        name: np.array(cells, float) for name, cells in run.columns.items() if name != "station"
    }
    stated = {"serial": "12.10", "simulated": True}
    if way == "columns":
        columns |= {name: [value] * run.count for name, value in stated.items()}
    frame = columns
    if library != "dictionary":
        frame = getattr(pytest.importorskip(library), FRAMES[library])(columns)
    if way == "attrs":
        if library != "pandas":
            return
        frame.attrs.update(stated)
    readings = mwdcal.read_run(frame, tool, metadata=stated if way == "metadata" else None)
    calibration = mwdcal.calibrate(readings)
    assert (calibration.serial, calibration.simulated) == ("12.10", True)


def test_a_calibration_says_whose_it_replaces(tmp_path):
    """Of the same tool, or of a file that is no calibration, it says no more than that it replaces an earlier file."""
    run, target = (EXAMPLE / "run.csv").read_text("utf-8"), tmp_path / "tool.json"
    (tmp_path / "other.csv").write_text(run.replace("SIM-0001", "OTHER-1"), "utf-8")

    def said(name):
        ran = command("calibrate", name, "--tool", EXAMPLE / "tool.toml", "-o", target)
        return ran.out.rpartition("wrote ")[2].partition(" (")[2].partition(")")[0]

    assert said(EXAMPLE / "run.csv") == "calibration"
    assert said(tmp_path / "other.csv") == "calibration, in place of that of SIM-0001"
    assert said(tmp_path / "other.csv") == "calibration, in place of an earlier file"
    for text in ("{", "[1]", '{"command": "calibrate", "tool": 3}', '{"tool": {"serial": "A"}}'):
        target.write_text(text)
        assert said(EXAMPLE / "run.csv") == "calibration, in place of an earlier file"
