"""Standstills in a continuous record: where the tool did not move, and what it read there.

Each channel is cut into short cells, each with the median of its samples (its *level*, which a
few spikes cannot move). The range of the levels within a window of five cells says how much the
channel moves; the range of its quietest windows is its noise floor. The *activity* of a cell is
that range, in noise floors, of the quietest window that covers it, in the liveliest channel.
Where it stays below a threshold the tool stands still.

The threshold is the one that matters least: counted over a geometric series of thresholds, the
number of standstills stays the same over the widest stretch, between noise that breaks
standstills up and movements that are swallowed. It is taken near the quiet end of that stretch,
where edges are sharpest.

The uncertainty of a mean is the long-run one: with correlated noise the autocovariances add up.

Reference: P. J. Huber, Robust Statistics, chapter 6 (medians, MAD); C. J. Geyer, Statistical
Science 7, 473 (1992), section 3.3 (initial monotone sequence).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mwdcal.core.vectors import Array, Bools, Ints

CELL = 0.2
"""Shortest cell, seconds."""
FEWEST = 3
"""Samples that a cell needs for its median to stand a spike."""
WINDOW = 5
"""Cells of a window."""
QUIET = 0.05
"""Quantile of the windows' ranges that is the noise floor."""
STEPS = 120
"""Thresholds tried."""
SAME = 0.02
"""Share by which the number of standstills may change and still count as the same."""
TURN = 0.05
"""Share of a triad's size by which no channel of a tool at rest moves within a window."""
NOISE = 8.0
"""The same in standard deviations of the difference of successive samples."""
CLEAR = 4.0
"""Distance from the median, in robust standard deviations, above which a sample is a spike."""
BLOCKS = 64
"""Blocks whose means tell the long-run variance."""
INTO = 0.15
"""How far into the stretch the threshold lies, in logarithm."""
SIGNIFICANT = 1e-4
"""Chance that a steady channel is said to drift."""


class Cells(NamedTuple):
    """One channel in short cells of equal numbers of samples (m,): start, end, median.

    `step` is the time between samples, `rough` the robust standard deviation of a sample as
    the difference of successive ones tells it: noise, whatever the tool does.
    """

    start: Array
    end: Array
    level: Array
    step: float
    rough: float


class Activity(NamedTuple):
    """Activity on a common grid of cells.

    Attributes:
        edge: start of each cell, and the end of the last (m + 1,), s.
        value: activity (m,), in noise floors; infinite where a channel has no samples.
        channels: which of the channels were looked at.
        cells: these channels, cut up.
        floor: noise floor of each, in its own unit.
    """

    edge: Array
    value: Array
    channels: tuple[int, ...]
    cells: tuple[Cells, ...]
    floor: Array


class Threshold(NamedTuple):
    """The threshold in noise floors, and the stretch (first, last) over which it hardly matters."""

    value: float
    stretch: tuple[float, float]


class Standstills(NamedTuple):
    """Intervals that look still (k,), their edges trimmed, and what became of each.

    `taken`: long enough, and no channel creeps on; `short`: not long enough. What is neither
    moves slowly.
    """

    start: Array
    end: Array
    taken: Bools
    short: Bools


class Summary(NamedTuple):
    """What one channel read during one standstill.

    Attributes:
        mean: of the samples that are no spikes.
        sd: standard uncertainty of the mean, correlation of the noise included.
        spread: robust standard deviation of one sample, from the median of deviations.
        drift: change over the standstill by the straight line.
        drifts: whether that is more than the noise explains.
        used: samples in the mean.
        spikes: samples left out.
    """

    mean: float
    sd: float
    spread: float
    drift: float
    drifts: bool
    used: int
    spikes: int


def cells_of(time: Array, value: Array, length: float) -> Cells:
    """A channel in cells of about `length` seconds, but of no fewer than `FEWEST` samples.

    Shapes: `time` (n,) ascending, `value` (n,) without blanks; the last, incomplete cell is
    left out.
    """
    step = time_step(time)
    size = max(FEWEST, round(length / step)) if step > 0 else FEWEST
    count = len(time) // size
    whole = value[: count * size].reshape(count, size)
    starts = np.arange(count) * size
    rough = float(np.median(np.abs(np.diff(value)))) / 0.6745 / np.sqrt(2)
    end = time[starts + size - 1] + step
    return Cells(time[starts], end, np.median(whole, axis=-1), step, rough)


def time_step(time: Array) -> float:
    """Median time between samples that differ in time; 0 where there are none."""
    steps = np.diff(time)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 0.0


def activity(channels: Sequence[tuple[Array, Array]]) -> Activity:
    """How much each moment moves, of channels (time (n,), value (n,)) with rates of their own.

    A channel too slow to have a cell within a window of the fastest is not looked at.
    Singular: fewer samples than a window needs give no cells at all.
    """
    steps = [time_step(time) for time, _ in channels]
    length = max(CELL, FEWEST * min((s for s in steps if s > 0), default=0.0))
    fast = [i for i, s in enumerate(steps) if 0 < FEWEST * s <= WINDOW * length]
    cut = {i: cells_of(*channels[i], length) for i in fast}
    cut = {i: own for i, own in cut.items() if len(own.level) >= WINDOW}
    cells = tuple(cut.values())
    if not cells:
        return Activity(np.zeros(1), np.zeros(0), (), (), np.zeros(0))
    start = min(c.start[0] for c in cells)
    count = round(float(max(c.end[-1] for c in cells) - start) / length)
    edge = start + length * np.arange(max(count, 1) + 1)
    floors, value = [], np.zeros(len(edge) - 1)
    for own in cells:
        ranges = quietest_range(own.level)
        floor = noise_floor(ranges)
        if np.quantile(ranges, QUIET) == 0:  # coarse steps: one up or down is no movement
            ranges = np.where(ranges <= floor, 0.0, ranges)
        ranges = np.where(_torn(own), np.inf, ranges)
        value = np.maximum(value, _on_grid(edge, own, ranges) / floor)
        floors.append(floor)
    return Activity(edge, value, tuple(cut), cells, np.array(floors))


def quietest_range(level: Array) -> Array:
    """Range of the levels (m,) in the quietest window of `WINDOW` cells that covers each."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    ranges = maximum_filter1d(level, WINDOW) - minimum_filter1d(level, WINDOW)
    half = WINDOW // 2
    ranges[:half] = ranges[-half:] = np.inf
    return np.asarray(minimum_filter1d(ranges, WINDOW, mode="constant", cval=np.inf))


def noise_floor(ranges: Array) -> float:
    """The low quantile of the ranges (m,), without those that are zero; 1 if all are."""
    alive = ranges[(ranges > 0) & np.isfinite(ranges)]
    return float(np.quantile(alive, QUIET)) if alive.size else 1.0


def _torn(cells: Cells) -> Bools:
    """Cells with a gap in them: they last more than twice as long as most."""
    length = cells.end - cells.start
    return np.asarray(length > 2 * np.median(length))


def _on_grid(edge: Array, cells: Cells, value: Array) -> Array:
    """Each grid cell's value of the channel: that of the channel's cell at its middle."""
    middle = (edge[1:] + edge[:-1]) / 2
    place = np.searchsorted(cells.start, middle, side="right") - 1
    inside = (place >= 0) & (middle <= cells.end[place] + cells.step)
    return np.where(inside, value[place], np.inf)


def triad_size(levels: Sequence[Array]) -> float:
    """Strength of what a triad measures, from the levels (m,) of its channels, in their unit.

    Definition: half the range that a channel covers, the largest of the triad. A triad that
    covers less than 3 % of its norm has never been turned: then it is that norm.
    """
    half = max(float(np.ptp(level)) / 2 for level in levels)
    norm = float(np.linalg.norm([np.median(level) for level in levels]))
    return half if half > 0.03 * norm else norm


def rest_limit(cells: Cells, size: float) -> float:
    """Largest range within a window that can be rest: a share of the triad's `size`, or noise."""
    return max(TURN * size, NOISE * cells.rough)


def stretches(still: Bools, least: int = 1) -> tuple[Ints, Ints]:
    """First cells, and cells after the last, of the runs of at least `least` true ones."""
    step = np.diff(still.astype(np.int8), prepend=0, append=0)
    first, last = np.flatnonzero(step == 1), np.flatnonzero(step == -1)
    long = last - first >= least
    return first[long], last[long]


def choose_threshold(value: Array, least: int, highest: float) -> Threshold:
    """The threshold of the activity (m,) on which the number of standstills depends least.

    Definition: of all stretches of thresholds over which the number of standstills of at least
    `least` cells stays within `SAME` of what it is at their start, the longest in logarithm;
    the first with the stretch's median number from `INTO` of it on. Tried is a geometric series
    from the quietest cell up to `highest`.
    Singular: without any standstill at any threshold the value is NaN.
    """
    alive = value[np.isfinite(value) & (value > 0)]
    low = float(alive.min()) if alive.size else 1.0
    tried = np.geomspace(low, highest, STEPS) if highest >= low else np.zeros(0)
    counts = np.array([len(stretches(value <= t, least)[0]) for t in tried], int)
    best, longest = slice(0), 0
    for first, count in enumerate(counts):
        other = np.abs(counts[first:] - count) > SAME * count
        length = int(np.argmax(other)) if other.any() else len(other)
        if count and length > longest:
            best, longest = slice(first, first + length), length
    if not longest:
        return Threshold(np.nan, (np.nan, np.nan))
    counts, tried = counts[best], tried[best]
    usual = (counts == np.median(counts)) & (np.arange(longest) >= INTO * (longest - 1))
    chosen = int(np.argmax(usual)) if usual.any() else longest // 2
    return Threshold(float(tried[chosen]), (float(tried[0]), float(tried[-1])))


def standstills(
    found: Activity, limits: Array, threshold: float, shortest: float, trim: float
) -> Standstills:
    """The intervals whose activity stays at or below the threshold, judged.

    `limits` (channels,) is the largest range of each channel within a window that can be rest
    (`rest_limit`); twice that over a whole interval is slow movement. `trim` seconds are cut
    off each end; `shortest` seconds must remain.
    """
    first, last = stretches(found.value <= threshold)
    start, end = found.edge[first] + trim, found.edge[last] - trim
    some = end > start
    start, end = start[some], end[some]
    creeps = np.zeros(len(start), bool)
    for own, limit in zip(found.cells, limits, strict=True):
        places = np.searchsorted(own.start, np.stack([start, end], -1))
        travels = [np.ptp(own.level[a:b]) if b > a else 0.0 for a, b in places]
        creeps |= np.array(travels, float).reshape(-1) > 2 * limit
    short = end - start < shortest
    return Standstills(start, end, ~short & ~creeps, short)


def summarise(time: Array, value: Array, resolution: float) -> Summary:
    """What a channel read: `time` and `value` (n,) of the samples of one standstill, n >= 2.

    `resolution` is the smallest step of the channel: samples with less noise than half of
    it hide the mean between two steps, which is then known to resolution/√12.
    """
    middle = np.median(value)
    distance = np.abs(value - middle)
    spread = float(1.4826 * np.median(distance))
    kept = distance <= CLEAR * max(spread, resolution)
    time, value = time[kept], value[kept]
    mean, sd, _ = long_run(value)
    clock = time - time.mean()
    square = float(clock @ clock)
    slope = float(clock @ value) / square if square > 0 else 0.0
    drift = slope * float(time[-1] - time[0])
    _, sd_steady, freedom = long_run(value - slope * clock)
    steady = _drift_limit(freedom) * np.sqrt(12) * sd_steady
    return Summary(
        mean=mean,
        sd=sd if value.std() > resolution / 3**0.5 else float(np.hypot(sd, resolution / 12**0.5)),
        spread=spread,
        drift=drift,
        drifts=abs(drift) > max(steady, resolution, 1e-12 * abs(mean)),
        used=len(value),
        spikes=len(kept) - len(value),
    )


def _drift_limit(freedom: float) -> float:
    """Two-sided Student quantile for `SIGNIFICANT`."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1 - SIGNIFICANT / 2))


def long_run(value: Array) -> tuple[float, float, float]:
    """Mean of correlated samples (n,), its standard uncertainty, and degrees of freedom.

    Definition: autocovariances of the means of at most `BLOCKS` blocks are added up in pairs
    as long as the pairs are positive, each no larger than the one before. With n' the number
    of independent means that leaves, the variance is freed of what the mean took away, n'/(n' - 1),
    and widened to that of Student's t, ν/(ν - 2), ν = n' - 1.
    Errors: ±1.96 of it covers 95 to 97 % with white noise, 92 % where the standstill is only
    15 correlation times long; a line of drift counts as noise.
    """
    mean = float(value.mean())
    blocks = min(len(value), BLOCKS)
    bounds = np.linspace(0, len(value), blocks + 1).astype(int)
    means = np.add.reduceat(value - mean, bounds[:-1]) / np.diff(bounds)
    means = means - means.mean()
    products = np.correlate(means, means, "full")[blocks - 1 :] / blocks
    pairs = products[: blocks // 4 * 2].reshape(-1, 2).sum(-1)
    if not pairs.size:
        pairs = products[:1]
    pairs = np.minimum.accumulate(pairs) * np.logical_and.accumulate(pairs > 0)
    variance = max(2 * float(pairs.sum()) - products[0], products[0]) / blocks
    independent = max(products[0] / variance, 1.5) if variance > 0 else float(blocks)
    freedom = max(independent - 1, 3.0)
    widened = variance * independent / (independent - 1) * freedom / (freedom - 2)
    return mean, float(np.sqrt(widened)), freedom
