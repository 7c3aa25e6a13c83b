"""Attitudes and the two reference vectors, in the tool frame of SPE 67616.

Frame: right-handed, z along the tool downhole, y the toolface scribe, x to the left of y
looking downhole. The earth frame is x magnetic north, y magnetic east, z down. Gravity
points down: a vertical tool reads gz = +|g|. Dip is positive down.

All functions broadcast over leading axes; the component axis is last.

Directions of the tool axis in the earth frame, and how they scatter within groups that share one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
ArrayLike = npt.ArrayLike
AnyArray = npt.NDArray[Any]
LEAST_HALF = 5
"""A matrix is inverted by halves where these have so many rows."""
_CROSS_PRODUCTS = np.cross(np.eye(3)[:, None], np.eye(3)).mT.reshape(3, 9)
"""The matrices of the cross product with each axis, row by row."""


def distinct(values: AnyArray, axis: int | None = None) -> AnyArray:
    """The different values in order, or rows of an axis: `np.unique` without loading masked arrays, 10 ms."""
    return np.unique(values, return_counts=True, axis=axis)[0]


def as_slice(index: Ints) -> Ints | slice:
    """Places in order as a slice where no other is between them: what is there is then a view, not a copy."""
    first, last = int(index[0]), int(index[-1])
    return slice(first, last + 1) if last - first == len(index) - 1 else index


def wrap(angle: ArrayLike, period: float = 2 * np.pi) -> Array:
    """An angle in [0, period): azimuths and toolfaces as the industry writes them."""
    return np.asarray(np.mod(angle, period), float)


def centred(angle: ArrayLike, period: float = 2 * np.pi) -> Array:
    """An angle difference in [-period/2, period/2)."""
    return np.asarray(np.mod(np.asarray(angle) + period / 2, period) - period / 2, float)


def tool_from_earth(inclination: ArrayLike, azimuth: ArrayLike, toolface: ArrayLike) -> Array:
    """Attitude matrix (..., 3, 3) that turns earth vectors (north, east, down) into tool vectors.

    Units: radians. Reference: SPE 67616; defined everywhere (at vertical only
    azimuth + toolface matters).
    """
    inc, azi, tool = np.broadcast_arrays(inclination, azimuth, toolface)
    ci, si, ca, sa = np.cos(inc), np.sin(inc), np.cos(azi), np.sin(azi)
    ct, st = np.cos(tool), np.sin(tool)
    rows = [
        *(ci * ca * st + sa * ct, ci * sa * st - ca * ct, -si * st),
        *(ci * ca * ct - sa * st, ci * sa * ct + ca * st, -si * ct),
        *(si * ca, si * sa, ci),
    ]
    return np.stack(rows, -1).reshape(*inc.shape, 3, 3)


def earth_gravity(gravity: ArrayLike) -> Array:
    """Gravity (..., 3) in the earth frame: straight down, in the unit of `gravity`."""
    g = np.asarray(gravity, float)
    return np.stack([np.zeros_like(g), np.zeros_like(g), g], -1)


def earth_field(field: ArrayLike, dip: ArrayLike) -> Array:
    """Geomagnetic field (..., 3) in the earth frame; `dip` in radians, positive down."""
    b, d = np.broadcast_arrays(np.asarray(field, float), np.asarray(dip, float))
    return np.stack([b * np.cos(d), np.zeros_like(b), b * np.sin(d)], -1)


def reference_vectors(
    inclination: ArrayLike,
    azimuth: ArrayLike,
    toolface: ArrayLike,
    gravity: ArrayLike = 1.0,
    field: ArrayLike = 1.0,
    dip: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Gravity and magnetic vector (..., 3) each that a perfect tool reads at an attitude.

    Units: radians; the vectors have the units of `gravity` and `field`.
    """
    attitude = tool_from_earth(inclination, azimuth, toolface)
    g = np.einsum("...ij,...j->...i", attitude, earth_gravity(gravity))
    b = np.einsum("...ij,...j->...i", attitude, earth_field(field, dip))
    return g, b


def dot(first: Array, second: Array) -> Array:
    """Scalar products (...) of vectors (..., 3): the sum of three products, without a loop over each vector."""
    x, y, z = (first[..., k] * second[..., k] for k in range(3))
    return np.asarray(x + y + z)


def length(vector: Array) -> Array:
    """Lengths (...) of vectors (..., 3), the digits of `np.linalg.norm` in a tenth of its time."""
    return np.asarray(np.sqrt(dot(vector, vector)))


def over_stations(values: Array) -> Array:
    """Sums (..., k) over the stations of values (..., n, k), the digits of `np.sum` in a quarter of its time."""
    return np.asarray(np.einsum("...nk->...k", values))


def skew(vector: Array) -> Array:
    """The matrix (..., 3, 3) of the cross product: skew(a) @ b = a × b."""
    return np.asarray((vector @ _CROSS_PRODUCTS).reshape(*vector.shape, 3))


def rotation(turn: Array) -> Array:
    """Rotation matrix (..., 3, 3) of a rotation vector (..., 3), radians (Rodrigues)."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    cross = skew(turn)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half * half * (cross @ cross)
    )


def diagonal(matrix: Array) -> Array:
    """Diagonal (..., k) of every matrix of a stack (..., k, k), as a view."""
    return np.diagonal(matrix, axis1=-2, axis2=-1)


def outer(first: Array, second: Array | None = None) -> Array:
    """Products (..., j, k) of the elements of two vectors, or of one with itself."""
    second = first if second is None else second
    return np.asarray(first[..., :, None] * second[..., None, :])


def quotient(numerator: Array, denominator: Array, where: Bools) -> Array:
    """The quotient, and zero elsewhere than `where`."""
    return np.where(where, numerator / np.where(where, denominator, 1.0), 0.0)


def nearest_rotation(matrix: Array) -> Array:
    """Rotation (..., 3, 3) nearest to a matrix in least squares: its polar factor.

    Singular: where the polar factor is a reflection, the axis of least gain is turned back.
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    signs = np.stack([np.ones_like(sign), np.ones_like(sign), sign], -1)
    return np.asarray((u * signs[..., None, :]) @ vt)


def inverse(matrix: Array) -> Array:
    """Inverse (..., k, k) of every matrix of a stack; NaN for a singular one, never an exception."""
    return _each(np.linalg.inv, matrix)


def inverse_of_positive(matrix: Array) -> Array:
    """Inverse of symmetric positive matrices (..., k, k), by halves: two thirds of the time from 20 rows on."""
    half = matrix.shape[-1] // 2
    if half < LEAST_HALF:
        return inverse(matrix)
    first, across = matrix[..., :half, :half], matrix[..., :half, half:]
    top = inverse_of_positive(first)
    taken = top @ across
    low = inverse_of_positive(matrix[..., half:, half:] - across.mT @ taken)
    pulled, whole = taken @ low, np.empty(matrix.shape)
    whole[..., :half, :half], whole[..., half:, half:] = top + pulled @ taken.mT, low
    whole[..., :half, half:], whole[..., half:, :half] = -pulled, -pulled.mT
    return whole


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def inverse_of_three(matrix: Array) -> Array:
    """Inverse of symmetric matrices (..., 3, 3) by cofactors; not finite where one is singular.

    A tenth of the time of `inverse`, and less exact where a matrix is almost singular.
    """
    (a, b, c), (_, d, e), (_, _, f) = np.moveaxis(matrix, (-2, -1), (0, 1))
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    yz = b * c - a * e
    rows = (xx, xy, xz, xy, a * f - c * c, yz, xz, yz, a * d - b * b)
    back = np.stack(rows, -1) / (a * xx + b * xy + c * xz)[..., None]
    return np.asarray(back.reshape(matrix.shape))


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def quadratic_form(matrix: Array, vector: Array) -> Array:
    """xᵀM⁻¹x (...) of vectors (..., k) and symmetric matrices (..., k, k), by elimination.

    Not finite where a matrix is not positive. Half the time of `inverse` for six rows.
    """
    rows, right = np.moveaxis(matrix, (-2, -1), (0, 1)).copy(), np.moveaxis(vector, -1, 0).copy()
    total = np.zeros(right.shape[1:])
    for k in range(len(right)):
        total += right[k] ** 2 / np.where(rows[k, k] > 0, rows[k, k], np.nan)
        share = rows[k, k + 1 :] / rows[k, k]
        right[k + 1 :] -= share * right[k]
        rows[k + 1 :, k + 1 :] -= share[:, None] * rows[k, k + 1 :]
    return total


def are_positive(matrix: Array) -> Bools:
    """Which symmetric matrices (..., 3, 3) have positive eigenvalues alone: their minors are positive."""
    (a, b, c), (_, d, e), (_, _, f) = np.moveaxis(matrix, (-2, -1), (0, 1))
    minor = a * d - b * b
    whole = minor * f - a * e * e - d * c * c + 2 * b * c * e
    return np.asarray((a > 0) & (minor > 0) & (whole > 0))


def solved(matrix: Array, right: Array) -> Array:
    """Solutions (..., k, m) of matrix x = right; NaN for a singular matrix, never an exception."""
    return _each(np.linalg.solve, matrix, right)


def _each(operation: Callable[..., Array], matrix: Array, *right: Array) -> Array:
    """An operation on a stack of matrices, NaN where one is singular or not finite."""
    try:
        return np.asarray(operation(matrix, *right))
    except np.linalg.LinAlgError:
        with np.errstate(all="ignore"):
            sound = np.isfinite(np.linalg.slogdet(matrix)[1])[..., None, None]
        whole = np.where(sound, matrix, np.eye(matrix.shape[-1]))
        return np.where(sound, operation(whole, *right), np.nan)


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (..., k), smallest first, and vectors of symmetric matrices; zero for not finite."""
    values, vectors = np.linalg.eigh(finite(matrix))
    return np.asarray(values), np.asarray(vectors)


def square_root(covariance: Array) -> Array:
    """A matrix (p, k) whose product with its transpose is a covariance (p, p) of quantities in any units.

    Each is scaled to a variance of 1 first: the rounding of the largest would otherwise drown the smallest.
    """
    scale = np.sqrt(np.diagonal(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = eigen(covariance / scale / scale[:, None])
    kept = values > 0
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def eigenvalues(matrix: Array) -> Array:
    """Eigenvalues (..., k) alone, smallest first: half the work."""
    return np.asarray(np.linalg.eigvalsh(finite(matrix)))


def finite(matrix: Array) -> Array:
    """The matrix with zero for what is not finite."""
    return matrix if np.isfinite(matrix).all() else np.nan_to_num(matrix, posinf=0.0, neginf=0.0)


def directions(g: Array, b: Array) -> Array:
    """Unit vector (..., 3) of the tool axis in the earth frame: north, east, down.

    Singular: where field and gravity are parallel (a magnetic pole) there is no north.
    """
    down = g / np.linalg.norm(g, axis=-1, keepdims=True)
    east = np.cross(down, b)
    with np.errstate(invalid="ignore"):  # a vertical direction has no east
        east = east / np.linalg.norm(east, axis=-1, keepdims=True)
    north = np.cross(east, down)
    return np.stack([north[..., 2], east[..., 2], down[..., 2]], -1)


def group_scatter(axis: Array, group: Ints) -> float:
    """Mean over groups of the norm of the (N - 1) standard deviations of `axis`, radians.

    Shapes: axis (n, 3), NaN if unknown; group (n,), -1: in no group. NaN without a group
    of two. Reference: the accuracy measure of CircuitPython_mag_cal, so that results compare.
    """
    group = np.where(np.isnan(axis).any(-1), -1, group)
    each = [axis[group == k] for k in distinct(group[group >= 0])]
    spread = [np.linalg.norm(v.std(axis=0, ddof=1)) for v in each if len(v) > 1]
    return float(np.mean(spread)) if spread else float("nan")
