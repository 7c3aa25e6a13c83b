"""`mwdcal registry add` and `withdraw`: what comes into a registry, and what no longer counts."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import lines, print_result, say
from mwdcal.errors import InputError

TABLE = ".parquet"
"""Suffix of tables that may hold many tools."""


@options.command()
@options.argument("files", nargs=-1, required=True)
@options.DATABASE
@options.ACTOR
@click.option(
    "--workers", type=click.IntRange(1), metavar="N", help="Processes. Default: one per core."
)
@options.JSON
def command(
    files: tuple[Path, ...], database: str, actor: str, workers: int | None, as_json: bool
) -> None:
    """Add FILES, or all files of folders: what each is shows in its content.

    Calibrations, verifications (verify --json) and certificates as JSON; runs and readings as they came; tool
    profiles, limits and laboratories; public keys; tables of calibrations that fleet wrote, each tool as a
    calibration file; a folder that export wrote. What is there already is not added again, and a file that
    cannot be added does not stop the others.

    \b
    Example: mwdcal registry add runs tool.toml cals.parquet --as "A. Borg" --database tools.sqlite
    Exit: 0 added, or there already; 2 a file is missing, or not one could be added.
    """
    from mwdcal import pool
    from mwdcal.app.progress import bar

    alone = workers == 1 or all(file.is_file() and file.suffix != TABLE for file in files)
    with pool.preparing(1 if alone else workers):  # these imports, in the workers too
        from mwdcal.registry import imports
        from mwdcal.registry.store import open_registry
        from mwdcal.screens.records import registry as screen
        from mwdcal.use.correction_numba import cores

    portions = imports.portions(imports.sources(files))
    try:
        with open_registry(database) as registry:
            adding = imports.Adding(registry, actor)
            with bar("adding") as advance:
                imports.add_all(adding, portions, 1 if alone else workers or cores(), advance)
            result = screen.added(registry, adding)
    except KeyboardInterrupt as stop:
        stop.add_note("What was added stays: the same command adds the rest.")
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
    Example: mwdcal registry withdraw 1207 --reason "wrong stand angles" --database tools.sqlite
    Exit: 0 withdrawn, 2 there is no such record, or it is withdrawn already.
    """
    from mwdcal.registry.lookup import one_record
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import registry as screen

    with open_registry(database) as registry:
        row = one_record(registry, record)
        registry.withdraw(row["number"], reason, actor)
        result = screen.withdrawn(registry, row, reason)
    print_result(
        screen.document("registry withdraw", result, row)
        if as_json
        else screen.withdrawn_text(result)
    )
