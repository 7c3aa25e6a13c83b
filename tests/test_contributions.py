"""Contributions of causes to the uncertainty of a well: they add up, and each is what its formula says."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE, read_csv, refused, write_csv
from cli_support import mwdcal as cli
from mwdcal.presentation.survey_page import stretches

STEPS, STEP = 10, 30.0
SD = ("inclination_deg", "azimuth_deg", "north_m", "east_m", "tvd_m")


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    """The calibration of the bundled example."""
    folder = tmp_path_factory.mktemp("tool")
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert cli(*fit, "-o", folder / "tool.json").code == 0
    return folder / "tool.json"


def straight(folder):
    """A straight hole: the last reading of the example's well at eleven depths."""
    given = read_csv(EXAMPLE / "well.csv")
    columns = {name: [cells[-1]] * (STEPS + 1) for name, cells in given.items()}
    columns["station"] = [f"S{i}" for i in range(STEPS + 1)]
    columns["md_m"] = [str(1000 + STEP * i) for i in range(STEPS + 1)]
    return write_csv(folder / "straight.csv", columns, "simulated = true", "declination_deg = 2.4")


def at_end(well, cause, propagation):
    """1σ of one cause at the last station by column, radians and metres."""
    columns = well.contributions
    rows = columns["cause"] == cause
    assert {*columns["propagation"][rows]} == {propagation}
    return {
        name: np.radians(values[rows][-1]) if name.endswith("_deg") else values[rows][-1]
        for name, values in columns.items()
        if name.startswith("sd_")
    }


@pytest.mark.parametrize(
    "options",
    [{}, {"error_model": "none"}, {"tie_in": (0.0, 1.0, 20.0, 5.0, -3.0, 90.0)}],
    ids=["model", "no-model", "tied-in"],
)
def test_squares_add_up_to_those_of_the_surveys_and_of_the_path(tool, options):
    well = mwdcal.survey(tool, EXAMPLE / "well.csv", **options)
    columns, stations = well.contributions, len(well.columns["md_m"])
    for name in SD:
        parts = columns[f"sd_{name}"].reshape(stations, -1)
        stated = well.columns[f"sd_{name.replace('azimuth', 'azimuth_true')}"]
        np.testing.assert_array_equal(np.isnan(parts).all(-1), np.isnan(stated))
        there = ~np.isnan(stated)
        assert there.sum() > stations / 2
        np.testing.assert_allclose(np.linalg.norm(parts[there], axis=-1), stated[there], rtol=1e-9)
    shares = columns["share_tvd"].reshape(stations, -1)[-1]
    assert shares.sum() == pytest.approx(1.0)


def test_causes_in_a_straight_hole_are_their_formulas_times_its_length(tool, tmp_path):
    """Expected: OWSG set A Rev 5.1, and an error of direction that lasts moves the end by the length of the hole."""
    well = mwdcal.survey(tool, straight(tmp_path))
    length = STEPS * STEP
    inclination, azimuth = (
        np.radians(well.columns[f"{name}_deg"][-1]) for name in ("inclination", "azimuth_magnetic")
    )
    sine, cosine, across = np.sin(inclination), np.cos(inclination), 48_000 * np.cos(np.radians(63))
    sag = at_end(well, "sag, whole run", "systematic")
    upward = np.radians(0.2) * sine**0.25
    assert sag["sd_inclination_deg"] == pytest.approx(upward)
    assert sag["sd_highside_m"] == pytest.approx(length * upward)
    rounding = np.sqrt(np.finfo(float).eps)  # the root of a variance that is rounded
    assert sag["sd_lateral_m"] <= rounding * sag["sd_highside_m"]
    axial = at_end(well, "axial interference of the drill string", "systematic")
    turn = 220 * sine * np.sin(azimuth) / across
    assert axial["sd_azimuth_deg"] == pytest.approx(turn, rel=2e-3)  # field and dip as measured
    assert axial["sd_lateral_m"] == pytest.approx(length * sine * turn, rel=2e-3)
    depth = at_end(well, "measured depth, whole run", "systematic")
    assert depth["sd_along_hole_m"] == pytest.approx(0.00056 * length)
    declination = at_end(well, "declination, whole well", "well")
    assert declination["sd_lateral_m"] == pytest.approx(
        length * sine * declination["sd_azimuth_deg"]
    )
    # errors new at every station: half a course at both ends, a whole one between
    random = at_end(well, "misalignment in the hole, each station", "random")
    courses = STEP * np.sqrt(STEPS - 1 + 2 * 0.25)
    assert random["sd_highside_m"] == pytest.approx(courses * np.radians(0.3) * cosine)
    assert random["sd_lateral_m"] == pytest.approx(courses * np.radians(0.3) * cosine)


def test_table_screen_and_json_of_the_command(tool, tmp_path):
    table = tmp_path / "contributions.csv"
    typed = ("survey", tool, straight(tmp_path), "-o", tmp_path / "o.csv", "--contributions", table)
    document = cli(*typed, "--json").json["contributions"]
    columns = read_csv(table)
    causes = [(each["cause"], each["propagation"]) for each in document["causes"]]
    assert ("declination, whole well", "well") in causes
    assert len({name for name, _ in causes}) == len(causes)
    assert list(zip(columns["cause"], columns["propagation"], strict=True)) == causes * (STEPS + 1)
    assert columns["station"][:: len(causes)] == document["station"]
    last = [float(cell) for cell in columns["sd_highside_m"][-len(causes) :]]
    assert [each["sd_highside_m"][-1] for each in document["causes"]] == pytest.approx(
        last, rel=1e-5
    )
    assert document["total"]["sd_highside_m"][-1] == pytest.approx(np.linalg.norm(last), rel=1e-5)
    assert "contributions to the uncertainty of station S10 at 1300.00 m MD" in cli(*typed).out
    assert f"{table.name} (contributions)" in cli(*typed).out
    assert "of station S3 at 1090.00 m MD" in cli(*typed, "--station", "S3").out
    assert "no stations have that label" in refused(cli(*typed, "--station", "S99"), 2)
    python = mwdcal.survey(tool, tmp_path / "straight.csv").to_dict()["contributions"]
    assert python == json.loads(json.dumps(document))


def test_without_depths_there_are_contributions_to_angles_alone(tool, tmp_path):
    given = read_csv(straight(tmp_path))
    source = write_csv(tmp_path / "o.csv", {k: v for k, v in given.items() if k != "md_m"})
    columns = mwdcal.survey(tool, source).contributions
    assert np.isnan(columns["sd_north_m"]).all()
    assert (columns["sd_inclination_deg"][columns["cause"] == "sag, whole run"] > 0.1).all()


def test_stretches_reach_half_a_course_beyond_their_stations():
    depth = np.array([0.0, 10, 20, np.nan, 30, 40, 50])
    chosen = np.array([True, False, False, True, True, True, False])
    assert stretches(depth, chosen) == [(0.0, 5.0), (25.0, 45.0)]
    assert stretches(depth, np.zeros(7, bool)) == []
    assert stretches(depth[-2:], np.array([False, True])) == [(45.0, 50.0)]
