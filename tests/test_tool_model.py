"""Sensor terms of error models: published weights and covariance, another program, the calibration's own errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.errors import FitError
from mwdcal.survey.error_model import load_error_model
from mwdcal.survey.path import position_covariance
from mwdcal.survey.tool_model import (
    FORMULAS,
    SENSOR_KINDS,
    formulas_at,
    sensor_terms,
    term_shifts,
    tool_model_text,
    write_tool_model,
)
from simulation import Tool, attitude
from test_calibrate import PROFILE, make, many_runs
from test_well_path import SURVEYS, needs_published_wells


def read_example():
    """Depths, inclination and true azimuth, header and published covariance of ISCWSA's example well 1."""
    example = json.loads((SURVEYS / "iscwsa_1_rev5_1.json").read_text())
    survey, published = example["survey"], example["vd"]
    rows = zip(
        *(published[k] for k in ("md", "source", "nn", "ee", "vv", "ne", "nv", "ev")), strict=True
    )
    covariance = {(md, source): np.array(six) for md, source, *six in rows}
    angles = np.radians(survey["inc"]), np.radians(survey["azi"])
    return np.array(survey["md"], float), *angles, example["header"], covariance


def six(covariance):
    """NN, EE, VV, NE, NV, EV of matrices."""
    return covariance[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def example_covariance(values, balanced):
    """Covariance (n, 6) by term of the example well, the slot's direction measured as well as the first station's."""
    md, inclination, azimuth, header, _ = read_example()
    magnetic = azimuth - header["declination"]
    shifts = term_shifts(inclination, magnetic, header["b_total"], header["dip"], header["G"])
    for name, shift in shifts.items():
        shift *= values[name]
        shift[0] = shift[1]
    covariances = {
        name: six(position_covariance(md, inclination, azimuth, shift[:, None], balanced=balanced))
        for name, shift in shifts.items()
    }
    return md, covariances


GENERIC = {
    name: {"AB": 0.004, "AS": 0.0005, "MB": 70.0, "MS": 0.0016}[name[:2]] for name in FORMULAS
}
"""Of OWSG set A, Rev 5.1, MWD."""


@needs_published_wells
@pytest.mark.parametrize("depth", [1200, 2100, 5100, 8000])
def test_published_covariance_of_every_sensor_term(depth):
    *_, published = read_example()
    md, ours = example_covariance(GENERIC, balanced=True)
    assert sum(source in GENERIC for at, source in published if at == depth) == len(ours) == 14
    for name, covariance in ours.items():
        expected = published[depth, name]
        np.testing.assert_allclose(covariance[md == depth][0], expected, rtol=1e-6, atol=1e-12)


@needs_published_wells
def test_minimum_curvature_gives_the_published_uncertainty_within_one_percent():
    """And within a square centimetre, where the published covariance cancels or is zero."""
    *_, published = read_example()
    md, ours = example_covariance(GENERIC, balanced=False)
    for name, covariance in ours.items():
        expected = published[8000, name]
        np.testing.assert_allclose(covariance[md == 8000][0], expected, rtol=0.01, atol=1e-4)


def turned_by(name, inclination, azimuth, toolface, dip):
    """Errors (2,) of inclination and azimuth by one unit of a term: central differences of a second forward model."""
    triad, axis = "AM".index(name[0]), "XYZ".index(name[2])
    fields = attitude(inclination, azimuth, toolface)(9.80665, 50_000.0, dip)
    step = 1e-5 * (np.linalg.norm(fields[triad]) if name[1] == "B" else 1.0)
    angles = []
    for sign in (1, -1):
        moved = [np.array(v, float).ravel() for v in fields]
        v = moved[triad]
        v[axis] += sign * step * (1.0 if name[1] == "B" else v[axis])
        g, b = moved
        down = g / np.linalg.norm(g)
        east = np.cross(down, b)
        north = np.cross(east, down)
        ratio = np.linalg.norm(north) / np.linalg.norm(east)
        angles.append((np.arccos(down[2]), np.arctan2(east[2] * ratio, north[2])))
    change = np.subtract(*angles)
    change[1] = (change[1] + np.pi) % (2 * np.pi) - np.pi
    return change / (2 * step)


@pytest.mark.parametrize("seed", range(20))
def test_terms_at_one_toolface_are_the_derivatives_of_the_angles(seed):
    rng = np.random.default_rng(seed)
    inclination, azimuth, face = rng.uniform(0.2, 2.0), *rng.uniform(0, 2 * np.pi, 2)
    dip = rng.uniform(-1.3, 1.3)
    names = {
        "Inc": inclination, "AzM": azimuth, "AzT": azimuth, "Dip": dip, "BField": 50_000.0, "Gfield": 9.80665,
        "Sin": np.sin, "Cos": np.cos, "Tan": np.tan, "Sqr": np.sqrt, "pi": np.pi,
    }  # fmt: skip
    formulas = formulas_at(face)
    assert {*formulas} == {kind + axis for kind in SENSOR_KINDS for axis in "XYZ"}
    for name, (upward, sideways, *_) in formulas.items():
        found = [eval(text, {"__builtins__": {}}, names) for text in (upward, sideways)]
        expected = turned_by(name, inclination, azimuth, face, dip)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * scale)


@pytest.mark.parametrize("face", [0.0, 1.1, np.pi])
def test_terms_at_one_toolface_near_vertical_are_those_at_vertical(face):
    """North and east shifts of the hole's direction, an arc second from vertical, by inclination and azimuth."""
    inclination, azimuth = 5e-6, 0.8
    names = {
        "Inc": inclination, "AzM": azimuth, "AzT": azimuth, "Dip": 0.0, "BField": 50_000.0, "Gfield": 9.80665,
        "Sin": np.sin, "Cos": np.cos, "Tan": np.tan, "pi": np.pi,
    }  # fmt: skip
    for name in ("ABX", "ABY"):
        upward, sideways, north, east = (
            eval(text, {"__builtins__": {}}, names) for text in formulas_at(face)[name]
        )
        side = sideways * np.sin(inclination)
        expected = (
            upward * np.cos(azimuth) - side * np.sin(azimuth),
            upward * np.sin(azimuth) + side * np.cos(azimuth),
        )
        np.testing.assert_allclose((north, east), expected, rtol=0, atol=1e-6)


def test_the_tool_model_of_a_tool_that_does_not_turn_is_read_back(tmp_path):
    record, path = calibrate(make(), PROFILE), tmp_path / "model.json"
    path.write_text(tool_model_text(record, toolface=np.radians(30.0)), "utf-8")
    model = load_error_model(path)
    values = {term.name: term.value for term in sensor_terms(record)}
    assert {term.name: term.size for term in model.terms} == {
        n: values[n] for n in formulas_at(0.5)
    }
    assert "toolface 30°" in json.loads(path.read_text("utf-8"))["metadata"]["application"]


# ── Of a calibrated tool ─────────────────────────────────────────────────────────────────────

RUNS = 4000


def estimated_errors():
    """Biases (RUNS, 2, 3) and matrices (RUNS, 2, 3, 3) by which calibrated tools err, in units of the field."""
    tool, result = Tool.random(7), fit(many_runs(RUNS, 5, (5, 45, 90, 135), 12), Options())
    biases, matrices = [], []
    for t, (triad, where) in enumerate(
        zip(result.problem.triads, result.problem.slices(), strict=True)
    ):
        raw = np.stack([tool.offset[t], *(tool.offset[t] + tool.matrix[t].T)])
        params, warmth = result.state.params[:, where], np.zeros((1, 4))
        fields = triad.model.fields(params, np.broadcast_to(raw, (RUNS, 4, 3)), warmth)
        biases.append(fields[:, 0])
        matrices.append((fields[:, 1:] - fields[:, :1]).swapaxes(-1, -2) - np.eye(3))
    matrices = np.stack(matrices, 1)
    turn = (matrices[:, 0, 1, 0] - matrices[:, 0, 0, 1]) / 2
    matrices[:, :, 1, 0] -= turn[:, None]
    matrices[:, :, 0, 1] += turn[:, None]
    return np.stack(biases, 1), matrices


@pytest.mark.slow
def test_sensor_terms_are_the_errors_of_many_calibrations():
    """Root mean squares over 4,000 calibrations of the same tool, from readings of unit fields.

    A record's covariance has the factor s² of its residuals, but no less than one: declared noise never shrinks.
    """
    biases, matrices = estimated_errors()
    scales = np.sqrt(np.mean(np.sum(matrices**2, -1), 0))
    biases = np.sqrt(np.mean(biases**2, 0)) * [[9.80665], [1.0]]
    expected = dict(zip(SENSOR_KINDS, [biases[0], scales[0], biases[1], scales[1]], strict=True))
    record = calibrate(make(), PROFILE)
    factors = {"A": record.accelerometer.variance_factor, "M": record.magnetometer.variance_factor}
    terms = {term.name: term for term in sensor_terms(record)}
    assert len(terms) == 16
    for kind, (x, y, z) in expected.items():
        both = np.sqrt((x**2 + y**2) / 2)
        for axes, value in {"X": x, "Y": y, "Z": z, "XY": both}.items():
            term = terms[kind + axes]
            factor = np.sqrt(max(factors[kind[0]], 1.0))
            assert term.value == pytest.approx(factor * value, rel=0.03), term.name
            assert term.ratio == pytest.approx(term.value / GENERIC[kind + "Z"])


def test_a_turn_about_the_tool_axis_is_no_error_of_the_hole():
    terms = sensor_terms(calibrate(make(unknown=("toolface",)), PROFILE))
    assert all(term.value is not None for term in terms)


def test_what_is_undetermined_has_no_term(tmp_path):
    """Without known directions scale errors are not told from turns; biases are."""
    record = calibrate(make(unknown=("toolface", "azimuth", "inclination")), PROFILE)
    terms = {term.name: term for term in sensor_terms(record)}
    assert {name for name, term in terms.items() if term.value is None} == {
        name for name in terms if "S" in name
    }
    assert terms["ASX"].ratio is None
    with pytest.raises(FitError, match="ASXY, ASZ, MSXY, MSZ undetermined"):
        write_tool_model(tmp_path / "model.json", record)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("field", [None, 1.0], ids=["no magnetometer", "relative field"])
def test_bias_in_nanotesla_needs_a_field_in_nanotesla(field):
    readings = make(unknown=("field",))
    record = calibrate(readings if field else replace(readings, magnetometer=None), PROFILE)
    terms = {term.name: term.value for term in sensor_terms(record)}
    assert terms["MBX"] is None
    assert (terms["MSX"] is not None) == bool(field)
    assert terms["ABX"] is not None


def hostile_well():
    """Vertical, past north, past horizontal and up again; in degrees."""
    md = np.arange(0.0, 3000.0, 30.0)
    inclination = np.interp(md, [0, 300, 1500, 2400, 3000], [0, 0, 90, 120, 70])
    azimuth = np.interp(md, [0, 600, 3000], [300.0, 300.0, 480.0]) % 360
    return md, inclination, azimuth


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_welleng_takes_the_tool_model_and_has_our_covariance(tmp_path):
    welleng = pytest.importorskip("welleng.survey")
    record = calibrate(make(), PROFILE)
    path = tmp_path / "model.json"
    write_tool_model(path, record, "tool 7")
    model = json.loads(path.read_text())
    md, inclination, azimuth = hostile_well()
    header = welleng.SurveyHeader(
        latitude=60.0, longitude=5.0, b_total=50_000.0, dip=65.0, declination=-3.0, convergence=0.0,
        azi_reference="true", vertical_inc_limit=1e-6,
    )  # fmt: skip
    survey = welleng.Survey(md, inclination, azimuth, header=header, error_model=model)
    errors = survey.err.errors
    assert not errors.dropped_terms
    inclination, azimuth = np.radians(inclination), np.radians(azimuth)
    magnetic = azimuth - np.radians(-3.0)
    shifts = term_shifts(inclination, magnetic, 50_000.0, np.radians(65.0))
    values = {term.name: term.value for term in sensor_terms(record)}
    causes = []
    for name, shift in shifts.items():
        shift[0] = shift[1]
        causes.append(shift * values[name.partition("-")[0]])
        ours = position_covariance(md, inclination, azimuth, causes[-1][:, None], balanced=True)
        np.testing.assert_allclose(ours, errors.errors[name].cov_NEV, rtol=1e-6, atol=1e-9)
    together = position_covariance(md, inclination, azimuth, np.stack(causes, -2), balanced=True)
    np.testing.assert_allclose(together, survey.cov_nev, rtol=1e-6, atol=1e-9)


def test_the_tool_model_has_the_fields_of_iscwsa_and_says_what_is_simulated(tmp_path):
    """As the published schema, which welleng carries, requires; and nothing else."""
    errors = pytest.importorskip("welleng.errors")
    schemas = Path(errors.__file__).with_name("iscwsa_schema")
    path = tmp_path / "model.json"
    record = msgspec.structs.replace(calibrate(make(), PROFILE), simulated=True)
    write_tool_model(path, record)
    model = json.loads(path.read_text())
    required = {
        name: set(json.loads((schemas / f"{name}.json").read_text())["required"])
        for name in ("draft", "metadata", "error_term")
    }
    assert set(model) == required["draft"]
    assert set(model["metadata"]) == required["metadata"]
    assert {frozenset(term) for term in model["terms"]} == {frozenset(required["error_term"])}
    assert "simulated" in model["metadata"]["tags"]
    write_tool_model(tmp_path / "again.json", record)
    assert path.read_bytes() == (tmp_path / "again.json").read_bytes()
