"""Errors in the hole that no stand shows: what an error model adds to the calibration of one tool.

The model's terms for sensors state what a tool of its kind may be off. Here the covariance of this tool's calibration
is used instead, with the drift since: it grows with the square root of time, and after a year it is as large as those
terms. Interference along the tool is an error of the axial magnetometer, and so also turns the dip and changes |b|.
All other terms act through the formulas of the model. Its terms for declination are left out: the declination has its
own uncertainty (`mwdcal.survey.norths`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.automatic.ageing import JULIAN_YEAR
from mwdcal.calibration.readings import Readings, stated_day
from mwdcal.calibration.record import Calibration
from mwdcal.digests import sha256_of
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, ArrayLike, Bools
from mwdcal.survey.acceptance import SensorTerms
from mwdcal.survey.error_model import ErrorModel, Hole
from mwdcal.survey.path import DirectionErrors, PathEnd, TieIn, direction_gradient, well_path
from mwdcal.survey.stations import SURVEY_OBSERVABLES, blocks
from mwdcal.use.uncertainty import AXIAL_INTERFERENCE, CORRECTED, DRIFT, DRIFTED, OF_MODELS

DRIFT_YEARS = 1.0
"""Time after which the sensors may have drifted by as much as the model's terms for sensors, years."""
SENSOR_CAUSES = 13
"""Independent errors of the sensors: bias and scale of every axis, and interference along the tool."""
_SENSORS = ("AB", "AS", "MB", "MS")
_WALKS = (
    "accelerometer_bias_ms2", "accelerometer_scale", "magnetometer_bias_nt", "magnetometer_scale",
)  # fmt: skip
_DECLINATION_TERMS = ("DEC", "DBH")
_INTERFERENCE = "AMIL"


@dataclass(frozen=True)
class WellErrors:
    """The errors that count for the surveys of a well.

    `model`: terms that act by their formulas. `sensors`: drift of biases and scales since the calibration and
    interference along the tool, 1σ. `years` since the calibration; None: not known. `relative`: the magnetometer is
    calibrated to a field of 1, whose size the references tell. `by_walk`: the drift is the random walk of this tool.
    """

    model: ErrorModel
    sensors: SensorTerms
    years: float | None
    relative: bool = False
    by_walk: bool = False

    def columns(self, g: Array, b: Array, unit: ArrayLike = 1.0) -> Array:
        """Errors (n, 13, 6) of both vectors by 1σ of each independent cause that lasts over a run.

        `unit` of the field, nT: that of a magnetometer calibrated to a field of 1 is the field itself.
        """
        sensors, one = self.sensors, np.ones((len(g), 1))
        bias = np.repeat(
            [sensors.accelerometer_bias_ms2 / STANDARD_GRAVITY, sensors.magnetometer_bias_nt], 3
        )
        scale = np.repeat([sensors.accelerometer_scale, sensors.magnetometer_scale], 3)
        size = one / np.broadcast_to(unit, (len(g),))[:, None]
        biases = bias * np.concatenate([one, one, one, size, size, size], -1)
        each = np.concatenate(
            [
                biases[..., None] * np.eye(6),
                (scale * np.concatenate([g, b], -1))[..., None] * np.eye(6),
            ],
            1,
        )
        axial = (sensors.axial_interference_nt * size)[..., None] * np.eye(6)[5:]
        return np.asarray(np.nan_to_num(np.concatenate([each, axial], 1)))

    def variances(self, gradient: Array, g: Array, b: Array, hole: Hole) -> Array:
        """Variance (n, 7) that all terms add to the observables of a survey, in the order of `SURVEY_OBSERVABLES`.

        `gradient` (n, 7, 6) of these by both vectors.
        Errors of the hole's direction against the tool, such as sag, leave the toolface as it is.
        """
        result = ((gradient @ self.columns(g, b, self.unit(hole)).mT) ** 2).sum(-1)
        systematic, random, _ = self.model.errors(hole)
        upward, sideways = ((systematic[..., i] ** 2).sum(-1) + random[..., i, i] for i in range(2))
        with np.errstate(divide="ignore", invalid="ignore"):
            azimuth = sideways / np.sin(hole.inclination) ** 2
        result[:, SURVEY_OBSERVABLES.index("inclination")] += upward
        result[:, SURVEY_OBSERVABLES.index("azimuth")] += azimuth
        return np.asarray(result)

    @property
    def included(self) -> list[str]:
        """Parts of it that are in the standard uncertainties, by the names of `use.uncertainty.error_terms`."""
        names = [AXIAL_INTERFERENCE] if self.sensors.axial_interference_nt else []
        names += [DRIFT] if self.sensors.magnetometer_bias_nt else []
        starts = [term.name for term in self.model.terms]
        return names + [
            n for letters, n in OF_MODELS.items() if any(s.startswith(letters) for s in starts)
        ]

    def unit(self, hole: Hole) -> ArrayLike:
        """The unit of the field, nT, that `columns` take."""
        return hole.quantities["bfield"] if self.relative else 1.0

    def of_surveys(
        self,
        calibration: Calibration,
        readings: Readings,
        md: Array | None,
        before: Sequence[float] | TieIn | PathEnd,
        seen: SeenHole,
    ) -> Callable[[Array, Array, Array, slice], Array]:
        """The variance of observables at some rows, by their gradients and both vectors."""
        depth = np.full(readings.count, np.nan) if md is None else md
        hole = hole_of(calibration, readings, seen, depth, 0.0, before)
        return lambda gradient, g, b, rows: self.variances(gradient, g, b, hole.part(rows))

    def of_path(
        self, calibration: Calibration, hole: Hole
    ) -> Callable[[DirectionErrors, Readings, slice], DirectionErrors]:
        """Adds the errors of the model to those of directions at some rows of a well."""
        return lambda errors, readings, rows: self.along(
            errors, *calibration.fields(readings), hole.part(rows)
        )

    def along(self, errors: DirectionErrors, g: Array, b: Array, hole: Hole) -> DirectionErrors:
        """Errors of direction and depth along a well: those given, and those of the model."""
        _, gradient = direction_gradient(g, b)
        sensors = with_depth(self.columns(g, b, self.unit(hole)) @ gradient.mT)
        systematic, random, course = self.model.errors(hole)
        noise = np.zeros_like(random)
        noise[:, :2, :2] = errors.random
        lasting = np.concatenate([with_depth(errors.systematic), sensors, systematic], -2)
        return DirectionErrors(errors.inclination, errors.azimuth, lasting, noise + random, course)


def cause_names(calibration: Calibration, errors: WellErrors | None) -> tuple[str, ...]:
    """Names of the causes that last, in the order of `DirectionErrors.systematic`; those of one run alone have none.

    Causes of one name are the same in all runs of a well: the calibration, if it is the same one, the declination, and
    terms of the model that last over the well or all wells.
    """
    digest = sha256_of(
        calibration.parameters.tobytes() + calibration.parameter_covariance.tobytes()
    )
    names = [f"calibration {digest} {i}" for i in range(len(calibration.parameter_covariance))]
    names.append("declination")
    if errors is None:
        return (*names,)
    terms = [term for term in errors.model.terms if term.kind == "lasting"]
    ours = [t.name if t.propagation_mode in ("Well", "Global") else "" for t in terms]
    return (*names, *[""] * SENSOR_CAUSES, *ours)


def with_depth(shifts: Array) -> Array:
    """Shifts (n, k, 3) of direction alone (n, k, 2), which leave depths as they are."""
    return np.concatenate([shifts, np.zeros((*shifts.shape[:-1], 1))], -1)


def well_errors(
    model: ErrorModel, calibration: Calibration, readings: Readings, walk: SensorTerms | None = None
) -> WellErrors:
    """The errors that an error model adds to surveys by a calibration.

    `walk`: 1σ of what the sensors of this tool move by in a year, as a random walk; by default the model's terms.
    Where multi-station analysis has taken interference off, its covariance holds what is left of it, and the drift that
    it was told to allow for: neither is added.
    """
    sizes = {term.name: term.size for term in model.terms}
    done = {finding.id for finding in calibration.findings}
    years = _years(stated_day(calibration.tool), stated_day(readings.metadata))
    elapsed = DRIFT_YEARS if years is None else years
    share, terms = min(1.0, np.sqrt(elapsed / DRIFT_YEARS)), [_largest(sizes, s) for s in _SENSORS]
    if walk is not None:
        share, terms = float(np.sqrt(elapsed)), [getattr(walk, name) for name in _WALKS]
    share = 0.0 if {CORRECTED, DRIFTED} & done else share
    ab, scale_a, mb, scale_m = (share * term for term in terms)
    axial = 0.0 if CORRECTED in done else sizes.get(_INTERFERENCE, 0.0)
    sensors = SensorTerms(
        accelerometer_bias_ms2=ab, accelerometer_scale=scale_a, magnetometer_bias_nt=mb,
        magnetometer_scale=scale_m, axial_interference_nt=axial,
    )  # fmt: skip
    others = [
        name for name in sizes if name.startswith((*_SENSORS, *_DECLINATION_TERMS, _INTERFERENCE))
    ]
    return WellErrors(model.without(others), sensors, years, calibration.relative, walk is not None)


def _largest(sizes: dict[str, float], start: str) -> float:
    return max((size for name, size in sizes.items() if name.startswith(start)), default=0.0)


def _years(calibrated: date | None, surveyed: date | None) -> float | None:
    """Time from one day to a later one; None where one is not stated, or the survey is the earlier one."""
    if calibrated is None or surveyed is None or surveyed < calibrated:
        return None
    return (surveyed - calibrated).days / JULIAN_YEAR


class SeenHole(NamedTuple):
    """Inclination, azimuth from magnetic north, field and dip (n,) at readings."""

    inclination: Array
    magnetic: Array
    field: Array
    dip: Array

    @classmethod
    def at(cls, calibration: Calibration, readings: Readings) -> SeenHole:
        """Those that a calibrated tool sees."""
        value, parts = {name: OBSERVABLES[name].value for name in OBSERVABLES}, []
        for some in blocks(readings):
            g, b = calibration.fields(some)
            azimuth, _ = direction_gradient(g, b)
            parts.append(
                (value["inclination"](g, b), azimuth, value["field"](g, b), value["dip"](g, b))
            )
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def part(self, rows: Bools) -> SeenHole:
        """Those of some readings."""
        return SeenHole(*(each[rows] for each in self))


def hole_of(
    calibration: Calibration,
    readings: Readings,
    seen: SeenHole,
    md: Array,
    north: float | Array = 0.0,
    before: Sequence[float] | TieIn | PathEnd = (),
) -> Hole:
    """The hole as the readings see it; TVD where all depths are known.

    `before`: where its path has come to, or the position of the first station.
    Singular: at vertical the azimuth is the magnetic toolface, as of `path.direction_gradient`.
    """
    inclination, magnetic, field, dip = seen
    angles = inclination, magnetic + north
    last: tuple[float, float, float] | None = None
    if isinstance(before, PathEnd):
        end = before.md, before.errors.inclination, before.errors.azimuth
        before = TieIn(end[0].item(), end[1].item(), end[2].item(), before.sums.position)
    if isinstance(before, TieIn):
        last = before[:3]
    tvd = np.zeros(len(md))
    if np.isfinite(md).all():
        start = before.place if isinstance(before, TieIn) else before or (0.0, 0.0, 0.0)
        stations = zip(last or (), (md, *angles), strict=False)
        whole = [np.concatenate([[first], values]) for first, values in stations] or [md, *angles]
        tvd = well_path(whole[0], whole[1], whole[2], start)[-len(md) :, 2]
    if calibration.relative:
        field = np.broadcast_to(readings.reference("field"), md.shape)
    return Hole.along(md, tvd, *angles, magnetic, field, dip, last=last)
