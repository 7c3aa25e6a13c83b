"""Statements in the sources about themselves: whose calibration, its units and range, how exact they are.

Python values as C source: text of others that stays text, numbers, initialisers and macros.

The coefficients of a calibration as C initialisers: as the file has them, and in words.

Test vectors: raw channels at attitudes and temperatures, with what `apply` makes of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import resources
from string import Template

import numpy as np

from mwdcal import __version__
from mwdcal.calibration.readings import NANOTESLA, SIMULATED, TRIADS, is_simulated
from mwdcal.calibration.record import DIGITS, Calibration, TriadCalibration
from mwdcal.calibration.results import readings_at
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import text
from mwdcal.files.formats.columns import Column
from mwdcal.files.runs import from_readings, to_readings
from mwdcal.firmware.quantisation import (
    ANGLES_OUT,
    SHARE_OF,
    FixedCalibration,
    FixedTriad,
    WorkingRange,
)
from mwdcal.geometry.observables import OUTPUTS, RESULTS, VECTORS
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.models import affine_parts, factor_parts
from mwdcal.sensor.profile import TriadProfile
from mwdcal.use.correction import reference

LONGEST_TEXT = 200
"""Characters of a text of others that are kept: C promises no more than 4095 in a string."""
_SPECIAL = '"\\*?'


def literal(text: object) -> str:
    r"""Text of others for a comment or a string, neither of which it can end.

    What C could take for more than text is an octal escape of its UTF-8 bytes, which a string gives back.

    >>> literal('A*/ "B"??/\n°')
    'A\\052/ \\042B\\042\\077\\077/\\012\\302\\260'
    """
    shown = str(text)
    cut = shown[:LONGEST_TEXT] + (" ..." if shown[LONGEST_TEXT:] else "")
    return "".join(c if " " <= c <= "~" and c not in _SPECIAL else _octal(c) for c in cut)


def _octal(character: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in character.encode("utf-8", "surrogatepass"))


def initialiser(values: AnyArray | float) -> str:
    """Nested braces with every number in the digits it has; a negative zero is zero.

    >>> initialiser(np.array([[1.0, -0.0], [0.25, 1e-05]]))
    '{{1.0, 0.0}, {0.25, 1e-05}}'
    """
    if isinstance(values, np.ndarray) and values.shape:
        return "{" + ", ".join(map(initialiser, values)) + "}"
    return repr(np.asarray(values + 0).item())


def comment(lines: Iterable[str]) -> str:
    """The lines of a block comment, each with its star; blank ones without a space at the end."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def macro(name: str, value: str, remark: str = "") -> str:
    """A definition on one line."""
    return f"#define {name} {value}" + (f" /* {remark} */" if remark else "")


def source(name: str, **values: object) -> str:
    """A source file of the package, its `$names` replaced by values; without values as it stands."""
    text = resources.files("mwdcal.firmware").joinpath("sources", name).read_text("utf-8")
    return Template(text).substitute(values) if values else text


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
    """Stated errors by quantity; zero without a statement."""
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


def order(calibration: Calibration) -> int:
    """The highest order of a triad, which the arrays of all have."""
    return max(triad.order for triad in calibration.triads)


def double_initialiser(calibration: Calibration) -> str:
    """All triads as `mwdcal_double_triad`: the numbers of the calibration file."""
    return _listed(
        (
            triad.name,
            _wiring(getattr(calibration.profile, triad.name)) | _courses(triad, order(calibration)),
        )
        for triad in calibration.triads
    )


def _wiring(profile: TriadProfile) -> dict[str, AnyArray]:
    """The channel of each tool axis, and its raw units per g or nT with their sign."""
    signed = profile.permutation
    return {
        "channel": np.argmax(np.abs(signed), -1),
        "unit": signed.sum(-1) * (profile.scale or 1.0),
    }


def _courses(triad: TriadCalibration, highest: int) -> dict[str, AnyArray]:
    """The fields of a triad from `centre` on; those that its model lacks change nothing."""
    params = np.array(triad.parameters)
    scale, bias, offset = np.ones((3, 1)), np.zeros((3, 1)), np.zeros((3, 1))
    gain, curves = np.eye(3)[..., None], np.zeros((2, 3))
    if triad.model == "factors":
        scale, bias, misalignment = factor_parts(params)
        gain = (np.eye(3) - misalignment)[..., None]
    else:
        affine = 12 * (triad.order + 1)
        matrix, constant = affine_parts(params[:affine].reshape(-1, 12))
        gain, offset = np.moveaxis(matrix, 0, -1), constant.transpose()
        curves = params[affine:].reshape(2, 3) if triad.curved else curves
    courses = {"scale": scale, "bias": bias, "gain": gain, "offset": offset}
    return {
        **{"centre": np.array(triad.centre), "radius": np.array(triad.radius)},
        **{name: _padded(values, highest) for name, values in courses.items()},
        **{"square": curves[0], "cube": curves[1]},
    }


def fixed_initialiser(fixed: FixedCalibration, highest: int) -> str:
    """All triads as `mwdcal_fixed_triad`."""
    return _listed((triad.name, _words(triad, highest) | _shifts(triad)) for triad in fixed.triads)


def _words(triad: FixedTriad, highest: int) -> dict[str, AnyArray]:
    nothing = np.zeros((3, 1), int)
    courses = {"scale": triad.scale, "bias": triad.bias, "gain": triad.gain, "offset": triad.offset}
    return {
        name: _padded(course.words if course else nothing, highest)
        for name, course in courses.items()
    }


def _shifts(triad: FixedTriad) -> dict[str, AnyArray]:
    """Powers of two between the words of a triad."""
    total = triad.middle + triad.gain.fraction
    shifts = {
        "factors": int(triad.scale is not None),
        "quotient": triad.middle + triad.scale.fraction - triad.raw if triad.scale else 0,
        "lift": total - triad.offset.fraction,
        "sum": total - triad.field,
    }
    return {name: np.array(value) for name, value in shifts.items()}


def _padded(values: AnyArray, highest: int) -> AnyArray:
    """Coefficients (..., K) by power, with zeros up to the highest."""
    spare = highest + 1 - values.shape[-1]
    return np.concatenate([values, np.zeros((*values.shape[:-1], spare), values.dtype)], -1)


def _listed(triads: Iterable[tuple[str, Mapping[str, AnyArray]]]) -> str:
    """Initialisers of triads, a field with its name on each line."""
    blocks = []
    for name, fields in triads:
        lines = [f"        /* {field} */ {_rows(value)},\n" for field, value in fields.items()]
        blocks.append(f"    /* {name} */\n    {{\n{''.join(lines)}    }},\n")
    return "{\n" + "".join(blocks) + "}"


def _rows(value: AnyArray) -> str:
    """An initialiser; of a matrix of courses with a row on each line."""
    if len(value.shape) < 3:
        return initialiser(value)
    return "{\n" + "".join(f"            {initialiser(row)},\n" for row in value) + "        }"


STATUS = {
    "VERTICAL": (1, "inclination 0 or 180 degrees: no azimuth and no toolface"),
    "NO_GRAVITY": (2, "no gravity: no inclination, azimuth and toolface"),
    "NO_NORTH": (4, "no horizontal field, or no magnetometer: no azimuth"),
    "AXIAL_FIELD": (8, "no field across the tool axis, or no magnetometer: no magnetic toolface"),
    "OUTSIDE_TEMPERATURE": (
        16,
        "outside the calibrated temperatures: results without a stated accuracy",
    ),
    "SATURATED": (32, "a value does not fit its word: results are wrong"),
}
"""Bits of the status by name, and what they mean; the last of fixed-point numbers alone."""
EXPECTED = "expected_"
"""Prefix of the name of a result in the table of test vectors."""
_VECTOR_ATTITUDES = np.radians(
    np.array(
        [
            [0, 180, 0.5, 3, 30, 60, 90, 120, 150, 178],
            [30, 0, 200, 75, 120, 10, 300, 165, 250, 340],
            [0, 60, 340, 15, 100, 205, 280, 45, 170, 310],
        ]
    )
)
"""Inclination, azimuth, toolface (3, n)."""
_QUANTITIES = {"g": "gravity", "nt": "field", "deg": "angle"}
"""The quantity of a column by the end of its name."""
CLEARLY = 1.125
"""A size so many times a limit, or less than the limit by as much, clearly is on its side."""
_EXPECTED_DECIMALS = {"gravity": 10, "field": 5}


def expected(calibration: Calibration) -> dict[str, Array]:
    """Columns of raw channels and temperature as in a run file, to 12 digits, and of the results."""
    ends = calibration.temperature_c or (calibration.reference_temperature,)
    warmths = np.unique([float(f"{t:.6g}") for t in (*ends, np.mean(ends))])
    inclination, azimuth, toolface = (np.tile(angle, len(warmths)) for angle in _VECTOR_ATTITUDES)
    warmth = np.repeat(warmths, _VECTOR_ATTITUDES.shape[-1])
    readings = readings_at(calibration, inclination, azimuth, toolface, warmth)
    table = from_readings(readings, calibration.profile)
    columns = {name: column for name, column in table.columns.items() if name != "station"}
    raw = {name: _formatted(column, f".{DIGITS}g") for name, column in columns.items()}
    again, _ = to_readings(replace(table, columns=raw), calibration.profile)
    results = reference(calibration, again)
    quantities = {name: _QUANTITIES[name.rpartition("_")[2]] for name in RESULTS}
    places = {name: decimals(calibration, quantity) for name, quantity in quantities.items()}
    return raw | {name: _formatted(results[name], f".{places[name]}f") for name in RESULTS}


def decimals(calibration: Calibration, quantity: str) -> int:
    """Decimals of expected gravity, field and angles; a relative field has those of gravity."""
    like_gravity = quantity == "field" and calibration.relative
    return _EXPECTED_DECIMALS.get("gravity" if like_gravity else quantity, 8)


def _formatted(values: Column, form: str) -> Array:
    """Numbers as a format writes them; no negative zero."""
    return np.array([float(f"{float(value):{form}}") for value in values]) + 0.0


def words(columns: Mapping[str, Array], fractions: Mapping[str, int]) -> dict[str, Ints]:
    """Raw channels and temperatures as words; none without `fractions`, the powers of two by quantity."""
    kinds = {name: kind for kind, names in CHANNELS.items() for name in names}
    powers = {n: fractions.get(kinds.get(n, n.removesuffix("_c"))) for n in columns}
    return {n: np.rint(columns[n] * 2.0**p).astype(int) for n, p in powers.items() if p is not None}


def _sizes(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Strengths that the status judges: gravity across the tool axis, field across it, and horizontal field (n,)."""
    g, b = (np.stack([columns[name] for name in names], -1) for names in (VECTORS[:3], VECTORS[3:]))
    b = np.nan_to_num(b)
    level = np.linalg.norm(np.cross(g, b), axis=-1) / np.linalg.norm(g, axis=-1)
    across = np.hypot(g[:, 0], g[:, 1])
    return {"VERTICAL": across, "NO_NORTH": level, "AXIAL_FIELD": np.hypot(b[:, 0], b[:, 1])}


def status(columns: Mapping[str, Array], weak: tuple[float, float]) -> Ints:
    """The status (n,) that each test vector must give; `weak`: gravity, g, and field without a direction.

    -1 where a vector is too close to either to tell.
    """
    limits = dict(zip(("VERTICAL", "NO_NORTH", "AXIAL_FIELD"), (*weak, weak[1]), strict=True))
    sizes = _sizes(columns)
    lacking = {name: sizes[name] <= limit for name, limit in limits.items()}
    lacking["NO_NORTH"] = lacking["NO_NORTH"] & ~lacking["VERTICAL"]
    close = [np.abs(sizes[name] - limit) < (CLEARLY - 1) * limit for name, limit in limits.items()]
    codes = sum(flags * STATUS[name][0] for name, flags in lacking.items())
    return np.where(np.any(close, 0), -1, codes)


def initialisers(columns: Mapping[str, Array], words: Mapping[str, AnyArray], codes: Ints) -> str:
    """The test vectors, one a line: channels and temperature, or their `words`, status, vectors, angles."""
    count = len(codes)
    inputs = {**columns, **words}
    zeros = np.zeros(count, int if words else float)
    triads = [np.stack([inputs.get(n, zeros) for n in names], -1) for names in CHANNELS.values()]
    vectors = np.stack([np.nan_to_num(columns[name]) for name in VECTORS], -1).reshape(-1, 2, 3)
    angles = np.stack([np.nan_to_num(columns[OUTPUTS[name]]) for name in ANGLES_OUT], -1)
    lines = []
    for i in range(count):
        parts = [*(t[i] for t in triads), inputs["temperature_c"][i]]
        cells = [initialiser(part) for part in (*parts, codes[i], *vectors[i], *angles[i])]
        lines.append("    {" + ", ".join(cells) + "},\n")
    return "{\n" + "".join(lines) + "}"


def table(
    columns: Mapping[str, Array],
    words: Mapping[str, AnyArray],
    codes: Ints,
    metadata: Mapping[str, object],
) -> str:
    """The test vectors as a run file, with their words and results beside the raw channels."""
    results = {n: c for n, c in columns.items() if n in RESULTS and not np.isnan(c).all()}
    whole = {**{f"word_{n}": w for n, w in words.items()}, f"{EXPECTED}status": codes}
    named = {n: c for n, c in columns.items() if n not in RESULTS}
    named |= {f"{EXPECTED}{n}": c for n, c in results.items()}
    return text.render(
        {**named, **{n: w.astype(str).tolist() for n, w in whole.items()}}, metadata, ","
    )
