"""The reference of a place and date, on the screen and for machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from mwdcal.calibration.readings import simulated
from mwdcal.calibration.record import Finding
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import files_written, fixed, signed
from mwdcal.presentation.text import one_line, table
from mwdcal.presentation.typed import findings_with_option_names
from mwdcal.survey.references import MEASURABLE, EarthReference, FilledRun

DECIMALS = {"gravity": 6, "field": 1, "dip": 3, "declination": 3}
"""Digits behind the point of each value; uncertainties have as many."""
PLACE_UNITS = {"gravity": "g", "field": "nT", "dip": "°, down", "declination": "°, east"}


class ReferenceSummary(EarthReference, frozen=True, kw_only=True):
    """The output of `reference`: the reference, and the cells that were filled in a run, by column."""

    filled: dict[str, int]
    output: str


def findings(reference: EarthReference, run: FilledRun | None) -> list[Finding]:
    """Findings of the reference and of the run that was filled."""
    return findings_with_option_names([*reference.findings, *(run.findings if run else [])])


def document(
    reference: EarthReference, run: FilledRun | None, output: Path | None
) -> dict[str, Any]:
    """The result for machines."""
    content = ReferenceSummary(
        **{**asdict(reference), "findings": findings(reference, run)},
        filled=run.cells if run else {},
        output=str(output or ""),
    )
    metadata = [run.table.metadata] if run else []
    return json_document("reference", content, *metadata, run=run.table.digest if run else "")


def screen(reference: EarthReference, run: FilledRun | None, output: Path | None) -> str:
    """The result for people."""
    blocks = [
        one_line("   ".join(heading(reference, run))),
        table(rows(reference), ["", "value", "±, all stations", "±, each station", "source"]),
        "\n".join(notes(reference)),
    ]
    if run:
        blocks.append(one_line("filled " + "   ".join(f"{c}: {n}" for c, n in run.cells.items())))
    if output:
        blocks.append(files_written(run=output) if run else files_written(reference=output))
    return "\n\n".join(blocks)


def heading(reference: EarthReference, run: FilledRun | None) -> list[str]:
    """Place, date and model."""
    place = [f"latitude {reference.latitude_deg:.6g}°", f"longitude {reference.longitude_deg:.6g}°"]
    place += [f"{reference.altitude_m:.6g} m above the ellipsoid", str(reference.date)]
    if reference.model:
        place.append(
            f"{reference.model}, epoch {reference.epoch:.1f}, valid to {reference.valid_to:.1f}"
        )
    return [*place, *simulated(*([run.table.metadata] if run else []))]


def rows(reference: EarthReference) -> list[list[str]]:
    """Each value with its uncertainties and its source."""
    cells = []
    for name, key in MEASURABLE.items():
        values = (getattr(reference, prefix + key, None) for prefix in ("", "sd_", "sd_random_"))
        numbers = [fixed(value, DECIMALS[name]) for value in values]
        source = reference.sources[name].partition(",")[0]
        cells.append([f"{name}, {PLACE_UNITS[name]}", *numbers, source])
    return cells


def notes(reference: EarthReference) -> list[str]:
    """The causes that turn azimuths, and where figures come from."""
    sources = reference.sources
    lines = [f"true azimuth = magnetic azimuth {signed(reference.offset_deg('true'), 3)}°"]
    if reference.convergence_deg is not None:
        lines += [
            f"grid azimuth = magnetic azimuth {signed(reference.offset_deg('grid'), 3)}°",
            f"convergence {signed(reference.convergence_deg, 4)}° of {reference.crs}: {sources['convergence']}",
        ]
    if reference.grid_scale is not None:
        lines.append(
            f"grid scale {fixed(reference.grid_scale, 6)}: length on the map over that on the ellipsoid"
        )
    if reference.coefficients:
        lines.append(f"field: {reference.coefficients}")
    lines += [
        f"gravity {fixed(reference.gravity_ms2, 8)} m/s²; 1 g = {STANDARD_GRAVITY} m/s²",
        f"± 1σ of gravity: {sources['sd_gravity']}",
        f"± 1σ of field, dip and declination: {sources['sd_field_dip_declination']}",
    ]
    return list(map(one_line, lines))
