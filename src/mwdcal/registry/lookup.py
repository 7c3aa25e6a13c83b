"""Questions to a registry by a word: the tools, the past of one, a document by serial, hash or number."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from unicodedata import category, normalize

import msgspec
import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.members import MARK, Member
from mwdcal.registry.database.models import history, records, tools, withdrawals
from mwdcal.registry.store import Registry
from mwdcal.registry.stored import RECORD_KINDS, check_tool, documents, with_objects

# --------------------------------------------------------------------------
# Queries of lists and pages to a registry. Rows are mappings with the columns of `database.models`.

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
    """The record of a number, with the columns of `past`, or None."""
    with registry.reading() as connection:
        row = connection.execute(with_events().where(records.c.number == number)).mappings().first()
        return dict(row) if row else None


def numbered(registry: Registry, number: int) -> tuple[Row, bytes]:
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
    """The newest calibration of a tool by its time, and its file's bytes, or None.

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


MOST_COMPARED = 10_000
"""Most tools among whose serials a similar one is looked for."""
SHORTEST_HASH = 8
"""Digits of a SHA-256 that name a document, at least."""


class ListedTool(msgspec.Struct, frozen=True, kw_only=True):
    """A tool: its last calibration with its 1σ accuracy to expect, its next due date and last verdict."""

    serial: str
    type: str | None
    calibrated: str | None
    calibrations: int
    inclination_deg: float | None
    toolface_deg: float | None
    azimuth_deg: float | None
    next_due: str | None
    status: str | None
    simulated: bool


class ListedRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A document: what it is, of which tool and time, and who added it when.

    `reason`: why it was withdrawn, if it was.
    """

    number: int
    kind: str
    sha256: str
    name: str
    serial: str | None
    type: str | None
    label: str | None
    time: str | None
    next_due: str | None
    status: str | None
    simulated: bool
    added: str
    actor: str
    reason: str | None


class Listing(msgspec.Struct, frozen=True, kw_only=True):
    """A part of a list of `total` rows, from the one of number `offset` on: of tools, or of records."""

    kind: str
    total: int
    offset: int
    tools: list[ListedTool] = []
    records: list[ListedRecord] = []


def listed(
    registry: Registry, kind: str | None, search: str, due: str, offset: int, limit: int
) -> Listing:
    """Tools by serial, or records of a kind, newest first; `due`: what is due before that day, most overdue first.

    Raises:
        InputError: there is no such kind of records.
    """
    if kind not in (None, "tool", *RECORD_KINDS):
        kinds = ", ".join(["tool", *RECORD_KINDS])
        raise InputError(f"`kind` must be one of {kinds}; got {shown(kind)}. Correct it.")
    if kind in (None, "tool"):
        order = "next_due" if due else "serial"
        total, rows = tools_page(
            registry, search, due_before=due or None, order=order, offset=offset, limit=limit
        )
        standards = standards_due(registry, due) if due else []
        return Listing(
            kind="tool",
            total=total,
            offset=offset,
            tools=[_tool(r) for r in rows],
            records=standards,
        )
    if due and kind == "standard":
        standards = standards_due(registry, due)
        some = standards[offset : offset + limit]
        return Listing(kind=kind, total=len(standards), offset=offset, records=some)
    if due or search:
        raise InputError("`due` and `search` are for tools, `due` for standards too. Leave it out.")
    total, rows = records_page(registry, str(kind), offset=offset, limit=limit)
    return Listing(kind=str(kind), total=total, offset=offset, records=[_record(r) for r in rows])


def standards_due(registry: Registry, due: str) -> list[ListedRecord]:
    """Measurement standards whose last certificate is due before a day, most overdue first."""
    at = records.c
    with registry.reading() as connection:
        query = with_events().where(at.kind == "standard").order_by(at.next_due, at.number)
        rows = [dict(row) for row in connection.execute(query).mappings()]
    last = {(r["type"], r["label"], r["serial"]): r for r in rows if r["withdrawn"] is None}
    return sorted(
        (_record(row) for row in last.values() if row["next_due"] and row["next_due"] < due),
        key=lambda row: row.next_due or "",
    )


def past_of(registry: Registry, serial: str, offset: int, limit: int) -> Listing:
    """The records of a serial, in the order in which they were added.

    Raises:
        InputError: there are none.
    """
    total, rows = past(registry, serial, offset, limit)
    if not total:
        raise _unknown(registry, serial)
    return Listing(kind="", total=total, offset=offset, records=[_record(r) for r in rows])


def document(registry: Registry, word: str) -> tuple[Row, bytes]:
    """The latest calibration of the tool whose serial is a word, or the document that the word names.

    Raises:
        InputError: there is none.
        AlteredError: it is not what was added.
    """
    latest = latest_calibration(registry, word)
    if latest:
        return latest
    if not _names_record(word):
        raise _unknown(registry, word)
    return numbered(registry, one_record(registry, word)["number"])


def latest_file(registry: Registry, serial: str | None) -> Member:
    """The file of the latest calibration of a tool, of the only one where no serial is given.

    Raises:
        InputError: there is none, or there are several tools to choose from.
    """
    if serial is None:
        total, rows = tools_page(registry, limit=1)
        if total != 1:
            example = f", such as '{registry.name}{MARK}{rows[0]['serial']}'" if rows else ""
            raise InputError(
                f"{registry.name} has {total} tools. Name one of them behind a {MARK}{example}."
            )
        serial = str(rows[0]["serial"])
    latest = latest_calibration(registry, serial)
    if latest is None:
        raise _unknown(registry, serial)
    row, data = latest
    return Member(data, f"{Path(registry.name).name}{MARK}{serial}", str(row["sha256"]))


def one_record(registry: Registry, word: str) -> Row:
    """The record of a number, or the only one whose SHA-256 begins with a word.

    Raises:
        InputError: there is none, or several.
    """
    if not _names_record(word):
        raise InputError(
            f"`record` must be a number, or at least {SHORTEST_HASH} digits of a SHA-256; got {shown(word)}."
        )
    row = record(registry, int(word)) if _is_number(word) else None
    if row:
        return row
    with registry.reading() as connection:
        at = records.c.sha256
        query = with_events().where(at >= word.lower(), at < word.lower() + "g").limit(2)
        rows = connection.execute(query).mappings().all()
    if len(rows) != 1:
        number = "several records" if rows else "no record"
        raise InputError(f"{registry.name} has {number} {shown(word)}. Write more of the SHA-256.")
    return dict(rows[0])


def _names_record(word: str) -> bool:
    return _is_number(word) or bool(re.fullmatch(rf"[0-9a-fA-F]{{{SHORTEST_HASH},64}}", word))


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[0-9]{1,9}", word) is not None


def _unknown(registry: Registry, serial: str) -> InputError:
    """That there is no calibration of a tool, and which tools have similar serials."""
    _, rows = tools_page(registry, limit=MOST_COMPARED)
    near = get_close_matches(serial, [str(row["serial"]) for row in rows])
    meant = f" Is it {' or '.join(map(shown, near))}?" if near else ""
    return InputError(
        f"{registry.name} has no tool {shown(serial)} with a calibration.{meant} Correct the serial."
    )


def alike(registry: Registry, serials: Collection[str]) -> list[list[str]]:
    """Serials of different tools that differ in case, spaces or the form of characters alone, one of `serials` each."""
    meant = {_spelling(serial) for serial in serials}
    groups: dict[str, list[str]] = {}
    if meant:
        with registry.reading() as connection:
            for serial in connection.scalars(sa.select(tools.c.serial).order_by(tools.c.serial)):
                if (spelling := _spelling(serial)) in meant:
                    groups.setdefault(spelling, []).append(serial)
    return [group for group in groups.values() if len(group) > 1]


def _spelling(serial: str) -> str:
    """The common part of the ways in which people write a serial."""
    if serial.isascii():
        return "".join(serial.casefold().split())
    characters = normalize("NFKC", serial).casefold()
    return "".join("-" if category(c) == "Pd" else c for c in characters if not c.isspace())


def _tool(row: Row) -> ListedTool:
    return ListedTool(**_fields(ListedTool, row))


def _record(row: Row) -> ListedRecord:
    return ListedRecord(**_fields(ListedRecord, row))


def _fields(struct: type[msgspec.Struct], row: Row) -> dict[str, Any]:
    """The columns of a row that are fields of a struct."""
    fields = {name: row[name] for name in struct.__struct_fields__}
    return {**fields, "simulated": bool(row["simulated"])}
