"""Tables of many tools: which rows belong to which tool, and partitions of whole tools.

A fleet is one Parquet file, or a folder of them (also `name=value` folders). One pass over
the serial column finds the tools; memory holds their serials, never the readings. Where the
rows of a tool are not together, the rows are dealt once into files of whole tools.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import msgspec
import numpy as np

from mwdcal.core.vectors import Ints
from mwdcal.errors import InputError
from mwdcal.files import contract, parquet

SERIAL = "serial"
TOOL = "#tool"
"""Column of dealt rows: number of the tool, in order of first appearance."""
LABELS = ("station", "group", SERIAL)
ROWS = (6_000, 100_000)
"""Fewest and most rows of a partition that is not a single tool…"""
SHARES = 32
"""…and into how many a fleet between these is divided."""
LARGEST_GROUP = 20_000_000
"""Rows of the largest row group that is read; it is dealt as a whole."""
BATCH = 32_768
"""Rows that are read at once."""
MOST_STRETCHES = 50_000_000
"""Most stretches of rows of one tool in a table."""
MOST_FILES = 200
"""Files of dealt rows that are written at once."""


@dataclass(frozen=True)
class Piece:
    """One row group of a Parquet file, with the values that its folder names state."""

    path: str
    stamp: tuple[int, int]
    group: int
    rows: int
    keys: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Partition:
    """Whole tools: `rows` rows of some pieces after the first `skip`.

    `first` is the number of the first row in the whole table; `dealt` says that the rows are
    not in order of tools.
    """

    pieces: tuple[Piece, ...]
    skip: int
    rows: int
    first: int
    tools: int
    dealt: bool = False


@dataclass(frozen=True)
class Source:
    """A fleet's table: its pieces, columns and metadata."""

    name: str
    pieces: tuple[Piece, ...]
    columns: tuple[str, ...]
    metadata: dict[str, object]

    @property
    def rows(self) -> int:
        """Number of stations of all tools."""
        return sum(piece.rows for piece in self.pieces)

    @property
    def used(self) -> tuple[str, ...]:
        """The columns that a run has, and the serial."""
        return tuple(n for n in self.columns if n in contract.COLUMNS or n == SERIAL)

    @property
    def fingerprint(self) -> str:
        """What changes when a file of the table does."""
        parts = [(Path(p.path).name, p.stamp, p.group, p.rows, p.keys) for p in self.pieces]
        return hashlib.sha256(msgspec.json.encode([parts, self.metadata])).hexdigest()


def open_source(path: Path) -> Source:
    """The table at `path`, its columns checked; refuses what is no table of many tools."""
    files = _files(path)
    pieces: list[Piece] = []
    columns: tuple[str, ...] = ()
    metadata: dict[str, object] = {}
    for file in files:
        own, names, described = _look(file, path)
        if columns and set(names) != set(columns):
            odd = sorted(set(names) ^ set(columns))[0]
            raise InputError(
                f"{file}: all files of '{path.name}' must have the same columns; '{odd}' is in some "
                f"and not in others ({files[0].name} …). Write the table again."
            )
        columns, metadata = columns or names, metadata or described
        pieces += own
    _check_columns(columns, path.name)
    source = Source(path.name, tuple(pieces), columns, metadata)
    if source.rows == 0:
        raise InputError(f"{path.name}: the table has no rows. Add one row per station.")
    largest = max(piece.rows for piece in pieces)
    if largest > LARGEST_GROUP:
        raise InputError(
            f"{path.name}: a row group must have at most {LARGEST_GROUP} rows; got {largest}. Write "
            "the table again with row groups of about a million rows (`row_group_size`)."
        )
    return source


def _files(path: Path) -> list[Path]:
    """The Parquet files of a table: itself, or all in a folder, in order of their names."""
    if path.is_dir():
        hidden = ("_", ".")
        found = sorted(
            file
            for file in path.rglob("*.parquet")
            if not any(part.startswith(hidden) for part in file.relative_to(path).parts)
        )
        if not found:
            raise InputError(f"'{path}' is a folder without .parquet files. Name a Parquet table.")
        return found
    if not path.exists():
        raise InputError(f"'{path}': no such file. Check the name and the folder.")
    if path.suffix.lower() != ".parquet":
        raise InputError(
            f"'{path}': a fleet is read from a Parquet file or a folder of them; got "
            f"'{path.suffix or 'no suffix'}'. Convert the table, with a column 'serial'."
        )
    return [path]


def _look(file: Path, root: Path) -> tuple[list[Piece], tuple[str, ...], dict[str, object]]:
    """Pieces, columns and metadata of one file."""
    _, pq = parquet.modules(str(file))
    try:
        opened = pq.ParquetFile(file)
    except Exception as error:
        raise parquet.unreadable(str(file), error) from error
    with opened:
        schema, about = opened.schema_arrow, opened.metadata
        folders = file.relative_to(root).parent.parts if root.is_dir() else ()
        keys = tuple((n, v) for n, eq, v in (part.partition("=") for part in folders) if eq)
        names = tuple(n for n in (*schema.names, *dict(keys)) if not n.startswith("__index"))
        contract_columns = set(contract.COLUMNS) - set(LABELS)
        for name in contract_columns.intersection(schema.names):
            _check_numeric(schema.field(name).type, name, file)
        status = file.stat()
        stamp = (status.st_size, status.st_mtime_ns)
        pieces = [
            Piece(str(file.resolve()), stamp, group, about.row_group(group).num_rows, keys)
            for group in range(about.num_row_groups)
        ]
        return pieces, names, parquet.metadata_of(schema.metadata, str(file))


def _check_numeric(kind: Any, name: str, file: Path) -> None:
    """Refuse a column of text where numbers belong."""
    arrow, _ = parquet.modules(str(file))
    types = arrow.types
    fine = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
    if not any(test(kind) for test in fine):
        raise InputError(
            f"{file.name}, column '{name}': expected numbers; the column has the type {kind}. "
            "Write it as numbers, with empty cells where a value is unknown."
        )


def _check_columns(names: Sequence[str], source: str) -> None:
    """Refuse a table that does not tell its tools apart, or lacks the channels."""
    if SERIAL not in names:
        near = [n for n in names if n.strip().lower().replace("_", " ") in _NEAR]
        hint = f" Is it '{near[0]}'? Rename it." if near else " Add it."
        raise InputError(
            f"{source}: a fleet needs the column '{SERIAL}', which tells its tools apart; found "
            f"{', '.join(repr(n) for n in names[:20])}.{hint}"
        )
    contract.check_columns(list(names), source)


_NEAR = (
    "sn",
    "serial no",
    "serial number",
    "serialno",
    "serialnumber",
    "serial",
    "tool",
    "tool id",
)


@dataclass(frozen=True)
class Tools:
    """The `count` tools of a table, in order of first appearance.

    `runs` are the first rows (r,) of stretches of one tool, `tool` (r,) whose each is.
    """

    count: int
    runs: Ints
    tool: Ints

    @property
    def together(self) -> bool:
        """Whether the rows of every tool are next to each other."""
        return len(self.runs) == self.count


def find_tools(source: Source) -> Tools:
    """One pass over the serials."""
    arrow, _ = parquet.modules(source.name)
    starts: list[Ints] = []
    heads: list[Any] = []
    row, last = 0, None
    for values in _serials(source):
        codes = values.indices.to_numpy(zero_copy_only=False)
        change = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
        if values[0].as_py() == last:
            change = change[1:]
        starts.append(change + row)
        indices = arrow.array(codes[change], values.indices.type)
        heads.append(arrow.DictionaryArray.from_arrays(indices, values.dictionary))
        row, last = row + len(codes), values[-1].as_py()
        _check_stretches(sum(map(len, starts)), source.name)
    every = one_chunk(arrow.chunked_array(heads))
    codes = every.indices.to_numpy(zero_copy_only=False)
    used, first, number = np.unique(codes, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    return Tools(len(used), np.concatenate(starts), rank[number])


def one_chunk(column: Any) -> Any:
    """A dictionary-encoded column as one array."""
    joined = column.unify_dictionaries().combine_chunks()
    return joined.chunk(0) if hasattr(joined, "chunks") else joined


def _check_stretches(count: int, source: str) -> None:
    """Refuse rows so mixed that to remember where the tools are would fill the memory."""
    if count > MOST_STRETCHES:
        raise InputError(
            f"{source}: the rows change from tool to tool more than {MOST_STRETCHES} times. Sort the "
            f"table by '{SERIAL}'."
        )


def _serials(source: Source) -> Iterator[Any]:
    """The serial column, in dictionary-encoded stretches; whole numbers stay numbers."""
    arrow, pq = parquet.modules(source.name)
    row = 0
    for piece in source.pieces:
        stated = dict(piece.keys).get(SERIAL)
        if stated is not None:
            if piece.rows:
                yield (
                    arrow.array([stated])
                    .dictionary_encode()
                    .take(arrow.array(np.zeros(piece.rows, int)))
                )
            row += piece.rows
            continue
        with pq.ParquetFile(piece.path, read_dictionary=[SERIAL]) as file:
            for batch in file.iter_batches(500_000, row_groups=[piece.group], columns=[SERIAL]):
                column = _encoded(batch.column(0), source.name)
                if column.null_count:
                    blank = row + int(
                        np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0]
                    )
                    raise InputError(
                        f"{source.name}, row {blank + 1}, column '{SERIAL}': must be filled in; got a "
                        "blank cell. Say which tool the station belongs to."
                    )
                row += len(column)
                if len(column):
                    yield column


def _encoded(column: Any, source: str) -> Any:
    """Serials, 64-bit whole numbers or text, as a dictionary and the place of each in it."""
    arrow, _ = parquet.modules(source)
    types = arrow.types
    kind = column.type.value_type if types.is_dictionary(column.type) else column.type
    if types.is_integer(kind):
        plain = arrow.int64()
    elif types.is_string(kind) or types.is_large_string(kind):
        plain = arrow.string()
    else:
        raise InputError(
            f"{source}, column '{SERIAL}': must be text or whole numbers; the column has the type "
            f"{kind}. Write it as text."
        )
    if kind == column.type:
        return column.cast(plain).dictionary_encode()
    encoded = arrow.dictionary(arrow.int32(), plain)
    return column if column.type == encoded else column.cast(encoded)


def partitions(source: Source, tools: Tools, folder: Path) -> list[Partition]:
    """The table in partitions of whole tools; dealt into files in `folder` where it must be."""
    size = int(np.clip(source.rows // SHARES, *ROWS))
    if not tools.together:
        return _dealt(source, tools, folder, size)
    ends = np.append(tools.runs[1:], source.rows)
    cuts = _cuts(ends, size)
    found, before = [], 0
    for cut in cuts:
        first = int(tools.runs[before])
        found.append(_part(source, first, int(ends[cut]), cut + 1 - before))
        before = cut + 1
    return found


def _cuts(ends: Ints, size: int) -> list[int]:
    """Last tool of each partition: as soon as `size` rows are full."""
    last = np.searchsorted(ends, np.arange(size, int(ends[-1]) + size, size))
    return sorted({min(int(i), len(ends) - 1) for i in last} | {len(ends) - 1})


def _part(source: Source, first: int, stop: int, tools: int) -> Partition:
    """The partition of rows `first` to `stop`."""
    bounds = np.cumsum([0, *(piece.rows for piece in source.pieces)])
    low = int(np.searchsorted(bounds, first, "right")) - 1
    high = int(np.searchsorted(bounds, stop, "left"))
    return Partition(source.pieces[low:high], first - int(bounds[low]), stop - first, first, tools)


def _dealt(source: Source, tools: Tools, folder: Path, size: int) -> list[Partition]:
    """Rows dealt into files by tool; done once, whatever interrupts it."""
    rows = np.bincount(tools.tool, np.diff(tools.runs, append=source.rows), tools.count)
    share = max(size, -(-source.rows // MOST_FILES))
    number = np.cumsum(rows).astype(int) // share
    number = np.minimum(number, MOST_FILES - 1)
    done = folder / f"sorted-{source.fingerprint[:16]}"
    if not done.is_dir():
        unfinished = done.with_suffix(".tmp")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        _deal(source, tools, number, unfinished)
        unfinished.rename(done)
    found = []
    for each in np.unique(number):
        file = done / f"{each:04d}.parquet"
        pieces, _, _ = _look(file, file)
        total = sum(piece.rows for piece in pieces)
        count = int(np.sum(number == each))
        stamped = tuple(
            Piece(p.path, (0, 0), p.group, p.rows, (("", source.fingerprint),)) for p in pieces
        )
        found.append(Partition(stamped, 0, total, 0, count, dealt=True))
    return found


def _deal(source: Source, tools: Tools, number: Ints, folder: Path) -> None:
    """Write the rows of every piece into the file of their tool."""
    arrow, pq = parquet.modules(source.name)
    writers: dict[int, Any] = {}
    row = 0
    try:
        for piece in filter(lambda p: p.rows, source.pieces):
            table = arrow.concat_tables(_batches(piece, source.used)).unify_dictionaries()
            rows = np.arange(row, row + piece.rows)
            tool = tools.tool[np.searchsorted(tools.runs, rows, "right") - 1]
            table = table.append_column(TOOL, arrow.array(tool))
            table = table.append_column("#row", arrow.array(rows))
            own = number[tool]
            order = np.argsort(own, kind="stable")
            sorted_own = own[order]
            table = table.take(arrow.array(order))
            bounds = np.flatnonzero(np.diff(sorted_own, prepend=-1))
            for start, stop in zip(bounds, [*bounds[1:], len(own)], strict=True):
                key = int(sorted_own[start])
                if key not in writers:
                    path = folder / f"{key:04d}.parquet"
                    writers[key] = pq.ParquetWriter(path, table.schema, compression="lz4")
                writers[key].write_table(table.slice(start, stop - start))
            row += piece.rows
    finally:
        for writer in writers.values():
            writer.close()


def read(partition: Partition, columns: Sequence[str]) -> Any:
    """The rows of a partition as an Arrow table, in order of tools, with their row numbers."""
    arrow, _ = parquet.modules("fleet")
    names = (*columns, TOOL, "#row") if partition.dealt else tuple(columns)
    tables, start, rows = [], partition.skip, partition.rows
    for piece in partition.pieces:
        stop = min(piece.rows, start + rows)
        tables += _rows(piece, names, start, stop) if stop > start else []
        start, rows = 0, rows - (stop - start)
    table = arrow.concat_tables(tables, promote_options="permissive").unify_dictionaries()
    if not partition.dealt:
        numbers = np.arange(partition.first, partition.first + partition.rows)
        return table.append_column("#row", arrow.array(numbers))
    order = np.argsort(table.column(TOOL).to_numpy(), kind="stable")
    return table.take(arrow.array(order)).drop_columns([TOOL])


@dataclass
class _Reading:
    """A row group that is being read: `held` is the batch of rows that has come, `row` its first."""

    batches: Iterator[Any]
    held: Any
    row: int = 0

    def rows(self, start: int, stop: int) -> list[Any]:
        """The rows `start` to `stop`, in stretches; those before are passed over."""
        found = []
        while True:
            end = self.row + len(self.held)
            if end > start:
                first = max(start - self.row, 0)
                found.append(self.held.slice(first, min(stop, end) - self.row - first))
            if end >= stop:
                return found
            self.row, self.held = end, next(self.batches)


_ONE_AT_A_TIME = Lock()


def _rows(piece: Piece, columns: tuple[str, ...], start: int, stop: int) -> list[Any]:
    """Rows of a row group; partitions next to each other go on where the last one ended."""
    with _ONE_AT_A_TIME:
        try:
            if _reading(piece, columns).row > start:
                _reading.cache_clear()
            return _reading(piece, columns).rows(start, stop)
        except Exception:
            _reading.cache_clear()
            raise


@lru_cache(maxsize=1)
def _reading(piece: Piece, columns: tuple[str, ...]) -> _Reading:
    batches = _batches(piece, columns)
    return _Reading(batches, next(batches))


def _batches(piece: Piece, columns: tuple[str, ...]) -> Iterator[Any]:
    """The rows of a row group in tables, with the values that its folder names state."""
    arrow, pq = parquet.modules(piece.path)
    keys = dict(piece.keys)
    wanted = [name for name in columns if name not in keys]
    labels = [name for name in LABELS if name in wanted]
    try:
        with pq.ParquetFile(piece.path, memory_map=True, read_dictionary=labels) as file:
            for batch in file.iter_batches(BATCH, [piece.group], wanted):
                yield _complete(arrow.Table.from_batches([batch]), piece, columns)
    except FileNotFoundError:
        raise InputError(
            f"'{piece.path}': no such file on this machine. Workers on other machines must see "
            "the table, and the folder of the output, under the same paths."
        ) from None
    except OSError as error:
        raise parquet.unreadable(piece.path, error) from error


def _complete(table: Any, piece: Piece, columns: tuple[str, ...]) -> Any:
    """Rows with the columns of their folder's names, and the serials encoded."""
    arrow, _ = parquet.modules(piece.path)
    keys = dict(piece.keys)
    for name in columns:
        if name in keys:
            value = arrow.array([keys[name]]).take(arrow.array(np.zeros(len(table), int)))
            table = table.append_column(name, value)
    place = table.column_names.index(SERIAL)
    table = table.set_column(place, SERIAL, _encoded(table.column(SERIAL), piece.path))
    return table.select(list(columns))
