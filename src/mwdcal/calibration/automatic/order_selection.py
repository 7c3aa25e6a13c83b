"""The temperature order: chosen by the terms that noise does not explain, judged at temperatures left out.

Leaving one soak out can judge an order of two less than there are soaks; the terms of a fit to all soaks
can be tested up to one less. A ramp is cut into parts that count as soaks (`readings.soaks`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mwdcal.calibration.automatic.courses import terms_beyond
from mwdcal.calibration.diagnosis.plausibility import is_bad
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options, Orders
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings, highest_order, usable_soaks
from mwdcal.calibration.record import OrderScore, stated
from mwdcal.calibration.residuals import shown_in
from mwdcal.estimation.batch import batch_of_one, mapped, take
from mwdcal.estimation.evidence import ANGLES
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.rank import free_directions
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import TESTED, marginal_rank, readjusted
from mwdcal.geometry.vectors import Array, Bools, Ints

Progress = Callable[[str], None]
"""What gets a line for each trial."""
FEWEST_SOAKS = 3
"""Fewest soaks among which one can be left out."""
UNDOUBTED = 1e-12
"""A term is there without doubt if noise alone gives one as large with a probability below this."""
LOWEST_RANK = 8
"""A triad of 12 parameters whose three rotations and scale are free has this rank."""


def choose_order(
    readings: Readings, options: Options, progress: Progress
) -> tuple[Orders, list[OrderScore]]:
    """Each triad's lowest order above which noise explains all terms, and the tables, of one run.

    Order 0 without a table where there is no temperature, or too short a span of it.
    """
    batch = batch_of_one(readings)
    levels = int(_judged_soaks(batch, options)[0])
    if levels < 2:
        return 0, []
    progress(f"temperature order: testing its terms over {levels} temperatures")
    chosen, chance = _tested(batch, options)
    if levels < FEWEST_SOAKS:
        progress(
            "two temperatures cannot be left out in turn: order 1 is taken where order 0 leaves "
            "residuals beyond the noise. A third temperature would test the course between."
        )
    orders = [(order, order) for order in range(_determined_order(batch, options) + 1)]
    batch = with_noise(batch, replace(options, order=orders[-1]))
    pair = (int(chosen[0, 0]), int(chosen[0, -1]))
    return pair, _scores(batch, options, orders, chosen[0], chance[0], progress)


def choose_orders(readings: Readings, options: Options) -> Ints:
    """Orders (B, 2) of accelerometer and magnetometer of a batch, as `choose_order` has them."""
    levels = _judged_soaks(readings, options)
    orders = np.zeros((len(levels), 2), int)
    for count in np.unique(levels[levels > 1]):
        alike = np.flatnonzero(levels == count)
        some = take(readings, alike)
        orders[alike] = _tested(some, options, _bare_stand(some, options))[0][:, [0, -1]]
    return orders


def _bare_stand(readings: Readings, options: Options) -> Readings | None:
    """The readings as if the stand were exact, where factors over temperature then come in closed form."""
    whole = all(not np.isnan(readings.reference(name)).any() for name in ANGLES)
    if options.method != "joint" or options.robust or options.model == "polynomial" or not whole:
        return None
    noise = {name: sd for name, sd in readings.sd.items() if name in TRIADS}
    return replace(readings, sd=noise) if len(noise) < len(readings.sd) else None


def _judged_soaks(readings: Readings, options: Options) -> Ints:
    """Soaks (B,) by which the order of each member is judged; 1: it has order 0 without a trial.

    So has one whose stations cannot even determine what all temperatures have in common.
    """
    levels = usable_soaks(_temperature(readings)).max(-1) + 1
    if (levels > 1).any():
        result = fit(readings, Options(method=options.method))
        ranks = [marginal_rank(result.analysis.determined, w) for w in result.problem.slices()]
        levels = np.where(np.min(ranks, 0) < LOWEST_RANK, 1, levels)
    return np.asarray(levels)


def _tested(
    readings: Readings, options: Options, bare: Readings | None = None
) -> tuple[Ints, Array]:
    """The lowest orders (B, t) that leave no term which is there, and the chance (B, t, k) of each term.

    The chance is that of the term in a fit of the order below, or of the order chosen. An order that the
    stations do not determine is not taken. Where `bare` readings of an exact stand leave no doubt, no fit is
    made, and no chance stated.
    """
    limit = _highest(readings, options)
    orders = np.full((len(limit), len(readings.triads)), -1)
    chance = np.full((*orders.shape, HIGHEST), np.nan)
    powers = np.arange(1, HIGHEST + 1)
    for order in range(int(limit.max()) + 1):
        some = np.flatnonzero((orders < 0).any(-1))
        if not some.size:
            break
        if bare is not None:
            known = _without_doubt(
                take(bare, some), replace(options, order=order), limit[some], orders[some]
            )
            last = known & (limit[some] == order)
            orders[some[last]] = np.where(orders[some[last]] < 0, order, orders[some[last]])
            some = some[~known]
        if not some.size:
            continue
        result = fit(take(readings, some), replace(options, order=order))
        weak = _too_weak(result) & (order > 0)
        limit[some[weak]] = np.minimum(limit[some[weak]], order - 1)
        most, chosen = limit[some], orders[some]
        chosen = np.where((chosen < 0) & (most < order)[:, None], order - 1, chosen)
        terms = terms_beyond(result)
        within = (powers <= most[:, None]) & (powers > order)
        open_ = (chosen < 0)[..., None] & within[:, None]
        chance[some] = np.where(open_, terms.chance[..., :HIGHEST], chance[some])
        wanted = np.any(terms.present[..., :HIGHEST] & within[:, None], -1)
        closed = (chosen < 0) & ~(wanted & (order < most)[:, None])
        orders[some] = np.where(closed, order, chosen)
    return orders, chance


def _without_doubt(bare: Readings, options: Options, limit: Ints, orders: Ints) -> Bools:
    """Members (B,) of which an exact stand already says all that a fit of an order would.

    Every direction is clearly determined, and each triad whose order is open is at its `limit` (B,), or has a term
    within it that errors of the stand, in the residuals here, cannot feign.
    """
    result, order = fit(bare, options), max(options.orders)
    clear = result.analysis.determined.clear & (result.status == int(Status.OK))
    powers = np.arange(1, HIGHEST + 1)
    within = (powers <= limit[:, None]) & (powers > order)
    chances = np.where(within[:, None], terms_beyond(result).chance[..., :HIGHEST], np.nan)
    there = np.any(np.nan_to_num(chances, nan=1.0) < UNDOUBTED, -1)
    done = (orders >= 0) | there | (limit == order)[:, None]
    return np.asarray(clear & done.all(-1))


def _too_weak(result: Fit) -> Bools:
    """Fits (B,) of which the stations leave more undetermined than rotations and scales."""
    weak = np.array(~result.analysis.determined.keep.all(-1))
    places = np.flatnonzero(weak)
    if places.size:
        part = take(result, places)
        free = free_directions(part.problem, part.state, part.analysis.determined)
        weak[places] = [any(map(is_bad, each)) for each in free]
    return np.asarray(weak)


def order_errors(readings: Readings, options: Options, progress: Progress) -> list[OrderScore]:
    """The errors of a given order at temperatures left out, one row per triad.

    None where there are too few soaks to leave one out.
    """
    if usable_soaks(_temperature(readings)).max() + 1 < _needed(options.orders):
        return []
    batch = batch_of_one(readings)
    if _judged_soaks(batch, options)[0] < _needed(options.orders):
        return []
    highest = _determined_order(batch, options)
    yardstick = options if options.prior else replace(options, order=highest)
    chosen = np.array(options.orders[: len(readings.triads)])
    untested = np.full((len(chosen), HIGHEST), np.nan)
    batch = with_noise(batch, yardstick)
    return _scores(batch, options, [options.orders], chosen, untested, progress)


def _needed(orders: tuple[int, int]) -> int:
    """Soaks with which orders can be judged by one left out."""
    return max(FEWEST_SOAKS, max(orders) + 2)


def _temperature(readings: Readings) -> Array:
    """Temperatures (B, n), all alike where none were measured."""
    shape = readings.accelerometer.shape[:-1]
    return np.zeros(shape) if readings.temperature is None else readings.temperature


def _highest(readings: Readings, options: Options) -> Ints:
    """The highest order (B,) that the soaks can carry, with stations enough."""
    carried = highest_order(_temperature(readings))
    return np.minimum(carried, 0 if options.method == "swarm" else HIGHEST)


def _determined_order(readings: Readings, options: Options) -> int:
    """The highest order that soaks carry and stations determine, of a batch of one."""
    order = int(_highest(readings, options)[0])
    while order and _too_weak(fit(readings, replace(options, order=order)))[0]:
        order -= 1
    return order


def _scores(
    readings: Readings,
    options: Options,
    orders: Sequence[tuple[int, int]],
    chosen: Ints,
    chance: Array,
    progress: Progress,
) -> list[OrderScore]:
    """The tables of all triads over some orders, of a batch of one; blank where soaks are too few.

    `chosen` (t,) orders and the `chance` (t, k) of each term by triad.
    """
    numbers = usable_soaks(_temperature(readings))
    count, squares = int(numbers.max()) + 1, []
    for pair in orders:
        if count < _needed(pair):
            squares.append(np.full((len(chosen), 5, count), np.nan))
            continue
        name = " and ".join(str(order) for order in dict.fromkeys(pair))
        progress(f"order {name}: leaving out each of {count} temperatures")
        squares.append(_held_out(readings, replace(options, order=pair), numbers))
    shown = [shown_in("gravity"), shown_in("field", readings.relative)]
    return [
        _score(triad, pair[triad], chosen[triad], each[triad], shown[triad], chance[triad])
        for triad in range(len(chosen))
        for pair, each in zip(orders, squares, strict=True)
    ]


def _score(
    triad: int, order: int, chosen: int, squares: Array, shown: tuple[float, str], chance: Array
) -> OrderScore:
    """One row of the table from the mean squares (5, soaks) of `_held_out`."""
    inner = squares[:, 1:-1] if squares.shape[-1] > 2 else squares
    means = np.stack([part.mean(-1) for part in (squares, inner, squares[:, [0, -1]])], -1)
    scale, degree = shown[0], float(np.degrees(1))
    means[1:] = np.sqrt(means[1:]) * np.array([scale, scale, degree, degree])[:, None]
    chi, noise, error, noise_deg, error_deg = ([stated(v) for v in row] for row in means)
    return OrderScore(
        triad=TRIADS[triad], order=order, chosen=bool(order == chosen),
        chance=stated(chance[order - 1]) if order else None,
        inside=chi[1], ends=chi[2], unit=shown[1], noise=noise[0], error_inside=error[1],
        error_ends=error[2], noise_deg=noise_deg[0], error_inside_deg=error_deg[1],
        error_ends_deg=error_deg[2],
    )  # fmt: skip


def with_noise(readings: Readings, options: Options) -> Readings:
    """The readings (B, n) with noise declared: where it was not, as a fit leaves it.

    Every choice is then judged by the same yardstick.
    """
    if all(name in readings.sd for name in readings.triads):
        return readings
    noise = dict(zip(readings.triads, fit(readings, options).noise.mT, strict=True))
    estimated = {n: sd[:, None, None] for n, sd in noise.items() if n not in readings.sd}
    return replace(readings, sd={**readings.sd, **estimated})


def _held_out(readings: Readings, options: Options, numbers: Ints) -> Array:
    """Mean squares (triads, 5, soaks) of each soak's stations, fitted without them, of a batch of one.

    Of the reading, in units of its noise (χ²); then of noise and error per axis of the vector
    (g, nT), and of noise and error across the field (rad).
    """
    problem, state, held = left_out(readings, options, numbers)
    linear = problem.linear(state)
    chi = np.sum(misfit(problem, state) * held[..., None], 1) / (3 * held.sum(1))[:, None]
    left, share = linear.weigh(linear.residual[..., None]), linear.weight
    squares = []
    for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        params, axes = state.params[:, where], slice(3 * index, 3 * index + 3)
        vector = triad.model.fields(params, triad.raw, problem.temperature)[..., None]
        slope = triad.model.slope(params, triad.raw, problem.temperature) * triad.sd[..., None, :]
        strength = np.linalg.norm(vector, axis=-2, keepdims=True)
        along = vector / strength
        across = (slope - along @ (along.mT @ slope)) / strength
        parts = left[..., axes, :], share[..., axes, axes], held
        squares.append([chi[:, index], *_squares(slope, *parts, 3), *_squares(across, *parts, 2)])
    return np.array(squares)


def _squares(
    effect: Array, left: Array, share: Array, held: Array, axes: int
) -> tuple[Array, Array]:
    """Mean squares (parts,) per axis of noise, and of the error left at the stations `held`.

    `effect` (B, n, 3, 3) turns a reading, in units of its noise, into what is judged, in so many
    `axes`. References that are unknown or uncertain test only the `share` of the noise that
    the unknowns of the station leave; the error is what is `left` for each such share of noise.
    """
    whole = np.sum(effect**2, (-2, -1)) * held
    tested = np.einsum("bnij,bnjk,bnik->bn", effect, share, effect) * held
    error = np.sum((effect @ left) ** 2, (-2, -1)) * held
    noise, tested, error = (x.sum(-1) for x in (whole, tested, error))
    tested = np.where(tested > TESTED * noise, tested, np.nan)
    noise = noise / (axes * held.sum(-1))
    return noise, noise * error / tested


def left_out(readings: Readings, options: Options, part: Ints) -> tuple[Problem, State, Array]:
    """Fits without each part of the stations, these at their best attitude then; who was left out.

    `part` (n,) or (B, n) has the numbers of the parts; what was left out (parts, n) is 1 in the last.
    """
    include = (np.arange(int(part.max()) + 1)[:, None] != part[..., None, :]).astype(float)
    result = fit(mapped(lambda value: np.expand_dims(value, 1), readings), options, include)
    evidence = result.problem.evidence
    everyone = replace(evidence, include=np.ones_like(evidence.include))
    problem = replace(result.problem, evidence=everyone)
    return problem, readjusted(problem, result.state), 1 - include.reshape(-1, readings.count)


def misfit(problem: Problem, state: State) -> Array:
    """χ² (B, n, t) of every station by triad."""
    linear = problem.linear(state)
    rows = linear.residual * linear.weigh(linear.residual[..., None])[..., 0]
    return np.asarray(rows.reshape(*rows.shape[:-1], rows.shape[-1] // 3, 3).sum(-1))
