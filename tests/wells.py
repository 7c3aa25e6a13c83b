"""Simulated surveys of wells with a magnetised drill string, by the tests' second forward model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from simulation import DEG, attitude

FIELD, DIP = 50_000.0, 65 * DEG
SD_FIELD, SD_DIP = 130.0, 0.2 * DEG
SD_MOMENT = (60.0, 0.08 * DEG)
"""Of field, nT, and dip at each station its own (OWSG, MFIR and MDIR)."""
NOISE = (1e-4, 15.0)
IRON = (80.0, -60.0, 1500.0)
"""Interference along x, y, z: 100 nT across the tool, 1,500 nT along it."""


@dataclass(frozen=True)
class Path:
    """Attitudes (n,) of the surveys of a well, radians."""

    inclination: np.ndarray
    azimuth: np.ndarray
    toolface: np.ndarray

    def __len__(self) -> int:
        return len(self.inclination)


def path(inclination, azimuth, count=30, seed=5, toolface=None) -> Path:
    """Attitudes between two inclinations and two azimuths, degrees, at random toolfaces or at one."""
    drawn = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    face = drawn if toolface is None else np.full(count, toolface * DEG)
    return Path(np.linspace(*inclination, count) * DEG, np.linspace(*azimuth, count) * DEG, face)


def joined(*parts: Path) -> Path:
    """One well of several parts."""
    each = ((part.inclination, part.azimuth, part.toolface) for part in parts)
    return Path(*(np.concatenate(angles) for angles in zip(*each, strict=True)))


def single(inclination: float, azimuth: float, toolface: float) -> Path:
    """One survey; degrees."""
    return Path(*(np.array([angle * DEG]) for angle in (inclination, azimuth, toolface)))


DEVIATED = path((5, 60), (40, 75))


def horizontal_east(seed: int = 6, count: int = 30) -> Path:
    """Horizontal within 2°, east or west within 4°, as a long lateral is."""
    rng = np.random.default_rng(seed)
    azimuth = np.where(seed % 2, 90.0, 270.0) + rng.uniform(-4, 4, count)
    toolface = rng.uniform(0, 2 * np.pi, count)
    return Path((90 + rng.uniform(-2, 2, count)) * DEG, azimuth * DEG, toolface)


def drawn_tools(calibration: Calibration, rng: np.random.Generator, count: int) -> np.ndarray:
    """Parameters of tools that have this calibration, drawn from its covariance."""
    covariance = calibration.parameter_covariance
    errors = rng.multivariate_normal(np.zeros(len(covariance)), covariance, count, method="eigh")
    return calibration.parameters + errors


def surveyed(
    calibration: Calibration,
    where: Path,
    wells: int,
    seed: int = 3,
    iron=IRON,
    references=1.0,
    scale=0.0,
    moments=0.0,
    gravity=(0.0, 0.0),
) -> Readings:
    """Surveys (wells, n) by tools whose calibration is off, in a field that is off its references.

    `references` multiplies the errors of these, of standard deviations that the surveys state. The readings are
    those of a triad field = A reading + c at one temperature. `gravity`: scale and bias by which the accelerometer
    is off, as `scale` and `iron` the magnetometer. `moments`: by how much of `SD_MOMENT` field and dip
    also differ from station to station.
    """
    rng = np.random.default_rng(seed)
    tools = drawn_tools(calibration, rng, wells).reshape(wells, 2, 12)
    matrix, offset = tools[..., :9].reshape(wells, 2, 3, 3), tools[..., 9:]
    vectors = attitude(where.inclination, where.azimuth, where.toolface)
    off = references * rng.normal(size=(wells, 2)) * (SD_FIELD, SD_DIP)
    off = np.repeat(off[:, None], len(where), 1)
    if moments:
        off = off + moments * rng.normal(size=off.shape) * SD_MOMENT
    fields = [vectors(1.0, FIELD + each[:, :1], DIP + each[:, 1]) for each in off]
    g, b = (np.stack(each) for each in zip(*fields, strict=True))
    seen = [
        g * (1 + np.asarray(gravity[0])) + gravity[1],
        b * (1 + np.asarray(scale)) + np.asarray(iron),
    ]
    raw = [
        np.einsum("wij,wnj->wni", np.linalg.inv(matrix[:, t]), v - offset[:, t, None])
        + NOISE[t] * rng.normal(size=v.shape)
        for t, v in enumerate(seen)
    ]
    count = len(where)
    known = {"field": np.full(count, FIELD), "dip": np.full(count, DIP)}
    sd = {
        "accelerometer": np.full((count, 3), NOISE[0]), "magnetometer": np.full((count, 3), NOISE[1]),
        "field": np.full(count, SD_FIELD), "dip": np.full(count, SD_DIP),
    }  # fmt: skip
    if moments:
        sizes = zip(("field", "dip"), SD_MOMENT, strict=True)
        sd |= {f"random-{name}": np.full(count, moments * size) for name, size in sizes}
    labels = tuple(f"S{i + 1}" for i in range(count))
    metadata = {"simulated": True}
    return Readings(*raw, None, known, sd, station=labels, metadata=metadata, source="well.csv")


def one(readings: Readings, well: int = 0) -> Readings:
    """The surveys of one well."""
    first, second = readings.accelerometer[well], readings.magnetometer[well]
    digest = tuple(f"{well}-{i}" for i in range(len(first)))
    return replace(readings, accelerometer=first, magnetometer=second, digest=digest)
