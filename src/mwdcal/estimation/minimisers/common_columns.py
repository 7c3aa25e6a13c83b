"""Effects on the readings of tools that were measured at the same exact references: what these have in common.

Such a tool reads raw = S f + o + noise, and its parameters take up all that is linear in f̃ = [f 1]. An effect on what
it should read, a column c (n, 3) in the frame of the field, is S c in its readings; one on the readings themselves is c
in those of any tool. What the parameters leave of c is therefore the same for all tools, and all sums over the stations
are linear in SᵀS, S and 1: they are formed once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from mwdcal.estimation.batch import held_once, is_once, take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.problem import Problem, State
from mwdcal.geometry.vectors import Array, Bools, inverse
from mwdcal.sensor.models import Polynomial

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
        each = [array[0].tobytes() for array in (*arrays, state.attitude)]
        return cls((*names, *each), *take((problem, state), np.arange(1)))


@lru_cache(maxsize=16)
def perfect(design: Alike) -> tuple[Problem, State]:
    """A design as sensors without error and with noise of one would read it."""
    problem, state = design.problem, design.state
    triads = [replace(triad, sd=np.ones_like(triad.sd)) for triad in problem.triads]
    params = [triad.model.start(np.eye(3)[None], np.zeros((1, 3))) for triad in triads]
    state = replace(state, params=np.concatenate(params, -1))
    return replace(problem, triads=tuple(triads)), state


def responses(problem: Problem, state: State) -> list[Array]:
    """What a change of the field, and one of the readings, does to each triad's whitened ones: [S 1] / σ (B, 3, 6)."""
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
        both = (self.whole @ value[:, None, :, None])[..., 0]
        return np.asarray(both @ response.mT)


def products_of(first: Array, second: Array) -> Array:
    """Sums (16, k q) over the stations of products of columns (n, 6, k) and (n, 6, q)."""
    flat = np.moveaxis(first, 0, 2)[:, None] @ np.moveaxis(second, 1, 0)
    return _by_response(flat)


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
