"""Plans and what they will give, on the screen and for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.options import ASSUMED, ASSUMED_PRACTICE
from mwdcal.calibration.readings import SIMULATED, is_simulated, serial_of
from mwdcal.calibration.record import Calibration, Finding, TriadCalibration, Undetermined
from mwdcal.calibration.residuals import shown_in
from mwdcal.calibration.results import accuracy_at, typical_accuracy
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.files.contract import CHANNELS, REFERENCES
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import Array, Ints, reference_vectors
from mwdcal.planning.expected import left_undetermined, planned_earth
from mwdcal.planning.planned import Planned, station_names
from mwdcal.planning.plans import attitudes, place_of, soak_numbers, soak_temperatures
from mwdcal.presentation.calibration import PLACE, steadiness
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import capital, files_written, quantity
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.stations import MOST_LINES
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SETTING_WORDS = {
    "per-station": "Set inclination and azimuth anew at every station, also where they stay the same.",
    **dict.fromkeys(
        ("per-direction", ASSUMED_PRACTICE),
        "Leave inclination and azimuth untouched while they stay the same: turn the toolface alone.",
    ),
}
"""Instructions to the operator by the practice on which a plan rests."""
STATION_TITLES = {
    "station": "station", "temperature_c": "T, °C", "ref_inclination_deg": "inclination, °",
    "ref_azimuth_deg": "magnetic azimuth, °", "ref_toolface_deg": "toolface, °",
}  # fmt: skip
"""Columns of the table of stations, and how they are headed."""


WITHOUT_VERTICAL = "not at 0°: at the vertical, azimuth and toolface are undefined"
"""The line below accuracies by inclination."""


GOOD_FOR = "the calibration will be good for {:.0f}…{:.0f} °C"
"""The temperatures that a plan gives."""
EFFICIENCY = "how close the plan is to the best possible one of as many stations, which has 100 %"
"""The meaning of the word in the table."""
FAR_INCLINATION = 150.0
"""Many stands that are turned by hand reach no larger inclination, degrees."""
BY_HAND = 120.0
"""Seconds that a person takes for a station beyond move and settling: to set each scale, and to read and note."""


class PlannedTriad(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a plan for a triad: uncertainties (1σ) by parameter of the calibration file."""

    standard_uncertainties: dict[str, float | None]
    order: int
    rank: int
    size: int
    degrees_of_freedom: float
    undetermined: list[Undetermined]


class DetectableError(msgspec.Struct, frozen=True, kw_only=True):
    """The error of one station from which `calibrate` reports it in 80 % of runs, at the worst station.

    `noticed`: the station or the residuals are reported; `named`: the station is, None where it never is.
    """

    observable: str
    unit: str
    noticed: float
    noticed_station: str
    named: float | None
    named_station: str


class PlanSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `plan` for one plan.

    `session_hours` are moves, settling and soaks of a driven stand, `soak_hours` part of them.
    `accuracy_deg` at 45° inclination, as `calibrate` states it without drift;
    `settings`: the practice of the stand that it rests on, as in a calibration file, and where that is "assumed"
    `accuracy_per_station_deg`, the same on a stand that is set at every station;
    `accuracy_by_inclination_deg` by angle at `inclinations_deg`. `efficiency_bound`: at least this share of the best
    D-value per parameter. Without `magnetometer` the profile says nothing of one. No plan of fewer than
    `fewest_stations` gives the wanted accuracy; None where none is wanted.
    """

    plan: str
    stations: int
    session_hours: float
    soak_hours: float
    accelerometer: PlannedTriad
    magnetometer: PlannedTriad | None = None
    accuracy_deg: dict[str, float | None]
    settings: str | msgspec.UnsetType = msgspec.UNSET
    accuracy_per_station_deg: dict[str, float | None] | msgspec.UnsetType = msgspec.UNSET
    inclinations_deg: list[float]
    accuracy_by_inclination_deg: dict[str, list[float | None]]
    rank: int
    size: int
    undetermined: list[Undetermined]
    efficiency_bound: float
    fewest_stations: int | None
    detectable_errors: list[DetectableError]
    findings: list[Finding]


class PlanDocument(PlanSummary, frozen=True, kw_only=True):
    """The output of `plan`: the first plan, the others that it was compared with, and the files written."""

    others: list[PlanSummary]
    output: str
    html: str


def wanted_accuracy(words: Sequence[str]) -> dict[str, float]:
    """Accuracies such as azimuth_deg=0.1 as numbers, degrees, by angle."""
    wanted = {}
    for word in words:
        name, _, value = word.replace("_deg=", "=").partition("=")
        try:
            wanted[name] = float(value)
        except ValueError:
            wanted[name] = np.nan
        if not 0 < wanted[name] < 180:
            raise InputError(f"`accuracy` must be such as azimuth_deg=0.1; got {word!r}.")
    return wanted


def reach(words: Sequence[str]) -> dict[str, tuple[float, float]]:
    """The reach of a stand, such as inclination_deg=0:120, as the least and the largest setting by angle, degrees."""
    ends = {}
    for word in words:
        name, _, limits = word.replace("_deg=", "=").partition("=")
        low, _, high = limits.partition(":")
        try:
            ends[name] = float(low), float(high)
        except ValueError:
            raise InputError(
                f"`reach` must be such as inclination_deg=0:120; got {word!r}."
            ) from None
    return ends


def facts(each: Planned) -> PlanSummary:
    """The statements about a plan."""
    return PlanSummary(**_fields(each))


def _fields(each: Planned) -> dict[str, Any]:
    """The fields of a `PlanSummary`."""
    calibration = each.calibration
    by_triad = {
        triad.name: _triad(triad, float(freedom))
        for triad, freedom in zip(calibration.triads, each.freedom, strict=True)
    }
    free = {entry.id: entry for entry in left_undetermined(calibration)}
    return {
        "plan": each.plan.source,
        "stations": each.plan.count,
        "session_hours": each.seconds / 3600,
        "soak_hours": each.soaking / 3600,
        **by_triad,
        "accuracy_deg": typical_accuracy(calibration),
        "settings": calibration.settings,
        "accuracy_per_station_deg": typical_accuracy(each.per_station)
        if each.per_station
        else msgspec.UNSET,
        "inclinations_deg": np.degrees(each.inclinations).round(9).tolist(),
        "accuracy_by_inclination_deg": _by_inclination(each),
        "rank": sum(triad.rank for triad in calibration.triads),
        "size": sum(triad.size for triad in calibration.triads),
        "undetermined": list(free.values()),
        "efficiency_bound": each.efficiency,
        "fewest_stations": each.bound,
        "detectable_errors": _detectable(each),
        "findings": each.findings,
    }


def _detectable(each: Planned) -> list[DetectableError]:
    """The errors of one station that `calibrate` will report, at the plan's worst stations."""
    names, rows = station_names(each.plan), []
    for observable, detection in each.detections.items():
        factor, unit = shown_in(observable)
        sizes = [sd[0, each.measured :] for sd in (detection.noticed, detection.named)]
        if np.isnan(sizes[0]).all():
            continue
        worst = [int(np.nanargmax(sd)) for sd in sizes]
        noticed, named = (float(sd[k]) * factor for sd, k in zip(sizes, worst, strict=True))
        rows.append(
            DetectableError(
                observable=observable, unit=unit, noticed=noticed, noticed_station=names[worst[0]],
                named=named if np.isfinite(named) else None, named_station=names[worst[1]],
            )
        )  # fmt: skip
    return rows


def _triad(triad: TriadCalibration, freedom: float) -> PlannedTriad:
    names = dict(zip(triad.parameter_names, triad.standard_uncertainties, strict=True))
    return PlannedTriad(
        standard_uncertainties=names,
        order=triad.order,
        rank=triad.rank,
        size=triad.size,
        degrees_of_freedom=freedom,
        undetermined=triad.undetermined,
    )


def _by_inclination(planned: Planned) -> dict[str, list[float | None]]:
    """1σ by angle at the working inclinations that the stand reaches, degrees; None: undetermined."""
    each = accuracy_at(planned.calibration, planned.inclinations.tolist())
    return {
        name: [None if np.isnan(sd) else float(np.degrees(sd)) for sd in values]
        for name, values in each.items()
    }


def findings(plans: Sequence[Planned]) -> list[Finding]:
    """That the tool has no magnetometer, what the plans leave undetermined, and what else is to be said of them."""
    profile = plans[0].calibration.profile
    text = f"the profile '{profile.name}' has no [magnetometer]: planned is a tool without one."
    without = [] if profile.has_magnetometer else [Finding(id="no-magnetometer", text=text)]
    entries: list[tuple[Planned, Finding | Undetermined]] = []
    for each in plans:
        entries += [(each, entry) for entry in left_undetermined(each.calibration)]
        entries += [(each, entry) for entry in each.findings]
    said = [
        Finding(id=entry.id, text=f"{each.plan.source}: {entry.text}") for each, entry in entries
    ]
    return without + said


def document(
    plans: Sequence[Planned], digests: Mapping[str, str], output: Path | None, html: Path | None,
    serial: str,
) -> dict[str, Any]:  # fmt: skip
    """The result for machines."""
    first, *others = map(_fields, plans)
    content = PlanDocument(
        **first,
        others=[PlanSummary(**other) for other in others],
        output=str(output or ""),
        html=str(html or ""),
    )
    return json_document("plan", content, {"simulated": True, "serial": serial}, **digests)


def screen(
    plans: Sequence[Planned], digests: Mapping[str, str], output: Path | None, html: Path | None
) -> str:
    """The result for people."""
    summaries = [facts(each) for each in plans]
    head = f"{plans[0].calibration.profile.name}   {_basis(plans[0])}"
    head += f"   {SIMULATED}" * _simulated(plans[0])
    blocks = [
        one_line(head),
        table(comparison_rows(summaries), ["", *(one_line(each.plan) for each in summaries)]),
    ]
    lines = [*_assumed(plans[0]), *_temperatures(plans), *_practice(summaries)]
    lines += [*_steadiness(plans), *_inclinations(plans[0]), *_far(plans)]
    lines.append(f"D-efficiency: {EFFICIENCY}")
    blocks += filter(None, ["\n".join(lines)])
    if len(plans) == 1:
        blocks += [accuracy(summaries[0]), detectable(summaries[0]), stations(plans[0])]
    if output or html:
        blocks.append(files_written(**{"plan": output, "run sheet": html}))
    return "\n\n".join(blocks)


def _basis(planned: Planned) -> str:
    """The tool of which a plan expects its results."""
    if (tool := planned.tool) is None:
        return "expected of a nominal tool, nothing measured"
    whose = f"tool {serial}" if (serial := serial_of(tool.tool)) else "the tool"
    return f"expected of {whose} from its calibration of {tool.day}"


def _simulated(planned: Planned) -> bool:
    """Whether a plan rests on a simulated calibration."""
    return planned.tool is not None and is_simulated(planned.tool.tool)


def _assumed(planned: Planned) -> list[str]:
    """Field, dip and gravity of the prediction as lines: field or dip that nothing states, if any."""
    if not planned.calibration.has_field:
        return []
    gravity, field, dip = (float(values[0]) for values in planned_earth(planned.plan))
    words = {"field": f"field {field:,.0f} nT", "dip": f"dip {np.degrees(dip):g}°"}
    blank = [word for name, word in words.items() if _is_blank(planned.plan, name)]
    if blank:
        return [f"the plan does not state the place; assumed: {', '.join(blank)}"]
    if not _is_blank(planned.plan, "gravity"):
        words["gravity"] = f"gravity {gravity:.5g} g"
    by_source: dict[str, list[str]] = {}
    for name, word in words.items():
        by_source.setdefault(_source(planned, name), []).append(word)
    return [f"place{source}: {', '.join(some)}" for source, some in by_source.items()]


def _source(planned: Planned, name: str) -> str:
    """Who gives a constant of the place; blank: the plan."""
    tool, column = planned.tool, REFERENCES[name].column
    if tool is None or np.any(planned.plan.columns[column] != place_of(tool).get(column)):
        return ""
    estimated = any(constant.name == name for constant in tool.constants)
    return ", estimated by the calibration" if estimated else ", from the calibration"


def _temperatures(plans: Sequence[Planned]) -> list[str]:
    """The temperatures of each plan, and those that its calibration will be good for, as a line."""
    lines = []
    for each in plans:
        if valid := each.calibration.valid_temperatures:
            at = ", ".join(f"{soak:.0f}" for soak in soak_temperatures(each.plan))
            whose = f"{one_line(each.plan.source)}: " if len(plans) > 1 else ""
            lines.append(f"{whose}planned at {at} °C; {GOOD_FOR.format(*valid)}")
    return lines


def _steadiness(plans: Sequence[Planned]) -> list[str]:
    """The drifts that the order of each plan would hide, and their effect, as lines."""
    lines = []
    for each in plans:
        whose = f"{one_line(each.plan.source)}: " if len(plans) > 1 else ""
        lines += [whose + block for block in steadiness(each.calibration) if block]
    return lines


def _practice(facts: Sequence[PlanSummary]) -> list[str]:
    """The assumption on the stand's settings as a line, if there is one."""
    return [ASSUMED] if any(each.settings == ASSUMED_PRACTICE for each in facts) else []


def _inclinations(planned: Planned) -> list[str]:
    """Why a best plan has few inclinations, and the cost of more, as a line, if it has."""
    levels = planned.compared()
    if levels is None:
        return []
    *others, last = [f"{each:g}°" for each in levels.used]
    used = f"{', '.join(others)} and {last}" if others else last
    aim = "the angles" if levels.criterion == "I" else "the parameters"
    bent = " They would also show an accelerometer that is not linear along the tool axis."
    more = bent if len(levels.used) <= 2 else ""
    return [
        f"Only {used} of {len(levels.offered)} inclinations to choose from: stations tell most where readings differ "
        f"most. As many stations evenly at all {len(levels.offered)} have {levels.cost:.2f} times the 1σ of {aim}."
        f"{more}"
    ]


def _far(plans: Sequence[Planned]) -> list[str]:
    """The option for a stand that turns less far than the plans, as a line, if they go far and nobody has used it."""
    most = max(float(attitudes(each.plan)[:, 0].max()) for each in plans)
    if most <= FAR_INCLINATION or ANGLES[0] in plans[0].stand.reach:
        return []
    return [
        f"Inclinations up to {most:g}°. If your stand reaches less, add --reach inclination_deg=0:120 to --stations "
        "or --accuracy."
    ]


def _is_blank(plan: Table, name: str) -> bool:
    """Whether a plan states a reference at no station."""
    return bool(
        np.isnan(np.asarray(plan.columns.get(REFERENCES[name].column, np.nan), float)).all()
    )


def comparison_rows(facts: Sequence[PlanSummary]) -> list[list[str]]:
    """The results of the plans, a plan in each column."""
    option = "no oven: --soak 0" if any(each.soak_hours for each in facts) else "--soak"
    lines = [
        ["stations", *(str(each.stations) for each in facts)],
        ["at the stand, driven", *(f"{each.session_hours:.1f} h" for each in facts)],
        [f"of which soak ({option})", *(f"{each.soak_hours:.1f} h" for each in facts)],
        ["per station (--speed, --settle)", *(f"{_seconds_each(each):.0f} s" for each in facts)],
        [
            f"by hand, {BY_HAND / 60:g} min a station more",
            *(f"{_by_hand(each):.1f} h" for each in facts),
        ],
        ["temperature order", *(_orders(each) for each in facts)],
        ["determined", *(f"{each.rank} of {each.size}" for each in facts)],
        ["degrees of freedom", *(_freedom(each) for each in facts)],
        ["D-efficiency, at least", *(f"{100 * each.efficiency_bound:.0f} %" for each in facts)],
    ]
    for name in facts[0].accuracy_deg:
        cells = [quantity(each.accuracy_deg[name], "°", 2) for each in facts]
        lines.append([f"{name}, 1σ at 45° inclination", *cells])
    anew = [each.accuracy_per_station_deg for each in facts]
    if any(anew):
        for name in facts[0].accuracy_deg:
            cells = [quantity(each[name], "°", 2) if each else "–" for each in anew]
            lines.append([f"{name}, 1σ if set at every station", *cells])
    return lines


def _by_hand(facts: PlanSummary) -> float:
    """Hours at a stand that a person sets and reads."""
    return facts.session_hours + facts.stations * BY_HAND / 3600


def _seconds_each(facts: PlanSummary) -> float:
    """Mean time of a station, from the move to it to its reading."""
    return 3600 * (facts.session_hours - facts.soak_hours) / facts.stations


def accuracy_rows(each: PlanSummary) -> list[list[str]]:
    """1σ of the angles, a working inclination in each row."""
    columns = each.accuracy_by_inclination_deg
    return [
        [f"{inclination:g}°", *(quantity(columns[name][place], "°", 2) for name in columns)]
        for place, inclination in enumerate(each.inclinations_deg)
    ]


def accuracy(each: PlanSummary) -> str:
    """1σ of the angles at the working inclinations."""
    rows = table(accuracy_rows(each), ["1σ at inclination", *each.accuracy_by_inclination_deg])
    return f"{rows}\n{WITHOUT_VERTICAL}"


DETECTABLE_TITLES = ["error of one station (80 % of runs)", "noticed from", "station named from"]
"""The titles of the table of errors that `calibrate` will report."""


def detectable_rows(each: PlanSummary) -> list[list[str]]:
    """The errors of one station from which `calibrate` reports it, an observable in each row."""
    return [
        [
            row.observable,
            quantity(float(f"{row.noticed:.2g}"), row.unit, 2),
            "never" if row.named is None else quantity(float(f"{row.named:.2g}"), row.unit, 2),
        ]
        for row in each.detectable_errors
    ]


def detectable(each: PlanSummary) -> str:
    """The errors of one station from which `calibrate` reports it in 80 % of runs."""
    return table(detectable_rows(each), DETECTABLE_TITLES)


def _freedom(each: PlanSummary) -> str:
    """Degrees of freedom of both triads."""
    triads = [triad for triad in (each.accelerometer, each.magnetometer) if triad]
    return " and ".join(dict.fromkeys(f"{triad.degrees_of_freedom:.0f}" for triad in triads))


def _orders(each: PlanSummary) -> str:
    orders = dict.fromkeys(t.order for t in (each.accelerometer, each.magnetometer) if t)
    return " and ".join(map(str, orders))


def stations(planned: Planned) -> str:
    """The stations of a plan, in order, up to `MOST_LINES`."""
    titles, rows = station_rows(planned.plan)
    more = len(rows) - MOST_LINES
    ends = f"\n… and {more} more" if more > 0 else ""
    return table([[*map(one_line, row)] for row in rows[:MOST_LINES]], titles) + ends


def station_rows(plan: Table) -> tuple[list[str], list[list[str]]]:
    """Titles and cells of the stations of a plan, in order."""
    names = [name for name in STATION_TITLES if name in plan.columns]
    columns = [[_cell(value) for value in plan.columns[name]] for name in names]
    return [STATION_TITLES[name] for name in names], [
        list(row) for row in zip(*columns, strict=True)
    ]


def _cell(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


# --------------------------------------------------------------------------
# The run sheet of a plan, to print and tick off, with what the plan will give.


SOAK_MARKERS = "os^Dv"
"""Markers of stations by soak."""


ROWS_OF_A_SHEET = 25
"""A table of no more rows is printed on one sheet."""


def render(plans: Sequence[Planned], serial: str = "") -> str:
    """The sheet of the first plan for the tool of a serial, and the others beside it, as HTML."""
    first, summaries = plans[0], [facts(each) for each in plans]
    titles, rows = _sheet(first.plan)
    return rendered(
        "plan.html",
        plan=first.plan.source,
        profile=first.calibration.profile.name,
        serial=serial,
        summary=summaries[0],
        banner=_banner(first),
        findings=[*left_undetermined(first.calibration), *first.findings],
        simulated=_simulated(first),
        basis="calibration" if first.tool else "profile",
        place=_place(first),
        titles=titles,
        channels=_channels(first.calibration),
        rows=rows,
        whole=len(rows) <= ROWS_OF_A_SHEET,
        soaks=any(begins for _, begins in rows),
        settings=SETTING_WORDS.get(str(first.calibration.settings), ""),
        asks_settings=not first.calibration.profile.stand.practice,
        compared=comparison_rows(summaries),
        plans=[each.plan for each in summaries],
        lines=_sheet_lines(first),
        accuracy=accuracy_rows(summaries[0]),
        detectable=detectable_rows(summaries[0]),
        detectable_titles=DETECTABLE_TITLES,
        coverage=draw_coverage(plans),
        curves=draw_accuracy(plans),
    )


def _sheet_lines(planned: Planned) -> list[str]:
    """The place, the temperatures and the efficiency of a plan, and why it has few inclinations, as sentences."""
    efficiency = f"D-efficiency, at least {100 * planned.efficiency:.0f} %: {EFFICIENCY}"
    lines = [*_assumed(planned), *_temperatures([planned]), efficiency]
    return [*(f"{capital(line)}." for line in lines), *_inclinations(planned)]


def _sheet(plan: Table) -> tuple[list[str], list[tuple[list[str], bool]]]:
    """Titles and cells of the stations in order, and where another soak begins.

    The last row is the first station of the last soak again: what has changed since is drift.
    """
    titles, rows = station_rows(plan)
    if titles[0] != STATION_TITLES["station"]:
        titles = [STATION_TITLES["station"], *titles]
        rows = [[name, *row] for name, row in zip(station_names(plan), rows, strict=True)]
    begins = np.diff(soak_numbers(plan), prepend=soak_numbers(plan)[:1]) != 0
    first, *others = rows[int(np.flatnonzero(begins)[-1]) if begins.any() else 0]
    stations = [*rows, [f"{first} again", *others]]
    return titles, list(zip(stations, [*begins.tolist(), False], strict=True))


def _channels(calibration: Calibration) -> list[str]:
    """The raw channels, with the unit that the profile's table has."""
    columns = calibration.profile.columns or {}
    names = [channel for triad in calibration.triads for channel in CHANNELS[triad.name]]
    units = {name: column.unit for name, column in columns.items() if column.unit}
    return [f"{name}, {units.get(name, 'raw')}" for name in names]


def _place(planned: Planned) -> list[tuple[str, str]]:
    """Gravity, field and dip of the place with their units; blank where the plan does not state them."""
    rows, stated = [], planned.stated.columns
    for name, word in (("gravity", "Gravity, g"), ("field", "Field, nT"), ("dip", "Dip, °")):
        values = np.unique(np.asarray(stated.get(REFERENCES[name].column, ()), float))
        rows.append((word, f"{values[0]:.6g}" if len(values) == 1 else ""))
    return rows


def _banner(planned: Planned) -> dict[str, str]:
    """How long it takes, and what it will give."""
    summary, free = facts(planned), planned.calibration.undetermined()
    expected = ", ".join(
        f"{name} {quantity(sd, '°', 2)}"
        for name, sd in summary.accuracy_deg.items()
        if sd is not None
    )
    soak = f" and {summary.soak_hours:.1f} h of soak" if summary.soak_hours else ""
    headline = (
        f"{plural(summary.stations, 'station')} – about {summary.session_hours:.1f} h at a driven stand, "
        f"{_seconds_each(summary):.0f} s a station{soak}; "
        f"{_by_hand(summary):.1f} h by hand"
    )
    after = (
        f"{summary.rank} of {summary.size} parameters determined. Accuracy to expect ({PLACE}): "
        f"{expected or 'none can be stated'}."
    )
    return banner(
        "attention" if free or planned.findings else "open",
        f"Planned – {_basis(planned)}",
        headline,
        after,
    )


@plots.style()
def draw_coverage(plans: Sequence[Planned]) -> Figure:
    """The directions of gravity and of the field in the tool at each station, by soak, a row for each plan."""
    label = "Directions of gravity and field in the axes of the tool"
    count = len(plans)
    figure, panels = plots.new_figure(
        label, 0.6 + 1.8 * count, rows=count, columns=2, sharex=True, sharey=True
    )
    for row, planned in zip(panels, plans, strict=True):
        degrees, soaks = attitudes(planned.plan), soak_numbers(planned.plan)
        both = reference_vectors(*np.radians(degrees).mT, *planned_earth(planned.plan))
        for axes, what, vectors in zip(row, ("gravity", "magnetic field"), both, strict=True):
            _directions(axes, vectors, soaks)
            name = f"{planned.plan.source[:30]}: " if count > 1 else ""
            axes.set_title(name + what)
        row[0].set_ylabel("above x-y plane, °")
    for axes in panels[-1]:
        axes.set_xlabel("direction about the tool axis, from x to y, °")
    return figure


def _directions(axes: Axes, vectors: Array, soaks: Ints) -> None:
    """Vectors (n, 3) in the tool's axes on a map of the sphere that is true to area: longitude and sine of latitude."""
    longitude = np.degrees(np.arctan2(vectors[:, 1], vectors[:, 0]))
    height = vectors[:, 2] / np.linalg.norm(vectors, axis=-1)
    for number in np.unique(soaks).tolist():
        some = soaks == number
        marker = SOAK_MARKERS[number % len(SOAK_MARKERS)]
        axes.plot(longitude[some], height[some], marker, mfc="none", color=plots.AFTER, alpha=0.8)
    axes.set(xlim=(-185, 185), ylim=(-1.08, 1.08), xticks=range(-180, 181, 90))
    latitudes = np.arange(-90, 91, 30)
    axes.set_yticks(np.sin(np.radians(latitudes)), [str(each) for each in latitudes])


@plots.style()
def draw_accuracy(plans: Sequence[Planned]) -> Figure:
    """1σ of each angle over inclination, a line for each plan."""
    x = np.linspace(2, 178, 45)
    curves = [accuracy_at(each.calibration, np.radians(x).tolist()) for each in plans]
    names = list(curves[0])
    label = "Expected 1σ over inclination"
    figure, [panels] = plots.new_figure(label, 2.3, columns=len(names))
    for axes, name in zip(panels, names, strict=True):
        for place, (each, sd) in enumerate(zip(plans, curves, strict=True)):
            colour, _, line = plots.SERIES[place % len(plots.SERIES)]
            axes.plot(x, np.degrees(sd[name]), ls=line, color=colour, label=each.plan.source[:30])
        axes.set(title=name, xlabel="inclination, °", xlim=(0, 180), xticks=range(0, 181, 45))
        if np.isfinite(np.concatenate([sd[name] for sd in curves])).any():
            axes.set_yscale("log")
            plots.plain_numbers(axes.yaxis, 1.0, 2.0, 5.0)
    panels[0].set_ylabel("1σ, °")
    if len(plans) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 4))
    return figure
