"""Pages of the drift of one tool, and of a fleet."""

from __future__ import annotations

from collections.abc import Iterator

from mwdcal import __version__
from mwdcal.drift.document import FleetDrift, ParameterCourse, ToolDrift
from mwdcal.drift.forecast import COVERAGE_FACTOR, LONGEST_INTERVAL, RISK
from mwdcal.drift.tool import CONTROL
from mwdcal.pages.page import banner, environment
from mwdcal.pages.records import drift_figures as figures
from mwdcal.screens.numbers import number
from mwdcal.screens.records.drift import (
    DUE_TITLES,
    drawn_chance,
    due_words,
    pair_chance,
    rate_rows,
    service_rows,
    step_rows,
)
from mwdcal.screens.text import plural


def render(tool: ToolDrift | None, fleet: FleetDrift | None) -> str:
    """The page of one tool, or of many."""
    return (render_tool(tool) if tool else "") + (render_fleet(fleet) if fleet else "")


def render_tool(drift: ToolDrift) -> str:
    """The page of one tool."""
    triads = figures.triads_of(drift)
    several = sum(each.used for each in drift.calibrations) > 1
    return environment().get_template("drift.html").render(
        drift=drift,
        simulated=drift.simulated,
        banner=_tool_banner(drift),
        parameters={t: figures.draw_parameters(drift, t) for t in triads} if several else {},
        forecast=figures.draw_forecast(drift) if drift.forecast and drift.basis else None,
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
        version=__version__,
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
    unit, factor = figures.shown_unit(course.unit)
    known = [v for v in course.values if v is not None]
    sds = [s for s in course.standard_uncertainties if s is not None]
    change = (known[-1] - known[0]) * factor if known else None
    return [
        course.triad, figures.short_name(course.name), number(known[-1] if known else None, 7),
        course.unit or "share", number(change), unit, number(sds[-1] * factor if sds else None, 2),
        number(course.score, 3),
    ]  # fmt: skip


def render_fleet(fleet: FleetDrift) -> str:
    """The page of many tools."""
    return environment().get_template("drift_fleet.html").render(
        fleet=fleet,
        drawn_chance=drawn_chance,
        simulated=fleet.simulated,
        banner=_fleet_banner(fleet),
        scores=figures.draw_scores(fleet) if fleet.tested else None,
        rates={name: rate_rows(rates) for name, rates in fleet.rates.items()},
        version=__version__,
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
