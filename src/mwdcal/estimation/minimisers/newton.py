"""Newton-Raphson of Moosavi et al.: strength of gravity and inclination, with the exact Hessian.

    E = Σ w_g (|g|² - G²)² / N + Σ w_I (I - I_reference)² / N          (their 16 to 20)
    θ ← θ - α |H|⁻¹ ∇E                                                 (their 21)
    until max |Δθ_k| / max(|mean θ_k|, floor_k) < 1.5e-6               (their 22)

Two departures, without which the method is not one. This evidence says nothing about a turn
of the triad about the tool axis (rank 11 of 12); away from the minimum the exact Hessian is
regular there all the same, and its inverse wanders along it. Steps stay in the row space of
the observables' Jacobian, and take the absolute eigenvalues of the Hessian, so that each
goes downhill. And criterion 22 has no meaning for a parameter near zero: its denominator has
a floor.

Shapes: parameters (..., p), readings (..., n, 3), temperature, gravity and inclination
(..., n); leading axes broadcast, and no member of a batch stops another. NaN is a reference
that is not known. Units: g, radians. Rank is counted in normalised columns: with temperature
terms the model wants a Chebyshev basis, as powers of 50 °C to the cube look alike.

Singular: exactly vertical stations. There I has no gradient, but the square of I is smooth,
and so is that of I - π: with a reference of exactly 0 or π nothing special happens. With
another reference a reading of exactly vertical is taken as toolface zero, without the
(infinite) curvature across; the first step leaves that point.

Reference: S. M. Seyed Moosavi et al., Modares J. Electrical Eng. 13 (4); what is wrong in
it is in `docs/errata.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.solvers import Determined, Normal, Status
from mwdcal.estimation.uncertainty import CHANGES, COUPLED, free_share, tangent
from mwdcal.geometry.observables import OBSERVABLES, VERTICAL, is_vertical
from mwdcal.geometry.vectors import (
    AnyArray,
    Array,
    ArrayLike,
    Bools,
    Ints,
    inverse,
    outer,
    quotient,
)
from mwdcal.sensor.models import Model

THRESHOLD = 1.5e-6
"""Criterion 22: the largest relative change of a parameter at which the iteration ends."""
CRITERION_FLOOR = 1e-3
"""Floor of its denominator, as a share of the change that moves the observables by one unit."""
BOTH_VERTICAL = 1e-9
"""A vertical reading this close to its reference, rad, has the curvature of the limit."""
SMALLEST_EIGENVALUE = 1e-12
"""Eigenvalues below this share of the largest are taken as that."""
DECREASE = 1e-4
"""Share of the decrease promised by the gradient with which the line search is content."""
MOST_HALVINGS = 40
EPSILON = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Compared:
    """What is compared: raw (B, n, 3), temperature, gravity, inclination (B, n), weights (B, n, 2).

    A reference of weight zero has a harmless value: nothing here is NaN for being unknown.
    """

    raw: Array
    temperature: Array
    gravity: Array
    inclination: Array
    weights: Array

    @property
    def used(self) -> Bools:
        """Which of |g| and inclination count (B, n, 2)."""
        return np.asarray(self.weights > 0)


@dataclass(frozen=True)
class Local:
    """E (B,) with its gradient (B, p) and Hessian (B, p, p)."""

    cost: Array
    gradient: Array
    hessian: Array


@dataclass(frozen=True)
class Newton:
    """Outcome of a batch: parameters (..., p), `Status` codes and iteration counts (...).

    `information` (..., p, p) is that of the observables, in units of gravity and radians.
    `cost` (..., limit + 1) begins with that of the start values, `criterion` (..., limit) is
    number 22 of each undamped step; both are NaN after the last one. `determined` says which
    directions of parameter space the stations determine; `free` (...) by name whether a turn
    about an axis, or the scale, is none of them.
    """

    params: Array
    status: Ints
    iterations: Ints
    cost: Array
    criterion: Array
    determined: Determined
    information: Array
    free: dict[str, Bools]


def newton(
    model: Model,
    params: Array,
    raw: Array,
    temperature: ArrayLike,
    gravity: ArrayLike,
    inclination: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    limit: int = 30,
) -> Newton:
    """Minimise E from start values, for a batch; nothing is raised for a member that fails.

    Definition: Moosavi 16 to 22. Units: g, radians; readings in tool axes and nominal units, so
    that the datasheet is `model.start(np.eye(3), np.zeros(3))`. `weights` (..., n, 2) of the
    two squares are one unless given, which is the paper's sum; see `propagated`.
    """
    shares = np.ones(2) if weights is None else np.asarray(weights, float)
    known = [np.asarray(values, float) for values in (temperature, gravity, inclination)]
    shapes = [values.shape[:-1] for values in known]
    lead = np.broadcast_shapes(
        params.shape[:-1], raw.shape[:-2], shares.shape[:-2], model.lead, *shapes
    )
    stations = _compared(raw, known, shares, lead)
    start = np.broadcast_to(params, (*lead, model.size)).reshape(prod(lead), model.size)
    with np.errstate(all="ignore"):
        descent = _NewtonDescent.at(model.flat(lead), stations, start, limit)
        for _ in range(limit):
            if descent.active.size:
                descent.step()
        return descent.outcome(lead)


def propagated(gravity: ArrayLike, noise: ArrayLike, stand: ArrayLike = 0.0) -> Array:
    """Weights (..., 2) from the noise of a reading (g) and the uncertainty of the stand (rad).

    One over the variances of |g|² - G² and of the inclination: E is then χ² / N.
    """
    strength, sd, angle = np.broadcast_arrays(gravity, noise, stand)
    return np.stack([1 / (2 * strength * sd) ** 2, 1 / ((sd / strength) ** 2 + angle**2)], -1)


def _compared(raw: Array, known: list[Array], shares: Array, lead: tuple[int, ...]) -> Compared:
    """Everything with one batch axis; what is not known has weight zero."""
    count = raw.shape[-2]

    def flat(values: Array, *tail: int) -> Array:
        return np.broadcast_to(values, (*lead, count, *tail)).reshape(prod(lead), count, *tail)

    temperature, gravity, inclination = (flat(values) for values in known)
    absent = np.isnan(np.stack([gravity, inclination], -1))
    weights = np.where(absent, 0.0, flat(shares, 2))
    strong, inclined = weights[..., 0] > 0, weights[..., 1] > 0
    counts = strong | inclined
    return Compared(
        np.where(counts[..., None], flat(raw, 3), np.array([0.0, 0.0, 1.0])),
        np.where(counts, temperature, 0.0),
        np.where(strong, gravity, 1.0),
        np.where(inclined, inclination, 0.0),
        weights,
    )


def half_square_strength(g: Array, gravity: Array) -> tuple[Array, Array, Array]:
    """Error e = |g|² - G² (...), and gradient (..., 3) and Hessian (..., 3, 3) of e² / 2."""
    error = np.sum(g * g, -1) - gravity**2
    second = 4 * outer(g, g) + 2 * error[..., None, None] * np.eye(3)
    return error, 2 * error[..., None] * g, second


def _directions(g: Array) -> tuple[Array, Array, Array]:
    """Unit vectors (..., 3) along g, up the inclination, and across: about the tool axis."""
    strength = np.linalg.norm(g, axis=-1)[..., None]
    slope = OBSERVABLES["inclination"].gradient(g, np.zeros_like(g))[..., :3]
    along, up = g / strength, slope * strength
    return along, up, np.cross(along, up)


def half_square_inclination(g: Array, inclination: Array) -> tuple[Array, Array, Array]:
    """Error e = I - reference (...), gradient (..., 3) and Hessian (..., 3, 3) of e² / 2.

    With unit vectors a along g, u up the inclination and t across, the second derivatives
    of I are (cot I t tᵀ - u aᵀ - a uᵀ) / |g|². Singular: e cot I is 1 where reading and
    reference are both vertical (the limit), and 0 where the reading alone is.
    """
    along, up, turn = _directions(g)
    strength = np.linalg.norm(g, axis=-1)[..., None]
    error = OBSERVABLES["inclination"].value(g, np.zeros_like(g)) - inclination
    vertical, across = is_vertical(g), np.hypot(g[..., 0], g[..., 1])
    limit = np.where(np.abs(error) < BOTH_VERTICAL, 1.0, 0.0)
    bend = np.where(vertical, limit, error * g[..., 2] / np.where(vertical, 1.0, across))
    mixed = outer(up, along) + outer(along, up)
    second = outer(up, up) + bend[..., None, None] * outer(turn, turn)
    second = (second - error[..., None, None] * mixed) / strength[..., None] ** 2
    return error, error[..., None] * up / strength, second


def cost(model: Model, params: Array, stations: Compared) -> Array:
    """E (B,): the mean over stations of both weighted squares."""
    g = model.fields(params, stations.raw, stations.temperature)
    strength = np.sum(g * g, -1) - stations.gravity**2
    angle = OBSERVABLES["inclination"].value(g, np.zeros_like(g)) - stations.inclination
    squares = stations.weights * np.stack([strength, angle], -1) ** 2
    return np.asarray(np.sum(squares, (-1, -2)) / g.shape[-2])


def local(model: Model, params: Array, stations: Compared) -> Local:
    """E and its exact derivatives: those of the two squares, chained with those of the model."""
    raw, temperature = stations.raw, stations.temperature
    g = model.fields(params, raw, temperature)
    strength = half_square_strength(g, stations.gravity)
    angle = half_square_inclination(g, stations.inclination)
    share = 2 * stations.weights / g.shape[-2]
    by_strength, by_angle = share[..., 0, None], share[..., 1, None]
    first = by_strength * strength[1] + by_angle * angle[1]
    second = by_strength[..., None] * strength[2] + by_angle[..., None] * angle[2]
    slope = model.jacobian(params, raw, temperature)
    gradient = np.einsum("bni,bnip->bp", first, slope)
    shape = (len(slope), 3 * slope.shape[1], model.size)
    bent = (second @ slope).reshape(shape)
    hessian = slope.reshape(shape).mT @ bent
    hessian = hessian + model.curvature(params, raw, temperature, first)
    squares = share * np.stack([strength[0], angle[0]], -1) ** 2
    return Local(0.5 * np.sum(squares, (-1, -2)), gradient, hessian)


def determines(model: Model, params: Array, stations: Compared) -> Determined:
    """Which directions of parameter space the stations determine, however noisy they are."""
    gram, norms = geometry(model, params, stations)
    nothing = np.zeros_like(params)
    return Determined.by(Normal(gram, nothing, nothing[:, 0], model.size), norms)


def geometry(model: Model, params: Array, stations: Compared) -> tuple[Array, Array]:
    """Information (B, p, p) of what the stations compare, and norms (B, p) of the whole columns.

    Rows are the logarithm of |g| and the inclination; at a vertical reference, where the
    square of the latter counts, both transverse components. They are taken at readings that
    agree with the references, which makes a free turn free to the last digit.
    """
    raw, temperature = stations.raw, stations.temperature
    g = model.fields(params, raw, temperature)
    target = _target(g, stations)
    back = inverse(model.slope(params, raw, temperature))
    agreeing = raw - np.einsum("bnij,bnj->bni", back, g - target)
    slope = model.jacobian(params, agreeing, temperature)
    rows = (_rows(target, stations) @ slope).reshape(len(slope), 3 * slope.shape[1], model.size)
    gram = np.nan_to_num(rows.mT @ rows, posinf=0.0, neginf=0.0)
    whole = slope / np.linalg.norm(target, axis=-1)[..., None, None]
    counted = np.any(stations.used, -1)[..., None, None]
    norms = np.sqrt(np.nan_to_num(np.sum((whole * counted) ** 2, (1, 2))))
    return gram, norms


def _target(g: Array, stations: Compared) -> Array:
    """The vector (B, n, 3) nearest to g of which the known references hold exactly."""
    used, across = stations.used, np.hypot(g[..., 0], g[..., 1])
    strength = np.where(used[..., 0], stations.gravity, np.linalg.norm(g, axis=-1))
    angle = np.where(used[..., 1], stations.inclination, np.arctan2(across, g[..., 2]))
    upright = is_vertical(g)
    x, y = (np.where(upright, 0.0, g[..., k] / np.where(upright, 1.0, across)) for k in (0, 1))
    y = np.where(upright, -1.0, y)
    return np.asarray(
        strength[..., None] * np.stack([x * np.sin(angle), y * np.sin(angle), np.cos(angle)], -1)
    )


def _rows(target: Array, stations: Compared) -> Array:
    """What each station compares, as rows (B, n, 3, 3) on the field, in units of gravity."""
    along, up, turn = _directions(target)
    used = stations.used[..., None]
    vertical = np.abs(np.sin(stations.inclination))[..., None] <= VERTICAL
    rows = [along * used[..., 0, :], up * used[..., 1, :], turn * used[..., 1, :] * vertical]
    return np.asarray(np.stack(rows, -2) / np.linalg.norm(target, axis=-1)[..., None, None])


def downhill(here: Local, determined: Determined) -> Array:
    """Newton's step (B, p) in the determined subspace, with absolute eigenvalues."""
    norms, kept = determined.norms, determined.basis * determined.keep[..., None, :]
    inner = kept.mT @ (here.hessian / outer(norms, norms)) @ kept
    values, vectors = np.linalg.eigh(inner)
    size = np.abs(values)
    size = np.maximum(size, SMALLEST_EIGENVALUE * np.max(size, -1, keepdims=True))
    axes = kept @ vectors
    along = axes.mT @ (here.gradient / norms)[..., None]
    length = quotient(along[..., 0], size, size > 0)
    return np.asarray(-(axes @ length[..., None])[..., 0] / norms)


def search(
    model: Model, params: Array, stations: Compared, here: Local, step: Array
) -> tuple[Array, Array]:
    """The largest α (B,) of 1, 1/2, 1/4, … that lowers E enough, and E there; 0 where none does."""
    promised = DECREASE * np.sum(here.gradient * step, -1)
    sizes = np.stack([stations.gravity**4, np.ones_like(stations.gravity)], -1)
    digits = np.sum(stations.weights * sizes, (-1, -2)) / sizes.shape[-2]
    bound = here.cost * (1 + 4 * EPSILON) + digits * (4 * EPSILON) ** 2
    share = np.ones_like(here.cost)
    for _ in range(MOST_HALVINGS):
        trial = cost(model, params + share[:, None] * step, stations)
        good = trial <= bound + share * promised
        if good.all():
            break
        share = np.where(good, share, share / 2)
    return np.where(good, share, 0.0), np.where(good, trial, here.cost)


def criterion(params: Array, step: Array, determined: Determined, stations: Compared) -> Array:
    """Number 22 (B,), its denominator no less than `CRITERION_FLOOR` of each parameter's own scale.

    That scale is the change which moves |g| by itself or the inclination by a radian, in the
    root mean square over the stations: about 1 g for a bias, 1 for a scale or a misalignment.
    """
    comparisons = np.sum(stations.used, (-1, -2))[:, None]
    scale = np.sqrt(comparisons) / determined.norms
    mean = np.abs(params + step / 2)
    return np.asarray(np.max(np.abs(step) / np.maximum(mean, CRITERION_FLOOR * scale), -1))


@dataclass
class _NewtonDescent:
    """Steps of one batch, each member until it has stopped."""

    model: Model
    stations: Compared
    params: Array
    status: Ints
    iterations: Ints
    cost: Array
    criterion: Array
    active: Ints

    @classmethod
    def at(cls, model: Model, stations: Compared, params: Array, limit: int) -> _NewtonDescent:
        """At the start values."""
        count = len(params)
        costs = np.full((count, limit + 1), np.nan)
        costs[:, 0] = cost(model, params, stations)
        return cls(
            model,
            stations,
            params.copy(),
            np.full(count, int(Status.NOT_CONVERGED)),
            np.zeros(count, int),
            costs,
            np.full((count, limit), np.nan),
            np.arange(count),
        )

    def step(self) -> None:
        """One iteration of the members that have not stopped."""
        here = self._local()
        active, params = self.active, self.params[self.active]
        model, stations = take((self.model, self.stations), active)
        determined = determines(model, params, stations)
        step = downhill(here, determined)
        share, after = search(model, params, stations, here, step)
        change = criterion(params, step, determined, stations)
        self.params[active] = params + share[:, None] * step
        self.criterion[active, self.iterations[active]] = change
        self.iterations[active] += 1
        self.cost[active, self.iterations[active]] = after
        converged = change < THRESHOLD
        self.status[active[converged]] = Status.OK
        self.active = active[~converged & (share > 0)]

    def _local(self) -> Local:
        """Derivatives of the active members; those that are not finite stop."""
        active = self.active
        here = local(*take((self.model, self.params, self.stations), active))
        finite = np.isfinite(here.cost) & np.isfinite(here.hessian).all((-1, -2))
        self.status[active[~finite]] = Status.NOT_FINITE
        self.active = active[finite]
        return take(here, np.flatnonzero(finite))

    def free(self, determined: Determined) -> dict[str, Bools]:
        """Whether a turn of all readings about an axis, or their scale, is free (B,), by name."""
        moved = {name: tangent(self.model, self.params, each) for name, each in CHANGES.items()}
        return {name: free_share(determined, each) > COUPLED for name, each in moved.items()}

    def outcome(self, lead: tuple[int, ...]) -> Newton:
        """What became of every member, with the leading axes that were given."""

        def led(values: AnyArray) -> AnyArray:
            return values.reshape((*lead, *values.shape[1:]))

        known = determines(self.model, self.params, self.stations)
        return Newton(
            led(self.params),
            led(self.status),
            led(self.iterations),
            led(self.cost),
            led(self.criterion),
            Determined(led(known.basis), led(known.values), led(known.norms), led(known.keep)),
            led(geometry(self.model, self.params, self.stations)[0]),
            {name: led(values) for name, values in self.free(known).items()},
        )
