"""`Certificate`: everything that a calibration certificate states, once, for every form that it takes.

PDF, page, JSON and XML are made from this record alone, pictures apart. The fields follow
ISO/IEC 17025:2017, 7.8.2 (all reports), 7.8.4 (calibration certificates) and 7.8.6 (statements of conformity).
"""

from __future__ import annotations

import math
import os
import re
from datetime import date
from typing import Literal

import msgspec

from mwdcal.calibration.record import Finding, Signature
from mwdcal.errors import InputError
from mwdcal.files.documents import laid_out
from mwdcal.files.profiles import decoded_toml
from mwdcal.sensor.profile import MeasurementStandard, Person

CERTIFICATE_VERSION = 1
"""Version of the certificate's JSON: higher when a key goes, or changes its meaning."""


class Party(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A laboratory or a customer: name, lines of the address, and what else identifies it.

    `country`: ISO 3166-1 code of two capitals, which a digital calibration certificate states.
    """

    name: str
    address: list[str] = []
    country: str = ""
    contact: str = ""
    accreditation: str = ""


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """The tool that was calibrated."""

    type: str
    serial: str
    manufacturer: str = ""
    identification: dict[str, str] = {}
    condition: str = ""
    received: str = ""


class Quantity(msgspec.Struct, frozen=True, kw_only=True):
    """A value with its unit and uncertainty; None where it is undetermined, or nothing is stated.

    `expanded_uncertainty` is `coverage_factor` times `standard_uncertainty` and covers the value
    with the probability `coverage_probability`. `at`: where it holds, such as an attitude.
    """

    id: str
    name: str
    unit: str
    value: float | None
    standard_uncertainty: float | None = None
    expanded_uncertainty: float | None = None
    coverage_factor: float | None = None
    coverage_probability: float | None = None
    at: str = ""


class ResultTable(msgspec.Struct, frozen=True, kw_only=True):
    """Results that belong together, such as the parameters of a triad."""

    id: str
    title: str
    note: str = ""
    quantities: list[Quantity]


class BudgetLine(msgspec.Struct, frozen=True, kw_only=True):
    """The contribution of one source to the standard uncertainty of each angle, in degrees; None: undetermined.

    `kind`: "A" by statistics of the readings, "B" otherwise (JCGM 100, 4.2 and 4.3).
    """

    id: str
    source: str
    kind: Literal["A", "B"]
    basis: str
    inclination_deg: float | None
    toolface_deg: float | None
    azimuth_deg: float | None = None


class Budget(msgspec.Struct, frozen=True, kw_only=True):
    """The uncertainty budget of the angles at one attitude: lines, their sum of squares, and its expansion."""

    at: str
    lines: list[BudgetLine]
    combined: BudgetLine
    expanded: BudgetLine
    coverage_factor: float
    coverage_probability: float


class TracedStandard(msgspec.Struct, frozen=True, kw_only=True):
    """A measurement standard that the results are traceable to, and its own certificate."""

    quantity: str
    name: str
    serial: str = ""
    certificate: str = ""
    issuer: str = ""
    date: str = ""
    due: str = ""
    overdue: bool = False
    standard_uncertainty: str = ""


class LimitDecision(msgspec.Struct, frozen=True, kw_only=True):
    """A limit of a roll test and the decision on it.

    `acceptance_limit`: what the value must not exceed, the limit less the guard band.
    `probability_within`: that the true value is within the limit, given value and uncertainty; None where
    the uncertainty is not stated, or the value is raw. `risk`: of the wrong decision that was taken, from it.
    `degrees_of_freedom` of the uncertainty; None: unlimited, or not stated. `raw`: the value with the noise in it;
    None: not stated, as in documents of earlier versions.
    """

    quantity: Quantity
    limit: float
    acceptance_limit: float | None
    passed: bool
    probability_within: float | None
    risk: float | None
    note: str = ""
    degrees_of_freedom: float | None = None
    raw: float | None = None


class ConformityTest(msgspec.Struct, frozen=True, kw_only=True):
    """A roll test as the certificate shows it: as found, or as left.

    `risk`: probability that the verdict is wrong, all limits and roll sets together; None: not stated.
    `not_judged`: names of limits for which the test lacks something.
    `settings`: in words, how often the direction of the stand was set.
    """

    when: Literal["as found", "as left"]
    passed: bool
    date: str = ""
    run: str
    stations: int
    limits: str
    source: str
    rule: Literal["simple", "guarded"]
    rule_text: str
    calibration_sha256: str
    decisions: list[LimitDecision]
    findings: list[Finding] = []
    risk: float | None = None
    not_judged: list[str] = []
    settings: str = ""


class Method(msgspec.Struct, frozen=True, kw_only=True):
    """How the tool was calibrated: procedure, estimator and model, and what they rest on."""

    name: str
    text: str
    software: str
    model: str
    stations: int
    references: list[str] = []
    deviations: list[str] = []


class SourceFile(msgspec.Struct, frozen=True, kw_only=True):
    """A file that the certificate rests on: what it is, its path from the certificate's folder, its SHA-256."""

    id: str
    name: str
    sha256: str


class Certificate(msgspec.Struct, frozen=True, kw_only=True):
    """A calibration certificate. Dates are ISO 8601; angles in degrees, strengths in g and nT."""

    schema_version: int = CERTIFICATE_VERSION
    command: str = "certificate"
    software: str
    serial: str | None
    simulated: bool
    number: str
    title: str = "Calibration certificate"
    issued: str
    laboratory: Party | None = None
    place: str = ""
    customer: Party | None = None
    item: Item
    calibrated: str
    next_due: str = ""
    method: Method
    conditions: list[Quantity]
    results: list[ResultTable]
    budget: Budget
    traceability: list[TracedStandard]
    as_found: ConformityTest | None = None
    as_left: ConformityTest | None = None
    measured_by: Person | None = None
    authorised_by: Person | None = None
    statements: list[str]
    findings: list[Finding]
    files: list[SourceFile]
    signature: Signature | msgspec.UnsetType = msgspec.UNSET


def encode(certificate: Certificate) -> bytes:
    """The bytes of the certificate's JSON file, which its XML carries too."""
    return laid_out(msgspec.json.encode(certificate))


# --------------------------------------------------------------------------
# `Laboratory`: what a laboratory states on its certificates beside the calibration, from a TOML file.


NUMBER_FIELDS = ("serial", "date", "year", "digest")
"""Fields that a pattern of certificate numbers may contain, in braces."""
LARGEST_GUARD = 5.0
"""Largest guard factor: of the expanded uncertainty, as guard band."""
MOST_MONTHS = 1200
"""Longest interval to the next calibration."""


class ItemDetails(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The facts about the tool beside its serial: maker, type, condition, day of receipt, other marks."""

    manufacturer: str = ""
    type: str = ""
    condition: str = ""
    received: date | None = None
    identification: dict[str, str] = {}


class DecisionRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the laboratory decides on conformity, as agreed with its customer.

    "guarded": accepted up to the limit less `guard_factor` times the expanded uncertainty; `risk` says
    what that means to the customer.
    """

    rule: Literal["simple", "guarded"]
    guard_factor: float = 1.0
    risk: str = ""


class Recalibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the next calibration is due, in months after this one."""

    months: int


class LaboratoryCondition(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A condition during the calibration, such as the humidity, with its standard uncertainty."""

    name: str
    value: float
    unit: str = ""
    uncertainty: float | None = None


class Laboratory(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A laboratory file: nothing in it is mandatory.

    `number` is a pattern of certificate numbers, with `NUMBER_FIELDS` in braces.
    """

    place: str = ""
    number: str = ""
    laboratory: Party | None = None
    customer: Party | None = None
    item: ItemDetails = ItemDetails()
    measured_by: Person | None = None
    authorised_by: Person | None = None
    standards: tuple[MeasurementStandard, ...] = ()
    decision: DecisionRule | None = None
    recalibration: Recalibration | None = None
    conditions: tuple[LaboratoryCondition, ...] = ()


def load_laboratory(path: str | os.PathLike[str]) -> tuple[Laboratory, str]:
    """A laboratory file and the SHA-256 of its bytes.

    Raises:
        InputError: it is not one, or states what cannot be.
    """
    name = os.fspath(path)
    laboratory, digest = decoded_toml(name, Laboratory, "", "laboratory file", "Certificates")
    if problem := _problem(laboratory):
        raise InputError(f"{name}: {problem} Correct the file.")
    return laboratory, digest


def _problem(laboratory: Laboratory) -> str:
    """The statements that a laboratory cannot make; empty if it can make all."""
    named = {
        "laboratory.name": laboratory.laboratory,
        "customer.name": laboratory.customer,
        "measured_by.name": laboratory.measured_by,
        "authorised_by.name": laboratory.authorised_by,
        **{f"standards.name, entry {i}": s for i, s in enumerate(laboratory.standards, 1)},
        **{f"conditions.name, entry {i}": c for i, c in enumerate(laboratory.conditions, 1)},
    }
    for key, each in named.items():
        if each is not None and not each.name.strip():
            return f"key '{key}': must not be blank; got {each.name!r}."
    for entry in laboratory.standards:
        if entry.issued and entry.due and entry.due < entry.issued:
            return f"standard {entry.name!r}: 'due' must not be before 'issued'; got {entry.due}."
    for condition in laboratory.conditions:
        if not math.isfinite(condition.value) or not 0 <= (condition.uncertainty or 0) < math.inf:
            return f"condition {condition.name!r}: 'value' must be finite, and 'uncertainty' at least 0."
    rule, interval = laboratory.decision, laboratory.recalibration
    if rule and not 0 < rule.guard_factor <= LARGEST_GUARD:
        return f"key 'decision.guard_factor': must be above 0, at most {LARGEST_GUARD:g}; got {rule.guard_factor}."
    if interval and not 1 <= interval.months <= MOST_MONTHS:
        return f"key 'recalibration.months': must be between 1 and {MOST_MONTHS}; got {interval.months}."
    return number_problem(laboratory.number) if laboratory.number else ""


def number_problem(pattern: str) -> str:
    """Why a pattern cannot give certificate numbers; empty where it can."""
    filled = filled_pattern(pattern, **dict.fromkeys(NUMBER_FIELDS, ""))
    if "{digest}" in pattern and not {"{", "}"} & {*filled}:
        return ""
    fields = ", ".join(f"{{{name}}}" for name in NUMBER_FIELDS)
    return (
        f"key 'number': must be a pattern of {fields} that contains {{digest}}, by which no two "
        f"certificates share a number; got {pattern[:60]!r}."
    )


def filled_pattern(pattern: str, **values: str) -> str:
    """A pattern of numbers with its fields filled in; nothing else in braces means anything."""
    return re.sub(r"\{(\w+)\}", lambda field: values.get(field[1], field[0]), pattern)
