"""XLSX: the first sheet; metadata in leading rows whose first cell starts with '#'."""

from __future__ import annotations

import datetime
import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import takewhile
from typing import IO, Any, NamedTuple
from xml.etree.ElementTree import iterparse
from xml.parsers import expat

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.formats.columns import (
    MAX_COLUMNS,
    Column,
    Merged,
    Parts,
    as_text,
    assemble,
    damaged_unless_read,
    number,
    plain_names,
    typed,
    with_merged,
)
from mwdcal.files.formats.text import is_metadata
from mwdcal.files.formats.title_references import stated_above
from mwdcal.sensor.profile import TableFormat

# --------------------------------------------------------------------------
# What a workbook may hold, checked in one pass over its XML before a library reads it.
#
# A small archive can unpack to gigabytes of objects: cells far to the right, rows far below, floods
# of attributes or elements, entities. No spreadsheet program writes such files.

MAX_ROWS = 1_048_576
MAX_BLANK_ROWS = 100_000
MAX_COUNTS = {
    "c": (1_500_000, "cells"),
    "si": (750_000, "texts"),
    "row": (MAX_ROWS, "rows"),
    "": (500_000, "other elements"),
}
"""Most elements of a kind in a part."""
_CONTENTS = frozenset(("v", "t", "is", "f", "r", "rPr", "rPh"))
"""What cells and texts are made of: a few of each, as `_CONTENTS_OF_ONE`, and `_MOST_FORMATS` more in all."""
_CONTENTS_OF_ONE = 2
_MOST_FORMATS = 500_000
_LONGEST_TEXT = 1 << 16
"""Characters of a cell or text, all its parts together: twice what a spreadsheet program allows."""
_LARGEST_UNPACKED = 200_000_000
_LONGEST_ELEMENT = 1 << 20
_MOST_NAMES = 10_000
_CHUNK = 1 << 16
_ADVICE = "Save the sheet with the run alone with a spreadsheet program, or as CSV UTF-8."


def check(archive: zipfile.ZipFile, source: str) -> None:
    """Refuse an archive that takes more memory than any run needs."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > _LARGEST_UNPACKED:
        raise InputError(
            f"{source}: a workbook must unpack to at most {_LARGEST_UNPACKED} bytes; got {size}. "
            f"{_ADVICE}"
        )
    for entry in archive.infolist():
        if entry.filename.lower().endswith((".xml", ".rels")):
            with archive.open(entry.filename) as stream:
                _PartCheck(f"{source}, {entry.filename}").check(stream)


class _PartCheck:
    """Counts the elements of a part of a workbook."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._counts: Counter[str] = Counter()
        self._row = self._column = self._text = self._contents = 0

    def check(self, stream: IO[bytes]) -> None:
        """Refuse what is beyond the limits; broken XML is left to its reader."""
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.CharacterDataHandler = self._characters
        parser.StartDoctypeDeclHandler = self._doctype
        fed = 0
        while data := stream.read(_CHUNK):
            try:
                parser.Parse(data, False)
            except expat.ExpatError:
                return
            fed += len(data)
            self._at_most(fed - parser.CurrentByteIndex, _LONGEST_ELEMENT, "bytes in an element")
            self._at_most(len(parser.intern), _MOST_NAMES, "names")

    def _at_most(self, count: int, most: int, what: str) -> None:
        if count > most:
            raise InputError(
                f"{self._where}: a workbook must have at most {most} {what}. {_ADVICE}"
            )

    def _doctype(self, *_: object) -> None:
        raise InputError(f"{self._where}: a workbook must not define a document type. {_ADVICE}")

    def _characters(self, text: str) -> None:
        self._text += len(text)
        self._at_most(self._text, _LONGEST_TEXT, "characters in a cell")

    def _start(self, tag: str, given: dict[str, str]) -> None:
        tag = tag.rpartition(":")[2]
        if tag in _CONTENTS:
            self._contents += 1
            most = _CONTENTS_OF_ONE * (self._counts["c"] + self._counts["si"]) + _MOST_FORMATS
            self._at_most(
                self._contents,
                most,
                f"parts in {self._counts['c'] + self._counts['si']} cells and texts",
            )
            return
        self._text = 0
        kind = tag if tag in MAX_COUNTS else ""
        self._counts[kind] += 1
        if kind == "c":
            self._cell(given.get("r", ""))
        elif kind == "row":
            self._new_row(given.get("r", ""))
        self._at_most(self._counts[kind], *MAX_COUNTS[kind])

    def _cell(self, place: str) -> None:
        letters = re.match("[A-Z]*", place)[0]  # type: ignore[index]
        column = sum((ord(x) - 64) * 26**i for i, x in enumerate(reversed(letters[:4])))
        self._column = column or self._column + 1
        if self._column > MAX_COLUMNS:
            raise InputError(
                f"{self._where}: a table must have at most {MAX_COLUMNS} columns; got a cell in "
                f"column {self._column}. Is this a run file?"
            )

    def _new_row(self, number: str) -> None:
        self._column = 0
        self._row = int(number[:12]) if number.isdecimal() else self._row + 1
        self._at_most(self._row, MAX_ROWS, "rows")
        self._at_most(self._row - self._counts["row"], MAX_BLANK_ROWS, "blank rows")


# A file must not depend on the hour it was written: the first day a ZIP archive can hold.
_EPOCH = datetime.datetime(1980, 1, 1)
_TIMES = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_EXPECTED = "an Excel workbook (.xlsx)", "Save it again as .xlsx, or as CSV UTF-8."
"""The expected form of a damaged file, and the remedy."""
LONGEST_CELL = 32_767
_LARGEST_KEPT = 4_000_000
"""Bytes of a workbook."""
_MOST_DIGITS = 15
_FORMULA = re.compile(rb"<(\w+:)?f[\s/>]")
_MERGED = re.compile(
    rb'<(?:\w+:)?mergeCell\s[^>]*ref="([A-Z]{1,3})(\d{1,7}):([A-Z]{1,3})(\d{1,7})"'
)
_NAMED = 5
"""Most cells that a message names."""
_UNWRITABLE = re.compile(r"[\x00-\x08\x0b-\x1f\ufffe\uffff]")

Row = tuple[int, Sequence[object]]


def parse(
    data: bytes, source: str, form: TableFormat | None = None, serial: str = "serial"
) -> Parts:
    """The table on the first sheet of a workbook; `form` says in which row it begins.

    `serial` is the name of the column of serials, which are read as the workbook shows them.
    """
    every = read_rows(data, source)
    rows = [row for row in every if form is None or _belongs(*row, form)]
    comments = list(takewhile(_is_comment, rows))
    table = rows[len(comments) :]
    width = len(table[0][1]) if table else 0
    padded = ((line, [*row, *[None] * (width - len(row))]) for line, row in table)
    metadata = meta.parse([(line, str(row[0]).strip()) for line, row in comments], source, "row")
    if form:
        above = [[as_text(cell) for cell in row] for line, row in every if line < form.header_line]
        metadata = {**stated_above(above).metadata, **metadata}
    names, cells, lines = assemble(padded, source, "row")
    named = zip(names, zip(*cells, strict=True), strict=True)
    columns = {name: typed(name, column) for name, column in named}
    if serial in columns and not all(isinstance(row[names.index(serial)], str) for row in cells):
        columns[serial] = _as_shown(data, source, serial, names.index(serial), lines)
    return Parts(columns, metadata, lines)


def _is_comment(row: Row) -> bool:
    return str(row[1][0]).lstrip().startswith("#")


def render(columns: Mapping[str, Column], metadata: Mapping[str, object], source: str) -> bytes:
    """The bytes that `parse` turns back into the same columns and metadata."""
    book = _module(source).Workbook(write_only=True)
    rows: list[Sequence[str | float]] = [[line] for line in meta.render(metadata)]
    rows += [plain_names(list(columns)), *zip(*columns.values(), strict=True)]
    _check_texts(rows, source)
    page = book.create_sheet("run")
    for row in rows:
        page.append([_cell(page, value) for value in row])
    stream = io.BytesIO()
    book.save(stream)
    return _timeless(stream)


def _module(source: str) -> Any:
    return extras.load("openpyxl", f"{source}: an Excel file", "xlsx")


def _belongs(line: int, row: Sequence[object], form: TableFormat) -> bool:
    """Whether a row holds metadata, the column names or readings."""
    metadata = line < form.header_line and is_metadata(str(row[0]).lstrip())
    return metadata or line == form.header_line or line >= form.first_line


def _as_shown(data: bytes, source: str, name: str, column: int, lines: Sequence[int]) -> list[str]:
    """The cells of a column, at these rows, as the workbook shows them: 12.1 may be there for 12.10."""
    page = (
        _module(source)
        .load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        .worksheets[0]
    )
    page.reset_dimensions()
    wanted, shown = {*lines}, []
    for line, (cell,) in enumerate(page.iter_rows(min_col=column + 1, max_col=column + 1), 1):
        if line in wanted:
            text = _shown(cell.value, cell.number_format if cell.value is not None else "General")
            if text is None:
                raise InputError(
                    f"{source}, row {line}, column '{name}': a serial must be text; the cell is a value that the "
                    f"workbook shows in the form {cell.number_format!r}. Format the column as text, and type the "
                    "serials as they stand on the tools."
                )
            shown.append(text)
    return shown


def _shown(value: object, form: str) -> str | None:
    """A cell as a number format shows it; None for a format that shows more than the digits of a number.

    >>> [_shown(12.1, form) for form in ("General", "0.00", "00000.0", "0%")]
    ['12.1', '12.10', '00012.1', None]
    """
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if form in ("General", "@"):
        return as_text(value)
    digits = re.fullmatch(r"(0+)(?:\.(0+))?", form)
    if digits is None:
        return None
    whole, decimals = len(digits[1]), len(digits[2] or "")
    return f"{value:0{whole + decimals + bool(decimals)}.{decimals}f}"


def _formulas_without_value(archive: zipfile.ZipFile, sheet: str) -> dict[str, str]:
    """Formulas by cell that no spreadsheet program has calculated; the cells look blank.

    One whose value is an empty text has one.
    """
    data = archive.read(sheet)
    without: dict[str, str] = {}
    if not _FORMULA.search(data):
        return without
    for _, cell in iterparse(io.BytesIO(data)):
        parts = {part.tag.rpartition("}")[2]: part.text for part in cell}
        if (
            cell.tag.endswith("}c")
            and "f" in parts
            and not parts.get("v")
            and cell.get("t") != "str"
        ):
            without[cell.get("r", "?")] = f"={parts['f'] or '…'}"
        if cell.tag.endswith("}row"):
            cell.clear()
    return without


def _check_formulas(without: Mapping[str, str], source: str) -> None:
    """Refuse formulas without a value."""
    if without:
        named = [f"{cell} ({formula})" for cell, formula in [*without.items()][:_NAMED]]
        more = f" and {len(without) - _NAMED} more" if len(without) > _NAMED else ""
        raise InputError(
            f"{source}: formulas without a value, in the cells {', '.join(named)}{more}. Name a copy "
            "that a spreadsheet program has saved: it calculates them."
        )


def read_rows(data: bytes, source: str) -> Sequence[Row]:
    """Row numbers and cells of the first sheet, without blank cells at the end and blank rows."""
    page = _book(data, source).page(0)
    _check_formulas(page.formulas, source)
    return page.rows


def read_sheets(data: bytes, source: str) -> Iterator[tuple[str, Iterator[Row], Merged, bool]]:
    """The names of all sheets, their rows as `read_rows` gives them, their merged cells, and whether each is hidden.

    A formula without a value is its text, which is no number: it may stand in a column that no one needs. A row that
    is struck out is one text.
    """
    book = _book(data, source)
    for place in range(book.count):
        page = book.page(place)
        each = ((n, _as_one_text(row) if n in page.struck else row) for n, row in page.rows)
        yield page.title, each, page.merged, page.hidden


class _ReadSheet(NamedTuple):
    """A sheet: its name, rows, merged cells, formulas without a value, rows struck out, and whether it is hidden."""

    title: str
    rows: Sequence[Row]
    merged: Merged
    formulas: Mapping[str, str]
    struck: Collection[int]
    hidden: bool


class _Book:
    """A workbook that is small enough; each of its sheets is read once."""

    def __init__(self, data: bytes, source: str) -> None:
        openpyxl = _module(source)
        with damaged_unless_read(source, *_EXPECTED), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._archive = zipfile.ZipFile(io.BytesIO(data))
            check(self._archive, source)
            self._book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        self.count = len(self._book.worksheets)
        self._source = source
        self._pages: dict[int, _ReadSheet] = {}

    def page(self, place: int) -> _ReadSheet:
        """The sheet at a place from 0."""
        if place not in self._pages:
            with damaged_unless_read(self._source, *_EXPECTED), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._pages[place] = self._read(self._book.worksheets[place])
        return self._pages[place]

    def _read(self, page: Any) -> _ReadSheet:
        path, book = page._worksheet_path, self._book
        merged = _merged(self._archive, path)
        formulas = _formulas_without_value(self._archive, path)
        rows = list(_rows(page, merged, formulas))
        struck = _struck_out(self._archive, path, book._fonts, book._cell_styles)
        return _ReadSheet(page.title, rows, merged, formulas, struck, page.sheet_state != "visible")


_last = lru_cache(maxsize=1)(_Book)


def _book(data: bytes, source: str) -> _Book:
    """A workbook; the last one is kept, unless it is large: a profile is proposed by all sheets and the first alone."""
    return (_last if len(data) <= _LARGEST_KEPT else _Book)(data, source)


def _as_one_text(row: Sequence[object]) -> Sequence[object]:
    return [f"struck out: {' '.join(map(as_text, row))}"]


def _struck_out(
    archive: zipfile.ZipFile, sheet: str, fonts: Sequence[Any], styles: Sequence[Any]
) -> set[int]:
    """The rows of a sheet of whose cells most are struck out."""
    struck = {n for n, style in enumerate(styles) if fonts[style.fontId].strike}
    if not struck:
        return set()
    rows = set[int]()
    for _, row in iterparse(io.BytesIO(archive.read(sheet))):
        if row.tag.endswith("}row"):
            filled = [cell for cell in row if len(cell)]
            out = sum(int(cell.get("s", 0)) in struck for cell in filled)
            if filled and 2 * out > len(filled):
                rows.add(int(row.get("r", 0)))
            row.clear()
    return rows


def _merged(archive: zipfile.ZipFile, sheet: str) -> Merged:
    """The merged cells of a sheet."""
    return [
        ((int(top), _place(first)), (int(bottom), _place(last)))
        for first, top, last, bottom in _MERGED.findall(archive.read(sheet))
    ]


def _place(letters: str | bytes) -> int:
    """The place from 0 of a column by its letters."""
    text = letters if isinstance(letters, str) else letters.decode()
    return sum((ord(x) - 64) * int(26**i) for i, x in enumerate(reversed(text))) - 1


def _rows(page: Any, merged: Merged, formulas: Mapping[str, str]) -> Iterator[Row]:
    """Row numbers and cells of a sheet that are not blank; a formula without a value is its text."""
    by_row = _by_row(formulas)
    page.reset_dimensions()
    rows = enumerate(page.iter_rows(values_only=True), 1)
    calculated = ((line, _with_formulas(row, by_row.get(line, {}))) for line, row in rows)
    for line, row in with_merged(calculated, merged):
        cells = _trimmed([_read(value) for value in row])
        if cells:
            yield line, cells


def _by_row(formulas: Mapping[str, str]) -> dict[int, dict[int, str]]:
    """Formulas by row from 1 and column from 0."""
    by_row: dict[int, dict[int, str]] = {}
    for cell, text in formulas.items():
        if match := re.fullmatch(r"([A-Z]{1,3})(\d{1,7})", cell):
            by_row.setdefault(int(match[2]), {})[_place(match[1])] = text
    return by_row


def _with_formulas(row: Sequence[object], formulas: Mapping[int, str]) -> Sequence[object]:
    """A row with the texts of formulas in their cells."""
    if not formulas:
        return row
    cells = [*row, *[None] * (max(formulas) + 1 - len(row))]
    for column, text in formulas.items():
        cells[column] = text if cells[column] is None else cells[column]
    return cells


def _read(value: object) -> object:
    """The value of a cell; a whole number of many digits as text, which loses none."""
    return str(value) if isinstance(value, int) and abs(value) >= 10**_MOST_DIGITS else value


def _trimmed(row: Sequence[object]) -> Sequence[object]:
    end = len(row)
    while end and (row[end - 1] is None or row[end - 1] == ""):
        end -= 1
    return row[:end]


def _check_texts(rows: Iterable[Sequence[str | float]], source: str) -> None:
    """Refuse text that a workbook cannot hold, before any of it is written."""
    for value in (value for row in rows for value in row if isinstance(value, str)):
        if len(value) > LONGEST_CELL or _UNWRITABLE.search(value):
            raise InputError(
                f"{source}: a cell of a workbook must be plain text of at most {LONGEST_CELL} "
                f"characters; got {value[:40]!r}. Write CSV or Parquet."
            )


def _cell(page: Any, value: str | float) -> Any:
    """A cell with all digits of a number, or text that stays text even if it looks like a number."""
    from openpyxl.cell import WriteOnlyCell

    content = value if isinstance(value, str) else number(value)
    if not content:
        return None
    cell = WriteOnlyCell(page, content)
    cell.data_type = "s" if isinstance(value, str) else "n"
    return cell


def _timeless(stream: io.BytesIO) -> bytes:
    """The same archive, its entries and properties dated `_EPOCH`."""
    result = io.BytesIO()
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(result, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "docProps/core.xml":
                content = _TIMES.sub(f"{_EPOCH.isoformat()}Z".encode(), content)
            entry = zipfile.ZipInfo(name, _EPOCH.timetuple()[:6])
            new.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return result.getvalue()
