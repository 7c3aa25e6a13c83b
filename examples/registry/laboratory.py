"""Five years of a calibration laboratory: run files of simulated tools, one folder for each year.

    python examples/registry/laboratory.py laboratory [--tools 200] [--years 5]

Every tool comes back once a year, its scales and biases a little changed. The first tool has a roll test at each of its
last two visits, and is knocked between them. All data are simulated; the same numbers, the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from mwdcal.files.formats import atomic, table
from mwdcal.files.formats.table import Table
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import from_readings
from mwdcal.geometry.vectors import Array
from mwdcal.planning.plans import Earth, Truth, drawn, load_plan
from mwdcal.planning.session import Session

SERVO = Path(__file__).parents[1] / "servo"
"""The folder of the example tool: its profile and the file of its laboratory."""
SEED = 20261122
FIRST_YEAR = 2022
YEARLY = 3e-5
"""What a scale and a bias change by from one visit to the next, 1σ, as shares of gravity and of the field."""
KNOCK = 4e-3
"""What the knock adds to the bias of the first tool's accelerometer along y, g."""
DAYS_APART = 0.9
"""Days from one tool's visit to that of the next."""


def laboratory(folder: Path, tools: int, years: int) -> None:
    """Write the profile, the laboratory, run files and roll tests."""
    profile, _ = load_profile(str(SERVO / "tool.toml"))
    sessions = [Session.of(load_plan(name), profile) for name in ("twenty-four-state", "roll-test")]
    rng = np.random.default_rng(SEED)
    truth = drawn(rng, profile, 0, (tools,))
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    for name in ("tool.toml", "laboratory.toml"):
        atomic.write(folder / name, (SERVO / name).read_bytes())
    for year in range(FIRST_YEAR, FIRST_YEAR + years):
        visits_to_come = FIRST_YEAR + years - 1 - year
        truth = truth if year == FIRST_YEAR else aged(truth, rng, knocked=not visits_to_come)
        (folder / "runs" / str(year)).mkdir(exist_ok=True)
        for serial, run in runs(sessions[0], truth, rng, year):
            write(folder / "runs" / str(year) / f"{serial}.csv", run)
        if visits_to_come < 2:
            write(folder / f"rolltest-{year}.csv", next(runs(sessions[1], truth, rng, year))[1])


def aged(truth: Truth, rng: np.random.Generator, knocked: bool) -> Truth:
    """The tools (T,) a year later; `knocked`: what the first one has suffered."""
    units = {"accelerometer": 1.0, "magnetometer": Earth().field}
    later = {}
    for name, unit in units.items():
        steps = YEARLY * rng.normal(size=(len(truth.accelerometer), 12))
        steps *= np.repeat([1.0, unit, 0.0], (3, 3, 6))  # scales, biases, misalignments
        later[name] = np.asarray(getattr(truth, name)) + steps
    later["accelerometer"][0, 4] += KNOCK * knocked
    return replace(truth, **later)


def runs(
    session: Session, truth: Truth, rng: np.random.Generator, year: int
) -> Iterator[tuple[str, Table]]:
    """Serial and run of each tool in a year."""
    common = session.common(rng, truth.accelerometer.shape[:-1])
    measured = session.measured(truth, rng, common).readings
    for tool in range(len(truth.accelerometer)):
        serial, day = f"SIM-{tool + 1:04}", date(year, 3, 1) + timedelta(DAYS_APART * tool)
        labels = {"serial": serial, "date": day.isoformat(), "simulated": True}
        readings = replace(
            measured,
            accelerometer=of_tool(measured.accelerometer, tool),
            magnetometer=of_tool(measured.magnetometer, tool),
            source=session.plan.source,
        )
        yield serial, from_readings(readings, session.profile, labels)


def of_tool(values: Array | None, tool: int) -> Array:
    """The readings (n, 3) of one tool."""
    assert values is not None
    return values[tool]


def write(path: Path, run: Table) -> None:
    """Write a run file."""
    atomic.write(path, table.rendered(path, run), durable=False)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tools", type=int, default=200)
    parser.add_argument("--years", type=int, default=5)
    given = parser.parse_args()
    laboratory(given.folder, given.tools, given.years)
