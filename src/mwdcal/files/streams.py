"""Tables in parts: Parquet and text of any length, read in bounded memory.

A source gives pieces in order, which are cheap to make, and loads a piece, which may be
done by several threads at once. Needs PyArrow. Lines of text that are not plain (quotes, blanks
before a cell) go through the parser of `formats.text`, and so do whole pieces with numbers in unusual
spelling or anything that is refused: one place decides what is accepted, and words it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.contract import RANGES, RAW
from mwdcal.files.formats import parquet, text
from mwdcal.files.formats.columns import LABELS, Column
from mwdcal.files.formats.table import Table, check_decimal, numbers, pointed
from mwdcal.geometry.observables import RESULTS, UNCERTAINTIES
from mwdcal.geometry.vectors import Array, Ints

Result = TypeVar("Result")
PART_ROWS = 1 << 16
"""Most rows of a part of a Parquet table."""
PART = 16 << 20
"""Bytes that the numbers of such a part may take, results included."""
PIECE = 1 << 20
"""Bytes of a piece of text."""
_LONGEST = 1 << 20


class Part(NamedTuple):
    """Some rows: `carried` is the Arrow table to pass on, `table` its columns of the contract."""

    carried: Any
    table: Table
    size: int


@dataclass(frozen=True)
class StreamedTable:
    """A table, not yet read.

    Attributes:
        name: of the file.
        names: of its columns, in order.
        metadata: what the file says about itself.
        schema: Arrow schema of what is carried.
        size: sum of the sizes of all parts, whatever they count.
        rows: number of rows, of text a guess.
        pieces: an iterator over the pieces, in order.
        load: a piece to a `Part`; the second argument asks for the lines of text exactly.
    """

    name: str
    names: list[str]
    metadata: dict[str, object]
    schema: Any
    size: int
    rows: int
    pieces: Callable[[], Iterator[Any]]
    load: Callable[[Any, bool], Part]

    def exactly_if_refused(self, work: Callable[[Part], Result], piece: Any) -> Result:
        """`work` of a piece; where something in it seems wrong, of its text looked at line by line."""
        try:
            return work(self.load(piece, False))
        except InputError:
            return work(self.load(piece, True))


def open_parquet(
    path: Path,
    rows: int = 0,
    decimal: str = ".",
    also: Sequence[str] = (),
    only: Collection[str] = (),
) -> StreamedTable:
    """A Parquet file in parts of `rows` rows; by default as many as memory bears.

    The table of a part has the columns of numbers of the contract, and those named `also`. Columns that are
    carried have the type it has in the file, whatever it is; `decimal` is the sign in columns of text that are read as
    numbers. `only`: those columns alone.
    """
    check_decimal(decimal)
    arrow, _ = parquet.modules(path.name)
    file, stored = parquet.opened(path, path.name, buffer_size=1 << 20, pre_buffer=False)
    count = file.metadata.num_rows
    names = [name for name in stored.names if not parquet.is_index(name)]
    names = [name for name in names if name in only] if only else names
    metadata = parquet.metadata_of(file.metadata.metadata, path.name)
    width = max(8 * len(names), parquet.row_size(file.metadata)) + 8 * len(RESULTS + UNCERTAINTIES)
    step = max(1, min(rows or PART_ROWS, PART // width))

    def pieces() -> Iterator[Any]:
        first = 1
        batches = file.iter_batches(step, columns=names if only else None, use_threads=True)
        with parquet.reading(path.name):
            for batch in batches:
                yield first, batch
                first += len(batch)

    def load(piece: Any, exact: bool) -> Part:
        first, batch = piece
        with parquet.reading(path.name):
            carried = parquet.dense(
                arrow.Table.from_batches([batch]), stored, path.name, arrow, 2 * PART
            )
            carried = carried.select(names)
            wanted = [name for name in names if name in RANGES or name in also]
            columns = {n: parquet.as_column(n, carried.column(n), arrow) for n in wanted}
        lines = range(first, first + len(batch))
        table = Table(columns, metadata, path.name, lines, decimal=decimal)
        return Part(carried, table, len(batch))

    schema = arrow.schema([stored.field(name) for name in names])
    return StreamedTable(path.name, names, metadata, schema, count, count, pieces, load)


def open_text(
    path: Path,
    typed: bool = False,
    decimal: str = ".",
    also: Sequence[str] = (),
    only: Collection[str] = (),
) -> StreamedTable:
    """A text table in pieces; `typed`: the contract's columns of numbers are carried as numbers.

    The table of a part has the columns of numbers of the contract, and those named `also`. Where `decimal` is
    the comma every line goes through the exact parser, and numbers are carried with the point. `only`: the table of a
    part has those columns alone.
    """
    check_decimal(decimal)
    arrow, _ = parquet.modules(path.name)
    try:
        with path.open("rb") as stream:
            first = next(_pieces(stream), b"")
    except OSError as error:
        raise InputError(f"cannot read '{path}': {error.strerror}.") from error
    start = _newlines(first)
    top = text.head(text.lines(start, path.name), path.name)
    body = start.split(b"\n", top.lines)[-1].rstrip(b"\n")
    numeric = [name for name in top.names if typed and name in RANGES]
    types = {n: arrow.float64() if n in numeric else arrow.string() for n in top.names}
    wanted = [name for name in top.names if name in RANGES or name in also]
    wanted = [name for name in wanted if name in only] if only else wanted

    def pieces() -> Iterator[Any]:
        yield body, top.lines, len(first)
        above = start.count(b"\n")
        with path.open("rb") as stream:
            stream.seek(len(first))
            for data in _pieces(stream):
                plain = _newlines(data)
                yield plain, above, len(data)
                above += plain.count(b"\n")

    def load(piece: Any, exact: bool) -> Part:
        data, above, size = piece
        both = None if exact or decimal != "." else _plain(data, top, wanted, arrow, bool(only))
        if both is None:
            parts = text.rows(data, top, above, path.name)
            table = Table(parts.columns, {}, path.name, parts.lines, decimal=decimal)
            both = _strings(pointed(table), arrow), table
        carried, table = both
        if typed:
            carried = _typed(carried, table, numeric, arrow)
        columns = {n: table.columns[n] for n in wanted}
        stated = replace(table, columns=columns, metadata=top.metadata, source=path.name)
        return Part(carried, stated, size)

    schema, total = arrow.schema(list(types.items())), path.stat().st_size
    guess = total * body.count(b"\n") // len(first)
    return StreamedTable(path.name, top.names, top.metadata, schema, total, guess, pieces, load)


def _pieces(stream: Any) -> Iterator[bytes]:
    """The bytes of a file in pieces of whole lines."""
    rest = b""
    while chunk := stream.read(PIECE):
        data = rest + chunk
        cut = data.rfind(b"\n") + 1 or data.rfind(b"\r", 0, -1) + 1
        if not cut and len(data) > _LONGEST:  # no line of a table: for the parser to refuse
            cut = len(data)
        if cut:
            yield data[:cut]
        rest = data[cut:]
    if rest:
        yield rest


def _newlines(data: bytes) -> bytes:
    """The piece with every line ended by a line feed."""
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data if data.endswith(b"\n") else data + b"\n"


def _plain(
    data: bytes, top: text.Head, wanted: Sequence[str], arrow: Any, alone: bool = False
) -> tuple[Any, Table] | None:
    """Strings and table of a piece, unusual lines by the exact parser; None where it takes all.

    `alone`: strings of the wanted columns alone.
    """
    from pyarrow import csv

    plain, odd, order = _sorted(data, top.delimiter.encode())
    if not plain.strip():
        return None
    strings = {name: arrow.string() for name in top.names}
    try:
        carried = csv.read_csv(
            arrow.BufferReader(plain),
            csv.ReadOptions(column_names=top.names, use_threads=False, block_size=len(plain) + 1),
            csv.ParseOptions(delimiter=top.delimiter, quote_char=False),
            csv.ConvertOptions(
                column_types=strings,
                strings_can_be_null=False,
                include_columns=wanted if alone else None,
            ),
        )
        if order is not None:
            few = _strings(text.rows(odd, top, 1, "").columns, arrow).select(carried.column_names)
            both = arrow.concat_tables([carried, few]).combine_chunks()
            if len(both) != len(order):  # lines that are blank are no rows
                return None
            carried = both.take(order)
        columns = {n: _numbers(n, carried.column(n), arrow) for n in wanted}
    except (arrow.ArrowInvalid, arrow.ArrowKeyError):
        return None
    return carried, Table(columns, {}, "", range(carried.num_rows))


def _strings(columns: Mapping[str, Column], arrow: Any) -> Any:
    return arrow.table({n: arrow.array(cells, arrow.string()) for n, cells in columns.items()})


def _sorted(data: bytes, delimiter: bytes) -> tuple[bytes, bytes, Ints | None]:
    """The plain lines of a piece, its unusual ones, and which row of both together comes when.

    Unusual: quotes, NUL, and blanks before a cell.
    """
    marks = (b'"', b"\0", delimiter + b" ")
    unusual = (*marks, b"\n ") if b" " in data else marks[:2]
    if not data.startswith(b" ") and not any(mark in data for mark in unusual):
        return data, b"", None
    lines = np.array([line + b"\n" for line in data.split(b"\n") if line], object)
    odd = np.array([s.startswith(b" ") or any(mark in s for mark in marks) for s in lines], bool)
    order = np.argsort(np.argsort(odd, kind="stable"))
    return b"".join(lines[~odd]), b"".join(lines[odd]), order


def _numbers(name: str, cells: Any, arrow: Any) -> Column:
    """Readings as numbers; so other columns, which may have blank cells, or as text where a cell is no number."""
    import pyarrow.compute as compute

    if name not in (*RAW, "temperature_c"):
        numbers = None if name in (*LABELS, "simulated") else _or_blank(cells, arrow)
        return cells.to_pylist() if numbers is None else numbers
    if cells[0].as_py() == "" and cells.unique().to_pylist() == [""]:
        blank = np.full(len(cells), np.nan)
        blank.flags.writeable = False  # as the others are: compiled loops take columns of one type
        return blank
    try:
        values = cells.cast(arrow.float64())
    except arrow.ArrowInvalid:  # blanks around a number
        values = compute.utf8_trim_whitespace(cells).cast(arrow.float64())
    return np.asarray(values.to_numpy(), float)


def _or_blank(cells: Any, arrow: Any) -> Array | None:
    """The cells as finite numbers, blank ones as NaN; None where a cell is anything else."""
    import pyarrow.compute as compute

    try:
        filled = compute.if_else(compute.equal(cells, ""), None, cells).cast(arrow.float64())
    except arrow.ArrowInvalid:
        return None
    values = np.asarray(filled.to_numpy(), float)
    return values if np.isfinite(values).sum() + filled.null_count == len(values) else None


def _typed(carried: Any, table: Table, numeric: list[str], arrow: Any) -> Any:
    """The strings, blank ones as null, with the contract's columns of numbers as numbers."""
    import pyarrow.compute as compute

    arrays = {
        name: arrow.array(numbers(table, name), arrow.float64(), from_pandas=True)
        if name in numeric
        else compute.if_else(compute.equal(cells, ""), None, cells)
        for name, cells in zip(carried.column_names, carried.columns, strict=True)
    }
    return arrow.table(arrays)


def in_parts(path: Path, least: int) -> bool:
    """Whether a table is taken in parts: Parquet always, text from `least` bytes on."""
    suffix = path.suffix.lower()
    if not path.is_file() or not os.access(path, os.R_OK):
        return False  # refused with its reason where it is read
    if suffix == ".parquet":
        return True
    text_table = suffix in (".csv", ".tsv") and find_spec("pyarrow") is not None
    return text_table and path.stat().st_size >= least
