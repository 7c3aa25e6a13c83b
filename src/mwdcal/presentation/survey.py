"""The surveys of a well, and multi-station analysis of them, on the screen and for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.readings import serial_of, simulated, stated_day
from mwdcal.calibration.record import Finding, SignatureCheck, stated
from mwdcal.files.formats.columns import shown
from mwdcal.geometry.units import LENGTH_UNITS, USUAL_COURSES
from mwdcal.presentation.contributions import (
    ContributionSummary,
    contribution_screen,
    contribution_summary,
)
from mwdcal.presentation.envelope import json_document, with_signature
from mwdcal.presentation.listing import closures
from mwdcal.presentation.numbers import files_written, fixed, measured, number, signed
from mwdcal.presentation.signature import signature_status
from mwdcal.presentation.text import chance, one_line, plural, table
from mwdcal.survey.interference import Interference, InterferenceSize, MultiStationAnalysis
from mwdcal.survey.path import PathEnd, TieIn
from mwdcal.survey.references import NO_SOURCE
from mwdcal.survey.stations import North
from mwdcal.survey.surveying import SurveyedWell, WellInputs
from mwdcal.survey.well import AXES_OF_EARTH, LastStation, Well, WellCounts, WellErrors
from mwdcal.use.uncertainty import ErrorTerms, error_terms

MOST_CORRECTED = 30
"""Surveys of a table on the screen of multi-station analysis."""
DIRECTION_TITLES = ["interference", "estimate", "1σ", "unit", "assumed 1σ", "from the surveys"]
"""Titles of the table of directions."""
CORRECTED_TITLES = [
    "station", "inclination, °", "azimuth before, °", "after, °", "1σ, °", "change, °",
    "|b| off before, nT", "after, nT", "dip off before, °", "after, °", "weight", "",
]  # fmt: skip
"""Titles of the table of surveys."""


def direction_rows(summary: MultiStationAnalysis) -> list[list[str]]:
    """A row for each direction of interference."""
    rows = []
    for each in summary.directions:
        factor, unit = (1.0, each.unit) if each.unit else (100.0, "%")
        value, sd = measured(factor * each.value, factor * each.standard_uncertainty)
        assumed = number(factor * each.assumed)
        rows.append([each.direction, value, sd, unit, assumed, "yes" if each.determined else "NO"])
    return rows


def corrected_rows(summary: MultiStationAnalysis, most: int) -> list[list[str]]:
    """A row for each survey, before and after."""
    return [
        [
            row.station,
            fixed(row.inclination_deg, 2),
            fixed(row.azimuth_before_deg, 2),
            fixed(row.azimuth_after_deg, 2),
            fixed(row.sd_azimuth_after_deg, 2),
            fixed(row.azimuth_change_deg, 2),
            fixed(row.field_before_nt - row.ref_field_nt, 0),
            fixed(row.field_after_nt - row.ref_field_nt, 0),
            fixed(row.dip_before_deg - row.ref_dip_deg, 2),
            fixed(row.dip_after_deg - row.ref_dip_deg, 2),
            fixed(row.weight, 2),
            "doubtful" if row.doubtful else "",
        ]
        for row in summary.station_rows[:most]
    ]


def verdict(summary: MultiStationAnalysis) -> str:
    """Whether the correction may be used, in a sentence."""
    left = (
        f"interference and drift that are left make the azimuth uncertain by {summary.azimuth_sd_deg:.2g}° (1σ, worst "
        f"survey; {summary.largest_azimuth_sd_deg:g}° allowed)"
    )
    return f"{'separable' if summary.separable else 'NOT separable from azimuth'}: {left}"


def misfit_in_words(summary: MultiStationAnalysis) -> str:
    """χ² before and after, in words."""
    return (
        f"χ² of |g|, |b| and dip {number(summary.chi_square_before)} before, {number(summary.chi_square_after)} after, "
        f"{summary.degrees_of_freedom} expected (probability after {chance(summary.chance_after)})"
    )


def interference_screen(result: Interference, *metadata: Mapping[str, object]) -> str:
    """The analysis for people; `metadata` of calibration and readings."""
    summary = result.summary
    count = len(summary.station_rows)
    heading = [
        "multi-station analysis", result.readings.name, plural(count, "survey"), *simulated(*metadata)
    ]  # fmt: skip
    lines = ["   ".join(heading), verdict(summary)]
    lines += [summary.missing] if summary.missing else []
    lines += [misfit_in_words(summary), result.terms.sentence]
    more = count - MOST_CORRECTED
    surveys = table(corrected_rows(summary, MOST_CORRECTED), CORRECTED_TITLES)
    parts = [
        *map(one_line, lines),
        "",
        table(direction_rows(summary), DIRECTION_TITLES),
        "",
        surveys,
    ]
    return "\n".join([*parts, *([f"… and {more} more"] if more > 0 else [])])


FIRST_SURVEYS = 30
"""Surveys at the beginning of a table on screen; the last comes behind them."""
OFF_IN_WORDS = "\noff: how far |g|, |b| and dip together are from their references"
"""The meaning of a column."""
OUTCOMES = {"true": "accepted", "false": "REJECTED", "": "not judged"}
"""The column `accepted` in words."""
ACCEPTED_TOGETHER = "accepted together"
JOINTLY = f"{ACCEPTED_TOGETHER}: one of |g|, |b| and dip is beyond its own limit, the three as one are within"
"""The meaning of an outcome."""


class EndOfPath(msgspec.Struct, frozen=True, kw_only=True):
    """The last station on the well path: its coordinates, m, with standard uncertainties.

    Closure is the horizontal distance from north 0, east 0, and its azimuth; null at the origin itself.
    """

    station: str
    md_m: float
    north_m: float
    east_m: float
    tvd_m: float
    closure_m: float
    closure_azimuth_deg: float | None
    sd_north_m: float | None
    sd_east_m: float | None
    sd_tvd_m: float | None
    covariance_m2: list[list[float | None]]


class RunOfWell(msgspec.Struct, frozen=True, kw_only=True):
    """One of several runs of a well: its tool, its surveys, and where it ends."""

    run: int
    serial: str
    readings: str
    readings_sha256: str
    calibration_run: str
    calibration_time: str
    calibration_sha256: str
    years_since_calibration: float | None
    rows: int
    accepted: int
    rejected: int
    end: EndOfPath | None
    msa: MultiStationAnalysis | None


class SurveySummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `survey`: stations counted by outcome, what they were judged by, where the path ends.

    `blind`: accepted ones whose azimuth interference could turn and still pass.
    The declination is the mean where it varies by row.
    `reference_sources`: where gravity, field, dip, declination and convergence come from, by name.
    `error_terms` are in the standard uncertainties of surveys and path, `not_included` are not; `error_model` states
    those that are not of the calibration. Drift counts over `years_since_calibration`; null: not known, taken as one.
    `random_walk`: the drift is that of the tool by a registry, not the model's.
    `msa` is the multi-station analysis, if one was asked for; `interference` and `separable` are of it.
    Lengths are in metres; `length_unit` is that of table, screen and page.
    `runs` of a well in several; its stations are then named run:station.
    `contributions`: what makes the uncertainty of each survey; null beyond 2000 surveys.
    """

    rows: int
    accepted: int
    rejected: int
    not_judged: int
    blind: int
    blank: int
    north: str
    declination_deg: float | None
    sd_declination_deg: float | None
    convergence_deg: float | None
    reference_sources: dict[str, str]
    error_model: str
    years_since_calibration: float | None
    random_walk: bool
    error_terms: list[str]
    not_included: list[str]
    limits: str
    source: str
    end: EndOfPath | None
    findings: list[Finding]
    output: str
    html: str
    length_unit: str = "m"
    interference: InterferenceSize | None = None
    separable: bool | None = None
    msa: MultiStationAnalysis | None = None
    contributions: ContributionSummary | None = None
    runs: list[RunOfWell] = []


def refusal(inputs: WellInputs, msa: MultiStationAnalysis) -> SurveySummary:
    """The refusal of a multi-station analysis: none of the surveys is judged, nothing is written."""
    rows, north = inputs.surveys.readings.count, inputs.surveys.north
    return SurveySummary(
        rows=rows,
        accepted=0,
        rejected=0,
        not_judged=rows,
        blind=0,
        blank=rows,
        north=north.name,
        **_stated(north, error_terms(inputs.calibration, north.declination is not None)),
        error_model=inputs.model.name if inputs.model else "none",
        years_since_calibration=None,
        random_walk=False,
        reference_sources=dict(inputs.surveys.sources),
        limits=inputs.limits.name,
        source=inputs.limits.source,
        end=None,
        findings=msa.findings,
        output="",
        html="",
        interference=msa.interference,
        separable=msa.separable,
        msa=msa,
    )


def result_summary(result: SurveyedWell, output: str = "", html: str = "") -> SurveySummary:
    """The result for machines; `output` and `html` are the files that were written, if any."""
    msa = result.analysis.summary if result.analysis else None
    others = result.inputs.surveys.readings.unused
    used = (*map(shown, result.inputs.surveys.others_used),)
    unused = unused_columns(tuple(text for text in others if not text.startswith(used)))
    facts = summary(result.well, result.counts, output, html, msa, unused)
    budget = result.contributions and contribution_summary(result.contributions)
    runs = [_run_of_well(i, run) for i, run in enumerate(result.runs, 1)]
    return replace(facts, contributions=budget, runs=runs)


def _run_of_well(place: int, run: SurveyedWell) -> RunOfWell:
    well, counts = run.well, run.counts
    return RunOfWell(
        run=place, serial=serial_of(well.calibration.tool) or "", readings=well.readings.name,
        readings_sha256=run.inputs.digests["readings"], calibration_run=well.calibration.run_name,
        calibration_time=well.calibration.time, calibration_sha256=run.inputs.digests["calibration"],
        years_since_calibration=well.errors.years if well.errors else None,
        rows=counts.rows, accepted=counts.accepted, rejected=counts.rejected,
        end=end_of_path(counts.end) if counts.end else None,
        msa=run.analysis.summary if run.analysis else None,
    )  # fmt: skip


def runs_in_words(facts: SurveySummary) -> list[str]:
    """A line for each of several runs: its tool and surveys, and where it ends."""
    metres = LENGTH_UNITS[facts.length_unit]
    lines = []
    for run in facts.runs:
        years = run.years_since_calibration
        time = (
            "time since the calibration unknown"
            if years is None
            else f"{fixed(years, 2)} years since the calibration"
        )
        end = f", to {fixed(run.end.md_m / metres, 2)} {facts.length_unit} MD" if run.end else ""
        counts = f"{run.accepted} of {plural(run.rows, 'survey')} accepted"
        tool = f"tool {run.serial}, " if run.serial else ""
        lines.append(
            f"run {run.run}   {run.readings}   {tool}calibration {run.calibration_run}, {time}   {counts}{end}"
        )
    return lines


def document(inputs: WellInputs, facts: SurveySummary, signature: SignatureCheck) -> dict[str, Any]:
    """The document of a result or of a refusal, with what all inputs say of themselves."""
    whole = json_document("survey", facts, *inputs.stated, **inputs.digests)
    return with_signature(whole, signature)


def whole_screen(
    result: SurveyedWell,
    facts: SurveySummary,
    signature: SignatureCheck,
    station: str | None = None,
    **files: Path | None,
) -> str:
    """The result for people, behind the multi-station analysis if there is one.

    `station`: label of the one whose contributions are shown, by default the last. `files`: others that were written.
    """
    stated = result.inputs.stated
    analyses = [run.analysis for run in result.runs] or [result.analysis]
    parts = [interference_screen(each, *stated) for each in analyses if each]
    parts.append(screen(result.well, facts, signature, *stated, last=result.last))
    if result.contributions and facts.blank < facts.rows:
        unit = result.well.length_unit
        parts.append(contribution_screen(result.contributions, station, unit))
    written = files_written(table=facts.output, page=facts.html, **files) if facts.output else ""
    return "\n\n".join(parts) + (f"\n{written}" if written else "")


def all_findings(facts: SurveySummary) -> list[Finding]:
    """The findings of the multi-station analysis, then those about the surveys."""
    analyses = [facts.msa, *(run.msa for run in facts.runs)]
    return [*(f for each in analyses if each for f in each.findings), *facts.findings]


def summary(
    well: Well,
    counts: WellCounts,
    output: str,
    html: str,
    msa: MultiStationAnalysis | None = None,
    about_file: Sequence[Finding] = (),
) -> SurveySummary:
    """The result for machines, `counts` of all surveys; findings `about_file` come after those about the well."""
    north = well.north
    return SurveySummary(
        rows=counts.rows,
        accepted=counts.accepted,
        rejected=counts.rejected,
        not_judged=counts.rows - counts.judged,
        blind=counts.blind,
        blank=counts.blank,
        north=north.name,
        **_stated(north, well.terms),
        error_model=well.errors.model.name if well.errors else "none",
        years_since_calibration=well.errors.years if well.errors else None,
        random_walk=well.errors is not None and well.errors.by_walk,
        reference_sources=dict(well.sources),
        limits=well.limits.name,
        source=well.limits.source,
        end=end_of_path(counts.end) if counts.end else None,
        findings=[*well.findings, *about_file],
        output=output,
        html=html,
        length_unit=well.length_unit,
        interference=msa.interference if msa else None,
        separable=msa.separable if msa else None,
        msa=msa,
    )


def _stated(north: North, terms: ErrorTerms) -> dict[str, Any]:
    """The causes that turn azimuths, degrees, and what their uncertainty holds."""
    return {**north.in_degrees, **terms.stated}


def end_of_path(last: LastStation) -> EndOfPath:
    """The last station with a position."""
    north, east, tvd = last.place.tolist()
    variances = np.maximum(np.diagonal(last.covariance), 0.0)
    sd_north, sd_east, sd_tvd = map(stated, np.sqrt(variances).tolist())
    closure, bearing = closures(last.place[None])
    return EndOfPath(
        station=last.label,
        md_m=last.md,
        north_m=north,
        east_m=east,
        tvd_m=tvd,
        closure_m=float(closure[0]),
        closure_azimuth_deg=stated(float(bearing[0])),
        sd_north_m=sd_north,
        sd_east_m=sd_east,
        sd_tvd_m=sd_tvd,
        covariance_m2=[[*map(stated, row)] for row in last.covariance.tolist()],
    )


def screen(
    well: Well, facts: SurveySummary, signature: SignatureCheck, *metadata: Mapping[str, object],
    last: Well | None = None,
) -> str:  # fmt: skip
    """The surveys for people; `signature` of the calibration, `metadata` of it and of the readings.

    `last`: the end of a long table, of which `well` is the beginning.
    """
    counts = [f"{facts.accepted} accepted", f"{facts.rejected} rejected"]
    counts += without_verdict(facts)
    if facts.blind:
        counts.append(f"{facts.blind} blind to interference")
    counts += [] if facts.end else ["no positions"]
    heading = [well.readings.name, plural(facts.rows, "survey"), *counts]
    heading += [*signature_status(signature), *simulated(*metadata)]
    lines = [
        "   ".join(heading),
        f"azimuths from {facts.north} north{declination_in_words(facts)}   limits {limits_in_words(well, facts)}",
    ]
    lines += runs_in_words(facts)
    if facts.reference_sources:
        lines.append("   ".join(["references", *sources_in_words(facts)]))
    if start := start_in_words(well):
        lines.append(f"path {start}")
    if facts.end:
        lines.append(end_in_words(facts.end, facts.north, facts.length_unit))
    lines.append(well.terms.sentence)
    if well.errors:
        lines.append(model_in_words(well, well.errors, bool(facts.runs)))
    return "\n".join(
        [
            *map(one_line, lines),
            *(
                ["", survey_table(well, facts.rows, last or well)]
                if facts.blank < facts.rows
                else []
            ),
        ]
    )


def without_verdict(facts: SurveySummary) -> list[str]:
    """Numbers of surveys that have a result and no verdict, and of those without a result, in words."""
    lacks = {facts.reference_sources.get(name) for name in ("gravity", "field", "dip")} == {
        NO_SOURCE
    }
    why = ": gravity, field and dip of the place are not given" if lacks else ""
    words = {
        f"not judged{why}": facts.not_judged - facts.blank,
        "without a result": facts.blank,
    }
    return [f"{count} {word}" for word, count in words.items() if count]


def model_in_words(well: Well, errors: WellErrors, runs: bool = False) -> str:
    """The error model, and the time over which the sensors may have drifted; that of several runs stands with these."""
    if runs:
        walk = "; drift by the random walk of each tool" if errors.by_walk else ""
        return f"error model {errors.model.name} ({errors.model.source}); no sag is corrected{walk}"
    time = (
        f"an unknown time since the calibration, taken as a year{_undated(well)}"
        if errors.years is None
        else (f"{fixed(errors.years, 2)} years since the calibration")
    )
    drift = (
        "drift of the sensors by the random walk of this tool"
        if errors.by_walk
        else "drift of the sensors"
    )
    model = f"error model {errors.model.name} ({errors.model.source})"
    return f"{model}; no sag is corrected; {drift} over {time}"


def _undated(well: Well) -> str:
    """The request for the dates that are not known; empty if both are."""
    stated = {"the surveys": well.readings.metadata, "the calibration run": well.calibration.tool}
    lacking = " and ".join(name for name, each in stated.items() if stated_day(each) is None)
    return f": date {lacking}, by a line Date above the table or by --date" if lacking else ""


def declination_in_words(facts: SurveySummary) -> str:
    """The declination with its standard uncertainty, after the name of a north."""
    if facts.declination_deg is None or facts.sd_declination_deg is None:
        return ""
    sd = fixed(facts.sd_declination_deg, 2)
    declination = f"declination {signed(facts.declination_deg, 2)}° ± {sd}°"
    if facts.convergence_deg is None:
        return f" ({declination})"
    added = signed(facts.declination_deg - facts.convergence_deg, 2)
    return f" ({declination}, convergence {signed(facts.convergence_deg, 2)}°: magnetic {added}°)"


def limits_in_words(well: Well, facts: SurveySummary) -> str:
    """The limits and their terms: after multi-station analysis those of noise and references alone."""
    if well.corrected and well.limits.probability is not None:
        return f"{facts.limits}: noise and references alone, as the analysis fitted the sensors to these"
    return f"{facts.limits}{f' ({facts.source})' if facts.source else ''}"


def start_in_words(well: Well) -> str:
    """Where the path starts: at its first station, or where it is tied in, with the dogleg severity from there.

    Empty for a run that goes on where another ended.
    """
    start, position = well.started, well.position
    if isinstance(start, PathEnd) or position is None or not position.on_path.any():
        return ""
    unit, row = well.length_unit, int(np.argmax(position.on_path))
    metres, label = LENGTH_UNITS[unit], well.readings.labels[row]
    if not isinstance(start, TieIn):
        places = zip(("north", "east", "TVD"), start, strict=True)
        taken = ", ".join(f"{name} {fixed(value / metres, 2)}" for name, value in places)
        md = fixed(position.md[row] / metres, 2)
        return f"counted from station {label} at {md} {unit} MD: {taken} {unit}"
    course = USUAL_COURSES[unit]
    severity = np.degrees(position.dogleg[row]) * course * metres
    return (
        f"tied in at {fixed(start.md / metres, 2)} {unit} MD: inclination "
        f"{fixed(np.degrees(start.inclination), 2)}°, azimuth {fixed(np.degrees(start.azimuth), 2)}° taken from "
        f"{well.north.name} north; {fixed(severity, 1)}°/{course:g} {unit} from there to station {label}"
    )


def sources_in_words(facts: SurveySummary) -> list[str]:
    """Where the references come from, those of one source together."""
    names: dict[str, list[str]] = {}
    for name, source in facts.reference_sources.items():
        names.setdefault(source, []).append(name.replace("sd_", "1σ of "))
    return [f"{', '.join(each)}: {source}" for source, each in names.items()]


def end_in_words(end: EndOfPath, north: str, unit: str = "m") -> str:
    """Where the path ends, with standard uncertainties, in a unit of length."""
    metres = LENGTH_UNITS[unit]
    parts = [
        f"{title} {fixed(value / metres, 2)} {unit} (1σ {'not stated' if sd is None else fixed(sd / metres, 2)})"
        for title, value, sd in (
            ("north", end.north_m, end.sd_north_m),
            ("east", end.east_m, end.sd_east_m),
            ("TVD", end.tvd_m, end.sd_tvd_m),
        )
    ]
    closure = f"; closure {fixed(end.closure_m / metres, 2)} {unit}"
    if end.closure_azimuth_deg is not None:
        closure += f" at {fixed(end.closure_azimuth_deg, 2)}°"
    return f"at {fixed(end.md_m / metres, 2)} {unit} MD, from {north} north: {', '.join(parts)}{closure}"


def survey_table(well: Well, count: int, last: Well) -> str:
    """The first of so many surveys, and the last one, each angle with its standard uncertainty."""
    header, rows = survey_rows(well, slice(FIRST_SURVEYS))
    between = count - len(rows) - 1
    if between > 0:
        rows.append([f"… {between} more", *[""] * (len(header) - 1)])
    if between >= 0:
        rows += survey_rows(last, slice(-1, None))[1]
    note = OFF_IN_WORDS if "off, σ" in header and well.judgement.judged.any() else ""
    if any(row[-1].startswith(ACCEPTED_TOGETHER) for row in rows):
        note += f"\n{JOINTLY}"
    return table(rows, header) + note


def survey_rows(
    well: Well, places: slice, located: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the surveys at some places; `located`: with their position."""
    columns = well.columns
    azimuth = f"azimuth_{well.north.name}_deg"
    angles, relative = ["inclination_deg", azimuth, "toolface_deg"], well.calibration.relative
    shown = {
        "inclination_deg": "inc °", azimuth: f"azi {well.north.name} °", "toolface_deg": "toolface °",
        "gravity_g": "|g| g", "field_nt": "|b| (relative)" if relative else "|b| nT", "dip_deg": "dip °",
    }  # fmt: skip
    digits = {"gravity_g": 5, "field_nt": 5 if relative else 0, "dip_deg": 2}
    position, unit = well.position, well.length_unit
    header = ["station", *([f"md {unit}"] if position else [])]
    header += [f"{axis} {unit}" for axis in AXES_OF_EARTH] if position and located else []
    for name, title in shown.items():
        header += [title, "1σ"] if name in angles else [title]
    modelled, rows = well.limits.probability is not None, []
    metres = LENGTH_UNITS[well.length_unit]
    labels, jointly = well.readings.labels, well.judgement.jointly
    for i in range(len(labels))[places]:
        row, place = [labels[i]], []
        if position:
            place = [position.md[i], *(position.place[i] if located else ())]
        row += [fixed(value / metres, 2) for value in place]
        for name in shown:
            row.append(fixed(columns[name][i], digits.get(name, 2)))
            if name in angles:
                row.append(fixed(columns[f"sd_{name}"][i], 2))
        kind = str(columns["toolface_kind"][i])
        distance = well.judgement.distance[i]
        model = [fixed(distance, 1) if well.judgement.judged[i] else "–"] if modelled else []
        outcome = ACCEPTED_TOGETHER if jointly[i] else OUTCOMES[str(columns["accepted"][i])]
        outcome += ", blind" if well.blind[i] else ""
        rows.append([*row, kind, *model, outcome])
    return [*header, "toolface from", *(["off, σ"] if modelled else []), ""], rows
