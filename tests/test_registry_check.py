"""`registry check`: whatever is changed, removed or added beside the program, it says so."""

import json
import random
import shutil
import sqlite3
from contextlib import closing

import pytest

from mwdcal.errors import InputError
from mwdcal.registry import checking
from mwdcal.registry.setup import create
from mwdcal.registry.store import Entry, open_registry
from registry_support import calibration

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


def tampered(path, rng):
    """Change something past the triggers, which are put back afterwards; what was done."""
    with closing(sqlite3.connect(path)) as connection:
        triggers = connection.execute(
            "SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"
        ).fetchall()
        while True:
            table, change = rng.choice(TABLES), rng.choice(CHANGES)
            connection.execute("BEGIN")
            for name, _ in triggers:
                connection.execute(f"DROP TRIGGER {name}")
            try:
                change(connection, table, rng)
            except sqlite3.IntegrityError:
                connection.rollback()
                continue
            for _, statement in triggers:
                connection.execute(statement)
            connection.commit()
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
