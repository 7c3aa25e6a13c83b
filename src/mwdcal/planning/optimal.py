"""The best stations out of candidates, by the information that each gives.

Information matrices of independent stations add up. What all stations share (errors of the stand,
uncertain references) are further unknowns, eliminated by a Schur complement, which keeps the
criteria concave: the bound of Kiefer and Wolfowitz holds for them too.

Reference: V. V. Fedorov, Theory of Optimal Experiments (1972), for the exchange of stations and the
bound; D. M. Titterington, "Algorithms for computing D-optimal designs" (1976), for the weights.

The fewest stations that keep several variances within their limits, and how few cannot do.

A variance is tr(W V), W (r, r) in units of its limit and V the covariance of the parameters: what is
wanted is reached where the largest is at most 1. Method: A-optimal stations for a weighted mean of all
W, the weights raised where a variance is large; then exchanges that lower the largest itself.

The bound is of the relaxed problem, in which a candidate counts by a weight from 0 to 1: the largest
variance is at least every weighted mean of them, and that is convex, hence nowhere below its tangents.

Reference: V. V. Fedorov, Theory of Optimal Experiments (1972), sections 2.9 and 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.geometry.vectors import Array, Bools, Ints, inverse

WEIGHT_STEPS = 300
"""Steps at most by which the weights of the bound are improved."""
CLOSE = 2e-3
"""The bound on the D-value per parameter is looked for to this share of it."""
ROUNDS = 3
"""Times that the stations of each group are chosen anew."""
GAIN = 1e-9
"""Smallest improvement of a criterion that counts."""
LITTLE = 1e-6
"""Weight of all candidates beside stations that are too few alone, for numbers to exist."""
TIE = 1e-7
"""Candidates whose gains differ by less than this share are equal: the first is taken."""


@dataclass(frozen=True)
class Information:
    """What candidate stations say of the parameters, in units in which all of them together say 1.

    `rows` (n, m, k): whitened rows by k unknowns, of which the first `size` are the determined directions of
    the parameters and the others what the stations share; `prior` (k, k) is their precision.
    """

    rows: Array
    prior: Array
    size: int

    @property
    def count(self) -> int:
        """Number of candidates."""
        return len(self.rows)

    def of(self, weights: Array) -> Array:
        """Information (k, k) of candidates that count with `weights` (n,)."""
        weighed = self.rows * np.sqrt(weights)[:, None, None]
        flat = weighed.reshape(-1, weighed.shape[-1])
        return np.asarray(flat.T @ flat + self.prior)

    @classmethod
    def of_fit(cls, result: Fit) -> tuple[Information, Array]:
        """Of the fit of all candidates, and the directions (p, r) in which it is: parameters = T · unknowns."""
        linear = result.problem.linear(result.state)
        values, vectors = np.linalg.eigh(linear.weight[0])
        rows = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]).mT @ linear.design[0]
        p, covariance = linear.size, result.analysis.covariance[0]
        determined = result.analysis.determined
        values, vectors = np.linalg.eigh(covariance / np.outer(*2 * [1 / determined.norms[0]]))
        kept = values > values[-1] * 1e-14
        turn = vectors[:, kept] * np.sqrt(values[kept]) / determined.norms[0][:, None]
        shared = 1 / np.sqrt(np.diag(linear.prior[0])[p:])
        whole = np.concatenate([rows[..., :p] @ turn, rows[..., p:] * shared], -1)
        size = turn.shape[1]
        prior = np.zeros((whole.shape[-1],) * 2)
        prior[:size, :size] = turn.T @ linear.prior[0, :p, :p] @ turn
        prior[size:, size:] = linear.prior[0, p:, p:] * np.outer(shared, shared)
        return cls(whole, prior, size), turn


@dataclass(frozen=True)
class Design:
    """Chosen candidates, `members` (n,) of all, and how good they are."""

    information: Information
    members: Bools

    @property
    def chosen(self) -> Ints:
        """Their places (N,) among the candidates, in the order of these."""
        return np.flatnonzero(self.members)

    @cached_property
    def efficiency(self) -> float:
        """Share of the best D-value, per parameter, that as many stations at the candidates can have, at least.

        Definition: of det(information)^(1/r). Method: weights of the candidates approach the best ones, and what
        any others could still gain over them is bounded by the steepest slope (Kiefer and Wolfowitz).
        """
        information, count = self.information, np.count_nonzero(self.members)
        size, bound = information.size, np.inf
        reached = _log_det(information.of(self.members.astype(np.float64)), size)
        weights = np.full(information.count, count / information.count)
        for _ in range(WEIGHT_STEPS):
            whole = information.of(weights)
            slopes = _slopes(information, whole)
            mean = float(weights @ slopes) / count
            gain = count * (float(slopes.max()) - mean)
            bound = min(bound, _log_det(whole, size) + gain)
            if gain < CLOSE * size:
                break
            weights = weights * slopes / mean
        return float(np.exp(min(reached - bound, 0.0) / size))


def best(
    information: Information, count: int, wanted: Array | None = None, kept: Bools | None = None
) -> Design:
    """The best `count` of the candidates, each at most once, `kept` (n,) ones among them.

    Without `wanted` those of the largest determinant of the parameters' information (D-optimal), with it
    those of the least tr(W V), W (r, r) being `wanted` and V the parameters' covariance: A-optimal where W
    scales the parameters, I-optimal where it is the mean of what variances V gives over a range.
    Method: stations added one by one, then exchanged as long as that gains.
    """
    kept = np.zeros(information.count, bool) if kept is None else kept
    chosen = _added(information, count, wanted, kept)
    return Design(information, exchanged(information, chosen, wanted, kept))


def exchanged(
    information: Information, chosen: Bools, wanted: Array | None, kept: Bools, limits: Array | None = None
) -> Bools:  # fmt: skip
    """The candidates (n,) after all exchanges that improve a criterion, those `kept` staying.

    With `limits` (c, r, r) none is made that brings a variance tr(W V) above 1, W being one of these.
    """
    chosen = chosen.copy()
    while _exchange(information, chosen, wanted, kept, limits):
        pass
    return chosen


def _added(information: Information, count: int, wanted: Array | None, kept: Bools) -> Bools:
    """A start: to those kept the station that gains most, one after the other."""
    chosen = kept.copy()
    little = LITTLE * information.of(np.ones(information.count))
    for _ in range(count - np.count_nonzero(kept)):
        gains = Gains(
            information, information.of(chosen.astype(np.float64)) + little, wanted
        ).of_adding()
        chosen[first_best(np.where(chosen, -np.inf, gains))] = True
    return chosen


def first_best(gains: Array) -> int:
    """The first of the candidates that gain most, so that rounding does not choose between equals.

    >>> first_best(np.array([1.0, 2.0 - 1e-12, 2.0]))
    1
    """
    largest = gains.max()
    return int(np.argmax(gains >= largest - TIE * abs(largest)))


def _exchange(
    information: Information, chosen: Bools, wanted: Array | None, kept: Bools, limits: Array | None
) -> bool:
    """Replace each chosen station, but for `kept` ones, by what gains most, if that does; whether one was."""
    improved = False
    for place in np.flatnonzero(chosen & ~kept):
        chosen[place] = False
        whole = information.of(chosen.astype(np.float64))
        if np.linalg.cond(whole) > 1e14:  # without it nothing can be said
            chosen[place] = True
            continue
        gains = np.where(chosen, -np.inf, Gains(information, whole, wanted).of_adding())
        least = gains[place] + max(GAIN, TIE * abs(gains[place]))
        if limits is not None:
            better = gains > least
            some = replace(information, rows=information.rows[better])
            gains[better] = np.where(_within(some, whole, limits), gains[better], -np.inf)
        other = first_best(gains)
        gained = bool(gains[other] > least)
        chosen[other if gained else place] = True
        improved |= gained
    return improved


def _within(information: Information, whole: Array, limits: Array) -> Bools:
    """With which candidates (n,), each added to `whole` (k, k), no variance is above 1."""
    none = not information.count
    return np.zeros(0, bool) if none else Gains(information, whole, limits).left().max(-1) <= 1


@dataclass(frozen=True)
class Gains:
    """What candidates add to a criterion where the information is `whole` (k, k)."""

    information: Information
    whole: Array
    wanted: Array | None

    def of_adding(self) -> Array:
        """Gain (n,) of the criterion by each candidate."""
        rows, size = self.information.rows, self.information.size
        if self.wanted is None:
            alone = _log_gain(rows[..., size:], self.whole[size:, size:])
            return _log_gain(rows, self.whole) - alone
        moved = rows @ inverse(self.whole)
        inner = np.eye(rows.shape[1]) + moved @ rows.mT
        seen = moved[..., :size] @ self.wanted @ moved[..., :size].mT
        return np.asarray(np.trace(np.linalg.solve(inner, seen), axis1=-2, axis2=-1))

    def left(self) -> Array:
        """The variances tr(W V) (n, c) with each candidate added, W being several, `wanted` (c, r, r)."""
        rows, size, wanted = self.information.rows, self.information.size, self.wanted
        back = inverse(self.whole)
        moved = rows @ back
        inner = np.eye(rows.shape[1]) + moved @ rows.mT
        fallen = np.linalg.solve(inner, moved[..., :size]).mT @ moved[..., :size]
        flat = np.reshape(np.asarray(wanted), (-1, size * size))
        return np.asarray(
            flat @ back[:size, :size].ravel() - fallen.reshape(len(rows), -1) @ flat.mT
        )


def _log_gain(rows: Array, whole: Array) -> Array:
    """Log det (n,) of I + R M⁻¹ Rᵀ: what rows add to log det M."""
    if not rows.shape[-1]:
        return np.zeros(len(rows))
    inner = np.eye(rows.shape[1]) + rows @ inverse(whole) @ rows.mT
    return np.asarray(np.linalg.slogdet(inner)[1])


def _log_det(whole: Array, size: int) -> float:
    """Log det of the parameters' information, what is shared being eliminated from the `whole` (k, k)."""
    return float(np.linalg.slogdet(whole)[1] - np.linalg.slogdet(whole[size:, size:])[1])


def _slopes(information: Information, whole: Array) -> Array:
    """Change (n,) of `_log_det` by the weight of each candidate, where the information is `whole` (k, k)."""
    size, rows = information.size, information.rows
    return _squares(rows, whole) - _squares(rows[..., size:], whole[size:, size:])


def _squares(rows: Array, whole: Array) -> Array:
    """Trace (n,) of R M⁻¹ Rᵀ for the rows of each candidate."""
    return np.asarray(np.sum(rows @ inverse(whole) * rows, (-2, -1)))


def evenly(information: Information, members: Bools, wanted: Array | None, group: Ints) -> Bools:
    """As many good candidates (n,) as `members`, of each group (n,) as many as of the others.

    Method: those of one group after the other are chosen anew, as the best beside the others.
    """
    taken, sizes = members.copy(), np.bincount(group)
    each, more = divmod(np.count_nonzero(members), len(sizes))
    for place in ROUNDS * list(range(len(sizes))):
        inside = group == place
        others = information.of((taken & ~inside).astype(np.float64))
        part = replace(information, rows=information.rows[inside], prior=others)
        taken[inside] = best(part, min(each + (place < more), sizes[place]), wanted).members
    return taken


def typical_sd(information: Information, members: Bools, wanted: Array | None) -> float:
    """The 1σ that a criterion is about, in a unit of its own: of all parameters, or the root of tr(W V)."""
    if wanted is None:
        whole = information.of(members.astype(np.float64))
        return float(np.exp(-_log_det(whole, information.size) / (2 * information.size)))
    return float(np.sqrt(variances(information, members, wanted[None])[0]))


WEIGHINGS = 8
"""Times that the variances are weighed anew."""
MOST_EXCHANGES = 100
"""Exchanges of one search, at most."""
LOWERED = 1e-6
"""Smallest share by which an exchange has to lower the largest variance."""
BOUND_STEPS = 300
"""Steps at most in which the bound is improved."""
MOST_PRODUCTS = 4e8
"""Products, at most, in one look at all exchanges; in a larger search there are none."""


def variances(information: Information, members: Bools, wanted: Array) -> Array:
    """The variances (c,) that chosen candidates give, of `wanted` (c, r, r)."""
    whole, size = information.of(members.astype(np.float64)), information.size
    if np.linalg.cond(whole) > 1e14:
        return np.full(len(wanted), np.inf)
    return np.asarray(np.einsum("cij,ji->c", wanted, inverse(whole)[:size, :size]))


def least_worst(
    information: Information, count: int, wanted: Array, kept: Bools,
    tell: Callable[[int], None] = lambda done: None,
) -> tuple[Bools, float]:  # fmt: skip
    """Such `count` candidates (n,), `kept` ones among them, that the largest variance is small, and that variance.

    A mean is weighed anew only while it is above 1. `tell` is called with the number of weighings done.
    """
    weight, chosen, least = np.full(len(wanted), 1 / len(wanted)), kept, np.inf
    for done in range(WEIGHINGS):
        tell(done)
        mean = np.einsum("c,cij->ij", weight, wanted)
        members = best(information, count, mean, kept).members
        each = variances(information, members, wanted)
        if each.max() < least * (1 - LOWERED):
            chosen, least = members, float(each.max())
        if least <= 1 or not np.isfinite(least):
            break
        weight = weight * each / (weight @ each)
    products = count * information.rows.size * information.size * (1 + len(wanted) / 6)
    if np.isfinite(least) and products < MOST_PRODUCTS:
        chosen, least = _lowered(information, chosen, wanted, kept)
    return chosen, least


def _lowered(
    information: Information, members: Bools, wanted: Array, kept: Bools
) -> tuple[Bools, float]:
    """The candidates after the exchanges, one at a time the best, that lower the largest variance."""
    least = float(variances(information, members, wanted).max())
    for _ in range(MOST_EXCHANGES):
        places = np.flatnonzero(members & ~kept)
        gains = [_in_place_of(information, members, place, wanted) for place in places.tolist()]
        which = first_best(np.array([each.max() for each in gains]))
        other = members.copy()
        other[[places[which], first_best(gains[which])]] = [False, True]
        lowest = float(variances(information, other, wanted).max())
        if not lowest < least * (1 - LOWERED):
            break
        members, least = other, lowest
    return members, least


def _in_place_of(information: Information, members: Bools, place: int, wanted: Array) -> Array:
    """The largest variance (n,), negative, with each candidate instead of a member."""
    others = members & (np.arange(len(members)) != place)
    whole = information.of(others.astype(np.float64))
    if np.linalg.cond(whole) > 1e14:  # too few without it
        whole = whole + LITTLE * information.of(np.ones(len(members)))
    after = Gains(information, whole, wanted).left()
    return np.asarray(np.where(members, -np.inf, -after.max(-1)))


def suffice(information: Information, count: int, wanted: Array, kept: Bools) -> bool:
    """Whether `count` candidates may keep all variances within 1; False where it is proven that none do.

    `kept` (n,) are among them.
    """
    size, free = information.size, ~kept
    new = count - int(np.count_nonzero(kept))
    weights = np.where(free, new / np.count_nonzero(free), 1.0)
    shares = np.full(len(wanted), 1 / len(wanted))
    for _ in range(BOUND_STEPS):
        back = inverse(information.of(weights))
        each = np.einsum("cij,ji->c", wanted, back[:size, :size])
        if each.max() <= 1:
            return True
        moved = (information.rows @ back)[..., :size]
        mean = np.einsum("c,cij->ij", shares, wanted)
        slopes = np.einsum("nmi,ij,nmj->n", moved, mean, moved, optimize=True)
        gained = np.sort(slopes[free])[::-1][:new].sum() - weights[free] @ slopes[free]
        if shares @ each - gained > 1:
            return False
        shares = shares * each / (shares @ each)
        raised = weights[free] * np.sqrt(slopes[free])
        weights[free] = _capped(raised * (new / raised.sum()), new)
    return True


def _capped(weights: Array, total: float) -> Array:
    """Weights of a sum, none above 1: what is above goes to the others."""
    for _ in range(20):
        over = weights >= 1
        rest = weights[~over].sum()
        if not np.any(weights > 1 + 1e-9) or rest <= 0:
            break
        room = (total - np.count_nonzero(over)) / rest
        weights = np.where(over, 1.0, weights * room)
    return np.minimum(weights, 1.0)


def least_count(information: Information, wanted: Array, kept: Bools, most: int) -> int:
    """A number of candidates, `kept` (n,) ones and at least one more, below which the variances cannot be within 1."""
    low, high = int(np.count_nonzero(kept)), most
    while high - low > 1:
        middle = (low + high) // 2
        if suffice(information, middle, wanted, kept):
            high = middle
        else:
            low = middle
    return high
