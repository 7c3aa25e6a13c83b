"""`mwdcal survey`: surveys of a well, accepted or not, and the path of the hole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import offering_blank, print_result
from mwdcal.errors import InputError
from mwdcal.presentation.typed import findings_with_option_names

if TYPE_CHECKING:
    from mwdcal.calibration.record import SignatureCheck
    from mwdcal.files.statements import Said
    from mwdcal.presentation.signature import LoadedCalibration
    from mwdcal.survey.interference import Interference
    from mwdcal.survey.path import TieIn
    from mwdcal.survey.surveying import SurveyedWell, WellInputs

Outputs = list[tuple[Path, Any]]
"""Files to write, with their content."""


@options.command()
@options.CALIBRATION
@options.argument("readings")
@options.output(metavar="OUT", help="Table to write; format by suffix.")
@click.option(
    "--reference",
    type=options.FILE,
    metavar="REF.json",
    help="Gravity, field, dip and declination of the place: what mwdcal reference --json prints.",
)
@click.option(
    "--msa",
    is_flag=True,
    help="Multi-station analysis first: take the drill string's interference, as all surveys show it, off the "
    "magnetometer.",
)
@click.option("--msa-html", type=options.FILE, hidden=True, help="Page of that analysis alone.")
@click.option(
    "--sensor-drift",
    metavar="owsg|none|FILE",
    help="For --msa: how far the sensors may have drifted since the calibration, 1σ: as the OWSG model (owsg, the "
    "default), not at all (none), or as the [sensor] terms of a limits file.",
)
@click.option(
    "--axial-correction",
    is_flag=True,
    help="Also correct each survey by itself for interference along the tool, from |b| and dip of the place: azimuths "
    "beside the others, blank in the no-go zone near horizontal east-west.",
)
@options.preset(
    "--error-model",
    default="owsg-mwd",
    metavar="NAME|FILE",
    help="What every 1σ holds besides calibration, noise and declination: interference, sag, misalignment, depth and "
    "drift since the calibration (owsg-mwd), nothing (none), or the terms of a file in ISCWSA's JSON form.",
)
@click.option(
    "--run",
    nargs=2,
    type=str,
    multiple=True,
    metavar="CALIBRATION READINGS",
    help="The next run of the same well, with the calibration of its tool; its path goes on where the run before "
    "ended. May be repeated.",
)
@click.option(
    "--registry",
    metavar="URL|FILE",
    help="Registry with earlier calibrations of the tool: the random walk that they show is the drift since the "
    "calibration, instead of that of the error model.",
)
@options.preset(
    "--limits",
    shell_complete=options.offers("survey_limits"),
    default="owsg-mwd",
    metavar="NAME|FILE",
    help="Limits on |g|, |b| and dip: an error model (owsg-mwd), fixed ones (iscwsa-fixed, fixed), or a TOML file with "
    "gravity_g, field_nt and dip_deg, or [sensor] and [reference]. Files of verify --limits do not fit.",
)
@options.preset(
    "--switch",
    default="3,5",
    metavar="LOW,HIGH",
    help="Inclinations, degrees: below LOW the toolface counts from magnetic north, above HIGH from the high "
    "side; between them as at the station before.",
)
@click.option(
    "--tie-in",
    metavar="MD,INC,AZI,N,E,TVD",
    help="Where the path is tied in, taken as exact: m and degrees, azimuth from the north of the path. Or N,E,TVD of "
    "the first station. Default: 0,0,0.",
)
@click.option(
    "--length-unit",
    type=click.Choice(["m", "ft", "usft"]),
    help="Unit of length of the results and of --tie-in, and of depths whose column states none: metres, feet, or US "
    "survey feet (1200/3937 m). Default: length_unit of mwdcal.toml, else m.",
)
@click.option(
    "--section-azimuth",
    type=float,
    default=0.0,
    show_default=True,
    metavar="DEG",
    help="Azimuth of the vertical section, from the north of the path.",
)
@click.option(
    "--station",
    metavar="LABEL",
    help="Station whose contributions to the uncertainty are on the screen. Default: the last on the path.",
)
@click.option(
    "--contributions",
    type=options.FILE,
    metavar="FILE",
    help="Also write a table of the contributions: what each cause of error makes of every 1σ, a row for each "
    "station and cause.",
)
@click.option(
    "--listing",
    type=options.FILE,
    metavar="FILE",
    help="Also write a survey listing for well-planning programs such as COMPASS: MD, Inc, Azi, TVD, N/S, E/W, V.Sec, "
    "DLS, closure, covariance; with the scale of the reference's grid the position on the map too.",
)
@click.option(
    "--covariance",
    is_flag=True,
    help="Add the covariance of the position to the table: covariance_nn_m2 and so on; WITSML always has it.",
)
@options.WHERE_OUTSIDE
@options.MISSING
@options.report(
    old=("--html",),
    help="Also write a page with the pictures; with --msa it shows the analysis too.",
)
@options.of_readings
@options.of_run
@options.DECIMAL
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, readings: Path, output: Path, reference: Path | None, msa: bool,
    msa_html: Path | None, sensor_drift: str | None, axial_correction: bool, error_model: str,
    registry: str | None, limits: str, switch: str, run: tuple[tuple[str, str], ...], tie_in: str | None,
    length_unit: str | None, section_azimuth: float, station: str | None, contributions: Path | None,
    listing: Path | None, covariance: bool, outside: str, missing: str, report: Path | None,
    decimal: str, key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Surveys of a well: READINGS in their order, corrected by the CALIBRATION of their tool.

    Adds inclination, azimuth, toolface, |g|, |b| and dip with standard uncertainties to the columns of READINGS, and
    whether each survey lies within the limits; with measured depths (md_m, md_ft or md_usft) north, east and TVD.

    \b
    Example: mwdcal survey tool.json surveys.csv --reference here.json -o well.csv --report well.html
    Exit: 0 written, 2 input cannot be read, does not belong to the calibration, or lacks the depths of positions asked
    for by an option, 3 a question is open, or with --msa: the surveys do not separate interference from azimuth.
    """
    from mwdcal.files.formats import atomic
    from mwdcal.presentation.signature import load_calibration
    from mwdcal.survey import long_table
    from mwdcal.survey.runs import survey_runs
    from mwdcal.survey.surveying import analysed, check_drift

    if msa_html and (not msa or run):
        raise InputError("`msa_html` goes with `msa` of one run. Leave it out, or add `msa`.")
    check_drift(sensor_drift, msa)
    pairs = [(calibration, readings), *((Path(tool), Path(table)) for tool, table in run)]
    given = [*(file for pair in pairs for file in pair), reference, limits, error_model, *key]
    options.check_outputs([output, msa_html, contributions, listing], given, page=report)
    unit = length_unit or ""
    start, ends = _tie_in(tie_in, unit), _switch(switch)
    loaded, said = [load_calibration(tool, key) for tool, _ in pairs], options.said(decimal)
    wanted = report, contributions, listing, station, covariance, said.statements, said.answers
    whole = any((msa, axial_correction, missing == "blank", run, registry, *wanted))
    if not whole and long_table.in_parts(readings, output, loaded[0].calibration.profile):
        result = long_table.survey_file(
            loaded[0].calibration, readings, output, reference, limits, start, ends, outside, decimal,
            loaded[0].digest, loaded[0].findings, error_model, section_azimuth, unit,
        )  # fmt: skip
        _print(result, loaded[0].signature, (str(output), ""), as_json)
        return
    how = (reference, limits, msa, error_model, missing, section_azimuth, unit, registry)
    inputs = [
        _inputs(tool, table, replace(said, statements={}) if i else said, how)
        for i, (tool, (_, table)) in enumerate(zip(loaded, pairs, strict=True))
    ]
    analyses = [analysed(each, sensor_drift) if msa else None for each in inputs]
    pages = _interference_page(inputs[0], analyses[0], msa_html)
    _check_analyses(inputs, analyses, loaded, pages, report, as_json)
    way: Any = {"tie_in": start, "switch": ends, "outside": outside, "axial": axial_correction}
    result = survey_runs(inputs, analyses, **way)
    _check_positions(result, tie_in, section_azimuth, covariance, listing)
    pages += _pages(result, report, contributions, station) + _listing(result, listing)
    atomic.write_all([_table(result, output, covariance), *pages])
    files, more = (
        (str(output), str(report or "")),
        {"contributions": contributions, "listing": listing},
    )
    _print(result, loaded[0].signature, files, as_json, station, **more)


def _inputs(tool: LoadedCalibration, readings: Path, said: Said, how: Any) -> WellInputs:
    """The inputs of a run: its calibration and its table."""
    from mwdcal.presentation.readings import inputs_of_run, read_surveys

    *how, registry = how
    named = read_surveys(readings, tool.calibration, said)
    with offering_blank():
        inputs = inputs_of_run(tool, named, how)
    if not registry:
        return inputs
    from mwdcal.library.drifts import with_walk

    return with_walk(inputs, registry)


def _table(result: SurveyedWell, output: Path, covariance: bool) -> tuple[Path, Any]:
    """The table of the surveys; WITSML has the covariance of the positions in any case."""
    from mwdcal.files.formats import table as tables

    table = result.table_with(covariance or output.suffix.lower() == ".xml")
    return output, tables.streamed(output, table)


def _pages(
    result: SurveyedWell, report: Path | None, table: Path | None, station: str | None
) -> Outputs:
    """The page, and the table of contributions, where they were asked for.

    Raises:
        InputError: contributions were asked for, and this table is too long for them, or has no azimuths.
    """
    from mwdcal.files.formats import table as tables
    from mwdcal.presentation.contributions import contribution_table, station_row

    pages: Outputs = []
    if report:
        from mwdcal.presentation.survey_page import render

        pages.append((report, render(result, findings_with_option_names(result.well.findings))))
    if table is None and station is None:
        return pages
    if result.contributions is None:
        raise InputError(
            "`contributions` and `station` are for tables of at most 2000 surveys with magnetic readings. Leave them "
            "out, or survey a part of the table."
        )
    station_row(result.contributions, station)
    if table:
        pages.append((table, tables.rendered(table, contribution_table(result))))
    return pages


def _listing(result: SurveyedWell, file: Path | None) -> Outputs:
    """The listing for well-planning programs, where one was asked for."""
    if file is None:
        return []
    from mwdcal.files.formats import table as tables
    from mwdcal.presentation.listing import listing

    return [(file, tables.rendered(file, listing(result)))]


def _check_positions(
    result: SurveyedWell, tie_in: str | None, section: float, covariance: bool, listing: Path | None
) -> None:
    """Refuse options on positions of a well that has none."""
    from mwdcal.survey.surveying import check_path

    texts = {each.id: each.text for each in result.well.findings}
    causes = [texts[each] for each in ("no-path", "outside-temperature") if each in texts]
    lacking = " ".join(causes) if "no-path" in texts else ""
    options_on_path = {"section_azimuth": section, "covariance": covariance, "listing": listing}
    check_path(lacking, tie_in=tie_in, **options_on_path)


def _interference_page(
    inputs: WellInputs, analysis: Interference | None, page: Path | None
) -> Outputs:
    """The page of a multi-station analysis, where one was asked for."""
    if not analysis or not page:
        return []
    from mwdcal.presentation.interference_page import render

    return [(page, render(analysis, inputs.named))]


def _check_analyses(
    inputs: Sequence[WellInputs], analyses: Sequence[Interference | None], loaded: Sequence[LoadedCalibration],
    pages: Outputs, report: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Refuse a run whose analysis cannot be used, with the pages that show it."""
    from mwdcal.files.formats import atomic

    for each, analysis, tool in zip(inputs, analyses, loaded, strict=True):
        if analysis and analysis.refusal:
            atomic.write_all(pages + _interference_page(each, analysis, report))
            _refuse(each, analysis, tool.signature, as_json)


def _refuse(
    inputs: WellInputs, analysis: Interference, signature: SignatureCheck, as_json: bool
) -> None:
    """Print an analysis that cannot be used where machines read it, and refuse it."""
    from mwdcal.presentation import survey as screens

    if as_json:
        facts = screens.refusal(inputs, analysis.summary)
        print_result(screens.document(inputs, facts, signature), [])
    analysis.check()


def _print(
    result: SurveyedWell,
    signature: SignatureCheck,
    files: tuple[str, str],
    as_json: bool,
    station: str | None = None,
    **more: Path | None,
) -> None:
    """Print the result, with the files that were written."""
    from mwdcal.presentation import survey as screens

    facts = screens.result_summary(result, *files)
    shown: object = (
        screens.document(result.inputs, facts, signature)
        if as_json
        else screens.whole_screen(result, facts, signature, station, **more)
    )
    print_result(shown, findings_with_option_names(screens.all_findings(facts)))


def _numbers(name: str, text: str, *counts: int) -> list[float]:
    """Numbers with commas between them, as many as one of the counts."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(abs(value) < 1e9 for value in values):
        raise InputError(
            f"`{name}` must be {' or '.join(map(str, counts))} numbers with commas between them; got {text!r}."
        )
    return values


def _tie_in(text: str | None, unit: str) -> tuple[float, float, float] | TieIn | None:
    """Where the path starts, by three numbers or six."""
    from mwdcal.survey.surveying import length_unit_of, start_of

    if text is None:
        return None
    numbers = _numbers("tie_in", text, 3, 6)
    return start_of(numbers, length_unit_of(unit)[1])


def _switch(text: str) -> tuple[float, float]:
    """Both inclinations in radians."""
    low, high = (radians(value) for value in _numbers("switch", text, 2))
    return low, high
