"""The same calibration in another notation, with covariance.

forward   raw = S · field + o          (Moradi 3-4)
affine    field = M · raw + b          (Ivanov)
factors   SF, B, m                     (Moosavi 1-8, in the order of the raw channels)

Raw units, channels in the order of the file; fields in g and nT (or a field of one).

At one temperature all three are equivalent. Over temperature they are given as coefficients by
power of τ = T - reference where these are polynomials: factors of order n have SF and B of degree n,
hence S of degree n and o = SF · B of degree 2n; the model that is linear in its parameters has
M and b of degree n. The other pairs are quotients of polynomials, and are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.record import FREE_SHARE, Calibration, TriadCalibration
from mwdcal.calibration.results import middle_temperature
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.models import affine_parts, factor_parts

NOTATIONS = ("factors", "forward", "affine")
COURSE = "course"
"""In place of a temperature: coefficients by power of T - reference."""
_NO_COURSE = (
    "{} notation is a quotient of polynomials of temperature and has no coefficients by power. Use `notation` {}, "
    "or a number in °C for `temperature`, or calibrate with `model` {}."
)
QUOTIENTS = {
    "factors": "factors are no polynomials of temperature. Use `notation` affine, for one temperature or with "
    "`temperature` course, or `notation` forward for one temperature, or calibrate with `model` factors.",
    "forward": _NO_COURSE.format("forward", "affine", "factors"),
    "affine": _NO_COURSE.format("affine", "forward or factors", "polynomial"),
}
"""Why a notation is refused that only another model has as polynomials of temperature, and what to do."""
VALUE_AXES = {"S": 2, "o": 1, "M": 2, "b": 1, "SF": 1, "B": 1, "m": 2}
"""Axes of each value at one temperature."""


@dataclass(frozen=True)
class Notation:
    """One triad in one notation: named arrays, their standard uncertainties and covariance.

    At one temperature S, M (3, 3) and o, b (3,); as a course S (n + 1, 3, 3), o (2n + 1, 3),
    M (n + 1, 3, 3) and b (n + 1, 3), by power of T - reference. SF and B (3, n + 1) have the
    powers last, m (3, 3) has none. `covariance` is of all values in the order of `values`,
    each row by row (power slowest in a course). A value that moves with a direction which no
    evidence determines has the uncertainty NaN.
    """

    values: dict[str, Array]
    uncertainty: dict[str, Array]
    covariance: Array


def powers(name: str, value: AnyArray) -> Ints:
    """Power of T - reference that each element of a value belongs to, in the value's shape."""
    count = np.arange(value.shape[-1] if name in ("SF", "B") else len(value))
    if name not in ("SF", "B"):
        course = value.ndim > VALUE_AXES[name]
        count = count.reshape(-1, *[1] * VALUE_AXES[name]) if course else np.zeros(1, int)
    return np.broadcast_to(count, value.shape)


def convert(
    calibration: Calibration, notation: str, temperature: float | str | None = None
) -> dict[str, Notation]:
    """Each triad of a calibration in a notation, at a temperature or as the whole course.

    `temperature` is in °C (default: the reference temperature) or the word "course". Factors
    are a course at any temperature.

    Errors: unknown notation or word; own-axis nonlinearity, which no notation can carry; a
    course that is no polynomial of temperature: factors or forward of a polynomial model and
    affine of the model of factors, both of order 1 or more.
    """
    if notation not in NOTATIONS:
        raise InputError(f"`notation` must be one of {', '.join(NOTATIONS)}; got {notation!r}.")
    if isinstance(temperature, str) and temperature != COURSE:
        raise InputError(
            "`temperature` must be a number in °C, or the word 'course' for coefficients by power "
            f"of temperature; got {temperature!r}."
        )
    at = calibration.reference_temperature if temperature is None else temperature
    return {triad.name: _one(calibration, triad, notation, at) for triad in calibration.triads}


@dataclass(frozen=True)
class ChannelCourse:
    """Scale and bias (n, 3) of the channels of a triad at n temperatures, and their 1σ.

    Units: `scale` in raw units per g, nT or field of one along the channel's own axis; `bias`, the reading
    at zero field, in g, nT or fields, by the scale at the middle temperature. 1σ is NaN where the
    value moves with a direction that no evidence determines.
    """

    scale: Array
    scale_sd: Array
    bias: Array
    bias_sd: Array


def channel_courses(
    calibration: Calibration, temperatures: Sequence[float]
) -> dict[str, ChannelCourse]:
    """How scale and bias of each channel vary with temperature (n,), °C, by triad."""
    middle = convert(calibration, "forward", middle_temperature(calibration))
    at = [convert(calibration, "forward", temperature) for temperature in temperatures]
    courses = {}
    for name, reference in middle.items():
        back = getattr(calibration.profile, name).permutation.transpose()
        place = np.arange(3), np.abs(back).argmax(-1)
        sign, unit = back[place], np.abs(reference.values["S"][place])
        each = [notations[name] for notations in at]
        courses[name] = ChannelCourse(
            scale=np.stack([n.values["S"][place] * sign for n in each]),
            scale_sd=np.stack([n.uncertainty["S"][place] for n in each]),
            bias=np.stack([n.values["o"] / unit for n in each]),
            bias_sd=np.stack([n.uncertainty["o"] / unit for n in each]),
        )
    return courses


def _one(
    calibration: Calibration, triad: TriadCalibration, notation: str, temperature: float | str
) -> Notation:
    """One triad in a notation, at a temperature or as a course."""
    _refuse(triad, notation, temperature)
    profile = getattr(calibration.profile, triad.name)
    permutation, scale = profile.permutation, np.full(3, profile.scale or 1.0)
    course = isinstance(temperature, str)
    tau = 0.0 if isinstance(temperature, str) else temperature - calibration.reference_temperature

    def values(params: AnyArray) -> dict[str, AnyArray]:
        if notation == triad.model:
            return channel_factors(params, permutation, scale)
        if course and triad.order and notation == "forward":
            return _forward_course(params, permutation, scale)
        if course and triad.order:  # the parameters of the polynomial model themselves
            matrix, offset = affine_parts(params.reshape(-1, 12))
            return {"M": matrix @ permutation / scale, "b": offset}
        matrix, offset = _affine(params, triad, tau)
        forms = _steady(notation, matrix @ permutation / scale, offset, permutation)
        if course and notation != "factors":
            return {name: value[None] for name, value in forms.items()}
        return forms

    return _propagate(values, calibration, triad)


def _refuse(triad: TriadCalibration, notation: str, temperature: float | str) -> None:
    """Refuse what the notation cannot carry, with the reason and what to do."""
    if triad.curved:
        raise InputError(
            f"the {triad.name} has own-axis quadratic and cubic terms, which the notation "
            f"{notation!r} cannot carry. Calibrate without 'nonlinearity' in the profile, or use "
            "mwdcal apply."
        )
    model = "polynomial" if notation == "affine" else "factors"
    if triad.order and triad.model != model and (notation == "factors" or temperature == COURSE):
        what = (
            f"the {triad.name} has the model '{triad.model}' of order {triad.order} in temperature"
        )
        raise InputError(f"{what}: its {QUOTIENTS[notation]}")


def _affine(params: AnyArray, triad: TriadCalibration, tau: float) -> tuple[AnyArray, AnyArray]:
    """Matrix and offset of field = A x + c at a temperature, x in tool axes and nominal units."""
    course = tau ** np.arange(triad.order + 1)
    if triad.model == "polynomial":
        return affine_parts(course @ params.reshape(triad.order + 1, 12))
    scale, bias, mixing = factor_parts(params)
    mixing = np.eye(3) - mixing
    return mixing / (scale @ course), -mixing @ (bias @ course)


def _steady(
    notation: str, matrix: AnyArray, offset: AnyArray, permutation: Array
) -> dict[str, AnyArray]:
    """The notation of field = matrix · raw + offset, raw in channels."""
    if notation == "affine":
        return {"M": matrix, "b": offset}
    if notation == "forward":
        inverse = np.linalg.inv(matrix)
        return {"S": inverse, "o": -inverse @ offset}
    channel = permutation.transpose() @ matrix
    scale = 1 / np.diagonal(channel)
    mixing = channel * scale
    bias = -np.linalg.solve(mixing, permutation.transpose() @ offset)
    return {"SF": scale[:, None], "B": bias[:, None], "m": -mixing * (1 - np.eye(3))}


def channel_factors(params: AnyArray, permutation: Array, scale: Array) -> dict[str, AnyArray]:
    """Stored factors, tool axes and nominal units, to channels and raw units: exact."""
    gain, bias, mixing = factor_parts(params)
    back = permutation.transpose()
    return {
        "SF": np.abs(back) @ gain * scale[:, None],
        "B": back @ bias,
        "m": back @ mixing @ permutation,
    }


def _forward_course(params: AnyArray, permutation: Array, scale: Array) -> dict[str, AnyArray]:
    """S and o of stored factors by power: diag(SF)(I - m)⁻¹ and SF · B of the nominal reading."""
    gain, bias, mixing = factor_parts(params)
    matrix = gain.transpose()[:, :, None] * np.linalg.inv(np.eye(3) - mixing)
    offset = np.stack([np.convolve(s, b) for s, b in zip(gain, bias, strict=True)], -1)
    back = permutation.transpose() * scale[:, None]
    return {"S": back @ matrix, "o": offset @ back.transpose()}


def _propagate(
    values: Callable[[AnyArray], dict[str, AnyArray]],
    calibration: Calibration,
    triad: TriadCalibration,
) -> Notation:
    """Values and covariance; derivatives by complex step, exact to rounding."""
    params, where = np.array(triad.parameters), calibration.places()[triad.name]
    notation = {name: np.asarray(value.real) + 0.0 for name, value in values(params).items()}
    steps = np.maximum(np.abs(params), 1.0) * 1e-30
    changed = (values(params + 1j * step) for step in np.diag(steps))
    columns = [np.concatenate([v.imag.ravel() for v in each.values()]) for each in changed]
    jacobian = np.stack(columns, -1) / steps
    spread = jacobian @ calibration.parameter_covariance[where, where] @ jacobian.transpose()
    free = calibration.free_directions[:, where]
    moved = np.abs(jacobian @ free.transpose()).max(-1, initial=0.0)
    loose = moved > FREE_SHARE * _sizes(calibration, triad, notation)
    sd = np.where(loose, np.nan, np.sqrt(np.maximum(np.diag(spread), 0.0)))
    ends = np.cumsum([value.size for value in notation.values()])[:-1]
    parts = zip(notation.items(), np.split(sd, ends), strict=True)
    uncertainty = {name: part.reshape(value.shape) for (name, value), part in parts}
    return Notation(notation, uncertainty, spread)


def _sizes(calibration: Calibration, triad: TriadCalibration, values: dict[str, Array]) -> Array:
    """Scale of each value, to see whether a free direction moves it."""
    low, high = calibration.temperature_c or (0.0, 0.0)
    strength = calibration.earth.get("field", 1.0) if triad.name == TRIADS[1] else 1.0
    name, value = next((n, v) for n, v in values.items() if n in ("S", "SF", "M"))
    gain = np.abs(value[powers(name, value) == 0]).max()
    scale = {"m": 1.0, "b": strength, "B": strength, "o": gain * strength}
    sizes = [
        scale.get(name, gain) / max((high - low) / 2, 1.0) ** powers(name, value)
        for name, value in values.items()
    ]
    return np.concatenate([size.ravel() for size in sizes])
