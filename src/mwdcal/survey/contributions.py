"""Contributions: how much of the variance of a survey's angles and of its position each group of errors makes.

The groups are independent, so their variances add up to those of the surveys and of the path, and each has a way it
propagates: *random* errors are new at every station, *systematic* ones last over a run, *well* ones over the well, and
*global* ones over all wells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.survey.error_model import Hole
from mwdcal.survey.path import (
    SeenDirection,
    TieIn,
    direction_errors,
    hole_direction,
    position_covariance,
    tilts,
)
from mwdcal.survey.well import SENSOR_CAUSES, SeenHole, Start, Well, WellErrors, hole_of, with_depth
from mwdcal.use.uncertainty import AXIAL_INTERFERENCE, CORRECTED, DRIFT, OF_MODELS

CORRECTION = "calibration and multi-station analysis"
COURSE_ERRORS = "course between stations"
DECLINATION = "declination"
PARTED = (DECLINATION, *OF_MODELS.values())
"""Causes that may propagate in several ways."""
RANDOM_ERRORS, SYSTEMATIC, OF_WELL = "random", "systematic", "well"
"""Ways of propagation; a fourth one, of error models alone, is global."""
SHARED_BY = {
    RANDOM_ERRORS: "each station", SYSTEMATIC: "whole run", OF_WELL: "whole well", "global": "all wells",
}  # fmt: skip
"""The stations that share an error, by the way that it propagates."""
CONTRIBUTED = (
    "inclination", "azimuth", "north", "east", "tvd", "along_hole", "lateral", "highside",
)  # fmt: skip
"""Quantities of a station that errors contribute to: two angles, and the position in two frames."""


class Cause(NamedTuple):
    """A group of errors, and the way it propagates."""

    name: str
    propagation: str


TIE_IN = Cause("tie-in", OF_WELL)
"""The position where the path is tied in."""


@dataclass(frozen=True)
class Contributions:
    """Variances (c, n, 8) of `CONTRIBUTED` by c causes at stations, rad² and m²; NaN: none stated, or off the path."""

    station: tuple[str, ...]
    md: Array
    causes: tuple[Cause, ...]
    variance: Array

    @cached_property
    def names(self) -> tuple[str, ...]:
        """A name of each cause (c,) that no other has: of those that propagate in several ways with their reach."""
        return tuple(
            f"{name}, {SHARED_BY[propagation]}" if name in PARTED else name
            for name, propagation in self.causes
        )

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

    def positions(self, runs: Sequence[_Run], start: Start) -> Array:
        """Covariance (n, 3, 3) of the positions of runs from where the first one starts; a tie-in is exact."""
        holes = [run.below for run in runs if run.path.any()]
        md, inclination, azimuth = (
            np.concatenate([getattr(hole, name) for hole in holes])
            for name in ("md", "inclination", "azimuth")
        )
        lasting, random, course = self
        first = isinstance(start, TieIn)
        if isinstance(start, TieIn):
            path = zip(start[:3], (md, inclination, azimuth), strict=True)
            md, inclination, azimuth = (np.concatenate([[a], b]) for a, b in path)
            lasting, random, course = (
                np.concatenate([np.zeros((1, *each.shape[1:])), each]) for each in self
            )
        covariance = position_covariance(md, inclination, azimuth, lasting, random, course=course)
        return covariance[1:] if first else covariance


class _Run(NamedTuple):
    """A run: its hole and causes at all stations, and at those of the path (n,)."""

    well: Well
    hole: Hole
    causes: dict[Cause, _Errors]
    path: Bools
    below: Hole
    along: dict[Cause, _Errors]


def contributions(wells: Sequence[Well]) -> Contributions | None:
    """The contributions at all stations of a well, in one or several runs; None where azimuths are not measured."""
    if any(not w.calibration.has_field or w.readings.magnetometer is None for w in wells):
        return None
    runs = [_run(well) for well in wells]
    causes = tuple(dict.fromkeys(cause for run in runs for cause in run.causes))
    path = np.concatenate([run.path for run in runs])
    positions = np.full((len(causes), len(path), 3, 3), np.nan)
    start = wells[0].started
    if path.any():
        along = [_joined_errors(runs, cause) for cause in causes]
        positions[:, path] = [errors.positions(runs, start) for errors in along]
    if isinstance(start, TieIn) and start.covariance is not None and start.covariance.any():
        fixed = np.where(path[:, None, None], start.covariance, np.nan)
        positions, causes = np.concatenate([positions, fixed[None]]), (*causes, TIE_IN)
    frame = np.concatenate([_frame(run.hole) for run in runs])
    spread = np.einsum("nij,cnjk,nik->cni", frame, positions, frame)
    lost = np.concatenate([_lost(well) for well in wells])
    spread = np.where(lost[:, None], np.nan, spread)
    angles = np.concatenate([_angles(run, causes) for run in runs], 1)
    labels = [[*well.readings.labels] for well in wells]
    if len(wells) > 1:
        labels = [[f"{i}:{name}" for name in each] for i, each in enumerate(labels, 1)]
    depth = np.concatenate([_depth(well) for well in wells])
    variance = np.concatenate([angles, spread], -1)
    return Contributions(tuple(name for each in labels for name in each), depth, causes, variance)


def _run(well: Well) -> _Run:
    """A run of a well."""
    readings, north, count = well.readings, well.north, well.readings.count
    path = np.zeros(count, bool) if well.position is None else well.position.on_path
    depth, offset = np.where(well.blank, np.nan, _depth(well)), north.of_path(count)[0]
    seen = SeenHole.at(well.calibration, readings)
    hole = hole_of(well.calibration, readings, seen, depth, offset, well.started)
    causes = _causes(well, readings, seen, hole, np.ones(count, bool))
    if path.all() or not path.any():
        return _Run(well, hole, causes, path, hole, causes if path.any() else {})
    some = readings.select(path)
    seen = seen.part(path)
    below = hole_of(well.calibration, some, seen, depth[path], offset[path], well.started)
    return _Run(well, hole, causes, path, below, _causes(well, some, seen, below, path))


def _depth(well: Well) -> Array:
    return np.full(well.readings.count, np.nan) if well.position is None else well.position.md


def _lost(well: Well) -> Bools:
    """Stations (n,) without a statement of the accuracy of their position."""
    if well.position is None:
        return np.ones(well.readings.count, bool)
    return np.asarray(np.isnan(well.position.covariance).any((-1, -2)))


def _joined_errors(runs: Sequence[_Run], cause: Cause) -> _Errors:
    """The errors of one cause along all runs: its lasting ones are the same in all, or each run has its own."""
    counts = [int(run.path.sum()) for run in runs]
    parts = [run.along.get(cause, _Errors.of(n)) for run, n in zip(runs, counts, strict=True)]
    if cause.propagation not in (RANDOM_ERRORS, SYSTEMATIC):
        owners = [0] * len(runs)
    elif cause.name == "calibration":
        calibrations = [run.well.calibration for run in runs]
        owners = [
            next(i for i, other in enumerate(calibrations) if _same(other, calibration))
            for calibration in calibrations
        ]
    else:
        owners = [*range(len(runs))]
    widths = {
        owner: max(p.lasting.shape[1] for p, o in zip(parts, owners, strict=True) if o == owner)
        for owner in owners
    }
    blocks = [
        np.concatenate(
            [
                part.lasting if o == owner else np.zeros((n, width, 3))
                for o, width in widths.items()
            ],
            1,
        )
        if part.lasting.shape[1]
        else np.zeros((n, sum(widths.values()), 3))
        for part, owner, n in zip(parts, owners, counts, strict=True)
    ]
    return _Errors(
        np.concatenate(blocks), *(np.concatenate([part[k] for part in parts]) for k in (1, 2))
    )


def _same(one: Calibration, other: Calibration) -> bool:
    """Whether two calibrations are the same: their errors are then the same too."""
    return np.array_equal(one.parameters, other.parameters) and np.array_equal(
        one.parameter_covariance, other.parameter_covariance
    )


def _angles(run: _Run, causes: Sequence[Cause]) -> Array:
    """Variances (c, n, 2) of inclination and azimuth by causes, where 1σ of these is stated."""
    well, none = run.well, _Errors.of(run.well.readings.count)
    turns = np.stack([run.causes.get(cause, none).angles for cause in causes])
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


def _causes(
    well: Well, readings: Readings, seen: SeenHole, hole: Hole, rows: Bools
) -> dict[Cause, _Errors]:
    """Errors of direction and depth by cause at some rows; all together are those of the path of the well."""
    calibration, count = well.calibration, readings.count
    _, shared, alone = (value[rows][:, None, None] for value in well.north.of_path(len(rows)))
    whole = direction_errors(calibration, readings, declination_sd=1.0, seen=seen.direction)
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
        Cause(DECLINATION, OF_WELL): _Errors.of(count, turn * shared),
        Cause(DECLINATION, RANDOM_ERRORS): _Errors.of(count, random=daily),
    }
    if well.errors is not None:
        result |= _modelled(well.errors, seen.direction, hole)
    return {cause: errors for cause, errors in result.items() if any(map(np.any, errors))}


def _modelled(errors: WellErrors, seen: SeenDirection, hole: Hole) -> dict[Cause, _Errors]:
    """Those of an error model: of the sensors, and by its formulas, which belong together by their names."""
    sensors = with_depth(errors.moved(seen.gradient, seen.g, seen.b, hole))
    count, modes = len(hole.md), {t.name: t.propagation_mode.lower() for t in errors.model.terms}
    result = {
        Cause(AXIAL_INTERFERENCE, SYSTEMATIC): _Errors.of(count, sensors[:, SENSOR_CAUSES - 1 :]),
        Cause(DRIFT, SYSTEMATIC): _Errors.of(count, sensors[:, : SENSOR_CAUSES - 1]),
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
