"""Methods side by side, on the screen and for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Finding, Measures
from mwdcal.comparison.compare import SCALE, Comparison, Row, able
from mwdcal.estimation.uncertainty import ROTATIONS
from mwdcal.geometry.observables import TITLES
from mwdcal.geometry.vectors import Array
from mwdcal.presentation.numbers import (
    RAW_MEANING,
    RAW_UNIT,
    UNDETERMINED,
    capital,
    measured,
    number,
    raw_unit,
    value_places,
)
from mwdcal.presentation.numbers import unit as spaced
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import one_line, raised, superscript, table
from mwdcal.use import plots
from mwdcal.use.notation import Notation

if TYPE_CHECKING:
    pass
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATISTICS = (
    ("mean", "after", "mean"),
    ("STD", "after", "std"),
    ("MSE", "after", "mse"),
    ("RMSE", "after", "rmse"),
    ("RMSE left out", "left out", "rmse"),
)
"""Measures of the vector error: title, of which fit, and name."""
CONVENTION_MARK = "*"
"""Behind a figure that rests on a convention."""


def text(comparison: Comparison, parameters: bool = False) -> str:
    """The advice, errors and residual statistics of every method, and why some were refused."""
    rows = able(comparison.rows)
    methods = [row.method for row in rows]
    simulated = [SIMULATED] if comparison.simulated else []
    lines = [one_line("   ".join([*heading(comparison), *simulated])), one_line(comparison.advice)]
    if rows:
        lines += ["", table(figures(comparison), ["", "before", *methods]), ""]
    lines += map(one_line, notes(comparison))
    lines += [f"{who} refused: {one_line(why)}" for who, why in refusals(comparison)]
    if parameters and rows:
        lines += ["", gauge(comparison) + " In parentheses: 1σ of the last digits."]
        for triad in rows[0].parameters:
            stated = [
                [each.name, *(_joined(*pair) for pair in each.pairs)]
                for each in parameters_of(comparison, triad)
            ]
            lines += ["", table(stated, [triad, *methods])]
    return "\n".join(lines)


def refusals(comparison: Comparison) -> list[tuple[str, str]]:
    """Who was refused, and why: once where all methods were for the same reason."""
    refused = [(row.method, row.refused) for row in comparison.rows if row.refused]
    reasons = {why for _, why in refused}
    if len(refused) == len(comparison.rows) > 1 and len(reasons) == 1:
        return [("every method", reasons.pop())]
    return refused


def _joined(value: str, sd: str) -> str:
    """1σ in parentheses, in units of the last digit of the value: 2.93051(10)."""
    if sd == UNDETERMINED:
        return sd
    digits, times, power = value.partition("×")
    short = sd.partition("×")[0].replace(".", "").lstrip("0") or "0"
    return f"{digits}({short}){times}{power}"


def heading(comparison: Comparison) -> list[str]:
    """The subject and the method of the comparison."""
    orders = " and ".join(str(order) for order in dict.fromkeys(comparison.orders))
    whole = comparison.parts == comparison.stations
    parts = [
        comparison.run,
        f"{comparison.stations} stations",
        f"temperature order {orders}",
        f"own-axis terms: {' and '.join(comparison.curved)}" if comparison.curved else "",
        "each station left out in turn" if whole else f"{comparison.parts} parts left out in turn",
    ]
    return [part for part in parts if part]


def figures(comparison: Comparison) -> list[list[str]]:
    """All figures of the nominal tool ("before"), then of every method."""
    return [
        *errors(comparison, "held_out", "rms left out"),
        *errors(comparison, "in_sample", "rms in sample"),
        *measures(comparison),
        *([what, "", *cells] for what, *cells in effort(comparison)),
    ]


def errors(comparison: Comparison, kind: str, how: str = "") -> list[list[str]]:
    """Root mean square errors by observable, before and of every method.

    `kind` is "held_out" or "in_sample", and `how` what the rows say of it.
    """
    rows = []
    for name, unit in comparison.units.items():
        cells = [
            number(getattr(row, kind)[name], 3) + CONVENTION_MARK * (name in row.resting)
            for row in able(comparison.rows)
        ]
        what = ", ".join(filter(None, (TITLES.get(name, name), how, unit)))
        rows.append([what, number(comparison.before[name], 3), *cells])
    return rows


def measures(comparison: Comparison) -> list[list[str]]:
    """Moradi's four measures of the vector error by triad, and the last of them left out."""
    rows = []
    for before in comparison.measures_before:
        for what, when, key in STATISTICS:
            cells = [_measure(row, before.triad, when, key) for row in able(comparison.rows)]
            first = number(getattr(before, key), 3) if when == "after" else ""
            rows.append([f"{before.triad} |e|, {what}", first, *cells])
    return rows


def _measure(row: Row, triad: str, when: str, key: str) -> str:
    """One measure of the vector error of a triad by one method."""
    values = [getattr(m, key) for m in row.measures if (m.triad, m.when) == (triad, when)]
    rank, size = row.ranks[triad]
    return number(values[0] if values else None, 3) + CONVENTION_MARK * (rank < size)


def effort(comparison: Comparison) -> list[list[str]]:
    """Rank, iterations and time of every method."""
    rows = able(comparison.rows)
    ranks = [
        [f"rank, {triad}", *("{} of {}".format(*row.ranks[triad]) for row in rows)]
        for triad in rows[0].ranks
    ]
    lost = ["stations no fit could judge", *(str(row.lost) for row in rows)]
    return [
        *ranks,
        *([lost] if any(row.lost for row in rows) else []),
        ["iterations", *(str(row.iterations) for row in rows)],
        ["time of one fit, s", *(f"{row.seconds:.2f}" for row in rows)],
    ]


def notes(comparison: Comparison) -> list[str]:
    """The parameters that each method leaves free, and what the tables mean."""
    measure = "|e|: length of the vector error, as a share of the reference vector (Moradi)"
    stated = [measure] if comparison.measures_before and able(comparison.rows) else []
    return [*undetermined(comparison), *stated, *marks(comparison)]


def undetermined(comparison: Comparison) -> list[str]:
    """The parameters that each method leaves free."""
    return [
        f"{row.method} leaves undetermined: {', '.join(row.undetermined)}"
        for row in able(comparison.rows)
        if row.undetermined
    ]


def marks(comparison: Comparison) -> list[str]:
    """The meaning of marks in the tables, if there are any."""
    if not able(comparison.rows):
        return []
    if any(CONVENTION_MARK in cell for row in figures(comparison) for cell in row):
        rests = "rests on a direction that the method leaves free: kept at nominal"
        return [f"{CONVENTION_MARK} {rests}"]
    return []


def gauge(comparison: Comparison) -> str:
    """The convention that all parameters were brought to, in words."""
    meaning = "Factors of the raw channels (u = V / SF - B, field = P (1 - m) u)"
    triads = able(comparison.rows)[0].parameters
    if RAW_UNIT in [raw_unit(comparison.profile, triad) for triad in triads]:
        meaning += f"; {RAW_MEANING}"
    if any(comparison.orders):
        meaning += ", by power of τ, temperature - reference"
    if comparison.curved:
        meaning += "; of the tangent at the centre of the readings, without own-axis terms"
    if not comparison.gauge:
        return f"{meaning}. No method leaves a direction free."
    courses = any("-temperature-" in name for row in comparison.rows for name in row.undetermined)
    rest = " What rests on a free course with temperature stays undetermined." if courses else ""
    each = "; ".join(f"{name} {', '.join(free)}" for name, free in comparison.gauge.items())
    return (
        f"{meaning}. One gauge for all: what any method leaves free ({each}) is taken out of every "
        "method's factors and listed below them. Free rotation: the gain, split into rotation and "
        "symmetric stretch, has none. Free scale: the mean strength is that of the references."
        + rest
    )


@dataclass(frozen=True)
class ComparedParameter:
    """A parameter of a triad: values and standard uncertainties by method, NaN: undetermined."""

    title: str
    unit: str
    values: list[float]
    sd: list[float]

    @property
    def name(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Each method's value and standard uncertainty as text."""
        return [measured(*pair) for pair in zip(self.values, self.sd, strict=True)]


def parameters_of(comparison: Comparison, triad: str) -> list[ComparedParameter]:
    """The parameters of a triad: its factors, then what was taken out of them."""
    rows = able(comparison.rows)
    factors, taken_out = [r.parameters[triad] for r in rows], [r.taken_out[triad] for r in rows]
    strength = "g" if triad == "accelerometer" else "nT" if "field" in comparison.units else ""
    result = [
        _parameter(f"{key} {axes}{raised('·τ', power)}", unit, factors, key, at)
        for key, at, axes, power, unit in value_places(
            factors[0].values, raw_unit(comparison.profile, triad), strength
        )
    ]
    for name in comparison.gauge.get(triad, []):
        turn = name != SCALE
        key, index = ("rotation_deg", ROTATIONS.index(name)) if turn else (name, 0)
        result.append(_parameter(name, "°" if turn else "", taken_out, key, (index,)))
    return result


def _parameter(
    title: str, unit: str, notations: list[Notation], key: str, at: tuple[int, ...]
) -> ComparedParameter:
    """One number of every method's notation."""
    values, sd = (
        [float(getattr(notation, what)[key][at]) for notation in notations]
        for what in ("values", "uncertainty")
    )
    return ComparedParameter(title, unit, values, sd)


class NotationValues(msgspec.Struct, frozen=True, kw_only=True):
    """A `Notation` as lists."""

    values: dict[str, list[Any]]
    uncertainty: dict[str, list[Any]]
    covariance: list[list[float | None]]


class ComparedMethod(msgspec.Struct, frozen=True, kw_only=True):
    """A `Row` without the errors of single stations and the course of the swarm."""

    method: str
    refused: str
    ranks: dict[str, tuple[int, int]]
    undetermined: list[str]
    iterations: int
    seconds: float
    in_sample: dict[str, float | None]
    held_out: dict[str, float | None]
    resting: list[str]
    lost: int
    measures: list[Measures]
    parameters: dict[str, NotationValues]
    taken_out: dict[str, NotationValues]


class ComparisonSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `compare`: the fields of `Comparison`, unused columns, and the page."""

    run: str
    stations: int
    simulated: bool
    orders: tuple[int, int]
    curved: list[str]
    parts: int
    seed: int
    units: dict[str, str]
    before: dict[str, float | None]
    measures_before: list[Measures]
    gauge: dict[str, list[str]]
    rows: list[ComparedMethod]
    advice: str
    findings: list[Finding]
    report: str


def document(
    comparison: Comparison, findings: list[Finding], report: Path | None
) -> ComparisonSummary:
    """The result for machines."""
    shown = msgspec.to_builtins(comparison, enc_hook=np.ndarray.tolist)
    files = {"findings": msgspec.to_builtins(findings), "report": str(report or "")}
    return msgspec.convert({**shown, **files}, ComparisonSummary)


# --------------------------------------------------------------------------
# The page of methods side by side, and its figures.
#
# Every method has a colour and a marker of its own, the same in all figures.


LOOKS = {method: look[:2] for method, look in zip(EVIDENCE, plots.SERIES, strict=True)}
"""Colour and marker of each method."""
STATED = {"serial": "", "date": "measured "}
"""The metadata of the run in the heading, and the words before them."""
ROW_HEIGHT = 0.6
"""Of an observable, inches: six markers below each other."""
LAST_RATIO = 10.0
"""Times the best error at which the axis of errors ends; beyond it the value is written."""
SEPARATE_SCALE = 4.0
"""Times the least of the methods' largest errors beyond which a method's panel has its own scale."""
ROOM, ROOM_AND_TEXT = 1.1, 1.7
"""Edge of a panel over its largest error, and where a line of text stands there."""
LAST_SIGMA = 12.0
"""Difference of a parameter, in 1σ of the first method, at which the axis ends."""
MOST_STATIONS = 240
"""A longer run shows the largest error of each of so many equal parts of it."""


def render(
    comparison: Comparison,
    profile: str = "",
    run_sha256: str = "",
    profile_sha256: str = "",
    metadata: Mapping[str, object] | None = None,
    time: str = "",
) -> str:
    """The comparison as HTML, with the name of its tool profile and the SHA-256 of its sources.

    `metadata` are those of the run; `time` is when the methods were compared.
    """
    return rendered(
        "comparison.html",
        **{function.__name__: function for function in TABLES + FIGURES},
        result=comparison,
        simulated=comparison.simulated,
        banner=_banner(comparison),
        heading=_heading(comparison, metadata or {}),
        rows=able(comparison.rows),
        limit=MOST_STATIONS,
        separate_scale=SEPARATE_SCALE,
        profile=profile,
        run_sha256=run_sha256,
        profile_sha256=profile_sha256,
        time=time,
    )


def _heading(comparison: Comparison, metadata: Mapping[str, object]) -> list[str]:
    """The tool, when it was measured, and what was compared."""
    stated = [f"{title}{metadata[key]}" for key, title in STATED.items() if metadata.get(key)]
    return [*stated, *(part for part in heading(comparison) if part != comparison.run)]


def _banner(comparison: Comparison) -> dict[str, str]:
    """The advice, and why."""
    headline, _, why = comparison.advice.partition(": ")
    level, word = ("good", "Advice") if able(comparison.rows) else ("bad", "Refused")
    return banner(level, word, capital(headline), capital(why))


@plots.style()
def draw_errors(comparison: Comparison) -> Figure:
    """Left-out error of every observable and method over the best of any; hollow: in sample."""
    rows, names = able(comparison.rows), list(comparison.units)
    label = "Left-out error of every method and observable"
    figure, [[axes]] = plots.new_figure(label, 0.75 + ROW_HEIGHT * len(names))
    best = np.fmin.reduce([[row.held_out[name] for name in names] for row in rows])
    best = np.where(best > 0, best, np.nan)
    step = min(0.15, 0.9 / len(rows))
    for row, shift in zip(rows, _abreast(rows, step), strict=True):
        where, (colour, marker) = np.arange(len(names)) + shift, LOOKS[row.method]
        inside = [row.in_sample[name] for name in names] / best
        left_out = [row.held_out[name] for name in names] / best
        hollow: dict[str, Any] = {"mfc": "white", "mew": 0.7, "ms": 3.2, "alpha": 0.8}
        axes.plot(
            np.where(inside > LAST_RATIO, np.nan, inside), where, marker, color=colour, **hollow
        )
        axes.plot(
            np.fmin(left_out, LAST_RATIO), where, marker, color=colour, ms=4.6, label=row.method
        )
        for i in np.flatnonzero(left_out > LAST_RATIO):
            _name_far(axes, f"{row.method}: {number(float(left_out[i]))} ▸", where[i])
    _ratio_axis(axes)
    _observable_axis(axes, names)
    axes.axvline(1, color="#4b5563", lw=0.8)
    _legend(figure)
    return figure


def _name_far(axes: Axes, text: str, where: float) -> None:
    """The value of a marker that is drawn at the edge of the axis."""
    look: dict[str, Any] = {"fontsize": 6.5, "ha": "right", "va": "center", "color": "#374151"}
    axes.annotate(text, (LAST_RATIO, where), (-5, 0), textcoords="offset points", **look)


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
    """A logarithmic axis of ratios, with plain numbers, that ends at `LAST_RATIO`."""
    axes.set(xscale="log", xlabel="rms error ÷ least left-out error of any method")
    low, high = axes.get_xlim()
    if high > LAST_RATIO:
        axes.set_xlim(low, 1.1 * LAST_RATIO)
    steps = (1.0, 2.0, 5.0) if high / low > 8 else (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0)
    plots.plain_numbers(axes.xaxis, *(steps if high / low < 1e3 else (1.0,)))


@plots.style()
def draw_stations(comparison: Comparison) -> Figure:
    """Left-out error of every station, an observable in each row and a method in each column."""
    rows = able(comparison.rows)
    names = [name for name in comparison.units if name in rows[0].station_errors]
    label, height = "Left-out error of every station by method", 0.5 + 0.85 * len(names)
    across: dict[str, Any] = {"sharex": True, "gridspec_kw": {"hspace": 0.02, "wspace": 0.02}}
    figure, panels = plots.new_figure(label, height, len(names), len(rows), **across)
    for line, name in zip(panels, names, strict=True):
        unit = comparison.units[name].partition(" ")[0]
        line[0].set_ylabel(f"{TITLES[name]}, {unit}", fontsize=6.5)
        for axes, row in zip(line, rows, strict=True):
            _station_stems(axes, row.station_errors[name], LOOKS[row.method][0])
        _scale(line, [row.station_errors[name] for row in rows], unit)
    for column, row in zip(panels.T, rows, strict=True):
        column[0].set_title(row.method, fontsize=7)
        column[-1].set_xlabel("station, in order", fontsize=6.5)
    return figure


def _station_stems(axes: Axes, values: Array, colour: str) -> None:
    where, heights = _largest(values)
    plots.stems(axes, where, heights, color=colour, lw=0.8 if len(where) < 80 else 0.5)
    axes.axhline(0, color="#4b5563", lw=0.5)
    axes.tick_params(labelsize=6.5, length=2)
    axes.locator_params(nbins=4)
    axes.grid(axis="x", visible=False)


def _scale(panels: Sequence[Axes], errors: Sequence[Array], unit: str) -> None:
    """One scale for the panels of an observable; of much larger errors a panel has its own, and says so."""
    largest = np.array([np.max(np.abs(each[~np.isnan(each)]), initial=0.0) for each in errors])
    alike = largest <= SEPARATE_SCALE * np.min(largest[largest > 0], initial=np.inf)
    common = float(np.max(largest[alike])) or 1.0
    labelled = int(np.argmax(alike))
    for index, (axes, size) in enumerate(zip(panels, largest.tolist(), strict=True)):
        edge = common if alike[index] else size
        axes.set_ylim(-ROOM * edge, (ROOM if alike[index] else ROOM_AND_TEXT) * edge)
        axes.tick_params(labelleft=index == labelled)
        if not alike[index]:
            axes.set_facecolor("#fdf3e2")
            place: dict[str, Any] = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
            text = f"to {number(size)}{spaced(unit)}"
            axes.annotate(text, (1, 1), (-1, -1), **place, **plots.NOTE | {"fontsize": 6.5})


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
    label, height = "Parameters of every method with 1σ", 0.4 + 2.3 * len(triads)
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
    where = np.arange(len(shown))[:, None] + _abreast(rows, 0.15)
    for index, row in enumerate(rows):
        colour, marker = LOOKS[row.method]
        look: dict[str, Any] = {"color": colour, "ms": 3.0, "elinewidth": 0.8, "label": row.method}
        bars = sd[:, index] / unit
        axes.errorbar(where[:, index], difference[:, index], bars, fmt=marker, **look)
        for sign, arrow in ((1, "^"), (-1, "v")):
            far = sign * difference[:, index] > LAST_SIGMA
            edge = np.full(np.count_nonzero(far), 0.96 * sign * LAST_SIGMA)
            axes.plot(where[far, index], edge, arrow, color=colour, ms=4)
    for place, line in zip(where, difference, strict=True):
        _name_outside(axes, place, line)
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, -LAST_SIGMA), min(high, LAST_SIGMA))
    axes.axhline(0, color="#4b5563", lw=0.6, zorder=1)


def _name_outside(axes: Axes, where: Array, difference: Array) -> None:
    """The largest difference of a parameter beyond each edge of the axis, at that edge."""
    for sign, align in ((1, "top"), (-1, "bottom")):
        far = np.nan_to_num(sign * difference)
        worst = int(np.argmax(far))
        if far[worst] > LAST_SIGMA:
            look: dict[str, Any] = {"rotation": 90, "fontsize": 6.5, "ha": "center", "va": align}
            edge = (float(where[worst]), sign * LAST_SIGMA)
            text = number(float(difference[worst]))
            axes.annotate(text, edge, (0, -8 * sign), textcoords="offset points", **look)


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


TABLES = (refusals, errors, measures, effort, undetermined, marks, gauge, parameters_of)
FIGURES = (draw_errors, draw_stations, draw_parameters, draw_course)
"""The functions that the templates call."""
