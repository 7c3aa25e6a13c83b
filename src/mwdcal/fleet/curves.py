"""Typical accuracy of tools with own-axis terms, whose fields are no affine function of the reading.

Attitude by attitude, as `predict.typical_accuracy` has it for one calibration; `fleet_accuracy`
is the quick way where there are no such terms.
"""

from __future__ import annotations

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.prediction import ANGLES, TOOLFACES, TYPICAL
from mwdcal.calibration.record import FREE_SHARE
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.sensor.models import Model

STEPS = 8
"""Newton steps from the field to the reading."""


def curved_sd(result: Fit, covariance: Array, free: Array, reference: float) -> dict[str, Array]:
    """1σ (B,) of the calibration by angle at 45° inclination, degrees, as `…_sd_deg`.

    Root mean square over azimuth and toolface. `covariance` (B, p, p) of the fit's parameters,
    `free` directions (B, k, p). NaN where an angle rests on a free direction.
    """
    problem, state = result.problem, result.state
    earth = [
        problem.constant(state, name).mean(-1)[:, None] for name in ("gravity", "field", "dip")
    ]
    azimuth, toolface = np.meshgrid(np.arange(12) * np.pi / 6, TOOLFACES)
    vectors = reference_vectors(TYPICAL, azimuth.reshape(1, -1), toolface.reshape(1, -1), *earth)
    temperature = np.clip(reference, problem.temperature.min(-1), problem.temperature.max(-1))
    warmth = np.repeat(temperature[:, None], azimuth.size, axis=1)
    changes = [
        _change(triad.model, state.params[:, where], target, warmth)
        for triad, where, target in zip(problem.triads, problem.slices(), vectors, strict=False)
    ]
    found = {}
    for name in ANGLES[: 1 + len(changes)]:
        gradient = OBSERVABLES[name].gradient(*vectors)
        rows = np.concatenate(
            [np.einsum("bai,baip->bap", gradient[..., 3 * t : 3 * t + 3], change)
             for t, change in enumerate(changes)], -1
        )  # fmt: skip
        variance = np.einsum("bap,bpq,baq->b", rows, covariance, rows, optimize=True)
        sd = np.degrees(np.sqrt(variance / azimuth.size))
        turned = np.abs(np.einsum("bap,bkp->bak", rows, free)).max((-1, -2), initial=0.0)
        found[f"{name}_sd_deg"] = np.where(turned > FREE_SHARE, np.nan, sd)
    return found


def _change(model: Model, params: Array, target: Array, temperature: Array) -> Array:
    """Change (B, a, 3, p) of the field by the parameters, where the model gives `target`."""
    raw = target
    for _ in range(STEPS):
        error = model.fields(params, raw, temperature) - target
        slope = model.slope(params, raw, temperature)
        raw = raw - np.linalg.solve(slope, error[..., None])[..., 0]
    return model.jacobian(params, raw, temperature)
