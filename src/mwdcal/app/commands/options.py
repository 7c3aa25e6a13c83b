"""What `mwdcal stations` and `mwdcal compare` ask for: apart from the work, so that help is quick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


class AskedToCompare(TypedDict):
    """What was typed at `mwdcal compare`."""

    run: Path
    tool: str | None
    order: str
    seed: int
    parameters: bool
    report: Path | None
    decimal: str
    as_json: bool


Option = Callable[[Callable[..., Any]], Callable[..., Any]]
FILE = click.Path(path_type=Path)
DECIMAL = click.option(
    "--decimal", default=".", show_default=True, metavar="SIGN",
    help="Decimal sign of numbers in text files.",
)  # fmt: skip
JSON = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
TOOL = click.option(
    "--tool", metavar="NAME|FILE", help="Tool profile: a shipped name or a TOML file."
)
SEED = click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the swarm."
)
REPORT = click.option(
    "--report", type=FILE, metavar="R.html", help="Also write a self-contained HTML report."
)


_FIT: tuple[Option, ...] = (
    TOOL,
    click.option(
        "--method", default="joint", show_default=True, metavar="METHOD",
        help="joint: all evidence, weighted. least-squares: reference vectors only. swarm: the same "
        "by particle swarm. newton: Newton-Raphson on |g| and inclination. toolface-inclination: the "
        "accelerometer by angles alone. scalar: |g| and |b| alone.",
    ),
    SEED,
    click.option(
        "--paper-weights", is_flag=True,
        help="Sum the squares as the method's paper does, unweighted, instead of by their uncertainty.",
    ),
    click.option(
        "--robust", type=click.Choice(["huber", "student-t"]),
        help="Bound what a bad station can do: huber keeps a little of its pull, student-t loses it.",
    ),
    click.option(
        "--ignore", default="", metavar="NAMES",
        help="What may not be used at any station: gravity, field, dip, or several with commas.",
    ),
    click.option(
        "--estimate", default="", metavar="NAMES",
        help="Errors of the stand to find as well: azimuth-zero, inclination-zero, tilt, or several with "
        "commas.",
    ),
    click.option(
        "--model", type=click.Choice(["polynomial", "factors"]),
        help="Default: polynomial at order 0, factors above.",
    ),
    click.option(
        "--parameters", type=click.Choice(["12", "9", "6"]),
        help="Per triad at one temperature; default 12. 9: the sensor frame, without mounting rotation. "
        "6: scale and bias alone.",
    ),
)  # fmt: skip


def fit_options(order: str, nonlinearity: str, prior: str, known: str) -> tuple[Option, ...]:
    """The options of `calibrate` and `fleet` that say how to fit.

    With the defaults of two of them, and what a prior may be, as metavar and in words.
    """
    return (
        *_FIT,
        click.option("--prior", metavar=prior, help=f"What is known beforehand: {known}."),
        click.option(
            "--order", default=order, show_default=True, metavar="0…3|auto",
            help="Order of temperature terms. auto: of each triad, the terms that noise does not explain.",
        ),
        click.option(
            "--nonlinearity", default=nonlinearity, show_default=True, metavar="auto|none|NAMES",
            help="Own-axis quadratic and cubic terms. auto: of the triads whose profile declares "
            "them, where the run speaks for them. NAMES: accelerometer, magnetometer, or both with "
            "a comma.",
        ),
    )  # fmt: skip


COLUMN_NAMES = click.option(
    "--columns", default="", metavar="NAMES",
    help="Columns of a text log without column names, such as time_s,ax,ay,az.",
)  # fmt: skip
SAMPLING_HZ = click.option(
    "--sampling-hz", type=float, metavar="HZ", help="Rate of the log; wins over its column time_s."
)
_OPTIONS = (
    click.argument("log", type=FILE),
    click.option(
        "-o", "--output", type=FILE, required=True, metavar="STATIONS.csv",
        help="Run file to write; format by suffix.",
    ),
    COLUMN_NAMES,
    SAMPLING_HZ,
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
        "--plot", type=FILE, metavar="FILE.png|svg", help="Also draw what was taken and left."
    ),
    DECIMAL,
    JSON,
)  # fmt: skip
_CALIBRATE: tuple[Option, ...] = (
    click.argument("run", type=FILE),
    click.option(
        "-o", "--output", type=FILE, required=True, metavar="CAL.json",
        help="Calibration file to write.",
    ),
    *fit_options(
        "auto", "auto", "CAL.json|datasheet",
        "a previous calibration of this tool, with its covariance, or the tolerances in the tool profile",
    ),
    click.option(
        "--exclude", multiple=True, metavar="STATION", help="Leave a station out; may be repeated."
    ),
    REPORT,
    DECIMAL,
    JSON,
)  # fmt: skip
_COMPARE = (
    click.argument("run", type=FILE),
    TOOL,
    click.option(
        "--order", type=click.Choice(["0", "1", "2", "3", "auto"]), default="auto",
        show_default=True, help="Order of temperature terms, the same for all methods.",
    ),
    SEED,
    click.option(
        "--parameters", is_flag=True, help="Print the parameters of every method as well."
    ),
    REPORT,
    DECIMAL,
    JSON,
)  # fmt: skip


def calibration_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command `calibrate` with its argument and options, in this order."""
    return taking(_CALIBRATE, command)


def standstill_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command `stations` with its argument and options, in this order."""
    return taking(_OPTIONS, command)


def comparison_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command `compare` with its argument and options, in this order."""
    return taking(_COMPARE, command)


def taking(
    options: Sequence[Callable[..., Any]], command: Callable[..., Any]
) -> Callable[..., Any]:
    """A command with its arguments and options, in this order."""
    for option in reversed(options):
        command = option(command)
    return command
