"""A table of readings through a calibration, to a table with the results beside the input."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, Any, TypeVar

import msgspec
import numpy as np

from mwdcal.app.messages import say
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.readings import TRIADS, Readings, is_simulated
from mwdcal.calibration.record import MARGIN, Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import contract, runs, streams, synonyms
from mwdcal.files.contract import (
    CHANNELS,
    COLUMNS,
    OPTIONAL,
    RANGES,
    RAW_RANGE,
    TEMPERATURE,
    blank_cell,
    check_columns,
    chosen,
    columns_of,
    is_blank,
    nothing,
    spread,
    wholly_blank,
    without_reading,
)
from mwdcal.files.formats import atomic, parquet
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import as_text, check_names, no_stations
from mwdcal.files.formats.sinks import ParquetSink, Sink, TextSink
from mwdcal.files.formats.table import EXCHANGED, Table
from mwdcal.files.formats.table import numbers as as_numbers
from mwdcal.files.runs import away_from_stand, is_export, renamed, to_readings
from mwdcal.files.statements import Said, with_statements
from mwdcal.files.streams import Part, StreamedTable
from mwdcal.geometry.observables import EXTRAPOLATED, RESULTS, UNCERTAINTIES
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.presentation.readings import read_surveys
from mwdcal.sensor.profile import Profile
from mwdcal.use import correction, correction_numba, strengths
from mwdcal.use.correction import JUDGED, RowCounts, correct_and_count
from mwdcal.use.uncertainty import reading_terms, with_uncertainty

# --------------------------------------------------------------------------
# Tables of any length through a calibration: read, corrected and written part by part.
#
# Every Parquet table that becomes Parquet or text goes this way, so that its columns keep their
# types. Reading, computing and writing overlap: one thread reads, some compute, the caller writes,
# and only a few parts are in memory at any time. Results, findings and refusals are those of
# `mwdcal.app.correction.apply_to_table`, which is for short text and for workbooks, but for two: which outputs
# rest on undetermined directions is judged on a sample of each part, and blank `sd_` cells are
# compared with others of their part.

TABLE_SIZES = {".csv": 1_000_000, ".tsv": 1_000_000, ".parquet": 8_000_000}
"""Bytes of a text table from which it is taken in parts, by what it becomes.

Text that becomes Parquet has numbers in fewer columns when it is.
"""
ROWS_FOR_LOOPS = 3_000_000
"""Rows from which the compiled loops are worth their start: until then the writer is the slowest."""
TEXT_ROWS = 1 << 14
"""Rows of a part that becomes text."""
WORKERS = 4
"""Most parts that are computed at once: more would wait for the writer."""
SAMPLE = 1024
"""Rows of a part on which undetermined outputs are judged."""
BLOCK = 1 << 14
"""Rows that plain NumPy takes at a time."""
LONGEST_SERIAL = 60
"""Most characters of another tool's serial that a finding names."""
_MOST = 10**15
_OFF = strengths.Strengths(_MOST, _MOST, _MOST, _MOST, -1.23e-100, -1.24e-100)
WORST_ROWS = RowCounts(
    rows=_MOST,
    beyond=_MOST,
    serials=("\0" * LONGEST_SERIAL, "\1" * LONGEST_SERIAL, "…"),
    strengths=dict.fromkeys(strengths.JUDGED_STRENGTHS, _OFF),
    warmth=TEMPERATURE[:2],
    valueless=_MOST,
    away=2 * _MOST,
    scatter=dict.fromkeys(
        correction.STEADY_CHANGES, correction.Scatter(1, 1, -1.23e9, 1.23e9, 1.2e-100)
    ),
)
"""Rows whose findings take more room than those of any others."""

Channels = Mapping[str, list[Array]]
"""Columns of each triad, and of the temperature, that are not blank."""
Item = TypeVar("Item")
Result = TypeVar("Result")


def in_parts(readings: Path, output: Path) -> bool:
    """Whether a table is taken in parts: Parquet or long text that does not become a workbook."""
    least = TABLE_SIZES.get(output.suffix.lower())
    return least is not None and streams.in_parts(readings, least)


def apply_to_file(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    advance: Callable[[int, int], None] = lambda done, total: None,
    rows: int = 0,
    least: int = ROWS_FOR_LOOPS,
    missing: str = "refuse",
    decimal: str = ".",
    uncertainty: bool = True,
    statements: Mapping[str, str] | None = None,
) -> tuple[RowCounts, list[Finding]]:
    """Correct a file into another; what was seen in the rows, and what the reader should know.

    `advance` gets how much of the whole is done, and the whole. `rows` of a part of a Parquet table, by
    default as many as memory bears; `least` rows of the whole from which loops are compiled.
    """
    correction.check_outside(outside)
    source = _source(readings, output, rows, decimal)
    source.metadata.update(with_statements(source.metadata, statements or {}))
    names = correction.result_names(outside, uncertainty)
    _check_header(calibration, source, names)
    pieces = source.pieces()
    first = next((piece for piece in pieces if _table(source, piece).count), None)
    if first is None:
        raise no_stations(source.name)
    worker = _Worker(calibration, source, first, outside, missing, source.rows >= least, names)
    done, tallies = 0, []
    with atomic.replacing(output) as stream, closing(worker.sink(stream, output)) as sink:
        work = partial(source.exactly_if_refused, partial(worker.corrected, sink))
        for rendered, size, tally in overlapped(chain([first], pieces), work):
            sink.write(rendered)
            tallies.append(tally)
            done += size
            advance(done, source.size)
        total = _total(tallies, worker.moved)
        total = total._replace(metadata=runs.identified(source.metadata, total.serials))
        if total.lacking == total.rows:
            raise nothing(source.name)
        remarks = worker.findings(total, outside)
        strengths.check(calibration, total.strengths, source.name)
        sink.finish(stated(source.metadata, remarks))
    remarks += unused_columns(synonyms.unused(source.names, COLUMNS))
    return total, remarks + runs.copied(source.names, sink.formulas, output.suffix.lower())


def overlapped(items: Iterator[Item], work: Callable[[Item], Result]) -> Iterator[Result]:
    """`work` of every item, in order; the next ones are taken and worked on meanwhile."""
    workers = min(WORKERS, correction_numba.cores())
    end: Any = object()
    with ThreadPoolExecutor(workers + 1) as pool:
        upcoming = pool.submit(next, items, end)
        running: deque[Future[Result]] = deque()
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


def _source(readings: Path, output: Path, rows: int, decimal: str) -> StreamedTable:
    typed = output.suffix.lower() == ".parquet"
    if readings.suffix.lower() == ".parquet":
        return streams.open_parquet(readings, rows or (0 if typed else TEXT_ROWS), decimal)
    return streams.open_text(readings, typed=typed, decimal=decimal)


def _check_header(calibration: Calibration, source: StreamedTable, results: Sequence[str]) -> None:
    """Refuse columns that are missing, doubtful, or have the name of a result."""
    check_names(source.names, source.name)
    contract.check_columns(source.names, source.name)
    check_free(source.names, results, source.name)
    check_warmth(calibration, source.names, source.name)


def check_warmth(calibration: Calibration, names: Sequence[str], source: str) -> None:
    """Refuse a temperature under another name or in another unit where it is needed."""
    if any(triad.order for triad in calibration.triads):
        synonyms.check_evidence(names, source, ("temperature_c",))


def check_free(names: Iterable[str], results: Sequence[str], source: str) -> None:
    """Refuse a table that has a column of the name of a result."""
    taken = [name for name in results if name in names]
    if taken:
        raise InputError(
            f"{source}: the column '{taken[0]}' is there already, and would be lost under "
            "the result of that name. Rename it, or correct the readings without it."
        )


def _table(source: StreamedTable, piece: Any) -> Table:
    return source.exactly_if_refused(lambda part: part.table, piece)


def _total(tallies: Sequence[RowCounts], moved: Collection[str]) -> RowCounts:
    serials = runs.serials({}, chain.from_iterable(tally.serials for tally in tallies))
    return correction.joined(tallies)._replace(
        moved=tuple(name for name in JUDGED if name in moved), serials=tuple(serials)
    )


class _Worker:
    """Corrects parts; may be called by several threads at once.

    Attributes:
        absent: groups of columns that are wholly blank in the first part, and so everywhere.
            Where rows may lack a reading: that are wholly blank in all parts.
        said: readings without rows: what the findings need to know of the source.
        triads: numbers for the compiled loops; None where NumPy computes.
        moved: outputs already known to rest on what the calibration leaves undetermined.
    """

    def __init__(
        self, calibration: Calibration, source: StreamedTable, first: Any, outside: str,
        missing: str, many: bool, names: Sequence[str],
    ) -> None:  # fmt: skip
        """With the first piece that has rows, whether there are `many` rows in all, and the `names` of the results."""
        self.names, self.stated = names, UNCERTAINTIES[0] in names
        self.calibration, self.source, self.first = calibration, source, first
        self.outside, self.missing = outside, missing
        self.moved: set[str] = set()
        judged = [first] if missing == "refuse" else source.pieces()
        self.absent = wholly_blank(_table(source, piece) for piece in judged)
        table = _table(source, first)
        no_rows = chosen(table, np.zeros(table.count, bool))
        self.said = self._readings(self._channels(no_rows), slice(None))
        correction.reference(calibration, self.said)  # refuses where temperatures are needed
        compiled = many and correction_numba.available()
        self.triads = correction.numbers(calibration) if compiled else None
        if self.triads and not correction_numba.kept_code_is_sound():
            say("machine code kept from an earlier run was damaged: it is compiled again.")
        self.limits = self._limits()

    def _limits(self) -> correction_numba.RowLimits:
        given = self.said.temperature is not None and self.calibration.temperature_c
        low, high = given or (-np.inf, np.inf)
        warmth = low - self.calibration.margin, high + self.calibration.margin
        blank = self.outside == "blank"
        return correction_numba.RowLimits(RAW_RANGE[:2], TEMPERATURE[:2], warmth, blank)

    def findings(self, tally: RowCounts, outside: str) -> list[Finding]:
        """The findings about rows with these counts."""
        metadata = runs.identified(self.source.metadata, tally.serials)
        heard = replace(self.said, metadata=metadata, source=self.source.name)
        return correction.findings(self.calibration, heard, tally, outside)

    def sink(self, stream: IO[bytes], output: Path) -> Sink:
        """An empty table in the format of the output's name."""
        arrow, _ = parquet.modules(output.name)
        metadata = {**self.source.metadata, **described(self.calibration, self.names)}
        metadata.pop("findings", None)  # with those of the results, when these are known
        kinds = dict.fromkeys(self.names, arrow.float64()) | {EXTRAPOLATED: arrow.bool_()}
        results = arrow.schema([(name, kinds[name]) for name in self.names])
        if output.suffix.lower() == ".parquet":
            return ParquetSink(stream, self.source.schema, results, metadata)
        worst = WORST_ROWS._replace(
            moved=JUDGED if self.calibration.free else (),
            lacking=0 if self.missing == "refuse" else _MOST,
        )
        how = "extrapolate" if self.outside == "refuse" else self.outside
        anonymous = worst._replace(serials=())  # has a finding that named tools have not
        remarks = self.findings(worst, how) + self.findings(anonymous, how)
        longest = stated(self.source.metadata, remarks)
        delimiter = "," if output.suffix.lower() == ".csv" else "\t"
        return TextSink(stream, self.source.schema, results, metadata, longest, delimiter, RANGES)

    def corrected(self, sink: Sink, part: Part) -> tuple[Any, int, RowCounts]:
        """A part, corrected and rendered, its size, and what was seen in it."""
        table, rows = part.table, part.table.count
        channels, corrected = self._compute(table)
        whole: Bools | None = None
        if corrected.unsound and self.missing == "blank":
            whole = ~without_reading(table, self.absent)
            table = chosen(table, whole)
            channels, corrected = self._compute(table)
        if corrected.unsound:
            self._refuse(table)
        known: Mapping[str, Array] = {}
        if any(name.startswith(("ref_", "sd_")) for name in table.columns):
            kinds = [kind for kind in TRIADS if kind in channels]
            known = runs.check_references(table, self.calibration.profile, kinds)
        readings = replace(self._readings(channels, slice(None)), sd=self._noise(table, channels))
        columns, valueless = with_uncertainty(
            self.calibration,
            readings,
            dict(zip(RESULTS, corrected.columns, strict=True)),
            self.stated,
        )
        results = [*columns.values()]
        if self.outside == "extrapolate":
            results.append(self.calibration.outside(readings))
        if whole is not None:
            results = [spread(values, whole) for values in results]
        empty = corrected.empty or valueless or any(np.isnan(each).any() for each in results)
        rendered = sink.render(part.carried, results, bool(empty) or whole is not None)
        self._judge(channels, table.count)
        tally = RowCounts(
            rows, corrected.beyond, (), rows - table.count, self._serials(part.carried),
            strengths.judged(self.calibration, columns, known),
            correction.warmth(*channels.get("temperature", [None])), {}, valueless,
            correction.scatters(self.calibration, readings, columns), correction.angle_ranges(columns),
            int(self.calibration.outside(readings, MARGIN).sum()),
        )  # fmt: skip
        return rendered, part.size, tally

    def _noise(self, table: Table, channels: Channels) -> dict[str, Array]:
        """Noise of the readings along the tool axes, as the table or the profile states it."""
        cells, noise = columns_of(table), {}
        for kind in set(TRIADS).intersection(channels):
            triad = getattr(self.calibration.profile, kind)
            sd = runs.reading_noise(cells, kind, triad, (table.count,), triad.scale or 1.0)
            if sd is not None:
                noise[kind] = sd
        return noise

    def _serials(self, carried: Any) -> tuple[str, ...]:
        """The tools that a part names; names of others are cut, so that there is room for them."""
        if "serial" not in carried.column_names:
            return ()
        arrow, _ = parquet.modules(self.source.name)
        ours = self.calibration.tool.get("serial")
        cells = [c.strip() for c in parquet.texts(carried.column("serial").unique(), arrow)]
        return tuple(runs.serials({}, [c if c == ours else c[:LONGEST_SERIAL] for c in cells]))

    def _compute(self, table: Table) -> tuple[Channels, correction_numba.CorrectedRows]:
        """The channels of a table, and their results."""
        channels = self._channels(table)
        compute = self._plain if self.triads is None else self._compiled
        return channels, compute(channels, table.count)

    def _channels(self, table: Table) -> Channels:
        channels = {}
        for kind, names in {**CHANNELS, "temperature": ("temperature_c",)}.items():
            if names not in self.absent:
                if names[0] in table.columns:
                    channels[kind] = [_column(table, name) for name in names]
            elif not all(is_blank(table, name) for name in names):
                raise blank_cell(self.source.load(self.first, True).table, names)
        return channels

    def _compiled(self, channels: Channels, count: int) -> correction_numba.CorrectedRows:
        assert self.triads is not None
        blank = [np.full(count, np.nan)] * 3
        columns: list[Array] = []
        units: list[float] = []
        for kind in TRIADS:
            triad = getattr(self.calibration.profile, kind)
            order = np.abs(triad.permutation).argmax(axis=1)
            sign = triad.permutation[np.arange(3), order]
            columns += [channels.get(kind, blank)[i] for i in order]
            units += (sign * (triad.scale or 1.0)).tolist()
        zero = self.calibration.reference_temperature
        columns += channels.get("temperature", [np.full(count, zero)])
        corrected = correction_numba.run(columns, self.triads, zero, units, self.limits, workers=1)
        absent = 0 if "magnetometer" in channels else 3 * count
        return corrected._replace(unsound=corrected.unsound - absent)

    def _plain(self, channels: Channels, count: int) -> correction_numba.CorrectedRows:
        """The same by plain NumPy, a block at a time."""
        limits, out = self.limits, np.empty((len(RESULTS), count))
        beyond = unsound = 0
        for kind, columns in channels.items():
            low, high = limits.temperature if kind == "temperature" else limits.raw
            unsound += sum(int((~((c >= low) & (c <= high))).sum()) for c in columns)
        for start in range(0, 0 if unsound else count, BLOCK):
            rows = slice(start, start + BLOCK)
            readings = self._readings(channels, rows)
            out[:, rows] = [*correction.reference(self.calibration, readings).values()]
            hot = self.calibration.outside(readings)
            beyond += int(hot.sum())
            if limits.blank:
                out[:, rows][:, hot] = np.nan
        return correction_numba.CorrectedRows(out, unsound, beyond, int(np.isnan(out).sum()))

    def _readings(self, channels: Channels, rows: slice) -> Readings:
        """Some rows as `Readings`, without labels and references."""
        some = {kind: [column[rows] for column in columns] for kind, columns in channels.items()}
        read: dict[str, Any] = {
            kind: runs.to_nominal(np.stack(some[kind], -1), getattr(self.calibration.profile, kind))
            for kind in TRIADS
            if kind in some
        }
        warmth = some.get("temperature", [None])[0]
        return Readings(**read, temperature=warmth, source=self.source.name)

    def _judge(self, channels: Channels, count: int) -> None:
        """Which outputs rest on what the calibration leaves undetermined."""
        if self.calibration.free and count:
            readings = self._readings(channels, slice(0, count, max(1, count // SAMPLE)))
            names = [name for name in JUDGED if name not in self.moved]
            self.moved.update(correction.undetermined(self.calibration, readings, names))

    def _refuse(self, table: Table) -> None:
        """Say what is wrong with a part, in the words of a run file."""
        runs.to_readings(table, self.calibration.profile)
        for names in OPTIONAL:
            present = names[0] in table.columns and names not in self.absent
            if present and is_blank(table, names[0]):
                raise blank_cell(table, names)


def described(calibration: Calibration, names: Iterable[str]) -> dict[str, object]:
    """The statements of a corrected table with results of these names about the calibration and their uncertainties."""
    uncertain = not set(UNCERTAINTIES).isdisjoint(names)
    return {
        "calibration_run": calibration.run,
        "calibration_time": calibration.time,
        "azimuth_out": "magnetic",
        "field_unit": calibration.field_unit,
        **(reading_terms(calibration).stated if uncertain else {}),
        **({"simulated": True} if is_simulated(calibration.tool) else {}),
    }


def stated(metadata: Mapping[str, object], remarks: Iterable[Finding]) -> list[str]:
    """The findings that a table's metadata state already, and others."""
    return [*runs.stated_findings(metadata), *(finding.text for finding in remarks)]


def _column(table: Table, name: str) -> Array:
    """The column as numbers; what they may be is checked with all the rest."""
    column = table.columns[name]
    return as_numbers(table, name) if isinstance(column, list) else column


LARGEST_TEXT = 8_000_000
"""Bytes of text that becomes a workbook, WITSML or LAS: memory is some fifty times as much."""
WHOLE_ROWS = 100_000
"""Rows of a Parquet table that becomes a workbook, WITSML or LAS."""
TEXT = (".csv", ".tsv")
"""Suffixes of text tables."""
WHOLE = (".xlsx", *EXCHANGED)
"""Suffixes of tables that are written as a whole."""


class Applied(msgspec.Struct, frozen=True, kw_only=True):
    """The result for a table: its rows, those without results, and the table that was written.

    `angles`: ranges of inclination and azimuth. `error_terms` are in the standard uncertainties of the table,
    `not_included` are not; both are empty where it has none.
    """

    rows: int
    blank: int
    output: str
    angles: dict[str, correction.AngleRange] = {}
    error_terms: list[str] = []
    not_included: list[str] = []
    findings: list[Finding]


def apply_to_any(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    missing: str,
    said: Said,
    uncertainty: bool,
    advance: Callable[[int, int], None],
) -> tuple[RowCounts, list[Finding], str]:
    """Correct a file into another: part by part, or whole where it is short text or a workbook.

    Counts of the rows, what the reader should know, and the SHA-256 of the readings, empty
    where they were not read as a whole. `advance` gets how much of a long
    table is done, and the whole. An export as the calibration's profile describes it is taken whole, and
    text that comes of it is written as it is. With `uncertainty` columns of standard uncertainties. `said`: as of
    `read_surveys`.
    """
    exported = said.answers or _is_exported(readings, calibration.profile, said.decimal)
    if in_parts(readings, output) and not exported:
        streamed = apply_to_file(
            calibration, readings, output, outside, advance,
            missing=missing, decimal=said.decimal, uncertainty=uncertainty, statements=said.statements,
        )  # fmt: skip
        return *streamed, ""
    if readings.suffix.lower() in TEXT and (exported or output.suffix.lower() in WHOLE):
        _check_size(readings)
    named = read_surveys(readings, calibration, said, WHOLE_ROWS)
    source, profile = named.table, named.calibration.profile
    result, tally, findings = apply_to_table(
        named.calibration, source, outside, missing, uncertainty, named.findings
    )
    if EXTRAPOLATED in result.columns and output.suffix.lower() != ".parquet":
        words = [as_text(bool(mark)) for mark in result.columns[EXTRAPOLATED]]
        result = replace(result, columns={**result.columns, EXTRAPOLATED: words})
    exported = exported and not named.findings
    form = profile.table if exported and readings.suffix.lower() in TEXT else msgspec.UNSET
    tables.write(output, result, None if isinstance(form, msgspec.UnsetType) else form)
    formulas = runs.with_formulas(source.columns) if output.suffix.lower() in TEXT else []
    findings += runs.copied([*source.columns], formulas, output.suffix.lower())
    return tally, findings, source.digest


def _is_exported(readings: Path, profile: Profile, decimal: str) -> bool:
    """Whether a table is written, or names its columns, as the profile says and not as documented."""
    if readings.suffix.lower() in WHOLE or not readings.is_file():
        return True
    opened = streams.open_parquet if readings.suffix.lower() == ".parquet" else streams.open_text
    try:
        names = opened(readings, decimal=decimal).names
    except InputError:
        return True
    return is_export(names, profile) or not set(CHANNELS["accelerometer"]) <= {*names}


def _check_size(readings: Path) -> None:
    """Refuse text that is too long to be taken whole."""
    size = readings.stat().st_size if readings.is_file() else 0
    if size > LARGEST_TEXT:
        raise InputError(
            f"{readings.name}: an export, or a text table that becomes XLSX, WITSML or LAS, must have at most "
            f"{LARGEST_TEXT} bytes; got {size}. Split it, or write CSV."
        )


def apply_to_table(
    calibration: Calibration,
    source: Table,
    outside: str,
    missing: str = "refuse",
    uncertainty: bool = True,
    about: Iterable[Finding] = (),
) -> tuple[Table, RowCounts, list[Finding]]:
    """The input's columns and metadata, the results, and what the calibration was; findings after those `about` it."""
    table = renamed(source, calibration.profile)
    check_columns(list(table.columns), source.source)
    check_warmth(calibration, list(table.columns), source.source)
    whole = np.ones(source.count, bool)
    if missing == "blank":
        whole = ~without_reading(table, wholly_blank([table]))
    if not whole.any():
        raise nothing(source.source)
    kept = chosen(table, whole)
    readings, _ = to_readings(kept, calibration.profile)
    readings = away_from_stand(readings, calibration.profile)
    results, tally, findings = correct_and_count(
        calibration, readings, outside, source.count - kept.count, uncertainty
    )
    findings = [*about, *findings]
    check_free(source.columns, list(results), source.source)
    columns = {name: spread(values, whole) for name, values in results.items()}
    metadata = {**source.metadata, **described(calibration, [*results])}
    if remarks := stated(metadata, findings):
        metadata["findings"] = remarks
    corrected = replace(source, columns={**source.columns, **columns}, metadata=metadata)
    return corrected, tally, findings + unused_columns(readings.unused)
