"""`mwdcal plan`: what stations will give, before any is measured, and the best ones."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Unpack

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result


@options.command()
@click.option(
    "--plan",
    "plans",
    shell_complete=options.offers("plans"),
    multiple=True,
    metavar="NAME|FILE",
    help="A built-in plan, a TOML file of attitudes, or a run file; several are compared. "
    "Default: twenty-four-state; with --stations the candidates to choose from.",
)
@click.option(
    "--stations",
    type=options.Whole(1),
    metavar="N",
    help="The best N stations out of the candidates; with --accuracy the best for it.",
)
@click.option(
    "--accuracy",
    metavar="ANGLE_deg=VALUE",
    multiple=True,
    help="The fewest stations that give an accuracy (1σ), such as azimuth_deg=0.1 or azimuth=0.1, and enough "
    "redundancy; may be repeated.",
)
@click.option(
    "--measured",
    type=options.FILE,
    metavar="RUN",
    help="A run that is measured already: the best stations to add to it.",
)
@click.option(
    "--reach",
    metavar="ANGLE_deg=LOW:HIGH",
    multiple=True,
    help="Settings in reach of the stand, such as inclination_deg=0:120 or azimuth_deg=0:0; may be repeated. Default: "
    "every attitude.",
)
@options.preset(
    "--criterion",
    type=click.Choice(["D", "A", "I"]),
    default="I",
    help="What --stations optimises. D: all parameters together. A: each of them. I: the angles "
    "between 5 and 120° inclination.",
)
@options.preset(
    "--speed", type=float, default=5.0, metavar="DEG/S", help="Speed of the stand's axes."
)
@options.preset(
    "--settle", type=float, default=30.0, metavar="S", help="From the end of a move to its reading."
)
@click.option(
    "--soak",
    type=float,
    metavar="MIN",
    help="To reach a temperature; 0 without an oven. Default: 90, but 0 at one temperature from 10 to 35 °C.",
)
@options.tool(
    help="Tool profile: a name that mwdcal list profiles shows, or a TOML file. Or a calibration (JSON): its profile, "
    "its field, dip and gravity if the plan states none, and the noise that it estimated if the profile states none."
)
@click.option(
    "--serial",
    default="",
    metavar="S",
    help="Serial of the tool, for plan file and run sheet. Default: that of the calibration, or of the run measured.",
)
@options.fit_options("auto", "none", "datasheet", "the tolerances in the tool profile")
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    metavar="PLAN.csv",
    help="Also write the plan: a run file with blank readings.",
)
@options.report(
    old=("--html",), metavar="PLAN.html", help="Also write a run sheet to print and tick off."
)
@options.JSON
def command(
    plans: tuple[str, ...], stations: int | None, accuracy: tuple[str, ...], measured: Path | None,
    reach: tuple[str, ...], criterion: Literal["D", "A", "I"], speed: float, settle: float, soak: float | None,
    tool: str | None, serial: str, output: Path | None, report: Path | None, as_json: bool,
    **typed: Unpack[options.FitArguments],
) -> None:  # fmt: skip
    """Predict a calibration from planned stations: uncertainty, rank, accuracy, hours at the stand.

    Nothing is measured: a nominal tool with the noise and the stand of the profile or calibration.

    \b
    Example: mwdcal plan --stations 24 --tool servo -o plan.csv --report sheet.html
    Exit: 0 planned, 2 input cannot be read, 3 the stations cannot give a calibration.
    """
    from mwdcal.app import messages
    from mwdcal.app.inputs import prior_of
    from mwdcal.calibration.options import options_of
    from mwdcal.library import planning
    from mwdcal.presentation import plan as screen

    options.check_outputs([output], [tool, measured, *plans], page=report)
    with messages.bar("planning") as show:
        result = planning.plan(
            tool or "generic", plan=plans, stations=stations, measured=measured,
            accuracy_deg=screen.wanted_accuracy(accuracy), reach=screen.reach(reach), criterion=criterion,
            speed=speed, settle=settle, soak=soak, serial=serial,
            options=options_of(typed, prior_of(typed["prior"])[0]), progress=show,
        )  # fmt: skip
    if output:
        result.save(output)
    if report:
        result.report(report)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)
