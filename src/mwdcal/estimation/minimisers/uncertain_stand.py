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

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod

import numpy as np

from mwdcal.estimation.batch import is_once, take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.closed_form import AffineMinimum
from mwdcal.estimation.problem import WALK_AXES, WALKS, Problem, State
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import Analysis, effects_of, variance_factors
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    as_slice,
    inverse,
    inverse_of_positive,
    quotient,
)
from mwdcal.sensor.models import Polynomial, affine_parts

# --------------------------------------------------------------------------
# Columns of the unknowns of runs on a stand, and sums over their stations.
#
# A column is a direction of a station's readings times a course over the stations. Of a parameter: one reading, times
# an
# element of f̃ = [f 1]; of a term of a drift: what a unit of its axis does, times a cosine that all tools have in
# common.
# Sums of XᵀMX over the stations are therefore products of the elements of M with products of courses.
#
# Arrays are (component, B, n) where not said otherwise: each step goes over all tools and stations at once.

TRIAD_ROWS = (slice(0, 3), slice(3, 6))
"""Rows of a station's six readings that are each triad's."""
FIELD_WALK = 2
"""Number of the walk of the field; the others are of the offsets of a triad."""
OF_PARAMETERS = 24
"""Number of the elements of Φ of both triads."""


def summed(*factors: Array) -> Array:
    """The product of arrays (..., B, n) summed for each tool (B,), in one order whatever the number of tools."""
    each = np.sum(prod(factors), -1)
    return np.asarray(sum(each.reshape(-1, each.shape[-1])))


def by_tool(components: Array) -> Array:
    """Components (..., B, n) as (B, k, n)."""
    flat = components.reshape(-1, *components.shape[-2:])
    return np.moveaxis(flat, 1, 0)


def by_component(values: Array, *shape: int) -> Array:
    """Values (B, k, n) as components (shape, B, n)."""
    return np.moveaxis(values, 0, 1).reshape(*shape, len(values), values.shape[-1])


@dataclass(frozen=True)
class Blocks:
    """A symmetric matrix of all unknowns: of Φ (B, 24, 24), of the terms of drifts (B, q, q), and across (B, 24, q)."""

    params: Array
    across: Array
    drifts: Array

    @property
    def whole(self) -> Array:
        """The matrix (B, u, u)."""
        if not self.drifts.size:
            return self.params
        return np.block([[self.params, self.across], [self.across.mT, self.drifts]])

    def less(self, taken: Array) -> Blocks:
        """XᵀMX where the columns of drifts are less what Φ takes of each, (B, 24, q)."""
        across = self.across - self.params @ taken
        drifts = self.drifts - taken.mT @ self.across - across.mT @ taken
        return Blocks(self.params, across, drifts)

    def product(self, values: Array) -> Array:
        """The matrix times values (B, u)."""
        first, second = np.split(values[..., None], [OF_PARAMETERS], 1)
        above = self.params @ first + self.across @ second
        return np.concatenate([above, self.across.mT @ first + self.drifts @ second], 1)[..., 0]

    def trace(self, other: Blocks) -> Array:
        """Trace (B,) of the product with another one."""
        pairs = (
            (self.params, other.params),
            (self.across, other.across),
            (self.drifts, other.drifts),
        )
        first, across, drifts = (np.einsum("bij,bij->b", *pair) for pair in pairs)
        return np.asarray(first + 2 * across + drifts)


@dataclass(frozen=True)
class StandColumns:
    """Columns of the elements of Φ of both triads, then of the terms of drifts, axis by axis.

    `terms` (2, 4, B, n) are f̃ of each triad, `weight` (6, B, n) is one over the noise of a reading. `axes`, by triad
    (3, a, B, n), are what a unit of each axis of its drifts adds to its whitened readings; `courses` (K, n) its terms.
    """

    terms: Array
    weight: Array
    axes: tuple[Array, Array]
    courses: Array

    @property
    def of_drifts(self) -> tuple[int, int]:
        """Number of axes of the drifts, and of the terms of each."""
        return sum(axes.shape[1] for axes in self.axes), len(self.courses)

    @cached_property
    def _pairs(self) -> dict[tuple[int, int], Array]:
        """Products (B, n, 16) of elements of f̃ of two triads."""
        pairs = {}
        for one, other in ((0, 0), (0, 1), (1, 1)):
            product = self.terms[one][:, None] * self.terms[other]
            pairs[one, other] = by_tool(product).mT
        return pairs

    @cached_property
    def _along(self) -> tuple[Array, Array]:
        """Products (B, 4 K, n) of f̃ of each triad with the courses of the drifts."""
        first, second = (by_tool(f[:, None] * self.courses[:, None]) for f in self.terms)
        return first, second

    @cached_property
    def _courses(self) -> Array:
        """Products (K K, n) of the courses."""
        return (self.courses[:, None] * self.courses).reshape(-1, self.courses.shape[-1])

    def axes_of(self, walks: Iterable[int], forward: Array, attitude: Array) -> tuple[Array, Array]:
        """Effect of a unit of each axis of some walks, by their numbers, on the whitened readings of each triad.

        At Φ (B, 2, 3, 4) and attitudes (3, 3, B, n).
        """
        units: tuple[list[Array], list[Array]] = ([], [])
        for walk in walks:
            unit = np.eye(3)[..., None, None]
            if walk == FIELD_WALK:
                unit = np.einsum("bij,jabn->iabn", forward[:, 1, :, :3], attitude)
            units[min(walk, 1)].append(unit * self.weight[TRIAD_ROWS[min(walk, 1)], None])
        nothing = np.zeros((3, 0, *self.weight.shape[1:]))
        first, second = (np.concatenate([nothing, *each], 1) for each in units)
        return first, second

    def gram(self, inner: Array) -> Blocks:
        """Sums XᵀMX for the symmetric M (6, 6, B, n) of each station."""
        count = self.weight.shape[1]
        whole = np.empty((count, 2, 3, 4, 2, 3, 4))
        for (one, other), pair in self._pairs.items():
            rows, columns = TRIAD_ROWS[one], TRIAD_ROWS[other]
            heavy = inner[rows, columns] * self.weight[rows, None]
            heavy *= self.weight[columns]
            each = (by_tool(heavy) @ pair).reshape(count, 3, 3, 4, 4)
            whole[:, one, :, :, other] = each.transpose(0, 1, 3, 2, 4)
            if one != other:
                whole[:, other, :, :, one] = each.transpose(0, 2, 4, 1, 3)
        moved = self.moved(inner)
        of_params = whole.reshape(count, OF_PARAMETERS, OF_PARAMETERS)
        return Blocks(of_params, self.crossed(moved), self.of_axes(self.onto_axes(moved)))

    def moved(self, inner: Array) -> Array:
        """M times the axes of the drifts (6, a, B, n), for the M (6, 6, B, n) of each station."""
        each = [
            np.einsum("ij...,ja...->ia...", inner[:, rows], axes)
            for rows, axes in zip(TRIAD_ROWS, self.axes, strict=True)
        ]
        return np.concatenate(each, 1)

    def onto_axes(self, values: Array) -> Array:
        """The transpose of the axes (a, k, B, n) times values (6, k, B, n) of each station."""
        each = [
            np.einsum("ia...,ik...->ak...", axes, values[rows])
            for rows, axes in zip(TRIAD_ROWS, self.axes, strict=True)
        ]
        return np.concatenate(each)

    def crossed(self, moved: Array) -> Array:
        """Sums (B, 24, q) of XᵀMD over the stations, D being the columns of the drifts, from M times their axes."""
        axes, terms = self.of_drifts
        count = moved.shape[-2]
        across = np.empty((count, 2, 3, 4, axes, terms))
        for index, (rows, along) in enumerate(zip(TRIAD_ROWS, self._along, strict=True)):
            each = by_tool(moved[rows] * self.weight[rows, None]) @ along.mT
            across[:, index] = each.reshape(count, 3, axes, 4, terms).swapaxes(2, 3)
        return across.reshape(count, OF_PARAMETERS, axes * terms)

    def of_axes(self, products: Array) -> Array:
        """Sums DᵀMD (B, q, q) over the stations, from the products (a, a, B, n) of the axes by M."""
        (axes, _, count, _), terms = products.shape, len(self.courses)
        each = by_tool(products) @ self._courses.transpose()
        each = each.reshape(count, axes, axes, terms, terms).swapaxes(2, 3)
        return each.reshape(count, axes * terms, axes * terms)

    def with_others(self, weighed: Array) -> Array:
        """Sums (B, u, k) of Xᵀ times other columns (6, k, B, n), weighed, over the stations."""
        count, others = self.weight.shape[1], weighed.shape[1]
        heavy = weighed * self.weight[:, None]
        each = [
            (by_tool(heavy[rows]) @ by_tool(f).mT).reshape(count, 3, others, 4).swapaxes(2, 3)
            for rows, f in zip(TRIAD_ROWS, self.terms, strict=True)
        ]
        terms = by_tool(self.onto_axes(weighed)) @ self.courses.transpose()
        axes, courses = self.of_drifts
        each.append(terms.reshape(count, axes, others, courses).swapaxes(2, 3))
        return np.concatenate([part.reshape(count, -1, others) for part in each], 1)

    def pull(self, values: Array) -> Array:
        """Sums (B, u) of Xᵀ times values (6, B, n) over the stations."""
        heavy = values * self.weight
        each = [
            by_tool(heavy[rows]) @ by_tool(f).mT
            for rows, f in zip(TRIAD_ROWS, self.terms, strict=True)
        ]
        if self.courses.size:
            each.append(by_tool(self.onto_axes(values[:, None])) @ self.courses.transpose())
        return np.concatenate([part.reshape(values.shape[1], -1) for part in each], -1)

    def change(self, step: Array) -> Array:
        """Effect of a step (B, u) of the unknowns on the whitened readings (6, B, n)."""
        first = step[:, :OF_PARAMETERS].reshape(-1, 2, 3, 4)
        each = [by_component(first[:, t] @ by_tool(f), 3) for t, f in enumerate(self.terms)]
        change, done = np.concatenate(each) * self.weight, 0
        if not self.courses.size:
            return change
        of_drifts = step[:, OF_PARAMETERS:].reshape(len(step), *self.of_drifts) @ self.courses
        for rows, axes in zip(TRIAD_ROWS, self.axes, strict=True):
            some = of_drifts[:, done : done + axes.shape[1]]
            change[rows] += np.einsum("ia...,a...->i...", axes, by_component(some, axes.shape[1]))
            done += axes.shape[1]
        return change

    def spread(self, covariance: Array, some: slice) -> Array:
        """Covariance (6, 6, b, n) of what Φ of a covariance (b, 24, 24) does to each station of `some` tools."""
        weight, count = self.weight[:, some], len(covariance)
        spread = np.empty((6, *weight.shape))
        of_params = covariance.reshape(count, 2, 3, 4, 2, 3, 4)
        for (one, other), pair in self._pairs.items():
            rows, columns = TRIAD_ROWS[one], TRIAD_ROWS[other]
            flat = of_params[:, one, :, :, other].transpose(0, 1, 3, 2, 4).reshape(count, 9, 16)
            each = by_component(flat @ pair[some].mT, 3, 3)
            each = each * weight[rows, None] * weight[columns]
            spread[rows, columns] = each
            spread[columns, rows] = each.swapaxes(0, 1)
        return spread

    def less(self, taken: Array, some: slice) -> Array:
        """Columns (b, 6, n, q) of the drifts of `some` tools less what Φ takes of each, (b, 24, q)."""
        weight, count = self.weight[:, some], len(taken)
        whole, done = np.empty((count, 6, weight.shape[-1], taken.shape[-1])), 0
        each = taken.reshape(count, 2, 3, 4, -1)
        for index, (rows, f) in enumerate(zip(TRIAD_ROWS, self.terms[:, :, some], strict=True)):
            heavy = -f * weight[rows, None]
            whole[:, rows] = heavy.transpose(2, 0, 3, 1) @ each[:, index]
            axes = np.moveaxis(self.axes[index][:, :, some], 1, -1).swapaxes(0, 1)
            effect = axes[..., None] * self.courses.transpose()[:, None]
            effect = effect.reshape(*effect.shape[:3], -1)
            whole[:, rows, :, done : done + effect.shape[-1]] += effect
            done += effect.shape[-1]
        return whole


# --------------------------------------------------------------------------
# Runs on a stand whose angles are known at every station, each with an error, linearised at a state.
#
# Arrays are (component, B, n), those that a stand and a state are made of (B, component, n).


MOST_AT_ONCE = 3.0
"""Largest power of s that the noise takes at once."""
NUMBERS_AT_ONCE = 2**18
"""Elements of the columns of drifts, or of the weights, that are worked on together: few enough for the cache."""
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
        nothing = np.zeros((3, 0, *weight.shape[1:]))
        columns = StandColumns(f, weight, (nothing, nothing), courses)
        if self.walks:
            columns = replace(columns, axes=columns.axes_of(self.walks, forward, attitude))
        held = quotient(errors, self.angle_sd, self.angle_sd > 0)
        gain = np.empty((6, 3, *weight.shape[1:]))
        for row, by in enumerate(forward.reshape(-1, 6, 4).swapaxes(0, 1)[..., None]):
            first, second, third = change[row // 3]
            each = by[:, 0] * first + by[:, 1] * second + by[:, 2] * third
            np.multiply(each, weight[row], out=gain[row])
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
    def of_data(self) -> Blocks:
        """XᵀWX."""
        return self.columns.gram(self.weight)

    @cached_property
    def squared(self) -> tuple[Blocks, Blocks]:
        """XᵀW E W X, E being one for the readings of a triad and zero for those of the other."""
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
        data = self.of_data
        alone = inverse(data.params)
        taken = alone @ data.across
        rest = data.drifts - data.across.mT @ taken
        np.einsum("bii->bi", rest)[...] += self.precision
        return alone, taken, inverse_of_positive(rest)

    @cached_property
    def covariance(self) -> Blocks:
        """Covariance of Φ and the terms of drifts."""
        alone, taken, inner = self.parts
        across = -taken @ inner
        return Blocks(alone - across @ taken.mT, across, inner)

    @cached_property
    def spread(self) -> Array:
        """W - WX V XᵀW (6, 6, B, n), the covariance of the weighed residuals of each station."""
        spread = np.empty(self.weight.shape)
        for some in self._pieces:
            weight, (alone, taken, inner) = self.weight[:, :, some], take(self.parts, some)
            both = self.columns.spread(alone, some)
            if self.precision.size:
                left = self.columns.less(taken, some)
                known = (left.reshape(len(left), -1, left.shape[-1]) @ inner).reshape(left.shape)
                each = known.swapaxes(1, 2) @ left.transpose(0, 2, 3, 1)
                both += np.moveaxis(each, (0, 1), (2, 3))
            moved = np.einsum("ij...,jk...->ik...", weight, both)
            spread[:, :, some] = weight - np.einsum("ij...,jk...->ik...", moved, weight)
        return spread

    @cached_property
    def beside(self) -> tuple[Array, Array]:
        """Covariance (B, 24, 24) of Φ from the errors of angles alone, and tr((XᵀW E W X V)²) (B, t)."""
        each = [self._beside(some) for some in self._pieces]
        of_angles, squares = (np.concatenate(parts) for parts in zip(*each, strict=True))
        return of_angles, squares

    def _beside(self, some: slice) -> tuple[Array, Array]:
        """The same of `some` tools, the columns of drifts being less what Φ takes of them."""
        alone, taken, inner = take(self.parts, some)
        whole = (take(matrix, some).less(taken) for matrix in (self.of_data, *self.squared))
        follow, (data, *squared) = taken @ inner, whole
        first, second = squared
        across = data.across - first.across - second.across
        reach = alone @ (data.params - first.params - second.params) - follow @ across.mT
        further = alone @ across - follow @ (data.drifts - first.drifts - second.drifts)
        each = []
        for m in squared:
            part = Blocks(m.params @ alone, m.across @ inner, m.drifts @ inner)
            other = Blocks(part.params.mT, alone @ m.across, part.drifts.mT)
            each.append(part.trace(other))
        return reach @ alone - further @ follow.mT, np.stack(each, -1)

    @property
    def _pieces(self) -> Iterator[slice]:
        """The tools, so many at once that what is worked on for them stays in the cache."""
        count, stations = self.angle_sd.shape[0], self.angle_sd.shape[-1]
        size = max(1, NUMBERS_AT_ONCE // (6 * stations * (12 + self.value.shape[-1])))
        return (slice(first, first + size) for first in range(0, count, size))

    def weighed(self, values: Array) -> Array:
        """W times values (6, B, n)."""
        return np.asarray(values - np.einsum("ik...,k...->i...", self.halves, self._along(values)))

    def step(self, covariance: Blocks) -> tuple[Array, Array, Array]:
        """Step (B, u) by a covariance, the errors (B, 3, n) after it, and the square of its length (B,) in σ."""
        pull = self.columns.pull(self.weighed(self.left))
        pull[:, pull.shape[-1] - self.value.shape[-1] :] -= self.precision * self.value
        step = covariance.product(pull)
        along = by_tool(self._back(self._along(self.after(step))))
        return step, self.angle_sd * along, np.sum(step * pull, -1)

    def after(self, step: Array) -> Array:
        """Readings (6, B, n) less those explained by a step (B, u)."""
        return np.asarray(self.left - self.columns.change(step))

    def moved(self, step: Array) -> StandLinear:
        """The same after a step (B, u) that changes nothing but what is left of the readings."""
        moved = replace(self)
        left, value = self.after(step), self.value + step[:, OF_PARAMETERS:]
        vars(moved).update(vars(self) | {"left": left, "value": value})
        return moved

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
            taken = self.covariance.trace(squared)
            squares = summed(block, block, include)
            freedom = whole - share - taken
            misfit = summed(left[rows], left[rows])
            factor = misfit / np.where(freedom >= 1, freedom, np.nan)
            power = np.clip((whole - share) / np.maximum(squares, 1e-9), 1.0, MOST_AT_ONCE)
            each.append((np.log(factor) / 2, power))
        excess, power = (np.stack(part, -1) for part in zip(*each, strict=True))
        return excess, power


MOST_STAND_STEPS = 12
"""Most steps of a fit: a member that has not settled then goes the general way."""
STEPS_ALIKE = 4
"""First steps that are taken by one covariance; those of members that have not settled have their own."""
LEAST_SQUARE = 1e-4
"""Square of the last step but one, in standard uncertainties: each comes several hundred times closer."""
LEAST_NOISE_CHANGE = 1e-5
"""Largest last change of the noise, as a share."""
LEAST_SECANT = 1e-9
"""Smaller changes of the noise tell nothing of its slope."""
LEAST_OF_SIGNAL = 1e-6
"""Noise below this share of the readings' size is left to the general way."""


def applies(problem: Problem) -> bool:
    """Whether angles are known with errors of their own alone, and both sensors' gains and offsets do not vary."""
    return (
        has_known_angles(problem)
        and all(closed_form.is_affine(triad) for triad in problem.triads)
        and not problem.evidence.set_together.any()
        and _have_common_terms(problem)
    )


def has_known_angles(problem: Problem) -> bool:
    """Whether all angles are known, and nothing but their errors, two sensors and drifts are to be found."""
    evidence = problem.evidence
    return (
        len(problem.triads) == 2
        and not (evidence.absent or evidence.scatter)
        and bool(evidence.referenced.all())
        and problem.prior.is_none
        and all(constant.name in WALK_AXES for constant in evidence.constants)
    )


def _have_common_terms(problem: Problem) -> bool:
    """Whether the terms of drifts are in the order of their axes, and the same for each, at all tools."""
    constants = problem.evidence.constants
    names = [constant.name for constant in constants]
    terms = names.count(names[0]) if names else 1
    masks = [constants[place % terms].mask[:1] for place in range(len(names))]
    return names == [name for name in WALK_AXES if name in names for _ in range(terms)] and all(
        bool((constant.mask[: 1 if is_once(constant.mask) else None] == mask).all())
        for constant, mask in zip(constants, masks, strict=True)
    )


@dataclass(frozen=True)
class Solution:
    """Where the fits have come to: state, the noise over that of the problem (B, t), the minima, and steps.

    `good` (B,): the members that have settled with all directions clearly determined. `linear`: the runs there.
    """

    state: State
    linear: StandLinear
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
    there, here = there.last()
    state, determined = _ended(problem, there, first, at)
    good &= settled & np.isfinite(state.params).all(-1) & np.isfinite(there.scale).all(-1)
    good &= np.all((there.scale * stand.noise_share > LEAST_OF_SIGNAL) | ~estimated, -1)
    return Solution(state, here, there.scale, determined, steps, good)


def refined(problem: Problem, state: State, anew: bool) -> Solution:
    """The fits from a state nearby; noise that is not declared is that of the problem, or is estimated `anew`."""
    at = closed_form.start(problem)
    first = [m for m in closed_form.minima(problem, at) if isinstance(m, AffineMinimum)]
    stand, forward = StandRuns.of(problem), _forward(problem, state)
    one, zero = np.ones((len(forward), 2)), np.zeros((len(forward), 2))
    start = _Turn(stand, forward, state.errors.mT, state.constants, one, zero, zero)
    sound = np.asarray(np.isfinite(state.params).all(-1))
    estimated = np.array([anew and not triad.declared for triad in problem.triads])
    there, steps, good = _settled(start, estimated, sound)
    there, here = there.last()
    state, determined = _ended(problem, there, first, at)
    good &= determined.clear & np.isfinite(state.params).all(-1)
    good &= np.all((there.scale * stand.noise_share > LEAST_OF_SIGNAL) | ~estimated, -1)
    return Solution(state, here, there.scale, determined, steps, good)


@dataclass(frozen=True)
class StandWalks:
    """All walks as fits without drift leave them, of unit terms: those of a walk axis by axis.

    `products` (a, a, B, n) of the axes by W, `score` (B, q) of the terms, `crossed`, XᵀWD (B, 24, q) with the
    parameters, and what these take up, `taken`.
    """

    columns: StandColumns
    products: Array
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
        moved = columns.moved(here.weight)
        crossed, products = columns.crossed(moved), columns.onto_axes(moved)
        return cls(columns, products, score, crossed, here.covariance.params @ crossed)

    def among(self, walks: Sequence[int]) -> tuple[Array, Array, Array]:
        """Scores (B, q) of some walks by their numbers, their covariance, and what that is with all else known."""
        axes = np.array([3 * walk + axis for walk in walks for axis in range(3)])
        terms = len(self.columns.courses)
        places = as_slice((axes[:, None] * terms + np.arange(terms)).ravel())
        some = as_slice(axes)
        alone = self.columns.of_axes(self.products[some][:, some])
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


def analysis_of(problem: Problem, there: Solution) -> Analysis:
    """The analysis of fits that have come to a solution, their runs linearised once."""
    problem.once("on stand", there.state, lambda _: there.linear)
    return analysed(problem, there.state, there.determined)


def analysed(problem: Problem, state: State, determined: Determined) -> Analysis:
    """The analysis of fits with all directions determined, as `analyse` has it, with what the stand does."""
    at, include = linear(problem, state), problem.evidence.include
    moved, covariance = moved_params(problem, _forward(problem, state)), at.covariance
    spread, residual = at.spread * include, at.weighed(at.left)
    pairs = [(at.weight[rows, rows], spread[rows, rows]) for rows in TRIAD_ROWS]
    lone = [summed(w, 2 * left - w * include) for w, left in pairs]
    spread, residual = (
        np.ascontiguousarray(np.moveaxis(each, (-2, -1), (0, 1))) for each in (spread, residual)
    )
    of_angles, squares = at.beside
    return Analysis(
        moved @ covariance.params @ moved.mT,
        determined,
        *variance_factors(residual, spread),
        residual,
        spread,
        covariance.drifts,
        effects_of(problem, moved @ covariance.across),
        np.zeros((len(moved), OF_PARAMETERS, 0)),
        squares=np.stack(lone, -1) + squares,
        of_stand=moved @ of_angles @ moved.mT,
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

    `covariance` is that of the unknowns, by which steps are taken. `excess` (B, t) is the logarithm of s as
    it was, `change` that of the noise since: their secant says the next one.
    """

    stand: StandRuns
    forward: Array
    errors: Array
    value: Array
    scale: Array
    excess: Array
    change: Array
    covariance: Blocks | None = None

    def next(self, estimated: Bools, anew: bool) -> tuple[_Turn, Bools]:
        """A step of the fit, and of the noise where it is estimated (t,); and which members (B,) have not settled.

        While the noise stays, so does the covariance unless it is asked for `anew`: it says how far to go, not where to
        end.
        """
        here, covariance = self.linear, self.covariance
        if covariance is None or anew or estimated.any():
            covariance = here.covariance
        step, errors, length = here.step(covariance)
        moving = ~(np.abs(length) < LEAST_SQUARE)  # where steps run away it is any number
        now = replace(self._after(step, errors), covariance=covariance)
        if not estimated.any():
            return now, moving
        excess, power = here.excess(step, self.stand.include)
        slope = quotient(self.excess - excess, self.change, np.abs(self.change) > LEAST_SECANT)
        slope = np.where(slope > 0, np.clip(slope, 1 / MOST_AT_ONCE, 2.0), 1 / power)
        change = np.where(estimated, excess / slope, 0.0)
        moving |= np.any(np.abs(change) >= LEAST_NOISE_CHANGE, -1)
        return replace(now, scale=self.scale * np.exp(change), excess=excess, change=change), moving

    def last(self) -> tuple[_Turn, StandLinear]:
        """A short last step, and the runs linearised at its end."""
        here = self.linear
        step, errors, _ = here.step(here.covariance)
        return self._after(step, errors), here.moved(step)

    @property
    def linear(self) -> StandLinear:
        """The runs linearised here."""
        return self.stand.at(self.forward, self.errors, self.value, self.scale)

    def _after(self, step: Array, errors: Array) -> _Turn:
        """After a step (B, u) that leaves these errors."""
        forward = self.forward + step[:, :OF_PARAMETERS].reshape(self.forward.shape)
        value = self.value + step[:, OF_PARAMETERS:]
        return replace(self, forward=forward, errors=errors, value=value)
