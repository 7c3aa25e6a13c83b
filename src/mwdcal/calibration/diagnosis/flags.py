"""Flags: what holds of some members of a batch, and the words that say it of one of them.

Refusals and findings are both flags, raised by operations on arrays with a leading tool axis. A single
run is a batch of one, and its sentences state the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from mwdcal.calibration.diagnosis.plausibility import freedom_of, misfit_chances
from mwdcal.calibration.diagnosis.structure import Effect, Shown, effects, shown_effects
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import StationRow
from mwdcal.calibration.residuals import Residuals
from mwdcal.calibration.results import StatedCovariance
from mwdcal.estimation.batch import batch_of_one, take
from mwdcal.estimation.uncertainty import Free, free_directions
from mwdcal.geometry.vectors import Array, Bools, Ints
from mwdcal.sensor.profile import Profile

Alone = Callable[[int], tuple[Readings, Profile]]
"""Readings and profile of one member of a batch, without leading axis, as `calibrate` takes them."""


@dataclass(frozen=True)
class Flag:
    """A refusal or a finding: its `id`, the `members` (B,) it holds of, and the words for one.

    The `words` have the names of `values` in braces: of an array (B, ...) the member's value is meant, of
    a function what it returns for the member's place, and anything else is common to all members.
    `station` (B,) is the number of the station that it is about, if it is about one.
    """

    id: str
    members: Bools
    words: str
    values: Mapping[str, Any] = field(default_factory=dict)
    station: Ints | None = None

    def sentence(self, place: int) -> str:
        """The sentence of the flag for one member."""
        return self.words.format_map(_Values(self.values, place))


@dataclass(frozen=True)
class _Values:
    """The values in the words of a flag for the member at `place`."""

    values: Mapping[str, Any]
    place: int

    def __getitem__(self, name: str) -> Any:
        value = self.values[name]
        if callable(value):
            return value(self.place)
        return value[self.place] if isinstance(value, np.ndarray) else value


def listed(names: Sequence[str], most: int) -> str:
    """The first few names, and how many more."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def spaced(unit: str) -> str:
    """A unit as it stands behind a number: degrees without a space."""
    return unit if unit == "°" else f" {unit}"


@dataclass(frozen=True)
class FittedRuns:
    """Fitted runs of one shape, as refusals and findings look at them.

    `readings` (B, n, ...), the `profile` with its scales stated, and the fit. `alone` gives a member by
    itself, for its sentences.
    """

    readings: Readings
    profile: Profile
    options: Options
    result: Fit
    alone: Alone
    _stations: dict[int, list[StationRow]] = field(init=False, repr=False, default_factory=dict)
    _shown: dict[int, Shown] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def free(self) -> list[list[Free]]:
        """Free directions of each member."""
        result = self.result
        return free_directions(result.problem, result.state, result.analysis.determined)

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.result.status)

    @cached_property
    def chances(self) -> Array:
        """`misfit_chances` (B, t) of the fit."""
        return misfit_chances(self.result, self.freedom)

    @cached_property
    def freedom(self) -> Array:
        """`freedom_of` (B, t) the fit."""
        return freedom_of(self.result)

    @cached_property
    def covariance(self) -> StatedCovariance:
        """The covariance of the fits' parameters."""
        return StatedCovariance(self.result)

    def take(self, index: Ints) -> FittedRuns:
        """Some of the runs."""
        return replace(
            self,
            readings=take(self.readings, index),
            result=take(self.result, index),
            alone=lambda place: self.alone(int(index[place])),
        )

    def member(self, place: int) -> Fit:
        """The fit of one run, as a batch of one."""
        return self.result if self.count == 1 else take(self.result, np.array([place]))

    def alone_as(self, place: int, run: tuple[Readings, Profile]) -> FittedRuns:
        """One of the runs, as a batch of one with the readings of that `run`."""
        readings, profile = run
        one = FittedRuns(
            batch_of_one(readings), profile, self.options, self.member(place), lambda _: run
        )
        if place in self._shown:
            one._shown[0] = self._shown[place]
        return one

    def shown(self, places: Ints) -> dict[int, Shown]:
        """Effects that the residuals of some runs show; many runs at once take less time than one by one."""
        new = np.array([place for place in places.tolist() if place not in self._shown], int)
        if new.size:
            others = {name: values[new] for name, values in self.readings.others.items()}
            result = self.result if new.size == self.count else take(self.result, new)
            self._shown.update(zip(new.tolist(), shown_effects(result, others), strict=True))
        return {place: self._shown[place] for place in places.tolist()}

    def effects(self, place: int) -> list[Effect]:
        """Effects that the residuals of one run show, with sizes, in the order in which they were found."""
        others = {name: values[place, None] for name, values in self.readings.others.items()}
        shown = self.shown(np.array([place]))[place]
        return effects(self.member(place), others, shown)

    @cached_property
    def residuals(self) -> Residuals:
        """The errors of the runs."""
        return Residuals(self.readings, self.result)

    def stations(self, place: int) -> list[StationRow]:
        """The errors of every station of one run."""
        if place not in self._stations:
            self._stations[place] = self.residuals.stations(place, self.alone(place)[0])
        return self._stations[place]
