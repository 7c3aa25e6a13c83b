"""Start values: linear where directions are known, else an ellipsoid; then attitudes.

Nominal scales may be 10 % off and hard iron may exceed the field: nothing here uses the
nominal values but for the orientation of the axes, and where all else fails.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mwdcal.estimation.problem import ANGLES, EARTH, Problem, State
from mwdcal.estimation.solvers import regress
from mwdcal.geometry import observables
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    diagonal,
    earth_field,
    earth_gravity,
    eigen,
    eigenvalues,
    inverse,
    quotient,
    rotation,
    solved,
    tool_from_earth,
)

ELLIPSOID_SPAN = 2e-3
"""Columns of the ellipsoid with a singular value below this share of the largest are noise."""
LEAST_SPAN = 1e-3
"""Least share of the field along an axis with which least squares gives a start."""
SQUARES = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]), np.array([1, 2, 2, 1, 2, 1.0])
"""Axes of the products in a quadric, and how often each counts."""
SPHERE = np.array([1, 0, 0, 1, 0, 1, 0, 0, 0.0])
"""Coefficients of a sphere about zero in the terms of the ellipsoid."""
FEWEST_KNOWN = 4
"""Fewest stations of known direction with which it does."""


def start(problem: Problem) -> State:
    """A state of every member of the batch from which Gauss-Newton converges.

    Singular: where neither known directions nor strengths determine a triad, the start is a sphere
    about the middle of its readings.
    """
    shape = problem.temperature.shape
    level = np.broadcast_to(np.eye(3), (*shape, 3, 3))
    empty = problem.start(np.zeros((shape[0], 0)), level)
    params = []
    for where, free in zip(problem.slices(), _triad_starts(problem, empty), strict=True):
        known = diagonal(problem.prior.precision[:, where, where]) > 0
        whole = known.all(-1, keepdims=True)
        params.append(np.where(whole, problem.prior.expected[:, where], free))
    return oriented(problem, replace(empty, params=np.concatenate(params, -1)))


def _triad_starts(problem: Problem, state: State) -> list[Array]:
    """Parameters (B, p) of each triad."""
    triads, include = problem.triads, problem.evidence.include
    raw, count = np.stack([triad.raw for triad in triads]), np.sum(include, -1)
    centre = np.sum(raw * include[..., None], -2) / count[..., None]
    x = raw - centre[..., None, :]
    radius = np.sqrt(np.sum(x * x * include[..., None], (-2, -1)) / count)
    radius = np.where(radius > 0, radius, 1.0)
    x = x / radius[..., None, None]
    each = [_linear(problem, state, index, part) for index, part in enumerate(x)]
    matrix, offset, usable = (np.stack(parts) for parts in zip(*each, strict=True))
    if not usable.all():
        strength = [problem.constant(state, name) for name in EARTH[: len(triads)]]
        flat = (-1, *x.shape[2:])
        every = np.broadcast_to(include, raw.shape[:-1]).reshape(flat[:2])
        root, centred = _ellipsoid(x.reshape(flat), np.concatenate(strength), every)
        matrix = np.where(usable[..., None, None], matrix, root.reshape(matrix.shape))
        offset = np.where(usable[..., None], offset, centred.reshape(offset.shape))
    matrix = matrix / radius[..., None, None]
    offset = offset - (matrix @ centre[..., None])[..., 0]
    return [t.model.start(*pair) for t, *pair in zip(triads, matrix, offset, strict=True)]


def _ellipsoid(x: Array, strength: Array, include: Array) -> tuple[Array, Array]:
    """Symmetric matrix and offset that put centred readings on a sphere of the given strength."""
    i, j, times = SQUARES
    features = np.concatenate([x[..., i] * x[..., j] * times, 2 * x], -1)
    weighed = features * include[..., None]
    gram = weighed.mT @ features
    size = np.sum(x * x * include[..., None], (-2, -1)) / np.sum(include, -1)
    sphere = SPHERE / np.maximum(size, 1e-300)[:, None]
    left = np.sum(weighed, -2) - (gram @ sphere[..., None])[..., 0]
    solution = sphere + _where_determined(gram, left)
    quadric = np.zeros((len(x), 3, 3))
    quadric[:, i, j] = solution[:, :6]
    quadric[:, j, i] = solution[:, :6]
    values, vectors = eigen(quadric)
    sound = values[:, 0] > 1e-3 * values[:, 2]
    values = np.where(sound[:, None], values, 1.0)
    along = vectors.mT @ solution[:, 6:, None] / values[..., None]
    centre = -(vectors @ along)[..., 0]
    centre = np.where(sound[:, None], centre, (x.max(-2) + x.min(-2)) / 2)
    root = (vectors * np.sqrt(values)[:, None]) @ vectors.mT
    mapped = np.linalg.norm((x - centre[:, None, :]) @ root, axis=-1)
    scale = np.sum(strength * include, -1) / np.maximum(np.sum(mapped * include, -1), 1e-30)
    matrix = root * scale[:, None, None]
    return matrix, -(matrix @ centre[..., None])[..., 0]


def _where_determined(gram: Array, right: Array) -> Array:
    """Solution (B, k) of gram · x = right, zero in directions that the columns hardly span.

    Noise alone would set those, and a start that is far off there looks as if it determined them.
    The columns are of size one as they come: one that is noise alone must not be scaled up.
    """
    values, vectors = eigen(gram)
    kept = values > ELLIPSOID_SPAN**2 * values[:, -1:]
    along = (vectors.mT @ right[..., None])[..., 0]
    return np.asarray((vectors @ quotient(along, values, kept)[..., None])[..., 0])


def _linear(problem: Problem, state: State, index: int, x: Array) -> tuple[Array, Array, Bools]:
    """Matrix and offset (field = matrix x + offset) from stations of known direction; where usable (B,)."""
    evidence = problem.evidence
    known = [evidence.is_known(name) for name in ANGLES]
    whole = known[0] & known[2] & (known[1] | (index == 0))
    weight = evidence.include * whole
    if (np.count_nonzero(weight, axis=-1) < FEWEST_KNOWN).all():
        count = len(x)
        return np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count, bool)
    attitude = tool_from_earth(*(np.nan_to_num(evidence.known[name]) for name in ANGLES))
    terms = np.concatenate([x, np.ones_like(x[..., :1])], -1)
    gram = np.einsum("bn,bni,bnj->bij", weight, terms, terms)
    values = eigenvalues(gram)
    usable = (values[:, 0] > LEAST_SPAN**2 * values[:, -1]) & (weight.sum(-1) >= FEWEST_KNOWN)
    gram = np.where(usable[:, None, None], gram, np.eye(4))

    if index == 0:
        earth = earth_gravity(problem.constant(state, "gravity"))
    else:
        field, dip = problem.constant(state, "field"), problem.constant(state, "dip")
        unknown = _unknown_dip(attitude, field, terms, weight, gram)
        blank = ~evidence.is_known("dip")
        earth = earth_field(field, np.where(blank, unknown[:, None], dip))
    target = np.einsum("bnij,bnj->bni", attitude, earth)
    forward = regress(x, target, weight[..., None]).forward
    usable = usable & np.isfinite(forward).all((-1, -2))
    forward = np.where(usable[:, None, None], forward, np.eye(4, 3))
    back = inverse(forward[:, :3].mT)
    return back, -np.einsum("bij,bj->bi", back, forward[:, 3]), np.asarray(usable)


def _unknown_dip(attitude: Array, field: Array, terms: Array, weight: Array, gram: Array) -> Array:
    """Dip (B,) at which the fields are nearest to a linear function of the readings.

    Definition: the smallest eigenvector of the residual sums of a horizontal and a vertical field.
    """
    parts = [
        np.einsum("bnij,bnj->bni", attitude, earth_field(field, np.full_like(field, angle)))
        for angle in (0.0, np.pi / 2)
    ]
    maps = [solved(gram, np.einsum("bn,bni,bnj->bij", weight, terms, part)) for part in parts]
    left = [part - terms @ each for part, each in zip(parts, maps, strict=True)]
    sums = np.stack(
        [np.stack([np.einsum("bn,bni,bni->b", weight, p, q) for q in left], -1) for p in left], -2
    )
    _, vectors = eigen(sums)
    north, down = vectors[:, 0, 0], vectors[:, 1, 0]
    gains = [np.trace(each[:, :3], axis1=-2, axis2=-1) for each in maps]
    sign = np.where(north * gains[0] + down * gains[1] < 0, -1.0, 1.0)
    return np.asarray(np.arctan2(sign * down, sign * north))


def oriented(problem: Problem, state: State) -> State:
    """A state with attitudes: unknown angles of its own fields, shared directions, the best unknown turns."""
    evidence = problem.evidence
    fields = problem.fields(state)[: len(problem.triads)]
    g = fields[0]
    b = fields[1] if len(fields) > 1 else np.broadcast_to(np.array([0.0, 0.0, 1.0]), g.shape)
    guess = {name: np.nan_to_num(observables.OBSERVABLES[name].value(g, b)) for name in ANGLES}
    angles = {n: np.where(evidence.is_known(n), evidence.known[n], guess[n]) for n in ANGLES}
    angles = _by_toolface(problem, _share(problem, angles), g, b)
    state = _with_absent(problem, state, g, b)
    attitude = tool_from_earth(*(angles[name] for name in ANGLES))
    turn = _best_turn(fields, problem.targets(replace(state, attitude=attitude)))
    turn = np.where(evidence.is_known("toolface"), 0.0, turn)
    return replace(state, attitude=rotation(turn[..., None] * np.array([0.0, 0.0, 1.0])) @ attitude)


def _best_turn(fields: Sequence[Array], targets: Iterable[Array]) -> Array:
    """Angle (B, n) about the tool axis that brings targets closest to fields, in closed form."""
    sine, cosine = np.zeros(fields[0].shape[:-1]), np.zeros(fields[0].shape[:-1])
    for field, target in zip(fields, targets, strict=False):
        weight = 1 / np.maximum(np.linalg.norm(field, axis=-1), 1e-30) ** 2
        x, y, to_x, to_y = field[..., 0], field[..., 1], target[..., 0], target[..., 1]
        cosine += weight * (x * to_x + y * to_y)
        sine += weight * (y * to_x - x * to_y)
    return np.asarray(np.arctan2(sine, cosine))


def _share(problem: Problem, angles: dict[str, Array]) -> dict[str, Array]:
    """Stations of a group whose direction is unknown start from their mean direction."""
    evidence = problem.evidence
    members = evidence.members
    if not members.size:
        return angles
    inc, azi = angles["inclination"], angles["azimuth"]
    across = np.sin(inc)
    axis = np.stack([across * np.cos(azi), across * np.sin(azi), np.cos(inc)], -1)
    mean = members @ (members.mT @ axis)
    means = {
        "inclination": np.arctan2(np.hypot(mean[..., 0], mean[..., 1]), mean[..., 2]),
        "azimuth": np.arctan2(mean[..., 1], mean[..., 0]),
    }
    shared = {n: np.where(evidence.shared[n].sum(-1) > 0, m, angles[n]) for n, m in means.items()}
    return angles | shared


def _by_toolface(
    problem: Problem, angles: dict[str, Array], g: Array, b: Array
) -> dict[str, Array]:
    """Unknown directions, of stations and of groups, where toolfaces are known.

    Definition: turned back by its toolface, g reads (-sin I, 0, cos I) at every station of a group;
    turned back by that inclination too, b reads north · (cos A, -sin A) across the vertical. The
    inclination has a sign, and the azimuth is as well defined at vertical as elsewhere.
    """
    evidence = problem.evidence
    faced = evidence.is_known("toolface") & (evidence.include > 0)
    if not faced.any():
        return angles
    lone = faced & (evidence.group < 0)

    def mean(name: str, inclination: Array, field: Array) -> tuple[Array, Bools]:
        """Sum (B, n, 3) over a station's group of fields turned back, where the angle is unknown."""
        back = tool_from_earth(inclination, np.zeros_like(inclination), angles["toolface"])
        turned = np.einsum("bnji,bnj->bni", back, field)
        members = evidence.shared[name] * faced[..., None]
        total = evidence.members @ (members.mT @ turned)
        some = np.einsum("bnk,bk->bn", evidence.members, members.sum(-2)) > 0
        alone = lone & ~evidence.is_known(name)
        return np.where(alone[..., None], turned, total), some | alone

    down, known = mean("inclination", np.zeros(faced.shape), g)
    inclination = np.where(known, np.arctan2(-down[..., 0], down[..., 2]), angles["inclination"])
    across, known = mean("azimuth", inclination, b)
    azimuth = np.where(known, np.arctan2(-across[..., 1], across[..., 0]), angles["azimuth"])
    return {**angles, "inclination": inclination, "azimuth": azimuth}


def _with_absent(problem: Problem, state: State, g: Array, b: Array) -> State:
    """The state with an unknown dip, and stations' own strengths and dip, as its fields have them."""
    evidence, constants = problem.evidence, state.constants.copy()
    for index, constant in enumerate(evidence.constants):
        if constant.name == "dip" and constant.unknown:
            weight = constant.mask * evidence.include
            total = np.sum(observables.dip(g, b) * weight, -1)
            constants[:, index] = total / np.maximum(weight.sum(-1), 1)
    state = replace(state, constants=constants)
    departures = [
        observables.OBSERVABLES[name].value(g, b) - problem.constant(state, name)
        for name in evidence.absent
    ]
    return replace(state, departures=np.stack(departures, -1)) if departures else state
