"""The version of a registry's schema, and whether this program can work with it."""

from __future__ import annotations

import re

import sqlalchemy as sa

from mwdcal.errors import InputError

SCHEMA_VERSION_OF_REGISTRY = "0002"
"""The newest migration: the schema that this program works with."""
VERSION_TABLE = "alembic_version"
"""Where Alembic keeps the version."""
_STATED_VERSION = sa.text(f"SELECT version_num FROM {VERSION_TABLE}")


def stated_version(connection: sa.Connection) -> str:
    """The version that a registry states; empty where it does not state one."""
    rows = connection.scalars(_STATED_VERSION).all()
    return str(rows[0]) if len(rows) == 1 else ""


def known_version(connection: sa.Connection, name: str) -> str:
    """The version of the schema in a database, the newest or an older one.

    Raises:
        InputError: it is not a registry, or one of a newer program.
    """
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
