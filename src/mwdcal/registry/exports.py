"""A registry as a folder of files: all documents by kind, the history as JSON lines, and a manifest."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import sqlalchemy as sa

from mwdcal.calibration.record import SOFTWARE
from mwdcal.errors import FitError, InputError, reason
from mwdcal.files.formats import atomic
from mwdcal.files.formats.atomic import file_name, whole
from mwdcal.registry.checking import check
from mwdcal.registry.database import migrating, schema
from mwdcal.registry.database.connections import OBJECTS_AT_ONCE, ROWS_AT_ONCE, connect
from mwdcal.registry.database.models import history, metadata, objects, records, withdrawals
from mwdcal.registry.store import Registry, open_registry, person
from mwdcal.registry.stored import AlteredError, Stored, content_address, documents, with_objects

EXPORT_MANIFEST = "manifest.json"
"""Name of the file of an export that names all others."""
HISTORY = "history.jsonl"
"""Name of the file with the events, one a line."""
EXPORT_VERSION = 1
"""Version of the manifest: higher when a key goes, or changes its meaning."""


class ExportedFile(msgspec.Struct, frozen=True, kw_only=True):
    """A record of a registry and the file that an export has of it; `path` is below the manifest's folder.

    `reason`: why the record was withdrawn, if it was.
    """

    number: int
    path: str
    sha256: str
    kind: str
    name: str
    serial: str | None
    added: str
    actor: str
    reason: str | None = None


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of an export: `events` of the history, the newest with the hash `head`, and all files."""

    schema_version: int = EXPORT_VERSION
    command: str = "registry export"
    software: str = SOFTWARE
    simulated: bool
    events: int
    head: str
    history_sha256: str
    files: list[ExportedFile]


def export(
    registry: Registry, folder: Path, progress: Callable[[int, int], None] = lambda done, all: None
) -> Manifest:
    """Write all that a registry holds, in one state of it, into a new or empty folder: whole or not at all.

    Raises:
        AlteredError: a document is not what was added; nothing is written.
    """
    with whole(folder) as unfinished, registry.reading_documents() as connection:
        events, head = schema.head(connection)
        lines = _written_history(connection, registry.name, unfinished / HISTORY)
        files, simulated = [], False
        query = with_objects(withdrawals.c.reason).outerjoin(
            withdrawals, withdrawals.c.record == records.c.number
        )
        query = query.order_by(records.c.number)
        for document in documents(connection, registry.name, query):
            files.append(_written(document, unfinished))
            simulated = simulated or bool(document.record["simulated"])
            progress(document.record["number"], events)
        manifest = Manifest(
            simulated=simulated, events=events, head=head, history_sha256=lines, files=files
        )
        encoded = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
        (unfinished / EXPORT_MANIFEST).write_bytes(encoded + b"\n")
    return manifest


def _written(document: Stored, folder: Path) -> ExportedFile:
    """Write a document."""
    record, row = document.record, document.row
    name = Path(record["name"])
    stem, suffix = file_name(name.stem), file_name(name.suffix.removeprefix("."))
    path = Path(record["kind"], f"{stem}-{record['sha256'][:12]}.{suffix or 'json'}")
    (folder / record["kind"]).mkdir(exist_ok=True)
    (folder / path).write_bytes(document.data)
    return ExportedFile(
        path=path.as_posix(),
        added=row[history.c.time],
        actor=row[history.c.actor],
        reason=row[withdrawals.c.reason],
        **{name: record[name] for name in ("number", "sha256", "kind", "name", "serial")},
    )


def _written_history(connection: sa.Connection, name: str, path: Path) -> str:
    """Write the history; the SHA-256 of the file."""
    query, previous = sa.select(history).order_by(history.c.number), schema.GENESIS
    options = {"yield_per": ROWS_AT_ONCE}
    with (
        path.open("wb") as stream,
        closing(connection.execute(query, execution_options=options)) as result,
    ):
        for event in map(dict, result.mappings()):
            if not schema.follows(event, previous):
                raise AlteredError(
                    f"{name}: event {event['number']} of the history was changed after it was written, or the one "
                    "before"
                )
            stream.write(msgspec.json.encode(event) + b"\n")
            previous = event["hash"]
    return content_address(path.read_bytes())


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of an export in a folder; None if it is not a folder.

    Raises:
        InputError: the manifest is damaged, or names files outside of the folder.
    """
    path = folder / EXPORT_MANIFEST
    try:
        data = path.read_bytes()
        head = msgspec.json.decode(data, type=dict[str, Any]) if data else {}
        if head.get("command") != "registry export":
            return None
        manifest = msgspec.json.decode(data, type=Manifest)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}). Check its rights.") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: it is damaged ({error}). Export again.") from None
    for file in manifest.files:
        if not (folder / file.path).resolve().is_relative_to(folder.resolve()):
            raise InputError(
                f"{path}: it names {file.path!r}, outside of its folder. Export again."
            )
    return manifest


# --------------------------------------------------------------------------
# Backup and restore: all rows of one state of a registry into another, which must be empty.
#
# A backup is a registry in a SQLite file, whichever database it is of.

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
                _, head = schema.head(sink)
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
                _, head = schema.head(sink)
                schema.append_one(sink, who, "restore", "registry", head)
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
