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
    from mwdcal.certificate.keys import read_private
    from mwdcal.certificate.signature import signed
    from mwdcal.files import documents
    from mwdcal.files.formats import atomic
    from mwdcal.screens.records import signature as screens

    options.check_outputs([output], [document, key])
    target = output or document
    atomic.target(target)
    file = documents.whole_file(document)
    data = signed(file, read_private(key, known), replace)
    result, fields = screens.signed_document(data, target, document.parent)
    shown = screens.for_machines("sign", result, fields, file.digest)
    atomic.write(target, data)
    print_result(shown if as_json else screens.signed(result, fields), result.findings)
