"""The registry: import, size, queries and check at 100 000 calibrations, in a SQLite file or in PostgreSQL.

    python benchmarks/registry.py [--calibrations 100000] [--database postgresql://…, an empty database]

Calibration files of 24 stations and 24 parameters, as `mwdcal fleet` writes them: a few hundred simulated tools are
calibrated, and their records repeated under other serials and dates, each sealed again, so that every file is one of
its own; their covariances, parameters and stations repeat, which matters to no query. Five calibrations of each tool.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from measuring import seconds

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.record import Calibration, with_checksum
from mwdcal.files.formats.members import RECORD
from mwdcal.files.profiles import load_profile
from mwdcal.planning.plans import drawn, load_plan
from mwdcal.planning.session import Session
from mwdcal.registry import checking, imports, lookup
from mwdcal.registry.store import Registry, create, open_registry

CALIBRATIONS, YEARS, SAMPLE, GROUP = 100_000, 5, 40, 1000
"""Calibrations in all, those of each tool, tools that are fitted, and rows of a row group."""
ROUNDS = 20
"""Runs of each query, on other tools where it is about one."""


def fitted(count: int) -> list[Calibration]:
    """Calibrations of simulated tools."""
    profile, rng = load_profile("servo")[0], np.random.default_rng(0)
    session = Session.of(load_plan("twenty-four-state"), profile)
    return [
        calibrate(session.measured(drawn(rng, profile, 0), rng).readings, profile, Options(order=0))
        for _ in range(count)
    ]


def tables(folder: Path, count: int) -> Iterator[Path]:
    """Tables of calibrations as `mwdcal fleet` writes them, one for each year."""
    sample = fitted(SAMPLE)
    for year in range(YEARS):
        path, tools = folder / f"{2022 + year}.parquet", count // YEARS
        schema = pa.schema(
            [(name, pa.string()) for name in ("serial", "status", "message", RECORD)]
        )
        with pq.ParquetWriter(path, schema) as writer:
            for first in range(0, tools, GROUP):
                serials = [f"B-{tool:06}" for tool in range(first, min(first + GROUP, tools))]
                whole = [
                    renamed(sample[i % SAMPLE], serial, 2022 + year)
                    for i, serial in enumerate(serials)
                ]
                texts = [[text] * len(serials) for text in ("ok", "")]
                writer.write_table(pa.table([serials, *texts, whole], schema=schema))
        yield path


def renamed(record: Calibration, serial: str, year: int) -> str:
    """The calibration as one of another tool and year."""
    about = {"serial": serial, "date": f"{year}-03-01", "simulated": "True"}
    time = f"{year}-03-01"
    changed = msgspec.structs.replace(record, tool=about, serial=serial, time=time)
    return msgspec.json.encode(with_checksum(changed)).decode()


def imported(registry: Registry, paths: list[Path], workers: int) -> None:
    """Add tables as `mwdcal registry add` does."""
    portions = imports.portions(imports.sources(paths))
    adding = imports.Adding(registry, "bench")
    imports.add_all(adding, portions, workers, lambda done, total: None)


def pages(registry: Registry, count: int) -> dict[str, Callable[[int], object]]:
    """What lists and pages ask, by name; each takes the number of its round."""
    tools = count // YEARS

    def serial(k: int) -> str:
        return f"B-{(7919 * k) % tools:06}"

    return {
        "tools, first page": lambda k: lookup.tools_page(registry),
        "tools, last page": lambda k: lookup.tools_page(registry, offset=tools - 50),
        "tools by day of calibration": lambda k: lookup.tools_page(
            registry, order="calibrated", descending=True
        ),
        "tools with a text in serial or type": lambda k: lookup.tools_page(
            registry, search=serial(k)[3:]
        ),
        "tools due": lambda k: lookup.tools_page(registry, due_before="2030-01-01"),
        "past of a tool": lambda k: lookup.past(registry, serial(k)),
        "latest calibration of a tool": lambda k: lookup.latest_calibration(registry, serial(k)),
        "all calibrations of a tool": lambda k: [*lookup.calibrations(registry, serial(k))],
        "calibrations, newest first": lambda k: lookup.records_page(registry, "calibration"),
        "history, newest events": lambda k: lookup.events(registry),
        "what is due": lambda k: lookup.listed(registry, None, "", "2030-01-01", 0, 50),
        "counts of everything": lambda k: lookup.counts(registry),
    }


def stored(registry: Registry) -> int:
    """Bytes of the database."""
    with registry.reading() as connection:
        if connection.dialect.name == "postgresql":
            query = "SELECT pg_database_size(current_database())"
        else:
            query = "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()"
        return int(connection.exec_driver_sql(query).scalar_one())


def report(count: int = CALIBRATIONS, database: str = "") -> str:
    """The section's figures as Markdown; `database`: an empty one in PostgreSQL, by default a SQLite file."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    with TemporaryDirectory() as place:
        folder, database = Path(place), database or str(Path(place) / "tools.sqlite")
        paths = [*tables(folder, count)]
        create(database, "bench")
        with open_registry(database) as registry:
            adding = seconds(partial(imported, registry, paths, cores))
        with open_registry(database) as registry:
            size = stored(registry)
            times = {
                name: [seconds(partial(page, k)) for k in range(ROUNDS)]
                for name, page in pages(registry, count).items()
            }
            problems: list[object] = []
            checking_time = seconds(lambda: problems.extend(checking.check(registry)))
        assert not problems, problems[:3]
    return shown(count, cores, adding, size, checking_time, times)


def spaced(count: int) -> str:
    """A count in groups of three digits."""
    return f"{count:,}".replace(",", " ")


def shown(
    count: int, cores: int, adding: float, size: int, checking_time: float, times: dict[str, list[float]]
) -> str:  # fmt: skip
    """The figures as Markdown."""
    lines = [
        f"- {spaced(count)} calibrations of {spaced(count // YEARS)} tools, {cores} cores",
        f"- import, every file checked as `apply` checks it: {adding:.0f} s, {count / adding:.0f} a second",
        f"- size: {size / 1e6:.0f} MB, {size / count / 1e3:.1f} kB for each calibration (54 kB as a file)",
        f"- check of every byte: {checking_time:.0f} s, {count / checking_time:.0f} calibrations a second",
        "",
        "| query | median, ms | slowest, ms |",
        "| --- | --- | --- |",
    ]
    for name, each in times.items():
        lines.append(f"| {name} | {1e3 * float(np.median(each)):.1f} | {1e3 * max(each):.1f} |")
    return "\n".join(lines)


def everywhere(count: int = CALIBRATIONS) -> str:
    """The figures of both databases as Markdown."""
    from registry_support import empty_database, postgresql_server

    with postgresql_server() as server:
        other = report(count, empty_database(server))
    return f"{report(count)}\n\nIn PostgreSQL, on the same machine:\n\n{other}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calibrations", type=int, default=CALIBRATIONS)
    parser.add_argument("--database", default="", help="URL of an empty PostgreSQL database")
    arguments = parser.parse_args()
    print(report(arguments.calibrations, arguments.database))
