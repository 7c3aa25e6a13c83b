"""The history: numbered events, each of which is hashed together with the hash of the one before.

Definition: row_sha256 of an event is that of the canonical JSON of the row it made, values that are
null left out, so that a column added later changes no digest; hash is that of the canonical JSON of
the event itself without `hash`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from mwdcal.calibration.canonical import canonical
from mwdcal.digests import sha256_of
from mwdcal.registry.database.models import history

GENESIS = "0" * 64
"""What the first event has as the hash of the one before."""


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
