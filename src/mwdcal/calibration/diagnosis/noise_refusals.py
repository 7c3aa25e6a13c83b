"""Refusals of noise in a wrong unit, and of fits that it leaves without a valid covariance."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag
from mwdcal.calibration.diagnosis.soundness import invertible, is_covariance, mirrored
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.results import temperature_range
from mwdcal.geometry.vectors import Array

DECLARED_NOISE = 0.3
"""Declared noise of more than this share of the field at every station is a wrong unit."""
UNSOUND_ADVICE = (
    "Check 'noise' and 'repeatability' in the tool profile and the columns sd_: all are in the raw units of their "
    "channel; without them the noise is estimated."
)
"""What to do where a fit has no valid covariance."""


def coarse_noise(readings: Readings, triad: str) -> Flag:
    """Declared noise that leaves nothing of the field, on some channel at every station."""
    values, declared = getattr(readings, triad), readings.sd.get(triad)
    if values is None or declared is None:
        return Flag("noise", np.zeros(len(readings.accelerometer), bool), lambda _: "")
    share = np.broadcast_to(declared, values.shape).min(-2) / _strength(values)[:, None]

    def sentence(place: int) -> str:
        return (
            f"the declared noise of the {triad} is {share[place].max():.2g} times the field that it measures, or more. "
            f"'noise' and 'repeatability' of [{triad}] in the tool profile and the columns sd_ are in the raw units of "
            "the channels, such as V: correct them, or leave them out and the noise is estimated."
        )

    return Flag("noise", np.any(share > DECLARED_NOISE, -1), sentence)


def unsound(fitted: FittedRuns) -> Flag:
    """Fits whose covariance is none, or whose gains are none that a sensor has."""
    result = fitted.result
    with np.errstate(all="ignore"):  # of members that earlier refusals hold of
        sound = is_covariance(fitted.covariance.in_file(fitted.profile.reference_temperature_c))
        for slope in _slopes(fitted):
            sound &= invertible(slope) & ~mirrored(slope)

    def sentence(place: int) -> str:
        triads = zip(TRIADS, result.problem.triads, strict=False)
        parts = [_noise_range(name, triad.sd[place], triad.raw[place]) for name, triad in triads]
        return f"the fit gives no valid covariance, or gains that no sensor has: {', '.join(parts)}. {UNSOUND_ADVICE}"

    return Flag("unsound", ~sound, sentence)


def _slopes(fitted: FittedRuns) -> Iterator[Array]:
    """Gains (B, 3, 3, 3) of each triad, at the ends of the calibrated temperatures and the reference."""
    result, zero = fitted.result, fitted.profile.reference_temperature_c
    low, high = temperature_range(result, fitted.options.knowledge)
    at = np.stack([low, high, np.clip(zero, low, high)], -1)
    for triad, where in zip(result.problem.triads, result.problem.slices(), strict=True):
        middle = np.broadcast_to(triad.raw.mean(1, keepdims=True), (*at.shape, 3))
        yield triad.model.slope(result.state.params[:, where], middle, at)


def _noise_range(name: str, sd: Array, raw: Array) -> str:
    """The smallest and the largest noise of a triad's readings (n, 3), in words."""
    share = sd / _strength(raw)
    return f"the {name}'s noise is {share.min():.1g} to {share.max():.1g} of the field"


def _strength(raw: Array) -> Array:
    """Mean strength (...) of readings (..., n, 3), at least 1e-30."""
    return np.asarray(np.maximum(np.linalg.norm(raw, axis=-1).mean(-1), 1e-30))
