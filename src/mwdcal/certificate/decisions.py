"""Decisions on conformity: the rule, the guard band, and the risk of the decision that was taken.

The quantity that is judged is assumed normal about its value with its standard uncertainty.
Reference: JCGM 106:2012, 7 and 8; ILAC-G8:09/2019, 4.2 and 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from msgspec import UNSET

from mwdcal.calibration.record import UNNAMED, Calibration, Finding
from mwdcal.certificate.document import ConformityTest, DecisionRule, LimitDecision, Quantity
from mwdcal.files.verifications import Verification
from mwdcal.geometry.vectors import Array, ArrayLike
from mwdcal.use.verification import (
    COVERAGE,
    RULES,
    SETTING_PRACTICES,
    VerdictRow,
    fewest_degrees_of_freedom,
    guard,
    probability_within,
)

When: TypeAlias = Literal["as found", "as left"]
"""When a roll test was made: before or after the adjustment."""
GUARDED_RISK = "the probability that a tool which passes is outside the limit is at most 2.3 %"
SIMPLE_RISK = "the probability of a wrong decision reaches 50 % where the value is at its limit"
"""Largest risks of the rules of a verification: one-sided, beyond two standard uncertainties, and at the limit."""
PROBABILITY = 0.95
"""Coverage probability of every expanded uncertainty of a certificate."""
UNKNOWN_FREEDOM = Finding(
    id="freedom-not-stated",
    text=f"the test as found does not state the degrees of freedom of its calibration: its coverage factor is "
    f"{COVERAGE:g}, not Student's. Verify that calibration again, and save what is printed as JSON.",
)
"""Of a test with another calibration, in a document of an earlier version."""


def student_factor(freedom: ArrayLike) -> Array:
    """Coverage factor k of a value with some degrees of freedom, of which less than one count as one.

    Definition: Student's t for `PROBABILITY`, two-sided. Reference: JCGM 100:2008, G.3.
    """
    import numpy as np
    from scipy.special import stdtrit

    return np.asarray(stdtrit(np.maximum(freedom, 1.0), (1 + PROBABILITY) / 2))


def coverage_of(freedom: float | None) -> float:
    """Coverage factor of a value of a roll test: at least `COVERAGE`; None: unlimited degrees of freedom."""
    return COVERAGE if freedom is None else max(COVERAGE, float(student_factor(freedom)))


def expanded_of(row: VerdictRow) -> float | None:
    """U of a limit that was tested; None of a raw figure beyond it, whose scatter is not noise."""
    beyond = row.judged_raw and row.value is not None and row.value > row.limit
    if row.uncertainty is None or beyond:
        return None
    return coverage_of(row.freedom) * row.uncertainty


@dataclass(frozen=True)
class Rule:
    """A rule of decision: a guard band of some expanded uncertainties, none for simple acceptance.

    `guard_factor` is in units of U, or None for that of `verify`. `coverage`: factor of the U of values that
    do not state degrees of freedom of their own.
    """

    name: Literal["simple", "guarded"]
    text: str
    guard_factor: float | None
    coverage: float

    def factors(self, row: VerdictRow) -> tuple[float, float]:
        """Standard uncertainties of the guard band, and of U, of the value of a row."""
        coverage = self.coverage
        if row.degrees_of_freedom is not UNSET:
            coverage = coverage_of(row.freedom)
        if self.guard_factor is None:
            return guard(True, row.freedom), coverage
        return self.guard_factor * coverage, coverage

    def decision(self, row: VerdictRow) -> LimitDecision:
        """The decision on a limit."""
        value, sd, within, passed = row.value, row.uncertainty, None, False
        band, coverage = self.factors(row)
        if value is not None and sd is not None:
            passed = value + band * sd <= row.limit  # as `verify` decides, to the last digit
            if not row.judged_raw:
                within = probability_within(value, sd, row.limit, row.two_sided, row.freedom)
        quantity = Quantity(
            id=row.name.replace(" ", "-"),
            name=row.name,
            unit=row.unit,
            value=value,
            standard_uncertainty=sd,
            expanded_uncertainty=None if sd is None else coverage * sd,
            coverage_factor=None if sd is None else coverage,
            coverage_probability=None if sd is None else PROBABILITY,
        )
        return LimitDecision(
            quantity=quantity,
            limit=row.limit,
            acceptance_limit=None if sd is None else row.limit - band * sd,
            passed=passed,
            probability_within=within,
            risk=None if within is None else (1 - within if passed else within),
            note=row.note,
            degrees_of_freedom=row.freedom,
            raw=row.raw,
        )


def rule_of(verification: Verification, freedom: float | None, choice: DecisionRule | None) -> Rule:
    """The rule for a test: the verification's, unless the laboratory asks for the guarded one.

    The coverage factor of its uncertainties is at least `COVERAGE`, and Student's for the degrees of
    `freedom` of the calibration that was tested; `COVERAGE` where they are not known.
    """
    k = coverage_of(freedom)
    if choice is not None and choice.rule == "guarded":
        rule = Rule("guarded", "", choice.guard_factor, k)
        factors = {f"{rule.factors(row)[1]:.3g}" for row in verification.rows}
        text = (
            f"guarded acceptance: noise-free value + {choice.guard_factor:g} U must not exceed the limit, "
            f"U = {' or '.join(sorted(factors))} × its standard uncertainty"
        )
        text += f"; {choice.risk}" if choice.risk else ""
        return replace(rule, text=text)
    if verification.rule == RULES["guarded"]:
        return Rule("guarded", f"{verification.rule}; {GUARDED_RISK}", None, k)
    return Rule("simple", f"{verification.rule}; {SIMPLE_RISK}", 0.0, k)


def conformity(
    when: When,
    verification: Verification,
    calibration: Calibration,
    choice: DecisionRule | None,
) -> tuple[ConformityTest, list[Finding]]:
    """A roll test as the certificate shows it, and findings about its decisions and its coverage factor.

    The degrees of freedom are those of the calibration that was tested, as the verification states them. One of
    an earlier version states none: those of `calibration` serve a test as left, and none serve one as found.
    """
    freedom = verification.degrees_of_freedom
    if freedom is None and when == "as left":
        freedom = fewest_degrees_of_freedom(calibration)
    rule = rule_of(verification, freedom, choice)
    decisions = [rule.decision(row) for row in verification.rows]
    passed = all(decision.passed for decision in decisions)
    risk = verification.risk  # of the other verdict, if the laboratory's rule has led to it
    if any(row.judged_raw for row in verification.rows) or verification.not_judged:
        risk = None
    if risk is not None and passed != verification.passed:
        risk = 1 - risk
    test = ConformityTest(
        when=when,
        passed=passed,
        date=verification.date,
        run=verification.run or UNNAMED,
        stations=verification.stations,
        limits=verification.limits,
        source=verification.source,
        rule=rule.name,
        rule_text=rule.text,
        calibration_sha256=verification.calibration_sha256,
        decisions=decisions,
        findings=verification.findings,
        risk=risk,
        not_judged=verification.not_judged,
        settings=SETTING_PRACTICES.get(verification.settings, ""),
    )
    unknown = [UNKNOWN_FREEDOM] if freedom is None else []
    return test, unknown + _changed(when, verification, decisions)


def _changed(
    when: str, verification: Verification, decisions: Sequence[LimitDecision]
) -> list[Finding]:
    """A finding that names the decisions which the verification took otherwise."""
    other = [
        f"{row.name} {_word(row.passed)} by the rule of the verification, {_word(decision.passed)} by the laboratory's"
        for row, decision in zip(verification.rows, decisions, strict=True)
        if row.passed != decision.passed
    ]
    text = (
        f"decisions of the test {when} differ from those of the verification: {'; '.join(other)}."
    )
    return [Finding(id="decision-changed", text=text)] if other else []


def _word(passed: bool) -> str:
    return "passed" if passed else "failed"
