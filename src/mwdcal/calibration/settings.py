"""Settings of the stand: which stations share one, because the operator set the direction once and rolled the tool.

The stand's error of inclination and azimuth is then common to these stations: it does not average
down over the turn, and small scatter within the set is no evidence that it is small.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.geometry.vectors import Array, Bools, Ints, centred

DIRECTION = ("inclination", "azimuth")
"""The angles that one setting of the stand gives to several stations."""
ASSUMED = (
    "Assumed: direction set once per roll set; state [stand] settings in the profile, as "
    '"per-direction" or "per-station".'
)
"""The assumption where nobody states the practice of the stand…"""
ASSUMED_PRACTICE = "assumed"
"""…and what a calibration says of it."""
EQUAL = 1e-6
"""References closer than this are one setting, radians: they differ by rounding alone."""


def settings_of(readings: Readings) -> Ints:
    """Number (..., n) of the setting of the stand that each station belongs to.

    Definition: stations that follow each other with equal reference inclination and azimuth share a
    setting, unless the profile says that the stand is set at every station; so do stations of a
    group with equal references, wherever they are in the run. Returning to a direction later is a
    new setting. Stations without either angle have a setting of their own.
    """
    group = np.broadcast_to(readings.groups, readings.accelerometer.shape[:-1])
    return numbered(group, [readings.reference(name) for name in DIRECTION], readings.settings)


def numbered(group: Ints, angles: Sequence[Array], practice: str) -> Ints:
    """`settings_of` stations of groups (..., n) and reference inclination and azimuth (..., n), by a practice."""
    pair = slice(1, None), slice(None, -1)
    shared = _equal([group[..., k] for k in pair], [[x[..., k] for k in pair] for x in angles])
    if practice == "per-station":
        shared &= group[..., 1:] >= 0
    first = np.ones((*group.shape[:-1], 1), bool)
    number = np.cumsum(np.concatenate([first, ~shared], -1), -1) - 1
    if (group < 0).all():
        return np.asarray(number)
    side = (..., slice(None), None), (..., None, slice(None))
    equal = _equal([group[k] for k in side], [[x[k] for k in side] for x in angles])
    earliest = np.argmax(equal, -1)
    grouped = (group >= 0) & ~np.all(np.isnan(angles), 0)
    return np.where(grouped, np.take_along_axis(number, earliest, -1), number)


def is_assumed(readings: Readings) -> bool:
    """Whether stations are taken as one setting although neither profile nor run says so."""
    number, group = (
        settings_of(readings),
        np.broadcast_to(readings.groups, readings.accelerometer.shape[:-1]),
    )
    together = (np.diff(number, axis=-1) == 0) & (group[..., 1:] < 0)
    return not readings.settings and bool(together.any())


def _equal(group: Sequence[Ints], angles: Sequence[Sequence[Array]]) -> Bools:
    """Where two stations are of one group and have the same known reference direction."""
    first, second = group
    equal, given = first == second, np.zeros((), bool)
    for angle, other in angles:
        blank = np.isnan(angle), np.isnan(other)
        equal = equal & ((np.abs(centred(angle - other)) < EQUAL) | (blank[0] & blank[1]))
        given = given | ~(blank[0] | blank[1])
    return np.asarray(equal & given)
