"""A survey listing for well-planning programs: plain columns under the titles that they know."""

from __future__ import annotations

from typing import cast

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.units import LENGTH_UNITS, USUAL_COURSES
from mwdcal.geometry.vectors import Array
from mwdcal.survey.path import TieIn
from mwdcal.survey.surveying import SurveyedWell, covariance_columns, described
from mwdcal.survey.well import Well

LISTED_DECIMALS = 4
"""Of lengths and angles: a tenth of a millimetre."""


def listing(surveyed: SurveyedWell) -> Table:
    """The stations on the path, the tie-in first: angles, position, section, closure, dogleg, covariance.

    Raises:
        InputError: there is no path.
    """
    well = surveyed.well
    if well.position is None or not well.position.on_path.any():
        raise InputError(
            "`listing` is of the well path, which these surveys do not have. Add measured depths, and see that "
            "stations have results: outside the calibrated temperatures they have none."
        )
    rows = np.flatnonzero(well.position.on_path)
    unit, metres = well.length_unit, LENGTH_UNITS[well.length_unit]
    course, columns = USUAL_COURSES[unit], well.columns
    azimuth = f"azimuth_{well.north.name}_deg"
    start = well.started if isinstance(well.started, TieIn) else None
    place, covariance = well.position.place[rows], well.position.covariance[rows]
    angles = np.stack([cast(Array, columns[n])[rows] for n in ("inclination_deg", azimuth)], -1)
    md, bend = well.position.md[rows], well.position.dogleg[rows]
    if start:
        first = np.degrees([start.inclination, start.azimuth % (2 * np.pi)])
        spread = np.zeros((3, 3)) if start.covariance is None else start.covariance
        md, bend = np.r_[start.md, md], np.r_[np.nan, bend]
        angles, place = np.vstack([first, angles]), np.vstack([start.place, place])
        covariance = np.concatenate([spread[None], covariance])
    closure, bearing = closures(place)
    section = place[:, :2] @ [np.cos(well.north.section), np.sin(well.north.section)]
    titled: dict[str, Column] = {
        f"MD ({unit})": md / metres,
        "Inc (deg)": angles[:, 0],
        f"Azi {well.north.name} (deg)": angles[:, 1],
        f"TVD ({unit})": place[:, 2] / metres,
        f"N/S ({unit})": place[:, 0] / metres,
        f"E/W ({unit})": place[:, 1] / metres,
        f"V.Sec ({unit})": section / metres,
        f"DLS (deg/{course:g}{unit})": np.degrees(bend * course * metres),
        f"Closure ({unit})": closure / metres,
        "Closure azi (deg)": bearing,
        **_on_map(well, place),
    }
    rounded = {n: np.round(cast(Array, v), LISTED_DECIMALS) + 0.0 for n, v in titled.items()}
    spreads = covariance_columns(covariance, unit)
    stated = {k: v for k, v in described(well).items() if k != "findings"}
    section_deg = float(np.degrees(well.north.section))
    return Table({**rounded, **spreads}, {**stated, "section_azimuth_deg": section_deg})


def closures(place: Array) -> tuple[Array, Array]:
    """Horizontal distance (n,), m, from north 0, east 0, and its azimuth, degrees; NaN at the origin itself."""
    distance = np.hypot(place[:, 0], place[:, 1])
    bearing = np.degrees(np.arctan2(place[:, 1], place[:, 0])) % 360
    return distance, np.where(distance > 0, bearing, np.nan)


def _on_map(well: Well, place: Array) -> dict[str, Column]:
    """North and east on the map: from the start of the path times the scale of the grid, where it is known."""
    if well.north.scale is None:
        return {}
    unit, metres = well.length_unit, LENGTH_UNITS[well.length_unit]
    mapped = (place[0] + well.north.scale * (place - place[0])) / metres
    return {f"Map N ({unit})": mapped[:, 0], f"Map E ({unit})": mapped[:, 1]}
