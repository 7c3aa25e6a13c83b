"""`mwdcal apply` against plain NumPy: in memory, Parquet to Parquet, and in bytes of memory.

Every comparison is made in one process or with commands in turn, so that what else the machine
does is shared; times are the best of several, memory is the worst.

    python benchmarks/apply.py [rows in memory] [rows in files ...]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from measuring import used_by

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.files import documents, profiles
from mwdcal.geometry.vectors import Array
from mwdcal.planning.plans import grid, run, servo
from mwdcal.use import correction_numba
from mwdcal.use.correction import compiled, numbers, reference

MWDCAL = Path(sys.executable).with_name("mwdcal")
NOMINAL = (3.0, 5e-5)
"""Raw units per g and per nT of the profile `servo`."""
BLOCK = 250_000
PLAIN = """
import sys
import numpy, pyarrow, pyarrow.parquet
from mwdcal.use.correction import reference
from mwdcal.files import documents
from mwdcal.calibration.readings import Readings
made = documents.read(sys.argv[1])
table = pyarrow.parquet.read_table(sys.argv[2])
g = numpy.stack([table[name].to_numpy() for name in ("ax", "ay", "az")], -1) / 3.0
b = numpy.stack([table[name].to_numpy() for name in ("mx", "my", "mz")], -1) / 5e-5
readings = Readings(accelerometer=g, magnetometer=b, temperature=table["temperature_c"].to_numpy())
outside = made.outside(readings)
for name, values in reference(made, readings).items():
    values = numpy.where(outside, numpy.nan, values)
    table = table.append_column(name, pyarrow.array(values, from_pandas=True))
pyarrow.parquet.write_table(table, sys.argv[3])
"""
"""What one would write without mwdcal's loops: whole columns, plain NumPy, default Parquet."""


class Row(NamedTuple):
    """One comparison: ours and theirs in the unit, and how many times better ours is."""

    name: str
    ours: float
    theirs: float
    ratio: float
    unit: str = "s"


def sixty() -> Calibration:
    """A simulated tool calibrated with 60 factors, -10…120 °C."""
    rng = np.random.default_rng(4)
    plan = grid([5, 45, 90, 135], 12, [0, 90, 180, 270], [-10.0, 20.0, 60.0, 90.0, 120.0])
    profile, _ = profiles.load_profile("servo")
    options = Options(model="factors", order=3)
    return calibrate(run(servo(rng), plan, rng, noise=(1e-5, 2.0)), profile, options)


def log(rows: int, seed: int = 1) -> Readings:
    """Nominal readings at any attitude and temperature."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(rows, 3))
    g /= np.linalg.norm(g, axis=-1, keepdims=True)
    return Readings(g, 3e4 * rng.normal(size=(rows, 3)), rng.uniform(0.0, 110.0, rows))


def seconds(*calls: Callable[[], object], repeats: int = 9) -> list[float]:
    """Best time of each call; the calls take turns, after one round that does not count."""
    rounds = [[_seconds(call) for call in calls] for _ in range(repeats + 1)]
    return np.min(rounds[1:], axis=0).tolist()


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def in_memory(rows: int = 10**6) -> Iterator[Row]:
    """Vectors and all angles; and the vectors alone, against a copy of as many bytes."""
    made, readings = sixty(), log(rows)
    ours, theirs = seconds(
        lambda: compiled(made, readings, least=0), lambda: reference(made, readings)
    )
    yield Row(f"60 factors, all angles, {rows} rows", ours, theirs, theirs / ours)
    columns = [*_columns(readings), readings.temperature]
    triads, out, copied = numbers(made), np.empty((6, rows)), np.empty((6, rows))
    source = np.stack(columns[:6])
    ours, theirs, half = seconds(
        lambda: correction_numba.run(columns, triads, made.reference_temperature, out=out),
        lambda: np.copyto(copied, source),
        lambda: made.fields(readings),
    )
    yield Row("vectors alone, against plain NumPy", ours, half, half / ours)
    yield Row("vectors alone, against a copy of them", ours, theirs, theirs / ours)


def _columns(readings: Readings) -> list[Array]:
    vectors = (readings.accelerometer, readings.magnetometer)
    return [np.ascontiguousarray(v[:, i]) for v in vectors if v is not None for i in range(3)]


def in_files(rows: int, folder: Path, repeats: int = 3) -> Iterator[Row]:
    """`mwdcal apply` from Parquet to Parquet, against NumPy with Parquet: time and peak memory."""
    documents.write(folder / "cal.json", sixty())
    write_log(folder / "log.parquet", rows)
    names = [str(folder / name) for name in ("cal.json", "log.parquet", "out.parquet")]
    commands = [
        [str(MWDCAL), "apply", *names[:2], "-o", names[2]],
        [sys.executable, "-c", PLAIN, *names],
    ]
    rounds = np.array([[used_by(command) for command in commands] for _ in range(repeats)])
    (ours, *_), (theirs, *_) = rounds.min(axis=0).tolist()
    (*_, our_peak), (*_, their_peak) = rounds.max(axis=0).tolist()
    yield Row(f"Parquet to Parquet, {rows} rows", ours, theirs, theirs / ours)
    yield Row(f"peak memory, {rows} rows", our_peak, their_peak, their_peak / our_peak, "MB")


def write_log(path: Path, rows: int) -> None:
    """A log in raw units as Parquet: time, temperature and six channels."""
    import pyarrow as arrow
    from pyarrow import parquet

    names = ("time_s", "temperature_c", "ax", "ay", "az", "mx", "my", "mz")
    schema = arrow.schema([(name, arrow.float64()) for name in names])
    with parquet.ParquetWriter(path, schema) as writer:
        for start in range(0, rows, BLOCK):
            readings = log(min(BLOCK, rows - start), start)
            times = np.arange(start, start + readings.count) * 0.01
            raw = [c * NOMINAL[i // 3] for i, c in enumerate(_columns(readings))]
            cells = [times, readings.temperature, *raw]
            writer.write_table(arrow.table(dict(zip(names, cells, strict=True)), schema=schema))


def main() -> None:
    memory, *files = [int(float(word)) for word in sys.argv[1:]] or [10**6, 10**6, 10**7]
    print(f"{'':<44}{'ours':>10}{'theirs':>10}{'ratio':>8}")
    with TemporaryDirectory() as folder:
        for rows in (in_memory(memory), *(in_files(n, Path(folder)) for n in files)):
            for row in rows:
                print(
                    f"{row.name:<44}{row.ours:>10.4g}{row.theirs:>10.4g}{row.ratio:>8.2f}  {row.unit}"
                )


if __name__ == "__main__":
    main()
