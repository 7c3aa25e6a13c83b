"""Ivanov & Lyutskanova-Zhekova (2019): calibration on toolface and inclination, reproduced.

    MWDCAL_DATA=... python examples/papers/ivanov.py     (writes docs/evidence/papers/ivanov.md and its figures)

The first part is the paper's own Gauss-Newton, written from its appendix and independent of
mwdcal: an accelerometer that reads the holding force, a = M v + b, p = (M row by row, b).
The second simulates instruments and compares methods, the third writes the page.
doi:10.1007/978-3-319-97277-0_14; only abstract and appendix were available.
It is about the estimators, and imports the core.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mwdcal import FitError, Options, Profile, Readings, calibrate
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.estimation.uncertainty import free_directions
from mwdcal.files.datasets import fetch
from mwdcal.geometry.vectors import Array, centred, earth_gravity, rotation, tool_from_earth
from mwdcal.planning.plans import Truth, grid, run, servo
from mwdcal.sensor.profile import TriadProfile

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
    every = np.broadcast_to(known, (len(raw), *known.shape[1:]))
    for _ in range(limit):
        now = np.flatnonzero(~done)
        step = _step(p[now], raw[now], every[now], weighted, jacobian)
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
        """Readings (B, n, 3) of gravity vectors (n, 3) or (B, n, 3), without noise."""
        return g @ np.swapaxes(self.matrix, -1, -2) + self.offset[:, None]


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


@dataclass(frozen=True)
class Solved:
    """Calibrations field = M v + b, and how many did not meet the solver's criterion."""

    matrix: Array
    offset: Array
    unsettled: int = 0

    def __call__(self, raw: Array) -> Array:
        """Corrected readings (B, n, 3)."""
        return np.einsum("bij,bnj->bni", self.matrix, raw) + self.offset[:, None]


def affine(result: Fit) -> Solved:
    """The accelerometer's M and b of a batch of fits."""
    where = result.problem.slices()[0]
    _, whole = result.problem.triads[0].model.finished(0.0)
    params = np.einsum("bij,bj->bi", whole, result.state.params[:, where])
    unsettled = int((result.status != 0).sum())
    return Solved(params[:, :9].reshape(-1, 3, 3), params[:, 9:], unsettled)


def from_paper(p: Array) -> Solved:
    """M and b in our axes of the paper's parameters; readings are in our axes already."""
    return Solved(PAPER_AXES @ p[:, :9].reshape(-1, 3, 3) @ PAPER_AXES, p[:, 9:] @ PAPER_AXES)


def in_paper_axes(readings: Readings) -> tuple[Array, Array]:
    """Readings (B, n, 3) and toolface, inclination (1, n, 2) as the paper has them."""
    known = np.stack([readings.known["toolface"], readings.known["inclination"]], -1)
    return readings.accelerometer @ PAPER_AXES, known[None]


def paper_method(readings: Readings, weighted: bool = False) -> Solved:
    """M and b by the paper's Gauss-Newton with the corrected derivatives."""
    return from_paper(gauss_newton(*in_paper_axes(readings), weighted).params)


def ours(method: str) -> Callable[[Readings], Solved]:
    """A method of mwdcal."""

    def solve(readings: Readings) -> Solved:
        return affine(fit(readings, Options(method)))

    return solve


METHODS: dict[str, Callable[[Readings], Solved]] = {
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


def errors(tools: Instruments, solved: Solved, turned: bool = False) -> Errors:
    """Errors of a calibration at other attitudes; `turned` grants the best rotation first."""
    true = _attitudes()
    found = solved(tools.read(true))
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


# ── Studies ──────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Check:
    """Printed derivatives against complex steps: which, where, and smallest and largest ratio."""

    rows: str
    parameters: str
    where: str
    low: float
    high: float


TURNED = (0, 1, 2, 3, 4, 5, 9, 10)
ALONG = (6, 7, 8, 11)


def random_readings(count: int, seed: int) -> tuple[Array, Array]:
    """Parameters (12,) of a crooked triad and readings (count, 3) in all directions, paper's axes."""
    rng = np.random.default_rng(seed)
    p = np.concatenate([np.eye(3).ravel(), np.zeros(3)]) + 0.05 * rng.uniform(-1, 1, 12)
    raw = rng.normal(size=(count, 3))
    return p, raw / np.linalg.norm(raw, axis=-1, keepdims=True)


def checks(count: int = 20_000) -> list[Check]:
    """Every printed formula of the appendix against complex steps of arctan and arccos."""
    p, raw = random_readings(count, 5)
    true, above = complex_step(p, raw), is_above(raw)
    over = angles(p, raw)[:, 1] > 90 * DEG
    everywhere = np.ones(count, bool)
    steep, slant = above & ~over, above & over
    literal = printed_toolface(p, raw, redefined=True)
    rows = [
        ("2i − 1", "p₁…p₆, p₁₀, p₁₁; A = B₁, B = B₂", "everywhere", everywhere, TURNED, 0,
         printed_toolface(p, raw)),
        ("2i − 1", "p₁…p₆, p₁₀, p₁₁; A, B as defined after (13)", "everywhere", everywhere,
         TURNED, 0, literal),
        ("2i", "p₁…p₆, p₁₀, p₁₁", "up to 60°", ~above, TURNED, 1, printed_otherwise(p, raw)),
        ("2i", "p₇, p₈, p₉, p₁₂", "up to 60°", ~above, ALONG, 1, printed_otherwise(p, raw)),
        ("2i", "all twelve", "60° to 90°", steep, range(12), 1, printed_above(p, raw)),
        ("2i", "all twelve", "above 90°", slant, range(12), 1, printed_above(p, raw)),
    ]  # fmt: skip
    result = []
    for name, parameters, where, chosen, columns, angle, formula in rows:
        at = np.ix_(chosen, columns)
        ratio = formula[at] / true[:, angle][at]
        result.append(Check(name, parameters, where, float(ratio.min()), float(ratio.max())))
    return result


def poles() -> list[tuple[str, float, float]]:
    """Relative error of the printed ∂inclination/∂p₁₂ close to where its root vanishes."""
    p = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    result = []
    for distance in (1e-2, 1e-4, 1e-6, 1e-8):
        found = []
        for inclination, formula, sign in (
            (distance, printed_otherwise, 1.0),
            (np.pi / 2 - distance, printed_above, -1.0),
        ):
            flat = np.sin(inclination) / np.sqrt(2)
            raw = np.array([[flat, flat, np.cos(inclination)]])
            true = corrected(p, raw)[0, 1, 11]
            with np.errstate(divide="ignore", invalid="ignore"):
                found.append(float(np.abs(sign * formula(p, raw)[0, 11] / true - 1)))
        result.append((f"{distance:.0e} rad", *found))
    return result


@dataclass(frozen=True)
class Comparison:
    """Errors of every method in one case."""

    case: Case
    errors: dict[str, Errors]
    unsettled: dict[str, int]

    def ratio(self, method: str, other: str = "least-squares") -> Ratio:
        """Ratio of the angular errors of two methods."""
        return Ratio.of(self.errors[method].direction, self.errors[other].direction)


def compare(
    case: Case, seed: int, methods: tuple[str, ...] = tuple(METHODS), plan: tuple = PLAN
) -> Comparison:
    """Simulate `SEEDS` instruments, calibrate each by every method, and judge at other attitudes."""
    tools = Instruments.mems(SEEDS, seed)
    readings = simulated(case, Stations.grid(*plan), tools, seed + 1)
    solved = {name: METHODS[name](readings) for name in methods}
    found = {name: errors(tools, solved[name], name == "scalar") for name in methods}
    return Comparison(case, found, {name: each.unsettled for name, each in solved.items()})


DISTURBANCES = (0.0, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2)
"""1σ of |g| at each station, g."""
LOWEST = (2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 45.0)
"""Lowest inclination of the plan, degrees."""


def disturbed() -> list[Comparison]:
    """The methods as |g| is disturbed more and more."""
    names = ("least-squares", "toolface-inclination", "scalar")
    return [
        compare(Case("", gravity=size), 300 + 2 * i, names) for i, size in enumerate(DISTURBANCES)
    ]


def lowest() -> list[Comparison]:
    """Equal weights against weights of equal noise, as the lowest stations near the vertical."""
    names = ("paper", "toolface-inclination")
    return [
        compare(Case(""), 400 + 2 * i, names, ((low, 60, 90, 135), 12))
        for i, low in enumerate(LOWEST)
    ]


@dataclass(frozen=True)
class Descent:
    """The paper's method on sensor noise: iterations, agreement with mwdcal, printed signs."""

    iterations: tuple[int, int]
    agreement: float
    noiseless: float
    null: float
    printed_converged: int
    printed_error: float
    corrected_error: float


def descent() -> Descent:
    """Run the paper's Gauss-Newton with corrected and printed derivatives."""
    tools, stations = Instruments.mems(SEEDS, 500), Stations.grid(*PLAN)
    noisy = simulated(Case(""), stations, tools, 501)
    exact = replace(simulated(Case("", noise=0.0), stations, tools, 502), sd=noisy.sd)
    with np.errstate(all="ignore"):
        wrong = gauss_newton(*in_paper_axes(noisy), jacobian=printed)
        wrong_errors = errors(tools, from_paper(wrong.params)).direction
    right = gauss_newton(*in_paper_axes(noisy))
    mine, paper = ours("toolface-inclination")(noisy), paper_method(noisy, weighted=True)
    p, raw = random_readings(200, 6)
    return Descent(
        (int(right.iterations.min()), int(right.iterations.max())),
        apart(tools, mine, paper) / float(np.sqrt(errors(tools, mine).direction.mean())),
        apart(tools, ours("toolface-inclination")(exact), paper_method(exact)),
        float(np.abs(printed(p, raw)[:, 1] @ p).max()),
        int(wrong.converged.sum()),
        float(np.sqrt(np.median(wrong_errors))),
        float(np.sqrt(np.median(errors(tools, from_paper(right.params)).direction))),
    )


def apart(tools: Instruments, one: Solved, other: Solved) -> float:
    """Largest angle between the directions that two calibrations give, rad, over all seeds."""
    raw = tools.read(_attitudes())
    found = [solved(raw) for solved in (one, other)]
    unit = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in found]
    return float(np.linalg.norm(unit[0] - unit[1], axis=-1).max())


def ranks() -> list[tuple[str, int, int, int]]:
    """Rank of 12 and 30 of each evidence; nominal triad, 0.5, 45, 90, 135° × 12, 5 temperatures."""
    truth = servo(np.random.default_rng(0))
    nominal = np.concatenate([np.tile([1.0, 0, 0, 0], 3), np.zeros(18)])
    drifting = truth
    truth = replace(truth, accelerometer=nominal)
    rows = []
    for name in ("least-squares", "toolface-inclination", "scalar"):
        found = [
            _rank(name, tool, order, temperatures)
            for tool, order, temperatures in (
                (truth, 0, [30.0]),
                (truth, 3, [0.0, 37.5, 75.0, 112.5, 150.0]),
                (drifting, 3, [0.0, 37.5, 75.0, 112.5, 150.0]),
            )
        ]
        rows.append((name, *found))
    return rows


def _rank(method: str, truth: Truth, order: int, temperatures: list[float]) -> int:
    plan = grid([0.5, 45, 90, 135], 12, [0.0], temperatures)
    whole = run(truth, plan, np.random.default_rng(1))
    alone = Readings(
        whole.accelerometer,
        None,
        whole.temperature,
        {name: whole.known[name] for name in ("inclination", "toolface")},
        {"accelerometer": np.array(1e-4)},
    )
    return int(fit(alone, Options(method, "factors", order)).analysis.determined.rank[0])


# ── Measured ─────────────────────────────────────────────────────────────────────────────────

FACES = {
    "x_p": (90, 270),
    "x_a": (90, 90),
    "y_p": (90, 180),
    "y_a": (90, 0),
    "z_p": (0, 0),
    "z_a": (180, 0),
}
"""Inclination and toolface of each face of the imucal session, degrees."""
COUNTS = 2045.0


@dataclass(frozen=True)
class Measured:
    """imucal's six faces: ranks, names of what is free, refusal, and differences of the methods."""

    rank: int
    classical: int
    free: tuple[str, ...]
    refusal: str
    axes: float
    offset: float
    faces: float
    repeat: float


def imucal() -> Measured:
    """Angles alone on six static faces, against least squares on the same."""
    rows = list(csv.DictReader(fetch("imucal/annotated_session.csv").read_text().splitlines()))
    samples = [
        np.array([[float(r[f"acc_{axis}"]) for axis in "xyz"] for r in rows if r["part"] == face])
        for face in FACES
    ]
    known = np.radians(list(FACES.values()))
    readings = Readings(
        np.stack([s.mean(0) for s in samples]) / COUNTS,
        known={"inclination": known[:, 0], "toolface": known[:, 1]},
        sd={"accelerometer": np.stack([s.std(0, ddof=1) for s in samples]) / COUNTS},
        station=tuple(FACES),
    )
    try:
        calibrate(
            readings,
            Profile(name="imucal", accelerometer=TriadProfile(scale=1 / COUNTS)),
            Options("toolface-inclination"),
        )
        refusal = "accepted"
    except FitError as error:
        refusal = str(error)
    ours_, theirs = (fit(readings, Options(m)) for m in ("toolface-inclination", "least-squares"))
    determined = ours_.analysis.determined
    return Measured(
        int(determined.rank[0]),
        int(theirs.analysis.determined.rank[0]),
        tuple(free.id for free in free_directions(ours_.problem, ours_.state, determined)[0]),
        refusal,
        *_differences(affine(ours_), affine(theirs), readings),
        float(max(s.std(0, ddof=1).max() / np.sqrt(len(s)) for s in samples)) / COUNTS,
    )


def _differences(one: Solved, other: Solved, readings: Readings) -> tuple[float, float, float]:
    """Largest angle of channel axes, of offsets (g), and direction error of faces by least squares."""
    forward = [np.linalg.inv(solved.matrix[0]) for solved in (one, other)]
    unit = [s / np.linalg.norm(s, axis=0) for s in forward]
    offsets = [-s @ c.offset[0] for s, c in zip(forward, (one, other), strict=True)]
    field = other(readings.accelerometer[None])[0]
    attitude = tool_from_earth(readings.known["inclination"], 0.0, readings.known["toolface"])
    true = np.einsum("nij,j->ni", attitude, earth_gravity(1.0))
    wrong = np.linalg.norm(np.cross(field, true), axis=-1) / np.linalg.norm(field, axis=-1)
    return (
        float(np.linalg.norm(unit[0] - unit[1], axis=0).max()),
        float(np.abs(offsets[0] - offsets[1]).max()),
        float(wrong.max()),
    )


# ── Page ─────────────────────────────────────────────────────────────────────────────────────

PAGE = Path(__file__).parents[2] / "docs" / "evidence" / "papers" / "ivanov.md"
COLOURS = ("#6b7280", "#0072b2", "#d55e00")
STYLE = {
    "axes.edgecolor": "#4b5563",
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.5,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4,
    "svg.fonttype": "path",
    "svg.hashsalt": "mwdcal",
    "text.parse_math": False,
}


@contextmanager
def drawn(name: str, width: float, height: float, columns: int) -> Iterator[list]:
    """Axes side by side of a figure, written as docs/evidence/papers/ivanov-NAME.svg when left."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        yield list(np.atleast_1d(figure.subplots(1, columns)))
        path = PAGE.with_name(f"ivanov-{name}.svg")
        figure.savefig(path, metadata={"Date": None})
    lines = path.read_text("utf-8").splitlines()
    path.write_text("\n".join(line.rstrip() for line in lines) + "\n", encoding="utf-8")


def draw_derivatives() -> None:
    """Printed over true derivative against inclination, for both groups of parameters."""
    p = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    inclination = np.radians(np.arange(1.5, 179, 1.0))
    turn = 0.7
    raw = np.stack(
        [np.sin(inclination) * np.sin(turn), np.sin(inclination) * np.cos(turn),
         np.cos(inclination)], -1,
    )  # fmt: skip
    ratio = printed(p, raw)[:, 1] / corrected(p, raw)[:, 1]
    with drawn("derivatives", 6.6, 2.5, 1) as (axes,):
        for columns, label, marker, colour, shift in (
            (TURNED, "p₁…p₆, p₁₀, p₁₁", "o", COLOURS[2], 0.03),
            (ALONG, "p₇, p₈, p₉, p₁₂", "s", COLOURS[1], -0.03),
        ):
            value = ratio[:, columns[0]] + shift
            axes.plot(
                np.degrees(inclination)[::3], value[::3], marker, color=colour, label=label, ms=3
            )
        axes.axvline(60, color=COLOURS[0], lw=0.8, ls="--")
        axes.set_xticks(range(0, 181, 30))
        axes.set_yticks([-1, 0, 1])
        axes.set_ylim(-1.5, 1.5)
        axes.set_xlabel("inclination, °")
        axes.set_ylabel("printed / true derivative")
        axes.set_title("Derivatives of the inclination as printed (dashed: change of formula, 60°)")
        axes.legend(loc="center right")


def draw_ratios(disturbances: list[Comparison], lows: list[Comparison]) -> None:
    """Angular error against the disturbance of |g|; price of equal weights near the vertical."""
    with drawn("errors", 6.9, 2.9, 2) as (left, right):
        shown = (
            ("least-squares", "least squares", "o"),
            ("toolface-inclination", "toolface-inclination", "s"),
            ("scalar", "scalar, best rotation granted", "^"),
        )
        x = 1e3 * np.array(DISTURBANCES)
        for (method, label, marker), colour in zip(shown, COLOURS, strict=True):
            squares = [c.errors[method].direction for c in disturbances]
            mean = np.array([np.degrees(np.sqrt(s.mean())) for s in squares])
            share = np.array([s.std(ddof=1) / np.sqrt(len(s)) / s.mean() / 2 for s in squares])
            left.errorbar(x, mean, 2 * share * mean, marker=marker, color=colour, label=label)
        left.set_xscale("symlog", linthresh=0.1)
        left.set_yscale("log")
        left.set_yticks(
            [0.01, 0.02, 0.05, 0.1, 0.2, 0.5], ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5"]
        )
        left.minorticks_off()
        left.set_xticks([0, 0.1, 1, 10], ["0", "0.1", "1", "10"])
        left.set_xlim(-0.01, 25)
        left.set_xlabel("disturbance of |g| at each station, 1σ, mg")
        left.set_ylabel("angular error, °")
        left.set_title("Disturbed |g| (noise 0.5 mg, simulated)")
        left.legend(loc="upper left")
        ratios = [c.ratio("paper", "toolface-inclination") for c in lows]
        right.errorbar(
            LOWEST, [r.value for r in ratios], [2 * r.error for r in ratios], marker="s",
            color=COLOURS[1],
        )  # fmt: skip
        right.axhline(1, color=COLOURS[0], lw=0.8, ls="--")
        right.set_xscale("log")
        right.set_xticks([2, 5, 10, 20, 45], ["2", "5", "10", "20", "45"])
        right.minorticks_off()
        right.set_xlabel("lowest inclination of the plan, °")
        right.set_ylabel("ratio of angular errors")
        right.set_title("Equal weights / weights of equal noise")


def table(head: tuple[str, ...], rows: list[tuple]) -> str:
    """A Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def _degrees(square: Array) -> str:
    return f"{np.degrees(np.sqrt(square.mean())):.4f}"


def _milli(square: Array) -> str:
    return f"{1e3 * np.sqrt(square.mean()):.2f}"


def _cases(found: list[Comparison]) -> str:
    head = ("what goes wrong", "`least-squares`, °", "`toolface-inclination`", "paper, equal weights",
            "`joint`", "`scalar`, turned")  # fmt: skip
    rows = [
        (c.case.title, _degrees(c.errors["least-squares"].direction),
         *(c.ratio(m) for m in ("toolface-inclination", "paper", "joint", "scalar")))
        for c in found
    ]  # fmt: skip
    return table(head, rows)


def _components(found: list[Comparison]) -> str:
    head = ("what goes wrong", "inclination, LS", "inclination, T+I", "toolface·sin I, LS",
            "toolface·sin I, T+I", "\\|g\\|, LS", "\\|g\\|, T+I")  # fmt: skip
    rows = []
    for c in found:
        ls, ti = c.errors["least-squares"], c.errors["toolface-inclination"]
        rows.append((c.case.title, _degrees(ls.inclination), _degrees(ti.inclination),
                     _degrees(ls.toolface), _degrees(ti.toolface), _milli(ls.strength),
                     _milli(ti.strength)))  # fmt: skip
    return table(head, rows)


def _appendix() -> str:
    rows = [
        (c.rows, c.parameters, c.where, f"{c.low:+.6f}" if abs(c.low) < 2 else f"{c.low:+.0f}",
         f"{c.high:+.6f}" if abs(c.high) < 2 else f"{c.high:+.0f}", _verdict(c))
        for c in checks()
    ]  # fmt: skip
    head = ("rows", "derivatives by", "where", "printed / true, least", "greatest", "")
    return table(head, rows)


def _verdict(check: Check) -> str:
    if max(abs(check.low - 1), abs(check.high - 1)) < 1e-6:
        return "right"
    return "wrong sign" if max(abs(check.low + 1), abs(check.high + 1)) < 1e-6 else "wrong"


def _unsettled(found: list[Comparison]) -> str:
    each = [
        f"{count} of {SEEDS} with `{name}` ({c.case.title})"
        for c in found
        for name, count in c.unsettled.items()
        if count
    ]
    if not each:
        return "Every fit converged."
    return f"Fits that did not meet the solver's criterion, kept in the means: {'; '.join(each)}."


TEMPLATE = r"""# Ivanov: toolface and inclination

T. B. Ivanov and G. S. Lyutskanova-Zhekova (2019) calibrate an accelerometer triad on the two angles it is
bought for: the sum of squares of the errors in toolface and inclination, minimised by Gauss–Newton with an
analytic Jacobian. Abstract and appendix were available ([Sources](../errata.md#sources)). This page is written
by `examples/papers/ivanov.py`; `MWDCAL_DATA` must name the folder of the [measured sets](../measured.md).

In short:

- **It wins where |g| is disturbed** from station to station. At 5 mg of disturbance the angular error of
  `--method toolface-inclination` is <<disturbed>> of that of least squares. The two are level at about
  <<level>> mg, with 0.5 mg of noise per channel.
- **It loses on sensor noise alone** (<<noise>>), because it throws away what |g| tells; with the paper's equal
  weights it loses more (<<noise paper>>).
- **It cannot find the overall scale**: rank 11 of 12. A wrong but constant g spoils the scale, of any method;
  the angles of least squares do not suffer, so an unknown local g alone is no reason to choose it.
- **It does not help against a bad stand.** An inclination offset does <<offset>> times the harm.
- Of the derivatives printed for inclinations up to 90° **most have the wrong sign**; with them the method does
  not converge.

The paper reports an advantage over a classical method on its own sensor data, which are not available. A
disturbed |g| would give one; stand errors would not.

## The appendix, checked

Each printed derivative against complex steps of the paper's own arctan and arccos: a crooked triad in 20 000
random attitudes. Its accelerometers count the holding force, so its toolface $\arctan(a_x/a_y)$ is
$\operatorname{atan2}(-g_x, -g_y)$ here.

<<appendix>>

A and B mean two things. With those of equation 13 the toolface rows are right; with those defined just after
it, for the inclination, they are not. In the inclination rows up to 60° the sign is wrong for the eight
parameters that move $B_1$ and $B_2$. From 60° they are derivatives of $-\arcsin(\sqrt A/B)$: up to 90° the
complement of the inclination, with all twelve signs opposite; above 90° they are right again.

![Printed over true derivative of the inclination, by inclination](ivanov-derivatives.svg)

One line tells without any differentiation: angles do not change with a common factor of $p$, so $J\,p = 0$
exactly. With the corrected rows $|J\,p|$ stays below $10^{-13}$ rad; with the printed ones it reaches <<null>> rad.

The change of formula at 60° is not only unnecessary, it is the wrong way round: the root of each formula
vanishes inside the range in which that formula is used. Relative error of the printed derivative by $p_{12}$,
sign put right, at a distance from that pole:

<<poles>>

With atan2 there is one formula,
$\partial I/\partial B_k = B_k B_3/(B^2 h)$ for $k = 1, 2$ and $-h/B^2$ for $k = 3$, $h = \sqrt{B_1^2 + B_2^2}$;
its only singular point is the vertical, where toolface does not exist.

## The method, rebuilt

Gauss–Newton from the appendix, independent of mwdcal, on <<seeds>> **simulated** instruments (scale ± 3 %, axes
± 10 mrad, offset ± 30 mg) at 5, 45, 90 and 135° × 12 toolfaces, noise 0.5 mg. The normal matrix is singular
(the scale), so the step taken is the shortest one.

- *Corrected derivatives*: <<iterations>> iterations to a step of $10^{-12}$.
- *Printed derivatives*: less than <<printed converged>> % converged within 50 iterations; the median angular
  error is about <<printed error>>°, against <<corrected error>>°. The program of the authors must have had other signs.
- *Against mwdcal*: without noise the directions given by both programs agree to $10^{-13}$ rad. With noise, and
  the paper's residuals weighted for equal noise of the channels, they differ by at most <<agreement>> % of the
  angular error, over all instruments and 200 attitudes.
- *Equal weights*, as in the paper, count a toolface near the vertical as much as any other, though its noise
  goes with $1/\sin I$. With a lowest row of 5° this costs a factor <<weights 5>>, with 45° <<weights 45>>. mwdcal
  weights by the noise, and vertical stations are allowed.

## Against the classical methods

All **simulated**: <<seeds>> instruments for each row, calibrated at the 48 stations above and judged at 200 other
attitudes. Angular error: root mean square of inclination and toolface·sin I together. First column in
degrees, the others as a ratio to it, ± one standard error. `scalar` knows |g| alone and leaves three
rotations free; it is judged after the best rotation, which no user has. `joint` knows what the run declares:
noise, 1 g, and the stand's uncertainty in the last row.

<<cases>>

<<unsettled>>

What to read from it:

- Every method that uses |g| takes its disturbance for an error of the sensor. `joint` does too: the
  uncertainty of g that can be declared is one error common to the run.
- Local g off by a constant: the ratio is that of noise alone (<<wrong g>>).
- An inclination offset of the stand: |g| tells least squares that such vectors cannot be, and part of the
  offset is refused. Angles alone swallow it whole.
- A tilted base turns the whole earth: <<tilt>>, as good as no difference, because it looks like a mounting rotation.
- Independent stand errors: `joint` with the stand's uncertainty declared is the best of those that find the
  mounting (<<stand joint>>), for no stand error touches |g|.
- `scalar` uses no stand, so no stand can harm it, and it knows no mounting.

By components (degrees; mg; LS is `least-squares`, T+I `toolface-inclination`, whose |g| is a convention: the
scale is set so that the mean strength is the nominal one, and no uncertainty is quoted for it):

<<components>>

![Angular error by disturbance of |g|, and price of equal weights](ivanov-errors.svg)

## Rank

Factors of a nominal triad, 0.5, 45, 90 and 135° × 12 toolfaces, order 3 at five temperatures; the last column is
a simulated servo instrument with drift.

<<ranks>>

The free directions of toolface and inclination are the scale and, at order 3, its three temperature terms.

## Measured data

The objective needs the toolface and inclination of every station. Of the [measured sets](../measured.md) only one
has them:

| set | stations | used here |
|---|---|---|
| imucal | six faces on a table | yes, see below |
| mikov, xsens | hand-held positions, attitude unknown | no: nothing but \|g\| is known |
| sap5, sap6, distox | shots and roll sets of unknown direction | no: no reference angle |

So no measured set says which method gives the better angles, and attitudes taken from another calibration
of the same data would decide nothing.

**imucal.** Six faces with angles alone determine <<face rank>> of 12, where least squares has <<face classical>>.
Opposite faces give the line on which a channel's axis lies, and the point where the three lines meet is the
offset; the distance along each line is each station's own unknown, so *three* scales are free. mwdcal counts
them (`<<face free>>`), and `calibrate` refuses:

> <<refusal>>

Six positions, which suffice for least squares, do not suffice here; stations between the axes do. What both
methods determine agrees to <<face axes>> mrad in the channel axes and <<face offset>> mg in the offset. The noise
of the means is at most <<face repeat>> mg, but after least squares a face is still up to <<face error>>° off its
nominal direction: the hand that laid it down. The difference in offset is of that kind.
"""


def page() -> str:
    """The documentation page: the template with every figure computed."""
    text = TEMPLATE
    values = {**_measured_values(), **_paper_values(), **_simulated_values()}
    for name, value in values.items():
        text = text.replace(f"<<{name}>>", str(value))
    if "<<" in text:
        raise ValueError(f"a figure is missing: {text[text.index('<<') :][:40]}")
    return text


def _paper_values() -> dict[str, object]:
    down = descent()
    draw_derivatives()
    head = ("distance", "up to 60°, from the vertical", "above 60°, from the horizontal")
    rows = [(name, *(f"{x:.0e}" if np.isfinite(x) else "no number" for x in pair))
            for name, *pair in poles()]  # fmt: skip
    return {
        "appendix": _appendix(),
        "poles": table(head, rows),
        "null": f"{down.null:.1f}",
        "iterations": f"{down.iterations[0]} to {down.iterations[1]}",
        "printed converged": int(100 * down.printed_converged / SEEDS) + 1,
        "printed error": int(float(f"{np.degrees(down.printed_error):.0e}")),
        "corrected error": f"{np.degrees(down.corrected_error):.3f}",
        "agreement": f"{100 * down.agreement:.1f}",
        "seeds": SEEDS,
        "ranks": table(("evidence", "of 12", "of 30", "of 30, drifting"),
                       [(f"`{name}`", *found) for name, *found in ranks()]),
    }  # fmt: skip


def _simulated_values() -> dict[str, object]:
    cases = [compare(case, 200 + 2 * i) for i, case in enumerate(CASES)]
    noise, shaken, _, wrong_g, high, tilted, stand = cases
    disturbances, lows = disturbed(), lowest()
    draw_ratios(disturbances, lows)
    angles_alone, weights = "toolface-inclination", ("paper", "toolface-inclination")
    return {
        "disturbed": shaken.ratio(angles_alone),
        "level": f"{1e3 * _crossing(disturbances):.1f}",
        "noise": noise.ratio(angles_alone),
        "noise paper": noise.ratio("paper"),
        "offset": high.ratio(angles_alone),
        "wrong g": wrong_g.ratio(angles_alone),
        "tilt": tilted.ratio(angles_alone),
        "stand joint": stand.ratio("joint"),
        "weights 5": lows[LOWEST.index(5.0)].ratio(*weights),
        "weights 45": lows[LOWEST.index(45.0)].ratio(*weights),
        "cases": _cases(cases),
        "components": _components(cases),
        "unsettled": _unsettled(cases),
    }


def _measured_values() -> dict[str, object]:
    face = imucal()
    return {
        "face rank": face.rank,
        "face classical": face.classical,
        "face free": "`, `".join(face.free),
        "refusal": face.refusal,
        "face axes": f"{1e3 * face.axes:.2f}",
        "face offset": f"{1e3 * face.offset:.1f}",
        "face repeat": f"{1e3 * face.repeat:.2f}",
        "face error": f"{np.degrees(face.faces):.2f}",
    }


def _crossing(found: list[Comparison]) -> float:
    """Disturbance of |g| (g) at which angles alone and least squares are level, log interpolated."""
    ratios = np.log([c.ratio("toolface-inclination").value for c in found])
    after = int(np.argmax(ratios < 0))
    share = ratios[after - 1] / (ratios[after - 1] - ratios[after])
    low, high = np.log(DISTURBANCES[after - 1 : after + 1])
    return float(np.exp(low + share * (high - low)))


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE}")
