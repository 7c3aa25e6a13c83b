"""Readings as a diagnosis takes them: checked, and with what is not stated made an honest uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.calibration.diagnosis.identity import doubts, other_tool
from mwdcal.calibration.readings import LEAST_TEMPERATURE_SPAN, Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError

NOMINAL_FIELD = 50_000.0
"""Field of the Earth, nT, by which sizes in nT are taken for a magnetometer that is calibrated to a field of 1."""
FIELD_SD = 0.3
"""Standard uncertainty of a field strength that the readings do not state, as a share of the laboratory's."""


def prepared(calibration: Calibration, readings: Readings) -> tuple[Readings, list[Finding]]:
    """The stations that a diagnosis can use, and what the reader should know of them.

    Raises:
        InputError: readings of another tool or of the fit itself, or none that can be used.
    """
    _check(calibration, readings)
    calibration.fields(readings)  # refuses readings that lack what the calibration needs
    findings = doubts(calibration, readings)
    if readings.magnetometer is not None and not calibration.has_field:
        readings = replace(readings, magnetometer=None)
    if calibration.has_field and readings.magnetometer is None:
        findings.append(
            _finding("no-magnetometer", "the readings have no magnetometer: nothing is said of it.")
        )
    whole = [getattr(readings, name) for name in readings.triads]
    sound = np.isfinite(np.concatenate(whole, -1)).all(-1)
    if not sound.any():
        raise InputError(
            f"{readings.name}: no station has all readings. Fill in the columns of raw readings."
        )
    if not sound.all():
        lacking = np.count_nonzero(~sound)
        findings.append(
            _finding("missing-reading", f"{lacking} stations lack a reading, and are left out.")
        )
        readings = readings.select(sound)
    if calibration.outside(readings).any():
        text = "some stations lie outside the calibrated temperature range: drift beyond it counts as a change."
        findings.append(_finding("outside-temperature", text))
    if not warmed(readings):
        text = "all readings are at one temperature: a fault of heat is no candidate. It needs two temperatures."
        findings.append(_finding("one-temperature", text))
    if calibration.unrecorded(readings):
        findings.append(
            _finding("no-temperature", "the tool was calibrated at unrecorded temperatures.")
        )
    if "gravity" not in readings.known:
        findings.append(
            _finding("assumed-gravity", "no ref_gravity_g: gravity is taken to be exactly 1 g.")
        )
    return _with_field(calibration, readings, findings), findings


def warmed(readings: Readings) -> bool:
    """Whether readings are at temperatures far enough apart to show what changes with temperature."""
    warmth = readings.temperature
    return warmth is not None and float(np.ptp(warmth)) >= LEAST_TEMPERATURE_SPAN


def _finding(name: str, text: str) -> Finding:
    return Finding(id=name, text=text)


def _check(calibration: Calibration, readings: Readings) -> None:
    """Refuse readings that say nothing of this calibration."""
    if other := other_tool(calibration, readings):
        raise InputError(
            f"{readings.name} is of tool {other[1]}, the calibration of tool {other[0]}. Give readings of the "
            "same tool, or correct 'serial' in the file."
        )
    if any(calibration.used(readings.digest)):
        raise InputError(
            f"{readings.name}: stations of the calibration's own fit cannot show what has changed since. Give "
            "later readings."
        )


def _with_field(calibration: Calibration, readings: Readings, findings: list[Finding]) -> Readings:
    """The readings with a field strength at every station, and an honest uncertainty where they state none."""
    if readings.magnetometer is None:
        return readings
    field, sd = readings.reference("field"), readings.uncertainty("field")
    if calibration.relative:
        field = np.full(field.shape, np.nan)
        text = "the magnetometer is calibrated to field = 1: sizes in nT are as if that were 50,000 nT."
        findings.append(_finding("relative-field", text))
    blank = np.isnan(field)
    if blank.all():
        earth = calibration.earth.get("field", 1.0)
        known = {**readings.known, "field": np.full(field.shape, earth)}
        return replace(
            readings,
            known=known,
            sd={**readings.sd, "field": np.full(field.shape, FIELD_SD * earth)},
        )
    filled = np.where(blank, np.nanmean(field), field)
    return replace(
        readings, known={**readings.known, "field": filled}, sd={**readings.sd, "field": sd}
    )


def freedom(calibration: Calibration, readings: Readings) -> float:
    """Degrees of freedom behind the noise of the readings: the fewest of any triad that states none."""
    triads = calibration.triads[: len(readings.triads)]
    estimated = [t.degrees_of_freedom for t in triads if t.name not in readings.sd]
    return max(1.0, min(estimated)) if estimated else np.inf
