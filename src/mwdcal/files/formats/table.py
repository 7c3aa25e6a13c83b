"""The raw table: cells as they were read, with the place of each for messages."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, UnreadableFileError, reason
from mwdcal.files import metadata as meta
from mwdcal.files.depths import unit_of_length
from mwdcal.files.formats import atomic, text
from mwdcal.files.formats.columns import (
    LABELS,
    WORKBOOKS,
    Column,
    Parts,
    as_text,
    at_most,
    check_names,
    letters_of,
    looks_numeric,
)
from mwdcal.files.formats.columns import shown as shown
from mwdcal.files.formats.titles import Titles, dated
from mwdcal.files.synonyms import unit_of
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import TableFormat

if TYPE_CHECKING:
    from mwdcal.files.formats.layout import Layout

_TABLES = {
    ".csv": "formats.text",
    ".tsv": "formats.text",
    ".parquet": "formats.parquet",
    ".xlsx": "formats.workbook",
}
_FORMATS = {**_TABLES, ".xml": "exchange.witsml", ".las": "exchange.las"}
SUFFIXES = tuple(_TABLES)
"""Of tables as documented; those of other programs are `EXCHANGED`."""
LAID_OUT = (".csv", ".tsv", ".txt", ".dat", ".lvm", ".asc", ".prn", ".log", ".out", *WORKBOOKS)
"""Suffixes of files in which a table is looked for; those that are no tables as documented need a profile."""
EXCHANGED = (".xml", ".las")
"""Suffixes of WITSML and LAS, whose columns are taken from the format's own names."""

_LARGEST_FILES = {".parquet": 2_000_000_000}
_LARGEST_TEXT = 50_000_000
_MARKS = {sign: frozenset(f"0123456789+-eE {sign}") for sign in ".,"}


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of cells as read: text, or numbers (NaN: blank) from typed formats.

    Attributes:
        columns: by name, in the order of the file.
        metadata: what the file says about itself.
        source: name of the file.
        lines: line (text) or row (other formats) of each station, for messages.
        digest: SHA-256 of the file's bytes, hexadecimal.
        decimal: the decimal sign of numbers in text cells.
        places: letters of the columns in a workbook, by name, for messages.
        sheet: name of its sheet there.
        parts: the sheet of each row, where the table is on several.
        across: whether its stations stand in columns of the file; `lines` are these.
        remarks: sentences on rows that were left out, for findings.
        not_taken: lines with a reference that is not read, by column of a run file.
        north: the north of the stand's azimuths by the tool profile, where the metadata do not state it.
        units: of columns, where they stand in a row of their own.
    """

    columns: Mapping[str, Column]
    metadata: Mapping[str, object] = field(default_factory=dict)
    source: str = "table"
    lines: Sequence[int] = ()
    digest: str = ""
    decimal: str = "."
    places: Mapping[str, str] = field(default_factory=dict)
    sheet: str = ""
    parts: Sequence[str] = ()
    across: bool = False
    remarks: tuple[str, ...] = ()
    not_taken: Mapping[str, str] = field(default_factory=dict)
    north: Mapping[str, object] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of stations."""
        return len(next(iter(self.columns.values()), ()))


def read(
    path: str | os.PathLike[str],
    *,
    decimal: str = ".",
    rows: int = 0,
    export: TableFormat | None = None,
    serial: str = "serial",
) -> Table:
    """The table in a .csv, .tsv, .parquet, .xlsx, .xml (WITSML) or .las file.

    `decimal` is the decimal sign of text cells, '.' or ','. `rows`: the most that a Parquet table may
    have; text and workbooks have limits of their own. `export`: how another program has written it.
    `serial`: the name of its column of serials.
    """
    check_decimal(decimal)
    file = Path(path)
    data = _content(file)
    return parsed(data, file.name, decimal=decimal, rows=rows, export=export, serial=serial)


def parsed(
    data: bytes,
    name: str,
    *,
    decimal: str = ".",
    rows: int = 0,
    export: TableFormat | None = None,
    serial: str = "serial",
) -> Table:
    """The table in the bytes of a file of that name: see `read`."""
    digest = sha256_of(data)
    suffix = _suffix(Path(name))
    form = _format(suffix)
    arguments: dict[str, Any] = {"most": rows} if suffix == ".parquet" else {}
    block = Titles({})
    if export and form is text:
        from mwdcal.files.formats.title_references import stated_above

        block = stated_above(text.above(data, export, name))
        data, arguments = text.plain(data, export, name), {"delimiter": export.delimiter}
    elif suffix == ".xlsx":
        arguments = {"form": export, "serial": serial}
    decimal = export.decimal if export else decimal
    parts: Parts = form.parse(data, name, **arguments)
    metadata = dated({**block.metadata, **parts.metadata}, parts.columns.items())
    letters = map(letters_of, range(len(parts.columns))) if suffix == ".xlsx" else ()
    places = dict(zip(parts.columns, letters, strict=False))
    return Table(
        parts.columns,
        metadata,
        name,
        parts.lines,
        digest,
        decimal,
        places,
        not_taken=block.not_taken,
    )


def check_decimal(decimal: str) -> None:
    """Refuse a decimal sign other than the point and the comma."""
    if decimal not in _MARKS:
        raise InputError(f"`decimal` must be '.' or ','; got {shown(decimal)}.")


def write(path: str | os.PathLike[str], table: Table, export: TableFormat | None = None) -> None:
    """Write the table atomically: see `rendered`."""
    atomic.write(path, rendered(path, table, export))


def rendered(
    path: str | os.PathLike[str], table: Table, export: TableFormat | None = None
) -> bytes | str:
    """The table in the format of the suffix of a file; the same table, the same bytes.

    `export`: text with that delimiter, decimal sign and encoding.
    """
    file = Path(path)
    form = _format(check_written(file))
    check_names(list(table.columns), file.name)
    content: bytes | str
    if export and form is text:
        content = text.render(table.columns, table.metadata, export.delimiter, export.decimal)
        encoding = "utf-8-sig" if export.encoding == "utf-8" else export.encoding
        return content.encode(encoding, "replace")
    if form is text:
        return "".join(_lines(file, table))
    content = form.render(_typed(table), table.metadata, file.name)
    if file.suffix.lower() in EXCHANGED:  # what could not be read again
        advice = "Write Parquet."
        at_most(len(content), _LARGEST_TEXT, file.name, "the file", "bytes", advice)
    return content


def streamed(path: str | os.PathLike[str], table: Table) -> bytes | str | Iterator[str]:
    """What `rendered` makes of the table; as text in pieces, which are made while they are written."""
    file = Path(path)
    if _format(check_written(file)) is not text:
        return rendered(path, table)
    check_names(list(table.columns), file.name)
    return _lines(file, table)


def _lines(file: Path, table: Table) -> Iterator[str]:
    """The text of a table in pieces."""
    delimiter = "\t" if file.suffix.lower() == ".tsv" else ","
    return text.pieces(pointed(table), table.metadata, delimiter)


def numbers(table: Table, name: str) -> Array:
    """The column as numbers (n,), NaN where blank; text, NaN and infinity are refused."""
    column = table.columns[name]
    if isinstance(column, list):
        fast = _floats(column, table.decimal)
        return _one_by_one(table, name, column) if fast is None else fast
    for row in np.flatnonzero(np.isinf(column)).tolist():
        raise cell_error(table, name, row, f"expected a finite number; got {column[row]}.")
    return column


def labels(table: Table, name: str) -> list[str]:
    """The column as text without surrounding blanks; no cells where there is no such column."""
    column = table.columns.get(name, [])
    cells = column if isinstance(column, list) else [as_text(value) for value in column.tolist()]
    return [cell.strip() for cell in cells]


def cell_error(table: Table, name: str, row: int, problem: str) -> InputError:
    """The error that names file, line and column before the problem."""
    number = table.lines[row] if row < len(table.lines) else row + 1
    of = table.parts[row] if row < len(table.parts) else table.sheet
    sheet = f", sheet {shown(of)}" if of else ""
    place = (
        f"cell {table.places[name]}{number}"
        if name in table.places
        else f"{row_word(table)} {number}"
    )
    return InputError(f"{table.source}{sheet}, {place}, column '{name}': {problem}")


def row_word(table: Table) -> str:
    """The word for a row of a table in its file: texts have lines."""
    suffix = Path(table.source).suffix.lower()
    if table.across:
        return "column"
    return "row" if suffix in ("", ".parquet", *WORKBOOKS) else "line"


def laid_out(
    path: str | os.PathLike[str],
    *,
    sheet: str = "",
    header_row: int = 0,
    wanted: Collection[str] = (),
    decimal: str = "",
    kind: str = "",
) -> Layout | None:
    """Where the table is in a text or workbook as a laboratory keeps it; None of a format without a layout.

    Raises:
        InputError: the file cannot be read, or holds no such table.
        FitError: several tables that may be meant, or an open decimal sign.
    """
    from mwdcal.files.formats import layout, sheets

    if decimal:
        check_decimal(decimal)
    file = Path(path)
    if file.suffix.lower() not in LAID_OUT:
        return None
    return layout.laid_out(
        sheets.sheets_of(_content(file), file.name),
        file.name,
        sheet=sheet,
        header_line=header_row,
        wanted=wanted,
        decimal=decimal,
        kind=kind,
    )


def every_table(path: str | os.PathLike[str], *, decimal: str = "") -> list[Layout]:
    """All tables in a text or workbook, as `laid_out` finds them; none in a format without a layout."""
    from mwdcal.files.formats import layout, sheets

    file = Path(path)
    if file.suffix.lower() not in LAID_OUT:
        return []
    return layout.every_table(sheets.sheets_of(_content(file), file.name), file.name, decimal)


def of_layout(where: Layout, path: str | os.PathLike[str], kept: Collection[str]) -> Table:
    """The table of a layout in a file; the cells of the columns `kept` as they stand, of labels and serials."""
    from mwdcal.files.formats import layout

    lines = [(n, line) for n, line in enumerate(where.above, 1) if text.is_metadata(line)]
    stated = meta.parse(lines, Path(path).name)
    return Table(
        layout.as_columns(where, kept),
        {**where.titles.metadata, **stated},
        Path(path).name,
        where.lines,
        sha256_of(_content(Path(path))),
        places=where.places,
        sheet=where.sheet,
        parts=where.parts,
        across=where.across,
        remarks=where.remarks,
        not_taken=where.titles.not_taken,
        units=dict(zip(where.names, where.units, strict=True)),
    )


def below_names(path: str | os.PathLike[str], form: TableFormat) -> list[tuple[int, Sequence[str]]]:
    """The names of the columns of an export, and what stands between them and the readings, by line or row."""
    file = Path(path)
    data, suffix = _content(file), _suffix(file)
    places = range(form.header_line, form.first_line)
    if suffix == ".xlsx":
        rows = dict(_format(suffix).read_rows(data, file.name))
        return [(place, [as_text(cell) for cell in rows.get(place, ())]) for place in places]
    if _format(suffix) is not text:
        return []
    return list(zip(places, text.below_names(data, form, file.name), strict=False))


def _format(suffix: str) -> Any:
    """The module that reads and writes a format."""
    return import_module(f"mwdcal.files.{_FORMATS[suffix]}")


def check_written(path: Path) -> str:
    """The suffix of a table to write, which must be that of a format."""
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise InputError(
            f"cannot write '{path}': the suffix of a table must be one of {', '.join(_FORMATS)}; got "
            f"'{suffix or 'none'}'. Write to '{path.with_suffix('.csv') if path.name else path}', for example."
        )
    return suffix


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix in LAID_OUT and suffix not in _FORMATS:
        raise InputError(
            f"'{path}': a {suffix} file is read by a tool profile that mwdcal profile has made of it. Name one by "
            f"`tool`, or save the table as one of {', '.join(_TABLES)}."
        )
    if suffix not in _FORMATS:
        raise InputError(
            f"'{path}': the suffix must be one of {', '.join(_FORMATS)}; got "
            f"'{suffix or 'none'}'. Convert or rename the file."
        )
    return suffix


def _content(path: Path) -> bytes:
    """The bytes of a regular file of a known suffix that is not too large."""
    try:
        check_file(path)
        suffix = path.suffix.lower()
        most = _LARGEST_FILES.get(suffix if suffix in LAID_OUT else _suffix(path), _LARGEST_TEXT)
        advice = "Split it, or write long tables as Parquet."
        at_most(path.stat().st_size, most, f"'{path}'", "the file", "bytes", advice)
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read '{path}': {reason(error)}. Check that the file may be read and is not "
            "locked by another program."
        ) from error


def check_file(path: Path) -> None:
    """Refuse a path at which there is no regular file."""
    if path.is_dir():
        raise UnreadableFileError(f"'{path}' is a folder. Name a file in it.")
    if not path.exists():
        raise UnreadableFileError(f"'{path}': no such file. Check the name and the folder.")
    if not path.is_file():
        raise UnreadableFileError(f"'{path}' is not a regular file. Name a file with readings.")


def _floats(cells: Sequence[str], decimal: str) -> Array | None:
    """The cells as numbers, blank as NaN; None where a cell is not a plain finite number."""
    if not set("".join(cells)) <= _MARKS[decimal]:
        return None
    pointed = [cell.replace(",", ".").strip() for cell in cells]
    try:
        values = np.array([float(cell) if cell else np.nan for cell in pointed])
    except ValueError:
        return None
    return None if np.isinf(values).any() else values


def _one_by_one(table: Table, name: str, cells: Sequence[str]) -> Array:
    """The same, for cells with unusual blanks; refuses the first cell that is not a number."""
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        stripped = cell.strip()
        if not stripped:
            continue
        if not looks_numeric(stripped, table.decimal):
            several = any(
                looks_numeric(c.strip(), table.decimal) for c in cells[:row] if "." in c or "," in c
            )
            advice = (
                _SINGLE
                if several and _is_other_sign(stripped, table.decimal)
                else _advice(name, stripped, table.decimal)
            )
            problem = f"expected a number; got {shown(cell)}. {advice}"
            raise cell_error(table, name, row, problem)
        values[row] = float(stripped.replace(",", "."))
        if np.isinf(values[row]):
            problem = f"expected a finite number; got {shown(cell)}, which is too large."
            raise cell_error(table, name, row, problem)
    return values


_SINGLE = "Other cells of the column have the other decimal sign. Correct this one."


def _is_other_sign(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with the decimal sign that its table does not have."""
    return looks_numeric(cell, "," if decimal == "." else ".")


LEAVE_OUT = "leave such rows out by leave_out in [table] of the tool profile"
"""The remedy for rows without a reading in a table that stays as it is."""


def _advice(name: str, cell: str, decimal: str) -> str:
    """The remedy for a cell of the column `name` that is not a number."""
    rows = f"leave_out = {{{shown(name)} = [{shown(cell)}]}}"
    if decimal == "." and looks_numeric(cell, ","):
        return "Is the decimal comma intended? Use `decimal` ','."
    if decimal == "," and looks_numeric(cell, "."):
        return "The decimal sign was given as a comma. Is the point intended? Use `decimal` '.'."
    if re.fullmatch(r"[+-]?(nan|inf|infinity|∞|n/?a|null|none)", cell, re.IGNORECASE):
        return (
            f"Every number must be finite. Where a channel has no value, {LEAVE_OUT}: {rows}. "
            "Leave the cell blank where another value is unknown."
        )
    if re.fullmatch(r"[+-]?\d{1,3}([ ,.'’_\u00a0\u202f]\d{3})+([.,]\d*)?", cell):
        return "Write numbers without thousands separators."
    if re.match(r"0[xXbBoO]", cell):
        return "Write decimal numbers."
    behind = re.fullmatch(r"[+-]?[\d.,]+([eE][+-]?\d+)?\s*([^\d\s.,+-].*)", cell)
    if behind and (unit_of(behind[2]) or unit_of_length(behind[2])):
        return "Write the number without its unit; the column name states it."
    return f"Write a plain number, such as 0.998 or 9.98e-1, or {LEAVE_OUT}: {rows}."


def pointed(table: Table) -> dict[str, Column]:
    """The columns with the decimal point in every number, for text files."""
    if table.decimal == ".":
        return dict(table.columns)
    return {
        name: [c.replace(",", ".") if looks_numeric(c.strip(), ",") else c for c in column]
        if isinstance(column, list) and name not in LABELS
        else column
        for name, column in table.columns.items()
    }


def _typed(table: Table) -> dict[str, Column]:
    """The columns for typed formats: text columns that hold nothing but numbers as numbers."""
    columns = dict(table.columns)
    for name, column in table.columns.items():
        if isinstance(column, list) and name not in LABELS and not any(map(_is_code, column)):
            values = _floats(column, table.decimal)
            columns[name] = column if values is None else values
    return columns


def _is_code(cell: str) -> bool:
    """Whether a number would lose digits of the cell: leading zeros ('007'), or more than it holds."""
    digits = cell.removeprefix("-")
    return bool(re.match(r"0\d", digits)) or (len(digits) > 15 and digits.isdigit())
