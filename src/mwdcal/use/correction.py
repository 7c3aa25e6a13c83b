"""Readings through a calibration: vectors, angles and strengths, in the units of files.

Strengths and dip of corrected rows that change from row to row as those of no place do.

Swapped axes, or one with the wrong sign, leave the strength of each vector as it is, and the dip varies with the
attitude of the tool. A table that goes slowly from place to place changes little between neighbouring rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.identity import doubts, other_tool
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import MARGIN, Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.geometry.observables import (
    EXTRAPOLATED,
    OBSERVABLES,
    OUTPUTS,
    RESULTS,
    UNCERTAINTIES,
    VECTORS,
)
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.sensor.profile import tolerance
from mwdcal.use import correction_numba, strengths
from mwdcal.use.strengths import Strengths
from mwdcal.use.uncertainty import (
    LARGEST_DIRECTION_SD,
    rows_of,
    standard_uncertainties,
    with_uncertainty,
)

STEADY_CHANGES = {"gravity": 0.005, "field": 0.03, "dip": 2.0}
"""Changes from row to row that a sound tool may see: g, a share of the field, degrees."""
DEVIATIONS = 5.0
"""Standard uncertainties of a reading that such a change exceeds as well."""
LAGS = (1, 4, 16)
"""Rows from one to another: repeated shots at one attitude are passed over."""
WINDOW_ROWS = 512
"""Neighbouring rows that are looked at together."""
WINDOWS = 4
"""Most windows of a part of a table."""
FEWEST_ROWS = 2
"""Fewest rows that are judged."""
ROWS_PER_LAG = 4
"""Rows of a window for each row of the longest lag."""
ABOUT = 5
"""Rows, with its own, to whose median a row is compared."""


class Scatter(NamedTuple):
    """Windows of rows of a table that were looked at, those in which a value scatters, and its extremes in these.

    `allowed`: the median 1σ of one row. `odd` of the `rows` of windows that do not scatter depart from the rows
    about them; `farthest`: by how much at most, and the value there.
    """

    windows: int = 0
    scattered: int = 0
    low: float = np.inf
    high: float = -np.inf
    allowed: float = 0.0
    rows: int = 0
    odd: int = 0
    farthest: tuple[float, float] = (0.0, np.nan)


def scatters(
    calibration: Calibration, readings: Readings, columns: Mapping[str, AnyArray]
) -> dict[str, Scatter]:
    """The scatter of strengths and dip of corrected rows (…, n), in the units of their columns.

    Values without a stated uncertainty are not judged, nor is the field of a coil.
    """
    count, names = readings.count, [*STEADY_CHANGES] if calibration.has_field else ["gravity"]
    if calibration.profile.stand.coil:
        names = ["gravity"]
    elif calibration.relative:
        names.remove("field")
    if count < FEWEST_ROWS:
        return {}
    result: dict[str, Scatter] = {}
    for start in window_starts(count):
        rows = slice(start, start + WINDOW_ROWS)
        middle = rows_of(readings, slice(start, start + WINDOW_ROWS, 16))
        sd = standard_uncertainties(calibration, middle, names)
        for k, name in enumerate(names):
            unit = np.degrees(1.0) if OBSERVABLES[name].unit == "rad" else 1.0
            values = np.asarray(columns[OUTPUTS[name]], float)[..., rows]
            result[name] = _joined(
                result.get(name, Scatter()), _window(name, values, sd[..., k] * unit)
            )
    return result


def window_starts(count: int) -> list[int]:
    """First rows of the windows of `WINDOW_ROWS` of so many rows, over all of which they spread."""
    most = min(-(-count // WINDOW_ROWS), WINDOWS)
    starts = np.linspace(0, max(count - WINDOW_ROWS, 0), most).astype(int)
    return [int(start) for start in np.unique(starts)]


def _window(name: str, values: Array, sd: Array) -> Scatter:
    """Whether values (…, n) of neighbouring rows scatter."""
    known = values[np.isfinite(values)]
    sd = sd[np.isfinite(sd)]
    if len(known) < FEWEST_ROWS or not sd.size:
        return Scatter()
    allowed = float(np.median(sd))
    usual = STEADY_CHANGES[name] * (float(np.median(known)) if name == "field" else 1.0)
    lags = [lag for lag in LAGS if lag <= max(len(known) // ROWS_PER_LAG, 1)]
    change = max(float(np.median(np.abs(known[lag:] - known[:-lag]))) for lag in lags)
    most = max(usual, DEVIATIONS * allowed)
    if change > most:
        return Scatter(1, 1, float(known.min()), float(known.max()), allowed)
    departure = np.abs(known - _about(known))
    worst = int(np.argmax(departure))
    odd = int(np.count_nonzero(departure > most))
    farthest = float(departure[worst]), float(known[worst])
    return Scatter(windows=1, allowed=allowed, rows=len(known), odd=odd, farthest=farthest)


def _about(values: Array) -> Array:
    """The median (n,) of the rows about each of some rows, its own among them.

    >>> _about(np.array([1.0, 1, 9, 1, 2, 2, 2])).tolist()
    [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0]
    """
    width = min(ABOUT, len(values))
    medians = np.median(np.lib.stride_tricks.sliding_window_view(values, width), -1)
    first = np.clip(np.arange(len(values)) - width // 2, 0, len(values) - width)
    return np.asarray(medians[first])


def total(parts: Iterable[Mapping[str, Scatter]]) -> dict[str, Scatter]:
    """The scatter of all parts of a table."""
    whole: dict[str, Scatter] = {}
    for name, each in chain.from_iterable(part.items() for part in parts):
        whole[name] = _joined(whole.get(name, Scatter()), each)
    return whole


def _joined(one: Scatter, other: Scatter) -> Scatter:
    return Scatter(
        one.windows + other.windows, one.scattered + other.scattered, min(one.low, other.low),
        max(one.high, other.high), max(one.allowed, other.allowed), one.rows + other.rows,
        one.odd + other.odd, max(one.farthest, other.farthest),
    )  # fmt: skip


def unsteady(scatter: Mapping[str, Scatter]) -> str:
    """The quantities that scatter in most of the windows, and how far, or empty."""
    words = []
    for name, each in scatter.items():
        if 2 * each.scattered > each.windows:
            digits, unit = SHOWN_STRENGTHS[name]
            extent = f"{each.low:.{digits}f}…{each.high:.{digits}f}"
            words.append(f"{name} {extent}{unit} (1σ of a row: {each.allowed:.2g}{unit})")
    return ", ".join(words)


def odd_rows(scatter: Mapping[str, Scatter]) -> str:
    """Quantities that are odd at single rows, and how far; empty if none is, or if all rows scatter."""
    words = []
    for name, each in scatter.items():
        if each.odd and 2 * each.scattered <= each.windows:
            digits, unit = SHOWN_STRENGTHS[name]
            (departure, value), rows = each.farthest, f"{each.odd} of {each.rows} rows"
            words.append(
                f"{name} at {rows} (as far as {value:.{digits}f}{unit}, {departure:.{digits}f}{unit} off)"
            )
    return ", ".join(words)


SHOWN_STRENGTHS = {"gravity": (3, " g"), "field": (0, " nT"), "dip": (1, "°")}
"""Decimals and unit of each value that may scatter."""
OUTSIDE = ("blank", "refuse", "extrapolate")
JUDGED = ("gravity", "inclination", "toolface", "azimuth", "field", "dip", "magnetic_toolface")
"""Observables that a calibration may leave undetermined."""
DIRECTIONS = {
    "gravity_g": ("inclination_deg", "azimuth_deg", "toolface_deg", "dip_deg"),
    "field_nt": ("azimuth_deg", "dip_deg", "magnetic_toolface_deg"),
}
"""Directions that do not exist where a strength is zero."""
UNKNOWN_TEMPERATURE = (
    "the readings have no temperature: nothing shows that they lie in the calibrated range "
    "{calibrated}"
)
"""Sentence on readings without a temperature."""
ROW_FINDINGS = {
    "no-magnetometer": "no columns mx, my, mz: magnetic results are blank.",
    "other-tool": "the readings are of tool {tools[1]}, the calibration of tool {tools[0]}: is it the right one?",
    "missing-reading": "{tally.lacking} of {tally.rows} rows lack a reading: their results are blank.",
    "outside-temperature": "{away}",
    "no-temperature": "the calibration has no temperature terms, and its run recorded no temperature{readings_at}.",
    "temperature-unknown": f"{UNKNOWN_TEMPERATURE}.",
    "implausible-gravity": "{off[gravity]}: the tool moved while it was read, or a reading is in another unit.",
    "implausible-field": "{off[field]}: iron or a current was near, or a reading is in another unit.",
    "unsteady": "from row to row {unsteady} change more than any place does: are two axes swapped, or a sign wrong? A "
    "tool that moves, iron nearby, and rows from several places look the same.",
    "odd-rows": "unlike the rows about them: {odd}. Is a sign or a digit of a reading wrong there? A tool that moved, "
    "iron nearby, and a row from another place look the same.",
    "without-value": "azimuth or a toolface is blank in {tally.valueless} of {tally.rows} rows: within the uncertainty "
    "the tool is vertical there, or the field is, and the angle would have a 1σ of more than {largest:.0f}°.",
    "field-relative": "the magnetometer is calibrated to field = 1: bx_nt, by_nt, bz_nt and field_nt are relative, "
    "not nT.",
    "undetermined": "{moved} rest on what the calibration leaves undetermined ({free}): no uncertainty can be stated.",
}
"""The texts of the findings about corrected rows, in their order."""
RESULTS_BEYOND = (
    "blank. Rows have results within {margin:g} °C of it ({low:.1f}…{high:.1f} °C). {advice}, or choose `outside` "
    "extrapolate (no uncertainty).",
    f"extrapolated, with no statement of accuracy, and marked in the column '{EXTRAPOLATED}'.",
)
"""The treatment of results outside the calibrated temperatures."""
ROWS_OUTSIDE = "{some} of {rows} rows lie outside the calibrated range {low:.1f}…{high:.1f} °C"
"""Rows outside the calibrated temperatures."""
ROWS_DRIFTING = (
    f"{ROWS_OUTSIDE} by up to {{most:.1f}} °C. The calibration has no temperature terms, and 1σ contains no drift over "
    "the difference: about {turn:.4f}° of inclination, if a bias drifts by {drift:.1f} µg/°C. Calibrate at several "
    "temperatures."
)
"""Rows whose 1σ lacks the drift of the sensors from the calibrated temperatures."""
COMPILED_ROWS = 300_000
"""Number of rows from which the compiled loops repay their loading."""


RANGED_ANGLES = ("inclination", "azimuth")
"""Angles whose ranges are reported."""


class AngleRange(msgspec.Struct, frozen=True):
    """Least and largest of an angle in corrected rows, and its largest standard uncertainty; null without one."""

    least_deg: float
    largest_deg: float
    sd_deg: float | None


class RowCounts(NamedTuple):
    """Rows of a table, counted by what the findings report of them.

    `beyond`: outside the calibrated temperatures and their margin; `away`: outside by more than `MARGIN`, with those
    `beyond`; `moved`: outputs that rest on a free direction;
    `lacking`: without a reading; `warmth`: lowest and highest temperature, °C; `metadata`: what the
    table says of itself; `valueless`: with a direction that has no value; `angles`: ranges of
    inclination and azimuth, where there are any.
    """

    rows: int
    beyond: int = 0
    moved: tuple[str, ...] = ()
    lacking: int = 0
    serials: tuple[str, ...] = ()
    strengths: Mapping[str, Strengths] = {}
    warmth: tuple[float, float] = (np.inf, -np.inf)
    metadata: Mapping[str, object] = {}
    valueless: int = 0
    scatter: Mapping[str, Scatter] = {}
    angles: Mapping[str, AngleRange] = {}
    away: int = 0

    def blank(self, outside: str) -> int:
        """Number of rows without results: without a reading, or `outside` the temperatures."""
        return self.lacking + (self.beyond if outside == "blank" else 0)


def correct(
    calibration: Calibration, readings: Readings, outside: str = "blank", uncertainty: bool = True
) -> tuple[dict[str, AnyArray], list[Finding]]:
    """Output columns (n,) by name, and the findings.

    Refuses readings most of which have a strength that no place on Earth has, or that is off their
    reference.

    With `uncertainty` also the 1σ of each angle and strength, of the calibration and of one reading.
    Singular: within the uncertainty of vertical azimuth and toolface are NaN (blank in files);
    `magnetic_toolface_deg` is there too. A strength of zero has no direction: NaN.
    Temperatures outside the calibrated range are blanked, refused or extrapolated as `outside` says.
    """
    columns, _, about = correct_and_count(calibration, readings, outside, uncertainty=uncertainty)
    return columns, about


def correct_and_count(
    calibration: Calibration,
    readings: Readings,
    outside: str,
    lacking: int = 0,
    uncertainty: bool = False,
) -> tuple[dict[str, AnyArray], RowCounts, list[Finding]]:
    """Output columns, counts of the rows and findings; `lacking` more rows were left out unread.

    With `uncertainty` the columns of standard uncertainties too.
    """
    columns, tally = tallied(calibration, readings, outside, lacking, uncertainty)
    about = findings(calibration, readings, tally, outside)
    strengths.check(calibration, tally.strengths, readings.name, nominal=not readings.source)
    return columns, tally, about


def tallied(
    calibration: Calibration,
    readings: Readings,
    outside: str,
    lacking: int = 0,
    uncertainty: bool = False,
    whole: bool = True,
) -> tuple[dict[str, AnyArray], RowCounts]:
    """Output columns and counts of the rows, of which nothing is refused; their scatter only of a `whole` table."""
    check_outside(outside)
    columns = compiled(calibration, readings) or reference(calibration, readings)
    beyond = calibration.outside(readings)
    if outside == "blank" and beyond.any():
        columns = {name: np.where(beyond, np.nan, value) for name, value in columns.items()}
    columns, valueless = with_uncertainty(calibration, readings, columns, uncertainty)
    tally = RowCounts(
        readings.count + lacking, int(beyond.sum()), undetermined(calibration, readings), lacking, (),
        strengths.judged(calibration, columns, readings.known), warmth(readings.temperature),
        readings.metadata, valueless, scatters(calibration, readings, columns) if whole else {},
        angle_ranges(columns) if whole else {}, int(calibration.outside(readings, MARGIN).sum()),
    )  # fmt: skip
    if outside == "extrapolate":
        columns[EXTRAPOLATED] = beyond
    return columns, tally


def joined(tallies: Sequence[RowCounts]) -> RowCounts:
    """The counts of the parts of a table together; serials and metadata are those of the first."""
    counts = [(t.rows, t.beyond, t.lacking, t.valueless, t.away) for t in tallies]
    rows, beyond, lacking, valueless, away = np.sum(counts, 0).tolist()
    lows, highs = zip(*(tally.warmth for tally in tallies), strict=True)
    moved = {name for tally in tallies for name in tally.moved}
    return tallies[0]._replace(
        rows=rows, beyond=beyond, moved=tuple(name for name in JUDGED if name in moved),
        lacking=lacking, strengths=strengths.total(tally.strengths for tally in tallies),
        warmth=(min(lows), max(highs)), valueless=valueless,
        scatter=total(tally.scatter for tally in tallies),
        angles=_joined_ranges([tally.angles for tally in tallies]), away=away,
    )  # fmt: skip


def angle_ranges(columns: Mapping[str, AnyArray]) -> dict[str, AngleRange]:
    """Ranges of inclination and azimuth over rows (n,) that have them; columns by the names of files."""
    ranges = {}
    for name in RANGED_ANGLES:
        values = columns[f"{name}_deg"]
        least = float(np.fmin.reduce(values, initial=np.inf))
        sd = float(np.fmax.reduce(columns.get(f"sd_{name}_deg", values[:0]), initial=-np.inf))
        if np.isfinite(least):
            largest = float(np.fmax.reduce(values, initial=-np.inf))
            ranges[name] = AngleRange(least, largest, sd if np.isfinite(sd) else None)
    return ranges


def _joined_ranges(parts: Sequence[Mapping[str, AngleRange]]) -> dict[str, AngleRange]:
    """Ranges over all parts of a table."""
    ranges = {}
    for name in RANGED_ANGLES:
        if each := [part[name] for part in parts if name in part]:
            sd = max((one.sd_deg for one in each if one.sd_deg is not None), default=None)
            least, largest = (
                min(one.least_deg for one in each),
                max(one.largest_deg for one in each),
            )
            ranges[name] = AngleRange(least, largest, sd)
    return ranges


def warmth(temperature: Array | None) -> tuple[float, float]:
    """Lowest and highest of temperatures, °C; infinite ends where there are none."""
    if temperature is None:
        return np.inf, -np.inf
    return float(temperature.min(initial=np.inf)), float(temperature.max(initial=-np.inf))


def result_names(outside: str, uncertainty: bool = True) -> tuple[str, ...]:
    """The columns of results, in their order."""
    sd = UNCERTAINTIES if uncertainty else ()
    return (*RESULTS, *sd, *([EXTRAPOLATED] if outside == "extrapolate" else []))


def check_outside(outside: str) -> None:
    """Refuse an unknown choice for temperatures outside the calibrated range."""
    if outside not in OUTSIDE:
        raise InputError(f"`outside` must be one of {', '.join(OUTSIDE)}; got {outside!r}.")


def reference(calibration: Calibration, readings: Readings) -> dict[str, AnyArray]:
    """The output columns (..., n) by plain NumPy, nothing blanked for its temperature."""
    g, b = calibration.fields(readings)
    columns = dict(zip(VECTORS, [*np.moveaxis(g, -1, 0), *np.moveaxis(b, -1, 0)], strict=True))
    for name, column in OUTPUTS.items():
        value = OBSERVABLES[name].value(g, b)
        columns[column] = np.degrees(value) if OBSERVABLES[name].unit == "rad" else value
    for strength, names in DIRECTIONS.items():
        for name in names:
            columns[name] = np.where(columns[strength] == 0.0, np.nan, columns[name])
    return columns


def compiled(
    calibration: Calibration, readings: Readings, least: int | None = None
) -> dict[str, AnyArray] | None:
    """The same columns by the compiled loops; None for few rows, or a model they do not have."""
    shape = readings.accelerometer.shape[:-1]
    triads = numbers(calibration)
    unknown = readings.temperature is None and calibration.thermal
    few = np.prod(shape) < (COMPILED_ROWS if least is None else least)
    if few or readings.self_scaled or triads is None or unknown or not correction_numba.available():
        return None
    zero = calibration.reference_temperature
    warmth = zero if readings.temperature is None else readings.temperature
    flat = np.ascontiguousarray(np.broadcast_to(warmth, shape), float).reshape(-1)
    g, b = readings.accelerometer, readings.magnetometer
    vectors = (g, np.full(g.shape, np.nan) if b is None else b)
    rows = (np.ascontiguousarray(vector, float).reshape(-1, 3) for vector in vectors)
    axes = [axis for three in rows for axis in three.transpose()]
    results = correction_numba.run([*axes, flat], triads, zero)
    return {n: c.reshape(shape) for n, c in zip(RESULTS, results.columns, strict=True)}


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
    low, high = calibration.temperature_c or (np.nan, np.nan)
    if tally.beyond and outside == "refuse":
        beyond = ROWS_OUTSIDE.format(some=tally.beyond, rows=tally.rows, low=low, high=high)
        advice = "Use `outside` blank or extrapolate, or calibrate over a wider range."
        raise InputError(f"{readings.source}: {beyond}. {advice}")
    off, tools = strengths.departures(tally.strengths), other_tool(calibration, readings)
    changing = unsteady(tally.scatter)
    applies = {
        "no-magnetometer": calibration.has_field and readings.magnetometer is None,
        "other-tool": tools,
        "missing-reading": tally.lacking,
        "outside-temperature": tally.away,
        "no-temperature": calibration.temperature_c is None,
        "temperature-unknown": bool(calibration.temperature_c) and tally.warmth[0] == np.inf,
        "implausible-gravity": "gravity" in off,
        "implausible-field": "field" in off,
        "unsteady": changing,
        "odd-rows": odd_rows(tally.scatter),
        "without-value": tally.valueless,
        "field-relative": calibration.relative,
        "undetermined": tally.moved,
    }
    warm = "…".join(dict.fromkeys(f"{end:.1f}" for end in tally.warmth))
    unknown = f": nothing says how good the results are at the readings' {warm} °C"
    words = {
        "calibrated": f"{low:.1f}…{high:.1f} °C",
        "away": _away(calibration, tally, outside),
        "readings_at": unknown if calibration.unrecorded(readings) else "",
        "unsteady": changing,
        "odd": odd_rows(tally.scatter),
        "largest": np.degrees(LARGEST_DIRECTION_SD),
        "moved": ", ".join(tally.moved),
        "free": ", ".join(dict.fromkeys(u.id for u in calibration.undetermined())),
    }
    return (
        calibration.change_findings()
        + doubts(calibration, readings)
        + [
            Finding(id=name, text=text.format(tally=tally, tools=tools, off=off, **words))
            for name, text in ROW_FINDINGS.items()
            if applies[name]
        ]
    )


def _away(calibration: Calibration, tally: RowCounts, outside: str) -> str:
    """The rows outside the calibrated temperatures: those without accuracy, and those whose 1σ lacks a drift."""
    (low, high), margin = calibration.temperature_c or (np.nan, np.nan), calibration.margin
    there = {"rows": tally.rows, "low": low, "high": high}
    texts = []
    if tally.beyond:
        advice = "over a wider range" if calibration.thermal else "at several temperatures"
        results = RESULTS_BEYOND[outside == "extrapolate"].format(
            margin=margin, low=low - margin, high=high + margin, advice=f"Calibrate {advice}"
        )
        beyond = ROWS_OUTSIDE.format(some=tally.beyond, **there)
        texts.append(f"{beyond}: their results are {results}")
    if some := tally.away - tally.beyond:
        coldest, hottest = tally.warmth
        most = min(max(low - coldest, hottest - high), margin)
        drift = tolerance(calibration.profile, TRIADS[0], "bias_per_c")
        sizes = {"most": most, "turn": np.degrees(drift * most), "drift": drift * 1e6}
        texts.append(ROWS_DRIFTING.format(some=some, **there, **sizes))
    return " ".join(texts)


def warn_if_blank(columns: Mapping[str, AnyArray], findings: Iterable[Finding]) -> None:
    """Warn the caller's caller where no row has a result and temperatures are the reason."""
    if np.isnan(columns["gravity_g"]).all():
        for finding in findings:
            if finding.id == "outside-temperature":
                warnings.warn(finding.text, stacklevel=3)


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
