"""XLSX: the first sheet; metadata in leading rows whose first cell starts with '#'."""

from __future__ import annotations

import datetime
import io
import re
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import takewhile
from typing import Any
from xml.etree.ElementTree import iterparse

from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.formats import workbook_limits
from mwdcal.files.formats.columns import (
    Column,
    Parts,
    as_text,
    assemble,
    damaged_unless_read,
    number,
    plain_names,
    typed,
)
from mwdcal.files.formats.dialect import is_metadata
from mwdcal.files.formats.title_references import stated_above
from mwdcal.sensor.profile import TableFormat

# A file must not depend on the hour it was written: the first day a ZIP archive can hold.
_EPOCH = datetime.datetime(1980, 1, 1)
_TIMES = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_EXPECTED = "an Excel workbook (.xlsx)", "Save it again as .xlsx, or as CSV UTF-8."
"""The expected form of a damaged file, and the remedy."""
LONGEST_CELL = 32_767
_MOST_DIGITS = 15
_FORMULA = re.compile(rb"<(\w+:)?f[\s/>]")
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
    every = list(read_rows(data, source))
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
    try:
        import openpyxl
    except ImportError:
        raise InputError(
            f"{source}: Excel files need the extra 'xlsx'. "
            'Install it with: pip install "mwdcal[xlsx]"'
        ) from None
    return openpyxl


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


def _check_formulas(archive: zipfile.ZipFile, sheet: str, source: str) -> None:
    """Refuse formulas without a value: no spreadsheet program has calculated them, and the cells look blank.

    One whose value is an empty text has one.
    """
    data = archive.read(sheet)
    if not _FORMULA.search(data):
        return
    without = []
    for _, cell in iterparse(io.BytesIO(data)):
        parts = {part.tag.rpartition("}")[2]: part.text for part in cell}
        if (
            cell.tag.endswith("}c")
            and "f" in parts
            and not parts.get("v")
            and cell.get("t") != "str"
        ):
            without.append(f"{cell.get('r', '?')} (={parts['f'] or '…'})")
        if cell.tag.endswith("}row"):
            cell.clear()
    if without:
        more = f" and {len(without) - _NAMED} more" if len(without) > _NAMED else ""
        raise InputError(
            f"{source}: formulas without a value, in the cells {', '.join(without[:_NAMED])}{more}. Name a copy "
            "that a spreadsheet program has saved: it calculates them."
        )


def read_rows(data: bytes, source: str) -> Iterator[Row]:
    """Row numbers and cells of the first sheet, without blank cells at the end and blank rows."""
    with _opened(data, source) as (archive, book):
        yield from _rows(archive, book.worksheets[0], source)


def read_sheets(data: bytes, source: str) -> Iterator[tuple[str, Iterator[Row]]]:
    """The names of all sheets, and their rows as `read_rows` gives them: each to be read before the next."""
    with _opened(data, source) as (archive, book):
        for page in book.worksheets:
            yield page.title, _rows(archive, page, source)


@contextmanager
def _opened(data: bytes, source: str) -> Iterator[tuple[zipfile.ZipFile, Any]]:
    """The archive of a workbook that is small enough, and the workbook."""
    openpyxl = _module(source)
    with (
        damaged_unless_read(source, *_EXPECTED),
        warnings.catch_warnings(),
        zipfile.ZipFile(io.BytesIO(data)) as archive,
    ):
        warnings.simplefilter("ignore")
        workbook_limits.check(archive, source)
        yield archive, openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)


def _rows(archive: zipfile.ZipFile, page: Any, source: str) -> Iterator[Row]:
    """Row numbers and cells of a sheet that are not blank."""
    with damaged_unless_read(source, *_EXPECTED):
        _check_formulas(archive, page._worksheet_path, source)
        page.reset_dimensions()
        for line, row in enumerate(page.iter_rows(values_only=True), 1):
            cells = _trimmed([_read(value) for value in row])
            if cells:
                yield line, cells


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
