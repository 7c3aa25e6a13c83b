"""Standstills in a continuous record: where the tool did not move, and what it read there.

Each channel is cut into short cells, each with the median of its samples (its *level*, which a
few spikes cannot move). The range of the levels within a window of five cells says how much the
channel moves; the range of its quietest windows is its noise floor. The *activity* of a cell is
that range, in noise floors, of the quietest window that covers it, in the liveliest channel.
Where it stays below a threshold the tool stands still.

The threshold is the one that matters least: over a geometric series of thresholds, the
standstills stay the same ones over the widest stretch, between noise that breaks them up and
movements that are swallowed. It is taken near the quiet end of that stretch, where edges are
sharpest.

A channel too slow for that, such as a magnetometer read once a second, cuts what the others call
a standstill where its own readings step from one level to another.

Reference: P. J. Huber, Robust Statistics, chapter 6 (medians, MAD).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np

from mwdcal.files.logs import StoredNumbers
from mwdcal.geometry.vectors import Array, Bools, Ints

CELL = 0.2
"""Shortest cell, seconds."""
FEWEST = 3
"""Samples that a cell needs for its median to stand a spike."""
WINDOW = 5
"""Cells of a window."""
QUIET = 0.05
"""Quantile of the windows' ranges that is the noise floor."""
CELLS_AT_ONCE = 1 << 14
"""Cells whose medians are taken at once."""
THRESHOLDS_TRIED = 120
"""Thresholds tried."""
CLOCK_SAMPLES = 32
"""Samples whose median step in time is the rate there."""
SAME = 0.02
"""Share of the standstills that may come, go or merge while they still count as the same."""
AGREE, EQUAL_SHARE = 0.03, 0.1
"""Steps of a channel that differ by less are equal; share of equal ones that is its resolution."""
TURN = 0.05
"""Share of a triad's size by which no channel of a tool at rest moves within a window."""
MOTION_RATIO = 8.0
"""The same in standard deviations of the difference of successive samples."""
SLOW_STEP = 0.01
"""Share of a triad's size by which no slow channel of a tool at rest steps."""
DIFFERENCES = 100_000
"""Differences of readings that are looked at."""
LEAST_FLOOR = 1e-200
"""Least noise floor: ratios to a smaller one are no numbers any more."""
INTO = 0.15
"""How far into the stretch the threshold lies, in logarithm."""


Trace = tuple[Array, Array]
Traces = Mapping[str, Trace]
"""Times (n,) and values (n,) of a channel, where it has any; of channels by name."""


class Cells(NamedTuple):
    """One channel in short cells (m,): start, end, median, and whether there is a gap within.

    `step` is the time between samples, `rough` the robust standard deviation of a sample from
    the difference of successive ones: noise, even while the tool moves. `resolution` is
    the step in which readings come.
    """

    start: Array
    end: Array
    level: Array
    torn: Bools
    step: float
    rough: float
    resolution: float


class Slow(NamedTuple):
    """A channel too slow for the activity: times and values (n,), and the step that is movement."""

    time: Array
    value: Array
    limit: float


class Activity(NamedTuple):
    """Activity on a common grid of cells.

    Attributes:
        edge: start of each cell, and the end of the last (m + 1,), s.
        value: activity (m,), in noise floors; infinite where a channel has no samples.
        cells: the channels that were looked at, cut up; of a long log read when they are asked for.
        floor: noise floor of each, in its own unit.
    """

    edge: Array
    value: Array
    cells: Mapping[str, Cells]
    floor: Array

    @property
    def cell(self) -> float:
        """Length of a cell, s."""
        return float(self.edge[1] - self.edge[0])


class Standstills(NamedTuple):
    """Intervals that look still (k,), their edges trimmed, and what became of each.

    `taken`: long enough, and no channel creeps on; `short`: not long enough. Anything else moves
    slowly.
    """

    start: Array
    end: Array
    taken: Bools
    short: Bools

    @property
    def stations(self) -> tuple[Array, Array]:
        """Start and end of those that are taken."""
        return self.start[self.taken], self.end[self.taken]


class CellGrid(NamedTuple):
    """The cells of a channel by its clock alone: start, end and gaps (m,), and the usual step between samples, s.

    `stretches` at one rate: first sample, number of cells, and samples of each.
    """

    start: Array
    end: Array
    torn: Bools
    step: float
    stretches: list[tuple[int, int, int]]


def cells_of(time: Array, value: Array, length: float) -> Cells:
    """A channel in cells of about `length` seconds, but of no fewer than `FEWEST` samples.

    Shapes: `time` (n,) ascending, `value` (n,) without blanks. Where the rate changes, so does the
    number of samples of a cell; what is left there belongs in time to the cell before.
    """
    return filled(cell_grid(time, length), value)


def filled(grid: CellGrid, value: Array) -> Cells:
    """The channel (n,) in the cells of its clock."""
    steps = np.diff(value)
    np.abs(steps, out=steps)
    rough = float(np.median(steps, overwrite_input=True)) / 0.6745 / np.sqrt(2) if steps.size else 0
    del steps
    level = np.empty(len(grid.start))
    done = 0
    for first, count, size in grid.stretches:
        shaped = value[first : first + count * size].reshape(count, size)
        for start in range(0, count, CELLS_AT_ONCE):
            part = shaped[start : start + CELLS_AT_ONCE]
            level[done : done + len(part)] = np.median(part, axis=-1)
            done += len(part)
    return Cells(grid.start, grid.end, level, grid.torn, grid.step, float(rough), resolution(value))


def cell_grid(time: Array, length: float) -> CellGrid:
    """The cells of samples at these times (n,)."""
    bounds = [*_rate_changes(time), len(time)]
    parts = [_even(time[a:b], length) for a, b in pairwise(bounds)]
    start, end, torn = (np.concatenate([part[k] for part in parts]) for k in range(3))
    shapes = [(int(a), *part[3]) for a, part in zip(bounds, parts, strict=False)]
    return CellGrid(start, end, torn, time_step(time), shapes)


def _even(time: Array, length: float) -> tuple[Array, Array, Bools, tuple[int, int]]:
    """Start, end and gaps of cells of samples at one rate, their number, and samples of each."""
    step = time_step(time)
    size = max(FEWEST, round(length / step)) if step > 0 else FEWEST
    count = len(time) // size
    clock = time[: count * size].reshape(count, size)
    end = clock[:, -1] + step
    torn = np.any(np.diff(clock) > (size + 0.5) * step, axis=-1)
    if count and time[-1] - clock[-1, -1] < size * step:
        end[-1] = time[-1] + step
    return clock[:, 0].copy(), end, torn, (count, size)


def _rate_changes(time: Array) -> Ints:
    """First samples of the stretches at one rate: the rate of a chunk is that of its median step."""
    count = (len(time) - 1) // CLOCK_SAMPLES
    if count < 2:
        return np.zeros(1, int)
    steps = np.median(np.diff(time)[: count * CLOCK_SAMPLES].reshape(count, CLOCK_SAMPLES), axis=-1)
    usual = time_step(time)
    level = np.round(np.log2(np.maximum(steps, 1e-3 * usual) / usual)) if usual else steps
    return np.concatenate([[0], (np.flatnonzero(np.diff(level)) + 1) * CLOCK_SAMPLES])


def resolution(value: Array) -> float:
    """The step in which the readings (n,) of a channel come; hardly anything where they show none.

    Definition: the smallest difference of successive readings on which `EQUAL_SHARE` of those that
    differ agree, but none that is far below another such one or below movements, as arises where
    a coarse reading was rescaled by something smooth. Without one, the difference that 1 % stay
    below: single odd readings do not make a channel fine.
    """
    every = max(1, len(value) // DIFFERENCES)
    steps = np.sort(np.abs(value[1::every] - value[:-1:every]))
    steps = steps[steps > 0]
    if not steps.size:
        return 0.0
    for least in (0.0, 1e-3 * float(np.quantile(steps, 0.99))):
        step = _agreed(steps[np.searchsorted(steps, least) :])
        if step:
            return step
    return float(np.quantile(steps, 0.01, method="lower"))


def _agreed(steps: Array) -> float:
    """The smallest of the ascending steps (n,) on which many agree and few are below; else 0."""
    count = np.searchsorted(steps, steps * (1 + AGREE), "right") - np.arange(len(steps))
    common = np.flatnonzero(count >= max(EQUAL_SHARE * len(steps), 10))
    if not common.size:
        return 0.0
    first = common[np.searchsorted(steps[common], steps[common[-1]] / 20)]
    first = first + int(np.argmax(count[first : first + count[first]]))
    step = float(steps[first + count[first] // 2])
    between = np.searchsorted(steps, [0.05 * step, 0.9 * step])
    return step if between[1] - between[0] <= EQUAL_SHARE * count[first] else 0.0


def time_step(time: Array) -> float:
    """Median time between samples that differ in time; 0 where there are none."""
    steps = np.diff(time)
    later = steps > 0
    if not later.all():
        steps = steps[later]
    return float(np.median(steps, overwrite_input=True)) if steps.size else 0.0


def distinct(time: Array) -> Array:
    """The times (n,) with equal ones spread over the usual step, as a coarse clock leaves them."""
    later = time[1:] > time[:-1]
    if later.all() or not later.any():
        return time
    first = np.concatenate([[0], np.flatnonzero(later) + 1])
    ticks = time[first]
    many = np.diff(first, append=len(time))
    room = np.minimum(np.diff(ticks, append=np.inf), time_step(ticks))
    rank = np.arange(len(time)) - np.repeat(first, many)
    return np.asarray(np.repeat(ticks, many) + rank * np.repeat(room / many, many))


class StoredCells(Mapping[str, Cells]):
    """Channels in cells whose levels are not in memory: they are read when a channel is asked for."""

    def __init__(self, cut: Iterable[tuple[str, Cells]]) -> None:
        self._cells: dict[str, tuple[Cells, StoredNumbers]] = {}
        for name, cells in cut:
            level = StoredNumbers()
            level.add(cells.level)
            self._cells[name] = cells._replace(level=cells.level[:0].copy()), level

    def __getitem__(self, name: str) -> Cells:
        cells, level = self._cells[name]
        return cells._replace(level=level.read())

    def __contains__(self, name: object) -> bool:
        return name in self._cells

    def __iter__(self) -> Iterator[str]:
        return iter(self._cells)

    def __len__(self) -> int:
        return len(self._cells)


def activity(traces: Traces) -> Activity:
    """How much each moment moves, of channels with rates of their own.

    A channel too slow to have a cell within a window of the fastest is not looked at, nor one
    that never changes. Where traces are not all in memory, cells are not either.
    Singular: fewer samples than a window needs give no cells at all.
    """
    steps = _clock_steps(traces)
    length = max(CELL, FEWEST * min((s for s in steps.values() if s > 0), default=0.0))
    fast = [name for name, step in steps.items() if 0 < FEWEST * step <= WINDOW * length]
    cut = _lively(traces, fast, length)
    named = dict(cut) if isinstance(traces, dict) else StoredCells(cut)
    cells = named.values()
    if not cells:
        return Activity(np.zeros(1), np.zeros(0), {}, np.zeros(0))
    start = min(c.start[0] for c in cells)
    count = round(float(max(c.end[-1] for c in cells) - start) / length)
    edge = start + length * np.arange(max(count, 1) + 1)
    floors, value = [], np.zeros(len(edge) - 1)
    for channel in cells:
        ranges = quietest_range(channel.level)
        # One step of the readings up or down is not movement.
        floor = max(noise_floor(ranges), (1 + AGREE) * channel.resolution, LEAST_FLOOR)
        ranges = np.where(channel.torn, np.inf, ranges)
        value = np.maximum(value, on_grid(edge, channel, ranges) / floor)
        floors.append(floor)
    return Activity(edge, value, named, np.array(floors))


def _clock_steps(traces: Traces) -> dict[str, float]:
    """Time between samples of each channel; worked out once for neighbours with one clock."""
    clock, step, steps = np.zeros(0), 0.0, {}
    for name, (time, _) in traces.items():
        if time is not clock:
            clock, step = time, time_step(time)
        steps[name] = step
    return steps


def _lively(traces: Traces, names: Sequence[str], length: float) -> Iterator[tuple[str, Cells]]:
    """Channels that change and have a window, in cells of about `length` seconds; one grid for one clock."""
    clock: Array | None = None
    for name in names:
        time, value = traces[name]
        if np.ptp(value) > 0:
            if time is not clock:
                clock, grid = time, cell_grid(time, length)
            if len(grid.start) >= WINDOW:
                yield name, filled(grid, value)
        del value  # before the next is read


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


def on_grid(edge: Array, cells: Cells, value: Array) -> Array:
    """Each grid cell's value of the channel: that of the channel's cell at its middle."""
    middle = (edge[1:] + edge[:-1]) / 2
    place = np.searchsorted(cells.start, middle, side="right") - 1
    inside = (place >= 0) & (middle <= cells.end[place] + cells.step)
    return np.where(inside, value[place], np.inf)


def triad_size(levels: Sequence[Array]) -> float:
    """Strength of what a triad measures, from the levels (m,) of its channels, in their unit.

    Definition: half the range that a channel covers, the largest of the triad. A triad that
    covers less than 3 % of its norm has never been turned: then it is that norm. Channels without a
    level count for nothing.
    """
    levels = [level for level in levels if len(level)]
    half = max((float(np.ptp(level)) / 2 for level in levels), default=0.0)
    norm = float(np.linalg.norm([np.median(level) for level in levels]))
    return half if half > 0.03 * norm else norm


def rest_limit(cells: Cells, size: float) -> float:
    """Largest range within a window that can be rest: a share of the triad's `size`, or noise."""
    return max(TURN * size, MOTION_RATIO * cells.rough, 2 * cells.resolution)


def step_limit(cells: Cells, size: float) -> float:
    """Step of a slow channel that is movement: a share of the triad's `size`, or noise."""
    return max(SLOW_STEP * size, MOTION_RATIO * max(cells.rough, cells.resolution))


def stretches(still: Bools, least: int = 1) -> tuple[Ints, Ints]:
    """First cells, and cells after the last, of the runs of at least `least` true ones."""
    step = np.diff(still.astype(np.int8), prepend=0, append=0)
    first, last = np.flatnonzero(step == 1), np.flatnonzero(step == -1)
    long = last - first >= least
    return first[long], last[long]


def choose_threshold(value: Array, least: int, highest: float) -> tuple[float, tuple[float, float]]:
    """The threshold of the activity (m,) on which the standstills depend least, and its stretch.

    Definition: of all stretches of thresholds over which no more than `SAME` of the standstills of
    at least `least` cells come, go or merge, the longest in logarithm; the first with the
    stretch's median number from `INTO` of it on. Tried is a geometric series from the quietest
    cell, but no less than the noise floor, up to `highest`.
    Singular: without any standstill at any threshold the value is NaN.
    """
    alive = value[np.isfinite(value) & (value > 0)]
    low = max(float(alive.min()), 1.0) if alive.size else 1.0
    tried = np.geomspace(low, highest, THRESHOLDS_TRIED) if highest >= low else np.zeros(0)
    runs = [stretches(value <= t, least)[0] for t in tried]
    counts = np.array([len(run) for run in runs], int)
    changes = np.cumsum([0, *(_changes(a, b) for a, b in pairwise(runs))])
    best, longest = slice(0), 0
    for first, count in enumerate(counts):
        other = changes[first : len(counts)] - changes[first] > SAME * count
        length = int(np.argmax(other)) if other.any() else len(other)
        if count and length > longest:
            best, longest = slice(first, first + length), length
    if not longest:
        return np.nan, (np.nan, np.nan)
    counts, tried = counts[best], tried[best]
    usual = (counts == np.median(counts)) & (np.arange(longest) >= INTO * (longest - 1))
    chosen = int(np.argmax(usual)) if usual.any() else longest // 2
    return float(tried[chosen]), (float(tried[0]), float(tried[-1]))


def _changes(before: Ints, after: Ints) -> int:
    """Runs that came or merged as the threshold rose, by the first cells (k,) of all of them."""
    shared = len(np.unique(np.searchsorted(after, before, side="right")))
    return len(before) + len(after) - 2 * shared


def standstills(
    activity: Activity, limits: Array, threshold: float, shortest: float, trim: float,
    slow: Sequence[Slow] = (),
) -> Standstills:  # fmt: skip
    """The intervals whose activity stays at or below the threshold, cut and judged.

    `limits` (channels,) is the largest range of each channel within a window that can be rest
    (`rest_limit`); twice that over a whole interval is slow movement. `trim` seconds are cut
    off each end; `shortest` seconds must remain. Slow channels cut intervals where they step.
    """
    first, last = stretches(activity.value <= threshold)
    edge = activity.edge
    start, end = cut_at_steps(edge[first] + trim, edge[last] - trim, slow, trim)
    creeps = np.zeros(len(start), bool)
    for channel, limit in zip(activity.cells.values(), limits, strict=True):
        creeps |= _travels(channel.start, channel.level, start, end) > 2 * limit
    for time, value, limit in slow:
        step = time_step(time)
        creeps |= _travels(time[1:-1], _despiked(value), start + step, end - step) > 4 * limit
    short = end - start < shortest
    return Standstills(start, end, ~short & ~creeps, short)


def _despiked(value: Array) -> Array:
    """Medians (n - 2,) of three samples (n,) next to each other."""
    return np.asarray(np.median(np.stack([value[:-2], value[1:-1], value[2:]]), axis=0))


def _travels(time: Array, level: Array, start: Array, end: Array) -> Array:
    """Range of the levels (n,) within each interval (k,)."""
    places = np.searchsorted(time, np.stack([start, end], -1))
    padded = np.append(level, 0.0)  # an interval may end after the last level
    high, low = (f.reduceat(padded, places.ravel())[::2] for f in (np.maximum, np.minimum))
    return np.where(places[:, 1] > places[:, 0], high - low, 0.0)


def cut_at_steps(
    start: Array, end: Array, slow: Sequence[Slow], trim: float
) -> tuple[Array, Array]:
    """The intervals (k,) that last, without the times at which slow channels step to another level."""
    rooms = [max(trim - 2 * time_step(channel.time), 0.0) for channel in slow]
    pieces = []
    for a, b in zip(start, end, strict=True):
        spans = [_steps(a, b, channel, room) for channel, room in zip(slow, rooms, strict=True)]
        for first, last in sorted(chain.from_iterable(spans)):
            pieces.append((a, first))
            a = max(a, last)
        pieces.append((a, b))
    kept = np.array([piece for piece in pieces if piece[1] > piece[0]], float).reshape(-1, 2)
    return kept[:, 0], kept[:, 1]


def _steps(start: float, end: float, slow: Slow, room: float) -> list[tuple[float, float]]:
    """When a slow channel steps within an interval: from when to when nothing is at rest.

    Definition: a step is where the medians of three samples before and after differ by more than
    the channel's limit, all of them within the interval; a spike is not a step. A step lasts from two
    samples before to two after, and `room` seconds more to each side.
    """
    first, last = np.searchsorted(slow.time, [start, end])
    time, value = slow.time[first:last], slow.value[first:last]
    if len(time) < 2 * FEWEST:
        return []
    middle = _despiked(value)
    stepped = np.abs(middle[FEWEST:] - middle[:-FEWEST]) > slow.limit
    return [
        (float(time[i + FEWEST - 2] - room), float(time[min(j + FEWEST, len(time) - 1)] + room))
        for i, j in zip(*stretches(stepped), strict=True)
    ]
