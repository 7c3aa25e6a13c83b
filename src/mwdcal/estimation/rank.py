"""The free directions of a fit, named: rotations, scales, or the parameters they consist of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import COUPLED, candidates
from mwdcal.geometry.vectors import Array

EXACT = 1 - 1e-6
"""A named direction with this share in the null space is taken as it is, free of rounding."""


@dataclass(frozen=True)
class Free:
    """One free direction: its name, the triads it moves, and the change of parameters (p,)."""

    id: str
    triads: tuple[int, ...]
    direction: Array


def free_directions(problem: Problem, state: State, determined: Determined) -> list[Free]:
    """Name every free direction of a problem of one member (B = 1).

    Each triad's own turns and scale are tried first, then common ones, then single
    parameters; a direction that is none of these is called `weak` after its largest part.
    """
    norms = determined.norms[0]
    null = determined.basis[0][:, ~determined.keep[0]]
    named = _named(problem, state)
    found: list[Free] = []
    while null.shape[-1]:
        scores = [_share(null, free.direction * norms) for free in named]
        best = int(np.argmax(np.round(scores, 3)))
        clear = scores[best] > COUPLED
        chosen = named.pop(best) if clear else _weakest(problem, null, norms)
        if clear and scores[best] < EXACT:
            chosen = _inside(chosen, null, norms)
        found.append(chosen)
        null = _without(null, chosen.direction * norms)
    return found


def _named(problem: Problem, state: State) -> list[Free]:
    every = tuple(range(len(problem.triads)))
    groups = [(t,) for t in every] + ([every] if len(every) > 1 else [])
    result = [
        Free(name, group, direction[0])
        for group in groups
        for name, direction in candidates(problem, state, list(group)).items()
    ]
    names = [name for triad in problem.triads for name in triad.model.names]
    for triad, where in enumerate(problem.slices()):
        unit = np.eye(len(names))
        result += [Free(names[i], (triad,), unit[i]) for i in range(where.start, where.stop)]
    return result


def _share(null: Array, direction: Array) -> float:
    total = float(np.sum(direction**2))
    return float(np.sum((null.transpose() @ direction) ** 2)) / total if total > 0 else 0.0


def _weakest(problem: Problem, null: Array, norms: Array) -> Free:
    direction = null[:, -1]
    names = [name for triad in problem.triads for name in triad.model.names]
    triads = tuple(
        t for t, where in enumerate(problem.slices()) if np.sum(direction[where] ** 2) > 0.01
    )
    return Free(f"weak-{names[int(np.argmax(np.abs(direction)))]}", triads, direction / norms)


def _inside(free: Free, null: Array, norms: Array) -> Free:
    """A named direction's part in the null space: own-axis terms do not turn with the rest."""
    part = null @ (null.transpose() @ (free.direction * norms))
    return replace(free, direction=part / norms)


def _without(null: Array, direction: Array) -> Array:
    """The null space less its part along a direction, as an orthonormal basis."""
    inside = null.transpose() @ direction
    inside = inside / np.linalg.norm(inside)
    rest = np.linalg.qr(np.column_stack([inside, np.eye(len(inside))]))[0][:, 1:]
    return np.asarray(null @ rest[:, : len(inside) - 1])
