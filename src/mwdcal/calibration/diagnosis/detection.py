"""How large an error of one station must be for `calibrate` to report it: reliability after Baarda.

An error δ of a station moves the residuals of all stations by δ times the response to it. The tests of
`calibrate` then follow noncentral χ² distributions, and δ is found at which they exceed their limits
in `POWER` of all runs. Two tests are looked at: that of the single station, which names it
(`residuals.stations_to_remeasure`), and that of all residuals of a triad. The error also widens the residuals of
the others, by which the first is judged: a run of few stations may name none, however large δ is.

Reference: W. Baarda, A testing procedure for use in geodetic networks, Netherlands Geodetic
Commission (1968).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.diagnosis.plausibility import freedom_of
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.record import MISFIT_CHANCE
from mwdcal.calibration.residuals import RESHOOT
from mwdcal.estimation.problem import ANGLES, EARTH
from mwdcal.estimation.uncertainty import TESTED, whole_covariance
from mwdcal.geometry.vectors import Array, eigen, quotient

POWER = 0.8
"""Share of runs in which an error of the stated size is reported."""
REPETITIONS = 60
"""Rounds in which the size of an error and its effect on the other stations are found in turn."""
HIDING_RISE = 0.9
"""An error hides among the other stations where the limit of the test rises by this share of the station's χ²."""


@dataclass(frozen=True)
class Detection:
    """Sizes (B, n) of an error of each station from which it is reported, in radians, g or nT.

    `noticed`: the station is named, or the residuals are. `named`: the station is; infinite where the error
    hides among the others, however large. NaN where the reference is not known.
    """

    noticed: Array
    named: Array


@dataclass(frozen=True)
class _Response:
    """What errors of one unit, of each station in turn, do to whitened residuals.

    `square` (B, n) is the χ² of the station, `others` (B, n) that of all others, and `triads` (B, n, t) the sum of
    squares of each triad.
    """

    square: Array
    others: Array
    triads: Array


def detections(result: Fit) -> dict[str, Detection]:
    """The errors of one station that are reported, by observable: settings of the stand, gravity, field, dip."""
    problem, state = result.problem, result.state
    turns, earth = problem.station_columns(state)
    known = [name for name in EARTH if len(problem.triads) > 1 or name == "gravity"]
    columns = {n: problem.stand_column(state, f"{n}-zero", turns) for n in ANGLES}
    columns |= {name: earth[..., EARTH.index(name)] for name in known}
    by_observable = {}
    for name, column in columns.items():
        given = problem.evidence.is_known(name) & (problem.evidence.include > 0)
        if np.any(given):
            each = _detection(result, _response(result, column))
            by_observable[name] = Detection(*(np.where(given, sd, np.nan) for sd in each))
    return by_observable


def _response(result: Fit, column: Array) -> _Response:
    """The response to errors by whose unit the whitened misfit moves by a `column` (B, n, m)."""
    linear, analysis = result.problem.linear(result.state), result.analysis
    weighed = linear.weighed[..., :-1]
    if analysis.influence is None:
        whole = whole_covariance(linear, analysis.determined)
        unknowns = -np.einsum("bpq,bnmq,bnm->bnp", whole, weighed, column, optimize=True)
    else:
        unknowns = np.einsum("bnpm,bnm->bnp", analysis.influence, column)
    itself = linear.weigh(column[..., None])[..., 0] + np.einsum("bnmp,bnp->bnm", weighed, unknowns)
    values, vectors = eigen(analysis.spread)
    roots = np.sqrt(quotient(np.ones_like(values), values, values > TESTED))
    tests = (vectors * roots[..., None, :]).mT
    seen = tests @ weighed
    square = np.sum((tests @ itself[..., None])[..., 0] ** 2, -1)
    others = _squares(seen, unknowns) - np.sum((seen @ unknowns[..., None])[..., 0] ** 2, -1)
    triads = []
    for first in range(0, weighed.shape[2], 3):
        rows, axes = weighed[:, :, first : first + 3], slice(first, first + 3)
        instead = np.sum((rows @ unknowns[..., None])[..., 0] ** 2, -1)
        triads.append(_squares(rows, unknowns) - instead + np.sum(itself[..., axes] ** 2, -1))
    return _Response(square, np.maximum(others, 0.0), np.maximum(np.stack(triads, -1), 0.0))


def _squares(rows: Array, unknowns: Array) -> Array:
    """Sum of squares (B, n), over all stations' rows (B, n, k, p), that each of unknowns (B, n, p) makes."""
    flat = rows.reshape(len(rows), -1, rows.shape[-1])
    return np.asarray(
        np.einsum("bnp,bpq,bnq->bn", unknowns, flat.mT @ flat, unknowns, optimize=True)
    )


def _detection(result: Fit, response: _Response) -> tuple[Array, Array]:
    """Sizes (B, n) from which an error is noticed, and from which its station is named."""
    from scipy.special import chdtri, chndtrinc

    analysis = result.analysis
    tested = np.sum(eigen(analysis.spread)[0] > TESTED, -1).astype(float)
    rest = tested.sum(-1, keepdims=True) - tested
    with np.errstate(all="ignore"):
        limit = chdtri(tested, RESHOOT / tested.shape[-1])
        rise = limit * response.others / response.square / rest
        hidden = ~(rise < HIDING_RISE)
        needed = chndtrinc(limit, tested, 1 - POWER)
        for _ in range(REPETITIONS):
            wider = limit + np.where(hidden, 0.0, rise) * needed
            needed = chndtrinc(wider, tested, 1 - POWER)
        named = np.where(hidden, np.inf, np.sqrt(needed / response.square))
        freedom = freedom_of(result)[:, None]
        whole = chndtrinc(chdtri(freedom, MISFIT_CHANCE), freedom, 1 - POWER)
        size = np.sqrt(whole * analysis.freedom[:, None] / freedom / response.triads)
    return np.fmin(named, size.min(-1)), named
