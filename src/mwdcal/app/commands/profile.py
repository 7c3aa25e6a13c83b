"""`mwdcal profile`: a tool profile proposed from a table as it comes."""

from __future__ import annotations

from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result


@options.command()
@options.RUN
@options.output(metavar="TOOL.toml", help="Tool profile to write.")
@options.JSON
def command(run: Path, output: Path, as_json: bool) -> None:
    """Propose a tool profile for a RUN as a logger or spreadsheet program has written it.

    Finds encoding, delimiter and decimal sign, the meaning and unit of each column, and, from
    readings at known attitudes, the axes and nominal scales of both triads. calibrate, verify,
    compare and apply then take such tables with --tool TOOL.toml as they are.

    \b
    Example: mwdcal profile export.csv -o tool.toml
    Exit: 0 written, 2 input cannot be read, 3 a choice is left open (nothing is written).
    """
    from mwdcal.library import planning

    options.check_outputs([output], [run])
    result = planning.propose_profile(run)
    result.save(output)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)
