"""Models: Jacobian and slope against differences, exact conversions, batch shapes."""

import numpy as np
import pytest

from mwdcal.geometry.vectors import rotation
from mwdcal.sensor.models import Basis, Factors, Polynomial

LEADS = [(), (1,), (3, 2)]


def model_and_params(kind, order, lead, rng):
    basis = Basis(order, 80.0, 60.0, chebyshev=True)
    centre, scale = rng.normal(size=(*lead, 1, 3)), 1 + rng.uniform(size=(*lead, 1, 3))
    if kind == "factors":
        model = Factors(basis)
        params = 1e-2 * rng.normal(size=(*lead, model.size))
        params[..., 0 : 3 * (order + 1) : order + 1] += 1.0
        return model, params
    model = Polynomial(basis, centre, scale, curved=kind == "curved")
    params = 1e-2 * rng.normal(size=(*lead, model.size))
    params[..., [0, 4, 8]] += 1.0
    return model, params


CASES = [(k, n) for k in ("polynomial", "curved", "factors") for n in (0, 1, 3)]


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize(("kind", "order"), CASES)
def test_derivatives_by_fourth_order_differences(kind, order, lead):
    rng = np.random.default_rng(6)
    model, params = model_and_params(kind, order, lead, rng)
    raw = rng.normal(size=(*lead, 5, 3))
    temperature = rng.uniform(20, 140, (*lead, 5))

    def difference(f, step=1e-3):
        return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)

    jacobian = model.jacobian(params, raw, temperature)
    assert jacobian.shape == (*lead, 5, 3, model.size)
    for j in range(model.size):
        unit = np.eye(model.size)[j]
        got = difference(lambda h, u=unit: model.fields(params + h * u, raw, temperature))
        np.testing.assert_allclose(jacobian[..., j], got, atol=1e-9)
    slope = model.slope(params, raw, temperature)
    for j in range(3):
        unit = np.eye(3)[j]
        got = difference(lambda h, u=unit: model.fields(params, raw + h * u, temperature))
        np.testing.assert_allclose(slope[..., j], got, atol=1e-9)


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize(("kind", "order"), CASES)
def test_finished_model_is_the_same_function(kind, order, lead):
    rng = np.random.default_rng(7)
    model, params = model_and_params(kind, order, lead, rng)
    raw, temperature = rng.normal(size=(*lead, 5, 3)), rng.uniform(20, 140, (*lead, 5))
    finished, whole = model.finished(30.0)
    moved = np.einsum("...ij,...j->...i", whole, params)
    np.testing.assert_allclose(
        finished.fields(moved, raw, temperature),
        model.fields(params, raw, temperature),
        rtol=1e-11,
        atol=1e-11,
    )


@pytest.mark.parametrize(
    ("kind", "order"), [("polynomial", 0), ("polynomial", 2), ("factors", 0), ("factors", 3)]
)
def test_transformed_model_gives_transformed_fields(kind, order):
    rng = np.random.default_rng(8)
    model, params = model_and_params(kind, order, (2,), rng)
    raw, temperature = rng.normal(size=(2, 5, 3)), rng.uniform(20, 140, (2, 5))
    turn = rotation(0.1 * rng.normal(size=(2, 3))) * 1.03
    got = model.fields(model.transformed(params, turn), raw, temperature)
    expected = np.einsum("bij,bnj->bni", turn, model.fields(params, raw, temperature))
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_factors_are_moosavis_equations():
    """Equations 1 to 8 written out for one channel triple, nominal temperature 30 °C."""
    rng = np.random.default_rng(9)
    model = Factors(Basis(3, 30.0))
    SF = np.array([3.0, 2.9, 3.1])[:, None] * np.array([1, 1e-4, 1e-7, 1e-10])
    B = rng.normal(size=(3, 4)) * np.array([1e-2, 1e-4, 1e-7, 1e-10])
    m = 2e-3 * rng.normal(size=6)
    V, T = rng.normal(size=(4, 3)), np.array([25.0, 60.0, 100.0, 150.0])
    got = model.fields(np.concatenate([SF.ravel(), B.ravel(), m]), V, T)
    for n, t in enumerate(T - 30.0):
        full_scale = [s[0] + s[1] * t + s[2] * t**2 + s[3] * t**3 for s in SF]
        full_bias = [b[0] + b[1] * t + b[2] * t**2 + b[3] * t**3 for b in B]
        u = [V[n, i] / full_scale[i] - full_bias[i] for i in range(3)]
        expected = [
            u[0] - m[0] * u[1] - m[1] * u[2],
            u[1] - m[2] * u[0] - m[3] * u[2],
            u[2] - m[4] * u[0] - m[5] * u[1],
        ]
        np.testing.assert_allclose(got[n], expected, rtol=1e-14)


def test_start_gives_the_affine_map():
    rng = np.random.default_rng(10)
    matrix, offset = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3)
    raw, temperature = rng.normal(size=(5, 3)), np.full(5, 80.0)
    for kind in ("polynomial", "factors"):
        model, _ = model_and_params(kind, 0, (), rng)
        got = model.fields(model.start(matrix, offset), raw, temperature)
        np.testing.assert_allclose(got, raw @ matrix.T + offset, atol=1e-12)
