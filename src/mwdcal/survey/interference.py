"""Multi-station analysis of surveys: interference, what it does to azimuth, and when it is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.diagnosis.structure import chance_of, products
from mwdcal.calibration.readings import CONSTANTS, Readings, is_simulated
from mwdcal.calibration.record import Calibration, Finding, rounded, stated, with_checksum
from mwdcal.calibration.residuals import RESHOOT
from mwdcal.calibration.results import readings_at
from mwdcal.errors import FitError
from mwdcal.estimation.problem import ANGLES
from mwdcal.estimation.uncertainty import station_misfit
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import AnyArray, Array, Bools, centred, tool_from_earth
from mwdcal.survey.acceptance import SURVEY_UNITS, SensorTerms
from mwdcal.survey.interference_estimate import (
    DETERMINED_SHARE,
    USUAL_SD,
    Assumed,
    Estimate,
    estimate,
    misfits,
    surveys,
    varied,
)
from mwdcal.use.uncertainty import CORRECTED, DRIFTED, ErrorTerms, error_terms

# --------------------------------------------------------------------------
# Which survey would separate interference from azimuth, or determine a direction of it.

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


FEWEST_SURVEYS = 2
"""Surveys below which nothing can be said of several stations."""
LEAST_CHANCE = 1e-3
"""Chance of as large a misfit below which the surveys do not fit."""
CHANGED_ALONG = "interference-changes"
CHANGE_CHANCE = 0.05
"""Chance below which the misfit of surveys that do not fit is a change of the interference along the well."""
LEAST_SEEN = 2.0
"""Interference below this many standard uncertainties in every direction was not seen."""
FEWEST_AT_END = 2
"""Doubtful surveys in a row at the end that point at something near the hole."""
FARTHEST_REFERENCE = 3.0
"""Standard uncertainties beyond which what the surveys say of a reference contradicts it."""
BEYOND_ASSUMED = 3.0
"""Interference of more than this many times what was assumed says that too little was assumed."""


class InterferenceSize(msgspec.Struct, frozen=True, kw_only=True):
    """Interference along the tool's axis and across it, nT, with standard uncertainties.

    `cross_axial_nt` is the size of its two components. Scales are shares; None: not estimated.
    """

    axial_nt: float
    sd_axial_nt: float
    cross_axial_nt: float
    sd_cross_axial_nt: float
    cross_axial_x_nt: float
    sd_cross_axial_x_nt: float
    cross_axial_y_nt: float
    sd_cross_axial_y_nt: float
    scale: list[float] | None = None
    sd_scale: list[float] | None = None


class InterferenceDirection(msgspec.Struct, frozen=True, kw_only=True):
    """One direction of interference: its estimate, and whether the surveys determine it.

    `assumed` is the standard uncertainty before the surveys; one that is not determined keeps most of it.
    """

    direction: str
    value: float
    standard_uncertainty: float
    unit: str
    assumed: float
    determined: bool


class InterferenceStation(msgspec.Struct, frozen=True, kw_only=True):
    """One survey before and after the correction; None where an angle does not exist.

    `deviation` is the station's misfit after it, in standard deviations of one normal variable; `weight` its
    share in the robust fit; `doubtful`: it does not agree with the others.
    """

    station: str
    md_m: float | None
    inclination_deg: float
    azimuth_before_deg: float | None
    azimuth_after_deg: float | None
    azimuth_change_deg: float | None
    sd_azimuth_before_deg: float | None
    sd_azimuth_after_deg: float | None
    field_before_nt: float
    field_after_nt: float
    dip_before_deg: float
    dip_after_deg: float
    ref_field_nt: float
    ref_dip_deg: float
    deviation: float
    weight: float
    doubtful: bool


class MultiStationAnalysis(msgspec.Struct, frozen=True, kw_only=True):
    """The analysis of several surveys, for machines.

    `separable`: the azimuth of every station is of use after the correction, `azimuth_sd_deg` (1σ, of what
    interference is left, at the worst station) being at most `largest_azimuth_sd_deg`. `missing` says which
    survey would help. χ² is of |g|, |b| and dip of all stations, without and with interference.
    """

    interference: InterferenceSize
    separable: bool
    azimuth_sd_deg: float
    largest_azimuth_sd_deg: float
    missing: str
    directions: list[InterferenceDirection]
    chi_square_before: float
    chi_square_after: float
    degrees_of_freedom: int
    chance_before: float
    chance_after: float
    sd_ref_field_nt: float
    sd_ref_dip_deg: float
    station_rows: list[InterferenceStation]
    findings: list[Finding]


@dataclass(frozen=True)
class Interference:
    """The analysis, the corrected calibration to use for these surveys, and what both come from.

    `readings` are the surveys that were used, with references and uncertainties as they were used.
    """

    summary: MultiStationAnalysis
    calibration: Calibration
    readings: Readings

    @property
    def terms(self) -> ErrorTerms:
        """Sources in the standard uncertainties of magnetic azimuths, and those left out."""
        return error_terms(self.calibration, declination=False)

    @property
    def refusal(self) -> str:
        """Why the result cannot be trusted, in sentences; empty if it can."""
        summary = self.summary
        if not summary.separable:
            return (
                f"{self.readings.name}: the surveys do not separate interference from azimuth, which would "
                f"stay uncertain by {summary.azimuth_sd_deg:.2g}° (1σ; {summary.largest_azimuth_sd_deg:g}° is "
                f"allowed). {summary.missing}"
            )
        changes = [each.text for each in summary.findings if each.id == CHANGED_ALONG]
        return f"{self.readings.name}: {changes[0]}" if changes else ""

    def check(self) -> None:
        """Refuse to go on with what cannot be trusted; raises `FitError`."""
        if self.refusal:
            raise FitError(self.refusal)


def interference(
    calibration: Calibration,
    readings: Readings,
    assumed: Assumed | None = None,
    depth: Array | None = None,
) -> Interference:
    """Interference of the drill string in the surveys of one well, and the calibration without it.

    `depth` (n,) is measured depth, m, for tables and pictures. Surveys without a reading, and those outside
    the calibrated temperatures, are left out.
    Raises `InputError` where something is missing, `FitError` for too few surveys; whether the result is to be
    trusted: see `Interference.check`.
    """
    used = usable(calibration, readings)
    count = int(np.count_nonzero(used))
    if count < FEWEST_SURVEYS:
        raise FitError(
            f"{readings.name}: multi-station analysis needs {FEWEST_SURVEYS} surveys or more; "
            f"{count} of {readings.count} can be used. Add surveys, best at other toolfaces."
        )
    chosen = readings if used.all() else readings.select(used)
    if not varied(surveys(calibration, chosen)):
        raise FitError(
            f"{readings.name}: all surveys are at one attitude and one toolface, and tell no more than one. Add "
            "surveys at other toolfaces."
        )
    whole = estimate(calibration, chosen, assumed)
    corrected = corrected_calibration(calibration, whole)
    depths = np.full(count, np.nan) if depth is None else np.asarray(depth, float)[used]
    rows = _station_rows(calibration, corrected, whole, depths)
    findings = _findings(calibration, readings, whole, rows)
    if left := readings.count - count:
        findings.append(Finding(id="surveys-left-out", text=_left_out(left)))
    return Interference(
        _analysis(calibration, corrected, whole, rows, findings), corrected, whole.readings
    )


def usable(calibration: Calibration, readings: Readings) -> Bools:
    """Surveys (n,) with all readings, at temperatures that the calibration covers."""
    values = [
        value for value in (readings.accelerometer, readings.magnetometer) if value is not None
    ]
    whole = np.isfinite(np.concatenate(values, -1)).all(-1)
    if readings.temperature is not None:
        whole &= np.isfinite(readings.temperature)
    return np.asarray(whole & ~calibration.outside(readings))


def corrected_calibration(calibration: Calibration, whole: Estimate) -> Calibration:
    """The calibration with the interference of one well taken off, and the covariance that it has then."""
    covariance = whole.covariance[0]
    sd, triads = np.sqrt(np.maximum(np.diag(covariance), 0.0)), {}
    for triad in calibration.triads:
        where = calibration.places()[triad.name]
        pairs = zip(triad.standard_uncertainties, sd[where].tolist(), strict=True)
        triads[triad.name] = msgspec.structs.replace(
            triad,
            parameters=whole.parameters[0, where].tolist(),
            standard_uncertainties=[None if old is None else new for old, new in pairs],
        )
    tool, metadata = calibration.tool, whole.readings.metadata
    if is_simulated(metadata):
        tool = {**tool, "simulated": str(True)}
    text = f"corrected for interference of the drill string by {whole.readings.count} surveys of {whole.readings.name}"
    record = msgspec.structs.replace(
        calibration,
        **triads,
        tool=tool,
        simulated=calibration.simulated or is_simulated(metadata),
        covariance_rows=covariance.tolist(),
        inherited=[*calibration.inherited, *whole.readings.digest],
        findings=[*calibration.findings, Finding(id=CORRECTED, text=text), *_drift(whole)],
    )
    return with_checksum(rounded(record))


def _drift(whole: Estimate) -> list[Finding]:
    """That the covariance allows for drift of the sensors."""
    drift = whole.assumed.drift
    if drift == SensorTerms():
        return []
    text = (
        "1σ allows for sensors that have drifted since the laboratory by (1σ): accelerometer scale "
        f"{drift.accelerometer_scale:g}, bias {1e3 * drift.accelerometer_bias_ms2 / STANDARD_GRAVITY:.2g} mg, "
        f"magnetometer scale {drift.magnetometer_scale:g}, bias {drift.magnetometer_bias_nt:g} nT."
    )
    return [Finding(id=DRIFTED, text=text)]


def _analysis(
    calibration: Calibration, corrected: Calibration, whole: Estimate,
    rows: list[InterferenceStation], findings: list[Finding],
) -> MultiStationAnalysis:  # fmt: skip
    """The analysis of one well for machines."""
    from scipy.special import chdtrc

    freedom = 3 * whole.readings.count
    before, after = (float(each[0]) for each in misfits(calibration, whole))
    lacking = missing(whole, corrected, calibration)
    return MultiStationAnalysis(
        interference=_size(whole),
        separable=bool(whole.separable[0]),
        azimuth_sd_deg=float(np.degrees(whole.azimuth_sd[0].max())),
        largest_azimuth_sd_deg=whole.assumed.largest_azimuth_sd_deg,
        missing=lacking,
        directions=_directions(whole),
        chi_square_before=before,
        chi_square_after=after,
        degrees_of_freedom=freedom,
        chance_before=float(chdtrc(freedom, before)),
        chance_after=float(chdtrc(freedom, after)),
        sd_ref_field_nt=float(whole.readings.sd["field"].max()),
        sd_ref_dip_deg=float(np.degrees(whole.readings.sd["dip"].max())),
        station_rows=rows,
        findings=findings,
    )


def _size(whole: Estimate) -> InterferenceSize:
    """Interference of one well, and the size of its cross-axial part with that of its uncertainty along it."""
    (x, y, axial, *scale), spread = whole.size[0].tolist(), whole.spread[0]
    sd_x, sd_y, sd_axial, *sd_scale = whole.sd[0].tolist()
    across = float(np.hypot(x, y))
    along = np.array([x, y]) / across
    return InterferenceSize(
        axial_nt=axial,
        sd_axial_nt=sd_axial,
        cross_axial_nt=across,
        sd_cross_axial_nt=float(np.sqrt(max(along @ spread[:2, :2] @ along, 0.0))),
        cross_axial_x_nt=x,
        sd_cross_axial_x_nt=sd_x,
        cross_axial_y_nt=y,
        sd_cross_axial_y_nt=sd_y,
        scale=scale or None,
        sd_scale=sd_scale or None,
    )


def _directions(whole: Estimate) -> list[InterferenceDirection]:
    """Every direction of one well's interference."""
    each = (whole.size[0], whole.sd[0], whole.assumed.sd, whole.determined[0])
    return [
        InterferenceDirection(
            direction=name,
            value=value,
            standard_uncertainty=sd,
            unit="" if name.startswith("scale") else "nT",
            assumed=assumed,
            determined=determined,
        )
        for name, value, sd, assumed, determined in zip(
            whole.assumed.names, *(column.tolist() for column in each), strict=True
        )
    ]


def _station_rows(
    calibration: Calibration, corrected: Calibration, whole: Estimate, depth: Array
) -> list[InterferenceStation]:
    """The surveys of one well before and after."""
    readings, (deviation, doubtful) = whole.readings, deviations(whole)
    columns = {"md_m": depth, "deviation": deviation, "weight": whole.result.trust[0]}
    for when, record in (("before", calibration), ("after", corrected)):
        vectors = record.fields(readings)
        for name in ("azimuth", "dip"):
            columns[f"{name}_{when}_deg"] = np.degrees(OBSERVABLES[name].value(*vectors))
        columns[f"field_{when}_nt"] = OBSERVABLES["field"].value(*vectors)
        sd = record.uncertainty("azimuth", readings, noise=True)
        columns[f"sd_azimuth_{when}_deg"] = np.degrees(sd)
    change = np.radians(columns["azimuth_after_deg"] - columns["azimuth_before_deg"])
    columns["azimuth_change_deg"] = np.degrees(centred(change))
    columns["inclination_deg"] = np.degrees(OBSERVABLES["inclination"].value(*vectors))
    columns["ref_field_nt"] = readings.reference("field")
    columns["ref_dip_deg"] = np.degrees(readings.reference("dip"))
    rows = zip(readings.labels, doubtful.tolist(), *columns.values(), strict=True)
    names = ("station", "doubtful", *columns)
    return [
        msgspec.convert(
            dict(zip(names, (*row[:2], *map(stated, row[2:])), strict=True)), InterferenceStation
        )
        for row in rows
    ]


def deviations(whole: Estimate) -> tuple[Array, Bools]:
    """How far (n,) each survey of a well is from the others, in standard deviations, and which are doubtful.

    A survey is doubtful if noise makes one of n as large with a probability below `RESHOOT`, the noise
    being what most surveys have where that is more than declared.
    """
    from scipy.special import chdtrc, chdtri, ndtri

    square, freedom = (each[0] for each in station_misfit(whole.result.analysis))
    square, freedom = square / whole.result.trust[0], np.maximum(freedom, 1.0)
    typical = max(1.0, float(np.median(square / chdtri(freedom, 0.5))))
    chance = np.asarray(chdtrc(freedom, square / typical))
    doubtful = chance < RESHOOT / len(chance)
    return np.asarray(-ndtri(np.maximum(chance, 1e-300) / 2)), doubtful


def _findings(
    calibration: Calibration, readings: Readings, whole: Estimate, rows: list[InterferenceStation]
) -> list[Finding]:
    """The findings of one well's analysis."""
    size, sd, assumed = whole.size[0], whole.sd[0], whole.assumed
    texts = {}
    if not (np.abs(size) > LEAST_SEEN * sd).any():
        texts["interference-not-significant"] = (
            f"no interference larger than {LEAST_SEEN:g} standard uncertainties in any direction: the "
            "azimuths need no correction."
        )
    beyond = np.abs(size) > BEYOND_ASSUMED * assumed.sd
    if beyond.any():
        name = whole.assumed.names[int(np.argmax(beyond))]
        texts["interference-beyond-assumed"] = (
            f"{name}: the interference is more than {BEYOND_ASSUMED:g} times what was assumed (1σ). Assume more, with "
            "`axial_nt`, `cross_axial_nt` or `scale`, and look for another cause, such as a magnetised tool."
        )
    if bare := [n for n in ("field", "dip") if (readings.uncertainty(n) <= 0).any()]:
        texts["reference-uncertainty-assumed"] = (
            f"no uncertainty is stated for the reference of {' and '.join(bare)}: that of a global field model is "
            f"assumed ({USUAL_SD['field']:.0f} nT, {np.degrees(USUAL_SD['dip']):.1g}°). State sd_ref_field_nt and "
            "sd_ref_dip_deg."
        )
    texts |= _misfit(calibration, whole) | _doubtful_references(whole)
    return [Finding(id=key, text=text) for key, text in texts.items()] + _doubtful(whole, rows)


def _misfit(calibration: Calibration, whole: Estimate) -> dict[str, str]:
    """That the surveys do not fit, by id, in a sentence."""
    from scipy.special import chdtrc

    chance = float(chdtrc(3 * whole.readings.count, misfits(calibration, whole)[1][0]))
    if chance >= LEAST_CHANCE:
        return {}
    factor = float(np.sqrt(results.variance_scales(whole.result)[0].max()))
    widened = f" Uncertainties are widened {factor:.2g} times." if factor > 1.05 else ""
    texts = {
        "surveys-do-not-fit": f"the surveys do not fit (chance {chance:.1g}): the sensors have changed by more than "
        "`sensor_drift` allows, or field and dip are not those of the references." + widened
    }
    if (changing := _chance_of_change(whole)) < CHANGE_CHANCE:
        texts[CHANGED_ALONG] = (
            "the surveys do not fit, and what is left along the axis follows their order (chance "
            f"{changing:.1g}): axial interference that changes along the well, or a drift of the sensors. No "
            "uncertainty covers it. Give the surveys before and after a change of the drill string as runs of their "
            "own, or do without multi-station analysis."
        )
    return texts


def _chance_of_change(whole: Estimate) -> float:
    """Chance in noise, as the surveys have it, of axial residuals of one well that follow its order as much.

    Definition: Fisher's F of a polynomial of the second degree in the number of a survey.
    """
    result, problem = whole.result, whole.result.problem
    place = np.linspace(-1, 1, whole.readings.count)
    order = np.asarray(np.polynomial.legendre.legvander(place, 2)[:, 1:], float)
    axial = np.zeros((*problem.temperature.shape, 6, 1))
    axial[..., 5, 0] = problem.evidence.include / problem.triads[1].sd[..., 2]
    return float(chance_of(problem, result, products(axial, order))[0])


def _doubtful_references(whole: Estimate) -> dict[str, str]:
    """References that the surveys put farther off than their uncertainty allows, by id, in sentences.

    With what the estimate itself may be off by, the noise being what the surveys have.
    """
    result, texts = whole.result, {}
    noisy = np.diag(result.analysis.constants[0]) * results.variance_scales(result)[0].max()
    stated = result.problem.evidence.constants
    for size, variance, constant in zip(result.state.constants[0], noisy, stated, strict=True):
        sigmas = abs(size) / float(constant.sd[0])
        likely = FARTHEST_REFERENCE * np.hypot(constant.sd[0], np.sqrt(max(variance, 0.0)))
        if constant.name in SURVEY_UNITS and abs(size) > likely:
            unit, factor, digits = SURVEY_UNITS[constant.name]
            texts[f"reference-{constant.name}-doubtful"] = (
                f"by the surveys {constant.name} is {size * factor:+.{digits}f} {unit} from its reference, "
                f"{sigmas:.1f} times the standard uncertainty of that: check place, date and datum. No stated "
                "uncertainty covers it."
            )
    return texts


def _doubtful(whole: Estimate, rows: list[InterferenceStation]) -> list[Finding]:
    """A finding for each survey that does not agree with the others; the last ones in a row together."""
    places = [place for place, row in enumerate(rows) if row.doubtful]
    last = len(rows)
    while last - 1 in places:
        last -= 1
    findings = [
        Finding(id="survey-doubtful", station=rows[place].station, text=_doubt(rows[place]))
        for place in places
        if place < last or len(rows) - last < FEWEST_AT_END
    ]
    if len(rows) - last >= FEWEST_AT_END:
        text = (
            f"the last {len(rows) - last} surveys, from station {rows[last].station} on, do not agree with those "
            "before: look for casing, another well or a fish near the tool. They count little."
        )
        findings.append(Finding(id="surveys-disturbed", station=rows[last].station, text=text))
    return findings


def _doubt(row: InterferenceStation) -> str:
    """The fault of a survey, in a sentence."""
    return (
        f"station {row.station} does not agree with the others ({row.deviation:.1f} standard deviations): |b| is "
        f"{row.field_after_nt - row.ref_field_nt:+.0f} nT and dip {row.dip_after_deg - row.ref_dip_deg:+.2f}° off the "
        "references after the correction. It counts little; take the survey again."
    )


def _left_out(count: int) -> str:
    """Why surveys were left out, in a sentence."""
    return (
        f"{count} surveys were left out: readings are missing, or their temperature is outside that of the "
        "calibration."
    )
