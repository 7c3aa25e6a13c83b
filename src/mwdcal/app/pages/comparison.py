"""Methods side by side: as text, as JSON, as one HTML file that needs nothing else, and its figures.

Every method has a colour and a marker of its own, the same in all figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.app.pages.page import environment, factor_places, measured, number
from mwdcal.app.text import one_line, raised, superscript, table
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.readings import SIMULATED
from mwdcal.comparison.common_gauge import SCALE
from mwdcal.comparison.compare import Comparison, Row, able
from mwdcal.estimation.uncertainty import ROTATIONS
from mwdcal.geometry.vectors import Array
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATISTICS = (("mean", "mean"), ("STD", "std"), ("MSE", "mse"), ("RMSE", "rmse"))
MARK = "*"
"""Behind a figure that rests on a convention."""
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#4b5563")
MARKERS = ("o", "s", "^", "x", "D", "v")
LOOKS = dict(zip(EVIDENCE, zip(COLOURS, MARKERS, strict=True), strict=True))
MOST_STATIONS = 240
"""A longer run shows the largest error of each of so many equal parts of it."""
Line = tuple[str, str, list[str]]
"""A row of a table: what, its unit, and a cell for each column."""


def text(comparison: Comparison, parameters: bool = False) -> str:
    """The advice, errors and residual statistics of every method, and why some were refused."""
    rows = able(comparison.rows)
    methods = [row.method for row in rows]
    simulated = [SIMULATED] if comparison.simulated else []
    lines = [one_line("   ".join([*heading(comparison), *simulated])), one_line(comparison.advice)]
    if rows:
        lines += ["", _table(figures(comparison), ["", "before", *methods]), ""]
    lines += map(one_line, notes(comparison))
    lines += [f"{who} refused: {one_line(why)}" for who, why in refusals(comparison)]
    if parameters and rows:
        lines += ["", gauge(comparison) + " In parentheses: 1σ of the last digits."]
        for name, stated in parameter_pairs(comparison).items():
            joined = [
                (what, unit, [_joined(*pair) for pair in pairs]) for what, unit, pairs in stated
            ]
            lines += ["", _table(joined, [name, *methods])]
    return "\n".join(lines)


def refusals(comparison: Comparison) -> list[tuple[str, str]]:
    """Who was refused, and why: once where all methods were for the same reason."""
    refused = [(row.method, row.refused) for row in comparison.rows if row.refused]
    reasons = {why for _, why in refused}
    if len(refused) == len(comparison.rows) > 1 and len(reasons) == 1:
        return [("every method", reasons.pop())]
    return refused


def _table(lines: list[Line], header: list[str]) -> str:
    return table([[f"{what}, {unit}" if unit else what, *c] for what, unit, c in lines], header)


def _joined(value: str, sd: str) -> str:
    """1σ in parentheses, in units of the last digit of the value: 2.93051(10)."""
    if sd == "undetermined":
        return sd
    digits, power = (text.partition("×") for text in (sd, value))
    short = digits[0].replace(".", "").lstrip("0") or "0"
    return f"{power[0]}({short}){''.join(power[1:])}"


def heading(comparison: Comparison) -> list[str]:
    """What was compared, and how."""
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


def figures(comparison: Comparison) -> list[Line]:
    """All figures of the nominal tool ("before"), then of every method."""
    if not able(comparison.rows):
        return []
    lines: list[Line] = []
    for kind, how in (("held_out", "left out"), ("in_sample", "in sample")):
        lines += [(f"{what}, rms {how}", unit, c) for what, unit, c in errors(comparison, kind)]
    return [*lines, *measures(comparison), *effort(comparison)]


def errors(comparison: Comparison, kind: str) -> list[Line]:
    """Root mean square errors by observable: `kind` "held_out" or "in_sample"."""
    lines = []
    for name, unit in comparison.units.items():
        cells = [
            number(getattr(row, kind)[name]) + MARK * (name in row.resting)
            for row in able(comparison.rows)
        ]
        before = number(comparison.before[name])
        lines.append((plots.TITLES.get(name, name), unit, [before, *cells]))
    return lines


def measures(comparison: Comparison) -> list[Line]:
    """Moradi's four measures of the vector error by triad, and the last of them left out."""
    lines: list[Line] = []
    for before in comparison.measures_before:
        name = f"{before.triad} |e|"
        for what, key in STATISTICS:
            cells = [_measure(row, before.triad, "after", key) for row in able(comparison.rows)]
            lines.append((f"{name}, {what}", "", [number(getattr(before, key)), *cells]))
        cells = [_measure(row, before.triad, "left out", "rmse") for row in able(comparison.rows)]
        lines.append((f"{name}, RMSE left out", "", ["", *cells]))
    return lines


def _measure(row: Row, triad: str, when: str, key: str) -> str:
    values = [getattr(m, key) for m in row.measures if (m.triad, m.when) == (triad, when)]
    rank, size = row.ranks[triad]
    return number(values[0] if values else None) + MARK * (rank < size)


def effort(comparison: Comparison) -> list[Line]:
    """Rank, iterations and time."""
    rows = able(comparison.rows)
    lines = [
        (f"rank, {triad}", "", ["", *("{} of {}".format(*row.ranks[triad]) for row in rows)])
        for triad in rows[0].ranks
    ]
    if any(row.lost for row in rows):
        lines.append(("stations no fit could judge", "", ["", *(str(row.lost) for row in rows)]))
    lines.append(("iterations", "", ["", *(str(row.iterations) for row in rows)]))
    return [*lines, ("time of one fit", "s", ["", *(f"{row.seconds:.2f}" for row in rows)])]


def notes(comparison: Comparison) -> list[str]:
    """What each method leaves free, and what the tables mean."""
    rows = able(comparison.rows)
    lines = [
        f"{row.method} leaves undetermined: {', '.join(row.undetermined)}"
        for row in rows
        if row.undetermined
    ]
    if comparison.measures_before and rows:
        lines.append("|e|: length of the vector error, as a share of the reference vector (Moradi)")
    if any(MARK in cell for *_, cells in figures(comparison) for cell in cells):
        lines.append(f"{MARK} rests on a direction that the method leaves free: kept at nominal")
    return lines


def gauge(comparison: Comparison) -> str:
    """The convention that all parameters were brought to, in words."""
    meaning = "Factors of the raw channels (u = V / SF - B, field = P (1 - m) u)"
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


Pairs = tuple[str, str, list[tuple[str, str]]]
"""A parameter, its unit, and each method's value and 1σ as text."""


def parameter_pairs(comparison: Comparison) -> dict[str, list[Pairs]]:
    """Parameters of every method by triad; last what was taken out of them."""
    result = {}
    for triad in able(comparison.rows)[0].parameters:
        result[triad] = [
            (place.title, place.unit, [measured(*place.of(row)) for row in able(comparison.rows)])
            for place in places(comparison, triad)
        ]
    return result


def document(comparison: Comparison) -> dict[str, Any]:
    """The result for machines, without the errors of single stations."""
    shown: dict[str, Any] = msgspec.to_builtins(comparison, enc_hook=np.ndarray.tolist)
    for row in shown["rows"]:
        del row["station_errors"], row["course"]
    del shown["labels"]
    return shown


def render(
    comparison: Comparison, profile: str = "", run_sha256: str = "", profile_sha256: str = ""
) -> str:
    """The comparison as HTML, with the name of its tool profile and the SHA-256 of its sources."""
    template = environment().get_template("comparison.html")
    trace = [
        ("run file", comparison.run, run_sha256),
        ("tool profile", profile, profile_sha256),
        ("software", f"mwdcal {__version__}, seed of the swarm {comparison.seed}", ""),
    ]
    rows = able(comparison.rows)
    headline, _, why = comparison.advice.partition(": ")
    return template.render(
        result=comparison,
        simulated=comparison.simulated,
        headline=headline,
        why=why,
        rows=rows,
        refused=refusals(comparison),
        heading=heading(comparison)[1:],
        errors=[errors(comparison, kind) for kind in ("held_out", "in_sample")] if rows else [],
        measures=measures(comparison) if rows else [],
        effort=effort(comparison) if rows else [],
        notes=notes(comparison),
        gauge=gauge(comparison),
        parameters=parameter_pairs(comparison) if rows else {},
        figures=figures_of(comparison) if rows else {},
        limit=MOST_STATIONS,
        trace=trace,
    )


def figures_of(comparison: Comparison) -> dict[str, Figure]:
    """All figures that the run gives anything for."""
    drawn = {
        "errors": draw_errors(comparison),
        "stations": draw_stations(comparison),
        "parameters": draw_parameters(comparison),
    }
    if any(row.course for row in comparison.rows):
        drawn["course"] = draw_course(comparison)
    return drawn


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


def places(comparison: Comparison, triad: str) -> list[Place]:
    """The parameters of a triad: its factors, then what was taken out of them."""
    strength = "g" if triad == "accelerometer" else "nT" if "field" in comparison.units else ""
    units = {"SF": f"raw/{strength}" if strength else "raw", "B": strength, "m": ""}
    result = []
    for key, at, axes, power in factor_places(able(comparison.rows)[0].parameters[triad].values):
        title, unit = f"{key} {axes}{raised('·τ', power)}", units[key] + raised("/°C", power)
        result.append(Place(triad, title, unit, key, at))
    for name in comparison.gauge.get(triad, []):
        if name == SCALE:
            result.append(Place(triad, name, "", name, (0,)))
        else:
            result.append(Place(triad, name, "°", "rotation_deg", (ROTATIONS.index(name),)))
    return result


@plots.styled
def draw_errors(comparison: Comparison) -> Figure:
    """Left-out error of every observable and method over the best of any; hollow: in sample."""
    rows, names = able(comparison.rows), list(comparison.units)
    figure = plots.new_figure(
        "Left-out error of every method and observable", 0.75 + 0.36 * len(names)
    )
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
    return figure


def _best(rows: Sequence[Row], name: str) -> float:
    """The least left-out error of any method."""
    best = float(np.fmin.reduce([row.held_out[name] for row in rows]))
    return best if best > 0 else float("nan")


def _legend(figure: Any) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))


def _ratio_axis(axes: Axes) -> None:
    """A logarithmic axis of ratios, with plain numbers."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    steps = (1.0, 2.0, 5.0) if high / low > 8 else (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0)
    plots.plain_numbers(axes.xaxis, *(steps if high / low < 1e3 else (1.0,)))


@plots.styled
def draw_stations(comparison: Comparison) -> Figure:
    """Left-out error of every station, an observable in each row and a method in each column."""
    rows = able(comparison.rows)
    names = [name for name in comparison.units if name in rows[0].station_errors]
    figure = plots.new_figure("Left-out error of every station by method", 0.5 + 0.85 * len(names))
    panels = figure.subplots(
        len(names), len(rows), sharex=True, sharey="row", squeeze=False,
        gridspec_kw={"hspace": 0.02, "wspace": 0.02},
    )  # fmt: skip
    for line, name in zip(panels, names, strict=True):
        unit = comparison.units[name].partition(" ")[0]
        line[0].set_ylabel(f"{plots.TITLES[name]}, {unit}", fontsize=6.5)
        for axes, row in zip(line, rows, strict=True):
            _station_stems(axes, row.station_errors[name], LOOKS[row.method][0])
    for axes, row in zip(panels[0], rows, strict=True):
        axes.set_title(row.method, fontsize=7, color=LOOKS[row.method][0])
    for axes in panels[-1]:
        axes.set_xlabel("station, in order", fontsize=6.5)
    return figure


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


@plots.styled
def draw_parameters(comparison: Comparison) -> Figure:
    """Parameters with 1σ, less those of the first method, in units of its own 1σ."""
    rows = able(comparison.rows)
    triads = list(rows[0].parameters)
    figure = plots.new_figure("Parameters of every method with 1σ", 0.4 + 2.0 * len(triads))
    panels = figure.subplots(len(triads), 1, squeeze=False)[:, 0]
    for axes, triad in zip(panels, triads, strict=True):
        _differences(axes, rows, places(comparison, triad))
        axes.set_title(triad)
        axes.set_ylabel(f"less {rows[0].method}, in its 1σ")
    _legend(figure)
    return figure


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


@plots.styled
def draw_course(comparison: Comparison) -> Figure:
    """The swarm's cost over its iterations: its excess over the least, as a share of it."""
    from matplotlib.ticker import NullFormatter

    row = next(row for row in comparison.rows if row.course)
    figure = plots.new_figure("Excess of the swarm's cost over its iterations", 1.7)
    axes = figure.subplots()
    for (name, excess), line in zip(row.course.items(), ("-", "--"), strict=False):
        shown = np.where(excess > 1e-13, excess, np.nan)
        axes.plot(np.arange(1, len(excess) + 1), shown, line, color=LOOKS["swarm"][0], label=name)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"10{superscript(round(np.log10(value)))}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(0, len(excess))
    axes.set_xlabel("iteration")
    axes.set_ylabel("cost ÷ least cost − 1")
    axes.legend(loc="upper right")
    return figure
