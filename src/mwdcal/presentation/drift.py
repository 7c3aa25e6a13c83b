"""The printed output of the drift of a tool and of a fleet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.readings import SIMULATED
from mwdcal.drift.change import LEAST_PAIR_PROBABILITY, LEAST_PROBABILITY
from mwdcal.drift.document import DueDate, FleetDrift, FleetTool, ServiceRow, ToolDrift, WalkRate
from mwdcal.drift.forecast import RISK
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import files_written, measured, number, unit
from mwdcal.presentation.text import chance, one_line, plural, table

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
