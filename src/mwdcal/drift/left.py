"""When a tool left a limit in service: what shortens the time to its next calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from itertools import pairwise

import numpy as np

from mwdcal.calibration.record import FREE_SHARE, Calibration
from mwdcal.drift.comparable import DAYS_PER_YEAR
from mwdcal.drift.forecast import Growth, Outlook
from mwdcal.drift.histories import ToolHistory
from mwdcal.drift.service import ServiceTest
from mwdcal.drift.walk import VISIT
from mwdcal.geometry.vectors import Array

CLEAR_STEP = 3.0
"""Standard uncertainties that a step between calibrations has, to be one."""
SHORTENED = 0.5
"""Share of a time in which a tool left a limit after which it is due: it may have left on any day of it."""
VISIT_DAYS = VISIT * DAYS_PER_YEAR


@dataclass(frozen=True)
class Left:
    """A time in which a tool left a limit, and in words how that is known."""

    start: date
    end: date
    how: str

    @property
    def span(self) -> timedelta:
        """How long after the calibration the tool may be used."""
        return SHORTENED * (self.end - self.start)


@dataclass(frozen=True)
class Departure:
    """The largest change of an angle between two successive calibrations, and its standard uncertainty, rad."""

    angle: str
    start: date
    end: date
    size: float
    uncertainty: float

    def left(self, limits: Mapping[str, float]) -> Iterator[Left]:
        """What it says of limits in degrees by angle."""
        degrees = float(np.degrees(self.size))
        if degrees > limits.get(self.angle, np.inf) and self.size > CLEAR_STEP * self.uncertainty:
            yield Left(self.start, self.end, f"{self.angle} changed by {degrees:.2g}°")


def departures(tool: ToolHistory, outlook: Outlook) -> list[Departure]:
    """The change of each angle from visit to visit, over azimuth and toolface at 45° inclination.

    None of an angle that rests on what one of two calibrations lacks or leaves undetermined.
    """
    history, columns, result = tool.history, outlook.columns, []
    days, free = tool.compared_days, [rows[:, columns] for rows in tool.free]
    for k, (start, end) in enumerate(pairwise(days)):
        if (end - start).days <= VISIT_DAYS:
            continue
        moved = np.diff(history.values[k : k + 2, columns], axis=0)[0]
        covariance = history.covariance[k : k + 2].sum(0)[np.ix_(columns, columns)]
        unknown = np.concatenate(free[k : k + 2])
        each = ((g.angle, _largest(g, moved, covariance, unknown)) for g in outlook.growths)
        result += [Departure(angle, start, end, *both) for angle, both in each if both]
    return result


def _largest(
    growth: Growth, moved: Array, covariance: Array, free: Array
) -> tuple[float, float] | None:
    """The largest change of an angle by parameters that moved, and its standard uncertainty."""
    seen = np.abs(growth.changes).max(0) > 0
    rows, moved = growth.changes[:, seen], moved[seen]
    if np.isnan(moved).any() or np.any(np.abs(rows @ free[:, seen].mT) > FREE_SHARE):
        return None
    row = rows[np.argmax(np.abs(rows @ moved))]
    return abs(float(row @ moved)), float(np.sqrt(row @ covariance[np.ix_(seen, seen)] @ row))


def failures(
    calibrations: Sequence[tuple[Calibration, Sequence[str]]], tests: Sequence[ServiceTest]
) -> Iterator[Left]:
    """Roll tests that found a tool beyond a limit in service, the first of each calibration.

    `calibrations`, oldest first, each with the SHA-256 by which a test may name it. A test in the visit of the
    calibration judges that, unless one before passed. No test was later than the next calibration.
    """
    ends = [*(c.day for c, _ in calibrations[1:]), date.max]
    for (calibration, names), end in zip(calibrations, ends, strict=True):
        passed = False
        mine = (t for t in tests if t.calibration_sha256 in names and t.day > calibration.day)
        for test in sorted(mine, key=lambda t: t.day):
            day = min(test.day, end)
            failed = [r.name for r in test.verdict.rows if r.value is not None and not r.passed]
            if failed and (passed or (day - calibration.day).days > VISIT_DAYS):
                what = f"the roll test of {day} failed ({', '.join(failed)})"
                yield Left(calibration.day, day, what)
                break
            passed = passed or not failed
