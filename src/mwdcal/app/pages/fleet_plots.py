"""Figures of a fleet's summary page: distributions of parameters, residuals and accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.geometry.vectors import Array
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#4b5563")
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 1)))
BINS = (12, 40)
"""Fewest and most bins: as many as half the root of the number of tools."""
ABREAST = 3
"""Most panels in a row."""
TICKS = 12
"""Numbers along the axes of a row of panels: more would run into each other."""
FAR = 6.0
"""Robust standard deviations from the fleet's median beyond which a tool is an outlier."""
FEWEST = 20
"""Sound tools without which there is no fleet to be an outlier of."""
SPREAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""
KINDS = {
    "gain": ("own-axis gain", "cross-axis gain"),
    "scale": ("scale", ""),
    "misalignment": ("", "misalignment"),
    "offset": ("offset", ""),
    "bias": ("bias", ""),
    "square": ("own-axis square", ""),
    "cube": ("own-axis cube", ""),
}
"""Titles of panels: of one axis, and of two."""
Panel = tuple[str, str, Mapping[str, Array]]
"""Title, name of the axis, and values by name."""


def distance(values: Array) -> Array:
    """Robust standard deviations (n,) from the median; 0 for few values, or where most are equal."""
    if np.sum(~np.isnan(values)) < FEWEST:
        return np.zeros(len(values))
    away = np.abs(values - np.nanmedian(values))
    spread = SPREAD * np.nanmedian(away)
    return away / spread if spread > 0 else np.zeros(len(values))


@plots.styled
def parameters(parameters: Sequence[Any]) -> Figure:
    """Number of tools by value of each steady parameter: a row of panels for each triad."""
    lines = _lines(parameters)
    figure = plots.new_figure("Distributions of the fleet's parameters", 2.1 * len(lines))
    columns = max(len(line) for line in lines)
    grid = figure.subplots(len(lines), columns, squeeze=False)
    for row, line in zip(grid, lines, strict=True):
        row[0].set_ylabel("tools")
        for axes in row[len(line) :]:
            axes.set_axis_off()
        for axes, (title, members) in zip(row, line, strict=False):
            axes.set(title=title, xlabel=members[0].unit or "share of nominal")
            _steps(axes, {m.title.partition(" ")[2]: m.values for m in members})
            axes.locator_params(axis="x", nbins=TICKS // columns)
    return figure


def _lines(parameters: Sequence[Any]) -> list[list[tuple[str, list[Any]]]]:
    """Panels in rows, each row of one triad: title and parameters of a panel."""
    triads: dict[str, dict[str, list[Any]]] = {}
    for each in parameters:
        kind, _, axes = each.title.partition(" ")
        triad = each.kind or each.triad
        title = f"{triad}: {KINDS[kind][len(set(axes)) > 1]}"
        triads.setdefault(triad, {}).setdefault(title, []).append(each)
    return [
        list(panels.items())[first : first + ABREAST]
        for panels in triads.values()
        for first in range(0, len(panels), ABREAST)
    ]


@plots.styled
def quality(panels: Sequence[Panel]) -> Figure:
    """Number of tools by residuals over noise or by noise, and by 1σ of each angle."""
    figure = plots.new_figure("Distributions of residuals and accuracy", 2.2)
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    row[0].set_ylabel("tools")
    for axes, (title, label, series) in zip(row, panels, strict=True):
        axes.set(title=title, xlabel=label)
        axes.locator_params(axis="x", nbins=TICKS // len(panels))
        _steps(axes, series, abreast=3 if len(panels) < 3 else 1)
    return figure


def _steps(axes: Axes, series: Mapping[str, Array], abreast: int = 3) -> None:
    """Step histograms over common bins, each with its own colour and dash; so many names in a line."""
    usable = {name: values[np.isfinite(values)] for name, values in series.items()}
    usable = {name: values for name, values in usable.items() if values.size}
    if not usable:
        axes.text(0.5, 0.5, "undetermined", ha="center", va="center", transform=axes.transAxes)
        return
    every = np.concatenate([values[distance(values) <= FAR] for values in usable.values()])
    low, high = every.min(), every.max()
    margin = 0.05 * (high - low) or max(abs(high), 1e-9) * 1e-3
    most = max(values.size for values in usable.values())
    edges = np.linspace(low - margin, high + margin, int(np.clip(most**0.5 / 2, *BINS)) + 1)
    for (name, values), colour, dash in zip(usable.items(), COLOURS, DASHES, strict=False):
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges, label=name, color=colour, ls=dash, lw=1.0)
    rows = -(-len(usable) // abreast)
    axes.legend(ncols=abreast, loc="upper left", handlelength=2.2, columnspacing=1.0)
    axes.set_ylim(bottom=0, top=axes.get_ylim()[1] * (1.1 + 0.15 * rows))
