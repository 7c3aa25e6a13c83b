"""What a correction in firmware must take, and how far errors of its vectors move the angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.prediction import (
    CORNER_SHARES,
    CORNERS,
    middle_temperature,
    raw_reading,
    readings_at,
)
from mwdcal.calibration.readings import EARTH_RANGES, TRIADS
from mwdcal.calibration.record import MAGNETIC, Calibration, TriadCalibration
from mwdcal.files.contract import TEMPERATURE
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Model

MARGIN_OF_STRENGTH = 1.1
"""A strength may be so many times that of the place of the calibration, and any that the Earth has."""
ANGLES_OUT = ("inclination", "azimuth", "toolface", "magnetic_toolface")
"""Angles of a correction in firmware, in their order; errors of all but the first count by a share."""
SHARE_OF = {"toolface": "gravity", "azimuth": "gravity", "magnetic_toolface": "field"}
"""The vector whose part across the tool axis, as a share of it, weights the error of an angle."""
_HIGHER_TERMS = 1.02
"""What a linear error leaves out, and the steps of the attitudes over which the largest is sought."""
_TURNS = np.radians(np.arange(0, 360, 15))
_ALL_ATTITUDES = np.meshgrid(np.radians([0.5, *range(5, 180, 5), 179.5]), _TURNS, _TURNS)
"""Inclinations, azimuths and toolfaces over which the largest error is sought."""
_WARMTHS = 65


@dataclass(frozen=True)
class WorkingRange:
    """Strengths by triad, lowest and highest temperature, °C, and the raw channels that follow (3,) each."""

    strengths: Mapping[str, float]
    temperatures: tuple[float, float]
    raw: Mapping[str, Array]


def working_range(calibration: Calibration) -> WorkingRange:
    """The range in which a correction by this calibration is used.

    Any strength of the Earth, and 10 % more than where the tool was calibrated; temperatures that `apply` corrects.
    """
    low, high = calibration.temperature_c or (TEMPERATURE.low, TEMPERATURE.high)
    margin = calibration.margin if calibration.temperature_c else 0.0
    ends = (max(low - margin, TEMPERATURE.low), min(high + margin, TEMPERATURE.high))
    strengths = {triad.name: _strength(calibration, triad) for triad in calibration.triads}
    raw = {
        t.name: _largest_raw(calibration, t, strengths[t.name], ends) for t in calibration.triads
    }
    return WorkingRange(strengths, ends, raw)


def _strength(calibration: Calibration, triad: TriadCalibration) -> float:
    """The largest strength, g or nT; of a relative field the ratio of the strongest to the weakest."""
    name = "gravity" if triad.name == TRIADS[0] else "field"
    low, high = EARTH_RANGES[name]
    relative = name == "field" and calibration.relative
    here = calibration.earth["gravity_g" if name == "gravity" else "field"]
    return max(high / low if relative else high, MARGIN_OF_STRENGTH * here)


def _model(calibration: Calibration, triad: TriadCalibration) -> tuple[Model, Array]:
    """A triad's model and its parameters."""
    return triad.functions(calibration.reference_temperature), np.array(triad.parameters)


def _largest_raw(
    calibration: Calibration, triad: TriadCalibration, strength: float, ends: tuple[float, float]
) -> Array:
    """The largest raw value (3,) of each channel over all directions and the temperatures."""
    warmth = np.linspace(*ends, _WARMTHS)[:, None]
    model, params = _model(calibration, triad)
    fields = np.broadcast_to(strength * CORNERS, (_WARMTHS, *CORNERS.shape))
    corners = raw_reading(model, params, fields, np.broadcast_to(warmth, fields.shape[:-1]))
    zero, *axes = np.moveaxis(CORNER_SHARES.transpose() @ corners, -2, 0)
    largest = np.max(np.abs(zero) + np.sqrt(sum(axis**2 for axis in axes)), 0)
    profile = getattr(calibration.profile, triad.name)
    return np.asarray(np.abs(profile.permutation.transpose()) @ largest * (profile.scale or 1.0))


def rounding_errors(calibration: Calibration, work: WorkingRange, share: float) -> list[Array]:
    """Errors (3,) of each triad's vector where every term of it is off by a share of itself."""
    warmth = np.array([middle_temperature(calibration)])
    errors = []
    for triad in calibration.triads:
        profile = getattr(calibration.profile, triad.name)
        raw = np.abs(profile.permutation) @ work.raw[triad.name] / (profile.scale or 1.0)
        model, params = _model(calibration, triad)
        slope = np.abs(model.slope(params, raw[None], warmth)[0])
        zero = np.abs(model.fields(params, np.zeros((1, 3)), warmth)[0])
        errors.append(share * (slope @ raw + 2 * zero + work.strengths[triad.name]))
    return errors


def angle_errors(
    calibration: Calibration, vectors: Sequence[Array], turn: float, read: float
) -> dict[str, float]:
    """Largest errors, degrees, of the angles where the vectors are off by errors (3,), over all attitudes.

    At the gravity, field and dip of the calibration. `turn`: what every direction is off by besides; `read`:
    what an angle is off by when it is written, both in radians. All but the inclination's are multiplied by the
    share of `SHARE_OF`; 180 where nothing is known.
    """
    g, b = calibration.fields(readings_at(calibration, *_ALL_ATTITUDES))
    b = b if calibration.has_field else np.zeros_like(g)
    off = (
        error + turn * np.linalg.norm(vector, axis=-1, keepdims=True)
        for error, vector in zip((*vectors, np.zeros(3)), (g, b), strict=False)
    )
    both, errors = np.concatenate(list(off), -1), {}
    for name in (n for n in ANGLES_OUT if calibration.has_field or n not in MAGNETIC):
        with np.errstate(divide="ignore", invalid="ignore"):  # an angle that does not exist there
            gradient = np.abs(OBSERVABLES[name].gradient(g, b))
            worst = np.nanmax(share(name, g, b) * (np.sum(gradient * both, -1) + turn))
        errors[name] = float(min(_HIGHER_TERMS * np.degrees(worst) + np.degrees(read), 180.0))
    return errors


def share(name: str, g: Array, b: Array) -> Array:
    """The part across the tool axis (...) of the vector that an angle is read from; 1 for inclination."""
    if name not in SHARE_OF:
        return np.ones(g.shape[:-1])
    vector = g if SHARE_OF[name] == "gravity" else b
    return np.asarray(np.hypot(vector[..., 0], vector[..., 1]) / np.linalg.norm(vector, axis=-1))
