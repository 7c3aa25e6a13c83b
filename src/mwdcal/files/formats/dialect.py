"""Tables as loggers and spreadsheet programs export them: how one is written, and reading it so.

An export may have another encoding, delimiter and decimal sign than a run file, lines above its
column names, and a line of units below them. `recognised` finds this out; `plain` makes of an export
the text of a run file whose lines keep their numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from typing import NamedTuple

from mwdcal.errors import FitError, InputError
from mwdcal.files.formats.columns import looks_numeric
from mwdcal.files.synonyms import unit_of
from mwdcal.sensor.profile import TableFormat

DELIMITERS = (";", "\t", ",", "|")
LEAST_COLUMNS = 4
"""Columns that a table with three channels and a reference has at least."""
_LOOKED_AT = 2000
"""Lines in which the layout of a table shows."""
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")

Rows = Sequence[Sequence[str]]


class Export(NamedTuple):
    """A table as it was exported: how it is written, its column names, and their units if a line has them.

    `above`: the lines above the names that are not metadata.
    """

    form: TableFormat
    names: list[str]
    units: list[str]
    above: tuple[str, ...] = ()


def decoded(data: bytes, encoding: str, source: str) -> str:
    """The text in some bytes; refuses bytes that the encoding does not have."""
    try:
        text = data.decode("utf-8-sig" if encoding == "utf-8" else encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{source}: expected {encoding} text, as the tool profile says; {error.reason} at byte "
            f"{error.start}. Correct 'encoding' in [table] of the profile."
        ) from None
    if "\0" in text:
        raise InputError(f"{source}: expected text; got a NUL byte. Save the table as text.")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def encoding_of(data: bytes) -> str:
    """The encoding of a text: UTF-16 by its mark, UTF-8 where it is valid, else cp1252."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def plain(data: bytes, form: TableFormat, source: str) -> bytes:
    """The export as the UTF-8 text of a run file with the same delimiter.

    What is neither metadata, column names nor readings becomes a blank line, and delimiters behind
    the last name are cut off on all lines.
    """
    lines = decoded(data, form.encoding, source).split("\n")
    header = lines[form.header_line - 1] if form.header_line <= len(lines) else ""
    ends = len(header) - len(header.rstrip(form.delimiter))
    kept = [_without_end(line, form.delimiter, ends) for line in lines]
    for place in range(min(form.first_line - 1, len(kept))):
        if place != form.header_line - 1 and not (
            place < form.header_line and is_metadata(kept[place])
        ):
            kept[place] = ""
    return "\n".join(kept).encode()


def is_metadata(line: str) -> bool:
    """Whether a line is one of a run file's own, such as `# serial = "A1"`."""
    return re.match(r'"?#\s*[A-Za-z0-9_-]+\s*=', line) is not None


def _without_end(line: str, delimiter: str, ends: int) -> str:
    """The line without so many delimiters at its end."""
    for _ in range(ends):
        line = line.removesuffix(delimiter)
    return line


def recognised_text(data: bytes, source: str) -> Export:
    """How the bytes of a text table are written.

    Raises:
        InputError: no table of numbers.
        FitError: a decimal sign that the cells leave open.
    """
    encoding = encoding_of(data)
    lines = decoded(data, encoding, source).split("\n")[:_LOOKED_AT]
    tables = {delimiter: _cells(lines, delimiter, source) for delimiter in DELIMITERS}
    best = max(DELIMITERS, key=lambda delimiter: _block(tables[delimiter])[1])
    form = TableFormat(encoding=encoding, delimiter=best)  # type: ignore[arg-type]
    return recognised_rows(tables[best], form, source)


def _cells(lines: Sequence[str], delimiter: str, source: str) -> Rows:
    """The cells of each line."""
    try:
        return [next(csv.reader([line], delimiter=delimiter), []) for line in lines]
    except csv.Error as error:
        raise InputError(
            f"{source}: the file is no table of text ({error}). Name the file with the readings."
        ) from None


def recognised_rows(rows: Rows, form: TableFormat, source: str) -> Export:
    """The column names and the layout of a table of these rows, the first of which is line 1."""
    first, numbers = _block(rows)
    if not numbers:
        raise InputError(
            f"{source}: no rows of numbers under column names were found. A table needs one row per station, "
            f"at least {LEAST_COLUMNS} columns, and names above them."
        )
    header, units = _head(rows, first, source)
    below = range((header if units is None else units) + 1, first)
    first = next((place for place in below if holds_numbers(rows[place])), first)
    names = [name.strip() for name in rows[header]]
    while names and not names[-1]:
        names.pop()
    under = [unit.strip(" []()") for unit in (rows[units] if units is not None else ())]
    cells = [cell.strip() for row in rows[first:] for cell in row]
    return Export(
        TableFormat(
            encoding=form.encoding,
            delimiter=form.delimiter,
            decimal=_decimal(cells, form.delimiter, source),  # type: ignore[arg-type]
            header_line=header + 1,
            first_line=first + 1,
        ),
        names,
        [*under, *[""] * len(names)][: len(names)],
        tuple(line for line in map(" ".join, rows[:header]) if not is_metadata(line)),
    )


def _is_number(cell: str) -> bool:
    return looks_numeric(cell.strip()) or looks_numeric(cell.strip(), ",")


def _block(rows: Rows) -> tuple[int, int]:
    """Place of the first row of readings, and how many numbers are in these rows; (0, 0) without any."""
    readings = [place for place, row in enumerate(rows) if _is_reading(row)]
    numbers = sum(_is_number(cell) for place in readings for cell in rows[place])
    return (readings[0], numbers) if readings else (0, 0)


def _is_reading(row: Sequence[str]) -> bool:
    """Whether a row has numbers in at least half of its cells, and in at least four."""
    numbers = sum(map(_is_number, row))
    return numbers >= LEAST_COLUMNS and 2 * numbers >= sum(bool(cell.strip()) for cell in row)


def holds_numbers(row: Sequence[str]) -> bool:
    """Whether at least half of a row's cells that are filled in are numbers, and any.

    >>> [holds_numbers(row) for row in (["P1", "0.1"], ["", "mg", "°"], [""])]
    [True, False, False]
    """
    numbers = sum(map(_is_number, row))
    return numbers > 0 and 2 * numbers >= sum(bool(cell.strip()) for cell in row)


def below_names(data: bytes, form: TableFormat, source: str) -> Rows:
    """The names of the columns, and the lines between them and the first readings."""
    lines = decoded(data, form.encoding, source).split("\n")
    return _cells(lines[form.header_line - 1 : form.first_line - 1], form.delimiter, source)


def _head(rows: Rows, first: int, source: str) -> tuple[int, int | None]:
    """Places of the column names and of the units below them above the first readings."""
    above = [k for k in range(first) if sum(map(bool, map(str.strip, rows[k]))) >= LEAST_COLUMNS]
    if not above:
        raise InputError(
            f"{source}, line {first + 1}: readings without column names above them. Put a line with the "
            "column names there."
        )
    if len(above) > 1 and all(map(is_unit, rows[above[-1]])):
        return above[-2], above[-1]
    return above[-1], None


def is_unit(cell: str) -> bool:
    """Whether a cell is a unit, in brackets or not, or blank.

    >>> [is_unit(cell) for cell in ("[°]", "(mg)", "nT", "", "-", "Azimuth")]
    [True, True, True, True, True, False]
    """
    bare = cell.strip().strip("[]()").strip()
    return not bare.strip("-–") or bool(unit_of(bare))


def _decimal(cells: Sequence[str], delimiter: str, source: str) -> str:
    """The decimal sign of the numbers in some cells."""
    numbers = [cell for cell in cells if _is_number(cell)]
    commas = [cell for cell in numbers if "," in cell]
    points = [cell for cell in numbers if "." in cell]
    if commas and points:
        raise InputError(
            f"{source}: numbers with a comma ({commas[0]}) and with a point ({points[0]}) are mixed. Export "
            "the table with one decimal sign and without thousands separators."
        )
    for sign, marked in (("comma", commas), ("point", points)):
        foreign = sign == "comma" or delimiter != TableFormat().delimiter
        if marked and foreign and all(map(_THOUSANDS.fullmatch, marked)):
            raise FitError(
                f"{source}: the {sign} in {marked[0]} may be a decimal sign or separate thousands. Export the "
                "table with more or fewer decimals, or without thousands separators."
            )
    return "," if commas else "."
