"""The version of a registry's schema, and whether this program can work with it."""

from __future__ import annotations

import re

import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry.database.models import metadata

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
"""What a database has that computes when it is read: views, virtual tables, generated columns."""


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
