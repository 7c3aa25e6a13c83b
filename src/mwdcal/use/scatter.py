"""Strengths and dip of corrected rows that change from row to row as those of no place do.

Swapped axes, or one with the wrong sign, leave the strength of each vector as it is, and the dip varies with the
attitude of the tool. A table that goes slowly from place to place changes little between neighbouring rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.use.uncertainty import rows_of, standard_uncertainties

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
FEWEST_ROWS = 4
"""Fewest rows that are judged."""


class Scatter(NamedTuple):
    """Windows of rows of a table that were looked at, those in which a value scatters, and its extremes in these.

    `allowed`: the median 1σ of one row.
    """

    windows: int = 0
    scattered: int = 0
    low: float = np.inf
    high: float = -np.inf
    allowed: float = 0.0


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
    starts = np.unique(
        np.linspace(0, max(count - WINDOW_ROWS, 0), min(-(-count // WINDOW_ROWS), WINDOWS)).astype(
            int
        )
    )
    result: dict[str, Scatter] = {}
    for start in starts.tolist():
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


def _window(name: str, values: Array, sd: Array) -> Scatter:
    """Whether values (…, n) of neighbouring rows scatter."""
    known = values[np.isfinite(values)]
    sd = sd[np.isfinite(sd)]
    if len(known) < FEWEST_ROWS or not sd.size:
        return Scatter()
    allowed = float(np.median(sd))
    usual = STEADY_CHANGES[name] * (float(np.median(known)) if name == "field" else 1.0)
    lags = [lag for lag in LAGS if lag <= len(known) // FEWEST_ROWS]
    change = max(float(np.median(np.abs(known[lag:] - known[:-lag]))) for lag in lags)
    if change <= max(usual, DEVIATIONS * allowed):
        return Scatter(windows=1)
    return Scatter(1, 1, float(known.min()), float(known.max()), allowed)


def total(parts: Iterable[Mapping[str, Scatter]]) -> dict[str, Scatter]:
    """The scatter of all parts of a table."""
    whole: dict[str, Scatter] = {}
    for name, each in chain.from_iterable(part.items() for part in parts):
        whole[name] = _joined(whole.get(name, Scatter()), each)
    return whole


def _joined(one: Scatter, other: Scatter) -> Scatter:
    return Scatter(
        one.windows + other.windows, one.scattered + other.scattered, min(one.low, other.low),
        max(one.high, other.high), max(one.allowed, other.allowed),
    )  # fmt: skip


def unsteady(scatter: Mapping[str, Scatter]) -> str:
    """What scatters in most of the windows, and how far; empty where nothing does."""
    words = []
    for name, each in scatter.items():
        if 2 * each.scattered > each.windows:
            digits = {"gravity": 3, "field": 0, "dip": 1}[name]
            extent = f"{each.low:.{digits}f}…{each.high:.{digits}f}"
            unit = {"gravity": " g", "field": " nT", "dip": "°"}[name]
            words.append(f"{name} {extent}{unit} (1σ of a row: {each.allowed:.2g}{unit})")
    return ", ".join(words)
