"""The same calibration in another notation, with covariance, at one temperature.

forward   raw = S · field + o          (Moradi 3-4)
affine    field = M · raw + b          (Ivanov)
factors   SF, B, m                     (Moosavi 1-8, in the order of the raw channels)

Raw units, channels in the order of the file; fields in g and nT (or a field of one).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mwdcal.calibration import FREE_SHARE, Calibration, TriadCalibration
from mwdcal.core.models import OFF_DIAGONAL
from mwdcal.core.vectors import AnyArray, Array
from mwdcal.errors import InputError
from mwdcal.profile import TriadProfile

NOTATIONS = ("factors", "forward", "affine")


@dataclass(frozen=True)
class Notation:
    """One triad in one notation: named arrays, their standard uncertainties and covariance.

    `covariance` is of all values in the order of `values`, each row by row. A value that
    moves with a direction which no evidence determines has the uncertainty NaN.
    """

    values: dict[str, Array]
    uncertainty: dict[str, Array]
    covariance: Array


def convert(
    calibration: Calibration, notation: str, temperature: float | None = None
) -> dict[str, Notation]:
    """Each triad of a calibration in a notation, at a temperature (default: the reference).

    Errors: unknown notation; own-axis nonlinearity, which no notation can carry; factors of
    a temperature-dependent polynomial, which are no polynomials themselves.
    """
    if notation not in NOTATIONS:
        raise InputError(f"--notation must be one of {', '.join(NOTATIONS)}; got {notation!r}.")
    at = calibration.reference_temperature if temperature is None else temperature
    return {
        triad.name: _one(_Part.of(calibration, index), notation, at)
        for index, triad in enumerate(calibration.triads)
    }


@dataclass(frozen=True)
class _Part:
    """One triad of a calibration, with its part of the covariance and of the free directions."""

    triad: TriadCalibration
    profile: TriadProfile
    covariance: Array
    free: Array
    strength: float
    reference: float
    half_range: float

    @classmethod
    def of(cls, calibration: Calibration, index: int) -> _Part:
        triads = calibration.triads
        triad, start = triads[index], sum(t.size for t in triads[:index])
        where = slice(start, start + triad.size)
        low, high = calibration.temperature_c or (0.0, 0.0)
        total = sum(t.size for t in triads)
        free = np.array(calibration.free, float).reshape(len(calibration.free), total)
        return cls(
            triad,
            getattr(calibration.profile, triad.name),
            np.array(calibration.covariance)[where, where],
            free[:, where],
            calibration.earth.get("field", 1.0) if index else 1.0,
            calibration.reference_temperature,
            max((high - low) / 2, 1.0),
        )

    def sizes(self, values: dict[str, Array]) -> Array:
        """What each value is compared with to see whether a free direction moves it."""
        gain = np.abs(values["S" if "S" in values else "SF" if "SF" in values else "M"]).max()
        own = {"m": 1.0, "b": self.strength, "B": self.strength, "o": gain * self.strength}
        found = []
        for name, value in values.items():
            powers = np.arange(value.shape[1]) if name in ("SF", "B") else np.zeros(1)
            size = own.get(name, gain) / self.half_range**powers
            found.append(np.broadcast_to(size, value.shape).ravel())
        return np.concatenate(found)


def _one(part: _Part, notation: str, temperature: float) -> Notation:
    triad, profile = part.triad, part.profile
    if triad.curved:
        raise InputError(
            f"the {triad.name} has own-axis quadratic and cubic terms, which the notation "
            f"{notation!r} cannot carry. Calibrate without 'nonlinearity' in the profile, or use "
            "mwdcal apply."
        )
    tau = temperature - part.reference
    scale = np.full(3, 1.0 if profile.scale is None else profile.scale)
    if notation == "factors" and triad.model == "factors":
        return _propagate(lambda p: _own_factors(p, triad.order, profile.permutation, scale), part)
    if notation == "factors" and triad.order:
        raise InputError(
            f"the {triad.name} is a polynomial of order {triad.order} in temperature: its factors "
            "are no polynomials of temperature. Use --notation affine or forward with "
            "--temperature, or calibrate with --model factors."
        )
    permutation = profile.permutation

    def values(params: AnyArray) -> dict[str, AnyArray]:
        matrix, offset = _affine(params, triad, tau)
        matrix = matrix @ permutation / scale
        return _FORMS[notation](matrix, offset, permutation)

    return _propagate(values, part)


def _affine(params: AnyArray, triad: TriadCalibration, tau: float) -> tuple[AnyArray, AnyArray]:
    """Matrix and offset of field = A x + c at a temperature, x in tool axes and nominal units."""
    powers = tau ** np.arange(triad.order + 1)
    if triad.model == "polynomial":
        terms = powers @ params.reshape(triad.order + 1, 12)
        return terms[:9].reshape(3, 3), terms[9:]
    linear = params[: 6 * len(powers)].reshape(2, 3, len(powers)) @ powers
    mixing = np.eye(3, dtype=params.dtype)
    for (i, j), value in zip(OFF_DIAGONAL, params[6 * len(powers) :], strict=True):
        mixing[i, j] = -value
    return mixing / linear[0], -mixing @ linear[1]


def _as_affine(matrix: AnyArray, offset: AnyArray, permutation: Array) -> dict[str, AnyArray]:
    return {"M": matrix, "b": offset}


def _as_forward(matrix: AnyArray, offset: AnyArray, permutation: Array) -> dict[str, AnyArray]:
    inverse = np.linalg.inv(matrix)
    return {"S": inverse, "o": -inverse @ offset}


def _as_factors(matrix: AnyArray, offset: AnyArray, permutation: Array) -> dict[str, AnyArray]:
    channel = permutation.transpose() @ matrix
    scale = 1 / np.diagonal(channel)
    mixing = channel * scale
    bias = -np.linalg.solve(mixing, permutation.transpose() @ offset)
    return {"SF": scale[:, None], "B": bias[:, None], "m": -mixing * (1 - np.eye(3))}


_FORMS: dict[str, Callable[[AnyArray, AnyArray, Array], dict[str, AnyArray]]] = {
    "affine": _as_affine,
    "forward": _as_forward,
    "factors": _as_factors,
}


def _own_factors(
    params: AnyArray, order: int, permutation: Array, scale: Array
) -> dict[str, AnyArray]:
    """Stored factors, tool axes and nominal units, to channels and raw units: exact."""
    count = order + 1
    linear = params[: 6 * count].reshape(2, 3, count)
    mixing = np.zeros((3, 3), dtype=params.dtype)
    for (i, j), value in zip(OFF_DIAGONAL, params[6 * count :], strict=True):
        mixing[i, j] = value
    back = permutation.transpose()
    return {
        "SF": np.abs(back) @ linear[0] * scale[:, None],
        "B": back @ linear[1],
        "m": back @ mixing @ permutation,
    }


def _propagate(values: Callable[[AnyArray], dict[str, AnyArray]], part: _Part) -> Notation:
    """Values and covariance; derivatives by complex step, exact to rounding."""
    params = np.array(part.triad.parameters)
    found = {name: np.asarray(value.real) for name, value in values(params).items()}
    columns = []
    for index in range(len(params)):
        step = np.zeros(len(params), complex)
        size = max(abs(params[index]), 1.0) * 1e-30
        step[index] = 1j * size
        columns.append(
            np.concatenate([v.imag.ravel() / size for v in values(params + step).values()])
        )
    jacobian = np.stack(columns, -1)
    spread = jacobian @ part.covariance @ jacobian.transpose()
    moved = np.abs(jacobian @ part.free.transpose()).max(-1, initial=0.0)
    loose = moved > FREE_SHARE * part.sizes(found)
    sd = np.where(loose, np.nan, np.sqrt(np.maximum(np.diag(spread), 0.0)))
    ends = np.cumsum([value.size for value in found.values()])[:-1]
    parts = zip(found.items(), np.split(sd, ends), strict=True)
    uncertainty = {name: part.reshape(value.shape) for (name, value), part in parts}
    return Notation(found, uncertainty, spread)
