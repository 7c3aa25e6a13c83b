"""References of a place in the columns of a run: blank cells are filled, given ones stay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.files.contract import AZIMUTH_KEYS, REFERENCES, magnetic_offset, stated_norths
from mwdcal.files.formats.columns import Column, shown
from mwdcal.files.formats.table import Table, numbers
from mwdcal.files.runs import check_run
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.survey.place.precedence import Claim, contradictions
from mwdcal.survey.place.references import MEASURABLE, EarthReference, north_contradictions

FILLED = ("gravity", "field", "dip")
"""References of a run that are those of a place."""
PLACE_KEY = "earth_reference"
"""Metadata key of a run in which references of a place were filled: where these come from."""


class FilledRun(NamedTuple):
    """A run with the references of a place, how many cells of each column were filled, and findings."""

    table: Table
    cells: dict[str, int]
    findings: list[Finding]


def fill(table: Table, reference: EarthReference) -> FilledRun:
    """A run with blank gravity, field and dip filled, and their uncertainties beside them.

    A cell that holds a value keeps it, and its uncertainty as it is. Where the run counts its azimuths from
    true or grid north, its metadata get the declination and the convergence that they do not state. An
    uncertainty is that of the whole run: of the place, and of the field at the moment of the run.
    """
    check_run(table)
    columns, counts = dict(table.columns), {}
    findings = _other_date(table, reference)
    stated = stated_norths(table.metadata, table.source)
    findings += north_contradictions(table.source, stated, 0.0, reference)
    for name in FILLED:
        column, value, sd = REFERENCES[name].column, *_of_run(reference, name)
        cells = numbers(table, column) if column in columns else np.full(table.count, np.nan)
        blank = np.isnan(cells)
        findings += contradictions(
            name,
            Claim(table.source, cells, _uncertainties(table, f"sd_{column}")),
            Claim("the reference", [value], sd),
            f"Check {column}, its unit, the place and the date.",
        )
        counts[column] = int(blank.sum())
        if counts[column]:
            columns[column] = _filled(table, column, blank, value)
            columns[f"sd_{column}"] = _filled(table, f"sd_{column}", blank, sd)
    if not any(counts.values()):
        text = f"{table.source}: no cell of {', '.join(counts)} is blank. Nothing was filled."
        return FilledRun(table, counts, [*findings, Finding(id="nothing-filled", text=text)])
    filled = replace(table, columns=columns, metadata=_metadata(table, reference))
    return FilledRun(filled, counts, findings)


def _of_run(reference: EarthReference, name: str) -> tuple[float, float]:
    """A value, and its standard uncertainty in a run."""
    key = MEASURABLE[name]
    random = getattr(reference, f"sd_random_{key}", 0.0)
    return getattr(reference, key), math.hypot(getattr(reference, f"sd_{key}"), random)


def _uncertainties(table: Table, column: str) -> Array:
    """Standard uncertainties (n,) of a column, 0 where none is stated."""
    return (
        np.nan_to_num(numbers(table, column)) if column in table.columns else np.zeros(table.count)
    )


def _filled(table: Table, name: str, where: Bools, value: float) -> Column:
    """A column with a value in the blank cells where that is true; a new one is blank elsewhere."""
    cells = table.columns.get(name)
    if cells is None:
        return np.where(where, value, np.nan)
    blank = where & np.isnan(numbers(table, name))
    if isinstance(cells, list):
        text = repr(value).replace(".", table.decimal)
        return [text if new else cell for cell, new in zip(cells, blank.tolist(), strict=True)]
    return np.where(blank, value, cells)


def _metadata(table: Table, reference: EarthReference) -> Mapping[str, object]:
    """The metadata of a run, with what turns its azimuths and where its references come from."""
    metadata = dict(table.metadata)
    north, *angles = AZIMUTH_KEYS
    if REFERENCES["azimuth"].column in table.columns:
        if metadata.get(north, "magnetic") != "magnetic":
            known = {key: getattr(reference, key) for key in angles}
            metadata = {k: v for k, v in known.items() if v is not None} | metadata
        magnetic_offset(metadata, table.source)
    model = reference.model or "measured"
    place = f"latitude {reference.latitude_deg:g}°, longitude {reference.longitude_deg:g}°"
    metadata[PLACE_KEY] = f"{model}, {place}, altitude {reference.altitude_m:g} m, {reference.date}"
    return metadata


def _other_date(table: Table, reference: EarthReference) -> list[Finding]:
    """That the run states another day than the reference."""
    stated = str(table.metadata.get("date", ""))
    if not stated or stated[: len("2026-01-01")] == str(reference.date):
        return []
    text = f"{table.source} states the date {shown(stated)}, the reference is of {reference.date}. Check `date`."
    return [Finding(id="other-date", text=text)]
