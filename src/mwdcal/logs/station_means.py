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
LONG = 16
"""Samples from which on the noise of a standstill is taken from itself; the most it borrows."""
SIGNIFICANT = 1e-4
"""Chance that a steady channel is said to drift, or to be less steady than usual."""
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
    """Readings of a channel at its standstills of n >= 2 samples; `resolution` is the step of its readings."""
    noise = pooled(rests, resolution)
    rows = [_summary(*rest, resolution, noise) for rest in rests]
    return ChannelMean._make(np.array([row[name] for row in rows]) for name in ChannelMean._fields)


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
    values = [value[:: -(-len(value) // BLOCKS)] for _, value in rests]
    middles = [float(np.median(value)) for value in values]
    values = [value - middle for value, middle in zip(values, middles, strict=True)]
    distances = [_distances(value) for value in values]
    lively = [d for d in distances if d.any()] or distances
    spread = 1.4826 * float(np.median(np.concatenate(lively)))
    limit = SPIKE_DISTANCE * max(spread, resolution)
    kept = [value[np.abs(value) <= limit] for value in values]
    kept = [value for value in kept if len(value)]  # none where they are at two levels far apart
    square = np.array([len(value) * value.var() for value in kept])
    freedom = np.array([len(value) - 1 for value in kept], float)
    usual = square <= max(spread, resolution) ** 2 * _chi_square_limit(freedom)
    usual |= freedom.sum() < 2 * LONG
    total = float(freedom[usual].sum())
    if not total:
        return ALONE
    variance = float(square[usual].sum() / total)
    some = usual & (freedom > 0)
    differ = float(np.var(square[some] / freedom[some]))
    by_chance = variance**2 * float(np.mean(2 / freedom[some]))
    scatter = max(differ - by_chance, differ / max(some.sum() - 1, 1)) ** 0.5
    rough = [_rough(value) for _, value in rests if len(value) >= 3 * PARTS]
    return SharedNoise(
        spread=spread,
        sd=variance**0.5,
        least=max(variance - scatter, 0.0) ** 0.5,
        freedom=total,
        rough=float(np.median([r for r in rough if r > 0])) if any(rough) else 0.0,
        reach=max(middles) - min(middles),
        course=_course(rests, middles, limit),
    )


def _course(rests: Sequence[Trace], middles: Sequence[float], limit: float) -> float:
    """Change per second that standstills share, 0 unless it is plain against how it scatters.

    Samples further than `limit` from the middle of their standstill are left out.
    """
    weights, sums = np.zeros((2, len(rests)))
    for i, ((time, value), middle) in enumerate(zip(rests, middles, strict=True)):
        value = value - middle
        fine = np.abs(value) <= limit
        clock = (time - time[0])[fine]
        clock = clock - clock.sum() / max(len(clock), 1)
        weights[i], sums[i] = clock @ clock, clock @ value[fine]
    some = weights > 0
    freedom = int(some.sum()) - 1
    if freedom < 1:
        return 0.0
    weights, slopes = weights[some], sums[some] / weights[some]
    mean = float(weights @ slopes / weights.sum())
    error = float(weights @ (slopes - mean) ** 2 / freedom / weights.sum()) ** 0.5
    return mean if abs(mean) > student(freedom, DRIFT_CHANCE) * error else 0.0


def _distances(value: Array) -> Array:
    """Distances from a median of 0, as many as are free, widened for what the median took (n,)."""
    distance = np.abs(value)
    if len(value) % 2:
        return np.sort(distance)[1:]
    return distance / (1 - 1.1 / len(value))


def _chi_square_limit(freedom: ArrayLike) -> Array:
    """Sums of squares that are exceeded with the chance `SIGNIFICANT`, and four times them.

    The factor leaves room for standstills of different noise.
    """
    from scipy.special import chdtri

    return np.asarray(UNUSUAL**2 * chdtri(np.maximum(freedom, 1), SIGNIFICANT), float)


def _blocks(value: Array, count: int = PARTS) -> Array:
    """Means of that many blocks."""
    bounds = np.linspace(0, len(value), count + 1).astype(int)
    return np.asarray(np.add.reduceat(value, bounds[:-1]) / np.diff(bounds))


def _rough(value: Array) -> float:
    """Standard deviation of a sample, from the steps between the means of blocks."""
    steps = np.abs(np.diff(_blocks(value)))
    return float(np.median(steps) / 0.6745 / 2**0.5 * (len(value) / PARTS) ** 0.5)


def _summary(time: Array, value: Array, resolution: float, noise: SharedNoise) -> dict[str, float]:
    """The entries of `ChannelMean` of one standstill: `time` and `value` (n,) of its samples, n >= 2.

    Steps of the `resolution` hide the mean where noise is far below them (`hidden`). The mean is that of
    the middle of the standstill: the course that all share is not part of its uncertainty. A stuck
    channel is known to its reach/√12.
    """
    distance = np.abs(value - np.median(value))
    spread = float(1.4826 * np.median(distance))
    kept = distance <= SPIKE_DISTANCE * max(_spike_scale(len(value), spread, noise), resolution)
    stuck = _is_stuck(value, distance, resolution, noise)
    unsteady = _is_unsteady(value[kept], resolution, noise)
    time, value = time[kept], value[kept]
    clock = time - time.mean()
    flat = value - noise.course * clock
    mean, variance, freedom = _mean_variance(flat, noise)
    square = float(clock @ clock)
    slope = float(clock @ value) / square if square > 0 else 0.0
    drift = slope * float(time[-1] - time[0])
    _, steady, left = _mean_variance(value - slope * clock, noise, 2)
    limit = student(left, SIGNIFICANT) * np.sqrt(12 * steady)
    sd = float(np.sqrt(variance)) * student(freedom, 0.05) / NORMAL
    sd = float(np.hypot(sd, hidden(_shared_spread(flat, resolution, noise), resolution)))
    if stuck:
        sd = noise.reach / 12**0.5
    used, half = len(value), len(value) // 2
    quarters = (_halves(flat[:half]) + _halves(flat[half:])) / 2 if half >= 4 else np.nan
    return {
        "mean": mean,
        "sd": sd,
        "spread": spread,
        "drift": drift,
        "drifts": abs(drift) > max(limit, resolution, 1e-12 * abs(mean)),
        "used": used,
        "spikes": len(kept) - used,
        "halves": _halves(flat) * used,
        "quarters": quarters * used,
        "unsteady": unsteady,
        "stuck": stuck,
    }


def hidden(spread: float, step: float) -> float:
    """What readings in steps hide of the mean of many: its standard deviation.

    `spread` is the standard deviation of the readings. SharedNoise of σ steps leaves of the mean, which
    lies anywhere between two steps, the variance step²/(2π²) Σ exp(-4π²k²σ²)/k² over k = 1, 2, …:
    step²/12 without noise.
    """
    if spread >= 2 * step:
        return 0.0
    variances, lost, _ = _dither()
    return float(step * np.interp((spread / step) ** 2, variances, lost) ** 0.5)


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


def _shared_spread(value: Array, step: float, noise: SharedNoise) -> float:
    """Standard deviation of a reading: that of all standstills, unless its own is plainly less.

    Where a standstill lies on a step its own is less anyway (`_dither`).
    """
    from scipy.special import chdtri

    spread, freedom = float(value.std()), max(len(value) - 1, 1)
    if not noise.freedom:
        return spread
    least = noise.least**2
    if noise.least < 2 * step:
        variances, _, lowest = _dither()
        least = step**2 * float(np.interp((noise.least / step) ** 2, variances, lowest))
    quiet = least * chdtri(freedom, 1 - SIGNIFICANT) / UNUSUAL**2
    return spread if len(value) * spread**2 < quiet else noise.least


def _spike_scale(count: int, spread: float, noise: SharedNoise) -> float:
    """The noise by which spikes are judged: its own where many samples tell it, else that of all."""
    if count < BLOCKS and noise.freedom >= LONG:
        return max(spread, noise.spread)
    return spread if count >= LONG else np.inf


def _is_stuck(value: Array, distance: Array, resolution: float, noise: SharedNoise) -> bool:
    """Whether more readings are equal than a channel of this noise and resolution can show."""
    from scipy.special import erf

    if not noise.freedom or noise.sd <= resolution:
        return False
    equal = [np.count_nonzero(v == 0) for v in (distance, value - value.min(), value.max() - value)]
    count = int(max(equal))
    share = float(erf(QUIETER * resolution / (8**0.5 * noise.sd)))
    chance = share + 4 * (share * (1 - share) / len(value)) ** 0.5
    return bool(count >= 5 and count > max(STUCK, chance) * len(value))


def _is_unsteady(value: Array, resolution: float, noise: SharedNoise) -> bool:
    """Whether a standstill spreads more than they usually do, or has a step within."""
    if noise.freedom < LONG:
        return False
    usual = max(noise.sd, resolution)
    if len(value) * value.var() > usual**2 * _chi_square_limit(len(value) - 1):
        return True
    scatter = max(noise.rough, resolution) / (len(value) / PARTS) ** 0.5
    return len(value) >= 3 * PARTS and bool(np.ptp(_blocks(value)) > WANDERS * scatter)


def _mean_variance(value: Array, noise: SharedNoise, lost: int = 1) -> tuple[float, float, float]:
    """Mean, variance of the mean, and degrees of freedom; `lost` are those of what was fitted.

    Fewer than `LONG` samples are taken as independent, and share the noise of all standstills
    unless theirs is plainly larger.
    """
    from scipy.special import chdtri

    if len(value) >= LONG:
        return long_run(value)
    mean, square = float(value.mean()), float(len(value) * value.var())
    freedom = float(max(len(value) - lost, 1))
    limit = float(chdtri(freedom, LENT))
    others = min(noise.freedom - freedom, LONG)
    if others > 0 and (others < LONG or square <= noise.sd**2 * limit):
        square, freedom = square + others * noise.sd**2, freedom + others
    return mean, square / freedom / len(value), freedom


def _halves(value: Array) -> float:
    """Variance of the mean of independent samples, by the difference of the halves' means."""
    half = len(value) // 2
    share = half * (len(value) - half) / len(value) ** 2
    return share * float(value[:half].mean() - value[half:].mean()) ** 2


def student(freedom: float, chance: float) -> float:
    """Two-sided Student quantile that is exceeded with this chance."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1 - chance / 2))


def long_run(value: Array) -> tuple[float, float, float]:
    """Mean of correlated samples (n,), the variance of that mean, and degrees of freedom.

    Definition: autocovariances of the means of at most `BLOCKS` blocks are added up in pairs
    as long as the pairs are positive, each no larger than the one before. With n' the number
    of independent means that leaves, the variance is freed of what the mean took away, n'/(n' - 1);
    ν = n' - 1.
    Errors: a line of drift counts as noise.
    """
    mean = float(value.mean())
    blocks = min(len(value), BLOCKS)
    means = _blocks(value - mean, blocks)
    means = means - means.mean()
    products = np.correlate(means, means, "full")[blocks - 1 :] / blocks
    pairs = products[: blocks // 4 * 2].reshape(-1, 2).sum(-1)
    pairs = np.minimum.accumulate(pairs) * np.logical_and.accumulate(pairs > 0)
    variance = max(2 * float(pairs.sum()) - products[0], products[0]) / blocks
    independent = max(products[0] / variance, 1.5) if variance > 0 else float(blocks)
    return mean, variance * independent / (independent - 1), max(independent - 1, 3.0)


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
