"""Stations found in a log, on the screen and for machines."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from mwdcal.app.text import one_line, plural, table
from mwdcal.calibration.record import Finding
from mwdcal.files.contract import RAW
from mwdcal.logs.stations import Stations

MOST_LINES = 40
"""Stations of a table on screen."""


class StationsSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `stations` prints: an entry for each station, what was left, and the files written."""

    log: str
    rows: int
    seconds: float
    threshold: float
    stretch: tuple[float, float] | None
    min_seconds: float
    trim_seconds: float
    stations: list[dict[str, float | str | bool | None]]
    left: list[dict[str, float | str]]
    findings: list[Finding]
    output: str
    plot: str


def summary(stations: Stations, files: dict[str, str]) -> StationsSummary:
    """The result for machines."""
    columns = stations.table.columns
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return StationsSummary(
        log=stations.table.source,
        rows=len(stations.time),
        seconds=_seconds(stations),
        threshold=stations.threshold,
        stretch=stations.stretch,
        min_seconds=stations.min_seconds,
        trim_seconds=stations.trim_seconds,
        stations=[dict(zip(columns, row, strict=True)) for row in rows],
        left=left(stations),
        findings=stations.findings,
        output=files["output"],
        plot=files["plot"],
    )


def left(stations: Stations) -> list[dict[str, Any]]:
    """Intervals that look still and were not taken."""
    intervals = stations.intervals
    columns = (intervals.start, intervals.end, intervals.short)
    rows = zip(*(column[~intervals.taken].tolist() for column in columns), strict=True)
    return [
        {"start_s": start, "end_s": end, "reason": "short" if short else "moves slowly"}
        for start, end, short in rows
    ]


def _seconds(stations: Stations) -> float:
    """Duration of the log."""
    return float(stations.time[-1] - stations.time[0])


def screen(stations: Stations, files: dict[str, str]) -> str:
    """What was found, for people."""
    picture = f"   {files['plot']} (picture)" if files["plot"] else ""
    after = f"next: mwdcal calibrate {files['output']} -o CAL.json"
    lines = [
        one_line("   ".join(_heading(stations))),
        "   ".join(_search(stations)),
        "",
        _stations_table(stations),
        one_line(f"wrote {files['output']}{picture}   {after}"),
    ]
    return "\n".join(lines)


def _heading(stations: Stations) -> list[str]:
    """The log, and how much of it the stations are."""
    whole = _seconds(stations)
    start, end = (np.asarray(stations.table.columns[name]) for name in ("start_s", "end_s"))
    share = 100 * float((end - start).sum()) / whole
    return [
        stations.table.source,
        f"{len(stations.time)} rows",
        f"{whole:.6g} s",
        f"{plural(stations.table.count, 'station')}, {share:.0f} % of the time",
    ]


def _search(stations: Stations) -> list[str]:
    """How stations were searched for, and what was left."""
    short = sum(each["reason"] == "short" for each in left(stations))
    same = " (the same stations from {:.3g} to {:.3g})"
    stretch = same.format(*stations.stretch) if stations.stretch else " (given)"
    return [
        f"threshold {stations.threshold:.3g} noise floors{stretch}",
        f"at least {stations.min_seconds:g} s after {stations.trim_seconds:g} s trimmed off each end",
        f"left: {short} too short, {len(left(stations)) - short} moving slowly",
    ]


def _stations_table(stations: Stations) -> str:
    columns = stations.table.columns
    names = [name for name in RAW if name in columns]
    titles = {"start_s": "start s", "end_s": "end s", "samples": "samples", "temperature_c": "°C"}
    plain = {name: title for name, title in titles.items() if name in columns}
    rows = []
    for i in range(min(stations.table.count, MOST_LINES)):
        numbers = [f"{float(columns[n][i]):.{0 if n == 'samples' else 2}f}" for n in plain]
        values = [_to_sd(float(columns[n][i]), float(columns[f"sd_{n}"][i])) for n in names]
        rows.append([str(i + 1), *numbers, *values, str(columns["drifting"][i])])
    more = stations.table.count - len(rows)
    header = ["station", *plain.values(), *names, "drifts"]
    return table(rows, header) + (f"\n… and {more} more" if more > 0 else "")


def _to_sd(value: float, sd: float) -> str:
    """A mean to two digits of its standard uncertainty."""
    if not 0 < sd < np.inf:
        return f"{value:.7g}"
    digits = max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f}"
