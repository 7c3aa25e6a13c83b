"""Stations from a continuous log: its standstills, each as one row of a run file.

Channels may have rates of their own (blank cells in one table), and the temperature may be
slower still: it never decides what stands still. See `standstill` for the method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS, RAW, TEMPERATURE, Range, is_angle
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table, numbers
from mwdcal.files.logs import READ, TIME, Say, StoredColumns, silent
from mwdcal.files.synonyms import unused
from mwdcal.geometry.circle import unrolled
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.logs import standstill
from mwdcal.logs.regular import SECONDS, check_argument, row_times, unlikely_seconds
from mwdcal.logs.standstill import Activity, Slow, Standstills, Trace, Traces
from mwdcal.logs.station_means import (
    ALONE,
    ChannelMean,
    Rows,
    about,
    correlated,
    count,
    dot,
    listed,
    noisy_rests,
    summarise,
    summarise_alike,
    widened,
)

MIN_SECONDS, TRIM_SECONDS = 1.0, 1.0
"""Defaults for a fast log; one sampled slowly needs a window, and a cell, respectively."""
LEAST_SAMPLES = 3
"""Fewest samples of each channel at a station."""
GAP = 5.0
"""Times the usual step between samples that are a gap."""
THRESHOLDS = Range(0.0, 1e15, "noise floors")
"""Accepted thresholds."""
REPORTED = 1.2
"""Factor by which correlated noise widens most means of a triad before it is reported."""
SMALLEST_RESOLUTION = 1e-12
"""Resolution of a channel that never changes, as a share of its reading."""
SUMMARIES = {"": "mean", "sd_": "sd", "spread_": "spread", "drift_": "drift", "samples_": "used"}
"""Columns per channel: prefix, and what of its summary stands there."""


@dataclass(frozen=True, eq=False)
class Stations:
    """Contents of a log.

    Attributes:
        table: the run, one row per station.
        intervals: all that look still, with what became of each.
        activity: how much each moment moves, in noise floors.
        threshold: activity up to which it stands still.
        stretch: thresholds from which to which the standstills are the same ones; None
            where the threshold was given.
        min_seconds, trim_seconds: as used.
        time: of each row of the log, s.
        traces: the channels that have samples.
        findings: what is reported beside the stations.
    """

    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    report: ClassVar[Callable[..., None]]
    """As of `Calibration`."""

    table: Table
    intervals: Standstills
    activity: Activity
    threshold: float
    stretch: tuple[float, float] | None
    min_seconds: float
    trim_seconds: float
    time: Array
    traces: Traces
    findings: list[Finding]


class StandstillError(InputError):
    """A log without a standstill; `analysis` is that of the log, with an empty table."""

    def __init__(self, text: str, analysis: Stations) -> None:
        super().__init__(text)
        self.analysis = analysis


def find_stations(
    log: Table,
    *,
    sampling_hz: float | None = None,
    min_seconds: float | None = None,
    trim_seconds: float | None = None,
    threshold: float | None = None,
    say: Say = silent,
) -> Stations:
    """The standstills of a log (`files.logs.read`) as the rows of a run.

    `sampling_hz` is the rate of a log without a column `time_s`; `threshold` in noise floors,
    found from the log where None. Errors: a log without time, without samples of a channel,
    or without standstills.
    """
    check_argument("min_seconds", min_seconds, SECONDS)
    check_argument("trim_seconds", trim_seconds, SECONDS)
    check_argument("threshold", threshold, THRESHOLDS)
    findings: list[Finding] = []
    time = row_times(log, sampling_hz)
    traces = _traces(log, time, findings)
    temperature = _warmth(log, time, findings)
    findings += _time_findings(log, time, traces, sampling_hz)
    say(f"looking for standstills in {len(time)} rows")
    activity = standstill.activity(traces)
    if not activity.cells:
        raise _short(log, time, traces)
    cell = activity.cell
    shortest = max(MIN_SECONDS, standstill.WINDOW * cell) if min_seconds is None else min_seconds
    trim = max(TRIM_SECONDS, cell) if trim_seconds is None else trim_seconds
    if all(finding.id != "gaps" for finding in findings):  # the times of the rows show none
        findings += _torn(activity)
    limits, slow = _limits(activity, traces)
    value, stretch = _threshold(activity, limits, threshold, shortest + 2 * trim)
    standstills = standstill.standstills(activity, limits, value, shortest, trim, slow)
    standstills = _with_samples(standstills, time, traces, findings)
    findings += noisy_rests(activity, limits, standstills, value, shortest + 2 * trim)
    stations = Stations(
        Table({}, log.metadata, log.source), standstills, activity, value, stretch, shortest, trim, time,
        traces, findings,
    )  # fmt: skip
    if not standstills.taken.any():
        raise StandstillError(_none(stations), stations)
    rows = _summaries(traces, *standstills.stations, findings, say)
    warmth = _temperatures(temperature, *standstills.stations, findings)
    columns = _columns(log, time, warmth, rows, *standstills.stations)
    findings += about(rows, standstills, float(time[-1] - time[0]) - 2 * trim)
    metadata = {**log.metadata, "log": log.source, "log_sha256": log.digest}
    lines = range(1, len(columns["station"]) + 1)
    return replace(stations, table=Table(columns, metadata, log.source, lines))


def _threshold(
    activity: Activity, limits: Array, given: float | None, least: float
) -> tuple[float, tuple[float, float] | None]:
    """The threshold, and the stretch over which it hardly matters; None where it was given.

    `least` is the shortest standstill, s. Where nothing lasts as long, the threshold is the highest
    one at which every channel can be at rest.
    """
    if given is not None:
        return given, None
    highest = float(np.min(limits / activity.floor))
    cells = int(np.ceil(least / activity.cell))
    value, stretch = standstill.choose_threshold(activity.value, cells, highest)
    return (highest, None) if np.isnan(value) else (value, stretch)


def _short(log: Table, time: Array, traces: Traces) -> InputError:
    if len(time) > 1 and not any(np.ptp(value) for _, value in traces.values()):
        return InputError(
            f"{log.source}: no channel ever changes, so rest and movement cannot be told apart. "
            "Check the logger and the order of the columns."
        )
    window = standstill.WINDOW
    return InputError(
        f"{log.source}: too short to find standstills in; got {count(len(time), 'row')} over "
        f"{time[-1] - time[0]:g} s. A channel needs at least {window * standstill.FEWEST} samples, over "
        f"{window * standstill.CELL:g} s. Is the log complete, and its time in seconds?"
    )


def _none(stations: Stations) -> str:
    """The message of a log without a station."""
    longest = float((stations.intervals.end - stations.intervals.start).max(initial=0.0))
    moving = int(np.count_nonzero(~stations.intervals.short))
    trimmed = f"after {stations.trim_seconds:g} s trimmed off each end"
    if moving:
        word = "interval moves" if moving == 1 else "intervals move"
        seen = f"{moving} long calm {word} slowly, by more than a tool at rest can"
    elif longest:
        seen = f"the longest calm interval lasts {longest:.3g} s {trimmed}"
    else:
        seen = f"nothing is left {trimmed}"
    return (
        f"{stations.table.source}: no standstill of at least {stations.min_seconds:g} s; {seen}. Stand still "
        "for longer, lower `min_seconds` or `trim_seconds`, or set `threshold`."
    )


def _traces(log: Table, time: Array, findings: list[Finding]) -> Traces:
    """The raw channels that have samples."""
    traces = _traces_of(log, time, [name for name in RAW if name in log.columns])
    magnetometer = [name for name in CHANNELS["magnetometer"] if name in traces]
    if magnetometer and not any(len(traces[name][0]) for name in magnetometer):
        text = "mx, my and mz are blank from end to end: the stations have no magnetometer."
        findings.append(Finding(id="no-magnetometer", text=text))
        traces = _traces_of(log, time, CHANNELS["accelerometer"])
    for name, (_, value) in traces.items():
        if not len(value):
            raise InputError(
                f"{log.source}, column '{name}': must have samples; every cell is blank. Check the "
                "logger and the order of the columns, or leave out the triad."
            )
        if np.ptp(value) == 0:
            text = f"{name} reads {value[0] + 0.0:g} from end to end: a dead channel?"
            findings.append(Finding(id="dead-channel", text=text))
    return traces


class _StoredTraces(Mapping[str, Trace]):
    """Channels of a log whose columns are not in memory: each is read when it is asked for."""

    def __init__(self, log: Table, time: Array, names: Sequence[str]) -> None:
        self._log, self._names = log, names
        self._time, self._clock = time, standstill.distinct(time)

    def __getitem__(self, name: str) -> Trace:
        if name not in self._names:
            raise KeyError(name)
        return _trace(self._log, self._time, self._clock, name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _traces_of(log: Table, time: Array, names: Sequence[str]) -> Traces:
    """Channels of a log; in memory if its columns are."""
    traces = _StoredTraces(log, time, names)
    return traces if isinstance(log.columns, StoredColumns) else dict(traces)


def _trace(log: Table, time: Array, clock: Array, name: str) -> Trace:
    """Times and values where there are values; times that are equal are spread, as `clock` has those of all rows."""
    value = numbers(log, name)
    blank = np.isnan(value)
    if not blank.any():
        return clock, value
    there = ~blank
    return standstill.distinct(time[there]), value[there]


def _warmth(log: Table, time: Array, findings: list[Finding]) -> Trace | None:
    """The temperatures that are possible; others, such as -999, are left out and reported."""
    if "temperature_c" not in log.columns:
        return None
    time, value = _trace(log, time, standstill.distinct(time), "temperature_c")
    fine = ~TEMPERATURE.outside(value)
    if not fine.all():
        wrong = np.flatnonzero(~fine)
        text = (
            f"{wrong.size} of {len(value)} values of temperature_c are not between {TEMPERATURE.low:g} "
            f"and {TEMPERATURE.high:g} °C, such as {value[wrong[0]]:g}: left out."
        )
        findings.append(Finding(id="impossible-temperature", text=text))
    if not fine.any():
        text = "temperature_c is blank from end to end: the stations have no temperature."
        findings.append(Finding(id="no-temperature", text=text))
        return None
    return (time, value) if fine.all() else (time[fine], value[fine])


def _time_findings(
    log: Table, time: Array, traces: Traces, sampling_hz: float | None
) -> Iterator[Finding]:
    """Gaps, times that occur twice in a channel or are not used, their unit, and spare columns."""
    if TIME in log.columns and sampling_hz is not None:
        text = f"`sampling_hz` {sampling_hz:g} was given: the column '{TIME}' is not used."
        yield Finding(id="time-not-used", text=text)
    elif TIME in log.columns:
        yield from unlikely_seconds(time)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > max(GAP * standstill.time_step(time), standstill.CELL))
    if gaps.size:
        widest = int(gaps[np.argmax(steps[gaps])])
        text = (
            f"{count(gaps.size, 'gap')} in time, the widest {steps[widest]:.3g} s after "
            f"{TIME} = {time[widest]:.10g} (line {log.lines[widest]}): no standstill goes across one."
        )
        yield Finding(id="gaps", text=text)
    if not np.all(steps > 0):
        yield from _equal_times(log, time, list(traces))
    yield from unused_columns(unused(list(log.columns), READ))


def _torn(activity: Activity) -> Iterator[Finding]:
    """Stretches in which a channel has no samples, as gaps."""
    torn = {}
    for name, channel in activity.cells.items():
        between = np.append(channel.start[1:] - channel.end[:-1], 0.0)
        limit = max(activity.cell, standstill.FEWEST * channel.step)
        torn[name] = np.flatnonzero(channel.torn | (between > limit))
    name = max(torn, key=lambda n: torn[n].size)
    if torn[name].size:
        at = f"{activity.cells[name].start[torn[name][0]]:.10g} s"
        gaps = (
            f"{name} has {count(torn[name].size, 'gap')} of several samples, the first after {at}"
        )
        yield Finding(id="gaps", text=f"{gaps}: no standstill goes across one.")


def _equal_times(log: Table, time: Array, names: list[str]) -> Iterator[Finding]:
    """Samples of a channel at one time; rows of different channels may share theirs."""
    filled = {name: time[~np.isnan(numbers(log, name))] for name in names}
    twice = {name: int(np.count_nonzero(np.diff(times) == 0)) for name, times in filled.items()}
    name = max(twice, key=twice.__getitem__)
    if twice[name]:
        have = "has" if twice[name] == 1 else "have"
        text = (
            f"{count(twice[name], 'sample')} of {name} {have} the time of the one before: all are used, spread "
            "over the step. Is the time written with too few digits, or are rows doubled?"
        )
        yield Finding(id="duplicate-time", text=text)


def _limits(activity: Activity, traces: Traces) -> tuple[Array, list[Slow]]:
    """The largest range that can be rest of each channel looked at, and the others that can step."""
    limits, slow = [], []
    for triad in CHANNELS.values():
        channels = {
            name: activity.cells.get(name) or standstill.cells_of(*traces[name], standstill.CELL)
            for name in triad
            if name in traces
        }
        size = standstill.triad_size([each.level for each in channels.values()])
        for name, channel in channels.items():
            if name in activity.cells:
                limits.append(standstill.rest_limit(channel, size))
            else:
                slow.append(Slow(*traces[name], standstill.step_limit(channel, size)))
    return np.array(limits), slow


def _within(time: Array, start: Array, end: Array) -> tuple[Ints, Ints]:
    """First sample of each interval, and the one after its last."""
    return np.searchsorted(time, start), np.searchsorted(time, end, side="right")


def _with_samples(
    standstills: Standstills, rows: Array, traces: Traces, findings: list[Finding]
) -> Standstills:
    """The same, without stations for which a slow channel, or the log, has hardly a sample."""
    span = standstills.start, standstills.end
    places = [_within(rows, *span), *(_within(traces[name][0], *span) for name in traces)]
    enough = np.all([last - first >= LEAST_SAMPLES for first, last in places], axis=0)
    poor = int(np.count_nonzero(standstills.taken & ~enough))
    if poor:
        text = (
            f"{count(poor, 'standstill')} left out: a channel has fewer than {LEAST_SAMPLES} samples there. "
            "Stand still for longer, or sample it faster."
        )
        findings.append(Finding(id="few-samples", text=text))
    return standstills._replace(taken=standstills.taken & enough, short=standstills.short | ~enough)


def _summaries(traces: Traces, start: Array, end: Array, findings: list[Finding], say: Say) -> Rows:
    """Readings of each channel at each station."""
    summaries: Rows = {}
    for name in traces:
        say(f"means of {name} at {count(len(start), 'station')}")
        summaries[name] = _summary(*traces[name], start, end)
    return _all_widened(summaries, findings)


def means_of(rests: Mapping[str, Sequence[Trace]], steps: Mapping[str, float]) -> Rows:
    """Readings of each channel at its standstills, by their samples and the steps of readings; as for a log.

    A step is 0 where none is known.
    """
    rows: Rows = {}
    for name, each in rests.items():
        fine = SMALLEST_RESOLUTION * (abs(float(each[0][1][0])) or 1.0)
        rows[name] = summarise(each, max(steps.get(name, 0.0), fine))
    return _all_widened(rows, [])


def _all_widened(rows: Rows, findings: list[Finding]) -> Rows:
    """Readings of all channels, triad by triad, known less well where their noise is correlated."""
    wider = dict(rows)
    for triad in CHANNELS.values():
        wider |= _widened({n: rows[n] for n in triad if n in rows}, findings)
    return wider


def _summary(time: Array, value: Array, start: Array, end: Array) -> ChannelMean:
    """Readings of a channel at each station."""
    resolution = standstill.resolution(value) or SMALLEST_RESOLUTION * abs(float(value[0]))
    places = zip(*_within(time, start, end), strict=True)
    rests = [(time[a:b], value[a:b]) for a, b in places]
    return summarise(rests, resolution or SMALLEST_RESOLUTION)


def _widened(triad: Rows, findings: list[Finding]) -> Rows:
    """Readings of a triad's channels, known less well where their noise is correlated."""
    variances, plain = correlated([*triad.values()])
    each = zip(triad.items(), variances.tolist(), strict=True)
    wider = {name: widened(channel, variance) for (name, channel), variance in each}
    grown = [wider[name].sd > REPORTED * triad[name].sd for name in triad]
    if plain and np.mean(grown) > 0.5:
        text = (
            f"noise of {', '.join(triad)} is correlated over seconds: the halves of standstills differ by more "
            "than their samples explain. sd_ is widened to what they tell; with 1/f noise it is still too "
            "small. Stand still for longer, or state the noise in the tool profile."
        )
        findings.append(Finding(id="correlated-noise", text=text))
    return wider


def _columns(
    log: Table, time: Array, warmth: dict[str, Column], rows: Rows, start: Array, end: Array
) -> dict[str, Column]:
    """The run: labels and times, temperatures, means, and what is known of each mean."""
    first, last = _within(time, start, end)
    columns: dict[str, Column] = {
        "station": [str(i) for i in range(1, len(start) + 1)],
        "start_s": time[first],
        "end_s": time[last - 1],
        "samples": np.asarray(last - first, float),
        **warmth,
    }
    for prefix, part in SUMMARIES.items():
        for name, row in rows.items():
            columns[prefix + name] = np.asarray(getattr(row, part), float)
    columns["drifting"] = [
        " ".join(n for n in rows if rows[n].drifts[i]) for i in range(len(start))
    ]
    for name in (n for n in log.columns if n.startswith(("ref_", "sd_ref_")) and n in READ):
        value, turns = numbers(log, name), is_angle(name)
        rests = zip(first, last, strict=True)
        columns[name] = np.array([_middle(value[a:b], turns) for a, b in rests])
    return columns


def _temperatures(
    temperature: Trace | None, start: Array, end: Array, findings: list[Finding]
) -> dict[str, Column]:
    """The temperature of each station, and its change; blank where none was taken nearby."""
    if temperature is None:
        return {}
    warmth = _warmth_of(*temperature, start, end, GAP * standstill.time_step(temperature[0]))
    blank = np.flatnonzero(np.isnan(warmth[:, 0])) + 1
    if blank.size:
        text = (
            f"{count(blank.size, 'station')} without a temperature nearby ({listed(blank)}): blank "
            "there. Fill temperature_c in, or leave these stations out."
        )
        findings.append(Finding(id="no-temperature-nearby", text=text))
    return {"temperature_c": warmth[:, 0], "drift_temperature_c": warmth[:, 1]}


def _warmth_of(time: Array, value: Array, start: Array, end: Array, lag: float) -> Array:
    """Mean over each interval (k,) and change over it (k, 2); between samples along straight lines.

    Singular: NaN where no sample is within the interval, or within `lag` seconds of it.
    """
    first, last = np.searchsorted(time, start), np.searchsorted(time, end)
    grid = np.linspace(start, end, 9, axis=-1)
    course, clock = np.interp(grid, time, value), grid - grid.mean(-1, keepdims=True)
    mean = course.mean(-1)
    slope = dot(clock, course - mean[:, None]) / dot(clock, clock)
    warmth = np.stack([mean, slope * (end - start)], -1)
    padded = np.concatenate([[-np.inf], time, [np.inf]])
    away = np.minimum(start - padded[first], padded[last + 1] - end) > lag
    warmth[(last == first) & away] = np.nan
    many = np.flatnonzero(last - first >= standstill.WINDOW)
    if many.size:
        rests = [(time[a:b], value[a:b]) for a, b in zip(first[many], last[many], strict=True)]
        means = summarise_alike(rests, 0.0, ALONE)
        warmth[many] = np.stack([means.mean, means.drift], -1)
    return warmth


def _middle(value: Array, turns: bool) -> float:
    """The middle one of the cells that are filled in, NaN if none is; of angles, which turn, on their circle."""
    there = value[~np.isnan(value)]
    if not there.size:
        return np.nan
    order = np.argsort(unrolled(there) if turns else there, kind="stable")
    return float(there[order[(len(there) - 1) // 2]])
