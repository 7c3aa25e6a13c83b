"""A registry as a folder of files: all documents by kind, the history as JSON lines, and a manifest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import sqlalchemy as sa

from mwdcal.calibration.record import SOFTWARE
from mwdcal.errors import InputError, reason
from mwdcal.files.formats.folders import file_name, whole
from mwdcal.registry.database import chain
from mwdcal.registry.database.models import history, objects, records, withdrawals
from mwdcal.registry.facts import content_address
from mwdcal.registry.store import Registry, unpacked

EXPORT_MANIFEST = "manifest.json"
"""Name of the file of an export that names all others."""
HISTORY = "history.jsonl"
"""Name of the file with the events, one a line."""
EXPORT_VERSION = 1
"""Version of the manifest: higher when a key goes, or changes its meaning."""
_RECORDS = 100


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
    """What an export holds: `events` of the history, the newest with the hash `head`, and all files."""

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
    """Write all that a registry holds, in one state of it, into a new or empty folder: whole or not at all."""
    with whole(folder) as unfinished, registry.reading() as connection:
        events, head = chain.head(connection)
        lines = _written_history(connection, unfinished / HISTORY)
        files, simulated = [], False
        for row in _rows(connection):
            files.append(_written(row, unfinished))
            simulated = simulated or bool(row.simulated)
            progress(row.number, events)
        manifest = Manifest(
            simulated=simulated, events=events, head=head, history_sha256=lines, files=files
        )
        encoded = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
        (unfinished / EXPORT_MANIFEST).write_bytes(encoded + b"\n")
    return manifest


def _rows(connection: sa.Connection) -> Iterator[Any]:
    """All records with their objects and events."""
    query = (
        sa.select(
            *(records.c[n] for n in ("number", "sha256", "kind", "name", "serial", "simulated")),
            *(objects.c.data, objects.c.size),
            *(history.c.time, history.c.actor, withdrawals.c.reason),
        )
        .join(objects, objects.c.sha256 == records.c.sha256)
        .join(history, history.c.number == records.c.number)
        .outerjoin(withdrawals, withdrawals.c.record == records.c.number)
        .order_by(records.c.number)
    )
    yield from connection.execute(query, execution_options={"yield_per": _RECORDS})


def _written(row: Any, folder: Path) -> ExportedFile:
    """Write the document of a record."""
    name = Path(row.name)
    stem, suffix = file_name(name.stem), file_name(name.suffix.removeprefix("."))
    path = Path(row.kind, f"{stem}-{row.sha256[:12]}.{suffix or 'json'}")
    (folder / row.kind).mkdir(exist_ok=True)
    (folder / path).write_bytes(unpacked(row.data, row.size))
    return ExportedFile(
        number=row.number,
        path=path.as_posix(),
        sha256=row.sha256,
        kind=row.kind,
        name=row.name,
        serial=row.serial,
        added=row.time,
        actor=row.actor,
        reason=row.reason,
    )


def _written_history(connection: sa.Connection, path: Path) -> str:
    """Write the history; the SHA-256 of the file."""
    query = sa.select(history).order_by(history.c.number)
    with path.open("wb") as stream:
        for row in connection.execute(query, execution_options={"yield_per": _RECORDS}).mappings():
            stream.write(msgspec.json.encode(dict(row)) + b"\n")
    return content_address(path.read_bytes())


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of an export in a folder; None where the folder is none.

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
