"""Verification: a calibration against independent readings and a limits profile. Pure data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import MARGIN, Calibration, Finding, html_table
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.use.departures import Departures, RollTest, Statistic

COVERAGE = 2.0
"""Coverage factor of the guard band and of the remark that a value is close to its limit."""
WEAK = 0.5
"""A test whose 1σ is a larger share of the limit hardly distinguishes a good tool from a bad one."""
NAMED_HARMONIC = 3.0
"""Standard uncertainties above which a harmonic is named as a cause."""
CAUSES = {
    "inclination": (
        "a bias of the accelerometer across the tool axis, or it leans",
        "a difference in scale, or a misalignment, of the accelerometer's x and y",
    ),
    "azimuth": (
        "a bias across the tool axis of either triad, or it leans",
        "a difference in scale, or a misalignment, of x and y of either triad",
    ),
    "gravity": (
        "a bias of the accelerometer across the tool axis, or its x or y is not square to z",
        "a difference in scale, or a misalignment, of the accelerometer's x and y",
    ),
}
"""What a first and a second harmonic of toolface come from; as for azimuth where not named."""


class Bounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Limits of one kind, each optional."""

    inclination_deg: float | None = None
    azimuth_deg: float | None = None
    toolface_deg: float | None = None
    gravity_g: float | None = None
    field_nt: float | None = None
    dip_deg: float | None = None

    def items(self) -> Iterable[tuple[str, float]]:
        """Observable and limit, of those that are set; angles in degrees."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if value is not None:
                yield name.rpartition("_")[0], value


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A limits profile: what a roll test may show, where the limits come from, and the rule.

    rule "simple": a noise-free value passes up to its limit. "guarded": value plus twice its
    standard uncertainty must not exceed the limit.
    """

    name: str
    source: str = ""
    rule: Literal["simple", "guarded"] = "simple"
    spread: Bounds = Bounds()
    error: Bounds = Bounds()


class VerdictRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit: the noise-free value, its standard uncertainty, and the decision.

    `raw` is the same figure with the noise in it: largest minus smallest value of a set as the
    papers define a spread, or the largest departure of any station. `harmonics` are the
    amplitudes of the first and second harmonic of toolface in the set that decided. None: it
    cannot be stated.
    """

    name: str
    unit: str
    value: float | None
    uncertainty: float | None
    limit: float
    passed: bool
    note: str
    raw: float | None = None
    harmonics: tuple[float, float] | None = None


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a verification."""

    passed: bool
    rule: str
    limits: str
    source: str
    run: str
    stations: int
    rows: list[VerdictRow]
    findings: list[Finding]

    def __repr__(self) -> str:
        failed = ", ".join(row.name for row in self.rows if not row.passed)
        decision = "passed" if self.passed else f"failed ({failed})"
        return f"<Verdict: {decision}, {len(self.rows)} limits of {self.limits}>"

    def _repr_html_(self) -> str:
        header = ("", "value", "1σ", "limit", "")
        lines = [
            (
                f"{row.name}, {row.unit}",
                *("" if v is None else f"{v:.3g}" for v in (row.value, row.uncertainty, row.limit)),
                "pass" if row.passed else "fail",
            )
            for row in self.rows
        ]
        return html_table("Passed" if self.passed else "Failed", [header, *lines])


RULES = {
    "simple": "simple acceptance: a noise-free value passes up to its limit; its 1σ is stated beside it",
    "guarded": "guarded acceptance: noise-free value + 2 × its 1σ must not exceed the limit",
}


def verify(calibration: Calibration, readings: Readings, limits: Limits) -> Verdict:
    """Apply a calibration to independent readings, and judge the result by a limits profile.

    Raises:
        InputError: stations of the fit, temperatures outside the calibrated range, or readings to
            which no limit applies.
    """
    for check in (_check_tool, _check_independent, _check_temperature):
        check(calibration, readings)
    test = RollTest(calibration, readings)
    outcomes = [(f"spread of {n}", n, most, test.spread(n)) for n, most in limits.spread.items()]
    outcomes += [(f"error of {n}", n, most, test.error(n)) for n, most in limits.error.items()]
    skipped = _skipped({title: outcome.skipped for title, *_, outcome in outcomes})
    guard = COVERAGE if limits.rule == "guarded" else 0.0
    judged = [_judged(*outcome, guard) for outcome in outcomes if not outcome[-1].skipped]
    if not judged:
        raise InputError(
            f"{readings.name}: no limit of '{limits.name}' applies: {'; '.join(skipped)}. Add what "
            "is missing, or choose other `limits`."
        )
    return Verdict(
        passed=all(row.passed for row, _ in judged),
        rule=RULES[limits.rule],
        limits=limits.name,
        source=limits.source,
        run=readings.source,
        stations=readings.count,
        rows=[row for row, _ in judged],
        findings=sum((about for _, about in judged), _findings(test, skipped)),
    )


def _skipped(reasons: dict[str, str]) -> list[str]:
    """Limits that were not judged, by reason."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(names[reason])} ({reason})" for reason in names if reason]


def _findings(test: RollTest, skipped: Sequence[str]) -> list[Finding]:
    """Findings about the verdict as a whole, and about limits that were not judged."""
    calibration = test.calibration
    findings = [*calibration.change_findings(), *_temperature_findings(calibration, test.readings)]
    findings += [Finding(id=u.id, text=f"{u.text}.") for u in calibration.undetermined()]
    if skipped:
        findings.append(Finding(id="not-judged", text=f"not judged: {'; '.join(skipped)}."))
    if not test.sets:
        findings.append(Finding(id="no-roll-set", text="no roll set: spreads were not judged."))
    return findings


def _temperature_findings(calibration: Calibration, readings: Readings) -> Iterable[Finding]:
    if readings.temperature is None:
        return
    tested = _span(float(readings.temperature.min()), float(readings.temperature.max()))
    if calibration.temperature_c is None:
        text = (
            f"the tool was calibrated at unrecorded temperatures, and tested at {tested} °C: "
            "the verdict holds for the temperatures of the test alone."
        )
        yield Finding(id="no-temperature", text=text)
    elif beyond := int(calibration.outside(readings, MARGIN).sum()):
        text = (
            f"{beyond} of {readings.count} stations ({tested} °C) lie outside the calibrated "
            f"range {_span(*calibration.temperature_c)} °C. The calibration has no temperature terms: drift "
            "over the difference counts as its error."
        )
        yield Finding(id="outside-temperature", text=text)


def _span(low: float, high: float) -> str:
    return f"{low:.1f}…{high:.1f}" if high - low >= 0.1 else f"{low:.1f}"


def _check_tool(calibration: Calibration, readings: Readings) -> None:
    if other := calibration.other_tool(readings):
        ours, theirs = other
        raise InputError(
            f"{readings.name} is of tool {theirs}, the calibration of tool {ours}. Verify with a "
            "run of the same tool, or correct 'serial' in the file."
        )


def _check_independent(calibration: Calibration, readings: Readings) -> None:
    seen = calibration.used(readings.digest)
    used = [label for label, old in zip(readings.labels, seen, strict=False) if old]
    if used:
        raise InputError(
            f"{readings.name}: {len(used)} of {readings.count} stations were in the fit (first: "
            f"station {used[0]}). Verification needs data that the fit has not seen: take a roll "
            "test of its own."
        )


def _check_temperature(calibration: Calibration, readings: Readings) -> None:
    outside = calibration.outside(readings)
    if outside.any() and calibration.temperature_c is not None:
        low, high = calibration.temperature_c
        first, count = int(np.flatnonzero(outside)[0]), int(outside.sum())
        raise InputError(
            f"{readings.name}: {count} {'station lies' if count == 1 else 'stations lie'} outside the calibrated range "
            f"{low:.1f}…{high:.1f} °C (first: station {readings.labels[first]}). Verify within "
            "the range, or calibrate over a wider one."
        )


def _judged(
    title: str, name: str, limit: float, outcome: Departures, guard: float
) -> tuple[VerdictRow, list[Finding]]:
    """The decision on one limit, by the worst set or station, and the findings about it."""
    inside, findings = OBSERVABLES[name].unit, [*_partial(title, outcome)]
    factor, unit = (float(np.degrees(1)), "°") if inside == "rad" else (1.0, inside)
    most = max((each.raw * factor for each in outcome.statistics), default=None)
    if outcome.blocked:
        row = VerdictRow(
            name=title, unit=unit, value=None if outcome.unrolled else most, uncertainty=None,
            limit=limit, passed=False, note=f"cannot be passed: {outcome.blocked}", raw=most,
        )  # fmt: skip
        return row, findings
    worst = max(outcome.statistics, key=lambda each: each.value + guard * each.uncertainty)
    value, sd = worst.value * factor, worst.uncertainty * factor
    passed = value + guard * sd <= limit
    note, harmonics = _remark(value, sd, limit, passed), _harmonics(worst, factor)
    row = VerdictRow(
        name=title, unit=unit, value=value, uncertainty=sd, limit=limit, passed=passed,
        note=f"{worst.where}{note}", raw=most, harmonics=harmonics,
    )  # fmt: skip
    return row, [*findings, *_weak(row), *_causes(row, name, worst)]


def _partial(title: str, outcome: Departures) -> Iterable[Finding]:
    """What of the run was not judged."""
    for text in outcome.apart:
        yield Finding(id="partly-judged", text=f"{title}: {text}.")
    if outcome.unseen:
        text = (
            f"{title}: the toolfaces hardly show one of the two harmonics of a turn (four at right "
            "angles do not show a misalignment of x and y): add toolfaces between them."
        )
        yield Finding(id="harmonic-unseen", text=text)


def _remark(value: float, sd: float, limit: float, passed: bool) -> str:
    """How close the decision was."""
    if value <= limit and not passed:
        return "; within the limit, but not by twice its uncertainty as the guarded rule asks"
    close = abs(value - limit) < COVERAGE * sd
    return "; closer to the limit than twice its uncertainty" if close else ""


def _harmonics(worst: Statistic, factor: float) -> tuple[float, float] | None:
    if worst.curve is None:
        return None
    first, second = worst.curve.amplitudes.tolist()
    return first * factor, second * factor


def _weak(row: VerdictRow) -> Iterable[Finding]:
    if row.uncertainty is not None and row.uncertainty > WEAK * row.limit:
        text = (
            f"{row.name}: its 1σ of {row.uncertainty:.2g} {row.unit} is more than half of the limit: this "
            "test can hardly tell a good tool from a bad one. Average longer at each station, or "
            "take more toolfaces."
        )
        yield Finding(id="weak-test", text=text)


def _causes(row: VerdictRow, name: str, worst: Statistic) -> Iterable[Finding]:
    """The likely causes of a failed limit, from the harmonics of the set that decided."""
    if row.passed or row.harmonics is None or worst.curve is None:
        return
    unit = row.unit if row.unit == "°" else f" {row.unit}"
    causes = CAUSES.get(name, CAUSES["azimuth"])
    size = worst.curve.amplitudes / np.maximum(worst.curve.amplitude_sd, 1e-30)
    each = zip(("first", "second"), row.harmonics, causes, size > NAMED_HARMONIC, strict=True)
    parts = [
        f"{which} harmonic {a:.2g}{unit} ({cause})" for which, a, cause, clear in each if clear
    ]
    if parts:
        text = f"{row.name} over a turn of toolface: {'; '.join(parts)}."
        yield Finding(id="roll-harmonics", text=text)
