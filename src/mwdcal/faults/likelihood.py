"""How well each fault explains readings: the joint estimator with the calibration as prior, and faults as columns.

Members B of a batch lead the axes. Everything that is not known has a proper prior, so that the density of the
readings under each fault is one Gaussian integral about the best explanation (Laplace), and comparable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.evidence import evidence_of
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.estimation.batch import batch_of_one, mapped, take
from mwdcal.estimation.problem import Prior, Problem, State, Triad
from mwdcal.estimation.solvers import Linear
from mwdcal.estimation.start import oriented
from mwdcal.faults.physics import columns
from mwdcal.geometry.vectors import Array, Ints, diagonal, inverse, outer

FREE_SIZE = 0.3
"""Standard uncertainty of a direction that the calibration has left free: it turns or stretches by as much."""
LEAST_SD = 1e-7
"""Smallest noise of a reading that counts, as a share of the field."""
IGNORED = 1e6
"""Factor on the noise of a channel that is taken to be dead: its readings then say nothing of anything else."""
STEPS, STEPS_FROM_NEAR = 5, 2
"""Gauss-Newton steps: departures are a few per cent of the field, and each step gains two digits or more."""


@dataclass(frozen=True)
class Suspect:
    """Tools that may be at fault: their readings as a problem, and what their calibrations leave uncertain.

    `expected` (B, p) are the parameters and `root` (B, p, k) a root of their covariance; `warmth` (B, n) is T
    less its reference.
    """

    problem: Problem
    expected: Array
    root: Array
    warmth: Array

    @classmethod
    def of(cls, calibration: Calibration, readings: Readings) -> Suspect:
        """A batch of one; `readings` have the triads of the calibration, or the accelerometer alone."""
        temperature = readings.temperature
        if temperature is None:
            temperature = np.full(readings.count, calibration.reference_temperature)
        triads = []
        for triad in calibration.triads[: len(readings.triads)]:
            raw = getattr(readings, triad.name)
            sd = np.broadcast_to(readings.sd.get(triad.name, triad.noise), raw.shape)
            floor = LEAST_SD * np.sqrt(np.mean(raw**2) + 1e-12)
            model = batch_of_one(triad.functions(calibration.reference_temperature))
            triads.append(Triad(model, raw[None], np.maximum(sd, floor)[None]))
        count = sum(triad.model.size for triad in triads)
        evidence = evidence_of(readings, np.ones(readings.count))
        if evidence.assumed:  # nobody says that stations of one direction were set together
            evidence = replace(evidence, apart=np.ones_like(evidence.apart))
        nothing = Prior(np.zeros((1, count, count)), np.zeros((1, count)))
        problem = Problem(tuple(triads), temperature[None], evidence, nothing)
        return cls(
            problem,
            calibration.parameters[None, :count],
            _root(calibration)[None, :count],
            (temperature - calibration.reference_temperature)[None],
        )

    def without(self, dead: Array) -> Suspect:
        """The same with readings left out where `dead` (B, n, m)."""
        triads, start = [], 0
        for triad in self.problem.triads:
            broken = dead[..., start : start + 3]
            triads.append(replace(triad, sd=np.where(broken, IGNORED * triad.sd, triad.sd)))
            start += 3
        return replace(self, problem=replace(self.problem, triads=tuple(triads)))

    def start(self, readable: Array | None = None) -> State:
        """Where the calibration sees the tools; `readable` (B, n, m) are readings to take for that instead."""
        level = np.broadcast_to(np.eye(3), (*self.problem.temperature.shape, 3, 3))
        empty = self.problem.start(self.expected, level)
        problem = self.problem if readable is None else with_raw(self.problem, readable)
        return oriented(problem, empty)


def _root(calibration: Calibration) -> Array:
    """Root (p, k) of the covariance of all parameters, free directions of `FREE_SIZE` in it."""
    covariance = calibration.parameter_covariance
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.concatenate([known, FREE_SIZE * calibration.free_directions.transpose()], -1)


def raw_of(problem: Problem) -> Array:
    """Readings (B, n, m) of all triads."""
    return np.concatenate([triad.raw for triad in problem.triads], -1)


def with_raw(problem: Problem, raw: Array) -> Problem:
    """The problem with other readings (B, n, m)."""
    parts = np.split(raw, len(problem.triads), -1)
    triads = [replace(t, raw=part) for t, part in zip(problem.triads, parts, strict=True)]
    return replace(problem, triads=tuple(triads))


def joined(suspects: list[Suspect]) -> Suspect:
    """One batch of several, whose problems differ in numbers alone."""
    whole: Suspect = mapped(lambda *arrays: np.concatenate(arrays), *suspects)
    return whole


def departures_seen(suspect: Suspect, state: State) -> Array:
    """Change (B, n, m, SIZE) of the readings by each departure, at the vectors and attitudes of a state."""
    problem = suspect.problem
    vectors = np.concatenate(problem.targets(state), -1)
    raw = raw_of(problem) - np.concatenate([p.misfit for p in problem.predictions(state)], -1)
    count, by_field = raw.shape[-1], np.broadcast_to(np.eye(3), state.attitude.shape)
    whole, gain = np.zeros((*raw.shape[:-1], 6)), np.ones((*raw.shape[:-1], 6))
    whole[..., :count] = raw
    for triad, where, start in zip(problem.triads, problem.slices(), (0, 3), strict=False):
        slope = triad.model.slope(state.params[:, where], triad.raw, problem.temperature)
        gain[..., start : start + 3] = 1 / diagonal(slope)
        by_field = inverse(slope)
    return columns(whole, vectors, problem.attitude(state), suspect.warmth, gain, by_field)[
        ..., :count, :
    ]


@dataclass(frozen=True)
class Explanation:
    """The best explanation of readings by a fault: `evidence` (B,), log density; its sizes (B, k).

    `covariance` (B, k, k) of the sizes; `information` (B, SIZE, SIZE) and `gradient` (B, SIZE) of all departures
    beside those explained, calibration and attitudes being uncertain; `scores` (B, k) of the calibration;
    `misfit` (B,) is χ², of at most as many degrees of freedom as there are readings.
    """

    evidence: Array
    sizes: Array
    covariance: Array
    information: Array
    gradient: Array
    state: State
    scores: Array
    misfit: Array


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def explained(
    suspect: Suspect,
    mixing: Array,
    state: State,
    near: Explanation | None = None,
    held: Array | float = 1.0,
) -> Explanation:
    """The best explanation of the readings by departures `mixing` (B, SIZE, k) times sizes of unit variance.

    `state` is where the search begins, or else it begins `near` that of sound tools, which takes fewer steps.
    Columns of zeros are sizes that nothing has. `held` (n, 1, SIZE) is 0 for departures that a station is without.
    """
    scores = np.zeros((len(mixing), suspect.root.shape[-1])) if near is None else near.scores
    sizes = np.zeros((len(mixing), mixing.shape[-1]))
    for _ in range(STEPS if near is None else STEPS_FROM_NEAR):
        system = _System.at(suspect, mixing, state, scores, sizes, held)
        step = -np.einsum("bij,bj->bi", system.covariance, system.gradient)
        state = system.moved(state, step, suspect.root)
        scores = scores + step[:, : scores.shape[1]]
        sizes = sizes + step[:, step.shape[1] - sizes.shape[1] :]
    system = _System.at(suspect, mixing, state, scores, sizes, held)
    first = system.covariance.shape[-1] - sizes.shape[-1]
    information, gradient = system.beside()
    evidence = np.nan_to_num(system.evidence(), nan=-np.inf)
    spread = system.covariance[:, first:, first:]
    return Explanation(
        evidence, sizes, spread, information, gradient, state, scores, system.misfit()
    )


@dataclass(frozen=True)
class _System:
    """Normal equations of all unknowns: scores of the calibration, shared unknowns, sizes of the fault."""

    problem: Problem
    linear: Linear
    seen: Array
    design: Array
    precision: Array
    pull: Array
    covariance: Array
    gradient: Array
    logarithm: Array

    @classmethod
    def at(
        cls, suspect: Suspect, mixing: Array, state: State, scores: Array, sizes: Array,
        held: Array | float,
    ) -> _System:  # fmt: skip
        """At a state, of the readings less what the fault does to them there."""
        seen = departures_seen(suspect, state) * held
        mixed = seen @ mixing[:, None]
        sound = raw_of(suspect.problem) - np.einsum("bnmk,bk->bnm", mixed, sizes)
        problem = with_raw(suspect.problem, sound)
        linear = problem.linear(state)
        noise = np.concatenate([triad.sd for triad in problem.triads], -1)[..., None]
        seen, mixed = -seen / noise, -mixed / noise
        p, k = linear.size, scores.shape[-1]
        known = linear.design[..., :p] @ suspect.root[:, None]
        design = np.concatenate([known, linear.shared, mixed], -1)
        shared = linear.prior[:, p:, p:]
        precision = np.broadcast_to(np.eye(design.shape[-1]), (len(scores), *design.shape[-1:] * 2))
        precision, inner = precision.copy(), slice(k, k + shared.shape[-1])
        precision[:, inner, inner] = shared
        pull = np.concatenate([scores, linear.pull[:, p:], sizes], -1)
        weighed = _rows(linear.weigh(design))
        information = weighed.mT @ _rows(design) + precision
        gradient = (weighed.mT @ _rows(linear.residual[..., None]))[..., 0]
        gradient = gradient + np.einsum("bij,bj->bi", precision, pull)
        scales = outer(np.sqrt(diagonal(information)))
        covariance = inverse(information / scales) / scales
        logarithm = np.linalg.slogdet(information)[1] - np.linalg.slogdet(shared)[1]
        return cls(problem, linear, seen, design, precision, pull, covariance, gradient, logarithm)

    def moved(self, state: State, step: Array, root: Array) -> State:
        """The state after a step; what the fault then explains is no longer in the residual."""
        k, s = root.shape[-1], self.linear.shared.shape[-1]
        fault = np.einsum("bnmk,bk->bnm", self.design[..., k + s :], step[:, k + s :])
        linear = replace(self.linear, residual=self.linear.residual + fault)
        params = np.einsum("bpk,bk->bp", root, step[:, :k])
        return self.problem.move(state, linear, np.concatenate([params, step[:, k : k + s]], -1))

    def evidence(self) -> Array:
        """Logarithm (B,) of the density of the readings, but for a constant."""
        private = -np.linalg.slogdet(self.linear.core)[1].sum(-1)
        return np.asarray(-0.5 * (self.misfit() + self.logarithm + private))

    def misfit(self) -> Array:
        """χ² (B,) of the readings and all priors, at the best values of everything."""
        linear = self.linear
        residual = linear.residual
        weighed = linear.weigh(residual[..., None])[..., 0]
        square = np.sum(residual * weighed, (-1, -2))
        square = square + np.einsum("bi,bij,bj->b", self.pull, self.precision, self.pull)
        left = np.einsum("bi,bij,bj->b", self.gradient, self.covariance, self.gradient)
        return np.asarray(square - left)

    def beside(self) -> tuple[Array, Array]:
        """Information (B, SIZE, SIZE) and gradient (B, SIZE) of all departures.

        Of the logarithm of the density by each departure, all that the system has being integrated out.
        """
        weighed = _rows(self.linear.weigh(self.seen))
        cross = weighed.mT @ _rows(self.design)
        pulled = (weighed.mT @ _rows(self.linear.residual[..., None]))[..., 0]
        inner = cross @ self.covariance
        information = weighed.mT @ _rows(self.seen) - inner @ cross.mT
        gradient = np.einsum("bij,bj->bi", inner, self.gradient) - pulled
        return (information + information.mT) / 2, gradient


def _rows(columns: Array) -> Array:
    """Columns (B, n, m, k) with all readings of all stations in one row of each: (B, n m, k)."""
    return columns.reshape(len(columns), -1, columns.shape[-1])


def ratios(information: Array, gradient: Array, mixing: Array) -> Array:
    """Log evidence (...,) of a fault over none, linearised: `information` (…, SIZE, SIZE), `mixing` (…, SIZE, k).

    Definition: bᵀ(I + A)⁻¹b / 2 - log det(I + A) / 2, A and b being those of its sizes.
    """
    inner = mixing.mT @ information @ mixing
    along = np.einsum("...ik,...i->...k", mixing, gradient)
    whole = np.eye(inner.shape[-1]) + inner
    solved = np.einsum("...k,...kj->...j", along, np.linalg.inv(whole))
    return np.asarray(0.5 * (np.sum(along * solved, -1) - np.linalg.slogdet(whole)[1]))


def repeated(suspect: Suspect, index: Ints) -> Suspect:
    """The members at `index`, as often as they stand there."""
    return take(suspect, index)
