"""From readings to a fitted problem: evidence, noise, gauge. The estimator behind every method.

A method is a selection of evidence; the solver is the same. See `METHODS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.core.models import Basis, Factors, Model, Polynomial
from mwdcal.core.newton import newton, propagated
from mwdcal.core.problem import UNKNOWN, Constant, Evidence, Problem, State, Triad
from mwdcal.core.solvers import Status, gauss_newton
from mwdcal.core.start import start
from mwdcal.core.swarm import forward_parts, swarm_forward
from mwdcal.core.uncertainty import Analysis, analyse, readjusted, settle_gauge
from mwdcal.core.vectors import AnyArray, Array, Bools, Ints, inverse
from mwdcal.readings import ANGLES, CONSTANTS, TRIADS, Readings

Orders = int | tuple[int, int]
"""Temperature order of both triads, or of accelerometer and magnetometer."""
HELD = 1e18
"""Precision of a parameter that is held at its value."""
ITERATIONS = 600
"""Iterations of the swarm, as Moradi's."""
FLOOR = 1e-9
"""Smallest noise, as a share of the signal, that an estimate from residuals may reach."""


def joint(evidence: Evidence) -> Evidence:
    """All evidence, weighted by its uncertainty."""
    return evidence


def whole_vectors(evidence: Evidence) -> Evidence:
    """Reference vectors only, taken as exact: least squares as in the six-state test."""
    exact = {name: np.zeros_like(sd) for name, sd in evidence.sd.items()}
    return replace(evidence, sd=exact, group=np.full_like(evidence.group, -1))


def angles_alone(evidence: Evidence) -> Evidence:
    """Inclination and toolface of the accelerometer, without |g| (Ivanov); scale stays nominal."""
    return _reset(evidence, absent=("gravity",))


def strengths_alone(evidence: Evidence) -> Evidence:
    """|g| and |b| at every station, and nothing else: the scalar (total field) method."""
    known = dict(evidence.known)
    for name in (*ANGLES, "dip"):
        known[name] = np.full_like(known[name], np.nan)
    alone = np.full_like(evidence.group, -1)
    return _reset(replace(evidence, known=known, group=alone), absent=("dip",))


def with_stand_errors(evidence: Evidence, names: tuple[str, ...]) -> Evidence:
    """The evidence with errors of the stand as unknown constants of the run (see `STAND`)."""
    found = list(evidence.constants)
    zero = np.zeros(len(evidence.include))
    for name in names:
        angle = "azimuth" if name == "azimuth-zero" else "inclination"
        mask = evidence.is_known(angle).astype(float)
        found.append(Constant(name, mask, zero, np.full(len(zero), UNKNOWN), unknown=True))
    return replace(evidence, constants=tuple(found))


def inclination_and_strength(evidence: Evidence) -> Evidence:
    """|g| and inclination of the accelerometer (Moosavi); azimuth, |b| and dip of the magnetometer."""
    known = {**evidence.known, "toolface": np.full_like(evidence.known["toolface"], np.nan)}
    return replace(evidence, known=known, group=np.full_like(evidence.group, -1))


def _reset(evidence: Evidence, absent: tuple[str, ...]) -> Evidence:
    """The evidence with its constants worked out again after a change."""
    changed = replace(evidence, absent=absent, constants=())
    return replace(changed, constants=_constants(changed))


METHODS: dict[str, Callable[[Evidence], Evidence]] = {
    "joint": joint,
    "least-squares": whole_vectors,
    "newton": inclination_and_strength,
    "swarm": whole_vectors,
    "toolface-inclination": angles_alone,
    "scalar": strengths_alone,
}


@dataclass(frozen=True)
class Fit:
    """A batch of fitted problems: shapes lead with the batch axis B.

    `noise` (B, triads) is the estimated standard deviation, NaN where it was declared;
    `status` holds `Status` codes.
    """

    problem: Problem
    state: State
    status: Ints
    iterations: Ints
    noise: Array
    analysis: Analysis


def _flat(value: AnyArray, lead: tuple[int, ...], *tail: int) -> AnyArray:
    """A value with one batch axis: (B, n, *tail)."""
    whole = np.broadcast_to(np.asarray(value), (*lead, *tail))
    return np.asarray(whole.reshape(math.prod(lead[:-1]), lead[-1], *tail))


def evidence_of(readings: Readings, include: Array) -> Evidence:
    """Everything the readings say about their stations, for one batch axis."""
    lead = np.broadcast_shapes(readings.accelerometer.shape[:-1], include.shape)
    known = {n: _flat(readings.reference(n), lead) for n in ANGLES + CONSTANTS}
    sd = {n: _flat(readings.uncertainty(n), lead) for n in ANGLES + CONSTANTS}
    group = _shared_groups(_flat(readings.groups, lead))
    included = _flat(include, lead).astype(float)
    nowhere = np.isnan(known["field"]).all(-1, keepdims=True)
    known["field"] = np.where(nowhere, 1.0, known["field"])
    bare = Evidence(known, sd, group, included, ())
    known, sd = _share_known(bare)
    return replace(bare, known=known, sd=sd, constants=_constants(bare))


def _shared_groups(group: Ints) -> Ints:
    """Group numbers (B, n) without gaps, -1 where a station is alone in its group."""
    labels, compact = np.unique(group, return_inverse=True)
    keys = compact.reshape(group.shape) + len(labels) * np.arange(len(group))[:, None]
    _, where, counts = np.unique(keys, return_inverse=True, return_counts=True)
    shared = (counts[where].reshape(group.shape) > 1) & (group >= 0)
    kept = np.unique(group[shared])
    return np.where(shared, np.searchsorted(kept, group), -1)


def _share_known(evidence: Evidence) -> tuple[dict[str, Array], dict[str, Array]]:
    """References and their σ where blank angles of a group take the mean of its filled cells.

    One error is then common to the group: every member gets a σ that leaves the group as
    uncertain as the mean of its k filled cells, σ √(members / k).
    """
    known, spread = dict(evidence.known), dict(evidence.sd)
    for name in ("inclination", "azimuth"):
        given = evidence.is_known(name)
        filled = evidence.members * given[..., None]
        count, total = filled.sum(-2), evidence.members.sum(-2)
        turn = np.einsum("bnk,bn->bk", filled, np.exp(1j * np.nan_to_num(known[name])))
        square = np.einsum("bnk,bn->bk", filled, evidence.sd[name] ** 2)
        partly = (count > 0) & (count < total)
        factor = np.where(partly, total / np.maximum(count, 1) ** 2, 0.0)
        common = np.einsum("bnk,bk->bn", evidence.members, np.sqrt(square * factor))
        mean = np.einsum("bnk,bk->bn", evidence.members, np.angle(turn))
        within = np.einsum("bnk,bk->bn", evidence.members, partly) > 0
        known[name] = np.where(within & ~given, mean, known[name])
        spread[name] = np.where(within, common, evidence.sd[name])
    return known, spread


def _constants(evidence: Evidence) -> tuple[Constant, ...]:
    """Constants of the run to estimate: unknown ones, and errors of uncertain references."""
    found = []
    for name, size in (("gravity", 1.0), ("field", 0.0), ("dip", UNKNOWN)):
        if name in evidence.absent:
            continue
        known = evidence.is_known(name)
        if not known.all():
            value = np.nan_to_num(
                np.nansum(evidence.known[name], -1) / np.maximum(known.sum(-1), 1)
            )
            scale = np.full(len(value), size) if size else np.where(value > 0, value, 1.0)
            found.append(Constant(name, (~known).astype(float), value, scale, unknown=True))
        sd = np.max(np.where(known, evidence.sd[name], 0.0), -1)
        if (sd > 0).any():
            floor = np.where(sd > 0, sd, 1e-12)
            found.append(
                Constant(name, known.astype(float), np.zeros(len(sd)), floor, unknown=False)
            )
    return tuple(found)


def model_of(
    kind: str, order: int, raw: Array, temperature: Array, include: Array, curved: bool = False
) -> Model:
    """A conditioned model for readings (B, n, 3): centred, scaled, Chebyshev in temperature."""
    low, high = float(temperature.min()), float(temperature.max())
    half = (high - low) / 2 or 1.0
    basis = Basis(order, (low + high) / 2, half, chebyshev=True)
    if kind == "factors":
        return Factors(basis)
    weight = include[..., None] / include.sum(-1)[:, None, None]
    centre = np.sum(raw * weight, -2, keepdims=True)
    radius = np.sqrt(np.sum((raw - centre) ** 2 * weight, (-2, -1)))
    radius = np.where(radius > 0, radius, 1.0)
    return Polynomial(
        basis, centre, np.broadcast_to(radius[:, None, None], centre.shape).copy(), curved
    )


def orders(order: Orders) -> tuple[int, int]:
    """Temperature order of accelerometer and magnetometer."""
    return (order, order) if isinstance(order, int) else order


def default_kind(order: int) -> str:
    """The model for a temperature order: identical at 0, where the linear one is simpler."""
    return "factors" if order else "polynomial"


def _problem(
    readings: Readings,
    evidence: Evidence,
    lead: tuple[int, ...],
    kind: str | None,
    order: Orders,
    curved: Mapping[str, float],
) -> tuple[Problem, list[bool]]:
    """The problem, and for each triad whether its noise is declared."""
    cold = np.zeros(readings.count)
    temperature = _flat(cold if readings.temperature is None else readings.temperature, lead)
    triads: list[Triad] = []
    declared: list[bool] = []
    for name in TRIADS:
        values = getattr(readings, name)
        if values is None:
            continue
        raw = _flat(values, lead, 3)
        own = orders(order)[len(triads)]
        model = model_of(
            kind or default_kind(own), own, raw, temperature, evidence.include, name in curved
        )
        sd = (
            _flat(readings.sd[name], lead, 3)
            if name in readings.sd
            else 1e-3 * _size(raw) + 0 * raw
        )
        prior = _prior(model, evidence, name, curved.get(name, 0.0))
        triads.append(Triad(model, raw, sd, prior, np.zeros_like(prior)))
        declared.append(name in readings.sd)
    return Problem(tuple(triads), temperature, evidence), declared


def _prior(model: Model, evidence: Evidence, name: str, nonlinearity: float) -> Array:
    """Prior precision (B, p): curved terms are small, all else is free."""
    prior = np.zeros((len(evidence.include), model.size))
    if isinstance(model, Polynomial) and model.curved:
        strength = np.nanmean(evidence.known["field" if name == "magnetometer" else "gravity"], -1)
        prior[:, -6:] = (nonlinearity * strength[:, None]) ** -2
    return prior


def _size(raw: Array) -> Array:
    """Root mean square departure of readings from their mean (B, 1, 1)."""
    size = np.sqrt(np.mean((raw - raw.mean(-2, keepdims=True)) ** 2, (-2, -1), keepdims=True))
    return np.where(size > 0, size, 1.0)


def fit(
    readings: Readings,
    method: str = "joint",
    kind: str | None = None,
    order: Orders = 0,
    include: Array | None = None,
    curved: Mapping[str, float] | None = None,
    stand: tuple[str, ...] = (),
    seed: int = 0,
    rounds: int = 8,
) -> Fit:
    """Fit a run, or a batch of runs (leading axes of the readings, or of `include`).

    `kind` is "polynomial" or "factors" (default: polynomial at order 0, factors above), and
    `order` the temperature order of both triads or of each.
    `curved` names triads with own-axis quadratic and cubic terms, and their prior as a share
    of the field; `stand` names turns of the stand's frame to estimate (`core.problem.STAND`);
    `seed` is that of the swarm.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return _fit(readings, method, kind, order, include, curved or {}, stand, seed, rounds)


def _fit(
    readings: Readings,
    method: str,
    kind: str | None,
    order: Orders,
    include: Array | None,
    curved: Mapping[str, float],
    stand: tuple[str, ...],
    seed: int,
    rounds: int,
) -> Fit:
    include = np.ones(readings.count) if include is None else np.asarray(include, float)
    evidence = with_stand_errors(METHODS[method](evidence_of(readings, include)), stand)
    lead = np.broadcast_shapes(readings.accelerometer.shape[:-1], include.shape)
    problem, declared = _problem(readings, evidence, lead, kind, order, curved)
    problem, finite = _without_broken(problem)
    state = start(problem)
    if method == "swarm":
        state, status, iterations = _swarmed(problem, state, seed)
    elif method == "newton":
        state, status, iterations = _by_newton(problem, state)
    else:
        state, status, iterations = gauss_newton(problem, state)
    noise = np.full((len(status), len(declared)), np.nan)
    if not all(declared):
        refit = None if method in ("swarm", "newton") else gauss_newton
        problem, state, status, noise = _estimate_noise(
            problem, state, status, declared, refit, rounds
        )
    state = settle_gauge(problem, state)
    status = np.where(finite, status, int(Status.NOT_FINITE))
    return Fit(problem, state, status, iterations, noise, analyse(problem, state))


def _swarmed(problem: Problem, state: State, seed: int) -> tuple[State, Ints, Ints]:
    """Parameters by particle swarm on the error in the readings, directions and strengths known."""
    parts = []
    for triad, earth in zip(problem.triads, problem.earth(state)[0], strict=False):
        target = np.einsum("bnij,bnj->bni", state.attitude, earth)
        found = _swarm_forward(triad.raw, target, problem.evidence.include > 0, seed)
        matrix, offset = forward_parts(found)
        back = inverse(matrix)
        parts.append(triad.model.start(back, -np.einsum("bij,bj->bi", back, offset)))
    params = np.concatenate(parts, -1)
    finite = np.isfinite(params).all(-1)
    status = np.where(finite, int(Status.OK), int(Status.NOT_FINITE))
    return replace(state, params=params), status, np.full(len(params), ITERATIONS)


def _by_newton(problem: Problem, state: State) -> tuple[State, Ints, Ints]:
    """The accelerometer by Newton-Raphson from the datasheet, then the magnetometer against it."""
    triad, evidence = problem.triads[0], problem.evidence
    batch = len(state.params)
    nominal = triad.model.start(np.zeros((batch, 3, 3)) + np.eye(3), np.zeros((batch, 3)))
    gravity = problem.constant(state, "gravity")
    noise = np.sqrt(np.mean(triad.sd**2, -1))
    weights = propagated(gravity, noise, evidence.sd["inclination"])
    weights = weights * evidence.include[..., None]
    found = newton(
        triad.model, nominal, triad.raw, problem.temperature, gravity,
        evidence.known["inclination"], weights=weights,
    )  # fmt: skip
    where = problem.slices()[0]
    params = state.params.copy()
    params[:, where] = found.params
    state = readjusted(problem, replace(state, params=params))
    if len(problem.triads) > 1:
        fixed = replace(triad, prior=np.full_like(triad.prior, HELD), expected=found.params)
        held = replace(problem, triads=(fixed, *problem.triads[1:]))
        state, status, _ = gauss_newton(held, state)
    else:
        status = found.status
    return state, np.maximum(status, found.status), found.iterations


def _swarm_forward(raw: Array, target: Array, include: Bools, seed: int) -> Array:
    """Forward parameters (B, 12); members that leave stations out fly one by one."""
    if include.all():
        return swarm_forward(raw, target, "reading", iterations=ITERATIONS, seed=seed).position
    each = [
        swarm_forward(r[keep], t[keep], "reading", iterations=ITERATIONS, seed=seed).position
        for r, t, keep in zip(raw, target, include, strict=True)
    ]
    return np.stack(each)


def _without_broken(problem: Problem) -> tuple[Problem, Bools]:
    """Members with readings that are not finite get stand-ins, so that the batch goes on."""
    finite = np.all([np.isfinite(t.raw).all((-1, -2)) for t in problem.triads], axis=0)
    if finite.all():
        return problem, finite
    pattern = np.sin(np.arange(problem.triads[0].raw[0].size) ** 1.5).reshape(-1, 3)
    triads = []
    for triad in problem.triads:
        raw = np.where(finite[:, None, None], triad.raw, pattern)
        triads.append(replace(triad, raw=raw, model=_finite_model(triad.model)))
    return replace(problem, triads=tuple(triads)), finite


def _finite_model(model: Model) -> Model:
    if isinstance(model, Factors):
        return model
    centre = np.where(np.isfinite(model.centre), model.centre, 0.0)
    return replace(model, centre=centre, scale=np.where(np.isfinite(model.scale), model.scale, 1.0))


def _estimate_noise(
    problem: Problem,
    state: State,
    status: Ints,
    declared: list[bool],
    refit: Callable[[Problem, State], tuple[State, Ints, Ints]] | None,
    rounds: int,
) -> tuple[Problem, State, Ints, Array]:
    """Variance per triad by restricted maximum likelihood, fit and estimate in turn."""
    for _ in range(rounds):
        scale = np.sqrt(analyse(problem, state).variance_factor)
        triads = tuple(
            t if known else replace(t, sd=_scaled_noise(t, scale[:, i]))
            for i, (t, known) in enumerate(zip(problem.triads, declared, strict=True))
        )
        problem = replace(problem, triads=triads)
        if refit is not None:
            state, status, _ = refit(problem, state)
        free = [i for i, known in enumerate(declared) if not known]
        if np.all(np.abs(scale[:, free] - 1) < 1e-3):
            break
    noise = [
        np.full(len(status), np.nan) if k else t.sd[:, 0, 0]
        for t, k in zip(problem.triads, declared, strict=True)
    ]
    return problem, state, status, np.stack(noise, -1)


def _scaled_noise(triad: Triad, scale: Array) -> Array:
    factor = np.where(np.isfinite(scale), scale, 1.0)[:, None, None]
    return np.maximum(triad.sd * factor, FLOOR * _size(triad.raw))


__all__ = ["METHODS", "Fit", "Status", "evidence_of", "fit", "joint", "whole_vectors"]
