"""The methods: which evidence each uses, and how each minimises.

A method is a selection of evidence (`EVIDENCE`); most share one estimator. Newton-Raphson and the
swarm have another, as have the papers' unweighted sums (`Options.paper_weights`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from mwdcal.calibration.evidence import STAND_TURNS, acts_on, constants
from mwdcal.calibration.options import Options
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.evidence import ANGLES, UNKNOWN, Evidence, SharedConstant
from mwdcal.estimation.minimisers.unweighted import STRENGTH, Sums
from mwdcal.estimation.problem import Prior, Problem, State
from mwdcal.estimation.solvers import Status, gauss_newton
from mwdcal.estimation.uncertainty import readjusted, unweighted_pulls
from mwdcal.geometry.vectors import Array, Bools, Ints, inverse
from mwdcal.sensor.models import affine_parts

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


def solve(problem: Problem, state: State, options: Options) -> Solved:
    """The minimum that the method is defined by, from a start."""
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
    """What a paper sums over one triad, with the run's references; those unknown do not count."""
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
