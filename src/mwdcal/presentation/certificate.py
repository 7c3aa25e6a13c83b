"""The numbers of a certificate as text: the same on screen, page and PDF.

A certificate on the screen: what it is of, its decisions with their risk, and its uncertainty budget.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mwdcal.calibration.prediction import STATED_ANGLES
from mwdcal.calibration.readings import SIMULATED
from mwdcal.certificate.document import (
    Budget,
    BudgetLine,
    Certificate,
    ConformityTest,
    LimitDecision,
    Quantity,
)
from mwdcal.presentation.numbers import (
    UNDETERMINED,
    contribution,
    exponent,
    files_written,
    fixed,
    measured,
    number,
    unit,
)
from mwdcal.presentation.numbers import quantity as in_unit
from mwdcal.presentation.text import NOT_STATED, chance, one_line, table
from mwdcal.presentation.verification import VERDICT_RISK

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


ASSUMED_EXACT = "exact"
"""In place of the share of a source that is assumed exact."""


def screen(certificate: Certificate, outputs: Sequence[Path]) -> str:
    """The certificate for people."""
    tests = [test for test in (certificate.as_found, certificate.as_left) if test]
    blocks = [
        "\n".join(map(one_line, heading(certificate))),
        *(_test(test) for test in tests),
        *([] if certificate.as_left else ["conformity was not tested"]),
        _budget(certificate.budget),
        *(
            [files_written(**{path.suffix[1:].upper(): path for path in outputs})]
            if outputs
            else []
        ),
    ]
    return "\n\n".join(blocks)


def heading(certificate: Certificate) -> list[str]:
    """Number and item, days, and who stands for it."""
    item, people = certificate.item, (certificate.measured_by, certificate.authorised_by)
    simulated = [SIMULATED] if certificate.simulated else []
    measured_by, authorised_by = (person.name if person else NOT_STATED for person in people)
    customer = certificate.customer.name if certificate.customer else NOT_STATED
    first = [f"certificate {certificate.number}", item.serial or NOT_STATED, item.type, *simulated]
    days = [f"calibrated {certificate.calibrated}", f"issued {certificate.issued}"]
    due = [f"next due {certificate.next_due}"] if certificate.next_due else []
    names = [f"customer {customer}", f"measured by {measured_by}", f"authorised by {authorised_by}"]
    return ["   ".join(parts) for parts in (first, days + due, names)]


def _test(test: ConformityTest) -> str:
    """A roll test: verdict, rule, and each decision with its risk."""
    outcome = "PASS" if test.passed else "FAIL"
    lines = [
        f"{outcome}   {test.when}   {test.run}   limits {test.limits}",
        f"rule: {test.rule_text}",
        *([test.settings] if test.settings else []),
        *([f"{VERDICT_RISK}: {chance(test.risk)}"] if test.risk is not None else []),
    ]
    header = ["", "raw", "value", "U", "limit", "accepted up to", "", "P within", "risk"]
    rows = [_decision(decision) for decision in test.decisions]
    return "\n".join(map(one_line, lines)) + "\n\n" + table(rows, header)


def _decision(decision: LimitDecision) -> list[str]:
    quantity = decision.quantity
    value, _, expanded = quantity_numbers(quantity)
    limits = (decision.limit, decision.acceptance_limit)
    shown = [in_unit(limit, quantity.unit) for limit in limits]
    raw = (
        NOT_STATED
        if decision.raw is None
        else measured(decision.raw, quantity.expanded_uncertainty)[0] + unit(quantity.unit)
    )
    verdict = "pass" if decision.passed else "FAIL"
    chances = [chance(p) for p in (decision.probability_within, decision.risk)]
    return [quantity.name, raw, value, expanded, *shown, verdict, *chances]


def _budget(budget: Budget) -> str:
    """The budget by source, with its sum and its expansion; no azimuth of a tool that has none."""
    lines = (*budget.lines, budget.combined, budget.expanded)
    names = [
        n
        for n in STATED_ANGLES
        if n != "azimuth" or any(line.azimuth_deg is not None for line in lines)
    ]
    rows = [_source(line, names, budget.combined) for line in lines]
    head = f"uncertainty budget (1σ), {budget.at}; k = {budget.coverage_factor:.3g}, {budget.coverage_probability:.0%}"
    return f"{one_line(head)}\n{table(rows, ['', 'kind', *names])}"


def _source(line: BudgetLine, names: Sequence[str], combined: BudgetLine) -> list[str]:
    total = line.id in ("combined", "expanded")
    keys = [f"{name}_deg" for name in names]
    shares = [_share(line, getattr(line, key), getattr(combined, key)) for key in keys]
    return [line.source, "" if total else line.kind, *shares]


def _share(line: BudgetLine, value: float | None, combined: float | None) -> str:
    """The contribution of a source to the uncertainty of an angle."""
    if line.basis.startswith("assumed exact"):
        return ASSUMED_EXACT
    return contribution(value, combined) + "°" * (value is not None)
