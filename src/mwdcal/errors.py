"""Exceptions of the package: one base, one subclass per kind of reader.

Every message names what is wrong, where, the value met, and what to do about it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple


def _in_quotes(match: re.Match[str]) -> str:
    """A text in double quotes, which all shells take; in single ones as bash does where these leave signs alive."""
    text = match[0]
    if {*text} & {*'"$`!'}:
        return "'" + text.replace("'", "'\\''") + "'"
    return f'"{text}"'


shell_word = partial(re.compile(r"(?=.*[^\w./\\:+@=#~…-]).+", re.DOTALL).sub, _in_quotes)
"""Quotes the name of a file as a command line needs it, where bash, cmd or PowerShell would take it apart."""
_MOST_NAMED = 4
"""Answers that a message names."""


class MwdcalError(Exception):
    """Base of all errors that a user of mwdcal can do something about."""

    exit_code = 2


class InputError(MwdcalError):
    """A file, a profile or an option cannot be read or understood (exit code 2)."""


class UnreadableFileError(InputError):
    """A file that is absent, damaged or cut: no profile reads it (exit code 2)."""


class FitError(MwdcalError):
    """The input is understood but not calibratable or not trustworthy (exit code 3)."""

    exit_code = 3


def argument_of(name: str, text: str) -> str | int:
    """The value of an argument of Python from its text: a row is a number."""
    return int(text) if name == "header_row" else text


class Answer(NamedTuple):
    """A choice that answers a question: what it is called, and the arguments that say it, each with its value.

    `numbers` are arguments with numbers that have to be added.
    """

    name: str
    arguments: tuple[tuple[str, str], ...]
    numbers: tuple[str, ...] = ()

    @property
    def options(self) -> str:
        """The arguments as options of a command, as a shell takes them; NUMBER for a number that has to be added."""
        said = [
            *((n, shell_word(v)) for n, v in self.arguments),
            *((n, "NUMBER") for n in self.numbers),
        ]
        return " ".join(f"--{name.replace('_', '-')} {value}" for name, value in said)

    @property
    def keywords(self) -> str:
        """The arguments as Python takes them, those of one name in a list; NUMBER likewise."""
        values: dict[str, list[str | int]] = {}
        for name, value in self.arguments:
            values.setdefault(name, []).append(argument_of(name, value))
        said = {name: repr(each if each[1:] else each[0]) for name, each in values.items()}
        said |= dict.fromkeys(self.numbers, "NUMBER")
        return ", ".join(f"{name}={value}" for name, value in said.items())


class QuestionError(FitError):
    """Something that the data leave open, with the answers that there are; the first is what is believed."""

    def __init__(self, text: str, answers: Sequence[Answer] = ()) -> None:
        super().__init__(f"{text}{_said_by([answer.keywords for answer in answers])}")
        self.text = text
        self.answers = tuple(answers)

    @property
    def with_options(self) -> str:
        """The message for a command, whose options answer it."""
        return f"{self.text}{_said_by([answer.options for answer in self.answers])}"


def _said_by(answers: Sequence[str]) -> str:
    """How answers are given, the first few, ready to be pasted."""
    each = answers[:_MOST_NAMED]
    more = f" or {len(answers) - len(each)} others" if len(answers) > len(each) else ""
    return f" Answer by {' or '.join(each)}{more}." if each else ""


class QuestionsError(FitError):
    """All questions that are open together."""

    def __init__(self, source: str, questions: Sequence[QuestionError]) -> None:
        super().__init__(_listed(source, [*map(str, questions)]))
        self.source = source
        self.questions = tuple(questions)

    @property
    def with_options(self) -> str:
        """The message for a command, whose options answer it."""
        return _listed(self.source, [each.with_options for each in self.questions])


def _listed(source: str, questions: Sequence[str]) -> str:
    """Questions about a file in one message."""
    texts = [re.sub(rf"^{re.escape(source)}[:,] ", "", each) for each in questions]
    if len(texts) == 1:
        return f"{source}: {texts[0]}"
    listed = " ".join(f"({n}) {text}" for n, text in enumerate(texts, 1))
    return f"{source}: {len(texts)} questions are open. {listed}"


def reason(error: Exception) -> str:
    """The error of the operating system, without its error number and the path."""
    text: str = getattr(error, "strerror", None) or str(error)
    return text.partition("[errno ")[2].partition("] ")[2] or text
