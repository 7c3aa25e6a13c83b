"""`mwdcal registry list`, `history` and `get`: what a registry knows, and its documents."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result

ROWS = options.preset("--limit", type=click.IntRange(1), default=50, help="Most rows to print.")
FIRST = options.preset("--offset", type=click.IntRange(0), default=0, help="Rows to leave out.")


@options.command("list")
@options.DATABASE
@click.option("--kind", metavar="KIND", help="Records of a kind, such as run, instead of tools.")
@click.option(
    "--search",
    default="",
    metavar="TEXT",
    help="Only tools with this in serial or type, in any case.",
)
@click.option(
    "--due",
    type=click.DateTime(["%Y-%m-%d"]),
    metavar="DATE",
    help="Only tools and measurement standards whose calibration is due before this day.",
)
@ROWS
@FIRST
@options.JSON
def listing(
    database: str, kind: str | None, search: str, due: datetime | None, limit: int, offset: int,
    as_json: bool,
) -> None:  # fmt: skip
    """List the tools of a registry: last calibration, accuracy to expect, next due, last verdict.

    \b
    Example: mwdcal registry list --database tools.sqlite
    Example: mwdcal registry list --due 2027-01-01 --database tools.sqlite
    Example: mwdcal registry list --kind certificate --database tools.sqlite
    Exit: 0 listed, 2 the registry cannot be opened.
    """
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

    day = due.date().isoformat() if due else ""
    with open_registry(database) as registry:
        result = lookup.listed(registry, kind, search, day, offset, limit)
    print_result(screen.document("registry list", result) if as_json else screen.list_text(result))


@options.command()
@click.argument("serial")
@options.DATABASE
@ROWS
@FIRST
@options.JSON
def history(serial: str, database: str, limit: int, offset: int, as_json: bool) -> None:
    """Show the past of the tool SERIAL: all its records, who added them and when.

    \b
    Example: mwdcal registry history SIM-0001 --database tools.sqlite
    Exit: 0 shown, 2 there is no such tool, or the registry cannot be opened.
    """
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

    with open_registry(database) as registry:
        result = lookup.past_of(registry, serial, offset, limit)
    shown = screen.document("registry history", result, {"serial": serial})
    print_result(shown if as_json else screen.history_text(result))


@options.command()
@click.argument("record", metavar="SERIAL|SHA256")
@options.DATABASE
@options.output(metavar="FILE", help="File to write.")
@options.JSON
def get(record: str, database: str, output: Path, as_json: bool) -> None:
    """Write a document as it was added: the latest calibration of a tool, or any by its SHA-256 or number.

    The first eight digits of a SHA-256 will do where no other begins with them.

    \b
    Example: mwdcal registry get SIM-0001 -o tool.json --database tools.sqlite
    Exit: 0 written, 2 no such record, or the file cannot be written, 3 the record was altered.
    """
    from mwdcal.files.formats import atomic
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

    options.check_outputs([output], [database], calibration=True)
    with open_registry(database) as registry:
        row, data = lookup.document(registry, record)
        atomic.write(output, data)
    result = screen.RegistryDocument(**{k: row[k] for k in screen.KEYS}, output=str(output))
    shown = screen.document("registry get", result, row) if as_json else screen.got_text(result)
    print_result(shown)
