"""What `mwdcal fleet` asks for: kept apart from the work, so that help is quick."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import click

from mwdcal.app.commands.options import FILE, JSON, Option, fit_options, taking


class Asked(TypedDict):
    """What was typed."""

    runs: Path
    output: Path
    tool: str | None
    method: str
    seed: int
    paper_weights: bool
    robust: str | None
    prior: str | None
    ignore: str
    estimate: str
    model: str | None
    parameters: str | None
    order: str
    nonlinearity: str
    workers: int | None
    scheduler: str | None
    report: Path | None
    as_json: bool


_OPTIONS: tuple[Option, ...] = (
    click.argument("runs", type=FILE),
    click.option(
        "-o", "--output", type=FILE, required=True, metavar="CALS.parquet",
        help="Table of calibrations to write, one row per tool.",
    ),
    *fit_options("0", "none", "datasheet", "the tolerances in the tool profile"),
    click.option(
        "--workers", type=click.IntRange(1), metavar="N",
        help="Processes on this machine. Default: one per core.",
    ),
    click.option(
        "--scheduler", metavar="ADDRESS",
        help="Use the workers of this Dask scheduler instead, such as tcp://host:8786.",
    ),
    click.option(
        "--report", type=FILE, metavar="FLEET.html", help="Also write a summary page of the fleet."
    ),
    JSON,
)  # fmt: skip


def fleet_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with its argument and options, in this order."""
    return taking(_OPTIONS, command)
