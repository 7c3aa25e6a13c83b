"""`mwdcal registry drift`: how a tool, or every tool, changes from calibration to calibration."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result


@options.command()
@click.argument("serial", required=False)
@options.DATABASE
@click.option(
    "--limit",
    "limits",
    multiple=True,
    metavar="ANGLE_deg=VALUE",
    help="What the 95 % accuracy of an angle may be until the next calibration, such as inclination_deg=0.1. "
    "Default: the errors that the limits profile roll-test allows.",
)
@click.option(
    "--level",
    type=click.FloatRange(0.001, 0.2),
    default=0.01,
    show_default=True,
    help="Share of unchanged tools that are called changed.",
)
@click.option(
    "--today",
    type=click.DateTime(["%Y-%m-%d"]),
    metavar="DATE",
    help="Day by which tools are overdue. Default: today.",
)
@click.option("--html", type=options.FILE, metavar="D.html", help="Also write a page.")
@options.JSON
def command(
    serial: str | None, database: str, limits: tuple[str, ...], level: float,
    today: datetime | None, html: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Compare the calibrations of the tool SERIAL, or of every tool: did it change, and when is it due?

    Changes are tested against the stated uncertainties, all parameters and calibrations at once. The next due
    date follows from the random walk of the parameters, learnt from the tool and others of its type.

    \b
    Example: mwdcal registry drift SIM-0001 --html drift.html --database tools.sqlite
    Example: mwdcal registry drift --limit inclination_deg=0.1 --html fleet.html --database tools.sqlite
    Exit: 0 compared, 2 there is no such tool, or the registry cannot be opened, 3 a document was altered.
    """
    from mwdcal.app.progress import bar
    from mwdcal.files.formats import atomic
    from mwdcal.library import drifts
    from mwdcal.pages.records import drift as pages
    from mwdcal.registry.store import open_registry
    from mwdcal.screens.records import drift as screen

    options.check_outputs([], [database], page=html)
    day = (today or datetime.now(UTC)).date()
    allowed = drifts.limits_of(limits)
    with open_registry(database) as registry, bar("comparing") as advance:
        result = drifts.of_registry(registry, serial, allowed, level, day, advance)
    if html:
        atomic.write(html, pages.render(result.tool, result.fleet))
    shown = screen.document(result) if as_json else screen.text(result, html)
    print_result(shown, result.tool.findings if result.tool else [])
