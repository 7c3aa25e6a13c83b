"""Whether the tool stands still, said while it is read.

The stream is cut into cells of half a second. A cell is still if no channel scatters more than three times its noise,
nor lies farther from the first cell of the standstill than noise allows. So many still cells in a row are a station,
whose reading is their mean. While a channel creeps, the oldest cells are dropped, until the others creep no more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import hypot, inf, sqrt

CELL_SECONDS = 0.5
"""Length of a cell, seconds."""
FEWEST_IN_CELL = 3
"""Samples of a cell at least."""
CELL_SCATTER = 3.0
"""Times its noise that a channel may scatter within a cell."""
CELLS_APART = 5.0
"""Standard deviations that the means of two cells of a standstill may lie apart."""
CREEP_SIGMA = 3.0
"""Standard deviations of a trend over the standstill beyond which a channel creeps."""
WANDER_SIGMA = 3.58
"""Of the normal distribution: chance exceeds it once in a thousand times in any of six sensors."""
DOUBTFUL_SIGMA = 2.0
"""Beyond these the change over the standstill counts as an uncertainty of the mean."""
SILENCE = 3.0
"""Seconds without a sample that end a standstill."""
LATEST = 40
"""Cells of which the quieter ones, their first quartile, tell the noise of a channel."""
QUARTILE = 0.6745
"""Of the normal distribution; so the first quartile of a scatter of χ² follows (Wilson and Hilferty)."""


@dataclass
class HalfSecond:
    """Sums over the samples of half a second."""

    start: float
    first: tuple[float, ...]
    count: int = 0
    end: float = 0.0
    sums: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)

    def add(self, time: float, values: Sequence[float]) -> None:
        """One sample more."""
        if not self.count:
            self.sums, self.squares = [0.0] * len(values), [0.0] * len(values)
        self.count, self.end = self.count + 1, time
        for place, (value, origin) in enumerate(zip(values, self.first, strict=True)):
            off = value - origin
            self.sums[place] += off
            self.squares[place] += off * off

    @property
    def means(self) -> list[float]:
        """The mean of each channel."""
        return [a + total / self.count for a, total in zip(self.first, self.sums, strict=True)]

    @property
    def scatter(self) -> list[float]:
        """The standard deviation of the samples of each channel."""
        many = max(self.count - 1, 1)
        return [
            sqrt(max(square - total * total / self.count, 0.0) / many)
            for total, square in zip(self.sums, self.squares, strict=True)
        ]


@dataclass(frozen=True)
class Standstill:
    """Means of the channels over a standstill, the standard uncertainty of each mean, and when it was."""

    means: tuple[float, ...]
    sd: tuple[float, ...]
    samples: int
    start: float
    end: float


class Settling:
    """The state of the tool: "moving", "settling" or "settled".

    The first `sensors` channels decide, those that follow, such as a temperature, do not. `window` is how long the tool
    has to stand, in seconds; `least` (k,) the smallest noise of each sensor that is believed. `moves` counts how often
    a standstill has ended.
    """

    def __init__(self, sensors: int, window: float = 5.0, least: Sequence[float] = ()) -> None:
        self.sensors, self.window = sensors, window
        self.least = [*least] or [0.0] * sensors
        self.step = [inf] * sensors
        self.still: list[HalfSecond] = []
        self.recent: deque[list[float]] = deque(maxlen=LATEST)
        self.noise = [inf] * sensors
        self.time = -inf
        self.moves = 0
        self._cell: HalfSecond | None = None
        self._before: Sequence[float] = ()
        self._settled = False

    def take(self, time: float, values: Sequence[float]) -> None:
        """One sample of all channels at a time in seconds; a gap, or a clock set back, ends a standstill."""
        if time < self.time or time - self.time > SILENCE:
            self._cell = None
            self._end()
        self.time = time
        cell = self._cell
        if cell is not None and time - cell.start >= CELL_SECONDS and cell.count >= FEWEST_IN_CELL:
            self._judge(cell)
            cell = None
        self._learn_steps(values)
        if cell is None:
            cell = self._cell = HalfSecond(time, tuple(values))
        cell.add(time, values)

    def _learn_steps(self, values: Sequence[float]) -> None:
        """The smallest step of each sensor: that of its converter, if it is coarse."""
        for place, (a, b) in enumerate(zip(values[: self.sensors], self._before, strict=False)):
            if 0 < abs(a - b) < self.step[place]:
                self.step[place] = abs(a - b)
        self._before = values

    def _end(self) -> None:
        """The standstill is over."""
        self.moves += bool(self.still)
        self.still, self._settled = [], False

    def _judge(self, cell: HalfSecond) -> None:
        """Take a whole cell into the standstill, or end it."""
        scatter = cell.scatter[: self.sensors]
        self.recent.append(scatter)
        quartiles = (sorted(each)[len(each) // 4] for each in zip(*self.recent, strict=True))
        freedom = cell.count - 1
        usual = (1 - 2 / (9 * freedom) - QUARTILE * sqrt(2 / (9 * freedom))) ** 1.5
        self.noise = [
            max(
                each / usual, least, step / 2 if step < inf else 0.0
            )  # half a step: a value between two
            for each, least, step in zip(quartiles, self.least, self.step, strict=True)
        ]
        quiet = all(s <= CELL_SCATTER * n for s, n in zip(scatter, self.noise, strict=True))
        ends = (self.still[0], self.still[-1]) if self.still else ()
        if not quiet or not all(self._alike(cell, other) for other in ends):
            self._end()
        if quiet:
            self.still.append(cell)
            del self.still[: -int(4 * self.window / CELL_SECONDS)]
        self._settled = False
        while self.still and self._stood >= self.window:
            if not self._creeps():
                self._settled = True
                break
            del self.still[0]

    def _alike(self, one: HalfSecond, other: HalfSecond) -> bool:
        spread = sqrt(1 / one.count + 1 / other.count)
        pairs = zip(one.means, other.means, self.noise, strict=False)
        return all(abs(a - b) <= CELLS_APART * n * spread for a, b, n in pairs)

    def _creeps(self) -> bool:
        """Whether a sensor has a trend that its scatter does not explain."""
        return any(sigmas > CREEP_SIGMA for _, sigmas in self._trends())

    def _trends(self) -> list[tuple[float, float]]:
        """The change of each sensor over the standstill, and the same in standard deviations."""
        count = sum(cell.count for cell in self.still) / len(self.still)
        columns = [*zip(*(cell.means for cell in self.still), strict=True)]
        return [
            _trend(columns[place], scatter / sqrt(count))
            for place, scatter in enumerate(self._scatter())
        ]

    def _scatter(self) -> list[float]:
        """The standard deviation of a sample of each sensor within the cells of the standstill."""
        each = [*zip(*(cell.scatter for cell in self.still), strict=True)][: self.sensors]
        pooled = (sqrt(sum(s * s for s in cells) / len(cells)) for cells in each)
        return [max(pair) for pair in zip(pooled, self.least, strict=True)]

    @property
    def _stood(self) -> float:
        return self.still[-1].end - self.still[0].start if self.still else 0.0

    @property
    def seconds_left(self) -> float:
        """How long the tool still has to stand; the whole window while it moves."""
        return max(self.window - self._stood, 0.0)

    @property
    def state(self) -> str:
        """The state in a word."""
        if not self.still:
            return "moving"
        return "settled" if self._settled else "settling"

    @property
    def wanders(self) -> bool:
        """Whether the means of cells scatter more than the samples within them explain: no scatter then tells enough.

        A converter too coarse for the noise is left out.
        """
        many, count = len(self.still), sum(cell.count for cell in self.still)
        if many <= FEWEST_IN_CELL:
            return False
        most = _largest_ratio(many - 1, count - many)
        columns = [*zip(*(cell.means for cell in self.still), strict=True)]
        for place, scatter in enumerate(self._scatter()):
            mean = sum(columns[place]) / many
            square = sum((each - mean) ** 2 for each in columns[place]) / (many - 1)
            is_coarse = scatter < self.step[place] / 2 < inf
            if not is_coarse and square * count / many > most * scatter**2:
                return True
        return False

    @property
    def means(self) -> tuple[float, ...]:
        """The mean of each channel over the standstill."""
        samples = sum(cell.count for cell in self.still)
        weighted = ([m * cell.count / samples for m in cell.means] for cell in self.still)
        return tuple(map(sum, zip(*weighted, strict=True)))

    def station(self) -> Standstill:
        """The mean over the standstill; only while settled."""
        cells, means = self.still, self.means
        samples = sum(cell.count for cell in cells)
        each = [*zip(*(cell.means for cell in cells), strict=True)]
        weights = [cell.count / samples for cell in cells]
        sd = [_sd_of_mean(row, weights, mean) for row, mean in zip(each, means, strict=True)]
        pairs = zip(self._scatter(), self._trends(), strict=True)
        for place, (sample, (change, sigmas)) in enumerate(pairs):
            sd[place] = max(sd[place], sample / sqrt(samples))
            if sigmas > DOUBTFUL_SIGMA:
                sd[place] = hypot(sd[place], change)
            if sample < (step := self.step[place]) / 2 < inf:  # its error does not average out
                sd[place] = hypot(sd[place], step / sqrt(12))
        return Standstill(means, tuple(sd), samples, cells[0].start, cells[-1].end)


def _largest_ratio(freedom: int, within: int) -> float:
    """The ratio of two variances of so many degrees of freedom beyond which noise wanders.

    Definition: the point of Fisher's F at `WANDER_SIGMA`, as its cube root is about normal. Singular: infinite where so
    few samples within cells tell nothing. Reference: Paulson 1942.
    """
    share, other = 2 / (9 * freedom), 2 / (9 * within)
    above, below = 1 - share, 1 - other
    square = below**2 - WANDER_SIGMA**2 * other
    if square <= 0:
        return inf
    rest = above**2 - WANDER_SIGMA**2 * share
    root = sqrt((above * below) ** 2 - square * rest)
    return float(((above * below + root) / square) ** 3)


def _trend(means: Sequence[float], sd: float) -> tuple[float, float]:
    """The change along a straight line through means, and the same over its standard deviation.

    That follows from the scatter of the means about the line, or from their `sd` if that is larger.
    """
    many = len(means)
    if many < FEWEST_IN_CELL:
        return 0.0, 0.0
    middle, mean = (many - 1) / 2, sum(means) / many
    square = many * (many * many - 1) / 12
    slope = sum((i - middle) * (m - mean) for i, m in enumerate(means)) / square
    left = sum((m - mean - slope * (i - middle)) ** 2 for i, m in enumerate(means)) / (many - 2)
    spread = max(sd, sqrt(left))
    return abs(slope) * (many - 1), abs(slope) * sqrt(square) / spread if spread else 0.0


def _sd_of_mean(cells: Sequence[float], weights: Sequence[float], mean: float) -> float:
    """Standard uncertainty of a mean of cells by their scatter, which holds noise that wanders from cell to cell.

    So few of them tell their own scatter badly: (m - 1)/(m - 3) makes up for it. Reference: JCGM 101:2008, 6.4.9.4.
    """
    largest = 0.0
    for size in (1, 2):  # means of two cells follow noise that wanders more slowly
        batches = [slice(i, i + size) for i in range(0, len(cells) - size + 1, size)]
        if (many := len(batches)) > 3:
            square = sum(sum(weights[b]) * (sum(cells[b]) / size - mean) ** 2 for b in batches)
            largest = max(largest, square / (many - 3))
    return sqrt(largest)
