"""Ivanov & Lyutskanova-Zhekova (2019): the printed appendix, and calibration on angles alone."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.uncertainty import free_directions
from mwdcal.geometry.observables import OBSERVABLES
from simulation import DEG, Tool, attitude, plan

SOURCE = Path(__file__).parents[1] / "examples" / "papers" / "ivanov.py"
SPEC = importlib.util.spec_from_file_location("ivanov_example", SOURCE)
ivanov = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = ivanov
SPEC.loader.exec_module(ivanov)

NAMES = [f"p{i + 1}" for i in range(12)]
MOVED_ACROSS = (0, 1, 2, 3, 4, 5, 9, 10)  # p1..p6, p10, p11
MOVED_ALONG = (6, 7, 8, 11)
SEEDS = 400


# ── The appendix ─────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module", params=[1, 2, 3])
def readings_all_round(request):
    p, raw = ivanov.random_readings(3000, request.param)
    inclined = ivanov.angles(p, raw)[:, 1]
    clear = (np.abs(inclined - np.pi / 2) > 1e-2) & (inclined > 1e-2) & (inclined < np.pi - 1e-2)
    raw, inclined = raw[clear], inclined[clear]
    return p, raw, inclined, ivanov.complex_step(p, raw)


def agree(found, true, tolerance=1e-9):
    np.testing.assert_allclose(found, true, rtol=tolerance, atol=tolerance)


def test_complex_step_is_right_about_itself(readings_all_round):
    p, raw, _, true = readings_all_round
    steps = 1e-6 * np.eye(12)
    two_sided = [(ivanov.angles(p + h, raw) - ivanov.angles(p - h, raw)) / 2e-6 for h in steps]
    two_sided = np.angle(np.exp(1j * np.stack(two_sided, -1) * 1e-6)) / 1e-6
    size = 1 + np.abs(true).max(-1, keepdims=True)
    np.testing.assert_array_less(np.abs(two_sided - true) / size**3, 1e-7)


def test_corrected_derivatives(readings_all_round):
    p, raw, _, true = readings_all_round
    agree(ivanov.corrected(p, raw), true)


@pytest.mark.parametrize("index", range(12), ids=NAMES)
def test_printed_toolface_derivative_is_right(readings_all_round, index):
    p, raw, _, true = readings_all_round
    agree(ivanov.printed_toolface(p, raw)[:, index], true[:, 0, index])


@pytest.mark.parametrize("index", MOVED_ACROSS, ids=[NAMES[i] for i in MOVED_ACROSS])
def test_printed_toolface_derivative_with_the_redefined_names_is_wrong(readings_all_round, index):
    p, raw, _, true = readings_all_round
    wrong = ivanov.printed_toolface(p, raw, redefined=True)[:, index]
    assert np.median(np.abs(wrong / true[:, 0, index] - 1)) > 0.3


@pytest.mark.parametrize("index", range(12), ids=NAMES)
def test_printed_inclination_derivative_up_to_60(readings_all_round, index):
    p, raw, _, true = readings_all_round
    below = ~ivanov.is_above(raw)
    sign = -1 if index in MOVED_ACROSS else 1
    agree(ivanov.printed_otherwise(p, raw)[below, index], sign * true[below, 1, index])


@pytest.mark.parametrize("index", range(12), ids=NAMES)
def test_printed_inclination_derivative_above_60_is_of_the_complement(readings_all_round, index):
    p, raw, inclined, true = readings_all_round
    above = ivanov.is_above(raw)
    sign = np.where(inclined < np.pi / 2, -1, 1)[above]
    agree(ivanov.printed_above(p, raw)[above, index], sign * true[above, 1, index])


def test_a_common_factor_changes_no_angle(readings_all_round):
    """J p = 0 for any p: a check of a Jacobian that needs no derivative. The printed one fails."""
    p, raw, _, _ = readings_all_round
    np.testing.assert_allclose(ivanov.corrected(p, raw) @ p, 0, atol=1e-13)
    below = ~ivanov.is_above(raw)
    assert np.median(np.abs(ivanov.printed(p, raw)[below, 1] @ p)) > 0.1


def test_printed_formulas_have_their_poles_inside_their_ranges():
    closest = ivanov.poles()
    assert closest[0][1] < 1e-11
    assert closest[0][2] < 1e-11
    assert closest[2][1] > 1e-6
    assert closest[2][2] > 1e-6
    assert not np.isfinite(closest[3][1:]).any()


# ── The paper's Gauss-Newton and ours ────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def instruments():
    return ivanov.Instruments.mems(60, 8), ivanov.Stations.grid((5, 45, 90, 135), 12)


def test_without_noise_both_programs_agree_and_find_the_truth(instruments):
    tools, stations = instruments
    data = ivanov.simulated(ivanov.Case("", noise=0.0), stations, tools, 1)
    data = Readings(
        data.accelerometer, known=data.known, sd={"accelerometer": np.array(ivanov.NOISE)}
    )
    ours, theirs = ivanov.ours("toolface-inclination")(data), ivanov.paper_method(data)
    assert ivanov.apart(tools, ours, theirs) < 1e-12
    assert np.sqrt(ivanov.errors(tools, theirs).direction.max()) < 1e-12


@pytest.mark.parametrize(("noise", "share"), [(5e-4, 0.02), (1e-5, 4e-4)])
def test_with_noise_both_programs_agree_in_angles(instruments, noise, share):
    """Equal but for terms of second order in the noise, when the angles are weighted by it."""
    tools, stations = instruments
    data = ivanov.simulated(ivanov.Case("", noise=noise), stations, tools, 2)
    ours = ivanov.ours("toolface-inclination")(data)
    theirs = ivanov.paper_method(data, weighted=True)
    size = np.sqrt(ivanov.errors(tools, ours).direction.mean())
    assert ivanov.apart(tools, ours, theirs) < share * size


def test_printed_derivatives_do_not_converge(instruments):
    tools, stations = instruments
    data = ivanov.simulated(ivanov.Case(""), stations, tools, 3)
    right = ivanov.gauss_newton(*ivanov.in_paper_axes(data))
    assert right.converged.all()
    assert right.iterations.max() <= 8
    with np.errstate(all="ignore"):
        wrong = ivanov.gauss_newton(*ivanov.in_paper_axes(data), jacobian=ivanov.printed)
    assert wrong.converged.mean() < 0.1


# ── Rank ─────────────────────────────────────────────────────────────────────────────────────


def stations_of(tool, count=1, seed=0, lowest=5):
    inc, azi, face = plan((lowest, 45, 90, 135))
    a, m = tool.readings(np.random.default_rng(seed), count, inc, azi, face)
    sd = {"accelerometer": np.array(tool.noise[0]), "magnetometer": np.array(tool.noise[1])}
    return (inc, azi, face), a, m, sd


def free(result):
    found = free_directions(result.problem, result.state, result.analysis.determined)[0]
    return sorted((f.id, f.triads) for f in found)


@pytest.mark.parametrize("kind", ["polynomial", "factors"])
@pytest.mark.parametrize("lowest", [0, 0.5, 5])
def test_angles_alone_leave_the_scale_free(lowest, kind):
    (inc, _, face), a, _, sd = stations_of(Tool.random(21), lowest=lowest)
    del sd["magnetometer"]
    result = fit(Readings(a, known={"inclination": inc, "toolface": face}, sd=sd),
                 Options("toolface-inclination", kind))  # fmt: skip
    assert result.status[0] == 0
    assert result.analysis.determined.rank[0] == 11
    assert free(result) == [("scale", (0,))]


def test_strengths_alone_leave_three_rotations_of_each_triad_free():
    tool = Tool.random(22)
    (inc, _, face), a, m, sd = stations_of(tool)
    known = {"inclination": inc, "toolface": face, "field": np.full(len(inc), tool.field)}
    result = fit(Readings(a, m, known=known, sd=sd), Options("scalar"))
    assert result.status[0] == 0
    assert result.analysis.determined.rank[0] == 9 + 9
    names = ("rotation-x", "rotation-y", "toolface-zero")
    assert free(result) == sorted((name, (triad,)) for name in names for triad in (0, 1))


def test_rank_at_order_three():
    assert ivanov.ranks() == [
        ("least-squares", 12, 30, 30),
        ("toolface-inclination", 11, 26, 26),
        ("scalar", 9, 27, 27),
    ]


# ── Errors against the bound ─────────────────────────────────────────────────────────────────


def forward(x, inc, face, count):
    """Whitened readings of S (9), o (3) and each station's own |g| (count)."""
    matrix, offset, strength = x[:9].reshape(3, 3), x[9:12], x[12 : 12 + count]
    g, _ = attitude(inc, 0 * inc, face)(strength[:, None], 1.0, 0.0)
    return (g @ matrix.T + offset).ravel()


def angle_bound(tool, inc, face):
    """Cramér-Rao covariance (12, 12) of S, o where only toolface and inclination are known."""
    count = len(inc)
    x = np.concatenate([tool.matrix[0].ravel(), tool.offset[0], np.ones(count)]).astype(complex)
    columns = [forward(x + 1e-30j * step, inc, face, count).imag / 1e-30 for step in np.eye(len(x))]
    jacobian = np.stack(columns, -1) / tool.noise[0]
    scale = np.linalg.norm(jacobian, axis=0)
    _, values, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    assert values[-1] < 1e-12 * values[0] < 1e-3 * values[-2]  # the scale alone is free
    kept = vt[:-1] / scale / values[:-1, None]
    return (kept.T @ kept)[:12, :12]


def affine(result):
    """Finished gains and offsets (B, 12) and their covariance (B, 12, 12)."""
    _, whole = result.problem.triads[0].model.finished(0.0)
    params = np.einsum("bij,bj->bi", whole, result.state.params)
    return params, whole @ result.analysis.covariance @ np.swapaxes(whole, -1, -2)


OTHER = np.array([[20, 15], [33, 75], [70, 160], [110, 222], [150, 301]]).T * DEG


@pytest.mark.parametrize("lowest", [0, 5])
def test_errors_in_angles_meet_the_bound_and_intervals_cover(lowest):
    """Inclination and toolface at other attitudes, |g| disturbed at every station."""
    tool = Tool.random(7)
    inc, azi, face = plan((lowest, 45, 90, 135))
    rng = np.random.default_rng(31)
    strength = 1 + 5e-3 * rng.normal(size=(SEEDS, len(inc), 1))
    g, _ = attitude(inc, azi, face)(1.0, 1.0, 0.0)
    a = strength * g @ tool.matrix[0].T + tool.offset[0]
    a = a + tool.noise[0] * rng.normal(size=a.shape)
    sd = {"accelerometer": np.array(tool.noise[0])}
    known = {"inclination": inc, "toolface": face}
    result = fit(Readings(a, known=known, sd=sd), Options("toolface-inclination"))
    assert (result.status == 0).all()

    params, covariance = affine(result)
    true, _ = attitude(OTHER[0], 0 * OTHER[0], OTHER[1])(1.0, 1.0, 0.0)
    raw = true @ tool.matrix[0].T + tool.offset[0]
    limit = angle_bound(tool, inc, face)
    back = np.linalg.inv(tool.matrix[0])
    found = np.einsum("bij,nj->bni", params[:, :9].reshape(-1, 3, 3), raw) + params[:, None, 9:]
    ratios, covered = [], []
    for name in ("inclination", "toolface"):
        observable = OBSERVABLES[name]
        error = observable.value(found, found) - observable.value(true, true)
        error = np.angle(np.exp(1j * error))
        gradient = observable.gradient(true, true)[:, :3]
        by_affine = np.concatenate(
            [(gradient[:, :, None] * raw[:, None, :]).reshape(-1, 9), gradient], -1
        )
        carried = -gradient @ back
        by_forward = np.concatenate(
            [(carried[:, :, None] * true[:, None, :]).reshape(-1, 9), carried], -1
        )
        allowed = np.sqrt(np.einsum("ni,ij,nj->n", by_forward, limit, by_forward))
        ratios.append(np.sqrt(np.mean((error / allowed) ** 2)))
        stated = np.sqrt(np.einsum("ni,bij,nj->bn", by_affine, covariance, by_affine))
        covered.append(np.mean(np.abs(error) < 1.96 * stated))
    print(lowest, np.round(ratios, 4), np.round(covered, 4))
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.03)
    assert 0.93 < np.mean(covered) < 0.97


# ── Against the classical methods ────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("case", "least", "most"),
    [
        (ivanov.Case("noise"), 1.1, 1.3),
        (ivanov.Case("disturbed", gravity=5e-3), 0.2, 0.27),
        (ivanov.Case("supply", gain=5e-3), 0.2, 0.28),
        (ivanov.Case("g unknown", gravity_error=5e-3), 1.1, 1.3),
        (ivanov.Case("inclination offset", inclination=0.1 * DEG), 1.7, 1.85),
        (ivanov.Case("tilt", tilt=0.1 * DEG), 0.98, 1.02),
    ],
    ids=lambda value: value.title if isinstance(value, ivanov.Case) else "",
)
def test_where_angles_alone_win_and_where_not(instruments, case, least, most):
    """Ratio of angular errors to those of least squares, as docs/evidence/papers/ivanov.md states them."""
    tools, stations = instruments
    data = ivanov.simulated(case, stations, tools, 4)
    found = [
        ivanov.errors(tools, ivanov.ours(method)(data)).direction
        for method in ("toolface-inclination", "least-squares")
    ]
    assert least < ivanov.Ratio.of(*found).value < most
