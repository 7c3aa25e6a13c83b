"""Queries of lists and pages to a registry. Rows are mappings with the columns of `database.models`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple
from unicodedata import normalize

import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry.database.models import history, records, tools, withdrawals
from mwdcal.registry.store import Registry
from mwdcal.registry.stored import check_tool, documents, with_objects

Row = Mapping[str, Any]
_LETTERS = 0x1F000
"""Characters below which all are that have capitals."""
TOOL_ORDERS = ("serial", "type", "next_due", "calibrated")
"""Columns by which tools can be sorted."""


class Page(NamedTuple):
    """A part of a list, and how many rows the whole has."""

    total: int
    rows: list[Row]


def tools_page(
    registry: Registry,
    search: str = "",
    where: Mapping[str, object] | None = None,
    due_before: str | None = None,
    order: str = "serial",
    descending: bool = False,
    offset: int = 0,
    limit: int = 50,
) -> Page:
    """Tools whose serial or type contains `search`, whose columns equal `where`, due before a date.

    Columns: those of `tools`. Rows without a value in the column `order` come last.
    """
    query = sa.select(tools.c.serial)
    if search:
        query = query.where(_contains(search))
    for name, value in (where or {}).items():
        query = query.where(tools.c[name] == value)
    if due_before:
        query = query.where(tools.c.next_due < due_before)
    by = tools.c[order]
    keys = [by.desc() if descending else by.asc(), tools.c.serial]
    keys = [by.is_(None), *keys] if by.nullable else keys
    part = query.order_by(*keys).offset(offset).limit(limit).subquery()
    rows = sa.select(tools).join(part, part.c.serial == tools.c.serial).order_by(*keys)
    return _page(registry, query, rows)


def _contains(text: str) -> sa.ColumnElement[bool]:
    """Whether a text is in serial or type of a tool, whatever the case and the form of its letters.

    The variants of each letter are named: what a database takes for the same letter depends on its locale.
    """
    both = tools.c.serial + "\n" + sa.func.coalesce(tools.c.type, "")
    return both.regexp_match("".join(map(_any_case, normalize("NFC", text))))


def _any_case(letter: str) -> str:
    """A regular expression for a letter, large or small, composed or not."""
    folded = letter.casefold()
    more = [] if letter.isascii() else _of_same_case().get(folded, [])
    twins = {folded, folded.upper(), *more}
    forms = sorted({re.escape(normalize(f, twin)) for twin in twins for f in ("NFC", "NFD")})
    return forms[0] if len(forms) == 1 else f"(?:{'|'.join(forms)})"


@cache
def _of_same_case() -> dict[str, list[str]]:
    """All characters by that which they are in small letters."""
    twins: dict[str, list[str]] = {}
    for letter in map(chr, range(_LETTERS)):
        twins.setdefault(letter.casefold(), []).append(letter)
    return twins


def _page(registry: Registry, whole: sa.Select[Any], part: sa.Select[Any]) -> Page:
    """The rows of a part, and how many the whole has.

    A part is sorted by its keys alone, and the rows are joined to it: databases sort wide rows slowly.
    """
    with registry.reading() as connection:
        rows = connection.execute(part).mappings().all()
        return Page(_count(connection, whole), [dict(row) for row in rows])


def _count(connection: sa.Connection, query: sa.Select[Any]) -> int:
    return connection.scalar(sa.select(sa.func.count()).select_from(query.subquery())) or 0


def with_events() -> sa.Select[Any]:
    """Records with who added them when (`added`, `actor`), and why they were withdrawn, if they were."""
    return (
        sa.select(
            records,
            history.c.time.label("added"),
            history.c.actor,
            withdrawals.c.number.label("withdrawn"),
            withdrawals.c.reason,
        )
        .join(history, history.c.number == records.c.number)
        .outerjoin(withdrawals, withdrawals.c.record == records.c.number)
    )


def past(registry: Registry, serial: str, offset: int = 0, limit: int = 200) -> Page:
    """All records of a serial in the order in which they were added.

    Columns: those of `records`, with `added` (time), `actor`, `withdrawn` (number of that event) and `reason`.
    """
    query = sa.select(records.c.number).where(records.c.serial == serial)
    return _records_page(registry, query, [records.c.number], offset, limit)


def records_page(
    registry: Registry,
    kind: str,
    where: Mapping[str, object] | None = None,
    newest_first: bool = True,
    offset: int = 0,
    limit: int = 50,
) -> Page:
    """Records of a kind whose columns equal `where`, in order of the time they state; columns as of `past`.

    A list in `where` holds the values that a column may have.
    """
    query = sa.select(records.c.number).where(records.c.kind == kind)
    for name, value in (where or {}).items():
        column = records.c[name]
        query = query.where(column.in_(value) if isinstance(value, list) else column == value)
    keys = [records.c.time, records.c.number]
    order = [key.desc() if newest_first else key for key in keys]
    return _records_page(registry, query, order, offset, limit)


def _records_page(
    registry: Registry, query: sa.Select[Any], order: list[Any], offset: int, limit: int
) -> Page:
    """A part of the records whose numbers a query gives."""
    part = query.order_by(*order).offset(offset).limit(limit).subquery()
    rows = with_events().join(part, part.c.number == records.c.number).order_by(*order)
    return _page(registry, query, rows)


def record(registry: Registry, number: int) -> Row | None:
    """The record of a number, with the columns of `past`; None where there is none."""
    with registry.reading() as connection:
        row = connection.execute(with_events().where(records.c.number == number)).mappings().first()
        return dict(row) if row else None


def document(registry: Registry, number: int) -> tuple[Row, bytes]:
    """The record of a number and its file's bytes.

    Raises:
        InputError: there is no such record.
        AlteredError: it is not what was added.
    """
    for stored in registry.documents(with_objects().where(records.c.number == number)):
        return stored.record, stored.data
    raise InputError(f"{registry.name}: there is no record {number}. Check the number.")


def calibrations(registry: Registry, *serials: str) -> Iterator[tuple[Row, bytes]]:
    """The calibrations of some tools that were not withdrawn, oldest first, each with its file's bytes.

    Raises:
        AlteredError: one of them is not what was added.
    """
    query = _calibrations_of(*serials).where(withdrawals.c.number.is_(None))
    return ((stored.record, stored.data) for stored in registry.documents(query))


def _calibrations_of(*serials: str) -> sa.Select[Any]:
    """All calibrations of some tools, oldest first."""
    return (
        with_objects()
        .outerjoin(withdrawals, withdrawals.c.record == records.c.number)
        .where(records.c.serial.in_(serials), records.c.kind == "calibration")
        .order_by(records.c.time, records.c.number)
    )


def latest_calibration(registry: Registry, serial: str) -> tuple[Row, bytes] | None:
    """The newest calibration of a tool by its time, and its file's bytes; None where there is none.

    Raises:
        AlteredError: it, or a calibration that it was chosen from, is not what was added.
    """
    latest = sa.select(tools.c.latest).where(tools.c.serial == serial)
    result = None
    with registry.reading_documents() as connection:
        check_tool(connection, registry.name, serial)
        number = connection.scalar(latest)
        for stored in documents(connection, registry.name, _calibrations_of(serial)):
            if stored.record["number"] == number:
                result = stored.record, stored.data
    return result


def events(registry: Registry, offset: int = 0, limit: int = 50) -> Page:
    """Events of the history, newest first; columns: those of `history`. Their numbers have no gap."""
    newest = sa.select(sa.func.max(history.c.number))
    with registry.reading() as connection:
        total = connection.scalar(newest) or 0
        part = sa.select(history).where(history.c.number <= total - offset)
        rows = connection.execute(part.order_by(history.c.number.desc()).limit(limit)).mappings()
        return Page(total, [dict(row) for row in rows])


def counts(registry: Registry) -> dict[str, int]:
    """How many records there are of each kind, and how many `tools`, `events` and `withdrawals`."""
    kinds = sa.select(records.c.kind, sa.func.count()).group_by(records.c.kind)
    rest = {
        "tools": sa.select(sa.func.count()).select_from(tools),
        "events": sa.select(sa.func.max(history.c.number)),
        "withdrawals": sa.select(sa.func.count()).select_from(withdrawals),
    }
    with registry.reading() as connection:
        result = {row[0]: int(row[1]) for row in connection.execute(kinds)}
        return result | {name: connection.scalar(query) or 0 for name, query in rest.items()}
