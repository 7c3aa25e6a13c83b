"""`mwdcal certificate sign`: a document with a signature."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result


@options.command()
@options.argument("document")
@click.option(
    "--key", type=options.FILE, required=True, metavar="K", help="Private key that signs."
)
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    metavar="FILE.json",
    help="File to write. Default: DOCUMENT is replaced.",
)
@click.option(
    "--replace", is_flag=True, help="Replace the signature of a document that is signed already."
)
@options.JSON
def command(document: Path, key: Path, output: Path | None, replace: bool, as_json: bool) -> None:
    """Sign a DOCUMENT: a calibration file, or the JSON of a verification or certificate.

    The passphrase of an encrypted key is asked for, or is the value of the variable
    MWDCAL_KEY_PASSPHRASE. Sign a calibration before you issue its certificate, which states the
    SHA-256 of its file.

    \b
    Example: mwdcal certificate sign certificate.json --key laboratory.key
    Exit: 0 signed, 2 input cannot be read or is signed already, 3 it was changed before.
    """
    from mwdcal.app.commands.records.passphrase import known
    from mwdcal.library.papers import sign

    options.check_outputs([output], [document, key])
    result = sign(document, key, output=output, replace=replace, passphrase=known)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)
