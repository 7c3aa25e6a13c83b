"""`mwdcal stations`: a continuous log to a run file."""

from __future__ import annotations

from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.app.messages import lines, print_result, say
from mwdcal.presentation.typed import findings_with_option_names, with_option_names


@options.command()
@options.LOG
@options.output(metavar="STATIONS.csv", help="Run file to write; format by suffix.")
@options.COLUMN_NAMES
@options.SAMPLING_HZ
@options.number(
    "--min-seconds", "S", "Shortest station, trimmed. Default: 1, or 15 samples of a slow log."
)
@options.number(
    "--trim-seconds", "S", "Seconds to cut off each end. Default: 1, or 3 samples of a slow log."
)
@options.number(
    "--threshold",
    "FLOORS",
    "Movement that is still rest, in noise floors. Default: found from the log.",
)
@options.plot(help="Also draw what was taken and left.")
@options.report(metavar="PAGE.html")
@options.DECIMAL
@options.JSON
def command(
    log: Path, output: Path, columns: str, plot: Path | None, report: Path | None, decimal: str,
    as_json: bool, **search: float | None,
) -> None:  # fmt: skip
    """Find the standstills in a continuous LOG and write each as a station of a run file.

    \b
    Example: mwdcal stations log.csv -o run.csv --plot log.png
    Exit: 0 written, 2 input cannot be read or never stands still.
    """
    from dataclasses import replace

    from mwdcal.app import messages
    from mwdcal.files import logs
    from mwdcal.files.formats import atomic, table
    from mwdcal.logs.stations import StandstillError, find_stations
    from mwdcal.presentation import stations as screen
    from mwdcal.presentation.envelope import json_document
    from mwdcal.presentation.page import picture
    from mwdcal.presentation.stations import figure, render

    options.check_outputs([output], [log], picture=plot, page=report)
    slowly = messages.slowly(say)
    readings = logs.read(log, options.column_names(columns), decimal=decimal, say=slowly)
    refusal = None
    try:
        stations = find_stations(readings, say=slowly, **search)
    except StandstillError as error:  # the picture helps most then
        refusal, stations = error, error.analysis
    stations = replace(stations, findings=findings_with_option_names(stations.findings))
    why = with_option_names(str(refusal or ""))
    drawn = picture(figure(stations), plot.suffix) if plot else b""
    rendered = render(stations, readings.digest, str(output), why) if report else ""
    if not refusal:
        table.write(output, stations.table)
    atomic.write_all([(plot, drawn), (report, rendered)])
    if refusal:
        for line in [*lines(stations.findings), screen.shown_in(plot, report)]:
            refusal.add_note(line)
        raise refusal
    files = {"output": str(output), "plot": str(plot or ""), "report": str(report or "")}
    content = screen.summary(stations, files)
    document = json_document("stations", content, readings.metadata, log=readings.digest)
    print_result(document if as_json else screen.screen(stations, files), stations.findings)
