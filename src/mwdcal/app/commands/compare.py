"""`mwdcal compare`: all methods on one run."""

from __future__ import annotations

import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, say
from mwdcal.errors import FitError
from mwdcal.presentation.text import one_line
from mwdcal.presentation.typed import with_option_names


@options.command()
@options.RUN
@options.tool()
@options.preset(
    "--order",
    type=click.Choice(["0", "1", "2", "3", "auto"]),
    default="auto",
    help="Order of temperature terms, the same for all methods.",
)
@options.SEED
@click.option("--parameters", is_flag=True, help="Print the parameters of every method as well.")
@options.report()
@options.DECIMAL
@options.JSON
def command(
    run: Path, tool: str | None, order: str, seed: int, parameters: bool, report: Path | None,
    decimal: str, as_json: bool,
) -> None:  # fmt: skip
    """Calibrate a RUN by every method, side by side, judged by stations left out.

    \b
    Example: mwdcal compare run.csv --tool servo --report methods.html
    Exit: 0 compared, 2 input cannot be read, 3 every method refused.
    """
    from mwdcal.app.inputs import load_run
    from mwdcal.calibration.diagnosis.findings import of_table
    from mwdcal.calibration.fit_options import order_of
    from mwdcal.calibration.options import Options
    from mwdcal.comparison.compare import able, compare
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import comparison as screen
    from mwdcal.presentation.envelope import json_document

    options.check_outputs([], [run, tool], page=report)
    readings, profile = load_run(run, tool, decimal)
    unused = of_table(readings)
    result = compare(readings, profile, Options(order=order_of(order), seed=seed), progress=say)
    rows = tuple(replace(row, refused=with_option_names(row.refused)) for row in result.rows)
    result = replace(result, rows=rows)
    if report:
        from mwdcal.presentation.comparison import render

        sources = profile.name, readings.run_sha256, readings.profile_sha256
        time = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        atomic.write(report, render(result, *sources, readings.metadata, time))
    if as_json:
        digests = {"run": readings.run_sha256, "profile": readings.profile_sha256}
        content = screen.document(result, unused, report)
        print_result(json_document("compare", content, readings.metadata, **digests), unused)
    else:
        written = f"\nwrote {one_line(report)} (report)" if report else ""
        print_result(screen.text(result, parameters) + written, unused)
    sys.exit(0 if able(result.rows) else FitError.exit_code)
