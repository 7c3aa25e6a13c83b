"""Factors over temperature on a stand whose angles are known, each with an error: a shorter way to the same minimum.

By axis a reading is s(τ) [v + u · (v of the other axes) + b(τ)] as at exact references (`closed_form_factors`), with v
at the angles that a state holds. A row of the design then has the unknowns of its own axis alone, and the angles that a
station has for itself are taken out as elsewhere,

    W = 1 - P Pᵀ,     P = G L⁻ᵀ,  L Lᵀ = 1 + Gᵀ G

of which only columns with an uncertainty count. Errors of settings and terms of drifts are further unknowns. The matrix
of the first step serves for all of a fit: it says how far to go, not where to end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, pairwise

import numpy as np

from mwdcal.estimation.batch import put, take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.closed_form_factors import OTHERS, Axes, factors, known_at
from mwdcal.estimation.minimisers.closed_form_factors import minimum as lone_minimum
from mwdcal.estimation.minimisers.uncertain_stand import (
    FIELD_WALK,
    TRIAD_ROWS,
    StandRuns,
    has_known_angles,
)
from mwdcal.estimation.problem import WALK_AXES, Problem, State, Triad
from mwdcal.estimation.solvers import Determined, Status, gauss_newton
from mwdcal.estimation.start import start as general_start
from mwdcal.estimation.uncertainty import Analysis, effects_of, variance_factors
from mwdcal.geometry.vectors import (
    Array,
    Ints,
    diagonal,
    inverse,
    outer,
    quotient,
)
from mwdcal.sensor.models import Factors, Polynomial, affine_parts, factor_parts

MOST_AXIS_STEPS = 12
"""Most steps of a fit: a member that has not settled then goes the general way."""
STEPS_BY_ONE = 6
"""First steps that are taken by one matrix; those of members that have not settled have their own."""
LAST_AXIS_STEP = 1e-12
"""Square of the last step, in standard uncertainties."""


def applies(problem: Problem) -> bool:
    """Whether there are factors, and what is to be found comes apart by axis but for errors of known angles."""
    return any(isinstance(t.model, Factors) for t in problem.triads) and comes_apart(problem)


def comes_apart(problem: Problem) -> bool:
    """Whether angles are known, with errors of their own or of settings, and the sensors are affine or factors."""
    return (
        all(closed_form.is_closed(triad) for triad in problem.triads)
        and has_known_angles(problem)
        and not problem.evidence.members.size
    )


# --------------------------------------------------------------------------
# Unknowns (B, 3, 2K + 2) of each axis of a triad, s, u and b, and the parameters of its model.


def unknowns_of(triad: Triad, params: Array) -> Array:
    """The unknowns of parameters (B, p)."""
    if isinstance(triad.model, Factors):
        scale, bias, mixing = factor_parts(params)
        back = inverse(np.eye(3) - mixing)
        pivots = diagonal(back)[..., None]
        scale, bias = scale * pivots, bias / pivots
    else:
        assert isinstance(triad.model, Polynomial)
        slope, field = affine_parts(params)
        back = inverse(slope / triad.model.scale)
        offset = triad.model.centre[:, 0] - (back @ field[..., None])[..., 0]
        scale = pivots = diagonal(back)[..., None]
        bias = offset[..., None] / pivots
    across = np.take_along_axis(back, np.broadcast_to(OTHERS, (len(back), 3, 2)), -1) / pivots
    return np.concatenate([scale, across, bias], -1)


def params_of(triad: Triad, unknowns: Array) -> Array:
    """The parameters (B, p) of unknowns."""
    if isinstance(triad.model, Factors):
        return factors(unknowns)[0]
    turn = closed_form.centred_parts(triad, _forward(unknowns))[1]
    return np.asarray(turn[:, :3].reshape(-1, 12)[:, closed_form.PLACES])


def moved_params(triad: Triad, unknowns: Array) -> Array:
    """Change (B, p, p) of the parameters by the unknowns."""
    batch, size = len(unknowns), unknowns[0].size
    if isinstance(triad.model, Factors):
        return inverse(factors(unknowns)[2].reshape(batch, size, size))
    forward, axis = _forward(unknowns), np.arange(3)
    by = np.zeros((batch, 3, 4, 3, 4))
    by[:, axis, :, axis, 0] = np.moveaxis(forward / unknowns[..., :1], 1, 0)
    for place in (0, 1):
        by[:, axis, OTHERS[:, place], axis, 1 + place] = unknowns[..., 0]
    by[:, axis, 3, axis, 3] = unknowns[..., 0]
    back, turn = closed_form.centred_parts(triad, forward)
    moved = -back[:, :, None, :, None] * turn.mT[:, None, :, None, :]
    return moved.reshape(batch, size, size)[:, closed_form.PLACES] @ by.reshape(batch, size, size)


def _forward(unknowns: Array) -> Array:
    """Φ (B, 3, 4) of unknowns (B, 3, 4) without a course."""
    offset = unknowns[..., :1] * unknowns[..., -1:]
    return np.concatenate([_shares(unknowns) * unknowns[..., :1], offset], -1)


def _shares(unknowns: Array) -> Array:
    """1 + u (B, 3, 3)."""
    count = unknowns.shape[-1] // 2 - 1
    shares = np.broadcast_to(np.eye(3), (len(unknowns), 3, 3)).copy()
    shares[:, np.arange(3)[:, None], OTHERS] = unknowns[..., count : count + 2]
    return shares


# --------------------------------------------------------------------------
# Runs linearised at a point.
#
# A column of the design is an effect on the six readings of a station times a course over the stations. Those of an
# axis have an effect on its reading alone; then come those of each axis of a drift and, with settings, of inclination
# and azimuth. Sums over the stations are products of courses. Arrays are (B, component, n).


@dataclass(frozen=True)
class AxisRuns:
    """Constants of the iteration: references, φ (B, K, n) of each triad, readings and 1/noise (B, 6, n).

    `lone` (B, 3, n) are σ of the angles of each station for itself; `settings`, two or none, those (B, k, n) of each
    setting. `terms` (B, K, n) of drifts act each on one of the `axes` of walks, and are known to a `precision` (B, q).
    """

    stand: StandRuns
    phi: tuple[Array, ...]
    root: Array
    lone: Array
    settings: tuple[Array, ...]
    terms: tuple[Array, ...]
    axes: tuple[tuple[int, int], ...]
    precision: Array

    @classmethod
    def of(cls, problem: Problem) -> AxisRuns:
        """Of a problem."""
        evidence, count = problem.evidence, len(problem.temperature)
        stand = StandRuns.of(replace(problem, evidence=replace(evidence, constants=())))
        walks = [list(each) for _, each in groupby(evidence.constants, lambda c: c.name)]
        sd = [constant.sd for constant in evidence.constants]
        return cls(
            replace(stand, angle_sd=np.ones_like(stand.angles)),
            tuple(triad.model.basis(problem.temperature).mT for triad in problem.triads),
            evidence.include[:, None] / stand.sd,
            evidence.turn_sd.mT,
            tuple(np.split(evidence.set_together.mT, 2, 1)) if evidence.settings else (),
            tuple(np.stack([constant.mask for constant in each], 1) for each in walks),
            tuple(WALK_AXES[each[0].name] for each in walks),
            np.stack(sd, -1) ** -2.0 if sd else np.zeros((count, 0)),
        )

    def at(self, point: AxisPoint) -> AxisLinear:
        """Linearised at a point."""
        errors = point.errors.copy()
        shared = np.split(point.settings, 2, -1) if self.settings else []
        for angle, (value, sd) in enumerate(zip(shared, self.settings, strict=True)):
            errors[:, angle] += (value[:, None] @ sd)[:, 0]
        f, change, attitude = self.stand.vectors(errors)
        shares = tuple(_shares(unknowns) for unknowns in point.unknowns)
        courses: list[Array] = []
        gains, seen, vectors, louds = [], [], [], []
        for index, (phi, unknowns) in enumerate(zip(self.phi, point.unknowns, strict=True)):
            root, size = self.root[:, TRIAD_ROWS[index]], phi.shape[1]
            v = np.moveaxis(f[index, :3], 0, 1)
            beside = np.empty((*v.shape[:2], size + 2, v.shape[-1]))
            beside[:, :, :2], beside[:, :, 2:] = v[:, OTHERS], phi[:, None]
            louder = (unknowns[..., :size] @ phi) * root
            unit = v + (unknowns[..., None, size:] @ beside)[..., 0, :]
            by = (unit * root)[:, :, None] * phi[:, None], louder[:, :, None] * beside
            courses.extend(np.moveaxis(np.concatenate(by, 2), 1, 0))
            turns = np.moveaxis(change[index], 2, 0).reshape(len(v), 3, -1)
            turned = (shares[index] @ turns).reshape(*v.shape[:2], 3, -1)
            gains.append(turned * louder[:, :, None])
            seen.append(louder * unit)
            vectors.append(v)
            louds.append(louder)
        gain, (louder, vector) = (
            np.concatenate(gains, 1),
            (np.concatenate(each, 1) for each in (louds, vectors)),
        )
        active = np.flatnonzero(self.lone.any((0, 2)))
        sd, held = self.lone[:, active], point.errors[:, active]
        lone = gain[:, :, active] * sd[:, None]
        walks = _walk_effects(self.axes, self.root, louder, shares, attitude)
        left = self.stand.raw * self.root - np.concatenate(seen, 1)
        left += np.sum(lone * quotient(held, sd, sd > 0)[:, None], 2)
        first = 0
        for place, terms in enumerate(self.terms):
            value = point.constants[:, first : first + terms.shape[1]]
            left -= walks[:, :, place] * (value[:, None] @ terms)
            first += terms.shape[1]
        known = np.concatenate([self.precision, np.ones(point.settings.shape)], -1)
        return AxisLinear(
            (*courses, *self.terms, *self.settings),
            np.concatenate([walks, gain[:, :, : len(self.settings)]], 2),
            lone, left, np.concatenate([point.constants, point.settings], -1), known,
            sd, active, vector, louder, shares, self.root, attitude,
        )  # fmt: skip


def _walk_effects(
    axes: Sequence[tuple[int, int]],
    root: Array,
    louder: Array,
    shares: tuple[Array, ...],
    attitude: Array,
) -> Array:
    """Effect (B, 6, a, n) on the readings over their noise of a unit of some axes of walks, by the numbers of both."""
    effect = np.zeros((len(root), 6, len(axes), root.shape[-1]))
    for place, (walk, axis) in enumerate(axes):
        if walk < FIELD_WALK:
            effect[:, 3 * walk + axis, place] = root[:, 3 * walk + axis]
        else:
            along = np.moveaxis(attitude[:, axis], 0, 1)
            effect[:, 3:, place] = (shares[1] @ along) * louder[:, 3:]
    return effect


@dataclass(frozen=True)
class AxisPoint:
    """Where fits are: unknowns (B, 3, 2K + 2) of each triad, errors (B, 3, n), constants (B, q), settings (B, 2k)."""

    unknowns: tuple[Array, ...]
    errors: Array
    constants: Array
    settings: Array

    @classmethod
    def of(cls, problem: Problem, state: State) -> AxisPoint:
        """Of a state."""
        pairs = zip(problem.triads, problem.slices(), strict=True)
        each = tuple(unknowns_of(triad, state.params[:, where]) for triad, where in pairs)
        return cls(each, np.ascontiguousarray(state.errors.mT), state.constants, state.settings)

    def state(self, problem: Problem, state: State) -> State:
        """The state, of which `state` has the references."""
        each = [params_of(*pair) for pair in zip(problem.triads, self.unknowns, strict=True)]
        return replace(
            state,
            params=np.concatenate(each, -1),
            constants=self.constants,
            errors=self.errors.mT,
            settings=self.settings,
        )

    def moved(self, step: Array, errors: Array) -> AxisPoint:
        """After a step (B, u), with the errors that follow."""
        sizes = [*(unknowns[0].size for unknowns in self.unknowns), self.constants.shape[-1]]
        *each, constants, settings = np.split(step, np.cumsum(sizes), -1)
        pairs = zip(self.unknowns, each, strict=True)
        moved = tuple(unknowns + part.reshape(unknowns.shape) for unknowns, part in pairs)
        return AxisPoint(moved, errors, self.constants + constants, self.settings + settings)


@dataclass(frozen=True)
class AxisLinear:
    """Runs at a point: `courses` (B, k, n) of the columns by effect, and what is `left` (B, 6, n) of the readings.

    The first six effects are on one axis each; `effect` (B, 6, e, n) are the others, of which values `held` and their
    `precision` (B, q) are known. `gain` (B, 6, a, n) is what one σ of each angle that a station has for itself does, of
    the `active` ones, with their σ `sd` (B, a, n). A reading over its noise is `louder` (B, 6, n) times the row of
    `shares` (B, 3, 3) times the `vector` (B, 6, n), and what is added to it; `root` (B, 6, n) is one over the noise.
    """

    courses: tuple[Array, ...]
    effect: Array
    gain: Array
    left: Array
    held: Array
    precision: Array
    sd: Array
    active: Ints
    vector: Array
    louder: Array
    shares: tuple[Array, ...]
    root: Array
    attitude: Array

    @cached_property
    def places(self) -> list[slice]:
        """Where the unknowns of each effect lie."""
        ends = np.cumsum([0, *(course.shape[1] for course in self.courses)]).tolist()
        return [slice(*pair) for pair in pairwise(ends)]

    @property
    def size(self) -> int:
        """Number of the unknowns of the axes."""
        return sum(course.shape[1] for course in self.courses[:6])

    @cached_property
    def factor(self) -> Array:
        """L (B, a, a, n), lower, of L Lᵀ = 1 + GᵀG."""
        gain, count = self.gain, self.gain.shape[2]
        factor = np.zeros((len(gain), count, count, gain.shape[-1]))
        for k in range(count):
            for j in range(k + 1):
                gram = np.sum(gain[:, :, k] * gain[:, :, j], 1)
                product = gram - np.sum(factor[:, k, :j] * factor[:, j, :j], 1)
                factor[:, k, j] = (
                    np.sqrt(np.maximum(1 + product, 1.0)) if j == k else product / factor[:, j, j]
                )
        return factor

    @cached_property
    def halves(self) -> Array:
        """P (B, 6, a, n)."""
        halves = np.empty_like(self.gain)
        for k in range(self.gain.shape[2]):
            rest = self.gain[:, :, k].copy()
            for j in range(k):
                rest -= halves[:, :, j] * self.factor[:, None, k, j]
            halves[:, :, k] = rest / self.factor[:, None, k, k]
        return halves

    @cached_property
    def seen_halves(self) -> Array:
        """P as the effects see it (B, 6 + e, a, n)."""
        return self.seen(self.halves)

    def seen(self, values: Array) -> Array:
        """Products (B, 6 + e, k, n) of all effects with values (B, 6, k, n)."""
        if not self.effect.shape[2]:
            return values
        each = [np.sum(effect[:, :, None] * values, 1) for effect in np.moveaxis(self.effect, 2, 0)]
        return np.concatenate([values, np.stack(each, 1)], 1)

    def weighed(self, values: Array) -> Array:
        """W times values (B, 6, k, n)."""
        whole = values.copy()
        for half in np.moveaxis(self.halves, 2, 0):
            whole -= half[:, :, None] * np.sum(half[:, :, None] * values, 1, keepdims=True)
        return whole

    @cached_property
    def score(self) -> Array:
        """W times what is left, as the effects see it (B, 6 + e, n)."""
        return self.seen(self.weighed(self.left[:, :, None]))[:, :, 0]

    @cached_property
    def pull(self) -> Array:
        """XᵀW times what is left, and the pull of what is known beforehand (B, u)."""
        pairs = zip(self.courses, np.moveaxis(self.score, 1, 0), strict=True)
        pull = np.concatenate([(course @ v[..., None])[..., 0] for course, v in pairs], -1)
        pull[:, self.size :] -= self.precision * self.held
        return pull

    def along(self, values: Array) -> Array:
        """All courses (B, u, a n) times values (B, 6 + e, a, n) of their effects."""
        batch, _, count, stations = values.shape
        along = np.empty((batch, self.places[-1].stop, count, stations))
        for place, (at, course) in enumerate(zip(self.places, self.courses, strict=True)):
            np.multiply(course[:, :, None], values[:, place, None], out=along[:, at])
        return along.reshape(*along.shape[:2], -1)

    @cached_property
    def halved(self) -> Array:
        """XᵀP (B, u, a n)."""
        return self.along(self.seen_halves)

    def products(self, rows: slice) -> Array:
        """Sums XᵀX (B, u, u) over the readings of some axes."""
        size, each = self.places[-1].stop, np.moveaxis(self.effect, 2, 0)
        whole = np.zeros((len(self.left), size, size))
        for axis in range(*rows.indices(6)):
            whole[:, self.places[axis], self.places[axis]] = (
                self.courses[axis] @ self.courses[axis].mT
            )
        for place, effect in enumerate(each, 6):
            at, course = self.places[place], self.courses[place]
            for axis in range(*rows.indices(6)):
                if effect[:, axis].any():
                    across = self.courses[axis] @ (course * effect[:, axis, None]).mT
                    whole[:, self.places[axis], at], whole[:, at, self.places[axis]] = (
                        across,
                        across.mT,
                    )
            for other, partner in enumerate(each[: place - 5], 6):
                both = np.sum(effect[:, rows] * partner[:, rows], 1)
                if both.any():
                    across = self.courses[other] @ (course * both[:, None]).mT
                    whole[:, self.places[other], at], whole[:, at, self.places[other]] = (
                        across,
                        across.mT,
                    )
        return whole

    @cached_property
    def of_data(self) -> Array:
        """XᵀWX (B, u, u)."""
        return np.asarray(self.products(slice(None)) - self.halved @ self.halved.mT)

    @cached_property
    def information(self) -> Array:
        """The same, with what is known beforehand."""
        whole = self.of_data.copy()
        np.einsum("bii->bi", whole)[:, self.size :] += self.precision
        return whole

    @cached_property
    def covariance(self) -> Array:
        """The inverse of the information (B, u, u); by halves it would be less exact where drifts are large."""
        with np.errstate(invalid="ignore"):  # by rounding a square may be below zero
            scale = outer(np.sqrt(diagonal(self.information)))
        return inverse(self.information / scale) / scale

    @cached_property
    def of_angles(self) -> Array:
        """XᵀWGGᵀWX (B, u, u), the information less that with W² instead of W."""
        each, count = self.seen_halves.copy(), self.gain.shape[2]
        for k in reversed(range(count)):  # P L⁻¹
            for j in range(k + 1, count):
                each[:, :, k] -= self.factor[:, None, j, k] * each[:, :, j]
            each[:, :, k] /= self.factor[:, None, k, k]
        moved = self.along(each)
        return np.asarray(moved @ moved.mT)

    @cached_property
    def squared(self) -> tuple[Array, Array]:
        """XᵀWEWX (B, u, u), E being one for the readings of a triad and zero for those of the other."""
        rows = TRIAD_ROWS[0]
        first = self.halves.copy()
        first[:, TRIAD_ROWS[1]] = 0.0
        gram = np.einsum("brkn,brjn->bkjn", self.halves[:, rows], self.halves[:, rows])
        each = self.seen(first) - 0.5 * np.einsum("bekn,bkjn->bejn", self.seen_halves, gram)
        mixed = self.along(each) @ self.halved.mT
        one = self.products(rows) - mixed - mixed.mT
        return one, self.of_data - self.of_angles - one

    @cached_property
    def weight(self) -> Array:
        """W (B, n, 6, 6)."""
        halves = np.ascontiguousarray(np.moveaxis(self.halves, -1, 1))
        return np.asarray(np.eye(6) - halves @ halves.mT)

    @cached_property
    def spread(self) -> Array:
        """W - WXVXᵀW (B, n, 6, 6), the covariance of the weighed residuals of each station."""
        count = len(self.courses)
        inner = np.empty((len(self.left), self.left.shape[-1], count, count))
        for place, (at, course) in enumerate(zip(self.places, self.courses, strict=True)):
            moved = self.covariance[:, : at.stop, at] @ course
            for other, partner in enumerate(self.courses[: place + 1]):
                both = np.sum(partner * moved[:, self.places[other]], 1)
                inner[..., place, other] = inner[..., other, place] = both
        moved = self.weight
        if self.effect.shape[2]:
            effects = np.ascontiguousarray(np.moveaxis(self.effect, -1, 1))
            moved = np.concatenate([self.weight, self.weight @ effects], -1)
        return np.asarray(self.weight - moved @ inner @ moved.mT)

    def walk_sums(
        self, axes: Sequence[tuple[int, int]], terms: Array
    ) -> tuple[Array, Array, Array]:
        """Of unit walks, terms (n, K) on some axes: score (B, a, K), XᵀWD (B, u, a, K) and DᵀWD (B, a, a, K, K)."""
        effect = _walk_effects(axes, self.root, self.louder, self.shares, self.attitude)
        weighed, batch, count = self.weighed(effect), len(effect), len(axes)
        score = np.sum(effect * self.score[:, :6, None], 1) @ terms
        pairs = zip(self.courses, np.moveaxis(self.seen(weighed), 1, 0), strict=True)
        crossed = [(course[:, :, None] * each[:, None]) @ terms for course, each in pairs]
        squares = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
        alone = np.sum(effect[:, :, :, None] * weighed[:, :, None], 1) @ squares
        alone = alone.reshape(batch, count, count, *2 * terms.shape[1:])
        return score, np.concatenate(crossed, 1), alone

    def with_courses(self, courses: Array) -> tuple[Array, Array]:
        """Information (B, u + k, u + k) and pull with six more unknowns of each triad for each of some courses.

        The courses (B, c, n) come one by one, and of each the gains and the offsets of a triad as shares of its vector;
        nothing is known of them beforehand.
        """
        batch, count, stations = courses.shape
        u, k = len(self.pull[0]), 12 * count
        cross, along = np.zeros((batch, u, k)), np.empty((batch, k, self.halved.shape[-1]))
        inner, pull = np.zeros((batch, k, k)), np.empty((batch, k))
        for index, (rows, shares) in enumerate(zip(TRIAD_ROWS, self.shares, strict=True)):
            vector = self.vector[:, rows]
            strength = np.sqrt(np.sum(vector * vector, 1, keepdims=True))
            each = np.stack([vector, np.broadcast_to(strength, vector.shape)], 1)
            turned = self.louder[:, None, rows] * shares.mT[..., None]
            steady = (each[:, :, :, None] * turned[:, None]).reshape(batch, 1, 6, 3, stations)
            columns = (steady * courses[:, :, None, None]).reshape(batch, -1, 3, stations)
            at = (12 * np.arange(count)[:, None] + 6 * index + np.arange(6)).ravel()
            seen = np.sum(columns[:, :, :, None] * self.halves[:, None, rows], 2)
            along[:, at] = seen.reshape(batch, at.size, -1)
            for axis in range(3):
                place = rows.start + axis
                cross[:, self.places[place], at] = self.courses[place] @ columns[:, :, axis].mT
            for place, effect in enumerate(np.moveaxis(self.effect, 2, 0), 6):
                both = np.sum(columns * effect[:, None, rows], 2)
                cross[:, self.places[place], at] = self.courses[place] @ both.mT
            flat = columns.reshape(batch, at.size, -1)
            inner[:, at[:, None], at] = flat @ flat.mT
            pull[:, at] = (flat @ self.score[:, rows].reshape(batch, -1, 1))[..., 0]
        cross -= self.halved @ along.mT
        inner -= along @ along.mT
        whole = np.block([[self.information, cross], [cross.mT, inner]])
        return whole, np.concatenate([self.pull, pull], -1)

    def step(self, covariance: Array) -> tuple[Array, Array]:
        """Step (B, u) by a covariance, and the square of its length (B,) in σ."""
        step = (covariance @ self.pull[..., None])[..., 0]
        return step, np.sum(step * self.pull, -1)

    def errors(self, step: Array) -> Array:
        """Errors (B, 3, n) of the angles that stations have for themselves, after a step (B, u)."""
        pairs = zip(self.places, self.courses, strict=True)
        moved = np.concatenate([step[:, None, at] @ course for at, course in pairs], 1)
        left, count = self.left - moved[:, :6], self.gain.shape[2]
        if self.effect.shape[2]:
            left -= np.sum(self.effect * moved[:, None, 6:], 2)
        along = np.sum(self.halves * left[:, :, None], 1)
        for k in reversed(range(count)):
            for j in range(k + 1, count):
                along[:, k] -= self.factor[:, j, k] * along[:, j]
            along[:, k] /= self.factor[:, k, k]
        errors = np.zeros((len(left), 3, left.shape[-1]))
        errors[:, self.active] = along * self.sd
        return errors


def minimum(problem: Problem, begin: State | None = None) -> tuple[State, Ints, Ints]:
    """States at the minimum, `Status` codes and numbers of steps; what does not settle goes the general way.

    From a state, or else from the minimum at exact angles.
    """
    state = begin or start(problem)
    runs, point = AxisRuns.of(problem), AxisPoint.of(problem, state)
    steps, good = np.zeros(len(runs.root), int), np.zeros(len(runs.root), bool)
    active, whole, covariance = np.arange(len(good)), point, None
    for count in range(1, MOST_AXIS_STEPS + 1):
        if not active.size:
            break
        here = runs.at(point)
        if covariance is None or count > STEPS_BY_ONE:
            covariance = here.covariance
        step, square = here.step(covariance)
        point = point.moved(step, here.errors(step))
        steps[active] = count
        done = square < LAST_AXIS_STEP
        if done.any():
            good[active[done]] = True
            at = np.flatnonzero(done)
            whole = put(whole, active[at], take(point, at))
            rest = np.flatnonzero(~done)
            active = active[rest]
            runs, point, covariance = take(runs, rest), take(point, rest), covariance[rest]
    ended = whole.state(problem, state)
    good &= np.isfinite(ended.params).all(-1)
    good &= determined(problem, ended).clear
    status = np.full(len(good), int(Status.OK))
    if not good.all():
        rest = np.flatnonzero(~good)
        some = take(problem, rest)
        general = take(begin, rest) if begin else general_start(some)
        general, status[rest], steps[rest] = gauss_newton(some, general)
        ended = put(ended, rest, general)
    return ended, status, steps


def stepped(problem: Problem, state: State) -> State:
    """The state after one full step, whatever it does to the cost."""
    here = linear(problem, state)
    step, _ = here.step(here.covariance)
    point = AxisPoint.of(problem, state).moved(step, here.errors(step))
    return point.state(problem, state)


def linear(problem: Problem, state: State) -> AxisLinear:
    """The problem linearised at a state; the last answer is kept."""
    return problem.once(
        "by axis", state, lambda _: AxisRuns.of(problem).at(AxisPoint.of(problem, state))
    )


def analysed(problem: Problem, state: State, known: Determined) -> Analysis:
    """The analysis of fits with all directions determined, as `analyse` has it."""
    at, include = linear(problem, state), problem.evidence.include
    p, q = at.size, len(problem.evidence.constants)
    whole = _in_parameters(problem, state, at.covariance)
    spread = at.spread * include[..., None, None]
    residual = np.ascontiguousarray(at.score[:, :6].mT)
    return Analysis(
        whole[:, :p, :p],
        known,
        *variance_factors(residual, spread),
        residual,
        spread,
        whole[:, p : p + q, p : p + q],
        effects_of(problem, whole[:, :p, p : p + q]),
        whole[:, :p, p + q :],
    )


def completed(problem: Problem, state: State, analysis: Analysis) -> Analysis:
    """The analysis that `analysed` gives with all that can be known of it."""
    at, include, squares = linear(problem, state), problem.evidence.include, []
    for index, squared in enumerate(at.squared):
        rows = (..., slice(3 * index, 3 * index + 3), slice(3 * index, 3 * index + 3))
        weight, part = at.weight[rows] * include[..., None, None], squared @ at.covariance
        alone = np.sum(weight * (2 * analysis.spread[rows] - weight), (1, 2, 3))
        squares.append(alone + np.sum(part * part.mT, (1, 2)))
    of_stand = _in_parameters(problem, state, at.covariance @ at.of_angles @ at.covariance)
    p = at.size
    return replace(analysis, squares=np.stack(squares, -1), of_stand=of_stand[:, :p, :p])


def _in_parameters(problem: Problem, state: State, covariance: Array) -> Array:
    """A covariance (B, u, u) of the unknowns by axis as that of the parameters, the others as they are."""
    whole = covariance.copy()
    for triad, where in zip(problem.triads, problem.slices(), strict=True):
        moved = moved_params(triad, unknowns_of(triad, state.params[:, where]))
        whole[:, where] = moved @ whole[:, where]
        whole[:, :, where] = whole[:, :, where] @ moved.mT
    return whole


def start(problem: Problem) -> State:
    """The minimum at the known angles, as if these were exact."""
    at = closed_form.start(problem)
    each, include = [], problem.evidence.include
    for triad, target in zip(problem.triads, problem.targets(at), strict=True):
        phi = triad.model.basis(problem.temperature)
        axes = Axes.of(phi, target, triad.raw, triad.sd, include)
        each.append(params_of(triad, lone_minimum(axes).unknowns))
    return replace(at, params=np.concatenate(each, -1))


def determined(problem: Problem, state: State) -> Determined:
    """Which directions of the parameters are determined at a state, by the geometry of its references.

    The last answer is kept.
    """
    return problem.once("determined factors", state, lambda _: _determined(problem, state))


def _determined(problem: Problem, state: State) -> Determined:
    bare = replace(state, errors=0 * state.errors, settings=0 * state.settings)
    known, include = [], problem.evidence.include
    targets = problem.targets(bare)
    for triad, where, target in zip(problem.triads, problem.slices(), targets, strict=True):
        unknowns = unknowns_of(triad, state.params[:, where])
        if isinstance(triad.model, Factors):
            phi = triad.model.basis(problem.temperature)
            axes = Axes.of(phi, target, triad.raw, triad.sd, include)
            known.append(known_at(axes, unknowns))
        else:
            terms = np.concatenate([target, np.ones_like(target[..., :1])], -1)
            forward = _forward(unknowns)
            turn = closed_form.centred_parts(triad, forward)[1]
            known.append(closed_form.known_at(include[..., None], terms, forward, turn))
    return closed_form.determined_by(known)
