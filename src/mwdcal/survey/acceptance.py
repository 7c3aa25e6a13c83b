"""Whether a survey may be used: |g|, |b| and dip against the Earth's at its place.

Fixed limits on each departure, or an error model: the departures against what sensors, calibration,
drill string and references explain, taken together as a Mahalanobis distance.

Reference: S. Ekseth et al., "The reliability problem related to directional survey data", SPE 103734 (2006).

Interference that acceptance cannot see: how much would pass at an attitude, and how far it turns the azimuth.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError
from mwdcal.files.profiles import decoded_toml
from mwdcal.geometry.observables import OBSERVABLES, is_vertical
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, dot, length
from mwdcal.survey.stations import RANDOM, STRENGTHS, SURVEY_OBSERVABLES, Surveys

STRENGTH_NAMES = SURVEY_OBSERVABLES[STRENGTHS]
LEAST_FREE = 1e-12
"""Share of a variance that is of its quantity alone, at least: the rounding of a correlation."""
LARGEST_SPREAD = 0.25
"""Departures are alike if their middle half spans less than this share of the median."""
SURVEY_UNITS = {
    "gravity": ("mg", 1e3, 2),
    "field": ("nT", 1.0, 0),
    "dip": ("°", float(np.degrees(1.0)), 2),
}
"""Unit in which a departure is shown, its factor, and decimals."""


class SensorTerms(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The errors of sensors beside the calibration's own uncertainty, 1σ of each axis."""

    accelerometer_bias_ms2: float = 0.0
    accelerometer_scale: float = 0.0
    magnetometer_bias_nt: float = 0.0
    magnetometer_scale: float = 0.0
    axial_interference_nt: float = 0.0

    def covariance(self, g: Array, b: Array) -> Array:
        """Covariance (..., 6) on the diagonal, of both vectors (..., 3): g² and nT²."""
        gravity = self.accelerometer_bias_ms2 / STANDARD_GRAVITY
        variance = np.concatenate(
            [
                gravity**2 + (self.accelerometer_scale * g) ** 2,
                self.magnetometer_bias_nt**2 + (self.magnetometer_scale * b) ** 2,
            ],
            -1,
        )
        variance[..., 5] += self.axial_interference_nt**2
        return variance


class ReferenceTerms(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard uncertainties of the references where they state none."""

    gravity_ms2: float = 0.0
    field_nt: float = 0.0
    dip_deg: float = 0.0

    def sd(self, name: str) -> float:
        """That of gravity, field or dip in g, nT or radians."""
        return {
            "gravity": self.gravity_ms2 / STANDARD_GRAVITY,
            "field": self.field_nt,
            "dip": float(np.radians(self.dip_deg)),
        }[name]


class SurveyLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Limits of surveys and where they come from.

    `gravity_g`, `field_nt`, `dip_deg`: fixed limits on the departures. `probability`: of the error model, that a
    survey within it is accepted.
    """

    name: str
    source: str = ""
    gravity_g: float | None = None
    field_nt: float | None = None
    dip_deg: float | None = None
    probability: float | None = None
    sensor: SensorTerms = SensorTerms()
    reference: ReferenceTerms = ReferenceTerms()

    def fixed(self, name: str) -> float | None:
        """The fixed limit of gravity, field or dip in g, nT or radians."""
        if name == "dip":
            return None if self.dip_deg is None else float(np.radians(self.dip_deg))
        return self.gravity_g if name == "gravity" else self.field_nt


@dataclass(frozen=True)
class AcceptanceTests:
    """The limits of surveys (n,): fixed limits (3,), and a covariance (n, 3, 3) with the largest distance (n,).

    `missing` (n, 3): not judged. `weights` (n, 3, 3): inverse of the covariance of what is judged, ones for the rest.
    """

    fixed: Array
    covariance: Array
    largest: Array
    missing: Bools
    weights: Array

    def part(self, rows: slice | Ints) -> AcceptanceTests:
        """Those of some surveys."""
        return AcceptanceTests(
            self.fixed, self.covariance[rows], self.largest[rows], self.missing[rows], self.weights[rows]
        )  # fmt: skip

    def largest_field(self) -> Array:
        """Largest departure (n,) of |b| that is accepted with some departure of dip, |g| being right; NaN: any."""
        field, dip = (STRENGTH_NAMES.index(name) for name in ("field", "dip"))
        weights = self.weights
        shared = weights[:, field, dip] ** 2 / weights[:, dip, dip]
        most = np.minimum(
            self.largest / np.sqrt(weights[:, field, field] - shared), self.fixed[field]
        )
        return np.where(self.missing[:, field], np.nan, most)

    def accept(self, departures: Mapping[str, Array]) -> Bools:
        """Which of departures (n, k) of |g|, |b| and dip are accepted; none where nothing is judged.

        Those that are not named are zero.
        """
        inside, square = (~self.missing).any(-1, keepdims=True), np.zeros(1)
        shifts: list[tuple[int, Array]] = []
        for name, departure in departures.items():
            place = STRENGTH_NAMES.index(name)
            missing = self.missing[:, [place]]
            shift = np.where(missing, 0.0, departure) if missing.any() else departure
            if np.isfinite(most := self.fixed[place]):
                inside = inside & (np.abs(shift) <= most)
            square = square + self.weights[:, place, [place]] * shift**2
            for other, before in shifts:
                square = square + 2.0 * self.weights[:, place, [other]] * shift * before
            shifts.append((place, shift))
        return np.asarray(inside & (square <= self.largest[:, None] ** 2))


@dataclass(frozen=True)
class Judgement:
    """Departures of |g|, |b| and dip (n, 3) from the references, g, nT, radians; NaN where not judged.

    `bound` (n, 3): what each may be by itself: the fixed limit, else that of the error model, infinite where
    neither is. `distance` (n,) of the three together and the `largest` that is accepted (n,), infinite without
    an error model. `accepted` (n,): judged, and within all limits, which says nothing of an error that moves none of
    the three. `tests`: what decided.
    """

    departure: Array
    bound: Array
    distance: Array
    largest: Array
    accepted: Bools
    tests: AcceptanceTests | None = None

    @property
    def judged(self) -> Bools:
        """Stations (n,) of which anything is judged."""
        return np.asarray((~np.isnan(self.departure)).any(-1))

    @property
    def jointly(self) -> Bools:
        """Accepted stations (n,) of which one strength is beyond its own bound: all three together are within."""
        return np.asarray(self.accepted & (np.abs(self.departure) > self.bound).any(-1))

    def findings(self, rows: slice = slice(None)) -> list[str]:
        """The fault of each station of some rows; empty if it has none."""
        plain, judged = (self.accepted & ~self.jointly)[rows].tolist(), self.judged[rows].tolist()
        return [
            "" if good else self._finding(i) if some else "not judged: no reference"
            for i, (good, some) in enumerate(zip(plain, judged, strict=True), rows.start or 0)
        ]

    def alike(self) -> list[str]:
        """The strengths of which most departures are beyond the bound, and the middle half of all is close together."""
        parts = []
        for off, most, (name, (unit, factor, digits)) in zip(
            self.departure.T, self.bound.T, SURVEY_UNITS.items(), strict=True
        ):
            there = ~np.isnan(off)
            low, middle, high = (
                np.quantile(off[there], [0.25, 0.5, 0.75]) if there.any() else np.zeros(3)
            )
            beyond = np.mean(np.abs(off[there]) > most[there]) if there.any() else 0.0
            if beyond > 0.5 and high - low < LARGEST_SPREAD * abs(middle):
                parts.append(f"{name} by {middle * factor:+.{digits}f} {unit}")
        return parts

    def _finding(self, i: int) -> str:
        off, most = self.departure[i].tolist(), self.bound[i].tolist()
        parts = [
            f"{name} {off[k] * factor:+.{digits}f} {unit} (at most {most[k] * factor:.{digits}f})"
            for k, (name, (unit, factor, digits)) in enumerate(SURVEY_UNITS.items())
            if abs(off[k]) > most[k]
        ]
        if self.distance[i] > self.largest[i]:
            parts.append(f"distance {self.distance[i]:.2f} (at most {self.largest[i]:.2f})")
        return ", ".join(parts) + "; accepted by all three together" * bool(self.accepted[i])


def load_survey_limits(
    name_or_path: str | os.PathLike[str] = "owsg-mwd",
) -> tuple[SurveyLimits, str]:
    """Limits of surveys and the SHA-256 of their bytes: built in by name, or a TOML file by path.

    Raises:
        InputError: no such limits, a limit that is not positive, or none at all.
    """
    name = os.fspath(name_or_path)
    limits, digest = decoded_toml(
        name, SurveyLimits, "survey_limits", "limits profile of surveys", "Surveys"
    )
    stated = {
        key: getattr(limits, key) for key in ("gravity_g", "field_nt", "dip_deg", "probability")
    }
    given = {key: value for key, value in stated.items() if value is not None}
    if not given:
        raise InputError(
            f"{name} sets no limit: give probability, or gravity_g, field_nt, dip_deg."
        )
    for key, value in given.items():
        if not 0 < value < (1.0 if key == "probability" else float("inf")):
            below = " and below 1" if key == "probability" else ""
            raise InputError(f"{name}: {key} must be above 0{below}; got {value}.")
    for part in (limits.sensor, limits.reference):
        for key, value in msgspec.structs.asdict(part).items():
            if not 0 <= value < float("inf"):
                raise InputError(f"{name}: {key} must be at least 0; got {value}.")
    return limits, digest


def judged(
    surveys: Surveys, vectors: tuple[Array, Array], readings: Readings, limits: SurveyLimits
) -> Judgement:
    """Surveys against the references of their readings; `vectors` (n, 3) each as corrected.

    A quantity without a reference, or that the calibration leaves undetermined, is not judged.
    """
    reference = np.stack(
        [np.broadcast_to(readings.known.get(n, np.nan), readings.count) for n in STRENGTH_NAMES], -1
    )
    departure = surveys.value[:, STRENGTHS] - reference
    covariance = _covariance(surveys, vectors, readings, limits)
    missing = np.isnan(departure) | np.isnan(diagonal(covariance))
    departure = np.where(missing, np.nan, departure)
    fixed = np.array(
        [np.inf if (most := limits.fixed(n)) is None else most for n in STRENGTH_NAMES]
    )
    weights, together = weighed(departure, covariance)
    largest = np.full(together.shape, np.inf)
    bound = np.broadcast_to(fixed, departure.shape)
    if limits.probability is not None:
        from scipy.special import chdtri

        beyond = 1 - limits.probability
        of_count = np.sqrt(chdtri(np.maximum(np.arange(len(STRENGTH_NAMES) + 1), 1), beyond))
        largest = of_count[(~missing).sum(-1)]
        alone = np.sqrt(diagonal(covariance) * chdtri(1, beyond))
        bound = np.where(np.isfinite(fixed), fixed, alone)
    over = np.abs(departure) > fixed
    accepted = ~missing.all(-1) & ~over.any(-1) & (together <= largest)
    tests = AcceptanceTests(fixed, covariance, largest, missing, weights)
    return Judgement(departure, bound, together, largest, np.asarray(accepted), tests)


def weighed(departure: Array, covariance: Array) -> tuple[Array, Array]:
    """Inverse (..., k, k) of the covariance of departures (..., k), and their Mahalanobis distance (...).

    NaN ones are left out: their inverse is that of a unit matrix.
    """
    missing = np.isnan(departure) | np.isnan(diagonal(covariance))
    blank = missing[..., :, None] | missing[..., None, :]
    whole = np.where(blank, np.eye(departure.shape[-1]), covariance)
    sd, correlation = correlations(whole)
    inverse = np.linalg.inv(correlation)
    scaled = np.where(missing, 0.0, departure) / sd
    square = np.einsum("...i,...ij,...j->...", scaled, inverse, scaled)
    weights = inverse / (sd[..., :, None] * sd[..., None, :])
    return np.asarray(weights), np.asarray(np.sqrt(np.maximum(square, 0.0)))


def correlations(covariance: Array) -> tuple[Array, Array]:
    """Standard uncertainties (..., k) of a covariance (..., k, k), and its correlations, by which one can divide.

    Singular: quantities that depend on one uncertain reading alone are fully correlated; `LEAST_FREE` keeps that apart.
    """
    sd = np.sqrt(diagonal(covariance))
    correlation = covariance / (sd[..., :, None] * sd[..., None, :])
    return sd, correlation + LEAST_FREE * np.eye(covariance.shape[-1])


def _covariance(
    surveys: Surveys, vectors: tuple[Array, Array], readings: Readings, limits: SurveyLimits
) -> Array:
    """Covariance (n, 3, 3) of the departures: calibration, noise, sensors and references."""
    gradient = np.stack([OBSERVABLES[name].gradient(*vectors) for name in STRENGTH_NAMES], -2)
    gradient = np.where(np.isnan(gradient), 0.0, gradient)
    variance = np.nan_to_num(limits.sensor.covariance(*vectors))
    sensors = (gradient * variance[:, None, :]) @ gradient.mT
    sd = np.stack([_reference_sd(readings, limits, name) for name in STRENGTH_NAMES], -1)
    return np.asarray(
        surveys.strengths + sensors + sd[:, :, None] ** 2 * np.eye(len(STRENGTH_NAMES))
    )


def _reference_sd(readings: Readings, limits: SurveyLimits, name: str) -> Array:
    """Standard uncertainty (n,) of a reference: its own, else that of the limits."""
    stated = readings.uncertainty(name)
    shared = np.where(stated > 0, stated, limits.reference.sd(name))
    return np.hypot(shared, readings.uncertainty(RANDOM + name))


AXIAL = np.arange(50.0, 3001.0, 50.0)
"""Sizes of interference along the tool that are tried, nT; more than the last is not usual."""
CROSS_AXIAL = np.arange(50.0, 301.0, 50.0)
"""Sizes across it: to twice what multi-station analysis assumes."""
AROUND_TOOL = np.radians(np.arange(0.0, 360.0, 30.0))
"""Directions across it, rad."""
SURVEYS_AT_ONCE = 1 << 10
"""Surveys for which sizes are tried at once, so that they stay in fast memory."""
LADDER = (200.0, 400.0, 600.0, 800.0, 1200.0, 1800.0, AXIAL[-1])
"""Sizes along the tool up to which those surveys are tried together that let no larger one pass."""
LOOSER = 1 + 1e-6
"""Share by which the largest departure of |b| is taken larger, so that rounding leaves out no size that passes."""
WHERE = ("along the tool", "across it")


@dataclass(frozen=True)
class Blindness:
    """Interference `size` (n, 2), nT, along the tool and across it, that would pass, and the `turn` (n, 2) it makes.

    Of all that is tried and would pass, that which turns the azimuth most, rad.
    """

    size: Array
    turn: Array

    def words(self, places: Ints, least: Array) -> list[str]:
        """What would pass at some surveys (m,) and turn their azimuth by at least so much (m,), rad."""
        texts = [
            self._words_of(places, k, where, last, least)
            for k, (where, last) in enumerate(zip(WHERE, (AXIAL[-1], CROSS_AXIAL[-1]), strict=True))
        ]
        return [
            f"interference would pass and turn the azimuth: {', '.join(filter(None, each))}"
            for each in zip(*texts, strict=True)
        ]

    def _words_of(self, places: Ints, k: int, where: str, last: float, least: Array) -> list[str]:
        """The same along the tool or across it; empty where less turns the azimuth."""
        sizes, of_size = np.unique(self.size[places, k], return_inverse=True)
        names = [
            f"{size:.0f} nT{' or more' if size >= last else ''} {where} by "
            for size in sizes.tolist()
        ]
        turn = self.turn[places, k]
        angles, of_angle = np.unique(two_digits(np.degrees(turn)), return_inverse=True)
        both, of_both = np.unique(of_size * len(angles) + of_angle, return_inverse=True)
        texts = [
            f"{names[pair // len(angles)]}{angles[pair % len(angles)]:.2g}°"
            for pair in both.tolist()
        ]
        texts.append("")
        return [texts[i] for i in np.where(turn >= least, of_both, len(both)).tolist()]


def two_digits(values: Array) -> Array:
    """Positive numbers (n,) with two digits, each as `.2g` rounds it.

    Reference: between two neighbours of two digits `.2g` itself says to which the number halfway belongs.
    """
    low, high = _TWO_DIGITS[0], _TWO_DIGITS[-1]
    inside = (values >= low) & (values <= high)
    rounded = _TWO_DIGITS[np.searchsorted(_HALFWAY, values, "right").clip(0, len(_TWO_DIGITS) - 1)]
    for place in np.flatnonzero(~inside).tolist():
        rounded[place] = float(f"{values[place]:.2g}")
    return np.asarray(rounded)


_TWO_DIGITS = np.array([float(f"{d}e{e}") for e in range(-5, 3) for d in range(10, 100)])
_HALFWAY = np.array(
    [
        half if f"{half:.2g}" == f"{above:.2g}" else np.nextafter(half, np.inf)
        for half, above in (
            (float(f"{d}.5e{e}"), float(f"{d + 1}e{e}"))
            for e in range(-5, 3)
            for d in range(10, 100)
        )
    ]
)[:-1]
"""The least numbers that `.2g` rounds to each but the first of `_TWO_DIGITS`."""


def blindness(tests: AcceptanceTests, vectors: tuple[Array, Array]) -> Blindness:
    """Interference that acceptance of surveys (n,) with these vectors (n, 3), g and nT, lets pass.

    Definition: interference that shifts |g|, |b| and dip of a survey without other errors by what the tests accept.
    """
    parts = [
        _of(tests.part(rows), *(each[rows] for each in vectors))
        for rows in _blocks(len(vectors[0]))
    ]
    return Blindness(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, max(count, 1), SURVEYS_AT_ONCE):
        yield slice(start, start + SURVEYS_AT_ONCE)


@cache
def _along_tool(last: float) -> Array:
    """Fields (k, 3) along the tool up to a size, nT, one way and the other."""
    sizes = AXIAL[last >= AXIAL]
    fields = np.zeros((2 * len(sizes), 3))
    fields[:, 2] = np.concatenate([sizes, -sizes])
    return fields


@cache
def _across_tool(size: float) -> Array:
    """Fields (k, 3) of a size across the tool, nT."""
    return size * np.stack([np.cos(AROUND_TOOL), np.sin(AROUND_TOOL), 0 * AROUND_TOOL], -1)


class _Tried(NamedTuple):
    """Surveys (m,) at which interference is tried.

    Gravity's direction and the field; the horizontal field turned by 90° to the right, NaN at vertical, and its square;
    |b|, its vertical part, and dip.
    """

    tests: AcceptanceTests
    down: Array
    b: Array
    side: Array
    across: Array
    strength: Array
    below: Array
    dip: Array

    def part(self, rows: Ints) -> _Tried:
        """Some of them."""
        return _Tried(self.tests.part(rows), *(each[rows] for each in self[1:]))

    def passing(self, fields: Array) -> Bools:
        """Which interference (k, 3) would pass at each survey (m, k)."""
        along, fall = self.b @ fields.mT, self.down @ fields.mT
        total = np.sqrt(self.strength**2 + 2 * along + np.linalg.norm(fields, axis=-1) ** 2)
        dip = np.arcsin(np.clip((self.below + fall) / total, -1.0, 1.0))
        return self.tests.accept({"field": total - self.strength, "dip": dip - self.dip})

    def turns(self, fields: Array, of: Ints | None = None) -> Array:
        """Turns (m, k) of the azimuth by interference (k, 3), rad; or those (m, j) `of` some at each survey.

        Interference f makes the horizontal field h to h + f - (f·d) d, d down: the azimuth turns by the angle between.
        """
        along, fall, turn = (vector @ fields.mT for vector in (self.b, self.down, self.side))
        if of is not None:
            along, fall, turn = (np.take_along_axis(each, of, -1) for each in (along, fall, turn))
        return np.abs(np.arctan2(turn, self.across + along - self.below * fall))

    def reach(self) -> Array:
        """Size (m,) of interference along the tool above which none passes, nT, by |b| alone.

        |b| rises along one way, and falls along the other until the field lies across the tool.
        """
        most = LOOSER * np.fmin(self.tests.largest_field(), AXIAL[-1])[:, None]
        ways = np.concatenate([self.b[:, 2:], -self.b[:, 2:]], -1)
        above, below = (2 * self.strength * sign * most + most**2 for sign in (1, -1))
        back = np.sqrt(np.maximum(ways**2 + below, 0.0))
        gap = (
            (ways < 0) & (ways**2 + below > 0) & (most < self.strength) & (back - ways > AXIAL[-1])
        )
        reach = np.where(gap, -ways - back, np.sqrt(ways**2 + above) - ways)
        return np.asarray(np.fmin(reach.max(-1), AXIAL[-1]))


def _of(tests: AcceptanceTests, g: Array, b: Array) -> tuple[Array, Array]:
    """Sizes and turns (m, 2) of some surveys."""
    down = g / length(g)[:, None]
    normal = np.cross(down, b)
    side = np.where(is_vertical(g)[:, None], np.nan, normal)
    strength, across = length(b)[:, None], dot(side, side)[:, None]
    below = dot(down, b)[:, None]
    dip = np.arctan2(below, length(normal)[:, None])
    tried = _Tried(tests, down, b, side, across, strength, below, dip)
    pairs = zip(_most_along(tried), _most_across(tried), strict=True)
    size, turn = (np.stack(pair, -1) for pair in pairs)
    return size, turn


def _most_along(tried: _Tried) -> tuple[Array, Array]:
    """Size and turn (m,) of what turns the azimuth most along the tool: either way the largest that passes.

    Sizes that |b| refuses are not tried.
    """
    reach = tried.reach()
    size, turn = np.full(reach.shape, AXIAL[0]), np.zeros(reach.shape)
    steps = np.searchsorted(LADDER, reach)
    for step, last in enumerate(LADDER):
        rows = np.flatnonzero(steps == step)
        if not rows.size:
            continue
        fields, some = _along_tool(last), tried.part(rows)
        passing = some.passing(fields).reshape(len(rows), 2, -1)
        largest = passing.shape[-1] - 1 - np.argmax(passing[..., ::-1], -1)
        turns = some.turns(fields, np.add(largest, [0, passing.shape[-1]]))
        turns = np.where(passing.any(-1) & (turns > 0), turns, 0.0)
        turn[rows], way = turns.max(-1), turns.argmax(-1)
        sizes = AXIAL[np.take_along_axis(largest, way[:, None], -1)[:, 0]]
        size[rows] = np.where(turn[rows] > 0, sizes, AXIAL[0])
    return size, turn


def _most_across(tried: _Tried) -> tuple[Array, Array]:
    """The same across the tool: the largest size first, as a smaller one turns the azimuth less in every direction."""
    rows = np.arange(len(tried.b))
    size, turn = np.full(rows.shape, CROSS_AXIAL[0]), np.zeros(rows.shape)
    for each in CROSS_AXIAL[::-1].tolist():
        fields = _across_tool(each)
        turns = tried.turns(fields)
        most = np.where(tried.passing(fields) & (turns > 0), turns, 0.0).max(-1)
        better = most > turn[rows]
        size[rows[better]], turn[rows[better]] = each, most[better]
        left = ~(turn[rows] >= turns.max(-1))
        if not left.any():
            break
        rows, tried = rows[left], tried.part(np.flatnonzero(left))
    return size, turn
