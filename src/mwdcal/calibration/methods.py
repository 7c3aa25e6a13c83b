"""The methods: which evidence each uses, and how each minimises.

A method is a selection of evidence (`EVIDENCE`); most share one estimator. Newton-Raphson and the
swarm have another, as have the papers' unweighted sums (`Options.paper_weights`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from mwdcal.calibration.options import DIRECTION, Options, numbered
from mwdcal.calibration.readings import CONSTANTS, Readings
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.drift import walk_constants
from mwdcal.estimation.minimisers import stand_factors
from mwdcal.estimation.minimisers.unweighted import STRENGTH, Sums
from mwdcal.estimation.problem import (
    ANGLES,
    UNKNOWN,
    WALKS,
    Evidence,
    Prior,
    Problem,
    SharedConstant,
    State,
)
from mwdcal.estimation.solvers import Status, gauss_newton
from mwdcal.estimation.start import start
from mwdcal.estimation.uncertainty import readjusted, unweighted_pulls
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints, distinct, inverse
from mwdcal.sensor.models import affine_parts
from mwdcal.sensor.profile import COMMON

# --------------------------------------------------------------------------
# What a run's readings say about its stations: references, uncertainties, groups, constants.

STAND_TURNS = {"tilt": ("stand-north", "stand-east"), "tool-axis": ("tool-axis-x", "tool-axis-y")}
"""Errors of the stand that consist of several turns."""


def flat(value: AnyArray, lead: tuple[int, ...], *tail: int) -> AnyArray:
    """A value with one batch axis: (B, n, *tail)."""
    shape = (*lead, *tail)
    value = np.asarray(value)
    whole = value if value.shape == shape else np.broadcast_to(value, shape)
    return whole.reshape(math.prod(lead[:-1]), lead[-1], *tail)


def evidence_of(readings: Readings, include: Array) -> Evidence:
    """References and uncertainties of all stations of readings, with one batch axis (B, n)."""
    lead = np.broadcast_shapes(readings.accelerometer.shape[:-1], include.shape)
    known = {n: flat(readings.reference(n), lead) for n in ANGLES + CONSTANTS}
    sd = {n: flat(readings.uncertainty(n), lead) for n in ANGLES + CONSTANTS}
    group = _shared_groups(flat(readings.groups, lead))
    included = flat(include, lead).astype(float)
    nowhere = np.isnan(known["field"]).all(-1, keepdims=True)
    known["field"] = np.where(nowhere, 1.0, known["field"])
    if readings.magnetometer is None:  # unread: any value will do
        known |= {name: np.nan_to_num(known[name], nan=1.0) for name in ("field", "dip")}
        sd |= {name: np.zeros(group.shape) for name in ("field", "dip")}
    alone = np.full(group.shape, -1)
    apart, stand = np.zeros(len(group)), _stand(readings, lead)
    drift = _declared(readings, [*WALKS][: 2 * len(readings.triads) - 1], lead)
    bare = Evidence(known, sd, group, alone, apart, included, (), stand=stand, drift=drift)
    known, sd = _share_known(bare)
    setting = _settings(readings, group, known, sd)
    settings, assumed = int(setting.max(initial=-1)) + 1, not readings.settings
    bare = replace(bare, known=known, sd=sd, setting=setting, settings=settings, assumed=assumed)
    return replace(bare, constants=constants(bare))


def _settings(
    readings: Readings, group: Ints, known: dict[str, Array], sd: dict[str, Array]
) -> Ints:
    """Number (B, n) of the setting of the stand that a station shares with others, -1 of its own.

    Exact references have none.
    """
    angles = [known[name] for name in DIRECTION]
    uncertain = np.any([sd[name] > 0 for name in DIRECTION], 0)
    if not uncertain.any():
        return np.full(group.shape, -1)
    number = numbered(group, angles, readings.settings)
    return _shared_groups(np.where(uncertain, number, -1))


def _stand(readings: Readings, lead: tuple[int, ...]) -> dict[str, Array]:
    """Standard uncertainties (B,) of errors of the stand, of each turn that they consist of.

    A tilt of known size leans to any azimuth, a tool's axis to any side: each of the two turns has half the variance.
    """
    turn_sd: dict[str, Array] = {}
    for name, size in _declared(readings, COMMON, lead).items():
        turns = STAND_TURNS.get(name, (name,))
        turn_sd |= dict.fromkeys(turns, size / math.sqrt(len(turns)))
    return turn_sd


def _declared(readings: Readings, names: Iterable[str], lead: tuple[int, ...]) -> dict[str, Array]:
    """Declared standard uncertainties (B,) of errors that all stations share."""
    given = [name for name in names if name in readings.sd]
    return {name: flat(readings.uncertainty(name), lead).max(-1) for name in given}


def acts_on(evidence: Evidence, name: str) -> Array:
    """Stations (B, n), as zeros and ones, whose references have an error of the stand."""
    angle = name.removesuffix("-zero") if name.endswith("-zero") else "inclination"
    return evidence.is_known(angle).astype(float)


def _shared_groups(group: Ints) -> Ints:
    """Group numbers (B, n) without gaps, -1 where a station is alone in its group."""
    if (group < 0).all():
        return np.full(group.shape, -1)
    labels, compact = np.unique(group, return_inverse=True)
    keys = compact.reshape(group.shape) + len(labels) * np.arange(len(group))[:, None]
    _, where, counts = np.unique(keys, return_inverse=True, return_counts=True)
    shared = (counts[where].reshape(group.shape) > 1) & (group >= 0)
    kept = distinct(group[shared])
    return np.where(shared, np.searchsorted(kept, group), -1)


def _share_known(evidence: Evidence) -> tuple[dict[str, Array], dict[str, Array]]:
    """References and their σ where blank angles of a group take the mean of its filled cells.

    One error is then common to the group: that of its filled cells, whose mean has no smaller one.
    """
    known, spread = dict(evidence.known), dict(evidence.sd)
    if (evidence.group < 0).all():
        return known, spread
    for name in ("inclination", "azimuth"):
        given = evidence.is_known(name)
        if given.all() or not given.any():
            continue
        filled = evidence.members * given[..., None]
        count, total = filled.sum(-2), evidence.members.sum(-2)
        turn = np.einsum("bnk,bn->bk", filled, np.exp(1j * np.nan_to_num(known[name])))
        square = np.einsum("bnk,bn->bk", filled, evidence.sd[name] ** 2)
        partly = (count > 0) & (count < total)
        common = np.sqrt(square / np.maximum(count, 1)) * partly
        common = np.einsum("bnk,bk->bn", evidence.members, common)
        mean = np.einsum("bnk,bk->bn", evidence.members, np.angle(turn))
        within = np.einsum("bnk,bk->bn", evidence.members, partly) > 0
        known[name] = np.where(within & ~given, mean, known[name])
        spread[name] = np.where(within, common, evidence.sd[name])
    return known, spread


def constants(evidence: Evidence) -> tuple[SharedConstant, ...]:
    """Constants of the run to estimate: unknown ones, and errors of uncertain references."""
    shared = []
    for name, size in (("gravity", 1.0), ("field", 0.0), ("dip", UNKNOWN)):
        if name in evidence.absent:
            continue
        known = evidence.is_known(name)
        if not known.all():
            value = np.nansum(evidence.known[name], -1) / np.maximum(known.sum(-1), 1)
            value = np.nan_to_num(value)
            scale = np.full(len(value), size) if size else np.where(value > 0, value, 1.0)
            shared.append(SharedConstant(name, (~known).astype(float), value, scale, unknown=True))
        sd = np.max(np.where(known, evidence.sd[name], 0.0), -1)
        shared += _common_error(name, known.astype(float), sd)
    for name, sd in evidence.stand.items():
        shared += _common_error(name, acts_on(evidence, name), sd)
    return (*shared, *walk_constants(declared_sizes(evidence), evidence.include.shape[-1]))


def declared_sizes(evidence: Evidence) -> dict[str, Array]:
    """Trend and walk (B, 2) of each declared drift: nobody knows which it is, so each has half of the variance."""
    parts = np.full(2, math.sqrt(0.5))
    sizes = {name: np.maximum(size, 1e-12) for name, size in evidence.drift.items() if size.any()}
    return {name: size[:, None] * parts for name, size in sizes.items()}


def _common_error(name: str, mask: Array, sd: Array) -> list[SharedConstant]:
    """An error of standard uncertainty `sd` (B,) that stations share; none where all of that is zero."""
    if not ((sd > 0).any() and mask.any()):
        return []
    floor = np.where(sd > 0, sd, 1e-12)
    return [SharedConstant(name, mask, np.zeros(len(sd)), floor, unknown=False)]


ESTIMABLE = {
    name: STAND_TURNS.get(name, (name,)) for name in ("azimuth-zero", "inclination-zero", "tilt")
}
"""Errors of the stand that can be estimated, and the constants of the run that each consists of."""
HELD_PRECISION = 1e18
"""Precision of a parameter that is held at its value."""
SWARM_ITERATIONS = 600
"""Iterations of the swarm, as Moradi's."""
PAPER_WEIGHT = 1e10
"""Weight of every square of an unweighted sum: only its digits matter, not the minimum."""


def check_stand_errors(names: Sequence[str], method: str) -> None:
    """Refuse errors of the stand that cannot be estimated, whatever the stations."""
    for name in names:
        if name == "toolface-zero":
            raise FitError(
                "`estimate` toolface-zero: a zero of the stand's toolface can never be told from a "
                "rotation of the sensors in the tool, whatever the stations. Set it by an index mark."
            )
        if name not in ESTIMABLE:
            raise InputError(
                f"`estimate` must be of {', '.join(ESTIMABLE)}; got {name!r}. Unknown field and dip "
                "are estimated without being asked for."
            )
    if names and method != "joint":
        raise InputError(f"`estimate` needs `method` joint; got {method!r}.")


def without_groups(evidence: Evidence, *blank: str) -> Evidence:
    """The evidence of every station by itself, without some references."""
    nothing = {name: np.full_like(evidence.known[name], np.nan) for name in blank}
    alone = np.full_like(evidence.group, -1)
    return replace(evidence, known=evidence.known | nothing, group=alone)


def whole_vectors(evidence: Evidence) -> Evidence:
    """Reference vectors only, taken as exact: least squares as in the six-state test."""
    exact = {name: np.zeros_like(sd) for name, sd in evidence.sd.items()}
    return replace(without_groups(evidence), sd=exact)


def angles_alone(evidence: Evidence) -> Evidence:
    """Inclination and toolface of the accelerometer, without |g| (Ivanov); scale stays nominal."""
    return without(evidence, "gravity")


def strengths_alone(evidence: Evidence) -> Evidence:
    """|g| and |b| at every station, and nothing else: the scalar (total field) method."""
    return without(without_groups(evidence, *ANGLES, "dip"), "dip")


def inclination_and_strength(evidence: Evidence) -> Evidence:
    """|g| and inclination of the accelerometer (Moosavi); azimuth, |b| and dip of the magnetometer."""
    return without(without_groups(evidence, "toolface"))


def without(evidence: Evidence, *names: str) -> Evidence:
    """The evidence without some strengths or the dip: they differ from station to station."""
    changed = replace(evidence, absent=tuple(dict.fromkeys((*evidence.absent, *names))))
    return replace(changed, constants=constants(changed))


def with_stand_errors(evidence: Evidence, names: tuple[str, ...]) -> Evidence:
    """The evidence with errors of the stand (see `ESTIMABLE`) as unknown constants of the run."""
    turns = [turn for error in names for turn in ESTIMABLE[error]]
    shared = [constant for constant in evidence.constants if constant.name not in turns]
    zero = np.zeros(len(evidence.include))
    for name in turns:
        sd, mask = np.full(len(zero), UNKNOWN), acts_on(evidence, name)
        shared.append(SharedConstant(name, mask, zero, sd, unknown=True))
    return replace(evidence, constants=tuple(shared))


def with_constant_errors(
    problem: Problem, state: State, names: Sequence[str]
) -> tuple[Problem, State]:
    """The problem with unknown errors of the stand (see `ESTIMABLE`) or of "dip-reference", and the state for it."""
    old = problem.evidence.constants
    evidence = with_stand_errors(problem.evidence, tuple(n for n in names if n in ESTIMABLE))
    if "dip-reference" in names:
        mask, zero = evidence.is_known("dip").astype(float), np.zeros(len(evidence.include))
        error = SharedConstant("dip", mask, zero, zero + UNKNOWN, unknown=True)
        others = (c for c in evidence.constants if c.name != "dip" or c.unknown)
        evidence = replace(evidence, constants=(*others, error))
    values = {(c.name, c.unknown): v for c, v in zip(old, state.constants.T, strict=True)}
    constants = [
        values.get((c.name, c.unknown), values.get((c.name, False), c.value))
        for c in evidence.constants
    ]
    there = replace(state, constants=np.stack(constants, -1))
    return replace(problem, evidence=evidence), there


EVIDENCE: dict[str, Callable[[Evidence], Evidence]] = {
    "joint": lambda evidence: evidence,
    "least-squares": whole_vectors,
    "newton": inclination_and_strength,
    "swarm": whole_vectors,
    "toolface-inclination": angles_alone,
    "scalar": strengths_alone,
}
"""The evidence that each method uses of the evidence: "joint" all of it, weighted by its uncertainty."""


@dataclass(frozen=True)
class Solved:
    """A minimum: state, `Status` codes and iterations (B,), and the sums it minimises, by triad.

    Triads without an entry in `sums` have the likelihood of their readings at its largest; for
    the others `known` (B, p_t, p_t) is the information of what they are fitted to. `unweighted`:
    least squares with all readings of a triad alike, whatever their noise.
    """

    state: State
    status: Ints
    iterations: Ints
    sums: dict[int, Sums] = field(default_factory=dict)
    known: dict[int, Array] = field(default_factory=dict)
    unweighted: bool = False

    def influence(self, problem: Problem, state: State) -> dict[int, Array]:
        """How an error of a station's whitened reading moves the triads that minimise `sums`.

        (B, n, p_t, 3) by triad; none where the likelihood is at its largest.
        """
        if self.unweighted:
            return unweighted_pulls(problem, _alike(problem), state)
        if not self.sums:
            return {}
        triples = zip(problem.triads, problem.slices(), problem.targets(state), strict=False)
        return {
            index: replace(self.sums[index], triad=triad).influence(_alone(state, where), target)
            for index, (triad, where, target) in enumerate(triples)
            if index in self.sums
        }


def _alone(state: State, where: slice) -> State:
    """The state with the parameters of one triad."""
    return replace(state, params=state.params[:, where])


def solve(problem: Problem, state: State | None, options: Options) -> Solved:
    """The minimum that the method is defined by, from a state, or a start of its own."""
    if not options.separate_solver and stand_factors.applies(problem):
        return Solved(*stand_factors.minimum(problem, state))
    state = state or start(problem)
    if options.method == "swarm":
        return _swarmed(problem, state, options.seed)
    if options.method == "newton":
        return _by_newton(problem, state, options.paper_weights)
    if options.paper_weights and options.method in ("toolface-inclination", "scalar"):
        return _by_sums(problem, state, options.method)
    if options.paper_weights:
        return Solved(*gauss_newton(_alike(problem), state), unweighted=True)
    return Solved(*gauss_newton(problem, state))


def _alike(problem: Problem) -> Problem:
    """The problem with one noise for all readings of a triad, as an unweighted sum has it."""
    means = (np.sqrt(np.mean(t.sd**2, (1, 2), keepdims=True)) for t in problem.triads)
    pairs = zip(problem.triads, means, strict=True)
    return replace(problem, triads=tuple(replace(t, sd=mean + 0 * t.sd) for t, mean in pairs))


def _swarmed(problem: Problem, state: State, seed: int) -> Solved:
    """Parameters by particle swarm on the error in the readings, directions and strengths known."""
    parts = []
    for triad, target in zip(problem.triads, problem.targets(state), strict=False):
        forward = _swarm_forward(triad.raw, target, problem.evidence.include > 0, seed)
        matrix, offset = affine_parts(forward)
        back = inverse(matrix)
        parts.append(triad.model.start(back, -np.einsum("bij,bj->bi", back, offset)))
    params = np.concatenate(parts, -1)
    finite = np.isfinite(params).all(-1)
    status = np.where(finite, int(Status.OK), int(Status.NOT_FINITE))
    flown = np.full(len(params), SWARM_ITERATIONS)
    return Solved(replace(state, params=params), status, flown, unweighted=True)


def _swarm_forward(raw: Array, target: Array, include: Bools, seed: int) -> Array:
    """Forward parameters (B, 12); members that leave stations out fly one by one."""
    from mwdcal.estimation.minimisers.swarm import swarm_forward

    fly = partial(swarm_forward, iterations=SWARM_ITERATIONS, seed=seed)
    if include.all():
        return fly(raw, target).position
    members = zip(raw, target, include, strict=True)
    return np.stack([fly(r[keep], t[keep]).position for r, t, keep in members])


def _by_newton(problem: Problem, state: State, paper: bool) -> Solved:
    """The accelerometer by Newton-Raphson from the datasheet, then the magnetometer against it."""
    from mwdcal.estimation.minimisers.newton import newton, propagated

    triad, evidence = problem.triads[0], problem.evidence
    batch = len(state.params)
    nominal = triad.model.start(np.zeros((batch, 3, 3)) + np.eye(3), np.zeros((batch, 3)))
    gravity = problem.constant(state, "gravity")
    noise = np.sqrt(np.mean(triad.sd**2, -1))
    weights = np.full((*gravity.shape, 2), PAPER_WEIGHT)
    if not paper:
        lone = np.where(evidence.alone("inclination"), evidence.sd["inclination"], 0.0)
        weights = propagated(gravity, noise, lone)
    weights = weights * evidence.include[..., None]
    minimum = newton(
        triad.model, nominal, triad.raw, problem.temperature, gravity,
        evidence.known["inclination"], weights=weights,
    )  # fmt: skip
    sums = _sums(problem, state, 0, (STRENGTH, "inclination"), weights)
    later = _magnetometer(problem, state, minimum.params)
    status = np.maximum(later.status, minimum.status)
    return Solved(later.state, status, minimum.iterations, {0: sums}, {0: minimum.information})


def _by_sums(problem: Problem, state: State, method: str) -> Solved:
    """The accelerometer, or with |v| alone both triads, by an unweighted sum of squares."""
    scalar = method == "scalar"
    names = (STRENGTH,) if scalar else ("toolface", "inclination")
    include = problem.evidence.include[..., None]
    sums, minima = {}, []
    for index in range(len(problem.triads) if scalar else 1):
        strength = problem.constant(state, ("gravity", "field")[index]).mean(-1)[:, None, None]
        weights = (
            include * (PAPER_WEIGHT / strength**4 if scalar else PAPER_WEIGHT) * np.ones(len(names))
        )
        sums[index] = _sums(problem, state, index, names, weights)
        minima.append(gauss_newton(sums[index], _alone(state, problem.slices()[index])))
    params = np.concatenate([each[0].params for each in minima], -1)
    status = np.max([each[1] for each in minima], 0)
    iterations = np.max([each[2] for each in minima], 0)
    if scalar:
        after = Solved(readjusted(problem, replace(state, params=params)), status, iterations)
    else:
        after = _magnetometer(problem, state, params)
    pairs = zip(sums.items(), minima, strict=True)
    known = {index: one.information(each[0]) for (index, one), each in pairs}
    return Solved(after.state, np.maximum(status, after.status), iterations, sums, known)


def _sums(
    problem: Problem, state: State, index: int, names: tuple[str, ...], weights: Array
) -> Sums:
    """The paper's terms of one triad, with the run's references; those unknown do not count."""
    evidence, strength = problem.evidence, ("gravity", "field")[index]
    value = problem.constant(state, strength)
    known = [value**2 if n == STRENGTH else evidence.known[n] for n in names]
    reference = np.stack(known, -1)
    weights = weights * ~np.isnan(reference)
    triad, temperature = problem.triads[index], problem.temperature
    return Sums(triad, temperature, names, np.nan_to_num(reference), weights)


def _magnetometer(problem: Problem, state: State, accelerometer: Array) -> Solved:
    """The magnetometer by all its evidence, the accelerometer's parameters (B, p) being held."""
    where = problem.slices()[0]
    params, precision = state.params.copy(), problem.prior.precision.copy()
    params[:, where] = accelerometer
    state = readjusted(problem, replace(state, params=params))
    if len(problem.triads) == 1:
        none = np.zeros(len(params), int)
        return Solved(state, none, none)
    precision[:, where, :] = precision[:, :, where] = 0.0
    precision[:, where, where] = HELD_PRECISION * np.eye(accelerometer.shape[-1])
    expected = problem.prior.expected.copy()
    expected[:, where] = accelerometer
    held = replace(problem, prior=Prior(precision, expected))
    return Solved(*gauss_newton(held, state))
