"""`mwdcal registry init`, `upgrade`, `check`, `export`, `backup` and `restore`: a registry as a whole."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.screens.text import one_line


@options.command()
@options.DATABASE
@options.ACTOR
@options.JSON
def init(database: str, actor: str, as_json: bool) -> None:
    """Create an empty registry, in a new file or an empty PostgreSQL database.

    \b
    Example: mwdcal registry init --database tools.sqlite
    Exit: 0 created, 2 it exists already, or cannot be written.
    """
    from mwdcal.registry.setup import create
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

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
    """Bring the tables of a registry to the form that this version of the program needs.

    All in one transaction. Back it up before.

    \b
    Example: mwdcal registry upgrade --database tools.sqlite
    Exit: 0 as it should be, 2 it cannot be opened, or a newer program made it.
    """
    from mwdcal.registry import setup
    from mwdcal.screens.records import registry as screen

    if target:
        before, after = setup.move_to(database, target, actor)
    else:
        before, after = setup.upgrade(database, actor)
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
    Example: mwdcal registry check --database tools.sqlite
    Exit: 0 sound, 1 altered, 2 it cannot be opened.
    """
    from mwdcal.app.progress import bar
    from mwdcal.registry import checking
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

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
    Example: mwdcal registry export tools --database tools.sqlite
    Exit: 0 written, 2 the folder is not empty, or cannot be written, 3 a document was altered.
    """
    from mwdcal.app.progress import bar
    from mwdcal.files.formats.folders import check_new
    from mwdcal.registry.exports import export as write
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

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
    Example: mwdcal registry backup tools-backup.sqlite --database tools.sqlite
    Exit: 0 written, 2 the registry cannot be opened, or the file cannot be written, 3 the registry was altered.
    """
    from mwdcal.registry import copies
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

    options.check_outputs([output], [database])
    with open_registry(database) as registry:
        result = screen.RegistryCopied(file=str(output), head=copies.backup(registry, output))
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
    Example: mwdcal registry restore tools-backup.sqlite --database restored.sqlite
    Exit: 0 restored, 2 the registry is not empty or cannot be written, 3 the backup was altered.
    """
    from mwdcal.registry import copies
    from mwdcal.screens.records import registry as screen

    head = copies.restore(source, database, actor)
    result = screen.RegistryCopied(file=str(source), head=head)
    text = f"restored the registry from {source}   newest event of the backup {head}"
    print_result(screen.document("registry restore", result) if as_json else one_line(text))
