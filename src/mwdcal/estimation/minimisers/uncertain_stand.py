"""Runs on a stand whose angles are known at every station, each with an error: weights, noise and fit at once.

A station says raw = S f(I + e) + o + noise, with errors e of its angles that a standard uncertainty bounds. Given e
that is the closed form of exact references, and e is three unknowns of the station's own:

    W = 1 - P Pᵀ,     P = G L⁻ᵀ,  L Lᵀ = 1 + Gᵀ G,  G = S df/de σ_e / σ

so that a step of the twelve elements of each Φ = [S o] takes a solution of 24 equations for a tool, and products of
three columns for a station. It comes to the minimum that the general way comes to, and is tested against it. Arrays
are (B, component, n), the stations last.

Reference: D. A. Harville, J. Am. Stat. Assoc. 72, 320 (1977), of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.closed_form import AffineMinimum
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.solvers import Determined
from mwdcal.geometry.vectors import Array, Bools, Ints, inverse, quotient, solved
from mwdcal.sensor.models import Polynomial

MOST_STAND_STEPS = 12
"""Most steps of a fit: a member that has not settled then goes the general way."""
LEAST_SQUARE = 1e-12
"""Square of the last step, in standard uncertainties."""
LEAST_NOISE_CHANGE = 1e-5
"""Largest last change of the noise, as a share."""
MOST_AT_ONCE = 3.0
"""Largest power of s that the noise takes at once."""
LEAST_SECANT = 1e-9
"""Smaller changes of the noise tell nothing of its slope."""
LEAST_OF_SIGNAL = 1e-6
"""Noise below this share of the readings' size is left to the general way."""
ERROR_SIGNS = np.array([1.0, -1.0, -1.0])[:, None]
"""How inclination, azimuth and toolface follow the errors of a state."""


def applies(problem: Problem) -> bool:
    """Whether all angles are known, and nothing but their own errors and the sensors' is to be found."""
    evidence = problem.evidence
    return (
        len(problem.triads) == 2
        and all(isinstance(t.model, Polynomial) for t in problem.triads)
        and not any(t.model.varies for t in problem.triads)
        and not (evidence.constants or evidence.absent or evidence.scatter)
        and not evidence.set_together.any()
        and bool(evidence.referenced.all())
        and not problem.prior.precision.any()
    )


@dataclass(frozen=True)
class Solution:
    """Where the fits have come to: state, the noise over that of the problem (B, t), what is determined, and steps.

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
    errors, scale = np.zeros(problem.evidence.turn_sd.mT.shape), _first_noise(problem, first)
    estimated = np.array([not triad.declared for triad in problem.triads])
    stand = _Stand.of(problem)
    active, now = np.arange(len(good)), _Turn(stand, forward, errors, scale, 0 * scale, 0 * scale)
    steps = np.full(len(good), MOST_STAND_STEPS)
    for count in range(1, MOST_STAND_STEPS + 1):
        now, moving = now.next(estimated)
        forward[active], errors[active], scale[active] = now.forward, now.errors, now.scale
        steps[active[~moving]] = count
        moving &= good[active]
        active = active[moving]
        if not active.size:
            break
        now = now if moving.all() else take(now, np.flatnonzero(moving))
    good[active] = False
    there: closed_form.Minima = []
    for index, (each, triad) in enumerate(zip(first, problem.triads, strict=True)):
        back, turn = closed_form.centred_parts(triad, forward[:, index])
        there.append(replace(each, forward=forward[:, index], back=back, turn=turn))
    params = np.concatenate([each.params for each in there], -1)
    state = replace(at, params=params, errors=errors.mT)
    good &= np.isfinite(params).all(-1) & np.isfinite(scale).all(-1)
    good &= np.all((scale * stand.noise_share > LEAST_OF_SIGNAL) | ~estimated, -1)
    return Solution(state, scale, closed_form.determined(there), steps, good)


def _first_noise(problem: Problem, minima: Sequence[AffineMinimum]) -> Array:
    """The noise at exact references over that of the problem (B, t); one where it is declared."""
    each = [
        np.sqrt(np.sum(m.left**2, (1, 2)) / np.maximum(np.sum(m.open, (1, 2)), 1.0)) for m in minima
    ]
    declared = [triad.declared for triad in problem.triads]
    return np.where(declared, 1.0, np.stack(each, -1))


@dataclass(frozen=True)
class _Stand:
    """Constants of the iteration: angles and σ (B, 3, n), strengths (B, n), readings and noise (B, 6, n)."""

    angles: Array
    angle_sd: Array
    gravity: Array
    north: Array
    down: Array
    raw: Array
    sd: Array
    include: Array

    @classmethod
    def of(cls, problem: Problem) -> _Stand:
        """Of a problem."""
        evidence = problem.evidence
        known = evidence.known
        angles = np.stack([known[n] for n in ("inclination", "azimuth", "toolface")], 1)
        field, dip = known["field"], known["dip"]
        raw, sd = (
            np.concatenate([getattr(t, n).mT for t in problem.triads], 1) for n in ("raw", "sd")
        )
        north, down = field * np.cos(dip), field * np.sin(dip)
        turn_sd = evidence.turn_sd.mT
        return cls(angles, turn_sd, known["gravity"], north, down, raw, sd, evidence.include)

    @property
    def noise_share(self) -> Array:
        """The problem's noise as a share of the readings' size (B, t)."""
        size, sd = (
            np.sqrt(np.mean(each.reshape(len(each), 2, -1) ** 2, -1))
            for each in (self.raw - self.raw.mean(-1, keepdims=True), self.sd)
        )
        return np.asarray(sd / np.where(size > 0, size, 1.0))

    def vectors(self, errors: Array) -> tuple[Array, Array]:
        """f̃ (B, 2, 4, n) of both triads, and the change of f by one σ of each angle (B, 2, 3, 3, n)."""
        angle = self.angles + ERROR_SIGNS * errors
        (ci, ca, ct), (si, sa, st) = (np.moveaxis(of(angle), 1, 0) for of in (np.cos, np.sin))
        batch, stations = ci.shape
        f = np.ones((batch, 2, 4, stations))
        change = np.zeros((batch, 2, 3, 3, stations))
        down = [-si * st, -si * ct, ci]
        north = [ci * ca * st + sa * ct, ci * ca * ct - sa * st, si * ca]
        by_inclination = [-ci * st, -ci * ct, -si], [ca * down[0], ca * down[1], ci * ca]
        by_azimuth = ca * ct - ci * sa * st, -ca * st - ci * sa * ct, -si * sa
        for axis in range(3):
            f[:, 0, axis] = self.gravity * down[axis]
            f[:, 1, axis] = self.north * north[axis] + self.down * down[axis]
            change[:, 0, axis, 0] = self.gravity * by_inclination[0][axis]
            change[:, 1, axis, 0] = (
                self.north * by_inclination[1][axis] + self.down * by_inclination[0][axis]
            )
            change[:, 1, axis, 1] = self.north * by_azimuth[axis]
        change[:, :, 0, 2], change[:, :, 1, 2] = f[:, :, 1], -f[:, :, 0]
        change *= (ERROR_SIGNS * self.angle_sd)[:, None, None]
        return f, change

    def at(self, forward: Array, errors: Array, scale: Array) -> _Linear:
        """Linearised at Φ (B, 2, 3, 4) and errors (B, 3, n), the noise times `scale` (B, t)."""
        f, change = self.vectors(errors)
        batch, stations = len(f), f.shape[-1]
        noise = self.sd * np.repeat(scale, 3, -1)[..., None]
        weight = self.include[:, None] / noise
        left = (self.raw - (forward @ f).reshape(batch, 6, stations)) * weight
        gain = forward[..., :3] @ change.reshape(batch, 2, 3, -1)
        gain = gain.reshape(batch, 6, 3, stations) * weight[:, :, None]
        sd = self.angle_sd
        held = np.where(sd > 0, errors / np.where(sd > 0, sd, 1.0), 0.0)
        left = left + np.sum(gain * held[:, None], 2)
        rows = np.repeat(f, 3, 1) * weight[:, :, None]
        return _Linear(left, rows, gain, sd)


@dataclass(frozen=True)
class _Turn:
    """Where fits have come to: Φ (B, 2, 3, 4), errors (B, 3, n), and the noise over the problem's (B, t).

    `excess` (B, t) is the logarithm of s as it was, `change` that of the noise since: their secant says the next one.
    """

    stand: _Stand
    forward: Array
    errors: Array
    scale: Array
    excess: Array
    change: Array

    def next(self, estimated: Bools) -> tuple[_Turn, Bools]:
        """A step of the fit, and of the noise where it is estimated (t,); and which members (B,) have not settled."""
        here = self.stand.at(self.forward, self.errors, self.scale)
        step, errors, length = here.step()
        forward, moving = self.forward + step.reshape(self.forward.shape), length >= LEAST_SQUARE
        now = replace(self, forward=forward, errors=errors)
        if not estimated.any():
            return now, moving
        excess, power = here.excess(step, self.stand.include)
        slope = quotient(self.excess - excess, self.change, np.abs(self.change) > LEAST_SECANT)
        slope = np.where(slope > 0, np.clip(slope, 1 / MOST_AT_ONCE, 2.0), 1 / power)
        change = np.where(estimated, excess / slope, 0.0)
        moving |= np.any(np.abs(change) >= LEAST_NOISE_CHANGE, -1)
        return replace(now, scale=self.scale * np.exp(change), excess=excess, change=change), moving


@dataclass(frozen=True)
class _Linear:
    """The problem at a state: whitened readings without the errors of angles (B, 6, n), what Φ and these do to them.

    `rows` (B, 6, 4, n) by the elements of Φ that a reading depends on, `gain` (B, 6, 3, n) by one σ of each angle.
    """

    left: Array
    rows: Array
    gain: Array
    angle_sd: Array

    @cached_property
    def factor(self) -> Array:
        """L (B, 3, 3, n), lower, of L Lᵀ = 1 + GᵀG."""
        factor = np.zeros((len(self.gain), 3, 3, self.gain.shape[-1]))
        for k in range(3):
            for j in range(k + 1):
                known = np.sum(factor[:, k, :j] * factor[:, j, :j], 1)
                product = np.sum(self.gain[:, :, k] * self.gain[:, :, j], 1) - known
                factor[:, k, j] = np.sqrt(1 + product) if j == k else product / factor[:, j, j]
        return factor

    @cached_property
    def halves(self) -> Array:
        """P (B, 6, 3, n)."""
        halves = np.empty(self.gain.shape)
        for k in range(3):
            known = np.sum(halves[:, :, :k] * self.factor[:, None, k, :k], 2)
            halves[:, :, k] = (self.gain[:, :, k] - known) / self.factor[:, None, k, k]
        return halves

    @cached_property
    def mixed(self) -> Array:
        """XᵀP (B, 24, 3, n)."""
        mixed = self.rows[:, :, :, None] * self.halves[:, :, None]
        return np.asarray(mixed.reshape(len(mixed), 24, 3, -1))

    @cached_property
    def information(self) -> Array:
        """XᵀWX (B, 24, 24)."""
        mixed = self.mixed.reshape(len(self.mixed), 24, -1)
        whole = -mixed @ mixed.mT
        by_row = whole.reshape(-1, 6, 4, 6, 4)
        square = self.rows @ self.rows.mT
        for row in range(6):
            by_row[:, row, :, row] += square[:, row]
        return np.asarray(whole)

    def step(self) -> tuple[Array, Array, Array]:
        """Step of Φ (B, 24), the errors after it (B, 3, n), and the square of its length (B,) in σ."""
        batch = len(self.left)
        along = np.sum(self.halves * self.left[:, :, None], 1)
        pull = (self.rows @ self.left[..., None]).reshape(batch, 24, 1)
        pull = pull - self.mixed.reshape(batch, 24, -1) @ along.reshape(batch, -1, 1)
        step = solved(self.information, pull)
        along = np.sum(self.halves * self.after(step)[:, :, None], 1)
        return step[..., 0], self.angle_sd * self._back(along), np.sum(step * pull, (1, 2))

    def after(self, step: Array) -> Array:
        """Readings (B, 6, n) less those explained by a step (B, 24)."""
        return np.asarray(self.left - (step.reshape(-1, 6, 1, 4) @ self.rows)[:, :, 0])

    def _back(self, along: Array) -> Array:
        """L⁻ᵀ times numbers (B, 3, n)."""
        back = np.empty(along.shape)
        for k in (2, 1, 0):
            known = np.sum(self.factor[:, k + 1 :, k] * back[:, k + 1 :], 1)
            back[:, k] = (along[:, k] - known) / self.factor[:, k, k]
        return back

    def excess(self, step: Array, include: Array) -> tuple[Array, Array]:
        """Logarithm (B, t) of s after a step, and how many times of it to take at first.

        To go ahead by what uncertain angles take of the residuals is Fisher's scoring, to first order.
        """
        left, covariance = self.after(step), inverse(self.information)
        along = np.sum(self.halves * left[:, :, None], 1)
        left = left - np.sum(self.halves * along[:, None], 2)
        weighed = np.zeros((len(left), 6, 4, 6, left.shape[-1]))
        for row in range(6):
            weighed[:, row, :, row] = self.rows[:, row]
        weighed = weighed.reshape(len(left), 24, 6, -1)
        weighed -= np.einsum("bukn,bmkn->bumn", self.mixed, self.halves)
        each = []
        for index in (0, 1):
            axes = slice(3 * index, 3 * index + 3)
            rows, halves = weighed[:, :, axes].reshape(len(left), 24, -1), self.halves[:, axes]
            taken = np.sum(covariance * (rows @ rows.mT), (1, 2))
            gram = halves.swapaxes(1, 2)[:, :, None], halves.swapaxes(1, 2)[:, None]
            overlap = np.sum(gram[0] * gram[1], 3)
            whole = 3 * include.sum(-1)
            share = np.einsum("bkkn->b", overlap)
            squares = whole - 2 * share + np.sum(overlap**2, (1, 2, 3))
            freedom = whole - share - taken
            factor = np.sum(left[:, axes] ** 2, (1, 2)) / np.where(freedom >= 1, freedom, np.nan)
            power = np.clip((whole - share) / np.maximum(squares, 1e-9), 1.0, MOST_AT_ONCE)
            each.append((np.log(factor) / 2, power))
        excess, power = (np.stack(part, -1) for part in zip(*each, strict=True))
        return excess, power
