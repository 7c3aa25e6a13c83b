"""Simulated runs of a known tool: for examples, tests and studies. Always labelled simulated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.prediction import raw_reading
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.evidence import ANGLES
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.sensor.models import Basis, Factors


class Earth(NamedTuple):
    """Gravity, g, field, nT, and dip, radians, of a place."""

    gravity: float = 1.0
    field: float = 48_000.0
    dip: float = float(np.radians(63.0))


@dataclass(frozen=True)
class StationPlan:
    """Attitudes (n,) in radians and temperatures (n,) in °C, in the order they are measured."""

    inclination: Array
    azimuth: Array
    toolface: Array
    temperature: Array

    @property
    def count(self) -> int:
        """Number of stations."""
        return len(self.inclination)


def grid(
    inclinations: list[float], toolfaces: int, azimuths: list[float], temperatures: list[float]
) -> StationPlan:
    """Every toolface at every inclination (degrees), azimuths in turn, at every temperature."""
    inc = np.repeat(np.radians(inclinations), toolfaces)
    tool = np.tile(np.arange(toolfaces) * 2 * np.pi / toolfaces, len(inclinations))
    azi = np.repeat(np.resize(np.radians(azimuths), len(inclinations)), toolfaces)
    count, soaks = len(inc), len(temperatures)
    return StationPlan(
        np.tile(inc, soaks),
        np.tile(azi, soaks),
        np.tile(tool, soaks),
        np.repeat(temperatures, count),
    )


@dataclass(frozen=True)
class Truth:
    """A tool of two triads of factors (30 each at order 3), and the earth it stands on."""

    accelerometer: Array
    magnetometer: Array
    order: int = 3
    reference: float = 30.0
    gravity: float = 1.0
    field: float = 48_000.0
    dip: float = np.radians(63.0)

    @property
    def model(self) -> Factors:
        """The model of both triads."""
        return Factors(Basis(self.order, self.reference))


def servo(rng: np.random.Generator) -> Truth:
    """A servo instrument within the datasheet limits of Moosavi's Table 1.

    Scale ± 5 %, bias ± 10 mg, axis alignment ± 2 mrad, scale drift ± 180 ppm/°C, bias drift
    ± 100 µg/°C, with a tenth and a hundredth of the drift over 100 °C in the square and the
    cube. The magnetometer: scale ± 2 %, hard iron ± 1 % of 50 µT, alignment ± 4 mrad.
    """
    return Truth(
        _triad(rng, 0.05, 0.010, 2e-3, 180e-6, 100e-6), _triad(rng, 0.02, 500.0, 4e-3, 100e-6, 2.0)
    )


def _triad(
    rng: np.random.Generator,
    scale: float,
    bias: float,
    alignment: float,
    scale_drift: float,
    bias_drift: float,
) -> Array:
    course = np.array([1.0, 1e-3, 1e-6])
    terms = []
    for middle, spread, drift in ((1.0, scale, scale_drift), (0.0, bias, bias_drift)):
        steady = middle + rng.uniform(-spread, spread, (3, 1))
        terms += [steady, drift * rng.uniform(-1, 1, (3, 3)) * course]
    scales, biases = np.hstack(terms[:2]), np.hstack(terms[2:])
    return np.concatenate([scales.ravel(), biases.ravel(), rng.uniform(-alignment, alignment, 6)])


def reading(truth: Truth, plan: StationPlan) -> tuple[Array, Array]:
    """What the tool's channels read (n, 3) without noise, nominal units: the model, inverted."""
    fields = reference_vectors(
        plan.inclination, plan.azimuth, plan.toolface, truth.gravity, truth.field, truth.dip
    )
    g, b = (
        raw_reading(truth.model, params, field, plan.temperature, steps=1)
        for params, field in zip((truth.accelerometer, truth.magnetometer), fields, strict=True)
    )
    return g, b


def run(
    truth: Truth,
    plan: StationPlan,
    rng: np.random.Generator,
    noise: tuple[float, float] = (1e-4, 15.0),
    stand: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Readings:
    """Readings with noise (g, nT), at a stand whose angles are off by `stand` (radians, 1 σ)."""
    count = len(plan.inclination)
    known = {name: getattr(plan, name) for name in ANGLES}
    off = {
        name: known[name] + sd * rng.normal(size=count)
        for name, sd in zip(ANGLES, stand, strict=True)
    }
    g, b = reading(truth, replace(plan, **off))
    known |= {name: np.full(count, getattr(truth, name)) for name in ("gravity", "field", "dip")}
    return Readings(
        g + noise[0] * rng.normal(size=g.shape),
        b + noise[1] * rng.normal(size=b.shape),
        plan.temperature,
        known,
        station=tuple(str(i + 1) for i in range(count)),
        metadata={"simulated": True},
    )
