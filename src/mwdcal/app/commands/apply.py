"""`mwdcal apply`: readings corrected by a calibration."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError
from mwdcal.presentation.text import one_line


@options.command()
@options.CALIBRATION
@options.argument("readings")
@options.output(metavar="OUT", help="Table to write; format by suffix.")
@options.WHERE_OUTSIDE
@options.preset(
    "--missing",
    type=click.Choice(["refuse", "blank"]),
    default="refuse",
    help="Rows with a blank reading or temperature: refuse the file, or leave their results blank.",
)
@click.option(
    "--uncertainty/--no-uncertainty",
    default=True,
    help="Columns with the standard uncertainty of each angle and strength. Without them long tables are faster.",
)
@options.DECIMAL
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, readings: Path, output: Path, outside: str, missing: str, uncertainty: bool, decimal: str,
    key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Correct READINGS (CSV, TSV, Parquet, XLSX, WITSML or LAS) with the CALIBRATION of their tool.

    Writes the columns of READINGS as they are and, beside them: gravity and field along the tool
    axes, inclination, azimuth (magnetic), toolface, dip and strengths, and their standard uncertainties (sd_).

    \b
    Example: mwdcal apply tool.json surveys.csv -o corrected.csv
    Exit: 0 written, 2 input cannot be read, or does not belong to the calibration.
    """
    from mwdcal.app.correction import Applied, apply_to_any
    from mwdcal.app.progress import bar
    from mwdcal.calibration.readings import simulated
    from mwdcal.files.runs import BlankReadingError
    from mwdcal.presentation.envelope import json_document, with_signature
    from mwdcal.presentation.signature import load_calibration, signature_status

    options.check_outputs([output], [calibration, readings, *key])
    loaded = load_calibration(calibration, key)
    fitted = loaded.calibration
    try:
        with bar("correcting") as advance:
            tally, findings, readings_digest = apply_to_any(
                fitted, readings, output, outside, missing, decimal, uncertainty, advance
            )
    except BlankReadingError as error:
        advice = "Or leave the results of such rows blank: --missing blank."
        raise InputError(f"{error} {advice}") from None
    findings = loaded.findings + findings
    blank = tally.blank(outside)
    document = json_document(
        "apply",
        Applied(rows=tally.rows, blank=blank, output=str(output), findings=findings),
        *(fitted.tool, tally.metadata),
        calibration=loaded.digest,
        readings=readings_digest,
    )
    corrected = f"{tally.rows} rows corrected" + (f", {blank} of them blank" if blank else "")
    signed = one_line(signature_status(loaded.signature))
    said = [corrected, f"wrote {one_line(output)}", signed, *simulated(fitted.tool)]
    document = with_signature(document, loaded.signature)
    print_result(document if as_json else "   ".join(said), findings)
