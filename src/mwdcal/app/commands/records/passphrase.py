"""The passphrase of a private key: typed unseen, or in a variable; never on the command line, which others can see."""

from __future__ import annotations

import os
import sys

import click

from mwdcal.certificate.keys import PASSPHRASE
from mwdcal.errors import InputError


def known(new: bool = False) -> str:
    """The passphrase of a key; of a `new` one it is typed twice.

    Raises:
        InputError: the variable is not set, and nobody is there to type.
    """
    if word := os.environ.get(PASSPHRASE):
        return word
    if sys.stdin is None or not sys.stdin.isatty():
        raise InputError(
            f"the passphrase of the key cannot be typed here. Set the variable {PASSPHRASE}, or use a terminal."
        )
    typed: str = click.prompt("Passphrase", hide_input=True, confirmation_prompt=new, err=True)
    return typed
