"""Station weights that bound what one bad station can do, and what they cost with good ones.

A station's misfit d² is χ² of k degrees of freedom when its readings and references are what
their uncertainties say. Its covariance is then divided by w(d):

huber       w = min(1, c/d), c² the 95 % point of χ²_k      an outlier keeps a bounded pull
student-t   w = (ν + k) / (ν + d²), ν = 4                   an outlier loses its pull

Both leave the estimate unbiased with good stations; `consistency` and `inflation` restore the
scale of the noise and of the covariance.

Reference: P. J. Huber, Robust Statistics, chapters 6 and 8; K. L. Lange, R. J. A. Little and
J. M. G. Taylor, J. Am. Stat. Assoc. 84, 881 (1989).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from mwdcal.geometry.vectors import Array

LOSSES = ("huber", "student-t")
TAIL = 4.0
"""ν of Student's t: heavy enough tails for a stand angle misread by ten degrees."""
INLIERS = 0.95
"""Share of good stations that Huber's weight leaves alone."""
LEAST_WEIGHT = 1e-6
"""Smallest weight: a station this far off is as good as left out."""


def _corner(freedom: Array) -> Array:
    from scipy.special import chdtri

    return np.asarray(np.sqrt(chdtri(freedom, 1 - INLIERS)))


def weight(loss: str, square: Array, freedom: Array) -> Array:
    """Weight (...) of stations from their misfit d² and its degrees of freedom k, both (...).

    One where k is zero: nothing tests that station.
    """
    k = np.maximum(freedom, 1.0)
    if loss == "huber":
        corner = _corner(k)
        weights = corner / np.maximum(np.sqrt(square), corner)
    else:
        weights = (TAIL + k) / (TAIL + square)
    return np.where(freedom > 0, np.maximum(weights, LEAST_WEIGHT), 1.0)


def _slope(loss: str, square: Array, k: float) -> Array:
    """Derivative of the weight by ln d, at misfits d²."""
    if loss == "huber":
        distance = np.sqrt(square)
        corner = _corner(np.asarray(k))
        return np.where(distance > corner, -corner / np.maximum(distance, corner), 0.0)
    return -2 * square * (TAIL + k) / (TAIL + square) ** 2


@cache
def _moments(loss: str, k: float) -> tuple[float, float, float, float]:
    """E[w], E[w d²]/k, E[w² d²]/k and E[w + d w'/k], d² being χ²_k: by quantiles of d²."""
    from scipy.special import chdtri

    share = (np.arange(20_000) + 0.5) / 20_000
    square = np.asarray(chdtri(k, share), float)
    w = weight(loss, square, np.full_like(square, k))
    bend = _slope(loss, square, k)
    means = (w, w * square / k, w**2 * square / k, w + bend / k)
    first, second, third, fourth = (float(np.mean(value)) for value in means)
    return first, second, third, fourth


def consistency(loss: str, freedom: float) -> float:
    """What the misfit w² d² per degree of freedom comes to with good stations: below 1.

    The square of the bounded pull w d: one bad station cannot make it large (Huber's proposal 2).
    """
    return _moments(loss, freedom)[2]


def weighted(loss: str, freedom: float) -> float:
    """What the misfit w d² per degree of freedom comes to with good stations: below 1."""
    return _moments(loss, freedom)[1]


def inflation(loss: str, freedom: float) -> float:
    """Variance of an estimate over what its weighted information says, with good stations.

    For an M-estimator the variance is E[w² d²]/k / E[w + d w'/k]² of the unweighted one, and
    the weighted information is E[w] of the unweighted (Huber, 6.3).
    """
    mean, _, spread, bend = _moments(loss, freedom)
    return mean * spread / bend**2
