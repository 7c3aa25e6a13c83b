"""`mwdcal certificate verify`: whether a document is as it was signed."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError
from mwdcal.screens.typed import findings_as_typed


@options.command()
@options.argument("document")
@click.argument("files", nargs=-1, type=options.FILE)
@options.TRUSTED_KEYS
@options.JSON
def command(document: Path, files: tuple[Path, ...], key: tuple[Path, ...], as_json: bool) -> None:
    """Verify the signature of a DOCUMENT: calibration file, or JSON of a verification or certificate.

    Of a certificate also the files that it rests on, by their SHA-256: FILES, or where the certificate
    says, seen from its folder, or beside it. What is not found is said, and no failure.

    \b
    Example: mwdcal certificate verify certificate.json --key laboratory.key.pub
    Exit: 0 intact, 1 altered, unsigned, or signed by a key that is not trusted, 2 cannot be read.
    """
    from msgspec.structs import replace

    from mwdcal.library.papers import check_signature

    if not key:
        raise InputError(
            "`key` is missing, and the variable MWDCAL_KEYS is not set. Name a public key."
        )
    result = check_signature(document, key, files=files)
    result.content = replace(result.content, findings=findings_as_typed(result.findings))
    print_result(result.to_dict() if as_json else result.summary(), result.findings)
    sys.exit(0 if result.passed else 1)
