"""How well each fault explains readings: the joint estimator with the calibration as prior, and faults as columns.

Members B of a batch lead the axes. Everything that is not known has a proper prior, so that the density of the
readings under each fault is one Gaussian integral about the best explanation (Laplace), and comparable.

Channels that stand at a constant: how well that explains readings, and what they then read.

How much readings speak for each fault: evidence over none, shares, and the chance of as much from a sound tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.methods import evidence_of
from mwdcal.calibration.readings import LEAST_TEMPERATURE_SPAN, TRIADS, Readings, usable_soaks
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.estimation.batch import batch_of_one, mapped, put, take
from mwdcal.estimation.problem import ANGLES, Prior, Problem, State, Triad
from mwdcal.estimation.solvers import Linear
from mwdcal.estimation.start import oriented
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    diagonal,
    inverse,
    outer,
    quotient,
    square_root,
)
from mwdcal.sensor.profile import Profile, tolerance

# --------------------------------------------------------------------------
# What a fault does to the vectors and readings of a tool: every fault is a set of elementary departures.
#
# Tools lead the axes, then stations; components of both triads follow one another, gravity first. Tool axes,
# g, nT, radians, °C.

DEAD = "dead-channel"
NONE = "none"
HEAT = "heat"
SURROUNDINGS = ("magnetised", "casing")
"""Causes outside the sensors, which may be as calibrated."""
FAULTS = ("impact", DEAD, HEAT, *SURROUNDINGS, "turn-on")
AXIS_NAMES = "xyz"
_COUNTS = {
    "bias": 6, "turn": 12, "drift-bias": 6, "drift-scale": 6, "iron": 3, "disturbance": 3, "turn-on": 6,
}  # fmt: skip
DEPARTURES = {
    name: slice(*ends)
    for name, ends in zip(_COUNTS, pairwise(accumulate(_COUNTS.values(), initial=0)), strict=True)
}
"""Where each kind of departure lies among all: see `changed_readings` and `changed_field` for what each does."""
SIZE = sum(_COUNTS.values())
"""Number of elementary departures."""
ACROSS = [(i, j) for i in range(6) for j in range(i - i % 3, i - i % 3 + 3) if j != i]
"""Channel, and component that it then reads too, of each departure "turn"."""
IRON = (70.0, 70.0, 220.0)
"""Field of a magnetised collar, nT: along the tool as AMIL of the OWSG error model (Set A, Rev 5.1), across it
as its MBXY."""
DISTURBANCE = 1_000.0
"""Field of casing or steel nearby along each axis of the Earth, nT: 2 % of it."""
TURN_ON = (4.08e-4, 70.0)
"""Bias that switching on may leave, g and nT: what the OWSG error model allows a sensor, ABXY and MBXY."""
LARGER = (1.0, 10.0, 100.0)
"""Times the usual size that a fault may have; an interference of some 1000 nT is ten times the usual one."""
SIMPLER = {"impact": ((0,),), "magnetised": ((2,), (0,), (1,), (0, 1))}
"""Sizes of a fault that it may have alone: the bias of a sensor; a field along the tool, across it."""
SIZE_RANGE = (0.5, 1.5)
"""Sizes of simulated faults are uniform between these multiples of the usual one, of either sign."""


class FaultTerm(NamedTuple):
    """One size that a fault has: its name, unit, what one of our units is in it, and the channel, if it has one.

    `channel` counts components of both triads from 0; so does `towards`, the component to which an axis turns.
    """

    name: str
    unit: str
    factor: float
    channel: int | None = None
    towards: int | None = None


@dataclass(frozen=True)
class FaultForm:
    """One way in which a kind of fault shows: on a channel, a triad, or the whole tool.

    `mixing` (SIZE, k) are the departures that its k sizes cause, each size in units of the usual one, which
    `usual` (k,) are in the units of `terms`. `channel` counts as of a `FaultTerm`; -1 and -2 are whole triads, None is
    the tool. `larger`: by how much these sizes exceed the usual ones of the fault.
    """

    kind: str
    channel: int | None
    mixing: Array
    terms: tuple[FaultTerm, ...]
    usual: Array
    larger: float = 1.0

    def part(self, columns: Sequence[int], larger: float) -> FaultForm:
        """The fault with some of its sizes alone, and those so many times as large."""
        some = list(columns)
        return FaultForm(
            self.kind, self.channel, larger * self.mixing[:, some],
            tuple(self.terms[i] for i in some), larger * self.usual[some], larger,
        )  # fmt: skip


def hypotheses(forms: Sequence[FaultForm]) -> list[FaultForm]:
    """All that may explain readings: each fault, its simpler forms, and all of these in any of the `LARGER` sizes.

    A blow may move a bias alone, a magnetised string may have a field along one axis alone. Without these and the
    larger sizes the prior alone would tell faults apart that do the same to readings.
    """
    result = []
    for form in forms:
        whole = range(form.mixing.shape[1])
        simpler = () if (form.channel or 0) < 0 else SIMPLER.get(form.kind, ())
        for larger in LARGER:
            result += [form.part(columns, larger) for columns in (whole, *simpler)]
    return result


def faults(profile: Profile, field_unit: float = 1.0) -> list[FaultForm]:
    """All ways in which faults show, dead channels apart, of the sizes of a profile's datasheet.

    `field_unit`: what 1 nT is in the unit of the magnetometer.
    """
    unit = np.repeat([1.0, field_unit], 3)
    result = [_impact(profile, channel, unit) for channel in range(6)]
    result += [_turned(profile, triad) for triad in range(2)]
    heat = [("drift-bias", i, _drift(profile, "bias", i) * unit[i]) for i in range(6)]
    heat += [("drift-scale", i, _drift(profile, "scale", i)) for i in range(6)]
    result.append(_fault(HEAT, None, heat, field_unit))
    iron = [("iron", i, size * field_unit) for i, size in enumerate(IRON)]
    result.append(_fault("magnetised", None, iron, field_unit))
    casing = [("disturbance", i, DISTURBANCE * field_unit) for i in range(3)]
    result.append(_fault("casing", None, casing, field_unit))
    turn_on = [("turn-on", i, TURN_ON[i // 3] * unit[i]) for i in range(6)]
    return [*result, _fault("turn-on", None, turn_on, field_unit)]


def _drift(profile: Profile, name: str, channel: int) -> float:
    """Usual drift of a channel's "bias" or "scale" per °C, in g, nT or as a share."""
    return tolerance(profile, TRIADS[channel // 3], f"{name}_per_c")


def _impact(profile: Profile, channel: int, unit: Array) -> FaultForm:
    """A blow that moves the bias of one sensor and turns its axis."""
    triad = TRIADS[channel // 3]
    bias = tolerance(profile, triad, "bias") * unit[channel]
    turn = np.radians(tolerance(profile, triad, "misalignment_deg"))
    places = [place for place, (i, _) in enumerate(ACROSS) if i == channel]
    departures = [("bias", channel, bias), *(("turn", place, turn) for place in places)]
    return _fault("impact", channel, departures, unit[-1])


def _turned(profile: Profile, triad: int) -> FaultForm:
    """A blow that turns a whole triad in its housing."""
    size = np.radians(tolerance(profile, TRIADS[triad], "misalignment_deg"))
    mixing = np.zeros((SIZE, 3))
    for about in range(3):
        first, second = (3 * triad + (about + step) % 3 for step in (1, 2))
        for pair, sign in (((first, second), 1.0), ((second, first), -1.0)):
            mixing[DEPARTURES["turn"].start + ACROSS.index(pair), about] = sign * size
    terms = tuple(FaultTerm(f"turn about {axis}", "°", np.degrees(1.0)) for axis in AXIS_NAMES)
    return FaultForm("impact", -1 - triad, mixing, terms, np.full(3, np.degrees(size)))


def _fault(
    kind: str, channel: int | None, departures: list[tuple[str, int, float]], field_unit: float
) -> FaultForm:
    """A fault of elementary departures: kind, place within it and usual size of each."""
    mixing = np.zeros((SIZE, len(departures)))
    terms = []
    for column, (name, place, size) in enumerate(departures):
        mixing[DEPARTURES[name].start + place, column] = size
        terms.append(_term(name, place, field_unit))
    sizes = [size * term.factor for (_, _, size), term in zip(departures, terms, strict=True)]
    return FaultForm(kind, channel, mixing, tuple(terms), np.array(sizes))


def _term(name: str, place: int, field_unit: float) -> FaultTerm:
    """Name and unit of one elementary departure."""
    if name == "turn":
        channel, towards = ACROSS[place]
        return FaultTerm("axis turned towards", "°", np.degrees(1.0), channel, towards)
    if name in ("iron", "disturbance"):
        axis = AXIS_NAMES[place] if name == "iron" else ("north", "east", "down")[place]
        return FaultTerm(f"field {'along ' if name == 'iron' else ''}{axis}", "nT", 1 / field_unit)
    if name == "drift-scale":
        return FaultTerm("scale drift", "ppm/°C", 1e6, place)
    unit, factor = ("mg", 1e3) if place < 3 else ("nT", 1 / field_unit)
    rate = "/°C" if name == "drift-bias" else ""
    return FaultTerm("bias drift" if rate else "bias", unit + rate, factor, place)


@dataclass(frozen=True)
class Damage:
    """What has happened to tools: departures (..., SIZE), and channels (..., 6) that stand at `reading` (..., 6).

    They do so at stations warmer than `above`, °C.
    """

    departures: Array
    dead: Bools
    reading: Array
    above: float = -np.inf

    def part(self, name: str) -> Array:
        """Departures (..., 1, k) of one kind."""
        return np.asarray(self.departures[..., None, DEPARTURES[name]])

    def described(self) -> dict[str, list[float]]:
        """What has happened to one tool, by kind of departure: those that have; and dead channels (6,)."""
        kinds = {name: self.departures[where].tolist() for name, where in DEPARTURES.items()}
        dead = {"dead": self.dead.astype(float).tolist()} if self.dead.any() else {}
        return {name: values for name, values in kinds.items() if any(values)} | dead


def drawn_damage(
    rng: np.random.Generator,
    forms: Sequence[FaultForm],
    size: float = 1.0,
    lead: tuple[int, ...] = (),
) -> Damage:
    """One of the `forms` for each tool, of `size` times the usual one: uniform within `SIZE_RANGE`, of either sign."""
    departures = np.zeros((*lead, SIZE))
    chosen = rng.integers(len(forms), size=lead)
    for place, form in enumerate(forms):
        shape = *lead, form.mixing.shape[1]
        drawn = rng.uniform(*SIZE_RANGE, shape) * rng.choice([-1.0, 1.0], shape)
        mine = np.asarray(chosen == place)[..., None]
        departures += np.where(mine, size * drawn @ form.mixing.transpose(), 0.0)
    nothing = np.zeros((*lead, 6))
    return Damage(departures, nothing > 0, nothing)


def changed_field(damage: Damage, field: Array, attitude: Array) -> Array:
    """The field (..., n, 3) at the magnetometers of tools that stand at attitudes (..., n, 3, 3).

    Definition: "iron" is fixed in the tool, "disturbance" in the Earth (north, east, down).
    """
    steady = np.einsum("...nij,...nj->...ni", attitude, damage.part("disturbance") + 0 * field)
    return np.asarray(field + damage.part("iron") + steady)


def changed_readings(
    damage: Damage, raw: Array, vectors: Array, temperature: Array, reference: float,
    gain: Array | float = 1.0,
) -> Array:  # fmt: skip
    """What channels (..., n, 6) read instead of `raw`, in nominal units, at `vectors` (..., n, 6).

    Definition: "bias" and "turn-on" add; "drift-…" add to bias and scale in proportion to T - `reference`; by
    "turn" an axis comes to lie along its old direction plus this share of another one, as a unit vector, and
    reads the component there. Dead channels read what `damage` says. `gain` (..., n, 6): nominal units that a
    channel reads for one true unit along its axis.
    """
    warm = (temperature - reference)[..., None]
    result = (1 + damage.part("drift-scale") * warm) * raw
    added = damage.part("drift-bias") * warm + damage.part("bias") + damage.part("turn-on")
    turn, axes = damage.part("turn"), np.zeros((*damage.departures.shape[:-1], 1, 6, 6))
    for place, (channel, towards) in enumerate(ACROSS):
        axes[..., channel, towards] = turn[..., place]
    axes[..., range(6), range(6)] = 1.0
    axes = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    moved = np.einsum("...ij,...j->...i", axes - np.eye(6), vectors)
    broken = damage.dead[..., None, :] & (temperature[..., None] + 0 * raw > damage.above)
    return np.where(broken, damage.reading[..., None, :], result + gain * (added + moved))


def columns(
    raw: Array, vectors: Array, attitude: Array, warmth: Array, gain: Array, by_field: Array
) -> Array:
    """Change (..., n, 6, SIZE) of the readings by each departure, to first order.

    `gain` (..., n, 6): change of each channel by the field along its own axis; `by_field` (..., n, 3, 3) of the
    magnetometer's by the field of the tool.
    """
    result = np.zeros((*raw.shape, SIZE))
    every = np.arange(6)
    for name, change in (
        ("bias", gain),
        ("turn-on", gain),
        ("drift-bias", gain * warmth[..., None]),
        ("drift-scale", raw * warmth[..., None]),
    ):
        result[..., every, DEPARTURES[name].start + every] = change
    for place, (channel, towards) in enumerate(ACROSS):
        turned = gain[..., channel] * vectors[..., towards]
        result[..., channel, DEPARTURES["turn"].start + place] = turned
    result[..., 3:, DEPARTURES["iron"]] = by_field
    result[..., 3:, DEPARTURES["disturbance"]] = by_field @ attitude
    return result


FREE_SIZE = 0.3
"""Standard uncertainty of a direction that the calibration has left free: it turns or stretches by as much."""
LEAST_SD = 1e-7
"""Smallest noise of a reading that counts, as a share of the field."""
LEAST_INFORMATION = 1e-9
"""Share of the information on an offset of the stand that is more than rounding leaves of none."""
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
            sd = np.broadcast_to(triad.noise_of(readings), raw.shape)
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
    known = square_root(calibration.parameter_covariance)
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


def stand_offsets(suspect: Suspect, none: Explanation) -> tuple[Array, Array]:
    """Information (3,) on an error that all references of each of the `ANGLES` share, and its best size (3,), radians.

    Each alone, beside all that explains the readings without a fault; positive where references are too high. Zero
    where no reference, or nothing but it, tells of the angle.
    """
    nothing = np.zeros((1, SIZE, 0))
    system = _System.at(suspect, nothing, none.state, none.scores, np.zeros((1, 0)), 1.0)
    problem = system.problem
    turns, _ = problem.station_columns(none.state)
    columns = [
        problem.stand_column(none.state, f"{name}-zero", turns)
        * np.isfinite(problem.evidence.known[name])[..., None]
        for name in ANGLES
    ]
    alone = np.sum(np.square(columns), (1, 2, 3))
    beside, gradient = replace(system, seen=np.stack(columns, -1)).beside()
    information = diagonal(beside)[0]
    information = np.where(information > LEAST_INFORMATION * alone, information, 0.0)
    return information, quotient(gradient[0], information, information > 0)


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


UNSTEADY = 100.0
"""Negative log density of readings, over the root of their number, at which they are no constant."""
MOST_ONSETS = 12
"""Temperatures that are tried as the one above which a channel is dead, where there are no distinct soaks."""


@dataclass(frozen=True)
class DeadChannels:
    """Every channel at every onset, as a batch of explanations (C,).

    `channel` (C,) counts components of both triads; `onset` (C,) is the coldest temperature at which it is dead,
    -inf where it always is. `evidence` (C,) is the log density of the readings, `misfit` (C,) χ² of the others;
    `value` and `sd` (C,) are of the constant.
    """

    channel: Ints
    onset: Array
    evidence: Array
    misfit: Array
    value: Array
    sd: Array


def dead_channels(suspect: Suspect) -> DeadChannels:
    """The explanations by a dead channel of one tool.

    The constant may be anything of the size of the field. A channel that stands still may do so from some soak
    upwards, for heat breaks it.
    """
    raw, temperature = raw_of(suspect.problem)[0], suspect.problem.temperature[0]
    sd = np.concatenate([triad.sd for triad in suspect.problem.triads], -1)[0]
    onsets = _onsets(temperature)
    channel = np.repeat(np.arange(raw.shape[-1]), len(onsets))
    onset = np.tile(onsets, raw.shape[-1])
    broken = (temperature >= onset[:, None])[..., None] & (
        np.arange(raw.shape[-1]) == channel[:, None, None]
    )
    density, value, spread = _constant(raw, sd, broken, _strengths(suspect))
    steady = np.flatnonzero(density > -UNSTEADY * np.sqrt(broken.sum((-1, -2))))
    evidence, misfit = np.full((2, len(channel)), -np.inf)
    if steady.size:
        tools = repeated(suspect, np.zeros(len(steady), int))
        sound = tools.without(broken[steady])
        state = sound.start(_readable(tools, broken[steady]))
        live = explained(sound, np.zeros((len(steady), SIZE, 0)), state)
        evidence[steady], misfit[steady] = live.evidence + density[steady], live.misfit
    return DeadChannels(channel, onset, evidence, misfit, value, spread)


def _onsets(temperature: Array) -> Array:
    """Where a channel may have died: always, or from one of at most `MOST_ONSETS` temperatures upwards, °C."""
    warmer = np.unique(temperature)[1:]
    if np.ptp(temperature) < LEAST_TEMPERATURE_SPAN:
        warmer = warmer[:0]
    if len(warmer) > MOST_ONSETS:
        soak = usable_soaks(temperature)
        starts = [temperature[soak == number].min() for number in range(1, soak.max() + 1)]
        spread = np.quantile(warmer, np.linspace(0, 1, MOST_ONSETS), method="lower")
        warmer = np.unique(np.concatenate([starts, spread]) if len(starts) < 2 else starts)
    return np.concatenate([[-np.inf], warmer])


def _strengths(suspect: Suspect) -> Array:
    """Gravity and field (m,) of the stations, for each channel."""
    evidence = suspect.problem.evidence
    sizes = [np.mean(evidence.known[name]) for name in ("gravity", "field")]
    return np.repeat(sizes[: len(suspect.problem.triads)], 3)


def _constant(raw: Array, sd: Array, broken: Bools, strength: Array) -> tuple[Array, Array, Array]:
    """Log density (C,) of readings that are a constant and noise, the constant, and its uncertainty.

    The constant has the strength of the field as its standard uncertainty.
    """
    part = np.where(broken, 1 / sd**2, 0.0)
    weight = part.sum((-1, -2))
    prior = np.sum(broken.any(-2) / strength**2, -1)
    total = np.sum(part * raw, (-1, -2))
    value = total / (weight + prior)
    square = np.sum(part * raw**2, (-1, -2)) - total * value
    return -0.5 * (square + np.log1p(weight / prior)), value, 1 / np.sqrt(weight + prior)


def _readable(tools: Suspect, broken: Bools) -> Array:
    """Readings (C, n, m) with the dead ones replaced by what the strength of the field leaves for them.

    Of the two signs that which suits the dip better: only a start, from which to find the attitudes.
    """
    raw, evidence = raw_of(tools.problem).copy(), tools.problem.evidence
    best = None
    for sign in (1.0, -1.0):
        trial = raw.copy()
        for start, name in zip(range(0, raw.shape[-1], 3), ("gravity", "field"), strict=False):
            part, dead = trial[..., start : start + 3], broken[..., start : start + 3]
            square = evidence.known[name] ** 2 - np.sum(np.where(dead, 0.0, part) ** 2, -1)
            filled = sign * np.sqrt(np.maximum(square, 0.0))[..., None]
            trial[..., start : start + 3] = np.where(dead, filled, part)
        if best is None or raw.shape[-1] == 3:
            best = trial if best is None else best
            continue
        error, other = (_dip_error(each, evidence.known) for each in (best, trial))
        best = np.where((other < error)[..., None], trial, best)
    return np.asarray(best)


def _dip_error(raw: Array, known: dict[str, Array]) -> Array:
    """How far (C, n) g·b is from what strengths and dip say."""
    expected = known["gravity"] * known["field"] * np.sin(np.nan_to_num(known["dip"], nan=1.0))
    return np.asarray(np.abs(np.sum(raw[..., :3] * raw[..., 3:], -1) - expected))


FALSE_ALARMS = 0.01
"""Probability that a fault is named where there is none."""
DEAD_SHARE = 0.05
"""Share of it that goes to dead channels, whose evidence has a bound and needs no simulation."""
DRAWS = 9_999
"""Simulated changes without a fault, by which the evidence is judged."""
WITHIN, SHARE_WITHIN = 50.0, 0.2
"""Log evidence, and share of the best one, by which the linearised evidence of a form may be behind to be refined."""
UNEXPLAINED = 1e-4
"""Probability of the misfit of the best explanation below which it explains too little."""
LIKELY = 0.05
"""A fault with a larger share of the likelihood than this is not excluded."""
DISTINCT = float(np.log(1 / LIKELY))
"""Logarithm of the evidence ratio that tells two faults apart."""


@dataclass(frozen=True)
class FaultEvidence:
    """The evidence of readings of one tool for all faults; `forms` are the ways in which faults show.

    `none` explains the readings without a fault, `best` by each form that is not far behind and by the first of
    each kind, those at `likely`, as a batch; `dead` are dead channels. `by_form` (F,) is the log evidence of each
    form over none.
    """

    suspect: Suspect
    forms: list[FaultForm]
    none: Explanation
    by_form: Array
    likely: Ints
    best: Explanation
    dead: DeadChannels

    @classmethod
    def of(cls, suspect: Suspect, forms: list[FaultForm]) -> FaultEvidence:
        """Of a batch of one."""
        none = explained(suspect, np.zeros((1, SIZE, 0)), suspect.start())
        roughly = by_form(forms, none.information[0], none.gradient[0])
        if not np.isfinite(roughly).all():
            raise InputError(
                "faults cannot be weighed: values or uncertainties of the calibration and the readings are out of "
                "all proportion. Check units, noise and standard uncertainties of both."
            )
        near_best = roughly >= roughly.max() - WITHIN - SHARE_WITHIN * abs(roughly.max())
        likely = np.union1d(np.flatnonzero(near_best), _best_of_each(forms, roughly))
        near = take(none, 0 * likely)
        mixing = padded([forms[i] for i in likely])
        best = explained(repeated(suspect, 0 * likely), mixing, near.state, near)
        exactly = np.asarray(best.evidence - none.evidence)
        exactly = put(np.minimum(roughly, exactly.max() - WITHIN), likely, exactly)
        return cls(suspect, forms, none, exactly, likely, best, dead_channels(suspect))

    @property
    def information(self) -> Array:
        """Information (SIZE, SIZE) of all departures of a sound tool."""
        return np.asarray(self.none.information[0])

    def misfit(self, kind: str) -> float:
        """χ² of the readings as a fault, or none, explains them best."""
        if kind == DEAD:
            return float(self.dead.misfit[np.argmax(self.dead.evidence)])
        if kind == NONE:
            return float(self.none.misfit[0])
        return float(self.best.misfit[self._best(kind)])

    def _best(self, kind: str) -> int:
        """The place of the best form of a fault among those at `likely`."""
        where = [i for i in self.likely.tolist() if self.forms[i].kind == kind]
        return int(np.searchsorted(self.likely, max(where, key=lambda i: self.by_form[i])))

    def _whole(self, place: int) -> int:
        """The place of the fullest form of the same fault and channel as one among those at `likely`."""
        chosen = self.forms[self.likely[place]]
        same = (chosen.kind, chosen.channel, chosen.larger)
        forms = [self.forms[i] for i in self.likely]
        alike = [i for i, f in enumerate(forms) if (f.kind, f.channel, f.larger) == same]
        return max(alike, key=lambda i: len(forms[i].terms))

    def sizes(self, kind: str, whole: bool = False) -> tuple[FaultForm, Array, Array]:
        """The best form of a fault, its sizes (k,) and their covariance (k, k), in units of the usual ones.

        `whole`: with all sizes that such a fault may have, so that the uncertainty of each is not that of a simpler
        form, in which the others are exactly zero.
        """
        place = self._best(kind)
        place = self._whole(place) if whole else place
        form = self.forms[self.likely[place]]
        count = form.mixing.shape[1]
        covariance = self.best.covariance[place, :count, :count]
        return form, self.best.sizes[place, :count], covariance

    @cached_property
    def dead_ratios(self) -> Array:
        """Log evidence (C,) of each dead channel over none."""
        return np.asarray(self.dead.evidence - self.none.evidence)

    @cached_property
    def by_fault(self) -> dict[str, float]:
        """Log evidence of each fault over none: the mean over its forms; none for one that has no form here."""
        others = over_forms(self.forms, self.by_form) | {DEAD: log_mean(self.dead_ratios)}
        return {NONE: 0.0} | {name: float(others.get(name, -np.inf)) for name in FAULTS}

    def likelihoods(self) -> dict[str, float]:
        """Share of each fault, all being as likely beforehand."""
        values = np.array(list(self.by_fault.values()))
        shares = np.exp(values - values.max())
        return dict(zip(self.by_fault, (shares / shares.sum()).tolist(), strict=True))

    def probability(self, freedom: float, draws: int = DRAWS) -> float:
        """Bound on the chance of so much evidence for any fault, from a sound tool.

        Definition: a Monte Carlo test. Without a fault the gradient by all departures is Gaussian with their
        information as covariance, so that the evidence of all faults can be drawn together; it is inflated by
        Student's factor of `freedom` degrees of freedom behind the noise. An evidence ratio has the mean 1
        under none, so that for dead channels Markov's inequality bounds it.
        """
        observed = log_mean(_linear(self.forms, self.information, self.none.gradient[0]))
        rng = np.random.default_rng(0)
        root = square_root(self.information)
        sound = rng.normal(size=(draws, root.shape[1])) @ root.transpose()
        if np.isfinite(freedom):
            sound *= np.sqrt(freedom / rng.chisquare(freedom, draws))[:, None]
        beyond = log_mean(_linear(self.forms, self.information, sound)) >= observed
        by_chance = (1 + np.count_nonzero(beyond)) / (draws + 1)
        dead = np.exp(min(0.0, -self.by_fault[DEAD]))
        return float(min(1.0, by_chance / (1 - DEAD_SHARE), dead / DEAD_SHARE))


def _best_of_each(forms: list[FaultForm], evidence: Array) -> Ints:
    """The places of the best form of each kind of fault."""
    kinds = np.array([form.kind for form in forms])
    places = [np.flatnonzero(kinds == kind) for kind in dict.fromkeys(kinds.tolist())]
    return np.array([where[np.argmax(evidence[where])] for where in places], int)


def padded(forms: list[FaultForm]) -> Array:
    """Departures (F, SIZE, k) of each form, columns of zeros where it has fewer than k sizes."""
    whole = np.zeros((len(forms), SIZE, max(form.mixing.shape[1] for form in forms)))
    for place, form in enumerate(forms):
        whole[place, :, : form.mixing.shape[1]] = form.mixing
    return whole


def _linear(forms: list[FaultForm], information: Array, gradient: Array) -> Array:
    """Log evidence (..., faults) of faults over none, linearised at none, of gradients (..., SIZE)."""
    each = by_form(forms, information, gradient)
    return np.stack(list(over_forms(forms, each).values()), -1)


def by_form(forms: list[FaultForm], information: Array, gradient: Array) -> Array:
    """Log evidence (..., F) of each form over none, linearised at none, of gradients (..., SIZE)."""
    return np.stack([ratios(information, gradient, form.mixing) for form in forms], -1)


def over_forms(forms: list[FaultForm], each: Array) -> dict[str, Array]:
    """Log evidence (...) of each fault, of those (..., F) of its forms, each as likely beforehand."""
    kinds = dict.fromkeys(form.kind for form in forms)
    places = {kind: [i for i, form in enumerate(forms) if form.kind == kind] for kind in kinds}
    return {kind: log_mean(each[..., where]) for kind, where in places.items()}


def log_mean(values: Array) -> Array:
    """Logarithm (...,) of the mean of exp(values (..., k))."""
    most = values.max(-1, keepdims=True)
    most = np.where(np.isfinite(most), most, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.mean(np.exp(values - most), -1)) + most[..., 0])
