"""`mwdcal noise`: the noise of a log of a tool at rest."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, say
from mwdcal.presentation.typed import findings_with_option_names


@options.command()
@options.LOG
@options.tool(help="Tool profile with the scales: figures also in g and nT.")
@options.COLUMN_NAMES
@options.SAMPLING_HZ
@options.number("--from", "S", "Use the log from so many seconds on.", "start")
@options.number("--to", "S", "Use it up to so many seconds.", "end")
@options.number(
    "--station-seconds", "S", "Duration of a station. Default: 30, or a tenth of a shorter log."
)
@click.option("--modified", is_flag=True, help="Show modified Allan deviations.")
@options.plot(help="Also draw the Allan deviations.")
@options.report()
@options.DECIMAL
@options.JSON
def command(
    log: Path, tool: str | None, columns: str, start: float | None, end: float | None,
    modified: bool, plot: Path | None, report: Path | None, decimal: str, as_json: bool,
    **times: float | None,
) -> None:  # fmt: skip
    """Noise of every raw channel of a LOG of a tool at rest, by Allan deviation.

    \b
    Example: mwdcal noise static.csv --tool servo --plot noise.png
    Exit: 0 found, 2 input cannot be read or used.
    """
    import numpy as np
    from msgspec.structs import replace

    from mwdcal.app import messages
    from mwdcal.calibration.diagnosis.findings import unused_columns
    from mwdcal.files import logs, synonyms
    from mwdcal.files.contract import COLUMNS
    from mwdcal.files.formats import atomic
    from mwdcal.files.profiles import load_profile
    from mwdcal.logs.allan import Kind
    from mwdcal.logs.noise import check, find_noise
    from mwdcal.presentation import noise as screen
    from mwdcal.presentation.envelope import json_document
    from mwdcal.presentation.noise import figure, render
    from mwdcal.presentation.page import picture

    options.check_outputs([], [log, tool], picture=plot, page=report)
    between = (-np.inf if start is None else start, np.inf if end is None else end)
    check(between, **times)
    slowly = messages.slowly(say)
    profile, digest = load_profile(tool) if tool else (None, "")
    readings = logs.read(log, options.column_names(columns), decimal=decimal, say=slowly)
    kind: Kind = "modified" if modified else "overlapping"
    noise = find_noise(readings, profile=profile, between=between, kind=kind, say=slowly, **times)
    unused = unused_columns(synonyms.unused(list(readings.columns), COLUMNS))
    noise = replace(noise, findings=findings_with_option_names([*noise.findings, *unused]))
    drawn = picture(figure(noise), plot.suffix) if plot else b""
    sources = readings.digest, profile.name if profile else "", digest
    rendered = render(noise, *sources) if report else ""
    digests = {"log": readings.digest, "profile": digest}
    document = json_document(
        "noise", screen.document(noise, plot, report), readings.metadata, **digests
    )
    atomic.write_all([(plot, drawn), (report, rendered)])
    print_result(document if as_json else screen.screen(noise, plot, report), noise.findings)
