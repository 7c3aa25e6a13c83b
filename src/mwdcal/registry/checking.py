"""Check of a registry: whether anything in it was changed, removed or added beside the program.

Everything is read once, in order of its number, with a few hundred rows in memory at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry.database import migrating, schema
from mwdcal.registry.database.connections import OBJECTS_AT_ONCE, ROWS_AT_ONCE
from mwdcal.registry.database.models import history, objects, records, tools, withdrawals
from mwdcal.registry.database.schema import TOOL_KINDS, rows_of
from mwdcal.registry.store import Registry
from mwdcal.registry.stored import FACTS_VERSION, AlteredError, facts, record_digest, unpacked

MOST_DISCREPANCIES = 1000
"""Discrepancies after which a check stops."""


Row = Mapping[str, Any]


class Discrepancy(NamedTuple):
    """Something in a registry that the program did not write: an id for machines, a sentence for people.

    `number` is that of the event or the record, where there is one.
    """

    id: str
    text: str
    number: int | None = None


Progress = Callable[[int, int], None]
"""Called with the number of events that are checked, and that of all."""


def check(
    registry: Registry, head: str | None = None, progress: Progress | None = None
) -> list[Discrepancy]:
    """All discrepancies of a registry, at most `MOST_DISCREPANCIES`; none where it is sound.

    `head` is the hash of an event that must be in the history, as a backup or an earlier check stated
    it: without it nobody can tell that the newest events were removed together with their rows.
    """
    result: list[Discrepancy] = []
    try:
        with registry.reading() as connection:
            for each in _all(connection, head, progress or (lambda done, total: None)):
                result.append(each)
                if len(result) == MOST_DISCREPANCIES:
                    break
    except InputError as error:
        result.append(Discrepancy("unreadable", str(error)))
    except TypeError:
        text = "a value is not of the type that the program writes, and nothing after it can be compared"
        result.append(Discrepancy("unreadable", text))
    return result


def _all(connection: sa.Connection, head: str | None, progress: Progress) -> Iterator[Discrepancy]:
    for text in migrating.differences(connection):
        yield Discrepancy("schema", text)
    yield from _events(connection, progress)
    yield from _tools(connection)
    if head and not connection.scalar(sa.select(sa.exists().where(history.c.hash == head))):
        yield Discrepancy(
            "head", f"no event has the hash {head}: the end of the history was removed or replaced"
        )


class _Rows:
    """The rows of a table in order of their numbers, to be taken one by one."""

    def __init__(
        self, connection: sa.Connection, table: sa.Table, portion: int = ROWS_AT_ONCE
    ) -> None:
        self.name = table.name
        options = {"stream_results": True, "yield_per": portion}
        query = sa.select(table).order_by(table.c.number)
        self._rows = iter(connection.execute(query, execution_options=options).mappings())
        self._next = next(self._rows, None)

    def of(self, number: int) -> Row | None:
        """The row of an event, or None."""
        row = self._next
        if row is None or row["number"] != number:
            return None
        self._next = next(self._rows, None)
        return dict(row)

    def before(self, number: float) -> Iterator[Discrepancy]:
        """A discrepancy for each row that is left with a smaller number: no event has it."""
        while self._next is not None and not self._next["number"] >= number:
            at = self._next["number"]
            yield Discrepancy(
                "row-without-event", f"{self.name} {at}: no event of the history made it", at
            )
            self._next = next(self._rows, None)


def _events(connection: sa.Connection, progress: Progress) -> Iterator[Discrepancy]:
    """The chain, and every row against the event that made it."""
    total = connection.scalar(sa.select(sa.func.count()).select_from(history)) or 0
    rows = [
        _Rows(connection, records),
        _Rows(connection, withdrawals),
        _Rows(connection, objects, OBJECTS_AT_ONCE),
    ]
    before = (0, schema.GENESIS)
    options = {"stream_results": True, "yield_per": ROWS_AT_ONCE}
    query = sa.select(history).order_by(history.c.number)
    for done, row in enumerate(connection.execute(query, execution_options=options).mappings()):
        event = dict(row)
        yield from _link(event, before)
        for each in rows:
            yield from each.before(event["number"])
        record, withdrawal, stored = (each.of(event["number"]) for each in rows)
        yield from _row(event, record, withdrawal, stored)
        yield from _content(connection, record, stored)
        before = (event["number"], event["hash"])
        if done % ROWS_AT_ONCE == 0:
            progress(done, total)
    for each in rows:
        yield from each.before(math.inf)
    if not total:
        yield Discrepancy("history", "the history is empty")
    progress(total, total)


def _link(event: Row, before: tuple[int, str]) -> Iterator[Discrepancy]:
    """An event by itself, and after the one before."""
    number = event["number"]
    if number != before[0] + 1:
        yield Discrepancy("numbers", f"events between {before[0]} and {number} are missing", number)
    if event["previous"] != before[1]:
        yield Discrepancy("chain", f"event {number}: the chain is broken before it", number)
    if _digest(event, "hash") != event["hash"]:
        yield Discrepancy("event", f"event {number} was changed after it was written", number)


def _digest(row: Row, without: str = "") -> str | None:
    """The digest of a row; None where its values are no text and numbers."""
    try:
        return schema.digest({name: value for name, value in row.items() if name != without})
    except (TypeError, ValueError):
        return None


def _row(
    event: Row,
    record: Row | None,
    withdrawal: Row | None,
    stored: Row | None,
) -> Iterator[Discrepancy]:
    """The rows that have the number of an event against the digest in it."""
    number, expected = event["number"], event["row_sha256"]
    digest: str | None = None
    try:
        if record is not None:
            digest = record_digest(record, stored)
        elif withdrawal is not None:
            digest = schema.digest(withdrawal)
    except (TypeError, ValueError):
        digest = "of no JSON"
    surplus = withdrawal is not None if record is not None else stored is not None
    if digest is None and expected is not None:
        text = f"the {event['kind']} of event {number} ({event['subject']}) was removed"
        yield Discrepancy("row-missing", text, number)
    elif digest != expected or surplus:
        text = f"the {event['kind']} of event {number} ({event['subject']}) was changed after it was written"
        yield Discrepancy("row", text, number)


def _content(
    connection: sa.Connection, record: Row | None, stored: Row | None
) -> Iterator[Discrepancy]:
    """The bytes of a record against their address, and its facts against those read from them again."""
    if record is None:
        return
    if stored is None:
        query = sa.select(objects).where(objects.c.sha256 == record["sha256"])
        row = connection.execute(query).mappings().one_or_none()
        stored = dict(row) if row else None
    number, label = (
        record["number"],
        f"the {record['kind']} {record['name']!r} ({record['number']})",
    )
    data = _bytes_of(record, stored)
    if data is None:
        text = f"{label}: the bytes stored are not those with the SHA-256 {record['sha256']}"
        yield Discrepancy("object", text, number)
    elif record["facts_version"] == FACTS_VERSION:
        odd = _other_facts(record, data)
        if odd:
            yield Discrepancy(
                "facts", f"{label}: its file says otherwise of {', '.join(odd)}", number
            )


def _bytes_of(record: Row, stored: Row | None) -> bytes | None:
    """The bytes of a record; None where they are not those that it is addressed by."""
    if stored is None or stored["sha256"] != record["sha256"]:
        return None
    try:
        return unpacked(stored["data"], stored["size"], stored["sha256"])
    except AlteredError:
        return None


def _other_facts(record: Row, data: bytes) -> list[str]:
    """Columns of a record that differ from the facts read from its bytes."""
    try:
        again = msgspec.structs.asdict(facts(record["kind"], data, record["name"]))
    except (InputError, TypeError):
        return ["its kind"]
    if again["serial"] is None:
        del again["serial"]  # stated by who added it
    return [n for n, value in again.items() if not _same(value, record[n])]


def _same(one: object, two: object) -> bool:
    return type(one) is type(two) and one == two


def _tools(connection: sa.Connection) -> Iterator[Discrepancy]:
    """The table of tools against the records that it is computed from."""
    counted = 0
    query = sa.select(tools).order_by(tools.c.serial)
    options = {"stream_results": True, "yield_per": ROWS_AT_ONCE}
    for portion in connection.execute(query, execution_options=options).mappings().partitions():
        expected = {
            row["serial"]: row for row in rows_of(connection, [t["serial"] for t in portion])
        }
        for row in map(dict, portion):
            serial = row["serial"]
            if serial not in expected or _digest(row) != _digest(expected[serial]):
                yield Discrepancy(
                    "tools", f"the row of tool {serial!r} is not what its records give"
                )
        counted += len(portion)
    at = records.c
    serials = sa.select(sa.func.count(at.serial.distinct())).where(at.kind.in_(TOOL_KINDS))
    if connection.scalar(serials) != counted:
        yield Discrepancy("tools", "the table of tools has more or fewer rows than there are tools")
