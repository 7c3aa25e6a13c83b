"""The version of a registry's schema, and whether this program can work with it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import groupby
from typing import Any

import sqlalchemy as sa

from mwdcal.calibration.record import canonical
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.registry.database.models import ACCURACY, history, metadata, records, tools, withdrawals

# --------------------------------------------------------------------------
# The history: numbered events, each of which is hashed together with the hash of the one before.
#
# Definition: row_sha256 of an event is that of the canonical JSON of the row it made, values that are
# null left out, so that a column added later changes no digest; hash is that of the canonical JSON of
# the event itself without `hash`.

GENESIS = "0" * 64
"""Hash before the first event."""


def digest(fields: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical JSON of a row, values that are null left out.

    Raises:
        TypeError, ValueError: a value is not text or a finite number, as only in a damaged database.
    """
    kept = {name: value for name, value in fields.items() if value is not None}
    return sha256_of(canonical(kept))


def event_hash(event: Mapping[str, Any]) -> str:
    """The hash that an event must have."""
    return digest({name: value for name, value in event.items() if name != "hash"})


def follows(event: Mapping[str, Any], previous: str) -> bool:
    """Whether an event is as it was written, after one of the hash `previous`."""
    try:
        return bool(event["previous"] == previous and event["hash"] == event_hash(event))
    except (TypeError, ValueError):  # no text or no number where one must be
        return False


def head(connection: sa.Connection) -> tuple[int, str]:
    """Number and hash of the newest event; 0 and `GENESIS` before the first."""
    newest = sa.select(history.c.number, history.c.hash).order_by(history.c.number.desc()).limit(1)
    row = connection.execute(newest).one_or_none()
    return (row.number, row.hash) if row else (0, GENESIS)


def append(connection: sa.Connection, previous: str, events: Iterable[Mapping[str, Any]]) -> None:
    """Append events, whose numbers must follow the newest, of hash `previous`, to the history."""
    rows = []
    for event in events:
        row = {"sha256": None, "row_sha256": None, **event, "previous": previous}
        row["hash"] = previous = event_hash(row)
        rows.append(row)
    if rows:
        connection.execute(sa.insert(history), rows)


def instant(when: datetime | None = None) -> str:
    """A time as the history states it: ISO 8601 in UTC; now, where none is given."""
    return (when or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="microseconds")


def append_one(
    connection: sa.Connection, actor: str, action: str, kind: str, subject: str, **more: Any
) -> int:
    """Append one event now; its number."""
    newest, previous = head(connection)
    number = newest + 1
    event = {"number": number, "time": instant(), "actor": actor, "action": action, "kind": kind}
    append(connection, previous, [{**event, "subject": subject, **more}])
    return number


# --------------------------------------------------------------------------
# Triggers that refuse to change or remove what is written: objects, records, withdrawals, history.

REFUSAL = "a registry only grows: nothing in it is changed or removed"
"""The answer of the database to an UPDATE or DELETE of a guarded table."""
FUNCTION = "mwdcal_refuse"
"""The PostgreSQL function that the triggers call."""
FUNCTION_BODY = f"BEGIN RAISE EXCEPTION '{REFUSAL}'; END"
_EVENTS = {"sqlite": ("UPDATE", "DELETE"), "postgresql": ("UPDATE", "DELETE", "TRUNCATE")}
_TYPES = {"DELETE": 2 + 8, "UPDATE": 2 + 16, "TRUNCATE": 2 + 32}
"""PostgreSQL's numbers of triggers before such a statement."""


def triggers_of_postgresql(tables: Iterable[str]) -> dict[str, tuple[str, int]]:
    """The triggers that PostgreSQL must have: the table and the type of each, by name."""
    events = _EVENTS["postgresql"]
    return {f"{t}_no_{event.lower()}": (t, _TYPES[event]) for t in tables for event in events}


def guard_statements(dialect: str, tables: Iterable[str]) -> Iterator[str]:
    """The statements that create the triggers."""
    postgresql = dialect == "postgresql"
    if postgresql:
        yield f"CREATE FUNCTION {FUNCTION}() RETURNS trigger LANGUAGE plpgsql AS $$ {FUNCTION_BODY} $$"
    for table in tables:
        for event in _EVENTS[dialect]:
            head = f"CREATE TRIGGER {table}_no_{event.lower()} BEFORE {event} ON {table}"
            if postgresql:
                yield f"{head} FOR EACH STATEMENT EXECUTE FUNCTION {FUNCTION}()"
            else:
                yield f"{head} BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END"


def drop_statements(dialect: str, tables: Iterable[str]) -> Iterator[str]:
    """The statements that remove the triggers."""
    for table in tables:
        for event in _EVENTS[dialect]:
            on = f" ON {table}" if dialect == "postgresql" else ""
            yield f"DROP TRIGGER {table}_no_{event.lower()}{on}"
    if dialect == "postgresql":
        yield f"DROP FUNCTION {FUNCTION}()"


# --------------------------------------------------------------------------
# The table of tools: what lists and pages show of each, computed from its records alone.

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


SCHEMA_VERSION_OF_REGISTRY = "0002"
"""The newest migration: the schema that this program works with."""
VERSION_TABLE = "alembic_version"
"""Where Alembic keeps the version."""
_STATED_VERSION = sa.text(f"SELECT version_num FROM {VERSION_TABLE}")


_COMPUTED = {
    "sqlite": sa.text(
        "SELECT name FROM sqlite_master WHERE type = 'view' OR (type = 'table' AND rootpage = 0) "
        "UNION ALL SELECT m.name FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c "
        "WHERE m.type = 'table' AND c.hidden"
    ),
    "postgresql": sa.text(
        "SELECT relname FROM unnest(CAST(:tables AS text[])) AS name "
        "JOIN pg_class ON pg_class.oid = to_regclass(name) WHERE relkind <> 'r' "
        "OR EXISTS (SELECT FROM pg_attribute WHERE attrelid = pg_class.oid AND attgenerated <> '')"
    ),
}
"""Parts of a database that compute when it is read: views, virtual tables, generated columns."""


def check_tables(connection: sa.Connection, name: str) -> None:
    """Refuse, before it is read, a database with anything that is not stored: reading that may never end.

    Raises:
        InputError: one of its tables computes what it gives.
    """
    names = {"tables": [*metadata.tables, VERSION_TABLE]}
    dialect = connection.dialect.name
    computed = connection.scalar(_COMPUTED[dialect], names if dialect == "postgresql" else {})
    if computed is not None:
        raise InputError(
            f"{name}: {computed!r} is a view or computes its values, and a registry has only tables that store them. "
            "It is not a registry, or was altered: restore it from a backup."
        )


def stated_version(connection: sa.Connection) -> str:
    """The version that a registry states; empty where it does not state one."""
    rows = connection.scalars(_STATED_VERSION).all()
    return str(rows[0]) if len(rows) == 1 else ""


def known_version(connection: sa.Connection, name: str) -> str:
    """The version of the schema in a database, the newest or an older one.

    Raises:
        InputError: it is not a registry, or one of a newer program.
    """
    check_tables(connection, name)
    tables = set(sa.inspect(connection).get_table_names())
    version = stated_version(connection) if {VERSION_TABLE, "history"} <= tables else ""
    if not re.fullmatch(r"\d{4}", version):
        raise InputError(f"{name}: it is not a registry. Name one that mwdcal made, or create it.")
    if version > SCHEMA_VERSION_OF_REGISTRY:
        raise InputError(
            f"{name}: a newer version of mwdcal made it (schema {version}). Use that version."
        )
    return version


def check_version(connection: sa.Connection, name: str) -> None:
    """Refuse a registry whose schema is not the newest."""
    version = stated_version(connection)
    if version != SCHEMA_VERSION_OF_REGISTRY:
        raise InputError(
            f"{name}: its schema is {version or 'not stated'}, and this program works with "
            f"{SCHEMA_VERSION_OF_REGISTRY}. Upgrade it with mwdcal registry upgrade, after a backup."
        )
