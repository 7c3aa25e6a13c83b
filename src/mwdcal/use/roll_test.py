"""Statistics of a roll test: the error of a tool over a turn of toolface, without noise.

A tool's error is smooth in toolface: a bias across the tool axis is the first harmonic, a
difference of scales or a misalignment of x and y the second. So a mean and two harmonics
are fitted to the values of a roll set, and judged instead of the largest and the smallest
value, which noise drives apart. Four toolfaces at right
angles determine a mean and the first harmonic. Arrays in, arrays out; angles are radians.

Roll sets: stations in one direction of the tool axis and at one temperature.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from mwdcal.calibration.options import DIRECTION, is_assumed, settings_of
from mwdcal.calibration.readings import Readings, direction_numbers, soaks
from mwdcal.calibration.record import FREE_SHARE, MAGNETIC, Calibration
from mwdcal.calibration.residuals import tail
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.geometry.circle import resultant, unrolled
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS
from mwdcal.geometry.vectors import Array, Bools, Ints, centred, eigen, inverse

NEAR_VERTICAL = np.radians(5.0)
"""Nearer to vertical than this azimuth and toolface are not judged."""
ROLL_SET = 3
"""Fewest stations that make a roll set."""
_ANGLE_DIGITS = 3
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
    """Roll sets of a run: by group, else by reference direction (`direction_numbers`), else all stations.

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
    inclination, azimuth = (readings.reference(name) for name in DIRECTION)
    known, turned = ~np.isnan(inclination), "magnetic " if readings.north else ""
    if not known.any() and (group < 0).all():
        yield "all stations", np.ones(readings.count, bool), True, True
        return
    direction = np.where((group < 0) & known, direction_numbers(inclination, azimuth), -1)
    sets: dict[tuple[float, float], Bools] = {}
    for each in np.unique(direction[direction >= 0]):
        members = np.asarray(direction == each)
        lean, north = (x[members][0] + readback(x[members]).mean() for x in (inclination, azimuth))
        lean, north = np.round(np.degrees([lean, north % (2 * np.pi)]), _ANGLE_DIGITS)
        sets[float(lean), -1.0 if np.isnan(north) else float(north % 360.0)] = members
    for (lean, north), members in sorted(sets.items(), key=lambda each: each[0]):
        where = f"{turned}azimuth {north:g}°" if north >= 0 else "azimuth not given"
        yield f"inclination {lean:g}°, {where}", members, False, north >= 0


def readback(angle: Array) -> Array:
    """Reference angles (k,) of one setting less the first of them: as far as an encoder shows them differently."""
    return centred(angle - angle[0])


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
RAW_JUDGED = "raw figure judged"
"""The remark on a figure whose residuals are not: nothing is taken off it."""
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
    by it, so that not too much is taken off. No uncertainty ever rests on it.
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
    """Chance (...) that the declared noise makes χ² larger; 1 without degrees of freedom.

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
    of the curve where it is farthest from zero. `rough`: the error is not smooth, `value` is the raw figure.
    """

    value: Array
    uncertainty: Array
    raw: Array
    freedom: Array
    errors: Array
    side: Array
    rough: Bools


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
    return Figure(value, sd * wider, raw, freedom, errors, side, rough)


@dataclass(frozen=True)
class Largest:
    """The largest of several figures (...) without the bias of the choice, and its 1σ.

    `place`: of the largest; `errors` (..., d) in tests like this one, on average zero.
    """

    value: Array
    uncertainty: Array
    place: Ints
    errors: Array


def largest(value: Array, uncertainty: Array, errors: Array, rough: Bools | None = None) -> Largest:
    """The largest of noise-free figures (..., k), of which `errors` (..., d, k) are drawn together.

    Definition (parametric bootstrap): noise drives the figures apart, so they are first drawn together to the
    scatter that they have beyond their uncertainties (DerSimonian and Laird's variance). About these the
    test is repeated; by as much as the largest figure then lies above the largest of these on average, that of
    the test is too large. The root mean square of that distance is its standard uncertainty.

    `rough` (..., k): raw figures, whose scatter is not known to be noise. They change no other figure, and nothing
    is taken off one that is the largest.
    """
    if value.shape[-1] == 1:
        place = np.argmax(value, -1)
        return Largest(value[..., 0], uncertainty[..., 0], place, errors[..., 0])
    raw = np.zeros(value.shape, bool) if rough is None else rough
    smooth = ~raw | raw.all(-1, keepdims=True)
    least = np.where(smooth, uncertainty, np.inf).min(-1, keepdims=True)
    root = np.where(smooth, least / uncertainty, 0.0)
    total = np.sum(root**2, -1)
    excess = _about_mean(value, root) - _about_mean(errors, root[..., None, :]).mean(-1)
    free = total - np.sum(root**4, -1) / total
    between = np.maximum(excess, 0.0) / np.maximum(free, TINY)
    sd = np.hypot(uncertainty, np.sqrt(between)[..., None])
    centre = _mean(value, np.where(smooth, least / sd, 0.0))
    centre = centre + np.sqrt(between)[..., None] / sd * (value - centre)
    centre = np.where(smooth, centre, -np.inf)
    change = (centre[..., None, :] + errors).max(-1) - centre.max(-1, keepdims=True)
    bias, off = change.mean(-1), np.sqrt(np.mean(change**2, -1))
    place = np.argmax(np.where(smooth, value, -np.inf), -1)
    noise_free = np.maximum(_at(value, place) - bias, 0.0)
    without = Largest(noise_free, off, place, change - bias[..., None])
    return _or_raw(without, value, uncertainty, errors, raw) if raw.any() else without


def _or_raw(
    without: Largest, value: Array, uncertainty: Array, errors: Array, raw: Bools
) -> Largest:
    """The largest raw figure as it is, where it is larger than the one found among the others."""
    place = np.argmax(np.where(raw, value, -np.inf), -1)
    more = raw.any(-1) & (raw.all(-1) | (_at(value, place) >= without.value))
    there = np.take_along_axis(errors, place[..., None, None], -1)[..., 0]
    return Largest(
        np.where(more, _at(value, place), without.value),
        np.where(more, _at(uncertainty, place), without.uncertainty),
        np.where(more, place, without.place),
        np.where(more[..., None], there, without.errors),
    )


def _at(values: Array, place: Ints) -> Array:
    """Those of values (..., k) at a place (...)."""
    return np.asarray(np.take_along_axis(values, place[..., None], -1)[..., 0])


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


# --------------------------------------------------------------------------
# Noise-free spreads and errors of a calibrated tool in a test run.
#
# The uncertainty of each statistic is that of the test: noise of its readings, references, setting
# of the stand. That of the calibration is not part of it: an error of the calibration is part of
# what is measured.


NO_ERROR_OF_A_TOOL: dict[str, float] = {
    **dict.fromkeys(("inclination", "azimuth", "toolface"), float(np.radians(5.0))),
    "gravity": 0.01,
    "field": 0.03,
    "dip": float(np.radians(2.0)),
}
"""Departures from a reference of the run that are no error of a tool: radians, g, a share of the field."""
UNDEFINED_AT_VERTICAL = ("azimuth", "toolface")
"""Angles that do not exist at vertical."""
LEVEL = ("inclination", "gravity")
"""Observables that stations of one inclination share at every azimuth."""
REFERENCE_COLUMNS = {name: f"ref_{column}" for name, column in OUTPUTS.items()}
"""Reference column of each observable."""
NO_TOOLFACE = (
    f"the toolface of exactly vertical stations is not known. Give {REFERENCE_COLUMNS['toolface']}"
)
NOT_DETERMINED = "the calibration does not determine "
"""Beginning of the reason why a limit cannot be passed where the calibration leaves a direction open."""
SEEN = 0.7
"""Least share of the amplitude of each harmonic that stations should show."""
WORST_CONDITION = 1e10
"""Condition number of a curve's covariance above which its digits are those of rounding."""
TINY = 1e-15
LEAST_ALONE = 1e-6
"""Least noise of a value beside errors that it shares with others, in sizes of these: their matrix stays regular."""


def directions_in_words(ids: Iterable[str]) -> str:
    """Undetermined directions as people name them, each once.

    >>> directions_in_words(["rotation-x", "rotation-y", "toolface-zero", "rotation-x"])
    'rotation about x and y, toolface zero'
    """
    axes = [
        name.removeprefix("rotation-")
        for name in dict.fromkeys(ids)
        if name.startswith("rotation-")
    ]
    others = [
        name.replace("-", " ") for name in dict.fromkeys(ids) if not name.startswith("rotation-")
    ]
    return ", ".join([*([f"rotation about {' and '.join(axes)}"] if axes else []), *others])


@dataclass(frozen=True)
class Statistic:
    """Spread or error of an observable in a roll set, or error of one station: radians, g or nT.

    `value` is without noise, `raw` with it; `where` says in words what was judged, `label` which set.
    `part` (k,): what the stations `index` show, noise included: errors, or departures from the
    middle of the set. `freedom`: degrees of freedom of the uncertainty, infinite where all of it is
    declared; `errors` (d,): what `value` would be off by in tests like this one.
    `rough`: the error is not smooth, `value` is the raw figure.
    """

    value: float
    uncertainty: float
    raw: float
    where: str
    index: Ints
    part: Array
    label: str = ""
    curve: Curve | None = None
    freedom: float = UNLIMITED
    errors: Array = field(default_factory=lambda: np.zeros(0))
    rough: bool = False


@dataclass(frozen=True)
class Departures:
    """All statistics of one observable in a run, or why there are none.

    `skipped`: why it cannot be judged. `blocked`: why no limit on it can be passed; `unrolled`:
    because the tool was not rolled all round: there is no noise-free value, and `statistics` have
    the raw one. `apart`: parts of the run that were left out, and why. `unseen`:
    the toolfaces hardly show one of the harmonics. `remarks`: ids of findings about the scatter.
    """

    statistics: tuple[Statistic, ...] = ()
    skipped: str = ""
    blocked: str = ""
    unrolled: bool = False
    apart: tuple[str, ...] = ()
    unseen: bool = False
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReferenceErrors:
    """Standard uncertainties of the references of a roll set of k stations.

    `individual` (k,): of each station alone; `together` (k, k): covariance of settings that some stations share, or
    None. `setting` or strength, and `zero` of the stand: of what all stations of the set share.
    """

    individual: Array
    together: Array | None
    setting: float
    zero: float

    @property
    def shared(self) -> float:
        """Standard uncertainty of what all stations of the set share."""
        return float(np.hypot(self.setting, self.zero))


@dataclass(frozen=True)
class _Rolled:
    """Values (k,) of a rolled set to judge, their curve, and the uncertainty of the references.

    `known`: degrees of freedom of the standard deviations of the values, what all values share apart.
    """

    roll_set: RollSet
    part: Array
    curve: Curve
    known: float
    reference: ReferenceErrors


@dataclass(frozen=True)
class RollTest:
    """Readings that a fit has not seen, through its calibration."""

    calibration: Calibration
    readings: Readings

    @cached_property
    def fields(self) -> tuple[Array, Array]:
        """Both corrected vectors (n, 3) of every station."""
        return self.calibration.fields(self.readings)

    @cached_property
    def sets(self) -> list[RollSet]:
        """Roll sets of the run."""
        return roll_sets(self.readings)

    @cached_property
    def near(self) -> Bools:
        """Stations (n,) too near to vertical for azimuth and toolface."""
        return near_vertical(self.readings, self.value("inclination"))

    @cached_property
    def toolface(self) -> Array:
        """Toolface (n,) by which the tool was rolled: near vertical the magnetic one, if there is any."""
        magnetic = self.value("magnetic_toolface")
        upright = np.where(np.isnan(magnetic), self.readings.reference("toolface"), magnetic)
        return np.where(self.near & ~np.isnan(upright), upright, self.value("toolface"))

    def value(self, name: str) -> Array:
        """An observable (n,) of the corrected vectors."""
        return OBSERVABLES[name].value(*self.fields)

    @cached_property
    def settings(self) -> Ints:
        """Number (n,) of the setting of the stand that each station belongs to."""
        return settings_of(self.readings)

    def _noise(self, name: str) -> Array:
        """Standard uncertainty (n,) of an observable by the noise of the test's own readings."""
        gradient = np.nan_to_num(OBSERVABLES[name].gradient(*self.fields))
        noise = self.calibration.noise_covariance(self.readings)
        variance = np.einsum("ni,nij,nj->n", gradient, noise, gradient)
        return np.asarray(np.maximum(np.sqrt(variance), TINY))

    def noise_freedom(self, name: str) -> float:
        """Degrees of freedom of the noise of an observable: infinite where the noise of all triads is declared."""
        triads = self.calibration.triads[: 2 if name in MAGNETIC else 1]
        estimated = [
            t for t in triads if t.name not in self.readings.sd and t.noise_source != "declared"
        ]
        return min((t.degrees_of_freedom for t in estimated), default=UNLIMITED)

    def _common(self, name: str) -> Array:
        """Standard uncertainty (n,) of a reference by errors that all stations of the stand share."""
        return self.readings.common_uncertainty(name, self.value("inclination"))

    def _lacks(self, name: str) -> str:
        """The inputs that an observable lacks; empty if it lacks none."""
        if name not in ("azimuth", "field", "dip"):
            return ""
        if not self.calibration.has_field:
            return "the magnetometer is not calibrated"
        return "" if self.readings.magnetometer is not None else "no columns mx, my, mz"

    def _error(self, name: str) -> Array:
        """Departure (n,) from the reference that the run itself gives; NaN where it gives none."""
        known = self.readings.known.get(name, np.nan)
        return OBSERVABLES[name].difference(self.value(name), known)

    def contradicted(self, name: str) -> float:
        """Median departure from the run's own reference, where it is more than a sound tool shows; else zero."""
        named = self.readings.known.get(name)
        if named is None or self._lacks(name) or (name == "field" and self.calibration.relative):
            return 0.0
        error, most = self._error(name), NO_ERROR_OF_A_TOOL[name]
        error = error[~np.isnan(error) & ~(self.near & (name in UNDEFINED_AT_VERTICAL))]
        if not error.size or bool(self.calibration.rests_on_free(name, self.readings).any()):
            return 0.0
        most *= float(np.nanmedian(named)) if name == "field" else 1.0
        size = float(np.median(np.abs(error)))
        return float(np.copysign(size, np.median(error))) if size > most else 0.0

    def loose(self, index: Ints) -> str:
        """Why stations do not determine a curve of one harmonic or two; empty where they do."""
        if not index.size or np.isnan(self.toolface[index]).any():
            return NO_TOOLFACE
        circle = self._coverage(index)
        if circle.rolled:
            return ""
        return _gap(circle, WIDEST_GAP) or (
            "the toolfaces do not determine a mean and a harmonic. Take six or more, evenly spread"
        )

    def off_plane(self, index: Ints) -> float:
        """Root mean square distance of gravity or field at stations from their plane, as a share of its strength.

        A tool rolled about a fixed axis shows both in a plane, whatever its biases, scales and axes. Without the
        station that is farthest off: a single wrong reading is not the set's.
        """
        shares, count = [0.0], len(index) - 1
        for vectors in (each[index] for each in self.fields):
            strength = np.linalg.norm(vectors, axis=-1)
            v = vectors - vectors.mean(0)
            without = v.T @ v - (count + 1) / count * v[:, :, None] * v[:, None]
            if np.isfinite(without).all() and strength.any():
                least = max(float(np.linalg.eigvalsh(without)[:, 0].min()), 0.0)
                shares.append(float(np.sqrt(least / count) / np.median(strength)))
        return max(shares)

    def harmonics(self, roll_set: RollSet) -> int:
        """Harmonics of the curve that a rolled set determines, 1 or 2."""
        return int(self._coverage(roll_set.index).harmonics)

    def _coverage(self, index: Ints) -> Coverage:
        """How the toolfaces of stations cover the circle."""
        places = tuple(index.tolist())
        if places not in self._coverages:
            self._coverages[places] = coverage(self.toolface[index])
        return self._coverages[places]

    @cached_property
    def _coverages(self) -> dict[tuple[int, ...], Coverage]:
        """Coverages by stations: a set is asked for again by every limit."""
        return {}

    def unfit(self, name: str, roll_set: RollSet) -> str:
        """Why a roll set has no spread of an observable; empty where it has."""
        if not roll_set.one_azimuth and name not in LEVEL:
            return f"stations of one direction need group or {REFERENCE_COLUMNS['azimuth']}"
        if name in UNDEFINED_AT_VERTICAL and self.near[roll_set.index].any():
            return "within 5° of vertical"
        blank = name == "toolface" and np.isnan(self._error(name)[roll_set.index]).any()
        return f"no {REFERENCE_COLUMNS[name]}" if blank else ""

    def spread(self, name: str) -> Departures:
        """The widest noise-free spread over the roll sets.

        A group that was not rolled cannot pass, nor can sets of equal reference directions if
        none of them was; other sets that were not rolled are left out. Toolface: of its error.
        """
        lacks = self._lacks(name)
        if lacks or not self.sets:
            return Departures(skipped=lacks or f"no {ROLL_SET} stations of one direction, to 0.05°")
        unfit = {s.label: self.unfit(name, s) for s in self.sets}
        fit = [s for s in self.sets if not unfit[s.label]]
        gaps = {s.label: self.loose(s.index) for s in fit}
        rolled = [s for s in fit if not gaps[s.label]]
        wrong = [s for s in fit if gaps[s.label] and (s.declared or (s.one_azimuth and not rolled))]
        kept = {s.label for s in (*rolled, *wrong)}
        apart = (
            *(f"{label}: {why}" for label, why in unfit.items() if why),
            *(f"{label}: not rolled, {gap}" for label, gap in gaps.items() if label not in kept),
        )
        if not kept:
            return Departures(skipped="; ".join(apart))
        free = any(self._free_spread(name, s.index) for s in fit)
        unrolled = f"{wrong[0].label} was not rolled: {gaps[wrong[0].label]}" if wrong else ""
        statistics, remarks = self._curves(name, rolled, False)
        statistics += [self._unrolled(name, s) for s in wrong]
        unseen = any(self.harmonics(s) < max(FITTED) for s in rolled)
        return self._outcome(name, statistics, free, unrolled, apart, unseen, remarks)

    def _unrolled(self, name: str, roll_set: RollSet) -> Statistic:
        """Spread, with its noise, of a set that was not rolled."""
        index, label = roll_set.index, roll_set.label
        part = self._centred(name, roll_set)
        raw, middle = float(np.ptp(part)), (part.max() + part.min()) / 2
        return Statistic(raw, 0.0, raw, label, index, part - middle, label)

    def error(self, name: str) -> Departures:
        """The largest noise-free departure from the reference: of rolled sets, and other stations.

        Cannot be passed on stations that were not, taken together, rolled all round.
        """
        if lacks := self._lacks(name):
            return Departures(skipped=lacks)
        given = ~np.isnan(self._error(name))
        near = given & self.near & (name in UNDEFINED_AT_VERTICAL)
        judged = np.flatnonzero(given & ~near)
        if not judged.size:
            steep = "every station within 5° of vertical"
            return Departures(skipped=steep if near.any() else f"no {REFERENCE_COLUMNS[name]}")
        free = bool(self.calibration.rests_on_free(name, self.readings)[judged].any())
        known = self.toolface[judged][~np.isnan(self.toolface[judged])]
        circle = coverage(known) if known.size else None
        gap = NO_TOOLFACE if circle is None else _gap(circle, OPEN)
        unrolled = f"the stations were not rolled: {gap}" if gap else ""
        unseen = circle is not None and not gap and bool(circle.seen.min() < SEEN)
        left = f"{near.sum()} of {given.sum()} stations lie within 5° of vertical"
        apart = (left,) if near.any() else ()
        statistics, remarks = self._errors(name, judged)
        return self._outcome(name, statistics, free, unrolled, apart, unseen, remarks)

    def _outcome(
        self, name: str, statistics: list[Statistic], free: bool, unrolled: str,
        apart: tuple[str, ...], unseen: bool, remarks: tuple[str, ...],
    ) -> Departures:  # fmt: skip
        """The statistics, and why no limit can be passed: `free` and `unrolled` are reasons."""
        if name == "field" and self.calibration.relative:
            return Departures(blocked="the calibration is relative: field = 1, not nT", apart=apart)
        blocked = NOT_DETERMINED + self._open_directions(name) if free else unrolled
        return Departures(tuple(statistics), "", blocked, bool(unrolled), apart, unseen, remarks)

    def _open_directions(self, name: str) -> str:
        """Undetermined directions in words; the zero of toolface where an angle rests on it, or on nothing else."""
        ids = [entry.id for entry in self.calibration.undetermined()]
        others = [each for each in ids if each != "toolface-zero" or name.endswith("toolface")]
        return directions_in_words(others or ids)

    def _errors(self, name: str, judged: Ints) -> tuple[list[Statistic], tuple[str, ...]]:
        """Largest errors of rolled sets, and of each station outside of them."""
        seen = [replace(s, index=s.index[np.isin(s.index, judged)]) for s in self.sets]
        whole = [s for s in seen if not self.loose(s.index) and (s.one_azimuth or name in LEVEL)]
        inside = np.concatenate([s.index for s in whole]) if whole else ()
        alone = judged[~np.isin(judged, inside)]
        curves, remarks = self._curves(name, whole, True)
        return curves + self._single(name, alone), remarks

    def _single(self, name: str, alone: Ints) -> list[Statistic]:
        """The error of each of some stations (k,)."""
        error, noise = self._error(name)[alone], self._noise(name)[alone]
        reference, common = self.readings.uncertainty(name)[alone], self._common(name)[alone]
        sd = np.sqrt(noise**2 + reference**2 + common**2)
        freedom = self.noise_freedom(name) * (sd / noise) ** 4
        drawn = noise * draws(f"noise of {name}", self.readings.count)[:, alone]
        drawn = drawn + reference * self._reference_draws(name, alone)
        errors = np.sign(error) * (drawn + common * draws(f"zero of {name}", 1))
        return [
            Statistic(
                abs(float(error[k])), float(sd[k]), abs(float(error[k])),
                f"station {self.readings.labels[i]}", alone[k : k + 1], error[k : k + 1],
                freedom=float(freedom[k]), errors=errors[:, k],
            )
            for k, i in enumerate(alone)
        ]  # fmt: skip

    def _reference_draws(self, name: str, index: Ints) -> Array:
        """Standard normal numbers (d, k) of the references of stations, the same for those of one setting."""
        numbers = draws(f"reference {name}", self.readings.count)
        if name in ANGLES:
            return numbers[:, self.settings[index] if name in DIRECTION else index]
        return np.broadcast_to(numbers[:, :1], (len(numbers), len(index)))

    def _curves(
        self, name: str, sets: Sequence[RollSet], error: bool
    ) -> tuple[list[Statistic], tuple[str, ...]]:
        """Noise-free spread, or largest error, of rolled sets, and remarks on their scatter."""
        if not sets:
            return [], ()
        rolled = [self._rolled(name, s, error) for s in sets]
        doubted = False
        if name in DIRECTION and is_assumed(self.readings):
            doubted = any(bool(each.curve.rough(each.known)) for each in rolled)
        if doubted:  # that the direction was set once was an assumption
            rolled = [self._rolled(name, s, error, doubted) for s in sets]
        noise = scatter([each.curve for each in rolled], min(each.known for each in rolled))
        remarks = {"little-scatter": bool(noise.calm), "settings-doubted": doubted}
        statistics = [self._curve_of(name, each, noise, error) for each in rolled]
        return statistics, tuple(remark for remark, holds in remarks.items() if holds)

    def _rolled(self, name: str, roll_set: RollSet, error: bool, doubted: bool = False) -> _Rolled:
        """The values of a rolled set, their curve, and what their errors would be in other tests."""
        index = roll_set.index
        part = self._error(name)[index] if error else self._centred(name, roll_set)
        if turn := OBSERVABLES[name].period:  # errors on both sides of half a turn are alike
            line = unrolled(part, turn)
            part = line if np.ptp(line) < turn / 4 else part
        noise, reference = self._noise(name)[index], self.reference_errors(name, roll_set, error)
        individual, together = reference.individual, reference.together
        if doubted and not roll_set.declared:
            individual = np.maximum(individual, self.readings.uncertainty(name)[index])
        sd = np.hypot(noise, individual)
        among = np.zeros(sd.shape) if together is None else np.sqrt(np.diagonal(together))
        sd = np.maximum(sd, LEAST_ALONE * among)
        curve = fitted(part, sd, self.toolface[index], self.harmonics(roll_set), together)
        places = FITTED[curve.harmonics]
        numbers = [*curve.coefficients, *curve.covariance.flat]
        covariance = curve.covariance[np.ix_(places, places)]
        if not np.isfinite(numbers).all() or np.linalg.cond(covariance) > WORST_CONDITION:
            raise InputError(
                f"{self.readings.source}: the uncertainties of {roll_set.label} are too far apart to judge "
                f"its {name}. Check the columns sd_: they are in the unit of their column."
            )
        whole, apart = np.mean(sd**2 + among**2), self._readback(name, roll_set, error).var(ddof=1)
        noisy, read = (float(x / whole) ** 2 for x in (np.mean(noise**2), apart))
        unknown = noisy / self.noise_freedom(name) + read / (len(index) - 1)
        known = 1 / unknown if unknown else UNLIMITED
        return _Rolled(roll_set, part, curve, known, reference)

    def _curve_of(self, name: str, rolled: _Rolled, noise: NoiseScale, error: bool) -> Statistic:
        """Noise-free spread, or largest error, of a rolled set."""
        roll_set, part, curve = rolled.roll_set, rolled.part, rolled.curve
        first, reference = int(roll_set.index[0]), rolled.reference
        judged = figure(part, curve, noise, error, drawn(curve, name, first))
        most, least, farthest = np.degrees(ends(curve))
        spread = f"least at toolface {least:.0f}°, most at {most:.0f}°"
        where = f"{roll_set.label}; {f'largest at toolface {farthest:.0f}°' if error else spread}"
        if curve.rough(noise.known):
            left = float(f"{curve.scale:.2g}")
            where += f"; {RAW_JUDGED}: the readings leave a smooth curve by {left:g} × their noise"
        if not error:
            curve, middle = about_middle(curve)
            part = part - middle
        sd = float(np.hypot(judged.uncertainty, reference.shared))
        share = float(judged.uncertainty / sd) ** 2
        freedom = float(judged.freedom) / max(share, TINY) ** 2
        return Statistic(
            float(judged.value), sd, float(judged.raw), where, roll_set.index, part, roll_set.label,
            curve, freedom, judged.errors + judged.side * self.common_errors(name, reference, first),
            bool(judged.rough),
        )  # fmt: skip

    def reference_errors(self, name: str, roll_set: RollSet, error: bool) -> ReferenceErrors:
        """Standard uncertainties of the references of a set, as a spread or an error has them.

        The error of a setting of the stand is common to the stations that share it, and does not average down.
        Beside it readbacks of one setting err as much as they scatter.
        """
        index = roll_set.index
        sd, number = self.readings.uncertainty(name)[index], self.settings[index]
        zero = float(self._common(name)[index].max()) if error else 0.0
        alone = np.full(sd.shape, self._readback(name, roll_set, error).std(ddof=1))
        if name in DIRECTION and self._set_unseen(name, index):
            return ReferenceErrors(np.full(sd.shape, self._setting_error(name)), None, 0.0, zero)
        if name == "toolface":
            return ReferenceErrors(sd, None, 0.0, zero)
        if name in ANGLES and not roll_set.declared and len(set(number.tolist())) > 1:
            same = number[:, None] == number
            if np.trace(same) == same.sum():
                return ReferenceErrors(np.hypot(sd, alone), None, 0.0, zero)
            return ReferenceErrors(alone, same * np.outer(sd, sd), 0.0, zero)
        most = float(sd.max()) if error else 0.0
        whole = most * float(np.sqrt(np.mean((sd / most) ** 2))) if most else 0.0
        return ReferenceErrors(alone, None, whole, zero)

    def _set_unseen(self, name: str, index: Ints) -> bool:
        """Whether the stand was set at each of some stations, and the run has not to what angle."""
        unknown = np.isnan(self.readings.reference(name)[index]).all()
        return self.readings.settings == "per-station" and bool(unknown)

    def _setting_error(self, name: str) -> float:
        """Standard uncertainty of one setting of an angle by the profile, radians."""
        stand, angle = self.calibration.profile.stand, f"{name}_deg"
        return float(np.radians(np.hypot(stand.of(angle), stand.repeatability(angle))))

    def common_errors(self, name: str, reference: ReferenceErrors, first: int) -> Array:
        """Error that a set (its `first` station) shares (d,) in tests like this one."""
        setting = self._reference_draws(name, np.array([first]))[:, 0]
        return reference.setting * setting + reference.zero * draws(f"zero of {name}", 1)[:, 0]

    def _centred(self, name: str, roll_set: RollSet) -> Array:
        """Values (k,) of a set about their middle, less what its readbacks differ by; of toolface its errors."""
        index = roll_set.index
        part = (self._error(name) if name == "toolface" else self.value(name))[index]
        part = part - self._readback(name, roll_set, False)
        periodic = OBSERVABLES[name].period
        middle = np.angle(resultant(part)) if periodic else part.mean()
        return OBSERVABLES[name].difference(part, middle)

    def _readback(self, name: str, roll_set: RollSet, error: bool) -> Array:
        """Differences (k,) of references within a set that are part of its spread or error, otherwise zero.

        A declared set stands still: its spread is that of the values.
        """
        if name not in DIRECTION or (roll_set.declared and not error):
            return np.zeros(len(roll_set.index))
        return np.nan_to_num(readback(self.readings.reference(name)[roll_set.index]))

    def _free_spread(self, name: str, index: Ints) -> bool:
        """Whether the spread of a set moves with a direction that no evidence determines."""
        if not self.calibration.free:
            return False
        rows = np.nan_to_num(self.calibration.sensitivity(name, self.readings)[index])
        moved = rows @ self.calibration.free_directions.transpose()
        size = self.calibration.earth.get("field", 1.0) if OBSERVABLES[name].unit == "nT" else 1.0
        return bool((np.ptp(moved, axis=0) > FREE_SHARE * size).any())


def _gap(circle: Coverage, most: float) -> str:
    """The sentence on toolfaces that leave a gap wider than `most` (radians); empty if they do not."""
    if circle.gap <= most + SLACK:
        return ""
    width, start = round(float(np.degrees(circle.gap))), round(float(np.degrees(circle.start)))
    span = f"{width}° from {start % 360}° to {(start + width) % 360}°"
    return f"the toolfaces leave a gap of {span} (at most {np.degrees(most):.0f}°). Add toolfaces there"
