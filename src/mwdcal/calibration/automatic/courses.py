"""Temperature terms beyond the order of a fit: terms beyond it, their test, size and share.

Gain and offset of each axis may vary with temperature by more than the order of the model says.
At the solution of a fit each further power (a Chebyshev polynomial of temperature over the run, for
the gains and the offsets of one triad, as shares of the field) is tried by one step: its χ² given all
lower powers, judged by the scatter that no power explains, says whether it is there; the excess of
χ² over what noise alone gives is its mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import HIGHEST, highest_order, usable_soaks
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form, stand_factors
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import TANGENT_STEP, fisher_tail, tangent
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, eigen, inverse, outer, quotient

TRIED = 5
"""The highest power that is tried, if there are soaks enough."""
UNLIKELY = 1e-3
"""A term is there if noise alone gives one as large with a probability below this."""
LEFT_TO_TERM = 1e-6
"""A direction of a term counts if the fit leaves this share of its information to it."""
SEEN_SHARE = 4e-4
"""A direction of a term counts as visible to the attitudes with this share of the information."""
ALIGNED = 0.05
"""Attitudes and temperature go together where the fit leaves less of the information on its next power."""
RIDGE = 1e-11
"""Added to the information of the fit's unknowns, so that it has an inverse: free ones stay free."""
OFFSETS = tuple(f"{word}-{axis}" for word in ("offset", "bias") for axis in "xyz")
"""Steady offsets of the axes, in either model."""
GRID = 64
"""Temperatures over the range at which what is left out is averaged."""


@dataclass(frozen=True)
class OmittedTerms:
    """Powers 1…`TRIED` of temperature that a fit has not, by member and triad: arrays (B, t, k).

    `square` is χ² of a term, all lower ones being fitted, `freedom` its degrees of freedom: 0 where
    the fit has it, or no soak shows it. `left` (B, t) is the least share of the information on the next power that the
    fit leaves, over its coefficients: little where attitudes and temperature go together. `size` (B, t, k, 2) is
    the mean square of its coefficients, gains and offsets, and `noise` what the declared noise adds to it.
    `scatter` (B, t) is the variance of whitened residuals that no term explains, `rest` (B, t) its degrees of
    freedom.
    """

    square: Array
    freedom: Array
    left: Array
    size: Array
    noise: Array
    scatter: Array
    rest: Array

    @property
    def chance(self) -> Array:
        """Probability (B, t, k) of so large a term by noise alone; NaN without a term to test."""
        return f_test(self.square, self.freedom, self.scatter[..., None], self.rest[..., None])

    @property
    def present(self) -> Bools:
        """Terms (B, t, k) that noise does not explain."""
        return np.asarray(np.nan_to_num(self.chance, nan=1.0) < UNLIKELY)

    @property
    def variance(self) -> Array:
        """Mean square (B, t, k, 2) of a term's gains and offsets, shares of the field, noise taken off."""
        excess = self.size - self.noise * self.scatter[..., None, None]
        usable = (self.freedom > 0) & (self.rest[..., None] >= 1)
        return np.where(usable[..., None], np.maximum(excess, 0.0), 0.0)


def f_test(square: Array, freedom: Array, scatter: Array, rest: Array) -> Array:
    """Probability of so large a χ² of `freedom` by noise alone: Fisher's F.

    Against a `scatter` that `rest` degrees of freedom tell of. NaN where there is nothing to test.
    """
    tested = (freedom > 0) & (rest >= 1)
    if not tested.any():
        return np.full(np.broadcast_shapes(tested.shape, square.shape, scatter.shape), np.nan)
    ratio = square / np.where(tested, freedom * scatter, 1.0)
    ratio, freedom = np.where(tested, ratio, 0.0), np.where(tested, freedom, 1.0)
    return np.where(tested, fisher_tail(freedom, np.maximum(rest, 1.0), ratio), np.nan)


def orders_of(result: Fit) -> list[int]:
    """Temperature order of each triad."""
    return [triad.model.basis.order for triad in result.problem.triads]


def terms_beyond(result: Fit) -> OmittedTerms:
    """The powers of temperature that a fit has not."""
    each = result.problem.once("terms", result.state, lambda _: _every_term(result))
    terms, left_over = each
    square, freedom = terms[:, 0], terms[:, 1]
    size, noise = (np.moveaxis(terms[:, at : at + 2], 1, -1) for at in (2, 4))
    factor, known = result.analysis.variance_factor, result.analysis.freedom
    rest = known - freedom.sum(-1)
    left = np.nan_to_num(factor * known) - square.sum(-1)
    least = 1e-3 * np.nan_to_num(factor)
    scatter = np.maximum(left / np.maximum(rest, 1.0), np.maximum(least, 1e-300))
    declared = np.isnan(result.noise) & (rest < 1)
    scatter, rest = np.where(declared, 1.0, scatter), np.where(declared, 1e9, rest)
    return OmittedTerms(square, freedom, left_over, size, noise, scatter, rest)


def members(result: Fit, places: Ints) -> Fit:
    """The members of a batch of fits at some places, with what is known of their terms."""
    part, memo = take(result, places), result.problem.memo
    if memo.get("state") is result.state and "terms" in memo:
        part.problem.memo.update(state=part.state, terms=take(memo["terms"], places))
    return part


def share_beyond(result: Fit, index: int, members: Bools) -> Array:
    """The share (B,) of a triad's residuals that further powers of temperature would leave `members` (B,)."""
    share, factor = np.ones(len(members)), result.analysis.variance_factor[:, index]
    places = np.flatnonzero(members & np.isfinite(factor))
    if places.size:
        left = terms_beyond(take(result, places)).scatter[:, index]
        share[places] = np.sqrt(left / factor[places])
    return share


def _every_term(result: Fit) -> tuple[Array, Array]:
    """The answers of `_in_turn` (B, 6, t, k) for every power and triad, and (B, t) for the next one."""
    highest = highest_order(result.problem.temperature)
    count = min(int(highest.max()), TRIED)
    triads, orders = len(result.problem.triads), orders_of(result)
    each, left = np.zeros((len(highest), 6, triads, TRIED)), np.zeros((len(highest), triads))
    least = min(orders)
    if count <= least:
        return each, left
    shown = (np.arange(1, count + 1) <= highest[:, None])[:, least:]
    whole, pulled = _with_terms(result, shown, least)
    every = np.arange(whole.shape[-1])
    columns = every[-6 * triads * (count - least) :].reshape(count - least, triads, 6)
    for index, order in enumerate(orders):
        if order < count:
            higher = columns[:, index].ravel()
            fitted, tested = np.setdiff1d(every, higher), higher[6 * (order - least) :]
            each[:, :, index, order:count], left[:, index] = _in_turn(whole, pulled, tested, fitted)
    return each, left


def _with_terms(result: Fit, shown: Bools, least: int) -> tuple[Array, Array]:
    """Information and pull of the fit's unknowns, then of the powers above `least` if `shown` (B, k).

    Of each power come the three gains and three offsets of each triad.
    """
    problem, state = result.problem, result.state
    every = temperature_powers(problem.temperature, least + shown.shape[-1])
    powers = every[..., least:] * shown[:, None]
    exact = closed_form.applies(problem) and stand_factors.comes_apart(problem)
    if exact or stand_factors.applies(problem):
        return stand_factors.linear(problem, state).with_courses(powers.mT)
    linear = problem.linear(state)
    columns = steady_columns(problem, state)
    members, stations, count = powers.shape
    weighed = linear.weigh(columns).mT
    turned = powers.mT

    def summed(each: Array, by: Array) -> Array:
        return np.asarray(by @ each.reshape(members, stations, -1))

    width = columns.shape[-1]
    cross = summed(weighed @ linear.design, turned).reshape(members, count * width, -1)
    pairs = (powers[..., None] * powers[..., None, :]).reshape(members, stations, -1)
    powered = summed(weighed @ columns, pairs.mT)
    powered = np.swapaxes(powered.reshape(members, count, count, width, width), 2, 3)
    powered = powered.reshape(members, count * width, count * width)
    pulled = -summed(weighed @ linear.residual[..., None], turned).reshape(members, -1)
    normal = linear.normal
    whole = np.block([[normal.information, cross.mT], [cross, powered]])
    return whole, np.concatenate([-normal.gradient, pulled], -1)


def steady_columns(problem: Problem, state: State) -> Array:
    """Columns (B, n, m, 6 t) of gains and offsets of each triad's axes, shares of the field."""
    rows = 3 * len(problem.triads)
    columns = np.zeros((*problem.temperature.shape, rows, 2 * rows))
    pairs = zip(problem.triads, problem.slices(), problem.targets(state), strict=False)
    for index, (triad, where, target) in enumerate(pairs):
        slope = triad.model.slope(state.params[:, where], triad.raw, problem.temperature)
        weight = problem.evidence.include[..., None] / triad.sd
        back = inverse(slope) * weight[..., None]
        axes, first = slice(3 * index, 3 * index + 3), 6 * index
        columns[..., axes, first : first + 3] = back * target[..., None, :]
        strength = np.linalg.norm(target, axis=-1)[..., None, None]
        columns[..., axes, first + 3 : first + 6] = back * strength
    return columns


def _mean(values: Array, weights: Array) -> Array:
    """Weighted means (2, B) of the gains and of the offsets among six coefficients (B, 6)."""
    total, weight = (each.reshape(-1, 2, 3).sum(-1) for each in (values * weights, weights))
    return np.asarray((total / np.where(weight > 0, weight, 1.0)).transpose())


def temperature_powers(temperature: Array, count: int) -> Array:
    """Chebyshev polynomials (B, n, count) of temperatures (B, n) over each member's range, from 1."""
    low, high = temperature.min(-1, keepdims=True), temperature.max(-1, keepdims=True)
    scaled = (2 * temperature - low - high) / np.maximum(high - low, 1e-9)
    return np.asarray(np.polynomial.chebyshev.chebvander(scaled, count)[..., 1:])


def _in_turn(whole: Array, pulled: Array, tested: Ints, fitted: Ints) -> tuple[Array, Array]:
    """χ², degrees of freedom, size and noise (B, 6, k) of powers in turn, six coefficients each.

    Each is what it adds to the `fitted` unknowns, and to the powers before it. And the share (B,) of the information
    on the first power that these leave.
    """
    with np.errstate(invalid="ignore"):  # by rounding it may be below zero
        norm = np.sqrt(diagonal(whole))
    norm = np.where(norm > 0, norm, 1.0)
    whole = whole / outer(norm)
    pulled = pulled / norm
    base, cross = whole[:, fitted][:, :, fitted], whole[:, fitted][:, :, tested]
    absent = diagonal(base) == 0
    base = base + (RIDGE + absent[:, :, None]) * np.eye(len(fitted))
    right = np.concatenate([cross, pulled[:, fitted, None]], -1)
    both = np.concatenate([whole[:, tested][:, :, tested], pulled[:, tested, None]], -1)
    alone = both[:, :6, :6]
    both = both - cross.mT @ np.linalg.solve(base, right)
    share, terms = _share_left(alone, both[:, :6, :6]), []
    for first in range(0, len(tested), 6):
        at = slice(first, first + 6)
        values, vectors = eigen(both[:, at, at])
        kept = values > LEFT_TO_TERM
        back = (vectors * quotient(np.ones_like(values), values, kept)[:, None]) @ vectors.mT
        step = back @ both[:, at]
        square = np.einsum("bi,bi->b", both[:, at, -1], step[..., -1])
        worth = np.einsum("bii->bi", both[:, at, at])
        scale = norm[:, tested[at]] ** 2
        sizes = [step[..., -1] ** 2, np.einsum("bii->bi", back)]
        means = [_mean(each / scale, worth * scale) for each in sizes]
        terms.append(np.concatenate([np.stack([square, kept.sum(-1)]), *means]))
        both = both - both[:, :, at] @ step
    return np.stack(terms, -1).swapaxes(0, 1), share


def _share_left(alone: Array, left: Array) -> Array:
    """The least share (B,) of information `alone` (B, c, c) that is `left` in any direction that it has."""
    values, vectors = eigen(alone)
    kept = values > SEEN_SHARE
    scaled = vectors * np.sqrt(quotient(np.ones_like(values), values, kept))[:, None]
    share = scaled.mT @ left @ scaled
    np.einsum("bii->bi", share)[...] += ~kept
    return np.asarray(eigen(share)[0].min(-1))


def aligned(result: Fit) -> Bools:
    """Triads (B, t) whose next power of temperature other stations' attitudes hide: see `ALIGNED`."""
    highest = np.minimum(highest_order(result.problem.temperature), HIGHEST)
    left = terms_beyond(result).left
    return np.asarray((left < ALIGNED) & (highest[:, None] > orders_of(result)))


def untested(result: Fit) -> Bools:
    """Triads (B, t) whose order takes all soaks that there are: nothing tests the course between."""
    temperature, orders = result.problem.temperature, np.array(orders_of(result))
    levels = usable_soaks(temperature).max(-1)[:, None] + 1
    return np.asarray((levels > 1) & (orders > 0) & (levels <= orders + 1))


def misfit_size(result: Fit) -> Array:
    """Root mean square (B, t), per axis, of what the orders leave out, as a share of the field."""
    gains, offsets = np.moveaxis(course_misfit(result), -1, 0)
    return np.asarray(np.sqrt(gains / 3 + offsets))


def course_misfit(result: Fit) -> Array:
    """Variance (B, t, 2) of gains and offsets that the order leaves out, shares of the field squared.

    Mean square over the range of temperatures of all terms that are there, and of the next one
    whether it is there or not: what noise may hide is not known to be absent. A term beyond the
    highest order is scatter between soaks: it is as large at any other temperature, and each soak
    passes its share of it on to the fit.
    """
    problem, terms, variances = result.problem, terms_beyond(result), []
    for index, order in enumerate(orders_of(result)):
        powers = np.arange(1, TRIED + 1)
        counted = terms.present[:, index] | (powers == order + 1)
        smooth, scattered = _left_out(problem, order)
        share = np.where((powers > HIGHEST) & terms.present[:, index], scattered, smooth)
        share = np.where(counted, share, 0.0)
        known = np.einsum("bk,bks->bs", share, terms.variance[:, index])
        untested = (terms.freedom[:, index, order : order + 1] == 0) & (order > 1)
        expected = smooth[:, order : order + 1] * _next_term(result, index)
        variances.append(np.where(untested, expected, known))
    return np.stack(variances, 1)


def _next_term(result: Fit, index: int) -> Array:
    """Variance (B, 2) expected of the power above a triad's highest: it falls off as that one did."""
    problem, order = result.problem, orders_of(result)[index]
    if order < 2:
        return np.zeros((len(problem.temperature), 2))
    low, high = problem.temperature.min(-1), problem.temperature.max(-1)
    nodes = np.cos(np.pi * (np.arange(order + 1) + 0.5) / (order + 1))
    warmth = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * nodes
    model, params = problem.triads[index].model, result.state.params[:, problem.slices()[index]]
    still = np.zeros((*warmth.shape, 3))
    strength = np.linalg.norm(problem.targets(result.state)[index], axis=-1).mean(-1)
    gain = diagonal(model.slope(params, still, warmth))
    offset = model.fields(params, still, warmth) / strength[:, None, None]
    both = np.stack([gain, offset], -1).reshape(*warmth.shape, 6)
    back = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, order))
    size = ((back @ both) ** 2).reshape(*warmth.shape, 3, 2).mean(-2)
    before, last = size[:, order - 1], size[:, order]
    return np.asarray(last * np.minimum(last / np.maximum(before, 1e-300), 1.0))


def _left_out(problem: Problem, order: int) -> tuple[Array, Array]:
    """Mean square (B, k) of each power's remainder when lower powers up to an order take its place.

    Over the range of temperatures; then that of soaks that scatter as much as the remainder does.
    """
    temperature, weight = problem.temperature, problem.evidence.include
    low, high = temperature.min(-1, keepdims=True), temperature.max(-1, keepdims=True)
    even = low + (high - low) * np.linspace(0, 1, GRID)
    every = np.concatenate([temperature, even], -1)
    powers = temperature_powers(every, TRIED)
    whole = np.concatenate([np.ones_like(powers[..., :1]), powers], -1)
    stations = temperature.shape[-1]
    measured, shown = whole[:, :stations], whole[:, stations:]
    basis = (measured[..., : order + 1] * weight[..., None]).mT
    gram = basis @ measured[..., : order + 1] + 1e-9 * np.eye(order + 1)
    taken = np.linalg.solve(gram, basis @ measured[..., 1:])
    remainder = shown[..., 1:] - shown[..., : order + 1] @ taken
    left = measured[..., 1:] - measured[..., : order + 1] @ taken
    levels = usable_soaks(temperature).max(-1)[:, None] + 1.0
    mean = np.sum(left**2 * weight[..., None], -2) / weight.sum(-1)[:, None]
    freedom = np.maximum(np.minimum(levels - 1, TRIED) - order, 1.0)
    return np.mean(remainder**2, -2), mean * levels / freedom * (1 + (order + 1) / levels)


def misfit_covariance(result: Fit) -> Array:
    """Covariance (B, p, p) of the fit's parameters that stands for what its order leaves out."""
    problem, params = result.problem, result.state.params
    covariance = np.zeros((*params.shape, params.shape[-1]))
    if not highest_order(problem.temperature).any():
        return covariance
    variance = course_misfit(result)
    stretches = np.eye(3) + TANGENT_STEP * np.eye(3)[:, None] * np.eye(3)
    for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        strength = np.linalg.norm(problem.targets(result.state)[index], axis=-1).mean(-1)
        gains = [tangent(triad.model, params[:, where], stretch) for stretch in stretches]
        offsets = np.eye(triad.model.size)[[name in OFFSETS for name in triad.model.names]]
        for place, rows in enumerate([np.stack(gains, 1), offsets * strength[:, None, None]]):
            covariance[:, where, where] += rows.mT @ rows * variance[:, index, place, None, None]
    return covariance
