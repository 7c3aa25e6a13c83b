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
"""Assumption of a calibration whose run could not show a drift, by the name of the drift."""


def exact_and_steady(assumed: Sequence[str]) -> tuple[list[str], str]:
    """The references among things assumed exact, and a sentence on the steadiness; blank if none is assumed.

    >>> exact_and_steady(["gravity reference", "steady field"])[1]
    'taken as steady during the run, whose order of stations would hide a drift: field. Measure there and back'
    """
    exact = [name for name in assumed if name not in STEADINESS.values()]
    steady = ", ".join(n.removeprefix("steady ") for n in assumed if n not in exact)
    words = "taken as steady during the run, whose order of stations would hide a drift"
    return exact, f"{words}: {steady}. Measure there and back" if steady else ""


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
