"""A table of readings through a calibration, to a table with the results beside the input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mwdcal.app.streaming import apply_to_file, described, is_long
from mwdcal.calibration import Calibration, Finding
from mwdcal.correction import correct
from mwdcal.errors import InputError
from mwdcal.files import table
from mwdcal.files.runs import to_readings
from mwdcal.files.table import Table


def apply_to_any(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    decimal: str,
    advance: Callable[[int, int], None],
) -> tuple[int, list[Finding]]:
    """Correct a file into another, whole or, where it is long, part by part.

    Number of rows, and what the reader should know. `advance` is told how much of a long
    table is done, and of how much.
    """
    if is_long(readings, output, decimal):
        return apply_to_file(calibration, readings, output, outside, advance)
    source = table.read(readings, decimal=decimal)
    result, findings = apply_to_table(calibration, source, outside)
    table.write(output, result)
    return source.count, findings


def apply_to_table(
    calibration: Calibration, source: Table, outside: str
) -> tuple[Table, list[Finding]]:
    """The input's columns and metadata, the results, and what the calibration was."""
    readings, _ = to_readings(source, calibration.profile)
    columns, findings = correct(calibration, readings, outside)
    taken = [name for name in columns if name in source.columns]
    if taken:
        raise InputError(
            f"{source.source}: the column '{taken[0]}' is there already, and would be lost under "
            "the result of that name. Rename it, or correct the readings without it."
        )
    metadata = {**source.metadata, **described(calibration)}
    if findings:
        metadata["findings"] = [finding.text for finding in findings]
    return replace(source, columns={**source.columns, **columns}, metadata=metadata), findings
