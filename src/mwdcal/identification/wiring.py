"""Which tool axis each channel measures, and its nominal scale, from readings at known attitudes.

Each channel is a straight line of the component of the field along its tool axis, but for misalignment:
raw = scale · component + offset. Of all 48 signed permutations of a triad the right one leaves a few
per cent of the channels' variation, any other most of it, unless the attitudes do not tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from mwdcal.geometry.vectors import Array

EXPLAINED = 0.3
"""Largest share of the channels' variation that the right axes leave: misalignment, noise, bias."""
ALTERNATIVE = 0.2
"""By how much less they leave than any others."""
LEAST_WITHOUT, LEAST_RATIO = 0.1, 2.0
"""A sign is told where without the component that tells it this share would be left, and so many times as much."""
LEAST_STATIONS = 5


class Wiring(NamedTuple):
    """The axes and scale of a triad, the share that they leave, and others that fit about as well."""

    axes: tuple[str, ...]
    scale: float
    unexplained: float
    next_best: float
    alternatives: list[tuple[str, ...]]


def wiring(raw: Array, *parts: Array) -> Wiring:
    """The axes of a triad by its raw readings (n, 3) and the field along the tool axes.

    `parts` (n, 3) each: components of the field at right angles to each other, which may come in unknown
    shares; the sign of the first is known. The scale is in raw units per unit of the field.
    Singular: a channel or a component that hardly varies explains nothing; its axis and sign stay open. So does the
    sign where the other component explains the readings as well, as at two inclinations and one azimuth.
    """
    shares, sizes = np.ones((2, 3, 3)), np.zeros((3, 3))
    moved = raw - raw.mean(0)
    spread = np.sqrt(np.mean(moved**2, 0))
    for axis in range(3):
        design = np.stack([part[:, axis] - part[:, axis].mean() for part in parts], -1)
        size = np.sqrt(np.mean(design**2, 0))
        seen = size > 0.02 * np.sqrt(np.mean(np.square(parts), (1, 2)))
        if not seen[0]:
            continue
        columns = design[:, seen]
        slope, share = _line(columns, moved)
        sizes[:, axis] = np.linalg.norm(slope, axis=0)
        alive = spread > 0.02 * spread.max()
        bare = _line(columns[:, 1:], moved)[1]
        signed = (bare > np.maximum(LEAST_WITHOUT, LEAST_RATIO * share)) | (columns.shape[1] == 1)
        for sign in (0, 1):
            right = slope[0] > 0 if sign == 0 else slope[0] < 0
            shares[sign, :, axis] = np.where(alive & (right | ~signed), share, 1.0)
    ranked = sorted(
        (float(np.sqrt(np.mean(shares[signs, range(3), order] ** 2))), order, signs)
        for order in permutations(range(3))
        for signs in product((0, 1), repeat=3)
    )
    if len(parts) == 2 and sum(each[0] < ranked[0][0] + ALTERNATIVE for each in ranked) > 1:
        ranked = sorted((_joint(moved, parts, *each[1:]), *each[1:]) for each in ranked)
    best, order, signs = ranked[0]
    near = [each for each in ranked if each[0] < best + ALTERNATIVE]
    scale = float(np.median(sizes[range(3), order]))
    return Wiring(
        _named(order, signs), scale, best, ranked[1][0], [_named(*each[1:]) for each in near]
    )


def _joint(
    moved: Array, parts: Sequence[Array], order: tuple[int, ...], signs: tuple[int, ...]
) -> float:
    """The share of all channels' variation that is left with one scale and one share of both components for all.

    Of an unknown dip the components come in the same shares on every axis; the first counts along itself.
    """
    axes, senses = list(order), 1.0 - 2.0 * np.array(signs)
    columns = np.stack([((part - part.mean(0))[:, axes] * senses).ravel() for part in parts], -1)
    slope, share = _line(columns, moved.reshape(-1, 1))
    return float(share[0]) if slope[0, 0] > 0 else 1.0


def _line(columns: Array, moved: Array) -> tuple[Array, Array]:
    """Slopes (K, 3) of the channels on columns (n, K), and the share of their variation that is left (3,).

    Per degree of freedom: few stations do not seem explained by many columns.
    """
    count, width = columns.shape
    slope, *_ = np.linalg.lstsq(columns, moved, rcond=1e-9)
    spread = np.sqrt(np.sum(moved**2, 0) / (count - 1))
    left = np.sqrt(np.sum((moved - columns @ slope) ** 2, 0) / (count - 1 - width))
    return np.asarray(slope), np.asarray(np.minimum(left / np.maximum(spread, 1e-300), 1.0))


def _named(order: tuple[int, ...], signs: tuple[int, ...]) -> tuple[str, ...]:
    return tuple("+-"[sign] + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))


def is_clear(result: Wiring) -> bool:
    """Whether the readings leave no choice of axes."""
    return len(result.alternatives) == 1 and result.unexplained < EXPLAINED
