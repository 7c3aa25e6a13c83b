"""Interference of the drill string: multi-station analysis (MSA) by the estimator of the laboratory.

Field surveys are the stations. Nobody knows their azimuth; gravity, field and dip of the place are
known within their uncertainties, common to the run. The laboratory's calibration with its covariance
is the prior, but for the magnetometer's offsets, and scales on request: the iron of the drill string
adds to these, so their prior is as wide as interference can be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.courses import OFFSETS
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import UNKNOWN_GRAVITY, unknown_gravity
from mwdcal.calibration.prior import Knowledge, for_run
from mwdcal.calibration.readings import CONSTANTS, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.estimation.uncertainty import TANGENT_STEP, analyse, tangent
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, diagonal
from mwdcal.survey.place.references import PLACE_SD
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


@dataclass(frozen=True)
class Assumed:
    """What interference can be before the surveys are seen, and when its estimate is of use.

    Attributes:
        axial_nt: 1σ of the interference along the tool, nT.
        cross_axial_nt: 1σ of each of the two components across it, nT.
        scale: 1σ by which interference can change each magnetometer scale, as a share; 0: not at all.
        robust: station weights, as of `Options`: one bad survey has little influence. None: all alike.
        largest_azimuth_sd_deg: 1σ of the azimuth, of what interference is left, that is still of use.
    """

    axial_nt: float = 3000.0
    cross_axial_nt: float = 150.0
    scale: float = 0.0
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
        """What each entry of `sd` is."""
        return OFFSET_NAMES + tuple(f"scale {axis}" for axis in "xyz") * (self.scale > 0)


@dataclass(frozen=True)
class Estimate:
    """Interference of B wells: arrays with a leading axis.

    `parameters` (B, k) and `covariance` (B, k, k) are those of the corrected calibration; `size` (B, d) and
    `spread` (B, d, d) the interference by `Assumed.names` with its covariance. If field and dip also depart
    from station to station, its covariance is `cautious_spread`, and `azimuth_sd` (B, n) the 1σ that it leaves
    in the azimuths, rad. `open_azimuth` (B,): one rests on what neither laboratory nor surveys determine. `bound`
    and `released` are the laboratory's knowledge without and with interference.
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
    bound: Knowledge
    released: Knowledge

    @property
    def sd(self) -> Array:
        """1σ (B, d) of each direction: where interference is not separable, the cautious one."""
        spread = np.where(self.separable[:, None, None], self.spread, self.cautious_spread)
        return np.asarray(np.sqrt(diagonal(spread)))

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

    Definition: with θ the parameters, θ₀ and Λ⁻¹ the laboratory's, and D what unit interference h does to
    them, θ - θ₀ = e - D h. The prior of θ is N(θ₀, Λ⁻¹ + D W² Dᵀ), W being what is assumed of h; and h
    given θ has mean -K (θ - θ₀), K = (W⁻² + DᵀΛD)⁻¹ DᵀΛ, and covariance (W⁻² + DᵀΛD)⁻¹.
    Raises `InputError` where calibration and readings do not belong together, or lack a reference.
    """
    assumed, readings = assumed or Assumed(), surveys(calibration, readings)
    known = for_run(calibration, readings)
    directions = _directions(calibration, known, assumed)
    weighed = known.precision @ directions
    left = np.linalg.inv(np.diag(assumed.sd**-2) + directions.T @ weighed)
    released = replace(known, precision=known.precision - weighed @ left @ weighed.T)
    options = _options(calibration, assumed)
    result = fit(readings, replace(options, prior=released))
    reference = calibration.reference_temperature
    maps = results.to_file(result, reference)
    parameters = np.einsum("bkp,bp->bk", maps, result.state.params)
    names = [f"{t.name} {name}" for t in calibration.triads for name in t.parameter_names]
    rows = [names.index(name) for name in known.names]
    gain, inner = -left @ weighed.T, maps[:, rows]
    stated = results.StatedCovariance(_no_quieter(result))
    spread, cautious = (
        gain @ (inner @ covariance @ inner.mT) @ gain.T + left
        for covariance in (stated.total, _cautious(result))
    )
    moved = _by_interference(result, assumed)
    return Estimate(
        readings=readings,
        assumed=assumed,
        result=result,
        parameters=parameters,
        covariance=stated.in_file(reference),
        size=_unscaled((parameters[:, rows] - known.expected) @ gain.T),
        spread=spread,
        cautious_spread=cautious,
        azimuth_sd=np.sqrt(np.einsum("bni,bij,bnj->bn", moved, cautious, moved)),
        open_azimuth=_open_azimuth(calibration, readings, result),
        bound=known,
        released=released,
    )


def surveys(calibration: Calibration, readings: Readings) -> Readings:
    """The readings as stations of unknown attitude, with the noise of the calibration where none is stated.

    What is new of field and dip at every station counts as noise of the magnetometer, by the larger of the two.
    Raises `InputError` for a calibration or readings without a magnetometer, or without a reference.
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
    calibration.fields(readings)
    shape = readings.accelerometer.shape
    sd = {
        t.name: np.broadcast_to(readings.sd.get(t.name, t.noise), shape) for t in calibration.triads
    }
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
    """Whether (B,) an azimuth rests on a direction that nothing determines; the zero of toolface is none."""
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


def _directions(calibration: Calibration, known: Knowledge, assumed: Assumed) -> Array:
    """Change (k, d) of the known parameters that adds each unit of interference to the field."""
    triad = calibration.triads[-1]
    model, params = triad.functions(calibration.reference_temperature), np.array(triad.parameters)
    steady = [place for place, name in enumerate(triad.parameter_names) if name in OFFSETS]
    at = params, np.zeros((1, 3)), np.array([calibration.reference_temperature])
    shift = np.zeros((len(params), 3))
    shift[steady] = np.linalg.inv(model.jacobian(*at)[0][:, steady])
    columns = [shift]
    if assumed.scale:
        stretches = np.eye(3) + TANGENT_STEP * np.eye(3)[:, :, None] * np.eye(3)[:, None]
        columns.append(tangent(model, np.broadcast_to(params, (3, len(params))), stretches).T)
    whole = np.concatenate(columns, -1)
    names = [f"{triad.name} {name}" for name in triad.parameter_names]
    return np.stack([whole[names.index(n)] if n in names else 0 * whole[0] for n in known.names])


def _by_interference(result: Fit, assumed: Assumed) -> Array:
    """Derivatives (B, n, d) of the azimuth by the directions of interference; zero at vertical."""
    g, b = result.problem.fields(result.state)
    azimuth = np.nan_to_num(OBSERVABLES["azimuth"].gradient(g, b)[..., 3:])
    return np.concatenate([azimuth, azimuth * b], -1) if assumed.scale else azimuth


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
    options = replace(_options(calibration, whole.assumed), robust=None)
    fits = [fit(whole.readings, replace(options, prior=p)) for p in (whole.bound, whole.released)]
    before, after = (each.problem.linear(each.state).normal.cost for each in fits)
    return before, after
