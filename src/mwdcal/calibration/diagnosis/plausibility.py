"""How plausible fits are, as arrays with a leading tool axis: refusals and findings put it into words."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from mwdcal.calibration.diagnosis.soundness import invertible, mirrored
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import EARTH_RANGES, Readings
from mwdcal.calibration.residuals import (
    RESHOOT,
    Residuals,
    chances,
    chi_chance,
    stations_to_remeasure,
    tail,
)
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.batch import batch_of_one, take
from mwdcal.estimation.evidence import STAND_ERRORS, UNKNOWN
from mwdcal.estimation.minimisers import closed_form, closed_form_drift
from mwdcal.estimation.rank import Free
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import (
    ROTATIONS,
    TESTED,
    effective_freedom,
    station_misfit,
    whole_covariance,
)
from mwdcal.geometry.vectors import Array, Bools, Ints, centred, diagonal, eigen, outer, quotient

BENIGN_DIRECTIONS = (*ROTATIONS, "scale")
"""Directions that may stay free."""
EXCESS_RATIO = 10.0
"""An error after calibration of more than this many times its expectation is not a sensor's."""
LOOSE = 0.1
"""A turn known no better than this share of no knowledge at all is not separated."""
DIP_CERTAINTY = 4.0
"""Standard uncertainties by which a dip must lie beyond vertical, not to be noise at a pole."""
STRAY_DEVIATIONS = 5.0
"""Standard deviations of one reading's residual from which the errors of a run are looked at."""
SMALLEST_EXPECTATION = 1e-12
"""Expectations below this, in the unit of the observable, are rounding."""
NOISE_RATIO = 3.0
"""Residuals of a robust fit that exceed the declared noise this many times are reported."""
LEEWAY = 1.01
"""A station is suspect already if a bound is as unlikely as this many times the limit."""


def is_bad(direction: Free) -> bool:
    """Whether a free direction means that the design is too weak."""
    return direction.id.partition("-temperature-")[0] not in BENIGN_DIRECTIONS


def gain_shares(result: Fit, index: int) -> tuple[Array, Array]:
    """Own-axis gains (B, 3) of a triad at the mean temperature, as shares of nominal.

    And as shares of its middle gain, whichever axes that is between, where no scale is known.
    """
    problem = result.problem
    triad, params = problem.triads[index], result.state.params[:, problem.slices()[index]]
    some = slice(None if triad.model.varies else 1)
    slope = triad.model.slope(params, triad.raw[:, some], problem.temperature[:, some]).mean(1)
    gain = diagonal(slope)
    with np.errstate(over="ignore"):  # an infinite gain has no shares
        middle = np.median(np.linalg.norm(slope, axis=-1), -1, keepdims=True)
    return gain, gain / middle


def has_sensor_gains(result: Fit, temperature: Array) -> Bools:
    """Fits (B,) whose gains at temperatures (B, k) are such as a sensor has."""
    problem, gains = result.problem, []
    for triad, where in zip(problem.triads, problem.slices(), strict=True):
        middle = np.broadcast_to(triad.raw.mean(1, keepdims=True), (*temperature.shape, 3))
        slope = triad.model.slope(result.state.params[:, where], middle, temperature)
        gains.append(invertible(slope) & ~mirrored(slope))
    return np.asarray(np.all(gains, 0))


def off_earth(result: Fit, name: str, coil: bool) -> Bools:
    """Stations (B, n) with a gravity or field that no place on Earth has, given or estimated.

    A coil may make any field; a field of one is counted in units of itself.
    """
    problem = result.problem
    value = problem.constant(result.state, name)
    if name == "field" and (coil or len(problem.triads) == 1):
        return np.zeros(value.shape, bool)
    low, high = EARTH_RANGES[name]
    relative = (problem.evidence.known["field"] == 1.0).all(-1, keepdims=True)
    outside = ~((value >= low) & (value <= high)) & (problem.evidence.include > 0)
    return np.asarray(outside & ~(relative & (name == "field")))


def overturned(result: Fit) -> Array:
    """Estimated dip (B,) where it lies beyond vertical, else NaN.

    Definition: with a known azimuth somewhere, north of the field and of the azimuths are then
    opposite. Where no azimuth is known the same field has a dip within ±90° and is not meant.
    """
    problem, dips = result.problem, np.full(len(result.status), np.nan)
    if len(problem.triads) == 1:
        return dips
    referenced = problem.evidence.is_known("azimuth").any(-1)
    constants = enumerate(problem.evidence.constants)
    for index in [place for place, c in constants if c.name == "dip" and c.unknown]:
        dip = centred(result.state.constants[:, index], 2 * np.pi)
        variance = np.nan_to_num(result.analysis.constants[:, index, index])
        sd = np.sqrt(np.maximum(variance, 0.0))  # by rounding it may be below
        beyond = np.abs(dip) - np.pi / 2 > DIP_CERTAINTY * np.minimum(sd, 1.0)
        dips = np.where(referenced & beyond, dip, dips)
    return np.asarray(dips)


def inseparable(result: Fit) -> Bools:
    """Fits (B,) whose stand errors the stations cannot separate from errors of the sensors.

    One of these is as good as unknown, or the rank is higher without them.
    """
    constants = result.problem.evidence.constants
    stand = np.array([c.unknown and c.name in STAND_ERRORS for c in constants])
    with np.errstate(invalid="ignore"):  # by rounding it may be below zero
        sd = np.sqrt(diagonal(result.analysis.constants)[:, stand])
    lost = np.any(sd > LOOSE * UNKNOWN, -1)
    some = np.flatnonzero(~lost & ~result.analysis.determined.keep.all(-1))
    if some.size:
        problem, state = take((result.problem, result.state), some)
        kept = np.flatnonzero(~stand)
        fewer = tuple(problem.evidence.constants[index] for index in kept)
        bare = replace(problem, evidence=replace(problem.evidence, constants=fewer))
        still = replace(state, constants=state.constants[:, kept])
        lost[some] = Determined.of(problem, state).rank < Determined.of(bare, still).rank
    return np.asarray(lost)


def excessive_errors(readings: Readings, result: Fit) -> dict[str, tuple[float, float]]:
    """Observables with errors far above what the misfit of the run explains: rms of both.

    Definition: the expectation is that of noise and stand, times the root of the run's s² where
    that is above one: so are the uncertainties that a calibration states. In a robust fit stations
    count with the pull that they have. A drift within the run that is part of the fit is no error here.
    """
    analysis = result.analysis
    squares = np.nan_to_num(analysis.variance_factor[0]) * np.maximum(analysis.freedom[0], 0)
    misfit = np.sqrt(max(squares.sum() / max(analysis.freedom[0].sum(), 1.0), 1.0))
    residuals, weight = Residuals(batch_of_one(readings), result), result.trust[0]
    excessive = {}
    for name, [after] in residuals.errors(residuals.undrifted).items():
        [expected] = residuals.expected[name]
        known = ~np.isnan(after + expected) & (weight > 0)
        if not known.any():
            continue
        square = np.stack([after, expected], -1)[known] ** 2
        rms = np.sqrt(np.average(square, axis=0, weights=weight[known] ** 2)) * [1.0, misfit]
        if rms[0] > EXCESS_RATIO * max(rms[1], SMALLEST_EXPECTATION):
            excessive[name] = (float(rms[0]), float(rms[1]))
    return excessive


def straying(result: Fit) -> Bools:
    """Members (B,) of which a reading is so far off that their errors have to be looked at."""
    analysis = result.analysis
    variance = diagonal(analysis.spread)
    stray = analysis.residual**2 > STRAY_DEVIATIONS**2 * np.maximum(variance, 1e-30)
    return np.asarray(stray.any((-1, -2)))


def freedom_of(result: Fit) -> Array:
    """Degrees of freedom (B, t) of the χ² that the s² of each triad follows."""
    analysis = result.analysis
    if closed_form.applies(result.problem) or analysis.influence is not None:
        return analysis.freedom
    if closed_form_drift.applies(result.problem):
        return closed_form_drift.effective_freedom(result.problem, analysis)
    return effective_freedom(result.problem, result.state, analysis)


def misfit_chances(result: Fit, freedom: Array | None = None, small: bool = False) -> Array:
    """Chance (B, t) of residuals as large as each triad's, or as `small`, if noise and stand are as declared.

    NaN where noise was estimated, nothing is redundant, or station weights hide what is large.
    """
    freedom = freedom_of(result) if freedom is None else freedom
    untested = np.isfinite(result.noise) | unchecked(result) | robust(result)[:, None]
    freedom = np.where(untested, 1.0, freedom)
    square = result.analysis.variance_factor * freedom
    return np.where(untested, np.nan, chi_chance(square, freedom, small))


def setting_chances(result: Fit) -> Array:
    """Chance (B, s) of so large an error of each setting of the stand as is estimated.

    Definition: the estimate z of an error of unit variance, known to v, has the variance 1 - v where all is
    as declared. Settings that nothing tests have a chance of 1.
    """
    settings = result.state.settings
    if not settings.size:
        return np.ones(settings.shape)
    linear = result.problem.linear(result.state)
    whole = whole_covariance(linear, result.analysis.determined)
    expected = 1 - diagonal(whole)[:, -settings.shape[-1] :]
    tested = expected > TESTED
    scale = np.maximum(variance_scales(result).max(-1, keepdims=True), 1.0)
    square = quotient(settings**2, expected * scale, tested)
    return tail(square, np.where(tested, 1, 0))


def robust(result: Fit) -> Bools:
    """Fits (B,) with station weights."""
    return np.asarray((result.trust != 1).any(-1))


def unchecked(result: Fit) -> Bools:
    """Triads (B, t) without redundancy."""
    return np.asarray(result.analysis.freedom < 1)


def departures(result: Fit) -> tuple[Array, Ints]:
    """The χ² (B,) of the departure from the prior, Λd with covariance Λ - ΛCΛ, and its freedom."""
    prior, covariance = result.problem.prior, result.analysis.covariance
    precision, away = prior.precision, result.state.params - prior.expected
    spread = precision - precision @ covariance @ precision
    scale = np.sqrt(np.maximum(diagonal(precision), 1e-300))
    values, vectors = eigen(spread / outer(scale))
    pull = (precision @ away[..., None])[..., 0] / scale
    along = np.einsum("bij,bi->bj", vectors, pull) ** 2
    tested = values > 1e-6
    return quotient(along, values, tested).sum(-1), np.sum(tested, -1)


def stations_to_reshoot(result: Fit) -> Bools:
    """Stations (B, n) to take again: `stations_to_remeasure`, evaluated only where a bound allows it to be true."""
    again = np.zeros(result.analysis.residual.shape[:2], bool)
    some = np.flatnonzero(_suspects(result))
    if some.size:
        part = result if some.size == len(again) else take(result, some)
        again[some] = stations_to_remeasure(chances(part))
    return again


def _suspects(result: Fit) -> Bools:
    """Members (B,) of which some station's misfit may be too large.

    With declared noise and no robust weights χ² itself must be. It is bounded from above by what
    the trace of the residuals' covariance says, whose eigenvalues are 0…1.
    """
    analysis = result.analysis
    residual, spread = analysis.residual, analysis.spread
    size, chance = spread.shape[-1], RESHOOT / len(result.trust[0])
    suspect = np.any(~np.isnan(result.noise), -1) | robust(result)
    smallest = np.trace(spread, axis1=-2, axis2=-1) - (size - 1)
    good = np.sum(residual**2, -1) < likely(size, chance) * smallest
    good &= (smallest > TESTED) & (analysis.influence is None)
    tool, station = np.nonzero(~good & ~suspect[:, None])
    left = residual[None, tool, station]
    some = replace(analysis, residual=left, spread=spread[None, tool, station])
    suspect[tool[tail(*station_misfit(some))[0] < LEEWAY * chance]] = True
    return np.asarray(suspect)


@cache
def likely(freedom: int, chance: float) -> float:
    """A χ² that is exceeded with more than this chance, to 0.1."""
    steps = 0.1 * np.arange(2001.0)
    return float(steps[np.sum(tail(steps, np.full(len(steps), freedom)) > LEEWAY * chance) - 1])
