"""Stations found in a log: on the screen, for machines, and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.app.pages.page import channels_of
from mwdcal.app.text import one_line, plural, table
from mwdcal.calibration.record import Finding
from mwdcal.files.contract import RAW
from mwdcal.geometry.vectors import Array
from mwdcal.logs.stations import Stations
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LINES = 40
"""Stations of a table on screen."""
POINTS = 2000
"""Points of a line in the picture."""


class StationsSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `stations` prints: an entry for each station, what was left, and the files written."""

    log: str
    rows: int
    seconds: float
    threshold: float
    stretch: tuple[float, float] | None
    min_seconds: float
    trim_seconds: float
    stations: list[dict[str, float | str | bool | None]]
    left: list[dict[str, float | str]]
    findings: list[Finding]
    output: str
    plot: str


def summary(stations: Stations, files: dict[str, str]) -> StationsSummary:
    """The result for machines."""
    columns = stations.table.columns
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return StationsSummary(
        log=stations.table.source,
        rows=len(stations.time),
        seconds=_seconds(stations),
        threshold=stations.threshold,
        stretch=stations.stretch,
        min_seconds=stations.min_seconds,
        trim_seconds=stations.trim_seconds,
        stations=[dict(zip(columns, row, strict=True)) for row in rows],
        left=_left(stations),
        findings=stations.findings,
        output=files["output"],
        plot=files["plot"],
    )


def _left(stations: Stations) -> list[dict[str, Any]]:
    """Intervals that look still and were not taken."""
    intervals = stations.intervals
    columns = (intervals.start, intervals.end, intervals.short)
    rows = zip(*(column[~intervals.taken].tolist() for column in columns), strict=True)
    return [
        {"start_s": start, "end_s": end, "reason": "short" if short else "moves slowly"}
        for start, end, short in rows
    ]


def _seconds(stations: Stations) -> float:
    """Duration of the log."""
    return float(stations.time[-1] - stations.time[0])


def screen(stations: Stations, files: dict[str, str]) -> str:
    """What was found, for people."""
    picture = f"   {files['plot']} (picture)" if files["plot"] else ""
    after = f"next: mwdcal calibrate {files['output']} -o CAL.json"
    lines = [
        one_line("   ".join(_heading(stations))),
        "   ".join(_search(stations)),
        "",
        _stations_table(stations),
        one_line(f"wrote {files['output']}{picture}   {after}"),
    ]
    return "\n".join(lines)


def _heading(stations: Stations) -> list[str]:
    """The log, and how much of it the stations are."""
    whole = _seconds(stations)
    start, end = (np.asarray(stations.table.columns[name]) for name in ("start_s", "end_s"))
    share = 100 * float((end - start).sum()) / whole
    return [
        stations.table.source,
        f"{len(stations.time)} rows",
        f"{whole:.6g} s",
        f"{plural(stations.table.count, 'station')}, {share:.0f} % of the time",
    ]


def _search(stations: Stations) -> list[str]:
    """How stations were searched for, and what was left."""
    short = sum(left["reason"] == "short" for left in _left(stations))
    same = " (the same stations from {:.3g} to {:.3g})"
    stretch = same.format(*stations.stretch) if stations.stretch else " (given)"
    return [
        f"threshold {stations.threshold:.3g} noise floors{stretch}",
        f"at least {stations.min_seconds:g} s after {stations.trim_seconds:g} s trimmed off each end",
        f"left: {short} too short, {len(_left(stations)) - short} moving slowly",
    ]


def _stations_table(stations: Stations) -> str:
    columns = stations.table.columns
    names = [name for name in RAW if name in columns]
    titles = {"start_s": "start s", "end_s": "end s", "samples": "samples", "temperature_c": "°C"}
    plain = {name: title for name, title in titles.items() if name in columns}
    rows = []
    for i in range(min(stations.table.count, MOST_LINES)):
        numbers = [f"{float(columns[n][i]):.{0 if n == 'samples' else 2}f}" for n in plain]
        values = [_to_sd(float(columns[n][i]), float(columns[f"sd_{n}"][i])) for n in names]
        rows.append([str(i + 1), *numbers, *values, str(columns["drifting"][i])])
    more = stations.table.count - len(rows)
    header = ["station", *plain.values(), *names, "drifts"]
    return table(rows, header) + (f"\n… and {more} more" if more > 0 else "")


def _to_sd(value: float, sd: float) -> str:
    """A mean to two digits of its standard uncertainty."""
    if not 0 < sd < np.inf:
        return f"{value:.7g}"
    digits = max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f}"


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
        f"calm intervals left {len(_left(stations))} (hatched)",
        pad=12,
    )
