"""A roll test made again many times: standard normal numbers behind each error of a test, always the same.

Errors that two figures have in common are drawn once: noise of a reading, a setting of the stand, its zeros.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mwdcal.geometry.vectors import Array
from mwdcal.use.roll_test import PAIRS, RANDOM_SEED

CHANNELS = 6
"""Channels of both triads."""
MOST_NUMBERS = 2_000_000
"""A test of more stations is repeated less often, but no fewer than `FEWEST_PAIRS` times two."""
FEWEST_PAIRS = 50


@dataclass(frozen=True)
class Draws:
    """Errors (d, ...) of d tests of `count` stations, in opposite pairs, so that their mean is zero."""

    count: int
    _references: dict[str, Array] = field(default_factory=dict)

    @property
    def pairs(self) -> int:
        """Half the number of tests."""
        most = MOST_NUMBERS // (CHANNELS * max(self.count, 1))
        return max(FEWEST_PAIRS, min(PAIRS, most))

    @cached_property
    def _noise(self) -> Array:
        """Standard normal numbers (d / 2, n, 6) behind the noise of the readings."""
        rng = np.random.default_rng(RANDOM_SEED)
        return rng.normal(size=(self.pairs, self.count, CHANNELS))

    def noise(self, gradient: Array) -> Array:
        """Errors (d, n) by noise of an observable that moves so (n, 6) with its standard normal numbers."""
        half = np.einsum("nj,dnj->dn", gradient, self._noise)
        return np.concatenate([half, -half])

    def reference(self, name: str) -> Array:
        """Standard normal numbers (d, n) of a reference, for each station or setting of the stand."""
        return self._named(name, self.count)

    def common(self, name: str) -> Array:
        """Standard normal numbers (d,) of what all references of a name share: a zero of the stand."""
        return self._named(f"common {name}", 1)[:, 0]

    def _named(self, name: str, count: int) -> Array:
        if name not in self._references:
            rng = np.random.default_rng([RANDOM_SEED, *name.encode()])
            half = rng.normal(size=(self.pairs, count))
            self._references[name] = np.concatenate([half, -half])
        return self._references[name]
