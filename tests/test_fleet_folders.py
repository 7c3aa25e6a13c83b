"""Fleets in many files: metadata of each, kinds of serials, and what the names of folders say."""

import json
import shutil
from urllib.parse import quote

import numpy as np
import pytest

from cli_support import EXAMPLE, mwdcal, refused
from test_fleet import alone, calibrated, check_same, roll_run, short_run, write_fleet

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

TRUE = {"azimuth_reference": "true", "declination_deg": 7.5}
GRID = {"azimuth_reference": "grid", "declination_deg": 7.5, "convergence_deg": 2.0}


@pytest.fixture
def folder(tmp_path):
    """An empty folder."""
    found = tmp_path / "runs"
    found.mkdir()
    return found


def turned(columns, offset):
    """A run whose azimuths count from another north."""
    return {**columns, "ref_azimuth_deg": (columns["ref_azimuth_deg"] + offset) % 360}


def ran(folder, *options):
    return mwdcal("fleet", folder, "-o", folder.parent / "o.parquet", "--tool", "servo", *options)


# Metadata


def test_each_tool_has_the_azimuths_of_its_own_file(folder):
    files = {"a": ({}, 0), "b": (TRUE, 7.5), "c": (GRID, 5.5), "d": ({"declination_deg": 3.0}, 0)}
    runs = {f"{name}{i}": turned(short_run(i), files[name][1]) for name in files for i in (1, 2)}
    for name, (metadata, _) in files.items():
        own = {serial: columns for serial, columns in runs.items() if serial[0] == name}
        write_fleet(folder / f"{name}.parquet", own, {**metadata, "lab": name, "made": "x"})
    rows = calibrated(folder)
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x", metadata=files[serial[0]][0]))
    stated = json.loads(pq.read_schema(folder.parent / "cals.parquet").metadata[b"mwdcal"])
    assert stated["made"] == "x"
    assert not {"lab", "declination_deg", "azimuth_reference"} & set(stated)
    assert "azimuths count from 3 norths, 0° to 7.5° from magnetic" in ran(folder).err


def test_a_broken_parquet_file_costs_the_run_files_beside_it_nothing(folder):
    shutil.copy(EXAMPLE / "run.csv", folder / "a.csv")
    (folder / "b.parquet").write_text("no table", "utf-8")
    done = ran(folder)
    assert done.code == 0, done.err
    status = {
        r["serial"]: r["status"] for r in pq.read_table(folder.parent / "o.parquet").to_pylist()
    }
    assert status == {"SIM-0001": "ok", "b": "bad-input"}


def test_mixed_rows_keep_the_azimuths_of_their_file(folder):
    runs = {f"T{i}": short_run(i) for i in range(4)}
    for name, serials, metadata in (("a", ("T0", "T1"), {}), ("b", ("T2", "T3"), TRUE)):
        offset = metadata.get("declination_deg", 0)
        own = {s: turned(runs[s], offset) for s in serials}
        path = write_fleet(folder / f"{name}.parquet", own, metadata)
        table = pq.read_table(path)
        order = np.argsort(np.tile(np.arange(28), 2), kind="stable")
        pq.write_table(table.take(pa.array(order)), path)
    rows = calibrated(folder)
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x"), 1e-8)


def test_a_tool_with_rows_of_two_norths_is_refused_by_name(folder):
    write_fleet(folder / "a.parquet", {"T1": short_run(1), "T2": short_run(2)})
    write_fleet(folder / "b.parquet", {"T2": short_run(3), "T3": turned(short_run(4), 7.5)}, TRUE)
    rows = calibrated(folder)
    assert [rows[s]["status"] for s in ("T1", "T2", "T3")] == ["ok", "bad-input", "ok"]
    assert "serial T2 of runs/*.parquet: the azimuths of a tool must count" in rows["T2"]["message"]
    assert "from 0° and 7.5° from magnetic" in rows["T2"]["message"]


def test_a_north_without_its_declination_is_refused_with_the_file(folder):
    write_fleet(folder / "a.parquet", {"T1": short_run(1)})
    write_fleet(folder / "b.parquet", {"T2": short_run(2)}, {"azimuth_reference": "true"})
    message = refused(ran(folder), 2)
    assert "b.parquet: true azimuths need the metadata 'declination_deg'" in message


def test_one_simulated_file_makes_a_simulated_fleet(folder):
    write_fleet(folder / "a.parquet", {"T1": short_run(1)}, {"simulated": False})
    write_fleet(folder / "b.parquet", {"T2": short_run(2)}, {"simulated": True})
    calibrated(folder)
    stated = json.loads(pq.read_schema(folder.parent / "cals.parquet").metadata[b"mwdcal"])
    assert stated["simulated"] is True


# Serials


def rewritten(path, **kinds):
    """The table at a path with columns of other types."""
    table = pq.read_table(path)
    for name, kind in kinds.items():
        place = table.column_names.index(name)
        table = table.set_column(place, name, table.column(name).cast(kind))
    pq.write_table(table, path)


def test_serials_that_are_numbers_in_one_file_and_text_in_another(folder):
    first = write_fleet(folder / "a.parquet", {7: short_run(1), 8: short_run(2)})
    write_fleet(folder / "b.parquet", {"8": short_run(3), "007": short_run(4)})
    rows = calibrated(folder)
    assert list(rows) == ["7", "8", "007"]
    assert [row["stations"] for row in rows.values()] == [28, 56, 28]
    for kind in (pa.int32(), pa.large_string(), pa.dictionary(pa.int8(), pa.string())):
        rewritten(first, serial=kind)
        assert calibrated(folder) == rows


def test_columns_of_different_types_in_different_files(folder):
    sets = [str(1 + i // 7) for i in range(28)]
    runs = {f"T{i}": {**roll_run(i), "group": sets} for i in (1, 2)}
    paths = [write_fleet(folder / f"{s}.parquet", {s: runs[s]}) for s in runs]
    expected = calibrated(folder)
    for kind in (pa.large_string(), pa.int64(), pa.float64()):
        rewritten(paths[0], group=kind, ref_gravity_g=pa.int64(), ref_field_nt=pa.float32())
        rewritten(paths[1], ref_gravity_g=pa.decimal128(12, 3))
        assert calibrated(folder) == expected


@pytest.mark.parametrize("blank", [None, ""])
def test_a_blank_serial_is_refused(folder, blank):
    path = write_fleet(folder / "a.parquet", {"T1": short_run(1)})
    table = pq.read_table(path)
    serials = pa.array(["T1"] * 9 + [blank] * 19)
    pq.write_table(table.set_column(0, "serial", serials), path)
    assert "row 10, column 'serial': must be filled in" in refused(ran(folder), 2)


# Folders


def in_folders(folder, runs):
    """Each run in the folder that its key names, without a column of serials."""
    for name, columns in runs.items():
        part = folder / name
        part.mkdir(parents=True)
        whole = pq.read_table(write_fleet(folder / "x.parquet", {"": columns}))
        pq.write_table(whole.drop_columns(["serial"]), part / "0.parquet")
    (folder / "x.parquet").unlink()


def test_names_of_folders_are_decoded(folder):
    serials = ["A/B 1", "Ünï 100%", "007"]
    in_folders(folder, {f"serial={quote(s, safe='')}": short_run(i) for i, s in enumerate(serials)})
    rows = calibrated(folder)
    assert set(rows) == set(serials)
    for index, serial in enumerate(serials):
        check_same(rows[serial], alone(short_run(index), "x"))


def test_a_folder_that_stands_for_a_blank_serial_is_refused(folder):
    blank = "serial=__HIVE_DEFAULT_PARTITION__"
    in_folders(folder, {"serial=A": short_run(1), blank: short_run(2)})
    message = refused(ran(folder), 2)
    assert f"'{blank}' stands for a blank cell" in message
    shutil.move(folder / blank, folder / "serial=")
    assert "'serial=' stands for a blank cell" in refused(ran(folder), 2)


def test_folders_that_state_a_number(folder):
    runs = {s: {**short_run(i), "ref_field_nt": None} for i, s in enumerate("AB")}
    runs = {s: {k: v for k, v in c.items() if v is not None} for s, c in runs.items()}
    in_folders(folder, {f"ref_field_nt=5e4/serial={s}": c for s, c in runs.items()})
    rows = calibrated(folder)
    for serial, columns in runs.items():
        check_same(rows[serial], alone({**columns, "ref_field_nt": np.full(28, 5e4)}, "x"))
    shutil.move(folder / "ref_field_nt=5e4", folder / "ref_field_nt=weak")
    assert "the folder says 'weak'" in refused(ran(folder), 2)


def test_tools_with_rows_in_several_folders_are_counted(folder):
    for year, serials in ((2024, "ABC"), (2025, "CBD")):
        part = folder / f"year={year}"
        part.mkdir()
        write_fleet(part / "0.parquet", {s: short_run(ord(s) + year) for s in serials})
    page = folder.parent / "fleet.html"
    said = ran(folder, "--report", page)
    for text in (said.err, page.read_text("utf-8")):
        assert "tools with rows in several folders: 2" in text
        assert "calibrate folder by folder" in text
    rows = calibrated(folder)
    assert {s: row["stations"] for s, row in rows.items()} == {"A": 28, "B": 56, "C": 56, "D": 28}
    year = mwdcal("fleet", folder / "year=2024", "-o", folder.parent / "o.parquet")
    assert "several folders" not in year.out + year.err


def test_text_where_numbers_belong_is_refused_with_the_remedy(folder):
    path = write_fleet(folder / "a.parquet", {"T1": short_run(1)})
    rewritten(path, ax=pa.string())
    assert "pandas.to_numeric(table['ax'])" in refused(ran(folder), 2)
