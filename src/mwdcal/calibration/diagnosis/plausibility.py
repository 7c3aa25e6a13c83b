"""What a fit may not say, however well it fits: a field that is nowhere on Earth, errors left over.

Functions on arrays with the batch axis first find it, for one run and for a fleet alike; `checks`
puts it into words.
"""

from __future__ import annotations

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import EARTH, Readings
from mwdcal.calibration.residuals import Residuals
from mwdcal.estimation.rank import Free
from mwdcal.geometry.vectors import Array, Bools, centred

BENIGN_DIRECTIONS = ("rotation-x", "rotation-y", "toolface-zero", "scale")
"""Directions that may stay free."""
EXCESS_RATIO = 10.0
"""An error after calibration of more than this many times its expectation is no error of a sensor."""
DIP_CERTAINTY = 4.0
"""Standard uncertainties by which a dip must lie beyond vertical, not to be noise at a pole."""
STRAY_DEVIATIONS = 5.0
"""Standard deviations of one reading's residual from which the errors of a run are looked at."""
SMALLEST_EXPECTATION = 1e-12
"""Expectations below this, in the observable's own unit, are rounding."""


def is_bad(direction: Free) -> bool:
    """Whether a free direction means that the design is too weak."""
    return direction.id.partition("-temperature-")[0] not in BENIGN_DIRECTIONS


def gain_shares(result: Fit, index: int) -> tuple[Array, Array]:
    """Own-axis gains (B, 3) of a triad at the mean temperature, as shares of nominal.

    And as shares of its middle gain, whichever axes that is between, where no scale is known.
    """
    problem = result.problem
    triad, params = problem.triads[index], result.state.params[:, problem.slices()[index]]
    whole = getattr(triad.model, "whole", triad.model)
    varies = bool(triad.model.basis.order) or getattr(whole, "curved", False)
    some = slice(None if varies else 1)
    slope = triad.model.slope(params, triad.raw[:, some], problem.temperature[:, some]).mean(1)
    gain = np.diagonal(slope, axis1=-2, axis2=-1)
    middle = np.median(np.linalg.norm(slope, axis=-1), -1, keepdims=True)
    return gain, gain / middle


def off_earth(result: Fit, name: str, coil: bool) -> Bools:
    """Stations (B, n) with a gravity or field that no place on Earth has, given or estimated.

    A coil may make any field; a field of one is counted in units of itself.
    """
    problem = result.problem
    value = problem.constant(result.state, name)
    if name == "field" and (coil or len(problem.triads) == 1):
        return np.zeros(value.shape, bool)
    low, high = EARTH[name]
    relative = (problem.evidence.known["field"] == 1.0).all(-1, keepdims=True)
    outside = ~((value >= low) & (value <= high)) & (problem.evidence.include > 0)
    return np.asarray(outside & ~(relative & (name == "field")))


def overturned(result: Fit) -> Array:
    """Estimated dip (B,) where it lies beyond vertical, else NaN.

    Definition: with a known azimuth somewhere, north of the field and of the azimuths are then
    opposite. Where no azimuth is known the same field has a dip within ±90° and is not meant.
    """
    problem, found = result.problem, np.full(len(result.status), np.nan)
    if len(problem.triads) == 1:
        return found
    told = problem.evidence.is_known("azimuth").any(-1)
    for index, constant in enumerate(problem.evidence.constants):
        if constant.name != "dip" or not constant.unknown:
            continue
        dip = centred(result.state.constants[:, index], 2 * np.pi)
        sd = np.sqrt(np.nan_to_num(result.analysis.constants[:, index, index]))
        beyond = np.abs(dip) - np.pi / 2 > DIP_CERTAINTY * np.minimum(sd, 1.0)
        found = np.where(told & beyond, dip, found)
    return np.asarray(found)


def excessive_errors(readings: Readings, result: Fit) -> dict[str, tuple[float, float]]:
    """Observables with errors far above what the misfit of the run explains: rms of both.

    Definition: the expectation is that of noise and stand, times the root of the run's own s² where
    that is above one: so are the uncertainties that a calibration states. In a robust fit stations
    count with the pull that they have.
    """
    analysis = result.analysis
    squares = np.nan_to_num(analysis.variance_factor[0]) * np.maximum(analysis.freedom[0], 0)
    misfit = np.sqrt(max(squares.sum() / max(analysis.freedom[0].sum(), 1.0), 1.0))
    residuals, weight = Residuals(readings, result), result.trust[0]
    found = {}
    for name in residuals.names():
        after, expected = residuals.errors(name, residuals.after), residuals.expected(name)
        known = ~np.isnan(after + expected) & (weight > 0)
        if not known.any():
            continue
        both = [
            float(np.sqrt(np.average(e[known] ** 2, weights=weight[known] ** 2)))
            for e in (after, expected)
        ]
        if both[0] > EXCESS_RATIO * max(both[1] * misfit, SMALLEST_EXPECTATION):
            found[name] = (both[0], float(both[1] * misfit))
    return found


def straying(result: Fit) -> Bools:
    """Members (B,) of which a reading is so far off that their errors have to be looked at."""
    analysis = result.analysis
    variance = np.diagonal(analysis.spread, axis1=-2, axis2=-1)
    stray = analysis.residual**2 > STRAY_DEVIATIONS**2 * np.maximum(variance, 1e-30)
    return np.asarray(stray.any((-1, -2)))
