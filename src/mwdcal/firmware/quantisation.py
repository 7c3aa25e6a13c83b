"""A calibration in whole numbers: the power of two of every word, and a bound of what rounding costs.

A word of N bits is a value times a power of two, its `fraction`, rounded. The bound follows each operation of
`sources/mwdcal_fixed.c`: half a step for every rounding, and the error of what comes in times its largest factor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.errors import InputError
from mwdcal.firmware.working_range import WorkingRange, angle_errors, working_range
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.use.notation import COURSE, convert

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
