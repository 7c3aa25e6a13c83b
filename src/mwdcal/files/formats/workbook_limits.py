"""What a workbook may hold, checked in one pass over its XML before a library reads it.

A small archive can unpack to gigabytes of objects: cells far to the right, rows far below, floods
of attributes or elements, entities. No spreadsheet program writes such files.
"""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from typing import IO
from xml.parsers import expat

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import MAX_COLUMNS

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
        """Refuse what is beyond the limits; XML that is none is left to its reader."""
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
