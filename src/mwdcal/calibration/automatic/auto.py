"""Choices that a calibration leaves to the software: prior, order, own-axis terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from mwdcal.calibration.automatic.courses import terms_beyond
from mwdcal.calibration.automatic.drift import aged
from mwdcal.calibration.diagnosis.plausibility import is_bad
from mwdcal.calibration.diagnosis.refusals import check_curves, check_readings
from mwdcal.calibration.estimate import Fit, fit, scatters
from mwdcal.calibration.methods import check_stand_errors
from mwdcal.calibration.options import AUTO, USUAL, Options, Orders
from mwdcal.calibration.prior import DATASHEET, for_run, from_datasheet, profile_for
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings, highest_order, usable_soaks
from mwdcal.calibration.record import Calibration, OrderScore, stated
from mwdcal.calibration.residuals import shown_in
from mwdcal.errors import InputError
from mwdcal.estimation.batch import batch_of_one, mapped, take
from mwdcal.estimation.problem import ANGLES, Problem, State
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import (
    TESTED,
    free_directions,
    left_out_residual,
    log_evidence,
    marginal_rank,
    readjusted,
    without_station,
)
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    directions,
    distinct,
    group_scatter,
)
from mwdcal.sensor.profile import Profile

# --------------------------------------------------------------------------
# The temperature order: chosen by the terms that noise does not explain, judged at temperatures left out.
#
# Leaving one soak out can judge an order of two less than there are soaks; the terms of a fit to all soaks
# can be tested up to one less. A ramp is cut into parts that count as soaks (`readings.soaks`).

Progress = Callable[[str], None]
"""What gets a line for each trial."""
FEWEST_SOAKS = 3
"""Fewest soaks among which one can be left out."""
LOUDER = 1.1
"""Variance of residuals, that of the declared noise being 1, from which terms may hide in them…"""
NEARLY_THERE = 0.01
"""…and chance of a term below which it may be there after all."""
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
    for count in distinct(levels[levels > 1]):
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
        usual = Options(method=options.method)
        result = fit(_bare_stand(readings, usual) or readings, usual)
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
    chance, hidden = np.full((*orders.shape, HIGHEST), np.nan), np.zeros(orders.shape, bool)
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
        louder = np.isfinite(result.noise) | (terms.scatter > LOUDER)
        tried = np.where(within[:, None], terms.chance[..., :HIGHEST], np.nan)
        near = np.any(np.nan_to_num(tried, nan=1.0) < NEARLY_THERE, -1)
        hidden[some] = np.where(closed, louder | near, hidden[some])
    coupled = any(readings.sd.get(name, np.zeros(1)).any() for name in ANGLES)
    return (_raised(readings, options, orders, limit, hidden) if coupled else orders), chance


def _raised(readings: Readings, options: Options, orders: Ints, limit: Ints, hidden: Bools) -> Ints:
    """The orders (B, t), raised where a triad has terms beyond its own once the other has its order.

    On an uncertain stand the errors of the angles take up terms that a precise triad lacks, and spread them over the
    residuals of the other, where they hide its terms. `hidden` (B, t): these residuals exceed the declared noise, or
    none is declared, or there is nearly a term.
    """
    orders, powers = orders.copy(), np.arange(1, HIGHEST + 1)
    unequal = np.flatnonzero(np.any((orders < orders.max(-1, keepdims=True)) & hidden, -1))
    while unequal.size:
        further: list[Ints] = []
        for pair in distinct(orders[unequal], axis=0):
            some = unequal[(orders[unequal] == pair).all(-1)]
            result = fit(take(readings, some), replace(options, order=(int(pair[0]), int(pair[1]))))
            within = (powers <= limit[some, None])[:, None] & (powers > pair[:, None])
            wanted = np.any(terms_beyond(result).present[..., :HIGHEST] & within, -1)
            wanted &= pair < pair.max()
            orders[some] += wanted
            further.append(some[wanted.any(-1)])
        unequal = np.concatenate(further)
        unequal = unequal[orders[unequal].min(-1) < orders[unequal].max(-1)]
    return orders


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


# --------------------------------------------------------------------------
# Own-axis nonlinearity, taken only where the run itself says clearly that it is there.
#
# Where the noise is estimated, the probability of all readings with the terms is compared with that
# without them, shot-to-shot scatter of strengths, dip and directions being estimated for each; where
# the noise is declared, stations left out of the fit decide.


BETTER_SHARE = 0.98
"""Left-out χ² must fall to this share before own-axis terms are taken…"""
CLEAR_ERRORS = 2.0
"""…and by so many standard errors of its mean over the stations."""
ODDS = float(np.log(1000.0))
"""All offered terms are taken if they make the readings so many times (ln) as probable as none.

A run without nonlinearity does so in at most one case of as many, whatever its stations.
"""
TRUSTED = 0.2
"""Stations of less weight in a robust fit have no say in the choice."""


@dataclass(frozen=True)
class CurveScore:
    """What speaks for own-axis terms of some triads.

    `left_out`: χ² per reading of stations left out, in units of a declared noise; `odds`: decimal
    logarithm of the probability of the readings over that without terms, where it is estimated.
    `group_scatter_deg`: how far directions within groups scatter at stations left out, if there are groups.
    """

    triads: tuple[str, ...]
    left_out: float | None
    chosen: bool
    odds: float | None = None
    group_scatter_deg: float | None = None


@dataclass(frozen=True)
class Curves:
    """The choice of own-axis terms of B tools among `choices`, by what speaks for each.

    `chosen` (B,) is the place of the choice; `score` (B, choices) are χ² of stations left out, or
    `odds`: natural logarithms of the probability over that without terms.
    """

    choices: list[tuple[str, ...]]
    chosen: Ints
    score: Array
    odds: bool


def declared(profile: Profile, options: Options) -> dict[str, float]:
    """Triads whose profile declares a nonlinearity and whose model can have it, with its prior.

    Only the polynomial model has such terms, and only the common estimator their prior.
    """
    values = {name: getattr(profile, name).nonlinearity for name in TRIADS}
    return {
        name: values[name]
        for name, order in zip(TRIADS, options.orders, strict=True)
        if values[name] and options.kind(order) == "polynomial" and not options.separate_solver
    }


def offered(profile: Profile, options: Options) -> dict[str, float]:
    """Own-axis terms that are left to the run to take or leave: none beside a prior."""
    auto = options.nonlinearity == AUTO and options.prior is None
    return declared(profile, options) if auto else {}


def with_strengths(options: Options, profile: Profile) -> Options:
    """The options with the prior of own-axis terms asked for by name: the profile's, or the usual."""
    if isinstance(options.nonlinearity, Mapping) or options.nonlinearity == AUTO:
        return options
    strength = {n: getattr(profile, n).nonlinearity or USUAL for n in options.nonlinearity}
    return replace(options, nonlinearity=strength)


def scattered(readings: Readings, options: Options) -> Options:
    """The options of every fit of a run: where the noise is estimated and groups exist, so is the scatter."""
    return replace(options, scatter=scatters(readings, replace(options, scatter=True)))


def choose_curves(
    readings: Readings, options: Options, terms: Mapping[str, float]
) -> tuple[dict[str, float], list[CurveScore]]:
    """Of the offered own-axis terms those that one run shows clearly, and the table, if there is a choice."""
    curves = compare_curves(batch_of_one(readings), options, terms)
    chosen, table = int(curves.chosen[0]), []
    for place, triads in enumerate(curves.choices):
        value = float(curves.score[0, place])
        left_out, odds = (None, value / float(np.log(10))) if curves.odds else (value, None)
        scatter = None
        if len(curves.choices) > 1:
            each = replace(options, robust=None, nonlinearity={n: terms[n] for n in triads})
            scatter = _group_scatter(readings, each)
        table.append(CurveScore(triads, left_out, place == chosen, odds, scatter))
    return {n: terms[n] for n in curves.choices[chosen]}, table if len(table) > 1 else []


def _group_scatter(readings: Readings, options: Options) -> float | None:
    """How far directions within groups scatter, degrees, each station being corrected by the fit without it."""
    if readings.magnetometer is None or not (readings.groups >= 0).any():
        return None
    result = fit(batch_of_one(readings), options)
    problem, state = result.problem, result.state
    params = state.params[0] + without_station(problem, state, result.analysis)[0]
    g, b = (
        t.model.fields(params[:, where], t.raw[0, :, None], problem.temperature[0, :, None])[:, 0]
        for t, where in zip(problem.triads, problem.slices(), strict=True)
    )
    return stated(np.degrees(group_scatter(directions(g, b), readings.groups)))


def compare_curves(readings: Readings, options: Options, terms: Mapping[str, float]) -> Curves:
    """Which of the offered own-axis terms each run (B, n, …) shows clearly."""
    choices, count = choices_of(readings, terms), len(readings.accelerometer)
    if len(choices) == 1:
        return Curves(choices, np.zeros(count, int), np.zeros((count, 1)), False)
    each = [{name: terms[name] for name in choice} for choice in choices]
    if any(name in readings.sd for name in TRIADS):
        return Curves(choices, *_by_left_out(readings, options, each), False)
    include = np.ones(readings.accelerometer.shape[:-1])
    if options.robust:  # those that a robust fit with all terms trusts
        trust = fit(readings, replace(options, nonlinearity=each[-1])).trust
        include = np.asarray(trust > TRUSTED, float)
    odds = log_odds(readings, options, each[-1], include)
    score = np.stack([np.zeros(count), odds], -1)
    return Curves([(), choices[-1]], np.asarray(odds > ODDS, int), score, True)


def choices_of(readings: Readings, terms: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Which triads may have terms: none first, then each offered one that the run has, then both."""
    names = [name for name in readings.triads if name in terms]
    return [c for count in range(len(names) + 1) for c in combinations(names, count)]


def log_odds(
    readings: Readings, options: Options, terms: Mapping[str, float], include: Array
) -> Array:
    """Logarithm (B,) of how much more probable all offered terms make the readings than none.

    `include` (B, n) as of `fit`.
    """
    evidence = []
    for curved in ({}, terms):
        result = fit(readings, replace(options, robust=None, nonlinearity=curved), include)
        evidence.append(log_evidence(result.problem, result.state))
    return np.nan_to_num(evidence[1] - evidence[0], nan=-np.inf)


def _by_left_out(
    readings: Readings, options: Options, choices: Sequence[Mapping[str, float]]
) -> tuple[Ints, Array]:
    """The choices (B,) by χ² of stations left out, and its mean (B, choices).

    More terms are taken only if they lower χ² clearly below that of fewer: by 2 %, and by two
    standard errors.
    """
    readings = with_noise(readings, replace(options, nonlinearity=choices[-1]))
    scores = [_left_out(readings, replace(options, nonlinearity=terms)) for terms in choices]
    best, least = np.zeros(len(scores[0]), int), scores[0]
    for index, score in enumerate(scores):
        gain = least - score
        error = gain.std(-1, ddof=1) / np.sqrt(readings.count)
        clear = gain.mean(-1) > CLEAR_ERRORS * error
        better = clear & (score.mean(-1) < BETTER_SHARE * least.mean(-1))
        best, least = np.where(better, index, best), np.where(better[:, None], score, least)
    return best, np.stack([score.mean(-1) for score in scores], -1)


def _left_out(readings: Readings, options: Options) -> Array:
    """χ² per reading (B, n) of stations, each judged by the fit without it."""
    result = fit(readings, options)
    left = left_out_residual(result.analysis)
    weighed = result.problem.linear(result.state).weigh(left[..., None])[..., 0]
    return np.asarray(np.mean(left * weighed, -1))


@dataclass(frozen=True)
class Choice:
    """The choices of a calibration, and the tables that decided what was left to the data.

    `readings` are without the stations left out on request, whose labels are `excluded`; `options`
    say `auto` nowhere. `orders` are empty where no temperature can be left out, `curves` where no
    own-axis terms were tried.
    """

    readings: Readings
    profile: Profile
    options: Options
    orders: list[OrderScore] = field(default_factory=list)
    curves: list[CurveScore] = field(default_factory=list)
    excluded: list[str] = field(default_factory=list)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def choose(readings: Readings, profile: Profile, options: Options, progress: Progress) -> Choice:
    """The options of one run; what they leave to the software is decided by the run.

    Raises `FitError` or `InputError` for readings and options that no fit could use.
    """
    check_stand_errors(options.estimate, options.method)
    excluded = [label for label in readings.labels if label in options.exclude]
    readings = without(readings, options.exclude)
    options, orders, curves = resolved(options, readings, profile, progress)
    orders = orders or order_errors(readings, options, progress)
    return Choice(readings, profile, options, orders, curves, excluded)


def tables_of(readings: Readings, given: Options, chosen: Options) -> list[OrderScore]:
    """The table of orders of one run, for which others have chosen the options."""
    orders: list[OrderScore] = []
    if given.order == AUTO:
        orders = choose_order(readings, replace(chosen, order=AUTO, nonlinearity={}), _silent)[1]
    return orders or order_errors(readings, chosen, _silent)


def _silent(text: str) -> None:
    """Nobody waits for a word on the way."""


def resolved(
    options: Options, readings: Readings, profile: Profile, progress: Progress
) -> tuple[Options, list[OrderScore], list[CurveScore]]:
    """The options without `auto`, and the tables of what was chosen among."""
    options = with_prior(options, readings, profile)
    check_readings(readings, options)
    orders: list[OrderScore] = []
    if options.order == AUTO:
        order, orders = choose_order(readings, replace(options, nonlinearity={}), progress)
        options = replace(options, order=order)
        check_readings(readings, options)
    options, curves = _with_curves(options, readings, profile, progress)
    return options, orders, curves


def with_prior(options: Options, readings: Readings, profile: Profile) -> Options:
    """The options with what is known of one or many tools beforehand, as their prior.

    A previous calibration brings its model and order along; own-axis terms asked for by name get
    their prior.
    """
    options = with_strengths(options, profile)
    profile_for(options.prior, profile)
    if options.prior == DATASHEET:
        return replace(options, prior=from_datasheet(profile, readings.relative))
    if not isinstance(options.prior, Calibration):
        return options
    previous = options.prior
    parameters = previous.options.parameters
    if options.parameters not in (12, parameters):
        raise InputError(
            f"`prior`: the calibration of {previous.run_name} has {parameters} parameters per triad, not "
            f"{options.parameters}. Leave `parameters` out, or calibrate without `prior`."
        )
    kinds = {triad.model for triad in previous.triads}
    order = (previous.triads[0].order, previous.triads[-1].order)
    return replace(
        options,
        model=options.model or (kinds.pop() if len(kinds) == 1 else None),
        order=order if options.order == AUTO else options.order,
        parameters=parameters,
        prior=aged(for_run(previous, readings), previous, readings, profile),
    )


def _with_curves(
    options: Options, readings: Readings, profile: Profile, progress: Progress
) -> tuple[Options, list[CurveScore]]:
    """The options with own-axis terms as asked for, or with those that the run shows."""
    options, terms = scattered(readings, options), offered(profile, options)
    if not terms:
        check_curves(readings, tuple(options.curved))
        return replace(options, nonlinearity=options.curved), []
    progress("own-axis nonlinearity: comparing fits with and without it")
    chosen, curves = choose_curves(readings, replace(options, nonlinearity={}), terms)
    return replace(options, nonlinearity=chosen), curves


def without(readings: Readings, exclude: tuple[str, ...]) -> Readings:
    """The readings less the stations of these labels."""
    if not exclude:
        return readings
    labels = readings.labels
    twice = [label for label in exclude if labels.count(label) > 1]
    if twice:
        raise InputError(
            f"`exclude` {twice[0]}: {labels.count(twice[0])} stations of {readings.name} "
            "have this label. Give each its own in the column 'station'."
        )
    missing = [label for label in exclude if label not in labels]
    if missing:
        each = [part.strip() for part in missing[0].split(",")]
        apart = " Name each by itself." if len(each) > 1 and {*each} <= {*labels} else ""
        raise InputError(
            f"`exclude` {missing[0]}: no such station in {readings.name}; "
            f"stations are {labels[0]} … {labels[-1]}.{apart}"
        )
    return readings.select(np.array([label not in exclude for label in labels]))
