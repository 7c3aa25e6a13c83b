"""`mwdcal certificate`: certificates, their signatures, and the keys for these."""

from __future__ import annotations

import click

from mwdcal.app.commands import Commands, Group


@click.group(
    cls=Group,
    default="issue",
    commands=Commands(
        {
            "issue": "records.certificate_issue",
            "sign": "records.certificate_sign",
            "verify": "records.certificate_verify",
            "key": "records.certificate_key",
        }
    ),
    subcommand_metavar="CALIBRATION -o FILE | COMMAND [ARGS]...",
)
def command() -> None:
    """Issue a certificate of a CALIBRATION, sign it, and verify its signature.

    `mwdcal certificate CALIBRATION` is short for `mwdcal certificate issue CALIBRATION`.

    \b
    Examples: mwdcal certificate tool.json -o certificate.json
              mwdcal certificate sign certificate.json --key laboratory.key
              mwdcal certificate verify certificate.json --key laboratory.key.pub
    """
