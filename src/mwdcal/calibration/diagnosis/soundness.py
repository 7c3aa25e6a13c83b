"""What every calibration must be: finite, with a covariance that is one, and in agreement with itself.

The same rules hold for a fit before it is written, as arrays with a leading tool axis, and for a
calibration file that is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration.canonical import numbers
from mwdcal.calibration.readings import HIGHEST, TRIADS
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array, Bools, diagonal, outer

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
    """The contradictions in a calibration; empty if there are none."""
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
    """A covariance that is none, or not that of the standard uncertainties."""
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
    condition = np.linalg.cond(np.where(finite & sized[..., None, None], slope, 0.0))
    return np.asarray(np.all(finite, (-1, -2, -3)) & np.all(condition <= WORST, -1))


def mirrored(slope: Array) -> Bools:
    """Which gains (..., k, 3, 3) turn a right-handed triad into a left-handed one (...)."""
    finite = np.nan_to_num(slope)
    largest = np.abs(finite).max((-2, -1), keepdims=True)
    return np.asarray(np.any(np.linalg.det(finite / np.where(largest > 0, largest, 1.0)) < 0, -1))
