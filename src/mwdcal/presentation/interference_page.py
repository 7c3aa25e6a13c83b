"""The page of a multi-station analysis, and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.geometry.vectors import Array
from mwdcal.presentation.numbers import estimate
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.survey import (
    CORRECTED_TITLES,
    DIRECTION_TITLES,
    corrected_rows,
    direction_rows,
    misfit_in_words,
)
from mwdcal.presentation.text import plural
from mwdcal.survey.interference import (
    CHANGED_ALONG,
    Interference,
    InterferenceStation,
    MultiStationAnalysis,
)
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LARGEST_DRAWN_SD = 2.0
"""Standard uncertainty up to which an angle is drawn, degrees: near vertical that of azimuth grows without end."""
MOST_CORRECTED_OF_PAGE = 2000
"""Surveys in the table of a page."""


def render(result: Interference, sha256: Mapping[str, str]) -> str:
    """The analysis as HTML; `sha256` of the files it comes from, by what these are."""
    summary, stated = result.summary, (result.readings.metadata, result.calibration.tool)
    return rendered(
        "interference.html",
        *stated,
        summary=summary,
        readings=result.readings.name,
        calibration=result.calibration.run_name,
        banner=_banner(summary),
        findings=summary.findings,
        terms=result.terms.sentence,
        analysis=sections(result),
        sha256=sha256,
    )


def sections(result: Interference) -> dict[str, Any]:
    """The analysis as `interference_sections` of the templates show it."""
    summary = result.summary
    rows = corrected_rows(summary, MOST_CORRECTED_OF_PAGE)
    return {
        "summary": summary,
        "directions": direction_rows(summary),
        "direction_titles": DIRECTION_TITLES,
        "misfit": misfit_in_words(summary),
        "strengths": draw_strengths(summary),
        "azimuths": draw_azimuths(summary),
        "titles": CORRECTED_TITLES,
        "rows": rows,
        "more": len(summary.station_rows) - len(rows),
    }


def _banner(summary: MultiStationAnalysis) -> dict[str, str]:
    """The interference, or that it cannot be separated from azimuth."""
    size = summary.interference
    left = f"{summary.azimuth_sd_deg:.2g}° (1σ) at the worst survey, {summary.largest_azimuth_sd_deg:g}° allowed"
    if not summary.separable:
        headline = "Interference cannot be separated from azimuth"
        return banner("bad", "Refused", headline, f"Azimuth would be uncertain by {left}.")
    if changes := [each.text for each in summary.findings if each.id == CHANGED_ALONG]:
        return banner(
            "bad", "Refused", "Surveys do not have one interference", changes[0].capitalize()
        )
    headline = (
        f"Axial {estimate(size.axial_nt, size.sd_axial_nt, 'nT')}, "
        f"cross-axial {estimate(size.cross_axial_nt, size.sd_cross_axial_nt, 'nT')}"
    )
    surveys = plural(len(summary.station_rows), "survey")
    after = f"From {surveys}; interference and drift that are left make the azimuth uncertain by {left}."
    doubtful = any(row.doubtful for row in summary.station_rows)
    if summary.missing or doubtful:
        return banner("attention", "Attention", headline, after)
    return banner("good", "Separable", headline, after)


def along_hole(rows: list[InterferenceStation]) -> tuple[Array, str]:
    """Where surveys (n,) lie along a depth axis, and its title: measured depth, else their number."""
    depth = np.array([row.md_m for row in rows], float)
    if np.isnan(depth).any():
        return np.arange(1.0, len(rows) + 1), "survey"
    return depth, "measured depth, m"


def _column(rows: list[InterferenceStation], name: str) -> Array:
    """A column (n,) of the surveys; NaN where there is nothing."""
    return np.array([getattr(row, name) for row in rows], float)


@plots.style()
def draw_strengths(summary: MultiStationAnalysis) -> Figure:
    """Departures of |b| and dip from their references over depth, before and after, with 2σ of the references."""
    rows = summary.station_rows
    label = "Departures of |b| and dip from the references over depth, before and after"
    figure, [panels] = plots.new_figure(label, 4.2, columns=2, sharey=True)
    depth, title = along_hole(rows)
    bands = {"field": ("nt", summary.sd_ref_field_nt), "dip": ("deg", summary.sd_ref_dip_deg)}
    for axes, (name, (unit, sd)) in zip(panels, bands.items(), strict=True):
        axes.axvspan(-2 * sd, 2 * sd, color=plots.BAND, lw=0, label="references, ±2σ")
        axes.axvline(0, color="#4b5563", lw=0.6)
        for when in ("before", "after"):
            off = _column(rows, f"{name}_{when}_{unit}") - _column(rows, f"ref_{name}_{unit}")
            _series(axes, off, depth, when)
        _mark(axes, off, depth, rows)
    panels[0].set(xlabel="|b| less reference, nT", ylabel=title)
    panels[1].set(xlabel="dip less reference, °")
    _finish(figure, panels, depth)
    return figure


@plots.style()
def draw_azimuths(summary: MultiStationAnalysis) -> Figure:
    """Change of azimuth by the correction, with 2σ of the corrected azimuth, and the attitudes."""
    rows = summary.station_rows
    figure, [panels] = plots.new_figure(
        "Change of azimuth by the correction over depth, and attitudes", 4.2, columns=2, sharey=True
    )
    depth, title = along_hole(rows)
    change, sd = _column(rows, "azimuth_change_deg"), _column(rows, "sd_azimuth_after_deg")
    certain = sd < LARGEST_DRAWN_SD
    change = np.where(certain, change, np.nan)
    first = panels[0]
    first.fill_betweenx(
        depth, change - 2 * sd, change + 2 * sd, color=plots.BAND, lw=0, label="±2σ after"
    )
    _series(first, change, depth, "after")
    _mark(first, change, depth, rows)
    first.axvline(0, color="#4b5563", lw=0.6)
    first.set(xlabel="azimuth after less before, °", ylabel=title)
    names = {"inclination_deg": "inclination", "azimuth_after_deg": "azimuth after"}
    for (name, word), (colour, marker, line) in zip(names.items(), plots.SERIES[1:], strict=False):
        shown = np.where(certain | (name == "inclination_deg"), _column(rows, name), np.nan)
        panels[1].plot(shown, depth, ls=line, marker=marker, color=colour, label=word)
    panels[1].set(xlabel="inclination, azimuth, °")
    _finish(figure, panels, depth)
    return figure


def _series(axes: Axes, value: Array, depth: Array, when: str) -> None:
    """Values before the correction in grey, after it in colour."""
    look = {"before": (plots.BEFORE, "o", (0, (3, 3))), "after": (plots.AFTER, "s", "-")}
    colour, marker, line = look[when]
    axes.plot(value, depth, ls=line, marker=marker, mfc="none", color=colour, label=when)


def _mark(axes: Axes, value: Array, depth: Array, rows: list[InterferenceStation]) -> None:
    """Surveys that do not agree with the others."""
    some = np.array([row.doubtful for row in rows])
    if some.any():
        axes.plot(value[some], depth[some], "x", ms=7, color=plots.MARKED, label="doubtful")


def _finish(figure: Figure, panels: Sequence[Axes], depth: Array) -> None:
    """Depth downwards, and one legend above the panels."""
    room = 0.03 * max(float(np.ptp(depth)), 1.0)
    panels[0].set_ylim(float(depth.max()) + room, float(depth.min()) - room)
    pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in panels]
    handles = {label: handle for each in pairs for handle, label in each}
    figure.legend(handles.values(), handles, loc="outside upper left", ncols=5)
