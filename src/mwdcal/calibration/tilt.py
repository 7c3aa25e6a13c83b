"""The interval of an inclination near vertical, where its error is the length of a vector."""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array


def tilt_width(g: Array, spread: Array, width: Array, freedom: float, probability: float) -> Array:
    """Half width (…, n) of inclination: `width` away from vertical, that of a tilt near it.

    From gravity (…, n, 3) and the covariance `spread` (…, n, 2, 2) of its share across the tool axis.
    Definition: the tilt (gx, gy) / |g| has two errors, and with their larger uncertainty u its
    error is below k u, k² = ν ((1 - p)^(-2/ν) - 1), Hotelling's for two. The one takes over from
    the other between tilts of k u and 2 k u. Reference: JCGM 102, 7.
    """
    half, odd = (spread[..., 0, 0] + spread[..., 1, 1]) / 2, spread[..., 0, 1]
    largest = half + np.hypot((spread[..., 0, 0] - spread[..., 1, 1]) / 2, odd)
    factor = freedom * np.expm1(-2 / freedom * np.log1p(-probability))
    near = np.sqrt(np.maximum(largest, 0.0) * factor)
    tilt = np.linalg.norm(g[..., :2], axis=-1) / np.linalg.norm(g, axis=-1)
    share = np.clip(tilt / np.maximum(near, 1e-300) - 1, 0.0, 1.0)
    share = share**2 * (3 - 2 * share)
    return np.asarray(near + share * (width - near) + 0 * width)
