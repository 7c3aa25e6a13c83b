"""Multi-station analysis of 500 simulated wells in each of several geometries, and where it refuses.

    python examples/interference/interference.py        (prints the tables of docs/howto/interference.md, a minute)

All data are simulated: tools are drawn from the covariance of one laboratory calibration, references are
off by their uncertainties.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import raw_reading
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import centred, reference_vectors
from mwdcal.planning.plans import grid, run, servo
from mwdcal.sensor.profile import Profile
from mwdcal.survey.acceptance import SensorTerms
from mwdcal.survey.interference_estimate import Assumed, estimate

FIELD, DIP = 50_000.0, np.radians(65.0)
SD_FIELD, SD_DIP = 130.0, np.radians(0.2)
NOISE = {"accelerometer": 1e-4, "magnetometer": 15.0}
IRON = np.array([80.0, -60.0, 1500.0])
SEEDS = 500


class Hole(NamedTuple):
    """Ranges of inclination and azimuth, degrees, of surveys that are spread evenly, and how many they are."""

    inclination: tuple[float, float]
    azimuth: tuple[float, float]
    count: int = 30
    toolface: float | None = None


HOLES = {
    "deviated, 5–60°, azimuth 40–75°": Hole((5, 60), (40, 75)),
    "tangent, 45°, azimuth 60°": Hole((45, 45), (60, 60)),
    "42–48°, azimuth 60°, one toolface": Hole((42, 48), (60, 60), toolface=30),
    "3 surveys, 20–60°, azimuth 60°": Hole((20, 60), (60, 60), 3),
    "horizontal, azimuth 20°": Hole((90, 90), (20, 20)),
    "horizontal, azimuth 75°": Hole((90, 90), (75, 75)),
    "horizontal within 2°, azimuth 86–94°": Hole((88, 92), (94, 86)),
}


def laboratory() -> Calibration:
    """A calibration by 48 stations at an exact stand."""
    rng = np.random.default_rng(1)
    plan = grid([0.5, 45, 90, 135], 12, [10, 100, 200, 300], [30.0])
    readings = run(servo(rng), plan, rng)
    readings = replace(readings, sd={name: np.array(sd) for name, sd in NOISE.items()})
    return calibrate(readings, Profile(name="study"), Options(order=0, nonlinearity=()))


def attitudes(hole: Hole) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inclination, azimuth and toolface (n,) of the surveys of a hole, radians."""
    drawn = np.random.default_rng(5).uniform(0, 2 * np.pi, hole.count)
    face = drawn if hole.toolface is None else np.full(hole.count, np.radians(hole.toolface))
    inc, azi = (np.radians(np.linspace(*ends, hole.count)) for ends in hole[:2])
    return inc, azi, face


def surveyed(
    record: Calibration, hole: Hole, seeds: int, iron: np.ndarray, off: float = 1.0
) -> Readings:
    """Surveys (seeds, n, 3); `off`: errors of the references in their standard uncertainties."""
    rng = np.random.default_rng(3)
    covariance = record.parameter_covariance
    tools = record.parameters + rng.multivariate_normal(
        np.zeros(len(covariance)), covariance, seeds, method="eigh"
    )
    errors = off * rng.normal(size=(2, seeds, 1))
    g, b = reference_vectors(
        *attitudes(hole), 1.0, FIELD + SD_FIELD * errors[0], DIP + SD_DIP * errors[1]
    )
    raw, warmth = {}, np.full((seeds, hole.count), 30.0)
    for triad, vectors in zip(record.triads, (g + 0 * b, b + iron), strict=True):
        params = tools[:, record.places()[triad.name]]
        exact = raw_reading(triad.functions(record.reference_temperature), params, vectors, warmth)
        raw[triad.name] = exact + NOISE[triad.name] * rng.normal(size=exact.shape)
    known = {"gravity": 1.0, "field": FIELD, "dip": DIP}
    sd = {**NOISE, "gravity": 1e-4, "field": SD_FIELD, "dip": SD_DIP}
    return Readings(
        **raw,
        temperature=warmth,
        known={name: np.full(hole.count, value) for name, value in known.items()},
        sd={name: np.asarray(value) for name, value in sd.items()},
    )


def statistics(record: Calibration, hole: Hole) -> str:
    """One row of the table: errors before and after, coverage, and how many wells are refused."""
    readings = surveyed(record, hole, SEEDS, IRON)
    whole = estimate(record, readings, Assumed(drift=SensorTerms(), robust=None))
    azimuth, truth = OBSERVABLES["azimuth"].value, attitudes(hole)[1]
    g, b = whole.result.problem.fields(whole.result.state)
    before, after = (centred(azimuth(*pair) - truth) for pair in (record.fields(readings), (g, b)))
    gradient = OBSERVABLES["azimuth"].gradient(g, b)
    rows = np.einsum("wni,wnip->wnp", gradient, record.jacobian(readings))
    variance = np.einsum("wnp,wpq,wnq->wn", rows, whole.covariance, rows)
    variance += np.einsum("wni,wnij,wnj->wn", gradient, record.noise_covariance(readings), gradient)
    inside = np.mean(np.abs(after) < 1.96 * np.sqrt(variance))
    cells = [
        f"{np.degrees(np.sqrt(np.mean(each**2))):.2g}°"
        for each in (before, after, np.sqrt(variance))
    ]
    cells += [
        f"{100 * inside:.1f} %",
        f"{whole.sd[:, 2].mean():.0f}",
        f"{whole.sd[:, :2].mean():.0f}",
    ]
    return " | ".join([*cells, f"{np.count_nonzero(~whole.separable)} of {SEEDS}"])


def left_in_azimuth(record: Calibration, inclination: float, azimuth: float) -> float:
    """1σ of azimuth by what interference is left, degrees, for 30 surveys at one attitude and all toolfaces."""
    hole = Hole((inclination, inclination), (azimuth, azimuth))
    readings = surveyed(record, hole, 1, np.zeros(3), off=0.0)
    return float(
        np.degrees(
            estimate(record, readings, Assumed(drift=SensorTerms(), robust=None)).azimuth_sd.max()
        )
    )


def main() -> None:
    """Print both tables."""
    record = laboratory()
    print(
        "| hole | azimuth before | after | stated 1σ | within 1.96 σ | axial 1σ, nT | cross-axial 1σ, nT | refused |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, hole in HOLES.items():
        print(f"| {name} | {statistics(record, hole)} |")
    across = (0, 15, 30, 45, 60, 65, 70, 75, 80, 90)
    print(
        "\n| inclination | "
        + " | ".join(f"{a}°" for a in across)
        + " |\n|---" * 1
        + "|---" * len(across)
        + "|"
    )
    for inclination in (5, 30, 45, 60, 70, 75, 80, 85, 90):
        cells = [f"{left_in_azimuth(record, inclination, a):.2g}" for a in across]
        print(f"| {inclination}° | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
