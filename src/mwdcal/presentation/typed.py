"""Messages of the library in the words of the command that runs."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click
from msgspec.structs import replace

if TYPE_CHECKING:
    from mwdcal.calibration.record import Finding

MOST_FINDINGS = 6
"""Most findings that a screen, or the first page of a report, shows."""
MOST_ALSO = 12
"""Most stations that a finding names besides its own."""
IMPORTANT: tuple[str | tuple[str, ...], ...] = (
    "too-few", "channel", "missing-reference", "weak-geometry", "temperature-span",
    "altered", "revoked", "unsound", "other-tool", "contradicted", "no-path", "not-judged",
    "not-verified", "partly-judged", "axes-exchanged", "rejected", "path-from", "tie-in", "depths-count",
    "long-courses", "calibration-later", "magnetic-north", "column-explains", ("reshoot", "settings "),
    "repeated-readings", "misfit", "accelerometer-residuals", "magnetometer-residuals", "looks-like",
    "outside-temperature", "changed", "standard-overdue", "roll-test-read", "columns-read",
)  # fmt: skip
"""Beginnings of the ids of findings that come first, the most important first; together: of equal importance."""
MINOR = ("not-used", "renamed-columns", "reference-unused", "settings-assumed", "unsigned")
"""Beginnings of the ids of findings that come last."""


def with_option_names(text: str) -> str:
    """A message of the library with the options of the command that runs instead of its arguments.

    The library names an argument in backticks, also in the files that it writes; the name stays as
    it is where no option has it. A message that names another command names its options too.
    """
    context = click.get_current_context(silent=True)
    if context is None or "`" not in text:
        return text
    commands = [context.command]
    root, other = context.find_root().command, re.search(r"\bmwdcal (\w+)", text)
    if isinstance(root, click.Group) and other and other[1] in root.commands:
        commands.insert(0, root.commands[other[1]])
    typed = [p for command in commands for p in command.params if isinstance(p, click.Option)]
    options = {p.opts[-1].lstrip("-").replace("-", "_"): p.opts[-1] for p in typed}
    options |= {p.name: p.opts[-1] for p in typed if p.name}
    return re.sub(r"`(\w+)`", lambda name: options.get(name[1], name[0]), text)


def on_page(text: str) -> str:
    """A message on a page: with option names, and other names in quotes."""
    return re.sub(r"`(\w+)`", r"'\1'", with_option_names(text)) if "`" in text else text


def findings_with_option_names(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in the words of the command that runs."""
    return [replace(finding, text=with_option_names(finding.text)) for finding in findings]


def leading_findings(findings: Iterable[Finding]) -> tuple[list[Finding], int]:
    """One finding for each cause, the most important first, six at most; and how many causes are left.

    Findings of one id have one cause: the first speaks for all, and names the stations of the others.
    """
    causes: dict[str, list[Finding]] = {}
    for finding in findings:
        alike = f"{finding.id}: {finding.text}" if not finding.station else finding.id
        causes.setdefault(alike, []).append(finding)
    ordered = sorted(causes.values(), key=lambda cause: _rank(cause[0].id))
    return [_with_others(cause) for cause in ordered[:MOST_FINDINGS]], len(ordered[MOST_FINDINGS:])


def _rank(name: str) -> int:
    """The place of a finding in the order of importance."""
    for place, start in enumerate(IMPORTANT):
        if f"{name} ".startswith(start):
            return place - len(IMPORTANT)
    return int(name.startswith(MINOR))


def _with_others(cause: list[Finding]) -> Finding:
    """The first finding of a cause, with the stations of the others."""
    first, *others = cause
    if not others:
        return first
    stations = [str(finding.station) for finding in others if finding.station is not None]
    if not stations:
        return first
    named = ", ".join(stations[:MOST_ALSO])
    plural = "s" * (len(stations) > 1)
    more = f" and {len(stations) - MOST_ALSO} more" if len(stations) > MOST_ALSO else ""
    return replace(first, text=f"{first.text.rstrip('.')}. Also station{plural} {named}{more}")
