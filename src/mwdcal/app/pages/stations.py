"""Stations found in a log, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app.screens.numbers import channels_of
from mwdcal.app.screens.stations import left
from mwdcal.geometry.vectors import Array
from mwdcal.logs.stations import Stations
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINTS = 2000
"""Points of a line in the picture."""


@plots.style()
def figure(stations: Stations) -> Figure:
    """The log with what was taken and what was left: a panel for each triad and for the activity."""
    triads = channels_of(stations.traces)
    label, count = "Stations taken and left in a log", len(triads)
    figure, grid = plots.new_figure(label, 1.5 + 1.5 * count, count + 1, sharex=True)
    panels = grid[:, 0]
    for axes, (triad, names) in zip(panels, triads.items(), strict=False):
        _draw_triad(axes, stations, names)
        axes.set_ylabel(f"{triad},\nraw")
    _draw_activity(panels[-1], stations)
    for axes in panels:
        _shade(axes, stations)
    _number_stations(panels[0], stations)
    return figure


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most `POINTS` points: the lowest and the highest of each of equal runs."""
    step = -(-2 * len(x) // POINTS)
    if step <= 2:
        return x, y
    count = len(x) // step
    blocks = y[: count * step].reshape(count, step)
    ends = np.stack([blocks.min(-1), blocks.max(-1)], -1).ravel()
    return np.repeat(x[: count * step : step], 2), ends


def _draw_triad(axes: Axes, stations: Stations, names: list[str]) -> None:
    """Medians of short cells of the channels that have them, else the samples."""
    cells = stations.activity.cells
    for name in names:
        x, y = (cells[name].start, cells[name].level) if name in cells else stations.traces[name]
        look = {"color": plots.AXES[name[-1]], "ls": plots.LINES[name[-1]]}
        axes.plot(*_thinned(x, y), lw=0.9, label=name, **look)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=2.6)


def _draw_activity(axes: Axes, stations: Stations) -> None:
    edge, value = stations.activity.edge, stations.activity.value
    fine = np.isfinite(value) & (value > 0)
    x, y = _thinned(edge[:-1], np.where(fine, value, value[fine].min(initial=np.inf)))
    axes.plot(x, np.where(np.isinf(y), np.nan, y), color=plots.BEFORE, lw=0.7)
    axes.set(yscale="log", ylabel="activity,\nnoise floors", xlabel="time, s")
    plots.plain_numbers(axes.yaxis, 1.0)
    if not stations.threshold:
        return  # a logarithmic axis has no zero
    axes.axhline(stations.threshold, color=plots.MARKED, lw=1, ls=(0, (5, 3)))
    title, place = f"threshold {stations.threshold:.3g}", (1.0, stations.threshold)
    across = ("axes fraction", "data")
    axes.annotate(title, place, (6, 0), xycoords=across, va="center", **plots.NOTE)
    if stations.stretch:
        axes.axhspan(*stations.stretch, color="#fde8d4", lw=0, zorder=0.4)


def _shade(axes: Axes, stations: Stations) -> None:
    """Taken intervals filled, left ones hatched."""
    intervals = stations.intervals
    bars = np.stack([intervals.start, intervals.end - intervals.start], -1)
    across = axes.get_xaxis_transform()
    place: dict[str, Any] = {"yrange": (0, 1), "transform": across, "zorder": 0.5}
    axes.broken_barh(bars[intervals.taken].tolist(), fc=plots.BAND, lw=0, **place)
    left = bars[~intervals.taken].tolist()
    axes.broken_barh(left, fc="none", ec=plots.BEFORE, hatch="////", lw=0.4, **place)
    axes.set_xlim(float(stations.time[0]), float(stations.time[-1]))


def _number_stations(axes: Axes, stations: Stations) -> None:
    start, end = stations.intervals.stations
    middle = (start + end) / 2
    every = max(1, -(-len(middle) // 30))
    across = ("data", "axes fraction")
    look: dict[str, Any] = {"xycoords": across, "textcoords": "offset points", "fontsize": 6}
    for i in range(0, len(middle), every):
        axes.annotate(str(i + 1), (middle[i], 1.0), (0, 2), ha="center", **look)
    axes.set_title(
        f"{stations.table.source}: stations taken {stations.table.count} (filled, numbered), "
        f"calm intervals left {len(left(stations))} (hatched)",
        pad=12,
    )
