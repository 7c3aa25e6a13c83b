"""The schema of a registry from version to version, up and down, with data in it."""

import json
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from mwdcal.errors import InputError
from mwdcal.registry import checking, lookup
from mwdcal.registry.database import migrating, models
from mwdcal.registry.database.connections import connect
from mwdcal.registry.database.schema import SCHEMA_VERSION_OF_REGISTRY
from mwdcal.registry.store import move_to, open_registry, upgrade
from registry_support import registry_database

database = pytest.fixture(params=["sqlite", "postgresql"])(registry_database)
FROZEN = Path(__file__).with_name("registry_0001.jsonl")
"""The rows of a registry as the first schema kept them; later schemas keep them as they are."""


def frozen_rows():
    for line in FROZEN.read_text("utf-8").splitlines():
        table, row = json.loads(line)
        if table == "objects":
            row["data"] = bytes.fromhex(row["data"])
        yield table, row


def filled_at(database, revision):
    """A registry whose schema and rows are those of a version."""
    place = connect(database, new=True)
    with place.writing() as connection:
        migrating.migrate(connection, revision)
        for table, row in frozen_rows():
            connection.execute(sa.insert(models.metadata.tables[table]), row)
        if revision >= "0002":
            from mwdcal.registry.database.schema import refresh_all

            refresh_all(connection)
    place.engine.dispose()


def content(database):
    """All rows of the tables that every schema has, but for the events of migrations."""
    place = connect(database)
    with place.reading() as connection:
        rows = {
            table.name: [
                tuple(row) for row in connection.execute(sa.select(table).order_by("number"))
            ]
            for table in models.GUARDED
        }
        tables = set(sa.inspect(connection).get_table_names())
    place.engine.dispose()
    migrations = [row for row in rows["history"] if row[4] == "schema"]
    rows["history"] = [row for row in rows["history"] if row[4] != "schema"]
    return rows, tables, [(row[3], row[5]) for row in migrations]


def test_the_newest_version_is_the_last_migration():
    assert migrating.revisions()[-1] == SCHEMA_VERSION_OF_REGISTRY


@pytest.mark.parametrize("revision", migrating.revisions())
def test_a_registry_of_each_version_goes_up_and_down_with_its_content(database, revision):
    filled_at(database, revision)
    rows, tables, _ = content(database)
    assert len(rows["history"]) == 16
    upgrade(database, "Ada")
    with open_registry(database) as registry:
        assert checking.check(registry) == []
        assert [row["serial"] for row in lookup.tools_page(registry).rows] == ["A-0", "A-1", "A-2"]
    assert content(database)[0] == rows
    move_to(database, revision, "Ada")
    changed = revision != SCHEMA_VERSION_OF_REGISTRY
    noted = [("upgrade", SCHEMA_VERSION_OF_REGISTRY), ("downgrade", revision)]
    assert content(database) == (rows, tables, noted if changed else [])
    if changed:
        with (
            pytest.raises(InputError, match="Upgrade it with mwdcal registry upgrade"),
            open_registry(database),
        ):
            pass
        upgrade(database, "Ada")
    with open_registry(database) as registry:
        assert checking.check(registry) == []


def test_the_first_migration_leaves_nothing_behind(database):
    place = connect(database, new=True)
    with place.writing() as connection:
        migrating.migrate(connection, SCHEMA_VERSION_OF_REGISTRY)
        migrating.migrate(connection, "base")
        assert set(sa.inspect(connection).get_table_names()) == {"alembic_version"}
        migrating.migrate(connection, SCHEMA_VERSION_OF_REGISTRY)
    with place.reading() as connection:
        assert migrating.differences(connection) == []
    place.engine.dispose()


def test_models_and_migrations_agree(database):
    place = connect(database, new=True)
    with place.writing() as connection:
        migrating.migrate(connection, SCHEMA_VERSION_OF_REGISTRY)
        options = {"compare_type": True, "compare_server_default": True}
        context = MigrationContext.configure(connection, opts=options)
        assert compare_metadata(context, models.metadata) == []
    place.engine.dispose()


def test_a_newer_schema_is_refused(database):
    filled_at(database, SCHEMA_VERSION_OF_REGISTRY)
    place = connect(database)
    with place.writing() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    place.engine.dispose()
    with (
        pytest.raises(InputError, match="a newer version of mwdcal") as refusal,
        open_registry(database),
    ):
        pass
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="a newer version of mwdcal"):
        upgrade(database, "Ada")
