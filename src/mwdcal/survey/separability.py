"""Which survey would separate interference from azimuth, or determine a direction of it."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import msgspec
import numpy as np

from mwdcal.calibration.prediction import readings_at
from mwdcal.calibration.readings import CONSTANTS
from mwdcal.calibration.record import Calibration
from mwdcal.estimation.evidence import ANGLES
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import AnyArray, Array, tool_from_earth
from mwdcal.survey.interference_estimate import DETERMINED_SHARE, Estimate, estimate

INCLINATIONS = np.radians(np.arange(5.0, 91.0, 10.0))
"""Inclinations of the surveys that are tried, rad."""
AROUND = np.radians(np.arange(0.0, 360.0, 15.0))
"""Azimuths, or toolfaces, of the surveys that are tried, rad."""


def missing(whole: Estimate, corrected: Calibration, calibration: Calibration) -> str:
    """The further survey that would help, in sentences; empty if none is needed."""
    parts = []
    if not whole.separable[0]:
        parts.append(_attitude(whole, corrected, calibration))
    if not whole.determined[0, :2].all():
        parts.append(_toolface(whole, corrected, calibration))
    return " ".join(parts)


def _attitude(whole: Estimate, corrected: Calibration, calibration: Calibration) -> str:
    """The survey, nearest to the last one, that makes all azimuths of use."""
    here = _last(whole, corrected)
    grid = np.meshgrid(INCLINATIONS, AROUND, indexing="ij")
    inc, azi = (each.ravel() for each in grid)
    more = _with_one_more(whole, corrected, calibration, inc, azi, np.full(inc.shape, here[2]))
    sd = more.azimuth_sd[:, : whole.readings.count].max(-1)
    limit = whole.assumed.largest_azimuth_sd_deg
    enough = np.degrees(sd) <= limit
    axes = tool_from_earth(inc, azi, 0.0)[:, 2] @ tool_from_earth(*here)[2]
    best = int(np.argmax(np.where(enough, axes, -2.0)) if enough.any() else np.argmin(sd))
    at = f"inclination {np.degrees(inc[best]):.0f}°, azimuth {np.degrees(azi[best]):.0f}°"
    if enough.any():
        return (
            f"A survey farther from horizontal east-west is missing: one at {at} would bring the "
            f"azimuth to {np.degrees(sd[best]):.2g}° (1σ)."
        )
    return (
        f"No single survey would do: the best, at {at}, would bring the azimuth to {np.degrees(sd[best]):.2g}° "
        f"(1σ), and {limit:g}° is wanted. Use references of field and dip that are measured at the place."
    )


def _toolface(whole: Estimate, corrected: Calibration, calibration: Calibration) -> str:
    """The toolface, at the last attitude, that determines cross-axial interference best."""
    inc, azi, _ = (np.full(AROUND.shape, angle) for angle in _last(whole, corrected))
    sd = _with_one_more(whole, corrected, calibration, inc, azi, AROUND).sd[:, :2].max(-1)
    best = int(np.argmin(sd))
    face, size = f"toolface {np.degrees(AROUND[best]):.0f}°", f"{sd[best]:.2g} nT (1σ)"
    if sd[best] < DETERMINED_SHARE * whole.assumed.cross_axial_nt:
        return (
            f"Another toolface is missing for cross-axial interference: a survey at {face}, at the last "
            f"attitude, would bring it to {size}."
        )
    return (
        "Several other toolfaces are missing for cross-axial interference: the best single survey, at "
        f"{face} of the last attitude, would bring it to {size}."
    )


def _last(whole: Estimate, corrected: Calibration) -> tuple[float, float, float]:
    """Inclination, azimuth and toolface of the last station; zero for those that vertical has not."""
    vectors = corrected.fields(whole.readings)
    values = (OBSERVABLES[name].value(*vectors)[-1] for name in ANGLES)
    inc, azi, face = (float(np.nan_to_num(value)) for value in values)
    return inc, azi, face


def _with_one_more(
    whole: Estimate, corrected: Calibration, calibration: Calibration,
    inc: Array, azi: Array, face: Array,
) -> Estimate:  # fmt: skip
    """The estimates if one more survey, of attitude (c,), follows: a batch of these."""
    readings = whole.readings
    place = {name: float(readings.known[name][-1]) for name in CONSTANTS}
    earth = {
        "gravity_g": place["gravity"], "field": place["field"], "dip_deg": np.degrees(place["dip"])
    }  # fmt: skip
    there = msgspec.structs.replace(corrected, earth=earth)
    warmth = None if readings.temperature is None else readings.temperature[-1]
    added = readings_at(there, inc[:, None], azi[:, None], face[:, None], warmth)

    def joined(ours: AnyArray, theirs: AnyArray) -> AnyArray:
        first = np.broadcast_to(ours, (len(inc), *ours.shape))
        return np.concatenate([first, np.broadcast_to(theirs, (len(inc), 1, *ours.shape[1:]))], 1)

    repeated = np.append(np.arange(readings.count), readings.count - 1)
    longer = replace(
        readings,
        accelerometer=joined(readings.accelerometer, added.accelerometer),
        magnetometer=joined(cast(Array, readings.magnetometer), cast(Array, added.magnetometer)),
        temperature=None if readings.temperature is None else readings.temperature[repeated],
        known={name: value[repeated] for name, value in readings.known.items()},
        sd={name: value[repeated] for name, value in readings.sd.items()},
        group=None if readings.group is None else np.append(readings.group, -1),
        station=(),
        digest=(),
    )
    return estimate(calibration, longer, replace(whole.assumed, robust=None))
