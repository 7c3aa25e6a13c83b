"""A table of readings through a calibration, to a table with the results beside the input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mwdcal.app import streaming
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import carried
from mwdcal.files.contract import check_columns
from mwdcal.files.formats import table
from mwdcal.files.formats.columns import as_text
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import to_readings
from mwdcal.geometry.observables import EXTRAPOLATED
from mwdcal.use.correction import RowCounts, counted

LARGEST_TEXT = 8_000_000
"""Bytes of text that becomes a workbook: memory is some fifty times as much."""
WHOLE_ROWS = 100_000
"""Rows of a Parquet table that becomes a workbook."""
TEXT = (".csv", ".tsv")
"""Suffixes of text tables."""


def apply_to_any(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    missing: str,
    decimal: str,
    advance: Callable[[int, int], None],
) -> tuple[RowCounts, list[Finding]]:
    """Correct a file into another: part by part, or whole where it is short text or a workbook.

    What was seen in the rows, and what the reader should know. `advance` gets how much of a long
    table is done, and the whole.
    """
    if streaming.in_parts(readings, output):
        return streaming.apply_to_file(
            calibration, readings, output, outside, advance, missing=missing, decimal=decimal
        )
    if readings.suffix.lower() in TEXT and output.suffix.lower() == ".xlsx":
        _check_size(readings)
    source = table.read(readings, decimal=decimal, rows=WHOLE_ROWS)
    result, tally, findings = apply_to_table(calibration, source, outside, missing)
    if EXTRAPOLATED in result.columns and output.suffix.lower() != ".parquet":
        words = [as_text(bool(mark)) for mark in result.columns[EXTRAPOLATED]]
        result = replace(result, columns={**result.columns, EXTRAPOLATED: words})
    table.write(output, result)
    formulas = carried.with_formulas(source.columns) if output.suffix.lower() in TEXT else []
    return tally, findings + carried.copied([*source.columns], formulas, output.suffix.lower())


def _check_size(readings: Path) -> None:
    """Refuse text that is too long to be taken whole."""
    size = readings.stat().st_size if readings.is_file() else 0
    if size > LARGEST_TEXT:
        raise InputError(
            f"{readings.name}: a text table that becomes a workbook must have at most {LARGEST_TEXT} "
            f"bytes; got {size}. Split it, or write CSV."
        )


def apply_to_table(
    calibration: Calibration, source: Table, outside: str, missing: str = "refuse"
) -> tuple[Table, RowCounts, list[Finding]]:
    """The input's columns and metadata, the results, and what the calibration was."""
    check_columns(list(source.columns), source.source)
    streaming.check_warmth(calibration, list(source.columns), source.source)
    whole = np.ones(source.count, bool)
    if missing == "blank":
        whole = ~streaming.lacking(source, streaming.wholly_blank([source]))
    if not whole.any():
        raise streaming.nothing(source.source)
    kept = streaming.chosen(source, whole)
    readings, _ = to_readings(kept, calibration.profile)
    results, tally, findings = counted(calibration, readings, outside, source.count - kept.count)
    streaming.check_free(source.columns, list(results), source.source)
    columns = {name: streaming.spread(values, whole) for name, values in results.items()}
    metadata = {**source.metadata, **streaming.described(calibration)}
    if remarks := streaming.stated(metadata, findings):
        metadata["findings"] = remarks
    corrected = replace(source, columns={**source.columns, **columns}, metadata=metadata)
    return corrected, tally, findings + unused_columns(readings.unused)
