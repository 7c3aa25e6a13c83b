"""Elements of a Digital Calibration Certificate: texts in English, single lines, types of content.

Quantities and units in D-SI, the format of SI quantities in digital calibration certificates.

Reference: D-SI 2.2, `si:real` with `si:expandedMU`; units are words of the SI Brochure behind backslashes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import date
from decimal import Decimal
from typing import NamedTuple
from xml.etree import ElementTree as ET

from mwdcal.certificate.document import Quantity
from mwdcal.files.exchange.xml import lines, one_line
from mwdcal.geometry.units import STANDARD_GRAVITY

LANGUAGE = "en"
UNSTATED = "not stated"
"""What stands where the schema demands an element and the certificate says nothing."""
REF_TYPES = "mwdcal"
"""Namespace of our types of content, beside PTB's `basic`."""
_OUTSIDE_TOKEN = re.compile(r"[^A-Za-z0-9.-]+")

Child = ET.Element | None
"""An element, or none where there is nothing to say."""


def node(tag: str, *children: Child, **attributes: str | None) -> ET.Element:
    """An element with those of its children and attributes that exist; a tag without prefix is one of the DCC."""
    stated = {name: value for name, value in attributes.items() if value}
    element = ET.Element(_tag(tag), stated)
    element.extend(child for child in children if child is not None)
    return element


def leaf(tag: str, text: str, fallback: str = "", **attributes: str | None) -> Child:
    """An element of one line of text; none where text and fallback are blank."""
    line = one_line(text) or fallback
    if not line:
        return None
    element = node(tag, **attributes)
    element.text = line
    return element


def container(tag: str, children: Iterable[Child]) -> Child:
    """An element around others; none where there are none."""
    stated = [child for child in children if child is not None]
    return node(tag, *stated) if stated else None


def content(text: str) -> Child:
    """A text in English; none where it is blank."""
    body = lines(text)
    if not body:
        return None
    element = node("content", lang=LANGUAGE)
    element.text = body
    return element


def words(tag: str, text: str, fallback: str = "") -> Child:
    """An element of text for people, in English; none where text and fallback are blank."""
    return container(tag, [content(lines(text) or fallback)])


def title(text: str) -> Child:
    """The name of what surrounds it, which is never blank."""
    return words("name", one_line(text), UNSTATED)


def typed(
    tag: str, kind: str, *children: Child, basic: str = "", **attributes: str | None
) -> ET.Element:
    """An element with types of content: PTB's basic ones, blanks between them, then ours by its name."""
    token = _OUTSIDE_TOKEN.sub("-", kind).strip("-")
    types = [f"basic_{each}" for each in basic.split()]
    types += [f"{REF_TYPES}_{token}"] if token else []
    return node(tag, *children, refType=" ".join(types), **attributes)


def day(text: str) -> str:
    """The date of an ISO 8601 text; blank where it has none."""
    try:
        return date.fromisoformat(text.strip()[:10]).isoformat()
    except ValueError:
        return ""


def _tag(tag: str) -> str:
    return tag if ":" in tag else f"dcc:{tag}"


_STANDARD_G = Decimal(str(STANDARD_GRAVITY))
_ACCELERATION = {"metre": 1, "second": -2}
_NORMAL_COVERAGE = 0.005
"""Largest difference from a normal distribution's coverage probability at which one is stated."""


class DsiUnit(NamedTuple):
    """A unit in D-SI, and how many of it make one of ours."""

    name: str
    factor: Decimal


class _Symbol(NamedTuple):
    """A symbol of a unit: D-SI units with their exponents, and the factor to their product."""

    powers: Mapping[str, int]
    factor: Decimal = Decimal(1)


_SYMBOLS = {
    "1": _Symbol({}),
    "%": _Symbol({}, Decimal("0.01")),
    "‰": _Symbol({}, Decimal("0.001")),
    "g": _Symbol(_ACCELERATION, _STANDARD_G),
    "mg": _Symbol(_ACCELERATION, _STANDARD_G / 1000),
    "m": _Symbol({"metre": 1}),
    "s": _Symbol({"second": 1}),
    "T": _Symbol({"tesla": 1}),
    "mT": _Symbol({r"milli\tesla": 1}),
    "µT": _Symbol({r"micro\tesla": 1}),
    "nT": _Symbol({r"nano\tesla": 1}),
    "°": _Symbol({"degree": 1}),
    "deg": _Symbol({"degree": 1}),
    "rad": _Symbol({"radian": 1}),
    "K": _Symbol({"kelvin": 1}),
    "°C": _Symbol({"kelvin": 1}),
}
"""Symbols as the parts of a unit: a difference of 1 °C is 1 K; g is standard gravity, mg a thousandth of it."""
_FACTOR_AND_POWER = re.compile(r"(1|[^\d^-]+)\^?(-?[1-9])?")
_SUPERSCRIPTS = str.maketrans("⁻¹²³⁴⁵⁶⁷⁸⁹", "-123456789")


def dsi_unit(text: str) -> DsiUnit:
    r"""The D-SI form of a unit such as "g/°C" or "nT"; "°C" by itself is `\degreecelsius`.

    What a share is of, as in "‰ of the field", is no part of its unit.

    Singular: a unit that is not of the SI is marked with a vertical bar, as D-SI has it.
    """
    if text.strip() == "°C":
        return DsiUnit(r"\degreecelsius", Decimal(1))
    powers: dict[str, int] = {}
    factor = Decimal(1)
    for symbol, exponent in _parts(text):
        if symbol is None:
            return DsiUnit(f"|{one_line(text)}", Decimal(1))
        factor *= symbol.factor**exponent
        for name, power in symbol.powers.items():
            powers[name] = powers.get(name, 0) + power * exponent
    named = (_raised(name, power) for name, power in powers.items() if power)
    return DsiUnit("".join(named) or r"\one", factor)


def _parts(text: str) -> Iterator[tuple[_Symbol | None, int]]:
    """Symbols of a unit with their exponents, below the fraction bar negative; None: not known."""
    for place, product in enumerate(text.partition(" of ")[0].translate(_SUPERSCRIPTS).split("/")):
        for part in product.replace("·", " ").strip("() ").split() or ["1"]:
            match = _FACTOR_AND_POWER.fullmatch(part)
            exponent = int(match[2] or 1) if match else 1
            yield _SYMBOLS.get(match[1]) if match else None, -exponent if place else exponent


def _raised(name: str, power: int) -> str:
    return rf"\{name}" if power == 1 else rf"\{name}\tothe{{{power}}}"


def real(quantity: Quantity) -> ET.Element:
    """A quantity with a value as `si:real`, labelled with its id; value and uncertainty converted exactly."""
    assert quantity.value is not None
    unit = dsi_unit(quantity.unit)
    return node(
        "si:real",
        leaf("si:label", quantity.id),
        leaf("si:value", _number(quantity.value, unit.factor)),
        leaf("si:unit", unit.name),
        _uncertainty(quantity, unit.factor),
    )


def _number(value: float, factor: Decimal = Decimal(1)) -> str:
    """The product with all of its digits: a double has 17 at most, and a Decimal keeps 28."""
    return str(Decimal(repr(float(value))) * factor)


def _uncertainty(quantity: Quantity, factor: Decimal) -> Child:
    coverage = _coverage(quantity)
    if coverage is None:
        return None
    expanded, times, probability = coverage
    normal = abs(math.erf(times / math.sqrt(2)) - probability) < _NORMAL_COVERAGE
    return node(
        "si:measurementUncertaintyUnivariate",
        node(
            "si:expandedMU",
            leaf("si:valueExpandedMU", _number(expanded, factor)),
            leaf("si:coverageFactor", _plain(times)),
            leaf("si:coverageProbability", _plain(probability)),
            leaf("si:distribution", "normal" if normal else ""),
        ),
    )


def _coverage(quantity: Quantity) -> tuple[float, float, float] | None:
    """Expanded uncertainty, coverage factor and probability; one standard uncertainty has the factor 1.

    Singular: None where no uncertainty is stated; D-SI has no factor below 1, so that such an
    expanded uncertainty gives way to the standard one.
    """
    expanded, factor = quantity.expanded_uncertainty, quantity.coverage_factor
    probability = quantity.coverage_probability
    if expanded is not None and factor is not None and probability is not None and factor >= 1:
        return expanded, factor, probability
    if quantity.standard_uncertainty is None:
        return None
    return quantity.standard_uncertainty, 1.0, math.erf(math.sqrt(0.5))


def _plain(value: float) -> str:
    """A number without exponent, which coverage factors and probabilities do not take."""
    return format(Decimal(repr(float(value))), "f")
