"""The positions of a run or of a roll test: where to go next, what is measured, what is to be measured again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mwdcal.bench.attitude import Attitude
from mwdcal.bench.stream import TEMPERATURE_COLUMN, TIME_COLUMN
from mwdcal.files.formats.table import Table
from mwdcal.logs.stations import means_of

ORDERED_ANGLES = ("inclination", "azimuth", "toolface")
PLAN_COLUMNS = (*(f"ref_{name}_deg" for name in ORDERED_ANGLES), TEMPERATURE_COLUMN)
"""Columns of a plan that the bench uses."""


@dataclass(frozen=True)
class SessionPlan:
    """The positions of a plan by column, None where it states nothing, and the 1σ by angle that it will give."""

    name: str
    columns: Mapping[str, Sequence[float | None]]
    accuracy_deg: Mapping[str, float | None] = field(default_factory=dict)


def planned_columns(columns: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """The columns of a plan as JSON can hold them."""
    cells = {name: [float(v) for v in columns[name]] for name in PLAN_COLUMNS if name in columns}
    return {name: [None if v != v else v for v in values] for name, values in cells.items()}


@dataclass(frozen=True)
class TakenStation:
    """An accepted station: its position in the plan from 0, its row of the run file, and the samples of its standstill.

    `samples` holds the times under `time_s`, the values of each channel under its name, and under `steps` the smallest
    step of each; it is empty for a reading by hand.
    """

    position: int
    row: Mapping[str, Any]
    samples: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Positions:
    """The run, or the roll test: the positions of a plan and all that was accepted at them, in order of time."""

    name: str
    columns: Mapping[str, Sequence[float | None]]
    taken: list[TakenStation] = field(default_factory=list)
    again: list[int] = field(default_factory=list)
    skipped: set[int] = field(default_factory=set)

    @property
    def count(self) -> int:
        """Number of positions."""
        return len(self.columns[PLAN_COLUMNS[0]])

    @property
    def done(self) -> dict[int, TakenStation]:
        """The latest station of each position, in order of time."""
        latest: dict[int, TakenStation] = {}
        for station in self.taken:
            latest.pop(station.position, None)
            latest[station.position] = station
        return latest

    @property
    def order(self) -> int | None:
        """The position to go to; None where all is measured."""
        if self.again:
            return self.again[0]
        done = self.done
        return next((i for i in range(self.count) if i not in done and i not in self.skipped), None)

    @property
    def open_positions(self) -> list[int]:
        """All positions still to be measured, in their order."""
        done = self.done
        left = (i for i in range(self.count) if i not in done and i not in self.skipped)
        return [*self.again, *(i for i in left if i not in self.again)]

    def attitude(self, position: int) -> Attitude:
        """Inclination, azimuth and toolface of a position, degrees; 0 where the plan states none."""
        inclination, azimuth, toolface = (
            self.columns[name][position] or 0.0 for name in PLAN_COLUMNS[:3]
        )
        return inclination, azimuth, toolface

    def temperature(self, position: int) -> float | None:
        """The oven's temperature at a position, °C; None where the plan has only one."""
        values = self.columns.get(TEMPERATURE_COLUMN, ())
        return values[position] if len({*values} - {None}) > 1 else None

    def is_new_soak(self, position: int) -> bool:
        """Whether the oven has to be set before a position."""
        before = self.temperature(self.taken[-1].position) if self.taken else None
        return self.temperature(position) not in (None, before)

    def accept(self, station: TakenStation) -> None:
        """Take a station, which stands for its position from now on."""
        self.taken.append(station)
        self.again = [position for position in self.again if position != station.position]
        self.skipped.discard(station.position)

    def undo(self) -> None:
        """Forget the latest station. A former one of its position counts again, and is asked for again."""
        station = self.taken.pop()
        if station.position in self.done:
            self.again.insert(0, station.position)

    def measure_again(self, positions: Iterable[int]) -> None:
        """Ask for positions again, after those already asked for."""
        self.again += [position for position in positions if position not in self.again]

    def skip(self, position: int) -> None:
        """Leave a position out; a station of it stays."""
        self.again = [each for each in self.again if each != position]
        self.skipped.add(position)

    def clear(self) -> None:
        """Begin again."""
        self.taken, self.again, self.skipped = [], [], set()

    def table(self, facts: Mapping[str, Any], earlier: Sequence[TakenStation] = ()) -> Table:
        """The run file, in order of time. The noise of `earlier` stations counts as well."""
        stations = [*self.done.values()]
        rows = measured_rows([*earlier, *stations])[len(earlier) :]
        columns: dict[str, Any] = {}
        for name in dict.fromkeys(name for row in rows for name in row):
            cells = [row.get(name) for row in rows]
            has_text = any(isinstance(cell, str) for cell in cells)
            columns[name] = (
                [str(cell or "") for cell in cells] if has_text else np.array(cells, dtype=float)
            )
        return Table(columns, facts, f"{self.name}.csv")


def measured_rows(stations: Sequence[TakenStation]) -> list[dict[str, Any]]:
    """Rows of the run file, with the means and uncertainties that all standstills together tell (`logs.stations`)."""
    rows = [dict(station.row) for station in stations]
    places: dict[tuple[str, ...], list[int]] = {}
    for place, station in enumerate(stations):
        if station.samples:
            places.setdefault(tuple(station.samples["steps"]), []).append(place)
    for channels, alike in places.items():
        samples = [stations[place].samples for place in alike]
        clocks = [np.array(each[TIME_COLUMN]) for each in samples]
        rests = {
            name: [
                (clock, np.array(each[name])) for clock, each in zip(clocks, samples, strict=True)
            ]
            for name in channels
        }
        steps = {
            name: min((s for each in samples if (s := each["steps"][name])), default=0.0)
            for name in channels
        }
        for name, channel in means_of(rests, steps).items():
            for place, mean, sd in zip(
                alike, channel.mean.tolist(), channel.sd.tolist(), strict=True
            ):
                rows[place] |= {name: mean, f"sd_{name}": sd}
    return rows
