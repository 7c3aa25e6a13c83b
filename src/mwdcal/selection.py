"""The temperature order, chosen and defended by leaving one temperature out at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.core.uncertainty import marginal_rank, readjusted
from mwdcal.core.vectors import Array, Ints
from mwdcal.estimate import Fit, fit
from mwdcal.options import Options, Orders
from mwdcal.readings import TRIADS, Readings

GAP = 5.0
"""Temperatures closer than this belong to one soak, °C."""
SPAN = 10.0
"""A run that spans less has no temperature terms, °C."""
HIGHEST = 3
EXCESS = 1.5
"""Residual variance of order 0, in units of the noise, beyond which a linear course is fitted."""
FEWEST = 3
"""Fewest soaks among which one can be left out."""
LOWEST_RANK = 8
"""A triad of 12 parameters whose three rotations and scale are free has this rank."""
NEAR_BEST = 1.02


@dataclass(frozen=True)
class OrderScore:
    """Held-out χ² per reading of one triad at one order.

    `inside`: mean over soaks inside the range (interpolation); `ends`: over the coldest and
    the hottest (extrapolation).
    """

    triad: str
    order: int
    inside: float
    ends: float
    chosen: bool


def soaks(temperature: Array) -> Ints:
    """Number (n,) of the soak that each station belongs to, coldest first."""
    order = np.argsort(temperature, kind="stable")
    steps = np.cumsum(np.diff(temperature[order], prepend=temperature[order[0]]) > GAP)
    numbers = np.empty(len(order), int)
    numbers[order] = steps
    return numbers


def choose_order(
    readings: Readings, options: Options, progress: Callable[[str], None]
) -> tuple[Orders, list[OrderScore]]:
    """Each triad's lowest order whose held-out χ² is within 2 % of its best, and the tables.

    Order 0 without a table where there is no temperature, or too short a span of it.
    """
    if readings.temperature is None or np.ptp(readings.temperature) < SPAN:
        return 0, []
    numbers = soaks(readings.temperature)
    levels = int(numbers.max()) + 1
    if _hopeless(readings, options) or levels == 1:
        return 0, []
    if levels < FEWEST:
        return _linear_if_needed(readings, options, progress), []
    highest = min(HIGHEST, levels - 2)
    readings = _with_noise(readings, replace(options, order=highest))
    found = []
    for order in range(highest + 1):
        progress(f"order {order}: leaving out each of {levels} temperatures")
        found.append(_held_out(readings, replace(options, order=order), numbers))
    names = TRIADS if readings.magnetometer is not None else TRIADS[:1]
    tables = [_scored(name, [f[:, t] for f in found]) for t, name in enumerate(names)]
    chosen = [next(s.order for s in table if s.chosen) for table in tables]
    return (chosen[0], chosen[-1]), [score for table in tables for score in table]


def _scored(triad: str, found: list[Array]) -> list[OrderScore]:
    """The table of one triad from held-out χ² (soaks,) of each order."""
    totals = np.array([f.mean() for f in found])
    best = int(np.flatnonzero(totals <= NEAR_BEST * np.nanmin(totals))[0])
    return [
        OrderScore(triad, order, float(f[1:-1].mean()), float(f[[0, -1]].mean()), order == best)
        for order, f in enumerate(found)
    ]


def _linear_if_needed(
    readings: Readings, options: Options, progress: Callable[[str], None]
) -> Orders:
    """Between two temperatures: order 1 where order 0 leaves clearly more than its noise."""
    readings = _with_noise(readings, replace(options, order=1))
    factor = fit(readings, replace(options, order=0)).analysis.variance_factor[0]
    wanted = [int(value > EXCESS) for value in factor]
    progress(
        "two temperatures cannot be left out in turn: order 1 is taken where order 0 leaves "
        f"residuals beyond the noise ({', '.join(f'{v**0.5:.1f}' for v in factor)} times). "
        "A third temperature would test the course between."
    )
    return wanted[0], wanted[-1]


def _hopeless(readings: Readings, options: Options) -> bool:
    """Whether the stations cannot even determine what all temperatures have in common."""
    result = fit(readings, Options(method=options.method))
    ranks = [marginal_rank(result.analysis.determined, w)[0] for w in result.problem.slices()]
    return bool(min(ranks) < LOWEST_RANK)


def _with_noise(readings: Readings, options: Options) -> Readings:
    """The readings with noise declared: where it was not, as a fit leaves it.

    Every order is then judged by the same yardstick.
    """
    result = fit(readings, options)
    noise = dict(zip(TRIADS, result.noise[0], strict=False))
    found = {name: np.array(sd) for name, sd in noise.items() if np.isfinite(sd)}
    return replace(readings, sd={**readings.sd, **found})


def _held_out(readings: Readings, options: Options, numbers: Ints) -> Array:
    """χ² per reading (parts, triads) of each part of the stations, fitted without it."""
    levels = int(numbers.max()) + 1
    include = (np.arange(levels)[:, None] != numbers).astype(float)
    result = fit(readings, options, include)
    held = (1 - include)[..., None]
    return np.asarray(np.sum(misfit(result) * held, 1) / (held.sum(1) * 3))


def misfit(result: Fit) -> Array:
    """χ² (B, n, t) of every station by triad, left out or not, attitudes at their best."""
    evidence = result.problem.evidence
    everyone = replace(evidence, include=np.ones_like(evidence.include))
    problem = replace(result.problem, evidence=everyone)
    linear = problem.linear(readjusted(problem, result.state))
    weighed = linear.weigh(linear.residual[..., None])[..., 0]
    rows = linear.residual * weighed
    return np.asarray(rows.reshape(*rows.shape[:-1], rows.shape[-1] // 3, 3).sum(-1))
