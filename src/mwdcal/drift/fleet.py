"""The drift of many tools: counts, the worst, and those due first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import date

import numpy as np

from mwdcal.drift.change import CHANGE_LEVEL
from mwdcal.drift.document import FleetDrift, FleetTool, ToolDrift, WalkRate
from mwdcal.drift.tool import MeasuredTool, TypeRates, predicted, walk_rate

SCORE_EDGES = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0, np.inf])
"""Edges of the classes of the largest score of a tool over its critical one."""
LISTED = 25
"""Most tools in each list."""


def fleet_drift(
    tools: Sequence[MeasuredTool], limits: Mapping[str, float], today: date,
    refused: Mapping[str, str] | None = None, level: float = CHANGE_LEVEL, listed: int = LISTED,
) -> tuple[FleetDrift, list[ToolDrift]]:  # fmt: skip
    """The drift of tools, each with the rates of its type, and the summary.

    `refused`: serials that could not be compared at all, and why.
    """
    types: dict[str, list[MeasuredTool]] = {}
    for tool in tools:
        types.setdefault(tool.drift.type, []).append(tool)
    rates = {name: TypeRates.of(members) for name, members in types.items()}
    drifts = [predicted(tool, rates[tool.drift.type], limits, today) for tool in tools]
    rows = [fleet_tool(drift, today) for drift in drifts]
    ratios = [d.change.largest_score / d.change.critical_score for d in drifts if d.change]
    tested = [row for row in rows if row.changed is not None]
    summary = FleetDrift(
        simulated=any(drift.simulated for drift in drifts),
        level=level,
        today=today.isoformat(),
        tools=len(rows),
        tested=len(tested),
        changed=sum(bool(row.changed) for row in rows),
        by_chance=level * len(tested),
        left_limits=sum(row.left_limits for row in rows),
        overdue=sum(row.overdue for row in rows),
        unpredicted=sum(row.next_due is None for row in rows),
        refused=dict(refused or {}),
        score_edges=SCORE_EDGES[:-1].tolist(),
        scores=np.histogram(ratios, SCORE_EDGES)[0].tolist(),
        rates={
            name: _of_type(each, members)
            for (name, each), members in zip(rates.items(), types.values(), strict=True)
        },
        worst=sorted(rows, key=_badness)[:listed],
        due=sorted((r for r in rows if r.next_due), key=lambda r: (r.next_due or "", r.serial))[
            :listed
        ],
    )
    return summary, drifts


def _badness(row: FleetTool) -> tuple[bool, float, float, str]:
    """Tools that left their limits first, then by how improbable their change is."""
    probability = 2.0 if row.probability is None else row.probability
    return not row.left_limits, probability, -(row.largest_score or 0.0), row.serial


def fleet_tool(drift: ToolDrift, today: date) -> FleetTool:
    """A tool as a row of the fleet."""
    change, first = drift.change, min((each.not_before for each in drift.due), default=None)
    return FleetTool(
        serial=drift.serial,
        type=drift.type,
        calibrations=len(drift.calibrations),
        calibrated=drift.calibrations[-1].date,
        changed=change.changed if change else None,
        probability=change.probability if change else None,
        largest_score=change.largest_score if change else None,
        parameter=_largest(drift),
        next_due=drift.next_due,
        not_before=first,
        overdue=bool(drift.next_due and drift.next_due < today.isoformat()),
        left_limits=any(row.as_left_passed and not row.as_found_passed for row in drift.service),
    )


def _largest(drift: ToolDrift) -> str:
    """The parameter with the largest score."""
    scored = [each for each in drift.parameters if each.score is not None]
    if not scored:
        return ""
    worst = max(scored, key=lambda each: each.score or 0.0)
    return f"{worst.triad} {worst.name}"


def _of_type(rates: TypeRates, members: Iterable[MeasuredTool]) -> list[WalkRate]:
    """What a tool of a type moves by in a year, when nothing else is known of it."""
    first = next(iter(members)).drift.parameters
    units = {(p.triad, p.name.partition("-")[0]): p.unit for p in first}
    return [
        walk_rate(triad, kind, units.get((triad, kind), ""), (each.rates, each.peers_probability))
        for (triad, kind), each in rates.groups.items()
    ]
