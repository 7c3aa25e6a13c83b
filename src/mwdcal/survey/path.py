"""Well path: minimum curvature between survey stations, and its derivative.

Between two stations the hole is an arc of a circle. With unit vectors t₁, t₂ along the hole, dogleg β
between them and course length L the arc leads from one station to the next by

    L s (t₁ + t₂),    s = tan(β/2) / β

Positions are (north, east, down) from the start, m; north is that of the azimuths. Stations lie on the
last axis of depths and angles, wells on those before.

Uncertainty of position along a well, from errors that last and errors that are new at every station.

An error of a survey station turns the direction of the hole there by two angles, rad: *upward*, which is the error of
inclination, and *sideways*, which is sin(inclination) times the error of azimuth. Both stay finite at vertical,
where azimuth itself does not exist. A third number, where there is one, is the error of measured depth, m.

Errors reach the position through the derivative of minimum curvature at both ends of every arc. The shifts that one
lasting cause makes along the well are added before they are squared; those of independent causes after.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import FREE_SHARE, Calibration, Slopes
from mwdcal.errors import InputError
from mwdcal.geometry.observables import VERTICAL, is_vertical
from mwdcal.geometry.vectors import Array, ArrayLike, Bools, dot, length, outer, square_root, wrap
from mwdcal.survey.stations import STATIONS_AT_ONCE, blocks
from mwdcal.use.uncertainty import rows_of

_SHORT = 0.03
"""Dogleg, rad, below which a series has more digits than the closed form."""
SLOPES_KEPT = 1 << 14
"""Readings whose slopes are kept, 1.4 kB each; those of more are worked out again where they are asked for."""


def hole_direction(inclination: ArrayLike, azimuth: ArrayLike) -> Array:
    """Unit vector (…, 3) along the hole: north, east, down.

    Units: radians. Singular: at vertical any azimuth will do, also NaN.
    """
    inc, azi = np.broadcast_arrays(np.asarray(inclination, float), np.asarray(azimuth, float))
    across = np.sin(inc)
    azi = np.where(np.abs(across) <= VERTICAL, 0.0, azi)
    return np.stack([across * np.cos(azi), across * np.sin(azi), np.cos(inc)], -1)


@dataclass(frozen=True)
class Arcs:
    """Arcs between neighbouring stations: unit vectors (…, n - 1, 3) at both ends, course length (…, n - 1), m.

    `balanced`: by the balanced tangential method, s = 1/2 whatever the dogleg.
    Singular: NaN where both ends point in exactly opposite directions, as the plane of the arc is not known.
    """

    upper: Array
    lower: Array
    length: Array
    balanced: bool = False

    @property
    def dogleg(self) -> Array:
        """Angle (…, n - 1) between both ends, rad; exact for small ones too."""
        return 2 * np.arctan2(*self._half())

    def _half(self) -> tuple[Array, Array]:
        """Sine and cosine of half the dogleg."""
        sine = length(self.lower - self.upper) / 2
        return sine, length(self.lower + self.upper) / 2

    def _share(self) -> Array:
        """The share s = tan(β/2) / β of the sum of both directions."""
        if self.balanced:
            return np.full_like(self.length, 0.5)
        sine, cosine = self._half()
        angle = 2 * np.arctan2(sine, cosine)
        straight = angle < _SHORT
        series = 0.5 + angle**2 / 24 + angle**4 / 240 + angle**6 * 17 / 40320
        cosine = np.where(cosine > VERTICAL, cosine, np.nan)
        return np.where(straight, series, sine / cosine / np.where(straight, 1.0, angle))

    @property
    def displacement(self) -> Array:
        """Steps (…, n - 1, 3) from each station to the next, m."""
        return (self.length * self._share())[..., None] * (self.upper + self.lower)

    @property
    def by_length(self) -> Array:
        """Derivative (…, n - 1, 3) of the step with respect to the course length."""
        return self._share()[..., None] * (self.upper + self.lower)

    def by_directions(self) -> tuple[Array, Array]:
        """Derivatives (…, n - 1, 3, 3) of the step, m, with respect to the direction at each end.

        Definition: d(s (t₁ + t₂)) with ds = s' (t₂·dt₁ + t₁·dt₂), s' = (sin β - β) / (2 β² cos²(β/2) sin β);
        directions change across themselves, so that they stay unit vectors.
        """
        total, length = self.upper + self.lower, self.length[..., None, None]
        straight = self._share()[..., None, None] * np.eye(3)
        bend = self._bend()[..., None, None]
        upper, lower = (straight + bend * outer(total, end) for end in (self.lower, self.upper))
        return length * upper, length * lower

    def _bend(self) -> Array:
        """The derivative s' of that share with respect to cos β."""
        if self.balanced:
            return np.zeros_like(self.length)
        sine, cosine = self._half()
        angle = 2 * np.arctan2(sine, cosine)
        straight = angle < _SHORT
        # s = tan(β/2)/β in powers of β, differentiated, over -sin β
        series = -(1 / 12 + angle**2 / 60 + angle**4 * 17 / 6720) / np.sinc(angle / np.pi)
        safe, cosine = np.where(straight, 1.0, angle), np.where(cosine > VERTICAL, cosine, np.nan)
        whole = 4 * sine * cosine**3 * safe**2
        return np.where(
            straight, series, (2 * sine * cosine - safe) / np.where(straight, 1.0, whole)
        )


def arcs(md: ArrayLike, direction: Array, balanced: bool = False) -> Arcs:
    """The arcs between stations at measured depths (…, n), m, with directions (…, n, 3)."""
    length = np.diff(np.asarray(md, float))
    return Arcs(direction[..., :-1, :], direction[..., 1:, :], length, balanced)


def well_path(
    md: ArrayLike,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """Positions (…, n, 3) of survey stations by minimum curvature: north, east, true vertical depth.

    Units: m, radians. `start` (…, 3): position of the first station. North is that of the azimuths.
    Singular: at vertical the azimuth may be NaN; NaN from a station on that turns back by exactly 180°.
    Reference: Sawaryn and Thorogood, SPE 84246.
    """
    md, inc, azi = np.broadcast_arrays(md, inclination, azimuth)
    step = arcs(md, hole_direction(inc, azi)).displacement
    first = np.broadcast_to(np.asarray(start, float)[..., None, :], (*step.shape[:-2], 1, 3))
    return np.cumsum(np.concatenate([first, step], -2), -2)


@dataclass(frozen=True)
class DirectionErrors:
    """The direction of the hole at survey stations (…, n), and its errors.

    Attributes:
        inclination: rad (…, n).
        azimuth: rad (…, n); at vertical the direction that counts as upward there.
        systematic: shifts (…, n, k, 2) upward and sideways, rad, by one standard deviation of each of k
            independent causes that last over the well.
        random: covariance (…, n, 2, 2) of the errors that are new at every station, rad².
        course: the same of a turn of the whole course that ends at each station; None: exact.
    """

    inclination: Array
    azimuth: Array
    systematic: Array
    random: Array
    course: Array | None = None

    def stations(self, where: slice) -> DirectionErrors:
        """Those of some stations."""
        pairs = (..., where, slice(None), slice(None))
        angles = self.inclination[..., where], self.azimuth[..., where]
        course = None if self.course is None else self.course[pairs]
        return DirectionErrors(*angles, self.systematic[pairs], self.random[pairs], course)

    def followed_by(self, others: DirectionErrors) -> DirectionErrors:
        """Those of both, one after the other."""
        return DirectionErrors(
            np.concatenate([self.inclination, others.inclination], -1),
            np.concatenate([self.azimuth, others.azimuth], -1),
            np.concatenate([self.systematic, others.systematic], -3),
            np.concatenate([self.random, others.random], -3),
            None
            if self.course is None or others.course is None
            else np.concatenate([self.course, others.course], -3),
        )


class _Sums(NamedTuple):
    """What has added up at the last station (…) of a part of a well.

    `shift` (…, k, 3): of its position, by each lasting cause; `settled` (…, 3, 3): covariance by random errors of the
    stations before it; `arrival` (…, m, 3): shift of its position by each of its own random errors.
    """

    position: Array
    shift: Array
    settled: Array
    arrival: Array


class TieIn(NamedTuple):
    """Where a path is tied in: its direction is taken as exact, and its place as well where it has no covariance.

    Units: measured depth m, inclination and azimuth (from the north of the path) rad, place (3,) m, covariance (3, 3)
    of the place, m², which is independent of all errors below it.
    """

    md: float
    inclination: float
    azimuth: float
    place: Array
    covariance: Array | None = None

    def before(self, errors: DirectionErrors) -> PathEnd:
        """The end of a path that leads there, for stations with such `errors` to follow."""

        def none(like: Array) -> Array:
            return np.zeros((1, *like.shape[-2:]))

        course = None if errors.course is None else none(errors.course)
        exact = DirectionErrors(
            np.array([self.inclination]), np.array([self.azimuth]),
            none(errors.systematic), none(errors.random), course,
        )  # fmt: skip
        md = np.array([self.md])
        sums = _no_sums(md, exact, self.place)
        if self.covariance is not None:
            sums = sums._replace(settled=self.covariance)
        return PathEnd(md, exact, sums, np.full(md.shape, np.nan))


class PathEnd(NamedTuple):
    """Where a path has come to: depth (…, 1) and errors of its last station, and what has added up there.

    `above` (…, 1) is the depth of the station before the last, or NaN.
    """

    md: Array
    errors: DirectionErrors
    sums: _Sums
    above: Array

    def widened(self, causes: int) -> PathEnd:
        """The same with room for more lasting causes, which so far have done nothing."""
        errors, sums = self.errors, self.sums
        return self._replace(
            errors=replace(errors, systematic=_widened(errors.systematic, causes)),
            sums=sums._replace(shift=_widened(sums.shift, causes)),
        )


def _widened(shifts: Array, causes: int) -> Array:
    """Shifts (…, k, m) with zeros up to so many causes."""
    lacking = np.zeros((*shifts.shape[:-2], causes - shifts.shape[-2], shifts.shape[-1]))
    return np.concatenate([shifts, lacking], -2)


@dataclass(frozen=True)
class CauseOrder:
    """The order of lasting causes along several runs: those before a run, then those that it adds.

    `names` of all, empty for those of one run alone; `places` in them of the causes of the run.
    """

    names: tuple[str, ...]
    places: tuple[int, ...]

    @staticmethod
    def of(before: tuple[str, ...], causes: tuple[str, ...]) -> CauseOrder:
        """For a run with some `causes`, after runs with those `before`."""
        names, places = [*before], []
        for name in causes:
            if name and name in before:
                places.append(before.index(name))
            else:
                places.append(len(names))
                names.append(name)
        return CauseOrder((*names,), (*places,))

    def placed(self, errors: DirectionErrors) -> DirectionErrors:
        """The errors of the run with its causes at their places, and zeros for all others."""
        shifts = errors.systematic
        systematic = np.zeros((*shifts.shape[:-2], len(self.names), shifts.shape[-1]))
        systematic[..., list(self.places), :] = shifts
        return replace(errors, systematic=systematic)


def tilts(inclination: ArrayLike, azimuth: ArrayLike) -> Array:
    """Changes (…, 2, 3) of the hole's direction, north, east, down, by a turn upward and one sideways.

    Units: radians. Singular: nowhere, but azimuth must be a number at vertical too.
    """
    inc, azi = np.broadcast_arrays(np.asarray(inclination, float), np.asarray(azimuth, float))
    ci, ca, sa = np.cos(inc), np.cos(azi), np.sin(azi)
    rows = [ci * ca, ci * sa, -np.sin(inc), -sa, ca, np.zeros_like(sa)]
    return np.stack(rows, -1).reshape(*inc.shape, 2, 3)


def direction_gradient(g: Array, b: Array) -> tuple[Array, Array]:
    """Azimuth (…) of the tool axis, and the gradient (…, 2, 6) of its direction, upward and sideways, by (g, b).

    Definition: with unit vectors in the tool's frame, d down, e magnetic east, h where the axis points on the map and
    l = d × h to the right of it: upward -h·δg / |g|, sideways
    (tan(dip) sin I e - cos I l)·δg / |g| - sin I e·δb / (|b| cos dip).
    Units: rad per unit of g and of b. Singular: finite at vertical, where h is taken as at toolface zero and the
    azimuth is the magnetic toolface; NaN where g and b are parallel.
    """
    strength, vertical = length(g)[..., None], is_vertical(g)[..., None]
    d = g / strength
    normal = np.cross(d, b)
    horizontal = length(normal)[..., None]
    e = normal / np.where(horizontal > 0, horizontal, np.nan)
    cosine = d[..., 2:]
    sine = np.where(vertical, 0.0, np.hypot(d[..., :1], d[..., 1:2]))
    heading = np.where(vertical, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]) - cosine * d)
    h = heading / length(heading)[..., None]
    along = dot(d, b)[..., None] / horizontal
    sideways = (along * sine * e - cosine * np.cross(d, h)) / strength
    rows = [np.concatenate([-h / strength, np.zeros_like(b)], -1)]
    rows.append(np.concatenate([sideways, -sine * e / horizontal], -1))
    north = np.cross(e, d)
    azimuth = np.arctan2(dot(h, e), dot(h, north))
    return wrap(azimuth), np.stack(rows, -2)


class SeenDirection(NamedTuple):
    """Vectors (…, n, 3) of readings as corrected, what `direction_gradient` makes of them, and their slopes."""

    g: Array
    b: Array
    azimuth: Array
    gradient: Array
    slopes: Slopes | None

    @classmethod
    def of(cls, calibration: Calibration, readings: Readings, slopes: bool = True) -> SeenDirection:
        """Those of some readings; `slopes` only if wanted."""
        g, b = calibration.fields(readings)
        return cls(
            g, b, *direction_gradient(g, b), calibration.slopes(readings) if slopes else None
        )

    @classmethod
    def of_many(cls, calibration: Calibration, readings: Readings) -> SeenDirection:
        """Those of readings (n,), worked out in blocks; slopes of no more than `SLOPES_KEPT`."""
        kept = readings.count <= SLOPES_KEPT
        parts = [cls.of(calibration, some, kept) for some in blocks(readings)]
        each = map(np.concatenate, zip(*(part[:4] for part in parts), strict=True))
        slopes = zip(*(part.slopes for part in parts if part.slopes), strict=True)
        return cls._make([*each, Slopes(*map(np.concatenate, slopes)) if kept else None])

    def part(self, rows: slice | Bools) -> SeenDirection:
        """Those of some of them."""
        each = [values[rows] for values in self[:4]]
        return SeenDirection._make([*each, self.slopes and self.slopes.part(rows)])


def direction_errors(
    calibration: Calibration,
    readings: Readings,
    north: float | Array = 0.0,
    declination_sd: float | Array = 0.0,
    declination_noise: float | Array = 0.0,
    seen: SeenDirection | None = None,
) -> DirectionErrors:
    """The direction of the hole at readings (…, n), with its errors from the calibration and from noise.

    Errors of the calibration last over the well, with the uncertainty of north as one cause more; noise is new at every
    station.
    Units: radians. `north`: declination, for azimuths from true north, less convergence, for those from
    grid north; `declination_sd`: its standard uncertainty, and `declination_noise` what is new at every station; each
    one value, or one for each station (n,). `seen`: the direction, where it is known already.
    Singular: finite at vertical. NaN where the direction rests on what no evidence determines, and without a field.
    """
    seen = seen or SeenDirection.of(calibration, readings)
    g, _, azimuth, gradient = seen[:4]
    jacobian, noise = seen.slopes or calibration.slopes(readings)
    change = gradient @ jacobian
    free = np.abs(change @ calibration.free_directions.transpose()) > FREE_SHARE
    flat = change.reshape(-1, change.shape[-1])  # one product is faster than one for each reading
    shifts = flat @ square_root(calibration.parameter_covariance)
    shifts = shifts.reshape(*change.shape[:-1], shifts.shape[-1])
    shifts = np.where(np.any(free, (-1, -2), keepdims=True), np.nan, shifts.swapaxes(-1, -2))
    inclination = np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2])
    turn = np.stack([np.zeros_like(inclination), np.sin(inclination)], -1)
    return DirectionErrors(
        inclination=inclination,
        azimuth=wrap(azimuth + north),
        systematic=np.concatenate(
            [shifts, turn[..., None, :] * np.asarray(declination_sd)[..., None, None]], -2
        ),
        random=gradient @ noise @ gradient.mT
        + np.asarray(declination_noise)[..., None, None] ** 2 * outer(turn),
    )


def position_covariance(
    md: ArrayLike,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    systematic: ArrayLike | None = None,
    random: ArrayLike | None = None,
    balanced: bool = False,
    course: ArrayLike | None = None,
) -> Array:
    """Covariance (…, n, 3, 3) of the positions (north, east, down) of survey stations, m².

    `systematic` (…, n, k, 2 or 3): shifts upward, sideways and, where there is a third, in measured depth, by one
    standard deviation of each of k independent causes that last over the well. `random` (…, n, 2, 2 or 3, 3):
    covariance of the same of the errors that are new at every station. `course` (…, n, 2, 2): of a turn, upward and
    sideways, of the whole course that ends at a station.
    `balanced`: by the balanced tangential method, as the numbers of published error models are.
    The first station is where the path starts: its position is exact, its direction has the errors given for it.
    Units: m, radians. Singular: finite at vertical, with any number for the azimuth that the shifts refer to.
    Memory: of the result and of the causes given, however many stations there are.
    """
    md, inc, azi = (
        np.asarray(each, float) for each in np.broadcast_arrays(md, inclination, azimuth)
    )
    lasting = np.zeros((*md.shape, 0, 2)) if systematic is None else np.asarray(systematic, float)
    new = np.zeros((*md.shape, 2, 2)) if random is None else np.asarray(random, float)

    turned = None if course is None else np.asarray(course, float)
    whole = DirectionErrors(inc, azi, lasting, new, turned)

    def part(where: slice) -> tuple[Array, DirectionErrors]:
        return md[..., where], whole.stations(where)

    return np.concatenate(
        [covariance for _, covariance, _ in _along(md.shape[-1], part, balanced=balanced)], -3
    )


def calibrated_path(
    calibration: Calibration,
    readings: Readings,
    md: ArrayLike,
    north: float = 0.0,
    declination_sd: float = 0.0,
    start: ArrayLike = (0.0, 0.0, 0.0),
    declination_noise: float = 0.0,
) -> tuple[Array, Array]:
    """Positions (n, 3), north, east, true vertical depth, m, of readings in a well, and their covariance (n, 3, 3).

    As `well_path` and `position_covariance` of `direction_errors`, in memory that the causes of error do not enter.
    A station without a direction leaves none of the following ones a position: leave it out.

    Raises:
        InputError: the depths do not increase.
    """
    norths = north, declination_sd, declination_noise
    return continued_path(calibration, readings, md, norths, start)[:2]


def continued_path(
    calibration: Calibration,
    readings: Readings,
    md: ArrayLike,
    norths: tuple[ArrayLike, ArrayLike, ArrayLike],
    before: ArrayLike | TieIn | PathEnd = (0.0, 0.0, 0.0),
    more: Callable[[DirectionErrors, slice], DirectionErrors] | None = None,
    seen: SeenDirection | None = None,
) -> tuple[Array, Array, PathEnd]:
    """The same of readings that follow others of their well, and where the path has come to.

    `norths` as of `direction_errors`. `before`: the position of the first station, where the path is tied in, or where
    it had come to: a well in parts has the positions that it has as a whole. `more` adds errors to those of the
    directions at some rows. `seen`: directions of the readings, where they are known already.
    """
    depth = np.asarray(md, float)
    last = [np.atleast_1d(before.md)] if isinstance(before, TieIn | PathEnd) else []
    if not (np.diff(np.concatenate([*last, depth])) > 0).all():
        raise InputError(
            "`md` must increase from station to station. Sort the stations by measured depth."
        )

    each_north = [np.broadcast_to(np.asarray(value, float), depth.shape) for value in norths]

    def part(where: slice) -> tuple[Array, DirectionErrors]:
        some = rows_of(readings, where)
        offset, shared, alone = (value[where] for value in each_north)
        known = seen and seen.part(where)
        errors = direction_errors(calibration, some, offset, shared, alone, known)
        return depth[where], errors if more is None else more(errors, where)

    place, covariance, end = [], [], None
    for each in _along(len(depth), part, before):
        place.append(each[0])
        covariance.append(each[1])
        end = each[2]
    assert end is not None
    return np.concatenate(place), np.concatenate(covariance), end


def _along(
    count: int,
    part: Callable[[slice], tuple[Array, DirectionErrors]],
    before: ArrayLike | TieIn | PathEnd = (0.0, 0.0, 0.0),
    balanced: bool = False,
) -> Iterator[tuple[Array, Array, PathEnd]]:
    """Positions (…, m, 3) and covariance (…, m, 3, 3) of all stations, some at a time, and where each part ends."""
    for first in range(0, max(count, 1), STATIONS_AT_ONCE):
        md, errors = part(slice(first, first + STATIONS_AT_ONCE))
        new = slice(0, None)
        if isinstance(before, TieIn):
            before = before.before(errors)
        if isinstance(before, PathEnd):  # each part begins with the last station of the one before
            md = np.concatenate([before.md, md], -1)
            errors, sums = before.errors.followed_by(errors), before.sums
            new = slice(1, None)
        else:
            sums = _no_sums(md, errors, before)
        position, covariance, sums = _part_of_path(md, errors, sums, balanced)
        above = md[..., -2:-1] if md.shape[-1] > 1 else np.full(md.shape, np.nan)
        before = PathEnd(md[..., -1:], errors.stations(slice(-1, None)), sums, above)
        yield position[..., new, :], covariance[..., new, :, :], before


def _no_sums(md: Array, errors: DirectionErrors, start: ArrayLike) -> _Sums:
    wells, causes = md.shape[:-1], errors.systematic.shape[-2]
    position = np.broadcast_to(np.asarray(start, float), (*wells, 3))
    arrival = np.zeros((*wells, errors.random.shape[-1], 3))
    return _Sums(position, np.zeros((*wells, causes, 3)), np.zeros((*wells, 3, 3)), arrival)


def _part_of_path(
    md: Array, errors: DirectionErrors, before: _Sums, balanced: bool
) -> tuple[Array, Array, _Sums]:
    """Positions and covariance of stations the first of which has the sums `before`, and those of the last."""
    arc = arcs(md, hole_direction(errors.inclination, errors.azimuth), balanced)
    turns = tilts(errors.inclination, errors.azimuth)
    upper, lower = _reach(arc, turns)
    shifts, random = errors.systematic, errors.random
    rows = slice(shifts.shape[-1])
    step = (
        shifts[..., :-1, :, :] @ upper[..., rows, :] + shifts[..., 1:, :, :] @ lower[..., rows, :]
    )
    position = _sums_from(before.position, arc.displacement, -2)
    shift = _sums_from(before.shift, step, -3)
    rows = slice(random.shape[-1])
    arrival = np.concatenate([before.arrival[..., None, :, :], lower[..., rows, :]], -3)
    through = arrival[..., :-1, :, :] + upper[..., rows, :]
    passed = through.mT @ random[..., :-1, :, :] @ through
    if errors.course is not None:
        turned = arc.length[..., None, None] * turns[..., 1:, :, :]
        passed = passed + turned.mT @ errors.course[..., 1:, :, :] @ turned
    settled = _sums_from(before.settled, passed, -3)
    covariance = settled + arrival.mT @ random @ arrival + shift.mT @ shift
    last = _Sums(position[..., -1, :], *(each[..., -1, :, :] for each in (shift, settled, arrival)))
    return position, covariance, last


def _reach(arc: Arcs, turns: Array) -> tuple[Array, Array]:
    """Changes (…, n - 1, 3, 3) of each step by a shift upward, sideways and in depth at its upper and lower end."""
    upper, lower = arc.by_directions()
    along = arc.by_length[..., None, :]
    return (
        np.concatenate([turns[..., :-1, :, :] @ upper.mT, -along], -2),
        np.concatenate([turns[..., 1:, :, :] @ lower.mT, along], -2),
    )


def _sums_from(first: Array, steps: Array, axis: int) -> Array:
    """Running sums from a first value, without the axis of the stations, over what is added at each station."""
    return np.cumsum(np.concatenate([np.expand_dims(first, axis), steps], axis), axis)
