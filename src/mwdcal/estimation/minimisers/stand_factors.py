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
from itertools import pairwise

import numpy as np

from mwdcal.estimation.batch import put, take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.minimisers.closed_form_factors import OTHERS, Axes, factors, known_at
from mwdcal.estimation.minimisers.closed_form_factors import minimum as lone_minimum
from mwdcal.estimation.minimisers.uncertain_stand import FIELD_WALK, StandRuns
from mwdcal.estimation.problem import WALK_AXES, Problem, State, Triad
from mwdcal.estimation.solvers import Determined, Status, gauss_newton
from mwdcal.estimation.start import start as general_start
from mwdcal.estimation.uncertainty import Analysis, effects_of, variance_factors
from mwdcal.geometry.vectors import Array, Ints, diagonal, inverse, outer, quotient
from mwdcal.sensor.models import Factors, Polynomial, affine_parts, factor_parts

MOST_AXIS_STEPS = 12
"""Most steps of a fit: a member that has not settled then goes the general way."""
STEPS_BY_ONE = 6
"""First steps that are taken by one matrix; those of members that have not settled have their own."""
LAST_AXIS_STEP = 1e-12
"""Square of the last step, in standard uncertainties."""


def applies(problem: Problem) -> bool:
    """Whether all angles are known, and nothing but their errors, the sensors' and drifts are to be found."""
    found = problem.evidence
    return (
        len(problem.triads) == 2
        and any(isinstance(t.model, Factors) for t in problem.triads)
        and all(_is_affine(t) or isinstance(t.model, Factors) for t in problem.triads)
        and not (found.absent or found.scatter or found.members.size)
        and bool(found.referenced.all())
        and not problem.prior.precision.any()
        and all(constant.name in WALK_AXES for constant in found.constants)
    )


def _is_affine(triad: Triad) -> bool:
    model = triad.model
    return isinstance(model, Polynomial) and not (model.basis.order or model.curved)


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


def _length(vector: Array) -> Array:
    """Lengths (B, 1, n) of vectors (B, 3, n)."""
    return np.asarray(np.sqrt(np.sum(vector * vector, 1, keepdims=True)))


# --------------------------------------------------------------------------
# AxisRuns linearised at a point. Arrays are (B, component, n).


@dataclass(frozen=True)
class AxisRuns:
    """Constants of the iteration: references, φ (B, K, n) of each triad, readings and 1/noise (B, 6, n).

    `lone` (B, 3, n) and `together` (B, 2k, n) are σ of the angles of each station and of each setting; `masks`
    (B, q, n) the terms of drifts, of `precision` (B, q), that act on the `axes` (q) of walks.
    """

    stand: StandRuns
    phi: tuple[Array, ...]
    raw: Array
    root: Array
    lone: Array
    together: Array
    masks: Array
    precision: Array
    axes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, problem: Problem) -> AxisRuns:
        """Of a problem."""
        found, triads = problem.evidence, problem.triads
        bare = replace(problem, evidence=replace(found, constants=()))
        stand = StandRuns.of(bare)
        phi = tuple(t.model.basis(problem.temperature).mT for t in triads)
        constants = found.constants
        masks = np.zeros((len(stand.raw), len(constants), stand.raw.shape[-1]))
        precision = np.zeros(masks.shape[:2])
        for index, constant in enumerate(constants):
            masks[:, index], precision[:, index] = constant.mask, constant.sd**-2.0
        axes = tuple(WALK_AXES[constant.name] for constant in constants)
        return cls(
            replace(stand, angle_sd=np.ones_like(stand.angles)),
            phi,
            stand.raw,
            found.include[:, None] / stand.sd,
            found.turn_sd.mT,
            found.set_together.mT,
            masks,
            precision,
            axes,
        )

    def at(self, point: AxisPoint) -> AxisLinear:
        """Linearised at a point."""
        count = self.together.shape[1] // 2
        common = self.together * point.settings[..., None]
        total = point.errors.copy()
        for angle in range(2):
            total[:, angle] += common[:, angle * count : (angle + 1) * count].sum(1)
        f, change, attitude = self.stand.vectors(total)
        shares = tuple(_shares(unknowns) for unknowns in point.unknowns)
        rows, gains, seen, vectors, louds = [], [], [], [], []
        for index, (phi, unknowns) in enumerate(zip(self.phi, point.unknowns, strict=True)):
            three = slice(3 * index, 3 * index + 3)
            root, size = self.root[:, three], phi.shape[1]
            v = np.moveaxis(f[index, :3], 0, 1)
            beside = np.empty((*v.shape[:2], size + 2, v.shape[-1]))
            beside[:, :, :2], beside[:, :, 2:] = v[:, OTHERS], phi[:, None]
            scale = unknowns[..., :size] @ phi
            unit = v + (unknowns[..., None, size:] @ beside)[..., 0, :]
            louder = scale * root
            seen.append(louder * unit)
            vectors.append(v)
            louds.append(louder)
            by = (unit * root)[:, :, None] * phi[:, None], louder[:, :, None] * beside
            rows.append(np.concatenate(by, 2))
            turns = np.moveaxis(change[index], 2, 0).reshape(len(v), 3, -1)
            turned = (shares[index] @ turns).reshape(*v.shape[:2], 3, -1)
            gains.append(turned * louder[:, :, None])
        gain = np.concatenate(gains, 1)
        settings = [
            gain[:, :, angle, None] * part[:, None]
            for angle, part in enumerate(np.split(self.together, 2, 1))
        ]
        left = self.raw * self.root - np.concatenate(seen, 1)
        active = np.flatnonzero(self.lone.any((0, 2)))
        sd, errors = self.lone[:, active], point.errors[:, active]
        own = gain[:, :, active] * sd[:, None]
        left += np.sum(own * quotient(errors, sd, sd > 0)[:, None], 2)
        here = AxisLinear(
            tuple(rows), np.concatenate(settings, 2), own, left, point.settings,
            np.ones(point.settings.shape), sd, active, np.concatenate(vectors, 1),
            np.concatenate(louds, 1), shares, self.root, attitude,
        )  # fmt: skip
        return here.with_walks(self.axes, self.masks, point.constants, self.precision)


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
        at, each = 0, []
        for unknowns in self.unknowns:
            size = unknowns[0].size
            each.append(unknowns + step[:, at : at + size].reshape(unknowns.shape))
            at += size
        q = at + self.constants.shape[-1]
        return AxisPoint(
            tuple(each), errors, self.constants + step[:, at:q], self.settings + step[:, q:]
        )


@dataclass(frozen=True)
class AxisLinear:
    """AxisRuns at a point: `rows` (B, 3, 2K + 2, n) of each triad, other columns (B, 6, q, n), and `left` (B, 6, n).

    `own` (B, 6, a, n) is what one σ of each angle that a station has for itself does, of the `active` ones. `held`
    and `precision` (B, q) are values of the others, and what is known of them. A reading over its noise is `louder`
    (B, 6, n) times the row of `shares` (B, 3, 3) times the vector (B, 6, n), and what is added to it.
    """

    rows: tuple[Array, ...]
    others: Array
    own: Array
    left: Array
    held: Array
    precision: Array
    sd: Array
    active: Ints
    vectors: Array
    louder: Array
    shares: tuple[Array, ...]
    root: Array
    attitude: Array

    @cached_property
    def factor(self) -> Array:
        """L (B, a, a, n), lower, of L Lᵀ = 1 + GᵀG."""
        gain, count = self.own, self.own.shape[2]
        factor = np.zeros((len(gain), count, count, gain.shape[-1]))
        for k in range(count):
            for j in range(k + 1):
                gram = np.sum(gain[:, :, k] * gain[:, :, j], 1)
                product = gram - np.sum(factor[:, k, :j] * factor[:, j, :j], 1)
                factor[:, k, j] = np.sqrt(1 + product) if j == k else product / factor[:, j, j]
        return factor

    @cached_property
    def halves(self) -> Array:
        """P (B, 6, a, n)."""
        halves = np.empty_like(self.own)
        for k in range(self.own.shape[2]):
            rest = self.own[:, :, k].copy()
            for j in range(k):
                rest -= halves[:, :, j] * self.factor[:, None, k, j]
            halves[:, :, k] = rest / self.factor[:, None, k, k]
        return halves

    def weighed(self, values: Array) -> Array:
        """W times values (B, 6, n)."""
        return np.asarray(values - np.sum(self.halves * self._along(values)[:, None], 2))

    def _along(self, values: Array) -> Array:
        """Pᵀ (B, a, n) times values (B, 6, n)."""
        return np.asarray(np.sum(self.halves * values[:, :, None], 1))

    @cached_property
    def pull(self) -> Array:
        """XᵀW times what is left, and the pull of what is known beforehand (B, u)."""
        values, batch = self.weighed(self.left), len(self.left)
        each = [
            (rows @ values[:, 3 * t : 3 * t + 3, :, None]).reshape(batch, -1)
            for t, rows in enumerate(self.rows)
        ]
        flat = np.swapaxes(self.others, 1, 2).reshape(
            batch, self.others.shape[2], 6 * self.left.shape[-1]
        )
        others = (flat @ values.reshape(batch, -1, 1))[..., 0] - self.precision * self.held
        return np.concatenate([*each, others], -1)

    @cached_property
    def places(self) -> list[slice]:
        """Where the unknowns of each of the six axes lie."""
        ends = np.cumsum([0, *(rows.shape[2] for rows in self.rows for _ in range(3))]).tolist()
        return [slice(*pair) for pair in pairwise(ends)]

    @cached_property
    def along(self) -> Array:
        """XᵀP (B, u, a n)."""
        batch, stations = len(self.left), self.left.shape[-1]
        q, count, size = self.others.shape[2], self.own.shape[2], self.places[-1].stop
        along = np.empty((batch, size + q, count, stations))
        for axis, at in enumerate(self.places):
            part = self.rows[axis // 3][:, axis % 3]
            np.multiply(part[:, :, None], self.halves[:, axis, None], out=along[:, at])
        if q:
            each = self.others.swapaxes(1, 2)[:, :, :, None] * self.halves[:, None]
            np.sum(each, 2, out=along[:, size:])
        return along.reshape(batch, size + q, count * stations)

    def products(self, axes: range) -> Array:
        """Sums XᵀX (B, u, u) over some of the six axes."""
        batch, size, q = len(self.left), self.places[-1].stop, self.others.shape[2]
        whole = np.zeros((batch, size + q, size + q))
        for axis in axes:
            part, at = self.rows[axis // 3][:, axis % 3], self.places[axis]
            whole[:, at, at] = part @ part.mT
            if q:
                across = part @ self.others[:, axis].mT
                whole[:, at, size:], whole[:, size:, at] = across, across.mT
        if q:
            some = self.others[:, axes.start : axes.stop].swapaxes(1, 2).reshape(batch, q, -1)
            whole[:, size:, size:] = some @ some.mT
        return whole

    @cached_property
    def of_data(self) -> Array:
        """XᵀWX (B, u, u)."""
        return np.asarray(self.products(range(6)) - self.along @ self.along.mT)

    @cached_property
    def information(self) -> Array:
        """The same, with what is known beforehand."""
        whole = self.of_data.copy()
        size = self.places[-1].stop
        np.einsum("bii->bi", whole)[:, size:] += self.precision
        return whole

    @cached_property
    def of_angles(self) -> Array:
        """XᵀW G GᵀW X (B, u, u): information that errors of angles are part of."""
        batch, u = self.along.shape[:2]
        count, stations = self.own.shape[2], self.own.shape[-1]
        each = self.along.reshape(batch, u, count, stations).copy()
        for k in reversed(range(count)):  # P L⁻¹
            for j in range(k + 1, count):
                each[:, :, k] -= self.factor[:, None, j, k] * each[:, :, j]
            each[:, :, k] /= self.factor[:, None, k, k]
        flat = each.reshape(self.along.shape)
        return np.asarray(flat @ flat.mT)

    @cached_property
    def squared(self) -> tuple[Array, Array]:
        """XᵀW E W X (B, u, u), E being one for the readings of a triad and zero for those of the other."""
        batch, u = self.along.shape[:2]
        count, stations = self.own.shape[2], self.own.shape[-1]
        gram = np.einsum("brkn,brjn->bkjn", self.halves[:, :3], self.halves[:, :3])
        along = self.along.reshape(batch, u, count, stations)
        part = -0.5 * np.einsum("bukn,bkjn->bujn", along, gram)
        size, own = self.places[-1].stop, self.places[2].stop
        part[:, :own] += along[:, :own]
        if self.others.shape[2]:
            others = self.others[:, :3].swapaxes(1, 2)[:, :, :, None]
            part[:, size:] += np.sum(others * self.halves[:, None, :3], 2)
        mixed = part.reshape(self.along.shape) @ self.along.mT
        first = self.products(range(3)) - mixed - mixed.mT
        return first, self.of_data - self.of_angles - first

    @cached_property
    def covariance(self) -> Array:
        """Its inverse (B, u, u)."""
        scale = outer(np.sqrt(diagonal(self.information)))
        return inverse(self.information / scale) / scale

    @cached_property
    def weight(self) -> Array:
        """W (B, n, 6, 6)."""
        halves = np.ascontiguousarray(np.moveaxis(self.halves, -1, 1))
        return np.asarray(np.eye(6) - halves @ halves.mT)

    @cached_property
    def spread(self) -> Array:
        """W - W X V Xᵀ W (B, n, 6, 6), the covariance of the weighed residuals of each station."""
        batch, stations, size = len(self.left), self.left.shape[-1], self.places[-1].stop
        inner = np.empty((batch, stations, 6, 6))
        for axis, at in enumerate(self.places):
            part = self.rows[axis // 3][:, axis % 3]
            moved = self.covariance[:, :, at] @ part
            if self.others.shape[2]:
                moved += self.covariance[:, :, size:] @ self.others[:, axis]
            for other, here in enumerate(self.places[: axis + 1]):
                both = np.sum(self.rows[other // 3][:, other % 3] * moved[:, here], 1)
                if self.others.shape[2]:
                    both += np.sum(self.others[:, other] * moved[:, size:], 1)
                inner[..., axis, other] = inner[..., other, axis] = both
        return np.asarray(self.weight - self.weight @ inner @ self.weight)

    def walk_axes(self, axes: Sequence[tuple[int, int]]) -> Array:
        """Effect (B, 6, a, n) on the readings of a unit of some axes of walks, by the numbers of both."""
        effect = np.zeros((len(self.root), 6, len(axes), self.root.shape[-1]))
        for place, (walk, axis) in enumerate(axes):
            if walk < FIELD_WALK:
                effect[:, 3 * walk + axis, place] = self.root[:, 3 * walk + axis]
            else:
                along = np.moveaxis(self.attitude[:, axis], 0, 1)
                effect[:, 3:, place] = (self.shares[1] @ along) * self.louder[:, 3:]
        return effect

    def with_walks(
        self, axes: Sequence[tuple[int, int]], masks: Array, value: Array, precision: Array
    ) -> AxisLinear:
        """The same with terms of walks, (B, q, n) on so many axes, at a value and known to a precision (B, q)."""
        if not axes:
            return self
        each = list(dict.fromkeys(axes))
        effect = self.walk_axes(each)[:, :, [each.index(axis) for axis in axes]] * masks[:, None]
        return replace(
            self,
            others=np.concatenate([effect, self.others], 2),
            left=self.left - (value[:, None, None] @ effect)[:, :, 0],
            held=np.concatenate([value, self.held], -1),
            precision=np.concatenate([precision, self.precision], -1),
        )

    def walk_sums(
        self, axes: Sequence[tuple[int, int]], terms: Array
    ) -> tuple[Array, Array, Array]:
        """Of unit walks, terms (n, K) on some axes: score (B, a, K), XᵀWD (B, u, a, K) and DᵀWD (B, a, a, K, K)."""
        effect, batch = self.walk_axes(axes), len(self.root)
        count, stations, size = len(axes), len(terms), self.places[-1].stop
        along = np.sum(self.halves[:, :, :, None] * effect[:, :, None], 1)
        weighed = effect - np.sum(self.halves[:, :, :, None] * along[:, None], 2)
        score = np.sum(effect * self.weighed(self.left)[:, :, None], 1) @ terms
        crossed = np.empty((batch, size + self.others.shape[2], count, terms.shape[-1]))
        for axis, at in enumerate(self.places):
            part = self.rows[axis // 3][:, axis % 3]
            product = part[:, :, None] * weighed[:, axis, None]
            crossed[:, at] = product @ terms
        if self.others.shape[2]:
            product = np.sum(self.others[:, :, :, None] * weighed[:, :, None], 1)
            crossed[:, size:] = product @ terms
        pairs = (terms[:, :, None] * terms[:, None]).reshape(stations, -1)
        alone = np.sum(effect[:, :, :, None] * weighed[:, :, None], 1) @ pairs
        return score, crossed, alone.reshape(batch, count, count, *2 * terms.shape[1:])

    def with_courses(self, courses: Array) -> tuple[Array, Array]:
        """Information (B, u + k, u + k) and pull with six more unknowns of each triad for each of some courses.

        The courses (B, c, n) come one by one, and of each the gains and the offsets of a triad as shares of its vector;
        nothing is known of them beforehand.
        """
        batch, count, stations = courses.shape
        size, u, k = self.places[-1].stop, len(self.information[0]), 12 * count
        cross, along = np.zeros((batch, u, k)), np.empty((batch, k, self.along.shape[-1]))
        inner, pull = np.zeros((batch, k, k)), np.empty((batch, k))
        left = self.weighed(self.left)
        for index, shares in enumerate(self.shares):
            three = slice(3 * index, 3 * index + 3)
            vector = self.vectors[:, three]
            each = np.stack([vector, np.broadcast_to(_length(vector), vector.shape)], 1)
            turned = self.louder[:, None, three] * shares.mT[..., None]
            steady = (each[:, :, :, None] * turned[:, None]).reshape(batch, 1, 6, 3, stations)
            columns = (steady * courses[:, :, None, None]).reshape(batch, -1, 3, stations)
            at = (12 * np.arange(count)[:, None] + 6 * index + np.arange(6)).ravel()
            seen = np.sum(columns[:, :, :, None] * self.halves[:, None, three], 2)
            along[:, at] = seen.reshape(batch, at.size, -1)
            for axis in range(3):
                place = self.places[3 * index + axis]
                cross[:, place, at] = self.rows[index][:, axis] @ columns[:, :, axis].mT
            flat = columns.reshape(batch, at.size, -1)
            if u > size:
                others = self.others[:, three].swapaxes(1, 2).reshape(batch, u - size, -1)
                cross[:, size:, at] = others @ flat.mT
            inner[:, at[:, None], at] = flat @ flat.mT
            pull[:, at] = (flat @ left[:, three].reshape(batch, -1, 1))[..., 0]
        cross -= self.along @ along.mT
        inner -= along @ along.mT
        whole = np.block([[self.information, cross], [cross.mT, inner]])
        return whole, np.concatenate([self.pull, pull], -1)

    def step(self, covariance: Array) -> tuple[Array, Array]:
        """Step (B, u) by a covariance, and the square of its length (B,) in σ."""
        step = (covariance @ self.pull[..., None])[..., 0]
        return step, np.sum(step * self.pull, -1)

    def errors(self, step: Array) -> Array:
        """Errors (B, 3, n) of the angles that stations have for themselves, after a step (B, u)."""
        left, first = self.left.copy(), 0
        for t, rows in enumerate(self.rows):
            size = 3 * rows.shape[2]
            part = step[:, first : first + size].reshape(-1, 3, 1, rows.shape[2])
            left[:, 3 * t : 3 * t + 3] -= (part @ rows)[:, :, 0]
            first += size
        left -= (step[:, None, None, first:] @ self.others)[:, :, 0]
        along, count = self._along(left), self.own.shape[2]
        errors = np.zeros((len(left), 3, left.shape[-1]))
        for k in reversed(range(count)):
            for j in range(k + 1, count):
                along[:, k] -= self.factor[:, j, k] * along[:, j]
            along[:, k] /= self.factor[:, k, k]
        errors[:, self.active] = along * self.sd
        return errors


def minimum(problem: Problem, begin: State | None = None) -> tuple[State, Ints, Ints]:
    """States at the minimum, `Status` codes and numbers of steps; what does not settle goes the general way.

    From a state, or else from the minimum at exact angles.
    """
    state = begin or start(problem)
    runs, point = AxisRuns.of(problem), AxisPoint.of(problem, state)
    steps, good = np.zeros(len(runs.raw), int), np.zeros(len(runs.raw), bool)
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
        found, status[rest], steps[rest] = gauss_newton(some, general)
        ended = put(ended, rest, found)
    return ended, status, steps


def linear(problem: Problem, state: State) -> AxisLinear:
    """The problem linearised at a state; the last answer is kept."""

    def found(state: State) -> AxisLinear:
        return AxisRuns.of(problem).at(AxisPoint.of(problem, state))

    return problem.once("by axis", state, found)


def analysed(problem: Problem, state: State, known: Determined) -> Analysis:
    """The analysis of fits with all directions determined, as `analyse` has it."""
    at, include = linear(problem, state), problem.evidence.include
    p, q = at.places[-1].stop, len(problem.evidence.constants)
    whole = _in_parameters(problem, state, at.covariance)
    spread = at.spread * include[..., None, None]
    residual = np.ascontiguousarray(at.weighed(at.left).mT)
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
    p = at.places[-1].stop
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
