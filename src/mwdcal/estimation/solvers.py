"""Least squares of a batch: Gauss-Newton on the determined subspace, and plain regression.

A problem linearises to residual rows per station, ρ + X δ, where X holds the columns of
all parameters and shared unknowns, and `private` the columns of the station's private unknowns
(attitude turns scaled to unit prior variance). Private unknowns are marginalised exactly:

    C⁻¹ = I - G (I + GᵀG)⁻¹ Gᵀ,     G = private columns

so a known angle (small σ), an unknown one (σ = π/√3) and everything between is one path.
Shared unknowns (field strength, dip, group directions) are eliminated by a Schur complement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache, cached_property
from typing import Any, Protocol

import numpy as np

from mwdcal.estimation.batch import put, take
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, eigen, eigenvalues, inverse, outer

# --------------------------------------------------------------------------
# Station weights that bound what one bad station can do, and what they cost with good ones.
#
# A station's misfit d² is χ² of k degrees of freedom when its readings and references are what
# their uncertainties say. Its covariance is then divided by w(d):
#
# huber       w = min(1, c/d), c² the 95 % point of χ²_k      an outlier keeps a bounded pull
# student-t   w = (ν + k) / (ν + d²), ν = 4                   an outlier loses its pull
#
# Both leave the estimate unbiased with good stations; `consistency` and `inflation` restore the
# scale of the noise and of the covariance.
#
# Reference: P. J. Huber, Robust Statistics, chapters 6 and 8; K. L. Lange, R. J. A. Little and
# J. M. G. Taylor, J. Am. Stat. Assoc. 84, 881 (1989).

LOSSES = ("huber", "student-t")
TAIL = 4.0
"""ν of Student's t: heavy enough tails for a stand angle misread by ten degrees."""
INLIERS = 0.95
"""Share of good stations that Huber's weight leaves alone."""
LEAST_WEIGHT = 1e-6
"""Smallest weight: a station this far off is as good as left out."""


def _corner(freedom: Array) -> Array:
    from scipy.special import chdtri

    return np.asarray(np.sqrt(chdtri(freedom, 1 - INLIERS)))


def weight(loss: str, square: Array, freedom: Array) -> Array:
    """Weight (...) of stations from their misfit d² and its degrees of freedom k, both (...).

    One where k is zero: nothing tests that station.
    """
    k = np.maximum(freedom, 1.0)
    if loss == "huber":
        corner = _corner(k)
        weights = corner / np.maximum(np.sqrt(square), corner)
    else:
        weights = (TAIL + k) / (TAIL + square)
    return np.where(freedom > 0, np.maximum(weights, LEAST_WEIGHT), 1.0)


def _slope(loss: str, square: Array, k: float) -> Array:
    """Derivative of the weight by ln d, at misfits d²."""
    if loss == "huber":
        distance = np.sqrt(square)
        corner = _corner(np.asarray(k))
        return np.where(distance > corner, -corner / np.maximum(distance, corner), 0.0)
    return -2 * square * (TAIL + k) / (TAIL + square) ** 2


@cache
def _moments(loss: str, k: float) -> tuple[float, float, float, float]:
    """E[w], E[w d²]/k, E[w² d²]/k and E[w + d w'/k], d² being χ²_k: by quantiles of d²."""
    from scipy.special import chdtri

    share = (np.arange(20_000) + 0.5) / 20_000
    square = np.asarray(chdtri(k, share), float)
    w = weight(loss, square, np.full_like(square, k))
    bend = _slope(loss, square, k)
    means = (w, w * square / k, w**2 * square / k, w + bend / k)
    first, second, third, fourth = (float(np.mean(value)) for value in means)
    return first, second, third, fourth


def consistency(loss: str, freedom: float) -> float:
    """Expected misfit w² d² per degree of freedom of good stations: below 1.

    The square of the bounded pull w d: one bad station cannot make it large (Huber's proposal 2).
    """
    return _moments(loss, freedom)[2]


def weighted(loss: str, freedom: float) -> float:
    """Expected misfit w d² per degree of freedom of good stations: below 1."""
    return _moments(loss, freedom)[1]


def inflation(loss: str, freedom: float) -> float:
    """Variance of an estimate over what its weighted information says, with good stations.

    For an M-estimator the variance is E[w² d²]/k / E[w + d w'/k]² of the unweighted one, and
    the weighted information is E[w] of the unweighted (Huber, 6.3).
    """
    mean, _, spread, bend = _moments(loss, freedom)
    return mean * spread / bend**2


RANK_TOLERANCE = 2e-2
"""Singular values of the column-normalised design below this share of the largest are free."""
NEGLIGIBLE = 1e-2
"""A member that is still on its way when iterations end has settled if a full step is a smaller
share of the standard uncertainty than this."""
SHORT_STEP = 1e-3
"""Standard uncertainties: a full step shorter than this is taken whatever it does to the cost, and is the last…"""
NEXT_STEP = 1e-8
"""…if the next, shorter by the same factor, would be shorter than this."""
CLEAR_MARGIN = 5.0
"""A direction is clearly determined with a singular value so many times `RANK_TOLERANCE`."""
SPANNED = 1e-6
"""Smallest eigenvalue of the normalised 4 × 4 information at which the vectors span space."""


class Status(IntEnum):
    """What became of one member of a batch; `message` says what to do about it."""

    OK = 0
    NOT_CONVERGED = 1
    NOT_FINITE = 2

    @property
    def message(self) -> str:
        """One sentence with the remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    Status.OK: "converged",
    Status.NOT_CONVERGED: "the fit did not settle: look for a wrong axis in the profile, a wrong "
    "reference cell, or a station that moved",
    Status.NOT_FINITE: "the fit ran into numbers that are not finite: the stations do not span "
    "enough attitudes for a start value; add stations at other inclinations and toolfaces",
}


@dataclass(frozen=True)
class Linear:
    """A problem at one state: ρ (B, n, m) and its columns X by u unknowns, private ones apart.

    X has the columns of each triad's parameters in `blocks`, (B, n, m_t, p_t) for the rows of that
    triad alone, then `shared` (B, n, m, s). `private` (B, n, m, a) are the private unknowns. `prior`
    (B, u, u) is the precision of X's unknowns, `pull` (B, u) their departure from the prior value
    (zero where unknown). `held` (B, n, a) are the values of private unknowns that a state holds, which ρ
    is without, and `loose` (B, n, a) says which ones it does not hold.
    """

    residual: Array
    blocks: tuple[Array, ...]
    shared: Array
    private: Array
    prior: Array
    pull: Array
    held: Array
    loose: Bools

    @property
    def size(self) -> int:
        """Number p of model parameters, at the head of X."""
        return sum(block.shape[-1] for block in self.blocks)

    def placed(self) -> Iterator[tuple[Array, slice, slice]]:
        """Each triad's block of X, with the rows and columns where it lies."""
        row = column = 0
        for block in self.blocks:
            below, right = row + block.shape[-2], column + block.shape[-1]
            yield block, slice(row, below), slice(column, right)
            row, column = below, right

    @cached_property
    def rows(self) -> Array:
        """X and ρ (B, n, m, u + 1) as one array."""
        whole = np.zeros((*self.residual.shape, self.size + self.shared.shape[-1] + 1))
        for block, rows, columns in self.placed():
            whole[..., rows, columns] = block
        whole[..., self.size : -1], whole[..., -1] = self.shared, self.residual
        return whole

    @cached_property
    def weighed(self) -> Array:
        """C⁻¹ times X and ρ (B, n, m, u + 1)."""
        return self.weigh(self.rows)

    @property
    def design(self) -> Array:
        """X (B, n, m, u)."""
        return self.rows[..., :-1]

    @property
    def norms(self) -> Array:
        """Column norms (B, p) of the parameters, prior in: the scale in which rank is counted."""
        squares = np.concatenate([np.sum(b**2, (-3, -2)) for b in self.blocks], -1)
        known = diagonal(self.prior)[..., : self.size]
        return np.asarray(np.sqrt(squares + known))

    @cached_property
    def normal(self) -> Normal:
        """Its normal equations: the sum over stations, priors included."""
        whole = self._by_triad if self.bare else self._together
        pulled = (self.prior @ self.pull[..., None])[..., 0]
        information = whole[..., :-1, :-1] + self.prior
        cost = whole[..., -1, -1] + np.sum(self.pull * pulled, -1)
        return Normal(information, whole[..., :-1, -1] + pulled, cost, self.size)

    @property
    def _together(self) -> Array:
        """(X ρ)ᵀ C⁻¹ (X ρ) (B, u + 1, u + 1)."""
        flat = (*self.rows.shape[:-3], -1, self.rows.shape[-1])
        return np.asarray(self.rows.reshape(flat).mT @ self.weighed.reshape(flat))

    @property
    def _by_triad(self) -> Array:
        """The same where C is the identity: the sum over triads, each with the unknowns that its rows have."""
        count, end = len(self.residual), self.size + self.shared.shape[-1]
        whole = np.zeros((count, end + 1, end + 1))
        for block, rows, columns in self.placed():
            shared = self.shared[..., rows, :]
            used = np.flatnonzero(shared.any((0, 1, 2)))
            part = [block, shared[..., used], self.residual[..., rows, None]]
            each = np.concatenate(part, -1).reshape(count, -1, block.shape[-1] + used.size + 1)
            at = np.concatenate([np.arange(columns.start, columns.stop), self.size + used, [end]])
            whole[:, at[:, None], at] += each.mT @ each
        return whole

    @cached_property
    def determined(self) -> Determined:
        """Which directions it determines, if it is of the geometry."""
        return Determined.by(self.normal.reduced[0], self.norms)

    def cost(self, at: Linear) -> Array:
        """ρᵀC⁻¹ρ over all stations, and the priors' part (B,), of residuals `at` a state; C is ours.

        Unknowns that a state holds have their values there; C is of the others.
        """
        residual, pulled = (
            at.residual,
            np.einsum("...i,...ij,...j->...", at.pull, at.prior, at.pull),
        )
        weighed = self.weigh(residual[..., None])
        if not self.loose.all():
            residual = residual + (at.private @ at.held[..., None])[..., 0]
            loose = replace(self, private=self.private * self.loose[..., None, :])
            weighed = loose.weigh(residual[..., None])
            pulled = pulled + np.sum(at.held**2, (-1, -2))
        return np.asarray(np.sum(residual * weighed[..., 0], (-1, -2)) + pulled)

    @cached_property
    def core(self) -> Array:
        """(I + GᵀG)⁻¹ (B, n, a, a)."""
        gram = self.private.mT @ self.private
        return np.asarray(inverse(np.eye(gram.shape[-1]) + gram))

    @cached_property
    def bare(self) -> bool:
        """Whether no station has an unknown to itself: C is the identity."""
        return not self.private.any()

    def weigh(self, columns: Array) -> Array:
        """C⁻¹ times columns (B, n, m, k)."""
        return columns if self.bare else self.weight @ columns

    @cached_property
    def weight(self) -> Array:
        """C⁻¹ (B, n, m, m)."""
        whole = np.eye(self.residual.shape[-1]) - self.private @ (self.core @ self.private.mT)
        return np.asarray(whole)

    def private_step(self, step: Array) -> Array:
        """Private unknowns (B, n, a), in their prior's units, after a step of X's unknowns."""
        moved = self.residual + np.einsum("bnms,bs->bnm", self.shared, step[:, self.size :])
        for block, rows, columns in self.placed():
            moved[..., rows] += np.einsum("bnmp,bp->bnm", block, step[:, columns])
        pulled = self.private.mT @ moved[..., None]
        return np.asarray(-(self.core @ pulled)[..., 0])


@dataclass(frozen=True)
class Normal:
    """Normal equations of a `Linear`: information, gradient and cost."""

    information: Array
    gradient: Array
    cost: Array
    size: int

    @cached_property
    def among_shared(self) -> Array:
        """H_ss⁻¹ (B, s, s): inverse of the information of the shared unknowns."""
        return inverse(self.information[..., self.size :, self.size :])

    @cached_property
    def reduced(self) -> tuple[Array, Array, Array]:
        """Information (B, p, p) and gradient (B, p) of the parameters, and the elimination.

        The elimination E (B, s, p) gives the shared step that goes with a parameter step:
        shared = -(H_ss⁻¹ g_s + E · step).
        """
        p = self.size
        block, cross = self.information[..., :p, :p], self.information[..., p:, :p]
        eliminate = self.among_shared @ cross
        reduced = block - cross.mT @ eliminate
        offset = eliminate.mT @ self.gradient[..., p:, None]
        return reduced, self.gradient[..., :p] - offset[..., 0], eliminate


@dataclass(frozen=True)
class Determined:
    """Which directions of parameter space the evidence determines.

    `basis` (B, p, p): orthonormal directions in normalised columns, largest singular value
    first; `values` (B, p): singular values as a share of the largest; `norms` (B, p): norms of
    the whole columns, private unknowns in; `keep` (B, p): which are determined. Where all are,
    `basis` may be any orthonormal one: no direction of it is of interest then.
    """

    basis: Array
    values: Array
    norms: Array
    keep: Bools

    @classmethod
    def by(cls, information: Array, norms: Array) -> Determined:
        """From the information (B, p, p) of the evidence's geometry: what is known, not how precisely.

        `norms` (B, p) are those of the whole columns. The rest of a column when private
        unknowns are taken out may be noise alone: its own norm would make much of that.
        """
        norms = np.where(norms > 0, norms, 1.0)
        values, basis = eigen(np.nan_to_num(information / outer(norms)))
        values = np.sqrt(np.clip(values[..., ::-1], 0, None))
        values = values / np.maximum(values[..., :1], 1e-300)
        return cls(basis[..., ::-1], values, norms, values > RANK_TOLERANCE)

    @classmethod
    def of(cls, problem: Linearisable, state: Any) -> Determined:
        """Of a problem at a state."""
        return problem.linear(state, geometry=True).determined

    @property
    def clear(self) -> Bools:
        """Members (B,) of which every direction is determined, and no step of a fit changes that."""
        return np.asarray((self.values > CLEAR_MARGIN * RANK_TOLERANCE).all(-1))

    @property
    def rank(self) -> Ints:
        """Number of determined directions (B,)."""
        return np.asarray(np.sum(self.keep, -1))

    def inverse(self, information: Array, damping: Array | float = 0.0) -> Array:
        """Inverse (B, p, p) of an information matrix on the determined subspace."""
        scales = outer(self.norms)
        kept = self.basis * self.keep[..., None, :]
        inner = kept.mT @ (information / scales) @ kept
        extra = np.asarray(damping)[..., None] * diagonal(inner)
        np.einsum("...ii->...i", inner)[...] += np.where(self.keep, extra, 1.0)
        return np.asarray(kept @ inverse(inner) @ kept.mT / scales)

    def null(self) -> Array:
        """Free directions (B, p, p) as columns in normalised units; determined ones are zero."""
        return np.asarray(self.basis * ~self.keep[..., None, :])


class Linearisable(Protocol):
    """Interface of a problem to the solver; of states it asks the parameters."""

    def linear(self, state: Any, geometry: bool = False) -> Linear:
        """Linearise; `geometry` asks for what is known, leaving out how precisely."""

    def move(self, state: Any, linear: Linear, step: Array) -> Any:
        """The state after a step of X's unknowns, private unknowns re-adjusted."""


@dataclass
class _Descent:
    """Damped steps of one batch until every member has stopped.

    All are of the members still `active`; `linear` is taken at `state`, or None where nobody has asked for it yet;
    `length` is that of the last full step in standard uncertainties, zero before there is one.
    """

    problem: Linearisable
    state: Any
    linear: Linear | None
    determined: Determined
    damping: Array
    active: Ints
    length: Array

    def step(self) -> tuple[Bools, Bools]:
        """One iteration: which active members are at a minimum, and which are not finite."""
        problem, linear = self.problem, self.here()
        normal = linear.normal
        finite = np.isfinite(normal.cost) & np.isfinite(normal.information).all((-1, -2))
        if not finite.all():
            return np.zeros_like(finite), ~finite
        step = _step(normal, self.determined, self.damping)
        trial = problem.move(self.state, linear, step)
        length = np.sqrt(_length(normal, step))
        small = _small(linear, step, self.state.params, length) | self._last(length)
        self.length = np.where(self.damping > 0, 0.0, length)
        if small.all():  # taken whatever it does to the cost
            self.state, self.linear, self.damping = trial, None, self._calmer()
            return small, ~finite
        after = problem.linear(trial)
        # the gradient holds the weights fixed, and so must the cost that judges the step
        before = normal.cost if linear.loose.all() else linear.cost(linear)
        cost = linear.cost(after)
        with np.errstate(invalid="ignore"):
            better = (cost <= before * (1 + 1e-9) + 1e-9) | small
        self._accept(trial, after, better)
        self.damping = np.where(better, self._calmer(), np.maximum(10 * self.damping, 1e-3))
        return small & better, ~finite

    def here(self) -> Linear:
        """The problem linearised at the state."""
        self.linear = self.linear or self.problem.linear(self.state)
        return self.linear

    def _last(self, length: Array) -> Bools:
        """Which full steps are so much shorter than those before that the next would be nothing."""
        return np.asarray(
            (self.damping == 0) & (length < SHORT_STEP) & (length**2 < NEXT_STEP * self.length)
        )

    def _calmer(self) -> Array:
        """Damping after a step that is taken."""
        return np.where(self.damping < 1e-6, 0.0, self.damping / 10)

    def arrived(self) -> Bools:
        """Which active members no full step would move by more than a `NEGLIGIBLE` share of σ.

        Rounding of the cost can refuse such steps for ever, and flat directions make them shrink
        slowly: both are at their minimum for all purposes.
        """
        normal = self.here().normal
        step = _step(normal, self.determined)
        return self.settled(np.asarray(_length(normal, step) < NEGLIGIBLE**2))

    def _accept(self, trial: Any, after: Linear, better: Bools) -> None:
        if better.all():
            self.state, self.linear = trial, after
            return
        which = np.flatnonzero(better)
        self.state = put(self.state, which, take(trial, which))
        self.linear = put(self.linear, which, take(after, which))

    def settled(self, converged: Bools) -> Bools:
        """Which converged members still have the rank that their steps were taken with.

        The others go on, with the directions that are determined where they are now.
        """
        doubtful = converged & ~self.determined.clear
        if not doubtful.any():
            return converged
        which = np.flatnonzero(doubtful)
        here = self.problem, self.state
        now = Determined.of(*(here if doubtful.all() else take(here, which)))
        same = now.rank == self.determined.rank[which]
        if not same.all():
            self.determined = put(self.determined, which, now)
        settled = converged.copy()
        settled[which] = same
        return settled


def _step(normal: Normal, determined: Determined, damping: Array | float = 0.0) -> Array:
    reduced, gradient, eliminate = normal.reduced
    step = -(determined.inverse(reduced, damping) @ gradient[..., None])
    shared = normal.among_shared @ normal.gradient[..., normal.size :, None]
    return np.concatenate([step, -shared - eliminate @ step], -2)[..., 0]


def _length(normal: Normal, step: Array) -> Array:
    """Square (B,) of a step's length in standard uncertainties."""
    return np.asarray(np.einsum("...i,...ij,...j->...", step, normal.information, step))


def _small(linear: Linear, step: Array, params: Array, length: Array) -> Bools:
    """Of a `length` (B,) below a millionth, or within rounding of each triad's largest parameter."""
    size, moved = (
        np.stack([np.abs(x[:, columns]).max(-1) for _, _, columns in linear.placed()])
        for x in (params, step)
    )
    return np.asarray((length < 1e-6) | np.all(moved <= 1e-12 * size, 0))


def stepped(problem: Linearisable, state: Any, determined: Determined) -> Any:
    """The state after one full step, whatever it does to the cost."""
    linear = problem.linear(state)
    return problem.move(state, linear, _step(linear.normal, determined))


def gauss_newton(problem: Linearisable, state: Any, limit: int = 60) -> tuple[Any, Ints, Ints]:
    """Minimise a batch of problems; returns states, `Status` codes and iteration counts."""
    count = len(state.params)
    status = np.full(count, int(Status.NOT_CONVERGED))
    iterations = np.zeros(count, int)
    determined, linear = Determined.of(problem, state), problem.linear(state)
    zero = np.zeros(count)
    descent = _Descent(problem, state, linear, determined, zero, np.arange(count), zero)
    for _ in range(limit):
        if not descent.active.size:
            break
        converged, broken = descent.step()
        iterations[descent.active[~broken]] += 1
        settled = descent.settled(converged)
        status[descent.active[settled]] = Status.OK
        status[descent.active[broken]] = Status.NOT_FINITE
        stopped = settled | broken
        if len(stopped) == count and stopped.all():
            return descent.state, status, iterations
        if stopped.any():
            done, rest = np.flatnonzero(stopped), np.flatnonzero(~stopped)
            state = put(state, descent.active[done], take(descent.state, done))
            descent = take(descent, rest)
    if descent.active.size:
        status[descent.active[descent.arrived()]] = Status.OK
    return put(state, descent.active, descent.state), status, iterations


@dataclass(frozen=True)
class Regression:
    """Weighted least squares of readings on vectors, axis by axis.

    `forward` (..., 4, 3): the transposed S in the first rows, o in the last; `terms` (..., n, 4): what
    they multiply, the vector and one. `cofactor` (..., 3, 4, 4) is the inverse information of each
    axis; `spanned` (...) says where the vectors determine it.
    """

    forward: Array
    terms: Array
    cofactor: Array
    spanned: Bools


def regress(raw: Array, vectors: Array, weight: Array) -> Regression:
    """S and o with the least weighted squared error in the readings (Moradi 12).

    Shapes: raw, vectors (..., n, 3); weight (..., n, 3), or (..., n, 1) for all axes alike.
    Singular: vectors that do not span space about their mean (fewer than four stations, or all in
    a plane) leave `spanned` false; numbers are then NaN or mean nothing.
    """
    terms = np.concatenate([vectors, np.ones_like(vectors[..., :1])], -1)
    size = np.sqrt(np.einsum("...na,...ni->...ai", weight, terms**2))
    size = np.where(size > 0, size, 1.0)
    scaled = terms[..., None, :, :] / size[..., None, :]
    weighed = scaled * weight.mT[..., None]
    information = weighed.mT @ scaled
    sums = scaled.mT @ (weight * raw)[..., None, :, :]
    cofactor = inverse(information)
    by_axis = cofactor @ sums / size[..., None]
    by_axis = np.broadcast_to(by_axis, (*by_axis.shape[:-3], 3, 4, 3))
    forward = np.diagonal(by_axis, axis1=-3, axis2=-1).copy()
    cofactor = cofactor / (size[..., :, None] * size[..., None, :])
    spanned = np.all(eigenvalues(information)[..., 0] > SPANNED, -1)
    cofactor = np.broadcast_to(cofactor, (*cofactor.shape[:-3], 3, 4, 4))
    return Regression(forward, terms, cofactor, spanned)
