"""A well: its surveys, whether each may be used, and where they lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.geometry.observables import RESULTS, VECTORS
from mwdcal.geometry.vectors import AnyArray, Array, Bools, wrap
from mwdcal.survey.acceptance import Judgement, SurveyLimits, judged
from mwdcal.survey.position import calibrated_path
from mwdcal.survey.stations import TOOLFACE_SWITCH, Surveys, surveyed
from mwdcal.use.correction import counted

AXES_OF_EARTH = ("north", "east", "tvd")
WELL_FINDINGS = {
    "rejected": "{rejected} of {judged} surveys lie outside the limits '{limits}' (first: station {first}: {why}).",
    "rejected-on-path": "surveys outside the limits are part of the well path. Leave them out of the table, or "
    "survey again.",
    "not-judged": "{count} of {rows} surveys are not judged: no reference for |g|, |b| or dip. Give `reference`, or "
    "columns ref_gravity_g, ref_field_nt, ref_dip_deg.",
    "laboratory-gravity": "the calibration's gravity is 1 g, as where its run states none: |g| is then in units of the "
    "laboratory's gravity, and judged with 1.5 mg more of uncertainty. Calibrate with ref_gravity_g.",
    "magnetic-north": "no declination: azimuths and the well path count from magnetic north.",
    "path-from-first": "the well path starts at the first station, at north 0, east 0 and TVD 0. `tie-in` gives its "
    "position.",
    "left-out": "{count} stations without a result are left out of the well path.",
}
"""What the findings about a well say, in their order."""
UNKNOWN_GRAVITY = 0.0015
"""Standard uncertainty of |g| in units of a laboratory's gravity that was taken as 1 g: that is anything from
9.780 to 9.832 m/s²."""


@dataclass(frozen=True)
class North:
    """The norths that azimuths may count from, radians: true = magnetic + declination, grid = true - convergence.

    None: not known. `declination_sd`: standard uncertainty that the stations share, `declination_noise` that of
    what changes from one to the next.
    """

    declination: float | None = None
    declination_sd: float = 0.0
    convergence: float | None = None
    declination_noise: float = 0.0

    @property
    def name(self) -> str:
        """The north of the well path: grid if it is known, else true, else magnetic."""
        if self.declination is None:
            return "magnetic"
        return "true" if self.convergence is None else "grid"

    @property
    def declination_uncertainty(self) -> float:
        """Standard uncertainty of the declination at one station."""
        return float(np.hypot(self.declination_sd, self.declination_noise))

    @property
    def offset(self) -> float:
        """What is added to magnetic azimuths to count from that north."""
        return (self.declination or 0.0) - (self.convergence or 0.0)


@dataclass(frozen=True)
class Position:
    """Where stations lie: `place` (n, 3) north, east, TVD, m, and `covariance` (n, 3, 3); NaN: not on the path."""

    md: Array
    place: Array
    covariance: Array

    @property
    def sd(self) -> Array:
        """Standard uncertainties (n, 3)."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0)))


@dataclass(frozen=True)
class Well:
    """Surveys of a well in the order of their table.

    `corrected`: vectors and scalars as `correction.correct` gives them; `blank` (n,): stations without results,
    and `extrapolated` ones, without a statement of accuracy. `position`: None without measured depths.
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

    @cached_property
    def remarks(self) -> list[str]:
        """What is wrong with each station."""
        return self.judgement.findings()

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
    columns, _, findings = counted(calibration, readings, outside)
    beyond, blank = calibration.outside(readings), np.isnan(columns[RESULTS[0]])
    surveys = _without(surveyed(calibration, readings, switch, advance), blank, beyond)
    g, b = (np.stack([columns[name] for name in VECTORS[i : i + 3]], -1) for i in (0, 3))
    judgement = judged(surveys, (g, b), _scaled(calibration, readings), limits)
    start = (0.0, 0.0, 0.0) if tie_in is None else tie_in
    position = None if md is None else _positions(calibration, readings, md, north, blank, start)
    result = Well(
        calibration, readings, surveys, judgement, limits, north, (g, b), position, findings
    )
    return replace(result, findings=findings + _findings(result, tie_in is None))


def _without(surveys: Surveys, blank: Bools, beyond: Bools) -> Surveys:
    """Surveys without values where they are `blank`, and without uncertainties `beyond` the temperatures."""
    return Surveys(
        np.where(blank[:, None], np.nan, surveys.value),
        np.where((blank | beyond)[:, None], np.nan, surveys.sd),
        np.where((blank | beyond)[:, None, None], np.nan, surveys.strengths),
        surveys.magnetic & ~blank,
    )


def _scaled(calibration: Calibration, readings: Readings) -> Readings:
    """The readings, with what |g| may depart from its reference because the laboratory's gravity is not known."""
    if not unknown_gravity(calibration):
        return readings
    sd = np.hypot(readings.uncertainty("gravity"), UNKNOWN_GRAVITY)
    return replace(readings, sd={**readings.sd, "gravity": sd})


def unknown_gravity(calibration: Calibration) -> bool:
    """Whether the calibration took gravity as exactly 1 g, which no reference says."""
    return calibration.earth["gravity_g"] == 1.0


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
    first = int(np.argmax(rejected))
    on_path = np.zeros(len(rejected), bool) if position is None else ~np.isnan(position.place[:, 0])
    there = bool(on_path.any())
    applies = {
        "rejected": rejected.any(),
        "rejected-on-path": (rejected & on_path).any(),
        "not-judged": not judgement.judged.all(),
        "laboratory-gravity": unknown_gravity(result.calibration)
        and not np.isnan(judgement.departure[:, 0]).all(),
        "magnetic-north": result.north.declination is None and result.calibration.has_field,
        "path-from-first": there and from_first and position is not None and position.md[0] > 0,
        "left-out": there and not on_path.all(),
    }
    words = {
        "rejected": int(rejected.sum()), "judged": int(judgement.judged.sum()), "limits": result.limits.name,
        "rows": len(rejected), "first": result.readings.labels[first], "why": result.remarks[first],
        "count": int((~on_path).sum() if there else 0),
    }  # fmt: skip
    return [
        Finding(id=name, text=text.format(**words | _not_judged(name, judgement)))
        for name, text in WELL_FINDINGS.items()
        if applies[name]
    ]


def _not_judged(name: str, judgement: Judgement) -> dict[str, int]:
    return {"count": int((~judgement.judged).sum())} if name == "not-judged" else {}


def _angle(name: str, value: Array, sd: Array) -> dict[str, AnyArray]:
    return {f"{name}_deg": np.degrees(value), f"sd_{name}_deg": np.degrees(sd)}
