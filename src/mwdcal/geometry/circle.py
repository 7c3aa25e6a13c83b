"""Angles on a circle: their means and medians do not depend on where the circle is cut."""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import AnyArray, Array, Ints

WHOLE_TURN = 360.0
"""Degrees of a circle: angles of files are in degrees."""


def resultant(angles: Array) -> AnyArray:
    """Mean (...) of unit vectors at angles (..., n), radians, as complex numbers.

    Its angle is the mean direction; its length is 1 where all angles are one, and 0 where they cancel.
    """
    return np.asarray(np.mean(np.exp(1j * angles), -1))


def _nearest(angles: Array, about: Array, turn: float) -> Array:
    """Angles with the whole turns added that bring them within half a turn of others."""
    return np.asarray(angles + turn * np.round((about - angles) / turn))


def unrolled(angles: Array, turn: float = WHOLE_TURN, starts: Ints | None = None) -> Array:
    """Angles (n,) with the whole turns added that bring them within half a turn of the mean direction of their set.

    `starts` (m,): the first of each set; None: all are one set. Sums and orders of the result are those of a line.
    """
    starts = np.zeros(1, int) if starts is None else starts
    sums = np.add.reduceat(np.exp(2j * np.pi / turn * angles), starts)
    middle = turn / (2 * np.pi) * np.angle(sums)
    return _nearest(angles, np.repeat(middle, np.diff(starts, append=len(angles))), turn)


def means(angles: Array, turn: float = WHOLE_TURN, starts: Ints | None = None) -> Array:
    """Mean (m,) of each set of angles (n,), from zero to a turn, or within half a turn of zero if one is negative."""
    starts = np.zeros(1, int) if starts is None else starts
    sizes = np.diff(starts, append=len(angles))
    line = unrolled(angles, turn, starts)
    above = np.add.reduceat(line - np.repeat(line[starts], sizes), starts) / sizes
    middle = np.where(np.minimum.reduceat(angles, starts) < 0, 0.0, turn / 2)
    return _nearest(line[starts] + above, middle, turn)
