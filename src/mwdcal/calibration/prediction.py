"""What a calibration promises: readings at a wanted attitude, and 1σ over the attitude sphere.

Everything here is of the calibration at the run's mean gravity, field and dip
(`Calibration.earth`). Angles are radians, shapes broadcast; no drawing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.geometry.vectors import Array, ArrayLike, reference_vectors

ANGLES = ("inclination", "toolface", "azimuth")
TOOLFACES = np.arange(12) * np.pi / 6
"""Toolfaces over which an uncertainty is averaged (root mean square)."""
TYPICAL = np.radians(45)
"""The inclination that stands for a tool's accuracy where one number must do."""
_STEPS = 8


def angles(calibration: Calibration) -> tuple[str, ...]:
    """Names of the angles that the calibrated triads can give."""
    return ANGLES if calibration.has_field else ANGLES[:2]


def middle_temperature(calibration: Calibration) -> float:
    """The reference temperature, moved into the calibrated range where it lies outside, °C."""
    low, high = calibration.temperature_c or (-np.inf, np.inf)
    return float(np.clip(calibration.reference_temperature, low, high))


def readings_at(
    calibration: Calibration,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    toolface: ArrayLike,
    temperature: float | None = None,
) -> Readings:
    """The readings (…, n) that this calibration turns into given attitudes (…, n).

    Units: radians; °C, by default `middle_temperature`. Singular: nowhere; a vertical tool
    reads a definite vector. Reference: the sensor model inverted by Newton steps, one of
    which is exact unless an axis is curved.
    """
    inc, azi, face = np.broadcast_arrays(inclination, azimuth, toolface)
    earth = calibration.earth
    dip = np.radians(earth.get("dip_deg", 0.0))
    strength = earth.get("field", 1.0)
    g, b = reference_vectors(inc, azi, face, earth["gravity_g"], strength, dip)
    at = middle_temperature(calibration) if temperature is None else temperature
    warmth = np.full(g.shape[:-1], at)
    reference = calibration.reference_temperature
    magnetometer = calibration.magnetometer
    return Readings(
        accelerometer=_inverse(calibration.accelerometer, reference, g, warmth),
        magnetometer=None if magnetometer is None else _inverse(magnetometer, reference, b, warmth),
        temperature=warmth,
    )


def _inverse(triad: TriadCalibration, reference: float, target: Array, warmth: Array) -> Array:
    """Readings (…, n, 3) that the triad's model turns into `target`."""
    model, params = triad.functions(reference), np.array(triad.parameters)
    raw = target
    for _ in range(_STEPS):
        error = model.fields(params, raw, warmth) - target
        step = np.linalg.solve(model.slope(params, raw, warmth), error[..., None])[..., 0]
        raw = raw - step
    return raw


@dataclass(frozen=True)
class AccuracyMap:
    """1σ over the attitude sphere: root mean square over toolface.

    `sd` holds (inclination, azimuth) arrays by angle, radians; NaN where an angle rests on
    a direction that no evidence determines.
    """

    inclination: Array
    azimuth: Array
    sd: dict[str, Array]


def accuracy_map(calibration: Calibration) -> AccuracyMap:
    """1σ of the calibration from 2 to 178° inclination."""
    inclination = np.radians(np.linspace(2, 178, 45))
    azimuth = np.radians(np.linspace(0, 360, 25))
    grid = np.meshgrid(inclination, azimuth, indexing="ij")
    sd = _over_toolface(calibration, grid[0], grid[1])
    return AccuracyMap(inclination, azimuth, sd)


def _over_toolface(
    calibration: Calibration,
    inclination: Array,
    azimuth: Array,
    temperature: float | None = None,
    noise: bool = False,
) -> dict[str, Array]:
    """1σ (…, n) by angle, root mean square over `TOOLFACES`: one toolface at a time, for memory."""
    square = {name: np.zeros(inclination.shape) for name in angles(calibration)}
    for toolface in TOOLFACES:
        readings = readings_at(calibration, inclination, azimuth, toolface, temperature)
        for name, total in square.items():
            total += calibration.uncertainty(name, readings, noise) ** 2 / len(TOOLFACES)
    return {name: np.sqrt(total) for name, total in square.items()}


def accuracy_at(
    calibration: Calibration,
    inclinations: Sequence[float],
    noise: bool = False,
    temperature: float | None = None,
) -> dict[str, Array]:
    """1σ (n,) by angle at inclinations (n,), root mean square over azimuth and toolface.

    Units: radians. Singular: NaN at exactly vertical for toolface and azimuth, and where
    an angle rests on an undetermined direction.
    """
    azimuth = np.arange(12) * np.pi / 6
    grid = np.meshgrid(np.asarray(inclinations, float), azimuth, indexing="ij")
    found = _over_toolface(calibration, grid[0], grid[1], temperature, noise)
    return {name: np.sqrt(np.mean(sd**2, -1)) for name, sd in found.items()}


def typical_budget(
    calibration: Calibration, shares: Mapping[str, Array]
) -> dict[str, dict[str, float | None]]:
    """What each share (p, p) of the covariance adds to `typical_accuracy`, degrees, by source and angle."""
    azimuth = np.arange(12) * np.pi / 6
    grid = np.meshgrid(azimuth, TOOLFACES)
    readings = readings_at(calibration, TYPICAL, grid[0].ravel(), grid[1].ravel())
    found: dict[str, dict[str, float | None]] = {source: {} for source in shares}
    for name in angles(calibration):
        rows = calibration.sensitivity(name, readings)
        free = bool(calibration.rests_on_free(name, readings).any())
        for source, share in shares.items():
            variance = np.einsum("ni,ij,nj->n", rows, share, rows).mean()
            sd = float(np.degrees(np.sqrt(max(variance, 0.0))))
            found[source][name] = None if free else sd
    return found


def typical_accuracy(calibration: Calibration) -> dict[str, float | None]:
    """1σ of the calibration alone by angle, degrees, at 45° inclination; None: undetermined."""
    found = accuracy_at(calibration, [TYPICAL])
    values = {name: float(np.degrees(sd[0])) for name, sd in found.items()}
    return {name: None if np.isnan(value) else value for name, value in values.items()}
