"""Gradients against complex steps and against the ISCWSA weighting functions."""

import numpy as np
import pytest

from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS, variances
from mwdcal.geometry.vectors import reference_vectors

SHAPES = [(), (1,), (3, 1, 2)]


def complex_value(name, x):
    """The observable written once more, for complex arguments: atan2 with its derivative."""
    g, b = x[..., :3], x[..., 3:]
    dot = lambda u, v: np.sum(u * v, -1)  # noqa: E731
    size = lambda u: np.sqrt(dot(u, u))  # noqa: E731

    def atan2(y, x):
        real = np.arctan2(y.real, x.real)
        return real + 1j * (y.imag * x.real - x.imag * y.real) / (x.real**2 + y.real**2)

    cross = np.cross(g, b)
    across = np.sqrt(g[..., 0] ** 2 + g[..., 1] ** 2)
    east = (g[..., 0] * b[..., 1] - g[..., 1] * b[..., 0]) * size(g)
    north = b[..., 2] * across**2 - g[..., 2] * (g[..., 0] * b[..., 0] + g[..., 1] * b[..., 1])
    values = {
        "inclination": lambda: atan2(across, g[..., 2]),
        "toolface": lambda: atan2(-g[..., 0], -g[..., 1]),
        "azimuth": lambda: atan2(east, north),
        "magnetic_toolface": lambda: atan2(b[..., 0], b[..., 1]),
        "gravity": lambda: size(g),
        "field": lambda: size(b),
        "dip": lambda: atan2(dot(g, b), size(cross)),
        "north_toolface": lambda: atan2(*upright(g / size(g)[..., None], b)),
    }
    return values[name]()


def upright(down, b):
    """x and y of b in a tool turned so that unit vector `down` is its z axis, the shortest way (Rodrigues)."""
    axis = np.stack([down[..., 1], -down[..., 0], 0 * down[..., 0]], -1)
    once = np.cross(axis, b)
    lean, less = 1 + down[..., 2:], 1 - down[..., 2:]
    lean = np.where(lean.real < 1, np.sum(down[..., :2] ** 2, -1, keepdims=True) / less, lean)
    turned = b + once + np.cross(axis, once) / lean
    return turned[..., 0], turned[..., 1]


ANGLES_AND_STRENGTHS = (
    *("inclination", "toolface", "azimuth", "magnetic_toolface", "north_toolface"),
    *("gravity", "field", "dip"),
)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", ANGLES_AND_STRENGTHS)
def test_gradients_by_complex_step(name, shape):
    rng = np.random.default_rng(4)
    inc = np.where(rng.uniform(size=shape) < 0.3, 1e-4, rng.uniform(0.02, 3.1, shape))
    azi, tool = rng.uniform(0, 6, (2, *shape))
    g, b = reference_vectors(inc, azi, tool, 1.003, 1.7, rng.uniform(-1.4, 1.4, shape))
    x = np.concatenate([g, b], -1)
    expected = np.stack(
        [complex_value(name, x + 1e-30j * np.eye(6)[j]).imag / 1e-30 for j in range(6)], -1
    )
    got = OBSERVABLES[name].gradient(g, b)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_variances_are_gradients_on_both_sides_of_the_covariance():
    rng = np.random.default_rng(6)
    g, b = rng.normal(size=(2, 300, 3))
    g[:7] = [(0, 0, 1), (0, 0, -1), (1e-13, 0, 1), (1e-5, 0, 1), (0, 1, 0), (0, 0, 0), (1, 2, 3)]
    b[6:9], b[9] = [(2, 4, 6), (0, 0, 1), (0, 0, 0)], g[9]
    roots = rng.normal(size=(300, 6, 6))
    whole = roots @ roots.mT
    rows, columns = np.triu_indices(3)
    own = (whole[:, k : k + 3, k : k + 3][:, rows, columns] for k in (0, 3))
    flat = np.concatenate([*own, whole[:, :3, 3:].reshape(-1, 9)], -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        got = variances(*(np.moveaxis(each, -1, 0) for each in (g, b, flat)))
        gradients = np.stack([OBSERVABLES[name].gradient(g, b) for name in OUTPUTS], -2)
    expected = np.einsum("nki,nij,nkj->kn", gradients, whole, gradients)
    along = np.isin(np.arange(300), (6, 9))  # g along b: azimuth and dip turn by rounding alone
    got[1::4, along] = expected[1::4, along] = np.nan
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert np.isfinite(expected[:, 10:]).all()


def weighting_functions(G, B, I, A, T, D):  # noqa: E741
    """SPE 67616 Table 1: inclination and azimuth per unit of each of the 12 sensor errors."""
    si, ci, sa, ca, st, ct = np.sin(I), np.cos(I), np.sin(A), np.cos(A), np.sin(T), np.cos(T)
    td, cd, cot = np.tan(D), np.cos(D), np.cos(I) / np.sin(I)
    return {
        "ABX": (-ci * st / G, ((ci * sa * st - ca * ct) * td + cot * ct) / G),
        "ABY": (-ci * ct / G, ((ci * sa * ct + ca * st) * td - cot * st) / G),
        "ABZ": (-si / G, td * si * sa / G),
        "ASX": (ci * si * st**2, -(td * si * (ci * sa * st - ca * ct) + ci * ct) * st),
        "ASY": (ci * si * ct**2, -(td * si * (ci * sa * ct + ca * st) - ci * st) * ct),
        "ASZ": (-si * ci, td * si * ci * sa),
        "MBX": (0 * I, (ca * ct - ci * sa * st) / (B * cd)),
        "MBY": (0 * I, -(ca * st + ci * sa * ct) / (B * cd)),
        "MBZ": (0 * I, -si * sa / (B * cd)),
        "MSX": (0 * I, (ci * ca * st - td * si * st + sa * ct) * (ca * ct - ci * sa * st)),
        "MSY": (0 * I, -(ci * ca * ct - td * si * ct - sa * st) * (ca * st + ci * sa * ct)),
        "MSZ": (0 * I, -(si * ca + td * ci) * si * sa),
    }


def test_iscwsa_weighting_functions_are_gradient_times_model():
    rng = np.random.default_rng(5)
    inc, dip = np.radians(rng.uniform(5, 120, 500)), np.radians(rng.uniform(-80, 80, 500))
    azi, tool = rng.uniform(0, 2 * np.pi, (2, 500))
    G, B = 9.80665, 50_000.0
    g, b = reference_vectors(inc, azi, tool, G, B, dip)
    readings = np.concatenate([g, b], -1)
    gradients = [OBSERVABLES[name].gradient(g, b) for name in ("inclination", "azimuth")]
    expected = weighting_functions(G, B, inc, azi, tool, dip)
    for index, sensor in enumerate("XYZXYZ"):
        letter = "A" if index < 3 else "M"
        columns = {
            f"{letter}B{sensor}": np.eye(6)[index],
            f"{letter}S{sensor}": np.eye(6)[index] * readings,
        }
        for term, column in columns.items():
            for got, want in zip(gradients, expected[term], strict=True):
                value = np.sum(got * column, -1)
                scale = max(np.abs(want).max(), np.abs(value).max(), 1e-300)
                np.testing.assert_allclose(
                    value / scale, want / scale, rtol=0, atol=1e-12, err_msg=term
                )


def test_north_toolface_is_azimuth_plus_toolface_and_the_magnetic_toolface_at_vertical():
    rng = np.random.default_rng(6)
    azi, tool = rng.uniform(0, 2 * np.pi, (2, 300))
    for inc in (0.0, 1e-13, 1e-9, 1e-3, 0.5, np.pi / 2, 3.0):
        g, b = reference_vectors(np.full(300, inc), azi, tool, 9.8, 50_000.0, 1.2)
        value, slope = (
            getattr(OBSERVABLES["north_toolface"], what)(g, b) for what in ("value", "gradient")
        )
        off = OBSERVABLES["north_toolface"].difference(value, azi + tool)
        np.testing.assert_allclose(off, 0, atol=1e-13 / max(1 + np.cos(inc), 0.01))
        assert np.isfinite(slope).all()
        if inc == 0:
            np.testing.assert_allclose(
                value, OBSERVABLES["magnetic_toolface"].value(g, b), atol=1e-15
            )
    down = reference_vectors(np.pi, 0.3, 0.4, 1.0, 1.0, 0.5)
    exactly = np.array([0.0, 0.0, -1.0]), down[1]
    assert np.isnan(OBSERVABLES["north_toolface"].value(*exactly))
