"""Stations from a continuous log: its standstills, each as one row of a run file.

Channels may have rates of their own (blank cells in one table), and the temperature may be
slower still: it never decides what stands still. See `core.standstill` for the method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration import Finding
from mwdcal.core import standstill
from mwdcal.core.standstill import Activity, Standstills, Summary
from mwdcal.core.vectors import Array, Ints
from mwdcal.errors import InputError
from mwdcal.files.columns import Column
from mwdcal.files.contract import CHANNELS, RAW
from mwdcal.files.logs import READ, TIME
from mwdcal.files.table import Table, cell_error, numbers, shown

MIN_SECONDS, TRIM_SECONDS = 1.0, 1.0
"""Defaults for a fast log; one sampled slowly needs a window, and a cell, respectively."""
LEAST_SAMPLES = 3
"""Samples of each channel below which there is no station."""
GAP = 5.0
"""Times the usual step between samples that are a gap."""
MANY_SPIKES = 0.01
"""Share of spikes that is worth a word."""
MOST_CELLS = 50_000_000
"""Cells of the longest log: four months at 15 samples a second or more."""
SMALLEST = 1e-12
"""Resolution of a channel that never changes, as a share of its reading."""
PARTS = {"": "mean", "sd_": "sd", "spread_": "spread", "drift_": "drift", "samples_": "used"}
"""Columns per channel: prefix, and what of its summary stands there."""

Trace = tuple[Array, Array]
"""Times (n,) and values (n,) of one channel, where it has any."""


@dataclass(frozen=True, eq=False)
class Stations:
    """What a log holds.

    Attributes:
        table: the run, one row per station.
        found: all intervals that look still, with what became of each.
        activity: how much each moment moves, in noise floors.
        threshold: activity up to which it stands still.
        stretch: thresholds from which to which the number of standstills is the same; None
            where the threshold was given.
        min_seconds, trim_seconds: as used.
        time: of each row of the log, s.
        traces: the channels that have samples.
        findings: what the reader should know.
    """

    table: Table
    found: Standstills
    activity: Activity
    threshold: float
    stretch: tuple[float, float] | None
    min_seconds: float
    trim_seconds: float
    time: Array
    traces: dict[str, Trace]
    findings: list[Finding]


def _silent(text: str) -> None:
    """Say nothing."""


def find_stations(
    log: Table,
    *,
    sampling_hz: float | None = None,
    min_seconds: float | None = None,
    trim_seconds: float | None = None,
    threshold: float | None = None,
    say: Callable[[str], None] = _silent,
) -> Stations:
    """The standstills of a log (`files.logs.read`) as the rows of a run.

    `sampling_hz` is the rate of a log without a column `time_s`; `threshold` in noise floors,
    found from the log where None. Errors: a log without time, without samples of a channel,
    or without standstills.
    """
    _check("min-seconds", min_seconds)
    _check("trim-seconds", trim_seconds)
    _check("threshold", threshold)
    findings: list[Finding] = []
    time = row_times(log, sampling_hz)
    traces, temperature = _traces(log, time, findings)
    findings += _time_findings(log, time, traces)
    say(f"looking for standstills in {len(time)} rows")
    activity = standstill.activity(list(traces.values()))
    if not activity.cells:
        raise _short(log, time)
    cell = float(activity.edge[1] - activity.edge[0])
    shortest = max(MIN_SECONDS, standstill.WINDOW * cell) if min_seconds is None else min_seconds
    trim = max(TRIM_SECONDS, cell) if trim_seconds is None else trim_seconds
    limits = _limits(activity, list(traces))
    value, stretch = threshold, None
    if value is None:
        least, highest = (shortest + 2 * trim) / cell, float(np.min(limits / activity.floor))
        value, stretch = standstill.choose_threshold(activity.value, int(np.ceil(least)), highest)
    found = standstill.standstills(activity, limits, value, shortest, trim)
    found = _with_samples(found, traces, findings)
    if not found.taken.any():
        raise _none(log, found, shortest)
    start, end = found.start[found.taken], found.end[found.taken]
    rows = _summaries(traces, start, end, say)
    columns = _columns(log, time, rows, start, end, temperature)
    findings += _findings(rows, found, float(time[-1] - time[0]))
    metadata = {**log.metadata, "log": log.source, "log_sha256": log.digest}
    table = Table(columns, metadata, log.source, range(1, len(start) + 1))
    return Stations(table, found, activity, value, stretch, shortest, trim, time, traces, findings)


def _check(name: str, value: float | None) -> None:
    if value is not None and not 0 <= value < float("inf"):
        raise InputError(f"--{name} must be a number of at least 0; got {shown(value)}.")


def _short(log: Table, time: Array) -> InputError:
    window = standstill.WINDOW
    return InputError(
        f"{log.source}: too short to find standstills in; got {len(time)} rows over "
        f"{time[-1] - time[0]:g} s. A channel needs at least {window * standstill.FEWEST} samples, over "
        f"{window * standstill.CELL:g} s. Is the log complete, and its time in seconds?"
    )


def _none(log: Table, found: Standstills, shortest: float) -> InputError:
    longest = float((found.end - found.start).max(initial=0.0))
    moving = int(np.count_nonzero(~found.short))
    seen = (
        f"{moving} long calm intervals move on slowly by more than a standstill can"
        if moving
        else f"the longest calm interval lasts {longest:.3g} s"
    )
    return InputError(
        f"{log.source}: no standstill of at least {shortest:g} s; {seen}. Stand still for longer, or "
        "lower --min-seconds, or set --threshold."
    )


def row_times(log: Table, sampling_hz: float | None) -> Array:
    """Seconds of each row: the column `time_s`, else from the rate of sampling."""
    stated = log.metadata.get("sampling_hz") if sampling_hz is None else sampling_hz
    if TIME in log.columns:
        time = numbers(log, TIME)
        for row in np.flatnonzero(np.isnan(time))[:1]:
            advice = "Fill it in, or remove the row."
            raise cell_error(log, TIME, int(row), f"must be filled in; got a blank cell. {advice}")
        for row in np.flatnonzero(np.diff(time) < 0)[:1]:
            got = f"{shown(float(time[row + 1]))} s after {shown(float(time[row]))} s"
            advice = "Sort the log by time, or split it where the clock was set back."
            raise cell_error(log, TIME, int(row) + 1, f"must not go back; got {got}. {advice}")
        _check_span(log, time)
        return time
    if stated is None:
        raise InputError(
            f"{log.source}: a log needs a column '{TIME}', or its rate of sampling; got neither. "
            "Add --sampling-hz 100, or a line '# sampling_hz = 100' above the column names."
        )
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0 < stated <= 1e9:
        raise InputError(
            f"{log.source}: sampling_hz must be a number above 0 and at most 1e9 Hz; got "
            f"{shown(stated)}. Correct it, or add --sampling-hz."
        )
    return np.arange(len(numbers(log, RAW[0]))) / float(stated)


def _check_span(log: Table, time: Array) -> None:
    """Refuse a clock that jumps so far that most of the log would be nothing."""
    cell = max(standstill.CELL, standstill.FEWEST * standstill.time_step(time))
    if time[-1] - time[0] > MOST_CELLS * cell:
        row = int(np.argmax(np.diff(time))) + 1
        got = f"{shown(float(time[row]))} s after {shown(float(time[row - 1]))} s"
        advice = "Correct the clock, split the log there, or write the time in seconds."
        raise cell_error(log, TIME, row, f"must not jump so far; got {got}. {advice}")


def _traces(
    log: Table, time: Array, findings: list[Finding]
) -> tuple[dict[str, Trace], Trace | None]:
    """The raw channels that have samples, and the temperature."""
    own = {name: _trace(log, time, name) for name in (*RAW, "temperature_c") if name in log.columns}
    magnetometer = [name for name in CHANNELS["magnetometer"] if name in own]
    if magnetometer and not any(len(own[name][0]) for name in magnetometer):
        text = "mx, my and mz are blank from end to end: the stations have no magnetometer."
        findings.append(Finding(id="no-magnetometer", text=text))
        own = {name: trace for name, trace in own.items() if name not in magnetometer}
    for name, (values, _) in own.items():
        if not len(values) and name in RAW:
            raise InputError(
                f"{log.source}, column '{name}': must have samples; every cell is blank. Check the "
                "logger and the order of the columns, or leave out the triad."
            )
        if name in RAW and np.ptp(own[name][1]) == 0:
            text = f"{name} reads {own[name][1][0]:g} from end to end: a dead channel?"
            findings.append(Finding(id="dead-channel", text=text))
    temperature = own.pop("temperature_c", None)
    if temperature is not None and not len(temperature[0]):
        text = "temperature_c is blank from end to end: the stations have no temperature."
        findings.append(Finding(id="no-temperature", text=text))
        temperature = None
    return own, temperature


def _trace(log: Table, time: Array, name: str) -> Trace:
    value = numbers(log, name)
    there = ~np.isnan(value)
    return (time, value) if there.all() else (time[there], value[there])


def _time_findings(log: Table, time: Array, traces: dict[str, Trace]) -> list[Finding]:
    """Gaps, times that occur twice in a channel, and columns that go nowhere."""
    findings = []
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > max(GAP * standstill.time_step(time), standstill.CELL))
    if gaps.size:
        widest = int(gaps[np.argmax(steps[gaps])])
        text = (
            f"{gaps.size} gap{'s' if gaps.size > 1 else ''} in time, the widest {steps[widest]:.3g} s after "
            f"{TIME} = {time[widest]:.10g} (line {log.lines[widest]}): no standstill goes across one."
        )
        findings.append(Finding(id="gaps", text=text))
    twice = {name: int(np.count_nonzero(np.diff(t) == 0)) for name, (t, _) in traces.items()}
    name = max(twice, key=lambda n: twice[n])
    if twice[name]:
        text = (
            f"{twice[name]} samples of {name} have the time of the one before: all are used. Is the "
            "time written with too few digits, or are rows doubled?"
        )
        findings.append(Finding(id="duplicate-time", text=text))
    spare = [name for name in log.columns if name not in READ]
    if spare:
        text = f"columns not used: {', '.join(spare[:10])}{' …' if spare[10:] else ''}."
        findings.append(Finding(id="columns-not-used", text=text))
    return findings


def _limits(activity: Activity, names: list[str]) -> Array:
    """The largest range of each channel that was looked at that can be rest, in its own unit."""
    cells = dict(zip((names[i] for i in activity.channels), activity.cells, strict=True))
    limits = []
    for name, own in cells.items():
        triad = next(kind for kind in CHANNELS.values() if name in kind)
        size = standstill.triad_size([cells[n].level for n in triad if n in cells])
        limits.append(standstill.rest_limit(own, size))
    return np.array(limits)


def _within(time: Array, start: Array, end: Array) -> tuple[Ints, Ints]:
    """First sample of each interval, and the one after its last."""
    return np.searchsorted(time, start), np.searchsorted(time, end, side="right")


def _with_samples(
    found: Standstills, traces: dict[str, Trace], findings: list[Finding]
) -> Standstills:
    """The same, without stations for which a slow channel has hardly a sample."""
    enough = np.ones(len(found.start), bool)
    for time, _ in traces.values():
        first, last = _within(time, found.start, found.end)
        enough &= last - first >= LEAST_SAMPLES
    poor = int(np.count_nonzero(found.taken & ~enough))
    if poor:
        text = (
            f"{poor} standstills left out: a channel has fewer than {LEAST_SAMPLES} samples there. "
            "Stand still for longer, or sample it faster."
        )
        findings.append(Finding(id="few-samples", text=text))
    return found._replace(taken=found.taken & enough, short=found.short | ~enough)


def _summaries(
    traces: dict[str, Trace], start: Array, end: Array, say: Callable[[str], None]
) -> dict[str, list[Summary]]:
    """What each channel read at each station."""
    summaries: dict[str, list[Summary]] = {}
    for name, (time, value) in traces.items():
        steps = np.abs(np.diff(value))
        resolution = float(np.min(steps, initial=np.inf, where=steps > 0))
        resolution = resolution if np.isfinite(resolution) else SMALLEST * abs(value[0]) or SMALLEST
        summaries[name] = []
        for first, last in zip(*_within(time, start, end), strict=True):
            own = slice(int(first), int(last))
            summaries[name].append(standstill.summarise(time[own], value[own], resolution))
            say(f"station {len(summaries[name])} of {len(start)}, {name}")
    return summaries


def _columns(
    log: Table, time: Array, rows: dict[str, list[Summary]], start: Array, end: Array,
    temperature: Trace | None,
) -> dict[str, Column]:  # fmt: skip
    """The run: labels and times, temperature, means, and what is known of each mean."""
    first, last = _within(time, start, end)
    columns: dict[str, Column] = {
        "station": [str(i) for i in range(1, len(start) + 1)],
        "start_s": time[first],
        "end_s": time[last - 1],
        "samples": np.asarray(last - first, float),
    }
    if temperature is not None:
        warmth = np.array(
            [_temperature(*temperature, *ends) for ends in zip(start, end, strict=True)]
        )
        columns |= {"temperature_c": warmth[:, 0], "drift_temperature_c": warmth[:, 1]}
    for prefix, part in PARTS.items():
        for name, found in rows.items():
            columns[prefix + name] = np.array([float(getattr(row, part)) for row in found])
    columns["drifting"] = [
        " ".join(n for n in rows if rows[n][i].drifts) for i in range(len(start))
    ]
    for name in (n for n in log.columns if n.startswith(("ref_", "sd_ref_")) and n in READ):
        value = numbers(log, name)
        columns[name] = np.array([_middle(value[a:b]) for a, b in zip(first, last, strict=True)])
    return columns


def _temperature(time: Array, value: Array, start: float, end: float) -> tuple[float, float]:
    """Mean over an interval and change over it; between samples along straight lines."""
    first, last = np.searchsorted(time, [start, end])
    if last - first >= standstill.WINDOW:
        found = standstill.summarise(time[first:last], value[first:last], 0.0)
        return found.mean, found.drift
    grid = np.linspace(start, end, 9)
    course = np.interp(grid, time, value)
    return float(course.mean()), float(np.polyfit(grid - start, course, 1)[0] * (end - start))


def _middle(value: Array) -> float:
    """The middle one of the cells that are filled in, NaN if none is."""
    there = np.sort(value[~np.isnan(value)])
    return float(there[(len(there) - 1) // 2]) if there.size else np.nan


def _findings(rows: dict[str, list[Summary]], found: Standstills, seconds: float) -> list[Finding]:
    """What the reader should know about the stations."""
    findings = []
    start, end = found.start[found.taken], found.end[found.taken]
    creeping = ~found.taken & ~found.short
    if creeping.any():
        where = ", ".join(
            f"{a:.1f}–{b:.1f} s"
            for a, b in zip(found.start[creeping], found.end[creeping], strict=True)
        )
        text = f"left out, as the tool moves slowly there: {where[:200]}."
        findings.append(Finding(id="slow-movement", text=text))
    if len(start) == 1 and end[0] - start[0] > 0.9 * seconds:
        text = "the log stands still from end to end: one station. A calibration needs several attitudes."
        findings.append(Finding(id="all-still", text=text))
    spikes = {
        n: sum(r.spikes for r in own) / sum(r.spikes + r.used for r in own)
        for n, own in rows.items()
    }
    name = max(spikes, key=lambda n: spikes[n])
    if spikes[name] > MANY_SPIKES:
        text = f"{100 * spikes[name]:.1f} % of the samples of {name} were left out as spikes: check the wiring."
        findings.append(Finding(id="spikes", text=text))
    for name, own in rows.items():
        drifting = [i for i, row in enumerate(own) if row.drifts]
        if drifting:
            worst = max(drifting, key=lambda i: abs(own[i].drift))
            text = (
                f"{name} drifts at {len(drifting)} of {len(own)} stations, most at station {worst + 1}: by "
                f"{own[worst].drift:.3g} over {end[worst] - start[worst]:.1f} s (noise of one sample "
                f"{own[worst].spread:.2g}). See the columns drift_."
            )
            findings.append(Finding(id="drift", text=text, station=str(worst + 1)))
    return findings
