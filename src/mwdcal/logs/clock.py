"""When the rows of a log were taken: by its column `time_s`, or by its rate of sampling."""

from __future__ import annotations

import re
from numbers import Real
from typing import TypeGuard

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.contract import RAW, Range
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, cell_error, numbers
from mwdcal.files.logs import TIME
from mwdcal.geometry.vectors import Array
from mwdcal.logs import standstill

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
