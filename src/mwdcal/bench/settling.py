"""Whether the tool stands still, said while it is read.

The stream is cut into cells of half a second. A cell is still where no channel scatters more than three times its noise, or
lies farther from the first cell of the standstill than noise allows. So many still cells in a row are a station, whose reading
is their mean.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, sqrt

CELL = 0.5
"""Length of a cell, seconds."""
FEWEST = 3
"""Samples of a cell at least."""
SCATTER = 3.0
"""Times its noise that a channel may scatter within a cell."""
APART = 5.0
"""Standard deviations that the means of two cells of a standstill may lie apart."""
GAP = 3.0
"""Seconds without a sample that end a standstill."""
QUIETEST = 40
"""Cells of which the quietest tell the noise of a channel."""


@dataclass
class Cell:
    """Sums over the samples of half a second."""

    start: float
    count: int = 0
    end: float = 0.0
    sums: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)

    def add(self, time: float, values: Sequence[float]) -> None:
        """One sample more."""
        if not self.count:
            self.first = tuple(values)
            self.sums, self.squares = [0.0] * len(values), [0.0] * len(values)
        self.count, self.end = self.count + 1, time
        for place, (value, origin) in enumerate(zip(values, self.first, strict=True)):
            off = value - origin
            self.sums[place] += off
            self.squares[place] += off * off

    @property
    def means(self) -> list[float]:
        """The mean of each channel."""
        return [
            origin + total / self.count for origin, total in zip(self.first, self.sums, strict=True)
        ]

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

    `sensors` channels decide, those that follow, such as a temperature, do not. `window` is how long the tool
    has to stand, in seconds; `least` (k,) the smallest noise of each sensor that is believed: its resolution.
    """

    def __init__(self, sensors: int, window: float = 5.0, least: Sequence[float] = ()) -> None:
        self.sensors, self.window = sensors, window
        self.least = list(least) or [0.0] * sensors
        self.cell: Cell | None = None
        self.still: list[Cell] = []
        self.recent: deque[list[float]] = deque(maxlen=QUIETEST)
        self.noise = [inf] * sensors
        self.time = -inf

    def take(self, time: float, values: Sequence[float]) -> None:
        """One sample of all channels at a time in seconds, which does not go back."""
        if time < self.time or time - self.time > GAP:
            self.cell, self.still = None, []
        self.time = time
        if self.cell is not None and time - self.cell.start >= CELL and self.cell.count >= FEWEST:
            self._close(self.cell)
            self.cell = None
        if self.cell is None:
            self.cell = Cell(time)
        self.cell.add(time, values)

    def _close(self, cell: Cell) -> None:
        """Judge a whole cell."""
        scatter = cell.scatter[: self.sensors]
        self.recent.append(scatter)
        ranked = (sorted(each) for each in zip(*self.recent, strict=True))
        quarter = (len(self.recent) - 1) // 4
        self.noise = [
            max(each[quarter], least) for each, least in zip(ranked, self.least, strict=True)
        ]
        quiet = all(s <= SCATTER * n for s, n in zip(scatter, self.noise, strict=True))
        if not quiet:
            self.still = []
        elif self.still and not (
            self._alike(cell, self.still[0]) and self._alike(cell, self.still[-1])
        ):
            self.still = [cell]
        else:
            self.still.append(cell)
        longest = int(4 * self.window / CELL)
        del self.still[:-longest]

    def _alike(self, one: Cell, other: Cell) -> bool:
        spread = sqrt(1 / one.count + 1 / other.count)
        return all(
            abs(a - b) <= APART * n * spread
            for a, b, n in zip(one.means, other.means, self.noise, strict=False)
        )

    @property
    def seconds_left(self) -> float:
        """How long the tool still has to stand; the whole window while it moves."""
        stood = self.still[-1].end - self.still[0].start if self.still else 0.0
        return max(self.window - stood, 0.0)

    @property
    def state(self) -> str:
        """ "moving", "settling" or "settled"."""
        if not self.still:
            return "moving"
        return "settling" if self.seconds_left > 0 else "settled"

    @property
    def began(self) -> float:
        """When the present standstill began, seconds; infinite while the tool moves."""
        return self.still[0].start if self.still else inf

    def station(self) -> Standstill:
        """The mean over the standstill; only while settled."""
        cells = self.still
        samples = sum(cell.count for cell in cells)
        each = list(zip(*(cell.means for cell in cells), strict=True))
        weights = [cell.count / samples for cell in cells]
        means = tuple(sum(m * w for m, w in zip(row, weights, strict=True)) for row in each)
        sd = tuple(_sd_of_mean(row, weights, mean) for row, mean in zip(each, means, strict=True))
        floor = [n / sqrt(samples) for n in self.noise]
        sd = tuple(max(pair) for pair in zip(sd, floor, strict=False)) + sd[len(floor) :]
        return Standstill(means, sd, samples, cells[0].start, cells[-1].end)


def _sd_of_mean(cells: Sequence[float], weights: Sequence[float], mean: float) -> float:
    """Standard uncertainty of a mean of cells, by their scatter: it holds noise that wanders from cell to cell, too."""
    many = len(cells)
    if many < 2:
        return 0.0
    square = sum(w * (cell - mean) ** 2 for cell, w in zip(cells, weights, strict=True))
    return sqrt(square / (many - 1))
