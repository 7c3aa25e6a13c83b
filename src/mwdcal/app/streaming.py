"""Tables of any length through a calibration: read, corrected and written part by part.

Reading, computing and writing overlap: one thread reads, some compute, the caller writes, and
only a few parts are in memory at any time. Results, findings and refusals are those of
`app.tables.apply_to_table`, which is for tables that fit in memory, but for two: which outputs
rest on undetermined directions is judged on a sample of each part, and blank `sd_` cells are
compared with others of their part.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from mwdcal.calibration import Calibration, Finding
from mwdcal.core import fused
from mwdcal.core.vectors import Array
from mwdcal.correction import (
    JUDGED,
    NAMES,
    Tally,
    check_outside,
    findings,
    numbers,
    reference,
    undetermined,
)
from mwdcal.errors import InputError
from mwdcal.files import atomic, runs, streams
from mwdcal.files.columns import check_names, no_stations
from mwdcal.files.contract import CHANNELS, RAW_RANGE, TEMPERATURE, check_columns
from mwdcal.files.sinks import ParquetSink, Sink, TextSink
from mwdcal.files.streams import Part, Source
from mwdcal.files.table import Table, cell_error
from mwdcal.files.table import numbers as as_numbers
from mwdcal.profile import TriadProfile
from mwdcal.readings import TRIADS, Readings

LONG = (200_000, 16_000_000)
"""Rows of a Parquet table, bytes of a text table, from which it is streamed."""
MANY = 3_000_000
"""Rows from which the compiled loops are worth their start: until then the writer is the slowest."""
LINES = 1 << 14
"""Rows of a part that becomes text."""
WORKERS = 4
"""Most parts that are computed at once: more would wait for the writer."""
SAMPLE = 1024
"""Rows of a part on which undetermined outputs are judged."""
BLOCK = 1 << 14
"""Rows that plain NumPy takes at a time."""
MARGIN = 1.0
"""Degrees by which a temperature may lie outside the calibrated range."""
OPTIONAL = {
    CHANNELS["magnetometer"]: "Fill it in, or remove the station.",
    ("temperature_c",): "Fill it in, or leave the whole column blank.",
}
"""Columns that are blank on all rows or on none, and what to do where they are neither."""
_MOST = 10**15

Item = TypeVar("Item")
Made = TypeVar("Made")


class Corrected(NamedTuple):
    """A part, rendered for the sink, and what was seen in it."""

    rendered: Any
    size: int
    tally: Tally


def is_long(readings: Path, output: Path, decimal: str) -> bool:
    """Whether a table is to be streamed: it is long, and both formats and signs allow it."""
    formats = (".parquet", ".csv", ".tsv")
    plain = decimal == "." and output.suffix.lower() in formats
    return plain and streams.is_long(readings, LONG)


def apply_to_file(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    advance: Callable[[int, int], None] = lambda done, total: None,
    rows: int = 0,
    least: int = MANY,
) -> tuple[int, list[Finding]]:
    """Correct a file into another; number of rows, and what the reader should know.

    `advance` is told how much of the whole is done. `rows` of a part of a Parquet table, by
    default as many as memory bears; `least` rows of the whole from which loops are compiled.
    """
    check_outside(outside)
    source = _source(readings, output, rows)
    _check_header(source)
    pieces = source.pieces()
    first = next((piece for piece in pieces if _loaded(source, piece).table.count), None)
    if first is None:
        raise no_stations(source.name)
    worker = _Worker.of(calibration, source, first, outside, source.rows >= least)
    done, tallies = 0, []
    with atomic.replacing(output) as stream:
        sink = worker.sink(stream, output)
        for part in overlapped(chain([first], pieces), lambda piece: worker(piece, sink)):
            sink.write(part.rendered)
            tallies.append(part.tally)
            done += part.size
            advance(done, source.size)
        total = _total(tallies)
        found = findings(calibration, worker.said, total, outside)
        sink.finish([finding.text for finding in found])
    return total.rows, found


def overlapped(items: Iterator[Item], work: Callable[[Item], Made]) -> Iterator[Made]:
    """`work` of every item, in order; the next ones are taken and worked on meanwhile."""
    workers = min(WORKERS, fused.cores())
    end: Any = object()
    with ThreadPoolExecutor(workers + 1) as pool:
        upcoming = pool.submit(next, items, end)
        running: deque[Future[Made]] = deque()
        try:
            while (item := upcoming.result()) is not end:
                upcoming = pool.submit(next, items, end)
                running.append(pool.submit(work, item))
                if len(running) > workers:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def _source(readings: Path, output: Path, rows: int) -> Source:
    typed = output.suffix.lower() == ".parquet"
    if readings.suffix.lower() == ".parquet":
        return streams.open_parquet(readings, rows or (0 if typed else LINES))
    return streams.open_text(readings, typed=typed)


def _check_header(source: Source) -> None:
    """Refuse columns that are missing, doubtful, or have the name of a result."""
    check_names(source.names, source.name)
    check_columns(source.names, source.name)
    if source.names[0].startswith("#"):
        raise InputError(f"{source.name}: the first column name must not start with '#'.")
    taken = [name for name in NAMES if name in source.names]
    if taken:
        raise InputError(
            f"{source.name}: the column '{taken[0]}' is there already, and would be lost under "
            "the result of that name. Rename it, or correct the readings without it."
        )


def _loaded(source: Source, piece: Any) -> Part:
    try:
        return source.load(piece, False)
    except InputError:
        return source.load(piece, True)


def _total(tallies: Sequence[Tally]) -> Tally:
    moved = {name for tally in tallies for name in tally.moved}
    rows, beyond = (sum(counts) for counts in zip(*(t[:2] for t in tallies), strict=True))
    return Tally(rows, beyond, tuple(name for name in JUDGED if name in moved))


@dataclass(frozen=True)
class _Worker:
    """Corrects parts; may be called by several threads at once.

    Attributes:
        first: the first piece that has rows.
        absent: groups of columns that are wholly blank in the first part, and so everywhere.
        said: readings without rows: what the findings need to know of the source.
        triads: numbers for the compiled loops; None where NumPy computes.
        tool: which channel each tool axis is, and the nominal unit of it, by triad.
        moved: outputs already known to rest on what the calibration leaves undetermined.
    """

    calibration: Calibration
    source: Source
    outside: str
    first: Any
    absent: tuple[tuple[str, ...], ...]
    said: Readings
    triads: tuple[fused.Numbers, fused.Numbers] | None
    tool: tuple[tuple[list[int], list[float]], ...]
    moved: set[str] = field(default_factory=set)

    @classmethod
    def of(
        cls, calibration: Calibration, source: Source, first: Any, outside: str, many: bool
    ) -> _Worker:
        """What the first piece says about all."""
        part = _loaded(source, first)
        columns = part.table.columns
        groups = [group for group in OPTIONAL if group[0] in columns]
        absent = tuple(g for g in groups if all(_is_blank(part.table, name) for name in g))
        kept = [g[0] for g in groups if g not in absent]
        empty = np.empty((0, 3))
        said = Readings(
            accelerometer=empty,
            magnetometer=empty if "mx" in kept else None,
            temperature=empty[:, 0] if "temperature_c" in kept else None,
            metadata=source.metadata,
            source=source.name,
        )
        reference(calibration, said)  # refuses a calibration with temperature terms without any
        triads = numbers(calibration) if many and fused.available() else None
        tool = tuple(_tool(calibration, triad) for triad in TRIADS)
        return cls(calibration, source, outside, first, absent, said, triads, tool)

    def sink(self, stream: IO[bytes], output: Path) -> Sink:
        """An empty table in the format of the output's name."""
        metadata = {**self.source.metadata, **described(self.calibration)}
        suffix = output.suffix.lower()
        if suffix == ".parquet":
            return ParquetSink(stream, self.source.schema, NAMES, metadata)
        how = "extrapolate" if self.outside == "refuse" else self.outside
        judged = JUDGED if self.calibration.free else ()
        most = findings(self.calibration, self.said, Tally(_MOST, _MOST, judged), how)
        longest = [finding.text for finding in most]
        delimiter = "," if suffix == ".csv" else "\t"
        return TextSink(stream, self.source.schema, NAMES, metadata, longest, delimiter)

    def __call__(self, piece: Any, sink: Sink) -> Corrected:
        """A piece, corrected and rendered; text that seems wrong is looked at line by line."""
        try:
            return self._corrected(self.source.load(piece, False), sink)
        except InputError:
            return self._corrected(self.source.load(piece, True), sink)

    def _corrected(self, part: Part, sink: Sink) -> Corrected:
        count = part.table.count
        channels = self._channels(part.table)
        found = self._compiled(channels, count) if self.triads else self._plain(channels, count)
        if found.unsound:
            self._refuse(part.table)
        if any(name.startswith(("ref_", "sd_")) for name in part.table.columns):
            kinds = [kind for kind in TRIADS if channels[kind] is not None]
            runs.check_references(part.table, self.calibration.profile, kinds)
        moved = self._undetermined(channels, count)
        rendered = sink.render(part.carried, found.columns, bool(found.empty))
        return Corrected(rendered, part.size, Tally(count, found.beyond, moved))

    def _channels(self, table: Table) -> dict[str, list[Array] | None]:
        """Columns of each triad, and of the temperature; None where there are none."""
        groups = {**CHANNELS, "temperature": ("temperature_c",)}
        found: dict[str, list[Array] | None] = {}
        for kind, names in groups.items():
            lacking = names in self.absent or names[0] not in table.columns
            found[kind] = None if lacking else [_column(table, name) for name in names]
            if names in self.absent and not all(_is_blank(table, name) for name in names):
                raise _blank(self.source.load(self.first, True).table, names)
        return found

    def _limits(self) -> fused.Limits:
        low, high = self.calibration.temperature_c or (-np.inf, np.inf)
        if self.said.temperature is None:
            low, high = -np.inf, np.inf
        accepted = (RAW_RANGE.low, RAW_RANGE.high), (TEMPERATURE.low, TEMPERATURE.high)
        return fused.Limits(*accepted, (low - MARGIN, high + MARGIN), self.outside == "blank")

    def _compiled(self, channels: Mapping[str, list[Array] | None], count: int) -> fused.Found:
        assert self.triads is not None
        columns, units, lacking = [], [], 0
        for kind, (order, unit) in zip(TRIADS, self.tool, strict=True):
            three = channels[kind] or [np.full(count, np.nan)] * 3
            lacking += 0 if channels[kind] else 3
            columns += [three[i] for i in order]
            units += unit
        zero = self.calibration.reference_temperature
        columns += channels["temperature"] or [np.full(count, zero)]
        found = fused.run(columns, self.triads, zero, units, self._limits(), workers=1)
        return found._replace(unsound=found.unsound - lacking * count)

    def _plain(self, channels: Mapping[str, list[Array] | None], count: int) -> fused.Found:
        """The same by plain NumPy, a block at a time."""
        limits, out = self._limits(), np.empty((len(NAMES), count))
        beyond = unsound = 0
        for kind, columns in channels.items():
            low, high = limits.temperature if kind == "temperature" else limits.raw
            unsound += sum(int((~((c >= low) & (c <= high))).sum()) for c in columns or [])
        for start in range(0, 0 if unsound else count, BLOCK):
            rows = slice(start, start + BLOCK)
            readings = self._readings(channels, rows)
            out[:, rows] = [*reference(self.calibration, readings).values()]
            hot = self.calibration.outside(readings)
            beyond += int(hot.sum())
            if limits.blank:
                out[:, rows][:, hot] = np.nan
        return fused.Found(out, unsound, beyond, int(np.isnan(out).sum()))

    def _readings(self, channels: Mapping[str, list[Array] | None], rows: slice) -> Readings:
        """Some rows as `Readings`, without labels and references."""
        profile, magnetic = self.calibration.profile, channels["magnetometer"]
        warmth = channels["temperature"]
        return replace(
            self.said,
            accelerometer=_nominal(channels["accelerometer"] or [], rows, profile.accelerometer),
            magnetometer=_nominal(magnetic, rows, profile.magnetometer) if magnetic else None,
            temperature=warmth[0][rows] if warmth else None,
        )

    def _undetermined(
        self, channels: Mapping[str, list[Array] | None], count: int
    ) -> tuple[str, ...]:
        if not self.calibration.free:
            return ()
        readings = self._readings(channels, slice(0, count, max(1, count // SAMPLE)))
        names = [name for name in JUDGED if name not in self.moved]
        moved = undetermined(self.calibration, readings, names)
        self.moved.update(moved)
        return moved

    def _refuse(self, table: Table) -> None:
        """Say what is wrong with a part, in the words of a run file."""
        runs.to_readings(table, self.calibration.profile)
        for names in OPTIONAL:
            present = names[0] in table.columns and names not in self.absent
            if present and _is_blank(table, names[0]):
                raise _blank(table, names)


def described(calibration: Calibration) -> dict[str, object]:
    """What a corrected table says of the calibration it rests on."""
    return {
        "calibration_run": calibration.run,
        "calibration_time": calibration.time,
        "azimuth_out": "magnetic",
        "field_unit": calibration.field_unit,
    }


def _blank(table: Table, names: tuple[str, ...]) -> InputError:
    problem = f"must be filled in; got a blank cell. {OPTIONAL[names]}"
    return cell_error(table, names[0], 0, problem)


def _column(table: Table, name: str) -> Array:
    """The column as numbers; what they may be is checked with all the rest."""
    column = table.columns[name]
    return as_numbers(table, name) if isinstance(column, list) else column


def _nominal(channels: Sequence[Array], rows: slice, triad: TriadProfile) -> Array:
    return runs.to_nominal(np.stack([channel[rows] for channel in channels], -1), triad)


def _is_blank(table: Table, name: str) -> bool:
    column = table.columns[name]
    if isinstance(column, list):
        return not any(cell.strip() for cell in column)
    return bool(np.isnan(column).all())


def _tool(calibration: Calibration, kind: str) -> tuple[list[int], list[float]]:
    """Which channel each tool axis is, and raw units, with sign, per nominal one."""
    triad = getattr(calibration.profile, kind)
    channel = np.abs(triad.permutation).argmax(axis=1)
    sign = triad.permutation[np.arange(3), channel]
    return channel.tolist(), (sign * (triad.scale or 1.0)).tolist()
