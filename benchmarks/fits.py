"""One fit of one tool against `scipy.optimize.least_squares`: 12, 30 and 60 parameters.

What both minimise is the same: error of the reading over its noise, at stations of exactly known
attitude,

    V = SF(τ) [(I - m)⁻¹ v + B(τ)]      (Moosavi's factors; order 0: 12 a triad, order 3: 30)

from the same start, the nominal tool. SciPy gets what does it most good: one vectorised NumPy
function, scaled Chebyshev polynomials of temperature, the magnetometer in units of the field, so
that all columns are of like size. `mwdcal.calibration.estimate.fit` does more than find the minimum: rank,
the covariance of all parameters and the share of each station are in its time.

The 60 of an uncertain stand have 540 unknowns more: three angles of every station. SciPy
estimates them all, mwdcal takes them out of each station; the two are the same up to the
curvature of an angle.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from measuring import Row, against
from scipy.optimize import OptimizeResult, least_squares

from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.estimation.problem import ANGLES
from mwdcal.sensor.models import OFF_DIAGONAL, Basis
from simulation import (
    DEG,
    attitude,
    factor_fields,
    factor_readings,
    factors_within_limits,
    plan,
)

FIELD, DIP = 50_000.0, 65 * DEG
UNIT = np.repeat([1.0, FIELD], 3)
NOISE = np.repeat([1e-4, 15.0], 3)
STAND = np.array([0.01, 0.05, 0.02]) * DEG
"""Standard uncertainty of inclination, azimuth and toolface of a servo stand."""


class Case(NamedTuple):
    """A simulated run to be fitted: readings (n, 6), attitudes (3, n), temperatures (n,)."""

    triads: int
    order: int
    raw: np.ndarray
    angles: np.ndarray
    warmth: np.ndarray
    stand: np.ndarray

    @property
    def readings(self) -> Readings:
        """The run as mwdcal takes it."""
        count = len(self.warmth)
        known = dict(zip(ANGLES, self.angles, strict=True))
        known |= {"field": np.full(count, FIELD), "dip": np.full(count, DIP)}
        sd = {name: np.full(count, s) for name, s in zip(ANGLES, self.stand, strict=True) if s}
        sd |= dict(zip(TRIADS, np.broadcast_to(NOISE.reshape(2, 1, 3), (2, count, 3)), strict=True))
        pair = (self.raw[:, :3], self.raw[:, 3:] if self.triads == 2 else None)
        return Readings(*pair, self.warmth, known, sd)

    @property
    def options(self) -> Options:
        """How mwdcal fits it by default: at order 0 in gains and offsets, which is the same model."""
        return Options(order=self.order)


def simulated(triads: int, order: int, stand: bool = False, seed: int = 60) -> Case:
    """48 stations at one temperature, or 36 at each of five."""
    rng = np.random.default_rng(seed)
    tool = factors_within_limits(rng, 1)[0]
    soaks = np.linspace(25.0, 150.0, 5) if order else np.array([30.0])
    once = np.stack(plan((0, 45, 90, 135), 9) if order else plan())
    angles, warmth = np.tile(once, len(soaks)), np.repeat(soaks, once.shape[1])
    sigma = STAND if stand else np.zeros(3)
    true = angles + sigma[:, None] * rng.normal(size=angles.shape)
    raw = factor_readings(tool, warmth, vectors(true) * UNIT)
    raw = raw + NOISE * rng.normal(size=raw.shape)
    return Case(triads, order, raw, angles, warmth, sigma)


def vectors(angles: np.ndarray) -> np.ndarray:
    """Reference vectors (n, 6) of attitudes (3, n), of unit size."""
    return np.concatenate(attitude(*angles)(1.0, 1.0, DIP), -1)


class Forward:
    """Whitened misfit of the readings as a function of all factors, and its derivative."""

    def __init__(self, case: Case) -> None:
        low, high = case.warmth.min(), case.warmth.max()
        basis = Basis(case.order, (low + high) / 2, (high - low) / 2 or 1.0, chebyshev=True)
        self.case, self.phi = case, basis(case.warmth)
        self.count = self.phi.shape[-1]
        self.each = 6 * self.count + 6
        self.known = vectors(case.angles)
        self.raw, self.weight = case.raw / UNIT, UNIT / NOISE
        self.start = np.zeros(case.triads * self.each)
        for triad in range(case.triads):
            own = triad * self.each + self.count * np.arange(3)
            self.start[own] = 1.0

    def parts(self, one: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, ...]:
        """(I - m)⁻¹, the vectors in sensor axes, scale and bias (n, 3) of one triad."""
        linear = one[: 6 * self.count].reshape(2, 3, self.count)
        mixing = np.eye(3)
        for (i, j), value in zip(OFF_DIAGONAL, one[6 * self.count :], strict=True):
            mixing[i, j] = -value
        back = np.linalg.inv(mixing)
        return back, known @ back.transpose(), *(self.phi @ linear[k].transpose() for k in (0, 1))

    def misfit(self, params: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
        """(Predicted reading - reading) / noise, flat."""
        known = self.known if known is None else known
        found = []
        for t in range(self.case.triads):
            own = slice(3 * t, 3 * t + 3)
            one = params[t * self.each : (t + 1) * self.each]
            _, turned, scale, bias = self.parts(one, known[:, own])
            error = scale * (turned + bias) - self.raw[:, own]
            found.append((error * self.weight[own]).ravel())
        return np.concatenate(found)

    def jacobian(self, params: np.ndarray) -> np.ndarray:
        """Derivative (all, p) of `misfit` by the factors."""
        rows, count = 3 * len(self.phi), self.count
        whole = np.zeros((self.case.triads * rows, len(params)))
        for t in range(self.case.triads):
            own = slice(3 * t, 3 * t + 3)
            first = t * self.each
            back, turned, scale, bias = self.parts(
                params[first : first + self.each], self.known[:, own]
            )
            block = whole[t * rows : (t + 1) * rows].reshape(-1, 3, len(params))
            unit = (turned + bias) * self.weight[own]
            heavy = scale * self.weight[own]
            for i in range(3):
                at = first + i * count
                block[:, i, at : at + count] = unit[:, i, None] * self.phi
                block[:, i, at + 3 * count : at + 4 * count] = heavy[:, i, None] * self.phi
            for k, (i, j) in enumerate(OFF_DIAGONAL):
                block[..., first + 6 * count + k] = heavy * back[:, i] * turned[:, j, None]
        return whole

    def whole_misfit(self, unknowns: np.ndarray) -> np.ndarray:
        """The same, with three angles of every station, in units of their uncertainty, besides."""
        size = len(self.start)
        turns = unknowns[size:].reshape(3, -1)
        known = vectors(self.case.angles + self.case.stand[:, None] * turns)
        return np.concatenate([self.misfit(unknowns[:size], known), unknowns[size:]])

    def corrected(self, params: np.ndarray) -> np.ndarray:
        """The readings corrected with these factors (n, 6), over their noise."""
        found = []
        for t in range(self.case.triads):
            own = slice(3 * t, 3 * t + 3)
            one = params[t * self.each : (t + 1) * self.each]
            back, _, scale, bias = self.parts(one, self.known[:, own])
            unit = self.raw[:, own] / scale - bias
            found.append(np.linalg.solve(back, unit.transpose()).transpose() * self.weight[own])
        return np.concatenate(found, -1)


def scipy_fit(
    misfit: Callable[[np.ndarray], np.ndarray], start: np.ndarray, **options: object
) -> OptimizeResult:
    """SciPy's minimum; method and tolerances (1e-8) as they come."""
    return least_squares(misfit, start, **options)


def equal(forward: Forward, ours: Fit, theirs: OptimizeResult) -> str:
    """Largest difference of the corrected readings in units of their noise."""
    fields = ours.problem.fields(ours.state)[: forward.case.triads]
    mine = np.concatenate(fields, -1)[0] / NOISE[: 3 * forward.case.triads]
    apart = np.abs(mine - forward.corrected(theirs.x)).max()
    return agreement(apart, theirs)


def agreement(apart: float, theirs: OptimizeResult) -> str:
    """How equal two results are, and what it took SciPy."""
    return f"corrected readings within {apart:.0e} of the noise; SciPy: {theirs.nfev} iterations"


def exact_stand(triads: int, order: int) -> list[Row]:
    """Stations of exactly known attitude."""
    case = simulated(triads, order)
    forward, name = Forward(case), f"{triads * (6 * order + 12)} factors"
    jobs: dict[str, Callable[[], OptimizeResult]] = {}
    for words, options in (
        ("SciPy, numeric Jacobian", {}),
        ("SciPy, numeric Jacobian, x_scale=jac", {"x_scale": "jac"}),
        ("SciPy, analytic Jacobian", {"jac": forward.jacobian}),
    ):
        jobs[words] = partial(scipy_fit, forward.misfit, forward.start, **options)
    whole = partial(fit, case.readings, case.options)
    mine = whole()
    same = {words: equal(forward, mine, job()) for words, job in jobs.items()}
    return against(name, whole, jobs, same)


def as_printed() -> list[Row]:
    """60 factors in the paper's own parameters: powers of T - 30 °C, and nT."""
    case = simulated(2, 3)
    start = np.zeros(60)
    start[[0, 4, 8, 30, 34, 38]] = 1.0
    known = vectors(case.angles) * UNIT

    def misfit(params: np.ndarray) -> np.ndarray:
        return ((factor_readings(params, case.warmth, known) - case.raw) / NOISE).ravel()

    jobs = {
        "SciPy in powers of T, numeric Jacobian": partial(scipy_fit, misfit, start),
        "SciPy in powers of T, numeric Jacobian, x_scale=jac": partial(
            scipy_fit, misfit, start, x_scale="jac"
        ),
    }
    whole = partial(fit, case.readings, case.options)
    fields = np.concatenate(whole().problem.fields(whole().state), -1)[0]
    same = {}
    for words, job in jobs.items():
        theirs = job()
        apart = np.abs(fields - factor_fields(theirs.x, case.warmth, case.raw)) / NOISE
        same[words] = agreement(apart.max(), theirs)
    return against("60 factors", whole, jobs, same)


def uncertain_stand() -> list[Row]:
    """60 factors and the angles of 180 stations, which are known to hundredths of a degree."""
    case = simulated(2, 3, stand=True)
    forward = Forward(case)
    start = np.concatenate([forward.start, np.zeros(case.angles.size)])
    jobs = {
        "SciPy, 600 unknowns, numeric Jacobian": partial(scipy_fit, forward.whole_misfit, start),
        "SciPy, 600 unknowns, numeric Jacobian, x_scale=jac": partial(
            scipy_fit, forward.whole_misfit, start, x_scale="jac"
        ),
    }
    whole = partial(fit, case.readings, case.options)
    mine = whole()
    same = {words: equal(forward, mine, job()) for words, job in jobs.items()}
    return against("60 factors, uncertain stand", whole, jobs, same)


def rows() -> list[Row]:
    """All fits, smallest first."""
    found = [row for size in ((1, 0), (1, 3), (2, 3)) for row in exact_stand(*size)]
    return found + as_printed() + uncertain_stand()
