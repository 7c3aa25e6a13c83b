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
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS, UNCERTAINTIES
from mwdcal.geometry.vectors import AnyArray, Array, Bools, diagonal

RESULT_OBSERVABLES = tuple(OUTPUTS)
"""Observables of a corrected reading, in the order of their columns."""
COVARIANCES_AT_ONCE = 1 << 12
"""Rows whose covariances are computed at once, so that they stay in fast memory."""
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
    findings: Iterable[Finding],
    declination: bool,
    depth: bool = True,
    modelled: Iterable[str] = (),
) -> ErrorTerms:
    """Those of readings by a calibration with these findings.

    `declination`: azimuths count from another north. `depth`: the readings are surveys of a well. `modelled`: what an
    error model adds: `AXIAL_INTERFERENCE`, `DRIFT`, `DEPTH` and of `NEVER`.
    """
    there, model = {finding.id for finding in findings}, set(modelled)
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
    return ErrorTerms(("calibration", "noise", *north, *included), tuple(left_out))


def reading_terms(calibration: Calibration) -> ErrorTerms:
    """Those of corrected readings: angles count from magnetic north, and there is no depth."""
    return error_terms(calibration.findings, declination=False, depth=False)


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
    valueless = 0
    for start in range(0, len(places), COVARIANCES_AT_ONCE):
        block = places[start : start + COVARIANCES_AT_ONCE]
        rows = slice(block[0], block[-1] + 1) if stated else block
        some = rows_of(readings, rows)
        value = np.stack([result[column][..., rows] for column in outputs], -1)
        part = standard_uncertainties(calibration, some)
        lost = without_value(calibration, some, RESULT_OBSERVABLES, value, part)
        valueless += int(np.count_nonzero(lost.any(-1)))
        for k in np.flatnonzero(lost.any(tuple(range(lost.ndim - 1)))).tolist():
            if result[outputs[k]] is columns[outputs[k]]:
                result[outputs[k]] = result[outputs[k]].copy()
            result[outputs[k]][..., rows] = np.where(lost[..., k], np.nan, value[..., k])
        if sd is not None:
            sd[..., rows] = np.moveaxis(
                np.where(np.isnan(value) | lost, np.nan, part * _FILE_UNITS), -1, 0
            )
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
