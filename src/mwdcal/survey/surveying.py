"""The surveys of a well from a table of readings: everything that `survey` computes, in two steps."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.table import Table
from mwdcal.survey.acceptance import SurveyLimits, load_survey_limits
from mwdcal.survey.multistation.interference import Interference, interference
from mwdcal.survey.multistation.interference_estimate import Assumed, sensor_drift
from mwdcal.survey.place.references import EarthReference, load_reference
from mwdcal.survey.stations import TOOLFACE_SWITCH
from mwdcal.survey.tables import SurveyReadings, survey_readings, surveyed_table
from mwdcal.survey.well import Well, well


@dataclass(frozen=True)
class WellInputs:
    """What the surveys of a well rest on.

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
        """What calibration and readings say of themselves."""
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
    """What surveys rest on: a table of readings, the calibration of their tool, reference and limits.

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
