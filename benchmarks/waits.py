"""Processor time and memory of the jobs that users wait for, each against its target.

Every command runs in a process of its own, on one core, so that its time holds its start and its memory is
its own. The fleets are those of `fleet.py`, the long tables those of the guard: the example over and over.

    python benchmarks/waits.py                # a quarter of an hour
    python benchmarks/waits.py --share 0.01   # a hundredth of every size
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import fleet
import guard
import numpy as np
import peers
import pyarrow as pa
import pyarrow.parquet as pq
from measuring import used_by

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.readings import Readings
from simulation import DEG, attitude, factor_readings, factors_within_limits, plan

WARM, STATIONS = (0.0, 25.0, 50.0, 75.0), 36
"""Temperatures of a thermal run, °C, and the stations at each."""
YEARS, DRIFTING = range(2022, 2026), 2_000
"""Years in which the tools of a registry were calibrated, and how many there are; their time is scaled."""
CURVED = "nonlinearity = 0.005\n"
"""A line of a triad's section in a profile: its own-axis terms may be fitted."""

Command = tuple[str | Path, ...]


class Wait(NamedTuple):
    """One line: what was measured in its unit, at least and aimed at; `more` if large is good; memory, MB."""

    name: str
    found: float
    least: float
    aim: float
    unit: str
    more: bool = False
    memory: float | None = None

    @property
    def verdict(self) -> str:
        """The verdict: which of its targets the figure meets."""
        size = 1 / self.found if self.more else self.found
        least, aim = (1 / x if self.more else x for x in (self.least, self.aim))
        return "aim" if size <= aim else "at least" if size <= least else "**short of it**"


def processor(*command: str | Path) -> tuple[float, float]:
    """Processor time of a command and of the processes that it waits for, s, and the memory of the largest, MB."""
    used = used_by([sys.executable, "-m", "mwdcal", *map(str, command)])
    return used.processor, used.memory


def sized(count: int, share: float, least: int = 20) -> int:
    """A share of a number of tools or rows."""
    return max(int(count * share), least)


def fleets(folder: Path, share: float) -> Iterator[Wait]:
    """Whole commands, Parquet to Parquet, on one core; ms a tool but for the first."""
    bare, stand = (
        guard.without_noise(folder / f"{n}.toml", n == "stand") for n in ("bare", "stand")
    )
    curved = folder / "curved.toml"
    text = (guard.EXAMPLE / "tool.toml").read_text()
    curved.write_text(text.replace("noise =", f"{CURVED}noise ="))
    exact = folder / "exact.toml"
    exact.write_text(text.partition("[stand]")[0])
    declared, few = guard.EXAMPLE / "tool.toml", "--no-records"

    def each(count: int, *words: str | Path) -> tuple[float, int]:
        count = sized(count, share)
        runs = folder / f"{count}.parquet"
        if not runs.exists():
            fleet.simulate(runs, count)
        target = folder / f"{len([*folder.iterdir()])}.out.parquet"
        return processor("fleet", runs, "--workers", "1", *words, "-o", target)[0], count

    seconds, count = each(20_000, few, "--tool", bare)
    alone = min(guard.processor_seconds(partial(fleet.scipy_seconds, 20)) for _ in range(5)) / 20
    name = f"fleet, {count} tools, noise undeclared, whole command, against a SciPy loop per core"
    yield Wait(name, alone * count / seconds, 50, 100, "x", more=True)
    for name, size, least, aim, *words in (
        ("noise declared, exact stand", 20_000, 0.4, 0.1, few, "--tool", exact),
        ("noise declared, uncertain stand", 20_000, 0.5, 0.3, few, "--tool", declared),
        ("noise undeclared, uncertain stand", 2_000, 1.5, 0.5, few, "--tool", stand),
        ("nonlinearity auto", 500, 20, 10, few, "--tool", curved, "--nonlinearity", "auto"),
        ("with records", 200, 8, 4, "--tool", "servo"),
    ):
        seconds, count = each(size, *words)
        yield Wait(f"{name}, {count} tools", seconds / count * 1e3, least, aim, "ms a tool")
    runs, count = folder / "thermal.parquet", sized(500, share)
    thermal(runs, count)
    words = ("fleet", runs, "--workers", "1", few, "--tool", "servo", "--order", "auto")
    seconds = processor(*words, "-o", folder / "warm.out.parquet")[0]
    name = f"60 factors, {STATIONS * len(WARM)} stations, order auto, {count} tools"
    yield Wait(name, seconds / count * 1e3, 10, 5, "ms a tool")


def thermal(path: Path, count: int) -> None:
    """A table of runs of tools of 60 factors, at all temperatures."""
    rng, soaks = np.random.default_rng(0), len(WARM)
    angles = np.concatenate([np.stack(plan(toolfaces=STATIONS // 4))] * soaks, -1)
    warmth = np.repeat(WARM, STATIONS)
    known = np.concatenate(attitude(*angles)(1.0, 50_000.0, 60 * DEG), -1)
    factors = factors_within_limits(rng, count)
    raw = factor_readings(factors, warmth, known)
    raw = raw + np.repeat(fleet.NOISE, 3) * rng.standard_normal(raw.shape)
    raw = (raw * np.repeat(fleet.SCALE, 3)).reshape(-1, 6)
    columns = {"serial": np.repeat([f"T-{k:06d}" for k in range(count)], len(warmth))}
    columns |= dict(zip(fleet.CHANNELS, raw.transpose(), strict=True))
    given = dict(zip(fleet.ANGLES, angles / DEG, strict=True))
    table = {f"ref_{name}_deg": values for name, values in given.items()} | {
        "temperature_c": warmth
    }
    table |= {"ref_gravity_g": 1.0, "ref_field_nt": 50_000.0, "ref_dip_deg": 60.0}
    columns |= {n: np.tile(np.broadcast_to(v, warmth.shape), count) for n, v in table.items()}
    pq.write_table(pa.table(columns), path)


def singles(folder: Path, share: float) -> Iterator[Wait]:
    """One tool, whatever the share."""
    del share
    path = next(each for each in guard.singles(folder) if each.name == "calibrate, from the start")
    yield Wait(f"calibrate, 48 stations, against {path.beside}", guard.ratio(path), 1.2, 1.0, "x")
    g, b, group = peers.shots()
    known = {"field": np.full(len(g), peers.TOOL.field)}
    shots = Readings(g, b, known=known, sd=peers.SD, group=group)
    times = [guard.processor_seconds(partial(fit, shots)) for _ in range(100)]
    yield Wait("24 shots, two roll groups", min(times) * 1e3, 5, 3, "ms")


def long(folder: Path, share: float) -> Iterator[Wait]:
    """Long text tables."""
    tool = folder / "tool.json"
    guard.command(
        "calibrate", guard.EXAMPLE / "run.csv", "--tool", guard.EXAMPLE / "tool.toml", "-o", tool
    )
    for name, source, count, least, aim, *words in (
        ("survey", "well.csv", 10**6, 12, 6, tool),
        ("noise", "static.csv", 10**7, 20, 10),
        ("stations", "log.csv", 10**7, 30, 15),
    ):
        rows = sized(count, share, 2_000)
        table = guard.longer(guard.EXAMPLE / source, folder / source, rows)
        target = () if name == "noise" else ("-o", folder / "long.csv")
        seconds, memory = processor(name, *words, table, *target)
        table.unlink()
        yield Wait(f"{name}, {rows} rows", seconds, least * share, aim * share, "s", memory=memory)


def registries(folder: Path, share: float) -> Iterator[Wait]:
    """Drift of all tools of a registry, each calibrated in four years, with the page."""
    count = sized(DRIFTING, share)
    years, database = [], folder / "tools.sqlite"
    for year in YEARS:
        runs, of_year = folder / "runs.parquet", folder / f"{year}.parquet"
        fleet.simulate(runs, count, seed=year)
        guard.dated(runs, of_year, f"{year}-03-01")
        years.append(folder / f"calibrated-{year}.parquet")
        processor(
            "fleet", of_year, "--tool", "servo", "--records", "--workers", "1", "-o", years[-1]
        )
    guard.command("registry", "--registry", database, "init")
    guard.command("registry", "--registry", database, "add", *years)
    page = ("--report", folder / "drift.html")
    seconds, memory = processor("registry", "--registry", database, "drift", *page)
    name = f"registry drift, {count} tools of {len(YEARS)} calibrations, with the page"
    yield Wait(f"{name}, for 10,000", seconds / count * 1e4, 120, 30, "s", memory=memory)


KINDS: tuple[Callable[[Path, float], Iterator[Wait]], ...] = (fleets, singles, long, registries)


def measured(share: float) -> Iterator[Wait]:
    """All lines; a kind's files are removed before the next begins."""
    for kind in KINDS:
        with TemporaryDirectory() as place:
            for wait in kind(Path(place), share):
                print(f"  {wait.found:8.3g} {wait.unit:10} {wait.name}", flush=True)
                yield wait


def shown(waits: list[Wait]) -> str:
    """The lines as Markdown."""
    head = "| what | processor time | memory, MB | at least | aimed at | reached |"
    rows = [
        f"| {w.name} | {w.found:.3g} {w.unit} | {'' if w.memory is None else f'{w.memory:.0f}'} "
        f"| {w.least:g} | {w.aim:g} | {w.verdict} |"
        for w in waits
    ]
    return "\n".join([head, "| --- " * 6 + "|", *rows])


def report(share: float = 1.0) -> str:
    """The section's figures as Markdown."""
    return shown([*measured(share)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="share of every size")
    print(report(parser.parse_args().share))


if __name__ == "__main__":
    main()
