"""A calibration in another notation or as C sources: on the screen and for machines."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings, simulated
from mwdcal.calibration.record import SOFTWARE, Calibration, Finding
from mwdcal.calibration.results import middle_temperature
from mwdcal.errors import InputError
from mwdcal.files.contract import TEMPERATURE
from mwdcal.files.formats import members
from mwdcal.firmware.c_source import stated_errors
from mwdcal.firmware.export import DEFAULT_BITS, FIXED_POINT, FirmwareSources, export
from mwdcal.firmware.quantisation import SHARE_OF
from mwdcal.geometry.vectors import AnyArray
from mwdcal.presentation.calibration_source import calibration_of
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import (
    HELD,
    RAW_MEANING,
    RAW_UNIT,
    UNDETERMINED,
    files_written,
    number,
    raw_unit,
    strength_unit,
    value_places,
)
from mwdcal.presentation.text import one_line, raised, table
from mwdcal.sensor.profile import Axis
from mwdcal.survey.tool_model import SensorTerm, sensor_terms, tool_model_text
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

    `name` and `sha256` are of the calibration file, empty for a calibration in memory; `temperature` is None where
    none was given.
    """

    name: str
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
    """The output of `convert`: whose calibration, then the values of each triad, or the sources.

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
    findings: list[Finding]
    notation: str | msgspec.UnsetType = msgspec.UNSET
    temperature_c: float | str | msgspec.UnsetType = msgspec.UNSET
    powers_of: str | msgspec.UnsetType = msgspec.UNSET
    accelerometer: ConvertedTriad | msgspec.UnsetType = msgspec.UNSET
    magnetometer: ConvertedTriad | msgspec.UnsetType = msgspec.UNSET
    to: str | msgspec.UnsetType = msgspec.UNSET
    word_bits: int | msgspec.UnsetType | None = msgspec.UNSET
    folder: str | msgspec.UnsetType = msgspec.UNSET
    files: list[str] | msgspec.UnsetType = msgspec.UNSET
    errors: dict[str, float] | msgspec.UnsetType = msgspec.UNSET
    multiplied_by_share_across_axis_of: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    powers_of_two: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    temperature_range_c: tuple[float, float] | msgspec.UnsetType | None = msgspec.UNSET
    strongest: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    terms: list[SensorTerm] | msgspec.UnsetType = msgspec.UNSET


def _identified(source: Calibration | PathLike[str] | str) -> tuple[str, str, Calibration]:
    """Name and SHA-256 of the file of a calibration, both empty for one in memory, and the calibration."""
    if isinstance(source, Calibration):
        return "", "", source
    calibration, sha256 = calibration_of(Path(source))
    return members.name_of(source), sha256, calibration


def converted(
    source: Calibration | PathLike[str] | str,
    notation: str,
    temperature: float | str | None = None,
) -> Converted:
    """A calibration, from memory or a file, in a notation; `temperature` as of `notation.convert`.

    Raises:
        InputError: a temperature or a notation that is not possible, or a file that cannot be read.
    """
    name, sha256, calibration = _identified(source)
    _check_temperature(temperature)
    triads = convert(calibration, notation, temperature)
    findings = temperature_findings(calibration, notation, temperature)
    findings += calibration.change_findings()
    return Converted(name, sha256, calibration, notation, temperature, triads, findings)


def terms_at(
    source: Calibration | PathLike[str] | str, temperature: float | str | None, toolface_deg: float | None = None
) -> tuple[Converted, list[SensorTerm], str]:  # fmt: skip
    """The sensor terms of a calibration at a temperature, and the text of its tool model; at one toolface if it stays.

    Raises:
        FitError: a term is undetermined.
        InputError: a temperature or toolface that is not possible, or a file that cannot be read.
    """
    name, sha256, calibration = _identified(source)
    _check_temperature(temperature)
    if toolface_deg is not None and not -360 <= toolface_deg <= 360:
        raise InputError(f"`toolface` must be an angle in degrees; got {toolface_deg:g}.")
    if isinstance(temperature, str):
        raise InputError(
            f"`temperature` of a tool model must be a number in °C; got {temperature!r}."
        )
    findings = [] if temperature is None else temperature_findings(calibration, "", temperature)
    findings += calibration.change_findings()
    result = Converted(name, sha256, calibration, "", temperature, {}, findings)
    terms = sensor_terms(calibration, temperature)
    toolface = None if toolface_deg is None else float(np.radians(toolface_deg))
    model = tool_model_text(calibration, temperature=temperature, toolface=toolface)
    return result, terms, model


def _check_temperature(temperature: float | str | None) -> None:
    """Refuse a temperature that no tool has; a word is left to the conversion."""
    if temperature is None or isinstance(temperature, str):
        return
    if not TEMPERATURE.low <= temperature <= TEMPERATURE.high:
        raise InputError(f"`temperature` must be {TEMPERATURE}; got {temperature:g}.")


def terms_document(
    converted: Converted, terms: list[SensorTerm], output: Path | None = None
) -> dict[str, Any]:
    """The sensor terms for machines."""
    at = converted.temperature
    content = ConversionSummary(
        **_identity(converted),
        to="tool-model",
        temperature_c=middle_temperature(converted.calibration) if at is None else at,
        files=[str(output)] if output else [],
        terms=terms,
    )
    return _enveloped(converted, content)


def terms_screen(converted: Converted, terms: list[SensorTerm], output: Path | None = None) -> str:
    """The sensor terms for people."""
    rows = [
        [
            term.name,
            *(number(value, 3) for value in (term.value, term.owsg)),
            term.unit,
            UNDETERMINED if term.ratio is None else number(term.ratio, 2),
        ]
        for term in terms
    ]
    heading = "\n".join(one_line("   ".join(line)) for line in _heading(converted))
    shown = table(rows, ["term", "1σ", "OWSG MWD", "unit", "ratio"])
    files = [files_written(**{"tool model": output})] if output else []
    return "\n".join([heading, "", shown, *files])


def temperature_findings(
    calibration: Calibration, notation: str, temperature: float | str | None
) -> list[Finding]:
    """The finding where the values are asked for at a temperature without calibration.

    The reference temperature counts as asked for where the values depend on it.
    """
    varies = notation != "factors" and calibration.thermal
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
    course = isinstance(converted.temperature, str)
    triads: dict[str, Any] = {name: _triad(converted, name) for name in converted.triads}
    content = ConversionSummary(
        **_identity(converted),
        **triads,
        notation=converted.notation,
        temperature_c=stated_temperature(converted),
        powers_of="T - reference_temperature_c" if course else msgspec.UNSET,
    )
    return _enveloped(converted, content)


def stated_temperature(converted: Converted) -> float | str:
    """The temperature of the values, °C: factors are those at the reference temperature; or that they are a course."""
    at = converted.temperature
    if at is None or (converted.notation == "factors" and not isinstance(at, str)):
        return converted.calibration.reference_temperature
    return at


def _identity(converted: Converted | Exported) -> dict[str, Any]:
    """Where the values come from: tool, run and calibration file."""
    calibration = converted.calibration
    return {
        "tool": calibration.tool,
        "profile": calibration.profile.name,
        "run": calibration.run,
        "calibration": converted.name,
        "calibrated": calibration.time,
        "software": calibration.software,
        "converted_by": SOFTWARE,
        "calibrated_temperature_c": calibration.temperature_c,
        "field_unit": calibration.field_unit,
        "findings": converted.findings,
    }


def _enveloped(converted: Converted | Exported, content: ConversionSummary) -> dict[str, Any]:
    calibration = converted.calibration
    digests = {"calibration": converted.sha256, "run": calibration.run_sha256}
    return json_document("convert", content, calibration.tool, **digests)


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
    stated = stated_temperature(converted)
    shown = "course" if isinstance(stated, str) else f"{stated:g} °C"
    lines = [
        *_heading(converted),
        [f"notation {converted.notation}", f"temperature {shown}", _calibrated(converted)],
        _units(calibration),
    ]
    values = notation(converted.triads, reference if at == COURSE else None)
    return "\n".join(one_line("   ".join(line)) for line in lines) + "\n\n" + values


def _heading(converted: Converted | Exported) -> list[list[str]]:
    """Whose calibration it is, and the digest of its file."""
    calibration = converted.calibration
    file = [converted.name] if converted.name else []
    first = [*file, calibration.tool_name, f"run {calibration.run_name}", calibration.software]
    digest = [[f"SHA-256 {converted.sha256}"]] if converted.sha256 else []
    return [[*first, *simulated(calibration.tool)], *digest]


def _calibrated(converted: Converted) -> str:
    """The calibrated temperatures, and whether the values lie outside them."""
    if converted.calibration.temperature_c is None:
        return "calibrated at unrecorded temperatures"
    beyond = any(finding.id == "outside-temperature" for finding in converted.findings)
    outside = "extrapolated: " if beyond else ""
    return f"{outside}calibrated at {_range(converted.calibration)}"


def _units(calibration: Calibration) -> list[str]:
    """The unit of each triad's scale, and the meaning of "raw" where the profile does not name a unit."""
    raw = {t.name: raw_unit(calibration.profile, t.name) for t in calibration.triads}
    each = [
        f"{t.name} {raw[t.name]} per {t.unit}{_nominal(calibration, t.name)}"
        for t in calibration.triads
    ]
    return [*each, *([RAW_MEANING] if RAW_UNIT in raw.values() else [])]


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


def value_table(converted: Converted) -> dict[str, AnyArray]:
    """A row for each value: triad, name, value, 1σ (NaN: undetermined) and unit; factors are named as in the report."""
    calibration, columns = converted.calibration, ("triad", "name", "value", "sd", "unit")
    rows = [
        (t.name, name + axes + raised("·τ", power), values[name][at], sd[name][at], unit)
        for t in calibration.triads
        for values, sd in [(converted.triads[t.name].values, converted.triads[t.name].uncertainty)]
        for name, at, axes, power, unit in value_places(
            values, raw_unit(calibration.profile, t.name), strength_unit(t), "1"
        )
    ]
    return {
        name: np.array(cells) for name, cells in zip(columns, zip(*rows, strict=True), strict=True)
    }


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


class Exported(NamedTuple):
    """A calibration as C sources: where from, in which form, and what to know of it."""

    name: str
    sha256: str
    calibration: Calibration
    form: str
    word_bits: int | None
    sources: FirmwareSources
    findings: list[Finding]


def check_bits(form: str | None, word_bits: int | None) -> None:
    """Refuse bits of whole numbers for a form that has none."""
    if word_bits is not None and form != FIXED_POINT:
        raise InputError("`word_bits` goes with `form` fixed-point. Leave it out, or add that.")


def exported(
    source: Calibration | PathLike[str] | str, form: str, word_bits: int | None = None
) -> Exported:
    """The C sources of a calibration, from memory or a file; `form` as of `firmware.export`.

    Raises:
        InputError: an unknown form, bits of another form, or fixed-point numbers that cannot carry the calibration.
    """
    check_bits(form, word_bits)
    name, sha256, calibration = _identified(source)
    bits = (word_bits or DEFAULT_BITS) if form == FIXED_POINT else None
    sources = export(calibration, form, sha256, bits or DEFAULT_BITS)
    findings = calibration.change_findings()
    return Exported(name, sha256, calibration, form, bits, sources, findings)


def export_document(exported: Exported, folder: Path | None = None) -> dict[str, Any]:
    """The sources for machines: identity, files, and how exact they are."""
    sources = exported.sources
    content = ConversionSummary(
        **_identity(exported),
        to=exported.form,
        word_bits=exported.word_bits,
        folder=str(folder or ""),
        files=list(sources.files),
        errors={_error_names(exported)[name]: error for name, error in sources.errors.items()},
        multiplied_by_share_across_axis_of=dict(SHARE_OF),
        powers_of_two=dict(sources.fractions),
        temperature_range_c=sources.work.temperatures,
        strongest=dict(sources.work.strengths),
    )
    return _enveloped(exported, content)


def _error_names(exported: Exported) -> dict[str, str]:
    """Names of the errors with their units."""
    field = "field" if exported.calibration.relative else "field_nt"
    angles = {name: f"{name}_deg" for name in exported.sources.errors}
    return angles | {"gravity": "gravity_g", "field": field}


def export_screen(exported: Exported, folder: Path | None = None) -> str:
    """The sources for people: whose calibration, how exact, and the files."""
    stated = stated_errors(exported.calibration, exported.sources.errors)
    heading = _heading(exported)
    words = [f"{exported.word_bits} bits"] if exported.word_bits else []
    place = f"wrote {one_line(folder)}" if folder else "files"
    lines = [*heading, [exported.form, *words]]
    rows = [[_error_title(name), text.replace(" degrees", "°")] for name, text in stated.items()]
    return "\n".join(
        [
            *(one_line("   ".join(line)) for line in lines),
            "",
            table(rows, ["", "largest difference from apply"]),
            "",
            f"{place}: {', '.join(exported.sources.files)}",
        ]
    )


def _error_title(name: str) -> str:
    """The subject of an error, and the share by which it is multiplied."""
    if name not in SHARE_OF:
        return name
    return f"{name.replace('_', ' ')} · {SHARE_OF[name]} across the axis"
