"""Several runs in one well: the path goes on, and errors last over a run, a tool or the well as they should."""

from __future__ import annotations

import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE, read_csv, refused, write_csv
from cli_support import mwdcal as cli

ALONE = ("--error-model", "none")
POSITIONS = ("north_m", "east_m", "tvd_m", "sd_north_m", "sd_east_m", "sd_tvd_m")
CUT = 20
STEP = 30.0


@pytest.fixture(scope="module")
def tools(tmp_path_factory):
    """Two calibrations of the example's tool, of different noise of the runs."""
    folder = tmp_path_factory.mktemp("tools")
    run = read_csv(EXAMPLE / "run.csv")
    run["ax"] = [repr(float(cell) + 1e-4 * (-1) ** i) for i, cell in enumerate(run["ax"])]
    write_csv(folder / "again.csv", run, 'serial = "B-2"', "simulated = true")
    for source, name in ((EXAMPLE / "run.csv", "a"), (folder / "again.csv", "b")):
        fit = ("calibrate", source, "--tool", EXAMPLE / "tool.toml", "-o", folder / f"{name}.json")
        assert cli(*fit).code == 0
    return folder / "a.json", folder / "b.json"


def parts(folder, given, cut=CUT):
    """The table of a well, and the same in two."""
    stated = ("simulated = true", "declination_deg = 2.4", "sd_declination_deg = 0.3")
    whole = write_csv(folder / "whole.csv", given, *stated)
    first, second = (
        write_csv(folder / f"{name}.csv", {k: v[rows] for k, v in given.items()}, *stated)
        for name, rows in (("one", slice(None, cut)), ("two", slice(cut, None)))
    )
    return whole, first, second


def surveyed(folder, *typed):
    """The table and the document of a survey."""
    ran = cli("survey", *typed, "-o", folder / "out.csv", "--json")
    assert ran.code == 0, ran
    return read_csv(folder / "out.csv"), ran.json


def straight(steps):
    """A straight hole: the last reading of the example's well at several depths."""
    given = read_csv(EXAMPLE / "well.csv")
    columns = {name: [cells[-1]] * (steps + 1) for name, cells in given.items()}
    columns["station"] = [f"S{i}" for i in range(steps + 1)]
    return columns | {"md_m": [str(1000 + STEP * i) for i in range(steps + 1)]}


def floats(cells):
    return np.array([float(cell) if cell else np.nan for cell in cells])


def test_two_runs_of_one_tool_are_one_well_where_errors_are_of_the_tool(tools, tmp_path):
    """Expected: the survey of the whole table: the calibration and the declination are the same in both."""
    tool, _ = tools
    whole, one, two = parts(tmp_path, read_csv(EXAMPLE / "well.csv"))
    expected, _ = surveyed(tmp_path, tool, whole, *ALONE)
    columns, document = surveyed(tmp_path, tool, one, "--run", tool, two, *ALONE)
    assert columns["run"] == ["1"] * CUT + ["2"] * (36 - CUT)
    for name in (*POSITIONS, "inclination_deg", "azimuth_true_deg", "sd_azimuth_true_deg"):
        np.testing.assert_allclose(
            floats(columns[name]), floats(expected[name]), rtol=1e-9, atol=1e-9, err_msg=name
        )
    assert [run["rows"] for run in document["runs"]] == [CUT, 36 - CUT]
    assert document["end"]["md_m"] == document["runs"][1]["end"]["md_m"] == 1050.0
    assert document["accepted"] == 36


@pytest.mark.parametrize(
    ("declination", "convergence", "expected"),
    [
        (2.4, 1.0, set()),
        (3.2, 1.0, set()),
        (3.3, 1.0, {"declination-disagrees"}),
        (2.4, -1.0, {"convergence-disagrees"}),
    ],
)
def test_runs_of_different_norths_are_named(tools, tmp_path, declination, convergence, expected):
    """Declinations of ± 0.3° each: farther apart than 2σ of their difference, 0.85°."""
    tool, given = tools[0], read_csv(EXAMPLE / "well.csv")
    files = []
    for rows, angles in (
        (slice(None, CUT), (2.4, 1.0)),
        (slice(CUT, None), (declination, convergence)),
    ):
        norths = (f"declination_deg = {angles[0]}", f"convergence_deg = {angles[1]}")
        columns = {k: v[rows] for k, v in given.items()}
        path = tmp_path / f"{len(files)}.csv"
        files.append(write_csv(path, columns, "sd_declination_deg = 0.3", *norths))
    _, document = surveyed(tmp_path, tool, files[0], "--run", tool, files[1])
    found = {f["id"]: f["text"] for f in document["findings"] if f["id"].endswith("-disagrees")}
    assert {*found} == expected
    assert all(text.startswith("run 2: ") for text in found.values())


def test_a_run_takes_the_errors_of_its_own_tool(tools, tmp_path):
    """Expected: independent tools in two halves of a straight hole are less uncertain than one in both."""
    given, (tool, other) = straight(10), tools
    _, one, two = parts(tmp_path, given, 5)
    same = surveyed(tmp_path, tool, one, "--run", tool, two, *ALONE)[1]
    changed = surveyed(tmp_path, tool, one, "--run", other, two, *ALONE)[1]
    serials = [run["serial"] for run in changed["runs"]]
    assert serials == ["SIM-0001", "B-2"]

    def vertical(document):
        causes = document["contributions"]["causes"]
        return next(each for each in causes if each["cause"] == "calibration")["sd_tvd_m"][-1]

    # weights of the stations of both runs: half a course at the ends of the well
    weights = STEP * (5 - 0.5), STEP * (6 - 0.5)
    turn = [
        vertical(surveyed(tmp_path, each, table, *ALONE)[1]) / (STEP * steps)
        for each, table, steps in ((tool, one, 4), (other, two, 5))
    ]
    assert vertical(same) == pytest.approx(sum(weights) * turn[0], rel=0.02)
    assert vertical(changed) == pytest.approx(np.hypot(*np.multiply(weights, turn)), rel=0.02)
    assert vertical(changed) < 0.8 * vertical(same)


def test_terms_last_over_a_run_or_the_well_as_the_model_says(tools, tmp_path):
    """Expected: sag of each run by the courses of its stations, added as squares; declination by the whole length."""
    tool, _ = tools
    _, one, two = parts(tmp_path, straight(10), 5)
    columns, document = surveyed(tmp_path, tool, one, "--run", tool, two)
    inclination = np.radians(float(columns["inclination_deg"][-1]))
    causes = {c["cause"]: c for c in document["contributions"]["causes"]}
    upward = np.radians(0.2) * np.sin(inclination) ** 0.25
    sag = upward * STEP * np.hypot(5 - 0.5, 6 - 0.5)
    assert causes["sag, whole run"]["sd_highside_m"][-1] == pytest.approx(sag, rel=1e-5)
    turned = 10 * STEP * np.sin(inclination) * np.radians(0.3)
    assert causes["declination, whole well"]["sd_lateral_m"][-1] == pytest.approx(turned, rel=1e-5)
    depth = causes["measured depth, whole run"]["sd_along_hole_m"][-1]
    # in proportion to the depth: where the path starts by the first run's, where it ends by the second's
    assert depth == pytest.approx(0.00056 * np.hypot(1000, 1300), rel=1e-5)
    for k, name in enumerate(("north", "east", "tvd")):
        squares = sum(each[f"sd_{name}_m"][-1] ** 2 for each in causes.values())
        stated = floats(columns[f"sd_{name}_m"])[-1]
        assert np.sqrt(squares) == pytest.approx(stated, rel=1e-5), k
        assert document["end"][f"sd_{name}_m"] == pytest.approx(stated)


def test_squares_of_three_runs_add_up_with_a_tie_in_and_in_python(tools, tmp_path):
    tool, other = tools
    given = read_csv(EXAMPLE / "well.csv")
    given["md_m"] = [str(float(cell) + 500) for cell in given["md_m"]]
    _, one, two = parts(tmp_path, given, 12)
    rest = {name: cells[24:] for name, cells in given.items()}
    three = write_csv(
        tmp_path / "three.csv", rest, "declination_deg = 1.4", "sd_declination_deg = 0.4"
    )
    two = write_csv(
        tmp_path / "two.csv", {name: cells[12:24] for name, cells in given.items()},
        "declination_deg = 2.4", "sd_declination_deg = 0.3",
    )  # fmt: skip
    tied = (400.0, 0.5, 20.0, 1.0, 2.0, 400.0)
    well = mwdcal.survey(tool, one, runs=[(other, two), (tool, three)], tie_in=tied)
    parts_of = well.contributions
    for name in ("north_m", "east_m", "tvd_m"):
        each = parts_of[f"sd_{name}"].reshape(36, -1)
        np.testing.assert_allclose(
            np.linalg.norm(each, axis=-1), well.columns[f"sd_{name}"], rtol=1e-9
        )
    turned = well.columns["azimuth_true_deg"] - well.columns["azimuth_magnetic_deg"]
    np.testing.assert_allclose(turned[[0, -1]] % 360, [2.4, 1.4], atol=1e-9)
    typed = (tool, one, "--run", other, two, "--run", tool, three)
    columns, document = surveyed(tmp_path, *typed, "--tie-in", ",".join(map(str, tied)))
    np.testing.assert_allclose(floats(columns["sd_east_m"]), well.columns["sd_east_m"], rtol=1e-9)
    assert well.to_dict()["runs"] == document["runs"]
    assert "run 3   three.csv" in well.summary()
    page = tmp_path / "page.html"
    well.report(page)
    assert "run 2   two.csv" in page.read_text("utf-8")


def test_overlapping_depths_are_left_out_and_norths_must_agree(tools, tmp_path):
    tool, _ = tools
    given = read_csv(EXAMPLE / "well.csv")
    _, one, _ = parts(tmp_path, given)
    late = {name: cells[CUT - 2 :] for name, cells in given.items()}
    two = write_csv(tmp_path / "two.csv", late, "declination_deg = 2.4", "sd_declination_deg = 0.3")
    columns, document = surveyed(tmp_path, tool, one, "--run", tool, two)
    assert columns["north_m"][CUT : CUT + 3].count("") == 2
    assert any(each["text"].startswith("run 2: left out") for each in document["findings"])
    bare = write_csv(tmp_path / "bare.csv", late)
    ran = cli("survey", tool, one, "--run", tool, bare, "-o", tmp_path / "o.csv")
    assert "different norths: true, magnetic" in refused(ran, 2)
