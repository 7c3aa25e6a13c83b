"""Figures of a calibration, and the style of all figures: the same input, the same figure.

A figure is a Matplotlib figure whose label says what it shows. Colours are told apart by
colour-blind readers, and never carry a meaning alone: every series has a marker of its own and
every contour its number.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mwdcal.calibration.prediction import AccuracyMap, accuracy_map, angles
from mwdcal.calibration.record import Calibration, ErrorRow, OrderScore, StationRow
from mwdcal.calibration.residuals import RESHOOT
from mwdcal.errors import InputError
from mwdcal.geometry.observables import TITLES
from mwdcal.geometry.vectors import AnyArray, Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.contour import ContourSet
    from matplotlib.figure import Figure

BEFORE, AFTER, MARKED, BAND = "#6b7280", "#0072b2", "#d55e00", "#dbe7f0"
AXES = {"x": AFTER, "y": MARKED, "z": "#111827"}
"""Colours of the channels of a triad."""
LINES: dict[str, Any] = {"x": "-", "y": (0, (5, 1.5)), "z": (0, (1.5, 1.2))}
"""Line styles of the channels of a triad."""
POINT_NAMES = "points"
"""Start of the gid of a line whose label names its points, below a first `_`, one on each line."""
WIDTH = 7.1
"""Of a figure, inches."""
NOTE: dict[str, Any] = {"textcoords": "offset points", "color": "#9a3d00", "fontsize": 7}
"""Look of a remark at something marked."""
STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#4b5563",
    "axes.grid": True,
    "axes.labelsize": 7.5,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 8,
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.5,
    "hatch.color": "#d1d5db",
    "hatch.linewidth": 0.5,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "lines.linewidth": 0.8,
    "lines.markersize": 3.6,
    "svg.hashsalt": "mwdcal",
    "text.parse_math": False,
    "xtick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.labelsize": 7,
    "ytick.major.width": 0.6,
}


@contextmanager
def style() -> Iterator[None]:
    """Our style on matplotlib's own defaults, whatever the user's settings are; for a block or a function."""
    import matplotlib as mpl

    with mpl.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


def new_figure(
    label: str,
    height: float,
    rows: int = 1,
    columns: int = 1,
    layout: Literal["constrained"] | None = "constrained",
    **grid: Any,
) -> tuple[Figure, Any]:
    """A figure as wide as a page, and its empty panels (rows, columns).

    `label` is what the figure shows, `height` in inches, `grid` as of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout=layout)
    figure.set_label(label)
    return figure, figure.subplots(rows, columns, squeeze=False, **grid)


def plain_numbers(axis: Axis, *steps: float) -> None:
    """Plain numbers along a logarithmic axis, at these steps of each decade."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def quantity(value: float, unit: str) -> str:
    """A number with its unit: 0.52°, 8.4 mg."""
    return f"{value:.3g}{'' if unit == '°' else ' '}{unit}"


def _by_order(axes: Axes, rows: Sequence[OrderScore]) -> None:
    """One triad's errors over the order, on a logarithmic scale, with the noise below them."""
    where = [row.order for row in rows]
    inside, ends, noise = (
        np.array([getattr(row, name) for row in rows], float)
        for name in ("error_inside", "error_ends", "noise")
    )
    axes.plot(where, ends, "^--", color=MARKED, label="at the ends (extrapolation)")
    axes.plot(where, inside, "s-", color=AFTER, label="inside (interpolation)")
    axes.plot(where, noise, ":", color=BEFORE, lw=1.2, label="noise of a reading")
    axes.set_yscale("log")
    wide = np.nanmax([inside, ends, noise]) > 30 * np.nanmin([inside, ends, noise])
    plain_numbers(axes.yaxis, *((1.0,) if wide else (1.0, 2.0, 5.0)))
    axes.set_xticks(where, [f"{row.order}" + "\nchosen" * row.chosen for row in rows])
    axes.margins(x=0.08, y=0.12)
    unit = rows[0].unit.partition(" ")[0]
    axes.set(title=rows[0].triad, xlabel="order", ylabel=f"error, {unit}")


def stems(axes: Axes, where: AnyArray, heights: Array, **look: Any) -> None:
    """Lines from zero to each height."""
    ends = np.stack([np.zeros_like(heights), heights, np.full_like(heights, np.nan)], -1)
    axes.plot(np.repeat(where, 3), ends.ravel(), **look)


def named_points(
    axes: Axes, where: AnyArray, heights: Array, names: Iterable[str], *marker: str, **look: Any
) -> None:
    """Markers, each with a name that a page shows for a closer look."""
    drawn = np.isfinite(heights)
    shown = (" ".join(name.split()) for name, here in zip(names, drawn, strict=True) if here)
    gid = f"{POINT_NAMES}-{sum(len(each.lines) for each in axes.figure.axes)}"
    label = "\n".join(["_", *shown])
    axes.plot(where[drawn], heights[drawn], *marker, gid=gid, label=label, **look)


def _station_stems(
    axes: Axes,
    rows: Sequence[StationRow],
    values: Sequence[float],
    unit: str,
    colour: str,
    marker: str,
) -> None:
    """Stems over the stations; the ones to re-shoot have a triangle and their label."""
    where, heights = np.arange(len(rows)), np.asarray(values, float)
    marked = np.array([row.reshoot for row in rows])
    small = 3.6 if len(rows) <= 80 else 2.2
    stems(axes, where, heights, color=colour, lw=0.7, alpha=0.6)
    names = np.array(
        [
            f"station {row.station}: {quantity(value, unit).replace('-', '−')}"
            for row, value in zip(rows, heights.tolist(), strict=True)
        ],
        object,
    )
    plain: dict[str, Any] = {"color": colour, "ms": small, "mfc": "white", "mew": 0.9}
    named_points(axes, where[~marked], heights[~marked], names[~marked], marker, **plain)
    named_points(axes, where[marked], heights[marked], names[marked], "^", color=MARKED, ms=6)
    for index in np.flatnonzero(marked & ~np.isnan(heights)).tolist():
        _name_station(axes, index, float(heights[index]), rows[index].station)
    axes.grid(axis="x", visible=False)
    axes.margins(x=0.02, y=0.16)
    _station_axis(axes, [row.station for row in rows])


def _name_station(axes: Axes, where: float, height: float, label: str) -> None:
    """A station's label at the end of its stem."""
    from matplotlib.patheffects import withStroke

    offset, align = ((5, -3), "top") if height < 0 else ((5, 3), "bottom")
    halo = [withStroke(linewidth=2, foreground="white")]
    axes.annotate(f"station {label}", (where, height), offset, va=align, path_effects=halo, **NOTE)


def _station_axis(axes: Axes, labels: Sequence[str]) -> None:
    """Station labels below: as many as are legible."""
    place = axes.get_subplotspec()
    room = 96 if place is None or place.get_gridspec().ncols == 1 else 40
    longest = min(max(map(len, labels)), 12)
    step = max(1, -(-len(labels) * (longest + 1) // room))
    axes.set_xticks(range(0, len(labels), step), [label[:12] for label in labels[::step]])
    axes.set_xlabel("station")


def _sphere(axes: Axes, chart: AccuracyMap, values: Array, name: str) -> None:
    axes.set_title(f"{name}, 1σ in °")
    axes.set_xlabel("azimuth, °")
    axes.set(xlim=(0, 360), ylim=(0, 180), xticks=range(0, 361, 90), yticks=range(0, 181, 30))
    axes.grid(visible=False)
    if np.isnan(values).all():
        axes.set_facecolor("#f3f4f6")
        text = "undetermined:\nno uncertainty\ncan be quoted"
        axes.patch.set_hatch("////")
        box = {"facecolor": "white", "edgecolor": "#9ca3af", "boxstyle": "round,pad=0.5"}
        axes.text(180, 90, text, ha="center", va="center", fontsize=8, bbox=box)
        return
    _contours(axes, np.degrees(chart.azimuth), np.degrees(chart.inclination), values)


def _contours(axes: Axes, x: Array, y: Array, values: Array) -> None:
    import matplotlib as mpl
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patheffects import withStroke

    levels = contour_levels(values)
    # a grey print keeps the order
    shades = mpl.colormaps["Blues"](np.linspace(0.06, 0.72, len(levels) - 1))
    drawn = np.ma.masked_invalid(values)
    norm = BoundaryNorm(levels, len(levels) - 1)
    axes.set_facecolor("#f3f4f6")
    filled = axes.contourf(x, y, drawn, levels=levels, cmap=ListedColormap(shades), norm=norm)
    lines = axes.contour(x, y, drawn, levels=levels[1:-1], colors="#374151", linewidths=0.4)
    for text in axes.clabel(lines, fmt=_short, fontsize=6, colors="#111827"):
        text.set_path_effects([withStroke(linewidth=1.6, foreground="white")])
    _colour_bar(axes, filled, levels)


def _colour_bar(axes: Axes, filled: ContourSet, levels: Array) -> None:
    """The bar below the contours, with up to six of their numbers."""
    bar = axes.figure.colorbar(
        filled, ax=axes, orientation="horizontal", aspect=22, pad=0.03, spacing="uniform"
    )
    every = -(-len(levels) // 6)
    bar.set_ticks(levels[::every].tolist(), labels=[_short(v) for v in levels[::every]])
    bar.ax.tick_params(labelsize=6, length=2)
    bar.set_label("1σ, °", fontsize=7)


def contour_levels(values: Array) -> Array:
    """Round levels that enclose the values: 1-2-5 over a wide range, equal steps over a narrow."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    low, high = max(low, 1e-9), max(high, 1.02e-9)
    if high / low > 4:
        decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        parts = [1, 2, 5] if high / low > 12 else [1, 1.5, 2, 3, 5, 7]
        steps = np.outer(10.0**decades, parts).ravel()
    else:
        rough = max(high - low, 0.02 * high) / 6
        power = 10.0 ** np.floor(np.log10(rough))
        width = power * min(n for n in (1, 2, 5, 10) if n * power >= rough)
        steps = np.arange(np.floor(low / width), np.ceil(high / width) + 1) * width
        steps = np.append(steps, steps[-1] + width)
    first = max(int(np.searchsorted(steps, low, "right")) - 1, 0)
    last = int(np.searchsorted(steps, high, "left"))
    return np.asarray(steps[first : max(last, first + 2) + 1])


def _short(value: float) -> str:
    return f"{value:.3g}" if value >= 1e-4 else f"{value:.1e}"


def reshoot_limit(calibration: Calibration) -> float:
    """The deviation above which a station is marked, in standard deviations."""
    from scipy.special import ndtri

    return float(-ndtri(RESHOOT / max(len(calibration.station_rows), 1) / 2))


@dataclass(frozen=True)
class Plots:
    """Figures of one calibration, as `calibration.plot`: Matplotlib figures, in the style of the report.

    Raises:
        InputError: the calibration has nothing to draw of that kind.
    """

    calibration: Calibration

    @style()
    def accuracy(self) -> Figure:
        """1σ of each angle over inclination and azimuth, degrees, root mean square over toolface."""
        chart, names = accuracy_map(self.calibration), angles(self.calibration)
        label = "Predicted 1σ over inclination and azimuth"
        figure, [panels] = new_figure(label, 2.75, columns=len(names), sharey=True)
        for axes, name in zip(panels, names, strict=True):
            _sphere(axes, chart, np.degrees(chart.sd[name]), name)
        panels[0].set_ylabel("inclination, °")
        return figure

    @style()
    def errors(self, observable: str) -> Figure:
        """Errors of an observable at each station, before and after, each on its own scale."""
        row, stations = self._errors(observable), self.calibration.station_rows
        unit = row.unit.partition(" ")[0]
        label = f"{TITLES[observable]}, {unit}"
        shown = f"Error of {label}, per station, before and after"
        place = {"left": 0.095, "right": 0.995, "bottom": 0.27, "top": 0.87, "wspace": 0.24}
        figure, [panels] = new_figure(shown, 1.5, columns=2, layout=None, gridspec_kw=place)
        series = (("errors_before", BEFORE, "o"), ("errors", AFTER, "s"))
        for axes, (errors, *look) in zip(panels, series, strict=True):
            values = [getattr(station, errors).get(observable, np.nan) for station in stations]
            _station_stems(axes, stations, values, unit, *look)
            axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)
            axes.set_ylabel(label)
        if row.expected:
            panels[1].axhspan(-row.expected, row.expected, color=BAND, lw=0, zorder=0.5)
        band = "  (band: ±1σ expected)" if row.expected else ""
        panels[0].set_title(f"before: rms {quantity(row.before, unit)}")
        panels[1].set_title(f"after: rms {quantity(row.after, unit)}{band}")
        return figure

    def _errors(self, observable: str) -> ErrorRow:
        """The row of the table of errors; refuses an observable without one."""
        rows = {row.observable: row for row in self.calibration.errors}
        if observable not in rows:
            raise InputError(
                f"`observable` must be one with references in the run ({', '.join(rows)}); got "
                f"{observable!r}. Name another."
            )
        return rows[observable]

    @style()
    def deviations(self) -> Figure:
        """Misfit of each station in standard deviations, and the limit for measuring it again."""
        rows, limit = self.calibration.station_rows, reshoot_limit(self.calibration)
        figure, [[axes]] = new_figure("Misfit of each station in standard deviations", 1.7)
        misfits = [row.deviation for row in rows]
        _station_stems(axes, rows, misfits, "σ", AFTER, "s")
        axes.axhline(limit, color=MARKED, lw=1, ls=(0, (5, 3)))
        axes.set(ylabel="misfit of the station, σ", ylim=(0, max(limit, *misfits) * 1.2))
        place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
        axes.annotate(f"re-shoot above {limit:.1f}σ", (1, limit), (-2, 3), **place, **NOTE)
        return figure

    @style()
    def orders(self) -> Figure:
        """Error at temperatures left out of the fit by order, inside and at the ends, per triad."""
        scores = self.calibration.orders
        if not any(row.ends is not None for row in scores):
            raise InputError(
                "no temperature orders were compared in this calibration: the run needs stations at "
                "three temperatures or more."
            )
        triads = list(dict.fromkeys(row.triad for row in scores))
        label = "Error at left-out temperatures by temperature order"
        figure, [panels] = new_figure(label, 2.0, columns=len(triads))
        for axes, triad in zip(panels, triads, strict=True):
            _by_order(axes, [row for row in scores if row.triad == triad])
        panels[0].legend(loc="upper right")
        return figure


Calibration.plot = property(Plots)
