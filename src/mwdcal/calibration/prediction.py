"""Forecasts of a calibration: readings at a wanted attitude, and 1σ over the attitude sphere.

Everything here is of the calibration at the run's mean gravity, field and dip
(`Calibration.earth`). Angles are radians, shapes broadcast; no drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import UNSET

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import FREE_SHARE, Calibration, stated
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, ArrayLike, Ints, reference_vectors
from mwdcal.sensor.models import Model

STATED_ANGLES = ("inclination", "toolface", "azimuth")
"""Angles whose accuracy is stated; the first two need no magnetometer."""
TWELFTHS = np.arange(12) * np.pi / 6
"""Azimuths, and toolfaces, over which an uncertainty is averaged (root mean square)."""
LATTICE = (89, 55)
"""Numbers of Fibonacci: so many azimuths, and by how many times each the toolface, that cover both evenly."""
TYPICAL = float(np.radians(45))
"""The inclination that stands for a tool's accuracy where one number must do."""
UNKNOWN_GRAVITY = 0.0015
"""Standard uncertainty of |g| in units of a laboratory's gravity that was taken as 1 g: that is anything from
9.780 to 9.832 m/s²."""
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
"""Four fields, in units of their strength, from which an affine function of the field is known."""
CORNER_SHARES = np.array([[1.0, -1, -1, -1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Shares of these four in the field of unit components (1, x, y, z)."""
_STEPS = 8


def angles(calibration: Calibration) -> tuple[str, ...]:
    """Names of the angles that the calibrated triads can give."""
    return STATED_ANGLES[: 1 + len(calibration.triads)]


def unknown_gravity(calibration: Calibration) -> bool:
    """Whether gravity was taken as 1 g without a reference; in files of earlier versions, whether it is 1 g."""
    if calibration.gravity_stated is UNSET:
        return calibration.earth["gravity_g"] == 1.0
    return not calibration.gravity_stated


def middle_temperature(calibration: Calibration) -> float:
    """The reference temperature, moved into the calibrated range where it lies outside, °C."""
    low, high = calibration.temperature_c or (-np.inf, np.inf)
    return float(np.clip(calibration.reference_temperature, low, high))


def without_temperature(calibration: Calibration) -> str:
    """What headlines say of a calibration whose run recorded no temperature; empty if it did."""
    return "" if calibration.temperature_c else "no temperature recorded"


def readings_at(
    calibration: Calibration,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    toolface: ArrayLike,
    temperature: ArrayLike | None = None,
) -> Readings:
    """The readings (…, n) that this calibration turns into given attitudes (…, n).

    Units: radians; °C, of all or of each (…, n), by default `middle_temperature`. Singular: nowhere; a vertical tool
    reads a definite vector.
    """
    inc, azi, face = np.broadcast_arrays(inclination, azimuth, toolface)
    vectors = reference_vectors(inc, azi, face, *_earth(calibration))
    at = middle_temperature(calibration) if temperature is None else temperature
    warmth = np.broadcast_to(np.asarray(at, float), vectors[0].shape[:-1])
    raw = [
        raw_reading(
            t.functions(calibration.reference_temperature), np.array(t.parameters), v, warmth
        )
        for t, v in zip(calibration.triads, vectors, strict=False)
    ]
    return Readings(raw[0], raw[1] if len(raw) > 1 else None, temperature=warmth)


def _earth(calibration: Calibration) -> tuple[float, float, float]:
    """Gravity, g, field, nT, and dip, radians, of a calibration; 1 and 0 where it has no field."""
    earth = calibration.earth
    return earth["gravity_g"], earth.get("field", 1.0), np.radians(earth.get("dip_deg", 0.0))


def raw_reading(
    model: Model, params: Array, field: Array, temperature: Array, steps: int = _STEPS
) -> Array:
    """Readings (…, n, 3) that a triad's model turns into `field` (…, n, 3).

    Reference: the sensor model inverted by Newton steps, one of which is exact unless an axis is
    curved.
    """
    raw = np.zeros(field.shape)
    for _ in range(steps):
        error = field - model.fields(params, raw, temperature)
        raw = raw + np.linalg.solve(model.slope(params, raw, temperature), error[..., None])[..., 0]
    return raw


@dataclass(frozen=True)
class CalibratedTools:
    """Calibrated tools as arrays with a leading tool axis B.

    `models` and `parameters` (B, k) by triad; `earth` (B, 3): gravity, field, dip; `temperature`
    (B,), °C; `free` (B, f, p): directions of all parameters that no evidence determines; `noise`
    (B, t): standard deviation of one reading.
    """

    models: tuple[Model, ...]
    parameters: tuple[Array, ...]
    earth: Array
    temperature: Array
    free: Array
    noise: Array

    def changes(self, fields: Sequence[Array], noise: bool) -> Array:
        """Changes (B, t, n, 3, c) of each triad's field, where these are `fields` (B, n, 3).

        By the parameters of all triads and, with `noise`, by that of three readings of each.
        """
        ends = np.cumsum([params.shape[-1] for params in self.parameters])
        size = ends[-1] + 3 * noise * len(self.models)
        result = np.zeros((len(self.earth), len(self.models), *fields[0].shape[1:], size))
        for triad, (model, params) in enumerate(zip(self.models, self.parameters, strict=True)):
            warmth = np.broadcast_to(self.temperature[:, None], fields[triad].shape[:-1])
            raw = raw_reading(model, params, fields[triad], warmth, _STEPS if model.curved else 1)
            change, end = result[:, triad], ends[triad]
            change[..., end - params.shape[-1] : end] = model.jacobian(params, raw, warmth)
            if noise:
                slope, first = model.slope(params, raw, warmth), ends[-1] + 3 * triad
                change[..., first : first + 3] = slope * self.noise[:, triad, None, None, None]
        return result

    @classmethod
    def of(cls, calibration: Calibration, temperature: float | None = None) -> CalibratedTools:
        """One calibration as a batch of one, at `middle_temperature` unless another is given."""
        triads, reference = calibration.triads, calibration.reference_temperature
        at = middle_temperature(calibration) if temperature is None else temperature
        return cls(
            models=tuple(t.functions(reference) for t in triads),
            parameters=tuple(np.array([t.parameters]) for t in triads),
            earth=np.array([_earth(calibration)]),
            temperature=np.array([at]),
            free=calibration.free_directions[None],
            noise=np.array([[t.noise for t in triads]]),
        )


def _gradients(
    earth: Array, triads: int, inclination: float, azimuth: Array, toolface: Array
) -> tuple[tuple[Array, Array], Array, dict[str, Array]]:
    """Fields (E, a, 3) of both triads at attitudes (a,), those of `triads`, and gradients by angle."""
    attitudes = (np.full((1, len(azimuth)), inclination), azimuth[None], toolface[None])
    both = reference_vectors(*attitudes, *(earth[:, i, None] for i in range(3)))
    vectors = np.stack(both[:triads], -2)
    gradients = {
        name: OBSERVABLES[name].gradient(*both)[..., : 3 * triads].reshape(vectors.shape)
        for name in STATED_ANGLES[: 1 + triads]
    }
    return both, vectors, gradients


def angle_changes(tools: CalibratedTools, inclination: float = TYPICAL) -> dict[str, Array]:
    """Change (B, a, p) of each angle by all parameters, radians, at an inclination and a = 89 attitudes.

    These cover azimuth and toolface evenly (`LATTICE`). Singular: NaN at exactly vertical for toolface and azimuth.
    """
    turns = 2 * np.pi * np.arange(LATTICE[0]) / LATTICE[0]
    both, _, gradients = _gradients(
        tools.earth, len(tools.models), inclination, turns, turns * LATTICE[1]
    )
    change = tools.changes(both, noise=False)
    return {n: np.einsum("bati,btaip->bap", g, change) for n, g in gradients.items()}


def accuracy(
    tools: CalibratedTools, covariance: Array, inclination: float = TYPICAL, noise: bool = False
) -> dict[str, Array]:
    """1σ (…, B) by angle, radians, at an inclination: root mean square over azimuth and toolface.

    `covariance` (…, B, p, p) is of all parameters; `noise` adds that of one reading.
    Singular: NaN at exactly vertical for toolface and azimuth, and where an angle rests on a free
    direction.
    Method: unless an axis is curved, a field is affine in the reading at one temperature, and so
    is its change by the parameters in the field: four fields tell it everywhere.
    """
    earth, number = tools.earth, np.arange(len(tools.earth))
    curved = any(model.curved for model in tools.models)
    if not curved:
        earth, number = np.unique(earth, axis=0, return_inverse=True)
    azimuth, toolface = (turn.ravel() for turn in np.meshgrid(TWELFTHS, TWELFTHS, indexing="ij"))
    both, vectors, gradients = _gradients(earth, len(tools.models), inclination, azimuth, toolface)
    free = tools.free
    if noise:
        covariance, free = _with_noise(covariance, free, 3 * len(tools.models))
    if curved:
        change = tools.changes(both, noise)
        rows = {n: np.einsum("bati,btaic->bac", g, change) for n, g in gradients.items()}
    else:
        strengths = tools.earth[:, :2].transpose()
        change = tools.changes([s[:, None, None] * CORNERS for s in strengths], noise)
        change = change.reshape(len(change), -1, change.shape[-1])
        covariance = change @ covariance @ change.mT
        free = np.einsum("bip,bkp->bki", change, free)
        unit = vectors / earth[:, None, : len(tools.models), None]
        share = np.concatenate([np.ones_like(unit[..., :1]), unit], -1) @ CORNER_SHARES.transpose()
        size = (*share.shape[:2], -1)
        rows = {n: (share[..., None] * g[..., None, :]).reshape(size) for n, g in gradients.items()}
    return {n: _root_mean_square(each, number, covariance, free) for n, each in rows.items()}


def _root_mean_square(rows: Array, number: Ints, covariance: Array, free: Array) -> Array:
    """1σ (…, B) of what changes by `rows` (E, a, c), those of each tool having a `number` (B,).

    NaN where a row moves with a direction in `free` (B, f, c), and beyond a half turn, which tells nothing.
    """
    weights = rows.mT @ rows / rows.shape[1]
    variance = np.einsum("bij,...bij->...b", weights[number], covariance)
    sd = np.sqrt(np.maximum(variance, 0.0))
    sd = np.where(sd > np.pi, np.nan, sd)
    if not free.size:
        return np.asarray(sd)
    moved = np.abs(np.einsum("bai,bki->bak", rows[number], free)).max((-1, -2))
    return np.where(moved > FREE_SHARE, np.nan, sd)


def _with_noise(covariance: Array, free: Array, count: int) -> tuple[Array, Array]:
    """Covariance and free directions with `count` more parameters: readings in units of their noise."""
    size = covariance.shape[-1]
    whole = np.zeros((*covariance.shape[:-2], size + count, size + count))
    whole[..., :size, :size] = covariance
    whole[..., np.arange(size, size + count), np.arange(size, size + count)] = 1.0
    return whole, np.pad(free, ((0, 0), (0, 0), (0, count)))


@dataclass(frozen=True)
class AccuracyCurve:
    """1σ (n,) of an angle over inclination, radians: root mean square over toolface.

    `typical`: over azimuth too; `least` and `largest`: at the best and the worst azimuth. NaN where
    no uncertainty can be stated at some azimuth or toolface, as in `Calibration.uncertainty`.
    """

    typical: Array
    least: Array
    largest: Array


def accuracy_curves(
    calibration: Calibration, inclination: Array, noise: bool = False
) -> dict[str, AccuracyCurve]:
    """1σ by angle at inclinations (n,), radians: of the calibration, or of one reading too."""
    grid = np.meshgrid(inclination, TWELFTHS, indexing="ij")
    square = {name: np.zeros(grid[0].shape) for name in angles(calibration)}
    for toolface in TWELFTHS:  # one at a time, for memory
        readings = readings_at(calibration, *grid, toolface)
        for name, total in square.items():
            total += calibration.uncertainty(name, readings, noise) ** 2 / len(TWELFTHS)
    return {
        name: AccuracyCurve(np.sqrt(s.mean(-1)), np.sqrt(s.min(-1)), np.sqrt(s.max(-1)))
        for name, s in square.items()
    }


def accuracy_at(
    calibration: Calibration,
    inclinations: Sequence[float],
    noise: bool = False,
    temperature: float | None = None,
) -> dict[str, Array]:
    """1σ (n,) by angle at inclinations (n,), by `accuracy`, of the calibration or one reading.

    Units: radians; °C, by default `middle_temperature`.
    """
    tools = CalibratedTools.of(calibration, temperature)
    covariance = calibration.parameter_covariance[None]
    each = [accuracy(tools, covariance, angle, noise) for angle in inclinations]
    return {name: np.concatenate([sd[name] for sd in each]) for name in each[0]}


def typical_accuracy(calibration: Calibration) -> dict[str, float | None]:
    """1σ of the calibration alone by angle, degrees, at 45° inclination; None: undetermined."""
    sd = accuracy_at(calibration, [TYPICAL])
    return {name: stated(np.degrees(value[0])) for name, value in sd.items()}
