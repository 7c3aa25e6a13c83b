"""Derivatives of every model, alone and under every observable, against formulas written anew."""

import numpy as np
import pytest

from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.sensor.models import Basis, Factors, Polynomial, restricted
from simulation import DEG, attitude, complex_steps
from test_observables import complex_value

LEADS = [(), (1,), (3, 2)]
ORDERS = (0, 1, 2, 3)
MIDDLE, HALF = 85.0, 65.0
CROSS = [(i, j) for i in range(3) for j in range(3) if i != j]
HIDDEN = {12: [], 9: [(0, 1), (0, 2), (1, 2)], 6: CROSS}
"""Cross terms (row, column) that a model of 12, 9 or 6 parameters does without."""
MODELS = [
    (kind, order, parameters)
    for kind in ("polynomial", "curved", "factors")
    for order in ORDERS
    for parameters in HIDDEN
]
EVERY = pytest.mark.parametrize(("kind", "order", "parameters"), MODELS)
BATCHES = pytest.mark.parametrize("lead", LEADS, ids=str)

INCLINATION = np.array([0, 180, 0.01, 0.01, 179.99, 5, 45, 90, 135]) * DEG
AZIMUTH = np.array([0, 40, 10, 200, 77, 300, 180, 355, 121]) * DEG
TOOLFACE = np.array([0, 10, 90, 301, 15, 250, 0, 77, 180]) * DEG
VERTICAL = np.arange(len(INCLINATION)) < 2
GRAVITY, FIELD, DIP = 1.003, 1.7, 65 * DEG


def kept(kind, order, parameters):
    """Which parameters of the whole model (p,) the restricted one has."""
    if kind == "factors":
        return np.array([True] * 6 * (order + 1) + [c not in HIDDEN[parameters] for c in CROSS])
    one = [(i, j) not in HIDDEN[parameters] for i in range(3) for j in range(3)] + [True] * 3
    return np.array(one * (order + 1) + [True] * 6 * (kind == "curved"))


class Written:
    """A model written anew, for complex parameters: its fields, and one of ours to compare."""

    def __init__(self, kind, order, parameters, lead, rng):
        self.kind, self.order = kind, order
        self.kept = kept(kind, order, parameters)
        self.centre = rng.normal(size=(*lead, 1, 3)) * (kind != "factors")
        self.scale = 1 + rng.uniform(size=(*lead, 1, 3)) * (kind != "factors")
        basis = Basis(order, MIDDLE, HALF, chebyshev=True)
        whole = (
            Factors(basis)
            if kind == "factors"
            else Polynomial(basis, self.centre, self.scale, curved=kind == "curved")
        )
        self.ours = restricted(whole, parameters)
        self.params = 1e-2 * rng.normal(size=(*lead, len(self.kept)))
        ones = 3 * (order + 1) if kind == "factors" else 9
        self.params[..., 0 : ones : order + 1 if kind == "factors" else 4] += 1
        self.params = self.params[..., self.kept]
        self.temperature = rng.uniform(20, 150, (*lead, len(INCLINATION)))

    def fields(self, params, raw):
        """Fields (..., n, 3) of complex parameters (..., p)."""
        whole = np.zeros((*params.shape[:-1], len(self.kept)), complex)
        whole[..., self.kept] = params
        t = (self.temperature - MIDDLE) / HALF
        basis = [1 + 0 * t, t, 2 * t**2 - 1, 4 * t**3 - 3 * t][: self.order + 1]
        x = (raw - self.centre) / self.scale
        return (self._factors if self.kind == "factors" else self._polynomial)(whole, x, basis)

    def _polynomial(self, whole, x, basis):
        result = 0
        for k, value in enumerate(basis):
            block = whole[..., None, 12 * k : 12 * k + 12]
            rows = [np.sum(block[..., 3 * i : 3 * i + 3] * x, -1) for i in range(3)]
            result = result + value[..., None] * (np.stack(rows, -1) + block[..., 9:])
        if self.kind == "curved":
            result = result + whole[..., None, -6:-3] * x**2 + whole[..., None, -3:] * x**3
        return result

    def _factors(self, whole, x, basis):
        def course(first):
            return sum(whole[..., None, first + k] * value for k, value in enumerate(basis))

        count = self.order + 1
        u = [x[..., i] / course(i * count) - course((3 + i) * count) for i in range(3)]
        g = list(u)
        for place, (i, j) in enumerate(CROSS):
            g[i] = g[i] - whole[..., None, 6 * count + place] * u[j]
        return np.stack(g, -1)

    def readings(self, fields):
        """Readings of given fields, by Newton's method."""
        raw = np.broadcast_to(self.centre, fields.shape)
        for _ in range(8):
            misfit = self.fields(self.params, raw).real - fields
            raw = raw - np.linalg.solve(self.slope(raw), misfit[..., None])[..., 0]
        return raw

    def slope(self, raw):
        """Derivative (..., n, 3, 3) of the fields by the readings."""
        return complex_steps(lambda x: self.fields(self.params, x), raw)


def made(kind, order, parameters, lead, seed=1):
    """A model, and readings (..., n, 3) near those of gravity."""
    rng = np.random.default_rng(seed)
    model = Written(kind, order, parameters, lead, rng)
    g, _ = attitude(INCLINATION, AZIMUTH, TOOLFACE)(GRAVITY, FIELD, DIP)
    return model, model.readings(np.broadcast_to(g, (*lead, *g.shape)))


@BATCHES
@EVERY
def test_fields_jacobian_and_slope(kind, order, parameters, lead):
    model, raw = made(kind, order, parameters, lead)
    ours, args = model.ours, (model.params, raw, model.temperature)
    assert ours.size == model.kept.sum()
    expected = model.fields(model.params, raw).real
    np.testing.assert_allclose(ours.fields(*args), expected, rtol=0, atol=1e-13)
    by_params = complex_steps(lambda p: model.fields(p, raw), model.params)
    assert by_params.shape == (*lead, len(INCLINATION), 3, ours.size)
    np.testing.assert_allclose(ours.jacobian(*args), by_params, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.slope(*args), model.slope(raw), rtol=1e-9, atol=1e-9)


@BATCHES
@EVERY
def test_curvature(kind, order, parameters, lead):
    """The gradient of Σ covector · field by complex step, differenced to fourth order."""
    model, raw = made(kind, order, parameters, lead)
    covector = np.random.default_rng(2).normal(size=raw.shape)

    def gradient(params):
        return complex_steps(lambda p: np.sum(covector * model.fields(p, raw), (-1, -2)), params)

    got = model.ours.curvature(model.params, raw, model.temperature, covector)
    assert got.shape == (*lead, model.ours.size, model.ours.size)
    units = np.eye(model.ours.size).reshape(-1, *[1] * len(lead), model.ours.size)
    steps = np.array([1, -1, 2, -2]).reshape(-1, 1, *[1] * len(lead), 1) * 1e-3
    near, less, far, least = gradient(model.params + steps * units)
    expected = np.moveaxis((8 * (near - less) - (far - least)) / 12e-3, 0, -1)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


def value(name, x):
    """An observable of complex vectors (..., 6); a component of them by its name."""
    components = ("gx", "gy", "gz", "bx", "by", "bz")
    return x[..., components.index(name)] if name in components else complex_value(name, x)


@BATCHES
@EVERY
def test_every_observable_through_the_model(kind, order, parameters, lead):
    """By the parameters of both triads, near and at vertical; there toolface and azimuth are not."""
    g, b = attitude(INCLINATION, AZIMUTH, TOOLFACE)(GRAVITY, FIELD, DIP)
    rng = np.random.default_rng(3)
    triads = [Written(kind, order, parameters, lead, rng) for _ in range(2)]
    raw = [
        m.readings(np.broadcast_to(v, (*lead, *v.shape)))
        for m, v in zip(triads, (g, b), strict=True)
    ]
    args = [(m.params, r, m.temperature) for m, r in zip(triads, raw, strict=True)]
    fields = [m.ours.fields(*a) for m, a in zip(triads, args, strict=True)]
    jacobians = [m.ours.jacobian(*a) for m, a in zip(triads, args, strict=True)]
    size = triads[0].ours.size
    whole = np.concatenate([m.params for m in triads], -1)

    def written(name, params):
        parts = (params[..., :size], params[..., size:])
        vectors = [m.fields(p, r) for m, p, r in zip(triads, parts, raw, strict=True)]
        x = np.concatenate(vectors, -1)
        if name == "inclination":  # at vertical the limit along toolface zero
            x.real[..., VERTICAL, :2] = [0, -1e-11]
        return value(name, x)

    for name, observable in OBSERVABLES.items():
        gradient = observable.gradient(*fields)
        got = np.concatenate(
            [
                np.einsum("...ni,...nip->...np", gradient[..., own], jacobian)
                for own, jacobian in zip((np.s_[:3], np.s_[3:]), jacobians, strict=True)
            ],
            -1,
        )
        there = ~VERTICAL if name in ("toolface", "azimuth") else VERTICAL | True
        if name == "north_toolface":  # not upside down
            there = np.arange(len(VERTICAL)) != 1
        with np.errstate(all="ignore"):
            expected = complex_steps(lambda params, n=name: written(n, params), whole)
        assert np.isnan(observable.value(*fields)[..., ~there]).all()
        assert np.isnan(got[..., ~there, :size]).all()
        scale = np.abs(expected[..., there, :]).max(-1, keepdims=True)
        np.testing.assert_allclose(
            got[..., there, :] / scale, expected[..., there, :] / scale, rtol=0, atol=1e-9,
            err_msg=name,
        )  # fmt: skip
