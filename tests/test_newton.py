"""Newton-Raphson of Moosavi: exact derivatives, few iterations, no drift, the minimum of others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import newton as core
from mwdcal.estimation.minimisers.newton import newton, propagated
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import CHANGES, COUPLED, free_share, tangent
from mwdcal.geometry.vectors import rotation
from mwdcal.planning.plans import grid, reading, servo
from mwdcal.sensor.models import Basis, Factors, Polynomial

LEADS = [(), (1,), (3, 2)]
COLD, HOT = [25.0], [25.0, 36.0, 47.0, 58.0, 69.0, 80.0]
TWELVE, THIRTY = Factors(Basis(0, 25.0)), Factors(Basis(3, 52.5, 27.5, chebyshev=True))
NOISE = 1e-4


def datasheet(model):
    return model.start(np.eye(3), np.zeros(3))


def moosavi(seeds, temperatures, toolfaces, noise=NOISE, inclinations=(0, 45, 90, 135)):
    """Readings of instruments within Table 1 on the paper's plan, and the instruments."""
    plan = grid(list(inclinations), toolfaces, [0], temperatures)
    raws, truths = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truths.append(servo(rng))
        clean = reading(truths[-1], plan)[0]
        raws.append(clean + noise * rng.normal(size=clean.shape))
    return plan, np.stack(raws), truths


def turns(model, params, raw, temperature):
    """Turn about z of each member's mean gain, in degrees, by its polar factor."""
    gain = model.slope(params, raw, temperature).mean(-3)
    polar = gain[..., 0, 1] - gain[..., 1, 0], gain[..., 0, 0] + gain[..., 1, 1]
    return np.degrees(np.arctan2(*polar))


def of_truths(truths, raw, temperature):
    return np.array(
        [
            turns(t.model, t.accelerometer, one, temperature)
            for t, one in zip(truths, raw, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def cold():
    plan, raw, truths = moosavi(200, COLD, 12)
    return plan, raw, truths, newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination)


@pytest.fixture(scope="module")
def warm():
    plan, raw, truths = moosavi(40, HOT, 9)
    found = newton(THIRTY, datasheet(THIRTY), raw, plan.temperature, 1.0, plan.inclination)
    return plan, raw, truths, found


# Derivatives


def difference(f, step=1e-3):
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


def some_model(kind, order, lead, rng):
    basis = Basis(order, 80.0, 60.0, chebyshev=True)
    if kind == "factors":
        model = Factors(basis)
        params = 1e-2 * rng.normal(size=(*lead, model.size))
        params[..., 0 : 3 * (order + 1) : order + 1] += 1.0
        return model, params
    centre, scale = rng.normal(size=(*lead, 1, 3)), 1 + rng.uniform(size=(*lead, 1, 3))
    model = Polynomial(basis, centre, scale, curved=kind == "curved")
    params = 1e-2 * rng.normal(size=(*lead, model.size))
    params[..., [0, 4, 8]] += 1.0
    return model, params


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", ["polynomial", "curved", "factors"])
def test_curvature_by_fourth_order_differences(kind, order, lead):
    rng = np.random.default_rng(11)
    model, params = some_model(kind, order, lead, rng)
    raw, covector = rng.normal(size=(2, *lead, 5, 3))
    temperature = rng.uniform(20, 140, (*lead, 5))
    got = model.curvature(params, raw, temperature, covector)
    assert got.shape == (*lead, model.size, model.size)
    for j, unit in enumerate(np.eye(model.size)):

        def gradient(h, unit=unit):
            slope = model.jacobian(params + h * unit, raw, temperature)
            return np.einsum("...ni,...nip->...p", covector, slope)

        np.testing.assert_allclose(got[..., j], difference(gradient), atol=1e-9)


def test_curvature_broadcasts_one_instrument_over_many_covectors():
    rng = np.random.default_rng(12)
    model, params = some_model("factors", 1, (), rng)
    raw, temperature, covector = (
        rng.normal(size=(5, 3)),
        np.full(5, 60.0),
        rng.normal(size=(4, 5, 3)),
    )
    got = model.curvature(params, raw, temperature, covector)
    one = [model.curvature(params, raw, temperature, w) for w in covector]
    np.testing.assert_allclose(got, one, atol=1e-14)


VECTORS = {
    "anywhere": ([0.3, -0.5, 0.7], 0.9),
    "horizontal": ([0.6, -0.8, 0.0], 1.5),
    "nearly vertical": ([1e-3, 2e-3, 1.0], 0.0),
    "vertical": ([0.0, 0.0, 1.01], 0.0),
    "nearly upside down": ([-3e-3, 1e-3, -1.0], np.pi),
    "upside down": ([0.0, 0.0, -0.98], np.pi),
}


@pytest.mark.parametrize(("g", "reference"), VECTORS.values(), ids=VECTORS)
def test_half_squares_by_differences(g, reference):
    g = np.array(g)

    def half(h):
        angle = np.arctan2(np.hypot(h[..., 0], h[..., 1]), h[..., 2]) - reference
        return np.stack([(np.sum(h * h, -1) - 0.98**2) ** 2 / 2, angle**2 / 2], -1)

    def gradient(h):
        return np.stack([difference(lambda s, u=u: half(h + s * u), 1e-3) for u in np.eye(3)])

    parts = core.half_square_strength(g, 0.98), core.half_square_inclination(g, reference)
    for k, (error, first, second) in enumerate(parts):
        np.testing.assert_allclose(error**2 / 2, half(g)[k], atol=1e-15)
        np.testing.assert_allclose(first, gradient(g)[:, k], atol=1e-9)
        expected = [difference(lambda s, u=u: gradient(g + s * u), 1e-3)[:, k] for u in np.eye(3)]
        np.testing.assert_allclose(second, expected, atol=1e-7)


def test_a_vertical_reading_of_an_inclined_station_is_toolface_zero():
    """The square of the inclination's error has a ridge there: downhill is along, not across."""
    error, first, second = core.half_square_inclination(np.array([0.0, 0.0, 1.0]), 0.5)
    np.testing.assert_allclose(error, -0.5)
    np.testing.assert_allclose(first, [0.0, 0.5, 0.0])
    np.testing.assert_allclose(second, [[0, 0, 0], [0, 1, -0.5], [0, -0.5, 0]], atol=1e-15)


@pytest.mark.parametrize("kind", ["polynomial", "curved", "factors"])
def test_gradient_and_hessian_of_the_cost_by_differences(kind):
    rng = np.random.default_rng(13)
    plan, raw, _ = moosavi(2, [40.0, 120.0], 3)
    model, params = some_model(kind, 1, (2,), rng)
    if kind != "factors":
        model = Polynomial(model.basis, 0.1 * model.centre, model.scale, model.curved)
    weights = rng.uniform(0.5, 2.0, (len(plan.inclination), 2))
    stations = core.compared(raw, plan.temperature, 1.0, plan.inclination, weights)
    here = core.local(model, params, stations)
    np.testing.assert_allclose(here.cost, core.cost(model, params, stations), rtol=1e-13)
    for j, unit in enumerate(np.eye(model.size)):
        first = difference(lambda h, u=unit: core.cost(model, params + h * u, stations), 1e-4)
        second = difference(
            lambda h, u=unit: core.local(model, params + h * u, stations).gradient, 1e-4
        )
        np.testing.assert_allclose(here.gradient[:, j], first, atol=1e-9)
        np.testing.assert_allclose(here.hessian[:, j], second, atol=1e-8)


# The paper's two calibrations


def test_twelve_parameters_in_under_ten_iterations_for_every_instrument(cold):
    plan, raw, _, found = cold
    assert np.sum(plan.inclination == 0) == 12
    assert np.all(found.status == Status.OK)
    assert found.iterations.max() < 10
    g = TWELVE.fields(found.params, raw, np.full(48, 25.0))
    assert np.abs(np.linalg.norm(g, axis=-1) - 1).max() < 6 * NOISE
    tilt = np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2]) - plan.inclination
    assert np.abs(tilt).max() < 6 * NOISE


def test_thirty_factors_in_under_ten_iterations_over_temperature(warm):
    plan, raw, _, found = warm
    assert np.all(found.status == Status.OK)
    assert found.iterations.max() < 10
    assert np.all(found.determined.rank == 29)
    g = THIRTY.fields(found.params, raw, plan.temperature)
    assert np.abs(np.linalg.norm(g, axis=-1) - 1).max() < 6 * NOISE


def free_changes(found):
    """Whether a turn about an axis, or the scale, of twelve factors is free, by name."""
    moved = np.stack([tangent(TWELVE, found.params, each) for each in CHANGES.values()], 1)
    return dict(zip(CHANGES, (free_share(found.determined, moved) > COUPLED).mT, strict=True))


def test_eleven_of_twelve_are_determined_and_the_free_one_has_a_name(cold):
    determined, free = cold[-1].determined, free_changes(cold[-1])
    assert np.all(determined.rank == 11)
    assert np.all(determined.values[:, 10] > 0.2)
    assert np.all(determined.values[:, 11] < 1e-6)
    assert np.all(free["toolface-zero"])
    for name in ("rotation-x", "rotation-y", "scale"):
        assert not np.any(free[name])


@pytest.mark.parametrize("case", ["cold", "warm"])
def test_toolface_zero_stays_within_the_instruments_own_freedom(case, request):
    """The datasheet has no turn, the truth up to 2 mrad: the steps add nothing to either."""
    plan, raw, truths, found = request.getfixturevalue(case)
    model = TWELVE if case == "cold" else THIRTY
    ours = turns(model, found.params, raw, plan.temperature)
    true = of_truths(truths, raw, plan.temperature)
    assert np.abs(ours).max() < 0.01
    assert np.abs(ours - true).max() < np.abs(true).max() + 0.01
    assert np.abs(np.mean(ours - true)) < 0.1


def pseudo_inverse(model, params, stations, limit=20):
    """The method as it is printed: every step from the pseudo-inverse of the exact Hessian."""
    for _ in range(limit):
        here = core.local(model, params, stations)
        back = np.linalg.pinv(here.hessian, rcond=1e-10, hermitian=True)
        params = params - (back @ here.gradient[..., None])[..., 0]
    return params


def test_the_pseudo_inverse_alone_lets_toolface_zero_wander(cold):
    plan, raw, _, found = cold
    some = slice(0, 40)
    stations = core.compared(raw[some], 25.0, 1.0, plan.inclination)
    start = np.broadcast_to(datasheet(TWELVE), (40, 12))
    wandered = pseudo_inverse(TWELVE, start, stations)
    reached = core.cost(TWELVE, wandered, stations)
    last = np.nanmin(found.cost[some], -1)
    np.testing.assert_allclose(reached, last, rtol=1e-9)  # as good a fit, and yet
    assert np.abs(turns(TWELVE, wandered, raw[some], plan.temperature)).max() > 0.3
    assert np.abs(turns(TWELVE, found.params[some], raw[some], plan.temperature)).max() < 0.01


def residuals(model, params, raw, temperature, inclination):
    """Written anew: vertical stations give both components of their tilt, with the same square."""
    order = model.basis.order
    t = np.polynomial.chebyshev.chebvander((temperature - 52.5) / 27.5, order)
    scale, bias = params[: 6 * (order + 1)].reshape(2, 3, order + 1) @ t.transpose()
    u = raw / scale.transpose() - bias.transpose()
    m = np.zeros((3, 3))
    m[~np.eye(3, dtype=bool)] = params[-6:]
    x, y, z = (u - u @ m.transpose()).transpose()
    across = np.hypot(x, y)
    tilt = np.arctan2(across, z)
    vertical = inclination == 0
    over = tilt[vertical] / across[vertical]
    tilts = [(tilt - inclination)[~vertical], x[vertical] * over, y[vertical] * over]
    return np.concatenate([x**2 + y**2 + z**2 - 1, *tilts]) / np.sqrt(len(raw))


@pytest.mark.parametrize(("case", "member"), [("cold", 0), ("cold", 1), ("cold", 7), ("warm", 3)])
def test_minimum_is_that_of_another_program(case, member, request):
    plan, raw, _, found = request.getfixturevalue(case)
    model = TWELVE if case == "cold" else THIRTY
    args = (raw[member], plan.temperature, plan.inclination)
    other = least_squares(
        lambda p: residuals(model, p, *args),
        datasheet(model),
        jac="3-point",
        method="trf",
        x_scale="jac",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    ours, theirs = (
        model.fields(p, raw[member], plan.temperature) for p in (found.params[member], other.x)
    )
    np.testing.assert_allclose(np.nanmin(found.cost[member]), 2 * other.cost, rtol=1e-10)
    for observable in (
        lambda g: np.linalg.norm(g, axis=-1),
        lambda g: np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2]),
    ):
        np.testing.assert_allclose(observable(ours), observable(theirs), rtol=0, atol=1e-8)


# History, weights, batches


def test_history_falls_to_criterion_22(cold):
    found = cold[-1]
    for cost, criterion, count in zip(found.cost, found.criterion, found.iterations, strict=True):
        assert np.all(np.diff(cost[: count + 1]) <= 1e-12)
        assert np.all(np.isnan(cost[count + 1 :]))
        assert np.all(criterion[: count - 1] >= core.THRESHOLD)
        assert criterion[count - 1] < core.THRESHOLD
        assert np.all(np.isnan(criterion[count:]))


def test_an_ideal_instrument_has_parameters_of_zero_and_converges_at_once():
    """As printed, criterion 22 divides zero by zero here."""
    plan = grid([0, 45, 90, 135, 180], 12, [0], COLD)
    x, y = np.sin(plan.toolface), np.cos(plan.toolface)
    si, ci = np.sin(plan.inclination), np.cos(plan.inclination)
    raw = np.stack([-si * x, -si * y, ci], -1)[None]
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination)
    assert found.status == Status.OK
    assert found.iterations == 1
    np.testing.assert_allclose(found.params[0], datasheet(TWELVE), atol=1e-14)


def test_vertical_and_horizontal_alone_determine_eleven():
    """Both transverse components of a vertical station count, whatever it reads at the start."""
    plan, raw, truths = moosavi(20, COLD, 12, noise=0.0, inclinations=(0, 90))
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination)
    assert np.all(found.status == Status.OK)
    assert np.all(found.determined.rank == 11)
    assert found.iterations.max() < 10
    for truth, params in zip(truths, found.params, strict=True):
        exact = truth.model.slope(truth.accelerometer, raw[0], plan.temperature)[0]
        gain = TWELVE.slope(params, raw[0], plan.temperature)[0]
        np.testing.assert_allclose(gain.transpose() @ gain, exact.transpose() @ exact, atol=1e-10)


def test_cost_with_propagated_weights_is_chi_square(cold):
    plan, raw, *_ = cold
    weights = propagated(1.0, NOISE)
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination, weights=weights)
    assert np.all(found.status == Status.OK)
    freedom = 48 + 36 + 2 * 12 - 11
    mean = np.mean(48 * np.nanmin(found.cost, -1))
    assert abs(mean - freedom) < 4 * np.sqrt(2 * freedom / 200)


def test_an_unknown_reference_is_one_of_weight_zero():
    plan, raw, _ = moosavi(2, COLD, 12)
    blank = np.where(np.arange(48) % 5 == 0, np.nan, plan.inclination)
    weights = np.stack([np.ones(48), np.arange(48) % 5 != 0], -1)
    one = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, blank)
    other = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination, weights=weights)
    assert np.all(one.status == Status.OK)
    np.testing.assert_allclose(one.params, other.params, atol=1e-12)


def test_strength_alone_leaves_three_rotations_and_inclination_alone_the_scale():
    plan, raw, _ = moosavi(1, COLD, 12, inclinations=(5, 45, 90, 135))
    blank = np.full(48, np.nan)
    strength = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, blank)
    assert strength.determined.rank == 9
    names = {name for name, free in free_changes(strength).items() if free}
    assert names == {"rotation-x", "rotation-y", "toolface-zero"}
    angle = newton(TWELVE, datasheet(TWELVE), raw, 25.0, blank, plan.inclination)
    assert angle.determined.rank == 10
    names = {name for name, free in free_changes(angle).items() if free}
    assert names == {"toolface-zero", "scale"}


@pytest.mark.parametrize("kind", ["polynomial", "factors"])
def test_batches_are_their_members(kind):
    count = 6
    plan, raw, _ = moosavi(count, COLD, 6)
    basis = Basis(0, 25.0)
    centre = np.linspace(-0.1, 0.1, 3 * count).reshape(count, 1, 3)
    model = Factors(basis) if kind == "factors" else Polynomial(basis, centre, 1.1 + 0 * centre)
    start = model.start(np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3)))
    found = newton(model, start, raw, 25.0, 1.0, plan.inclination, limit=12)
    assert np.all(found.status == Status.OK)
    for k in range(count):
        one = slice(k, k + 1)
        single = newton(take(model, one), start[one], raw[one], 25.0, 1.0, plan.inclination)
        np.testing.assert_allclose(found.params[k], single.params[0], atol=1e-12)


def test_both_models_find_the_same_calibration(cold):
    plan, raw, _, found = cold
    model = Polynomial(Basis(0, 25.0), np.zeros((20, 1, 3)), np.ones((20, 1, 3)))
    start = model.start(np.broadcast_to(np.eye(3), (20, 3, 3)), np.zeros((20, 3)))
    linear = newton(model, start, raw[:20], 25.0, 1.0, plan.inclination)
    assert np.all(linear.status == Status.OK)
    heat = np.full(48, 25.0)
    g, h = (
        TWELVE.fields(found.params[:20], raw[:20], heat),
        model.fields(linear.params, raw[:20], heat),
    )
    np.testing.assert_allclose(np.linalg.norm(g, axis=-1), np.linalg.norm(h, axis=-1), atol=1e-9)
    np.testing.assert_allclose(g[..., 2], h[..., 2], atol=1e-9)


def test_a_broken_member_stops_nobody():
    plan, raw, _ = moosavi(5, COLD, 12)
    whole = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination)
    broken = raw.copy()
    broken[1, 3, 0] = np.nan
    broken[2] = 0.0
    broken[3] = 1e200
    found = newton(TWELVE, datasheet(TWELVE), broken, 25.0, 1.0, plan.inclination)
    assert list(found.status[[1, 2, 3]]) == [Status.NOT_FINITE] * 3
    np.testing.assert_array_equal(found.params[[0, 4]], whole.params[[0, 4]])


@pytest.mark.filterwarnings("error")
def test_a_hessian_without_eigenvalues_is_a_status(monkeypatch):
    """Finite as it is, it overflows in the scale of its columns; other members go on."""
    plan, raw, _ = moosavi(3, COLD, 12)
    raw *= 100.0
    whole = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 100.0, plan.inclination)
    local = core.local

    def overflowing(model, params, stations):
        here = local(model, params, stations)
        ill = np.all(stations.raw == raw[1], (1, 2))
        return replace(here, hessian=np.where(ill[:, None, None], 1e308, here.hessian))

    monkeypatch.setattr(core, "local", overflowing)
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 100.0, plan.inclination)
    assert found.status[1] == Status.NOT_FINITE
    for name in ("status", "iterations", "params"):
        others = (getattr(each, name)[[0, 2]] for each in (found, whole))
        np.testing.assert_array_equal(*others, err_msg=name)


def test_too_few_iterations_are_said():
    plan, raw, _ = moosavi(1, COLD, 12)
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination, limit=2)
    assert found.status == Status.NOT_CONVERGED
    assert found.iterations == 2


def test_inclinations_far_from_the_start_are_reached():
    """A triad mounted 10° askew, 20 % off in scale: the exact Hessian is not positive there."""
    rng = np.random.default_rng(14)
    plan, raw, _ = moosavi(50, COLD, 12)
    turn = rotation(np.radians(10) * rng.normal(size=(50, 3)) / np.sqrt(3))
    raw = 1.2 * np.einsum("bij,bnj->bni", turn, raw)
    found = newton(TWELVE, datasheet(TWELVE), raw, 25.0, 1.0, plan.inclination)
    assert np.all(found.status == Status.OK)
    assert np.nanmin(found.cost, -1).max() < 3 * NOISE**2 * 4
    assert Rotation.from_matrix(turn).magnitude().max() > np.radians(15)
