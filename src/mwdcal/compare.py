"""Every applicable method on the same run, side by side, judged by stations left out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from mwdcal.calibrate import calibrate, with_nonlinearity
from mwdcal.calibration import Calibration, Measures
from mwdcal.core.observables import OBSERVABLES
from mwdcal.core.vectors import Array, centred
from mwdcal.errors import MwdcalError
from mwdcal.estimate import fit
from mwdcal.methods import EVIDENCE
from mwdcal.notation import Notation, convert
from mwdcal.options import Options, Orders
from mwdcal.profile import Profile
from mwdcal.readings import Readings
from mwdcal.residuals import SHOWN, shown_in
from mwdcal.scatter import directions, group_scatter

SCATTER = "scatter within groups"
FOLDS = 8
"""Parts into which the stations are dealt; each is left out once."""
NEAR_BEST = 1.02
"""A simpler preference stands if its held-out error is within this ratio of the best."""


@dataclass(frozen=True)
class Row:
    """One method on the run: what it reached, or why it was refused.

    `in_sample` and `held_out` are root mean square errors by observable in shown units, only
    where the run has references, whichever of them the method used.
    """

    method: str
    refused: str = ""
    ranks: dict[str, tuple[int, int]] = field(default_factory=dict)
    undetermined: tuple[str, ...] = ()
    iterations: int = 0
    seconds: float = 0.0
    in_sample: dict[str, float] = field(default_factory=dict)
    held_out: dict[str, float] = field(default_factory=dict)
    measures: tuple[Measures, ...] = ()
    parameters: dict[str, Notation] = field(default_factory=dict)


@dataclass(frozen=True)
class Comparison:
    """All methods on one run, the units of their errors, and which to use and why."""

    run: str
    stations: int
    units: dict[str, str]
    rows: tuple[Row, ...]
    advice: str


def compare(readings: Readings, profile: Profile, order: Orders = 0) -> Comparison:
    """Calibrate a run by every method and judge each by stations left out of its fit."""
    relative = bool(np.isnan(readings.reference("field")).all())
    names = _referenced(readings)
    units = {name: shown_in(name, relative)[1] for name in names}
    if (readings.groups >= 0).any() and readings.magnetometer is not None:
        units[SCATTER] = "°"
    rows = tuple(_row(readings, profile, method, order, relative) for method in EVIDENCE)
    return Comparison(readings.source, readings.count, units, rows, advice(rows))


def _referenced(readings: Readings) -> list[str]:
    """Observables that have a reference somewhere in the run."""
    magnetic = ("azimuth", "field", "dip")
    usable = [n for n in SHOWN if readings.magnetometer is not None or n not in magnetic]
    return [n for n in usable if not np.isnan(readings.reference(n)).all()]


def _row(readings: Readings, profile: Profile, method: str, order: Orders, relative: bool) -> Row:
    started = time.perf_counter()
    options = with_nonlinearity(Options(method, order=order), profile)
    try:
        made = calibrate(readings, profile, options)
    except MwdcalError as error:
        return Row(method, refused=str(error))
    seconds = time.perf_counter() - started
    whole = fit(readings, options)
    left_out = _left_out(readings, options)
    return Row(
        method,
        ranks={t.name: (t.rank, t.size) for t in made.triads},
        undetermined=tuple(dict.fromkeys(u.id for u in made.undetermined())),
        iterations=int(whole.iterations[0]),
        seconds=seconds,
        in_sample=_summary(readings, *made.fields(readings), relative),
        held_out=_summary(readings, *left_out, relative),
        measures=tuple(made.measures),
        parameters=_parameters(made),
    )


def _parameters(made: Calibration) -> dict[str, Notation]:
    try:
        return convert(made, "factors")
    except MwdcalError:
        return {}


def errors(readings: Readings, g: Array, b: Array) -> dict[str, Array]:
    """Departure (…, n) of each observable from the run's own reference, NaN where there is none.

    Toolface and azimuth are times sin(inclination).
    """
    found = {}
    for name in _referenced(readings):
        observable = OBSERVABLES[name]
        error = observable.value(g, b) - readings.reference(name)
        error = centred(error, observable.period) if observable.period else error
        across = np.sin(OBSERVABLES["inclination"].value(g, b))
        found[name] = error * across if name in ("toolface", "azimuth") else error
    return found


def _summary(readings: Readings, g: Array, b: Array, relative: bool) -> dict[str, float]:
    """Root mean square errors by observable, and the scatter within groups, in shown units."""
    found = errors(readings, g, b)
    factors = {name: shown_in(name, relative)[0] for name in found}
    result = {n: float(np.sqrt(np.nanmean(e**2)) * factors[n]) for n, e in found.items()}
    if (readings.groups >= 0).any() and readings.magnetometer is not None:
        result[SCATTER] = float(np.degrees(group_scatter(directions(g, b), readings.groups)))
    return result


def _left_out(readings: Readings, options: Options) -> tuple[Array, Array]:
    """Vectors (n, 3) of each station from the fit that left its part out."""
    part = np.arange(readings.count) % FOLDS
    include = (np.arange(FOLDS)[:, None] != part).astype(float)
    result = fit(readings, options, include)
    g, b = result.problem.fields(result.state)
    own = np.arange(readings.count)
    return g[part, own], b[part, own]


def score(row: Row, best: dict[str, float]) -> float:
    """Mean ratio of a method's held-out errors to the best of any method."""
    ratios = [row.held_out[n] / value for n, value in best.items() if value > 0]
    return float(np.mean(ratios)) if ratios else float("inf")


def advice(rows: tuple[Row, ...]) -> str:
    """Which method to use on this run, and why."""
    able = [row for row in rows if not row.refused]
    if not able:
        return "no method can calibrate this run: see why each was refused."
    names = able[0].held_out
    best = {n: min(row.held_out[n] for row in able) for n in names}
    scores = {row.method: score(row, best) for row in able}
    winner = min(able, key=lambda row: (len(row.undetermined), scores[row.method]))
    joint = next((row for row in able if row.method == "joint"), None)
    if joint is not None and len(joint.undetermined) <= len(winner.undetermined):
        within = scores["joint"] <= NEAR_BEST * scores[winner.method]
        winner = joint if within else winner
    why = f"{winner.method}: held-out errors {scores[winner.method]:.2f} times the best of each"
    free = f"; leaves {', '.join(winner.undetermined)} undetermined" if winner.undetermined else ""
    others = [
        f"{m} {s:.2f}" for m, s in sorted(scores.items(), key=lambda x: x[1]) if m != winner.method
    ]
    return f"use {why}{free} (others: {', '.join(others)})." if others else f"use {why}{free}."
