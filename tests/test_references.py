"""References of a place: against published values, other implementations and second formulas."""

import csv
import json
import os
import sys
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from cli_support import EXAMPLE, mwdcal, read_csv, refused, write_csv
from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.survey import references
from mwdcal.survey.references import (
    MOMENT_SD,
    PLACE_SD,
    EarthReference,
    grid_convergence,
    load_reference,
    reference_at,
)

PLACE = (60.0, 3.5, 40.0, date(2026, 7, 1))
TYPED = ("--latitude", 60, "--longitude", 3.5, "--altitude-m", 40, "--date", "2026-07-01")
published = pytest.mark.skipif(
    "MWDCAL_DATA" not in os.environ, reason="published values: set MWDCAL_DATA to a local copy"
)


def data(name):
    return Path(os.environ["MWDCAL_DATA"]) / "survey" / name


# Gravity


def test_normal_gravity_is_the_published_one():
    at_sea_level = references.normal_gravity([0, 45, 60, 90], 0.0)
    expected = [9.7803253359, 9.806197769, 9.819176953, 9.8321849379]  # NIMA TR8350.2
    assert at_sea_level == pytest.approx(expected, abs=1e-9)
    above = references.normal_gravity(45.0, [500.0, 2000.0])
    assert above == pytest.approx([9.80465515, 9.80002947], abs=5e-9)


def test_normal_gravity_is_that_of_boule():
    boule = pytest.importorskip("boule")
    latitude, height = np.linspace(-90, 90, 37)[:, None], np.array([0.0, 100.0, 2000.0, 8000.0])
    latitude, height = np.broadcast_arrays(latitude, height)
    theirs = boule.WGS84.normal_gravity((None, latitude, height), si_units=True)
    assert references.normal_gravity(latitude, height) == pytest.approx(theirs, abs=1e-9)


def test_normal_gravity_on_the_ellipsoid_is_somiglianas_formula():
    latitude = np.linspace(-90, 90, 181)
    s = np.sin(np.radians(latitude)) ** 2
    somigliana = 9.7803253359 * (1 + 0.00193185265241 * s) / np.sqrt(1 - 0.00669437999014 * s)
    assert references.normal_gravity(latitude, 0.0) == pytest.approx(somigliana, abs=1e-9)


def geopotential(radial, axial):
    """Potential of gravity of WGS84 as a series of zonal harmonics, m²/s²."""
    gm, a, e2, j2 = 3.986004418e14, 6378137.0, 0.00669437999014, 1.0826298213e-3
    r, sine = np.hypot(radial, axial), axial / np.hypot(radial, axial)
    series = 1.0
    for n in range(1, 7):  # Heiskanen and Moritz (1967), equation 2-92
        zonal = (-1) ** (n + 1) * 3 * e2**n / ((2 * n + 1) * (2 * n + 3))
        zonal *= 1 - n + 5 * n * j2 / e2
        series -= zonal * (a / r) ** (2 * n) * np.polynomial.legendre.Legendre.basis(2 * n)(sine)
    return gm / r * series + (7.292115e-5 * radial) ** 2 / 2


@pytest.mark.parametrize("altitude", [-10_000.0, 0.0, 3000.0, 100_000.0])
def test_normal_gravity_is_the_gradient_of_the_potential(altitude):
    latitude = np.radians(np.array([0.5, 30.0, 45.0, 71.0, 89.5]))
    a, e2, step = 6378137.0, 0.00669437999014, 200.0
    n = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    p, z = (n + altitude) * np.cos(latitude), (n * (1 - e2) + altitude) * np.sin(latitude)

    def slope(u, v):
        near, far = (
            geopotential(p + k * u, z + k * v) - geopotential(p - k * u, z - k * v) for k in (1, 2)
        )
        return (8 * near - far) / (12 * step)

    gravity = references.normal_gravity(np.degrees(latitude), altitude)
    assert gravity == pytest.approx(np.hypot(slope(step, 0.0), slope(0.0, step)), abs=1e-9)


def moradi(latitude, doubled):
    """Moradi's equation 7 at sea level; the last term printed in sin²θ, or as it is meant."""
    theta = np.radians(latitude)
    last = np.sin(2 * theta if doubled else theta) ** 2
    return 9.7803327 * (1 + 5.3024e-3 * np.sin(theta) ** 2 - 5.8e-6 * last)


def test_moradis_equation_7_holds_with_the_sine_of_twice_the_latitude():
    latitude = np.linspace(0, 90, 91)
    exact = references.normal_gravity(latitude, 0.0)
    meant, printed = (moradi(latitude, doubled) - exact for doubled in (True, False))
    assert np.abs(meant).max() < 1e-5  # 0.0000057 of it by another digit in the constant
    assert printed[-1] == pytest.approx(meant[-1] - 5.67e-5, abs=1e-7)  # the pole
    assert printed[45] - meant[45] == pytest.approx(2.84e-5, rel=1e-2)
    height = references.normal_gravity(45.0, 1000.0) - references.normal_gravity(45.0, 0.0)
    assert height == pytest.approx(-3.086e-6 * 1000, rel=1e-3)


# The main field


@published
def test_wmm2025_gives_its_100_official_values():
    rows = np.loadtxt(data("WMM2025_TEST_VALUES.txt"))
    assert len(rows) == 100
    for year, altitude, latitude, longitude, *official in rows:
        north, east, down, strength = official[3:7]
        model = references.field_model("wmm2025", year)
        field = references.main_field(model, latitude, longitude, 1000 * altitude, year)
        horizontal = np.hypot(north, east)
        assert field.field_nt == pytest.approx(strength, abs=1e-3)
        assert field.dip_deg == pytest.approx(np.degrees(np.arctan2(down, horizontal)), abs=1e-6)
        turned = field.declination_deg - np.degrees(np.arctan2(east, north))
        assert np.radians(turned) * horizontal == pytest.approx(0.0, abs=1e-3)  # nT
        assert field[1:] == pytest.approx((official[1], official[0]), abs=0.005 + 1e-9)


def components(field):
    """North, east and down, nT."""
    dip, declination = np.radians(field[1:])
    level = field.field_nt * np.cos(dip)
    axes = (level * np.cos(declination), level * np.sin(declination), field.field_nt * np.sin(dip))
    return np.array(axes)


@published
def test_igrf_gives_the_grid_of_noaa(monkeypatch):
    monkeypatch.setattr(references, "_IGRF_FILE", "IGRF13.shc")  # the generation of that grid
    references._igrf.cache_clear()
    with data("noaa_igrf_2022-10-05_5km.csv").open() as stream:
        rows = [list(map(float, row.values())) for row in csv.DictReader(stream)]
    fields = []
    for year, latitude, longitude, h, *_ in rows[::15]:
        model = references.field_model("igrf14", year)
        fields.append(components(references.main_field(model, latitude, longitude, 1000 * h, year)))
    references._igrf.cache_clear()
    off = np.array(fields) - np.array(rows)[::15, 4:]
    # ppigrf itself is off by as much; the date matters by 0.4 nT a day.
    assert np.abs(off).max() < 5.0
    assert np.sqrt((off**2).mean()) < 2.0


def test_igrf_is_that_of_ppigrf():
    ppigrf = pytest.importorskip("ppigrf")
    from datetime import datetime

    rng = np.random.default_rng(14)
    # It counts days from epoch to epoch where we count years: 0.002 years at most.
    for year, tolerance in ((1900, 0.01), (1944, 0.1), (2025, 0.01), (2030, 0.01)):
        latitude, longitude = rng.uniform(-88, 88), rng.uniform(-180, 360)
        altitude = rng.uniform(-8000, 9000)
        east, north, up = ppigrf.igrf(longitude, latitude, altitude / 1000, datetime(year, 1, 1))
        model = references.field_model("igrf14", float(year))
        field = references.main_field(model, latitude, longitude, altitude, float(year))
        theirs = [float(np.squeeze(c)) for c in (north, east, -up)]
        assert components(field) == pytest.approx(theirs, abs=tolerance), year


def test_the_field_is_that_of_a_library_everywhere_and_at_the_poles():
    """The library evaluates the same coefficients by recurrences of its own."""
    pygeomag = pytest.importorskip("pygeomag")
    rng, theirs = np.random.default_rng(15), pygeomag.GeoMag(coefficients_file="wmm/WMM_2025.COF")
    places = rng.uniform((-90, -180, -9000, 2025), (90, 360, 20_000, 2030), (60, 4))
    places[:4, 0] = 90.0, -90.0, 0.0, 90.0
    ours = references.main_fields(references.field_model("wmm2025", 2025.0), *places.transpose())
    for found, (latitude, longitude, altitude, year) in zip(ours, places, strict=True):
        seen = theirs.calculate(latitude, longitude, altitude / 1000, year)
        assert found == pytest.approx((seen.x, seen.y, seen.z), abs=1e-4)


def test_fields_of_many_places_and_dates_are_those_of_each():
    model, spots = (
        references.field_model("igrf14", 2025.0),
        [(60.0, 3.5, 0.0, 2025.5), (-90.0, 9.0, 1e4, 2029.0)],
    )
    together = references.main_fields(model, *np.transpose(spots))
    assert together.shape == (2, 3)
    for found, spot in zip(together, spots, strict=True):
        alone = references.main_field(model, *spot)
        assert components(alone) == pytest.approx(found, abs=1e-6)


def test_both_models_agree_within_what_their_makers_state():
    day, spots = 2026.5, [(60.0, 3.5), (-33.0, 151.0), (29.4, -98.5), (25.0, 51.0), (0.0, 120.0)]
    for latitude, longitude in spots:
        wmm, igrf = (
            references.main_field(references.field_model(name, day), latitude, longitude, 0.0, day)
            for name in ("wmm2025", "igrf14")
        )
        assert abs(wmm.field_nt - igrf.field_nt) < 20
        assert abs(wmm.dip_deg - igrf.dip_deg) < 0.02
        assert abs(wmm.declination_deg - igrf.declination_deg) < 0.06


def test_the_epoch_of_igrf_is_the_last_one_before_the_date():
    epochs = {1900.0: 1900.0, 1904.9: 1900.0, 2022.7: 2020.0, 2025.0: 2025.0, 2030.0: 2025.0}
    for year, epoch in epochs.items():
        model = references.field_model("igrf14", year)
        assert (model.epoch, model.valid_to) == (epoch, 2030.0)
        assert "IGRF14.shc of ppigrf" in model.coefficients
        assert len(model.sha256) == 64


# Norths


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude"),
    [
        ("EPSG:23031", 60.0, 3.5),  # the North Sea
        ("EPSG:32614", 29.4, -98.5),  # Texas
        ("EPSG:2193", -41.0, 175.0),  # New Zealand, north before east
        ("EPSG:32739", -20.0, 410.0 - 360.0),
        ("EPSG:3348", 55.0, -115.0),  # Canada, Lambert
        ("EPSG:27700", 57.0, -4.0),
        ("EPSG:2276", 32.0, -97.0),  # Texas, feet
        ("EPSG:27572", 48.5, 3.5),  # counts longitude from Paris
        ("EPSG:21780", 46.9, 7.4),  # from Bern
        ("EPSG:2062", 40.0, -4.0),  # from Madrid
        ("EPSG:5555", 52.0, 10.0),  # with heights
    ],
)
def test_convergence_is_the_bearing_of_true_north_on_the_grid(crs, latitude, longitude):
    pyproj = pytest.importorskip("pyproj")
    onto = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    (x0, y0), (x1, y1) = (onto.transform(longitude, latitude + d) for d in (-1e-4, 1e-4))
    bearing_of_true_north = np.degrees(np.arctan2(x1 - x0, y1 - y0))
    grid = grid_convergence(crs, latitude, longitude)
    assert grid.covered
    # A_grid = A_true - convergence, where A_true is zero
    assert bearing_of_true_north == pytest.approx(-grid.convergence_deg, abs=1e-5)


def test_convergence_of_utm_is_positive_east_of_its_meridian_in_the_north():
    grid = grid_convergence("EPSG:23031", 60.0, 3.5)
    assert grid.convergence_deg == pytest.approx(0.4330, abs=5e-5)  # published with the frame
    sphere = np.degrees(np.arctan(np.tan(np.radians(0.5)) * np.sin(np.radians(60))))
    assert grid.convergence_deg == pytest.approx(sphere, abs=1e-4)
    assert grid_convergence("EPSG:23031", 60.0, 363.5) == grid


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude", "by_formula"),
    [
        # Lambert's cone turns by the sine of its parallel, from the meridian of Paris
        ("EPSG:27572", 48.5, 3.5, np.sin(np.radians(46.8)) * (3.5 - 2.33722917)),
        # transverse Mercator in the south, axes west and south: of its north
        ("EPSG:2053", -28.0, 30.0, np.sin(np.radians(-28.0))),
        # the three ways to write Krovak's grid
        *((crs, 50.0, 14.0, -8.158) for crs in ("EPSG:5513", "EPSG:5514", "EPSG:2065")),
        # about the poles grid north is the axis of northings
        ("EPSG:32661", 85.0, 20.0, 20.0),
        ("EPSG:5041", 85.0, 20.0, 20.0),
        ("EPSG:5042", -85.0, 20.0, -20.0),
        ("EPSG:3031", -90.0, 30.0, -30.0),
        ("EPSG:3413", 80.0, -30.0, 15.0),
    ],
)
def test_convergence_follows_the_projection_whatever_its_axes(crs, latitude, longitude, by_formula):
    grid = grid_convergence(crs, latitude, longitude)
    assert grid.convergence_deg == pytest.approx(by_formula, abs=1e-3)


def test_a_grid_that_does_not_keep_angles_is_reported():
    reference = reference_at(52.0, 20.0, 0.0, PLACE[3], crs="EPSG:3035")
    north, apart = np.radians(52.0), np.radians(10.0)
    # equal area about 52°, 10°: scales cos(c/2) and its inverse at a distance c
    cosine = np.sqrt((1 + np.sin(north) ** 2 + np.cos(north) ** 2 * np.cos(apart)) / 2)
    largest = 2 * np.arcsin((1 - cosine**2) / (1 + cosine**2))
    assert [finding.id for finding in reference.findings] == ["grid-not-conformal"]
    grid = grid_convergence("EPSG:3035", 52.0, 20.0)
    assert grid.distortion_deg == pytest.approx(np.degrees(largest), rel=0.01)


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:4326", "must name a map grid"),
        ("EPSG:4979", "must name a map grid"),
        ("EPSG:22300", "method Tunisia Mining Grid"),
        ("EPSG:22700", "method Lambert Conic Near-Conformal"),
        ("EPSG:999999", "such as EPSG:32631"),
        ("+proj=utm +zone=31", "such as EPSG:32631"),
        ("/etc/passwd", "such as EPSG:32631"),
    ],
)
def test_what_is_no_grid_is_refused(crs, words):
    with pytest.raises(InputError, match=words):
        grid_convergence(crs, 60.0, 3.5)


def test_a_place_that_the_grid_does_not_show_is_refused():
    with pytest.raises(InputError, match="Check `latitude`"):
        grid_convergence("EPSG:2154", -90.0, 3.5)


def test_a_place_outside_the_zone_is_reported():
    reference = reference_at(60.0, 9.5, 0.0, PLACE[3], crs="EPSG:23031")
    assert [finding.id for finding in reference.findings] == ["outside-grid"]


def test_a_system_without_bounds_covers_every_place():
    assert grid_convergence("EPSG:31461", 54.0, 3.0).covered


def test_azimuths_turn_by_declination_and_convergence():
    reference = EarthReference(
        latitude_deg=60, longitude_deg=3.5, altitude_m=0, date=PLACE[3], gravity_g=1.0,
        gravity_ms2=9.80665, field_nt=50_000, dip_deg=72, declination_deg=-4, convergence_deg=1.5,
    )  # fmt: skip
    assert [reference.offset_deg(north) for north in reference.norths] == [0.0, -4.0, -5.5]


# References


def test_uncertainties_are_those_of_the_owsg_set():
    classic = (130.0, 0.20, 0.36, 5000.0)  # of the error models before the terms were split
    assert pytest.approx(classic, rel=0.01) == PLACE_SD
    reference = reference_at(*PLACE)
    horizontal = reference.field_nt * np.cos(np.radians(reference.dip_deg))
    for prefix, sd in (("sd_", PLACE_SD), ("sd_random_", MOMENT_SD)):
        assert getattr(reference, f"{prefix}field_nt") == sd.field_nt
        declination = np.hypot(sd.declination_deg, sd.horizontal_deg_nt / horizontal)
        assert getattr(reference, f"{prefix}declination_deg") == pytest.approx(declination)
    assert reference.sources["sd_field_dip_declination"].startswith("OWSG set A Rev 5.1")


def test_measured_values_stand_before_the_model():
    measured = {"field": 50_500.0, "dip": 72.7, "gravity": 1.0013}
    uncertainties = {"field": 30.0, "gravity": 1e-6}
    modelled, reference = (
        reference_at(*PLACE, measured=m, uncertainties=u)
        for m, u in (({}, {}), (measured, uncertainties))
    )
    assert (reference.field_nt, reference.dip_deg, reference.gravity_g) == (50_500.0, 72.7, 1.0013)
    assert reference.gravity_ms2 == pytest.approx(1.0013 * 9.80665)
    assert (reference.sd_field_nt, reference.sd_dip_deg, reference.sd_gravity_g) == (30, 0, 1e-6)
    bare = reference_at(*PLACE, measured={"declination": 1.0})
    assert (bare.declination_deg, bare.sd_declination_deg) == (1.0, modelled.sd_declination_deg)
    assert [f.id for f in bare.findings] == ["declination-uncertainty-assumed"]
    assert reference.declination_deg == modelled.declination_deg
    assert reference.measured == ["gravity", "field", "dip"]
    assert {n for n, s in reference.sources.items() if s == "measured"} == set(reference.measured)
    # dip; and a field that is 800 nT off the model, whose 1σ is 140 nT
    assert [f.id for f in reference.findings] == ["exact-reference", "field-disagrees"]


def test_where_all_was_measured_no_model_is_needed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    measured = {"field": 50_500.0, "dip": 72.7, "declination": 1.0}
    reference = reference_at(60.0, 3.5, 40.0, date(1850, 1, 1), measured=measured)
    assert (reference.model, reference.epoch, reference.coefficients) == (None, None, None)
    assert "not-compared-with-model" in {finding.id for finding in reference.findings}


SD_OF_MODEL = {
    "gravity": "sd_gravity_g",
    "field": "sd_field_nt",
    "dip": "sd_dip_deg",
    "declination": "sd_declination_deg",
}


@pytest.mark.parametrize("name", SD_OF_MODEL)
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_measured_value_is_compared_with_the_model(name, sign):
    modelled, key = reference_at(*PLACE), SD_OF_MODEL[name].removeprefix("sd_")
    of_model = np.hypot(getattr(modelled, f"sd_{key}"), getattr(modelled, f"sd_random_{key}", 0.0))
    measured_sd = 0.7 * of_model
    for off, named in ((1.9, False), (2.1, True)):
        value = getattr(modelled, key) + sign * off * np.hypot(of_model, measured_sd)
        found = reference_at(*PLACE, measured={name: value}, uncertainties={name: measured_sd})
        texts = [each.text for each in found.findings if each.id == f"{name}-disagrees"]
        assert bool(texts) is named
        assert all("the model" in text for text in texts)


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"dip": 63.0}, "`dip_deg`: 63 ° cannot be of this place, where the model has -63."),
        (
            {"field": 80_000.0, "dip": 20.0, "declination": 100.0},
            "`field_nt`, `dip_deg`, `declination_deg`",
        ),
        ({"gravity": 1.05}, "`gravity_g` must be within 0.01 g of the model's"),
    ],
)
def test_a_measured_value_that_cannot_be_there_is_refused(measured, words):
    with pytest.raises(InputError) as refusal:
        reference_at(-33.0, 151.0, 0.0, date(2026, 7, 1), measured=measured)
    assert words in str(refusal.value)


def test_the_north_of_a_run_that_contradicts_the_place_is_named(tmp_path):
    here = reference_at(*PLACE, crs="EPSG:23031")
    for off, named in ((0.0, False), (5.0, True)):
        metadata = f"# declination_deg = {here.declination_deg + off}\n# convergence_deg = {here.convergence_deg - off}"
        file = run_file(tmp_path, "ax,ay,az", "0,0,1", metadata=metadata)
        ran, _ = filled(tmp_path, file, "--crs", "EPSG:23031")
        assert ("declination:" in ran.err, "convergence:" in ran.err) == (named, named)


@pytest.mark.parametrize(
    ("name", "options"), [("pygeomag", ()), ("pyproj", ("--crs", "EPSG:23031"))]
)
def test_a_missing_library_says_what_to_install(monkeypatch, name, options):
    references._wmm.cache_clear()
    monkeypatch.setitem(sys.modules, name, None)
    message = refused(mwdcal("reference", *TYPED, *options), 2)
    assert f"needs {name}" in message
    assert extras.command("survey") in message


def test_below_ground_gravity_is_less_certain():
    shallow, deep = (reference_at(60.0, 3.5, h, PLACE[3]) for h in (0.0, -3000.0))
    assert deep.sd_gravity_g > 10 * shallow.sd_gravity_g
    assert [f.id for f in deep.findings] == ["gravity-below-ground"]
    # Free air continued down against a slab of rock of 2670 kg/m³: 0.0848 mGal/m
    rock = shallow.gravity_ms2 + 3000 * 0.0848e-5
    assert abs(deep.gravity_ms2 - rock) == pytest.approx(deep.sd_gravity_g * 9.80665, rel=0.02)


def test_near_a_magnetic_pole_azimuths_are_reported_as_unreliable():
    reference = reference_at(86.0, 140.0, 0.0, PLACE[3])
    assert [f.id for f in reference.findings] == ["magnetic-pole"]
    assert reference.sd_declination_deg > 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--latitude", 95), "--latitude must be between -90 and 90 °; got 95. Are latitude and"),
        (("--longitude", 400), "--longitude must be between -180 and 360 °; got 400"),
        (("--altitude-m", 900_000), "Give it in metres above the ellipsoid"),
        (("--latitude", "nan"), "--latitude must be"),
        (("--longitude", "3,5"), "decimal comma"),
        (("--date", "1.7.2026"), "expected a day such as 2026-11-28"),
        (("--date", "2024-12-31"), "wmm2025 holds from 2025.0 to 2030.0; got 2024.997. Use --model igrf14"),
        (("--date", "2031-01-01"), "got 2031.000. Give measured values"),
        (("--date", "1899-12-31", "--model", "igrf14"), "igrf14 holds from 1900.0"),
        (("--field-nt", 50.5), "--field-nt must be between 15000 and 80000 nT; got 50.5. Give it in nT"),
        (("--gravity-g", 9.81), "--gravity-g must be between 0.9 and 1.1 g; got 9.81"),
        (("--dip-deg", -95), "Down is positive"),
        (("--sd-dip-deg", 0.1), "--sd-dip-deg is of a measured value. Add --dip-deg"),
        (("--field-nt", 50_000, "--sd-field-nt", -1), "--sd-field-nt must be between 0"),
        (("--fill", "run.csv"), "--fill needs a file"),
        (("-o", "ref.csv"), "--output 'ref.csv': a reference is written as JSON"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(options, words):
    assert words in refused(mwdcal("reference", *TYPED, *options), 2)


# The file


def test_json_is_what_survey_loads(tmp_path):
    file = tmp_path / "ref.json"
    ran = mwdcal("reference", *TYPED, "--crs", "EPSG:23031", "--json", "-o", file)
    reference, digest = load_reference(file)
    document = json.loads(file.read_text("utf-8"))
    assert {**ran.json, "output": ""} == {**document, "output": ""}
    assert (document["schema_version"], document["command"]) == (1, "reference")
    assert (document["model"], document["epoch"], document["valid_to"]) == (
        "wmm2025",
        2025.0,
        2030.0,
    )
    assert document["date"] == "2026-07-01"
    assert reference == reference_at(*PLACE, crs="EPSG:23031")
    assert len(digest) == 64


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("dip_deg", 95.0, "'dip_deg' must be between -90 and 90 °; got 95. Down is positive"),
        ("field_nt", 50.0, "'field_nt' must be between 15000 and 80000 nT; got 50. Give it in nT"),
        ("latitude_deg", -91, "'latitude_deg'"),
        ("sd_dip_deg", -0.1, "'sd_dip_deg' must be between 0"),
        ("convergence_deg", 200.0, "'convergence_deg'"),
        ("gravity_ms2", 9.7, "'gravity_ms2' must be 'gravity_g' times 9.80665"),
        ("schema_version", 2, "'schema_version' must be 1; got 2"),
        ("command", "noise", "is not a reference"),
        ("date", "1.7.2026", "is not a reference"),
        ("declination_deg", "2.0", "`$.declination_deg`"),
        ("declination_deg", None, "`$.declination_deg`"),
    ],
)
def test_a_damaged_reference_is_refused(tmp_path, key, value, words):
    file = tmp_path / "ref.json"
    mwdcal("reference", *TYPED, "-o", file)
    document = json.loads(file.read_text("utf-8"))
    file.write_text(json.dumps(document | {key: value}), "utf-8")
    with pytest.raises(InputError) as refusal:
        load_reference(file)
    assert words in str(refusal.value)
    assert "ref.json" in str(refusal.value)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b"\xff", b"[" * 100_000, b"{}" + b" " * 10**6]
)
def test_what_is_no_reference_is_refused(tmp_path, content):
    file = tmp_path / "ref.json"
    file.write_bytes(content)
    with pytest.raises(InputError, match="ref.json is not a reference"):
        load_reference(file)
    with pytest.raises(InputError, match="cannot be read"):
        load_reference(tmp_path / "none.json")


def test_reference_needs_no_pandas():
    code = (
        "import sys; from mwdcal.app.cli import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "assert not {'pandas', 'ppigrf'} & set(sys.modules)"
    )
    import subprocess

    arguments = ["reference", *map(str, TYPED), "--model", "igrf14"]
    ran = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


# Filling a run


def run_file(folder, header, *rows, metadata=""):
    file = folder / "run.csv"
    file.write_text("\n".join([*metadata.splitlines(), header, *rows]) + "\n", "utf-8")
    return file


def filled(folder, file, *options, suffix=".csv"):
    output = folder / f"filled{suffix}"
    ran = mwdcal("reference", *TYPED, "--fill", file, "-o", output, *options)
    assert ran.code == 0, ran.err
    return ran, output


def test_blank_references_of_a_run_are_filled(tmp_path):
    header = "ax,ay,az,ref_field_nt,sd_ref_field_nt,note"
    file = run_file(tmp_path, header, "0.10,0,1,,,a", "0.2,0,1,51300.0,25,b", "0.3,0,1,,40,=c")
    ran, output = filled(tmp_path, file, "--json")
    rows = list(csv.DictReader(output.read_text("utf-8").splitlines()[1:]))
    reference = reference_at(*PLACE)
    assert ran.json["filled"] == {"ref_gravity_g": 3, "ref_field_nt": 2, "ref_dip_deg": 3}
    whole = np.hypot(reference.sd_field_nt, reference.sd_random_field_nt)
    assert [row["ref_field_nt"] for row in rows][1] == "51300.0"
    assert [float(row["ref_field_nt"]) for row in rows][::2] == [reference.field_nt] * 2
    assert [float(row["sd_ref_field_nt"]) for row in rows] == pytest.approx([whole, 25, 40])
    assert {float(row["ref_dip_deg"]) for row in rows} == {reference.dip_deg}
    assert {float(row["ref_gravity_g"]) for row in rows} == {reference.gravity_g}
    assert [row["note"] for row in rows] == ["a", "b", "=c"]
    assert [row["ax"] for row in rows] == ["0.10", "0.2", "0.3"]  # cells as they were
    assert "earth_reference" in output.read_text("utf-8").splitlines()[0]


def test_a_run_without_blank_references_stays_as_it_is(tmp_path):
    ran, output = filled(tmp_path, EXAMPLE / "run.csv")
    assert output.read_text("utf-8") == (EXAMPLE / "run.csv").read_text("utf-8")
    assert "Nothing was filled" in ran.err
    assert "field: run.csv states 48000 nT" in ran.err
    assert "SIMULATED DATA" in ran.out


def test_a_filled_run_calibrates_with_these_references(tmp_path):
    columns = read_csv(EXAMPLE / "run.csv")
    kept = {n: c for n, c in columns.items() if n not in ("ref_gravity_g", "ref_dip_deg")}
    file = tmp_path / "run.csv"
    write_csv(file, {**kept, "ref_field_nt": ["" for _ in kept["ax"]]})
    measured = ("--field-nt", 48_000, "--sd-field-nt", 20, "--gravity-g", 1, "--sd-gravity-g", 1e-6)
    _, output = filled(tmp_path, file, *measured, "--dip-deg", 63, "--sd-dip-deg", 0.02)
    cal = tmp_path / "cal.json"
    ran = mwdcal("calibrate", output, "--tool", EXAMPLE / "tool.toml", "-o", cal)
    assert ran.code == 0, ran.err
    free = {u["id"] for u in json.loads(cal.read_text("utf-8"))["magnetometer"]["undetermined"]}
    assert "scale" not in free


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".xlsx"])
def test_every_format_can_be_filled(tmp_path, suffix):
    header = "ax;ay;az;ref_dip_deg"
    file = run_file(tmp_path, header, "0,1;0;1;", "0,2;0;1;72,5")
    _, output = filled(tmp_path, file, "--decimal", ",", suffix=suffix)
    _, again = filled(tmp_path, output, suffix=".refilled.csv")
    rows = read_csv(again)
    assert [float(v) for v in rows["ref_dip_deg"]] == [reference_at(*PLACE).dip_deg, 72.5]
    assert [float(v) for v in rows["ax"]] == [0.1, 0.2]


@pytest.mark.parametrize(
    ("north", "options", "stated"),
    [
        ("magnetic", (), set()),
        ("true", (), {"declination_deg"}),
        ("grid", ("--crs", "EPSG:23031"), {"declination_deg", "convergence_deg"}),
    ],
)
def test_what_turns_azimuths_is_stated_where_they_need_it(tmp_path, north, options, stated):
    file = run_file(
        tmp_path, "ax,ay,az,ref_azimuth_deg", "0,0,1,10",
        metadata=f"# azimuth_reference = {north}",
    )  # fmt: skip
    _, output = filled(tmp_path, file, *options)
    head = [line for line in output.read_text("utf-8").splitlines() if line[0] == "#"]
    assert {line[2:].split(" = ")[0] for line in head if "_deg = " in line} == stated
    reference = reference_at(*PLACE)
    if stated:
        assert f"# declination_deg = {reference.declination_deg}" in head


def test_grid_azimuths_without_a_grid_are_refused(tmp_path):
    metadata = "# azimuth_reference = grid\n# declination_deg = 7.0"
    file = run_file(tmp_path, "ax,ay,az,ref_azimuth_deg", "0,0,1,10", metadata=metadata)
    ran = mwdcal("reference", *TYPED, "--fill", file, "-o", tmp_path / "out.csv")
    assert "convergence_deg" in refused(ran, 2)
    assert not (tmp_path / "out.csv").exists()
    _, output = filled(tmp_path, file, "--crs", "EPSG:23031")
    assert "# declination_deg = 7.0" in output.read_text("utf-8")  # as given


def test_another_day_than_that_of_the_run_is_reported(tmp_path):
    file = run_file(tmp_path, "ax,ay,az", "0,0,1", metadata="# date = 2026-07-03")
    ran, _ = filled(tmp_path, file)
    assert "states the date '2026-07-03', the reference is of 2026-07-01" in ran.err
