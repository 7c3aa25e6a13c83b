"""Figures of a calibration, and the style of all figures: the same input, the same figure.

A figure is a Matplotlib figure whose label says what it shows. Colours are told apart by
colour-blind readers, and never carry a meaning alone: every series has a marker or a
line style of its own.

Figures of a verdict: what each limit judges, over toolface.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mwdcal.calibration.readings import TRIADS, soaks
from mwdcal.calibration.record import Calibration, ErrorRow, OrderScore, StationRow
from mwdcal.calibration.residuals import RESHOOT
from mwdcal.calibration.results import TYPICAL, accuracy_at, accuracy_curves, middle_temperature
from mwdcal.errors import InputError
from mwdcal.geometry.observables import TITLES
from mwdcal.geometry.vectors import AnyArray, Array, Ints, reference_vectors
from mwdcal.use.notation import ChannelCourse, channel_courses
from mwdcal.use.roll_test import basis
from mwdcal.use.verification import JudgedSet, Verdict, VerdictRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

BEFORE, AFTER, MARKED, BAND = "#6b7280", "#0072b2", "#d55e00", "#dbe7f0"
AXES = {"x": AFTER, "y": MARKED, "z": "#111827"}
"""Colours of the channels of a triad."""
LINES: dict[str, Any] = {"x": "-", "y": (0, (5, 1.5)), "z": (0, (1.5, 1.2))}
"""Line styles of the channels of a triad."""
SERIES: tuple[tuple[str, str, Any], ...] = (
    (AFTER, "o", "-"),
    ("#e69f00", "s", (0, (5, 1.5))),
    ("#009e73", "^", (0, (1.5, 1.2))),
    ("#cc79a7", "x", "-."),
    ("#7c3aed", "D", (0, (8, 2, 1, 2, 1, 2))),
    ("#4b5563", "v", (0, (3, 3))),
)
"""Colour, marker and line style of up to six series: methods, roll sets, plans."""
POINT_NAMES = "points"
"""Start of the gid of a line whose label names its points, below a first `_`, one on each line."""
ACCURACY_OF = {"of the calibration alone": False, "of one reading: calibration and noise": True}
"""The subject of an accuracy, and whether the noise of one reading is in it."""
TEMPERATURES = 41
"""Points of a curve over temperature."""
WIDTH = 7.1
"""Of a figure, inches."""
LONGEST_LABEL = 40
"""Characters of a name that a file gives; a longer one would leave its panel no room."""
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
    width: float = WIDTH,
    **grid: Any,
) -> tuple[Figure, Any]:
    """A figure as wide as a page, and its empty panels (rows, columns).

    `label` is what the figure shows, `height` and `width` in inches, `grid` as of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
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


def _accuracy_panel(axes: Axes, x: Array, curves: Mapping[str, Array]) -> None:
    """1σ of each angle, radians, in degrees on a logarithmic axis; undetermined ones in words."""
    for (name, sd), axis in zip(curves.items(), LINES, strict=False):
        if not np.isnan(sd).all():
            axes.plot(x, np.degrees(sd), color=AXES[axis], ls=LINES[axis], lw=1.3, label=name)
    axes.set_yscale("log")
    _undetermined(axes, [name for name, sd in curves.items() if np.isnan(sd).all()])


def _undetermined(axes: Axes, names: Sequence[str]) -> None:
    """Says what has no curve, and why."""
    if names:
        text = f"{', '.join(names)}: undetermined,\nno uncertainty can be quoted"
        box = {"facecolor": "white", "edgecolor": "#9ca3af", "boxstyle": "round,pad=0.4"}
        axes.text(0.5, 0.93, text, ha="center", va="top", transform=axes.transAxes, bbox=box)


def _accuracy_axes(figure: Figure, panels: Sequence[Axes]) -> Figure:
    """The parts that both panels share: plain numbers, and one legend of all curves."""
    low, high = panels[0].get_ylim()
    plain_numbers(panels[0].yaxis, *((1.0, 2.0, 5.0) if high / low < 300 else (1.0,)))
    panels[0].set_ylabel("1σ, °")
    handles, labels = panels[0].get_legend_handles_labels()
    place: dict[str, Any] = {"loc": "outside upper left", "ncols": max(len(labels), 1)}
    if labels:
        figure.legend(handles, labels, handlelength=3, **place)
    else:
        panels[0].yaxis.set_major_formatter(lambda value, _: "")
    return figure


def _channel_curves(axes: Axes, x: Array, values: Array, labels: Sequence[str]) -> None:
    """A curve (n,) for each channel, columns of `values`; undetermined ones in words."""
    series = dict(zip(labels, values.transpose(), strict=True))
    free = [label for label, column in series.items() if np.isnan(column).all()]
    for (label, column), axis in zip(series.items(), LINES, strict=True):
        axes.plot(x, column, color=AXES[axis], ls=LINES[axis], lw=1.2, label=label)
    axes.margins(x=0.02, y=0.08)
    _undetermined(axes, free)


def _errors_by_temperature(
    axes: Axes, row: ErrorRow, stations: Sequence[StationRow], soak: Ints
) -> None:
    """Errors of an observable at each station over temperature, and the mean of each soak."""
    warmth = np.array([station.temperature_c for station in stations])
    values = np.array([station.errors.get(row.observable, np.nan) for station in stations])
    marked = np.array([station.reshoot for station in stations])
    if row.expected:
        axes.axhspan(-row.expected, row.expected, color=BAND, lw=0, zorder=0.5)
    axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)
    axes.plot(warmth[~marked], values[~marked], "s", color=AFTER, mfc="none", ms=3, mew=0.7)
    axes.plot(warmth[marked], values[marked], "^", color=MARKED, ms=5)
    given = ~np.isnan(values)
    means = [
        [warmth[here].mean(), values[here].mean()]
        for here in (given & (soak == number) for number in np.unique(soak[given]))
    ]
    axes.plot(*np.transpose(means), "_-", color="#111827", lw=1, ms=14, mew=1.6)
    axes.margins(x=0.06, y=0.1)
    axes.set_ylabel(f"{TITLES[row.observable]}, {row.unit.partition(' ')[0]}")


def reshoot_limit(calibration: Calibration) -> float:
    """The deviation above which a station is marked, in standard deviations."""
    from scipy.special import ndtri

    return float(-ndtri(RESHOOT / max(len(calibration.station_rows), 1) / 2))


SPHERE_VIEW = np.array([[-0.5, 0.866, 0.0], [-0.296, -0.171, 0.94], [0.814, 0.47, 0.342]])
"""Right, up and towards the reader of a sphere, in the tool's frame: its axis is upright, and leans to the reader."""
SHOWN_DEPARTURE = 0.2
"""Length, in radii, to which the largest departures on a sphere are drawn at most."""


def _unit_vectors(
    calibration: Calibration, errors: Literal["errors", "errors_before"] | None = None
) -> Sequence[Array]:
    """Readings (n, 3) of each triad, in shares of gravity and field: with the errors of the fit, those before, or none.

    Definition: the six observables fix both vectors; an error without a reference counts as zero.
    """
    rows, known = calibration.station_rows, {row.observable: row for row in calibration.errors}
    sizes: dict[str, float] = {
        "mg": 1e-3,
        "‰": 1e-3,
        "°": np.radians(1.0),
        "nT": 1 / calibration.earth.get("field", 1.0),
    }

    def error(name: str, when: str) -> Array:
        values = np.array([getattr(row, when).get(name, 0.0) for row in rows], float)
        unit = known[name].unit.partition(" ")[0] if name in known else ""
        return np.asarray(values * sizes.get(unit, 0.0))

    def reference(name: str) -> Array:
        degrees = np.array([getattr(row, f"{name}_deg") for row in rows], float)
        return np.asarray(np.radians(degrees))

    inclination = reference("inclination") - error("inclination", "errors")
    weight = np.maximum(np.sin(inclination), 1e-3)
    values: dict[str, Any] = {"inclination": inclination, "gravity": 1.0, "field": 1.0}
    values["dip"] = np.radians(calibration.earth.get("dip_deg", 0.0))
    values["toolface"] = reference("toolface") - error("toolface", "errors") / weight
    azimuth = reference("azimuth") - error("azimuth", "errors") / weight
    values["azimuth"] = azimuth if calibration.has_field else 0.0
    if errors:
        weights = {"toolface": weight, "azimuth": weight}
        values = {n: v + error(n, errors) / weights.get(n, 1.0) for n, v in values.items()}
    return [*reference_vectors(**values)]


def _sphere(
    axes: Axes, triad: str, truth: Array, departures: Sequence[Array], rows: Sequence[StationRow]
) -> None:
    """The sphere of a triad with its stations, and how far from them it reads before and after the fit."""
    before, _ = sizes = [np.linalg.norm(each, axis=-1) for each in departures]
    longest = SHOWN_DEPARTURE / max(float(np.nanquantile(before, 0.9)), 1e-9)
    decade = 10.0 ** np.floor(np.log10(longest))
    scale = decade * max(step for step in (1, 2, 5) if step * decade <= longest)
    _graticule(axes)
    x, y, towards = SPHERE_VIEW @ truth.T
    axes.plot(x, y, ".", color="#9ca3af", ms=2.5, label="reference")
    looks = zip(("before", "after"), (BEFORE, AFTER), ("o", "s"), (3.4, 2.6), strict=True)
    for (name, colour, marker, small), each, size in zip(looks, departures, sizes, strict=True):
        ends = SPHERE_VIEW @ (truth + scale * each).T
        for far in (True, False):
            here = np.flatnonzero((towards < 0) == far).tolist()
            look: dict[str, Any] = {"color": colour, "alpha": 0.35 if far else 1.0}
            lines = np.stack([[x[here], y[here]], ends[:2, here], np.full((2, len(here)), np.nan)])
            axes.plot(*lines.transpose(1, 2, 0).reshape(2, -1), lw=0.7, **look)
            names = [f"station {rows[i].station}: {100 * size[i]:.2g} % {name}" for i in here]
            look |= {"mfc": "white" if name == "before" else colour, "mew": 0.8, "ms": small}
            named_points(axes, ends[0, here], ends[1, here], names, marker, **look)
        axes.plot(
            [], [], marker, label=name, color=colour, mfc="white" if name == "before" else colour
        )
    axes.set_title(f"{triad}, departures × {scale:g}", loc="center", fontsize=7)


def _graticule(axes: Axes) -> None:
    """The outline of a sphere, its near parallels and meridians, and the tool axis."""
    turn = np.radians(np.arange(0, 361, 4))
    circles = [np.stack([np.cos(turn), np.sin(turn), 0 * turn])]
    for level in np.radians([-60, -30, 0, 30, 60]):
        around = np.cos(level) * circles[0]
        axes.plot(*_near(around + np.array([[0], [0], [np.sin(level)]])), color="#e5e7eb", lw=0.5)
    for side in np.radians(range(0, 180, 30)):
        up = [np.cos(side) * np.cos(turn), np.sin(side) * np.cos(turn), np.sin(turn)]
        axes.plot(*_near(np.stack(up)), color="#e5e7eb", lw=0.5)
    axes.plot(*circles[0][:2], color="#6b7280", lw=0.8)
    foot, top = ((0.0, SPHERE_VIEW[1, 2] * length) for length in (1.0, 1.16))
    axes.annotate(
        "z", foot, top, arrowprops={"arrowstyle": "<-", "lw": 0.7}, ha="center", fontsize=7
    )
    axes.set_aspect("equal")
    axes.set(xlim=(-1.25, 1.25), ylim=(-1.2, 1.25))
    axes.set_axis_off()


def _near(curve: Array) -> Array:
    """A curve (3, n) as it is seen (2, n), without its far side."""
    right, up, towards = SPHERE_VIEW @ curve
    return np.where(towards > 0, [right, up], np.nan)


@dataclass(frozen=True)
class Plots:
    """Figures of one calibration, as `calibration.plot`: Matplotlib figures, in the style of the report.

    Raises:
        InputError: the calibration has nothing to draw of that kind.
    """

    calibration: Calibration

    @style()
    def accuracy(self) -> Figure:
        """1σ of each angle over inclination, degrees: of the calibration alone, and of one reading.

        Root mean square over toolface and azimuth; the band is from the best to the worst azimuth.
        """
        x = np.linspace(2, 178, 45)
        figure, [panels] = new_figure("Predicted 1σ over inclination", 2.5, columns=2, sharey=True)
        for axes, (title, noise) in zip(panels, ACCURACY_OF.items(), strict=True):
            curves = accuracy_curves(self.calibration, np.radians(x), noise)
            _accuracy_panel(axes, x, {name: curve.typical for name, curve in curves.items()})
            for curve in curves.values():
                ends = np.degrees([curve.least, curve.largest])
                axes.fill_between(x, *ends, color=AXES["z"], alpha=0.15, lw=0)
            axes.set(title=title, xlabel="inclination, °", xlim=(0, 180), xticks=range(0, 181, 30))
        return _accuracy_axes(figure, panels)

    @style()
    def accuracy_over_temperature(self) -> Figure:
        """1σ of each angle at 45° inclination over temperature, degrees; as `accuracy`."""
        x, label = self._temperatures(), "Predicted 1σ over temperature"
        figure, [panels] = new_figure(label, 2.1, columns=2, sharey=True)
        for axes, (title, noise) in zip(panels, ACCURACY_OF.items(), strict=True):
            each = [accuracy_at(self.calibration, [TYPICAL], noise, at) for at in x.tolist()]
            curves = {name: np.array([sd[name][0] for sd in each]) for name in each[0]}
            _accuracy_panel(axes, x, curves)
            axes.set(title=title, xlabel="temperature, °C")
        return _accuracy_axes(figure, panels)

    @style()
    def temperature(self) -> Figure:
        """Scale and bias of each channel over temperature, as changes, and the 1σ of both."""
        x, middle = self._temperatures(), middle_temperature(self.calibration)
        courses = channel_courses(self.calibration, [middle, *x.tolist()])
        label = "Scale and bias of each channel over temperature, with 1σ"
        across: dict[str, Any] = {"sharex": True, "gridspec_kw": {"hspace": 0.06}}
        figure, panels = new_figure(label, 5.6, 4, len(courses), **across)
        for column, (triad, course) in zip(panels.transpose(), courses.items(), strict=True):
            names = [f"{triad[0]}{axis}" for axis in AXES]
            for axes, (title, values) in zip(column, self._shown(triad, course), strict=True):
                _channel_curves(axes, x, values, names)
                axes.set_ylabel(title)
            column[0].set_title(f"{triad}: change since {middle:g} °C", pad=16)
            place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 0.99)}
            column[0].legend(ncols=3, borderpad=0.1, handlelength=3, **place)
            column[-1].set_xlabel("temperature, °C")
        return figure

    def _shown(self, triad: str, course: ChannelCourse) -> list[tuple[str, Array]]:
        """Title and values (n, 3) of each panel of a triad, the first row of a course being the middle."""
        unit = (
            "mg" if triad == TRIADS[0] else "‰ of the field" if self.calibration.relative else "nT"
        )
        size, scale = 1.0 if unit == "nT" else 1e3, course.scale[0]
        return [
            ("scale, %", 100 * (course.scale[1:] / scale - 1)),
            ("1σ of scale, %", 100 * course.scale_sd[1:] / scale),
            (f"bias, {unit}", size * (course.bias[1:] - course.bias[0])),
            (f"1σ of bias, {unit}", size * course.bias_sd[1:]),
        ]

    @property
    def over_temperature(self) -> bool:
        """Whether the calibration has temperature terms, and a range of temperatures."""
        low, high = self.calibration.temperature_c or (0.0, 0.0)
        return self.calibration.thermal and low < high

    def _temperatures(self) -> Array:
        """Temperatures over the calibrated range; refuses where nothing varies with them."""
        if not self.over_temperature or self.calibration.temperature_c is None:
            raise InputError(
                "the calibration has no temperature terms, so that nothing varies with temperature. "
                "Calibrate a run of several temperatures, with `order` 1 or more."
            )
        return np.linspace(*self.calibration.temperature_c, TEMPERATURES)

    @style()
    def errors_by_temperature(self) -> Figure:
        """Errors after the fit at each station over its temperature, an observable in each panel."""
        stations = [row for row in self.calibration.station_rows if row.temperature_c is not None]
        rows = self.calibration.errors
        if not stations or not rows:
            raise InputError(
                "no station of the run has both a temperature and a reference. Calibrate a run with "
                "the column temperature_c."
            )
        soak = soaks(np.array([row.temperature_c for row in stations]))
        height = -(-len(rows) // 2)
        label = "Errors left at each station over its temperature"
        figure, panels = new_figure(label, 0.3 + 1.35 * height, height, 2, sharex=True)
        for axes, row in zip(panels.ravel(), rows, strict=False):
            _errors_by_temperature(axes, row, stations, soak)
        for axes in panels.ravel()[len(rows) :]:
            axes.set_visible(False)
        for axes in panels.ravel()[: len(rows)][-2:]:
            axes.xaxis.set_tick_params(labelbottom=True)
            axes.set_xlabel("temperature, °C")
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

    @style()
    def errors_of_all(self, before: bool = False) -> Figure:
        """Errors of every observable at each station in small panels: those left, or those before."""
        rows, stations = self.calibration.errors, self.calibration.station_rows
        when = "before" if before else "after"
        errors, *look = ("errors_before", BEFORE, "o") if before else ("errors", AFTER, "s")
        height = -(-len(rows) // 2)
        label = f"Errors at each station, {when} calibration"
        figure, panels = new_figure(label, 0.1 + 1.2 * height, height, 2)
        for axes, row in zip(panels.ravel(), rows, strict=False):
            unit = row.unit.partition(" ")[0]
            values = [getattr(station, errors).get(row.observable, np.nan) for station in stations]
            _station_stems(axes, stations, values, unit, *look)
            axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)
            if row.expected and not before:
                axes.axhspan(-row.expected, row.expected, color=BAND, lw=0, zorder=0.5)
            rms = quantity(getattr(row, when), unit)
            axes.set(title=f"{TITLES[row.observable]}, {unit}: rms {rms}", xlabel="")
        for axes in panels.ravel()[len(rows) :]:
            axes.set_visible(False)
        for axes in panels.ravel()[: len(rows)][-2:]:
            axes.set_xlabel("station")
        return figure

    @style()
    def sphere(self) -> Figure:
        """The unit sphere of each triad in the tool's frame: where stations read before and after calibration.

        A dot is the direction of the reference. Departures from it are drawn much too large, as the title says.
        """
        names = [triad.name for triad in self.calibration.triads]
        truth = _unit_vectors(self.calibration)
        before = _unit_vectors(self.calibration, "errors_before")
        after = _unit_vectors(self.calibration, "errors")
        label = "Unit sphere with the stations before and after calibration"
        figure, [panels] = new_figure(label, 1.95, columns=len(names), width=1.75 * len(names))
        for k, axes in enumerate(panels):
            departures = [each[k] - truth[k] for each in (before, after)]
            _sphere(axes, names[k], truth[k], departures, self.calibration.station_rows)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
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
        axes.set_title(row.name[:LONGEST_LABEL], **look)
        axes.set_title(outcome, loc="right", fontsize=7, **look)

    def _look(self, each: JudgedSet, worst: bool) -> tuple[str, tuple[str, str, Any]]:
        """How a set is called in the legend, and its colour, marker and line."""
        sets = (each for row in self.verdict.rows for each in row.sets)
        labels = list(dict.fromkeys(each.label for each in sets if each.label))
        if not each.label:
            return "stations outside of roll sets", (BEFORE, "p", "-")
        if len(labels) <= len(SERIES):
            return each.label[:LONGEST_LABEL], SERIES[labels.index(each.label)]
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
