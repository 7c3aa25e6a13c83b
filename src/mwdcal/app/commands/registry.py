"""`mwdcal registry`: every tool's past in a database.

`mwdcal registry init`, `upgrade`, `check`, `export`, `backup` and `restore`: a registry as a whole.

`mwdcal registry add` and `withdraw`: what comes into a registry, and what no longer counts.

`mwdcal registry list`, `history` and `get`: what a registry knows, and its documents.

`mwdcal registry drift`: how a tool, or every tool, changes from calibration to calibration.
"""

from __future__ import annotations

import gc
import sys
from datetime import UTC, datetime
from pathlib import Path

import click

from mwdcal.app.commands import Commands, Group, options
from mwdcal.app.messages import lines, print_result, say
from mwdcal.errors import InputError
from mwdcal.presentation.text import one_line

SUBCOMMANDS = {
    "init": "registry:init",
    "add": "registry:add",
    "list": "registry:listing",
    "history": "registry:history",
    "get": "registry:get",
    "drift": "registry:drift",
    "withdraw": "registry:withdraw",
    "export": "registry:export",
    "check": "registry:check",
    "backup": "registry:backup",
    "restore": "registry:restore",
    "upgrade": "registry:upgrade",
}
"""Modules of the subcommands, in the order of the help."""


@click.group(cls=Group, commands=Commands(SUBCOMMANDS))
@options.registry(envvar=options.REGISTRY)
def command(database: str | None) -> None:
    """Keep every tool's past in a database: runs, calibrations, verifications, certificates, standards, people.

    The database is a file (SQLite), or PostgreSQL by its URL. Nothing in it is ever changed or removed; each change
    is an event of a history with who and when, chained by hashes.

    \b
    Example: mwdcal registry --registry tools.sqlite init
             mwdcal registry --registry tools.sqlite add calibrations runs tool.toml
             mwdcal registry --registry tools.sqlite list
    """


@options.command()
@options.DATABASE
@options.ACTOR
@options.JSON
def init(database: str, actor: str, as_json: bool) -> None:
    """Create an empty registry, in a new file or an empty PostgreSQL database.

    \b
    Example: mwdcal registry init --registry tools.sqlite
    Exit: 0 created, 2 it exists already, or cannot be written.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry.store import create, open_registry

    create(database, actor)
    with open_registry(database) as registry:
        result = screen.RegistryCreated(registry=registry.name, head=registry.head()[1])
    created = f"created the registry {result.registry}   newest event {result.head}"
    print_result(screen.document("registry init", result) if as_json else created)


@options.command()
@options.DATABASE
@options.ACTOR
@click.option("--to", "target", metavar="VERSION", help="Of the schema. Default: the newest.")
@options.JSON
def upgrade(database: str, actor: str, target: str | None, as_json: bool) -> None:
    """Bring the tables of a registry to the form of this version.

    All in one transaction. Back it up before.

    \b
    Example: mwdcal registry upgrade --registry tools.sqlite
    Exit: 0 as it should be, 2 it cannot be opened, or a newer program made it.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import store

    if target:
        before, after = store.move_to(database, target, actor)
    else:
        before, after = store.upgrade(database, actor)
    result = screen.RegistryUpgraded(before=before, after=after)
    words = f"schema {before} → {after}" if before != after else f"schema {after}   nothing to do"
    print_result(screen.document("registry upgrade", result) if as_json else words)


@options.command()
@options.DATABASE
@click.option(
    "--head",
    metavar="HASH",
    help="Hash of an event that must be there, as an earlier check or a backup printed it.",
)
@options.JSON
def check(database: str, head: str | None, as_json: bool) -> None:
    """Check that nothing in a registry was changed, removed or added beside the program.

    Every byte of every document, every row and the chain of hashes. Only a hash that was noted elsewhere shows that
    the newest events are missing together with all that they brought.

    \b
    Example: mwdcal registry check --registry tools.sqlite
    Exit: 0 sound, 1 altered, 2 it cannot be opened.
    """
    from mwdcal.app.messages import bar
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import checking
    from mwdcal.registry.store import open_registry

    with open_registry(database) as registry:
        with bar("checking") as advance:
            discrepancies = checking.check(registry, head, advance)
        result = screen.checked(registry, discrepancies)
    shown = screen.document("registry check", result) if as_json else screen.check_text(result)
    print_result(shown, screen.problems_of(result))
    sys.exit(0 if result.sound else 1)


@options.command()
@options.argument("folder")
@options.DATABASE
@options.JSON
def export(folder: Path, database: str, as_json: bool) -> None:
    """Write all documents of a registry as files into a new FOLDER, with the history and a manifest.

    `mwdcal registry add FOLDER` brings them into another registry, where they have a history of their own; backup
    and restore keep the history.

    \b
    Example: mwdcal registry export tools --registry tools.sqlite
    Exit: 0 written, 2 the folder is not empty, or cannot be written, 3 a document was altered.
    """
    from mwdcal.app.messages import bar
    from mwdcal.files.formats.atomic import check_new
    from mwdcal.presentation import registry as screen
    from mwdcal.registry.exports import export as write
    from mwdcal.registry.store import open_registry

    check_new(folder)
    with open_registry(database) as registry, bar("exporting") as advance:
        manifest = write(registry, folder, advance)
    result = screen.RegistryExported(
        folder=str(folder), files=len(manifest.files), events=manifest.events, head=manifest.head
    )
    about = {"simulated": manifest.simulated}
    document = screen.document("registry export", result, about)
    print_result(document if as_json else screen.exported_text(result))


@options.command()
@options.argument("output", metavar="FILE")
@options.DATABASE
@options.JSON
def backup(output: Path, database: str, as_json: bool) -> None:
    """Write a backup of a registry into a FILE, while others go on writing to it.

    The registry and the backup are checked first: a backup of before stays where either is not sound.
    Note the hash that it prints: `check --head` later tells whether all is still there.

    \b
    Example: mwdcal registry backup tools-backup.sqlite --registry tools.sqlite
    Exit: 0 written, 2 the registry cannot be opened, or the file cannot be written, 3 the registry was altered.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import exports
    from mwdcal.registry.store import open_registry

    options.check_outputs([output], [database])
    with open_registry(database) as registry:
        result = screen.RegistryCopied(file=str(output), head=exports.backup(registry, output))
    document = screen.document("registry backup", result)
    print_result(document if as_json else screen.copied_text(result))


@options.command()
@options.argument("source", metavar="FILE")
@options.DATABASE
@options.ACTOR
@options.JSON
def restore(source: Path, database: str, actor: str, as_json: bool) -> None:
    """Fill a new registry, a file or an empty PostgreSQL database, from the backup in a FILE.

    \b
    Example: mwdcal registry restore tools-backup.sqlite --registry restored.sqlite
    Exit: 0 restored, 2 the registry is not empty or cannot be written, 3 the backup was altered.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import exports

    head = exports.restore(source, database, actor)
    result = screen.RegistryCopied(file=str(source), head=head)
    text = f"restored the registry from {source}   newest event of the backup {head}"
    print_result(screen.document("registry restore", result) if as_json else one_line(text))


TABLE = ".parquet"
"""Suffix of tables that may hold many tools."""


@options.command()
@options.argument("files", nargs=-1, required=True)
@options.DATABASE
@options.ACTOR
@click.option(
    "--workers", type=options.Whole(1), metavar="N", help="Processes. Default: one per core."
)
@options.JSON
def add(
    files: tuple[Path, ...], database: str, actor: str, workers: int | None, as_json: bool
) -> None:
    """Add FILES, or all files of folders: what each is shows in its content.

    Calibrations, verifications (verify --json) and certificates as JSON; runs and readings as they came; tool
    profiles, limits and laboratories; public keys; tables of calibrations that fleet wrote, each tool as a
    calibration file; a folder that export wrote. Files that are there already are not added again, and a file that
    cannot be added does not stop the others.

    \b
    Example: mwdcal registry add runs tool.toml cals.parquet --as "A. Borg" --registry tools.sqlite
    Exit: 0 added, or there already; 2 a file is missing, or not one could be added.
    """
    from mwdcal import pool
    from mwdcal.app.messages import bar

    alone = workers == 1 or all(file.is_file() and file.suffix != TABLE for file in files)
    with pool.preparing(1 if alone else workers):  # these imports, in the workers too
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import imports
        from mwdcal.registry.store import open_registry
        from mwdcal.use.correction_numba import cores

    portions = imports.portions(imports.sources(files))
    try:
        with open_registry(database) as registry:
            adding = imports.Adding(registry, actor)
            with bar("adding") as advance:
                imports.add_all(adding, portions, 1 if alone else workers or cores(), advance)
            result = screen.added(registry, adding)
    except KeyboardInterrupt as stop:
        stop.add_note("Added files stay: the same command adds the rest.")
        raise
    if not (result.new or result.known):
        for line in lines(result.findings):
            say(line)
        raise InputError(f"{result.registry}: not one of the files could be added. Correct them.")
    document = screen.document("registry add", result, {"simulated": adding.simulated})
    shown = document if as_json else screen.added_text(result, adding.simulated)
    print_result(shown, result.findings)


@options.command()
@click.argument("record")
@click.option("--reason", required=True, metavar="TEXT", help="Why it no longer counts.")
@options.DATABASE
@options.ACTOR
@options.JSON
def withdraw(record: str, reason: str, database: str, actor: str, as_json: bool) -> None:
    """Withdraw a RECORD, by its number or SHA-256: it stays in the history, and no longer counts.

    \b
    Example: mwdcal registry withdraw 1207 --reason "wrong stand angles" --registry tools.sqlite
    Exit: 0 withdrawn, 2 there is no such record, or it is withdrawn already.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry.lookup import one_record
    from mwdcal.registry.store import open_registry

    with open_registry(database) as registry:
        row = one_record(registry, record)
        registry.withdraw(row["number"], reason, actor)
        result = screen.withdrawn(registry, row, reason)
    print_result(
        screen.document("registry withdraw", result, row)
        if as_json
        else screen.withdrawn_text(result)
    )


ROWS = options.preset("--limit", type=options.Whole(1), default=50, help="Most rows to print.")
FIRST = options.preset("--offset", type=options.Whole(0), default=0, help="Rows to leave out.")


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
    type=options.Day(),
    metavar="YYYY-MM-DD",
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
    Example: mwdcal registry list --registry tools.sqlite
    Example: mwdcal registry list --due 2027-01-01 --registry tools.sqlite
    Example: mwdcal registry list --kind certificate --registry tools.sqlite
    Exit: 0 listed, 2 the registry cannot be opened.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry

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
    Example: mwdcal registry history SIM-0001 --registry tools.sqlite
    Exit: 0 shown, 2 there is no such tool, or the registry cannot be opened.
    """
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry

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
    Example: mwdcal registry get SIM-0001 -o tool.json --registry tools.sqlite
    Exit: 0 written, 2 no such record, or the file cannot be written, 3 the record was altered.
    """
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import registry as screen
    from mwdcal.registry import lookup
    from mwdcal.registry.store import open_registry

    options.check_outputs([output], [database], calibration=True)
    with open_registry(database) as registry:
        row, data = lookup.document(registry, record)
        atomic.write(output, data)
    result = screen.RegistryDocument(**{k: row[k] for k in screen.KEYS}, output=str(output))
    shown = screen.document("registry get", result, row) if as_json else screen.got_text(result)
    print_result(shown)


@options.command()
@click.argument("serial", required=False)
@options.DATABASE
@click.option(
    "--limit",
    "limits",
    multiple=True,
    metavar="ANGLE_deg=VALUE",
    help="Largest 95 % accuracy of an angle until the next calibration, such as inclination_deg=0.1. "
    "Default: the errors that the limits profile roll-test allows.",
)
@click.option(
    "--level",
    type=options.Within(0.001, 0.2),
    default=0.01,
    show_default=True,
    help="Share of unchanged tools that are called changed.",
)
@options.renamed(
    "--date",
    "today",
    old=("--today",),
    type=options.Day(),
    metavar="YYYY-MM-DD",
    help="Day by which tools are overdue. Default: today.",
)
@options.report(old=("--html",))
@options.JSON
def drift(
    serial: str | None, database: str, limits: tuple[str, ...], level: float,
    today: datetime | None, report: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Compare the calibrations of the tool SERIAL, or of every tool: did it change, and when is it due?

    Changes are tested against the stated uncertainties, all parameters and calibrations at once. The next due
    date follows from the random walk of the parameters, learnt from the tool and others of its type.

    \b
    Example: mwdcal registry drift SIM-0001 --report drift.html --registry tools.sqlite
    Example: mwdcal registry drift --limit inclination_deg=0.1 --report fleet.html --registry tools.sqlite
    Exit: 0 compared, 2 there is no such tool, or the registry cannot be opened, 3 a document was altered.
    """
    from mwdcal.app.messages import bar
    from mwdcal.files.formats import atomic
    from mwdcal.library import drifts
    from mwdcal.presentation import drift as pages
    from mwdcal.presentation import drift as screen
    from mwdcal.registry.store import open_registry

    options.check_outputs([], [database], page=report)
    day = (today or datetime.now(UTC)).date()
    allowed = drifts.limits_of(limits)
    gc.freeze()  # what is loaded stays: the search for garbage among many tools need not look through it
    with open_registry(database) as registry, bar("comparing") as advance:
        result = drifts.of_registry(registry, serial, allowed, level, day, advance)
    if report:
        atomic.write(report, pages.render(result.tool, result.fleet))
    shown = screen.document(result) if as_json else screen.text(result, report)
    print_result(shown, result.tool.findings if result.tool else [])
