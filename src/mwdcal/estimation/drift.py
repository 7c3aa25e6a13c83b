"""Slow drift within a run, of the field or of a triad's offsets, over the order of stations: trend and random walk.

A walk W about its mean over the run is a sum of cosines, √2 cos(πkt) with independent coefficients of
variance (s/πk)² (Karhunen-Loève), t being the place in the run, 0…1, and s the standard deviation of
W(1) - W(0). The mean itself lies s/√3 from where the walk began, or ended. A trend r(t - ½) is a drift
of its own, of standard deviation r, whose mean lies r/2 from where it began: a walk alone would take it for a
smaller one, since it has no power beyond its first cosine. Each coefficient is a constant of the run with its
variance as the prior; s² and r² are estimated by restricted maximum likelihood.

Reference: K. Karhunen, Ann. Acad. Sci. Fenn. A 37 (1947); R. B. Schall, Biometrika 78, 719 (1991).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from mwdcal.estimation.minimisers import closed_form_drift, stand_factors, uncertain_stand
from mwdcal.estimation.problem import WALK_AXES, WALKS, Evidence, Problem, SharedConstant, State
from mwdcal.estimation.uncertainty import Analysis, fisher_tail, whole_covariance
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    diagonal,
    eigen,
    finite,
    inverse,
    inverse_of_positive,
    outer,
    quotient,
)

MOST_TERMS = 8
"""Cosines of a walk: they hold 93 % of its variance; the rest looks like noise."""
STATIONS_PER_TERM = 4
"""Fewest stations for each cosine."""
LEAST_TREND = 0.2
"""A trend does not show where residuals keep less than this share of its information."""
LEAST_KEPT = 1e-6
"""Share of the information about a trend that is more than rounding."""
LEAST_WALK = 1e-3
"""A walk over the run is at least this share of the noise of a reading: a smaller one does not count."""
HELD_TREND = 1e-5
"""A trend that is not fitted beside a walk, as a share of the noise of a reading."""
FEWEST_USED = 2.0
"""Fewest degrees of freedom that are counted to the estimate of a walk's variance."""
ROUNDING = 1e-13
"""Differences of matrices, as a share of the largest element, that are rounding."""
STUDENT_DEGREE, SECANTS = 20, 12
"""Degree of the polynomial for Student's t, and steps to its nodes: more change nothing but rounding."""
VARIANCE_ROUNDS = 25
"""Repetitions of the estimate of variances: they end before its maximum, which may be zero and then covers less."""


def terms_of(count: int) -> tuple[Array, Array]:
    """Values (n, K + 2) of mean, trend and cosines at n stations; variances (2, K + 2) for r = 1 and for s = 1.

    >>> values, (trend, walk) = terms_of(48)
    >>> values.shape, round(float(walk[2:].sum() * 6), 2)
    ((48, 10), 0.93)
    """
    order = np.arange(1, min(MOST_TERMS, count // STATIONS_PER_TERM) + 1)
    place = (np.arange(count) + 0.5) / max(count, 1)
    cosines = np.sqrt(2.0) * np.cos(np.pi * order * place[:, None])
    values = np.column_stack([np.ones(count), place - 0.5, cosines])
    trend = np.concatenate([[1 / 4, 1], np.zeros(order.size)])
    return values, np.stack([trend, np.concatenate([[1 / 3, 0], 1 / (np.pi * order) ** 2])])


def families(problem: Problem) -> list[str]:
    """The walks that a run may show: of the offsets of each triad, and of the field."""
    return [*WALKS][: 1 if len(problem.triads) == 1 else len(WALKS)]


def acting(walks: Iterable[str]) -> dict[str, int]:
    """The number of the triad that each walk acts on."""
    return {name: min([*WALKS].index(name), 1) for name in walks}


def walk_constants(sizes: Mapping[str, Array], count: int) -> tuple[SharedConstant, ...]:
    """Drifts over `count` stations as constants of the run.

    `sizes` (B, 2) of each: r of its trend and s of its walk, g or nT.
    """
    values, variance = terms_of(count)
    return tuple(
        SharedConstant(axis, np.broadcast_to(value, (len(sd), count)), 0 * sd, sd, unknown=False)
        for name, size in sizes.items()
        for axis in WALKS[name]
        for value, sd in zip(values.mT, np.sqrt(size**2 @ variance).mT, strict=True)
    )


def with_walks(problem: Problem, state: State, sizes: dict[str, Array]) -> tuple[Problem, State]:
    """The problem with drifts as further constants of the run, and the state for it."""
    evidence = problem.evidence
    new = walk_constants(sizes, evidence.include.shape[-1])
    more = np.zeros((len(evidence.include), len(new)))
    walking = replace(problem, evidence=replace(evidence, constants=(*evidence.constants, *new)))
    return walking, replace(state, constants=np.concatenate([state.constants, more], -1))


def without_walks(problem: Problem, state: State) -> tuple[Problem, State]:
    """The problem as if the run were steady, and the state for it."""
    evidence, walks = problem.evidence, problem.walks
    left = tuple(c for index, c in enumerate(evidence.constants) if index not in walks)
    constants = np.delete(state.constants, walks, -1)
    steady = replace(problem, evidence=replace(evidence, constants=left))
    return steady, replace(state, constants=constants)


def places(evidence: Evidence) -> dict[str, Ints]:
    """Places (3, K + 2) of the constants that each drift of the evidence consists of: those of `terms_of` by axis."""
    names = [constant.name for constant in evidence.constants]
    each = {
        walk: np.array([i for i, name in enumerate(names) if name in axes], int)
        for walk, axes in WALKS.items()
    }
    return {walk: index.reshape(3, -1) for walk, index in each.items() if index.size}


def held_trends(problem: Problem) -> dict[str, Bools]:
    """Members (B,) whose drift is fitted without its trend, by the drift."""
    evidence, least = problem.evidence, noise(problem)
    return {
        name: evidence.constants[index[0, 1]].sd < LEAST_WALK / 10 * least[name]
        for name, index in places(evidence).items()
    }


def noise(problem: Problem) -> dict[str, Array]:
    """Noise (B,) of a reading of the triad that each walk acts on."""
    each = [np.sqrt(np.mean(triad.sd**2, (1, 2))) for triad in problem.triads]
    return dict(zip(WALKS, [*each, *each[1:]], strict=False))


@dataclass(frozen=True)
class WalkScores:
    """Evidence for drift terms in the residuals of a fit without them, in units of the noise.

    `score` (B, k) and its covariance `information` (B, k, k), for drifts of r = s = 1 noise of a reading, and `alone`
    (B, k, k), what that would be with all unknowns of the fit known, if asked for; `places` of the columns of each
    drift, its three trends first.
    """

    score: Array
    information: Array
    alone: Callable[[], Array]
    places: dict[str, Ints]

    def of(self, walks: Sequence[str]) -> WalkScores:
        """Those of some drifts."""
        index = np.concatenate([self.places[name] for name in walks])
        ends = np.cumsum([len(self.places[name]) for name in walks])
        each = np.split(np.arange(index.size), ends[:-1])
        some = np.ix_(np.arange(len(self.information)), index, index)
        places = dict(zip(walks, each, strict=True))
        information = self.information[some]
        return WalkScores(self.score[:, index], information, lambda: self.alone()[some], places)

    @property
    def apart(self) -> bool:
        """Whether there are walks of both triads, and readings of one say nothing of the walks of the other."""
        triads = acting(self.places)
        first, second = (
            [c for n, t in triads.items() if t == triad for c in self.places[n].tolist()]
            for triad in (0, 1)
        )
        return bool(first and second) and not self.information[:, first][..., second].any()

    def shown(self, name: str) -> Array:
        """Share (B,) of the information about a trend that residuals keep, of the axis along which it is least.

        Definition: the least eigenvalue of the information about the three trends relative to that `alone`. The rest
        of a trend looks like the parameters and references of the fit.
        """
        index = self.places[name][:3]
        left, alone = (m[:, index[:, None], index] for m in (self.information, self.alone()))
        return np.asarray(np.linalg.eigvals(finite(inverse(alone) @ left)).real.min(-1))

    def trend(self, name: str) -> Array:
        """χ² (B,) of the three trends of a drift, of three degrees of freedom, where `shown` is above `LEAST_KEPT`.

        However little of a trend residuals keep, which in the sum of squares of all terms would drown.
        """
        index = self.places[name][:3]
        information, score = self.information[:, index[:, None], index], self.score[:, index]
        step = finite(inverse(information)) @ score[..., None]
        return np.asarray(np.sum(score * step[..., 0], -1))

    def components(self) -> dict[tuple[str, int], Ints]:
        """Columns of the trend (0) and of the walk (1) of each drift."""
        parts = {(n, i): p for n, c in self.places.items() for i, p in enumerate((c[:3], c[3:]))}
        return {key: columns for key, columns in parts.items() if columns.size}

    def square(self, index: Ints) -> tuple[Array, Array, Array]:
        """Q = sᵀs of some columns, and what noise alone gives: its mean tr G and tr G², with G the covariance of s."""
        each = self.information[:, index[:, None], index]
        return (
            np.sum(self.score[:, index] ** 2, -1),
            np.asarray(np.einsum("bii->b", each)),
            np.sum(each**2, (-1, -2)),
        )


def walk_scores(
    problem: Problem, state: State, analysis: Analysis, walks: Sequence[str] | None = None
) -> WalkScores:
    """Scores of the walks of a run that has none in its fit: what the fit's unknowns cannot take up.

    `walks`: some of them; all if None.
    """
    walking, at, sd, each = _walking(problem, state, families(problem) if walks is None else walks)
    old, residual, scale = len(problem.evidence.constants), analysis.residual, outer(sd)
    if not old and closed_form_drift.applies(walking):
        return _common_scores(walking, at, sd, each, residual)
    if not old and analysis.squares is not None and uncertain_stand.applies(problem):
        return _on_stand(problem, state, each, sd)
    if analysis.determined.clear.all() and stand_factors.applies(problem):
        return _by_axis(problem, state, each, sd)
    linear, base = problem.linear(state), _axes(problem, state, [*each])
    whole = whole_covariance(linear, analysis.determined)
    terms = terms_of(base.shape[1])[0][:, 1:]
    weighed, count = linear.weigh(base), len(base)
    score = _by_term((base.mT @ residual[..., None])[..., 0], terms) * sd
    crossed = _by_term(linear.design.mT @ weighed, terms) * sd[:, None]
    pairs = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
    alone = (base.mT @ weighed).reshape(count, len(terms), -1).mT @ pairs
    alone = alone.reshape(count, *2 * (len(each), 3), *2 * terms.shape[1:])
    alone = alone.transpose(0, 1, 5, 2, 3, 6, 4).reshape(scale.shape) * scale
    return WalkScores(score, alone - crossed.mT @ whole @ crossed, lambda: alone, each)


def _on_stand(problem: Problem, state: State, places: dict[str, Ints], sd: Array) -> WalkScores:
    """The same on a stand of known angles, where the terms of an axis are together."""
    courses = terms_of(problem.evidence.include.shape[-1])[0].mT[1:]
    walks = uncertain_stand.stand_walks(problem, state, courses)
    score, left, alone = walks.among([[*WALKS].index(name) for name in places])
    by_axis = {name: c.reshape(3, -1).mT.ravel() for name, c in places.items()}
    sizes = np.empty(sd.shape)
    for name, c in places.items():
        sizes[:, by_axis[name]] = sd[:, c]
    scale = outer(sizes)
    return WalkScores(score * sizes, left * scale, lambda: alone * scale, by_axis)


def _by_axis(problem: Problem, state: State, places: dict[str, Ints], sd: Array) -> WalkScores:
    """The same of factors on a stand of known angles."""
    at, scale = stand_factors.linear(problem, state), outer(sd)
    axes = [WALK_AXES[axis] for name in places for axis in WALKS[name]]
    terms = terms_of(problem.evidence.include.shape[-1])[0][:, 1:]
    score, crossed, alone = at.walk_sums(axes, terms)
    score = -score.reshape(len(sd), -1, 3, terms.shape[-1]).swapaxes(2, 3).reshape(sd.shape) * sd
    crossed = crossed.reshape(*crossed.shape[:2], -1, 3, terms.shape[-1]).swapaxes(3, 4)
    crossed = crossed.reshape(len(sd), -1, sd.shape[-1]) * sd[:, None]
    alone = alone.reshape(len(sd), *2 * (len(places), 3), *2 * terms.shape[1:])
    alone = alone.transpose(0, 1, 5, 2, 3, 6, 4).reshape(scale.shape) * scale
    left = alone - crossed.mT @ at.covariance @ crossed
    return WalkScores(score, left, lambda: alone, places)


def common_scores(problem: Problem, state: State, residual: Array) -> WalkScores:
    """The scores of all walks of runs at the same exact references, of residuals (B, n, m).

    The problem may be of one member for the residuals of many.
    """
    return _common_scores(*_walking(problem, state, families(problem)), residual)


def _common_scores(
    walking: Problem, at: State, sd: Array, places: dict[str, Ints], residual: Array
) -> WalkScores:
    score, scale = closed_form_drift.scores(walking, at, residual) * sd, outer(sd)
    information = partial(closed_form_drift.information, walking, at)
    return WalkScores(score, information() * scale, lambda: information(alone=True) * scale, places)


def _axes(problem: Problem, state: State, walks: Sequence[str]) -> Array:
    """Columns (B, n, m, a) of what a unit of each axis of some drifts does at every station."""
    evidence = problem.evidence
    zero, mask = np.zeros(len(evidence.include)), np.ones(evidence.include.shape)
    axes = (
        SharedConstant(axis, mask, zero, zero + 1, unknown=False)
        for name in walks
        for axis in WALKS[name]
    )
    lone = replace(problem, evidence=replace(evidence, constants=tuple(axes)))
    lone.memo.update(problem.memo)
    return lone.walk_columns(state)


def _by_term(values: Array, terms: Array) -> Array:
    """Sums (B, ..., k) over the stations of values (B, n, ..., a) by axis of drifts, times each term (n, K)."""
    flat = values.reshape(*values.shape[:2], -1)
    sums = (flat.mT @ terms).reshape(len(values), *values.shape[2:-1], -1, 3, terms.shape[-1])
    return np.asarray(sums.swapaxes(-1, -2).reshape(*sums.shape[:-3], -1))


def _walking(
    problem: Problem, state: State, walks: Sequence[str]
) -> tuple[Problem, State, Array, dict[str, Ints]]:
    """The problem with those of some drifts that are not in its fit, r = s = 1 noise of a reading.

    They are without their means. And the state for it, the standard deviations (B, k) of their terms, and the places
    of those of each drift.
    """
    present, old = places(problem.evidence), problem.evidence.constants
    sizes = {
        name: np.stack([size, size], -1)
        for name, size in noise(problem).items()
        if name in walks and name not in present
    }
    walking, at = with_walks(problem, state, sizes)
    kept: list[SharedConstant] = []
    columns = {}
    for name in sizes:
        chosen = places(walking.evidence)[name][:, 1:].mT.ravel()
        columns[name] = len(kept) + np.arange(chosen.size)
        kept += [walking.evidence.constants[i] for i in chosen]
    walking = replace(walking, evidence=replace(walking.evidence, constants=(*old, *kept)))
    at = replace(at, constants=at.constants[:, : len(old) + len(kept)])
    return walking, at, np.stack([constant.sd for constant in kept], -1), columns


@dataclass(frozen=True)
class _Ridge:
    """Scores and information of walks in a basis in which those of one component, `some`, are independent.

    `values` (B, m) are the eigenvalues of its information, `cross` (B, k - m, m) and `rest` (B, k - m, k - m) those
    with and among the `others`.
    """

    score: Array
    values: Array
    cross: Array
    rest: Array
    some: Ints
    others: Ints

    @classmethod
    def of(cls, scores: WalkScores, some: Ints) -> _Ridge:
        """In the basis for a component of scores."""
        others = np.setdiff1d(np.arange(scores.score.shape[-1]), some)
        values, basis = _eigen_alike(scores.information[:, some[:, None], some])
        score = scores.score.copy()
        score[:, some] = (basis.mT @ scores.score[:, some, None])[..., 0]
        cross = scores.information[:, others[:, None], some] @ basis
        rest = np.ascontiguousarray(scores.information[:, others[:, None], others])
        return cls(score, values, cross, rest, some, others)

    def at(self, ratio: Array) -> tuple[Array, Array]:
        """Coefficients (B, k) and their variances, with a `ratio` (B, k) of each component added to the information."""
        variance, value = np.empty(self.score.shape), np.empty(self.score.shape)
        lone = 1 / (self.values + ratio[:, self.some])
        scaled = self.cross * lone[:, None]
        rest = self.rest - scaled @ self.cross.mT
        np.einsum("bii->bi", rest)[...] += ratio[:, self.others]
        whole = inverse_of_positive(rest)
        pull = self.score[:, self.others, None] - scaled @ self.score[:, self.some, None]
        shared = whole @ pull
        value[:, self.others] = shared[..., 0]
        value[:, self.some] = lone * self.score[:, self.some] - (scaled.mT @ shared)[..., 0]
        variance[:, self.others] = diagonal(whole)
        variance[:, self.some] = lone + np.einsum("bij,bij->bj", scaled, whole @ scaled)
        return value, variance


def _eigen_alike(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues and vectors of matrices (B, m, m), worked out once where these are alike but for rounding.

    So is the information on a drift of the readings themselves, in units of their noise, of runs at equal references.
    """
    if np.abs(matrix - matrix[:1]).max(initial=0.0) > ROUNDING * np.abs(matrix).max(initial=0.0):
        return eigen(matrix)
    values, basis = eigen(matrix[:1])
    return np.broadcast_to(values, matrix.shape[:2]), np.broadcast_to(basis, matrix.shape)


def walk_variances(
    scores: WalkScores,
    variance: Array,
    freedom: Array,
    declared: Bools,
    least: Array,
    held: Bools,
) -> tuple[Array, Array]:
    """Variances (B, c) of the components of the drifts in units of the noise, and of the noise (B, t): REML.

    `variance` (B, t) is s² of the fit without walks, of so many degrees of `freedom`; that of the noise
    stays 1 where it is `declared`. None of a drift is below its `least` (B, c); where `held` (c,) it is that.
    Definition: for the coefficients u of a walk, V their covariance given the readings: θ = Σu² / Σ(1 - V/θ);
    of the noise, misfit less what the walks explain over its degrees of freedom (Henderson).
    """
    of_walk, parts = acting(scores.places), scores.components()
    triad = np.array([of_walk[name] for name, _ in parts])
    if scores.apart:
        (lower, quiet), (upper, left) = (
            walk_variances(
                scores.of([n for n, t in of_walk.items() if t == one]),
                variance, freedom, declared, least[:, triad == one], held[triad == one],
            )
            for one in (0, 1)
        )  # fmt: skip
        left[:, 0] = quiet[:, 0]
        return np.concatenate([lower, upper], -1), left
    owner = np.zeros(scores.score.shape[-1], int)
    for number, columns in enumerate(parts.values()):
        owner[columns] = number
    of = (owner == np.arange(len(parts))[:, None]).astype(float).mT
    misfit = variance * freedom
    left = np.where(declared, 1.0, variance)
    first = [scores.square(columns) for columns in parts.values()]
    floor = np.maximum(least, np.where(held, HELD_TREND, LEAST_WALK) ** 2)
    theta = np.stack([np.maximum(q - m, 0.1 * m) / s for q, m, s in first], -1)
    theta = np.where(held, floor, theta)
    ridge = _Ridge.of(scores, max(parts.values(), key=len))
    for _ in range(VARIANCE_ROUNDS):
        ratio = (left[:, triad] / theta)[:, owner]
        value, known = ridge.at(ratio)
        used = (1 - known * ratio) @ of
        theta = np.maximum(np.where(held, 0.0, value**2 @ of / np.maximum(used, 1e-9)), floor)
        explained = (value * ridge.score) @ of
        by_triad = np.stack([explained[:, triad == t].sum(-1) for t in range(misfit.shape[-1])], -1)
        left = np.where(declared, 1.0, np.maximum((misfit - by_triad) / freedom, 1e-3 * variance))
    wider = theta * np.where([part == 0 for _, part in parts], 1.0, _widened(used))
    return np.where(theta > least, wider, theta), left


def _widened(freedom: Array) -> Array:
    """What makes a normal 95 % interval as wide as Student's t for a variance of so many degrees of freedom."""
    return np.asarray(student_squares()(1 / np.maximum(freedom, FEWEST_USED)) / 1.959964**2)


@cache
def student_squares() -> np.polynomial.Chebyshev:
    """Square of Student's t of two-sided 95 %, by one over its degrees of freedom from `FEWEST_USED` on, to 1e-13.

    SciPy's function takes as long to load as five hundred tools to fit. Secants of ln of the chance, by Fisher's F.
    """

    def squares(inverse: Array) -> Array:
        before, now = np.full((2, *inverse.shape), [[3.8], [4.2]])
        left = np.log(fisher_tail(np.ones(inverse.shape), 1 / inverse, before) / 0.05)
        for _ in range(SECANTS):
            here = np.log(fisher_tail(np.ones(inverse.shape), 1 / inverse, now) / 0.05)
            step = quotient(here * (now - before), here - left, here != left)
            before, left, now = now, here, now - step
        return np.asarray(now)

    return np.polynomial.Chebyshev.interpolate(squares, STUDENT_DEGREE, domain=[0, 1 / FEWEST_USED])


def trend_effect(problem: Problem, state: State, analysis: Analysis, name: str) -> Array:
    """The effect on the parameters (B, p, k) of a trend of r = 1, g or nT, that is not in the fit: 1σ of each term."""
    batch, old = len(state.params), len(problem.evidence.constants)
    walking, at = with_walks(problem, state, {name: np.tile([1.0, 0.0], (batch, 1))})
    sd = np.stack([constant.sd for constant in walking.evidence.constants[old:]], -1)
    linear = problem.linear(state)
    columns = linear.weigh(walking.walk_columns(at)[..., old:] * sd[:, None, None])
    crossed = linear.design.reshape(batch, -1, linear.prior.shape[-1]).mT @ columns.reshape(
        batch, -1, sd.shape[-1]
    )
    return np.asarray(-whole_covariance(linear, analysis.determined)[:, : linear.size] @ crossed)


def walk(problem: Problem, state: State, name: str) -> tuple[Array, Array]:
    """A fitted drift about its mean (B, n, 3), g or nT, and the terms (n, K + 1) that it is a sum of.

    Its axes are those of a triad, or north, east, down.
    """
    terms = terms_of(problem.evidence.include.shape[-1])[0][:, 1:]
    value = state.constants[:, places(problem.evidence)[name][:, 1:]]
    return np.einsum("bak,nk->bna", value, terms), terms


def walk_covariance(problem: Problem, analysis: Analysis, name: str) -> Array:
    """Covariance (B, 3(K + 1), 3(K + 1)) of the coefficients of a fitted drift, axis by axis."""
    index = places(problem.evidence)[name][:, 1:].ravel()
    return np.asarray(analysis.constants[:, index[:, None], index])
