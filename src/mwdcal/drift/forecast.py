"""How accurate a calibration will be some years after it, and when it no longer will be accurate enough.

Variance of an angle t years after: that of the calibration, and t times what each group's random walk adds
in a year, both averaged over azimuth and toolface at `TYPICAL` inclination.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import date, timedelta

import numpy as np
from scipy.special import ndtri

from mwdcal.calibration.prediction import CalibratedTools, accuracy
from mwdcal.drift.comparable import DAYS_PER_YEAR, FACTOR_NAMES
from mwdcal.drift.histories import ToolHistory
from mwdcal.drift.walk import WALK_GROUPS, group_places
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Basis, Factors

ACCURACY_PROBABILITY = 0.95
"""Share of directions whose error is to stay within a limit."""
INTERVAL = (0.05, 0.5, 0.95)
"""Shares of the probability below which lie the earliest, the expected and the latest day."""
LONGEST_INTERVAL = 5.0
"""No calibration is called good for longer, years."""
DRAWN_RATES = 2_000
"""Draws of the rates of a tool."""
COVERAGE_FACTOR = float(ndtri((1 + ACCURACY_PROBABILITY) / 2))
"""Standard uncertainties within which that share of normal errors lies."""


@dataclass(frozen=True)
class Growth:
    """Variance of an angle, rad²: of the calibration, and by group what a rate of one adds in a year."""

    angle: str
    calibration: float
    yearly: dict[tuple[str, str], float]

    def rate(self, rates: Mapping[tuple[str, str], Array]) -> Array:
        """What is added in a year (…,), rad², at rates (…,) by group."""
        return np.asarray(sum(share * rates[group] for group, share in self.yearly.items()))


def growths(tool: ToolHistory) -> list[Growth]:
    """The growth of each angle that the latest calibration gives; none of those that it leaves undetermined."""
    latest, names = tool.calibrations[-1], tool.history.names
    size, triads = 12, [triad.name for triad in latest.triads]
    places = [names.index(f"{triad} {title}") for triad in triads for title in FACTOR_NAMES]
    values = tool.history.values[-1][places].reshape(len(triads), size)
    units = [np.zeros(len(places)) for _ in WALK_GROUPS]
    steady = [names[place] for place in places]
    for row, (triad, kind) in zip(units, WALK_GROUPS, strict=True):
        row[group_places(steady, triad, kind)] = 1.0
    block = tool.covariance[-1][np.ix_(places, places)]
    each = np.stack([block, *map(np.diag, units)])[:, None]
    middle = sum(tool.temperature_c) / 2
    tools = replace(
        CalibratedTools.of(latest, middle),
        models=(Factors(Basis(0, middle)),) * len(triads),
        parameters=tuple(row[None] for row in values),
        earth=np.array([tool.earth]),
        free=tool.free[None][..., places],
    )
    result = []
    for angle, sd in accuracy(tools, each).items():
        first, *others = (sd[:, 0] ** 2).tolist()
        if np.isfinite(first):
            yearly = {g: v for g, v in zip(WALK_GROUPS, others, strict=True) if v > 0}
            result.append(Growth(angle, first, yearly))
    return result


def years_to(limit: float, growth: Growth, yearly: Array) -> Array:
    """Years (…,) until the error of an angle exceeds a limit, rad, where its variance grows by `yearly`."""
    room = (limit / COVERAGE_FACTOR) ** 2 - growth.calibration
    return np.asarray(np.maximum(room, 0.0) / np.maximum(yearly, 1e-300))


def day_after(start: date, span: float) -> date:
    """The day that is some years, at most `LONGEST_INTERVAL`, after another."""
    return start + timedelta(days=int(min(max(span, 0.0), LONGEST_INTERVAL) * DAYS_PER_YEAR))
