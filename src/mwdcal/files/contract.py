"""The columns of a run file: names, units, accepted ranges, near misses; the north of its azimuths.

True azimuth = magnetic + declination; grid azimuth = true - convergence. Metadata
`azimuth_reference` is "magnetic" (the default), "true" or "grid". `declination_deg` without
`azimuth_reference` turns surveys to true north; the azimuths of a stand stay magnetic.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from math import pi
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.errors import InputError
from mwdcal.files.formats.columns import LABELS
from mwdcal.files.formats.table import LEAVE_OUT, Table, cell_error, numbers, shown
from mwdcal.files.synonyms import ABOVE, BELOW, CONVERSIONS, OF_TOOLFACES, resembled
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.sensor.profile import Profile

CHANNELS = {"accelerometer": ("ax", "ay", "az"), "magnetometer": ("mx", "my", "mz")}


def channels(magnetometer: bool) -> dict[str, tuple[str, ...]]:
    """Channels by triad of a tool with a magnetometer, or without."""
    return {
        kind: names for kind, names in CHANNELS.items() if magnetometer or kind == "accelerometer"
    }


RAW = tuple(name for triad in CHANNELS.values() for name in triad)

# Metadata that changes what the numbers mean.
AZIMUTH_KEYS = ("azimuth_reference", "declination_deg", "convergence_deg")
_NORTHS: dict[str, dict[str, float]] = {
    "magnetic": {},
    "true": {"declination_deg": 1.0},
    "grid": {"declination_deg": 1.0, "convergence_deg": -1.0},
}
"""Angle to add to magnetic azimuths, with its sign."""


class Range(NamedTuple):
    """Accepted values, both ends included unless `positive`, which leaves out zero."""

    low: float
    high: float
    unit: str
    positive: bool = False

    def outside(self, values: Array) -> Bools:
        """Which of the values (...) are not accepted; NaN, a blank cell, is."""
        low = values <= self.low if self.positive else values < self.low
        return np.asarray(low | (values > self.high))

    def __str__(self) -> str:
        words = "above {:g} and at most {:g} {}" if self.positive else "between {:g} and {:g} {}"
        return words.format(self.low, self.high, self.unit).rstrip()


class Reference(NamedTuple):
    """A reference column: accepted values and uncertainties, and the factor to inside units."""

    column: str
    values: Range
    uncertainty: Range
    factor: float


def _angle(name: str, low: float, high: float) -> Reference:
    return Reference(f"ref_{name}_deg", Range(low, high, "°"), Range(0.0, 180.0, "°"), pi / 180.0)


REFERENCES = {
    "inclination": _angle("inclination", 0.0, 180.0),
    "azimuth": _angle("azimuth", -360.0, 360.0),
    "toolface": _angle("toolface", -360.0, 360.0),
    "gravity": Reference("ref_gravity_g", Range(0, 2, "g", True), Range(0, 2, "g"), 1.0),
    "field": Reference("ref_field_nt", Range(0, 200_000, "nT", True), Range(0, 200_000, "nT"), 1.0),
    "dip": _angle("dip", -90.0, 90.0),
}


def is_angle(column: str) -> bool:
    """Whether a column has angles of the stand or of the field."""
    return column.startswith("ref_") and column.endswith("_deg")


TEMPERATURE = Range(-273.15, 1000.0, "°C")
RAW_RANGE = Range(-1e15, 1e15, "")
RAW_SPREAD = Range(0.0, 1e15, "")
ROTATION = Range(-180.0, 180.0, "°")

RANGES = {
    "temperature_c": TEMPERATURE,
    **dict.fromkeys(RAW, RAW_RANGE),
    **{reference.column: reference.values for reference in REFERENCES.values()},
    **{f"sd_{name}": RAW_SPREAD for name in RAW},
    **{f"sd_{reference.column}": reference.uncertainty for reference in REFERENCES.values()},
}
"""The columns of numbers, and their accepted values."""
COLUMNS = ("station", "group", *RANGES)
COLUMN_OF_DAY = frozenset({"date"})
"""The column, and the metadata key, of the day of a run."""
REFERENCE_VECTORS = tuple(f"ref_{name}_{'g' if name[0] == 'a' else 'nt'}" for name in RAW)
"""Components along the tool axes of gravity and field as the stand states them, instead of angles and strengths."""
MAPPED = (*COLUMNS, "serial", *REFERENCE_VECTORS)
"""Columns that a table may have under another name."""
_UNITS_BY_END = {
    "deg": ("°", "rad", "gon"),
    "g": ("g", "mg", "m/s²", "gal", "mGal", "ft/s²"),
    "nt": ("nT", "µT", "mT", "gauss", "mG", "A/m"),
    "c": ("°C", "°F", "K"),
}
"""The units of a quantity by the end of its column's name, that of the contract first."""

_UNIT = re.compile(
    r"[\s_(\[-]+(°|°?c|deg|degc|degrees?|rad|f|k|m?g|m/?s2|[nµu]t|gauss|m?v|counts?|raw)[)\]]?$|\s*[(\[][^(\[]*[)\]]$"
)


def of_vectors(columns: Collection[str]) -> list[str]:
    """References that the components among some columns give: of gravity alone, or of both fields."""
    gravity, field = (
        {*part} <= {*columns} for part in (REFERENCE_VECTORS[:3], REFERENCE_VECTORS[3:])
    )
    names = ("inclination", "toolface", "gravity") if gravity else ()
    more = ("azimuth", "field", "dip") if gravity and field else ()
    return [REFERENCES[name].column for name in (*names, *more)]


def units_of(column: str) -> tuple[str, ...]:
    """The units that a column may be given in, that of the contract first; any for a raw channel.

    >>> units_of("ref_field_nt")
    ('nT', 'µT', 'mT', 'gauss', 'mG', 'A/m')
    >>> units_of("ax")
    ()
    """
    end = column.rpartition("_")[2]
    if column == "ref_inclination_deg":
        return (*_UNITS_BY_END[end], ABOVE, BELOW)
    if column == "ref_toolface_deg":
        return (*_UNITS_BY_END[end], *OF_TOOLFACES)
    return _UNITS_BY_END.get(end, ()) if column.removeprefix("sd_") not in (*RAW, *LABELS) else ()


def check_columns(names: Sequence[str], source: str) -> None:
    """Refuse near misses of the contract's names, and missing or half-present triads."""
    check_near_misses(names, COLUMNS, f"{source}: column")
    missing = [name for name in CHANNELS["accelerometer"] if name not in names]
    if missing:
        raise _missing(missing, names, source)
    magnetometer = CHANNELS["magnetometer"]
    absent = [name for name in magnetometer if name not in names]
    if 0 < len(absent) < len(magnetometer):
        raise InputError(
            f"{source}: the columns mx, my, mz must be all present or all absent; "
            f"{_listed(absent)} missing. Add what is missing or remove the others."
        )


def check_near_misses(names: Collection[str], contract: Sequence[str], what: str) -> None:
    """Refuse a name that differs from an absent one of the contract in case or unit only.

    Such a column would be ignored silently; any other unknown column is the user's.
    """
    present = set(names)
    expected = {form: name for name in contract if name not in present for form in forms(name)}
    for name in names:
        meant = next((expected[form] for form in forms(name) if form in expected), None)
        if meant is not None and name not in contract:
            alike = resembled(name)
            how = CONVERSIONS.get(alike.unit if alike else "", "and convert its unit")
            raise InputError(
                f"{what} {shown(name)} must be spelled exactly as documented. Did you mean "
                f"'{meant}'? Rename it ({how}), choose a different name, or propose a tool profile for the table as "
                "it is: mwdcal profile."
            )


def forms(name: str) -> tuple[str, str]:
    """The name without case and separators, and the same without its unit.

    >>> forms("Ref inclination [deg]")
    ('refinclinationdeg', 'refinclination')
    """
    bare = name.strip().lower()
    whole, without = (re.sub(r"[^a-z0-9]", "", form) for form in (bare, _UNIT.sub("", bare)))
    return whole, without


def _missing(missing: Sequence[str], names: Sequence[str], source: str) -> InputError:
    closest = {m: difflib.get_close_matches(m, names[:100], n=1, cutoff=0.5) for m in missing}
    hints = [f"{shown(near[0])} for '{name}'" for name, near in closest.items() if near]
    meant = f" Did you mean {', '.join(hints)}?" if hints else ""
    present = ", ".join(shown(name) for name in names[:20]) + (" …" if names[20:] else "")
    return InputError(
        f"{source}: the columns ax, ay, az must be present; {_listed(missing)} missing; "
        f"found {present}.{meant} Rename the columns, propose a tool profile for the table "
        "as it is (mwdcal profile), or check the delimiter of the file."
    )


def _listed(names: Sequence[str]) -> str:
    quoted = ", ".join(f"'{name}'" for name in names)
    return f"{quoted} {'is' if len(names) == 1 else 'are'}"


def magnetic_offset(metadata: Mapping[str, object], source: str) -> float:
    """Stated azimuth minus magnetic azimuth, degrees.

    >>> magnetic_offset({"azimuth_reference": "true", "declination_deg": 3.0}, "run.csv")
    3.0
    """
    stated = stated_norths(metadata, source)
    kind = metadata.get("azimuth_reference", "magnetic")
    if kind is True:  # the bare word `true` in a metadata line
        kind = "true"
    if not isinstance(kind, str) or kind not in _NORTHS:
        raise InputError(
            f"{source}, metadata 'azimuth_reference': must be one of "
            f"{', '.join(_NORTHS)}; got {shown(kind)}. Say which north the azimuths count from."
        )
    for key in _NORTHS[kind]:
        if key not in stated:
            raise InputError(
                f"{source}: {kind} azimuths need the metadata '{key}'; got none. Add a line "
                f"`# {key} = …`, state {key} in [table] of the tool profile, or give magnetic azimuths."
            )
    return sum((sign * stated[key] for key, sign in _NORTHS[kind].items()), 0.0)


def stated_norths(metadata: Mapping[str, object], source: str) -> dict[str, float]:
    """Declination and convergence that metadata state, degrees.

    >>> stated_norths({"declination_deg": 3.0}, "run.csv")
    {'declination_deg': 3.0}
    """
    check_near_misses(list(metadata), AZIMUTH_KEYS, f"{source}: metadata")
    return {
        key: _degrees(metadata[key], key, source) for key in AZIMUTH_KEYS[1:] if key in metadata
    }


def _degrees(value: object, key: str, source: str) -> float:
    number = float(value) if isinstance(value, int | float) else float("nan")
    if isinstance(value, bool) or not ROTATION.low <= number <= ROTATION.high:
        raise InputError(
            f"{source}, metadata '{key}': must be a number {ROTATION}; got {shown(value)}. "
            "East is positive; write it with a decimal point."
        )
    return number


# --------------------------------------------------------------------------
# Cells that a run may not have, in rows of one tool or of many.
#
# The rows of T tools stand one tool after the other: `starts` (T + 1,) are the first row of each,
# and the number of rows. A run file is one tool. What must be filled in where other cells of a tool
# are is judged tool by tool.


Cells = Callable[[str], Array | None]
"""The numbers (R,) of a column by its name, NaN where blank; None where there is no such column."""


OPTIONAL = {
    CHANNELS["magnetometer"]: f"Fill it in, or {LEAVE_OUT}.",
    ("temperature_c",): f"Fill it in, {LEAVE_OUT}, or leave the whole column blank.",
}
"""Columns that are blank on all rows or on none, and what to do where they are neither."""


class BlankReadingError(InputError):
    """A blank cell among readings or temperatures: `apply` may leave the results of its row blank."""


class Fault(NamedTuple):
    """Cells that break one rule: where `cells` (k, R) is true, of the `columns` (k).

    `must_be` is the rule, `advice` what to do. `missing_reading`: the rule is that readings and
    temperatures may not be blank.
    """

    columns: tuple[str, ...]
    cells: Bools
    must_be: str
    advice: str
    missing_reading: bool = False


def faults(cells: Cells, starts: Ints, profile: Profile) -> Iterator[Fault]:
    """The rules that are broken, in the order in which they are reported.

    A column is not read before its turn.
    """
    readings = [(names, f"Fill it in, or {LEAVE_OUT}.") for names in CHANNELS.values()]
    warmth = (("temperature_c",), f"Fill it in, {LEAVE_OUT}, or leave the whole column blank.")
    for names, advice in (*readings, warmth):
        for name in names:
            yield from range_faults(cells, name)
        blank = _blank_faults(cells, starts, names, advice, True)
        optional = names != CHANNELS["accelerometer"]
        yield from _where_filled(cells, starts, names, blank) if optional else blank
    yield from faults_beside_readings(cells, starts, profile, TRIADS)


def faults_beside_readings(
    cells: Cells, starts: Ints, profile: Profile, kinds: Iterable[str]
) -> Iterator[Fault]:
    """The same of references, and of uncertainties of these and of the triads `kinds`."""
    for reference in REFERENCES.values():
        yield from range_faults(cells, reference.column)
    for kind in kinds:
        noise = _noise_faults(cells, starts, profile, kind)
        yield from _where_filled(cells, starts, CHANNELS[kind], noise)
    for name, reference in REFERENCES.items():
        sd = range_faults(cells, f"sd_{reference.column}")
        optional = name != "gravity"
        yield from _where_filled(cells, starts, (reference.column,), sd) if optional else sd


def columns_of(table: Table) -> Cells:
    """The columns of numbers of a table, each read when it is asked for the first time."""
    return cache(lambda name: numbers(table, name) if name in table.columns else None)


def refuse(table: Table, rules: Iterable[Fault]) -> None:
    """Refuse the first cell that breaks a rule."""
    for fault in rules:
        row = int(np.argmax(fault.cells.any(0)))
        name = fault.columns[int(np.argmax(fault.cells[:, row]))]
        problem = f"must be {fault.must_be}; got {_content(table, name, row)}. {fault.advice}"
        error = cell_error(table, name, row, problem)
        raise BlankReadingError(str(error)) if fault.missing_reading else error


def _content(table: Table, name: str, row: int) -> str:
    """The content of a cell, for messages."""
    if name not in table.columns:
        return "no such column"
    value = float(numbers(table, name)[row])
    return "a blank cell" if np.isnan(value) else f"{shown(value)} {RANGES[name].unit}".rstrip()


def _noise_faults(cells: Cells, starts: Ints, profile: Profile, kind: str) -> Iterator[Fault]:
    """Noise of a triad out of range, stated for some cells of a tool and not for others, or zero."""
    names, triad = tuple(f"sd_{name}" for name in CHANNELS[kind]), getattr(profile, kind)
    if all(cells(name) is None for name in names):
        return
    for name in names:
        yield from range_faults(cells, name)
    if triad.noise is None:
        advice = (
            f"Other sd_ cells of the {kind} are filled. Fill it in, or state `noise` under [{kind}] in the "
            "tool profile."
        )
        blank = _blank_faults(cells, starts, names, advice)
        yield from _where_filled(cells, starts, names, blank)
    zero = _stacked(cells, names, starts) == 0.0
    if triad.repeatability == 0.0 and zero.any():
        advice = f"State the noise of the {kind}, or leave it blank."
        yield Fault(names, zero, "above 0", advice)


def range_faults(cells: Cells, name: str) -> Iterator[Fault]:
    """Values that the column may not have."""
    values, limits = cells(name), RANGES[name]
    if values is not None and (outside := limits.outside(values)).any():
        advice = "Check the cell, and the unit of the column."
        yield Fault((name,), outside[None], str(limits), advice)


def _blank_faults(
    cells: Cells, starts: Ints, names: tuple[str, ...], advice: str, missing_reading: bool = False
) -> Iterator[Fault]:
    """Cells that are blank."""
    blank = np.isnan(_stacked(cells, names, starts))
    if blank.any():
        yield Fault(names, blank, "filled in", advice, missing_reading)


def _where_filled(
    cells: Cells, starts: Ints, names: tuple[str, ...], rules: Iterator[Fault]
) -> Iterator[Fault]:
    """Broken rules in tools that have any cell of the columns filled in."""
    filled = ~np.isnan(_stacked(cells, names, starts)).all(0)
    if not filled.any():
        return
    for fault in rules:
        tools = np.logical_or.reduceat(filled, starts[:-1])
        wrong = fault.cells & np.repeat(tools, np.diff(starts))
        if wrong.any():
            yield fault._replace(cells=wrong)


def _stacked(cells: Cells, names: tuple[str, ...], starts: Ints) -> Array:
    """The columns (k, R); those that are not there are blank."""
    columns = (cells(name) for name in names)
    return np.stack([np.full(starts[-1], np.nan) if c is None else c for c in columns])


def wholly_blank(tables: Iterable[Table]) -> tuple[tuple[str, ...], ...]:
    """Groups of optional columns that are blank on every row of all tables; looks no further than needed."""
    left = [*OPTIONAL]
    for table in tables:
        left = [g for g in left if g[0] in table.columns and all(is_blank(table, n) for n in g)]
        if not left:
            break
    return tuple(left)


def blank_cell(table: Table, names: tuple[str, ...]) -> InputError:
    """The refusal of a column that is blank on some rows and not on others."""
    problem = f"must be filled in; got a blank cell. {OPTIONAL[names]}"
    return BlankReadingError(str(cell_error(table, names[0], 0, problem)))


def is_blank(table: Table, name: str) -> bool:
    """Whether a column has no cell that is filled in."""
    column = table.columns[name]
    if isinstance(column, list):
        return not any(cell.strip() for cell in column)
    return bool(np.isnan(column).all())


def without_reading(table: Table, absent: Sequence[tuple[str, ...]]) -> Bools:
    """Rows (n,) with a blank reading or temperature; columns `absent` on all rows do not count."""
    without = [name for group in absent for name in group]
    names = [n for n in (*RAW, "temperature_c") if n in table.columns and n not in without]
    return np.asarray(np.isnan([_cells(table, name) for name in names]).any(axis=0))


def chosen(table: Table, rows: Bools) -> Table:
    """Some rows of a table, with their places."""
    picked = np.flatnonzero(rows).tolist()
    columns = {
        name: [column[i] for i in picked] if isinstance(column, list) else column[rows]
        for name, column in table.columns.items()
    }
    return replace(table, columns=columns, lines=[table.lines[i] for i in picked])


def spread(values: AnyArray, rows: Bools) -> AnyArray:
    """Values of the chosen rows, at their places among all; others are NaN, False or blank."""
    blank = {"b": False, "U": "", "O": ""}.get(values.dtype.kind, np.nan)
    out = np.full(rows.shape, blank, values.dtype)
    out[rows] = values
    return out


def _cells(table: Table, name: str) -> Array:
    """The column as numbers; what they may be is checked with all the rest."""
    column = table.columns[name]
    return numbers(table, name) if isinstance(column, list) else column


def nothing(source: str) -> InputError:
    """A table of which no row can be corrected."""
    return InputError(
        f"{source}: every row lacks a reading, so that there is nothing to correct. Check the "
        "columns of the raw channels and temperature_c."
    )
