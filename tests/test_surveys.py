"""Surveys with their uncertainty, the toolface switch, and acceptance by fixed limits and by an error model."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct
from scipy.stats import chi2

import mwdcal
import published_wells
from cli_support import EXAMPLE, read_csv, refused, write_csv
from cli_support import mwdcal as cli
from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError
from mwdcal.files.formats import table as tables
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import centred, reference_vectors
from mwdcal.planning.plans import Earth, Truth, grid, run, servo
from mwdcal.presentation import survey_page
from mwdcal.presentation.page import svg
from mwdcal.survey.acceptance import (
    STRENGTH_NAMES,
    Judgement,
    SurveyLimits,
    blindness,
    judged,
    load_survey_limits,
    weighed,
)
from mwdcal.survey.error_model import load_error_model
from mwdcal.survey.path import well_path
from mwdcal.survey.stations import (
    STRENGTHS,
    SURVEY_OBSERVABLES,
    North,
    survey_angles,
    switched,
)
from mwdcal.survey.surveying import survey_readings
from mwdcal.survey.well import well, well_errors

EARTH = Earth()
NOISE = (1e-4, 15.0)
STAND = 1e-4
"""Uncertainty of each angle that the stand sets, radians."""


@cache
def laboratory(seed=0):
    """A tool and its calibration."""
    rng = np.random.default_rng(seed)
    tool = servo(rng)
    plan = grid([0, 45, 90, 135], 12, [0, 90, 180, 270], [30.0])
    sd = {name: np.full(plan.count, STAND) for name in ("inclination", "azimuth", "toolface")}
    sd |= dict(zip(("accelerometer", "magnetometer"), map(np.array, NOISE), strict=True))
    measured = run(tool, plan, rng, NOISE, (STAND, STAND, STAND))
    return tool, mwdcal.calibrate(replace(measured, sd=sd))


def readings(tool, inclination, azimuth, toolface, rng=None, shift=0.0):
    """What the tool reads in a well, with references; `shift` (3,) is a field of the drill string."""
    angles = np.broadcast_arrays(*map(np.atleast_1d, (inclination, azimuth, toolface)))
    count = angles[0].size
    g, b = reference_vectors(*angles, EARTH.gravity, EARTH.field, EARTH.dip)
    warmth = np.full(count, 30.0)
    raw = tool.readings((g, b + shift), warmth)
    if rng is not None:
        raw = {
            name: value + size * rng.normal(size=value.shape)
            for (name, value), size in zip(raw.items(), NOISE, strict=True)
        }
    known = {name: np.full(count, getattr(EARTH, name)) for name in ("gravity", "field", "dip")}
    return Readings(raw["accelerometer"], raw["magnetometer"], warmth, known)


@pytest.mark.parametrize("tools", [80, pytest.param(200, marks=pytest.mark.study)])
def test_uncertainty_covers_the_errors_of_surveys(tools):
    """Errors of calibrations, 12 surveys each, in units of the stated covariance: chi-square, χ²/k = 1."""
    total, count = 0.0, 0
    names = ["inclination", "azimuth", "north_toolface", "gravity", "field", "dip"]
    places = [SURVEY_OBSERVABLES.index(name) for name in names]
    inc, azi, roll = np.radians([[4.0, 30, 88, 120], [20, 140, 260, 330], [10, 100, 200, 300]])
    for seed in range(tools):
        tool, calibration = laboratory(seed)
        surveys = survey_angles(
            calibration, readings(tool, inc, azi, roll, np.random.default_rng(seed))
        )
        vectors = reference_vectors(inc, azi, roll, EARTH.gravity, EARTH.field, EARTH.dip)
        true = np.stack([OBSERVABLES[name].value(*vectors) for name in names], -1)
        error = centred(surveys.value[:, places] - true)
        error[:, 3:5] = (surveys.value[:, places] - true)[:, 3:5]
        sd = surveys.sd[:, places]
        total += float(np.sum((error / sd) ** 2))
        count += error.size
    # errors of one calibration are alike: the sum scatters by no more than that of 6 independent ones of each
    assert total / count == pytest.approx(1.0, abs=4 * np.sqrt(2 / (6 * tools)))


def test_azimuth_does_not_depend_on_the_toolface():
    roll = np.radians(np.arange(0, 360, 7.0))
    for inc in np.radians([1.0, 5, 45, 90, 135, 179]):
        g, b = reference_vectors(np.full(roll.shape, inc), 1.234, roll, 1.0, 48_000.0, 1.1)
        off = centred(OBSERVABLES["azimuth"].value(g, b) - 1.234)
        assert np.abs(off).max() < 1e-12 / np.sin(inc)


def test_the_magnetic_toolface_takes_over_without_a_jump():
    """From 8° to vertical and back: azimuth + gravity toolface goes on as the toolface from north."""
    tool, calibration = laboratory()
    inc = np.radians(np.concatenate([np.arange(8.1, 0, -0.25), [0.0], np.arange(0.1, 8.2, 0.25)]))
    surveys = survey_angles(calibration, readings(tool, inc, np.radians(70), np.radians(40)))
    toolface, sd = surveys.of("toolface")
    kind = surveys.magnetic
    down = slice(0, np.argmin(inc))
    np.testing.assert_array_equal(kind[down], inc[down] < np.radians(3))
    up = slice(np.argmin(inc), None)
    np.testing.assert_array_equal(kind[up], inc[up] <= np.radians(5))
    expected = np.where(kind, np.radians(110), np.radians(40))
    assert np.abs(centred(toolface - expected)).max() < 0.01
    switch = np.flatnonzero(np.diff(kind.astype(int)))
    azimuth = surveys.of("azimuth")[0]
    gravity = surveys.value[:, SURVEY_OBSERVABLES.index("toolface")]
    for i in switch:  # the same stations by either
        for k in (i, i + 1):
            north = surveys.value[k, SURVEY_OBSERVABLES.index("north_toolface")]
            assert abs(centred(azimuth[k] + gravity[k] - north)) < 1e-12
    assert np.isfinite(toolface).all()
    assert np.isfinite(sd).all()
    assert sd[kind].max() < 1.5 * sd[np.abs(inc - np.radians(8.1)) < 1e-9].max()


def test_switch_keeps_its_state_between_its_ends():
    inc = np.array([4.0, 2.9, 4.0, 5.1, 4.0, 3.1, 2.0, 4.9])
    expected = [False, True, True, False, False, False, True, True]
    assert switched(inc, 3.0, 5.0).tolist() == expected


def test_bad_switch_is_refused():
    tool, calibration = laboratory()
    with pytest.raises(InputError, match="`switch` must be"):
        survey_angles(calibration, readings(tool, 1.0, 0.0, 0.0), (0.2, 0.1))


def test_distance_of_the_published_case():
    """MagVAR's public interface, 2026-09-13: 29.4217° N, I 45°, A 45° true, declination 4.24°: 0.9495."""
    limits, _ = load_survey_limits("owsg-mwd")
    roll = np.radians(np.arange(0, 360, 5.0))
    inc, azi = np.radians([45.0, 45 - 4.24])
    g, b = reference_vectors(inc, azi, roll, 9.800 / 9.80665, 46_644.9, np.radians(58.04))
    slope = np.stack([OBSERVABLES[name].gradient(g, b) for name in STRENGTH_NAMES], -2)
    sensors = ((slope * limits.sensor.covariance(g, b)[:, None]) @ slope.mT).mean(0)
    references = np.diag([limits.reference.sd(name) ** 2 for name in STRENGTH_NAMES])
    off = np.array([0.003 / 9.80665, 46_475.6 - 46_644.9, np.radians(57.96 - 58.04)])
    assert weighed(off, sensors + references)[1] == pytest.approx(0.9495, rel=0.02)


def test_error_model_accepts_at_its_probability():
    """Sensor errors, noise and references drawn as stated: 99.73 % of 20,000 surveys are accepted."""
    limits = SurveyLimits(
        name="x",
        probability=0.9973,
        sensor=load_survey_limits()[0].sensor,
        reference=load_survey_limits()[0].reference,
    )
    tool, calibration = laboratory()
    rng = np.random.default_rng(2)
    count = 20_000
    inc, azi, roll = rng.uniform(0.1, 2.0, count), *rng.uniform(0, 6.28, (2, count))
    exact = reference_vectors(inc, azi, roll, EARTH.gravity, EARTH.field, EARTH.dip)
    variance = limits.sensor.covariance(*exact)
    off = np.sqrt(variance) * rng.normal(size=variance.shape)
    warmth = np.full(count, 30.0)
    raw = tool.readings((exact[0] + off[:, :3], exact[1] + off[:, 3:]), warmth)
    known = {
        name: getattr(EARTH, name) + limits.reference.sd(name) * rng.normal(size=count)
        for name in STRENGTH_NAMES
    }
    read = Readings(
        raw["accelerometer"] + NOISE[0] * rng.normal(size=(count, 3)),
        raw["magnetometer"] + NOISE[1] * rng.normal(size=(count, 3)),
        warmth,
        known,
    )
    result = judged(survey_angles(calibration, read), calibration.fields(read), read, limits)
    rejected = np.mean(~result.accepted)
    assert rejected == pytest.approx(0.0027, abs=4 * np.sqrt(0.0027 / count) + 0.0005)
    assert np.median(result.distance) == pytest.approx(np.sqrt(chi2.median(3)), rel=0.03)


def test_axial_interference_is_rejected_and_named():
    tool, calibration = laboratory()
    read = readings(tool, np.radians([10, 40]), np.radians([20, 300]), 1.0, shift=[0, 0, 1500.0])
    limits, _ = load_survey_limits()
    result = judged(survey_angles(calibration, read), calibration.fields(read), read, limits)
    assert not result.accepted.any()
    assert all("distance" in text and "field" in text for text in result.findings())


def test_fixed_limits_hold_one_by_one():
    limits, _ = load_survey_limits("iscwsa-fixed")
    tool, calibration = laboratory()
    read = readings(tool, 0.8, 0.5, np.radians([0.0, 120, 240]))
    known = {**read.known, "dip": read.known["dip"] + np.radians([0.0, 0.3, -0.1])}
    known["field"] = known["field"] + np.array([0.0, 0, 400])
    read = replace(read, known=known)
    result = judged(survey_angles(calibration, read), calibration.fields(read), read, limits)
    assert result.accepted.tolist() == [True, False, False]
    first, second, third = result.findings()
    assert first == ""
    assert second.startswith("dip -0.3")
    assert "at most 0.25" in second
    assert float(third.split()[1]) == pytest.approx(-400, abs=10)


def test_nothing_is_accepted_without_a_reference():
    tool, calibration = laboratory()
    read = replace(readings(tool, 0.8, 0.5, 0.1), known={})
    result = judged(
        survey_angles(calibration, read), calibration.fields(read), read, load_survey_limits()[0]
    )
    assert isinstance(result, Judgement)
    assert not result.accepted.any()
    assert not result.judged.any()
    assert result.findings() == ["not judged: no reference"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "x"', "sets no limit"),
        ('name = "x"\nprobability = 1.0', "probability must be above 0 and below 1"),
        ('name = "x"\nfield_nt = -3.0', "field_nt must be above 0"),
        ('name = "x"\nfield_nt = nan', "field_nt must be above 0"),
        ('name = "x"\nfield_nt = 1.0\n[sensor]\nmagnetometer_bias_nt = -1.0', "at least 0"),
        ('name = "x"\nfeild_nt = 1.0', "limits profile of surveys"),
    ],
)
def test_limits_that_are_none(tmp_path, text, message):
    path = tmp_path / "limits.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_survey_limits(path)


def test_a_distance_of_readings_of_any_uncertainty_is_a_number():
    """One axis so uncertain that strength and dip follow it alone: fully correlated, and yet a distance."""
    along = np.array([3.0, 2.0, -1.0])
    for size in (1e-6, 1.0, 1e15):
        covariance = np.outer(along, along) * size**2 + 1e-24 * np.eye(3)
        assert 0.9 < weighed(along * size, covariance)[1] < 1.1


def test_strengths_lie_where_they_are_said_to():
    assert SURVEY_OBSERVABLES[STRENGTHS] == ("gravity", "field", "dip")


# ------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The calibration of the bundled example."""
    folder = tmp_path_factory.mktemp("well")
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert cli(*fit, "-o", folder / "tool.json").code == 0
    return folder / "tool.json"


BY_CALIBRATION = ("--error-model", "none")
"""Standard uncertainties of calibration, noise and declination alone."""


def floats(cells):
    """Numbers of a column, NaN where it is blank."""
    return np.array([float(cell) if cell else np.nan for cell in cells])


def surveyed_file(example, folder, columns=None, *options, metadata=()):
    """The table that `survey` makes of the example's well, changed; and the document it prints."""
    source = EXAMPLE / "well.csv"
    if columns is not None:
        stated = ("simulated = true", *metadata)
        source = write_csv(folder / "in.csv", {**read_csv(source), **columns}, *stated)
    out = folder / "out.csv"
    ran = cli("survey", example, source, "-o", out, "--json", *options)
    assert ran.code == 0, ran
    return read_csv(out), ran.json


def test_columns_of_a_well(example, tmp_path):
    columns, document = surveyed_file(example, tmp_path, None, *BY_CALIBRATION)
    given = read_csv(EXAMPLE / "well.csv")
    assert [*columns][: len(given)] == [*given]
    values = {k: np.array(v, float) for k, v in columns.items() if k.endswith(("_deg", "_m"))}
    depth = np.array(given["md_m"], float)
    inclination = np.minimum(np.maximum(0.08 * (depth - 120), 0.5), 70)
    azimuth = 20 + 0.06 * np.maximum(depth - 600, 0) + 2.4
    for name, true in {"inclination": inclination, "azimuth_true": azimuth}.items():
        off = (values[f"{name}_deg"] - true + 180) % 360 - 180
        assert np.abs(off / values[f"sd_{name}_deg"]).max() < 4
    assert (values["azimuth_true_deg"] - values["azimuth_magnetic_deg"]) % 360 == pytest.approx(2.4)
    assert "azimuth_grid_deg" not in columns
    assert set(columns["accepted"]) == {"true"}
    assert set(columns["toolface_kind"]) == {"gravity", "magnetic"}
    assert document["accepted"] == document["rows"] == 36
    assert document["north"] == "true"
    assert document["simulated"] is True
    reference = well_path(depth, np.radians(inclination), np.radians(azimuth))
    for k, name in enumerate(("north_m", "east_m", "tvd_m")):
        assert values[name] == pytest.approx(reference[:, k], abs=5 * values[f"sd_{name}"].max())
        assert document["end"][name] == pytest.approx(float(columns[name][-1]), abs=1e-6)


def test_reference_file_gives_norths_and_limits(example, tmp_path):
    place = tmp_path / "here.json"
    made = cli(
        *("reference", "--latitude", "60", "--longitude", "3.5", "--altitude-m", "0"),
        *("--date", "2026-06-01", "--crs", "EPSG:23031", "--field-nt", "48000"),
        *("--dip-deg", "63", "--gravity-g", "1", "--json"),
    )
    assert made.code == 0, made
    place.write_text(made.out)
    blank = dict.fromkeys(("ref_gravity_g", "ref_field_nt", "ref_dip_deg"), [""] * 36)
    columns, document = surveyed_file(
        example, tmp_path, blank, "--reference", place, *BY_CALIBRATION
    )
    stated = made.json
    true, grid, magnetic = (
        np.array(columns[f"azimuth_{name}_deg"], float) for name in ("true", "grid", "magnetic")
    )
    assert (true - magnetic) % 360 == pytest.approx(stated["declination_deg"] % 360)
    assert (true - grid) % 360 == pytest.approx(stated["convergence_deg"] % 360)
    sd = np.array(columns["sd_azimuth_grid_deg"], float)
    alone = np.array(columns["sd_azimuth_magnetic_deg"], float)
    shared = np.hypot(stated["sd_declination_deg"], stated["sd_random_declination_deg"])
    assert sd == pytest.approx(np.hypot(alone, shared))
    assert document["not_judged"] == 0
    assert document["north"] == "grid"
    assert document["reference_sha256"]


@pytest.mark.parametrize(
    ("stated", "sd", "finding"),
    [
        # 0.36°, and 5000° nT over the horizontal field, shared; 0.10° and 3000° nT of each station its own
        ((), (0.36, 5000.0), True),
        (("sd_declination_deg = 0.9",), (0.9, 0.0), False),
    ],
)
def test_a_declination_is_never_exact(example, tmp_path, stated, sd, finding):
    """Expected: OWSG set A Rev 5.1 at 48,000 nT and dip 63°, the example's field."""
    told = ("declination_deg = 2.4", *stated)
    columns, document = surveyed_file(example, tmp_path, {}, *BY_CALIBRATION, metadata=told)
    horizontal = 48_000 * np.cos(np.radians(63))
    shared = np.hypot(sd[0], sd[1] / horizontal)
    declination = np.hypot(shared, np.hypot(0.10, 3000 / horizontal))
    true, alone = (np.array(columns[f"sd_azimuth_{n}_deg"], float) for n in ("true", "magnetic"))
    assert true == pytest.approx(np.hypot(alone, declination), rel=0.01)
    assert document["sd_declination_deg"] == pytest.approx(shared, rel=0.01)
    ids = {each["id"] for each in document["findings"]}
    assert ("declination-uncertainty-assumed" in ids) is finding


def test_a_table_and_a_reference_that_disagree_of_north_are_named(example, tmp_path):
    place = tmp_path / "here.json"
    made = cli(
        *("reference", "--latitude", "60", "--longitude", "3.5", "--altitude-m", "0"),
        *("--date", "2026-06-01", "--crs", "EPSG:23031", "-o", place, "--json"),
    ).json  # fmt: skip
    here, sd = made["declination_deg"], made["sd_declination_deg"]
    for off, turn, expected in ((0.5, 0.0, set()), (4.0, 1.0, {"declination", "convergence"})):
        told = (
            f"declination_deg = {here + off * sd}",
            f"sd_declination_deg = {sd / 2}",
            f"convergence_deg = {made['convergence_deg'] + turn}",
        )
        _, document = surveyed_file(example, tmp_path, {}, "--reference", place, metadata=told)
        norths = {"declination", "convergence"}
        assert disagreements(document) & norths == expected


def disagreements(document):
    ids = (each["id"] for each in document["findings"])
    return {name.removesuffix("-disagrees") for name in ids if name.endswith("-disagrees")}


QUANTITIES = ("gravity", "field", "dip", "declination", "convergence")


@pytest.fixture
def place(tmp_path):
    """A reference of the field and dip of the example's well, with uncertainties that are known here."""
    file = tmp_path / "here.json"
    made = cli(
        *("reference", "--latitude", "60", "--longitude", "3.5", "--altitude-m", "0"),
        *("--date", "2026-06-01", "--crs", "EPSG:23031", "--field-nt", "48000", "--sd-field-nt", "80"),
        *("--dip-deg", "63", "--sd-dip-deg", "0.06", "--gravity-g", "1", "--sd-gravity-g", "0.0001"),
        *("--declination-deg", "2", "--sd-declination-deg", "0.3", "-o", file, "--json"),
    )  # fmt: skip
    assert made.code == 0, made
    return file, made.json


@pytest.mark.parametrize(
    ("calibrated", "surveyed", "expected"),
    [
        ("2026-01-10", "2026-05-20", set()),
        ("2025-06-01", "2026-05-20", set()),
        ("2024-11-01", "2026-05-20", {"calibration-old"}),
        ("2026-05-21", "2026-05-20", {"calibration-later"}),
        ("2019-01-10", "2019-05-20", {"reference-of-another-day"}),
    ],
)
def test_days_that_do_not_belong_together_are_named(
    example, tmp_path, place, calibrated, surveyed, expected
):
    """The reference is of 2026-06-01."""
    record = mwdcal.load(example)
    record = replace_struct(record, tool={**record.tool, "date": calibrated})
    source = write_csv(tmp_path / "in.csv", read_csv(EXAMPLE / "well.csv"), f'date = "{surveyed}"')
    named = {"calibration-old", "calibration-later", "reference-of-another-day"}
    whole = mwdcal.survey(record, source, reference=place[0])
    assert {f.id for f in whole.findings} & named == expected


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "allows for the drift of one year"),
        ({"msa": True}, "allows for the drift of one year"),
        ({"error_model": "none"}, "has nothing of the drift since"),
        ({"msa": True, "sensor_drift": "none"}, "has nothing of the drift since"),
    ],
)
def test_an_old_calibration_says_whether_its_drift_is_in_the_uncertainty(
    example, tmp_path, place, options, words
):
    record = mwdcal.load(example)
    record = replace_struct(record, tool={**record.tool, "date": "2024-01-10"})
    source = write_csv(tmp_path / "in.csv", read_csv(EXAMPLE / "well.csv"), 'date = "2026-05-20"')
    whole = mwdcal.survey(record, source, reference=place[0], **options)
    (text,) = [f.text for f in whole.findings if f.id == "calibration-old"]
    assert words in text


@pytest.mark.parametrize(("times", "named"), [(1.0, False), (1.9, False), (1 / 0.3048, True)])
def test_courses_as_long_as_those_of_feet_taken_for_metres_are_named(
    example, tmp_path, times, named
):
    """The example has 30 m from survey to survey."""
    depths = [repr(times * float(cell)) for cell in read_csv(EXAMPLE / "well.csv")["md_m"]]
    _, document = surveyed_file(example, tmp_path, {"md_m": depths})
    texts = [f["text"] for f in document["findings"] if f["id"] == "long-courses"]
    assert [text[:48] for text in texts] == [
        "the courses between surveys are 98 m long (media"
    ] * named


def table_of(document, gravity=1.0, field=48_000.0, dip=63.0, sd=(0.0001, 60.0, 0.08)):
    """Columns and metadata that state every quantity, with uncertainties."""
    cells = {"ref_gravity_g": gravity, "ref_field_nt": field, "ref_dip_deg": dip}
    columns = {name: [str(value)] * 36 for name, value in cells.items()}
    columns |= {f"sd_{name}": [str(each)] * 36 for name, each in zip(cells, sd, strict=True)}
    convergence = f"convergence_deg = {document['convergence_deg']}"
    return columns, ("declination_deg = 2", "sd_declination_deg = 0.4", convergence)


def test_a_reference_of_which_nothing_is_used_is_not_in_the_record(example, tmp_path, place):
    file, document = place
    columns, metadata = table_of(document)
    with_file = surveyed_file(example, tmp_path, columns, "--reference", file, metadata=metadata)
    without = surveyed_file(example, tmp_path, columns, metadata=metadata)
    assert with_file[0] == without[0]
    assert with_file[1]["reference_sha256"] is None
    assert with_file[1]["reference_sources"] == {
        **dict.fromkeys(QUANTITIES, "table"), "sd_declination": "table"
    }  # fmt: skip
    assert "reference-unused" in {each["id"] for each in with_file[1]["findings"]}
    assert disagreements(with_file[1]) == set()


@pytest.mark.usefixtures("without_pictures")
def test_every_quantity_has_a_source_on_screen_page_table_and_in_json(example, tmp_path, place):
    file, document = place
    columns, _ = table_of(document)
    columns["ref_field_nt"][3:7] = [""] * 4
    columns["ref_dip_deg"] = [""] * 36
    expected = {
        "gravity": "table",
        "field": "table at 32 of 36 rows, else reference",
        "dip": "reference",
        "declination": "table",
        "sd_declination": "reference",
        "convergence": "reference",
    }
    _, told = surveyed_file(
        example, tmp_path, columns, "--reference", file, metadata=("declination_deg = 2",)
    )
    assert told["reference_sources"] == expected
    assert told["reference_sha256"]
    out, page = tmp_path / "again.csv", tmp_path / "s.html"
    screen = cli(
        "survey", example, tmp_path / "in.csv", "--reference", file, "-o", out, "--report", page
    ).out
    line = (
        "gravity, declination: table   field: table at 32 of 36 rows, else reference   "
        "dip, convergence, 1σ of declination: reference"
    )
    assert " ".join(line.split()) in " ".join(screen.split())
    assert line.replace("   ", "; ") in " ".join(page.read_text("utf-8").split())
    assert "reference_sources" in out.read_text("utf-8").partition("station")[0]
    _, alone = surveyed_file(example, tmp_path, dict.fromkeys(columns, [""] * 36))
    assert set(alone["reference_sources"].values()) == {"none"}


def test_an_uncertainty_belongs_to_the_value_beside_it(example, tmp_path, place):
    file, document = place
    told = ("sd_declination_deg = 9",)
    _, survey = surveyed_file(example, tmp_path, {}, "--reference", file, metadata=told)
    assert survey["sd_declination_deg"] == pytest.approx(document["sd_declination_deg"])
    assert "declination-uncertainty-unused" in {each["id"] for each in survey["findings"]}


@pytest.mark.parametrize("name", ["gravity", "field", "dip"])
def test_a_table_and_a_reference_that_contradict_each_other_are_named(
    example, tmp_path, place, name
):
    """Expected: named beyond what 36 readings of a sound table would show once in 22 tables, 3.2σ (Bonferroni)."""
    file, document = place
    at, random = {"gravity": (1.0, 0.0), "field": (48_000.0, 60.0), "dip": (63.0, 0.08)}[name]
    keys = {"gravity": "gravity_g", "field": "field_nt", "dip": "dip_deg"}
    sd = {"gravity": 0.0001, "field": 60.0, "dip": 0.08}[name]
    together = np.sqrt(sd**2 + document[f"sd_{keys[name]}"] ** 2 + random**2)
    for off, expected in ((2.9, set()), (3.5, {name})):
        columns, metadata = table_of(document)
        columns[f"ref_{keys[name]}"][20] = str(at - off * together)
        _, told = surveyed_file(example, tmp_path, columns, "--reference", file, metadata=metadata)
        assert disagreements(told) == expected
        for finding in told["findings"]:
            if expected and finding["id"] == f"{name}-disagrees":
                assert "1 of 36 rows" in finding["text"]


@pytest.mark.parametrize("value", ["-1", '"a bit"', "true", "200"])
def test_an_uncertainty_of_declination_that_cannot_be_is_refused(example, tmp_path, value):
    source = write_csv(
        tmp_path / "in.csv", read_csv(EXAMPLE / "well.csv"), f"sd_declination_deg = {value}",
        "declination_deg = 1.0",
    )  # fmt: skip
    ran = cli("survey", example, source, "-o", tmp_path / "out.csv")
    assert "sd_declination_deg" in refused(ran, 2)


@pytest.mark.usefixtures("without_pictures")
def test_nothing_states_an_uncertainty_without_what_it_leaves_out(example, tmp_path):
    out, page = tmp_path / "out.csv", tmp_path / "s.html"
    source = EXAMPLE / "well.csv"
    ran = cli("survey", example, source, "-o", out, "--report", page, *BY_CALIBRATION)
    left_out = ("interference of the drill string", "drift of the sensors", "sag", "measured depth")
    document = cli("survey", example, source, "-o", out, "--json", *BY_CALIBRATION).json
    for told in (ran.out, page.read_text("utf-8"), out.read_text("utf-8")):
        assert all(name in " ".join(told.split()) for name in left_out)
    assert document["error_terms"] == ["calibration", "noise", "declination"]
    assert all(any(name in each for each in document["not_included"]) for name in left_out)


def test_references_of_the_laboratory_do_not_count_in_a_well(example, tmp_path):
    """The stand's uncertainty of field and dip is that of the laboratory: limits are those of the model."""
    calibration = mwdcal.load(example)
    stand = replace_struct(calibration.profile.stand, field_nt=1.0, dip_deg=0.001, gravity_g=1e-6)
    narrow = replace_struct(calibration, profile=replace_struct(calibration.profile, stand=stand))
    path = tmp_path / "narrow.json"
    mwdcal.save(narrow, path)
    (tmp_path / "b").mkdir()
    first, _ = surveyed_file(example, tmp_path, {})
    second, _ = surveyed_file(path, tmp_path / "b", {})
    shifted = {"ref_field_nt": ["48700"] * 36}
    assert first["accepted"] == second["accepted"]
    one, other = (surveyed_file(c, tmp_path, shifted)[0]["accepted"] for c in (example, path))
    assert one == other


def test_without_reference_nothing_is_accepted(example, tmp_path):
    blank = dict.fromkeys(("ref_gravity_g", "ref_field_nt", "ref_dip_deg"), [""] * 36)
    columns, document = surveyed_file(example, tmp_path, blank)
    assert set(columns["accepted"]) == {""}
    assert document["not_judged"] == 36
    assert "not-judged" in {finding["id"] for finding in document["findings"]}
    assert document["north"] == "magnetic"
    assert "azimuth_true_deg" not in columns


def test_a_well_outside_the_calibrated_temperatures_has_the_reason_and_no_blank_tables(
    example, tmp_path
):
    """The example's run is of 24.8…25.3 °C without temperature terms, which count 5 °C farther."""
    given = read_csv(EXAMPLE / "well.csv")
    low, high = mwdcal.load(example).temperature_c
    hot = {**given, "temperature_c": ["90"] * len(given["md_m"])}
    source, page = write_csv(tmp_path / "in.csv", hot), tmp_path / "p.html"
    ran = cli("survey", example, source, "-o", tmp_path / "out.csv", "--report", page)
    assert ran.code == 0
    told = (
        f"are blank. Rows have results within 5 °C of it ({low - 5:.1f}…{high + 5:.1f} °C). Calibrate at several "
        "temperatures, or choose --outside extrapolate (no uncertainty)."
    )
    assert told in ran.err
    assert "36 without a result" in ran.out
    assert "–    –" not in ran.out
    assert "contributions" not in ran.out
    html = page.read_text("utf-8")
    assert "No survey has a result" in html
    assert told in html
    assert "<svg" not in html[html.index('id="outcome"') :]
    with pytest.warns(UserWarning, match="are blank. Rows have results within 5 °C") as warned:
        mwdcal.survey(mwdcal.load(example), source)
    assert warned[0].filename == __file__
    with pytest.warns(UserWarning, match="choose `outside` extrapolate") as warned:
        mwdcal.apply(mwdcal.load(example), source)
    assert warned[0].filename == __file__


def test_hot_stations_have_no_result_and_no_position(example, tmp_path):
    warm = ["25.1"] * 36
    warm[5] = "90"
    columns, document = surveyed_file(example, tmp_path, {"temperature_c": warm})
    assert columns["inclination_deg"][5] == columns["tvd_m"][5] == columns["accepted"][5] == ""
    assert columns["tvd_m"][6] != ""
    assert document["blank"] == 1
    assert {"outside-temperature", "left-out"} <= {f["id"] for f in document["findings"]}
    columns, _ = surveyed_file(
        example, tmp_path, {"temperature_c": warm}, "--outside", "extrapolate"
    )
    assert columns["inclination_deg"][5] != ""
    assert columns["sd_inclination_deg"][5] == ""
    assert columns["extrapolated"] == ["false"] * 5 + ["true"] + ["false"] * 30
    assert columns["tvd_m"][5] != ""
    # a direction without a stated accuracy leaves none to the positions from there on
    assert [cell == "" for cell in columns["sd_tvd_m"]] == [False] * 5 + [True] * 31
    assert columns["finding"][5] == "not judged: no statement of accuracy"


def test_a_station_without_result_does_not_lack_a_reference(example, tmp_path):
    warm = ["25.1"] * 36
    warm[5] = "90"
    columns, document = surveyed_file(example, tmp_path, {"temperature_c": warm})
    assert columns["finding"][5] == "no result"
    texts = {finding["id"]: finding["text"] for finding in document["findings"]}
    assert "not-judged" not in texts
    assert texts["left-out"].endswith("1 of 36 stations.")


@pytest.mark.parametrize("options", [(), ("--tie-in", "100,-20,1000")])
@pytest.mark.parametrize(
    ("column", "cells"),
    [("temperature_c", ["90", *["25.1"] * 35]), ("md_m", ["", *map(str, range(1000, 1350, 10))])],
)
def test_a_path_that_cannot_begin_at_the_first_station_says_so(
    example, tmp_path, column, cells, options
):
    """Else the tie-in, or zero, would silently be the position of another station."""
    columns, document = surveyed_file(example, tmp_path, {column: cells}, *options)
    assert columns["tvd_m"][0] == ""
    [text] = [f["text"] for f in document["findings"] if f["id"] == "path-from-later"]
    assert f"starts at station {columns['station'][1]}:" in text
    assert any(f["id"] == "path-from-first" for f in document["findings"]) is not bool(options)


def test_a_tie_in_at_a_point_is_no_position_of_a_station(example, tmp_path):
    """The first station lies at the depth of the point: the path begins there, not at the second."""
    depths = {"md_m": [*map(str, range(1000, 1360, 10))]}
    _, document = surveyed_file(example, tmp_path, depths, "--tie-in", "1000,0,0,100,-20,900")
    found = {finding["id"] for finding in document["findings"]}
    assert "left-out" in found
    assert not found & {"path-from-later", "path-from-first"}


def test_what_is_not_judged_is_named(example, tmp_path):
    blank = dict.fromkeys(("ref_field_nt", "ref_dip_deg"), [""] * 36)
    columns, document = surveyed_file(example, tmp_path, blank)
    assert set(columns["accepted"]) == {"true"}
    [text] = [f["text"] for f in document["findings"] if f["id"] == "partly-judged"]
    assert text.startswith("no reference for field and dip at 36 of 36 surveys: `accepted` says")
    assert text.endswith("Give `reference`, or state ref_field_nt and ref_dip_deg above the table.")
    one = ["48000"] * 36
    one[3] = ""
    _, document = surveyed_file(example, tmp_path, {"ref_field_nt": one})
    [text] = [f["text"] for f in document["findings"] if f["id"] == "partly-judged"]
    assert text.startswith("no reference for field at 1 of 36 surveys:")
    _, document = surveyed_file(example, tmp_path)
    assert "partly-judged" not in {f["id"] for f in document["findings"]}


def test_unused_columns_are_listed(example, tmp_path):
    _, document = surveyed_file(example, tmp_path, {"Inc": ["1"] * 36})
    [text] = [f["text"] for f in document["findings"] if f["id"] == "unused-columns"]
    assert "Inc" in text
    assert "md_m" not in text


@pytest.fixture(scope="module")
def relative(tmp_path_factory):
    """The example's tool, calibrated without the strength of the field."""
    folder = tmp_path_factory.mktemp("relative")
    run = read_csv(EXAMPLE / "run.csv")
    run = {name: cells for name, cells in run.items() if "ref_field" not in name}
    source = write_csv(folder / "run.csv", run, "simulated = true")
    made = cli("calibrate", source, "--tool", "servo", "-o", folder / "tool.json")
    assert made.code == 0, made
    return folder / "tool.json"


def test_a_relative_magnetometer_is_judged_by_dip_alone(example, relative, tmp_path):
    """|b| in units of the laboratory's field is no nT; dip has the limits that it has in nT."""
    (tmp_path / "absolute").mkdir()
    _, document = surveyed_file(relative, tmp_path)
    assert document["accepted"] == 36
    assert "partly-judged" not in {f["id"] for f in document["findings"]}
    dip = np.array(read_csv(EXAMPLE / "well.csv")["ref_dip_deg"], float)
    for off, accepted in ((0.1, 36), (2.0, 0)):
        shifted = {"ref_dip_deg": (dip + off).astype(str).tolist()}
        by_ratio, first = surveyed_file(relative, tmp_path, shifted)
        _, second = surveyed_file(example, tmp_path / "absolute", shifted)
        assert first["accepted"] == second["accepted"] == accepted
        assert not any("nT (at most" in finding for finding in by_ratio["finding"])
    blank = {"ref_field_nt": [""] * 36}
    source = write_csv(tmp_path / "blank.csv", {**read_csv(EXAMPLE / "well.csv"), **blank})
    refused = cli("survey", relative, source, "-o", tmp_path / "none.csv")
    assert refused.code == 2
    assert "ref_field_nt" in refused.err
    assert not (tmp_path / "none.csv").exists()
    _, document = surveyed_file(relative, tmp_path, blank, "--error-model", "none")
    [text] = [f["text"] for f in document["findings"] if f["id"] == "partly-judged"]
    assert text.startswith("no reference for dip at 36 of 36")


def test_without_magnetic_readings_the_toolface_is_the_gravity_one(example, tmp_path):
    given = read_csv(EXAMPLE / "well.csv")
    bare = {name: cells for name, cells in given.items() if name not in ("mx", "my", "mz")}
    source, out = write_csv(tmp_path / "in.csv", bare, "simulated = true"), tmp_path / "out.csv"
    ran = cli("survey", example, source, "-o", out, "--json")
    assert ran.code == 0, ran
    columns = read_csv(out)
    assert set(columns["toolface_kind"]) == {"gravity"}
    assert "" not in columns["toolface_deg"]
    assert "no-path" in {finding["id"] for finding in ran.json["findings"]}


def test_tie_in_moves_the_path(example, tmp_path):
    first, _ = surveyed_file(example, tmp_path)
    moved, document = surveyed_file(example, tmp_path, None, "--tie-in", "100,-20,1000")
    for name, shift in (("north_m", 100), ("east_m", -20), ("tvd_m", 1000)):
        gap = np.array(moved[name], float) - np.array(first[name], float)
        assert gap == pytest.approx(shift)
    assert "path-from-first" not in {f["id"] for f in document["findings"]}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            (),
            "path counted from station 1 at 0.00 m MD: north 0.00, east 0.00, TVD 0.00 m",
        ),
        (
            ("--tie-in", "1,-2,30", "--length-unit", "ft"),
            "path counted from station 1 at 0.00 ft MD: north 1.00, east −2.00, TVD 30.00 ft",
        ),
        (("--tie-in", "0,0,0,1,-2,30"), "path tied in at 0.00 m MD"),
    ],
)
def test_the_screen_says_where_north_east_and_tvd_count_from(example, tmp_path, options, words):
    screen = cli("survey", example, EXAMPLE / "well.csv", "-o", tmp_path / "o.csv", *options).out
    [line] = [line for line in screen.splitlines() if line.startswith("path ")]
    assert line.startswith(words)


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ({"md_m": [str(1000 - i) for i in range(36)]}, (), "must not decrease.* Sort"),
        ({"md_m": [*map(str, range(18)), *map(str, range(18))]}, (), "line 21, .*twice.* by --run"),
        (
            {"md_m": [*map(str, range(20)), *map(str, range(3, 19))]},
            (),
            "line 23, .*twice.* by --run",
        ),
        ({"md_m": [*map(str, range(20)), "0", *map(str, range(21, 36))]}, (), "line 23, .* Sort"),
        ({"md_m": [*map(str, range(35)), "0"]}, (), "line 38, .* Sort"),
        (
            {"md_m": ["7", "8", "7.9", *map(str, range(9, 42))]},
            (),
            "line 5, column 'md_m': must not decrease",
        ),
        (
            {"md_m": ["7", "", "6", *map(str, range(9, 42))]},
            (),
            "line 5, column 'md_m': must not decrease",
        ),
        (
            {"DEPT": ["1"] * 36},
            (),
            r"does not state the unit.*'DEPT \(ft\)', or give --length-unit",
        ),
        ({"Bit depth": ["1"] * 36}, (), "column 'Bit depth' does not state the unit"),
        ({"md_m": ["-5", *map(str, range(35))]}, (), "between 0 and 20000"),
        ({"accepted": ["x"] * 36}, (), "'accepted' is there already"),
        ({}, ("--switch", "5"), "--switch"),
        ({}, ("--switch", "6,5"), "--switch"),
        ({}, ("--tie-in", "1,2"), "--tie-in must be 3 or 6 numbers"),
        ({}, ("--limits", "nothing"), "nothing"),
        ({}, ("--error-model", "nothing"), "Built in: owsg-mwd"),
        ({}, ("--outside", "hide"), "--outside"),
    ],
)
def test_bad_input_of_a_well(example, tmp_path, columns, options, message):
    given = read_csv(EXAMPLE / "well.csv")
    if {"DEPT", "Bit depth"} & {*columns}:
        del given["md_m"]
    source = write_csv(tmp_path / "in.csv", {**given, **columns}, "simulated = true")
    ran = cli("survey", example, source, "-o", tmp_path / "out.csv", *options)
    assert re.search(message, refused(ran, 2))
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("name", "options"),
    [("MD [m]", ()), ("Measured depth (m)", ()), ("MD", ("--length-unit", "m"))],
)
def test_depths_in_metres_under_another_name(example, tmp_path, name, options):
    given = read_csv(EXAMPLE / "well.csv")
    other = {name if column == "md_m" else column: cells for column, cells in given.items()}
    ends = []
    for columns, chosen in ((given, ()), (other, options)):
        source = write_csv(tmp_path / "in.csv", columns, "simulated = true")
        ran = cli("survey", example, source, "-o", tmp_path / "out.csv", "--json", *chosen)
        assert ran.code == 0
        assert not any(name in finding["text"] for finding in ran.json["findings"])
        ends.append(ran.json["end"])
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("name", "foot", "options"),
    [
        ("Depth (ft)", 0.3048, ()),
        ("Bit depth [ft]", 0.3048, ()),
        ("MD ft", 0.3048, ("--length-unit", "ft")),
        ("Hole depth (usft)", 1200 / 3937, ()),
        ("Depth (ft)", 1200 / 3937, ("--length-unit", "usft")),
        ("Bit depth", 0.3048, ("--length-unit", "ft")),
    ],
)
def test_depths_in_feet_by_the_title_of_their_column(example, tmp_path, name, foot, options):
    """Courses of 90 m: nobody asks for feet where the unit is stated."""
    given = read_csv(EXAMPLE / "well.csv")
    metres = 3 * np.array(given.pop("md_m"), float)
    columns = {**given, name: [repr(md / foot) for md in metres.tolist()]}
    source = write_csv(tmp_path / "in.csv", columns, "simulated = true")
    ran = cli("survey", example, source, "-o", tmp_path / "out.csv", "--json", *options)
    assert ran.code == 0, ran.err
    assert ran.json["end"]["md_m"] == pytest.approx(metres[-1], abs=1e-9)
    assert not [f for f in ran.json["findings"] if f["id"] == "long-courses" or name in f["text"]]


def test_long_well_is_like_its_parts(example, tmp_path):
    """Results do not depend on how many stations are worked on at once."""
    from mwdcal.survey import path, stations

    whole, _ = surveyed_file(example, tmp_path)
    with (
        patch.object(stations, "STATIONS_AT_ONCE", 7),
        patch.object(path, "STATIONS_AT_ONCE", 5),
    ):
        parts, _ = surveyed_file(example, tmp_path)
    for name in whole:
        if name.endswith(("_deg", "_m", "_nt", "_g")):
            one, other = (floats(t[name]) for t in (whole, parts))
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------ multi-station analysis


def with_iron(folder, axial, inclination=None, azimuth=None):
    """The example's well, or 30 surveys at one attitude, with axial interference; nominal nT by the profile."""
    columns = read_csv(EXAMPLE / "well.csv")
    if inclination is not None:
        roll = np.radians(np.arange(30) * 77.0)
        g, b = reference_vectors(inclination, azimuth, roll, 1.0, 48_000.0, np.radians(63))
        truth = json.loads((EXAMPLE / "truth.json").read_text("utf-8"))
        tool = Truth(np.array(truth["accelerometer"]), np.array(truth["magnetometer"]))
        raw = tool.readings((g, b + np.array([0, 0, axial])), np.full(30, 25.1))
        noise = np.random.default_rng(5).normal(size=(6, 30))
        columns = {name: values[:30] for name, values in columns.items()}
        for k, name in enumerate(("ax", "ay", "az")):
            columns[name] = raw["accelerometer"][:, k] * 3.0 + 3e-4 * noise[k]
        for k, name in enumerate(("mx", "my", "mz")):
            columns[name] = raw["magnetometer"][:, k] * 5e-5 + 7.5e-4 * noise[3 + k]
    else:
        columns["mz"] = [f"{float(value) + 5e-5 * axial:.6f}" for value in columns["mz"]]
    columns |= {"sd_ref_field_nt": ["130"] * len(columns["ax"])}
    columns |= {"sd_ref_dip_deg": ["0.2"] * len(columns["ax"])}
    return write_csv(folder / "iron.csv", columns, "simulated = true")


def test_msa_takes_axial_interference_off(example, tmp_path):
    source, out = with_iron(tmp_path, 1500), tmp_path / "out.csv"
    plain = cli("survey", example, source, "-o", out, "--json").json
    assert plain["rejected"] > 20
    assert plain["interference"] is plain["separable"] is None
    ran = cli(
        "survey", example, source, "-o", out, "--msa", "--json", "--report", tmp_path / "m.html"
    )
    assert ran.code == 0, ran
    size = ran.json["interference"]
    # 1500 nT on the sensor, whose scale is within 2 % of nominal
    assert size["axial_nt"] == pytest.approx(1500, abs=3 * size["sd_axial_nt"] + 30)
    assert ran.json["separable"] is True
    assert ran.json["rejected"] == 0
    columns = read_csv(out)
    depth = np.array(columns["md_m"], float)
    true = 20 + 0.06 * np.maximum(depth - 600, 0)
    off = (np.array(columns["azimuth_magnetic_deg"], float) - true + 180) % 360 - 180
    sd = floats(columns["sd_azimuth_magnetic_deg"])
    assert np.nanmax(np.abs(off / sd)) < 4
    assert "SIMULATED" in (tmp_path / "m.html").read_text("utf-8")


@pytest.mark.usefixtures("without_pictures")
def test_results_say_whether_interference_was_taken_off(example, tmp_path):
    source, out, page = with_iron(tmp_path, 1500), tmp_path / "out.csv", tmp_path / "s.html"
    for options, corrected in (((), False), (("--msa",), True)):
        ran = cli(
            "survey",
            example,
            source,
            "-o",
            out,
            "--report",
            page,
            "--json",
            *options,
            *BY_CALIBRATION,
        )
        ids = {finding["id"] for finding in ran.json["findings"]}
        shown = " ".join(page.read_text("utf-8").split())
        assert ("interference-corrected" in ids) is corrected
        assert ("corrected for interference" in out.read_text("utf-8")) is corrected
        assert ("Not in it: interference of the drill string" in shown) is not corrected
        assert "judged by all three together" in shown
    cli("survey", example, source, "-o", out, "--report", page, "--limits", "fixed")
    assert "judged by all three together" not in " ".join(page.read_text("utf-8").split())


@pytest.mark.parametrize(
    ("inclination", "azimuth", "limits", "along", "across"),
    [
        # horizontal east: |b|' = √(B² + h²), sin(dip)' = B sin(dip) / |b|', the azimuth turns by atan(h / B cos dip);
        # 2034 nT move the dip by 0.1°, 5375 nT |b| by 300 nT
        (90, 90, {"dip_deg": 0.1}, (2000, np.arctan(2000 / 21_791.5)), (0, 0.0)),
        (90, 90, {"field_nt": 300.0}, (3000, np.arctan(3000 / 21_791.5)), (0, 0.0)),
        # horizontal north: along the tool nothing turns, across it all of 300 nT east do
        (90, 0, {"dip_deg": 0.1}, (None, 0.0), (300, np.arctan(300 / 21_791.5))),
    ],
)
def test_interference_that_would_pass(inclination, azimuth, limits, along, across):
    tool, calibration = laboratory()
    inc, azi = np.radians([float(inclination)]), np.radians([float(azimuth)])
    b = reference_vectors(inc, azi, 0.0, 1.0, 48_000.0, np.radians(63))
    read = readings(tool, inc, azi, 0.0)
    judgement = judged(
        survey_angles(calibration, read), b, read, SurveyLimits(name="ours", **limits)
    )
    blind = blindness(judgement.tests, b)
    for k, (size, turn) in enumerate((along, across)):
        assert blind.turn[0, k] == pytest.approx(turn, abs=1e-3)
        assert size in (None, 0) or blind.size[0, k] == pytest.approx(size)


@pytest.mark.parametrize("limits", ["owsg-mwd", "iscwsa-fixed"])
def test_all_sizes_of_interference_are_tried(limits):
    """What passes and turns the azimuth most is that of every size, tried with the observables themselves."""
    tool, calibration = laboratory()
    angles = np.random.default_rng(7).uniform([0.0, 0.0, 0.0], [np.pi, 6.28, 6.28], (300, 3))
    angles[0] = 0.0
    read = readings(tool, *angles.transpose())
    known = {"gravity": 1.0, "field": 48_000.0, "dip": np.radians(63)}
    known = {name: np.full(300, value) for name, value in known.items()}
    known["dip"][5], known["field"][6], known["gravity"][7] = np.nan, np.nan, np.nan
    read = replace(read, known=known)
    g, b = vectors = calibration.fields(read)
    tests = judged(
        survey_angles(calibration, read), vectors, read, load_survey_limits(limits)[0]
    ).tests
    found = blindness(tests, vectors)
    along = [(0.0, 0.0, sign * size) for sign in (1, -1) for size in range(50, 3001, 50)]
    ways = [(np.cos(way), np.sin(way), 0.0) for way in np.radians(range(0, 360, 30))]
    across = [np.multiply(way, size) for way in ways for size in range(50, 301, 50)]

    def change(name, place, seen):
        value = OBSERVABLES[name].value
        return value(np.broadcast_to(g[place], seen.shape), seen) - value(g[place], b[place])

    for k, fields in enumerate((along, across)):
        for place, there in enumerate(~tests.missing):
            seen = b[place] + np.array(fields)
            off = np.stack([change(name, place, seen) for name in STRENGTH_NAMES], -1)[:, there]
            square = (off @ np.linalg.inv(tests.covariance[place][np.ix_(there, there)]) * off).sum(
                -1
            )
            passing = (np.abs(off) <= tests.fixed[there]).all(-1)
            passing &= square <= tests.largest[place] ** 2
            turn = np.abs(centred(np.nan_to_num(change("azimuth", place, seen))))
            assert found.turn[place, k] == pytest.approx(np.max(turn * passing), abs=1e-9)
    assert 20 < (found.turn[:, 0] > np.radians(1)).sum() < 300


def test_only_multi_station_analysis_takes_fingerprints():
    _, calibration = laboratory()
    table = tables.read(EXAMPLE / "well.csv")
    assert survey_readings(table, calibration, recognised=False).readings.digest == ()
    assert len(survey_readings(table, calibration).readings.digest) == table.count


def test_what_is_accepted_is_what_the_tests_accept():
    tool, calibration = laboratory()
    rng = np.random.default_rng(4)
    angles = (rng.uniform(0.1, 3, 50), rng.uniform(0, 6, 50), rng.uniform(0, 6, 50))
    read = readings(tool, *angles, rng, shift=rng.normal(size=(50, 3)) * 400)
    vectors = calibration.fields(read)
    for limits in (load_survey_limits()[0], SurveyLimits(name="ours", field_nt=200.0)):
        judgement = judged(survey_angles(calibration, read), vectors, read, limits)
        departure = judgement.departure.transpose()[:, :, None]
        again = judgement.tests.accept(dict(zip(STRENGTH_NAMES, departure, strict=True)))[:, 0]
        assert 5 < judgement.accepted.sum() < 45
        assert (again == judgement.accepted).all()


@pytest.mark.usefixtures("without_pictures")
def test_acceptance_that_is_blind_says_so_by_survey(example, tmp_path):
    source, out, page = (tmp_path / name for name in ("iron.csv", "out.csv", "s.html"))
    with_iron(tmp_path, 600, np.radians(90), np.radians(90))
    ran = cli("survey", example, source, "-o", out, "--report", page)
    document = cli("survey", example, source, "-o", out, "--json").json
    columns = read_csv(out)
    assert document["accepted"] == document["blind"] == len(columns["accepted"]) == 30
    assert all("along the tool by" in text for text in columns["finding"])
    assert "blind-to-interference" in {finding["id"] for finding in document["findings"]}
    assert "accepted, blind" in ran.out
    assert "30 blind to interference" in page.read_text("utf-8")
    north = with_iron(tmp_path, 0, np.radians(60), np.radians(10))
    ran = cli("survey", example, north, "-o", out, "--msa", "--json")
    assert ran.json["blind"] == 0


def test_sensor_drift_is_for_msa_and_is_named(example, tmp_path):
    source, out = with_iron(tmp_path, 1500), tmp_path / "out.csv"
    assert "--sensor-drift goes with --msa" in refused(
        cli("survey", example, source, "-o", out, "--sensor-drift", "owsg"), 2
    )
    left = {}
    for drift in ("owsg", "none"):
        ran = cli("survey", example, source, "-o", out, "--msa", "--sensor-drift", drift, "--json")
        left[drift] = ran.json["interference"]["sd_axial_nt"]
        held = ran.json["error_terms"]
        assert "interference of the drill string" in held
        assert ("drift of the sensors since the calibration" in held) is (drift == "owsg")
    # 70 nT of drift of the axial sensor's bias cannot be told from interference; drift of scales adds a little
    least = np.hypot(left["none"], 70.0)
    assert least < left["owsg"] < 1.2 * least


def test_msa_near_horizontal_east_west_is_refused(example, tmp_path):
    source, out = with_iron(tmp_path, 1500, np.radians(89), np.radians(90)), tmp_path / "out.csv"
    ran = cli("survey", example, source, "-o", out, "--msa")
    assert "do not separate interference from azimuth" in refused(ran, 3)
    assert not out.exists()
    ran = cli("survey", example, source, "-o", out, "--msa", "--json")
    assert ran.code == 3
    assert ran.json["separable"] is False
    assert ran.json["msa"]["missing"]
    assert not out.exists()
    north = with_iron(tmp_path, 1500, np.radians(60), np.radians(10))
    assert cli("survey", example, north, "-o", out, "--msa", "--json").json["separable"] is True


@pytest.mark.usefixtures("without_pictures")
def test_the_page_shows_the_analysis_of_msa_alone(example, tmp_path):
    line = ("survey", example, EXAMPLE / "well.csv", "-o", tmp_path / "o.csv")
    page, alone = tmp_path / "s.html", tmp_path / "m.html"
    assert cli(*line, "--report", page).code == 0
    assert "Interference of the drill string" not in page.read_text("utf-8")
    north = with_iron(tmp_path, 1500, np.radians(60), np.radians(10))
    assert (
        cli(
            "survey", example, north, *line[3:], "--msa", "--report", page, "--msa-html", alone
        ).code
        == 0
    )
    whole, part = (path.read_text("utf-8") for path in (page, alone))
    assert whole.count("Interference of the drill string") == 1
    ids = re.findall(r'<section id="([^"]+)"', whole)
    assert len(ids) == len({*ids})
    assert {f"analysis-{name}" for name in re.findall(r'<section id="([^"]+)"', part)[1:-1]} < {
        *ids
    }
    assert "--msa" in refused(cli(*line, "--msa-html", alone), 2)


# ------------------------------------------------------------------ sensor terms


def test_tool_model_of_a_calibration(example, tmp_path):
    ran = cli("convert", example, "--to", "tool-model", "-o", tmp_path / "m.json", "--json")
    assert ran.code == 0, ran
    terms = {term["name"]: term for term in ran.json["terms"]}
    model = json.loads((tmp_path / "m.json").read_text("utf-8"))
    values = {term["name"]: term["value"] for term in model["terms"]}
    assert values["ABZ"] == pytest.approx(terms["ABZ"]["value"])
    assert terms["MBZ"]["ratio"] == pytest.approx(terms["MBZ"]["value"] / 70)
    assert "ABXY" in cli("convert", example, "--to", "tool-model", "-o", tmp_path / "m.json").out
    bad = cli(
        "convert",
        example,
        "--to",
        "tool-model",
        "-o",
        tmp_path / "m.json",
        "--temperature",
        "course",
    )
    assert "--temperature" in refused(bad, 2)


# ------------------------------------------------------------------ the error model


def test_the_error_model_is_in_every_uncertainty_by_default(example, tmp_path):
    """Expected: formulas of OWSG set A Rev 5.1 at the last station, with a year of drift of the sensors."""
    columns, document = surveyed_file(example, tmp_path)
    alone, _ = surveyed_file(example, tmp_path, None, *BY_CALIBRATION)
    assert document["error_model"] == "owsg-mwd"
    assert document["error_model_sha256"]
    assert "axial interference of the drill string" in document["error_terms"]
    assert document["not_included"] == [
        "cross-axial interference of the drill string", "drift of the sensors with temperature"
    ]  # fmt: skip
    inclination, azimuth = (
        np.radians(float(columns[f"{name}_deg"][-1]))
        for name in ("inclination", "azimuth_magnetic")
    )
    sine, cosine, dip = np.sin(inclination), np.cos(inclination), np.radians(63)
    hole = [0.2 * sine**0.25, 0.1 * sine, 0.3 * cosine]
    scale = np.degrees(0.0005 * sine * cosine) * np.sqrt(2)
    expected = [*hole, np.degrees(0.004 / 9.80665), scale, floats(alone["sd_inclination_deg"])[-1]]
    stated = floats(columns["sd_inclination_deg"])[-1]
    assert stated == pytest.approx(np.linalg.norm(expected), rel=0.01)
    turn = np.degrees(220 * sine * np.sin(azimuth) / (48_000 * np.cos(dip)))
    assert floats(columns["sd_azimuth_magnetic_deg"])[-1] > np.hypot(turn, 0.1)
    for name in ("north", "east", "tvd"):
        assert floats(columns[f"sd_{name}_m"])[-1] > floats(alone[f"sd_{name}_m"])[-1]


@pytest.mark.parametrize(("years", "share"), [(0.25, 0.5), (1.0, 1.0), (4.0, 1.0)])
def test_drift_grows_with_the_time_since_the_calibration(example, years, share):
    model, calibration = load_error_model(), mwdcal.load(example)
    dated = replace_struct(calibration, tool={**calibration.tool, "date": "2025-01-01"})
    day = str(np.datetime64("2025-01-01") + round(years * 365.25))
    readings = Readings(np.ones((1, 3)), np.ones((1, 3)), metadata={"date": day})
    errors = well_errors(model, dated, readings)
    assert errors.years == pytest.approx(years, abs=0.002)
    assert errors.sensors.magnetometer_bias_nt == pytest.approx(70.0 * share, rel=0.005)
    assert errors.sensors.axial_interference_nt == 220.0


def test_norths_in_results_are_those_that_the_table_states(example, tmp_path):
    given = "declination_deg = 1.5", "sd_declination_deg = 0.35", "convergence_deg = -0.7"
    source = write_csv(
        tmp_path / "in.csv", read_csv(EXAMPLE / "well.csv"), "simulated = true", *given
    )
    document = cli("survey", example, source, "-o", tmp_path / "out.csv", "--json").json
    lines = (tmp_path / "out.csv").read_text("utf-8").splitlines()
    assert {f"# {each}" for each in given} <= {*lines}
    assert [document[each.split()[0]] for each in given] == [1.5, 0.35, -0.7]


def test_dates_that_are_not_known_are_asked_for(example, tmp_path):
    calibration, given = mwdcal.load(example), read_csv(EXAMPLE / "well.csv")
    tool = replace_struct(calibration, tool={**calibration.tool, "date": "2025-01-01"})
    for cal, above, words in (
        (calibration, (), "a year: date the surveys and the calibration run, by a line Date above"),
        (
            tool,
            (),
            "taken as a year: date the surveys, by a line Date above the table or by --date",
        ),
        (tool, ("Date: 2025-07-02",), "drift of the sensors over 0.50 years since the calibration"),
        (
            tool,
            ("Date: 2024-07-02",),
            "over an unknown time since the calibration, taken as a year\n",
        ),
    ):
        source = write_csv(tmp_path / "in.csv", given, "simulated = true", *above)
        assert words in mwdcal.survey(cal, source).summary()


# ------------------------------------------------------------------ a well as it is drilled


def test_stations_at_one_depth_are_all_judged_and_one_is_on_the_path(example, tmp_path):
    given = read_csv(EXAMPLE / "well.csv")
    twice = {name: [cell for cell in cells for _ in range(2)] for name, cells in given.items()}
    twice["station"] = [str(i) for i in range(72)]
    source = write_csv(tmp_path / "in.csv", twice, "simulated = true")
    ran = cli("survey", example, source, "-o", tmp_path / "twice.csv", "--json")
    assert ran.code == 0, ran
    columns, once = read_csv(tmp_path / "twice.csv"), surveyed_file(example, tmp_path, {})[0]
    assert set(columns["accepted"]) == {"true"}
    assert columns["tvd_m"][1::2] == [""] * 36
    assert floats(columns["tvd_m"][::2]) == pytest.approx(floats(once["tvd_m"]), abs=1e-9)
    assert "left-out" in {finding["id"] for finding in ran.json["findings"]}


def test_rows_without_readings_keep_their_place(example, tmp_path):
    given = read_csv(EXAMPLE / "well.csv")
    blank = {name: [*given[name]] for name in ("ax", "ay", "az", "mx", "my", "mz")}
    for cells in blank.values():
        cells[0] = cells[7] = ""
    source = write_csv(tmp_path / "in.csv", {**given, **blank}, "simulated = true")
    out = tmp_path / "out.csv"
    assert "--missing blank" in refused(cli("survey", example, source, "-o", out), 2)
    ran = cli("survey", example, source, "-o", out, "--missing", "blank", "--json")
    assert ran.code == 0, ran
    columns, whole = read_csv(out), surveyed_file(example, tmp_path, {})[0]
    assert columns["md_m"] == given["md_m"]
    for name in ("inclination_deg", "accepted", "finding", "north_m"):
        assert columns[name][0] == columns[name][7] == ""
    assert columns["inclination_deg"][8] == whole["inclination_deg"][8]
    assert "missing-reading" in {finding["id"] for finding in ran.json["findings"]}


def test_a_path_that_is_tied_in_begins_at_the_tie_in(example, tmp_path):
    """Expected: the path from the first station, moved by the arc that leads there from the tie-in."""
    at = ("-100", "0.3", "350", "7", "-4", "-98")
    options = (*BY_CALIBRATION, "--tie-in")
    ran = cli(
        "survey", example, EXAMPLE / "well.csv", "-o", tmp_path / "o.csv", *options, ",".join(at)
    )
    assert "--tie-in must have a depth" in refused(ran, 2)
    moved = {"md_m": [str(float(cell) + 200) for cell in read_csv(EXAMPLE / "well.csv")["md_m"]]}
    tied, _ = surveyed_file(example, tmp_path, moved, *options, "100,0.3,350,7,-4,98")
    first, _ = surveyed_file(example, tmp_path, moved, *BY_CALIBRATION)
    azimuth = "azimuth_magnetic_deg"
    ends = [
        np.radians([0.3, float(first["inclination_deg"][0])]),
        np.radians([350.0, float(first[azimuth][0])]),
    ]
    arc = well_path([100.0, 200.0], *ends, start=(7.0, -4.0, 98.0))[1]
    for k, name in enumerate(("north_m", "east_m", "tvd_m")):
        assert floats(tied[name]) == pytest.approx(floats(first[name]) + arc[k], abs=1e-9)
    # the direction at the tie-in is exact, that of the first station is not
    assert 0 < float(tied["sd_north_m"][0]) < float(tied["sd_north_m"][1])


def test_a_tie_in_has_three_numbers_or_six(example, tmp_path):
    ran = cli(
        "survey", example, EXAMPLE / "well.csv", "-o", tmp_path / "o.csv", "--tie-in", "1,2,3,4"
    )
    assert "--tie-in must be 3 or 6 numbers" in refused(ran, 2)


def test_dogleg_severity_and_vertical_section(example, tmp_path):
    """Expected: cos β = cos ΔI - sin I₁ sin I₂ (1 - cos ΔA), and north cos A + east sin A."""
    columns, _ = surveyed_file(example, tmp_path, None, *BY_CALIBRATION, "--section-azimuth", "40")
    names = ("md_m", "inclination_deg", "azimuth_true_deg")
    md, inclination, azimuth = (floats(columns[name]) for name in names)
    i, a = np.radians(inclination), np.radians(azimuth)
    turned = np.sin(i[1:]) * np.sin(i[:-1]) * (1 - np.cos(np.diff(a)))
    dogleg = np.degrees(np.arccos(np.clip(np.cos(np.diff(i)) - turned, -1, 1))) / np.diff(md) * 30
    assert columns["dogleg_severity_deg_per_30m"][0] == ""
    ours = floats(columns["dogleg_severity_deg_per_30m"])[1:]
    np.testing.assert_allclose(ours, dogleg, rtol=1e-5, atol=1e-6)
    section = np.radians(40)
    north, east = (floats(columns[f"{name}_m"]) for name in ("north", "east"))
    expected = north * np.cos(section) + east * np.sin(section)
    np.testing.assert_allclose(floats(columns["vertical_section_m"]), expected, atol=1e-9)


# ------------------------------------------------------------------ feet


@pytest.mark.parametrize(("unit", "metres"), [("ft", 0.3048), ("usft", 1200 / 3937)])
def test_feet_are_metres_in_another_unit(example, tmp_path, unit, metres):
    """Depths that state feet, or none: every length is that of the same well in metres, divided by the foot."""
    given = read_csv(EXAMPLE / "well.csv")
    deep = [repr(float(cell) / metres) for cell in given.pop("md_m")]
    whole, document = surveyed_file(example, tmp_path, {})
    path = tmp_path / "contributions.csv"
    for name in (f"md_{unit}", "MD", f"MD ({unit})"):
        source = write_csv(tmp_path / "feet.csv", {**given, name: deep}, "simulated = true")
        out = tmp_path / "feet_out.csv"
        typed = ("survey", example, source, "-o", out, "--length-unit", unit)
        ran = cli(*typed, "--contributions", path, "--json")
        assert ran.code == 0, ran
        columns = read_csv(out)
        assert not [column for column in columns if column.endswith("_m")]
        for column in ("north", "sd_east", "tvd", "vertical_section"):
            expected = floats(whole[f"{column}_m"]) / metres
            np.testing.assert_allclose(
                floats(columns[f"{column}_{unit}"]), expected, rtol=1e-9, atol=1e-9
            )
        severity = floats(columns[f"dogleg_severity_deg_per_100{unit}"])[1:]
        metric = floats(whole["dogleg_severity_deg_per_30m"])[1:]
        np.testing.assert_allclose(severity, metric / 30 * 100 * metres, rtol=1e-9, atol=1e-9)
        assert ran.json["length_unit"] == unit
        assert ran.json["end"]["tvd_m"] == pytest.approx(document["end"]["tvd_m"], rel=1e-12)
        last = read_csv(path)
        assert float(last[f"md_{unit}"][-1]) == pytest.approx(1050 / metres, rel=1e-12)
        assert f"at {1050 / metres:.2f} {unit} MD" in cli(*typed).out


def test_feet_of_a_tie_in_of_a_table_in_metres_and_of_the_settings(example, tmp_path, monkeypatch):
    moved = {"md_m": [str(float(cell) + 200) for cell in read_csv(EXAMPLE / "well.csv")["md_m"]]}
    metric, _ = surveyed_file(example, tmp_path, moved, "--tie-in", "30.48,1,20,0,3.048,30.48")
    feet = ("--tie-in", "100,1,20,0,10,100", "--length-unit", "ft")
    tied, _ = surveyed_file(example, tmp_path, moved, *feet)
    np.testing.assert_allclose(
        floats(tied["east_ft"]), floats(metric["east_m"]) / 0.3048, rtol=1e-9
    )
    (tmp_path / "mwdcal.toml").write_text('length_unit = "usft"\n')
    monkeypatch.chdir(tmp_path)
    stated, _ = surveyed_file(example, tmp_path, moved)
    assert "tvd_usft" in stated
    chosen, _ = surveyed_file(example, tmp_path, moved, "--length-unit", "m")
    assert "tvd_m" in chosen


@pytest.mark.parametrize("title", ["Measured Depth (ft)", "MD", "Hole depth [m]"])
def test_a_depth_under_its_own_title_is_not_called_unused(example, tmp_path, title):
    given = read_csv(EXAMPLE / "well.csv")
    columns = {title: given.pop("md_m"), "pump": ["1"] * 36, **given}
    source = write_csv(tmp_path / "titled.csv", columns, "simulated = true")
    typed = ("--length-unit", "ft", "--json")
    ran = cli("survey", example, source, "-o", tmp_path / "well.csv", *typed)
    assert ran.code == 0, ran
    assert [f["text"] for f in ran.json["findings"] if f["id"] == "unused-columns"] == [
        "columns not used: 'pump'."
    ]


def test_every_depth_track_of_the_page_has_its_axis(example):
    """A narrow screen shows the tracks below each other: all but the dial of toolfaces have depths and a title."""
    well = mwdcal.survey(example, EXAMPLE / "well.csv").surveyed.well
    for draw, dials in ((survey_page.strengths, 0), (survey_page.angles, 1)):
        figure = draw(well)
        svg(figure, "x")
        tracks = [axes for axes in figure.axes if axes.name != "polar"]
        assert len(figure.axes) - len(tracks) == dials
        assert {axes.get_ylabel() for axes in tracks} == {"measured depth, m"}
        assert all(label.get_visible() for axes in tracks for label in axes.get_yticklabels())


def test_a_trajectory_in_feet_says_so(example, tmp_path):
    given = read_csv(EXAMPLE / "well.csv")
    feet = {"md_ft": [repr(float(cell) / 0.3048) for cell in given.pop("md_m")], **given}
    source = write_csv(tmp_path / "feet.csv", feet, "simulated = true")
    out = tmp_path / "well.xml"
    ran = cli("survey", example, source, "-o", out, "--length-unit", "ft")
    assert ran.code == 0, ran
    text = out.read_text("utf-8")
    assert text.count('<md uom="ft">') == text.count('<tvd uom="ft">') == 36
    assert 'uom="m"' not in text


# ------------------------------------------------------------------ ISCWSA's example wells


@pytest.mark.parametrize("number", [2, 3])
def test_a_calibrated_tool_lacks_the_sensor_terms_of_the_published_wells(number):
    """Right after its calibration: their published totals less AB, AS, MB, MS and declination, plus its own covariance.

    The declination is exact here. 1 % of the total: published figures are by the balanced tangential method.
    """
    tool, calibration = laboratory()
    today = {"date": "2026-05-20"}
    calibration = replace_struct(calibration, tool={**calibration.tool, **today})
    md, inclination, azimuth = published_wells.stations(number)
    field, dip, declination = published_wells.EARTH[number]
    angles = (inclination, azimuth - np.radians(declination), np.radians(67.0 * np.arange(len(md))))
    g, b = reference_vectors(*angles, 1.0, field, np.radians(dip))
    raw = tool.readings((g, b), np.full(len(md), 30.0))
    surveys = Readings(
        raw["accelerometer"], raw["magnetometer"], np.full(len(md), 30.0), metadata=today
    )
    limits, _ = load_survey_limits()
    north = North(np.radians(declination))
    own, whole = (
        well(calibration, surveys, limits, north, md, model=model).position.covariance[-1]
        for model in (None, load_error_model())
    )
    published = published_wells.published(number)
    replaced = ("AB", "AS", "MB", "MS", "DEC", "DBH")
    terms = [each for name, each in published.items() if name.startswith(replaced)]
    nn, ee, vv, ne, nv, ev = published["TOTAL"] - sum(terms)
    expected = own + np.array([[nn, ne, nv], [ne, ee, ev], [nv, ev, vv]])
    assert whole == pytest.approx(expected, abs=0.01 * np.trace(expected))
    assert np.trace(whole) < 0.95 * published["TOTAL"][:3].sum()


# ------------------------------------------------------------------ references by station


def test_a_declination_by_row_turns_each_row_by_its_own(example, tmp_path):
    """Expected: true = magnetic + declination at every row; 1σ that rows share and 1σ of each, added as squares."""
    declination, shared, alone = (
        np.linspace(1.0, 4.0, 36),
        np.linspace(0.1, 0.3, 36),
        np.full(36, 0.2),
    )
    rows = {
        "ref_declination_deg": [repr(value) for value in declination.tolist()],
        "sd_ref_declination_deg": [repr(value) for value in shared.tolist()],
        "sd_random_ref_declination_deg": [repr(value) for value in alone.tolist()],
    }
    columns, document = surveyed_file(example, tmp_path, rows, *BY_CALIBRATION)
    magnetic, true = (floats(columns[f"azimuth_{name}_deg"]) for name in ("magnetic", "true"))
    np.testing.assert_allclose((true - magnetic) % 360, declination, atol=1e-9)
    without, _ = surveyed_file(example, tmp_path, {}, *BY_CALIBRATION)
    known = ~np.isnan(floats(without["sd_azimuth_magnetic_deg"]))
    sd = np.sqrt(floats(without["sd_azimuth_magnetic_deg"]) ** 2 + shared**2 + alone**2)
    np.testing.assert_allclose(floats(columns["sd_azimuth_true_deg"])[known], sd[known], rtol=1e-9)
    assert document["declination_deg"] == pytest.approx(2.5)
    assert document["reference_sources"]["declination"] == "table"
    assert not {"unused-columns", "column-unused"} & {each["id"] for each in document["findings"]}
    angles = (np.radians(floats(columns[f"{n}_deg"])) for n in ("inclination", "azimuth_true"))
    path = well_path(floats(columns["md_m"]), *angles)
    np.testing.assert_allclose(floats(columns["east_m"]), path[:, 1], atol=1e-6)
    # the end turns by the shift that all rows share, weighted by courses; that of each row adds up as squares
    sine = np.sin(np.radians(floats(columns["inclination_deg"])))
    course = 30.0 * np.where(np.isin(np.arange(36), (0, 35)), 0.5, 1.0) * sine
    heading = np.radians(floats(columns["azimuth_true_deg"]))
    shift = np.radians(np.stack([shared, alone])) * course
    north = np.hypot((shift[0] * np.sin(heading)).sum(), np.linalg.norm(shift[1] * np.sin(heading)))
    stated = floats(columns["sd_north_m"])[-1]
    alone_north, _ = surveyed_file(
        example, tmp_path, rows | {k: ["0"] * 36 for k in [*rows][1:]}, *BY_CALIBRATION
    )
    rest = floats(alone_north["sd_north_m"])[-1]
    assert np.sqrt(stated**2 - rest**2) == pytest.approx(north, rel=0.01)


@pytest.mark.parametrize("name", ["ref_declination_deg", "declination_deg"])
def test_declinations_by_row_about_180_degrees_have_a_mean_there(example, tmp_path, name):
    """Expected: the direction of the sum of unit vectors at the declinations; by the metadata key as well."""
    cells = np.where(np.arange(36) % 3 == 0, 179.7, -179.9)
    rows = {name: [repr(value) for value in cells.tolist()]}
    columns, document = surveyed_file(example, tmp_path, rows, *BY_CALIBRATION)
    turned = floats(columns["azimuth_true_deg"]) - floats(columns["azimuth_magnetic_deg"])
    np.testing.assert_allclose(turned % 360, cells % 360, atol=1e-9)
    assert "unused-columns" not in {each["id"] for each in document["findings"]}
    mean = np.degrees(np.angle(np.exp(1j * np.radians(cells)).sum()))
    assert document["declination_deg"] == pytest.approx(mean, abs=1e-5)


def test_a_declination_by_row_is_whole_or_has_one_that_stands_for_it(example, tmp_path):
    cells = ["2.4"] * 35 + [""]
    given = {**read_csv(EXAMPLE / "well.csv"), "ref_declination_deg": cells}
    source = write_csv(tmp_path / "in.csv", given, "simulated = true")
    ran = cli("survey", example, source, "-o", tmp_path / "out.csv")
    assert "'ref_declination_deg': is blank" in refused(ran, 2)
    columns, _ = surveyed_file(
        example, tmp_path, {"ref_declination_deg": cells}, metadata=["declination_deg = 9"]
    )
    turned = floats(columns["azimuth_true_deg"]) - floats(columns["azimuth_magnetic_deg"])
    np.testing.assert_allclose(turned[[0, -1]] % 360, [2.4, 9.0], atol=1e-9)
    wrong = {"ref_declination_deg": ["200"] * 36}
    source = write_csv(tmp_path / "in.csv", {**given, **wrong}, "simulated = true")
    assert "between -180 and 180" in refused(
        cli("survey", example, source, "-o", tmp_path / "out.csv"), 2
    )


def test_random_uncertainty_of_a_reference_widens_the_limits_of_its_row(example, tmp_path):
    """Expected: a field 500 nT off passes where its reference is uncertain by 1000 nT, and nowhere else."""
    off = ["48600"] * 36
    sd = ["1000"] * 18 + ["10"] * 18
    columns, _ = surveyed_file(
        example, tmp_path, {"ref_field_nt": off, "sd_ref_field_nt": ["10"] * 36, "sd_random_ref_field_nt": sd},
        "--limits", "owsg-mwd",
    )  # fmt: skip
    assert set(columns["accepted"][:18]) == {"true"}
    assert "false" in columns["accepted"][18:]


def test_a_survey_beyond_one_limit_that_all_three_together_accept_says_so(example, tmp_path):
    field = np.full(36, 47_060.0)
    columns, _ = surveyed_file(example, tmp_path, {"ref_field_nt": field})
    rows = zip(columns["accepted"], columns["finding"], strict=True)
    together = [text for accepted, text in rows if accepted == "true" and text]
    assert any(
        re.fullmatch(r"field \+\d+ nT \(at most \d+\); accepted by all three together", text)
        for text in together
    )
    page = tmp_path / "well.html"
    ran = cli("survey", example, tmp_path / "in.csv", "-o", tmp_path / "n.csv", "--report", page)
    for shown in (ran.out, page.read_text("utf-8")):
        assert "accepted together" in shown
        assert "ccepted together: one of |g|, |b| and dip" in shown


def test_the_page_lists_positions_before_the_contributions(example, tmp_path):
    page = tmp_path / "well.html"
    ran = cli("survey", example, EXAMPLE / "well.csv", "-o", tmp_path / "n.csv", "--report", page)
    assert ran.code == 0
    text = page.read_text("utf-8")
    assert text.index('id="path"') < text.index('id="surveys"') < text.index('id="contributions"')
    table = text[text.index('id="surveys"') : text.index('id="contributions"')]
    assert "<th>md m</th><th>north m</th><th>east m</th><th>tvd m</th>" in table
    last = read_csv(tmp_path / "n.csv")
    for name in ("north_m", "east_m", "tvd_m"):
        assert f"<td>{float(last[name][-1]):.2f}</td>" in table


@pytest.mark.parametrize(
    ("off", "spread", "shown"),
    [({"field": 900.0}, 50.0, "alike: field by +900 nT (median)"), ({"field": 900.0}, 900.0, ""),
     ({"dip": np.radians(-2.0)}, 50.0, "alike: dip by -2.00 ° (median)"), ({}, 50.0, "")],
)  # fmt: skip
def test_surveys_that_depart_alike_name_the_references(off, spread, shown):
    """A strength that departs by one amount everywhere; one that scatters as much is no reference."""
    rng, count, bound = np.random.default_rng(4), 41, np.array([2e-3, 500.0, np.radians(1.0)])
    departure = np.zeros((count, 3))
    for name, size in off.items():
        departure[:, STRENGTH_NAMES.index(name)] += size
    around = rng.permutation(np.linspace(-1, 1, count))  # the median departure is exact
    departure[:, STRENGTH_NAMES.index("field")] += spread * around
    judgement = Judgement(
        departure, np.tile(bound, (count, 1)), np.zeros(count), np.full(count, np.inf),
        (np.abs(departure) <= bound).all(-1),
    )  # fmt: skip
    assert [f"alike: {each} (median)" for each in judgement.alike()] == [shown] * bool(shown)


def test_a_wrong_field_reference_is_named(tmp_path):
    """The bundled well with a field reference 1500 nT too small."""
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert cli(*fit, "-o", tmp_path / "tool.json").code == 0
    text = (EXAMPLE / "well.csv").read_text("utf-8")
    wrong = text.replace(",48000.0,", ",46500.0,")
    assert wrong != text
    for words, table in ((True, wrong), (False, text)):
        (tmp_path / "well.csv").write_text(table, "utf-8")
        done = cli(
            "survey", tmp_path / "tool.json", tmp_path / "well.csv", "-o", tmp_path / "o.csv"
        )
        assert ("most surveys depart alike: field by +" in done.err) == words
