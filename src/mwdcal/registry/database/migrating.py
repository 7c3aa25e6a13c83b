"""The schema of a registry: the steps between its versions, up and down, and what is wrong with it."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any
from uuid import uuid4

import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.environment import EnvironmentContext
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory

from mwdcal.errors import InputError
from mwdcal.registry.database.connections import Database
from mwdcal.registry.database.models import GUARDED, metadata
from mwdcal.registry.database.schema import (
    FUNCTION_BODY,
    SCHEMA_VERSION_OF_REGISTRY,
    VERSION_TABLE,
    append_one,
    known_version,
    triggers_of_postgresql,
)


@cache
def scripts() -> ScriptDirectory:
    """The migrations, which are part of the package."""
    folder = str(files(__package__) / "migrations")
    return ScriptDirectory(folder, version_locations=[folder])


@cache
def revisions() -> list[str]:
    """All versions of the schema, oldest first."""
    return [step.revision for step in scripts().walk_revisions()][::-1]


def migrate(connection: sa.Connection, target: str) -> None:
    """Bring the schema to a version, up or down, within the transaction of the connection."""
    directory, steps = scripts(), revisions()
    current = MigrationContext.configure(connection).get_current_revision()
    up = current is None or (target != "base" and steps.index(target) >= steps.index(current))

    def plan(at: Any, _context: MigrationContext) -> Any:
        if up:
            return directory._upgrade_revs(target, at)
        return directory._downgrade_revs(target, at)

    with EnvironmentContext(Config(), directory, fn=plan, destination_rev=target) as environment:
        environment.configure(connection=connection, target_metadata=metadata)
        environment.run_migrations()


def initialise(database: Database, actor: str) -> None:
    """Create the tables in an empty database, and begin the history.

    Raises:
        InputError: there are tables already.
    """
    with database.writing() as connection:
        create_tables(connection, database.name)
        append_one(connection, actor, "create", "registry", uuid4().hex)


def create_tables(connection: sa.Connection, name: str) -> None:
    """Create the tables at the newest version; refuses a database that has tables of a registry, or a file with any."""
    tables = set(sa.inspect(connection).get_table_names())
    ours = {*metadata.tables, VERSION_TABLE}
    if tables if connection.dialect.name == "sqlite" else tables & ours:
        raise InputError(f"{name}: it exists and is not empty. Name another, or use this one.")
    migrate(connection, SCHEMA_VERSION_OF_REGISTRY)


def change(database: Database, target: str, actor: str) -> tuple[str, str]:
    """Bring the schema to a version, up or down, and note it in the history; from which to which."""
    steps = revisions()
    if target not in steps:
        raise InputError(
            f"`target` must be one of the schema's versions {', '.join(steps)}; got {target!r}. Choose one."
        )
    with database.reading() as connection:
        known_version(connection, database.name)  # nothing is written to what is not a registry
    with database.writing() as connection:
        current = known_version(connection, database.name)
        if current != target:
            migrate(connection, target)
            action = "upgrade" if steps.index(target) > steps.index(current) else "downgrade"
            append_one(connection, actor, action, "schema", target)
    return current, target


def differences(connection: sa.Connection) -> list[str]:
    """The faults of the tables, indexes and triggers of a database, one sentence each."""
    if connection.dialect.name == "sqlite":
        wrong = [
            row for row in connection.scalars(sa.text("PRAGMA integrity_check")) if row != "ok"
        ]
        return [f"SQLite finds: {text}" for text in wrong[:5]] + _sqlite_differences(connection)
    return _postgresql_differences(connection)


def _sqlite_differences(connection: sa.Connection) -> list[str]:
    present, expected = _catalogue(connection), _expected_catalogue()
    names = sorted({*present, *expected})
    return [
        f"{kind} '{name}' of the schema is "
        + ("missing" if (kind, name) not in present else "not as mwdcal makes it")
        for kind, name in names
        if present.get((kind, name)) != expected.get((kind, name))
    ]


def _catalogue(connection: sa.Connection) -> dict[tuple[str, str], tuple[str, str | None]]:
    """The statement that made each table, index and trigger; SQLite's own statistics apart."""
    query = "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite~_stat%' ESCAPE '~'"
    return {
        (row.type, row.name): (row.tbl_name, row.sql) for row in connection.execute(sa.text(query))
    }


@cache
def _expected_catalogue() -> dict[tuple[str, str], tuple[str, str | None]]:
    """The catalogue of a new registry."""
    engine = sa.create_engine("sqlite://")
    with engine.begin() as connection:
        migrate(connection, SCHEMA_VERSION_OF_REGISTRY)
        result = _catalogue(connection)
    engine.dispose()
    return result


_OUR_TABLES = (
    "WITH ours AS (SELECT to_regclass(name) AS ours FROM unnest(CAST(:tables AS text[])) AS name) "
)
_TRIGGERS_THERE = sa.text(
    _OUR_TABLES
    + "SELECT tgname, relname, tgtype, prosrc, tgenabled = 'O' AND tgattr = '' AND tgqual IS NULL AS always "
    "FROM ours JOIN pg_trigger ON tgrelid = ours JOIN pg_proc ON pg_proc.oid = tgfoid "
    "JOIN pg_class ON pg_class.oid = tgrelid WHERE NOT tgisinternal"
)
_UNSEEN_BY_ALEMBIC = sa.text(
    _OUR_TABLES + "SELECT 'table', relname FROM ours JOIN pg_class ON oid = ours "
    "WHERE relpersistence <> 'p' OR relrowsecurity "
    "OR EXISTS (SELECT FROM pg_inherits WHERE ours IN (inhparent, inhrelid)) "
    "UNION ALL SELECT 'rule', rulename FROM ours JOIN pg_rewrite ON ev_class = ours "
    "UNION ALL SELECT 'constraint', conname FROM ours JOIN pg_constraint ON conrelid = ours "
    "WHERE contype IN ('c', 'x') "
    "UNION ALL SELECT 'index', relname FROM ours JOIN pg_index ON indrelid = ours "
    "JOIN pg_class ON pg_class.oid = indexrelid JOIN pg_am ON pg_am.oid = relam "
    "WHERE amname <> 'btree' OR indpred IS NOT NULL OR NOT (indisvalid AND indisready) "
    "UNION ALL SELECT 'column', attname FROM ours JOIN pg_attribute ON attrelid = ours "
    "JOIN pg_collation ON pg_collation.oid = attcollation "
    "WHERE collname <> 'C' AND ours <> to_regclass(:version)"
)
"""Rules, policies, inheritance, tables that a crash empties, and other parts that Alembic does not compare."""


def _postgresql_differences(connection: sa.Connection) -> list[str]:
    """Differences as Alembic finds them, what it does not compare, and triggers that are missing or off."""
    ours = {*metadata.tables, VERSION_TABLE}
    options = {
        "include_name": lambda name, kind, parents: kind != "table" or name in ours,
        "compare_server_default": True,
    }
    context = MigrationContext.configure(connection, opts=options)
    wrong = [
        f"the schema is not as mwdcal makes it: {_words(d)}"
        for d in compare_metadata(context, metadata)
    ]
    names = {"tables": sorted(ours), "version": VERSION_TABLE}
    parts = [(row[0], row[1]) for row in connection.execute(_UNSEEN_BY_ALEMBIC, names)]
    parts += [("primary key of", name) for name in _without_primary_key(connection)]
    wrong += [f"{kind} '{name}' of the schema is not as mwdcal makes it" for kind, name in parts]
    present = {
        row.tgname: (row.relname, row.tgtype)
        if row.always and row.prosrc.strip() == FUNCTION_BODY
        else None
        for row in connection.execute(_TRIGGERS_THERE, {"tables": sorted(ours)})
    }
    expected = triggers_of_postgresql(table.name for table in GUARDED)
    wrong += [
        f"trigger '{name}' of the schema is missing or not as mwdcal makes it"
        for name in {*present, *expected}
        if name not in expected or present.get(name) != expected[name]
    ]
    return sorted(wrong)


def _without_primary_key(connection: sa.Connection) -> list[str]:
    """Tables whose primary key is another than it was."""
    expected = {
        table.name: list(table.primary_key.columns.keys()) for table in metadata.sorted_tables
    }
    present = sa.inspect(connection).get_multi_pk_constraint(filter_names=[*expected])
    keys = {name: key["constrained_columns"] for (_, name), key in present.items()}
    return [name for name, columns in expected.items() if keys.get(name) != columns]


def _words(difference: Any) -> str:
    """A difference that Alembic reports, in short."""
    first = difference[0] if isinstance(difference, list) else difference
    named = [getattr(part, "name", part) for part in first[1:] if part is not None]
    return " ".join([str(first[0]).replace("_", " "), *(str(n) for n in named[:2])])
