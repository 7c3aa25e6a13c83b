"""A calibration problem: sensor models, what the stations are known to be, one residual.

Per station the raw readings are compared with what the model says the reference vectors
would have read:

    ρ = (slope⁻¹ (field(reading) - R e)) / σ

R is the station's attitude, e the earth's vectors. Every reference angle is a private
unknown with its own standard uncertainty: zero for an exact stand, π/√3 where the angle is
not known. Directions shared by a group, and unknown or uncertain field strength, dip and
gravity, are shared unknowns. Value, constant in a group, absent and exactly vertical
stations are thereby one path. Residual and Jacobian are taken at the predicted reading,
which makes this the estimator of errors in the readings for any evidence.

Batch axis B first, station next, component last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate, pairwise
from typing import Any, TypeVar

import numpy as np

from mwdcal.estimation.batch import for_all, is_once
from mwdcal.estimation.solvers import Linear
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    earth_field,
    earth_gravity,
    eigen,
    inverse,
    outer,
    quotient,
    rotation,
    skew,
)
from mwdcal.sensor.models import Model, stacked

# --------------------------------------------------------------------------
# The evidence on the stations of a run: references with their uncertainty, and errors in common.

ANGLES = ("inclination", "azimuth", "toolface")
EARTH = ("gravity", "field", "dip")
STAND = {
    "stand-north": np.array([1.0, 0.0, 0.0]),
    "stand-east": np.array([0.0, 1.0, 0.0]),
    "azimuth-zero": np.array([0.0, 0.0, 1.0]),
}
"""Turns of the stand's frame, by the earth axis (north, east, down) they are about."""
TOOL_TURNS = {"tool-axis-x": 0, "tool-axis-y": 1, "toolface-zero": 2}
"""Turns of the tool in the stand, by the axis of the tool that they are about."""
STAND_ERRORS = (*STAND, "inclination-zero", *TOOL_TURNS)
"""All errors of the stand that are common to its stations: turns of its frame, and of the tool in it, zeros of its
scales."""
WALKS = {
    "accelerometer-drift": tuple(f"accelerometer-drift-{axis}" for axis in "xyz"),
    "magnetometer-drift": tuple(f"magnetometer-drift-{axis}" for axis in "xyz"),
    "field-drift": tuple(f"field-drift-{axis}" for axis in ("north", "east", "down")),
}
"""Slow drifts within a run, with their axes: of the offsets of a triad, and of the field."""
UNKNOWN = np.pi / np.sqrt(3)
"""Standard uncertainty of an angle about which nothing is known, rad."""


@dataclass(frozen=True)
class SharedConstant:
    """A constant of the run that is estimated: gravity, field, dip, an error, or a term of a drift.

    Errors are of one of these references, or of the stand: one of `STAND_ERRORS`, each a small
    angle such that reading of the stand = value in the earth's frame + error. A term of a drift
    adds to an axis of `WALKS` in proportion to the mask.

    `mask` (B, n) says which stations it acts on; `value` (B,) is where it starts. `sd` (B,)
    is the standard uncertainty of the reference; for an unknown constant it is only a scale.
    """

    name: str
    mask: Array
    value: Array
    sd: Array
    unknown: bool


@dataclass(frozen=True)
class Evidence:
    """The evidence on the stations: arrays (B, n), radians, g, nT; NaN where unknown.

    `sd` of the angles are independent per station, but for inclination and azimuth of stations of one
    `setting` of the stand (-1: of their own): these have one error in common, and errors of their own by
    a share `apart` (B,) of the σ, which is estimated where the practice of the stand is only `assumed`.
    `settings` is the number of them, also where some members of a batch have fewer. `group` shares a direction
    among stations of the same number (-1: none). `include` is 1 for stations that count, 0 for
    those left out. `absent` names the strengths and the dip of which nothing may be used:
    each station then has its own. `stand` (B,) are the standard uncertainties of errors that all
    stations have in common, by name of `STAND_ERRORS`. `scatter` (B, n) is how far what should be
    constant departs from station to station, 1σ: "gravity" and "field" as a share, "dip" and the
    common "direction" of a group in radians. `drift` (B,) are declared drifts by name of `WALKS`, 1σ of the change
    from the first station to the last.
    """

    known: dict[str, Array]
    sd: dict[str, Array]
    group: Ints
    setting: Ints
    apart: Array
    include: Array
    constants: tuple[SharedConstant, ...]
    settings: int = 0
    assumed: bool = False
    absent: tuple[str, ...] = ()
    stand: Mapping[str, Array] = field(default_factory=dict)
    scatter: dict[str, Array] = field(default_factory=dict)
    drift: Mapping[str, Array] = field(default_factory=dict)

    def is_known(self, name: str) -> Bools:
        """Where a reference value is given (B, n)."""
        return for_all(lambda values: ~np.isnan(values), self.known[name])

    @cached_property
    def known_or_zero(self) -> dict[str, Array]:
        """The reference values, zero where unknown."""
        return {name: for_all(np.nan_to_num, values) for name, values in self.known.items()}

    @cached_property
    def members(self) -> Array:
        """Membership (B, n, k) of the k groups, as zeros and ones."""
        numbers = np.arange(int(self.group.max(initial=-1)) + 1)
        return np.asarray(self.group[..., None] == numbers, float)

    @cached_property
    def shared(self) -> dict[str, Array]:
        """Membership (B, n, k) of the groups for which the inclination, or azimuth, is a shared unknown."""
        unknown = {
            name: np.einsum("bnk,bn->bk", self.members, self.is_known(name)) == 0
            for name in ANGLES[:2]
        }
        return {name: self.members * groups[:, None, :] for name, groups in unknown.items()}

    @cached_property
    def shared_turns(self) -> Array:
        """The same (B, n, 2 k) of the inclination, then the azimuth."""
        return np.concatenate([self.shared[name] for name in ANGLES[:2]], -1)

    @cached_property
    def upright(self) -> tuple[Array, Bools, Bools]:
        """Members (B, n, k) of known toolface or azimuth, which groups (B, k) have one, and which any known angle."""
        tied = self.members * (self.is_known("toolface") | self.is_known("azimuth"))[..., None]
        inclined = self.members * self.is_known("inclination")[..., None]
        across, leant = (np.any(members > 0, -2) for members in (tied, inclined))
        return tied, across, np.asarray(across | leant)

    @cached_property
    def set_together(self) -> Array:
        """σ (B, n, 2 k) of inclination, then azimuth, that stations have from each of k settings."""
        numbers = np.arange(self.settings)
        members = np.asarray(self.setting[..., None] == numbers, float)
        each = [np.where(self.is_known(n), self.sd[n], 0.0)[..., None] for n in ANGLES[:2]]
        return np.concatenate([members * sd for sd in each], -1)

    @cached_property
    def referenced(self) -> Bools:
        """Where each angle (B, n, 3) has a reference."""
        return np.stack([self.is_known(name) for name in ANGLES], -1)

    def alone(self, name: str) -> Bools:
        """Stations (B, n) whose error of an angle is not that of a setting."""
        return np.asarray((self.setting < 0) | (name == "toolface"))

    @cached_property
    def free(self) -> Bools:
        """Stations (B, n) of which neither direction nor toolface is known."""
        given = [self.is_known(name) for name in ANGLES]
        return np.asarray(~np.any(given, 0) & (self.group < 0))

    @cached_property
    def turn_sd(self) -> Array:
        """Standard uncertainties (B, n, 3) of the angles that each station has for itself."""
        share = self.apart[:, None]
        lone = {n: self.sd[n] * np.where(self.alone(n), 1.0, share) for n in ANGLES}
        return self._turn_sd(lone)

    @cached_property
    def held_sd(self) -> Array:
        """The same (B, n, 3) of angles that have a reference, zero of the others."""
        return np.where(self.referenced, self.turn_sd, 0.0)

    @cached_property
    def about_tool(self) -> bool:
        """Whether stations turn about axes of the tool alone: all three of a free one, else the tool's own."""
        across = (self.turn_sd[..., :2] > 0).any(-1) & ~self.free
        return not (across.any() or self.set_together.any())

    @cached_property
    def exact_turn_sd(self) -> Array:
        """The same where every reference is exact."""
        return self._turn_sd(dict.fromkeys(ANGLES, np.zeros(())))

    def _turn_sd(self, stated: Mapping[str, Array]) -> Array:
        alone = [np.where(self._tied(name), 0.0, UNKNOWN) for name in ANGLES]
        given = zip(ANGLES, alone, strict=True)
        return np.stack([np.where(self.is_known(n), stated[n], sd) for n, sd in given], -1)

    def _tied(self, name: str) -> Bools:
        """Where an angle (B, n) that is unknown is that of the station's group."""
        return (self.group >= 0) & (name != "toolface")


_Result = TypeVar("_Result")

INFORMED = 1e-13
"""A prior says something of a direction if its precision exceeds this share of the largest."""
GEOMETRIC_NOISE = 1e-4
"""Noise, as a share of the field, at which rank is counted whatever the actual noise."""
WALK_AXES = {
    name: (walk, axis)
    for walk, names in enumerate(WALKS.values())
    for axis, name in enumerate(names)
}
"""Number of the walk and of its axis by the name of a constant."""
NOISELESS = ("state", "attitude", "group axes", "predictions", "linear True")
"""Entries of a problem's memo that do not depend on noise."""


@dataclass(frozen=True)
class Triad:
    """One sensor triad: model, readings (B, n, 3), their noise (B, n, 3), and whether that is declared."""

    model: Model
    raw: Array
    sd: Array
    declared: bool = True


@dataclass(frozen=True)
class State:
    """Where a fit stands: parameters (B, p), attitudes (B, n, 3, 3), constants (B, q).

    `attitude` has known angles at their references: `errors` (B, n, 3), radians, are by what a station's own
    inclination, azimuth and toolface differ from these, and `settings` (B, 2 k) by how many σ those of
    each setting of the stand do. `departures` (B, n, a) are what each station's own strengths and dip
    add where they are absent.
    """

    params: Array
    attitude: Array
    constants: Array
    departures: Array
    errors: Array
    settings: Array


@dataclass(frozen=True)
class Prediction:
    """One triad at a state: misfit of the reading, its derivatives, and the size of the field.

    `misfit` (B, n, 3) raw; `by_params` (B, n, 3, p); `by_turn` (B, n, 3, 3) for a turn of the
    station; `by_earth` (B, n, 3, 3) for its gravity, field and dip; `by_vector` (B, n, 3, 3) for
    the field's north, east and down; `vector` (B, n, 3) is the field in raw units.
    """

    misfit: Array
    by_params: Array
    by_turn: Array
    by_earth: Array
    by_vector: Array
    vector: Array

    @property
    def strength(self) -> Array:
        """Size (B, n) of the field in raw units."""
        return np.asarray(np.linalg.norm(self.vector, axis=-1))


@dataclass(frozen=True)
class Prior:
    """Prior information on all parameters: `precision` (B, p, p) about `expected` (B, p)."""

    precision: Array
    expected: Array

    @cached_property
    def is_none(self) -> bool:
        """Whether nothing is known beforehand."""
        return not self.precision.any()

    def informed(self, norms: Array) -> Array:
        """Precision (B, p, p) as large as the data's wherever it is not zero.

        It tells which directions a prior determines, however loosely; `norms` (B, p) are
        those of the data's columns.
        """
        norms = np.where(norms > 0, norms, 1.0)  # of what the data say nothing of
        scales = outer(norms)
        values, vectors = eigen(self.precision / scales)
        informed = values > INFORMED * np.maximum(values[:, -1:], 1e-300)
        known = vectors * informed[:, None, :]
        return np.asarray(known @ known.mT * scales)


@dataclass(frozen=True)
class Problem:
    """Models, readings, evidence and prior knowledge of a batch of runs.

    `memo` is what was found at the last state, by name: rank, step and analysis ask at the same one.
    """

    triads: tuple[Triad, ...]
    temperature: Array
    evidence: Evidence
    prior: Prior
    memo: dict[str, Any] = field(init=False, repr=False, compare=False, default_factory=dict)

    def with_noise(self, triads: tuple[Triad, ...], evidence: Evidence) -> Problem:
        """The same with other uncertainties alone: what does not depend on them is kept."""
        other = replace(self, triads=triads, evidence=evidence)
        other.memo.update({name: self.memo[name] for name in NOISELESS if name in self.memo})
        return other

    def start(self, params: Array, attitude: Array) -> State:
        """A state at parameters (B, p) and attitudes (B, n, 3, 3), all else at its reference."""
        shape, evidence = self.temperature.shape, self.evidence
        constants = [constant.value for constant in evidence.constants]
        return State(
            params,
            attitude,
            np.stack(constants, -1) if constants else np.zeros((shape[0], 0)),
            np.zeros((*shape, len(evidence.absent))),
            np.broadcast_to(0.0, (*shape, 3)),
            np.zeros((shape[0], evidence.set_together.shape[-1])),
        )

    def slices(self) -> list[slice]:
        """Where each triad's parameters lie."""
        ends = accumulate((t.model.size for t in self.triads), initial=0)
        return [slice(*each) for each in pairwise(ends)]

    def fields(self, state: State) -> tuple[Array, Array]:
        """Corrected vectors (B, n, 3) of both triads, left-out stations too; NaN for a missing one."""
        fields = [
            triad.model.fields(state.params[:, where], triad.raw, self.temperature)
            for triad, where in zip(self.triads, self.slices(), strict=True)
        ]
        return fields[0], fields[1] if len(fields) > 1 else np.full_like(fields[0], np.nan)

    def constant(self, state: State, name: str) -> Array:
        """Value (B, n) of gravity, field or dip at each station."""
        value = self.evidence.known_or_zero[name]
        for index, constant in enumerate(self.evidence.constants):
            if constant.name == name:
                value = value + constant.mask * state.constants[:, index, None]
        if name in self.evidence.absent:
            value = value + state.departures[..., self.evidence.absent.index(name)]
        return np.asarray(value)

    def targets(self, state: State) -> list[Array]:
        """Vectors (2, B, n, 3) that perfect triads would read: gravity, then the field."""
        return self._seen(self.attitude(state), *(self.constant(state, c) for c in EARTH))

    @staticmethod
    def _seen(attitude: Array, gravity: Array, field: Array, dip: Array) -> list[Array]:
        down = for_all(earth_gravity, gravity)
        north = for_all(earth_field, field, dip)
        if is_once(attitude, down) or is_once(attitude, north):
            return [for_all(_turned, attitude, vector) for vector in (down, north)]
        return [*(attitude @ np.stack([down, north])[..., None])[..., 0]]

    def attitude(self, state: State) -> Array:
        """Attitudes (B, n, 3, 3) with the errors of known angles in."""
        if not (state.errors.any() or state.settings.any()):
            return state.attitude
        return self.once("attitude", state, self._misaligned)

    def _misaligned(self, state: State) -> Array:
        """Base attitudes inclined, turned about down, and rolled by the errors of these angles."""
        inclination, azimuth, _ = np.moveaxis(self._angle_errors(state), -1, 0)
        tilt = rotation(inclination[..., None] * self._across(state))
        turn = rotation(azimuth[..., None] * np.array([0.0, 0.0, 1.0]))
        return np.asarray(self._rolled(state) @ tilt @ turn)

    def _rolled(self, state: State) -> Array:
        """Base attitudes rolled by the errors of toolfaces: what a turn of the base turns the tool about."""
        if not state.errors[..., 2].any():
            return state.attitude
        roll = rotation(state.errors[..., 2:] * np.array([0.0, 0.0, 1.0]))
        return np.asarray(roll @ state.attitude)

    def _angle_errors(self, state: State) -> Array:
        """Errors (B, n, 3) of known angles: the station's own and those of its setting."""
        common = self.evidence.set_together * state.settings[:, None]
        parts = np.split(common, 2, -1)
        errors = state.errors.copy()
        errors[..., :2] += np.stack([part.sum(-1) for part in parts], -1)
        return errors

    def once(self, name: str, state: State, find: Callable[[State], _Result]) -> _Result:
        """What `find` finds at a state, kept under a name until something is asked at another."""
        if self.memo.get("state") is not state:
            self.memo.clear()
            self.memo["state"] = state
        if name not in self.memo:
            self.memo[name] = find(state)
        result: _Result = self.memo[name]
        return result

    def predictions(self, state: State) -> list[Prediction]:
        """Each triad's readings compared with the reference vectors; the last answer is kept."""
        return self.once("predictions", state, self._predictions)

    def _predictions(self, state: State) -> list[Prediction]:
        gravity, field, dip = (self.constant(state, c) for c in EARTH)
        attitude = self.attitude(state)
        targets = self._seen(attitude, gravity, field, dip)
        changes = self._earth_changes(field, dip)
        if self.alike:
            params = state.params.reshape(len(attitude), 2, -1).swapaxes(0, 1)
            both = self._predicted(self.alike, params, attitude, np.stack(targets), changes)
            return [Prediction(*parts) for parts in zip(*vars(both).values(), strict=True)]
        parameters = [state.params[:, where] for where in self.slices()]
        each = zip(self.triads, parameters, targets, changes, strict=False)
        return [self._predicted(t, params, attitude, *rest) for t, params, *rest in each]

    def _predicted(
        self, triad: Triad, params: Array, attitude: Array, target: Array, change: Array
    ) -> Prediction:
        model, raw, temperature = triad.model, triad.raw, self.temperature
        some = slice(None if model.varies else 1)
        back = inverse(model.slope(params, raw[..., some, :], temperature[:, some]))
        departure = model.fields(params, raw, temperature) - target
        misfit, vector = ((back @ v[..., None])[..., 0] for v in (departure, target))
        by_vector = -back @ attitude
        by_params = back @ model.jacobian(params, raw - misfit, temperature)
        by_turn = back @ skew(target)
        return Prediction(misfit, by_params, by_turn, by_vector @ change, by_vector, vector)

    @cached_property
    def alike(self) -> Triad | None:
        """Both triads as one with a leading axis, if their models are of one kind: half as many calls."""
        first, last = self.triads[0], self.triads[-1]
        model = stacked([triad.model for triad in self.triads])
        if first is last or model is None:
            return None
        return Triad(model, np.stack([first.raw, last.raw]), np.stack([first.sd, last.sd]))

    @staticmethod
    def _earth_changes(field: Array, dip: Array) -> Array:
        """Changes (2, B, n, 3, 3) of both earth vectors, columns of each, by gravity, field and dip."""
        changes = np.zeros((2, *field.shape, 3, 3))
        north, down = np.cos(dip), np.sin(dip)
        changes[0, ..., 2, 0] = 1.0
        changes[1, ..., 0, 1], changes[1, ..., 2, 1] = north, down
        changes[1, ..., 0, 2], changes[1, ..., 2, 2] = -field * down, field * north
        return changes

    def linear(self, state: State, geometry: bool = False) -> Linear:
        """Linearise at a state; `geometry` takes references as exact and noise as uniform.

        The last answers are kept.
        """
        return self.once(f"linear {geometry}", state, partial(self._linear, geometry))

    def _linear(self, geometry: bool, state: State) -> Linear:
        if geometry and (state.errors.any() or state.settings.any()):
            state = replace(state, errors=0 * state.errors, settings=0 * state.settings)
        residual, blocks, turns, by_earth = self._whitened(state, geometry)
        angles = turns if self.evidence.about_tool else turns @ self._angle_axes(state)
        if state.errors.any():
            residual = residual - np.einsum("bnmi,bni->bnm", angles, state.errors)
        constants = self._constant_columns(state, by_earth, turns, geometry)
        if not geometry and self.walks:
            drifted = constants[..., self.walks] @ state.constants[:, None, self.walks, None]
            residual = residual + drifted[..., 0]
        settings = self._setting_columns(angles, geometry)
        shared = np.concatenate([constants, *self._group_turns(state, turns), settings], -1)
        private = [self._private_turns(angles, turns, geometry)]
        if self.evidence.absent:
            departures = by_earth[..., [EARTH.index(name) for name in self.evidence.absent]]
            private.append(departures * self._absent_scales(state)[..., None, :])
        if self.evidence.scatter and not geometry:
            columns, scatter = self.scatter_columns(state), self.evidence.scatter
            private += [c * scatter[name][..., None, None] for name, c in columns.items()]
        prior, pull = self._prior(state, blocks, shared.shape[-1], geometry)
        whole = np.concatenate(private, -1)
        held, loose = self._held(state, whole.shape[-1])
        return Linear(residual, blocks, shared, whole, prior, pull, held, loose)

    def _held(self, state: State, count: int) -> tuple[Array, Bools]:
        """Errors of known angles in units of their σ, among `count` private unknowns, and which are no angles."""
        held = np.zeros((*state.errors.shape[:2], count))
        loose = np.ones(held.shape, bool)
        sd = self.evidence.held_sd
        if not sd.any():
            return held, loose
        held[..., :3] = quotient(state.errors, sd, sd > 0)
        loose[..., :3] = sd == 0
        return held, loose

    def _whitened(
        self, state: State, geometry: bool
    ) -> tuple[Array, tuple[Array, ...], Array, Array]:
        """Predictions over the noise, or over a uniform one; zero for stations left out.

        Misfit (B, n, m), rows by the parameters of each triad, and the two of `station_columns`.
        """
        result, known = [], self.memo.get("state") is state or not geometry
        seen = self.predictions(state) if known else self._predictions(state)
        for triad, p in zip(self.triads, seen, strict=True):
            noise = GEOMETRIC_NOISE * p.strength[..., None] + np.zeros(3) if geometry else triad.sd
            w = self.evidence.include[..., None] / noise
            row = w[..., None]
            result.append((p.misfit * w, p.by_params * row, p.by_turn * row, p.by_earth * row))
        misfits, blocks, turns, by_earth = zip(*result, strict=True)
        stacked = np.concatenate(turns, -2), np.concatenate(by_earth, -2)
        return np.concatenate(misfits, -1), blocks, *stacked

    def station_columns(self, state: State) -> tuple[Array, Array]:
        """Whitened rows (B, n, m, 3) by a turn of the station, and by its gravity, field and dip."""
        return self._whitened(state, geometry=False)[2:]

    def scatter_columns(self, state: State) -> dict[str, Array]:
        """Whitened rows (B, n, m, k) by a departure of one in each of the evidence's `scatter`.

        A direction turns about x and y.
        """
        turns, by_earth = self.station_columns(state)
        columns = {}
        for name in self.evidence.scatter:
            if name == "direction":
                sharing = self.evidence.shared["inclination"].sum(-1)
                columns[name] = turns[..., :2] * sharing[..., None, None]
                continue
            size = 1.0 if name == "dip" else self.constant(state, name)[..., None, None]
            columns[name] = by_earth[..., [EARTH.index(name)]] * size
        return columns

    def resetting_columns(self, state: State) -> Array:
        """Whitened rows (B, n, m, 2) by one σ of inclination and azimuth at stations of a setting."""
        turns, _ = self.station_columns(state)
        sd = self.evidence.set_together
        each = np.stack([part.sum(-1) for part in np.split(sd, 2, -1)], -1)
        return np.asarray((turns @ self._angle_axes(state)[..., :2]) * each[..., None, :])

    def _constant_columns(
        self, state: State, by_earth: Array, turns: Array, geometry: bool
    ) -> Array:
        """Columns (B, n, m, q) of the constants; `geometry` takes references as exact."""
        columns = np.zeros((*by_earth.shape[:-1], len(self.evidence.constants)))
        if self.walks and not geometry:
            columns = self.walk_columns(state)
        for index, constant in enumerate(self.evidence.constants):
            if constant.name not in WALK_AXES and (constant.unknown or not geometry):
                if constant.name in STAND_ERRORS:
                    column = self.stand_column(state, constant.name, turns)
                else:
                    column = by_earth[..., EARTH.index(constant.name)]
                columns[..., index] = column * constant.mask[..., None]
        return columns

    @property
    def walks(self) -> list[int]:
        """Places of the constants that are terms of a drift."""
        return [i for i, c in enumerate(self.evidence.constants) if c.name in WALK_AXES]

    def walk_columns(self, state: State) -> Array:
        """Columns (B, n, m, q) of the terms of a drift; zero for other constants."""
        offset, size = np.eye(3), 3 * len(self.triads)
        columns = np.zeros((*state.attitude.shape[:2], size, len(self.evidence.constants)))
        predictions, constants = self.predictions(state), self.evidence.constants
        for index in self.walks:
            walk, axis = WALK_AXES[constants[index].name]
            triad = min(walk, 1)
            change = -offset[axis] if walk < 2 else predictions[1].by_vector[..., axis]
            weight = self.evidence.include * constants[index].mask
            rows = slice(3 * triad, 3 * triad + 3)
            columns[..., rows, index] = change * weight[..., None] / self.triads[triad].sd
        return columns

    def stand_column(self, state: State, name: str, turns: Array) -> Array:
        """Change (B, n, m) of the misfit by an error of the stand, from `turns` (B, n, m, 3)."""
        axis = np.einsum("bnij,bnj->bni", self._rolled(state), self._stand_axis(state, name))
        return np.asarray(np.einsum("bnmi,bni->bnm", turns, axis))

    def _stand_axis(self, state: State, name: str) -> Array:
        """Earth axis (B, n, 3) about which a station is turned by an error of the stand."""
        if name == "inclination-zero":
            return -self._across(state)
        if name in TOOL_TURNS:
            return np.asarray(state.attitude[..., TOOL_TURNS[name], :])
        return np.broadcast_to(STAND[name], state.attitude.shape[:-1])

    def _absent_scales(self, state: State) -> Array:
        """How far (B, n, a) each absent strength or dip may be anywhere: its own size, or any angle."""
        scales = np.zeros((*state.attitude.shape[:2], len(self.evidence.absent)))
        for index, name in enumerate(self.evidence.absent):
            scales[..., index] = UNKNOWN if name == "dip" else np.abs(self.constant(state, name))
        return scales

    def _prior(
        self, state: State, blocks: tuple[Array, ...], shared: int, geometry: bool
    ) -> tuple[Array, Array]:
        """Precision (B, u, u) and pull (B, u) of the parameters and the shared unknowns.

        `geometry` asks which directions of the parameters have a prior, not how precise it is.
        """
        p, constants = state.params.shape[-1], self.evidence.constants
        pull = np.zeros((len(state.params), p + shared))
        pull[:, :p] = state.params - self.prior.expected
        for index, constant in enumerate(constants):
            if not constant.unknown:
                pull[:, p + index] = state.constants[:, index] - constant.value
        pull[:, pull.shape[-1] - state.settings.shape[-1] :] = state.settings
        if not geometry or self.prior.is_none:
            return self.precision, pull
        norms = [np.sqrt(np.sum(block**2, (1, 2))) for block in blocks]
        precision = self.precision.copy()
        precision[:, :p, :p] = self.prior.informed(np.concatenate(norms, -1))
        return precision, pull

    @cached_property
    def precision(self) -> Array:
        """Precision (B, u, u) of the parameters and the shared unknowns, by all that is known beforehand."""
        constants, p = self.evidence.constants, self.prior.expected.shape[-1]
        groups, settings = (
            getattr(self.evidence, n).shape[-1] for n in ("shared_turns", "set_together")
        )
        diagonal = np.full(
            (len(self.temperature), p + len(constants) + groups + settings), UNKNOWN**-2
        )
        for index, constant in enumerate(constants):
            diagonal[:, p + index] = constant.sd**-2
        diagonal[:, diagonal.shape[-1] - settings :] = 1.0
        precision = diagonal[..., None] * np.eye(diagonal.shape[-1])
        precision[:, :p, :p] = self.prior.precision
        return precision

    def _angle_axes(self, state: State) -> Array:
        """Axes (B, n, 3, 3), as columns in the tool, about which inclination, azimuth and toolface turn it."""
        axes = np.zeros(state.attitude.shape)
        across = np.einsum("bnij,bnj->bni", self._rolled(state), self._across(state))
        axes[..., 0], axes[..., 1], axes[..., 2, 2] = across, self.attitude(state)[..., :, 2], 1.0
        return axes

    def _private_turns(self, angles: Array, turns: Array, geometry: bool) -> Array:
        """Columns (B, n, m, 3) of the station's private turns times their σ.

        From those of its `angles` and of `turns` about the tool's axes, which free stations have.
        """
        sd = self.evidence.exact_turn_sd if geometry else self.evidence.turn_sd
        natural, free = angles * sd[..., None, :], self.evidence.free
        if self.evidence.about_tool:
            return natural
        return np.where(free[..., None, None], UNKNOWN * turns, natural) if free.any() else natural

    def _setting_columns(self, angles: Array, geometry: bool) -> Array:
        """Columns (B, n, m, 2 k) of the settings' errors in units of their σ; none of exact references."""
        sd = self.evidence.set_together
        if geometry or not sd.shape[-1]:
            return np.zeros((*angles.shape[:-1], sd.shape[-1]))
        each = zip(np.moveaxis(angles[..., :2], -1, 0), np.split(sd, 2, -1), strict=True)
        return np.concatenate([column[..., None] * size[..., None, :] for column, size in each], -1)

    def _across(self, state: State) -> Array:
        """Earth axis (B, n, 3) about which a station inclines: horizontal, across its azimuth.

        Singular: at vertical a known azimuth or toolface still says which way a station inclines.
        """
        axis, known = state.attitude[..., 2, :], self.evidence.known
        azimuth = np.arctan2(axis[..., 1], axis[..., 0])
        azimuth = np.where(np.isnan(known["azimuth"]), azimuth, known["azimuth"])
        across = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(azimuth)], -1)
        by_toolface = np.isnan(known["azimuth"]) & ~np.isnan(known["toolface"])
        if not by_toolface.any():
            return across
        toolface = self.evidence.known_or_zero["toolface"]
        fixed = np.stack([np.cos(toolface), -np.sin(toolface), np.zeros_like(toolface)], -1)
        turned = np.einsum("bnij,bni->bnj", state.attitude, fixed)
        return np.where(by_toolface[..., None], turned, across)

    def _group_axes(self, state: State) -> Array:
        """Earth axes (B, 2, k, 3) of each group's shared turns: inclining, and across or about down."""
        if self.memo.get("state") is not state:
            return self._find_group_axes(state)
        return self.once("group axes", state, self._find_group_axes)

    def _find_group_axes(self, state: State) -> Array:
        axis = self._mean_of(self.evidence.members, state.attitude[..., 2, :])
        tied, across, upright = self.evidence.upright
        azimuth = np.arctan2(axis[..., 1], axis[..., 0])
        axes = np.zeros((len(axis), 2, *axis.shape[1:]))
        axes[:, 0, :, 0], axes[:, 0, :, 1] = np.sin(azimuth), -np.cos(azimuth)
        if across.any():
            along = self._mean_of(tied, self._across(state))
            size = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-300)
            axes[:, 0] = np.where(across[..., None], along / size, axes[:, 0])
        second = (skew(axis) @ axes[:, 0, :, :, None])[..., 0]
        axes[:, 1] = np.where(upright[..., None], np.array([0.0, 0.0, 1.0]), second)
        return axes

    @staticmethod
    def _mean_of(members: Array, vectors: Array) -> Array:
        """Mean (B, k, 3) of vectors (B, n, 3) over the members (B, n, k) of each group."""
        count = np.maximum(members.sum(-2), 1.0)
        return np.asarray(members.mT @ vectors / count[..., None])

    def _group_turns(self, state: State, turns: Array) -> list[Array]:
        """Columns (B, n, m, k) of both shared turns of each group."""
        if not self.evidence.members.size:
            return []
        axes, shared = self._group_axes(state), self.evidence.shared_turns
        rolled, attitude = self._rolled(state), self.attitude(state)
        if rolled is attitude:
            parts = [(attitude, axes.reshape(len(axes), -1, 3), shared)]
        else:
            first, second = np.split(shared, 2, -1)
            parts = [(rolled, axes[:, 0], first), (attitude, axes[:, 1], second)]
        return [(turns @ base @ axis[:, None].mT) * who[..., None, :] for base, axis, who in parts]

    def move(self, state: State, linear: Linear, step: Array) -> State:
        """The state after a step; unknown private angles and the errors of known ones follow."""
        p, q, evidence = linear.size, len(self.evidence.constants), self.evidence
        first = step.shape[-1] - state.settings.shape[-1]
        private = linear.private_step(step)
        attitude = self._turn_stand(state, step[:, p : p + q])
        base = state if attitude is state.attitude else replace(state, attitude=attitude)
        attitude = self._turn_groups(base, step[:, p + q : first])
        attitude = self._turn_stations(state, attitude, private[..., :3])
        absent = private[..., 3 : 3 + state.departures.shape[-1]]
        departures = state.departures + absent * self._absent_scales(state)
        constants = state.constants + step[:, p : p + q]
        errors = private[..., :3] * evidence.turn_sd * evidence.referenced
        settings = state.settings + step[:, first:]
        return State(state.params + step[:, :p], attitude, constants, departures, errors, settings)

    def _turn_stand(self, state: State, constants: Array) -> Array:
        attitude = state.attitude
        for index, constant in enumerate(self.evidence.constants):
            if constant.name in STAND_ERRORS:
                turn = constants[:, index, None] * constant.mask
                axis = self._stand_axis(state, constant.name)
                attitude = attitude @ rotation(turn[..., None] * axis)
        return attitude

    def _turn_groups(self, state: State, turns: Array) -> Array:
        attitude = state.attitude
        if not turns.size:
            return attitude
        evidence, axes = self.evidence, self._group_axes(state)
        sizes = turns * evidence.shared_turns.any(-2)
        first, second = np.moveaxis(rotation(sizes.reshape(*axes.shape[:-1], 1) * axes), 1, 0)
        whole = (first @ second - np.eye(3)).reshape(*first.shape[:-2], 9)
        turned = (evidence.members @ whole).reshape(attitude.shape)
        return np.asarray(attitude + attitude @ turned)

    def _turn_stations(self, state: State, attitude: Array, private: Array) -> Array:
        """Attitudes with unknown angles turned by private unknowns (B, n, 3) in units of their σ."""
        sd = self.evidence.exact_turn_sd
        if not sd.any():
            return attitude
        if self.evidence.about_tool:
            return np.asarray(rotation(sd * private) @ attitude)
        bare = replace(state, errors=0 * state.errors, settings=0 * state.settings)
        free, turn = self.evidence.free, (sd * private)[..., None, :] * self._angle_axes(bare)
        about_down = np.zeros(turn.shape[:-1])
        about_down[..., 2] = sd[..., 1] * private[..., 1]
        natural = rotation(turn[..., 2]) @ rotation(turn[..., 0]) @ attitude @ rotation(about_down)
        if not free.any():
            return np.asarray(natural)
        whole = rotation(UNKNOWN * private) @ attitude
        return np.where(free[..., None, None], whole, natural)


def _turned(attitude: Array, vector: Array) -> Array:
    """Vectors (B, n, 3) of the earth as tools of an attitude (B, n, 3, 3) see them."""
    return np.asarray((attitude @ vector[..., None])[..., 0])
