"""Rows of many tools to batches of `Readings`, by the rules of a run file.

Tools of the same number of stations and the same kinds of evidence form one batch. The message
about a cell that a run file may not have is that of the tool's rows as a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mwdcal.calibration.diagnosis.flags import Alone
from mwdcal.calibration.readings import TRIADS, Readings, group_numbers
from mwdcal.errors import InputError, MwdcalError
from mwdcal.estimation.batch import held_once
from mwdcal.files.contract import COLUMN_OF_DAY, COLUMNS, RANGES, faults
from mwdcal.files.formats import parquet
from mwdcal.files.formats.columns import as_text, shown
from mwdcal.files.formats.table import Table
from mwdcal.files.formats.titles import dated
from mwdcal.files.runs import convert, to_readings
from mwdcal.fleet import sources
from mwdcal.fleet.choices import alike
from mwdcal.fleet.sources import AZIMUTH, FAULT, OFFSET, RUN_FILE, SERIAL
from mwdcal.fleet.tables import one_chunk
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.sensor.profile import Profile

GROUP, STATION = "group", "station"


@dataclass(frozen=True)
class Rows:
    """The stations of T tools, the rows of each together: an Arrow table.

    `digest` is that of the file that all of them come from, if it is known.
    """

    table: Any
    source: str
    metadata: Mapping[str, object]
    profile: Profile
    digest: str = ""
    _run_files: dict[str, Table] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def starts(self) -> Ints:
        """The first row of each tool, and the end (T + 1,); rows are in order of tools."""
        codes = one_chunk(self.table.column(SERIAL)).indices.to_numpy(zero_copy_only=False)
        return np.append(np.flatnonzero(np.diff(codes, prepend=codes[0] - 1)), len(codes))

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
        names = [name for name in self.table.column_names if name in RANGES]
        columns = {name: np.asarray(self.table.column(name).to_numpy(), float) for name in names}
        return {name: cells for name, cells in columns.items() if not np.isnan(cells).all()}

    @cached_property
    def offsets(self) -> tuple[Array, Array]:
        """Least and most (T,) by which a tool's stated azimuths exceed magnetic ones, °; NaN for none."""
        count = len(self.counts)
        if AZIMUTH not in self.numbers or OFFSET not in self.table.column_names:
            return np.zeros(count), np.zeros(count)
        stated = self.table.column(OFFSET).to_numpy()
        offset = np.where(np.isnan(self.numbers[AZIMUTH]), np.nan, stated)
        first = self.starts[:-1]
        return np.fmin.reduceat(offset, first), np.fmax.reduceat(offset, first)

    @cached_property
    def groups(self) -> Ints:
        """Number (R,) of the group of each row within its tool, -1 for none."""
        none = np.full(self.starts[-1], -1)
        if GROUP not in self.table.column_names:
            return none
        arrow, _ = parquet.modules(self.source)
        names = parquet.as_column(GROUP, self.table.column(GROUP), arrow)
        numbers = group_numbers([str(name).strip() for name in names], self.starts.tolist())
        return none if numbers is None else numbers

    def alone(self, tool: int, proved: bool = False) -> tuple[Readings, Profile]:
        """One tool's readings as a single run has them; raises what a single run would, if it is not `proved`."""
        arrow, _ = parquet.modules(self.source)
        part = self.table.slice(self.starts[tool], self.counts[tool])
        serial = part.column(SERIAL)[0].as_py()
        if run := self._run(tool, str(serial)):
            return to_readings(run, self.profile)
        lines = (part.column("#row").to_numpy() + 1).tolist()
        names = [name for name in part.column_names if name in (*COLUMNS, *COLUMN_OF_DAY)]
        columns = {name: parquet.as_column(name, part.column(name), arrow) for name in names}
        place = self.source if self.source.endswith(".parquet") else f"{self.source}/*.parquet"
        source = f"serial {serial} of {place}"
        metadata = {**self.metadata, SERIAL: str(serial), **self._north(tool, source)}
        table = Table(columns, dated(metadata, columns.items()), source, lines, self.digest)
        return to_readings(table, self.profile, proved=proved)

    def _run(self, tool: int, serial: str) -> Table | None:
        """The run of a tool that comes from a run file; refuses one of several, or that cannot be read."""
        paths = self._texts(RUN_FILE, tool)
        if len(paths) > 1:
            files = sorted(path or self.source for path in paths)
            names = {Path(file).name for file in files}
            each = sorted(names) if len(names) == len(files) else files
            raise InputError(
                f"the serial {shown(serial)} is that of {' and '.join(each)}. A run file is a whole run: correct "
                "the serial in one of them, or take it out of the folder."
            )
        for fault in filter(None, self._texts(FAULT, tool)):
            raise InputError(fault)
        path = paths[0]
        if path is None:
            return None
        if path not in self._run_files:
            self._run_files[path] = sources.read(Path(path), self.profile)
        return sources.run_of(self._run_files[path], serial)

    def _texts(self, name: str, tool: int) -> list[str | None]:
        """The different cells of a tool in a column of text."""
        if name not in self.table.column_names:
            return [None]
        column = self.table.column(name).slice(self.starts[tool], self.counts[tool])
        return list(column.unique().to_pylist())

    @cached_property
    def doubtful(self) -> Bools:
        """Tools (T,) with rows in several run files, or in one that cannot be read."""
        doubtful = np.zeros(len(self.counts), bool)
        if RUN_FILE in self.table.column_names:
            codes = one_chunk(self.table.column(RUN_FILE)).indices.fill_null(-1).to_numpy()
            first = self.starts[:-1]
            low, high = np.minimum.reduceat(codes, first), np.maximum.reduceat(codes, first)
            doubtful = (low < high) | self.unread
        return doubtful

    @cached_property
    def unread(self) -> Bools:
        """Tools (T,) with a run file that cannot be read."""
        if FAULT not in self.table.column_names:
            return np.zeros(len(self.counts), bool)
        return self.any(self.table.column(FAULT).is_valid().to_numpy())

    def members(self, tools: Ints) -> Alone:
        """The same for some tools that none of `refused_tools` is among, by place among these."""
        return lambda place: self.alone(int(tools[place]), proved=True)

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

    def any(self, rows: Bools) -> Bools:
        """Whether (T,) any of the rows of a tool is true."""
        return np.logical_or.reduceat(rows, self.starts[:-1])


def refused_tools(rows: Rows) -> dict[int, str]:
    """Tools with cells that a run may not have, and the message about the first of them."""
    wrong = np.zeros(rows.starts[-1], bool)
    for fault in faults(rows.numbers.get, rows.starts, rows.profile):
        wrong |= fault.cells.any(0)
    refused = {}
    for tool in np.flatnonzero(
        rows.any(wrong) | (rows.offsets[1] > rows.offsets[0]) | rows.doubtful
    ):
        try:
            rows.alone(int(tool))
        except MwdcalError as error:
            refused[int(tool)] = str(error)
    return refused


def batches(rows: Rows, tools: Ints) -> list[tuple[Ints, Readings]]:
    """The given tools, in batches of one number of stations and the same kinds of evidence.

    Their numbers (B,), and their readings (B, n, ...).
    """
    return [(some, _readings(rows, some)) for _, some in alike(tools, _kinds(rows)[tools])]


def _kinds(rows: Rows) -> Ints:
    """What must be alike (T, k) in a batch: stations, and which columns are blank, part, full."""
    kinds: list[AnyArray] = [rows.counts]
    for name in sorted(rows.numbers):
        blank = np.isnan(rows.numbers[name])
        kinds += [rows.any(~blank), ~rows.any(blank)]
        if name.startswith("sd_ref"):
            kinds.append(rows.any(rows.numbers[name] > 0))
    return np.stack([*kinds, rows.any(rows.groups >= 0)], -1).astype(int)


def _readings(rows: Rows, tools: Ints) -> Readings:
    """Readings (B, n, ...) of tools of one kind; what they have in common is held once, but for what the tools read."""
    where = rows.starts[tools][:, None] + np.arange(rows.counts[tools[0]])

    @cache
    def cells(name: str) -> Array | None:
        values = rows.numbers.get(name)
        return None if values is None else values[where]

    readings, _ = convert(cells, where.shape, rows.profile, rows.offsets[0][tools][:, None])
    group = rows.groups[where]
    readings = replace(readings, group=group if (group >= 0).any() else None, source=rows.source)
    read = {name: getattr(readings, name) for name in TRIADS}
    return replace(held_once(readings), **read)
