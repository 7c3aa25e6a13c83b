"""Variance components of a fit: what departs from station to station, and how probable a run is.

Strengths, dip and the direction of a group are constants of the model. Real instruments are held by
hand, near iron: each such constant may have a scatter of its own beside the noise of the sensors.
Its variance is estimated like the noise, by restricted maximum likelihood (REML).

Reference: D. A. Harville, J. Am. Stat. Assoc. 72, 320 (1977).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import Analysis
from mwdcal.geometry.vectors import Array, diagonal

FIRST_SCATTER = 1e-3
"""Scatter at which its estimation begins, as a share or in radians."""
LEAST_SCATTER = 1e-5
"""Scatter below which there is none."""
LARGEST_CHANGE = 20.0
"""A variance changes by this factor at most in one round."""
PIN = 0.05
"""Parameters are known to this share of the field when runs are compared by their probability."""


def scatter_ratios(problem: Problem, state: State, analysis: Analysis) -> dict[str, Array]:
    """New variance (B,) of each scatter over its present one; REML has the fixed point at one.

    Definition: with q = P y and P the covariance of the weighed residuals, qᵀVq / tr(PV) for the
    component V = GGᵀ of unit variance. One where nothing tests a component.
    """
    ratios = {}
    for name, columns in problem.scatter_columns(state).items():
        share = problem.evidence.scatter[name][..., None]
        share = share / np.maximum(share.max(1, keepdims=True), LEAST_SCATTER)
        along = np.einsum("bnmk,bnm->bnk", columns, analysis.residual) * share
        tested = columns * share[..., None]
        whole = np.einsum("bnmk,bnml,bnlk->b", tested, analysis.spread, tested, optimize=True)
        square = np.sum(along**2, (-1, -2))
        ratio = np.where(whole > 0, square / np.where(whole > 0, whole, 1.0), 1.0)
        ratios[name] = np.clip(np.nan_to_num(ratio, nan=1.0), 1 / LARGEST_CHANGE, LARGEST_CHANGE)
    return ratios


def with_scatter(problem: Problem, state: State, ratios: dict[str, Array]) -> Problem:
    """The problem with each scatter's variance times a ratio (B,).

    A strength scatters no more than the noise of its triad: else nothing would be left to tell
    that noise by.
    """
    scatter = {
        name: np.maximum(value * np.sqrt(ratios[name])[:, None], LEAST_SCATTER)
        for name, value in problem.evidence.scatter.items()
    }
    sizes = [p.strength.mean(-1) for p in problem.predictions(state)]
    for name, triad, size in zip(("gravity", "field"), problem.triads, sizes, strict=False):
        if name in scatter:
            noise = np.sqrt(np.mean(triad.sd**2, (1, 2))) / size
            scatter[name] = np.minimum(scatter[name], np.maximum(noise, LEAST_SCATTER)[:, None])
    return replace(problem, evidence=replace(problem.evidence, scatter=scatter))


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def log_evidence(problem: Problem, state: State) -> Array:
    """Logarithm (B,) of the probability of the readings, parameters integrated out.

    Definition: Laplace's approximation at the fit, exact for a linear problem. Parameters without
    a prior get one of `PIN` times the field, the same in all models that are compared; a free
    direction then counts the same in all.
    """
    linear = problem.linear(state)
    include = problem.evidence.include
    noise = sum((np.log(t.sd).sum(-1) * include).sum(-1) for t in problem.triads)
    private = -np.linalg.slogdet(linear.core)[1].sum(-1)
    known = diagonal(problem.prior.precision)
    pin = np.zeros((len(known), linear.prior.shape[-1]))
    for name, where in zip(("gravity", "field"), problem.slices(), strict=False):
        size = problem.constant(state, name).mean(-1)[:, None]
        pin[:, where] = (PIN * size) ** -2
    information = linear.normal.information + pin[:, :, None] * np.eye(pin.shape[-1])
    prior = np.log(np.where(known > 0, known, pin[:, : linear.size])).sum(-1)
    determinant = np.linalg.slogdet(information)[1]
    whole = 2 * noise + private + determinant - prior + linear.normal.cost
    return np.asarray(-0.5 * whole)
