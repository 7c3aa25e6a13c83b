"""Figures of the comparison of methods, as SVG to be put into HTML, in the style of the report.

Every method has a colour and a marker of its own, the same in all figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app.pages import plots
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.comparison.common_gauge import SCALE
from mwdcal.comparison.compare import Comparison, Row, able
from mwdcal.estimation.uncertainty import ROTATIONS
from mwdcal.geometry.vectors import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#4b5563")
MARKERS = ("o", "s", "^", "x", "D", "v")
LOOKS = dict(zip(EVIDENCE, zip(COLOURS, MARKERS, strict=True), strict=True))
MOST_STATIONS = 240
"""A longer run shows the largest error of each of so many equal parts of it."""
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def figures(found: Comparison) -> dict[str, str]:
    """All figures that the run gives anything for."""
    made = {"errors": errors(found), "stations": stations(found)}
    made["parameters"] = parameters(found)
    if any(row.course for row in found.rows):
        made["course"] = course(found)
    return made


@dataclass(frozen=True)
class Place:
    """One parameter of one triad: where a row has it, and how it is called."""

    triad: str
    title: str
    unit: str
    key: str
    at: tuple[int, ...]

    def of(self, row: Row) -> tuple[float, float]:
        """A method's value and standard uncertainty, NaN where it is undetermined."""
        source = row.parameters if self.key in ("SF", "B", "m") else row.taken_out
        item = source[self.triad]
        return float(item.values[self.key][self.at]), float(item.uncertainty[self.key][self.at])


def places(found: Comparison, triad: str) -> list[Place]:
    """The parameters of a triad: its factors, then what was taken out of them."""
    strength = "g" if triad == "accelerometer" else "nT" if "field" in found.units else ""
    units = {"SF": f"raw/{strength}" if strength else "raw", "B": strength, "m": ""}
    result = []
    for key, value in able(found.rows)[0].parameters[triad].values.items():
        for i, j in np.ndindex(value.shape):
            if key == "m" and i == j:
                continue
            power = 0 if key == "m" else j
            course = f"τ{str(power).translate(SUPERSCRIPT) if power > 1 else ''}"
            title = f"{key} {'xyz'[i]}{'xyz'[j] if key == 'm' else ''}"
            per = course.replace("τ", "/°C") if power else ""
            title = f"{title}·{course}" if power else title
            result.append(Place(triad, title, f"{units[key]}{per}", key, (i, j)))
    for name in found.gauge.get(triad, []):
        key, at, unit = (
            (name, 0, "") if name == SCALE else ("rotation_deg", ROTATIONS.index(name), "°")
        )
        result.append(Place(triad, name, unit, key, (at,)))
    return result


def errors(found: Comparison) -> str:
    """Left-out error of every observable and method over the best of any; hollow: in sample."""
    rows, names = able(found.rows), list(found.units)
    with plots._style():
        figure = plots._figure(0.75 + 0.36 * len(names))
        axes = figure.subplots()
        for index, row in enumerate(rows):
            colour, marker = LOOKS[row.method]
            height = np.arange(len(names)) + 0.11 * (index - (len(rows) - 1) / 2)
            inside, left_out = (
                [kind[n] / _best(rows, n) for n in names] for kind in (row.in_sample, row.held_out)
            )
            edge: dict[str, Any] = {"color": colour, "ls": "none", "marker": marker}
            axes.plot(inside, height, mfc="white", mew=0.7, ms=3.2, alpha=0.8, **edge)
            axes.plot(left_out, height, ms=4.6, label=row.method, **edge)
        _ratio_axis(axes)
        axes.set_xlabel("rms error ÷ least left-out error of any method")
        axes.set_yticks(range(len(names)), [plots.TITLES.get(n, n) for n in names])
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.grid(axis="y", visible=False)
        for edge_at in np.arange(len(names) - 1) + 0.5:
            axes.axhline(edge_at, color="#e5e7eb", lw=0.6)
        axes.axvline(1, color="#4b5563", lw=0.8)
        _legend(figure)
        return plots._svg(figure, "methods", "Left-out error of every method and observable")


def _best(rows: Sequence[Row], name: str) -> float:
    """The least left-out error of any method."""
    best = float(np.fmin.reduce([row.held_out[name] for row in rows]))
    return best if best > 0 else float("nan")


def _legend(figure: Any) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))


def _ratio_axis(axes: Axes) -> None:
    """A logarithmic axis of ratios, with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    steps = (1.0, 2.0, 5.0) if high / low > 8 else (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0)
    axes.xaxis.set_major_locator(LogLocator(subs=steps if high / low < 1e3 else (1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def stations(found: Comparison) -> str:
    """Left-out error of every station, an observable in each row and a method in each column."""
    rows = able(found.rows)
    names = [name for name in found.units if name in rows[0].station_errors]
    with plots._style():
        figure = plots._figure(0.5 + 0.85 * len(names))
        panels = figure.subplots(
            len(names), len(rows), sharex=True, sharey="row", squeeze=False,
            gridspec_kw={"hspace": 0.02, "wspace": 0.02},
        )  # fmt: skip
        for line, name in zip(panels, names, strict=True):
            unit = found.units[name].partition(" ")[0]
            line[0].set_ylabel(f"{plots.TITLES[name]}, {unit}", fontsize=6.5)
            for axes, row in zip(line, rows, strict=True):
                _station_stems(axes, row.station_errors[name], LOOKS[row.method][0])
        for axes, row in zip(panels[0], rows, strict=True):
            axes.set_title(row.method, fontsize=7, color=LOOKS[row.method][0])
        for axes in panels[-1]:
            axes.set_xlabel("station, in order", fontsize=6.5)
        return plots._svg(figure, "stations", "Left-out error of every station by method")


def _station_stems(axes: Axes, values: Array, colour: str) -> None:
    where, heights = _largest(values)
    gap = np.full(len(where), np.nan)
    axes.plot(
        np.repeat(where, 3), np.stack([0 * heights, heights, gap], -1).ravel(),
        color=colour, lw=0.8 if len(where) < 80 else 0.5,
    )  # fmt: skip
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


def parameters(found: Comparison) -> str:
    """Parameters with 1σ, less those of the first method, in units of its own 1σ."""
    rows = able(found.rows)
    triads = list(rows[0].parameters)
    with plots._style():
        figure = plots._figure(0.4 + 2.0 * len(triads))
        panels = figure.subplots(len(triads), 1, squeeze=False)[:, 0]
        for axes, triad in zip(panels, triads, strict=True):
            _differences(axes, rows, places(found, triad))
            axes.set_title(triad)
            axes.set_ylabel(f"less {rows[0].method}, in its 1σ")
        _legend(figure)
        return plots._svg(figure, "parameters", "Parameters of every method with 1σ")


def _differences(axes: Axes, rows: Sequence[Row], shown: Sequence[Place]) -> None:
    first = np.array([place.of(rows[0]) for place in shown])
    unit = np.where(first[:, 1] > 0, first[:, 1], np.nan)
    for index, row in enumerate(rows):
        colour, marker = LOOKS[row.method]
        value, sd = np.array([place.of(row) for place in shown]).transpose()
        where = np.arange(len(shown)) + 0.12 * (index - (len(rows) - 1) / 2)
        value = np.where(np.isnan(sd), np.nan, (value - first[:, 0]) / unit)
        axes.errorbar(
            where, value, sd / unit, color=colour, marker=marker, ms=3.4, ls="none",
            elinewidth=0.8, label=row.method,
        )  # fmt: skip
    low, high = axes.get_ylim()
    if max(-low, high) > 20:
        axes.set_yscale("symlog", linthresh=5)
    axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)
    steep = len(shown) > 18
    axes.set_xticks(
        range(len(shown)), [place.title for place in shown],
        rotation=90 if steep else 40, ha="center" if steep else "right",
        rotation_mode="default" if steep else "anchor", fontsize=6.5,
    )  # fmt: skip
    axes.set_xlim(-0.6, len(shown) - 0.4)
    axes.grid(axis="x", visible=False)
    for edge in np.arange(len(shown) - 1) + 0.5:
        axes.axvline(edge, color="#e5e7eb", lw=0.5)


def course(found: Comparison) -> str:
    """The swarm's cost over its iterations: its excess over the least, as a share of it."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    row = next(row for row in found.rows if row.course)
    with plots._style():
        figure = plots._figure(1.7)
        axes = figure.subplots()
        for (name, excess), line in zip(row.course.items(), ("-", "--"), strict=False):
            shown = np.where(excess > 1e-13, excess, np.nan)
            axes.plot(
                np.arange(1, len(excess) + 1), shown, line, color=LOOKS["swarm"][0], label=name
            )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlim(0, len(excess))
        axes.set_xlabel("iteration")
        axes.set_ylabel("cost ÷ least cost − 1")
        axes.legend(loc="upper right")
        return plots._svg(figure, "course", "Excess of the swarm's cost over its iterations")


def _power(value: float) -> str:
    """A power of ten, to be read on an axis."""
    return f"10{str(round(np.log10(value))).translate(SUPERSCRIPT)}"
