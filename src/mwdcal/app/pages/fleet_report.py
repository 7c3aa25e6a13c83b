"""The summary page of a fleet: statuses, distributions, outliers, in one HTML file.

It reads the table of calibrations column by column, whatever its length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app.pages.page import banner, environment
from mwdcal.app.screens.fleet import (
    ERRORS,
    FleetSummary,
    is_doubt,
    numbers,
    quantiles,
    unusual,
)
from mwdcal.app.text import number, plural, raised
from mwdcal.calibration.diagnosis.plausibility import NOISE_RATIO
from mwdcal.calibration.prediction import STATED_ANGLES
from mwdcal.calibration.readings import TRIADS, is_simulated
from mwdcal.files.formats import parquet
from mwdcal.fleet.calibrate import OK
from mwdcal.fleet.sources import SERIAL
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RELATIVE_KIND = "field = 1"
"""The kind of magnetometers of which the strength of the field is not known."""
TRIAD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#4b5563")
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 1)))
BINS = (12, 40)
"""Fewest and most bins: as many as half the root of the number of tools."""
ABREAST = 3
"""Most panels in a row."""
TICKS = 12
"""Numbers along the axes of a row of panels: more would run into each other."""
FAR = 6.0
"""Robust standard deviations from the fleet's median beyond which a tool is an outlier."""
FEWEST_TOOLS = 20
"""Sound tools without which there is no fleet to be an outlier of."""
SPREAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""
ONE_AXIS_OR_TWO = ("gain", "square", "cube")
"""Parameters of one axis or of two: a panel for each."""
Panel = tuple[str, str, Mapping[str, Array]]
"""Title, name of the axis, and values by name."""


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
        """What may be compared."""
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
        """A column of numbers, NaN where there is none."""
        return numbers(self._file, name)[self._rows]

    def words(self, name: str) -> AnyArray:
        """A column of text or labels."""
        return np.array(self._column(name).to_pylist(), object)[self._rows]


def render(calibrations: Path, summary: FleetSummary) -> str:
    """The page as HTML: the same table gives the same text but for the time it took."""
    template = environment().get_template("fleet.html")
    tools = SoundTools(calibrations)
    parameters = _parameters(tools) if tools.count else []
    estimated: Any = tools.metadata["noise_estimated"]
    return template.render(
        result=summary,
        metadata=tools.metadata,
        simulated=is_simulated(tools.metadata),
        banner=_banner(summary),
        options="; ".join(unusual(summary.options)) or "defaults",
        stand={name: summary.spread[name] for name in ERRORS if summary.spread.get(name)},
        short=number,
        estimated=estimated,
        figures=_figures(tools, parameters, estimated) if tools.count else {},
        parameters=parameters,
        outliers=_outliers(tools, parameters),
        suspects=_suspects(tools),
        far=FAR,
        fewest=FEWEST_TOOLS,
        suspect=NOISE_RATIO,
    )


def _banner(summary: FleetSummary) -> dict[str, str]:
    """The result in one sentence."""
    refused = summary.tools - summary.sound
    doubts = [
        f"{finding.id.replace('-', ' ')} in {plural(finding.tools, 'tool')}"
        for finding in summary.findings
        if is_doubt(finding.id)
    ]
    headline = f"{summary.sound} of {plural(summary.tools, 'tool')} calibrated"
    after = "Every tool has parameters with their uncertainty."
    if refused:
        after = f"{plural(refused, 'tool')} without a result: see the reasons below."
    after = "; ".join([after.rstrip("."), *doubts]) + "." if doubts else after
    if not summary.sound:
        return banner("bad", "None calibrated", headline, after)
    if refused or doubts:
        word = "Some refused" if refused else "Some doubtful"
        return banner("attention", word, headline, after)
    return banner("good", "All calibrated", headline, after)


def _parameters(tools: SoundTools) -> list[FleetParameter]:
    """All columns of parameters, with units that people use."""
    parameters = []
    kinds = _kinds(tools)
    nominal = _nominal(tools, kinds)
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


def _kinds(tools: SoundTools) -> dict[str, Bools]:
    """Which tools are calibrated to nT, and which to a field of one: they do not compare."""
    units = tools.words("field_unit")
    relative = np.array([unit not in (None, "nT") for unit in units])
    kinds = {"": units == "nT", RELATIVE_KIND: relative}
    return {name: which for name, which in kinds.items() if which.any()}


def _nominal(tools: SoundTools, kinds: Mapping[str, Bools]) -> str:
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


def _figures(
    tools: SoundTools, parameters: list[FleetParameter], estimated: list[str]
) -> dict[str, Figure]:
    """Distributions of the parameters, and of residuals, noise and accuracy."""
    triads = dict.fromkeys(p.triad for p in parameters)
    declared = [triad for triad in triads if triad not in estimated]
    s = {f"{triad} s": _residuals(tools, triad) for triad in declared}
    panels: list[Panel] = [("residuals ÷ what noise alone would give, s", "s", s)] if s else []
    panels += [_noise(tools, triad) for triad in triads if triad in estimated]
    angles = STATED_ANGLES[: 1 + len(triads)]
    accuracy = {angle: tools.numbers(f"{angle}_sd_deg") for angle in angles}
    panels.append(("1σ of the calibration at 45°", "1σ, °", accuracy))
    steady = [p for p in parameters if "τ" not in p.title]
    return {"parameters": draw_parameters(steady), "quality": draw_quality(panels)}


def _residuals(tools: SoundTools, triad: str) -> Array:
    """Residuals of a triad divided by what noise alone would give."""
    return np.sqrt(tools.numbers(f"{triad}_variance_factor"))


def _noise(tools: SoundTools, triad: str) -> Panel:
    """The panel of the noise estimated from each tool's residuals; of one kind of magnetometers."""
    values = tools.numbers(f"{triad}_noise")
    title = f"{triad}: estimated noise"
    if triad == TRIADS[0]:
        return title, "1σ, mg", {triad: 1e3 * values}
    kinds = _kinds(tools)
    kind, which = next(iter(kinds.items()))
    relative = kind == RELATIVE_KIND and not _nominal(tools, kinds)
    return title, "1σ of the field" if relative else "1σ, nT", {triad: values[which]}


def _outliers(
    tools: SoundTools, parameters: list[FleetParameter]
) -> list[tuple[Any, FleetParameter, float, float]]:
    """Tools far from the fleet: serial, farthest parameter, value, distance; the farthest first."""
    if tools.count < FEWEST_TOOLS:
        return []
    away = np.nan_to_num([distance(each.values) for each in parameters])
    which, farthest = away.argmax(0), away.max(0)
    serials, outliers = tools.words(SERIAL), []
    for i in np.argsort(-farthest, kind="stable")[: int(np.sum(farthest > FAR))]:
        each = parameters[which[i]]
        outliers.append((serials[i], each, float(each.values[i]), float(farthest[i])))
    return outliers


def _suspects(tools: SoundTools) -> list[tuple[Any, str, float]]:
    """Sound tools with large residuals: serial, triad, s; the largest first."""
    serials, suspects = tools.words(SERIAL), []
    for triad in TRIADS:
        if f"{triad}_variance_factor" in tools.names:
            s = _residuals(tools, triad)
            suspects += [(serials[i], triad, float(s[i])) for i in np.flatnonzero(s > NOISE_RATIO)]
    return sorted(suspects, key=lambda row: -row[2])


def distance(values: Array) -> Array:
    """Robust standard deviations (n,) from the median; 0 for few values, or where most are equal."""
    if np.sum(~np.isnan(values)) < FEWEST_TOOLS:
        return np.zeros(len(values))
    away = np.abs(values - np.nanmedian(values))
    spread = SPREAD * np.nanmedian(away)
    return away / spread if spread > 0 else np.zeros(len(values))


@plots.style()
def draw_parameters(parameters: Sequence[FleetParameter]) -> Figure:
    """Number of tools by value of each steady parameter: a row of panels for each triad."""
    lines = _lines(parameters)
    columns, label = max(map(len, lines)), "Distributions of the fleet's parameters"
    figure, grid = plots.new_figure(label, 2.1 * len(lines), len(lines), columns)
    for row, line in zip(grid, lines, strict=True):
        row[0].set_ylabel("tools")
        for axes in row[len(line) :]:
            axes.set_axis_off()
        for axes, (title, members) in zip(row, line, strict=False):
            axes.set(title=title, xlabel=members[0].unit or "share of nominal")
            _steps(axes, {m.title.partition(" ")[2]: m.values for m in members})
            axes.locator_params(axis="x", nbins=TICKS // columns)
    return figure


def _lines(parameters: Sequence[FleetParameter]) -> list[list[tuple[str, list[FleetParameter]]]]:
    """Panels in rows, each row of one triad: title and parameters of a panel."""
    triads: dict[str, dict[str, list[FleetParameter]]] = {}
    for each in parameters:
        kind, _, axes = each.title.partition(" ")
        if kind in ONE_AXIS_OR_TWO:
            kind = f"{'own' if len(set(axes)) == 1 else 'cross'}-axis {kind}"
        triad = each.kind or each.triad
        title = f"{triad}: {kind}"
        triads.setdefault(triad, {}).setdefault(title, []).append(each)
    return [
        list(panels.items())[first : first + ABREAST]
        for panels in triads.values()
        for first in range(0, len(panels), ABREAST)
    ]


@plots.style()
def draw_quality(panels: Sequence[Panel]) -> Figure:
    """Number of tools by residuals over noise or by noise, and by 1σ of each angle."""
    label = "Distributions of residuals and accuracy"
    figure, [row] = plots.new_figure(label, 2.2, columns=len(panels))
    row[0].set_ylabel("tools")
    for axes, (title, quantity, series) in zip(row, panels, strict=True):
        axes.set(title=title, xlabel=quantity)
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
    for (name, values), colour, dash in zip(usable.items(), TRIAD_COLOURS, DASHES, strict=False):
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges, label=name, color=colour, ls=dash, lw=1.0)
    rows = -(-len(usable) // abreast)
    axes.legend(ncols=abreast, loc="upper left", handlelength=2.2, columnspacing=1.0)
    axes.set_ylim(bottom=0, top=axes.get_ylim()[1] * (1.1 + 0.15 * rows))
