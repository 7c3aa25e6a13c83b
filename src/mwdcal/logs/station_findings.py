"""Findings about the stations of a log: what was left out, and what is unusual at a station."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import ceil, floor, log10

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.logs import standstill
from mwdcal.logs.standstill import Activity, Standstills
from mwdcal.logs.station_means import ChannelMean

ALL_STILL = "all-still"
"""The finding on a log that is one station."""
MANY_SPIKES = 0.01
"""Share of spikes that is reported."""
MOST_LISTED = 12
"""Stations, or stretches of time, that a finding names."""
STEADY = 3.0
"""Standard deviations of a cell's level by which a noisy but steady stretch may drift."""

Rows = dict[str, ChannelMean]
"""What each channel read at the stations."""


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
