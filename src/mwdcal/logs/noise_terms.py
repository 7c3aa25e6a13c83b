"""Noise terms from centred Allan variances, by generalised least squares on their own covariance.

With V (m,) the centred overlapping variances of one record, E (m, 4) what unit noise makes of
them and C(θ) (m, m) their covariance under noise of the squares θ = (Q², N², B², K²), all from
`allan.moments`:

    θ̂ = W V,   W = (Eᵀ C⁻¹ E)⁻¹ Eᵀ C⁻¹,   C at the best θ >= 0, found by iteration.

θ̂ is linear in V, and so unbiased; it may be negative where a term is absent. θ >= 0 (`bounded`)
gives the curve. The interval of a term holds the values t under which θ̂ is not improbable:
its variance under t, with the other terms as bounded, is a quadratic in t, and its law that of a
gamma variable of that variance, as skew as the term's own share makes it. A term that might be
absent with a chance of more than `DETECTED` has an upper bound instead; so has one without which
the others, fitted anew, do as well.

Where the variances at the shortest averages contradict all five terms (a filter, a vibration),
they are left out one after the other. Quantisation, which shows nowhere else, is then not used
to explain the rest.

Reference: S. Guerrier, J. Skaloud, Y. Stebler, M.-P. Victoria-Feser, J. Am. Stat. Assoc. 108,
1021 (2013) (moments of wavelet variances as estimator); here the weights are exact and
iterated, and the intervals inverted tests.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from mwdcal.geometry.vectors import Array, Bools, Ints, outer
from mwdcal.logs.allan import Moments, deviation, drift_variance, expected, freedom

FEWEST_FACTORS = 6
"""Averaging factors that a fit needs."""
ITERATIONS = 8
"""Of the weights; three would do."""
DETECTED = 0.005
"""Chance below which a term counts as present."""
CONFIDENCE = 0.95
"""Probability of the intervals."""
CONTRADICTED = 1e-3
"""Chance of a misfit below which the shortest averages are left out, or the fit is in doubt."""
BETTER = 1.5
"""Ratio of degrees of freedom from which on a measured deviation comes before the terms.

Near 1, where both come from the same readings, to take the larger is to take the luckier.
"""
HALVINGS = 60
"""Of an interval's limit: to the last digits of a number."""
KEPT_VARIANCE = 1e-9
"""Share of its variance that a term keeps where all terms are absent."""
ROUNDED_EIGENVALUE = 1e-4
"""Eigenvalue of the correlation between averaging factors below which rounding decides."""


class NoiseTerms(NamedTuple):
    """Squares of the noise terms (..., 4) in the order of `allan.TERMS`, and the drift.

    Attributes:
        square: unbiased estimate, negative where noise has it so.
        bounded: best fit without negative ones.
        covariance: of `square` (..., 4, 4).
        lower, upper: limits of the intervals; where `determined` is false 0 and a bound.
        determined: whether a term cannot be absent.
        slope, slope_sd: drift per sample (...) and its standard uncertainty.
        steady: size (...) of the drift less what noise adds to its square, unbiased but for >= 0.
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
    steady: Array
    misfit: Array
    freedom: Ints
    start: Ints

    @property
    def chance(self) -> Array:
        """Probability (...) of a misfit as large, if the terms describe the noise."""
        from scipy.special import gammaincc

        return np.asarray(gammaincc(self.freedom / 2, self.misfit / 2))


def fit(variance: Array, slope: Array, moments: Moments) -> NoiseTerms:
    """The terms of B records with centred variances (B, m) and slopes (B,).

    Errors: fewer than `FEWEST_FACTORS` factors, or a record without any noise, raise ValueError.
    """
    size = variance.shape[-1]
    if size < FEWEST_FACTORS or not np.all(variance > 0):
        raise ValueError(
            f"`variance` must hold {FEWEST_FACTORS} or more positive values; got {variance}"
        )
    best = _fit(variance, slope, moments, 0)
    for start in range(1, size - FEWEST_FACTORS + 1):
        doubtful = np.flatnonzero(best.chance < CONTRADICTED)
        if not doubtful.size:
            break
        other = _fit(variance[doubtful], slope[doubtful], moments, start)
        better = other.chance >= CONTRADICTED
        for kept, refitted in zip(best, other, strict=True):
            kept[doubtful[better]] = refitted[better]
    return best


def single(
    values: Array, length: float, moments: Moments, terms: NoiseTerms
) -> tuple[Array, Array, Bools]:
    """Deviation (B,) of one mean over `length` samples of records (B, n), drift included.

    With its degrees of freedom (B,), and whether (B,) it was measured: the Allan deviation at
    `length`, where the terms do not describe the record or are known by far less.
    """
    weight = expected(np.asarray(length))
    variance = terms.bounded @ weight + (terms.steady * length) ** 2 / 2
    spread = np.einsum("a,bac,c->b", weight, terms.covariance, weight)
    doubt = terms.slope_sd**2
    spread = spread + length**4 * doubt * (terms.steady**2 + doubt / 2)
    known = 2 * variance**2 / spread
    whole = max(round(length), 1)
    measurable = freedom(moments, terms.bounded, terms.steady, terms.covariance)
    places = np.log(moments.averaging)
    measurable = measurable @ [np.interp(np.log(whole), places, one) for one in np.eye(len(places))]
    described = (terms.chance >= CONTRADICTED) & (length >= moments.averaging[terms.start])
    measured = ~described | (measurable > BETTER * known)
    size = np.where(measured, deviation(values, [whole])[:, 0], np.sqrt(variance))
    return size, np.where(measured, measurable, known), measured


def _fit(variance: Array, slope: Array, moments: Moments, start: int) -> NoiseTerms:
    """The same on the averaging factors from `start` on; if not all, without quantisation."""
    used = _Used(
        variance[:, start:], moments.mean[start:], moments.covariance[start:, start:],
        moments.averaging[start:] / moments.samples,
    )  # fmt: skip
    present = (0, 1, 2, 3) if start == 0 else (1, 2, 3)
    bounded = _bounded(used, present)
    square, each, covariance = _estimate(used, bounded)
    misfit, free = _misfit(used, bounded)
    spread = _spread(each, bounded)
    determined = _absence(used, square, spread, misfit, present) < DETECTED
    lower, upper = _interval(square, spread, determined)
    weight = drift_variance(moments.samples)
    doubt = np.sqrt(np.einsum("a,bac,c->b", weight, covariance, weight))
    return NoiseTerms(
        square, bounded, covariance, lower, upper, determined,
        slope.copy(), np.sqrt(bounded @ weight + doubt),
        np.sqrt(np.maximum(slope**2 - bounded @ weight, 0.0)),
        misfit, free, np.full(len(variance), start),
    )  # fmt: skip


def _absence(
    used: _Used, square: Array, spread: Array, misfit: Array, present: tuple[int, ...]
) -> Array:
    """Chance (B, 4) of as much of a term, if it is absent: the larger of two.

    That of its estimate, the other terms as bounded; and that of the misfit which is added where
    the others have to do without it, as only those that were fitted anew can take its place.
    """
    from scipy.special import gammaincc

    chance = 1 - _chance(square, np.zeros_like(square), spread)
    for term in range(4):
        others = tuple(other for other in present if other != term)
        added = np.maximum(_misfit(used, _bounded(used, others))[0] - misfit, 0.0)
        chance[:, term] = np.maximum(chance[:, term], gammaincc(0.5, added / 2) / 2)
    return np.asarray(chance)


class _Used(NamedTuple):
    """What is fitted.

    Variances (B, m), their mean (m, 4) and covariance (m, m, 4, 4) under unit noise, and
    averaging factors (m,) as shares of the record.
    """

    variance: Array
    mean: Array
    unit: Array
    share: Array


def _bounded(used: _Used, present: tuple[int, ...]) -> Array:
    """Best fit (B, 4) without negative terms, of those `present`, under its own weights."""
    weight = 1 / (used.variance * np.sqrt(used.share))
    squares = _nonnegative(used.mean * weight[..., None], used.variance * weight, present)
    for _ in range(ITERATIONS):
        whiten = _whitening(used.unit, squares)
        data = np.einsum("bij,bj->bi", whiten, used.variance)
        better = _nonnegative(whiten @ used.mean, data, present)
        squares = np.where(better.any(-1, keepdims=True), better, squares)
    return squares


def _estimate(used: _Used, bounded: Array) -> tuple[Array, Array, Array]:
    """Unbiased squares (B, 4) under the weights of noise `bounded`.

    With their variances (B, 4, 4, 4) per unit noise, and their covariance (B, 4, 4).
    """
    whiten = _whitening(used.unit, bounded)
    gain = _inverse(whiten @ used.mean) @ whiten
    each = np.einsum("bjm,bjn,mnac->bjac", gain, gain, used.unit, optimize=True)
    square = np.einsum("bjm,bm->bj", gain, used.variance)
    return square, each, gain @ _joint(used.unit, bounded) @ np.swapaxes(gain, -1, -2)


def _misfit(used: _Used, bounded: Array) -> tuple[Array, Ints]:
    """χ² (B,) of the variances about noise `bounded`, and its degrees of freedom.

    A variance of few degrees of freedom is skew; its cube root is normal (Wilson, Hilferty).
    """
    fitted = bounded @ np.swapaxes(used.mean, -1, -2)
    spread = np.sqrt(np.einsum("bmm->bm", _joint(used.unit, bounded)))
    skew = (spread / fitted) ** 2 / 9
    normal = (np.cbrt(used.variance / fitted) - 1 + skew) / np.sqrt(skew)
    rest = np.einsum("bij,bj->bi", _whitening(used.unit, bounded), normal * spread)
    return np.sum(rest**2, -1), len(used.mean) - np.sum(bounded > 0, -1)


def _joint(unit: Array, squares: Array) -> Array:
    """Covariance (B, m, m) of the variances under noise of these squares (B, 4)."""
    products = outer(squares).reshape(len(squares), -1)
    return (products @ unit.reshape(-1, products.shape[-1]).T).reshape(-1, *unit.shape[:2])


def _whitening(unit: Array, squares: Array) -> Array:
    """Matrix (B, m, m) that makes the variances of noise (B, 4) independent, each of variance 1."""
    joint = _joint(unit, squares)
    scale = 1 / np.sqrt(np.einsum("bmm->bm", joint))
    size, axes = np.linalg.eigh(joint * scale[:, :, None] * scale[:, None, :])
    whiten = np.swapaxes(axes, -1, -2) / np.sqrt(np.maximum(size, ROUNDED_EIGENVALUE))[..., None]
    return np.asarray(whiten * scale[:, None, :])


def _inverse(design: Array) -> Array:
    """Least-squares inverse (B, 4, m) of designs (B, m, 4), independent of the units of the columns."""
    size = np.sqrt(np.sum(design**2, -2, keepdims=True))
    return np.asarray(np.linalg.pinv(design / size) / np.swapaxes(size, -1, -2))


def _nonnegative(design: Array, data: Array, present: tuple[int, ...]) -> Array:
    """Least-squares solution (B, 4) without negative entries of design (B, m, 4) · x = data (B, m).

    The best of all choices of entries, among those `present`, that are not zero. The triangle of the
    design, as turned as the data, has the same solutions.
    """
    turn, triangle = np.linalg.qr(design)
    data = np.einsum("bmj,bm->bj", turn, data)
    best = np.zeros((len(data), 4))
    cost = np.sum(data**2, -1)
    for size in range(1, len(present) + 1):
        subsets = np.array(list(combinations(present, size)))
        parts = np.moveaxis(triangle[..., subsets], -2, -3)
        solutions = np.einsum("bsjm,bm->bsj", _inverse(parts), data)
        fitted = np.einsum("bsmj,bsj->bsm", parts, solutions)
        rest = np.sum((data[:, None] - fitted) ** 2, -1)
        rest = np.where((solutions >= 0).all(-1), rest, np.inf)
        least = np.argmin(rest, -1)
        better = np.flatnonzero(rest.min(-1) < cost)
        chosen = least[better]
        cost[better] = rest[better, chosen]
        best[better] = 0.0
        best[better[:, None], subsets[chosen]] = solutions[better, chosen]
    return best


def _spread(each: Array, bounded: Array) -> Array:
    """Coefficients (3, B, 4) of the variance of a term's estimate, by powers of the term.

    `each` (B, 4, 4, 4) is that variance for unit noise; the other terms are as bounded.
    """
    others = bounded[:, None, :] * (1 - np.eye(4))
    quadratic = np.einsum("bjjj->bj", each)
    constant = np.einsum("bja,bjac,bjc->bj", others, each, others)
    linear = 2 * np.einsum("bjjc,bjc->bj", each, others)
    return np.stack(
        [np.maximum(constant, KEPT_VARIANCE * quadratic * bounded**2), linear, quadratic]
    )


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
    """Limits (B, 4) at `CONFIDENCE`: both sides of determined terms, a bound of the others."""
    tail = (1 - CONFIDENCE) / 2
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
