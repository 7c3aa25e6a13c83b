"""Regular samples of the channels of a log: the rows that are used, and what is left out and why."""

from __future__ import annotations

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.table import Table, cell_error, numbers, shown
from mwdcal.files.logs import TIME
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.logs import allan
from mwdcal.logs.clock import rate_findings, row_times, unlikely_seconds
from mwdcal.logs.station_findings import count

FEWEST = 128
"""Samples of a channel below which the terms cannot be separated."""
SPARSE = 1e-3
"""Largest share of single blanks that are filled in: the change is below the uncertainty of the noise."""
JITTER = 0.5
"""Share of the sampling interval by which one may differ: more is a gap."""
LEAST = 1e-40
"""Noise below which its powers are no numbers any more."""


def section(
    log: Table, given: float | None, between: tuple[float, float], findings: list[Finding]
) -> tuple[slice, float]:
    """Rows of a log that are to be used, and rows a second."""
    time = row_times(log, given)
    inside = np.flatnonzero((time - time[0] >= between[0]) & (time - time[0] <= between[1]))
    if len(inside) < FEWEST:
        problem, advice = f"got {len(time)}", "Record for longer."
        if len(time) >= FEWEST:
            problem = f"`start` and `end` leave {len(inside)} of {len(time)} rows"
            advice = f"The log lasts {time[-1] - time[0]:.4g} s: widen them."
        raise InputError(
            f"{log.source}: at least {FEWEST} samples are needed for an Allan deviation; {problem}. "
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


def samples(
    log: Table,
    name: str,
    rows: slice,
    rate: float,
    station: float,
    findings: list[Finding],
) -> tuple[Array, float] | None:
    """Values of a channel and samples a second; None with a finding where it cannot be used."""
    value = numbers(log, name)[rows]
    there = np.flatnonzero(~np.isnan(value))
    problem = _unusable(name, value[there])
    if not problem:
        steps = np.diff(there)
        step = int(np.median(steps))
        if (odd := np.flatnonzero(steps != step)).size:
            row = rows.start + int(there[odd[0]]) + min(step, int(steps[odd[0]]))
            line = log.lines[row] if row < len(log.lines) else row + 1
        filled = _filled(value, there, step)
        if filled is None:
            problem = f"{name} is blank at irregular places, first in line {line}: fill in or cut."
        else:
            problem = _noiseless(name, filled, max(round(station * rate / step), 1))
    if problem or filled is None:
        findings.append(Finding(id="channel-left-out", text=f"{problem} It was left out."))
        return None
    if odd.size:
        text = (
            f"{name} is blank in {len(odd)} of {len(filled)} samples, first in line {line}: taken as "
            "the mean of the two neighbours."
        )
        findings.append(Finding(id="filled", text=text))
    return filled, rate / step


def _filled(value: Array, there: Ints, step: int) -> Array | None:
    """Samples of a channel, present `there` at every `step`, single blanks the mean of their neighbours.

    None where others are blank, or more than `SPARSE`.
    """
    steps = np.diff(there)
    single = steps == 2 * step
    if np.any(~single & (steps != step)) or single.sum() > max(SPARSE * len(there), 1):
        return None
    return np.asarray(np.interp(np.arange(there[0], there[-1] + 1, step), there, value[there]))


def _unusable(name: str, value: Array) -> str:
    """Why a channel with these samples (n,) has no noise to be found, if so."""
    if not value.size:
        return f"{name} is blank from end to end."
    if len(value) < FEWEST:
        return f"{name} has {len(value)} samples; {FEWEST} are needed."
    if np.ptp(value) == 0:
        return f"{name} reads {value[0] + 0.0:g} from end to end: a dead channel?"
    return ""


def _noiseless(name: str, value: Array, station: int) -> str:
    """Why the samples (n,), or their means over a `station`, have no noise, if so."""
    factors = [*allan.octaves(len(value)), station]
    size = np.sqrt(allan.variance(value, factors, centred=True))
    none = np.flatnonzero(size <= np.maximum(allan.rounding(value, factors), LEAST))
    if not none.size:
        return ""
    return (
        f"{name} has no noise above the rounding of numbers in averages over "
        f"{count(factors[none[0]], 'sample')}: a ramp, a pattern, or simulated without noise?"
    )
