"""How fast parameters wander: a random walk of each, its rate estimated with that of the tool's peers.

Between two calibrations t years apart a parameter moves by a normal variable of variance q t. Parameters of
a kind (`WALK_GROUPS`) have one rate; rates of tools of a type are log-normal about a common one, but
for a few (`UNLIKE_SHARE`) of any rate.

Calibrations of one tool in the same parameters, whatever the form, order and units of each.

Of each triad they are factors over temperatures that all calibrations hold for: scale, bias and misalignments of
field = (I - m)(x / SF - B), with x in the axes and nominal scales of the latest calibration. Scale and bias are
compared as polynomials of temperature of the lowest order among the calibrations, misalignments at its middle.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from mwdcal.calibration.readings import TRIADS
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints, diagonal, outer
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


def by_kind(kinds: Iterable[Hashable]) -> list[list[int]]:
    """The places of each kind, in the order in which the kinds first appear.

    >>> by_kind("aba")
    [[0, 2], [1]]
    """
    places: dict[Hashable, list[int]] = {}
    for place, kind in enumerate(kinds):
        places.setdefault(kind, []).append(place)
    return list(places.values())


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
    `has_prior` (…, n): calibrations made with another of these as their prior, or None: none.
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

    @classmethod
    def of(cls, tools: Sequence[History]) -> History:
        """The histories of tools with as many calibrations in the same parameters, as one."""
        priors = (
            np.zeros(t.years.shape, bool) if t.has_prior is None else t.has_prior for t in tools
        )
        return cls(
            names=tools[0].names,
            values=np.stack([tool.values for tool in tools]),
            covariance=np.stack([tool.covariance for tool in tools]),
            precision=np.stack([tool.precision for tool in tools]),
            freedom=np.stack([tool.freedom for tool in tools]),
            pooled=np.stack([tool.pooled for tool in tools]),
            years=np.stack([tool.years for tool in tools]),
            has_prior=np.stack([*priors]),
        )

    @cached_property
    def free_directions(self) -> tuple[Array, Array]:
        """Units (…, n, p) in which each parameter is known to one, and directions (…, n, p, p) of which nothing is.

        The latter are columns of length one in these units; other columns are zero. A parameter of which nothing is
        known whatever the others are is no part of them.
        """
        units = _units(self.precision)
        values, vectors = np.linalg.eigh(self.precision * outer(units))
        known = _positive(values)[..., None, :] | (units == 0)[..., None]
        return units, np.where(known, 0.0, vectors)

    @property
    def steady(self) -> Ints:
        """Places (s,) of the parameters at the middle temperature."""
        return np.flatnonzero(["·" not in name for name in self.names])

    @property
    def triads(self) -> list[slice]:
        """Where the parameters of each triad lie, side by side."""
        of_place = [name.partition(" ")[0] for name in self.names]
        counts = [of_place.count(triad) for triad in TRIADS]
        ends = np.cumsum([0, *counts]).tolist()
        return [slice(*pair) for pair, count in zip(pairwise(ends), counts, strict=True) if count]


def parameter_names(orders: Mapping[str, int]) -> tuple[str, ...]:
    """Names of the parameters of triads that are compared to these orders."""
    return tuple(
        f"{triad} {title}{f'·{power}' if power else ''}"
        for triad, order in orders.items()
        for power in range(order + 1)
        for title in (FACTOR_NAMES[:6] if power else FACTOR_NAMES)
    )


def precision(covariance: Array, free: Array) -> Array:
    """Information (p, p): the inverse of a covariance (p, p) across free directions (f, p).

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


def precisions(covariance: Array, free: Sequence[Array]) -> Array:
    """The same of several calibrations (n, p, p), together where all parameters of all move freely."""
    variance = diagonal(covariance)
    if not (variance > HELD_SD**2).all() or any(rows.size for rows in free):
        return np.stack([precision(*each) for each in zip(covariance, free, strict=True)])
    scale = outer(np.sqrt(variance))
    known = np.linalg.pinv(covariance / scale, DEPENDENT, hermitian=True)
    return np.asarray(known / scale)


def common_noise_scale(factors: Array, freedom: Array) -> tuple[Array, Array, Bools]:
    """What variances (…, n) of one triad are multiplied by if the noise of the tool is one, and their freedom.

    And which of them (…, n) then are of that one estimate.

    `factors` (…, n): s², the ratio of the noise of each calibration to what is declared, of `freedom` degrees,
    or NaN. Ratios that differ by more than chance (`UNLIKE`) are kept apart.
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


WALK_GROUPS = tuple((triad, kind) for triad in TRIADS for kind in WALK_KINDS)
"""Triad and kind of the parameters that wander at one rate."""
LEAST_DECADE, DECADE = -4.0, 3.0
"""Least and, at least, largest rate that is tried: decimal logarithm of variance a year over a calibration's."""
BEYOND = 2.0
"""Decades by which the largest rate exceeds the square of the largest change of any tool."""
DECADE_STEP = 0.125
"""Between rates that are tried, decades."""
CENTRE_STEP, CENTRE_MARGIN = 0.2, 0.5
"""Between rates about which those of a type may lie, all equally probable beforehand, and from the ends, decades."""
RATE_SPREADS = np.linspace(0.05, 2.0, 40)
"""Standard deviations, in decades, of the rates of tools of a type; see `SPREAD_SCALE`."""
SPREAD_SCALE = 0.4
"""Most probable of these before there are data, of a Rayleigh distribution: it keeps away from none at all."""
UNLIKE_SHARE = 0.02
"""Share of the tools of a type, knocked or repaired ones, whose rates are unlike those of the others."""
VISIT = 7 / 365.25
"""Calibrations that are no further apart, years, are of one visit: the tool is repaired then, it does not wander."""


def group_places(names: Sequence[str], triad: str, kind: str) -> list[int]:
    """Places of the parameters of a group at the middle temperature."""
    members = {f"{triad} {title}" for title in FACTOR_NAMES if title.startswith(kind)}
    return [place for place, name in enumerate(names) if name in members]


FREE_SHARE_OF_GROUP = 1e-6
"""Share of a free direction, in the units in which each parameter is known to one, that a group has at least."""
FREE_OF_LARGEST = 1e-4
"""Share of the largest of the free directions of a tool up to which one is a small turn of the others."""


def _free_directions(history: History, places: Sequence[int]) -> Array:
    """Sums (…, n, s, s) of the products of the directions of a group that each calibration leaves free."""
    units, directions = history.free_directions
    some = directions[..., places, :]
    some = np.where(np.sum(some**2, -2, keepdims=True) > FREE_SHARE_OF_GROUP, some, 0.0)
    some = some * units[..., places, None]
    return np.asarray(some @ some.mT)


def _of_steps(weights: Array, blocks: Array) -> Array:
    """Covariances (t, m s, m s) of steps by those of calibrations (t, n, s, s), with weights (t, m, m, n)."""
    steps, size = weights.shape[1], blocks.shape[-1]
    noise = np.zeros((len(blocks), steps, size, steps, size))
    for weight, block in zip(np.moveaxis(weights, -1, 0), blocks.swapaxes(0, 1), strict=True):
        noise += weight[:, :, None, :, None] * block[:, None, :, None, :]
    return noise.reshape(-1, steps * size, steps * size)


@dataclass(frozen=True)
class Increments:
    """Changes (m,) of a group from visit to visit, in axes in which walk and noise are both white.

    Of variance q + `noise` (m,) at a rate q, variance per year.
    """

    change: Array
    noise: Array

    @classmethod
    def of(cls, history: History, places: Sequence[int]) -> Increments:
        """Those of the calibrations that have all parameters of the group and none of the others as a prior."""
        return cls.of_tools(History.of([history]), places)[0]

    @classmethod
    def of_tools(cls, history: History, places: Sequence[int]) -> list[Increments]:
        """The same of each of the tools (t, n, p) of a history."""
        values = history.values[..., places]
        known = diagonal(history.precision)[..., places]
        usable = np.asarray(np.isfinite(values).all(-1) & (known > 0).all(-1))
        if history.has_prior is not None:
            usable &= ~history.has_prior
        apart = [np.diff(at[use]) > VISIT for at, use in zip(history.years, usable, strict=True)]
        result = [cls(np.zeros(0), np.zeros(0))] * len(values)
        free = _free_directions(history, places)
        open_ = free.any((-2, -1)) & usable
        for tools in by_kind(
            (u.tobytes(), a.tobytes(), tool if some.any() else -1)
            for tool, (u, a, some) in enumerate(zip(usable, apart, open_, strict=True))
        ):
            kept, gap = np.flatnonzero(usable[tools[0]]), apart[tools[0]]
            if gap.any():
                some = np.ix_(np.array(tools), kept)
                block = history.covariance[some][..., places, :][..., places]
                gaps = np.diff(history.years[some])[:, gap]
                lost = free[some] if open_[tools].any() else None
                changes = cls._white(values[some], block, gaps, gap, lost)
                for tool, one in zip(tools, changes, strict=True):
                    result[tool] = one
        return result

    @classmethod
    def _white(
        cls, values: Array, covariance: Array, gaps: Array, apart: Bools, free: Array | None = None
    ) -> list[Increments]:
        """Of values (t, n, s) of covariance (t, n, s, s) with gaps (t, m), years, where they are `apart` (n - 1,).

        Without what follows directions that calibrations leave free, whose products are `free` (1, n, s, s): a value
        there is a convention.
        """
        step = np.diff(np.eye(values.shape[1]), axis=0)[apart]
        root = np.sqrt(gaps)
        weights = step[:, None] * step / (root[:, :, None, None] * root[:, None, :, None])
        noise = _of_steps(weights, covariance)
        change = (step @ values / root[..., None]).reshape(len(noise), 1, -1)
        if free is not None:
            sizes, axes = np.linalg.eigh(_of_steps(weights, free))
            across = axes[..., sizes[0] <= FREE_OF_LARGEST * sizes[0, -1]]
            noise, change = across.mT @ noise @ across, change @ across
        spread, axes = np.linalg.eigh(noise)
        change = change @ axes
        return [cls(*each) for each in zip(change[:, 0], np.maximum(spread, 0.0), strict=True)]

    def log_likelihood(self, rates: Array) -> Array:
        """Log likelihood (r,) of rates (r,), but for a constant."""
        variance = rates[:, None] + self.noise
        return np.asarray(-0.5 * np.sum(np.log(variance) + self.change**2 / variance, -1))


@dataclass(frozen=True)
class GroupRates:
    """Rates of a group in the tools of one type, learnt from some of them.

    `unit`: variance of a calibration, by which rates are counted; `decades` (r,) the logarithms of the rates that
    are tried, in it; `log_likelihood` (tools, r) of the rates of these tools.
    """

    unit: float
    decades: Array
    log_likelihood: Array

    @classmethod
    def of(cls, tools: Sequence[Increments]) -> GroupRates | None:
        """Of tools of a type; None where none of them has two calibrations of the group."""
        moved = [each for each in tools if each.noise.size]
        if not moved:
            return None
        unit = float(np.median(np.concatenate([each.noise for each in moved]))) or 1.0
        largest = max(float(np.max(each.change**2)) for each in moved)
        end = max(DECADE, BEYOND + np.log10(max(largest / unit, 1.0)))
        decades = np.arange(LEAST_DECADE, end + DECADE_STEP, DECADE_STEP)
        return cls(unit, decades, np.stack([e.log_likelihood(unit * 10.0**decades) for e in moved]))

    @property
    def rates(self) -> Array:
        """The rates (r,) that are tried, variance per year."""
        return np.asarray(self.unit * 10.0**self.decades)

    @cached_property
    def _centres(self) -> Array:
        """Decades (c,) about which the rates of the type may lie."""
        low, high = self.decades[0] + CENTRE_MARGIN, self.decades[-1] - CENTRE_MARGIN
        return np.arange(low, high + CENTRE_STEP / 2, CENTRE_STEP)

    @cached_property
    def _members(self) -> Array:
        """Share (c, s, r) of the tools of a type with each rate, by centre and spread of the type."""
        z = (self.decades - self._centres[:, None, None]) / RATE_SPREADS[:, None]
        density = np.exp(-0.5 * z**2)
        alike = density / density.sum(-1, keepdims=True)
        return np.asarray((1 - UNLIKE_SHARE) * alike + UNLIKE_SHARE / len(self.decades))

    def _evidence(self, log_likelihood: Array) -> Array:
        """Log probability (…, c, s) of a tool's calibrations, by centre and spread of its type."""
        largest = log_likelihood.max(-1, keepdims=True)
        by_type = self._members.reshape(-1, self._members.shape[-1])
        logs = np.log(np.maximum(np.exp(log_likelihood - largest) @ by_type.mT, 1e-300)) + largest
        return np.asarray(logs.reshape(*largest.shape[:-1], *self._members.shape[:2]))

    @cached_property
    def type_probability(self) -> Array:
        """Probability (c, s) of centre and spread of the type, by the tools it was learnt from."""
        prior = np.log(RATE_SPREADS) - 0.5 * (RATE_SPREADS / SPREAD_SCALE) ** 2
        logs = self._evidence(self.log_likelihood).sum(0) + prior
        return np.asarray(np.exp(logs - logsumexp(logs)))

    @cached_property
    def peers_probability(self) -> Array:
        """Probability (r,) of each rate of a tool of the type of which nothing else is known."""
        return np.asarray(np.einsum("cs,csr->r", self.type_probability, self._members))

    def edge(self, tool: Increments | None) -> str | None:
        """The finding that the rate of a tool, or where its own say nothing its type, is likeliest at an end.

        That of changes within the uncertainties is, at the least rate.
        """
        if tool is not None and tool.noise.size:
            likeliest = int(np.argmax(tool.log_likelihood(self.rates)))
        else:
            likeliest = self._likeliest
        return {0: "walk-unseen", len(self.decades) - 1: "walk-edge"}.get(likeliest)

    @cached_property
    def _likeliest(self) -> int:
        """The place of the rate that is likeliest of all tools together."""
        return int(np.argmax(self.log_likelihood.sum(0)))

    def probabilities(self, tools: Sequence[Increments], among: Sequence[bool]) -> Array:
        """Probability (t, r) of each rate of some tools; `among` those that the type was learnt from or not."""
        likelihood = np.stack([tool.log_likelihood(self.rates) for tool in tools])
        by_peers = np.broadcast_to(self.peers_probability, likelihood.shape).copy()
        members = np.array(
            [each and tool.noise.size > 0 for tool, each in zip(tools, among, strict=True)]
        )
        if members.any():
            prior = np.log(np.maximum(self.type_probability, 1e-300))
            logs = (prior - self._evidence(likelihood[members])).reshape(
                np.count_nonzero(members), -1
            )
            weight = np.exp(logs - logs.max(-1, keepdims=True))
            by_peers[members] = weight @ self._members.reshape(weight.shape[-1], -1)
        logs = likelihood + np.log(np.maximum(by_peers, 1e-300))
        return np.asarray(np.exp(logs - logsumexp(logs, -1, keepdims=True)))


def quantiles(rates: Array, probability: Array, shares: Sequence[float] | Array) -> Array:
    """Rates below which lie the given shares of a distribution (r,) over rates (r,), between them interpolated."""
    inner = np.cumsum(probability) - probability / 2
    return np.asarray(np.exp(np.interp(shares, inner, np.log(rates))))


def draws(rates: Array, probability: Array, count: int, rng: np.random.Generator) -> Array:
    """Rates (count,) drawn from a distribution over rates."""
    return quantiles(rates, probability, rng.uniform(size=count))


# --------------------------------------------------------------------------
# Did a tool change? A test of its calibrations against their stated uncertainty, all of them at once.
#
# Two statements at one level: that one parameter took a step between two calibrations, by the largest of all
# scores of such steps; and that the calibrations disagree at all, by their misfit to one set of parameters.
# Both are judged by their joint distribution under no change, so that all parameters and all transitions
# together raise a false alarm at the stated level.


CHANGE_LEVEL = 0.01
"""Share of unchanged tools that are called changed."""
STEP_SHARE = 0.8
"""Share of the level that steps of one parameter have; the misfit has the rest."""
LEVEL_SHARES = (STEP_SHARE, 1 - STEP_SHARE)
"""The shares of both."""
NULL_DRAWS = 9_999
"""Histories without change that the test is judged by."""
FIRST_DRAWS = 999
"""Of these, those that decide where they leave no doubt: see `change_test`."""
DECIDED_BEYOND = 6.0
"""Standard deviations of the share of the first draws above the level within which all are drawn."""
DISAGREES = 4.0
"""Misfit of a degree of freedom above which all draws are made at once: the first would not decide."""
PAIR_DRAWS = 1_999
"""Of these, those that two calibrations alone are judged by."""
LEAST_PROBABILITY = 1 / (NULL_DRAWS + 1)
"""The smallest probability that the draws can state: it stands for this or less."""
LEAST_PAIR_PROBABILITY = 1 / (PAIR_DRAWS + 1)
"""The smallest of two calibrations alone."""
SEED_OF_DRAWS = 15
DRAWN_TOGETHER = 2_000
"""Draws that are worked on at once, at least `PAIR_DRAWS`: they fit into a processor's cache."""
MOST_NAMED_STEPS = 8
"""Most steps of one tool that are named."""
UNSEEN = 1e-6
"""A step of which the calibrations tell less than this share of what one of them does is not tested."""


@dataclass(frozen=True)
class Step:
    """A step of the parameter at `place` between calibrations `after` - 1 and `after`, counted from 0.

    `size` with its standard uncertainty, all named steps being estimated together; `score` is that by which it
    was found: the step over its uncertainty if nothing else changed.
    """

    place: int
    after: int
    size: float
    uncertainty: float
    score: float


@dataclass(frozen=True)
class ChangeTest:
    """The outcome of the test of one tool: `probability` that an unchanged tool shows this much.

    `scores` (n - 1, p) of a step of each parameter between calibrations, NaN where they do not tell;
    `largest_score` of those of steady parameters, and the `critical_score` that it may have; `misfit` (χ²)
    of one set of parameters with its `degrees_of_freedom`. Of each pair of successive calibrations alone
    (n - 1,): `pair_misfit`, `pair_freedom` and `pair_probability`.
    """

    level: float
    probability: float
    scores: Array
    largest_score: float
    critical_score: float
    step_probability: float
    misfit: float
    degrees_of_freedom: int
    misfit_probability: float
    pair_misfit: Array
    pair_freedom: Array
    pair_probability: Array
    steps: tuple[Step, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the test calls the tool changed."""
        return self.probability <= self.level


@dataclass(frozen=True)
class Contrasts:
    """Statistics of differences between the calibrations of a tool, or of many.

    `precision` (…, n, p, p) of each calibration, in any units.
    """

    precision: Array

    @cached_property
    def _unit(self) -> Array:
        """Units (…, p) in which all calibrations together know each parameter to one."""
        return _units(self.precision.sum(-3))

    @cached_property
    def scaled(self) -> Array:
        """The precision (…, n, p, p) in these units."""
        return np.asarray(self.precision * outer(self._unit)[..., None, :, :])

    @cached_property
    def after(self) -> Array:
        """Information of the calibrations from each transition on (…, n - 1, p, p)."""
        sums = np.cumsum(self.scaled[..., ::-1, :, :], -3)
        return np.asarray(sums[..., ::-1, :, :][..., 1:, :, :])

    @cached_property
    def _spectra(self) -> tuple[Array, Array, Ints]:
        """Eigenvalues and vectors of each calibration's information, and its rank (…, n)."""
        values, vectors = np.linalg.eigh(self.scaled)
        return values, vectors, np.sum(_positive(values), -1)

    @cached_property
    def _means(self) -> tuple[Array, Ints]:
        """Covariance (…, n, p, p) of parameters that never changed, and rank (…, n) of what is known of them.

        By all calibrations, and by each two successive ones.
        """
        whole = self.scaled.sum(-3)[..., None, :, :]
        pairs = self.scaled[..., :-1, :, :] + self.scaled[..., 1:, :, :]
        known = np.concatenate([whole, pairs], -3)
        units = outer(_units(known))
        values, vectors = np.linalg.eigh(known * units)
        kept = _positive(values)
        inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
        return (vectors * inverse[..., None, :]) @ vectors.mT * units, np.sum(kept, -1)

    @cached_property
    def by_mean(self) -> Array:
        """Evidence (…, n - 1, p, p) for a change that the mean takes up of the evidence of all calibrations."""
        return np.asarray(self.after @ self._means[0][..., :1, :, :])

    @cached_property
    def information(self) -> Array:
        """Information (…, n - 1, p, p) about a change at each transition, the parameters being unknown."""
        return np.asarray(self.after - self.by_mean @ self.after)

    @cached_property
    def known(self) -> Bools:
        """Which steps (…, n - 1, p) the calibrations tell."""
        return np.asarray(diagonal(self.information) > UNSEEN)

    @cached_property
    def freedom(self) -> Ints:
        """Degrees of freedom (…, n) of the misfits of all calibrations, and of each two successive ones."""
        each, means = self._spectra[-1], self._means[-1]
        runs = each.sum(-1, keepdims=True), each[..., :-1] + each[..., 1:]
        return np.asarray(np.concatenate(runs, -1) - means)

    @cached_property
    def _sizes(self) -> Array:
        """Standard deviations (…, n - 1, p) of the evidence for steps; infinite where the calibrations tell none."""
        return np.sqrt(np.where(self.known, diagonal(self.information), np.inf))

    def departures(self, values: Array) -> Array:
        """Values (…, n, p) less those of the last calibration that has them, in our units: a column (…, n, p, 1)."""
        latest = values[..., -1, :]
        for k in range(values.shape[-2] - 2, -1, -1):
            latest = np.where(np.isnan(latest), values[..., k, :], latest)
        unit = np.where(self._unit > 0, self._unit, 1.0)[..., None, :]
        moved = np.nan_to_num((values - np.nan_to_num(latest)[..., None, :]) / unit)
        return np.asarray(moved * (self._unit > 0)[..., None, :])[..., None]

    def pull(self, departures: Array) -> Array:
        """Evidence (…, n, p, m) of each calibration for these departures of the parameters, in each of m columns."""
        return np.asarray(self.scaled @ departures)

    def sums(self, pull: Array) -> Array:
        """Evidence (…, n - 1, p, m) for a change at each transition, of covariance `information`."""
        later = np.cumsum(pull[..., ::-1, :, :], -3)[..., ::-1, :, :]
        return np.asarray(later[..., 1:, :, :] - self.by_mean @ later[..., :1, :, :])

    def scores(self, pull: Array) -> Array:
        """Scores (…, n - 1, p, m) of a step of each parameter alone, of variance 1 under no change."""
        return np.asarray(self.sums(pull) / self._sizes[..., None])

    def misfits(self, departures: Array, pull: Array) -> Array:
        """Misfit (…, n, m) of one set of parameters to all calibrations, and to each two successive ones."""
        each = np.sum(departures * pull, -2)
        whole = [each.sum(-2, keepdims=True), each[..., :-1, :] + each[..., 1:, :]]
        sums = [pull.sum(-3, keepdims=True), pull[..., :-1, :, :] + pull[..., 1:, :, :]]
        total = np.concatenate(sums, -3)
        return np.asarray(np.concatenate(whole, -2) - np.sum(total * (self._means[0] @ total), -2))

    def drawing(self, steady: Ints) -> list[_Draws]:
        """The same of each of t tools (t, n, p, p) for draws, with scores of the parameters at places `steady`."""
        values, vectors, _ = self._spectra
        kept = _positive(values)
        inverse = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
        root, sizes = vectors * inverse[..., None, :], self._sizes[..., steady, None]
        by_mean = self.by_mean[..., steady, :] / sizes
        parts = (root, self.scaled, 1 / sizes, by_mean, self._means[0])
        each = zip(*(part.astype(np.float32) for part in parts), strict=True)
        return [_Draws(steady, *tool) for tool in each]

    def step(self, tool: int, after: int, place: int) -> Array:
        """Evidence (n - 1, p) of one of the tools for a change at each transition, by a step of one, in our units."""
        information, by_mean = self.after[tool], self.by_mean[tool]
        rest = np.maximum(np.arange(1, 1 + len(information)), after) - 1
        return np.asarray(information[rest, :, place] - by_mean @ information[after - 1, :, place])


def _units(information: Array) -> Array:
    """Units (…, p) in which an information (…, p, p) is one of each parameter; 0 where nothing is known."""
    known = diagonal(information)
    return np.where(known > 0, 1 / np.sqrt(np.where(known > 0, known, 1.0)), 0.0)


def _positive(eigenvalues: Array) -> Bools:
    """Which eigenvalues (…, p), the largest last, are more than rounding."""
    return np.asarray(eigenvalues > DEPENDENT * eigenvalues[..., -1:])


@dataclass(frozen=True)
class _Draws:
    """The linear maps that turn normal numbers into the scores and misfits of an unchanged tool, single precision.

    `root` (n, p, p) turns them into departures and `scaled` (n, p, p) these into evidence; `inverse` (n - 1, s, 1) and
    `by_mean` (n - 1, s, p) make scores of the evidence, `means` (n, p, p) misfits. `steady` (s,): places of the scores.
    """

    steady: Ints
    root: AnyArray
    scaled: AnyArray
    inverse: AnyArray
    by_mean: AnyArray
    means: AnyArray

    def drawn(self, history: History, draws: int) -> tuple[AnyArray, AnyArray, AnyArray]:
        """The largest score (draws,), the misfit (draws,), and those of pairs (n - 1, `PAIR_DRAWS` at most)."""
        noise, grown = _noise(*history.values.shape), stretches(history, draws)
        count, size = history.values.shape
        steady: Ints | slice = slice(None) if len(self.steady) == size else self.steady
        most, misfit = np.zeros((2, draws), np.float32)
        pairs = np.zeros((count - 1, min(draws, PAIR_DRAWS)), np.float32)
        for first in range(0, draws, DRAWN_TOGETHER):
            part = slice(first, min(first + DRAWN_TOGETHER, draws))
            departures = self.root @ noise[..., part]
            for triad, factors in zip(history.triads, grown, strict=True):
                departures[:, triad] *= factors[:, None, part]
            pull = self.scaled @ departures
            each = np.einsum("kim,kim->km", departures, pull)
            for k, row in enumerate(pairs[:, part]):
                total = pull[k, :, : len(row)] + pull[k + 1, :, : len(row)]
                taken = np.einsum("im,im->m", total, self.means[k + 1] @ total)
                row[:] = (each[k] + each[k + 1])[: len(row)] - taken
            for k in range(count - 1, 0, -1):
                pull[k - 1] += pull[k]
            taken = np.einsum("im,im->m", pull[0], self.means[0] @ pull[0])
            misfit[part] = each.sum(0) - taken
            scores = pull[1:, steady] * self.inverse
            scores -= (self.by_mean.reshape(-1, size) @ pull[0]).reshape(scores.shape)
            ends = scores.max((0, 1), initial=0.0), scores.min((0, 1), initial=0.0)
            most[part] = np.maximum(ends[0], -ends[1])
        return most, misfit, pairs


@lru_cache(maxsize=2)
def _noise(count: int, size: int) -> AnyArray:
    """Standard normal numbers (n, p, `NULL_DRAWS`), the same for every tool."""
    rng = np.random.default_rng([SEED_OF_DRAWS, count, size])
    drawn = rng.standard_normal((NULL_DRAWS, count, size), np.float32)
    return np.ascontiguousarray(drawn.transpose(1, 2, 0))


def stretches(history: History, draws: int) -> AnyArray:
    """By how much errors (triads, n, draws) exceed those of a known noise: Student's t of each noise estimate.

    Calibrations of a triad whose noise was estimated together (`pooled`) have one factor.
    """
    each = (history.freedom, history.pooled)
    estimates = [tuple(tuple(a[:, t.start].tolist()) for a in each) for t in history.triads]
    return _stretches(history.freedom.shape, tuple(estimates), draws)


@lru_cache(maxsize=8)
def _stretches(
    shape: tuple[int, ...], estimates: tuple[tuple[tuple[float, ...], ...], ...], draws: int
) -> AnyArray:
    """The same by degrees of freedom (n,) of each triad and which are pooled, as many tools have them."""
    result = np.ones((len(estimates), shape[0], draws), np.float32)
    rng = np.random.default_rng([SEED_OF_DRAWS, *shape])
    for grown, (degrees, pooled) in zip(result, estimates, strict=True):
        together = np.array(pooled, bool)
        groups = [np.flatnonzero(together), *np.flatnonzero(~together)[:, None]]
        for rows in (each for each in groups if each.size and np.isfinite(degrees[each[0]])):
            freedom = degrees[rows[0]]
            grown[rows] = np.sqrt(freedom / rng.chisquare(freedom, draws))
    return result


def change_test(history: History, level: float = CHANGE_LEVEL) -> ChangeTest:
    """The test of one tool with two calibrations or more: `History` of (n, p)."""
    return change_tests([history], level)[0]


def change_tests(histories: Sequence[History], level: float = CHANGE_LEVEL) -> list[ChangeTest]:
    """The tests of tools with as many calibrations, two or more, in the same parameters.

    By `FIRST_DRAWS` where they show a tool to be unchanged, else by `NULL_DRAWS`. A tool is then called changed
    only where all draws call it so, and so with a probability of at most the level where nothing changed.
    """
    together = History.of(histories)
    contrasts, steady = Contrasts(together.precision), together.steady
    departures = contrasts.departures(together.values)
    pull = contrasts.pull(departures)
    sums = contrasts.sums(pull)[..., 0]
    scores = np.where(contrasts.known, sums / contrasts._sizes, np.nan)
    misfits = contrasts.misfits(departures, pull)[..., 0]
    each = zip(
        histories, scores, misfits, contrasts.freedom, contrasts.drawing(steady), strict=True
    )
    tests = [_tested(*tool, level) for tool in each]
    return [
        replace(test, steps=_steps(contrasts, tool, sums[tool], steady, test.critical_score))
        if test.changed
        else test
        for tool, test in enumerate(tests)
    ]


def _tested(
    history: History, scores: Array, misfits: Array, freedom: Ints, draws: _Draws, level: float
) -> ChangeTest:
    """The test of one tool by its scores (n - 1, p) and misfits (n,), without the steps."""
    if misfits[0] <= DISAGREES * freedom[0]:
        first = _test(
            scores, misfits, freedom, draws.steady, draws.drawn(history, FIRST_DRAWS), level
        )
        doubtful = first.probability <= level + DECIDED_BEYOND * np.sqrt(level / FIRST_DRAWS)
        if not doubtful and (first.pair_probability > 1 / (FIRST_DRAWS + 1)).all():
            return first
    return _test(scores, misfits, freedom, draws.steady, draws.drawn(history, NULL_DRAWS), level)


def _test(
    scores: Array, misfits: Array, freedom: Ints, steady: Ints,
    drawn: tuple[AnyArray, AnyArray, AnyArray], level: float,
) -> ChangeTest:  # fmt: skip
    """The test by draws of the largest score, the misfit, and those of pairs."""
    largest = float(np.nanmax(np.abs(scores[:, steady]), initial=0.0))
    evidence = NullDistribution.of(*drawn[:2])
    by_step, by_misfit = evidence.beyond(largest, float(misfits[0]))
    probability, critical = evidence.judged(
        min(by_step / STEP_SHARE, by_misfit / (1 - STEP_SHARE)), level
    )
    pairs = zip(drawn[2], misfits[1:], strict=True)
    return ChangeTest(
        level, probability, scores, largest, critical,
        by_step, float(misfits[0]), int(freedom[0]), by_misfit,
        misfits[1:], freedom[1:].astype(float),
        np.array([(1 + np.sum(each >= one)) / (len(each) + 1) for each, one in pairs]),
    )  # fmt: skip


@dataclass(frozen=True)
class NullDistribution:
    """Draws (m,) of the largest score and of the misfit of an unchanged tool, as they come and in `order`."""

    drawn: tuple[AnyArray, AnyArray]
    order: tuple[AnyArray, AnyArray]

    @classmethod
    def of(cls, most: AnyArray, misfit: AnyArray) -> NullDistribution:
        """Of draws."""
        return cls((most, misfit), (np.sort(most), np.sort(misfit)))

    def beyond(self, *values: float) -> list[float]:
        """Probability of as large a score, and of as large a misfit, among draws of no change."""
        count = len(self.drawn[0])
        return [
            (1 + count - int(np.searchsorted(order, value))) / (count + 1)
            for order, value in zip(self.order, values, strict=True)
        ]

    def _tail(self, limit: float) -> Bools:
        """Which draws are evidence (m,) of at most a limit: by the share of the level that each statement has."""
        count = len(self.drawn[0])
        result = np.zeros(count, bool)
        for drawn, order, share in zip(self.drawn, self.order, LEVEL_SHARES, strict=True):
            rank = int(share * limit * count + DEPENDENT)
            result |= drawn > order[count - 1 - rank] if rank < count else True
        return result

    def judged(self, least: float, level: float) -> tuple[float, float]:
        """Probability of as little evidence as the `least`, and the largest score below which there is no alarm."""
        count = len(self.drawn[0])
        probability = (1 + np.count_nonzero(self._tail(least))) / (count + 1)
        place = level * (count - 1)
        some = self._tail((place + 2) / count / STEP_SHARE)
        if np.count_nonzero(some) < place + 2:  # draws that are equal
            some = np.ones(count, bool)
        each = [
            (count - np.searchsorted(order, drawn[some])) / count / share
            for drawn, order, share in zip(self.drawn, self.order, LEVEL_SHARES, strict=True)
        ]
        alarm = _at(np.sort(np.minimum(*each)), place)
        return float(probability), _at(self.order[0], (1 - alarm * STEP_SHARE) * (count - 1))


def _at(order: Array, place: float) -> float:
    """The value at a place, counted from 0, of values in order: between two of them in proportion."""
    below = min(int(place), len(order) - 1)
    low, high = float(order[below]), float(order[min(below + 1, len(order) - 1)])
    return low + (place - below) * (high - low)


def _steps(
    contrasts: Contrasts, tool: int, sums: Array, steady: Ints, critical: float
) -> tuple[Step, ...]:
    """Steps that explain the change of one of the tools, the largest first, each with those before taken out.

    By the evidence `sums` (n - 1, p) for a change at each transition.
    """
    named: list[tuple[int, int]] = []
    scored: list[float] = []
    sizes, unit = contrasts._sizes[tool][:, steady], contrasts._unit[tool]
    moved, estimate, covariance = np.zeros((*sums.shape, 0)), np.zeros(0), np.zeros((0, 0))
    while len(named) < MOST_NAMED_STEPS:
        scores = (sums - moved @ estimate)[:, steady] / sizes
        row, column = np.unravel_index(np.argmax(np.abs(scores)), scores.shape)
        if abs(scores[row, column]) <= critical:
            break
        named.append((int(row) + 1, int(steady[column])))
        scored.append(float(scores[row, column]))
        moved = np.concatenate([moved, contrasts.step(tool, *named[-1])[..., None]], -1)
        after, place = np.array(named).transpose()
        covariance = np.linalg.pinv(moved[after - 1, place], DEPENDENT, hermitian=True)
        estimate = covariance @ sums[after - 1, place]
    uncertainty = np.sqrt(np.diag(covariance))
    return tuple(
        Step(place, after, float(size * unit[place]), float(sd * unit[place]), score)
        for (after, place), size, sd, score in zip(
            named, estimate, uncertainty, scored, strict=True
        )
    )
