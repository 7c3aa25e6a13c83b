"""`mwdcal list`: what is built in, by the names that options take."""

from __future__ import annotations

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result


@options.command()
@click.argument("kind", type=click.Choice(["plans", "profiles", "limits", "methods"]))
@options.JSON
def command(kind: str, as_json: bool) -> None:
    """Print the built-in KIND: plans of stations, tool profiles, limits of roll tests and surveys, or methods.

    \b
    Example: mwdcal list profiles
    """
    from mwdcal.presentation import builtin as screen

    entries = screen.entries(kind)
    print_result(screen.document(kind, entries) if as_json else screen.screen(entries))
