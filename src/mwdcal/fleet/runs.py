"""Rows of many tools to batches of `Readings`: what `runs.to_readings` does, for all at once.

Tools of the same number of stations and the same kinds of evidence form one batch. Cells that
a run file may not have are found by arrays; the words for them are those of a single run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.contract import (
    CHANNELS,
    COLUMNS,
    RAW_RANGE,
    RAW_SPREAD,
    REFERENCES,
    TEMPERATURE,
    Range,
)
from mwdcal.files.formats import parquet
from mwdcal.files.formats.columns import as_text
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import common_errors, reference_spread, to_readings
from mwdcal.fleet.sources import AZIMUTH, OFFSET, SERIAL
from mwdcal.fleet.tables import one_chunk
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.sensor.profile import Profile, TriadProfile

GROUP, STATION = "group", "station"


@dataclass(frozen=True)
class Rows:
    """The stations of T tools, the rows of each together: an Arrow table and where tools start."""

    table: Any
    starts: Ints
    source: str
    metadata: Mapping[str, object]
    profile: Profile

    @classmethod
    def of(cls, table: Any, source: str, metadata: Mapping[str, object], profile: Profile) -> Rows:
        """From a table whose rows are in order of tools."""
        codes = one_chunk(table.column(SERIAL)).indices.to_numpy(zero_copy_only=False)
        starts = np.append(np.flatnonzero(np.diff(codes, prepend=codes[0] - 1)), len(codes))
        return cls(table, starts, source, metadata, profile)

    @property
    def serials(self) -> Any:
        """The serial of each tool (T,)."""
        serial = one_chunk(self.table.column(SERIAL))
        return serial.dictionary.take(serial.indices.take(self.starts[:-1]))

    @property
    def counts(self) -> Ints:
        """Number of stations (T,)."""
        return np.diff(self.starts)

    @cached_property
    def numbers(self) -> dict[str, Array]:
        """Columns of numbers (R,), NaN where blank; wholly blank ones are left out."""
        arrow, _ = parquet.modules(self.source)
        found = {}
        for name in self.table.column_names:
            if name in COLUMNS and name not in (GROUP, STATION):
                cells = self.table.column(name).cast(arrow.float64(), safe=False)
                values = np.asarray(cells.to_numpy(), float)
                if not np.isnan(values).all():
                    found[name] = values
        return found

    @cached_property
    def offsets(self) -> tuple[Array, Array]:
        """Least and most (T,) by which a tool's stated azimuths exceed magnetic ones, °; NaN for none."""
        count = len(self.counts)
        if AZIMUTH not in self.numbers or OFFSET not in self.table.column_names:
            return np.zeros(count), np.zeros(count)
        stated = self.table.column(OFFSET).to_numpy()
        own = np.where(np.isnan(self.numbers[AZIMUTH]), np.nan, stated)
        first = self.starts[:-1]
        return np.fmin.reduceat(own, first), np.fmax.reduceat(own, first)

    @cached_property
    def groups(self) -> Ints:
        """Number (R,) of the group of each row within its tool, -1 for none."""
        return _groups(self)

    def alone(self, tool: int) -> tuple[Readings, Profile]:
        """One tool's readings as a single run has them; raises what a single run would."""
        arrow, _ = parquet.modules(self.source)
        part = self.table.slice(self.starts[tool], self.counts[tool])
        serial = part.column(SERIAL)[0].as_py()
        lines = (part.column("#row").to_numpy() + 1).tolist()
        columns = {
            name: parquet.as_column(name, part.column(name), arrow)
            for name in part.column_names
            if name in COLUMNS
        }
        place = self.source if self.source.endswith(".parquet") else f"{self.source}/*.parquet"
        source = f"serial {serial} of {place}"
        metadata = {**self.metadata, SERIAL: str(serial), **self._north(tool, source)}
        return to_readings(Table(columns, metadata, source, lines), self.profile)

    def label(self, tool: int, station: int) -> str:
        """A station's label, as a single run has it."""
        number = str(station + 1)
        if STATION not in self.table.column_names:
            return number
        cell = self.table.column(STATION)[int(self.starts[tool]) + station].as_py()
        return as_text(cell).strip() or number

    def _north(self, tool: int, source: str) -> dict[str, object]:
        """The metadata that say which north a tool's azimuths count from."""
        low, high = (float(each[tool]) for each in self.offsets)
        if high > low:
            raise InputError(
                f"{source}: the azimuths of a tool must count from one north; those of its files count from "
                f"{low:g}° and {high:g}° from magnetic. Write its rows with one azimuth reference."
            )
        known = bool(np.nan_to_num(low))
        return {"azimuth_reference": "true", "declination_deg": low} if known else {}

    def filled(self, name: str) -> Ints:
        """Number of filled cells (T,) of a column."""
        if name not in self.numbers:
            return np.zeros(len(self.counts), int)
        return self.sums(~np.isnan(self.numbers[name]))

    def sums(self, values: AnyArray) -> Ints:
        """Sum (T,) of row values over each tool."""
        return np.add.reduceat(values.astype(int), self.starts[:-1])


@dataclass(frozen=True)
class Batch:
    """Tools of one shape: readings (B, n, ...), and the number (B,) of each among its rows."""

    readings: Readings
    tools: Ints


def refused_tools(rows: Rows) -> dict[int, str]:
    """Tools with cells that a run may not have, and the message about the first of them."""
    found = {}
    for tool in np.flatnonzero(_odd_cells(rows)):
        try:
            rows.alone(int(tool))
        except MwdcalError as error:
            found[int(tool)] = str(error)
    return found


def _ranges() -> dict[str, Range]:
    """Accepted values of every column of numbers."""
    channels = [name for triad in CHANNELS.values() for name in triad]
    found = dict.fromkeys(channels, RAW_RANGE) | {"temperature_c": TEMPERATURE}
    found |= {f"sd_{name}": RAW_SPREAD for name in channels}
    for reference in REFERENCES.values():
        found |= {reference.column: reference.values, f"sd_{reference.column}": reference.spread}
    return found


def _odd_cells(rows: Rows) -> Bools:
    """Tools (T,) with a cell out of its range, or blank where others are filled."""
    limits, counts = _ranges(), rows.counts
    odd = np.zeros(len(rows.table), bool)
    for name, values in rows.numbers.items():
        one = limits[name]
        low = values <= one.low if one.positive else values < one.low
        odd |= low | (values > one.high)
    found = rows.sums(odd) > 0
    for kind, names in CHANNELS.items():
        filled = np.stack([rows.filled(name) for name in names])
        whole = (filled == counts).all(0)
        found |= ~whole if kind == "accelerometer" else ~whole & (filled > 0).any(0)
        found |= _odd_spread(rows, kind)
    found |= rows.offsets[1] > rows.offsets[0]
    filled = rows.filled("temperature_c")
    return np.asarray(found | ((filled > 0) & (filled < counts)))


def _odd_spread(rows: Rows, kind: str) -> Bools:
    """Tools (T,) with noise stated for some cells of a triad and not for others, or of zero."""
    triad: TriadProfile = getattr(rows.profile, kind)
    names = [f"sd_{name}" for name in CHANNELS[kind]]
    filled = np.stack([rows.filled(name) for name in names])
    partly = ~(filled == rows.counts).all(0) & (filled > 0).any(0) & (triad.noise is None)
    zero = [rows.sums(rows.numbers[n] == 0) > 0 for n in names if n in rows.numbers]
    bare = bool(zero) and triad.repeatability == 0
    return np.asarray(partly | (np.any(zero, axis=0) if bare else False))


def batches(rows: Rows, tools: Ints) -> list[Batch]:
    """The given tools, in batches of one number of stations and the same kinds of evidence."""
    if not tools.size:
        return []
    keys = _kinds(rows)[tools]
    if (keys == keys[0]).all():
        return [Batch(_readings(rows, tools), tools)]
    _, number = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(number, kind="stable")
    bounds = np.flatnonzero(np.diff(number[order], prepend=-1))
    groups = np.split(order, bounds[1:])
    return [Batch(_readings(rows, tools[np.sort(each)]), tools[np.sort(each)]) for each in groups]


def _kinds(rows: Rows) -> Ints:
    """What must be alike (T, k) in a batch: stations, and which columns are blank, part, full."""
    counts = rows.counts
    kinds = [counts]
    for name in sorted(rows.numbers):
        filled = rows.filled(name)
        kinds.append((filled > 0).astype(int) + (filled == counts))
        if name.startswith("sd_ref"):
            kinds.append(np.minimum(rows.sums(rows.numbers[name] > 0), 1))
    if GROUP in rows.table.column_names:
        kinds.append(np.minimum(rows.sums(rows.groups >= 0), 1))
    return np.stack(kinds, -1).astype(int)


def _groups(rows: Rows) -> Ints:
    """Number (R,) of the group of each row within its tool, -1 for none."""
    arrow, _ = parquet.modules(rows.source)
    cells = parquet.as_column(GROUP, rows.table.column(GROUP), arrow)
    names = arrow.array([str(cell).strip() for cell in cells]).dictionary_encode()
    blank = names.dictionary.index("").as_py()
    codes = names.indices.to_numpy(zero_copy_only=False).astype(int)
    codes = np.where(codes == blank, -1, codes)
    tool = np.repeat(np.arange(len(rows.counts)), rows.counts)
    keys = tool * (codes.max(initial=0) + 2) + codes + 1
    _, place = np.unique(keys, return_inverse=True)
    lowest = np.minimum.reduceat(place, rows.starts[:-1])
    ungrouped = np.logical_or.reduceat(codes < 0, rows.starts[:-1])
    return np.where(codes < 0, -1, place - (lowest + ungrouped)[tool])


def _readings(rows: Rows, tools: Ints) -> Readings:
    """Readings (B, n, ...) of tools of one kind."""
    where = rows.starts[tools][:, None] + np.arange(rows.counts[tools[0]])

    def cells(name: str) -> Array | None:
        values = rows.numbers.get(name)
        found = None if values is None else values[where]
        return None if found is None or np.isnan(found).all() else found

    known = _known(cells, rows.offsets[0][tools][:, None])
    triads, sd = {}, {}
    for kind in CHANNELS:
        raw = [cells(name) for name in CHANNELS[kind]]
        if any(channel is None for channel in raw):
            continue
        stacked = np.stack([c for c in raw if c is not None], -1)
        triad: TriadProfile = getattr(rows.profile, kind)
        scale = _scale(triad, stacked, _strength(known, kind, where.shape))
        triads[kind] = (stacked / scale) @ triad.permutation.transpose()
        spread = _spread(triad, [cells(f"sd_{name}") for name in CHANNELS[kind]], stacked)
        if spread is not None:
            sd[kind] = (spread / scale) @ np.abs(triad.permutation.transpose())
    group = rows.groups[where] if GROUP in rows.table.column_names else None
    return Readings(
        accelerometer=triads["accelerometer"],
        magnetometer=triads.get("magnetometer"),
        temperature=cells("temperature_c"),
        known=known,
        sd=sd
        | _reference_spreads(rows, known, cells, where.shape)
        | common_errors(rows.profile, where.shape),
        group=None if group is None or (group < 0).all() else group,
        source=rows.source,
    )


def _known(cells: Any, offset: Array) -> dict[str, Array]:
    """Reference values (B, n) by name, in radians, g and nT; stated azimuths less `offset` (B, 1), °."""
    found = {}
    for name, reference in REFERENCES.items():
        values = cells(reference.column)
        if values is None:
            continue
        if name == "azimuth":
            values = values - offset
        if name in ("azimuth", "toolface"):
            outside = (values < 0.0) | (values >= 360.0)
            if outside.any():
                values = np.where(outside, np.mod(values, 360.0), values)
        found[name] = values * reference.factor
    return found


def _scale(triad: TriadProfile, raw: Array, strength: Array) -> Array | float:
    """Nominal scale, or where the profile states none (B, 1, 1) of the readings themselves."""
    if triad.scale is not None:
        return triad.scale
    middle = (raw.min(-2, keepdims=True) + raw.max(-2, keepdims=True)) / 2
    radius = np.median(np.linalg.norm(raw - middle, axis=-1), -1)
    still = np.median(np.linalg.norm(raw, axis=-1), -1)
    radius = np.where(radius > 0, radius, np.where(still > 0, still, 1.0))
    return np.asarray(radius / strength)[:, None, None]


def _strength(known: Mapping[str, Array], kind: str, shape: tuple[int, ...]) -> Array:
    """Mean strength (B,) of the field that a triad measures, 1 where it is not known."""
    if kind == "accelerometer":
        gravity = known.get("gravity", np.ones(shape))
        return np.asarray(np.where(np.isnan(gravity), 1.0, gravity).mean(-1))
    field = known.get("field", np.ones(shape))
    return np.asarray(np.nansum(field, -1) / np.maximum((~np.isnan(field)).sum(-1), 1))


def _spread(triad: TriadProfile, cells: Sequence[Array | None], raw: Array) -> Array | None:
    """Standard uncertainty (B, n, 3) of raw readings; None where nothing is stated."""
    if all(c is None for c in cells):
        common = triad.noise
        return None if common is None else np.full(raw.shape, np.hypot(common, triad.repeatability))
    stated = [np.full(raw.shape[:-1], np.nan) if c is None else c for c in cells]
    noise = np.stack(stated, -1)
    if triad.noise is not None:
        noise = np.where(np.isnan(noise), triad.noise, noise)
    return None if np.isnan(noise).all() else np.hypot(noise, triad.repeatability)


def _reference_spreads(
    rows: Rows, known: Mapping[str, Array], cells: Any, shape: tuple[int, ...]
) -> dict[str, Array]:
    """Standard uncertainties (B, n) of references: the table's, else the stand's, else zero."""
    found = {}
    for name in dict.fromkeys([*known, "gravity"]):
        stated = cells(f"sd_{REFERENCES[name].column}")
        values = np.full(shape, np.nan) if stated is None else stated
        given = name in known or name == "gravity"
        spread = reference_spread(rows.profile, name, values, given)
        if spread.any():
            found[name] = spread
    return found
