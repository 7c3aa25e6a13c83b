"""The drift of one tool and when it is due, and of many of one type, whose walks are estimated together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from types import MappingProxyType
from typing import NamedTuple
from zlib import crc32

import numpy as np
from msgspec.structs import replace

from mwdcal.calibration.record import Calibration, Finding
from mwdcal.drift.document import (
    AccuracyForecast,
    ChangeVerdict,
    ComparedCalibration,
    DueDate,
    FleetDrift,
    FleetTool,
    ParameterCourse,
    ParameterStep,
    ToolDrift,
    Transition,
    WalkRate,
)
from mwdcal.drift.histories import (
    DRAWN_PATHS,
    INTERVAL,
    LONGEST_INTERVAL,
    RISK,
    Departure,
    Growth,
    Left,
    Outlook,
    Paths,
    ServiceTest,
    ToolHistory,
    day_after,
    departures,
    factor,
    failures,
    outlooks,
    service_rows,
    tool_history,
)
from mwdcal.drift.walk import (
    CHANGE_LEVEL,
    WALK_GROUPS,
    ChangeTest,
    GroupRates,
    History,
    Increments,
    by_kind,
    change_tests,
    draws,
    group_places,
    quantiles,
)
from mwdcal.geometry.vectors import Array, diagonal

CONTROL = 3.0
"""Standard deviations within which control limits lie."""
MOST_PEERS = 2_000
"""Most tools of a type that its rates are learnt from."""
PREDICTED_TOGETHER = 64
"""Tools of a type whose rates are worked out at once."""
TIMES = np.linspace(0.0, LONGEST_INTERVAL, 21)
"""Years after a calibration for which its accuracy is forecast."""
TOOL_AND_PEERS, PEERS = "tool and peers", "peers"
FINDINGS = {
    "changed": "the tool changed: {what}.",
    "misfit": "the calibrations disagree beyond their uncertainties, though no step of a single parameter explains it",
    "single": "there is one calibration to compare: a change cannot be tested, and only peers tell how fast it drifts.",
    "unpredicted": "the next due date cannot be predicted: no tool of type '{type}' has two calibrations that can be "
    "compared.",
    "peers": "its own calibrations tell no rate of drift: the rates are those of {count} of the same type.",
    "left-limits": "{count} passed as left and failed as found: the tool left its limits in service ({names}).",
    "overdue": "the latest calibration was due again on {due}.",
    "shortened": "it left a limit between {start} and {end}: {how}. It is due after half of that time at the latest.",
    "walk-unseen": "the calibrations show no walk of {groups} beyond their uncertainty: its rate is a bound.",
    "walk-edge": "the rate of {groups} is likeliest at the largest that was tried: due dates are too late.",
    "inaccurate": "the error of {angle} may be {now:.2g}° (95 %) on the day of the calibration, more than the limit of "
    "{limit:g}°.",
    "too-free": "{angle} has no stated accuracy: it rests on a direction that the calibration leaves undetermined.",
}


Distribution = tuple[Array, Array]
"""Rates and their probabilities."""


@dataclass(frozen=True)
class MeasuredTool:
    """A tool before its rates are known: what its calibrations say by themselves."""

    drift: ToolDrift
    calibrated: date
    increments: dict[tuple[str, str], Increments]
    outlook: Outlook
    departures: list[Departure]
    failures: list[Left]
    gaps: Array
    groups: list[tuple[str, str] | None]


class ToolRecords(NamedTuple):
    """The calibrations, one or more, and roll tests of a tool.

    `digests`: the SHA-256 of the file of each calibration by that of its contents, by which tests may name it.
    """

    serial: str
    calibrations: Sequence[Calibration]
    tests: Sequence[ServiceTest] = ()
    digests: Mapping[str, str] = MappingProxyType({})


def measured(
    serial: str, calibrations: Sequence[Calibration], tests: Sequence[ServiceTest] = (),
    level: float = CHANGE_LEVEL, digests: Mapping[str, str] | None = None, tested: bool = True,
) -> MeasuredTool:  # fmt: skip
    """The change test and the growth of one tool; see `ToolRecords` and `all_measured`."""
    return all_measured([ToolRecords(serial, calibrations, tests, digests or {})], level, tested)[0]


def all_measured(
    tools: Sequence[ToolRecords], level: float = CHANGE_LEVEL, tested: bool = True
) -> list[MeasuredTool]:
    """The same of many tools, those of one form together. Not `tested`: no change test, as of a peer."""
    pasts = [tool_history(tool.calibrations) for tool in tools]
    result: dict[int, MeasuredTool] = {}
    forms = ((p.history.names, len(p.history.years), len(p.calibrations[-1].triads)) for p in pasts)
    for places in by_kind(forms):
        some = [pasts[place] for place in places]
        histories = [past.history for past in some]
        together, names = History.of(histories), histories[0].names
        compared = tested and len(histories[0].years) > 1
        tests = change_tests(histories, level) if compared else [None] * len(some)
        groups = {group: group_places(names, *group) for group in WALK_GROUPS}
        moves = {g: Increments.of_tools(together, some) for g, some in groups.items() if some}
        of_place = {place: group for group, members in groups.items() for place in members}
        parts = zip(places, some, tests, outlooks(some), strict=True)
        for row, (place, past, test, ahead) in enumerate(parts):
            increments = {group: each[row] for group, each in moves.items()}
            of_steady = [of_place.get(int(each)) for each in past.history.steady]
            result[place] = _measured(tools[place], past, test, increments, ahead, of_steady)
    return [result[place] for place in range(len(tools))]


def _measured(
    records: ToolRecords, tool: ToolHistory, test: ChangeTest | None,
    increments: dict[tuple[str, str], Increments], ahead: Outlook,
    groups: list[tuple[str, str] | None],
) -> MeasuredTool:  # fmt: skip
    """One tool, of which these are known."""
    named = [(c, _digests(c, records.digests)) for c in tool.calibrations]
    drift = ToolDrift(
        serial=records.serial, type=tool.calibrations[-1].profile.name,
        simulated=any(c.simulated for c in tool.calibrations),
        temperature_c=tool.temperature_c if np.isfinite(tool.temperature_c).all() else None,
        calibrations=_calibrations(tool), parameters=_parameters(tool, test),
        change=None if test is None else _verdict(tool, test),
        basis="", peers=0, rates=[], forecast=[], due=[], next_due=None,
        service=service_rows(named, records.tests), findings=[],
    )  # fmt: skip
    return MeasuredTool(
        drift, tool.compared_days[-1], increments, ahead, departures(tool, ahead),
        list(failures(named, records.tests)), np.diff(tool.history.years), groups,
    )  # fmt: skip


def _digests(calibration: Calibration, digests: Mapping[str, str]) -> list[str]:
    """The SHA-256 by which a roll test may name a calibration."""
    content = str(calibration.sha256)
    return [content, digests.get(content, content)]


def _calibrations(tool: ToolHistory) -> list[ComparedCalibration]:
    rows = zip(tool.calibrations, tool.days, tool.used, tool.notes, strict=True)
    return [
        ComparedCalibration(
            date=day.isoformat(), run=c.run, sha256=str(c.sha256 or ""), used=used, notes=[*notes]
        )
        for c, day, used, notes in rows
    ]


def _parameters(tool: ToolHistory, test: ChangeTest | None) -> list[ParameterCourse]:
    """The parameters at the middle temperature; control limits are still missing."""
    history, steady = tool.history, tool.history.steady
    times = np.array([factor(tool.units[place]) for place in steady])
    known = diagonal(history.precision) > 0
    sd = np.where(known, np.sqrt(np.maximum(diagonal(tool.covariance), 0.0)), np.nan)
    scores = np.full((1, len(known[0])), np.nan) if test is None else np.abs(test.scores)
    largest = np.where(np.isnan(scores), -np.inf, scores).max(0)
    columns = (_stated(each[:, steady] * times) for each in (history.values, sd))
    rows = zip(steady.tolist(), *columns, largest[steady].tolist(), strict=True)
    nothing: list[float | None] = [None] * len(sd)
    courses = []
    for place, values, uncertainties, score in rows:
        triad, _, name = history.names[place].partition(" ")
        courses.append(
            ParameterCourse(
                triad=triad, name=name, unit=tool.units[place], values=values,
                standard_uncertainties=uncertainties, low=nothing, high=nothing,
                outside=[False] * len(sd), score=score if score >= 0 else None,
            )
        )  # fmt: skip
    return courses


def _stated(values: Array) -> list[list[float | None]]:
    """Columns of numbers (n, k) as a file has them: None for NaN."""
    return [[None if v != v else v for v in column] for column in values.mT.tolist()]


def _verdict(tool: ToolHistory, test: ChangeTest) -> ChangeVerdict:
    """The outcome of the test in words and dates."""
    days = [day.isoformat() for day in tool.compared_days]
    steps = []
    for step in test.steps:
        triad, _, name = tool.history.names[step.place].partition(" ")
        times = factor(tool.units[step.place])
        steps.append(
            ParameterStep(
                triad=triad, name=name, unit=tool.units[step.place], after=days[step.after - 1],
                by=days[step.after], change=step.size * times, standard_uncertainty=step.uncertainty * times,
                score=step.score,
            )
        )  # fmt: skip
    pairs = zip(
        days, days[1:], test.pair_misfit, test.pair_freedom, test.pair_probability, strict=False
    )
    return ChangeVerdict(
        changed=test.changed, level=test.level, probability=test.probability,
        largest_score=test.largest_score, critical_score=test.critical_score, misfit=test.misfit,
        degrees_of_freedom=test.degrees_of_freedom, misfit_probability=test.misfit_probability,
        steps=steps,
        transitions=[
            Transition(start=a, end=b, misfit=float(m), degrees_of_freedom=int(f), probability=float(p))
            for a, b, m, f, p in pairs
        ],
    )  # fmt: skip


@dataclass(frozen=True)
class TypeRates:
    """The random walks of tools of one type, by group; `peers`: how many tools with two calibrations they rest on.

    `members`: serials of the tools that they were learnt from.
    """

    groups: dict[tuple[str, str], GroupRates]
    members: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def of(cls, tools: Sequence[MeasuredTool]) -> TypeRates:
        """Of tools of one type, at most `MOST_PEERS` of them, spread evenly."""
        several = [t for t in tools if any(i.noise.size for i in t.increments.values())]
        some = several[:: -(-len(several) // MOST_PEERS) or 1]
        each = {g: [t.increments[g] for t in some if g in t.increments] for g in WALK_GROUPS}
        rates = {group: GroupRates.of(increments) for group, increments in each.items()}
        kept = {group: learnt for group, learnt in rates.items() if learnt is not None}
        return cls(kept, frozenset(t.drift.serial for t in some))


def predicted(
    tool: MeasuredTool, rates: TypeRates, limits: Mapping[str, float], today: date | None = None
) -> ToolDrift:
    """The drift of a tool with control limits, forecast and due dates, by the rates of its type.

    `limits` in degrees by angle, which the 95 % accuracy is to keep; with `today`, an overdue calibration says so.
    """
    return next(all_predicted([tool], rates, limits, today))


def all_predicted(
    tools: Sequence[MeasuredTool],
    rates: TypeRates,
    limits: Mapping[str, float],
    today: date | None = None,
) -> Iterator[ToolDrift]:
    """The same of tools of one type, whose rates are worked out together."""
    for first in range(0, len(tools), PREDICTED_TOGETHER):
        some = tools[first : first + PREDICTED_TOGETHER]
        known: list[dict[tuple[str, str], Distribution]] = [{} for _ in some]
        for group, learnt in rates.groups.items():
            having = [i for i, tool in enumerate(some) if group in tool.increments]
            if having:
                among = [some[i].drift.serial in rates.members for i in having]
                each = learnt.probabilities([some[i].increments[group] for i in having], among)
                for i, probability in zip(having, each, strict=True):
                    known[i][group] = learnt.rates, probability
        for tool, distributions in zip(some, known, strict=True):
            yield _predicted(tool, rates, distributions, limits, today)


def _predicted(
    tool: MeasuredTool,
    rates: TypeRates,
    known: Mapping[tuple[str, str], Distribution],
    limits: Mapping[str, float],
    today: date | None,
) -> ToolDrift:
    """The same of one tool, whose rates are distributed as `known`."""
    drift, serial = tool.drift, tool.drift.serial
    usable = [g for g in tool.outlook.growths if set(g.yearly) <= set(known)]
    rng = np.random.default_rng(crc32(serial.encode()))
    drawn = {group: draws(*each, DRAWN_PATHS, rng) for group, each in known.items()}
    spread = {group: quantiles(*each, INTERVAL) for group, each in known.items()}
    left = _shortest(tool, limits)
    latest = date.max if left is None else tool.calibrated + left.span
    due, days = [], [] if left is None else [latest.isoformat()]
    if judged := [g for g in usable if g.angle in limits]:
        paths = Paths.of(tool.outlook.covariance, tool.outlook.places, drawn, rng)
        kept, error = map(
            np.stack,
            zip(*(g.kept(paths, np.radians(limits[g.angle])) for g in judged), strict=True),
        )
        spans = np.quantile([*kept, kept.min(0)], INTERVAL, axis=-1).mT
        now = np.degrees(np.quantile(error, 1 - RISK, axis=-1)).tolist()
        each = zip(judged, spans[:-1].tolist(), now, strict=True)
        due = [_due(tool, *one, latest, limits) for one in each]
        days.append(_day(tool, float(spans[-1, 0])))
    several = any(each.noise.size for each in tool.increments.values())
    drift = replace(
        drift,
        basis=(TOOL_AND_PEERS if several else PEERS) if known else "",
        peers=len(rates.members - {serial}),
        rates=_rates(drift, spread),
        parameters=_controlled(tool, spread),
        forecast=_forecasts(usable, drawn),
        due=due,
        next_due=min(days, default=None),
    )
    findings = [*_findings(drift, limits, today), *_of_the_walk(tool, rates)]
    if left is not None and drift.next_due == latest.isoformat():
        findings.append(_said("shortened", start=left.start, end=left.end, how=left.how))
    return replace(drift, findings=findings)


def _shortest(tool: MeasuredTool, limits: Mapping[str, float]) -> Left | None:
    """The shortest time in which the tool left a limit, by roll tests or from one calibration to the next."""
    stepped = [left for each in tool.departures for left in each.left(limits)]
    return min([*tool.failures, *stepped], key=lambda left: left.span, default=None)


def _of_the_walk(tool: MeasuredTool, rates: TypeRates) -> list[Finding]:
    """Findings of rates whose likelihood is highest at an end of those that were tried."""
    sides: dict[str, list[str]] = {"walk-unseen": [], "walk-edge": []}
    for (triad, kind), learnt in rates.groups.items():
        if (side := learnt.edge(tool.increments.get((triad, kind)))) is not None:
            sides[side].append(f"{triad} {kind}")
    return [_said(side, groups=", ".join(groups)) for side, groups in sides.items() if groups]


def _rates(drift: ToolDrift, spread: Mapping[tuple[str, str], Array]) -> list[WalkRate]:
    """The rates in words: what a parameter moves by in a year."""
    units = {(p.triad, p.name.partition("-")[0]): p.unit for p in drift.parameters}
    return [walk_rate(*group, units[group], rates) for group, rates in spread.items()]


def walk_rate(triad: str, kind: str, unit: str, rates: Array) -> WalkRate:
    """The quantiles `INTERVAL` of a rate in words."""
    low, middle, high = (np.sqrt(rates) * factor(unit)).tolist()
    return WalkRate(triad=triad, kind=kind, unit=unit, per_root_year=middle, low=low, high=high)


def _controlled(
    tool: MeasuredTool, spread: Mapping[tuple[str, str], Array]
) -> list[ParameterCourse]:
    """The parameters with control limits: from each calibration to the next, by walk and uncertainties."""
    courses, nothing = tool.drift.parameters, np.zeros(len(INTERVAL))
    values = np.array([course.values for course in courses], float)
    sd = np.array([course.standard_uncertainties for course in courses], float)
    rates = [spread.get(group, nothing)[1] if group else 0.0 for group in tool.groups]
    yearly = np.array(rates) * np.array([factor(course.unit) ** 2 for course in courses])
    half = CONTROL * np.sqrt(sd[:, :-1] ** 2 + sd[:, 1:] ** 2 + yearly[:, None] * tool.gaps)
    half[np.isnan(values[:, 1:])] = np.nan
    outside = np.abs(np.diff(values)) > half
    limits = (_stated((values[:, :-1] + sign * half).mT) for sign in (-1, 1))
    return [
        replace(course, low=[None, *low], high=[None, *high], outside=[False, *beyond])
        for course, low, high, beyond in zip(courses, *limits, outside.tolist(), strict=True)
    ]


def _forecasts(
    growths: Sequence[Growth], drawn: Mapping[tuple[str, str], Array]
) -> list[AccuracyForecast]:
    """1σ of each angle over time: the median, and the interval of the rates."""
    if not growths:
        return []
    rates = np.quantile([g.rate(drawn) for g in growths], INTERVAL, axis=-1)
    now = np.array([g.calibration for g in growths])
    sd = np.degrees(np.sqrt(now[:, None] + rates[..., None] * TIMES))
    return [
        AccuracyForecast(
            angle=growth.angle, years=TIMES.tolist(), sd_deg=middle, low_deg=low, high_deg=high
        )
        for growth, low, middle, high in zip(growths, *sd.tolist(), strict=True)
    ]


def _day(tool: MeasuredTool, span: float) -> str:
    """The day so many years after the latest calibration."""
    return day_after(tool.calibrated, span).isoformat()


def _due(
    tool: MeasuredTool, growth: Growth, spans: Sequence[float], now: float, latest: date,
    limits: Mapping[str, float],
) -> DueDate:  # fmt: skip
    """When the tool is beyond the limit of an angle with a probability of `RISK`, or at the `latest`.

    By the quantiles `INTERVAL` of the years for which it keeps the limit, and the bound of its error `now`, degrees.
    """
    first, middle, last = (_day(tool, span) for span in spans)
    return DueDate(
        angle=growth.angle, limit_deg=limits[growth.angle], now_deg=now,
        due=min(first, latest.isoformat()), risk=RISK,
        not_before=first, expected=middle, not_after=last, capped=spans[-1] >= LONGEST_INTERVAL,
    )  # fmt: skip


def _said(name: str, **values: object) -> Finding:
    return Finding(id=name, text=FINDINGS[name].format(**values))


def _findings(drift: ToolDrift, limits: Mapping[str, float], today: date | None) -> list[Finding]:
    """The findings."""
    findings = []

    def say(name: str, **values: object) -> None:
        findings.append(_said(name, **values))

    if drift.change is None:
        say("single")
    elif drift.change.changed:
        say("changed", what=", ".join(map(_step_words, drift.change.steps)) or FINDINGS["misfit"])
    if failed := [
        row.name for row in drift.service if row.as_left_passed and not row.as_found_passed
    ]:
        count = f"{len(failed)} limit{'s' * (len(failed) > 1)}"
        say("left-limits", count=count, names=", ".join(failed))
    if not drift.basis:
        say("unpredicted", type=drift.type)
    elif drift.basis == PEERS:
        say("peers", count=f"{drift.peers} tool{'s' * (drift.peers != 1)}")
    stated_angles = {each.angle for each in drift.forecast}
    for angle in [a for a in limits if a not in stated_angles and drift.basis]:
        say("too-free", angle=angle)
    for each in (e for e in drift.due if e.now_deg > e.limit_deg):
        say("inaccurate", angle=each.angle, now=each.now_deg, limit=each.limit_deg)
    if today and drift.next_due and drift.next_due < today.isoformat():
        say("overdue", due=drift.next_due)
    return findings


def _step_words(step: ParameterStep) -> str:
    return f"{step.triad} {step.name} between {step.after} and {step.by} ({step.score:+.1f} standard uncertainties)"


# --------------------------------------------------------------------------
# The drift of many tools: counts, the worst, and those due first.


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
    of_type = {
        name: all_predicted(types[name], each, limits, today) for name, each in rates.items()
    }
    drifts = [next(of_type[tool.drift.type]) for tool in tools]
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
    """Movement of a tool of a type in a year, when nothing else is known of it."""
    first = next(iter(members)).drift.parameters
    units = {(p.triad, p.name.partition("-")[0]): p.unit for p in first}
    known = ((group, (each.rates, each.peers_probability)) for group, each in rates.groups.items())
    return [
        walk_rate(*group, units.get(group, ""), quantiles(*distribution, INTERVAL))
        for group, distribution in known
    ]
