"""`mwdcal registry export`, `backup` and `restore`: all that a registry holds, somewhere else."""

from __future__ import annotations

from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.app.text import one_line, plural


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
    Exit: 0 written, 2 the folder is not empty, or cannot be written.
    """
    from mwdcal.app.progress import bar
    from mwdcal.app.screens.records import registry as screen
    from mwdcal.files.formats.folders import check_new
    from mwdcal.registry.exports import export as write
    from mwdcal.registry.store import open_registry

    check_new(folder)
    with open_registry(database) as registry, bar("exporting") as advance:
        manifest = write(registry, folder, advance)
    result = screen.RegistryExported(
        folder=str(folder), files=len(manifest.files), events=manifest.events, head=manifest.head
    )
    text = f"wrote {plural(result.files, 'document')} to {folder}   newest event {result.head}"
    about = {"simulated": manifest.simulated}
    print_result(screen.document("registry export", result, about) if as_json else one_line(text))


@options.command()
@options.argument("output", metavar="FILE")
@options.DATABASE
@options.JSON
def backup(output: Path, database: str, as_json: bool) -> None:
    """Write a backup of a registry into a FILE, while others go on writing to it.

    Note the hash that it prints: `check --head` later tells whether all is still there.

    \b
    Example: mwdcal registry backup tools-backup.sqlite --database tools.sqlite
    Exit: 0 written, 2 the registry cannot be opened, or the file cannot be written.
    """
    from mwdcal.app.screens.records import registry as screen
    from mwdcal.registry import copies
    from mwdcal.registry.store import open_registry

    options.check_outputs([output], [database])
    with open_registry(database) as registry:
        result = screen.RegistryCopied(file=str(output), head=copies.backup(registry, output))
    text = f"wrote {output}   newest event {result.head}"
    print_result(screen.document("registry backup", result) if as_json else one_line(text))


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
    from mwdcal.app.screens.records import registry as screen
    from mwdcal.registry import copies

    head = copies.restore(source, database, actor)
    result = screen.RegistryCopied(file=str(source), head=head)
    text = f"restored the registry from {source}   newest event of the backup {head}"
    print_result(screen.document("registry restore", result) if as_json else one_line(text))
