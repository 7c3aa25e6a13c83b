"""Readings as a linear function of known vectors: reading = S · vector + o + noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.geometry.vectors import Array, Bools, eigenvalues, inverse

SPANNED = 1e-6
"""Smallest eigenvalue of the normalised 4 × 4 information at which the vectors span space."""


@dataclass(frozen=True)
class Regression:
    """Weighted least squares of readings on vectors, axis by axis.

    `forward` (..., 4, 3): the transposed S in the first rows, o in the last; `terms` (..., n, 4): what
    they multiply, the vector and one. `cofactor` (..., 3, 4, 4) is the inverse information of each
    axis; `spanned` (...) says where the vectors determine it.
    """

    forward: Array
    terms: Array
    cofactor: Array
    spanned: Bools


def regress(raw: Array, vectors: Array, weight: Array) -> Regression:
    """S and o with the least weighted squared error in the readings (Moradi 12).

    Shapes: raw, vectors (..., n, 3); weight (..., n, 3), or (..., n, 1) for all axes alike.
    Singular: vectors that do not span space about their mean (fewer than four stations, or all in
    a plane) leave `spanned` false; numbers are then NaN or mean nothing.
    """
    terms = np.concatenate([vectors, np.ones_like(vectors[..., :1])], -1)
    size = np.sqrt(np.einsum("...na,...ni->...ai", weight, terms**2))
    size = np.where(size > 0, size, 1.0)
    scaled = terms[..., None, :, :] / size[..., None, :]
    weighed = scaled * weight.mT[..., None]
    information = weighed.mT @ scaled
    sums = scaled.mT @ (weight * raw)[..., None, :, :]
    cofactor = inverse(information)
    by_axis = cofactor @ sums / size[..., None]
    by_axis = np.broadcast_to(by_axis, (*by_axis.shape[:-3], 3, 4, 3))
    forward = np.diagonal(by_axis, axis1=-3, axis2=-1).copy()
    cofactor = cofactor / (size[..., :, None] * size[..., None, :])
    spanned = np.all(eigenvalues(information)[..., 0] > SPANNED, -1)
    cofactor = np.broadcast_to(cofactor, (*cofactor.shape[:-3], 3, 4, 4))
    return Regression(forward, terms, cofactor, spanned)
