"""Strip plots of a fleet: a mark for each tool, or for each of some equal groups of very many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.pages.fleet_columns import FAR, FleetParameter, distance
from mwdcal.screens.numbers import number, unit
from mwdcal.screens.text import one_line, superscript
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS = 2500
"""Most tools of which each has a mark of its own in a strip."""
GROUPS = 1000
"""Marks that stand for the others of more tools."""
ENDS = 10
"""Marks of single tools at either end then."""
FEW = 30
"""Most tools whose marks have the height of their strip."""
MEDIAN_OF = 3
"""Fewest tools whose median is drawn."""
GOLDEN = 0.6180339887498949
"""Multiples of it, modulo 1, fill a strip evenly."""
ABREAST = 3
"""Most panels in a row."""
TICKS = 12
"""Numbers along the axes of a row of panels: more would run into each other."""
LOGARITHMIC = 8.0
"""Largest over smallest value from which an axis of positive values is logarithmic."""
CUT_SERIAL = 16
"""Characters of a serial that a figure shows."""
ONE_AXIS_OR_TWO = ("gain", "square", "cube")
"""Parameters of one axis or of two: a panel for each."""
BESIDE = 3.0
"""Times the margin of an axis at an end where tools are left out, which are counted there."""
HALF = 0.36
"""Half the height of a strip, of which the distance to the next is 1."""


@dataclass(frozen=True)
class Strips:
    """A panel: title, unit or name of its axis, and values by the name of a strip.

    With a `unit` the largest value of each strip is named. `lines` are values to compare with, by what they
    mean. Where `positive`, the axis may be logarithmic, and then nothing is left out.
    """

    title: str
    axis: str
    series: Mapping[str, Array]
    unit: str = ""
    lines: Mapping[str, float] | None = None
    positive: bool = False


@plots.style()
def draw_quality(panels: Sequence[Strips], serials: AnyArray, doubtful: Bools) -> Figure:
    """Accuracy, and residuals over noise or noise, one panel below the other; doubtful tools are marked."""
    heights = [len(panel.series) + 1.5 + 0.4 * bool(panel.lines) for panel in panels]
    label = "Accuracy and residuals of the fleet, one mark per tool"
    ratios = {"height_ratios": heights}
    figure, grid = plots.new_figure(label, 0.42 * sum(heights), len(panels), gridspec_kw=ratios)
    for axes, panel in zip(grid[:, 0], panels, strict=True):
        _draw(axes, panel, doubtful)
        if panel.unit:
            _name_largest(axes, panel, serials)
        if axes.get_xscale() == "linear":
            axes.locator_params(axis="x", nbins=TICKS)
    return figure


@plots.style()
def draw_parameters(parameters: Sequence[FleetParameter]) -> Figure:
    """Every steady parameter of every tool: a row of panels for each triad."""
    lines = _lines(parameters)
    columns, label = max(map(len, lines)), "Parameters of the fleet, one mark per tool"
    heights = [max(len(members) for _, members in line) + 2.6 for line in lines]
    ratios = {"height_ratios": heights}
    figure, grid = plots.new_figure(
        label, 0.21 * sum(heights), len(lines), columns, gridspec_kw=ratios
    )
    for row, line in zip(grid, lines, strict=True):
        for axes in row[len(line) :]:
            axes.set_axis_off()
        for axes, (title, members) in zip(row, line, strict=False):
            series = {m.title.partition(" ")[2]: m.values for m in members}
            axis, factor = _multiple(members[0].unit or "share of nominal", series)
            scaled = {name: values * factor for name, values in series.items()}
            _draw(axes, Strips(title, axis, scaled))
            axes.locator_params(axis="x", nbins=TICKS // columns)
    return figure


def _multiple(one: str, series: Mapping[str, Array]) -> tuple[str, float]:
    """A multiple of `one` unit in which values are no tiny fractions, and the factor to it.

    >>> _multiple("1/nT", {"xx": np.array([2.1e-5])})
    ('10⁻⁵ × 1/nT', 100000.0)
    """
    largest = max(float(np.nanmedian(np.abs(values))) for values in series.values())
    if not 0 < largest < 1e-3:
        return one, 1.0
    power = int(np.floor(np.log10(largest)))
    return f"10{superscript(power)} × {one}", 10.0**-power


def _lines(parameters: Sequence[FleetParameter]) -> list[list[tuple[str, list[FleetParameter]]]]:
    """Panels in rows, each row of one triad: title and parameters of a panel."""
    triads: dict[str, dict[str, list[FleetParameter]]] = {}
    for each in parameters:
        kind, _, axes = each.title.partition(" ")
        if kind in ONE_AXIS_OR_TWO:
            kind = f"{'own' if len(set(axes)) == 1 else 'cross'}-axis {kind}"
        title = f"{each.kind or each.triad}: {kind}"
        triads.setdefault(each.sensors, {}).setdefault(title, []).append(each)
    return [
        list(panels.items())[first : first + ABREAST]
        for panels in triads.values()
        for first in range(0, len(panels), ABREAST)
    ]


def _draw(axes: Axes, panel: Strips, doubtful: Bools | None = None) -> None:
    """The strips of a panel, from top to bottom."""
    names, series = list(panel.series), list(panel.series.values())
    odd = np.zeros(len(series[0]), bool) if doubtful is None else doubtful
    axes.set_title(panel.title, pad=14 if panel.lines else 6)
    axes.set(xlabel=panel.axis, ylim=(len(names) - 0.4, -0.6))
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    usable = np.concatenate(series)
    usable = usable[np.isfinite(usable)]
    lines = panel.lines or {}
    if not usable.size:
        axes.set_xticks([])
        axes.text(0.5, 0.5, "undetermined", ha="center", va="center", transform=axes.transAxes)
        return
    low, high = _limits(axes, panel, np.concatenate([usable, [*lines.values()]]))
    for place, values in enumerate(series):
        _strip(axes, place, np.where(np.isfinite(values), values, np.nan), odd)
        _count_beyond(axes, place, int(np.sum(values < low)), int(np.sum(values > high)))
    for words, value in lines.items():
        axes.axvline(value, color=plots.MARKED, lw=0.9, ls=(0, (5, 3)), zorder=1.5)
        up: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "va": "bottom", "ha": "center"}
        axes.annotate(words, (value, 1), (0, 1), **up, **plots.NOTE)


def _limits(axes: Axes, panel: Strips, usable: Array) -> tuple[float, float]:
    """Ends of the axis: of `positive` values all, else without what lies far from the fleet's median."""
    low, high = float(usable.min()), float(usable.max())
    if panel.positive and low > 0 and high / low > LOGARITHMIC:
        low, high = low / 1.15, high * 1.15
        axes.set_xscale("log")
        plots.plain_numbers(axes.xaxis, *((1.0, 2.0, 5.0) if high / low < 1e3 else (1.0,)))
    elif panel.positive:
        low, high = 0.0, high * 1.05
    else:
        near = [values[distance(values) <= FAR] for values in panel.series.values()]
        kept = np.concatenate(near)
        first, last = float(np.nanmin(kept)), float(np.nanmax(kept))
        margin = 0.04 * (last - first) or max(abs(last), 1e-9) * 1e-3
        low = first - margin * (BESIDE if low < first else 1)
        high = last + margin * (BESIDE if high > last else 1)
    axes.set_xlim(low, high)
    return low, high


def marked(values: Array) -> Ints:
    """Tools that have a mark in a strip, in order of their values; of very many evenly some, and the ends."""
    order = np.argsort(values, kind="stable")[: int(np.sum(~np.isnan(values)))]
    if len(order) <= MARKS:
        return order
    evenly = np.linspace(0, len(order) - 1, GROUPS).round().astype(int)
    ends = np.arange(ENDS)
    return np.asarray(order[np.unique([*ends, *evenly, *(len(order) - 1 - ends)])])


def _strip(axes: Axes, place: int, values: Array, doubtful: Bools) -> None:
    """The marks of a strip: short lines, taller ones of doubtful tools, and a long one at the median."""
    tools = marked(values)
    if not tools.size:
        return
    few = len(tools) <= FEW
    height = HALF if few else float(np.clip(1.0 / len(tools) ** 0.5, 0.03, 0.07))
    across = (0.5 + GOLDEN * np.arange(len(tools))) % 1 - 0.5
    middle = np.asarray(place + (0.0 if few else 2 * (HALF - height)) * across, float)
    odd, tall = doubtful[tools], min(2.6 * height, HALF + 0.08)
    _ticks(axes, values[tools][~odd], middle[~odd], height, plots.AFTER, alpha=0.75)
    _ticks(axes, values[tools][odd], middle[odd], tall, plots.MARKED, lw=1.4 if few else 1.0)
    if len(tools) >= MEDIAN_OF:
        median = np.array([np.nanmedian(values)])
        _ticks(axes, median, np.array([place]), 0.48, plots.AXES["z"], lw=1.1)


def _ticks(axes: Axes, x: Array, y: Array, half: float, colour: str, **look: Any) -> None:
    """Short vertical lines as one path, none of which is left out."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    ends = np.stack([np.stack([x, y - half], -1), np.stack([x, y + half], -1)], 1)
    codes = np.tile([Path.MOVETO, Path.LINETO], len(x))
    path = Path(ends.reshape(-1, 2), codes)
    path.should_simplify = False
    if len(x):
        drawn = {"lw": 0.9, "zorder": 2.5, **look}
        axes.add_artist(PathPatch(path, facecolor="none", edgecolor=colour, **drawn))


def _count_beyond(axes: Axes, place: int, below: int, above: int) -> None:
    """How many tools of a strip lie beyond the ends of its axis."""
    at = {"xycoords": axes.get_yaxis_transform(), "va": "center", **plots.NOTE}
    for count, x, align, words in ((below, 0, "left", "◂ {}"), (above, 1, "right", "{} ▸")):
        if count:
            offset = (2 if x == 0 else -1, 0)
            axes.annotate(words.format(count), (x, place), offset, ha=align, **_halo(), **at)


def _name_largest(axes: Axes, panel: Strips, serials: AnyArray) -> None:
    """The value and the serial of the largest of each strip beside it, if there are several tools."""
    beside = {"xycoords": axes.get_yaxis_transform(), "ha": "left", "va": "center", **plots.NOTE}
    for place, values in enumerate(panel.series.values()):
        if np.sum(np.isfinite(values)) < 2:
            continue
        largest = int(np.nanargmax(values))
        name = one_line(serials[largest])
        name = name if len(name) <= CUT_SERIAL else f"{name[: CUT_SERIAL - 1]}…"
        words = f"worst {number(float(values[largest]))}{unit(panel.unit)}\n{name}"
        axes.annotate(words, (1.0, place), (5, 0), **beside)


def _halo() -> dict[str, Any]:
    """A white edge around text on marks."""
    from matplotlib.patheffects import withStroke

    return {"path_effects": [withStroke(linewidth=2.2, foreground="white")]}
