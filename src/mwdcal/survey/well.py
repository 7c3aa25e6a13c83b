"""A well: its surveys, whether each may be used, and where they lead."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mwdcal.calibration.prediction import UNKNOWN_GRAVITY, unknown_gravity
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.geometry.observables import EXTRAPOLATED, RESULTS, VECTORS
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints, diagonal, wrap
from mwdcal.survey.acceptance import (
    STRENGTH_NAMES,
    Blindness,
    Judgement,
    SurveyLimits,
    blindness,
    judged,
)
from mwdcal.survey.interference import CORRECTED, DRIFTED, ErrorTerms, error_terms
from mwdcal.survey.norths import North
from mwdcal.survey.path import calibrated_path
from mwdcal.survey.stations import TOOLFACE_SWITCH, Surveys, survey_angles
from mwdcal.use.correction import correct_and_count

BLIND_FROM = 2.0
"""Stated standard uncertainties of azimuth by which interference that would pass turns it where acceptance is blind."""
AXES_OF_EARTH = ("north", "east", "tvd")
WELL_FINDINGS = {
    "rejected": "{rejected} of {judged} surveys lie outside the limits '{limits}' (first: station {first}: {why}).",
    "blind-to-interference": "acceptance is blind to interference of the drill string at {blind} of {accepted} "
    "accepted surveys. At station {blindest} {worst}. Use `msa`, or measure a check azimuth.",
    "rejected-on-path": "surveys outside the limits are part of the well path. Leave them out of the table, or "
    "survey again.",
    "not-judged": "{unjudged} of {rows} surveys are not judged: no reference for |g|, |b| or dip. Give `reference`, or "
    "columns ref_gravity_g, ref_field_nt, ref_dip_deg.",
    "partly-judged": "{names} of {partly} of {rows} surveys are not judged: no reference. `accepted` says nothing "
    "about them.",
    "laboratory-gravity": "gravity at the laboratory is unknown (1 g was assumed), so |g| is judged 1.5 mg more "
    "loosely. To tighten this, give ref_gravity_g in the calibration run.",
    "magnetic-north": "no declination: azimuths and the well path count from magnetic north.",
    "path-from-first": "the well path starts at the first station, at north 0, east 0 and TVD 0. `tie_in` gives its "
    "position.",
    "path-from-later": "the well path starts at station {start}: those before it have no result or no measured depth. "
    "`tie_in` gives the position of station {start}.",
    "left-out": "left out of the well path, without a result or a measured depth: {count} of {rows} stations.",
    "no-path": "no well path: no station has both a measured depth and a direction with azimuth.",
}
"""The texts of the findings about a well, in their order."""


@dataclass(frozen=True)
class Position:
    """Where stations lie: `place` (n, 3) north, east, TVD, m, and `covariance` (n, 3, 3); NaN: not on the path."""

    md: Array
    place: Array
    covariance: Array

    @property
    def on_path(self) -> Bools:
        """Stations (n,) with a position."""
        return ~np.isnan(self.place[:, 0])

    def without_accuracy(self, beyond: Bools) -> Position:
        """The same, with no covariance from the first station on the path on that is `beyond` (n,)."""
        lost = np.logical_or.accumulate(beyond & self.on_path)
        return replace(self, covariance=np.where(lost[:, None, None], np.nan, self.covariance))

    @property
    def sd(self) -> Array:
        """Standard uncertainties (n, 3)."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0)))


@dataclass(frozen=True)
class Well:
    """Surveys of a well in the order of their table.

    `vectors` (n, 3) each as corrected; `extrapolated` (n,): stations without a statement of accuracy, None where
    none may be. `position`: None without measured depths. `sources`: where references come from, by name.
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
        """The scope of the standard uncertainties: what they hold and leave out."""
        return error_terms(self.calibration.findings, self.north.declination is not None)

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

    @cached_property
    def remarks(self) -> list[str]:
        """The fault of each station."""
        remarks = zip(
            self.judgement.findings(), self.blank.tolist(), self.unstated.tolist(), strict=True
        )
        remarked = [
            "no result" if blank else "not judged: no statement of accuracy" if unstated else remark
            for remark, blank, unstated in remarks
        ]
        places = np.flatnonzero(self.blind)
        for place, words in zip(places.tolist(), self.what_passes(places), strict=True):
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
        norths = {"magnetic": 0.0}
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
        columns["finding"] = np.array(self.remarks, dtype=object)
        if self.extrapolated is not None:
            columns[EXTRAPOLATED] = np.where(self.extrapolated, "true", "false")
        if self.position is not None:
            for k, name in enumerate(AXES_OF_EARTH):
                columns |= {
                    f"{name}_m": self.position.place[:, k],
                    f"sd_{name}_m": self.position.sd[:, k],
                }
        return columns


def well(
    calibration: Calibration,
    readings: Readings,
    limits: SurveyLimits,
    north: North | None = None,
    md: Array | None = None,
    tie_in: tuple[float, float, float] | None = None,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Well:
    """The surveys of a well from readings in their order, references with these; `md` (n,) measured depths, m.

    Units: `tie_in` north, east and TVD of the first station, m; `switch` as of `surveyed`. `outside` the calibrated
    temperatures as of `correction.correct`: blank results, refuse, or extrapolate without stated uncertainty.
    `advance` as of `surveyed`.

    Raises:
        InputError: readings that do not belong to the calibration, or depths that do not increase.
    """
    north = north or North()
    columns, _, findings = correct_and_count(calibration, readings, outside)
    beyond, blank = calibration.outside(readings), np.isnan(columns[RESULTS[0]])
    surveys = _without(survey_angles(calibration, readings, switch, advance), blank, beyond)
    g, b = (np.stack([columns[name] for name in VECTORS[i : i + 3]], -1) for i in (0, 3))
    judgement, blind = _judged(calibration, readings, surveys, (g, b), limits)
    start = (0.0, 0.0, 0.0) if tie_in is None else tie_in
    position = None if md is None else _positions(calibration, readings, md, north, blank, start)
    if position is not None:
        position = position.without_accuracy(beyond)
    result = Well(
        calibration, readings, surveys, judgement, limits, north, (g, b), position, findings,
        extrapolated=columns.get(EXTRAPOLATED), blindness=blind,
    )  # fmt: skip
    return replace(result, findings=findings + _findings(result, tie_in is None))


def _without(surveys: Surveys, blank: Bools, beyond: Bools) -> Surveys:
    """Surveys without values where they are `blank`, and without uncertainties `beyond` the temperatures."""
    return Surveys(
        np.where(blank[:, None], np.nan, surveys.value),
        np.where((blank | beyond)[:, None], np.nan, surveys.sd),
        np.where((blank | beyond)[:, None, None], np.nan, surveys.strengths),
        surveys.magnetic & ~blank,
    )


def _judged(
    calibration: Calibration, readings: Readings, surveys: Surveys, vectors: tuple[Array, Array],
    limits: SurveyLimits,
) -> tuple[Judgement, Blindness | None]:  # fmt: skip
    """Acceptance, and what it cannot see; nothing where interference was taken off, or there is no field."""
    seen, known = _to_judge(calibration, readings, vectors)
    judgement = judged(surveys, seen, known, limits)
    taken = any(finding.id == CORRECTED for finding in calibration.findings)
    if taken or not calibration.has_field or judgement.tests is None:
        return judgement, None
    return judgement, blindness(judgement.tests, seen)


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
    calibration: Calibration, readings: Readings, md: Array, north: North, blank: Bools,
    start: tuple[float, float, float],
) -> Position:  # fmt: skip
    """Positions of the stations with results."""
    whole = ~blank & ~np.isnan(md)
    if not calibration.has_field or readings.magnetometer is None or not whole.any():
        whole = np.zeros(len(md), bool)
    place, covariance = np.full((len(md), 3), np.nan), np.full((len(md), 3, 3), np.nan)
    if whole.any():
        some = readings if whole.all() else readings.select(whole)
        place[whole], covariance[whole] = calibrated_path(
            calibration,
            some,
            md[whole],
            north.offset,
            north.declination_sd,
            start,
            north.declination_noise,
        )
    return Position(md, place, covariance)


def _findings(result: Well, from_first: bool) -> list[Finding]:
    """Findings about a well."""
    judgement, position = result.judgement, result.position
    rejected = judgement.judged & ~judgement.accepted
    unjudged = ~judgement.judged & ~result.blank & ~result.unstated
    partly = judgement.judged & result.lacking.any(-1)
    on_path = np.zeros(len(rejected), bool) if position is None else position.on_path
    there, start = bool(on_path.any()), int(np.argmax(on_path))
    applies = {
        "rejected": rejected.any(),
        "blind-to-interference": result.blind.any(),
        "rejected-on-path": (rejected & on_path).any(),
        "not-judged": unjudged.any(),
        "partly-judged": partly.any(),
        "laboratory-gravity": unknown_gravity(result.calibration)
        and not np.isnan(judgement.departure[:, 0]).all(),
        "magnetic-north": result.north.declination is None and result.calibration.has_field,
        "path-from-first": there and from_first and position is not None and position.md[start] > 0,
        "path-from-later": start > 0,
        "left-out": there and not on_path.all(),
        "no-path": position is not None and not there,
    }
    turn = 0.0 if result.blindness is None else result.blindness.turn.max(-1)
    blindest = int(np.argmax(np.where(result.blind, turn, -1.0)))
    first, labels = int(np.argmax(rejected)), result.readings.labels
    absent = np.asarray(result.lacking[partly].any(0)).tolist()
    words = {
        "rejected": int(rejected.sum()), "judged": int(judgement.judged.sum()), "limits": result.limits.name,
        "rows": len(rejected), "first": labels[first], "why": result.remarks[first], "start": labels[start],
        "names": " and ".join(n for n, lacks in zip(STRENGTH_NAMES, absent, strict=True) if lacks),
        "blind": int(result.blind.sum()), "accepted": int(judgement.accepted.sum()), "blindest": labels[blindest],
        "worst": result.what_passes(np.array([blindest]))[0] if result.blind.any() else "",
        "partly": int(partly.sum()), "unjudged": int(unjudged.sum()), "count": int((~on_path).sum()),
    }  # fmt: skip
    return [*result.corrected, *result.north.findings] + [
        Finding(id=name, text=text.format(**words))
        for name, text in WELL_FINDINGS.items()
        if applies[name]
    ]


def _angle(name: str, value: Array, sd: Array) -> dict[str, AnyArray]:
    return {f"{name}_deg": np.degrees(value), f"sd_{name}_deg": np.degrees(sd)}
