"""Interference of the drill string: multi-station analysis (MSA) by the estimator of the laboratory.

Field surveys are the stations. Nobody knows their azimuth; gravity, field and dip of the place are
known within their uncertainties, common to the run. The laboratory's calibration is the prior, with its
covariance and with what biases and scales have drifted since. The magnetometer's offsets, and scales on
request, are released further: the iron of the drill string adds to these.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.courses import OFFSETS
from mwdcal.calibration.diagnosis.identity import other_tool
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import PriorInformation, for_run
from mwdcal.calibration.readings import CONSTANTS, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import UNKNOWN_GRAVITY, unknown_gravity
from mwdcal.errors import InputError
from mwdcal.estimation.uncertainty import TANGENT_STEP, analyse, tangent
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, Bools, diagonal
from mwdcal.survey.acceptance import SensorTerms, load_survey_limits
from mwdcal.survey.references import PLACE_SD
from mwdcal.survey.stations import RANDOM

OFFSET_NAMES = ("cross-axial x", "cross-axial y", "axial")
"""Directions of interference, in the order of the tool axes x, y, z."""
USUAL_SD = {
    "gravity": UNKNOWN_GRAVITY,
    "field": PLACE_SD.field_nt,
    "dip": float(np.radians(PLACE_SD.dip_deg)),
}
"""1σ of references, common to a well, where the readings state none, g, nT and rad: those of global models."""
LEAST_VARIATION = float(np.radians(2.0))
"""Directions of gravity and field in the tool that differ by less, rad, make of many surveys one."""
DETERMINED_SHARE = 0.5
"""A direction is determined by the readings if they leave less than this share of what was assumed."""


DRIFT_SOURCES = {"owsg": "owsg-mwd", "none": ""}
"""Words for what sensors may have drifted by: limits of surveys whose sensor terms it is."""


def sensor_drift(name_or_path: str | os.PathLike[str] = "owsg") -> SensorTerms:
    """Drift of the sensors since the laboratory, 1σ of each axis: by a word of `DRIFT_SOURCES` or a limits file.

    Raises:
        InputError: no such limits.
    """
    name = os.fspath(name_or_path)
    source = DRIFT_SOURCES.get(name, name)
    return load_survey_limits(source)[0].sensor if source else SensorTerms()


@dataclass(frozen=True)
class Assumed:
    """What interference and drift can be before the surveys are seen, and when the estimate is of use.

    Attributes:
        axial_nt: 1σ of the interference along the tool, nT.
        cross_axial_nt: 1σ of each of the two components across it, nT.
        scale: 1σ by which interference can change each magnetometer scale, as a share; 0: not at all.
        drift: 1σ by which biases and scales of all axes have moved since the laboratory.
        robust: station weights, as of `Options`: one bad survey has little influence. None: all alike.
        largest_azimuth_sd_deg: 1σ of the azimuth, of interference and drift that are left, that is still of use.
    """

    axial_nt: float = 3000.0
    cross_axial_nt: float = 150.0
    scale: float = 0.0
    drift: SensorTerms = field(default_factory=sensor_drift)
    robust: str | None = "student-t"
    largest_azimuth_sd_deg: float = 1.0

    def __post_init__(self) -> None:
        """Refuse sizes that cannot be; raises `InputError`."""
        for name in ("axial_nt", "cross_axial_nt", "largest_azimuth_sd_deg"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"`{name}` must be above zero; got {getattr(self, name)!r}.")
        if not 0 <= self.scale < 1:
            raise InputError(f"`scale` must be a share, 0 to below 1; got {self.scale!r}.")

    @property
    def sd(self) -> Array:
        """1σ (d,) of each direction, nT, and of each scale if these are estimated."""
        offsets = [self.cross_axial_nt, self.cross_axial_nt, self.axial_nt]
        return np.array(offsets + [self.scale] * 3 * (self.scale > 0))

    @property
    def names(self) -> tuple[str, ...]:
        """The quantity that each entry of `sd` belongs to."""
        return OFFSET_NAMES + tuple(f"scale {axis}" for axis in "xyz") * (self.scale > 0)


@dataclass(frozen=True)
class Estimate:
    """Interference of B wells: arrays with a leading axis.

    `parameters` (B, k) and `covariance` (B, k, k) are those of the corrected calibration; `size` (B, d) and
    `spread` (B, d, d) the interference by `Assumed.names` with its covariance. If field and dip also depart
    from station to station, its covariance is `cautious_spread`, and `azimuth_sd` (B, n) the 1σ that the
    magnetometer, with interference and drift, leaves in the azimuths, rad. `open_azimuth` (B,): one rests on what
    neither laboratory nor surveys determine. `bound` and `released` are what is known of the tool, with drift,
    without and with interference.
    """

    readings: Readings
    assumed: Assumed
    result: Fit
    parameters: Array
    covariance: Array
    size: Array
    spread: Array
    cautious_spread: Array
    azimuth_sd: Array
    open_azimuth: Bools
    bound: PriorInformation
    released: PriorInformation

    @property
    def sd(self) -> Array:
        """1σ (B, d) of each direction: where interference is not separable, the cautious one."""
        spread = np.where(self.separable[:, None, None], self.spread, self.cautious_spread)
        return np.asarray(np.sqrt(np.maximum(diagonal(spread), 0.0)))

    @property
    def determined(self) -> Array:
        """Directions (B, d) that the readings determine, rather than what was assumed."""
        return np.asarray(self.sd < DETERMINED_SHARE * self.assumed.sd)

    @property
    def separable(self) -> Array:
        """Whether (B,) the azimuth of every station is of use after the correction."""
        whole = ~self.open_azimuth & varied(self.readings)
        limit = np.radians(self.assumed.largest_azimuth_sd_deg)
        return np.asarray(whole & (self.azimuth_sd.max(-1) <= limit))


def estimate(
    calibration: Calibration, readings: Readings, assumed: Assumed | None = None
) -> Estimate:
    """The interference in surveys (..., n) of one tool in one or many wells.

    Definition: with θ the parameters, θ₀ the laboratory's, Λ⁻¹ their covariance with that of drift, and D what
    unit interference h does to them, θ - θ₀ = e - D h. The prior of θ is N(θ₀, Λ⁻¹ + D W² Dᵀ), W being what is
    assumed of h; and h given θ has mean -K (θ - θ₀), K = (W⁻² + DᵀΛD)⁻¹ DᵀΛ, and covariance (W⁻² + DᵀΛD)⁻¹.
    Raises `InputError` where calibration and readings do not belong together, or lack a reference.
    """
    assumed, readings = assumed or Assumed(), surveys(calibration, readings)
    known, (released, gain, left) = _known(calibration, readings, assumed)
    result = fit(readings, replace(_options(calibration, assumed), prior=released))
    reference = calibration.reference_temperature
    maps = results.to_file(result, reference)
    parameters = np.einsum("bkp,bp->bk", maps, result.state.params)
    names = [f"{t.name} {name}" for t in calibration.triads for name in t.parameter_names]
    rows = [names.index(name) for name in known.names]
    inner = maps[:, rows]
    stated = results.StatedCovariance(_no_quieter(result))
    uneven = _cautious(result)
    spread, cautious = (
        gain @ (inner @ covariance @ inner.mT) @ gain.T + left
        for covariance in (stated.total, uneven)
    )
    return Estimate(
        readings=readings,
        assumed=assumed,
        result=result,
        parameters=parameters,
        covariance=stated.in_file(reference),
        size=_unscaled((parameters[:, rows] - known.expected) @ gain.T),
        spread=spread,
        cautious_spread=cautious,
        azimuth_sd=_azimuth_sd(result, uneven),
        open_azimuth=_open_azimuth(calibration, readings, result),
        bound=known,
        released=released,
    )


def surveys(calibration: Calibration, readings: Readings) -> Readings:
    """The readings as stations of unknown attitude, with the noise of the calibration where none is stated.

    Changes of field and dip from station to station count as noise of the magnetometer, by the larger of the two.
    Raises `InputError` for a calibration or readings without a magnetometer, or without a reference, or of two tools.
    """
    if not calibration.has_field or readings.magnetometer is None:
        raise InputError(
            f"{readings.name}: interference needs a magnetometer, in calibration and readings."
        )
    if calibration.relative:
        raise InputError(
            f"the calibration of {calibration.run_name} is relative (field = 1), and interference is in nT. "
            "Calibrate with ref_field_nt."
        )
    for name, column in (("field", "ref_field_nt"), ("dip", "ref_dip_deg")):
        if np.isnan(readings.reference(name)).any():
            raise InputError(
                f"{readings.name}: interference is estimated from field and dip, and {column} is missing. Add it, "
                "for example from mwdcal reference."
            )
    if other := other_tool(calibration, readings):
        raise InputError(
            f"{readings.name} is of tool {other[1]}, the calibration of tool {other[0]}. Give the calibration of tool "
            f"{other[1]}, or correct 'serial' in the table."
        )
    calibration.fields(readings)
    shape = readings.accelerometer.shape
    sd = {t.name: np.broadcast_to(t.noise_of(readings), shape) for t in calibration.triads}
    random = [readings.uncertainty(RANDOM + name) for name in ("field", "dip")]
    moved = np.maximum(random[0], readings.reference("field") * random[1])
    sd["magnetometer"] = np.hypot(sd["magnetometer"], moved[..., None])
    for name in CONSTANTS:
        stated = readings.uncertainty(name)
        sd[name] = np.where(stated > 0, stated, USUAL_SD[name])
    if unknown_gravity(calibration):
        sd["gravity"] = np.hypot(sd["gravity"], UNKNOWN_GRAVITY)
    known = {name: readings.reference(name) for name in CONSTANTS}
    return replace(readings, known=known, sd=sd)


def varied(readings: Readings) -> Bools:
    """Whether (...) surveys differ in attitude or toolface: gravity or field in the tool by `LEAST_VARIATION`."""
    turned = []
    for value in (readings.accelerometer, readings.magnetometer):
        unit = np.asarray(value) / np.linalg.norm(np.asarray(value), axis=-1, keepdims=True)
        turned.append(np.linalg.norm(unit - unit[..., :1, :], axis=-1).max(-1))
    return np.asarray(np.maximum(*turned) > LEAST_VARIATION)


def _open_azimuth(calibration: Calibration, readings: Readings, result: Fit) -> Bools:
    """Whether (B,) an azimuth rests on a direction that nothing determines; the zero of toolface does not count."""
    undetermined = (~result.analysis.determined.keep).sum(-1)
    resting = calibration.rests_on_free("azimuth", readings).any(-1)
    return np.asarray((undetermined > len(calibration.free)) | ((undetermined > 0) & resting))


def _options(calibration: Calibration, assumed: Assumed) -> Options:
    """A fit with the calibration's own model."""
    first, last = calibration.triads[0], calibration.triads[-1]
    return Options(
        model=first.model if first.model == last.model else None,
        order=(first.order, last.order),
        parameters=calibration.options.parameters,
        nonlinearity=(),
        robust=assumed.robust,
    )


def _loosened(
    known: PriorInformation, directions: Array, sd: Array
) -> tuple[PriorInformation, Array, Array]:
    """PriorInformation (k,) that also varies along directions (k, d) by `sd` (d,), and what it says of their sizes.

    Their gain (d, k), by which a departure of the parameters is theirs, and their covariance (d, d) beside it.
    """
    weighed = known.precision @ directions
    left = np.linalg.inv(np.diag(sd**-2) + directions.T @ weighed)
    precision = known.precision - weighed @ left @ weighed.T
    return replace(known, precision=precision), -left @ weighed.T, np.asarray(left)


def _drifted(
    calibration: Calibration, known: PriorInformation, drift: SensorTerms
) -> PriorInformation:
    """The remaining information on the tool once its biases and scales may have moved."""
    sizes = (
        (drift.accelerometer_bias_ms2 / STANDARD_GRAVITY, drift.accelerometer_scale),
        (drift.magnetometer_bias_nt, drift.magnetometer_scale),
    )
    sd = np.repeat(np.ravel(sizes), 3)
    changes = [_unit_changes(calibration, known, place) for place in range(len(sizes))]
    moves = np.concatenate(changes, -1)[:, sd > 0]
    return _loosened(known, moves, sd[sd > 0])[0]


def _unit_changes(calibration: Calibration, known: PriorInformation, place: int) -> Array:
    """Changes (k, 6) of the known parameters that add one unit to each axis of a triad, and one to each scale."""
    triad = calibration.triads[place]
    model, params = triad.functions(calibration.reference_temperature), np.array(triad.parameters)
    steady = [index for index, name in enumerate(triad.parameter_names) if name in OFFSETS]
    at = params, np.zeros((1, 3)), np.array([calibration.reference_temperature])
    shift = np.zeros((len(params), 3))
    shift[steady] = np.linalg.inv(model.jacobian(*at)[0][:, steady])
    stretches = np.eye(3) + TANGENT_STEP * np.eye(3)[:, :, None] * np.eye(3)[:, None]
    stretched = tangent(model, np.broadcast_to(params, (3, len(params))), stretches).T
    whole = np.concatenate([shift, stretched], -1)
    names = [f"{triad.name} {name}" for name in triad.parameter_names]
    return np.stack([whole[names.index(n)] if n in names else 0 * whole[0] for n in known.names])


def _azimuth_sd(result: Fit, covariance: Array) -> Array:
    """1σ (B, n) of the azimuths by a covariance (B, p, p) of the magnetometer's parameters; zero at vertical."""
    problem, state = result.problem, result.state
    triad, where = problem.triads[-1], problem.slices()[-1]
    gradient = np.nan_to_num(OBSERVABLES["azimuth"].gradient(*problem.fields(state))[..., 3:])
    by_params = triad.model.jacobian(state.params[:, where], triad.raw, problem.temperature)
    moved = np.einsum("bni,bnip->bnp", gradient, by_params)
    return np.asarray(
        np.sqrt(
            np.maximum(np.einsum("bnp,bpq,bnq->bn", moved, covariance[:, where, where], moved), 0.0)
        )
    )


def _unscaled(size: Array) -> Array:
    """The size (B, d) of interference from the change that takes it off: that divides offsets by scales too."""
    scales = size[:, 3:] if size.shape[1] > 3 else 0.0
    return np.concatenate([size[:, :3] * (1 + scales), size[:, 3:]], -1)


def _no_quieter(result: Fit) -> Fit:
    """The fit with s² of at least one: that few surveys scatter little does not make the noise small."""
    factor = np.fmax(result.analysis.variance_factor, 1.0)
    return replace(result, analysis=replace(result.analysis, variance_factor=factor))


def _cautious(result: Fit) -> Array:
    """Covariance (B, p, p) of the parameters if field and dip also depart from station to station.

    By as much as their references are uncertain in common: small differences between stations, all
    that there is near horizontal east-west, then tell little.
    """
    evidence = result.problem.evidence
    scatter = {name: evidence.sd[name] for name in ("field", "dip")}
    scatter["field"] = scatter["field"] / evidence.known["field"]
    uneven = replace(result.problem, evidence=replace(evidence, scatter=scatter))
    return analyse(uneven, result.state, result.analysis.determined).covariance


def misfits(calibration: Calibration, whole: Estimate) -> tuple[Array, Array]:
    """χ² (B,) of all stations, priors and references, alike: without and with interference.

    Of three degrees of freedom for each station: |g|, |b| and dip.
    """
    before, after = (
        _misfit(calibration, whole.readings, whole.assumed, prior)
        for prior in (whole.bound, whole.released)
    )
    return before, after


def chi_square(calibration: Calibration, readings: Readings, assumed: Assumed) -> Array:
    """χ² (B,) of `surveys` (B, n) or of those of one well (n,), as the second of `misfits`."""
    _, (released, *_) = _known(calibration, readings, assumed)
    return _misfit(calibration, readings, assumed, released)


def _misfit(
    calibration: Calibration, readings: Readings, assumed: Assumed, prior: PriorInformation
) -> Array:
    result = fit(readings, replace(_options(calibration, assumed), robust=None, prior=prior))
    return result.problem.linear(result.state).normal.cost


def _known(
    calibration: Calibration, readings: Readings, assumed: Assumed
) -> tuple[PriorInformation, tuple[PriorInformation, Array, Array]]:
    """The information on the tool without interference, and with it as of `_loosened`."""
    known = _drifted(calibration, for_run(calibration, readings), assumed.drift)
    field_changes = _unit_changes(calibration, known, 1)
    return known, _loosened(known, field_changes[:, : len(assumed.sd)], assumed.sd)
