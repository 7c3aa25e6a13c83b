"""From as left to as found: what roll tests of one calibration, before and after service, show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from mwdcal.calibration.record import Calibration
from mwdcal.drift.document import ServiceRow
from mwdcal.use.verification import Verdict, VerdictRow


@dataclass(frozen=True)
class ServiceTest:
    """A roll test of a calibration: its day, the verdict, and the SHA-256 of the calibration that it names."""

    day: date
    calibration_sha256: str
    verdict: Verdict


def service_rows(
    calibrations: Sequence[tuple[Calibration, Sequence[str]]], tests: Sequence[ServiceTest]
) -> list[ServiceRow]:
    """Each limit of each calibration that was tested twice or more: the first test against the last.

    `calibrations` each with the SHA-256 by which a test may name it: of its contents, or of its file.
    """
    rows: list[ServiceRow] = []
    for calibration, names in calibrations:
        mine = sorted((t for t in tests if t.calibration_sha256 in names), key=lambda t: t.day)
        if len(mine) > 1 and mine[0].day < mine[-1].day:
            rows += _compared(calibration.day, mine[0], mine[-1])
    return rows


def _compared(calibrated: date, left: ServiceTest, last: ServiceTest) -> Iterator[ServiceRow]:
    """The limits that both tests judge."""
    before = {row.name: row for row in left.verdict.rows}
    for row in last.verdict.rows:
        if row.name not in before:
            continue
        first = before[row.name]
        change, sd = _change(first, row)
        yield ServiceRow(
            calibrated=calibrated.isoformat(),
            as_left_date=left.day.isoformat(),
            as_found_date=last.day.isoformat(),
            name=row.name,
            unit=row.unit,
            limit=row.limit,
            as_left=first.value,
            as_found=row.value,
            change=change,
            standard_uncertainty=sd,
            score=None if change is None or not sd else change / sd,
            as_left_passed=first.passed,
            as_found_passed=row.passed,
        )


def _change(left: VerdictRow, last: VerdictRow) -> tuple[float | None, float | None]:
    """What a figure changed by and its standard uncertainty, the tests being independent."""
    if left.value is None or last.value is None:
        return None, None
    change = last.value - left.value
    if left.uncertainty is None or last.uncertainty is None:
        return change, None
    return change, float(np.hypot(left.uncertainty, last.uncertainty))
