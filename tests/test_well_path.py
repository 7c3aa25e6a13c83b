"""Minimum curvature and position covariance: published wells, another program, derivatives, Monte Carlo."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import readings_at
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import reference_vectors, rotation
from mwdcal.survey import path
from mwdcal.survey.path import (
    arcs,
    calibrated_path,
    direction_errors,
    direction_gradient,
    hole_direction,
    position_covariance,
    well_path,
)
from simulation import Tool
from test_calibrate import PROFILE, make, many_runs

SURVEYS = Path(os.environ.get("MWDCAL_DATA", "")) / "survey"
needs_published_wells = pytest.mark.skipif(
    "MWDCAL_DATA" not in os.environ, reason="published wells: set MWDCAL_DATA"
)
STATIONS = 12


def random_wells(seed, wells=5, count=STATIONS):
    """Depths, inclinations and azimuths (wells, count): every well begins with a vertical and a straight leg."""
    rng = np.random.default_rng(seed)
    md = np.cumsum(rng.uniform(5.0, 60.0, (wells, count)), -1)
    inclination = np.cumsum(rng.uniform(-0.05, 0.3, (wells, count)), -1) % 3.0
    azimuth = np.cumsum(rng.uniform(-0.5, 0.6, (wells, count)), -1) % (2 * np.pi)
    inclination[:, :2] = 0.0
    inclination[:, 5], azimuth[:, 5] = inclination[:, 4], azimuth[:, 4]
    return md, inclination, azimuth


@needs_published_wells
def test_the_iscwsa_clearance_wells_within_their_rounding():
    wells = json.loads((SURVEYS / "iscwsa_clearance_wells.json").read_text())["wells"]
    assert len(wells) == 12
    for well in wells.values():
        published = np.stack([well[name] for name in ("N", "E", "TVD")], -1)
        angles = np.radians(well["IncDeg"]), np.radians(well["AziDeg"])
        ours = well_path(well["MD"], *angles, start=published[0])
        assert np.abs(ours - published).max() <= 0.005


def test_wellpathpy_has_the_same_positions():
    wellpathpy = pytest.importorskip("wellpathpy")
    wells = random_wells(0)
    ours = well_path(*wells)
    for index, (md, inclination, azimuth) in enumerate(zip(*wells, strict=True)):
        theirs = wellpathpy.deviation(md, np.degrees(inclination), np.degrees(azimuth))
        theirs = theirs.minimum_curvature()
        expected = np.stack([theirs.northing, theirs.easting, theirs.depth - theirs.depth[0]], -1)
        np.testing.assert_allclose(ours[index], expected, atol=1e-6)


def test_a_quarter_of_a_circle():
    """From down to east: radius 2 L / π both ways, whatever the number of stations on the arc."""
    for count in (2, 3, 400):
        angle = np.linspace(0, np.pi / 2, count)
        end = well_path(angle * 200.0, angle, np.pi / 2)[-1]
        np.testing.assert_allclose(end, [0, 200, 200], atol=1e-10)


def test_nearly_straight_and_nearly_reversed_arcs():
    """A chord of a circle: L sin(β/2) / (β/2), to all digits at any dogleg below 180°."""
    dogleg = np.array([0.0, 1e-9, 1e-4, 0.0299, 0.0301, 1.0, 3.0, np.pi - 1e-6])
    direction = hole_direction(np.stack([0 * dogleg, dogleg], -1), 0.3)
    arc = arcs(np.array([0.0, 100.0]), direction)
    chord = np.linalg.norm(arc.displacement[:, 0], axis=-1)
    np.testing.assert_allclose(chord, 100 * np.sinc(dogleg / 2 / np.pi), rtol=1e-9)
    np.testing.assert_allclose(arc.dogleg[:, 0], dogleg, rtol=1e-9)
    reversed_hole = well_path([0.0, 30.0, 60.0], [0.0, 0.0, np.pi], [np.nan, np.nan, np.nan])
    assert np.isnan(reversed_hole[2]).all()
    assert np.isfinite(reversed_hole[:2]).all()


def changes(md, inclination, azimuth, column, size, place):
    """The hole's path by central differences of one angle or depth of one station."""

    def shifted(step):
        moved = [inclination.copy(), azimuth.copy(), md.copy()]
        moved[column][..., place] += step
        return well_path(moved[2], moved[0], moved[1])

    return (shifted(size) - shifted(-size)) / (2 * size)


def test_covariance_is_that_of_the_derivative_of_the_path(monkeypatch):
    """Every angle and depth of every station as a cause of its own, by differences; the same in parts."""
    md, inclination, azimuth = random_wells(1)
    inclination += 0.1  # azimuth has no derivative at vertical
    causes = np.zeros((STATIONS, 3 * STATIONS, 3))
    derivative = np.zeros((*md.shape, 3, 3 * STATIONS))
    for cause in range(3 * STATIONS):
        place, column = divmod(cause, 3)
        causes[place, cause, column] = 1.0
        derivative[..., cause] = changes(md, inclination, azimuth, column, 1e-5, place)
        if column == 1:
            derivative[..., cause] /= np.sin(inclination[:, place])[:, None, None]
    expected = derivative @ derivative.swapaxes(-1, -2)
    causes = np.broadcast_to(causes, (len(md), *causes.shape))
    new = np.broadcast_to(np.eye(3), (*md.shape, 3, 3))
    for at_once in (4096, 5, 1):
        monkeypatch.setattr(path, "STATIONS_AT_ONCE", at_once)
        lasting = position_covariance(md, inclination, azimuth, causes)
        np.testing.assert_allclose(lasting, expected, rtol=1e-6, atol=1e-6)
        both = position_covariance(md, inclination, azimuth, causes, new)
        np.testing.assert_allclose(both, 2 * expected, rtol=1e-6, atol=1e-6)


def test_straight_vertical_hole():
    """A tilt ε that lasts moves the end by ε md; new ones by half the legs at each station."""
    md = np.array([0.0, 10.0, 40.0, 50.0])
    lasting = np.broadcast_to([[1e-3, 0.0], [0.0, 2e-3]], (4, 2, 2))
    ours = position_covariance(md, 0.0, 0.7, lasting)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    plane = turn @ np.diag([1e-6, 4e-6]) @ turn.T
    np.testing.assert_allclose(ours[:, :2, :2], md[:, None, None] ** 2 * plane, atol=1e-15)
    assert not ours[:, 2].any()
    assert not ours[..., 2].any()
    new = position_covariance(md, 0.0, 0.7, random=np.broadcast_to(np.eye(2) * 1e-6, (4, 2, 2)))
    halves = [0.0, 5**2 + 5**2, 5**2 + 20**2 + 15**2, 5**2 + 20**2 + 20**2 + 5**2]
    np.testing.assert_allclose(new[:, 0, 0], 1e-6 * np.array(halves), rtol=1e-12)
    np.testing.assert_allclose(new[:, 1, 1], 1e-6 * np.array(halves), rtol=1e-12)


def test_direction_gradient_is_that_of_inclination_and_azimuth():
    rng = np.random.default_rng(4)
    inclination, azimuth, toolface = rng.uniform(0.01, [[3.1], [6.2], [6.2]], (3, 100))
    g, b = reference_vectors(inclination, azimuth, toolface, 0.998, 48_000.0, 1.2)
    angle, gradient = direction_gradient(g, b)
    np.testing.assert_allclose(angle, azimuth, rtol=1e-12)
    upward = OBSERVABLES["inclination"].gradient(g, b)
    sideways = OBSERVABLES["azimuth"].gradient(g, b) * np.sin(inclination)[:, None]
    expected = np.stack([upward, sideways], -2)
    np.testing.assert_allclose(gradient, expected, atol=1e-12)


def test_direction_gradient_at_vertical_is_the_limit():
    """From toolface zero, where azimuth becomes the magnetic toolface."""
    near, at = (reference_vectors(tilt, 1.1, 0.0, 1.0, 48_000.0, 1.2) for tilt in (1e-9, 0.0))
    for ours, limit in zip(direction_gradient(*at), direction_gradient(*near), strict=True):
        np.testing.assert_allclose(ours, limit, atol=1e-8)


# ── From a calibration ───────────────────────────────────────────────────────────────────────

WELLS = 10_000


def planned_well():
    """Depths and true angles: vertical, a build, a turn past north, horizontal; toolface as it comes."""
    md = np.arange(0.0, 1860.0, 60.0)
    inclination = np.radians(np.interp(md, [0, 480, 1200, 1800], [0.0, 0.0, 90.0, 92.0]))
    azimuth = np.radians(np.interp(md, [0, 600, 1800], [340.0, 340.0, 395.0])) % (2 * np.pi)
    toolface = np.random.default_rng(8).uniform(0, 2 * np.pi, len(md))
    return md, inclination, azimuth, toolface


@cache
def calibrated_wells(count=WELLS):
    """Paths (count, n, 3) of the planned well by one tool, calibrated anew for each from readings with noise."""
    md, inclination, azimuth, toolface = planned_well()
    tool, rng = Tool.random(7), np.random.default_rng(3)
    result = fit(many_runs(count, 5, (5, 45, 90, 135), 12), Options())
    assert (result.status == 0).all()
    vectors = []
    for triad, where, raw in zip(
        result.problem.triads, result.problem.slices(),
        tool.readings(rng, count, inclination, azimuth, toolface), strict=True,
    ):  # fmt: skip
        params = result.state.params[:, where]
        vectors.append(triad.model.fields(params, raw, np.zeros(raw.shape[:2])))
    angles = (OBSERVABLES[name].value(*vectors) for name in ("inclination", "azimuth"))
    return well_path(md, *angles)


@pytest.mark.slow
@pytest.mark.parametrize("north_sd", [0.0, 2e-3], ids=["north exact", "north uncertain"])
def test_covariance_of_ten_thousand_calibrated_wells(north_sd):
    """Standard deviations within 3 % along each axis, and in every other direction: correlations too."""
    md, *angles = planned_well()
    turn = rotation(north_sd * np.random.default_rng(1).standard_normal((WELLS, 1)) * [0, 0, 1])
    errors = calibrated_wells() @ turn.mT - well_path(md, *angles[:2])
    drawn = np.einsum("wni,wnj->nij", errors, errors) / WELLS
    record, readings = calibrate(make(), PROFILE), Readings(*Tool.random(7).clean(*angles))
    path, covariance = calibrated_path(record, readings, md, declination_sd=north_sd)
    assert np.abs(path - well_path(md, *angles[:2])).max() < 1.0
    stated, sampled = (np.sqrt(np.diagonal(c, 0, -2, -1)) for c in (covariance, drawn))
    np.testing.assert_allclose(sampled[1:, :2], stated[1:, :2], rtol=0.03)
    deviated = angles[0] > 0  # at vertical the errors of depth are of second order
    np.testing.assert_allclose(sampled[deviated, 2], stated[deviated, 2], rtol=0.03)
    assert sampled[~deviated, 2].max() < 1e-4 * sampled[1:, 0].max()
    factor = np.linalg.inv(np.linalg.cholesky(covariance[deviated]))
    whole = np.linalg.eigvalsh(factor @ drawn[deviated] @ factor.mT)
    np.testing.assert_allclose(np.sqrt(whole), 1.0, atol=0.03)


def test_directions_at_exactly_vertical_stations_and_past_them():
    """A well that drops back to vertical keeps its covariance; the azimuths there are those of the shifts."""
    record, (md, *angles) = calibrate(make(), PROFILE), planned_well()
    angles[0][-4:] = 0.0
    readings = readings_at(record, *angles)
    errors = direction_errors(record, readings, north=0.3)
    azimuth = np.where(
        angles[0] > 0, angles[1], angles[1] + angles[2]
    )  # magnetic toolface at vertical
    np.testing.assert_allclose(np.cos(errors.azimuth), np.cos(azimuth + 0.3), atol=1e-9)
    _, covariance = calibrated_path(record, readings, md, north=0.3)
    assert np.isfinite(covariance).all()
    near = readings_at(record, np.maximum(angles[0], 1e-7), *angles[1:])
    _, nearly = calibrated_path(record, near, md, north=0.3)
    np.testing.assert_allclose(covariance, nearly, rtol=1e-5, atol=1e-10)


def test_the_path_turns_with_north():
    record, (md, *angles) = calibrate(make(), PROFILE), planned_well()
    readings, turn = readings_at(record, *angles), rotation(np.array([0.0, 0.0, 0.4]))
    path, covariance = calibrated_path(record, readings, md, start=(3.0, -5.0, 7.0))
    other, turned = calibrated_path(record, readings, md, 0.4, start=turn @ (3.0, -5.0, 7.0))
    np.testing.assert_allclose(other, path @ turn.T, atol=1e-8)
    np.testing.assert_allclose(turned, turn @ covariance @ turn.T, atol=1e-12)


def test_north_that_changes_from_station_to_station():
    """A turn of each direction about the vertical: half the legs around a station, times its sine of inclination."""
    record, (md, *angles) = calibrate(make(), PROFILE), planned_well()
    readings = readings_at(record, *angles)
    errors = [direction_errors(record, readings, declination_noise=noise) for noise in (0.0, 0.01)]
    added = position_covariance(md, *angles[:2], random=errors[1].random - errors[0].random)
    level = angles[0] > np.radians(89)
    arm = 60.0 * np.sin(angles[0])
    arm[0] /= 2
    most = 0.01**2 * (np.cumsum(arm**2) - arm**2 + (arm / 2) ** 2)
    across = added[:, 0, 0] + added[:, 1, 1]
    np.testing.assert_allclose(across[level], most[level], rtol=0.01)
    assert not added[:, 2, 2].max() > 1e-3 * across.max()


def test_what_no_evidence_determines_leaves_no_covariance():
    """Toolface zero moves no hole; the direction of the field in the tool does."""
    md, *angles = planned_well()
    cases = ((), True), (("toolface",), True), (("toolface", "azimuth", "inclination"), False)
    for missing, known in cases:
        record = calibrate(make(unknown=missing), PROFILE)
        assert bool(record.free) == bool(missing)
        readings = readings_at(record, *angles)
        _, covariance = calibrated_path(record, readings, md)
        assert (np.isfinite(covariance[1:]) == known).all()
        azimuth = record.uncertainty("azimuth", readings)[angles[0] > 0]
        assert (np.isfinite(azimuth) == known).all()


def test_without_a_magnetometer_there_is_no_covariance():
    md, *angles = planned_well()
    record = calibrate(replace(make(), magnetometer=None), PROFILE)
    path, covariance = calibrated_path(record, readings_at(record, *angles), md)
    assert np.isnan(path[angles[0] > 0]).all()  # nothing turns at vertical
    assert np.isnan(covariance[1:]).all()


def test_depths_must_increase():
    md, *angles = planned_well()
    record = calibrate(make(), PROFILE)
    with pytest.raises(InputError, match="`md` must increase"):
        calibrated_path(record, readings_at(record, *angles), md[::-1])
