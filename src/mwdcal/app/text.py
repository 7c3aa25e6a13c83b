"""Tables, numbers and counts as text: how everything that is printed is written."""

from __future__ import annotations

import codecs
import io
import math
import re
import sys

WIDE = 300
"""Width of a table whose last column holds remarks, which are never cut."""
_PLAIN, _RAISED = "-+0123456789T", "⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹ᵀ"
_HANDLER = "mwdcal.twins"
TWINS = {chr(0xA0): " ", chr(0x2009): " ", chr(0x202F): " ", "‰": "per mille"} | dict(
    re.findall(
        r"(\S) (\S+)",
        "° deg  º deg  µ u  ± +/-  × x  ÷ /  · *  √ sqrt  ∞ inf  ≤ <=  ≥ >=  ≈ ~  ≠ !=  → ->  ← <-  ⁄ /  "
        "– -  — -  − -  ─ -  ━ -  │ |  … ...  • *  ‘ '  ’ '  “ \"  ” \"  ′ '  ″ \"  ✓ ok  ✗ x  ▲ ^  ½ 1/2  "
        "α alpha  β beta  γ gamma  δ delta  θ theta  κ kappa  λ lambda  μ u  ν nu  π pi  ρ rho  σ sigma  "
        "τ tau  φ phi  χ chi  ω omega  Δ Delta  Θ Theta  Λ Lambda  Σ Sigma  Φ Phi  ∂ d  ∇ grad  "
        "₀ _0  ₁ _1  ₂ _2  ₃ _3  ₄ _4  ₅ _5  ₆ _6  ₇ _7  ₈ _8  ₉ _9  ᵢ _i  ⱼ _j  ᵏ ^k",
    )
)
"""What stands for a character where the encoding of the output lacks it; raised digits become ^2."""
_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
_CONTROL = rf"\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff{_BIDI}"
_UNSAFE = re.compile(f"[{_CONTROL}]")
UNSAFE_BUT_LINES = re.compile(f"(?!\n)[{_CONTROL}]")
"""Characters that control a terminal or the direction of writing, but for line breaks."""


def one_line(text: object) -> str:
    r"""Text of a user's file, harmless on a terminal and on one line.

    Control characters and those that reverse the direction of writing are shown as escapes, as are
    the bytes of a file name that is not UTF-8.

    >>> [one_line(text) for text in ("S[a1]", "A\x1b[2JPASS", "a\nb")]
    ['S[a1]', 'A\\x1b[2JPASS', 'a\\nb']
    """
    return _UNSAFE.sub(_escape, str(text))


def harmless(text: str) -> str:
    """As `one_line`, but line breaks stay."""
    return UNSAFE_BUT_LINES.sub(_escape, text)


def _escape(unsafe: re.Match[str]) -> str:
    """A character as Python writes it; a surrogate that stands for a byte as that byte."""
    code = ord(unsafe[0])
    if 0xDC80 <= code <= 0xDCFF:
        return f"\\x{code - 0xDC00:02x}"
    return unsafe[0].encode("unicode_escape").decode("ascii")


def fitting(text: str, encoding: str | None) -> str:
    r"""The text with plain twins of the characters that the encoding lacks.

    >>> fitting("1σ 0.1° 10⁻³ Ω", "ascii")
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


def number(value: float | None) -> str:
    """Three significant digits, or a dash."""
    if value is None or math.isnan(value):
        return "–"
    return f"{value + 0.0:.3g}" if abs(value) < 100 else f"{value:.0f}"


def quantity(value: float | None, unit: str) -> str:
    """A value with its unit; no space before the degree sign."""
    return number(value) if value is None else f"{number(value)}{'' if unit == '°' else ' '}{unit}"


def plural(count: int, noun: str) -> str:
    """A count with its noun: 1 station, 2 stations."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def chance(probability: float | None) -> str:
    """A probability to two digits; far below any decision a bound; a dash where there is none.

    >>> [chance(p) for p in (0.41234, 0.00012, 1e-30, None)]
    ['0.41', '0.00012', '< 1e-9', '–']
    """
    if probability is None:
        return number(probability)
    return "< 1e-9" if probability < 1e-9 else f"{probability:.2g}"


def table(rows: list[list[str]], header: list[str], width: int = 160) -> str:
    """Columns aligned: the first to the left, the others to the right.

    Cells are shown as they are, on one line, in characters that stdout has.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    def cell(content: str) -> Text:
        return Text(fitting(one_line(content), sys.stdout.encoding))

    aligned = Table(box=box.SIMPLE, pad_edge=False, show_edge=False)
    for index, title in enumerate(header):
        aligned.add_column(cell(title), justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        aligned.add_row(*map(cell, row))
    shown = io.StringIO()  # not stdout, whose encoding would change the lines
    Console(file=shown, width=width, color_system=None, legacy_windows=False).print(aligned)
    return "\n".join(line.rstrip() for line in shown.getvalue().splitlines())


def superscript(power: int) -> str:
    """An exponent, raised."""
    return str(power).translate(str.maketrans(_PLAIN, _RAISED))


def raised(symbol: str, power: int) -> str:
    """A symbol to a power: nothing for the power 0.

    >>> [raised("τ", power) for power in range(3)]
    ['', 'τ', 'τ²']
    """
    return symbol + superscript(power) if power > 1 else symbol * power
