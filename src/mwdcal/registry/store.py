"""`Registry`: documents into the database, in transactions that are durable or without effect."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from getpass import getuser
from typing import Any, NamedTuple

import msgspec
import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry.database import migrating, schema
from mwdcal.registry.database.connections import Database, connect
from mwdcal.registry.database.models import objects, records, withdrawals
from mwdcal.registry.database.schema import (
    SCHEMA_VERSION_OF_REGISTRY,
    TOOL_KINDS,
    portions,
    refresh,
)
from mwdcal.registry.stored import (
    FACTS_VERSION,
    LARGEST_OBJECT,
    LONGEST_NAME,
    Stored,
    check_complete,
    content_address,
    documents,
    facts,
    packed,
    plain,
    record_digest,
    with_objects,
)

# --------------------------------------------------------------------------
# Who acts, where nobody says it.


def system_user() -> str:
    """The name under which the user is known to the system, or empty."""
    with suppress(KeyError, OSError, ImportError):
        return getuser()
    return ""


# --------------------------------------------------------------------------
# Creation of a registry, and the change of its schema from version to version.


def create(database: str | os.PathLike[str], actor: str) -> None:
    """Create a registry in a new file, or in an empty database by its URL.

    Raises:
        InputError: it exists already, or cannot be created.
    """
    who, target = person(actor), connect(database, new=True)
    try:
        migrating.initialise(target, who)
    finally:
        target.engine.dispose()


def upgrade(database: str | os.PathLike[str], actor: str) -> tuple[str, str]:
    """Bring the schema of a registry to this program's version; from which to which."""
    return move_to(database, SCHEMA_VERSION_OF_REGISTRY, actor)


def move_to(database: str | os.PathLike[str], target: str, actor: str) -> tuple[str, str]:
    """Bring the schema of a registry to a version, up or down; from which to which."""
    who, place = person(actor), connect(database)
    try:
        return migrating.change(place, target, who)
    finally:
        place.engine.dispose()


Draft = dict[str, Any]
"""The rows inserted for an entry: see `draft`."""


class Entry(NamedTuple):
    """A file for the registry: its kind, its bytes as they are, and its name.

    `serial` is that of the tool, where the file itself does not state it.
    """

    kind: str
    data: bytes
    name: str
    serial: str | None = None


class Added(NamedTuple):
    """The outcome for an entry: the record of it, and whether it is new."""

    number: int
    kind: str
    sha256: str
    serial: str | None
    new: bool


class Registry:
    """An open registry. Each call of a method is one transaction; several threads may share one."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self._complete = False

    @property
    def name(self) -> str:
        """Its name in messages: its file, or its URL without password."""
        return self.database.name

    @contextlib.contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A transaction that sees one state of the registry."""
        with self.database.reading() as connection:
            schema.check_version(connection, self.name)
            yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """A transaction of the only writer, durable when the block ends."""
        with self.database.writing() as connection:
            schema.check_version(connection, self.name)
            yield connection

    def add(
        self, entries: Iterable[Entry], actor: str, when: datetime | None = None
    ) -> list[Added]:
        """Add files, all or none; what is there already is not added again.

        `actor` is who adds them, `when` the time that the history states: now, if None. The result of
        the call is on the disk. The files, compressed, are in memory at once. Where the connection breaks
        during the call, nobody can know whether it took effect: add the same again.

        Raises:
            InputError: a file is not of its kind, its serial is another than the entry's, or the
                database refuses.
        """
        return self.insert([rows_to_insert(entry) for entry in entries], actor, when)

    def insert(
        self,
        drafts: Sequence[Draft],
        actor: str,
        when: datetime | None = None,
        reasons: Sequence[str | None] = (),
    ) -> list[Added]:
        """The same with the drafts of entries, which other processes may have made.

        `reasons`: of each that is withdrawn at once if it is new, why.
        """
        who, time = person(actor), schema.instant(when)
        with self.writing() as connection:
            result = _insert(connection, drafts, who, time)
            for each, why in zip(result, reasons, strict=False):
                if each.new and why:
                    _withdraw(connection, self.name, each.number, plain(why), who, time)
            return result

    def withdraw(self, number: int, reason: str, actor: str, when: datetime | None = None) -> None:
        """Mark a record as withdrawn for a reason; it stays, and lists no longer count it.

        Raises:
            InputError: there is no such record, or it is withdrawn already.
        """
        who, why, time = person(actor), plain(reason).strip(), schema.instant(when)
        if not why:
            raise InputError("`reason` must not be empty. Say why the record is withdrawn.")
        with self.writing() as connection:
            _withdraw(connection, self.name, number, why, who, time)

    @contextlib.contextmanager
    def reading_documents(self) -> Iterator[sa.Connection]:
        """The same, for documents: the first time it is checked that no row is missing by which they are selected.

        Raises:
            AlteredError: rows and history do not fit together.
        """
        with self.reading() as connection:
            if not self._complete:
                check_complete(connection, self.name)
                self._complete = True
            yield connection

    def documents(self, query: sa.Select[Any]) -> Iterator[Stored]:
        """The documents of a query made of `stored.with_objects`, as they were added.

        Raises:
            AlteredError: one of them is not what was added.
        """
        with self.reading_documents() as connection:
            yield from documents(connection, self.name, query)

    def content(self, sha256: str) -> bytes:
        """The bytes of an object, as they were added.

        Raises:
            InputError: there is no such object.
            AlteredError: it is not what was added.
        """
        query = with_objects().where(records.c.sha256 == sha256).order_by(records.c.number)
        for stored in self.documents(query.limit(1)):
            return stored.data
        raise InputError(f"{self.name}: there is no object {sha256}. Check the SHA-256.")

    def head(self) -> tuple[int, str]:
        """Number and hash of the newest event of the history."""
        with self.reading() as connection:
            return schema.head(connection)


def person(actor: str) -> str:
    """The name of who acts, as the history states it."""
    name = " ".join(plain(actor).split())
    if not name or len(name) > LONGEST_NAME:
        raise InputError(
            f"`actor` must be a name of 1 to {LONGEST_NAME} characters; got {len(name)}. Say who acts."
        )
    return name


def rows_to_insert(entry: Entry) -> Draft:
    """The rows of an entry, without their number: columns of a record, and `object`."""
    if len(entry.data) > LARGEST_OBJECT:
        raise InputError(
            f"{entry.name}: a registry takes files of at most {LARGEST_OBJECT:,} bytes; got "
            f"{len(entry.data):,}. Split the file."
        )
    about = facts(entry.kind, entry.data, entry.name)
    serial = plain(entry.serial) if entry.serial else None
    if serial and about.serial and serial != about.serial:
        raise InputError(
            f"{entry.name}: it is of the tool {about.serial!r}, not {serial!r}. Correct `serial`."
        )
    address = content_address(entry.data)
    stored = {"sha256": address, "size": len(entry.data), "data": packed(entry.data)}
    return {
        "kind": entry.kind,
        "sha256": address,
        "name": plain(entry.name)[-LONGEST_NAME:],
        **msgspec.structs.asdict(about),
        "serial": about.serial or serial,
        "facts_version": FACTS_VERSION,
        "object": stored,
    }


def _insert(connection: sa.Connection, drafts: Sequence[Draft], who: str, time: str) -> list[Added]:
    """Insert what is new, with its events; what became of each."""
    known = _known(connection, [rows_to_insert["sha256"] for rows_to_insert in drafts])
    stored = {sha256 for sha256, _ in known}
    number, previous = schema.head(connection)
    rows, packed, events, result = [], [], [], []
    for rows_to_insert in drafts:
        row = {name: value for name, value in rows_to_insert.items() if name != "object"}
        key = (row["sha256"], row["kind"])
        new = key not in known
        if new:
            number += 1
            known[key] = (number, row["serial"])
            row["number"] = number
            object_row = (
                None if row["sha256"] in stored else {"number": number, **rows_to_insert["object"]}
            )
            if object_row:
                packed.append(object_row)
                stored.add(row["sha256"])
            rows.append(row)
            events.append(_event(row, row, who, time, "add", record_digest(row, object_row)))
        at, serial = known[key]
        result.append(Added(at, row["kind"], row["sha256"], serial, new))
    for table, values in ((objects, packed), (records, rows)):
        if values:
            connection.execute(sa.insert(table), values)
    schema.append(connection, previous, events)
    _refresh_tools(connection, rows)
    return result


def _withdraw(
    connection: sa.Connection, name: str, number: int, why: str, who: str, time: str
) -> None:
    """Mark a record as withdrawn, with its event."""
    record = connection.execute(sa.select(records).where(records.c.number == number)).one_or_none()
    if record is None:
        raise InputError(f"{name}: there is no record {number}. Check the number.")
    before = sa.select(withdrawals.c.number).where(withdrawals.c.record == number)
    if connection.scalar(before) is not None:
        raise InputError(f"{name}: record {number} is withdrawn already.")
    newest, previous = schema.head(connection)
    row = {"number": newest + 1, "record": number, "reason": why}
    connection.execute(sa.insert(withdrawals), row)
    event = _event(row, record._mapping, who, time, "withdraw", schema.digest(row))
    schema.append(connection, previous, [event])
    _refresh_tools(connection, [record._mapping])


def _known(
    connection: sa.Connection, addresses: Sequence[str]
) -> dict[tuple[str, str], tuple[int, str | None]]:
    """Number and serial of the records there are, by SHA-256 and kind."""
    at = records.c
    query = sa.select(at.sha256, at.kind, at.number, at.serial)
    return {
        (row.sha256, row.kind): (row.number, row.serial)
        for portion in portions(addresses)
        for row in connection.execute(query.where(at.sha256.in_(portion)))
    }


def _event(row: Any, record: Any, who: str, time: str, action: str, digest: str) -> dict[str, Any]:
    return {
        "number": row["number"],
        "time": time,
        "actor": who,
        "action": action,
        "kind": record["kind"],
        "subject": record["serial"] or record["label"] or record["name"],
        "sha256": record["sha256"],
        "row_sha256": digest,
    }


def _refresh_tools(connection: sa.Connection, rows: Iterable[Any]) -> None:
    refresh(
        connection, {row["serial"] for row in rows if row["serial"] and row["kind"] in TOOL_KINDS}
    )


@contextlib.contextmanager
def open_registry(database: str | os.PathLike[str], shared: bool = True) -> Iterator[Registry]:
    """A registry by the path of its file or its URL, closed when the block ends.

    Not `shared`: a file that nobody writes to, as a backup, which may be on a network drive.

    Raises:
        InputError: there is none, it is not a registry, or its schema is older or newer than this program's.
    """
    target = connect(database, shared=shared)
    try:
        with target.reading() as connection:
            schema.known_version(connection, target.name)
            schema.check_version(connection, target.name)
        yield Registry(target)
    finally:
        target.engine.dispose()
