"""Plans: run files without readings, built in by name, or from a TOML file of attitudes, or any run file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain, product
from math import prod
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.methods import STAND_TURNS
from mwdcal.calibration.options import DIRECTION, settings_of
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings, soaks
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import raw_reading, unknown_gravity
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.faults.likelihood import (
    NONE,
    SIZE,
    Damage,
    changed_field,
    changed_readings,
    drawn_damage,
    faults,
)
from mwdcal.files.contract import (
    COLUMNS,
    REFERENCES,
    TEMPERATURE,
    Range,
    channels,
    check_near_misses,
)
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, Column
from mwdcal.files.formats.table import Table, labels, numbers
from mwdcal.files.profiles import decoded_toml
from mwdcal.files.synonyms import check_evidence
from mwdcal.geometry.vectors import (
    Array,
    Ints,
    centred,
    diagonal,
    earth_field,
    earth_gravity,
    reference_vectors,
    rotation,
    tool_from_earth,
)
from mwdcal.sensor.models import Basis, Factors, Model
from mwdcal.sensor.profile import COMMON, ROOT3, Datasheet, Profile, TriadProfile, tolerance

Values = float | list[float]
MOST_PLANNED = 20_000
"""Stations of a plan, or candidates."""
ROOM_TEMPERATURE = 25.0
"""Temperature of a plan that states none, °C."""


PLANNED = (
    *("station", "group", "temperature_c"),
    *(prefix + reference.column for reference in REFERENCES.values() for prefix in ("", "sd_")),
)
"""Columns of a run file that count in a plan."""


class PlannedStations(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Every inclination with every azimuth and every toolface, degrees; the last changes fastest."""

    inclination_deg: Values
    azimuth_deg: Values = 0.0
    toolface_deg: Values = 0.0

    @property
    def count(self) -> int:
        """Number of stations, without a list of them."""
        return prod(
            len(_listed(v)) for v in (self.inclination_deg, self.azimuth_deg, self.toolface_deg)
        )

    @property
    def attitudes(self) -> list[tuple[float, ...]]:
        """Inclination, azimuth and toolface of every station."""
        every = (self.inclination_deg, self.azimuth_deg, self.toolface_deg)
        return list(product(*map(_listed, every)))


class PlanFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The stations of a plan, in order: all stations at each temperature, °C.

    `gravity_g`, `field_nt` and `dip_deg` are of the place, where the plan depends on them.
    """

    name: str
    stations: list[PlannedStations]
    source: str = ""
    temperature_c: Values = ROOM_TEMPERATURE
    gravity_g: float | None = None
    field_nt: float | None = None
    dip_deg: float | None = None

    def table(self, source: str) -> Table:
        """The run file of the plan, without readings; refuses one of no stations or too many."""
        soaks = _listed(self.temperature_c)
        count = sum(some.count for some in self.stations) * len(soaks)
        check_count(count, source)
        attitudes = [each for some in self.stations for each in some.attitudes]
        place = {"gravity": self.gravity_g, "field": self.field_nt, "dip": self.dip_deg}
        columns = dict(zip(ANGLES, np.tile(np.transpose(attitudes), len(soaks)), strict=True))
        columns |= {n: np.full(count, float(v)) for n, v in place.items() if v is not None}
        _check_values("temperature_c", np.asarray(soaks, float), TEMPERATURE, source)
        for name, values in columns.items():
            key = REFERENCES[name].column.removeprefix("ref_")
            _check_values(key, values, REFERENCES[name].values, source)
        return Table(
            {
                "station": [str(number + 1) for number in range(count)],
                "temperature_c": np.repeat(np.asarray(soaks, float), len(attitudes)),
                **{REFERENCES[name].column: values for name, values in columns.items()},
            },
            {"plan": self.name},
            source,
            range(1, count + 1),
        )


def _listed(values: Values) -> list[float]:
    return values if isinstance(values, list) else [values]


def _check_values(key: str, values: Array, allowed: Range, source: str) -> None:
    """Refuse numbers of a TOML file that no run file may have."""
    wrong = values[~np.isfinite(values) | allowed.outside(values)]
    if wrong.size:
        raise InputError(
            f"{source}, key '{key}': must be {allowed}; got {wrong[0]:g}. Correct it, or leave the key out."
        )


def check_count(count: int, source: str) -> None:
    """Refuse a plan of no stations, or of too many."""
    if not 1 <= count <= MOST_PLANNED:
        raise InputError(
            f"{source}: a plan has from 1 to {MOST_PLANNED} stations; this one has {count}. List the attitudes "
            "and temperatures that are to be measured, or a coarser grid of candidates."
        )


def load_plan(source: str | Table) -> Table:
    """A plan as a run file without readings: built in by name, a TOML file, a run file, or the table of one.

    Of a run attitudes and temperatures count, and what is stated of their uncertainty; its
    readings and columns without a figure are left out.

    Raises:
        InputError: no such plan, or a file that is not one.
    """
    path = None if isinstance(source, Table) else Path(source)
    if path is None or path.suffix.lower() in tables.SUFFIXES:
        table = source if isinstance(source, Table) else tables.read(source)
        check_count(table.count, table.source)
        check_near_misses(list(table.columns), COLUMNS, f"{table.source}: column")
        check_evidence(list(table.columns), table.source)
        kept = [name for name in table.columns if name in PLANNED]
        cells: dict[str, Column] = {
            name: labels(table, name) if name in LABELS else numbers(table, name) for name in kept
        }
        return replace(table, columns={k: v for k, v in cells.items() if not _blank(v)})
    plan, _ = decoded_toml(str(source), PlanFile, "plans", "plan", "Plans")
    return plan.table(path.name)


def _blank(cells: Column) -> bool:
    """Whether a column states nothing, as if it were not there."""
    return isinstance(cells, np.ndarray) and bool(np.isnan(cells).all())


def load_measured(source: str | Table, magnetometer: bool = True) -> Table:
    """The stations of a run that is measured already, a file or a table, as a plan for one triad or both.

    Raises:
        InputError: it cannot be read, or does not hold the triads of the plan.
    """
    table = source if isinstance(source, Table) else tables.read(source)
    for triad, names in channels(magnetometer).items():
        missing = [name for name in names if name not in table.columns]
        if missing:
            raise InputError(
                f"{table.source}: no column {missing[0]}. The stations of a run without {triad} cannot be added to a "
                "plan for both triads; plan without `measured`."
            )
    return load_plan(table)


def joined(first: Table, second: Table) -> Table:
    """The stations of two plans, one after the other; what one does not state is blank there.

    Without temperatures in the first there are none.
    """
    names = dict.fromkeys([*first.columns, *second.columns])
    if "temperature_c" not in first.columns:
        names.pop("temperature_c", None)
    columns = {name: _both(first, second, name) for name in names}
    return replace(first, columns=columns, lines=range(1, first.count + second.count + 1))


def _both(first: Table, second: Table, name: str) -> Column:
    """A column of two plans, blank in the one that does not have it."""
    if name in LABELS:
        parts = [labels(plan, name) or [""] * plan.count for plan in (first, second)]
        return parts[0] + parts[1]
    blank = [np.full(plan.count, np.nan) for plan in (first, second)]
    return np.concatenate(
        [plan.columns.get(name, none) for plan, none in zip((first, second), blank, strict=True)]
    )


def taken(plan: Table, places: Ints) -> Table:
    """The stations of a plan at some places, in that order, labelled by number."""
    columns: dict[str, Column] = {
        name: cells[places] for name, cells in plan.columns.items() if isinstance(cells, np.ndarray)
    }
    count = len(places)
    stations = {"station": [str(number) for number in range(1, count + 1)]}
    return replace(plan, columns=stations | columns, lines=range(1, count + 1))


def at_temperatures(plan: Table, other: Table) -> Table:
    """The attitudes of a plan at every soak of another, and at the place of that one."""
    soaks = soak_temperatures(other)
    result = taken(plan, np.tile(np.arange(plan.count), max(len(soaks), 1)))
    warmth = {"temperature_c": np.repeat(soaks, plan.count)} if len(soaks) else {}
    return at_place(replace(result, columns={**result.columns, **warmth}), other)


def at_place(plan: Table, other: Table) -> Table:
    """A plan with the gravity, field and dip that another states first, where that states any."""
    place = {column: np.full(plan.count, value) for column, value in stated_place(other).items()}
    return replace(plan, columns={**plan.columns, **place})


def stated_place(plan: Table) -> dict[str, float]:
    """Gravity, field and dip that a plan states first, by column."""
    place = {}
    for column in (REFERENCES[constant].column for constant in CONSTANTS):
        stated = np.asarray(plan.columns.get(column, ()), float)
        if not np.isnan(stated).all():
            place[column] = float(stated[~np.isnan(stated)][0])
    return place


def place_of(calibration: Calibration) -> dict[str, float]:
    """Gravity, field and dip of a calibration, stated or estimated, by column; no gravity that it assumed."""
    place = {}
    for name in CONSTANTS:
        column = REFERENCES[name].column
        value = calibration.earth.get("field" if name == "field" else column.removeprefix("ref_"))
        if value is not None and not (name == "gravity" and unknown_gravity(calibration)):
            place[column] = value
    return place


def at_place_of(plan: Table, calibration: Calibration) -> Table:
    """A plan with the gravity, field and dip of a calibration where the plan states none."""
    return with_place(plan, place_of(calibration))


def with_place(plan: Table, place: Mapping[str, float]) -> Table:
    """A plan with the values of a place, by column, where the plan states none."""
    known = stated_place(plan)
    added = {name: np.full(plan.count, place[name]) for name in place if name not in known}
    return replace(plan, columns={**plan.columns, **added})


def without_estimates(plan: Table, calibration: Calibration) -> Table:
    """A plan without the gravity, field and dip that a calibration estimated: they are no references of a run."""
    place, cells = place_of(calibration), plan.columns
    estimated = {REFERENCES[constant.name].column for constant in calibration.constants}
    taken = {name for name in estimated & {*place} & {*cells} if np.all(cells[name] == place[name])}
    return replace(plan, columns={name: cells[name] for name in cells if name not in taken})


def at_temperature_of(plan: Table, calibration: Calibration) -> Table:
    """A plan at the temperature, in whole degrees, of a calibration that has no temperature terms."""
    if calibration.thermal or calibration.temperature_c is None:
        return plan
    warmth = np.full(plan.count, float(round(np.mean(calibration.temperature_c))))
    return replace(plan, columns={**plan.columns, "temperature_c": warmth})


def soak_temperatures(plan: Table) -> Array:
    """The mean temperatures of the soaks of a plan, ascending, °C."""
    temperature = np.asarray(plan.columns.get("temperature_c", ()), float)
    temperature = temperature[~np.isnan(temperature)]
    soak = soaks(temperature) if temperature.size else np.zeros(0, int)
    return np.array(
        [temperature[soak == number].mean() for number in range(soak.max(initial=-1) + 1)]
    )


def soak_numbers(plan: Table) -> Ints:
    """Which soak each station (n,) belongs to, by `soak_temperatures`; all zero without temperatures."""
    soaks = soak_temperatures(plan)
    if not len(soaks):
        return np.zeros(plan.count, int)
    temperature = np.asarray(plan.columns["temperature_c"], float)
    return np.asarray(np.argmin(np.abs(temperature[:, None] - soaks), -1))


def attitudes(plan: Table) -> Array:
    """Inclination, azimuth and toolface (n, 3) in degrees.

    Raises:
        InputError: a station without one of them.
    """
    columns = [REFERENCES[name].column for name in ANGLES]
    blank = np.full(plan.count, np.nan)
    angles = np.stack([np.asarray(plan.columns.get(name, blank), float) for name in columns], -1)
    for row, place in np.argwhere(np.isnan(angles))[:1].tolist():
        raise InputError(
            f"{plan.source}: station {row + 1} has no {columns[place]}. A plan states the attitude of every station."
        )
    return angles


def run_sheet(plan: Table, magnetometer: bool = True, serial: str = "") -> Table:
    """The run file of a plan to be filled in: its columns, blank ones for readings and place, and the tool's serial."""
    raw = chain(*channels(magnetometer).values())
    head = {
        name: cells for name, cells in plan.columns.items() if name in ("station", "temperature_c")
    }
    place = [REFERENCES[name].column for name in CONSTANTS[: len(CONSTANTS) if magnetometer else 1]]
    order = dict.fromkeys([*head, *raw, *plan.columns, *place])
    blank = np.full(plan.count, np.nan)
    columns = {name: plan.columns.get(name, blank) for name in order}
    return replace(plan, columns=columns, metadata={**plan.metadata, "serial": serial})


# --------------------------------------------------------------------------
# Simulated tools and their readings, of many at once: for planning, examples, tests and studies.
#
# Tools lead the axes, then stations (n,), the component axis is last. Always labelled simulated.
#
# What happens to readings besides white noise: effects of sensors, stand, oven and Earth, each by its physics.
#
# Sizes of everything that is drawn are standard deviations. All effects are zero unless a file says otherwise.


LARGEST_EFFECT = 1e6
"""No size of an effect is larger, in its unit."""


class SensorEffects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of each channel of a triad, in g or nT.

    `turn_on`: bias that each switching on leaves, constant until the next (1σ). `instability`: bias that
    wanders about zero (1σ), forgotten with the time constant `instability_minutes` (`wandering`).
    `resolution`: step of the converter. `saturation`: largest reading of either sign, if there is one.
    """

    turn_on: float = 0.0
    instability: float = 0.0
    instability_minutes: float = 60.0
    resolution: float = 0.0
    saturation: float | None = None

    def recorded(self, reading: Array) -> Array:
        """Readings behind the converter: cut at the saturation, rounded to the resolution."""
        most = self.saturation
        cut = reading if most is None else np.clip(reading, -most, most)
        return np.rint(cut / self.resolution) * self.resolution if self.resolution else cut


class StandEffects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors of the stand besides those that the tool profile declares, degrees.

    `…_zero_deg`, `tilt_deg`, `tool_axis_deg`: common to the session (1σ). `backlash_…_deg`: play of the gear; the table
    lags behind its scale by half of it, against the direction of approach (`approach`).
    """

    inclination_zero_deg: float = 0.0
    azimuth_zero_deg: float = 0.0
    toolface_zero_deg: float = 0.0
    tilt_deg: float = 0.0
    tool_axis_deg: float = 0.0
    backlash_inclination_deg: float = 0.0
    backlash_azimuth_deg: float = 0.0
    backlash_toolface_deg: float = 0.0

    def common(self, name: str) -> float:
        """Standard deviation, radians, of an error such as "azimuth-zero"."""
        return math.radians(getattr(self, f"{name.replace('-', '_')}_deg"))

    def backlash(self, angle: str) -> float:
        """Play of the axis of an angle, radians."""
        return math.radians(getattr(self, f"backlash_{angle}_deg"))


class TemperatureEffects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How sensors and thermometer follow the oven, each with its time constant (`response`).

    `drift_c_per_hour`: how fast both warm from the first reading on.
    """

    sensor_minutes: float = 0.0
    thermometer_minutes: float = 0.0
    drift_c_per_hour: float = 0.0


class EarthEffects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Variation of the Earth's field: each of its components (north, east, down) wanders, nT (1σ)."""

    variation_nt: float = 0.0
    variation_minutes: float = 60.0


class FaultEffect(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A fault that the tool has: what it does is that of `mwdcal.faults.likelihood`, drawn for each tool.

    `channel` is that of an impact ("ax" …, or a triad) or of a dead channel; "" is drawn. `size` in multiples
    of the usual one, which the tool's datasheet gives. A dead channel reads `reading`, g or nT along the tool axis,
    at temperatures above `above_c`, if there is one.
    """

    kind: Literal["none", "impact", "dead-channel", "heat", "magnetised", "casing", "turn-on"] = (
        "none"
    )
    channel: Literal["", "ax", "ay", "az", "mx", "my", "mz", "accelerometer", "magnetometer"] = ""
    size: float = 1.0
    reading: float = 0.0
    above_c: float | None = None

    def damage(
        self, rng: np.random.Generator, profile: Profile, lead: tuple[int, ...]
    ) -> Damage | None:
        """Effect of the fault on tools (...,); None without one."""
        if self.kind == NONE:
            return None
        if self.kind == "dead-channel":
            drawn = rng.integers(6, size=lead) if not self.channel else self._place(profile)
            dead = np.arange(6) == np.broadcast_to(drawn, lead)[..., None]
            reading = np.full((*lead, 6), self.reading)
            above = -np.inf if self.above_c is None else self.above_c
            return Damage(np.zeros((*lead, SIZE)), dead, reading, above)
        forms = [form for form in faults(profile) if form.kind == self.kind]
        if self.channel:
            forms = [form for form in forms if form.channel in (None, self._place(profile))]
        return drawn_damage(rng, forms, self.size, lead)

    def _place(self, profile: Profile) -> int:
        """The component of both triads that the channel measures; of a triad -1 or -2."""
        if self.channel in TRIADS:
            return -1 - TRIADS.index(self.channel)
        triad = "am".index(self.channel[0])
        permutation = getattr(profile, TRIADS[triad]).permutation
        return 3 * triad + int(np.argmax(np.abs(permutation[:, "xyz".index(self.channel[1])])))


class Effects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All effects of a session."""

    accelerometer: SensorEffects = SensorEffects()
    magnetometer: SensorEffects = SensorEffects()
    stand: StandEffects = StandEffects()
    temperature: TemperatureEffects = TemperatureEffects()
    earth: EarthEffects = EarthEffects()
    fault: FaultEffect = FaultEffect()


def load_effects(name_or_path: str) -> tuple[Effects, str]:
    """Effects and the SHA-256 of their file: built in by name, or a TOML file by path."""
    effects, digest = decoded_toml(name_or_path, Effects, "effects", "file of effects", "Planning")
    for section, values in msgspec.to_builtins(effects).items():
        for key, value in values.items():
            if isinstance(value, float):
                _check(f"{name_or_path}, key '{section}.{key}'", key, value)
    _check_channel(f"{name_or_path}, key 'fault.channel'", effects.fault)
    return effects, digest


def _check(where: str, key: str, value: float) -> None:
    """Refuse a size that no effect has."""
    positive = key in ("instability_minutes", "variation_minutes", "saturation")
    low = -LARGEST_EFFECT if key in ("drift_c_per_hour", "reading", "above_c") else 0.0
    if not low <= value <= LARGEST_EFFECT or (positive and value == 0):
        word = "above 0" if positive else f"at least {low:g}"
        raise InputError(
            f"{where}: must be {word} and at most {LARGEST_EFFECT:g}; got {value}. Correct it, or leave it out."
        )


def _check_channel(where: str, fault: FaultEffect) -> None:
    """Refuse a channel that the fault does not have."""
    on_one = fault.kind == "dead-channel" and fault.channel not in TRIADS
    if fault.channel and not on_one and fault.kind != "impact":
        whole = "one channel, such as ax" if fault.kind == "dead-channel" else "left out"
        raise InputError(f"{where}: of '{fault.kind}' it must be {whole}; got '{fault.channel}'.")


def wandering(
    rng: np.random.Generator, shape: tuple[int, ...], minutes: Array, sd: float, correlation: float
) -> Array:
    """What wanders (..., n, c) of `shape`, at times (n,) in minutes: a Gauss-Markov process of the first order.

    Definition: stationary, normal, of standard deviation `sd`, correlated by exp(-Δt / `correlation`).
    """
    result = sd * rng.normal(size=shape)
    kept = np.exp(-np.diff(minutes) / correlation)
    for place, share in enumerate(kept, 1):
        result[..., place, :] *= np.sqrt(1 - share**2)
        result[..., place, :] += share * result[..., place - 1, :]
    return result


def drifted(rng: np.random.Generator, session: Readings, name: str, lead: tuple[int, ...]) -> Array:
    """A declared drift (..., n, 3) since the first station: a trend and a walk of half its variance each."""
    size, steps = float(session.uncertainty(name).max(initial=0.0)), session.count - 1
    if not (size and steps):
        return np.zeros((session.count, 3))
    slopes = rng.normal(size=(*lead, 1, 3)) / steps
    walk = np.cumsum(slopes + rng.normal(size=(*lead, steps, 3)) / np.sqrt(steps), -2)
    start = np.zeros((*lead, 1, 3))
    return np.asarray(size * np.sqrt(0.5) * np.concatenate([start, walk], -2))


def response(level: Array, minutes: Array, time_constant: float, start: float) -> Array:
    """How something follows levels (n,) that change when the one before was last read, minutes (n,).

    Definition: dy/dt = (level - y) / `time_constant`; y is `start` at time 0. It follows at once where the
    time constant is zero.
    """
    if not time_constant:
        return level
    result, value = np.empty(len(level)), start
    for place, step in enumerate(np.diff(minutes, prepend=0.0)):
        value = level[place] + (value - level[place]) * math.exp(-step / time_constant)
        result[place] = value
    return result


def approach(setting: Array) -> Array:
    """From where each setting (n,) of an axis is approached: 1 from below, -1 from above; radians.

    The axis turns the shorter way; where it stays, so does the direction. The first is approached from below.
    """
    direction, result = 1.0, []
    for step in centred(np.diff(setting, prepend=setting[:1])):
        direction = float(np.sign(step)) or direction
        result.append(direction)
    return np.array(result)


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
            name: raw_reading(model, params, vector, temperature)
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
    """Readings of the tool's channels (n, 3) without noise, nominal units: the model, inverted."""
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
    the stand's frame, of a tilt; `tool-axis-x` and `tool-axis-y`, turns of the tool; by what gravity,
    field and dip exceed their references.
    """
    errors: dict[str, Array] = {}
    for name in (*COMMON, *CONSTANTS):
        size = float(session.uncertainty(name).max(initial=0.0))
        if name not in CONSTANTS:
            size = float(np.hypot(size, effects.stand.common(name)))
        turns = STAND_TURNS.get(name, (name,))
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
        whole = exact + drifted(rng, session, f"{name}-drift", lead)
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
    if "tool-axis-x" in common:
        lean = np.stack(
            [common["tool-axis-x"], common["tool-axis-y"], 0 * common["tool-axis-x"]], -1
        )
        attitude = rotation(lean)[..., None, :, :] @ attitude
    earth = [earth_gravity(gravity), earth_field(field, dip)]
    earth[1] = earth[1] + drifted(rng, session, "field-drift", attitude.shape[:-3])
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
