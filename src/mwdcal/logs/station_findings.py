"""Findings about the stations of a log: what was left out, and what is unusual at a station."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import ceil, floor, log10

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.vectors import Array
from mwdcal.logs import standstill
from mwdcal.logs.standstill import Activity, Standstills
from mwdcal.logs.station_means import ChannelMean

MANY_SPIKES = 0.01
"""Share of spikes that is reported."""
MOST_LISTED = 12
"""Stations, or stretches of time, that a finding names."""
STEADY = 3.0
"""Standard deviations of a cell's level by which a noisy but steady stretch may drift."""

Rows = dict[str, list[ChannelMean]]
"""What each channel read at each station."""


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
        yield Finding(id="all-still", text=text)
    yield from _spikes(rows)
    for name, summaries in rows.items():
        yield from _unreliable(name, summaries)
        yield from _drifting(name, summaries, end - start)


def correlated_noise(names: list[str]) -> Finding:
    """Noise that is correlated over times that are not short against the standstills."""
    text = (
        f"noise of {', '.join(names)} is correlated over seconds: the halves of standstills differ by "
        "more than their samples explain. sd_ is widened to what they tell; with 1/f noise it is still "
        "too small. Stand still for longer, or state the noise in the tool profile."
    )
    return Finding(id="correlated-noise", text=text)


def _spikes(rows: Rows) -> Iterator[Finding]:
    """The channel with the largest share of spikes, where that is large."""
    share = {
        n: sum(r.spikes for r in summaries) / sum(r.spikes + r.used for r in summaries)
        for n, summaries in rows.items()
    }
    name = max(share, key=lambda n: share[n])
    if share[name] > MANY_SPIKES:
        lost = f"{100 * share[name]:.1f} % of the samples of {name}"
        yield Finding(id="spikes", text=f"{lost} were left out as spikes: check the wiring.")


def _unreliable(name: str, summaries: list[ChannelMean]) -> Iterator[Finding]:
    """A channel at its limit or frozen, and one that is less steady than usual or steps."""
    stuck = [row.stuck for row in summaries]
    if any(stuck):
        text = (
            f"{name} stands at its limit, or is frozen, at {_places(stuck)}: too many equal readings for its "
            f"noise, such as {summaries[stuck.index(True)].mean + 0.0:.6g}. Its sd_ there is that of a reading "
            "known to the channel's range only."
        )
        yield Finding(id="stuck-channel", text=text, station=str(stuck.index(True) + 1))
    unsteady = [row.unsteady and not row.stuck for row in summaries]
    if any(unsteady):
        usual = float(np.median([row.spread for row in summaries]))
        text = (
            f"{name} is less steady than usual at {_places(unsteady)}: it spreads more than at the others, or "
            f"moves within the standstill (usual spread of one sample {usual:.2g}). Was the tool knocked, turned "
            "or shaken?"
        )
        yield Finding(id="unsteady", text=text, station=str(unsteady.index(True) + 1))


def _places(where: list[bool]) -> str:
    """How many of the stations, and which."""
    numbers = [i for i, there in enumerate(where, 1) if there]
    return f"{count(len(numbers), 'station')} of {len(where)} ({listed(numbers)})"


def _drifting(name: str, summaries: list[ChannelMean], seconds: Array) -> Iterator[Finding]:
    """A channel that drifts at some stations."""
    drifting = [i for i, row in enumerate(summaries) if row.drifts]
    if drifting:
        worst = max(drifting, key=lambda i: abs(summaries[i].drift))
        text = (
            f"{name} drifts at {len(drifting)} of {len(summaries)} stations, most at station {worst + 1}: by "
            f"{summaries[worst].drift:.3g} over {seconds[worst]:.1f} s (noise of one sample "
            f"{summaries[worst].spread:.2g}). See the columns drift_."
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
