"""Did a tool change? A test of its calibrations against their stated uncertainty, all of them at once.

Two statements at one level: that one parameter took a step between two calibrations, by the largest of all
scores of such steps; and that the calibrations disagree at all, by their misfit to one set of parameters.
Both are judged by their joint distribution under no change, so that all parameters and all transitions
together raise a false alarm at the stated level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.drift.walk import DEPENDENT, History
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints, diagonal, outer

CHANGE_LEVEL = 0.01
"""Share of unchanged tools that are called changed."""
STEP_SHARE = 0.8
"""Share of the level that steps of one parameter have; the misfit has the rest."""
NULL_DRAWS = 9_999
"""Histories without change that the test is judged by."""
FIRST_DRAWS = 999
"""Of these, those that decide where they leave no doubt: see `change_test`."""
DECIDED_BEYOND = 6.0
"""Standard deviations of the share of the first draws above the level within which all are drawn."""
PAIR_DRAWS = 1_999
"""Of these, those that two calibrations alone are judged by."""
LEAST_PROBABILITY = 1 / (NULL_DRAWS + 1)
"""The smallest probability that the draws can state: it stands for this or less."""
LEAST_PAIR_PROBABILITY = 1 / (PAIR_DRAWS + 1)
"""The smallest of two calibrations alone."""
SEED_OF_DRAWS = 15
MOST_NAMED_STEPS = 8
"""Most steps of one tool that are named."""
UNSEEN = 1e-6
"""A step of which the calibrations tell less than this share of what one of them does is not tested."""


@dataclass(frozen=True)
class Step:
    """A step of the parameter at `place` between calibrations `after` - 1 and `after`, counted from 0.

    `size` with its standard uncertainty, all named steps being estimated together; `score` is that by which it
    was found: the step over its uncertainty if nothing else changed.
    """

    place: int
    after: int
    size: float
    uncertainty: float
    score: float


@dataclass(frozen=True)
class ChangeTest:
    """The outcome of the test of one tool: `probability` that an unchanged tool shows this much.

    `scores` (n - 1, p) of a step of each parameter between calibrations, NaN where they do not tell;
    `largest_score` of those of steady parameters, and the `critical_score` that it may have; `misfit` (χ²)
    of one set of parameters with its `degrees_of_freedom`. Of each pair of successive calibrations alone
    (n - 1,): `pair_misfit`, `pair_freedom` and `pair_probability`.
    """

    level: float
    probability: float
    scores: Array
    largest_score: float
    critical_score: float
    step_probability: float
    misfit: float
    degrees_of_freedom: int
    misfit_probability: float
    pair_misfit: Array
    pair_freedom: Array
    pair_probability: Array
    steps: tuple[Step, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the tool is said to have changed."""
        return self.probability <= self.level


@dataclass(frozen=True)
class Contrasts:
    """What differences between calibrations tell: `precision` (n, p, p) of each, in any units."""

    precision: Array

    @cached_property
    def _unit(self) -> Array:
        """Units (p,) in which all calibrations together know each parameter to one."""
        known = diagonal(self.precision.sum(0))
        return np.where(known > 0, 1 / np.sqrt(np.where(known > 0, known, 1.0)), 0.0)

    @cached_property
    def scaled(self) -> Array:
        """The precision (n, p, p) in these units."""
        return np.asarray(self.precision * outer(self._unit))

    @cached_property
    def after(self) -> Array:
        """What the calibrations from each transition on know together (n - 1, p, p)."""
        return np.asarray(np.cumsum(self.scaled[::-1], 0)[::-1][1:])

    @cached_property
    def _mean(self) -> Array:
        """Covariance (p, p) of the parameters, if they never changed."""
        return np.linalg.pinv(self.scaled.sum(0), DEPENDENT, hermitian=True)

    @cached_property
    def information(self) -> Array:
        """Information (n - 1, p, p) about a change at each transition, the parameters being unknown."""
        return np.asarray(self.after - self.after @ self._mean @ self.after)

    @cached_property
    def known(self) -> Bools:
        """Which steps (n - 1, p) the calibrations tell."""
        return np.asarray(diagonal(self.information) > UNSEEN)

    @cached_property
    def freedom(self) -> int:
        """Degrees of freedom of the misfit."""
        ranks = np.linalg.matrix_rank(self.scaled, DEPENDENT, hermitian=True)
        return int(ranks.sum() - np.linalg.matrix_rank(self._mean, DEPENDENT, hermitian=True))

    def departures(self, values: Array) -> Array:
        """Values (n, p) less those of the last calibration that has them, in our units."""
        latest = [column[~np.isnan(column)][-1:] for column in values.transpose()]
        middle = np.array([each[0] if each.size else 0.0 for each in latest])
        unit = np.where(self._unit > 0, self._unit, 1.0)
        return np.asarray(np.nan_to_num((values - middle) / unit) * (self._unit > 0))

    def pull(self, departures: Array) -> Array:
        """What each calibration says (…, n, p) of parameters that depart so."""
        return _each(self.scaled.astype(departures.dtype), departures)

    def sums(self, pull: Array) -> Array:
        """What speaks for a change (…, n - 1, p) at each transition, of covariance `information`."""
        later = pull.copy()
        for k in range(pull.shape[-2] - 1, 0, -1):  # a running sum, whose terms lie side by side
            later[..., k - 1, :] += later[..., k, :]
        rest = later[..., 1:, :]
        mean = (later[..., 0, :] @ self._mean.astype(pull.dtype))[..., None, :]
        after = self.after.astype(pull.dtype)
        return np.asarray(rest - _each(after, np.broadcast_to(mean, rest.shape)))

    def scores(self, pull: Array) -> Array:
        """Scores (…, n - 1, p) of a step of each parameter alone, of variance 1 under no change."""
        size = np.sqrt(np.where(self.known, diagonal(self.information), np.inf))
        return np.asarray(self.sums(pull) / size.astype(pull.dtype))

    def misfit(self, departures: Array, pull: Array) -> Array:
        """Misfit (…,) of one set of parameters to all calibrations."""
        total = pull[..., 0, :]
        for k in range(1, pull.shape[-2]):
            total = total + pull[..., k, :]
        whole = np.einsum("...ki,...ki->...", departures, pull)
        return np.asarray(whole - (total * (total @ self._mean.astype(pull.dtype))).sum(-1))

    def drawn(self, noise: Array, stretch: Array) -> Array:
        """Departures (…, n, p) of an unchanged tool from standard normal `noise`, grown by `stretch`."""
        values, vectors = np.linalg.eigh(self.scaled)
        largest = values[:, -1:]
        inverse = np.where(values > DEPENDENT * largest, 1 / np.sqrt(np.maximum(values, 1e-300)), 0)
        root = vectors * inverse[:, None, :]
        return _each(root.mT.astype(noise.dtype), noise) * stretch

    def pair(self, first: int, departures: Array) -> tuple[Contrasts, Array]:
        """Of two successive calibrations alone, and their departures (…, 2, p) in its units."""
        pair = Contrasts(self.scaled[first : first + 2])
        inverse = np.divide(1.0, pair._unit, out=np.zeros_like(pair._unit), where=pair._unit > 0)
        return pair, departures[..., first : first + 2, :] * inverse.astype(departures.dtype)

    def sizes(self, steps: Sequence[tuple[int, int]], departures: Array) -> tuple[Array, Array]:
        """Sizes and standard uncertainties (s,) of steps (after, place) together, in the units of the values."""
        sums = self.sums(self.pull(departures))
        evidence = np.array([sums[after - 1, place] for after, place in steps])
        matrix = np.array([[self._shared(a, b) for b in steps] for a in steps])
        covariance = np.linalg.pinv(matrix, DEPENDENT, hermitian=True)
        unit = self._unit[[place for _, place in steps]]
        return covariance @ evidence * unit, np.sqrt(np.diag(covariance)) * unit

    def _shared(self, one: tuple[int, int], other: tuple[int, int]) -> float:
        """Covariance of what speaks for two steps."""
        (a, i), (b, j) = one, other
        first, second, both = self.after[a - 1], self.after[b - 1], self.after[max(a, b) - 1]
        return float((both - first @ self._mean @ second)[i, j])


def _each(matrices: Array, vectors: Array) -> Array:
    """Vectors (…, n, p) times n matrices (n, p, p), one each."""
    flat = vectors.reshape(-1, *vectors.shape[-2:]).swapaxes(0, 1)
    return np.asarray((flat @ matrices).swapaxes(0, 1).reshape(vectors.shape))


@lru_cache(maxsize=2)
def _noise(count: int, size: int) -> AnyArray:
    """Standard normal numbers (`NULL_DRAWS`, n, p), the same for every tool."""
    rng = np.random.default_rng([SEED_OF_DRAWS, count, size])
    return rng.standard_normal((NULL_DRAWS, count, size), np.float32)


def stretches(history: History, draws: int) -> AnyArray:
    """By how much errors (draws, n, p) exceed those of a known noise: Student's t of each noise estimate.

    Calibrations of a triad whose noise was estimated together (`pooled`) have one factor.
    """
    freedom, pooled = history.freedom, history.pooled
    result = np.ones((draws, *freedom.shape), np.float32)
    rng = np.random.default_rng([SEED_OF_DRAWS, *freedom.shape])
    for triad in TRIADS:
        columns = [place for place, name in enumerate(history.names) if name.startswith(triad)]
        if not columns:
            continue
        degrees, together = freedom[:, columns[0]], pooled[:, columns[0]]
        groups = [np.flatnonzero(together), *np.flatnonzero(~together)[:, None]]
        for rows in (each for each in groups if each.size and np.isfinite(degrees[each[0]])):
            grown = np.sqrt(degrees[rows[0]] / rng.chisquare(degrees[rows[0]], draws))
            result[:, rows[:, None], columns] = grown[:, None, None]
    return result


def change_test(history: History, level: float = CHANGE_LEVEL) -> ChangeTest:
    """The test of one tool with two calibrations or more: `History` of (n, p).

    By `FIRST_DRAWS` where they show a tool to be unchanged, else by `NULL_DRAWS`. A tool is then called changed
    only where all draws call it so, and so with a probability of at most the level where nothing changed.
    """
    first = _test(history, level, FIRST_DRAWS)
    doubtful = first.probability <= level + DECIDED_BEYOND * np.sqrt(level / FIRST_DRAWS)
    rare = (first.pair_probability <= 1 / (FIRST_DRAWS + 1)).any()
    return _test(history, level, NULL_DRAWS) if doubtful or rare else first


def _test(history: History, level: float, draws: int) -> ChangeTest:
    """The test by so many draws."""
    contrasts, steady = Contrasts(history.precision), history.steady
    departures = contrasts.departures(history.values)
    noise = _noise(*history.values.shape)[:draws]
    null = contrasts.drawn(noise, stretches(history, draws))
    pull, null_pull = contrasts.pull(departures), contrasts.pull(null)
    scores = np.where(contrasts.known, contrasts.scores(pull), np.nan)
    largest = float(np.nanmax(np.abs(scores[:, steady]), initial=0.0))
    most = np.abs(contrasts.scores(null_pull)[..., steady]).reshape(draws, -1).max(-1, initial=0.0)
    misfit, misfits = float(contrasts.misfit(departures, pull)), contrasts.misfit(null, null_pull)
    (by_step, each_step), (by_misfit, each_misfit) = _ranks(most, largest), _ranks(misfits, misfit)
    evidence = np.minimum(each_step / STEP_SHARE, each_misfit / (1 - STEP_SHARE))
    least = min(by_step / STEP_SHARE, by_misfit / (1 - STEP_SHARE))
    critical = float(np.quantile(most, 1 - np.quantile(evidence, level) * STEP_SHARE))
    pairs = [
        _pair(*contrasts.pair(k, departures), contrasts.pair(k, null[:PAIR_DRAWS])[1])
        for k in range(len(scores))
    ]
    result = ChangeTest(
        level, float((1 + np.sum(evidence <= least)) / (draws + 1)), scores, largest, critical,
        by_step, misfit, contrasts.freedom, by_misfit,
        np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs]), np.array([p[2] for p in pairs]),
    )  # fmt: skip
    steps = _steps(contrasts, departures, steady, critical) if result.changed else ()
    return replace(result, steps=steps)


def _ranks(drawn: Array, value: float) -> tuple[float, Array]:
    """Probability of as much as a value among draws of no change, and of as much as each of them."""
    ascending = np.sort(drawn)
    above = len(drawn) - np.searchsorted(ascending, np.append(value, drawn), "left")
    return float((1 + above[0]) / (len(drawn) + 1)), above[1:] / len(drawn)


def _pair(pair: Contrasts, departures: Array, null: Array) -> tuple[float, int, float]:
    """Misfit of two successive calibrations, its degrees of freedom and probability."""
    misfit = float(pair.misfit(departures, pair.pull(departures)))
    drawn = pair.misfit(null, pair.pull(null))
    return misfit, pair.freedom, float((1 + np.sum(drawn >= misfit)) / (len(drawn) + 1))


def _steps(
    contrasts: Contrasts, departures: Array, steady: Ints, critical: float
) -> tuple[Step, ...]:
    """Steps that explain the change, the largest first, each with those before taken out."""
    named: list[tuple[int, int]] = []
    scored: list[float] = []
    unit = np.where(contrasts._unit > 0, contrasts._unit, 1.0)
    left = departures
    while len(named) < MOST_NAMED_STEPS:
        scores = np.where(contrasts.known, contrasts.scores(contrasts.pull(left)), 0.0)[:, steady]
        row, column = np.unravel_index(np.argmax(np.abs(scores)), scores.shape)
        if abs(scores[row, column]) <= critical:
            break
        named.append((int(row) + 1, int(steady[column])))
        scored.append(float(scores[row, column]))
        sizes, _ = contrasts.sizes(named, departures)
        left = departures.copy()
        for (after, place), size in zip(named, sizes, strict=True):
            left[after:, place] -= size / unit[place]
    if not named:
        return ()
    each = zip(named, *contrasts.sizes(named, departures), scored, strict=True)
    return tuple(
        Step(place, after, float(size), float(sd), score)
        for (after, place), size, sd, score in each
    )
