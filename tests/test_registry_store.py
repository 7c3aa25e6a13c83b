"""The registry's database: what goes in comes out, once, and is on the disk."""

import sqlite3
from contextlib import closing

import pytest
import sqlalchemy as sa

from cli_support import mwdcal
from mwdcal.registry import checking, exports, lookup
from mwdcal.registry.database.models import objects
from mwdcal.registry.store import Entry, create, open_registry
from registry_support import calibration, registry_database
from test_registry_check import PostgresqlTables, without_triggers

database = pytest.fixture(params=["sqlite", "postgresql"])(registry_database)


def test_what_is_added_comes_back_once(database):
    create(database, "Ada")
    entry = Entry("calibration", calibration("A-1"), "a.json")
    with open_registry(database) as registry:
        first, again = registry.add([entry], "Ada"), registry.add([entry], "Ben")
        assert [(a.new, a.number) for a in (*first, *again)] == [(True, 2), (False, 2)]
        assert registry.content(first[0].sha256) == entry.data
        assert lookup.tools_page(registry).rows[0]["inclination_deg"] == 0.03
        assert checking.check(registry) == []


def test_a_backup_is_the_registry(database, tmp_path):
    create(database, "Ada")
    with open_registry(database) as registry:
        registry.add(
            [Entry("calibration", calibration(f"A-{i}"), "a.json") for i in range(5)], "Ada"
        )
        head = exports.backup(registry, tmp_path / "backup.registry")
        assert head == registry.head()[1]
    exports.restore(tmp_path / "backup.registry", tmp_path / "new.registry", "Ada")
    with open_registry(tmp_path / "new.registry") as registry:
        assert checking.check(registry, head=head) == []
        assert lookup.counts(registry)["calibration"] == 5


def rot(database):
    """Flip a bit of the file that was added first, past the triggers."""
    with open_registry(database) as registry, registry.reading() as connection:
        data = bytearray(connection.scalar(sa.select(objects.c.data).order_by(objects.c.number)))
    data[len(data) // 2] ^= 4
    if isinstance(database, str):
        with closing(PostgresqlTables(database).connection) as connection:
            connection.execute("UPDATE objects SET data = %s WHERE number = 2", (bytes(data),))
            connection.commit()
        return
    with closing(sqlite3.connect(database)) as connection, without_triggers(connection):
        connection.execute("UPDATE objects SET data = ? WHERE number = 2", (bytes(data),))


def test_a_rotten_registry_never_replaces_a_good_backup(database, tmp_path):
    """Thirty nights; the bit flips before the tenth."""
    create(database, "Ada")
    file, heads = tmp_path / "night.registry", []
    for night in range(1, 31):
        with open_registry(database) as registry:
            registry.add([Entry("calibration", calibration(f"A-{night}"), "a.json")], "Ada")
        if night == 10:
            rot(database)
            good = file.read_bytes()
        ran = mwdcal("registry", "--registry", database, "backup", file, "--json")
        if night < 10:
            heads.append(ran.json["head"])
            continue
        assert ran.code == 3
        assert "was altered or is damaged (the calibration" in ran.err
        assert "was not written" in ran.err
        assert file.read_bytes() == good
    exports.restore(file, tmp_path / "new.registry", "Ada")
    with open_registry(tmp_path / "new.registry") as registry:
        assert checking.check(registry, head=heads[-1]) == []
        assert lookup.counts(registry)["calibration"] == 9
