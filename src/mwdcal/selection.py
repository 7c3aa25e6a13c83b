"""The temperature order, chosen and defended by leaving one temperature out at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mwdcal.calibration import OrderScore
from mwdcal.core.problem import Problem, State
from mwdcal.core.solvers import Linear
from mwdcal.core.uncertainty import TESTED, marginal_rank, readjusted
from mwdcal.core.vectors import Array, Ints
from mwdcal.estimate import Fit, fit
from mwdcal.options import Options, Orders
from mwdcal.readings import TRIADS, Readings
from mwdcal.residuals import shown_in

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
    numbers = _usable_soaks(readings)
    levels = _count(numbers)
    if levels < 2 or _hopeless(readings, options):
        return 0, []
    if levels < FEWEST:
        return _linear_if_needed(readings, options, progress), []
    highest = _highest(options, levels)
    readings = _with_noise(readings, replace(options, order=highest))
    orders = [(order, order) for order in range(highest + 1)]
    tables = _tables(readings, options, orders, numbers, progress)
    chosen = [next(s.order for s in table if s.chosen) for table in tables]
    return (chosen[0], chosen[-1]), [score for table in tables for score in table]


def order_errors(
    readings: Readings, options: Options, progress: Callable[[str], None]
) -> list[OrderScore]:
    """What an order that was given is worth at temperatures left out, one row per triad.

    None where there are too few soaks to leave one out.
    """
    numbers = _usable_soaks(readings)
    levels = _count(numbers)
    if levels < max(FEWEST, max(options.orders) + 2) or _hopeless(readings, options):
        return []
    yardstick = options.order if options.prior else _highest(options, levels)
    readings = _with_noise(readings, replace(options, order=yardstick))
    tables = _tables(readings, options, [options.orders], numbers, progress)
    return [score for table in tables for score in table]


def _usable_soaks(readings: Readings) -> Ints:
    """Number (n,) of each station's soak: all 0 without temperatures, or with too short a span."""
    if readings.temperature is None or np.ptp(readings.temperature) < SPAN:
        return np.zeros(readings.count, int)
    return soaks(readings.temperature)


def _count(numbers: Ints) -> int:
    return int(numbers.max()) + 1


def _highest(options: Options, levels: int) -> int:
    """The highest order that can be judged when one soak is left out."""
    return 0 if options.method == "swarm" else min(HIGHEST, levels - 2)


def _tables(
    readings: Readings,
    options: Options,
    orders: Sequence[tuple[int, int]],
    numbers: Ints,
    progress: Callable[[str], None],
) -> list[list[OrderScore]]:
    """The table of each triad over some orders."""
    found = []
    for pair in orders:
        name = " and ".join(str(order) for order in dict.fromkeys(pair))
        progress(f"order {name}: leaving out each of {_count(numbers)} temperatures")
        found.append(_held_out(readings, replace(options, order=pair), numbers))
    relative = bool(np.isnan(readings.reference("field")).all())
    shown = [shown_in("gravity"), shown_in("field", relative)]
    return [
        _scored(name, [pair[t] for pair in orders], np.stack([f[t] for f in found]), shown[t])
        for t, name in enumerate(TRIADS[: len(found[0])])
    ]


def _scored(
    triad: str, orders: Sequence[int], found: Array, shown: tuple[float, str]
) -> list[OrderScore]:
    """The table of one triad from the mean squares (orders, 5, soaks) of `_held_out`."""
    totals = found[:, 0].mean(-1)
    best = int(np.argmax(totals <= NEAR_BEST * np.fmin.reduce(totals)))
    means = np.stack([f.mean(-1) for f in (found, found[..., 1:-1], found[..., [0, -1]])], -1)
    scale, degree = shown[0], float(np.degrees(1))
    means[:, 1:] = np.sqrt(means[:, 1:]) * np.array([scale, scale, degree, degree])[:, None]
    rows = []
    for index, order in enumerate(orders):
        stated = [[None if np.isnan(v) else float(v) for v in row] for row in means[index]]
        chi, noise, error, noise_deg, error_deg = stated
        rows.append(
            OrderScore(
                triad=triad,
                order=order,
                chosen=index == best,
                inside=chi[1],
                ends=chi[2],
                unit=shown[1],
                noise=noise[0],
                error_inside=error[1],
                error_ends=error[2],
                noise_deg=noise_deg[0],
                error_inside_deg=error_deg[1],
                error_ends_deg=error_deg[2],
            )
        )
    return rows


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
    """Mean squares (triads, 5, parts) of each part of the stations, fitted without it.

    Of the reading, in units of its noise (χ²); then of noise and error per axis of the vector
    (g, nT), and of noise and error across the field (rad).
    """
    include = (np.arange(_count(numbers))[:, None] != numbers).astype(float)
    result = fit(readings, options, include)
    held = 1 - include
    problem, state = _everyone(result)
    linear = problem.linear(state)
    chi = np.sum(_chi(linear) * held[..., None], 1) / (3 * held.sum(1))[:, None]
    left = linear.weigh(linear.residual[..., None])
    share = linear.weigh(
        np.broadcast_to(np.eye(left.shape[-2]), (*left.shape[:-1], left.shape[-2]))
    )
    found = []
    for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        params, own = state.params[:, where], slice(3 * index, 3 * index + 3)
        vector = triad.model.fields(params, triad.raw, problem.temperature)[..., None]
        slope = triad.model.slope(params, triad.raw, problem.temperature) * triad.sd[..., None, :]
        strength = np.linalg.norm(vector, axis=-2, keepdims=True)
        along = vector / strength
        across = (slope - along @ (np.swapaxes(along, -1, -2) @ slope)) / strength
        parts = left[..., own, :], share[..., own, own], held
        found.append(
            np.stack([chi[:, index], *_squares(slope, *parts, 3), *_squares(across, *parts, 2)])
        )
    return np.stack(found)


def _squares(
    effect: Array, left: Array, share: Array, held: Array, axes: int
) -> tuple[Array, Array]:
    """Mean squares (parts,) per axis of noise, and of the error left at the stations `held`.

    `effect` (B, n, 3, 3) turns a reading, in units of its noise, into what is judged, in so many
    `axes`. References that are unknown or uncertain test only the `share` of the noise that
    the station's own unknowns leave; the error is what is `left` for each such share of noise.
    """
    whole = np.sum(effect**2, (-2, -1)) * held
    tested = np.einsum("bnij,bnjk,bnik->bn", effect, share, effect) * held
    error = np.sum((effect @ left) ** 2, (-2, -1)) * held
    noise, tested, error = (x.sum(-1) for x in (whole, tested, error))
    tested = np.where(tested > TESTED * noise, tested, np.nan)
    noise = noise / (axes * held.sum(-1))
    return noise, noise * error / tested


def _everyone(result: Fit) -> tuple[Problem, State]:
    """The problem with the left-out stations back, each at its best attitude for the fit."""
    evidence = result.problem.evidence
    everyone = replace(evidence, include=np.ones_like(evidence.include))
    problem = replace(result.problem, evidence=everyone)
    return problem, readjusted(problem, result.state)


def misfit(result: Fit) -> Array:
    """χ² (B, n, t) of every station by triad, left out or not, attitudes at their best."""
    problem, state = _everyone(result)
    return _chi(problem.linear(state))


def _chi(linear: Linear) -> Array:
    weighed = linear.weigh(linear.residual[..., None])[..., 0]
    rows = linear.residual * weighed
    return np.asarray(rows.reshape(*rows.shape[:-1], rows.shape[-1] // 3, 3).sum(-1))
