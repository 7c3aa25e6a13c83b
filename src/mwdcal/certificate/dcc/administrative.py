"""The administrative part of a Digital Calibration Certificate: who, what, when, and what is stated."""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree import ElementTree as ET

import msgspec

from mwdcal.calibration.readings import SIMULATED
from mwdcal.certificate.dcc.elements import (
    LANGUAGE,
    REF_TYPES,
    UNSTATED,
    Child,
    container,
    day,
    leaf,
    node,
    title,
    typed,
    words,
)
from mwdcal.certificate.document import (
    Certificate,
    ConformityTest,
    Item,
    Party,
    TracedStandard,
)
from mwdcal.errors import InputError
from mwdcal.sensor.profile import Person

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
