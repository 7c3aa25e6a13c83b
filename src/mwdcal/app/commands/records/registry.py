"""`mwdcal registry`: every tool's past in a database."""

from __future__ import annotations

import click

from mwdcal.app.commands import Commands, Group, options

SUBCOMMANDS = {
    "init": "records.registry_whole:init",
    "add": "records.registry_add",
    "list": "records.registry_queries:listing",
    "history": "records.registry_queries:history",
    "get": "records.registry_queries:get",
    "drift": "records.registry_drift",
    "withdraw": "records.registry_add:withdraw",
    "export": "records.registry_whole:export",
    "check": "records.registry_whole:check",
    "backup": "records.registry_whole:backup",
    "restore": "records.registry_whole:restore",
    "upgrade": "records.registry_whole:upgrade",
}
"""Modules of the subcommands, in the order of the help."""


@click.group(cls=Group, commands=Commands(SUBCOMMANDS))
@options.database(envvar=options.REGISTRY)
def command(database: str | None) -> None:
    """Keep every tool's past in a database: runs, calibrations, verifications, certificates, standards, people.

    The database is a file (SQLite), or PostgreSQL by its URL. Nothing in it is ever changed or removed; each change
    is an event of a history with who and when, chained by hashes.

    \b
    Example: mwdcal registry --database tools.sqlite init
             mwdcal registry --database tools.sqlite add calibrations runs tool.toml
             mwdcal registry --database tools.sqlite list
    """
