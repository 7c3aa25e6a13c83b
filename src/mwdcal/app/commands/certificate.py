"""`mwdcal certificate`: certificates, their signatures, and the keys for these.

`mwdcal certificate CAL`: the certificate of a calibration, in any of its forms.

`mwdcal certificate sign`: a document with a signature.

`mwdcal certificate verify`: whether a document is as it was signed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import Commands, Group, options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError
from mwdcal.presentation.typed import findings_with_option_names


@click.group(
    cls=Group,
    default="issue",
    commands=Commands(
        {
            "issue": "certificate:issue",
            "sign": "certificate:sign",
            "verify": "certificate:verify",
            "key": "certificate_keys",
        }
    ),
    subcommand_metavar="CALIBRATION -o FILE | COMMAND [ARGS]...",
)
def command() -> None:
    """Issue a certificate of a CALIBRATION, sign it, and verify its signature.

    `mwdcal certificate CALIBRATION` is short for `mwdcal certificate issue CALIBRATION`.

    \b
    Examples: mwdcal certificate tool.json -o certificate.json
              mwdcal certificate sign certificate.json --private-key laboratory.key
              mwdcal certificate verify certificate.json --key laboratory.key.pub
    """


@options.command()
@options.CALIBRATION
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    multiple=True,
    metavar="C.json|.html|.pdf|.xml",
    help="Certificate to write, the form by its suffix; may be repeated.",
)
@click.option(
    "--verification",
    type=options.FILE,
    metavar="V.json",
    help="Roll test with this calibration (as left), as mwdcal verify --json printed it.",
)
@click.option(
    "--as-found",
    type=options.FILE,
    metavar="V.json",
    help="Roll test before the adjustment, with the previous calibration.",
)
@click.option(
    "--laboratory",
    type=options.FILE,
    metavar="LAB.toml",
    help="Laboratory file: name, people, standards, decision rule.",
)
@click.option(
    "--registry",
    metavar="URL|FILE",
    help="Registry with the earlier calibrations of the tool, whose drift the certificate then shows.",
)
@click.option("--number", default="", metavar="N", help="Number of the certificate.")
@click.option("--customer", default="", metavar="NAME", help="Customer.")
@click.option("--condition", default="", metavar="TEXT", help="Condition of the tool when it came.")
@click.option(
    "--received", type=options.Day(), metavar="YYYY-MM-DD", help="Day of receipt of the tool."
)
@click.option(
    "--date",
    "day",
    type=options.Day(),
    metavar="YYYY-MM-DD",
    help="Day of issue; today (UTC) if not given.",
)
@click.option(
    "--private-key",
    type=options.FILE,
    metavar="K",
    help="Sign the certificate with this key: its JSON, and the PDF itself (PAdES).",
)
@click.option(
    "--x509",
    type=options.FILE,
    metavar="CERT.pem",
    help="X.509 certificate of that key, for readers of PDF; by default one that the key signs itself.",
)
@options.TRUSTED_KEYS
@options.JSON
def issue(
    calibration: Path, output: tuple[Path, ...], verification: Path | None, as_found: Path | None,
    laboratory: Path | None, registry: str | None, number: str, customer: str, condition: str,
    received: datetime | None, day: datetime | None, private_key: Path | None, x509: Path | None,
    key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Issue the certificate of a CALIBRATION: ISO/IEC 17025 contents, uncertainty budget, decisions with their risk.

    The certificate names what the laboratory file leaves out. A failed roll test is shown as failed.

    \b
    Example: mwdcal certificate tool.json --verification v.json --laboratory lab.toml -o C.json -o C.pdf
    Exit: 0 written, 2 input cannot be read or does not belong to the calibration.
    """
    from mwdcal.app.commands.certificate_keys import known
    from mwdcal.files.formats import atomic
    from mwdcal.library.papers import certificate, check_form

    for path in output:
        check_form(path)
    inputs = [calibration, verification, as_found, laboratory, registry, private_key, x509, *key]
    options.check_outputs(output, inputs)
    paper = certificate(
        calibration, verification=verification, as_found=as_found, laboratory=laboratory, registry=registry,
        number=number, customer=customer, condition=condition, received=received, date=day, keys=key,
        folder=_folder(output), private_key=private_key, x509=x509, passphrase=known,
    )  # fmt: skip
    atomic.write_all([(path, paper.form(path)) for path in output])
    paper.saved.extend(output)
    print_result(paper.to_dict() if as_json else paper.summary(), paper.findings)


def _folder(outputs: Sequence[Path]) -> Path:
    """The folder of a certificate: that of its JSON, else of the first form."""
    first = [path for path in outputs if path.suffix.lower() == ".json"] or list(outputs)
    return first[0].resolve().parent if first else Path.cwd()


@options.command()
@options.argument("document")
@options.renamed(
    "--private-key",
    "key",
    old=("--key",),
    type=options.FILE,
    required=True,
    metavar="K",
    help="Private key that signs.",
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
def sign(document: Path, key: Path, output: Path | None, replace: bool, as_json: bool) -> None:
    """Sign a DOCUMENT: a calibration file, or the JSON of a verification or certificate.

    The passphrase of an encrypted key is asked for, or is the value of the variable
    MWDCAL_KEY_PASSPHRASE. Sign a calibration before you issue its certificate, which states the
    SHA-256 of its file.

    \b
    Example: mwdcal certificate sign certificate.json --private-key laboratory.key
    Exit: 0 signed, 2 input cannot be read or is signed already, 3 it was changed before.
    """
    from mwdcal.app.commands.certificate_keys import known
    from mwdcal.library.papers import sign

    options.check_outputs([output], [document, key], form=".json")
    result = sign(document, key, output=output, replace=replace, passphrase=known)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)


@options.command()
@options.argument("document")
@click.argument("files", nargs=-1, type=options.FILE)
@options.TRUSTED_KEYS
@options.JSON
def verify(document: Path, files: tuple[Path, ...], key: tuple[Path, ...], as_json: bool) -> None:
    """Verify the signature of a DOCUMENT: calibration file, JSON of a verification or certificate, or its PDF.

    Of a certificate also the files that it rests on, by their SHA-256: FILES, or where the certificate
    says, seen from its folder, or beside it. A file that is not there is reported, and is no failure.

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
    result.content = replace(result.content, findings=findings_with_option_names(result.findings))
    print_result(result.to_dict() if as_json else result.summary(), result.findings)
    sys.exit(0 if result.passed else 1)
