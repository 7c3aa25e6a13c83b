"""`mwdcal certificate`: the certificate of a calibration."""

from __future__ import annotations

from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.errors import InputError


@options.command()
@options.CALIBRATION
@options.output(metavar="C.pdf|html|json|xml", help="Certificate to write; form by suffix.")
def command(calibration: Path, output: Path) -> None:
    """Issue the certificate of a CALIBRATION.

    \b
    Example: mwdcal certificate tool.json -o certificate.pdf
    """
    raise InputError("this version of mwdcal does not issue certificates yet. Use a later one.")
