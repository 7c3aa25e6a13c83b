"""Runs on a stand whose angles are known at every station, each with an error, linearised at a state.

Arrays are (component, B, n), those that a stand and a state are made of (B, component, n).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mwdcal.estimation.minimisers.stand_columns import (
    OF_PARAMETERS,
    TRIAD_ROWS,
    StandColumns,
    by_component,
    by_tool,
    summed,
)
from mwdcal.estimation.problem import WALK_AXES, Problem
from mwdcal.geometry.vectors import Array, inverse, quotient

MOST_AT_ONCE = 3.0
"""Largest power of s that the noise takes at once."""
ERROR_SIGNS = np.array([1.0, -1.0, -1.0])[:, None]
"""How inclination, azimuth and toolface follow the errors of a state."""


@dataclass(frozen=True)
class StandRuns:
    """Constants of the iteration: angles and σ (B, 3, n), strengths (B, n), readings and noise (B, 6, n).

    `courses` (B, K, n) are the terms of each axis of the drifts, of precision (B, q); `walks` their numbers.
    """

    angles: Array
    angle_sd: Array
    gravity: Array
    north: Array
    down: Array
    raw: Array
    sd: Array
    include: Array
    courses: Array
    precision: Array
    walks: tuple[int, ...]

    @classmethod
    def of(cls, problem: Problem) -> StandRuns:
        """Of a problem."""
        evidence = problem.evidence
        known = evidence.known
        angles = np.stack([known[n] for n in ("inclination", "azimuth", "toolface")], 1)
        field, dip = known["field"], known["dip"]
        raw, sd = (
            np.concatenate([getattr(t, n).mT for t in problem.triads], 1) for n in ("raw", "sd")
        )
        north, down = field * np.cos(dip), field * np.sin(dip)
        turn_sd, constants = evidence.turn_sd.mT, evidence.constants
        axes = [*dict.fromkeys(constant.name for constant in constants)]
        terms = constants[: len(constants) // max(len(axes), 1)]
        courses, precision = np.zeros((len(raw), 0, raw.shape[-1])), np.zeros((len(raw), 0))
        if terms:
            courses = np.stack([constant.mask for constant in terms], 1)
            precision = np.stack([constant.sd for constant in constants], -1) ** -2.0
        walks = tuple(WALK_AXES[name][0] for name in axes[::3])
        return cls(
            angles, turn_sd, known["gravity"], north, down, raw, sd, evidence.include,
            courses, precision, walks,
        )  # fmt: skip

    @property
    def noise_share(self) -> Array:
        """The problem's noise as a share of the readings' size (B, t)."""
        size, sd = (
            np.sqrt(np.mean(each.reshape(len(each), 2, -1) ** 2, -1))
            for each in (self.raw - self.raw.mean(-1, keepdims=True), self.sd)
        )
        return np.asarray(sd / np.where(size > 0, size, 1.0))

    def vectors(self, errors: Array) -> tuple[Array, Array, Array]:
        """f̃ (2, 4, B, n), the change of f by one σ of each angle (2, 3, 3, B, n), and attitudes (3, 3, B, n)."""
        angle = np.ascontiguousarray(np.moveaxis(self.angles + ERROR_SIGNS * errors, 1, 0))
        (ci, ca, ct), (si, sa, st) = np.cos(angle), np.sin(angle)
        sd = np.ascontiguousarray(np.moveaxis(ERROR_SIGNS * self.angle_sd, 1, 0))
        one = np.ones_like(ci)
        down = np.stack([-si * st, -si * ct, ci])
        north = np.stack([ci * ca * st + sa * ct, ci * ca * ct - sa * st, si * ca])
        east = np.stack([ci * sa * st - ca * ct, ci * sa * ct + ca * st, si * sa])
        fields = [self.gravity * down, self.north * north + self.down * down]
        by_inclination = np.stack([-ci * st, -ci * ct, -si])
        change = np.zeros((2, 3, 3, *ci.shape))
        change[0, :, 0] = self.gravity * sd[0] * by_inclination
        change[1, :, 0] = sd[0] * (self.north * ca * down + self.down * by_inclination)
        change[1, :, 1] = -self.north * sd[1] * east
        for index, field in enumerate(fields):
            change[index, 0, 2], change[index, 1, 2] = sd[2] * field[1], -sd[2] * field[0]
        f = np.stack([np.concatenate([field, one[None]]) for field in fields])
        return f, change, np.stack([north, east, down], 1)

    def at(self, forward: Array, errors: Array, value: Array, scale: Array) -> StandLinear:
        """Linearised at Φ (B, 2, 3, 4), errors (B, 3, n) and terms of drifts (B, q), the noise times `scale` (B, t)."""
        f, change, attitude = self.vectors(errors)
        noise = self.sd * np.repeat(scale, 3, -1)[..., None]
        weight = by_component(self.include[:, None] / noise, 6)
        courses = self.courses[0] if self.walks else np.zeros((0, weight.shape[-1]))
        columns = StandColumns(f, weight, np.zeros((6, 0, *weight.shape[1:])), courses)
        columns = replace(columns, axes=columns.axes_of(self.walks, forward, attitude))
        held = quotient(errors, self.angle_sd, self.angle_sd > 0)
        each = [
            np.einsum("bij,jabn->iabn", forward[:, t, :, :3], change[t]) * weight[rows, None]
            for t, rows in enumerate(TRIAD_ROWS)
        ]
        gain = np.concatenate(each)
        unknowns = np.concatenate([forward.reshape(len(forward), -1), value], -1)
        left = by_component(self.raw, 6) * weight - columns.change(unknowns)
        left += np.einsum("ik...,k...->i...", gain, by_component(held, 3))
        return StandLinear(columns, left, gain, attitude, self.angle_sd, self.precision, value)


@dataclass(frozen=True)
class StandLinear:
    """Runs at a state: whitened readings `left` (6, B, n) without the errors of angles, and what unknowns do to them.

    `columns` are those of Φ and of the terms of drifts, which are at a `value` (B, q), known to a `precision` before;
    `gain` (6, 3, B, n) is what one σ of each angle does, and `attitude` (3, 3, B, n) where the angles are.
    """

    columns: StandColumns
    left: Array
    gain: Array
    attitude: Array
    angle_sd: Array
    precision: Array
    value: Array

    @cached_property
    def factor(self) -> Array:
        """L (3, 3, B, n), lower, of L Lᵀ = 1 + GᵀG."""
        gram = np.einsum("ik...,ij...->kj...", self.gain, self.gain)
        factor = np.zeros(gram.shape)
        for k in range(3):
            for j in range(k + 1):
                product = gram[k, j] - np.sum(factor[k, :j] * factor[j, :j], 0)
                factor[k, j] = np.sqrt(1 + product) if j == k else product / factor[j, j]
        return factor

    @cached_property
    def halves(self) -> Array:
        """P (6, 3, B, n)."""
        halves = np.empty(self.gain.shape)
        for k in range(3):
            rest = self.gain[:, k].copy()
            for j in range(k):
                rest -= halves[:, j] * self.factor[k, j]
            halves[:, k] = rest / self.factor[k, k]
        return halves

    @cached_property
    def weight(self) -> Array:
        """W (6, 6, B, n)."""
        weight = -np.einsum("ik...,jk...->ij...", self.halves, self.halves)
        for row in range(6):
            weight[row, row] += 1
        return np.asarray(weight)

    @cached_property
    def of_data(self) -> Array:
        """XᵀWX (B, u, u)."""
        return self.columns.gram(self.weight)

    @cached_property
    def squared(self) -> tuple[Array, Array]:
        """XᵀW E W X (B, u, u), E being one for the readings of a triad and zero for those of the other."""
        first, second = (
            self.columns.gram(
                np.einsum("ik...,kj...->ij...", self.weight[:, rows], self.weight[rows])
            )
            for rows in TRIAD_ROWS
        )
        return first, second

    @cached_property
    def parts(self) -> tuple[Array, Array, Array]:
        """Covariance (B, 24, 24) of Φ without drifts, what Φ takes of their terms (B, 24, q), and theirs (B, q, q).

        A drift's mean is an offset: of the sums of both together only rounding would be left.
        """
        p, information = OF_PARAMETERS, self.of_data
        alone = inverse(information[:, :p, :p])
        if not self.precision.size:
            return alone, information[:, :p, p:], information[:, p:, p:]
        taken = alone @ information[:, :p, p:]
        rest = information[:, p:, p:] - information[:, p:, :p] @ taken
        np.einsum("bii->bi", rest)[...] += self.precision
        return alone, taken, inverse(rest)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (B, u, u) of Φ and the terms of drifts."""
        alone, taken, inner = self.parts
        if not self.precision.size:
            return alone
        across = -taken @ inner
        return np.block([[alone - across @ taken.mT, across], [across.mT, inner]])

    @cached_property
    def spread(self) -> Array:
        """W - WX V XᵀW (6, 6, B, n), the covariance of the weighed residuals of each station."""
        alone, taken, inner = self.parts
        both = self.columns.spread(alone)
        if self.precision.size:
            left = self.columns.less(taken)
            both += by_component(
                (left @ inner[:, None] @ left.mT).reshape(*left.shape[:2], 36).mT, 6, 6
            )
        moved = np.einsum("ij...,jk...->ik...", self.weight, both)
        return np.asarray(self.weight - np.einsum("ij...,jk...->ik...", moved, self.weight))

    @cached_property
    def apart(self) -> tuple[Array, ...]:
        """XᵀWX, then both of `squared`, where the columns of drifts are less what Φ takes of them."""
        each, p = (self.of_data, *self.squared), OF_PARAMETERS
        if not self.precision.size:
            return each
        taken, changed = self.parts[1], []
        for whole in each:
            across = whole[:, :p, p:] - whole[:, :p, :p] @ taken
            among = whole[:, p:, p:] - taken.mT @ whole[:, :p, p:] - across.mT @ taken
            changed.append(np.block([[whole[:, :p, :p], across], [across.mT, among]]))
        return tuple(changed)

    @cached_property
    def of_angles(self) -> Array:
        """Covariance (B, 24, 24) of Φ from the errors of angles alone."""
        alone, taken, inner = self.parts
        data, *squared = self.apart
        reach = np.concatenate([alone, -taken @ inner], -1) if self.precision.size else alone
        return reach @ (data - sum(squared)) @ reach.mT

    @cached_property
    def shared_squares(self) -> Array:
        """tr((XᵀW E W X V)²) (B, t)."""
        alone, _, inner = self.parts
        each, p = [], OF_PARAMETERS
        for squared in self.apart[1:]:
            part = np.concatenate([squared[..., :p] @ alone, squared[..., p:] @ inner], -1)
            each.append(np.sum(part * part.mT, (1, 2)))
        return np.stack(each, -1)

    def weighed(self, values: Array) -> Array:
        """W times values (6, B, n)."""
        return np.asarray(values - np.einsum("ik...,k...->i...", self.halves, self._along(values)))

    def step(self, covariance: Array) -> tuple[Array, Array, Array]:
        """Step (B, u) by a covariance, the errors (B, 3, n) after it, and the square of its length (B,) in σ."""
        pull = self.columns.pull(self.weighed(self.left))
        pull[:, pull.shape[-1] - self.value.shape[-1] :] -= self.precision * self.value
        step = (covariance @ pull[..., None])[..., 0]
        along = by_tool(self._back(self._along(self.after(step))))
        return step, self.angle_sd * along, np.sum(step * pull, -1)

    def after(self, step: Array) -> Array:
        """Readings (6, B, n) less those explained by a step (B, u)."""
        return np.asarray(self.left - self.columns.change(step))

    def _along(self, values: Array) -> Array:
        """Pᵀ times values (6, B, n)."""
        return np.asarray(np.einsum("ik...,i...->k...", self.halves, values))

    def _back(self, along: Array) -> Array:
        """L⁻ᵀ times numbers (3, B, n)."""
        back = np.empty(along.shape)
        for k in (2, 1, 0):
            known = np.sum(self.factor[k + 1 :, k] * back[k + 1 :], 0)
            back[k] = (along[k] - known) / self.factor[k, k]
        return back

    def excess(self, step: Array, include: Array) -> tuple[Array, Array]:
        """Logarithm (B, t) of s after a step, and how many times of it to take at first.

        To go ahead by what uncertain angles take of the residuals is Fisher's scoring, to first order.
        """
        left, each, whole = self.weighed(self.after(step)), [], 3 * include.sum(-1)
        for rows, squared in zip(TRIAD_ROWS, self.squared, strict=True):
            block = self.weight[rows, rows]
            share = whole - summed(np.einsum("iibn->ibn", block), include)
            taken = np.sum(self.covariance * squared, (1, 2))
            squares = summed(block, block, include)
            freedom = whole - share - taken
            misfit = summed(left[rows], left[rows])
            factor = misfit / np.where(freedom >= 1, freedom, np.nan)
            power = np.clip((whole - share) / np.maximum(squares, 1e-9), 1.0, MOST_AT_ONCE)
            each.append((np.log(factor) / 2, power))
        excess, power = (np.stack(part, -1) for part in zip(*each, strict=True))
        return excess, power
