"""Methods side by side, as text, as JSON and as one HTML file that needs nothing else."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mwdcal import __version__
from mwdcal.app.commands.choices import order_of
from mwdcal.app.commands.options import AskedToCompare
from mwdcal.app.pages import comparison_plots as plots
from mwdcal.app.pages import report
from mwdcal.app.text import WEIGHED, plain, table
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import SIMULATED, Readings
from mwdcal.comparison.compare import Comparison, Row, able, compare
from mwdcal.files.formats import atomic
from mwdcal.sensor.profile import Profile

STATISTICS = (("mean", "mean"), ("STD", "std"), ("MSE", "mse"), ("RMSE", "rmse"))
MARK = "*"
"""Behind a figure that rests on a convention."""
Line = tuple[str, str, list[str]]
"""A row of a table: what, its unit, and a cell for each column."""


def run(
    asked: AskedToCompare,
    readings: Readings,
    profile: Profile,
    say: Callable[[str], None],
    **digests: str,
) -> tuple[bool, str | dict[str, Any]]:
    """Compare the methods on a run, write the report if asked for.

    Whether any method could calibrate it; text, or what JSON shows.
    """
    options = Options(order=order_of(asked["order"]), seed=asked["seed"])
    found = compare(readings, profile, options, progress=say)
    path = asked["report"]
    if path:
        write_report(path, found, profile.name, **digests)
    if asked["as_json"]:
        also = {"findings": unused_columns(readings.unused), "report": str(path or "")}
        return bool(able(found.rows)), {**document(found), **also}
    wrote = f"\nwrote {path} (report)" if path else ""
    return bool(able(found.rows)), text(found, asked["parameters"]) + wrote


def text(found: Comparison, parameters: bool = False) -> str:
    """The advice, errors and residual statistics of every method, and why some were refused."""
    rows = able(found.rows)
    methods = [row.method for row in rows]
    simulated = [SIMULATED] if found.simulated else []
    lines = ["   ".join([*heading(found), *simulated]), found.advice]
    if rows:
        lines += ["", _table(figures(found), ["", "before", *methods]), ""]
    lines += notes(found)
    lines += [f"{who} refused: {why}" for who, why in refusals(found)]
    if parameters and rows:
        lines += ["", gauge(found) + " In parentheses: 1σ of the last digits."]
        for name, own in parameter_pairs(found).items():
            joined = [(what, unit, [_joined(*pair) for pair in pairs]) for what, unit, pairs in own]
            lines += ["", _table(joined, [name, *methods])]
    return "\n".join(lines)


def refusals(found: Comparison) -> list[tuple[str, str]]:
    """Who was refused, and why: once where all methods were for the same reason."""
    refused = [(row.method, row.refused) for row in found.rows if row.refused]
    reasons = {why for _, why in refused}
    if len(refused) == len(found.rows) > 1 and len(reasons) == 1:
        return [("every method", reasons.pop())]
    return refused


def _table(lines: list[Line], header: list[str]) -> str:
    return table([[f"{what}, {unit}" if unit else what, *c] for what, unit, c in lines], header)


def _joined(value: str, sd: str) -> str:
    """1σ in parentheses, in units of the last digit of the value: 2.93051(10)."""
    if sd == "undetermined":
        return sd
    digits, power = (text.partition("×") for text in (sd, value))
    short = digits[0].replace(".", "").lstrip("0") or "0"
    return f"{power[0]}({short}){''.join(power[1:])}"


def heading(found: Comparison) -> list[str]:
    """What was compared, and how."""
    orders = " and ".join(str(order) for order in dict.fromkeys(found.orders))
    whole = found.parts == found.stations
    parts = [
        found.run,
        f"{found.stations} stations",
        f"temperature order {orders}",
        f"own-axis terms: {' and '.join(found.curved)}" if found.curved else "",
        "each station left out in turn" if whole else f"{found.parts} parts left out in turn",
    ]
    return [part for part in parts if part]


def figures(found: Comparison) -> list[Line]:
    """All figures of the nominal tool ("before"), then of every method."""
    if not able(found.rows):
        return []
    lines: list[Line] = []
    for kind, how in (("held_out", "left out"), ("in_sample", "in sample")):
        lines += [(f"{what}, rms {how}", unit, c) for what, unit, c in errors(found, kind)]
    return [*lines, *measures(found), *effort(found)]


def errors(found: Comparison, kind: str) -> list[Line]:
    """Root mean square errors by observable: `kind` "held_out" or "in_sample"."""
    lines = []
    for name, unit in found.units.items():
        cells = [
            report.number(getattr(row, kind)[name]) + MARK * (name in row.resting)
            for row in able(found.rows)
        ]
        before = report.number(found.before[name])
        lines.append((WEIGHED.get(name, name), unit, [before, *cells]))
    return lines


def measures(found: Comparison) -> list[Line]:
    """Moradi's four measures of the vector error by triad, and the last of them left out."""
    lines: list[Line] = []
    for before in found.measures_before:
        name = f"{before.triad} |e|"
        for what, key in STATISTICS:
            cells = [_measure(row, before.triad, "after", key) for row in able(found.rows)]
            lines.append((f"{name}, {what}", "", [report.number(getattr(before, key)), *cells]))
        cells = [_measure(row, before.triad, "left out", "rmse") for row in able(found.rows)]
        lines.append((f"{name}, RMSE left out", "", ["", *cells]))
    return lines


def _measure(row: Row, triad: str, when: str, key: str) -> str:
    found = [getattr(m, key) for m in row.measures if (m.triad, m.when) == (triad, when)]
    rank, size = row.ranks[triad]
    return report.number(found[0] if found else None) + MARK * (rank < size)


def effort(found: Comparison) -> list[Line]:
    """Rank, iterations and time."""
    rows = able(found.rows)
    lines = [
        (f"rank, {triad}", "", ["", *("{} of {}".format(*row.ranks[triad]) for row in rows)])
        for triad in rows[0].ranks
    ]
    if any(row.lost for row in rows):
        lines.append(("stations no fit could judge", "", ["", *(str(row.lost) for row in rows)]))
    lines.append(("iterations", "", ["", *(str(row.iterations) for row in rows)]))
    return [*lines, ("time of one fit", "s", ["", *(f"{row.seconds:.2f}" for row in rows)])]


def notes(found: Comparison) -> list[str]:
    """What each method leaves free, and what the tables mean."""
    rows = able(found.rows)
    lines = [
        f"{row.method} leaves undetermined: {', '.join(row.undetermined)}"
        for row in rows
        if row.undetermined
    ]
    if found.measures_before and rows:
        lines.append("|e|: length of the vector error, as a share of the reference vector (Moradi)")
    if any(MARK in cell for *_, cells in figures(found) for cell in cells):
        lines.append(f"{MARK} rests on a direction that the method leaves free: kept at nominal")
    return lines


def gauge(found: Comparison) -> str:
    """The convention that all parameters were brought to, in words."""
    meaning = "Factors of the raw channels (u = V / SF - B, field = P (1 - m) u)"
    if any(found.orders):
        meaning += ", by power of τ, temperature - reference"
    if found.curved:
        meaning += "; of the tangent at the centre of the readings, without own-axis terms"
    if not found.gauge:
        return f"{meaning}. No method leaves a direction free."
    courses = any("-temperature-" in name for row in found.rows for name in row.undetermined)
    rest = " What rests on a free course with temperature stays undetermined." if courses else ""
    each = "; ".join(f"{name} {', '.join(free)}" for name, free in found.gauge.items())
    return (
        f"{meaning}. One gauge for all: what any method leaves free ({each}) is taken out of every "
        "method's factors and listed below them. Free rotation: the gain, split into rotation and "
        "symmetric stretch, has none. Free scale: the mean strength is that of the references."
        + rest
    )


Pairs = tuple[str, str, list[tuple[str, str]]]
"""A parameter, its unit, and each method's value and 1σ as text."""


def parameter_pairs(found: Comparison) -> dict[str, list[Pairs]]:
    """Parameters of every method by triad; last what was taken out of them."""
    result = {}
    for triad in able(found.rows)[0].parameters:
        result[triad] = [
            (place.title, place.unit, [_stated(*place.of(row)) for row in able(found.rows)])
            for place in plots.places(found, triad)
        ]
    return result


def _stated(value: float, sd: float) -> tuple[str, str]:
    return report.measured(value, None if np.isnan(sd) else sd)


def document(found: Comparison) -> dict[str, Any]:
    """The result for machines, without the errors of single stations."""
    rows = tuple(replace(row, station_errors={}, course={}) for row in found.rows)
    made: dict[str, Any] = plain(replace(found, rows=rows, labels=()))
    for row in made["rows"]:
        del row["station_errors"], row["course"]
    del made["labels"]
    return made


def write_report(
    path: str | os.PathLike[str],
    found: Comparison,
    profile: str = "",
    *,
    run_sha256: str = "",
    profile_sha256: str = "",
) -> None:
    """Write the report; the old file or the new one exists at any moment, never a part."""
    trace = [
        ("run file", found.run, run_sha256),
        ("tool profile", profile, profile_sha256),
        ("software", f"mwdcal {__version__}, seed of the swarm {found.seed}", ""),
    ]
    atomic.write(path, render(found, trace))


def render(found: Comparison, trace: Sequence[tuple[str, str, str]] = ()) -> str:
    """The comparison as HTML; `trace`: what it says of its sources, with their SHA-256."""
    template = report._environment().get_template("comparison.html")
    rows = able(found.rows)
    headline, _, why = found.advice.partition(": ")
    return template.render(
        found=found,
        headline=headline,
        why=why,
        rows=rows,
        refused=refusals(found),
        heading=heading(found)[1:],
        errors=[errors(found, kind) for kind in ("held_out", "in_sample")] if rows else [],
        measures=measures(found) if rows else [],
        effort=effort(found) if rows else [],
        notes=notes(found),
        gauge=gauge(found),
        parameters=parameter_pairs(found) if rows else {},
        figures=plots.figures(found) if rows else {},
        limit=plots.MOST_STATIONS,
        trace=trace,
    )
