"""How accurate a calibration will be some years after it, and when the tool no longer keeps a limit.

All at `TYPICAL` inclination. Variance of an angle t years after: that of the calibration, and t times what each
group's random walk adds in a year, both averaged over azimuth and toolface. A tool keeps a limit while the largest
error over azimuth and toolface does, which is what a roll test sees.

When a tool left a limit in service: what shortens the time to its next calibration.

From as left to as found: what roll tests of one calibration, before and after service, show.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from mwdcal.calibration.prediction import CalibratedTools, accuracy, angle_changes
from mwdcal.calibration.record import FREE_SHARE, Calibration
from mwdcal.drift.document import ServiceRow
from mwdcal.drift.histories import ToolHistory
from mwdcal.drift.walk import DAYS_PER_YEAR, FACTOR_NAMES, VISIT, WALK_GROUPS, group_places
from mwdcal.geometry.vectors import AnyArray, Array, square_root
from mwdcal.sensor.models import Basis, Factors
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


ACCURACY_PROBABILITY = 0.95
"""Share of directions whose error is to stay within a limit."""
RISK = 0.05
"""Probability that a tool is beyond a limit on the day when it is due."""
INTERVAL = (RISK, 0.5, 1 - RISK)
"""Shares of the probability below which lie the earliest, the expected and the latest value."""
LONGEST_INTERVAL = 5.0
"""No calibration is called good for longer, years."""
DRAWN_PATHS = 2_000
"""Draws of what is not known of a tool: its rates, the error of its calibration, and where it walks."""
LEAST_SPEED = np.float32(1e-12)
"""Walk of an angle in a year, rad, that keeps any limit."""
COVERAGE_FACTOR = float(ndtri((1 + ACCURACY_PROBABILITY) / 2))
"""Standard uncertainties within which that share of normal errors lies."""


@dataclass(frozen=True)
class Growth:
    """Variance of an angle, rad²: of the calibration, and by group what a rate of one adds in a year.

    `changes` (a, p) of the angle by the parameters of the triads at the middle temperature, over azimuth and
    toolface.
    """

    angle: str
    calibration: float
    yearly: dict[tuple[str, str], float]
    changes: Array

    def rate(self, rates: Mapping[tuple[str, str], Array]) -> Array:
        """What is added in a year (…,), rad², at rates (…,) by group."""
        return np.asarray(sum(share * rates[group] for group, share in self.yearly.items()))

    def kept(self, paths: Paths, limit: float) -> tuple[Array, Array]:
        """On each of n paths the years (n,) after which the largest error exceeds a limit, and that error at first.

        A path is straight in √t, with the distribution that a walk has at each time: where it has left a limit
        it does not come back, so that the share of paths that have left by t is the probability to be beyond at t.
        Units: radians.
        """
        changes = self.changes.mT.astype(np.float32)
        error, walk = paths.error @ changes, paths.walk @ changes
        largest = np.maximum(error.max(-1), -error.min(-1))
        error *= np.sign(walk)  # in place: no new array for each step
        left, speed = np.subtract(np.float32(limit), error, out=error), np.abs(walk, out=walk)
        span = np.min(np.divide(left, np.maximum(speed, LEAST_SPEED, out=speed), out=left), -1)
        return np.where(largest > limit, 0.0, np.maximum(span, 0.0)) ** 2, largest


@dataclass(frozen=True)
class Paths:
    """Draws of what parameters (n, p) are wrong by: on the day of the calibration, and by the walk of a year."""

    error: AnyArray
    walk: AnyArray

    @classmethod
    def of(
        cls, covariance: Array, places: Mapping[tuple[str, str], Sequence[int]],
        rates: Mapping[tuple[str, str], Array], rng: np.random.Generator,
    ) -> Paths:  # fmt: skip
        """By the covariance (p, p) of a calibration, and drawn rates (n,) of groups of parameters at `places`."""
        draws, root = len(next(iter(rates.values()))), square_root(covariance)
        walk = rng.standard_normal((draws, len(covariance)), np.float32)
        for group, drawn in rates.items():
            walk[:, places[group]] *= np.sqrt(drawn, dtype=np.float32)[:, None]
        size = draws, root.shape[1]
        return cls(rng.standard_normal(size, np.float32) @ root.mT.astype(np.float32), walk)


@dataclass(frozen=True)
class Outlook:
    """What a calibration lets one forecast: the growth of each angle that it determines.

    `places` of all parameters of its triads in the history, of each group among them; `covariance` (p, p) of them.
    """

    growths: list[Growth]
    columns: list[int]
    places: dict[tuple[str, str], list[int]]
    covariance: Array


def outlook(tool: ToolHistory) -> Outlook:
    """The outlook of the latest calibration; no growth of an angle that it leaves undetermined."""
    latest, names = tool.calibrations[-1], tool.history.names
    size, triads = 12, [triad.name for triad in latest.triads]
    columns = [names.index(f"{triad} {title}") for triad in triads for title in FACTOR_NAMES]
    values = tool.history.values[-1][columns].reshape(len(triads), size)
    steady = [names[place] for place in columns]
    places = {group: group_places(steady, *group) for group in WALK_GROUPS}
    units = np.zeros((len(WALK_GROUPS), len(columns)))
    for row, some in zip(units, places.values(), strict=True):
        row[some] = 1.0
    block = tool.covariance[-1][np.ix_(columns, columns)]
    each = np.stack([block, *map(np.diag, units)])[:, None]
    middle = sum(tool.temperature_c) / 2
    tools = replace(
        CalibratedTools.of(latest, middle),
        models=(Factors(Basis(0, middle)),) * len(triads),
        parameters=tuple(row[None] for row in values),
        earth=np.array([tool.earth]),
        free=tool.free[-1][None][..., columns],
    )
    changes, growths = angle_changes(tools), []
    for angle, sd in accuracy(tools, each).items():
        first, *others = (sd[:, 0] ** 2).tolist()
        if np.isfinite(first):
            yearly = {g: v for g, v in zip(WALK_GROUPS, others, strict=True) if v > 0}
            growths.append(Growth(angle, first, yearly, changes[angle][0]))
    return Outlook(growths, columns, {g: p for g, p in places.items() if p}, block)


def day_after(start: date, span: float) -> date:
    """The day that is some years, at most `LONGEST_INTERVAL`, after another."""
    return start + timedelta(days=int(min(max(span, 0.0), LONGEST_INTERVAL) * DAYS_PER_YEAR))


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
