"""Monte Carlo: many simulated tools fitted at once, against a loop of SciPy fits of the same readings.

    python benchmarks/procedures.py [--tools 10000]

Tools within the datasheet of the servo instrument, 48 stations, an exact stand, 12 parameters of each triad.
SciPy is `scipy.optimize.least_squares`, triad by triad, from the nominal tool, at units in which all parameters
are near one; a sample of the tools, scaled. The simulation is in neither time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from measuring import Row, seconds
from msgspec.structs import replace as with_changes
from scipy.optimize import least_squares

from mwdcal.calibration import results
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning.plans import drawn, load_plan
from mwdcal.planning.session import Session
from mwdcal.sensor.profile import StandProfile

TOOLS, AT_ONCE, ALONE = 10_000, 500, 100
"""Tools in all, in one fit, and in the sample of the loop."""
FIELDS = (1.0, 48_000.0)


def readings(tools: int) -> Readings:
    """Simulated runs of 48 stations."""
    profile = with_changes(load_profile("servo")[0], stand=StandProfile())
    session, rng = Session.of(load_plan("moosavi-12"), profile), np.random.default_rng(0)
    return session.measured(drawn(rng, profile, 0, (tools,)), rng).readings


def ours(runs: Readings) -> np.ndarray:
    """Parameters (tools, 24) of all tools, with the uncertainty that a fit has with it."""
    tools, found = len(runs.accelerometer), []
    for first in range(0, tools, AT_ONCE):
        result = fit(_some(runs, slice(first, first + AT_ONCE)), Options(order=0))
        found.append(np.einsum("bkp,bp->bk", results.to_file(result, 30.0), result.state.params))
    return np.concatenate(found)


def _some(runs: Readings, tools: slice) -> Readings:
    """Some of the runs."""
    a, m = runs.accelerometer[tools], runs.magnetometer[tools]
    return replace(runs, accelerometer=a, magnetometer=m)


def theirs(runs: Readings, sample: int) -> np.ndarray:
    """Parameters (sample, 24) by the loop: error of the reading over its noise, as a tool's fit minimises it."""
    known = [runs.known[name] for name in ("inclination", "azimuth", "toolface")]
    vectors = reference_vectors(*known, 1.0, 1.0, runs.known["dip"])
    raws = [runs.accelerometer / FIELDS[0], runs.magnetometer / FIELDS[1]]
    noises = [
        runs.sd[n][0, 0] / s for n, s in zip(("accelerometer", "magnetometer"), FIELDS, strict=True)
    ]
    start, found = np.concatenate([np.eye(3).ravel(), np.zeros(3)]), np.empty((sample, 24))

    def misfit(p: np.ndarray, raw: np.ndarray, field: np.ndarray, sd: float) -> np.ndarray:
        return ((field @ p[:9].reshape(3, 3).transpose() + p[9:] - raw) / sd).ravel()

    for tool in range(sample):
        for triad in range(2):
            given = raws[triad][tool], vectors[triad], noises[triad]
            p = least_squares(misfit, start, args=given).x
            matrix = np.linalg.inv(p[:9].reshape(3, 3))
            offset = -matrix @ p[9:] * FIELDS[triad]
            found[tool, 12 * triad : 12 * triad + 12] = np.concatenate([matrix.ravel(), offset])
    return found


def rows(tools: int = TOOLS, sample: int = ALONE) -> list[Row]:
    """The fits of all tools against the loop, scaled from a sample."""
    runs = readings(tools)
    times = [(seconds(lambda: ours(runs)), seconds(lambda: theirs(runs, sample))) for _ in range(3)]
    mine, loop = np.median(times, axis=0)
    loop *= tools / sample
    scale = np.tile(np.repeat([1.0, 1.0], [9, 3]), 2)
    scale[21:] = FIELDS[1]
    apart = np.abs((ours(_some(runs, slice(sample))) - theirs(runs, sample)) / scale).max()
    name = f"{tools} simulated calibrations, 2 x 12 parameters, 48 stations; SciPy loop ({sample} tools, scaled)"
    return [Row(name, float(mine), float(loop), float(loop / mine), same=f"{apart:.0e}")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tools", type=int, default=TOOLS)
    for row in rows(parser.parse_args().tools):
        print(
            f"{row.name}\n  ours {row.ours:.2f} s   SciPy {row.theirs:.1f} s   {row.ratio:.0f} x   {row.same}"
        )


if __name__ == "__main__":
    main()
