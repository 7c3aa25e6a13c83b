"""Factors at exactly known references: least squares axis by axis.

Moosavi's model of one triad,

    raw = SF(τ) [(I - m)⁻¹ v + B(τ)],

comes apart by axis. With N = (I - m)⁻¹ and all shares of its diagonal element Nᵢᵢ,

    rawᵢ = sᵢ(τ) [vᵢ + Σⱼ uᵢⱼ vⱼ + bᵢ(τ)],    s = SF Nᵢᵢ,  u = Nᵢⱼ / Nᵢᵢ,  b = B / Nᵢᵢ

which is one small bilinear problem for each axis: a few Gauss-Newton steps for 10 unknowns in place
of 30 or 60. The factors follow, and their covariance by the slope ∂(s, u, b)/∂(SF, B, m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mwdcal.estimation.batch import take
from mwdcal.estimation.problem import GEOMETRIC_NOISE, Triad
from mwdcal.geometry.vectors import Array, Bools, diagonal, eigenvalues, inverse, outer, solved
from mwdcal.sensor.models import OFF_COLUMNS, OFF_ROWS, factor_params, factor_parts

OTHERS = np.array([[1, 2], [0, 2], [0, 1]])
"""The two axes that an axis is misaligned with."""
MOST_STEPS = 12
"""Most steps to the minimum; a sound run takes three to five."""
LAST_STEP = 1e-8
"""Step, squared and in standard uncertainties, that is the last: steps shrink quadratically."""


@dataclass(frozen=True)
class Axes:
    """Runs of one triad (B), axis by axis: readings and references over the noise (B, 3, n).

    `phi` (B, 1, K, n) are the polynomials of temperature; `beside` (B, 3, K + 2, n) are the vector
    along the two other axes and φ, over the noise of the axis as `along` and `raw` are. Parameters left out
    are zero in them. `vectors` and `noise` are the references and the noise themselves.
    """

    phi: Array
    beside: Array
    along: Array
    raw: Array
    vectors: Array
    noise: Array

    @classmethod
    def of(cls, phi: Array, target: Array, raw: Array, sd: Array, include: Array) -> Axes:
        """From φ (B, n, K), vectors, readings and their noise (B, n, 3), and what counts (B, n)."""
        phi, along, raw, noise = (each.mT for each in (phi, target, raw, sd))
        root = include[:, None] / noise
        beside = np.empty((*noise.shape[:2], phi.shape[1] + 2, noise.shape[-1]))
        np.multiply(along[:, OTHERS], root[:, :, None], out=beside[:, :, :2])
        np.multiply(phi[:, None], root[:, :, None], out=beside[:, :, 2:])
        return cls(phi[:, None], beside, along * root, raw * root, along, noise)

    def predicted(self, unknowns: Array) -> tuple[Array, Array]:
        """Scale s(τ), and what it multiplies, v + uv + b(τ), over the noise; each (B, 3, n)."""
        count = self.phi.shape[-2]
        scale = (unknowns[..., None, :count] @ self.phi)[..., 0, :]
        return scale, self.along + (unknowns[..., None, count:] @ self.beside)[..., 0, :]

    def slopes(self, scale: Array, unit: Array) -> Array:
        """Derivatives (B, 3, 2K + 2, n) of the reading over its noise by s, u and b."""
        by = (unit[..., None, :] * self.phi, scale[..., None, :] * self.beside)
        return np.concatenate(by, -2)


@dataclass(frozen=True)
class Point:
    """The unknowns (B, 3, 2K + 2) after the last step, and what it began with.

    It is so short that scale and `rows`, the slopes, are those of the minimum; `left` are the
    residuals after it. `settled` (B,) says of which runs all axes came to their minimum.
    """

    unknowns: Array
    scale: Array
    rows: Array
    information: Array
    left: Array
    settled: Bools


def minimum(axes: Axes) -> Point:
    """Every axis at its minimum; a run that has settled waits for the others before its last step."""
    count = axes.phi.shape[-2]
    unknowns = np.zeros((len(axes.raw), 3, 2 * count + 2))
    unknowns[..., 0] = 1.0
    for turn in range(MOST_STEPS):
        scale, unit = axes.predicted(unknowns)
        rows = axes.slopes(scale, unit)
        left = axes.raw - scale * unit
        gradient = rows @ left[..., None]
        information = rows @ rows.mT
        step = solved(information, gradient)
        settled = np.all(np.sum(step * gradient, (-1, -2)) < LAST_STEP, -1) & (turn > 0)
        if settled.all():
            break
        unknowns = unknowns + np.where(settled[:, None, None], 0.0, step[..., 0])
        if turn == 0:  # linear so far: what goes with the scale is still times it
            unknowns[..., count:] /= unknowns[..., :1]
    left -= (step.mT @ rows)[..., 0, :]
    return Point(unknowns + step[..., 0], scale, rows, information, left, settled)


@dataclass(frozen=True)
class FactorsMinimum:
    """One triad at its minimum: factors (B, 6K + 6), their covariance, and what stations show.

    `left` (B, n, 3) are whitened residuals, `open` (B, n, 3) their expected variances; `known`
    are singular values (B, p) of the evidence, and norms (B, p) of its columns. `settled` (B,) says
    which runs came to their minimum.
    """

    params: Array
    covariance: Array
    left: Array
    open: Array
    known: tuple[Array, Array]
    settled: Bools


def minima(
    triads: Sequence[tuple[Triad, Array]], temperature: Array, include: Array
) -> list[FactorsMinimum]:
    """Every triad, with the vectors it should read, at its minimum.

    Triads of one order are done together.
    """
    if len({triad.model.basis.order for triad, _ in triads}) > 1:
        return [minima([pair], temperature, include)[0] for pair in triads]
    if not triads:
        return []
    count, phi = len(triads), triads[0][0].model.basis(temperature)
    axes = Axes.of(
        np.concatenate([phi] * count),
        np.concatenate([target for _, target in triads]),
        np.concatenate([triad.raw for triad, _ in triads]),
        np.concatenate([triad.sd for triad, _ in triads]),
        include := np.concatenate([include] * count),
    )
    whole, batch = _minimum(axes, minimum(axes), include), len(temperature)
    return [take(whole, slice(k * batch, (k + 1) * batch)) for k in range(count)]


def _minimum(axes: Axes, at: Point, include: Array) -> FactorsMinimum:
    """The analysis at the minimum."""
    spread = inverse(at.information)
    share = np.sum((spread @ at.rows) * at.rows, -2)
    params, shares, slope = factors(at.unknowns)
    batch, _, _, size = slope.shape
    back = inverse(slope.reshape(batch, size, size))
    by_axis = np.swapaxes(back.reshape(batch, size, 3, -1), 1, 2)
    moved = np.swapaxes(by_axis @ spread, 1, 2).reshape(batch, size, size)
    return FactorsMinimum(
        params,
        moved @ back.mT,
        at.left.mT,
        (include[:, None] - share).mT,
        _evidence(axes, at.rows, at.scale, shares, slope),
        at.settled,
    )


def known_at(axes: Axes, unknowns: Array) -> tuple[Array, Array]:
    """Singular values and norms (see `FactorsMinimum`) at some unknowns (B, 3, 2K + 2)."""
    scale, unit = axes.predicted(unknowns)
    _, shares, slope = factors(unknowns)
    return _evidence(axes, axes.slopes(scale, unit), scale, shares, slope)


def _evidence(
    axes: Axes, rows: Array, scale: Array, shares: Array, slope: Array
) -> tuple[Array, Array]:
    """Singular values and norms (see `FactorsMinimum`), at a noise that is a share of the field."""
    strength = np.linalg.norm(scale * (shares @ axes.vectors), axis=-2)[:, None]
    louder = axes.noise / (GEOMETRIC_NOISE * strength)
    rows *= louder[..., None, :]  # in place: they are large, and done with
    by_axis = rows @ rows.mT
    information = (slope.mT @ by_axis @ slope).sum(1)
    norms = np.sqrt(diagonal(information))
    norms = np.where(norms > 0, norms, 1.0)
    values = eigenvalues(information / outer(norms))
    return np.sqrt(np.clip(values, 0, None)), norms


def factors(unknowns: Array) -> tuple[Array, Array, Array]:
    """Factors (B, 6K + 6) of s, u, b (B, 3, 2K + 2), I + u (B, 3, 3), and ∂(s, u, b)/∂(SF, B, m)."""
    batch, count = len(unknowns), unknowns.shape[-1] // 2 - 1
    scale, cross, bias = np.split(unknowns, [count, count + 2], axis=-1)
    shares = np.broadcast_to(np.eye(3), (batch, 3, 3)).copy()
    shares[:, np.arange(3)[:, None], OTHERS] = cross
    back = inverse(shares)
    pivots = diagonal(back)
    params = factor_params(
        scale / pivots[..., None], bias * pivots[..., None], -back / pivots[:, None, :]
    )
    slope = np.zeros((batch, 3, 2 * count + 2, params.shape[-1]))
    scales, biases, misalignments = factor_parts(np.arange(params.shape[-1]))
    axis, k = np.arange(3)[:, None], np.arange(count)
    slope[:, axis, k, scales] = pivots[..., None]
    slope[:, axis, count + 2 + k, biases] = 1 / pivots[..., None]
    turn = shares * pivots[..., None]  # N; dN = N dm N
    pulled, moved = turn[:, :, OFF_ROWS] / pivots[..., None], turn[:, OFF_COLUMNS]
    grown = (pulled * moved.mT)[:, :, None]
    by_mixing = np.zeros((batch, 3, 2 * count + 2, 6))
    by_mixing[:, :, :count] = scale[..., None] * grown
    by_mixing[:, :, count + 2 :] = -bias[..., None] * grown
    each = pulled[:, :, None] * moved[:, :, OTHERS].transpose(0, 2, 3, 1)
    by_mixing[:, :, count : count + 2] = each - cross[..., None] * grown
    slope[..., misalignments[OFF_ROWS, OFF_COLUMNS]] = by_mixing
    return params, shares, slope
