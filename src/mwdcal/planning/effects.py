"""What happens to readings besides white noise: effects of sensors, stand, oven and Earth, each by its physics.

Sizes of everything that is drawn are standard deviations. All effects are zero unless a file says otherwise.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.errors import InputError
from mwdcal.faults.physics import NONE, SIZE, Damage, drawn_damage, faults
from mwdcal.files.profiles import decoded_toml
from mwdcal.geometry.vectors import Array, centred
from mwdcal.sensor.profile import Profile

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
        """What the converter gives of readings: cut at the saturation, rounded to the resolution."""
        most = self.saturation
        cut = reading if most is None else np.clip(reading, -most, most)
        return np.rint(cut / self.resolution) * self.resolution if self.resolution else cut


class StandEffects(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors of the stand beside those that the tool profile declares, degrees.

    `…_zero_deg`, `tilt_deg`: common to the session (1σ). `backlash_…_deg`: play of the gear; the table lags
    behind its scale by half of it, against the direction of approach (`approach`).
    """

    inclination_zero_deg: float = 0.0
    azimuth_zero_deg: float = 0.0
    toolface_zero_deg: float = 0.0
    tilt_deg: float = 0.0
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
    """A fault that the tool has: what it does is that of `mwdcal.faults.physics`, drawn for each tool.

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
        """What the fault has done to tools (...,); None without one."""
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
