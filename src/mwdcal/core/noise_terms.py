"""Noise terms from centred Allan variances, by generalised least squares on their own covariance.

With V (m,) the centred overlapping variances of one record, E (m, 4) what unit noise makes of
them and C(θ) (m, m) their covariance under noise of the squares θ = (Q², N², B², K²), all from
`allan.moments`:

    θ̂ = W V,   W = (Eᵀ C⁻¹ E)⁻¹ Eᵀ C⁻¹,   C at the best θ >= 0, found by iteration.

θ̂ is linear in V, and so unbiased; it may be negative where a term is absent. θ >= 0 (`bounded`)
is what draws the curve. An interval of one term holds the values t for which θ̂ is no surprise:
its variance under t, with the other terms as bounded, is a quadratic in t, and its law that of a
gamma variable of that variance, as skew as the term's own share makes it. A term that might be
absent with a chance of more than `DETECTED` has an upper bound instead.

Where the variances at the shortest averages contradict all five terms (a filter, a vibration),
they are left out one after the other.

Reference: S. Guerrier, J. Skaloud, Y. Stebler, M.-P. Victoria-Feser, J. Am. Stat. Assoc. 108,
1021 (2013) (moments of wavelet variances as estimator); here the weights are exact and
iterated, and the intervals inverted tests.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from mwdcal.core.allan import Moments, drift_variance
from mwdcal.core.vectors import Array, Bools, Ints

FEWEST = 6
"""Averaging factors that a fit needs."""
ITERATIONS = 8
"""Of the weights; three would do."""
DETECTED = 0.005
"""Chance under which a term is no longer taken for absent."""
LEVEL = 0.95
"""Probability of the intervals."""
CONTRADICTED = 1e-3
"""Chance of a misfit below which the shortest averages are left out, or the fit is in doubt."""
HALVINGS = 60
"""Of an interval's limit: to the last digits of a number."""
ALONE = 1e-9
"""Share of its own variance that a term keeps where it is absent and so are all others."""
SMALLEST = 1e-4
"""Eigenvalue of the correlation between averaging factors below which rounding decides."""
SUBSETS = [s for size in range(1, 5) for s in combinations(range(4), size)]
"""Which terms are present."""


class Terms(NamedTuple):
    """Squares of the noise terms (..., 4) in the order of `allan.TERMS`, and the drift.

    Attributes:
        square: unbiased estimate, negative where noise has it so.
        bounded: best fit without negative ones.
        covariance: of `square` (..., 4, 4).
        lower, upper: limits of the intervals; where `determined` is false 0 and a bound.
        determined: whether a term cannot be absent.
        slope, slope_sd: drift per sample (...) and its standard uncertainty.
        misfit, freedom: χ² (...) of the bounded fit, and its degrees of freedom.
        start: index of the first averaging factor used (...).
    """

    square: Array
    bounded: Array
    covariance: Array
    lower: Array
    upper: Array
    determined: Bools
    slope: Array
    slope_sd: Array
    misfit: Array
    freedom: Ints
    start: Ints

    @property
    def chance(self) -> Array:
        """Probability (...) of a misfit as large, if the terms describe the noise."""
        from scipy.special import gammaincc

        return np.asarray(gammaincc(self.freedom / 2, self.misfit / 2))


def fit(variance: Array, slope: Array, moments: Moments) -> Terms:
    """The terms of B records with centred variances (B, m) and slopes (B,).

    Errors: fewer than `FEWEST` factors, or a record without any noise, raise ValueError.
    """
    size = variance.shape[-1]
    if size < FEWEST or not np.all(variance > 0):
        raise ValueError(f"`variance` must hold {FEWEST} or more positive values; got {variance}")
    best = _fit(variance, slope, moments, 0)
    for start in range(1, size - FEWEST + 1):
        doubtful = np.flatnonzero(best.chance < CONTRADICTED)
        if not doubtful.size:
            break
        other = _fit(variance[doubtful], slope[doubtful], moments, start)
        better = other.chance > best.chance[doubtful]
        for own, new in zip(best, other, strict=True):
            own[doubtful[better]] = new[better]
    return best


def _fit(variance: Array, slope: Array, moments: Moments, start: int) -> Terms:
    """The same on the averaging factors from `start` on."""
    variance, mean = variance[:, start:], moments.mean[start:]
    unit = moments.covariance[start:, start:]
    bounded = _rough(variance, mean, moments.averaging[start:] / moments.samples)
    for _ in range(ITERATIONS):
        whiten = _whitening(unit, bounded)
        design, data = whiten @ mean, np.einsum("bij,bj->bi", whiten, variance)
        bounded = _nonnegative(design, data)
    whiten = _whitening(unit, bounded)
    gain = _inverse(whiten @ mean) @ whiten
    square = np.einsum("bjm,bm->bj", gain, variance)
    each = np.einsum("bjm,bjn,mnac->bjac", gain, gain, unit, optimize=True)
    joint = np.einsum("mnac,ba,bc->bmn", unit, bounded, bounded, optimize=True)
    covariance = gain @ joint @ np.swapaxes(gain, -1, -2)
    rest = np.einsum("bij,bj->bi", whiten, variance - bounded @ np.swapaxes(mean, -1, -2))
    absent = _chance(square, np.zeros_like(square), _spread(each, bounded))
    determined = 1 - absent < DETECTED
    lower, upper = _interval(square, _spread(each, bounded), determined)
    weight = drift_variance(moments.samples)
    doubt = np.sqrt(np.einsum("a,bac,c->b", weight, covariance, weight))
    return Terms(
        square, bounded, covariance, lower, upper, determined,
        slope.copy(), np.sqrt(bounded @ weight + doubt),
        np.sum(rest**2, -1), len(mean) - np.sum(bounded > 0, -1), np.full(len(variance), start),
    )  # fmt: skip


def _rough(variance: Array, mean: Array, share: Array) -> Array:
    """Terms (B, 4) by the weights of white noise: the relative variance of V grows with m."""
    weight = 1 / (variance * np.sqrt(share))
    return _nonnegative(mean * weight[..., None], variance * weight)


def _whitening(unit: Array, squares: Array) -> Array:
    """Matrix (B, m, m) that makes the variances of noise (B, 4) independent, each of variance 1."""
    joint = np.einsum("mnac,ba,bc->bmn", unit, squares, squares, optimize=True)
    scale = 1 / np.sqrt(np.einsum("bmm->bm", joint))
    size, axes = np.linalg.eigh(joint * scale[:, :, None] * scale[:, None, :])
    whiten = np.swapaxes(axes, -1, -2) / np.sqrt(np.maximum(size, SMALLEST))[..., None]
    return np.asarray(whiten * scale[:, None, :])


def _inverse(design: Array) -> Array:
    """Least-squares inverse (B, 4, m) of designs (B, m, 4), whatever the units of the columns."""
    size = np.sqrt(np.sum(design**2, -2, keepdims=True))
    return np.asarray(np.linalg.pinv(design / size) / np.swapaxes(size, -1, -2))


def _nonnegative(design: Array, data: Array) -> Array:
    """Least-squares solution (B, 4) without negative entries of design (B, m, 4) · x = data (B, m).

    The best of all choices of entries that are not zero.
    """
    best = np.zeros((len(data), 4))
    cost = np.sum(data**2, -1)
    for subset in SUBSETS:
        part = design[..., subset]
        found = np.einsum("bjm,bm->bj", _inverse(part), data)
        rest = np.sum((data - np.einsum("bmj,bj->bm", part, found)) ** 2, -1)
        better = (found >= 0).all(-1) & (rest < cost)
        cost = np.where(better, rest, cost)
        whole = np.zeros_like(best)
        whole[:, subset] = found
        best = np.where(better[:, None], whole, best)
    return best


def _spread(each: Array, bounded: Array) -> Array:
    """Coefficients (3, B, 4) of the variance of a term's estimate, by powers of the term.

    `each` (B, 4, 4, 4) is that variance for unit noise; the other terms are as bounded.
    """
    others = bounded[:, None, :] * (1 - np.eye(4))
    own = np.einsum("bjjj->bj", each)
    constant = np.einsum("bja,bjac,bjc->bj", others, each, others)
    linear = 2 * np.einsum("bjjc,bjc->bj", each, others)
    return np.stack([np.maximum(constant, ALONE * own * bounded**2), linear, own])


def _chance(observed: Array, value: Array, spread: Array) -> Array:
    """Probability (B, 4) of an estimate up to `observed` if the term has `value`.

    The law is a gamma distribution moved and scaled to mean, variance and skewness; the
    skewness is that of a χ² as wide as the part of the variance that the term makes itself.
    """
    from scipy.special import gammainc

    variance = spread[0] + spread[1] * value + spread[2] * value**2
    skewness = np.maximum(2 * (spread[2] * value) ** 2 * value / variance**1.5, 1e-3)
    shape = 4 / skewness**2
    place = shape + np.sqrt(shape / variance) * (observed - value)
    return np.asarray(gammainc(shape, np.maximum(place, 0.0)))


def _interval(observed: Array, spread: Array, determined: Bools) -> tuple[Array, Array]:
    """Limits (B, 4) at `LEVEL`: both sides of determined terms, a bound of the others."""
    tail = (1 - LEVEL) / 2
    below = np.where(determined, _limit(observed, spread, np.asarray(1 - tail)), 0.0)
    seen = np.where(determined, observed, np.maximum(observed, 0.0))
    return below, _limit(seen, spread, np.where(determined, tail, 2 * tail))


def _limit(observed: Array, spread: Array, chance: Array) -> Array:
    """The value (B, 4) of a term that leaves `observed` or less this chance, by bisection."""
    low = np.zeros_like(observed)
    high = np.maximum(observed, 0) + 10 * np.sqrt(spread[0])
    high = high * (1 + 10 * np.sqrt(spread[2]) + 10 * spread[2]) + 100 * spread[1]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        above = _chance(observed, middle, spread) > chance
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray((low + high) / 2)
