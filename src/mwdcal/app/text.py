"""Tables, numbers and counts as text: how everything that is printed is written."""

from __future__ import annotations

import numpy as np

WIDE = 300
"""Width of a table whose last column holds remarks, which are never cut."""
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None) -> str:
    """Three significant digits, or a dash."""
    if value is None or np.isnan(value):
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
    """Columns aligned: the first to the left, the others to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    aligned = Table(box=box.SIMPLE, pad_edge=False, show_edge=False)
    for index, title in enumerate(header):
        aligned.add_column(title, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        aligned.add_row(*row)
    console = Console(width=width, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(aligned)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def superscript(power: int) -> str:
    """An exponent, raised."""
    return str(power).translate(_SUPERSCRIPT)


def raised(symbol: str, power: int) -> str:
    """A symbol to a power: nothing for the power 0.

    >>> [raised("τ", power) for power in range(3)]
    ['', 'τ', 'τ²']
    """
    return symbol + superscript(power) if power > 1 else symbol * power
