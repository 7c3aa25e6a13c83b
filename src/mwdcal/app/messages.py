"""What commands say beside their result: messages, findings, JSON, and errors in their words."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from mwdcal.errors import MwdcalError

if TYPE_CHECKING:
    from mwdcal.calibration.record import Finding


class Command(click.Command):
    """A command whose errors name its options as they are typed."""

    def invoke(self, context: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(context)
        except MwdcalError as error:
            error.args = (as_typed(str(error), self),)
            raise


def as_typed(text: str, command: click.Command) -> str:
    """A message of the library with the command's options instead of its arguments.

    The library names an argument in backticks; the name stays as it is where no option has it.
    """
    options = {p.name: p.opts[-1] for p in command.params if isinstance(p, click.Option)}
    return re.sub(r"`(\w+)`", lambda name: options.get(name[1], name[0]), text)


def findings_as_typed(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in the words of the command that runs."""
    from msgspec.structs import replace

    command = click.get_current_context().command
    return [replace(finding, text=as_typed(finding.text, command)) for finding in findings]


def say(text: str) -> None:
    """A message for people, on stderr."""
    click.echo(text, err=True)


def lines(findings: Iterable[Finding]) -> list[str]:
    """Findings, one line each."""
    return [f"! {finding.text}" for finding in findings]


def to_json(result: Any) -> str:
    """A result for machines."""
    import msgspec

    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode()


def print_result(result: Any, findings: Iterable[Finding] = ()) -> None:
    """Findings on stderr, and the result on stdout: text as it is, anything else as JSON."""
    for line in lines(findings):
        say(line)
    click.echo(result if isinstance(result, str) else to_json(result))
