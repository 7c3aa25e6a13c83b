"""CSV and TSV: UTF-8 text, metadata lines, one header line, one line per station."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, takewhile
from typing import Any, NamedTuple

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.formats.columns import (
    Column,
    Parts,
    assemble,
    at_most,
    check_names,
    looks_numeric,
    of_texts,
    plain_names,
)
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import TableFormat

# --------------------------------------------------------------------------
# Tables as loggers and spreadsheet programs export them: how one is written, and reading it so.
#
# An export may have another encoding, delimiter and decimal sign than a run file, lines above its
# column names, and a line of units below them. `layout` finds this out; `plain` makes of an export the text of a
# run file whose lines keep their numbers.

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


def plain(data: bytes, form: TableFormat, source: str) -> bytes:
    """The export as the UTF-8 text of a run file with the same delimiter.

    Lines that are neither metadata, column names nor readings become a blank line, and delimiters behind
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
    """The cells of each line; `skip_blanks` before a cell, which may be in quotes behind them.

    A cell that is nothing but a quote is the unit of seconds.

    >>> cells_of(["deg;';\\";V"], ";", "run.csv")
    [['deg', "'", '"', 'V']]
    """
    try:
        return [
            next(
                csv.reader(
                    [_with_seconds(line, delimiter) if '"' in line else line],
                    delimiter=delimiter,
                    skipinitialspace=skip_blanks,
                ),
                [],
            )
            for line in lines
        ]
    except csv.Error as error:
        raise InputError(
            f"{source}: the file is no table of text ({error}). Name the file with the readings."
        ) from None


def _with_seconds(line: str, delimiter: str) -> str:
    """The line with each cell that is nothing but a quote in quotes; as it is where such quotes may be of a cell."""
    sign = re.escape(delimiter)
    lone = re.compile(rf'(?<![^{sign}])"(?![^{sign}])(?!{sign}"(?![^{sign}]))')
    return lone.sub('""""', line) if lone.sub("", line).count('"') % 2 == 0 else line


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


FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of cells that spreadsheet programs run as a formula, unless it is a number."""
_BREAKS = "\n\r\0"
_SMALLEST_ALIKE, _LARGEST_ALIKE = 1e-4, 1e10
"""Between these Arrow spells numbers as `repr` does, whole ones without their ".0"."""
_LONGEST_LINE = 100_000
_ROWS_AT_ONCE = 1 << 12
_MAX_LINES = 1_000_000
_DELIMITING = re.compile(r'[",;\t]')
_QUOTED = re.compile(r'"[^"]*"')

UTF_16 = (b"\xff\xfe", b"\xfe\xff")
"""What UTF-16 text begins with."""
_FOREIGN = {
    b"\xff\xfe": ("UTF-16 text", "Save it as UTF-8 (in Excel: 'CSV UTF-8')."),
    b"\xfe\xff": ("UTF-16 text", "Save it as UTF-8 (in Excel: 'CSV UTF-8')."),
    b"\x89PNG": ("a PNG picture", "Name the file with the readings."),
    b"%PDF": ("a PDF document", "Name the file with the readings."),
    b"PK\x03\x04": ("a ZIP archive or Excel workbook", "A workbook must be named .xlsx."),
    b"PAR1": ("a Parquet file", "Name it .parquet."),
    b"\x1f\x8b": ("gzip-compressed", "Unpack it first."),
    b"\xd0\xcf\x11\xe0": ("an old Excel workbook (.xls)", "Save it as .xlsx or CSV UTF-8."),
}


class Head(NamedTuple):
    """What stands above the rows of a text table, in so many lines."""

    names: list[str]
    metadata: dict[str, object]
    delimiter: str
    lines: int


def parse(data: bytes, source: str, delimiter: str = "") -> Parts:
    """The table in the bytes of a text file; without `delimiter` the header says what it is."""
    whole = lines(data, source)
    top = head(whole, source, delimiter)
    return _parts(whole[top.lines :], top, top.lines, source)


def head(lines: Sequence[str], source: str, delimiter: str = "") -> Head:
    """The head of a table that begins with these lines."""
    comments = list(takewhile(is_preamble, lines))
    metadata = meta.parse([(i, comment(line)) for i, line in enumerate(comments, 1)], source)
    start = len(comments)
    header = lines[start : start + 1]
    delimiter = delimiter or (_delimiter(header[0], source) if header else ",")
    cells = next(split(header, start, delimiter, source), (start + 1, ()))[1]
    names = [str(cell).strip() for cell in cells]
    check_names(names, f"{source}, line {start + 1}")
    return Head(names, metadata, delimiter, start + 1)


def rows(data: bytes, top: Head, above: int, source: str) -> Parts:
    """The rows of a piece of a text table, whole lines with `above` lines of the file before."""
    if not data.strip(top.delimiter.encode() + b" \t\r\n"):
        return Parts({name: [] for name in top.names}, {}, ())
    return _parts(lines(data, source, above), top, above, source)


def _parts(lines: Sequence[str], top: Head, above: int, source: str) -> Parts:
    """The rows in some lines, which follow `above` lines of the file."""
    entries = split(lines, above, top.delimiter, source)
    names, cells, numbers = assemble(chain([(above, top.names)], entries), source, "line")
    return Parts(of_texts(names, cells), top.metadata, numbers)


def render(
    columns: Mapping[str, Column],
    metadata: Mapping[str, object],
    delimiter: str,
    decimal: str = ".",
) -> str:
    """The text that `parse` turns back into the same columns and metadata.

    `decimal` is the sign in numbers; cells of text stay as they are.
    """
    return "".join(pieces(columns, metadata, delimiter, decimal))


def pieces(
    columns: Mapping[str, Column],
    metadata: Mapping[str, object],
    delimiter: str,
    decimal: str = ".",
) -> Iterator[str]:
    """The text of `render` in pieces of `_ROWS_AT_ONCE`: of a long table never all of it is in memory."""
    yield "".join(f"{line}\n" for line in meta.render(metadata)) + header(list(columns), delimiter)
    for start in range(0, max(map(len, columns.values()), default=0), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        stream = io.StringIO()
        writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
        cells = (_cells(name, column[rows], decimal) for name, column in columns.items())
        writer.writerows(zip(*cells, strict=True))
        yield stream.getvalue()


def header(names: Sequence[str], delimiter: str) -> str:
    """The line of the column names, in quotes where they hold what delimits other tables."""
    plain = plain_names(names)
    cells = ('"' + n.replace('"', '""') + '"' if _DELIMITING.search(n) else n for n in plain)
    return delimiter.join(cells) + "\n"


def is_formula(cell: str) -> bool:
    """Whether spreadsheet programs run a cell of a text table as a formula.

    >>> [is_formula(cell) for cell in ("=1+1", "-1+1", "-1.5", "A-1")]
    [True, True, False, False]
    """
    return cell.startswith(FORMULA) and not looks_numeric(cell.strip().replace(",", "."))


def _cells(name: str, column: Column, decimal: str) -> list[str]:
    if not isinstance(column, list):
        plain = [
            "" if value != value else repr(value) for value in np.asarray(column, float).tolist()
        ]
        return plain if decimal == "." else [cell.replace(".", decimal) for cell in plain]
    return one_line(name, column)


def one_line(name: str, cells: list[str]) -> list[str]:
    """The cells; refuses a line break in one, which text tables do not have."""
    joined_cells = "".join(cells)
    if any(mark in joined_cells for mark in _BREAKS):
        cell = next(cell for cell in cells if any(mark in cell for mark in _BREAKS))
        raise InputError(
            f"column '{name}': cells of a text file must be one line; got {cell!r}. "
            "Remove the line break, or write Parquet."
        )
    return cells


def spelt(values: Array, arrow: Any) -> Any:
    """Numbers (n,) as Arrow's texts, spelled as `repr` does; NaN is blank."""
    import pyarrow.compute as compute

    values = np.asarray(values, float)
    words = arrow.array(values).cast(arrow.string())
    size = np.abs(values)
    with np.errstate(invalid="ignore"):
        whole = (size < _LARGEST_ALIKE) & (values == np.trunc(values))
        odd = ~(whole | ((size >= _SMALLEST_ALIKE) & (size < _LARGEST_ALIKE)))
    if whole.any():
        pointed = compute.binary_join_element_wise(words, ".0", "")
        words = pointed if whole.all() else compute.if_else(whole, pointed, words)
    if odd.any():
        others = ["" if value != value else repr(value) for value in values[odd].tolist()]
        words = compute.replace_with_mask(words, odd, arrow.array(others, arrow.string()))
    return words


def quoted(cells: Any, delimiter: str) -> Any:
    """Arrow's texts, blank where null, in quotes where a text table needs them."""
    import pyarrow.compute as compute

    cells = compute.fill_null(cells, "")
    if not _holds(cells, ('"', "\r", "\n", delimiter)):
        return cells
    odd = compute.match_substring_regex(cells, f'["\r\n{delimiter}]')
    doubled = compute.replace_substring(cells, '"', '""')
    return compute.if_else(odd, compute.binary_join_element_wise('"', doubled, '"', ""), cells)


def _holds(cells: Any, marks: Sequence[str]) -> bool:
    """Whether a mark is in the memory of Arrow's texts, which may hold more than these: a look at all bytes at once."""
    for chunk in getattr(cells, "chunks", [cells]):
        data = chunk.buffers()[-1]
        whole = b"" if data is None else data.to_pybytes()
        if any(mark.encode() in whole for mark in marks):
            return True
    return False


def joined(columns: Sequence[Any], delimiter: str, arrow: Any) -> memoryview:
    """The lines of rows of which Arrow has the cells, each with its end."""
    import pyarrow.compute as compute

    cells = [c.combine_chunks() if hasattr(c, "combine_chunks") else c for c in columns]
    ended = compute.binary_join_element_wise(cells[-1], "\n", "")
    rows = compute.binary_join_element_wise(*cells[:-1], ended, delimiter)
    if isinstance(rows, arrow.ChunkedArray):
        rows = rows.combine_chunks()
    _, offsets, data = rows.buffers()
    ends = np.frombuffer(offsets, np.int32)[[rows.offset, rows.offset + len(rows)]]
    return memoryview(data)[ends[0] : ends[1]]


def lines(data: bytes, source: str, above: int = 0) -> list[str]:
    """The lines without their ends, blank ones at the end left out; `above` lines came before."""
    if not above:
        refuse_foreign(data, source)
    content = _decoded(data, source, above).replace("\r\n", "\n").replace("\r", "\n").rstrip("\n")
    if not content.strip():
        raise InputError(
            f"{source}: the file is empty. A run file needs a line with the column names, "
            "such as ax,ay,az, and one row per station."
        )
    advice = "Split it, or write long tables as Parquet."
    at_most(content.count("\n"), _MAX_LINES, source, "a text table", "lines", advice)
    result = content.split("\n")
    for position, line in enumerate(result, above + 1):
        if len(line) > _LONGEST_LINE:
            raise InputError(
                f"{source}, line {position}: a line must have at most {_LONGEST_LINE} "
                f"characters; got {len(line)}. Is this a run file, with one line per station?"
            )
    return result


def refuse_foreign(data: bytes, source: str, allowed: Sequence[bytes] = ()) -> None:
    """Refuse bytes that are no text table, unless they begin with one of those allowed."""
    for signature, (kind, advice) in _FOREIGN.items():
        if data.startswith(signature) and signature not in allowed:
            raise InputError(f"{source}: expected a text table; the file is {kind}. {advice}")


def _decoded(data: bytes, source: str, above: int) -> str:
    """The text; every refusal names the line of the first offending byte."""
    position = data.find(b"\0")
    if position >= 0:
        raise InputError(
            f"{source}, line {above + _line_of(data, position)}: expected text; got a NUL byte. The "
            "file is binary or UTF-16: save the table as UTF-8 text."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{source}, line {above + _line_of(data, error.start)}: expected UTF-8 text; got byte "
            f"0x{data[error.start]:02X}. Save the file as UTF-8 (in Excel: 'CSV UTF-8')."
        ) from None


def _line_of(data: bytes, position: int) -> int:
    return data.count(b"\n", 0, position) + 1


def is_preamble(line: str) -> bool:
    """Whether the line stands above the header: a comment, or blank.

    A spreadsheet that saves the file again may have put quotes around a comment.
    """
    return line.lstrip().startswith(("#", '"#')) or not line.strip()


def comment(line: str) -> str:
    """The comment without what a spreadsheet adds: quotes, and delimiters at the end."""
    if line.lstrip().startswith('"'):
        line = ",".join(next(csv.reader([line], skipinitialspace=True)))
    return line.strip().rstrip(",;\t ")


def _delimiter(header: str, source: str) -> str:
    """The delimiter of the header line: the most frequent one of tab, ';' and ','."""
    order = "\t,;" if source.lower().endswith(".tsv") else ",;\t"
    return max(order, key=_QUOTED.sub("", header).count)


def _tidied(line: str, delimiter: str) -> str:
    """The line without the blanks between a delimiter and a quote, which other programs write."""
    cell = rf'(^|{delimiter})( *)("(?:[^"]|"")*"|[^{delimiter}]*)'
    return re.sub(cell, lambda m: m[1] + ("" if m[3].startswith('"') else m[2]) + m[3], line)


def split(
    lines: Sequence[str], start: int, delimiter: str, source: str
) -> Iterator[tuple[int, Sequence[object]]]:
    """The cells of each line with its line number; `start` lines stand above."""
    tidied = (_tidied(line, delimiter) if ' "' in line else line for line in lines)
    reader = csv.reader(tidied, delimiter=delimiter, strict=True)
    done = 0
    try:
        for row in reader:
            if reader.line_num != done + 1:
                raise csv.Error("line break within quotes")
            done += 1
            yield start + done, row
    except csv.Error as error:
        raise InputError(
            f"{source}, line {start + done + 1}: a cell in quotes must end on its line and "
            f"be followed by the delimiter ({error}). Remove the quote or the line break."
        ) from None
