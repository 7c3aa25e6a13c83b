"""Refusals of noise in a wrong unit, and of fits that it leaves without a valid covariance."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag
from mwdcal.calibration.diagnosis.soundness import invertible, is_covariance, mirrored
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.results import temperature_range
from mwdcal.geometry.vectors import Array, Bools

DECLARED_NOISE = 0.3
"""Declared noise of more than this share of the field at every station is a wrong unit."""
COARSE = (
    "the declared noise of the {triad} is {share:.2g} times the field that it measures, or more. 'noise' and "
    "'repeatability' of [{triad}] in the tool profile and the columns sd_ are in the raw units of the channels, such "
    "as V: correct them, or leave them out and the noise is estimated."
)
"""What is wrong with such a noise, and what to do."""
UNSOUND_ADVICE = (
    "Check 'noise' and 'repeatability' in the tool profile and the columns sd_: all are in the raw units of their "
    "channel; without them the noise is estimated."
)
"""What to do where a fit has no valid covariance."""


def coarse_noise(readings: Readings, triad: str) -> Iterator[Flag]:
    """Declared noise that leaves nothing of the field, on some channel at every station."""
    if triad not in readings.sd:
        return
    values = getattr(readings, triad)
    least = np.broadcast_to(readings.sd[triad], values.shape).min(-2)
    share = least / _strength(values)[:, None]
    coarse = np.any(share > DECLARED_NOISE, -1)
    yield Flag("noise", coarse, COARSE, {"triad": triad, "share": share.max(-1)})


def is_sound(fitted: FittedRuns) -> Bools:
    """Fits (B,) whose covariance is one, and whose gains are such as a sensor has."""
    with np.errstate(all="ignore"):  # of members that earlier refusals hold of
        sound = is_covariance(fitted.covariance.in_file(fitted.profile.reference_temperature_c))
        for slope in _slopes(fitted):
            sound &= invertible(slope) & ~mirrored(slope)
    return sound


def _slopes(fitted: FittedRuns) -> Iterator[Array]:
    """Gains (B, 3, 3, 3) of each triad, at the ends of the calibrated temperatures and the reference."""
    result, zero = fitted.result, fitted.profile.reference_temperature_c
    low, high = temperature_range(result, fitted.options.knowledge)
    at = np.stack([low, high, np.clip(zero, low, high)], -1)
    for triad, where in zip(result.problem.triads, result.problem.slices(), strict=True):
        middle = np.broadcast_to(triad.raw.mean(1, keepdims=True), (*at.shape, 3))
        yield triad.model.slope(result.state.params[:, where], middle, at)


def noise_ranges(result: Fit, place: int) -> str:
    """The smallest and the largest noise of each triad's readings, in words."""
    shares = [triad.sd[place] / _strength(triad.raw[place]) for triad in result.problem.triads]
    return ", ".join(
        f"the {name}'s noise is {share.min():.1g} to {share.max():.1g} of the field"
        for name, share in zip(TRIADS, shares, strict=False)
    )


def _strength(raw: Array) -> Array:
    """Mean strength (...) of readings (..., n, 3), at least 1e-30."""
    return np.asarray(np.maximum(np.linalg.norm(raw, axis=-1).mean(-1), 1e-30))
