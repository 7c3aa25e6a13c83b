"""The evidence on the stations of a run: references with their uncertainty, and errors in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mwdcal.estimation.batch import for_all
from mwdcal.geometry.vectors import Array, Bools, Ints

ANGLES = ("inclination", "azimuth", "toolface")
EARTH = ("gravity", "field", "dip")
STAND = {
    "stand-north": np.array([1.0, 0.0, 0.0]),
    "stand-east": np.array([0.0, 1.0, 0.0]),
    "azimuth-zero": np.array([0.0, 0.0, 1.0]),
}
"""Turns of the stand's frame, by the earth axis (north, east, down) they are about."""
STAND_ERRORS = (*STAND, "inclination-zero", "toolface-zero")
"""All errors of the stand that are common to its stations: turns of its frame, zeros of its scales."""
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
