"""PTB's Digital Calibration Certificate 3.3.0 from a `Certificate`.

The whole certificate is in it twice: as elements of the schema, and as its own JSON in `dcc:document`.

Reference: PTB, DCC 3.3.0 (https://ptb.de/dcc/v3.3.0/), D-SI 2.2.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from xml.etree import ElementTree as ET

from msgspec.structs import replace

from mwdcal.calibration.readings import SIMULATED
from mwdcal.certificate.dcc.administrative import (
    Child,
    administrative_data,
    conformity,
    container,
    content,
    identification,
    leaf,
    node,
    real,
    rule_id,
    software,
    tests,
    title,
    typed,
    when_id,
    words,
)
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
    encode,
)

DCC_VERSION = "3.3.0"
DOCUMENT_NAME = "certificate.json"
"""Name of the file that the XML carries: the certificate's JSON."""
NO_VALUE = "Undetermined: the measurements give no value."
_NAMESPACE = "https://ptb.de/dcc"
_ANGLES = ("inclination", "toolface", "azimuth")
_MEASURED_VALUE = "measuredValue"
"""PTB's type of content of a result, unlike that of a limit."""


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
    """The certificate's JSON file."""
    data = base64.b64encode(encode(certificate)).decode()
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
        typed("metaData", "file", title(file.name), leaf("reference", f"SHA-256 {file.sha256}"))
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


def _method(method: Method) -> ET.Element:
    said = [method.text, f"Model: {method.model}"]
    said += [f"Deviation from the method: {each}" for each in method.deviations]
    stations = Quantity(id="stations", name="Stations", unit="1", value=method.stations)
    return typed(
        "usedMethod",
        "",
        title(method.name),
        words("description", "\n".join(said)),
        *(leaf("reference", each) for each in method.references),
        node(
            "usedMethodQuantities", node("usedMethodQuantity", title(stations.name), real(stations))
        ),
        basic="calibrationMethod",
    )


def _uncertainty_method(budget: Budget) -> ET.Element:
    factor, probability = budget.coverage_factor, budget.coverage_probability
    text = (
        "An expanded uncertainty is the standard uncertainty times the coverage factor that is stated with it. "
        f"In the uncertainty budget the factor is {factor:g}, the coverage probability {100 * probability:g} %."
    )
    return typed(
        "usedMethod",
        "",
        title("Uncertainty of measurement"),
        words("description", text),
        leaf("norm", "JCGM 100:2008"),
        basic="methodMeasurementUncertainty",
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
    return typed(
        "measuringEquipment",
        "",
        title(standard.name),
        container("identifications", numbers),
        container("measuringEquipmentQuantities", facts),
        basic="measurementStandard",
    )


def _condition(quantity: Quantity) -> ET.Element:
    kinds = {"temperature": quantity.unit == "°C", "humidityRelative": "humidity" in quantity.name}
    stated = _within("condition", quantity)
    return typed(
        "influenceCondition",
        quantity.id,
        title(quantity.name),
        node("data", _undetermined(stated) if stated.value is None else _quantity(stated)),
        basic=" ".join(kind for kind, applies in kinds.items() if applies),
    )


def _within(place: str, quantity: Quantity) -> Quantity:
    """The quantity with the id that it has in the whole certificate: clients give quantities without their place."""
    return replace(quantity, id=f"{place}/{quantity.id}")


def _quantity(quantity: Quantity, *metadata: Child, basic: str = _MEASURED_VALUE) -> Child:
    """A quantity with its value, none where it is undetermined; metadata are what is decided on it."""
    if quantity.value is None:
        return None
    return typed(
        "quantity",
        quantity.id,
        title(quantity.name or quantity.id),
        words("description", quantity.at),
        real(quantity),
        container("measurementMetaData", metadata),
        basic=basic,
    )


def _undetermined(quantity: Quantity) -> ET.Element:
    """The text in place of the number of a quantity that is undetermined."""
    name = title(quantity.name or quantity.id)
    text = content(f"{NO_VALUE} {quantity.at}")
    return typed("text", f"undetermined-{quantity.id}", name, text)


def _data(
    quantities: Iterable[Quantity], *head: Child, basic: str = _MEASURED_VALUE
) -> list[Child]:
    """A list of the quantities that have values, behind its head, and a text for each of the others."""
    quantities = list(quantities)
    values = [_quantity(each, basic=basic) for each in quantities if each.value is not None]
    listed = node("list", *head, *values) if values else None
    return [listed, *(_undetermined(each) for each in quantities if each.value is None)]


def _result(name: str, note: str, kind: str, data: list[Child]) -> ET.Element:
    stated: list[Child] = [child for child in data if child is not None]
    return typed(
        "result",
        kind,
        title(name),
        words("description", note),
        node("data", *(stated or [words("text", "No results.")])),
    )


def _name(text: str, simulated: bool) -> Child:
    return title(f"{text} ({SIMULATED})" if simulated else text)


def _calibration(certificate: Certificate) -> ET.Element:
    tables = [_table(table) for table in certificate.results]
    return typed(
        "measurementResult",
        "calibration",
        _name(certificate.title, certificate.simulated),
        node("results", *tables, _budget(certificate.budget)),
    )


def _table(table: ResultTable) -> ET.Element:
    quantities = (_within(table.id, each) for each in table.quantities)
    return _result(table.title, table.note, table.id, _data(quantities))


def _budget(budget: Budget) -> ET.Element:
    """A list for each source, of what it adds to the uncertainty of each angle; then their sum, and expanded.

    An angle of which no source says anything, as without a magnetometer, is undetermined in the sum alone.
    """
    known = [
        angle for angle in _ANGLES if any(_sd(line, angle) is not None for line in budget.lines)
    ]
    data = [child for line in budget.lines for child in _budget_line(line, known)]
    sums = [
        child
        for line in (budget.combined, budget.expanded)
        for child in _budget_line(line, _ANGLES)
    ]
    return _result("Uncertainty budget", budget.at, "uncertainty-budget", [*data, *sums])


def _sd(line: BudgetLine, angle: str) -> float | None:
    """The contribution of a line of the budget to an angle, degrees."""
    value: float | None = getattr(line, f"{angle}_deg")
    return value


def _budget_line(line: BudgetLine, angles: Iterable[str]) -> list[Child]:
    quantities = (
        Quantity(id=f"budget/{line.id}/{angle}", name=angle, unit="°", value=_sd(line, angle))
        for angle in angles
    )
    basis = words("description", f"Type {line.kind}. {line.basis}")
    return _data(quantities, title(line.source), basis, basic="")


def _roll_test(test: ConformityTest, simulated: bool) -> ET.Element:
    """A roll test as found (before adjustment) or as left (after it), with the decision on every limit."""
    before = test.when == "as found"
    state = node(
        "influenceCondition",
        title("State of the tool"),
        leaf("status", "beforeAdjustment" if before else "afterAdjustment"),
        node("data", words("text", test.when)),
    )
    decisions = [replace(d, quantity=_within(when_id(test), d.quantity)) for d in test.decisions]
    values = [_quantity(each.quantity, _decision(each, test)) for each in decisions]
    without = [each for each in decisions if each.quantity.value is None]
    texts = [_undetermined(each.quantity) for each in without]
    facts = (
        f"Run {test.run}, {test.stations} stations. Limits: {test.limits} ({test.source}). "
        f"Calibration SHA-256 {test.calibration_sha256}."
    )
    facts += f" {test.settings}" if test.settings else ""
    if test.not_judged:
        facts += f" Limits that were not judged: {', '.join(test.not_judged)}."
    if test.risk is not None:
        facts += f" Probability that the verdict is wrong, all limits together: {test.risk:.2g}."
    return typed(
        "measurementResult",
        test.when,
        _name(f"Roll test, {test.when}", simulated),
        words("description", facts),
        node("influenceConditions", state),
        node(
            "results",
            _result(f"Limits, {test.when}", "", test.when, [container("list", values), *texts]),
        ),
        node(
            "measurementMetaData",
            typed(
                "metaData",
                "verdict",
                title(f"Conformity, {test.when}"),
                conformity(test.passed),
                basic="conformity",
            ),
            *(_decision(each, test) for each in without),
            *(typed("metaData", f.id, words("declaration", f.text)) for f in test.findings),
        ),
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
        _quantity(
            Quantity(id=f"{decision.quantity.id}/{kind}", name=text, unit=one, value=value),
            basic="",
        )
        for kind, text, one, value in numbers
    )
    return typed(
        "metaData",
        decision.quantity.id,
        title(f"Decision on {name}"),
        words("declaration", decision.note),
        conformity(decision.passed),
        container("data", values),
        basic="conformity",
        refId=rule_id(test),
    )
