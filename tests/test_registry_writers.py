"""Several writers of one registry, kills and backups among them: the small version of `registry_stress`."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing

import pytest
import sqlalchemy as sa

from mwdcal.errors import FitError, InputError
from mwdcal.registry import checking, exports, lookup
from mwdcal.registry.database import models
from mwdcal.registry.store import Entry, create, open_registry
from registry_stress import acknowledged_in, losses, stressed, write_on, writers_context
from registry_support import calibration, empty_database, registry_database

pytestmark = pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL and fork servers")
database = pytest.fixture(params=["sqlite", "postgresql"])(registry_database)


@pytest.mark.slow
def test_no_acknowledged_write_is_lost_to_kills(database, tmp_path):
    create(database, "Ada")
    logs = tmp_path / "logs"
    logs.mkdir()
    calls, events = stressed(str(database), logs, writers=4, seconds=3.0, kills=6)
    assert events["writers killed"] > 0
    assert len(calls) > 10
    after = losses(str(database), calls)
    assert (after["lost"], after["discrepancies"]) == ([], [])


@pytest.mark.slow
def test_a_backup_among_writers_holds_what_was_acknowledged_before(database, tmp_path):
    create(database, "Ada")
    log = tmp_path / "0.log"
    arguments = (str(database), str(log), 0, str(tmp_path / "end"))
    writer = writers_context().Process(target=write_on, args=arguments)
    writer.start()
    try:
        for number in range(3):
            while not log.exists() or log.read_bytes().count(b"\n") < 8 * (number + 1):
                assert writer.is_alive()
                time.sleep(0.02)
            before = [sha for call in acknowledged_in(tmp_path, {}) for sha in call]
            path = tmp_path / f"{number}.backup"
            with open_registry(database) as registry:
                head = exports.backup(registry, path)
                assert checking.check(registry, head) == []  # while it goes on
            with open_registry(path) as kept:
                assert checking.check(kept, head) == []
                with kept.reading() as connection:
                    assert set(before) <= set(
                        connection.scalars(sa.select(models.records.c.sha256))
                    )
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
    assert not [p for p in tmp_path.iterdir() if p.name.endswith(("-journal", ".tmp"))]


@pytest.mark.parametrize("to", ["sqlite", "postgresql"])
def test_a_backup_restored_into_either_database_is_the_same(database, to, tmp_path, request):
    create(database, "Ada")
    with open_registry(database) as registry:
        added = registry.add(
            [Entry("calibration", calibration(f"A-{i}"), "a.json") for i in range(9)], "Ada"
        )
        registry.withdraw(added[3].number, "wrong tool", "Ben")
        head = exports.backup(registry, tmp_path / "tools.backup")
        rows = everything(registry)
    url = to == "postgresql"
    target = empty_database(request.getfixturevalue("postgresql")) if url else tmp_path / "new"
    assert exports.restore(tmp_path / "tools.backup", target, "Eve") == head
    with open_registry(target) as registry:
        assert checking.check(registry, head) == []
        newest = lookup.events(registry, limit=1).rows[0]
        assert (newest["action"], newest["subject"], newest["actor"]) == ("restore", head, "Eve")
        again = everything(registry)
        again["history"].pop()
        assert again == rows
        registry.add([Entry("calibration", calibration("B-1"), "b.json")], "Eve")
        assert checking.check(registry, head) == []


def everything(registry):
    tables = {**dict.fromkeys(models.GUARDED, "number"), models.tools: "serial"}
    with registry.reading() as connection:
        return {
            table.name: [tuple(row) for row in connection.execute(sa.select(table).order_by(key))]
            for table, key in tables.items()
        }


def test_an_altered_backup_is_not_restored(tmp_path):
    create(tmp_path / "tools.registry", "Ada")
    with open_registry(tmp_path / "tools.registry") as registry:
        registry.add([Entry("calibration", calibration("A-1"), "a.json")], "Ada")
        exports.backup(registry, tmp_path / "tools.backup")
    with closing(sqlite3.connect(tmp_path / "tools.backup")) as connection:
        connection.execute("DROP TRIGGER records_no_update")
        connection.execute("UPDATE records SET inclination_deg = 0.01")
        connection.commit()
    with pytest.raises(FitError, match="was altered or is damaged"):
        exports.restore(tmp_path / "tools.backup", tmp_path / "new.registry", "Ada")
    assert not (tmp_path / "new.registry").exists()


def test_a_backup_that_cannot_be_written_leaves_nothing(tmp_path):
    create(tmp_path / "tools.registry", "Ada")
    with open_registry(tmp_path / "tools.registry") as registry:
        with pytest.raises(InputError, match="does not exist"):
            exports.backup(registry, tmp_path / "no" / "tools.backup")
        with pytest.raises(InputError, match="registry itself"):
            exports.backup(registry, tmp_path / "tools.registry")
        exports.backup(registry, tmp_path / "tools.backup")
        exports.backup(registry, tmp_path / "tools.backup")  # replaces the older
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tools.backup", "tools.registry"]


CREATION = """
import sys
from mwdcal.registry.database import connections, migrating
from mwdcal.registry.store import create
import os, signal

def kill(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)

migrating.append_one = kill
create(sys.argv[1], "Ada")
"""


def test_a_killed_creation_leaves_what_can_be_created(database):
    killed = subprocess.run([sys.executable, "-c", CREATION, str(database)])
    assert killed.returncode == -signal.SIGKILL
    with pytest.raises(InputError, match="is not a registry"), open_registry(database):
        pass
    create(database, "Ada")
    with open_registry(database) as registry:
        assert checking.check(registry) == []
