"""What every table format shares: columns, the header, and rows of cells turned into columns."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date, time
from typing import NamedTuple

import numpy as np

from mwdcal.errors import InputError, UnreadableFileError
from mwdcal.geometry.vectors import Array

# Text as it was read, or numbers with NaN where the cell is blank.
Column = list[str] | Array

# Columns that are text even where every cell looks like a number.
LABELS = ("station", "group", "serial")

MAX_COLUMNS = 1000
WORKBOOKS = (".xlsx", ".xls", ".ods")
"""Suffixes of files whose tables have rows, not lines."""
_LONGEST_SHOWN = 40

_CONTROLS = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029\ufeff]+")
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)


class Parts(NamedTuple):
    """Contents of a file as a format reads them."""

    columns: dict[str, Column]
    metadata: dict[str, object]
    lines: Sequence[int]


def of_texts(names: Sequence[str], rows: Sequence[Sequence[object]]) -> dict[str, Column]:
    """Rows of text cells as columns."""
    columns = zip(*rows, strict=True)
    return {name: [str(cell) for cell in cells] for name, cells in zip(names, columns, strict=True)}


@contextmanager
def damaged_unless_read(source: str, expected: str, advice: str) -> Iterator[None]:
    """Whatever a library raises on a foreign or damaged file means the same to the user."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
        reason = re.sub(r"<class '([\w.]+)'>", r"\1", reason)
        raise UnreadableFileError(
            f"{source}: expected {expected}; reading it failed ({reason}). {advice}"
        ) from error


def looks_numeric(text: str, decimal: str = ".") -> bool:
    """Whether the text is one plain decimal number, with the given decimal sign."""
    other = "," if decimal == "." else "."
    return other not in text and _NUMBER.fullmatch(text) is not None


def shown(value: object) -> str:
    """A value for a message: text in quotes, long text cut, numbers in short form."""
    if isinstance(value, str):
        cut = value if len(value) <= _LONGEST_SHOWN else value[:_LONGEST_SHOWN] + "…"
        return f"'{cut}'" if cut.isprintable() else repr(cut)
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def at_most(count: int, most: int, where: str, what: str, units: str, advice: str) -> None:
    """Refuse more of something than may be there."""
    if count > most:
        raise InputError(f"{where}: {what} must have at most {most} {units}; got {count}. {advice}")


def check_names(names: Sequence[str], where: str) -> None:
    """Refuse a header with too many, unnamed or repeated columns, or without names at all."""
    if not names:
        raise InputError(
            f"{where}: expected the column names; got the end of the file. Add a line with the "
            "column names, such as ax,ay,az, and one row per station."
        )
    at_most(len(names), MAX_COLUMNS, where, "a table", "columns", "Is this a run file?")
    if all(looks_numeric(name) for name in names):
        raise InputError(
            f"{where}: expected the column names; got numbers. Put a line with the column "
            "names, such as ax,ay,az, above them."
        )
    if "" in names:
        raise InputError(
            f"{where}: every column must have a name; column {[*names].index('') + 1} has none. "
            "Name it, or remove it with its delimiter."
        )
    for name in (name for i, name in enumerate(names) if name in names[:i]):
        raise InputError(
            f"{where}: column names must be unique; got {shown(name)} more than once. "
            "Rename one of the columns, or propose a tool profile for the table as it is: mwdcal profile."
        )


def plain_names(names: Sequence[str], lone_mark: str = "") -> list[str]:
    """The names as text tables and workbooks can have them; those that they can have are kept.

    One line without control characters and blanks around, no '#' before the first, none blank, no
    two alike. `lone_mark`: the name of a first column that is called '#' and nothing else.

    >>> plain_names(["#ax", "Temp\\n(C)", "", "note", "note ", "note"])
    ['ax', 'Temp (C)', 'column 3', 'note', 'note (2)', 'note (3)']
    """
    plain = [_CONTROLS.sub(" ", name).strip() for name in names]
    plain[:1] = [name.lstrip("# ") or (name and lone_mark) for name in plain[:1]]
    taken = {name for name, wanted in zip(names, plain, strict=True) if name == wanted}
    for place, (name, wanted) in enumerate(zip(names, plain, strict=True)):
        if not wanted or name != wanted or name in names[:place]:
            plain[place] = _free(wanted or f"column {place + 1}", taken)
            taken.add(plain[place])
    return plain


def plain_headings(names: Sequence[str]) -> list[str]:
    """The names of a table that is read, in which '#' alone may head the first column.

    >>> plain_headings(["#", "ax"]), plain_headings(["# ax", "#"]), plain_headings(["", "#"])
    (['#', 'ax'], ['ax', '#'], ['column 1', '#'])
    """
    return plain_names(names, "#")


Merged = Sequence[tuple[tuple[int, int], tuple[int, int]]]
"""Ranges of merged cells: the first and the last, each by row from 1 and column from 0."""


def with_merged(
    rows: Iterable[tuple[int, Sequence[object]]], merged: Merged
) -> Iterator[tuple[int, Sequence[object]]]:
    """Rows by number, with the value of cells that are merged downwards in each of their rows.

    >>> [*with_merged([(1, [10, 0]), (2, [None, 90])], [((1, 0), (2, 0))])]
    [(1, [10, 0]), (2, [10, 90])]
    """
    ends = {place: last for place, (last, _) in merged if last > place[0]}
    running: dict[int, tuple[int, object]] = {}
    for line, row in rows:
        running = {c: each for c, each in running.items() if each[0] >= line}
        if blank := [c for c in running if c >= len(row) or row[c] in (None, "")]:
            row = [*row, *[None] * (max(blank) + 1 - len(row))]
            for column in blank:
                row[column] = running[column][1]
        running |= {c: (ends[line, c], cell) for c, cell in enumerate(row) if (line, c) in ends}
        yield line, row


def letters_of(place: int) -> str:
    """The letters of a column of a workbook by its place from 0.

    >>> [letters_of(place) for place in (0, 25, 26, 701, 702)]
    ['A', 'Z', 'AA', 'ZZ', 'AAA']
    """
    before, letter = divmod(place, 26)
    return (letters_of(before - 1) if before else "") + chr(ord("A") + letter)


def _free(name: str, taken: set[str]) -> str:
    """The name, with a number behind it if it is taken."""
    numbered = (f"{name} ({count})" for count in range(2, len(taken) + 3))
    return name if name not in taken else next(each for each in numbered if each not in taken)


def assemble(
    rows: Iterator[tuple[int, Sequence[object]]], source: str, word: str
) -> tuple[list[str], list[Sequence[object]], list[int]]:
    """Names, rows of equal length, and their line numbers; the first row is the header.

    Rows without any content are left out.
    """
    number, header = next(rows, (1, ()))
    names = [as_text(cell).strip() for cell in header]
    check_names(names, f"{source}, {word} {number}")
    kept: list[Sequence[object]] = []
    lines: list[int] = []
    for number, row in rows:
        if _is_blank(row):
            continue
        if len(row) != len(names):
            raise _ragged(row, len(names), f"{source}, {word} {number}")
        kept.append(row)
        lines.append(number)
    if not kept:
        raise no_stations(source)
    return names, kept, lines


def no_stations(source: str) -> InputError:
    """The refusal of a table with a header and nothing below it."""
    return InputError(
        f"{source}: the file has column names but no stations. Add one row per station."
    )


def _is_blank(row: Sequence[object]) -> bool:
    return not any(cell.strip() if isinstance(cell, str) else cell is not None for cell in row)


def _ragged(row: Sequence[object], width: int, where: str) -> InputError:
    if as_text(row[0]).lstrip().startswith("#"):
        advice = "Lines that start with '#' belong above the column names."
    else:
        advice = "Check the delimiters of this line; a decimal comma needs ';' between cells."
    return InputError(
        f"{where}: expected {width} cells, as many as there are column names; "
        f"got {len(row)}. {advice}"
    )


def typed(name: str, cells: Iterable[object]) -> Column:
    """A column of typed cells: numbers if all are numbers or blank, else text."""
    values = list(cells)
    if name in LABELS or not {type(value) for value in values} <= {int, float, type(None)}:
        return [as_text(value) for value in values]
    return np.array([np.nan if value is None else value for value in values], float)


def without_marks(text: str) -> str:
    """A text with plain letters in place of those with accents and other marks.

    >>> without_marks("Posición"), without_marks("자기장")
    ('Posicion', '자기장')
    """
    apart = unicodedata.normalize("NFKD", text)
    return unicodedata.normalize("NFC", "".join(c for c in apart if not unicodedata.combining(c)))


def as_text(value: object) -> str:
    """A typed cell as text: whole numbers without a decimal point, dates in ISO form.

    >>> [as_text(v) for v in (None, "A", 7.0, 0.1, True)]
    ['', 'A', '7', '0.1', 'true']
    """
    if isinstance(value, float):
        return number(value).removesuffix(".0")
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)


def number(value: float) -> str:
    """The shortest text that reads back as the same number; blank for NaN."""
    return "" if math.isnan(value) else repr(float(value))
