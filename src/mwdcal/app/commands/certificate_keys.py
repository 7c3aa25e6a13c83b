"""The passphrase of a private key: typed unseen, or in a variable; never on the command line, which others can see.

`mwdcal certificate key …`: keys that sign, and files of keys that are trusted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mwdcal.app.commands import Group, options
from mwdcal.app.messages import Command, print_result
from mwdcal.certificate.signature import PASSPHRASE
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.certificate.signature import TrustedKey


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


KEYS_FILE = options.argument("keys", metavar="KEYS.json")
ONE_KEY = click.argument("name", metavar="KEY")


@click.group(cls=Group)
def command() -> None:
    """Make keys, and keep the list of those whose signatures are trusted.

    \b
    Example: mwdcal certificate key create -o laboratory.key --owner "Calibration laboratory"
             mwdcal certificate key trust keys.json laboratory.key.pub
    """


def subcommand(function: Callable[..., Any]) -> Any:
    """A subcommand of the name of its function, `list` without what tells it from Python's."""
    name = function.__name__.removesuffix("_keys")
    return command.command(name, cls=Command)(options.JSON(function))


def _print(name: str, file: Path, keys: list[TrustedKey], as_json: bool, **written: Path) -> None:
    """The keys in a file, and what was written."""
    from mwdcal.presentation import signature as screens
    from mwdcal.presentation.envelope import json_document

    result = screens.KeysDocument(file=str(file), keys=keys)
    shown = json_document(f"certificate key {name}", result)
    print_result(shown if as_json else screens.keys(result, **written))


@subcommand
@options.output(metavar="K.key", help="Private key to write; the public one becomes K.key.pub.")
@click.option("--owner", default="", metavar="TEXT", help="Whose key it is, stated in K.key.pub.")
@click.option(
    "--passphrase",
    is_flag=True,
    help="Ask for a passphrase, with which the key is encrypted; or that of the variable "
    "MWDCAL_KEY_PASSPHRASE, where it is set.",
)
def create(output: Path, owner: str, passphrase: bool, as_json: bool) -> None:
    """Make a key: K.key signs, and only you may read it; K.key.pub checks, and everybody may have it.

    No file is overwritten.

    \b
    Example: mwdcal certificate key create -o laboratory.key --owner "Calibration laboratory"
    """
    import os

    from mwdcal.certificate import signature

    encrypted = passphrase or signature.PASSPHRASE in os.environ
    public, file = signature.create(output, owner, known(new=True) if encrypted else "")
    _print("create", file, [public], as_json, private=output, public=file)


@subcommand
@KEYS_FILE
@options.argument("public", metavar="K.pub")
def trust(keys: Path, public: Path, as_json: bool) -> None:
    """Add the public key K.pub to the trusted ones in KEYS.json, which is made if need be.

    Take a public key from its owner, not from the sender of a document: compare its digits by telephone.

    \b
    Example: mwdcal certificate key trust keys.json laboratory.key.pub
    """
    from mwdcal.certificate import signature as lists

    _print("trust", keys, lists.trust(keys, lists.read_public(public)).keys, as_json)


@subcommand
@KEYS_FILE
@ONE_KEY
@click.option("--at", default="", metavar="TIME", help="UTC, ISO 8601. Default: now.")
def retire(keys: Path, name: str, at: str, as_json: bool) -> None:
    """End the use of a KEY in KEYS.json: what it has signed before stays valid.

    KEY: its first digits, or the file of the public key.

    \b
    Example: mwdcal certificate key retire keys.json 3f9a --at 2027-01-01
    """
    from mwdcal.certificate import signature as lists

    _print("retire", keys, lists.retire(keys, name, at).keys, as_json)


@subcommand
@KEYS_FILE
@ONE_KEY
@click.option("--reason", default="", metavar="TEXT", help="Why, for those who read it.")
def revoke(keys: Path, name: str, reason: str, as_json: bool) -> None:
    """Withdraw all trust in a KEY in KEYS.json: nothing that it has ever signed is valid.

    KEY: its first digits, or the file of the public key.

    \b
    Example: mwdcal certificate key revoke keys.json 3f9a --reason "laptop stolen"
    """
    from mwdcal.certificate import signature as lists

    _print("revoke", keys, lists.revoke(keys, name, reason).keys, as_json)


@subcommand
@KEYS_FILE
def list_keys(keys: Path, as_json: bool) -> None:
    """List the keys in KEYS.json, or the key in a K.pub.

    \b
    Example: mwdcal certificate key list keys.json
    """
    from mwdcal.certificate.signature import read_trusted

    _print("list", keys, read_trusted(keys), as_json)
