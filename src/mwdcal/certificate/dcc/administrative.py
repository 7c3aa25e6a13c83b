"""The administrative part of a Digital Calibration Certificate: who, what, when, and what is stated."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import date
from decimal import Decimal
from typing import NamedTuple
from xml.etree import ElementTree as ET

import msgspec

from mwdcal.calibration.readings import SIMULATED
from mwdcal.certificate.document import (
    Certificate,
    ConformityTest,
    Item,
    Party,
    Quantity,
    TracedStandard,
)
from mwdcal.errors import InputError
from mwdcal.files.exchange.xml import lines, one_line
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.sensor.profile import Person

# --------------------------------------------------------------------------
# Elements of a Digital Calibration Certificate: texts in English, single lines, types of content.
#
# Quantities and units in D-SI, the format of SI quantities in digital calibration certificates.
#
# Reference: D-SI 2.2, `si:real` with `si:expandedMU`; units are words of the SI Brochure behind backslashes.

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

    The whole of a share, as in "‰ of the field", is no part of its unit.

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


UNKNOWN_COUNTRY = "ZZ"
"""A code that ISO 3166-1 leaves to its users, here for a country that is not stated."""
_COUNTRY = re.compile("[A-Z]{2}")
_EMAIL = re.compile(r"[^\s@]+@[^\s@]+")
_NAMESPACES = {
    "basic": (
        "Types of content of all fields of metrology, by PTB",
        "https://digilab.ptb.de/dkd/refType/vocab/index.php?tema=2",
    ),
    REF_TYPES: ("Types of content of mwdcal, named by the ids of its certificates", "urn:x-mwdcal"),
}


def administrative_data(certificate: Certificate) -> ET.Element:
    """Software, dates, tool, laboratory, persons, customer and statements."""
    laboratory = node(
        "calibrationLaboratory",
        leaf("calibrationLaboratoryCode", _laboratory(certificate).accreditation),
        _contact("contact", _laboratory(certificate)),
    )
    return node(
        "administrativeData",
        node("dccSoftware", software(certificate.software)),
        node("refTypeDefinitions", *(_definition(name) for name in _NAMESPACES)),
        _core_data(certificate),
        node("items", _item(certificate.item)),
        laboratory,
        node("respPersons", *_persons(certificate)),
        _contact("customer", certificate.customer or Party(name="")),
        container("statements", _statements(certificate)),
    )


def software(name_and_version: str) -> ET.Element:
    """A program by its name and version, "mwdcal 1.2"."""
    before, _, last = name_and_version.strip().rpartition(" ")
    name, version = (before, last) if before else (last, "")
    release = leaf("release", version, UNSTATED)
    return node("software", title(name), release, leaf("type", "application"))


def identification(
    issuer: str, value: str, name: str, basic: str = "", fallback: str = ""
) -> Child:
    """A number by which something is known, and who gave it; none where it is blank."""
    stated = leaf("value", value, fallback)
    if stated is None:
        return None
    return typed("identification", "", leaf("issuer", issuer), stated, title(name), basic=basic)


def when_id(test: ConformityTest) -> str:
    """The id of a test: as-found or as-left."""
    return test.when.replace(" ", "-")


def rule_id(test: ConformityTest) -> str:
    """The id of the statement with the decision rule of a test."""
    return f"decision-rule-{when_id(test)}"


def tests(certificate: Certificate) -> list[ConformityTest]:
    """The roll tests of a certificate: as found, as left."""
    return [test for test in (certificate.as_found, certificate.as_left) if test]


def _laboratory(certificate: Certificate) -> Party:
    return certificate.laboratory or Party(name="")


def _definition(namespace: str) -> ET.Element:
    name, link = _NAMESPACES[namespace]
    return node("refTypeDefinition", title(name), leaf("namespace", namespace), leaf("link", link))


def _core_data(certificate: Certificate) -> ET.Element:
    dated = (certificate.calibrated, *(test.date for test in tests(certificate)))
    days = sorted(filter(None, map(day, dated)))
    if not days:
        raise InputError(
            "`certificate.calibrated` must be a date such as 2026-03-01, without which there is no digital "
            f"calibration certificate; got {certificate.calibrated!r}. State the date of the calibration."
        )
    return node(
        "coreData",
        leaf("countryCodeISO3166_1", _country(_laboratory(certificate)), UNKNOWN_COUNTRY),
        leaf("usedLangCodeISO639_1", LANGUAGE),
        leaf("mandatoryLangCodeISO639_1", LANGUAGE),
        leaf("uniqueIdentifier", certificate.number, UNSTATED),
        leaf("receiptDate", day(certificate.item.received)),
        leaf("beginPerformanceDate", days[0]),
        leaf("endPerformanceDate", days[-1]),
        leaf("performanceLocation", _where(certificate)),
        leaf("issueDate", day(certificate.issued)),
    )


def _country(party: Party) -> str:
    code = party.country.strip()
    return code if _COUNTRY.fullmatch(code) else ""


def _where(certificate: Certificate) -> str:
    """The place in the words of the schema: the laboratory, unless it is that of the customer."""
    customer = certificate.customer or Party(name="")
    lines = {line.strip().casefold() for line in (customer.name, *customer.address)} - {""}
    return "customer" if certificate.place.strip().casefold() in lines else "laboratory"


def _item(item: Item) -> ET.Element:
    others = (identification("other", value, name) for name, value in item.identification.items())
    serial = identification(
        "manufacturer", item.serial, "Serial number", "serialNumber", fallback=UNSTATED
    )
    maker = title(item.manufacturer) if item.manufacturer.strip() else None
    return node(
        "item",
        title(item.type),
        words("description", item.condition),
        node("manufacturer", maker) if maker is not None else None,
        leaf("model", item.type),
        node("identifications", serial, *others),
    )


def _contact(tag: str, party: Party) -> ET.Element:
    """A laboratory or customer; what of its contact is no e-mail address is a line of its address."""
    email = party.contact if _EMAIL.fullmatch(party.contact.strip()) else ""
    lines = [*party.address, "" if email else party.contact]
    location = node(
        "location",
        words("further", "\n".join(filter(None, lines)), UNSTATED),
        leaf("countryCode", _country(party)),
    )
    return node(tag, title(party.name), leaf("eMail", email), location)


def _persons(certificate: Certificate) -> Iterator[ET.Element]:
    """Who measured and who authorised; the schema wants one person at least."""
    persons = {"measured": certificate.measured_by, "authorised": certificate.authorised_by}
    stated = {role: person for role, person in persons.items() if person}
    for role, person in (stated or {"authorised": Person(name="")}).items():
        yield node(
            "respPerson",
            node("person", title(person.name)),
            words("description", person.function),
            leaf("role", role),
            leaf("mainSigner", "true" if role == "authorised" else "false"),
        )


def _statements(certificate: Certificate) -> Iterator[ET.Element]:
    """The statements on the whole calibration: simulation, traceability, conformity, the certificate's own words."""
    if certificate.simulated:
        yield typed(
            "statement", "simulated", words("declaration", f"{SIMULATED}: no tool was measured.")
        )
    for text in certificate.statements:
        if (declaration := words("declaration", text)) is not None:
            yield typed("statement", "statement", declaration)
    yield from _signature(certificate)
    yield from _place(certificate)
    yield from _traceability(certificate)
    for test in tests(certificate):
        yield _decision_rule(test)
        yield _conformity(test)
    if day(certificate.next_due):
        yield typed(
            "statement",
            "next-due",
            title("Next calibration due"),
            leaf("date", day(certificate.next_due)),
        )
    for finding in certificate.findings:
        if (declaration := words("declaration", finding.text)) is not None:
            yield typed("statement", finding.id, declaration)


def _signature(certificate: Certificate) -> Iterator[ET.Element]:
    if certificate.signature is not msgspec.UNSET:
        signed = certificate.signature
        text = f"The JSON in this document is signed: {signed.algorithm}, key {signed.key}, {signed.time}."
        yield typed("statement", "signature", words("declaration", text))


def _place(certificate: Certificate) -> Iterator[ET.Element]:
    if (place := words("further", certificate.place)) is not None:
        location = node("location", place)
        yield typed("statement", "place", title("Place of the calibration"), location)


def _traceability(certificate: Certificate) -> Iterator[ET.Element]:
    """The certificates by which the results are traceable; nothing where no standard has one."""
    standards = [each for each in certificate.traceability if each.certificate.strip()]
    if standards:
        lines = (f"{each.quantity}: {each.name}, {_source(each)}" for each in standards)
        yield typed(
            "statement",
            "traceability",
            title("Metrological traceability"),
            *(leaf("reference", each.certificate) for each in standards),
            words("declaration", "\n".join(["Traceable by these certificates.", *lines])),
            basic="metrologicallyTraceableToSI",
        )


def _source(standard: TracedStandard) -> str:
    """The certificate of a standard: number, issuer, and whether it is overdue."""
    issuer = f" of {standard.issuer}" if standard.issuer.strip() else ""
    return f"certificate {standard.certificate}{issuer}" + (", overdue" if standard.overdue else "")


def _decision_rule(test: ConformityTest) -> ET.Element:
    return typed(
        "statement",
        f"{test.rule}-acceptance",
        title(f"Decision rule, {test.when}"),
        leaf("reference", test.limits),
        leaf("reference", test.source),
        words("declaration", test.rule_text, UNSTATED),
        basic="decisionRule",
        id=rule_id(test),
    )


def _conformity(test: ConformityTest) -> ET.Element:
    return typed(
        "statement",
        test.when,
        title(f"Conformity, {test.when}"),
        leaf("norm", "ISO/IEC 17025:2017, 7.8.6"),
        leaf("date", day(test.date)),
        conformity(test.passed),
        basic="conformity",
        refId=rule_id(test),
    )


def conformity(passed: bool) -> Child:
    """The decision in the words of the schema."""
    return leaf("conformity", "pass" if passed else "fail")
