"""`mwdcal fleet`: a table of many tools to a table of calibrations."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Unpack

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, say
from mwdcal.errors import FitError, InputError


@options.command()
@options.argument("runs")
@options.output(metavar="CALS.parquet", help="Table of calibrations to write, one row per tool.")
@options.tool()
@options.fit_options("0", "none", "datasheet", "the tolerances in the tool profile")
@click.option(
    "--workers",
    type=options.Whole(1),
    metavar="N",
    help="Processes on this machine. Default: one per core.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Use the workers of this Dask scheduler instead, such as tcp://host:8786.",
)
@click.option(
    "--records/--no-records",
    default=None,
    help="Whether the table holds the whole calibration of each tool, for CALS.parquet#SERIAL. Default: "
    "where it has at most 500 tools.",
)
@click.option(
    "--calibrations",
    type=options.FILE,
    metavar="DIR",
    help="Also write the calibration file of each tool into this folder, which must be new or empty.",
)
@options.report(metavar="FLEET.html", help="Also write a summary page of the fleet.")
@options.JSON
def command(
    runs: Path, output: Path, tool: str | None, workers: int | None,
    scheduler: str | None, records: bool | None, calibrations: Path | None, report: Path | None,
    as_json: bool, **typed: Unpack[options.FitArguments],
) -> None:  # fmt: skip
    """Calibrate many tools: RUNS is a folder of run files, or a table with a column `serial`.

    Run files and tables are CSV, TSV, XLSX or Parquet. One tool of the result is named
    CALS.parquet#SERIAL in apply, verify and convert.

    Interrupted, the same command goes on where it was: finished parts are kept beside the output.

    \b
    Example: mwdcal fleet runs.parquet -o cals.parquet --tool servo --report fleet.html
    Example: mwdcal fleet folder -o cals.parquet --tool tool.toml --calibrations tools
    Exit: 0 at least one tool calibrated, 2 input cannot be read, 3 not a single one.
    """
    from mwdcal import pool

    with pool.preparing(1 if scheduler else workers):  # these imports, in the workers too
        from mwdcal.calibration.options import options_of
        from mwdcal.files.formats import atomic
        from mwdcal.fleet import kept
        from mwdcal.library import fleet_table
        from mwdcal.presentation import fleet as screen
        from mwdcal.presentation.text import plural

        if report:
            from mwdcal.presentation import fleet_page

    options.check_outputs([output], [runs, tool], page=report, calibration=True)
    if calibrations:
        if records is False:
            raise InputError("`calibrations` needs the whole calibrations: leave out --no-records.")
        atomic.check_new(calibrations)
        records = True
    fit = options_of(typed, fleet_table.prior_of_fleet(typed["prior"]))
    try:
        summary = fleet_table.calibrate_table(
            runs, output, tool, fit, typed, workers, scheduler, records, say
        )
        if calibrations:
            count = kept.write(output, calibrations)
            say(f"wrote {plural(count, 'calibration file')} to {calibrations}")
        if report:
            atomic.write(report, fleet_page.render(output, summary))
    except KeyboardInterrupt as stop:
        stop.add_note("Finished parts are kept: the same command goes on from there.")
        raise
    shown = screen.document if as_json else screen.text
    print_result(shown(summary, report), screen.findings(summary))
    sys.exit(0 if summary.sound else FitError.exit_code)
