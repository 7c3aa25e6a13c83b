"""Grid north of a map projection: its convergence at a place, from points that PROJ transforms."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array
from mwdcal.survey.place.earth import FLATTENING, SEMI_MAJOR_AXIS, optional_library

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
