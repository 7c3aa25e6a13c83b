"""What a tool may have changed since an earlier calibration that is the prior of a run: turn-on and walk.

The offsets that a calibration finds are those of one switching on. The next one leaves others, and offsets
and scales wander with time. Both add to the covariance of the prior.

Reference: ISCWSA, OWSG error model Rev 5.1, MWD: ABXY and MBXY, ASXY and MSXY.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.prior import PriorInformation
from mwdcal.calibration.readings import TRIADS, Readings, stated_day
from mwdcal.calibration.record import Calibration
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import AGEING, Profile, ageing

JULIAN_YEAR = 365.25
"""Days."""
UNSTATED_YEARS = 1.0
"""Time since the earlier calibration where a run does not state its date, years."""
USUAL_FIELD = 50_000.0
"""Strength of the field of which a magnetometer without nT reads shares, nT."""


@dataclass(frozen=True)
class Ageing:
    """What a triad may have changed by, 1σ: `offset` in g or nT, `scale` as a share."""

    offset: float
    scale: float

    @classmethod
    def of(cls, profile: Profile, triad: str, years: float) -> Ageing:
        """After some years: two switchings on, and the walk between them."""
        turn_on, offset, scale = (ageing(profile, triad, name) for name in AGEING)
        return cls(float(np.sqrt(2 * turn_on**2 + offset**2 * years)), scale * np.sqrt(years))


def aged(
    known: PriorInformation, previous: Calibration, readings: Readings, profile: Profile
) -> PriorInformation:
    """A previous calibration as knowledge of a later run, with what the tool may have changed meanwhile."""
    years, when = _elapsed(previous, readings)
    each = {triad: Ageing.of(profile, triad, years) for triad in TRIADS}
    added = np.zeros(len(known.names))
    for place, name in enumerate(known.names):
        triad, _, parameter = name.partition(" ")
        kind, _, axes = parameter.partition("-")
        unit = USUAL_FIELD if readings.relative and triad == TRIADS[1] else 1.0
        if kind in ("offset", "bias") and "·" not in axes:
            added[place] = each[triad].offset / unit
        elif (kind == "scale" and "·" not in axes) or (
            kind == "gain" and axes in ("xx", "yy", "zz")
        ):
            added[place] = each[triad].scale
    first, second = (each[triad] for triad in TRIADS)
    words = f"{when}: offsets {1e3 * first.offset:.2g} mg and {second.offset:.2g} nT, scales {first.scale:.1g} and "
    return replace(
        known,
        precision=_widened(known.precision, added),
        ageing=f"{words}{second.scale:.1g} (1σ)",
    )


def _elapsed(previous: Calibration, readings: Readings) -> tuple[float, str]:
    """Years between the runs, and how that is known."""
    day = stated_day(readings.metadata)
    if day is None or stated_day(previous.tool) is None:
        return UNSTATED_YEARS, "a year, as not both runs state a date"
    days = abs((day - previous.day).days)
    return days / JULIAN_YEAR, f"{days} day{'s' * (days != 1)}"


def _widened(precision: Array, sd: Array) -> Array:
    """Precision (k, k) when independent errors of standard deviations (k,) come on top.

    P - P Q (I + Q P)⁻¹ P, also where P says nothing of some direction.
    """
    some = np.flatnonzero(sd)
    inner = precision[np.ix_(some, some)] + np.diag(sd[some] ** -2.0)
    across = precision[:, some]
    return np.asarray(precision - across @ np.linalg.solve(inner, across.transpose()))
