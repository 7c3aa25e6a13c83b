"""Which fits at the same exact references may show an effect: the first round of `structure` for all at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

import numpy as np

from mwdcal.calibration.automatic.courses import f_test
from mwdcal.calibration.diagnosis.families import families, moves, side
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.common_columns import (
    CommonColumns,
    are_common,
    perfect,
    responses,
    sensor_terms,
)
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen, outer, quotient

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
    if not (closed_form.applies(problem) and are_common(problem)):
        return every
    columns = dict(families(*perfect(problem, result.state)))
    if any(name.endswith(("-temperature", "-thermal-lag")) for name in columns):
        return every
    scale = np.sqrt(np.maximum(variance_scales(result), 1e-12))
    residual = result.analysis.residual / np.repeat(scale, 3, -1)[:, None]
    response = [r / scale[:, i, None, None] for i, r in enumerate(responses(problem, result.state))]
    misfit, shown = np.sum(residual**2, (1, 2)), ~every
    rest = np.sum(problem.evidence.include[0]) * residual.shape[-1] - result.state.params.shape[-1]
    for gain, directions in _gains(result, columns, residual, response):
        for count in np.unique(directions[directions > 0]).tolist():
            least = least_gain(count, float(rest)) * LOOK_MARGIN
            shown |= (directions == count) & (gain > least * misfit)
    return np.asarray(shown)


def _gains(
    result: Fit, columns: Mapping[str, Array], residual: Array, response: list[Array]
) -> Iterator[tuple[Array, Ints]]:
    """By how much (B,) each family lowers the misfit, and its directions, from whitened residuals (B, n, m)."""
    one, state = perfect(result.problem, result.state)
    terms = [sensor_terms(one, state, index) for index in range(len(one.triads))]
    parts = [residual[..., 3 * i : 3 * i + 3] for i in range(len(terms))]
    for name, family in columns.items():
        triad, _, kind = name.partition("-")
        if kind == "hysteresis":
            index = TRIADS.index(triad)
            sides = side(moves(result.problem.triads[index].raw))
            sides = sides * result.problem.evidence.include[..., None]
            yield _gain_of_sides(terms[index], sides, parts[index])
            continue
        count = family.shape[-1]
        score, square = np.zeros((2, len(residual), count))
        information = np.zeros((len(residual), count, count))
        for index, (term, part, reads) in enumerate(zip(terms, parts, response, strict=True)):
            rows = family[0, :, 3 * index : 3 * index + 3]
            if rows.any():
                each = CommonColumns.of(term, rows, np.full(rows.shape[-1], triad in TRIADS))
                score += each.score(reads, part)
                information += each.information(reads)
                square += each.squares(reads)
        length = np.sqrt(np.where(square > 0, square, 1.0))
        value, vector = eigen(information / outer(length))
        along = (vector.mT @ (score / length)[..., None])[..., 0]
        kept = value > LEFT_BY_FIT
        yield quotient(along**2, value, kept).sum(-1), np.count_nonzero(kept, -1)


def _gain_of_sides(terms: Array, sides: Array, residual: Array) -> tuple[Array, Ints]:
    """The same for a column on each axis, of which the values (B, n, 3) are each tool's."""
    basis = np.linalg.qr(terms)[0]
    whole = np.sum(sides**2, 1)
    left = whole - np.sum((basis.transpose() @ sides) ** 2, 1)
    kept = left > LEFT_BY_FIT * whole
    square = np.sum(sides * residual, 1) ** 2
    return quotient(square, left, kept).sum(-1), np.count_nonzero(kept, -1)


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
