"""Which fits on an uncertain stand may show an effect: the first round of `structure` for all at once.

Tools at the same references have the columns of effects in common but for their own sensors; here they are taken where
the stand does not err. Weights, and what the fit takes up, are each tool's own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mwdcal.calibration.diagnosis.families import moves, side
from mwdcal.calibration.diagnosis.first_look import (
    HYSTERESIS,
    common_effects,
    gain_of,
    least_gain,
)
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.evidence import ANGLES
from mwdcal.estimation.minimisers import uncertain_stand
from mwdcal.estimation.minimisers.common_columns import Alike, are_alike, responses
from mwdcal.estimation.minimisers.stand_columns import TRIAD_ROWS
from mwdcal.estimation.problem import Problem, State
from mwdcal.geometry.vectors import Array, Bools

STAND_MARGIN = 0.75
"""A fit is looked at from this share of the gain that would name an effect."""
LARGEST_ERROR = 5e-3
"""Errors of angles, rad, up to which the columns of effects are as without them."""
LARGEST_RESCALING = 0.1
"""Change of the noise, as a share, up to which the weights are as in the fit."""


def on_stand_may_show(result: Fit) -> Bools:
    """Fits (B,) on an uncertain stand that may show an effect.

    All of them where the columns of effects are not common to tools, or depend on temperature.
    """
    problem, every = result.problem, np.ones(len(result.status), bool)
    if not are_alike(problem):
        return every
    design = _exact(problem, result.state)
    common = common_effects(design).columns
    if any(name.endswith(("-temperature", "-thermal-lag")) for name in common):
        return every
    at, errors = uncertain_stand.linear(problem, result.state), result.state.errors
    scale = np.sqrt(variance_scales(result))
    shown = np.any(np.abs(scale - 1) > LARGEST_RESCALING, -1)
    shown |= np.any(np.abs(errors) > LARGEST_ERROR, (1, 2))
    residual = at.weighed(at.left)
    misfit = np.einsum("ibn,ibn->b", at.left, residual) + np.sum(at.precision * at.value**2, -1)
    known = np.sum(at.covariance * at.of_data, (1, 2))
    rest = np.ceil(6 * problem.evidence.include.sum(-1) - known)
    for columns in _columns(problem, result, design):
        weighed = np.einsum("ij...,jk...->ik...", at.weight, columns)
        score = np.einsum("ikbn,ibn->bk", columns, residual)
        crossed = at.columns.with_others(weighed)
        information = np.einsum("ikbn,ilbn->bkl", columns, weighed)
        square = np.einsum("bkk->bk", information).copy()
        information -= crossed.mT @ (at.covariance @ crossed)
        gain, directions = gain_of(score, information, square)
        for count, left in {*zip(directions.tolist(), rest.tolist(), strict=True)}:
            if count:
                least = least_gain(count, left) * STAND_MARGIN
                shown |= (directions == count) & (rest == left) & (gain > least * misfit)
    return np.asarray(shown)


def _exact(problem: Problem, state: State) -> Alike:
    """The design of a problem as if its stand did not err."""
    evidence = problem.evidence
    sd = {n: 0 * sd if n in ANGLES else sd for n, sd in evidence.sd.items()}
    exact = replace(problem, evidence=replace(evidence, sd=sd))
    return Alike.of(exact, replace(state, errors=0 * state.errors))


def _columns(problem: Problem, result: Fit, design: Alike) -> Iterator[Array]:
    """Columns (6, k, B, n) of every effect in whitened readings."""
    response, include = responses(problem, result.state), problem.evidence.include
    effects = common_effects(design)
    for columns in effects.columns.values():
        count = next(iter(columns.values())).whole.shape[-1]
        every = np.zeros((6, count, *include.shape))
        for index, each in columns.items():
            flat = each.whole.transpose(1, 2, 0).reshape(6, -1)
            both = (response[index] @ flat).reshape(len(include), 3, count, -1)
            every[TRIAD_ROWS[index]] = np.moveaxis(both, 0, 2)
        yield every
    for name in effects.sides:
        index = TRIADS.index(name.removesuffix(HYSTERESIS))
        one = problem.triads[index]
        sides = side(moves(one.raw)) * include[..., None] / one.sd
        every = np.zeros((6, 3, *include.shape))
        for axis in range(3):
            every[3 * index + axis, axis] = sides[..., axis]
        yield every
