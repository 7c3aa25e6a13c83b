"""Whether the tool turned in a regular log that should be one of a tool at rest."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.files.contract import CHANNELS
from mwdcal.geometry.vectors import Array
from mwdcal.logs import standstill
from mwdcal.logs.standstill import Cells

NOT_AT_REST = "not-at-rest"
"""The finding on a log in which the tool turns."""
SLOW_CELL = standstill.WINDOW * standstill.CELL
"""Shortest cell, seconds: a window of them shows a turn of half a degree a second."""
LONGEST_WINDOW = 30.0
"""Longest window, seconds: within a longer one a temperature may change readings as a turn does."""
TURNED = 2
"""Channels of a triad that change where it turns; a fault, or a spike, changes one."""
CAUSES = {"accelerometer": "the tool moves", "magnetometer": "the tool or iron nearby moves"}
"""What changes so much, by triad."""


def cells_of(value: Array, rate: float) -> Cells:
    """A channel (n,) of `rate` samples a second, in cells."""
    return standstill.cells_of(np.arange(len(value)) / rate, value, SLOW_CELL)


def movement(channels: Mapping[str, Cells]) -> list[Finding]:
    """The finding on a log in which a triad turns, by channel.

    Definition: within a window of cells at least `TURNED` channels of a triad change by more than can be
    rest (`standstill.rest_limit`). That is a share of the triad's size, which is no less than the norm
    of its levels here: a log at rest may hold nothing but drift.
    """
    for kind, names in CHANNELS.items():
        triad = {n: channels[n] for n in names if n in channels and _is_seen(channels[n])}
        levels = [channel.level for channel in triad.values()]
        norm = float(np.linalg.norm([np.median(level) for level in levels]))
        size = max(standstill.triad_size(levels), norm)
        ranges = {name: _ranges(channel) for name, channel in triad.items()}
        limits = {name: standstill.rest_limit(channel, size) for name, channel in triad.items()}
        if sum(ranges[name].max() > limits[name] for name in triad) >= TURNED:
            name = max(triad, key=lambda n: float(ranges[n].max()))
            first, seconds = int(np.argmax(ranges[name])), _window(triad[name])
            text = (
                f"this log is not at rest: {name} changes by {ranges[name][first]:.4g} within {seconds:.3g} s about "
                f"{triad[name].start[first] + seconds / 2:.4g} s after the start, as {CAUSES[kind]}. Run mwdcal "
                "stations, or choose a part at rest by `start` and `end`."
            )
            return [Finding(id=NOT_AT_REST, text=text)]
    return []


def _is_seen(channel: Cells) -> bool:
    """Whether a channel has a window, and that is short enough."""
    return len(channel.level) >= standstill.WINDOW and _window(channel) <= LONGEST_WINDOW


def _window(channel: Cells) -> float:
    """Duration of a window, seconds."""
    return float(channel.end[standstill.WINDOW - 1] - channel.start[0])


def _ranges(channel: Cells) -> Array:
    """Range of the levels within each window."""
    windows = np.lib.stride_tricks.sliding_window_view(channel.level, standstill.WINDOW)
    return np.asarray(np.ptp(windows, axis=-1))
