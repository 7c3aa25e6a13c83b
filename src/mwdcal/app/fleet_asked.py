"""What `mwdcal fleet` asks for: kept apart from the work, so that help is quick."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import click

from mwdcal.app.asked import FILE, JSON, taking


class Asked(TypedDict):
    """What was typed."""

    runs: Path
    output: Path
    tool: str | None
    method: str
    order: int
    model: str | None
    seed: int
    workers: int | None
    scheduler: str | None
    report: Path | None
    as_json: bool


_OPTIONS = (
    click.argument("runs", type=FILE),
    click.option(
        "-o", "--output", type=FILE, required=True, metavar="CALS.parquet",
        help="Table of calibrations to write, one row per tool.",
    ),
    click.option(
        "--tool", metavar="NAME|FILE", help="Tool profile: a shipped name or a TOML file."
    ),
    click.option(
        "--method", default="joint", show_default=True, metavar="METHOD", help="As of `calibrate`."
    ),
    click.option(
        "--order", type=click.IntRange(0, 3), default=0, show_default=True,
        help="Order of temperature terms, the same for all tools.",
    ),
    click.option(
        "--model", type=click.Choice(["polynomial", "factors"]),
        help="Default: polynomial at order 0, factors above.",
    ),
    click.option(
        "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the swarm."
    ),
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
