"""Times what lists and pages ask of a registry with many calibrations (small ones).

python tests/registry_queries.py --calibrations 100000 --databases sqlite,postgresql
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import sqlalchemy as sa

from mwdcal.registry import checking, exports, lookup
from mwdcal.registry.store import Entry, Registry, create, open_registry
from registry_support import calibration, empty_database, postgresql_server

PER_TOOL = 5
ALLOWED = 0.1
"""Seconds that a page's query may take."""


def files(count: int) -> Iterator[Entry]:
    """Yearly calibrations of tools, the newest of each with a certificate; a few standards."""
    for tool in range(count // PER_TOOL):
        serial, kind = f"T-{tool * 7919 % 100_003:06d}", f"type {tool % 9}"
        for year in range(PER_TOOL):
            time_of = f"{2021 + year}-{1 + tool % 12:02d}-{1 + tool % 28:02d}T08:00:00Z"
            data = calibration(serial, time_of, profile={"name": kind})
            yield Entry("calibration", data, f"{serial}-{year}.json")
        fields = {
            "serial": serial,
            "number": f"C-{tool}",
            "issued": time_of[:10],
            "next_due": f"2026-{1 + tool % 12:02d}-{1 + tool % 28:02d}",
            "item": {"serial": serial, "type": kind},
        }
        yield Entry("certificate", json.dumps(fields).encode(), f"{serial}.certificate.json")
    for number in range(50):
        fields = {
            "quantity": "stand",
            "name": f"Stand {number}",
            "due": f"2026-{1 + number % 12:02d}-01",
        }
        yield Entry("standard", json.dumps(fields).encode(), f"stand-{number}.json")


def pages(registry: Registry, tools: int) -> dict[str, Callable[[], object]]:
    """The queries of every page, the dearest of each."""
    serial = lookup.tools_page(registry, offset=tools // 2, limit=1).rows[0]["serial"]
    return {
        "tools, first page": lambda: lookup.tools_page(registry),
        "tools, last page": lambda: lookup.tools_page(registry, offset=tools - 50),
        "tools, search": lambda: lookup.tools_page(registry, search="99"),
        "tools, of a type": lambda: lookup.tools_page(registry, where={"type": "type 3"}),
        **{
            f"tools, by {name}": lambda name=name: lookup.tools_page(
                registry, order=name, descending=True, offset=tools // 2
            )
            for name in lookup.TOOL_ORDERS
        },
        "tools, overdue": lambda: lookup.tools_page(
            registry, due_before="2026-06-30", order="next_due"
        ),
        "past of a tool": lambda: lookup.past(registry, serial),
        "calibrations of a tool": lambda: list(lookup.calibrations(registry, serial)),
        "latest calibration": lambda: lookup.latest_calibration(registry, serial),
        "calibrations, newest": lambda: lookup.records_page(registry, "calibration"),
        "calibrations, half way": lambda: lookup.records_page(
            registry, "calibration", offset=tools * PER_TOOL // 2
        ),
        "calibrations, oldest": lambda: lookup.records_page(
            registry, "calibration", newest_first=False
        ),
        "due": lambda: lookup.listed(registry, None, "", "2026-12-31", 0, 50),
        "history": lambda: lookup.events(registry),
        "history, half way": lambda: lookup.events(registry, offset=tools * PER_TOOL // 2),
        "counts": lambda: lookup.counts(registry),
    }


def timed(database: Path | str, folder: Path, count: int, brief: bool) -> bool:
    """Fill a registry and print what everything takes; whether a query takes too long."""
    create(database, "queries")
    begun, entries, added = time.perf_counter(), files(count), 0
    with open_registry(database) as registry:
        while portion := list(islice(entries, 1000)):
            added += len(registry.add(portion, "queries"))
        rate = added / (time.perf_counter() - begun)
        print(f"{count} calibrations, {added} records, {rate:.0f} per second")
        if registry.database.file is None:  # as the server does by itself within a minute
            with registry.database.engine.connect() as plain:
                plain.execution_options(isolation_level="AUTOCOMMIT").execute(
                    sa.text("VACUUM ANALYZE")
                )
        slow = False
        for name, query in pages(registry, count // PER_TOOL).items():
            seconds = []
            for _ in range(7):
                begun = time.perf_counter()
                query()
                seconds.append(time.perf_counter() - begun)
            slow |= statistics.median(seconds) > ALLOWED
            print(
                f"  {name:26s} median {statistics.median(seconds) * 1e3:6.1f} ms, "
                f"largest {max(seconds) * 1e3:6.1f} ms"
            )
        for name, task in (
            ()
            if brief
            else (
                ("check", lambda: checking.check(registry)),
                ("backup", lambda: exports.backup(registry, folder / "backup.registry")),
            )
        ):
            begun = time.perf_counter()
            result = task()
            print(f"  {name:26s} {time.perf_counter() - begun:.1f} s {result!r:.80}")
    if not brief:
        size = (folder / "backup.registry").stat().st_size
        print(f"  size of the backup         {size / 1e6:.0f} MB")
    return slow


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calibrations", type=int, default=100_000)
    parser.add_argument("--databases", default="sqlite,postgresql")
    parser.add_argument("--brief", action="store_true", help="without check and backup")
    options = parser.parse_args()
    slow = False
    for kind in options.databases.split(","):
        print(kind)
        with tempfile.TemporaryDirectory() as name:
            if kind == "sqlite":
                slow |= timed(
                    Path(name) / "many.registry", Path(name), options.calibrations, options.brief
                )
            else:
                with postgresql_server() as server:
                    slow |= timed(
                        empty_database(server), Path(name), options.calibrations, options.brief
                    )
    return slow


if __name__ == "__main__":
    sys.exit(main())
