"""The report of a calibration: one HTML file that needs nothing else, to be read and signed.

The pictures are drawn in `use.plots`, the wording of fixed text stands in `templates/`. Needs the
extra `report` (jinja2, matplotlib).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.diagnosis.findings import MISFIT_BY_COLUMN
from mwdcal.calibration.readings import is_simulated, soaks
from mwdcal.calibration.record import MAGNETIC, Calibration, Finding, TriadCalibration
from mwdcal.calibration.results import (
    accuracy_at,
    angles,
    middle_temperature,
    typical_accuracy,
    without_temperature,
)
from mwdcal.certificate.decisions import coverage_of, expanded_of
from mwdcal.errors import InputError, shell_word
from mwdcal.estimation.solvers import RANK_TOLERANCE
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.calibration import (
    NEXT_ROLL_TEST,
    PLACE,
    accuracy_in_words,
    how,
    known_inclinations,
    unseen_remarks,
)
from mwdcal.presentation.numbers import (
    HELD,
    RAW_MEANING,
    UNDETERMINED,
    capital,
    estimate,
    exponent,
    norths,
    quantity,
    raw_unit,
    strength_unit,
    uncertainty,
    value_places,
)
from mwdcal.presentation.page import banner, environment
from mwdcal.presentation.text import plural, raised
from mwdcal.presentation.typed import leading_findings
from mwdcal.presentation.verification import (
    BETWEEN_SETS,
    after_failure,
    freedom,
    noise_free,
    raw_rule,
    verdict_risk,
)
from mwdcal.sensor.profile import NOMINAL
from mwdcal.use import plots
from mwdcal.use.notation import Notation, convert
from mwdcal.use.verification import SETTING_PRACTICES, fewest_degrees_of_freedom

if TYPE_CHECKING:
    from mwdcal.use.verification import Limits, Verdict, VerdictRow

SHOWN_DEPARTURES = {"spread": "departure from the middle of the roll set", "error": "error"}
"""Departures of a roll test's stations for each kind of limit."""
UNUSED_COLUMN = "a column that is not used explains the misfit or a drift"
"""A doubt of the fit in the banner."""
LONG_TABLE = 60
"""A run of more stations has its station table at the end, as an annex."""
LARGE_RATIO = 2.0
"""Errors after the fit of more than this times what is expected are marked."""
ACCURACY_INCLINATIONS = (5.0, 45.0, 90.0)
"""Inclinations of the table of predicted accuracy, degrees."""


def render(
    calibration: Calibration,
    verdict: Verdict | None = None,
    *metadata: Mapping[str, object],
    limits: Limits | None = None,
    file: str = "CAL.json",
    rolltest: str = NEXT_ROLL_TEST,
) -> str:
    """The report as HTML: the same input gives the same text, byte for byte.

    `metadata` are those of the roll test behind the verdict, `limits` those that a roll test will have to meet. `file`
    and `rolltest` are the names of the calibration and of a roll test in the next commands.
    """
    pages = environment()
    pages.filters |= {"freedom": freedom, "noise_free": noise_free, "risk": verdict_risk}
    template = pages.get_template("report.html")
    findings = _findings(calibration, verdict)
    first, left = leading_findings(findings)
    return template.render(
        cal=calibration,
        name=calibration.tool_name,
        verdict=verdict,
        banner=outcome(calibration, verdict),
        findings=findings,
        first_findings=first,
        left=left,
        spherical=_spherical(calibration),
        gauges=list(_gauges(calibration, verdict, limits)),
        steps=_steps(calibration, verdict, file, rolltest),
        simulated=any(map(is_simulated, (calibration.tool, *metadata))),
        inclinations=known_inclinations(calibration),
        method="; ".join(how(calibration)),
        magnetic=MAGNETIC,
        limit=plots.reshoot_limit(calibration),
        decimals=_decimals(calibration),
        long_table=LONG_TABLE,
        parameters=_parameters(calibration),
        raw={t.name: raw_unit(calibration.profile, t.name) for t in calibration.triads},
        raw_meaning=RAW_MEANING,
        held=HELD,
        accuracy=_accuracy(calibration),
        soaked=_soaked(calibration),
        kinds=_kinds(verdict),
        norths=norths(calibration.tool, calibration.profile.form.north),
        drifts=list(map(capital, filter(None, unseen_remarks(calibration)))),
        settings=SETTING_PRACTICES,
        raw_rule=raw_rule(verdict) if verdict else "",
        outside=BETWEEN_SETS,
        titles=TITLES,
        large=LARGE_RATIO,
        tolerance=RANK_TOLERANCE,
        usual_temperature=NOMINAL.reference_temperature_c,
        when=_when(calibration.time),
    )


def outcome(calibration: Calibration, verdict: Verdict | None) -> dict[str, str]:
    """The banner: the verdict, if there is one, and what came of the fit."""
    fit, level = _fit_outcome(calibration)
    word = "OK" if level == "good" else "Attention"
    if verdict is None:
        expected = ", ".join(accuracy_in_words(calibration))
        after = f"{fit}. Accuracy to expect ({PLACE}): {expected or 'not stated'}."
        unverified = "Calibrated – not yet verified"
        return banner("open" if level == "good" else level, "Not verified", unverified, after)
    missed = [row.name for row in verdict.rows if not row.passed]
    count = plural(len(verdict.rows), "limit")
    without = f", {len(verdict.not_judged)} not judged" if verdict.not_judged else ""
    fit = f"Not judged: {', '.join(verdict.not_judged)}. {fit}" if without else fit
    if free := verdict.left_open:
        headline = f"Not verified – nothing wrong was found, {free} left open"
        return banner("attention", "Open", headline, f"Not judged: {', '.join(missed)}. {fit}.")
    if not verdict.passed:
        headline = f"Verification failed – {len(missed)} of {count} not met{without}"
        return banner("bad", "Failed", headline, f"Not met: {', '.join(missed)}. {fit}.")
    return banner(level, word, f"Verification passed – {count} met{without}", fit)


def _spherical(calibration: Calibration) -> bool:
    """Whether there are stations to draw on spheres: attitudes, and errors before and after."""
    attitudes = ("inclination", "toolface", *(["azimuth"] if calibration.has_field else []))
    return bool(calibration.errors) and any(
        None not in [getattr(row, f"{name}_deg") for name in attitudes]
        for row in calibration.station_rows
    )


@dataclass(frozen=True)
class AngleGauge:
    """An angle against its limit: what is shown of it, its outcome, and a bar of 100 units.

    `span` is from value less U to value plus U.
    """

    name: str
    shown: str
    limit: str
    level: str
    word: str
    value: float
    span: tuple[float, float]
    bound: float | None


def _gauges(
    calibration: Calibration, verdict: Verdict | None, limits: Limits | None
) -> Iterator[AngleGauge]:
    """Each angle as value ± U against the limit that is nearest, and every other limit that is not met.

    An angle without a roll test, or without a limit, has the U to expect of the calibration alone.
    """
    rows = verdict.rows if verdict else []
    bounds = dict([*limits.spread.items(), *limits.error.items()]) if limits and not rows else {}
    worst = sorted(rows, key=lambda row: (row.passed, -_nearness(row)))
    k, shown = coverage_of(fewest_degrees_of_freedom(calibration)), []
    for name, sd in typical_accuracy(calibration).items():
        judged = [row for row in worst if row.name.endswith(f" of {name}")]
        if judged:
            shown.append(judged[0])
            yield _judged(judged[0])
        else:
            expanded = None if sd is None else k * sd
            expected = (
                UNDETERMINED
                if sd is None
                else f"± {uncertainty(expanded)}° expected (U, k = {k:.2g})"
            )
            limit, outcome = bounds.get(name), ("open", "not tested")
            gauge = _gauge(name, expected, 0.0, expanded, limit, "°", outcome)
            skipped = verdict and any(n.endswith(f" of {name}") for n in verdict.not_judged)
            yield replace(gauge, limit="", word="not judged") if skipped else gauge
    yield from (_judged(row) for row in worst if not row.passed and row not in shown)


def _judged(row: VerdictRow) -> AngleGauge:
    """The gauge of a limit that was tested; a raw figure beyond it has no ±."""
    expanded = expanded_of(row)
    shown = "not stated" if row.value is None else estimate(row.value, expanded, row.unit)
    if expanded is None and row.judged_raw:
        shown, _ = noise_free(row, row.unit)
    elif row.judged_raw:
        shown += " raw"
    outcome = ("good", "pass") if row.passed else ("bad", "FAIL")
    return _gauge(row.name, shown, row.value, expanded, row.limit, row.unit, outcome)


def _nearness(row: VerdictRow) -> float:
    """Share of the limit that a value takes with its uncertainty."""
    return ((row.value or 0.0) + 2 * (row.uncertainty or 0.0)) / row.limit


def _gauge(
    name: str, shown: str, value: float | None, expanded: float | None, limit: float | None,
    symbol: str, outcome: tuple[str, str],
) -> AngleGauge:  # fmt: skip
    """A gauge on which the limit stands at four fifths, unless the value needs the room."""
    low, high = ((value or 0.0) + sign * (expanded or 0.0) for sign in (-1, 1))
    whole = max((limit or 0.0) / 0.8, high * 1.05) or 1.0
    said = f"limit {quantity(limit, symbol)}" if limit else "no limit given"
    span = max(100 * low / whole, 0.0), 100 * high / whole
    bound = 100 * limit / whole if limit else None
    return AngleGauge(name, shown, said, *outcome, 100 * (value or 0.0) / whole, span, bound)


def _steps(
    calibration: Calibration, verdict: Verdict | None, file: str, rolltest: str
) -> list[str]:
    """Steps after the calibration: stations to measure again, then the next command."""
    count, named = sum(row.reshoot for row in calibration.station_rows), file
    file, test = map(shell_word, (named, verdict.run if verdict else rolltest))
    steps = [f"Measure {plural(count, 'station')} again, and calibrate once more."] if count else []
    if verdict is None:
        return [
            *steps,
            f"Verify the calibration with a roll test that the fit has not seen: mwdcal verify {file} {test}",
        ]
    if verdict.passed:
        return [
            *steps,
            f"Keep the verdict: mwdcal verify {file} {test} -o verdict.json",
            f"Issue the certificate: mwdcal certificate {file} --verification verdict.json -o certificate.pdf",
        ]
    again, command, reason = after_failure(verdict, named, verdict.run)
    return [*steps, f"{capital(again)}.", f"{capital(reason)}: {command}"]


def _fit_outcome(calibration: Calibration) -> tuple[str, str]:
    """The outcome of the fit in one line, and its level."""
    ids = [finding.id for finding in calibration.findings]
    doubts = [
        f"{i.removesuffix('-residuals')} residuals exceed the declared noise"
        for i in ids
        if i.endswith("-residuals")
    ]
    doubts += [UNUSED_COLUMN] * (MISFIT_BY_COLUMN in ids)
    parts = [*doubts]
    free = dict.fromkeys(entry.id.replace("-", " ") for entry in calibration.undetermined())
    undetermined = f"{', '.join(free)} undetermined"
    if free and doubts:
        parts.append(undetermined)
    if calibration.relative:
        parts.append("magnetic field relative, not in nT")
    again = sum(row.reshoot for row in calibration.station_rows)
    if again:
        parts.append(f"{plural(again, 'station')} to re-shoot")
    accepted = capital(undetermined) if free else "Fit accepted"
    headline, level = (
        "Fit doubtful" if doubts else accepted,
        "attention" if parts or free else "good",
    )
    parts += filter(None, [without_temperature(calibration)])
    return f"{headline} – {'; '.join(parts)}" if parts else headline, level


def _findings(calibration: Calibration, verdict: Verdict | None) -> list[Finding]:
    """Findings and advice, each once."""
    findings = {f.text: f for f in calibration.findings}
    ids = {f.id for f in calibration.findings}
    for extra in verdict.findings if verdict else ():
        if extra.id not in ids:
            findings.setdefault(extra.text, extra)
    return [*findings.values()]


def _when(time: str) -> str:
    """A time of the record as people write it; of a tool in a fleet's table it is the day."""
    if "T" not in time:
        return time
    try:
        return datetime.fromisoformat(time).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return time


def _decimals(calibration: Calibration) -> dict[str, int]:
    """Decimals of the station table: two significant digits of what is left after the fit."""
    return {
        row.observable: min(max(1 - exponent(row.after), 0), 9) if row.after > 0 else 3
        for row in calibration.errors
    }


def _parameters(calibration: Calibration) -> dict[str, Any]:
    """Parameters of each triad: as factors of the raw channels where there are any.

    A row is name, axes, power of τ, value, 1σ and unit.
    """
    try:
        notations = convert(calibration, "factors")
    except InputError:
        rows = {triad.name: _record_rows(triad) for triad in calibration.triads}
        return {"notation": "record", "rows": rows}
    rows = {
        triad.name: _factor_rows(
            triad, notations[triad.name], raw_unit(calibration.profile, triad.name)
        )
        for triad in calibration.triads
    }
    return {"notation": "factors", "rows": rows}


def _record_rows(triad: TriadCalibration) -> list[tuple[Any, ...]]:
    """The parameters of the record: tool axes, nominal units."""
    columns = (triad.parameter_names, triad.parameters, triad.standard_uncertainties)
    rows = []
    for full, value, sd in zip(*columns, strict=True):
        base, _, power = full.partition("·")
        name, _, axes = base.rpartition("-")
        symbol = "1" if name in ("gain", "scale") else strength_unit(triad) or "1"
        symbol = "rad" if name == "misalignment" else symbol
        per = raised("/°C", int(power or 0))
        rows.append((name, axes, int(power or 0), value, sd, symbol + per))
    return rows


def _factor_rows(triad: TriadCalibration, factors: Notation, raw: str) -> list[tuple[Any, ...]]:
    values, sd = factors.values, factors.uncertainty
    return [
        (name, axes, power, float(values[name][at]), float(sd[name][at]), symbol)
        for name, at, axes, power, symbol in value_places(values, raw, strength_unit(triad), "1")
    ]


def _kinds(verdict: Verdict | None) -> list[tuple[str, list[tuple[VerdictRow, int]]]]:
    """Columns of the stations of a roll test: limits of each kind, with the decimals of their 1σ."""
    kinds: dict[str, list[tuple[VerdictRow, int]]] = {}
    for row in verdict.rows if verdict else ():
        if row.sets:
            places = min(max(1 - exponent(row.uncertainty or row.limit / 100), 0), 9)
            kinds.setdefault(SHOWN_DEPARTURES[row.name.partition(" ")[0]], []).append((row, places))
    return list(kinds.items())


def _soaked(calibration: Calibration) -> bool:
    """Whether stations of several soaks have errors to draw against temperature."""
    warmth = [r.temperature_c for r in calibration.station_rows if r.temperature_c is not None]
    return bool(calibration.errors and warmth and soaks(np.array(warmth)).any())


def _accuracy(calibration: Calibration) -> dict[str, Any]:
    """1σ in degrees by angle: of the calibration alone, and of one reading."""
    middle = middle_temperature(calibration)
    cases = [(inclination, middle) for inclination in ACCURACY_INCLINATIONS]
    if calibration.thermal and calibration.temperature_c:
        cases += [(45.0, t) for t in calibration.temperature_c]
    names = angles(calibration)
    rows = []
    for inclination, temperature in cases:
        at = [float(np.radians(inclination))]
        both = [accuracy_at(calibration, at, noise, temperature) for noise in (False, True)]
        sd = [float(np.degrees(each[name][0])) for name in names for each in both]
        rows.append((inclination, temperature, sd))
    pairs = [sd[2 * i] for *_, sd in rows for i in range(len(names))]
    stated = [n for n, sd in zip(names * len(rows), pairs, strict=True) if not np.isnan(sd)]
    return {"names": names, "rows": rows, "temperature": middle, "stated": stated}
