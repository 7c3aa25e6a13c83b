"""Stations found in a log, on the screen and for machines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.findings import UNUSED
from mwdcal.calibration.readings import serial_of
from mwdcal.calibration.record import Finding
from mwdcal.errors import shell_word
from mwdcal.files.contract import RAW
from mwdcal.geometry.vectors import Array
from mwdcal.logs.station_means import ALL_STILL
from mwdcal.logs.stations import Stations
from mwdcal.presentation.noise import rounded
from mwdcal.presentation.numbers import capital, channels_of, files_written, fixed, measured
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LINES = 40
"""Stations of a table on screen."""


class StationsSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `stations`: an entry for each station, what was left, and the files written."""

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
    report: str


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
        left=left(stations),
        findings=stations.findings,
        **files,
    )


def left(stations: Stations) -> list[dict[str, Any]]:
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


def body(stations: Stations) -> str:
    """The result, for people."""
    lines = [one_line("   ".join(heading(stations))), "   ".join(search(stations)), ""]
    return "\n".join([*lines, _stations_table(stations)])


def screen(stations: Stations, files: dict[str, str]) -> str:
    """The result, the files that were written, and what to do next."""
    outputs = files_written(run=files["output"], picture=files["plot"], report=files["report"])
    return f"{body(stations)}\n{outputs}   next: {one_line(next_command(files['output']))}"


def shown_in(plot: Path | None, report: Path | None) -> str:
    """Where a log without a station is shown."""
    if plot or report:
        return files_written(picture=plot, report=report)
    return "--report or --plot shows the log."


def next_command(output: str) -> str:
    """The advice for the run."""
    return f"mwdcal calibrate {shell_word(output)} -o CAL.json"


def heading(stations: Stations) -> list[str]:
    """The log, and how much of it the stations are."""
    return [
        stations.table.source,
        *extent(stations),
        f"{plural(stations.table.count, 'station')}, {share(stations)} of the time",
    ]


def extent(stations: Stations) -> list[str]:
    """Rows and seconds of the log."""
    return [f"{len(stations.time)} rows", f"{_seconds(stations):.6g} s"]


def share(stations: Stations) -> str:
    """How much of the time of the log the stations are."""
    columns = stations.table.columns
    start, end = (np.asarray(columns.get(name, ()), float) for name in ("start_s", "end_s"))
    return f"{100 * float((end - start).sum()) / _seconds(stations):.0f} %"


def search(stations: Stations) -> list[str]:
    """How stations were searched for, and what was left."""
    short = sum(each["reason"] == "short" for each in left(stations))
    same = " (the same stations from {} to {})"
    stretch = same.format(*map(rounded, stations.stretch)) if stations.stretch else " (given)"
    return [
        f"threshold {rounded(stations.threshold)} noise floors{stretch}",
        f"at least {stations.min_seconds:g} s after {stations.trim_seconds:g} s trimmed off each end",
        f"left: {short} too short, {len(left(stations)) - short} moving slowly",
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


# --------------------------------------------------------------------------
# The page of the stations found in a log, and its figure.


POINTS = 2000
"""Points of a line in the picture."""
LONGEST_LOG_NAME = 40
"""Characters of the name of a log that have room above the picture."""
NUMBER_ROOM = 0.014
"""Room of a digit above the picture, as a share of its width."""
PLAIN_COLUMNS = {
    "start_s": ("start, s", 2),
    "end_s": ("end, s", 2),
    "samples": ("samples", 0),
    "temperature_c": ("T, °C", 2),
    "drift_temperature_c": ("its drift, °C", 2),
}
"""Columns of the table of stations without an uncertainty: title and decimals."""
LEFT_OUT = {
    "short": "too short once trimmed",
    "moves slowly": "moves slowly, by more than a tool at rest can",
}
"""Why an interval was left out, in words."""


def render(stations: Stations, log_sha256: str, output: str = "", why: str = "") -> str:
    """The stations as HTML, with the run file that they were written to.

    A log without a station has none, but the reason `why`.
    """
    metadata = stations.table.metadata
    return rendered(
        "standstills.html",
        metadata,
        result=stations,
        log=stations.table.source,
        heading=_heading(stations),
        banner=_banner(stations, output, why),
        findings=stations.findings,
        figure=figure(stations),
        **_table(stations),
        left=left(stations),
        reasons=LEFT_OUT,
        search=search(stations),
        log_sha256=log_sha256,
        output=output,
    )


def _heading(stations: Stations) -> list[str]:
    """The log, unless it is the name of the page, its extent, and when it was recorded, if it says so."""
    metadata = stations.table.metadata
    log = [stations.table.source] if serial_of(metadata) else []
    date = [f"recorded {metadata['date']}"] if metadata.get("date") else []
    return [*log, ", ".join(extent(stations)), *date]


def _banner(stations: Stations, output: str, why: str) -> dict[str, str]:
    """How many stations there are, what is doubtful, and what to do next."""
    if not stations.table.count:
        reason = why.removeprefix(f"{stations.table.source}: ")
        return banner("bad", "No station", "No standstill found in this log", capital(reason))
    ids = [finding.id for finding in stations.findings if finding.id != UNUSED]
    headline = (
        f"{plural(stations.table.count, 'station')} found – at rest {share(stations)} of the time"
    )
    if ALL_STILL in ids:
        log = shell_word(stations.table.source)
        after = f"A calibration needs several attitudes. Noise of the tool: mwdcal noise {log}"
        return banner("attention", "At rest throughout", headline, after)
    enter = f"enter the angles of the stand in {output} (ref_inclination_deg, …), then "
    stated = any(name.startswith("ref_") for name in stations.table.columns)
    after = f"Next: {'' if stated else enter}{next_command(output)}"
    if not ids:
        some = len(left(stations))
        passed = (
            f"{plural(some, 'calm interval')} left out, see below" if some else "Nothing left out"
        )
        return banner("good", "OK", headline, f"{passed}. {after}")
    seen = "the finding" if len(ids) == 1 else f"the {len(ids)} findings"
    return banner("attention", "Attention", headline, f"See {seen} below. {after}")


def _table(stations: Stations) -> dict[str, Any]:
    """Titles of the table of stations, and rows: plain cells, means with their 1σ, and what drifts."""
    columns = stations.table.columns
    plain = {name: look for name, look in PLAIN_COLUMNS.items() if name in columns}
    channels = [name for name in RAW if name in columns]
    titles = [*(title for title, _ in plain.values()), *(f"{name}, raw" for name in channels)]
    cells = [(columns[name], places) for name, (_, places) in plain.items()]
    rows = [
        {
            "station": columns["station"][i],
            "plain": [fixed(float(column[i]), places) for column, places in cells],
            "means": [measured(*(float(columns[n][i]) for n in (c, f"sd_{c}"))) for c in channels],
            "drifts": columns["drifting"][i],
        }
        for i in range(stations.table.count)
    ]
    return {"titles": ["station", *titles, "drifts"], "rows": rows}


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
    """Numbers of the stations above them, as many as have room."""
    start, end = stations.intervals.stations
    room = NUMBER_ROOM * float(stations.time[-1] - stations.time[0])
    look: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "fontsize": 6.5, "ha": "center"}
    free = -np.inf
    for number, middle in enumerate(((start + end) / 2).tolist(), 1):
        half = room * len(str(number)) / 2
        if middle - half >= free:
            place = (0, 2)
            axes.annotate(str(number), (middle, 1.0), place, textcoords="offset points", **look)
            free = middle + half
    log = stations.table.source
    log = log if len(log) <= LONGEST_LOG_NAME else f"…{log[-LONGEST_LOG_NAME:]}"
    axes.set_title(
        f"{log}: stations taken {stations.table.count} (filled, numbered), "
        f"calm intervals left {len(left(stations))} (hatched)",
        pad=12,
    )
