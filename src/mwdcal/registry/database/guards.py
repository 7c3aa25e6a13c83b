"""Triggers that refuse to change or remove what is written: objects, records, withdrawals, history."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

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
