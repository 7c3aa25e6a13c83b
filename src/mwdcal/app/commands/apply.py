"""`mwdcal apply`: readings corrected by a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import offering_blank, print_result
from mwdcal.presentation.text import one_line

if TYPE_CHECKING:
    from mwdcal.use.correction import AngleRange


@options.command()
@options.CALIBRATION
@options.argument("readings")
@options.output(metavar="OUT", help="Table to write; format by suffix.")
@options.WHERE_OUTSIDE
@options.MISSING
@click.option(
    "--uncertainty/--no-uncertainty",
    default=True,
    help="Columns with the standard uncertainty of each angle and strength. Without them long tables are faster.",
)
@options.of_readings
@options.of_run
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
    Exit: 0 written, 2 input cannot be read, or does not belong to the calibration, 3 a question is open.
    """
    from mwdcal.app.correction import Applied, apply_to_any
    from mwdcal.app.messages import bar
    from mwdcal.calibration.readings import simulated
    from mwdcal.presentation.envelope import json_document, with_signature
    from mwdcal.presentation.signature import load_calibration, signature_status
    from mwdcal.use.uncertainty import reading_terms

    options.check_outputs([output], [calibration, readings, *key])
    loaded = load_calibration(calibration, key)
    fitted = loaded.calibration
    with offering_blank(), bar("correcting") as advance:
        tally, findings, readings_digest = apply_to_any(
            fitted, readings, output, outside, missing, options.said(decimal), uncertainty, advance,
        )  # fmt: skip
    findings = loaded.findings + findings
    blank, terms = tally.blank(outside), reading_terms(fitted)
    document = json_document(
        "apply",
        Applied(
            rows=tally.rows,
            blank=blank,
            output=str(output),
            angles=dict(tally.angles),
            findings=findings,
            **(terms.stated if uncertainty else {}),
        ),
        *(fitted.tool, tally.metadata),
        calibration=loaded.digest,
        readings=readings_digest,
    )
    corrected = f"{tally.rows} rows corrected" + (f", {blank} of them blank" if blank else "")
    signed = signature_status(loaded.signature)
    said = [corrected, f"wrote {one_line(output)}", *signed, *simulated(fitted.tool)]
    document = with_signature(document, loaded.signature)
    angles = filter(None, [_angles_in_words(tally.angles)])
    lines = ["   ".join(said), *angles, *([terms.sentence] if uncertainty else [])]
    print_result(document if as_json else "\n".join(lines), findings)


def _angles_in_words(angles: Mapping[str, AngleRange]) -> str:
    """Ranges of angles with their largest 1σ, or empty."""
    from mwdcal.presentation.numbers import fixed, uncertainty

    def in_words(name: str, angle: AngleRange) -> str:
        sd = "" if angle.sd_deg is None else f", 1σ at most {uncertainty(angle.sd_deg)}°"
        return f"{name} {fixed(angle.least_deg, 2)}° to {fixed(angle.largest_deg, 2)}°{sd}"

    return "   ".join(in_words(name, each) for name, each in angles.items())
