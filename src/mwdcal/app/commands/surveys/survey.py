"""`mwdcal survey`: surveys of a well, accepted or not, and the path of the hole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import findings_as_typed, print_result
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.app.choices import LoadedCalibration
    from mwdcal.calibration.canonical import SignatureCheck
    from mwdcal.calibration.readings import Readings
    from mwdcal.calibration.record import Calibration, Finding
    from mwdcal.files.formats.table import Table
    from mwdcal.geometry.vectors import Array
    from mwdcal.survey.acceptance import SurveyLimits
    from mwdcal.survey.multistation.interference import Interference
    from mwdcal.survey.norths import North
    from mwdcal.survey.well import Well


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
@click.option(
    "--msa-html", type=options.FILE, metavar="M.html", help="Also write a page of that analysis."
)
@click.option(
    "--sensor-drift",
    metavar="owsg|none|FILE",
    help="For --msa: how far the sensors may have drifted since the calibration, 1σ: as the OWSG model (owsg, the "
    "default), not at all (none), or as the [sensor] terms of a limits file.",
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
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, readings: Path, output: Path, reference: Path | None, msa: bool,
    msa_html: Path | None, sensor_drift: str | None, limits: str, switch: str, tie_in: str | None, outside: str,
    html: Path | None, decimal: str, key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Surveys of a well: READINGS in their order, corrected by the CALIBRATION of their tool.

    Adds inclination, azimuth, toolface, |g|, |b| and dip with standard uncertainties to the columns of READINGS, and
    whether each survey lies within the limits; with measured depths (md_m) north, east and TVD.

    \b
    Example: mwdcal survey tool.json surveys.csv --reference here.json -o well.csv --html well.html
    Exit: 0 written, 2 input cannot be read, or does not belong to the calibration, 3 with --msa: the surveys do not
    separate interference from azimuth.
    """
    from mwdcal.app.choices import load_calibration
    from mwdcal.files.formats import atomic
    from mwdcal.files.formats import table as tables
    from mwdcal.survey.tables import surveyed_table
    from mwdcal.survey.well import well

    if msa_html and not msa:
        raise InputError("`msa_html` goes with `msa`. Leave it out, or add `msa`.")
    if sensor_drift and not msa:
        raise InputError("`sensor_drift` goes with `msa`. Leave it out, or add `msa`.")
    inputs = [calibration, readings, reference, limits, *key]
    options.check_outputs([output, msa_html], inputs, page=html)
    start, ends = _three("tie_in", tie_in), _switch(switch)
    loaded = load_calibration(calibration, key)
    scene = _read(loaded, readings, reference, limits, decimal, msa)
    fitted, analysis = scene.calibration, None
    pages: list[tuple[Path, bytes | str]] = []
    if msa:
        analysis, pages = _analysed(scene, msa_html, sensor_drift or "owsg", as_json)
        fitted = analysis.calibration
    result = well(fitted, scene.readings, scene.limits, scene.north, scene.md, start, ends, outside)
    findings = [*loaded.findings, *scene.findings, *result.findings]
    result = replace(result, findings=findings, sources=scene.sources)
    if html:
        from mwdcal.app.pages.surveys.survey import render

        findings = findings_as_typed(result.findings)
        pages.append((html, render(result, findings, scene.named)))
    content = tables.rendered(output, surveyed_table(scene.table, result))
    atomic.write_all([(output, content), *pages])
    _print(scene, result, analysis, (str(output), str(html or "")), as_json)


@dataclass(frozen=True)
class _WellInputs:
    """What the command was given; digests of its files."""

    signature: SignatureCheck
    calibration: Calibration
    table: Table
    readings: Readings
    md: Array | None
    north: North
    limits: SurveyLimits
    sources: Mapping[str, str]
    findings: list[Finding]
    digests: dict[str, str]

    @property
    def stated(self) -> tuple[Mapping[str, object], Mapping[str, object]]:
        """What calibration and readings say of themselves."""
        return self.calibration.tool, self.readings.metadata

    def enveloped(self, summary: object) -> dict[str, Any]:
        """The result for machines, with what all inputs say of themselves."""
        from mwdcal.app.envelope import enveloped, with_signature

        document = enveloped("survey", summary, *self.stated, **self.digests)
        return with_signature(document, self.signature)

    @property
    def named(self) -> dict[str, str]:
        """Digests of the files that there are."""
        return {name: digest for name, digest in self.digests.items() if digest}


def _read(
    loaded: LoadedCalibration, readings: Path, reference: Path | None, limits: str, decimal: str, msa: bool,
) -> _WellInputs:  # fmt: skip
    """The files read; stations that multi-station analysis puts into the record have fingerprints."""
    from mwdcal.files.runs import MOST_ROWS, read_export
    from mwdcal.survey.acceptance import load_survey_limits
    from mwdcal.survey.place.references import load_reference
    from mwdcal.survey.tables import survey_readings

    fitted = loaded.calibration
    bounds, limits_digest = load_survey_limits(limits)
    source = read_export(readings, fitted.profile, decimal=decimal, rows=MOST_ROWS)
    place, place_digest = load_reference(reference) if reference else (None, "")
    read = survey_readings(source, fitted, place, recognised=msa)
    digests = {"calibration": loaded.digest, "readings": source.digest}
    digests |= {"reference": place_digest} if read.uses_reference else {}
    return _WellInputs(
        loaded.signature,
        fitted,
        source,
        read.readings,
        read.md,
        read.north,
        bounds,
        read.sources,
        read.findings,
        {**digests, "limits": limits_digest},
    )


def _analysed(
    scene: _WellInputs, page: Path | None, drift: str, as_json: bool
) -> tuple[Interference, list[tuple[Path, bytes | str]]]:
    """The multi-station analysis and its page; one that is not separable is printed and refused."""
    from mwdcal.app.screens.surveys.survey import refusal
    from mwdcal.files.formats import atomic
    from mwdcal.survey.multistation.interference import interference
    from mwdcal.survey.multistation.interference_estimate import Assumed, sensor_drift

    assumed = Assumed(drift=sensor_drift(drift))
    analysis = interference(scene.calibration, scene.readings, assumed, scene.md)
    pages: list[tuple[Path, bytes | str]] = []
    if page:
        from mwdcal.app.pages.surveys.interference import render

        pages.append((page, render(analysis, scene.named)))
    if not analysis.summary.separable:
        atomic.write_all(pages)
        if as_json:
            refused = refusal(
                analysis.summary, scene.limits, scene.north, scene.sources, scene.readings.count
            )
            print_result(scene.enveloped(refused), [])
        analysis.check()
    return analysis, pages


def _print(
    scene: _WellInputs,
    result: Well,
    analysis: Interference | None,
    files: tuple[str, str],
    as_json: bool,
) -> None:
    """What came of it."""
    from mwdcal.app.screens.surveys import interference as screens_of_msa
    from mwdcal.app.screens.surveys import survey as screens
    from mwdcal.calibration.diagnosis.findings import unused_columns

    msa = analysis.summary if analysis else None
    unused = unused_columns(scene.readings.unused)
    summary = screens.summary(result, *files, msa, unused)
    document = scene.enveloped(summary)
    shown = screens.screen(result, summary, scene.signature, *scene.stated)
    if analysis:
        shown = f"{screens_of_msa.screen(analysis, *scene.stated)}\n\n{shown}"
    findings = findings_as_typed([*(msa.findings if msa else []), *summary.findings])
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
