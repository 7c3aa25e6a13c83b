"""The registry's database: what goes in comes out, once, and is on the disk."""

import pytest

from mwdcal.registry import checking, copies, queries
from mwdcal.registry.setup import create
from mwdcal.registry.store import Entry, open_registry
from registry_support import calibration, registry_database

database = pytest.fixture(params=["sqlite", "postgresql"])(registry_database)


def test_what_is_added_comes_back_once(database):
    create(database, "Ada")
    entry = Entry("calibration", calibration("A-1"), "a.json")
    with open_registry(database) as registry:
        first, again = registry.add([entry], "Ada"), registry.add([entry], "Ben")
        assert [(a.new, a.number) for a in (*first, *again)] == [(True, 2), (False, 2)]
        assert registry.content(first[0].sha256) == entry.data
        assert queries.tools_page(registry).rows[0]["inclination_deg"] == 0.03
        assert checking.check(registry) == []


def test_a_backup_is_the_registry(database, tmp_path):
    create(database, "Ada")
    with open_registry(database) as registry:
        registry.add(
            [Entry("calibration", calibration(f"A-{i}"), "a.json") for i in range(5)], "Ada"
        )
        head = copies.backup(registry, tmp_path / "backup.registry")
        assert head == registry.head()[1]
    copies.restore(tmp_path / "backup.registry", tmp_path / "new.registry", "Ada")
    with open_registry(tmp_path / "new.registry") as registry:
        assert checking.check(registry, head=head) == []
        assert queries.counts(registry)["calibration"] == 5
