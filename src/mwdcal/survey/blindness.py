"""Interference that acceptance cannot see: how much would pass at an attitude, and how far it turns the azimuth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mwdcal.geometry.observables import is_vertical
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.survey.acceptance import AcceptanceTests

AXIAL = np.arange(50.0, 3001.0, 50.0)
"""Sizes of interference along the tool that are tried, nT; more than the last is not usual."""
CROSS_AXIAL = np.arange(50.0, 301.0, 50.0)
"""Sizes across it: to twice what multi-station analysis assumes."""
AROUND_TOOL = np.radians(np.arange(0.0, 360.0, 30.0))
"""Directions across it, rad."""
SURVEYS_AT_ONCE = 1 << 8
"""Surveys for which all sizes are tried at once, so that they stay in fast memory."""
WHERE = ("along the tool", "across it")


@dataclass(frozen=True)
class Blindness:
    """Interference `size` (n, 2), nT, along the tool and across it, that would pass, and the `turn` (n, 2) it makes.

    Of all that is tried and would pass, that which turns the azimuth most, rad.
    """

    size: Array
    turn: Array

    def words(self, places: Ints, least: Array) -> list[str]:
        """What would pass at some surveys (m,) and turn their azimuth by at least so much (m,), rad."""
        parts: list[list[str]] = [[] for _ in places]
        for k, (where, last) in enumerate(zip(WHERE, (AXIAL[-1], CROSS_AXIAL[-1]), strict=True)):
            names = {
                size: f"{size:.0f} nT{' or more' if size >= last else ''} {where} by "
                for size in np.unique(self.size[places, k]).tolist()
            }
            turns = np.degrees(self.turn[places, k]).tolist()
            enough = (self.turn[places, k] >= least).tolist()
            for each, size, turn, is_enough in zip(
                parts, self.size[places, k].tolist(), turns, enough, strict=True
            ):
                if is_enough:
                    each.append(f"{names[size]}{turn:.2g}°")
        return [
            f"interference would pass and turn the azimuth: {', '.join(each)}" for each in parts
        ]


def blindness(tests: AcceptanceTests, vectors: tuple[Array, Array]) -> Blindness:
    """What the acceptance of surveys (n,) with these vectors (n, 3), g and nT, would let pass.

    Definition: interference that shifts |g|, |b| and dip of a survey without other errors by what the tests accept.
    """
    parts = [
        _of(tests.part(rows), *(each[rows] for each in vectors))
        for rows in _blocks(len(vectors[0]))
    ]
    return Blindness(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, max(count, 1), SURVEYS_AT_ONCE):
        yield slice(start, start + SURVEYS_AT_ONCE)


def _candidates() -> tuple[Array, Array]:
    """Fields (k, 3) along the tool and across it, nT."""
    along = np.zeros((2 * len(AXIAL), 3))
    along[:, 2] = np.concatenate([AXIAL, -AXIAL])
    around = np.stack([np.cos(AROUND_TOOL), np.sin(AROUND_TOOL), 0 * AROUND_TOOL], -1)
    return along, (CROSS_AXIAL[:, None, None] * around).reshape(-1, 3)


def _of(tests: AcceptanceTests, g: Array, b: Array) -> tuple[Array, Array]:
    """Sizes and turns (m, 2) of some surveys.

    Interference f makes the horizontal field h to h + f - (f·d) d, d down: the azimuth turns by the angle between them.
    """
    down = g / np.linalg.norm(g, axis=-1, keepdims=True)
    side = np.where(is_vertical(g)[:, None], np.nan, np.cross(down, b))
    strength, across = np.linalg.norm(b, axis=-1, keepdims=True), np.sum(side**2, -1, keepdims=True)
    below = np.sum(down * b, -1, keepdims=True)
    before = np.arctan2(below, np.linalg.norm(np.cross(down, b), axis=-1, keepdims=True))
    sizes, turns = [], []
    for fields in _candidates():
        size, along, fall = np.linalg.norm(fields, axis=-1), b @ fields.mT, down @ fields.mT
        total = np.sqrt(strength**2 + 2 * along + size**2)
        dip = np.arcsin(np.clip((below + fall) / total, -1.0, 1.0))
        passing = tests.accept({"field": total - strength, "dip": dip - before})
        turn = np.abs(np.arctan2(side @ fields.mT, across + along - below * fall))
        turn = np.where(passing & (turn > 0), turn, 0.0)
        best = np.argmax(turn, -1)[:, None]
        turns.append(np.take_along_axis(turn, best, -1)[:, 0])
        sizes.append(size[best[:, 0]])
    return np.stack(sizes, -1), np.stack(turns, -1)
