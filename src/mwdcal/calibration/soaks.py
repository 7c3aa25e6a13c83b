"""Soaks: the temperatures at which a run was measured, and which station belongs to which."""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array, Ints

SOAK_GAP = 5.0
"""Temperatures closer than this belong to one soak, °C."""
LEAST_TEMPERATURE_SPAN = 10.0
"""A run that spans less has no temperature terms, °C. An order needs as much for each power."""


HIGHEST = 3
"""The highest temperature order of a model."""


def soaks(temperature: Array) -> Ints:
    """Number (..., n) of the soak that each station belongs to, coldest first."""
    order = np.argsort(temperature, -1, kind="stable")
    ascending = np.take_along_axis(temperature, order, -1)
    steps = np.cumsum(np.diff(ascending, prepend=ascending[..., :1], axis=-1) > SOAK_GAP, -1)
    numbers = np.empty(order.shape, int)
    np.put_along_axis(numbers, order, steps, -1)
    return numbers


def usable_soaks(temperature: Array) -> Ints:
    """Number (..., n) of each station's soak: all 0 where temperatures span less than `LEAST_TEMPERATURE_SPAN`."""
    wide = np.ptp(temperature, axis=-1, keepdims=True) >= LEAST_TEMPERATURE_SPAN
    return np.where(wide, soaks(temperature), 0)


def highest_order(temperature: Array) -> Ints:
    """The highest order (...,) that soaks (..., n) can carry: one less than they are, 10 °C for each."""
    levels = usable_soaks(temperature).max(-1) + 1
    return np.asarray(
        np.minimum(levels - 1, np.ptp(temperature, axis=-1) // LEAST_TEMPERATURE_SPAN), int
    )
