"""What `mwdcal stations` asks for: kept apart from the work, so that help is quick."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import click


class Asked(TypedDict):
    """What was typed."""

    log: Path
    output: Path
    columns: str
    sampling_hz: float | None
    min_seconds: float | None
    trim_seconds: float | None
    threshold: float | None
    plot: Path | None
    decimal: str
    as_json: bool


_FILE = click.Path(path_type=Path)
_OPTIONS = (
    click.argument("log", type=_FILE),
    click.option(
        "-o", "--output", type=_FILE, required=True, metavar="STATIONS.csv",
        help="Run file to write; format by suffix.",
    ),
    click.option(
        "--columns", default="", metavar="NAMES",
        help="Columns of a text log without column names, such as time_s,ax,ay,az.",
    ),
    click.option(
        "--sampling-hz", type=float, metavar="HZ", help="Rate of a log without a column time_s."
    ),
    click.option(
        "--min-seconds", type=float, metavar="S",
        help="Shortest station, trimmed. Default: 1, or 15 samples of a slow log.",
    ),
    click.option(
        "--trim-seconds", type=float, metavar="S",
        help="What is cut off each end. Default: 1, or 3 samples of a slow log.",
    ),
    click.option(
        "--threshold", type=float, metavar="FLOORS",
        help="Movement that is still rest, in noise floors. Default: found from the log.",
    ),
    click.option(
        "--plot", type=_FILE, metavar="FILE.png|svg", help="Also draw what was taken and left."
    ),
    click.option(
        "--decimal", default=".", show_default=True, metavar="SIGN",
        help="Decimal sign of numbers in text files.",
    ),
    click.option("--json", "as_json", is_flag=True, help="Print the result as JSON."),
)  # fmt: skip


def standstill_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with its argument and options, in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
