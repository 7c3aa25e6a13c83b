"""Fleets of run files, and one tool out of a fleet's table: as `mwdcal calibrate` has each file alone."""

import hashlib
import json
import os

import numpy as np
import pytest

import mwdcal as library
from cli_support import EXAMPLE, mwdcal, read_csv, refused, servo_run, write_csv
from mwdcal.files.formats.atomic import file_name
from test_fleet import roll_run, short_run, write_fleet

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
openpyxl = pytest.importorskip("openpyxl")

from mwdcal.files.formats import members, parquet  # noqa: E402
from mwdcal.library import fleet_table  # noqa: E402

FIT = ("--order", 0, "--nonlinearity", "none")
"""The options of `calibrate` that are the defaults of a fleet."""


@pytest.fixture
def lab(tmp_path):
    """An empty folder for run files."""
    folder = tmp_path / "lab"
    folder.mkdir()
    return folder


def write_xlsx(path, columns):
    """A workbook by another writer."""
    book = openpyxl.Workbook()
    book.active.append(list(columns))
    for row in zip(*columns.values(), strict=True):
        book.active.append([v.item() if hasattr(v, "item") else v for v in row])
    book.save(path)
    return path


def calibrated(folder, *options, tool="servo", code=0):
    """The rows of a fleet by serial, its table, and what it said."""
    table = folder.parent / "cals.parquet"
    ran = mwdcal("fleet", folder, "-o", table, "--tool", tool, "--workers", 1, *options)
    assert ran.code == code, ran
    return {row["serial"]: row for row in pq.read_table(table).to_pylist()}, table, ran


def alone(run, *options, tool="servo"):
    """The calibration file of a run, as a document, or the message that refuses it."""
    output = run.parent.parent / "alone.json"
    ran = mwdcal("calibrate", run, "--tool", tool, "-o", output, *options)
    if ran.code:
        return refused(ran, 2, 3).removeprefix("mwdcal: ")
    return json.loads(output.read_text("utf-8"))


def check_same(record, document, *others):
    """A record says what a calibration file says, but for its time and what it is expected to add."""
    left = set(others) | {"time", "sha256"}
    assert {k: v for k, v in record.items() if k not in left} == {
        k: v for k, v in document.items() if k not in left
    }
    assert document["time"].startswith(record["time"])
    if not others:
        assert record["sha256"] == document["sha256"]  # of all but the time


def by_serial(table, serial):
    return json.loads(next(r for s, r in members.records(table) if s == serial))


# Run files


def test_each_run_file_is_calibrated_as_alone(lab):
    true = ('azimuth_reference = "true"', "declination_deg = 7.5")
    turned = short_run(2)
    turned["ref_azimuth_deg"] = (turned["ref_azimuth_deg"] + 7.5) % 360
    serial = {"serial": ["C-3"] * 28}
    files = {
        "A 1": write_csv(lab / "first.csv", short_run(1), 'serial = "A 1"', 'lab = "X"'),
        "B-2": write_csv(lab / "second.csv", turned, 'serial = "B-2"', *true),
        "C-3": write_xlsx(lab / "third.xlsx", {**serial, **short_run(3)}),
        "D-4": write_csv(lab / "d.tsv", roll_run(4), 'serial = "D-4"', delimiter="\t"),
        "named": write_csv(lab / "named.csv", short_run(5, temperature_c=None)),
    }
    for name in ("README.txt", "~$third.xlsx", ".DS_Store", "_old.csv"):
        (lab / name).write_text("not a run")
    rows, table, ran = calibrated(lab)
    assert set(rows) == set(files)
    assert {row["status"] for row in rows.values()} == {"ok"}
    assert "do not end in .csv, .tsv, .parquet or .xlsx: 1 (README.txt)" in ran.err
    for name, path in files.items():
        document = alone(path, *FIT)
        record = by_serial(table, name)
        check_same(record, document, *(("tool", "serial", "findings") if name == "named" else ()))
        assert record["serial"] == name
        assert record["run"] == path.name
        assert record["run_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        for triad in ("accelerometer", "magnetometer"):
            values = [rows[name][f"{triad}_gain_{a}{b}"] for a in "xyz" for b in "xyz"]
            assert values == pytest.approx(document[triad]["parameters"][:9], rel=1e-9, abs=1e-9)


def test_tables_as_another_program_writes_them(lab):
    profile = lab.parent / "tool.toml"
    export = EXAMPLE / "export.csv"
    assert mwdcal("profile", export, "-o", profile).code == 0
    for serial in ("SIM-0001", "SIM-0002"):
        text = export.read_bytes().replace(b"SIM-0001", serial.encode())
        (lab / f"{serial} as exported.csv").write_bytes(text)
    rows, table, _ = calibrated(lab, tool=profile)
    assert {s: row["status"] for s, row in rows.items()} == {"SIM-0001": "ok", "SIM-0002": "ok"}
    for serial in rows:
        run = lab / f"{serial} as exported.csv"
        check_same(by_serial(table, serial), alone(run, *FIT, tool=profile))


DAYS = {
    "one day": (["2026-03-04"] * 28, "2026-03-04"),
    "times of a day": ([f"04.03.2026 10:{minute}" for minute in range(10, 38)], "2026-03-04"),
    "two days": (["2026-03-04"] * 27 + ["2026-03-05"], None),
    "read in two ways": (["03/04/2026"] * 28, None),
}


@pytest.mark.parametrize(("cells", "day"), DAYS.values(), ids=DAYS)
def test_a_column_dates_a_run_whose_rows_share_a_day(lab, cells, day):
    """Expected: the day as written, in a run file, in a folder of them, and in a Parquet table of two tools."""
    run = {"date": cells, **short_run(1)}
    path = write_csv(lab / "run.csv", run, 'serial = "A-1"')
    assert alone(path, *FIT)["tool"].get("date") == day
    _, table, ran = calibrated(lab)
    assert by_serial(table, "A-1")["tool"].get("date") == day
    assert "'date'" not in ran.err
    tools = {"serial": ["A-1"] * 28 + ["B-2"] * 28, "date": [*cells, *["2026-05-06"] * 28]}
    both = {n: np.concatenate([v, short_run(2)[n]]) for n, v in short_run(1).items()}
    whole = lab.parent / "whole.parquet"
    pq.write_table(pa.table({**tools, **both}), whole)
    _, table, _ = calibrated(whole)
    assert by_serial(table, "A-1")["tool"].get("date") == day
    assert by_serial(table, "B-2")["tool"]["date"] == "2026-05-06"
    path = write_csv(lab / "both.csv", {**tools, **both})
    assert alone(path, *FIT, "--serial", "B-2")["tool"]["date"] == "2026-05-06"
    assert library.read_run(run, "servo").metadata.get("date") == day


OPTIONS = {
    "orders": ("--order", "auto", "--nonlinearity", "none", "--robust", "huber", "--ignore", "dip"),
    "datasheet": (*FIT, "--prior", "datasheet"),
    "stand": (*FIT, "--estimate", "azimuth-zero"),
    "curves": (*FIT[:3], "accelerometer", "--method", "scalar"),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_options_reach_the_record(lab, options):
    soaks = (20.0, 60.0, 100.0) if "auto" in options else (25.0,)
    columns = {
        **servo_run(3, temperatures=soaks),
        "sd_ref_azimuth_deg": np.full(48 * len(soaks), 0.1),
    }
    path = write_csv(lab / "a.csv", columns, 'serial = "A"')
    _, table, _ = calibrated(lab, *options)
    check_same(by_serial(table, "A"), alone(path, *options))


def test_a_bad_file_is_the_status_of_its_tool(lab):
    blank = short_run(4)
    blank["ax"] = [*map(repr, blank["ax"].tolist())]
    blank["ax"][3] = "abc"
    flat = {**short_run(6), "my": np.zeros(28)}
    files = {
        "good": write_csv(lab / "good.csv", short_run(1)),
        "B 2": write_csv(lab / "b.csv", short_run(2, az=None), 'serial = "B 2"'),
        "text": write_csv(lab / "text.csv", blank),
        "flat": write_csv(lab / "flat.csv", flat),
        "notes": lab / "notes.csv",
        "book": lab / "book.xlsx",
    }
    files["notes"].write_text("to do: buy oil\n")
    files["book"].write_bytes(b"PK nothing")
    rows, _, ran = calibrated(lab)
    assert set(rows) == set(files)
    assert rows.pop("good")["status"] == "ok"
    for name, row in rows.items():
        assert row["message"] == alone(files[name], *FIT), name
        assert row["status"] == ("channel" if name == "flat" else "bad-input"), row
        assert row["calibration"] is None
    assert {rows[name]["stations"] for name in ("B 2", "notes", "book")} == {0}
    assert "6 tools, 84 stations" in ran.err


def test_two_files_of_one_serial_are_refused_by_their_names(lab):
    for name, serial in (("a", "T1"), ("b", "T2"), ("c", "T1")):
        write_csv(lab / f"{name}.csv", short_run(ord(name)), f'serial = "{serial}"')
    rows, _, _ = calibrated(lab)
    assert [rows[s]["status"] for s in ("T1", "T2")] == ["bad-input", "ok"]
    assert "the serial 'T1' is that of a.csv and c.csv" in rows["T1"]["message"]


def test_tables_of_many_tools_beside_run_files(lab):
    runs = {f"M{i}": short_run(i) for i in range(3)}
    columns = {
        "serial": np.repeat(list(runs), 28).tolist(),
        **{n: np.concatenate([run[n] for run in runs.values()]) for n in short_run(0)},
    }
    columns["ax"] = [*map(repr, columns["ax"].tolist())]
    columns["ax"][30] = "oops"
    many = write_csv(lab / "many.csv", columns)
    write_fleet(lab / "table.parquet", {"P1": short_run(7), "P2": short_run(8)})
    one = write_csv(lab / "one.csv", short_run(9))
    rows, table, _ = calibrated(lab)
    assert list(rows) == ["M0", "M1", "M2", "one", "P1", "P2"]
    assert [s for s, row in rows.items() if row["status"] != "ok"] == ["M1"]
    assert (
        "serial M1 of many.csv, line 32, column 'ax': expected a number; got 'oops'"
        in (rows["M1"]["message"])
    )
    lone = write_csv(lab.parent / "lone.csv", {"serial": ["M2"] * 28, **runs["M2"]})
    sheet = lab.parent / "x"
    sheet.mkdir()
    document = alone(lone.rename(sheet / "lone.csv"), *FIT)
    check_same(by_serial(table, "M2"), document, "run", "run_sha256")
    assert by_serial(table, "M2")["run_sha256"] == hashlib.sha256(many.read_bytes()).hexdigest()
    assert by_serial(table, "one")["run"] == one.name
    rows, _, _ = calibrated(many)
    assert list(rows) == ["M0", "M1", "M2"]


def test_serials_that_contradict_each_other(lab):
    columns = {"serial": ["B"] * 28, **short_run(1)}
    write_csv(lab / "a.csv", columns, 'serial = "A"')
    columns["serial"] = ["B"] * 20 + [""] * 4 + ["C"] * 4
    write_csv(lab / "b.csv", columns)
    rows, _, _ = calibrated(lab, code=3)
    assert (
        "a.csv: the metadata state the serial 'A', the column 'serial' 'B'" in rows["a"]["message"]
    )
    assert "b.csv, line 22, column 'serial': must be filled in" in rows["b"]["message"]


def test_a_column_that_looks_like_the_serial(lab):
    write_csv(lab / "a.csv", {"Serial No": ["A"] * 14 + ["B"] * 14, **short_run(1)})
    write_csv(lab / "b.csv", {"Serial No": ["A"] * 28, **short_run(2)})
    rows, _, _ = calibrated(lab)
    assert [rows[s]["status"] for s in ("a", "b")] == ["bad-input", "ok"]
    assert "a.csv: the column 'Serial No' names several tools" in rows["a"]["message"]


@pytest.mark.parametrize(("stated", "serial"), [("serial = 0", "0"), ('serial = " "', "a b")])
def test_serials_that_are_no_text(lab, stated, serial):
    write_csv(lab / "a b.csv", short_run(1), stated)
    rows, table, _ = calibrated(lab)
    assert list(rows) == [serial]
    assert by_serial(table, serial)["serial"] == serial


def test_folders_name_what_files_do_not(lab):
    for name in ("serial=X%2F1", "Bohrung 7"):
        (lab / name).mkdir()
        write_csv(lab / name / f"run of {name[-1]}.csv", short_run(len(name)))
    assert set(calibrated(lab)[0]) == {"X/1", "run of 7"}


@pytest.mark.skipif(os.name == "nt", reason="names are text there")
def test_a_name_that_is_no_text_is_refused(lab):
    write_csv(lab / "a.csv", short_run(1)).rename(os.fsdecode(os.fsencode(lab) + b"/\xff.csv"))
    ran = mwdcal("fleet", lab, "-o", lab.parent / "o.parquet")
    assert "must be valid UTF-8" in refused(ran, 2)


def test_a_single_file_that_is_no_run_is_refused(tmp_path):
    path = write_csv(tmp_path / "a.csv", short_run(1, az=None))
    assert "'az' is missing" in refused(mwdcal("fleet", path, "-o", tmp_path / "o.parquet"), 2)


def test_an_interrupted_fleet_of_run_files_goes_on(lab, monkeypatch):
    for i in range(3):
        write_csv(lab / f"{i}.csv", short_run(i))
    rows, table, _ = calibrated(lab)
    expected = table.read_bytes()
    table.unlink()
    with pytest.MonkeyPatch.context() as patch:

        def stop(writer):
            raise KeyboardInterrupt

        patch.setattr(parquet, "close", stop)
        calibrated_before = mwdcal("fleet", lab, "-o", table, "--tool", "servo", "--workers", 1)
    assert calibrated_before.code == 130
    table.unlink(missing_ok=True)
    again, _, ran = calibrated(lab)
    assert "1 part, 1 done before" in ran.err
    assert again == rows
    assert table.read_bytes() == expected
    write_csv(lab / "1.csv", short_run(9))
    assert calibrated(lab)[0] != rows


# One tool out of a table

SERIALS = ("A 1", "B#2", "Süd/3", "x" * 200, "con", "a 1", "../up", "\x1b[31mred", "=1+1")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A table of tools with unpleasant serials and one that is refused, and their files."""
    folder = tmp_path_factory.mktemp("fleet")
    runs = {serial: short_run(seed) for seed, serial in enumerate(SERIALS)}
    runs["bad"] = {**short_run(20), "my": np.zeros(28)}
    path = write_fleet(folder / "runs.parquet", runs, {"simulated": True, "lab": "X"})
    table = folder / "cals.parquet"
    given = ("--tool", "servo", "--workers", 1, "--calibrations", folder / "tools")
    ran = mwdcal("fleet", path, "-o", table, *given)
    assert ran.code == 0, ran
    assert f"wrote {len(SERIALS)} calibration files to" in ran.err
    write_csv(folder / "readings.csv", servo_run(3, (20, 70, 120), 5))
    return folder


def test_each_tool_has_a_file_that_says_what_the_table_says(fleet):
    files = sorted((fleet / "tools").iterdir())
    serials = {}
    for path in files:
        record = library.load(path)
        serials[record.serial] = path
        assert path.read_text("utf-8").endswith("}\n")
        named = library.load(f"{fleet / 'cals.parquet'}#{record.serial}")
        assert named == record
        assert not named.changed
        assert named.simulated
    assert set(serials) == set(SERIALS)
    names = [path.name.casefold() for path in files]
    assert len(set(names)) == len(names)
    assert serials["B#2"].name == "B%232.json"
    assert serials["Süd/3"].name == "Süd%2F3.json"
    assert {serials["A 1"].name[:3], serials["a 1"].name[:3]} == {"A 1", "a 1"}
    assert all(path.name.isprintable() and len(path.name.encode()) < 200 for path in files)


def test_files_say_what_calibrate_says_of_the_same_rows(fleet):
    one = pq.read_table(fleet / "runs.parquet", filters=[("serial", "==", "B#2")])
    (fleet / "sub").mkdir(exist_ok=True)
    pq.write_table(one, fleet / "sub" / "one.parquet")
    document = alone(fleet / "sub" / "one.parquet", *FIT)
    record = json.loads((fleet / "tools" / "B%232.json").read_text("utf-8"))
    check_same(record, document, "run", "run_sha256")
    digest = hashlib.sha256((fleet / "runs.parquet").read_bytes()).hexdigest()
    assert (record["run"], record["run_sha256"]) == ("serial B#2 of runs.parquet", digest)


@pytest.mark.parametrize("serial", ["A 1", "B#2", "Süd/3"])
def test_commands_take_a_tool_as_they_take_its_file(fleet, tmp_path, serial):
    table = fleet / "cals.parquet"
    tool, file = f"{table}#{serial}", fleet / "tools" / f"{file_name(serial)}.json"
    digest = hashlib.sha256(table.read_bytes()).hexdigest()
    outputs = []
    for calibration in (tool, file):
        output = tmp_path / f"{len(outputs)}.csv"
        ran = mwdcal("apply", calibration, fleet / "readings.csv", "-o", output, "--json")
        assert ran.code == 0, ran
        outputs.append(read_csv(output))
        if calibration == tool:
            assert ran.json["calibration_sha256"] == digest
    assert outputs[0] == outputs[1]
    shown = [mwdcal("convert", c, "--notation", "forward", "--json") for c in (tool, file)]
    first, second = (ran.json for ran in shown)
    assert (first["calibration"], first["calibration_sha256"]) == (f"cals.parquet#{serial}", digest)
    which = {"calibration": "", "calibration_sha256": ""}
    assert first | which == second | which
    verdicts = [mwdcal("verify", c, fleet / "readings.csv", "--json") for c in (tool, file)]
    assert [ran.code for ran in verdicts] in ([0, 0], [1, 1])
    first, second = (ran.json for ran in verdicts)
    assert first["calibration_sha256"] == digest
    for each in (first, second):  # after a FAIL the command names the calibration
        each["findings"] = [f for f in each["findings"] if f["id"] != "next-step"]
    assert first | which == second | which


def test_a_tool_of_a_fleet_is_a_prior(fleet, tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(0, (20, 70, 120), 5), 'serial = "A 1"')
    output = tmp_path / "new.json"
    given = ("--tool", "servo", "-o", output)
    prior = f"{fleet / 'cals.parquet'}#A 1"
    ran = mwdcal("calibrate", run, *given, "--prior", prior)
    assert ran.code == 0, ran
    digest = hashlib.sha256((fleet / "cals.parquet").read_bytes()).hexdigest()
    assert json.loads(output.read_text("utf-8"))["prior_sha256"] == digest


def test_what_a_table_cannot_give_is_said_in_one_sentence(fleet, tmp_path):
    table = fleet / "cals.parquet"

    def message(calibration):
        return refused(mwdcal("convert", calibration, "--notation", "forward"), 2)

    assert f"has the calibrations of {len(SERIALS) + 1} tools" in message(table)
    assert "such as 'cals.parquet#A 1'" in message(table)
    assert "has no tool 'A1'. Is it 'A 1'?" in message(f"{table}#A1")
    assert "Its tools are 'A 1', 'B#2', 'Süd/3'" in message(f"{table}#quite another")
    assert "the tool 'bad' was not calibrated, status channel: " in message(f"{table}#bad")
    assert "cannot be read" in message(f"{fleet / 'none.parquet'}#A 1")
    assert "cannot be read" in message(f"{next((fleet / 'tools').iterdir())}#A 1")
    assert "the column 'status' is missing" in message(fleet / "runs.parquet")
    slim = tmp_path / "slim.parquet"
    whole = pq.read_table(table)
    pq.write_table(whole.drop_columns(["calibration"]), slim)
    assert "has no column 'calibration'" in message(f"{slim}#A 1")
    assert "--records" in message(f"{slim}#A 1")
    pq.write_table(whole.slice(1, 1), slim)
    assert library.load(slim).serial == "B#2"
    damaged = whole.to_pylist()
    damaged[0]["calibration"] = damaged[0]["calibration"].replace('"rank":', '"rang":')
    pq.write_table(pa.Table.from_pylist(damaged, whole.schema), slim)
    assert "slim.parquet#A 1 is not a calibration file" in message(f"{slim}#A 1")


def test_a_changed_record_is_reported(fleet, tmp_path):
    whole = pq.read_table(fleet / "cals.parquet")
    changed = whole.to_pylist()
    record = json.loads(changed[0]["calibration"])
    record["earth"]["gravity_g"] += 1e-3
    changed[0]["calibration"] = json.dumps(record)
    path = tmp_path / "changed.parquet"
    pq.write_table(pa.Table.from_pylist(changed, whole.schema), path)
    assert library.load(f"{path}#A 1").changed
    assert not library.load(f"{path}#B#2").changed


def test_a_file_that_has_the_whole_name_is_meant(fleet, tmp_path):
    file = next((fleet / "tools").glob("B*.json"))
    odd = tmp_path / "cals.parquet#A 1"
    odd.write_bytes(file.read_bytes())
    (tmp_path / "cals.parquet").write_bytes((fleet / "cals.parquet").read_bytes())
    assert library.load(odd).serial == "B#2"
    odd.unlink()
    assert library.load(odd).serial == "A 1"


def test_the_table_is_an_input_that_is_not_lost(fleet):
    table = fleet / "cals.parquet"
    ran = mwdcal("apply", f"{table}#A 1", fleet / "readings.csv", "-o", table)
    assert "would be lost" in refused(ran, 2)


# Which tables hold calibrations, and their files


def test_large_fleets_leave_calibrations_out(lab, monkeypatch):
    monkeypatch.setattr(fleet_table, "RECORDED", 1)
    for i in range(2):
        write_csv(lab / f"{i}.csv", short_run(i))
    assert "calibration" not in calibrated(lab)[0]["0"]
    assert calibrated(lab, "--records")[0]["0"]["calibration"]
    assert "calibration" not in calibrated(lab, "--no-records")[0]["0"]
    rows, _, _ = calibrated(lab, "--calibrations", lab.parent / "each")
    assert rows["1"]["calibration"]
    assert sorted(path.name for path in (lab.parent / "each").iterdir()) == ["0.json", "1.json"]


def test_a_folder_with_files_is_left_as_it_is(lab):
    write_csv(lab / "a.csv", short_run(1))
    each = lab.parent / "each"
    each.mkdir()
    calibrated(lab, "--calibrations", each)
    before = {path.name: path.read_bytes() for path in each.iterdir()}
    output = lab.parent / "o.parquet"
    given = ("fleet", lab, "-o", output, "--tool", "servo")
    assert "there are files in it" in refused(mwdcal(*given, "--calibrations", each), 2)
    assert before == {path.name: path.read_bytes() for path in each.iterdir()}
    assert not output.exists()
    other = lab / "a.csv"
    assert "not a folder" in refused(mwdcal(*given, "--calibrations", other), 2)
    assert "does not exist" in refused(mwdcal(*given, "--calibrations", each / "x" / "y"), 2)
    both = mwdcal(*given, "--calibrations", lab.parent / "new", "--no-records")
    assert "leave out --no-records" in refused(both, 2)


def test_file_names_differ_and_suit_every_system():
    serials = [
        *SERIALS,
        "CON",
        "con.1",
        "nul",
        ".hidden",
        "dot.",
        "a ",
        "%",
        "a%20",
        "Ä" * 90,
        "\u202e",
    ]
    names = [file_name(serial) for serial in serials]
    assert len(set(names)) == len(serials)
    for name in names:
        assert not set(name) & set('<>:"/\\|?*\x1b\u202e')
        assert name == name.strip(" .")
        assert name.partition(".")[0].casefold() not in ("con", "nul")
        assert len(name.encode()) <= 120
    assert [file_name(s) for s in ("MWD-17", "Süd 3")] == ["MWD-17", "Süd 3"]
