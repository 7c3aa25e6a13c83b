"""The coefficients of a calibration as C initialisers: as the file has them, and in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.firmware.c_text import initialiser
from mwdcal.firmware.quantisation import FixedCalibration, FixedTriad
from mwdcal.geometry.vectors import AnyArray
from mwdcal.sensor.models import affine_parts, factor_parts
from mwdcal.sensor.profile import TriadProfile


def order(calibration: Calibration) -> int:
    """The highest order of a triad, which the arrays of all have."""
    return max(triad.order for triad in calibration.triads)


def double_initialiser(calibration: Calibration) -> str:
    """All triads as `mwdcal_double_triad`: the numbers of the calibration file."""
    return _listed(
        (
            triad.name,
            _wiring(getattr(calibration.profile, triad.name)) | _courses(triad, order(calibration)),
        )
        for triad in calibration.triads
    )


def _wiring(profile: TriadProfile) -> dict[str, AnyArray]:
    """The channel of each tool axis, and its raw units per g or nT with their sign."""
    signed = profile.permutation
    return {
        "channel": np.argmax(np.abs(signed), -1),
        "unit": signed.sum(-1) * (profile.scale or 1.0),
    }


def _courses(triad: TriadCalibration, highest: int) -> dict[str, AnyArray]:
    """The fields of a triad from `centre` on; those that its model lacks change nothing."""
    params = np.array(triad.parameters)
    scale, bias, offset = np.ones((3, 1)), np.zeros((3, 1)), np.zeros((3, 1))
    gain, curves = np.eye(3)[..., None], np.zeros((2, 3))
    if triad.model == "factors":
        scale, bias, misalignment = factor_parts(params)
        gain = (np.eye(3) - misalignment)[..., None]
    else:
        affine = 12 * (triad.order + 1)
        matrix, constant = affine_parts(params[:affine].reshape(-1, 12))
        gain, offset = np.moveaxis(matrix, 0, -1), constant.transpose()
        curves = params[affine:].reshape(2, 3) if triad.curved else curves
    courses = {"scale": scale, "bias": bias, "gain": gain, "offset": offset}
    return {
        **{"centre": np.array(triad.centre), "radius": np.array(triad.radius)},
        **{name: _padded(values, highest) for name, values in courses.items()},
        **{"square": curves[0], "cube": curves[1]},
    }


def fixed_initialiser(fixed: FixedCalibration, highest: int) -> str:
    """All triads as `mwdcal_fixed_triad`."""
    return _listed((triad.name, _words(triad, highest) | _shifts(triad)) for triad in fixed.triads)


def _words(triad: FixedTriad, highest: int) -> dict[str, AnyArray]:
    nothing = np.zeros((3, 1), int)
    courses = {"scale": triad.scale, "bias": triad.bias, "gain": triad.gain, "offset": triad.offset}
    return {
        name: _padded(course.words if course else nothing, highest)
        for name, course in courses.items()
    }


def _shifts(triad: FixedTriad) -> dict[str, AnyArray]:
    """Powers of two between the words of a triad."""
    total = triad.middle + triad.gain.fraction
    shifts = {
        "factors": int(triad.scale is not None),
        "quotient": triad.middle + triad.scale.fraction - triad.raw if triad.scale else 0,
        "lift": total - triad.offset.fraction,
        "sum": total - triad.field,
    }
    return {name: np.array(value) for name, value in shifts.items()}


def _padded(values: AnyArray, highest: int) -> AnyArray:
    """Coefficients (..., K) by power, with zeros up to the highest."""
    spare = highest + 1 - values.shape[-1]
    return np.concatenate([values, np.zeros((*values.shape[:-1], spare), values.dtype)], -1)


def _listed(triads: Iterable[tuple[str, Mapping[str, AnyArray]]]) -> str:
    """Initialisers of triads, a field with its name on each line."""
    blocks = []
    for name, fields in triads:
        lines = [f"        /* {field} */ {_rows(value)},\n" for field, value in fields.items()]
        blocks.append(f"    /* {name} */\n    {{\n{''.join(lines)}    }},\n")
    return "{\n" + "".join(blocks) + "}"


def _rows(value: AnyArray) -> str:
    """An initialiser; of a matrix of courses with a row on each line."""
    if len(value.shape) < 3:
        return initialiser(value)
    return "{\n" + "".join(f"            {initialiser(row)},\n" for row in value) + "        }"
