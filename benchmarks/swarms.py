"""The particle swarm against pyswarms: 60 particles, 600 iterations, 12 parameters of one triad.

48 stations, error in the reading (Moradi 12) on centred channels, same box: ± 1 about a triad
without misalignment. pyswarms gets a cost of a few vectorised NumPy lines and the same constants
of the flight; it draws from NumPy's global generator, which is seeded here.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence
from functools import partial
from tempfile import TemporaryDirectory

import numpy as np
from measuring import Row, against

from mwdcal.estimation.minimisers.swarm import (
    ACCELERATION,
    CONSTRICTION,
    least_squares_forward,
    swarm,
    swarm_forward,
    vector_cost,
)
from simulation import attitude, plan

PARTICLES, ITERATIONS = 60, 600
TOOLS = 20
SEEDS = 5
MIDDLE = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
FLIGHT = {"c1": CONSTRICTION * ACCELERATION, "c2": CONSTRICTION * ACCELERATION, "w": CONSTRICTION}


def simulated(tools: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (tools, 48, 3) of accelerometers with noise of 0.1 mg, and gravity (48, 3)."""
    rng = np.random.default_rng(12)
    reference = attitude(*plan())(1.0, 1.0, 1.1)[0]
    matrix = np.eye(3) + 0.05 * rng.uniform(-1, 1, (tools, 3, 3))
    clean = reference @ np.swapaxes(matrix, -1, -2) + 0.01 * rng.uniform(-1, 1, (tools, 1, 3))
    return clean + 1e-4 * rng.normal(size=clean.shape), reference


def plain_cost(raw: np.ndarray, reference: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Mean squared error in the reading of parameters (particles, 12), channels being centred."""
    x, y = reference - reference.mean(0), (raw - raw.mean(0)).transpose()
    terms = np.concatenate([x, np.ones((len(x), 1))], -1).transpose()

    def cost(params: np.ndarray) -> np.ndarray:
        affine = np.concatenate([params[:, :9].reshape(-1, 3, 3), params[:, 9:, None]], -1)
        error = affine @ terms - y
        return np.einsum("pin,pin->p", error, error) / len(x)

    return cost


def fly(cost: Callable[[np.ndarray], np.ndarray], seed: int = 0) -> float:
    """The cost that pyswarms reaches."""
    from pyswarms.single import GlobalBestPSO

    np.random.seed(seed)  # noqa: NPY002
    bounds = (MIDDLE - 1, MIDDLE + 1)
    made = GlobalBestPSO(PARTICLES, len(MIDDLE), FLIGHT, bounds=bounds)
    return made.optimize(cost, ITERATIONS, verbose=False)[0]


@contextlib.contextmanager
def quiet():
    """Keep the log that pyswarms writes into the working folder out of it."""
    with TemporaryDirectory() as folder, contextlib.chdir(folder):
        import pyswarms  # noqa: F401

        logging.disable(logging.CRITICAL)
        try:
            yield
        finally:
            logging.shutdown()
            logging.disable(logging.NOTSET)


def excess(costs: Sequence[float] | np.ndarray, least: float | np.ndarray) -> str:
    """How far above the least the worst cost is; the least, where ten digits agree."""
    share = np.max(np.asarray(costs) / least - 1)
    return "the least" if share < 1e-10 else f"{share:.0e} above the least"


def reached(ours: Callable[[int], float], theirs: Callable[[int], float], least: float) -> str:
    """Worst cost of some seeds."""
    words = [excess([each(seed) for seed in range(SEEDS)], least) for each in (ours, theirs)]
    return f"worst of {SEEDS} seeds: ours {words[0]}, theirs {words[1]}"


def least_cost(raw: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Cost (...) of the least-squares solution."""
    solved = least_squares_forward(raw, reference)
    return vector_cost(raw, reference)(solved[..., None, :])[..., 0]


def rows() -> list[Row]:
    """One tool from its readings; the same cost handed to both; many tools at once."""
    with quiet():
        return _rows()


def _rows() -> list[Row]:
    many, reference = simulated(TOOLS)
    raw, cost = many[0], plain_cost(many[0], reference)
    least = float(least_cost(raw, reference))
    size = {"particles": PARTICLES, "iterations": ITERATIONS}

    def ours(seed: int = 0) -> float:
        return float(swarm_forward(raw, reference, seed=seed, **size).cost)

    def handed(seed: int = 0) -> float:
        return float(swarm(cost, MIDDLE - 1, MIDDLE + 1, seed=seed, **size).cost)

    def theirs(seed: int = 0) -> float:
        return fly(cost, seed)

    def each() -> list[float]:
        return [fly(plain_cost(one, reference)) for one in many]

    name, word = f"{PARTICLES} x {ITERATIONS} x 12", "pyswarms"
    batch, one_by_one = (
        partial(swarm_forward, many, reference, **size),
        f"{word}, one by one",
    )
    all_least = least_cost(many, reference)
    words = [excess(costs, all_least) for costs in (batch().cost, each())]
    same = f"worst of {TOOLS} tools: ours {words[0]}, theirs {words[1]}"
    return [
        *against(
            f"{name}, from the readings", ours, {word: theirs}, {word: reached(ours, theirs, least)}
        ),
        *against(
            f"{name}, the same NumPy cost in both",
            handed,
            {word: theirs},
            {word: reached(handed, theirs, least)},
        ),
        *against(f"{name}, {TOOLS} tools", batch, {one_by_one: each}, {one_by_one: same}),
    ]
