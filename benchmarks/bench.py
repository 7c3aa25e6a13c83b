"""Every benchmark side by side in one run, and the page of the ratios.

    make bench            (writes docs/evidence/benchmarks.md and its .svg; under 25 minutes on two cores)
    make bench QUICK=1    (smaller sizes, under two minutes, into build/benchmarks)

All comparisons are made in one environment, in which mwdcal and the alternatives are installed.
A module of GROUPS that is missing, or an alternative that does not run, is named on the page.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import fill
from typing import TYPE_CHECKING

import measuring
from measuring import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parents[1]
TEXTS = Path(__file__).with_name("page.txt")
"""The page without its figures: a paragraph per group under its heading."""
PACKAGES = (
    "mwdcal", "numpy", "scipy", "numba", "pyarrow", "pyswarms", "AllanTools",
    "circuitpython-mag-cal", "imucal", "pandas", "welleng",
)  # fmt: skip
ORDER = (
    *("fleet", "apply", "fits", "procedures", "surveys", "registry", "swarms", "peers", "allan"),
    *("commands", "waits"),
)
"""Order of the runs: the memory of a fleet is that of the largest process so far."""
PLOTTED = (
    "fits",
    "procedures",
    "surveys",
    "swarms",
    "peers",
    "allan",
    "fleet",
    "apply",
    "commands",
)
GOALS = {
    "swarms": (
        ("60 x 600 x 12, from the readings", 3.0, 6.0),
        ("60 x 600 x 12, the same NumPy cost in both", 3.0, 6.0),
    ),
    "fits": (
        ("60 factors; SciPy, numeric Jacobian", 10.0, None),
        ("60 factors, uncertain stand; SciPy, 600 unknowns, numeric Jacobian", 10.0, None),
    ),
    "apply": (
        ("60 factors, all angles, 1000000 rows", 10.0, 20.0),
        ("vectors alone, against a copy of them", 0.5, None),
        ("Parquet to Parquet, 1000000 rows", 1.5, 4.0),
        ("Parquet to Parquet, 10000000 rows", 1.5, 4.0),
    ),
}
"""What was aimed at: how the name of the row begins, the ratio at least, and the one hoped for."""
ALLAN = "ours has the mean difference taken off as well, in the same pass and in blocks of bounded memory"
CLOSED = "a closed form of a few small solutions; ours weighs each reading, and gives uncertainty, rank and residuals"
SLOWER = {
    "24 shots": f"{CLOSED}; it iterates to the minimum",
    "six positions": CLOSED,
    "12 factors; SciPy, analytic Jacobian": "SciPy gets the Jacobian by hand, and finds no covariance or rank",
    "position covariance, 14 sensor terms": "NumPy written for this one job: never vertical, no random errors",
    "vectors alone, against a copy": "a copy moves the same bytes and computes nothing",
    "Parquet to Parquet": "mwdcal also states the 1σ of seven angles and strengths at each row; plain NumPy none",
    **dict.fromkeys(("standard", "overlapping", "modified"), ALLAN),
    "mwdcal calibrate": "the import alone computes, reads and writes nothing",
}
"""Why another is faster, by how the name of a row begins."""
UNITS = {"s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")), "MB": ((1.0, "MB"),)}


@dataclass
class Group:
    """What one module measured; `growth` are tools, seconds and memory (MB), `text` figures of other kinds."""

    rows: list[Row] = field(default_factory=list)
    text: str = ""
    growth: list[tuple[int, float, float]] = field(default_factory=list)
    missing: str = ""

    @property
    def shown(self) -> str:
        """The figures as Markdown, or why there are none."""
        return self.missing or self.text or group_table(self.rows)


def fleet(quick: bool) -> Group:
    """Growth with the number of tools, and a SciPy loop."""
    module, cores = import_module("fleet"), count_cores()
    sizes = [10**k for k in range(2, 5 if quick else 6)]
    grown = list(module.growth(sizes, cores))
    return Group(module.against_scipy(2_000 if quick else 20_000, cores), growth=grown)


def apply(quick: bool) -> Group:
    """In memory, and from file to file."""
    module, rows = import_module("apply"), 10**5 if quick else 10**6
    found = list(module.in_memory(rows))
    with TemporaryDirectory() as folder:
        for count in (rows,) if quick else (rows, 10 * rows):
            found += module.in_files(count, Path(folder))
    return Group(found)


def registry(quick: bool) -> Group:
    """Import, size, queries and check of a registry."""
    return Group(text=import_module("registry").everywhere(2_000 if quick else 20_000))


def waits(quick: bool) -> Group:
    """Processor time of what users wait for, against what is aimed at."""
    return Group(text=import_module("waits").report(0.01 if quick else 1.0))


def procedures(quick: bool) -> Group:
    """Simulated calibrations."""
    return Group(import_module("procedures").rows(*((500, 20) if quick else (10_000, 100))))


def surveys(quick: bool) -> Group:
    """Positions with their covariance."""
    return Group(import_module("surveys").rows(*((10**5, 2_000) if quick else (10**6, 10_000))))


OWN = {
    "fleet": fleet,
    "apply": apply,
    "procedures": procedures,
    "surveys": surveys,
    "registry": registry,
    "waits": waits,
}


def measured(name: str, quick: bool) -> Group:
    """One group; what cannot be measured says why."""
    begun = time.perf_counter()
    try:
        group = OWN[name](quick) if name in OWN else Group(import_module(name).rows())
    except ImportError as error:
        group = Group(missing=f"Not measured: {error}.")
    print(f"{name}: {time.perf_counter() - begun:.0f} s", flush=True)
    for row in group.rows:
        print(f"  {row.ratio:>8.2f} x  {row.name}", flush=True)
    return group


# ── The page ─────────────────────────────────────────────────────────────────────────────────


def shown(value: float, unit: str) -> str:
    """A value with three digits and a unit that suits it."""
    scales = UNITS.get(unit, ((1.0, unit),))
    size, name = next((pair for pair in scales if value >= pair[0]), scales[-1])
    return f"{digits(value / size)} {name}"


def digits(value: float) -> str:
    """Three digits, and never an exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def share(ratio: float) -> str:
    """A ratio with two digits: it has no more."""
    return f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.2g}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def group_table(rows: Sequence[Row]) -> str:
    """Ours, theirs and the ratio of each row."""
    cells = []
    for row in rows:
        same, memory = getattr(row, "same", ""), getattr(row, "memory", None)
        unit = getattr(row, "unit", "s")
        what, _, other = row.name.partition("; ")
        peak = " / ".join(digits(m) for m in memory) if memory else ""
        values = [shown(v, unit) for v in (row.ours, row.theirs)]
        cells.append(
            [
                what,
                other,
                *values,
                f"**{share(row.ratio)}**{'' if row.ratio >= 1 else ' slower'}",
                peak,
                same,
            ]
        )
    head = ["what", "against", "ours", "theirs", "ratio", "peak MB, ours / theirs", "equal result"]
    kept = [i for i, name in enumerate(head) if (i < 5 and i != 1) or any(c[i] for c in cells)]
    return table([head[i] for i in kept], [[c[i] for i in kept] for c in cells])


def growth_table(grown: Sequence[tuple[int, float, float]]) -> str:
    """Time and memory against the number of tools."""
    rows = [
        [f"{tools:,}".replace(",", " "), shown(s, "s"), digits(tools / s), digits(memory)]
        for tools, s, memory in grown
    ]
    return table(["tools", "time", "tools per second", "largest process, MB"], rows)


def goals(groups: dict[str, Group]) -> Iterator[str]:
    """What was aimed at and what came out."""
    for name, wanted in GOALS.items():
        for start, least, hoped in wanted:
            for row in groups[name].rows:
                if row.name.startswith(start):
                    aim = f"{least:g}" + (f", hoped for {hoped:g}" if hoped else "")
                    high, low = row.ratio >= (hoped or least), row.ratio < least
                    verdict = (
                        "**short of it**" if low else "reached" if high else "reached, not the hope"
                    )
                    yield f"- {row.name}: {share(row.ratio)} x; aimed at: {aim} x: {verdict}."
                    break


def slower(groups: dict[str, Group]) -> Iterator[str]:
    """Rows in which another is faster, and why."""
    for row in (row for group in groups.values() for row in group.rows if row.ratio < 1):
        reasons = (why for start, why in SLOWER.items() if row.name.startswith(start))
        yield f"- {row.name}: {share(row.ratio)} x: {next(reasons, '**no reason known**')}."


def machine() -> str:
    """Processor and cores."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            x.partition(":")[2].strip()
            for x in info.read_text().splitlines()
            if x[:10] == "model name"
        ]
        model = names[0] if names else model
    return (
        f"{model}, {count_cores()} cores; {platform.system()}, Python {platform.python_version()}"
    )


def count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> str:
    """What was measured, and against what."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


def page(groups: dict[str, Group], quick: bool) -> str:
    """The text with its figures in place."""
    text = TEXTS.read_text("utf-8")
    sizes = "`make bench QUICK=1`: small sizes and few rounds" if quick else "`make bench`"
    parts = {
        "machine": machine(),
        "versions": versions(),
        "date": f"{datetime.now(UTC).date()}",
        "made": sizes,
        "goals": "\n".join(goals(groups)),
        "slower": "\n".join(slower(groups)) or "None.",
        "growth": growth_table(groups["fleet"].growth) if groups["fleet"].growth else "",
    }
    for name, group in groups.items():
        parts[name] = group.shown
    for name, value in parts.items():
        text = text.replace("{" + name + "}", value)
    return text


def renewed(text: str, groups: dict[str, Group]) -> str:
    """A page with the sections of some groups measured anew, by themselves: with their own machine and date."""
    parts = re.split(r"(?m)^(?=## )", text)
    for section in re.split(r"(?m)^(?=## )", TEXTS.read_text("utf-8")):
        for name, group in groups.items():
            if "{" + name + "}" in section:
                shown = group.shown
                about = f"Measured by itself: {datetime.now(UTC).date()}, {machine()}."
                filled = section.replace("{" + name + "}", f"{shown}\n\n{about}")
                heading = section.partition("\n")[0]
                kept = [part for part in parts if part.partition("\n")[0] != heading]
                place = next(
                    i for i, part in enumerate(kept) if part.startswith("## Particle swarm")
                )
                parts = [*kept[:place], filled, *kept[place:]]
    return "".join(parts)


def plot(groups: dict[str, Group], path: Path) -> None:
    """All ratios of time on one logarithmic axis, the groups apart."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    lines: list[tuple[str, float | None]] = []
    for name in (name for name in PLOTTED if groups[name].rows):
        rows = [row for row in groups[name].rows if getattr(row, "unit", "s") == "s"]
        lines += [(name, None), *((fill(row.name, 74), row.ratio) for row in rows)]
    ratios = [ratio for _, ratio in lines if ratio is not None]
    style = {"font.size": 8, "svg.hashsalt": "mwdcal", "svg.fonttype": "path"}
    with mpl.rc_context(style):
        figure = Figure(figsize=(9.5, 0.24 * len(lines) + 0.8), layout="constrained")
        axes = figure.add_subplot()
        for place, (_, ratio) in enumerate(lines):
            if ratio is not None:
                _bar(axes, place, ratio)
        axes.axvline(1, color="black", linewidth=0.8)
        axes.set_xscale("log")
        axes.set_xlim(min(ratios) / 3, max(ratios) * 3)
        axes.set_ylim(len(lines) - 0.3, -0.7)
        axes.set_yticks(range(len(lines)), [label for label, _ in lines])
        for tick, (_, ratio) in zip(axes.get_yticklabels(), lines, strict=True):
            tick.set_fontweight("bold" if ratio is None else "normal")
        axes.tick_params(axis="y", length=0)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.set_xlabel("times faster than the other (left of 1: slower)")
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right", "left"]].set_visible(False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _bar(axes: Axes, place: int, ratio: float) -> None:
    """A bar from one to the ratio, with its figure at the end."""
    faster = ratio >= 1
    color = "#2a6f97" if faster else "#b5533c"
    axes.plot([1, ratio], [place, place], color=color, linewidth=4, solid_capstyle="butt")
    axes.annotate(
        share(ratio), (ratio, place), (4 if faster else -4, 0), textcoords="offset points",
        ha="left" if faster else "right", va="center", color=color,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "evidence")
    parser.add_argument("--only", help="groups with commas, whose sections of the page are renewed")
    asked = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        sys.exit("set OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1, or use `make bench`")
    if asked.quick:
        measuring.BUDGET["seconds"] = 0.5
    if asked.only:
        groups = {name: measured(name, asked.quick) for name in asked.only.split(",")}
        there = asked.output / "benchmarks.md"
        there.write_text(renewed(there.read_text("utf-8"), groups), "utf-8")
        return
    groups = {name: measured(name, asked.quick) for name in ORDER}
    asked.output.mkdir(parents=True, exist_ok=True)
    (asked.output / "benchmarks.md").write_text(page(groups, asked.quick), "utf-8")
    plot(groups, asked.output / "benchmarks.svg")
    plot(groups, ROOT / "build" / "benchmarks" / "benchmarks.png")
    print(f"wrote {asked.output / 'benchmarks.md'}")


if __name__ == "__main__":
    main()
