"""Corrected strengths of gravity and field against the Earth's, and against references of the table.

A strength that is off at a few rows means shock, iron or a bad reading; off at most rows it means a
calibration that does not belong to the readings, or readings in another unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from math import sqrt
from operator import add
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import EARTH_RANGES, TRIADS
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import AnyArray, Array

OFF_REFERENCE = 0.05
"""Departure from the reference of the row, as a share of it, from which a strength is off."""
MOST_OFF = 0.5
"""A table of which more than this share of the rows is off is refused."""
ALIKE = {"gravity": 1.5, "field": 6.0}
"""Greatest over least strength up to which one unit may explain all rows."""
JUDGED_STRENGTHS = ("gravity", "field")
STRENGTH_UNITS: dict[str, dict[str, float]] = {
    "gravity": {"g": 1.0, "m/s²": STANDARD_GRAVITY, "mg": 1000.0},
    "field": {"nT": 1.0, "µT": 1e-3, "mT": 1e-6, "gauss": 1e-5, "mG": 1e-2},
}
"""Units in which readings come, per g or nT."""


class Strengths(NamedTuple):
    """One corrected strength over the rows that have it.

    `earth` counts rows with a strength that no place on Earth has, `reference` those off their
    reference, `off` those of either kind; `low` and `high` are the extremes of these.
    """

    rows: int = 0
    earth: int = 0
    reference: int = 0
    off: int = 0
    low: float = np.inf
    high: float = -np.inf


def judged(
    calibration: Calibration, columns: Mapping[str, AnyArray], known: Mapping[str, Array]
) -> dict[str, Strengths]:
    """Both strengths of corrected rows; `known` are references of the rows, NaN where blank.

    A field that is relative is not judged, that of a coil not by the Earth's, and a scale that
    the calibration leaves free not by references.
    """
    strengths = {}
    for name, triad in zip(JUDGED_STRENGTHS, calibration.triads, strict=False):
        if name == "field" and calibration.relative:
            continue
        values = np.asarray(columns[OUTPUTS[name]], float)
        coil = name == "field" and calibration.profile.stand.coil
        low, high = (-np.inf, np.inf) if coil else EARTH_RANGES[name]
        earth, reference = (values < low) | (values > high), np.zeros(values.shape, bool)
        if name in known and not any(entry.id == "scale" for entry in triad.undetermined):
            reference = np.abs(values - known[name]) > OFF_REFERENCE * known[name]
        kinds = (~np.isnan(values), earth, reference, earth | reference)
        counts = (int(np.count_nonzero(rows)) for rows in kinds)
        worst = values[earth | reference]
        ends = float(worst.min(initial=np.inf)), float(worst.max(initial=-np.inf))
        strengths[name] = Strengths._make((*counts, *ends))
    return strengths


def total(parts: Iterable[Mapping[str, Strengths]]) -> dict[str, Strengths]:
    """The strengths of all parts of a table."""
    whole: dict[str, Strengths] = {}
    for name, (*counts, low, high) in chain.from_iterable(part.items() for part in parts):
        *before, lowest, highest = whole.get(name, Strengths())
        ends = (min(low, lowest), max(high, highest))
        whole[name] = Strengths._make((*map(add, before, counts), *ends))
    return whole


def departures(strengths: Mapping[str, Strengths]) -> dict[str, str]:
    """How each strength is off that is off at any row, and at how many."""
    return {
        name: f"{each.off} of {each.rows} rows: {_departure(name, each)}"
        for name, each in strengths.items()
        if each.off
    }


def _departure(name: str, each: Strengths) -> str:
    unit, (low, high) = OBSERVABLES[name].unit, EARTH_RANGES[name]
    extent = "…".join(dict.fromkeys(f"{end:.3g}" for end in (each.low, each.high)))
    reasons = {
        f"no place on Earth has it ({low:g}…{high:g} {unit})": each.earth,
        f"it is more than {OFF_REFERENCE:.0%} off its reference ref_{OUTPUTS[name]}": each.reference,
    }
    why = " and ".join(reason for reason, rows in reasons.items() if rows)
    return f"corrected {name} is {extent} {unit}, and {why}"


def check(
    calibration: Calibration, strengths: Mapping[str, Strengths], source: str, nominal: bool = False
) -> None:
    """Refuse a table, or `nominal` arrays, of which most rows have a strength that is off."""
    for name, each in strengths.items():
        if each.off > MOST_OFF * each.rows:
            raise InputError(
                f"{source}: at {each.off} of {each.rows} rows "
                f"{_departure(name, each)}. {_advice(calibration, name, each, nominal)}"
            )


def _advice(calibration: Calibration, name: str, each: Strengths, nominal: bool) -> str:
    """The likely cause, and what to do."""
    triad, unit = TRIADS[name == "field"], OBSERVABLES[name].unit
    if nominal:
        return f"Arrays are in {unit}; give readings in other units as a table, by the names of the columns."
    scale, about = getattr(calibration.profile, triad).scale, ""
    if scale is not None:
        about = f" of about {scale:.4g} raw units per {unit}{_likely(name, each, scale)}"
    text = (
        f"The calibration of {calibration.run_name} is for {triad} readings{about}. Give the readings in the "
        "units of its run, or the calibration that belongs to them."
    )
    if each.reference and not each.earth:
        text += " Or are latitude and longitude of the reference those of the place?"
    if name == "field" and each.earth:
        text += " The field of a coil is declared in the tool profile before the calibration: [stand] coil = true."
    return text


def _likely(name: str, each: Strengths, scale: float) -> str:
    """The unit of the readings that would explain the strengths; empty where none does."""
    if not 0 < each.low <= each.high <= ALIKE[name] * each.low:
        return ""
    low, high = EARTH_RANGES[name]
    raw = sqrt(each.low * each.high) * scale
    for unit, per in STRENGTH_UNITS[name].items():
        if low <= raw / per <= high and not 0.9 < scale / per < 1.1:
            return f"; these look like readings in {unit}"
    return ""
