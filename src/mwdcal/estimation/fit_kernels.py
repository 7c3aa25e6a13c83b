"""Loops for the compiler: imported only by `core.fast`, where they are described."""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array
from mwdcal.sensor.jit import compiled


@compiled
def _factor(own: Array, lower: Array) -> None:
    """Cholesky factor L of I + GᵀG, of G (m, a)."""
    rows, count = own.shape
    for i in range(count):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for k in range(rows):
                total += own[k, i] * own[k, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]


@compiled
def _project(own: Array, lower: Array, out: Array) -> None:
    """L⁻¹ Gᵀ (a, m): what is removed from a column x is its square, |L⁻¹Gᵀx|²."""
    rows, count = own.shape
    for m in range(rows):
        for i in range(count):
            total = own[m, i]
            for k in range(i):
                total -= lower[i, k] * out[k, m]
            out[i, m] = total / lower[i, i]


@compiled
def _gather(residual: Array, first: Array, second: Array, shared: Array, rows: Array) -> None:
    """[X ρ] of one station (m, u + 1): the zeros beside the blocks are there from the start."""
    top, p = first.shape
    q, s = second.shape[1], shared.shape[1]
    for m in range(len(residual)):
        if m < top:
            for i in range(p):
                rows[m, i] = first[m, i]
        else:
            for i in range(q):
                rows[m, p + i] = second[m - top, i]
        for i in range(s):
            rows[m, p + q + i] = shared[m, i]
        rows[m, p + q + s] = residual[m]


@compiled
def _add(rows: Array, sign: float, total: Array) -> None:
    """Lower triangle of total += sign · rowsᵀ rows."""
    for m in range(len(rows)):
        row = rows[m]
        for i in range(len(row)):
            value = sign * row[i]
            if value != 0.0:
                for j in range(i + 1):
                    total[i, j] += value * row[j]


@compiled
def gram(
    residual: Array, first: Array, second: Array, shared: Array, own: Array, found: Array
) -> None:
    """[X ρ]ᵀ C⁻¹ [X ρ] = [X ρ]ᵀ[X ρ] less the squares of L⁻¹Gᵀ[X ρ], summed over stations."""
    batch, stations, count = residual.shape
    a, width = own.shape[3], found.shape[-1]
    lower, removing = np.zeros((a, a)), np.zeros((a, count))
    rows, removed = np.zeros((count, width)), np.zeros((a, width))
    for b in range(batch):
        total = found[b]
        for n in range(stations):
            _gather(residual[b, n], first[b, n], second[b, n], shared[b, n], rows)
            _add(rows, 1.0, total)
            _factor(own[b, n], lower)
            _project(own[b, n], lower, removing)
            removed[:] = 0.0
            for k in range(a):
                for m in range(count):
                    value = removing[k, m]
                    if value != 0.0:
                        for i in range(width):
                            removed[k, i] += value * rows[m, i]
            _add(removed, -1.0, total)
        for i in range(width):
            for j in range(i):
                total[j, i] = total[i, j]


@compiled
def remaining(
    residual: Array, first: Array, second: Array, shared: Array, own: Array, covariance: Array,
    left: Array, spread: Array,
) -> None:  # fmt: skip
    """C⁻¹ρ and C⁻¹ - C⁻¹X V XᵀC⁻¹ of every station."""
    batch, stations, count = residual.shape
    a, u = own.shape[3], covariance.shape[-1]
    lower, removing, weight = np.zeros((a, a)), np.zeros((a, count)), np.zeros((count, count))
    rows, weighed = np.zeros((count, u + 1)), np.zeros((count, u + 1))
    known = np.zeros((count, u))
    for b in range(batch):
        for n in range(stations):
            _gather(residual[b, n], first[b, n], second[b, n], shared[b, n], rows)
            _factor(own[b, n], lower)
            _project(own[b, n], lower, removing)
            weighed[:] = 0.0
            known[:] = 0.0
            for m in range(count):
                for k in range(count):
                    value = 1.0 if m == k else 0.0
                    for i in range(a):
                        value -= removing[i, m] * removing[i, k]
                    weight[m, k] = value
                    for i in range(u + 1):
                        weighed[m, i] += value * rows[k, i]
            for m in range(count):
                left[b, n, m] = weighed[m, u]
                for i in range(u):
                    value = weighed[m, i]
                    for j in range(u):
                        known[m, j] += value * covariance[b, i, j]
            for m in range(count):
                for k in range(count):
                    value = weight[m, k]
                    for i in range(u):
                        value -= known[m, i] * weighed[k, i]
                    spread[b, n, m, k] = value


@compiled
def _inverse(matrix: Array, out: Array) -> None:
    """Inverse of a 3 × 3 matrix by its cofactors; NaN for a singular one."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            out[m, i] = matrix[j, n] * matrix[k, o] - matrix[j, o] * matrix[k, n]
    size = matrix[0, 0] * out[0, 0] + matrix[0, 1] * out[1, 0] + matrix[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] = out[i, j] / size if size != 0.0 else np.nan


@compiled
def _misfit(back: Array, departure: Array, out: Array) -> None:
    """Misfit of the reading: inverse slope times the departure of the field."""
    for i in range(3):
        out[i] = back[i, 0] * departure[0] + back[i, 1] * departure[1] + back[i, 2] * departure[2]


@compiled
def polynomial(
    params: Array, phi: Array, raw: Array, target: Array, centre: Array, scale: Array,
    curved: bool, back: Array, misfit: Array, by_params: Array,
) -> None:  # fmt: skip
    """`Polynomial` at every station: inverse slope, misfit, derivatives at the predicted reading."""
    batch, stations, count = phi.shape
    terms, slope, departure, x = np.zeros(12), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    last = 12 * count
    for b in range(batch):
        p = params[b]
        for n in range(stations):
            terms[:] = 0.0
            for k in range(count):
                for i in range(12):
                    terms[i] += phi[b, n, k] * p[12 * k + i]
            for j in range(3):
                x[j] = (raw[b, n, j] - centre[b, 0, j]) / scale[b, 0, j]
            for i in range(3):
                total = terms[9 + i] - target[b, n, i]
                for j in range(3):
                    total += terms[3 * i + j] * x[j]
                    slope[i, j] = terms[3 * i + j] / scale[b, 0, j]
                if curved:
                    square, cube = p[last + i], p[last + 3 + i]
                    total += (square + cube * x[i]) * x[i] * x[i]
                    slope[i, i] += (2 * square + 3 * cube * x[i]) * x[i] / scale[b, 0, i]
                departure[i] = total
            _inverse(slope, back[b, n])
            _misfit(back[b, n], departure, misfit[b, n])
            for j in range(3):
                x[j] -= misfit[b, n, j] / scale[b, 0, j]
            for m in range(3):
                row = by_params[b, n, m]
                for i in range(3):
                    value = back[b, n, m, i]
                    for k in range(count):
                        for j in range(3):
                            row[12 * k + 3 * i + j] = value * phi[b, n, k] * x[j]
                        row[12 * k + 9 + i] = value * phi[b, n, k]
                    if curved:
                        row[last + i] = value * x[i] * x[i]
                        row[last + 3 + i] = value * x[i] * x[i] * x[i]


@compiled
def factors(
    params: Array, phi: Array, raw: Array,
    target: Array, back: Array, misfit: Array, by_params: Array,
) -> None:  # fmt: skip
    """`Factors` at every station: inverse slope, misfit, derivatives at the predicted reading."""
    batch, stations, count = phi.shape
    both, unit, mixing = np.zeros((2, 3)), np.zeros(3), np.eye(3)
    slope, departure = np.zeros((3, 3)), np.zeros(3)
    for b in range(batch):
        p, at = params[b], 6 * count
        for i in range(3):
            for j in range(3):
                if i != j:
                    mixing[i, j] = -p[at]
                    at += 1
        for n in range(stations):
            for s in range(2):
                for i in range(3):
                    both[s, i] = 0.0
                    for k in range(count):
                        both[s, i] += phi[b, n, k] * p[(3 * s + i) * count + k]
            for j in range(3):
                unit[j] = raw[b, n, j] / both[0, j] - both[1, j]
            for i in range(3):
                departure[i] = -target[b, n, i]
                for j in range(3):
                    departure[i] += mixing[i, j] * unit[j]
                    slope[i, j] = mixing[i, j] / both[0, j]
            _inverse(slope, back[b, n])
            _misfit(back[b, n], departure, misfit[b, n])
            for j in range(3):
                unit[j] = (raw[b, n, j] - misfit[b, n, j]) / both[0, j] - both[1, j]
            for m in range(3):
                row, at = by_params[b, n, m], 6 * count
                for j in range(3):
                    value = 0.0
                    for i in range(3):
                        value += back[b, n, m, i] * mixing[i, j]
                    grown = (unit[j] + both[1, j]) / both[0, j]
                    for k in range(count):
                        row[j * count + k] = -value * grown * phi[b, n, k]
                        row[(3 + j) * count + k] = -value * phi[b, n, k]
                for i in range(3):
                    for j in range(3):
                        if i != j:
                            row[at] = -back[b, n, m, i] * unit[j]
                            at += 1


@compiled
def turned(back: Array, target: Array, attitude: Array, change: Array, turn: Array, earth: Array,
           strength: Array) -> None:  # fmt: skip
    """Derivatives by a turn of the station and by gravity, field and dip; size of the field, raw."""
    batch, stations = target.shape[:2]
    moved = np.zeros((3, 3))
    for b in range(batch):
        for n in range(stations):
            x, y, z = target[b, n]
            for i in range(3):
                for j in range(3):
                    moved[i, j] = 0.0
                    for k in range(3):
                        moved[i, j] -= attitude[b, n, i, k] * change[b, n, k, j]
            total = 0.0
            for m in range(3):
                p, q, r = back[b, n, m]
                turn[b, n, m, 0] = q * z - r * y
                turn[b, n, m, 1] = r * x - p * z
                turn[b, n, m, 2] = p * y - q * x
                total += (p * x + q * y + r * z) ** 2
                for j in range(3):
                    earth[b, n, m, j] = p * moved[0, j] + q * moved[1, j] + r * moved[2, j]
            strength[b, n] = np.sqrt(total)
