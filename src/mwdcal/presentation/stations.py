"""Stations found in a log, on the screen and for machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.files.contract import RAW
from mwdcal.logs.stations import Stations
from mwdcal.presentation.noise import rounded
from mwdcal.presentation.numbers import files_written
from mwdcal.presentation.text import one_line, plural, table

MOST_LINES = 40
"""Stations of a table on screen."""


class StationsSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `stations`: an entry for each station, what was left, and the files written."""

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
    report: str


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
        **files,
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


def body(stations: Stations) -> str:
    """The result, for people."""
    lines = [one_line("   ".join(heading(stations))), "   ".join(search(stations)), ""]
    return "\n".join([*lines, _stations_table(stations)])


def screen(stations: Stations, files: dict[str, str]) -> str:
    """The result, the files that were written, and what to do next."""
    outputs = files_written(run=files["output"], picture=files["plot"], report=files["report"])
    return f"{body(stations)}\n{outputs}   next: {one_line(next_command(files['output']))}"


def shown_in(plot: Path | None, report: Path | None) -> str:
    """Where a log without a station is shown."""
    if plot or report:
        return files_written(picture=plot, report=report)
    return "--report or --plot shows the log."


def next_command(output: str) -> str:
    """The advice for the run."""
    return f"mwdcal calibrate {output} -o CAL.json"


def heading(stations: Stations) -> list[str]:
    """The log, and how much of it the stations are."""
    return [
        stations.table.source,
        *extent(stations),
        f"{plural(stations.table.count, 'station')}, {share(stations)} of the time",
    ]


def extent(stations: Stations) -> list[str]:
    """Rows and seconds of the log."""
    return [f"{len(stations.time)} rows", f"{_seconds(stations):.6g} s"]


def share(stations: Stations) -> str:
    """How much of the time of the log the stations are."""
    columns = stations.table.columns
    start, end = (np.asarray(columns.get(name, ()), float) for name in ("start_s", "end_s"))
    return f"{100 * float((end - start).sum()) / _seconds(stations):.0f} %"


def search(stations: Stations) -> list[str]:
    """How stations were searched for, and what was left."""
    short = sum(each["reason"] == "short" for each in left(stations))
    same = " (the same stations from {} to {})"
    stretch = same.format(*map(rounded, stations.stretch)) if stations.stretch else " (given)"
    return [
        f"threshold {rounded(stations.threshold)} noise floors{stretch}",
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
