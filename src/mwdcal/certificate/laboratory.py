"""`Laboratory`: what a laboratory states on its certificates beside the calibration, from a TOML file."""

from __future__ import annotations

import math
import os
import re
from datetime import date
from typing import Literal

import msgspec

from mwdcal.certificate.document import Party
from mwdcal.errors import InputError
from mwdcal.files.profiles import decoded_toml
from mwdcal.sensor.profile import MeasurementStandard, Person

NUMBER_FIELDS = ("serial", "date", "year", "digest")
"""What a pattern of certificate numbers may contain, in braces."""
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
