"""The likely causes of the misfit of a run: zeros of the stand, drift, gradient, backlash, thermal lag.

Each effect is a family of columns that the residuals may have in common with it. A family is named
where it takes away more of the misfit than noise of any direction would (F test), the best one
first; the others are then judged by what that one leaves. Nothing is corrected here: what moves
with a parameter of the sensor has gone into the fit, and no residual shows it.

Reference: efficient scores, C. R. Rao, Proc. Camb. Phil. Soc. 44, 50 (1948).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np

from mwdcal.calibration.automatic.courses import TRIED, f_test, steady_columns, temperature_powers
from mwdcal.calibration.diagnosis.plausibility import stations_to_reshoot
from mwdcal.calibration.estimate import Fit, fewer_stations, without_stations
from mwdcal.calibration.methods import ESTIMABLE, STAND_TURNS, acts_on
from mwdcal.calibration.readings import (
    HIGHEST,
    LEAST_TEMPERATURE_SPAN,
    TRIADS,
    Readings,
    highest_order,
)
from mwdcal.calibration.residuals import shown_in
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.batch import kind_of, put, take
from mwdcal.estimation.minimisers import closed_form, closed_form_drift, uncertain_stand
from mwdcal.estimation.minimisers.closed_form_drift import (
    Alike,
    CommonColumns,
    are_alike,
    are_common,
    perfect,
    products_of,
    responses,
    sensor_terms,
    squares_of,
)
from mwdcal.estimation.minimisers.uncertain_stand import TRIAD_ROWS
from mwdcal.estimation.problem import ANGLES, STAND_ERRORS, Problem, State
from mwdcal.estimation.uncertainty import whole_covariance
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    centred,
    diagonal,
    distinct,
    eigen,
    inverse,
    inverse_of_positive,
    outer,
    over_stations,
    quotient,
)

# --------------------------------------------------------------------------
# Columns of every effect that residuals may show: errors of the stand, drift, gradient, backlash, hysteresis, lag.

DRIFTS = 2
"""Degree of the polynomial of order (or of the row) that a drift is looked for as."""
SMALLEST_SET = 3
"""Fewest stations of one direction that may share an error of its setting."""
SET_TURNS = ("inclination-zero", "azimuth-zero")
COURSE_SUFFIX = "-temperature"
"""What ends the names of the powers of temperature that the order of a triad leaves out."""
LEAST_MOVE = 0.05
"""Moves below this share of the run's largest have no side: of angles that are read off, noise would choose it."""


def families(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Columns (B, n, m, k) of every effect that these runs could show, whitened; zero where one could not."""
    turns, by_earth = problem.station_columns(state)
    known = _turns(problem, state, turns)
    for name, parts in ESTIMABLE.items():
        each = [known[turn] for turn in parts if turn in known]
        if each:
            yield name, np.stack(each, -1)
    sets = _sets(problem)
    each = [known[n][..., None] * sets[..., None, :] for n in SET_TURNS if n in known]
    if each and sets.shape[-1] > 1:
        yield "settings", np.concatenate(each, -1)
    place = np.linspace(-1, 1, state.attitude.shape[1])
    order = np.asarray(np.polynomial.legendre.legvander(place, DRIFTS)[:, 1:], float)
    down = problem.stand_column(state, "azimuth-zero", turns)
    if len(problem.triads) > 1:
        given = problem.evidence.is_known("dip")[..., None]
        if given.any() and "dip" not in problem.evidence.absent:
            yield "dip-reference", (by_earth[..., 2] * given)[..., None]
        field = np.concatenate([by_earth[..., 1:], down[..., None]], -1)
        field[..., :3, :] = 0.0  # the declination of a field that turns does not turn gravity
        if not problem.walks:
            yield "field-drift", products(field, order)
        yield "field-gradient", products(field, state.attitude[..., 2, :])
    steps = _approach(problem)
    back = [known[n] * s[..., None] for n, s in steps.items() if n in known and s.any()]
    if back:
        yield "backlash", np.stack(back, -1)
    yield from _courses(problem, state)
    for index, name in enumerate(TRIADS[: len(problem.triads)]):
        yield from _of_sensor(problem, index, name, order)


def _sets(problem: Problem) -> Array:
    """Membership (B, n, k) of stations in directions that several share by their references; none of a single one."""
    known = problem.evidence.known
    pair = np.stack([known["inclination"], known["azimuth"]], -1)
    keys = np.round(np.nan_to_num(pair, nan=-1.0), 6)
    alike = bool((keys == keys[:1]).all())
    each = [_sets_of(key) for key in keys[: 1 if alike else None]]
    members = np.zeros((len(each), keys.shape[1], max(of.shape[-1] for of in each)))
    for place, of in enumerate(each):
        members[place, :, : of.shape[-1]] = of if of.shape[-1] > 1 else 0.0
    return members


def _sets_of(key: Array) -> Array:
    """Membership (n, k) of one run's stations in the directions (n, 2) that are not too few, nor too many."""
    _, number, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    usable = np.flatnonzero(count >= SMALLEST_SET)
    if len(usable) > len(key) / SMALLEST_SET:
        usable = usable[:0]
    return np.asarray(number.reshape(-1)[:, None] == usable, float)


def _courses(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Powers of temperature that a triad's order leaves out: another finding names these."""
    varied = np.ptp(problem.temperature, -1) >= LEAST_TEMPERATURE_SPAN
    if not varied.any():
        return
    highest = np.clip(highest_order(problem.temperature), HIGHEST, TRIED)
    columns, most = steady_columns(problem, state), int(highest.max())
    tried = (np.arange(1, most + 1) <= highest[:, None]) & varied[:, None]
    powers = temperature_powers(problem.temperature, most) * tried[:, None]
    for index, triad in enumerate(problem.triads):
        order = triad.model.basis.order
        if order < most:
            of_triad = columns[..., 6 * index : 6 * index + 6]
            yield f"{TRIADS[index]}{COURSE_SUFFIX}", products(of_triad, powers[..., order:])


def _turns(problem: Problem, state: State, turns: Array) -> dict[str, Array]:
    """Columns (B, n, m) of errors of the stand that act on references, at stations that have them."""
    visible = [name for name in STAND_ERRORS if name not in STAND_TURNS["tool-axis"]]
    acting = {name: acts_on(problem.evidence, name)[..., None] for name in visible}
    columns = {n: problem.stand_column(state, n, turns) * acts for n, acts in acting.items()}
    return {name: column for name, column in columns.items() if column.any()}


def products(columns: Array, factors: Array) -> Array:
    """Columns (B, n, m, a) times factors (n, b) or (B, n, b) of their stations: (B, n, m, a b)."""
    product = columns[..., :, None] * factors[..., None, None, :]
    return np.asarray(product.reshape(*columns.shape[:-1], -1))


def _approach(problem: Problem) -> dict[str, Array]:
    """From which side (B, n) each angle of the stand was reached: 1, -1, or 0 where it did not move."""
    known = problem.evidence.known
    angles = {name: known[name][..., None] for name in ("inclination", "azimuth", "toolface")}
    steps = {name: np.nan_to_num(centred(moves(angle))) for name, angle in angles.items()}
    return {f"{name}-zero": side(moved)[..., 0] for name, moved in steps.items()}


def moves(values: Array) -> Array:
    """Changes (B, n, k) of values from station to station, zero at the first."""
    return np.diff(values, axis=1, prepend=values[:, :1])


def side(moved: Array) -> Array:
    """The sign of each move (B, n, k), 0 for those too small to be more than the error of a statement."""
    least = np.maximum(LEAST_MOVE * np.abs(moved).max((1, 2), keepdims=True), 1e-6)
    return np.where(np.abs(moved) > least, np.sign(moved), 0.0)


def _of_sensor(
    problem: Problem, index: int, name: str, order: Array
) -> Iterator[tuple[str, Array]]:
    """Drift with the order of stations, hysteresis and thermal lag of one triad's readings."""
    triad = problem.triads[index]
    axes = np.zeros((*problem.temperature.shape, 3 * len(problem.triads), 3))
    weight = problem.evidence.include[..., None] / triad.sd
    axes[:, :, 3 * index : 3 * index + 3] = np.eye(3) * weight[..., None]
    if index == 0 and not problem.walks:
        yield f"{name}-drift", products(axes, order)
    yield f"{name}-hysteresis", axes * side(moves(triad.raw))[..., None, :]
    rate = moves(problem.temperature[..., None])
    varied = np.ptp(rate, 1, keepdims=True) > 1.0
    if varied.any():
        rate = quotient(rate, np.abs(rate).max(1, keepdims=True), varied)
        reading = (triad.raw - triad.raw.mean(1, keepdims=True)) / np.std(triad.raw, (1, 2))[
            :, None, None
        ]
        scale = axes * (rate * reading)[..., None, :]
        yield f"{name}-thermal-lag", np.concatenate([axes * rate[..., None, :], scale], -1)


# --------------------------------------------------------------------------
# Which fits at the same exact references may show an effect: the first round of `structure` for all at once.


EFFECT_CHANCE = 1e-4
"""Chance of so much common structure in noise, below which an effect is named."""
LEFT_BY_FIT = 1e-3
"""A column counts if the fit leaves this share of its square: what is left of others is rounding."""
HYSTERESIS = "-hysteresis"
"""What ends the names of families whose columns are each tool's own."""
LOOK_MARGIN = 0.99
"""A fit is looked at from this share of the gain that would name an effect: rounding differs by far less."""
FREEDOM_STEP = 8
"""Degrees of freedom are counted up to a multiple of these, which asks for less gain: few limits are worked out."""
LEAST_ALIKE = 0.4
"""Least share of the information of others that sensors have to which these are compared; the inverse is the most."""
NOTHING_LEFT, CLEARLY_LEFT = 1e-10, 1e-2
"""Between these it depends on the sensors whether a direction counts: a bound takes its gain, and asks for less."""
GAINS = np.geomspace(1, 1e4, 1000)
"""Ratios of variances at which the chance of noise is worked out…"""
GAIN_STRIDE = 32
"""…at every so many of them first, and then between two."""


def may_show(result: Fit, among: Collection[str] = ()) -> Bools:
    """Fits (B,) that may show an effect, `among` some if any are given.

    All of them where the columns of effects are not common to tools, or depend on temperature.
    """
    problem, every = result.problem, np.ones(len(result.status), bool)
    if problem.evidence.constants:
        common = closed_form_drift.applies(problem)
    else:
        common = closed_form.applies(problem) and are_common(problem)
    if not common:
        return every
    design = Alike.of(problem, result.state)
    names = common_effects(design).among(among)
    if any(name.endswith(("-temperature", "-thermal-lag")) for name in names):
        return every
    scale = np.sqrt(np.maximum(variance_scales(result), 1e-12))
    residual = result.analysis.residual / np.repeat(scale, 3, -1)[:, None]
    response = [r / scale[:, i, None, None] for i, r in enumerate(responses(problem, result.state))]
    drifts = _Drifts.of(problem, result.state, design, residual, response)
    misfit = np.sum(residual**2, (1, 2)) + drifts.misfit
    rest = np.sum(problem.evidence.include[0]) * residual.shape[-1] - result.state.params.shape[-1]
    rest = FREEDOM_STEP * np.ceil((rest - drifts.freedom) / FREEDOM_STEP)
    sides = _gains_of_sides(problem, design, names, residual, response, drifts)
    shown = _are_enough(sides, misfit, rest)
    near = every
    if not drifts.columns:
        near = _may_be_enough(design, names, residual, response, misfit, rest)
    some = np.flatnonzero(near)
    if some.size:
        gains = _gains(design, names, residual[some], [r[some] for r in response], drifts)
        shown[some] |= _are_enough(gains, misfit[some], rest[some])
    return shown


def _are_enough(gains: Iterable[tuple[Array, Ints]], misfit: Array, rest: Array) -> Bools:
    """Fits (B,) of which some family lowers the misfit by so much that it may be named."""
    shown, lefts = np.zeros(misfit.shape, bool), distinct(rest).tolist()
    for gain, directions in gains:
        for count in filter(None, distinct(directions).tolist()):
            least = np.array([least_gain(count, left) for left in lefts]) * LOOK_MARGIN
            shown |= (directions == count) & (gain > least[np.searchsorted(lefts, rest)] * misfit)
    return shown


def _may_be_enough(
    design: Alike,
    names: Collection[str],
    residual: Array,
    response: list[Array],
    misfit: Array,
    rest: Array,
) -> Bools:
    """Fits (B,) without drift of which a bound of some family's gain is enough for it to be named.

    Sensors R that are M times those R₀ of a fit of middling noise have at least κ times the information on an effect, κ
    being the least eigenvalue of MᵀM. So no gain is more than 1/κ times that by the information of this one fit.
    """
    middle = np.argsort(response[-1][:, 0, 3])[len(misfit) // 2 :][:1]
    first = [each[middle] for each in response]
    least, most = np.ones((2, len(misfit)))
    for each, one in zip(response, first, strict=True):
        ratio, quieter = each[..., :3] @ inverse(one[..., :3]), (each[:, 0, 3] / one[:, 0, 3]) ** 2
        away = ratio.mT @ ratio / quieter[:, None, None] - np.eye(3)
        size = np.sqrt(np.sum(away**2, (1, 2)))
        least = np.minimum(least, quieter * (1 - size))
        most = np.maximum(most, quieter * (1 + size))
    near = (least < LEAST_ALIKE) | (most > 1 / LEAST_ALIKE)
    effects = common_effects(design)
    _, products, square = effects.sums(0 * residual[:1], first)
    score = np.sum(effects.scores(residual, response), 0)
    for name in (each for each in effects.places if each in names):
        some, pair = effects.places[name]
        size = some.stop - some.start
        information = sum(products[i][0, pair] for i in effects.columns[name])
        length = np.sqrt(np.where(square[0, some] > 0, square[0, some], 1.0))
        value, basis = eigen(np.reshape(information, (size, size)) / outer(length))
        kept, fewest = value > NOTHING_LEFT, max(np.count_nonzero(value > CLEARLY_LEFT), 1)
        along = score[:, some] @ (basis / length[:, None])[:, kept] / np.sqrt(value[kept])
        gain = np.sum(along**2, -1) / np.maximum(least, LEAST_ALIKE)
        near |= _are_enough([(gain, np.full(gain.shape, fewest))], misfit, rest)
    return near


@dataclass(frozen=True)
class _Drifts:
    """Drifts that are in the fits, by triad: their columns, covariance (B, q, q), and the pull (B, q) that is left.

    Their part of the `misfit` (B,), and take of its degrees of `freedom` (B,).
    """

    columns: dict[int, CommonColumns]
    covariance: dict[int, Array]
    pull: dict[int, Array]
    misfit: Array
    freedom: Array

    @classmethod
    def of(
        cls, problem: Problem, state: State, design: Alike, residual: Array, response: list[Array]
    ) -> _Drifts:
        """Of a problem at its solution, with other whitened residuals (B, n, m) and responses."""
        columns, covariance, pull = {}, {}, {}
        misfit, freedom = np.zeros((2, len(residual)))
        if problem.walks:
            precision = closed_form_drift.prior_precision(problem)
            for index, (places, each) in closed_form_drift.walk_columns(design).items():
                known, value = precision[:, places], state.constants[:, places]
                part = residual[..., 3 * index : 3 * index + 3]
                information = each.information(response[index])
                np.einsum("bii->bi", information)[...] += known
                inner = inverse_of_positive(information)
                force = each.score(response[index], part) + known * value
                step = (inner @ force[..., None])[..., 0]
                columns[index], covariance[index], pull[index] = each, inner, step
                misfit += np.sum(known * value**2 - force * step, -1)
                freedom += len(places) - np.sum(known * diagonal(inner), -1)
        return cls(columns, covariance, pull, misfit, freedom)

    def less(
        self, index: int, cross: Array, score: Array, information: Array
    ) -> tuple[Array, Array]:
        """Score (B, k) and information (B, k, k) of effects on a triad less what drifts take.

        `cross` (B, k, q) is what they have in common.
        """
        taken = cross @ self.covariance[index]
        return (
            score - (cross @ self.pull[index][..., None])[..., 0],
            information - taken @ cross.mT,
        )


@dataclass(frozen=True)
class _Families:
    """Effects that are common to tools: what one product of all tools needs, by number of the triad.

    `places` of each family's columns among the k of all, and of its products among those of all families. `left`
    (n, 6, k), `products` (16, p) and `squares` (16, k) as of `CommonColumns`, zero where a family has no effect on the
    triad. `sides` are names of families whose columns are each tool's own.
    """

    places: dict[str, tuple[slice, slice]]
    left: list[Array]
    products: list[Array]
    squares: list[Array]
    columns: dict[str, dict[int, CommonColumns]]
    sides: list[str]

    @classmethod
    def of(
        cls, columns: dict[str, dict[int, CommonColumns]], triads: int, stations: int
    ) -> _Families:
        """Of the effects of each family on each triad."""
        common = {name: each for name, each in columns.items() if each}
        counts = [next(iter(each.values())).whole.shape[-1] for each in common.values()]
        ends, squared = np.cumsum([0, *counts]), np.cumsum([0, *(k * k for k in counts)])
        pairs = zip(pairwise(ends.tolist()), pairwise(squared.tolist()), strict=True)
        places = dict(zip(common, ((slice(*k), slice(*p)) for k, p in pairs), strict=True))
        left = [np.zeros((stations, 6, ends[-1])) for _ in range(triads)]
        products, squares = (
            [np.zeros((16, end[-1])) for _ in range(triads)] for end in (squared, ends)
        )
        for name, (some, pair) in places.items():
            for index, each in common[name].items():
                left[index][..., some], products[index][:, pair] = each.left, each.products
                squares[index][:, some] = each.lengths
        sides = [name for name, each in columns.items() if not each and name.endswith(HYSTERESIS)]
        return cls(places, left, products, squares, common, sides)

    def among(self, some: Collection[str]) -> list[str]:
        """Names of the families that are `some`; of all where none are given."""
        return [name for name in (*self.places, *self.sides) if not some or name in some]

    def sums(
        self, residual: Array, response: list[Array]
    ) -> tuple[list[Array], list[Array], Array]:
        """By triad: scores (B, k) and products (B, p) of all families; and the squares (B, k) of whole columns."""
        information, square = [], np.zeros(())
        for index, reads in enumerate(response):
            squared = squares_of(reads)
            information.append(squared @ self.products[index])
            square = square + squared @ self.squares[index]
        return self.scores(residual, response), information, square

    def scores(self, residual: Array, response: list[Array]) -> list[Array]:
        """By triad: scores (B, k) of all families."""
        scores = []
        for index, reads in enumerate(response):
            pull = residual[..., 3 * index : 3 * index + 3] @ reads
            scores.append(pull.reshape(len(pull), -1) @ self.left[index].reshape(pull[0].size, -1))
        return scores


@lru_cache(maxsize=8)
def common_effects(design: Alike) -> _Families:
    """The change of the readings of the triads by each effect."""
    one, state = perfect(design)
    terms = [sensor_terms(one, state, index) for index in range(len(one.triads))]
    columns: dict[str, dict[int, CommonColumns]] = {}
    for name, family in families(one, state):
        triad = name.partition("-")[0]
        columns[name] = {}
        for index, term in enumerate([] if name.endswith(HYSTERESIS) else terms):
            rows = family[0, :, 3 * index : 3 * index + 3]
            if rows.any():
                of_reading = np.full(rows.shape[-1], triad in TRIADS)
                columns[name][index] = CommonColumns.of(term, rows, of_reading)
    return _Families.of(columns, len(terms), len(terms[0]))


@lru_cache(maxsize=8)
def _across(design: Alike) -> dict[int, Array]:
    """The part of all effects that the drifts in the fit of a design can explain, by triad: (16, k q)."""
    drifts = closed_form_drift.walk_columns(design)
    left = common_effects(design).left
    return {index: products_of(left[index], each.left) for index, (_, each) in drifts.items()}


def _gains(
    design: Alike,
    names: Collection[str],
    residual: Array,
    response: list[Array],
    drifts: _Drifts,
) -> Iterator[tuple[Array, Ints]]:
    """By how much (B,) each common family of some names lowers the misfit, and its directions.

    From whitened residuals (B, n, m).
    """
    effects, count = common_effects(design), len(residual)
    scores, products, square = effects.sums(residual, response)
    across = {
        index: (squares_of(response[index]) @ _across(design)[index]).reshape(
            count, square.shape[-1], -1
        )
        for index in drifts.columns
    }
    for name in (each for each in effects.places if each in names):
        some, pair = effects.places[name]
        size = some.stop - some.start
        score = information = np.zeros(())
        for index in effects.columns[name]:
            both = scores[index][:, some], products[index][:, pair].reshape(count, size, size)
            if index in across:
                both = drifts.less(index, across[index][:, some], *both)
            score, information = score + both[0], information + both[1]
        yield gain_of(score, information, square[:, some])


def _gains_of_sides(
    problem: Problem,
    design: Alike,
    names: Collection[str],
    residual: Array,
    response: list[Array],
    drifts: _Drifts,
) -> Iterator[tuple[Array, Ints]]:
    """The same of the families whose columns are each tool's own."""
    for name in (each for each in common_effects(design).sides if each in names):
        index = TRIADS.index(name.removesuffix(HYSTERESIS))
        raw, include = problem.triads[index].raw, problem.evidence.include
        sides = side(moves(raw)) * include[..., None]
        terms = sensor_terms(*perfect(design), index)
        part = residual[..., 3 * index : 3 * index + 3]
        yield _gain_of_sides(terms, sides, part, index, response[index], drifts)


def gain_of(score: Array, information: Array, square: Array) -> tuple[Array, Ints]:
    """By how much (B,) columns of so large a `square` (B, k) lower the misfit, and their directions."""
    length = np.sqrt(np.where(square > 0, square, 1.0))
    if length.shape[-1] == 1:
        value, vector = information[..., 0] / length**2, np.ones((1, 1))
    else:
        value, vector = eigen(information / outer(length))
    along = (vector.mT @ (score / length)[..., None])[..., 0]
    kept = value > LEFT_BY_FIT
    return quotient(along**2, value, kept).sum(-1), np.count_nonzero(kept, -1)


def _gain_of_sides(
    terms: Array, sides: Array, residual: Array, index: int, response: Array, drifts: _Drifts
) -> tuple[Array, Ints]:
    """The same for a column on each axis of a triad, of which the values (B, n, 3) are each tool's."""
    basis = np.linalg.qr(terms)[0]
    whole = over_stations(sides**2)
    left = whole - over_stations((basis.transpose() @ sides) ** 2)
    score = over_stations(sides * residual)
    if index in drifts.columns:
        seen = drifts.columns[index].left
        cross = (sides.mT @ seen.reshape(len(seen), -1)).reshape(len(sides), 3, 6, -1)
        cross = np.sum(response[..., None] * cross, 2)
        return gain_of(*drifts.less(index, cross, score, left[..., None] * np.eye(3)), whole)
    kept = left > LEFT_BY_FIT * whole
    return quotient(score**2, left, kept).sum(-1), np.count_nonzero(kept, -1)


@cache
def least_gain(directions: int, rest: float) -> float:
    """Share of the misfit from which a family of so many directions may be named, the `rest` being all other freedom.

    >>> round(least_gain(1, 265.0), 3)
    0.056
    """
    rest -= directions

    def possible(gains: Array) -> int:
        """How many of the gains noise alone may have: the first ones."""
        many = np.full(gains.shape, float(directions))
        chance = f_test(gains * directions, many, np.ones(()), np.full(gains.shape, rest))
        return int(np.sum(~(chance < EFFECT_CHANCE)))

    before = max(possible(GAINS[::GAIN_STRIDE]) - 1, 0) * GAIN_STRIDE
    last = max(before + possible(GAINS[before : before + GAIN_STRIDE]) - 1, 0)
    ratio = GAINS[last] * directions
    return float(ratio / (ratio + max(rest, 1.0)))


# --------------------------------------------------------------------------
# Which fits on an uncertain stand may show an effect: the first round of `structure` for all at once.
#
# Tools at the same references have the columns of effects in common but for their own sensors; here they are taken
# where
# the stand does not err. Weights, and what the fit takes up, are each tool's own.


STAND_MARGIN = 0.75
"""A fit is looked at from this share of the gain that would name an effect."""
LARGEST_ERROR = 5e-3
"""Errors of angles, rad, up to which the columns of effects are as without them."""
LARGEST_RESCALING = 0.1
"""Change of the noise, as a share, up to which the weights are as in the fit."""


def on_stand_may_show(result: Fit, among: Collection[str] = ()) -> Bools:
    """Fits (B,) on an uncertain stand that may show an effect, `among` some if any are given.

    All of them where the columns of effects are not common to tools, or depend on temperature.
    """
    problem, every = result.problem, np.ones(len(result.status), bool)
    if not are_alike(problem):
        return every
    design = _exact(problem, result.state)
    names = common_effects(design).among(among)
    if any(name.endswith(("-temperature", "-thermal-lag")) for name in names):
        return every
    at, errors = uncertain_stand.linear(problem, result.state), result.state.errors
    scale = np.sqrt(variance_scales(result))
    shown = np.any(np.abs(scale - 1) > LARGEST_RESCALING, -1)
    shown |= np.any(np.abs(errors) > LARGEST_ERROR, (1, 2))
    residual = at.weighed(at.left)
    misfit = np.einsum("ibn,ibn->b", at.left, residual) + np.sum(at.precision * at.value**2, -1)
    known, covariance = at.covariance.trace(at.of_data), at.covariance.whole
    rest = np.ceil(6 * problem.evidence.include.sum(-1) - known)
    for columns in _columns(problem, result, design, names):
        weighed = np.einsum("ij...,jk...->ik...", at.weight, columns)
        score = np.einsum("ikbn,ibn->bk", columns, residual)
        crossed = at.columns.with_others(weighed)
        information = np.einsum("ikbn,ilbn->bkl", columns, weighed)
        square = np.einsum("bkk->bk", information).copy()
        information -= crossed.mT @ (covariance @ crossed)
        gain, directions = gain_of(score, information, square)
        for count, left in {*zip(directions.tolist(), rest.tolist(), strict=True)}:
            if count:
                least = least_gain(count, left) * STAND_MARGIN
                shown |= (directions == count) & (rest == left) & (gain > least * misfit)
    return np.asarray(shown)


def _exact(problem: Problem, state: State) -> Alike:
    """The design of a problem as if its stand did not err."""
    evidence = problem.evidence
    sd = {n: 0 * sd if n in ANGLES else sd for n, sd in evidence.sd.items()}
    exact = replace(problem, evidence=replace(evidence, sd=sd))
    return Alike.of(exact, replace(state, errors=0 * state.errors))


def _columns(
    problem: Problem, result: Fit, design: Alike, names: Collection[str]
) -> Iterator[Array]:
    """Columns (6, k, B, n) of the effects of some names in whitened readings."""
    response, include = responses(problem, result.state), problem.evidence.include
    effects = common_effects(design)
    for columns in (effects.columns[name] for name in effects.places if name in names):
        count = next(iter(columns.values())).whole.shape[-1]
        every = np.zeros((6, count, *include.shape))
        for index, each in columns.items():
            flat = each.whole.transpose(1, 2, 0).reshape(6, -1)
            both = (response[index] @ flat).reshape(len(include), 3, count, -1)
            every[TRIAD_ROWS[index]] = np.moveaxis(both, 0, 2)
        yield every
    for name in (each for each in effects.sides if each in names):
        index = TRIADS.index(name.removesuffix(HYSTERESIS))
        one = problem.triads[index]
        sides = side(moves(one.raw)) * include[..., None] / one.sd
        every = np.zeros((6, 3, *include.shape))
        for axis in range(3):
            every[3 * index + axis, axis] = sides[..., axis]
        yield every


STRUCTURE_CHANCE = 0.01
"""Chance of residuals as large in declared noise, below which their structure is looked at."""
BAD_SHARE = 0.1
"""Share of bad stations up to which they are left out; a single one always is."""
COLUMN = "column "
"""Beginnings of the names of columns that the run does not use."""
COLUMN_EXPLAINS = (
    "Column {name!r} is not used, and explains {effect.share:.0%} of the misfit. If it is the temperature of the tool, "
    "name it 'temperature_c' (°C), or under [columns] of the tool profile; else find out what it stands for."
)
CLEAR_SHARE = 0.2
"""A column is reported if it explains this share of the misfit…"""
CLEAR_CHANCE = 1e-6
"""…and would by chance less often than this."""
FEWEST_TESTED = 20
"""Stations from which columns are tested: fewer are explained by anything."""
REPEATED = 0.02
"""A column repeats the attitudes if they leave no more than this share of its variance."""
AT_ONCE = 32
"""Fits that are looked at together: few enough for the cache."""
ZEROS = ("azimuth-zero", "inclination-zero", "dip-reference")
"""Effects that are one angle."""
CONSTANT_ERRORS = (*ZEROS, "tilt")
"""Effects that are errors of the references, the same at all stations."""
EFFECTS = {
    "azimuth-zero": "an azimuth zero of the stand: set the index, or fit it with `estimate` azimuth-zero, or declare "
    "its uncertainty (azimuth_zero_deg under [stand])",
    "inclination-zero": "an inclination zero of the stand: set the level, or fit it with `estimate` inclination-zero, "
    "or declare its uncertainty (inclination_zero_deg under [stand])",
    "tilt": "a stand whose vertical leans: level it, or fit it with `estimate` tilt, or declare its uncertainty "
    "(tilt_deg under [stand])",
    "settings": "settings of the stand that stations of one direction share: set it anew for each station, or give "
    "the roll sets as group without their reference angles",
    "dip-reference": "a wrong reference for the dip: check ref_dip_deg, or leave it blank to have it estimated",
    "field-drift": "a field that changes in the order of the stations (diurnal variation, traffic): give ref_field_nt "
    "and ref_dip_deg of each station from a reference magnetometer, or repeat the run at a quiet time",
    "field-gradient": "a field that depends on where the tool points (iron nearby, or sensors off the pivot): move "
    "iron away, or keep the sensors at one place while turning",
    "backlash": "backlash of the stand: its angles depend on the side they were reached from. Reach every angle "
    "from the same side",
    "drift": "a drift in the order of the stations: let the tool warm up, or repeat the first stations at the end",
    "hysteresis": "hysteresis: readings depend on the side they were reached from. Demagnetise, or look for play in "
    "the mounting",
    "thermal-lag": "thermal lag: readings follow the thermometer late. Wait longer after each change of temperature",
}
"""The likely cause of the residuals, and the remedy."""


@dataclass(frozen=True)
class Effect:
    """One effect: its name, the share of the misfit it takes, chance in noise, and its size.

    `values` and `uncertainties` belong to its columns, in their units (radians, g or nT); `size`
    (t,) is the root mean square of what it does to the readings of each triad, in g and nT.
    """

    name: str
    share: float
    chance: float
    values: Array
    uncertainties: Array
    size: Array


@dataclass(frozen=True)
class _Scores:
    """Efficient scores (B, k) and their covariance (B, k, k) for columns of unit length, with lengths (B, k).

    `places` of the columns of each family; the `misfit` (B,) of all readings, with its degrees of freedom.
    """

    score: Array
    information: Array
    length: Array
    columns: Array
    places: dict[str, Ints]
    misfit: Array
    freedom: Array

    def of(self, members: Ints) -> _Scores:
        """Those of some fits."""
        names = ("score", "information", "length", "columns", "misfit", "freedom")
        return replace(self, **{name: getattr(self, name)[members] for name in names})

    def gain(self, names: Sequence[str]) -> tuple[Array, Ints]:
        """By how much (B,) some families lower the cost, and how many directions they have."""
        if not names:
            return 0.0 * self.misfit, np.zeros(self.misfit.shape, int)
        index = self._columns(names)
        value, vector = eigen(self.information[:, index[:, None], index])
        along = (vector.mT @ self.score[:, index, None])[..., 0]
        kept = value > LEFT_BY_FIT
        return quotient(along**2, value, kept).sum(-1), np.count_nonzero(kept, -1)

    def solution(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Values (k',) of the columns of some families, and their covariance (k', k'), of a single fit."""
        index = self._columns(names)
        value, vector = eigen(self.information[0][np.ix_(index, index)])
        kept, length = value > LEFT_BY_FIT, self.length[0, index]
        inverse = (vector[:, kept] / value[kept]) @ vector[:, kept].transpose()
        return -inverse @ self.score[0, index] / length, inverse / outer(length)

    def _columns(self, names: Sequence[str]) -> Ints:
        return np.concatenate([self.places[name] for name in names])


Shown = dict[str, tuple[float, float]]
"""Chance and share of the misfit of each effect that a fit shows, by name."""


def shown_effects(
    result: Fit, others: Mapping[str, Array], among: Collection[str] = ()
) -> list[Shown]:
    """Effects that the residuals of each fit (B) show, in the order in which they are found.

    `others` (B, n) are numbers of columns that the fit does not use: each may explain the residuals too. The effects
    are `among` some if any are given.
    """
    if result.analysis.influence is not None:
        return [{} for _ in result.status]
    every: list[Shown] = [{} for _ in result.status]
    stand = result.analysis.squares is not None and uncertain_stand.applies(result.problem)
    look = on_stand_may_show if stand else may_show
    looked_at = look(result, among) | bool(others)
    bad = _bad_stations(result)
    places = np.flatnonzero(looked_at | bad.any(-1))
    for first in range(0, len(places), AT_ONCE):
        some = places[first : first + AT_ONCE]
        part = _without(take(result, some), bad[some])
        shown = _searched(part, {n: v[some] for n, v in others.items()}, among)
        for place, each in zip(some.tolist(), shown, strict=True):
            every[place] = each
    return every


def _searched(result: Fit, others: Mapping[str, Array], among: Collection[str]) -> list[Shown]:
    """Effects that residuals show: the least likely by chance first, then what its fit leaves, and so on."""
    scores = _scores(_at_noise_of(result), result, others, among)
    shown: list[Shown] = [{} for _ in result.status]
    left = scores.misfit.copy()
    searched: dict[tuple[str, ...], Ints] = {(): np.arange(len(shown))} if scores.places else {}
    while searched:
        further: dict[tuple[str, ...], list[int]] = {}
        for chosen, members in searched.items():
            part = scores if len(members) == len(shown) else scores.of(members)
            open_ = sorted(scores.places.keys() - chosen)
            chance, change = _trials(part, chosen, open_, left[members])
            best = np.lexsort((change, chance), axis=0)[0]
            for place, number in enumerate(best.tolist()):
                if chance[number, place] < EFFECT_CHANCE:
                    member, taken = int(members[place]), -change[number, place]
                    share = float(taken / scores.misfit[member])
                    shown[member][open_[number]] = float(chance[number, place]), share
                    left[member] -= taken
                    further.setdefault((*chosen, open_[number]), []).append(member)
        whole = len(scores.places)
        searched = {names: np.array(m) for names, m in further.items() if len(names) < whole}
    return shown


def _at_noise_of(result: Fit) -> Problem:
    """The problem of a fit with the noise that its residuals show."""
    scales = np.maximum(variance_scales(result), 1e-12)
    triads = [
        replace(t, sd=t.sd * np.sqrt(scales[:, i, None, None]))
        for i, t in enumerate(result.problem.triads)
    ]
    return replace(result.problem, triads=tuple(triads))


def chance_of(problem: Problem, result: Fit, columns: Array) -> Array:
    """Chance (B,) in noise that columns (B, n, m, k) explain as much of the residuals of a fit to a problem."""
    scores = _scores_of(problem, result, {"": columns})
    chance, _ = _trials(scores, (), ("",), scores.misfit)
    return np.asarray(chance[0])


def effects(
    result: Fit, others: Mapping[str, Array] | None = None, shown: Shown | None = None
) -> list[Effect]:
    """The effects that one fit (B = 1) shows, with their sizes, as far as they are reported.

    `shown` are those that `shown_effects` found, if it was asked before.
    """
    others = others or {}
    shown = shown_effects(result, others)[0] if shown is None else shown
    if not shown:
        return []
    every = _described(_without(result, _bad_stations(result)), shown, others)
    return [effect for effect in every if is_shown(shown, effect.name)]


def is_shown(shown: Shown, name: str) -> bool:
    """Whether an effect is reported: powers of temperature by another finding, columns where they explain much."""
    chance, share = shown[name]
    much = share >= CLEAR_SHARE and chance < CLEAR_CHANCE
    return much if name.startswith(COLUMN) else not name.endswith(COURSE_SUFFIX)


def _testable(problem: Problem, state: State, others: Mapping[str, Array]) -> dict[str, Array]:
    """Columns (B, n), centred and of unit size; zero for those that are constant, counters, or repeat the attitudes."""
    shape = problem.temperature.shape
    if not others or shape[-1] < FEWEST_TESTED:
        return {}
    turns = np.concatenate([np.ones((*shape, 1)), state.attitude.reshape(*shape, 9)], -1)
    basis = np.linalg.svd(turns, full_matrices=False)[0]
    columns = {}
    for name, values in others.items():
        spread = np.std(values, -1, keepdims=True)
        varies = spread > 1e-12 * np.abs(values).max(-1, keepdims=True)
        counter = np.all(np.diff(values) == 1, -1) & np.isin(values[:, 0], (0, 1))
        unit = quotient(values - values.mean(-1, keepdims=True), spread, varies)
        left = unit - (basis @ (basis.mT @ unit[..., None]))[..., 0]
        tested = ~counter & (np.mean(left**2, -1) > REPEATED)
        columns[name] = unit * tested[:, None]
    return columns


def _bad_stations(result: Fit) -> Bools:
    """The stations (B, n) to take again of fits of which they are few: one bad station looks like anything."""
    bad = stations_to_reshoot(result)
    few = np.sum(bad, -1, keepdims=True) <= max(1.0, BAD_SHARE * bad.shape[-1])
    return np.asarray(bad & few)


def _without(result: Fit, bad: Bools) -> Fit:
    """The fits less their bad stations, and with the noise of the others.

    With that of a bad station in one triad, the other looks as if it had structure.
    """
    places = np.flatnonzero(bad.any(-1))
    if not places.size:
        return result
    fewer = without_stations(take(result, places), bad[places])
    if kind_of(fewer) != kind_of(result):  # of a method with an analysis of its own
        return replace(result, problem=fewer_stations(result.problem, bad))
    return put(result, places, fewer)


def _trials(
    scores: _Scores, chosen: Sequence[str], names: Sequence[str], left: Array
) -> tuple[Array, Array]:
    """Chance (F, B) in noise of each of some families beside those chosen, and its change of the misfit `left`."""
    before, taken = scores.gain(chosen)
    each = [scores.gain([*chosen, name]) for name in names]
    gain, directions = (np.stack(part) for part in zip(*each, strict=True))
    gain, directions = np.minimum(gain - before, left * (1 - 1e-9)), directions - taken
    rest = scores.freedom - taken - directions
    tested = (directions >= 1) & (rest >= 1)
    scatter = quotient(left - gain, rest, tested)
    chance = f_test(gain, np.where(tested, directions, 0), scatter, rest)
    return np.nan_to_num(chance, nan=1.0), np.where(tested, -gain, 0.0)


def _described(result: Fit, shown: Shown, others: Mapping[str, Array]) -> list[Effect]:
    """The effects, of chance and share, with their sizes: all together, with the noise that they leave."""
    problem, names = result.problem, [*shown]
    scores = _scores(problem, result, others)
    gain, directions = (float(each[0]) for each in scores.gain(names))
    misfit, freedom = float(scores.misfit[0]), float(scores.freedom[0])
    scale = np.sqrt(max(misfit - gain, 0.0) / max(freedom - directions, 1.0))
    values, covariance = scores.solution(names)
    spread, sized, end = np.sqrt(np.diag(covariance)) * scale, [], 0
    for name, (chance, share) in shown.items():
        where = scores.places[name]
        columns = slice(end, end := end + len(where))
        change = (scores.columns[..., where] * scores.length[:, where]) @ values[columns]
        size = [
            np.sqrt(np.mean(np.sum((change[..., 3 * i : 3 * i + 3] * t.sd) ** 2, -1)))
            for i, t in enumerate(problem.triads)
        ]
        sized.append(Effect(name, share, chance, values[columns], spread[columns], np.array(size)))
    return sized


def _scores(
    problem: Problem, result: Fit, others: Mapping[str, Array], among: Collection[str] = ()
) -> _Scores:
    """Efficient scores of all families, or `among` some, and of columns that the fit does not use."""
    columns = {n: c for n, c in families(problem, result.state) if not among or n in among}
    if tested := _testable(problem, result.state, others):
        steady = steady_columns(problem, result.state)
        columns |= {COLUMN + n: products(steady, v[..., None]) for n, v in tested.items()}
    return _scores_of(problem, result, columns)


def _scores_of(problem: Problem, result: Fit, columns: Mapping[str, Array]) -> _Scores:
    """Efficient scores of the columns (B, n, m, k) of some families: what the fit's unknowns cannot take up."""
    linear = problem.linear(result.state)
    whole, normal = whole_covariance(linear, result.analysis.determined), linear.normal
    every = np.concatenate([linear.residual[..., None][..., :0], *columns.values()], -1)
    ends = np.cumsum([0, *(each.shape[-1] for each in columns.values())])
    places = {n: np.arange(*each) for n, each in zip(columns, pairwise(ends), strict=True)}
    flat = every.reshape(len(every), linear.residual[0].size, every.shape[-1])
    weighed = linear.weigh(every).reshape(flat.shape)
    square = np.einsum("bik,bik->bk", flat, weighed)
    length = np.sqrt(np.maximum(square, 0.0))  # rounding may leave less where the noise is tiny
    length = np.where(length > 0, length, 1.0)
    crossed = linear.design.reshape(len(every), -1, whole.shape[-1]).mT @ weighed
    pull = (weighed.mT @ linear.residual.reshape(len(every), -1, 1))[..., 0]
    taken = whole @ np.concatenate([crossed, normal.gradient[..., None]], -1)
    score = pull - (crossed.mT @ taken[..., -1:])[..., 0]
    information = flat.mT @ weighed - crossed.mT @ taken[..., :-1]
    misfit = normal.cost - np.sum(normal.gradient * taken[..., -1], -1)
    fitted = np.sum(whole * (normal.information - linear.prior), (-1, -2))
    count = problem.evidence.include.sum(-1) * linear.residual.shape[-1]
    freedom = count - (fitted + _unknown(problem, result))
    unit = every / length[:, None, None]
    return _Scores(
        score / length, information / outer(length), length, unit, places, misfit, freedom
    )


def _unknown(problem: Problem, result: Fit) -> Ints:
    """Number (B,) of unknowns that stations have to themselves; none where one is left out."""
    evidence = problem.evidence
    if not (evidence.exact_turn_sd.any() or evidence.free.any() or evidence.absent):
        return np.zeros(len(result.status), int)
    private = problem.linear(result.state, geometry=True).private
    return np.asarray(np.sum(np.linalg.svd(private, compute_uv=False) > 1.0, (-1, -2)))


def suspected(result: Fit, chance: Array) -> Bools:
    """Fits (B,) whose residuals are looked at: where noise is estimated, or residuals exceed it.

    `chance` (B, t) is that of residuals as large as each triad's, NaN where noise is not declared.
    """
    estimated = np.isfinite(result.noise).any(-1)
    return np.asarray(estimated | (np.nan_to_num(chance, nan=1.0) < STRUCTURE_CHANCE).any(-1))


def farthest_setting(problem: Problem, state: State, effect: Effect) -> tuple[str, Ints]:
    """The angle and the stations of the setting that an effect of settings shows most clearly, of a single run."""
    turns = _turns(problem, state, problem.station_columns(state)[0])
    angles, sets = [name for name in SET_TURNS if name in turns], _sets(problem)[0]
    sizes = quotient(np.abs(effect.values), effect.uncertainties, effect.uncertainties > 0)
    angle, number = divmod(int(np.argmax(sizes)), sets.shape[-1])
    return angles[angle].removesuffix("-zero"), np.flatnonzero(sets[:, number])


def described(effect: Effect, readings: Readings) -> str:
    """An effect in words, in the units of a run."""
    if effect.name.startswith(COLUMN):
        return COLUMN_EXPLAINS.format(name=effect.name.removeprefix(COLUMN), effect=effect)
    triad, _, kind = effect.name.partition("-")
    of_triad = triad in TRIADS
    looks = EFFECTS[kind if of_triad else effect.name]
    if effect.name in ZEROS:
        size = f"{np.degrees(effect.values[0]):+.3g}° ± {np.degrees(effect.uncertainties[0]):.2g}°"
        reference = effect.name == "dip-reference"
        size += " (dip less its reference)" if reference else " (reading less true)"
    elif effect.name == "tilt":
        size = f"{np.degrees(np.linalg.norm(effect.values)):.2g}°"
    else:
        factor, unit = shown_in("field", readings.relative)
        if readings.relative and readings.magnetometer is not None:
            factor /= np.linalg.norm(readings.magnetometer, axis=-1).mean()
        parts = [(1e3, "mg"), (factor, unit)][: len(effect.size)]
        each = [f"{s * f:.2g} {u} rms" for s, (f, u) in zip(effect.size, parts, strict=True)]
        size = " and ".join(each[TRIADS.index(triad) :][:1] if of_triad else each)
    whose = f"{triad}: the" if of_triad else "The"
    return (
        f"{whose} residuals look like {looks}. Size {size}, {effect.share:.0%} of the misfit; chance in "
        f"noise {effect.chance:.0e}. The stated uncertainty does not include it."
    )
