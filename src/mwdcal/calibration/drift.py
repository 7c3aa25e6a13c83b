"""Slow drift within a run: found in the residuals of a fit, and then part of its model.

A run is fitted without drift first. Where its residuals follow the order of the stations more than noise
does, walks of the field and of both triads' offsets are fitted with it, of sizes that the run itself tells.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mwdcal.calibration.automatic.courses import f_test
from mwdcal.calibration.estimate import Fit, Stage, finished, rescaled_noise
from mwdcal.calibration.methods import solve
from mwdcal.calibration.options import Options
from mwdcal.estimation import drift
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.solvers import Status
from mwdcal.geometry.vectors import Array, Bools, Ints

DRIFT_CHANCE = 0.2
"""Chance of residuals that follow the order of stations as much in noise, below which a drift is fitted.

A drift that is not there costs little: its size comes out small. One that is left out costs coverage.
"""
LEAST_STATIONS = 12
"""Fewest stations that can tell a drift from noise."""
def chances(result: Fit) -> Array:
    """Probability (B, t) that noise alone follows the order of stations as the residuals of a triad do.

    The least of those of the walks that act on a triad, times their number.
    """
    scores, analysis = _scores(result), result.analysis
    least = np.ones(analysis.freedom.shape)
    for name, triad in drift.acting(scores.places).items():
        scatter, rest = (x[:, triad] for x in (analysis.variance_factor, analysis.freedom))
        total, mean, square = scores.of_walk(name)
        ratio = np.where(square > 0, mean / np.where(square > 0, square, 1.0), 0.0)
        one = f_test(total * ratio, mean * ratio, np.nan_to_num(scatter), rest)
        one = np.nan_to_num(one, nan=1.0) * (1 + (triad > 0))
        least[:, triad] = np.minimum(least[:, triad], one)
    return least


def _scores(result: Fit) -> drift.WalkScores:
    problem = result.problem
    common = closed_form.applies(problem) and _one_plan(problem)
    return drift.walk_scores(problem, result.state, result.analysis, common)


def _one_plan(problem: Problem) -> bool:
    """Whether all members have the same attitudes, temperatures and stations."""
    evidence = problem.evidence
    arrays = [*evidence.known.values(), evidence.include, problem.temperature]
    return all(np.array_equal(a, np.broadcast_to(a[:1], a.shape), equal_nan=True) for a in arrays)


def drifting(result: Fit, options: Options) -> Bools:
    """Triads (B, t) whose readings drifted within the run."""
    apart = options.robust or options.separate_solver or result.analysis.influence is not None
    found = np.zeros(result.analysis.freedom.shape, bool)
    if apart or result.problem.evidence.include.shape[-1] < LEAST_STATIONS:
        return found
    sound = (result.status == int(Status.OK)) & result.analysis.finite
    found[sound] = chances(result if sound.all() else take(result, np.flatnonzero(sound))) < DRIFT_CHANCE
    return found


def by_drift(result: Fit, options: Options) -> Iterator[tuple[Ints, Fit]]:
    """Members without drift, as they are, and those with a drift of some triads, which is fitted."""
    found = drifting(result, options)
    for triads in np.unique(found, axis=0):
        places = np.flatnonzero((found == triads).all(-1))
        part = result if len(places) == len(found) else take(result, places)
        yield places, with_drift(part, options, triads) if triads.any() else part


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def with_drift(result: Fit, options: Options, triads: Bools) -> Fit:
    """A fit with walks of estimated size that act on some triads (t,), from one without."""
    problem, analysis = result.problem, result.analysis
    declared = np.isnan(result.noise)
    scores = drift.walk_scores(problem, result.state, analysis, common=False)
    scores = scores.of([n for n, t in drift.acting(scores.places).items() if triads[t]])
    theta, left = drift.walk_variances(scores, analysis.variance_factor, analysis.freedom, declared)
    sizes = dict(zip(scores.places, np.sqrt(theta.T), strict=True))
    sizes = {name: size * drift.noise(problem)[name] for name, size in sizes.items()}
    problem = rescaled_noise(problem, np.sqrt(left))
    problem, state = drift.with_walks(problem, result.state, sizes)
    solved = solve(problem, state, options)
    stage = Stage(problem, solved, result.trust, solved.iterations)
    finite = result.status != int(Status.NOT_FINITE)
    return finished(stage, options, finite, result.iterations + solved.iterations)
