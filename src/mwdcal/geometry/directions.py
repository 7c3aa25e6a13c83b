"""Directions of the tool axis in the earth frame, and how they scatter within groups that share one."""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array, Ints


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
