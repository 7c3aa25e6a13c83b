"""Backup and restore: all rows of one state of a registry into another, which must be empty.

A backup is a registry in a SQLite file, whichever database it is of.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import sqlalchemy as sa

from mwdcal.errors import FitError, InputError
from mwdcal.files.formats import atomic
from mwdcal.registry.checking import check
from mwdcal.registry.database import chain, migrating
from mwdcal.registry.database.connections import OBJECTS_AT_ONCE, ROWS_AT_ONCE, connect
from mwdcal.registry.database.models import metadata, objects
from mwdcal.registry.store import Registry, open_registry, person

_OTHER = "Use another backup."


def backup(registry: Registry, path: str | os.PathLike[str]) -> str:
    """Write a backup while others go on writing; the hash of its newest event.

    The file appears whole or not at all. It holds every write that was acknowledged before the call. The registry
    is checked before, and the copy, before it replaces an older backup.

    Raises:
        FitError: the registry was altered, or the copy is not sound; what is at `path` stays.
        InputError: it cannot be written, or `path` is the registry itself.
    """
    file = registry.database.file
    if file and atomic.identity(Path(path)) == atomic.identity(file):
        raise InputError(f"`path` must not be the registry itself, '{path}'. Name another file.")
    kept = f"'{path}' was not written. Restore the registry from the last good backup."
    with atomic.replacing(path) as stream:
        _refuse_altered(registry, kept)
        target = replace(connect(stream.name, new=True, shared=False), name=str(path))
        try:
            with registry.reading() as source, target.writing() as sink:
                migrating.create_tables(sink, target.name)
                _copy(source, sink)
                _, head = chain.head(sink)
            _refuse_altered(Registry(target), kept)
        finally:
            target.engine.dispose()
    return head


def restore(path: str | os.PathLike[str], database: str | os.PathLike[str], actor: str) -> str:
    """Fill an empty database, or a new file, from a backup; the hash of the backup's newest event.

    The restoration is an event in the new history. Both are checked, the backup before.

    Raises:
        FitError: the backup was altered; nothing is restored.
        InputError: the database is not empty, or either cannot be opened.
    """
    who, target = person(actor), connect(database, new=True)
    try:
        with open_registry(path, shared=False) as source:
            _refuse_altered(source, _OTHER)
            with source.reading() as rows, target.writing() as sink:
                migrating.create_tables(sink, target.name)
                _copy(rows, sink)
                _, head = chain.head(sink)
                chain.append_one(sink, who, "restore", "registry", head)
        _refuse_altered(Registry(target), _OTHER)
    finally:
        target.engine.dispose()
    return head


def _copy(source: sa.Connection, sink: sa.Connection) -> None:
    for table in metadata.sorted_tables:
        portion = OBJECTS_AT_ONCE if table is objects else ROWS_AT_ONCE
        options = {"stream_results": True, "yield_per": portion}
        for rows in (
            source.execute(sa.select(table), execution_options=options).mappings().partitions()
        ):
            sink.execute(sa.insert(table), [dict(row) for row in rows])


def _refuse_altered(registry: Registry, advice: str) -> None:
    problems = check(registry)
    if problems:
        raise FitError(
            f"{registry.name}: it was altered or is damaged ({problems[0].text.rstrip('.')}). {advice}"
        )
