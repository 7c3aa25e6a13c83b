"""PTB's Digital Calibration Certificate 3.3.0 from a `Certificate`.

The whole certificate is in it twice: as elements of the schema, and as its own JSON in `dcc:document`.

Reference: PTB, DCC 3.3.0 (https://ptb.de/dcc/v3.3.0/), D-SI 2.2.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from xml.etree import ElementTree as ET

import msgspec

from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import canonical
from mwdcal.certificate.dcc.administrative import (
    administrative_data,
    conformity,
    identification,
    rule_id,
    software,
    tests,
)
from mwdcal.certificate.dcc.elements import (
    Child,
    container,
    content,
    leaf,
    node,
    ref_type,
    title,
    words,
)
from mwdcal.certificate.dcc.quantities import real
from mwdcal.certificate.document import (
    Budget,
    BudgetLine,
    Certificate,
    ConformityTest,
    LimitDecision,
    Method,
    Quantity,
    ResultTable,
    TracedStandard,
)

DCC_VERSION = "3.3.0"
DOCUMENT_NAME = "certificate.json"
"""Name of the file that the XML carries: the certificate's JSON."""
NO_VALUE = "Undetermined: the measurements give no value."
_NAMESPACE = "https://ptb.de/dcc"
_ANGLES = ("inclination", "toolface", "azimuth")
_MEASURED_VALUE = ("measuredValue",)
"""PTB's types of content of a result, unlike those of a limit, say."""


def to_xml(certificate: Certificate) -> bytes:
    """The certificate as a Digital Calibration Certificate, in UTF-8; the same bytes for the same certificate.

    Definition: characters that XML cannot hold are left out of the elements, not of the JSON inside.
    Units: g as \\metre\\second\\tothe{-2} times 9.80665, exactly; "per °C" as per kelvin.
    Singular: a value that is undetermined has no number, and text in its place; without the date
    of the calibration there is no certificate (`InputError`).
    """
    attributes = {
        "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
        "xmlns:dcc": _NAMESPACE,
        "xmlns:si": "https://ptb.de/si",
        "xsi:schemaLocation": f"{_NAMESPACE} {_NAMESPACE}/v{DCC_VERSION}/dcc.xsd",
        "schemaVersion": DCC_VERSION,
    }
    root = node(
        "digitalCalibrationCertificate",
        administrative_data(certificate),
        _measurement_results(certificate),
        _document(certificate),
        **attributes,
    )
    ET.indent(root)
    declaration = '<?xml version="1.0" encoding="UTF-8"?>'
    return f"{declaration}\n{ET.tostring(root, encoding='unicode')}\n".encode()


def _document(certificate: Certificate) -> ET.Element:
    """The certificate's JSON, in the one form in which it is signed."""
    data = base64.b64encode(canonical(msgspec.to_builtins(certificate))).decode()
    return node(
        "document",
        title("The certificate as JSON of mwdcal"),
        leaf("fileName", DOCUMENT_NAME),
        leaf("mimeType", "application/json"),
        leaf("dataBase64", data),
    )


def _measurement_results(certificate: Certificate) -> ET.Element:
    """The calibration, then each roll test."""
    method = certificate.method
    standards = [_equipment(standard) for standard in certificate.traceability]
    conditions = [_condition(quantity) for quantity in certificate.conditions]
    files = [
        _metadata("file", title(file.name), leaf("reference", f"SHA-256 {file.sha256}"))
        for file in certificate.files
    ]
    return node(
        "measurementResults",
        node("usedMethods", _method(method), _uncertainty_method(certificate.budget)),
        node("usedSoftware", software(method.software)),
        container("measuringEquipments", standards),
        container("influenceConditions", conditions),
        container("measurementMetaData", files),
        _calibration(certificate),
        *(_roll_test(test, certificate.simulated) for test in tests(certificate)),
    )


def _metadata(name: str, *children: Child, basic: str = "", **attributes: str) -> ET.Element:
    types = ref_type(name, *([basic] if basic else []))
    return node("metaData", *children, refType=types or None, **attributes)


def _method(method: Method) -> ET.Element:
    said = [method.text, f"Model: {method.model}"]
    said += [f"Deviation from the method: {each}" for each in method.deviations]
    stations = Quantity(id="stations", name="Stations", unit="1", value=method.stations)
    return node(
        "usedMethod",
        title(method.name),
        words("description", "\n".join(said)),
        *(leaf("reference", each) for each in method.references),
        node(
            "usedMethodQuantities", node("usedMethodQuantity", title(stations.name), real(stations))
        ),
        refType=ref_type("", "calibrationMethod"),
    )


def _uncertainty_method(budget: Budget) -> ET.Element:
    factor, probability = budget.coverage_factor, budget.coverage_probability
    text = (
        "An expanded uncertainty is the standard uncertainty times the coverage factor that is stated with it. "
        f"In the uncertainty budget the factor is {factor:g}, the coverage probability {100 * probability:g} %."
    )
    return node(
        "usedMethod",
        title("Uncertainty of measurement"),
        words("description", text),
        leaf("norm", "JCGM 100:2008"),
        refType=ref_type("", "methodMeasurementUncertainty"),
    )


def _equipment(standard: TracedStandard) -> ET.Element:
    """A measurement standard; what the schema has no element for are named texts."""
    said = {
        "Quantity": standard.quantity,
        "Issuer of the certificate": standard.issuer,
        "Date of the certificate": standard.date,
        "Due": f"{standard.due} (OVERDUE)" if standard.overdue else standard.due,
        "Standard uncertainty": standard.standard_uncertainty,
    }
    numbers = (
        identification("manufacturer", standard.serial, "Serial number", "serialNumber"),
        identification("calibrationLaboratory", standard.certificate, "Certificate number"),
    )
    facts = (
        node("measuringEquipmentQuantity", title(name), fact)
        for name, text in said.items()
        if (fact := words("noQuantity", text)) is not None
    )
    return node(
        "measuringEquipment",
        title(standard.name),
        container("identifications", numbers),
        container("measuringEquipmentQuantities", facts),
        refType=ref_type("", "measurementStandard"),
    )


def _condition(quantity: Quantity) -> ET.Element:
    basic = ("temperature",) if quantity.unit.strip() == "°C" else ()
    return node(
        "influenceCondition",
        title(quantity.name),
        node("data", _undetermined(quantity) if quantity.value is None else _quantity(quantity)),
        refType=ref_type(quantity.id, *basic) or None,
    )


def _quantity(
    quantity: Quantity, *metadata: Child, basic: tuple[str, ...] = _MEASURED_VALUE
) -> Child:
    """A quantity with its value, none where it is undetermined; metadata are what is decided on it."""
    if quantity.value is None:
        return None
    return node(
        "quantity",
        title(quantity.name or quantity.id),
        words("description", quantity.at),
        real(quantity),
        container("measurementMetaData", metadata),
        refType=ref_type(quantity.id, *basic) or None,
    )


def _undetermined(quantity: Quantity) -> ET.Element:
    """What stands in place of the number of a quantity that is undetermined."""
    return node(
        "text",
        title(quantity.name or quantity.id),
        content(f"{NO_VALUE} {quantity.at}"),
        refType=ref_type(f"undetermined-{quantity.id}"),
    )


def _data(
    quantities: Iterable[Quantity], *head: Child, basic: tuple[str, ...] = _MEASURED_VALUE
) -> list[Child]:
    """A list of the quantities that have values, behind its head, and a text for each of the others."""
    quantities = list(quantities)
    values = [_quantity(each, basic=basic) for each in quantities if each.value is not None]
    listed = node("list", *head, *values) if values else None
    return [listed, *(_undetermined(each) for each in quantities if each.value is None)]


def _result(name: str, note: str, kind: str, data: list[Child]) -> ET.Element:
    stated: list[Child] = [child for child in data if child is not None]
    return node(
        "result",
        title(name),
        words("description", note),
        node("data", *(stated or [words("text", "No results.")])),
        refType=ref_type(kind) or None,
    )


def _name(text: str, simulated: bool) -> Child:
    return title(f"{text} ({SIMULATED})" if simulated else text)


def _calibration(certificate: Certificate) -> ET.Element:
    tables = [_table(table) for table in certificate.results]
    return node(
        "measurementResult",
        _name(certificate.title, certificate.simulated),
        node("results", *tables, _budget(certificate.budget)),
        refType=ref_type("calibration"),
    )


def _table(table: ResultTable) -> ET.Element:
    return _result(table.title, table.note, table.id, _data(table.quantities))


def _budget(budget: Budget) -> ET.Element:
    """A list for each source, of what it adds to the uncertainty of each angle; then their sum, and expanded."""
    lines = [*budget.lines, budget.combined, budget.expanded]
    data = [child for line in lines for child in _budget_line(line)]
    return _result("Uncertainty budget", budget.at, "uncertainty-budget", data)


def _budget_line(line: BudgetLine) -> Iterator[Child]:
    angles = (
        Quantity(id=f"{line.id}-{name}", name=name, unit="°", value=getattr(line, f"{name}_deg"))
        for name in _ANGLES
    )
    basis = words("description", f"Type {line.kind}. {line.basis}")
    yield from _data(angles, title(line.source), basis, basic=())


def _roll_test(test: ConformityTest, simulated: bool) -> ET.Element:
    """A roll test as found (before adjustment) or as left (after it), with the decision on every limit."""
    before = test.when == "as found"
    state = node(
        "influenceCondition",
        title("State of the tool"),
        leaf("status", "beforeAdjustment" if before else "afterAdjustment"),
        node("data", words("text", test.when)),
    )
    values = [_quantity(each.quantity, _decision(each, test)) for each in test.decisions]
    without = [each for each in test.decisions if each.quantity.value is None]
    texts = [_undetermined(each.quantity) for each in without]
    facts = (
        f"Run {test.run}, {test.stations} stations. Limits: {test.limits} ({test.source}). "
        f"Calibration SHA-256 {test.calibration_sha256}."
    )
    return node(
        "measurementResult",
        _name(f"Roll test, {test.when}", simulated),
        words("description", facts),
        node("influenceConditions", state),
        node(
            "results",
            _result(f"Limits, {test.when}", "", test.when, [container("list", values), *texts]),
        ),
        node(
            "measurementMetaData",
            _metadata(
                "verdict",
                title(f"Conformity, {test.when}"),
                conformity(test.passed),
                basic="conformity",
            ),
            *(_decision(each, test) for each in without),
            *(_metadata(f.id, words("declaration", f.text)) for f in test.findings),
        ),
        refType=ref_type(test.when),
    )


def _decision(decision: LimitDecision, test: ConformityTest) -> ET.Element:
    """The decision on a limit: limits, probability and risk beside pass or fail."""
    unit, name = decision.quantity.unit, decision.quantity.name
    numbers = (
        ("limit", "Limit", unit, decision.limit),
        ("acceptance-limit", "Acceptance limit", unit, decision.acceptance_limit),
        (
            "probability-within",
            "Probability of being within the limit",
            "1",
            decision.probability_within,
        ),
        ("risk", "Probability of a wrong decision", "1", decision.risk),
    )
    values = (
        _quantity(Quantity(id=kind, name=text, unit=one, value=value), basic=())
        for kind, text, one, value in numbers
    )
    return _metadata(
        decision.quantity.id,
        title(f"Decision on {name}"),
        words("declaration", decision.note),
        conformity(decision.passed),
        container("data", values),
        basic="conformity",
        refId=rule_id(test),
    )
