"""A raw sample by the nominal scales of the tool: vectors, angles, and whether it is near an ordered position."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import starmap

import numpy as np

from mwdcal.files.contract import CHANNELS
from mwdcal.files.runs import to_nominal
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.sensor.profile import Profile

Attitude = tuple[float, float, float]
"""Inclination, azimuth and toolface, degrees."""
LEAST_TURN_DEG = 2.0
"""A smaller turn of gravity or field cannot be told from a knock."""
FAR_DEG, FAR_FIELD_DEG = 10.0, 30.0
"""Nominal gravity, and nominal field, farther from those of the order: the tool is not there."""
STEEP_DEG = 1.0
"""Inclinations nearer to 0° or 180° have neither azimuth nor toolface that could be shown."""


def nominal_vectors(raw: Mapping[str, float], profile: Profile) -> tuple[Array, Array | None]:
    """Gravity in g and field in nT along the tool axes; in raw units where the profile states no scale."""
    vectors = [
        to_nominal(np.array([raw[name] for name in CHANNELS[triad]]), getattr(profile, triad))
        for triad in CHANNELS
        if CHANNELS[triad][0] in raw
    ]
    return vectors[0], vectors[1] if len(vectors) > 1 else None


def live_values(raw: Mapping[str, float], profile: Profile) -> dict[str, float]:
    """Angles in degrees, |g| in g and |b| in nT of a sample; only what the sample and the profile tell."""
    g, b = nominal_vectors(raw, profile)
    names = ["inclination", "toolface"] + ["azimuth", "dip"] * (b is not None)
    names += ["gravity"] * bool(profile.accelerometer.scale)
    names += ["field"] * bool(b is not None and profile.magnetometer.scale)
    with np.errstate(all="ignore"):
        values = {n: float(OBSERVABLES[n].value(g, g if b is None else b)) for n in names}
    for name in {*names} - {"gravity", "field"}:
        values[name] = float(np.degrees(values[name]))
    if not STEEP_DEG < values["inclination"] < 180 - STEEP_DEG:
        values = {name: v for name, v in values.items() if name not in ("azimuth", "toolface")}
    return values


def is_near(
    raw: Mapping[str, float], profile: Profile, attitude_deg: Attitude, dip_deg: float | None
) -> bool:  # fmt: skip
    """Whether a sample is about one of an attitude. Without the stand's dip only gravity is compared."""
    vectors, wanted = nominal_vectors(raw, profile), _wanted(attitude_deg, dip_deg or 0.0)
    limits = (FAR_DEG, FAR_FIELD_DEG if dip_deg is not None else 181.0)
    pairs = [(v, w) for v, w in zip(vectors, wanted, strict=True) if v is not None]
    return all(a < limit for a, limit in zip(starmap(_angle_deg, pairs), limits, strict=False))


def has_turned(
    raw: Mapping[str, float], before: Mapping[str, float], profile: Profile,
    attitudes_deg: tuple[Attitude, Attitude], dip_deg: float | None,
) -> bool:  # fmt: skip
    """Whether a tool has left the sample `before` for another attitude; True too where the two cannot tell.

    Gravity and field together have to have moved by half of what lies between the attitudes, now and before. A
    difference of readings holds neither biases nor the signs of the axes.
    """
    now, then = nominal_vectors(raw, profile), nominal_vectors(before, profile)
    if dip_deg is None:
        dip_deg = live_values(raw, profile).get("dip", 0.0)
    ends = [_wanted(attitude, dip_deg) for attitude in attitudes_deg]
    moved = ordered = 0.0
    for a, b, one, other in zip(now, then, *ends, strict=True):
        if a is not None and b is not None:
            strength = (np.linalg.norm(a) + np.linalg.norm(b)) / 2
            moved += float(np.sum((a - b) ** 2) / (strength or 1.0) ** 2)
            ordered += float(np.sum((one - other) ** 2))
    return ordered < np.radians(LEAST_TURN_DEG) ** 2 or moved > ordered / 4


def _wanted(attitude_deg: Attitude, dip_deg: float) -> tuple[Array, Array]:
    """Directions of gravity and field along the tool axes at an attitude."""
    inclination, azimuth, toolface = np.radians(attitude_deg)
    return reference_vectors(inclination, azimuth, toolface, 1.0, 1.0, np.radians(dip_deg))


def _angle_deg(one: Array, other: Array) -> float:
    """The angle between two vectors; 180 where one of them is zero."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / size, -1, 1)))) if size else 180.0
