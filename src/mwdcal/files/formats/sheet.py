"""The first sheet of a workbook, row by row: XML in bounded memory, whatever the archive holds.

Nothing is kept but the row at hand and the shared texts. What no spreadsheet program writes is
refused where it is met: documents that define entities, elements of a megabyte, cells beyond
`MAX_COLUMNS`, more cells than `MAX_CELLS`.
"""

from __future__ import annotations

import posixpath
import re
import zipfile
from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import cache
from typing import Any, NamedTuple
from xml.parsers import expat

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import MAX_COLUMNS

MAX_ROWS = 1_048_576
MAX_CELLS = 1_500_000
LONGEST_CELL = 32_767
_LARGEST_UNPACKED = 200_000_000
_MOST_STYLES = 100_000
_CHUNK = 1 << 16
_LONGEST_ELEMENT = 1 << 20
_MOST_NAMES = 10_000
_LETTERS = re.compile("[A-Z]{1,3}")

Row = tuple[int, Sequence[object]]
Event = tuple[str, dict[str, str] | str | None]
"""A tag without its namespace and its attributes, None where it ends; or '' and text."""


class _Formats(NamedTuple):
    """Which styles show a number as a date or a duration, and the day that they count from."""

    dates: frozenset[str]
    durations: frozenset[str]
    epoch: datetime


def rows(archive: zipfile.ZipFile, source: str) -> Iterator[Row]:
    """Number and cells of each row of the first sheet, without the blank cells at its end."""
    _check_size(archive, source)
    book = _target(archive, "", "officeDocument", source)
    sheet, from_1904 = _first_sheet(archive, book, source)
    strings = _target(archive, book, "sharedStrings", source)
    styles = _target(archive, book, "styles", source)
    texts = list(_texts(archive, strings, source)) if strings else []
    reader = _Rows(source, texts, _formats(archive, styles, from_1904, source))
    for _ in _fed(reader.parser(), archive, sheet, source):
        yield from reader.done
        reader.done.clear()


def _check_size(archive: zipfile.ZipFile, source: str) -> None:
    """Refuse an archive that would unpack to more than any run needs."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > _LARGEST_UNPACKED:
        raise InputError(
            f"{source}: a workbook must unpack to at most {_LARGEST_UNPACKED} bytes; "
            f"got {size}. Save the sheet with the run alone, or as CSV UTF-8."
        )


def _fed(parser: Any, archive: zipfile.ZipFile, path: str, source: str) -> Iterator[None]:
    """The parser through a part, a chunk at a time."""

    def refuse(*_: object) -> None:
        raise InputError(
            f"{source}: a workbook must not define a document type; {path} does. Save it again "
            "with a spreadsheet program."
        )

    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = refuse
    fed = 0
    with archive.open(path) as stream:
        while data := stream.read(_CHUNK):
            parser.Parse(data, False)
            fed += len(data)
            if fed - parser.CurrentByteIndex > _LONGEST_ELEMENT or len(parser.intern) > _MOST_NAMES:
                raise InputError(
                    f"{source}: a workbook must have elements of at most {_LONGEST_ELEMENT} bytes "
                    f"and {_MOST_NAMES} names; {path} has more. Save it again with a spreadsheet "
                    "program."
                )
            yield
    parser.Parse(b"", True)
    yield


def _events(archive: zipfile.ZipFile, path: str, source: str) -> Iterator[Event]:
    """The elements of a part in order, each as it starts and as it ends, and text between."""
    events: list[Event] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, given: events.append((_local(tag), given))
    parser.EndElementHandler = lambda tag: events.append((_local(tag), None))
    parser.CharacterDataHandler = lambda text: events.append(("", text))
    for _ in _fed(parser, archive, path, source):
        yield from events
        events.clear()


def _local(tag: str) -> str:
    """A tag without the prefix of its namespace."""
    return tag.rpartition(":")[2] if ":" in tag else tag


def _relations(archive: zipfile.ZipFile, part: str, source: str) -> Iterator[tuple[str, str, str]]:
    """Id, kind and path of what a part refers to; of the whole workbook where it is ''."""
    folder, name = posixpath.split(part)
    path = posixpath.join(folder, "_rels", f"{name}.rels")
    if path not in archive.NameToInfo:
        return
    for tag, given in _events(archive, path, source):
        if tag == "Relationship" and isinstance(given, dict):
            target = posixpath.normpath(posixpath.join("/", folder, given.get("Target", "")))
            kind = given.get("Type", "").rpartition("/")[2]
            yield given.get("Id", ""), kind, target.lstrip("/")


def _target(archive: zipfile.ZipFile, part: str, wanted: str, source: str) -> str:
    """The path of the part of this kind that a part refers to; '' where there is none."""
    paths = (path for _, kind, path in _relations(archive, part, source) if kind == wanted)
    return next(paths, "")


def _first_sheet(archive: zipfile.ZipFile, book: str, source: str) -> tuple[str, bool]:
    """The path of the first sheet with cells, and whether dates of the workbook count from 1904."""
    kinds = {name: (kind, path) for name, kind, path in _relations(archive, book, source)}
    first, from_1904 = "", False
    for tag, given in _events(archive, book, source):
        if not isinstance(given, dict):
            continue
        if tag == "workbookPr":
            from_1904 = given.get("date1904", "0") in ("1", "true")
        elif tag == "sheet" and not first:
            named = next((v for k, v in given.items() if _local(k) == "id"), "")
            kind, path = kinds.get(named, ("", ""))
            first = path if kind == "worksheet" else ""
    if not first:
        raise InputError(f"{source}: the workbook has no sheet with cells. Save the run in one.")
    return first, from_1904


def _texts(archive: zipfile.ZipFile, path: str, source: str) -> Iterator[str]:
    """The texts that cells refer to by number, without formats and phonetic signs."""
    count, text = 0, _Text(source)
    for tag, given in _events(archive, path, source):
        if tag == "":
            text.add(str(given))
        elif tag in ("t", "rPh"):
            text.mark(tag, given is not None, "t")
        elif tag == "si" and given is None:
            count += 1
            if count > MAX_CELLS // 2:
                raise InputError(
                    f"{source}: a workbook must have at most {MAX_CELLS // 2} texts. Split it, or "
                    "save the sheet with the run as CSV UTF-8."
                )
            yield text.taken()


class _Text:
    """The text of a cell as it is gathered, of elements of one tag outside phonetic signs."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._parts: list[str] = []
        self._size = 0
        self._open = self._spoken = False

    def mark(self, tag: str, begins: bool, wanted: str) -> None:
        """An element begins or ends; text counts within the `wanted` ones."""
        if tag == "rPh":
            self._spoken = begins
        self._open = begins and tag == wanted and not self._spoken

    def add(self, text: str) -> None:
        """Text between elements; refuses more than a cell may have."""
        if not self._open:
            return
        self._parts.append(text)
        self._size += len(text)
        if self._size > LONGEST_CELL:
            raise InputError(
                f"{self._source}: a cell of a workbook must have at most {LONGEST_CELL} "
                "characters. Shorten the longest text, or write CSV or Parquet."
            )

    def taken(self) -> str:
        """The text so far; that of the next cell begins."""
        text = "".join(self._parts)
        self._parts.clear()
        self._size = 0
        return text


def _formats(archive: zipfile.ZipFile, path: str, from_1904: bool, source: str) -> _Formats:
    """What the styles say of numbers."""
    from openpyxl.styles.numbers import BUILTIN_FORMATS, is_date_format, is_timedelta_format
    from openpyxl.utils.datetime import MAC_EPOCH, WINDOWS_EPOCH

    codes: dict[int, str] = dict(BUILTIN_FORMATS)
    used: list[int] = []
    inside = False
    for tag, given in _events(archive, path, source) if path else ():
        if tag == "cellXfs":
            inside = given is not None
        elif tag == "numFmt" and isinstance(given, dict):
            codes[int(given.get("numFmtId", 0))] = given.get("formatCode", "")
        elif tag == "xf" and inside and isinstance(given, dict):
            used.append(int(given.get("numFmtId", 0)))
        if len(used) + len(codes) > _MOST_STYLES:
            raise InputError(
                f"{source}: a workbook must have at most {_MOST_STYLES} styles. Save the sheet "
                "with the run alone, or as CSV UTF-8."
            )
    dates = {k for k, code in codes.items() if is_date_format(code)}
    durations = {k for k, code in codes.items() if is_timedelta_format(code)}
    return _Formats(
        frozenset(str(i) for i, k in enumerate(used) if k in dates),
        frozenset(str(i) for i, k in enumerate(used) if k in durations),
        MAC_EPOCH if from_1904 else WINDOWS_EPOCH,
    )


class _Rows:
    """Takes the elements of a sheet, and puts whole rows into `done`: number and cells."""

    def __init__(self, source: str, texts: Sequence[str], formats: _Formats) -> None:
        self.done: list[Row] = []
        self._source, self._texts, self._formats = source, texts, formats
        self._number = self._column = self._count = 0
        self._kind, self._style, self._wanted = "n", "", "v"
        self._text = _Text(source)
        self._cells: list[object] = []

    def parser(self) -> Any:
        """A parser that hands its elements to this."""
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.CharacterDataHandler = self._text.add
        parser.EndElementHandler = self._end
        return parser

    def _start(self, tag: str, given: dict[str, str]) -> None:
        tag = _local(tag)
        if tag == "c":
            self._kind, self._style = given.get("t", "n"), given.get("s", "")
            self._wanted = "t" if self._kind == "inlineStr" else "v"
            self._column = _column(given["r"]) if "r" in given else self._column + 1
        elif tag == "row":
            self._number, self._column = self._row_number(given), 0
        else:
            self._text.mark(tag, True, self._wanted)

    def _end(self, tag: str) -> None:
        tag = _local(tag)
        if tag == "c":
            content = self._text.taken()
            if content:
                self._keep(self._value(content))
        elif tag == "row":
            self.done.append((self._number, self._cells))
            self._cells = []
        else:
            self._text.mark(tag, False, self._wanted)

    def _row_number(self, given: dict[str, str]) -> int:
        number = int(float(given.get("r", self._number + 1)))
        if number > MAX_ROWS:
            raise InputError(
                f"{self._source}: a sheet must have at most {MAX_ROWS} rows. Split it."
            )
        if number <= self._number:
            raise ValueError(f"row {number} after row {self._number}")
        return number

    def _keep(self, value: object) -> None:
        """A cell at its place in the row."""
        if value == "":
            return
        if self._column > MAX_COLUMNS:
            raise InputError(
                f"{self._source}, row {self._number}: a table must have at most {MAX_COLUMNS} "
                f"columns; got a cell in column {self._column}. Is this a run file?"
            )
        self._count += 1
        if self._count > MAX_CELLS:
            raise InputError(
                f"{self._source}: a sheet must have at most {MAX_CELLS} cells. Split it, or save "
                "it as CSV UTF-8."
            )
        lacking = self._column - len(self._cells)
        self._cells += [None] * lacking
        self._cells[self._column - 1] = value

    def _value(self, text: str) -> object:
        """What a cell holds: text, number, truth value, date or time."""
        if self._kind == "n":
            value = _numeric(text)
            dated = self._style in self._formats.dates and isinstance(value, float)
            return _date(value, self._style, self._formats) if dated else value
        if self._kind == "s":
            return self._texts[int(text)]
        if self._kind == "b":
            return bool(int(text))
        return _iso_date(text) if self._kind == "d" else text


@cache
def _letters(name: str) -> int:
    """The number of a column by its letters, at most three."""
    if not _LETTERS.fullmatch(name):
        raise ValueError(f"no column is called {name[:20]}")
    return sum((ord(letter) - 64) * 26**i for i, letter in enumerate(reversed(name)))


def _column(place: str) -> int:
    """The number of the column of a cell such as AB12."""
    return _letters(place.rstrip("0123456789"))


def _numeric(text: str) -> float | str:
    """A number; a whole one of many digits as text, which loses none."""
    if len(text) > 15 and text.strip().lstrip("-").isdigit():
        return text
    value = float(text)
    if value != value or "_" in text:
        raise ValueError(f"no number: {text[:20]}")
    return value


def _date(value: Any, style: str, formats: _Formats) -> object:
    """The date, time or duration that a number stands for."""
    from openpyxl.utils.datetime import from_excel

    try:
        return from_excel(value, formats.epoch, timedelta=style in formats.durations)
    except (OverflowError, ValueError):
        return "#VALUE!"


def _iso_date(text: str) -> object:
    from openpyxl.utils.datetime import from_ISO8601

    return from_ISO8601(text)
