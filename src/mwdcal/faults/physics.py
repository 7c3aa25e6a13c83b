"""What a fault does to the vectors and readings of a tool: every fault is a set of elementary departures.

Tools lead the axes, then stations; components of both triads follow one another, gravity first. Tool axes,
g, nT, radians, °C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.sensor.profile import Profile, tolerance

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

    `channel` counts components of both triads from 0.
    """

    name: str
    unit: str
    factor: float
    channel: int | None = None


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
        return FaultTerm(
            f"axis turned towards {AXIS_NAMES[towards % 3]}", "°", np.degrees(1.0), channel
        )
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
