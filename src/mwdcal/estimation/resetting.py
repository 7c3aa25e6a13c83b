"""Stations of one setting of the stand that were set one by one after all: residuals show that, and by how much.

Where nobody says how often the operator sets the stand, stations of one direction are taken as one
setting. Their share `Evidence.apart` of the declared σ is then estimated, as the noise is, by restricted
maximum likelihood: zero unless the stations of a setting scatter by clearly more than the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import LARGEST_CHANGE, Analysis
from mwdcal.geometry.vectors import Array, Bools

CLEAR = 3.0
"""Standard deviations by which the scatter within settings exceeds the noise where it is estimated."""
LEAST_APART = 0.01
"""Share of the declared σ below which stations are not set apart."""


def _scores(problem: Problem, state: State, analysis: Analysis) -> tuple[Array, Array, Array]:
    """qᵀVq, tr(PV) and the variance 2 tr(PVPV) (B,) of a departure of unit share, station by station."""
    columns = problem.resetting_columns(state)
    along = np.einsum("bnmk,bnm->bnk", columns, analysis.residual)
    inner = columns.mT @ analysis.spread @ columns
    expected = np.einsum("bnkk->b", inner)
    return np.sum(along**2, (-1, -2)), expected, 2 * np.sum(inner**2, (1, 2, 3))


def set_apart(problem: Problem, state: State, analysis: Analysis) -> Bools:
    """Members (B,) whose stations of one setting scatter by clearly more than the noise."""
    square, expected, variance = _scores(problem, state, analysis)
    return np.asarray((expected > 0) & (square > expected + CLEAR * np.sqrt(variance)))


def with_share(problem: Problem, state: State, analysis: Analysis) -> Problem:
    """The problem with the next estimate of each share, which is never more than all that is declared."""
    square, expected, _ = _scores(problem, state, analysis)
    ratio = np.where(expected > 0, square / np.where(expected > 0, expected, 1.0), 1.0)
    ratio = np.clip(np.nan_to_num(ratio, nan=1.0), 1 / LARGEST_CHANGE, LARGEST_CHANGE)
    share = problem.evidence.apart * np.sqrt(ratio)
    share = np.where(share < LEAST_APART, 0.0, np.minimum(share, 1.0))
    return problem.with_noise(problem.triads, replace(problem.evidence, apart=share))
