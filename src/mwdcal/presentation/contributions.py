"""Contributions to the uncertainty of surveys by cause: on the screen, as a table and for machines."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.units import LENGTH_UNITS
from mwdcal.geometry.vectors import Array
from mwdcal.presentation.numbers import fixed, number
from mwdcal.presentation.text import table
from mwdcal.survey.contributions import CONTRIBUTED, Contributions
from mwdcal.survey.surveying import SurveyedWell, described

SHARE_TITLES = ["of the variance, %", "propagation", "inc", "azi", "north", "east", "TVD"]
"""Titles of the shares of causes at a station on the screen; the last row is 1σ."""
_STATED_DIGITS = 6


def _sd_columns(unit: str = "m") -> list[str]:
    """Columns of 1σ by a cause, in the order of `CONTRIBUTED`."""
    return [f"sd_{n}_deg" if n in CONTRIBUTED[:2] else f"sd_{n}_{unit}" for n in CONTRIBUTED]


def _factors(unit: str = "m") -> Array:
    """Units of files per radian and metre, in the order of `CONTRIBUTED`."""
    turns = [name in CONTRIBUTED[:2] for name in CONTRIBUTED]
    return np.where(turns, np.degrees(1.0), 1 / LENGTH_UNITS[unit])


class CauseOfError(msgspec.Struct, frozen=True, kw_only=True):
    """The 1σ that one cause makes at every station, and how its errors propagate.

    `propagation`: random (new at every station), systematic (lasts over the run), well or global.
    """

    cause: str
    propagation: str
    sd_inclination_deg: list[float | None]
    sd_azimuth_deg: list[float | None]
    sd_north_m: list[float | None]
    sd_east_m: list[float | None]
    sd_tvd_m: list[float | None]
    sd_along_hole_m: list[float | None]
    sd_lateral_m: list[float | None]
    sd_highside_m: list[float | None]


class ContributionSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The causes of the 1σ of surveys by station, in the order of the table; their squares add up to those of `total`.

    Lateral is to the right of the hole as seen along it, highside across it and up.
    """

    station: list[str]
    md_m: list[float | None]
    causes: list[CauseOfError]
    total: CauseOfError


def contribution_summary(result: Contributions) -> ContributionSummary:
    """The contributions for machines, to six digits."""
    return ContributionSummary(
        station=[*result.station],
        md_m=_stated(result.md),
        causes=[
            _cause(name, cause.propagation, sd)
            for name, cause, sd in zip(result.names, result.causes, result.sd, strict=True)
        ],
        total=_cause("all", "", result.total),
    )


def _cause(name: str, propagation: str, sd: Array) -> CauseOfError:
    columns = zip(_sd_columns(), (sd * _factors()).T, strict=True)
    return CauseOfError(cause=name, propagation=propagation, **{k: _stated(v) for k, v in columns})


def _stated(values: Array) -> list[float | None]:
    return [float(f"{v:.{_STATED_DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]


def contribution_table(surveyed: SurveyedWell) -> Table:
    """A table of the contributions, with what the table of the surveys states of itself."""
    assert surveyed.contributions is not None
    unit = surveyed.well.length_unit
    return Table(contribution_columns(surveyed.contributions, unit), described(surveyed.well))


def contribution_columns(result: Contributions, unit: str = "m") -> Mapping[str, Column]:
    """A row for each station and cause, with 1σ and share in the variance; lengths in a unit."""
    count, stations = len(result.causes), len(result.station)
    columns: dict[str, Column] = {
        "station": [label for label in result.station for _ in range(count)],
        f"md_{unit}": np.repeat(result.md / LENGTH_UNITS[unit], count),
        "cause": [*result.names] * stations,
        "propagation": [cause.propagation for cause in result.causes] * stations,
    }
    sd, share = (
        np.swapaxes(each, 0, 1).reshape(-1, len(CONTRIBUTED)) for each in (result.sd, result.share)
    )
    columns |= dict(zip(_sd_columns(unit), (sd * _factors(unit)).T, strict=True))
    return columns | {f"share_{name}": share[:, k] for k, name in enumerate(CONTRIBUTED)}


def station_row(result: Contributions, label: str | None) -> int:
    """The row of a station by its label; by default the last one on the path, else the last with a result.

    Raises:
        InputError: no station, or several, of that label.
    """
    if label is None:
        stated = ~np.isnan(result.total)
        known = stated[:, 2] if stated[:, 2].any() else stated[:, 0]
        return int(np.flatnonzero(known)[-1]) if known.any() else len(known) - 1
    rows = [i for i, name in enumerate(result.station) if name == label]
    if len(rows) != 1:
        raise InputError(
            f"`station` '{label}': {len(rows) or 'no'} stations have that label. Name one of the column station, or a "
            "row by its number where there is no such column."
        )
    return rows[0]


def share_rows(result: Contributions, row: int, unit: str = "m") -> list[list[str]]:
    """Shares of each cause at a station, per cent, the largest in position or azimuth first; 1σ of all last."""
    share, shown = result.share[:, row], len(SHARE_TITLES) - 2
    order = np.argsort(-np.nan_to_num(share[:, :shown]).max(-1), kind="stable")
    rows = [
        [
            result.names[k],
            result.causes[k].propagation,
            *(fixed(100 * part, 1) for part in share[k, :shown].tolist()),
        ]
        for k in order.tolist()
    ]
    total = (result.total[row] * _factors(unit))[:shown].tolist()
    units = ["°", "°", *[f" {unit}"] * 3]
    sd = [number(v, 2) + (u if np.isfinite(v) else "") for v, u in zip(total, units, strict=True)]
    return [*rows, ["1σ of all", "", *sd]]


def contribution_screen(result: Contributions, label: str | None = None, unit: str = "m") -> str:
    """The causes of the uncertainty at one station for people."""
    row = station_row(result, label)
    md = result.md[row] / LENGTH_UNITS[unit]
    where = f" at {fixed(md, 2)} {unit} MD" if np.isfinite(md) else ""
    heading = f"contributions to the uncertainty of station {result.station[row]}{where}"
    return f"{heading}\n\n{table(share_rows(result, row, unit), SHARE_TITLES)}"
