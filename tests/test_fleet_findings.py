"""What `calibrate` says of a tool, said of each tool of a fleet: in its row, on screen and page."""

import re

import numpy as np
import pytest
from scipy.special import chdtrc

from cli_support import mwdcal
from mwdcal.calibration.residuals import tail
from test_fleet import (
    alone,
    calibrated,
    check_same,
    servo_run,
    short_run,
    warm_run,
    write_fleet,
)

pq = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.usefixtures("without_pictures")


def spoiled(seed, station=7, by=0.05, **changes):
    """A run with one reading that is off."""
    columns = short_run(seed, **changes)
    columns["az"] = columns["az"].copy()
    columns["az"][station] += by
    return columns


def troubled():
    """Runs with a finding each, some with several."""
    whole = short_run(4)
    again = {name: np.concatenate([v, v[3:5]]) for name, v in whole.items()}
    return {
        "fine": short_run(1),
        "off": spoiled(2),
        "a little off": spoiled(3, by=0.005),
        "named": {**spoiled(5), "station": [f"p{i}" if i % 2 else "" for i in range(28)]},
        "copies": again,
        "relative": short_run(6, ref_field_nt=np.full(28, np.nan)),
        "weightless": short_run(9, ref_gravity_g=np.full(28, np.nan)),
        "bare": servo_run(7, inclinations=(10, 80, 110, 140), toolfaces=1),
        "alone": spoiled(8, mx=None, my=None, mz=None),
    }


@pytest.mark.parametrize("tool", ["servo", "generic"])
@pytest.mark.parametrize("method", ["joint", "least-squares", "newton"])
def test_findings_are_those_of_each_tool_alone(tmp_path, method, tool):
    runs = troubled()
    if method == "newton":
        del runs["relative"]
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs), "--method", method, tool=tool)
    seen = set()
    for serial, columns in runs.items():
        made = alone(columns, "x", tool=tool, method=method)
        if isinstance(made, Exception):
            assert rows[serial]["findings"] is None
            continue
        check_same(rows[serial], made, 1e-6)
        seen |= set(rows[serial]["findings"])
    assert {"reshoot", "repeated-readings"} <= seen
    assert ("accelerometer-residuals" in seen) == (tool == "servo")
    if rows["named"]["status"] == "ok":
        assert rows["named"]["reshoot"] == ["p7"]


def with_copies(columns, *places):
    """A run with copies of some stations at its end, all of the 31 stations labelled."""
    every = np.append(np.arange(28), places)
    columns = {name: np.asarray(values)[every] for name, values in columns.items()}
    return {**columns, "station": [f"s{i}" for i in range(31)]}


def copied():
    """Runs of one kind with copies of the same and of other stations; one knows the field at a copy alone."""
    front = {name: np.roll(v, 3) for name, v in with_copies(spoiled(4, 20), 0, 1, 2).items()}
    field = np.where(np.arange(28) == 27, short_run(5)["ref_field_nt"], np.nan)
    known = with_copies(short_run(5, ref_field_nt=field), 0, 0, 27)
    lost = with_copies(short_run(7, ref_field_nt=np.full(28, np.nan)), 0, 0, 27)
    lost["ref_field_nt"][28] = field[27]
    return {
        "none": with_copies(short_run(1), 0, 1, 2) | short_run(1, station=range(28)),
        "three": with_copies(short_run(2), 3, 4, 5),
        "same three": with_copies(spoiled(3), 3, 4, 5),
        "in front": {**front, "station": [f"s{i}" for i in range(31)]},
        "field at one": known,
        "field at a copy": lost,
    }


def test_copies_are_left_out_as_of_each_tool_alone(tmp_path):
    """Also where others of the batch have other copies."""
    runs = copied()
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs))
    for serial, columns in runs.items():
        made = alone(columns, "x")
        check_same(rows[serial], made, 1e-10)
        assert made.stations == 28
        assert ("repeated-readings" in rows[serial]["findings"]) == (serial != "none")
    assert rows["in front"]["reshoot"] == ["s23"]


def test_a_tool_that_cannot_do_without_its_copies_is_refused_as_alone(tmp_path):
    warm = {seed: warm_run(seed) for seed in (1, 2)}
    half = {name: np.asarray(v)[:48] for name, v in warm[2].items()}
    half["temperature_c"] = np.full(48, 20.0)
    warm[2] = {name: np.append(v, v) for name, v in half.items()}
    warm[2]["temperature_c"] = np.repeat([20.0, 60.0], 48)
    path = write_fleet(tmp_path / "runs.parquet", {str(k): v for k, v in warm.items()})
    rows = calibrated(path, "--order", 1)
    assert (rows["1"]["status"], rows["2"]["status"]) == ("ok", "temperature-span")
    assert rows["2"]["message"] == str(alone(warm[2], "x", order=1))


@pytest.mark.parametrize(
    "options", [{"robust": "student-t"}, {"parameters": 6}, {"parameters": 9, "model": "factors"}]
)
def test_findings_of_options(tmp_path, options):
    runs = {serial: columns for serial, columns in troubled().items() if serial != "bare"}
    asked = [part for name, value in options.items() for part in (f"--{name}", value)]
    rows = calibrated(write_fleet(tmp_path / "runs.parquet", runs), *asked)
    expected = "distrusted" if "robust" in options else "restricted"
    assert any(expected in (row["findings"] or ()) for row in rows.values())
    for serial, columns in runs.items():
        made = alone(columns, "x", **options)
        if isinstance(made, Exception):
            assert rows[serial]["message"].split(":")[-1] == str(made).split(":")[-1]
        else:
            check_same(rows[serial], made, 1e-5)


def test_no_station_to_reshoot_escapes_the_bound(tmp_path):
    """Many runs of few and many stations, with errors from none to plain."""
    runs = {f"{seed}-{by}": spoiled(seed, by=by) for seed in range(8) for by in (0.0, 3e-3, 4e-3)}
    found = {method: calibrated(
        write_fleet(tmp_path / "runs.parquet", runs), "--method", method
    ) for method in ("joint", "least-squares")}  # fmt: skip
    some = 0
    for method, rows in found.items():
        for serial, columns in runs.items():
            made = alone(columns, "x", method=method)
            assert rows[serial]["reshoot"] == [r.station for r in made.station_rows if r.reshoot]
            some += bool(rows[serial]["reshoot"])
    assert 3 < some < 45


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 6])
def test_the_chance_of_a_larger_chi_square(freedom):
    square = np.array([0.0, 1e-3, 0.5, 3.0, 10.0, 30.0, 100.0, 600.0])
    degrees = np.full(square.shape, freedom)
    assert tail(square, degrees) == pytest.approx(chdtrc(freedom, square), 1e-12)
    assert (tail(square, 0 * degrees) == 1).all()
    assert tail(np.array([np.inf]), degrees[:1]) < 1e-290


# Screen and page


def said(tmp_path, runs, *options):
    path = write_fleet(tmp_path / "runs.parquet", runs)
    page = tmp_path / "fleet.html"
    ran = mwdcal(
        "fleet", path, "-o", tmp_path / "o.parquet", "--tool", "servo", "--workers", 1,
        "--report", page, *options,
    )  # fmt: skip
    assert ran.code == 0, ran
    return ran, re.sub(r"<svg.*?</svg>", "", page.read_text("utf-8"), flags=re.S)


def test_screen_and_page_name_the_doubtful_tools(tmp_path):
    runs = troubled()
    del runs["bare"]
    ran, page = said(tmp_path, runs)
    assert "! accelerometer-residuals in 4 tools: off, a little off, named, alone" in ran.err
    assert "! repeated-readings in 1 tool: copies" in ran.err
    assert "All calibrated" not in page
    assert "Some doubtful" in page
    assert "4 tools doubtful: residuals of the accelerometer are larger" in page
    assert "5 doubtful, none verified yet" in page
    assert "looks-like" not in ran.out + ran.err
    ran, _ = said(tmp_path, runs, "--json")
    first = ran.json["findings"][0]
    assert first == {
        "id": "accelerometer-residuals",
        "tools": 4,
        "serials": ["off", "a little off", "named", "alone"],
    }
    _, page = said(tmp_path, {"fine": short_run(1)})
    assert "All calibrated" in page


def parameter(page, sensors, title):
    """Cells of a row of the page's table of parameters."""
    cells = rf"<tr><td>{sensors}</td><td class=\"text\">{title}</td>(.*?)</tr>"
    found = re.search(cells, page)
    return re.findall(r"<td>(.*?)</td>", found[1]) if found else None


def test_a_tool_without_a_magnetometer_leaves_the_table_of_the_others(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(3)}
    _, whole = said(tmp_path, runs)
    _, page = said(tmp_path, {**runs, "none": short_run(9, mx=None, my=None, mz=None)})
    expected = parameter(whole, "magnetometer", "gain xx")
    assert expected[0] == "3"
    assert "–" not in expected
    assert parameter(page, "magnetometer", "gain xx") == expected
    assert parameter(page, "magnetometer", "offset x")[-1] == "nT"
    assert parameter(page, "accelerometer", "gain xx")[0] == "4"


def test_relative_magnetometers_are_apart_from_those_in_nt(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(24)}
    _, whole = said(tmp_path, runs)
    relative = short_run(50, ref_field_nt=np.full(28, np.nan))
    ran, page = said(tmp_path, {**runs, "R": relative})
    for title in ("gain xx", "offset x"):
        assert parameter(page, "magnetometer", title) == parameter(whole, "magnetometer", title)
    assert parameter(page, "magnetometer, field = 1", "gain xx")[0::5] == ["1", "1/nT"]
    assert parameter(page, "magnetometer, field = 1", "offset x")[0::5] == ["1", "of the field"]
    assert "No tool has a parameter farther" in page
    assert "! field-unknown in 1 tool: R" in ran.err
