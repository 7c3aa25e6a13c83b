"""Allan variances of a regularly sampled record, and what four kinds of noise make of them.

The record `values` (..., n) has time last; tools, channels or repetitions lead. Averages are
over `averaging` samples; the time between samples is 1 here.

Five terms make up σ²(m): quantisation 3Q²/m² (of the integral of the record), white noise N²/m,
bias instability (2 ln 2/π) B², random walk K²m/3, and drift R²m²/2. The first four are Gaussian
processes whose integral x has the generalised covariance (`_covariance`)

    Q² δ(l)    -N² |l|/2    B² l² ln|l| / 2π    K² |l|³/12

at lag l: whatever constants it lacks, second differences of x do not see. All that follows is
exact for such noise but for sums over lags taken in steps of m/16: expectations, covariances
between averaging factors, and so the equivalent degrees of freedom.

Drift is a straight line, not noise. A *centred* variance is that of the differences of
successive averages about their own mean, and does not see it.

Reference: D. W. Allan, Proc. IEEE 54, 221 (1966); D. A. Howe, D. W. Allan, J. A. Barnes, Proc.
35th Frequency Control Symposium, 669 (1981) (overlapping); D. W. Allan, J. A. Barnes, ibid.,
470 (1981) (modified); C. A. Greenhall, W. J. Riley, Proc. 35th PTTI Meeting, 267 (2003) (degrees
of freedom from generalised covariances); IEEE Std 952, annex C (terms).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from mwdcal.geometry.vectors import Array, ArrayLike

Kind = Literal["overlapping", "modified", "standard"]

TERMS = ("quantisation", "white", "bias-instability", "random-walk")
"""The terms that are noise, in the order of every axis of four."""
FLOOR = 2 * np.log(2) / np.pi
"""Allan variance of a bias instability B = 1."""
SECOND = (1.0, -2.0, 1.0)
"""Weights of a second difference."""
LAG_STEPS = 16
"""Steps of a lag sum per averaging factor."""
REACH = 8
"""Lag in averaging factors beyond which covariances of second differences are left out."""
APART = 128
"""Ratio of averaging factors above which only quantisation and random walk correlate variances."""
BLOCK_SAMPLES = 1 << 14
"""Samples that are taken at once, so that they stay in fast memory."""
LONG_RECORD = 64
"""Averages in a record above which their centring no longer counts in covariances."""


class Moments(NamedTuple):
    """What unit noise of the four terms makes of the variances at m averaging factors.

    Attributes:
        samples: of the record.
        averaging: the factors (m,).
        mean: expected centred overlapping variance (m, 4).
        covariance: of the same (m, m, 4, 4): that of noise θ (squares) is θᵀ C θ.
        plain_mean: expected variance (m, 4), not centred, of the kind asked for.
        plain_variance: its variance (m, 4, 4).
        plain_drift: part of its variance per unit noise and unit drift² (m, 4).
    """

    samples: int
    averaging: Array
    mean: Array
    covariance: Array
    plain_mean: Array
    plain_variance: Array
    plain_drift: Array


def octaves(count: int) -> list[int]:
    """Averaging factors 1, 2, 4, … of which a record of `count` samples holds four averages.

    >>> octaves(100)
    [1, 2, 4, 8, 16]
    """
    return [2**k for k in range((count // 4).bit_length())]


def deviation(values: Array, averaging: Sequence[int], kind: Kind = "overlapping") -> Array:
    """Allan deviation (..., m) of a record (..., n) of readings at m averaging factors.

    Definition: root of half the mean square difference of successive averages; `standard` of
    averages side by side, `overlapping` of those at every sample, `modified` of the overlapping
    differences averaged once more.
    Singular: NaN where a reading is NaN; a record has to hold 2 averages (modified: 3 less one
    sample) of every factor, else ValueError.
    """
    return np.sqrt(variance(values, averaging, kind))


def variance(
    values: Array, averaging: Sequence[int], kind: Kind = "overlapping", centred: bool = False
) -> Array:
    """Allan variance (..., m), see `deviation`; `centred` takes off the mean difference first."""
    return variances(values, averaging, kind)[int(centred)]


def variances(
    values: Array, averaging: Sequence[int], kind: Kind = "overlapping"
) -> tuple[Array, Array]:
    """Allan variances (..., m), plain and centred: both of `variance` in one pass."""
    phase = _phase(values)
    pairs = [_variances(phase, int(m), kind) for m in averaging]
    whole = np.array(pairs).reshape(-1, 2, *phase.shape[:-1])
    plain, centred = np.moveaxis(whole, (0, 1), (-1, 0))
    return plain, centred


def _phase(values: Array) -> Array:
    """Sums (..., n + 1) of the readings less their mean, which second differences do not see.

    Without the mean, sums stay small: rounding is that of the noise, not that of the offset.
    """
    return _sums(values, np.mean(values, -1, keepdims=True))


def _sums(values: Array, mean: ArrayLike = 0.0) -> Array:
    """Sums (..., n + 1) of the first 0, 1, … n values less their `mean`."""
    sums = np.empty((*values.shape[:-1], values.shape[-1] + 1))
    sums[..., 0] = 0.0
    np.subtract(values, mean, out=sums[..., 1:])
    np.cumsum(sums[..., 1:], -1, out=sums[..., 1:])
    return sums


def _variances(phase: Array, m: int, kind: Kind) -> tuple[Array, Array]:
    """Variances (...), plain and centred, at one averaging factor."""
    count = phase.shape[-1] - 1
    if m < 1 or count < (3 * m - 1 if kind == "modified" else 2 * m):
        raise ValueError(f"`averaging` must be from 1 to half of {count} readings; got {m}")
    if kind == "modified":
        sums = _sums(_differences(phase, m))
        mean, square = _moments_of(
            lambda rows: sums[..., m:][..., rows] - sums[..., :-m][..., rows], count - 3 * m + 2
        )
        mean, square = mean / m, square / (m * m)
    elif kind == "standard":
        ends = phase[..., ::m]
        mean, square = _moments_of(lambda rows: _differences(ends, 1, rows), ends.shape[-1] - 2)
    else:
        mean, square = _moments_of(lambda rows: _differences(phase, m, rows), count - 2 * m + 1)
    scale = 2.0 * m * m
    return (square + mean**2) / scale, square / scale


def _moments_of(step: Callable[[slice], Array], count: int) -> tuple[Array, Array]:
    """Mean (...) of values, and their mean square about it; `step` gives those (..., m) at some of `count` places.

    Values are taken a block at a time, which stays in fast memory, and blocks added up about their own means.
    """
    mean, square = np.zeros(1), np.zeros(1)
    for start in range(0, count, BLOCK_SAMPLES):
        part = step(slice(start, min(start + BLOCK_SAMPLES, count)))
        size = part.shape[-1]
        middle = part.mean(-1)
        part = part - middle[..., None]
        apart = middle - mean
        mean = mean + apart * (size / (start + size))
        square = (
            square
            + np.einsum("...i,...i->...", part, part)
            + apart**2 * (start * size / (start + size))
        )
    return mean, square / count


def rounding(values: Array, averaging: Sequence[int]) -> Array:
    """Allan deviation (..., m) that the rounding of numbers alone can make of a record (..., n)."""
    sums, largest = (
        np.maximum(v.max(-1, keepdims=True), -v.min(-1, keepdims=True))
        for v in (_phase(values), values)
    )
    return np.asarray(np.finfo(float).eps * (sums / np.asarray(averaging, float) + largest))


def differences(values: Array, m: int) -> Array:
    """Differences (..., n - 2m + 1) of averages over m samples that follow each other."""
    return _differences(_phase(values), m) / m


def _differences(phase: Array, m: int, rows: slice = slice(None)) -> Array:
    """Second differences (..., n - 2m) over m samples, or some of them."""
    ends = (phase[..., 2 * m :], phase[..., m:-m], phase[..., : -2 * m])
    last, middle, first = (end[..., rows] for end in ends)
    return np.asarray(last - 2 * middle + first)


def drift(values: Array) -> Array:
    """Drift (...) per sample: difference of the means of the last and the first third.

    It has 8/9 of the information of a fitted line in white noise, and 4/5 in a random walk, and
    a variance in closed form (`drift_variance`).
    """
    third = values.shape[-1] // 3
    ends = values[..., -third:].mean(-1) - values[..., :third].mean(-1)
    return np.asarray(ends / (values.shape[-1] - third))


def drift_variance(count: int) -> Array:
    """Variance (4,) of `drift` for unit noise of each term in a record of `count` samples."""
    third = count // 3
    ends = np.array([0, third, count - third, count])
    weights = np.array([1.0, -1.0, -1.0, 1.0]) / (third * (count - third))
    lags = ends[:, None] - ends
    return np.asarray(np.einsum("i,aij,j->a", weights, _covariance(lags), weights))


def expected(averaging: Array) -> Array:
    """Allan variance (..., 4) of unit noise of each term at averaging factors (...)."""
    m = np.asarray(averaging, float)
    return np.stack([3 / m**2, 1 / m, np.full_like(m, FLOOR), m / 3], -1)


def moments(count: int, averaging: Sequence[int], kind: Kind = "overlapping") -> Moments:
    """The moments of the variances at powers of two, of a record of `count` samples.

    `kind` is that of the plain variance, overlapping or modified.
    """
    size = len(averaging)
    mean, covariance = np.zeros((size, 4)), np.zeros((size, size, 4, 4))
    for i, m in enumerate(averaging):
        for j, k in enumerate(averaging[i:], i):
            covariance[i, j], total = _pair(count, m, k)
            covariance[j, i] = covariance[i, j]
            if i == j:
                mean[i] = expected(np.array(m)) - total / 2
    plain = zip(*(_plain(count, m, kind) for m in averaging), strict=True)
    return Moments(count, np.array(averaging, float), mean, covariance, *map(np.array, plain))


def freedom(moments: Moments, squares: Array, slope: Array, covariance: ArrayLike = 0.0) -> Array:
    """Equivalent degrees of freedom (..., m) of the plain variances, 2 mean²/variance.

    `squares` (..., 4) are the terms of the noise, `slope` (...) its drift per sample. What the
    slow terms add to a drift is taken larger by its standard uncertainty, from the `covariance`
    (..., 4, 4) of the squares: just there it is known least.
    """
    steady = (moments.averaging * np.asarray(slope)[..., None]) ** 2
    mean = squares @ np.swapaxes(moments.plain_mean, -1, -2) + steady / 2
    spread = np.einsum("...a,mab,...b->...m", squares, moments.plain_variance, squares)
    added = squares @ np.swapaxes(moments.plain_drift, -1, -2)
    weight, doubt = moments.plain_drift, np.broadcast_to(covariance, (*squares.shape, 4))
    added = added + np.sqrt(np.einsum("ma,...ab,mb->...m", weight, doubt, weight))
    return np.asarray(2 * mean**2 / (spread + steady * added))


def band(value: Array, freedom: Array) -> tuple[Array, Array]:
    """Limits (...) at 95 % confidence of a deviation with degrees of freedom: χ² of its square."""
    from scipy.special import gammaincinv

    half = freedom / 2
    low, high = (half / gammaincinv(half, (1 + sign * 0.95) / 2) for sign in (1, -1))
    return value * np.sqrt(low), value * np.sqrt(high)


def _covariance(lags: Array) -> Array:
    """Generalised covariances (4, ...) of the integrated noise of each term at lags (...)."""
    lag = np.abs(np.asarray(lags, float))
    safe = np.where(lag > 0, lag, 1.0)
    return np.stack(
        [np.where(lag > 0, 0.0, 1.0), -lag / 2, lag**2 * np.log(safe) / (2 * np.pi), lag**3 / 12]
    )


def _between(m: int, k: int, lags: Array) -> Array:
    """Covariance (4, l) of differences of averages over m and over k samples, `lags` (l,) apart."""
    return _twice_differenced(lambda lag: _covariance(lags + lag), m, k) / (m * k)


def _twice_differenced(value: Callable[[int], Array], m: int, k: int) -> Array:
    """Second difference over m, and once more over k, of a function of a lag."""
    terms = product(enumerate(SECOND), repeat=2)
    return np.asarray(sum(a * b * value(p * m - q * k) for (p, a), (q, b) in terms))


def _pairs(first: int, second: int, lags: Array) -> Array:
    """How many of `first` times `second` terms are each of `lags` (l,) apart."""
    return np.asarray(np.clip(np.minimum(first, second + lags) - np.maximum(0, lags), 0, None))


def _pair(count: int, m: int, k: int) -> tuple[Array, Array]:
    """Covariance (4, 4) of two centred variances, m <= k, and for m = k what centring takes off.

    That is the mean square (4,) of the mean difference. With C the covariance matrix of the two
    sets of differences, its rows and columns centred, the covariance of the variances is half
    the mean square of C; here it is summed along its diagonals.
    """
    first, second = count - 2 * m + 1, count - 2 * k + 1
    spikes = np.unique([float(q * k - p * m) for p in range(3) for q in range(3)])
    square, total = _summed(_between(m, k, spikes), _pairs(first, second, spikes))
    square[1:, 1:], total[1:] = 0.0, 0.0
    smooth = slice(1, 4) if k <= APART * m else slice(3, 4)
    step = max(1, (m if k <= APART * m else k) // LAG_STEPS)
    low, high = -min(second - 1, REACH * k) // step, min(first - 1, REACH * k) // step
    lags = step * np.arange(low, high + 1, dtype=float)
    between = _between(m, k, lags)[smooth]
    more, mean = _summed(between, step * _pairs(first, second, lags))
    if first < LONG_RECORD * k:
        more = more - _rows(between, lags, step, first, second)
        more = more + np.outer(mean, mean) / (first * second)
    square[smooth, smooth], total[smooth] = more, mean
    return square / (2.0 * first * second), total / (1.0 * first * second)


def _summed(covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Sums (a, a) of products and (a,) of covariances (a, l), each lag with its weight (l,)."""
    weighted = covariance * weights
    return weighted @ np.swapaxes(covariance, -1, -2), weighted.sum(-1)


def _rows(covariance: Array, lags: Array, step: int, first: int, second: int) -> Array:
    """Products (a, a) of row sums of C over columns, and of column sums over rows, both summed."""
    below = step * (np.cumsum(covariance, -1) - covariance / 2) + covariance / 2

    def up_to(lag: Array) -> Array:
        return np.stack([np.interp(lag, lags, row, left=0.0) for row in below])

    row, by_row = _grid(first, step)
    column, by_column = _grid(second, step)
    rows = up_to(row) - up_to(row - second)
    columns = up_to(first - 1 - column) - up_to(-column - 1)
    return np.asarray(_summed(rows, by_row)[0] / second + _summed(columns, by_column)[0] / first)


def _grid(count: int, step: int) -> tuple[Array, Array]:
    """Places from 0 to count - 1, about `step` apart, and weights that sum over all between."""
    places = np.linspace(0, count - 1, max((count - 1) // step, 1) + 1)
    weights = np.full(len(places), (count - 1) / max(len(places) - 1, 1))
    weights[0] = weights[-1] = (weights[0] + 1) / 2
    return places, weights


def _plain(count: int, m: int, kind: Kind) -> tuple[Array, Array, Array]:
    """Mean (4,), variance (4, 4), and variance per unit drift² (4,) of a variance."""
    modified = kind == "modified"
    terms = count - (3 * m - 2 if modified else 2 * m - 1)
    step = max(1, m // LAG_STEPS)
    reach = min(terms - 1, REACH * m) // step * step
    pad = m if modified else 0
    lags = np.arange(-reach - pad, reach + pad + 1, step, dtype=float)
    covariance = _between(m, m, lags)
    weights = np.full((4, 1), step, float)
    weights[0] = 1.0
    if modified:
        covariance = _smoothed(covariance, lags, m, step)
        lags, weights[0] = lags[pad // step : len(lags) - pad // step], step
    pairs = _pairs(terms, terms, lags)
    joint = np.minimum(weights, np.swapaxes(weights, -1, -2))
    square, total = _summed(covariance, pairs)
    size = 1.0 * terms * terms
    return (
        covariance[:, reach // step] / 2,
        square * joint / (2 * size),
        total * weights[:, 0] / size,
    )


def _smoothed(covariance: Array, lags: Array, m: int, step: int) -> Array:
    """Covariances (4, l) at `lags` of differences averaged over m more samples: at fewer lags."""
    offsets = np.arange(-m, m + 1, step)
    kernel = (m - np.abs(offsets)) / m**2
    smooth = [np.convolve(row, step * kernel, "valid") for row in covariance[1:]]
    inner = lags[m // step : len(lags) - m // step]
    sharp = _twice_differenced(lambda lag: np.clip(m - np.abs(inner + lag), 0, None), m, m)
    return np.stack([sharp / m**4, *smooth])
