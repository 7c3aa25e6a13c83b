"""A calibration in another notation: on the screen and for machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mwdcal.app.pages.page import HELD, is_held
from mwdcal.app.text import raised, table
from mwdcal.calibration.readings import TRIADS, Readings, is_simulated, simulated
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.files import documents
from mwdcal.use.notation import COURSE, Notation, convert, powers

SCHEMA_VERSION = 1
"""Version of the JSON document."""


class Converted(NamedTuple):
    """A calibration in one notation: where from, at which temperature, and what to know of it.

    `sha256` is of the bytes of the calibration file; `temperature` is None where none was given.
    """

    path: Path
    sha256: str
    calibration: Calibration
    notation: str
    temperature: float | str | None
    triads: dict[str, Notation]
    findings: list[Finding]


def convert_file(path: Path, notation: str, temperature: float | str | None) -> Converted:
    """Read a calibration file and convert it."""
    calibration, sha256 = documents.load(path)
    triads = convert(calibration, notation, temperature)
    findings = temperature_findings(calibration, notation, temperature)
    findings += calibration.change_findings()
    return Converted(path, sha256, calibration, notation, temperature, triads, findings)


def temperature_findings(
    calibration: Calibration, notation: str, temperature: float | str | None
) -> list[Finding]:
    """What to know where the values are asked for at a temperature without calibration.

    The reference temperature counts as asked for where the values depend on it.
    """
    if isinstance(temperature, str):
        return []
    varies = notation != "factors" and any(t.order for t in calibration.triads)
    if temperature is None and not varies:
        return []
    at = calibration.reference_temperature if temperature is None else temperature
    there = Readings(np.zeros((1, 3)), temperature=np.array([at]))
    if calibration.unrecorded(there):
        text = (
            "the calibration was made at unrecorded temperatures, without temperature terms: the values are "
            f"the same at any temperature, and nothing says how good they are at {at:g} °C."
        )
        return [Finding(id="no-temperature", text=text)]
    if not calibration.outside(there).any():
        return []
    low, high = calibration.temperature_c or (np.nan, np.nan)
    text = (
        f"{at:g} °C lies outside the calibrated range {low:.1f}…{high:.1f} °C: the values are extrapolated, and "
        "their uncertainties do not hold. Choose a temperature inside, or calibrate over a wider range."
    )
    return [Finding(id="outside-temperature", text=text)]


def document(converted: Converted) -> dict[str, Any]:
    """The result for machines: identity, units and conditions, then the values of each triad."""
    return {**_identity(converted), **{name: _triad(converted, name) for name in converted.triads}}


def _identity(converted: Converted) -> dict[str, Any]:
    calibration, at = converted.calibration, converted.temperature
    identity: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "tool": calibration.tool,
        "serial": calibration.tool.get("serial"),
        "profile": calibration.profile.name,
        "run": calibration.run,
        "run_sha256": calibration.run_sha256,
        "calibration": converted.path.name,
        "calibration_sha256": converted.sha256,
        "calibrated": calibration.time,
        "software": calibration.software,
        "simulated": is_simulated(calibration.tool),
        "calibrated_temperature_c": calibration.temperature_c,
        "field_unit": calibration.field_unit,
        "notation": converted.notation,
        "temperature_c": at,
        "findings": converted.findings,
    }
    if isinstance(at, str):
        identity["powers_of"] = "T - reference_temperature_c"
    elif converted.notation == "factors" or at is None:
        identity["temperature_c"] = calibration.reference_temperature
    return identity


def _triad(converted: Converted, name: str) -> dict[str, Any]:
    item, profile = converted.triads[name], getattr(converted.calibration.profile, name)
    triad = next(t for t in converted.calibration.triads if t.name == name)
    return {
        **{k: v.tolist() for k, v in item.values.items()},
        "reference_temperature_c": converted.calibration.reference_temperature,
        "axes": profile.axes,
        "unit": triad.unit,
        "nominal_raw_per_unit": profile.scale,
        "standard_uncertainty": {k: v.tolist() for k, v in item.uncertainty.items()},
        "covariance": item.covariance.tolist(),
    }


def screen(converted: Converted) -> str:
    """The result for people: whose calibration it is, in which units, then the values."""
    calibration, at = converted.calibration, converted.temperature
    reference = calibration.reference_temperature
    serial = calibration.tool.get("serial", calibration.profile.name)
    first = [f"{converted.path.name}", serial, f"run {calibration.run}", calibration.software]
    lines = ["   ".join([*first, *simulated(calibration.tool)]), f"SHA-256 {converted.sha256}"]
    units = [
        f"{name} raw per {triad.unit}{_nominal(calibration, name)}"
        for name, triad in zip(TRIADS, calibration.triads, strict=False)
    ]
    stated = reference if at is None or converted.notation == "factors" else at
    shown = "course" if isinstance(stated, str) else f"{stated:g} °C"
    conditions = [f"notation {converted.notation}", f"temperature {shown}", _calibrated(converted)]
    lines += ["   ".join(conditions), "   ".join(units)]
    values = notation(converted.triads, reference if at == COURSE else None)
    return "\n".join(lines) + "\n\n" + values


def _calibrated(converted: Converted) -> str:
    """The calibrated temperatures, and whether the values lie outside them."""
    if converted.calibration.temperature_c is None:
        return "calibrated at unrecorded temperatures"
    low, high = converted.calibration.temperature_c
    beyond = any(finding.id == "outside-temperature" for finding in converted.findings)
    outside = "extrapolated: " if beyond else ""
    return f"{outside}calibrated at {low:.1f}…{high:.1f} °C"


def _nominal(calibration: Calibration, name: str) -> str:
    scale = getattr(calibration.profile, name).scale
    return "" if scale is None else f" (nominal {scale:.6g})"


def notation(triads: dict[str, Notation], reference: float | None = None) -> str:
    """Values with standard uncertainties, in as many digits as a firmware can hold.

    A course is stated by its `reference` temperature: each coefficient then names its power of τ.
    """
    blocks = [] if reference is None else [f"τ = T - {reference:g} °C"]
    for triad, notation in triads.items():
        rows = []
        for name, value in notation.values.items():
            power = powers(name, value)
            for index in np.ndindex(value.shape):
                label = _label(name, index, None if reference is None else int(power[index]))
                sd = float(notation.uncertainty[name][index])
                diagonal = name == "m" and index[0] == index[1]  # zero in every model
                stated = "undetermined" if np.isnan(sd) else f"{sd:.2g}"
                if is_held(float(value[index]), sd) and not diagonal:
                    stated = HELD
                rows.append([label, f"{value[index] + 0.0:.12g}", stated])
        blocks.append(f"{triad}\n" + table(rows, ["", "value", "1σ"]))
    return "\n\n".join(blocks)


def _label(name: str, index: tuple[int, ...], power: int | None) -> str:
    """Name and place of a value; in a course its power of τ instead of that index."""
    if power is not None and name != "m":
        index = index[:-1] if name in ("SF", "B") else index[1:]
    course = raised("·τ", power or 0)
    return name + "".join(f"[{i}]" for i in index) + course
