"""One gauge for several calibrations of a run, so that their parameters can be compared.

A turn or a stretch that no evidence determines is put by convention: the mean gain of a triad,
split into rotation and symmetric stretch, has no rotation, and the mean strength of its field
is that of the references. Here every calibration is put there, also the one that determines
the direction; the turn and the stretch that are taken out of each are kept beside, with their
uncertainty. (In geodesy: an S-transformation.)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import FREE_SHARE, Calibration, TriadCalibration
from mwdcal.estimation.rank import Free
from mwdcal.estimation.uncertainty import ROTATIONS, unrotating
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Model
from mwdcal.use.notation import Notation, convert

SCALE = "scale"
DERIVATIVE_STEP = 1e-6
"""Step of a derivative, as the share of the field by which it changes the field."""


@dataclass(frozen=True)
class Gauge:
    """Directions put by convention, each with the triads that it turns or stretches together."""

    free: frozenset[tuple[str, tuple[int, ...]]]

    @classmethod
    def of(cls, free: Iterable[Free]) -> Gauge:
        """All that any of several calibrations leaves free, but for courses with temperature."""
        return cls(frozenset((f.id, f.triads) for f in free if f.id in (*ROTATIONS, SCALE)))

    def names(self, triad: int) -> list[str]:
        """The directions that are put by convention for one triad, in their usual order."""
        free = {name for name, triads in self.free if triad in triads}
        return [name for name in (*ROTATIONS, SCALE) if name in free]


def in_gauge(
    calibration: Calibration, readings: Readings, gauge: Gauge
) -> tuple[dict[str, Notation], dict[str, Notation]]:
    """Factors of each triad in a gauge, and what was taken out to put them there.

    Taken out: `rotation_deg` (3,), the rotation vector in degrees about the tool axes, and
    `scale` (1,), each with uncertainty: NaN where this calibration does not determine it.
    Own-axis terms do not count: factors are those of the tangent at the centre of the readings.
    """
    calibration = _straight(calibration)
    settle = _Settle.of(calibration, readings, gauge)
    params, size = calibration.parameters, len(calibration.parameters)
    settled, slope = settle(params), settle.slope(calibration, readings, params)
    covariance, free = _carried(calibration, slope)
    triads = [
        msgspec.structs.replace(triad, parameters=settled[where].tolist())
        for triad, where in zip(calibration.triads, settle.slices, strict=True)
    ]
    record = _replaced(calibration, triads, covariance[:size, :size], free[:, :size])
    names, rest = [t.name for t in triads], (covariance[size:, size:], free[:, size:])
    return convert(record, "factors"), _taken_out(names, settled[size:], *rest)


def _carried(calibration: Calibration, slope: Array) -> tuple[Array, Array]:
    """Covariance and free directions of the parameters, through a linear map."""
    covariance = slope @ calibration.parameter_covariance @ slope.transpose()
    return covariance, calibration.free_directions @ slope.transpose()


def _taken_out(
    triads: list[str], taken: Array, covariance: Array, free: Array
) -> dict[str, Notation]:
    """Rotation and scale of each triad, from those (4 t,) of all in radians."""
    unit = np.array([*np.full(3, np.degrees(1)), 1.0])
    moved = np.abs(free).max(0, initial=0.0)
    sd = np.where(moved > FREE_SHARE, np.nan, np.sqrt(np.maximum(np.diag(covariance), 0)))
    each = np.stack([taken, sd]).reshape(2, len(triads), 4) * unit
    notations = {}
    for index, name in enumerate(triads):
        block = slice(4 * index, 4 * index + 4)
        value, spread = ({"rotation_deg": v[:3], "scale": v[3:]} for v in each[:, index])
        notations[name] = Notation(value, spread, covariance[block, block] * np.outer(unit, unit))
    return notations


@dataclass(frozen=True)
class _Settle:
    """The map from the parameters (p,) of all triads to those in the gauge."""

    gauge: Gauge
    models: list[Model]
    slices: list[slice]
    raw: list[Array]
    temperature: Array
    nominal: list[float]

    @classmethod
    def of(cls, calibration: Calibration, readings: Readings, gauge: Gauge) -> _Settle:
        reference, triads = calibration.reference_temperature, calibration.triads
        temperature = readings.temperature
        if temperature is None:
            temperature = np.full(readings.count, reference)
        strengths = [readings.reference(name) for name in ("gravity", "field")[: len(triads)]]
        return cls(
            gauge,
            [t.functions(reference) for t in triads],
            [*calibration.places().values()],
            [getattr(readings, t.name) for t in triads],
            temperature,
            [1.0 if np.isnan(s).all() else float(np.nanmean(s)) for s in strengths],
        )

    def __call__(self, params: Array) -> Array:
        """Parameters in the gauge, then per triad the rotation vector, rad, and scale taken out."""
        parts = [params[w] for w in self.slices]
        every = tuple(range(len(parts)))
        turned = [np.eye(3) for _ in every]
        for triads in dict.fromkeys([every, *((t,) for t in every)]):
            turn = self._turn(parts[triads[0]], triads)
            for t in triads:
                parts[t] = self.models[t].transformed(parts[t], turn)
                turned[t] = turn @ turned[t]
        taken = []
        for t in every:
            factor = self._factor(parts[t], t)
            parts[t] = self.models[t].transformed(parts[t], factor * np.eye(3))
            taken += [*_rotation_vector(turned[t].transpose()), 1 / factor]
        return np.concatenate([*parts, taken])

    def slope(self, calibration: Calibration, readings: Readings, params: Array) -> Array:
        """Derivative (p + 4 t, p) of the map, by central differences."""
        effect, fields = calibration.jacobian(readings), calibration.fields(readings)
        steps: list[float] = []
        for t, where in enumerate(self.slices):
            strength = np.linalg.norm(fields[t], axis=-1).mean()
            rows = effect[:, 3 * t : 3 * t + 3, where]
            sizes = np.sqrt(np.mean(np.sum(rows**2, 1), 0)) / strength
            steps += (DERIVATIVE_STEP / sizes).tolist()
        moves = np.diag(steps)
        changes = [self(params + move) - self(params - move) for move in moves]
        return np.asarray(np.stack(changes, -1) / (2 * np.array(steps)))

    def _turn(self, params: Array, triads: tuple[int, ...]) -> Array:
        """The turn that leaves the first triad's gain without rotation about the free axes."""
        first, free = triads[0], [(axis, triads) in self.gauge.free for axis in ROTATIONS]
        gain = self.models[first].slope(params, self.raw[first], self.temperature).mean(0)
        return unrotating(gain, np.array(free))

    def _factor(self, params: Array, triad: int) -> float:
        """What brings the triad's mean strength to that of the references, if its scale is free."""
        if SCALE not in self.gauge.names(triad):
            return 1.0
        fields = self.models[triad].fields(params, self.raw[triad], self.temperature)
        return self.nominal[triad] / float(np.linalg.norm(fields, axis=-1).mean())


def _rotation_vector(turn: Array) -> Array:
    """Rotation vector (3,), rad, of a rotation by less than half a turn."""
    odd = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    sine = np.linalg.norm(odd)
    angle = np.arctan2(sine, (np.trace(turn) - 1) / 2)
    return odd * (angle / sine if sine > 0 else 1.0)


def _straight(calibration: Calibration) -> Calibration:
    """The calibration with own-axis terms replaced by the tangent at the centre of the readings."""
    from scipy.linalg import block_diag

    if not any(t.curved for t in calibration.triads):
        return calibration
    blocks = [_tangent(t, calibration.reference_temperature) for t in calibration.triads]
    triads = [
        msgspec.structs.replace(
            triad,
            curved=False,
            parameter_names=triad.parameter_names[: len(block)],
            parameters=(block @ triad.parameters).tolist(),
        )
        for triad, block in zip(calibration.triads, blocks, strict=True)
    ]
    return _replaced(calibration, triads, *_carried(calibration, block_diag(*blocks)))


def _replaced(
    calibration: Calibration, triads: list[TriadCalibration], covariance: Array, free: Array
) -> Calibration:
    """The calibration with other parameters, their covariance and their free directions."""
    return msgspec.structs.replace(
        calibration,
        accelerometer=triads[0],
        magnetometer=triads[1] if len(triads) > 1 else None,
        covariance_rows=covariance.tolist(),
        free=free.tolist(),
    )


def _tangent(triad: TriadCalibration, reference: float) -> Array:
    """Linear map from a triad's parameters to those of its tangent on plain readings."""
    if not triad.curved:
        return np.eye(len(triad.parameters))
    _, plain = msgspec.structs.replace(triad, curved=False).functions(reference).finished(reference)
    return np.concatenate([plain, np.zeros((len(plain), 6))], -1)
