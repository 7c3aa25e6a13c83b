"""`certificate`: the contents of a calibration certificate, from a calibration and what the laboratory states.

Whatever ISO/IEC 17025:2017 asks for and nobody states becomes a finding in the certificate itself.

How the tool was calibrated, in the words of a certificate.

Traceability of a calibration's references, and whether that held on its day.
"""

from __future__ import annotations

import operator
import re
from calendar import monthrange
from collections.abc import Iterator, Mapping
from datetime import date
from itertools import product
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from mwdcal.calibration.diagnosis.identity import FROM_THE_FUTURE, UNIDENTIFIED, dated, unidentified
from mwdcal.calibration.fit_options import unusual
from mwdcal.calibration.options import ASSUMED, ASSUMED_PRACTICE
from mwdcal.calibration.readings import (
    CONSTANTS,
    NANOTESLA,
    check_day,
    is_simulated,
    serial_of,
    stated_day,
)
from mwdcal.calibration.record import (
    ALIGNMENT,
    LEAN,
    SOFTWARE,
    Calibration,
    Finding,
    TriadCalibration,
    blindness,
    canonical,
    exact_and_steady,
    rounded,
)
from mwdcal.calibration.results import TYPICAL, error_name, middle_temperature, without_temperature
from mwdcal.certificate.budget import (
    STAND_ANGLES,
    accuracy_with_factor,
    assumed_exact,
    attitude_in_words,
    budget,
    repeatability,
    settings_in_words,
)
from mwdcal.certificate.decisions import PROBABILITY, When, conformity, student_factor
from mwdcal.certificate.document import (
    Certificate,
    ConformityTest,
    Item,
    Laboratory,
    Method,
    Party,
    Quantity,
    ResultTable,
    SourceFile,
    TracedStandard,
    filled_pattern,
)
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files.verifications import Verification
from mwdcal.geometry.observables import TITLES
from mwdcal.sensor.profile import MeasurementStandard, Person
from mwdcal.use.verification import fewest_degrees_of_freedom

# --------------------------------------------------------------------------
# Conditions and results of a calibration as quantities with their expanded uncertainties.

STATED_INCLINATIONS = (float(np.radians(5.0)), TYPICAL, float(np.radians(90.0)))
"""Inclinations at which the accuracy of the angles is stated."""
ONE = "1"
"""Unit of a number."""
NUMBERS = ("gain", "scale", "misalignment")
"""Parameters without a unit, unless the triad is curved; all others have the unit of the field."""
AT_THE_PLACE = {
    "gravity": ("gravity", "gravity_g", "g", "gravity_g"),
    "field": ("strength of the magnetic field", "field", "nT", "field_nt"),
    "dip": ("dip of the magnetic field", "dip_deg", "°", "dip_deg"),
}
"""Title, key in `Calibration.earth`, unit, and key of `[stand]`, of what the place of the calibration had."""


def expanded(
    name: str,
    title: str,
    unit: str,
    value: float | None,
    sd: float | None,
    k: float | None,
    at: str = "",
) -> Quantity:
    """A quantity with standard and expanded uncertainty; without either where `sd` is None."""
    known = sd is not None and k is not None
    return Quantity(
        id=name,
        name=title,
        unit=unit,
        value=value,
        standard_uncertainty=sd,
        expanded_uncertainty=k * sd if sd is not None and k is not None else None,
        coverage_factor=k if known else None,
        coverage_probability=PROBABILITY if known else None,
        at=at,
    )


def conditions(calibration: Calibration, laboratory: Laboratory) -> list[Quantity]:
    """Temperatures of the run, gravity, field and dip at the place, and what the laboratory states beside."""
    normal = float(student_factor(np.inf))
    return [
        *_temperatures(calibration),
        *_place(calibration),
        *(
            expanded(f"condition-{i}", c.name, c.unit, c.value, c.uncertainty, normal)
            for i, c in enumerate(laboratory.conditions, 1)
        ),
    ]


def _temperatures(calibration: Calibration) -> Iterator[Quantity]:
    names = ("lowest", "highest")
    for name, value in zip(names, calibration.temperature_c or (), strict=False):
        yield Quantity(
            id=f"temperature-{name}", name=f"{name} tool temperature", unit="°C", value=value
        )


def _place(calibration: Calibration) -> Iterator[Quantity]:
    """Gravity, field and dip: estimated ones with the uncertainty of the estimate, others as declared.

    The coverage factor is Student's of the residuals where more is known by the readings than was declared.
    """
    fewest = fewest_degrees_of_freedom(calibration)
    constants = {constant.name: constant for constant in calibration.constants}
    for name, (title, key, unit, declared) in AT_THE_PLACE.items():
        if key not in calibration.earth or (name == "field" and calibration.relative):
            continue
        estimated, shared = constants.get(name), constants.get(error_name(name))
        sd = next((c.standard_uncertainty for c in (estimated, shared) if c), None)
        words = f"{title}, estimated" if estimated else title
        most = calibration.profile.stand.of(declared) ** 2 / 2
        by_readings = estimated or (shared and shared.standard_uncertainty**2 < most)
        k = float(student_factor(fewest if by_readings else np.inf))
        yield expanded(name, words, unit, calibration.earth[key], sd, k)


def result_tables(calibration: Calibration) -> list[ResultTable]:
    """Errors before and after, accuracy of the angles, and the parameters of each triad."""
    return [
        *([_errors(calibration)] if calibration.errors else []),
        _accuracy(calibration),
        *(_parameters(calibration, triad) for triad in calibration.triads),
    ]


def _errors(calibration: Calibration) -> ResultTable:
    """Root mean square errors of the stations before and after adjustment."""
    quantities = [
        Quantity(
            id=f"{row.observable}-{when}",
            name=f"error of {TITLES.get(row.observable, row.observable)}, rms, {when} adjustment",
            unit=row.unit,
            value=getattr(row, when),
        )
        for row in calibration.errors
        for when in ("before", "after")
    ]
    note = (
        f"{calibration.stations} stations. Before: with nominal scales and no bias or misalignment; after: "
        "with the parameters of this certificate, in the stations that they were fitted to."
    )
    return ResultTable(
        id="errors", title="Errors before and after adjustment", note=note, quantities=quantities
    )


def _accuracy(calibration: Calibration) -> ResultTable:
    """The error of each angle that a corrected reading has through the calibration: zero, with its uncertainty."""
    middle = middle_temperature(calibration)
    warm = dict.fromkeys(
        [middle, *(calibration.temperature_c or ())] if calibration.thermal else [middle]
    )
    quantities = []
    for temperature, inclination in product(sorted(warm), STATED_INCLINATIONS):
        each = accuracy_with_factor(calibration, inclination, temperature)
        at = attitude_in_words(inclination, temperature)
        for name, (sd, k) in each.items():
            place = f"{np.degrees(inclination):.0f}" + (
                f"-{temperature:.1f}c" if len(warm) > 1 else ""
            )
            value = None if sd is None else 0.0
            title = f"error of {name} after correction"
            quantities.append(expanded(f"{name}-{place}", title, "°", value, sd, k, at))
    note = "Of the calibration alone: the noise of a reading is not part of it."
    return ResultTable(
        id="accuracy", title="Accuracy of corrected angles", note=note, quantities=quantities
    )


def _parameters(calibration: Calibration, triad: TriadCalibration) -> ResultTable:
    """The parameters of a triad; none that the model holds at zero, and no value of an undetermined one."""
    k = float(student_factor(triad.freedom_of_noise))
    quantities, held = [], []
    columns = (triad.parameter_names, triad.parameters, triad.standard_uncertainties)
    for name, value, sd in zip(*columns, strict=True):
        if sd == 0 and value == 0:
            held.append(name)
            continue
        title, unit = parameter_in_words(triad, name)
        quantities.append(expanded(name, title, unit, None if sd is None else value, sd, k))
    notes = [
        f"Model {triad.model} of order {triad.order}, reference temperature "
        f"{calibration.reference_temperature:g} °C; {triad.rank} of {triad.size} parameters determined, "
        f"{triad.degrees_of_freedom:.0f} degrees of freedom.",
        *(f"{each.text}." for each in triad.undetermined),
        *([f"Held at zero by the model: {', '.join(held)}."] if held else []),
    ]
    title = f"Parameters of the {triad.name}"
    return ResultTable(id=triad.name, title=title, note=" ".join(notes), quantities=quantities)


def parameter_in_words(triad: TriadCalibration, name: str) -> tuple[str, str]:
    """A parameter's name without its power of temperature, and its unit.

    `gain-xy·2` is the coefficient of (T - reference)² in the gain of x by y, in 1/°C².
    """
    base, _, power = name.partition("·")
    kind = base.rpartition("-")[0]
    plain = triad.unit not in ("g", NANOTESLA) or (kind in NUMBERS and not triad.curved)
    unit = ONE if plain else triad.unit
    per = {"": "", "0": "", "1": "/°C"}.get(power, f"/°C{power}")
    title = base.replace("-", " ", 1)
    return (f"{title}, per (T − reference)^{power}" if per else title), unit + per


DOCUMENTATION = "mwdcal documentation, Methods"
MOOSAVI = "S. M. Seyed Moosavi et al., Error Analysis in Accelerometers Calibration of MWD Instruments (2016)"
MORADI = "M. Moradi, I. Izadi, calibration of MWD sensors by particle swarm optimisation (2019)"
PROCEDURE = (
    "Readings of the tool at rest in many attitudes are taken, and the parameters of the sensor model "
    "are fitted "
)
METHODS: dict[str, tuple[str, tuple[str, ...]]] = {
    "joint": ("to all references at once by weighted least squares.", ()),
    "least-squares": ("to the reference vectors by least squares.", (MORADI,)),
    "swarm": ("to the reference vectors by a particle swarm.", (MORADI,)),
    "newton": ("to the strength of gravity and the inclination by Newton's method.", (MOOSAVI,)),
    "toolface-inclination": ("to toolface and inclination alone.", ()),
    "scalar": ("to the strengths of gravity and field alone.", ()),
}
"""The evidence that each method fits the parameters to, and where it is published."""


def method(calibration: Calibration) -> Method:
    """The method of a calibration, its model, and how it deviates from the usual procedure."""
    text, papers = METHODS.get(calibration.method, (f"by the method {calibration.method}.", ()))
    stand = calibration.tool.get("stand", "")
    return Method(
        name=calibration.method,
        text=PROCEDURE + text,
        software=calibration.software,
        model="; ".join(map(_model, calibration.triads)),
        stations=calibration.stations,
        references=[DOCUMENTATION, *papers, *([f"stand: {stand}"] if stand else [])],
        deviations=list(_deviations(calibration)),
    )


def _model(triad: TriadCalibration) -> str:
    curved = ", with own-axis quadratic and cubic terms" if triad.curved else ""
    return f"{triad.name}: {triad.model}, temperature order {triad.order}{curved}"


def _deviations(calibration: Calibration) -> Iterator[str]:
    """The departures from the usual procedure, a phrase each."""
    if without_temperature(calibration):
        yield f"{without_temperature(calibration)}: the results hold at the temperature of the calibration alone"
    if calibration.excluded:
        yield f"stations excluded from the fit: {', '.join(calibration.excluded)}"
    yield from unusual(calibration.options, "deviation")
    if calibration.relative:
        yield "strength of the field unknown: the magnetometer is calibrated to a field of 1"


DIGEST_DIGITS = 12
"""Hexadecimal digits of the contents' SHA-256 in a certificate number."""
NUMBER_PATTERN = "{serial}-{date}-{digest}"
"""How a certificate number is made, unless the laboratory has a pattern of its own."""
LONGEST_NUMBER = 64
"""Characters of a certificate number."""
NOT_TESTED = "Conformity was not tested: no roll test after the calibration was supplied."
DATE_OF_FIT = (
    "the run states no date: the day on which the calibration was computed is used as that of the "
    "measurements."
)
NO_AS_FOUND = "No roll test before the adjustment (as found) was supplied."
STATEMENTS = (
    "The results relate only to the item that was calibrated.",
    "This certificate must not be reproduced except in full without the approval of the laboratory.",
    "The expanded uncertainty is the standard uncertainty multiplied by the coverage factor k, which by Student's t "
    "for the degrees of freedom corresponds to a coverage probability of about 95 % (JCGM 100:2008).",
)
"""Statements of every certificate."""


class CertificateRequest(msgspec.Struct, frozen=True, kw_only=True):
    """The facts of one certificate, beside its calibration and the laboratory.

    `customer`, `condition` and `received` override those of the laboratory file; `number` before its
    pattern. `verification` (as left) and `as_found` are roll tests with this and with the previous calibration;
    `calibration_sha256` is of the file of this one. `findings` are about the files themselves, such as their
    signatures.
    """

    issued: date
    number: str = ""
    customer: str = ""
    condition: str = ""
    received: date | None = None
    verification: Verification | None = None
    as_found: Verification | None = None
    calibration_sha256: str
    files: tuple[SourceFile, ...] = ()
    findings: tuple[Finding, ...] = ()


@np.errstate(over="ignore", invalid="ignore")  # what is infinite is refused when it is hashed
def certificate(
    calibration: Calibration, order: CertificateRequest, laboratory: Laboratory | None = None
) -> Certificate:
    """The certificate of a calibration, with every number at 12 significant digits.

    The number is made of the serial, the date of issue and the SHA-256 of all else.
    """
    stated = laboratory or Laboratory()
    check_day(calibration.tool, "the calibration")
    day, day_stated = calibration.day, stated_day(calibration.tool)
    _check_days(day, order, stated)
    given: dict[When, Verification | None] = {
        "as found": order.as_found,
        "as left": order.verification,
    }
    tests, changed = _tests(calibration, order, given, stated)
    contents = Certificate(
        software=SOFTWARE,
        serial=serial_of(calibration.tool),
        simulated=_simulated(calibration, order),
        number="",
        issued=order.issued.isoformat(),
        **_parties(calibration, order, stated),
        item=_item(calibration, order, stated),
        calibrated=day.isoformat(),
        next_due=_next_due(day, stated),
        method=method(calibration),
        conditions=conditions(calibration, stated),
        results=[*result_tables(calibration), *repeatability(given)],
        budget=budget(calibration),
        traceability=traced(calibration, stated, day),
        as_found=tests.get("as found"),
        as_left=tests.get("as left"),
        statements=_statements(tests),
        findings=[],
        files=list(order.files),
    )
    unstated_day = [] if day_stated else [Finding(id="date-not-stated", text=DATE_OF_FIT)]
    findings = [
        *order.findings,
        *_findings(contents, calibration),
        *unstated_day,
        *dated({"date": contents.issued}, "the certificate"),
        *(_order_of_days(tests, day) if day_stated else ()),
        *changed,
        *calibration.findings,
    ]
    whole = rounded(replace(contents, findings=findings))
    number = order.number or _number(whole, stated.number or NUMBER_PATTERN)
    _check_number(number)
    return replace(whole, number=number)


def _parties(
    calibration: Calibration, order: CertificateRequest, laboratory: Laboratory
) -> dict[str, Any]:
    """Laboratory, customer and people: as the laboratory states them, else as the run does."""
    return {
        "laboratory": laboratory.laboratory or _party(calibration.tool.get("lab", "")),
        "place": laboratory.place,
        "customer": _party(order.customer) or laboratory.customer,
        "measured_by": laboratory.measured_by or _person(calibration.tool.get("operator", "")),
        "authorised_by": laboratory.authorised_by,
    }


def _findings(contents: Certificate, calibration: Calibration) -> Iterator[Finding]:
    """The findings about the certificate: changes, gaps, overdue standards, exact references."""
    yield from calibration.change_findings()
    yield from _not_stated(contents, calibration)
    for standard in contents.traceability:
        yield from _out_of_date(standard, contents.calibrated)
    yield from _exact(calibration)
    if calibration.settings == ASSUMED_PRACTICE:
        yield Finding(id="settings-assumed", text=ASSUMED)


def _check_days(day: date, order: CertificateRequest, laboratory: Laboratory) -> None:
    """Refuse a certificate from before the calibration, and a tool that was received after it."""
    received = order.received or laboratory.item.received
    if order.issued < day:
        raise InputError(
            f"`date` must not be before the day of the calibration, {day}; got {order.issued}. Correct one of them."
        )
    if received and received > day:
        raise InputError(
            f"`received` must not be after the day of the calibration, {day}; got {received}. Correct one of them."
        )


def _order_of_days(tests: Mapping[str, ConformityTest], day: date) -> Iterator[Finding]:
    """A finding if a test as found was made after the day of the calibration, or one as left before it."""
    for when, wrong in (("as found", operator.gt), ("as left", operator.lt)):
        test_day = stated_day({"date": tests[when].date}) if when in tests else None
        if test_day and wrong(test_day, day):
            side = "after" if test_day > day else "before"
            text = (
                f"the roll test {when} was made on {test_day}, {side} the day of the calibration, {day}: check that it "
                f"shows the tool {when}."
            )
            yield Finding(id="test-date", text=text)


def _check_number(number: str) -> None:
    """Refuse a number that cannot stand on one line of every page."""
    if not number.strip() or len(number) > LONGEST_NUMBER or not number.isprintable():
        raise InputError(
            f"`number` must be 1 to {LONGEST_NUMBER} printable characters; got {number[:80]!r}. Choose another."
        )


def _tests(
    calibration: Calibration,
    order: CertificateRequest,
    given: Mapping[When, Verification | None],
    laboratory: Laboratory,
) -> tuple[dict[str, ConformityTest], list[Finding]]:
    """The roll tests by when they were made, and findings about their decisions."""
    tests: dict[str, ConformityTest] = {}
    findings: list[Finding] = []
    for when, document in given.items():
        if document is not None:
            _check_test(document, calibration, order)
            _check_issued(document, order)
            tests[when], about = conformity(when, document, calibration, laboratory.decision)
            findings += about + _doubts(document, calibration, order)
    return tests, findings


def _check_test(
    document: Verification, calibration: Calibration, order: CertificateRequest
) -> None:
    """Refuse a roll test of another tool, or with the wrong one of the two calibrations."""
    as_left = document is order.verification
    argument = _argument(document, order)
    serial = serial_of(calibration.tool)
    if serial and document.serial and document.serial != serial:
        raise InputError(
            f"{argument} is of tool {document.serial}, the calibration of tool {serial}. Name a roll test of the "
            "same tool."
        )
    if as_left and document.calibration_sha256 != order.calibration_sha256:
        other, this = (each.calibration_sha256[:16] for each in (document, order))
        raise InputError(
            f"{argument} is a test of another calibration (SHA-256 {other}…): it must be of this one ({this}…). "
            "Verify this calibration, and save what is printed as JSON."
        )
    if not as_left and document.calibration_sha256 == order.calibration_sha256:
        raise InputError(
            f"{argument} is a test of this very calibration: it must be of the one that was in the tool before. "
            "Verify that one by readings from before the adjustment, or leave it out."
        )


def _doubts(
    document: Verification, calibration: Calibration, order: CertificateRequest
) -> list[Finding]:
    """The findings about the identity of a roll test, and whether it states that it is of the calibration's tool."""
    said = [each for each in document.findings if each.id in (UNIDENTIFIED, FROM_THE_FUTURE)]
    serials = {
        _argument(document, order): document.serial,
        "the calibration": serial_of(calibration.tool),
    }
    return said or unidentified(serials)


def _argument(document: Verification, order: CertificateRequest) -> str:
    return "`verification`" if document is order.verification else "`as_found`"


def _check_issued(document: Verification, order: CertificateRequest) -> None:
    """Refuse a certificate from before a roll test that it shows."""
    stated, argument = {"date": document.date}, _argument(document, order)
    check_day(stated, argument)
    test_day = stated_day(stated)
    if test_day and order.issued < test_day:
        raise InputError(
            f"`date` must not be before the day of {argument}, {test_day}; got {order.issued}. Correct one of them."
        )


def _simulated(calibration: Calibration, order: CertificateRequest) -> bool:
    documents = [each for each in (order.as_found, order.verification) if each]
    marked = calibration.simulated or is_simulated(calibration.tool)
    return marked or any(each.simulated for each in documents)


def _party(name: str) -> Party | None:
    return Party(name=name) if name.strip() else None


def _person(name: str) -> Person | None:
    return Person(name=name) if name.strip() else None


def _item(calibration: Calibration, order: CertificateRequest, laboratory: Laboratory) -> Item:
    details = laboratory.item
    received = order.received or details.received
    return Item(
        type=details.type or calibration.tool_type,
        serial=calibration.tool.get("serial", ""),
        manufacturer=details.manufacturer,
        identification=details.identification,
        condition=order.condition or details.condition,
        received=received.isoformat() if received else "",
    )


def _next_due(day: date, laboratory: Laboratory) -> str:
    """The day of the next calibration, by the laboratory's interval; empty where none is stated."""
    if laboratory.recalibration is None:
        return ""
    years, month = divmod(day.month - 1 + laboratory.recalibration.months, 12)
    year = min(day.year + years, date.max.year)
    last = monthrange(year, month + 1)[1]
    return date(year, month + 1, min(day.day, last)).isoformat()


def _statements(tests: dict[str, ConformityTest]) -> list[str]:
    """The statements of every certificate, and those it must make of tests that it lacks or of their rule."""
    rules = dict.fromkeys(test.rule_text for test in tests.values())
    return [
        *STATEMENTS,
        *(f"Decision rule: {rule}." for rule in rules),
        *([] if "as left" in tests else [NOT_TESTED]),
        *([] if "as found" in tests else [NO_AS_FOUND]),
    ]


def _not_stated(contents: Certificate, calibration: Calibration) -> Iterator[Finding]:
    """A finding that names what ISO/IEC 17025:2017, 7.8.2.1, 7.8.4.1 and 7.8.6, ask for and nobody states."""
    laboratory = contents.laboratory
    traceable = {standard.quantity for standard in contents.traceability}
    lacking = {
        "laboratory": laboratory is None,
        "address of the laboratory": laboratory is not None and not laboratory.address,
        "place of the calibration": not contents.place,
        "customer": contents.customer is None,
        "serial of the item": not contents.item.serial,
        "condition of the item": not contents.item.condition,
        "measured by": contents.measured_by is None,
        "authorised by": contents.authorised_by is None,
        **{
            f"traceability of {'' if quantity == 'gravity' else 'the '}{quantity}": quantity
            not in traceable
            for quantity in references_in_use(calibration)
        },
    }
    names = [name for name, missing in lacking.items() if missing]
    if names:
        text = f"not stated: {', '.join(names)}."
        yield Finding(id="not-stated", text=text)


def _out_of_date(standard: TracedStandard, calibrated: str) -> Iterator[Finding]:
    """A finding if the calibration of a standard was not valid on the day of this one."""
    name, this = (
        f"the {standard.quantity} standard {standard.name}",
        f"this calibration ({calibrated})",
    )
    if standard.overdue:
        text = f"the calibration of {name} was due on {standard.due}, before the day of {this}."
        yield Finding(id="standard-overdue", text=text)
    if standard.date > calibrated:
        text = (
            f"{name} was calibrated on {standard.date}, after the day of {this}: name that before."
        )
        yield Finding(id="standard-later", text=text)


def _exact(calibration: Calibration) -> Iterator[Finding]:
    names, steady = exact_and_steady(assumed_exact(calibration))
    if steady:
        unseen = blindness(calibration.unseen)
        text = f"{steady}. {unseen[:1].upper()}{unseen[1:]}." if unseen else f"{steady}."
        yield Finding(id="assumed-steady", text=text)
    if names:
        text = (
            f"assumed exact in the budget: {', '.join(names)}. State their uncertainty in [stand] of the tool "
            f"profile, and calibrate again.{f' {LEAN}.' if ALIGNMENT in names else ''}"
        )
        yield Finding(id="assumed-exact", text=text)


def _number(contents: Certificate, pattern: str) -> str:
    """The number of a certificate, from what it says."""
    digest = sha256_of(canonical(msgspec.to_builtins(contents)))
    serial = re.sub(r"[^A-Za-z0-9._]+", "-", contents.item.serial).strip("-")[:40]
    return filled_pattern(
        pattern,
        serial=serial or "tool",
        date=contents.issued.replace("-", ""),
        year=contents.issued[:4],
        digest=digest[:DIGEST_DIGITS],
    )


def references_in_use(calibration: Calibration) -> list[str]:
    """Quantities whose references the results rest on: the stand, gravity, field, dip, temperature."""
    known = {row.observable for row in calibration.errors}
    estimated = {constant.name for constant in calibration.constants}
    unused = (
        estimated | {*calibration.options.ignore} | ({"field"} if calibration.relative else set())
    )
    return [
        *(["stand"] if known.intersection(STAND_ANGLES) else []),
        *(name for name in CONSTANTS if name in known - unused),
        *(["temperature"] if calibration.thermal else []),
    ]


def traced(calibration: Calibration, laboratory: Laboratory, day: date) -> list[TracedStandard]:
    """The standards of profile and laboratory, which replaces one of the same quantity and name."""
    declared = calibration.profile.standards
    standards = () if isinstance(declared, msgspec.UnsetType) else declared
    named = {(each.quantity, each.name): each for each in (*standards, *laboratory.standards)}
    return [_traced(calibration, standard, day) for standard in named.values()]


def _traced(calibration: Calibration, standard: MeasurementStandard, day: date) -> TracedStandard:
    issued, due = standard.issued, standard.due
    return TracedStandard(
        quantity=standard.quantity,
        name=standard.name,
        serial=standard.serial,
        certificate=standard.certificate,
        issuer=standard.issuer,
        date=issued.isoformat() if issued else "",
        due=due.isoformat() if due else "",
        overdue=due is not None and due < day,
        standard_uncertainty=_uncertainty(calibration, standard.quantity),
    )


def _uncertainty(calibration: Calibration, quantity: str) -> str:
    """The declared 1σ of a reference in words; empty where none is."""
    stand = calibration.profile.stand
    if quantity == "stand":
        return settings_in_words(calibration).removeprefix(": ")
    units = {"gravity": "g", "field": "nT", "dip": "°"}
    sd = getattr(
        stand,
        {"field": "field_nt", "gravity": "gravity_g", "dip": "dip_deg"}.get(quantity, ""),
        0.0,
    )
    unit = units.get(quantity, "")
    return f"{sd:.2g}{'' if unit == '°' else ' '}{unit}" if sd else ""
