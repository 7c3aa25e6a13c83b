"""How accurate a calibration will be some years after it, and when the tool no longer keeps a limit.

All at `TYPICAL` inclination. Variance of an angle t years after: that of the calibration, and t times what each
group's random walk adds in a year, both averaged over azimuth and toolface. A tool keeps a limit while the largest
error over azimuth and toolface does, which is what a roll test sees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta

import numpy as np
from scipy.special import ndtri

from mwdcal.calibration.prediction import CalibratedTools, accuracy, angle_changes
from mwdcal.drift.comparable import DAYS_PER_YEAR, FACTOR_NAMES
from mwdcal.drift.histories import ToolHistory
from mwdcal.drift.walk import WALK_GROUPS, group_places
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.sensor.models import Basis, Factors

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
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        size = len(next(iter(rates.values()))), len(covariance)
        walk = rng.standard_normal(size, np.float32)
        for group, drawn in rates.items():
            walk[:, places[group]] *= np.sqrt(drawn, dtype=np.float32)[:, None]
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
