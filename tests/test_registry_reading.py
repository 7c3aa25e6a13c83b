"""Documents that leave a registry are those that were added, or are refused, whatever was changed in it."""

import sqlite3
import zlib
from contextlib import closing, suppress

import psycopg
import pytest
import sqlalchemy as sa

from mwdcal.errors import MwdcalError
from mwdcal.registry import exports, lookup, stored
from mwdcal.registry.database import models
from mwdcal.registry.store import Entry, create, open_registry
from registry_support import calibration, drop_database, empty_database
from test_registry_check import PostgresqlTables, sound, without_triggers

LATEST = 13
"""Number of the latest calibration of the tool A-1."""


def answers(database, folder):
    """What each question gets for an answer: bytes with what is said of them, or that it is refused."""
    questions = {
        "serial": lambda registry: lookup.document(registry, "A-1"),
        "latest": lambda registry: lookup.latest_file(registry, "A-1").record,
        "drift": lambda registry: [*lookup.calibrations(registry, "A-1")],
        "export": lambda registry: exported(registry, folder),
        **{
            f"record {n}": lambda registry, n=n: lookup.numbered(registry, n)
            for n in (2, 7, 10, 13, 14)
        },
    }
    result = dict.fromkeys(questions, "refused")
    with suppress(MwdcalError), open_registry(database) as registry:
        for name, question in questions.items():
            with suppress(MwdcalError):
                result[name] = question(registry)
    return result


def exported(registry, folder):
    """The files of an export, by name."""
    out = folder / f"out{len([*folder.iterdir()])}"
    exports.export(registry, out)
    return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}


def tamperings():
    """Statements, by name: each value of the rows that belong to a calibration, whole rows, and what hides another."""
    keys = {"tools": "serial = 'A-1'", "withdrawals": "number = 16"}
    for table in (*models.GUARDED, models.tools):
        where = keys.get(table.name, f"number = {LATEST}")
        for column in table.columns:
            kind = column.type.python_type
            value = {str: f"'x' || coalesce({column.name}, '')", bytes: None}.get(
                kind, f"coalesce({column.name}, 0) + 1000"
            )
            if value:
                yield (
                    f"{table.name}.{column.name}",
                    f"UPDATE {table.name} SET {column.name} = {value} WHERE {where}",
                )
        yield f"{table.name} without a row", f"DELETE FROM {table.name} WHERE {where}"
    of = "SELECT {} FROM objects WHERE number = 11"
    yield (
        "bytes of another",
        f"UPDATE objects SET data = ({of.format('data')}), size = ({of.format('size')}) "
        f"WHERE number = {LATEST}",
    )
    yield "bytes without the last", f"UPDATE objects SET size = size - 1 WHERE number = {LATEST}"
    yield (
        "record of another object",
        f"UPDATE records SET sha256 = (SELECT sha256 FROM records WHERE number = 8) WHERE number = {LATEST}",
    )
    yield "older as latest", "UPDATE tools SET latest = 10 WHERE serial = 'A-1'"
    yield (
        "withdrawal of another",
        f"INSERT INTO withdrawals (number, record, reason) VALUES (17, {LATEST}, 'none')",
    )


TAMPERINGS = dict(tamperings())


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def original(request, tmp_path_factory):
    """A registry, what it answers, and a way to change a copy of it past its triggers."""
    folder = tmp_path_factory.mktemp("original")
    if request.param == "sqlite":
        path = sound(folder / "original.registry")
        data = path.read_bytes()

        def changed(statement, *values):
            copy = folder / "changed.registry"
            copy.write_bytes(data)
            with closing(sqlite3.connect(copy)) as connection, without_triggers(connection):
                connection.execute(statement, values)
            return copy

        yield path, answers(path, folder), changed, lambda copy: None
        return
    server = request.getfixturevalue("postgresql")
    url = sound(empty_database(server))
    template = sa.make_url(url).database

    def changed(statement, *values):
        copy = empty_database(server, template)
        with closing(PostgresqlTables(copy).connection) as connection:
            connection.execute(statement.replace("?", "%s"), values or None)
            connection.commit()
        return copy

    yield url, answers(url, folder), changed, lambda copy: drop_database(server, copy)


@pytest.mark.parametrize("name", TAMPERINGS)
def test_what_was_tampered_with_is_refused_when_it_is_read(original, tmp_path, name):
    _, right, changed, drop = original
    assert "refused" not in {key: a for key, a in right.items() if key in ("serial", "export")}
    copy = changed(TAMPERINGS[name])
    got = answers(copy, tmp_path)
    drop(copy)
    wrong = [key for key, answer in got.items() if answer not in (right[key], "refused")]
    assert wrong == []
    assert got["serial"] == got["latest"] == "refused"
    assert got["export"] == "refused" or name.startswith(("tools", "older"))


@pytest.mark.parametrize("bit", [3, 700, -5])
def test_a_bit_of_the_bytes_stored_is_noticed_when_they_are_read(original, tmp_path, bit):
    url, _, changed, drop = original
    with open_registry(url) as registry, registry.reading() as connection:
        query = sa.select(models.objects.c.data).where(models.objects.c.number == LATEST)
        data = bytearray(connection.scalar(query))
    data[bit % len(data)] ^= 1
    copy = changed(f"UPDATE objects SET data = ? WHERE number = {LATEST}", bytes(data))
    with open_registry(copy) as registry, pytest.raises(stored.AlteredError, match="restore it"):
        lookup.document(registry, "A-1")
    drop(copy)


def test_a_file_that_would_unpack_to_far_more_is_refused_and_never_stored_so(monkeypatch):
    monkeypatch.setattr(stored, "UNSUSPICIOUS", 10_000)
    zeros = bytes(1_000_000)
    address = stored.content_address(zeros)
    with pytest.raises(stored.AlteredError, match="damaged"):
        stored.unpacked(zlib.compress(zeros, 9), len(zeros), address)
    assert stored.unpacked(stored.packed(zeros), len(zeros), address) == zeros


COMPUTED = {
    "sqlite": [
        "ALTER TABLE {0} RENAME TO {0}0; CREATE VIEW {0} AS SELECT * FROM {0}0",
        "CREATE VIRTUAL TABLE more USING fts5(x)",
        "ALTER TABLE {0} ADD COLUMN more BLOB GENERATED ALWAYS AS (zeroblob(300000000))",
    ],
    "postgresql": [
        "ALTER TABLE {0} RENAME TO {0}0; CREATE VIEW {0} AS SELECT * FROM {0}0",
        "ALTER TABLE {0} ADD COLUMN more INTEGER GENERATED ALWAYS AS (1 + 1) STORED",
    ],
}


@pytest.mark.parametrize("table", [t.name for t in models.metadata.sorted_tables])
@pytest.mark.parametrize("dialect", COMPUTED)
def test_tables_that_compute_what_they_hold_are_refused(request, tmp_path, dialect, table):
    for number, statement in enumerate(COMPUTED[dialect]):
        if dialect == "sqlite":
            database = tmp_path / f"{number}.registry"
            create(database, "Ada")
            with closing(sqlite3.connect(database)) as connection:
                connection.executescript("PRAGMA legacy_alter_table=ON;" + statement.format(table))
        else:
            database = empty_database(request.getfixturevalue("postgresql"))
            create(database, "Ada")
            with closing(psycopg.connect(database, autocommit=True)) as connection:
                connection.execute(statement.format(table))
        with pytest.raises(MwdcalError, match="computes its values"), open_registry(database):
            pass


SPELLINGS = {
    "ÄB-7": ("ÄB", "äb-7", "A\u0308b"),
    "ΩΜ-3": ("ωμ", "ΩΜ-3"),
    "A\u0308C-1": ("äc", "ÄC-1"),
    "straße 1": ("STRAßE", "STRA\u1e9eE"),
    "Σας": ("ΣΑΣ", "σασ"),
    "A.9%_[1]": ("a.9%", "%_[", "[1]"),
}


@pytest.mark.parametrize("dialect", ["sqlite", "postgresql"])
def test_tools_are_found_in_any_case_and_form_of_their_letters(request, tmp_path, dialect):
    database = tmp_path / "tools.registry"
    if dialect == "postgresql":
        options = "template0 LOCALE 'C' ENCODING 'UTF8'"
        database = empty_database(request.getfixturevalue("postgresql"), options)
    create(database, "Ada")
    with open_registry(database) as registry:
        registry.add([Entry("calibration", calibration(s), "a.json") for s in SPELLINGS], "Ada")
        for serial, words in SPELLINGS.items():
            for word in words:
                found = [row["serial"] for row in lookup.tools_page(registry, word).rows]
                assert found == [serial], word
        assert lookup.tools_page(registry, "servo").total == len(SPELLINGS)  # by type
        assert lookup.tools_page(registry, ".*").total == 0
