"""Multi-station analysis on the screen: interference, what the surveys determine of it, and each survey."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.calibration.readings import simulated
from mwdcal.screens.numbers import fixed, measured, number
from mwdcal.screens.text import chance, one_line, plural, table
from mwdcal.survey.interference import Interference, MultiStationAnalysis

MOST_CORRECTED = 30
"""Surveys of a table on screen."""
DIRECTION_TITLES = ["interference", "estimate", "1σ", "unit", "assumed 1σ", "from the surveys"]
"""Titles of the table of directions."""
CORRECTED_TITLES = [
    "station", "inclination, °", "azimuth before, °", "after, °", "1σ, °", "change, °",
    "|b| off before, nT", "after, nT", "dip off before, °", "after, °", "weight", "",
]  # fmt: skip
"""Titles of the table of surveys."""


def direction_rows(summary: MultiStationAnalysis) -> list[list[str]]:
    """A row for each direction of interference."""
    rows = []
    for each in summary.directions:
        factor, unit = (1.0, each.unit) if each.unit else (100.0, "%")
        value, sd = measured(factor * each.value, factor * each.standard_uncertainty)
        assumed = number(factor * each.assumed)
        rows.append([each.direction, value, sd, unit, assumed, "yes" if each.determined else "NO"])
    return rows


def corrected_rows(summary: MultiStationAnalysis, most: int) -> list[list[str]]:
    """A row for each survey, before and after."""
    return [
        [
            row.station,
            fixed(row.inclination_deg, 2),
            fixed(row.azimuth_before_deg, 2),
            fixed(row.azimuth_after_deg, 2),
            fixed(row.sd_azimuth_after_deg, 2),
            fixed(row.azimuth_change_deg, 2),
            fixed(row.field_before_nt - row.ref_field_nt, 0),
            fixed(row.field_after_nt - row.ref_field_nt, 0),
            fixed(row.dip_before_deg - row.ref_dip_deg, 2),
            fixed(row.dip_after_deg - row.ref_dip_deg, 2),
            fixed(row.weight, 2),
            "doubtful" if row.doubtful else "",
        ]
        for row in summary.station_rows[:most]
    ]


def verdict(summary: MultiStationAnalysis) -> str:
    """Whether the correction may be used, in a sentence."""
    left = (
        f"interference and drift that are left make the azimuth uncertain by {summary.azimuth_sd_deg:.2g}° (1σ, worst "
        f"survey; {summary.largest_azimuth_sd_deg:g}° allowed)"
    )
    return f"{'separable' if summary.separable else 'NOT separable from azimuth'}: {left}"


def misfit_in_words(summary: MultiStationAnalysis) -> str:
    """χ² before and after, in words."""
    return (
        f"χ² of |g|, |b| and dip {number(summary.chi_square_before)} before, {number(summary.chi_square_after)} after, "
        f"{summary.degrees_of_freedom} expected (probability after {chance(summary.chance_after)})"
    )


def screen(result: Interference, *metadata: Mapping[str, object]) -> str:
    """The analysis for people; `metadata` of calibration and readings."""
    summary = result.summary
    count = len(summary.station_rows)
    heading = [
        "multi-station analysis", result.readings.source, plural(count, "survey"), *simulated(*metadata)
    ]  # fmt: skip
    lines = ["   ".join(heading), verdict(summary)]
    lines += [summary.missing] if summary.missing else []
    lines += [misfit_in_words(summary), result.terms.sentence]
    more = count - MOST_CORRECTED
    surveys = table(corrected_rows(summary, MOST_CORRECTED), CORRECTED_TITLES)
    parts = [
        *map(one_line, lines),
        "",
        table(direction_rows(summary), DIRECTION_TITLES),
        "",
        surveys,
    ]
    return "\n".join([*parts, *([f"… and {more} more"] if more > 0 else [])])
