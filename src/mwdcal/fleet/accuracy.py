"""Typical accuracy of a whole batch: what `predict.typical_accuracy` says, for every member.

At one temperature every model is affine in the reading, so the change of the fields by the
parameters is affine in the field itself. It is known everywhere from four fields: none, and
the strength along each axis. The mean variance over attitudes is then one weighted sum.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.prediction import ANGLES, TOOLFACES, TYPICAL
from mwdcal.calibration.record import FREE_SHARE
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.sensor.models import Model

MIXED = np.array([[1.0, -1.0, -1.0, -1.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Shares of the four fields in the field of unit components (1, x, y, z)."""


def typical_sd(result: Fit, covariance: Array, free: Array, reference: float) -> dict[str, Array]:
    """1σ (B,) of the calibration by angle at 45° inclination, degrees, as `…_sd_deg`.

    Root mean square over azimuth and toolface; `covariance` (B, p, p) of the fit's parameters,
    `free` directions (B, k, p). NaN where an angle rests on a free direction.
    """
    problem, state = result.problem, result.state
    earth = [problem.constant(state, name).mean(-1) for name in ("gravity", "field", "dip")]
    temperature = np.clip(reference, problem.temperature.min(-1), problem.temperature.max(-1))
    blocks = []
    for triad, where, strength in zip(problem.triads, problem.slices(), earth[:2], strict=False):
        blocks.append(_at_four(triad.model, state.params[:, where], temperature, strength))
    change = _diagonal(blocks)
    spread = change @ covariance @ np.swapaxes(change, -1, -2)
    moved = np.einsum("bip,bkp->bki", change, free)
    both = np.stack(earth, -1)
    unlike, number = np.unique(both, axis=0, return_inverse=True)
    found = {}
    for name, rows in _rows(ANGLES[: 1 + len(blocks)], unlike, len(blocks)).items():
        weights = np.swapaxes(rows, -1, -2) @ rows / rows.shape[1]
        variance = np.einsum("bij,bij->b", weights[number], spread)
        sd = np.degrees(np.sqrt(np.maximum(variance, 0.0)))
        if free.size:
            turned = np.abs(np.einsum("bai,bki->bak", rows[number], moved)).max((-1, -2))
            sd = np.where(turned > FREE_SHARE, np.nan, sd)
        found[f"{name}_sd_deg"] = sd
    return found


def _at_four(model: Model, params: Array, temperature: Array, strength: Array) -> Array:
    """Change (B, 12, p) of the field by the parameters, at no field and at one along each axis."""
    warmth = np.repeat(temperature[:, None], 4, axis=1)
    still = np.zeros((len(params), 4, 3))
    target = still.copy()
    target[:, 1:] = strength[:, None, None] * np.eye(3)
    slope = model.slope(params, still, warmth)
    error = target - model.fields(params, still, warmth)
    reading = np.asarray(np.linalg.solve(slope, error[..., None])[..., 0], float)
    return model.jacobian(params, reading, warmth).reshape(len(params), 12, -1)


def _diagonal(blocks: list[Array]) -> Array:
    """Block-diagonal matrices (B, rows, columns)."""
    rows, columns = (sum(b.shape[axis] for b in blocks) for axis in (-2, -1))
    whole = np.zeros((len(blocks[0]), rows, columns))
    row = start = 0
    for block in blocks:
        whole[:, row : row + block.shape[-2], start : start + block.shape[-1]] = block
        row, start = row + block.shape[-2], start + block.shape[-1]
    return whole


def _rows(names: Sequence[str], earth: Array, triads: int) -> dict[str, Array]:
    """Change of angles (E, attitudes, 12 or 24) by the fields at the four of each triad."""
    azimuth, toolface = np.meshgrid(np.arange(12) * np.pi / 6, TOOLFACES, indexing="ij")
    gravity, field, dip = (earth[:, i, None] for i in range(3))
    angles = (np.broadcast_to(TYPICAL, (1, azimuth.size)), azimuth.reshape(1, -1))
    vectors = reference_vectors(*angles, toolface.reshape(1, -1), gravity, field, dip)
    shares = []
    for vector, strength in zip(vectors[:triads], (gravity, field), strict=False):
        unit = vector / strength[..., None]
        shares.append(np.concatenate([np.ones_like(unit[..., :1]), unit], -1) @ MIXED.transpose())
    share, found = np.stack(shares, -2)[..., None], {}
    for name in names:
        gradient = OBSERVABLES[name].gradient(*vectors)[..., : 3 * triads]
        slope = gradient.reshape(*gradient.shape[:-1], triads, 1, 3)
        found[name] = (share * slope).reshape(*gradient.shape[:-1], 12 * triads)
    return found


__all__ = ["ANGLES", "typical_sd"]
