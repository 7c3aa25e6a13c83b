"""Survey listing for well-planning programs, closure, and the scale of a grid."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

import mwdcal
from cli_support import mwdcal as cli
from mwdcal.errors import InputError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The example's calibration, and its well without its own declination."""
    folder = tmp_path_factory.mktemp("listing")
    assert cli("example", folder).code == 0
    made = cli(
        "calibrate", folder / "run.csv", "--tool", folder / "tool.toml", "-o", folder / "c.json"
    )
    assert made.code == 0
    text = (folder / "well.csv").read_text("utf-8").splitlines()
    kept = [line for line in text if "declination" not in line]
    (folder / "well.csv").write_text("\n".join(kept) + "\n", "utf-8")
    place = ("--latitude", 60.4, "--longitude", 5.3, "--altitude-m", 0, "--date", "2026-11-23")
    made = cli("reference", *place, "--crs", "EPSG:23031", "-o", folder / "ref.json")
    assert made.code == 0
    return folder


def rows_of(path) -> list[dict[str, str]]:
    lines = path.read_text("utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def minimum_curvature(md, inclination, azimuth, start):
    """Positions by the ratio factor, from angles in degrees: a formula of its own."""
    i, a = np.radians(inclination), np.radians(azimuth)
    along = np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)
    bend = np.arccos(np.clip(np.sum(along[1:] * along[:-1], -1), -1, 1))
    factor = np.where(bend > 1e-7, np.tan(bend / 2) / np.maximum(bend / 2, 1e-12), 1.0)
    steps = (np.diff(md) / 2 * factor)[:, None] * (along[1:] + along[:-1])
    return np.concatenate([[start], start + np.cumsum(steps, 0)]), bend


@pytest.mark.parametrize("unit", ["m", "ft"])
def test_listing_has_the_path_from_its_tie_in(folder, unit) -> None:
    out = folder / f"list-{unit}.csv"
    ran = cli(
        "survey", folder / "c.json", folder / "well.csv", "-o", folder / "o.csv", "--reference",
        folder / "ref.json", "--tie-in", "0,1,20,100,200,15", "--section-azimuth", 30,
        "--length-unit", unit, "--listing", out,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    rows = rows_of(out)
    column = {name: np.array([float(r[name] or "nan") for r in rows]) for name in rows[0]}
    md, north, east = (column[f"{name} ({unit})"] for name in ("MD", "N/S", "E/W"))
    assert (md[0], north[0], east[0]) == (0, 100, 200)
    place, bend = minimum_curvature(
        md, column["Inc (deg)"], column["Azi grid (deg)"], np.array([100.0, 200.0, 15.0])
    )
    found = np.stack([north, east, column[f"TVD ({unit})"]], -1)
    assert np.abs(found - place).max() < 5e-3  # four decimals of angles over a kilometre
    course = {"m": 30, "ft": 100}[unit]
    severity = np.degrees(bend) * course / np.diff(md)
    assert column[f"DLS (deg/{course}{unit})"][1:] == pytest.approx(severity, abs=2e-3)
    assert column[f"Closure ({unit})"] == pytest.approx(np.hypot(north, east), abs=1e-3)
    bearing = np.degrees(np.arctan2(east, north))
    assert column["Closure azi (deg)"] == pytest.approx(bearing, abs=1e-3)
    section = north * np.cos(np.radians(30)) + east * np.sin(np.radians(30))
    assert column[f"V.Sec ({unit})"] == pytest.approx(section, abs=1e-3)
    scale = json.loads((folder / "ref.json").read_text("utf-8"))["grid_scale"]
    assert column[f"Map N ({unit})"] == pytest.approx(100 + scale * (north - 100), abs=1e-3)
    results = rows_of(folder / "o.csv")
    sd = float(results[-1][f"sd_north_{unit}"])
    assert column[f"covariance_nn_{unit}2"][-1] == pytest.approx(sd**2, rel=1e-9)


def test_scale_of_a_grid_is_that_of_proj() -> None:
    """ED50 / UTM 31 and a grid in feet, by PROJ's own derivative of the projection."""
    pyproj = pytest.importorskip("pyproj")
    for code, latitude, longitude in (
        ("EPSG:23031", 60.0, 3.5),
        ("EPSG:32631", 45.0, 6.0),
        ("EPSG:2277", 30.5, -98.0),
    ):
        place = {"latitude": latitude, "longitude": longitude, "date": "2026-11-23"}
        found = mwdcal.reference(**place, altitude_m=0.0, crs=code).earth.grid_scale
        factors = pyproj.Proj(pyproj.CRS(code)).get_factors(longitude, latitude)
        # a datum's ellipsoid is another by up to 1e-4 of its radius
        assert found == pytest.approx(np.sqrt(factors.areal_scale), abs=1.2e-4)


def test_closure_of_the_end_is_on_screen_and_in_json(folder) -> None:
    arguments = (
        "survey",
        folder / "c.json",
        folder / "well.csv",
        "-o",
        folder / "o.csv",
        "--tie-in",
        "30,-40,0",
    )
    end = cli(*arguments, "--json").json["end"]
    assert end["closure_m"] == pytest.approx(np.hypot(end["north_m"], end["east_m"]), rel=1e-12)
    degrees = np.degrees(np.arctan2(end["east_m"], end["north_m"])) % 360
    assert end["closure_azimuth_deg"] == pytest.approx(degrees, rel=1e-12)
    assert f"closure {end['closure_m']:.2f} m at {degrees:.2f}°" in cli(*arguments).out


def test_a_well_without_depths_has_no_listing(folder, tmp_path) -> None:
    columns = mwdcal.survey(folder / "c.json", folder / "well.csv").columns
    names = ("ax", "ay", "az", "mx", "my", "mz", "temperature_c")
    well = mwdcal.survey(folder / "c.json", {name: columns[name] for name in names})
    with pytest.raises(InputError, match="Add measured depths"):
        well.save_listing(tmp_path / "x.csv")
