"""Azimuth from gravity between two packages, against arcs built from rotations."""

from __future__ import annotations

import numpy as np
import pytest

from mwdcal.survey.gravity_azimuth import gravity_azimuth


def frame(inclination: np.ndarray, azimuth: np.ndarray, toolface: np.ndarray) -> np.ndarray:
    """Rows: scribe and axis of a tool in the earth (north, east, down); from the high side, turned clockwise."""
    i, a, t = inclination, azimuth, toolface
    high = np.stack([np.cos(i) * np.cos(a), np.cos(i) * np.sin(a), -np.sin(i)], -1)
    right = np.stack([-np.sin(a), np.cos(a), 0 * a], -1)
    along = np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)
    scribe = np.cos(t)[:, None] * high + np.sin(t)[:, None] * right
    return np.stack([scribe, along], 1)


def angles(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inclination, azimuth and toolface of such a frame, by projections."""
    scribe, along = rows[:, 0], rows[:, 1]
    inclination = np.arctan2(np.hypot(along[:, 0], along[:, 1]), along[:, 2])
    azimuth = np.arctan2(along[:, 1], along[:, 0])
    flat = frame(inclination, azimuth, np.zeros(len(azimuth)))[:, 0]
    right = np.cross(along, flat)
    return inclination, azimuth, np.arctan2((scribe * right).sum(-1), (scribe * flat).sum(-1))


def arcs(count: int, seed: int) -> tuple[np.ndarray, ...]:
    """Pairs at the ends of circular arcs: the second frame is the first turned about an axis across it."""
    rng = np.random.default_rng(seed)
    first = frame(
        np.arccos(rng.uniform(-0.98, 0.98, count)), *rng.uniform(0, 2 * np.pi, (2, count))
    )
    way, bend = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, np.radians(60), count)
    side = np.cross(first[:, 1], first[:, 0])
    axis = np.cos(way)[:, None] * first[:, 0] + np.sin(way)[:, None] * side

    def turned(v: np.ndarray) -> np.ndarray:
        c, s = np.cos(bend)[:, None], np.sin(bend)[:, None]
        return c * v + s * np.cross(axis, v) + (1 - c) * (axis * v).sum(-1, keepdims=True) * axis

    return *angles(first), *angles(np.stack([turned(first[:, 0]), turned(first[:, 1])], 1))


def test_closed_form_is_exact_for_2000_circular_arcs() -> None:
    inc1, azi1, face1, inc2, azi2, face2 = arcs(2000, 1)
    change = gravity_azimuth(inc1, inc2, face2 - face1).change
    error = np.angle(np.exp(1j * (change - (azi2 - azi1))))
    near = np.minimum(np.sin(inc1), np.sin(inc2)) < 0.05  # azimuth itself is ill conditioned there
    assert near.sum() < 40
    assert np.abs(error[~near]).max() < 1e-12


def test_gradient_is_the_derivative() -> None:
    inc1, _, face1, inc2, _, face2 = arcs(300, 2)
    at = np.stack([inc1, inc2, face2 - face1])
    result, step = gravity_azimuth(*at), 1e-6
    for place in range(3):
        shift = step * np.eye(3)[place][:, None]
        both = [gravity_azimuth(*(at + sign * shift)).change for sign in (1, -1)]
        slope = np.angle(np.exp(1j * (both[0] - both[1]))) / (2 * step)
        expected = result.gradient[:, place]
        assert np.abs(slope - expected).max() < 1e-6 * np.abs(result.gradient).max() + 1e-8


@pytest.mark.parametrize(("inclination", "expected"), [(45, 0.1414), (85, 1.147)])
def test_a_tenth_of_a_degree_of_toolface(inclination: float, expected: float) -> None:
    """Straight hole: 0.1° of toolface is 0.1° / cos I of azimuth."""
    result = gravity_azimuth(*np.radians([inclination, inclination]), 0.0)
    assert np.degrees(result.uncertainty(0, 0, np.radians(0.1))) == pytest.approx(
        expected, abs=5e-4
    )
    assert bool(result.unreliable) == (inclination == 85)


def test_uncertainty_is_that_of_many_readings() -> None:
    rng, sd = np.random.default_rng(3), np.radians([0.05, 0.05, 0.2])
    at = np.radians([35.0, 42.0, 8.0])
    drawn = gravity_azimuth(*(at + sd * rng.normal(size=(200_000, 3))).T).change
    stated = gravity_azimuth(*at).uncertainty(*sd)
    assert drawn.std() == pytest.approx(float(stated), rel=0.01)


def test_warns_near_horizontal_only() -> None:
    assert gravity_azimuth(*np.radians([[30.0, 60.0], [32.0, 61.0]]), 0.01).findings() == []
    [finding] = gravity_azimuth(np.radians([30.0, 89.0]), np.radians([31.0, 90.0]), 0.01).findings()
    assert finding.id == "gravity-azimuth-unreliable"
    assert "1 of 2" in finding.text


def test_between_symmetric_packages_nothing_is_stated() -> None:
    """Both at horizontal without a change of toolface: any azimuth fits."""
    result = gravity_azimuth(np.radians(80.0), np.radians(100.0), 0.0)
    assert bool(result.unreliable)
