"""Figures of a verdict: what each limit judges, over toolface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.errors import InputError
from mwdcal.use.plots import BEFORE, MARKED, SERIES, new_figure, quantity, style
from mwdcal.use.roll_test import basis
from mwdcal.use.verification import JudgedSet, Verdict, VerdictRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OTHER_SETS = ("#9ca3af", ".", "-")
"""Colour, marker and line of all but the worst where there are many roll sets, and of stations outside of them."""
DRAWN_TOOLFACES = np.radians(np.arange(0, 361, 3))
"""Toolfaces at which a curve is drawn."""
OFF_PICTURE = 8.0
"""A limit of more than this times what is drawn is named instead of drawn."""


@dataclass(frozen=True)
class VerdictPlots:
    """Figures of one verdict, as `verdict.plot`: Matplotlib figures, in the style of the report.

    Raises:
        InputError: the verdict has nothing to draw.
    """

    verdict: Verdict

    @style()
    def toolface(self) -> Figure:
        """Each judged limit over toolface: stations and curve of every roll set, and the limit.

        An error is drawn as it is, a spread as the departure from the middle of its curve.
        """
        rows = [row for row in self.verdict.rows if row.sets]
        if not rows:
            raise InputError(
                "the verdict has no values to draw: no limit could be judged. See its `rows` and "
                "`findings` for the reasons."
            )
        height = -(-len(rows) // 2)
        label = "Departures over toolface, with limits"
        figure, panels = new_figure(label, 0.35 + 1.75 * height, height, 2)
        for axes, row in zip(panels.ravel(), rows, strict=False):
            self._panel(axes, row)
        for axes in panels.ravel()[len(rows) :]:
            axes.set_visible(False)
        series = {
            label: handle
            for axes in panels.ravel()
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(series.values(), series, loc="outside upper left", ncols=3, handlelength=3.5)
        return figure

    def _panel(self, axes: Axes, row: VerdictRow) -> None:
        worst = max(row.sets, key=lambda each: each.value)
        for each in row.sets:
            self._draw_set(axes, row, each, each is worst)
        shown = [
            self.verdict.station_rows[i].departures.get(row.name, np.nan) for i in _stations(row)
        ]
        _limit_lines(axes, row, float(np.nanmax(np.abs([0.0, *shown]))))
        axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)
        axes.set(xlim=(-5, 365), xticks=range(0, 361, 90), xlabel="toolface, °")
        axes.set_ylabel(f"{'departure' if row.bound < row.limit else 'error'}, {row.unit}")
        look: dict[str, Any] = {"color": "#111827" if row.passed else "#9a3d00"}
        value = "not stated" if row.value is None else quantity(row.value, row.unit)
        outcome = f"{value} of {quantity(row.limit, row.unit)}: {'pass' if row.passed else 'FAIL'}"
        axes.set_title(row.name, **look)
        axes.set_title(outcome, loc="right", fontsize=7, **look)

    def _look(self, each: JudgedSet, worst: bool) -> tuple[str, tuple[str, str, Any]]:
        """How a set is called in the legend, and its colour, marker and line."""
        sets = (each for row in self.verdict.rows for each in row.sets)
        labels = list(dict.fromkeys(each.label for each in sets if each.label))
        if not each.label:
            return "stations outside of roll sets", (BEFORE, "p", "-")
        if len(labels) <= len(SERIES):
            return each.label, SERIES[labels.index(each.label)]
        return ("worst roll set", SERIES[0]) if worst else ("other roll sets", OTHER_SETS)

    def _draw_set(self, axes: Axes, row: VerdictRow, each: JudgedSet, worst: bool) -> None:
        """Stations of a set as markers, and its curve."""
        label, (colour, marker, line) = self._look(each, worst)
        stations = [self.verdict.station_rows[i] for i in each.stations]
        toolface = np.array([station.toolface_deg for station in stations], float)
        values = [station.departures.get(row.name, np.nan) for station in stations]
        look: dict[str, Any] = {"color": colour, "lw": 1, "zorder": 2.5 if worst else 2}
        markers: dict[str, Any] = {"marker": marker, "mfc": "none", "mew": 0.8, "ms": 3.4}
        axes.plot(np.mod(toolface, 360), values, ls="", **markers, **look)
        if each.coefficients is None:
            axes.plot([], [], ls="", label=label, **markers, **look)
            return
        course = basis(DRAWN_TOOLFACES) @ np.array(each.coefficients)
        axes.plot(np.degrees(DRAWN_TOOLFACES), course, ls=line, **look)
        axes.plot([], [], ls=line, label=label, **markers, **look)


def _stations(row: VerdictRow) -> Sequence[int]:
    return [i for each in row.sets for i in each.stations]


def _limit_lines(axes: Axes, row: VerdictRow, size: float) -> None:
    """Both limit lines, or, far beyond what is drawn, their value in words."""
    axes.margins(y=0.12)
    if row.bound <= OFF_PICTURE * size:
        for sign in (-1, 1):
            axes.axhline(sign * row.bound, color=MARKED, lw=1, ls=(0, (5, 3)), label="limit")
        return
    axes.margins(y=0.3)
    text = f"limit lines at ±{quantity(row.bound, row.unit)}: off the picture"
    look: dict[str, Any] = {"ha": "right", "va": "top", "color": "#9a3d00", "fontsize": 6.5}
    axes.text(0.99, 0.97, text, transform=axes.transAxes, **look)


Verdict.plot = property(VerdictPlots)
