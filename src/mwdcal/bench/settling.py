"""Whether the tool stands still, said while it is read.

The stream is cut into cells of half a second. A standstill is a row of cells whose scatter is that of the noise, and
whose means do not step; it has settled when it is long enough and no sensor has a trend. The bounds of all three tests
follow from the noise of the tool at rest, with its correlation, and from how often a tool at rest may fail them.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import comb, exp, inf, sqrt
from typing import NamedTuple

import numpy as np

from mwdcal.geometry.vectors import Array
from mwdcal.logs.station_means import student

CELL_SECONDS = 0.5
"""Length of a cell, seconds."""
FEWEST_IN_CELL = 3
"""Samples of a cell at least."""
FEWEST_CELLS = 5
"""Cells of a standstill at least: three tell a curve, the others the noise about it."""
FALSE_MOVE = 1e-3
"""Chance that a cell of a tool at rest ends its standstill, by any sensor."""
FALSE_CREEP = 0.05
"""Chance that a tool at rest looks as if it crept, by any sensor: it then waits for another cell."""
SILENCE = 3.0
"""Seconds without a sample that end a standstill."""
LATEST = 120
"""Cells of which the quieter ones, their first quartile, tell the noise of a sensor."""
QUARTILE_COST = 6.0
"""Cells whose first quartile knows a variance as well as one degree of freedom: of the normal distribution, 6.3."""
QUARTER_OF_NORMAL = 0.3186393639643752
"""First quartile of the size of a normal variate."""
SMOOTH = 3
"""Order of the differences of samples that tell the roughness of a sensor: a movement is smooth, and hardly shows."""
FLIP = 1.001
"""Steps by which a coarse reading at rest changes at most: between two, rounded."""
LARGEST_WANDER = 12.0
"""Times its roughness that a sensor at rest wanders from cell to cell.

AR(1) noise of 0.05 to 5 s does so up to 10.6 times, at 100 samples a second.
"""
LEAST_TIMES = 3.0
"""A standstill holds at least so many correlation times of its noise, or the noise wanders."""
RANDOM_WALK_FREEDOM = 2.5
"""Degrees of freedom of the variance of a random walk about its mean: (Σ 1/k²)²/Σ 1/k⁴."""
MOST_BLOCKS = 20
"""Blocks of cells in which a trend is looked for."""
LEAST_CHANGES = 9
"""Changes from cell to cell before which no standstill is believed."""
REMEMBERED = 64
"""Standstills whose noise is remembered."""
TRIAD = 3


class Standstill(NamedTuple):
    """A standstill: times (n,), samples (n, channels), and the smallest step of each sensor, 0 where none was seen."""

    time: Array
    samples: Array
    steps: tuple[float, ...]


@dataclass
class HalfSecond:
    """Samples of half a second: their times, and all channels one after the other."""

    times: array[float]
    values: array[float]

    @property
    def table(self) -> Array:
        """The samples (n, channels)."""
        return np.frombuffer(self.values).reshape(len(self.times), -1)


class StreamCell(NamedTuple):
    """A whole half second: its samples, the means of all channels, and of each sensor the scatter and the roughness."""

    samples: HalfSecond
    means: Array
    scatter: Array
    rough: Array


class RestNoise(NamedTuple):
    """Noise of the cell means of a standstill: its variance in each sensor, and its correlation in each triad."""

    variance: Array
    correlation: Array


def _lower_quartile(values: Array) -> Array:
    """The lower quartiles of columns (n, ...), in an eighth of the time of `numpy.quantile`."""
    place, share = divmod((len(values) - 1) / 4, 1)
    low, high = int(place), min(int(place) + 1, len(values) - 1)
    ordered = np.partition(values, (low, high), axis=0)
    return np.asarray(ordered[low] + share * (ordered[high] - ordered[low]))


class Settling:
    """The state of the tool: "moving", "settling" or "settled".

    The first `sensors` channels decide, those that follow, such as a temperature, do not. `window` is how long the tool
    has to stand, in seconds; `least` (k,) the smallest noise of each sensor that is believed. `moves` counts how often
    a standstill has ended. `wanders`: the correlation time of the noise is more than a third of a standstill, so
    that the standstills tell the uncertainty of their means badly.
    """

    def __init__(self, sensors: int, window: float = 5.0, least: Sequence[float] = ()) -> None:
        self.sensors, self.window = sensors, window
        self.least = np.array([*least] or [0.0] * sensors, dtype=float)
        self.step = [inf] * sensors
        self.still: list[StreamCell] = []
        self.recent: deque[tuple[Array, Array, Array]] = deque(maxlen=LATEST)
        self.past: deque[RestNoise] = deque(maxlen=REMEMBERED)
        self.time = -inf
        self.moves = 0
        self._open: HalfSecond | None = None
        self._last: StreamCell | None = None
        self._before: Sequence[float] = ()
        self._noise: RestNoise | None = None
        self.wanders = False

    def take(self, time: float, values: Sequence[float]) -> None:
        """One sample of all channels at a time in seconds; a gap, or a clock set back, ends a standstill."""
        if time < self.time or time - self.time > SILENCE:
            self._open = self._last = None
            self._end()
        self.time = time
        cell = self._open
        if (
            cell is not None
            and time - cell.times[0] >= CELL_SECONDS
            and len(cell.times) >= FEWEST_IN_CELL
        ):
            self._judge(self._closed(cell))
            cell = None
        self._learn_steps(values)
        if cell is None:
            cell = self._open = HalfSecond(array("d"), array("d"))
        cell.times.append(time)
        cell.values.extend(values)

    def _learn_steps(self, values: Sequence[float]) -> None:
        """The smallest step of each sensor: that of its converter, if it is coarse."""
        for place, (a, b) in enumerate(zip(values[: self.sensors], self._before, strict=False)):
            if 0 < abs(a - b) < self.step[place]:
                self.step[place] = abs(a - b)
        self._before = values

    def _closed(self, samples: HalfSecond) -> StreamCell:
        table = samples.table
        sensors = table[:, : self.sensors]
        order = min(SMOOTH, len(table) - 1)
        rough = np.sqrt(np.mean(np.diff(sensors, order, axis=0) ** 2, 0) / comb(2 * order, order))
        return StreamCell(samples, table.mean(0), sensors.std(0, ddof=1), rough)

    def _end(self) -> None:
        """The standstill is over. The noise of one that had settled is remembered."""
        self.moves += bool(self.still)
        if self._noise is not None:
            self.past.append(self._noise)
        self.still, self._noise = [], None

    def _judge(self, cell: StreamCell) -> None:
        """Take a whole cell: into the standstill, or as the end of it."""
        last = self._last
        self._last = cell
        if last is not None:
            change = np.abs(cell.means - last.means)[: self.sensors]
            self.recent.append((cell.rough, cell.scatter, change))
            self._cut([*self.still, cell])
        self._look()

    def _cut(self, cells: list[StreamCell]) -> None:
        """The standstill: the latest cells whose scatter and changes are those of rest, as it is known by now."""
        scatter, most = self._bounds(len(cells[-1].samples.times))
        means = np.array([cell.means[: self.sensors] for cell in cells])
        loud = np.any([cell.scatter > scatter for cell in cells], axis=1)
        apart = np.any(np.abs(np.diff(means, axis=0)) > most, axis=1)
        first = max(
            np.flatnonzero(loud).max(initial=-1) + 1, np.flatnonzero(apart).max(initial=-1) + 1
        )
        if first == len(cells) or (first and apart[-1]):
            self._end()
        self.still = cells[max(first, len(cells) - int(4 * self.window / CELL_SECONDS)) :]

    def _bounds(self, count: int) -> tuple[Array, Array]:
        """The largest scatter of a cell, and the largest change to the next, at rest (k,).

        Both are seen as multiples of the roughness, which movement hardly changes, and are alike in a triad. Cells of
        correlated noise hold fewer independent samples than samples: as many as the change of their means tells, as
        that of n independent ones has the variance 2/n.
        """
        recent = np.array(self.recent).transpose(1, 0, 2)
        rough = np.maximum(_lower_quartile(recent[0]), self._floor)
        ratios = np.divide(recent[1:], rough, out=np.zeros_like(recent[1:]), where=rough > 0)
        chance, bounds = FALSE_MOVE / 2 / self.sensors, np.zeros((2, self.sensors))
        for triad in self._triads:
            scatter, change = (float(_lower_quartile(each[:, triad].ravel())) for each in ratios)
            known = ratios[0][:, triad].size / QUARTILE_COST
            scatter = max(scatter, 1.0)  # less only of coarse readings
            change = max(change / QUARTER_OF_NORMAL, sqrt(2 / count))
            freedom = min(max(2 * (scatter / change) ** 2, RANDOM_WALK_FREEDOM), count - 1)
            times = _largest_scatter(round(freedom, 1), round(known, 1), chance)
            wander = min(
                float(student(known, chance)), float(student(inf, chance)) * LARGEST_WANDER / change
            )
            bounds[:, triad] = [[scatter * times], [change * wander]]
        coarse = np.where(rough > self._steps / 2, 0.0, FLIP * self._steps)
        return bounds[0] * rough, np.maximum(bounds[1] * rough, coarse)

    @property
    def _triads(self) -> list[slice]:
        return [slice(i, i + TRIAD) for i in range(0, self.sensors, TRIAD)]

    @property
    def _floor(self) -> Array:
        """The smallest noise of each sensor: half a step is a value between two."""
        return np.asarray(np.maximum(self.least, self._steps / 2))

    @property
    def _steps(self) -> Array:
        """The smallest step of each sensor; 0 where none was seen."""
        return np.where(np.isfinite(self.step), self.step, 0.0)

    def _look(self) -> None:
        """Drop the oldest cells until no sensor creeps; settled if what is left is long enough."""
        self._noise = None
        while len(self.recent) >= LEAST_CHANGES and self._is_long:
            noise, creeps = self._trend()
            if not creeps:
                self._noise = noise
                return
            del self.still[0]

    def _trend(self) -> tuple[RestNoise, bool]:
        """The noise of the means about their trend, and whether that is more than it explains."""
        cells = np.array([cell.means[: self.sensors] for cell in self.still])
        count = len(cells)
        size = -(-count // MOST_BLOCKS)
        means = cells[count % size :].reshape(-1, size, self.sensors).mean(1)
        form = _trend_in_noise(len(means))
        trend, residual = form.trend @ means, form.residual @ means
        squares = np.sum(residual**2, 0)
        products = np.sum(residual[1:] * residual[:-1], 0)
        ratio = np.divide(products, squares, out=np.zeros(self.sensors), where=squares > 0)
        now = np.array([form.correlation(float(ratio[triad].mean())) for triad in self._triads])
        earlier = [each for each in self.past if each.variance.shape == squares.shape]
        correlation = np.mean([now, *(each.correlation for each in earlier)], 0)
        self.wanders = bool(np.any(correlation > exp(-LEAST_TIMES / len(means))))
        place = np.repeat(form.place(correlation), TRIAD)[: self.sensors]
        samples = sum(len(cell.samples.times) for cell in self.still) / len(means)
        noise = RestNoise(np.maximum(squares / form.left[place], self._floor**2 / samples), now)
        variance = np.mean([noise.variance, *(each.variance for each in earlier)], 0)
        freedom = form.freedom[place] * (1 + len(earlier))
        limit = student(freedom, FALSE_CREEP / trend.size) * np.sqrt(
            form.variance[:, place] * variance
        )
        return noise, bool(np.any(np.abs(trend) > limit))

    @property
    def _stood(self) -> float:
        return (
            self.still[-1].samples.times[-1] - self.still[0].samples.times[0] if self.still else 0.0
        )

    @property
    def _is_long(self) -> bool:
        return self._stood >= self.window and len(self.still) >= FEWEST_CELLS

    @property
    def seconds_left(self) -> float:
        """How long the tool still has to stand; the whole window while it moves."""
        return max(self.window - self._stood, 0.0)

    @property
    def state(self) -> str:
        """The state in a word."""
        if not self.still:
            return "moving"
        return "settled" if self._noise is not None else "settling"

    @property
    def means(self) -> tuple[float, ...]:
        """The mean of each channel over the standstill."""
        counts = [len(cell.samples.times) for cell in self.still]
        means = np.average([cell.means for cell in self.still], 0, counts)
        return tuple(map(float, means))

    def station(self) -> Standstill:
        """The samples of the standstill."""
        parts = [cell.samples for cell in self.still]
        time = np.concatenate([np.frombuffer(each.times) for each in parts])
        steps = tuple(step if step < inf else 0.0 for step in self.step)
        return Standstill(time, np.concatenate([each.table for each in parts]), steps)


@cache
def _largest_scatter(freedom: float, known: float, chance: float) -> float:
    """Times the first quartile of a scatter that one more exceeds with this chance.

    The scatter has so many degrees of `freedom`, and the quartile, as an estimate, is as good as `known` cells.
    Definition: the point of Fisher's F, by the quartile of χ² over its degrees of freedom.
    """
    from scipy.special import chdtri, fdtri

    quartile = chdtri(freedom, 0.75) / freedom
    return float(sqrt(fdtri(freedom, max(known * freedom, 1.0), 1 - chance) / quartile))


class TrendInNoise(NamedTuple):
    """A line and a curve through n means of AR(1) noise, for correlations of neighbours on a grid (g,).

    Attributes:
        trend: weights (2, n) of the amplitudes of line and curve.
        residual: what is left without mean, line and curve (n, n).
        grid: the correlations.
        ratio: expected product of neighbouring residuals over their square, of each correlation.
        left: expected sum of squares of the residuals, of noise of variance 1.
        variance: of the amplitudes (2, g), of noise of variance 1.
        freedom: degrees of freedom of the sum of squares (Satterthwaite 1946).
    """

    trend: Array
    residual: Array
    grid: Array
    ratio: Array
    left: Array
    variance: Array
    freedom: Array

    def correlation(self, ratio: float) -> float:
        """The correlation that gives this ratio."""
        return float(np.interp(ratio, self.ratio, self.grid))

    def place(self, correlation: Array) -> Array:
        """The nearest place on the grid."""
        return np.asarray(np.abs(self.grid[:, None] - correlation).argmin(0))


@cache
def _trend_in_noise(count: int) -> TrendInNoise:
    """The form of a trend of `count` means; correlation times up to all of them, which show at most."""
    base, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, count), 3, increasing=True))
    residual, trend = np.eye(count) - base @ base.T, base[:, 1:].T
    grid = np.linspace(0.0, exp(-1 / count), 65)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    rows = []
    for correlation in grid:
        noise = correlation**apart
        left = residual @ noise @ residual
        total = float(np.trace(left))
        amplitudes = np.diag(trend @ noise @ trend.T)
        rows.append(
            (np.trace(left, 1) / total, total, total**2 / float(np.sum(left * left)), *amplitudes)
        )
    ratio, total, freedom, *variance = np.array(rows).T
    return TrendInNoise(
        trend, residual, grid, np.maximum.accumulate(ratio), total, np.array(variance), freedom
    )
