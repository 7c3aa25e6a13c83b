"""`mwdcal survey`: surveys of a well, accepted or not, and the path of the hole."""

from __future__ import annotations

from math import radians
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import findings_as_typed, print_result
from mwdcal.errors import InputError


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
@options.preset(
    "--limits",
    default="owsg-mwd",
    metavar="NAME|FILE",
    help="Limits on |g|, |b| and dip: an error model (owsg-mwd), fixed ones (iscwsa-fixed, fixed), or a TOML file.",
)
@options.preset(
    "--switch",
    default="3,5",
    metavar="LOW,HIGH",
    help="Inclinations, degrees: below LOW the toolface counts from magnetic north, above HIGH from the high "
    "side; between them as at the station before.",
)
@click.option(
    "--tie-in", metavar="N,E,TVD", help="Position of the first station, m. Default: 0,0,0."
)
@options.WHERE_OUTSIDE
@click.option(
    "--html", type=options.FILE, metavar="S.html", help="Also write a page with the pictures."
)
@options.DECIMAL
@options.JSON
def command(
    calibration: Path, readings: Path, output: Path, reference: Path | None, limits: str, switch: str,
    tie_in: str | None, outside: str, html: Path | None, decimal: str, as_json: bool,
) -> None:  # fmt: skip
    """Surveys of a well: READINGS in their order, corrected by the CALIBRATION of their tool.

    Adds inclination, azimuth, toolface, |g|, |b| and dip with standard uncertainties to the columns of READINGS, and
    whether each survey lies within the limits; with measured depths (md_m) north, east and TVD.

    \b
    Example: mwdcal survey tool.json surveys.csv --reference here.json -o well.csv --html well.html
    Exit: 0 written, 2 input cannot be read, or does not belong to the calibration.
    """
    from mwdcal.app.envelope import enveloped
    from mwdcal.app.screens.surveys import survey as screens
    from mwdcal.files import documents
    from mwdcal.files.formats import table as tables
    from mwdcal.files.runs import MOST_ROWS, read_export
    from mwdcal.survey.acceptance import load_survey_limits
    from mwdcal.survey.place.references import load_reference
    from mwdcal.survey.tables import survey_readings, surveyed_table
    from mwdcal.survey.well import well

    options.check_outputs([output], [calibration, readings, reference, limits], page=html)
    fitted, digest = documents.load(calibration)
    bounds, limits_digest = load_survey_limits(limits)
    source = read_export(readings, fitted.profile, decimal=decimal, rows=MOST_ROWS)
    place, place_digest = load_reference(reference) if reference else (None, "")
    read, md, north = survey_readings(source, fitted, place)
    result = well(
        fitted, read, bounds, north, md, _three("tie_in", tie_in), _switch(switch), outside
    )
    corrected = surveyed_table(source, result)
    findings = findings_as_typed(result.findings)
    document = enveloped(
        "survey",
        screens.summary(result, str(output), str(html or "")),
        *(fitted.tool, read.metadata),
        calibration=digest,
        readings=source.digest,
        reference=place_digest,
        limits=limits_digest,
    )
    tables.write(output, corrected)
    if html:
        from mwdcal.app.pages.surveys.survey import render
        from mwdcal.files.formats import atomic

        digests = {"calibration": digest, "readings": source.digest, "reference": place_digest}
        stated = {name: each for name, each in digests.items() if each}
        atomic.write(html, render(result, findings, {**stated, "limits": limits_digest}))
    shown = screens.screen(result, str(output), str(html or ""), fitted.tool, read.metadata)
    print_result(document if as_json else shown, findings)


def _numbers(name: str, text: str, count: int) -> list[float]:
    """Numbers with commas between them."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) < 1e9 for value in values):
        raise InputError(
            f"`{name}` must be {count} numbers with commas between them; got {text!r}."
        )
    return values


def _three(name: str, text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    first, second, third = _numbers(name, text, 3)
    return first, second, third


def _switch(text: str) -> tuple[float, float]:
    """Both inclinations in radians."""
    low, high = (radians(value) for value in _numbers("switch", text, 2))
    return low, high
