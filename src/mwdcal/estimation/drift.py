"""Slow drift within a run: a random walk of the field, or of a triad's offsets, over the order of stations.

A walk W about its mean over the run is a sum of cosines, √2 cos(πkt) with independent coefficients of
variance (s/πk)² (Karhunen-Loève), t being the place in the run, 0…1, and s the standard deviation of
W(1) - W(0). The mean itself lies s/√3 from where the walk began, or ended. Each coefficient is a
constant of the run with its variance as the prior; s² is estimated by restricted maximum likelihood.

Reference: K. Karhunen, Ann. Acad. Sci. Fenn. A 37 (1947); R. B. Schall, Biometrika 78, 719 (1991).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.evidence import WALKS, Evidence, SharedConstant
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import Analysis, whole_covariance
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, inverse

MOST_TERMS = 8
"""Cosines of a walk: they hold 93 % of its variance; the rest looks like noise."""
STATIONS_PER_TERM = 4
"""Fewest stations for each cosine."""
LEAST_WALK = 1e-3
"""A walk over the run is at least this share of the noise of a reading: a smaller one is none."""
FEWEST_USED = 2.0
"""Fewest degrees of freedom that are counted to the estimate of a walk's variance."""
VARIANCE_ROUNDS = 25
"""Repetitions of the estimate of variances."""


def terms_of(count: int) -> tuple[Array, Array]:
    """Values (n, K + 1) of the mean and the cosines at n stations, and their variances (K + 1,) for s = 1.

    >>> values, variance = terms_of(48)
    >>> values.shape, round(float(variance[1:].sum() * 6), 2)
    ((48, 9), 0.93)
    """
    order = np.arange(min(MOST_TERMS, count // STATIONS_PER_TERM) + 1)
    place = (np.arange(count) + 0.5) / max(count, 1)
    cosines = np.sqrt(2.0) * np.cos(np.pi * order * place[:, None])
    cosines[:, 0] = 1.0
    return cosines, np.concatenate([[1 / 3], 1 / (np.pi * order[1:]) ** 2])


def families(problem: Problem) -> list[str]:
    """The walks that a run may show: of the offsets of each triad, and of the field."""
    return [*WALKS][: 1 if len(problem.triads) == 1 else len(WALKS)]


def acting(walks: Iterable[str]) -> dict[str, int]:
    """The number of the triad that each walk acts on."""
    return {name: min([*WALKS].index(name), 1) for name in walks}


def with_walks(problem: Problem, state: State, sizes: dict[str, Array]) -> tuple[Problem, State]:
    """The problem with walks of some sizes s (B,), g or nT, as constants of the run, and the state for it."""
    evidence, count = problem.evidence, problem.evidence.include.shape[-1]
    values, variance = terms_of(count)
    batch = len(evidence.include)
    zero, new = np.zeros(batch), list(evidence.constants)
    for name, size in sizes.items():
        for axis in WALKS[name]:
            for value, share in zip(values.swapaxes(0, 1), variance, strict=True):
                mask = np.broadcast_to(value, (batch, count))
                sd = size * np.sqrt(share)
                new.append(SharedConstant(axis, mask, zero, sd, unknown=False))
    more = np.zeros((batch, len(new) - len(evidence.constants)))
    walking = replace(problem, evidence=replace(evidence, constants=tuple(new)))
    return walking, replace(state, constants=np.concatenate([state.constants, more], -1))


def places(evidence: Evidence) -> dict[str, Ints]:
    """Places of the constants that each walk of the evidence consists of, mean first for each axis."""
    names = [constant.name for constant in evidence.constants]
    each = {
        walk: np.array([i for i, name in enumerate(names) if name in axes], int)
        for walk, axes in WALKS.items()
    }
    return {walk: index for walk, index in each.items() if index.size}


def cosines(index: Ints, problem: Problem) -> Bools:
    """Which of the constants of a walk are cosines: the others are means over the run."""
    return np.arange(index.size) % terms_of(problem.evidence.include.shape[-1])[1].size > 0


def sizes(problem: Problem) -> dict[str, Array]:
    """Standard deviation s (B,) of each walk over the run, g or nT."""
    first = {name: index[0] for name, index in places(problem.evidence).items()}
    return {n: problem.evidence.constants[i].sd * np.sqrt(3.0) for n, i in first.items()}


def noise(problem: Problem) -> dict[str, Array]:
    """Noise (B,) of a reading of the triad that each walk acts on."""
    each = [np.sqrt(np.mean(triad.sd**2, (1, 2))) for triad in problem.triads]
    return dict(zip(WALKS, [*each, *each[1:]], strict=False))


@dataclass(frozen=True)
class WalkScores:
    """What the residuals of a fit without walks say of their cosines, in units of the noise.

    `score` (B, k) and its covariance `information` (B, k, k), for walks of s = 1 noise of a reading; `places`
    of the columns of each walk.
    """

    score: Array
    information: Array
    places: dict[str, Ints]

    def of(self, walks: Sequence[str]) -> WalkScores:
        """Those of some walks."""
        index = np.concatenate([self.places[name] for name in walks])
        ends = np.cumsum([len(self.places[name]) for name in walks])
        each = np.split(np.arange(index.size), ends[:-1])
        information = self.information[:, index[:, None], index]
        places = dict(zip(walks, each, strict=True))
        return WalkScores(self.score[:, index], information, places)

    def of_walk(self, name: str) -> tuple[Array, Array, Array]:
        """Q = sᵀs of a walk, and what noise alone gives: its mean tr G and tr G², with G the covariance of s."""
        index = self.places[name]
        each = self.information[:, index[:, None], index]
        return (
            np.sum(self.score[:, index] ** 2, -1),
            np.asarray(np.einsum("bii->b", each)),
            np.sum(each**2, (-1, -2)),
        )


def walk_scores(problem: Problem, state: State, analysis: Analysis) -> WalkScores:
    """Scores of the walks of a run that has none in its fit: what the fit's unknowns cannot take up.

    The problem may be of one member for the residuals (B, n, m) of many.
    """
    columns = _cosine_columns(problem, state)
    linear = problem.linear(state)
    whole = whole_covariance(linear, analysis.determined)
    weighed = linear.weigh(columns)
    rows = (len(columns), -1, columns.shape[-1])
    crossed = linear.design.reshape(len(columns), -1, whole.shape[-1]).mT @ weighed.reshape(rows)
    information = columns.reshape(rows).mT @ weighed.reshape(rows)
    information = information - crossed.mT @ whole @ crossed
    count = columns.shape[-1] // len(families(problem))
    every = np.arange(columns.shape[-1]).reshape(-1, count)
    residual = analysis.residual
    score = (columns.reshape(rows).mT @ residual.reshape(len(residual), -1, 1))[..., 0]
    return WalkScores(
        score,
        information,
        dict(zip(families(problem), every, strict=True)),
    )


def _cosine_columns(problem: Problem, state: State) -> Array:
    """Whitened columns (B, n, m, k) of the cosines of all walks, of size s = 1 noise of a reading."""
    sized = {name: size for name, size in noise(problem).items() if name in families(problem)}
    walking, at = with_walks(problem, state, sized)
    sd = np.stack([c.sd for c in walking.evidence.constants], -1)
    kept = [
        i for index in places(walking.evidence).values() for i in index[cosines(index, problem)]
    ]
    return np.asarray(walking.walk_columns(at)[..., kept] * sd[:, None, None, kept])


def walk_variances(
    scores: WalkScores, variance: Array, freedom: Array, declared: Bools
) -> tuple[Array, Array]:
    """Variances (B, w) of the walks in units of the noise, and of the noise (B, t): REML.

    `variance` (B, t) is s² of the fit without walks, of so many degrees of `freedom`; that of the noise
    stays 1 where it is `declared`.
    Definition: for the coefficients u of a walk, V their covariance given the readings: θ = Σu² / Σ(1 - V/θ);
    of the noise, misfit less what the walks explain over its degrees of freedom (Henderson).
    """
    count = len(scores.places)
    owner = np.array([*acting(scores.places).values()])
    width = scores.score.shape[-1] // count
    misfit = variance * freedom
    left = np.where(declared, 1.0, variance)
    first = [scores.of_walk(name) for name in scores.places]
    theta = np.stack([np.maximum(q - m, 0.1 * m) / s for q, m, s in first], -1)
    for _ in range(VARIANCE_ROUNDS):
        ratio = np.repeat(left[:, owner] / theta, width, -1)
        whole = scores.information + ratio[..., None] * np.eye(ratio.shape[-1])
        whole = inverse(whole)
        value = (whole @ scores.score[..., None])[..., 0]
        used = (1 - diagonal(whole) * ratio).reshape(-1, count, width).sum(-1)
        square = (value**2).reshape(-1, count, width).sum(-1)
        theta = np.maximum(square / np.maximum(used, 1e-9), LEAST_WALK**2)
        explained = (value * scores.score).reshape(-1, count, width).sum(-1)
        by_triad = np.stack([explained[:, owner == t].sum(-1) for t in range(misfit.shape[-1])], -1)
        left = np.where(declared, 1.0, np.maximum((misfit - by_triad) / freedom, 1e-3 * variance))
    return theta * _widened(used), left


def _widened(freedom: Array) -> Array:
    """What makes a normal 95 % interval as wide as Student's t for a variance of so many degrees of freedom."""
    from scipy.special import stdtrit

    return np.asarray((stdtrit(np.maximum(freedom, FEWEST_USED), 0.975) / 1.959964) ** 2)


def walk(problem: Problem, state: State, name: str) -> tuple[Array, Array]:
    """A fitted walk about its mean (B, n, 3), g or nT, and the cosines (n, K) that it is a sum of.

    Its axes are those of a triad, or north, east, down.
    """
    terms = terms_of(problem.evidence.include.shape[-1])[0][:, 1:]
    value = state.constants[:, _of_cosines(problem, name)].reshape(len(state.constants), 3, -1)
    return np.einsum("bak,nk->bna", value, terms), terms


def walk_covariance(problem: Problem, analysis: Analysis, name: str) -> Array:
    """Covariance (B, 3K, 3K) of the coefficients of a fitted walk, axis by axis."""
    index = _of_cosines(problem, name)
    return np.asarray(analysis.constants[:, index[:, None], index])


def _of_cosines(problem: Problem, name: str) -> Ints:
    index = places(problem.evidence)[name]
    return np.asarray(index[cosines(index, problem)])
