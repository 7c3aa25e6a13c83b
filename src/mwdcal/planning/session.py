"""A plan carried out: the session at the stand, with tools of a profile or that of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import from_readings
from mwdcal.geometry.vectors import Array
from mwdcal.planning.expected import highest_order, nominal_run
from mwdcal.planning.planned import USUAL_SOAK, USUAL_STAND, move_seconds
from mwdcal.planning.plans import (
    ROOM_TEMPERATURE,
    Effects,
    Simulation,
    Truth,
    attitudes,
    common_errors,
    simulated,
    soak_numbers,
    soak_temperatures,
)
from mwdcal.sensor.profile import Profile
from mwdcal.use.notation import COURSE, channel_factors, convert

TILT = ("stand-north", "stand-east")
"""The two turns of the stand's frame that a tilt consists of."""


@dataclass(frozen=True)
class Session:
    """A plan on a stand: `readings` (n, ...) of a nominal tool with all uncertainties, and when they are taken.

    `minutes` (n,) count from the moment when the oven is set to the first temperature.
    """

    plan: Table
    profile: Profile
    readings: Readings
    minutes: Array
    effects: Effects = field(default_factory=Effects)

    @classmethod
    def of(cls, plan: Table, profile: Profile, effects: Effects | None = None) -> Session:
        """The session of a plan.

        Raises:
            InputError: the plan does not state an attitude, or the profile neither scale nor noise of a triad.
        """
        readings, scaled = nominal_run(plan, profile)
        readings = replace(readings, profile=scaled, self_scaled={})  # no tool's yet
        return cls(plan, scaled, readings, station_minutes(plan), effects or Effects())

    @property
    def highest_order(self) -> int:
        """The highest order of temperature terms that its soaks carry."""
        return highest_order(self.readings.temperature)

    def common(self, rng: np.random.Generator, lead: tuple[int, ...]) -> dict[str, Array]:
        """Errors (...,) that all stations of the stand have in common, drawn: see `common_errors`."""
        return common_errors(rng, self.readings, self.effects, lead)

    def measured(
        self, truth: Truth, rng: np.random.Generator, common: Mapping[str, Array] | None = None
    ) -> Simulation:
        """The plan carried out with tools: see `simulated`."""
        readings = self.readings
        if truth.magnetometer is None:
            readings = replace(readings, magnetometer=None)
        return simulated(truth, readings, rng, self.effects, common, self.minutes)


def station_minutes(plan: Table) -> Array:
    """When each station (n,) is read: moves, and a soak at each change of temperature."""
    attitude, soak = attitudes(plan), soak_numbers(plan)
    pairs = (attitude[i : i + 2] for i in range(plan.count - 1))
    steps = [move_seconds(pair, USUAL_STAND)[0, 1] / 60 for pair in pairs]
    first = (
        soak_temperatures(plan)[soak[:1]] if "temperature_c" in plan.columns else ROOM_TEMPERATURE
    )
    changed = np.append(first != ROOM_TEMPERATURE, np.diff(soak) != 0)
    settled = [USUAL_STAND.settle_seconds / 60, *steps]
    return np.asarray(np.cumsum(settled + USUAL_SOAK * changed))


def simulated_run(
    session: Session, tool: Truth, seed: int, rng: np.random.Generator, serial: str
) -> tuple[Table, dict[str, object]]:
    """The run file of one tool, and what is true of it, by field of the truth file."""
    common = session.common(rng, ())
    result = session.measured(tool, rng, common)
    labels = {**session.readings.metadata, "serial": serial, "simulated": True, "seed": seed}
    read = replace(result.readings, source=session.plan.source)
    table = from_readings(read, session.profile, labels)
    stated = {k: v for k, v in session.plan.columns.items() if k != "temperature_c"}
    table = replace(table, columns={**table.columns, **stated})
    facts = {"seed": seed, "order": tool.order, "reference_temperature_c": tool.reference}
    return table, facts | session_facts(session, result, common)


def session_facts(
    session: Session, result: Simulation, common: Mapping[str, Array]
) -> dict[str, object]:
    """The truth of the session of one tool, with units, by field of the truth file."""
    exact = {f"{name}_deg": np.degrees(value) for name, value in result.angles.items()}
    exact["temperature_c"] = result.temperature
    rows = zip(*(values.tolist() for values in exact.values()), strict=True)
    stand = {
        f"{name.replace('-', '_')}_deg": float(np.degrees(value))
        for name, value in common.items()
        if name.endswith("-zero")
    }
    if TILT[0] in common:
        north, east = (float(common[name]) for name in TILT)
        stand["tilt_deg"] = float(np.degrees(np.hypot(north, east)))
        stand["tilt_azimuth_deg"] = float(np.degrees(np.arctan2(-north, east)) % 360)
    if "tool-axis-x" in common:
        lean = np.hypot(common["tool-axis-x"], common["tool-axis-y"])
        stand["tool_axis_deg"] = float(np.degrees(lean))
    known = session.readings.known
    earth = {
        name: float(np.mean(known[name]) + common.get(name, 0.0)) for name in ("gravity", "field")
    }
    dip = np.degrees(np.mean(known["dip"]) + common.get("dip", 0.0))
    return {
        "stations": [
            {"station": label, **dict(zip(exact, row, strict=True))}
            for label, row in zip(session.readings.labels, rows, strict=True)
        ],
        "stand": stand,
        "earth": {"gravity_g": earth["gravity"], "field_nt": earth["field"], "dip_deg": float(dip)},
        "turn_on": {name: value.tolist() for name, value in result.turn_on.items()},
        "fault": {} if result.damage is None else result.damage.described(),
    }


def calibrated_profile(calibration: Calibration) -> Profile:
    """The tool profile of a calibration, with the noise that was estimated where it states none.

    Raises:
        InputError: the magnetometer is calibrated to a field of 1.
    """
    if calibration.relative and calibration.has_field:
        raise InputError(
            f"the magnetometer of {calibration.run_name} is calibrated to field = 1, and plans and simulations "
            "need nT. Add ref_field_nt to the run and calibrate again, or name a tool profile by `tool`."
        )
    profile = calibration.profile
    for triad in calibration.triads:
        part = getattr(profile, triad.name)
        if part.noise is None:
            noise = replace_struct(part, noise=triad.noise * (part.scale or 1.0))
            profile = replace_struct(profile, **{triad.name: noise})
    return profile


def calibrated_tool(calibration: Calibration) -> tuple[Truth, Profile]:
    """The tool that a calibration describes exactly, and its `calibrated_profile`."""
    profile, triads = calibrated_profile(calibration), calibration.triads
    reference = calibration.reference_temperature
    first, *second = (np.array(triad.parameters) for triad in triads)
    tool = Truth(
        first, second[0] if second else None, order=max(triad.order for triad in triads), reference=reference,
        forms=tuple(triad.functions(reference) for triad in triads),
    )  # fmt: skip
    return tool, profile


def tool_facts(
    tool: Truth, profile: Profile, calibration: Calibration | None = None
) -> dict[str, object]:
    """Parameters of one tool by triad, in raw units and the order of the channels, and their `notation`.

    Factors (SF, B, m); of a calibration that is linear in its parameters at an order above 0, which no factors can
    give, affine (M, b) by power of T - reference: see `use.notation`.
    """
    notation = "factors"
    if calibration is None:
        values = {
            name: _factors(params, profile, name) for name, (_, params) in tool.triads.items()
        }
        for name, curve in zip(values, tool.curves, strict=False):
            if curve is not None:
                values[name]["nonlinearity"] = _channel_curve(curve, profile, name)
    else:
        linear = any(t.order and t.model != "factors" for t in calibration.triads)
        notation = "affine" if linear else "factors"
        each = convert(calibration, notation, COURSE if linear else None)
        values = {name: triad.values for name, triad in each.items()}
    lists = {name: {k: v.tolist() for k, v in triad.items()} for name, triad in values.items()}
    return {"notation": notation, **lists}


def _factors(params: Array, profile: Profile, triad: str) -> dict[str, Array]:
    sensor = getattr(profile, triad)
    return channel_factors(params, sensor.permutation, np.full(3, sensor.scale or 1.0))


def _channel_curve(curve: Array, profile: Profile, triad: str) -> Array:
    """Own-axis errors (3, 2) of channels, of those along the tool axes: a square turns its sign with the axis."""
    turn = getattr(profile, triad).permutation.mT
    return np.stack([turn @ curve[:, 0], np.abs(turn) @ curve[:, 1]], -1)
