"""Regular samples of the channels of a log: the rows that are used, and what is left out and why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, cell_error, numbers
from mwdcal.files.logs import TIME
from mwdcal.geometry.vectors import Array
from mwdcal.logs import allan
from mwdcal.logs.clock import rate_findings, row_times, unlikely_seconds
from mwdcal.logs.station_findings import count

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


def check_noise(name: str, value: Array, factors: Sequence[int], centred: Array) -> None:
    """Refuse samples (n,) without noise in means over some of the factors (m,), by their `centred` variances (m,)."""
    size = np.sqrt(centred)
    for i in np.flatnonzero(size <= np.maximum(allan.rounding(value, factors), SMALLEST_NOISE))[:1]:
        raise UnusableChannelError(
            f"{name} has no noise above the rounding of numbers in averages over "
            f"{count(factors[i], 'sample')}: a ramp, a pattern, or simulated without noise?"
        )
