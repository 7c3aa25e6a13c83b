"""Regular samples of the channels of a log: the rows that are used, and what is left out and why.

When the rows of a log were taken: by its column `time_s`, or by its rate of sampling.

Whether the tool turned in a regular log that should be one of a tool at rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from numbers import Real
from typing import TypeGuard

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS, RAW, Range
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, cell_error, numbers
from mwdcal.files.logs import TIME
from mwdcal.geometry.vectors import Array
from mwdcal.logs import allan, standstill
from mwdcal.logs.standstill import CellGrid, Cells
from mwdcal.logs.station_means import count

ANY = Range(-np.inf, np.inf, "s")
SECONDS = Range(0.0, 1e9, "s")
DURATION = Range(0.0, 1e9, "s", positive=True)
RATE = Range(1e-12, 1e9, "Hz")
"""Accepted times and rates; the slowest is that of a clock in nanoseconds taken as seconds."""
INSTANT = Range(-1e19, 1e19, "s")
"""Accepted cells of a clock: also those of one that counts nanoseconds from 1970, which is reported."""
MOST_CELLS = 50_000_000
"""Cells of the longest log: four months at 15 samples a second or more."""
SAME_DURATION = 0.01
"""Share by which a duration may differ from that by a rate of sampling."""
DAY = 86_400.0
SPARSE, RARE = 0.5, 2.0
"""Seconds between samples that are odd in a log of more than a day, and in any."""
CLOCK = re.compile(r"^t(?![A-Za-z0-9])|(?i:time|stamp|clock|epoch|seconds|millis|micros)")
"""Names of columns that may hold the time."""


def is_number(value: object, allowed: Range) -> TypeGuard[float]:
    """Whether the value is a number in the range."""
    if isinstance(value, bool) or not isinstance(value, Real) or np.isnan(float(value)):
        return False
    return not allowed.outside(np.asarray(float(value)))


def check_argument(name: str, value: float | None, allowed: Range) -> None:
    """Refuse what is not a number in the range; None stands for the default."""
    if value is not None and not is_number(value, allowed):
        raise InputError(f"`{name}` must be a number {allowed}; got {shown(value)}. Correct it.")


def row_times(log: Table, sampling_hz: float | None) -> Array:
    """Seconds of each row: from the rate of sampling if given, else the column `time_s`."""
    check_argument("sampling_hz", sampling_hz, RATE)
    if TIME in log.columns and sampling_hz is None:
        return _clock(log)
    rate = log.metadata.get("sampling_hz") if sampling_hz is None else sampling_hz
    if rate is None:
        raise _timeless(log)
    if not is_number(rate, RATE):
        raise InputError(
            f"{log.source}: sampling_hz must be a number {RATE}; got {shown(rate)}. Correct it, or give "
            "`sampling_hz`."
        )
    return np.arange(len(numbers(log, RAW[0]))) / float(rate)


def _clock(log: Table) -> Array:
    """The column `time_s`; refused where a cell is blank, before the one above, or far away."""
    time = numbers(log, TIME)
    for row in np.flatnonzero(np.isnan(time))[:1]:
        advice = "Fill it in, or remove the row."
        raise cell_error(log, TIME, int(row), f"must be filled in; got a blank cell. {advice}")
    for row in np.flatnonzero(INSTANT.outside(time))[:1]:
        got = f"must be {INSTANT}; got {shown(float(time[row]))} s"
        raise cell_error(log, TIME, int(row), f"{got}. Correct the clock.")
    for row in np.flatnonzero(np.diff(time) < 0)[:1]:
        advice = "Sort the log by time, or split it where the clock was set back."
        raise _step_error(log, time, int(row), "must not go back", advice)
    step = standstill.time_step(time)
    if step and not is_number(1 / step, RATE):
        raise InputError(
            f"{log.source}, column '{TIME}': the rate must be a number {RATE}; got rows {step:.4g} s "
            "apart. Write the time in seconds."
        )
    cell = max(standstill.CELL, standstill.FEWEST * step)
    if time[-1] - time[0] > MOST_CELLS * cell:  # most of the log would be nothing
        advice = "Correct the clock, split the log there, or write the time in seconds."
        widest = int(np.argmax(np.diff(time)))
        raise _step_error(log, time, widest, "must not jump so far", advice)
    return time


def _step_error(log: Table, time: Array, row: int, rule: str, advice: str) -> InputError:
    """The refusal of the step from a row to the next."""
    got = f"{shown(float(time[row + 1]))} s after {shown(float(time[row]))} s"
    return cell_error(log, TIME, row + 1, f"{rule}; got {got}. {advice}")


def _timeless(log: Table) -> InputError:
    """The refusal of a log without a time, or with one of another name."""
    clock = next((name for name in log.columns if CLOCK.search(name)), None)
    got = "neither. Add"
    if clock is not None:
        got = f"'{clock}'. Rename it to '{TIME}', in seconds (convert it if it is not); or add"
    return InputError(
        f"{log.source}: a log needs a column '{TIME}', or its rate of sampling; got {got} "
        "`sampling_hz` 100, or a line '# sampling_hz = 100' above the column names."
    )


def rate_findings(log: Table, rows: slice, sampling_hz: float) -> list[Finding]:
    """A finding where the column of times contradicts the rate that was given."""
    time = numbers(log, TIME)[rows]
    filled = np.flatnonzero(~np.isnan(time))
    if not filled.size:
        return []
    first, last = time[filled[[0, -1]]]
    seconds = float(filled[-1] - filled[0]) / sampling_hz
    if abs(last - first - seconds) <= SAME_DURATION * seconds:
        return []
    text = (
        f"`sampling_hz` {sampling_hz:g} was used, by which {len(time)} rows last {seconds:.6g} s, but {TIME} "
        f"goes from {first:g} to {last:g} s: all times and densities rest on the rate given."
    )
    return [Finding(id="rate", text=text)]


def unlikely_seconds(time: Array) -> list[Finding]:
    """A finding on times of rows (n,) that can hardly be seconds, from their steps alone.

    Where the clock starts says nothing: seconds from 1970, or from any other day, are seconds.
    """
    step, lasts = standstill.time_step(time), float(time[-1] - time[0])
    if step < (SPARSE if lasts > DAY else RARE):
        return []
    whole = f"{lasts / DAY:.5g} days" if lasts > DAY else f"{lasts:.4g} s"
    text = (
        f"samples are {step:.5g} s apart and the log lasts {whole} by {TIME}: is it in milliseconds, "
        "microseconds or nanoseconds? It is taken as seconds."
    )
    return [Finding(id="time-unit", text=text)]


FEWEST_SAMPLES = 128
"""Samples of a channel below which the terms cannot be separated."""
MISSING_SHARE = 1e-3
"""Largest share of single blanks that are filled in: the change is below the uncertainty of the noise."""
JITTER = 0.5
"""Share of the sampling interval by which one may differ: more is a gap."""
SMALLEST_NOISE = 1e-40
"""Noise below which its powers are no numbers any more."""


def section(
    log: Table, given: float | None, between: tuple[float, float], findings: list[Finding]
) -> tuple[slice, float]:
    """Rows of a log that are to be used, and rows a second."""
    time = row_times(log, given)
    inside = np.flatnonzero((time - time[0] >= between[0]) & (time - time[0] <= between[1]))
    if len(inside) < FEWEST_SAMPLES:
        problem, advice = f"got {len(time)}", "Record for longer."
        if len(time) >= FEWEST_SAMPLES:
            problem = f"`start` and `end` leave {len(inside)} of {len(time)} rows"
            advice = f"The log lasts {time[-1] - time[0]:.4g} s: widen them."
        raise InputError(
            f"{log.source}: at least {FEWEST_SAMPLES} samples are needed for an Allan deviation; {problem}. "
            f"{advice}"
        )
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    if TIME in log.columns:
        findings += rate_findings(log, rows, given) if given else unlikely_seconds(time[rows])
    return rows, given or _regular_rate(log, time[rows], rows.start)


def _regular_rate(log: Table, time: Array, row: int) -> float:
    """Rows a second of the rows from `row` on, which must come at equal steps of time (n,)."""
    steps = np.diff(time)
    step = float(np.median(steps))
    if step <= 0:
        raise InputError(
            f"{log.source}, column '{TIME}': most samples have the time of the one before; written "
            "with too few digits? Give the rate: `sampling_hz` 100."
        )
    for late in np.flatnonzero(np.abs(steps - step) > JITTER * step)[:1]:
        got = f"{steps[late]:.4g} s after {shown(float(time[late]))} s, not {step:.4g} s"
        advice = (
            "An Allan deviation needs regular samples: choose a part without gaps by `start` and "
            "`end` (seconds from the start), or give the rate if only the clock is coarse."
        )
        place = row + int(late) + 1
        raise cell_error(log, TIME, place, f"the next sample came {got}. {advice}")
    return len(steps) / float(time[-1] - time[0])


class UnusableChannelError(InputError):
    """A channel that is left out; the others go on."""


def samples(
    log: Table, name: str, rows: slice, rate: float, findings: list[Finding]
) -> tuple[Array, float]:
    """Values of a channel and samples a second.

    Errors: `UnusableChannelError` where these samples do not show the noise of the channel.
    """
    value = numbers(log, name)[rows]
    if not np.isnan(value).any():
        _check_changes(name, value)
        return value, rate
    there = np.flatnonzero(~np.isnan(value))
    _check_changes(name, value[there])
    steps = np.diff(there)
    step = int(np.median(steps))
    places = np.arange(there[0], there[-1] + 1, step)
    blank = np.flatnonzero(steps != step)
    if blank.size:
        row = rows.start + int(there[blank[0]]) + min(step, int(steps[blank[0]]))
        line = f"line {log.lines[row] if row < len(log.lines) else row + 1}"
        if np.any(steps[blank] != 2 * step) or blank.size > max(MISSING_SHARE * len(there), 1):
            problem = f"{name} is blank at irregular places, first in {line}: fill in or cut."
            raise UnusableChannelError(problem)
        text = (
            f"{name} is blank in {blank.size} of {len(places)} samples, first in {line}: taken as "
            "the mean of the two neighbours."
        )
        findings.append(Finding(id="filled", text=text))
    return np.interp(places, there, value[there]), rate / step


def _check_changes(name: str, value: Array) -> None:
    """Refuse a channel with too few samples (n,), or that never changes."""
    if not value.size:
        raise UnusableChannelError(f"{name} is blank from end to end.")
    if len(value) < FEWEST_SAMPLES:
        size = count(len(value), "sample")
        raise UnusableChannelError(f"{name} has {size}; {FEWEST_SAMPLES} are needed.")
    if np.ptp(value) == 0:
        reads = f"{name} reads {value[0] + 0.0:g} from end to end: a dead channel?"
        raise UnusableChannelError(reads)


def check_noise(
    name: str, value: Array, factors: Sequence[int], centred: Array, phase: Array
) -> None:
    """Refuse samples (n,) without noise in means over some of the factors (m,), by their `centred` variances (m,)."""
    least = np.maximum(allan.rounding(value, factors, phase), SMALLEST_NOISE)
    for i in np.flatnonzero(np.sqrt(centred) <= least)[:1]:
        raise UnusableChannelError(
            f"{name} has no noise above the rounding of numbers in averages over "
            f"{count(factors[i], 'sample')}: a ramp, a pattern, or simulated without noise?"
        )


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
    return standstill.filled(_grid(len(value), rate), value)


@lru_cache(maxsize=2)
def _grid(samples: int, rate: float) -> CellGrid:
    """The cells of so many samples: channels of one length and rate have the same."""
    return standstill.cell_grid(np.arange(samples) / rate, SLOW_CELL)


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
