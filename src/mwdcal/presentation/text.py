"""Tables, numbers and counts as text: how everything that is printed is written."""

from __future__ import annotations

import codecs
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from itertools import zip_longest
from typing import Any, TypeAlias

from mwdcal.errors import shell_word

PATIENCE = 2.0
"""Seconds before there is any progress to see."""
NARROWEST, WIDEST = 80, 160
"""Columns for which a terminal gets its tables and lines, however many it has."""
REMARKS_WIDTH = 120
"""Columns to which a table with remarks is folded where no terminal says how many there are."""
NOT_STATED = "not stated"
"""In place of what a document must have room for, and does not say."""
UNCUT = 1_000_000
"""Width that no table has."""
BETWEEN = 3
"""Blanks between two columns of a table."""
READABLE = 24
"""Least width to which a column of words is folded; its title, to half of it."""
Column: TypeAlias = tuple[str, ...]
"""The title of a column of a table, and its cells."""
_PLAIN, _RAISED = "-+0123456789T", "⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹ᵀ"
_HANDLER = "mwdcal.twins"
TWINS = {chr(0xA0): " ", chr(0x2009): " ", chr(0x202F): " ", "‰": "per mille"} | dict(
    re.findall(
        r"(\S) (\S+)",
        "• *  ° deg  º deg  µ u  ± +/-  × x  ÷ /  · *  √ sqrt  ∞ inf  ≤ <=  ≥ >=  ≈ ~  ≠ !=  → ->  ← <-  ⁄ /  "
        "– -  — -  − -  ： :  ─ -  ━ -  │ |  … ...  ‘ '  ’ '  “ \"  ” \"  ′ '  ″ \"  ✓ ok  ✗ x  ▲ ^  ▸ >  ◂ <  ½ 1/2  "
        "α alpha  β beta  γ gamma  δ delta  θ theta  κ kappa  λ lambda  μ u  ν nu  π pi  ρ rho  σ sigma  "
        "τ tau  φ phi  χ chi  ω omega  Δ Delta  Θ Theta  Λ Lambda  Σ Sigma  Φ Phi  ∂ d  ∇ grad  "
        "₀ _0  ₁ _1  ₂ _2  ₃ _3  ₄ _4  ₅ _5  ₆ _6  ₇ _7  ₈ _8  ₉ _9  ᵢ _i  ⱼ _j  ᵏ ^k",
    )
)
"""The replacement of a character where the encoding of the output lacks it; raised digits become ^2."""
_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
_CONTROL = rf"\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff{_BIDI}"
_UNSAFE = re.compile(f"[{_CONTROL}]")
UNSAFE_BUT_LINES = re.compile(f"(?!\n)[{_CONTROL}]")
"""Characters that control a terminal or the direction of writing, but for line breaks."""
_PASSWORD = re.compile(
    r"(//[^\s:@/]*:|(?<![\w+.-])[\w+.-]{2,}+:(?!//))(?!password@)(?=\S)[^'\n]*@|(\bpassword *= *)[^\s&'\"]+",
    re.IGNORECASE,
)
"""A password, from the colon behind a user to the last @ before a quote, or behind its name, with what is before it."""


def one_line(text: object) -> str:
    r"""Text of a user's file, harmless on a terminal and on one line.

    Control characters and those that reverse the direction of writing are shown as escapes, as are
    the bytes of a file name that is not UTF-8.

    >>> [one_line(text) for text in ("S[a1]", "A\x1b[2JPASS", "a\nb")]
    ['S[a1]', 'A\\x1b[2JPASS', 'a\\nb']
    """
    return _UNSAFE.sub(_escape, str(text))


def page_option(page: object) -> str:
    """The option with which a next command writes a page too; blank where what draws it is not installed."""
    drawn = all(map(find_spec, ("jinja2", "matplotlib")))
    return f" --report {one_line(shell_word(str(page)))}" if drawn else ""


def escape_controls(text: str) -> str:
    """As `one_line`, but line breaks stay."""
    return UNSAFE_BUT_LINES.sub(_escape, text)


def to_json(result: Any) -> str:
    """A result for machines."""
    import msgspec

    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode()


def without_passwords(text: str) -> str:
    """A message without the passwords of URLs in it, however these are mistyped.

    >>> without_passwords("'postgresql//bob:s3cret@host/x': no such file. Or host=h password=s3cret")
    "'postgresql//bob:***@host/x': no such file. Or host=h password=***"
    """
    return _PASSWORD.sub(lambda it: f"{it[1]}***@" if it[1] else f"{it[2]}***", text)


def _escape(unsafe: re.Match[str]) -> str:
    """A character as Python writes it; a surrogate that stands for a byte as that byte."""
    code = ord(unsafe[0])
    if 0xDC80 <= code <= 0xDCFF:
        return f"\\x{code - 0xDC00:02x}"
    return unsafe[0].encode("unicode_escape").decode("ascii")


def transliterate(text: str, encoding: str | None) -> str:
    r"""The text with plain twins of the characters that the encoding lacks.

    >>> transliterate("1σ 0.1° 10⁻³ Ω", "ascii")
    '1sigma 0.1deg 10^-3 \\u03a9'
    """
    name = encoding or "utf-8"
    return text.encode(name, _HANDLER).decode(name)


def _twins(error: UnicodeError) -> tuple[str, int]:
    """Twins of the characters that cannot be encoded; escapes of those that have none."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    level = str.maketrans(_RAISED, _PLAIN)
    plain = re.sub(f"[{_RAISED}]+", lambda run: "^" + run[0].translate(level), lacking)
    twins = "".join(TWINS.get(character, character) for character in plain)
    return one_line(twins).encode("ascii", "backslashreplace").decode(), error.end


codecs.register_error(_HANDLER, _twins)


def plural(count: int, noun: str) -> str:
    """A count with its noun: 1 station, 2 stations."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def chance(probability: float | None) -> str:
    """A probability to two digits; far below any decision a bound; a dash where there is none.

    >>> [chance(p) for p in (0.41234, 0.00012, 1e-30, None)]
    ['0.41', '0.00012', '< 1e-9', '–']
    """
    if probability is None:
        return "–"
    return "< 1e-9" if probability < 1e-9 else f"{probability:.2g}"


def columns(stream: Any) -> int | None:
    """Terminal width, or None if the stream is not a terminal."""
    if not stream.isatty():
        return None
    stated = os.environ.get("COLUMNS", "")
    try:
        size = int(stated) if stated.isdecimal() else os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError):
        size = 0
    return min(max(size, NARROWEST), WIDEST)


def laid_out(text: str, stream: Any) -> str:
    """Text for a stream: on a terminal its lines are folded, elsewhere it stays as it is."""
    width = columns(stream)
    if width is None:
        return text

    def indent(line: str) -> str:
        deeper = len(line) - len(line.lstrip(" ")) + 2
        return "# " if " # " in f" {line}" else " " * deeper

    lines = transliterate(text, stream.encoding).split("\n")
    return "\n".join(fold(line, width, indent(line)) for line in lines)


def fold(line: str, width: int, indent: str = "") -> str:
    """A line in lines of at most a width, never broken inside a word; after the first with an indent.

    It is broken between its items, which two blanks or more separate, and within one only if that is too
    long for a line.

    >>> print(fold("12 stations   method joint   as it is", 20, "  "))
    12 stations
      method joint
      as it is
    """
    from rich.cells import cell_len

    if cell_len(line) <= width:
        return line
    lines = [""]
    for gap, item in re.findall(r"(^ *| {2,})([^ ]+(?: [^ ]+)*)", line):
        whole = cell_len(indent + item) <= width
        for piece in [item] if whole else re.findall(r" ?[^ ]+", item):
            longer = lines[-1] + gap * (piece[0] != " ") + piece
            if cell_len(longer) <= width or not lines[-1]:
                lines[-1] = longer
            else:
                lines.append(indent + piece.lstrip())
    return "\n".join(lines)


def table(
    rows: list[list[str]],
    header: list[str],
    width: int = WIDEST,
    names: int = 1,
    remarks: bool = False,
) -> str:
    """Columns aligned: the first to the left, the others to the right.

    Cells are shown as they are, on one line, in characters that stdout has. On a terminal too narrow for
    it words are folded and the columns stand in several tables, which all begin with those that name the
    rows: the first, or several. Elsewhere the table is cut to a `width`; with `remarks` it is folded as on a terminal.
    """
    cells = [
        [transliterate(one_line(cell), sys.stdout.encoding) for cell in row]
        for row in [header, *rows]
    ]
    whole, room = list(zip(*cells, strict=True)), columns(sys.stdout)
    if room is None and not remarks:
        return _render_table(whole, width)
    room = room or REMARKS_WIDTH
    return "\n\n".join(_render_table(some, UNCUT) for some in _split_columns(whole, room, names))


def _split_columns(whole: Sequence[Column], room: int, names: int) -> list[list[Column]]:
    """The columns of a table in as many tables as they need, with the first ones in each."""

    def left(some: Sequence[Column]) -> int:
        return room - sum(_width(column) + BETWEEN for column in some)

    def folded(column: Column, width: int) -> Column:
        return tuple(fold(cell, max(width, READABLE)) for cell in column)

    narrow = [(fold(title, max(_width(cells), READABLE // 2)), *cells) for title, *cells in whole]
    for each in (whole, narrow):
        if left(each) + BETWEEN >= 0:
            return [list(each)]
    first = [folded(column, room // 2) for column in whole[:names]]
    tables = [first]
    for column in whole[names:]:
        words = tuple(word for cell in column for word in cell.split(" "))
        least = min(_width(column), max(READABLE, _width(words)))
        if left(tables[-1]) < least and tables[-1] is not first:
            tables.append(first)
        tables[-1] = [*tables[-1], folded(column, left(tables[-1]))]
    return tables


def _width(column: Iterable[str]) -> int:
    """Width of the longest line of some cells."""
    from rich.cells import cell_len

    return max((cell_len(line) for cell in column for line in cell.split("\n")), default=0)


def _render_table(whole: Sequence[Column], width: int) -> str:
    """The columns of a table side by side; those with folded cells begin at the left."""
    room = _shared_out([_width(column) for column in whole], width - BETWEEN * (len(whole) - 1))
    tallest = max(title.count("\n") for title, *_ in whole)
    lowered = [("\n" * (tallest - title.count("\n")) + title, *cells) for title, *cells in whole]
    left = [i == 0 or any("\n" in cell for cell in cells) for i, (_, *cells) in enumerate(whole)]
    lines = []
    for row in zip(*lowered, strict=True):
        for parts in zip_longest(*(cell.split("\n") for cell in row), fillvalue=""):
            cells = map(_aligned, parts, room, left)
            lines.append((" " * BETWEEN).join(cells).rstrip())
    rule = "─" * (sum(room) + BETWEEN * (len(room) - 1))
    return "\n".join([*lines[: tallest + 1], rule, *lines[tallest + 1 :]])


def _shared_out(widths: list[int], width: int) -> list[int]:
    """The widths of columns, of which the widest are cut to one that leaves all together at most `width`.

    >>> _shared_out([10, 40, 30], 60)
    [10, 25, 25]
    """
    most = next(
        most
        for most in range(max(widths), -1, -1)
        if sum(min(w, most) for w in widths) <= width or not most
    )
    return [min(each, most) for each in widths]


def _aligned(cell: str, width: int, left: bool) -> str:
    """A cell as wide as its column, cut where it is too long."""
    from rich.cells import cell_len, set_cell_size

    if cell_len(cell) > width:
        cell = set_cell_size(cell, width - 1) + "…"
    blanks = " " * (width - cell_len(cell))
    return cell + blanks if left else blanks + cell


def superscript(power: int) -> str:
    """An exponent, raised."""
    return str(power).translate(str.maketrans(_PLAIN, _RAISED))


def raised(symbol: str, power: int) -> str:
    """A symbol to a power: nothing for the power 0.

    >>> [raised("τ", power) for power in range(3)]
    ['', 'τ', 'τ²']
    """
    return symbol + superscript(power) if power > 1 else symbol * power


def slowly(say: Callable[[str], None], every: float = PATIENCE) -> Callable[[str], None]:
    """`say`, but silent for the first seconds and between two messages."""
    last = time.monotonic()

    def say_slowly(text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= every:
            last = time.monotonic()
            say(text)

    return say_slowly
