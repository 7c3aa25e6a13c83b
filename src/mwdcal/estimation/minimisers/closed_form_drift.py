"""Runs at exact references whose readings drifted: the terms of the drift besides the closed form.

Given S, the readings are linear in the terms of a drift as well, and what they take of the residuals says S anew: it
changes by the noise times the drift, so that each round comes some thousand times closer.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from mwdcal.estimation.batch import held_once, is_once, take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.problem import WALK_AXES, Problem, State
from mwdcal.estimation.uncertainty import (
    Analysis,
    per_freedom,
    scaled_freedom,
    tested_inverse,
    variance_factors,
)
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, inverse, inverse_of_positive
from mwdcal.sensor.models import Polynomial, affine_parts

# --------------------------------------------------------------------------
# Effects on the readings of tools that were measured at the same exact references: what these have in common.
#
# Such a tool reads raw = S f + o + noise, and its parameters take up all that is linear in f̃ = [f 1]. An effect on
# what
# it should read, a column c (n, 3) in the frame of the field, is S c in its readings; one on the readings themselves is
# c
# in those of any tool. What the parameters leave of c is therefore the same for all tools, and all sums over the
# stations
# are linear in SᵀS, S and 1: they are formed once.

FIRST_AXES, SECOND_AXES = np.triu_indices(3)
"""Pairs of axes of a symmetric matrix."""


def are_common(problem: Problem) -> bool:
    """Whether all references are exact, and members differ in their readings and the level of their noise alone."""
    return closed_form.but_for_constants(problem) and are_alike(problem)


def are_alike(problem: Problem) -> bool:
    """Whether members differ in their readings and the level of their noise alone."""
    evidence = problem.evidence
    if not all(isinstance(triad.model, Polynomial) for triad in problem.triads):
        return False
    if any(closed_form.noise_level(triad) is None for triad in problem.triads):
        return False
    arrays = [*evidence.known.values(), evidence.include, problem.temperature]
    return is_once(*held_once(tuple(arrays)))


@dataclass(frozen=True)
class Alike:
    """The first member of a problem; equal to others of equal references and constants, whatever the readings."""

    references: tuple[bytes | str, ...]
    problem: Problem = field(compare=False)
    state: State = field(compare=False)

    @classmethod
    def of(cls, problem: Problem, state: State) -> Alike:
        """Of the members of a problem that `are_common`."""
        evidence = problem.evidence
        masks = [constant.mask for constant in evidence.constants]
        arrays = [*evidence.known.values(), evidence.include, problem.temperature, *masks]
        names = [str(len(problem.triads)), *(constant.name for constant in evidence.constants)]
        references = (*names, *(array[0].tobytes() for array in (*arrays, state.attitude)))
        if references not in _DESIGNS:
            if len(_DESIGNS) >= MOST_DESIGNS:
                _DESIGNS.clear()
            _DESIGNS[references] = cls(references, *take((problem, state), np.arange(1)))
        return _DESIGNS[references]


MOST_DESIGNS = 16
"""Designs whose first members are kept: to take these out of a batch with drifts costs as much as a product of all."""
_DESIGNS: dict[tuple[bytes | str, ...], Alike] = {}


@lru_cache(maxsize=MOST_DESIGNS)
def perfect(design: Alike) -> tuple[Problem, State]:
    """A design as sensors without error and with noise of one would read it."""
    problem, state = design.problem, design.state
    triads = [replace(triad, sd=np.ones_like(triad.sd)) for triad in problem.triads]
    params = [triad.model.start(np.eye(3)[None], np.zeros((1, 3))) for triad in triads]
    state = replace(state, params=np.concatenate(params, -1))
    return replace(problem, triads=tuple(triads)), state


def responses(problem: Problem, state: State) -> list[Array]:
    """Effect of a change of the field, and of the readings, on each triad's whitened ones: [S 1] / σ (B, 3, 6)."""
    each = []
    for triad, where in zip(problem.triads, problem.slices(), strict=True):
        params, at = state.params[:, where], (triad.raw[:, :1], problem.temperature[:, :1])
        gain = inverse(triad.model.slope(params, *at)[:, 0])
        both = np.concatenate([gain, np.broadcast_to(np.eye(3), gain.shape)], -1)
        each.append(both / triad.sd[:, :1, :1])
    return each


def sensor_terms(problem: Problem, state: State, index: int) -> Array:
    """f̃ (n, 4) of a triad at the stations that count."""
    vectors, include = problem.targets(state)[index][0], problem.evidence.include[0, :, None]
    return np.concatenate([vectors, np.ones_like(include)], -1) * include


@dataclass(frozen=True)
class CommonColumns:
    """Columns of k effects on the readings of one triad.

    `whole` and `left` (n, 6, k), in the frame of the field and then in that of the readings: what an effect does, and
    what the sensors' parameters do not take up. `taken` (4, 6, k) is what they take up, by element of f̃.
    By element of SᵀS, S and 1, sums over the stations: `products` (16, k k) of what is left, and `lengths` (16, k),
    squares of the whole.
    """

    whole: Array
    left: Array
    taken: Array
    products: Array
    lengths: Array

    @classmethod
    def of(cls, terms: Array, columns: Array, of_reading: Bools) -> CommonColumns:
        """From f̃ (n, 4), or none of its elements, and columns (n, 3, k) of a perfect triad.

        They act on the field or, where `of_reading` (k,), on the readings themselves.
        """
        whole = np.concatenate([columns * ~of_reading, columns * of_reading], 1)
        basis, triangle = np.linalg.qr(terms)
        taken = basis.transpose() @ whole.reshape(len(whole), -1)
        left = whole - (basis @ taken).reshape(whole.shape)
        taken = np.linalg.solve(triangle, taken).reshape(-1, *whole.shape[1:])
        lengths = _by_response(np.einsum("nik,njk->ijk", whole, whole))
        return cls(whole, left, taken, products_of(left, left), lengths)

    def information(self, response: Array) -> Array:
        """Information (B, k, k) on the effects, the sensors' parameters being unknown; of `responses` (B, 3, 6)."""
        count = self.whole.shape[-1]
        return np.asarray((squares_of(response) @ self.products).reshape(-1, count, count))

    def squares(self, response: Array) -> Array:
        """Squares (B, k) of the lengths of the columns in whitened readings."""
        return np.asarray(squares_of(response) @ self.lengths)

    def score(self, response: Array, residual: Array) -> Array:
        """Scores (B, k) of the effects in whitened residuals (B, n, 3) of a fit without them."""
        if len(response) == 1:  # of one response for all residuals
            columns = self.seen(response)[0]
            flat = residual.reshape(len(residual), -1)
            return np.asarray(flat @ columns.reshape(-1, columns.shape[-1]))
        flat = (residual @ response).reshape(len(residual), -1)
        return np.asarray(flat @ self.left.reshape(-1, self.left.shape[-1]))

    def seen(self, response: Array) -> Array:
        """What effects do to whitened residuals (B, n, 3, k)."""
        return np.asarray(response[:, None] @ self.left)

    def change(self, response: Array, value: Array) -> Array:
        """Change (B, n, 3) of whitened readings by effects of some size (B, k)."""
        both = value @ self.whole.reshape(-1, value.shape[-1]).transpose()
        return np.asarray(both.reshape(len(value), *self.whole.shape[:2]) @ response.mT)


def products_of(first: Array, second: Array) -> Array:
    """Sums (16, k q) over the stations of products of columns (n, 6, k) and (n, 6, q)."""
    one, other = (columns.reshape(len(columns), -1) for columns in (first, second))
    shape = (*first.shape[1:], *second.shape[1:])
    return _by_response((one.transpose() @ other).reshape(shape).swapaxes(1, 2))


def _by_response(sums: Array) -> Array:
    """Sums (6, 6, ...) over the stations of products of elements, flat, by the 16 `squares_of` a response."""
    field = sums[FIRST_AXES, SECOND_AXES] + sums[SECOND_AXES, FIRST_AXES]
    field[FIRST_AXES == SECOND_AXES] /= 2
    across = sums[3:, :3] + np.swapaxes(sums[:3, 3:], 0, 1)
    reading = sums[3, 3] + sums[4, 4] + sums[5, 5]
    count = reading.size
    parts = [part.reshape(-1, count) for part in (field, across, reading)]
    return np.concatenate(parts)


def squares_of(response: Array) -> Array:
    """Elements (B, 16) of SᵀS, S and 1, over σ², of responses (B, 3, 6)."""
    gain, one = response[..., :3], response[:, :1, 3]
    square = (gain.mT @ gain)[:, FIRST_AXES, SECOND_AXES]
    return np.concatenate([square, gain.reshape(-1, 9) * one, one**2], -1)


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


@lru_cache(maxsize=MOST_DESIGNS)
def walk_columns(design: Alike, alone: bool = False) -> WalkColumns:
    """Effect of the drift terms on the readings of the triads; `alone`: with the sensors' parameters known."""
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


def left_out_variances(
    problem: Problem, state: State, analysis: Analysis, tool: Ints, station: Ints
) -> tuple[Array, Array]:
    """The same (k, t) as `uncertainty.left_out_variances`, by the covariance of a triad's residuals.

    That is S = 1 - H - D V Dᵀ: H projects on f̃, D is what the drifts do to the readings, and V their covariance.
    """
    design, reads = Alike.of(problem, state), responses(problem, state)
    columns, every = walk_columns(design), np.arange(len(tool))
    squares, freedom = np.empty((2, len(tool), len(reads)))
    for index, response in enumerate(reads):
        axes = slice(3 * index, 3 * index + 3)
        basis = np.linalg.qr(sensor_terms(*perfect(design), index))[0]
        hat = np.eye(len(basis)) - basis @ basis.transpose()
        across = hat[station][..., None, None] * np.eye(3)
        if index in columns:
            places, each = columns[index]
            seen = each.seen(response[tool])
            follow = analysis.constants[tool][:, places[:, None], places] @ seen[every, station].mT
            flat = seen.reshape(len(seen), -1, seen.shape[-1])
            across = across - (flat @ follow).reshape(across.shape)
        residual = analysis.residual[tool, :, axes]
        back = tested_inverse(analysis.spread[tool, station, axes, axes])[0]
        moved = across @ (back @ residual[every, station, :, None])[:, None]
        squares[:, index] = np.sum((residual - moved[..., 0]) ** 2, (1, 2))
        shares = np.sum(back * np.sum(across.mT @ across, 1), (1, 2))
        freedom[:, index] = analysis.freedom[tool, index] - shares
    return np.maximum(per_freedom(squares, freedom), 0.0), freedom


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
