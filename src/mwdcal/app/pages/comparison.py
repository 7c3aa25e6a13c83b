"""The page of methods side by side, and its figures.

Every method has a colour and a marker of its own, the same in all figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal import __version__
from mwdcal.app.pages.page import banner, environment
from mwdcal.app.screens.comparison import (
    ComparedParameter,
    effort,
    errors,
    gauge,
    heading,
    measures,
    notes,
    parameters_of,
    refusals,
)
from mwdcal.app.screens.numbers import capital
from mwdcal.app.text import superscript
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.comparison.compare import Comparison, Row, able
from mwdcal.geometry.observables import TITLES
from mwdcal.geometry.vectors import Array
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHOD_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#4b5563")
LOOKS = dict(zip(EVIDENCE, zip(METHOD_COLOURS, "os^xDv", strict=True), strict=True))
MOST_STATIONS = 240
"""A longer run shows the largest error of each of so many equal parts of it."""


def render(
    comparison: Comparison, profile: str = "", run_sha256: str = "", profile_sha256: str = ""
) -> str:
    """The comparison as HTML, with the name of its tool profile and the SHA-256 of its sources."""
    template = environment().get_template("comparison.html")
    return template.render(
        {function.__name__: function for function in TABLES + FIGURES},
        result=comparison,
        simulated=comparison.simulated,
        banner=_banner(comparison),
        rows=able(comparison.rows),
        limit=MOST_STATIONS,
        profile=profile,
        run_sha256=run_sha256,
        profile_sha256=profile_sha256,
        version=__version__,
    )


def _banner(comparison: Comparison) -> dict[str, str]:
    """The advice, and why."""
    headline, _, why = comparison.advice.partition(": ")
    level = "good" if able(comparison.rows) else "bad"
    return banner(level, "Advice", capital(headline), capital(why))


@plots.style()
def draw_errors(comparison: Comparison) -> Figure:
    """Left-out error of every observable and method over the best of any; hollow: in sample."""
    rows, names = able(comparison.rows), list(comparison.units)
    label = "Left-out error of every method and observable"
    figure, [[axes]] = plots.new_figure(label, 0.75 + 0.36 * len(names))
    best = np.fmin.reduce([[row.held_out[name] for name in names] for row in rows])
    best = np.where(best > 0, best, np.nan)
    for row, shift in zip(rows, _abreast(rows, 0.11), strict=True):
        where, (colour, marker) = np.arange(len(names)) + shift, LOOKS[row.method]
        inside = [row.in_sample[name] for name in names] / best
        left_out = [row.held_out[name] for name in names] / best
        hollow: dict[str, Any] = {"mfc": "white", "mew": 0.7, "ms": 3.2, "alpha": 0.8}
        axes.plot(inside, where, marker, color=colour, **hollow)
        axes.plot(left_out, where, marker, color=colour, ms=4.6, label=row.method)
    _ratio_axis(axes)
    _observable_axis(axes, names)
    axes.axvline(1, color="#4b5563", lw=0.8)
    _legend(figure)
    return figure


def _abreast(rows: Sequence[Row], step: float) -> Array:
    """Shifts that put the markers of every method side by side."""
    return step * (np.arange(len(rows), dtype=float) - (len(rows) - 1) / 2)


def _observable_axis(axes: Axes, names: Sequence[str]) -> None:
    """An observable in each row, the first at the top, with lines between them."""
    axes.set_yticks(range(len(names)), [TITLES.get(n, n) for n in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    for edge in np.arange(len(names) - 1) + 0.5:
        axes.axhline(edge, color="#e5e7eb", lw=0.6)


def _legend(figure: Any) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))


def _ratio_axis(axes: Axes) -> None:
    """A logarithmic axis of ratios, with plain numbers."""
    axes.set(xscale="log", xlabel="rms error ÷ least left-out error of any method")
    low, high = axes.get_xlim()
    steps = (1.0, 2.0, 5.0) if high / low > 8 else (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0)
    plots.plain_numbers(axes.xaxis, *(steps if high / low < 1e3 else (1.0,)))


@plots.style()
def draw_stations(comparison: Comparison) -> Figure:
    """Left-out error of every station, an observable in each row and a method in each column."""
    rows = able(comparison.rows)
    names = [name for name in comparison.units if name in rows[0].station_errors]
    label, height = "Left-out error of every station by method", 0.5 + 0.85 * len(names)
    across: dict[str, Any] = {"sharex": True, "sharey": "row"}
    across["gridspec_kw"] = {"hspace": 0.02, "wspace": 0.02}
    figure, panels = plots.new_figure(label, height, len(names), len(rows), **across)
    for axes, name in zip(panels[:, 0], names, strict=True):
        unit = comparison.units[name].partition(" ")[0]
        axes.set_ylabel(f"{TITLES[name]}, {unit}", fontsize=6.5)
    for column, row in zip(panels.T, rows, strict=True):
        colour = LOOKS[row.method][0]
        for axes, name in zip(column, names, strict=True):
            _station_stems(axes, row.station_errors[name], colour)
        column[0].set_title(row.method, fontsize=7, color=colour)
        column[-1].set_xlabel("station, in order", fontsize=6.5)
    return figure


def _station_stems(axes: Axes, values: Array, colour: str) -> None:
    where, heights = _largest(values)
    plots.stems(axes, where, heights, color=colour, lw=0.8 if len(where) < 80 else 0.5)
    axes.axhline(0, color="#4b5563", lw=0.5)
    axes.tick_params(labelsize=6, length=2)
    axes.locator_params(nbins=4)
    axes.grid(axis="x", visible=False)


def _largest(values: Array) -> tuple[Array, Array]:
    """Numbers, from 1, and errors of the stations; of a long run the worst of each part."""
    step = -(-len(values) // MOST_STATIONS)
    size = np.nan_to_num(np.abs(values), nan=-1.0)
    starts = range(0, len(values), step)
    worst = np.array([s + int(np.argmax(size[s : s + step])) for s in starts])
    return worst + 1.0, values[worst]


@plots.style()
def draw_parameters(comparison: Comparison) -> Figure:
    """Parameters with 1σ, less those of the first method, in units of its own 1σ."""
    rows = able(comparison.rows)
    triads = list(rows[0].parameters)
    label, height = "Parameters of every method with 1σ", 0.4 + 2.0 * len(triads)
    figure, panels = plots.new_figure(label, height, len(triads))
    for axes, triad in zip(panels[:, 0], triads, strict=True):
        shown = parameters_of(comparison, triad)
        _differences(axes, rows, shown)
        _parameter_axis(axes, [parameter.title for parameter in shown])
        axes.set(title=triad, ylabel=f"less {rows[0].method}, in its 1σ")
    _legend(figure)
    return figure


def _differences(axes: Axes, rows: Sequence[Row], shown: Sequence[ComparedParameter]) -> None:
    """Parameters of every method less those of the first, with error bars, in its 1σ."""
    values = np.array([parameter.values for parameter in shown])
    sd = np.array([parameter.sd for parameter in shown])
    unit = np.where(sd[:, 0] > 0, sd[:, 0], np.nan)
    difference = np.where(np.isnan(sd), np.nan, (values - values[:, :1]) / unit[:, None])
    for index, (row, shift) in enumerate(zip(rows, _abreast(rows, 0.12), strict=True)):
        colour, marker = LOOKS[row.method]
        look: dict[str, Any] = {"color": colour, "ms": 3.4, "elinewidth": 0.8, "label": row.method}
        where = np.arange(len(shown)) + shift
        axes.errorbar(where, difference[:, index], sd[:, index] / unit, fmt=marker, **look)
    low, high = axes.get_ylim()
    if max(-low, high) > 20:
        axes.set_yscale("symlog", linthresh=5)
    axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)


def _parameter_axis(axes: Axes, titles: Sequence[str]) -> None:
    """A parameter in each column, with lines between them; many have upright titles."""
    turned: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    upright: dict[str, Any] = {"rotation": 90, "ha": "center", "rotation_mode": "default"}
    place = upright if len(titles) > 18 else turned
    axes.set_xticks(range(len(titles)), titles, fontsize=6.5, **place)
    axes.set_xlim(-0.6, len(titles) - 0.4)
    axes.grid(axis="x", visible=False)
    for edge in np.arange(len(titles) - 1) + 0.5:
        axes.axvline(edge, color="#e5e7eb", lw=0.5)


@plots.style()
def draw_course(comparison: Comparison) -> Figure:
    """The swarm's cost over its iterations: its excess over the least, as a share of it."""
    row = next(row for row in comparison.rows if row.course)
    figure, [[axes]] = plots.new_figure("Excess of the swarm's cost over its iterations", 1.7)
    colour = LOOKS["swarm"][0]
    for (name, excess), line in zip(row.course.items(), ("-", "--"), strict=False):
        shown = np.where(excess > 1e-13, excess, np.nan)
        axes.plot(np.arange(1, len(excess) + 1), shown, line, color=colour, label=name)
    axes.set(yscale="log", xlim=(0, len(excess)), xlabel="iteration")
    axes.set_ylabel("cost ÷ least cost − 1")
    axes.yaxis.set_major_formatter(lambda value, _: f"10{superscript(round(np.log10(value)))}")
    axes.yaxis.set_minor_formatter(lambda value, _: "")
    axes.legend(loc="upper right")
    return figure


TABLES = (refusals, heading, errors, measures, effort, notes, gauge, parameters_of)
FIGURES = (draw_errors, draw_stations, draw_parameters, draw_course)
"""What the template calls."""
