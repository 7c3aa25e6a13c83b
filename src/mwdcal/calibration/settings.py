"""Settings of the stand: which stations share one, because the operator set the direction once and rolled the tool.

The stand's error of inclination and azimuth is then common to these stations: it does not average
down over the turn, and small scatter within the set is no evidence that it is small.
"""

from __future__ import annotations

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.geometry.vectors import Array, Bools, Ints, centred

DIRECTION = ("inclination", "azimuth")
"""The angles that one setting of the stand gives to several stations."""
ASSUMED = (
    "Assumed: direction set once per roll set; state [stand] settings in the profile, as "
    '"per-direction" or "per-station".'
)
"""The assumption where nobody states the practice of the stand."""
EQUAL = 1e-6
"""References closer than this are one setting, radians: they differ by rounding alone."""


def settings_of(readings: Readings) -> Ints:
    """Number (..., n) of the setting of the stand that each station belongs to.

    Definition: stations that follow each other with equal reference inclination and azimuth share a
    setting, unless the profile says that the stand is set at every station; so do stations of a
    group with equal references, wherever they are in the run. Returning to a direction later is a
    new setting. Stations without either angle have a setting of their own.
    """
    shape = readings.accelerometer.shape[:-1]
    group = np.broadcast_to(readings.groups, shape)
    angles = [readings.reference(name) for name in DIRECTION]
    next_to = [np.stack([x[..., 1:], x[..., :-1]]) for x in (group, *angles)]
    shared = _equal(*next_to)
    if readings.settings == "per-station":
        shared &= group[..., 1:] >= 0
    first = np.ones((*shape[:-1], 1), bool)
    number = np.cumsum(np.concatenate([first, ~shared], -1), -1) - 1
    if (group < 0).all():
        return np.asarray(number)
    pairs = [
        np.stack(np.broadcast_arrays(x[..., :, None], x[..., None, :])) for x in (group, *angles)
    ]
    earliest = np.argmax(_equal(*pairs), -1)
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


def _equal(group: Ints, *angles: Array) -> Bools:
    """Where two stations (2, ...) are of one group and have the same known reference direction."""
    blank = [np.isnan(angle) for angle in angles]
    same = [np.abs(centred(angle[0] - angle[1])) < EQUAL for angle in angles]
    same = [each | none.all(0) for each, none in zip(same, blank, strict=True)]
    return np.asarray(np.all(same, 0) & ~np.all(blank, (0, 1)) & (group[0] == group[1]))
