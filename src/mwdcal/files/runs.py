"""A table and a tool profile to `Readings`, and back: every conversion of unit and axis.

Raw channels become nominal g and nT along the tool axes, nominal = P (raw / scale); degrees
become radians; true and grid azimuths become magnetic ones.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from mwdcal.calibration.readings import (
    Readings,
    fingerprints,
    group_numbers,
    is_simulated,
    serial_of,
)
from mwdcal.calibration.record import Finding
from mwdcal.errors import FitError, InputError, QuestionError, UnreadableFileError, shell_word
from mwdcal.estimation.problem import ANGLES, WALKS
from mwdcal.files import synonyms
from mwdcal.files.contract import (
    AZIMUTH_KEYS,
    CHANNELS,
    COLUMN_OF_DAY,
    COLUMNS,
    RANGES,
    RAW,
    REFERENCE_VECTORS,
    REFERENCES,
    Cells,
    Range,
    check_columns,
    columns_of,
    faults,
    faults_beside_readings,
    forms,
    is_blank,
    magnetic_offset,
    of_vectors,
    refuse,
    units_of,
)
from mwdcal.files.contract import BlankReadingError as BlankReadingError
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, Column, looks_numeric, plain_names, shown
from mwdcal.files.formats.table import Table, labels
from mwdcal.files.formats.text import holds_numbers, is_formula
from mwdcal.files.formats.titles import columns_of_a_day
from mwdcal.files.marks import UNMARKED, second_run, without_rejected
from mwdcal.files.repeats import means, repeats
from mwdcal.files.statements import stated_table
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, eigen, quotient
from mwdcal.sensor.profile import ColumnSource, Profile, TableFormat, TriadProfile

if TYPE_CHECKING:
    from mwdcal.files.formats.layout import Layout

# --------------------------------------------------------------------------
# The findings about the columns that were only copied into it.

_RENAMING = (".csv", ".tsv", ".xlsx")
"""Suffixes of formats in which the name of a column is one line of a table."""
NAMED = 10
"""Most columns that a finding names."""


def copied(names: Sequence[str], formulas: Collection[str], suffix: str) -> list[Finding]:
    """Columns that a table of this format has under another name, and those with formulas."""
    plain = plain_names(names) if suffix in _RENAMING else names
    renamed = [
        f"{shown(old)} is {shown(new)}" for old, new in zip(names, plain, strict=True) if old != new
    ]
    findings = []
    if renamed:
        text = f"columns renamed, as the format does not have such names: {_listed(renamed)}."
        findings.append(Finding(id="renamed-columns", text=text))
    if formulas:
        text = (
            "spreadsheet programs may run cells as formulas, which begin with =, +, -, @ or a tab "
            f"and are written as they are: {_listed([shown(n) for n in names if n in formulas])}."
        )
        findings.append(Finding(id="formula-cells", text=text))
    return findings


def _listed(entries: Sequence[str]) -> str:
    more = f" and {len(entries) - NAMED} more" if len(entries) > NAMED else ""
    return ", ".join(entries[:NAMED]) + more


def with_formulas(columns: Mapping[str, Column]) -> list[str]:
    """Columns with a name or a text cell that spreadsheet programs would run as a formula."""
    return [
        name
        for name, cells in columns.items()
        if name not in RANGES
        and (is_formula(name) or (isinstance(cells, list) and any(map(is_formula, cells))))
    ]


def stated_findings(metadata: Mapping[str, object]) -> list[str]:
    """The findings that a table's metadata state already."""
    stated = metadata.get("findings")
    if stated is None:
        return []
    return [str(each) for each in stated] if isinstance(stated, list) else [str(stated)]


ROWS_OF_LOG = 1000
"""Rows of a table with times from which it is a log."""
MOST_ROWS = 1_000_000
"""Rows that a run may have at most, as many as a text table."""
MOST_OTHERS = 20
"""Unused columns of numbers that are kept to see whether they explain the residuals."""
ANGLES_OF_STAND = tuple(REFERENCES[name].column for name in ANGLES)
STATED_REFERENCES = ("gravity", "field", "dip")
"""References that may be the same at all stations, and be stated once."""
LEAST_VARIED = 0.03
"""Readings vary in a direction if their spread there is at least this share of the largest."""
_TURN = 360.0


def read_run(
    source: str | os.PathLike[str] | Table,
    profile: Profile,
    *,
    decimal: str = ".",
    statements: Mapping[str, str] | None = None,
) -> tuple[Readings, Profile]:
    """The readings of a run, a file or a table, and the profile with its nominal scales filled in.

    `statements`: serial, date and operator as the user says.
    """
    if not isinstance(source, Table):
        source = read_export(
            source, profile, decimal=decimal, rows=MOST_ROWS, statements=statements
        )
    return read_stations(station_table(source, profile), profile)


def read_stations(stations: Table, profile: Profile) -> tuple[Readings, Profile]:
    """The readings of the rows of `station_table`, and the profile with its nominal scales filled in."""
    table = renamed(stations, profile)
    check_run(table)
    readings, profile = to_readings(table, profile)
    return replace(readings, others=_other_numbers(table)), profile


def _other_numbers(table: Table) -> dict[str, Array]:
    """The numbers (n,) in columns that are not used and have one at every station."""
    others: dict[str, Array] = {}
    for name in table.columns:
        if name not in (*COLUMNS, *synonyms.OURS) and len(others) < MOST_OTHERS:
            with suppress(InputError):
                values = tables.numbers(table, name)
                others |= {name: values} if np.isfinite(values).all() else {}
    return others


def read_export(
    path: str | os.PathLike[str],
    profile: Profile,
    *,
    decimal: str = ".",
    rows: int = 0,
    statements: Mapping[str, str] | None = None,
) -> Table:
    """The table in a file, written as the profile says or as documented, under its own names.

    `decimal` and `rows` as for `table.read`; a profile that says how tables are written says their
    decimal sign as well. `statements`: serial, date and operator as the user says.
    """
    form = profile.table
    if isinstance(form, msgspec.UnsetType):
        try:
            table = tables.read(path, decimal=decimal, rows=rows)
        except InputError as error:
            raise _undocumented(path, error) from None
    else:
        table = _exported(path, form, profile, decimal, rows)
        if is_export(table.columns, profile):
            table = filled_down(table, form.fill_down)
    return stated_table(table, statements or {}, serial_column(table, profile))


def _undocumented(path: str | os.PathLike[str], error: InputError) -> InputError:
    """Why a file is no run file, if it holds a table of another layout: else the error that it was read with."""
    where = "other tables than a run file"
    try:
        layout = tables.laid_out(path)
        if layout is None or {*CHANNELS["accelerometer"]} <= {*layout.names}:
            return error
        sheet = f"sheet {shown(layout.sheet)}, " if layout.sheet else ""
        word = "row" if layout.sheet else "line"
        where = f"a table with its names in {sheet}{word} {layout.form.header_line}"
    except InputError:
        return error
    except FitError:
        pass
    name = Path(path).name
    return InputError(
        f"{name} holds {where}, not written as a run file is. Propose a tool profile for it first, `mwdcal profile "
        f"{shell_word(name)} -o tool.toml`, and name that by `tool`."
    )


def filled_down(table: Table, names: Collection[str]) -> Table:
    """A table with the cell of the row above in blank cells of some columns; `remarks` of it say in how many."""
    columns, remarks = dict(table.columns), []
    for name in (each for each in table.columns if each in names):
        cells, column = labels(table, name), table.columns[name]
        rows = np.maximum.accumulate([row if cell else 0 for row, cell in enumerate(cells)])
        columns[name] = [column[row] for row in rows] if isinstance(column, list) else column[rows]
        count = sum(not cell for cell in cells)
        remarks += [
            f"{count} of {table.count} rows take {shown(name)} from the row above, as it is written once for a series."
        ] * bool(count)
    return replace(table, columns=columns, remarks=(*table.remarks, *remarks))


def serial_column(table: Table, profile: Profile) -> str:
    """The column of serials in a table."""
    name = sources_of(profile).get("serial", ColumnSource(name="serial")).name
    return name if name in table.columns else "serial"


def _exported(
    path: str | os.PathLike[str], form: TableFormat, profile: Profile, decimal: str, rows: int
) -> Table:
    """The table in a file that is written as a form says, or as documented."""
    if form.find:
        sign = "," if form.decimal == "," else ""
        try:
            where = _laid_out(path, form, channels_of(profile), sign)
        except InputError as error:
            if table := _as_documented(path, decimal, rows):
                return table
            raise _unlike_profile(error) from None
        return of_layout(where, path, profile) if where else tables.read(path)
    try:
        serial = sources_of(profile).get("serial", ColumnSource(name="serial")).name
        table = tables.read(path, rows=rows, export=form, serial=serial)
        if is_export(table.columns, profile):
            return replace(table, units=_units_below_names(path, form, profile))
        problem = _not_as_stated(table, profile)
    except InputError as error:
        problem = error
    if documented := _as_documented(path, decimal, rows):
        return documented
    if moved := _moved(path, form, profile):
        return of_layout(moved, path, profile)
    raise _unlike_profile(problem)


def _as_documented(path: str | os.PathLike[str], decimal: str, rows: int) -> Table | None:
    """The table in a file with the names of a run file; None where it has other names."""
    with suppress(InputError):
        table = tables.read(path, decimal=decimal, rows=rows)
        if set(CHANNELS["accelerometer"]) <= {*table.columns}:
            return table
    return None


def _unlike_profile(problem: InputError) -> InputError:
    """The problem with a table, and what to do where it is another than the profile's."""
    if isinstance(problem, UnreadableFileError):
        return problem
    return InputError(
        f"{problem} If the table is laid out otherwise than the tool profile says, or names its columns otherwise, "
        "rename them, correct [table] and [columns] there, or propose a profile for it: mwdcal profile."
    )


def _laid_out(
    path: str | os.PathLike[str], form: TableFormat, wanted: Sequence[str], decimal: str
) -> Layout | None:
    """Where a file has the table of a profile: of several, the one in the row that the profile states."""
    try:
        return tables.laid_out(path, sheet=form.sheet, wanted=wanted, decimal=decimal)
    except QuestionError:
        if form.header_line == 1:
            raise
    return tables.laid_out(
        path, sheet=form.sheet, header_row=form.header_line, wanted=wanted, decimal=decimal
    )


def _moved(path: str | os.PathLike[str], form: TableFormat, profile: Profile) -> Layout | None:
    """Where a file has the table of a profile, if elsewhere than the profile says."""
    with suppress(InputError, FitError):
        where = tables.laid_out(path, wanted=channels_of(profile))
        if where and (where.number > 0 or not _same_place(where.form, form)):
            return where
    return None


def _same_place(one: TableFormat, other: TableFormat) -> bool:
    """Whether two tables are written alike; the units below the names may be absent."""
    written = ("encoding", "delimiter", "decimal", "header_line", "first_line")
    return all(getattr(one, name) == getattr(other, name) for name in written)


def channels_of(profile: Profile) -> list[str]:
    """The channels by the names of a profile's tables."""
    return [each.name for column, each in sources_of(profile).items() if column in RAW]


def of_layout(where: Layout, path: str | os.PathLike[str], profile: Profile) -> Table:
    """The table of a layout that has the channels of a profile.

    Raises:
        InputError: a column is in another unit than the profile says.
    """
    named = {each.name: column for column, each in sources_of(profile).items()}
    for name, unit in zip(where.names, map(synonyms.unit_of, where.units), strict=True):
        source = sources_of(profile)[named[name]] if name in named else ColumnSource(name=name)
        stated = source.unit
        if unit and stated and unit != source.instead_of and not alike_units(unit, stated):
            raise InputError(
                f"{Path(path).name}: {shown(name)} is in {unit}, by the tool profile in {stated}. Correct "
                "[columns] there, or propose a profile for this table: mwdcal profile."
            )
    return tables.of_layout(where, path, [n for n, column in named.items() if column in LABELS])


def _units_below_names(
    path: str | os.PathLike[str], form: TableFormat, profile: Profile
) -> dict[str, str]:
    """The units of columns in lines below the names.

    Raises:
        InputError: readings in a line that is not read, or units other than the profile's.
    """
    units: dict[str, str] = {}
    if form.first_line == form.header_line + 1:
        return units
    (_, names), *skipped = tables.below_names(path, form) or [(0, [])]
    theirs = {each.name: each.unit for each in sources_of(profile).values() if each.unit}
    wrong = {(each.name, each.instead_of) for each in sources_of(profile).values()}
    for line, cells in skipped:
        where = f"{Path(path).name}, line {line}"
        if holds_numbers(cells):
            raise InputError(
                f"{where}: readings that by first_line = {form.first_line} of the tool profile would not be read."
            )
        for name, unit in zip(names, map(synonyms.unit_of, cells), strict=False):
            if (name.strip(), unit) in wrong:
                continue
            if unit and not alike_units(unit, theirs.get(name.strip(), unit)):
                raise InputError(
                    f"{where}: {shown(name.strip())} is in {unit}, by the tool profile in "
                    f"{theirs[name.strip()]}."
                )
        units |= {n.strip(): cell for n, cell in zip(names, cells, strict=False)}
    return units


def alike_units(written: str, stated: str) -> bool:
    """Whether a unit as it is written may be the one of a profile: G is also Gauss, and ° any sense of an angle."""
    return (
        written == stated
        or stated.startswith(f"{written} ")
        or (written, stated) in (("g", "gauss"), ("°", "°F"), ("°", "°C"))
    )


def sources_of(profile: Profile) -> dict[str, ColumnSource]:
    """The columns that a profile names, by the name of the run file."""
    return {} if isinstance(profile.columns, msgspec.UnsetType) else profile.columns


def is_export(names: Iterable[str], profile: Profile) -> bool:
    """Whether columns of these names are those of the channels that the profile states."""
    stated = {s.name for column, s in sources_of(profile).items() if column in RAW}
    return not stated.isdisjoint(names)


def _not_as_stated(table: Table, profile: Profile) -> InputError:
    stated = [s.name for column, s in sources_of(profile).items() if column in RAW]
    return InputError(
        f"{table.source}: none of the columns {', '.join(map(shown, stated))} that [columns] of the tool "
        f"profile names; found {', '.join(shown(name) for name in [*table.columns][:12])}."
    )


def run_table(table: Table, profile: Profile) -> Table:
    """The stations of a run, as `station_table` has them, under the names and in the units of the run file."""
    run = renamed(station_table(table, profile), profile)
    return replace(run, metadata={**run.north, **run.metadata})


def station_table(table: Table, profile: Profile) -> Table:
    """The rows of a run that its laboratory has not rejected, with one row for each station.

    Its `remarks` say which rows are left out, and of which the means are taken.
    """
    sources = sources_of(profile) if is_export(table.columns, profile) else {}
    named = {each.name: column for column, each in sources.items()}
    used = [n for n in table.columns if named.get(n, n) in UNMARKED]
    _check_names(table, sources)
    table = without_rejected(table, profile.table, used)
    remarks = (*table.remarks, *second_run(table), *_absent_angles(table, sources))
    table = replace(table, remarks=remarks)
    sets = repeats(table, sources)
    if sets is None:
        return table
    if sets.numbered or not (sources or sets.labelled):
        return replace(table, remarks=(*table.remarks, sets.advice()))
    _check_cells(renamed(table, profile), profile)
    scales = {kind: getattr(profile, kind).scale for kind in CHANNELS}
    return replace(means(table, sources, sets), remarks=(*table.remarks, sets.sentence(scales)))


def _check_cells(table: Table, profile: Profile) -> None:
    """Refuse the first cell that a run may not have, by its row; rows of one tool that follow each other are a run."""
    tools = np.array(labels(table, "serial") or [""] * table.count)
    starts = np.r_[0, 1 + np.flatnonzero(tools[1:] != tools[:-1]), table.count]
    refuse(table, faults(columns_of(table), starts, profile))


def _check_names(table: Table, sources: Mapping[str, ColumnSource]) -> None:
    """Refuse a column whose name differs from one of the profile that is absent only in case, separators or unit."""
    named = {each.name for each in sources.values()}
    others = {forms(name)[0]: name for name in table.columns if name not in named}
    for column, each in sources.items():
        theirs = others.get(forms(each.name)[0])
        if each.name not in table.columns and theirs:
            raise InputError(
                f"{table.source}: the tool profile's column {shown(each.name)} ({column}) is not in the table. Did you "
                f"mean {shown(theirs)}? Rename one of them, or correct [columns] in the profile."
            )


def _absent_angles(table: Table, sources: Mapping[str, ColumnSource]) -> list[str]:
    """A sentence on each angle of the stand that the profile names and a table with another of them does not have."""
    angles = {c: sources[c].name for c in ANGLES_OF_STAND if c in sources}
    absent = {c: name for c, name in angles.items() if name not in table.columns}
    if len(absent) == len(angles):
        return []
    others = [name for name in table.columns if name not in {s.name for s in sources.values()}]
    near = {c: difflib.get_close_matches(name, others, n=1) for c, name in absent.items()}
    meant = {c: f" Did you mean {shown(each[0])}?" if each else "" for c, each in near.items()}
    return [
        f"the tool profile's column {shown(name)} ({c}) is not in the table.{meant[c]}"
        for c, name in absent.items()
    ]


def renamed(table: Table, profile: Profile) -> Table:
    """An export under the names and in the units of the run file; a run file as it is.

    Raises:
        InputError: a channel of the profile that the table has not, or a name that is taken.
    """
    ignored = profile.form.ignore
    table = replace(
        table,
        columns={n: c for n, c in table.columns.items() if n not in ignored},
        metadata={n: c for n, c in table.metadata.items() if n not in ignored},
    )
    sources = sources_of(profile)
    if not is_export(table.columns, profile):
        if sources and {*CHANNELS["accelerometer"]}.isdisjoint(table.columns):
            raise _unlike_profile(_not_as_stated(table, profile))
        return _with_stated_references(table)
    theirs = {s.name: column for column, s in sources.items() if s.name in table.columns}
    others = [name for name in table.columns if name not in theirs]
    absent = {s.name: c for c, s in sources.items() if c in RAW and s.name not in table.columns}
    if absent:
        listed = ", ".join(f"{shown(name)} ({column})" for name, column in absent.items())
        raise InputError(
            f"{table.source}: the table has no {'column' if len(absent) == 1 else 'columns'} {listed} of the tool "
            f"profile; its others are {', '.join(map(shown, others[:8])) or 'none'}. Rename them, or correct [columns] "
            "in the profile."
        )
    for column, source in sources.items():
        if column in table.columns and source.name != column and column not in theirs:
            raise InputError(
                f"{table.source}: '{column}' is a column of the table, and {shown(source.name)} is '{column}' by "
                "the tool profile. Correct [columns] in the profile, or name the former under ignore in [table] there."
            )
    columns: dict[str, Column] = {}
    for name, cells in table.columns.items():
        column = theirs.get(name, name)
        columns[column] = cells
        if name in theirs and column not in LABELS:
            unit = (
                sources[column].unit if units_of(column) else ""
            )  # that of a raw channel is a note
            factor, offset = synonyms.FACTORS.get(unit, (1.0, 0.0))
            values = tables.numbers(table, name)
            columns[column] = values * factor + offset if (factor, offset) != (1.0, 0.0) else values
    columns |= {
        column: np.full(table.count, float(sources[column].name))
        for column in stated_numbers({c: s.name for c, s in sources.items()}, table.columns)
    }
    places = {theirs.get(name, name): place for name, place in table.places.items()}
    columns = _with_angles(columns)
    north = profile.form.north
    return _with_stated_references(replace(table, columns=columns, places=places, north=north))


def away_from_stand(readings: Readings, profile: Profile) -> Readings:
    """The readings without what only their tool profile states of its stand's place: north, gravity, field and dip."""
    sources = sources_of(readings.profile or profile)
    stated = stated_numbers({c: each.name for c, each in sources.items()}, readings.table)
    known = dict(readings.known)
    if readings.north:
        known.pop("azimuth", None)
    for name in STATED_REFERENCES:
        column, factor = REFERENCES[name].column, REFERENCES[name].factor
        if column in stated and known.pop(name, None) is not None and column in readings.metadata:
            value = float(str(readings.metadata[column])) * factor
            known[name] = np.full(readings.count, value)
    return replace(readings, known=known, north={})


def stated_numbers(sources: Mapping[str, str], names: Collection[str]) -> dict[str, float]:
    """The references of all stations that are given as a number, in the unit of a run file, instead of a column."""
    columns = (REFERENCES[name].column for name in STATED_REFERENCES)
    return {
        c: float(sources[c])
        for c in columns
        if c in sources and sources[c] not in names and looks_numeric(sources[c])
    }


def _with_angles(columns: dict[str, Column]) -> dict[str, Column]:
    """Angles and strengths instead of the components of gravity and field that the stand states, where it has none."""
    given = of_vectors(columns)
    if not given:
        return columns
    parts = [np.asarray(columns[name], float) for name in REFERENCE_VECTORS if name in columns]
    g = np.stack(parts[:3], -1)
    b = np.stack(parts[3:], -1) if len(parts) == len(RAW) else g
    names = [name for name, each in REFERENCES.items() if each.column in given]
    values = {name: OBSERVABLES[name].value(g, b) for name in names}
    angles = {
        REFERENCES[n].column: v if n in ("gravity", "field") else np.degrees(v)
        for n, v in values.items()
    }
    return angles | {
        name: cells for name, cells in columns.items() if name not in REFERENCE_VECTORS
    }


def _with_stated_references(table: Table) -> Table:
    """The table with the references that its metadata state for all stations, where it has no column of them."""
    columns = dict(table.columns)
    blank = [
        each.column
        for each in REFERENCES.values()
        if each.column in columns and is_blank(table, each.column)
    ]
    stated = stated_references(table.metadata, columns.keys() - blank, table.source)
    columns |= {column: np.full(table.count, value) for column, value in stated.items()}
    return replace(table, columns=columns)


def stated_references(
    metadata: Mapping[str, object], given: Collection[str], source: str
) -> dict[str, float]:
    """The references that metadata state for all stations, by the names of their columns, without those `given`."""
    values: dict[str, float] = {}
    for column in (REFERENCES[name].column for name in STATED_REFERENCES):
        value = metadata.get(column)
        if value is None or column in given:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(
                f"{source}, metadata '{column}': must be a number; got {shown(str(value))}. Write it with a "
                "decimal point and without quotes."
            )
        values[column] = float(value)
    return values


def check_run(table: Table) -> None:
    """Refuse a table of several tools, a continuous log, and references under other names."""
    names = list(table.columns)
    check_columns(names, table.source)
    synonyms.check_evidence(names, table.source)
    tools = serials(table.metadata, labels(table, "serial"))
    if len(tools) > 1:
        raise InputError(
            f"{table.source} has rows of more than one tool (serial {', '.join(tools)}). Take the "
            "rows of one by `serial`, or use mwdcal fleet."
        )
    if table.count > ROWS_OF_LOG and ("time_s" in table.columns or "sampling_hz" in table.metadata):
        raise InputError(
            f"{table.source} is a continuous log ({table.count} rows): its rows are not stations. Find "
            f"the standstills first: mwdcal stations {shell_word(table.source)} -o run.csv. If each row is a "
            "station, remove time_s and sampling_hz."
        )


def _check_serials(table: Table) -> None:
    """Refuse a column of serials that are numbers with decimals: 12.10 and 12.1 are two tools, and one number."""
    column = table.columns.get("serial", [])
    if not isinstance(column, list) and (broken := column[column % 1 > 0]).size:
        raise InputError(
            f"{table.source}, column 'serial': must be text; got the number {broken[0]:g}, whose spelling is lost. "
            "Store serials as text, as in '12.10'."
        )


def serials(metadata: Mapping[str, object], cells: Iterable[str]) -> list[str]:
    """Serials of the tools, that of the metadata first; at most two, then '…' for the rest."""
    known = dict.fromkeys(filter(None, [serial_of(metadata), *cells]))
    return [*[*known][:2], *["…"] * (len(known) > 2)]


def identified(metadata: Mapping[str, object], cells: Sequence[str]) -> Mapping[str, object]:
    """The metadata, with the serials of a column joined to its own, each as it stands."""
    tools = serials(metadata, cells) if cells else []
    return {**metadata, "serial": ", ".join(tools)} if tools else metadata


def _marked(table: Table) -> Mapping[str, object]:
    """The metadata of a table, which is simulated if one of its rows says so in a column of that name."""
    marks = labels(table, "simulated")
    simulated = any(is_simulated({"simulated": mark}) for mark in marks)
    return {**table.metadata, "simulated": True} if simulated else table.metadata


def to_readings(
    table: Table, profile: Profile, recognised: bool = True, proved: bool = False
) -> tuple[Readings, Profile]:
    """The readings of a table, and the profile with its nominal scales filled in.

    Uncertainties of stations and angles that the table leaves blank are the profile's.
    Azimuths are taken as magnetic unless the metadata `azimuth_reference` says otherwise,
    also where the metadata state a declination. Fingerprints of the stations only where they are to be `recognised`.
    Columns and cells that were `proved` before are taken as they are.
    """
    cells = columns_of(table)
    if not proved:
        _check_serials(table)
        check_columns(list(table.columns), table.source)
        refuse(table, faults(cells, np.array([0, table.count]), profile))
    offset = _azimuth_offset(table)
    readings, scales = convert(cells, (table.count,), profile, offset)
    raw = [_stacked(cells, kind) for kind in scales]
    readings = replace(
        readings,
        group=group_numbers(labels(table, "group")),
        station=numbered_labels(labels(table, "station"), table.count),
        digest=fingerprints([channels for channels in raw if channels is not None])
        if recognised
        else (),
        metadata=identified(_marked(table), labels(table, "serial")),
        north=_north(table) if offset or table.north else {},
        source=table.source,
        sheet=table.sheet,
        run_sha256=table.digest,
        unused=synonyms.unused(list(table.columns), {*COLUMNS, *_columns_of_day(table)}),
        remarks=table.remarks,
        self_scaled={
            kind: float(np.squeeze(scale))
            for kind, scale in scales.items()
            if getattr(profile, kind).scale is None
        },
        not_taken={c: line for c, line in table.not_taken.items() if c not in table.columns},
    )
    triads = {
        kind: msgspec.structs.replace(getattr(profile, kind), scale=float(np.squeeze(scale)))
        for kind, scale in scales.items()
    }
    return readings, msgspec.structs.replace(profile, **triads)


def _columns_of_day(table: Table) -> set[str]:
    """The columns that give the day of the run, or agree with it."""
    day = str(table.metadata.get("date", ""))
    dated = columns_of_a_day(table.columns.items()) if day else ()
    return {*COLUMN_OF_DAY.intersection(table.metadata), *(n for n, each in dated if each == day)}


def check_references(table: Table, profile: Profile, kinds: list[str]) -> dict[str, Array]:
    """The references of a table; refuses what `to_readings` refuses in them and in triads `kinds`."""
    cells = columns_of(table)
    starts = np.array([0, table.count])
    refuse(table, faults_beside_readings(cells, starts, profile, kinds))
    return references(cells, _azimuth_offset(table))


def _azimuth_offset(table: Table) -> float:
    """Stated azimuth minus magnetic azimuth, degrees; 0 where no azimuths are stated."""
    stated = REFERENCES["azimuth"].column in table.columns
    source = f"{table.source}, sheet {shown(table.sheet)}" if table.sheet else table.source
    return magnetic_offset({**table.north, **table.metadata}, source) if stated else 0.0


def _north(table: Table) -> dict[str, object]:
    """The north that the azimuths of a table count from, as metadata state it; empty where it is magnetic."""
    azimuths = REFERENCES["azimuth"].column in table.columns
    return north_of({**table.north, **table.metadata}) if azimuths else {}


def north_of(metadata: Mapping[str, object]) -> dict[str, object]:
    """The north that azimuths count from, as metadata state it; empty where it is magnetic."""
    if metadata.get(AZIMUTH_KEYS[0], "magnetic") == "magnetic":
        return {}
    stated = {key: metadata[key] for key in AZIMUTH_KEYS if key in metadata}
    return {key: "true" if value is True else value for key, value in stated.items()}


def convert(
    cells: Cells, shape: tuple[int, ...], profile: Profile, azimuth_offset: float | Array
) -> tuple[Readings, dict[str, float | Array]]:
    """Readings of `shape` (..., n) stations, and the nominal scales (..., 1, 1) of their triads.

    `cells` gives columns of that shape; one that is wholly blank is not there. `azimuth_offset` is
    by what stated azimuths exceed magnetic ones, degrees.
    """
    known = references(cells, azimuth_offset)
    triads: dict[str, Array] = {}
    scales: dict[str, float | Array] = {}
    sd: dict[str, Array] = {}
    for kind in CHANNELS:
        raw = _stacked(cells, kind)
        if raw is None:
            continue
        triad: TriadProfile = getattr(profile, kind)
        scales[kind] = triad.scale or _scale(raw, _strength(known, kind))
        triads[kind] = to_nominal(raw, triad, scales[kind])
        noise = reading_noise(cells, kind, triad, shape, scales[kind])
        if noise is not None:
            sd[kind] = noise
    common = {n: np.full(shape, np.radians(v)) for n, v in profile.stand.common().items()}
    common |= _drifts(profile, scales, shape)
    readings = Readings(
        accelerometer=triads["accelerometer"],
        magnetometer=triads.get("magnetometer"),
        temperature=_given(cells, "temperature_c"),
        known=known,
        sd=sd | _reference_uncertainties(cells, shape, profile, known) | common,
        settings=profile.stand.practice,
    )
    return readings, scales


def _drifts(
    profile: Profile, scales: Mapping[str, float | Array], shape: tuple[int, ...]
) -> dict[str, Array]:
    """Declared drifts (..., n) within a run, g and nT, by name of `WALKS`."""
    sizes = [np.abs(getattr(profile, k).drift / np.asarray(s)) for k, s in scales.items()]
    sizes = [np.reshape(size, (*np.shape(size)[:-2], 1)) for size in sizes]
    field = [np.array(profile.stand.field_drift_nt)] if len(scales) > 1 else []
    each = zip(WALKS, [*sizes, *field], strict=False)
    return {name: np.broadcast_to(size, shape) for name, size in each if size.any()}


def _given(cells: Cells, name: str) -> Array | None:
    """A column that is not wholly blank."""
    values = cells(name)
    return None if values is None or np.isnan(values).all() else values


def _or_blank(values: Array | None, shape: tuple[int, ...]) -> Array:
    """A column, of blank cells where it is not there."""
    return np.full(shape, np.nan) if values is None else values


def _stacked(cells: Cells, kind: str) -> Array | None:
    """Raw readings of a triad (..., n, 3) in channel order; None where it was not read."""
    channels = [_given(cells, name) for name in CHANNELS[kind]]
    present = [values for values in channels if values is not None]
    return np.stack(present, -1) if len(present) == len(channels) else None


def references(cells: Cells, azimuth_offset: float | Array) -> dict[str, Array]:
    """Reference values (..., n) by name, in radians, g and nT, azimuths magnetic."""
    known = {}
    for name, reference in REFERENCES.items():
        values = _given(cells, reference.column)
        if values is None:
            continue
        if name == "azimuth":
            values = values - azimuth_offset
        if name in ("azimuth", "toolface"):
            values = _turned(values)
        known[name] = values * reference.factor
    return known


def _turned(angle: Array) -> Array:
    """The angle in 0..360 degrees; those already there keep every digit."""
    outside = (angle < 0.0) | (angle >= _TURN)
    return np.where(outside, np.mod(angle, _TURN), angle) if outside.any() else angle


def to_nominal(raw: Array, triad: TriadProfile, scale: float | Array | None = None) -> Array:
    """Nominal field along the tool axes (..., 3) of raw channels; `scale` if not the profile's."""
    return (raw / (triad.scale or 1.0 if scale is None else scale)) @ triad.permutation.transpose()


def _strength(known: Mapping[str, Array], kind: str) -> Array:
    """Mean strength (...) of the field that a triad measures, 1 where it is not known."""
    if kind == "accelerometer":
        gravity = known.get("gravity", np.ones(1))
        return np.asarray(np.where(np.isnan(gravity), 1.0, gravity).mean(-1))
    field = known.get("field", np.ones(1))
    return np.asarray(np.nansum(field, -1) / np.maximum((~np.isnan(field)).sum(-1), 1))


def _scale(raw: Array, strength: Array) -> Array:
    """Nominal scale (..., 1, 1) of raw readings (..., n, 3) of a field of this strength (...).

    Definition: median distance from the centre of the sphere nearest to the readings, over the strength; in directions
    in which they hardly vary the centre is their mean.
    Singular: where nothing moves (a single station) it is the distance from zero; readings that are
    all zero count as one: whether the channels are alive is decided where they are fitted.
    """
    centred = raw - raw.mean(-2, keepdims=True)
    size = np.abs(centred).max((-2, -1))[..., None, None]
    unit = quotient(centred, size, size > 0)
    count, square = raw.shape[-2], np.sum(unit**2, -1)
    values, vectors = eigen(np.einsum("...ni,...nj->...ij", unit, unit) / count)
    pull = np.einsum("...ni,...n,...ij->...j", unit, square, vectors) / count
    along = quotient(pull / 2, values, values > LEAST_VARIED**2 * values[..., -1:])
    beyond = unit - np.einsum("...ij,...j->...i", vectors, along)[..., None, :]
    radius = np.median(np.linalg.norm(beyond, axis=-1), -1) * size[..., 0, 0]
    still = np.median(np.linalg.norm(raw, axis=-1), -1)
    radius = np.where(radius > 0, radius, np.where(still > 0, still, 1.0))
    return np.asarray(radius / strength)[..., None, None]


def reading_noise(
    cells: Cells, kind: str, triad: TriadProfile, shape: tuple[int, ...], scale: float | Array
) -> Array | None:
    """Standard uncertainty (..., n, 3) of readings along the tool axes, nominal; None where nothing is stated."""
    noise = _noise(cells, kind, triad, shape)
    return None if noise is None else (noise / scale) @ np.abs(triad.permutation.transpose())


def _noise(cells: Cells, kind: str, triad: TriadProfile, shape: tuple[int, ...]) -> Array | None:
    """Standard uncertainty (..., n, 3) of raw readings; None where nothing is stated."""
    noise = np.stack([_or_blank(cells(f"sd_{name}"), shape) for name in CHANNELS[kind]], -1)
    if triad.noise is not None:
        noise = np.where(np.isnan(noise), triad.noise, noise)
    return None if np.isnan(noise).all() else np.hypot(noise, triad.repeatability)


def _reference_uncertainties(
    cells: Cells, shape: tuple[int, ...], profile: Profile, known: Iterable[str]
) -> dict[str, Array]:
    """Standard uncertainties (..., n) of references: the table's, else the stand's; zero ones left out."""
    columns = {name: cells(f"sd_{REFERENCES[name].column}") for name in (*known, "gravity")}
    sd = {n: _reference_uncertainty(profile, n, _or_blank(c, shape)) for n, c in columns.items()}
    return {name: values for name, values in sd.items() if values.any()}


def _reference_uncertainty(profile: Profile, name: str, stated: Array) -> Array:
    """Standard uncertainty of a reference: as `stated`, the stand's where that is NaN.

    With the repeatability of the stand added. Units inside.
    """
    factor, quantity = REFERENCES[name].factor, _quantity(name)
    sd = np.where(np.isnan(stated), profile.stand.of(quantity), stated)
    return np.hypot(sd, profile.stand.repeatability(quantity)) * factor


def from_readings(
    readings: Readings, profile: Profile, metadata: Mapping[str, object] | None = None
) -> Table:
    """The table of a run of one tool: raw channels and degrees, the inverse of `to_readings`.

    Uncertainties that the profile would fill in on reading are left to it. Without
    `metadata` it is that of the readings.
    """
    metadata = {**readings.north, **(readings.metadata if metadata is None else metadata)}
    source = readings.source or "run"
    offset = magnetic_offset(metadata, source) if "azimuth" in readings.known else 0.0
    columns: dict[str, Column] = {"station": list(readings.labels)}
    if readings.group is not None:
        columns["group"] = ["" if g < 0 else str(g) for g in readings.group.tolist()]
    if readings.temperature is not None:
        columns["temperature_c"] = np.asarray(readings.temperature, float)
    for kind in CHANNELS:
        columns |= _raw_columns(readings, profile, kind)
    for name in REFERENCES:
        columns |= _reference_columns(readings, profile, name, offset)
    return Table(columns, dict(metadata), source, range(1, readings.count + 1))


def _quantity(name: str) -> str:
    """A reference with its unit, as in `azimuth_deg`."""
    return REFERENCES[name].column.removeprefix("ref_")


def numbered_labels(given: Sequence[str], count: int, first: int = 1) -> tuple[str, ...]:
    """Labels of `count` stations, as given or numbered; a blank one is the number of its row, counted from `first`."""
    if not given:
        return tuple(map(str, range(first, first + count)))
    return (
        tuple(given)
        if all(given)
        else tuple(label or str(i) for i, label in enumerate(given, first))
    )


def _raw_columns(readings: Readings, profile: Profile, kind: str) -> dict[str, Column]:
    """The three channels of a triad, and their noise where the profile does not state it."""
    nominal = getattr(readings, kind)
    if nominal is None:
        return {}
    triad = getattr(profile, kind)
    scale = triad.scale or 1.0
    raw = nominal @ triad.permutation * scale
    columns: dict[str, Column] = dict(zip(CHANNELS[kind], raw.T, strict=True))
    if kind in readings.sd:
        total = readings.sd[kind] @ np.abs(triad.permutation) * scale
        if triad.noise is None or not np.allclose(
            total, np.hypot(triad.noise, triad.repeatability), rtol=1e-12, atol=0.0
        ):
            noise = np.sqrt(np.maximum(total**2 - triad.repeatability**2, 0.0))
            names = (f"sd_{name}" for name in CHANNELS[kind])
            columns |= dict(zip(names, np.broadcast_to(noise, raw.shape).T, strict=True))
    return columns


def _reference_columns(
    readings: Readings, profile: Profile, name: str, offset: float
) -> dict[str, Column]:
    """A reference and its uncertainty, where the profile does not state the same one."""
    reference = REFERENCES[name]
    columns: dict[str, Column] = {}
    if name in readings.known:
        known = np.broadcast_to(readings.known[name], (readings.count,))
        values = known / reference.factor + (offset if name == "azimuth" else 0.0)
        columns[reference.column] = (
            _turned(values) if name == "azimuth" else _trimmed(values, reference.values)
        )
    if name in readings.sd and (columns or name == "gravity"):
        sd = readings.uncertainty(name)
        usual = _reference_uncertainty(profile, name, np.array(np.nan))
        if not np.allclose(sd, usual, rtol=1e-12, atol=0.0):
            repeated = profile.stand.repeatability(_quantity(name))
            variance = (sd / reference.factor) ** 2 - repeated**2
            columns[f"sd_{reference.column}"] = np.sqrt(np.maximum(variance, 0.0))
    return columns


def _trimmed(values: Array, limits: Range) -> Array:
    """The values without what rounding carried over the ends of the accepted range."""
    inside = np.clip(values, limits.low, limits.high)
    return np.where(np.isclose(values, inside, rtol=0.0, atol=1e-9), inside, values)
