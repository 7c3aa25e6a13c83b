"""Statistics of a roll test: the error of a tool over a turn of toolface, without noise.

A tool's error is smooth in toolface: a bias across the tool axis is the first harmonic, a
difference of scales or a misalignment of x and y the second. So a mean and two harmonics
are fitted to the values of a roll set, and judged instead of the largest and the smallest
value, which noise drives apart. Arrays in, arrays out; angles are radians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mwdcal.calibration.residuals import tail
from mwdcal.geometry.vectors import Array, Bools, eigen, inverse

HARMONICS = np.arange(1, 3)
COEFFICIENTS = 1 + 2 * len(HARMONICS)
WIDEST_GAP = np.radians(90.0)
"""The widest part of the circle without a toolface that a roll test may have."""
OPEN = np.radians(120.0)
"""The widest part of the circle without a toolface on which limits on errors can be passed."""
SLACK = np.radians(5.0)
"""Tolerance of a gap: toolfaces set by hand are off by some degrees."""
CARRIED = 2.0
"""Largest standard uncertainty of the curve anywhere on the circle, in noises of one reading."""
DEPARTURE_CHANCE = 1e-3
"""Residuals from the curve that are less likely than this are not noise alone."""
CURVE_POINTS = 120
"""Toolfaces at which a curve is evaluated: its range is at most 0.14 % too small."""
PAIRS = 500
RANDOM_SEED = 1


@dataclass(frozen=True)
class Coverage:
    """How toolfaces (..., n) cover the circle: the widest gap (...), and where it starts.

    `carried`: largest standard uncertainty of the curve over the circle, in noises of one
    reading; infinite where the toolfaces do not determine its five coefficients. `seen`
    (..., 2): share of the amplitude of each harmonic that the toolfaces show at the least
    favourable phase.
    """

    gap: Array
    start: Array
    carried: Array
    seen: Array

    @property
    def rolled(self) -> Bools:
        """Whether the toolfaces determine a curve of two harmonics all round."""
        return np.asarray((self.gap <= WIDEST_GAP + SLACK) & (self.carried <= CARRIED))


@dataclass(frozen=True)
class Curve:
    """Mean and two harmonics fitted to a roll set.

    Shapes: coefficients (..., 5): mean, cosines, sines; covariance (..., 5, 5); square (...): χ²
    of the residuals with `freedom` degrees of freedom.
    """

    coefficients: Array
    covariance: Array
    square: Array
    freedom: int

    def at(self, toolface: Array) -> Array:
        """Values (..., n) at toolfaces (n,)."""
        return self.coefficients @ basis(toolface).swapaxes(-1, -2)

    @property
    def amplitudes(self) -> Array:
        """Amplitude (..., 2) of the first and second harmonic."""
        return np.hypot(self.coefficients[..., 1:3], self.coefficients[..., 3:])

    @property
    def amplitude_sd(self) -> Array:
        """Standard uncertainty (..., 2) of the amplitudes: root mean square of both parts."""
        variance = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.sqrt((variance[..., 1:3] + variance[..., 3:]) / 2)

    @property
    def rough(self) -> Bools:
        """Where the residuals are larger than noise alone would give: the error is not smooth."""
        return np.asarray(self._chance() < DEPARTURE_CHANCE)

    @property
    def calm(self) -> Bools:
        """Where the residuals are smaller than the stated noise would give: it is overstated."""
        return np.asarray((self._chance() > 1 - DEPARTURE_CHANCE) & (self.freedom > 0))

    @property
    def scale(self) -> Array:
        """Residuals divided by what noise alone would give (...); 1 without degrees of freedom."""
        return np.sqrt(self.square / self.freedom) if self.freedom else np.ones(self.square.shape)

    def _chance(self) -> Array:
        return tail(self.square, np.full(self.square.shape, self.freedom))


@dataclass(frozen=True)
class Extent:
    """Noise-free range (...) of a curve over the circle, its largest departure from zero, and 1σ."""

    range: Array
    range_sd: Array
    largest: Array
    largest_sd: Array


def basis(toolface: Array) -> Array:
    """Values (..., n, 5) of the functions fitted: 1, cos t, cos 2t, sin t, sin 2t."""
    angle = toolface[..., None] * HARMONICS
    return np.concatenate([np.ones((*toolface.shape, 1)), np.cos(angle), np.sin(angle)], -1)


CIRCLE = np.arange(CURVE_POINTS) * 2 * np.pi / CURVE_POINTS


def coverage(toolface: Array) -> Coverage:
    """How toolfaces (..., n) cover the circle."""
    ordered, steps = _steps(toolface, 2 * np.pi)
    halves = [_steps(k * toolface, np.pi)[1].max(-1) for k in HARMONICS]
    widest = np.argmax(steps, -1)[..., None]
    rows = basis(toolface)
    information = np.swapaxes(rows, -1, -2) @ rows / toolface.shape[-1]
    least = np.linalg.eigvalsh(information)[..., 0]
    whole = least > 1e-9
    safe = np.where(whole[..., None, None], information, np.eye(COEFFICIENTS))
    variance = np.einsum("gi,...ij,gj->...g", basis(CIRCLE), inverse(safe), basis(CIRCLE)).max(-1)
    return Coverage(
        gap=np.take_along_axis(steps, widest, -1)[..., 0],
        start=np.take_along_axis(ordered, widest, -1)[..., 0],
        carried=np.where(whole, np.sqrt(variance / toolface.shape[-1]), np.inf),
        seen=np.cos(np.stack(halves, -1) / 2),
    )


def _steps(angle: Array, period: float) -> tuple[Array, Array]:
    """Angles (..., n) in order, and the step from each to the next, the last round to the first."""
    ordered = np.sort(np.mod(angle, period), -1)
    return ordered, np.diff(ordered, append=ordered[..., :1] + period, axis=-1)


def fitted(value: Array, sd: Array, toolface: Array) -> Curve:
    """The curve through values (..., n) of independent `sd` (..., n) at toolfaces (..., n).

    Singular: the toolfaces must determine five coefficients (`Coverage.rolled`).
    """
    rows = basis(toolface) / sd[..., None]
    seen = value / sd
    covariance = inverse(np.swapaxes(rows, -1, -2) @ rows)
    coefficients = np.einsum("...ij,...nj,...n->...i", covariance, rows, seen)
    left = seen - np.einsum("...ni,...i->...n", rows, coefficients)
    return Curve(coefficients, covariance, np.sum(left**2, -1), value.shape[-1] - COEFFICIENTS)


def extent(curve: Curve) -> Extent:
    """Range and largest departure over the whole circle, corrected for the bias by noise.

    Definition (parametric bootstrap): both are computed for the fitted curve, c, and for many
    curves drawn about it with its covariance. 2 c - (their mean) is the noise-free value, at least
    0; their root mean square distance from c, which includes the correction, is its standard
    uncertainty. The draws are always the same. Where the stated noise is far above that of the
    residuals, the latter is used.
    """
    scale = np.where(curve.calm, curve.scale, 1.0)
    root = _root(curve.covariance) * scale[..., None, None]
    moved = np.einsum("...ij,dj->...di", root, _draws())
    wide, far = _measures(curve.coefficients[..., None, :] + moved)
    return Extent(*_corrected(wide), *_corrected(far))


def _corrected(drawn: Array) -> tuple[Array, Array]:
    """The first of (..., d) values without the bias of the others, and its standard uncertainty."""
    curve, bias = drawn[..., 0], drawn[..., 1:] - drawn[..., :1]
    return np.maximum(curve - bias.mean(-1), 0.0), np.sqrt(np.mean(bias**2, -1))


@dataclass(frozen=True)
class Figure:
    """Spread of an observable in roll sets (...), or its largest error: without noise, its 1σ, and `raw` with it."""

    value: Array
    uncertainty: Array
    raw: Array
    curve: Curve


def figure(part: Array, sd: Array, toolface: Array, error: bool) -> Figure:
    """The figure to judge of values (..., n) about their middle, or of errors, of independent `sd`.

    Definition: range or largest departure of the curve, by `extent`; where the error is not smooth, the raw figure.
    """
    curve = fitted(part, sd, toolface)
    turn = extent(curve)
    raw = np.abs(part).max(-1) if error else np.ptp(part, axis=-1)
    value, noise = (turn.largest, turn.largest_sd) if error else (turn.range, turn.range_sd)
    rough = curve.rough
    sd = np.where(rough, noise * curve.scale, noise)
    return Figure(np.where(rough, raw, value), sd, raw, curve)


def ends(curve: Curve) -> tuple[Array, Array, Array]:
    """Toolfaces (...) where the curve is greatest, least, and farthest from zero."""
    course = curve.at(CIRCLE)
    farthest = np.abs(course).argmax(-1)
    return CIRCLE[course.argmax(-1)], CIRCLE[course.argmin(-1)], CIRCLE[farthest]


def about_middle(curve: Curve) -> tuple[Curve, Array]:
    """The curve less the middle (...) between its greatest and its least value, and that middle."""
    course = curve.at(CIRCLE)
    middle = (course.max(-1) + course.min(-1)) / 2
    first = np.arange(COEFFICIENTS) == 0
    return replace(curve, coefficients=curve.coefficients - middle[..., None] * first), middle


def _measures(coefficients: Array) -> tuple[Array, Array]:
    """Range and largest departure (..., d) of curves (..., d, 5), one toolface at a time."""
    most = np.full(coefficients.shape[:-1], -np.inf)
    least = -most
    for row in basis(CIRCLE):
        value = coefficients @ row
        np.maximum(most, value, out=most)
        np.minimum(least, value, out=least)
    return most - least, np.maximum(np.abs(most), np.abs(least))


def _root(covariance: Array) -> Array:
    """Matrices (..., 5, 5) whose product with their transpose is the covariance; NaN without one."""
    values, vectors = eigen(covariance)
    known = np.isfinite(covariance).all((-1, -2), keepdims=True)
    return np.where(known, vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :], np.nan)


@cache
def _draws() -> Array:
    """Zero, then draws (2 · PAIRS, 5) in opposite pairs, of mean zero and covariance one exactly."""
    drawn = np.random.default_rng(RANDOM_SEED).normal(size=(PAIRS, COEFFICIENTS))
    square = drawn.swapaxes(-1, -2) @ drawn / PAIRS
    even = np.linalg.solve(np.linalg.cholesky(square), drawn.swapaxes(-1, -2)).swapaxes(-1, -2)
    return np.concatenate([np.zeros((1, COEFFICIENTS)), even, -even])
