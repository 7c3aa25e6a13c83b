"""Ivanov & Lyutskanova-Zhekova (2019): calibration on toolface and inclination, reproduced.

    MWDCAL_DATA=... python examples/papers/ivanov.py     (writes docs/papers/ivanov.md and its figures)

The first part is the paper's own Gauss-Newton, written from its appendix and independent of
mwdcal: an accelerometer that reads the holding force, a = M v + b, p = (M row by row, b).
The second simulates instruments and compares methods, the third writes the page.
doi:10.1007/978-3-319-97277-0_14; only abstract and appendix were available.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mwdcal.calibrate import calibrate
from mwdcal.core.observability import free_directions
from mwdcal.core.vectors import Array, centred, earth_gravity, rotation, tool_from_earth
from mwdcal.datasets import fetch
from mwdcal.errors import FitError
from mwdcal.estimate import Fit, fit
from mwdcal.profile import Profile, TriadProfile
from mwdcal.readings import Readings
from mwdcal.simulate import Truth, grid, reading, run, servo

DEG = np.pi / 180
PAPER_AXES = np.diag([-1.0, -1.0, 1.0])
"""The paper's axes from ours: it counts the holding force, and z uphole."""
SWITCH = 60 * DEG
"""Raw inclination, condition (14), above which the appendix changes its formula."""

# ── The paper ────────────────────────────────────────────────────────────────────────────────


def parts(p: Array, raw: Array) -> tuple[Array, Array, Array]:
    """B₁, B₂, B₃ (..., n) of the appendix: the components of M v + b."""
    matrix = p[..., :9].reshape(*p.shape[:-1], 3, 3)
    vector = np.einsum("...ij,...nj->...ni", matrix, raw) + p[..., None, 9:]
    return vector[..., 0], vector[..., 1], vector[..., 2]


def angles(p: Array, raw: Array) -> Array:
    """Toolface and inclination (..., n, 2) of the corrected readings, by atan2."""
    b1, b2, b3 = parts(p, raw)
    return np.stack([np.arctan2(b1, b2), np.arctan2(np.hypot(b1, b2), b3)], -1)


def _rows(by_part: Array, raw: Array) -> Array:
    """Derivatives (..., n, 12) by p from those (..., n, 3) by B₁, B₂, B₃."""
    gains = by_part[..., :, None] * raw[..., None, :]
    return np.concatenate([gains.reshape(*gains.shape[:-2], 9), by_part], -1)


def by_vector(b1: Array, b2: Array, b3: Array) -> Array:
    """Derivatives (..., 2, 3) of toolface and inclination by the vector."""
    flat = b1**2 + b2**2
    across, total, zero = np.sqrt(flat), flat + b3**2, np.zeros_like(b1)
    toolface = np.stack([b2 / flat, -b1 / flat, zero], -1)
    slant = b3 / (total * across)
    return np.stack([toolface, np.stack([b1 * slant, b2 * slant, -across / total], -1)], -2)


def corrected(p: Array, raw: Array) -> Array:
    """Derivatives (..., n, 2, 12) of toolface and inclination: the appendix as it should be."""
    gradient = by_vector(*parts(p, raw))
    return np.stack([_rows(gradient[..., i, :], raw) for i in (0, 1)], -2)


def printed_toolface(p: Array, raw: Array, redefined: bool = False) -> Array:
    """J of rows 2i - 1 (..., n, 12) as printed, in rad.

    With A = B₁, B = B₂ as in equation 13, or with the A and B that are defined after it.
    """
    b1, b2, b3 = parts(p, raw)
    a, b = b1, b2
    if redefined:
        a, b = b1**2 + b2**2, np.sqrt(b1**2 + b2**2 + b3**2)
    first = 1 / (b * (1 + a**2 / b**2))
    second = -a / (b**2 * (1 + a**2 / b**2))
    return _rows(np.stack([first, second, np.zeros_like(b1)], -1), raw)


def printed_above(p: Array, raw: Array) -> Array:
    """J of rows 2i (..., n, 12) as printed for more than 60°, in rad."""
    b1, b2, b3 = parts(p, raw)
    a, b = b1**2 + b2**2, np.sqrt(b1**2 + b2**2 + b3**2)
    root = np.sqrt(a / b**2) * np.sqrt(1 - a / b**2)
    first, second = (-(-2 * x * a / b**4 + 2 * x / b**2) / (2 * root) for x in (b1, b2))
    return _rows(np.stack([first, second, a * b3 / (b**4 * root)], -1), raw)


def printed_otherwise(p: Array, raw: Array) -> Array:
    """J of rows 2i (..., n, 12) as printed for "otherwise", up to 60°, in rad."""
    b1, b2, b3 = parts(p, raw)
    b = np.sqrt(b1**2 + b2**2 + b3**2)
    root = np.sqrt(1 - b3**2 / b**2)
    third = -(-(b3**2) / b**3 + 1 / b) / root
    return _rows(np.stack([-b1 * b3 / (b**3 * root), -b2 * b3 / (b**3 * root), third], -1), raw)


def is_above(raw: Array) -> Array:
    """Condition (14): where the uncalibrated reading inclines by more than 60°."""
    return np.asarray(np.arctan2(np.hypot(raw[..., 0], raw[..., 1]), raw[..., 2]) > SWITCH)


def printed(p: Array, raw: Array) -> Array:
    """The appendix as printed (..., n, 2, 12), with A = B₁ and B = B₂ in the toolface rows."""
    with np.errstate(invalid="ignore", divide="ignore"):
        inclination = np.where(
            is_above(raw)[..., None], printed_above(p, raw), printed_otherwise(p, raw)
        )
    return np.stack([printed_toolface(p, raw), inclination], -2)


def complex_step(p: Array, raw: Array) -> Array:
    """Derivatives (n, 2, 12) of the paper's arctan and arccos by complex steps: no formula of ours."""
    columns = []
    for index in range(12):
        stepped = p.astype(complex)
        stepped[index] += 1e-30j
        b1, b2, b3 = parts(stepped, raw)
        length = np.sqrt(b1**2 + b2**2 + b3**2)
        pair = np.stack([np.arctan(b1 / b2), np.arccos(b3 / length)], -1)
        columns.append(pair.imag / 1e-30)
    return np.stack(columns, -1)


@dataclass(frozen=True)
class Solution:
    """Parameters (B, 12), iterations until the step was below 1e-12 (B,), whether it was (B,)."""

    params: Array
    iterations: Array
    converged: Array


def whitening(p: Array, length: Array, known: Array) -> Array:
    """W (B, n, 2, 2): WᵀW is the inverse covariance of the angles for equal noise of the channels.

    Taken at the reference angles, where the noise of the reading does not enter.
    """
    toolface, inclination = known[..., 0], known[..., 1]
    flat = length * np.sin(inclination)
    vector = (flat * np.sin(toolface), flat * np.cos(toolface), length * np.cos(inclination))
    spread = by_vector(*vector) @ p[..., :9].reshape(-1, 1, 3, 3)
    covariance = spread @ np.swapaxes(spread, -1, -2)
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


def gauss_newton(
    raw: Array,
    known: Array,
    weighted: bool = False,
    jacobian: Callable[[Array, Array], Array] = corrected,
    limit: int = 50,
) -> Solution:
    """Minimise the paper's sum of squares (6) for readings (B, n, 3), angles (B or 1, n, 2).

    The normal matrix is singular, for a common factor of p changes no angle: the step is the
    shortest, and the factor is set at the end so that the mean length is one. `weighted`
    replaces the paper's equal weights by those of equal noise in the channels.
    """
    p = np.tile(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), (len(raw), 1))
    iterations, done = np.zeros(len(raw), int), np.zeros(len(raw), bool)
    for _ in range(limit):
        now = np.flatnonzero(~done)
        step = _step(p[now], raw[now], np.broadcast_to(known, (len(raw), *known.shape[1:]))[now],
                     weighted, jacobian)  # fmt: skip
        p[now] += step
        iterations[now] += 1
        done[now] = np.max(np.abs(step), -1) < 1e-12
        if done.all():
            break
    length = np.sqrt(sum(part**2 for part in parts(p, raw)))
    return Solution(p / length.mean(-1)[:, None], iterations, done)


def _step(
    p: Array,
    raw: Array,
    known: Array,
    weighted: bool,
    jacobian: Callable[[Array, Array], Array],
) -> Array:
    residual = angles(p, raw) - known
    residual[..., 0] = centred(residual[..., 0])
    rows, left = jacobian(p, raw), residual[..., None]
    if weighted:
        length = np.sqrt(sum(part**2 for part in parts(p, raw)))
        weight = whitening(p, length, known)
        rows, left = weight @ rows, weight @ left
    rows = rows.reshape(len(p), -1, 12)
    inverse = np.linalg.pinv(np.nan_to_num(rows), rcond=1e-9)
    return -(inverse @ left.reshape(len(p), -1, 1))[..., 0]


# ── Simulated instruments ────────────────────────────────────────────────────────────────────

SEEDS = 400
NOISE = 5e-4
PLAN = ((5, 45, 90, 135), 12)


@dataclass(frozen=True)
class Instruments:
    """Accelerometers that read v = S g + o: S (B, 3, 3) and o (B, 3), all of them simulated."""

    matrix: Array
    offset: Array

    @classmethod
    def mems(cls, count: int, seed: int) -> Instruments:
        """Scale ± 3 %, axes ± 10 mrad, offset ± 30 mg."""
        rng = np.random.default_rng(seed)
        matrix = np.eye(3) * (1 + rng.uniform(-0.03, 0.03, (count, 3, 3)))
        matrix = matrix + 0.01 * rng.uniform(-1, 1, (count, 3, 3)) * (1 - np.eye(3))
        return cls(matrix, rng.uniform(-0.03, 0.03, (count, 3)))

    def read(self, g: Array) -> Array:
        """Readings (B, n, 3) of gravity vectors, without noise."""
        return np.einsum("bij,...nj->bni", self.matrix, g) + self.offset[:, None] if g.ndim == 2 else (
            np.einsum("bij,bnj->bni", self.matrix, g) + self.offset[:, None]
        )  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What goes wrong during the run (1σ, or constant): g, rad, shares."""

    title: str
    noise: float = NOISE
    gravity: float = 0.0
    gravity_error: float = 0.0
    gain: float = 0.0
    inclination: float = 0.0
    tilt: float = 0.0
    stand: float = 0.0


CASES = (
    Case("sensor noise alone"),
    Case("\\|g\\| disturbed by 5 mg at each station", gravity=5e-3),
    Case("common gain wanders by 0.5 % (ratiometric supply)", gain=5e-3),
    Case("local g 5 mg off, unknown to the user", gravity_error=5e-3),
    Case("stand: inclination 0.1° too high throughout", inclination=0.1 * DEG),
    Case("stand: base tilted by 0.1°, across", tilt=0.1 * DEG),
    Case("stand: independent errors of 0.1° in both angles", stand=0.1 * DEG),
)


@dataclass(frozen=True)
class Stations:
    """Nominal angles (n,) of the stations, radians."""

    inclination: Array
    toolface: Array

    @classmethod
    def grid(cls, inclinations: tuple[float, ...], toolfaces: int) -> Stations:
        """Every toolface at every inclination, degrees."""
        plan = grid(list(inclinations), toolfaces, [0.0], [25.0])
        return cls(plan.inclination, plan.toolface)


def simulated(case: Case, stations: Stations, tools: Instruments, seed: int) -> Readings:
    """A batch of runs (B, n, 3), one per instrument; the errors of the stand are not told."""
    rng, count = np.random.default_rng(seed), len(tools.matrix)
    shape = (count, len(stations.inclination))
    normal = rng.normal(size=(4, *shape))
    inclination = stations.inclination + case.inclination + case.stand * normal[0]
    toolface = stations.toolface + case.stand * normal[1]
    strength = 1 + case.gravity_error + case.gravity * normal[2]
    down = rotation(np.array([case.tilt, 0.0, 0.0])) @ np.array([0.0, 0.0, 1.0])
    g = strength[..., None] * (tool_from_earth(inclination, 0.0, toolface) @ down)
    raw = tools.read(g) * (1 + case.gain * normal[3])[..., None]
    raw = raw + case.noise * rng.normal(size=raw.shape)
    sd = {"accelerometer": np.array(case.noise)}
    if case.stand:
        sd |= {name: np.array(case.stand) for name in ("inclination", "toolface")}
    return Readings(
        raw,
        known={"inclination": stations.inclination, "toolface": stations.toolface},
        sd=sd,
        metadata={"simulated": True},
    )


def affine(result: Fit) -> tuple[Array, Array]:
    """M (B, 3, 3) and b (B, 3) of field = M v + b of the accelerometer."""
    where = result.problem.slices()[0]
    _, whole = result.problem.triads[0].model.finished(0.0)
    params = np.einsum("bij,bj->bi", whole, result.state.params[:, where])
    return params[:, :9].reshape(-1, 3, 3), params[:, 9:]


def from_paper(p: Array) -> tuple[Array, Array]:
    """M and b in our axes of the paper's parameters; readings are in our axes already."""
    return PAPER_AXES @ p[:, :9].reshape(-1, 3, 3) @ PAPER_AXES, p[:, 9:] @ PAPER_AXES


def in_paper_axes(readings: Readings) -> tuple[Array, Array]:
    """Readings (B, n, 3) and toolface, inclination (1, n, 2) as the paper has them."""
    known = np.stack([readings.known["toolface"], readings.known["inclination"]], -1)
    return readings.accelerometer @ PAPER_AXES, known[None]


def paper_method(readings: Readings, weighted: bool = False) -> tuple[Array, Array]:
    """M and b by the paper's Gauss-Newton with the corrected derivatives."""
    return from_paper(gauss_newton(*in_paper_axes(readings), weighted).params)


def ours(method: str) -> Callable[[Readings], tuple[Array, Array]]:
    """M and b by a method of mwdcal."""

    def solve(readings: Readings) -> tuple[Array, Array]:
        result = fit(readings, method)
        if (result.status != 0).any():
            raise FitError(f"{method}: {int((result.status != 0).sum())} fits failed.")
        return affine(result)

    return solve


METHODS: dict[str, Callable[[Readings], tuple[Array, Array]]] = {
    "least-squares": ours("least-squares"),
    "toolface-inclination": ours("toolface-inclination"),
    "paper": paper_method,
    "joint": ours("joint"),
    "scalar": ours("scalar"),
}


def _attitudes(count: int = 200) -> Array:
    """Directions of gravity (count, 3) spread over the sphere, none of them a station."""
    rng = np.random.default_rng(99)
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Errors:
    """Mean squares (B,) over 200 other attitudes: inclination, toolface·sin I, both; and of |g|."""

    inclination: Array
    toolface: Array
    direction: Array
    strength: Array


def errors(tools: Instruments, solved: tuple[Array, Array], turned: bool = False) -> Errors:
    """Errors of a calibration at other attitudes; `turned` grants the best rotation first."""
    true = _attitudes()
    found = np.einsum("bij,bnj->bni", solved[0], tools.read(true)) + solved[1][:, None]
    strength = np.linalg.norm(found, axis=-1)
    if turned:
        u, _, vt = np.linalg.svd(np.einsum("ni,bnj->bij", true, found))
        found = np.einsum("bij,bnj->bni", u @ vt, found)
    sine = np.hypot(true[:, 0], true[:, 1])
    down = np.arctan2(np.hypot(found[..., 0], found[..., 1]), found[..., 2])
    inclination = down - np.arctan2(sine, true[:, 2])
    turn = np.arctan2(-found[..., 0], -found[..., 1]) - np.arctan2(-true[:, 0], -true[:, 1])
    squares = inclination**2, (sine * centred(turn)) ** 2
    means = [np.mean(square, -1) for square in squares]
    return Errors(means[0], means[1], means[0] + means[1], np.mean((strength - 1) ** 2, -1))


@dataclass(frozen=True)
class Ratio:
    """Ratio of two root mean squares of the same seeds, with its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, over: Array, under: Array) -> Ratio:
        """From mean squares (B,), paired by seed; the error to first order."""
        value = float(np.sqrt(over.mean() / under.mean()))
        pulled = over / over.mean() - under / under.mean()
        return cls(value, value / 2 * float(pulled.std(ddof=1)) / np.sqrt(len(over)))

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.error:.3f}"
