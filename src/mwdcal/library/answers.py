"""Answers to what a table leaves open, as arguments of `propose_profile`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mwdcal.errors import InputError, argument_of

BY_COLUMN = {
    "column": "OURS=THEIRS, such as 'ref_azimuth_deg=Azi 2'",
    "leave_out": "COLUMN=TEXT, such as 'QC=rejected'",
    "keep": "COLUMN=TEXT, such as 'QC=second try'",
}
"""Options that say something of a column, and what is expected."""
Said = str | Iterable[str]
"""Answers about columns as a command takes them: one text NAME=VALUE, or several."""


class Answers(dict[str, Any]):
    """Arguments of `propose_profile` by name."""

    def take(self, argument: str, value: Any) -> None:
        """Note the value of an argument; of one with columns beside those noted before."""
        if argument not in BY_COLUMN:
            self[argument] = argument_of(argument, value)
            return
        name, text = _pair(argument, value)
        known = self.setdefault(argument, {})
        known[name] = text if argument == "column" else [*known.get(name, ()), text]


def by_column(argument: str, said: Mapping[str, Any] | Said | None) -> Mapping[str, Any]:
    """The answers of an argument by column, from texts as a command takes them or from a mapping.

    Raises:
        InputError: a text without a sign of equality, or what is no text.
    """
    if said is None or isinstance(said, Mapping):
        return said or {}
    answers = Answers({argument: {}})
    for text in [said] if isinstance(said, str) or not isinstance(said, Iterable) else said:
        answers.take(argument, text)
    known: Mapping[str, Any] = answers[argument]
    return known


def _pair(argument: str, text: object) -> tuple[str, str]:
    """The two parts of an option, NAME=VALUE: a column ends at the first sign, rows at the last one."""
    if not isinstance(text, str) or "=" not in text:
        raise InputError(f"`{argument}` {text!r}: expected {BY_COLUMN[argument]}.")
    name, _, said = text.partition("=") if argument == "column" else text.rpartition("=")
    return name.strip(), said.strip()
