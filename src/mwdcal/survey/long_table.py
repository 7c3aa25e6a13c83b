"""Surveys of a long table, in memory that does not grow with it: read, computed and written part by part.

Results, findings and refusals are those of `mwdcal.survey.surveying.survey_well`; of several things to refuse that in
the first part is named.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files import streams, synonyms
from mwdcal.files.contract import (
    COLUMNS,
    OPTIONAL,
    REFERENCES,
    blank_cell,
    check_columns,
    is_blank,
    wholly_blank,
)
from mwdcal.files.depths import MEASURED_DEPTHS
from mwdcal.files.formats import atomic, parquet
from mwdcal.files.formats.columns import LABELS, Column, check_names, no_stations
from mwdcal.files.formats.sinks import ParquetSink, SpooledSink
from mwdcal.files.formats.table import Table, labels
from mwdcal.files.runs import check_references, identified, numbered_labels
from mwdcal.files.streams import Part, StreamedTable
from mwdcal.geometry.vectors import Array, ArrayLike
from mwdcal.sensor.profile import Profile, StandProfile
from mwdcal.survey.acceptance import SurveyLimits
from mwdcal.survey.axes import exchanged_axes
from mwdcal.survey.error_model import BUILT_IN, ErrorModel
from mwdcal.survey.path import TieIn
from mwdcal.survey.references import Claim, EarthReference
from mwdcal.survey.stations import horizontal_field, norths_of
from mwdcal.survey.surveying import (
    BY_ROW,
    DECLINATION_COLUMNS,
    SurveyedWell,
    SurveyReadings,
    WellInputs,
    by_row,
    check_free,
    check_path,
    claim,
    depth_column,
    depths,
    described,
    error_model_of,
    judged_constants,
    length_unit_of,
    loaded_limits,
    loaded_reference,
    not_deeper,
    of_another_day,
    of_reference,
    station_readings,
    typical_north,
    with_reference,
    with_section,
    with_stated_unit,
)
from mwdcal.survey.well import LACKING_PATH, Before, Well, WellCounts, part_of_well, with_findings
from mwdcal.use.correction import (
    WINDOW_ROWS,
    RowCounts,
    Scatter,
    joined,
    tallied,
    window_starts,
)
from mwdcal.use.uncertainty import rows_of

LONG_TEXT = 8_000_000
"""Bytes of text from which it is surveyed in parts; of a shorter one memory has room for all."""
LONG_ROWS = 1 << 16
"""Rows of a Parquet table beyond which it is."""
_TEXT_ROWS = 1 << 14
"""Rows of a part of a Parquet table that becomes text."""
_ALSO = (*MEASURED_DEPTHS, *BY_ROW, *LABELS, "simulated")
_DELIMITERS = {".csv": ",", ".tsv": "\t"}


def in_parts(readings: Path, output: Path, profile: Profile) -> bool:
    """Whether a table is surveyed in parts: a long one as documented, that keeps its format or becomes text."""
    unset = msgspec.UnsetType
    if not (isinstance(profile.table, unset) and isinstance(profile.columns, unset)):
        return False
    typed = readings.suffix.lower() == ".parquet"
    if output.suffix.lower() not in (*_DELIMITERS, *([".parquet"] if typed else [])):
        return False
    if not streams.in_parts(readings, LONG_TEXT):
        return False
    return not typed or streams.open_parquet(readings).rows > LONG_ROWS


class _Settings(NamedTuple):
    """How a long table is surveyed."""

    calibration: Calibration
    limits: SurveyLimits
    reference: EarthReference | None
    tie_in: tuple[float, float, float] | TieIn | None
    switch: tuple[float, float]
    outside: str
    model: ErrorModel | None = None
    unit: str = ""
    shown_unit: str = "m"


class _Stations(NamedTuple):
    """The stations of a part, and the columns of the input that go with them."""

    readings: Readings
    md: Array | None
    north: dict[str, Array]
    carried: dict[str, Column | Any]


@dataclass
class _PartsSeen:
    """State after the parts so far."""

    before: Before
    first: Well | None = None
    last: Well | None = None
    depth: float = -np.inf
    simulated: bool = False
    tallies: list[RowCounts] = field(default_factory=list)
    counts: list[WellCounts] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    claims: dict[str, list[Claim]] = field(default_factory=dict)
    serials: dict[str, None] = field(default_factory=dict)


def survey_file(
    calibration: Calibration,
    readings: Path,
    output: Path,
    reference: Path | None,
    limits: str,
    tie_in: tuple[float, float, float] | TieIn | None,
    switch: tuple[float, float],
    outside: str,
    decimal: str,
    digest: str,
    findings: Iterable[Finding],
    error_model: str = BUILT_IN,
    section_azimuth: float = 0.0,
    length_unit: str = "",
) -> SurveyedWell:
    """Survey a long table into another, as `mwdcal.survey.surveying` does with a table in memory.

    `digest` and `findings` are of the file of the calibration.

    Raises:
        InputError: a file that cannot be read, or readings that do not belong to the calibration.
    """
    bounds, limits_digest = loaded_limits(limits)
    place, place_digest = loaded_reference(reference)
    model = error_model_of(error_model)
    settings = _Settings(
        calibration, bounds, place, tie_in, switch, outside, model, *length_unit_of(length_unit)
    )
    long = _LongTable(settings, readings, output, decimal)
    long.north = with_section(long.north, section_azimuth)
    lacking = "" if long.located else LACKING_PATH[False]
    check_path(lacking, tie_in=tie_in, section_azimuth=section_azimuth)
    digests = {"calibration": digest, "readings": sha256_of(readings)}
    with atomic.replacing(output) as stream, closing(long.sink(stream)) as sink:
        for columns in long.columns():
            sink.write(columns)
        digests |= {"reference": place_digest, "limits": limits_digest}
        digests |= {"error_model": model.digest} if model else {}
        result = long.result(digests, findings)
        sink.finish({**long.source.metadata, **described(result.well)})
    return result


class _LongTable:
    """A table that is surveyed in parts.

    Attributes:
        head: the table without rows.
        absent: groups of columns that are blank on all rows.
        depth: the column of measured depths.
        located: whether any station has a measured depth.
    """

    def __init__(self, settings: _Settings, readings: Path, output: Path, decimal: str) -> None:
        self.settings, self.path = settings, readings
        self.delimiter = _DELIMITERS.get(output.suffix.lower(), "")
        self.decimal = decimal
        self.source = self._opened()
        self.head = self._head(self.source)
        first = next((table for table in self._tables() if table.count), None)
        if first is None:
            raise no_stations(self.source.name)
        self.opening = first
        self.absent = wholly_blank([first])
        self.depth, _ = depth_column(self.head, settings.unit)
        self.located = self.depth in MEASURED_DEPTHS and any(
            not is_blank(table, self.depth) for table in self._tables()
        )
        metadata = {**self.source.metadata, **typical_north(self._by_row())}
        self.north = norths_of(
            metadata, self.source.name, self._all_readings, settings.calibration, settings.reference,
            self._horizontal_fields,
        )  # fmt: skip

    def _by_row(self) -> dict[str, Array]:
        """The columns of a declination that varies by row, of the whole table."""
        if not {*DECLINATION_COLUMNS} & {*self.source.names}:
            return {}
        parts = [by_row(table) for table in self._tables()]
        return {n: np.concatenate([each[n] for each in parts]) for n in parts[0]}

    def _opened(self, only: Collection[str] = ()) -> StreamedTable:
        """The table in parts, or some of its columns."""
        if self.path.suffix.lower() == ".parquet":
            rows = _TEXT_ROWS if self.delimiter else 0
            return streams.open_parquet(self.path, rows, self.decimal, _ALSO, only)
        return streams.open_text(self.path, decimal=self.decimal, also=_ALSO, only=only)

    def _horizontal_fields(self) -> list[Array]:
        """Horizontal fields by references, nT; all columns are read where one is refused, for the first fault."""
        only = {REFERENCES[name].column for name in ("field", "dip")}.intersection(
            self.source.names
        )
        if not only:
            return [np.full(1, np.nan)]
        source, profile = self._opened(only), self.settings.calibration.profile
        read = partial(
            check_references, profile=replace_struct(profile, stand=StandProfile()), kinds=[]
        )
        try:
            return [
                source.exactly_if_refused(
                    lambda part: horizontal_field(read(part.table), part.table.count), piece
                )
                for piece in source.pieces()
            ]
        except InputError:
            return [horizontal_field(each.known, each.count) for each in self._all_readings()]

    def _head(self, source: StreamedTable) -> Table:
        """The table without rows; refuses names of columns that surveys cannot have."""
        head = Table({name: [] for name in source.names}, source.metadata, source.name)
        check_names(source.names, source.name)
        check_columns(source.names, source.name)
        if self.settings.calibration.thermal:
            synonyms.check_evidence(source.names, source.name, ("temperature_c",))
        depths(head, self.settings.unit)
        return head

    def _table(self, piece: Any) -> Table:
        return self.source.exactly_if_refused(lambda part: part.table, piece)

    def _tables(self) -> Iterator[Table]:
        return map(self._table, self.source.pieces())

    def _readings(self, piece: Any) -> Readings:
        """The readings of a piece."""
        read = partial(
            station_readings, calibration=self.settings.calibration, recognised=False,
            length_unit=self.settings.unit,
        )  # fmt: skip
        return self.source.exactly_if_refused(lambda part: read(part.table)[0], piece)

    def _all_readings(self) -> Iterator[Readings]:
        filled = (piece for piece in self.source.pieces() if self._table(piece).count)
        yield from map(self._readings, filled)

    def sink(self, stream: IO[bytes]) -> _Sink:
        """An empty table in the format of the output."""
        return _Sink(stream, self.delimiter, self.source.metadata)

    def columns(self) -> Iterator[dict[str, Column | Any]]:
        """The columns of each part, those of the input before the results."""
        self.seen = _PartsSeen(before=Before(path=self.settings.tie_in or (0.0, 0.0, 0.0)))
        for piece in self.source.pieces():
            stations = self.source.exactly_if_refused(self._stations, piece)
            self.seen.rows.append(stations.readings.count if stations else 0)
            if stations:
                yield {**stations.carried, **self._surveyed(stations)}

    def _stations(self, part: Part) -> _Stations | None:
        """The stations of a part; None where it has none."""
        table, seen = part.table, self.seen
        if not table.count:
            return None
        for names in OPTIONAL:
            if names[0] in table.columns and (names in self.absent) != all(
                is_blank(table, name) for name in names
            ):
                raise blank_cell(self.opening if names in self.absent else table, names)
        unlabelled = {name: table.columns[name] for name in table.columns if name != "station"}
        readings, md = station_readings(
            replace(table, columns=unlabelled), self.settings.calibration, False, self.settings.unit
        )
        if md is not None:
            there = np.flatnonzero(~np.isnan(md))
            if md[there[0]] < seen.depth:
                raise not_deeper(table, int(there[0]), md[there[0]], self.settings.unit)
        seen.serials.update(dict.fromkeys(labels(table, "serial")))
        station = numbered_labels(labels(table, "station"), table.count, sum(seen.rows) + 1)
        readings = replace(readings, station=station)
        return _Stations(readings, md, by_row(table), self._carried(part))

    def _carried(self, part: Part) -> dict[str, Column | Any]:
        """The columns of the input as they are written: text as it is, numbers of typed formats as such."""
        cells = dict(zip(part.carried.column_names, part.carried.columns, strict=True))
        if self.path.suffix.lower() != ".parquet":
            return cells
        arrow, _ = parquet.modules(self.source.name)
        return {name: parquet.as_column(name, column, arrow) for name, column in cells.items()}

    def _surveyed(self, stations: _Stations) -> dict[str, Column]:
        """The results of the stations of a part."""
        settings, seen, readings = self.settings, self.seen, stations.readings
        seen.last = None  # one part at a time in memory
        calibration, md = settings.calibration, stations.md
        self._note(readings, md)
        if settings.reference:
            readings = with_reference(readings, settings.reference)
        north = self.north.by_row(stations.north)
        if md is None and self.located:
            md = np.full(readings.count, np.nan)
        well, tally = part_of_well(
            calibration, readings, settings.limits, north, md, seen.before, settings.switch,
            settings.outside, model=settings.model, whole=False,
        )  # fmt: skip
        well = replace(well, length_unit=settings.shown_unit)
        seen.before, seen.last = well.after, well
        seen.tallies.append(tally)
        seen.counts.append(well.counts)
        if seen.first is None:
            check_free(self.head, well.columns)
            seen.first = well
        return {
            name: values if values.dtype.kind == "f" else [str(cell) for cell in values.tolist()]
            for name, values in well.columns.items()
        }

    def _note(self, readings: Readings, md: Array | None) -> None:
        """Keep what the findings say of the whole table."""
        seen = self.seen
        seen.simulated |= readings.metadata.get("simulated") is True
        for name in judged_constants(self.settings.calibration, readings):
            stated = claim(self.source.name, readings, name)
            kept = Claim(stated.source, _short(stated.values), _short(stated.sd))
            seen.claims.setdefault(name, []).append(kept)
        if md is not None:
            seen.depth = float(md[~np.isnan(md)][-1])

    def result(self, digests: dict[str, str], findings: Iterable[Finding]) -> SurveyedWell:
        """The result, when all parts are surveyed; refuses what can be said of all rows alone."""
        settings, seen = self.settings, self.seen
        assert seen.first is not None
        claims = {name: _joined_claims(each) for name, each in seen.claims.items()}
        sources, about = of_reference(claims, self.north, settings.reference, self.source.name)
        if settings.reference is not None:
            about += of_another_day(settings.reference, self.source.metadata)
        marked = {**self.source.metadata, **({"simulated": True} if seen.simulated else {})}
        readings = replace(
            seen.first.readings, metadata=identified(marked, [*seen.serials]),
            unused=synonyms.unused(self.source.names, COLUMNS), run_sha256=digests["readings"],
        )  # fmt: skip
        surveys = SurveyReadings(readings, None, self.north, sources, about, self.depth)
        if not surveys.uses_reference:
            digests.pop("reference", None)
        inputs = WellInputs(
            settings.calibration, self.head, surveys, settings.limits, [*findings, *about], digests,
            settings.model, length_unit=settings.shown_unit,
        )  # fmt: skip
        counts = reduce(WellCounts.followed_by, seen.counts)
        tally = joined(seen.tallies)._replace(scatter=self._scatter(), metadata=readings.metadata)
        first = replace(seen.first, readings=readings, sources=sources)
        first = with_findings(first, tally, counts, settings.outside, settings.tie_in is None)
        exchanged = exchanged_axes(settings.calibration, readings)
        others = with_stated_unit(first.findings, self.depth)
        first = replace(first, findings=[*inputs.findings, *exchanged, *others])
        return SurveyedWell(inputs, first, counts, last=seen.last)

    def _scatter(self) -> dict[str, Scatter]:
        """How strengths and dip scatter in windows over the whole table, whose rows are read once more."""
        ends = np.cumsum(self.seen.rows)
        starts = window_starts(int(ends[-1]))
        wanted = np.concatenate([np.arange(start, start + WINDOW_ROWS) for start in starts])
        parts, places = [], []
        for piece, count, end in zip(self.source.pieces(), self.seen.rows, ends, strict=True):
            rows = wanted[(wanted >= end - count) & (wanted < end)]
            if rows.size:
                parts.append(rows_of(self._readings(piece), rows - (end - count)))
                places.append(rows)
        order = np.empty(len(wanted), int)  # windows overlap, and parts end within them
        order[np.argsort(wanted, kind="stable")] = np.argsort(np.concatenate(places), kind="stable")
        readings = rows_of(_one_after_another(parts), order)
        return dict(tallied(self.settings.calibration, readings, self.settings.outside)[1].scatter)


def _one_after_another(parts: list[Readings]) -> Readings:
    """The readings of parts of a table, without references and labels."""
    first = parts[0]

    def together(arrays: Iterable[Array | None]) -> Array | None:
        present = [array for array in arrays if array is not None]
        return np.concatenate(present) if present else None

    return replace(
        first,
        accelerometer=np.concatenate([part.accelerometer for part in parts]),
        magnetometer=together(part.magnetometer for part in parts),
        temperature=together(part.temperature for part in parts),
        sd={name: np.concatenate([part.sd[name] for part in parts]) for name in first.sd},
    )


def _short(values: ArrayLike) -> Array:
    """Values (n,) in as little memory as they need: one where they are all alike."""
    array = np.asarray(values, float)
    alike = array.size and np.array_equal(array, np.full(array.shape, array[:1]), equal_nan=True)
    return np.broadcast_to(array[:1].copy(), array.shape) if alike else array


def _joined_claims(parts: list[Claim]) -> Claim:
    """The claims of all parts of a table together."""
    values, sd = (np.concatenate([np.asarray(p[i]) for p in parts]) for i in (1, 2))
    return Claim(parts[0].source, values, sd)


class _Sink:
    """Where the columns of each part go: text, or Parquet where there is no delimiter."""

    def __init__(self, stream: IO[bytes], delimiter: str, metadata: Mapping[str, object]) -> None:
        self._stream, self._metadata = stream, metadata
        self._arrow, _ = parquet.modules(stream.name)
        self._text = SpooledSink(stream, delimiter) if delimiter else None
        self._typed: ParquetSink | None = None

    def write(self, columns: Mapping[str, Column | Any]) -> None:
        """Append a part."""
        if self._text:
            self._text.write(columns)
            return
        rows = self._arrow.table(
            {name: parquet.array_of(column, self._arrow) for name, column in columns.items()}
        )
        if self._typed is None:
            none = self._arrow.schema([])
            self._typed = ParquetSink(self._stream, rows.schema, none, self._metadata)
        self._typed.write(rows)

    def finish(self, metadata: Mapping[str, object]) -> None:
        """Write what is known at the end."""
        if self._text:
            self._text.finish(metadata)
        elif self._typed:
            self._typed.finish([], metadata)

    def close(self) -> None:
        """Close the table, finished or not."""
        for sink in (self._text, self._typed):
            if sink:
                sink.close()
