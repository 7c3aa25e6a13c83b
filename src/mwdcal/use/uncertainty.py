"""Standard uncertainties of corrected readings, and angles that have no value: one rule for readings and surveys.

The uncertainty is that of the calibration and of the noise of one reading. Near vertical azimuth and toolface have
no value, nor has azimuth where the field is vertical: a direction is then smaller than its own error.

Beside every 1σ stands what it holds and what it leaves out: one sentence, one place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS, UNCERTAINTIES, VECTORS, variances
from mwdcal.geometry.vectors import AnyArray, Array, Bools, diagonal

RESULT_OBSERVABLES = tuple(OUTPUTS)
"""Observables of a corrected reading, in the order of their columns."""
COVARIANCES_AT_ONCE = 1 << 13
"""Rows whose covariances are computed at once, so that they stay in fast memory."""
_TERMS_AT_ONCE = 1 << 10
"""Rows whose products of readings and powers of temperature are formed at once, for the same reason."""
_STEP = 2.0**20
_ENDS = _STEP * np.eye(4)[:, 1:]
"""Readings between which a Jacobian is affine: far beyond any bias, so that their differences keep their digits."""
_PAIRS, _TERMS = np.triu_indices(3), np.triu_indices(4)
"""Pairs of components of a triad, and of the terms 1, y."""
_FILE_UNITS = np.array(
    [np.degrees(1.0) if OBSERVABLES[n].unit == "rad" else 1.0 for n in RESULT_OBSERVABLES]
)
LARGEST_DIRECTION_SD = 1 / 3
"""Largest standard uncertainty, rad, of a direction that has a value: the tool is three of them off vertical.

Noise alone puts a vertical tool farther off in one reading of ninety."""
DOUBTFUL = 4.0
"""Degrees from vertical within which a direction may have no value, for any calibration that is of use."""
CORRECTED = "interference-corrected"
"""The finding of a calibration from which multi-station analysis has taken interference."""
DRIFTED = "sensor-drift-allowed"
"""The finding of one whose covariance allows for what the sensors have moved since the laboratory."""
INTERFERENCE = "interference of the drill string"
AXIAL_INTERFERENCE, CROSS_INTERFERENCE = f"axial {INTERFERENCE}", f"cross-axial {INTERFERENCE}"
"""Interference of the drill string as error models part it: they state the first alone."""
DRIFT = "drift of the sensors since the calibration"
THERMAL_DRIFT = "drift of the sensors with temperature"
"""The drift that a calibration without temperature terms does not know."""
NEVER = ("sag", "misalignment in the hole")
"""Errors that no calibration and no survey of its own knows…"""
DEPTH = "measured depth"
"""…and one that only surveys with depths have."""
OF_MODELS = dict(zip(("SAG", "XYM", "D"), (*NEVER, DEPTH), strict=True))
"""First letters of the terms of error models that state them."""


@dataclass(frozen=True)
class ErrorTerms:
    """Sources of error in a standard uncertainty, and those that are not in it."""

    included: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Both, as printed beside every 1σ."""
        lacking = f" Not in it: {', '.join(self.left_out)}." if self.left_out else ""
        return f"1σ: {', '.join(self.included)}.{lacking}"

    @property
    def stated(self) -> dict[str, list[str]]:
        """Both, as the metadata of a table and JSON state them."""
        return {"error_terms": list(self.included), "not_included": list(self.left_out)}


def error_terms(
    calibration: Calibration,
    declination: bool,
    depth: bool = True,
    modelled: Iterable[str] = (),
) -> ErrorTerms:
    """Those of readings by a calibration.

    `declination`: azimuths count from another north. `depth`: the readings are surveys of a well. `modelled`: what an
    error model adds: `AXIAL_INTERFERENCE`, `DRIFT`, `DEPTH` and of `NEVER`.
    """
    there, model = {finding.id for finding in calibration.findings}, set(modelled)
    parts = {INTERFERENCE: CORRECTED in there}
    if AXIAL_INTERFERENCE in model:
        parts = {AXIAL_INTERFERENCE: True, CROSS_INTERFERENCE: False}
    others = [*NEVER, *([DEPTH] if depth else [])]
    optional = {
        **parts,
        DRIFT: DRIFTED in there or DRIFT in model,
        **{name: name in model for name in others},
    }
    included = [name for name, known in optional.items() if known]
    north = ["declination"] if declination else []
    left_out = [name for name, known in optional.items() if not known]
    if not calibration.thermal and DRIFTED not in there:
        left_out.append(THERMAL_DRIFT)
    return ErrorTerms(("calibration", "noise", *north, *included), tuple(left_out))


def reading_terms(calibration: Calibration) -> ErrorTerms:
    """Those of corrected readings: angles count from magnetic north, and there is no depth."""
    return error_terms(calibration, declination=False, depth=False)


def standard_uncertainties(
    calibration: Calibration, readings: Readings, names: Sequence[str] = RESULT_OBSERVABLES
) -> Array:
    """1σ (…, n, k) of observables of one reading; NaN where none can be stated. Units: radians, g, nT."""
    with np.errstate(invalid="ignore", divide="ignore"):  # a strength of zero, g along b
        covariance = calibration.covariance(names, readings, noise=True)
    return np.asarray(np.sqrt(np.maximum(diagonal(covariance), 0.0)))


def without_value(
    calibration: Calibration, readings: Readings, names: Sequence[str], value: Array, sd: Array
) -> Bools:
    """Where (…, n, k) a direction has no value: its 1σ would exceed `LARGEST_DIRECTION_SD`.

    Of `names`, with `value` and `sd` (…, n, k). A result that is missing, rests on a free direction or lies outside the
    calibrated temperatures has no `sd` for other reasons.
    """
    turns = np.array([OBSERVABLES[name].period > 0 for name in names])
    lost = turns & ~(sd <= LARGEST_DIRECTION_SD) & ~np.isnan(value)
    lost &= ~calibration.outside(readings)[..., None]
    if lost.any() and calibration.free:
        lost &= ~np.stack([calibration.rests_on_free(name, readings) for name in names], -1)
    return np.asarray(lost)


class VectorCovariance:
    """Covariance of gravity and field at any reading: of a calibration without own-axis terms, and of noise.

    Definition: with t the scaled temperature, d(t) the divisor of a reading and y = reading / d², an error of the
    parameters moves a component by (1, y) · e(t), e a polynomial of the order of the model. So a covariance of two
    components is a sum of 1, y, y y and (sd of the reading / d)², each times a polynomial of t of twice that order.
    Their coefficients come from Jacobians at as many temperatures. `Calibration.covariance` goes row by row instead.
    """

    def __init__(self, calibration: Calibration) -> None:
        """With coefficients for temperatures in the calibrated range and its margin."""
        self.calibration, self.triads = calibration, calibration.triads
        self.zero = calibration.reference_temperature
        low, high = calibration.temperature_c or (self.zero, self.zero)
        self.middle, self.half = (low + high) / 2, (high - low) / 2 + calibration.margin
        self.powers = np.arange(2 * max(triad.order for triad in self.triads) + 1)
        nodes = np.cos(np.pi * (self.powers + 0.5) / len(self.powers))
        self._by_power = np.linalg.inv(nodes[:, None] ** self.powers)
        covariance, places = calibration.parameter_covariance, calibration.places()
        self.divisors, self.triad_terms, errors = [], [], []
        for triad in self.triads:
            divisor, error, noise = self._triad(triad, self.middle + self.half * nodes)
            place = places[triad.name]
            part = _products(error, covariance[place, place], error)[:, *_PAIRS]
            part = (part + part.mT * (1.0 - np.eye(4)))[..., *_TERMS]
            self.divisors.append((self._by_power @ divisor).transpose())
            self.triad_terms.append(self._coefficients(np.concatenate([part, noise], -1)))
            errors.append((error, place))
        if len(errors) == len(TRIADS):
            (first, here), (second, there) = errors
            part = _products(first, covariance[here, there], second)
            self.cross_terms = self._coefficients(part.reshape(-1, 9, 16))

    def _triad(self, triad: TriadCalibration, temperature: Array) -> tuple[Array, Array, Array]:
        """At some temperatures (m,): divisors (m, 3), e (m, 3, 4, p), and factors of the noise (m, 6, 3)."""
        model, params = triad.functions(self.zero), np.array(triad.parameters)
        warmth = np.broadcast_to(temperature[:, None], (len(temperature), len(_ENDS)))
        divisor = model.divisor(params, warmth)
        raw = _ENDS * divisor**2
        error = model.jacobian(params, raw, warmth)
        error[:, 1:] = (error[:, 1:] - error[:, :1]) / _STEP
        slope = (model.slope(params, raw, warmth) * divisor[..., None, :])[:, 0]
        return divisor[:, 0], error.swapaxes(1, 2), slope[:, _PAIRS[0]] * slope[:, _PAIRS[1]]

    def _coefficients(self, values: Array) -> Array:
        """Coefficients (k, powers × j) of the polynomials through values (m, k, j) at the temperatures."""
        each = np.tensordot(self._by_power, values, 1).swapaxes(0, 1)
        return each.reshape(len(each), -1)

    def __call__(self, readings: Readings) -> Array:
        """Covariances (21, …, n) in the order of `observables.variances`; NaN where there is no magnetometer."""
        shape = readings.accelerometer.shape[:-1]
        warmth = self.zero if readings.temperature is None else readings.temperature
        scaled = (np.broadcast_to(warmth, shape).reshape(-1) - self.middle) / self.half
        channels = []
        for triad in self.triads:
            raw = getattr(readings, triad.name)
            if raw is not None:
                sd = np.broadcast_to(triad.noise_of(readings), raw.shape)
                channels.append([np.moveaxis(v, -1, 0).reshape(3, -1) for v in (raw, sd)])
        result = np.full((21, scaled.size), np.nan)
        for start in range(0, scaled.size, _TERMS_AT_ONCE):
            rows = slice(start, start + _TERMS_AT_ONCE)
            powers = np.repeat(scaled[None, rows], len(self.powers), 0)
            powers[0] = 1.0
            powers = np.multiply.accumulate(powers, 0)
            affine = []
            for k, (raw, sd) in enumerate(channels):
                divisor = self.divisors[k] @ powers
                y = np.concatenate([powers[:1], raw[:, rows] / divisor**2])
                terms = [y[_TERMS[0]] * y[_TERMS[1]], (sd[:, rows] / divisor) ** 2]
                result[6 * k : 6 * k + 6, rows] = _total(
                    self.triad_terms[k], powers, np.concatenate(terms)
                )
                affine.append(y)
            if len(affine) == len(TRIADS):
                terms = (affine[0][:, None] * affine[1]).reshape(16, -1)
                result[12:, rows] = _total(self.cross_terms, powers, terms)
        return result.reshape(21, *shape)


def _products(first: Array, covariance: Array, second: Array) -> Array:
    """Covariances (m, 3, 3, 4, 4) of e (m, 3, 4, p) of two triads by that of their parameters."""
    count, _, _, p = first.shape
    product = first.reshape(count, 12, p) @ covariance @ second.reshape(count, 12, -1).mT
    return product.reshape(count, 3, 4, 3, 4).swapaxes(2, 3)


def _total(coefficients: Array, powers: Array, terms: Array) -> Array:
    """Sums (k, n) of terms (j, n) times powers (m, n) by coefficients (k, m × j)."""
    return coefficients @ (powers[:, None] * terms).reshape(-1, terms.shape[-1])


def result_uncertainties(
    calibration: Calibration,
    readings: Readings,
    vectors: Array,
    covariances: VectorCovariance | None,
) -> Array:
    """`standard_uncertainties` (k, …, n) of all results, with `vectors` (6, …, n) of the readings."""
    if covariances is None:
        return np.moveaxis(standard_uncertainties(calibration, readings), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = variances(vectors[:3], vectors[3:], covariances(readings))
    blank = calibration.without_uncertainty(
        RESULT_OBSERVABLES, readings, np.moveaxis(variance, 0, -1)
    )
    return np.sqrt(np.maximum(np.where(np.moveaxis(blank, -1, 0), np.nan, variance), 0.0))


def with_uncertainty(
    calibration: Calibration, readings: Readings, columns: Mapping[str, AnyArray], stated: bool
) -> tuple[dict[str, AnyArray], int]:
    """Corrected columns (…, n) with directions that have no value blanked, and the number of rows with such.

    With standard uncertainties after them where these are to be `stated`; without, only rows near vertical are
    looked at.
    """
    result = {name: np.asarray(values, float) for name, values in columns.items()}
    shape, outputs = readings.accelerometer.shape[:-1], [*OUTPUTS.values()]
    sd = np.full((len(RESULT_OBSERVABLES), *shape), np.nan) if stated else None
    places = np.arange(readings.count) if stated else np.flatnonzero(_doubtful(columns))
    curved = any(triad.curved for triad in calibration.triads)
    covariances = None if curved or not places.size else VectorCovariance(calibration)
    valueless = 0
    for start in range(0, len(places), COVARIANCES_AT_ONCE):
        block = places[start : start + COVARIANCES_AT_ONCE]
        rows = slice(block[0], block[-1] + 1) if stated else block
        some = rows_of(readings, rows)
        vectors, value = (
            np.stack([result[column][..., rows] for column in names])
            for names in (VECTORS, outputs)
        )
        part = result_uncertainties(calibration, some, vectors, covariances)
        last = [np.moveaxis(each, 0, -1) for each in (value, part)]
        lost = np.moveaxis(without_value(calibration, some, RESULT_OBSERVABLES, *last), -1, 0)
        valueless += int(np.count_nonzero(lost.any(0)))
        for k in np.flatnonzero(lost.any(tuple(range(1, lost.ndim)))).tolist():
            if result[outputs[k]] is columns[outputs[k]]:
                result[outputs[k]] = result[outputs[k]].copy()
            result[outputs[k]][..., rows] = np.where(lost[k], np.nan, value[k])
        if sd is not None:
            units = _FILE_UNITS.reshape(-1, *[1] * len(shape))
            sd[..., rows] = np.where(np.isnan(value) | lost, np.nan, part * units)
    names = UNCERTAINTIES if stated else ()
    return result | dict(zip(names, () if sd is None else sd, strict=True)), valueless


def _doubtful(columns: Mapping[str, AnyArray]) -> Bools:
    """Rows (n,) where the tool or the field is nearly vertical, or the field lies nearly along the tool."""
    across = np.hypot(columns["bx_nt"], columns["by_nt"])
    with np.errstate(invalid="ignore"):
        near = np.abs(columns["inclination_deg"] - 90.0) > 90.0 - DOUBTFUL
        near |= np.abs(columns["dip_deg"]) > 90.0 - DOUBTFUL
        near |= across < np.sin(np.radians(DOUBTFUL)) * columns["field_nt"]
    return np.asarray(near.reshape(-1, near.shape[-1]).any(0))


def rows_of(readings: Readings, rows: AnyArray | slice) -> Readings:
    """Some rows of readings (…, n), as far as corrections need them."""
    shape = readings.accelerometer.shape
    magnetometer, temperature = readings.magnetometer, readings.temperature
    return replace(
        readings,
        accelerometer=readings.accelerometer[..., rows, :],
        magnetometer=None if magnetometer is None else magnetometer[..., rows, :],
        temperature=None if temperature is None else temperature[..., rows],
        sd={
            n: np.broadcast_to(readings.sd[n], shape)[..., rows, :]
            for n in TRIADS
            if n in readings.sd
        },
        known={},
        group=None,
        station=(),
        digest=(),
    )
