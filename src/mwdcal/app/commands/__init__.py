"""One module for each command: its options, what it runs, what it prints."""

from __future__ import annotations

import re
import sys
from collections import UserDict
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from mwdcal.presentation.text import laid_out


def summary(command: click.Command, width: int) -> str:
    """Purpose of a command in one line: its first sentence, if longer than a width up to a colon, or else a comma."""
    text = " ".join((command.help or "").split("\n\n")[0].split())
    sentence = text.partition(". ")[0].rstrip(".")
    for end in (r"$", r"[:;]| \(", r",| and "):
        part = re.split(end, sentence)[0]
        if len(part) <= width:
            return part
    return sentence[:width]


class Commands(UserDict[str, Any]):
    """Commands by name, each imported only when it is used.

    The values are modules below this one whose `command` it is: "survey", or with another name in
    the module "registry:add".
    """

    def __getitem__(self, name: str) -> Any:
        """The command of that name."""
        module, _, attribute = super().__getitem__(name).partition(":")
        command = getattr(import_module(f"{__name__}.{module}"), attribute or "command")
        command.name = name
        return command


class Group(click.Group):
    """A command with subcommands; a first word that names none of them belongs to the `default`."""

    def __init__(self, *arguments: Any, default: str | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.default = default

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        """Read the arguments, with the name of the default in front where no subcommand is named."""
        helped = args[:1] and args[0] in self.get_help_option_names(context)
        named = args[:1] and args[0] in self.commands
        if self.default and not (helped or named or (context.resilient_parsing and not args)):
            self._refuse_misspelt(context, "".join(args[:1]))
            args = [self.default, *args]
        return super().parse_args(context, args)

    def _refuse_misspelt(self, context: click.Context, word: str) -> None:
        """Refuse a first word that is almost a subcommand, and no path."""
        near = get_close_matches(word, self.commands) if word.isalpha() else []
        if near and not Path(word).exists():
            context.fail(f"No such command {word!r}. Did you mean {' or '.join(near)}?")

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the subcommands, each with what it does in one line."""
        width = formatter.width - 6 - max(map(len, self.commands))
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, summary(self.commands[name], width)) for name in sorted(self.commands)]
            )

    def get_help(self, context: click.Context) -> str:
        """The help, as wide as the terminal."""
        return laid_out(super().get_help(context), sys.stdout)

    def shell_complete(self, context: click.Context, incomplete: str) -> list[CompletionItem]:
        """Subcommands and options, and what may follow the default."""
        items = super().shell_complete(context, incomplete)
        if not self.default:
            return items
        command = self.commands[self.default]
        inner = command.make_context(self.default, [], parent=context, resilient_parsing=True)
        first = command if incomplete.startswith("-") else command.params[0]
        names = {item.value for item in items}
        return items + [
            item for item in first.shell_complete(inner, incomplete) if item.value not in names
        ]
