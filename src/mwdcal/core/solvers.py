"""Gauss-Newton with Levenberg-Marquardt damping, on the determined subspace, for a batch.

A problem linearises to residual rows per station, ρ + X δ, where X holds the columns of
all parameters and shared unknowns, and `own` the columns of the station's private unknowns
(attitude turns scaled to unit prior variance). Private unknowns are marginalised exactly:

    C⁻¹ = I - G (I + GᵀG)⁻¹ Gᵀ,     G = own columns

so a known angle (small σ), an unknown one (σ = π/√3) and everything between is one path.
Shared unknowns (field strength, dip, group directions) are eliminated by a Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol

import numpy as np

from mwdcal.core.vectors import Array, Bools, Ints, inverse

RANK_TOLERANCE = 2e-2
"""Singular values of the column-normalised design below this share of the largest are free."""


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
    """A problem at one state: ρ (B, n, m), X (B, n, m, u), own (B, n, m, 3), prior (B, u, u).

    The u unknowns of X are p = `size` model parameters, then s shared ones. `prior` is their
    precision matrix, `pull` (B, u) their departure from the prior value (zero where unknown).
    """

    residual: Array
    design: Array
    own: Array
    prior: Array
    pull: Array
    size: int

    @property
    def core(self) -> Array:
        """(I + GᵀG)⁻¹ (B, n, 3, 3)."""
        gram = np.swapaxes(self.own, -1, -2) @ self.own
        return np.asarray(inverse(np.eye(gram.shape[-1]) + gram))

    def weigh(self, columns: Array) -> Array:
        """C⁻¹ times columns (B, n, m, k)."""
        return np.asarray(
            columns - self.own @ (self.core @ (np.swapaxes(self.own, -1, -2) @ columns))
        )

    def private(self, step: Array) -> Array:
        """Private unknowns (B, n, 3), in their prior's units, after a step of X's unknowns."""
        moved = self.residual + np.einsum("...nmk,...k->...nm", self.design, step)
        pulled = np.swapaxes(self.own, -1, -2) @ moved[..., None]
        return np.asarray(-(self.core @ pulled)[..., 0])


@dataclass(frozen=True)
class Normal:
    """Normal equations of a `Linear`: information, gradient and cost."""

    information: Array
    gradient: Array
    cost: Array
    size: int

    @classmethod
    def of(cls, linear: Linear) -> Normal:
        """Sum over stations, priors included."""
        columns = np.concatenate([linear.design, linear.residual[..., None]], -1)
        weighed = linear.weigh(columns)
        whole = np.einsum("...nmi,...nmj->...ij", columns, weighed, optimize=True)
        information, gradient = whole[..., :-1, :-1].copy(), whole[..., :-1, -1].copy()
        pulled = (linear.prior @ linear.pull[..., None])[..., 0]
        information += linear.prior
        gradient += pulled
        cost = whole[..., -1, -1] + np.sum(linear.pull * pulled, -1)
        return cls(information, gradient, cost, linear.size)

    def reduced(self) -> tuple[Array, Array, Array]:
        """Information (B, p, p) and gradient (B, p) of the parameters, and the elimination.

        The elimination E (B, s, p) gives the shared step that goes with a parameter step:
        shared = -(H_ss⁻¹ g_s + E · step).
        """
        p = self.size
        own, cross = self.information[..., :p, :p], self.information[..., p:, :p]
        eliminate = inverse(self.information[..., p:, p:]) @ cross
        reduced = own - np.swapaxes(cross, -1, -2) @ eliminate
        offset = np.swapaxes(eliminate, -1, -2) @ self.gradient[..., p:, None]
        return reduced, self.gradient[..., :p] - offset[..., 0], eliminate

    def norms(self) -> Array:
        """Column norms (B, p) of the parameters, the scale in which rank is counted."""
        diagonal = np.diagonal(self.information, axis1=-2, axis2=-1)[..., : self.size]
        return np.sqrt(np.where(diagonal > 0, diagonal, 1.0))


@dataclass(frozen=True)
class Determined:
    """Which directions of parameter space the evidence determines.

    `basis` (B, p, p): orthonormal directions in normalised columns, largest singular value
    first; `values` (B, p): singular values as a share of the largest; `norms` (B, p): column
    norms; `keep` (B, p): which are determined.
    """

    basis: Array
    values: Array
    norms: Array
    keep: Bools

    @classmethod
    def by(cls, geometry: Normal, tolerance: float = RANK_TOLERANCE) -> Determined:
        """From the evidence's geometry: what is known, not how precisely."""
        norms = geometry.norms()
        reduced, _, _ = geometry.reduced()
        scaled = np.nan_to_num(reduced / (norms[..., :, None] * norms[..., None, :]))
        values, basis = np.linalg.eigh(scaled)
        values = np.sqrt(np.clip(values[..., ::-1], 0, None))
        values = values / np.maximum(values[..., :1], 1e-300)
        return cls(basis[..., ::-1], values, norms, values > tolerance)

    @property
    def rank(self) -> Ints:
        """Number of determined directions (B,)."""
        return np.asarray(np.sum(self.keep, -1))

    def inverse(self, information: Array, damping: Array | float = 0.0) -> Array:
        """Inverse (B, p, p) of an information matrix on the determined subspace."""
        scaled = information / (self.norms[..., :, None] * self.norms[..., None, :])
        kept = self.basis * self.keep[..., None, :]
        inner = np.swapaxes(kept, -1, -2) @ scaled @ kept
        diagonal = np.arange(inner.shape[-1])
        extra = np.asarray(damping)[..., None] * inner[..., diagonal, diagonal]
        inner[..., diagonal, diagonal] += np.where(self.keep, extra, 1.0)
        outer = kept @ inverse(inner) @ np.swapaxes(kept, -1, -2)
        return np.asarray(outer / (self.norms[..., :, None] * self.norms[..., None, :]))

    def null(self) -> Array:
        """Free directions (B, p, p) as columns in normalised units; determined ones are zero."""
        return np.asarray(self.basis * ~self.keep[..., None, :])


class Problem(Protocol):
    """What the solver asks of a problem; states are opaque to it."""

    def linear(self, state: Any, geometry: bool = False) -> Linear:
        """Linearise; `geometry` asks for what is known, leaving out how precisely."""

    def move(self, state: Any, linear: Linear, step: Array) -> Any:
        """The state after a step of X's unknowns, private unknowns re-adjusted."""

    def take(self, index: Ints) -> Problem:
        """The problem of some members of the batch."""

    def size_of(self, state: Any) -> Array:
        """Magnitude (B, p) below 1e-12 of which a parameter step is rounding."""


@dataclass
class _Descent:
    """Damped steps of one batch until every member has stopped."""

    problem: Problem
    state: Any
    damping: Array
    iterations: Ints

    def step(self, active: Ints) -> tuple[Bools, Bools]:
        """One iteration of the active members: which converged, which are not finite."""
        problem, state = self.problem.take(active), self.state.take(active)
        linear = problem.linear(state)
        normal = Normal.of(linear)
        finite = np.isfinite(normal.cost) & np.isfinite(normal.information).all((-1, -2))
        if not finite.all():
            return np.zeros_like(finite), ~finite
        determined = Determined.by(Normal.of(problem.linear(state, geometry=True)))
        step = _step(normal, determined, self.damping[active])
        trial = problem.move(state, linear, step)
        # the gradient holds the weights fixed, and so must the cost that judges the step
        cost = Normal.of(replace(problem.linear(trial), own=linear.own)).cost
        small = _small(normal, step, problem.size_of(state))
        with np.errstate(invalid="ignore"):
            better = (cost <= normal.cost * (1 + 1e-9) + 1e-9) | small
        self.state = self.state.put(active[better], trial.take(np.flatnonzero(better)))
        calmer = np.where(self.damping[active] < 1e-6, 0.0, self.damping[active] / 10)
        self.damping[active] = np.where(better, calmer, np.maximum(10 * self.damping[active], 1e-3))
        self.iterations[active] += 1
        return small & better, ~finite


def _step(normal: Normal, determined: Determined, damping: Array) -> Array:
    reduced, gradient, eliminate = normal.reduced()
    step = -(determined.inverse(reduced, damping) @ gradient[..., None])
    p = normal.size
    shared = inverse(normal.information[..., p:, p:]) @ normal.gradient[..., p:, None]
    return np.concatenate([step, -shared - eliminate @ step], -2)[..., 0]


def _small(normal: Normal, step: Array, size: Array) -> Bools:
    """Below a millionth of the standard uncertainty, or rounding."""
    length = np.einsum("...i,...ij,...j->...", step, normal.information, step)
    rounding = np.all(np.abs(step[..., : normal.size]) <= 1e-12 * size, -1)
    return np.asarray((length < 1e-12) | rounding)


def gauss_newton(problem: Problem, state: Any, limit: int = 60) -> tuple[Any, Ints, Ints]:
    """Minimise a batch of problems; returns states, `Status` codes and iteration counts."""
    count = len(state.params)
    descent = _Descent(problem, state, np.zeros(count), np.zeros(count, int))
    status = np.full(count, int(Status.NOT_CONVERGED))
    active = np.arange(count)
    for _ in range(limit):
        converged, broken = descent.step(active)
        status[active[converged]] = Status.OK
        status[active[broken]] = Status.NOT_FINITE
        active = active[~(converged | broken)]
        if not active.size:
            break
    return descent.state, status, descent.iterations
