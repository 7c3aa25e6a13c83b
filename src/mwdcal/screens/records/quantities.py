"""The numbers of a certificate as text: the same on screen, page and PDF."""

from __future__ import annotations

from mwdcal.certificate.document import Quantity
from mwdcal.screens.numbers import UNDETERMINED, exponent, fixed, measured, number, unit
from mwdcal.screens.text import NOT_STATED, chance

EXACT_DIGITS = 6
"""Significant digits of a number without uncertainty, at most."""
NEARLY_CERTAIN = 1e-6
"""A probability nearer to one than this is given as a bound."""


def quantity_numbers(quantity: Quantity, digits: int = EXACT_DIGITS) -> tuple[str, str, str]:
    """Value, standard and expanded uncertainty with their unit.

    Uncertainties have two significant digits, the value the last decimal place of the expanded one; a value
    without uncertainty has `digits` at most.
    """
    symbol = unit("" if quantity.unit == "1" else quantity.unit)
    value, u = quantity.value, quantity.standard_uncertainty
    widest = u if quantity.expanded_uncertainty is None else quantity.expanded_uncertainty
    blank = UNDETERMINED if value is None else NOT_STATED
    first, last = blank, None
    if value is not None:
        first, last = (
            measured(value, widest) if widest is not None else (plain(value, digits), None)
        )
        first += symbol
    stated = blank if u is None else _two_digits(u, last or "") + symbol
    if quantity.expanded_uncertainty is None:
        return first, stated, blank
    return first, stated, (last or number(widest, 2)) + symbol


def _two_digits(value: float, beside: str) -> str:
    """An uncertainty to two digits, with a power of ten only where the one beside it has one."""
    return (
        fixed(value, 1 - exponent(value))
        if value and "." in beside and "×" not in beside
        else number(value, 2)
    )


def plain(value: float, digits: int = EXACT_DIGITS) -> str:
    """A number as it was set, such as a limit, or to some significant digits."""
    text = f"{value:.{digits}g}".replace("-", "−")
    return number(value, digits) if "e" in text else text


def probability(value: float) -> str:
    """A probability with two significant digits of what is missing to one.

    >>> [probability(p) for p in (0.123, 0.99871, 1.0, 0.0)]
    ['0.12', '0.9987', '> 0.999999', '< 1e-9']
    """
    missing = 1 - value
    if missing > 0.5:
        return chance(value)
    if missing < NEARLY_CERTAIN:
        return f"> {1 - NEARLY_CERTAIN:.6f}"
    return f"{value:.{1 - exponent(missing)}f}"
