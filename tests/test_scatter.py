"""Scatter from shot to shot beside the noise: against simulated instruments held by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.automatic.auto import scattered
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.geometry.observables import OBSERVABLES
from simulation import attitude

DIP = 1.17
GROUP = np.array([-1] * 8 + [0] * 8 + [1] * 8)


def hand_held(rng, count, direction, strength):
    """Runs of 8 shots anywhere and two groups of 8 rolls, each shot off by `direction`; what reads them."""
    inc = np.arccos(rng.uniform(-1, 1, (count, 24)))
    azi, roll = rng.uniform(0, 2 * np.pi, (2, count, 24))
    for group in (0, 1):
        some = group == GROUP
        inc[:, some] = rng.uniform(0.7, 1.4, (count, 1)) + direction * rng.normal(size=(count, 8))
        azi[:, some] = rng.uniform(0, 6, (count, 1)) + direction * rng.normal(size=(count, 8))
        roll[:, some] = np.arange(8) * np.pi / 4
    vectors = attitude(inc, azi, roll)(1.0, 1 + strength * rng.normal(size=(count, 24, 1)), DIP)
    gains = np.eye(3) + 0.02 * rng.normal(size=(2, count, 3, 3))
    offsets = 0.01 * rng.normal(size=(2, count, 1, 3))
    a, b = (
        v @ gain.mT + offset + noise * rng.normal(size=v.shape)
        for v, gain, offset, noise in zip(vectors, gains, offsets, (3e-4, 1e-3), strict=True)
    )
    known = {"gravity": np.ones(24), "field": np.ones(24)}
    return Readings(a, b, known=known, group=GROUP), gains, offsets


def inclinations(result, gains, offsets):
    """Errors of inclination of noise-free readings at 40 attitudes, and their stated 1σ."""
    rng = np.random.default_rng(1)
    inc, (azi, roll) = np.arccos(rng.uniform(-0.95, 0.95, 40)), rng.uniform(0, 6, (2, 40))
    vectors = attitude(inc, azi, roll)(1.0, 1.0, DIP)
    raw = vectors[0] @ gains[0].mT + offsets[0]
    model, where = result.problem.triads[0].model, result.problem.slices()[0]
    params, cold = result.state.params[:, where], np.zeros(raw.shape[:2])
    g = model.fields(params, raw, cold)
    observable = OBSERVABLES["inclination"]
    gradient = observable.gradient(g, np.broadcast_to(vectors[1], g.shape))[..., :3]
    rows = np.einsum("bni,bnip->bnp", gradient, model.jacobian(params, raw, cold))
    covariance = result.analysis.covariance[:, where, where]
    error = observable.difference(observable.value(g, g), np.broadcast_to(inc, cold.shape))
    return error, np.sqrt(np.einsum("bnp,bpq,bnq->bn", rows, covariance, rows))


@pytest.mark.parametrize("count", [60, pytest.param(400, marks=pytest.mark.study)])
def test_estimated_scatter_makes_directions_better_and_their_uncertainty_true(count):
    readings, gains, offsets = hand_held(np.random.default_rng(3), count, 2e-3, 3e-3)
    estimated = scattered(readings, Options())
    assert estimated.scatter
    error, sd = inclinations(fit(readings, estimated), gains, offsets)
    plain, loose = inclinations(fit(readings, replace(estimated, scatter=False)), gains, offsets)
    assert np.median(np.abs(error)) < 0.9 * np.median(np.abs(plain))
    # the 1σ of 24 shots is itself known to a tenth, and 60 runs to another
    assert 0.88 < np.mean(np.abs(error) < 1.96 * sd) < 0.98
    assert np.median(loose) > 1.3 * np.median(sd)


def test_few_shots_have_no_scatter_estimated():
    """Of eight shots a scatter cannot be told from the noise; nor without groups."""
    batch, _, _ = hand_held(np.random.default_rng(0), 1, 0.0, 0.0)
    readings = replace(
        batch, accelerometer=batch.accelerometer[0], magnetometer=batch.magnetometer[0]
    )
    assert not scattered(readings.select(np.arange(24) % 3 == 0), Options()).scatter
    assert not scattered(replace(readings, group=np.full(24, -1)), Options()).scatter
    declared = replace(readings, sd={"accelerometer": np.full(3, 3e-4)})
    assert not scattered(declared, Options()).scatter
