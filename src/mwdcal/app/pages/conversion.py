"""A calibration in another notation: on the screen and for machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.app.envelope import enveloped
from mwdcal.app.pages.page import HELD, UNDETERMINED
from mwdcal.app.text import one_line, raised, table
from mwdcal.calibration.readings import Readings, simulated
from mwdcal.calibration.record import SOFTWARE, Calibration, Finding
from mwdcal.files import documents
from mwdcal.sensor.profile import Axis
from mwdcal.use.notation import COURSE, Notation, convert, powers

UNRECORDED = (
    "the calibration was made at unrecorded temperatures, without temperature terms: the values are "
    "the same at any temperature, and nothing says how good they are at {:g} °C."
)
OUTSIDE_RANGE = (
    "{:g} °C lies outside the calibrated range {}: the values are extrapolated, and their "
    "uncertainties do not hold. Choose a temperature inside, or calibrate over a wider range."
)


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


class ConvertedTriad(msgspec.Struct, frozen=True, kw_only=True):
    """The values of a triad in one notation, and what they are of."""

    S: list[Any] | msgspec.UnsetType = msgspec.UNSET
    o: list[Any] | msgspec.UnsetType = msgspec.UNSET
    M: list[Any] | msgspec.UnsetType = msgspec.UNSET
    b: list[Any] | msgspec.UnsetType = msgspec.UNSET
    SF: list[Any] | msgspec.UnsetType = msgspec.UNSET
    B: list[Any] | msgspec.UnsetType = msgspec.UNSET
    m: list[Any] | msgspec.UnsetType = msgspec.UNSET
    reference_temperature_c: float
    axes: tuple[Axis, Axis, Axis]
    unit: str
    nominal_raw_per_unit: float | None
    standard_uncertainty: dict[str, list[Any]]
    covariance: list[list[float]]


class ConversionSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `convert` prints and writes: whose calibration it is, then the values of each triad.

    `software` is that of the calibration; `converted_by` wrote this document.
    """

    tool: dict[str, str]
    profile: str
    run: str
    calibration: str
    calibrated: str
    software: str
    converted_by: str
    calibrated_temperature_c: tuple[float, float] | None
    field_unit: str
    notation: str
    temperature_c: float | str
    findings: list[Finding]
    powers_of: str | msgspec.UnsetType = msgspec.UNSET
    accelerometer: ConvertedTriad
    magnetometer: ConvertedTriad | msgspec.UnsetType = msgspec.UNSET


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
    varies = notation != "factors" and any(t.order for t in calibration.triads)
    if isinstance(temperature, str) or (temperature is None and not varies):
        return []
    at = calibration.reference_temperature if temperature is None else temperature
    there = Readings(np.zeros((1, 3)), temperature=np.array([at]))
    if calibration.unrecorded(there):
        return [Finding(id="no-temperature", text=UNRECORDED.format(at))]
    if calibration.outside(there).any():
        text = OUTSIDE_RANGE.format(at, _range(calibration))
        return [Finding(id="outside-temperature", text=text)]
    return []


def _range(calibration: Calibration) -> str:
    """The calibrated temperatures."""
    low, high = calibration.temperature_c or (np.nan, np.nan)
    return f"{low:.1f}…{high:.1f} °C"


def document(converted: Converted) -> dict[str, Any]:
    """The result for machines: identity, units and conditions, then the values of each triad."""
    calibration, at = converted.calibration, converted.temperature
    course = isinstance(at, str)
    if at is None or (converted.notation == "factors" and not course):
        at = calibration.reference_temperature
    content = ConversionSummary(
        tool=calibration.tool,
        profile=calibration.profile.name,
        run=calibration.run,
        calibration=converted.path.name,
        calibrated=calibration.time,
        software=calibration.software,
        converted_by=SOFTWARE,
        calibrated_temperature_c=calibration.temperature_c,
        field_unit=calibration.field_unit,
        notation=converted.notation,
        temperature_c=at,
        findings=converted.findings,
        powers_of="T - reference_temperature_c" if course else msgspec.UNSET,
        **{name: _triad(converted, name) for name in converted.triads},
    )
    digests = {"calibration": converted.sha256, "run": calibration.run_sha256}
    return enveloped("convert", content, calibration.tool, **digests)


def _triad(converted: Converted, name: str) -> ConvertedTriad:
    item, profile = converted.triads[name], getattr(converted.calibration.profile, name)
    triad = next(t for t in converted.calibration.triads if t.name == name)
    return ConvertedTriad(
        **{k: v.tolist() for k, v in item.values.items()},
        reference_temperature_c=converted.calibration.reference_temperature,
        axes=profile.axes,
        unit=triad.unit,
        nominal_raw_per_unit=profile.scale,
        standard_uncertainty={k: v.tolist() for k, v in item.uncertainty.items()},
        covariance=item.covariance.tolist(),
    )


def screen(converted: Converted) -> str:
    """The result for people: whose calibration it is, in which units, then the values."""
    calibration, at = converted.calibration, converted.temperature
    reference = calibration.reference_temperature
    serial = calibration.tool.get("serial", calibration.profile.name)
    first = [converted.path.name, serial, f"run {calibration.run}", calibration.software]
    stated = reference if at is None or converted.notation == "factors" else at
    shown = "course" if isinstance(stated, str) else f"{stated:g} °C"
    lines = [
        [*first, *simulated(calibration.tool)],
        [f"SHA-256 {converted.sha256}"],
        [f"notation {converted.notation}", f"temperature {shown}", _calibrated(converted)],
        [f"{t.name} raw per {t.unit}{_nominal(calibration, t.name)}" for t in calibration.triads],
    ]
    values = notation(converted.triads, reference if at == COURSE else None)
    return "\n".join(one_line("   ".join(line)) for line in lines) + "\n\n" + values


def _calibrated(converted: Converted) -> str:
    """The calibrated temperatures, and whether the values lie outside them."""
    if converted.calibration.temperature_c is None:
        return "calibrated at unrecorded temperatures"
    beyond = any(finding.id == "outside-temperature" for finding in converted.findings)
    outside = "extrapolated: " if beyond else ""
    return f"{outside}calibrated at {_range(converted.calibration)}"


def _nominal(calibration: Calibration, name: str) -> str:
    """The nominal scale of a triad, if the profile states one."""
    scale = getattr(calibration.profile, name).scale
    return "" if scale is None else f" (nominal {scale:.6g})"


def notation(triads: dict[str, Notation], reference: float | None = None) -> str:
    """Values with standard uncertainties, in as many digits as a firmware can hold.

    A course is stated by its `reference` temperature: each coefficient then names its power of τ.
    """
    course = reference is not None
    blocks = [f"τ = T - {reference:g} °C"] if course else []
    for triad, notation in triads.items():
        rows = [
            [_label(name, index, int(power) if course else None), *_stated(notation, name, index)]
            for name, value in notation.values.items()
            for index, power in np.ndenumerate(powers(name, value))
        ]
        blocks.append(f"{triad}\n" + table(rows, ["", "value", "1σ"]))
    return "\n\n".join(blocks)


def _stated(notation: Notation, name: str, index: tuple[int, ...]) -> tuple[str, str]:
    """A value and its standard uncertainty; the diagonal of m is zero in every model."""
    value, sd = (float(v[name][index]) for v in (notation.values, notation.uncertainty))
    diagonal = name == "m" and index[0] == index[1]
    if value == sd == 0 and not diagonal:
        return "0", HELD
    return f"{value + 0.0:.12g}", UNDETERMINED if np.isnan(sd) else f"{sd:.2g}"


def _label(name: str, index: tuple[int, ...], power: int | None) -> str:
    """Name and place of a value; in a course its power of τ instead of that index."""
    if power is not None and name != "m":
        index = index[:-1] if name in ("SF", "B") else index[1:]
    course = raised("·τ", power or 0)
    return name + "".join(f"[{i}]" for i in index) + course
