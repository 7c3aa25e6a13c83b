"""Roll sets: stations in one direction of the tool axis and at one temperature; scatter of that direction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.readings import Readings, soaks
from mwdcal.geometry.vectors import Array, Bools, Ints

NEAR_VERTICAL = np.radians(5.0)
"""Nearer to vertical than this azimuth and toolface are not judged."""
ROLL_SET = 3
"""Fewest stations that make a roll set."""
_ANGLE_DIGITS = 3
_BLANK = -1.0
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RollSet:
    """Stations of one direction and one temperature.

    `index` (k,) are their numbers. `declared`: the run says that they are a roll set, by `group`
    or by naming no direction at all; else the stand was set to the direction at each station.
    `one_azimuth`: they are known to share an azimuth too.
    """

    label: str
    index: Ints
    declared: bool
    one_azimuth: bool


def roll_sets(readings: Readings) -> list[RollSet]:
    """Roll sets of a run: by group, else by equal reference angles, else all stations.

    Stations of different temperatures are never in one set. Equal inclinations without azimuth
    make a set that does not share an azimuth.
    """
    warmth = np.zeros(readings.count) if readings.temperature is None else readings.temperature
    several, sets = soaks(warmth).any(), []
    for label, members, declared, one_azimuth in _directions(readings):
        where = np.flatnonzero(members)
        soak = soaks(warmth[where])
        for number in np.unique(soak):
            index = where[soak == number]
            at = f", {warmth[index].mean():.1f} °C" if several else ""
            if len(index) >= ROLL_SET:
                sets.append(RollSet(label + at, index, declared, one_azimuth))
    return sets


def _directions(readings: Readings) -> Iterator[tuple[str, Bools, bool, bool]]:
    """Label and members (n,) of each direction, whether it is declared, and of one azimuth."""
    group = readings.groups
    for number in range(int(group.max(initial=-1)) + 1):
        yield f"roll set {number + 1}", np.asarray(group == number), True, True
    inclination, azimuth = (np.degrees(readings.reference(n)) for n in ("inclination", "azimuth"))
    known = ~np.isnan(inclination)
    if not known.any() and (group < 0).all():
        yield "all stations", np.ones(readings.count, bool), True, True
        return
    key = np.round(np.stack([inclination, np.nan_to_num(azimuth, nan=_BLANK)], -1), _ANGLE_DIGITS)
    for pair in np.unique(key[(group < 0) & known], axis=0):
        given = bool(pair[1] != _BLANK)
        where = f"azimuth {pair[1]:g}°" if given else "azimuth not given"
        members = np.all(key == pair, -1) & (group < 0)
        yield f"inclination {pair[0]:g}°, {where}", members, False, given


def near_vertical(readings: Readings, inclination: Array) -> Bools:
    """Stations (n,) within `NEAR_VERTICAL` of vertical.

    By the reference inclination, else the mean measured `inclination` (n,) of the group, else that
    of the station.
    """
    steep, group = np.sin(inclination), readings.groups
    for number in range(int(group.max(initial=-1)) + 1):
        steep = np.where(group == number, steep[group == number].mean(), steep)
    given = readings.reference("inclination")
    steep = np.where(np.isnan(given), steep, np.sin(given))
    return np.asarray(steep < np.sin(NEAR_VERTICAL) - _ROUNDING)


def directions(g: Array, b: Array) -> Array:
    """Unit vector (..., 3) of the tool axis in the earth frame: north, east, down.

    Singular: where field and gravity are parallel (a magnetic pole) there is no north.
    """
    down = g / np.linalg.norm(g, axis=-1, keepdims=True)
    east = np.cross(down, b)
    with np.errstate(invalid="ignore"):  # a vertical direction has no east
        east = east / np.linalg.norm(east, axis=-1, keepdims=True)
    north = np.cross(east, down)
    return np.stack([north[..., 2], east[..., 2], down[..., 2]], -1)


def group_scatter(axis: Array, group: Ints) -> float:
    """Mean over groups of the norm of the (N - 1) standard deviations of `axis`, radians.

    Shapes: axis (n, 3), NaN where there is none; group (n,), -1: in no group. NaN without a group
    of two. Reference: the accuracy measure of CircuitPython_mag_cal, so that results compare.
    """
    group = np.where(np.isnan(axis).any(-1), -1, group)
    each = [axis[group == k] for k in np.unique(group[group >= 0])]
    spread = [np.linalg.norm(v.std(axis=0, ddof=1)) for v in each if len(v) > 1]
    return float(np.mean(spread)) if spread else float("nan")
