"""Grid convergence of every projected system of the EPSG database, against points that PROJ transforms back.

The second computation goes the other way: it steps along the grid's axes, finds that of north by its name, takes
the steps back to WGS84, and turns their derivative into the bearing of the meridian. Both use one operation of
PROJ for each system: the search for it takes most of the time.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from functools import cache

import numpy as np
import pyproj
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from world import table, turned, write

from mwdcal.errors import InputError
from mwdcal.survey.references import LEAST_DISTORTION, grid_convergence

SHARES = ((0.5, 0.5), (0.1, 0.1), (0.1, 0.9), (0.9, 0.1), (0.9, 0.9))
"""Where in the area of use, by share of latitude and longitude."""
REACH = 2e-4
"""Half of a step on the grid, as degrees of latitude."""
LIMIT = 0.005
"""Largest difference that is allowed, degrees."""


def places(system: pyproj.CRS) -> Iterator[tuple[float, float]]:
    """Latitudes and longitudes in the area of use of a system."""
    west, south, east, north = system.area_of_use.bounds
    if south < -90:  # as PROJ says where the database has no bounds
        params = {each.name: each.value for each in system.coordinate_operation.params}
        centre = params["Longitude of natural origin"]
        west, south, east, north = centre - 3, 0.0, centre + 3, 60.0
    span = (east - west) % 360 or 360.0
    for up, right in SHARES:
        yield south + up * (north - south), (west + right * span + 180) % 360 - 180


def bearing_of_north(
    system: pyproj.CRS, onto: pyproj.Transformer, latitude: float, longitude: float
) -> float:
    """Bearing on the grid of the meridian of WGS84 through a place, degrees."""
    names = [axis.name.lower() for axis in system.axis_info[:2]]
    north = next(i for i, name in enumerate(names) if name.startswith(("north", "south")))
    sign = [-1.0 if name.startswith(("south", "west")) else 1.0 for name in names]
    moves = np.zeros((2, 2))
    for row, axis in enumerate((1 - north, north)):
        moves[row, axis] = sign[axis]
    here = np.array(onto.transform(latitude, longitude))
    with suppress(pyproj.exceptions.ProjError):
        onto = onto.get_last_used_operation()
    towards = latitude - np.copysign(REACH, latitude)
    moves *= np.hypot(*(here - onto.transform(towards, longitude)))
    ends = here + np.stack([moves, -moves])
    up, right = onto.transform(ends[..., 0], ends[..., 1], direction="INVERSE")
    sine, flat = np.sin(np.radians(latitude)), 0.00669437999
    east = turned(right[0] - right[1]) * np.cos(np.radians(latitude)) * (1 - flat * sine**2)
    grid = np.linalg.solve(np.stack([east, (up[0] - up[1]) * (1 - flat)]), [0.0, 1.0])
    return float(np.degrees(np.arctan2(*grid)))


def kinds(system: pyproj.CRS) -> Iterator[str]:
    """The rows of the table that a system counts in."""
    yield "all"
    if system.prime_meridian.longitude:
        yield "prime meridian not Greenwich"
    directions = {axis.direction for axis in system.axis_info[:2]}
    if directions & {"west"} or directions == {"south", "east"}:
        yield "an axis that counts south or west"
    if directions in ({"north"}, {"south"}):
        yield "about a pole"
    if system.axis_info[0].unit_conversion_factor != 1.0:
        yield "not in metres"


def main(step: int = 1) -> None:
    """Compare every system, or every `step`-th one."""
    warnings.simplefilter("ignore")
    systems, points, refused, worst = Counter(), Counter(), Counter(), defaultdict(float)
    without, distorted = defaultdict(list), defaultdict(float)
    pyproj.Transformer.from_crs = cache(pyproj.Transformer.from_crs)  # type: ignore[method-assign]
    found = query_crs_info("EPSG", [PJType.PROJECTED_CRS], allow_deprecated=True)[::step]
    for info in found:
        code, system = f"EPSG:{info.code}", pyproj.CRS.from_epsg(info.code)
        rows = list(kinds(system))
        systems.update(rows)
        method = system.coordinate_operation.method_name
        for place in places(system):
            try:
                grid = grid_convergence(code, *place)
            except InputError:
                refused.update(rows)
                without[method].append(code)
                continue
            onto = pyproj.Transformer.from_crs("EPSG:4326", system)
            off = abs(turned(grid.convergence_deg + bearing_of_north(system, onto, *place)))
            off = np.inf if np.isnan(off) else float(off)
            if off > LIMIT:
                print(code, system.name, place, off, file=sys.stderr)
            points.update(rows)
            distorted[method] = max(distorted[method], grid.distortion_deg)
            for row in rows:
                worst[row] = max(worst[row], off)
    _write(systems, points, refused, worst, without, distorted)


def _write(systems, points, refused, worst, without, distorted) -> None:  # type: ignore[no-untyped-def]
    """The page."""
    first = table(
        ["systems", "number", "points", "refused points", "largest difference"],
        [(k, n, points[k], refused[k], f"{worst[k]:.1g}°") for k, n in systems.items()],
    )
    second = table(
        ["method", "systems", "codes"],
        [(m, len(set(c)), ", ".join(sorted(set(c))[:6])) for m, c in sorted(without.items())],
    )
    third = table(
        ["method", "largest error of an angle"],
        [(m, f"{d:.2g}°") for m, d in sorted(distorted.items()) if d > LEAST_DISTORTION],
    )
    write(
        "convergence",
        "Grid convergence of the EPSG database",
        f"Every projected system of the database, deprecated ones too, at five points of its area of use. `mwdcal "
        f"reference` and the derivative of PROJ's inverse must agree within {LIMIT}°.\n",
        first,
        "Refused (exit status 2), since PROJ has no such projection:\n",
        second,
        "These projections do not keep angles. Their convergence is the bearing of true north; a finding states how "
        "far other directions are off, at most:\n",
        third,
        simulated=False,
        facts={"PROJ": pyproj.proj_version_str, "pyproj": pyproj.__version__},
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
