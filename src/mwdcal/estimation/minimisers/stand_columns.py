"""Columns of the unknowns of runs on a stand, and sums over their stations.

A column is a direction of a station's readings times a course over the stations. Of a parameter: one reading, times an
element of f̃ = [f 1]; of a term of a drift: what a unit of its axis does, times a cosine that all tools have in common.
Sums of XᵀMX over the stations are therefore products of the elements of M with products of courses.

Arrays are (component, B, n) where not said otherwise: each step goes over all tools and stations at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import prod

import numpy as np

from mwdcal.geometry.vectors import Array

TRIAD_ROWS = (slice(0, 3), slice(3, 6))
"""Rows of a station's six readings that are each triad's."""
FIELD_WALK = 2
"""Number of the walk of the field; the others are of the offsets of a triad."""
OF_PARAMETERS = 24
"""Number of the elements of Φ of both triads."""


def summed(*factors: Array) -> Array:
    """The product of arrays (..., B, n) summed for each tool (B,), in one order whatever the number of tools."""
    each = np.sum(prod(factors), -1)
    return np.asarray(sum(each.reshape(-1, each.shape[-1])))


def by_tool(components: Array) -> Array:
    """Components (..., B, n) as (B, k, n)."""
    flat = components.reshape(-1, *components.shape[-2:])
    return np.moveaxis(flat, 1, 0)


def by_component(values: Array, *shape: int) -> Array:
    """Values (B, k, n) as components (shape, B, n)."""
    return np.moveaxis(values, 0, 1).reshape(*shape, len(values), values.shape[-1])


@dataclass(frozen=True)
class StandColumns:
    """Columns of the elements of Φ of both triads, then of the terms of drifts, axis by axis.

    `terms` (2, 4, B, n) are f̃ of each triad, `weight` (6, B, n) is one over the noise of a reading. `axes` (6, a, B, n)
    are what a unit of each axis of the drifts adds to the whitened readings, `courses` (K, n) their terms.
    """

    terms: Array
    weight: Array
    axes: Array
    courses: Array

    @property
    def of_drifts(self) -> tuple[int, int]:
        """Number of axes of the drifts, and of the terms of each."""
        return self.axes.shape[1], len(self.courses)

    @cached_property
    def _pairs(self) -> dict[tuple[int, int], Array]:
        """Products (B, n, 16) of elements of f̃ of two triads."""
        pairs = {}
        for one, other in ((0, 0), (0, 1), (1, 1)):
            product = self.terms[one][:, None] * self.terms[other]
            pairs[one, other] = by_tool(product).mT
        return pairs

    @cached_property
    def _along(self) -> tuple[Array, Array]:
        """Products (B, 4 K, n) of f̃ of each triad with the courses of the drifts."""
        first, second = (by_tool(f[:, None] * self.courses[:, None]) for f in self.terms)
        return first, second

    @cached_property
    def _courses(self) -> Array:
        """Products (K K, n) of the courses."""
        return (self.courses[:, None] * self.courses).reshape(-1, self.courses.shape[-1])

    def axes_of(self, walks: Iterable[int], forward: Array, attitude: Array) -> Array:
        """What a unit of each axis of some walks, by their numbers, adds to the whitened readings (6, a, B, n).

        At Φ (B, 2, 3, 4) and attitudes (3, 3, B, n).
        """
        numbers = [*walks]
        axes = np.zeros((6, 3 * len(numbers), *self.weight.shape[1:]))
        for place, walk in enumerate(numbers):
            rows, unit = TRIAD_ROWS[min(walk, 1)], np.eye(3)[..., None, None]
            if walk == FIELD_WALK:
                unit = np.einsum("bij,jabn->iabn", forward[:, 1, :, :3], attitude)
            axes[rows, 3 * place : 3 * place + 3] = unit * self.weight[rows, None]
        return axes

    def gram(self, inner: Array) -> Array:
        """Sums XᵀMX (B, u, u) for the symmetric M (6, 6, B, n) of each station."""
        count = self.weight.shape[1]
        heavy = inner * self.weight[:, None]
        whole = np.empty((count, 2, 3, 4, 2, 3, 4))
        for (one, other), pair in self._pairs.items():
            rows, columns = TRIAD_ROWS[one], TRIAD_ROWS[other]
            each = by_tool(heavy[rows, columns] * self.weight[columns]) @ pair
            each = each.reshape(count, 3, 3, 4, 4)
            whole[:, one, :, :, other] = each.transpose(0, 1, 3, 2, 4)
            if one != other:
                whole[:, other, :, :, one] = each.transpose(0, 2, 4, 1, 3)
        of_params = whole.reshape(count, OF_PARAMETERS, OF_PARAMETERS)
        if not self.axes.size:
            return of_params
        across = self.crossed(inner)
        return np.block([[of_params, across], [across.mT, self.of_axes(inner)]])

    def crossed(self, inner: Array) -> Array:
        """Sums (B, 24, q) of XᵀMD over the stations, D being the columns of the drifts alone."""
        axes, terms = self.of_drifts
        moved = np.einsum("ij...,ja...->ia...", inner, self.axes) * self.weight[:, None]
        count, across = moved.shape[-2], []
        for rows, along in zip(TRIAD_ROWS, self._along, strict=True):
            each = by_tool(moved[rows]) @ along.mT
            across.append(each.reshape(count, 3, axes, 4, terms).swapaxes(2, 3))
        return np.stack(across, 1).reshape(count, OF_PARAMETERS, axes * terms)

    def with_others(self, weighed: Array) -> Array:
        """Sums (B, u, k) of Xᵀ times other columns (6, k, B, n), weighed, over the stations."""
        count, others = self.weight.shape[1], weighed.shape[1]
        heavy = weighed * self.weight[:, None]
        each = [
            (by_tool(heavy[rows]) @ by_tool(f).mT).reshape(count, 3, others, 4).swapaxes(2, 3)
            for rows, f in zip(TRIAD_ROWS, self.terms, strict=True)
        ]
        if self.axes.size:
            moved = np.einsum("ia...,ik...->ak...", self.axes, weighed)
            terms = by_tool(moved) @ self.courses.transpose()
            each.append(terms.reshape(count, len(self.axes[0]), others, -1).swapaxes(2, 3))
        return np.concatenate([part.reshape(count, -1, others) for part in each], 1)

    def of_axes(self, inner: Array) -> Array:
        """Sums DᵀMD (B, q, q) over the stations."""
        axes, terms = self.of_drifts
        moved = np.einsum("ij...,ja...->ia...", inner, self.axes)
        products = by_tool(np.einsum("ia...,ib...->ab...", self.axes, moved))
        each = (products @ self._courses.transpose()).reshape(-1, axes, axes, terms, terms)
        return each.swapaxes(2, 3).reshape(-1, axes * terms, axes * terms)

    def pull(self, values: Array) -> Array:
        """Sums (B, u) of Xᵀ times values (6, B, n) over the stations."""
        heavy = values * self.weight
        each = [
            by_tool(heavy[rows]) @ by_tool(f).mT
            for rows, f in zip(TRIAD_ROWS, self.terms, strict=True)
        ]
        if self.axes.size:
            each.append(
                by_tool(np.einsum("ia...,i...->a...", self.axes, values)) @ self.courses.transpose()
            )
        return np.concatenate([part.reshape(len(part), -1) for part in each], -1)

    def change(self, step: Array) -> Array:
        """What a step (B, u) of the unknowns does to the whitened readings (6, B, n)."""
        first = step[:, :OF_PARAMETERS].reshape(-1, 2, 3, 4)
        each = [by_component(first[:, t] @ by_tool(f), 3) for t, f in enumerate(self.terms)]
        change = np.concatenate(each) * self.weight
        if self.axes.size:
            of_drifts = step[:, OF_PARAMETERS:].reshape(-1, *self.of_drifts) @ self.courses
            change += np.einsum(
                "ia...,a...->i...", self.axes, by_component(of_drifts, len(self.axes[0]))
            )
        return change

    def spread(self, covariance: Array) -> Array:
        """Covariance (6, 6, B, n) of what Φ of a covariance (B, 24, 24) does to each station."""
        count, spread = len(covariance), np.empty((6, *self.weight.shape))
        of_params = covariance.reshape(count, 2, 3, 4, 2, 3, 4)
        for (one, other), pair in self._pairs.items():
            rows, columns = TRIAD_ROWS[one], TRIAD_ROWS[other]
            flat = of_params[:, one, :, :, other].transpose(0, 1, 3, 2, 4).reshape(count, 9, 16)
            each = by_component(flat @ pair.mT, 3, 3)
            each = each * self.weight[rows, None] * self.weight[columns]
            spread[rows, columns] = each
            spread[columns, rows] = each.swapaxes(0, 1)
        return spread

    def less(self, taken: Array) -> Array:
        """Columns (B, n, 6, q) of the drifts less what Φ takes of each, (B, 24, q)."""
        count, axes = len(taken), np.moveaxis(self.axes, (0, 1), (2, 3))
        whole = axes[..., None] * self.courses.transpose()[:, None, None]
        whole = whole.reshape(*whole.shape[:3], -1)
        each = taken.reshape(count, 2, 3, 4, -1).swapaxes(2, 3)
        for index, (rows, f) in enumerate(zip(TRIAD_ROWS, self.terms, strict=True)):
            part = by_tool(f).mT @ each[:, index].reshape(count, 4, -1)
            part = part.reshape(count, -1, 3, taken.shape[-1])
            whole[:, :, rows] -= part * by_tool(self.weight[rows]).mT[..., None]
        return whole
