"""The north and the references of a stand: they turn its run and its roll test, and never a well."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

import mwdcal as library
from cli_support import SERVO_NOISE, mwdcal, read_csv, servo_run, write_csv
from simulation import Tool
from test_wrong_inputs import measured

DECLINATION = 5.2
OF_PLACE = ("ref_gravity_g", "ref_field_nt", "ref_dip_deg")


def at_the_stand(rows):
    """Columns with azimuths from true north, without gravity, field and dip."""
    kept = {name: cells for name, cells in rows.items() if name not in OF_PLACE}
    kept["Azi true [°]"] = (np.asarray(kept.pop("ref_azimuth_deg")) + DECLINATION) % 360
    return kept


def surveys(field=50_000.0):
    """Surveys of a well without references, in a field of so many nT."""
    rows = measured((30, 60), 12, tool=Tool.random(1, noise=SERVO_NOISE, field=field))
    kept = {name: cells for name, cells in rows.items() if not name.startswith(("ref_", "sd_"))}
    return {"md_m": 30.0 * np.arange(1, 25), **kept}


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    """A folder with a run, its profile, which states the place of the stand, and the calibration."""
    folder, rows = tmp_path_factory.mktemp("stand"), servo_run()
    run = write_csv(folder / "run.csv", at_the_stand(rows))
    numbers = [("--column", f"{column}={rows[column][0]:.6f}") for column in OF_PLACE]
    north = ("--north", "true", "--declination-deg", DECLINATION)
    options = (*north, *(word for pair in numbers for word in pair))
    ran = mwdcal("profile", run, "-o", folder / "tool.toml", *options)
    assert ran.code == 0, ran
    ran = mwdcal("calibrate", run, "--tool", folder / "tool.toml", "-o", folder / "cal.json")
    assert ran.code == 0, ran
    write_csv(folder / "well.csv", surveys())
    return folder


def test_the_declination_of_the_stand_does_not_reach_a_well(stand, tmp_path):
    out = tmp_path / "out.csv"
    ran = mwdcal("survey", stand / "cal.json", stand / "well.csv", "-o", out)
    assert ran.code == 0, ran
    assert "azimuths from magnetic north" in ran.out
    assert "gravity, field, dip, declination, convergence: none" in ran.out
    head = [line for line in out.read_text().splitlines() if line.startswith("#")]
    assert '# north = "magnetic"' in head
    assert not any("azimuth_reference" in line or "declination_deg" in line for line in head)


def test_the_reference_of_the_well_counts(stand, tmp_path):
    place = tmp_path / "place.json"
    options = ("--latitude", 60, "--longitude", 5, "--altitude-m", 0, "--date", "2026-06-01")
    place.write_text(mwdcal("reference", *options, "--json").out)
    out = tmp_path / "out.csv"
    ran = mwdcal("survey", stand / "cal.json", stand / "well.csv", "-o", out, "--reference", place, "--json")  # fmt: skip
    expected = json.loads(place.read_text())["declination_deg"]
    assert ran.json["declination_deg"] == pytest.approx(expected)
    sources = ran.json["reference_sources"]
    assert {sources[name] for name in ("field", "dip", "declination")} == {"reference"}
    assert not [f for f in ran.json["findings"] if "well.csv states" in f["text"]]


def test_python_does_not_take_it_either(stand):
    cal = library.load(stand / "cal.json")
    table = pd.read_csv(stand / "well.csv")
    read = [
        stand / "well.csv",
        table,
        library.read_run(stand / "well.csv", cal.profile),
        library.read_run(table, cal.profile, metadata={"date": "2026-01-01"}),
    ]
    for readings in read:
        surveyed = library.survey(cal, readings)
        assert "azimuth_true_deg" not in surveyed.columns
        assert np.isnan(surveyed.columns.get("ref_field_nt", np.nan)).all()
    own = library.read_run(stand / "well.csv", cal.profile, metadata={"declination_deg": 5.2})
    turned = library.survey(cal, own).columns
    off = turned["azimuth_true_deg"] - turned["azimuth_magnetic_deg"]
    np.testing.assert_allclose((off + 180) % 360 - 180, 5.2, atol=1e-9)


def test_apply_and_diagnose_do_not_judge_a_well_by_the_field_of_the_stand(stand, tmp_path):
    well = write_csv(tmp_path / "well.csv", surveys(60_000.0))
    out = tmp_path / "out.csv"
    ran = mwdcal("apply", stand / "cal.json", well, "-o", out)
    assert ran.code == 0, ran
    assert "azimuth_reference" not in out.read_text()
    cal = library.load(stand / "cal.json")
    library.apply(cal, well)
    library.apply(cal, library.read_run(well, cal.profile))
    assert library.diagnose(cal, well).fault == "none"
    assert mwdcal("diagnose", stand / "cal.json", well).code == 0


def test_a_table_in_memory_is_turned_as_its_file_is(stand):
    table = pd.read_csv(stand / "run.csv")
    by_file = library.read_run(stand / "run.csv", stand / "tool.toml")
    in_memory = library.read_run(table, stand / "tool.toml")
    expected = np.asarray(table["Azi true [°]"]) - DECLINATION
    for readings in (by_file, in_memory):
        off = np.degrees(readings.reference("azimuth")) - expected
        np.testing.assert_allclose((off + 180) % 360 - 180, 0.0, atol=1e-9)


def test_a_run_is_written_with_the_north_of_its_stand(stand, tmp_path):
    library.save(library.read_run(stand / "run.csv", stand / "tool.toml"), tmp_path / "again.csv")
    again = library.read_run(tmp_path / "again.csv", "servo")
    assert again.metadata["declination_deg"] == DECLINATION
    written = np.array(read_csv(tmp_path / "again.csv")["ref_azimuth_deg"], float)
    np.testing.assert_allclose(written, np.asarray(pd.read_csv(stand / "run.csv")["Azi true [°]"]))
