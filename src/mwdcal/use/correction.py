"""Readings through a calibration: vectors, angles and strengths, in the units of files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.geometry.observables import EXTRAPOLATED, OBSERVABLES, OUTPUTS, RESULTS, VECTORS
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.use import correction_numba, strengths
from mwdcal.use.strengths import Strengths

OUTSIDE = ("blank", "refuse", "extrapolate")
JUDGED = ("gravity", "inclination", "toolface", "azimuth", "field", "dip", "magnetic_toolface")
"""Observables that a calibration may leave undetermined."""
DIRECTIONS = {
    "gravity_g": ("inclination_deg", "azimuth_deg", "toolface_deg", "dip_deg"),
    "field_nt": ("azimuth_deg", "dip_deg", "magnetic_toolface_deg"),
}
"""Directions that do not exist where a strength is zero."""
COMPILED_ROWS = 300_000
"""Number of rows from which the compiled loops repay their loading."""


class RowCounts(NamedTuple):
    """Rows of a table, counted by what the findings report of them.

    `beyond`: outside the calibrated temperatures; `moved`: outputs that rest on a free direction;
    `lacking`: without a reading; `warmth`: lowest and highest temperature, °C.
    """

    rows: int
    beyond: int = 0
    moved: tuple[str, ...] = ()
    lacking: int = 0
    serials: tuple[str, ...] = ()
    strengths: Mapping[str, Strengths] = {}
    warmth: tuple[float, float] = (np.inf, -np.inf)

    def blank(self, outside: str) -> int:
        """Number of rows without results: without a reading, or `outside` the temperatures."""
        return self.lacking + (self.beyond if outside == "blank" else 0)


def correct(
    calibration: Calibration, readings: Readings, outside: str = "blank"
) -> tuple[dict[str, AnyArray], list[Finding]]:
    """Output columns (n,) by name, and the findings.

    Refuses readings most of which have a strength that no place on Earth has, or that is off their
    reference.

    Singular: at exactly vertical attitudes azimuth and toolface are NaN (blank in files);
    `magnetic_toolface_deg` stands beside them. A strength of zero has no direction: NaN.
    Temperatures outside the calibrated range are blanked, refused or extrapolated as `outside` says.
    """
    columns, _, about = counted(calibration, readings, outside)
    return columns, about


def counted(
    calibration: Calibration, readings: Readings, outside: str, lacking: int = 0
) -> tuple[dict[str, AnyArray], RowCounts, list[Finding]]:
    """Output columns, counts of the rows and findings; `lacking` more rows were left out unread."""
    check_outside(outside)
    columns: dict[str, AnyArray] = {
        **(compiled(calibration, readings) or reference(calibration, readings))
    }
    beyond = calibration.outside(readings)
    rows, moved = readings.count + lacking, undetermined(calibration, readings)
    if outside == "blank" and beyond.any():
        columns = {name: np.where(beyond, np.nan, value) for name, value in columns.items()}
    tally = RowCounts(
        rows, int(beyond.sum()), moved, lacking, (),
        strengths.judged(calibration, columns, readings.known), warmth(readings.temperature),
    )  # fmt: skip
    about = findings(calibration, readings, tally, outside)
    strengths.check(calibration, tally.strengths, readings.name)
    if outside == "extrapolate":
        columns[EXTRAPOLATED] = beyond
    return columns, tally, about


def warmth(temperature: Array | None) -> tuple[float, float]:
    """Lowest and highest of temperatures, °C; infinite ends where there are none."""
    if temperature is None:
        return np.inf, -np.inf
    return float(temperature.min(initial=np.inf)), float(temperature.max(initial=-np.inf))


def result_names(outside: str) -> tuple[str, ...]:
    """The columns of results, in their order."""
    return (*RESULTS, EXTRAPOLATED) if outside == "extrapolate" else RESULTS


def check_outside(outside: str) -> None:
    """Refuse an unknown choice for temperatures outside the calibrated range."""
    if outside not in OUTSIDE:
        raise InputError(f"`outside` must be one of {', '.join(OUTSIDE)}; got {outside!r}.")


def reference(calibration: Calibration, readings: Readings) -> dict[str, Array]:
    """The output columns (..., n) by plain NumPy, nothing blanked for its temperature."""
    g, b = calibration.fields(readings)
    columns = dict(zip(VECTORS, [*np.moveaxis(g, -1, 0), *np.moveaxis(b, -1, 0)], strict=True))
    for name, column in OUTPUTS.items():
        value = OBSERVABLES[name].value(g, b)
        columns[column] = np.degrees(value) if OBSERVABLES[name].unit == "rad" else value
    for strength, names in DIRECTIONS.items():
        nothing = columns[strength] == 0.0
        for name in names:
            columns[name] = np.where(nothing, np.nan, columns[name])
    return columns


def compiled(
    calibration: Calibration, readings: Readings, least: int | None = None
) -> dict[str, Array] | None:
    """The same columns by the compiled loops; None for few rows, or a model they do not have."""
    shape = readings.accelerometer.shape[:-1]
    triads = numbers(calibration)
    unknown = readings.temperature is None and any(t.order for t in calibration.triads)
    few = np.prod(shape) < (COMPILED_ROWS if least is None else least)
    if few or triads is None or unknown or not correction_numba.available():
        return None
    zero = calibration.reference_temperature
    warmth = zero if readings.temperature is None else readings.temperature
    flat = np.ascontiguousarray(np.broadcast_to(warmth, shape), float).reshape(-1)
    g, b = readings.accelerometer, readings.magnetometer
    vectors = [*_axes(g), *(_axes(b) if b is not None else [np.full(flat.shape, np.nan)] * 3)]
    results = correction_numba.run([*vectors, flat], triads, zero)
    return {n: c.reshape(shape) for n, c in zip(RESULTS, results.columns, strict=True)}


def _axes(vectors: Array) -> list[Array]:
    """The three components (n,) of vectors (..., 3), as views where the memory allows it."""
    flat = np.ascontiguousarray(vectors, float).reshape(-1, 3)
    return [flat[:, i] for i in range(3)]


def numbers(
    calibration: Calibration,
) -> tuple[correction_numba.Numbers, correction_numba.Numbers] | None:
    """Both triads for the compiled loops; None where a model is not for them."""
    reference = calibration.reference_temperature
    triads = [
        correction_numba.numbers(t.functions(reference), np.array(t.parameters))
        for t in calibration.triads
    ]
    first, second = [*triads, correction_numba.NOTHING][:2]
    return None if first is None or second is None else (first, second)


def findings(
    calibration: Calibration, readings: Readings, tally: RowCounts, outside: str
) -> list[Finding]:
    """Findings about corrected rows; refuses rows outside the temperatures if `outside` says so.

    Of the readings only the metadata are used, and whether there is a magnetometer.
    """
    about = calibration.change_findings()
    if calibration.has_field and readings.magnetometer is None:
        text = "no columns mx, my, mz: magnetic results are blank."
        about.append(Finding(id="no-magnetometer", text=text))
    about += _other_tool(calibration, readings)
    if tally.lacking:
        text = f"{tally.lacking} of {tally.rows} rows lack a reading: their results are blank."
        about.append(Finding(id="missing-reading", text=text))
    if tally.beyond:
        about.append(_outside(calibration, readings.source, outside, tally))
    if calibration.unrecorded(readings):
        at = "…".join(dict.fromkeys(f"{end:.1f}" for end in tally.warmth))
        text = (
            "the calibration was made at unrecorded temperatures, without temperature terms: nothing says how "
            f"good the results are at the readings' {at} °C."
        )
        about.append(Finding(id="no-temperature", text=text))
    about += strengths.findings(tally.strengths)
    if calibration.relative:
        text = "the magnetometer is calibrated to field = 1: bx_nt, by_nt, bz_nt and field_nt are relative, not nT."
        about.append(Finding(id="field-relative", text=text))
    if tally.moved:
        free = ", ".join(dict.fromkeys(u.id for u in calibration.undetermined()))
        text = f"{', '.join(tally.moved)} rest on what the calibration leaves undetermined ({free})"
        about.append(Finding(id="undetermined", text=f"{text}: no uncertainty can be stated."))
    return about


def _other_tool(calibration: Calibration, readings: Readings) -> list[Finding]:
    other = calibration.other_tool(readings)
    if other is None:
        return []
    ours, theirs = other
    text = (
        f"the readings are of tool {theirs}, the calibration of tool {ours}: is it the right one?"
    )
    return [Finding(id="other-tool", text=text)]


def _outside(calibration: Calibration, source: str, how: str, tally: RowCounts) -> Finding:
    low, high = calibration.temperature_c or (np.nan, np.nan)
    text = f"{tally.beyond} of {tally.rows} rows lie outside the calibrated range {low:.1f}…{high:.1f} °C"
    if how == "refuse":
        raise InputError(
            f"{source}: {text}. Use `outside` blank or extrapolate, or calibrate over a wider range."
        )
    results = "their results are blank"
    if how == "extrapolate":
        results = (
            "their results are extrapolated, with no statement of accuracy, and marked in the column "
            f"'{EXTRAPOLATED}'"
        )
    return Finding(id="outside-temperature", text=f"{text}: {results}.")


def undetermined(
    calibration: Calibration, readings: Readings, names: Sequence[str] = JUDGED
) -> tuple[str, ...]:
    """Those of the outputs that rest, in any row, on a direction the calibration leaves free.

    A row without field or gravity has no directions, and none that could be undetermined.
    """
    if not calibration.free:
        return ()
    with np.errstate(invalid="ignore", divide="ignore"):
        return tuple(n for n in names if calibration.rests_on_free(n, readings).any())
