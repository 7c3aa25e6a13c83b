"""Contributions: how much of the variance of a survey's angles and of its position each group of errors makes.

The groups are independent, so their variances add up to those of the surveys and of the path, and each has a way it
propagates: *random* errors are new at every station, *systematic* ones last over a run, *well* ones over the well, and
*global* ones over all wells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.survey.error_model import Hole
from mwdcal.survey.path import (
    TieIn,
    direction_errors,
    direction_gradient,
    hole_direction,
    position_covariance,
    tilts,
)
from mwdcal.survey.well import Start, Well
from mwdcal.survey.well_errors import WellErrors, hole_of, with_depth
from mwdcal.use.uncertainty import AXIAL_INTERFERENCE, CORRECTED, DRIFT, OF_MODELS

CORRECTION = "calibration and multi-station analysis"
COURSE_ERRORS = "course between stations"
RANDOM_ERRORS, SYSTEMATIC, OF_WELL = "random", "systematic", "well"
"""Ways of propagation; a fourth one, of error models alone, is global."""
CONTRIBUTED = (
    "inclination", "azimuth", "north", "east", "tvd", "along_hole", "lateral", "highside",
)  # fmt: skip
"""Quantities of a station that errors contribute to: two angles, and the position in two frames."""


class Cause(NamedTuple):
    """A group of errors, and the way it propagates."""

    name: str
    propagation: str


@dataclass(frozen=True)
class Contributions:
    """Variances (c, n, 8) of `CONTRIBUTED` by c causes at stations, rad² and m²; NaN: none stated, or off the path."""

    station: tuple[str, ...]
    md: Array
    causes: tuple[Cause, ...]
    variance: Array

    @cached_property
    def sd(self) -> Array:
        """1σ (c, n, 8) by each cause, rad and m."""
        return np.asarray(np.sqrt(np.maximum(self.variance, 0.0)))

    @cached_property
    def total(self) -> Array:
        """1σ (n, 8) by all causes together, rad and m."""
        return np.asarray(np.sqrt(np.maximum(self.variance, 0.0).sum(0)))

    @cached_property
    def share(self) -> Array:
        """Share (c, n, 8) of each cause in the variance; NaN where this is 0."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.maximum(self.variance, 0.0) / self.total**2)


class _Errors(NamedTuple):
    """Errors at stations by one cause: shifts (n, k, 3), covariance (n, 3, 3) of random ones, (n, 2, 2) of courses."""

    lasting: Array
    random: Array
    course: Array

    @staticmethod
    def of(
        count: int,
        lasting: Array | None = None,
        random: Array | None = None,
        course: Array | None = None,
    ) -> _Errors:
        """Those that are given; of the others there are none."""
        return _Errors(
            np.zeros((count, 0, 3)) if lasting is None else lasting,
            np.zeros((count, 3, 3)) if random is None else random,
            np.zeros((count, 2, 2)) if course is None else course,
        )

    @property
    def angles(self) -> Array:
        """Variance (n, 2) upward and sideways."""
        each = np.diagonal(self.random, axis1=-2, axis2=-1)
        return np.asarray((self.lasting**2).sum(-2) + each)[:, :2]

    def positions(self, hole: Hole, start: Start) -> Array:
        """Covariance (n, 3, 3) of the positions of a hole from where it starts; a tie-in is exact."""
        path, first = [hole.md, hole.inclination, hole.azimuth], isinstance(start, TieIn)
        lasting, random, course = self
        if isinstance(start, TieIn):
            path = [np.concatenate([[a], b]) for a, b in zip(start[:3], path, strict=True)]
            lasting, random, course = (
                np.concatenate([np.zeros((1, *each.shape[1:])), each]) for each in self
            )
        md, inclination, azimuth = path
        covariance = position_covariance(md, inclination, azimuth, lasting, random, course=course)
        return covariance[1:] if first else covariance


def contributions(well: Well) -> Contributions | None:
    """The contributions at all stations of a well; None where azimuths are not measured."""
    calibration, readings, north = well.calibration, well.readings, well.north
    if not calibration.has_field or readings.magnetometer is None:
        return None
    count = readings.count
    depth = np.full(count, np.nan)
    path: Bools = np.zeros(count, bool)
    if well.position is not None:
        depth, path = np.where(well.blank, np.nan, well.position.md), well.position.on_path
    hole = hole_of(calibration, readings, depth, north.offset, well.started)
    causes = _causes(well, readings, hole, np.ones(count, bool))
    positions = np.full((len(causes), count, 3, 3), np.nan)
    if path.any():
        some = readings if path.all() else readings.select(path)
        below = hole_of(calibration, some, depth[path], north.of_path(count)[0][path], well.started)
        along = causes if path.all() else _causes(well, some, below, path)
        positions[:, path] = [along[cause].positions(below, well.started) for cause in causes]
    frame = _frame(hole)
    spread = np.einsum("nij,cnjk,nik->cni", frame, positions, frame)
    if well.position is not None:
        lost = np.asarray(np.isnan(well.position.covariance).any((-1, -2)))
        spread = np.where(lost[:, None], np.nan, spread)
    angles = _angles(well, np.stack([errors.angles for errors in causes.values()]))
    labels = tuple(readings.labels)
    return Contributions(labels, depth, (*causes,), np.concatenate([angles, spread], -1))


def _angles(well: Well, turns: Array) -> Array:
    """Variances (c, n, 2) of inclination and azimuth by those upward and sideways, where these are stated."""
    stated = np.stack([np.isfinite(well.surveys.of(name)[1]) for name in CONTRIBUTED[:2]], -1)
    sine = np.sin(well.surveys.of("inclination")[0])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(stated, turns / np.stack([np.ones_like(sine), sine**2], -1), np.nan)


def _frame(hole: Hole) -> Array:
    """Directions (n, 6, 3) to look at positions in: north, east, down, along the hole, to its right, and up."""
    upward, sideways = np.moveaxis(tilts(hole.inclination, hole.azimuth), -2, 0)
    along = hole_direction(hole.inclination, hole.azimuth)
    earth = np.broadcast_to(np.eye(3), (len(along), 3, 3))
    return np.concatenate([earth, np.stack([along, sideways, upward], 1)], 1)


def _causes(well: Well, readings: Readings, hole: Hole, rows: Bools) -> dict[Cause, _Errors]:
    """Errors of direction and depth by cause at some rows; all together are those of the path of the well."""
    calibration, count = well.calibration, readings.count
    _, shared, alone = (value[rows][:, None, None] for value in well.north.of_path(len(rows)))
    whole = direction_errors(calibration, readings, declination_sd=1.0)
    lasting, noise = with_depth(whole.systematic), np.zeros((count, 3, 3))
    noise[:, :2, :2] = whole.random
    turn = lasting[:, -1:]  # by 1 rad of north
    daily = turn.mT @ turn * alone**2
    corrected = any(finding.id == CORRECTED for finding in calibration.findings)
    result = {
        Cause(CORRECTION if corrected else "calibration", SYSTEMATIC): _Errors.of(
            count, lasting[:, :-1]
        ),
        Cause("noise", RANDOM_ERRORS): _Errors.of(count, random=noise),
        Cause("declination", OF_WELL): _Errors.of(count, turn * shared),
        Cause("declination", RANDOM_ERRORS): _Errors.of(count, random=daily),
    }
    if well.errors is not None:
        result |= _modelled(well.errors, calibration.fields(readings), hole)
    return {cause: errors for cause, errors in result.items() if any(map(np.any, errors))}


def _modelled(errors: WellErrors, fields: tuple[Array, Array], hole: Hole) -> dict[Cause, _Errors]:
    """Those of an error model: of the sensors, and by its formulas, which belong together by their names."""
    _, gradient = direction_gradient(*fields)
    sensors = with_depth(errors.columns(*fields, errors.unit(hole)) @ gradient.mT)
    count, modes = len(hole.md), {t.name: t.propagation_mode.lower() for t in errors.model.terms}
    result = {
        Cause(AXIAL_INTERFERENCE, SYSTEMATIC): _Errors.of(count, sensors[:, 12:]),
        Cause(DRIFT, SYSTEMATIC): _Errors.of(count, sensors[:, :12]),
    }
    groups: dict[Cause, list[Array]] = {}
    for kind in ("lasting", "random", "course"):
        for name, shift in errors.model.shifts(hole, kind).items():
            group = next((g for start, g in OF_MODELS.items() if name.startswith(start)), name)
            cause = Cause(COURSE_ERRORS if kind == "course" else group, modes[name])
            groups.setdefault(cause, []).append(shift)
    for cause, shifts in groups.items():
        each = np.stack(shifts, 1)
        if cause.name == COURSE_ERRORS:
            result[cause] = _Errors.of(count, course=(each.mT @ each)[:, :2, :2])
        elif cause.propagation == RANDOM_ERRORS:
            result[cause] = _Errors.of(count, random=each.mT @ each)
        else:
            result[cause] = _Errors.of(count, each)
    return result
