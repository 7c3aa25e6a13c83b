"""Runs at exact references whose readings drifted: the terms of the drift besides the closed form.

Given S, the readings are linear in the terms of a drift as well, and what they take of the residuals says S anew: it
changes by the noise times the drift, so that each round comes some thousand times closer.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.common_columns import (
    Alike,
    CommonColumns,
    are_common,
    perfect,
    responses,
    sensor_terms,
)
from mwdcal.estimation.problem import WALK_AXES, Problem, State
from mwdcal.estimation.uncertainty import Analysis, scaled_freedom, variance_factors
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, inverse_of_positive
from mwdcal.sensor.models import affine_parts

DRIFT_ROUNDS = 12
"""Most repetitions of drift and sensors in turn."""
SETTLED_DRIFT = 1e-9
"""A member has settled before a step that is shorter than this, in standard uncertainties."""
WalkColumns = dict[int, tuple[Ints, CommonColumns]]
"""Places of the constants that act on a triad, and what these do, by the number of the triad."""


def applies(problem: Problem) -> bool:
    """Whether the terms of a drift are the constants of runs at the same exact references."""
    constants = problem.evidence.constants
    walks = bool(constants) and all(constant.name in WALK_AXES for constant in constants)
    return walks and are_common(problem)


@lru_cache(maxsize=16)
def walk_columns(design: Alike, alone: bool = False) -> WalkColumns:
    """What the terms of the drifts do to the readings of the triads; `alone`: with the sensors' parameters known."""
    perfect_problem, at = perfect(design)
    columns = perfect_problem.walk_columns(at)[0]
    walk = np.array([WALK_AXES[c.name][0] for c in perfect_problem.evidence.constants])
    each = {}
    for index in np.unique(np.minimum(walk, 1)).tolist():
        terms = sensor_terms(perfect_problem, at, index)[:, : 0 if alone else None]
        places = np.flatnonzero(np.minimum(walk, 1) == index)
        rows = columns[:, 3 * index : 3 * index + 3, places]
        each[index] = places, CommonColumns.of(terms, rows, walk[places] < 2)
    return each


def scores(problem: Problem, state: State, residual: Array) -> Array:
    """Scores (B, q) of the terms in whitened residuals (B, n, m) of a fit without them."""
    reads, score = (
        responses(problem, state),
        np.zeros((len(residual), len(problem.evidence.constants))),
    )
    for index, (places, each) in walk_columns(Alike.of(problem, state)).items():
        score[:, places] = each.score(reads[index], residual[..., 3 * index : 3 * index + 3])
    return score


def information(problem: Problem, state: State, alone: bool = False) -> Array:
    """Information (B, q, q) of the readings on the terms; `alone`: with the sensors' parameters known."""
    reads, count = responses(problem, state), len(problem.evidence.constants)
    whole = np.zeros((len(state.params), count, count))
    for index, (places, each) in walk_columns(Alike.of(problem, state), alone).items():
        whole[:, places[:, None], places] = each.information(reads[index])
    return whole


def solution(problem: Problem, at: State) -> tuple[State, Analysis, Bools]:
    """State and analysis at the minimum for the attitudes of a state, and members (B,) that came there."""
    bare = replace(problem, evidence=replace(problem.evidence, constants=()))
    columns, precision = walk_columns(Alike.of(problem, at)), prior_precision(problem)
    value = np.zeros(precision.shape)
    steady, still = bare, replace(at, constants=value[:, :0])
    covariances: dict[int, Array] = {}
    for _ in range(DRIFT_ROUNDS):
        state, residual = closed_form.minimum(steady, still)
        reads = responses(steady, state)
        covariances = covariances or _covariances(columns, precision, reads)
        step, square = np.zeros(value.shape), np.zeros(len(value))
        for index, (places, each) in columns.items():
            pull = each.score(reads[index], residual[..., 3 * index : 3 * index + 3])
            pull = pull + precision[:, places] * value[:, places]
            step[:, places] = -(covariances[index] @ pull[..., None])[..., 0]
            square -= np.sum(step[:, places] * pull, -1)
        moving = square >= SETTLED_DRIFT**2
        if not moving.any():
            break
        value = value + step * moving[:, None]
        steady = _less_drift(bare, columns, reads, value)
    state, analysis, good = closed_form.solution(steady, still)
    reads = responses(steady, state)
    covariances = _covariances(columns, precision, reads)
    analysis = _with_drift(bare, state, analysis, columns, reads, covariances)
    effects = analysis.effects * np.sqrt(precision)[:, None]
    good = good & ~moving
    return replace(state, constants=value), replace(analysis, effects=effects), good


def effective_freedom(problem: Problem, analysis: Analysis) -> Array:
    """Degrees of freedom (B, t) of the χ² that s² times them follows: tr(S)² / tr(S²), as in `uncertainty`.

    With V the covariance of the terms of the drifts and Λ their precision before, 1 - ΛV is what the readings say of
    them: tr(S²) is less than tr(S) by the trace of that, and more by the trace of its square.
    """
    precision, square = prior_precision(problem), analysis.freedom.copy()
    owner = np.array([min(WALK_AXES[c.name][0], 1) for c in problem.evidence.constants])
    for index in np.unique(owner).tolist():
        places = np.flatnonzero(owner == index)
        known = -precision[:, places, None] * analysis.constants[:, places[:, None], places]
        np.einsum("bii->bi", known)[...] += 1
        square[:, index] += np.sum(known * known.mT, (-1, -2)) - diagonal(known).sum(-1)
    return scaled_freedom(analysis.freedom, square)


def prior_precision(problem: Problem) -> Array:
    """Precision (B, q) of the constants before the run."""
    return np.stack([constant.sd for constant in problem.evidence.constants], -1) ** -2.0


def _covariances(columns: WalkColumns, precision: Array, reads: list[Array]) -> dict[int, Array]:
    """Covariance (B, k, k) of the terms that act on each triad."""
    covariance = {}
    for index, (places, each) in columns.items():
        information = each.information(reads[index])
        np.einsum("bii->bi", information)[...] += precision[:, places]
        covariance[index] = inverse_of_positive(information)
    return covariance


def _less_drift(
    problem: Problem, columns: WalkColumns, reads: list[Array], value: Array
) -> Problem:
    """The problem with readings as they would be without drifts of some size (B, q)."""
    triads = [*problem.triads]
    for index, (places, each) in columns.items():
        drift = each.change(reads[index], value[:, places]) * triads[index].sd
        triads[index] = replace(triads[index], raw=triads[index].raw + drift)
    return replace(problem, triads=tuple(triads))


def _with_drift(
    problem: Problem,
    state: State,
    analysis: Analysis,
    columns: WalkColumns,
    reads: list[Array],
    covariances: dict[int, Array],
) -> Analysis:
    """The analysis of a fit without drift with the uncertainty of the drift; `effects` are covariances still."""
    count = sum(len(places) for places, _ in columns.values())
    constants = np.zeros((len(state.params), count, count))
    cross = np.zeros((*state.params.shape, count))
    covariance, spread = analysis.covariance.copy(), analysis.spread.copy()
    for index, (places, each) in columns.items():
        where, rows = problem.slices()[index], slice(3 * index, 3 * index + 3)
        inner, seen = covariances[index], each.seen(reads[index])
        moved = _moved_params(problem, state, index, each.taken)
        follow = moved @ inner
        constants[:, places[:, None], places] = inner
        cross[:, where, places] = follow
        covariance[:, where, where] += follow @ moved.mT
        flat = seen.reshape(len(seen), -1, seen.shape[-1])
        spread[..., rows, rows] -= (flat @ inner).reshape(seen.shape) @ seen.mT
    factor, freedom = variance_factors(analysis.residual, spread)
    return replace(
        analysis,
        covariance=covariance,
        constants=constants,
        effects=cross,
        spread=spread,
        variance_factor=factor,
        freedom=freedom,
    )


def _moved_params(problem: Problem, state: State, index: int, taken: Array) -> Array:
    """Change (B, 12, k) of a triad's parameters by effects of which they take up a part (4, 6, k)."""
    triad, where = problem.triads[index], problem.slices()[index]
    params, at = state.params[:, where], (triad.raw[:, :1], problem.temperature[:, :1])
    back = triad.model.slope(params, *at)[:, 0]
    turn = np.zeros((len(params), 4, 4))
    turn[:, :3, :3], turn[:, :3, 3] = affine_parts(params)
    turn[:, 3, 3] = 1.0
    field, reading = np.moveaxis(taken[:, :3], 0, 1), np.moveaxis(taken[:, 3:], 0, 1)
    by_axis = field + (back @ reading.reshape(3, -1)).reshape(-1, *reading.shape)
    moved = -turn.mT[:, None] @ by_axis
    return np.asarray(moved.reshape(len(params), 12, -1)[:, closed_form.PLACES])
