"""Axial correction of single surveys: against a forward model, perturbed inputs, and published sectors."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import mwdcal
from cli_support import mwdcal as cli
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import centred
from mwdcal.survey.acceptance import load_survey_limits
from mwdcal.survey.axial import AxialCorrection, axial_correction
from mwdcal.survey.error_model import load_error_model
from mwdcal.survey.stations import North
from mwdcal.survey.well import well
from simulation import DEG
from test_interference import laboratory
from wells import NOISE, SD_DIP, SD_FIELD, Path, one, path, surveyed


def corrected(
    readings: Readings, model: bool = False, calibration: Calibration | None = None
) -> AxialCorrection:
    """One well by the laboratory's calibration, with or without the terms of the error model."""
    limits, _ = load_survey_limits()
    errors = load_error_model() if model else None
    surveys = replace(readings, digest=())
    record = calibration or laboratory()
    return axial_correction(well(record, surveys, limits, North(), model=errors))


def wells(where: Path, drift: float = 0.0, count: int = 150) -> tuple[Readings, np.ndarray]:
    """Surveys of wells with 900 nT along the tool, and the drift of the magnetometer's biases."""
    rng = np.random.default_rng(5)
    sizes = ((70.0, 0.0016), (4.1e-4, 0.0005))
    (bias, scale), (g_bias, g_scale) = (
        drift * rng.normal(size=(2, count, 1, 3)) * np.reshape(each, (2, 1, 1, 1)) for each in sizes
    )
    along = np.array([0.0, 0.0, 900.0]) + bias
    return surveyed(
        laboratory(), where, count, seed=7, iron=along, scale=scale, gravity=(g_scale, g_bias)
    ), bias


TANGENT = path((45, 45), (60, 60), 3)
NORTH = path((90, 90), (8, 8), 3)


@pytest.mark.parametrize("where", [TANGENT, NORTH, path((20, 60), (200, 260), 3)])
def test_azimuth_and_size_are_within_their_uncertainty(where: Path) -> None:
    """150 wells of a tool without drift; 1σ without an error model is then all that there is."""
    readings, _ = wells(where)
    each = [corrected(one(readings, k)) for k in range(150)]
    assert all(some.usable.all() for some in each)
    azimuth = [centred(some.azimuth - where.azimuth) / some.sd_azimuth for some in each]
    size = [(some.size - 900.0) / some.sd_size for some in each]
    for errors in (azimuth, size):
        assert 0.90 < np.mean(np.abs(errors) < 1.96) < 0.99


def test_drift_is_in_the_uncertainty() -> None:
    readings, bias = wells(TANGENT, drift=1.0)
    each = [corrected(one(readings, k), model=True) for k in range(150)]
    inside = [np.abs(centred(e.azimuth - TANGENT.azimuth)) < 1.96 * e.sd_azimuth for e in each]
    assert np.mean(inside) >= 0.93
    size = [
        np.abs(e.size - 900 - b[0, 2]) < 1.96 * e.sd_size for e, b in zip(each, bias, strict=True)
    ]
    assert np.mean(size) >= 0.90


def test_uncertainty_is_that_of_perturbed_inputs() -> None:
    """Second formula: each reading and reference moved by its 1σ, the correction done again, squares added."""
    where = path((40, 60), (30, 70), 5)
    readings = one(surveyed(laboratory(), where, 1, iron=(0, 0, 900.0)))
    record = laboratory()
    exact = msgspec.structs.replace(
        record, covariance_rows=np.zeros_like(record.parameter_covariance).tolist()
    )
    base, square = corrected(readings, calibration=exact), np.zeros(5)
    cases = [
        {"known": {**readings.known, name: readings.known[name] + sd}}
        for name, sd in (("field", SD_FIELD), ("dip", SD_DIP))
    ]
    cases += [
        {name: getattr(readings, name) + sd * np.eye(3)[axis]}
        for name, sd in zip(("accelerometer", "magnetometer"), NOISE, strict=True)
        for axis in range(3)
    ]
    for case in cases:
        other = corrected(replace(readings, **case), calibration=exact)
        square += centred(other.azimuth - base.azimuth) ** 2
    assert base.sd_azimuth == pytest.approx(np.sqrt(square), rel=0.02)


@pytest.mark.parametrize("azimuth", [0, 15, 45, 75, 90, 105, 195, 255, 270, 285, 345])
def test_no_go_zone_holds_the_published_one(azimuth: float) -> None:
    """Horizontal: OWSG's models with axial correction exclude 15° on either side of east and west."""
    readings = surveyed(laboratory(), path((90, 90), (azimuth, azimuth), 5), 1, iron=(0, 0, 300.0))
    result = corrected(one(readings), model=True)
    from_meridian = np.degrees(np.arccos(abs(np.cos(azimuth * DEG))))
    assert (result.no_go == (from_meridian > 74.9)).all()


def test_a_survey_that_the_other_sign_explains_too_is_in_the_zone() -> None:
    """At horizontal |b| and dip are those of both signs of the axial field: the size alone, 3,000 nT, tells."""
    where = path((90, 90), (62, 89), 40)
    readings = surveyed(laboratory(), where, 1, seed=3, iron=np.array([0.0, 0.0, 900.0]))
    found = corrected(one(readings, 0))
    _, b = laboratory().fields(one(readings, 0))
    mirrored = 2 * np.asarray(b)[:, 2] - found.size
    apart = (mirrored**2 - found.size**2) / 3000.0**2
    assert found.usable.any()
    assert not found.usable[apart < 8.5].any()


def test_both_reasons_of_the_zone_are_told_apart() -> None:
    sd, usable = np.array([0.5, 0.6, 2.0]) * DEG, np.array([True, False, False])
    found = AxialCorrection(np.zeros(3), np.ones(3), np.zeros(3), sd, usable)
    text = {f.id: f.text for f in found.findings("abc", "true")}["axial-no-go"]
    assert text.startswith("2 of 3 surveys lie in the no-go zone")
    assert "1 would keep an azimuth uncertain by more than 1° (1σ; 2° at station c)" in text
    assert "1 the other sign of the axial field explains nearly as well" in text


def test_command_and_python_have_the_columns_and_the_zone(tmp_path) -> None:
    """Axial interference east-west: both say so, the path is the same, and both corrections are too many."""
    calibration, run, out = (tmp_path / name for name in ("tool.json", "well.csv", "out.csv"))
    assert cli("example", tmp_path / "demo").code == 0
    tool, lines = (
        tmp_path / "demo" / "tool.toml",
        (tmp_path / "demo" / "well.csv").read_text("utf-8"),
    )
    assert (
        cli("calibrate", tmp_path / "demo" / "run.csv", "--tool", tool, "-o", calibration).code == 0
    )
    said = [line for line in lines.splitlines() if line.startswith("#")]
    head, *rows = [line for line in lines.splitlines() if not line.startswith("#")]
    # references so loose that they tell too little where the hole is steep
    rows = [f"{head},sd_ref_field_nt,sd_ref_dip_deg", *(f"{row},600,1.2" for row in rows)]
    run.write_text("\n".join([*said, *rows]) + "\n", "utf-8")
    ran = cli("survey", calibration, run, "-o", out, "--axial-correction", "--json")
    assert ran.code == 0, ran.err
    ids = {finding["id"] for finding in ran.json["findings"]}
    assert {"axial-correction", "axial-no-go"} <= ids
    well = mwdcal.survey(calibration, run, axial_correction=True)
    zone, azimuth = well.columns["axial_no_go"], well.columns["azimuth_true_axial_deg"]
    assert zone[0] == ""  # vertical: no azimuth
    assert {*zone[10:]} == {"false", "true"}
    assert (np.isnan(azimuth[10:]) == (zone[10:] == "true")).all()
    plain = mwdcal.survey(calibration, run)
    names = ("azimuth_true_deg", "sd_azimuth_true_deg", "north_m", "sd_north_m")
    assert all((plain.columns[n] == well.columns[n])[10:].all() for n in names)
    np.testing.assert_array_equal(plain.path.covariance, well.path.covariance)
    said = "azimuth_true_deg stays definitive, and with it path and covariance"
    assert said in out.read_text("utf-8")
    well.report(tmp_path / "page.html")
    assert said in (tmp_path / "page.html").read_text("utf-8")
    with pytest.raises(InputError, match="Leave one of them out"):
        mwdcal.survey(calibration, run, msa=True, axial_correction=True)
