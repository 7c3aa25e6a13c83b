"""Tables as loggers and spreadsheet programs export them: how one is written, and reading it so.

An export may have another encoding, delimiter and decimal sign than a run file, lines above its
column names, and a line of units below them. `layout` finds this out; `plain` makes of an export the text of a
run file whose lines keep their numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import looks_numeric
from mwdcal.sensor.profile import TableFormat

_FOREIGN_WORDS = {
    "cp1251": re.compile(
        "азимут|зенит|темп|прибор|дата|угол|ускор|магн|поле|точк|номер|град|станц", re.IGNORECASE
    ),
    "gb18030": re.compile("角|温度|磁|加速度|日期|序|编号|工具|方位|井斜|重力|标定|仪器"),
    "cp932": re.compile("角|温度|磁|加速度|日付|番号|センサ|ツール|方位|傾斜|重力|校正|機器|測定"),
    "cp1250": re.compile(
        "kąt|narzędz|świadec|całkow|przyśp|ciąż|położ|ferdeség|térerő|nehézségi|hőmérs|jegyző|gyorsulás|mágnes|"
        "szerszám|úhel|sklon|zrychlen|teplot|měř|číslo|înclin|unghi|câmp|ubrzan|kut|mjer|naklon",
        re.IGNORECASE,
    ),
    "cp1254": re.compile(
        "eğim|sıra|sıcaklık|takım|açıklama|ivme|yüzü|yönelim|ölçüm|kalibrasyon|yerçekimi",
        re.IGNORECASE,
    ),
}
"""Encodings without a mark, and words of the field that show them: single bytes may be ° or ü of another."""

Rows = Sequence[Sequence[str]]


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
    """The encoding of a text: UTF-16 by its mark, UTF-8 where it is valid, else by its words; cp1252 by default."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        counts = {e: _words_in(data, e, words) for e, words in _FOREIGN_WORDS.items()}
        best = max(counts, key=lambda e: counts[e])
        return best if counts[best] else "cp1252"
    return "utf-8"


def _words_in(data: bytes, encoding: str, words: re.Pattern[str]) -> int:
    """The different words of the field that some bytes hold in an encoding, of which some are no ASCII."""
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        return 0
    every = {word.lower() for word in words.findall(text)}
    return len(every) if any(not word.isascii() for word in every) else 0


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


def cells_of(
    lines: Sequence[str], delimiter: str, source: str, *, skip_blanks: bool = False
) -> Rows:
    """The cells of each line; `skip_blanks` before a cell, which may be in quotes behind them."""
    try:
        return [
            next(csv.reader([line], delimiter=delimiter, skipinitialspace=skip_blanks), [])
            for line in lines
        ]
    except csv.Error as error:
        raise InputError(
            f"{source}: the file is no table of text ({error}). Name the file with the readings."
        ) from None


def _is_number(cell: str) -> bool:
    return looks_numeric(cell.strip()) or looks_numeric(cell.strip(), ",")


def holds_numbers(row: Sequence[str]) -> bool:
    """Whether at least half of a row's cells that are filled in are numbers, and any.

    >>> [holds_numbers(row) for row in (["P1", "0.1"], ["", "mg", "°"], [""])]
    [True, False, False]
    """
    numbers = sum(map(_is_number, row))
    return numbers > 0 and 2 * numbers >= sum(bool(cell.strip()) for cell in row)


def above(data: bytes, form: TableFormat, source: str) -> Rows:
    """The lines above the column names."""
    lines = decoded(data, form.encoding, source).split("\n")
    return cells_of(lines[: form.header_line - 1], form.delimiter, source)


def below_names(data: bytes, form: TableFormat, source: str) -> Rows:
    """The names of the columns, and the lines between them and the first readings."""
    lines = decoded(data, form.encoding, source).split("\n")
    return cells_of(lines[form.header_line - 1 : form.first_line - 1], form.delimiter, source)
