"""The sheets of a file of any form that tables come in: text, workbooks of three kinds."""

from __future__ import annotations

import io
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.formats import figures, records, text
from mwdcal.files.formats.columns import WORKBOOKS, at_most, damaged_unless_read, with_merged
from mwdcal.files.formats.encodings import encoding_of
from mwdcal.files.formats.layout import LEAST_COLUMNS, Cells, Sheet, is_units
from mwdcal.files.synonyms import unit_of
from mwdcal.sensor.profile import TableFormat

DELIMITERS = (";", "\t", ",", "|")
_DRAWN = re.compile("[│┃║]")
_BAR = re.compile(r"(?<!\S)\|(?!\S)")
_FRAME = "!"
"""The sign that old programs draw between columns."""
_BLANKS, _RUNS = "blanks", "runs of blanks"
_SIXTIETHS = re.compile(r"[-−]?\d{1,3} [0-5]\d [0-5]\d([.,]\d+)?")
"""Degrees, minutes and seconds in one cell, which are three numbers wherever blanks part cells."""
_LOOKED_AT = 400
"""Most lines that tell the delimiter of a text, and most characters that tell a page."""
_ARCHIVES = (b"\xd0\xcf\x11\xe0", b"PK")
"""First bytes of workbooks; some programs name pages and texts .xls."""
_IS_PAGE = re.compile(r"<(html|table|!doctype html)\b", re.IGNORECASE)
_LEAST_ROWS = 4
"""Rows from which on columns of a text show by where they stand."""
_LARGEST_CONTENTS = 100_000_000
_REPEATED = re.compile(rb'number-(?:rows|columns)-repeated="(\d+)"')
_MOST_REPEATED = 1_100_000
_MOST_CELLS = 3_000_000


def sheets_of(data: bytes, name: str) -> list[Sheet]:
    """The sheets in the bytes of a file of that name.

    Raises:
        InputError: it is damaged, too large, or needs a package that is not installed.
    """
    suffix = Path(name).suffix.lower()
    if suffix == ".xlsx":
        from mwdcal.files.formats import workbook

        pages = workbook.read_sheets(data, name)
        return [
            Sheet(title, _rows(page), number=n, merged=merged, hidden=hidden)
            for n, (title, page, merged, hidden) in enumerate(pages)
        ]
    if records.IS_XML in data[:_LOOKED_AT]:
        pages_of_xml = enumerate(records.sheets_of_xml(data, name))
        return [Sheet(title, _rows(rows), number=n) for n, (title, rows) in pages_of_xml]
    if suffix in WORKBOOKS and (suffix != ".xls" or data.startswith(_ARCHIVES)):
        return list(_by_calamine(data, name))
    text.refuse_foreign(data, name, allowed=text.UTF_16)
    encoding = encoding_of(data)
    content = text.decoded(data, encoding, name)
    if _IS_PAGE.search(content[:_LOOKED_AT]):
        return [Sheet("", _rows(records.rows_of_page(content)))]
    lines = _DRAWN.sub("|", content).split("\n")
    if rows_of_records := records.rows_of_records(lines):
        return [Sheet("", _rows(rows_of_records))]
    mark, rows = _delimited(lines, name)
    form = TableFormat(encoding=encoding, delimiter=mark if mark in DELIMITERS else ",")  # type: ignore[arg-type]
    return [Sheet("", rows, form)]


def _rows(rows: Iterable[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    return [(line, _plain(row)) for line, row in rows]


def _plain(row: Cells) -> list[object]:
    """Cells of a row, blank ones as empty text, and text without blanks around."""
    return ["" if c is None else c.strip() if isinstance(c, str) else c for c in row]


def _delimited(lines: Sequence[str], source: str) -> tuple[str, list[tuple[int, Cells]]]:
    """The delimiter of a text by which most numbers show, and its rows by it."""
    looked_at = lines[:_LOOKED_AT]
    drawn = (*DELIMITERS, _FRAME)
    marks = (*drawn, _RUNS, _BLANKS)
    first = {mark: _split(looked_at, mark, source) for mark in marks}
    counts = {mark: _numbers(rows) for mark, rows in first.items()}
    best = max(drawn, key=lambda mark: counts[mark])
    if 2 * counts[best] < max(counts.values()):  # blanks may stand within cells
        best = max(marks, key=lambda mark: counts[mark])
    if best == _RUNS and _is_named(first[_BLANKS]) and not _is_named(first[_RUNS]):
        best = _BLANKS
    cells = _split(lines, best, source)
    if best in (_BLANKS, _RUNS):
        cells = _in_columns(lines, _without_marks(cells))
    return best, [(line, _trimmed(row)) for line, row in enumerate(cells, 1) if any(row)]


def _is_named(rows: Sequence[list[str]]) -> bool:
    """Whether one of the two rows above the first numbers is of as many texts as most rows have cells."""
    rows = [row for row in _without_marks(rows) if row]
    widths = Counter(len(row) for row in rows if _is_of_numbers(row)).most_common(1)
    first = next((k for k, row in enumerate(rows) if _is_of_numbers(row)), 0)
    return any(
        bool(widths) and len(row) == widths[0][0] and not any(map(figures.is_figure, row))
        for row in rows[max(0, first - 2) : first]
    )


def _without_marks(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows without the mark of a comment before names, of which there is one cell more than of readings."""
    widths = Counter(len(row) for row in rows if _is_of_numbers(row))
    usual = widths.most_common(1)[0][0] if widths else 0
    return [
        row[1:] if len(row) == usual + 1 and re.fullmatch(r"[#%;!/*]+", row[0]) else row
        for row in rows
    ]


def _in_columns(lines: Sequence[str], rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows of a text whose columns stand one below the other, each cell of a shorter row in its own column.

    A row of units, or one with a blank cell, has fewer cells than the others. Where columns overlap, or the cells of
    a row are not each below another column, the rows stay as they are.
    """
    spans = [_spans(line, row) for line, row in zip(lines, rows, strict=True)]
    numbered = [s for s, row in zip(spans, rows, strict=True) if _is_of_numbers(row)]
    usual = Counter(map(len, numbered)).most_common(1)
    width = usual[0][0] if usual else 0
    whole = [s for s in numbered if len(s) == width]
    columns = _common(whole)
    if len(whole) < _LEAST_ROWS or _overlap(columns):
        return [*rows]
    named = _common([s for s in spans if len(s) == width])
    columns = columns if _overlap(named) else named
    placed = [_placed(row, each, columns) for row, each in zip(rows, spans, strict=True)]
    first = next(k for k, row in enumerate(rows) if _is_of_numbers(row))
    words = " ".join(placed[first - 1]).split() if first else []
    if len(placed[first - 1]) < len(words) == width and not any(map(figures.is_figure, words)):
        placed[first - 1] = words  # names above the first row, not all two blanks apart
    return placed


def _common(rows: Sequence[Sequence[tuple[int, int]]]) -> list[tuple[int, int]]:
    """Where the columns of rows begin and end, by those of their cells."""
    return [(min(a for a, _ in each), max(b for _, b in each)) for each in zip(*rows, strict=True)]


def _overlap(columns: Sequence[tuple[int, int]]) -> bool:
    return any(one[1] > two[0] for one, two in pairwise(columns))


def _spans(line: str, row: Sequence[str]) -> list[tuple[int, int]]:
    """Where the cells of a line begin and end, tabs filled up."""
    text, start, spans = line.expandtabs(), 0, []
    for cell in row:
        start = text.find(cell.expandtabs(), start)
        spans.append((start, start + len(cell)))
        start += len(cell)
    return spans


def _is_of_numbers(row: Sequence[str]) -> bool:
    return sum(map(figures.is_figure, row)) >= LEAST_COLUMNS


def _placed(
    row: list[str], spans: Sequence[tuple[int, int]], columns: Sequence[tuple[int, int]]
) -> list[str]:
    """The cells of a row that is shorter than others, or of units, each in the column above or below which it stands.

    A unit may be of several words: DEG C. What stands behind the last column is one remark.
    """
    behind = next((k for k, (start, _) in enumerate(spans) if start >= columns[-1][1]), len(row))
    if len(row) - behind > 1:
        return [*row[:behind], " ".join(row[behind:])]
    if len(row) < LEAST_COLUMNS:
        return row
    row, spans = _over_one(row, spans, columns)
    places = [_below(span, columns) for span in spans]
    if any(len(each) != 1 for each in places):
        return row
    by_place: dict[int, list[str]] = {}
    for (place,), cell in zip(places, row, strict=True):
        by_place.setdefault(place, []).append(cell)
    placed = [" ".join(by_place.get(place, ())) for place in range(len(columns))]
    if any(map(_are_two_units, by_place.values())):  # the first columns have none
        return [""] * (len(columns) - len(row)) + [*row]
    apart = len(by_place) == len(row) < len(columns)
    return placed if apart or is_units(placed) or _is_of_words(row, spans, places) else row


def _are_two_units(cells: Sequence[str]) -> bool:
    """Whether cells below one name are two units, such as nT C, and not one of two words: DEG C."""
    return len(cells) > 1 and all(map(unit_of, cells)) and unit_of(cells[0]) != "°"


def _is_of_words(
    row: Sequence[str], spans: Sequence[tuple[int, int]], places: Sequence[list[int]]
) -> bool:
    """Whether a row is of names of most columns, of which some have several words, one blank apart."""
    pairs = zip(pairwise(spans), pairwise(places), strict=True)
    close = all(two[0] - one[1] == 1 for (one, two), (a, b) in pairs if a == b)
    named = len({place for (place,) in places})
    words = not any(re.search(r"\d", cell) for cell in row)
    return words and close and named >= LEAST_COLUMNS and 2 * named > len(row)


def _below(span: tuple[int, int], columns: Sequence[tuple[int, int]]) -> list[int]:
    """The columns that stand below or above a cell."""
    return [k for k, (start, end) in enumerate(columns) if span[0] < end and start < span[1]]


def _over_one(
    row: Sequence[str], spans: Sequence[tuple[int, int]], columns: Sequence[tuple[int, int]]
) -> tuple[list[str], list[tuple[int, int]]]:
    """Cells and their places, with each word apart of a cell over several columns: one blank parts two names."""
    cells, places = list[str](), list[tuple[int, int]]()
    for cell, span in zip(row, spans, strict=True):
        words = [*re.finditer(r"\S+", cell)] if len(_below(span, columns)) > 1 else []
        cells += [word[0] for word in words] or [cell]
        places += [(span[0] + w.start(), span[0] + w.end()) for w in words] or [span]
    return cells, places


def _numbers(rows: Sequence[Sequence[str]]) -> int:
    """Numbers in the rows that have at least four, and as many cells as most of these have."""
    counts = [
        (len(row), count)
        for row in rows
        if (count := sum(3 if _SIXTIETHS.fullmatch(c) else figures.is_figure(c) for c in row)) >= 4
    ]
    widths = Counter(width for width, _ in counts)
    usual = max(widths, key=lambda width: widths[width], default=0)
    return sum(count for width, count in counts if width == usual)


def _split(lines: Sequence[str], mark: str, source: str) -> list[list[str]]:
    """The cells of each line, without blanks around."""
    if mark in (_BLANKS, _RUNS):  # a unit in brackets belongs to the name before it
        apart = r"\s{2,}|\t" if mark == _RUNS else r"\s+(?![\[(])(?![^\[(]*[\])])"
        bare = (_BAR.sub(" ", line).strip() for line in lines)
        return [re.split(apart, line) if line else [] for line in bare]
    rows = text.cells_of(lines, mark, source, skip_blanks=True)
    return [[cell.strip() for cell in row] for row in rows]


def _trimmed(row: Sequence[object]) -> list[object]:
    cells = list(row)
    while cells and cells[-1] == "":
        cells.pop()
    return cells


def _by_calamine(data: bytes, source: str) -> Iterator[Sheet]:
    """The sheets of an OpenDocument or old Excel workbook."""
    calamine = _module(source)
    if source.lower().endswith(".ods"):
        _check_ods(data, source)
    with damaged_unless_read(source, "a workbook", "Save it again as .xlsx, or as CSV UTF-8."):
        book = calamine.CalamineWorkbook.from_filelike(io.BytesIO(data))
        hidden = {
            each.name
            for each in book.sheets_metadata
            if each.visible != calamine.SheetVisibleEnum.Visible
        }
        for name in book.sheet_names:
            page = book.get_sheet_by_name(name)
            at_most(
                page.total_height * page.total_width,
                _MOST_CELLS,
                f"{source}, sheet {name}",
                "a sheet",
                "cells",
                "Save the sheet with the run alone.",
            )
            first, left = page.start or (0, 0)
            merged = [
                ((top + 1, one - left), (bottom + 1, other - left))
                for (top, one), (bottom, other) in page.merged_cell_ranges or ()
            ]
            rows = with_merged(enumerate(page.to_python(skip_empty_area=True), first + 1), merged)
            yield Sheet(
                name,
                [(line, cells) for line, row in rows if (cells := _trimmed(_plain(row)))],
                first_column=left,
                merged=merged,
                hidden=name in hidden,
            )


def _check_ods(data: bytes, source: str) -> None:
    """Refuse a small archive that holds a large table: rows and cells that are repeated very often."""
    with (
        damaged_unless_read(source, "an OpenDocument spreadsheet", "Save it again."),
        zipfile.ZipFile(io.BytesIO(data)) as archive,
    ):
        size = sum(entry.file_size for entry in archive.infolist())
        advice = "Save the sheet with the run alone."
        at_most(size, _LARGEST_CONTENTS, source, "its contents", "bytes", advice)
        content = archive.read("content.xml")
    repeated = [int(each) for each in _REPEATED.findall(content)]
    if repeated and max(repeated) > _MOST_REPEATED:
        raise InputError(
            f"{source}: cells are repeated {max(repeated)} times, as in no spreadsheet."
        )


def _module(source: str) -> Any:
    return extras.load("python_calamine", f"{source}: an .ods file", "xlsx")
