"""Axial correction of single surveys: interference along the tool, as |b| and dip of the place show it at one attitude.

Each survey by itself. Near horizontal east-west, and wherever else the axial sensor hardly moves |b| and dip, is the
no-go zone: the correction would leave the azimuth more uncertain than is of use, and has no value.

Reference: the sensors across the tool and the place's field determine the component along it, US 4,163,324 (1979).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import AnyArray, Array, ArrayLike, Bools, wrap
from mwdcal.survey.acceptance import AXIAL
from mwdcal.survey.interference_estimate import Assumed, surveys
from mwdcal.survey.well import Well
from mwdcal.use.uncertainty import CORRECTED

TELLING = ("field", "dip")
"""The observables that tell interference along the tool."""
SIGN_COST = 9.0
"""Cost of the other sign of the axial field, over that of the better one, from which a survey tells it (3σ)."""
NEWTON_STEPS = 4
"""Steps of Newton's method from the best of the sizes that are tried: the last moves it by less than 1e-6 nT."""


@dataclass(frozen=True)
class AxialCorrection:
    """Interference along the tool of each survey (n,), nT, and the azimuth without it, from the north of the path, rad.

    Each with its standard uncertainty. `usable`: not in the no-go zone; NaN: no result.
    """

    size: Array
    sd_size: Array
    azimuth: Array
    sd_azimuth: Array
    usable: Bools

    @classmethod
    def joined(cls, parts: Sequence[AxialCorrection]) -> AxialCorrection:
        """Those of several runs, one after the other."""
        names = [each.name for each in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @property
    def no_go(self) -> Bools:
        """Surveys (n,) with an azimuth that are in the no-go zone."""
        return np.asarray(~self.usable & ~np.isnan(self.sd_azimuth))

    def columns(self, north: str) -> dict[str, AnyArray]:
        """The columns of a table; blank in the no-go zone but for the size, whose uncertainty says why."""
        azimuth, sd = (
            np.degrees(np.where(self.usable, value, np.nan))
            for value in (self.azimuth, self.sd_azimuth)
        )
        zone = np.where(self.usable, "false", np.where(self.no_go, "true", ""))
        return {
            "axial_interference_nt": self.size,
            "sd_axial_interference_nt": self.sd_size,
            f"azimuth_{north}_axial_deg": azimuth,
            f"sd_azimuth_{north}_axial_deg": sd,
            "axial_no_go": zone,
        }

    def findings(self, labels: Sequence[str], north: str) -> list[Finding]:
        """Findings about the extra column of azimuths without it, and about the no-go zone."""
        good, bad = int(self.usable.sum()), int(self.no_go.sum())
        text = (
            f"axial correction of single surveys: azimuth_{north}_axial_deg is the azimuth without interference along "
            f"the tool at {good} of {len(labels)} surveys, for comparison. azimuth_{north}_deg stays definitive, and "
            "with it path and covariance: they have the interference, and its 1σ. `msa` corrects all of them."
        )
        result = [Finding(id="axial-correction", text=text)]
        if bad:
            limit, sd, reasons = Assumed().largest_azimuth_sd_deg, np.degrees(self.sd_azimuth), []
            if wide := int((self.no_go & (sd > limit)).sum()):
                worst = int(np.argmax(np.where(self.no_go, sd, -1.0)))
                reasons.append(
                    f"{wide} would keep an azimuth uncertain by more than {limit:g}° (1σ; {sd[worst]:.2g}° at station "
                    f"{labels[worst]})"
                )
            if wide < bad:
                reasons.append(
                    f"{bad - wide} the other sign of the axial field explains nearly as well"
                )
            text = (
                f"{bad} of {len(labels)} surveys lie in the no-go zone of the axial correction, and are blank there: "
                f"{', '.join(reasons)}. Use `msa` with surveys at other attitudes."
            )
            result.append(Finding(id="axial-no-go", text=text))
        return result


def axial_correction(well: Well) -> AxialCorrection:
    """The axial correction of each survey of one run.

    Definition: with r(h) what |b| and dip are off their references once h is taken off along the tool, C the covariance
    of r by sensors and references, and W what is assumed of h, h minimises rᵀ C⁻¹ r + h²/W².
    Raises `InputError` without a magnetometer or references, or where interference was taken off before.
    """
    if any(finding.id == CORRECTED for finding in well.calibration.findings):
        raise InputError(
            "`axial_correction` and `msa` both take interference off. Leave one of them out."
        )
    readings = surveys(well.calibration, well.readings)
    g, b = (np.asarray(each, float) for each in well.vectors)
    sensors = _sensors(well, readings, g, b)
    size, spread, gain = _solved(readings, g, b, sensors)
    without = _without(b, size)
    # an error e of the vectors moves the azimuth itself and, by -K G e, the size that is taken off
    azimuth = OBSERVABLES["azimuth"].gradient(g, without)
    turn = azimuth[:, 5]
    moved = azimuth + turn[:, None] * np.einsum("nk,nkj->nj", gain, _gradient(g, without))
    left = spread / Assumed().axial_nt
    variance = np.einsum("ni,nij,nj->n", moved, sensors, moved)
    variance += turn**2 * (np.sum((gain * _reference_sd(readings)) ** 2, -1) + left**2)
    with np.errstate(invalid="ignore"):
        usable = np.degrees(np.sqrt(variance)) <= Assumed().largest_azimuth_sd_deg
    usable &= ~np.isnan(well.sd_azimuth)
    usable &= ~_ambiguous(readings, g, b, sensors, size)
    return AxialCorrection(
        size,
        np.sqrt(spread),
        wrap(OBSERVABLES["azimuth"].value(g, without) + well.north.offset),
        np.sqrt(variance + _other_errors(well, sensors, g, b)),
        np.asarray(usable),
    )


def _sensors(well: Well, readings: Readings, g: Array, b: Array) -> Array:
    """Covariance (n, 6, 6) of both vectors: calibration, noise, and drift of the sensors."""
    calibration = well.calibration
    by_parameters = calibration.jacobian(readings)
    covariance = by_parameters @ calibration.parameter_covariance @ by_parameters.mT
    covariance = covariance + calibration.noise_covariance(readings)
    if well.errors is None:
        return np.asarray(covariance)
    biases, scales, _ = well.errors.sizes(g, b)
    return np.asarray(covariance + (biases**2 + scales**2)[..., None] * np.eye(6))


def _other_errors(well: Well, sensors: Array, g: Array, b: Array) -> Array:
    """Variance (n,) of the azimuth by what the correction leaves as it is: declination, and the tool in the hole."""
    gradient = OBSERVABLES["azimuth"].gradient(g, b)
    axial = 0.0 if well.errors is None else well.errors.sensors.axial_interference_nt
    variance = np.einsum("ni,nij,nj->n", gradient, sensors, gradient)
    variance += (gradient[:, 5] * axial) ** 2
    return np.asarray(np.maximum(well.sd_azimuth**2 - variance, 0.0))


def _solved(readings: Readings, g: Array, b: Array, sensors: Array) -> tuple[Array, Array, Array]:
    """Interference along the tool (n,) with its variance (n,), and its gain (n, 2) from what |b| and dip are off."""
    sizes = np.concatenate([-AXIAL[::-1], [0.0], AXIAL])
    weights, prior = np.linalg.inv(_of_seen(readings, g, b, sensors)), Assumed().axial_nt ** -2
    costs = [
        _cost(_off(readings, g, _without(b, each)), weights) + prior * each**2 for each in sizes
    ]
    size = sizes[np.argmin(np.nan_to_num(costs, nan=0.0), 0)]
    for _ in range(NEWTON_STEPS):
        without = _without(b, size)
        weights = np.linalg.inv(_of_seen(readings, g, without, sensors))
        slope = -_gradient(g, without)[:, :, 5]
        weighed = np.einsum("nkl,nl->nk", weights, slope)
        spread = 1.0 / (np.sum(slope * weighed, -1) + prior)
        gain = spread[:, None] * weighed
        size = np.sum(gain * (slope * size[:, None] - _off(readings, g, without)), -1)
    return size, spread, gain


def _ambiguous(readings: Readings, g: Array, b: Array, sensors: Array, size: Array) -> Bools:
    """Surveys (n,) that the other sign of the field along the tool explains nearly as well.

    |b| is the same for both signs, and so is the dip of a horizontal tool: what remains is the size assumed.
    """
    prior = Assumed().axial_nt ** -2
    weights = np.linalg.inv(_of_seen(readings, g, _without(b, size), sensors))
    here, there = (
        _cost(_off(readings, g, _without(b, each)), weights) + prior * each**2
        for each in (size, 2 * b[:, 2] - size)
    )
    return np.asarray(there - here < SIGN_COST)


def _without(b: Array, size: ArrayLike) -> Array:
    """Fields (n, 3) without so much along the tool."""
    return np.asarray(b - np.broadcast_to(size, len(b))[:, None] * np.eye(3)[2])


def _off(readings: Readings, g: Array, b: Array) -> Array:
    """What |b| and dip (n, 2) are off their references."""
    return np.stack([OBSERVABLES[n].value(g, b) - readings.reference(n) for n in TELLING], -1)


def _gradient(g: Array, b: Array) -> Array:
    """Gradients (n, 2, 6) of |b| and dip."""
    return np.stack([OBSERVABLES[name].gradient(g, b) for name in TELLING], -2)


def _reference_sd(readings: Readings) -> Array:
    """Standard uncertainties (n, 2) of field and dip of the place."""
    return np.stack([np.broadcast_to(readings.sd[name], readings.count) for name in TELLING], -1)


def _of_seen(readings: Readings, g: Array, b: Array, sensors: Array) -> Array:
    """Covariance (n, 2, 2) of what |b| and dip are off."""
    gradient = _gradient(g, b)
    of_place = _reference_sd(readings)[:, :, None] ** 2 * np.eye(len(TELLING))
    return np.asarray(gradient @ sensors @ gradient.mT + of_place)


def _cost(off: Array, weights: AnyArray) -> Array:
    return np.asarray(np.einsum("nk,nkl,nl->n", off, weights, off))
