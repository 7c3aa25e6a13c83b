"""A bench whose server, source or browser is ended at random moments: no accepted station is lost or doubled.

    python tests/bench_kills.py --count 200 --seed 1

The stand is a server behind TCP in this process, which goes where the page says. What the page has shown as accepted
must be in the journal after the kill, and each position once in run.csv.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import csv
import json
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

from bench_support import EARTH, BenchProcess, StandServer
from cli_support import EXAMPLE

KINDS = ("server", "server", "source", "browser")


def open_bench(folder, stand):
    return BenchProcess(
        *("--source", f"tcp:127.0.0.1:{stand.port}", "--tool", EXAMPLE / "tool.toml"),
        *("--plan", "acceptance-104", "--settle", "1.5"), folder=folder,
    )  # fmt: skip


def watch(bench, stand, seconds, columns):
    """Let the stand go where the page says; how many stations the page has shown."""
    shown, limit = 0, time.monotonic() + seconds
    while time.monotonic() < limit:
        position, shown = bench.order()
        if position is None:
            break
        names = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
        stand.order = tuple(columns[name][position] or 0.0 for name in names)
        time.sleep(0.03)
    return shown


def look_at_events(bench):
    """A browser that watches until it is closed."""
    with contextlib.suppress(Exception), bench.client.stream("GET", "/events") as stream:
        for _, _ in zip(range(5), stream.iter_lines(), strict=False):
            pass


def faults(folder, shown):
    """What is wrong with the folder after a kill."""
    lines = (folder / "session.jsonl").read_bytes().split(b"\n")[:-1]
    events = [json.loads(line) for line in lines]
    taken = [event for event in events if event["event"] == "station"]
    wrong = []
    if len(taken) < shown:
        wrong.append(f"lost: the page has shown {shown}, the journal has {len(taken)}")
    if len({event["position"] for event in taken}) < len(taken):
        wrong.append("a position is there twice")
    starts = [event["row"]["ax"] for event in taken]
    if len({*starts}) < len(starts):
        wrong.append("a standstill is there twice")
    return wrong, len(taken)


def rows_of(folder):
    if not (folder / "run.csv").exists():  # written beside the stream
        return []
    with (folder / "run.csv").open(encoding="utf-8") as stream:
        return [row["station"] for row in csv.DictReader(line for line in stream if line[0] != "#")]


def run(count, seed, folder):
    """Faults of so many kills; the session goes on after each, and a full one is followed by a new one."""
    dice, wrong, counts, number = random.Random(seed), [], collections.Counter(), 0
    stand, bench, path = StandServer(speed=40, seed=seed), None, folder / "S0"
    for index in range(count):
        if bench is None:
            bench = open_bench(path, stand)
            if "b-start" in bench.page():
                bench.do("start", serial="K-1", **{k: str(v) for k, v in EARTH.items()})
                bench.do("auto", on="on")
            else:
                bench.do("resume")
        first = json.loads((path / "session.jsonl").read_bytes().split(b"\n")[0])
        shown = watch(bench, stand, dice.uniform(0.05, 2.5), first["plan"]["columns"])
        kind = dice.choice(KINDS)
        counts[kind] += 1
        if kind == "server":
            bench.kill()
            bench = None
        elif kind == "source":
            stand.drop()
        else:
            threading.Thread(target=look_at_events, args=(bench,), daemon=True).start()
        found, total = faults(path, shown)
        wrong += [f"{index} {kind}: {each}" for each in found]
        if bench is not None and len(rows := rows_of(path)) != len({*rows}):
            wrong.append(f"{index} {kind}: a station is twice in run.csv")
        if total > 95:
            if bench is not None:
                bench.kill()
            number, bench = number + 1, None
            path = folder / f"S{number}"
    if bench is not None:
        bench.stop()
    stand.close()
    total = sum(
        b'"station"' in line and b'"event": "station"' in line
        for each in folder.glob("S*/session.jsonl") for line in each.read_bytes().splitlines()
    )  # fmt: skip
    print(f"{dict(counts)}: {total} stations accepted, {len(wrong)} faults", flush=True)
    return wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-kills-") as folder:
        wrong = run(given.count, given.seed, Path(folder))
    print("\n".join(wrong))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
