"""Constants of a run, and drifts within it, as a calibration file states them."""

from __future__ import annotations

import msgspec

SHOWN_DRIFT = 3.0
"""A drift is a finding if it is so many times its standard uncertainty; smaller ones are in the uncertainty too."""


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
