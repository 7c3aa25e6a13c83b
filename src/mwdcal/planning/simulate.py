"""Simulated tools and their readings, of many at once: for planning, examples, tests and studies.

Tools lead the axes, then stations (n,), the component axis is last. Always labelled simulated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.prediction import raw_reading
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings
from mwdcal.calibration.settings import DIRECTION, settings_of
from mwdcal.estimation.evidence import ANGLES
from mwdcal.faults.physics import Damage, changed_field, changed_readings
from mwdcal.geometry.vectors import (
    Array,
    diagonal,
    earth_field,
    earth_gravity,
    reference_vectors,
    rotation,
    tool_from_earth,
)
from mwdcal.planning.effects import Effects, approach, response, wandering
from mwdcal.planning.plans import ROOM_TEMPERATURE
from mwdcal.sensor.datasheets import ROOT3, tolerance
from mwdcal.sensor.models import Basis, Factors, Model
from mwdcal.sensor.profile import COMMON, Datasheet, Profile, TriadProfile

DRIFT_POWERS = np.array([1.0, 1e-3, 1e-6])
"""Powers of a drift over temperature: the square and the cube are a tenth and a hundredth of it over 100 °C."""


class Earth(NamedTuple):
    """Gravity, g, field, nT, and dip, radians, of a place."""

    gravity: float = 1.0
    field: float = 48_000.0
    dip: float = float(np.radians(63.0))


@dataclass(frozen=True)
class StationPlan:
    """Attitudes (n,) in radians and temperatures (n,) in °C, in the order they are measured."""

    inclination: Array
    azimuth: Array
    toolface: Array
    temperature: Array

    @property
    def count(self) -> int:
        """Number of stations."""
        return len(self.inclination)


def grid(
    inclinations: list[float], toolfaces: int, azimuths: list[float], temperatures: list[float]
) -> StationPlan:
    """Every toolface at every inclination (degrees), azimuths in turn, at every temperature."""
    inc = np.repeat(np.radians(inclinations), toolfaces)
    tool = np.tile(np.arange(toolfaces) * 2 * np.pi / toolfaces, len(inclinations))
    azi = np.repeat(np.resize(np.radians(azimuths), len(inclinations)), toolfaces)
    count, soaks = len(inc), len(temperatures)
    return StationPlan(
        np.tile(inc, soaks),
        np.tile(azi, soaks),
        np.tile(tool, soaks),
        np.repeat(temperatures, count),
    )


@dataclass(frozen=True)
class Truth:
    """Tools of two triads, parameters (..., k) each, and the earth they stand on.

    The parameters are factors (30 at order 3) unless `forms` gives the models of the triads. `curves` (..., 3, 2) of
    each triad, or None: own-axis quadratic and cubic error along each axis where gravity or field is all on it, as
    shares of them. `turn_on` (..., 3) by triad is the bias of readings that the last switching on has left.
    """

    accelerometer: Array
    magnetometer: Array | None
    order: int = 3
    reference: float = 30.0
    gravity: float = 1.0
    field: float = 48_000.0
    dip: float = np.radians(63.0)
    forms: tuple[Model, ...] = ()
    curves: tuple[Array | None, ...] = ()
    turn_on: Mapping[str, Array] = dataclasses.field(default_factory=dict)

    @property
    def model(self) -> Factors:
        """The model of both triads."""
        return Factors(Basis(self.order, self.reference))

    @property
    def triads(self) -> dict[str, tuple[Model, Array]]:
        """Model and parameters by triad."""
        parameters = [p for p in (self.accelerometer, self.magnetometer) if p is not None]
        models: tuple[Model, ...] = self.forms or (self.model,) * len(parameters)
        return dict(zip(TRIADS, zip(models, parameters, strict=True), strict=False))

    def readings(self, vectors: tuple[Array, Array], temperature: Array) -> dict[str, Array]:
        """Readings (..., n, 3) of each triad without noise, nominal units: the model, inverted."""
        pairs = zip(self.triads.items(), vectors, strict=False)
        result = {
            name: raw_reading(model, params, vector, temperature, *() if model.curved else (1,))
            for (name, (model, params)), vector in pairs
        }
        for name, curve, strength in zip(
            result, self.curves, (self.gravity, self.field), strict=False
        ):
            if curve is not None:
                share = result[name] / strength
                square, cube = np.moveaxis(curve[..., None, :, :], -1, 0)
                result[name] = result[name] + strength * (square + cube * share) * share**2
        return {
            name: exact + self.turn_on[name][..., None, :] if name in self.turn_on else exact
            for name, exact in result.items()
        }

    @property
    def parameters(self) -> dict[str, tuple[Model, Array]]:
        """Model and parameters by triad with the bias of this switching on, at the reference temperature."""
        result = {}
        for name, (model, params) in self.triads.items():
            params, names = params.copy(), model.finished(self.reference)[0].names
            for axis, bias in zip(
                "xyz", np.moveaxis(self.turn_on.get(name, np.zeros(3)), -1, 0), strict=True
            ):
                if f"bias-{axis}" in names:
                    scale = params[..., names.index(f"scale-{axis}")]
                    params[..., names.index(f"bias-{axis}")] += bias / scale
                for row in (axis_ for axis_ in "xyz" if f"offset-{axis_}" in names):
                    gain = params[..., names.index(f"gain-{row}{axis}")]
                    params[..., names.index(f"offset-{row}")] -= gain * bias
            result[name] = model, params
        return result


def servo(rng: np.random.Generator) -> Truth:
    """A servo instrument within the datasheet limits of Moosavi's Table 1: see `SERVO`."""
    return drawn(rng, Profile(name="servo", magnetometer=TriadProfile(datasheet=Datasheet())))


def drawn(
    rng: np.random.Generator, profile: Profile, order: int = 3, lead: tuple[int, ...] = ()
) -> Truth:
    """Tools within the tolerances of a profile's datasheets; what these do not state is as of `SERVO`.

    Every tolerance is the standard deviation of a uniform distribution, about nominal, and so is a declared
    nonlinearity. The same numbers are drawn at every order. Without magnetometer where the profile has none.
    """
    unit = rng.uniform(-ROOT3, ROOT3, (*lead, len(TRIADS), 30))
    first, second = (
        _factors(unit[..., k, :], profile, name, order) for k, name in enumerate(TRIADS)
    )
    declared = [getattr(profile, name).nonlinearity for name in TRIADS]
    curves = [sd and sd * rng.uniform(-ROOT3, ROOT3, (*lead, 3, 2)) for sd in declared]
    reference = profile.reference_temperature_c
    field = second if profile.has_magnetometer else None
    return Truth(first, field, order=order, reference=reference, curves=tuple(curves))


def _factors(unit: Array, profile: Profile, triad: str, order: int) -> Array:
    """Factors (..., k) of a triad within tolerances, of numbers (..., 30) of standard deviation 1."""
    parts = []
    for start, middle, name in ((0, 1.0, "scale"), (12, 0.0, "bias")):
        steady = middle + tolerance(profile, triad, name) * unit[..., start : start + 3, None]
        drift = unit[..., start + 3 : start + 12].reshape(*unit.shape[:-1], 3, 3)
        powers = tolerance(profile, triad, f"{name}_per_c") * drift * DRIFT_POWERS
        parts.append(np.concatenate([steady, powers], -1)[..., : order + 1])
    linear = [part.reshape(*unit.shape[:-1], -1) for part in parts]
    turns = np.radians(tolerance(profile, triad, "misalignment_deg")) * unit[..., 24:]
    return np.concatenate([*linear, turns], -1)


def reading(truth: Truth, plan: StationPlan) -> tuple[Array, Array]:
    """What the tool's channels read (n, 3) without noise, nominal units: the model, inverted."""
    angles = plan.inclination, plan.azimuth, plan.toolface
    vectors = reference_vectors(*angles, truth.gravity, truth.field, truth.dip)
    g, b = truth.readings(vectors, plan.temperature).values()
    return g, b


def run(
    truth: Truth,
    plan: StationPlan,
    rng: np.random.Generator,
    noise: tuple[float, float] = (1e-4, 15.0),
    stand: tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: str = "",
) -> Readings:
    """Readings with noise (g, nT), at a stand whose angles are off by `stand` (radians, 1 σ), and its practice."""
    known = {name: getattr(plan, name) for name in ANGLES}
    known |= {name: np.full(plan.count, getattr(truth, name)) for name in CONSTANTS}
    blank = np.zeros((plan.count, 3))
    sd = {name: size + blank for name, size in zip(TRIADS, noise, strict=True)}
    sd |= {name: np.asarray(size) for name, size in zip(ANGLES, stand, strict=True)}
    session = Readings(blank, blank, plan.temperature, known, sd, settings=settings)
    result = simulated(truth, session, rng).readings
    return Readings(
        result.accelerometer,
        result.magnetometer,
        plan.temperature,
        known,
        settings=settings,
        station=tuple(str(i + 1) for i in range(plan.count)),
        metadata=result.metadata,
    )


@dataclass(frozen=True)
class Simulation:
    """Readings of tools (..., n, 3), and what is true of their sessions.

    `angles` by name and `temperature` of the sensors (..., n), radians and °C; `turn_on` (..., 3) by triad;
    `damage` of a tool at fault.
    """

    readings: Readings
    angles: dict[str, Array]
    temperature: Array
    turn_on: dict[str, Array]
    damage: Damage | None = None


def common_errors(
    rng: np.random.Generator, session: Readings, effects: Effects, lead: tuple[int, ...]
) -> dict[str, Array]:
    """Errors (...,) that all stations of a stand have in common, of standard deviations that `session` states.

    Zeros of the scales in radians, such that reading = value + zero; `stand-north` and `stand-east`, turns of
    the stand's frame, of a tilt; by what gravity, field and dip exceed their references.
    """
    errors: dict[str, Array] = {}
    for name in (*COMMON, *CONSTANTS):
        size = float(session.uncertainty(name).max(initial=0.0))
        if name not in CONSTANTS:
            size = float(np.hypot(size, effects.stand.common(name)))
        turns = ("stand-north", "stand-east") if name == "tilt" else (name,)
        if size:
            share = size / np.sqrt(len(turns))
            errors |= {turn: share * rng.normal(size=lead) for turn in turns}
    return errors


def simulated(
    truth: Truth,
    session: Readings,
    rng: np.random.Generator,
    effects: Effects | None = None,
    common: Mapping[str, Array] | None = None,
    minutes: Array | None = None,
) -> Simulation:
    """What tools read in a session: `session` has references, uncertainties and temperatures of its stations.

    White noise and errors of each setting are those that `session` states; errors of the stand are `common`,
    by default drawn. `minutes` (n,) are the times of the stations, by default one each minute.
    """
    effects = effects or Effects()
    lead, count = truth.accelerometer.shape[:-1], session.count
    times = np.arange(1.0, count + 1) if minutes is None else minutes
    common = common_errors(rng, session, effects, lead) if common is None else common
    angles = {
        name: _settings(session, name, effects, common)
        + session.uncertainty(name) * _alike(session, name, rng.normal(size=(*lead, count)))
        for name in ANGLES
    }
    damage = effects.fault.damage(rng, session.profile or Profile(name="servo"), lead)
    vectors = _vectors(session, angles, rng, effects, common, times, damage)
    warmth, recorded = _temperatures(session, effects, times)
    readings, turn_on = {}, {}
    for name, exact in _read(truth, vectors, warmth, damage).items():
        sensor = getattr(effects, name)
        whole = exact
        if sensor.turn_on:
            turn_on[name] = sensor.turn_on * rng.normal(size=(*lead, 3))
            whole = whole + turn_on[name][..., None, :]
        if sensor.instability:
            size = sensor.instability, sensor.instability_minutes
            whole = whole + wandering(rng, exact.shape, times, *size)
        readings[name] = sensor.recorded(whole + session.sd[name] * rng.normal(size=exact.shape))
    result = Readings(
        **{**dict.fromkeys(TRIADS), **readings},
        temperature=recorded,
        known=session.known,
        sd=session.sd,
        group=session.group,
        settings=session.settings,
        station=session.station,
        metadata={**session.metadata, "simulated": True},
    )
    return Simulation(result, angles, warmth, turn_on, damage)


def _alike(session: Readings, name: str, numbers: Array) -> Array:
    """Random numbers (..., n), the same for stations of one setting of the stand; toolface is set at each."""
    return numbers[..., settings_of(session)] if name in DIRECTION else numbers


def _settings(session: Readings, name: str, effects: Effects, common: Mapping[str, Array]) -> Array:
    """Angles (..., n) that the stand has turned to, the error of each setting apart."""
    stated, play = session.known[name], effects.stand.backlash(name)
    zero = np.asarray(common.get(f"{name}-zero", 0.0))[..., None]
    lag = play / 2 * approach(stated) if play else 0.0
    return np.asarray(stated - zero - lag)


def _vectors(
    session: Readings, angles: Mapping[str, Array], rng: np.random.Generator, effects: Effects,
    common: Mapping[str, Array], minutes: Array, damage: Damage | None,
) -> tuple[Array, Array]:  # fmt: skip
    """Gravity and field (..., n, 3) in the frames of the tools, at their sensors."""
    gravity, field, dip = (
        session.known[name] + np.asarray(common.get(name, 0.0))[..., None] for name in CONSTANTS
    )
    attitude = tool_from_earth(*(angles[name] for name in ANGLES))
    if "stand-north" in common:
        turn = np.stack(
            [common["stand-north"], common["stand-east"], 0 * common["stand-north"]], -1
        )
        attitude = attitude @ rotation(turn)[..., None, :, :]
    earth = [earth_gravity(gravity), earth_field(field, dip)]
    if effects.earth.variation_nt:
        size = effects.earth.variation_nt, effects.earth.variation_minutes
        earth[1] = earth[1] + wandering(rng, attitude.shape[:-1], minutes, *size)
    g, b = (np.einsum("...ij,...j->...i", attitude, vector) for vector in earth)
    return g, b if damage is None else changed_field(damage, b, attitude)


def _read(
    truth: Truth, vectors: tuple[Array, Array], temperature: Array, damage: Damage | None
) -> dict[str, Array]:
    """Readings (..., n, 3) of each triad without noise, of tools that may be at fault."""
    sound = truth.readings(vectors, temperature)
    if damage is None:
        return sound
    whole = [sound.get(name, 0 * vector) for name, vector in zip(TRIADS, vectors, strict=True)]
    raw, both = (np.concatenate(pair, -1) for pair in (whole, vectors))
    gain = np.ones_like(raw)
    for start, (name, (model, params)) in zip((0, 3), truth.triads.items(), strict=False):
        gain[..., start : start + 3] = 1 / diagonal(model.slope(params, sound[name], temperature))
    changed = changed_readings(damage, raw, both, temperature, truth.reference, gain)
    return {name: changed[..., 3 * i : 3 * i + 3] for i, name in enumerate(sound)}


def _temperatures(
    session: Readings, effects: Effects, minutes: Array
) -> tuple[Array, Array | None]:
    """Temperatures (n,) of the sensors, and those that are recorded, °C."""
    if session.temperature is None:
        return np.full(session.count, ROOM_TEMPERATURE), None
    course = effects.temperature
    drift = course.drift_c_per_hour / 60 * (minutes - minutes[0])
    sensors, thermometer = (
        response(session.temperature, minutes, constant, ROOM_TEMPERATURE) + drift
        for constant in (course.sensor_minutes, course.thermometer_minutes)
    )
    return sensors, thermometer
