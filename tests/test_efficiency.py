"""Errors against the Cramér-Rao bound and coverage of the stated intervals, many seeds at once."""

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.geometry.observables import OBSERVABLES
from simulation import DEG, Tool, bound, plan

SEEDS = 400
CASES = {
    "whole": ((5, 45, 90, 135), ()),
    "vertical": ((0, 45, 90, 180), ()),
    "toolface unknown": ((5, 45, 90, 135), ("toolface",)),
    "toolface unknown, vertical": ((0, 45, 90, 180), ("toolface",)),
    "dip unknown": ((5, 45, 90, 135), ("dip",)),
    "dip unknown, vertical": ((0, 45, 90, 180), ("dip",)),
    "azimuth unknown": ((5, 45, 90, 135), ("azimuth",)),
}
OTHER = [
    np.array(x) * DEG
    for x in ([20.0, 33, 70, 110, 150], [10.0, 100, 200, 250, 333], [15.0, 75, 160, 222, 301])
]


def simulated(case, method="joint"):
    inclinations, unknown = CASES[case]
    tool = Tool.random(7)
    inc, azi, face = plan(inclinations)
    a, m = tool.readings(np.random.default_rng(11), SEEDS, inc, azi, face)
    known = {
        "inclination": inc,
        "azimuth": azi,
        "toolface": face,
        "dip": np.full(len(inc), tool.dip),
    }
    known = {k: v for k, v in known.items() if k not in unknown}
    known["field"] = np.full(len(inc), tool.field)
    sd = {"accelerometer": np.array(tool.noise[0]), "magnetometer": np.array(tool.noise[1])}
    readings = Readings(a, m, known=known, sd=sd)
    return tool, bound(tool, inc, azi, face, unknown), fit(readings, Options(method))


def affine(result):
    """Finished parameters (B, 24) of both triads and their covariance, in affine notation."""
    params, maps = [], []
    for triad, where in zip(result.problem.triads, result.problem.slices(), strict=True):
        _, whole = triad.model.finished(0.0)
        params.append(np.einsum("bij,bj->bi", whole, result.state.params[:, where]))
        maps.append(whole)
    joined = np.zeros((len(params[0]), 24, 24))
    joined[:, :12, :12], joined[:, 12:, 12:] = maps
    covariance = joined @ result.analysis.covariance @ np.swapaxes(joined, -1, -2)
    return np.concatenate(params, -1), covariance


def sensitivity(tool, name):
    """Gradient of an observable at other attitudes by affine parameters, and by S, o."""
    clean = tool.clean(*OTHER)
    from simulation import attitude

    pair = attitude(*OTHER)(tool.gravity, tool.field, tool.dip)
    gradient = OBSERVABLES[name].gradient(*pair)
    count = len(clean[0])
    by_affine, by_forward = np.zeros((count, 24)), np.zeros((count, 24))
    for t in (0, 1):
        part = gradient[:, 3 * t : 3 * t + 3]
        by_affine[:, 12 * t : 12 * t + 9] = np.einsum("ni,nj->nij", part, clean[t]).reshape(
            count, 9
        )
        by_affine[:, 12 * t + 9 : 12 * t + 12] = part
        back = -part @ np.linalg.inv(tool.matrix[t])
        by_forward[:, 9 * t : 9 * t + 9] = np.einsum("ni,nj->nij", back, pair[t]).reshape(count, 9)
        by_forward[:, 18 + 3 * t : 21 + 3 * t] = back
    return by_affine, by_forward


SLOW = pytest.mark.slow
METHODS = [
    pytest.param(case, "joint", marks=SLOW if case == "toolface unknown" else ()) for case in CASES
] + [
    (case, "least-squares")
    for case in ("whole", "vertical", "dip unknown", "dip unknown, vertical")
]


@pytest.mark.parametrize(("case", "method"), METHODS)
def test_errors_meet_the_bound_and_intervals_cover(case, method):
    tool, limit, result = simulated(case, method)
    assert (result.status == 0).all()
    params, covariance = affine(result)
    truth = [np.linalg.inv(m) for m in tool.matrix]
    offsets = [-k @ o for k, o in zip(truth, tool.offset, strict=True)]
    true = np.concatenate(
        [np.concatenate([k.ravel(), o]) for k, o in zip(truth, offsets, strict=True)]
    )
    names = ["gravity", "inclination", "azimuth", "field", "dip"]
    if "toolface" not in CASES[case][1]:
        names.append("toolface")
    ratios, covered = [], []
    for name in names:
        by_affine, by_forward = sensitivity(tool, name)
        error = (params - true) @ by_affine.T
        allowed = np.sqrt(np.einsum("ni,ij,nj->n", by_forward, limit, by_forward))
        ratios.append(np.sqrt(np.mean((error / allowed) ** 2)))
        stated = np.sqrt(np.einsum("ni,bij,nj->bn", by_affine, covariance, by_affine))
        covered.append(np.mean(np.abs(error) < 1.96 * stated))
    print(case, method, np.round(ratios, 3), np.round(covered, 3))
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.03)
    assert 0.93 < np.mean(covered) < 0.97
