"""Particle swarm, and least squares, of a triad's readings against known vectors.

swarm                  the minimiser, for any cost
vector_cost            mean squared error in the reading (Moradi 12)
least_squares_forward  where it is least: one linear solve
swarm_forward          the swarm on it, in coordinates that suit it

Forward parameters (..., 12) of a triad: S and o of reading = S · field + o, as `affine_parts` has them.
The error in the field (Moradi 13) is the same with readings and fields changed round: its parameters
are M and b of field = M · reading + b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.solvers import regress
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


def vector_cost(raw: Array, reference: Array) -> Cost:
    """Mean squared length of reading - S · reference - o over the stations (Moradi 12).

    Units: those of the readings, squared. Shapes: `raw`, `reference` (..., n, 3); the cost takes
    forward parameters (..., particles, 12) to (..., particles).
    """
    readings, known = raw[..., None, :, :], reference[..., None, :, :]

    def cost(params: Array) -> Array:
        matrix, offset = affine_parts(params)
        error = (readings - offset[..., None, :]) - known @ matrix.mT
        return np.asarray(np.einsum("...ni,...ni->...", error, error) / raw.shape[-2])

    return cost


def least_squares_forward(raw: Array, reference: Array) -> Array:
    """Forward parameters (..., 12) of least `vector_cost`.

    Shapes: `raw`, `reference` (..., n, 3). Singular: as `regress`.
    """
    forward = regress(raw, reference, np.ones((*raw.shape[:-1], 1))).forward
    return affine_terms(forward[..., :3, :].mT, forward[..., 3, :])


def _centred(vectors: Array) -> tuple[Array, Array, Array]:
    """Vectors (..., n, 3) about their mean, the mean (..., 1, 3), and their spread (..., 1, 1)."""
    mean = vectors.mean(-2, keepdims=True)
    left = vectors - mean
    spread = np.sqrt(np.sum(left * left, (-1, -2)) / left.shape[-2])
    return left, mean, spread[..., None, None]


def _coordinates(raw: Array, reference: Array) -> tuple[Cost, Callable[[Array], Array]]:
    """Cost and forward parameters of places u (..., particles, 12), centred and whitened.

    Definition: reading = S (reference - mean) + middle, with S = gain I + spread · U whiten and U
    the first nine of u row by row; middle is the mean of the readings plus `spread`, theirs, times
    the last three; gain is the ratio of both spreads. In u the cost is a sphere about its minimum,
    and a unit of u is an error as large as the spread. Zero is a triad without misalignment.
    """
    (y, mean, spread), (x, middle, size) = _centred(raw), _centred(reference)
    gain, whiten = spread / size, inverse(np.linalg.qr(x / np.sqrt(x.shape[-2]))[1]).mT

    def params(place: Array) -> Array:
        turn, shift = affine_parts(place)
        matrix = (turn @ whiten[..., None, :, :]) * spread[..., None]
        matrix = matrix + gain[..., None] * np.eye(3)
        moved = np.einsum("...ij,...j->...i", matrix, middle)
        return affine_terms(matrix, mean + spread * shift - moved)

    return _whitened_cost(y, x, spread, gain, whiten), params


def _whitened_cost(y: Array, x: Array, spread: Array, gain: Array, whiten: Array) -> Cost:
    """Mean squared error of centred readings y at places u; see `_coordinates`.

    Stations count by their second moments alone: up to six that have the same, rows of the
    triangular factor of all, take their place, however many there are.
    """
    rows = np.concatenate(np.broadcast_arrays(x, y), -1)
    few = np.linalg.qr(rows / np.sqrt(rows.shape[-2]))[1].mT
    few_x, few_y = few[..., :3, :], few[..., 3:, :]
    lead, size = few.shape[:-2], 3 * few.shape[-1]
    turned = np.einsum("ij,...ab->...iajb", np.eye(3), spread * (whiten @ few_x))
    slope, zero = np.zeros((*lead, 12, size + 3)), np.zeros((*lead, 1, size + 3))
    slope[..., :9, :size] = turned.reshape(*lead, 9, size)
    slope[..., 9:, size:] = spread * np.eye(3)
    zero[..., 0, :size] = (gain * few_x - few_y).reshape(*lead, size)

    def mean_square(place: Array) -> Array:
        error = place @ slope
        error += zero
        return np.asarray(np.vecdot(error, error))

    return mean_square


def swarm_forward(
    raw: Array,
    reference: Array,
    *,
    reach: float = 1.0,
    particles: int = 60,
    iterations: int = 600,
    seed: int = 0,
) -> Swarm:
    """Forward parameters of least error in the readings, by a particle swarm.

    The swarm minimises `vector_cost`, but flies in centred and whitened coordinates: an offset of
    many times the field is then nothing to search for, and all axes of the search are alike however
    the stations are spread. The box is ± `reach` about a triad without misalignment, which takes
    in gains from none to twice the mean one. The least-squares solution is not used. In S and o of
    uncentred readings a swarm misses: with hard iron of five times the field, always.

    Shapes: `raw`, `reference` (..., n, 3). Result: as `swarm`, the position as forward
    parameters (..., 12).
    Accuracy: a cost is seen to 16 digits, hence the position to 8 digits of the residual.
    Singular: as `least_squares_forward`.
    """
    cost, params = _coordinates(raw, reference)
    box = np.full(12, reach)
    flight = swarm(cost, -box, box, particles=particles, iterations=iterations, seed=seed)
    return replace(flight, position=params(flight.position[..., None, :])[..., 0, :])
