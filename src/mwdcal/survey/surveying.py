"""The surveys of a well from a table of readings: everything that `survey` computes, in two steps.

Surveys from a table of readings, and the table with the results beside its columns.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.readings import CONSTANTS, Readings, is_simulated
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import synonyms
from mwdcal.files.contract import REFERENCES, check_columns
from mwdcal.files.formats.table import Table, cell_error, numbers
from mwdcal.files.runs import renamed, to_readings
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import StandProfile
from mwdcal.survey.acceptance import SurveyLimits, load_survey_limits
from mwdcal.survey.interference import Interference, interference
from mwdcal.survey.interference_estimate import Assumed, sensor_drift
from mwdcal.survey.norths import SD_KEY, North, norths_of
from mwdcal.survey.references import (
    FROM_REFERENCE,
    MEASURABLE,
    NO_SOURCE,
    Claim,
    EarthReference,
    contradictions,
    load_reference,
    source_of,
)
from mwdcal.survey.stations import RANDOM, TOOLFACE_SWITCH
from mwdcal.survey.well import Well, well

MEASURED_DEPTH = "md_m"
"""The column of measured depths, m."""
LARGEST_DEPTH = 20_000.0
"""No hole is longer, m."""
_DEPTH_NAMES = re.compile(
    r"(md|dept|((measured|bit|survey|hole|along[ _-]?hole)[ _]?)?depth)[ _]*[\[(]?(m|ft|feet|met(re|er)s?)?[\])]?"
)


@dataclass(frozen=True)
class SurveyReadings:
    """The readings of a table, measured depths (n,) if it has them, and the norths that azimuths may count from.

    `sources`: where gravity, field, dip, declination and convergence come from, by name. `findings`: what of the
    reference contradicts the table, or is not used.
    """

    readings: Readings
    md: Array | None
    north: North
    sources: Mapping[str, str]
    findings: list[Finding]

    @property
    def uses_reference(self) -> bool:
        """Whether anything of the reference of the place is used."""
        return any(FROM_REFERENCE in source for source in self.sources.values())


def survey_readings(
    table: Table,
    calibration: Calibration,
    reference: EarthReference | None = None,
    recognised: bool = True,
) -> SurveyReadings:
    """The readings of a table of surveys, and the references they are judged and turned by.

    Uncertainties of the laboratory's stand and references do not count in a well.
    Stations have fingerprints where they are to be `recognised`.
    What the table states counts before the `reference`, by `mwdcal.survey.references`.

    Raises:
        InputError: a table that cannot be read, depths under another name or in another unit.
    """
    table = renamed(table, calibration.profile)
    check_columns(list(table.columns), table.source)
    if calibration.thermal:
        synonyms.check_evidence(list(table.columns), table.source, ("temperature_c",))
    in_a_well = replace_struct(calibration.profile, stand=StandProfile())
    readings, _ = to_readings(table, in_a_well, recognised)
    north = norths_of(table, readings, calibration, reference)
    names = (
        CONSTANTS if calibration.has_field and readings.magnetometer is not None else CONSTANTS[:1]
    )
    sources, findings = {}, []
    for name in names:
        otherwise = NO_SOURCE if reference is None else FROM_REFERENCE
        sources[name] = source_of(~np.isnan(_stated(readings, name)), otherwise)
        if reference is not None:
            findings += _contradictions(table.source, readings, reference, name)
    if len(names) == len(CONSTANTS):
        sources |= north.sources
    if reference is not None:
        readings = _referenced(readings, reference)
    result = SurveyReadings(readings, _depths(table), north, sources, findings)
    if reference is not None and not result.uses_reference:
        text = f"nothing of `reference` is used: {table.source} states all of it itself. Leave one of the two out."
        findings.append(Finding(id="reference-unused", text=text))
    return result


def _stated(readings: Readings, name: str) -> Array:
    """Gravity, field or dip (n,) as the table states it, NaN where it does not."""
    return np.broadcast_to(readings.known.get(name, np.nan), readings.count)


def _of_place(reference: EarthReference, name: str) -> tuple[float, float, float]:
    """A strength or dip of the place, its 1σ that all stations share, and that of each its own, as in `Readings`."""
    key, factor = MEASURABLE[name], REFERENCES[name].factor
    value, shared, alone = (getattr(reference, f"{p}{key}", 0.0) for p in ("", "sd_", "sd_random_"))
    return value * factor, shared * factor, alone * factor


def _contradictions(
    source: str, readings: Readings, reference: EarthReference, name: str
) -> list[Finding]:
    """Where the table and the reference contradict each other."""
    factor, (value, shared, alone) = REFERENCES[name].factor, _of_place(reference, name)
    return contradictions(
        name,
        Claim(source, _stated(readings, name) / factor, readings.uncertainty(name) / factor),
        Claim("the reference", [value / factor], np.hypot(shared, alone) / factor),
        "Check unit, place and date.",
    )


def _referenced(readings: Readings, reference: EarthReference) -> Readings:
    """The readings with gravity, field and dip of the place where the table states none.

    Their uncertainty that all stations share stands under the name, and what is new at each under `RANDOM`.
    """
    known, sd = dict(readings.known), dict(readings.sd)
    for name in CONSTANTS:
        value, shared, alone = _of_place(reference, name)
        stated = _stated(readings, name)
        blank = np.isnan(stated)
        known[name] = np.where(blank, value, stated)
        sd[name] = np.where(blank, shared, readings.uncertainty(name))
        sd[RANDOM + name] = np.where(blank, alone, 0.0)
    return replace(readings, known=known, sd=sd)


def _depths(table: Table) -> Array | None:
    if MEASURED_DEPTH not in table.columns:
        for name in table.columns:
            if _DEPTH_NAMES.fullmatch(name.strip().lower()):
                raise InputError(
                    f"{table.source}: column '{name}': measured depths must be in metres, in a column "
                    f"'{MEASURED_DEPTH}'. Rename it, and convert feet (× 0.3048)."
                )
        return None
    column = table.columns[MEASURED_DEPTH]
    depths = numbers(table, MEASURED_DEPTH) if isinstance(column, list) else column
    wrong = np.flatnonzero((depths < 0) | (depths > LARGEST_DEPTH))
    if wrong.size:
        problem = f"must be between 0 and {LARGEST_DEPTH:g} m; got {depths[wrong[0]]:g}."
        raise cell_error(table, MEASURED_DEPTH, int(wrong[0]), problem)
    there = np.flatnonzero(~np.isnan(depths))
    back = there[1:][np.diff(depths[there]) <= 0]
    if back.size:
        problem = f"must increase from station to station; got {depths[back[0]]:g}. Sort; leave repeated surveys out."
        raise cell_error(table, MEASURED_DEPTH, int(back[0]), problem)
    return depths if there.size else None


def surveyed_table(table: Table, well: Well) -> Table:
    """The table with the results beside its columns.

    Raises:
        InputError: a column has the name of a result already.
    """
    results = well.columns
    taken = [name for name in results if name in table.columns]
    if taken:
        raise InputError(
            f"{table.source}: the column '{taken[0]}' is there already, and would be lost under the result of that "
            "name. Rename it."
        )
    texts: dict[str, str] = {}  # few words stand in many rows: each is in memory once
    columns = {
        name: values
        if values.dtype.kind == "f"
        else [texts.setdefault(cell, cell) for cell in map(str, values)]
        for name, values in results.items()
    }
    metadata = {**table.metadata, **described(well)}
    return replace(table, columns={**table.columns, **columns}, metadata=metadata)


def described(well: Well) -> Mapping[str, object]:
    """The statements of a table of surveys about the calibration, north and limits it rests on."""
    calibration, north = well.calibration, well.north
    stated: dict[str, object] = {
        "calibration_run": calibration.run,
        "calibration_time": calibration.time,
        "survey_limits": well.limits.name,
        "north": north.name,
        "error_terms": list(well.terms.included),
        "not_included": list(well.terms.left_out),
    }
    for key, angle in (
        ("declination_deg", north.declination),
        (SD_KEY, None if north.declination is None else north.declination_sd),
        ("convergence_deg", north.convergence),
    ):
        if angle is not None:
            stated[key] = float(np.degrees(angle))
    if well.sources:
        stated["reference_sources"] = dict(well.sources)
    if is_simulated(calibration.tool) or is_simulated(well.readings.metadata):
        stated["simulated"] = True
    if well.findings:
        stated["findings"] = [finding.text for finding in well.findings]
    return stated


@dataclass(frozen=True)
class WellInputs:
    """The inputs of the surveys of a well.

    `findings` are of the calibration's signature and of the reference; `digests` the SHA-256 of each input by name,
    empty for one that is in memory.
    """

    calibration: Calibration
    table: Table
    surveys: SurveyReadings
    limits: SurveyLimits
    findings: list[Finding]
    digests: Mapping[str, str]

    @property
    def stated(self) -> tuple[Mapping[str, object], Mapping[str, object]]:
        """The statements of calibration and readings about themselves."""
        return self.calibration.tool, self.surveys.readings.metadata

    @property
    def named(self) -> dict[str, str]:
        """Digests of the inputs that are files."""
        return {name: digest for name, digest in self.digests.items() if digest}


@dataclass(frozen=True)
class SurveyedWell:
    """The surveys of a well with what they rest on; `analysis` is None without multi-station analysis."""

    inputs: WellInputs
    well: Well
    analysis: Interference | None = None

    @property
    def table(self) -> Table:
        """The table of the readings with the results beside its columns."""
        return surveyed_table(self.inputs.table, self.well)


def well_inputs(
    calibration: Calibration,
    table: Table,
    reference: EarthReference | str | os.PathLike[str] | None = None,
    limits: SurveyLimits | str | os.PathLike[str] = "owsg-mwd",
    recognised: bool = False,
    digest: str = "",
    findings: Sequence[Finding] = (),
) -> WellInputs:
    """The inputs of surveys: a table of readings, the calibration of their tool, reference and limits.

    `reference` and `limits` are values, or files by path. Stations that multi-station analysis puts into the record
    have to be `recognised`. `digest` and `findings` are of the file of the calibration.

    Raises:
        InputError: a file that cannot be read, readings that do not belong to the calibration.
    """
    bounds, limits_digest = (
        (limits, "") if isinstance(limits, SurveyLimits) else load_survey_limits(limits)
    )
    place, place_digest = (
        (reference, "")
        if reference is None or isinstance(reference, EarthReference)
        else load_reference(reference)
    )
    read = survey_readings(table, calibration, place, recognised=recognised)
    digests = {"calibration": digest, "readings": table.digest}
    digests |= {"reference": place_digest} if read.uses_reference else {}
    return WellInputs(
        calibration,
        table,
        read,
        bounds,
        [*findings, *read.findings],
        {**digests, "limits": limits_digest},
    )


def check_drift(drift: object, msa: bool) -> None:
    """Refuse a drift of the sensors without the multi-station analysis that allows for it."""
    if drift and not msa:
        raise InputError("`sensor_drift` goes with `msa`. Leave it out, or add `msa`.")


def analysed(inputs: WellInputs, drift: str | os.PathLike[str] | None = None) -> Interference:
    """The multi-station analysis of surveys; whether it may be used says its `check`.

    `drift` as of `interference_estimate.sensor_drift`, by default that of the OWSG model.
    """
    assumed = Assumed(drift=sensor_drift(drift or "owsg"))
    surveys = inputs.surveys
    return interference(inputs.calibration, surveys.readings, assumed, surveys.md)


def survey_well(
    inputs: WellInputs,
    analysis: Interference | None = None,
    *,
    tie_in: tuple[float, float, float] | None = None,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
) -> SurveyedWell:
    """The surveys of a well, corrected for interference where there is an `analysis`; else as of `well`."""
    surveys = inputs.surveys
    fitted = analysis.calibration if analysis else inputs.calibration
    result = well(
        fitted, surveys.readings, inputs.limits, surveys.north, surveys.md, tie_in, switch, outside
    )
    findings = [*inputs.findings, *result.findings]
    return SurveyedWell(
        inputs, replace(result, findings=findings, sources=surveys.sources), analysis
    )
