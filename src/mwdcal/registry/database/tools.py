"""The table of tools: what lists and pages show of each, computed from its records alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any

import sqlalchemy as sa

from mwdcal.registry.database.models import ACCURACY, history, records, tools, withdrawals

TOOL_KINDS = ("tool", "run", "calibration", "verification", "certificate")
"""Kinds of records whose serial is that of a tool; others have one of their own, as a stand has."""
_PORTION = 400


def summary(rows: Sequence[Any]) -> dict[str, Any]:
    """The row of a tool from its records in order of their numbers, each with `withdrawn` and `seen`."""
    valid = [row for row in rows if row.withdrawn is None]
    calibrations = [row for row in valid if row.kind == "calibration"]
    latest = max(calibrations, key=lambda row: (row.time or "", row.number), default=None)
    due = [row for row in valid if row.kind == "certificate"]
    certificate = max(due, key=lambda row: (row.time or "", row.number), default=None)
    return {
        "serial": rows[0].serial,
        "type": next((row.type for row in reversed(rows) if row.type), None),
        "first_seen": min(row.seen for row in rows),
        "records": len(valid),
        "calibrations": len(calibrations),
        "latest": latest and latest.number,
        "calibrated": latest and latest.time,
        **{name: latest and getattr(latest, name) for name in ACCURACY},
        "next_due": certificate and certificate.next_due,
        "status": next((row.status for row in reversed(valid) if row.status), None),
        "simulated": int(any(row.simulated for row in valid)),
    }


def rows_of(connection: sa.Connection, serials: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The rows that the table must have for some serials, by serial."""
    at = records.c
    query = (
        sa.select(records, withdrawals.c.number.label("withdrawn"), history.c.time.label("seen"))
        .join(history, history.c.number == at.number)
        .outerjoin(withdrawals, withdrawals.c.record == at.number)
        .where(at.serial.in_(serials), at.kind.in_(TOOL_KINDS))
        .order_by(at.serial, at.number)
    )
    for _, rows in groupby(connection.execute(query), lambda row: row.serial):
        yield summary(list(rows))


def refresh(connection: sa.Connection, serials: Iterable[str]) -> None:
    """Compute the rows of some tools again."""
    for portion in portions(sorted(set(serials))):
        connection.execute(sa.delete(tools).where(tools.c.serial.in_(portion)))
        if rows := list(rows_of(connection, portion)):
            connection.execute(sa.insert(tools), rows)


def refresh_all(connection: sa.Connection) -> None:
    """Compute the rows of all tools."""
    serials = sa.select(records.c.serial).where(records.c.kind.in_(TOOL_KINDS)).distinct()
    refresh(connection, connection.scalars(serials.where(records.c.serial.is_not(None))).all())


def portions(items: Sequence[str]) -> Iterator[Sequence[str]]:
    """Items in parts that one statement can name."""
    return (items[i : i + _PORTION] for i in range(0, len(items), _PORTION))
