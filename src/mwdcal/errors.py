"""Exceptions of the package: one base, one subclass per kind of reader.

Every message names what is wrong, where, the value met, and what to do about it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

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


class Answer(NamedTuple):
    """A choice that answers a question: what it is called, and the arguments that say it, each with its value.

    `numbers` are arguments with numbers that have to be added.
    """

    name: str
    arguments: tuple[tuple[str, str], ...]
    numbers: tuple[str, ...] = ()

    @property
    def typed(self) -> list[tuple[str, str]]:
        """The arguments with their values as a shell takes them; NUMBER for a number that has to be added."""
        return [
            *((n, _quoted(v)) for n, v in self.arguments),
            *((n, "NUMBER") for n in self.numbers),
        ]


class QuestionError(FitError):
    """Something that the data leave open, with the answers that there are; the first is what is believed."""

    def __init__(self, text: str, answers: Sequence[Answer] = ()) -> None:
        super().__init__(f"{text}{_said_by(answers)}")
        self.text = text
        self.answers = tuple(answers)


def _said_by(answers: Sequence[Answer]) -> str:
    """How answers are given, the first few, ready to be pasted."""
    each = [
        " ".join(f"`{name}` {value}" for name, value in answer.typed)
        for answer in answers[:_MOST_NAMED]
    ]
    more = f" or {len(answers) - len(each)} others" if len(answers) > len(each) else ""
    return f" Answer by {' or '.join(each)}{more}." if each else ""


def _quoted(value: str) -> str:
    """A value as a shell takes it."""
    return (
        value
        if re.fullmatch(r"[\w=.+-]+", value, re.ASCII)
        else "'" + value.replace("'", "'\\''") + "'"
    )


class QuestionsError(FitError):
    """All questions that are open together."""

    def __init__(self, source: str, questions: Sequence[QuestionError]) -> None:
        texts = [re.sub(rf"^{re.escape(source)}[:,] ", "", str(each)) for each in questions]
        listed = " ".join(f"({n}) {text}" for n, text in enumerate(texts, 1))
        one = len(texts) == 1
        super().__init__(
            f"{source}: {texts[0]}"
            if one
            else f"{source}: {len(texts)} questions are open. {listed}"
        )
        self.questions = tuple(questions)


def reason(error: Exception) -> str:
    """The error of the operating system, without its error number and the path."""
    text: str = getattr(error, "strerror", None) or str(error)
    return text.partition("[errno ")[2].partition("] ")[2] or text
