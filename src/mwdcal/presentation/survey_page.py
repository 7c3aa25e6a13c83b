"""Figures of a well: strengths against their limits, angles, toolface, and the path on the map and in section.

The page of the surveys of a well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.units import LENGTH_UNITS
from mwdcal.geometry.vectors import Array, Bools, wrap
from mwdcal.presentation.contributions import SHARE_TITLES, share_rows, station_row
from mwdcal.presentation.interference_page import LARGEST_DRAWN_SD, sections
from mwdcal.presentation.numbers import capital
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.survey import (
    ACCEPTED_TOGETHER,
    JOINTLY,
    SurveySummary,
    declination_in_words,
    end_in_words,
    limits_in_words,
    result_summary,
    runs_in_words,
    sources_in_words,
    start_in_words,
    survey_rows,
    without_verdict,
)
from mwdcal.presentation.text import plural
from mwdcal.survey.acceptance import SURVEY_UNITS
from mwdcal.survey.contributions import Contributions
from mwdcal.survey.surveying import SurveyedWell
from mwdcal.survey.well import Position, Well
from mwdcal.use.plots import AFTER, BAND, BEFORE, MARKED, SERIES, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ELLIPSE_POINTS = np.linspace(0, 2 * np.pi, 73)
ELLIPSE_SDS = 2.0
"""Standard deviations of the ellipses of position."""
ELLIPSE_SHARE = 0.08
"""Largest half axis of an ellipse as a share of the path."""
BLIND_SHADE = "#f0b429"
"""Shade of stretches where acceptance is blind to interference."""
MOST_ELLIPSES = 12
"""Ellipses of position on a map."""
MOST_MARKS = 400
"""Stations that are marked; of more only the line is drawn."""
STRENGTH_TITLES = {
    "gravity": "|g| less reference, mg",
    "field": "|b| less reference, nT",
    "dip": "dip less reference, °",
}


def along(well: Well) -> tuple[Array, str]:
    """Where stations (n,) lie along a depth axis, and its title: measured depth, else their number."""
    if well.position is None:
        return np.arange(1.0, len(well.judgement.accepted) + 1), "station"
    unit = well.length_unit
    return well.position.md / LENGTH_UNITS[unit], f"measured depth, {unit}"


@style()
def strengths(well: Well) -> Figure:
    """Departures of |g|, |b| and dip over depth, with the band of the limits; rejected stations marked."""
    depth, title = along(well)
    figure, panels = new_figure(
        "Departures of |g|, |b| and dip from the references, over depth", 4.6, 1, 3, sharey=True
    )
    for k, (axes, (name, (_, factor, _))) in enumerate(
        zip(panels[0], SURVEY_UNITS.items(), strict=True)
    ):
        _track(axes, well, depth, k, factor)
        axes.set_xlabel(STRENGTH_TITLES[name])
        axes.locator_params(axis="x", nbins=5)
    panels[0, 0].set_ylabel(title)
    _downwards(panels[0, 0], depth)
    handles = {
        label: handle
        for axes in panels[0]
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=3)
    return figure


SHARE_COLOURS = (
    "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#7c3aed", "#d55e00", "#56b4e9", "#b8a200", "#4b5563", "#a3c1ad",
)  # fmt: skip
"""Colours of causes; neighbours differ in lightness, and lines part them."""
SHOWN_SHARES = {"inclination": 0, "azimuth": 1, "lateral": 6, "highside": 7}
"""Quantities whose shares are drawn, and their places in `CONTRIBUTED`."""


@style()
def shares(well: Well, budget: Contributions) -> Figure:
    """The share of each cause in the variance over depth: of the angles, and of the position across the hole."""
    depth, title = along(well)
    names = [*dict.fromkeys(cause.name for cause in budget.causes)]
    located = has_path(well.position)
    shown = {n: k for n, k in SHOWN_SHARES.items() if located or k < 2}
    figure, panels = new_figure(
        "Share of each cause in the variance of angles and position, over depth",
        4.6,
        1,
        len(shown),
        sharey=True,
    )
    for axes, (name, k) in zip(panels[0], shown.items(), strict=True):
        _share_track(axes, depth, [_share_of(budget, cause, k) for cause in names])
        axes.set_xlabel(f"{name}, % of variance")
    panels[0, 0].set_ylabel(title)
    _downwards(panels[0, 0], depth)
    figure.legend(
        *(panels[0, 0].get_legend_handles_labels()[0], names), loc="outside upper left", ncols=2
    )
    return figure


def _share_of(budget: Contributions, name: str, k: int) -> Array:
    """The share (n,) of all causes of a name, per cent."""
    rows = [i for i, cause in enumerate(budget.causes) if cause.name == name]
    return np.asarray(100 * budget.share[rows, :, k].sum(0))


def _share_track(axes: Axes, depth: Array, parts: list[Array]) -> None:
    """Shares side by side, over depth."""
    there = ~np.isnan(parts[0]) & ~np.isnan(depth)
    edge = np.zeros(int(there.sum()))
    for i, part in enumerate(parts):
        upper = edge + part[there]
        colour = SHARE_COLOURS[i % len(SHARE_COLOURS)]
        axes.fill_betweenx(
            depth[there], edge, upper, color=colour, lw=0.4, ec="white", label=str(i)
        )
        edge = upper
    axes.set_xlim(0, 100)


def _track(axes: Axes, well: Well, depth: Array, k: int, factor: float) -> None:
    """One strength over depth."""
    judgement = well.judgement
    value, bound = judgement.departure[:, k] * factor, judgement.bound[:, k] * factor
    there = ~np.isnan(value) & ~np.isnan(depth)
    if not there.any():
        axes.annotate("not judged", (0.5, 0.5), xycoords="axes fraction", ha="center", color=BEFORE)
        axes.set_xticks([])
        return
    limited = there & np.isfinite(bound)
    if limited.any():
        axes.fill_betweenx(
            depth[limited], -bound[limited], bound[limited], color=BAND, lw=0, label="limits"
        )
    axes.axvline(0, color="#4b5563", lw=0.6)
    axes.plot(
        value[there],
        depth[there],
        color=AFTER,
        marker="." if there.sum() <= MOST_MARKS else "",
        lw=0.8,
        label="surveys",
    )
    wrong = there & judgement.judged & ~judgement.accepted
    if wrong.any():
        axes.plot(
            value[wrong], depth[wrong], ls="", marker="x", ms=5, color=MARKED, label="rejected"
        )


def _downwards(axes: Axes, depth: Array) -> None:
    """Depth downwards, with room at both ends."""
    known = depth[~np.isnan(depth)]
    low, high = float(known.min(initial=0.0)), float(known.max(initial=1.0))
    room = 0.03 * max(high - low, 1.0)
    axes.set_ylim(high + room, low - room)


@style()
def angles(well: Well) -> Figure:
    """Inclination and azimuth over depth with ±2σ, and the toolface as a dial: outwards is deeper."""
    depth, title = along(well)
    figure, panels = new_figure("Inclination, azimuth and toolface over depth", 4.0, 1, 3)
    inclination, azimuth, toolface = (
        well.surveys.of(n) for n in ("inclination", "azimuth", "toolface")
    )
    north = well.north.name
    turned = np.degrees(wrap(azimuth[0] + well.north.offset)), np.degrees(well.sd_azimuth)
    tracks = (
        (np.degrees(inclination[0]), np.degrees(inclination[1]), "inclination, °"),
        (*turned, f"azimuth from {north} north, °"),
    )
    panels[0, 1].sharey(panels[0, 0])
    panels[0, 1].tick_params(labelleft=False)
    for axes, (value, sd, name) in zip(panels[0, :2], tracks, strict=True):
        _angle_track(axes, depth, value, sd)
        for top, bottom in stretches(depth, well.blind):
            axes.axhspan(top, bottom, color=BLIND_SHADE, alpha=0.35, lw=0)
        axes.set_xlabel(name)
    panels[0, 0].set_ylabel(title)
    where = panels[0, 2].get_subplotspec()
    panels[0, 2].remove()
    _dial(figure.add_subplot(where, projection="polar"), well, depth, toolface[0])
    return figure


def stretches(depth: Array, chosen: Bools) -> list[tuple[float, float]]:
    """From where to where neighbouring stations are all chosen, half a course farther at both ends."""
    known = np.flatnonzero(~np.isnan(depth))
    at, some = depth[known], chosen[known]
    middle = (at[1:] + at[:-1]) / 2
    edges = np.concatenate([at[:1], middle, at[-1:]])
    change = np.diff(np.concatenate([[False], some, [False]]).astype(int))
    return [
        *zip(
            edges[np.flatnonzero(change > 0)].tolist(),
            edges[np.flatnonzero(change < 0)].tolist(),
            strict=True,
        )
    ]


def _angle_track(axes: Axes, depth: Array, value: Array, sd: Array) -> None:
    there = ~np.isnan(value) & ~np.isnan(depth) & (sd < LARGEST_DRAWN_SD)
    marker = "." if there.sum() <= MOST_MARKS else ""
    breaks = np.where(
        np.abs(np.diff(value[there], prepend=value[there][:1])) > 180, np.nan, value[there]
    )
    axes.plot(breaks, depth[there], color=AFTER, marker=marker)
    axes.fill_betweenx(
        depth[there], (value - 2 * sd)[there], (value + 2 * sd)[there], color=BAND, lw=0
    )
    _downwards(axes, depth)


def _dial(axes: Any, well: Well, depth: Array, toolface: Array) -> None:
    """Toolfaces around a dial: from high side, or from magnetic north."""
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetagrids(range(0, 360, 45))
    magnetic = well.surveys.magnetic
    kinds = (("from high side", ~magnetic, SERIES[0]), ("from magnetic north", magnetic, SERIES[1]))
    for label, some, (colour, marker, _) in kinds:
        some = some & ~np.isnan(toolface)
        if some.any():
            axes.plot(toolface[some], depth[some], ls="", marker=marker, color=colour, label=label)
    known = depth[~np.isnan(depth)]
    low, high = float(known.min(initial=0.0)), float(known.max(initial=1.0))
    axes.set_ylim(low - 0.5 * max(high - low, 1.0), high + 0.05 * max(high - low, 1.0))
    axes.set_yticklabels([])
    axes.set_title("toolface, ° (outwards: deeper)", pad=14)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=1)


@style()
def path(well: Well) -> Figure:
    """The hole on the map, and in the vertical section towards its end, with ellipses of position.

    Ellipses are drawn as large as they are, filled, and enlarged. Where acceptance is blind the hole is shaded.
    """
    position = well.position
    assert position is not None
    there = ~np.isnan(position.place[:, 0])
    figure, panels = new_figure("Well path on the map and in vertical section", 3.9, 1, 2)
    unit, metres = well.length_unit, LENGTH_UNITS[well.length_unit]
    place, covariance = position.place[there] / metres, position.covariance[there] / metres**2
    towards, enlarged = _section(place), enlargement(position)
    plan = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    section = np.array([[np.cos(towards), np.sin(towards), 0.0], [0.0, 0.0, 1.0]])
    for axes, view in zip(panels[0], (plan, section), strict=True):
        _shade(axes, place @ view.T, well.blind[there])
        _view(axes, place, covariance, view, enlarged)
    panels[0, 0].set(xlabel=f"east, {unit}", ylabel=f"north ({well.north.name}), {unit}")
    panels[0, 1].set(
        xlabel=f"along {np.degrees(wrap(towards)):.0f}°, {unit}", ylabel=f"TVD, {unit}"
    )
    panels[0, 1].invert_yaxis()
    panels[0, 0].set_title("map")
    panels[0, 1].set_title("vertical section")
    for axes in panels[0]:
        axes.set_aspect("equal", adjustable="datalim")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4)
    return figure


def _shade(axes: Axes, points: Array, blind: Bools) -> None:
    """Shade the stretches of a hole whose stations are `blind` (n,)."""
    if blind.any():
        line = np.where(blind[:, None], points, np.nan)
        axes.plot(
            *line.T, color=BLIND_SHADE, lw=9, marker="o", ms=9, mec="none", alpha=0.5, label="blind", zorder=1,
            solid_capstyle="round",
        )  # fmt: skip


def _section(place: Array) -> float:
    """Azimuth from the first to the last position, radians."""
    north, east, _ = place[-1] - place[0]
    return float(np.arctan2(east, north))


def _view(axes: Axes, place: Array, covariance: Array, view: Array, enlarged: float) -> None:
    """Positions (n, 3) in a plane, `view` (2, 3), with some ellipses, `enlarged` times."""
    points = place @ view.T
    marker = "." if len(points) <= MOST_MARKS else ""
    axes.plot(*points.T, color=AFTER, marker=marker, lw=1.0, label="hole")
    chosen = np.unique(np.linspace(0, len(points) - 1, MOST_ELLIPSES).round().astype(int))
    circle = np.stack([np.cos(ELLIPSE_POINTS), np.sin(ELLIPSE_POINTS)])
    labels = ["2σ as large as it is", f"2σ, {enlarged:g} times as large"]
    for i in chosen:
        spread = view @ covariance[i] @ view.T
        if np.isfinite(spread).all():
            values, vectors = np.linalg.eigh(spread)
            ring = ELLIPSE_SDS * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
            axes.fill(*(points[i][:, None] + ring), color=MARKED, lw=0.7, label=labels[0])
            if enlarged > 1:
                larger = points[i][:, None] + enlarged * ring
                axes.plot(*larger, color=MARKED, lw=0.7, ls=(0, (4, 2)), label=labels[1])
            labels = ["_", "_"]


def enlargement(position: Position) -> float:
    """By how much ellipses of position are drawn larger than they are, to be seen: 1, 2, 5, 10 and so on."""
    extent = np.nanmax(np.ptp(position.place[~np.isnan(position.place[:, 0])], axis=0), initial=0.0)
    largest = ELLIPSE_SDS * np.nanmax(position.sd, initial=0.0)
    if not 0 < largest < ELLIPSE_SHARE * extent:
        return 1.0
    ratio = ELLIPSE_SHARE * extent / largest
    decade = 10.0 ** np.floor(np.log10(ratio))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= ratio))


def has_path(position: Position | None) -> bool:
    """Whether any station has a position."""
    return position is not None and not np.isnan(position.place[:, 0]).all()


MOST_ROWS_OF_PAGE = 2000
"""Surveys in the table of a page."""


def render(surveyed: SurveyedWell, findings: list[Finding]) -> str:
    """The surveys as HTML, with the multi-station analysis if there is one."""
    well, analysis = surveyed.well, surveyed.analysis
    facts = result_summary(surveyed)
    budget = surveyed.contributions if facts.blank < facts.rows else None
    digests = dict(surveyed.inputs.named)
    for i, run in enumerate(surveyed.runs[1:], 2):
        digests |= {
            f"{name} {i}": run.inputs.named.get(name, "") for name in digests if " " not in name
        }
    stated = well.readings.metadata, well.calibration.tool
    located = has_path(well.position)
    header, rows = survey_rows(well, slice(MOST_ROWS_OF_PAGE), located)
    return rendered(
        "survey.html",
        *stated,
        facts=facts,
        modelled=well.limits.probability is not None,
        readings=well.readings.name,
        banner=_banner(facts),
        findings=findings,
        strengths=strengths(well) if facts.not_judged < facts.rows else None,
        angles=angles(well) if facts.blank < facts.rows else None,
        path=path(well) if located else None,
        contributions=shares(well, budget) if budget else None,
        causes=share_rows(budget, station_row(budget, None), well.length_unit) if budget else [],
        cause_titles=SHARE_TITLES,
        last=budget.station[station_row(budget, None)] if budget else "",
        enlarged=enlargement(well.position) if located and well.position else 1.0,
        terms=well.terms.sentence,
        declination=declination_in_words(facts),
        sources="; ".join(sources_in_words(facts)),
        limits=limits_in_words(well, facts),
        tie_in=start_in_words(well),
        end=end_in_words(facts.end, facts.north, facts.length_unit) if facts.end else "",
        header=header,
        rows=rows,
        jointly=capital(JOINTLY)
        if any(row[-1].startswith(ACCEPTED_TOGETHER) for row in rows)
        else "",
        analysis=sections(analysis) if analysis else None,
        more=facts.rows - len(rows),
        calibration=well.calibration.run_name,
        sha256={name: digest for name, digest in digests.items() if digest},
        runs=runs_in_words(facts),
    )


def _banner(facts: SurveySummary) -> dict[str, str]:
    """How many surveys may be used."""
    surveys = plural(facts.rows, "survey")
    headline = f"{facts.accepted} of {surveys} within the limits {facts.limits}"
    if facts.not_judged == facts.rows:
        headline = f"{surveys} not judged by the limits {facts.limits}"
    north = f"Azimuths count from {facts.north} north"
    if facts.rejected:
        return banner("bad", "Rejected", headline, f"{facts.rejected} outside. {north}")
    if facts.blank == facts.rows:
        outside = any(finding.id == "outside-temperature" for finding in facts.findings)
        reason = (
            "they lie outside the calibrated temperatures" if outside else "readings are missing"
        )
        return banner("bad", "No result", "No survey has a result", f"See below: {reason}")
    if without := ", ".join(without_verdict(facts)):
        return banner("attention", "Attention", headline, f"{without}. {north}")
    if facts.blind:
        return banner(
            "attention", "Attention", headline, f"{facts.blind} blind to interference. {north}"
        )
    if any(finding.id == "partly-judged" for finding in facts.findings):
        return banner("attention", "Attention", headline, f"Judged in part. {north}")
    return banner("good", "Accepted", headline, north)
