"""Interference that acceptance cannot see: how much would pass at an attitude, and how far it turns the azimuth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, centred
from mwdcal.survey.acceptance import STRENGTH_NAMES, AcceptanceTests
from mwdcal.survey.stations import STATIONS_AT_ONCE

AXIAL = np.arange(50.0, 3001.0, 50.0)
"""Sizes of interference along the tool that are tried, nT; more than the last is not usual."""
CROSS_AXIAL = np.arange(50.0, 301.0, 50.0)
"""Sizes across it: to twice what multi-station analysis assumes."""
AROUND_TOOL = np.radians(np.arange(0.0, 360.0, 30.0))
"""Directions across it, rad."""
WHERE = ("along the tool", "across it")


@dataclass(frozen=True)
class Blindness:
    """Interference `size` (n, 2), nT, along the tool and across it, that would pass, and the `turn` (n, 2) it makes.

    Of all that is tried and would pass, that which turns the azimuth most, rad.
    """

    size: Array
    turn: Array

    def words(self, place: int, least: float) -> str:
        """What would pass at one survey and turn its azimuth by at least so much, rad."""
        parts = [
            f"{size:.0f} nT{' or more' if size >= last else ''} {where} by {np.degrees(turn):.2g}°"
            for size, turn, where, last in zip(
                self.size[place], self.turn[place], WHERE, (AXIAL[-1], CROSS_AXIAL[-1]), strict=True
            )
            if turn >= least
        ]
        return f"interference would pass and turn the azimuth: {', '.join(parts)}"


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
    for start in range(0, max(count, 1), STATIONS_AT_ONCE):
        yield slice(start, start + STATIONS_AT_ONCE)


def _candidates() -> tuple[Array, Array]:
    """Fields (k, 3) along the tool and across it, nT."""
    along = np.zeros((2 * len(AXIAL), 3))
    along[:, 2] = np.concatenate([AXIAL, -AXIAL])
    around = np.stack([np.cos(AROUND_TOOL), np.sin(AROUND_TOOL), 0 * AROUND_TOOL], -1)
    return along, (CROSS_AXIAL[:, None, None] * around).reshape(-1, 3)


def _of(tests: AcceptanceTests, g: Array, b: Array) -> tuple[Array, Array]:
    """Sizes and turns (m, 2) of some surveys."""
    sizes, turns = [], []
    for fields in _candidates():
        seen = g[:, None], b[:, None] + fields
        passing = tests.accept(_change(tuple(STRENGTH_NAMES), g, b, seen))
        turn = _change(("azimuth",), g, b, seen)
        turn = np.where(passing, np.abs(np.nan_to_num(centred(turn[..., 0]))), 0.0)
        best = np.argmax(turn, -1)[:, None]
        turns.append(np.take_along_axis(turn, best, -1)[:, 0])
        sizes.append(np.linalg.norm(fields, axis=-1)[best[:, 0]])
    return np.stack(sizes, -1), np.stack(turns, -1)


def _change(names: tuple[str, ...], g: Array, b: Array, seen: tuple[Array, Array]) -> Array:
    """Changes (m, k, len(names)) of observables from (g, b) to what is seen."""
    before, after = (
        np.stack(np.broadcast_arrays(*(OBSERVABLES[name].value(*pair) for name in names)), -1)
        for pair in ((g[:, None], b[:, None]), seen)
    )
    return np.asarray(after - before)
