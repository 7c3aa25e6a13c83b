"""The fewest stations that keep several variances within their limits, and how few cannot do.

A variance is tr(W V), W (r, r) in units of its limit and V the covariance of the parameters: what is
wanted is reached where the largest is at most 1. Method: A-optimal stations for a weighted mean of all
W, the weights raised where a variance is large; then exchanges that lower the largest itself.

The bound is of the relaxed problem, in which a candidate counts by a weight from 0 to 1: the largest
variance is at least every weighted mean of them, and that is convex, hence nowhere below its tangents.

Reference: V. V. Fedorov, Theory of Optimal Experiments (1972), sections 2.9 and 3.4.
"""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array, Bools, inverse
from mwdcal.planning.optimal import LITTLE, Gains, Information, best, first_best

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
    information: Information, count: int, wanted: Array, kept: Bools
) -> tuple[Bools, float]:
    """Such `count` candidates (n,), `kept` ones among them, that the largest variance is small, and that variance.

    A mean is weighed anew only while it is above 1.
    """
    weight, chosen, least = np.full(len(wanted), 1 / len(wanted)), kept, np.inf
    for _ in range(WEIGHINGS):
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
    """The largest variance (n,), negative, with each candidate in the place of a member."""
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
