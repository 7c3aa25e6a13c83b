"""Strip plots of a fleet: a mark for each tool, or for each of some equal groups of very many.

The table of a fleet's calibrations as columns over its calibrated tools, and what is comparable among them.

It is read column by column, whatever its length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.results import STATED_ANGLES
from mwdcal.files.formats import parquet
from mwdcal.fleet.calibrate import OK
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.presentation.fleet import is_doubt, numbers, quantiles
from mwdcal.presentation.numbers import number, unit
from mwdcal.presentation.text import one_line, raised, superscript
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RELATIVE_KIND = "field = 1"
"""The kind of magnetometers of which the strength of the field is not known."""
FAR = 6.0
"""Robust standard deviations from the fleet's median beyond which a tool is an outlier."""
FEWEST_TOOLS = 20
"""Sound tools without which there is no fleet to be an outlier of."""
SPREAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""


@dataclass(frozen=True)
class FleetParameter:
    """A column of parameters over the sound tools, NaN where a tool does not have it.

    Magnetometers calibrated to nT and to a field of one are of different `kind`.
    """

    triad: str
    kind: str
    title: str
    unit: str
    values: Array
    sd: Array

    @property
    def sensors(self) -> str:
        """The quantities that may be compared."""
        return f"{self.triad}, {self.kind}" if self.kind else self.triad

    @property
    def tools(self) -> int:
        """Number of tools that have it."""
        return int(np.sum(~np.isnan(self.values)))

    @property
    def quantiles(self) -> list[float]:
        """1 %, median and 99 %."""
        return quantiles(self.values)

    @property
    def typical_sd(self) -> float | None:
        """Median of the standard uncertainties."""
        return None if np.isnan(self.sd).all() else float(np.nanmedian(self.sd))


class SoundTools:
    """The calibrated tools of a table of calibrations, read column by column."""

    def __init__(self, path: Path) -> None:
        _, pq = parquet.modules(path.name)
        self._file = pq.ParquetFile(path)
        self.names: list[str] = self._file.schema_arrow.names
        self.metadata = parquet.metadata_of(self._file.schema_arrow.metadata, path.name)
        self._rows: Bools = np.array(self._column("status").to_pylist(), object) == OK
        self.count = int(self._rows.sum())

    def _column(self, name: str) -> Any:
        return self._file.read([name]).column(0)

    def numbers(self, name: str) -> Array:
        """A column of numbers, or NaN."""
        return numbers(self._file, name)[self._rows]

    def words(self, name: str) -> AnyArray:
        """A column of text, labels, or lists of them."""
        cells = self._column(name).to_pylist()
        return np.fromiter(cells, object, len(cells))[self._rows]

    @property
    def has_magnetometer(self) -> Bools:
        """Which tools have a calibrated magnetometer."""
        return np.array([unit is not None for unit in self.words("field_unit")], bool)

    def accuracy(self) -> dict[str, Array]:
        """1σ of the calibration at 45° inclination by angle, degrees; NaN where it is undetermined."""
        columns = {angle: f"{angle}_sd_deg" for angle in STATED_ANGLES}
        return {a: self.numbers(name) for a, name in columns.items() if name in self.names}

    def undetermined(self) -> dict[str, Bools]:
        """Which tools have an angle without an accuracy, although their sensors give the angle."""
        magnetic = {STATED_ANGLES[-1]: self.has_magnetometer}
        return {a: np.isnan(sd) & magnetic.get(a, True) for a, sd in self.accuracy().items()}

    @property
    def triads(self) -> list[str]:
        """The triads that some tool of the table may have."""
        return [triad for triad in TRIADS if f"{triad}_rank" in self.names]

    def residuals(self, triad: str) -> Array:
        """Residuals of a triad divided by what noise alone would give."""
        return np.sqrt(self.numbers(f"{triad}_variance_factor"))

    def doubtful(self) -> Bools:
        """Which tools have a finding that says that their fit is doubtful."""
        return np.array([any(map(is_doubt, each)) for each in self.words("findings")], bool)


def parameters_of(tools: SoundTools) -> list[FleetParameter]:
    """All columns of parameters, with units that people use."""
    parameters = []
    kinds = kinds_of(tools)
    nominal = nominal_unit(tools, kinds)
    for name in tools.names:
        triad, _, rest = name.partition("_")
        if triad not in TRIADS or f"{name}_sd" not in tools.names:
            continue
        every, spread = _comparable(tools, triad, rest), tools.numbers(f"{name}_sd")
        for kind, which in kinds.items() if triad == TRIADS[1] else [("", True)]:
            values, sd = (np.where(which, v, np.nan) for v in (every, spread))
            if not np.isnan(values).all():
                unit, factor = _unit(rest, triad, bool(kind), nominal)
                each = FleetParameter(triad, kind, _title(rest), unit, values * factor, sd * factor)
                parameters.append(each)
    return sorted(parameters, key=lambda each: each.sensors)


def kinds_of(tools: SoundTools) -> dict[str, Bools]:
    """Which tools are calibrated to nT, and which to a field of one: they do not compare."""
    units = tools.words("field_unit")
    relative = np.array([unit not in (None, "nT") for unit in units])
    kinds = {"": units == "nT", RELATIVE_KIND: relative}
    return {name: which for name, which in kinds.items() if which.any()}


def nominal_unit(tools: SoundTools, kinds: Mapping[str, Bools]) -> str:
    """Unit of the nominal readings of magnetometers calibrated to a field of one.

    nT, or none where the profile states no scale: then they are relative too, and gains near 1, as
    the fit refuses others. In nT a gain is one over the strength, and a scale is the strength.
    """
    which = kinds.get(RELATIVE_KIND, np.zeros(tools.count, bool))
    for name in ("gain_xx", "scale_x", "radius"):
        if f"{TRIADS[1]}_{name}" in tools.names:
            values = _comparable(tools, TRIADS[1], name)[which]
            if not np.isnan(values).all():
                return "" if 0.01 < abs(np.nanmedian(values)) < 100.0 else "nT"
    return "nT"


def _comparable(tools: SoundTools, triad: str, name: str) -> Array:
    """A column but for tools with own-axis terms, whose other parameters are of scaled readings."""
    values, radius = tools.numbers(f"{triad}_{name}"), f"{triad}_radius"
    if radius not in tools.names or name.startswith(("square", "cube", "radius")):
        return values
    return np.where(np.isnan(tools.numbers(radius)), values, np.nan)


def _unit(name: str, triad: str, relative: bool, nominal: str) -> tuple[str, float]:
    """Unit and factor of a parameter: offsets in mg or nT, the rest as shares of nominal.

    A `relative` field has no unit, whatever that of the `nominal` readings: a factor's scale has
    theirs, and a gain one over it.
    """
    kind, _, rest = name.partition("_")
    per = raised("/°C", int(rest.partition("_t")[2] or 0))
    if kind in ("offset", "bias", "square", "cube"):
        field = "of the field" if relative else "nT"
        return (f"mg{per}", 1e3) if triad == TRIADS[0] else (f"{field}{per}", 1.0)
    if relative and nominal and kind in ("gain", "scale"):
        return (f"1/{nominal}" if kind == "gain" else nominal) + per, 1.0
    return per.replace("/", "1/"), 1.0


def _title(name: str) -> str:
    """The parameter as its calibration file calls it.

    >>> _title("gain_xy_t1")
    'gain xy·τ'
    """
    steady, _, power = name.partition("_t")
    return steady.replace("_", " ") + raised("·τ", int(power or 0))


def distance(values: Array) -> Array:
    """Robust standard deviations (n,) from the median; 0 for few values, or where most are equal."""
    if np.sum(~np.isnan(values)) < FEWEST_TOOLS:
        return np.zeros(len(values))
    away = np.abs(values - np.nanmedian(values))
    spread = SPREAD * np.nanmedian(away)
    return away / spread if spread > 0 else np.zeros(len(values))


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
