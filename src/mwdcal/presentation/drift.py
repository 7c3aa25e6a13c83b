"""The printed output of the drift of a tool and of a fleet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.readings import SIMULATED, TRIADS
from mwdcal.drift.document import (
    AccuracyForecast,
    DueDate,
    FleetDrift,
    FleetTool,
    ParameterCourse,
    ServiceRow,
    ToolDrift,
    WalkRate,
)
from mwdcal.drift.histories import COVERAGE_FACTOR, LONGEST_INTERVAL, RISK
from mwdcal.drift.tool import CONTROL
from mwdcal.drift.walk import LEAST_PAIR_PROBABILITY, LEAST_PROBABILITY
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import capital, files_written, measured, number, unit
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import chance, one_line, plural, table
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DUE_RULE = (
    f"the tool is beyond a limit with {100 * RISK:g} % then, or has been in as short a time before"
)
STEP_TITLES = ["changed", "between", "and", "by", "1σ", "score"]
DUE_TITLES = ["angle", "error now", "limit", "due", "50 % beyond", "95 % beyond"]
SERVICE_TITLES = [
    "calibrated",
    "limit on",
    "as left",
    "as found",
    "change",
    "1σ",
    "limit",
    "result",
]
RATE_TITLES = ["sensors", "parameters", "in a year", "90 % interval"]
WORST_TITLES = [
    "serial",
    "type",
    "calibrations",
    "latest",
    "changed",
    "probability",
    "largest change",
    "due",
]


def drawn_chance(probability: float | None, least: float = LEAST_PROBABILITY) -> str:
    """A probability that was drawn: the least that the draws can state is a bound.

    >>> [drawn_chance(p) for p in (0.41234, 0.0002, 0.0001, None)]
    ['0.41', '0.0002', '≤ 0.0001', '–']
    """
    bound = probability is not None and probability <= least
    return ("≤ " if bound else "") + chance(probability)


def pair_chance(probability: float) -> str:
    """The probability of two calibrations alone."""
    return drawn_chance(probability, LEAST_PAIR_PROBABILITY)


class RegistryDrift(msgspec.Struct, frozen=True, kw_only=True):
    """How one tool changes, or all tools of a registry; by the limits of the 95 % accuracy, degrees."""

    registry: str
    limits_deg: dict[str, float]
    tool: ToolDrift | None = None
    fleet: FleetDrift | None = None


def step_rows(drift: ToolDrift) -> list[list[str]]:
    """The changes that were named, one in a row."""
    rows = []
    for step in drift.change.steps if drift.change else ():
        value, sd = measured(step.change, step.standard_uncertainty)
        name = f"{step.triad} {step.name.replace('-', ' ')}"
        per = unit(step.unit)
        rows.append([name, step.after, step.by, value + per, sd + per, number(step.score, 3)])
    return rows


def due_words(due: DueDate) -> list[str]:
    """A due date as a row, with the days by which the tool is beyond the limit with 50 % and 95 %."""
    latest = f"{due.not_after} or later" if due.capped else due.not_after
    values = number(due.now_deg, 2), number(due.limit_deg)
    return [due.angle, *(f"{v}°" for v in values), due.due, due.expected, latest]


def rate_rows(rates: Sequence[WalkRate]) -> list[list[str]]:
    """Random walks, one kind of parameter in a row."""
    rows = []
    for rate in rates:
        factor, shown = (1e6, "ppm") if not rate.unit else (1.0, rate.unit)
        factor, shown = (1e3, "mg") if rate.unit == "g" else (factor, shown)
        values = [number(v * factor, 2) for v in (rate.per_root_year, rate.low, rate.high)]
        rows.append(
            [
                rate.triad,
                rate.kind,
                values[0] + unit(shown),
                f"{values[1]}…{values[2]}{unit(shown)}",
            ]
        )
    return rows


def service_rows(service: Sequence[ServiceRow]) -> list[list[str]]:
    """Limits as left and as found, one in a row."""
    return [
        [
            row.calibrated, row.name, *(_value(v, row.unit) for v in (row.as_left, row.as_found, row.change)),
            _value(row.standard_uncertainty, row.unit), f"{number(row.limit)}{unit(row.unit)}", _result(row),
        ]
        for row in service
    ]  # fmt: skip


def _value(value: float | None, symbol: str) -> str:
    return number(value) + (unit(symbol) if value is not None else "")


def _result(row: ServiceRow) -> str:
    """Whether a tool kept a limit in service."""
    if row.as_found_passed:
        return "kept" if row.as_left_passed else "passes again"
    return "left in service" if row.as_left_passed else "failed before"


def tool_screen(drift: ToolDrift) -> str:
    """The drift of a tool, as text."""
    count = plural(len(drift.calibrations), "calibration")
    head = [f"drift of {one_line(drift.serial)}", count, one_line(drift.type), *simulated(drift)]
    parts = ["   ".join(head), *_change_lines(drift)]
    steps, due, service = (
        step_rows(drift),
        [due_words(d) for d in drift.due],
        service_rows(drift.service),
    )
    for title, header, rows in (
        ("", STEP_TITLES, steps),
        (f"next calibration due {drift.next_due}: {DUE_RULE}", DUE_TITLES, due),
        ("in service", SERVICE_TITLES, service),
        ("random walk", RATE_TITLES, rate_rows(drift.rates)),
    ):
        if rows:
            parts.append("\n".join(filter(None, [title, table(rows, header)])))
    notes = [f"{c.date} {note}" for c in drift.calibrations for note in c.notes]
    return "\n\n".join([*parts, *(["\n".join(notes)] if notes else [])])


def document(result: RegistryDrift) -> dict[str, Any]:
    """The drift for machines."""
    marked = [each.simulated for each in (result.tool, result.fleet) if each]
    stated = {"serial": result.tool.serial if result.tool else "", "simulated": any(marked)}
    return json_document("registry drift", result, stated)


def text(result: RegistryDrift, page: Path | None) -> str:
    """The drift for people."""
    shown = tool_screen(result.tool) if result.tool else ""
    shown = fleet_screen(result.fleet) if result.fleet else shown
    return "\n\n".join(filter(None, [shown, files_written(page=page) if page else ""]))


def simulated(drift: ToolDrift | FleetDrift) -> list[str]:
    """The mark of simulated data, where these are."""
    return [SIMULATED] if drift.simulated else []


def _change_lines(drift: ToolDrift) -> Iterator[str]:
    """Whether the tool changed."""
    change = drift.change
    if change is None:
        return
    word = "CHANGED" if change.changed else "no change seen"
    yield (
        f"{word}: probability {drawn_chance(change.probability)} under no change, "
        f"level {number(100 * change.level)} %   "
        f"largest score {number(change.largest_score)}, critical {number(change.critical_score)}   "
        f"misfit χ² {number(change.misfit)} of {change.degrees_of_freedom}"
    )


def fleet_rows(tools: Sequence[FleetTool]) -> list[list[str]]:
    """Tools, one in a row."""
    words = {True: "yes", False: "no", None: "–"}
    return [
        [
            tool.serial, tool.type, str(tool.calibrations), tool.calibrated, words[tool.changed],
            drawn_chance(tool.probability), tool.parameter.replace("-", " "),
            (tool.next_due or "–") + (" overdue" if tool.overdue else ""),
        ]
        for tool in tools
    ]  # fmt: skip


def fleet_screen(fleet: FleetDrift) -> str:
    """The drift of a fleet, as text."""
    head = "   ".join([f"drift of {plural(fleet.tools, 'tool')}", fleet.today, *simulated(fleet)])
    counts = (
        f"{fleet.changed} of {fleet.tested} tested changed ({number(fleet.by_chance, 2)} by chance)   "
        f"{fleet.overdue} overdue   {fleet.left_limits} left their limits   {fleet.unpredicted} without due date"
    )
    parts = [head, counts]
    if fleet.worst:
        parts.append("worst first\n" + table(fleet_rows(fleet.worst), WORST_TITLES))
    if fleet.due:
        parts.append("due first\n" + table(fleet_rows(fleet.due), WORST_TITLES))
    parts += [f"{one_line(serial)}: {one_line(why)}" for serial, why in fleet.refused.items()]
    return "\n\n".join(parts)


# --------------------------------------------------------------------------
# Figures of the drift of a tool and of a fleet.
#
# Pages of the drift of one tool, and of a fleet.


COURSES_ABREAST = 3
"""Panels in a row."""
HEIGHT = 1.15
"""Of a row of panels, inches."""
SHOWN_UNITS = {"": ("ppm", 1e6), "g": ("mg", 1e3)}
"""Unit in which changes of a parameter are drawn, and the factor to it; others stay."""
BAR = 1.96
"""Standard uncertainties of an error bar: 95 %."""


def shown_unit(unit: str) -> tuple[str, float]:
    """The unit in which a change is shown, and the factor to it.

    >>> shown_unit("g")
    ('mg', 1000.0)
    """
    return SHOWN_UNITS.get(unit, (unit, 1.0))


def short_name(name: str) -> str:
    """A parameter's name as titles have it: bias x."""
    return name.replace("-", " ")


@plots.style()
def draw_parameters(drift: ToolDrift, triad: str) -> Figure:
    """The parameters of a triad over time, each as its difference from the first calibration."""
    courses = [each for each in drift.parameters if each.triad == triad]
    return _courses(drift, courses, f"Parameters of the {triad} over time")


@plots.style()
def drift_picture(drift: ToolDrift) -> Figure:
    """The biases of both triads over time: the drift of a tool in one figure, as a certificate has it."""
    courses = [each for each in drift.parameters if each.name.startswith("bias")]
    return _courses(drift, courses, "Biases from calibration to calibration")


def _courses(drift: ToolDrift, courses: Sequence[ParameterCourse], label: str) -> Figure:
    """Panels, three abreast, of some parameters."""
    rows = -(-len(courses) // COURSES_ABREAST)
    figure, grid = plots.new_figure(label, HEIGHT * rows + 0.3, rows, COURSES_ABREAST, sharex=True)
    days = [date.fromisoformat(c.date) for c in drift.calibrations if c.used]
    for axes, course in zip(grid.ravel(), courses, strict=False):
        _course(axes, drift, course, days)
    for axes in grid.ravel()[len(courses) :]:
        axes.set_axis_off()
    return figure


def _course(axes: Axes, drift: ToolDrift, course: ParameterCourse, days: Sequence[date]) -> None:
    """One parameter: differences from the first calibration, bars of 95 %, control limits, changes."""
    unit, factor = shown_unit(course.unit)
    values = np.array(course.values, float)
    start = next((v for v in course.values if v is not None), 0.0)
    sd = np.array(course.standard_uncertainties, float) * factor
    departures = (values - start) * factor
    x = np.array(_years(days))
    low, high = ((np.array(v, float) - start) * factor for v in (course.low, course.high))
    for at, a, b in zip(x, low, high, strict=True):
        if np.isfinite(a):
            width = max(0.012 * (x[-1] - x[0]), 0.02)
            axes.fill_between([at - 3 * width, at + 3 * width], a, b, color=plots.BAND, linewidth=0)
    steps = _steps(drift, course)
    colour = plots.MARKED if steps else plots.AFTER
    known = np.isfinite(sd) & np.isfinite(departures)
    axes.errorbar(
        x[known], departures[known], BAR * sd[known], fmt="o-", color=colour, markersize=3,
        linewidth=0.7, elinewidth=0.8, capsize=2,
    )  # fmt: skip
    for after in steps:
        axes.axvline((x[after - 1] + x[after]) / 2, color=plots.MARKED, linestyle=(0, (3, 2)))
    for at in np.flatnonzero(course.outside):
        axes.plot(x[at], departures[at], "D", color=plots.MARKED, markersize=6, fillstyle="none")
    mark = "  ▲ changed" if steps else ""
    axes.set_title(f"{capital(course.triad)[:3]}. {short_name(course.name)}, {unit}{mark}")
    axes.locator_params(axis="x", nbins=5, integer=True)
    axes.locator_params(axis="y", nbins=4)
    axes.ticklabel_format(useOffset=False)


def _years(days: Sequence[date]) -> list[float]:
    """Days as decimal years."""
    return [day.year + (day.timetuple().tm_yday - 1) / 365.25 for day in days]


def _steps(drift: ToolDrift, course: ParameterCourse) -> list[int]:
    """Numbers of the calibrations, of those compared, with which the parameter was seen to have changed."""
    days = [each.date for each in drift.calibrations if each.used]
    named = drift.change.steps if drift.change else []
    return [
        days.index(step.by)
        for step in named
        if (step.triad, step.name) == (course.triad, course.name)
    ]


@plots.style()
def draw_forecast(drift: ToolDrift) -> Figure:
    """The accuracy of each angle in the years after the latest calibration, and its limit."""
    due = {each.angle: each for each in drift.due}
    label = "Accuracy in the years after the latest calibration"
    figure, grid = plots.new_figure(label, 1.9, 1, len(drift.forecast))
    for axes, forecast in zip(grid[0], drift.forecast, strict=True):
        _forecast(axes, forecast, due.get(forecast.angle))
    grid[0, 0].set_ylabel("95 % accuracy, °")
    return figure


def _forecast(axes: Axes, forecast: AccuracyForecast, due: DueDate | None) -> None:
    """One angle: expected, 90 % interval of the rates, limit and due date."""
    low, middle, high = (
        COVERAGE_FACTOR * np.array(v)
        for v in (forecast.low_deg, forecast.sd_deg, forecast.high_deg)
    )
    axes.fill_between(forecast.years, low, high, color=plots.BAND, linewidth=0)
    axes.plot(forecast.years, middle, color=plots.AFTER)
    axes.set_title(capital(forecast.angle))
    axes.set_xlabel("years after the calibration")
    axes.set_ylim(
        0, 1.1 * max(high[-1], due.limit_deg if due and due.limit_deg < 4 * high[-1] else 0)
    )
    axes.set_xlim(0, forecast.years[-1])
    if due and due.limit_deg < 4 * high[-1]:
        axes.axhline(due.limit_deg, color=plots.MARKED, linestyle=(0, (5, 1.5)))
        axes.text(
            0.02 * forecast.years[-1],
            due.limit_deg,
            f"limit {number(due.limit_deg)}°",
            va="bottom",
            fontsize=7,
        )
    elif due:
        axes.text(
            0.05,
            0.06,
            f"limit {number(due.limit_deg)}° is far above",
            transform=axes.transAxes,
            fontsize=7,
        )


@plots.style()
def draw_scores(fleet: FleetDrift) -> Figure:
    """How many tools have a largest score of so many times the critical one."""
    figure, grid = plots.new_figure("Largest change of each tool over what raises an alarm", 1.8)
    axes, edges = grid[0, 0], fleet.score_edges
    alarm = [edge >= 1 for edge in edges]
    bars = axes.bar(
        range(len(edges)), fleet.scores, color=[plots.MARKED if a else plots.AFTER for a in alarm]
    )
    for bar, over in zip(bars, alarm, strict=True):
        bar.set_hatch("///" if over else "")
    for place, count in enumerate(fleet.scores):
        axes.text(place, count, str(count), ha="center", va="bottom", fontsize=7)
    names = [f"{a:g}–{b:g}" for a, b in pairwise(edges)]
    axes.set_xticks(range(len(edges)), [*names, f"over {edges[-1]:g}"])
    axes.locator_params(axis="y", integer=True)
    axes.set_xlabel("largest score of a tool over its critical score; an alarm from 1")
    axes.set_ylabel("tools")
    axes.margins(y=0.15)
    return figure


def triads_of(drift: ToolDrift) -> list[str]:
    """The triads that are compared."""
    return [triad for triad in TRIADS if any(p.triad == triad for p in drift.parameters)]


def render(tool: ToolDrift | None, fleet: FleetDrift | None) -> str:
    """The page of one tool, or of many."""
    return (render_tool(tool) if tool else "") + (render_fleet(fleet) if fleet else "")


def render_tool(drift: ToolDrift) -> str:
    """The page of one tool."""
    triads = triads_of(drift)
    several = sum(each.used for each in drift.calibrations) > 1
    return rendered(
        "drift.html",
        drift=drift,
        simulated=drift.simulated,
        banner=_tool_banner(drift),
        parameters={t: draw_parameters(drift, t) for t in triads} if several else {},
        forecast=draw_forecast(drift) if drift.forecast and drift.basis else None,
        steps=step_rows(drift),
        due=[due_words(each) for each in drift.due],
        due_titles=DUE_TITLES,
        rates=rate_rows(drift.rates),
        service=service_rows(drift.service),
        rows=list(_parameter_rows(drift)),
        control=CONTROL,
        drawn_chance=drawn_chance,
        pair_chance=pair_chance,
        longest=LONGEST_INTERVAL,
        factor=COVERAGE_FACTOR,
        risk=RISK,
    )  # fmt: skip


def _tool_banner(drift: ToolDrift) -> dict[str, str]:
    """Whether the tool changed, and when it is due."""
    after = (
        f"Next calibration due {drift.next_due}" if drift.next_due else "No due date is predicted"
    )
    if any(row.as_left_passed and not row.as_found_passed for row in drift.service):
        return banner("bad", "Left its limits", "Passed as left and failed as found", after)
    if drift.change is None:
        count = plural(sum(each.used for each in drift.calibrations), "calibration")
        return banner("open", "Not tested", f"{count} to compare: a change cannot be tested", after)
    change = drift.change
    level = f"probability {drawn_chance(change.probability)} under no change; level {number(100 * change.level)} %"
    if change.changed:
        return banner("attention", "Changed", f"The tool changed ({level})", after)
    return banner("good", "Not changed", f"No change is seen ({level})", after)


def _parameter_rows(drift: ToolDrift) -> Iterator[tuple[bool, list[str]]]:
    """Each parameter in a row: whether it changed, then first and latest value, their difference, and its score."""
    changed = {(s.triad, s.name) for s in drift.change.steps} if drift.change else set()
    for course in drift.parameters:
        yield (course.triad, course.name) in changed, _parameter_row(course)


def _parameter_row(course: ParameterCourse) -> list[str]:
    unit, factor = shown_unit(course.unit)
    known = [v for v in course.values if v is not None]
    sds = [s for s in course.standard_uncertainties if s is not None]
    change = (known[-1] - known[0]) * factor if known else None
    return [
        course.triad, short_name(course.name), number(known[-1] if known else None, 7),
        course.unit or "share", number(change), unit, number(sds[-1] * factor if sds else None, 2),
        number(course.score, 3),
    ]  # fmt: skip


def render_fleet(fleet: FleetDrift) -> str:
    """The page of many tools."""
    return rendered(
        "drift_fleet.html",
        fleet=fleet,
        drawn_chance=drawn_chance,
        simulated=fleet.simulated,
        banner=_fleet_banner(fleet),
        scores=draw_scores(fleet) if fleet.tested else None,
        rates={name: rate_rows(rates) for name, rates in fleet.rates.items()},
    )  # fmt: skip


def _fleet_banner(fleet: FleetDrift) -> dict[str, str]:
    """How many tools changed, left their limits or are overdue."""
    headline = f"{fleet.changed} of {plural(fleet.tested, 'tested tool')} changed"
    after = (
        f"{number(fleet.by_chance, 2)} would by chance if none had. {fleet.overdue} overdue on {fleet.today}; "
        f"{fleet.left_limits} left their limits in service; {fleet.unpredicted} without a predicted due date"
    )
    if fleet.left_limits:
        return banner("bad", "Attention", headline, after)
    if fleet.changed or fleet.overdue:
        return banner("attention", "Attention", headline, after)
    return banner("good" if fleet.tested else "open", "Fleet", headline, after)
