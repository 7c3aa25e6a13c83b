"""The columns of a run file: names, units, accepted ranges, near misses; the north of its azimuths.

True azimuth = magnetic + declination; grid azimuth = true - convergence. Metadata
`azimuth_reference` is "magnetic" (the default), "true" or "grid". `declination_deg` without
`azimuth_reference` changes nothing: the azimuths are magnetic.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import LABELS
from mwdcal.files.formats.table import shown
from mwdcal.files.synonyms import ABOVE, ANTICLOCKWISE, BELOW, CONVERSIONS, resembled
from mwdcal.geometry.vectors import Array, Bools

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
"""What is added to magnetic azimuths, with its sign."""


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
MAPPED = (*COLUMNS, "serial")
"""Columns that a table may have under another name."""
_UNITS_BY_END = {
    "deg": ("°", "rad", "gon"),
    "g": ("g", "mg", "m/s²", "gal", "mGal"),
    "nt": ("nT", "µT", "mT", "gauss", "mG"),
    "c": ("°C", "°F", "K"),
}
"""The units of a quantity by the end of its column's name, that of the contract first."""

_UNIT = re.compile(
    r"[\s_(\[-]+(°|°?c|deg|degc|degrees?|rad|f|k|m?g|m/?s2|[nµu]t|gauss|m?v|counts?|raw)[)\]]?$|\s*[(\[][^(\[]*[)\]]$"
)


def units_of(column: str) -> tuple[str, ...]:
    """The units that a column may be given in, that of the contract first; any for a raw channel.

    >>> units_of("ref_field_nt")
    ('nT', 'µT', 'mT', 'gauss', 'mG')
    >>> units_of("ax")
    ()
    """
    end = column.rpartition("_")[2]
    if column == "ref_inclination_deg":
        return (*_UNITS_BY_END[end], ABOVE, BELOW)
    if column == "ref_toolface_deg":
        return (*_UNITS_BY_END[end], ANTICLOCKWISE)
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
