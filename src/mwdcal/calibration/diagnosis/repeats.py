"""Stations that repeat the readings of an earlier one more closely than noise allows: copies, not measurements."""

from __future__ import annotations

from math import erf

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.results import reading_noise
from mwdcal.geometry.vectors import Array, Bools

AGREEING = 0.03
"""Readings agree that differ on no channel by more than this share of its noise."""
NEAR = 10.0
"""Stations of one attitude differ on no channel by more than so many times its noise."""
COINCIDENCE = 1e-3
"""Chance below which as many pairs of measurements that agree are not a coincidence."""
LEAST_STEP = 1e-3
"""A resolution below this share of the noise is as good as none."""


def copies(result: Fit) -> Bools:
    """Stations (B, n) whose readings agree with those of an earlier one, where noise does not explain it.

    Definition: two measurements at one attitude agree on a channel by chance with a probability that follows from
    its noise and its resolution; a channel whose resolution is coarser than its noise says nothing. Copies are
    named if as many pairs would agree with a chance below `COINCIDENCE`.
    """
    noise = _noise(result)
    rows = np.concatenate(
        [t.raw / noise[:, [i], None] for i, t in enumerate(result.problem.triads)], -1
    )
    rows = np.nan_to_num(rows)
    weights = np.sqrt(2.0 + np.arange(rows.shape[-1]))
    line = np.sort(np.einsum("bnk,k->bn", rows, weights), -1)
    close = np.diff(line, axis=-1) <= AGREEING * weights.sum()
    repeated = np.zeros(rows.shape[:-1], bool)
    for member in np.flatnonzero(np.any(close, -1)):
        repeated[member] = _copies(rows[member])
    return repeated


def _noise(result: Fit) -> Array:
    """Noise (B, t) of a reading, as the residuals have it where more is declared; one where there is none."""
    less = np.minimum(np.nan_to_num(result.analysis.variance_factor, nan=1.0), 1.0)
    noise = reading_noise(result) * np.sqrt(less)
    return np.where(noise > 0, noise, 1.0)


def _copies(rows: Array) -> Bools:
    """Stations (n,) of one run that agree with an earlier one, of readings (n, k) in units of their noise."""
    from scipy.spatial import KDTree

    tree = KDTree(rows)
    within = np.asarray(tree.count_neighbors(tree, [AGREEING, NEAR], p=np.inf)).tolist()
    pairs, near = (int(count - len(rows)) // 2 for count in within)
    alone = float(np.prod([_agreement(resolution(each)) for each in rows.T]))
    if not pairs or _at_least(pairs, near, alone) >= COINCIDENCE:
        return np.zeros(len(rows), bool)
    distinct, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    tree = KDTree(distinct)
    earliest = [first[tree.query_ball_point(row, AGREEING, p=np.inf)].min() for row in distinct]
    return np.asarray(np.array(earliest)[which.ravel()] < np.arange(len(rows)))


def _agreement(step: float) -> float:
    """Chance that two measurements of one value agree on a channel of this resolution, in units of its noise."""
    return 1.0 if step >= 1.0 else erf(max(AGREEING, step / 2) / 2)


def _at_least(pairs: int, of: int, chance: float) -> float:
    """Chance of as many successes in so many trials: binomial."""
    from scipy.special import bdtrc

    return float(bdtrc(pairs - 1, of, chance))


def resolution(values: Array) -> float:
    """Largest step of which all differences of values (n,) are multiples; 0 where none is above `LEAST_STEP`.

    Reference: Euclid's algorithm, to `LEAST_STEP`.
    """
    rest, step = np.abs(values - values[0]), 0.0
    while (left := rest[rest > LEAST_STEP]).size:
        step = float(left.min())
        rest = np.abs(rest - step * np.round(rest / step))
    return step if step > 10 * LEAST_STEP else 0.0
