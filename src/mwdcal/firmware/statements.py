"""What the sources say of themselves: whose calibration, its units and range, how exact they are."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal import __version__
from mwdcal.calibration.readings import NANOTESLA, SIMULATED, TRIADS, is_simulated
from mwdcal.calibration.record import Calibration
from mwdcal.files.contract import CHANNELS
from mwdcal.firmware.c_text import initialiser, literal, macro
from mwdcal.firmware.vectors import STATUS
from mwdcal.firmware.working_range import SHARE_OF, WorkingRange

VECTOR_NAMES = ("gravity", "field")
"""Vectors of the two triads."""
_HERE = "of the field where the tool was calibrated"


def field_unit(calibration: Calibration) -> str:
    """The unit of the field."""
    return _HERE if calibration.relative else NANOTESLA


def origin(calibration: Calibration, sha256: str) -> list[str]:
    """Whose calibration it is; the words of others cannot end a comment. One in memory has no `sha256`."""
    lines = {
        "tool": calibration.tool.get("serial", "without serial"),
        "profile": calibration.profile.name,
        "run": calibration.run_name,
        "calibrated": f"{calibration.time} by {calibration.software}, method {calibration.method}",
        **({"calibration": f"SHA-256 {sha256}"} if sha256 else {}),
        "written by": f"mwdcal {__version__}",
    }
    simulated = [SIMULATED] if is_simulated(calibration.tool) else []
    return [*simulated, *(_line(name, literal(value)) for name, value in lines.items())]


def head(
    calibration: Calibration, sha256: str, work: WorkingRange, errors: Mapping[str, float]
) -> list[str]:
    """Whose calibration, what it holds for, and how exact the sources are."""
    models = (
        f"{t.name} {t.model}, order {t.order}" + " with own-axis terms" * t.curved
        for t in calibration.triads
    )
    stated = stated_errors(calibration, errors).items()
    return [
        *origin(calibration, sha256),
        _line("model", f"{'; '.join(models)} in temperature"),
        _line("temperature", _temperatures(calibration, work)),
        _line(
            "units", f"gravity in g; field {_field(calibration)}; raw channels as in the run file"
        ),
        _line("range", _strengths(calibration, work)),
        *(_line("undetermined", literal(entry.text)) for entry in calibration.undetermined()),
        "",
        "Largest differences from mwdcal apply in that range. Those of toolface and azimuth are multiplied by the",
        "share of gravity across the tool axis, that of magnetic toolface by the share of the field across it.",
        _place(calibration),
        "",
        *(f"    {name.replace('_', ' '):<18} {text}" for name, text in stated),
    ]


def _line(name: str, text: str) -> str:
    return f"{name:<12} {text}"


def stated_errors(calibration: Calibration, errors: Mapping[str, float]) -> dict[str, str]:
    """Errors with their units: mg, that of the field, degrees."""
    units = {"gravity": (1000.0, "mg"), "field": (1.0, field_unit(calibration))}
    parts = {name: (error, *units.get(name, (1.0, "degrees"))) for name, error in errors.items()}
    return {name: f"{error * factor:.3g} {unit}" for name, (error, factor, unit) in parts.items()}


def _field(calibration: Calibration) -> str:
    if not calibration.has_field:
        return "not calibrated"
    return "relative, 1 where the tool was calibrated, not nT" if calibration.relative else "in nT"


def _temperatures(calibration: Calibration, work: WorkingRange) -> str:
    if calibration.temperature_c is None:
        return "unrecorded; the calibration has no temperature terms"
    ranges = (
        (f"{end:.12g}" for end in ends) for ends in (calibration.temperature_c, work.temperatures)
    )
    calibrated, used = (" to ".join(ends) for ends in ranges)
    zero = initialiser(calibration.reference_temperature)
    return f"calibrated from {calibrated} degrees C, used from {used}; tau = T - {zero}"


def _strengths(calibration: Calibration, work: WorkingRange) -> str:
    units = dict(zip(TRIADS, ("g", field_unit(calibration)), strict=True))
    names = dict(zip(TRIADS, VECTOR_NAMES, strict=True))
    return ", ".join(f"{names[n]} up to {s:.6g} {units[n]}" for n, s in work.strengths.items())


def _place(calibration: Calibration) -> str:
    """Gravity and field at which the errors of the angles hold."""
    earth = calibration.earth
    place = f"Angles at {earth['gravity_g']:.6g} g"
    if not calibration.has_field:
        return f"{place}."
    strength = "" if calibration.relative else f", {earth['field']:.6g} nT"
    dip = f"{earth['dip_deg']:.4g} degrees of dip"
    return f"{place}{strength} and {dip}; those from the field grow as it shrinks."


def status_macros(saturates: bool) -> str:
    """Bits of the status; those that both sources have are the same."""
    bits = {name: each for name, each in STATUS.items() if saturates or name != "SATURATED"}
    lines = [macro(f"MWDCAL_{name}", f"{bit}u", meaning) for name, (bit, meaning) in bits.items()]
    return "\n".join(["/* Status: the sum of what holds. */", *lines])


def error_macros(kind: str, errors: Mapping[str, float]) -> str:
    """Stated errors by quantity; zero where there is none."""
    names = (*VECTOR_NAMES, "inclination", *SHARE_OF)
    lines = [
        macro(f"MWDCAL_{kind}_ERROR_{n.upper()}", initialiser(errors.get(n, 0.0))) for n in names
    ]
    return "\n".join(
        ["/* The differences above, in g, the unit of the field, and degrees. */", *lines]
    )


def formats(calibration: Calibration, fractions: Mapping[str, int], bits: int) -> list[str]:
    """Each input and output of fixed-point numbers as a value times a power of two."""
    units = {
        **{name: f"raw channels {', '.join(names)}" for name, names in CHANNELS.items()},
        **{"temperature": "degrees C", "gravity": "g", "field": field_unit(calibration)},
    }
    words = [f"{name:<14} {units[name]} x 2^{power}" for name, power in fractions.items()]
    return [f"    {line}" for line in (*words, f"{'angles':<14} turns x 2^{bits}, without sign")]


def fraction_macros(fractions: Mapping[str, int]) -> str:
    """Powers of two of inputs and outputs; zero of a magnetometer that is not there."""
    names = (*TRIADS, "temperature", *VECTOR_NAMES)
    powers = {f"MWDCAL_FIXED_{n.upper()}_FRACTION": f"({fractions.get(n, 0)})" for n in names}
    return "\n".join(macro(name, power) for name, power in powers.items())
