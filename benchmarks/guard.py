"""Compares the processor time of what users wait for with that of a reference, and with the last release.

Each path is divided by a reference that runs beside it: a bare import, a loop of SciPy, NumPy reading the same
bytes. The ratio hardly depends on the machine, so it can be stored (`guard.json`) and compared: a path that takes more
than a third longer than it did, in every one of some tries, has lost its speed unnoticed.

    python benchmarks/guard.py            # compare; exit status 1 and the names of the paths that lost
    python benchmarks/guard.py --keep     # measure anew and store the ratios
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import fleet
import numpy as np

MWDCAL = Path(sys.executable).with_name("mwdcal")
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "servo"
STORED = Path(__file__).with_name("guard.json")
LOST = 4 / 3
"""A path has lost if its ratio is this many times the stored one…"""
TRIES = 4
"""…in each of so many tries."""
DEEPEST = 15_000.0
"""Measured depth of the longest well, m."""
TOOLS, SAMPLE = 200, 20
"""Tools of the fleets, and of the loop of SciPy that they are compared with."""

Call = Callable[[], object]


class Guarded(NamedTuple):
    """A path whose speed is guarded, and the reference that runs beside it."""

    name: str
    beside: str
    theirs: Call
    ours: Call


def processor_seconds(call: Call) -> float:
    """Processor time of a call, and of the processes that it starts."""
    before = _used()
    call()
    return _used() - before


def _used() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def command(*words: object) -> None:
    """Run a command; stops everything where it fails."""
    done = subprocess.run(
        [str(MWDCAL), *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(
            f"mwdcal {' '.join(map(str, words))} ended with {done.returncode}:\n{done.stderr.strip()}"
        )


def python(script: str) -> None:
    """Run a script in a process of its own."""
    subprocess.run([sys.executable, "-c", script], check=True)


def read_numbers(path: Path) -> None:
    """Read the numbers of a text table with NumPy: what a script would do first."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    np.loadtxt(lines[1:], delimiter=",", usecols=range(1, lines[0].count(",")))


def longer(source: Path, target: Path, rows: int) -> Path:
    """The table of an example over and over, its first column counted on: a long one of the same kind."""
    lines = source.read_text().splitlines()
    stated = [line for line in lines if line.startswith("#")]
    head, *cells = (line for line in lines if not line.startswith("#"))
    step = float(cells[1].split(",")[0]) - float(cells[0].split(",")[0])
    step = min(step, DEEPEST / rows) if head.startswith("md_m") else step
    rest = [cell.partition(",")[2] for cell in cells]
    body = (f"{i * step:.6f},{rest[i % len(rest)]}" for i in range(rows))
    target.write_text("\n".join([*stated, head, *body, ""]))
    return target


def without_noise(path: Path, stand: bool) -> Path:
    """The profile of the example that declares no noise, and with its `stand` or as if that were exact."""
    text = (EXAMPLE / "tool.toml").read_text()
    lines = (text if stand else text.partition("[stand]")[0]).splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("noise")) + "\n")
    return path


def roll_groups(times: int) -> None:
    """Calibrate 24 shots, two roll groups of eight among them, again and again."""
    import mwdcal

    run = mwdcal.simulate((20, 70, 110), 8, seed=1)
    group = np.repeat([0, 1, -1], 8)
    known = {name: run.known[name] for name in ("gravity", "field", "dip")}
    run = replace(run, known=known, group=group)
    for _ in range(times):
        mwdcal.calibrate(run)


def paths(folder: Path) -> list[Guarded]:
    """All that is guarded, with its inputs written into a folder."""
    runs, tool = folder / "runs.parquet", folder / "tool.json"
    fleet.simulate(runs, TOOLS)
    declared = EXAMPLE / "tool.toml"
    undeclared, exact = (
        without_noise(folder / f"{n}.toml", n == "stand") for n in ("stand", "exact")
    )
    calibrate = ("calibrate", EXAMPLE / "run.csv", "--tool", declared, "-o")
    command(*calibrate, tool)
    scipy = "SciPy, a loop over the tools", partial(fleet.scipy_seconds, SAMPLE)
    imports = "import numpy, scipy.special", partial(python, "import numpy, scipy.special")

    def fleets(name: str, profile: object) -> Guarded:
        words = ("fleet", runs, "--tool", profile, "--no-records", "--workers", "1")
        target = folder / f"{len(list(folder.iterdir()))}.parquet"
        return Guarded(f"fleet, {name}", *scipy, partial(command, *words, "-o", target))

    def long(words: tuple[object, ...], source: str, rows: int) -> Guarded:
        path = longer(EXAMPLE / source, folder / source, rows)
        ours = partial(command, words[0], *(path if word is source else word for word in words[1:]))
        return Guarded(
            f"{words[0]}, {rows} rows",
            "NumPy, reading the numbers",
            partial(read_numbers, path),
            ours,
        )

    return [
        Guarded(
            "calibrate, 48 stations", *imports, partial(command, *calibrate, folder / "again.json")
        ),
        Guarded("calibrate, two roll groups", *scipy, partial(roll_groups, 10)),
        fleets("noise undeclared", exact),
        fleets("stand and noise declared", declared),
        fleets("stand declared, noise not", undeclared),
        long(("apply", tool, "surveys.csv", "-o", folder / "applied.csv"), "surveys.csv", 100_000),
        long(("survey", tool, "well.csv", "-o", folder / "surveyed.csv"), "well.csv", 20_000),
        long(("noise", "static.csv"), "static.csv", 200_000),
        long(("stations", "log.csv", "-o", folder / "stations.csv"), "log.csv", 100_000),
    ]


def ratio(guarded: Guarded) -> float:
    """Processor time over that of the reference, the least of two turns each."""
    turns = [(processor_seconds(guarded.ours), processor_seconds(guarded.theirs)) for _ in range(2)]
    ours, theirs = (min(each) for each in zip(*turns, strict=True))
    return ours / theirs


def main() -> None:
    """Measure, and compare with what is stored or store it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="store the ratios that are measured")
    keep = parser.parse_args().keep
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every command compiles itself anew
    stored: dict[str, float] = json.loads(STORED.read_text()) if STORED.exists() else {}
    measured, lost = {}, []
    with TemporaryDirectory() as folder:
        for guarded in paths(Path(folder)):
            limit = LOST * stored.get(guarded.name, np.inf)
            found = ratio(guarded)
            for _ in range(0 if keep else TRIES - 1):
                if found <= limit:
                    break
                found = min(found, ratio(guarded))
            measured[guarded.name] = float(f"{found:.3g}")
            before = stored.get(guarded.name)
            verdict = "new" if before is None else "LOST" if found > limit else "ok"
            lost += [guarded.name] if verdict == "LOST" else []
            print(
                f"{guarded.name:28} {found:7.3g} x {guarded.beside:30} stored {before or 0:7.3g}  {verdict}",
                flush=True,
            )
    if keep:
        STORED.write_text(json.dumps(measured, indent=1) + "\n")
    elif lost:
        sys.exit(f"more than a third slower than stored in {STORED.name}: {', '.join(lost)}")


if __name__ == "__main__":
    main()
