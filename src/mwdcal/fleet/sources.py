"""The input of a fleet: a table or a folder of tables and run files, and what they state about their rows.

Names of folders (`serial=MWD-17`) state a column of the rows below them. The metadata of a file
hold for its own rows: which north their azimuths count from becomes a column of the table. A run
file that cannot be read is a tool with one row, which says why.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import msgspec
import numpy as np

from mwdcal.calibration.readings import is_simulated
from mwdcal.errors import InputError, MwdcalError, QuestionError
from mwdcal.files import contract, runs, synonyms
from mwdcal.files.contract import REFERENCES, magnetic_offset
from mwdcal.files.formats import parquet
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.atomic import visible_files
from mwdcal.files.formats.columns import LABELS, check_names, shown
from mwdcal.files.formats.table import SUFFIXES, Table, check_file, labels
from mwdcal.files.statements import rows_of
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import Profile

# --------------------------------------------------------------------------
# Run files of a fleet: CSV, TSV and XLSX as `mwdcal calibrate` reads them, with the serial of each.
#
# A file holds the run of one tool, or those of many, told apart by a column `serial`. Which tool one
# run belongs to says its metadata, else its column `serial`, else its folder (`serial=…`) or its name.

SERIAL = "serial"
RUN_FILE = "#file"
"""Column of the path of the run file that a row comes from."""
_LABEL = "station"
FAULT = "#fault"
"""Column of what is wrong with a run file that cannot be read: it has one row."""


def read(path: Path, profile: Profile) -> Table:
    """The rows of a run file that its laboratory has not rejected, under the names of the run file's columns."""
    return runs.run_table(runs.read_export(path, profile, rows=runs.MOST_ROWS), profile)


def serials(table: Table, otherwise: str) -> list[str]:
    """The serials of a table: many of its column, or one; `otherwise` where it states none.

    Raises:
        InputError: the metadata name another tool than the column, or a row of many tools names none.
    """
    stated = _stated(table)
    cells = labels(table, SERIAL)
    named = list(dict.fromkeys(filter(None, cells)))
    if stated and named and named != [stated.strip()]:
        raise InputError(
            f"{table.source}: the metadata state the serial {shown(stated)}, the column '{SERIAL}' "
            f"{', '.join(map(shown, named[:2]))}{' …' if len(named) > 2 else ''}. Correct one of them."
        )
    if len(named) > 1 and "" in cells:
        problem = "must be filled in; got a blank cell. Say which tool the station belongs to."
        raise tables.cell_error(table, SERIAL, cells.index(""), problem)
    if not stated and not named:
        _check_near_misses(table)
    return named or [stated or otherwise]


def _check_near_misses(table: Table) -> None:
    """Refuse a table that seems to tell several tools apart by a column of another name."""
    for name in table.columns:
        if synonyms.resembled(name) == (SERIAL, "") and len(set(labels(table, name)) - {""}) > 1:
            raise InputError(
                f"{table.source}: the column {shown(name)} names several tools. Rename it to '{SERIAL}', or name it "
                "under [columns] of the tool profile."
            )


def run_of(table: Table, serial: str) -> Table:
    """The run of one tool, which states its serial; refuses what is not a run."""
    cells = labels(table, SERIAL)
    if len(set(filter(None, cells))) > 1:
        rows = [row for row, cell in enumerate(cells) if cell == serial]
        table = replace(rows_of(table, rows), source=f"{SERIAL} {serial} of {table.source}")
    runs.check_run(table)
    return replace(table, metadata={**table.metadata, SERIAL: _stated(table) or serial})


def _stated(table: Table) -> str:
    """The serial in the metadata of a table, or empty."""
    stated = table.metadata.get(SERIAL)
    return "" if stated is None or not str(stated).strip() else str(stated)


def numbers(table: Table, name: str) -> Array:
    """A column as numbers, NaN where blank; infinite where a cell is not a number.

    That is out of every range: its tool is refused, in the words of its run.
    """
    try:
        return tables.numbers(table, name)
    except InputError:
        return np.array([_number(table, name, row) for row in range(table.count)])


def _number(table: Table, name: str, row: int) -> float:
    cells = table.columns[name][row : row + 1]
    try:
        return float(tables.numbers(replace(table, columns={name: cells}), name)[0])
    except InputError:
        return np.inf


OFFSET = "#offset"
"""Column of stated azimuth minus magnetic azimuth, °; there where a file's metadata say so."""
AZIMUTH = REFERENCES["azimuth"].column
BLANK = ("", "__HIVE_DEFAULT_PARTITION__")
"""How folder names spell a blank cell."""
LARGEST_GROUP = 20_000_000
"""Rows of the largest row group that is read; it is dealt as a whole."""
PARQUET = ".parquet"
NAMES_SHOWN = 3
"""Most files that a note names."""

Keys = tuple[tuple[str, str | float | None], ...]
Stamp = tuple[int, int, int]
"""Size of a file, and when its content and its place or rights last changed, ns."""
DEALT: Stamp = (0, 0, 0)
"""Stamp of files that the fleet itself has written."""


@dataclass(frozen=True)
class Piece:
    """One row group of a Parquet file, or a run file.

    `keys` are the columns that its folders and its metadata state. `text`: its serials are
    taken as text, because those of some file are. `profile`: that by which a run file is read, as
    JSON; empty for Parquet tables.
    """

    path: str
    stamp: Stamp
    group: int
    rows: int
    keys: Keys
    text: bool = False
    profile: str = ""


@dataclass(frozen=True)
class FleetTable:
    """A fleet's table: its pieces, columns, the metadata of all its files, and what to mention."""

    name: str
    pieces: tuple[Piece, ...]
    columns: tuple[str, ...]
    metadata: dict[str, object]
    notes: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """Number of stations of all tools."""
        return sum(piece.rows for piece in self.pieces)

    @property
    def stations(self) -> int:
        """The same without the rows of files that cannot be read."""
        return sum(piece.rows for piece in self.pieces if FAULT not in dict(piece.keys))

    @property
    def used(self) -> tuple[str, ...]:
        """The columns that a run has, and the serial."""
        known = (*contract.COLUMNS, *contract.COLUMN_OF_DAY, SERIAL, OFFSET, RUN_FILE, FAULT)
        return tuple(name for name in self.columns if name in known)

    @property
    def fingerprint(self) -> str:
        """What changes when a file of the table does."""
        parts = [(Path(p.path).name, p.stamp, p.group, p.rows, p.keys) for p in self.pieces]
        return hashlib.sha256(msgspec.json.encode([parts, self.metadata])).hexdigest()


@dataclass(frozen=True)
class _File:
    """What one file says: `text` of its serials, `offset` of its azimuths, `remarks` on rows that are left out."""

    pieces: list[Piece]
    columns: tuple[str, ...]
    metadata: dict[str, object]
    text: bool
    offset: float
    remarks: tuple[str, ...] = ()


def open_source(
    path: Path, profile: Profile, progress: Callable[[str], None] = lambda text: None
) -> FleetTable:
    """The table at `path`, its columns checked; refuses what is not a table of many tools.

    Run files are read by the `profile`.
    """
    paths, others = input_files(path)
    of_runs = {file for file in paths if file.suffix.lower() != PARQUET or _has_repeats(file)}
    mixed, files = bool(of_runs), []
    for count, file in enumerate(paths, 1):
        is_run = file in of_runs
        files.append(_described(file, path, profile, is_run) if mixed else _look(file, path))
        progress(f"file {count} of {len(paths)} read")
    if not mixed:
        _check_same_columns(path, paths, files)
        _check_columns(files[0].columns, path.name)
    elif not path.is_dir() and (fault := dict(files[0].pieces[0].keys).get(FAULT)):
        raise InputError(str(fault))
    notes = [*(_left_alone(others) if mixed else []), *(r for each in files for r in each.remarks)]
    source = _joined(path.name, files, notes)
    if source.rows == 0:
        raise InputError(f"{path.name}: the table has no rows. Add one row per station.")
    largest = max(piece.rows for piece in source.pieces)
    if largest > LARGEST_GROUP:
        raise InputError(
            f"{path.name}: a row group must have at most {LARGEST_GROUP} rows; got {largest}. Write "
            "the table again with row groups of about a million rows (`row_group_size`)."
        )
    return source


def _check_same_columns(path: Path, paths: Sequence[Path], files: Sequence[_File]) -> None:
    """Refuse Parquet files of which some have columns that others lack."""
    for file, described in zip(paths, files, strict=True):
        if odd := sorted(set(described.columns) ^ set(files[0].columns)):
            raise InputError(
                f"{file}: all files of '{path.name}' must have the same columns; '{odd[0]}' is in some "
                f"and not in others ({paths[0].name} …). Write the table again."
            )


def _joined(name: str, files: Sequence[_File], notes: list[str]) -> FleetTable:
    """The table of all files: each with its own azimuths, and serials of one kind."""
    columns, pieces = [*dict.fromkeys(name for file in files for name in file.columns)], []
    text, offsets = any(file.text for file in files), sorted({file.offset for file in files})
    for file in files:
        stated: Keys = ((OFFSET, file.offset),) if any(offsets) else ()
        pieces += [replace(p, keys=(*p.keys, *stated), text=text) for p in file.pieces]
    if any(offsets):
        columns.append(OFFSET)
    if len(offsets) > 1:
        notes.append(
            f"azimuths count from {len(offsets)} norths, {offsets[0]:g}° to {offsets[-1]:g}° from "
            "magnetic: each file's metadata hold for its own rows."
        )
    metadata = _agreed([file.metadata for file in files if FAULT not in file.columns])
    return FleetTable(name, tuple(pieces), tuple(columns), metadata, tuple(notes))


def _left_alone(others: Sequence[Path]) -> list[str]:
    """What to say of files in a folder that are not tables."""
    if not others:
        return []
    more = " …" if len(others) > NAMES_SHOWN else ""
    names = ", ".join(file.name for file in others[:NAMES_SHOWN]) + more
    kinds = f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
    return [f"files left alone, as their names do not end in {kinds}: {len(others)} ({names})."]


def _agreed(stated: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Metadata on which all files agree; a fleet is simulated if one file is."""
    first = next(iter(stated), {})
    agreed = {k: v for k, v in first.items() if all(k in s and s[k] == v for s in stated)}
    return agreed | next(({"simulated": s["simulated"]} for s in stated if is_simulated(s)), {})


def input_files(path: Path) -> tuple[list[Path], list[Path]]:
    """The tables and run files at a path, itself or all in a folder, by name; and the other files there."""
    if not path.is_dir():
        check_file(path)
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(
                f"'{path}': a fleet is read from a file whose name ends in {', '.join(SUFFIXES)}, or a folder "
                f"of such; got '{path.suffix or 'no suffix'}'. Convert the table, with a column '{SERIAL}'."
            )
        return [path], []
    visible = visible_files(path)
    paths = [file for file in visible if file.suffix.lower() in SUFFIXES]
    for file in paths:
        if str(file) != str(file).encode("utf-8", "ignore").decode():
            raise InputError(f"{str(file)!r}: a name must be valid UTF-8. Rename the file.")
    if not paths:
        raise InputError(
            f"'{path}' is a folder without files that end in {', '.join(SUFFIXES)}. Name a table, or a "
            "folder of run files."
        )
    return paths, [file for file in visible if file.suffix.lower() not in SUFFIXES]


def _described(file: Path, root: Path, profile: Profile, is_run: bool) -> _File:
    """One file of a folder with run files, which this one `is_run` or not; what is wrong with it is data."""
    if is_run:
        return _look_at_runs(file, root, profile)
    try:
        table = _look(file, root)
        if SERIAL not in table.columns:
            return _look_at_runs(file, root, profile)
        _check_columns(table.columns, file.name)
    except InputError as error:
        return _refused(file, file.stem, error)
    return table


def _has_repeats(file: Path) -> bool:
    """Whether rows of a Parquet file that follow each other have one tool and label: it is read as a run file is.

    A file or column that cannot be read is refused where it is looked at for its rows, and not here.
    """
    arrow, pq = parquet.modules(str(file))
    import pyarrow.compute as compute

    with (
        suppress(InputError, arrow.ArrowException),
        parquet.reading(str(file)),
        pq.ParquetFile(file) as opened,
    ):
        names = {*opened.schema_arrow.names}
        if not {_LABEL, "ax"} <= names or opened.metadata.num_rows > runs.MOST_ROWS:
            return False
        same = True
        for column in opened.read([_LABEL, *{SERIAL} & names]).combine_chunks().columns:
            column.validate(full=True)
            cells = column.cast(cell_type(column.type))
            same = compute.and_(same, compute.equal(cells[1:], cells[:-1]))
            if arrow.types.is_string(cells.type) or arrow.types.is_large_string(cells.type):
                same = compute.and_(same, compute.not_equal(cells[1:], ""))
        return compute.any(same).as_py() is True
    return False


def _look_at_runs(file: Path, root: Path, profile: Profile) -> _File:
    """The run of a tool, or those of many, in one file."""
    stamp, serial = _stamp(file), dict(_keys(file, root)).get(SERIAL) or file.stem
    try:
        table = read(file, profile)
        stated = serials(table, str(serial))
        serial = stated[0] if len(stated) == 1 else serial
        run_of(table, stated[0])
        north = AZIMUTH in table.columns
        offset = magnetic_offset(table.metadata, table.source) if north else 0.0
    except (InputError, QuestionError) as error:
        return _refused(file, str(serial), error)
    keys: Keys = ((RUN_FILE, str(file.resolve())),)
    if len(stated) == 1:
        keys = (*keys, (SERIAL, serial))
    known = msgspec.json.encode(profile).decode()
    piece = Piece(str(file.resolve()), stamp, 0, table.count, keys, profile=known)
    columns = tuple(dict.fromkeys((*table.columns, *dict(keys))))
    remarks = tuple(f"{file.name}: {remark}" for remark in table.remarks)
    return _File([piece], columns, dict(table.metadata), True, offset, remarks)


def _refused(file: Path, serial: str, error: MwdcalError) -> _File:
    """A file that cannot be read as a tool with one row."""
    path = str(file.resolve())
    keys: Keys = ((RUN_FILE, path), (SERIAL, serial), (FAULT, str(error)))
    return _File([Piece(path, _stamp(file), 0, 1, keys)], tuple(dict(keys)), {}, True, 0.0)


def _look(file: Path, root: Path) -> _File:
    """Pieces, columns and metadata of one file."""
    arrow, pq = parquet.modules(str(file))
    stamp = _stamp(file)
    with parquet.reading(str(file)), pq.ParquetFile(file) as opened:
        schema, keys = opened.schema_arrow, _keys(file, root)
        check_names(schema.names, str(file))
        for field in sorted(schema, key=lambda each: (each.name in LABELS, each.name)):
            _check_type(field.type, field.name, file)
        columns = dict.fromkeys((*schema.names, *dict(keys)))
        names = tuple(n for n in columns if not n.startswith("__index"))
        whole = {each.name for each in schema if arrow.types.is_integer(cell_type(each.type))}
        metadata = parquet.metadata_of(schema.metadata, str(file))
        pieces = pieces_of(file, stamp, opened.metadata, keys)
    offset = magnetic_offset(metadata, str(file)) if AZIMUTH in names else 0.0
    return _File(pieces, names, metadata, SERIAL in dict(keys) or SERIAL not in whole, offset)


def cell_type(kind: Any) -> Any:
    """The type of a column's cells, whether they are encoded or not."""
    arrow, _ = parquet.modules("fleet")
    return kind.value_type if arrow.types.is_dictionary(kind) else kind


def pieces_of(file: Path, stamp: Stamp, about: Any, keys: Keys) -> list[Piece]:
    """The row groups of a file with the given Parquet metadata."""
    return [
        Piece(str(file.resolve()), stamp, group, about.row_group(group).num_rows, keys)
        for group in range(about.num_row_groups)
    ]


def _stamp(file: Path) -> Stamp:
    """What tells a file from what it was, or from another in its place."""
    try:
        status = file.stat()
    except OSError:
        return (0, 0, 0)
    return (status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def check_unchanged(pieces: Iterable[Piece]) -> None:
    """Refuse an input that is not what it was when it was opened."""
    for path, stamp in {piece.path: piece.stamp for piece in pieces}.items():
        if stamp != DEALT and _stamp(Path(path)) != stamp:
            raise InputError(
                f"'{path}': the file has changed while its tools were calibrated, and nothing was "
                "written. Run the same command again when the file is complete."
            )


def _keys(file: Path, root: Path) -> Keys:
    """The columns that the names of a file's folders state, below the folder of the table."""
    folders = file.relative_to(root).parent.parts if root.is_dir() else ()
    keys: dict[str, str | float | None] = {}
    for folder in folders:
        name, equals, value = (unquote(part) for part in folder.partition("="))
        if not equals:
            continue
        keys[name] = None if value in BLANK else value
        if name == SERIAL and value in BLANK:
            raise InputError(
                f"{file.parent}, column '{SERIAL}': must be filled in; the folder '{folder}' stands for "
                "a blank cell. Say which tool these stations belong to."
            )
        if name in contract.RANGES and value not in BLANK:
            try:
                keys[name] = float(value)
            except ValueError:
                raise InputError(
                    f"{file.parent}, column '{name}': expected a number; the folder says '{value}'. Rename it."
                ) from None
    return tuple(keys.items())


def _check_type(kind: Any, name: str, file: Path) -> None:
    """Refuse text where numbers belong, labels that are no text, numbers or times, and odd serials."""
    types = parquet.modules(str(file))[0].types
    advice = "Write it as text."
    if name in contract.RANGES:
        numbers = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
        fine, expected = any(test(kind) for test in numbers), "expected numbers"
        advice = (
            "Write it as numbers, with empty cells where a value is unknown: with pandas, "
            f"table['{name}'] = pandas.to_numeric(table['{name}'])."
        )
    elif name == SERIAL:
        kind, texts = cell_type(kind), (types.is_string, types.is_large_string, types.is_integer)
        fine, expected = any(test(kind) for test in texts), "must be text or whole numbers"
    else:
        kind = cell_type(kind)
        fine = name not in LABELS or not types.is_nested(kind)
        expected = "must be text, numbers or times"
    if not fine:
        raise InputError(
            f"{file.name}, column '{name}': {expected}; the column has the type {kind}. {advice}"
        )


def _check_columns(names: Sequence[str], source: str) -> None:
    """Refuse a table that does not tell its tools apart, or lacks the channels."""
    if SERIAL not in names:
        near = [n for n in names if synonyms.resembled(n) == (SERIAL, "")]
        hint = f" Is it '{near[0]}'? Rename it." if near else " Add it."
        raise InputError(
            f"{source}: a fleet needs the column '{SERIAL}', which tells its tools apart; found "
            f"{', '.join(repr(n) for n in names[:20])}.{hint}"
        )
    contract.check_columns(list(names), source)
    synonyms.check_evidence(names, source)
