"""Constants of a run, and drifts within it, as a calibration file states them."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

SHOWN_DRIFT = 3.0
"""A drift is a finding if it is so many times its standard uncertainty; smaller ones are in the uncertainty too."""

STEADINESS = {
    "accelerometer-drift": "steady accelerometer offsets",
    "magnetometer-drift": "steady magnetometer offsets",
    "field-drift": "steady field",
}
"""What is taken as exact of a run in which a drift would not show."""


def taken_as_steady(assumed: Sequence[str]) -> str:
    """What is said of the steadiness among things assumed exact: nothing where there is none.

    >>> taken_as_steady(["gravity reference", "steady field"])
    'taken as steady during the run, whose order of stations would hide a drift: field. Measure there and back'
    """
    names = ", ".join(n.removeprefix("steady ") for n in assumed if n in STEADINESS.values())
    words = "taken as steady during the run, whose order of stations would hide a drift"
    return f"{words}: {names}. Measure there and back" if names else ""


class Constant(msgspec.Struct, frozen=True, kw_only=True):
    """A constant of the run that was estimated, with its standard uncertainty."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


class Drift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift within the run that is part of the fit: the largest change between two stations, 1σ, and unit.

    `name`: "field", or the triad whose offsets drifted.
    """

    name: str
    change: float
    standard_uncertainty: float
    unit: str
