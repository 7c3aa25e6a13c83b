"""Methods side by side, on the screen and for machines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Finding, Measures
from mwdcal.comparison.compare import SCALE, Comparison, Row, able
from mwdcal.estimation.uncertainty import ROTATIONS
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.numbers import UNDETERMINED, factor_places, measured, number
from mwdcal.presentation.text import one_line, raised, table
from mwdcal.use.notation import Notation

if TYPE_CHECKING:
    pass

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
        for key, at, axes, power, unit in factor_places(factors[0].values, strength)
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
