"""Many writers of one registry, some of them killed: what was acknowledged must be there.

    python tests/registry_stress.py --writers 50 --seconds 60 --kills 100 --databases sqlite,postgresql

Each writer is a process that adds one file after the other, some together, and notes in a file of its
own what was acknowledged. Writers get a KILL at random moments and are replaced. Of PostgreSQL the
processes that serve writers are killed as well, by which the server stops and recovers.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import sqlalchemy as sa

from mwdcal.errors import InputError
from mwdcal.registry import checking, lookup
from mwdcal.registry.database.models import records
from mwdcal.registry.store import Entry, create, open_registry
from registry_support import calibration, empty_database, postgresql_server

SERIALS = 40


def write_on(database: str, log: str, writer: int, end: str) -> None:
    """Add files until the file `end` exists, and note each acknowledged call: SHA-256 of its files, one line."""
    rng, count = random.Random(writer), 0
    with open(log, "ab", buffering=0) as acknowledged:
        while not os.path.exists(end):
            try:
                with open_registry(database) as registry:
                    while not os.path.exists(end):
                        files = []
                        for _ in range(rng.choice([1, 1, 1, 5])):
                            count += 1
                            data = calibration(
                                f"T-{rng.randrange(SERIALS)}", writer=writer, count=count
                            )
                            files.append(Entry("calibration", data, f"{writer}-{count}.json"))
                        added = registry.add(files, f"writer {writer}")
                        acknowledged.write((json.dumps([a.sha256 for a in added]) + "\n").encode())
            except (
                InputError
            ) as error:  # a server that recovers, or a process of it that was killed
                acknowledged.write((json.dumps(str(error)) + "\n").encode())
                time.sleep(0.2)


def writers_context() -> multiprocessing.context.ForkServerContext:
    """Processes that have imported what a writer needs, which takes seconds, before they begin."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["registry_stress"])
    return context


def stressed(
    database: str, folder: Path, writers: int, seconds: float, kills: int, seed: int = 1
) -> tuple[list[list[str]], Counter[str]]:
    """What was acknowledged to writers, by call, and how often they were killed or refused."""
    rng, context = random.Random(seed), writers_context()
    end, events = folder / "end", Counter[str]()

    def started(number: int):
        arguments = (database, str(folder / f"{number}.log"), number, str(end))
        process = context.Process(target=write_on, args=arguments)
        process.start()
        return process

    running = [started(number) for number in range(writers)]
    number = writers
    while not any(log.stat().st_size for log in folder.glob("*.log")):
        time.sleep(0.02)  # until the first has begun: a process takes seconds on a busy machine
    begun = time.time()
    for kill in range(kills):
        time.sleep(max(0.0, begun + (kill + rng.random()) * seconds / (kills + 1) - time.time()))
        served = backends(database) if kill % 25 == 12 else []
        if served:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(rng.choice(served), signal.SIGKILL)
                events["server processes killed"] += 1
            continue
        at = rng.randrange(writers)
        if running[at].is_alive():
            events["writers killed"] += 1
            os.kill(running[at].pid, signal.SIGKILL)
        running[at].join()
        running[at] = started(number)
        number += 1
    time.sleep(max(0.0, begun + seconds - time.time()))
    end.touch()
    for process in running:
        process.join(120)
        events[f"exit status {process.exitcode}"] += 1
    return acknowledged_in(folder, events), events


def acknowledged_in(folder: Path, events: Counter[str]) -> list[list[str]]:
    """What the logs of the writers note; a last line that was cut off by a kill is not acknowledged."""
    calls = []
    for log in folder.glob("*.log"):
        for line in log.read_bytes().split(b"\n")[:-1]:
            noted = json.loads(line)
            if isinstance(noted, str):
                events[f"refused: {noted.partition(': ')[2][:60]}"] += 1
            else:
                calls.append(noted)
    return calls


def backends(database: str) -> list[int]:
    """Numbers of the server's processes that serve writers; none of SQLite, or while it recovers."""
    if "://" not in database:
        return []
    engine = sa.create_engine(sa.make_url(database).set(drivername="postgresql+psycopg"))
    query = sa.text(
        "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    )
    try:
        with engine.connect() as connection:
            return list(connection.scalars(query))
    except sa.exc.OperationalError:
        return []
    finally:
        engine.dispose()


def losses(database: str, calls: list[list[str]]) -> dict[str, object]:
    """What is wrong with the registry afterwards."""
    for _ in range(120):  # of a server that recovers
        try:
            with open_registry(database):
                break
        except InputError:
            time.sleep(0.5)
    with open_registry(database) as registry:
        with registry.reading() as connection:
            kept = set(connection.scalars(sa.select(records.c.sha256)))
        return {
            "lost": [sha for call in calls for sha in call if sha not in kept],
            "discrepancies": checking.check(registry),
            "records": lookup.counts(registry).get("calibration", 0),
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--writers", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--databases", default="sqlite,postgresql")
    options = parser.parse_args()
    bad = 0
    for kind in options.databases.split(","):
        with tempfile.TemporaryDirectory() as name:
            if kind == "sqlite":
                bad += reported(kind, str(Path(name) / "stress.registry"), Path(name), options)
            else:
                with postgresql_server() as server:
                    bad += reported(kind, empty_database(server), Path(name), options)
    return bad


def reported(kind: str, database: str, folder: Path, options: argparse.Namespace) -> bool:
    """Print what became of one registry; whether anything is wrong."""
    create(database, "stress")
    calls, events = stressed(
        database, folder, options.writers, options.seconds, options.kills, options.seed
    )
    begun = time.time()
    after = losses(database, calls)
    print(
        f"{kind}: {options.writers} writers, {options.seconds:g} s: {len(calls)} calls acknowledged "
        f"with {sum(map(len, calls))} files; {after['records']} records; "
        f"lost {len(after['lost'])}; discrepancies {len(after['discrepancies'])} "
        f"(checked in {time.time() - begun:.1f} s)"
    )
    for what, count in sorted(events.items()):
        print(f"  {count} × {what}")
    for each in (*after["lost"][:5], *after["discrepancies"][:5]):
        print(f"  WRONG: {each}")
    return bool(after["lost"] or after["discrepancies"])


if __name__ == "__main__":
    sys.exit(main())
