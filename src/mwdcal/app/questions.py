"""Questions on a terminal: one line each, with what is believed first."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import click

from mwdcal.app.messages import quiet, say
from mwdcal.errors import InputError
from mwdcal.presentation.text import one_line


def on_terminal() -> bool:
    """Whether somebody can be asked: keys come from a terminal, and questions go to one."""
    return not quiet() and bool(sys.stdin and sys.stdin.isatty()) and sys.stderr.isatty()


def ask(lines: Sequence[str], default: str, check: Callable[[str], object]) -> str:
    """The answer to a question of some lines, until it passes a check; the return key alone takes the default."""
    for line in lines:
        say(line)
    while True:
        answer = click.prompt(">", default=default, prompt_suffix=" ", err=True, type=str)
        try:
            check(str(answer).strip())
        except InputError as error:
            say(str(error))
            continue
        return str(answer).strip()


def choose(question: str, choices: Sequence[str]) -> int:
    """The place of the choice taken, which is typed by its number; the first is what is believed."""

    def check(answer: str) -> None:
        if not answer.isdecimal() or not 1 <= int(answer) <= len(choices):
            raise InputError(f"Type a number from 1 to {len(choices)}; got {answer!r}.")

    listed = [f"  {n}  {one_line(text)}" for n, text in enumerate(choices, 1)]
    return int(ask([question, *listed], "1", check)) - 1
