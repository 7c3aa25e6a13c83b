"""`mwdcal diagnose`: what has happened to a calibrated tool, by later readings."""

from __future__ import annotations

import sys
from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.presentation.text import to_json
from mwdcal.presentation.typed import findings_with_option_names


@options.command()
@options.CALIBRATION
@options.argument("readings")
@options.RESULT
@options.report()
@options.of_roll_test
@options.DECIMAL
@options.JSON
def command(
    calibration: Path, readings: Path, output: Path | None, report: Path | None, decimal: str, as_json: bool
) -> None:  # fmt: skip
    """Say which fault, if any, later READINGS of the tool of a CALIBRATION show.

    READINGS are a roll test or surveys, a run file with the references that are known, or none.

    \b
    Example: mwdcal diagnose tool.json rolltest.csv
    Exit: 0 no change, 1 a fault is named, 2 input cannot be read or is of the fit itself, 3 it leaves a question open.
    """
    from msgspec.structs import replace

    from mwdcal.calibration.diagnosis.findings import of_table
    from mwdcal.faults.diagnosis import diagnose
    from mwdcal.files.formats import atomic
    from mwdcal.identification.roll_tests import read_later
    from mwdcal.presentation.calibration_source import calibration_of
    from mwdcal.presentation.diagnosis import is_fine, render, screen
    from mwdcal.presentation.envelope import json_document

    options.check_outputs([output], [calibration, readings], page=report, form=".json")
    fitted, digest = calibration_of(calibration)
    later = read_later(readings, fitted, options.said(decimal), is_test=False)
    result = diagnose(fitted, later)
    findings = findings_with_option_names(
        [*fitted.change_findings(), *result.findings, *of_table(later)]
    )
    result = replace(result, findings=findings)
    stated = fitted.tool, later.metadata
    digests = {"calibration": digest, "readings": later.run_sha256}
    document = json_document("diagnose", result, *stated, **digests)
    page = render(result, digests, *stated) if report else ""
    atomic.write_all([(output, to_json(document) + "\n"), (report, page)])
    print_result(document if as_json else screen(result, *stated), findings)
    sys.exit(0 if is_fine(result) else 1)
