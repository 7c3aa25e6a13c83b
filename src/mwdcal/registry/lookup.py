"""Questions to a registry by a word: the tools, the past of one, a document by serial, hash or number."""

from __future__ import annotations

import re
from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path
from typing import Any
from unicodedata import category, normalize

import msgspec
import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.members import MARK, Member
from mwdcal.registry import queries
from mwdcal.registry.database.models import records, tools
from mwdcal.registry.facts import RECORD_KINDS
from mwdcal.registry.queries import Row
from mwdcal.registry.store import Registry

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
        total, rows = queries.tools_page(
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
    total, rows = queries.records_page(registry, str(kind), offset=offset, limit=limit)
    return Listing(kind=str(kind), total=total, offset=offset, records=[_record(r) for r in rows])


def standards_due(registry: Registry, due: str) -> list[ListedRecord]:
    """Measurement standards whose last certificate is due before a day, most overdue first."""
    at = records.c
    with registry.reading() as connection:
        query = queries.with_events().where(at.kind == "standard").order_by(at.next_due, at.number)
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
    total, rows = queries.past(registry, serial, offset, limit)
    if not total:
        raise _unknown(registry, serial)
    return Listing(kind="", total=total, offset=offset, records=[_record(r) for r in rows])


def document(registry: Registry, word: str) -> tuple[Row, bytes]:
    """The latest calibration of the tool whose serial is a word, or the document that the word names.

    Raises:
        InputError: there is none.
        AlteredError: it is not what was added.
    """
    latest = queries.latest_calibration(registry, word)
    if latest:
        return latest
    if not _names_record(word):
        raise _unknown(registry, word)
    return queries.document(registry, one_record(registry, word)["number"])


def latest_file(registry: Registry, serial: str | None) -> Member:
    """The file of the latest calibration of a tool, of the only one where no serial is given.

    Raises:
        InputError: there is none, or there are several tools to choose from.
    """
    if serial is None:
        total, rows = queries.tools_page(registry, limit=1)
        if total != 1:
            example = f", such as '{registry.name}{MARK}{rows[0]['serial']}'" if rows else ""
            raise InputError(
                f"{registry.name} has {total} tools. Name one of them behind a {MARK}{example}."
            )
        serial = str(rows[0]["serial"])
    latest = queries.latest_calibration(registry, serial)
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
    row = queries.record(registry, int(word)) if _is_number(word) else None
    if row:
        return row
    with registry.reading() as connection:
        at = records.c.sha256
        query = queries.with_events().where(at >= word.lower(), at < word.lower() + "g").limit(2)
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
    _, rows = queries.tools_page(registry, limit=MOST_COMPARED)
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
