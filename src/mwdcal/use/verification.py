"""Verification: a calibration against independent readings and a limits profile. Pure data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np

from mwdcal.calibration.notebooks import html_table
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import MARGIN, Calibration, Finding, stated
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.use.departures import LEVEL, Departures, RollTest, Statistic

COVERAGE = 2.0
"""Coverage factor of the guard band and of the remark that a value is close to its limit."""
SPREAD_OF = "spread of "
"""How the name of a limit on a spread begins."""
WEAK = 0.5
"""A test whose 1σ is a larger share of the limit hardly distinguishes a good tool from a bad one."""
NAMED_HARMONIC = 3.0
"""Standard uncertainties above which a harmonic is named as a cause."""
FIRST_HARMONIC = {
    "inclination": "a bias of the accelerometer across the tool axis, or it leans",
    "azimuth": "a bias across the tool axis of either triad, or it leans",
    "gravity": "a bias of the accelerometer across the tool axis, or its x or y is not square to z",
}
"""What a first harmonic of toolface comes from; as for azimuth where not named."""
SECOND_HARMONIC = "a difference in scale, or a misalignment, of "
"""What a second harmonic comes from."""
VERDICT_FINDINGS = {
    "no-temperature": "the tool was calibrated at unrecorded temperatures, and tested at {tested} °C: "
    "the verdict holds for the temperatures of the test alone.",
    "outside-temperature": "{where} lie outside the calibrated range {calibrated} °C. The calibration has no "
    "temperature terms: drift over the difference counts as its error.",
    "not-judged": "not judged: {limits}.",
    "no-roll-set": "no roll set: spreads were not judged.",
    "harmonic-unseen": "{title}: the toolfaces hardly show one of the two harmonics of a turn (four at right "
    "angles do not show a misalignment of x and y): add toolfaces between them.",
    "weak-test": "{row.name}: its 1σ of {row.uncertainty:.2g} {row.unit} is more than half of the limit: this "
    "test can hardly tell a good tool from a bad one. Average longer at each station, or take more toolfaces.",
    "roll-harmonics": "{row.name} over a turn of toolface: {causes}.",
}


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
        for name, value in msgspec.structs.asdict(self).items():
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


class JudgedSet(msgspec.Struct, frozen=True, kw_only=True):
    """What one roll set shows of one limit, or, without a `label`, the stations outside of roll sets.

    `stations` are their places in `Verdict.station_rows`, from 0. `coefficients` of the curve that
    was judged: mean, cos t, cos 2t, sin t, sin 2t of toolface t, in the unit of the limit; None:
    the set was not rolled, or the figure judged is the raw one of each station.
    """

    label: str
    stations: list[int]
    coefficients: list[float] | None
    value: float
    uncertainty: float
    passed: bool


class VerifiedStation(msgspec.Struct, frozen=True, kw_only=True):
    """One station of the test: attitude as corrected, and what it shows of each limit, noise included.

    `toolface_deg` is the one by which the tool was rolled: near vertical the magnetic one.
    `departures`, by name of the limit and in its unit: of an error, the error; of a spread, the
    departure from the middle of its roll set's curve. `over` names the limits that they exceed; of a
    spread, by more than half of it.
    """

    station: str
    temperature_c: float | None
    inclination_deg: float | None
    azimuth_deg: float | None
    toolface_deg: float | None
    departures: dict[str, float]
    over: list[str]


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
    sets: list[JudgedSet] = []

    @property
    def bound(self) -> float:
        """What a departure may be, up or down: the limit on an error, half of that on a spread."""
        return self.limit / 2 if self.name.startswith(SPREAD_OF) else self.limit


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a verification; `date` as the run states it.

    `degrees_of_freedom`: of the triad of the calibration with the fewest, on which the standard
    uncertainties rest. None: a document of an earlier version.
    """

    passed: bool
    rule: str
    limits: str
    source: str
    run: str
    date: str = ""
    stations: int
    rows: list[VerdictRow]
    findings: list[Finding]
    station_rows: list[VerifiedStation] = []
    degrees_of_freedom: float | None = None

    plot: ClassVar[Any]
    """Figures of the verdict, as `Calibration.plot`."""

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
    outcomes = [(SPREAD_OF + n, n, most, test.spread(n)) for n, most in limits.spread.items()]
    outcomes += [(f"error of {n}", n, most, test.error(n)) for n, most in limits.error.items()]
    skipped = _skipped({title: outcome.skipped for title, *_, outcome in outcomes})
    guard = COVERAGE if limits.rule == "guarded" else 0.0
    outcomes = [outcome for outcome in outcomes if not outcome[-1].skipped]
    judged = [_judged(*outcome, guard) for outcome in outcomes]
    if not judged:
        raise InputError(
            f"{readings.name}: no limit of '{limits.name}' applies: {'; '.join(skipped)}. Add what "
            "is missing, or choose other `limits`."
        )
    rows = [row for row, _ in judged]
    return Verdict(
        passed=all(row.passed for row in rows),
        rule=RULES[limits.rule],
        limits=limits.name,
        source=limits.source,
        run=readings.source,
        date=str(readings.metadata.get("date", "")),
        stations=readings.count,
        rows=rows,
        findings=sum((about for _, about in judged), [*_findings(test, skipped)]),
        station_rows=_station_rows(test, rows, [outcome[-1] for outcome in outcomes]),
        degrees_of_freedom=fewest_degrees_of_freedom(calibration),
    )


def fewest_degrees_of_freedom(calibration: Calibration) -> float:
    """Degrees of freedom of the residuals of the triad that has the fewest."""
    return min(triad.degrees_of_freedom for triad in calibration.triads)


def _station_rows(
    test: RollTest, rows: Sequence[VerdictRow], outcomes: Sequence[Departures]
) -> list[VerifiedStation]:
    """Every station of the test, with its departures in each row that has statistics of it."""
    readings = test.readings
    departures: list[dict[str, float]] = [{} for _ in range(readings.count)]
    for row, outcome in zip(rows, outcomes, strict=True):
        factor = _scale(row.unit)
        for statistic in outcome.statistics:
            for i, part in zip(statistic.index, (statistic.part * factor).tolist(), strict=True):
                departures[i][row.name] = part
    bounds = {row.name: row.bound for row in rows}
    attitude = test.value("inclination"), test.value("azimuth"), test.toolface
    warmth = (
        np.full(readings.count, np.nan) if readings.temperature is None else readings.temperature
    )
    each = np.stack([warmth, *np.degrees(attitude)], -1)
    names = ("temperature_c", "inclination_deg", "azimuth_deg", "toolface_deg")
    return [
        VerifiedStation(
            station=label,
            **dict(zip(names, map(stated, values), strict=True)),
            departures=shown,
            over=[name for name, value in shown.items() if abs(value) > bounds[name]],
        )
        for label, values, shown in zip(readings.labels, each, departures, strict=True)
    ]


def _skipped(reasons: dict[str, str]) -> list[str]:
    """Limits that were not judged, by reason."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(names[reason])} ({reason})" for reason in names if reason]


def _findings(test: RollTest, skipped: Sequence[str]) -> Iterator[Finding]:
    """Findings about the verdict as a whole, and about limits that were not judged."""
    calibration, readings = test.calibration, test.readings
    warmth = readings.temperature
    tested = "" if warmth is None else _span(float(warmth.min()), float(warmth.max()))
    yield from calibration.change_findings()
    if calibration.unrecorded(readings):
        yield _finding("no-temperature", tested=tested)
    if beyond := int(calibration.outside(readings, MARGIN).sum()):
        where = f"{beyond} of {readings.count} stations ({tested} °C)"
        calibrated = _span(*calibration.temperature_c or (np.nan, np.nan))
        yield _finding("outside-temperature", where=where, calibrated=calibrated)
    for free in calibration.undetermined():
        yield Finding(id=free.id, text=f"{free.text}.")
    if skipped:
        yield _finding("not-judged", limits="; ".join(skipped))
    if not test.sets:
        yield _finding("no-roll-set")


def _finding(name: str, **values: object) -> Finding:
    return Finding(id=name, text=VERDICT_FINDINGS[name].format(**values))


def _span(low: float, high: float) -> str:
    return f"{low:.1f}…{high:.1f}" if high - low >= 0.1 else f"{low:.1f}"


def _check_tool(calibration: Calibration, readings: Readings) -> None:
    if other := calibration.other_tool(readings):
        raise InputError(
            f"{readings.name} is of tool {other[1]}, the calibration of tool {other[0]}. Verify with a "
            "run of the same tool, or correct 'serial' in the file."
        )


def _check_independent(calibration: Calibration, readings: Readings) -> None:
    used = np.flatnonzero(calibration.used(readings.digest))
    if used.size:
        raise InputError(
            f"{readings.name}: {used.size} of {readings.count} stations were in the fit (first: "
            f"station {readings.labels[used[0]]}). Verification needs data that the fit has not seen: take a roll "
            "test of its own."
        )


def _check_temperature(calibration: Calibration, readings: Readings) -> None:
    outside = np.flatnonzero(calibration.outside(readings))
    if outside.size and calibration.temperature_c is not None:
        low, high = calibration.temperature_c
        lie = "station lies" if outside.size == 1 else "stations lie"
        raise InputError(
            f"{readings.name}: {outside.size} {lie} outside the calibrated range {low:.1f}…{high:.1f} °C "
            f"(first: station {readings.labels[outside[0]]}). Verify within the range, or calibrate over a wider one."
        )


def _judged(
    title: str, name: str, limit: float, outcome: Departures, guard: float
) -> tuple[VerdictRow, list[Finding]]:
    """The decision on one limit, by the worst set or station, and the findings about it."""
    unit = OBSERVABLES[name].unit.replace("rad", "°")
    factor = _scale(unit)
    findings = [Finding(id="partly-judged", text=f"{title}: {text}.") for text in outcome.apart]
    if outcome.unseen:
        findings.append(_finding("harmonic-unseen", title=title))
    most = max((each.raw * factor for each in outcome.statistics), default=None)
    if outcome.blocked:
        row = VerdictRow(
            name=title, unit=unit, value=None if outcome.unrolled else most, uncertainty=None,
            limit=limit, passed=False, note=f"cannot be passed: {outcome.blocked}", raw=most,
            sets=_sets(outcome, factor, 0.0, -1.0),
        )  # fmt: skip
        return row, findings
    worst = max(outcome.statistics, key=lambda each: each.value + guard * each.uncertainty)
    value, sd = worst.value * factor, worst.uncertainty * factor
    passed = value + guard * sd <= limit
    row = VerdictRow(
        name=title, unit=unit, value=value, uncertainty=sd, limit=limit, passed=passed,
        note=worst.where + _remark(value, sd, limit, passed), raw=most,
        harmonics=_harmonics(worst, factor), sets=_sets(outcome, factor, guard, limit),
    )  # fmt: skip
    if sd > WEAK * limit:
        findings.append(_finding("weak-test", row=row))
    if causes := _causes(row, name, worst):
        findings.append(_finding("roll-harmonics", row=row, causes="; ".join(causes)))
    return row, findings


def _scale(unit: str) -> float:
    """Factor from the unit of calculation to that of a limit."""
    return float(np.degrees(1)) if unit == "°" else 1.0


def _sets(outcome: Departures, factor: float, guard: float, limit: float) -> list[JudgedSet]:
    """The roll sets behind a row, and the stations outside of them as one; none passes below zero."""
    by_label: dict[str, list[Statistic]] = {}
    for each in outcome.statistics:
        by_label.setdefault(each.label, []).append(each)
    sets = []
    for label, members in by_label.items():
        worst = max(members, key=lambda each: each.value + guard * each.uncertainty)
        value, sd, curve = worst.value * factor, worst.uncertainty * factor, worst.curve
        sets.append(
            JudgedSet(
                label=label,
                stations=np.concatenate([each.index for each in members]).tolist(),
                coefficients=None if curve is None else (curve.coefficients * factor).tolist(),
                value=value,
                uncertainty=sd,
                passed=value + guard * sd <= limit,
            )
        )
    return sets


def _remark(value: float, sd: float, limit: float, passed: bool) -> str:
    """How close the decision was."""
    if value <= limit and not passed:
        return "; within the limit, but not by twice its uncertainty as the guarded rule asks"
    close = abs(value - limit) < COVERAGE * sd
    return "; closer to the limit than twice its uncertainty" if close else ""


def _harmonics(worst: Statistic, factor: float) -> tuple[float, float] | None:
    if worst.curve is None:
        return None
    first, second = (worst.curve.amplitudes * factor).tolist()
    return first, second


def _causes(row: VerdictRow, name: str, worst: Statistic) -> list[str]:
    """The likely causes of a failed limit, from the harmonics of the set that decided."""
    if row.passed or row.harmonics is None or worst.curve is None:
        return []
    unit = row.unit if row.unit == "°" else f" {row.unit}"
    clear = worst.curve.amplitudes / np.maximum(worst.curve.amplitude_sd, 1e-30) > NAMED_HARMONIC
    axes = "the accelerometer's x and y" if name in LEVEL else "x and y of either triad"
    causes = FIRST_HARMONIC.get(name, FIRST_HARMONIC["azimuth"]), SECOND_HARMONIC + axes
    each = zip(("first", "second"), row.harmonics, causes, strict=True)
    parts = [f"{which} harmonic {size:.2g}{unit} ({cause})" for which, size, cause in each]
    return [part for part, named in zip(parts, clear, strict=True) if named]
