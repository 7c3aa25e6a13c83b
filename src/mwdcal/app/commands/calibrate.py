"""`mwdcal calibrate`: a run to a calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, say


@options.command()
@options.RUN
@options.output(metavar="CAL.json", help="Calibration file to write.")
@options.tool()
@options.fit_options(
    "auto",
    "auto",
    "CAL.json|datasheet",
    "a previous calibration of this tool, with its covariance, or the tolerances in the tool profile",
)
@click.option(
    "--exclude", multiple=True, metavar="STATION", help="Leave a station out; may be repeated."
)
@options.report()
@options.DECIMAL
@options.JSON
def command(
    run: Path, output: Path, tool: str | None, exclude: tuple[str, ...],
    report: Path | None, decimal: str, as_json: bool, **typed: Unpack[options.Typed],
) -> None:  # fmt: skip
    """Fit the sensor model to a calibration RUN (CSV, TSV, Parquet, XLSX, WITSML or LAS).

    \b
    Example: mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    Exit: 0 calibrated, 2 input cannot be read, 3 fit failed or refused.
    """
    from mwdcal.app.choices import load_run, options_of, prior_of
    from mwdcal.calibration.calibrate import chosen_fit, recorded
    from mwdcal.files import documents
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import calibration as screen

    options.check_outputs([output], [run, tool, typed["prior"]], page=report, calibration=True)
    prior, digest = prior_of(typed["prior"])
    readings, profile = load_run(run, tool, decimal, prior)
    choice, result = chosen_fit(readings, profile, options_of(typed, prior, exclude, digest), say)
    calibration = recorded(choice, result)
    rendered = ""
    if report:
        from mwdcal.presentation.calibration_page import render

        rendered = render(calibration)
    shown = (screen.summary if as_json else screen.screen)(
        calibration, choice.curves, output, report
    )
    atomic.write_all([(output, documents.encode(calibration)), (report, rendered)])
    print_result(shown, screen.first_findings(calibration))
