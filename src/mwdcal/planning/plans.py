"""Plans: run files without readings, built in by name, or from a TOML file of attitudes, or any run file."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import msgspec
import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS, REFERENCES
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.table import Table
from mwdcal.files.profiles import built_in, read_toml, toml_problem

Values = float | list[float]
MOST_STATIONS = 20_000
"""Stations of a plan, or candidates."""
ROOM_TEMPERATURE = 25.0
"""Temperature of a plan that states none, °C."""
DIRECTION = ("inclination", "azimuth", "toolface")
"""What a plan states of each station."""


class PlannedStations(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Every inclination with every azimuth and every toolface, degrees; the last changes fastest."""

    inclination_deg: Values
    azimuth_deg: Values = 0.0
    toolface_deg: Values = 0.0

    @property
    def attitudes(self) -> list[tuple[float, ...]]:
        """Inclination, azimuth and toolface of every station."""
        every = (self.inclination_deg, self.azimuth_deg, self.toolface_deg)
        return list(product(*map(_listed, every)))


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is to be measured, in order: all stations at each temperature, °C.

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
        attitudes = [each for some in self.stations for each in some.attitudes]
        count = len(attitudes) * len(soaks)
        check_count(count, source)
        columns = dict(zip(DIRECTION, np.tile(np.transpose(attitudes), len(soaks)), strict=True))
        place = {"gravity": self.gravity_g, "field": self.field_nt, "dip": self.dip_deg}
        columns |= {n: np.full(count, float(v)) for n, v in place.items() if v is not None}
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


def check_count(count: int, source: str) -> None:
    """Refuse a plan of no stations, or of too many."""
    if not 1 <= count <= MOST_STATIONS:
        raise InputError(
            f"{source}: a plan has from 1 to {MOST_STATIONS} stations; this one has {count}. List the attitudes "
            "and temperatures that are to be measured, or a coarser grid of candidates."
        )


def load_plan(name_or_path: str) -> Table:
    """A plan as a run file without readings: built in by name, a TOML file, or a run file.

    Of a run file attitudes and temperatures count, and what is stated of their uncertainty; its
    readings are left out.

    Raises:
        InputError: no such plan, or a file that is not one.
    """
    path = Path(name_or_path)
    if path.suffix.lower() in tables.SUFFIXES:
        table = tables.read(path)
        check_count(table.count, table.source)
        raw = {channel for channels in CHANNELS.values() for channel in channels}
        kept = {name: cells for name, cells in table.columns.items() if name not in raw}
        return replace(table, columns=kept)
    data, _ = read_toml(name_or_path, "plans", "plan")
    try:
        plan = msgspec.toml.decode(data, type=Plan)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise InputError(
            f"{name_or_path} is not a plan: {toml_problem(error)}. Compare it with the built-in ones: "
            f"{', '.join(built_in('plans'))} (docs, 'Plans')."
        ) from None
    return plan.table(path.name)
