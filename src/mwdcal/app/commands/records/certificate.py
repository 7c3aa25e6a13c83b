"""`mwdcal certificate`: certificates, their signatures, and the keys for these."""

from __future__ import annotations

import click

from mwdcal.app.commands import Commands, Group


@click.group(
    cls=Group,
    default="issue",
    commands=Commands({"issue": "records.certificate_issue"}),
    subcommand_metavar="CALIBRATION -o FILE | COMMAND [ARGS]...",
)
def command() -> None:
    """Issue a certificate of a CALIBRATION, sign it, and verify its signature.

    `mwdcal certificate CALIBRATION` is short for `mwdcal certificate issue CALIBRATION`.

    \b
    Examples: mwdcal certificate tool.json -o certificate.pdf
              mwdcal certificate verify certificate.json --key laboratory.pub
    """
