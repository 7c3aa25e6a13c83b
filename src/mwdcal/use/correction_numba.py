"""Vectors, angles and strengths of many rows at once, by the compiled loops of `correction_kernels`.

The same formulas as `sensor.models` and `geometry.observables`, which are the reference: both
agree to 1e-12 (`tests/test_fused.py`; reasons and timings: `design/kernels.md`). Numba is
imported when rows are first computed, never before; MWDCAL_NUMPY=1 turns it off.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from mwdcal.geometry.observables import RESULTS
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.sensor.models import Factors, Model, Polynomial, affine_parts, factor_parts

HIGHEST_POWER = 3
"""Highest order in temperature that the loops know."""
_PIECE_ROWS = 1 << 15


class Numbers(NamedTuple):
    """A triad: field_i = Σ_j gain_ij(τ) z_j + offset_i(τ) + (square_i + cube_i z_i) z_i².

    z_j = (x_j - centre_j) / (radius_j scale_j(τ)). `courses` are powers of τ, four each, of
    nine gains, three offsets and three scales; `shape` are centre, radius, square and cube.
    """

    courses: tuple[tuple[float, ...], ...]
    shape: tuple[float, ...]
    curved: bool


class RowLimits(NamedTuple):
    """Accepted raw values and temperatures, both ends included, and the calibrated range.

    Results of rows beyond the calibrated range are NaN where `blank`.
    """

    raw: tuple[float, float] = (-np.inf, np.inf)
    temperature: tuple[float, float] = (-np.inf, np.inf)
    calibrated: tuple[float, float] = (-np.inf, np.inf)
    blank: bool = False


ANYTHING = RowLimits()


class CorrectedRows(NamedTuple):
    """Results (outputs, n), with counts of cells and rows that need a remark.

    `unsound`: cells out of the accepted ranges or NaN. `beyond`: rows out of the calibrated
    range. `empty`: results that are NaN.
    """

    columns: Array
    unsound: int
    beyond: int
    empty: int


def available() -> bool:
    """Whether compiled loops can be had, and are wanted: Numba, and not MWDCAL_NUMPY=1."""
    return find_spec("numba") is not None and not os.environ.get("MWDCAL_NUMPY")


@cache
def kept_code_is_sound() -> bool:
    """Whether the machine code kept on disk is as it was written; if not, it is compiled again."""
    from mwdcal.use import correction_kernels

    return correction_kernels.check_kept()


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def numbers(model: Model, params: Array) -> Numbers | None:
    """A finished model (powers of T - reference) of parameters (p,); None where its order is too high."""
    if model.basis.order > HIGHEST_POWER:
        return None
    if isinstance(model, Polynomial):
        return _polynomial(model, params)
    return _factors(params) if isinstance(model, Factors) else None


NOTHING = Numbers(((0.0,) * 4,) * 12 + ((1.0, 0.0, 0.0, 0.0),) * 3, (np.nan,) * 12, False)
"""A triad that is not there: all results NaN."""


def _polynomial(model: Polynomial, params: Array) -> Numbers:
    gain, offset = affine_parts(params[: model.affine].reshape(-1, 12))
    curves = params[model.affine :] if model.curved else np.zeros(6)
    shape = np.concatenate([model.centre.ravel(), model.scale.ravel(), curves])
    return Numbers(_courses(gain, offset, np.ones((1, 3))), tuple(shape.tolist()), model.curved)


def _factors(params: Array) -> Numbers:
    scale, bias, misalignment = factor_parts(params)
    mixing = np.eye(3) - misalignment
    courses = _courses(mixing[None], -np.swapaxes(mixing @ bias, 0, 1), np.swapaxes(scale, 0, 1))
    return Numbers(courses, (0.0,) * 3 + (1.0,) * 3 + (0.0,) * 6, False)


def _courses(gain: Array, offset: Array, scale: Array) -> tuple[tuple[float, ...], ...]:
    """Gains (K, 3, 3), offsets and scales (K, 3) by power, each as far as it goes, as tuples of four."""
    padded = np.zeros((HIGHEST_POWER + 1, 15))
    padded[: len(gain), :9] = gain.reshape(-1, 9)
    padded[: len(offset), 9:12] = offset
    padded[: len(scale), 12:] = scale
    return tuple(map(tuple, np.swapaxes(padded, 0, 1).tolist()))


def run(
    columns: Sequence[AnyArray],
    triads: tuple[Numbers, Numbers],
    reference: float,
    units: Sequence[float] = (1.0,) * 6,
    limits: RowLimits = ANYTHING,
    workers: int | None = None,
    out: Array | None = None,
) -> CorrectedRows:
    """All results of `columns`: three of gravity, three of the field, in tool order; temperature.

    Columns are (n,), in `units` (with their sign) per nominal g or nT; the last is °C, and
    `reference` the temperature τ = 0. By default on all cores. `out` (6 or 13, n), which is filled
    where given: with 6 rows the vectors alone.
    """
    from mwdcal.use import correction_kernels

    kept_code_is_sound()
    count = len(columns[-1])
    out = np.empty((len(RESULTS), count)) if out is None else out
    channels = tuple(columns[:3]), tuple(columns[3:6]), columns[6]
    settings = tuple(map(float, units)), limits, reference, triads

    def piece(start: int, stop: int) -> tuple[int, int, int]:
        return correction_kernels.rows(channels, *settings, out, start, stop)

    step = max(_PIECE_ROWS, -(-count // (workers or cores())))
    starts = range(0, max(count, 1), step)
    with ThreadPoolExecutor(len(starts)) as pool:
        counts = list(pool.map(piece, starts, [min(s + step, count) for s in starts]))
    correction_kernels.write_checksums(correction_kernels.compilations())
    return CorrectedRows(out, *np.sum(counts, axis=0).tolist())
