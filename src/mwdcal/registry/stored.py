"""The one way of documents out of the database: each is, byte for byte, what the history says was added."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from contextlib import closing
from typing import Any, NamedTuple

import sqlalchemy as sa

from mwdcal.errors import FitError
from mwdcal.registry.database import chain
from mwdcal.registry.database.connections import OBJECTS_AT_ONCE
from mwdcal.registry.database.models import history, objects, records, tools, withdrawals
from mwdcal.registry.database.tools import TOOL_KINDS, rows_of
from mwdcal.registry.facts import content_address

LARGEST_OBJECT = 500_000_000
"""Bytes of the largest file that a registry takes."""
UNSUSPICIOUS, DENSEST = 50_000_000, 200
"""Bytes to which any object may unpack; a larger one to so many times what is stored, as no readings do."""
_next = history.alias("next")
_AFTER = (
    sa.select(_next.c.previous)
    .where(_next.c.number == records.c.number + 1)
    .scalar_subquery()
    .label("after")
)
Row = Mapping[str, Any]


class AlteredError(FitError):
    """A registry no longer holds what was added to it: `what` is wrong."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"{what}. Check the registry (mwdcal registry check), and restore it from a backup."
        )


class Stored(NamedTuple):
    """A document of a registry: its record, its bytes, and the row of the query that it came with."""

    record: dict[str, Any]
    data: bytes
    row: Any


def packed(data: bytes) -> bytes:
    """The bytes of an object as they are stored, of which `unpacked` makes the same again."""
    small = zlib.compress(data, 6)
    return zlib.compress(data, 0) if _is_dense(len(data), len(small)) else small


def _is_dense(size: int, stored: int) -> bool:
    return size > max(UNSUSPICIOUS, DENSEST * stored)


def unpacked(data: bytes, size: int, sha256: str, label: str = "a file") -> bytes:
    """An object's bytes from those stored, which have this size and SHA-256.

    Raises:
        AlteredError: they have not, or would unpack to more than memory bears.
    """
    unpacker, content = zlib.decompressobj(), None
    try:
        if 0 <= size <= LARGEST_OBJECT and not _is_dense(size, len(data)):
            content = unpacker.decompress(data, size + 1)
    except (zlib.error, TypeError, ValueError, OverflowError):
        pass
    if content is None or len(content) != size or not unpacker.eof or unpacker.unused_data:
        raise AlteredError(f"{label}: the bytes stored are damaged")
    if content_address(content) != sha256:
        raise AlteredError(f"{label}: the bytes stored are not those with the SHA-256 {sha256}")
    return content


def record_digest(record: Row, stored: Row | None) -> str:
    """The digest of a record, and of the object that came with it, whose bytes it covers as stored."""
    if stored is None:
        return chain.digest(record)
    as_stored = {**stored, "data": content_address(stored["data"])}
    return chain.digest({**record, "object": as_stored})


def with_objects(*more: sa.ColumnElement[Any]) -> sa.Select[Any]:
    """The query of records for `documents`; those whose object or event is missing are in it, to be refused."""
    return (
        sa.select(records, objects, history, _AFTER, *more)
        .outerjoin(objects, objects.c.sha256 == records.c.sha256)
        .outerjoin(history, history.c.number == records.c.number)
    )


def documents(connection: sa.Connection, name: str, query: sa.Select[Any]) -> Iterator[Stored]:
    """The documents of a query made of `with_objects`, in the registry of a name; a few in memory at once.

    Definition: of each the record, and the object that came with it, has the digest in its event; the event has its
    hash, which the next event repeats; the bytes have the size and the SHA-256 by which they are addressed.

    Raises:
        AlteredError: one of them is not what was added.
    """
    options = {"stream_results": True, "yield_per": OBJECTS_AT_ONCE}
    with closing(connection.execute(query, execution_options=options)) as result:
        for row in result.mappings():
            parts = (records, objects, history)
            record, stored, event = ({c.name: row[c] for c in part.columns} for part in parts)
            label = f"{name}: the {record['kind']} {record['name']!r} ({record['number']})"
            if not _is_as_added(record, stored, event, row["after"]):
                raise AlteredError(f"{label} was changed after it was added")
            data = unpacked(stored["data"], stored["size"], record["sha256"], label)
            yield Stored(record, data, row)


def _is_as_added(record: Row, stored: Row, event: Row, after: str | None) -> bool:
    """Whether a record is the one that its event tells of, and the event the one that the next follows."""
    brought = stored if stored["number"] == record["number"] else None
    try:
        return (
            event["row_sha256"] == record_digest(record, brought)
            and chain.follows(event, event["previous"])
            and after in (None, event["hash"])
        )
    except (TypeError, ValueError):  # no text or no number where one must be
        return False


def check_complete(connection: sa.Connection, name: str) -> None:
    """Refuse a registry in which a record, a withdrawal or a tool was removed, added or exchanged.

    What is selected rests on all of them: without a withdrawal another calibration would be the latest.

    Raises:
        AlteredError: rows and history do not fit together.
    """
    at, event = records.c, history.c
    subject = sa.func.coalesce(sa.func.nullif(at.serial, ""), sa.func.nullif(at.label, ""), at.name)
    odd = (
        sa.select(event.number)
        .outerjoin(records, at.number == event.number)
        .outerjoin(withdrawals, withdrawals.c.number == event.number)
        .where(event.row_sha256.is_not(None))
        .where(
            sa.or_(
                sa.and_(at.number.is_(None), withdrawals.c.number.is_(None)),
                *(at.kind != event.kind, at.sha256 != event.sha256, subject != event.subject),
            )
        )
        .limit(1)
    )
    number = connection.scalar(odd)
    if number is None:
        number = next(_changed_withdrawals(connection), None)
    if number is not None:
        raise AlteredError(
            f"{name}: what event {number} of the history added was changed or removed"
        )
    serials = sa.select(sa.func.count(at.serial.distinct())).where(at.kind.in_(TOOL_KINDS))
    if connection.scalar(serials) != connection.scalar(sa.select(sa.func.count(tools.c.serial))):
        raise AlteredError(
            f"{name}: the table of tools has more or fewer rows than there are tools"
        )


def _changed_withdrawals(connection: sa.Connection) -> Iterator[int]:
    """Numbers of withdrawals that no event tells of."""
    query = sa.select(withdrawals, history.c.row_sha256).outerjoin(
        history, history.c.number == withdrawals.c.number
    )
    for row in connection.execute(query).mappings():
        withdrawal = {column.name: row[column] for column in withdrawals.columns}
        try:
            sound = chain.digest(withdrawal) == row["row_sha256"]
        except (TypeError, ValueError):
            sound = False
        if not sound:
            yield row["number"]


def check_tool(connection: sa.Connection, name: str, serial: str) -> None:
    """Refuse a tool whose row in the table of tools is not what its records give.

    Raises:
        AlteredError: it is not.
    """
    row = connection.execute(sa.select(tools).where(tools.c.serial == serial)).mappings().first()
    expected = next(rows_of(connection, [serial]), None)
    if (row and dict(row)) != expected:
        raise AlteredError(f"{name}: the row of tool {serial!r} is not what its records give")
