"""Test vectors: raw channels at attitudes and temperatures, with what `apply` makes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mwdcal.calibration.canonical import DIGITS
from mwdcal.calibration.prediction import readings_at
from mwdcal.calibration.record import Calibration
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import text
from mwdcal.files.formats.columns import Column
from mwdcal.files.runs import from_readings, to_readings
from mwdcal.firmware.c_text import initialiser
from mwdcal.firmware.working_range import ANGLES_OUT
from mwdcal.geometry.observables import OUTPUTS, RESULTS, VECTORS
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.use.correction import reference

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
"""What stands before the name of a result in the table of test vectors."""
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
    """What the status judges: gravity across the tool axis, field across it, and horizontal field (n,)."""
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
