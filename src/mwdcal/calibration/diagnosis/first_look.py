"""Which fits at the same exact references may show an effect: the first round of `structure` for all at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np

from mwdcal.calibration.automatic.courses import f_test
from mwdcal.calibration.diagnosis.families import families, moves, side
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.minimisers import closed_form, closed_form_drift
from mwdcal.estimation.minimisers.common_columns import (
    Alike,
    CommonColumns,
    are_common,
    perfect,
    products_of,
    responses,
    sensor_terms,
    squares_of,
)
from mwdcal.estimation.problem import Problem, State
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    diagonal,
    eigen,
    inverse_of_positive,
    outer,
    quotient,
)

EFFECT_CHANCE = 1e-4
"""Chance of so much common structure in noise, below which an effect is named."""
LEFT_BY_FIT = 1e-3
"""A column counts if the fit leaves this share of its square: what is left of others is rounding."""
HYSTERESIS = "-hysteresis"
"""What ends the names of families whose columns are each tool's own."""
LOOK_MARGIN = 0.99
"""A fit is looked at from this share of the gain that would name an effect: rounding differs by far less."""
GAINS = np.geomspace(1, 1e4, 1000)
"""Ratios of variances at which the chance of noise is worked out."""


def may_show(result: Fit) -> Bools:
    """Fits (B,) that may show an effect.

    All of them where the columns of effects are not common to tools, or depend on temperature.
    """
    problem, every = result.problem, np.ones(len(result.status), bool)
    if problem.evidence.constants:
        common = closed_form_drift.applies(problem)
    else:
        common = closed_form.applies(problem) and are_common(problem)
    if not common:
        return every
    design = Alike.of(problem, result.state)
    if any(
        name.endswith(("-temperature", "-thermal-lag")) for name in common_effects(design).columns
    ):
        return every
    scale = np.sqrt(np.maximum(variance_scales(result), 1e-12))
    residual = result.analysis.residual / np.repeat(scale, 3, -1)[:, None]
    response = [r / scale[:, i, None, None] for i, r in enumerate(responses(problem, result.state))]
    drifts = _Drifts.of(problem, result.state, design, residual, response)
    misfit, shown = np.sum(residual**2, (1, 2)) + drifts.misfit, ~every
    rest = np.sum(problem.evidence.include[0]) * residual.shape[-1] - result.state.params.shape[-1]
    rest = np.ceil(rest - drifts.freedom)
    for gain, directions in _gains(problem, design, residual, response, drifts):
        for count, left in {*zip(directions.tolist(), rest.tolist(), strict=True)}:
            if count:
                least = least_gain(count, left) * LOOK_MARGIN
                shown |= (directions == count) & (rest == left) & (gain > least * misfit)
    return np.asarray(shown)


@dataclass(frozen=True)
class _Drifts:
    """Drifts that are in the fits, by triad: their columns, covariance (B, q, q), and the pull (B, q) that is left.

    What they add to the `misfit` (B,), and take of its degrees of `freedom` (B,).
    """

    columns: dict[int, CommonColumns]
    covariance: dict[int, Array]
    pull: dict[int, Array]
    misfit: Array
    freedom: Array

    @classmethod
    def of(
        cls, problem: Problem, state: State, design: Alike, residual: Array, response: list[Array]
    ) -> _Drifts:
        """Of a problem at its solution, with other whitened residuals (B, n, m) and responses."""
        columns, covariance, pull = {}, {}, {}
        misfit, freedom = np.zeros((2, len(residual)))
        if problem.walks:
            precision = closed_form_drift.prior_precision(problem)
            for index, (places, each) in closed_form_drift.walk_columns(design).items():
                known, value = precision[:, places], state.constants[:, places]
                part = residual[..., 3 * index : 3 * index + 3]
                information = each.information(response[index])
                np.einsum("bii->bi", information)[...] += known
                inner = inverse_of_positive(information)
                force = each.score(response[index], part) + known * value
                step = (inner @ force[..., None])[..., 0]
                columns[index], covariance[index], pull[index] = each, inner, step
                misfit += np.sum(known * value**2 - force * step, -1)
                freedom += len(places) - np.sum(known * diagonal(inner), -1)
        return cls(columns, covariance, pull, misfit, freedom)

    def less(
        self, index: int, cross: Array, score: Array, information: Array
    ) -> tuple[Array, Array]:
        """Score (B, k) and information (B, k, k) of effects on a triad less what drifts take.

        `cross` (B, k, q) is what they have in common.
        """
        taken = cross @ self.covariance[index]
        return (
            score - (cross @ self.pull[index][..., None])[..., 0],
            information - taken @ cross.mT,
        )


@dataclass(frozen=True)
class _Families:
    """Effects that are common to tools: what one product of all tools needs, by number of the triad.

    `places` of each family's columns among the k of all, and of its products among those of all families. `left`
    (n, 6, k), `products` (16, p) and `squares` (16, k) as of `CommonColumns`, zero where a family has no effect on the
    triad. `sides` are names of families whose columns are each tool's own.
    """

    places: dict[str, tuple[slice, slice]]
    left: list[Array]
    products: list[Array]
    squares: list[Array]
    columns: dict[str, dict[int, CommonColumns]]
    sides: list[str]

    @classmethod
    def of(
        cls, columns: dict[str, dict[int, CommonColumns]], triads: int, stations: int
    ) -> _Families:
        """Of the effects of each family on each triad."""
        common = {name: each for name, each in columns.items() if each}
        counts = [next(iter(each.values())).whole.shape[-1] for each in common.values()]
        ends, squared = np.cumsum([0, *counts]), np.cumsum([0, *(k * k for k in counts)])
        pairs = zip(pairwise(ends.tolist()), pairwise(squared.tolist()), strict=True)
        places = dict(zip(common, ((slice(*k), slice(*p)) for k, p in pairs), strict=True))
        left = [np.zeros((stations, 6, ends[-1])) for _ in range(triads)]
        products, squares = (
            [np.zeros((16, end[-1])) for _ in range(triads)] for end in (squared, ends)
        )
        for name, (some, pair) in places.items():
            for index, each in common[name].items():
                left[index][..., some], products[index][:, pair] = each.left, each.products
                squares[index][:, some] = each.lengths
        sides = [name for name, each in columns.items() if not each and name.endswith(HYSTERESIS)]
        return cls(places, left, products, squares, common, sides)

    def sums(
        self, residual: Array, response: list[Array]
    ) -> tuple[list[Array], list[Array], Array]:
        """By triad: scores (B, k) and products (B, p) of all families; and the squares (B, k) of whole columns."""
        scores, information, square = [], [], np.zeros(())
        for index, reads in enumerate(response):
            pull = residual[..., 3 * index : 3 * index + 3] @ reads
            scores.append(pull.reshape(len(pull), -1) @ self.left[index].reshape(pull[0].size, -1))
            squared = squares_of(reads)
            information.append(squared @ self.products[index])
            square = square + squared @ self.squares[index]
        return scores, information, square


@lru_cache(maxsize=8)
def common_effects(design: Alike) -> _Families:
    """The change of the readings of the triads by each effect."""
    one, state = perfect(design)
    terms = [sensor_terms(one, state, index) for index in range(len(one.triads))]
    columns: dict[str, dict[int, CommonColumns]] = {}
    for name, family in families(one, state):
        triad = name.partition("-")[0]
        columns[name] = {}
        for index, term in enumerate([] if name.endswith(HYSTERESIS) else terms):
            rows = family[0, :, 3 * index : 3 * index + 3]
            if rows.any():
                of_reading = np.full(rows.shape[-1], triad in TRIADS)
                columns[name][index] = CommonColumns.of(term, rows, of_reading)
    return _Families.of(columns, len(terms), len(terms[0]))


@lru_cache(maxsize=8)
def _across(design: Alike) -> dict[int, Array]:
    """The part of all effects that the drifts in the fit of a design can explain, by triad: (16, k q)."""
    drifts = closed_form_drift.walk_columns(design)
    left = common_effects(design).left
    return {index: products_of(left[index], each.left) for index, (_, each) in drifts.items()}


def _gains(
    problem: Problem, design: Alike, residual: Array, response: list[Array], drifts: _Drifts
) -> Iterator[tuple[Array, Ints]]:
    """By how much (B,) each family lowers the misfit, and its directions, from whitened residuals (B, n, m)."""
    effects, count = common_effects(design), len(residual)
    scores, products, square = effects.sums(residual, response)
    across = {
        index: (squares_of(response[index]) @ _across(design)[index]).reshape(
            count, square.shape[-1], -1
        )
        for index in drifts.columns
    }
    for name, (some, pair) in effects.places.items():
        size = some.stop - some.start
        score = information = np.zeros(())
        for index in effects.columns[name]:
            both = scores[index][:, some], products[index][:, pair].reshape(count, size, size)
            if index in across:
                both = drifts.less(index, across[index][:, some], *both)
            score, information = score + both[0], information + both[1]
        yield gain_of(score, information, square[:, some])
    for name in effects.sides:
        index = TRIADS.index(name.removesuffix(HYSTERESIS))
        raw, include = problem.triads[index].raw, problem.evidence.include
        sides = side(moves(raw)) * include[..., None]
        terms = sensor_terms(*perfect(design), index)
        part = residual[..., 3 * index : 3 * index + 3]
        yield _gain_of_sides(terms, sides, part, index, response[index], drifts)


def gain_of(score: Array, information: Array, square: Array) -> tuple[Array, Ints]:
    """By how much (B,) columns of so large a `square` (B, k) lower the misfit, and their directions."""
    length = np.sqrt(np.where(square > 0, square, 1.0))
    if length.shape[-1] == 1:
        value, vector = information[..., 0] / length**2, np.ones((1, 1))
    else:
        value, vector = eigen(information / outer(length))
    along = (vector.mT @ (score / length)[..., None])[..., 0]
    kept = value > LEFT_BY_FIT
    return quotient(along**2, value, kept).sum(-1), np.count_nonzero(kept, -1)


def _gain_of_sides(
    terms: Array, sides: Array, residual: Array, index: int, response: Array, drifts: _Drifts
) -> tuple[Array, Ints]:
    """The same for a column on each axis of a triad, of which the values (B, n, 3) are each tool's."""
    basis = np.linalg.qr(terms)[0]
    whole = np.sum(sides**2, 1)
    left = whole - np.sum((basis.transpose() @ sides) ** 2, 1)
    score = np.sum(sides * residual, 1)
    if index in drifts.columns:
        seen = drifts.columns[index].left
        cross = (sides.mT @ seen.reshape(len(seen), -1)).reshape(len(sides), 3, 6, -1)
        cross = np.sum(response[..., None] * cross, 2)
        return gain_of(*drifts.less(index, cross, score, left[..., None] * np.eye(3)), whole)
    kept = left > LEFT_BY_FIT * whole
    return quotient(score**2, left, kept).sum(-1), np.count_nonzero(kept, -1)


@cache
def least_gain(directions: int, rest: float) -> float:
    """Share of the misfit from which a family of so many directions may be named, the `rest` being all other freedom.

    >>> round(least_gain(1, 265.0), 3)
    0.056
    """
    rest -= directions
    many = np.full(GAINS.shape, float(directions))
    chance = f_test(GAINS * directions, many, np.ones(()), np.full(GAINS.shape, rest))
    ratio = GAINS[max(int(np.sum(~(chance < EFFECT_CHANCE))) - 1, 0)] * directions
    return float(ratio / (ratio + max(rest, 1.0)))
