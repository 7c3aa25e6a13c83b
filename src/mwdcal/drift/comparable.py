"""Calibrations of one tool in the same parameters, whatever the form, order and units of each.

Of each triad they are factors over temperatures that all calibrations hold for: scale, bias and misalignments of
field = (I - m)(x / SF - B), with x in the axes and nominal scales of the latest calibration. Scale and bias are
compared as polynomials of temperature of the lowest order among the calibrations, misalignments at its middle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal
from mwdcal.sensor.models import OFF_COLUMNS, OFF_DIAGONAL, OFF_ROWS, Model

WALK_KINDS = ("scale", "bias", "misalignment")
"""Kinds of parameters of a triad, in their order; those of a kind drift alike."""
FACTOR_NAMES = (
    *(f"{kind}-{axis}" for kind in WALK_KINDS[:2] for axis in "xyz"),
    *(f"{WALK_KINDS[2]}-{'xyz'[i]}{'xyz'[j]}" for i, j in OFF_DIAGONAL),
)
"""Names of the twelve parameters of a triad."""
CORNER = 1 / np.sqrt(3)
FIELD_DIRECTIONS = np.array(
    [*np.eye(3), *-np.eye(3)]
    + [[i * CORNER, j * CORNER, k * CORNER] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
)
"""Directions of the field (14, 3) over which a curved axis is put as a straight one."""
DEPENDENT = 1e-9
"""Singular values below this share of the largest are rounding."""
HELD_SD = 1e-14
"""A parameter of less standard uncertainty is one that its model holds."""
NODES = np.array([0.0, 1.0, -1.0, 0.5])
"""Temperatures of a range at which a course is read: 0 its middle, 1 and -1 its ends."""
UNLIKE = 1e-3
"""Ratios of noise as unlike as this are not those of one noise."""
ANY_TEMPERATURE = (-np.inf, np.inf)
"""The range of a calibration whose run recorded no temperature."""
DAYS_PER_YEAR = 365.25


def years(days: Sequence[date]) -> Array:
    """Years (n,) since the first of some days."""
    return np.array([(day - days[0]).days / DAYS_PER_YEAR for day in days])


@dataclass(frozen=True)
class Factored:
    """Factors (…, 12 + 6 n) of a triad, and what file parameters change of them (…, 12 + 6 n, p).

    First the twelve at the middle of a temperature range (`FACTOR_NAMES`); then scale and bias by power 1…n of the
    distance from it, in halves of the range.
    """

    values: Array
    jacobian: Array


def factored(
    model: Model, params: Array, raw: Array, temperatures: tuple[float, float], order: int,
    x: Array | None = None,
) -> Factored:  # fmt: skip
    """The factors of a model over a range of temperatures, °C, by readings (m, 3) that span the field.

    `x` (m, 3): the same readings in the axes and units of the factors, where these are others. Exact for a
    triad without own-axis terms; else the factors are those of the best straight one over the readings.
    """
    x = raw if x is None else x
    lead, nodes = params.shape[:-1], NODES[: order + 1]
    low, high = temperatures
    warmth = np.repeat((low + high) / 2 + nodes * (high - low) / 2, len(raw))
    onto = np.linalg.pinv(np.concatenate([x, np.ones_like(x[:, :1])], -1))
    points = np.broadcast_to(np.concatenate([raw] * len(nodes)), (*lead, len(warmth), 3))
    fields = model.fields(params, points, warmth).reshape(*lead, len(nodes), len(raw), 3)
    moved = model.jacobian(params, points, warmth)
    moved = moved.reshape(*lead, len(nodes), len(raw), 3, moved.shape[-1])
    affine = np.einsum("am,...kmi->...kai", onto, fields)
    change = np.einsum("am,...kmip->...kaip", onto, moved)
    return _as_factors(affine, change, np.linalg.inv(np.vander(nodes, increasing=True)))


def _as_factors(affine: Array, change: Array, powers: Array) -> Factored:
    """Factors of affine maps (…, K, 4, 3) at K temperatures, the columns of the matrix and the offset.

    `change` are their derivatives, `powers` (K, K) makes coefficients of values at the temperatures.
    """
    matrix, offset = affine[..., :3, :].mT, affine[..., 3, :]
    by_matrix, axis = np.swapaxes(change[..., :3, :, :], -3, -2), np.arange(3)
    scale = 1 / diagonal(matrix)
    by_scale = -(scale**2)[..., None] * by_matrix[..., axis, axis, :]
    mixing = matrix * scale[..., None, :]
    by_mixing = (
        by_matrix * scale[..., None, :, None] + matrix[..., None] * by_scale[..., None, :, :]
    )
    bias = -np.linalg.solve(mixing, offset[..., None])[..., 0]
    pulled = change[..., 3, :, :] + np.einsum("...ijp,...j->...ip", by_mixing, bias)
    linear = np.concatenate([scale, bias], -1)
    by_linear = np.concatenate([by_scale, -np.linalg.solve(mixing, pulled)], -2)
    linear = np.einsum("jk,...ki->...ji", powers, linear)
    by_linear = np.einsum("jk,...kip->...jip", powers, by_linear)
    turn = -mixing[..., 0, OFF_ROWS, OFF_COLUMNS]
    by_turn = -by_mixing[..., 0, OFF_ROWS, OFF_COLUMNS, :]
    lead, count = linear.shape[:-2], by_linear.shape[-1]
    later = linear[..., 1:, :].reshape(*lead, 6 * (len(powers) - 1))
    by_later = by_linear[..., 1:, :, :].reshape(*lead, 6 * (len(powers) - 1), count)
    return Factored(
        np.concatenate([linear[..., 0, :], turn, later], -1),
        np.concatenate([by_linear[..., 0, :, :], by_turn, by_later], -2),
    )


@dataclass(frozen=True)
class History:
    """Calibrations of a tool, or of many tools that have as many, in common parameters: (…, n, p).

    `values`, their `covariance` (…, n, p, p), `precision` (…, n, p, p): what each calibration says of the
    parameters, nothing along directions that it leaves free. `freedom` (…, n, p): degrees of freedom of
    the noise estimate behind each parameter, infinite where there is none; `pooled` (…, n, p): those of a triad
    that are so marked are of one estimate. `years` (…, n) since the first.
    `has_prior` (n,): calibrations made with another of these as their prior, or None: none.
    `names` (p,): "accelerometer bias-x"; a name with a `·` is a power of temperature.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    precision: Array
    freedom: Array
    pooled: Bools
    years: Array
    has_prior: Bools | None = None

    @property
    def steady(self) -> Ints:
        """Places (s,) of the parameters at the middle temperature."""
        return np.flatnonzero(["·" not in name for name in self.names])


def parameter_names(orders: Mapping[str, int]) -> tuple[str, ...]:
    """Names of the parameters of triads that are compared to these orders."""
    return tuple(
        f"{triad} {title}{f'·{power}' if power else ''}"
        for triad, order in orders.items()
        for power in range(order + 1)
        for title in (FACTOR_NAMES[:6] if power else FACTOR_NAMES)
    )


def precision(covariance: Array, free: Array) -> Array:
    """What is known (p, p): the inverse of a covariance (p, p) across free directions (f, p).

    Along them nothing is known, and nothing of a parameter without variance, which the model holds.
    """
    variance = np.diag(covariance)
    moving = np.flatnonzero(variance > HELD_SD**2)
    result = np.zeros_like(covariance)
    if not moving.size:
        return result
    sd, across = np.sqrt(variance[moving]), np.eye(len(moving))
    if free.size:
        _, sizes, rows = np.linalg.svd(free[:, moving] / sd)
        across = rows[np.sum(sizes > DEPENDENT * max(sizes[0], 1.0)) :].transpose()
    inner = across.transpose() @ (covariance[np.ix_(moving, moving)] / np.outer(sd, sd)) @ across
    known = across @ np.linalg.pinv(inner, DEPENDENT, hermitian=True) @ across.transpose()
    result[np.ix_(moving, moving)] = known / np.outer(sd, sd)
    return result


def one_noise(factors: Array, freedom: Array) -> tuple[Array, Array, Bools]:
    """What variances (…, n) of one triad are multiplied by if the noise of the tool is one, and their freedom.

    And which of them (…, n) then are of that one estimate.

    `factors` (…, n): s², the ratio of the noise of each calibration to what is declared, of `freedom` degrees;
    NaN where there is none. Ratios that differ by more than chance (`UNLIKE`) are kept apart.
    Reference: Bartlett's test of equal variances.
    """
    from scipy.special import chdtrc

    known = np.isfinite(factors) & (factors > 0) & (freedom >= 1)
    degrees, square = np.where(known, freedom, 0.0), np.where(known, factors, 1.0)
    total, count = degrees.sum(-1, keepdims=True), known.sum(-1, keepdims=True)
    mean = np.where(
        total > 0, (degrees * square).sum(-1, keepdims=True) / np.maximum(total, 1.0), 1.0
    )
    spread = total * np.log(mean) - (degrees * np.log(square)).sum(-1, keepdims=True)
    inverse = np.where(known, 1 / np.maximum(degrees, 1.0), 0.0).sum(-1, keepdims=True)
    correction = 1 + (inverse - 1 / np.maximum(total, 1.0)) / (3 * np.maximum(count - 1, 1))
    alike = known & (count > 1) & (chdtrc(np.maximum(count - 1, 1), spread / correction) > UNLIKE)
    ratio = np.where(alike, mean / square, 1.0)
    single = np.where(known, freedom, np.inf)
    return ratio, np.where(alike, total, single), alike
