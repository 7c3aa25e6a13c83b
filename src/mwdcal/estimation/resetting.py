"""Stations of one setting of the stand that were set one by one after all: residuals show that, and by how much.

Where nobody says how often the operator sets the stand, stations of one direction are taken as one
setting. Their share `Evidence.apart` of the declared σ is then estimated, as the noise is, by restricted
maximum likelihood: zero unless the stations of a setting scatter by more than the noise explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import (
    LARGEST_CHANGE,
    Analysis,
    fisher_tail,
    triad_sums,
    whole_covariance,
)
from mwdcal.geometry.vectors import Array, Bools

APART_CHANCE = 0.01
"""Chance of as much scatter within settings in noise, below which it is estimated."""
LEAST_VARIANCE = 1e-6
"""Least variance of the scatter within settings, as a share of the square of its mean."""
EXACT_VARIANCE = np.full(1, 1e9)
"""Degrees of freedom of a variance without error."""
LEAST_APART = 0.01
"""Share of the declared σ below which stations are not set apart."""


def _scores(problem: Problem, state: State, analysis: Analysis) -> tuple[Array, Array]:
    """Q = qᵀVq (B,) and its mean in noise, tr(PV), by triad (B, t); V of a departure of unit share."""
    columns = problem.resetting_columns(state)
    along = np.einsum("bnmk,bnm->bnk", columns, analysis.residual)
    expected = triad_sums(np.sum(columns * (analysis.spread @ columns), -1))
    return np.sum(along**2, (-1, -2)), expected


def _variance(problem: Problem, state: State, analysis: Analysis, expected: Array) -> Array:
    """Variance (B,) of Q in noise, 2 tr(PVPV), less 2 m²/ν of a triad of estimated noise: ν degrees of freedom, mean m.

    With P = W - WXCXᵀW and V = ZZᵀ: tr(B²) - 2 tr(C AᵀBA) + tr((C AᵀA)²), B = ZᵀWZ by station, A = ZᵀWX.
    """
    columns, linear = problem.resetting_columns(state), problem.linear(state)
    weighed = linear.weigh(columns)
    inner, across = columns.mT @ weighed, weighed.mT @ linear.design
    whole = whole_covariance(linear, analysis.determined)
    mixed = whole @ np.sum(across.mT @ inner @ across, 1)
    shared = whole @ np.sum(across.mT @ across, 1)
    trace = np.sum(inner**2, (1, 2, 3)) - 2 * np.einsum("buu->b", mixed)
    trace = trace + np.sum(shared * shared.mT, (-1, -2))
    estimated = [not triad.declared for triad in problem.triads]
    absorbed = expected**2 / np.maximum(analysis.freedom, 1.0)
    return np.asarray(2 * (trace - np.sum(absorbed * estimated, -1)))


def set_apart(problem: Problem, state: State, analysis: Analysis) -> Bools:
    """Members (B,) whose stations of one setting scatter as much as in noise they do with a chance of `APART_CHANCE`.

    The chance is that of the χ² with mean and variance of Q. Of declared noise it has no more degrees of freedom than
    there are errors that a setting shares: that many, and so at least that chance, clear most members at once.
    Reference: F. E. Satterthwaite, Biometrics Bulletin 2, 110 (1946).
    """
    square, by_triad = _scores(problem, state, analysis)
    expected = by_triad.sum(-1)
    apart = (expected > 0) & (square > expected)
    if all(triad.declared for triad in problem.triads):
        errors = np.count_nonzero(problem.evidence.set_together, (1, 2))
        ratio = square / np.where(apart, expected, 1.0)
        apart &= fisher_tail(np.maximum(errors, 1), EXACT_VARIANCE, ratio) < APART_CHANCE
    places = np.flatnonzero(apart)
    if places.size:
        mean, at, means = expected[places], take(state, places), by_triad[places]
        variance = _variance(take(problem, places), at, take(analysis, places), means)
        freedom = 2 * mean**2 / np.maximum(variance, LEAST_VARIANCE * mean**2)
        apart[places] = fisher_tail(freedom, EXACT_VARIANCE, square[places] / mean) < APART_CHANCE
    return np.asarray(apart)


def with_share(problem: Problem, state: State, analysis: Analysis) -> Problem:
    """The problem with the next estimate of each share, which is never more than all that is declared."""
    square, by_triad = _scores(problem, state, analysis)
    expected = by_triad.sum(-1)
    ratio = np.where(expected > 0, square / np.where(expected > 0, expected, 1.0), 1.0)
    ratio = np.clip(np.nan_to_num(ratio, nan=1.0), 1 / LARGEST_CHANGE, LARGEST_CHANGE)
    share = problem.evidence.apart * np.sqrt(ratio)
    share = np.where(share < LEAST_APART, 0.0, np.minimum(share, 1.0))
    return problem.with_noise(problem.triads, replace(problem.evidence, apart=share))
