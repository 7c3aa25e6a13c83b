"""Compiled forms of the few loops that take the time of large batches; NumPy does the rest.

Each does what a few lines of NumPy beside its caller do, without the temporary arrays, and is
tested against them. They need Numba (the extra `fast`) and pay from `ENOUGH` stations on, which
single runs never reach: those never wait for the compiler to load. MWDCAL_NUMPY=1 turns them off.

Measured in `design/kernels.md`.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.sensor.models import Model, Polynomial, Restricted

ENOUGH = 4096
"""Stations in a batch from which a compiled loop repays its loading."""


def available() -> bool:
    """Whether compiled loops can be had, and are wanted."""
    return _installed() and not os.environ.get("MWDCAL_NUMPY")


@cache
def _installed() -> bool:
    return find_spec("numba") is not None


def pays(stations: Array) -> bool:
    """Whether an array with leading axes (B, n) is worth a compiled loop."""
    return stations.shape[0] * stations.shape[1] >= ENOUGH and available()


def gram(residual: Array, blocks: tuple[Array, ...], shared: Array, own: Array) -> Array:
    """[X ρ]ᵀ C⁻¹ [X ρ] (B, u + 1, u + 1), summed over stations, C⁻¹ = I - G (I + GᵀG)⁻¹ Gᵀ.

    Shapes: residual (B, n, m), one or two blocks (B, n, m_t, p_t), shared (B, n, m, s),
    own columns G (B, n, m, a).
    """
    second = blocks[1] if len(blocks) > 1 else blocks[0][:, :, :0, :0]
    width = sum(block.shape[-1] for block in blocks) + shared.shape[-1] + 1
    found = np.zeros((len(residual), width, width))
    _loops().gram(*_plain(residual, blocks[0], second, shared, own), found)
    return found


def remaining(
    residual: Array, blocks: tuple[Array, ...], shared: Array, own: Array, covariance: Array
) -> tuple[Array, Array]:
    """What a fit leaves: C⁻¹ρ (B, n, m), and its covariance C⁻¹ - C⁻¹X V XᵀC⁻¹ (B, n, m, m).

    Shapes as in `gram`; V (B, u, u) is the covariance of X's unknowns.
    """
    second = blocks[1] if len(blocks) > 1 else blocks[0][:, :, :0, :0]
    count = residual.shape[-1]
    left, spread = np.empty_like(residual), np.empty((*residual.shape, count))
    given = _plain(residual, blocks[0], second, shared, own, covariance)
    _loops().remaining(*given, left, spread)
    return left, spread


def responses(
    model: Model, params: Array, raw: Array, temperature: Array, target: Array
) -> tuple[Array, Array, Array]:
    """Inverse slope (B, n, 3, 3), misfit of the reading (B, n, 3), and that by the parameters.

    misfit = slope⁻¹ (field(raw) - target); the derivatives (B, n, 3, p) are slope⁻¹ times the
    model's Jacobian at the predicted reading, raw - misfit.
    """
    if isinstance(model, Restricted):
        back, misfit, whole = responses(model.whole, model.full(params), raw, temperature, target)
        return back, misfit, whole[..., model.kept]
    shape, terms = target.shape[:2], model.basis.order + 1
    back, misfit = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
    by_params = np.empty((*shape, 3, model.size))
    phi = np.broadcast_to(model.basis(temperature), (*shape, terms))
    given = _plain(params, phi, raw, target)
    if isinstance(model, Polynomial):
        ends = [np.broadcast_to(x, (shape[0], 1, 3)) for x in (model.centre, model.scale)]
        ends = _plain(*ends)
        _loops().polynomial(*given, *ends, model.curved, back, misfit, by_params)
    else:
        _loops().factors(*given, back, misfit, by_params)
    return back, misfit, by_params


def turned(
    back: Array, target: Array, attitude: Array, change: Array
) -> tuple[Array, Array, Array]:
    """Derivatives of the misfit by a turn of the station and by the earth's three constants.

    Shapes: inverse slope (B, n, 3, 3), target (B, n, 3), attitude (B, n, 3, 3), earth's vector by
    its constants `change` (B, n, 3, 3); results (B, n, 3, 3) twice, and |back · target| (B, n).
    """
    turn, earth = np.empty_like(back), np.empty_like(back)
    strength = np.empty(target.shape[:2])
    _loops().turned(*_plain(back, target, attitude, change), turn, earth, strength)
    return turn, earth, strength


def _plain(*arrays: AnyArray) -> list[AnyArray]:
    """Arrays in one piece: the loops are compiled for nothing else."""
    return [np.ascontiguousarray(array) for array in arrays]


@cache
def _loops() -> Any:
    from mwdcal.estimation import fit_kernels

    return fit_kernels
