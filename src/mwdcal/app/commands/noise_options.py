"""What `mwdcal noise` asks for: kept apart from the work, so that help is quick."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import click

from mwdcal.app.commands.options import COLUMN_NAMES, DECIMAL, FILE, JSON, SAMPLING_HZ, taking


class Asked(TypedDict):
    """What was typed."""

    log: Path
    tool: str | None
    columns: str
    sampling_hz: float | None
    start: float | None
    end: float | None
    station_seconds: float | None
    modified: bool
    plot: Path | None
    report: Path | None
    decimal: str
    as_json: bool


_OPTIONS = (
    click.argument("log", type=FILE),
    click.option(
        "--tool", metavar="NAME|FILE",
        help="Tool profile with the scales: figures also in g and nT.",
    ),
    COLUMN_NAMES,
    SAMPLING_HZ,
    click.option(
        "--from", "start", type=float, metavar="S", help="Use the log from so many seconds on."
    ),
    click.option("--to", "end", type=float, metavar="S", help="Use it up to so many seconds."),
    click.option(
        "--station-seconds", type=float, metavar="S",
        help="Duration of a station. Default: 30, or a tenth of a shorter log.",
    ),
    click.option("--modified", is_flag=True, help="Show modified Allan deviations."),
    click.option(
        "--plot", type=FILE, metavar="FILE.png|svg", help="Also draw the Allan deviations."
    ),
    click.option(
        "--report", type=FILE, metavar="R.html", help="Also write a self-contained HTML report."
    ),
    DECIMAL,
    JSON,
)  # fmt: skip


def noise_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command `noise` with its argument and options, in this order."""
    return taking(_OPTIONS, command)
