"""`mwdcal completion`: the script that completes commands and options in a shell."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from mwdcal.app.commands import options
from mwdcal.app.messages import quiet


@options.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print the completion script of a SHELL.

    \b
    Example: mwdcal completion bash >> ~/.bashrc
    """
    completion = get_completion_class(shell)
    if completion is not None and not quiet():
        root = context.find_root().command
        click.echo(completion(root, {}, "mwdcal", "_MWDCAL_COMPLETE").source())
