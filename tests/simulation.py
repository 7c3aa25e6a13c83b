"""A second, independent forward model for tests: reading = S R e + o + noise, and its information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DEG = np.pi / 180


def attitude(inc, azi, tool):
    """Tool vectors of gravity and field by the printed formulas, not by a matrix product."""

    def vectors(gravity, field, dip):
        g = np.stack(
            [-np.sin(inc) * np.sin(tool), -np.sin(inc) * np.cos(tool), np.cos(inc) + 0 * tool], -1
        )
        cd, sd = np.cos(dip), np.sin(dip)
        b = np.stack(
            [
                cd * (np.cos(inc) * np.cos(azi) * np.sin(tool) + np.sin(azi) * np.cos(tool))
                - sd * np.sin(inc) * np.sin(tool),
                cd * (np.cos(inc) * np.cos(azi) * np.cos(tool) - np.sin(azi) * np.sin(tool))
                - sd * np.sin(inc) * np.cos(tool),
                cd * np.sin(inc) * np.cos(azi) + sd * np.cos(inc),
            ],
            -1,
        )
        return gravity * g, field * b

    return vectors


@dataclass
class Tool:
    """Forward parameters of both triads, noise, and the earth."""

    matrix: np.ndarray  # (2, 3, 3)
    offset: np.ndarray  # (2, 3)
    noise: tuple[float, float] = (1e-4, 15.0)
    gravity: float = 1.0
    field: float = 50_000.0
    dip: float = 65 * DEG

    @classmethod
    def random(cls, seed, iron=400.0, **others):
        rng = np.random.default_rng(seed)
        matrix = np.eye(3) * (1 + 0.05 * rng.uniform(-1, 1, (2, 3, 3)))
        matrix = matrix + 3e-3 * rng.uniform(-1, 1, (2, 3, 3))
        offset = rng.uniform(-1, 1, (2, 3)) * np.array([[0.01], [iron]])
        return cls(matrix, offset, **others)

    def clean(self, inc, azi, tool):
        pairs = zip(
            attitude(inc, azi, tool)(self.gravity, self.field, self.dip), (0, 1), strict=True
        )
        return [v @ self.matrix[t].T + self.offset[t] for v, t in pairs]

    def readings(self, rng, count, inc, azi, tool):
        shape = (count, len(inc), 3)
        return [
            c + s * rng.normal(size=shape)
            for c, s in zip(self.clean(inc, azi, tool), self.noise, strict=True)
        ]


def plan(inclinations=(5, 45, 90, 135), toolfaces=12):
    """Stations at each inclination × toolface, azimuth turning along."""
    inc = np.repeat(inclinations, toolfaces) * DEG
    tool = np.tile(np.arange(toolfaces) * 360 / toolfaces, len(inclinations)) * DEG
    azi = (np.arange(len(inc)) * 77.0 % 360) * DEG
    return inc, azi, tool


def information(tool, inc, azi, toolface, unknown):
    """Fisher information of (S, o of both triads, then every unknown), by complex step."""
    count = len(inc)
    sizes = {"inclination": count, "azimuth": count, "toolface": count, "field": 1, "dip": 1}

    def predicted(x):
        matrix, offset = x[:18].reshape(2, 3, 3), x[18:24].reshape(2, 3)
        values = {
            "inclination": inc + 0j, "azimuth": azi + 0j, "toolface": toolface + 0j,
            "field": tool.field + 0j, "dip": tool.dip + 0j,
        }  # fmt: skip
        at = 24
        for name in unknown:
            values[name] = values[name] + x[at : at + sizes[name]]
            at += sizes[name]
        if sizes["field"] and "field" not in unknown:
            values["field"] = tool.field
        pair = attitude(values["inclination"], values["azimuth"], values["toolface"])
        pair = pair(tool.gravity, values["field"], values["dip"])
        rows = [(v @ matrix[t].T + offset[t]) / tool.noise[t] for t, v in enumerate(pair)]
        return np.concatenate([r.ravel() for r in rows])

    total = 24 + sum(sizes[name] for name in unknown)
    x0 = np.concatenate([tool.matrix.ravel(), tool.offset.ravel(), np.zeros(total - 24)]).astype(
        complex
    )
    columns = []
    for j in range(total):
        x = x0.copy()
        x[j] += 1e-30j
        columns.append(predicted(x).imag / 1e-30)
    jacobian = np.stack(columns, -1)
    return jacobian.T @ jacobian


def bound(tool, inc, azi, toolface, unknown=(), tolerance=1e-9):
    """Cramér-Rao covariance (24, 24) of (S, o); free directions removed by pseudo-inverse."""
    whole = information(tool, inc, azi, toolface, unknown)
    scale = np.sqrt(np.diag(whole))
    scale[scale == 0] = 1
    inverse = np.linalg.pinv(whole / np.outer(scale, scale), rcond=tolerance, hermitian=True)
    return (inverse / np.outer(scale, scale))[:24, :24]


# Sixty factors: SF (3 x 4 powers of T - 30 °C), B (3 x 4) and m (6), accelerometer then magnetometer

LIMITS = np.array([[0.05, 0.01, 180e-6, 100e-6, 2e-3], [0.05, 500.0, 180e-6, 5.0, 2e-3]])
"""Moosavi's Table 1: scale, bias (g), drift of both per °C, alignment; and 50 000 nT for 1 g."""
COURSE = np.array([1 / 2, 1 / 8 / 120, 1 / 12 / 120**2])
"""Shares of the powers of T - 30 °C in a drift that reaches its limit at 150 °C and not before."""


def factors_within_limits(rng, count):
    """Factors (count, 60) of servo instruments, and of magnetometers comparable to them."""
    triads = []
    for scale, bias, scale_drift, bias_drift, alignment in LIMITS:
        first = rng.uniform(-1, 1, (count, 6, 1)) * np.repeat([scale, bias], 3)[:, None]
        later = rng.uniform(-1, 1, (count, 6, 3)) * COURSE
        later = later * np.repeat([scale_drift, bias_drift], 3)[:, None]
        linear = np.concatenate([first, later], -1)
        linear[:, :3, 0] += 1
        turned = rng.uniform(-alignment, alignment, (count, 6))
        triads.append(np.concatenate([linear.reshape(count, 24), turned], -1))
    return np.concatenate(triads, -1)


def _factor_parts(one, temperature):
    """SF and B (..., n, 3), and I - m (..., 3, 3), of one triad's 30 factors, complex ones too."""
    powers = (temperature - 30.0)[:, None] ** np.arange(4)
    scale, bias = (
        np.einsum("nk,...ik->...ni", powers, one[..., w : w + 12].reshape(*one.shape[:-1], 3, 4))
        for w in (0, 12)
    )
    mixing = np.eye(3) + np.zeros((*one.shape[:-1], 3, 3), one.dtype)
    mixing[..., ~np.eye(3, dtype=bool)] -= one[..., 24:]
    return scale, bias, mixing


def factor_readings(factors, temperature, vectors):
    """Readings (..., n, 6) of tools (..., 60) in fields (..., n, 6): V = SF ((I - m)⁻¹ v + B)."""
    readings = []
    for t in (0, 1):
        scale, bias, mixing = _factor_parts(factors[..., 30 * t : 30 * t + 30], temperature)
        field = vectors[..., 3 * t : 3 * t + 3] @ np.swapaxes(np.linalg.inv(mixing), -1, -2)
        readings.append(scale * (field + bias))
    return np.concatenate(readings, -1)


def factor_fields(factors, temperature, readings):
    """Fields (..., n, 6) from the readings: (I - m) (V / SF - B)."""
    fields = []
    for t in (0, 1):
        scale, bias, mixing = _factor_parts(factors[..., 30 * t : 30 * t + 30], temperature)
        unit = readings[..., 3 * t : 3 * t + 3] / scale - bias
        fields.append(unit @ np.swapaxes(mixing, -1, -2))
    return np.concatenate(fields, -1)


def complex_steps(function, x):
    """Derivative (..., p) of a function of x (..., p) by complex step, all components at once."""
    units = np.eye(x.shape[-1]).reshape(-1, *[1] * (x.ndim - 1), x.shape[-1])
    return np.moveaxis(function(x + 1e-30j * units).imag / 1e-30, 0, -1)
