"""The free directions of a fit, named: rotations, scales, or the parameters they consist of."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import COUPLED, candidates
from mwdcal.geometry.vectors import Array

EXACT = 1 - 1e-6
"""A named direction with this share in the null space is taken as it is, free of rounding."""
MOVED = 0.01
"""A direction without a name moves a triad that has more than this share of its square."""


@dataclass(frozen=True)
class Free:
    """One free direction: its name, the triads it moves, and the change of parameters (p,)."""

    id: str
    triads: tuple[int, ...]
    direction: Array


# What overflows belongs to a fit that is refused.
@np.errstate(over="ignore", invalid="ignore")
def free_directions(problem: Problem, state: State, determined: Determined) -> list[list[Free]]:
    """Name the free directions of every member of a batch.

    Each triad's own turns and scale are tried first, then common ones, then single
    parameters; a direction that is none of these is called `weak` after its largest part.
    """
    directions: list[list[Free]] = [[] for _ in determined.keep]
    missing = np.sum(~determined.keep, -1)
    for count in np.unique(missing[missing > 0]):
        index = np.flatnonzero(missing == count)
        every = _named(*take((problem, state, determined), index), int(count))
        for place, each in zip(index, every, strict=True):
            directions[place] = each
    return directions


def _named(problem: Problem, state: State, determined: Determined, count: int) -> list[list[Free]]:
    """Names of the `count` free directions of each member.

    The best candidate is taken in turn, and the null space goes on without it.
    """
    ids, directions = _candidates(problem, state)
    norms, members = determined.norms, np.arange(len(state.params))
    scaled = directions * norms[:, None]
    length = np.sum(scaled**2, -1)
    null = determined.basis[..., -count:]
    free: list[list[Free]] = [[] for _ in members]
    used = np.zeros(length.shape, bool)
    for _ in range(count):
        inside = np.sum((scaled @ null) ** 2, -1) / np.where(length > 0, length, 1.0)
        best = np.argmax(np.where(used, -1.0, np.round(inside, 3)), -1)
        score = inside[members, best]
        clear = score > COUPLED
        used[members, best] |= clear
        chosen = scaled[members, best]
        part = (null @ (null.mT @ chosen[..., None]))[..., 0]
        chosen = np.where((score < EXACT)[:, None], part, chosen)
        chosen = np.where(clear[:, None], chosen, null[..., -1])
        for place, index in enumerate(best):
            name, triads = ids[index] if clear[place] else _weak(problem, chosen[place])
            free[place].append(Free(name, triads, chosen[place] / norms[place]))
        null = _without(null, chosen)
    return free


def _candidates(problem: Problem, state: State) -> tuple[list[tuple[str, tuple[int, ...]]], Array]:
    """Directions (B, c, p) that have a name, and their names and triads, in order of preference."""
    every = tuple(range(len(problem.triads)))
    groups = dict.fromkeys([*product(every), every])
    turns = {(n, g): d for g in groups for n, d in candidates(problem, state, list(g)).items()}
    alone = [(n, (t,)) for t in every for n in problem.triads[t].model.names]
    unit = np.broadcast_to(np.eye(len(alone)), (*state.params.shape, len(alone)))
    return [*turns, *alone], np.concatenate([np.stack([*turns.values()], 1), unit], 1)


def _weak(problem: Problem, direction: Array) -> tuple[str, tuple[int, ...]]:
    """Name and triads of a direction (p,), in normalised units, that is no candidate."""
    names = [name for triad in problem.triads for name in triad.model.names]
    shares = [np.sum(direction[where] ** 2) for where in problem.slices()]
    triads = tuple(triad for triad, share in enumerate(shares) if share > MOVED)
    return f"weak-{names[int(np.argmax(np.abs(direction)))]}", triads


def _without(null: Array, direction: Array) -> Array:
    """Null spaces (B, p, k) less their part along a direction (B, p), as orthonormal bases."""
    inside = (null.mT @ direction[..., None])[..., 0]
    length = np.linalg.norm(inside, axis=-1, keepdims=True)
    inside = inside / np.where(length > 0, length, 1.0)
    size = null.shape[-1]
    unit = np.broadcast_to(np.eye(size), (len(null), size, size))
    whole = np.linalg.qr(np.concatenate([inside[..., None], unit], -1))[0]
    return np.asarray(null @ whole[..., 1:size])
