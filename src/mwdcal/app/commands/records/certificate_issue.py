"""`mwdcal certificate CAL`: the certificate of a calibration, in any of its forms."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result

ISO_DAY = click.DateTime(["%Y-%m-%d"])
"""A day as it is typed."""


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
    help="What the laboratory states: name, people, standards, decision rule.",
)
@click.option(
    "--registry",
    metavar="URL|FILE",
    help="Registry with the earlier calibrations of the tool, whose drift the certificate then shows.",
)
@click.option("--number", default="", metavar="N", help="Number of the certificate.")
@click.option("--customer", default="", metavar="NAME", help="Customer.")
@click.option("--condition", default="", metavar="TEXT", help="Condition of the tool when it came.")
@click.option("--received", type=ISO_DAY, metavar="YYYY-MM-DD", help="Day of receipt of the tool.")
@click.option(
    "--date",
    "day",
    type=ISO_DAY,
    metavar="YYYY-MM-DD",
    help="Day of issue; today (UTC) if not given.",
)
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, output: tuple[Path, ...], verification: Path | None, as_found: Path | None,
    laboratory: Path | None, registry: str | None, number: str, customer: str, condition: str,
    received: datetime | None, day: datetime | None, key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Issue the certificate of a CALIBRATION: ISO/IEC 17025 contents, uncertainty budget, decisions with their risk.

    What the laboratory file does not state is named in the certificate. A failed roll test is shown as failed.

    \b
    Example: mwdcal certificate tool.json --verification v.json --laboratory lab.toml -o C.json -o C.pdf
    Exit: 0 written, 2 input cannot be read or does not belong to the calibration.
    """
    from mwdcal.files.formats import atomic
    from mwdcal.library.papers import certificate, check_form

    for path in output:
        check_form(path)
    options.check_outputs(output, [calibration, verification, as_found, laboratory, registry, *key])
    paper = certificate(
        calibration, verification=verification, as_found=as_found, laboratory=laboratory, registry=registry,
        number=number, customer=customer, condition=condition, received=received, date=day, keys=key,
        folder=_folder(output),
    )  # fmt: skip
    atomic.write_all([(path, paper.form(path)) for path in output])
    paper.saved.extend(output)
    print_result(paper.to_dict() if as_json else paper.summary(), paper.findings)


def _folder(outputs: Sequence[Path]) -> Path:
    """The folder of a certificate: that of its JSON, else of the first form."""
    first = [path for path in outputs if path.suffix.lower() == ".json"] or list(outputs)
    return first[0].resolve().parent if first else Path.cwd()
