"""A calibration in whole numbers: the power of two of every word, and a bound of what rounding costs.

A word of N bits is a value times a power of two, its `fraction`, rounded. The bound follows each operation of
`sources/mwdcal_fixed.c`: half a step for every rounding, and the error of what comes in times its largest factor.

Range of a correction in firmware, and how far errors of its vectors move the angles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import EARTH_RANGES, TRIADS
from mwdcal.calibration.record import MAGNETIC, Calibration, TriadCalibration
from mwdcal.calibration.results import (
    CORNER_SHARES,
    CORNERS,
    middle_temperature,
    raw_reading,
    readings_at,
)
from mwdcal.errors import InputError
from mwdcal.files.contract import TEMPERATURE
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.sensor.models import Model
from mwdcal.use.notation import COURSE, convert

MARGIN_OF_STRENGTH = 1.1
"""A strength may be so many times that of the place of the calibration, and any that the Earth has."""
ANGLES_OUT = ("inclination", "azimuth", "toolface", "magnetic_toolface")
"""Angles of a correction in firmware, in their order; errors of all but the first count by a share."""
SHARE_OF = {"toolface": "gravity", "azimuth": "gravity", "magnetic_toolface": "field"}
"""The vector whose part across the tool axis, as a share of it, weights the error of an angle."""
_HIGHER_TERMS = 1.02
"""Allowance for what a linear error leaves out, and the steps of the attitudes over which the largest is sought."""
_TURNS = np.radians(np.arange(0, 360, 15))
_ALL_ATTITUDES = np.meshgrid(np.radians([0.5, *range(5, 180, 5), 179.5]), _TURNS, _TURNS)
"""Inclinations, azimuths and toolfaces over which the largest error is sought."""
_WARMTHS = 65


@dataclass(frozen=True)
class WorkingRange:
    """Strengths by triad, lowest and highest temperature, °C, and the raw channels that follow (3,) each."""

    strengths: Mapping[str, float]
    temperatures: tuple[float, float]
    raw: Mapping[str, Array]


def working_range(calibration: Calibration) -> WorkingRange:
    """The range in which a correction by this calibration is used.

    Any strength of the Earth, and 10 % more than where the tool was calibrated; temperatures that `apply` corrects.
    """
    low, high = calibration.temperature_c or (TEMPERATURE.low, TEMPERATURE.high)
    margin = calibration.margin if calibration.temperature_c else 0.0
    ends = (max(low - margin, TEMPERATURE.low), min(high + margin, TEMPERATURE.high))
    strengths = {triad.name: _strength(calibration, triad) for triad in calibration.triads}
    raw = {
        t.name: _largest_raw(calibration, t, strengths[t.name], ends) for t in calibration.triads
    }
    return WorkingRange(strengths, ends, raw)


def _strength(calibration: Calibration, triad: TriadCalibration) -> float:
    """The largest strength, g or nT; of a relative field the ratio of the strongest to the weakest."""
    name = "gravity" if triad.name == TRIADS[0] else "field"
    low, high = EARTH_RANGES[name]
    relative = name == "field" and calibration.relative
    here = calibration.earth["gravity_g" if name == "gravity" else "field"]
    return max(high / low if relative else high, MARGIN_OF_STRENGTH * here)


def _model(calibration: Calibration, triad: TriadCalibration) -> tuple[Model, Array]:
    """A triad's model and its parameters."""
    return triad.functions(calibration.reference_temperature), np.array(triad.parameters)


def _largest_raw(
    calibration: Calibration, triad: TriadCalibration, strength: float, ends: tuple[float, float]
) -> Array:
    """The largest raw value (3,) of each channel over all directions and the temperatures."""
    warmth = np.linspace(*ends, _WARMTHS)[:, None]
    model, params = _model(calibration, triad)
    fields = np.broadcast_to(strength * CORNERS, (_WARMTHS, *CORNERS.shape))
    corners = raw_reading(model, params, fields, np.broadcast_to(warmth, fields.shape[:-1]))
    zero, *axes = np.moveaxis(CORNER_SHARES.transpose() @ corners, -2, 0)
    largest = np.max(np.abs(zero) + np.sqrt(sum(axis**2 for axis in axes)), 0)
    profile = getattr(calibration.profile, triad.name)
    return np.asarray(np.abs(profile.permutation.transpose()) @ largest * (profile.scale or 1.0))


def rounding_errors(calibration: Calibration, work: WorkingRange, share: float) -> list[Array]:
    """Errors (3,) of each triad's vector where every term of it is off by a share of itself."""
    warmth = np.array([middle_temperature(calibration)])
    errors = []
    for triad in calibration.triads:
        profile = getattr(calibration.profile, triad.name)
        raw = np.abs(profile.permutation) @ work.raw[triad.name] / (profile.scale or 1.0)
        model, params = _model(calibration, triad)
        slope = np.abs(model.slope(params, raw[None], warmth)[0])
        zero = np.abs(model.fields(params, np.zeros((1, 3)), warmth)[0])
        errors.append(share * (slope @ raw + 2 * zero + work.strengths[triad.name]))
    return errors


def angle_errors(
    calibration: Calibration, vectors: Sequence[Array], turn: float, read: float
) -> dict[str, float]:
    """Largest errors, degrees, of the angles where the vectors are off by errors (3,), over all attitudes.

    At the gravity, field and dip of the calibration. `turn`: what every direction is off by besides; `read`:
    what an angle is off by when it is written, both in radians. All but the inclination's are multiplied by the
    share of `SHARE_OF`; 180 where nothing is known.
    """
    g, b = calibration.fields(readings_at(calibration, *_ALL_ATTITUDES))
    b = b if calibration.has_field else np.zeros_like(g)
    off = (
        error + turn * np.linalg.norm(vector, axis=-1, keepdims=True)
        for error, vector in zip((*vectors, np.zeros(3)), (g, b), strict=False)
    )
    both, errors = np.concatenate(list(off), -1), {}
    for name in (n for n in ANGLES_OUT if calibration.has_field or n not in MAGNETIC):
        with np.errstate(divide="ignore", invalid="ignore"):  # an angle that does not exist there
            gradient = np.abs(OBSERVABLES[name].gradient(g, b))
            worst = np.nanmax(share(name, g, b) * (np.sum(gradient * both, -1) + turn))
        errors[name] = float(min(_HIGHER_TERMS * np.degrees(worst) + np.degrees(read), 180.0))
    return errors


def share(name: str, g: Array, b: Array) -> Array:
    """The part across the tool axis (...) of the vector that an angle is read from; 1 for inclination."""
    if name not in SHARE_OF:
        return np.ones(g.shape[:-1])
    vector = g if SHARE_OF[name] == "gravity" else b
    return np.asarray(np.hypot(vector[..., 0], vector[..., 1]) / np.linalg.norm(vector, axis=-1))


WORD_BITS = (12, 32)
"""Least and greatest number of bits of a word."""
_SPARE = 8
"""Words at the upper end that are left to the rounding of sums."""
_LARGEST_SUM = 62
"""Power of two that no sum of 64 bits exceeds."""
_WEAK = 16
"""Errors below which a vector has no direction."""


class WordForm(NamedTuple):
    """Words of some `bits`, over temperatures: |τ| does not exceed 2^half, `error` is that of τ / 2^half."""

    bits: int
    half: int
    error: float


class Words(NamedTuple):
    """Coefficients (..., K) by power of τ / 2^half, as words: value = words / 2^fraction.

    `size` and `error` (...): what their sum can reach, and by how much it is off.
    """

    words: Ints
    fraction: int
    size: Array
    error: Array


@dataclass(frozen=True)
class FixedTriad:
    """One triad in words; `raw`, `middle` and `field` are the fractions of its input, of z and of its output.

    `error` (3,) bounds the error of the field, from the raw channel on. `scale` and `bias` of factors only.
    """

    name: str
    raw: int
    middle: int
    field: int
    gain: Words
    offset: Words
    scale: Words | None
    bias: Words | None
    error: Array


@dataclass(frozen=True)
class FixedCalibration:
    """A calibration in words; `temperature` is the fraction of the temperature.

    `reference`, `lowest` and `highest` are temperatures as words. `angles`: errors in degrees, see `angle_errors`.
    """

    form: WordForm
    work: WorkingRange
    temperature: int
    reference: int
    lowest: int
    highest: int
    triads: tuple[FixedTriad, ...]
    angles: Mapping[str, float]

    @property
    def weak(self) -> list[int]:
        """Words of each triad below which its vector has no direction."""
        sizes = (_WEAK * math.sqrt(2) * t.error.max() * 2.0**t.field for t in self.triads)
        return [math.ceil(size) for size in sizes]


def quantised(calibration: Calibration, bits: int) -> FixedCalibration:
    """The calibration in words.

    Raises:
        InputError: `word_bits` is out of range, a triad has own-axis terms, or scale factors could vanish.
    """
    low, high = WORD_BITS
    if not low <= bits <= high:
        raise InputError(f"`word_bits` must be between {low} and {high}; got {bits}.")
    for triad in calibration.triads:
        if triad.curved:
            raise InputError(
                f"the {triad.name} has own-axis quadratic and cubic terms, which fixed-point numbers do not "
                "carry. Use `form` c-header, or calibrate with `nonlinearity` none."
            )
    work, reference = working_range(calibration), calibration.reference_temperature
    ends = np.array([*work.temperatures, reference])
    fraction = _fraction(float(np.max(np.abs([ends, ends - reference]))), bits)
    words = np.rint(ends * 2.0**fraction).astype(int)
    half = max(math.ceil(math.log2(np.max(np.abs(ends - reference)) + 2.0**-fraction)), 0)
    off = 2.0 ** -(fraction + 1) + abs(float(words[2]) / 2.0**fraction - reference)
    form = WordForm(bits, half, off / 2.0**half)
    triads = _triads(calibration, work, form)
    turn = 2.0 ** -(bits + 3) + 2.0**-31  # of the steps by which vectors are turned
    angles = angle_errors(calibration, [t.error for t in triads], turn, math.pi / 2.0**bits)
    return FixedCalibration(form, work, fraction, words[2], words[0], words[1], triads, angles)


def _triads(calibration: Calibration, work: WorkingRange, form: WordForm) -> tuple[FixedTriad, ...]:
    """All triads in words, of the notation for raw channels whose coefficients are by power of τ."""
    factors = any(triad.model == "factors" for triad in calibration.triads)
    notations = convert(calibration, "factors" if factors else "affine", COURSE)
    convert_triad = _of_factors if factors else _of_polynomial
    return tuple(
        convert_triad(calibration, triad, notations[triad.name].values, work, form)
        for triad in calibration.triads
    )


def _of_polynomial(
    calibration: Calibration,
    triad: TriadCalibration,
    values: Mapping[str, Array],
    work: WorkingRange,
    form: WordForm,
) -> FixedTriad:
    """A triad whose field is M(τ) raw + b(τ)."""
    raw = work.raw[triad.name]
    fraction = _fraction(raw.max(), form.bits)
    gain, offset = np.moveaxis(values["M"], 0, -1), np.moveaxis(values["b"], 0, -1)
    reading = raw, np.full(3, 2.0 ** -(fraction + 1))
    strength = work.strengths[triad.name]
    rest = _mixed(gain, offset, *reading, fraction, strength, form)
    return FixedTriad(triad.name, fraction, fraction, *rest[:3], None, None, rest[3])


def _of_factors(
    calibration: Calibration,
    triad: TriadCalibration,
    values: Mapping[str, Array],
    work: WorkingRange,
    form: WordForm,
) -> FixedTriad:
    """A triad whose field is P (I - m) (raw / SF(τ) - B(τ))."""
    raw = work.raw[triad.name]
    fraction = _fraction(raw.max(), form.bits)
    scale = _words(values["SF"], form)
    least = 2 * values["SF"][:, 0] - scale.size - scale.error
    if (least <= 0).any():
        raise InputError(
            f"the scale factors of the {triad.name} could vanish between the calibrated temperatures. Calibrate "
            "with a lower `order`."
        )
    share, bias_size = raw / least, _words(values["B"], form).size
    middle = _fraction(float((share + bias_size).max()), form.bits)
    bias = _words(values["B"], form, middle)
    off = (2.0 ** -(fraction + 1) + share * scale.error) / least + 2.0 ** -(middle + 1) + bias.error
    profile = getattr(calibration.profile, triad.name)
    gain = (profile.permutation @ (np.eye(3) - values["m"]))[..., None]
    reading = share + bias.size, off
    strength = work.strengths[triad.name]
    rest = _mixed(gain, np.zeros((3, 1)), *reading, middle, strength, form)
    return FixedTriad(triad.name, fraction, middle, *rest[:3], scale, bias, rest[3])


def _mixed(
    gain: Array,
    offset: Array,
    size: Array,
    error: Array,
    fraction: int,
    strength: float,
    form: WordForm,
) -> tuple[int, Words, Words, Array]:
    """Of gain (3, 3, K) · z + offset (3, K): the fraction, the words of both, and the error (3,).

    `size` and `error` (3,) are of z, which has the `fraction`.
    """
    field = _fraction(strength, form.bits)
    reach = _scaled(gain, form).sum(-1) @ size + _scaled(offset, form).sum(-1)
    most = _LARGEST_SUM - math.ceil(math.log2(reach.max())) - fraction
    gains = _words(gain, form, most)
    offsets = _words(offset, form, fraction + gains.fraction)
    total = (gains.size + gains.error) @ error + gains.error @ size + offsets.error
    return field, gains, offsets, total + 2.0 ** -(field + 1)


def _fraction(limit: float, bits: int) -> int:
    """The largest power of two by which values up to a limit still fit a word."""
    return math.floor(math.log2((2 ** (bits - 1) - _SPARE) / limit))


def _scaled(values: Array, form: WordForm) -> Array:
    """Sizes (..., K) of the terms of courses at the ends of the working temperatures."""
    return np.asarray(np.abs(values) * 2.0 ** (form.half * np.arange(values.shape[-1])))


def _words(values: Array, form: WordForm, most: int | None = None) -> Words:
    """Coefficients (..., K) by power of τ as words, all of one fraction, which is at most `most`."""
    terms = _scaled(values, form)
    size, limit = terms.sum(-1), float(terms.sum(-1).max())
    fits = [_fraction(limit, form.bits)] if limit else []
    fraction = min([*fits, *([] if most is None else [most])], default=0)
    half_step = 2.0 ** -(fraction + 1)
    error, reach = np.full(size.shape, half_step), terms[..., -1]
    for term in np.moveaxis(terms, -1, 0)[-2::-1]:
        error = 2 * half_step + error + (reach + error) * form.error
        reach = reach + term
    words = np.rint(np.sign(values) * terms * 2.0**fraction).astype(int)
    return Words(words, fraction, size, error)
