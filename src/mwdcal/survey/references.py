"""Which source counts where several state a quantity of a place, and where two of them contradict each other.

One order for gravity, field, dip, declination and convergence: the table of the readings, as it was measured with
them; then the reference of the place, in which a measured value comes before that of a model; then a model. The
source that does not count is still compared with the one that does.

References of surveys at a place and date: gravity, field, dip, declination, convergence.

Values come from models of the Earth, or were measured there; a measured value always overrides a modelled
one. Each has a standard uncertainty, and says where both come from.

References of a place in the columns of a run: blank cells are filled, given ones stay.
"""

from __future__ import annotations

import math
import os
import re
from calendar import isleap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal import extras
from mwdcal.calibration.readings import EARTH_RANGES
from mwdcal.calibration.record import DOCUMENT_VERSION, Finding
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files.contract import (
    AZIMUTH_KEYS,
    REFERENCES,
    ROTATION,
    Range,
    magnetic_offset,
    stated_norths,
)
from mwdcal.files.formats.columns import Column, shown
from mwdcal.files.formats.table import Table, numbers
from mwdcal.files.runs import check_run
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, ArrayLike, Bools

# --------------------------------------------------------------------------
# The Earth at a place and date: normal gravity and the main magnetic field.
#
# Nothing is loaded from a network: coefficients are those of the installed libraries.
#
# Grid north of a map projection: its convergence at a place, from points that PROJ transforms.

SEMI_MAJOR_AXIS = 6_378_137.0
"""Of the ellipsoid WGS84, m."""
FLATTENING = 1 / 298.257223563
"""Of the ellipsoid WGS84."""
GRAVITATION = 3.986004418e14
"""Geocentric gravitational constant of WGS84, m³/s²."""
ROTATION_RATE = 7.292115e-5
"""Of the Earth by WGS84, rad/s."""
FIELD_MODELS = {"wmm2025": (2025.0, 2030.0), "igrf14": (1900.0, 2030.0)}
"""Models of the main field, and the decimal years in which they hold, both included."""
EPOCH_YEARS = 5.0
"""Years between the epochs of a model, over which its coefficients change evenly."""
_WMM_FILE = "wmm/WMM_2025.COF"
_IGRF_FILE = "IGRF14.shc"
_MODEL_RADIUS = 6_371_200.0
"""Radius of the sphere that coefficients refer to, m."""


class MainField(NamedTuple):
    """The main field of the Earth: strength, nT; dip, positive down, and declination, positive east, degrees."""

    field_nt: float
    dip_deg: float
    declination_deg: float


class FieldModel(NamedTuple):
    """Coefficients of the main field from an epoch on.

    `coefficients` names their file and its version. `cosines` and `sines` (N + 1, N + 1) by degree and order, nT, at
    the epoch, and what they change by in a year.
    """

    epoch: float
    valid_to: float
    coefficients: str
    sha256: str
    cosines: Array
    sines: Array
    cosine_rates: Array
    sine_rates: Array


def normal_gravity(latitude_deg: ArrayLike, altitude_m: ArrayLike) -> Array:
    """Normal gravity of WGS84, the gravity of an Earth that is an ellipsoid without mountains.

    Definition: gradient of the normal potential in ellipsoidal coordinates, exact at any altitude; on the
    ellipsoid it is Somigliana's formula.
    Units: geodetic latitude in degrees, metres above the ellipsoid; m/s².
    Shapes: those of the arguments, broadcast.
    Reference: Heiskanen and Moritz, Physical Geodesy (1967), section 2-8; constants of NIMA TR8350.2.
    """
    a, b = SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS * (1 - FLATTENING)
    linear = np.sqrt(a**2 - b**2)
    latitude, altitude = np.radians(latitude_deg), np.asarray(altitude_m, float)
    vertical = a**2 / np.hypot(a * np.cos(latitude), b * np.sin(latitude))
    radial = (vertical + altitude) * np.cos(latitude)
    axial = (vertical * (b / a) ** 2 + altitude) * np.sin(latitude)
    excess = radial**2 + axial**2 - linear**2
    u = np.sqrt((excess + np.hypot(excess, 2 * linear * axial)) / 2)
    across = np.hypot(u, linear)
    sine, cosine = axial / u, radial / across
    width = np.hypot(u, linear * sine) / across
    quotient, slope = _bulge(u, linear), _bulge_slope(u, linear)
    spin = ROTATION_RATE**2
    ratio = spin * a**2 / _bulge(np.asarray(b), linear)
    inward = (
        GRAVITATION / across**2
        + ratio * linear / across**2 * slope * (sine**2 / 2 - 1 / 6)
        - spin * u * cosine**2
    )
    sideways = (ratio * quotient / across - spin * across) * sine * cosine
    return np.asarray(np.hypot(inward, sideways) / width)


def _bulge(u: Array, linear: float) -> Array:
    """Heiskanen and Moritz's q at the semi-minor axis u of a confocal ellipsoid."""
    return ((1 + 3 * (u / linear) ** 2) * np.arctan(linear / u) - 3 * u / linear) / 2


def _bulge_slope(u: Array, linear: float) -> Array:
    """Their q′ there."""
    return 3 * (1 + (u / linear) ** 2) * (1 - u / linear * np.arctan(linear / u)) - 1


def decimal_year(day: date) -> float:
    """The decimal year at the beginning of a day.

    >>> decimal_year(date(2028, 1, 1)), decimal_year(date(2027, 7, 2))
    (2028.0, 2027.4986301369863)
    """
    return day.year + (day.timetuple().tm_yday - 1) / (366 if isleap(day.year) else 365)


def main_field(
    model: FieldModel, latitude_deg: float, longitude_deg: float, altitude_m: float, year: float
) -> MainField:
    """The main field that a model gives at a place, metres above the ellipsoid, and decimal year."""
    north, east, down = main_fields(model, latitude_deg, longitude_deg, altitude_m, year).tolist()
    level = math.hypot(north, east)
    dip, declination = math.atan2(down, level), math.atan2(east, north)
    return MainField(math.hypot(level, down), math.degrees(dip), math.degrees(declination))


def main_fields(
    model: FieldModel,
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    altitude_m: ArrayLike,
    year: ArrayLike,
) -> Array:
    """Main fields (…, 3) at places and decimal years: north, east and down of the ellipsoid, nT.

    Definition: spherical harmonics with the functions of Legendre as Schmidt scales them, by their recurrences in the
    degree; those of order 1 and more over the sine of the distance from the pole, so that the east stays finite there.
    Units: geodetic latitude and longitude in degrees, metres above the ellipsoid.
    Reference: Langel, in Jacobs (ed.), Geomagnetism, vol. 1 (1987), chapter 4.
    """
    lat, lon, h, time = np.broadcast_arrays(latitude_deg, longitude_deg, altitude_m, year)
    lat, lon, minor = np.radians(lat), np.radians(lon), (1 - FLATTENING) ** 2
    vertical = SEMI_MAJOR_AXIS / np.sqrt(np.cos(lat) ** 2 + minor * np.sin(lat) ** 2)
    across, axial = (vertical + h) * np.cos(lat), (minor * vertical + h) * np.sin(lat)
    radius = np.hypot(across, axial)
    sine, cosine = (np.abs(across) / radius)[..., None], (axial / radius)[..., None]
    order = np.arange(len(model.cosines))
    waves = np.cos(lon[..., None] * order), np.sin(lon[..., None] * order)
    years = time[..., None, None] - model.epoch
    g, h_ = model.cosines + years * model.cosine_rates, model.sines + years * model.sine_rates
    inward, south, east = (np.zeros(lat.shape) for _ in range(3))
    share = (_MODEL_RADIUS / radius)[..., None]
    for n, (value, over, slope) in enumerate(_legendre(len(order) - 1, sine, cosine), 1):
        size = share ** (n + 2)
        along = size * (g[..., n, :] * waves[0] + h_[..., n, :] * waves[1])
        turned = size * (g[..., n, :] * waves[1] - h_[..., n, :] * waves[0])
        inward -= (n + 1) * (along * value).sum(-1)
        south -= (along * slope).sum(-1)
        east += (turned * order * over).sum(-1)
    tilt_sine = cosine[..., 0] * np.cos(lat) - sine[..., 0] * np.sin(lat)
    tilt_cosine = sine[..., 0] * np.cos(lat) + cosine[..., 0] * np.sin(lat)
    north = -south * tilt_cosine - inward * tilt_sine
    return np.stack([north, east, inward * tilt_cosine - south * tilt_sine], -1)


def _legendre(last: int, sine: Array, cosine: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Functions of degree 1 to `last` by order (…, last + 1), the same over the sine, and their derivatives.

    Of the sine and cosine (…, 1) of the distance from the pole. Over the sine those of order 0, which would not be
    finite, are zero.
    """
    order = np.arange(last + 1)
    value, over, slope = (np.zeros((*sine.shape[:-1], last + 1)) for _ in range(3))
    value[..., 0] = 1.0
    before = value * 0.0, over, slope
    for n in range(1, last + 1):
        lower = order < n
        root = np.sqrt(np.where(lower, n**2 - order**2, 1.0))
        first = np.where(lower, (2 * n - 1) / root, 0.0)
        second = np.where(lower, np.sqrt(np.maximum((n - 1.0) ** 2 - order**2, 0.0)) / root, 0.0)
        scale = np.sqrt((2 * n - 1) / (2 * n)) if n > 1 else 1.0
        diagonal = value[..., n - 1 : n], over[..., n - 1 : n], slope[..., n - 1 : n]
        after = (
            first * cosine * value - second * before[0],
            first * cosine * over - second * before[1],
            first * (cosine * slope - sine * value) - second * before[2],
        )
        after[0][..., n : n + 1] = scale * sine * diagonal[0]
        after[1][..., n : n + 1] = scale * diagonal[0]
        after[2][..., n : n + 1] = scale * (sine * diagonal[2] + cosine * diagonal[0])
        before, (value, over, slope) = (value, over, slope), after
        yield after


def field_model(name: str, year: float) -> FieldModel:
    """The model of `FIELD_MODELS` with this name, for a decimal year.

    Raises:
        InputError: another name, a year in which the model does not hold, or a library that is missing.
    """
    if name not in FIELD_MODELS:
        raise InputError(f"`model` must be one of {', '.join(FIELD_MODELS)}; got {name!r}.")
    first, last = FIELD_MODELS[name]
    if not first <= year <= last:
        others = [other for other, (low, high) in FIELD_MODELS.items() if low <= year <= high]
        advice = f"Use `model` {others[0]}" if others else "Give measured values"
        raise InputError(
            f"`date`: {name} holds from {first:.1f} to {last:.1f}; got {year:.3f}. {advice}."
        )
    return _wmm() if name == "wmm2025" else _igrf(_epoch(year))


def _epoch(year: float) -> float:
    """The epoch of IGRF from which coefficients are carried forward to a year."""
    first, last = FIELD_MODELS["igrf14"]
    return min(first + (year - first) // EPOCH_YEARS * EPOCH_YEARS, last - EPOCH_YEARS)


@cache
def _wmm() -> FieldModel:
    """WMM2025 of pygeomag, which is not imported."""
    text, sha256 = _coefficients("pygeomag", _WMM_FILE, "The World Magnetic Model")
    (_, name, released), *rows = [line.split() for line in text.splitlines()]
    whole = [row for row in rows if len(row) == 6]  # not those of nines at the end
    first, last = FIELD_MODELS["wmm2025"]
    named = f"{_named(name, _WMM_FILE, 'pygeomag')}, released {released}"
    columns = (_square([(int(n), int(m), float(row[k])) for n, m, *row in whole]) for k in range(4))
    return FieldModel(first, last, named, sha256, *columns)


@cache
def _igrf(epoch: float) -> FieldModel:
    """IGRF-14 from an epoch to the next: coefficients of ppigrf, which is not imported (it needs pandas)."""
    text, sha256 = _coefficients("ppigrf", _IGRF_FILE, "The geomagnetic reference field")
    header, *rows = [line.split() for line in text.splitlines() if line and line[0] != "#"][1:]
    now = [float(year) for year in header].index(epoch)
    each = [(int(n), int(m), float(row[now]), float(row[now + 1])) for n, m, *row in rows]
    cosines, sines = (
        [row for row in each if (row[1] < 0) == negative] for negative in (False, True)
    )
    parts = [
        _square([(n, abs(m), value) for n, m, value, _ in part]) for part in (cosines, sines)
    ] + [
        _square([(n, abs(m), (later - value) / EPOCH_YEARS) for n, m, value, later in part])
        for part in (cosines, sines)
    ]
    last = FIELD_MODELS["igrf14"][1]
    return FieldModel(epoch, last, _named("IGRF-14", _IGRF_FILE, "ppigrf"), sha256, *parts)


def _square(entries: Sequence[tuple[int, int, float]]) -> Array:
    """Coefficients by degree and order, as a matrix."""
    size = max(n for n, _, _ in entries) + 1
    matrix = np.zeros((size, size))
    for n, m, value in entries:
        matrix[n, m] = value
    return matrix


def _coefficients(library: str, file: str, what: str) -> tuple[str, str]:
    """The text of a file of coefficients in a library that need not be imported, and its SHA-256."""
    spec = find_spec(library)
    if spec is None or spec.origin is None:
        raise extras.missing(library, what, "survey")
    try:
        data = (Path(spec.origin).parent / file).read_bytes()
    except OSError:
        raise InputError(
            f"{library} {version(library)} has no file {file}. Install another version: "
            f"{extras.command('survey')} -U"
        ) from None
    return data.decode("utf-8"), sha256_of(data)


def _named(model: str, file: str, library: str) -> str:
    return f"{model}, {Path(file).name} of {library} {version(library)}"


WGS84 = "EPSG:4326"
STEP = 1e-4
"""Half the distance between the two points of a derivative, degrees: 11 m on a meridian."""
SAME_PLACE = 1e-4
"""Largest difference between a place and what the grid gives back for it, degrees."""
LEAST_DISTORTION = 0.01
"""Distortion of angles below which a grid counts as conformal, degrees."""
_SIGNS = {"north": 1, "east": 1, "south": -1, "west": -1}
_CODE = re.compile(r"[A-Za-z]+:\w+")


class Grid(NamedTuple):
    """North of a map projection at a place.

    `convergence_deg`: angle from true to grid north, positive east. `distortion_deg`: largest error of an angle
    between two directions on the grid, zero where it is conformal. `covered`: the grid is made for that place.
    `scale`: length on the map over that on the ellipsoid, the mean of all directions.
    """

    convergence_deg: float
    name: str
    covered: bool
    distortion_deg: float
    scale: float


def grid_convergence(crs: str, latitude_deg: float, longitude_deg: float) -> Grid:
    """Grid north of a map projection at a place on WGS84.

    Definition: two points on the place's meridian of WGS84, transformed to the grid, lie on a line of bearing
    -convergence; A_grid = A_true - convergence. Grid north is the axis that counts north, or the opposite of the
    one that counts south. Where both axes point along meridians, as at the poles, it is the one that lies 90°
    anticlockwise of the other.

    Raises:
        InputError: no such projection, one that PROJ cannot compute, or a place it does not show.
    """
    pyproj = extras.load("pyproj", "The convergence of a grid", "survey")
    system = _projected(pyproj, crs)
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    axes = _derivatives(pyproj, crs, system, latitude_deg, longitude)
    grid = _north_up(crs, system, axes)
    long, short = np.linalg.svd(grid, compute_uv=False)
    return Grid(
        convergence_deg=float(0.0 - np.degrees(np.arctan2(*grid[:, 1]))),
        name=f"{system.name}, pyproj {pyproj.__version__}",
        covered=_covers(system, longitude, latitude_deg),
        distortion_deg=float(2 * np.degrees(np.arcsin((long - short) / (long + short)))),
        scale=float(np.sqrt(long * short) * system.axis_info[0].unit_conversion_factor),
    )


def _projected(pyproj: Any, crs: str) -> Any:
    """The projected system of a code, the horizontal part of a compound one."""
    try:
        system = pyproj.CRS.from_user_input(crs if _CODE.fullmatch(crs) else "")
    except pyproj.exceptions.CRSError:
        raise InputError(
            f"`crs` must be the code of a projected coordinate system, such as EPSG:32631; got {crs!r}. "
            "Name that of the well plan."
        ) from None
    horizontal = system.sub_crs_list[0] if system.is_compound else system
    if not horizontal.is_projected:
        raise InputError(
            f"`crs` must name a map grid; {crs} ({system.name}) is not one. Name the projected system of the well plan."
        )
    return horizontal


def _derivatives(pyproj: Any, crs: str, system: Any, latitude: float, longitude: float) -> Array:
    """Change (2, 2) of both axes of a grid, in their order and in their unit, by a metre east and a metre north."""
    latitude = float(np.clip(latitude, -90.0 + STEP, 90.0 - STEP))
    cosine = np.cos(np.radians(latitude))
    latitudes = latitude + np.array([0.0, 0.0, -STEP, STEP])
    longitudes = longitude + np.array([-1.0, 1.0, 0.0, 0.0]) * STEP / max(cosine, STEP)
    onto = _operation(pyproj, crs, system)
    try:
        points, back = _there_and_back(pyproj, onto, latitudes, longitudes)
    except pyproj.exceptions.ProjError as error:
        raise InputError(
            f"`crs`: PROJ cannot transform {latitude:g}°, {longitude:g}° to {crs} ({system.name}): "
            f"{str(error).rstrip('.')}. Check `latitude`, `longitude` and the zone."
        ) from None
    off = np.abs(back - [latitudes, longitudes])
    off[1] = np.minimum(off[1], np.abs(off[1] - 360.0)) * cosine
    if not (off <= SAME_PLACE).all():
        raise InputError(
            f"`crs` {crs} ({system.name}) does not show {latitude:g}°, {longitude:g}°. "
            "Check `latitude`, `longitude` and the zone."
        )
    units = [axis.unit_conversion_factor for axis in system.axis_info[:2]]
    west, east, first, last = points.T * units / units[0]
    meridian, parallel = _radii(latitude)
    by_east = (east - west) / (np.radians(longitudes[1] - longitudes[0]) * cosine * parallel)
    return np.stack([by_east, (last - first) / (np.radians(2 * STEP) * meridian)], -1)


def _operation(pyproj: Any, crs: str, system: Any) -> Any:
    """From WGS84 to a grid, with its datum and prime meridian."""
    try:
        return pyproj.Transformer.from_crs(WGS84, system)
    except pyproj.exceptions.ProjError:
        method = system.coordinate_operation.method_name
        raise InputError(
            f"`crs`: PROJ cannot compute {crs} ({system.name}, method {method}). Leave `crs` out, and state the "
            "convergence in the table of the surveys (convergence_deg)."
        ) from None


def _there_and_back(
    pyproj: Any, onto: Any, latitude: Array, longitude: Array
) -> tuple[Array, Array]:
    """Places on WGS84 (n,) in the axes of a grid (2, n), and latitude and longitude (2, n) that the grid gives back.

    All by the operation that PROJ chooses for the first.
    """
    onto.transform(latitude[0], longitude[0], errcheck=True)
    with suppress(pyproj.exceptions.ProjError):  # which it raises where there is one operation only
        onto = onto.get_last_used_operation()
    points = onto.transform(latitude, longitude, errcheck=True)
    back = onto.transform(*points, direction="INVERSE", errcheck=True)
    return np.stack(points), np.stack(back)


def _radii(latitude: float) -> tuple[float, float]:
    """Radii of curvature of WGS84 along the meridian and across it, m."""
    eccentricity = FLATTENING * (2 - FLATTENING)
    share = 1 - eccentricity * np.sin(np.radians(latitude)) ** 2
    across = SEMI_MAJOR_AXIS / np.sqrt(share)
    return float(across * (1 - eccentricity) / share), float(across)


def _north_up(crs: str, system: Any, axes: Array) -> Array:
    """The change (2, 2) of a grid's east and north, from that of its axes in their order."""
    directions = [axis.direction for axis in system.axis_info[:2]]
    signs = np.array([_SIGNS.get(direction, 0) for direction in directions])
    upright = [direction in ("north", "south") for direction in directions]
    if not signs.all() or not any(upright):
        raise InputError(
            f"`crs` must name a grid with axes east and north; {crs} ({system.name}) has {' and '.join(directions)}. "
            "Name the projected system of the well plan."
        )
    if all(upright):
        # near a pole, where every axis points along a meridian
        return axes if np.linalg.det(axes) > 0 else np.asarray(axes[::-1])
    whole = axes * signs[:, None]
    return np.asarray(whole[::-1] if upright[0] else whole)


def _covers(system: Any, longitude: float, latitude: float) -> bool:
    """Whether a place is in the area for which a coordinate system is made; all are where it states none."""
    area = system.area_of_use
    if area is None or area.south < -90.0:  # as PROJ writes unknown bounds
        return True
    beyond = (area.east - area.west) % 360.0 or 360.0
    inside = area.south <= latitude <= area.north and (longitude - area.west) % 360.0 <= beyond
    return bool(inside)


FARTHEST = 2.0
"""Combined standard uncertainties beyond which one value contradicts another."""
LARGEST_TURN = 0.01
"""Convergences that differ by no more agree, degrees: they have no uncertainty."""
QUANTITIES = {
    "gravity": ("g", 5),
    "field": ("nT", 0),
    "dip": ("°", 2),
    "declination": ("°", 2),
    "convergence": ("°", 2),
}
"""Unit of each quantity, and decimals of a message."""
FROM_TABLE, FROM_REFERENCE, FROM_MODEL, NO_SOURCE = "table", "reference", "field model", "none"
"""Sources, in their order."""
_LEAST_SHARE = 1e-9


class Claim(NamedTuple):
    """Values of a quantity in a source: values (n,) in the unit of `QUANTITIES`, with standard uncertainties.

    NaN where it states none.
    """

    source: str
    values: ArrayLike
    sd: ArrayLike = 0.0


def contradictions(name: str, counts: Claim, other: Claim, remedy: str) -> list[Finding]:
    """The finding `NAME-disagrees` if two claims differ by more than their uncertainties; the first one counts.

    Definition: at `FARTHEST` standard uncertainties for one value, farther for several, so that claims that agree are
    named as seldom, however many they are.
    """
    there = ~np.isnan(np.asarray(counts.values, float)) & ~np.isnan(np.asarray(other.values, float))
    values, others, sd = (
        np.broadcast_to(array, there.shape)[there]
        for array in (counts.values, other.values, np.hypot(counts.sd, other.sd))
    )
    if not values.size:
        return []
    from scipy.special import ndtr, ndtri

    off = values - others
    if name in ("declination", "convergence"):
        off = (off + 180.0) % 360.0 - 180.0
    limit = -ndtri(ndtr(-FARTHEST) / off.size) * sd + _LEAST_SHARE * np.abs(others)
    excess = np.abs(off) - np.maximum(limit, LARGEST_TURN if name == "convergence" else 0.0)
    if not (excess > 0).any():
        return []
    return [
        Finding(
            id=f"{name}-disagrees",
            text=_text(name, counts, other, (values, off, sd, excess)) + f" {remedy}",
        )
    ]


def _text(name: str, counts: Claim, other: Claim, parts: tuple[Array, Array, Array, Array]) -> str:
    """Both values where they differ most, and what counts."""
    values, off, sd, excess = parts
    unit, decimals = QUANTITIES[name]
    worst, gap = int(np.argmax(excess)), "" if unit == "°" else " "
    rows = f" at {np.count_nonzero(excess > 0)} of {off.size} rows" if off.size > 1 else ""
    first, second, apart = (
        f"{number:+.{decimals}f}" if unit == "°" else f"{number:.{decimals}f}"
        for number in (values[worst], values[worst] - off[worst], off[worst])
    )
    spread = f" ± {sd[worst]:.{decimals}f}" if sd[worst] else ""
    return (
        f"{name}: {counts.source} states {first}{gap}{unit}{rows}, {other.source} {second}{gap}{unit}: they differ by "
        f"{apart}{spread}{gap}{unit}. The value of {counts.source} counts."
    )


def source_of(stated: Array, otherwise: str) -> str:
    """Where the values of rows come from, of which the table has `stated` (n,) true, and the rest `otherwise`."""
    count = int(np.count_nonzero(stated))
    if count in (0, len(stated)):
        return FROM_TABLE if count else otherwise
    return f"{FROM_TABLE} at {count} of {len(stated)} rows, else {otherwise}"


MEASURABLE = {
    "gravity": "gravity_g",
    "field": "field_nt",
    "dip": "dip_deg",
    "declination": "declination_deg",
}
"""Values that may be measured, and their keys with the unit."""
GRAVITY_ANOMALY = 4.2e-4
"""Spread of real gravity about normal gravity, m/s²: √1795 mGal (Tscherning and Rapp 1974)."""
GRADIENT_IN_ROCK = 2.24e-6
"""By which gravity falls behind the free-air gradient below ground, m/s² per m: 4πGρ of 2670 kg/m³."""
GRAVITY_SD_SOURCE = "gravity anomalies (Tscherning and Rapp 1974), gradient in rock of 2670 kg/m³"
"""Source of the uncertainty of normal gravity."""


class FieldSd(NamedTuple):
    """Standard uncertainties of the main field as a reference; declination also by the horizontal field."""

    field_nt: float
    dip_deg: float
    declination_deg: float
    horizontal_deg_nt: float


OWSG = "OWSG set A Rev 5.1"
"""Source of the uncertainties of the main field."""
PLACE_SD = FieldSd(*(math.hypot(*terms) for terms in (
    (61.0, 88.0, 73.0, 13.0), (0.09, 0.14, 0.11, 0.03), (0.16, 0.24, 0.21, 0.05), (2350.0, 3359.0, 2840.0, 356.0)
)))  # fmt: skip
"""The same for all stations of a well: MFI, MDI, DEC and DBH, each of -U, -OS, -OH and -OI."""
MOMENT_SD = FieldSd(60.0, 0.08, 0.10, 3000.0)
"""Of each station its own: MFIR, MDIR, DECR and DBHR."""
GEOMAGNETIC = {"field", "dip", "declination"}
LOWEST_LAND = -500.0
"""Altitude below which there is no open ground, m."""
LARGEST_ANOMALY = 0.5
"""Departure of a measured field from that of a model, as a share of its strength, beyond which it is a mistake."""
LARGEST_ANOMALY_G = 0.01
"""Departure of measured gravity, g, beyond which it is a mistake. It is over ten times the largest anomaly."""
LEAST_HORIZONTAL = 6000.0
"""Horizontal field below which magnetic azimuths need caution by the World Magnetic Model, nT."""
ALTITUDES = Range(-15_000.0, 100_000.0, "m")
_REFERENCE_BYTES = 1_000_000
_SD = {name: REFERENCES.get(name, REFERENCES["dip"]).uncertainty for name in MEASURABLE}
RANGES_OF_REFERENCE = {
    "latitude_deg": Range(-90.0, 90.0, "°"),
    "longitude_deg": Range(-180.0, 360.0, "°"),
    "altitude_m": ALTITUDES,
    "gravity_g": Range(*EARTH_RANGES["gravity"], "g"),
    "field_nt": Range(*EARTH_RANGES["field"], "nT"),
    "dip_deg": REFERENCES["dip"].values,
    "declination_deg": ROTATION,
    "convergence_deg": ROTATION,
    **{f"sd_{key}": _SD[name] for name, key in MEASURABLE.items()},
    **{f"sd_random_{MEASURABLE[name]}": _SD[name] for name in sorted(GEOMAGNETIC)},
}
"""Accepted values."""
_ARGUMENT_NAMES = {"latitude_deg": "latitude", "longitude_deg": "longitude"}
"""Names of keys where they are given, if not by their own name."""
_REMEDIES = {
    "latitude_deg": "North is positive.",
    "longitude_deg": "East is positive.",
    "altitude_m": "Give it in metres above the ellipsoid.",
    "gravity_g": f"Give it in g of {STANDARD_GRAVITY} m/s².",
    "field_nt": "Give it in nT.",
    "dip_deg": "Down is positive.",
    "declination_deg": "East is positive.",
}


class EarthReference(msgspec.Struct, frozen=True, kw_only=True):
    """Gravity and field at a place and date, and what turns magnetic azimuths into true and grid ones.

    True azimuth = magnetic + declination; grid azimuth = true - convergence; both east positive. Dip is
    positive down. 1 g is 9.80665 m/s².

    Attributes:
        latitude_deg: geodetic, WGS84; north positive.
        longitude_deg: east positive.
        altitude_m: metres above the ellipsoid, negative below.
        date: day for which the field holds.
        convergence_deg: of the grid `crs`; None where no grid was named.
        grid_scale: of that grid: length on the map over that on the ellipsoid.
        model: word of the field model; None where field, dip and declination were all measured.
        epoch: decimal year from which its coefficients are carried forward.
        valid_to: decimal year up to which it holds.
        coefficients: file and version of its coefficients.
        sd_gravity_g: standard uncertainty; this and those of field, dip and declination are of errors
            that all stations of a well share.
        sd_random_field_nt: standard uncertainty of what changes from station to station, as the
            field varies with time; as are those of dip and declination.
        measured: values that were measured at the place, of `MEASURABLE`.
        sources: where values and uncertainties come from.
        findings: what the reader should know.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    date: date
    gravity_g: float
    gravity_ms2: float
    field_nt: float
    dip_deg: float
    declination_deg: float
    convergence_deg: float | None = None
    grid_scale: float | None = None
    crs: str | None = None
    model: str | None = None
    epoch: float | None = None
    valid_to: float | None = None
    coefficients: str | None = None
    coefficients_sha256: str | None = None
    sd_gravity_g: float = 0.0
    sd_field_nt: float = 0.0
    sd_dip_deg: float = 0.0
    sd_declination_deg: float = 0.0
    sd_random_field_nt: float = 0.0
    sd_random_dip_deg: float = 0.0
    sd_random_declination_deg: float = 0.0
    measured: list[str] = []
    sources: dict[str, str] = {}
    findings: list[Finding] = []

    @property
    def norths(self) -> tuple[str, ...]:
        """The norths that azimuths can be counted from."""
        return ("magnetic", "true", *(["grid"] if self.convergence_deg is not None else []))

    @property
    def declination_spread_deg(self) -> tuple[float, float]:
        """1σ of the declination that all stations share, and of each its own; a global model's by default."""
        if self.sd_declination_deg:
            return self.sd_declination_deg, self.sd_random_declination_deg
        return declination_sd(self.field_nt * math.cos(math.radians(self.dip_deg)))

    def offset_deg(self, north: str) -> float:
        """The angle added to a magnetic azimuth to count it from a north, degrees."""
        stated = (north, self.declination_deg, self.convergence_deg)
        metadata = {k: v for k, v in zip(AZIMUTH_KEYS, stated, strict=True) if v is not None}
        return magnetic_offset(metadata, "reference")


def reference_at(
    latitude_deg: float,
    longitude_deg: float,
    altitude_m: float,
    day: date,
    *,
    model: str = "wmm2025",
    crs: str | None = None,
    measured: Mapping[str, float] | None = None,
    uncertainties: Mapping[str, float] | None = None,
) -> EarthReference:
    """The reference of a place and date.

    `measured` values by name of `MEASURABLE`, in the units of their keys, override those of the models,
    with their standard `uncertainties`. Where none is stated it is zero, that of declination as of the model: no
    residual would ever show its error. Measured values are compared with the models. Where field, dip and declination
    were all measured that is all a field model does, and it need not be there.

    Raises:
        InputError: a value that no place on Earth has, or none so near; a model that is missing or does not hold.
    """
    measured, uncertainties = measured or {}, uncertainties or {}
    place: dict[str, Any] = {
        "latitude_deg": float(latitude_deg),
        "longitude_deg": float(longitude_deg),
        "altitude_m": float(altitude_m),
    }
    given = {MEASURABLE[name]: value for name, value in measured.items()}
    stated = {f"sd_{MEASURABLE[name]}": value for name, value in uncertainties.items()}
    check_ranges({**place, **given, **stated})
    for name in sorted(uncertainties.keys() - measured.keys()):
        key = MEASURABLE[name]
        raise InputError(
            f"`sd_{key}` is of a measured value. Add `{key}`, or leave out `sd_{key}`."
        )
    modelled, described = _modelled(place, day, model, measured)
    values: dict[str, Any] = {**modelled, **given}
    spread: dict[str, Any] = _uncertainties(values, altitude_m)
    doubtful = _against_model(modelled, given, stated, altitude_m)
    spread |= {
        f"sd_{MEASURABLE[name]}": uncertainties.get(name, 0.0)
        for name in measured
        if uncertainties.get(name) or name != "declination"
    }
    grid = grid_convergence(crs, latitude_deg, longitude_deg) if crs else None
    return EarthReference(
        **place,
        date=day,
        **values,
        gravity_ms2=values["gravity_g"] * STANDARD_GRAVITY,
        **spread,
        **described,
        convergence_deg=grid.convergence_deg if grid else None,
        grid_scale=grid.scale if grid else None,
        crs=crs or None,
        measured=[name for name in MEASURABLE if name in measured],
        sources=_sources(described.get("coefficients"), measured, grid),
        findings=_findings(values, altitude_m, measured, uncertainties, grid) + doubtful,
    )


def _modelled(
    place: Mapping[str, float], day: date, model: str, measured: Mapping[str, float]
) -> tuple[dict[str, float], dict[str, Any]]:
    """Values of the models by key, and what the field model is, if a value of it is used.

    Without values of the field where all of them are measured, and no model can be had to compare them with.
    """
    gravity = float(normal_gravity(place["latitude_deg"], place["altitude_m"]))
    values = {"gravity_g": gravity / STANDARD_GRAVITY}
    all_measured = measured.keys() >= GEOMAGNETIC
    try:
        year = decimal_year(day)
        coefficients = field_model(model, year)
    except InputError:
        if all_measured:
            return values, {}
        raise
    field = main_field(coefficients, **place, year=year)
    described = {
        "model": model,
        "epoch": coefficients.epoch,
        "valid_to": coefficients.valid_to,
        "coefficients": coefficients.coefficients,
        "coefficients_sha256": coefficients.sha256,
    }
    return {**values, **field._asdict()}, {} if all_measured else described


def _against_model(
    modelled: Mapping[str, float],
    given: Mapping[str, float],
    stated: Mapping[str, float],
    altitude_m: float,
) -> list[Finding]:
    """Measured values that contradict the models.

    Raises:
        InputError: values that no place so near can have.
    """
    names = [name for name, key in MEASURABLE.items() if key in given]
    missing = [f"`{MEASURABLE[name]}`" for name in names if MEASURABLE[name] not in modelled]
    if missing:
        text = f"{', '.join(missing)}: no model of the field to compare with at this date. Check sign and unit."
        findings = [Finding(id="not-compared-with-model", text=text)]
    else:
        _check_possible(modelled, given)
        findings = []
    spread = _uncertainties({**given, **modelled}, altitude_m)
    for name in names:
        key = MEASURABLE[name]
        sd = math.hypot(spread[f"sd_{key}"], spread.get(f"sd_random_{key}", 0.0))
        findings += contradictions(
            name,
            Claim(f"`{key}`", [given[key]], stated.get(f"sd_{key}", 0.0)),
            Claim("the model", [modelled.get(key, math.nan)], sd),
            "Check sign, unit, place and date.",
        )
    return findings


def _check_possible(modelled: Mapping[str, float], given: Mapping[str, float]) -> None:
    """Refuse gravity and field that are too far from those of the models for any place there."""
    values = {**modelled, **given}
    off = given.get("gravity_g", modelled["gravity_g"]) - modelled["gravity_g"]
    if abs(off) > LARGEST_ANOMALY_G:
        raise InputError(
            f"`gravity_g` must be within {LARGEST_ANOMALY_G:g} g of the model's {modelled['gravity_g']:.5f} g; got "
            f"{given['gravity_g']:g} g, which no place there has. {_REMEDIES['gravity_g']}"
        )
    here, there = (_field_vector(each) for each in (modelled, values))
    apart, most = math.dist(here, there), LARGEST_ANOMALY * modelled["field_nt"]
    if apart > most:
        keys = [
            key
            for key in map(MEASURABLE.__getitem__, MEASURABLE)
            if key in given and key != "gravity_g"
        ]
        typed, model = (
            ", ".join(f"{each[key]:g} {_unit(key)}" for key in keys) for each in (given, modelled)
        )
        raise InputError(
            f"{', '.join(f'`{key}`' for key in keys)}: {typed} cannot be of this place, where the model has "
            f"{model}. "
            f"The two fields are {apart:.0f} nT apart, and at most {most:.0f} nT is possible. Check sign, unit, "
            "hemisphere and date."
        )


def _field_vector(values: Mapping[str, float]) -> tuple[float, float, float]:
    """The field to the north, to the east and down, nT."""
    dip, declination = (math.radians(values[key]) for key in ("dip_deg", "declination_deg"))
    level = values["field_nt"] * math.cos(dip)
    return (
        level * math.cos(declination),
        level * math.sin(declination),
        values["field_nt"] * math.sin(dip),
    )


def _unit(key: str) -> str:
    return {"nt": "nT", "deg": "°"}[key.rpartition("_")[2]]


def _uncertainties(values: Mapping[str, float], altitude_m: float) -> dict[str, float]:
    """Standard uncertainties of modelled values, and of what changes from station to station."""
    below = max(-altitude_m, 0.0)
    gravity = math.hypot(GRAVITY_ANOMALY, GRADIENT_IN_ROCK * below) / STANDARD_GRAVITY
    declinations = declination_sd(values["field_nt"] * math.cos(math.radians(values["dip_deg"])))
    spread = {"sd_gravity_g": gravity}
    for prefix, sd, declination in zip(
        ("sd_", "sd_random_"), (PLACE_SD, MOMENT_SD), declinations, strict=True
    ):
        spread |= {
            f"{prefix}field_nt": sd.field_nt,
            f"{prefix}dip_deg": sd.dip_deg,
            f"{prefix}declination_deg": declination,
        }
    return spread


def declination_sd(horizontal_nt: float) -> tuple[float, float]:
    """1σ of a global model's declination, degrees: what all stations share, and of each its own."""
    shared, alone = (
        math.hypot(sd.declination_deg, sd.horizontal_deg_nt / max(horizontal_nt, 1.0))
        for sd in (PLACE_SD, MOMENT_SD)
    )
    return min(shared, _SD["declination"].high), min(alone, _SD["declination"].high)


def _sources(
    coefficients: str | None, measured: Mapping[str, float], grid: Grid | None
) -> dict[str, str]:
    """Where each value comes from, and the uncertainties of those that were not measured."""
    sources = dict.fromkeys(MEASURABLE, str(coefficients))
    sources["gravity"] = "WGS84 normal gravity (NIMA TR8350.2)"
    sources |= dict.fromkeys(measured, "measured")
    sources["sd_gravity"] = "stated" if "gravity" in measured else GRAVITY_SD_SOURCE
    sources["sd_field_dip_declination"] = (
        OWSG if not GEOMAGNETIC & measured.keys() else f"{OWSG}; of measured values their own"
    )
    return sources | ({"convergence": grid.name} if grid else {})


def _findings(
    values: Mapping[str, float], altitude_m: float, measured: Mapping[str, float],
    uncertainties: Mapping[str, float], grid: Grid | None,
) -> list[Finding]:  # fmt: skip
    """The findings about a reference."""
    findings = []
    for name in measured:
        if not uncertainties.get(name):
            key = MEASURABLE[name]
            as_model = name == "declination"
            taken = "that of a field model is taken" if as_model else "it is taken as exact"
            text = f"`{key}` has no standard uncertainty: {taken}. State `sd_{key}`."
            kind = "declination-uncertainty-assumed" if as_model else "exact-reference"
            findings.append(Finding(id=kind, text=text))
    horizontal = values["field_nt"] * math.cos(math.radians(values["dip_deg"]))
    if horizontal < LEAST_HORIZONTAL:
        text = (
            f"the horizontal field is {horizontal:.0f} nT: magnetic azimuths are unreliable so close to "
            "a magnetic pole."
        )
        findings.append(Finding(id="magnetic-pole", text=text))
    if altitude_m < LOWEST_LAND and "gravity" not in measured:
        text = (
            "below ground gravity does not follow the free-air gradient of normal gravity: its "
            "uncertainty is enlarged. Measure gravity, or use the altitude of the ground."
        )
        findings.append(Finding(id="gravity-below-ground", text=text))
    if grid and not grid.covered:
        text = f"the place is outside the area of use of {grid.name}. Check `crs` and the zone."
        findings.append(Finding(id="outside-grid", text=text))
    if grid and grid.distortion_deg > LEAST_DISTORTION:
        text = (
            f"{grid.name} does not keep angles: grid azimuths are off by up to {grid.distortion_deg:.2g}°, those "
            "along the meridian by nothing. Use a conformal grid for the well plan."
        )
        findings.append(Finding(id="grid-not-conformal", text=text))
    return findings


def north_contradictions(
    source: str, stated: Mapping[str, float], sd: float, reference: EarthReference
) -> list[Finding]:
    """Declination and convergence that a source has `stated`, in degrees, and that are not those of the reference.

    `sd`: standard uncertainty of its declination.
    """
    of_place = {
        "declination": (sd, reference.declination_deg, reference.declination_spread_deg[0]),
        "convergence": (0.0, reference.convergence_deg, 0.0),
    }
    return [
        finding
        for name, (sd_stated, value, spread) in of_place.items()
        if f"{name}_deg" in stated and value is not None
        for finding in contradictions(
            name,
            Claim(source, [stated[f"{name}_deg"]], sd_stated),
            Claim("the reference", [value], spread),
            "Check sign, place and date.",
        )
    ]


def check_ranges(values: Mapping[str, float], source: str = "") -> None:
    """Refuse a value that no place on Earth has; `source` is the file that states it."""
    for key, value in values.items():
        limits = RANGES_OF_REFERENCE[key]
        if not limits.low <= value <= limits.high:
            named = f"{source}: '{key}'" if source else f"`{_ARGUMENT_NAMES.get(key, key)}`"
            raise InputError(f"{named} must be {limits}; got {value:g}. {_remedy(key, values)}")


def _remedy(key: str, values: Mapping[str, float]) -> str:
    if key == "latitude_deg" and abs(values.get("longitude_deg", math.inf)) <= 90.0:
        return "Are latitude and longitude swapped?"
    return _REMEDIES.get(key, "State a standard uncertainty (1σ).")


def load_reference(path: str | os.PathLike[str]) -> tuple[EarthReference, str]:
    """A reference that `mwdcal reference` wrote, and the SHA-256 of its file."""
    file = Path(path)
    try:
        with file.open("rb") as stream:
            data = stream.read(_REFERENCE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read ({reason(error)}). Check the path.") from None
    try:
        head = msgspec.json.decode(data, type=dict[str, Any])
        if len(data) > _REFERENCE_BYTES or head.get("command") != "reference":
            raise msgspec.ValidationError("it is not of that command")
        if head.get("schema_version") != DOCUMENT_VERSION:
            version = (
                f"'schema_version' must be {DOCUMENT_VERSION}; got {head.get('schema_version')!r}"
            )
            raise msgspec.ValidationError(version)
        reference = msgspec.json.decode(data, type=EarthReference)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"{file.name} is not a reference: {error}. Use a file that mwdcal reference wrote."
        ) from None
    numbers = {key: getattr(reference, key) for key in RANGES_OF_REFERENCE}
    if not math.isclose(reference.gravity_ms2, reference.gravity_g * STANDARD_GRAVITY):
        raise InputError(
            f"{file.name}: 'gravity_ms2' must be 'gravity_g' times {STANDARD_GRAVITY}; got "
            f"{reference.gravity_ms2:g} and {reference.gravity_g:g}. Use the file as mwdcal wrote it."
        )
    check_ranges({key: value for key, value in numbers.items() if value is not None}, file.name)
    return reference, sha256_of(data)


FILLED = ("gravity", "field", "dip")
"""References of a run that are those of a place."""
PLACE_KEY = "earth_reference"
"""Metadata key of a run in which references of a place were filled: where these come from."""


class FilledRun(NamedTuple):
    """A run with the references of a place, how many cells of each column were filled, and findings."""

    table: Table
    cells: dict[str, int]
    findings: list[Finding]


def fill(table: Table, reference: EarthReference) -> FilledRun:
    """A run with blank gravity, field and dip filled, and their uncertainties beside them.

    A cell that holds a value keeps it, and its uncertainty as it is. Where the run counts its azimuths from
    true or grid north, its metadata get the declination and the convergence that they do not state. An
    uncertainty is that of the whole run: of the place, and of the field at the moment of the run.
    """
    check_run(table)
    columns, counts = dict(table.columns), {}
    findings = _other_date(table, reference)
    stated = stated_norths(table.metadata, table.source)
    findings += north_contradictions(table.source, stated, 0.0, reference)
    for name in FILLED:
        column, value, sd = REFERENCES[name].column, *_of_run(reference, name)
        cells = numbers(table, column) if column in columns else np.full(table.count, np.nan)
        blank = np.isnan(cells)
        findings += contradictions(
            name,
            Claim(table.source, cells, _column_uncertainties(table, f"sd_{column}")),
            Claim("the reference", [value], sd),
            f"Check {column}, its unit, the place and the date.",
        )
        counts[column] = int(blank.sum())
        if counts[column]:
            columns[column] = _filled(table, column, blank, value)
            columns[f"sd_{column}"] = _filled(table, f"sd_{column}", blank, sd)
    if not any(counts.values()):
        text = f"{table.source}: no cell of {', '.join(counts)} is blank. Nothing was filled."
        return FilledRun(table, counts, [*findings, Finding(id="nothing-filled", text=text)])
    filled = replace(table, columns=columns, metadata=_metadata(table, reference))
    return FilledRun(filled, counts, findings)


def _of_run(reference: EarthReference, name: str) -> tuple[float, float]:
    """A value, and its standard uncertainty in a run."""
    key = MEASURABLE[name]
    random = getattr(reference, f"sd_random_{key}", 0.0)
    return getattr(reference, key), math.hypot(getattr(reference, f"sd_{key}"), random)


def _column_uncertainties(table: Table, column: str) -> Array:
    """Standard uncertainties (n,) of a column, 0 where none is stated."""
    return (
        np.nan_to_num(numbers(table, column)) if column in table.columns else np.zeros(table.count)
    )


def _filled(table: Table, name: str, where: Bools, value: float) -> Column:
    """A column with a value in the blank cells where that is true; a new one is blank elsewhere."""
    cells = table.columns.get(name)
    if cells is None:
        return np.where(where, value, np.nan)
    blank = where & np.isnan(numbers(table, name))
    if isinstance(cells, list):
        text = repr(value).replace(".", table.decimal)
        return [text if new else cell for cell, new in zip(cells, blank.tolist(), strict=True)]
    return np.where(blank, value, cells)


def _metadata(table: Table, reference: EarthReference) -> Mapping[str, object]:
    """The metadata of a run, with what turns its azimuths and where its references come from."""
    metadata = dict(table.metadata)
    north, *angles = AZIMUTH_KEYS
    if REFERENCES["azimuth"].column in table.columns:
        if metadata.get(north, "magnetic") != "magnetic":
            known = {key: getattr(reference, key) for key in angles}
            metadata = {k: v for k, v in known.items() if v is not None} | metadata
        magnetic_offset(metadata, table.source)
    model = reference.model or "measured"
    place = f"latitude {reference.latitude_deg:g}°, longitude {reference.longitude_deg:g}°"
    metadata[PLACE_KEY] = f"{model}, {place}, altitude {reference.altitude_m:g} m, {reference.date}"
    return metadata


def _other_date(table: Table, reference: EarthReference) -> list[Finding]:
    """That the run states another day than the reference."""
    stated = str(table.metadata.get("date", ""))
    if not stated or stated[: len("2026-01-01")] == str(reference.date):
        return []
    text = f"{table.source} states the date {shown(stated)}, the reference is of {reference.date}. Check `date`."
    return [Finding(id="other-date", text=text)]
