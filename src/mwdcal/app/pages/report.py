"""The report of a calibration: one HTML file that needs nothing else, to be read and signed.

The pictures are drawn in `use.plots`, the wording of fixed text stands in `templates/`. Needs the
extra `report` (jinja2, matplotlib).
"""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app.pages.calibration import choices, known_inclinations
from mwdcal.app.pages.calibration import model as model_of
from mwdcal.app.pages.page import (
    HELD,
    environment,
    exponent,
    factor_places,
    fixed,
    is_held,
    measured,
    number,
    unit,
)
from mwdcal.app.text import plural, raised
from mwdcal.calibration.prediction import accuracy_at, angles, middle_temperature
from mwdcal.calibration.readings import is_simulated
from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.errors import InputError
from mwdcal.estimation.solvers import RANK_TOLERANCE
from mwdcal.geometry.observables import TITLES
from mwdcal.use import plots
from mwdcal.use.notation import Notation, convert
from mwdcal.use.plots import reshoot_limit

if TYPE_CHECKING:
    from mwdcal.calibration.record import Finding
    from mwdcal.use.verification import Verdict

LONG_TABLE = 60
"""A run of more stations has its station table at the end, as an annex."""
ACCURACY_INCLINATIONS = (5.0, 45.0, 90.0)
"""Inclinations of the table of predicted accuracy, degrees."""


def render(calibration: Calibration, verdict: Verdict | None = None) -> str:
    """The report as HTML: the same input gives the same text, byte for byte."""
    template = environment().get_template("report.html")
    return template.render(
        cal=calibration,
        name=calibration.tool.get("serial") or calibration.profile.name,
        verdict=verdict,
        banner=banner(calibration, verdict),
        findings=_findings(calibration, verdict),
        simulated=is_simulated(calibration.tool),
        facts=_facts(calibration),
        relative=calibration.relative,
        figures=_figures(calibration),
        compared=_compared(calibration),
        judged=_judged(calibration),
        limit=reshoot_limit(calibration),
        decimals=_decimals(calibration),
        left_out=any(row.errors_left_out for row in calibration.station_rows),
        annex=len(calibration.station_rows) > LONG_TABLE,
        parameters=_parameters(calibration),
        held=HELD,
        accuracy=_accuracy(calibration),
        budget=_budget(calibration),
        titles=TITLES,
        tolerance=RANK_TOLERANCE,
        earth=_earth(calibration),
        when=_when(calibration.time),
    )


def banner(calibration: Calibration, verdict: Verdict | None) -> dict[str, str]:
    """The outcome in plain words: level (good, attention, bad), word, headline, second line."""
    fit, level = _fit_outcome(calibration)
    if verdict is None:
        after = "Not verified: run mwdcal verify on a roll test that was not used in the fit."
        return _banner(level, fit, after)
    missed = sum(not row.passed for row in verdict.rows)
    count = plural(len(verdict.rows), "limit")
    if not verdict.passed:
        return _banner("bad", f"Verification failed – {missed} of {count} not met", fit)
    return _banner(level, f"Verification passed – {count} met", fit)


def _banner(level: str, headline: str, after: str) -> dict[str, str]:
    word = {"good": "OK", "attention": "Attention", "bad": "Failed"}[level]
    return {"level": level, "word": word, "headline": headline, "after": after}


def _fit_outcome(calibration: Calibration) -> tuple[str, str]:
    """What the fit came to, in one line, and its level."""
    ids = [finding.id for finding in calibration.findings]
    doubts = [i.removesuffix("-residuals") for i in ids if i.endswith("-residuals")]
    parts = [f"{name} residuals exceed the declared noise" for name in doubts]
    free = dict.fromkeys(entry.id.replace("-", " ") for entry in calibration.undetermined())
    undetermined = f"{', '.join(free)} undetermined"
    if free and doubts:
        parts.append(undetermined)
    if calibration.relative:
        parts.append("magnetic field relative, not in nT")
    again = sum(row.reshoot for row in calibration.station_rows)
    if again:
        parts.append(f"{plural(again, 'station')} to re-shoot")
    accepted = undetermined[0].upper() + undetermined[1:] if free else "Fit accepted"
    headline = "Fit doubtful" if doubts else accepted
    text = f"{headline} – {'; '.join(parts)}" if parts else headline
    return text, "attention" if parts or free else "good"


def _findings(calibration: Calibration, verdict: Verdict | None) -> list[Finding]:
    """What to know and do, each thing once; stations to re-shoot first."""
    findings = {f.text: f for f in calibration.findings}
    ids = {f.id for f in calibration.findings}
    for extra in verdict.findings if verdict else ():
        if extra.id not in ids:
            findings.setdefault(extra.text, extra)
    return sorted(findings.values(), key=lambda f: f.id != "reshoot")


def _when(time: str) -> str:
    """A time of the record as people write it."""
    try:
        return datetime.fromisoformat(time).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return time


def _facts(calibration: Calibration) -> list[tuple[str, str]]:
    """What was calibrated, with what."""
    tool, profile = calibration.tool, calibration.profile
    method = [calibration.method, model_of(calibration), *choices(calibration.options)]
    facts = [
        ("Tool", tool.get("serial") or "no serial given"),
        ("Type", tool.get("tool", profile.name)),
        ("Sensors", " and ".join(t.name for t in calibration.triads)),
        ("Calibrated", _when(calibration.time)),
        ("Measured", tool.get("date", "")),
        ("Run file", calibration.run or "not named"),
        ("Stations", _attitudes(calibration)),
        ("Excluded", ", ".join(calibration.excluded)),
        ("Temperature", _temperatures(calibration)),
        ("Method", "; ".join(method)),
        ("Stand", tool.get("stand", "")),
        ("Laboratory", tool.get("lab", "")),
        ("Operator", tool.get("operator", "")),
    ]
    return [(name, value) for name, value in facts if value]


def _temperatures(calibration: Calibration) -> str:
    if calibration.temperature_c is None:
        return "not recorded"
    low, high = (fixed(t, 1) for t in calibration.temperature_c)
    return f"{low} °C" if low == high else f"{low} to {high} °C"


def _attitudes(calibration: Calibration) -> str:
    inclinations = known_inclinations(calibration)
    if not inclinations:
        return str(calibration.stations)
    return f"{calibration.stations}, at inclinations {min(inclinations):.0f} to {max(inclinations):.0f}°"


def _figures(calibration: Calibration) -> dict[str, Any]:
    """Figures by name, and the observables that have none."""
    names = [row.observable for row in calibration.errors]
    missing = [
        name
        for name in TITLES
        if name not in names and (calibration.has_field or name not in ("azimuth", "field", "dip"))
    ]
    return {
        "errors": {name: plots.station_errors(calibration, name) for name in names},
        "missing": missing,
        "deviations": calibration.plot.deviations(),
        "orders": (
            plots.order_errors(calibration.orders)
            if _compared(calibration) and _judged(calibration)
            else None
        ),
        "accuracy": calibration.plot.accuracy(),
    }


def _compared(calibration: Calibration) -> bool:
    """Whether orders were compared, rather than one given."""
    return not all(row.chosen for row in calibration.orders)


def _judged(calibration: Calibration) -> bool:
    """Whether some order was judged at temperatures left out."""
    return any(row.ends is not None for row in calibration.orders)


def _decimals(calibration: Calibration) -> dict[str, int]:
    """Decimals of the station table: two significant digits of what is left after the fit."""
    return {
        row.observable: min(max(1 - exponent(row.after), 0), 9) if row.after > 0 else 3
        for row in calibration.errors
    }


def _parameters(calibration: Calibration) -> dict[str, Any]:
    """Parameters of each triad as rows: as factors of the raw channels where there are any."""
    try:
        notations = convert(calibration, "factors")
    except InputError:
        tables = {triad.name: _own_rows(triad) for triad in calibration.triads}
        return {"notation": "record", "tables": tables}
    tables = {
        triad.name: _factor_rows(triad, notations[triad.name]) for triad in calibration.triads
    }
    return {"notation": "factors", "tables": tables}


def _row(name: str, index: str, power: int, value: float, sd: float | None, symbol: str) -> Any:
    shown, uncertainty = ("0", HELD) if is_held(value, sd) else measured(value, sd)
    return {
        "name": name,
        "index": index,
        "course": raised("τ", power),
        "value": shown,
        "sd": uncertainty,
        "unit": symbol + raised("/°C", power),
    }


def _own_rows(triad: TriadCalibration) -> list[Any]:
    """The parameters of the record: tool axes, nominal units."""
    columns = zip(
        triad.parameter_names, triad.parameters, triad.standard_uncertainties, strict=True
    )
    rows = []
    for full, value, sd in columns:
        base, _, power = full.partition("·")
        name, _, index = base.rpartition("-")
        symbol = "1" if name in ("gain", "scale", "misalignment") else _unit(triad)
        rows.append(_row(name, index, int(power or 0), value, sd, symbol))
    return rows


def _unit(triad: TriadCalibration) -> str:
    return triad.unit if triad.unit in ("g", "nT") else "1"


def _factor_rows(triad: TriadCalibration, notation: Notation) -> list[Any]:
    raw = "raw" if _unit(triad) == "1" else f"raw/{triad.unit}"
    units = {"SF": raw, "B": _unit(triad), "m": "1"}
    rows = []
    for name, at, axes, power in factor_places(notation.values):
        value, sd = (float(v[name][at]) for v in (notation.values, notation.uncertainty))
        rows.append(_row(name, axes, power, value, sd, units[name]))
    return rows


def _accuracy(calibration: Calibration) -> dict[str, Any]:
    """1σ in degrees by angle: of the calibration alone, and of one reading."""
    middle = middle_temperature(calibration)
    cases = [(inclination, middle) for inclination in ACCURACY_INCLINATIONS]
    if any(t.order for t in calibration.triads) and calibration.temperature_c:
        cases += [(45.0, t) for t in calibration.temperature_c]
    names = angles(calibration)
    rows = []
    for inclination, temperature in cases:
        at = [float(np.radians(inclination))]
        both = [accuracy_at(calibration, at, noise, temperature) for noise in (False, True)]
        pairs = [[_degrees(sd[name][0]) for sd in both] for name in names]
        rows.append({"inclination": inclination, "temperature": temperature, "pairs": pairs})
    return {"names": names, "rows": rows, "temperature": middle}


def _budget(calibration: Calibration) -> list[dict[str, str]]:
    """What the calibration's uncertainty consists of: a row for each source, degrees by angle."""
    names = angles(calibration)
    return [
        {"source": row.source}
        | {
            name: "undetermined" if sd is None else number(sd, 2)
            for name in names
            for sd in [getattr(row, f"{name}_deg")]
        }
        for row in calibration.budget
    ]


def _degrees(angle: float) -> str:
    return "undetermined" if np.isnan(angle) else number(float(np.degrees(angle)), 2)


def _earth(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Gravity, field and dip of the run: name, value with unit, and where it comes from."""
    estimated = {c.name: c for c in calibration.constants}
    nanotesla = "" if calibration.relative else "nT"
    keys = (("gravity", "gravity_g", "g"), ("field", "field", nanotesla), ("dip", "dip_deg", "°"))
    rows = []
    for name, key, symbol in keys:
        if key not in calibration.earth:
            continue
        value, source = calibration.earth[key], "given"
        text = f"{value:.7g}".replace("-", "−")
        if name in estimated:
            text, sd = measured(value, estimated[name].standard_uncertainty)
            source = f"estimated from the run, 1σ {sd}{unit(symbol)}"
        elif name == "field" and calibration.relative:
            text, source = "1", "by convention: the strength is known at no station"
        rows.append((f"mean {name}", f"{text}{unit(symbol)}", source))
    for c in calibration.constants:
        if c.name.endswith("reference error"):
            text, sd = measured(c.value, c.standard_uncertainty)
            rows.append(
                (c.name, f"{text}{unit(c.unit)}", f"estimated with the fit, 1σ {sd}{unit(c.unit)}")
            )
    return rows
