"""Observables: scalars of the two tool vectors, each with its gradient, period and unit.

An observable is a function of gravity g (..., 3) and field b (..., 3). Gradients are
(..., 6): three components for g, then three for b. Adding an observable is one entry
in `OBSERVABLES`.

Singular: at exactly vertical attitudes toolface and azimuth do not exist (NaN);
inclination does, and its gradient there is the limit taken along toolface zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mwdcal.geometry.vectors import Array, ArrayLike, Bools, centred, dot, length, wrap

TITLES = {
    "gravity": "|g|",
    "inclination": "inclination",
    "toolface": "toolface·sin I",
    "azimuth": "azimuth·sin I",
    "field": "|b|",
    "dip": "dip",
}
"""How an observable's error is called: toolface and azimuth are weighted by sin I."""
OUTPUTS = {
    **{name: f"{name}_deg" for name in ("inclination", "azimuth", "toolface")},
    **{"gravity": "gravity_g", "field": "field_nt"},
    **{name: f"{name}_deg" for name in ("dip", "magnetic_toolface")},
}
"""Output column of each observable, in their order."""
VECTORS = ("gx_g", "gy_g", "gz_g", "bx_nt", "by_nt", "bz_nt")
RESULTS = (*VECTORS, *OUTPUTS.values())
"""Columns of a corrected reading, in their order."""
UNCERTAINTIES = tuple(f"sd_{column}" for column in OUTPUTS.values())
"""Columns of their standard uncertainties, those of `OUTPUTS`."""
EXTRAPOLATED = "extrapolated"
"""The column that says of each row whether it was extrapolated, where that is allowed."""
VERTICAL = 1e-12
"""A transverse share of gravity below this is an exactly vertical attitude."""


def is_vertical(g: Array) -> Bools:
    """Where the attitude is exactly vertical (..., ) as booleans."""
    return np.asarray(np.hypot(g[..., 0], g[..., 1]) <= VERTICAL * length(g))


def inclination(g: Array, b: Array) -> Array:
    """Angle between the tool axis and the vertical, 0…π."""
    return np.asarray(np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2]))


def toolface(g: Array, b: Array) -> Array:
    """Gravity (highside) toolface, 0…2π; NaN at vertical."""
    return np.where(is_vertical(g), np.nan, wrap(np.arctan2(-g[..., 0], -g[..., 1])))


def magnetic_toolface(g: Array, b: Array) -> Array:
    """Magnetic toolface, 0…2π: azimuth + toolface at vertical, used at low inclination."""
    return wrap(np.arctan2(b[..., 0], b[..., 1]))


def _north_parts(g: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """Gravity's direction u, 1 + u_z, the field t in a tool turned upright by the shortest way, and s.

    Definition: t = b - s u across the tool axis, s = (u·b + b_z) / (1 + u_z); without cancellation upside down.
    """
    upright = np.where(is_vertical(g) & (g[..., 2] < 0), np.nan, 1.0)[..., None]
    down = _unit(g) * upright
    x, y, z = np.moveaxis(down, -1, 0)
    lean = np.where(z < 0, (x**2 + y**2) / (1 - np.minimum(z, 0.0)), 1 + z)
    share = (x * b[..., 0] + y * b[..., 1]) / lean + b[..., 2]
    return down, lean, b - share[..., None] * down, share


def north_toolface(g: Array, b: Array) -> Array:
    """Angle from magnetic north to the toolface scribe, 0…2π: azimuth + toolface, which exists at vertical.

    Singular: NaN at 180° inclination, where azimuth - toolface matters instead.
    """
    _, _, turned, _ = _north_parts(g, b)
    return wrap(np.arctan2(turned[..., 0], turned[..., 1]))


def _azimuth_parts(g: Array, b: Array) -> tuple[Array, Array]:
    strength = length(g)
    east = (g[..., 0] * b[..., 1] - g[..., 1] * b[..., 0]) * strength
    along = g[..., 0] * b[..., 0] + g[..., 1] * b[..., 1]
    return east, b[..., 2] * (g[..., 0] ** 2 + g[..., 1] ** 2) - g[..., 2] * along


def azimuth(g: Array, b: Array) -> Array:
    """Magnetic azimuth of the tool axis, 0…2π; NaN at vertical."""
    return np.where(is_vertical(g), np.nan, wrap(np.arctan2(*_azimuth_parts(g, b))))


def dip(g: Array, b: Array) -> Array:
    """Angle of the field below the horizontal, -π/2…π/2 (through atan2: exact at the poles)."""
    down = dot(g, b)
    return np.asarray(np.arctan2(down, length(np.cross(g, b))))


def gravity(g: Array, b: Array) -> Array:
    """Strength of gravity."""
    return np.asarray(length(g))


def field(g: Array, b: Array) -> Array:
    """Strength of the magnetic field."""
    return np.asarray(length(b))


def _six(first: Array, second: Array) -> Array:
    return np.concatenate(np.broadcast_arrays(first, second), -1)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / length(vector)[..., None])


def _inclination_gradient(g: Array, b: Array) -> Array:
    vertical, across = is_vertical(g), np.hypot(g[..., 0], g[..., 1])
    safe = np.where(vertical, 1.0, across)
    x = np.where(vertical, 0.0, g[..., 0] / safe)
    y = np.where(vertical, -1.0, g[..., 1] / safe)
    down = g[..., 2]
    rows = np.stack([down * x, down * y, -across], -1) / dot(g, g)[..., None]
    return _six(rows, np.zeros_like(b))


def _toolface_gradient(g: Array, b: Array) -> Array:
    return _six(_turning(g, ~is_vertical(g)), np.zeros_like(b))


def _turning(vector: Array, exists: Bools | bool = True) -> Array:
    """Gradient (..., 3) of the angle of a vector's part across the tool axis; NaN if it has none."""
    x, y = vector[..., 0], vector[..., 1]
    square = np.where(exists, x**2 + y**2, np.nan)
    return np.stack([y, -x, np.zeros_like(x)], -1) / square[..., None]


def _azimuth_gradient(g: Array, b: Array) -> Array:
    east, north = _azimuth_parts(g, b)
    strength = length(g)
    (gx, gy, gz), (bx, by, bz) = np.moveaxis(g, -1, 0), np.moveaxis(b, -1, 0)
    zero, scaled = np.zeros_like(east), east / strength**2
    east_g = [strength * by + scaled * gx, -strength * bx + scaled * gy, scaled * gz]
    east_b = [-strength * gy, strength * gx, zero]
    north_g = [2 * bz * gx - gz * bx, 2 * bz * gy - gz * by, -(gx * bx + gy * by)]
    north_b = [-gz * gx, -gz * gy, gx**2 + gy**2]
    numerator = north[..., None] * np.stack([*east_g, *east_b], -1)
    numerator -= east[..., None] * np.stack([*north_g, *north_b], -1)
    square = east**2 + north**2
    square = np.where(is_vertical(g) | (square == 0), np.nan, square)
    return np.asarray(numerator / square[..., None])


def _north_toolface_gradient(g: Array, b: Array) -> Array:
    down, lean, turned, share = _north_parts(g, b)
    across = _turning(turned)
    axis = np.array([0.0, 0.0, 1.0])
    part = (dot(across, down) / lean)[..., None]
    of_down = -share[..., None] * (across - part * axis) - part * b
    of_down = of_down - dot(of_down, down)[..., None] * down
    return _six(of_down / length(g)[..., None], across - part * (down + axis))


def _dip_gradient(g: Array, b: Array) -> Array:
    strength = length(g)[..., None]
    total = length(b)[..., None]
    down, north = g / strength, b / total
    sine = dot(down, north)[..., None]
    cosine = length(np.cross(down, north))[..., None]
    return _six(
        (north - sine * down) / (strength * cosine), (down - sine * north) / (total * cosine)
    )


def variances(g: Array, b: Array, covariance: Array) -> Array:
    """Variances (7, …) of the observables of `OUTPUTS`, in their order.

    Definition: the gradients of `OBSERVABLES` on both sides of the covariance, written out with c = g × b, s = g · b:
    azimuth c |g| / c² by b and (g_z t - s c / c²) / |g| by g, t = (g_y, -g_x, 0) / (g_x² + g_y²), sign aside; dip
    (b - s g / g²) / |c| by g and (g - s b / b²) / |c| by b.
    Shapes: components first, g and b (3, …), as arrays of whole columns are; covariance (21, …): xx, xy, xz, yy, yz, zz
    of gravity, the same of the field, then xx, xy, xz, yx, … of gravity with the field.
    Units: squares of radians, g and nT. Singular: as the gradients.
    """
    of_g, of_b, of_both = covariance[:6], covariance[6:12], covariance[12:]
    (x, y, z), (bx, by, _) = g, b
    vertical = is_vertical(np.moveaxis(g, 0, -1))
    level, square, field_square = x * x + y * y, _product(g, g), _product(b, b)
    across = np.sqrt(level)
    safe = np.where(vertical, 1.0, across)
    steepest = np.where(vertical, 0.0, x / safe), np.where(vertical, -1.0, y / safe)
    level = np.where(vertical, np.nan, level)
    inclined = z * steepest[0], z * steepest[1], -across
    normal = g[1] * b[2] - z * by, z * bx - x * b[2], x * by - y * bx
    down, area = _product(g, b), _product(normal, normal)
    area = np.where(area == 0.0, np.nan, area)
    lean, tilt = z / level, -down / area
    turning = lean * y + tilt * normal[0], tilt * normal[1] - lean * x, tilt * normal[2]
    of_g_dip = [b[k] - down / square * g[k] for k in range(3)]
    of_b_dip = [g[k] - down / field_square * b[k] for k in range(3)]
    azimuths = (
        _form(of_g, turning) / square
        + _between(of_both, turning, normal) * (2.0 / area)
        + _form(of_b, normal) * (square / area**2)
    )
    dips = _form(of_g, of_g_dip) + 2.0 * _between(of_both, of_g_dip, of_b_dip)
    return np.stack(
        [
            _form(of_g, inclined) / square**2,
            azimuths,
            _turn(of_g, x, y) / level**2,
            _form(of_g, g) / square,
            _form(of_b, b) / field_square,
            (dips + _form(of_b, of_b_dip)) / area,
            _turn(of_b, bx, by) / (bx * bx + by * by) ** 2,
        ]
    )


_Triple = Array | Sequence[Array]
"""Three components (3, …)."""


def _product(v: _Triple, w: _Triple) -> Array:
    return np.asarray(v[0] * w[0] + v[1] * w[1] + v[2] * w[2])


def _form(symmetric: Array, v: _Triple) -> Array:
    """Form v · S v with S as its upper triangle (6, …)."""
    xx, xy, xz, yy, yz, zz = symmetric
    x, y, z = v
    tail = y * (y * yy + 2.0 * z * yz) + z * z * zz
    return np.asarray(x * (x * xx + 2.0 * (y * xy + z * xz)) + tail)


def _between(matrix: Array, v: _Triple, w: _Triple) -> Array:
    """Form v · M w with M (9, …) row by row."""
    return _product(v, [_product(matrix[k : k + 3], w) for k in (0, 3, 6)])


def _turn(symmetric: Array, x: Array, y: Array) -> Array:
    """The form of (y, -x, 0)."""
    return np.asarray(y * (y * symmetric[0] - 2.0 * x * symmetric[1]) + x * x * symmetric[3])


def _component(index: int, unit: str) -> Observable:
    return Observable(
        lambda g, b: _six(g, b)[..., index],
        lambda g, b: np.broadcast_to(np.eye(6)[index], _six(g, b).shape),
        0.0,
        unit,
    )


@dataclass(frozen=True)
class Observable:
    """A scalar of (g, b): value and gradient, its period (0: none) and its unit inside."""

    value: Callable[[Array, Array], Array]
    gradient: Callable[[Array, Array], Array]
    period: float
    unit: str

    def difference(self, value: Array, reference: ArrayLike) -> Array:
        """Value minus reference (...), angles with a period in the half turn about zero."""
        error = np.asarray(value - np.asarray(reference))
        return centred(error, self.period) if self.period else error


OBSERVABLES: dict[str, Observable] = {
    "inclination": Observable(inclination, _inclination_gradient, 0.0, "rad"),
    "toolface": Observable(toolface, _toolface_gradient, 2 * np.pi, "rad"),
    "azimuth": Observable(azimuth, _azimuth_gradient, 2 * np.pi, "rad"),
    "magnetic_toolface": Observable(
        magnetic_toolface, lambda g, b: _six(np.zeros_like(g), _turning(b)), 2 * np.pi, "rad"
    ),
    "north_toolface": Observable(north_toolface, _north_toolface_gradient, 2 * np.pi, "rad"),
    "gravity": Observable(gravity, lambda g, b: _six(_unit(g), np.zeros_like(b)), 0.0, "g"),
    "field": Observable(field, lambda g, b: _six(np.zeros_like(g), _unit(b)), 0.0, "nT"),
    "dip": Observable(dip, _dip_gradient, 0.0, "rad"),
    **{
        name: _component(index, "g" if index < 3 else "nT")
        for index, name in enumerate(("gx", "gy", "gz", "bx", "by", "bz"))
    },
}
