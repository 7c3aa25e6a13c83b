"""What the residuals of fits say, as arrays with a leading tool axis: findings put it into words."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.residuals import RESHOOT, chances, chi_chance, tail, to_reshoot
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.problem import Prior
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import TESTED, effective_freedom, station_misfit
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen

NOISE_RATIO = 3.0
"""Residuals of a robust fit that exceed the declared noise this many times are reported."""
CALM_FREEDOM = 12.0
"""Degrees of freedom from which residuals far below the declared noise are no chance."""
MISFIT_CHANCE = 1e-3
"""Chance of so large residuals, or of so large a departure from the prior, below which it is reported."""
LOW_WEIGHT = 0.1
"""A station of less weight than this in a robust fit is reported."""
SCATTER_SHARE = 3e-4
"""A scatter from station to station beyond this share, or radians, is a finding."""
VARIANCE_RIDGE = 1e-9
"""What is added to variances (of whitened readings: 0…1), so that they have an inverse."""
LEEWAY = 1.01
"""A station is suspect already if a bound is as unlikely as this many times the limit."""


def misfit_chances(result: Fit) -> Array:
    """Chance (B, t) of residuals as large as each triad's, if noise and stand are as declared.

    NaN where noise was estimated, nothing is redundant, or station weights hide what is large.
    """
    problem, analysis = result.problem, result.analysis
    freedom = analysis.freedom
    if not closed_form.applies(problem) and analysis.influence is None:
        freedom = effective_freedom(problem, result.state, analysis)
    untested = np.isfinite(result.noise) | unchecked(result) | robust(result)[:, None]
    freedom = np.where(untested, 1.0, freedom)
    return np.where(untested, np.nan, chi_chance(analysis.variance_factor * freedom, freedom))


def robust(result: Fit) -> Bools:
    """Fits (B,) with station weights."""
    return np.asarray((result.trust != 1).any(-1))


def excessive(result: Fit, chance: Array) -> Bools:
    """Triads (B, t) whose residuals noise and stand do not explain, by `misfit_chances`."""
    weighed = robust(result)[:, None] & np.isnan(result.noise) & ~unchecked(result)
    large = weighed & (result.analysis.variance_factor > NOISE_RATIO**2)
    return np.asarray(large | (np.nan_to_num(chance, nan=1.0) < MISFIT_CHANCE))


def calm(result: Fit) -> Bools:
    """Triads (B, t) whose residuals are less than the declared noise over `NOISE_RATIO`."""
    tested = np.isnan(result.noise) & (result.analysis.freedom >= CALM_FREEDOM)
    return np.asarray(tested & (result.analysis.variance_factor < NOISE_RATIO**-2))


def unchecked(result: Fit) -> Bools:
    """Triads (B, t) without redundancy."""
    return np.asarray(result.analysis.freedom < 1)


def copies(result: Fit) -> Bools:
    """Stations (B, n) whose readings are those of an earlier one of the same run, to the last digit."""
    problem = result.problem
    rows = np.concatenate([*(t.raw for t in problem.triads), problem.temperature[..., None]], -1)
    key = np.sort(np.einsum("bnk,k->bn", rows, np.sqrt(2.0 + np.arange(rows.shape[-1]))), -1)
    found = np.zeros(rows.shape[:-1], bool)
    for member in np.flatnonzero(np.any(np.diff(key, axis=-1) == 0, -1)):
        _, first, place = np.unique(rows[member], axis=0, return_index=True, return_inverse=True)
        found[member] = first[place.ravel()] != np.arange(len(found[member]))
    return found


def scattered(result: Fit) -> Bools:
    """Whether (B,) strengths, dip or the directions of groups depart from station to station."""
    sizes = [value.max(-1) for value in result.problem.evidence.scatter.values()]
    return np.asarray(np.max([np.zeros(len(result.status)), *sizes], 0) > SCATTER_SHARE)


def distrusted(result: Fit) -> Bools:
    """Stations (B, n) that a robust fit all but left out."""
    return np.asarray(result.trust < LOW_WEIGHT)


def without_prior(result: Fit) -> Fit:
    """The fit with only those directions determined that the run itself determines."""
    prior = result.problem.prior
    bare = replace(result.problem, prior=Prior(0 * prior.precision, prior.expected))
    determined = Determined.of(bare, result.state)
    return replace(result, problem=bare, analysis=replace(result.analysis, determined=determined))


def departures(result: Fit) -> tuple[Array, Ints]:
    """The χ² (B,) of the departure from the prior, Λd with covariance Λ - ΛCΛ, and its freedom."""
    prior, covariance = result.problem.prior, result.analysis.covariance
    precision, away = prior.precision, result.state.params - prior.expected
    spread = precision - precision @ covariance @ precision
    scale = np.sqrt(np.maximum(np.diagonal(precision, axis1=-2, axis2=-1), 1e-300))
    values, vectors = eigen(spread / (scale[:, :, None] * scale[:, None, :]))
    pull = (precision @ away[..., None])[..., 0] / scale
    along = np.einsum("bij,bi->bj", vectors, pull) ** 2
    tested = values > 1e-6
    square = np.sum(np.where(tested, along / np.where(tested, values, 1.0), 0.0), -1)
    return square, np.sum(tested, -1)


def conflicting(square: Array, freedom: Ints) -> Bools:
    """Whether departures (B,) from the prior are unlikely."""
    return np.asarray(tail(square, np.maximum(freedom, 1)) <= MISFIT_CHANCE)


def stations_to_reshoot(result: Fit) -> Bools:
    """Stations (B, n) to take again: `to_reshoot`, asked only where a bound allows it to be true."""
    found = np.zeros(result.analysis.residual.shape[:2], bool)
    some = np.flatnonzero(_suspects(result))
    if some.size:
        found[some] = to_reshoot(chances(take(result, some)))
    return found


def _suspects(result: Fit) -> Bools:
    """Members (B,) of which some station's misfit may be too large.

    With declared noise and no robust weights χ² itself must be. It is bounded from above by what
    the trace of the residuals' covariance says, whose eigenvalues are 0…1, then by its inverse.
    """
    analysis = result.analysis
    residual, spread = analysis.residual, analysis.spread
    size, chance = spread.shape[-1], RESHOOT / len(result.trust[0])
    found = np.any(~np.isnan(result.noise), -1) | robust(result)
    smallest = np.trace(spread, axis1=-2, axis2=-1) - (size - 1)
    good = np.sum(residual**2, -1) < likely(size, chance) * smallest
    good &= (smallest > TESTED) & (analysis.influence is None)
    tool, station = np.nonzero(~good & ~found[:, None])
    left = residual[tool, station]
    whole = spread[tool, station] + VARIANCE_RIDGE * np.eye(size)
    bound = np.sum(left * np.linalg.solve(whole, left[..., None])[..., 0], -1)
    large = bound > likely(1, chance)
    tool, station, left = tool[large], station[large], left[large]
    some = replace(analysis, residual=left[None], spread=spread[None, tool, station])
    found[tool[tail(*station_misfit(some))[0] < LEEWAY * chance]] = True
    return np.asarray(found)


@cache
def likely(freedom: int, chance: float) -> float:
    """A χ² that is exceeded with more than this chance, to 0.1."""
    steps = 0.1 * np.arange(2001.0)
    return float(steps[np.sum(tail(steps, np.full(len(steps), freedom)) > LEEWAY * chance) - 1])
