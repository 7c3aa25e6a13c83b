"""Many tools in one table: as `calibrate` has each alone, bad ones too; parts, restart, cluster."""

import importlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from cli_support import (
    SERVO_NOISE,
    channels,
    mwdcal,
    process,
    refused,
    servo_run,
    stations,
)
from mwdcal import extras
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import typical_accuracy
from mwdcal.errors import InputError, MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.estimation.uncertainty import free_directions
from mwdcal.files.formats import table as tables
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import to_readings
from mwdcal.fleet.calibrate import column, names
from simulation import DEG, Tool, attitude, plan

MWDCAL = (sys.executable, "-m", "mwdcal")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

from mwdcal import pool  # noqa: E402
from mwdcal.files.formats import atomic  # noqa: E402
from mwdcal.fleet import sources  # noqa: E402
from mwdcal.fleet import tables as fleet_tables  # noqa: E402
from mwdcal.fleet.parts import Plan, Task, calibrations, load  # noqa: E402

ANGLES = ("inclination", "azimuth", "toolface")


def short_run(seed, **changes):
    """A run of 28 stations with its temperature, and some columns changed or left out (None)."""
    columns = servo_run(seed, inclinations=(10, 60, 90, 130), toolfaces=7)
    columns |= {name: value for name, value in changes.items() if value is not None}
    return {k: v for k, v in columns.items() if k not in changes or changes[k] is not None}


def warm_run(seed):
    return servo_run(seed, (10, 60, 90, 130), 6, temperatures=(20.0, 60.0, 100.0, 140.0))


def write_fleet(path, tools, metadata=None, **options):
    """A Parquet table of runs by serial; columns that a run lacks are blank."""
    every = list(dict.fromkeys(name for columns in tools.values() for name in columns))
    parts = {"serial": [], **{name: [] for name in every}}
    for serial, columns in tools.items():
        count = len(columns["ax"])
        parts["serial"] += [serial] * count
        for name in every:
            blank = [None] * count
            cells = columns.get(name, blank)
            text = name in ("station", "group")
            parts[name] += [None if c is None else str(c) if text else float(c) for c in cells]
    arrays = {name: pa.array(cells, from_pandas=True) for name, cells in parts.items()}
    table = pa.table(arrays)
    if metadata:
        table = table.replace_schema_metadata({b"mwdcal": json.dumps(metadata).encode()})
    pq.write_table(table, path, **options)
    return path


def calibrated(path, *options, tool="servo", code=0):
    """The table of calibrations as rows by serial."""
    output = path.with_name("cals.parquet")
    ran = mwdcal(
        "fleet", path, "-o", output, "--tool", tool, "--workers", 1, "--no-records", *options
    )
    assert ran.code == code, ran
    return {row["serial"]: row for row in pq.read_table(output).to_pylist()}


def alone(columns, source, first=1, metadata=None, tool="servo", **options):
    """The calibration of one run by itself, or the error that refuses it."""
    cells = {
        name: [str(v) for v in values]
        if name in ("station", "group")
        else np.asarray(values, float)
        for name, values in columns.items()
    }
    lines = range(first, first + len(columns["ax"]))
    table = tables.Table(cells, {"serial": "alone"} | (metadata or {}), source, lines)
    try:
        readings, profile = to_readings(table, load_profile(tool)[0])
        return calibrate(readings, profile, Options(**{"order": 0, "nonlinearity": (), **options}))
    except MwdcalError as error:
        return error


def check_same(row, made, tolerance=1e-9):
    """The row of a tool says what its calibration file says."""
    assert row["status"] == "ok", row["message"]
    assert row["stations"] == made.stations
    free = {u.id for triad in made.triads for u in triad.undetermined}
    assert row["findings"] == list(dict.fromkeys(f.id for f in made.findings if f.id not in free))
    assert row["reshoot"] == [each.station for each in made.station_rows if each.reshoot]
    assert row["field_unit"] == (made.field_unit if made.has_field else None)
    for triad in made.triads:
        assert row[f"{triad.name}_rank"] == triad.rank
        assert row[f"{triad.name}_size"] == triad.size
        assert row[f"{triad.name}_undetermined"] == [u.id for u in triad.undetermined]
        for name in ("noise", "variance_factor", "degrees_of_freedom"):
            assert row[f"{triad.name}_{name}"] == pytest.approx(getattr(triad, name), tolerance)
        for name, value, sd in zip(
            triad.parameter_names, triad.parameters, triad.standard_uncertainties, strict=True
        ):
            own = column(triad.name, name)
            assert row[own] == pytest.approx(value, tolerance, tolerance * (sd or 1e-3))
            expected = sd if sd is None else pytest.approx(sd, tolerance)
            assert row[f"{own}_sd"] == expected
    for angle, sd in typical_accuracy(made).items():
        expected = sd if sd is None else pytest.approx(sd, tolerance)
        assert row[f"{angle}_sd_deg"] == expected
    earth = {"gravity_g": 1e-9, "field": 1e-9, "dip_deg": 1e-9}
    for name in earth:
        if name in made.earth:
            assert row[name] == pytest.approx(made.earth[name], tolerance)


# Agreement with `calibrate`


@pytest.mark.parametrize("method", ["joint", "least-squares", "scalar", "newton"])
@pytest.mark.parametrize("order", [0, 1])
def test_each_tool_is_calibrated_as_it_is_alone(tmp_path, method, order):
    runs = {f"T{seed}": (warm_run if order else short_run)(seed) for seed in range(4)}
    rows = calibrated(
        write_fleet(tmp_path / "runs.parquet", runs), "--method", method, "--order", order
    )
    assert list(rows) == list(runs)
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x", method=method, order=order))


def roll_run(seed, alone=0):
    """Four roll sets of unknown directions, and some stations without a set."""
    inc = np.repeat([5.0, 45.0, 95.0, 140.0], 7) * DEG
    azi = np.repeat([10.0, 100.0, 190.0, 280.0], 7) * DEG
    face = np.tile(np.arange(7) * 2 * np.pi / 7, 4)
    tool = Tool.random(seed, noise=SERVO_NOISE)
    g, b = (v[0] for v in tool.readings(np.random.default_rng(seed), 1, inc, azi, face))
    group = [f" {chr(100 - i // 7)} " if i >= alone else "" for i in range(28)]
    columns = stations(inc, azi, face, earth=(1.0, 5e4, tool.dip / DEG), group=group)
    columns |= {f"ref_{a}_deg": np.full(28, np.nan) for a in ANGLES}
    return {**columns, **channels(g, b)}


def evidence_patterns():
    """Runs that know different things, two of each kind."""
    blank = np.full(28, np.nan)
    half = np.where(np.arange(28) % 2, np.nan, 1.0)
    noise = {f"sd_{c}": np.full(28, 2e-4) for c in ("ax", "ay", "az")}
    angles = {f"ref_{a}_deg": blank for a in ANGLES}
    kinds = {
        "whole": {},
        "no-azimuth": {"ref_azimuth_deg": blank, "ref_dip_deg": np.full(28, np.nan)},
        "no-field": {"ref_field_nt": blank},
        "half": {"ref_inclination_deg": short_run(1)["ref_inclination_deg"] * half},
        "noise": noise,
        "uncertain": {"sd_ref_field_nt": np.full(28, 30.0), "sd_ref_dip_deg": np.full(28, 0.1)},
        "alone": dict.fromkeys(("mx", "my", "mz")),
        "cold": {"temperature_c": None},
        "free": angles,
    }
    found = {
        f"{name}-{seed}": short_run(seed, **changes)
        for seed in (1, 2)
        for name, changes in kinds.items()
    }
    return found | {"rolls-1": roll_run(1), "rolls-2": roll_run(2, alone=1)}


def test_tools_of_different_evidence_are_calibrated_as_they_are_alone(tmp_path):
    runs = evidence_patterns()
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x"), 1e-8)


def test_tools_with_fewer_settings_of_the_stand_than_those_refused_beside_them(tmp_path):
    """Directions at which the first tool's stand serves two stations; the other's serves one everywhere."""
    place = np.sort(np.append(np.arange(26), [3, 9]))
    runs = {
        "refused": {k: np.asarray(v)[place] for k, v in short_run(1).items()},
        "fine": short_run(2),
    }
    runs["refused"]["ax"] = np.roll(runs["refused"]["ax"], 5)
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    assert rows["refused"]["status"] == "residuals"
    check_same(rows["fine"], alone(runs["fine"], "x"))


def test_a_profile_without_scale_or_noise_is_filled_in_per_tool(tmp_path):
    runs = {f"T{seed}": short_run(seed) for seed in range(3)}
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs), tool="generic")
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x", tool="generic"), 1e-6)


@pytest.mark.parametrize(
    "stand", ["", "azimuth_deg = 0.05"], ids=["closed form", "uncertain stand"]
)
def test_a_declared_drift_is_that_of_each_tool_alone(tmp_path, stand):
    """No noise is declared: each tool's is told apart from the drift in as many rounds as alone. 0.6 mV is 0.2 mg."""
    profile = tmp_path / "tool.toml"
    triads = "[accelerometer]\nscale = 3.0\ndrift = 6e-4\n[magnetometer]\nscale = 5e-5\n"
    profile.write_text(f'name = "t"\n{triads}[stand]\nfield_drift_nt = 40\n{stand}')
    runs = {f"T{seed}": short_run(seed) for seed in range(3)}
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs), tool=str(profile))
    for serial, columns in runs.items():
        made = alone(columns, "x", tool=str(profile))
        declared = {each.name: each.declared for each in made.drift}
        assert declared == pytest.approx({"field": 40.0, "accelerometer": 0.2})
        check_same(rows[serial], made)


def test_factors_and_true_azimuths(tmp_path):
    metadata = {"azimuth_reference": "true", "declination_deg": 7.5}
    runs = {f"T{seed}": short_run(seed) for seed in range(3)}
    for columns in runs.values():
        columns["ref_azimuth_deg"] = (columns["ref_azimuth_deg"] + 7.5) % 360
    path = write_fleet(tmp_path / "runs.parquet", runs, metadata)
    rows = calibrated(path, "--model", "factors")
    for serial, columns in runs.items():
        check_same(rows[serial], alone(columns, "x", metadata=metadata, model="factors"))


def test_ragged_runs_with_rows_of_tools_in_any_order(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(6)}
    runs = {s: {k: v[: 28 - i % 3] for k, v in c.items()} for i, (s, c) in enumerate(runs.items())}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    expected = calibrated(path)
    assert [row["stations"] for row in expected.values()] == [28, 27, 26, 28, 27, 26]
    table = pq.read_table(path)
    whose = np.random.default_rng(0).permutation(table["serial"].to_pylist())
    place = {s: iter(np.flatnonzero(np.array(table["serial"]) == s)) for s in runs}
    order = [int(next(place[s])) for s in whose]  # stations in the order that they were taken in
    pq.write_table(table.take(pa.array(order)), path, row_group_size=50)
    mixed = calibrated(path)
    assert set(mixed) == set(expected)
    for serial, row in mixed.items():
        for name, value in row.items():
            same = pytest.approx(value, 1e-9, 1e-12) if isinstance(value, float) else value
            assert expected[serial][name] == same


def test_serials_may_be_categories_in_another_order(tmp_path):
    runs = {f"T{seed}": short_run(seed) for seed in (2, 0, 1)}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    expected = calibrated(path)
    table = pq.read_table(path)
    codes = [int(serial[1:]) for serial in table.column("serial").to_pylist()]
    names = pa.array(["T0", "T1", "T2", "nobody"])
    coded = pa.DictionaryArray.from_arrays(pa.array(codes, pa.int8()), names)
    pq.write_table(table.set_column(0, "serial", coded), path, row_group_size=30)
    assert calibrated(path) == expected


def test_rows_that_are_mixed_too_much_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(fleet_tables, "MOST_STRETCHES", 2)
    path = write_fleet(tmp_path / "runs.parquet", {i: short_run(i) for i in range(3)})
    ran = mwdcal("fleet", path, "-o", tmp_path / "out.parquet")
    assert "Sort the table by 'serial'" in refused(ran, 2)


def test_serials_may_be_numbers_and_stay_so(tmp_path):
    runs = {7: short_run(7), 3: short_run(3)}
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    assert list(rows) == [7, 3]


def test_a_folder_with_one_tool_in_each_part(tmp_path):
    runs = {f"T{seed}": short_run(seed) for seed in range(3)}
    expected = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    folder = tmp_path / "runs"
    for serial, columns in runs.items():
        part = folder / f"serial={serial}"
        part.mkdir(parents=True)
        whole = pq.read_table(write_fleet(tmp_path / "one.parquet", {serial: columns}))
        pq.write_table(whole.drop_columns(["serial"]), part / "0.parquet")
    assert calibrated(folder) == expected


def test_the_table_says_what_it_is(tmp_path):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)}, {"simulated": True})
    calibrated(path)
    made = tables.read(tmp_path / "cals.parquet")
    assert made.metadata["simulated"] is True
    assert made.metadata["profile"] == load_profile("servo")[0].name
    assert list(made.columns)[:4] == ["serial", "status", "message", "stations"]
    assert set(names(Options(order=0), load_profile("servo")[0])) <= set(made.columns)


# Bad tools


def bad_tools():
    """Runs that `calibrate` refuses, by the status that a fleet gives them."""
    good = short_run(1)
    blank = good["ay"].copy()
    blank[3] = np.nan
    far = good["ref_inclination_deg"].copy()
    far[5] = 400.0
    scattered = good["ax"] + np.random.default_rng(1).normal(0, 0.5, 28)
    return {
        "bad-input": {**good, "ay": blank},
        "bad-input-range": {**good, "ref_inclination_deg": far},
        "bad-input-temperature": {**good, "temperature_c": np.where(blank == blank, 20.0, np.nan)},
        "too-few-stations": {n: v[:3] for n, v in good.items()},
        "channel": {**good, "mz": np.full(28, 2.0)},
        "channel-scale": {**good, "mx": good["mx"] * 1e6},
        "gain": {**good, "mx": -good["mx"]},
        "earth": {
            **good,
            **{n: good[n] * 2 for n in ("mx", "my", "mz")},
            "ref_field_nt": np.full(28, 1e5),
        },
        "earth-dip": {
            **good,
            **{n: -good[n] for n in ("mx", "my", "mz")},
            "ref_dip_deg": np.full(28, np.nan),
        },
        "gain-unit": {n: v * 9.81 if n in ("ax", "ay", "az") else v for n, v in good.items()},
        "residuals": {**good, "ax": scattered},
        "weak-geometry": servo_run(1, inclinations=(5, 45, 90), toolfaces=4),
    }


def statuses(serial):
    return (
        serial.removesuffix("-range")
        .removesuffix("-dip")
        .removesuffix("-temperature")
        .removesuffix("-scale")
    )


@pytest.mark.parametrize("method", ["joint", "scalar"])
def test_what_calibrate_refuses_is_refused_for_the_same_reason(tmp_path, method):
    runs = {"good": short_run(2), **bad_tools(), "good-too": short_run(3)}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    rows = calibrated(path, "--method", method)
    first, seen = 1, set()
    for serial, columns in runs.items():
        expected = alone(columns, f"serial {serial} of runs.parquet", first, method=method)
        first += len(columns["ax"])
        if isinstance(expected, MwdcalError):
            assert rows[serial]["message"] == str(expected), serial
            assert rows[serial]["status"] != "ok"
            assert rows[serial]["accelerometer_gain_xx"] is None
            assert isinstance(expected, InputError) == (rows[serial]["status"] == "bad-input")
            seen.add(rows[serial]["status"])
            if method == "joint":
                assert rows[serial]["status"] == statuses(serial).removesuffix("-unit")
        else:
            check_same(rows[serial], expected)
    assert "serial bad-input of runs.parquet, row 32, column" in rows["bad-input"]["message"]
    assert len(seen) == 6 + (method == "scalar"), seen
    assert ("weak-geometry" in seen) == (method == "scalar")


def test_references_that_a_method_needs(tmp_path):
    runs = {"whole": short_run(1), "lacking": short_run(2, ref_toolface_deg=np.full(28, np.nan))}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    rows = calibrated(path, "--method", "least-squares")
    assert [row["status"] for row in rows.values()] == ["ok", "missing-reference"]
    expected = alone(runs["lacking"], "x", method="least-squares")
    assert rows["lacking"]["message"] == str(expected)


def test_temperatures_that_an_order_needs(tmp_path):
    runs = {"warm": warm_run(1), "cold": short_run(2), "none": short_run(3, temperature_c=None)}
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs), "--order", 1)
    statuses = ["ok", "temperature-span", "bad-input"]
    assert [row["status"] for row in rows.values()] == statuses
    for serial in ("cold", "none"):
        expected = alone(runs[serial], f"serial {serial}", order=1)
        assert rows[serial]["message"] == str(expected)
        assert isinstance(expected, InputError) == (rows[serial]["status"] == "bad-input")


def test_one_member_that_stops_the_batch_does_not_stop_the_others(tmp_path, monkeypatch):
    def fragile(readings, options):
        if readings.accelerometer[..., 0, 0].max() > 5:
            raise np.linalg.LinAlgError("no convergence")
        return fit(readings, options)

    monkeypatch.setattr(importlib.import_module("mwdcal.fleet.calibrate"), "fit", fragile)
    runs = {f"T{seed}": short_run(seed) for seed in range(5)}
    runs["T3"]["ax"][0] = 50.0
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    assert [row["status"] for row in rows.values()] == ["ok"] * 3 + ["failed", "ok"]
    assert "alone" in rows["T3"]["message"]


def test_no_tool_calibrated_is_exit_3(tmp_path):
    runs = {"a": bad_tools()["gain"], "b": bad_tools()["channel"]}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    report = tmp_path / "fleet.html"
    rows = calibrated(path, "--report", report, code=3)
    assert {row["status"] for row in rows.values()} == {"gain", "channel"}
    assert "None calibrated" in report.read_text("utf-8")


@pytest.mark.parametrize("method", ["joint", "scalar", "newton", "toolface-inclination"])
def test_free_directions_of_a_batch_are_those_of_each_member(method):
    inc, azi, face = plan((10, 60, 130), 6)
    rng = np.random.default_rng(5)
    g, b = attitude(inc, azi, face)(1.0, 5e4, 60 * DEG)
    gain = np.eye(3) + 0.02 * rng.normal(size=(2, 6, 1, 3, 3))
    a, m = (
        np.einsum("bnij,nj->bni", gain[t], v) + s * rng.normal(size=(6, 18, 3))
        for t, (v, s) in enumerate(((g, 1e-4), (b, 5.0)))
    )
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"gravity": np.ones(18), "field": np.full(18, 5e4), "dip": np.full(18, 60 * DEG)}
    known = {n: np.broadcast_to(v, (6, 18)) for n, v in known.items()}
    sd = {"accelerometer": np.full((6, 18, 3), 1e-4), "magnetometer": np.full((6, 18, 3), 5.0)}
    readings = Readings(a, m, known=known, sd=sd)
    result = fit(readings, Options(method=method))
    parts = result.problem, result.state, result.analysis.determined
    found = free_directions(*parts)
    for index in range(6):
        (expected,) = free_directions(*take(parts, np.array([index])))
        assert [(f.id, f.triads) for f in found[index]] == [(f.id, f.triads) for f in expected]
        for ours, theirs in zip(found[index], expected, strict=True):
            assert ours.direction == pytest.approx(theirs.direction, 1e-6, 1e-9)
    some = take(readings, np.array([4, 1]))
    assert (some.accelerometer == a[[4, 1]]).all()


# Wrong inputs


def test_wrong_inputs(tmp_path):
    good = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    table = pq.read_table(good)
    output = tmp_path / "out.parquet"

    def message(changed, *options, code=2):
        pq.write_table(changed, good)
        return refused(mwdcal("fleet", good, "-o", output, "--tool", "servo", *options), code)

    bare = table.drop_columns(["serial"])
    assert "'serial'" in message(bare)
    assert "Is it 'SN'?" in message(bare.append_column("SN", table.column("serial")))
    assert "ax, ay, az must be present" in message(table.drop_columns(["ax"]))
    assert "Did you mean" in message(
        table.rename_columns(["AX" if n == "ax" else n for n in table.column_names])
    )
    assert "no rows" in message(table.slice(0, 0))
    blank = pa.array([None, *table.column("serial").to_pylist()[1:]])
    assert "row 1, column 'serial'" in message(table.set_column(0, "serial", blank))
    text = pa.array(["x"] * table.num_rows)
    place = table.column_names.index("ax")
    assert "column 'ax': expected numbers" in message(table.set_column(place, "ax", text))
    assert "--order 1 needs" in message(table.drop_columns(["temperature_c"]), "--order", 1)
    assert "--method" in message(table, "--method", "best")
    assert "swarm" in message(table, "--method", "swarm", "--order", 1, code=3)
    assert not output.exists()


def test_wrong_paths(tmp_path):
    good = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    output = tmp_path / "out.parquet"
    assert "no such file" in refused(mwdcal("fleet", tmp_path / "no.parquet", "-o", output), 2)
    assert "Parquet" in refused(mwdcal("fleet", good, "-o", tmp_path / "out.csv"), 2)
    assert "would be lost" in refused(mwdcal("fleet", good, "-o", good), 2)
    assert "folder without" in refused(mwdcal("fleet", _empty(tmp_path), "-o", output), 2)
    inside = mwdcal("fleet", tmp_path, "-o", tmp_path / "out.parquet")
    assert "part of the input" in refused(inside, 2)
    csv = tmp_path / "runs.csv"
    csv.write_text("serial,ax,ay,az\n")
    assert "no stations" in refused(mwdcal("fleet", csv, "-o", output), 2)
    other = tmp_path / "runs.txt"
    other.write_text("serial,ax,ay,az\n")
    assert "Convert" in refused(mwdcal("fleet", other, "-o", output), 2)
    good.write_bytes(b"PAR1 and nothing")
    assert "complete Parquet file" in refused(mwdcal("fleet", good, "-o", output), 2)


@pytest.mark.parametrize("column", ["serial", "az"])
def test_a_table_with_damaged_pages(tmp_path, column):
    """The footer is whole: the damage shows only where the rows of a column are read."""
    path = write_fleet(tmp_path / "runs.parquet", {f"T{i}": short_run(i) for i in range(3)})
    group = pq.read_metadata(path).row_group(0)
    chunks = (group.column(i) for i in range(group.num_columns))
    chunk = next(c for c in chunks if c.path_in_schema == column)
    data = bytearray(path.read_bytes())
    start = chunk.dictionary_page_offset or chunk.data_page_offset
    data[start : start + 12] = b"\xff" * 12
    path.write_bytes(data)
    message = refused(mwdcal("fleet", path, "-o", tmp_path / "out.parquet"), 2)
    assert "complete Parquet file" in message


def _empty(folder):
    found = folder / "empty"
    found.mkdir()
    return found


def test_files_of_a_folder_that_do_not_match(tmp_path):
    folder = _empty(tmp_path)
    write_fleet(folder / "a.parquet", {"T1": short_run(1)})
    write_fleet(folder / "b.parquet", {"T2": short_run(2, ref_dip_deg=None)})
    message = refused(mwdcal("fleet", folder, "-o", tmp_path / "out.parquet"), 2)
    assert "'ref_dip_deg' is in some" in message


def test_order_0_on_a_wide_span_is_mentioned(tmp_path):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": warm_run(1), "T2": short_run(2)})
    ran = mwdcal("fleet", path, "-o", tmp_path / "out.parquet", "--tool", "servo")
    assert "1 tool spans more than 10 °C" in ran.err


# Parts, restart, cluster


def many(path, tools=1200, stations=20, seed=0):
    """A table of simple tools, made by arrays: four parts."""
    rng = np.random.default_rng(seed)
    inc, azi, face = plan((10, 60, 90, 130), stations // 4)
    g, b = attitude(inc, azi, face)(1.0, 5e4, 60 * DEG)
    gain = np.eye(3) + 0.01 * rng.normal(size=(2, tools, 3, 3))
    raw = [
        (np.einsum("tij,nj->tni", gain[i], v) + s * rng.normal(size=(tools, stations, 3))) * k
        for i, (v, s, k) in enumerate(((g, 1e-4, 3.0), (b, 15.0, 5e-5)))
    ]
    serial = pa.array([f"T{i:05d}" for i in range(tools)])
    columns = {"serial": serial.take(pa.array(np.repeat(np.arange(tools), stations)))}
    flat = np.concatenate(raw, -1).reshape(-1, 6)
    columns |= dict(zip(("ax", "ay", "az", "mx", "my", "mz"), flat.transpose(), strict=True))
    angles = dict(zip(ANGLES, (inc, azi, face), strict=True))
    columns |= {f"ref_{n}_deg": np.tile(np.degrees(v), tools) for n, v in angles.items()}
    for name, value in (("ref_gravity_g", 1.0), ("ref_field_nt", 5e4), ("ref_dip_deg", 60.0)):
        columns[name] = np.full(tools * stations, value)
    pq.write_table(pa.table(columns), path)
    return path


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A fleet of four parts and its calibrations."""
    folder = tmp_path_factory.mktemp("fleet")
    path = many(folder / "runs.parquet")
    ran = mwdcal("fleet", path, "-o", folder / "cals.parquet", "--tool", "servo", "--workers", 1)
    assert ran.code == 0, ran
    assert not (folder / "cals.parquet.parts").exists()
    return path, (folder / "cals.parquet").read_bytes()


def test_one_good_run_in_a_hundred_has_a_station_to_take_again(tmp_path):
    """1500 good runs: 15 are expected, with a standard deviation of 4; at a level of 3 %, 45."""
    profile = tmp_path / "tool.toml"
    triads = (("accelerometer", 3.0, 3e-4), ("magnetometer", 5e-5, 7.5e-4))
    lines = [f"[{name}]\nscale = {scale}\nnoise = {noise}" for name, scale, noise in triads]
    profile.write_text("\n".join(['name = "exact stand"', *lines]), "utf-8")
    rows = calibrated(many(tmp_path / "runs.parquet", 1500, seed=1), tool=profile).values()
    assert {row["status"] for row in rows} == {"ok"}
    marked = sum(bool(row["reshoot"]) for row in rows)
    assert 5 <= marked <= 27


@pytest.mark.slow
def test_a_pool_of_processes_writes_the_same_bytes(fleet, tmp_path):
    path, expected = fleet
    output = tmp_path / "cals.parquet"
    ran = mwdcal(
        "fleet", path, "-o", output, "--tool", "servo", "--workers", 2, "--json",
        "--report", tmp_path / "fleet.html",
    )  # fmt: skip
    assert ran.code == 0, ran
    assert output.read_bytes() == expected
    assert ran.json["calibrated"] == ran.json["tools"] == 1200
    assert ran.json["parts"] == 4
    page = (tmp_path / "fleet.html").read_text("utf-8")
    assert page.count("<figure>") == 2
    for text in ("1200 of 1200 tools", "own-axis gain", "nan"):
        assert (text in page) == (text not in ("own-axis gain", "nan"))
    told = {each["id"]: each["tools"] for each in ran.json["findings"]}
    large = [count for name, count in told.items() if name.endswith("-residuals")]
    assert sum(large) <= 10  # of 2400 triads 2.4 exceed the noise by chance, one in a thousand


def by_two_workers(fleet, folder):
    """Arguments that calibrate a fleet by two workers."""
    inputs, output = (fleet[0], "--tool", "servo"), folder / "cals.parquet"
    return ["fleet", *inputs, "-o", output, "--workers", 2]


@pytest.mark.slow
def test_neither_the_command_nor_its_workers_load_pandas(fleet, tmp_path):
    seen, package = tmp_path / "seen", tmp_path / "path" / "pandas.py"
    package.parent.mkdir()
    package.write_text(f"open({str(seen)!r}, 'w').close()\nraise ImportError\n", "utf-8")
    environment = os.environ | {"PYTHONPATH": str(package.parent)}
    command = by_two_workers(fleet, tmp_path)
    subprocess.run([*MWDCAL, *map(str, command)], env=environment, check=True, capture_output=True)
    assert not seen.exists()
    bare = [sys.executable, "-c", "import pyarrow; pyarrow.array([1.0])"]
    subprocess.run(bare, env=environment, check=True)
    assert seen.exists()  # so PyArrow would


def _started(*command):
    """A command in a session of its own."""
    return subprocess.Popen(
        [*MWDCAL, *map(str, command)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def _wait_for_a_part(folder):
    limit = time.monotonic() + 60
    while not list(folder.glob("*.arrow")) and time.monotonic() < limit:
        time.sleep(0.005)


@pytest.mark.slow
def test_an_interrupted_fleet_goes_on_where_it_was(fleet, tmp_path):
    path, expected = fleet
    output = tmp_path / "cals.parquet"
    folder = tmp_path / "cals.parquet.parts"
    command = ["fleet", path, "-o", output, "--tool", "servo", "--workers", 1]
    first = subprocess.Popen(
        [*MWDCAL, *map(str, command)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    _wait_for_a_part(folder)
    first.kill()
    first.wait()
    done = {part: part.stat().st_mtime_ns for part in folder.glob("*.arrow")}
    assert 1 <= len(done) < 4
    assert not output.exists()
    touched = {}

    def watch(steps, tasks, workers, scheduler):
        touched["tasks"] = len(tasks)
        yield from ((i, steps(task)) for i, task in enumerate(tasks))
        touched["times"] = {part: part.stat().st_mtime_ns for part in done}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "results", watch)
        ran = mwdcal(*command)
    assert ran.code == 0
    assert f"{len(done)} done before" in ran.err
    assert touched == {"tasks": 4 - len(done), "times": done}
    assert output.read_bytes() == expected
    assert not folder.exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no such locks on this system")
def test_one_output_is_written_by_one_fleet_at_a_time(fleet, tmp_path):
    path, expected = fleet
    output, folder = tmp_path / "cals.parquet", tmp_path / "cals.parquet.parts"
    command = ["fleet", path, "-o", output, "--tool", "servo", "--workers", 1]
    with atomic.holding(folder / "lock") as ours:
        assert ours
        message = refused(mwdcal(*command), 2)
        assert "another fleet is writing this output. Wait for it" in message
        assert folder.exists()
    assert not folder.exists()
    both = [
        subprocess.Popen(
            [*MWDCAL, *map(str, command)],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, encoding="utf-8",
        )
        for _ in range(2)
    ]  # fmt: skip
    said = {one.communicate()[1].splitlines()[-1]: one.returncode for one in both}
    assert 0 in said.values()
    for words, ended in said.items():
        assert ended == 0 or (ended == 2 and "another fleet" in words)
    assert output.read_bytes() == expected
    assert {each.name for each in tmp_path.iterdir()} == {"cals.parquet"}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no process groups on this system")
def test_an_interruption_from_the_keyboard_leaves_parts_and_no_traceback(tmp_path):
    path = many(tmp_path / "runs.parquet", tools=6000)
    output, folder = tmp_path / "cals.parquet", tmp_path / "cals.parquet.parts"
    command = ["fleet", path, "-o", output, "--tool", "servo", "--workers", 2]
    running = _started(*command)
    _wait_for_a_part(folder)
    os.killpg(running.pid, signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert (running.returncode, out) == (130, "")
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("mwdcal: interrupted")
    assert list(folder.glob("*.arrow"))
    assert not output.exists()


def _of_session(leader):
    """Processes of a session that are alive."""
    listed = subprocess.run(
        ["ps", "-A", "-o", "pid=,sess=,stat="], capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in listed.stdout.splitlines()]
    return [pid for pid, session, state in rows if session == str(leader) and state[0] != "Z"]


PS = pytest.mark.skipif(
    not (sys.platform.startswith("linux") and shutil.which("ps")), reason="asks ps for sessions"
)


@pytest.mark.slow
@PS
def test_an_interruption_while_workers_start_leaves_no_traceback(fleet, tmp_path):
    command = ["fleet", fleet[0], "-o", tmp_path / "cals.parquet", "--tool", "servo"]
    for others, later in ((1, 0.0), (2, 0.0), (2, 0.1), (2, 0.2)):
        running = _started(*command, "--workers", 2)
        limit = time.monotonic() + 60
        while len(_of_session(running.pid)) <= others and time.monotonic() < limit:
            pass
        time.sleep(later)
        os.killpg(running.pid, signal.SIGINT)
        out, err = running.communicate(timeout=60)
        assert (running.returncode, out) == (130, "")
        assert "Traceback" not in err


@pytest.mark.slow
@PS
def test_workers_end_with_the_command_that_was_killed(tmp_path):
    path = many(tmp_path / "runs.parquet", tools=6000)
    output, folder = tmp_path / "cals.parquet", tmp_path / "cals.parquet.parts"
    command = ["fleet", path, "-o", output, "--tool", "servo", "--workers", 2]
    running = subprocess.Popen(
        [*MWDCAL, *map(str, command)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    _wait_for_a_part(folder)
    assert len(_of_session(running.pid)) >= 3
    running.kill()
    running.wait()
    limit = time.monotonic() + 10
    while (left := _of_session(running.pid)) and time.monotonic() < limit:
        time.sleep(0.05)
    for pid in left:
        os.kill(int(pid), signal.SIGKILL)
    assert not left
    assert not output.exists()


def test_other_options_or_input_are_other_parts(fleet):
    path, _ = fleet
    source = sources.open_source(path, load_profile("servo")[0])
    part = fleet_tables.partitions(source, fleet_tables.find_tools(source), path.parent, print)[0]
    profile = load_profile("servo")[0]
    plan = Plan.of(source, profile, Options())
    others = [
        replace(plan, options=Options(order=1)),
        replace(plan, profile=load_profile("generic")[0]),
        replace(plan, version="0"),
        replace(plan, metadata={"declination_deg": 1.0}),
    ]
    keys = [each.key(part) for each in (plan, *others)]
    piece = replace(part.pieces[0], stamp=(1, 1, 1))
    keys.append(plan.key(replace(part, pieces=(piece,))))
    assert len(set(keys)) == len(keys)
    with pytest.raises(InputError, match="same version"):
        calibrations(replace(plan, version="0"), load(plan, Task(part, fleet[0]))[1])


def _die_once(mark, task):
    if not os.path.exists(mark):
        with open(mark, "w"):
            os.kill(os.getpid(), signal.SIGKILL)
    return bytes([task])


def _tripled(task):
    return bytes([3 * task])


def _die(task):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_process_that_dies_loses_nothing(tmp_path):
    from functools import partial

    if not hasattr(signal, "SIGKILL"):
        pytest.skip("no SIGKILL on this system")
    once = pool.Steps(int, partial(_die_once, str(tmp_path / "mark")))
    found = dict(pool.results(once, list(range(6)), 2, None))
    assert found == {i: bytes([i]) for i in range(6)}
    with pytest.raises(InputError, match="fewer `workers`"):
        list(pool.results(pool.Steps(int, _die), [0, 1], 2, None))


@pytest.mark.slow
def test_workers_are_prepared_with_settings_of_their_own(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    before = dict(os.environ)
    with pool.preparing(2):
        assert os.environ["OMP_NUM_THREADS"] == os.environ["MKL_NUM_THREADS"] == "1"
    assert dict(os.environ) == before
    tripled = pool.Steps(int, _tripled)
    assert dict(pool.results(tripled, [1, 2, 3], 2, None)) == {0: b"\3", 1: b"\6", 2: b"\t"}


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads in /proc")
def test_the_process_that_is_copied_has_no_thread_of_a_memory_pool(fleet, tmp_path):
    """Else Python warns from 3.12 on that the copies may hang."""
    script = (
        "import os\nfrom multiprocessing import forkserver\nfrom mwdcal.app import cli\n"
        "from mwdcal.fleet import kept\ntidy = kept.remove\ndef count(folder):\n    tidy(folder)\n"
        "    pid = forkserver._forkserver._forkserver_pid\n"
        "    for each in os.listdir(f'/proc/{pid}/task'):\n"
        "        with open(f'/proc/{pid}/task/{each}/comm') as name:\n"
        "            print('thread', name.read().strip(), flush=True)\n"
        "kept.remove = count\nif __name__ == '__main__':\n    cli.main()\n"
    )
    (tmp_path / "count.py").write_text(script, "utf-8")
    command = by_two_workers(fleet, tmp_path)
    done = subprocess.run(
        [sys.executable, "-W", "always", tmp_path / "count.py", *map(str, command)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "thread python" in done.stdout
    assert "jemalloc" not in done.stdout
    assert "DeprecationWarning" not in done.stderr


@pytest.mark.parametrize("batch", [5, 32_768])
def test_partitions_are_of_whole_tools_and_bounded(tmp_path, monkeypatch, batch):
    monkeypatch.setattr(fleet_tables, "PARTITION_ROWS", (50, 100))
    monkeypatch.setattr(fleet_tables, "ENOUGH_ROWS", 50)
    monkeypatch.setattr(fleet_tables, "BATCH", batch)
    path = write_fleet(
        tmp_path / "runs.parquet", {i: short_run(i) for i in range(9)}, row_group_size=37
    )
    source = sources.open_source(path, load_profile("servo")[0])
    tools = fleet_tables.find_tools(source)
    assert tools.count == 9
    assert tools.together
    parts = fleet_tables.partitions(source, tools, tmp_path, print)
    assert [part.rows for part in parts] == [56, 56, 56, 56, 28]
    whole = pq.read_table(path)
    starts = [sum(part.rows for part in parts[:i]) for i in range(len(parts))]
    for index in (0, 1, 2, 3, 4, 2, 0, 0, 4, 1):
        part, at = parts[index], starts[index]
        own = fleet_tables.read(part, ["serial", "ax"])
        assert own.column("ax").to_pylist() == whole.column("ax").slice(at, part.rows).to_pylist()
        assert own.column("#row").to_pylist() == list(range(at, at + part.rows))


@contextmanager
def cluster(folder, workers=2):
    """A Dask scheduler and workers on this machine: its address and their processes."""
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONWARNINGS": "ignore"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": env, "cwd": folder}
    dask = [sys.executable, "-m", "dask"]
    running = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", address, "--no-dashboard", "--no-show"], **quiet
        )
    ]
    one = ["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    try:
        running += [subprocess.Popen([*dask, *one], **quiet) for _ in range(workers)]
        yield address, running
    finally:
        for each in reversed(running):
            each.kill()
            each.wait()


@pytest.mark.slow
def test_a_cluster_of_two_of_which_one_dies_half_way(tmp_path):
    path = many(tmp_path / "runs.parquet", tools=1500)
    output, folder = tmp_path / "cals.parquet", tmp_path / "cals.parquet.parts"
    with cluster(tmp_path) as (address, (_, *workers)):
        command = ["fleet", path, "-o", output, "--tool", "servo", "--scheduler", address]
        client = subprocess.Popen(
            [*MWDCAL, *map(str, command)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        limit = time.monotonic() + 120
        while len(list(folder.glob("*.arrow"))) < 1 and time.monotonic() < limit:
            assert client.poll() is None, client.communicate()
            time.sleep(0.01)
        before = len(list(folder.glob("*.arrow")))
        workers[0].kill()
        out, err = client.communicate(timeout=300)
    assert client.returncode == 0, err
    assert "Traceback" not in err
    assert before < 5
    assert "1500 tools" in out
    local = tmp_path / "local.parquet"
    assert mwdcal("fleet", path, "-o", local, "--tool", "servo", "--workers", 1).code == 0
    assert output.read_bytes() == local.read_bytes()


def test_a_cluster_without_its_extra(fleet, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    ran = mwdcal("fleet", fleet[0], "-o", tmp_path / "o.parquet", "--scheduler", "tcp://host:8786")
    assert extras.command("parquet,cluster") in refused(ran, 2)


@pytest.mark.slow
def test_no_cluster_there(fleet, tmp_path):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    path, _ = fleet
    ran = process(
        "fleet", path, "-o", tmp_path / "o.parquet", "--scheduler", "nonsense", timeout=90
    )
    assert ran.returncode == 2
    assert "Traceback" not in ran.stderr
    assert "no Dask scheduler answers" in ran.stderr


@pytest.mark.slow
def test_a_scheduler_that_does_not_speak_or_wants_certificates(fleet, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setattr(pool, "CLUSTER_TIMEOUT", 0.5)
    command = ["fleet", fleet[0], "-o", tmp_path / "o.parquet", "--scheduler"]
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        place = f"127.0.0.1:{mute.getsockname()[1]}"
        assert "it is mute" in refused(mwdcal(*command, f"tcp://{place}"), 2)
        assert "distributed.comm.tls" in refused(mwdcal(*command, f"tls://{place}"), 2)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("by", ["SIGKILL", "SIGSTOP"])
def test_a_scheduler_that_falls_silent_ends_the_fleet_and_leaves_its_parts(
    tmp_path, monkeypatch, by
):
    monkeypatch.setattr(pool, "CLUSTER_TIMEOUT", 20.0)
    path = many(tmp_path / "runs.parquet", tools=2400)
    real = pool._finished

    def silenced(client, waiting):
        for count, key in enumerate(real(client, waiting), 1):
            yield key
            if count == 2:
                scheduler.send_signal(getattr(signal, by))
                monkeypatch.setattr(pool, "CLUSTER_TIMEOUT", 2.0)

    monkeypatch.setattr(pool, "_finished", silenced)
    with cluster(tmp_path, 1) as (address, (scheduler, _)):
        ran = mwdcal(
            "fleet", path, "-o", tmp_path / "o.parquet", "--tool", "servo", "--scheduler", address
        )
    assert "the scheduler no longer answers. Finished parts are kept" in refused(ran, 2)
    assert len(list((tmp_path / "o.parquet.parts").glob("*.arrow"))) >= 2


def test_a_fleet_without_records_loads_only_what_it_uses(tmp_path):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1), "T2": short_run(2)})
    script = (
        "import sys\nfrom mwdcal.app.cli import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as end:\n    assert not end.code\n"
        "unused = {'asyncio', 'scipy', 'mwdcal.library.face', 'mwdcal.library.tasks', 'mwdcal.comparison',"
        " 'mwdcal.logs', 'mwdcal.planning', 'mwdcal.presentation.fleet_page'}\n"
        "sys.exit(str(sorted(unused & set(sys.modules))))\n"
    )
    command = [sys.executable, "-c", script, "fleet", str(path), "--tool", "servo"]
    command += ["--workers", "1", "--no-records", "-o", str(tmp_path / "cals.parquet")]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert done.stderr.strip().splitlines()[-1] == "[]"
