"""Chances of large values, in NumPy alone: SciPy's functions take longer to load than a run to calibrate."""

from __future__ import annotations

from math import erfc

import numpy as np

from mwdcal.geometry.vectors import Array

LAST_DIGIT = 1e-15
"""Relative change at which an iteration has converged."""
MOST_FRACTIONS = 10_000
"""Most terms of a continued fraction: degrees of freedom up to 10⁹ need fewer."""
STIRLING = (1 / 12, -1 / 360, 1 / 1260, -1 / 1680, 1 / 1188)
"""Coefficients of Stirling's series of ln Γ(z), at z⁻¹, z⁻³, …"""
EXACT_FROM = 10
"""Argument from which Stirling's series is exact to the last digit."""


def fisher_tail(over: Array, under: Array, ratio: Array) -> Array:
    """Chance of a larger ratio of two variances with `over` and `under` degrees of freedom: Fisher's F.

    Definition: the regularised incomplete beta function I_x(n₂/2, n₁/2) at x = n₂ / (n₂ + n₁F).
    Reference: A. R. DiDonato and A. H. Morris, ACM Trans. Math. Softw. 18, 360 (1992), equation 9.

    >>> fisher_tail(np.array([1, 2]), np.array([10, 20]), np.array([4.964603, 3.492828])).round(6)
    array([0.05, 0.05])
    """
    over, under, ratio = (np.asarray(each, float) for each in (over, under, ratio))
    below = ratio < 1  # the continued fraction is for ratios above one
    a, b = (np.where(below, *pair) / 2 for pair in ((over, under), (under, over)))
    upside = np.divide(1, ratio, out=np.full(below.shape, np.inf), where=ratio > 0)
    chance = _beta(a, b, np.where(below, upside, ratio))
    return np.asarray(np.where(below, 1 - chance, chance))


def _beta(a: Array, b: Array, ratio: Array) -> Array:
    """I_x(a, b) at x = a / (a + bF), for F from one to infinity."""
    finite = np.minimum(ratio, 1e280 / np.maximum(b, 1.0))
    whole = a + b * finite
    x, beyond = a / whole, a * (b * ((finite - 1) / whole))
    value = last = a * (beyond + 1) / (a + 1)
    share = np.zeros_like(last)
    for m in range(1, MOST_FRACTIONS):  # Lentz
        part = a + 2 * m - 1
        lower = m * (b - m) * x / part
        upper = (a + m - 1) * ((a + b + m - 1) * x / part) * lower
        term = m + lower + (a + m) * (beyond + 1 + m * (2 - x)) / (part + 2)
        share, last = 1 / (term + upper * share), term + upper / last
        value = value * share * last
        if (np.abs(share * last - 1) <= LAST_DIGIT).all():
            break
    return np.asarray(np.where(np.isinf(ratio), 0.0, _density(a, b, finite, whole) / value))


def _density(a: Array, b: Array, ratio: Array, whole: Array) -> Array:
    """xᵃ(1 − x)ᵇ / B(a, b) without differences of large logarithms.

    Reference: C. Loader, Fast and accurate computation of binomial probabilities (2000).
    """
    log = np.log((a + b) / whole)
    shift = (1 - ratio) / whole
    exponent = _deviance(a, b * shift, log) + _deviance(b, -a * shift, log + np.log(ratio))
    exponent += _stirling(a) + _stirling(b) - _stirling(a + b)
    return np.asarray(np.sqrt(a * b / (2 * np.pi * (a + b))) * np.exp(-exponent))


def _deviance(size: Array, excess: Array, log: Array) -> Array:
    """N (e − ln(1 + e)), with ln(1 + e) given for where e is not small."""
    small = np.abs(excess) < 0.5
    return np.asarray(size * (excess - np.where(small, np.log1p(np.where(small, excess, 0)), log)))


def _stirling(z: Array) -> Array:
    """Remainder of Stirling's formula for ln Γ(z)."""
    steps = z[..., None] + np.arange(EXACT_FROM)
    series = sum(c / (z + EXACT_FROM) ** (2 * k + 1) for k, c in enumerate(STIRLING))
    return np.asarray(series + ((steps + 0.5) * np.log1p(1 / steps) - 1).sum(-1))


def normal_quantile(chance: Array) -> Array:
    """Standard deviations z that a normal value exceeds, on either side, with a chance above 0.

    By Newton's method for the logarithm of the chance, which is concave: it comes from above. Each row of chances
    (..., n) goes on until all of it has come.

    >>> normal_quantile(np.array([1.0, 0.05, 0.0027])).round(4)
    array([0.  , 1.96, 3.  ])
    """
    chance = np.asarray(chance, float)
    z, moving = np.sqrt(2 * np.log(1 / chance)), np.ones(chance.shape, bool)
    for _ in range(MOST_FRACTIONS):
        tail = np.vectorize(erfc, otypes=[float])(z / np.sqrt(2))
        step = np.log(tail / chance) * tail / (np.sqrt(2 / np.pi) * np.exp(-(z**2) / 2))
        z = z + np.where(moving, step, 0.0)
        moving = moving & np.any(np.abs(step) > LAST_DIGIT * np.maximum(z, 1), -1, keepdims=True)
        if not moving.any():
            break
    return np.asarray(np.maximum(z, 0))
