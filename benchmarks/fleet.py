"""Times `mwdcal fleet` against a loop of `scipy.optimize.least_squares` over the tools.

The fleet is simulated with NumPy: 48 stations, vector evidence, 24 parameters per tool. The
loop is what one would write first: the same residuals, default settings, its own Jacobian by
differences. It is timed on a sample of tools on one core; a second line grants it, without loss,
as many cores as the command has.

    python benchmarks/fleet.py --tools 20000 --growth 100,1000,10000,100000
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

MWDCAL = Path(sys.executable).with_name("mwdcal")
ANGLES = ("inclination", "azimuth", "toolface")
CHANNELS = ("ax", "ay", "az", "mx", "my", "mz")
SCALE, NOISE, DIP = (3.0, 5e-5), (1e-4, 15.0), np.radians(60.0)
GROUP = 10_000
"""Tools per row group of the simulated table."""
SAMPLE = 50


class Row(NamedTuple):
    """One line of the benchmark; seconds, and how many times faster we are."""

    name: str
    ours: float
    theirs: float
    ratio: float


def attitudes() -> dict[str, np.ndarray]:
    """Four inclinations by twelve toolfaces."""
    count = np.arange(48)
    degrees = (np.array([5.0, 45.0, 90.0, 135.0])[count // 12], 77.0 * count % 360, count % 12 * 30)
    return dict(zip(ANGLES, np.radians(degrees), strict=True))


def vectors(at: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Gravity, g, and field, nT, (48, 3) in tool axes."""
    ci, ca, ct = (np.cos(at[name]) for name in ANGLES)
    si, sa, st = (np.sin(at[name]) for name in ANGLES)
    g = np.stack([-si * st, -si * ct, ci], -1)
    north = np.stack([ci * ca * st + sa * ct, ci * ca * ct - sa * st, si * ca], -1)
    return g, 50_000.0 * (np.cos(DIP) * north + np.sin(DIP) * g)


def readings(rng: np.random.Generator, tools: int) -> np.ndarray:
    """Raw channels (tools, 48, 6) of random tools."""
    parts = []
    iron = (0.01, 400.0)
    for field, scale, noise, offset in zip(vectors(attitudes()), SCALE, NOISE, iron, strict=True):
        gain = np.eye(3) + rng.uniform(-0.02, 0.02, (tools, 3, 3))
        bias = rng.uniform(-offset, offset, (tools, 1, 3))
        clean = np.einsum("tij,nj->tni", gain, field) + bias
        parts.append(scale * (clean + noise * rng.standard_normal(clean.shape)))
    return np.concatenate(parts, -1)


def simulate(path: Path, tools: int, seed: int = 0) -> None:
    """Write a fleet as a Parquet table, a row group at a time."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rng, at, writer = np.random.default_rng(seed), attitudes(), None
    for first in range(0, tools, GROUP):
        count = min(GROUP, tools - first)
        serial = pa.array([f"MWD-{first + i:07d}" for i in range(count)])
        columns = {"serial": serial.take(pa.array(np.repeat(np.arange(count), 48)))}
        flat = readings(rng, count).reshape(-1, 6)
        columns |= dict(zip(CHANNELS, flat.transpose(), strict=True))
        columns |= {f"ref_{n}_deg": np.tile(np.degrees(v), count) for n, v in at.items()}
        constants = {"gravity_g": 1.0, "field_nt": 50_000.0, "dip_deg": np.degrees(DIP)}
        columns |= {f"ref_{n}": np.full(48 * count, v) for n, v in constants.items()}
        table = pa.table(columns)
        writer = writer or pq.ParquetWriter(path, table.schema)
        writer.write_table(table, row_group_size=48 * GROUP)
    if writer:
        writer.close()


def scipy_seconds(sample: int, seed: int = 0) -> float:
    """Seconds per tool of the SciPy loop on one core."""
    from scipy.optimize import least_squares

    known = np.concatenate(vectors(attitudes()), -1)
    sigma = np.repeat(NOISE, 3)
    raw = readings(np.random.default_rng(seed), sample) / np.repeat(SCALE, 3)

    def residuals(params: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        fields = [
            nominal[:, t : t + 3] @ params[4 * t : 4 * t + 9].reshape(3, 3).transpose()
            + params[4 * t + 9 : 4 * t + 12]
            for t in (0, 3)
        ]
        return ((np.concatenate(fields, -1) - known) / sigma).ravel()

    start = np.concatenate([np.eye(3).ravel(), np.zeros(3)] * 2)
    begun = time.perf_counter()
    for nominal in raw:
        least_squares(residuals, start, args=(nominal,))
    return (time.perf_counter() - begun) / sample


def command(runs: Path, output: Path, *options: str) -> tuple[float, float]:
    """Seconds of one run of the command, and the largest memory of any of its processes, MB."""
    begun = time.perf_counter()
    subprocess.run(
        [str(MWDCAL), "fleet", str(runs), "-o", str(output), "--tool", "servo", "--no-records",
         *options],
        check=True, capture_output=True,
    )  # fmt: skip
    seconds = time.perf_counter() - begun
    return seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def against_scipy(tools: int = 20_000, cores: int = 4, sample: int = SAMPLE) -> list[Row]:
    """The whole command, Parquet to Parquet, against the loop: as it is, and on as many cores."""
    with TemporaryDirectory() as folder:
        runs, output = Path(folder) / "runs.parquet", Path(folder) / "cals.parquet"
        simulate(runs, tools)
        options = ("--workers", str(cores), "--method")
        same, joint = (
            median(command(runs, output, *options, method)[0] for _ in range(rounds))
            for method, rounds in (("least-squares", 5), ("joint", 3))
        )
        theirs = median(scipy_seconds(sample) for _ in range(3)) * tools
    name = f"fleet, {tools} tools x 48 stations x 24 parameters, {cores} cores"
    loop = f"SciPy loop ({sample} tools, scaled)"
    return [
        Row(f"{name}, least-squares; {loop}", same, theirs, theirs / same),
        Row(f"the same; {loop} on {cores} cores", same, theirs / cores, theirs / cores / same),
        Row(f"{name}, joint with an uncertain stand; the same loop", joint, theirs, theirs / joint),
    ]


def growth(sizes: Sequence[int], cores: int = 4) -> Iterator[tuple[int, float, float]]:
    """Tools, seconds and largest memory of any process so far (MB), smallest fleet first."""
    for tools in sorted(sizes):
        with TemporaryDirectory() as folder:
            runs, output = Path(folder) / "runs.parquet", Path(folder) / "cals.parquet"
            simulate(runs, tools)
            yield tools, *command(runs, output, "--workers", str(cores))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tools", type=int, default=20_000)
    parser.add_argument("--cores", type=int, default=4)
    parser.add_argument("--growth", default="100,1000,10000")
    asked = parser.parse_args()
    for row in against_scipy(asked.tools, asked.cores):
        print(f"{row.name}\n  ours {row.ours:.1f} s   SciPy {row.theirs:.1f} s   {row.ratio:.0f} x")
    print(f"{'tools':>9}{'s':>9}{'tools/s':>9}{'MB':>7}")
    for tools, seconds, memory in growth([int(n) for n in asked.growth.split(",")], asked.cores):
        print(f"{tools:>9}{seconds:>9.1f}{tools / seconds:>9.0f}{memory:>7.0f}", flush=True)


if __name__ == "__main__":
    main()
