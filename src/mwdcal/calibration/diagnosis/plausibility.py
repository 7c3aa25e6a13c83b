"""How plausible fits are, as arrays with a leading tool axis: refusals and findings put it into words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from functools import cache
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration.automatic.courses import f_test
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import (
    EARTH_RANGES,
    HIGHEST,
    TRIADS,
    Readings,
    direction_numbers,
)
from mwdcal.calibration.record import Calibration, numbers
from mwdcal.calibration.residuals import (
    RESHOOT,
    Residuals,
    chances,
    chances_of_tests,
    chi_chance,
    is_by_left_out,
    left_out_chances,
    left_out_tests,
    stations_to_remeasure,
    tail,
)
from mwdcal.calibration.results import variance_scales
from mwdcal.errors import InputError
from mwdcal.estimation.batch import batch_of_one, take
from mwdcal.estimation.minimisers import closed_form, closed_form_drift
from mwdcal.estimation.problem import STAND_ERRORS, UNKNOWN, Evidence
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import (
    ROTATIONS,
    TESTED,
    Free,
    effective_freedom,
    station_misfit,
    whole_covariance,
)
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    centred,
    diagonal,
    eigen,
    inverse,
    outer,
    over_stations,
    quadratic_form,
    quotient,
)

# --------------------------------------------------------------------------
# What every calibration must be: finite, with a covariance that is one, and in agreement with itself.
#
# The same rules hold for a fit before it is written, as arrays with a leading tool axis, and for a
# calibration file that is read.

LARGEST = 1e30
"""Magnitude that no number of a calibration reaches, nor the inverse of a gain."""
WORST = 1e4
"""Condition number that the gains of a real sensor never reach."""
ASYMMETRY = 1e-6
"""Departure of a correlation matrix from symmetry and from zero eigenvalues that is rounding."""
AGREEMENT = 1e-3
"""Share by which a standard uncertainty may depart from the root of its variance."""
SOURCES = ("declared", "estimated from the residuals")
"""Where the noise of a triad may come from."""


def check(calibration: Calibration, name: str, advice: str) -> None:
    """Refuse a calibration with impossible numbers or parts that do not fit together.

    `name` is that of its file, `advice` what to do about it. Raises `InputError`.
    """
    problem = inconsistency(calibration)
    if problem:
        raise InputError(f"{name}: {problem}. {advice}")


def inconsistency(calibration: Calibration) -> str:
    """The contradictions in a calibration, or empty."""
    rules = (_parts, _numbers, _surroundings, _ranks, _covariance, _gains)
    return next((problem for rule in rules for problem in rule(calibration)), "")


def _parts(calibration: Calibration) -> Iterator[str]:
    """Models that are unknown, and lists of a wrong length: `verify` knows by the stations what the fit has seen."""
    for triad, expected in zip(calibration.triads, TRIADS, strict=False):
        if triad.name != expected:
            yield f"the triad '{triad.name}' stands where the {expected} belongs"
        if triad.model not in ("polynomial", "factors") or not 0 <= triad.order <= HIGHEST:
            yield f"the {triad.name} has the unknown model '{triad.model}' of order {triad.order}"
        if len(triad.centre) != 3 or not 0 < triad.radius < np.inf:
            yield f"the {triad.name} has no usable centre and radius"
        names = triad.functions(calibration.reference_temperature).names
        given = (triad.parameter_names, triad.parameters, triad.standard_uncertainties)
        if list(names) != triad.parameter_names or {len(g) for g in given} != {len(names)}:
            yield f"the parameters of the {triad.name} are not those of its model"
    size = len(calibration.parameters)
    if [len(row) for row in calibration.covariance_rows] != [size] * size:
        yield "parameters and covariance do not fit together"
    if any(len(row) != size for row in calibration.free):
        yield "parameters and undetermined directions do not fit together"
    said, listed = calibration.stations, len(calibration.station_rows)
    if said != listed or said < 1:
        yield f"'stations' is {said}, and 'station_rows' lists {listed}"


def _numbers(calibration: Calibration) -> Iterator[str]:
    """Numbers that are not finite, too large, or negative where none can be."""
    fields = msgspec.to_builtins(calibration)
    if not (np.abs(numbers(fields)) <= LARGEST).all():
        for path, value in _impossible(fields):
            yield f"'{path}' must be a finite number below {LARGEST:g}; got {value:g}"
    for triad in calibration.triads:
        positive = {
            "noise": triad.noise,
            "variance_factor": triad.variance_factor or 0.0,
            "misfit_probability": triad.misfit_probability or 0.0,
            "standard_uncertainties": min(sd or 0.0 for sd in triad.standard_uncertainties),
            "singular_values": min(triad.singular_values, default=0.0),
        }
        for name, value in positive.items():
            if value < 0:
                yield f"'{name}' of the {triad.name} must not be negative; got {value:g}"
        if triad.noise_source not in SOURCES:
            yield f"'noise_source' of the {triad.name} must be one of {', '.join(SOURCES)}; got {triad.noise_source!r}"
        if (triad.misfit_probability or 0.0) > 1:
            yield f"'misfit_probability' of the {triad.name} must be 0…1; got {triad.misfit_probability:g}"


def _impossible(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number with a fraction in a document that cannot be, and where it stands."""
    if isinstance(value, float):
        if not abs(value) <= LARGEST:
            yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _impossible(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _impossible(item, f"{path}[{index}]")


def _surroundings(calibration: Calibration) -> Iterator[str]:
    """A time, temperatures and an earth's field that cannot be."""
    try:
        datetime.fromisoformat(calibration.time)
    except ValueError:
        yield f"'time' must be a date and time of ISO 8601; got {calibration.time[:80]!r}"
    low, high = calibration.temperature_c or (0.0, 0.0)
    if low > high:
        yield f"'temperature_c' must be the lowest and the highest; got {low:g} and {high:g}"
    needed = {"gravity_g", "field", "dip_deg"} if calibration.has_field else {"gravity_g"}
    if not needed <= set(calibration.earth):
        yield f"'earth' must have {', '.join(sorted(needed))}"
    for name in ("gravity_g", "field"):
        if calibration.earth.get(name, 1.0) <= 0:
            yield f"'{name}' of the earth must be more than 0; got {calibration.earth[name]:g}"


def _ranks(calibration: Calibration) -> Iterator[str]:
    """Ranks that are not what the undetermined directions leave."""
    for triad in calibration.triads:
        free = len(triad.undetermined)
        if not 0 <= triad.rank <= triad.size <= len(triad.parameters):
            yield f"rank {triad.rank} and size {triad.size} of the {triad.name} are not those of its parameters"
        if (triad.rank < triad.size) != (free > 0):
            yield (
                f"the {triad.name} has rank {triad.rank} of {triad.size}, and 'undetermined' lists {free} directions"
            )
    each = [len(triad.undetermined) for triad in calibration.triads]
    if not max(each) <= len(calibration.free) <= sum(each):
        yield f"'free' has {len(calibration.free)} directions, and the triads name {' and '.join(map(str, each))}"


def _covariance(calibration: Calibration) -> Iterator[str]:
    """A covariance that is not valid, or not that of the standard uncertainties."""
    covariance = calibration.parameter_covariance
    if not is_covariance(covariance):
        yield (
            "the covariance is not a valid covariance matrix: it is not symmetric, or has negative variances"
        )
    if not covariance.any():
        yield "the covariance is zero everywhere"
    start = 0
    for triad in calibration.triads:
        where = slice(start, start + len(triad.parameters))
        start = where.stop
        if None in triad.standard_uncertainties and not triad.undetermined:
            yield f"the {triad.name} lacks a standard uncertainty, and 'undetermined' names no direction"
        sd = np.array([np.nan if s is None else s for s in triad.standard_uncertainties])
        root = np.sqrt(np.diag(covariance)[where])
        if (np.abs(sd - root) > AGREEMENT * root).any():
            yield f"the standard uncertainties of the {triad.name} are not those of the covariance"


def _gains(calibration: Calibration) -> Iterator[str]:
    """Gains that cannot be inverted or mirror the axes, over the calibrated temperatures."""
    zero = calibration.reference_temperature
    low, high = calibration.temperature_c or (zero, zero)
    temperature = np.array([low, high, min(max(zero, low), high)])
    for triad in calibration.triads:
        middle, params = np.broadcast_to(triad.centre, (3, 3)), np.array(triad.parameters)
        with np.errstate(all="ignore"):
            slope = triad.functions(zero).slope(params, middle, temperature)
        if not invertible(slope):
            yield f"the gains of the {triad.name} cannot be inverted"
        if mirrored(slope):
            yield (
                f"the gains of the {triad.name} turn right-handed axes into left-handed ones, which no sensor "
                "does: one row has the wrong sign, or two are exchanged (correct a wrong axis by 'axes' in the "
                "tool profile)"
            )


def is_covariance(covariance: Array) -> Bools:
    """Which matrices (..., p, p) are finite and symmetric and without negative variances (...)."""
    finite = np.abs(covariance) <= LARGEST
    whole = np.where(finite, covariance, 0.0)
    variances = diagonal(whole)
    scaled = whole / outer(np.sqrt(np.where(variances > 0, variances, 1.0)))
    even = np.all(np.abs(scaled - scaled.mT) <= ASYMMETRY * (1 + np.abs(scaled)), (-1, -2))
    sound = np.all(finite, (-1, -2)) & even & np.all(variances >= 0, -1)
    return np.asarray(sound & _semidefinite(scaled))


def _semidefinite(correlation: Array) -> Bools:
    """Which symmetric matrices (..., p, p) have no negative eigenvalue beyond rounding."""
    half = correlation.shape[-1] // 2
    if (
        half and not correlation[..., :half, half:].any()
    ):  # of two triads that have no error in common
        first, second = correlation[..., :half, :half], correlation[..., half:, half:]
        return _semidefinite(first) & _semidefinite(second)
    lifted = correlation + ASYMMETRY * np.eye(correlation.shape[-1])
    try:
        np.linalg.cholesky(lifted)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(lifted)[..., 0] >= 0)
    return np.ones(correlation.shape[:-2], bool)


def invertible(slope: Array) -> Bools:
    """Which gains (..., k, 3, 3) can be inverted at each of k places (...): finite, of a usual size, no axis lost."""
    finite = np.isfinite(slope)
    largest = np.abs(np.where(finite, slope, 0.0)).max((-1, -2))
    sized = (largest <= LARGEST) & (largest >= 1 / LARGEST)
    usable = np.where(finite & sized[..., None, None], slope, 0.0)
    bound = np.linalg.norm(usable, axis=(-2, -1)) * np.linalg.norm(inverse(usable), axis=(-2, -1))
    fine = bound <= WORST  # no condition number is larger
    if not fine.all():
        fine[~fine] = np.linalg.cond(usable[~fine]) <= WORST
    return np.asarray(np.all(finite, (-1, -2, -3)) & np.all(fine, -1))


def mirrored(slope: Array) -> Bools:
    """Which gains (..., k, 3, 3) turn a right-handed triad into a left-handed one (...)."""
    finite = np.nan_to_num(slope)
    largest = np.abs(finite).max((-2, -1), keepdims=True)
    return np.asarray(np.any(np.linalg.det(finite / np.where(largest > 0, largest, 1.0)) < 0, -1))


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
NEARLY = 0.75
"""Share of its variance from which the noise of the others is worked out exactly."""
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
        middle = np.sort(np.linalg.norm(slope, axis=-1), -1)[..., 1:2]
    return gain, gain / middle


def has_sensor_gains(result: Fit, temperature: Array) -> Bools:
    """Fits (B,) whose gains at temperatures (B, k) are such as a sensor has."""
    problem, gains = result.problem, []
    for triad, where in zip(problem.triads, problem.slices(), strict=True):
        at = temperature if triad.model.varies else temperature[:, :1]
        mean = over_stations(triad.raw)[:, None] / triad.raw.shape[1]
        middle = np.broadcast_to(mean, (*at.shape, 3))
        slope = triad.model.slope(result.state.params[:, where], middle, at)
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
    misfit = float(np.sqrt(_run_variance(result)[0]))
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
    members = np.asarray(stray.any((-1, -2)))
    places = np.flatnonzero(members)
    if places.size:
        members[places] = ~_explained(take(result, places))
    return members


def _explained(result: Fit) -> Bools:
    """Members (B,) that cannot have `excessive_errors`: no station's misfit d² is that large.

    By Schwarz's inequality the square of any error of a station is at most d² times its expectation. Half of the
    limit is left for errors that are not linear in the readings.
    """
    square, tested = station_misfit(result.analysis)
    whole = (tested == result.analysis.residual.shape[-1]).all(-1) & ~robust(result)
    least = EXCESS_RATIO**2 / 2 * _run_variance(result)
    return np.asarray(whole & (square.max(-1) <= least) & (result.analysis.influence is None))


def _run_variance(result: Fit) -> Array:
    """The s² (B,) of all readings of a run together, or one if that is less."""
    factor, freedom = result.analysis.variance_factor, np.maximum(result.analysis.freedom, 0)
    squares = np.sum(np.nan_to_num(factor) * freedom, -1)
    return np.asarray(np.maximum(squares / np.maximum(result.analysis.freedom.sum(-1), 1.0), 1.0))


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


def setting_chances(result: Fit) -> tuple[Array, Array]:
    """Chance (B, s) of so large an error of each setting of the stand as is estimated, and the share that is seen.

    Definition: the estimate z of an error of unit variance, known to v, has the variance 1 - v where all is
    as declared, and the readings alone give z / (1 - v). Settings that nothing tests have a chance of 1.
    """
    settings = result.state.settings
    if not settings.size:
        return np.ones(settings.shape), np.ones(settings.shape)
    linear = result.problem.linear(result.state)
    whole = whole_covariance(linear, result.analysis.determined)
    expected = 1 - diagonal(whole)[:, -settings.shape[-1] :]
    tested = expected > TESTED
    scale = np.maximum(variance_scales(result).max(-1, keepdims=True), 1.0)
    square = quotient(settings**2, expected * scale, tested)
    return tail(square, np.where(tested, 1, 0)), expected


def toolface_agreement(result: Fit, by: str) -> tuple[Array, Ints]:
    """Chance (B,) of errors of toolface that agree so much within groups of stations, and the number of groups.

    Groups are those of one "setting" of the stand, one "direction", or one "toolface".
    Definition: analysis of variance of the estimated errors in units of their σ, which count as independent; 1 where
    the means of groups scatter no more than independent errors of σ would let them.
    Reference: R. A. Fisher, Statistical Methods for Research Workers (1925).
    """
    evidence, errors = result.problem.evidence, result.state.errors[..., 2]
    sd = np.where(evidence.is_known("toolface"), evidence.sd["toolface"], 0.0)
    number = _numbered(evidence, by)
    some = (sd > 0) & (evidence.include > 0) & (number >= 0)
    tools, kinds = len(errors), int(number.max(initial=0)) + 1
    if not some.any():
        return np.ones(tools), np.zeros(tools, int)
    flat, error = (number + kinds * np.arange(tools)[:, None])[some], errors[some] / sd[some]
    count, total, square = (
        np.asarray(np.bincount(flat, w, tools * kinds), float).reshape(tools, kinds)
        for w in (np.ones(error.size), error, error**2)
    )
    several = count > 1
    groups, stations = np.count_nonzero(several, -1), (several * count).sum(-1)
    means = quotient(total**2, count, several)
    grand = quotient((several * total).sum(-1) ** 2, stations, stations > 0)
    between, within = means.sum(-1) - grand, np.sum(several * square - means, -1)
    freedom, rest = np.maximum(groups - 1.0, 0.0), stations - groups
    scatter = np.maximum(quotient(within, rest, rest > 0), 1e-300)
    chance = f_test(between, freedom, scatter, rest)
    return np.where(between > freedom, np.nan_to_num(chance, nan=1.0), 1.0), groups


def _numbered(evidence: Evidence, by: str) -> Ints:
    """Number (B, n) of the stations' "setting" of the stand, "direction" or "toolface"; -1 of a station alone."""
    if by == "setting":
        return evidence.setting
    if by == "direction":
        known = evidence.known_or_zero
        return direction_numbers(known["inclination"], known["azimuth"])
    keys = np.round(evidence.known_or_zero["toolface"], 6)
    alike = bool((keys == keys[:1]).all())
    each = [np.unique(key, return_inverse=True)[1] for key in keys[: 1 if alike else None]]
    return np.broadcast_to(each, keys.shape)


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
    return result.problem.once("to reshoot", result.state, lambda _: _to_reshoot(result))


def _to_reshoot(result: Fit) -> Bools:
    """Stations (B, n) to take again, by the chances of those near the limit."""
    again = np.zeros(result.analysis.residual.shape[:2], bool)
    by_left_out = is_by_left_out(result)
    if by_left_out.any():
        again = _standing_out(result) & by_left_out[:, None]
    some = np.flatnonzero(~by_left_out)
    if some.size:
        part = result if some.size == len(again) else take(result, some)
        places = np.flatnonzero(_suspects(part))
        if places.size:
            part = part if places.size == len(again) else take(part, places)
            again[some[places]] = stations_to_remeasure(chances(part))
    return again


def _standing_out(result: Fit) -> Bools:
    """Stations (B, n) that stand out from the noise that the others show.

    Fisher's F is never as unlikely as χ², which is tried first. Where references are uncertain, or drifts fitted, the
    noise of the others is approximate at first: it is worked out exactly where F with some margin asks for it.
    """
    exact, shape = closed_form.applies(result.problem), result.trust.shape
    tool, station = np.indices(shape).reshape(2, -1)
    chance = RESHOOT / shape[-1]
    limit = likely(3, chance / result.noise.shape[-1])
    out, tests = np.zeros(tool.size, bool), list[tuple[Array, ...]]()
    for square, freedom, variance, rest in left_out_tests(result, tool, station):
        least = variance if exact else NEARLY * variance
        tests.append((square, freedom, least, rest))
        out |= ~(square <= limit * np.nan_to_num(least, nan=1.0))
    some = np.flatnonzero(out)
    few = [tuple(part[some] for part in test) for test in tests]
    some = some[chances_of_tests(few, result.noise[tool[some]]) < chance]
    if some.size and not exact:
        tools, place = np.unique(tool[some], return_inverse=True)
        part = take(result, tools)
        some = some[left_out_chances(part, place, station[some]) < chance]
    again = np.zeros(shape, bool)
    again.reshape(-1)[some] = True
    return again


def _suspects(result: Fit) -> Bools:
    """Members (B,) of which some station's misfit may be too large, where noise is declared, or a fit robust.

    Without robust weights χ² itself must be. It is bounded from above by what
    the trace of the residuals' covariance says, whose eigenvalues are 0…1, then by that of all directions.
    """
    analysis = result.analysis
    residual, spread = analysis.residual, analysis.spread
    size, chance = spread.shape[-1], RESHOOT / len(result.trust[0])
    suspect = np.any(~np.isnan(result.noise), -1) | robust(result)
    smallest = np.trace(spread, axis1=-2, axis2=-1) - (size - 1)
    good = np.sum(residual**2, -1) < likely(size, chance) * smallest
    good &= (smallest > TESTED) & (analysis.influence is None)
    tool, station = np.nonzero(~good & ~suspect[:, None])
    square = quadratic_form(spread[tool, station], residual[tool, station])
    over = ~(square < likely(1, chance))
    tool, station = tool[over], station[over]
    left = residual[None, tool, station]
    some = replace(analysis, residual=left, spread=spread[None, tool, station])
    suspect[tool[tail(*station_misfit(some))[0] < LEEWAY * chance]] = True
    return np.asarray(suspect)


@cache
def likely(freedom: int, chance: float) -> float:
    """A χ² that is exceeded with more than this chance, to 0.1."""
    steps = 0.1 * np.arange(2001.0)
    return float(steps[np.sum(tail(steps, np.full(len(steps), freedom)) > LEEWAY * chance) - 1])
