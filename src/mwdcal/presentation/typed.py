"""Messages of the library in the words of the command that runs."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click
from msgspec.structs import replace

if TYPE_CHECKING:
    from mwdcal.calibration.record import Finding


def with_option_names(text: str) -> str:
    """A message of the library with the options of the command that runs instead of its arguments.

    The library names an argument in backticks, also in the files that it writes; the name stays as
    it is where no option has it.
    """
    context = click.get_current_context(silent=True)
    parameters = context.command.params if context else []
    typed = [p for p in parameters if isinstance(p, click.Option)]
    options = {p.opts[-1].lstrip("-").replace("-", "_"): p.opts[-1] for p in typed}
    options |= {p.name: p.opts[-1] for p in typed if p.name}
    return re.sub(r"`(\w+)`", lambda name: options.get(name[1], name[0]), text)


def findings_with_option_names(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in the words of the command that runs."""
    return [replace(finding, text=with_option_names(finding.text)) for finding in findings]
