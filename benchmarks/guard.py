"""Compares the processor time of what users wait for with that of a reference, and with the last release.

Each path is divided by a reference that runs beside it: a bare import, a loop of SciPy, NumPy reading the same
text. Path and reference take turns in one process, some tens of times, so that a machine which is busy slows both. The
ratio hardly depends on the machine, so it can be stored (`guard.json`) and compared: a path that takes more than a
third longer than it did, in every one of some tries, has lost its speed unnoticed.

    python benchmarks/guard.py            # compare; exit status 1 and the names of the paths that lost
    python benchmarks/guard.py --keep     # measure anew and store the ratios
    python benchmarks/guard.py fleet      # only paths with this word in their name
    python benchmarks/guard.py --stored before.json --keep    # the same with another file of ratios

With PYTHONPATH it takes the sources of another commit (docs/evidence/benchmarks.md shows one that it fails on).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

import apply
import fleet
import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq

import mwdcal
from mwdcal.app import cli
from mwdcal.files import documents

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "servo"
STORED = Path(__file__).with_name("guard.json")
LOST = 4 / 3
"""A path has lost if its ratio is more than this many times the stored one…"""
TRIES = 4
"""…in each of so many tries."""
SECONDS = 2.0
"""Processor time of a try, about."""
MORE = (1, 25)
"""Fewest and most turns of a try after its first."""
DEEPEST = 15_000.0
"""Measured depth of the longest well, m."""
TOOLS, SAMPLE = 1000, 10
"""Tools of the fleets, and of the loop of SciPy that they are compared with."""
MANY = 4000
"""Tools of a fleet whose parts are as large as those of the largest are at least."""
PARQUET_ROWS = 300_000
"""Rows of the table from Parquet to Parquet."""
WARM = 4
"""Tools of the fleet whose temperature orders are chosen."""
IMPORTS = "import numpy, scipy.special"

Call = Callable[[], object]


class Guarded(NamedTuple):
    """A path whose speed is guarded, and the reference that runs beside it."""

    name: str
    beside: str
    theirs: Call
    ours: Call


# ------------------------------------------------------------------ time


def processor_seconds(call: Call) -> float:
    """Processor time of a call, and of the processes that it starts."""
    before = _used()
    call()
    return _used() - before


def _used() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def ratio(guarded: Guarded) -> float:
    """Processor time over that of the reference: the least of either, or the median of neighbours, whichever is less.

    Both rise if a path is slower. A disturbance that lasts raises the least times, a short one the median.
    """
    turns = [_turn(guarded)]  # also warms up
    turns += [_turn(guarded) for _ in range(int(np.clip(SECONDS / sum(turns[0]), *MORE)))]
    ours, theirs = zip(*turns, strict=True)
    return min(min(ours) / min(theirs), median(mine / other for mine, other in turns))


def _turn(guarded: Guarded) -> tuple[float, float]:
    return processor_seconds(guarded.ours), processor_seconds(guarded.theirs)


def judged(guarded: Guarded, most: float, tries: int) -> float:
    """The ratio; measured again while it is above the most that counts as kept."""
    found = ratio(guarded)
    for _ in range(tries - 1):
        if found <= most:
            break
        found = min(found, ratio(guarded))
    return float(f"{found:.3g}")


# ------------------------------------------------------------------ calls


def command(*words: object) -> None:
    """Run a command in this process; stops everything where it fails."""
    typed, out, err = [*map(str, words)], io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(typed)
            code: object = 0
        except SystemExit as end:
            code = end.code
    if code:
        sys.exit(f"mwdcal {' '.join(typed)} ended with {code}:\n{err.getvalue().strip()}")


def python(*words: object) -> None:
    """Run Python in a process of its own."""
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"python {' '.join(map(str, words))}:\n{done.stderr.strip()}")


def read_numbers(path: Path) -> None:
    """Read the numbers of a text table with NumPy: what a script would do first."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    np.loadtxt(lines[1:], delimiter=",", usecols=range(1, lines[0].count(",")))


def draw() -> None:
    """Draw one picture with Matplotlib."""
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    for axes in figure.subplots(2, 2).flat:
        axes.plot(np.arange(50.0), label="a line")
        axes.legend()
    figure.savefig(io.BytesIO(), format="svg")


# ------------------------------------------------------------------ inputs


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


def warm(folder: Path) -> Path:
    """Runs of some tools at several temperatures, whose sixty factors vary with them."""
    folder.mkdir()
    for seed in range(WARM):
        words = ("--plan", "moosavi-12", "--tool", "servo", "--seed", seed)
        command("simulate", *words, "-o", folder / f"{seed}.csv")
    return folder


def roll_groups() -> mwdcal.Readings:
    """Readings of 24 shots, two roll groups of eight among them."""
    run = mwdcal.simulate((20, 70, 110), 8, seed=1)
    known = {name: run.known[name] for name in ("gravity", "field", "dip")}
    return replace(run, known=known, group=np.repeat([0, 1, -1], 8))


def dated(source: Path, target: Path, day: str) -> Path:
    """The runs of a fleet as those of a day."""
    stated = {"mwdcal": json.dumps({"date": day})}
    pq.write_table(pq.read_table(source).replace_schema_metadata(stated), target)
    return target


# ------------------------------------------------------------------ paths


def singles(folder: Path) -> Iterator[Guarded]:
    """One tool: a command from its start, fits, a page."""
    run, declared, undeclared = EXAMPLE / "run.csv", EXAMPLE / "tool.toml", folder / "bare.toml"
    without_noise(undeclared, stand=True)
    fit = ("calibrate", run, "-o", folder / "again.json", "--tool")
    start = partial(python, "-m", "mwdcal", *fit, declared)
    yield Guarded("calibrate, from the start", IMPORTS, partial(python, "-c", IMPORTS), start)
    loop = "SciPy, one tool", partial(fleet.scipy_seconds, 1)
    for name, profile in (("default options", "servo"), ("stand declared", undeclared)):
        yield Guarded(f"calibrate, {name}", *loop, partial(command, *fit, profile))
    yield Guarded("calibrate, two roll groups", *loop, partial(mwdcal.calibrate, roll_groups()))
    page = partial(command, *fit, declared, "--report", folder / "again.html")
    yield Guarded("calibrate, a page", "Matplotlib, four panels", draw, page)


def fleets(folder: Path) -> Iterator[Guarded]:
    """Many tools: Parquet and text, noise and stand declared or not, with records."""
    runs, few, text = (folder / name for name in ("runs.parquet", "few.parquet", "few.csv"))
    fleet.simulate(runs, TOOLS)
    fleet.simulate(few, SAMPLE)
    pyarrow.csv.write_csv(pq.read_table(few), text)
    loop = f"SciPy, {SAMPLE} tools", partial(fleet.scipy_seconds, SAMPLE)
    declared = EXAMPLE / "tool.toml"
    undeclared, bare = (
        without_noise(folder / f"{n}.toml", n == "stand") for n in ("stand", "bare")
    )
    for name, table, profile, *options in (
        ("exact stand", runs, "servo", "--no-records", "--method", "least-squares"),
        ("noise undeclared", runs, bare, "--no-records"),
        ("stand and noise declared", runs, declared, "--no-records"),
        ("stand declared, noise not", runs, undeclared, "--no-records"),
        ("a text table", text, "servo", "--no-records"),
        ("with records", few, "servo"),
        ("orders auto", warm(folder / "warm"), declared, "--no-records", "--order", "auto"),
    ):
        words = ("fleet", table, "--tool", profile, "--workers", "1", *options)
        target = folder / f"{len([*folder.iterdir()])}.parquet"
        yield Guarded(f"fleet, {name}", *loop, partial(command, *words, "-o", target))
    many = folder / "many.parquet"
    fleet.simulate(many, MANY)
    words = ("fleet", many, "--tool", bare, "--workers", "1", "--no-records")
    whole = partial(python, "-m", "mwdcal", *words, "-o", folder / "many-out.parquet")
    yield Guarded(f"fleet, {MANY} tools from the start", *loop, whole)


def registries(folder: Path) -> Iterator[Guarded]:
    """Calibrations of some tools in four years, in a registry."""
    loop = f"SciPy, {SAMPLE} tools", partial(fleet.scipy_seconds, SAMPLE)
    years, runs = [], folder / "tools.parquet"
    fleet.simulate(runs, SAMPLE)
    for year in range(2022, 2026):
        of_year = dated(runs, folder / f"{year}.parquet", f"{year}-03-01")
        years.append(folder / f"calibrated-{year}.parquet")
        command("fleet", of_year, "--tool", "servo", "--workers", "1", "-o", years[-1])

    def add() -> None:
        database = folder / f"{len([*folder.iterdir()])}.sqlite"
        command("registry", "--database", database, "init")
        command("registry", "--database", database, "add", *years)

    yield Guarded("registry add", *loop, add)
    command("registry", "--database", folder / "kept.sqlite", "init")
    command("registry", "--database", folder / "kept.sqlite", "add", *years)
    drift = partial(command, "registry", "--database", folder / "kept.sqlite", "drift")
    yield Guarded("registry drift", *loop, drift)


def long(folder: Path) -> Iterator[Guarded]:
    """Long text tables."""
    tool = folder / "tool.json"
    command("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", "-o", tool)
    for name, source, rows, *words in (
        ("apply", "surveys.csv", 50_000, tool),
        ("survey", "well.csv", 10_000, tool),
        ("survey", "well.csv", 100_000, tool),
        ("noise", "static.csv", 100_000),
        ("noise", "static.csv", 400_000),
        ("stations", "log.csv", 50_000),
        ("stations", "log.csv", 200_000),
    ):
        table = longer(EXAMPLE / source, folder / f"{rows}-{source}", rows)
        target = () if name == "noise" else ("-o", folder / f"{name}.csv")
        ours = partial(command, name, *words, table, *target)
        reading = "NumPy, reading the numbers", partial(read_numbers, table)
        yield Guarded(f"{name}, {rows} rows", *reading, ours)
    documents.write(folder / "warm.json", apply.sixty())
    apply.write_log(folder / "log.parquet", PARQUET_ROWS)
    files = (folder / "warm.json", folder / "log.parquet", folder / "out.parquet")
    whole = partial(python, "-m", "mwdcal", "apply", *files[:2], "-o", files[2])
    plain = partial(python, "-c", apply.PLAIN, *files)
    yield Guarded(f"apply, {PARQUET_ROWS} rows of Parquet", "plain NumPy, no 1σ", plain, whole)


def small(folder: Path) -> Iterator[Guarded]:
    """The example's other files as they come, with default options: the first minute of a newcomer."""
    tool = folder / "first.json"
    command("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", "-o", tool)
    loop = "SciPy, one tool", partial(fleet.scipy_seconds, 1)
    for name, *words in (
        ("verify", tool, EXAMPLE / "rolltest.csv"),
        ("profile", EXAMPLE / "export.csv", "-o", folder / "export.toml"),
        ("survey", tool, EXAMPLE / "well.csv", "-o", folder / "first.csv"),
        ("apply", tool, EXAMPLE / "surveys.csv", "-o", folder / "corrected.csv"),
    ):
        yield Guarded(f"{name}, the example", *loop, partial(command, name, *words))


KINDS = {
    "calibrate": singles,
    "fleet": fleets,
    "registry": registries,
    "apply survey noise stations": long,
    "verify profile survey apply": small,
}
"""Kinds of paths, by how the names of the paths begin."""


def asked_paths(word: str, folder: Path) -> Iterator[Guarded]:
    """The paths with a word in their name; a kind without any is not even prepared where the word begins with one's."""
    begins = [name for names in KINDS for name in names.split() if word.startswith(name)]
    for names, kind in KINDS.items():
        if not begins or set(begins) & set(names.split()):
            yield from (each for each in kind(folder) if word in each.name)


def main() -> None:
    """Measure, and compare with what is stored or store it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("word", nargs="?", default="", help="only paths with this word")
    parser.add_argument("--keep", action="store_true", help="store the ratios that are measured")
    parser.add_argument(
        "--most",
        type=float,
        default=LOST,
        help="largest share of a stored ratio (default: a third more)",
    )
    parser.add_argument("--stored", type=Path, default=STORED, help="file of the ratios")
    asked = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every process compiles everything anew
    stored: dict[str, float] = json.loads(asked.stored.read_text()) if asked.stored.exists() else {}
    measured, lost = {}, []
    with TemporaryDirectory() as place:
        for guarded in asked_paths(asked.word, Path(place)):
            before = stored.get(guarded.name)
            found = judged(guarded, asked.most * (before or np.inf), 1 if asked.keep else TRIES)
            measured[guarded.name] = found
            verdict = "new" if before is None else "LOST" if found > asked.most * before else "ok"
            lost += [guarded.name] if verdict == "LOST" else []
            was = f"stored {before or 0:7.3g}  {verdict}"
            print(f"{guarded.name:32} {found:7.3g} x {guarded.beside:28} {was}", flush=True)
    if asked.keep:
        asked.stored.write_text(json.dumps({**stored, **measured}, indent=1) + "\n")
    elif lost:
        sys.exit(
            f"over {asked.most:.2f} times the ratio stored in {asked.stored.name}: {', '.join(lost)}"
        )


if __name__ == "__main__":
    main()
