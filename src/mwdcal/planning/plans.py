"""Plans: run files without readings, built in by name, or from a TOML file of attitudes, or any run file."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, product
from math import prod
from pathlib import Path

import msgspec
import numpy as np

from mwdcal.calibration.readings import CONSTANTS, soaks
from mwdcal.errors import InputError
from mwdcal.estimation.evidence import ANGLES
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
from mwdcal.geometry.vectors import Array, Ints

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
    place = {}
    for name in (REFERENCES[constant].column for constant in CONSTANTS):
        stated = np.asarray(other.columns.get(name, ()), float)
        for value in stated[~np.isnan(stated)][:1]:
            place[name] = np.full(plan.count, value)
    return replace(plan, columns={**plan.columns, **place})


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


def run_sheet(plan: Table, magnetometer: bool = True) -> Table:
    """The run file of a plan to be filled in: its columns, and blank ones for readings and place."""
    raw = chain(*channels(magnetometer).values())
    head = {
        name: cells for name, cells in plan.columns.items() if name in ("station", "temperature_c")
    }
    place = [REFERENCES[name].column for name in CONSTANTS[: len(CONSTANTS) if magnetometer else 1]]
    order = dict.fromkeys([*head, *raw, *plan.columns, *place])
    return replace(
        plan, columns={n: plan.columns.get(n, np.full(plan.count, np.nan)) for n in order}
    )
