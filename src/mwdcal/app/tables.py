"""A table of readings through a calibration, to a table with the results beside the input."""

from __future__ import annotations

from dataclasses import replace

from mwdcal.calibration import Calibration, Finding
from mwdcal.correction import correct
from mwdcal.errors import InputError
from mwdcal.files.runs import to_readings
from mwdcal.files.table import Table


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
    metadata = {
        **source.metadata,
        "calibration_run": calibration.run,
        "calibration_time": calibration.time,
        "azimuth_out": "magnetic",
        "field_unit": calibration.field_unit,
    }
    if findings:
        metadata["findings"] = [finding.text for finding in findings]
    return replace(source, columns={**source.columns, **columns}, metadata=metadata), findings
