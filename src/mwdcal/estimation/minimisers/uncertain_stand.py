"""Runs on a stand whose angles are known at every station, each with an error: weights, noise and fit at once.

A station says raw = S f(I + e) + o + noise, with errors e of its angles that a standard uncertainty bounds. Given e
that is the closed form of exact references, and e is three unknowns of the station's own:

    W = 1 - P Pᵀ,     P = G L⁻ᵀ,  L Lᵀ = 1 + Gᵀ G,  G = S df/de σ_e / σ

so that a step of the twelve elements of each Φ = [S o] takes a solution of 24 equations for a tool, and products of
three columns for a station. Terms of a drift are further unknowns. It comes to the minimum that the general way comes
to, and is tested against it. Arrays are (component, B, n) while a step is taken, and (B, component, n) between steps.

Reference: D. A. Harville, J. Am. Stat. Assoc. 72, 320 (1977), of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.evidence import WALKS
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.closed_form import AffineMinimum
from mwdcal.estimation.minimisers.stand_columns import (
    OF_PARAMETERS,
    TRIAD_ROWS,
    StandColumns,
    summed,
)
from mwdcal.estimation.minimisers.stand_linear import MOST_AT_ONCE, StandLinear, StandRuns
from mwdcal.estimation.problem import WALK_AXES, Problem, State
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import Analysis, effects_of, variance_factors
from mwdcal.geometry.vectors import Array, Bools, Ints, inverse, quotient
from mwdcal.sensor.models import Polynomial, affine_parts

MOST_STAND_STEPS = 12
"""Most steps of a fit: a member that has not settled then goes the general way."""
STEPS_ALIKE = 4
"""First steps that are taken by one covariance; those of members that have not settled have their own."""
LEAST_SQUARE = 1e-10
"""Square of the last step, in standard uncertainties."""
LEAST_NOISE_CHANGE = 1e-5
"""Largest last change of the noise, as a share."""
LEAST_SECANT = 1e-9
"""Smaller changes of the noise tell nothing of its slope."""
LEAST_OF_SIGNAL = 1e-6
"""Noise below this share of the readings' size is left to the general way."""


def applies(problem: Problem) -> bool:
    """Whether all angles are known, and nothing but their own errors, the sensors' and drifts are to be found."""
    evidence = problem.evidence
    return (
        len(problem.triads) == 2
        and all(isinstance(t.model, Polynomial) for t in problem.triads)
        and not any(t.model.varies for t in problem.triads)
        and not (evidence.absent or evidence.scatter)
        and not evidence.set_together.any()
        and bool(evidence.referenced.all())
        and not problem.prior.precision.any()
        and _are_drifts(problem)
    )


def _are_drifts(problem: Problem) -> bool:
    """Whether all constants are terms of drifts, those of each axis the same, at all tools."""
    constants = problem.evidence.constants
    names = [constant.name for constant in constants]
    terms = names.count(names[0]) if names else 1
    masks = [constants[place % terms].mask[:1] for place in range(len(names))]
    return (
        all(name in WALK_AXES for name in names)
        and names == [name for name in dict.fromkeys(names) for _ in range(terms)]
        and all(
            np.array_equal(constant.mask, np.broadcast_to(mask, constant.mask.shape))
            for constant, mask in zip(constants, masks, strict=True)
        )
    )


@dataclass(frozen=True)
class Solution:
    """Where the fits have come to: state, the noise over that of the problem (B, t), the minima, and steps.

    `good` (B,): the members that have settled with all directions clearly determined.
    """

    state: State
    scale: Array
    determined: Determined
    steps: Ints
    good: Bools


def solution(problem: Problem) -> Solution:
    """The fits, from those at exact references; noise that is not declared is estimated on the way."""
    at = closed_form.start(problem)
    minima = closed_form.minima(problem, at)
    first = [each for each in minima if isinstance(each, AffineMinimum)]
    good = closed_form.determined(minima).clear & np.all([each.settled for each in first], 0)
    forward = np.stack([each.forward for each in first], 1)
    estimated = np.array([not triad.declared for triad in problem.triads])
    stand, scale = StandRuns.of(problem), _first_noise(problem, first)
    start = _Turn(stand, forward, at.errors.mT, at.constants, scale, 0 * scale, 0 * scale)
    there, steps, settled = _settled(start, estimated, good)
    state, determined = _ended(problem, there, first, at)
    good &= settled & np.isfinite(state.params).all(-1) & np.isfinite(there.scale).all(-1)
    good &= np.all((there.scale * stand.noise_share > LEAST_OF_SIGNAL) | ~estimated, -1)
    return Solution(state, there.scale, determined, steps, good)


def refined(problem: Problem, state: State) -> Solution:
    """The fits from a state nearby, the noise being what the problem has."""
    at = closed_form.start(problem)
    first = [m for m in closed_form.minima(problem, at) if isinstance(m, AffineMinimum)]
    stand, forward = StandRuns.of(problem), _forward(problem, state)
    one, zero = np.ones((len(forward), 2)), np.zeros((len(forward), 2))
    start = _Turn(stand, forward, state.errors.mT, state.constants, one, zero, zero)
    sound = np.asarray(np.isfinite(state.params).all(-1))
    there, steps, good = _settled(start, np.zeros(2, bool), sound)
    state, determined = _ended(problem, there, first, at)
    good &= determined.clear & np.isfinite(state.params).all(-1)
    return Solution(state, one, determined, steps, good)


@dataclass(frozen=True)
class StandWalks:
    """What the fits of runs without drift leave of all walks, of unit terms: those of a walk axis by axis.

    `score` (B, q) of the terms, XᵀWD (B, 24, q) with the parameters, `crossed`, and what these take up, `taken`.
    """

    weight: Array
    columns: StandColumns
    score: Array
    crossed: Array
    taken: Array

    @classmethod
    def of(cls, problem: Problem, state: State, courses: Array) -> StandWalks:
        """At the fits of a problem, for some `courses` (K, n)."""
        here = linear(problem, state)
        axes = here.columns.axes_of(range(len(WALKS)), _forward(problem, state), here.attitude)
        columns = replace(here.columns, axes=axes, courses=courses)
        score = -columns.pull(here.weighed(here.left))[:, OF_PARAMETERS:]
        crossed = columns.crossed(here.weight)
        return cls(here.weight, columns, score, crossed, here.covariance @ crossed)

    def among(self, walks: Sequence[int]) -> tuple[Array, Array, Array]:
        """Scores (B, q) of some walks by their numbers, their covariance, and what that is with all else known."""
        axes = np.array([3 * walk + axis for walk in walks for axis in range(3)])
        terms = len(self.columns.courses)
        places = (axes[:, None] * terms + np.arange(terms)).ravel()
        alone = replace(self.columns, axes=self.columns.axes[:, axes]).of_axes(self.weight)
        left = alone - self.crossed[:, :, places].mT @ self.taken[:, :, places]
        return self.score[:, places], left, alone


def stand_walks(problem: Problem, state: State, courses: Array) -> StandWalks:
    """What fits leave of all walks; the last answer is kept."""
    return problem.once("stand walks", state, lambda _: StandWalks.of(problem, state, courses))


def linear(problem: Problem, state: State) -> StandLinear:
    """The problem linearised at a state; the last answer is kept."""
    return problem.once("on stand", state, lambda _: _linear(problem, state))


def _linear(problem: Problem, state: State) -> StandLinear:
    scale = np.ones((len(state.params), len(problem.triads)))
    forward = _forward(problem, state)
    return StandRuns.of(problem).at(forward, state.errors.mT, state.constants, scale)


def _forward(problem: Problem, state: State) -> Array:
    """Φ (B, 2, 3, 4) of a state."""
    forward = np.empty((len(state.params), 2, 3, 4))
    for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        assert isinstance(triad.model, Polynomial)
        slope, field = affine_parts(state.params[:, where])
        gain = inverse(slope / triad.model.scale)
        forward[:, index, :, :3] = gain
        forward[:, index, :, 3] = triad.model.centre[:, 0] - (gain @ field[..., None])[..., 0]
    return forward


def moved_params(problem: Problem, forward: Array) -> Array:
    """Change (B, 24, 24) of the parameters by the elements of Φ (B, 2, 3, 4)."""
    moved = np.zeros((len(forward), OF_PARAMETERS, OF_PARAMETERS))
    for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        back, turn = closed_form.centred_parts(triad, forward[:, index])
        each = -back[:, :, None, :, None] * turn.mT[:, None, :, None, :]
        moved[:, where, where] = each.reshape(-1, 12, 12)[:, closed_form.PLACES]
    return moved


def analysed(problem: Problem, state: State, determined: Determined) -> Analysis:
    """The analysis of fits with all directions determined, as `analyse` has it, with what the stand does."""
    at, include, p = linear(problem, state), problem.evidence.include, OF_PARAMETERS
    moved = moved_params(problem, _forward(problem, state))
    whole = at.covariance.copy()
    whole[:, :p] = moved @ whole[:, :p]
    whole[:, :, :p] = whole[:, :, :p] @ moved.mT
    spread, residual = at.spread * include, at.weighed(at.left)
    pairs = [(at.weight[rows, rows], spread[rows, rows]) for rows in TRIAD_ROWS]
    lone = [summed(w, 2 * left - w * include) for w, left in pairs]
    spread, residual = (
        np.ascontiguousarray(np.moveaxis(each, (-2, -1), (0, 1))) for each in (spread, residual)
    )
    return Analysis(
        whole[:, :p, :p],
        determined,
        *variance_factors(residual, spread),
        residual,
        spread,
        whole[:, p:, p:],
        effects_of(problem, whole[:, :p, p:]),
        np.zeros((len(whole), p, 0)),
        squares=np.stack(lone, -1) + at.shared_squares,
        of_stand=moved @ at.of_angles @ moved.mT,
    )


def _settled(start: _Turn, estimated: Bools, sound: Bools) -> tuple[_Turn, Ints, Bools]:
    """Where fits end, after how many steps (B,), and which of the `sound` ones have settled (B,)."""
    forward, errors, value, scale = (
        getattr(start, n).copy() for n in ("forward", "errors", "value", "scale")
    )
    active, now = np.arange(len(sound)), start
    steps, good = np.full(len(sound), MOST_STAND_STEPS), sound.copy()
    for count in range(1, MOST_STAND_STEPS + 1):
        now, moving = now.next(estimated, anew=count > STEPS_ALIKE)
        forward[active], errors[active], scale[active] = now.forward, now.errors, now.scale
        value[active] = now.value
        steps[active[~moving]] = count
        moving &= good[active]
        active = active[moving]
        if not active.size:
            break
        now = now if moving.all() else take(now, np.flatnonzero(moving))
    good[active] = False
    return replace(start, forward=forward, errors=errors, value=value, scale=scale), steps, good


def _ended(
    problem: Problem, there: _Turn, minima: Sequence[AffineMinimum], at: State
) -> tuple[State, Determined]:
    """The state of the problem where fits have come to, and which directions are determined."""
    each: closed_form.Minima = []
    for index, (minimum, triad) in enumerate(zip(minima, problem.triads, strict=True)):
        back, turn = closed_form.centred_parts(triad, there.forward[:, index])
        each.append(replace(minimum, forward=there.forward[:, index], back=back, turn=turn))
    params = np.concatenate([minimum.params for minimum in each], -1)
    state = replace(at, params=params, errors=there.errors.mT, constants=there.value)
    return state, closed_form.determined(each)


def _first_noise(problem: Problem, minima: Sequence[AffineMinimum]) -> Array:
    """The noise at exact references over that of the problem (B, t); one where it is declared."""
    each = [
        np.sqrt(np.sum(m.left**2, (1, 2)) / np.maximum(np.sum(m.open, (1, 2)), 1.0)) for m in minima
    ]
    declared = [triad.declared for triad in problem.triads]
    return np.where(declared, 1.0, np.stack(each, -1))


@dataclass(frozen=True)
class _Turn:
    """Where fits have come to: Φ (B, 2, 3, 4), errors (B, 3, n), drifts (B, q), the noise over the problem's (B, t).

    `covariance` (B, u, u) is that of the unknowns, by which steps are taken. `excess` (B, t) is the logarithm of s as
    it was, `change` that of the noise since: their secant says the next one.
    """

    stand: StandRuns
    forward: Array
    errors: Array
    value: Array
    scale: Array
    excess: Array
    change: Array
    covariance: Array | None = None

    def next(self, estimated: Bools, anew: bool) -> tuple[_Turn, Bools]:
        """A step of the fit, and of the noise where it is estimated (t,); and which members (B,) have not settled.

        While the noise stays, so does the covariance unless it is asked for `anew`: it says how far to go, not where to
        end.
        """
        here = self.stand.at(self.forward, self.errors, self.value, self.scale)
        covariance = self.covariance
        if covariance is None or anew or estimated.any():
            covariance = here.covariance
        step, errors, length = here.step(covariance)
        moved = step[:, :OF_PARAMETERS].reshape(self.forward.shape)
        value, moving = self.value + step[:, OF_PARAMETERS:], length >= LEAST_SQUARE
        now = replace(
            self, forward=self.forward + moved, errors=errors, value=value, covariance=covariance
        )
        if not estimated.any():
            return now, moving
        excess, power = here.excess(step, self.stand.include)
        slope = quotient(self.excess - excess, self.change, np.abs(self.change) > LEAST_SECANT)
        slope = np.where(slope > 0, np.clip(slope, 1 / MOST_AT_ONCE, 2.0), 1 / power)
        change = np.where(estimated, excess / slope, 0.0)
        moving |= np.any(np.abs(change) >= LEAST_NOISE_CHANGE, -1)
        return replace(now, scale=self.scale * np.exp(change), excess=excess, change=change), moving
