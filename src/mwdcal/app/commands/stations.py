"""`mwdcal stations`: what is read, found, shown and drawn."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app import progress
from mwdcal.app.commands.options import Asked
from mwdcal.app.pages import plots
from mwdcal.app.text import table
from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files import logs
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import atomic
from mwdcal.files.formats import table as tables
from mwdcal.geometry.vectors import Array
from mwdcal.logs.stations import StandstillError, Stations, find_stations

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LINES = 40
"""Stations of a table on screen."""
POINTS = 2000
"""Points of a line in the picture."""
PICTURES = (".png", ".svg")
LINES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))
"""Line styles of x, y and z."""


def run(asked: Asked, say: Callable[[str], None]) -> tuple[list[Finding], Any]:
    """Find, write and draw: the findings, and the result for people or for machines."""
    plot = asked["plot"]
    if plot and plot.suffix.lower() not in PICTURES:
        raise InputError(f"--plot {plot}: the suffix must be one of {', '.join(PICTURES)}.")
    try:
        made = find(asked, say)
    except StandstillError as error:
        raise _told(error, plot) from None
    drawn = picture(made, plot.suffix.lower()) if plot else b""
    tables.write(asked["output"], made.table)
    if plot:
        atomic.write(plot, drawn)
    files = {"output": str(asked["output"]), "plot": str(plot or "")}
    shown = {**summary(made), **files} if asked["as_json"] else screen(made, files)
    return made.findings, shown


def _told(error: StandstillError, plot: Path | None) -> InputError:
    """The refusal with what was found out so far, and the picture, which helps most then."""
    lines = [str(error), *(f"! {finding.text}" for finding in error.made.findings)]
    if plot:
        atomic.write(plot, picture(error.made, plot.suffix.lower()))
        lines.append(f"wrote {plot} (picture)")
    return InputError("\n".join(lines))


def find(asked: Asked, say: Callable[[str], None]) -> Stations:
    """The standstills of a log file; says how far it is where it takes long."""
    slowly = progress.slowly(say)
    names = [name.strip() for name in asked["columns"].split(",")] if asked["columns"] else []
    read = logs.read(asked["log"], names, decimal=asked["decimal"], say=slowly)
    return find_stations(
        read,
        sampling_hz=asked["sampling_hz"],
        min_seconds=asked["min_seconds"],
        trim_seconds=asked["trim_seconds"],
        threshold=asked["threshold"],
        say=slowly,
    )


def summary(made: Stations) -> dict[str, Any]:
    """The result for machines: one entry per station, and what was left."""
    columns = {
        name: column if isinstance(column, list) else [_finite(v) for v in column.tolist()]
        for name, column in made.table.columns.items()
    }
    rows = zip(*columns.values(), strict=True)
    return {
        "log": made.table.source,
        "rows": len(made.time),
        "seconds": float(made.time[-1] - made.time[0]),
        "threshold": made.threshold,
        "stretch": made.stretch,
        "min_seconds": made.min_seconds,
        "trim_seconds": made.trim_seconds,
        "stations": [dict(zip(columns, row, strict=True)) for row in rows],
        "left": [
            {"start_s": start, "end_s": end, "reason": "short" if short else "moves slowly"}
            for start, end, short in _left(made)
        ],
        "findings": made.findings,
    }


def _finite(value: float) -> float | None:
    return None if np.isnan(value) else value


def _left(made: Stations) -> list[tuple[float, float, bool]]:
    """Intervals that look still and were not taken: start, end, whether they are short."""
    found = made.found
    return [
        (float(found.start[i]), float(found.end[i]), bool(found.short[i]))
        for i in np.flatnonzero(~found.taken)
    ]


def screen(made: Stations, files: dict[str, str]) -> str:
    """What was found, for people."""
    columns = made.table.columns
    start, end = (np.asarray(columns[name]) for name in ("start_s", "end_s"))
    whole = float(made.time[-1] - made.time[0])
    left = _left(made)
    short = sum(is_short for *_, is_short in left)
    lines = [
        f"{made.table.source}   {len(made.time)} rows   {whole:.6g} s   "
        f"{made.table.count} stations, {100 * float((end - start).sum()) / whole:.0f} % of the time",
        f"threshold {made.threshold:.3g} noise floors{_stretch(made)}   at least "
        f"{made.min_seconds:g} s after {made.trim_seconds:g} s trimmed off each end   "
        f"left: {short} too short, {len(left) - short} moving slowly",
        "",
        _stations_table(made),
        f"wrote {files['output']}"
        + (f"   {files['plot']} (picture)" if files["plot"] else "")
        + f"   next: mwdcal calibrate {files['output']} -o CAL.json",
    ]
    return "\n".join(lines)


def _stretch(made: Stations) -> str:
    if made.stretch is None:
        return " (given)"
    return " (the same stations from {:.3g} to {:.3g})".format(*made.stretch)


def _stations_table(made: Stations) -> str:
    columns = made.table.columns
    names = [name for kind in CHANNELS.values() for name in kind if name in columns]
    warm = ["temperature_c"] if "temperature_c" in columns else []
    rows = []
    for i in range(min(made.table.count, MOST_LINES)):
        ends = [f"{float(columns[name][i]):.2f}" for name in ("start_s", "end_s")]
        samples = f"{float(columns['samples'][i]):.0f}"
        warmth = [f"{float(columns[name][i]):.2f}" for name in warm]
        values = [_to_sd(float(columns[n][i]), float(columns[f"sd_{n}"][i])) for n in names]
        drifting = str(columns["drifting"][i])
        rows.append([str(i + 1), *ends, samples, *warmth, *values, drifting])
    header = ["station", "start s", "end s", "samples", *(["°C"] if warm else []), *names, "drifts"]
    more = made.table.count - len(rows)
    return table(rows, header) + (f"\n… and {more} more" if more > 0 else "")


def _to_sd(value: float, sd: float) -> str:
    """A mean to two digits of its standard uncertainty."""
    if not 0 < sd < np.inf:
        return f"{value:.7g}"
    digits = max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f}"


def picture(made: Stations, kind: str) -> bytes:
    """The log with what was taken and what was left, as PNG or SVG (`kind` the suffix)."""
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError(
            "--plot needs matplotlib, which is not installed. Install mwdcal[report]: "
            "pip install 'mwdcal[report]'"
        ) from None
    triads = [t for t in CHANNELS.values() if any(name in made.traces for name in t)]
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(plots.STYLE)
        height = 1.5 + 1.5 * len(triads)
        figure = Figure(figsize=(plots.WIDTH, height), layout="constrained")
        panels = figure.subplots(len(triads) + 1, 1, sharex=True, squeeze=False)[:, 0]
        for axes, triad in zip(panels, triads, strict=False):
            _draw_triad(axes, made, triad)
        _draw_activity(panels[-1], made)
        for axes in panels:
            _shade(axes, made)
        _number_stations(panels[0], made)
        stream = io.BytesIO()
        nothing = {"Software": None} if kind == ".png" else {"Date": None, "Creator": None}
        figure.savefig(stream, format=kind[1:], dpi=160, metadata=nothing)
    return stream.getvalue()


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most `POINTS` points: the lowest and the highest of each of equal runs."""
    step = -(-2 * len(x) // POINTS)
    if step <= 2:
        return x, y
    count = len(x) // step
    blocks = y[: count * step].reshape(count, step)
    ends = np.stack([blocks.min(-1), blocks.max(-1)], -1).ravel()
    return np.repeat(x[: count * step : step], 2), ends


def _draw_triad(axes: Axes, made: Stations, triad: tuple[str, ...]) -> None:
    """Medians of short cells of the channels that have them, else the samples."""
    names = list(made.traces)
    cells = {names[i]: c for i, c in zip(made.activity.channels, made.activity.cells, strict=True)}
    for name, line in zip(triad, LINES, strict=True):
        if name in cells:
            x, y = cells[name].start, cells[name].level
        else:
            x, y = made.traces[name]
        colour = {"x": plots.AFTER, "y": plots.MARKED, "z": "#111827"}[name[-1]]
        axes.plot(*_thinned(x, y), color=colour, ls=line, lw=0.9, label=name)
    axes.set_ylabel("accelerometer,\nraw" if triad[0] == "ax" else "magnetometer,\nraw")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=2.6)


def _draw_activity(axes: Axes, made: Stations) -> None:
    edge, value = made.activity.edge, made.activity.value
    fine = np.isfinite(value) & (value > 0)
    x, y = _thinned(edge[:-1], np.where(fine, value, value[fine].min(initial=np.inf)))
    axes.plot(x, np.where(np.isinf(y), np.nan, y), color=plots.BEFORE, lw=0.7)
    axes.set_yscale("log")
    axes.set_ylabel("activity,\nnoise floors")
    axes.set_xlabel("time, s")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: "")
    axes.axhline(made.threshold, color=plots.MARKED, lw=1, ls=(0, (5, 3)))
    axes.annotate(
        f"threshold {made.threshold:.3g}", (1.0, made.threshold), (6, 0), va="center",
        xycoords=("axes fraction", "data"), textcoords="offset points", color="#9a3d00", fontsize=7,
    )  # fmt: skip
    if made.stretch:
        axes.axhspan(*made.stretch, color="#fde8d4", lw=0, zorder=0.4)


def _shade(axes: Axes, made: Stations) -> None:
    """Taken intervals filled, left ones hatched."""
    found = made.found
    bars = np.stack([found.start, found.end - found.start], -1)
    place: dict[str, Any] = {
        "yrange": (0, 1),
        "transform": axes.get_xaxis_transform(),
        "zorder": 0.5,
    }
    axes.broken_barh(bars[found.taken].tolist(), fc=plots.BAND, lw=0, **place)
    left = bars[~found.taken].tolist()
    axes.broken_barh(left, fc="none", ec=plots.BEFORE, hatch="////", lw=0.4, **place)
    axes.set_xlim(float(made.time[0]), float(made.time[-1]))


def _number_stations(axes: Axes, made: Stations) -> None:
    found = made.found
    middle = (found.start + found.end)[found.taken] / 2
    every = max(1, -(-len(middle) // 30))
    for i in range(0, len(middle), every):
        place = (float(middle[i]), 1.0)
        axes.annotate(
            str(i + 1), place, (0, 2), xycoords=("data", "axes fraction"), ha="center",
            textcoords="offset points", fontsize=6,
        )  # fmt: skip
    left = int(np.count_nonzero(~found.taken))
    axes.set_title(
        f"{made.table.source}: stations taken {made.table.count} (filled, numbered), "
        f"calm intervals left {left} (hatched)",
        pad=12,
    )
