"""`registry check`: whatever is changed, removed or added beside the program, it says so."""

import hashlib
import json
import random
import re
import shutil
import sqlite3
import zlib
from contextlib import closing, contextmanager, suppress

import psycopg
import pytest
import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry import checking, stored
from mwdcal.registry.store import Entry, create, open_registry
from registry_support import calibration, drop_database, empty_database

TABLES = ("objects", "records", "withdrawals", "history", "tools", "alembic_version")
RUN = b"# serial = A-1\n# simulated = yes\nax,ay,az\n" + b"".join(
    b"%d,%d,%d\n" % (i, i * i, i**3) for i in range(50)
)


def entries():
    """One file of each kind, and calibrations of a few tools."""
    documents = {
        "tool": {"serial": "A-1", "type": "servo"},
        "verification": {"serial": "A-1", "passed": True, "limits": "roll-test", "simulated": True},
        "certificate": {
            **{"number": "C-1", "issued": "2026-03-01", "next_due": "2027-03-01"},
            **{"item": {"serial": "A-1", "type": "servo"}, "as_left": {"passed": True}},
        },
        "standard": {"quantity": "stand", "name": "Stand 1", "serial": "S-1", "due": "2026-12-31"},
        "person": {"name": "Ada", "function": "metrologist"},
    }
    for kind, fields in documents.items():
        yield Entry(kind, json.dumps(fields).encode(), f"{kind}.json")
    yield Entry("run", RUN, "run.csv")
    yield Entry("profile", b'name = "servo"\n', "tool.toml")
    for i in range(6):
        yield Entry("calibration", calibration(f"A-{i % 3}", f"202{i}-01-01T00:00:00Z"), "cal.json")


def sound(path):
    """A registry with a record of every kind, two of them withdrawn."""
    create(path, "Ada")
    with open_registry(path) as registry:
        registry.add(entries(), "Ada")
        registry.withdraw(9, "wrong tool", "Ben")
        registry.withdraw(10, "wrong tool", "Ben")
    return path


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return sound(tmp_path_factory.mktemp("sound") / "original.registry")


def verdict(path, head=None):
    """The ids of what a check reports; that the registry cannot be opened, where it cannot."""
    try:
        with open_registry(path) as registry:
            return {each.id for each in checking.check(registry, head)}
    except InputError:
        return {"refused"}


def rows_of(path):
    """All rows of all tables; None where they cannot be read."""
    try:
        with closing(sqlite3.connect(path)) as connection:
            return {t: connection.execute(f"SELECT * FROM {t}").fetchall() for t in TABLES}
    except (sqlite3.Error, UnicodeError, OverflowError):
        return None


def test_a_sound_registry_has_no_discrepancy(original):
    assert verdict(original) == set()


def other(value, rng):
    """Another value of the same type, as near as can be, or none at all."""
    if value is None:
        return rng.choice(["x", "2026-01-01", 1, 0.5])
    if isinstance(value, int):
        return value + rng.choice([-1, 1, 100])
    if isinstance(value, float):
        return rng.choice([-value, value * (1 + 1e-15 * rng.randint(5, 100)), None])
    if not value:
        return "x"
    place = rng.randrange(len(value))
    if isinstance(value, bytes):
        flipped = value[place] ^ 1 << rng.randrange(8)
        return value[:place] + bytes([flipped]) + value[place + 1 :]
    replaced = rng.choice([c for c in "0aZé-" if c != value[place]])
    return rng.choice(
        [
            value[:place] + replaced + value[place + 1 :],
            value + " ",
            value[:place] + value[place + 1 :],
        ]
    )


def change_value(connection, table, rng):
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
    row, at = rng.choice(rows), rng.randrange(len(columns))
    value = other(row[1 + at], rng)
    connection.execute(f"UPDATE {table} SET {columns[at]} = ? WHERE rowid = ?", (value, row[0]))


def delete_row(connection, table, rng):
    rows = connection.execute(f"SELECT rowid FROM {table}").fetchall()
    connection.execute(f"DELETE FROM {table} WHERE rowid = ?", rng.choice(rows))


def insert_row(connection, table, rng):
    """A copy of a row under another number, unlike it where two may not be alike."""
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    row = list(rng.choice(connection.execute(f"SELECT * FROM {table}").fetchall()))
    top = connection.execute("SELECT max(number) FROM history").fetchone()[0]
    for at, name in enumerate(columns):
        if name == "number":
            row[at] = top + rng.choice([1, 2])
        elif name in ("serial", "sha256", "record", "version_num") and row[at] is not None:
            row[at] = other(row[at], rng)
    places = ", ".join("?" * len(row))
    connection.execute(f"INSERT INTO {table} VALUES ({places})", row)


def swap_rows(connection, table, rng):
    """Two rows trade the number, or the serial, by which they are known."""
    key = {"tools": "serial", "alembic_version": "version_num"}.get(table, "number")
    keys = [row[0] for row in connection.execute(f"SELECT {key} FROM {table}")]
    if len(keys) < 2:
        delete_row(connection, table, rng)
        return
    one, two = rng.sample(keys, 2)
    for old, new in ((one, -1), (two, one), (-1, two)):
        connection.execute(f"UPDATE {table} SET {key} = ? WHERE {key} = ?", (new, old))


CHANGES = (change_value, change_value, change_value, delete_row, insert_row, swap_rows)


@contextmanager
def without_triggers(connection):
    """A transaction in which nothing keeps tables from being changed; the triggers are there again afterwards."""
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"
    triggers = connection.execute(query).fetchall()
    connection.execute("BEGIN")
    for name, _ in triggers:
        connection.execute(f"DROP TRIGGER {name}")
    yield
    for _, statement in triggers:
        connection.execute(statement)
    connection.commit()


def tampered(path, rng):
    """Change something past the triggers; what was done."""
    while True:
        table, change = rng.choice(TABLES), rng.choice(CHANGES)
        with closing(sqlite3.connect(path)) as connection, suppress(sqlite3.IntegrityError):
            with without_triggers(connection):
                change(connection, table, rng)
            return change.__name__, table


def undetected(original, folder, seeds):
    """Changes through SQL that a check does not report."""
    before, missed = rows_of(original), []
    for seed in seeds:
        path = folder / "changed.registry"
        shutil.copyfile(original, path)
        done = tampered(path, random.Random(seed))
        if rows_of(path) != before and not verdict(path):
            missed.append((seed, *done))
    return missed


def test_changes_through_sql_are_reported(original, tmp_path):
    assert undetected(original, tmp_path, range(150)) == []


@pytest.mark.study
def test_each_of_a_thousand_changes_through_sql_is_reported(original, tmp_path):
    assert undetected(original, tmp_path, range(1000, 2000)) == []


def unnoticed_bytes(original, folder, seeds):
    """Changed bytes of the file that a check does not report, though rows differ or cannot be read."""
    before, data, missed = rows_of(original), original.read_bytes(), []
    for seed in seeds:
        rng, path = random.Random(seed), folder / "changed.registry"
        changed, start = bytearray(data), rng.randrange(len(data))
        for at in range(start, min(len(data), start + rng.choice([1, 1, 1, 2, 8]))):
            changed[at] ^= rng.randrange(1, 256)
        path.write_bytes(changed)
        if not verdict(path) and rows_of(path) != before:
            missed.append((seed, start))
    return missed


def test_changed_bytes_of_the_file_are_reported(original, tmp_path):
    assert unnoticed_bytes(original, tmp_path, range(150)) == []


@pytest.mark.study
def test_changed_bytes_of_the_file_are_reported_in_each_of_a_thousand_trials(original, tmp_path):
    assert unnoticed_bytes(original, tmp_path, range(1000, 2000)) == []


def test_removed_events_show_by_the_head_that_was_known(original, tmp_path):
    path = tmp_path / "changed.registry"
    with open_registry(original) as registry:
        head = registry.head()[1]
    shutil.copyfile(original, path)
    with closing(sqlite3.connect(path)) as connection, without_triggers(connection):
        for table in ("history", "withdrawals"):
            connection.execute(f"DELETE FROM {table} WHERE number = 16")
        one_more = "records = records + 1, calibrations = calibrations + 1"
        connection.execute(f"UPDATE tools SET {one_more} WHERE serial = 'A-1'")
    assert verdict(path) == set()  # the rows fit together: nothing in them tells
    assert verdict(path, head) == {"head"}
    assert verdict(original, head) == set()


@pytest.mark.parametrize(
    "statement",
    [
        "DROP INDEX records_serial",
        "DROP TRIGGER history_no_update",
        "DROP TRIGGER objects_no_delete",
        "DROP TABLE tools",
        "CREATE TABLE more (number INTEGER)",
        "CREATE TRIGGER sly AFTER INSERT ON records BEGIN DELETE FROM tools; END",
        "ALTER TABLE history ADD COLUMN more TEXT",
    ],
)
def test_a_changed_schema_is_reported(original, tmp_path, statement):
    path = tmp_path / "changed.registry"
    shutil.copyfile(original, path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
    assert verdict(path) & {"schema", "unreadable"}


def test_a_serial_that_is_no_text_is_reported(original, tmp_path):
    path = tmp_path / "changed.registry"
    shutil.copyfile(original, path)
    with closing(sqlite3.connect(path)) as connection:
        columns = "(serial, first_seen, records, calibrations, simulated)"
        connection.execute(f"INSERT INTO tools {columns} VALUES (x'41', '', 1, 1, 0)")
        connection.commit()
    assert verdict(path) == {"tools"}


def test_a_time_that_is_no_text_is_reported(original, tmp_path):
    path = tmp_path / "changed.registry"
    shutil.copyfile(original, path)
    with closing(sqlite3.connect(path)) as connection, without_triggers(connection):
        connection.execute("UPDATE history SET time = CAST(time AS BLOB) WHERE number = 2")
        connection.commit()
    assert {"event", "unreadable"} <= verdict(path)


def test_no_more_is_unpacked_than_a_registry_takes(monkeypatch):
    monkeypatch.setattr(stored, "LARGEST_OBJECT", 1000)
    bomb, address = (
        zlib.compress(bytes(10_000_000), 9),
        hashlib.sha256(bytes(10_000_000)).hexdigest(),
    )
    for size in (10_000_000, 2**62, -1, -2, None, "1"):
        with pytest.raises(stored.AlteredError, match="damaged"):
            stored.unpacked(bomb, size, address)


@pytest.mark.parametrize("table", ["objects", "records", "withdrawals", "history"])
def test_triggers_refuse_changes(original, tmp_path, table):
    path = tmp_path / "changed.registry"
    shutil.copyfile(original, path)
    with closing(sqlite3.connect(path)) as connection:
        for statement in (f"UPDATE {table} SET number = 99", f"DELETE FROM {table}"):
            with pytest.raises(sqlite3.IntegrityError, match="only grows"):
                connection.execute(statement)


class PostgresqlTables:
    """A connection to PostgreSQL that takes the statements above."""

    def __init__(self, url):
        self.connection = psycopg.connect(url)
        self.connection.execute("SET session_replication_role = replica")  # no triggers, no keys

    def execute(self, query, values=()):
        if pragma := re.match(r"PRAGMA table_info\((\w+)\)", query):
            columns = "SELECT 0, column_name FROM information_schema.columns WHERE table_name = %s "
            return self.connection.execute(f"{columns} ORDER BY ordinal_position", pragma.groups())
        return self.connection.execute(query.replace("rowid", "ctid").replace("?", "%s"), values)


def undetected_in_postgresql(server, seeds):
    """Changes through SQL that a check of a registry in PostgreSQL does not report."""
    original, missed = empty_database(server), []
    sound(original)
    template = sa.make_url(original).database
    for seed in seeds:
        rng, changed = random.Random(seed), empty_database(server, template)
        while True:
            table, change = rng.choice(TABLES), rng.choice(CHANGES)
            tables = PostgresqlTables(changed)
            with closing(tables.connection), suppress(psycopg.Error):
                before = {t: tables.execute(f"SELECT * FROM {t}").fetchall() for t in TABLES}
                change(tables, table, rng)
                after = {t: tables.execute(f"SELECT * FROM {t}").fetchall() for t in TABLES}
                tables.connection.commit()
                break
        same = {t: sorted(map(str, rows)) for t, rows in before.items()} == {
            t: sorted(map(str, rows)) for t, rows in after.items()
        }
        if not same and not verdict(changed):
            missed.append((seed, change.__name__, table))
        drop_database(server, changed)
    return missed


def test_changes_of_postgresql_are_reported(postgresql):
    assert undetected_in_postgresql(postgresql, range(8)) == []


@pytest.mark.study
def test_each_of_a_thousand_changes_of_postgresql_is_reported(postgresql):
    assert undetected_in_postgresql(postgresql, range(1000, 2000)) == []


@pytest.mark.parametrize(
    "statement",
    [
        "DROP INDEX records_serial",
        "DROP TRIGGER history_no_update ON history",
        "ALTER TABLE objects DISABLE TRIGGER objects_no_delete",
        "ALTER TABLE records ALTER COLUMN name DROP NOT NULL",
        "ALTER TABLE records DROP CONSTRAINT records_sha256",
        "CREATE OR REPLACE FUNCTION mwdcal_refuse() RETURNS trigger LANGUAGE plpgsql AS 'BEGIN RETURN NEW; END'",
        "CREATE TRIGGER sly AFTER INSERT ON records FOR EACH ROW EXECUTE FUNCTION mwdcal_refuse()",
        "DROP TRIGGER history_no_update ON history; CREATE TRIGGER history_no_update BEFORE UPDATE ON history "
        "FOR EACH STATEMENT WHEN (false) EXECUTE FUNCTION mwdcal_refuse()",
        "CREATE RULE lost AS ON INSERT TO tools DO INSTEAD NOTHING",
        "ALTER TABLE records ENABLE ROW LEVEL SECURITY",
        "ALTER TABLE history SET UNLOGGED",
        "ALTER TABLE history DROP CONSTRAINT history_pkey",
        "ALTER TABLE records ADD CONSTRAINT few CHECK (number < 1000)",
        "ALTER TABLE records ALTER COLUMN name SET DEFAULT 'none'",
        'ALTER TABLE tools ALTER COLUMN serial TYPE text COLLATE "default"',
        "CREATE TABLE part () INHERITS (records)",
        "DROP INDEX records_run; CREATE INDEX records_run ON records (run) WHERE kind = 'run'",
    ],
)
def test_a_changed_schema_of_postgresql_is_reported(postgresql, statement):
    changed = empty_database(postgresql)
    create(changed, "Ada")
    assert verdict(changed) == set()
    with closing(psycopg.connect(changed, autocommit=True)) as connection:
        connection.execute(statement)
    assert verdict(changed) == {"schema"}


@pytest.mark.parametrize("table", ["objects", "records", "withdrawals", "history"])
def test_triggers_of_postgresql_refuse_changes(postgresql, table):
    changed = empty_database(postgresql)
    create(changed, "Ada")
    with closing(psycopg.connect(changed, autocommit=True)) as connection:
        for statement in (
            f"UPDATE {table} SET number = 9",
            f"DELETE FROM {table}",
            f"TRUNCATE {table} CASCADE",
        ):
            with pytest.raises(psycopg.errors.RaiseException, match="only grows"):
                connection.execute(statement)
