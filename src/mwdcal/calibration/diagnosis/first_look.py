"""Which fits at the same exact references may show an effect: the first round of `structure` for all at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache

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
    responses,
    sensor_terms,
    squares_of,
)
from mwdcal.estimation.problem import Problem, State
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen, inverse, outer, quotient

EFFECT_CHANCE = 1e-4
"""Chance of so much common structure in noise, below which an effect is named."""
LEFT_BY_FIT = 1e-3
"""A column counts if the fit leaves this share of its square: what is left of others is rounding."""
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
    if any(name.endswith(("-temperature", "-thermal-lag")) for name in common_effects(design)):
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
                part, information = (
                    residual[..., 3 * index : 3 * index + 3],
                    each.information(response[index]),
                )
                inner = inverse(information + known[..., None] * np.eye(len(places)))
                force = each.score(response[index], part) + known * value
                step = (inner @ force[..., None])[..., 0]
                columns[index], covariance[index], pull[index] = each, inner, step
                misfit += np.sum(known * value**2 - force * step, -1)
                freedom += np.sum(inner * information, (-1, -2))
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


@lru_cache(maxsize=8)
def common_effects(design: Alike) -> dict[str, dict[int, CommonColumns]]:
    """The change of the readings of the triads by each effect, by name; nothing if it differs from tool to tool."""
    one, state = perfect(design)
    terms = [sensor_terms(one, state, index) for index in range(len(one.triads))]
    columns: dict[str, dict[int, CommonColumns]] = {}
    for name, family in families(one, state):
        triad, _, kind = name.partition("-")
        columns[name] = {}
        for index, term in enumerate(terms if kind != "hysteresis" else []):
            rows = family[0, :, 3 * index : 3 * index + 3]
            if rows.any():
                of_reading = np.full(rows.shape[-1], triad in TRIADS)
                columns[name][index] = CommonColumns.of(term, rows, of_reading)
    return columns


@lru_cache(maxsize=8)
def _across(design: Alike) -> dict[str, dict[int, Array]]:
    """The part of each effect that the drifts in the fit of a design can explain."""
    drifts = closed_form_drift.walk_columns(design) if design.problem.walks else {}
    return {
        name: {i: c.across(drifts[i][1]) for i, c in columns.items() if i in drifts}
        for name, columns in common_effects(design).items()
    }


def _gains(
    problem: Problem, design: Alike, residual: Array, response: list[Array], drifts: _Drifts
) -> Iterator[tuple[Array, Ints]]:
    """By how much (B,) each family lowers the misfit, and its directions, from whitened residuals (B, n, m)."""
    parts = np.split(residual, residual.shape[-1] // 3, -1)
    for name, columns in common_effects(design).items():
        triad, _, kind = name.partition("-")
        if kind == "hysteresis":
            index = TRIADS.index(triad)
            sides = side(moves(problem.triads[index].raw)) * problem.evidence.include[..., None]
            terms = sensor_terms(*perfect(design), index)
            yield _gain_of_sides(terms, sides, parts[index], index, response[index], drifts)
        elif columns:
            score = information = square = np.zeros(())
            for index, each in columns.items():
                reads = response[index]
                both = each.score(reads, parts[index]), each.information(reads)
                if index in drifts.columns:
                    cross = squares_of(reads) @ _across(design)[name][index]
                    cross = cross.reshape(*both[0].shape, -1)
                    both = drifts.less(index, cross, *both)
                score, information = score + both[0], information + both[1]
                square = square + each.squares(reads)
            yield gain_of(score, information, square)


def gain_of(score: Array, information: Array, square: Array) -> tuple[Array, Ints]:
    """By how much (B,) columns of so large a `square` (B, k) lower the misfit, and their directions."""
    length = np.sqrt(np.where(square > 0, square, 1.0))
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
