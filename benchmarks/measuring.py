"""Times and peak memory of calls that take turns in one process, and the rows they make."""

from __future__ import annotations

import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

Call = Callable[[], object]
FEWEST, MOST = 3, 25
"""Rounds of a comparison."""
BUDGET = {"seconds": 4.0}
"""Time that a comparison may take; at least `FEWEST` rounds are made."""


LAUNCH = """
import os, subprocess, sys, time
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, used = os.wait4(process.pid, 0)
print(time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(status != 0)
"""
"""Starts a command from a small process: its peak memory begins with that of who starts it."""


class Used(NamedTuple):
    """Wall time and processor time of a command with the processes that it waits for, s; the largest memory, MB."""

    wall: float
    processor: float
    memory: float


def used_by(command: Sequence[str]) -> Used:
    """Time and memory of a command; ends the benchmark when it fails."""
    launched = [sys.executable, "-c", LAUNCH, *command]
    done = subprocess.run(launched, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr.strip()}")
    wall, processor, memory = map(float, done.stdout.split()[-3:])
    return Used(wall, processor, memory * (1.0 if sys.platform == "darwin" else 1024.0) / 1e6)


class Row(NamedTuple):
    """One comparison: ours and theirs in the unit, how many times better ours is, equal result.

    `memory`: largest memory that either allocates in Python and NumPy while it runs, MB.
    """

    name: str
    ours: float
    theirs: float
    ratio: float
    unit: str = "s"
    same: str = ""
    memory: tuple[float, float] | None = None


def seconds(call: Call) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def medians(calls: Mapping[str, Call]) -> dict[str, float]:
    """Median wall time of each call; calls take turns, after a round that does not count."""
    first = sum(seconds(call) for call in calls.values())
    count = int(np.clip(BUDGET["seconds"] / first, FEWEST, MOST))
    rounds = [[seconds(call) for call in calls.values()] for _ in range(count)]
    return dict(zip(calls, np.median(rounds, axis=0).tolist(), strict=True))


def peak(call: Call) -> float:
    """Largest memory that a call allocates in Python and NumPy, MB."""
    tracemalloc.start()
    call()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


def against(
    name: str, ours: Call, theirs: Mapping[str, Call], same: Mapping[str, str]
) -> list[Row]:
    """One row for each of theirs; all take turns. `same` says how equal the results are."""
    times = medians({"": ours, **theirs})
    mine = peak(ours)
    return [
        Row(
            f"{name}; {other}",
            times[""],
            times[other],
            times[other] / times[""],
            "s",
            same[other],
            (mine, peak(call)),
        )
        for other, call in theirs.items()
    ]
