"""A well: its surveys, whether each may be used, and where they lead."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import date
from functools import cached_property
from operator import or_
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.automatic.drift import JULIAN_YEAR
from mwdcal.calibration.readings import Readings, stated_day
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.calibration.results import UNKNOWN_GRAVITY, unknown_gravity
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files.contract import REFERENCES
from mwdcal.files.formats.columns import shown
from mwdcal.geometry.observables import EXTRAPOLATED, OBSERVABLES, RESULTS, VECTORS
from mwdcal.geometry.units import LENGTH_UNITS, STANDARD_GRAVITY, USUAL_COURSES
from mwdcal.geometry.vectors import AnyArray, Array, ArrayLike, Bools, Ints, diagonal, wrap
from mwdcal.survey.acceptance import (
    STRENGTH_NAMES,
    Blindness,
    Judgement,
    SensorTerms,
    SurveyLimits,
    blindness,
    judged,
)
from mwdcal.survey.error_model import USUAL_COURSE, ErrorModel, Hole
from mwdcal.survey.path import (
    CauseOrder,
    DirectionErrors,
    PathEnd,
    SeenDirection,
    TieIn,
    continued_path,
    well_path,
)
from mwdcal.survey.stations import (
    STRENGTHS,
    SURVEY_OBSERVABLES,
    TOOLFACE_SWITCH,
    North,
    Surveys,
    survey_angles,
)
from mwdcal.use.correction import RowCounts, tallied
from mwdcal.use.correction import findings as about_rows
from mwdcal.use.strengths import check as check_strengths
from mwdcal.use.uncertainty import (
    AXIAL_INTERFERENCE,
    CORRECTED,
    DRIFT,
    DRIFTED,
    OF_MODELS,
    ErrorTerms,
    error_terms,
)

# --------------------------------------------------------------------------
# Errors in the hole that no stand shows: what an error model adds to the calibration of one tool.
#
# The model's terms for sensors state what a tool of its kind may be off. Here the covariance of this tool's calibration
# is used instead, with the drift since: it grows with the square root of time, and after a year it is as large as those
# terms. Interference along the tool is an error of the axial magnetometer, and so also turns the dip and changes |b|.
# All other terms act through the formulas of the model. Its terms for declination are left out: the declination has its
# own uncertainty (`mwdcal.survey.stations`).

AddsErrors = Callable[[DirectionErrors, slice], DirectionErrors]
"""Adds errors to those of directions at some rows."""
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

    def sizes(self, g: Array, b: Array, unit: ArrayLike = 1.0) -> tuple[Array, Array, Array]:
        """1σ (n, 6) of the biases of all axes, of their scales in the unit of the vectors, and (n,) of interference.

        `unit` of the field, nT: that of a magnetometer calibrated to a field of 1 is the field itself.
        """
        sensors, one = self.sensors, np.ones((len(g), 3))
        unit = np.broadcast_to(np.asarray(unit, float), len(g))
        gravity = sensors.accelerometer_bias_ms2 / STANDARD_GRAVITY * one
        field = sensors.magnetometer_bias_nt * one / unit[:, None]
        scales = [sensors.accelerometer_scale * g, np.nan_to_num(sensors.magnetometer_scale * b)]
        biases = np.concatenate([gravity, np.nan_to_num(field)], -1)
        axial = np.nan_to_num(sensors.axial_interference_nt / unit)
        return biases, np.nan_to_num(np.concatenate(scales, -1)), axial

    def moved(self, gradient: Array, g: Array, b: Array, hole: Hole) -> Array:
        """Changes (n, 13, k) of what has a gradient (n, k, 6) by 1σ of each independent cause that lasts over a run."""
        biases, scales, axial = self.sizes(g, b, self.unit(hole))
        each = [(gradient * size[:, None, :]).mT for size in (biases, scales)]
        return np.concatenate([*each, (gradient[..., 5] * axial[:, None])[:, None, :]], 1)

    def variances(self, gradient: Array, g: Array, b: Array, hole: Hole) -> Array:
        """Variance (n, 7) that all terms add to the observables of a survey, in the order of `SURVEY_OBSERVABLES`.

        `gradient` (n, 7, 6) of these by both vectors.
        Errors of the hole's direction against the tool, such as sag, leave the toolface as it is.
        """
        biases, scales, axial = self.sizes(g, b, self.unit(hole))
        size = biases**2 + scales**2
        size[:, 5] += axial**2
        result = (gradient**2 @ size[..., None])[..., 0]
        systematic, random = self.model.errors_of_stations(hole)
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
        """The unit of the field, nT: that of a magnetometer calibrated to a field of 1 is the field itself.

        Raises:
            InputError: the field is not known, and so not what interference and drift of so many nT are.
        """
        field = hole.quantities["bfield"]
        if self.relative and np.isnan(field).any():
            raise InputError(
                "the calibration has a field of 1, and the strength of the field is blank at some surveys: what "
                "interference and drift in nT do to the azimuth cannot be stated. Give `ref_field_nt`, or "
                "`error_model` none."
            )
        return field if self.relative else 1.0

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

    def of_path(self, seen: SeenDirection, hole: Hole) -> AddsErrors:
        """Adds the errors of the model to those of directions at some rows of a well."""
        return lambda errors, rows: self.along(errors, seen.part(rows), hole.part(rows))

    def along(self, errors: DirectionErrors, seen: SeenDirection, hole: Hole) -> DirectionErrors:
        """Errors of direction and depth along a well: those given, and those of the model."""
        systematic, random, course = self.model.errors(hole)
        turns = errors.systematic, self.moved(seen.gradient, seen.g, seen.b, hole)
        alone = sum(each.shape[-2] for each in turns)  # of these none shifts a depth
        lasting = np.zeros((len(random), alone + systematic.shape[-2], 3))
        np.concatenate(turns, -2, out=lasting[:, :alone, :2])
        lasting[:, alone:] = systematic
        random[:, :2, :2] += errors.random
        return DirectionErrors(errors.inclination, errors.azimuth, lasting, random, course)


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
    """Inclination, field and dip (n,) at readings, and the direction of the hole."""

    inclination: Array
    field: Array
    dip: Array
    direction: SeenDirection

    @classmethod
    def at(cls, calibration: Calibration, readings: Readings) -> SeenHole:
        """Those that a calibrated tool sees."""
        direction = SeenDirection.of_many(calibration, readings)
        angles = [OBSERVABLES[n].value(*direction[:2]) for n in ("inclination", "field", "dip")]
        return cls._make([*angles, direction])

    def part(self, rows: Bools) -> SeenHole:
        """Those of some readings."""
        return SeenHole._make([*(each[rows] for each in self[:3]), self.direction.part(rows)])


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
    inclination, field, dip, direction = seen
    magnetic = direction.azimuth
    angles = inclination, magnetic + north
    last: tuple[float, float, float] | None = None
    above = np.nan
    if isinstance(before, PathEnd):
        above = before.above.item()
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
    return Hole.along(md, tvd, *angles, magnetic, field, dip, last=last, above=above)


BLIND_FROM = 1.0
"""Stated standard uncertainties of azimuth by which interference that would pass turns it where acceptance is blind.

Below it the turn is less than what is stated. With other errors of one standard uncertainty an azimuth turned by t is
off by more than three with probability Φ(t - 3): of interference that turns by anything up to five, as five times the
model's does, 0.4 % of the azimuths that are off have a turn below one, and 1.4 % one below 1.5.
"""
Start = tuple[float, float, float] | TieIn | PathEnd
"""Where a path starts: position of the first station, a tie-in, or the end of the part before."""
AXES_OF_EARTH = ("north", "east", "tvd")
WELL_FINDINGS = {
    "rejected": "{rejected} of {judged} surveys lie outside the limits '{limits}' (first: station {first}: {why}).",
    "rejected-alike": "most surveys depart alike: {alike} (median). Likely a reference is wrong: that of the well's "
    "place, or of the calibration's stand. At one attitude interference of the drill string looks the same.",
    "blind-to-interference": "acceptance is blind to interference of the drill string at {blind} of {accepted} "
    "accepted surveys. At station {blindest} {worst}. Use `msa`: surveys at another attitude show what is along the "
    "tool, rotation shots (four toolfaces at one depth) what is across it. Or measure a check azimuth.",
    "rejected-on-path": "surveys outside the limits are part of the well path. Leave them out of the table, or "
    "survey again.",
    "not-judged": "{unjudged} of {rows} surveys are not judged: no reference for |g|, |b| or dip. Give `reference`, or "
    "columns ref_gravity_g, ref_field_nt, ref_dip_deg.",
    "partly-judged": "no reference for {names} at {partly} of {rows} surveys: `accepted` says nothing about {names}. "
    "Give `reference`, or state {references} above the table.",
    "laboratory-gravity": "gravity at the laboratory is unknown (1 g was assumed), so |g| is judged 1.5 mg more "
    "loosely. To tighten this, give ref_gravity_g in the calibration run.",
    "calibration-old": "the tool was calibrated {years:.1f} years before, and 1σ {drift}",
    "calibration-later": "the surveys are of {day}, before the calibration of {calibrated}: is it the right one?",
    "long-courses": "the courses between surveys are {course:.0f} m long (median), and {usual:g} m are usual: are "
    "the depths in feet? Name their column `md_ft`, or give `length_unit`.",
    "magnetic-north": "no declination{unread}: azimuths and the well path count from magnetic north.",
    "path-from-first": "the well path starts at the first station, at north 0, east 0 and TVD 0. `tie_in` gives its "
    "position.",
    "path-from-later": "the well path starts at station {start}: those before it have no result or no measured depth. "
    "`tie_in` gives the position of station {start}.",
    "left-out": "left out of the well path, without a result, without a measured depth, or at the depth of the "
    "station before: {count} of {rows} stations.",
    "no-path": "no well path: {lacking_path}",
}
"""The texts of the findings about a well, in their order."""
LACKING_PATH = {
    True: "no station has both a measured depth and a direction with azimuth.",
    False: 'no column has the measured depth. Add it, or name yours by `column` "md_m=NAME" (in feet '
    "md_ft or md_usft); arrays take mwdcal.readings(…, md_m=…).",
}
"""Lack that leaves a well without a path, where stations have depths and where none has."""
OLD_DRIFT = {
    True: "allows for the drift of one year. Verify the tool, or give `registry`, where the drift of tools has no such "
    "end.",
    False: "has nothing of the drift since. Verify the tool, or survey with an error model, and after `msa` a "
    "`sensor_drift`, that has one.",
}
"""The drift since an old calibration that 1σ includes: that of one year, or none."""


@dataclass(frozen=True)
class Position:
    """Where stations lie: `place` (n, 3) north, east, TVD, m, and `covariance` (n, 3, 3); NaN: not on the path.

    `dogleg` (n,): angle between the directions here and at the station before over the course between, rad/m.
    """

    md: Array
    place: Array
    covariance: Array
    dogleg: Array

    @property
    def on_path(self) -> Bools:
        """Stations (n,) with a position."""
        return ~np.isnan(self.place[:, 0])

    def without_accuracy(self, lost: Bools) -> Position:
        """The same, with no covariance at stations where it is `lost` (n,)."""
        return replace(self, covariance=np.where(lost[:, None, None], np.nan, self.covariance))

    @property
    def sd(self) -> Array:
        """Standard uncertainties (n, 3)."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0)))


@dataclass(frozen=True)
class Before:
    """State that stations pass on to those that follow them.

    `magnetic`: the toolface counts from magnetic north. `path`: where the path has come to, at first where it starts.
    `inaccurate`: no accuracy is stated of positions any more. `causes`: names of the lasting causes along the path of
    the runs before, empty in the first one; `ran`: the same with this run.
    """

    magnetic: bool = False
    path: Start = (0.0, 0.0, 0.0)
    inaccurate: bool = False
    causes: tuple[str, ...] = ()
    ran: tuple[str, ...] = ()

    def next_run(self) -> Before:
        """The same for the first station of the next run, whose tool starts anew."""
        return replace(self, magnetic=False, causes=self.ran)


class LastStation(NamedTuple):
    """The last station with a position: its place (3,), m, with covariance (3, 3)."""

    label: str
    md: float
    place: Array
    covariance: Array


@dataclass(frozen=True)
class WellCounts:
    """Stations of a well, counted by what its findings and its summary say of them.

    `unjudged` have a result and no reference; `partly` lack a reference of those that `lacking` (3,) names. `first`:
    label of the first rejected station, and why; `blindest`: how far interference turns its azimuth, its label, and
    the interference in words; `start`: row, label and depth of the first station on the path. `weighed`: |g| is judged
    somewhere; `located`: there are measured depths.
    """

    rows: int
    judged: int
    accepted: int
    rejected: int
    blind: int
    blank: int
    unjudged: int
    partly: int
    on_path: int
    rejected_on_path: int
    lacking: tuple[bool, ...]
    weighed: bool
    located: bool
    first: tuple[str, str] | None
    blindest: tuple[float, str, str] | None
    start: tuple[int, str, float] | None
    end: LastStation | None

    def followed_by(self, other: WellCounts) -> WellCounts:
        """Those of a well of which these are the first part, and the others the next."""
        start = other.start and (other.start[0] + self.rows, *other.start[1:])
        most = [each for each in (self.blindest, other.blindest) if each]
        sums = {
            f.name: getattr(self, f.name) + getattr(other, f.name)
            for f in fields(self)
            if f.type == "int"
        }
        return replace(
            self, **sums, lacking=tuple(map(or_, self.lacking, other.lacking)),
            weighed=self.weighed or other.weighed, located=self.located or other.located,
            first=self.first or other.first, start=self.start or start, end=other.end or self.end,
            blindest=max(most, key=lambda each: each[0], default=None),
        )  # fmt: skip


@dataclass(frozen=True)
class Well:
    """Surveys of a well in the order of their table.

    `vectors` (n, 3) each as corrected; `extrapolated` (n,): stations without a statement of accuracy, None where
    none may be. `position`: None without measured depths. `sources`: where references come from, by name. `after`:
    what these stations leave to others that follow.
    `started`: where their path starts. `length_unit`: of the columns.
    `errors`: of the error model in the standard uncertainties; None: these hold calibration, noise and declination.
    """

    calibration: Calibration
    readings: Readings
    surveys: Surveys
    judgement: Judgement
    limits: SurveyLimits
    north: North
    vectors: tuple[Array, Array]
    position: Position | None
    findings: list[Finding]
    extrapolated: Bools | None = None
    blindness: Blindness | None = None
    sources: Mapping[str, str] = field(default_factory=dict)
    after: Before = Before()
    errors: WellErrors | None = None
    started: Start = (0.0, 0.0, 0.0)
    length_unit: str = "m"

    @cached_property
    def sd_azimuth(self) -> Array:
        """Standard uncertainty (n,) of the azimuth from the north of the path, rad."""
        turned = 0.0 if self.north.name == "magnetic" else self.north.declination_uncertainty
        return np.asarray(np.hypot(self.surveys.of("azimuth")[1], turned))

    @cached_property
    def blind(self) -> Bools:
        """Accepted surveys (n,) whose azimuth interference could turn by `BLIND_FROM` 1σ and still pass."""
        if self.blindness is None:
            return np.zeros(len(self.judgement.accepted), bool)
        over = self.blindness.turn.max(-1) >= BLIND_FROM * self.sd_azimuth
        return np.asarray(over & self.judgement.accepted)

    @property
    def corrected(self) -> list[Finding]:
        """The findings that interference of the drill string was taken off, and drift allowed for."""
        about = (CORRECTED, DRIFTED)
        return [finding for finding in self.calibration.findings if finding.id in about]

    @property
    def terms(self) -> ErrorTerms:
        """Sources in the standard uncertainties, and those left out."""
        modelled = () if self.errors is None else self.errors.included
        return error_terms(self.calibration, self.north.declination is not None, modelled=modelled)

    @property
    def blank(self) -> Bools:
        """Stations (n,) without a result."""
        return np.isnan(self.surveys.value[:, 0])

    @property
    def unstated(self) -> Bools:
        """Stations (n,) of whose |g|, and so of nothing, an uncertainty is stated."""
        return np.isnan(self.surveys.of("gravity")[1])

    @property
    def lacking(self) -> Bools:
        """What (n, 3) of |g|, |b| and dip is not judged although the survey has it: its reference lacks."""
        stated = ~np.isnan(diagonal(self.surveys.strengths))
        lacking = np.isnan(self.judgement.departure) & stated
        return np.asarray(lacking & np.array([True, not self.calibration.relative, True]))

    def remarks(self, rows: slice = slice(None)) -> list[str]:
        """The fault of each station of some rows."""
        remarks = zip(
            self.judgement.findings(rows), self.blank[rows].tolist(), self.unstated[rows].tolist(),
            strict=True,
        )  # fmt: skip
        remarked = [
            "no result" if blank else "not judged: no statement of accuracy" if unstated else remark
            for remark, blank, unstated in remarks
        ]
        places, start = np.flatnonzero(self.blind[rows]), rows.start or 0
        for place, words in zip(places.tolist(), self.what_passes(places + start), strict=True):
            remarked[place] = f"blind: {words}"
        return remarked

    def what_passes(self, places: Ints) -> list[str]:
        """Interference that would pass at some surveys (m,), in words."""
        if self.blindness is None:
            return [""] * len(places)
        return self.blindness.words(places, BLIND_FROM * self.sd_azimuth[places])

    @cached_property
    def columns(self) -> dict[str, AnyArray]:
        """Results by column, in the units of files; only azimuths whose north is known."""
        norths: dict[str, float | Array] = {"magnetic": 0.0}
        if self.north.declination is not None:
            norths["true"] = self.north.declination
            if self.north.convergence is not None:
                norths["grid"] = self.north.offset
        inclination, azimuth, toolface = (
            self.surveys.of(n) for n in ("inclination", "azimuth", "toolface")
        )
        columns = _angle("inclination", *inclination)
        for name, offset in norths.items():
            turned = self.north.declination_uncertainty if name != "magnetic" else 0.0
            sd = np.hypot(azimuth[1], turned)
            columns |= _angle(f"azimuth_{name}", wrap(azimuth[0] + offset), sd)
        columns |= _angle("toolface", *toolface)
        kinds = np.where(self.surveys.magnetic, "magnetic", "gravity")
        columns["toolface_kind"] = np.where(np.isnan(toolface[0]), "", kinds)
        for name in ("gravity_g", "field_nt"):
            columns |= dict(
                zip((name, f"sd_{name}"), self.surveys.of(name.rpartition("_")[0]), strict=True)
            )
        columns |= _angle("dip", *self.surveys.of("dip"))
        columns["accepted"] = np.where(
            self.judgement.judged, np.where(self.judgement.accepted, "true", "false"), ""
        )
        columns["finding"] = np.array(self.remarks(), dtype=object)
        if self.extrapolated is not None:
            columns[EXTRAPOLATED] = np.where(self.extrapolated, "true", "false")
        if self.position is not None:
            columns |= self._located(self.position)
        return columns

    def _located(self, position: Position) -> dict[str, AnyArray]:
        """The columns of positions, in the unit of length."""
        columns: dict[str, AnyArray] = {}
        unit = self.length_unit
        metres, course = LENGTH_UNITS[unit], USUAL_COURSES[unit]
        place, sd = position.place / metres, position.sd / metres
        for k, name in enumerate(AXES_OF_EARTH):
            columns |= {f"{name}_{unit}": place[:, k], f"sd_{name}_{unit}": sd[:, k]}
        severity = np.degrees(position.dogleg * course * metres)
        columns[f"dogleg_severity_deg_per_{course:g}{unit}"] = severity
        section = np.array([np.cos(self.north.section), np.sin(self.north.section)])
        columns[f"vertical_section_{unit}"] = place[:, :2] @ section
        return columns

    @cached_property
    def counts(self) -> WellCounts:
        """The stations, counted by what findings and summary say of them."""
        judged, accepted, labels = (
            self.judgement.judged,
            self.judgement.accepted,
            self.readings.labels,
        )
        rejected, partly = judged & ~accepted, judged & self.lacking.any(-1)
        unjudged = ~judged & ~self.blank & ~self.unstated
        path = np.zeros(len(judged), bool) if self.position is None else self.position.on_path
        masks = {
            "judged": judged, "accepted": accepted, "rejected": rejected, "blind": self.blind, "blank": self.blank,
            "unjudged": unjudged, "partly": partly, "on_path": path, "rejected_on_path": rejected & path,
        }  # fmt: skip
        numbers: dict[str, Any] = {n: int(np.count_nonzero(mask)) for n, mask in masks.items()}
        first, lacking = int(np.argmax(rejected)), np.asarray(self.lacking[partly].any(0))
        why = self.remarks(slice(first, first + 1))[0] if rejected.any() else ""
        return WellCounts(
            rows=len(judged), **numbers, lacking=tuple(lacking.tolist()),
            weighed=not np.isnan(self.judgement.departure[:, 0]).all(),
            located=self.position is not None, first=(labels[first], why) if rejected.any() else None,
            blindest=self._blindest(labels), start=self._start(labels, path), end=self._end(labels, path),
        )  # fmt: skip

    def _blindest(self, labels: Sequence[str]) -> tuple[float, str, str] | None:
        """The accepted survey whose azimuth interference turns most, and what does."""
        if self.blindness is None or not self.blind.any():
            return None
        turn = np.where(self.blind, self.blindness.turn.max(-1), -1.0)
        place = int(np.argmax(turn))
        return float(turn[place]), labels[place], self.what_passes(np.array([place]))[0]

    def _start(self, labels: Sequence[str], path: Bools) -> tuple[int, str, float] | None:
        """The first station on the path."""
        if self.position is None or not path.any():
            return None
        row = int(np.argmax(path))
        return row, labels[row], float(self.position.md[row])

    def _end(self, labels: Sequence[str], path: Bools) -> LastStation | None:
        """The last station on the path."""
        if self.position is None or not path.any():
            return None
        row, at = int(np.flatnonzero(path)[-1]), self.position
        place, covariance = at.place[row].copy(), at.covariance[row].copy()  # of one station alone
        return LastStation(labels[row], float(at.md[row]), place, covariance)


def well(
    calibration: Calibration,
    readings: Readings,
    limits: SurveyLimits,
    north: North | None = None,
    md: Array | None = None,
    tie_in: tuple[float, float, float] | TieIn | None = None,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
    advance: Callable[[int, int], None] = lambda done, total: None,
    model: ErrorModel | None = None,
    follows: Before | None = None,
    walk: SensorTerms | None = None,
) -> Well:
    """The surveys of a well from readings in their order, references with these; `md` (n,) measured depths, m.

    Units: `tie_in` north, east and TVD of the first station, m, or where the path is tied in; `switch` as of
    `surveyed`. `outside` the calibrated temperatures as of `correction.correct`: blank results, refuse, or extrapolate
    without stated uncertainty. `advance` as of `surveyed`. `model`: error model whose terms are in the standard
    uncertainties too. `follows`: what the run before leaves, instead of `tie_in`. `walk` as of `well_errors`.

    Raises:
        InputError: readings that do not belong to the calibration, or depths that do not increase.
    """
    start = (0.0, 0.0, 0.0) if tie_in is None else tie_in
    north = north or North()
    result, tally = part_of_well(
        calibration,
        readings,
        limits,
        north,
        md,
        follows or Before(path=start),
        switch,
        outside,
        advance,
        model,
        walk=walk,
    )
    return with_findings(result, tally, result.counts, outside, tie_in is None and follows is None)


def part_of_well(
    calibration: Calibration,
    readings: Readings,
    limits: SurveyLimits,
    north: North,
    md: Array | None,
    before: Before,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
    advance: Callable[[int, int], None] = lambda done, total: None,
    model: ErrorModel | None = None,
    whole: bool = True,
    walk: SensorTerms | None = None,
) -> tuple[Well, RowCounts]:
    """The same of stations that follow others, without findings; and what the findings say of the corrected rows.

    `whole`: the stations are all of the table.
    """
    columns, tally = tallied(calibration, readings, outside, whole=whole)
    beyond, blank = calibration.outside(readings), np.isnan(columns[RESULTS[0]])
    errors, added = None, None
    seen = SeenHole.at(calibration, readings)
    if model is not None and calibration.has_field:
        errors = well_errors(model, calibration, readings, walk)
        depth = None if md is None else np.where(blank, np.nan, md)
        added = errors.of_surveys(calibration, readings, depth, before.path, seen)
    angles = survey_angles(
        calibration, readings, switch, advance, added, before.magnetic,
        seen.direction[:2], seen.direction.slopes,
    )  # fmt: skip
    surveys = _without(angles, blank, beyond)
    g, b = (np.stack([columns[name] for name in VECTORS[i : i + 3]], -1) for i in (0, 3))
    judgement, blind = _judged(calibration, readings, surveys, (g, b), limits)
    after = replace(before, magnetic=angles.ends_magnetic)
    position = None
    if md is not None:
        order = CauseOrder.of(before.causes, cause_names(calibration, errors))
        position, end = _positions(
            calibration, readings, seen, md, north, blank, before.path, errors,
            order if before.causes else None,
        )  # fmt: skip
        lost = np.logical_or.accumulate(beyond & position.on_path) | before.inaccurate
        position = position.without_accuracy(lost)
        after = replace(after, path=end, inaccurate=bool(lost[-1]), ran=order.names)
    result = Well(
        calibration, readings, surveys, judgement, limits, north, (g, b), position, [],
        extrapolated=columns.get(EXTRAPOLATED), blindness=blind, after=after, errors=errors,
        started=before.path,
    )  # fmt: skip
    return result, tally


def with_findings(
    result: Well, tally: RowCounts, counts: WellCounts, outside: str, from_first: bool
) -> Well:
    """The well with its findings, about all stations that the counts are of.

    Raises:
        InputError: most readings have a strength that no place has, or lie `outside` where that is refused.
    """
    calibration, readings = result.calibration, result.readings
    findings = about_rows(calibration, readings, tally, outside)
    check_strengths(calibration, tally.strengths, readings.name)
    return replace(result, findings=findings + _findings(result, counts, from_first))


def _without(surveys: Surveys, blank: Bools, beyond: Bools) -> Surveys:
    """Surveys without values where they are `blank`, and without uncertainties `beyond` the temperatures."""
    return Surveys(
        np.where(blank[:, None], np.nan, surveys.value),
        np.where((blank | beyond)[:, None], np.nan, surveys.sd),
        np.where((blank | beyond)[:, None, None], np.nan, surveys.strengths),
        surveys.magnetic & ~blank,
        surveys.ends_magnetic,
    )


def _judged(
    calibration: Calibration, readings: Readings, surveys: Surveys, vectors: tuple[Array, Array],
    limits: SurveyLimits,
) -> tuple[Judgement, Blindness | None]:  # fmt: skip
    """Acceptance, and what it cannot see; nothing where interference was taken off, or there is no field.

    Where it was taken off, the calibration was fitted to these surveys and their references. With S the covariance of
    noise and references, P that of the parameters and H the departures by these, the departures have S - H P Hᵀ, which
    is at most S: S is taken, and neither calibration nor terms for sensors are added.
    """
    seen, known = _to_judge(calibration, readings, vectors)
    taken = any(finding.id == CORRECTED for finding in calibration.findings)
    if taken:
        limits = replace_struct(limits, sensor=SensorTerms())
        surveys = replace(surveys, strengths=_of_noise(calibration, readings, surveys.strengths))
    judgement = judged(surveys, seen, known, limits)
    if taken or not calibration.has_field or judgement.tests is None:
        return judgement, None
    return judgement, blindness(judgement.tests, seen)


def _of_noise(calibration: Calibration, readings: Readings, strengths: Array) -> Array:
    """The part (n, 3, 3) of the covariance of |g|, |b| and dip that is noise; NaN as the whole."""
    slopes = calibration.gradients(SURVEY_OBSERVABLES[STRENGTHS], readings)
    noise = slopes @ calibration.noise_covariance(readings) @ slopes.mT
    return np.where(np.isnan(strengths), np.nan, noise)


def _to_judge(
    calibration: Calibration, readings: Readings, vectors: tuple[Array, Array]
) -> tuple[tuple[Array, Array], Readings]:
    """Vectors in g and nT, and the readings with the references they are judged by.

    |g| may depart from its reference because the laboratory's gravity is not known. A magnetometer calibrated to a
    field of one says nothing of |b|, and of dip where no reference says how large the sensors' nT are in it.
    """
    (g, b), known, sd = vectors, dict(readings.known), dict(readings.sd)
    if unknown_gravity(calibration):
        sd["gravity"] = np.hypot(readings.uncertainty("gravity"), UNKNOWN_GRAVITY)
    if calibration.relative:
        field = readings.reference("field")
        b = b * field[:, None]
        known |= {"field": np.full(len(b), np.nan), "dip": readings.reference("dip") + 0 * field}
    return (g, b), replace(readings, known=known, sd=sd)


def _positions(
    calibration: Calibration, readings: Readings, seen: SeenHole, md: Array, north: North, blank: Bools,
    before: Start, errors: WellErrors | None, order: CauseOrder | None = None,
) -> tuple[Position, Start]:  # fmt: skip
    """Positions of the stations with results, and where the path has come to."""
    whole = _on_path(md, blank, before)
    if not calibration.has_field or readings.magnetometer is None or not whole.any():
        whole = np.zeros(len(md), bool)
    place, covariance = np.full((len(md), 3), np.nan), np.full((len(md), 3, 3), np.nan)
    dogleg = np.full(len(md), np.nan)
    if whole.any():
        some = readings if whole.all() else readings.select(whole)
        offset, shared, alone = (value[whole] for value in north.of_path(len(md)))
        norths, at = (offset, shared, alone), md[whole]
        seen = seen if whole.all() else seen.part(whole)
        hole = hole_of(calibration, some, seen, at, offset, before)
        more = None if errors is None else errors.of_path(seen.direction, hole)
        if order is not None and isinstance(before, PathEnd):
            before, more = before.widened(len(order.names)), _in_order(order, more)
        dogleg[whole] = hole.dogleg
        if not isinstance(before, TieIn | PathEnd):  # no course leads to the first station
            dogleg[np.argmax(whole)] = np.nan
        place[whole], covariance[whole], before = continued_path(
            calibration, some, at, norths, before, more, seen.direction
        )
    return Position(md, place, covariance, dogleg), before


def _in_order(order: CauseOrder, more: AddsErrors | None) -> AddsErrors:
    """Adds errors, if there are more, and puts all lasting ones where those of the runs before have their places."""

    def added(errors: DirectionErrors, rows: slice) -> DirectionErrors:
        return order.placed(errors if more is None else more(errors, rows))

    return added


def _on_path(md: Array, blank: Bools, before: Start) -> Bools:
    """Stations (n,) that the path goes through: of several at one depth the first that has a result."""
    whole = ~blank & ~np.isnan(md)
    depths = md[whole]
    reached = np.max(before.md) if isinstance(before, TieIn | PathEnd) else -np.inf
    whole[whole] = depths > np.maximum.accumulate(np.concatenate([[reached], depths]))[:-1]
    return whole


def _findings(result: Well, counts: WellCounts, from_first: bool) -> list[Finding]:
    """Findings about a well."""
    start, label, depth = counts.start or (0, "", 0.0)
    first, why = counts.first or ("", "")
    _, blindest, worst = counts.blindest or (0.0, "", "")
    there = counts.on_path > 0
    calibrated, day = (
        stated_day(each) for each in (result.calibration.tool, result.readings.metadata)
    )
    years, course = _years(calibrated, day) or 0.0, _usual_course(result.position)
    lacking = [n for n, lacks in zip(STRENGTH_NAMES, counts.lacking, strict=True) if lacks]
    walks = result.errors is not None and result.errors.by_walk
    alike = ", ".join(result.judgement.alike())
    line = result.readings.not_taken.get("declination_deg", "")
    applies = {
        "rejected": counts.rejected,
        "rejected-alike": 2 * counts.rejected > counts.judged and alike,
        "blind-to-interference": counts.blind,
        "rejected-on-path": counts.rejected_on_path,
        "not-judged": counts.unjudged,
        "partly-judged": counts.partly,
        "laboratory-gravity": unknown_gravity(result.calibration) and counts.weighed,
        "calibration-old": years > DRIFT_YEARS and not walks,
        "calibration-later": calibrated is not None and day is not None and day < calibrated,
        "long-courses": course > 2 * USUAL_COURSE,
        "magnetic-north": result.north.declination is None and result.calibration.has_field,
        "path-from-first": there and from_first and depth > 0,
        "path-from-later": start > 0 and not isinstance(result.started, TieIn),
        "left-out": there and counts.on_path < counts.rows,
        "no-path": not there,
    }
    words = {
        "rejected": counts.rejected, "judged": counts.judged, "limits": result.limits.name, "rows": counts.rows,
        "first": first, "why": why, "start": label, "blind": counts.blind, "accepted": counts.accepted,
        "names": " and ".join(lacking), "references": " and ".join(REFERENCES[n].column for n in lacking),
        "blindest": blindest, "alike": alike, "worst": worst, "partly": counts.partly, "unjudged": counts.unjudged,
        "count": counts.rows - counts.on_path, "years": years, "day": day, "calibrated": calibrated, "course": course,
        "usual": USUAL_COURSE, "lacking_path": LACKING_PATH[counts.located],
        "drift": OLD_DRIFT[DRIFT in result.terms.included],
        "unread": f" ({shown(line)} is not understood: write degrees, east positive)" if line else "",
    }  # fmt: skip
    return [*result.corrected, *result.north.findings] + [
        Finding(id=name, text=text.format(**words))
        for name, text in WELL_FINDINGS.items()
        if applies[name]
    ]


def _usual_course(position: Position | None) -> float:
    """The median distance of neighbouring stations on the path along the hole, m; 0 where there are no two."""
    depth = np.empty(0) if position is None else position.md[position.on_path]
    return float(np.median(np.diff(depth))) if len(depth) > 1 else 0.0


def _angle(name: str, value: Array, sd: Array) -> dict[str, AnyArray]:
    return {f"{name}_deg": np.degrees(value), f"sd_{name}_deg": np.degrees(sd)}
