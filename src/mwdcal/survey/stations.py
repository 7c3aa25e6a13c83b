"""Surveys: angles and strengths of calibrated readings in a well, each with its standard uncertainty.

The uncertainty is that of the calibration and of the noise of one reading, with the variance that is `added`, such as
that of an error model (`mwdcal.survey.well_errors`); of true and grid azimuths also that of the declination.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import LARGEST_ANGLE_SD, Calibration
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, diagonal
from mwdcal.use.uncertainty import rows_of, without_value

SURVEY_OBSERVABLES = (
    "inclination",
    "azimuth",
    "toolface",
    "north_toolface",
    "gravity",
    "field",
    "dip",
)
"""Observables of a survey, in the order of `Surveys.value`."""
TURNS = np.array([OBSERVABLES[name].period > 0 for name in SURVEY_OBSERVABLES])
"""Which of them are angles of a full turn."""
STRENGTHS = slice(4, 7)
"""Where |g|, |b| and dip lie in it."""
TOOLFACE_SWITCH = (np.radians(3.0), np.radians(5.0))
"""Inclinations below which the toolface counts from magnetic north, and above which from the high side."""
RANDOM = "random-"
"""Start of the names, in `Readings.sd`, of what a reference is uncertain by anew at every station: "random-field"."""
STATIONS_AT_ONCE = 1 << 12
"""Stations whose covariances are computed at once, so that memory does not grow with their number."""


@dataclass(frozen=True)
class Surveys:
    """Observables (n, 7) in the order of `SURVEY_OBSERVABLES`, radians, g, nT, and their standard uncertainties (n, 7).

    NaN: not there, such as azimuth and toolface within the uncertainty of vertical, or without a stated one.
    `strengths` (n, 3, 3): covariance of |g|, |b| and dip. `magnetic` (n,): the toolface counts from magnetic north.
    `ends_magnetic`: so it does behind the last station, until the inclination says otherwise.
    """

    value: Array
    sd: Array
    strengths: Array
    magnetic: Bools
    ends_magnetic: bool

    def of(self, name: str) -> tuple[Array, Array]:
        """An observable (n,) and its standard uncertainty; `toolface` is the one that counts."""
        place, north = SURVEY_OBSERVABLES.index(name), SURVEY_OBSERVABLES.index("north_toolface")
        value, sd = self.value[:, place], self.sd[:, place]
        if name != "toolface":
            return value, sd
        return (
            np.where(self.magnetic, self.value[:, north], value),
            np.where(self.magnetic, self.sd[:, north], sd),
        )


def survey_angles(
    calibration: Calibration,
    readings: Readings,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    advance: Callable[[int, int], None] = lambda done, total: None,
    added: Callable[[Array, Array, Array, slice], Array] | None = None,
    starts_magnetic: bool = False,
) -> Surveys:
    """Surveys from readings, in the order in which they were taken.

    `starts_magnetic`: the toolface counted from magnetic north at the station before.

    Shapes: `readings` of n stations without leading axes. Units: `switch` in radians. `advance` gets how many are
    done, and of how many. `added` gives the variance (m, 7) that some rows have besides, by their gradients
    (m, 7, 6) and both vectors (m, 3).
    Singular: at vertical azimuth and toolface are NaN, the toolface from magnetic north is not.

    Raises:
        InputError: a switch that does not open above where it closes; temperatures are missing that the calibration
            needs.
    """
    low, high = switch
    if not 0 <= low <= high <= np.pi / 2:
        raise InputError(
            f"`switch` must be two inclinations between 0 and 90°, the lower one first; got {np.degrees(low):g}° and "
            f"{np.degrees(high):g}°."
        )
    value = np.empty((readings.count, len(SURVEY_OBSERVABLES)))
    sd, strengths, done = np.empty_like(value), np.empty((readings.count, 3, 3)), 0
    for part in blocks(readings):
        rows = slice(done, done + part.count)
        g, b = calibration.fields(part)
        value[rows] = np.stack([OBSERVABLES[name].value(g, b) for name in SURVEY_OBSERVABLES], -1)
        slopes = calibration.gradients(SURVEY_OBSERVABLES, part)
        covariance = calibration.covariance(SURVEY_OBSERVABLES, part, True, slopes)
        sd[rows] = np.sqrt(np.maximum(diagonal(covariance), 0.0))
        lost = without_value(calibration, part, SURVEY_OBSERVABLES, value[rows], sd[rows])
        value[rows] = np.where(lost, np.nan, value[rows])
        sd[rows] = np.where(lost, np.nan, sd[rows])
        if added is not None:
            whole = np.sqrt(sd[rows] ** 2 + added(slopes, g, b, rows))
            sd[rows] = np.where(TURNS & (whole > LARGEST_ANGLE_SD), np.nan, whole)
        strengths[rows] = covariance[:, STRENGTHS, STRENGTHS]
        done = rows.stop
        advance(done, readings.count)
    there = calibration.has_field and readings.magnetometer is not None
    magnetic = switched(value[:, 0], low, high, starts_magnetic)
    ends = bool(magnetic[-1]) if magnetic.size else starts_magnetic
    return Surveys(value, sd, strengths, magnetic & there, ends)


def blocks(readings: Readings) -> Iterator[Readings]:
    """The readings in parts of `STATIONS_AT_ONCE`, without references and labels."""
    for start in range(0, readings.count, STATIONS_AT_ONCE):
        yield rows_of(readings, slice(start, start + STATIONS_AT_ONCE))


def switched(inclination: Array, low: float, high: float, before: bool = False) -> Bools:
    """Stations (n,) whose toolface is magnetic: from below `low` until above `high`, in their order.

    A first station between the two is as the one `before`, by default gravity toolface.
    """
    decided = np.where(inclination < low, 1, np.where(inclination > high, 0, -1))
    last = np.maximum.accumulate(np.where(decided >= 0, np.arange(len(decided)), -1))
    return np.where(last >= 0, decided[np.maximum(last, 0)] == 1, before)
