"""Tables of many tools: which rows belong to which tool, and partitions of whole tools.

One pass over the serial column finds the tools; memory holds their serials, never the readings.
Where the rows of a tool are not together, the rows are dealt once into files of whole tools.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import msgspec
import numpy as np

from mwdcal.errors import InputError, reason
from mwdcal.files.contract import COLUMN_OF_DAY, RANGES
from mwdcal.files.formats import atomic, parquet
from mwdcal.files.formats.columns import LABELS
from mwdcal.files.formats.table import labels
from mwdcal.fleet import kept, sources
from mwdcal.fleet.sources import (
    DEALT,
    FAULT,
    OFFSET,
    RUN_FILE,
    SERIAL,
    FleetTable,
    Piece,
    cell_type,
    check_unchanged,
    pieces_of,
)
from mwdcal.geometry.vectors import Ints
from mwdcal.sensor.profile import Profile

TEXTS = (*LABELS, *COLUMN_OF_DAY, RUN_FILE, FAULT)
"""Columns of text."""
TOOL = "#tool"
"""Column of dealt rows: number of the tool, in order of first appearance."""
ROW = "#row"
"""Column of the number of a row in the whole table."""
PARTITION_ROWS = (6_000, 100_000)
"""Fewest and most rows of a partition that is not a single tool: memory grows with them."""
ENOUGH_ROWS = 24_000
"""Rows from which what a partition costs by itself, some 60 ms, is little…"""
SHARES = (4, 16)
"""…and into how many a fleet is divided: below these rows, and above."""
BATCH = 32_768
"""Rows that are read at once…"""
SERIALS = 500_000
"""…and serials."""
MOST_STRETCHES = 50_000_000
"""Most stretches of rows of one tool in a table."""
MOST_FILES = 200
"""Files of dealt rows that are written at once."""


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
class Tools:
    """The `count` tools of a table, in order of first appearance.

    `runs` are the first rows (r,) of stretches of one tool, `tool` (r,) the tool of each.
    """

    count: int
    runs: Ints
    tool: Ints

    @property
    def together(self) -> bool:
        """Whether the rows of every tool are next to each other."""
        return len(self.runs) == self.count


def find_tools(source: FleetTable) -> Tools:
    """One pass over the serials."""
    arrow, _ = parquet.modules(source.name)
    starts: list[Ints] = []
    heads: list[Any] = []
    row, last = 0, None
    with parquet.reading(source.name):
        for values in _serials(source):
            codes = values.indices.to_numpy(zero_copy_only=False)
            change = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
            if values[0].as_py() == last:
                change = change[1:]
            starts.append(change + row)
            indices = arrow.array(codes[change], values.indices.type)
            heads.append(arrow.DictionaryArray.from_arrays(indices, values.dictionary))
            row, last = row + len(codes), values[-1].as_py()
            if sum(map(len, starts)) > MOST_STRETCHES:
                raise InputError(
                    f"{source.name}: the rows change from tool to tool more than {MOST_STRETCHES} times. "
                    f"Sort the table by '{SERIAL}'."
                )
    serials = one_chunk(arrow.chunked_array(heads))
    codes = serials.indices.to_numpy(zero_copy_only=False)
    used, first, number = np.unique(codes, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return Tools(len(used), np.concatenate(starts), rank[number])


def one_chunk(column: Any) -> Any:
    """A dictionary-encoded column as one array."""
    return column.unify_dictionaries().combine_chunks()


def in_several_folders(source: FleetTable, tools: Tools) -> list[str]:
    """What to say of tools with rows in folders that state different values of a column."""
    numbers: dict[Any, int] = {}
    stated = [
        tuple(k for k in p.keys if k[0] not in (SERIAL, OFFSET, RUN_FILE, FAULT))
        for p in source.pieces
    ]
    folder = np.array([numbers.setdefault(keys, len(numbers)) for keys in stated])
    if len(numbers) == 1:
        return []
    ends = np.cumsum([piece.rows for piece in source.pieces])
    last = np.append(tools.runs[1:], source.rows) - 1
    places = folder[np.searchsorted(ends, [tools.runs, last], "right")]
    pairs = np.unique(tools.tool * len(numbers) + places)
    count = int(np.sum(np.bincount(pairs // len(numbers)) > 1))
    if not count:
        return []
    return [
        f"tools with rows in several folders: {count}. All rows of a serial are one run; where they are "
        "runs of their own, calibrate folder by folder."
    ]


def _serials(source: FleetTable) -> Iterator[Any]:
    """The serial column, in dictionary-encoded stretches; whole numbers stay numbers."""
    arrow, _ = parquet.modules(source.name)
    row = 0
    for piece in filter(lambda p: p.rows, source.pieces):
        stated = dict(piece.keys).get(SERIAL)
        if stated is None:
            tables = _batches(piece, (SERIAL,), SERIALS)
        else:
            label = arrow.DictionaryArray.from_arrays(np.zeros(piece.rows, np.int32), [stated])
            tables = iter([arrow.table({SERIAL: label})])
        for table in tables:
            column = one_chunk(table.column(SERIAL))
            _check_filled(column, row, source.name)
            row += len(column)
            yield column


def _check_filled(serials: Any, row: int, source: str) -> None:
    """Refuse the first blank of dictionary-encoded serials; `row` is the number of their first."""
    values = serials.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    blank = values < 0
    if parquet.modules(source)[0].types.is_string(serials.dictionary.type):
        blank |= values == serials.dictionary.index("").as_py()
    if blank.any():
        raise InputError(
            f"{source}, row {row + int(np.argmax(blank)) + 1}, column '{SERIAL}': must be filled in; got "
            "a blank cell. Say which tool the station belongs to."
        )


def _encoded(column: Any, piece: Piece) -> Any:
    """Serials, 64-bit whole numbers or text, as a dictionary and the place of each in it."""
    arrow, _ = parquet.modules(piece.path)
    kind = cell_type(column.type)
    if piece.text or not arrow.types.is_integer(kind):
        return _texts(column, piece, SERIAL)
    try:
        return column.cast(kind).cast(arrow.int64()).dictionary_encode()
    except arrow.ArrowInvalid as error:
        raise InputError(
            f"{Path(piece.path).name}, column '{SERIAL}': must be text or whole numbers of 64 bits ({error}). "
            "Write it as text."
        ) from error


def _texts(column: Any, piece: Piece, name: str) -> Any:
    """A column of labels as text, as a dictionary and the place of each in it; refuses broken UTF-8."""
    arrow, _ = parquet.modules("fleet")
    try:
        if column.type != arrow.dictionary(arrow.int32(), arrow.string()):
            column = one_chunk(column.cast(cell_type(column.type)).dictionary_encode())
            texts = arrow.array(parquet.texts(column.dictionary, arrow), arrow.string())
            return arrow.DictionaryArray.from_arrays(column.indices, texts)
        for chunk in column.chunks:
            chunk.dictionary.validate(full=True)
        return column
    except Exception as error:
        raise InputError(
            f"{Path(piece.path).name}, column '{name}': expected labels that can be written as text; the "
            f"column has the type {cell_type(column.type)} ({str(error)[:80]}). Write it as text."
        ) from error


def _partition_rows(rows: int) -> int:
    """Rows of a partition of a table; whatever the workers are, so that others go on with what is done.

    >>> [_partition_rows(1000 * rows) for rows in (10, 48, 192, 960, 9600)]
    [6000, 12000, 24000, 60000, 100000]
    """
    few, many = (rows // share for share in SHARES)
    return int(np.clip(max(min(few, ENOUGH_ROWS), many), *PARTITION_ROWS))


def partitions(
    source: FleetTable, tools: Tools, folder: Path, say: Callable[[str], None]
) -> list[Partition]:
    """The table in partitions of whole tools; dealt into files in `folder` where it must be."""
    size = _partition_rows(source.rows)
    if not tools.together:
        return _dealt(source, tools, folder, size, say)
    ends = np.append(tools.runs[1:], source.rows)
    full = np.searchsorted(ends, np.arange(size, source.rows, size))
    last = np.unique(np.append(full, tools.count - 1))
    counts = np.diff(last, prepend=-1).tolist()
    bounds = np.cumsum([0, *(piece.rows for piece in source.pieces)])
    parts = []
    for (first, stop), count in zip(pairwise([0, *ends[last].tolist()]), counts, strict=True):
        low = int(np.searchsorted(bounds, first, "right")) - 1
        pieces = source.pieces[low : int(np.searchsorted(bounds, stop, "left"))]
        parts.append(Partition(pieces, first - int(bounds[low]), stop - first, first, count))
    return parts


def _dealt(
    source: FleetTable, tools: Tools, folder: Path, size: int, say: Callable[[str], None]
) -> list[Partition]:
    """Rows dealt into files by tool; what an interrupted command has finished is not done again."""
    _, pq = parquet.modules(source.name)
    sizes = np.bincount(tools.tool, np.diff(tools.runs, append=source.rows), tools.count)
    share = max(size, -(-source.rows // MOST_FILES))
    number = np.minimum(np.cumsum(sizes).astype(int) // share, MOST_FILES - 1)
    done = folder / f"sorted-{source.fingerprint[:16]}"
    if not kept.is_whole(done):
        again = ", again: those there are damaged" if done.exists() else ""
        say(f"the rows of a tool are not together: dealing them into files of whole tools{again}")
        kept.make_room(done)
        with _whole_folder(done) as unfinished:
            _deal(source, tools, number, unfinished)
            check_unchanged(source.pieces)
    parts = []
    for each, count in zip(*np.unique(number, return_counts=True), strict=True):
        file = done / f"{each:04d}.parquet"
        pieces = pieces_of(file, DEALT, pq.read_metadata(file), (("", source.fingerprint),))
        rows = sum(piece.rows for piece in pieces)
        parts.append(Partition(tuple(pieces), 0, rows, 0, int(count), dealt=True))
    return parts


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill, which has its name and a manifest when the block ends without an error."""
    unfinished = folder.with_suffix(".tmp")
    kept.make_room(unfinished)
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        kept.write_manifest(unfinished)
        atomic.rename(unfinished, folder)
    except OSError as error:
        raise InputError(
            f"cannot write to '{folder.parent}': {reason(error)}. Make room there, or choose another "
            "`output`."
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _deal(source: FleetTable, tools: Tools, number: Ints, folder: Path) -> None:
    """Write the rows of every piece into the file of their tool."""
    arrow, pq = parquet.modules(source.name)
    writers: dict[int, Any] = {}
    row = 0
    with ExitStack() as stack:
        for piece in filter(lambda p: p.rows, source.pieces):
            table = arrow.concat_tables(_batches(piece, source.used)).unify_dictionaries()
            rows = np.arange(row, row + piece.rows)
            tool = tools.tool[np.searchsorted(tools.runs, rows, "right") - 1]
            table = table.append_column(TOOL, arrow.array(tool))
            table = table.append_column(ROW, arrow.array(rows))
            target = number[tool]
            for file in np.unique(target).tolist():
                if file not in writers:
                    path = folder / f"{file:04d}.parquet"
                    writer = pq.ParquetWriter(path, table.schema, compression="lz4")
                    writers[file] = stack.enter_context(writer)
                writers[file].write_table(table.filter(arrow.array(target == file)))
            row += piece.rows


def read(partition: Partition, columns: Sequence[str]) -> Any:
    """The rows of a partition as an Arrow table, in order of tools, with their row numbers."""
    arrow, _ = parquet.modules("fleet")
    names = (*columns, TOOL, ROW) if partition.dealt else tuple(columns)
    tables, start, rows = [], partition.skip, partition.rows
    for piece in partition.pieces:
        stop = min(piece.rows, start + rows)
        tables += _rows(piece, names, start, stop) if stop > start else []
        start, rows = 0, rows - (stop - start)
    table = arrow.concat_tables(tables, promote_options="permissive").unify_dictionaries()
    if partition.dealt:
        return table.sort_by(TOOL).drop_columns([TOOL])
    numbers = np.arange(partition.first, partition.first + partition.rows)
    return table.append_column(ROW, arrow.array(numbers))


@dataclass
class _Reading:
    """A row group that is being read: `held` is the batch of rows that has come, `row` its first."""

    batches: Iterator[Any]
    held: Any = ()
    row: int = 0

    def rows(self, start: int, stop: int) -> list[Any]:
        """The rows `start` to `stop`, in stretches; those before are passed over."""
        stretches = []
        while True:
            end = self.row + len(self.held)
            if end > start:
                first = max(start - self.row, 0)
                stretches.append(self.held.slice(first, min(stop, end) - self.row - first))
            if end >= stop:
                return stretches
            self.row, self.held = end, next(self.batches)


_ONE_AT_A_TIME = Lock()


def _rows(piece: Piece, columns: tuple[str, ...], start: int, stop: int) -> list[Any]:
    """Rows of a row group; the next partition continues where the last one ended."""
    with _ONE_AT_A_TIME:
        try:
            if _reading(piece, columns).row > start:
                _reading.cache_clear()
            return _reading(piece, columns).rows(start, stop)
        except Exception:
            _reading.cache_clear()
            raise


def close_rows() -> None:
    """Close the file that rows were last read from."""
    with _ONE_AT_A_TIME:
        _reading.cache_clear()


@lru_cache(maxsize=1)
def _reading(piece: Piece, columns: tuple[str, ...]) -> _Reading:
    return _Reading(_batches(piece, columns))


def _batches(piece: Piece, columns: tuple[str, ...], size: int = 0) -> Iterator[Any]:
    """The rows of a piece in tables, with the values that its folder names state."""
    if not Path(piece.path).exists():
        raise InputError(
            f"'{piece.path}': no such file on this machine. Workers on other machines must see "
            "the table, and the folder of the output, under the same paths."
        )
    keys = dict(piece.keys)
    wanted = [name for name in columns if name not in keys]
    if RUN_FILE in keys:
        yield _complete(_run_rows(piece, wanted), piece, columns)
        return
    arrow, pq = parquet.modules(piece.path)
    present = pq.read_schema(piece.path).names if RUN_FILE in columns else wanted
    encoded = [name for name in TEXTS if name in wanted and name in present]
    with (
        parquet.reading(piece.path),
        pq.ParquetFile(piece.path, read_dictionary=encoded) as file,
    ):
        for batch in file.iter_batches(size or BATCH, [piece.group], wanted):
            yield _complete(arrow.Table.from_batches([batch]), piece, columns)


def _run_rows(piece: Piece, wanted: Sequence[str]) -> Any:
    """The columns of a run file that a run has; one row without any where it cannot be read."""
    arrow, _ = parquet.modules(piece.path)
    if not piece.profile:
        return arrow.table({"": arrow.nulls(piece.rows)})
    profile = msgspec.json.decode(piece.profile, type=Profile)
    table = sources.read(Path(piece.path), profile)
    names = [name for name in wanted if name in table.columns]
    columns = {
        name: arrow.array(sources.numbers(table, name), from_pandas=True)
        if name in RANGES
        else arrow.array(labels(table, name), arrow.string())
        for name in names
    }
    return arrow.table({"": arrow.nulls(table.count), **columns})


def _complete(table: Any, piece: Piece, columns: tuple[str, ...]) -> Any:
    """Rows with the columns that their piece states: labels as text, encoded, the rest as numbers.

    A column that the file lacks is blank.
    """
    arrow, _ = parquet.modules(piece.path)
    stated = dict(piece.keys)
    arrays = {}
    for name in columns:
        if name in stated or name not in table.column_names:
            kind = arrow.string() if name in TEXTS else arrow.float64()
            cells = arrow.repeat(arrow.scalar(stated.get(name), kind), len(table))
            table = table.append_column(name, cells)
        column = table.column(name)
        if name == SERIAL:
            column = _encoded(column, piece)
        elif name in TEXTS:
            column = _texts(column, piece, name)
        elif name not in (TOOL, ROW):
            column = column.cast(arrow.float64(), safe=False)
        arrays[name] = column
    return arrow.table(arrays)
