"""Particle swarm, and the two least-squares costs of a triad against known vectors.

swarm                  the minimiser, for any cost
vector_cost            mean squared error in the field (Moradi 13) or in the reading (Moradi 12)
least_squares_forward  where the error in the reading is least: one linear solve
least_squares_affine   where the error in the field is least: another one
swarm_forward          the swarm on either cost, in coordinates that suit it

Forward parameters (..., 12) of a triad: S and o of reading = S · field + o, as `affine_parts` has them.

Moradi's equations 12 and 13 are two estimators. Each is a convex quadratic (13 in the matrix
that takes readings to fields), so swarm and least squares meet on either, and neither
estimator depends on the method that finds it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mwdcal.estimation.regression import regress
from mwdcal.geometry.vectors import Array, ArrayLike, inverse
from mwdcal.sensor.models import affine_parts, affine_terms

ACCELERATION = 2.05
"""Pull towards a particle's own best and towards the swarm's best, each."""
CONSTRICTION = 2 / (2 * ACCELERATION - 2 + np.sqrt((2 * ACCELERATION) ** 2 - 8 * ACCELERATION))
"""Factor on every velocity: 0.7298 (Clerc and Kennedy 2002, κ = 1)."""
FASTEST = 1.0
"""Largest velocity along an axis, in half widths of the box."""
DRAWN = 50
"""Iterations whose random numbers are drawn at once."""

Cost = Callable[[Array], Array]
"""Takes places (..., particles, p) to their costs (..., particles)."""
Error = Literal["field", "reading"]


@dataclass(frozen=True)
class Swarm:
    """Where a swarm ended: best position (..., p), its cost (...) and how it got there.

    `history` (..., iterations) is the best cost after each iteration.
    """

    position: Array
    cost: Array
    history: Array
    iterations: int


class _Flight:
    """Particles in units of the box, -1 to 1; all arrays are changed in place.

    Attributes:
        aims: what pulls the particles (2, tools, particles, p): own best places, and the swarm's.
        best_cost: cost (tools, particles) of the own best places.
        lowest: that of the swarm's best place (tools,).
    """

    def __init__(self, cost: Cost, place: Array, velocity: Array) -> None:
        first = cost(place)
        self.lead, shape = first.shape[:-1], place.shape
        self.best_cost = np.where(np.isfinite(first), first, np.inf).reshape(-1, len(place))
        self.tools = np.arange(len(self.best_cost))
        self.place, self.velocity = (
            np.broadcast_to(x, (len(self.tools), *shape)).copy() for x in (place, velocity)
        )
        self.seen = self.place.reshape(*self.lead, *shape)
        self.cost = cost
        self.aims = np.stack([self.place, self.place])
        self.pull = np.empty_like(self.aims)
        self._lead_on()

    def _lead_on(self) -> None:
        """Note the lowest cost and aim all particles at its place."""
        leader = self.best_cost.argmin(-1)
        self.lowest = self.best_cost[self.tools, leader]
        self.aims[1] = self.aims[0, self.tools, leader][:, None]

    def step(self, strength: Array) -> None:
        """Move all particles once, pulled to either aim with a strength (2, 1, particles, p)."""
        place, velocity, pull = self.place, self.velocity, self.pull
        np.subtract(self.aims, place, out=pull)
        pull *= strength
        velocity *= CONSTRICTION
        velocity += pull[0]
        velocity += pull[1]
        np.minimum(velocity, FASTEST, out=velocity)
        np.maximum(velocity, -FASTEST, out=velocity)
        place += velocity
        self._reflect(np.abs(place, out=pull[0]))
        cost = self.cost(self.seen).reshape(self.best_cost.shape)
        better = (cost < self.best_cost) & (cost > -np.inf)
        if better.any():
            np.copyto(self.best_cost, cost, where=better)
            np.copyto(self.aims[0], place, where=better[..., None])
            self._lead_on()

    def _reflect(self, size: Array) -> None:
        """Turn back at the bounds those that would pass them; `size` is |place|."""
        if size.max() > 1:
            outside = size > 1
            np.subtract(2 * np.sign(self.place), self.place, out=self.place, where=outside)
            np.negative(self.velocity, out=self.velocity, where=outside)


def swarm(
    cost: Cost,
    low: ArrayLike,
    high: ArrayLike,
    *,
    particles: int = 60,
    iterations: int = 600,
    seed: int = 0,
) -> Swarm:
    """Minimise a cost inside a box with a swarm of particles.

    Definition: v ← χ [v + 2.05 r₁ (own best - x) + 2.05 r₂ (swarm's best - x)], x ← x + v,
    χ = 0.7298, r₁ and r₂ drawn from 0 to 1 per particle and axis; every particle knows the
    whole swarm's best. Velocity is clamped to half the width of the box; at a bound position
    and velocity are reflected. Places start uniform in the box, velocities uniform up to half
    the clamp. It always runs all its iterations: a best cost that stays the same for a while
    says nothing about convergence. No gradient and no local search is used.

    Shapes: `low`, `high` (..., p); `cost` takes places (..., particles, p) to (..., particles).
    Leading axes are tools. All tools share the random numbers, so a tool in a batch takes the
    path that it takes alone; equal seeds give equal results.
    Singular: a cost that is not finite counts as infinite; where all are, the cost returned is
    infinite and the position means nothing.
    Reference: M. Clerc, J. Kennedy (2002), IEEE Trans. Evol. Comput. 6 (1), 58-73; 60 particles
    and 600 iterations are Moradi's.
    """
    low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
    middle, half = (low + high)[..., None, :] / 2, (high - low)[..., None, :] / 2

    def boxed(place: Array) -> Array:
        return cost(middle + half * place)

    random = np.random.default_rng(seed)
    shape = (particles, low.shape[-1])
    place, velocity = random.uniform(-1, 1, (2, *shape))
    flight = _Flight(boxed, place, velocity * FASTEST / 2)
    history = np.empty((len(flight.tools), iterations))
    for first in range(0, iterations, DRAWN):
        strength = random.random((min(DRAWN, iterations - first), 2, 1, *shape))
        strength *= CONSTRICTION * ACCELERATION
        for index, one in enumerate(strength, first):
            flight.step(one)
            history[:, index] = flight.lowest
    lead = flight.lead
    leader = flight.aims[1].reshape(*lead, *shape)[..., :1, :]
    position = (middle + half * leader)[..., 0, :]
    return Swarm(
        position, flight.lowest.reshape(lead), history.reshape(*lead, iterations), iterations
    )


def vector_cost(raw: Array, reference: Array, error: Error = "field") -> Cost:
    """Mean squared length of the error over the stations, as a function of forward parameters.

    Definition: error in the field (Moradi 13): S⁻¹ (reading - o) - reference;
    error in the reading (Moradi 12): reading - S · reference - o.
    Units: those of the reference, or of the readings, squared.
    Shapes: `raw`, `reference` (..., n, 3); the cost takes (..., particles, 12) to
    (..., particles).
    Singular: NaN in the field where S has no inverse.
    """
    readings, known = raw[..., None, :, :], reference[..., None, :, :]

    def in_reading(params: Array) -> Array:
        matrix, offset = affine_parts(params)
        return (readings - offset[..., None, :]) - known @ matrix.mT

    def in_field(params: Array) -> Array:
        matrix, offset = affine_parts(params)
        back = inverse(matrix).mT
        return (readings - offset[..., None, :]) @ back - known

    misfit = {"field": in_field, "reading": in_reading}[error]

    def cost(params: Array) -> Array:
        error = misfit(params)
        return np.asarray(np.einsum("...ni,...ni->...", error, error) / raw.shape[-2])

    return cost


def _centred(vectors: Array) -> tuple[Array, Array]:
    """Vectors (..., n, 3) about their mean, and the mean (..., 1, 3)."""
    mean = vectors.mean(-2, keepdims=True)
    return vectors - mean, mean


def least_squares_forward(raw: Array, reference: Array) -> Array:
    """Forward parameters (..., 12) with the least error in the readings (Moradi 12).

    Shapes: `raw`, `reference` (..., n, 3). Singular: as `regress`.
    """
    forward = regress(raw, reference, np.ones((*raw.shape[:-1], 1))).forward
    return affine_terms(forward[..., :3, :].mT, forward[..., 3, :])


def least_squares_affine(raw: Array, reference: Array) -> Array:
    """Forward parameters (..., 12) with the least error in the field (Moradi 13).

    Definition: field = M · reading + b by linear least squares, then S = M⁻¹, o = -M⁻¹ b. With
    noise in the readings M is a little too small, by (noise / signal)².
    Shapes and singular cases: as `least_squares_forward`.
    """
    centred, mean = _centred(raw)
    back = regress(reference, centred, np.ones((*raw.shape[:-1], 1))).forward
    matrix = inverse(back[..., :3, :].mT)
    return affine_terms(
        matrix, mean[..., 0, :] - np.einsum("...ij,...j->...i", matrix, back[..., 3, :])
    )


@dataclass(frozen=True)
class Coordinates:
    """Centred and whitened coordinates u (..., 12) of target = K (terms - mean) + middle.

    K = gain I + spread · U whiten, with U the first nine of u row by row; middle is the mean
    of the targets plus spread times the last three of u. In u the mean squared error of the
    targets is a sphere about its minimum, and a unit of u is an error as large as their
    spread. Zero is a triad without misalignment.

    `spread`, `gain` (...): spread of the targets, and its ratio to that of the terms;
    `whiten` (..., 3, 3); the means (..., 1, 3).
    """

    gain: Array
    spread: Array
    whiten: Array
    mean_target: Array
    mean_terms: Array

    @classmethod
    def of(cls, target: Array, terms: Array) -> Coordinates:
        """Coordinates for targets and terms (..., n, 3), both in tool axes."""
        (y, mean_target), (x, mean_terms) = _centred(target), _centred(terms)
        spread, size = (np.sqrt(np.sum(v * v, (-1, -2)) / v.shape[-2]) for v in (y, x))
        _, r = np.linalg.qr(x / np.sqrt(x.shape[-2]))
        whiten = inverse(r).mT
        return cls(spread / size, spread, whiten, mean_target, mean_terms)

    def parts(self, place: Array) -> tuple[Array, Array]:
        """K (..., particles, 3, 3) and middle (..., particles, 3) at u (..., particles, 12)."""
        turn, shift = affine_parts(place)
        spread = self.spread[..., None, None]
        matrix = (turn @ self.whiten[..., None, :, :]) * spread[..., None]
        matrix = matrix + self.gain[..., None, None, None] * np.eye(3)
        return matrix, self.mean_target + spread * shift

    def cost(self, target: Array, terms: Array) -> Cost:
        """Mean squared error of the targets as a function of u (..., particles, 12).

        Stations count by their second moments alone: up to six that have the same, rows of the
        triangular factor of all, take their place, however many there are.
        """
        both = np.broadcast_arrays(terms - self.mean_terms, target - self.mean_target)
        rows = np.concatenate(both, -1)
        few = np.linalg.qr(rows / np.sqrt(rows.shape[-2]))[1]
        few = few.mT
        few_terms, few_target = few[..., :3, :], few[..., 3:, :]
        spread, lead, size = self.spread[..., None, None], few.shape[:-2], 3 * few.shape[-1]
        turned = np.einsum("ij,...ab->...iajb", np.eye(3), spread * (self.whiten @ few_terms))
        slope, zero = np.zeros((*lead, 12, size + 3)), np.zeros((*lead, 1, size + 3))
        slope[..., :9, :size] = turned.reshape(*lead, 9, size)
        slope[..., 9:, size:] = spread * np.eye(3)
        rest = self.gain[..., None, None] * few_terms - few_target
        zero[..., 0, :size] = rest.reshape(*lead, size)

        def mean_square(place: Array) -> Array:
            error = place @ slope
            error += zero
            return np.asarray(np.vecdot(error, error))

        return mean_square


def _field_search(raw: Array, reference: Array) -> tuple[Cost, Callable[[Array], Array]]:
    """Cost and forward parameters by u of field = M (reading - mean) + middle, S = M⁻¹."""
    coordinates = Coordinates.of(reference, raw)

    def params(place: Array) -> Array:
        matrix, middle = coordinates.parts(place)
        back = inverse(matrix)
        return affine_terms(
            back, coordinates.mean_terms - np.einsum("...ij,...j->...i", back, middle)
        )

    return coordinates.cost(reference, raw), params


def _reading_search(raw: Array, reference: Array) -> tuple[Cost, Callable[[Array], Array]]:
    """Cost and forward parameters by u of reading = S (reference - mean) + middle."""
    coordinates = Coordinates.of(raw, reference)

    def params(place: Array) -> Array:
        matrix, middle = coordinates.parts(place)
        mean = np.einsum("...ij,...j->...i", matrix, coordinates.mean_terms)
        return affine_terms(matrix, middle - mean)

    return coordinates.cost(raw, reference), params


_SEARCHES = {"field": _field_search, "reading": _reading_search}


def swarm_forward(
    raw: Array,
    reference: Array,
    error: Error = "field",
    *,
    reach: float = 1.0,
    particles: int = 60,
    iterations: int = 600,
    seed: int = 0,
) -> Swarm:
    """Forward parameters of least error in the field or in the readings, by a particle swarm.

    The swarm minimises `vector_cost`, but flies in `Coordinates`: centred, so that an offset of
    many times the field is nothing to search for, and whitened, so that all axes of the search
    are alike however the stations are spread. The box is ± `reach` about a triad without
    misalignment, which takes in gains from none to twice the mean one. The least-squares
    solutions are not used. In M and b of uncentred readings a swarm misses: with hard iron of
    five times the field, always.

    Shapes: `raw`, `reference` (..., n, 3). Result: as `swarm`, the position as forward
    parameters (..., 12).
    Accuracy: a cost is seen to 16 digits, hence the position to 8 digits of the residual.
    Singular: as `least_squares_forward`.
    """
    cost, params = _SEARCHES[error](raw, reference)
    flight = swarm(
        cost,
        np.full(12, -reach),
        np.full(12, reach),
        particles=particles,
        iterations=iterations,
        seed=seed,
    )
    return replace(flight, position=params(flight.position[..., None, :])[..., 0, :])
