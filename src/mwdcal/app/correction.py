"""A table of readings through a calibration, to a table with the results beside the input."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from mwdcal.app import streaming
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import carried, streams
from mwdcal.files.contract import CHANNELS, check_columns
from mwdcal.files.faults import chosen, nothing, spread, wholly_blank, without_reading
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import as_text
from mwdcal.files.formats.table import EXCHANGED, Table
from mwdcal.files.runs import is_export, read_export, renamed, to_readings
from mwdcal.geometry.observables import EXTRAPOLATED
from mwdcal.sensor.profile import Profile
from mwdcal.use.correction import RowCounts, correct_and_count

LARGEST_TEXT = 8_000_000
"""Bytes of text that becomes a workbook, WITSML or LAS: memory is some fifty times as much."""
WHOLE_ROWS = 100_000
"""Rows of a Parquet table that becomes a workbook, WITSML or LAS."""
TEXT = (".csv", ".tsv")
"""Suffixes of text tables."""
WHOLE = (".xlsx", *EXCHANGED)
"""Suffixes of tables that are written as a whole."""


class Applied(msgspec.Struct, frozen=True, kw_only=True):
    """The result for a table: its rows, those without results, and the table that was written.

    `error_terms` are in the standard uncertainties of the table, `not_included` are not; both are empty where it
    has none.
    """

    rows: int
    blank: int
    output: str
    error_terms: list[str] = []
    not_included: list[str] = []
    findings: list[Finding]


def apply_to_any(
    calibration: Calibration,
    readings: Path,
    output: Path,
    outside: str,
    missing: str,
    decimal: str,
    uncertainty: bool,
    advance: Callable[[int, int], None],
    statements: Mapping[str, str],
) -> tuple[RowCounts, list[Finding], str]:
    """Correct a file into another: part by part, or whole where it is short text or a workbook.

    What was seen in the rows, what the reader should know, and the SHA-256 of the readings, empty
    where they were not read as a whole. `advance` gets how much of a long
    table is done, and the whole. An export as the calibration's profile describes it is taken whole, and
    text that comes of it is written as it is. With `uncertainty` columns of standard uncertainties. `statements`:
    serial, date and operator as the user says.
    """
    profile = calibration.profile
    exported = _is_exported(readings, profile, decimal)
    if streaming.in_parts(readings, output) and not exported:
        streamed = streaming.apply_to_file(
            calibration, readings, output, outside, advance,
            missing=missing, decimal=decimal, uncertainty=uncertainty, statements=statements,
        )  # fmt: skip
        return *streamed, ""
    if readings.suffix.lower() in TEXT and (exported or output.suffix.lower() in WHOLE):
        _check_size(readings)
    source = read_export(readings, profile, decimal=decimal, rows=WHOLE_ROWS, statements=statements)
    result, tally, findings = apply_to_table(calibration, source, outside, missing, uncertainty)
    if EXTRAPOLATED in result.columns and output.suffix.lower() != ".parquet":
        words = [as_text(bool(mark)) for mark in result.columns[EXTRAPOLATED]]
        result = replace(result, columns={**result.columns, EXTRAPOLATED: words})
    form = profile.table if exported and readings.suffix.lower() in TEXT else msgspec.UNSET
    tables.write(output, result, None if isinstance(form, msgspec.UnsetType) else form)
    formulas = carried.with_formulas(source.columns) if output.suffix.lower() in TEXT else []
    findings += carried.copied([*source.columns], formulas, output.suffix.lower())
    return tally, findings, source.digest


def _is_exported(readings: Path, profile: Profile, decimal: str) -> bool:
    """Whether a table is written, or names its columns, as the profile says and not as documented."""
    if isinstance(profile.columns, msgspec.UnsetType):
        return False
    if readings.suffix.lower() in WHOLE:
        return True
    opened = streams.open_parquet if readings.suffix.lower() == ".parquet" else streams.open_text
    try:
        names = opened(readings, decimal=decimal).names
    except InputError:
        return True
    return is_export(names, profile) or not set(CHANNELS["accelerometer"]) <= {*names}


def _check_size(readings: Path) -> None:
    """Refuse text that is too long to be taken whole."""
    size = readings.stat().st_size if readings.is_file() else 0
    if size > LARGEST_TEXT:
        raise InputError(
            f"{readings.name}: an export, or a text table that becomes XLSX, WITSML or LAS, must have at most "
            f"{LARGEST_TEXT} bytes; got {size}. Split it, or write CSV."
        )


def apply_to_table(
    calibration: Calibration,
    source: Table,
    outside: str,
    missing: str = "refuse",
    uncertainty: bool = True,
) -> tuple[Table, RowCounts, list[Finding]]:
    """The input's columns and metadata, the results, and what the calibration was."""
    table = renamed(source, calibration.profile)
    check_columns(list(table.columns), source.source)
    streaming.check_warmth(calibration, list(table.columns), source.source)
    whole = np.ones(source.count, bool)
    if missing == "blank":
        whole = ~without_reading(table, wholly_blank([table]))
    if not whole.any():
        raise nothing(source.source)
    kept = chosen(table, whole)
    readings, _ = to_readings(kept, calibration.profile)
    results, tally, findings = correct_and_count(
        calibration, readings, outside, source.count - kept.count, uncertainty
    )
    streaming.check_free(source.columns, list(results), source.source)
    columns = {name: spread(values, whole) for name, values in results.items()}
    metadata = {**source.metadata, **streaming.described(calibration, [*results])}
    if remarks := streaming.stated(metadata, findings):
        metadata["findings"] = remarks
    corrected = replace(source, columns={**source.columns, **columns}, metadata=metadata)
    return corrected, tally, findings + unused_columns(readings.unused)
