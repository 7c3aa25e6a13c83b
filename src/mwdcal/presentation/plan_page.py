"""The run sheet of a plan, to print and tick off, with what the plan will give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mwdcal.calibration.prediction import accuracy_at
from mwdcal.files.contract import REFERENCES
from mwdcal.geometry.vectors import Array, Ints, reference_vectors
from mwdcal.planning.expected import left_undetermined, planned_earth
from mwdcal.planning.planned import Planned
from mwdcal.planning.plans import attitudes, soak_numbers
from mwdcal.presentation.numbers import quantity
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.plan import (
    DETECTABLE_TITLES,
    PLACE,
    accuracy_rows,
    comparison_rows,
    detectable_rows,
    facts,
    station_rows,
)
from mwdcal.presentation.text import plural
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SOAK_MARKERS = "os^Dv"
"""Markers of stations by soak."""


def render(plans: Sequence[Planned]) -> str:
    """The sheet of the first plan, and the others beside it, as HTML."""
    first, summaries = plans[0], [facts(each) for each in plans]
    soaks = soak_numbers(first.plan)
    return rendered(
        "plan.html",
        plan=first.plan.source,
        profile=first.calibration.profile.name,
        summary=summaries[0],
        banner=_banner(first),
        findings=[*left_undetermined(first.calibration), *first.findings],
        simulated=True,
        place=_place(first),
        titles=station_rows(first.plan)[0],
        rows=zip(station_rows(first.plan)[1], np.diff(soaks, prepend=soaks[:1]) != 0, strict=True),
        compared=comparison_rows(summaries),
        plans=[each.plan for each in summaries],
        accuracy=accuracy_rows(summaries[0]),
        detectable=detectable_rows(summaries[0]),
        detectable_titles=DETECTABLE_TITLES,
        coverage=draw_coverage(plans),
        curves=draw_accuracy(plans),
    )


def _place(planned: Planned) -> list[tuple[str, str]]:
    """Gravity, field and dip of the place with their units; blank where the plan does not state them."""
    rows = []
    for name, word in (("gravity", "Gravity, g"), ("field", "Field, nT"), ("dip", "Dip, °")):
        values = np.unique(np.asarray(planned.plan.columns.get(REFERENCES[name].column, ()), float))
        rows.append((word, f"{values[0]:.12g}" if len(values) == 1 else ""))
    return rows


def _banner(planned: Planned) -> dict[str, str]:
    """How long it takes, and what it will give."""
    summary, free = facts(planned), planned.calibration.undetermined()
    expected = ", ".join(
        f"{name} {quantity(sd, '°')}" for name, sd in summary.accuracy_deg.items() if sd is not None
    )
    headline = (
        f"{plural(summary.stations, 'station')} – about {summary.session_hours:.1f} h at the stand"
    )
    after = (
        f"{summary.rank} of {summary.size} parameters determined. Accuracy to expect ({PLACE}): "
        f"{expected or 'none can be stated'}."
    )
    return banner(
        "attention" if free or planned.findings else "open",
        "Planned – nothing measured",
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
