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

Noise terms from centred Allan variances, by generalised least squares on their own covariance.

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

from collections.abc import Callable, Sequence
from itertools import combinations, product
from typing import Literal, NamedTuple

import numpy as np

from mwdcal.geometry.vectors import Array, ArrayLike, Bools, Ints, outer

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
BLOCK_SAMPLES = 1 << 13
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
    values: Array,
    averaging: Sequence[int],
    kind: Kind = "overlapping",
    phase: Array | None = None,
) -> tuple[Array, Array]:
    """Allan variances (..., m), plain and centred: both of `variance` in one pass.

    Here and below `phase` is the `phase_of` the values, where it is known already.
    """
    phase = phase_of(values) if phase is None else phase
    pairs = [_variances(phase, int(m), kind) for m in averaging]
    whole = np.array(pairs).reshape(-1, 2, *phase.shape[:-1])
    plain, centred = np.moveaxis(whole, (0, 1), (-1, 0))
    return plain, centred


def phase_of(values: Array) -> Array:
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
        part -= middle[..., None]
        apart = middle - mean
        mean = mean + apart * (size / (start + size))
        square = (
            square
            + np.einsum("...i,...i->...", part, part)
            + apart**2 * (start * size / (start + size))
        )
    return mean, square / count


def rounding(values: Array, averaging: Sequence[int], phase: Array | None = None) -> Array:
    """Allan deviation (..., m) that the rounding of numbers alone can make of a record (..., n)."""
    phase = phase_of(values) if phase is None else phase
    sums, largest = (
        np.maximum(v.max(-1, keepdims=True), -v.min(-1, keepdims=True)) for v in (phase, values)
    )
    return np.asarray(np.finfo(float).eps * (sums / np.asarray(averaging, float) + largest))


def largest_difference(phase: Array, m: int) -> tuple[float, int]:
    """Largest difference of averages over m samples that follow each other, by its size, and its place."""
    count, largest = phase.shape[-1] - 2 * m, (-1.0, 0)
    for start in range(0, count, BLOCK_SAMPLES):
        size = np.abs(_differences(phase, m, slice(start, min(start + BLOCK_SAMPLES, count))))
        place = int(np.argmax(size))
        if size[place] > largest[0]:
            largest = float(size[place]), start + place
    return largest[0] / m, largest[1]


def usual_difference(phase: Array, m: int, above: float) -> float:
    """Median size of these differences; infinite where it is more than `above`, as half of them are."""
    count, below = phase.shape[-1] - 2 * m, 0
    for start in range(0, count, BLOCK_SAMPLES):
        part = _differences(phase, m, slice(start, min(start + BLOCK_SAMPLES, count)))
        below += int(np.count_nonzero(np.abs(part) <= above * m))
    if below < count // 2:
        return np.inf
    size = np.abs(_differences(phase, m))
    return float(np.median(size, overwrite_input=True)) / m


def _differences(phase: Array, m: int, rows: slice = slice(None)) -> Array:
    """Second differences (..., n - 2m) over m samples, or some of them."""
    ends = (phase[..., 2 * m :], phase[..., m:-m], phase[..., : -2 * m])
    last, middle, first = (end[..., rows] for end in ends)
    result = 2 * middle
    np.subtract(last, result, out=result)
    result += first
    return np.asarray(result)


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

    `squares` (..., 4) are the terms of the noise, `slope` (...) its drift per sample. The part
    of the slow terms in a drift counts larger by its standard uncertainty, from the `covariance`
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
    values: Array,
    length: float,
    moments: Moments,
    terms: NoiseTerms,
    seen: Array | None = None,
) -> tuple[Array, Array, Bools]:
    """Deviation (B,) of one mean over `length` samples of records (B, n), drift included.

    `seen`: Allan deviation (B,) of the records at `length`, where it is known already.
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
    seen = deviation(values, [whole])[:, 0] if seen is None else seen
    size = np.where(measured, seen, np.sqrt(variance))
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
    """The quantities to fit.

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
