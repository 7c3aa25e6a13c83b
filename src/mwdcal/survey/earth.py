"""The Earth at a place and date: normal gravity and the main magnetic field.

Nothing is loaded from a network: coefficients are those of the installed libraries.

Grid north of a map projection: its convergence at a place, from points that PROJ transforms.
"""

from __future__ import annotations

import math
import re
from calendar import isleap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import date
from functools import cache
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array, ArrayLike

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


def optional_library(name: str, what: str) -> Any:
    """A library of the extra 'survey', or what to install."""
    try:
        return import_module(name)
    except ImportError:
        raise _missing(name, what) from None


def _coefficients(library: str, file: str, what: str) -> tuple[str, str]:
    """The text of a file of coefficients in a library that need not be imported, and its SHA-256."""
    spec = find_spec(library)
    if spec is None or spec.origin is None:
        raise _missing(library, what)
    try:
        data = (Path(spec.origin).parent / file).read_bytes()
    except OSError:
        raise InputError(
            f"{library} {version(library)} has no file {file}. Install another version: "
            'pip install -U "mwdcal[survey]"'
        ) from None
    return data.decode("utf-8"), sha256_of(data)


def _named(model: str, file: str, library: str) -> str:
    return f"{model}, {Path(file).name} of {library} {version(library)}"


def _missing(name: str, what: str) -> InputError:
    return InputError(
        f"{what} needs {name}, which is not installed. Install the extra 'survey': "
        'pip install "mwdcal[survey]"'
    )


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
    """

    convergence_deg: float
    name: str
    covered: bool
    distortion_deg: float


def grid_convergence(crs: str, latitude_deg: float, longitude_deg: float) -> Grid:
    """Grid north of a map projection at a place on WGS84.

    Definition: two points on the place's meridian of WGS84, transformed to the grid, lie on a line of bearing
    -convergence; A_grid = A_true - convergence. Grid north is the axis that counts north, or the opposite of the
    one that counts south. Where both axes point along meridians, as at the poles, it is the one that lies 90°
    anticlockwise of the other.

    Raises:
        InputError: no such projection, one that PROJ cannot compute, or a place it does not show.
    """
    pyproj = optional_library("pyproj", "The convergence of a grid")
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
