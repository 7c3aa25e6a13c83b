"""Readings through a calibration: vectors, angles and strengths, in the units of files."""

from __future__ import annotations

import numpy as np

from mwdcal.calibration import Calibration, Finding
from mwdcal.core.observables import OBSERVABLES
from mwdcal.core.vectors import Array
from mwdcal.errors import InputError
from mwdcal.readings import Readings

ANGULAR = ("inclination", "azimuth", "toolface", "dip", "magnetic_toolface")
OUTSIDE = ("blank", "refuse", "extrapolate")
JUDGED = ("gravity", "inclination", "toolface", "azimuth", "field", "dip", "magnetic_toolface")
DIRECTIONS = {
    "gravity_g": ("inclination_deg", "azimuth_deg", "toolface_deg", "dip_deg"),
    "field_nt": ("azimuth_deg", "dip_deg", "magnetic_toolface_deg"),
}
"""Directions that do not exist where a strength is zero."""


def correct(
    calibration: Calibration, readings: Readings, outside: str = "blank"
) -> tuple[dict[str, Array], list[Finding]]:
    """Output columns (n,) by name, and what the reader should know.

    Singular: at exactly vertical attitudes azimuth and toolface are NaN (blank in files);
    `magnetic_toolface_deg` stands beside them. A strength of zero has no direction: NaN.
    Temperatures outside the calibrated range are blanked, refused or extrapolated as `outside` says.
    """
    if outside not in OUTSIDE:
        raise InputError(f"--outside must be one of {', '.join(OUTSIDE)}; got {outside!r}.")
    if calibration.has_field and readings.magnetometer is None:
        findings = [
            Finding(id="no-magnetometer", text="no columns mx, my, mz: magnetic results are blank.")
        ]
    else:
        findings = []
    findings += _other_tool(calibration, readings)
    columns = _columns(calibration, readings)
    beyond = calibration.outside(readings)
    if beyond.any():
        findings.append(_outside(calibration, readings, outside, int(beyond.sum())))
    if outside == "blank":
        columns = {name: np.where(beyond, np.nan, value) for name, value in columns.items()}
    if calibration.field_unit != "nT" and calibration.has_field:
        text = "the magnetometer is calibrated to field = 1: bx_nt, by_nt, bz_nt and field_nt are relative, not nT."
        findings.append(Finding(id="field-relative", text=text))
    return columns, findings + _undetermined(calibration, readings)


def _columns(calibration: Calibration, readings: Readings) -> dict[str, Array]:
    g, b = calibration.fields(readings)
    columns = {f"g{axis}_g": g[..., i] for i, axis in enumerate("xyz")}
    columns |= {f"b{axis}_nt": b[..., i] for i, axis in enumerate("xyz")}
    for name in ("inclination", "azimuth", "toolface"):
        columns[f"{name}_deg"] = np.degrees(OBSERVABLES[name].value(g, b))
    columns["gravity_g"] = OBSERVABLES["gravity"].value(g, b)
    columns["field_nt"] = OBSERVABLES["field"].value(g, b)
    columns["dip_deg"] = np.degrees(OBSERVABLES["dip"].value(g, b))
    columns["magnetic_toolface_deg"] = np.degrees(OBSERVABLES["magnetic_toolface"].value(g, b))
    for strength, names in DIRECTIONS.items():
        nothing = columns[strength] == 0.0
        for name in names:
            columns[name] = np.where(nothing, np.nan, columns[name])
    return columns


def _other_tool(calibration: Calibration, readings: Readings) -> list[Finding]:
    other = calibration.other_tool(readings)
    if other is None:
        return []
    ours, theirs = other
    text = (
        f"the readings are of tool {theirs}, the calibration of tool {ours}: is it the right one?"
    )
    return [Finding(id="other-tool", text=text)]


def _outside(calibration: Calibration, readings: Readings, how: str, count: int) -> Finding:
    low, high = calibration.temperature_c or (np.nan, np.nan)
    text = (
        f"{count} of {readings.count} rows lie outside the calibrated range {low:.1f}…{high:.1f} °C"
    )
    if how == "refuse":
        raise InputError(
            f"{readings.source}: {text}. Use --outside blank or extrapolate, or calibrate over a wider range."
        )
    done = (
        "their results are blank"
        if how == "blank"
        else "their results are extrapolated, with no statement of accuracy"
    )
    return Finding(id="outside-temperature", text=f"{text}: {done}.")


def _undetermined(calibration: Calibration, readings: Readings) -> list[Finding]:
    """Outputs that rest on a direction which the calibration leaves free.

    A row without field or gravity has no directions, and none that could be undetermined.
    """
    if not calibration.free:
        return []
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = {name: calibration.rests_on_free(name, readings).any() for name in JUDGED}
    names = [name for name, any_row in moved.items() if any_row]
    if not names:
        return []
    free = ", ".join(dict.fromkeys(u.id for u in calibration.undetermined()))
    text = f"{', '.join(names)} rest on what the calibration leaves undetermined ({free})"
    text += ": no uncertainty can be stated."
    return [Finding(id="undetermined", text=text)]
