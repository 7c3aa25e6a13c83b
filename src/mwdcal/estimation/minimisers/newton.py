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

Shapes: parameters (B, p), readings (B, n, 3); temperature, gravity and inclination broadcast to
(B, n); no member of a batch stops another. NaN is a reference that is not known. Units: g, radians.
Rank is counted in normalised columns: with temperature terms the model wants a Chebyshev basis, as
powers of 50 °C to the cube look alike.

Singular: exactly vertical stations. There I has no gradient, but the square of I is smooth,
and so is that of I - π: with a reference of exactly 0 or π nothing special happens. With
another reference a reading of exactly vertical is taken as toolface zero, without the
(infinite) curvature across; the first step leaves that point.

Reference: S. M. Seyed Moosavi et al., Modares J. Electrical Eng. 13 (4); what is wrong in
it is in `docs/evidence/errata.md`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.solvers import Determined, Status
from mwdcal.geometry.observables import OBSERVABLES, VERTICAL, is_vertical
from mwdcal.geometry.vectors import Array, ArrayLike, Bools, Ints, eigen, inverse, outer, quotient
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
    """Values to compare: raw (B, n, 3), temperature, gravity, inclination (B, n), weights (B, n, 2).

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
    """Outcome of a batch: parameters (B, p), `Status` codes and iteration counts (B,).

    `information` (B, p, p) is that of the observables, in units of gravity and radians.
    `cost` (B, limit + 1) begins with that of the start values, `criterion` (B, limit) is
    number 22 of each undamped step; both are NaN after the last one. `determined` says which
    directions of parameter space the stations determine.
    """

    params: Array
    status: Ints
    iterations: Ints
    cost: Array
    criterion: Array
    determined: Determined
    information: Array


def newton(
    model: Model,
    params: Array,
    raw: Array,
    temperature: ArrayLike,
    gravity: ArrayLike,
    inclination: ArrayLike,
    *,
    weights: ArrayLike = 1.0,
    limit: int = 30,
) -> Newton:
    """Minimise E from start values, for a batch; nothing is raised for a member that fails.

    Definition: Moosavi 16 to 22. Units: g, radians; readings in tool axes and nominal units, so
    that the datasheet is `model.start(np.eye(3), np.zeros(3))`. `weights` (B, n, 2) of the
    two squares are one unless given, which is the paper's sum; see `propagated`.
    """
    stations = compared(raw, temperature, gravity, inclination, weights)
    start = np.broadcast_to(params, (len(raw), model.size)).copy()
    with np.errstate(all="ignore"):
        reached = _descend(model, start, stations, limit)
        information, norms = geometry(model, reached[0], stations)
        return Newton(*reached, Determined.by(information, norms), information)


def _descend(
    model: Model, params: Array, stations: Compared, limit: int
) -> tuple[Array, Ints, Ints, Array, Array]:
    """Newton's steps of every member until it stops: the first five fields of `Newton`."""
    count = len(params)
    status, iterations = np.full(count, int(Status.NOT_CONVERGED)), np.zeros(count, int)
    costs, changes = np.full((count, limit + 1), np.nan), np.full((count, limit), np.nan)
    costs[:, 0], active = cost(model, params, stations), np.arange(count)
    for turn in range(limit):
        at = take((model, params, stations), active)
        here, determined = local(*at), Determined.by(*geometry(*at))
        step = downhill(here, determined)
        finite = np.isfinite(here.cost) & np.isfinite(step).all(-1)
        status[active[~finite]] = Status.NOT_FINITE
        some, active = np.flatnonzero(finite), active[finite]
        if not active.size:
            break
        (at, here, determined), step = take((at, here, determined), some), step[some]
        share, costs[active, turn + 1] = search(*at, here, step)
        change = criterion(params[active], step, determined, at[2])
        params[active] += share[:, None] * step
        changes[active, turn], iterations[active] = change, turn + 1
        converged = change < THRESHOLD
        status[active[converged]] = Status.OK
        active = active[~converged & (share > 0)]
    return params, status, iterations, costs, changes


def propagated(gravity: ArrayLike, noise: ArrayLike, stand: ArrayLike = 0.0) -> Array:
    """Weights (..., 2) from the noise of a reading (g) and the uncertainty of the stand (rad).

    One over the variances of |g|² - G² and of the inclination: E is then χ² / N.
    """
    strength, sd, angle = np.broadcast_arrays(gravity, noise, stand)
    return np.stack([1 / (2 * strength * sd) ** 2, 1 / ((sd / strength) ** 2 + angle**2)], -1)


def compared(
    raw: Array,
    temperature: ArrayLike,
    gravity: ArrayLike,
    inclination: ArrayLike,
    weights: ArrayLike = 1.0,
) -> Compared:
    """Readings (B, n, 3) and what broadcasts to (B, n); what is not known has weight zero."""
    known = [
        np.broadcast_to(np.asarray(each, float), raw.shape[:-1]) for each in (gravity, inclination)
    ]
    shares = np.where(np.isnan(np.stack(known, -1)), 0.0, weights)
    strong, inclined = shares[..., 0] > 0, shares[..., 1] > 0
    counts = strong | inclined
    return Compared(
        np.where(counts[..., None], raw, np.array([0.0, 0.0, 1.0])),
        np.where(counts, temperature, 0.0),
        np.where(strong, known[0], 1.0),
        np.where(inclined, known[1], 0.0),
        shares,
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
    """Comparisons of each station, as rows (B, n, 3, 3) on the field, in units of gravity."""
    along, up, turn = _directions(target)
    used = stations.used[..., None]
    vertical = np.abs(np.sin(stations.inclination))[..., None] <= VERTICAL
    rows = [along * used[..., 0, :], up * used[..., 1, :], turn * used[..., 1, :] * vertical]
    return np.asarray(np.stack(rows, -2) / np.linalg.norm(target, axis=-1)[..., None, None])


def downhill(here: Local, determined: Determined) -> Array:
    """Newton's step (B, p) in the determined subspace, with absolute eigenvalues.

    Singular: NaN where the Hessian is not finite in the scale of its columns.
    """
    norms, kept = determined.norms, determined.basis * determined.keep[..., None, :]
    inner = kept.mT @ (here.hessian / outer(norms)) @ kept
    values, vectors = eigen(inner)
    size = np.abs(values)
    size = np.maximum(size, SMALLEST_EIGENVALUE * np.max(size, -1, keepdims=True))
    axes = kept @ vectors
    along = axes.mT @ (here.gradient / norms)[..., None]
    length = quotient(along[..., 0], size, size > 0)
    step = -(axes @ length[..., None])[..., 0] / norms
    return np.where(np.all(np.isfinite(inner), (-1, -2), keepdims=True)[..., 0], step, np.nan)


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
