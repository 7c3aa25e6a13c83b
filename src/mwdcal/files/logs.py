"""A continuous log: many samples a second, in any table format, with or without column names.

Text is read in pieces of a few megabytes, so that a log may be larger than a run file. A piece
that is plain numbers goes through NumPy's own reader; any other goes cell by cell, which finds
the one that is wrong.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO, NamedTuple
from weakref import finalize

import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files import metadata as meta
from mwdcal.files.contract import (
    COLUMNS,
    RANGES,
    RAW,
    check_columns,
    check_near_misses,
    columns_of,
    range_faults,
    refuse,
)
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import (
    Column,
    assemble,
    check_names,
    looks_numeric,
    no_stations,
    of_texts,
    shown,
)
from mwdcal.files.formats.table import Table
from mwdcal.files.formats.text import comment, is_preamble, split
from mwdcal.geometry.vectors import Array

TIME = "time_s"
READ = (TIME, *RANGES)
"""Columns of a log that mean something, all of them numbers."""

_PIECE = 16_000_000
_LONGEST_ROW = 1_000_000
_TYPED = (".parquet", ".xlsx", *tables.EXCHANGED)
_ODD = ("nan", "inf", '"', "\r")
"""Letters and signs that no plain number has, in lower case."""
_CLOCK = re.compile(r"\d{4}-\d{1,2}-\d{1,2}|\d{1,2}:\d{2}|\d{1,2}[./]\d{1,2}[./]\d{4}")
_OF_NUMBERS = b"0123456789+-.eE \r\n"
"""All that plain numbers are spelled with, and lines end with."""
_BINARY = bytes([*range(0x09), *range(0x0E, 0x20)])
_LONG_LOG = 100_000_000
"""Bytes of text from which the columns of a log are not all in memory at once."""
_EXAMPLE = "`columns` time_s,ax,ay,az"


Say = Callable[[str], None]
"""Called with the progress of a long computation, in words."""


def silent(text: str) -> None:
    """Say nothing."""


class _Layout(NamedTuple):
    """How the lines of a text log are to be read; the delimiter None is white space."""

    names: list[str]
    delimiter: str | None
    decimal: str
    source: str


def read(
    path: str | os.PathLike[str],
    columns: Sequence[str] = (),
    *,
    decimal: str = ".",
    say: Say = silent,
) -> Table:
    """The columns of a log that mean something, as numbers (NaN: blank), and its metadata.

    `columns` are the names of a text log without a line of column names. `say` receives
    the progress. Errors name file, line and column.
    """
    file = Path(path)
    if file.suffix.lower() in _TYPED:
        return _typed(file, columns, decimal)
    return _accepted(_text(file, [*columns], decimal, say))


def check(table: Table) -> Table:
    """The log with columns that are in memory, refused like a file where they are no log."""
    _check(list(table.columns), table.source)
    if not table.count:
        raise _empty(table.source)
    return _accepted(table)


def _accepted(table: Table) -> Table:
    """The log with numbers in every column that means something; refused if no channel reads them."""
    if not isinstance(table.columns, StoredColumns):
        numbers = {name: _numbers(table, name) for name in table.columns if name in READ}
        table = replace(table, columns={**table.columns, **numbers})
    for name in RAW:
        refuse(table, range_faults(columns_of(table), name))
    return table


def _typed(file: Path, names: Sequence[str], decimal: str) -> Table:
    """The table of a log of typed columns, its numbers as numbers."""
    if names:
        raise InputError(
            f"`columns` names the columns of a text log without column names; '{file}' has "
            "names of its own. Leave `columns` out."
        )
    try:
        return check(tables.read(file, decimal=decimal))
    except InputError as error:
        if str(error) != str(no_stations(file.name)):
            raise
        raise _empty(file.name) from None


def _text(file: Path, names: list[str], decimal: str, say: Say) -> Table:
    """The table of a text log."""
    tables.check_decimal(decimal)
    try:
        tables.check_file(file)
        with file.open("rb") as stream:
            table = _read_text(stream, names, decimal, file.name, say)
            stream.seek(0)
            return replace(table, digest=sha256_of(stream))
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read '{file}': {reason(error)}. Check the name and the file."
        ) from None


def _empty(source: str) -> InputError:
    """A log with nothing below its column names."""
    return InputError(f"{source}: the log has no samples. Is the file complete?")


def _numbers(table: Table, name: str) -> Array:
    """The column as numbers; dates and times of day instead of seconds are refused as such."""
    column = table.columns[name]
    if name == TIME and isinstance(column, list):
        for row, cell in enumerate(column):
            if _CLOCK.search(cell):
                raise tables.cell_error(
                    table, name, row,
                    f"expected seconds as a number; got the date or time of day {shown(cell)}. Write the "
                    "seconds since the start, or leave the column out and give `sampling_hz`.",
                )  # fmt: skip
    return tables.numbers(table, name)


def _read_text(stream: BinaryIO, names: list[str], decimal: str, source: str, say: Say) -> Table:
    """The table in the text of a log."""
    comments, first, number = _top(stream, source)
    metadata = meta.parse(comments, source)
    layout = _layout(first, number, names, decimal, source)
    size = os.fstat(stream.fileno()).st_size
    ahead, done = ((first + "\n").encode(), number - 1) if names else (b"", number)
    wanted, lines = _wanted(layout), []
    others = [name for name in layout.names if name not in READ]
    filled: _Growing | StoredColumns = (
        _Growing(others, wanted) if size < _LONG_LOG else StoredColumns(others, wanted)
    )
    for piece in _pieces(stream, ahead):
        taken = _by_arrow(piece, done, layout) if size >= _LONG_LOG else None
        if taken is None:
            text = _decoded(piece, done + 1, source).replace("\r\n", "\n")
            taken = _piece(text, done, layout)
        values, numbers, done = taken
        share = stream.tell() / size
        filled.add(values, share)
        lines.append(numbers)
        say(f"reading {source}: {100 * share:.0f} %")
    if not sum(map(len, lines)):
        raise _empty(source)
    return Table(filled.whole(), metadata, source, _joined(lines), decimal=decimal)


class _Growing:
    """Columns that are filled piece by piece: a long log is in memory once, not as pieces and as a whole."""

    def __init__(self, others: Sequence[str], names: Sequence[str]) -> None:
        self.others, self.names = others, names
        self.columns = [np.empty(0) for _ in names]
        self.rows = 0

    def add(self, values: Array, share: float) -> None:
        """Append values (rows, columns), with which this share of the log is read."""
        start, self.rows = self.rows, self.rows + len(values)
        for i, column in enumerate(self.columns):
            if self.rows > len(column):  # room for the whole as it looks from here
                column = np.empty(int(self.rows * max(1.02 / share, 1.1)) + 1)
                column[:start], self.columns[i] = self.columns[i][:start], column
            column[start : self.rows] = values[:, i]

    def whole(self) -> Mapping[str, Column]:
        """The columns, as long as what was added; the room that is left over was never touched."""
        columns: dict[str, Column] = {name: [] for name in self.others}
        filled = (column[: self.rows] for column in self.columns)
        return columns | dict(zip(self.names, filled, strict=True))


class StoredNumbers:
    """Numbers in a file without a name."""

    def __init__(self) -> None:
        self._file = TemporaryFile()  # noqa: SIM115, closed by what follows
        finalize(self, self._file.close)

    def add(self, values: Array) -> None:
        """Append numbers (n,)."""
        self._file.write(np.ascontiguousarray(values, float).data)

    def read(self) -> Array:
        """All of them, (n,)."""
        self._file.seek(0)  # what was added is written before
        return np.fromfile(self._file)


class StoredColumns(Mapping[str, Column]):
    """Columns of a long log, each in a file without a name, from which it is read when it is asked for."""

    def __init__(self, others: Sequence[str], names: Sequence[str]) -> None:
        self._others = others
        self._stored = {name: StoredNumbers() for name in names}

    def add(self, values: Array, share: float) -> None:
        """Append values (rows, columns)."""
        for stored, column in zip(self._stored.values(), values.transpose(), strict=True):
            stored.add(column)

    def whole(self) -> Mapping[str, Column]:
        """The columns."""
        return self

    def __getitem__(self, name: str) -> Column:
        return [] if name in self._others else self._stored[name].read()

    def __contains__(self, name: object) -> bool:
        return name in self._stored or name in self._others

    def __iter__(self) -> Iterator[str]:
        return chain(self._others, self._stored)

    def __len__(self) -> int:
        return len(self._others) + len(self._stored)


def _top(stream: BinaryIO, source: str) -> tuple[list[tuple[int, str]], str, int]:
    """Numbered comments above the table, and its first line with its number."""
    comments: list[tuple[int, str]] = []
    for number, data in enumerate(stream, 1):
        if len(data) > _LONGEST_ROW:
            raise InputError(
                f"{source}, line {number}: the line must have at most {_LONGEST_ROW} bytes; got "
                f"{len(data)}. Is this a log?"
            )
        line = _decoded(data, number, source).lstrip("\ufeff").strip("\r\n")
        if not is_preamble(line):
            return comments, line, number
        comments.append((number, comment(line)))
    raise InputError(
        f"{source}: the file is empty. A log needs a line with the column names, such as "
        f"time_s,ax,ay,az, or {_EXAMPLE}; and one row per sample."
    )


def _decoded(data: bytes, number: int, source: str) -> str:
    """Text of a piece whose first line has this number."""
    try:
        if len(data.translate(None, _BINARY)) == len(data):
            return data.decode("utf-8")
        bad = next(place for place, byte in enumerate(data) if byte in _BINARY)
    except UnicodeDecodeError as error:
        bad = error.start
    line = number + data.count(b"\n", 0, bad)
    raise InputError(
        f"{source}, line {line}: expected UTF-8 text; got byte 0x{data[bad]:02X}. Save the log "
        "as UTF-8 text, or as .parquet."
    )


def _layout(first: str, number: int, names: list[str], decimal: str, source: str) -> _Layout:
    """Names and delimiter, from the first line of the table."""
    marks = [mark for mark in ",;\t" if mark != decimal]
    best = max(marks, key=first.count)
    delimiter = best if best in first else None
    _, header = next(_rows([first], delimiter, number - 1, source))
    cells = [str(cell).strip() for cell in header]
    numeric = all(looks_numeric(cell, decimal) or not cell for cell in cells)
    where = f"{source}, line {number}"
    if numeric and not names:
        raise InputError(
            f"{where}: expected the column names; got numbers. Name the columns: {_EXAMPLE} (in the "
            "order of the file)."
        )
    _check(names or cells, "`columns`" if names else where)
    if names and not numeric and any(re.match(r"[A-Za-z]", cell) for cell in cells):
        raise InputError(
            f"{where}: expected numbers, as `columns` names the columns; got {shown(first.strip())}. "
            "Leave `columns` out, or remove this line."
        )
    return _Layout(names or cells, delimiter, decimal, source)


def _check(names: list[str], where: str) -> None:
    """Refuse names that are missing, doubled, or nearly those of the contract."""
    check_names(names, where)
    check_near_misses(names, (TIME, *COLUMNS), f"{where}: column")
    check_columns(names, where)


def _wanted(layout: _Layout) -> list[str]:
    return [name for name in layout.names if name in READ]


def _pieces(stream: BinaryIO, ahead: bytes) -> Iterator[bytes]:
    """The rest of the file in whole lines, `ahead` before it."""
    while data := stream.read(_PIECE) + stream.readline():
        yield ahead + data
        ahead = b""
    if ahead:
        yield ahead


def _by_arrow(data: bytes, done: int, layout: _Layout) -> tuple[Array, Sequence[int], int] | None:
    """As `_piece` of plain numbers, by Arrow; None where a piece is anything else, or there is no Arrow."""
    if layout.delimiter is None or layout.decimal != ".":
        return None
    if data.translate(None, _OF_NUMBERS + layout.delimiter.encode()):
        return None
    try:
        import pyarrow as arrow
        from pyarrow import csv
    except ImportError:
        return None
    wanted, count = _wanted(layout), data.count(b"\n") + (not data.endswith(b"\n"))
    try:
        cells = csv.read_csv(
            arrow.BufferReader(data),
            csv.ReadOptions(
                column_names=layout.names, use_threads=False, block_size=len(data) + 1
            ),
            csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
            csv.ConvertOptions(
                column_types=dict.fromkeys(wanted, arrow.float64()), include_columns=wanted,
                null_values=[""],
            ),
        )  # fmt: skip
    except arrow.ArrowInvalid:
        return None
    values = np.stack([np.asarray(column.to_numpy(), float) for column in cells.columns])
    if len(cells) != count or np.isinf(values).any():
        return None
    return values.transpose(), range(done + 1, done + count + 1), done + count


def _piece(text: str, done: int, layout: _Layout) -> tuple[Array, Sequence[int], int]:
    """Values (rows, wanted columns) and line numbers of a piece, and the lines done after it."""
    after = done + text.count("\n") + (not text.endswith("\n"))
    text = text.rstrip("\n")
    if not text.strip():
        return np.zeros((0, len(_wanted(layout)))), range(0), after
    lines = text.split("\n")
    values = _plain(text, len(lines), layout)
    if values is not None and len(values) == len(lines):
        return values, range(done + 1, done + len(lines) + 1), after
    rows = _rows(lines, layout.delimiter, done, layout.source)
    names, cells, numbers = assemble(chain([(done, layout.names)], rows), layout.source, "line")
    table = Table(of_texts(names, cells), {}, layout.source, numbers, "", layout.decimal)
    values = np.stack([_numbers(table, name) for name in _wanted(layout)], -1)
    return values, numbers, after


def _plain(text: str, count: int, layout: _Layout) -> Array | None:
    """The values of a piece of plain numbers and blanks, None where it is anything else."""
    mark, names = layout.delimiter, layout.names
    wanted = [names.index(name) for name in _wanted(layout)]
    lowered = text.lower()
    if any(odd in lowered for odd in _ODD) or (layout.decimal == "," and "." in text):
        return None
    if mark is not None:
        if text.count(mark) != (len(names) - 1) * count:
            return None
        text = _filled(text, mark)
    rows = text.replace(layout.decimal, ".").split("\n")
    used = wanted if mark else None
    try:
        values = np.loadtxt(rows, delimiter=mark, comments=None, ndmin=2, usecols=used)
    except ValueError:
        return None
    if not mark:
        if values.shape[-1] != len(names):
            return None
        values = values[:, wanted]
    return None if np.isinf(values).any() else values


def _filled(text: str, mark: str) -> str:
    """The text with `nan` in every blank cell."""
    for _ in range(2):  # of blanks that share a delimiter, one at a time
        text = text.replace(mark * 2, f"{mark}nan{mark}")
    text = f"\n{text}\n".replace(f"{mark}\n", f"{mark}nan\n")
    return text.replace(f"\n{mark}", f"\nnan{mark}")[1:-1]


def _rows(
    lines: Sequence[str], delimiter: str | None, above: int, source: str
) -> Iterator[tuple[int, Sequence[object]]]:
    """The cells of each line with its number; the delimiter None is white space."""
    if delimiter is None:
        return ((number, line.split()) for number, line in enumerate(lines, above + 1))
    return split(lines, above, delimiter, source)


def _joined(lines: Sequence[Sequence[int]]) -> Sequence[int]:
    """Line numbers of all pieces; a range where they follow each other."""
    full = [numbers for numbers in lines if len(numbers)]
    if all(isinstance(numbers, range) for numbers in full):
        return range(full[0][0], full[-1][-1] + 1)
    return list(chain.from_iterable(lines))
