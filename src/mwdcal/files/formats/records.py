"""Texts that hold a table without being one: a page of HTML, Excel's XML, lines of names with values.

Programs write the first two under the name of an old workbook, loggers the last: JSON, `STN=1 INC=30.0`, or a line for
each value. All of them become rows of cells below names.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from html.parser import HTMLParser
from itertools import pairwise
from xml.etree import ElementTree

from mwdcal.errors import InputError
from mwdcal.files.formats import figures

Rows = list[tuple[int, list[object]]]
_LEAST_PAIRS, _LEAST_RECORDS = 4, 5
"""Names with values in a record at least, and records of the same names."""
_PAIR_IN_LINE = re.compile(
    r"(?<![^\s,;|])([^\W\d_][\w./°-]*)\s*[=:]\s*"
    r"(\d{1,2}:\d{2}(?::\d{2})?|[+−-]?[\w.,+−-]*\w)(?=[\s,;|]|$)"
)
_TIME_BEFORE = re.compile(
    r"\W*(\d{1,4}([-./])\d{1,2}\2\d{1,4})?[T ,;]*(\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?)?Z?[\s,;|\]]+"
)
"""A day, a time or both before the first name of a line."""
_LABEL_BEFORE = re.compile(r"\W*([^\W\d_]*[\s#_-]*\d+)\s*[:：]\s*(?=[^\W\d_])")
"""The number of a station before the first name of a line: P01: Inc=30.0."""
_ROW_OF_AXES = re.compile(
    r"((?:[xyz]\s*[=:]?\s*[+−-]?\d+(?:[.,]\d+)?[\s,;]*){3})([^\W\d_][\w/²]{0,5})?", re.IGNORECASE
)
"""The values of three axes in a row, and their unit: X 0.01 Y -0.02 Z 0.99 g."""
_PAIR_ALONE = re.compile(r"\s*([^\W\d_][^=:;]{0,30}?)\s*[=:]\s*(\S.*?)\s*")
_SPREADSHEET = "{urn:schemas-microsoft-com:office:spreadsheet}"
IS_XML = _SPREADSHEET[1:-1].encode()
"""The name space in the first lines of a workbook in Excel's XML of 2003."""


def rows_of_records(lines: Sequence[str]) -> Rows | None:
    """The rows of a text of records, names above the first; None of any other text.

    >>> rows_of_records(["probe 7", *(f"N={n} AX=0.1 AY=0.2 AZ=0.9" for n in range(1, 6))])[:3]
    [(1, ['probe 7']), (2, ['N', 'AX', 'AY', 'AZ']), (2, ['1', '0.1', '0.2', '0.9'])]
    """
    by_line = {n: named for n, line in enumerate(lines, 1) if (named := _record(line))}
    each = by_line or _records_by_lines(lines)
    names = Counter(tuple(record) for record in each.values())
    usual, count = names.most_common(1)[0] if names else ((), 0)
    if count < _LEAST_RECORDS or len(usual) < _LEAST_PAIRS or 2 * count < len(each):
        return None
    rows: Rows = []
    inside = False
    for n, line in enumerate(lines, 1):
        record = each.get(n)
        if record and {*record} <= {*usual}:
            rows += [] if inside else [(n, [*usual])]
            rows.append((n, [record.get(name, "") for name in usual]))
            inside = True
        elif record:
            rows.append((n, [f"{name}: {value}" for name, value in record.items()]))
        elif (words := line.strip(" \t\r/#%*")) and not inside:
            rows.append((n, [words]))
    return rows


def _record(line: str) -> dict[str, object]:
    """The names with values of one line; empty where it has no record."""
    if line.lstrip().startswith("{"):
        with suppress(ValueError, RecursionError):
            record = json.loads(line.strip().rstrip(","))
            return {key: _cell(value) for key, value in record.items()}
    time = match[0] if (match := _TIME_BEFORE.match(line)) else ""
    line = line[len(time) :]
    label = _LABEL_BEFORE.match(line)
    line = line[label.end() if label else 0 :]
    pairs = _PAIR_IN_LINE.findall(line)
    named: dict[str, object] = dict(pairs)
    numbers = sum(map(figures.is_figure, named.values()))
    whole = len(named) == len(pairs) >= _LEAST_PAIRS and 2 * numbers >= len(pairs)
    if not whole or re.search(r"[^\s,;|]", _PAIR_IN_LINE.sub(" ", line)):
        return {}
    before = {"Time": time.strip()} if re.search(r"\d", time) else {}
    return before | ({"Station": label[1]} if label else {}) | named


def _cell(value: object) -> object:
    return value if isinstance(value, str | int | float) else "" if value is None else str(value)


def _records_by_lines(lines: Sequence[str]) -> dict[int, dict[str, object]]:
    """Records of which each name stands with its value in a line of its own, by the line of the first."""
    pairs = [
        (n, *pair)
        for n, text in enumerate(lines, 1)
        if (m := _PAIR_ALONE.fullmatch(text))
        for pair in _by_axis(m[1], m[2])
    ]
    counts = Counter(name for _, name, _ in pairs)
    repeated = [(n, name, value) for n, name, value in pairs if counts[name] >= _LEAST_RECORDS]
    if not repeated:
        return {}
    usual = Counter(counts[name] for _, name, _ in repeated).most_common(1)[0][0]
    first = next(name for _, name, _ in repeated if counts[name] == usual)  # others: titles, too
    starts = [k for k, (_, name, _) in enumerate(repeated) if name == first]
    return {
        repeated[one][0]: {name: value for _, name, value in repeated[one:other]}
        for one, other in pairwise([*starts, len(repeated)])
    }


def _by_axis(name: str, value: str) -> list[tuple[str, str]]:
    """A name with its value, or three of them where the values of three axes stand in a row.

    >>> _by_axis("Accel (g)", "X 0.01 Y -0.02  Z 0.99")
    [('Accel X (g)', '0.01'), ('Accel Y (g)', '-0.02'), ('Accel Z (g)', '0.99')]
    """
    row = _ROW_OF_AXES.fullmatch(value)
    if not row:
        return [(name, value)]
    words, _, unit = name.rstrip(")] ").partition("(" if "(" in name else "[")
    unit = f" ({unit or row[2]})" if unit or row[2] else ""
    each = re.findall(r"([xyzXYZ])\s*[=:]?\s*([^\s;=:xyzXYZ]*[^\s;,])", row[1])
    return [(f"{words.strip()} {axis}{unit}", number) for axis, number in each]


class _Page(HTMLParser):
    """The cells of all tables of a page, and its other texts, row by row."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.rows: list[list[object]] = []
        self.cell: list[str] | None = None
        self.hidden = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.close_cell()
            self.cell = []
            span = dict(attrs).get("colspan") or ""
            self.span = min(int(span), 100) if span.isdecimal() else 1
        elif tag in ("style", "script", "title"):
            self.hidden = tag

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "tr", "table"):
            self.close_cell()
        if tag == self.hidden:
            self.hidden = ""

    def handle_data(self, data: str) -> None:
        if self.cell is not None:
            self.cell.append(data)
        elif data.strip() and not self.hidden:
            self.rows.append([" ".join(data.split())])

    def close_cell(self) -> None:
        """End the cell that is open: of one over several columns the others are blank."""
        if self.cell is not None and self.rows:
            self.rows[-1] += [" ".join("".join(self.cell).split()), *[""] * (self.span - 1)]
        self.cell = None


def rows_of_page(text: str) -> Rows:
    """The rows of all tables of a page of HTML, and its other texts."""
    page = _Page()
    page.feed(text)
    page.close()
    return [(n, row) for n, row in enumerate(page.rows, 1) if any(row)]


def sheets_of_xml(data: bytes, source: str) -> Iterator[tuple[str, Rows]]:
    """The sheets of a workbook in Excel's XML of 2003: name and rows of each.

    Raises:
        InputError: it is damaged, or defines entities.
    """
    try:
        if b"<!" in data.replace(b"<!--", b""):
            raise ElementTree.ParseError("it has a document type")
        book = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(
            f"{source}: expected a workbook in XML; reading it failed ({error}). Save it again as .xlsx."
        ) from None
    for page in book.iter(f"{_SPREADSHEET}Worksheet"):
        rows: Rows = []
        for number, row in _indexed(page.iter(f"{_SPREADSHEET}Row")):
            cells: dict[int, object] = {
                place: _value(cell.find(f"{_SPREADSHEET}Data"))
                for place, cell in _indexed(row.iter(f"{_SPREADSHEET}Cell"))
            }
            if cells and max(cells) <= _WIDEST_SHEET:
                rows.append((number, [cells.get(k, "") for k in range(1, max(cells) + 1)]))
        yield page.get(f"{_SPREADSHEET}Name", ""), [r for r in rows if any(c != "" for c in r[1])]


_WIDEST_SHEET = 16_384
"""Columns of a sheet at most."""


def _indexed(
    elements: Iterator[ElementTree.Element],
) -> Iterator[tuple[int, ElementTree.Element]]:
    """Elements with their number from 1, which one may state."""
    place = 0
    for element in elements:
        stated = element.get(f"{_SPREADSHEET}Index", "")
        place = int(stated) if stated.isdecimal() else place + 1
        yield place, element


def _value(data: ElementTree.Element | None) -> object:
    """The value of a cell: a number, or text."""
    text = "".join(data.itertext()).strip() if data is not None else ""
    if data is not None and data.get(f"{_SPREADSHEET}Type") == "Number":
        with suppress(ValueError):
            return float(text)
    return text
