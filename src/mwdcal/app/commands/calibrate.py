"""`mwdcal calibrate`: a run to a calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, say

if TYPE_CHECKING:
    from mwdcal.app.commands.choices import Typed


@options.command()
@options.RUN
@options.output("CAL.json", "Calibration file to write.")
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
    run: Path, output: Path, tool: str | None, typed: Typed, exclude: tuple[str, ...],
    report: Path | None, decimal: str, as_json: bool,
) -> None:  # fmt: skip
    """Fit the sensor model to a calibration RUN (CSV, TSV, Parquet or XLSX).

    \b
    Example: mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    Exit: 0 calibrated, 2 input cannot be read, 3 fit failed or refused.
    """
    from mwdcal.app.commands.choices import choose
    from mwdcal.app.inputs import load_run, without
    from mwdcal.app.pages import calibration as page
    from mwdcal.calibration.calibrate import calibrate
    from mwdcal.calibration.diagnosis.findings import UNUSED
    from mwdcal.files import documents

    options.check_outputs([output], [run, tool, typed["prior"]], page=report)
    readings, profile, digests = load_run(run, tool, decimal, typed["prior"])
    excluded = [label for label in readings.station if label in exclude]
    readings = without(readings, exclude)
    chosen = choose(readings, profile, typed, say)
    calibration = calibrate(
        readings, profile, chosen.options, orders=chosen.orders, excluded=excluded, **digests
    )
    if report:
        from mwdcal.app.pages.report import write_report

        write_report(report, calibration)
    documents.write(output, calibration)
    shown = page.summary if as_json else page.screen
    unused = [finding for finding in calibration.findings if finding.id == UNUSED]
    print_result(shown(calibration, chosen, output, report), unused)
