"""Statistics of a roll test: the error of a tool over a turn of toolface, without noise.

A tool's error is smooth in toolface: a bias across the tool axis is the first harmonic, a
difference of scales or a misalignment of x and y the second. So a mean and two harmonics
are fitted to the values of a roll set, and judged instead of the largest and the smallest
value, which noise drives apart. Four toolfaces at right
angles determine a mean and the first harmonic. Arrays in, arrays out; angles are radians.

Roll sets: stations in one direction of the tool axis and at one temperature.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mwdcal.calibration.readings import Readings, soaks
from mwdcal.calibration.residuals import tail
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen, inverse

NEAR_VERTICAL = np.radians(5.0)
"""Nearer to vertical than this azimuth and toolface are not judged."""
ROLL_SET = 3
"""Fewest stations that make a roll set."""
_ANGLE_DIGITS = 3
_BLANK = -1.0
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RollSet:
    """Stations of one direction and one temperature.

    `index` (k,) are their numbers. `declared`: the run says that they are a roll set, by `group`
    or by naming no direction at all; else the stand was set to the direction at each station.
    `one_azimuth`: they are known to share an azimuth too.
    """

    label: str
    index: Ints
    declared: bool
    one_azimuth: bool


def roll_sets(readings: Readings) -> list[RollSet]:
    """Roll sets of a run: by group, else by equal reference angles, else all stations.

    Stations of different temperatures are never in one set. Equal inclinations without azimuth
    make a set that does not share an azimuth.
    """
    warmth = np.zeros(readings.count) if readings.temperature is None else readings.temperature
    several, sets = soaks(warmth).any(), []
    for label, members, declared, one_azimuth in _directions(readings):
        where = np.flatnonzero(members)
        soak = soaks(warmth[where])
        for number in np.unique(soak):
            index = where[soak == number]
            at = f", {warmth[index].mean():.1f} °C" if several else ""
            if len(index) >= ROLL_SET:
                sets.append(RollSet(label + at, index, declared, one_azimuth))
    return sets


def _directions(readings: Readings) -> Iterator[tuple[str, Bools, bool, bool]]:
    """Label and members (n,) of each direction, whether it is declared, and of one azimuth."""
    group = readings.groups
    for number in range(int(group.max(initial=-1)) + 1):
        yield f"roll set {number + 1}", np.asarray(group == number), True, True
    inclination, azimuth = (np.degrees(readings.reference(n)) for n in ("inclination", "azimuth"))
    known = ~np.isnan(inclination)
    if not known.any() and (group < 0).all():
        yield "all stations", np.ones(readings.count, bool), True, True
        return
    key = np.round(np.stack([inclination, np.nan_to_num(azimuth, nan=_BLANK)], -1), _ANGLE_DIGITS)
    for pair in np.unique(key[(group < 0) & known], axis=0):
        given = bool(pair[1] != _BLANK)
        where = f"azimuth {pair[1]:g}°" if given else "azimuth not given"
        members = np.all(key == pair, -1) & (group < 0)
        yield f"inclination {pair[0]:g}°, {where}", members, False, given


def near_vertical(readings: Readings, inclination: Array) -> Bools:
    """Stations (n,) within `NEAR_VERTICAL` of vertical.

    By the reference inclination, else the mean measured `inclination` (n,) of the group, else that
    of the station.
    """
    steep, group = np.sin(inclination), readings.groups
    for number in range(int(group.max(initial=-1)) + 1):
        steep = np.where(group == number, steep[group == number].mean(), steep)
    given = readings.reference("inclination")
    steep = np.where(np.isnan(given), steep, np.sin(given))
    return np.asarray(steep < np.sin(NEAR_VERTICAL) - _ROUNDING)


HARMONICS = np.arange(1, 3)
COEFFICIENTS = 1 + 2 * len(HARMONICS)
FITTED = {1: [0, 1, 3], 2: [0, 1, 2, 3, 4]}
"""Places of the coefficients of a curve of so many harmonics: mean, cos t, cos 2t, sin t, sin 2t."""
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
UNLIMITED = np.inf
"""Degrees of freedom of a noise that was declared, not estimated."""
CLOSED_FORM = 100
"""Degrees of freedom up to which χ² is computed without SciPy."""
CURVE_POINTS = 120
"""Toolfaces at which a curve is evaluated: its range is at most 0.14 % too small."""
PAIRS = 500
RANDOM_SEED = 1


@dataclass(frozen=True)
class Coverage:
    """How toolfaces (..., n) cover the circle: the widest gap (...), and where it starts.

    `carried` (..., 2): largest standard uncertainty over the circle of a curve of one harmonic and of
    two, in noises of one reading; infinite where the toolfaces do not determine its coefficients.
    `seen` (..., 2): share of the amplitude of each harmonic that the toolfaces show at the least
    favourable phase.
    """

    gap: Array
    start: Array
    carried: Array
    seen: Array

    @property
    def harmonics(self) -> Ints:
        """Harmonics (...) of the curve that the toolfaces determine all round; 0: not rolled.

        At three toolfaces 120° apart a second harmonic looks like a first, so these determine neither.
        """
        one, two = np.moveaxis(self.carried <= CARRIED, -1, 0)
        most = np.where(two, 2, np.where(one, 1, 0))
        return np.asarray(np.where(self.gap <= WIDEST_GAP + SLACK, most, 0))

    @property
    def rolled(self) -> Bools:
        """Whether the toolfaces determine a mean and one or two harmonics all round."""
        return np.asarray(self.harmonics > 0)


@dataclass(frozen=True)
class Curve:
    """Mean and harmonics fitted to a roll set.

    Shapes: coefficients (..., 5): mean, cosines, sines; covariance (..., 5, 5), both zero for a
    harmonic that was not fitted; square (...): χ² of the residuals with `freedom` degrees of freedom.
    """

    coefficients: Array
    covariance: Array
    square: Array
    freedom: int
    harmonics: int = len(HARMONICS)

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
    def scale(self) -> Array:
        """Residuals divided by what noise alone would give (...); 1 without degrees of freedom."""
        return np.sqrt(self.square / self.freedom) if self.freedom else np.ones(self.square.shape)

    def rough(self, known: float = UNLIMITED) -> Bools:
        """Where the residuals are larger than noise alone would give: the error is not smooth.

        `known`: degrees of freedom of the stated noise.
        """
        freedom = np.full(self.square.shape, self.freedom)
        return np.asarray(chance(self.square, freedom, known) < DEPARTURE_CHANCE)


@dataclass(frozen=True)
class NoiseScale:
    """Noise of one observable in one run (...), in units of the stated noise.

    `known`: degrees of freedom of the stated noise. A declared noise keeps its size: `scale` is 1. An estimated
    one is pooled with the residuals of all curves, each by its degrees of freedom; `freedom` is their sum.
    `calm`: the residuals are improbably small. Then `seen` is their noise, else `scale`: the bias is taken off
    by it, lest too much be taken off. No uncertainty ever rests on it.
    """

    known: float
    scale: Array
    freedom: Array
    calm: Bools
    seen: Array


def scatter(curves: Sequence[Curve], known: float = UNLIMITED) -> NoiseScale:
    """Noise of one observable in one run, by all its curves but those that are not smooth."""
    square, freedom = np.zeros(()), np.zeros((), int)
    for curve in curves:
        smooth = ~curve.rough(known)
        square = square + np.where(smooth, curve.square, 0.0)
        freedom = freedom + np.where(smooth, curve.freedom, 0)
    whole = known + freedom
    scale = np.ones(square.shape)
    if np.isfinite(known):
        scale = np.sqrt((known + square) / np.maximum(whole, 1e-9))
    calm = np.asarray(chance(square, freedom, known) > 1 - DEPARTURE_CHANCE) & (freedom > 0)
    seen = np.where(calm, np.sqrt(square / np.maximum(freedom, 1)), scale)
    return NoiseScale(known, scale, whole, calm, seen)


def chance(square: Array, freedom: Array, known: float = UNLIMITED) -> Array:
    """Chance (...) that noise as stated makes χ² larger; 1 without degrees of freedom.

    Definition: the tail of χ², or of Fisher's F where the noise was estimated with `known` degrees of freedom.
    """
    if not np.isfinite(known) and np.max(freedom) <= CLOSED_FORM:
        return tail(square, freedom)
    from scipy.special import chdtrc, fdtrc

    some, least = freedom > 0, np.maximum(freedom, 1)
    if not np.isfinite(known):
        return np.where(some, chdtrc(least, square), 1.0)
    return np.where(some, fdtrc(least, max(known, 1.0), square / least), 1.0)


@dataclass(frozen=True)
class Extent:
    """Noise-free range (...) of a curve over the circle, its largest departure from zero, and 1σ.

    `…_errors` (..., d): what each would be off by in tests like this one, on average zero.
    """

    range: Array
    range_sd: Array
    range_errors: Array
    largest: Array
    largest_sd: Array
    largest_errors: Array


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
    return Coverage(
        gap=np.take_along_axis(steps, widest, -1)[..., 0],
        start=np.take_along_axis(ordered, widest, -1)[..., 0],
        carried=np.stack([_carried(toolface, places) for places in FITTED.values()], -1),
        seen=np.cos(np.stack(halves, -1) / 2),
    )


def _carried(toolface: Array, places: list[int]) -> Array:
    """Largest standard uncertainty (...) over the circle of a curve of some coefficients, in noises of a reading."""
    rows, circle = basis(toolface)[..., places], basis(CIRCLE)[..., places]
    information = np.swapaxes(rows, -1, -2) @ rows / toolface.shape[-1]
    whole = np.linalg.eigvalsh(information)[..., 0] > 1e-9
    safe = np.where(whole[..., None, None], information, np.eye(len(places)))
    variance = np.sum((circle @ inverse(safe)) * circle, -1).max(-1)
    return np.where(whole, np.sqrt(variance / toolface.shape[-1]), np.inf)


def _steps(angle: Array, period: float) -> tuple[Array, Array]:
    """Angles (..., n) in order, and the step from each to the next, the last round to the first."""
    ordered = np.sort(np.mod(angle, period), -1)
    return ordered, np.diff(ordered, append=ordered[..., :1] + period, axis=-1)


def fitted(
    value: Array,
    sd: Array,
    toolface: Array,
    harmonics: int = len(HARMONICS),
    shared: Array | None = None,
) -> Curve:
    """The curve through values (..., n) of independent `sd` (..., n) at toolfaces (..., n).

    `shared` (n, n): covariance of errors that some of the values have in common.
    Singular: the toolfaces must determine the coefficients (`Coverage.harmonics`).
    """
    places = FITTED[harmonics]
    white = np.eye(sd.shape[-1]) / sd[..., None]
    if shared is not None:
        variance = np.eye(sd.shape[-1]) * sd[..., None] ** 2
        white = inverse(np.asarray(np.linalg.cholesky(variance + shared)))
    rows = white @ basis(toolface)[..., places]
    seen = np.einsum("...ij,...j->...i", white, value)
    covariance = inverse(np.swapaxes(rows, -1, -2) @ rows)
    coefficients = np.einsum("...ij,...nj,...n->...i", covariance, rows, seen)
    left = seen - np.einsum("...ni,...i->...n", rows, coefficients)
    whole = np.eye(COEFFICIENTS)[:, places]
    return Curve(
        coefficients=coefficients @ whole.swapaxes(-1, -2),
        covariance=whole @ covariance @ whole.swapaxes(-1, -2),
        square=np.sum(left**2, -1),
        freedom=value.shape[-1] - len(places),
        harmonics=harmonics,
    )


def extent(curve: Curve, noise: NoiseScale | None = None, moved: Array | None = None) -> Extent:
    """Range and largest departure over the whole circle, corrected for the bias by noise.

    Definition (parametric bootstrap): both are computed for the fitted curve, c, and for many
    curves drawn about it with its covariance. 2 c - (their mean) is the noise-free value, at least
    0; their root mean square distance from c, which includes the correction, is its standard
    uncertainty. The draws are always the same.

    `noise` scales the covariance; `moved` (..., d, 5), changes of the coefficients, take the place of the draws.
    """
    noise = scatter([curve]) if noise is None else noise
    moved = drawn(curve) if moved is None else moved
    middle = curve.coefficients[..., None, :]
    still = _measures(middle)
    changed = _measures(middle + noise.scale[..., None, None] * moved)
    seen = _measures(middle + noise.seen[..., None, None] * moved) if noise.calm.any() else changed
    parts: list[Array] = []
    for value, other, by_seen in zip(still, changed, seen, strict=True):
        change = other - value
        corrected = np.maximum(value[..., 0] - (by_seen - value).mean(-1), 0.0)
        sd = np.sqrt(np.mean(change**2, -1))
        parts += [corrected, sd, change - change.mean(-1, keepdims=True)]
    return Extent(*parts)


@dataclass(frozen=True)
class Figure:
    """Spread of an observable in roll sets (...), or its largest error: without noise, its 1σ, and `raw` with it.

    `freedom`: degrees of freedom of the 1σ; `errors` (..., d) in tests like this one, on average zero. `side`: sign
    of the curve where it is farthest from zero.
    """

    value: Array
    uncertainty: Array
    raw: Array
    freedom: Array
    errors: Array
    side: Array


def figure(
    part: Array, curve: Curve, noise: NoiseScale, error: bool, moved: Array | None = None
) -> Figure:
    """The figure to judge of values (..., n) about their middle, or of errors, through which `curve` goes.

    Definition: range or largest departure of the curve, by `extent`; where the error is not smooth, the raw figure,
    with the noise of these residuals.
    """
    turn = extent(curve, noise, moved)
    value, sd, errors = (
        (turn.largest, turn.largest_sd, turn.largest_errors)
        if error
        else (turn.range, turn.range_sd, turn.range_errors)
    )
    raw = np.abs(part).max(-1) if error else np.ptp(part, axis=-1)
    rough = curve.rough(noise.known)
    wider = np.where(rough, curve.scale / noise.scale, 1.0)
    freedom = np.where(rough, curve.freedom, noise.freedom)
    value, errors = np.where(rough, raw, value), errors * wider[..., None]
    course = curve.at(CIRCLE)
    side = np.where(course.max(-1) > -course.min(-1), 1.0, -1.0)
    return Figure(value, sd * wider, raw, freedom, errors, side)


@dataclass(frozen=True)
class Largest:
    """The largest of several figures (...) without the bias of the choice, and its 1σ.

    `place`: of the largest; `errors` (..., d) in tests like this one, on average zero.
    """

    value: Array
    uncertainty: Array
    place: Ints
    errors: Array


def largest(value: Array, uncertainty: Array, errors: Array) -> Largest:
    """The largest of noise-free figures (..., k), of which `errors` (..., d, k) are drawn together.

    Definition (parametric bootstrap): noise drives the figures apart, so they are first drawn together to the
    scatter that they have beyond their uncertainties (DerSimonian and Laird's variance). About these the
    test is repeated; by as much as the largest figure then lies above the largest of these on average, that of
    the test is too large. The root mean square of that distance is its standard uncertainty.
    """
    place = np.argmax(value, -1)
    most = np.take_along_axis(value, place[..., None], -1)[..., 0]
    if value.shape[-1] == 1:
        return Largest(most, uncertainty[..., 0], place, errors[..., 0])
    least = uncertainty.min(-1, keepdims=True)
    root = least / uncertainty
    total = np.sum(root**2, -1)
    excess = _about_mean(value, root) - _about_mean(errors, root[..., None, :]).mean(-1)
    between = np.maximum(excess, 0.0) / (total - np.sum(root**4, -1) / total)
    sd = np.hypot(uncertainty, np.sqrt(between)[..., None])
    centre = _mean(value, least / sd)
    centre = centre + np.sqrt(between)[..., None] / sd * (value - centre)
    change = (centre[..., None, :] + errors).max(-1) - centre.max(-1, keepdims=True)
    bias = change.mean(-1)
    sd = np.sqrt(np.mean(change**2, -1))
    return Largest(np.maximum(most - bias, 0.0), sd, place, change - bias[..., None])


def _mean(value: Array, root: Array) -> Array:
    """Mean (..., 1) of values (..., k) by the squares of roots of weights."""
    return np.asarray(
        np.sum(root**2 * value, -1, keepdims=True) / np.sum(root**2, -1, keepdims=True)
    )


def _about_mean(value: Array, root: Array) -> Array:
    """Weighted sum of squares (...) of values (..., k) about their mean."""
    return np.asarray(np.sum((root * (value - _mean(value, root))) ** 2, -1))


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


def drawn(curve: Curve, name: str = "", number: int = 0) -> Array:
    """Changes (..., d, 5) of the coefficients by noise: always the same of an observable and a set's number."""
    root = _root(curve.covariance)
    return np.asarray(np.einsum("...ij,dj->...di", root, _even_draws(name, number)))


@cache
def draws(name: str, count: int) -> Array:
    """Standard normal numbers (2 · PAIRS, count) in opposite pairs, always the same for a name."""
    half = np.random.default_rng([RANDOM_SEED, *name.encode()]).normal(size=(count, PAIRS)).T
    return np.concatenate([half, -half])


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
def _even_draws(name: str, number: int) -> Array:
    """Draws (2 · PAIRS, 5) in opposite pairs, of mean zero and covariance one exactly."""
    drawn = draws(f"{name} {number}", COEFFICIENTS)[:PAIRS]
    square = drawn.swapaxes(-1, -2) @ drawn / PAIRS
    even = np.linalg.solve(np.linalg.cholesky(square), drawn.swapaxes(-1, -2)).swapaxes(-1, -2)
    return np.concatenate([even, -even])
