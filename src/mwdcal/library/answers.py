"""Answers to what a table leaves open, as arguments of `propose_profile`."""

from __future__ import annotations

from typing import Any

from mwdcal.errors import InputError

BY_COLUMN = {
    "column": "OURS=THEIRS, such as ref_azimuth_deg='Azi 2'",
    "leave_out": "COLUMN=TEXT, such as 'QC=rejected'",
    "keep": "COLUMN=TEXT, such as 'QC=second try'",
}
"""Options that say something of a column, and what is expected."""


class Answers(dict[str, Any]):
    """Arguments of `propose_profile` by name."""

    def take(self, argument: str, value: str) -> None:
        """Note the value of an argument; of one with columns beside those noted before."""
        if argument not in BY_COLUMN:
            self[argument] = int(value) if argument == "header_row" else value
            return
        name, text = _pair(argument, value)
        known = self.setdefault(argument, {})
        known[name] = text if argument == "column" else [*known.get(name, ()), text]


def _pair(argument: str, text: str) -> tuple[str, str]:
    """The two parts of an option, NAME=VALUE: a column ends at the first sign, rows at the last one."""
    if "=" not in text:
        option = f"--{argument.replace('_', '-')}"
        expected = BY_COLUMN[argument]
        raise InputError(f"{option} {text!r}: expected {expected}.")
    name, _, said = text.partition("=") if argument == "column" else text.rpartition("=")
    return name.strip(), said.strip()
