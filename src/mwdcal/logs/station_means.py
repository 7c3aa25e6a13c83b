"""Means of a channel at rest: what it read at each standstill, and how well that is known.

The standstills of one channel share its noise. The noise of a long one, with its correlation, is
estimated from its autocovariances. A short one borrows: its variance is drawn to that of all
standstills, as if the others had given it some samples more, and its spikes are judged by the
spread of all.
A drift that all of them share is not part of it. Readings in coarse steps hide the mean by what their
noise, all together again, does not dither away.
Whether the means then scatter as they claim is asked of the halves of all standstills of a triad:
noise that is correlated over a second or more shows there, and not in one standstill alone.

Reference: P. J. Huber, Robust Statistics, chapter 6 (medians, MAD); C. J. Geyer, Statistical
Science 7, 473 (1992), section 3.3 (initial monotone sequence); G. K. Smyth, Statistical
Applications in Genetics and Molecular Biology 3, 3 (2004) (moderated variances); B. Widrow and
I. Kollár, Quantization SharedNoise (2008) (dither).

Findings about the stations of a log: what was left out, and what is unusual at a station.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from math import ceil, floor, log10
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.vectors import Array, ArrayLike, Bools, Ints
from mwdcal.logs import standstill
from mwdcal.logs.standstill import Activity, Standstills, Trace

SPIKE_DISTANCE = 4.0
"""Distance from the median, in robust standard deviations, above which a sample is a spike."""
BLOCKS = 64
"""Blocks whose means give the long-run variance."""
SAMPLES_OF_RESTS = 1 << 16
"""Samples of standstills that are worked on at once: they fit into a processor's cache."""
LONG = 16
"""Samples from which on the noise of a standstill is taken from itself; the most it borrows."""
SIGNIFICANT = 1e-4
"""Chance that a steady channel is reported to drift, or to be less steady than usual."""
UNUSUAL = 2.0
"""Ratio to the usual spread that is reported."""
LENT = 0.01
"""Chance that a standstill of the usual noise is taken for noisier, and lent none."""
DRIFT_CHANCE = 0.01
"""Chance that steady standstills are said to share a drift, which is then taken out of their noise."""
PARTS, WANDERS = 16, 12.0
"""Blocks that tell a knock within a standstill, and their range, in their own noise, that does."""
STUCK, QUIETER = 0.5, 5.0
"""Least share of equal readings at a limit, and times that a tool at rest may be less noisy than usual."""
HALVES, MOST = 8, 9.0
"""Standstills of a triad whose halves can correct the uncertainty of all; most that one counts."""
CHANCE, GROWN = (5e-2, 1e-3), (1e-1, 1e-2)
"""Chances that white noise is widened, and said to be correlated: by the halves, by their growth."""
LONGEST = 1.0
"""Longest correlation time, in standstills, that their halves and quarters can tell."""
NORMAL = 1.9599639845400545
"""Standard deviations of a normal variate within which it is with a chance of 95 %."""
GROWTH = 2.0
"""Growth of the variance from quarters to halves that only a drift can have."""


class SharedNoise(NamedTuple):
    """What all standstills of a channel say together of one sample.

    Attributes:
        spread: robust standard deviation about the median of its standstill.
        sd: standard deviation, without spikes and without standstills that are less steady.
        least: the same less what the variances of standstills differ, or its standard error.
        freedom: degrees of freedom of sd; 0 where there is only one standstill.
        rough: standard deviation of a sample as the successive means of blocks tell it.
        reach: range of the channel over all standstills.
        course: change per second that all standstills share; 0 where none is plain.
    """

    spread: float
    sd: float
    least: float
    freedom: float
    rough: float
    reach: float
    course: float


ALONE = SharedNoise(np.nan, np.nan, np.nan, 0.0, np.nan, np.inf, 0.0)
"""The shared noise where a channel has one standstill only."""


class ChannelMean(NamedTuple):
    """What one channel read at its standstills (k,).

    Attributes:
        mean: of the samples that are not spikes.
        sd: standard uncertainty of the mean, correlation of the noise included.
        spread: robust standard deviation of one sample, from the median of deviations.
        drift: change over the standstill by the straight line.
        drifts: whether that is more than the noise explains.
        used: samples in the mean.
        spikes: samples left out.
        halves: variance of a sample's worth of mean as the difference of the two halves' means tells it.
        quarters: that of the halves, by the quarters; NaN for fewer than eight samples.
        unsteady: whether it spreads more than it usually does, or moves within the standstill.
        stuck: whether it stands at a limit, or is frozen: too many equal readings for its noise.
    """

    mean: Array
    sd: Array
    spread: Array
    drift: Array
    drifts: Bools
    used: Ints
    spikes: Ints
    halves: Array
    quarters: Array
    unsteady: Bools
    stuck: Bools


def summarise(rests: Sequence[Trace], resolution: float) -> ChannelMean:
    """Means of a channel at its standstills of n >= 2 samples; `resolution` is the step of its readings."""
    return summarise_alike(rests, resolution, pooled(rests, resolution))


def summarise_alike(rests: Sequence[Trace], resolution: float, noise: SharedNoise) -> ChannelMean:
    """Means of a channel of this noise at its standstills: those with equally many samples together."""
    parts = [
        (places[rows], part)
        for places, time, value in _together(rests)
        for rows, part in _summary(time, value, resolution, noise)
    ]
    order = np.argsort(np.concatenate([places for places, _ in parts]))
    columns = zip(*(part for _, part in parts), strict=True)
    return ChannelMean._make(np.concatenate(column)[order] for column in columns)


def _together(rests: Sequence[Trace]) -> Iterator[tuple[Ints, Array, Array]]:
    """Standstills of equally many samples: their places (k,), times and values (k, n)."""
    for alike in _equal(np.array([len(value) for _, value in rests])):
        each = max(SAMPLES_OF_RESTS // len(rests[alike[0]][1]), 1)
        for first in range(0, len(alike), each):
            places = alike[first : first + each]
            traces = zip(*(rests[place] for place in places), strict=True)
            time, value = (np.concatenate(one).reshape(len(places), -1) for one in traces)
            yield places, time, value


def _equal(sizes: Ints) -> list[Ints]:
    """The places of equal sizes (k,), for each size."""
    order = np.argsort(sizes, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(sizes[order])) + 1)
    return parts if sizes.size else []


def _chosen(chosen: Bools, *arrays: Array) -> Iterator[tuple[Ints, list[Array]]]:
    """Rows with equally many chosen samples, and these (j, m), of arrays (k, n)."""
    counts = np.count_nonzero(chosen, -1)
    for rows in _equal(counts):
        shape, where = (len(rows), counts[rows[0]]), chosen[rows]
        yield rows, [array[rows][where].reshape(shape) for array in arrays]


class Correlated(NamedTuple):
    """Evidence in the halves of a triad's standstills of noise that is correlated over seconds.

    Attributes:
        variance: of a sample's worth of mean, sd² times samples, of each channel; 0 for none.
        plain: whether it is reported; the uncertainty is widened before that (`CHANCE`).
    """

    variance: Array
    plain: bool


def correlated(channels: Sequence[ChannelMean]) -> Correlated:
    """Whether the means of a triad's channels scatter by more than the samples claim.

    Definition: what the halves of a channel's standstills tell, times what noise that reaches
    beyond a half hides in them (`beyond`, from the whole triad). None unless the halves tell more
    than is claimed, or grow more from quarters to halves, than by chance (χ², F); nor where they
    grow as with a line of drift.
    """
    from scipy.special import chdtri, fdtri

    clear = [ChannelMean._make(part[~m.stuck] for part in m) for m in channels]
    counts = np.array([len(m.mean) for m in clear])
    if counts.sum() < HALVES or not counts.all():
        return Correlated(np.zeros(len(channels)), False)
    halves = np.array([_typical(m.halves) for m in clear])
    pairs = np.concatenate([(m.halves, m.quarters) for m in clear], -1)
    pairs = pairs[:, ~np.isnan(pairs[1])]
    quartered = max(len(pairs[0]), 1)
    half, quarter = (_typical(one) if one.size else 0.0 for one in pairs)
    growth = half / quarter if quarter else 0.5
    claimed = np.array([np.median(m.sd**2 * m.used) for m in clear])
    # Satterthwaite: a noisy channel counts most
    freedom = claimed.sum() ** 2 / (claimed @ (claimed / counts))
    more = halves.sum() > chdtri(freedom, CHANCE) / freedom * claimed.sum()
    more |= growth > 0.5 * fdtri(quartered, 2 * quartered, 1 - np.array(GROWN))
    widens, plain = (bool(one) for one in more & (growth < GROWTH))
    return Correlated(halves * beyond(growth) if widens else 0 * halves, plain)


def _typical(squares: Array) -> float:
    """Mean of squares of normal variates (n,), the largest cut at `MOST` times what is expected."""
    return float(np.minimum(squares, MOST * np.median(squares) / 0.455).mean())


def beyond(growth: float) -> float:
    """Variance of a mean by what the halves tell of it, for AR(1) noise.

    `growth` is what the halves tell of the variance by what the quarters tell of that of a half:
    1/2 for independent samples, 1 where it no longer falls with time. From the variance of a mean
    over y = time by correlation time, 2/y (1 - (1 - exp(-y))/y).
    """
    time = np.geomspace(1e3, 1 / LONGEST, 300)

    def variance(y: Array) -> Array:
        return np.asarray(2 / y * (1 - (1 - np.exp(-y)) / y))

    halves = variance(time / 2) - variance(time)
    quarters = variance(time / 4) - variance(time / 2)
    return float(np.interp(growth, halves / quarters, variance(time) / halves))


def widened(channel: ChannelMean, variance: float) -> ChannelMean:
    """The same with at least this variance of a sample's worth of mean."""
    least = [(variance / used) ** 0.5 for used in channel.used.tolist()]
    return channel._replace(sd=np.where(channel.stuck, channel.sd, np.maximum(channel.sd, least)))


def pooled(rests: Sequence[Trace], resolution: float) -> SharedNoise:
    """The noise that the standstills of a channel share.

    Each standstill counts with 64 samples at most. Singular: one alone has none to share.
    """
    if len(rests) < 2:
        return ALONE
    parts = [
        (places, value[:, :: -(-value.shape[-1] // BLOCKS)].copy())
        for places, _, value in _together(rests)
    ]
    order = np.argsort(np.concatenate([places for places, _ in parts]))
    some = [value for _, value in parts]
    del parts
    medians = [np.median(value, -1, keepdims=True) for value in some]
    for value, median in zip(some, medians, strict=True):
        value -= median
    spread = 1.4826 * _middle_distance(some)
    limit = SPIKE_DISTANCE * max(spread, resolution)
    square, size = np.concatenate([_squares(value, limit) for value in some])[order].transpose()
    there = size > 0  # none where they are at two levels far apart
    square, freedom = square[there], size[there] - 1
    usual = square <= max(spread, resolution) ** 2 * _chi_square_limit(freedom)
    usual |= freedom.sum() < 2 * LONG
    total = float(freedom[usual].sum())
    if not total:
        return ALONE
    variance = float(square[usual].sum() / total)
    few = usual & (freedom > 0)
    differ = float(np.var(square[few] / freedom[few]))
    by_chance = variance**2 * float(np.mean(2 / freedom[few]))
    scatter = max(differ - by_chance, differ / max(few.sum() - 1, 1)) ** 0.5
    middles = np.concatenate(medians)[order, 0]
    return SharedNoise(
        spread=spread,
        sd=variance**0.5,
        least=max(variance - scatter, 0.0) ** 0.5,
        freedom=total,
        rough=_usual_roughness(rests),
        reach=float(np.ptp(middles)),
        course=_course(rests, middles, limit),
    )


def _squares(value: Array, limit: float) -> Array:
    """Sum of squares about their mean of the values up to a limit, and their number (k, 2), of each row (k, n)."""
    result = np.zeros((len(value), 2))
    for rows, (few,) in _chosen(np.abs(value) <= limit, value):
        size = few.shape[-1]
        if size:
            result[rows] = np.stack([size * few.var(-1), np.full(len(rows), size)], -1)
    return result


def _usual_roughness(rests: Sequence[Trace]) -> float:
    """Standard deviation of a sample, from the steps between the means of blocks, of the usual standstill."""
    rough = [np.zeros(0)]
    for _, _, value in _together([rest for rest in rests if len(rest[1]) >= 3 * PARTS]):
        steps = np.median(np.abs(np.diff(_blocks(value))), -1)
        rough.append(steps / 0.6745 / 2**0.5 * (value.shape[-1] / PARTS) ** 0.5)
    alive = np.concatenate(rough)
    return float(np.median(alive[alive > 0])) if alive.any() else 0.0


def _course(rests: Sequence[Trace], middles: Array, limit: float) -> float:
    """Change per second that standstills share, 0 unless it is plain against how it scatters.

    Samples further than `limit` from the middle of their standstill are left out.
    """
    weights, sums = np.zeros((2, len(rests)))
    for places, time, value in _together(rests):
        value = value - middles[places, None]
        for rows, (clock, few) in _chosen(np.abs(value) <= limit, time - time[:, :1], value):
            clock = clock - clock.sum(-1, keepdims=True) / max(clock.shape[-1], 1)
            weights[places[rows]], sums[places[rows]] = dot(clock, clock), dot(clock, few)
    some = weights > 0
    freedom = int(some.sum()) - 1
    if freedom < 1:
        return 0.0
    weights, slopes = weights[some], sums[some] / weights[some]
    mean = float(weights @ slopes / weights.sum())
    error = float(weights @ (slopes - mean) ** 2 / freedom / weights.sum()) ** 0.5
    return mean if abs(mean) > student(freedom, DRIFT_CHANCE) * error else 0.0


def _middle_distance(values: Sequence[Array]) -> float:
    """Median distance (k, n) from medians of 0, without rows that never change unless all are such."""
    lively = [each[each.any(-1)].ravel() for each in map(_distances, values)]
    if not any(each.size for each in lively):
        lively = [_distances(value).ravel() for value in values]
    whole = np.concatenate(lively)
    del lively
    return float(np.median(whole, overwrite_input=True))


def _distances(value: Array) -> Array:
    """Distances from a median of 0, as many as are free, widened for what the median took (k, n)."""
    distance = np.abs(value)
    if value.shape[-1] % 2:
        return np.asarray(np.sort(distance)[:, 1:])
    return np.asarray(distance / (1 - 1.1 / value.shape[-1]))


def _chi_square_limit(freedom: ArrayLike) -> Array:
    """Sums of squares that are exceeded with the chance `SIGNIFICANT`, and four times them.

    The factor leaves room for standstills of different noise.
    """
    from scipy.special import chdtri

    return np.asarray(UNUSUAL**2 * chdtri(np.maximum(freedom, 1), SIGNIFICANT), float)


def _blocks(value: Array, count: int = PARTS) -> Array:
    """Means of that many blocks (k, count) of values (k, n)."""
    bounds = np.linspace(0, value.shape[-1], count + 1).astype(int)
    return np.asarray(np.add.reduceat(value, bounds[:-1], -1) / np.diff(bounds))


def _summary(
    time: Array, value: Array, resolution: float, noise: SharedNoise
) -> Iterator[tuple[Ints, ChannelMean]]:
    """Standstills (k,) by the number of samples that are no spikes: which, and what was read there.

    Shapes: `time` and `value` (k, n) of their samples, n >= 2. Steps of the `resolution` hide the mean where
    noise is far below them (`hidden`). The mean is that of the middle of the standstill: the course that
    all share is not part of its uncertainty. A stuck channel is known to its reach/√12.
    """
    size = value.shape[-1]
    distance = np.abs(value - np.median(value, -1, keepdims=True))
    spread = 1.4826 * np.median(distance, -1)
    limit = SPIKE_DISTANCE * np.maximum(_spike_scale(size, spread, noise), resolution)
    stuck = _is_stuck(value, distance, resolution, noise)
    for rows, (clock, few) in _chosen(distance <= limit[:, None], time, value):
        part = _of_kept(clock, few, resolution, noise)
        sd = np.where(stuck[rows], noise.reach / 12**0.5, part.sd)
        yield (
            rows,
            part._replace(sd=sd, spread=spread[rows], spikes=size - part.used, stuck=stuck[rows]),
        )


def _of_kept(time: Array, value: Array, resolution: float, noise: SharedNoise) -> ChannelMean:
    """Means at standstills over samples (k, n) without spikes."""
    used, half = value.shape[-1], value.shape[-1] // 2
    clock = time - time.mean(-1, keepdims=True)
    flat = value - noise.course * clock
    mean, variance, freedom = _mean_variance(flat, noise)
    square = dot(clock, clock)
    slope = np.divide(dot(clock, value), square, out=np.zeros(len(value)), where=square > 0)
    drift = slope * (time[:, -1] - time[:, 0])
    _, steady, left = _mean_variance(value - slope[:, None] * clock, noise, 2)
    limit = student(left, SIGNIFICANT) * np.sqrt(12 * steady)
    sd = np.sqrt(variance) * student(freedom, 0.05) / NORMAL
    quarters = np.full(len(value), np.nan)
    if half >= 4:
        quarters = (_halves(flat[:, :half]) + _halves(flat[:, half:])) / 2
    no = np.zeros(len(value), bool)
    return ChannelMean(
        mean=mean,
        sd=np.hypot(sd, hidden(_shared_spread(flat, resolution, noise), resolution)),
        spread=flat.std(-1),
        drift=drift,
        drifts=np.abs(drift) > np.maximum(np.maximum(limit, resolution), 1e-12 * np.abs(mean)),
        used=np.full(len(value), used),
        spikes=no.astype(int),
        halves=_halves(flat) * used,
        quarters=quarters * used,
        unsteady=_is_unsteady(value, resolution, noise),
        stuck=no,
    )


def dot(a: Array, b: Array) -> Array:
    """The products of rows (..., n), added up."""
    return np.asarray((a[..., None, :] @ b[..., :, None])[..., 0, 0])


def hidden(spread: ArrayLike, step: float) -> Array:
    """What readings in steps hide of the mean of many: its standard deviation.

    `spread` is the standard deviation of the readings. Noise of σ steps leaves of the mean, which
    lies anywhere between two steps, the variance step²/(2π²) Σ exp(-4π²k²σ²)/k² over k = 1, 2, …:
    step²/12 without noise.
    """
    spread = np.asarray(spread, float)
    if not step:
        return 0 * spread
    variances, lost, _ = _dither()
    share = np.sqrt(np.interp((spread / step) ** 2, variances, lost))
    return np.where(spread >= 2 * step, 0.0, step * share)


@cache
def _dither() -> tuple[Array, Array, Array]:
    """Variance of readings, what they hide, and the least variance, in steps, for rising noise (n,).

    The variance is the mean over all places between two steps; it is least on a step.
    """
    from scipy.special import ndtr

    sigma = np.linspace(1e-6, 2.1, 401)
    order = np.arange(1, 200)[:, None]
    lost = np.sum(np.exp(-((2 * np.pi * order * sigma) ** 2)) / order**2, axis=0) / (2 * np.pi**2)
    lost[0] = 1 / 12
    away = np.arange(20)[:, None] + 0.5
    least = 4 * np.sum(away * ndtr(-away / sigma), axis=0)
    return sigma**2 + 1 / 12 - lost, lost, least


def _shared_spread(value: Array, step: float, noise: SharedNoise) -> Array:
    """Standard deviation of a reading (k,): that of all standstills, unless its own is plainly less.

    Where a standstill lies on a step its own is less anyway (`_dither`).
    """
    from scipy.special import chdtri

    spread, size = value.std(-1), value.shape[-1]
    if not noise.freedom:
        return np.asarray(spread)
    least = noise.least**2
    if noise.least < 2 * step:
        variances, _, lowest = _dither()
        least = step**2 * float(np.interp((noise.least / step) ** 2, variances, lowest))
    quiet = least * chdtri(max(size - 1, 1), 1 - SIGNIFICANT) / UNUSUAL**2
    return np.where(size * spread**2 < quiet, spread, noise.least)


def _spike_scale(count: int, spread: Array, noise: SharedNoise) -> Array:
    """The noise (k,) by which spikes are judged: its own where many samples tell it, else that of all."""
    if count < BLOCKS and noise.freedom >= LONG:
        return np.maximum(spread, noise.spread)
    return spread if count >= LONG else np.full_like(spread, np.inf)


def _is_stuck(value: Array, distance: Array, resolution: float, noise: SharedNoise) -> Bools:
    """Whether more readings (k, n) are equal than a channel of this noise and resolution can show."""
    from scipy.special import erf

    size = value.shape[-1]
    if not noise.freedom or noise.sd <= resolution:
        return np.zeros(len(value), bool)
    ends = (f(value, -1, keepdims=True) for f in (np.min, np.max))
    counts = [
        np.count_nonzero(distance == 0, -1),
        *(np.count_nonzero(value == e, -1) for e in ends),
    ]
    count = np.max(counts, axis=0)
    share = float(erf(QUIETER * resolution / (8**0.5 * noise.sd)))
    chance = share + 4 * (share * (1 - share) / size) ** 0.5
    return np.asarray((count >= 5) & (count > max(STUCK, chance) * size))


def _is_unsteady(value: Array, resolution: float, noise: SharedNoise) -> Bools:
    """Whether standstills (k, n) spread more than they usually do, or have a step within."""
    size = value.shape[-1]
    if noise.freedom < LONG:
        return np.zeros(len(value), bool)
    usual = max(noise.sd, resolution)
    unsteady = size * value.var(-1) > usual**2 * _chi_square_limit(size - 1)
    if size >= 3 * PARTS:
        scatter = max(noise.rough, resolution) / (size / PARTS) ** 0.5
        unsteady |= np.ptp(_blocks(value), -1) > WANDERS * scatter
    return np.asarray(unsteady)


def _mean_variance(value: Array, noise: SharedNoise, lost: int = 1) -> tuple[Array, Array, Array]:
    """Mean, variance of the mean, and degrees of freedom (k,); `lost` are those of what was fitted.

    Fewer than `LONG` samples are taken as independent, and share the noise of all standstills
    unless theirs is plainly larger.
    """
    from scipy.special import chdtri

    size = value.shape[-1]
    if size >= LONG:
        return long_run(value)
    mean, square = value.mean(-1), size * value.var(-1)
    freedom = np.full(len(value), float(max(size - lost, 1)))
    others = np.minimum(noise.freedom - freedom, LONG)
    alike = (others < LONG) | (square <= noise.sd**2 * chdtri(freedom, LENT))
    others = np.where((others > 0) & alike, others, 0.0)
    borrowed = np.where(others > 0, others * noise.sd**2, 0.0)
    square, freedom = square + borrowed, freedom + others
    return mean, square / freedom / size, freedom


def _halves(value: Array) -> Array:
    """Variance of the mean of independent samples (k, n), by the difference of the halves' means."""
    size, half = value.shape[-1], value.shape[-1] // 2
    share = half * (size - half) / size**2
    return np.asarray(share * (value[:, :half].mean(-1) - value[:, half:].mean(-1)) ** 2)


def student(freedom: ArrayLike, chance: float) -> Array:
    """Two-sided Student quantile that is exceeded with this chance."""
    from scipy.special import stdtrit

    return np.asarray(stdtrit(np.asarray(freedom, float), 1 - chance / 2))


def long_run(value: Array) -> tuple[Array, Array, Array]:
    """Means of correlated samples (k, n), the variances of these means, and degrees of freedom.

    Definition: autocovariances of the means of at most `BLOCKS` blocks are added up in pairs
    as long as the pairs are positive, each no larger than the one before. With n' the number
    of independent means that leaves, the variance is freed of what the mean took away, n'/(n' - 1);
    ν = n' - 1.
    Errors: a line of drift counts as noise.
    """
    mean = value.mean(-1)
    blocks = min(value.shape[-1], BLOCKS)
    means = _blocks(value - mean[:, None], blocks)
    means = means - means.mean(-1, keepdims=True)
    lags = range(blocks // 4 * 2)
    products = np.stack([dot(means[:, k:], means[:, : blocks - k]) for k in lags], -1) / blocks
    pairs = products.reshape(len(value), -1, 2).sum(-1)
    positive = np.logical_and.accumulate(pairs > 0, -1)
    pairs, single = np.minimum.accumulate(pairs, -1) * positive, products[:, 0]
    variance = np.maximum(2 * pairs.sum(-1) - single, single) / blocks
    independent = np.full(len(value), float(blocks))
    np.divide(single, variance, out=independent, where=variance > 0)
    independent = np.maximum(independent, 1.5)
    return mean, variance * independent / (independent - 1), np.maximum(independent - 1, 3.0)


ALL_STILL = "all-still"
"""The finding on a log that is one station."""
MANY_SPIKES = 0.01
"""Share of spikes that is reported."""
MOST_LISTED = 12
"""Stations, or stretches of time, that a finding names."""
STEADY = 3.0
"""Standard deviations of a cell's level by which a noisy but steady stretch may drift."""

Rows = dict[str, ChannelMean]
"""Readings of each channel at the stations."""


def count(number: int, word: str) -> str:
    """'1 station', '2 stations'."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def listed(parts: Iterable[object]) -> str:
    """The first few, with commas."""
    names = [str(part) for part in parts]
    return ", ".join(names[:MOST_LISTED]) + (" …" if len(names) > MOST_LISTED else "")


def _between(start: Array, end: Array) -> str:
    return listed(f"{a:.1f}–{b:.1f} s" for a, b in zip(start, end, strict=True))


def about(rows: Rows, standstills: Standstills, seconds: float) -> Iterator[Finding]:
    """Findings about the stations, and about what was left; `seconds` lasts the log once trimmed."""
    start, end = standstills.stations
    creeping = ~standstills.taken & ~standstills.short
    if creeping.any():
        where = _between(standstills.start[creeping], standstills.end[creeping])
        text = f"left out, as the tool moves slowly there: {where}."
        yield Finding(id="slow-movement", text=text)
    if len(start) == 1 and end[0] - start[0] > 0.9 * seconds:
        text = "the log stands still from end to end: one station. A calibration needs several attitudes."
        yield Finding(id=ALL_STILL, text=text)
    yield from _spikes(rows)
    for name, row in rows.items():
        yield from _unreliable(name, row)
        yield from _drifting(name, row, end - start)


def _spikes(rows: Rows) -> Iterator[Finding]:
    """The channel with the largest share of spikes, where that is large."""
    share = {n: row.spikes.sum() / (row.spikes + row.used).sum() for n, row in rows.items()}
    name = max(share, key=share.__getitem__)
    if share[name] > MANY_SPIKES:
        lost = f"{100 * share[name]:.1f} % of the samples of {name}"
        yield Finding(id="spikes", text=f"{lost} were left out as spikes: check the wiring.")


def _unreliable(name: str, row: ChannelMean) -> Iterator[Finding]:
    """A channel at its limit or frozen, and one that is less steady than usual or steps."""
    if row.stuck.any():
        first = int(np.argmax(row.stuck))
        text = (
            f"{name} stands at its limit, or is frozen, at {_places(row.stuck)}: too many equal readings for its "
            f"noise, such as {row.mean[first] + 0.0:.6g}. Its sd_ there is that of a reading known to the "
            "channel's range only."
        )
        yield Finding(id="stuck-channel", text=text, station=str(first + 1))
    unsteady = row.unsteady & ~row.stuck
    if unsteady.any():
        text = (
            f"{name} is less steady than usual at {_places(unsteady)}: it spreads more than at the others, or "
            f"moves within the standstill (usual spread of one sample {np.median(row.spread):.2g}). Was the "
            "tool knocked, turned or shaken?"
        )
        yield Finding(id="unsteady", text=text, station=str(int(np.argmax(unsteady)) + 1))


def _places(where: Bools) -> str:
    """How many of the stations, and which."""
    numbers = np.flatnonzero(where) + 1
    return f"{count(len(numbers), 'station')} of {len(where)} ({listed(numbers)})"


def _drifting(name: str, row: ChannelMean, seconds: Array) -> Iterator[Finding]:
    """A channel that drifts at some stations."""
    if row.drifts.any():
        worst = int(np.argmax(row.drifts * np.abs(row.drift)))
        text = (
            f"{name} drifts at {row.drifts.sum()} of {len(seconds)} stations, most at station {worst + 1}: by "
            f"{row.drift[worst]:.3g} over {seconds[worst]:.1f} s (noise of one sample {row.spread[worst]:.2g}). "
            "See the columns drift_."
        )
        yield Finding(id="drift", text=text, station=str(worst + 1))


def noisy_rests(
    activity: Activity, limits: Array, standstills: Standstills, threshold: float, least: float
) -> Iterator[Finding]:
    """Stretches of at least `least` seconds that are steady on average, but above the threshold.

    Definition: no channel moves by more than can be rest within a window, and by the straight line
    none changes by more than `STEADY` times what its cells scatter about that line.
    """
    can_rest = activity.value > threshold
    for channel, limit in zip(activity.cells.values(), limits, strict=True):
        ranges = np.where(channel.torn, np.inf, standstill.quietest_range(channel.level))
        can_rest &= standstill.on_grid(activity.edge, channel, ranges) <= limit
    shortest = max(ceil(least / activity.cell), standstill.WINDOW)
    first, last = standstill.stretches(can_rest, shortest)
    start, end = activity.edge[first], activity.edge[last]
    kept = [
        i
        for i, (a, b) in enumerate(zip(start, end, strict=True))
        if not np.any((standstills.start < b) & (standstills.end > a))
        and all(
            _is_steady(channel.start, channel.level, a, b) for channel in activity.cells.values()
        )
    ]
    if kept:
        enough = max(float(activity.value[first[i] : last[i]].max()) for i in kept)
        digit = 10.0 ** (floor(log10(enough)) - 1)
        text = (
            f"{len(kept)} stretch{'es' if len(kept) > 1 else ''} steady on average, but too noisy for rest, "
            f"left out: {_between(start[kept], end[kept])}. Vibration? "
            f"`threshold` {ceil(enough / digit) * digit:g} takes them."
        )
        yield Finding(id="noisy-rest", text=text)


def _is_steady(time: Array, level: Array, start: float, end: float) -> bool:
    """Whether the levels between these times scatter about a constant."""
    first, last = np.searchsorted(time, [start, end])
    levels, clock = level[first:last], time[first:last] - start
    if len(levels) < standstill.WINDOW:
        return True
    slope, constant = np.polyfit(clock, levels, 1)
    scatter = np.std(levels - slope * clock - constant)
    return bool(abs(slope) * (clock[-1] - clock[0]) <= STEADY * scatter)
