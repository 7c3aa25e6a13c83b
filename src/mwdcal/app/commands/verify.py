"""`mwdcal verify`: a calibration against a roll test."""

from __future__ import annotations

import sys
from pathlib import Path

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.presentation.text import to_json
from mwdcal.presentation.typed import findings_with_option_names


@options.command()
@options.CALIBRATION
@options.RUN
@options.LIMITS
@options.RESULT
@options.report(help="Also write the report, with this verdict.")
@options.of_roll_test
@options.of_run
@options.DECIMAL
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, run: Path, limits: str, output: Path | None, report: Path | None, decimal: str,
    key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Verify a CALIBRATION by a roll test: a RUN whose stations were not in the fit, or the roll test in its file.

    \b
    Example: mwdcal verify tool.json rolltest.csv --limits roll-test
    Exit: 0 pass, 1 fail, 2 input cannot be read or is not independent, 3 it leaves a question open.
    """
    from msgspec.structs import replace

    from mwdcal.calibration.diagnosis.findings import of_table
    from mwdcal.calibration.diagnosis.identity import overdue
    from mwdcal.files.formats import atomic
    from mwdcal.files.limits import load_limits
    from mwdcal.files.profiles import standards_of
    from mwdcal.identification.roll_tests import read_later
    from mwdcal.presentation.envelope import json_document, with_signature
    from mwdcal.presentation.signature import load_calibration
    from mwdcal.presentation.verification import next_step, screen, with_next_step
    from mwdcal.use.verification import verify

    options.check_outputs([output], [calibration, run, limits, *key], page=report, form=".json")
    loaded = load_calibration(calibration, key)
    fitted = loaded.calibration
    readings = read_later(run, fitted, options.said(decimal))
    bounds, limits_digest = load_limits(limits)
    result = verify(fitted, readings, bounds)
    late = overdue(standards_of(fitted.profile), readings.metadata)
    findings = findings_with_option_names(
        loaded.findings + result.findings + of_table(readings) + late
    )
    result = replace(result, findings=findings)
    stated = fitted.tool, readings.metadata
    digests = {"calibration": loaded.digest, "run": readings.run_sha256, "limits": limits_digest}
    content = with_next_step(result, calibration, run)
    document = json_document("verify", content, *stated, **digests)
    document = with_signature(document, loaded.signature)
    rendered = ""
    if report:
        from mwdcal.presentation.calibration_page import render

        rendered = render(fitted, result, *stated, file=calibration.name)
    atomic.write_all([(output, to_json(document) + "\n"), (report, rendered)])
    shown = screen(result, loaded.signature, *stated) + next_step(result, calibration, run)
    print_result(document if as_json else shown, result.findings)
    sys.exit(0 if result.passed else 1)
