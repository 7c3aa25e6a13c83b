"""The surveys of a well from a table of readings: everything that `survey` computes, in two steps.

Surveys from a table of readings, and the table with the results beside its columns.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.automatic.drift import JULIAN_YEAR
from mwdcal.calibration.readings import CONSTANTS, Readings, is_simulated, stated_day
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import synonyms
from mwdcal.files.contract import (
    AZIMUTH_KEYS,
    REFERENCES,
    ROTATION,
    check_columns,
    check_near_misses,
    chosen,
    nothing,
    spread,
    stated_norths,
    wholly_blank,
    without_reading,
)
from mwdcal.files.depths import (
    MEASURED_DEPTHS,
    chosen_length,
    counts_stations,
    is_depth,
    is_length,
    is_other_length,
    unit_of_length,
)
from mwdcal.files.formats.columns import looks_numeric, shown
from mwdcal.files.formats.table import Table, cell_error, numbers
from mwdcal.files.profiles import setting
from mwdcal.files.runs import away_from_stand, renamed, to_readings
from mwdcal.geometry.circle import means
from mwdcal.geometry.units import LENGTH_UNITS
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.sensor.profile import StandProfile
from mwdcal.survey.acceptance import SensorTerms, SurveyLimits, load_survey_limits
from mwdcal.survey.axes import exchanged_axes
from mwdcal.survey.axial import AxialCorrection, axial_correction
from mwdcal.survey.contributions import Contributions, contributions
from mwdcal.survey.error_model import BUILT_IN, ErrorModel, load_error_model
from mwdcal.survey.interference import Interference, interference
from mwdcal.survey.interference_estimate import Assumed, sensor_drift
from mwdcal.survey.path import PathEnd, TieIn
from mwdcal.survey.references import (
    FROM_REFERENCE,
    MEASURABLE,
    NO_SOURCE,
    Claim,
    EarthReference,
    contradictions,
    load_reference,
    source_of,
)
from mwdcal.survey.stations import DECLINATIONS, RANDOM, SD_KEY, TOOLFACE_SWITCH, North, norths_of
from mwdcal.survey.trajectory import TrajectoryFacts, has_stations, north_of_tie_in, trajectory
from mwdcal.survey.well import AXES_OF_EARTH, Before, Well, WellCounts, well

NO_MODEL = "none"
"""The word for standard uncertainties of calibration, noise and declination alone."""
RANDOM_COLUMNS = {f"sd_random_{REFERENCES[name].column}": RANDOM + name for name in CONSTANTS}
"""Columns of what gravity, field and dip are uncertain by anew at every row, by their names in `Readings.sd`."""
DECLINATION_COLUMNS = (DECLINATIONS[0], AZIMUTH_KEYS[1])
"""Names of the column of a declination that varies by row: that of a reference, and the key that metadata have."""
BY_ROW = {
    **dict.fromkeys(DECLINATION_COLUMNS, ROTATION),
    **dict.fromkeys(DECLINATIONS[1:], REFERENCES["dip"].uncertainty),
    **{f"sd_random_{REFERENCES[name].column}": REFERENCES[name].uncertainty for name in CONSTANTS},
}
"""Columns of references that surveys alone have, with the values they take."""
MOST_CONTRIBUTED = 2000
"""Surveys of a table whose contributions are computed."""
DEPTHS_COUNT = (
    "the measured depths go on by one, as numbers of surveys do. Is it the right column? Name another by `column` "
    '"md_m=NAME".'
)
"""The finding that depths are a numbering."""
LARGEST_DEPTH = 20_000.0
"""No hole is longer, m."""


@dataclass(frozen=True)
class SurveyReadings:
    """The readings of a table, measured depths (n,) in the column `depth`, and the norths that azimuths may count from.

    `sources`: where gravity, field, dip, declination and convergence come from, by name. `findings`: what of the
    reference contradicts the table, or is not used.
    """

    readings: Readings
    md: Array | None
    north: North
    sources: Mapping[str, str]
    findings: list[Finding]
    depth: str = ""

    @property
    def others_used(self) -> tuple[str, ...]:
        """Columns that a survey uses and a run of calibration does not: references by row, and the measured depth."""
        return (*BY_ROW, self.depth)

    @property
    def uses_reference(self) -> bool:
        """Whether anything of the reference of the place is used."""
        return any(FROM_REFERENCE in source for source in self.sources.values())


def survey_readings(
    table: Table,
    calibration: Calibration,
    reference: EarthReference | None = None,
    recognised: bool = True,
    length_unit: str = "",
) -> SurveyReadings:
    """The readings of a table of surveys, and the references they are judged and turned by.

    Uncertainties of the laboratory's stand and references do not count in a well.
    Stations have fingerprints where they are to be `recognised`.
    Values of the table override the `reference`, by `mwdcal.survey.references`.

    Raises:
        InputError: a table that cannot be read, depths under another name or in another unit.
    """
    readings, md = station_readings(table, calibration, recognised, length_unit)
    named = renamed(table, calibration.profile)
    rows = by_row(named)
    stated = {**table.metadata, **typical_north(rows)}
    north = norths_of(stated, table.source, lambda: [readings], calibration, reference)
    north = north.by_row(rows)
    claims = {
        name: claim(table.source, readings, name)
        for name in judged_constants(calibration, readings)
    }
    sources, findings = of_reference(claims, north, reference, table.source)
    if reference is not None:
        findings += of_another_day(reference, readings.metadata)
    referenced = readings if reference is None else with_reference(readings, reference)
    depth, factor = depth_column(named, length_unit or "m")
    if md is not None and counts_stations(np.round(md / factor, 6)):
        findings.append(Finding(id="depths-count", text=DEPTHS_COUNT))
    return SurveyReadings(referenced, md, north, sources, findings, depth)


def station_readings(
    table: Table, calibration: Calibration, recognised: bool = True, length_unit: str = ""
) -> tuple[Readings, Array | None]:
    """The readings of a table of surveys, and its measured depths (n,) if it has them."""
    table = renamed(table, calibration.profile)
    check_columns(list(table.columns), table.source)
    if calibration.thermal:
        synonyms.check_evidence(list(table.columns), table.source, ("temperature_c",))
    in_a_well = replace_struct(calibration.profile, stand=StandProfile())
    readings = away_from_stand(to_readings(table, in_a_well, recognised)[0], in_a_well)
    columns = by_row(table).items()
    alone = {RANDOM_COLUMNS[name]: values for name, values in columns if name in RANDOM_COLUMNS}
    if alone:
        factors = {RANDOM + name: REFERENCES[name].factor for name in CONSTANTS}
        alone = {name: np.nan_to_num(values) * factors[name] for name, values in alone.items()}
        readings = replace(readings, sd={**readings.sd, **alone})
    return readings, depths(table, length_unit)


def by_row(table: Table) -> dict[str, Array]:
    """Columns (n,) of references that a survey alone has, in the units of files: declination, and 1σ new at each row.

    Raises:
        InputError: a cell that cannot be, or a declination that is blank where nothing else states one.
    """
    check_near_misses([*table.columns], [*BY_ROW], f"{table.source}: column")
    result = {}
    for name, limits in BY_ROW.items():
        if name not in table.columns:
            continue
        cells = table.columns[name]
        values = numbers(table, name) if isinstance(cells, list) else np.asarray(cells, float)
        wrong = np.flatnonzero(limits.outside(values))
        if wrong.size:
            problem = f"must be {limits}; got {values[wrong[0]]:g}."
            raise cell_error(table, name, int(wrong[0]), problem)
        result[name] = values
    column = next((name for name in DECLINATION_COLUMNS if name in result), "")
    if not column:
        return result
    declination = result.pop(column)
    otherwise = stated_norths(table.metadata, table.source).get("declination_deg", np.nan)
    declination = np.where(np.isnan(declination), otherwise, declination)
    result[DECLINATIONS[0]] = declination
    blank = np.flatnonzero(np.isnan(declination))
    if 0 < blank.size < declination.size:
        problem = "is blank, and no declination_deg in the metadata stands for it. Fill the cell, or state one."
        raise cell_error(table, column, int(blank[0]), problem)
    return result if not blank.size else {k: v for k, v in result.items() if k != DECLINATIONS[0]}


def typical_north(rows: Mapping[str, Array]) -> dict[str, float]:
    """The declination of a table that varies by row, and its 1σ, as metadata state one for all: their means."""
    if DECLINATIONS[0] not in rows:
        return {}
    typical = {"declination_deg": means(rows[DECLINATIONS[0]]).item()}
    sd = rows.get(DECLINATIONS[1], np.full(1, np.nan))
    return typical if np.isnan(sd).all() else {**typical, SD_KEY: float(np.nanmean(sd))}


def judged_constants(calibration: Calibration, readings: Readings) -> tuple[str, ...]:
    """Those of gravity, field and dip that surveys are judged by."""
    whole = calibration.has_field and readings.magnetometer is not None
    return CONSTANTS if whole else CONSTANTS[:1]


def claim(source: str, readings: Readings, name: str) -> Claim:
    """The claim of a table about gravity, field or dip."""
    factor = REFERENCES[name].factor
    return Claim(source, _stated(readings, name) / factor, readings.uncertainty(name) / factor)


def of_reference(
    claims: Mapping[str, Claim], north: North, reference: EarthReference | None, source: str
) -> tuple[dict[str, str], list[Finding]]:
    """Where references come from, by name, and where the reference contradicts the claims of a table or is not used."""
    sources, findings = {}, []
    for name, stated in claims.items():
        otherwise = NO_SOURCE if reference is None else FROM_REFERENCE
        sources[name] = source_of(~np.isnan(np.asarray(stated.values)), otherwise)
        if reference is not None:
            findings += _contradictions(stated, reference, name)
    if len(claims) == len(CONSTANTS):
        sources |= north.sources
    if reference is not None and not any(FROM_REFERENCE in each for each in sources.values()):
        text = f"nothing of `reference` is used: {source} states all of it itself. Leave one of the two out."
        findings.append(Finding(id="reference-unused", text=text))
    return sources, findings


def of_another_day(reference: EarthReference, metadata: Mapping[str, object]) -> list[Finding]:
    """The finding that the field of a reference is not of the day of the surveys, by more than a year.

    In a year the declination of WMM2025 moves by 0.07° in the median, and at most by 0.76 of its 1σ between 60° south
    and 70° north.
    """
    day = stated_day(metadata)
    if day is None or abs((day - reference.date).days) <= JULIAN_YEAR:
        return []
    text = (
        f"the reference is of {reference.date}, and the surveys are of {day}: field, dip and declination have moved "
        f"since. Make one for {day}."
    )
    return [Finding(id="reference-of-another-day", text=text)]


def _stated(readings: Readings, name: str) -> Array:
    """Gravity, field or dip (n,) as the table states it, NaN where it does not."""
    return np.broadcast_to(readings.known.get(name, np.nan), readings.count)


def _of_place(reference: EarthReference, name: str) -> tuple[float, float, float]:
    """A strength or dip of the place, its 1σ that all stations share, and that of each its own, as in `Readings`."""
    key, factor = MEASURABLE[name], REFERENCES[name].factor
    value, shared, alone = (getattr(reference, f"{p}{key}", 0.0) for p in ("", "sd_", "sd_random_"))
    return value * factor, shared * factor, alone * factor


def _contradictions(stated: Claim, reference: EarthReference, name: str) -> list[Finding]:
    """Where a table and the reference contradict each other."""
    factor, (value, shared, alone) = REFERENCES[name].factor, _of_place(reference, name)
    place = Claim("the reference", [value / factor], np.hypot(shared, alone) / factor)
    return contradictions(name, stated, place, "Check unit, place and date.")


def with_reference(readings: Readings, reference: EarthReference) -> Readings:
    """The readings with gravity, field and dip of the place where the table states none.

    Their uncertainty that all stations share stands under the name, and what is new at each under `RANDOM`.
    """
    known, sd = dict(readings.known), dict(readings.sd)
    for name in CONSTANTS:
        value, shared, alone = _of_place(reference, name)
        stated = _stated(readings, name)
        blank = np.isnan(stated)
        known[name] = np.where(blank, value, stated)
        sd[name] = np.where(blank, shared, readings.uncertainty(name))
        sd[RANDOM + name] = np.where(blank, alone, readings.uncertainty(RANDOM + name))
    return replace(readings, known=known, sd=sd)


def depths(table: Table, length_unit: str = "") -> Array | None:
    """Measured depths (n,), m, which increase; None where the table has none.

    `length_unit` is that of a column without one; blank: such a column is refused.
    """
    name, factor = depth_column(table, length_unit)
    if not name:
        return None
    column = table.columns[name]
    md = factor * (numbers(table, name) if isinstance(column, list) else column)
    wrong = np.flatnonzero((md < 0) | (md > LARGEST_DEPTH))
    if wrong.size:
        problem = f"must be between 0 and {LARGEST_DEPTH:g} m; got {md[wrong[0]]:g}."
        raise cell_error(table, name, int(wrong[0]), problem)
    there = np.flatnonzero(~np.isnan(md))
    back = there[1:][np.diff(md[there]) < 0]
    if back.size:
        known, row = md[there], int(back[0])
        anew = back.size == 1 and _start_over(known[there < row], known[there >= row])
        raise not_deeper(table, row, md[row], length_unit, TWO_PARTS if anew else UNSORTED)
    return md if there.size else None


def _start_over(first: Array, second: Array) -> bool:
    """Whether depths start over: in the upper half of the first part, with two stations of the second in it."""
    return bool(second[0] <= np.median(first) and second[:2].max() <= first[-1] and second[1:].size)


UNSORTED = "Sort the stations by measured depth."
TWO_PARTS = (
    "The depths start over there: is the table in it twice? Delete the copy. If it is the next run of the well, put "
    "its rows into another table, and name that by `run`."
)
"""Remedies for decreasing depths: in general, and where a second table seems to begin."""


def not_deeper(
    table: Table, row: int, depth: float, length_unit: str = "", remedy: str = UNSORTED
) -> InputError:
    """A measured depth, m, that is not beyond that of the station before."""
    name, factor = depth_column(table, length_unit)
    problem = f"must not decrease from station to station; got {depth / factor:g}. {remedy}"
    return cell_error(table, name, row, problem)


def depth_column(table: Table, length_unit: str = "") -> tuple[str, float]:
    """The column of measured depths, and metres per its unit, or blank.

    Raises:
        InputError: several columns of other names may be it, or its unit is neither in the table nor chosen.
    """
    names = [name for name in MEASURED_DEPTHS if name in table.columns][:1]
    names = names or [*filter(is_depth, table.columns)]
    if not names:
        lengths = [name for name in table.columns if is_length(name, table.units.get(name, ""))]
        names = lengths if len(lengths) == 1 and _may_be_depths(table, lengths[0]) else []
    if not names:
        return "", 1.0
    which = f'as in `column` "md_m={names[0]}" (in feet md_ft or md_usft)'
    if len(names) > 1:
        raise InputError(
            f"{table.source}: each of {', '.join(map(shown, names))} may be the measured depth of the surveys. Name "
            f"the right one, {which}."
        )
    name = names[0]
    stated = MEASURED_DEPTHS.get(name) or unit_of_length(name, table.units.get(name, ""))
    if not stated and not length_unit:
        raise InputError(
            f"{table.source}: column {shown(name)} does not state the unit of measured depths. State it, {which}, "
            f"rename it '{name} (m)' or '{name} (ft)', or give `length_unit`."
        )
    unit = stated if name in MEASURED_DEPTHS else chosen_length(stated, length_unit)
    return name, LENGTH_UNITS[unit]


def check_path(lacking: str, **options: object) -> None:
    """Refuse options that need a well path, if there is none; `lacking` says why, and is blank if there is one.

    Raises:
        InputError: an option needs a well path, and there is none.
    """
    names = [name for name, value in options.items() if value]
    if lacking and names:
        why = lacking.removeprefix("no well path: ")
        raise InputError(f"`{names[0]}` needs a well path, which these surveys do not have: {why}")


def _may_be_depths(table: Table, name: str) -> bool:
    """Whether most cells of a column have numbers, which never decrease, change, and do not count the stations."""
    cells = table.columns[name]
    if isinstance(cells, list):
        cells = [c if looks_numeric(c.strip(), table.decimal) else "" for c in cells]
    try:
        values = numbers(replace(table, columns={name: cells}), name)
    except InputError:
        return False
    there = ~np.isnan(values)
    if 2 * np.count_nonzero(there) <= there.size:
        return False
    values = values[there]
    steps = np.diff(values)
    return bool((steps >= 0).all() and steps.any()) and not counts_stations(values)


def _with_depths_of(
    findings: Iterable[Finding], table: Table, unused: Collection[str]
) -> list[Finding]:
    """The findings; those that lack a measured depth name the `unused` columns that may be it.

    Of these a column with a unit of length comes alone; other lengths than a measured depth are not named.
    """
    names = [n for n in table.columns if shown(n) in unused]
    names = [n for n in names if not is_other_length(n, table.units.get(n, ""))]
    rising = [n for n in names if _may_be_depths(table, n)]
    rising = [n for n in rising if unit_of_length(n, table.units.get(n, ""))] or rising
    listed = f" It may be {' or '.join(map(shown, rising))}." if rising[1:] else ""
    return [
        replace_struct(f, text=f.text.replace("NAME", rising[0]) + listed)
        if rising and "md_m=NAME" in f.text
        else f
        for f in findings
    ]


def with_stated_unit(findings: Iterable[Finding], depth: str) -> list[Finding]:
    """The findings without the question for feet, where the title of the `depth` or `length_unit` answers it."""
    return [finding for finding in findings if depth == "md_m" or finding.id != "long-courses"]


def length_unit_of(given: str) -> tuple[str, str]:
    """The unit of lengths without one, blank where none was chosen, and that of results.

    Raises:
        InputError: no unit of length.
    """
    chosen = given or setting("length_unit")
    if chosen and chosen not in LENGTH_UNITS:
        raise InputError(f"`length_unit` must be one of {', '.join(LENGTH_UNITS)}; got {chosen!r}.")
    return chosen, chosen or "m"


def surveyed_table(
    table: Table,
    well: Well,
    rows: Bools | None = None,
    covariance: bool = False,
    tie_ins: Mapping[int, TieIn] | None = None,
    more: Mapping[str, AnyArray] | None = None,
) -> Table:
    """The table with the results beside its columns; `rows` (n,) are those of the well, by default all.

    With the `covariance` of the positions if asked for, and `more` columns. `tie_ins` have what they state at
    their rows.

    Raises:
        InputError: a column has the name of a result already.
    """
    results = {**well.columns, **(more or {})}
    if covariance and well.position is not None:
        results = results | covariance_columns(well.position.covariance, well.length_unit)
    if rows is not None:
        results = {name: spread(values, rows) for name, values in results.items()}
        for row, start in (tie_ins or {}).items():
            for name, value in _of_tie_in(start, well).items():
                if name in results:
                    results[name][row] = value
    check_free(table, results)
    texts: dict[str, str] = {}  # few words stand in many rows: each is in memory once
    columns = {
        name: values
        if values.dtype.kind == "f"
        else [texts.setdefault(cell, cell) for cell in map(str, values)]
        for name, values in results.items()
    }
    metadata = {**table.metadata, **described(well)}
    return replace(table, columns={**table.columns, **columns}, metadata=metadata)


def covariance_columns(covariance: Array, unit: str) -> dict[str, AnyArray]:
    """The six elements (n,) of covariances (n, 3, 3) of positions: north, east and vertical, in a unit of length."""
    axes, metres = "nev", LENGTH_UNITS[unit]
    return {
        f"covariance_{axes[i]}{axes[j]}_{unit}2": covariance[:, i, j] / metres**2
        for i in range(3)
        for j in range(i, 3)
    }


def _of_tie_in(start: TieIn, well: Well) -> dict[str, float]:
    """Columns of results at a tie-in station, in the units of files."""
    unit, metres = well.length_unit, LENGTH_UNITS[well.length_unit]
    covariance = np.zeros((3, 3)) if start.covariance is None else start.covariance
    place = start.place / metres
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)) / metres
    values = {
        "inclination_deg": float(np.degrees(start.inclination)),
        f"azimuth_{well.north.name}_deg": float(np.degrees(start.azimuth)),
        f"vertical_section_{unit}": float(
            place[0] * np.cos(well.north.section) + place[1] * np.sin(well.north.section)
        ),
    }
    for k, name in enumerate(AXES_OF_EARTH):
        values |= {f"{name}_{unit}": float(place[k]), f"sd_{name}_{unit}": float(sd[k])}
    whole = covariance_columns(covariance[None], unit)
    return values | {name: float(value[0]) for name, value in whole.items()}


def check_free(table: Table, results: Collection[str]) -> None:
    """Refuse a table that has a column of the name of a result."""
    taken = [name for name in results if name in table.columns]
    if taken and "calibration_run" in table.metadata:
        raise InputError(
            f"{table.source}: this is a result of `survey` already: it has the column '{taken[0]}'. Give the table of "
            "readings that it was made of."
        )
    if taken:
        raise InputError(
            f"{table.source}: the column '{taken[0]}' is there already, and would be lost under the result of that "
            "name. Rename it."
        )


def described(well: Well) -> Mapping[str, object]:
    """The statements of a table of surveys about the calibration, north and limits it rests on."""
    calibration, north = well.calibration, well.north.typical
    stated: dict[str, object] = {
        "calibration_run": calibration.run,
        "calibration_time": calibration.time,
        "survey_limits": well.limits.name,
        "north": north.name,
        "error_model": "none" if well.errors is None else well.errors.model.name,
        **({} if well.length_unit == "m" else {"length_unit": well.length_unit}),
        **well.terms.stated,
    }
    stated |= {key: angle for key, angle in north.in_degrees.items() if angle is not None}
    if north.scale is not None:
        stated["grid_scale"] = north.scale
    if well.sources:
        stated["reference_sources"] = dict(well.sources)
    if is_simulated(calibration.tool) or is_simulated(well.readings.metadata):
        stated["simulated"] = True
    if well.findings:
        stated["findings"] = [finding.text for finding in well.findings]
    return stated


@dataclass(frozen=True)
class WellInputs:
    """The inputs of the surveys of a well.

    `length_unit` is that of results. `model`: the error model whose terms are in the standard uncertainties; None:
    none. `rows` (n,) of the table that have readings; None: all.
    `tie_ins` by the row of the table that states them. `unused` (n,): surveys that are rejected or superseded by their
    status. `walk`: random walk of the sensors in a year, 1σ, as of `well_errors`. `findings` are of the calibration's
    signature and of the reference; `digests` the SHA-256 of each input by name, empty for one that is in memory.
    """

    calibration: Calibration
    table: Table
    surveys: SurveyReadings
    limits: SurveyLimits
    findings: list[Finding]
    digests: Mapping[str, str]
    model: ErrorModel | None = None
    rows: Bools | None = None
    length_unit: str = "m"
    tie_ins: Mapping[int, TieIn] = field(default_factory=dict)
    unused: Bools | None = None
    walk: SensorTerms | None = None

    @property
    def stated(self) -> tuple[Mapping[str, object], Mapping[str, object]]:
        """The statements of calibration and readings about themselves."""
        return self.calibration.tool, self.surveys.readings.metadata

    @property
    def named(self) -> dict[str, str]:
        """Digests of the inputs that are files."""
        return {name: digest for name, digest in self.digests.items() if digest}


@dataclass(frozen=True)
class SurveyedWell:
    """The surveys of a well with what they rest on; `analysis` is None without multi-station analysis.

    Of a long table that was surveyed in parts `well` has the first stations only, `last` the last ones, and `counts` is
    of all. `runs` are those of a well in several, whose surveys `well` has together. `axial`: each survey corrected by
    itself; None: not.
    """

    inputs: WellInputs
    well: Well
    counts: WellCounts
    analysis: Interference | None = None
    runs: tuple[SurveyedWell, ...] = ()
    axial: AxialCorrection | None = None
    last: Well | None = None

    @cached_property
    def contributions(self) -> Contributions | None:
        """Contributions to the uncertainty of each survey; None for long tables and without measured azimuths."""
        if self.counts.rows > MOST_CONTRIBUTED or self.counts.rows != self.well.readings.count:
            return None
        return contributions([run.well for run in self.runs] or [self.well])

    @property
    def table(self) -> Table:
        """The table of the readings with the results beside its columns."""
        return self.table_with()

    def table_with(self, covariance: bool = False) -> Table:
        """The same, with the covariance of the positions too; a tie-in station has what it states."""
        more = self.axial.columns(self.well.north.name) if self.axial else {}
        return surveyed_table(
            self.inputs.table, self.well, self.inputs.rows, covariance, self.inputs.tie_ins, more
        )


def well_inputs(
    calibration: Calibration,
    table: Table,
    reference: EarthReference | str | os.PathLike[str] | None = None,
    limits: SurveyLimits | str | os.PathLike[str] = "owsg-mwd",
    recognised: bool = False,
    digest: str = "",
    findings: Sequence[Finding] = (),
    error_model: ErrorModel | str | os.PathLike[str] = BUILT_IN,
    missing: str = "refuse",
    section_azimuth: float = 0.0,
    length_unit: str = "",
) -> WellInputs:
    """The inputs of surveys: a table of readings, the calibration of their tool, reference and limits.

    `reference`, `limits` and `error_model` are values, or files by path; `NO_MODEL` for none. Stations that
    multi-station analysis puts into the record have to be `recognised`. `digest` and `findings` are of the file of the
    calibration. `length_unit` (m, ft, usft) is that of results, and of depths that state none. `section_azimuth` of the
    vertical section, degrees from the north of the path.

    Raises:
        InputError: a file that cannot be read, readings that do not belong to the calibration.
    """
    bounds, limits_digest = loaded_limits(limits)
    place, place_digest = loaded_reference(reference)
    unit, shown_unit = length_unit_of(length_unit)
    said, rows = _said_of(table, calibration, missing == "blank", unit)
    read = survey_readings(chosen(said.table, rows), calibration, place, recognised, unit)
    unused = said.unused[rows]
    if unused.any() and read.md is not None:
        read = replace(read, md=np.where(unused, np.nan, read.md))
    read = replace(read, findings=[*said.findings, *read.findings])
    read = _with_blank_rows(read, rows)
    digests = {"calibration": digest, "readings": table.digest}
    digests |= {"reference": place_digest} if read.uses_reference else {}
    model = error_model_of(error_model)
    digests |= {"error_model": model.digest} if model else {}
    read = replace(read, north=with_section(read.north, section_azimuth))
    _check_north(said, read.north)
    return WellInputs(
        calibration,
        said.table,
        read,
        bounds,
        [*findings, *read.findings],
        {**digests, "limits": limits_digest},
        model,
        None if rows.all() else rows,
        shown_unit,
        {said.tie_row: said.tie_in} if said.tie_in and said.tie_row is not None else {},
        unused if unused.any() else None,
    )


def _with_blank_rows(read: SurveyReadings, rows: Bools) -> SurveyReadings:
    """Surveys of some `rows` of a table, named by these where they have no label."""
    if rows.all():
        return read
    numbered = np.flatnonzero(rows) + 1
    names = tuple(label or str(i) for label, i in zip(read.readings.station, numbered, strict=True))
    text = f"{np.sum(~rows)} of {rows.size} rows lack a reading: their results are blank."
    about = [Finding(id="missing-reading", text=text), *read.findings]
    return replace(read, readings=replace(read.readings, station=names), findings=about)


def _check_north(said: TrajectoryFacts, north: North) -> None:
    """Refuse a tie-in station whose azimuth counts from another north than the path."""
    counted = north_of_tie_in(said.table)
    if said.tie_in and counted not in ("", north.name):
        raise InputError(
            f"{said.table.source}: the tie-in station counts its azimuth from {counted} north, and the path goes from "
            f"{north.name} north. State declination_deg and convergence_deg, give `reference`, or give `tie_in`."
        )


def _said_of(
    table: Table, calibration: Calibration, blank: bool, unit: str
) -> tuple[TrajectoryFacts, Bools]:
    """The statements of a table about its norths, tie-in and statuses, and its rows (n,) that are surveys.

    Rows without readings are allowed where they may be `blank`, nor is a tie-in station.
    """
    none = np.zeros(table.count, bool)
    if not (blank or has_stations(table)):
        return trajectory(table, None, none), ~none
    known = renamed(table, calibration.profile)
    without = without_reading(known, wholly_blank([known]))
    said = trajectory(table, depths(known, unit), without)
    rows = ~without if blank else ~none
    if said.tie_row is not None:
        rows[said.tie_row] = False
    if not rows.any():
        raise nothing(table.source)
    return said, rows


def with_section(north: North, azimuth: float) -> North:
    """A north with the azimuth, degrees, of the vertical section.

    Raises:
        InputError: no azimuth.
    """
    if not -360 <= azimuth <= 360:
        raise InputError(f"`section_azimuth` must be an azimuth in degrees; got {azimuth:g}.")
    return replace(north, section=float(np.radians(azimuth)))


def error_model_of(model: ErrorModel | str | os.PathLike[str]) -> ErrorModel | None:
    """An error model by itself, its name or its file; None for `NO_MODEL`."""
    if isinstance(model, ErrorModel):
        return model
    return None if os.fspath(model) == NO_MODEL else load_error_model(model)


def loaded_limits(limits: SurveyLimits | str | os.PathLike[str]) -> tuple[SurveyLimits, str]:
    """Limits, and the SHA-256 of their file, empty for those in memory."""
    return (limits, "") if isinstance(limits, SurveyLimits) else load_survey_limits(limits)


def loaded_reference(
    reference: EarthReference | str | os.PathLike[str] | None,
) -> tuple[EarthReference | None, str]:
    """A reference, and the SHA-256 of its file, empty for one in memory."""
    if reference is None or isinstance(reference, EarthReference):
        return reference, ""
    return load_reference(reference)


def start_of(numbers: Sequence[float], unit: str = "m") -> tuple[float, float, float] | TieIn:
    """Where a path starts: north, east and TVD of the first station, or behind measured depth and two angles, degrees.

    Lengths are in a `unit` of length.

    Raises:
        InputError: neither three nor six numbers, or an inclination or depth that no hole has.
    """
    if len(numbers) not in (3, 6):
        raise InputError(
            "`tie_in` must be north, east and TVD, or measured depth, inclination, azimuth, north, east and TVD; got "
            f"{len(numbers)} numbers."
        )
    metres = LENGTH_UNITS[unit]
    north, east, tvd = (metres * float(number) for number in numbers[-3:])
    if len(numbers) == 3:
        return north, east, tvd
    md, inclination, azimuth = map(float, numbers[:3])
    if not (0 <= md * metres <= LARGEST_DEPTH and 0 <= inclination <= 180):
        raise InputError(
            f"`tie_in` must have a depth of 0 to {LARGEST_DEPTH / metres:g} {unit} and an inclination of 0 to 180°; "
            f"got {md:g} and {inclination:g}."
        )
    place = np.array([north, east, tvd])
    return TieIn(md * metres, float(np.radians(inclination)), float(np.radians(azimuth)), place)


def check_drift(drift: object, msa: bool) -> None:
    """Refuse a drift of the sensors without the multi-station analysis that allows for it."""
    if drift and not msa:
        raise InputError("`sensor_drift` goes with `msa`. Leave it out, or add `msa`.")


def analysed(inputs: WellInputs, drift: str | os.PathLike[str] | None = None) -> Interference:
    """The multi-station analysis of surveys; whether it may be used says its `check`.

    `drift` as of `interference_estimate.sensor_drift`, by default that of the OWSG model.
    """
    assumed = Assumed(drift=sensor_drift(drift or "owsg"))
    surveys = inputs.surveys
    readings, md = surveys.readings, surveys.md
    if inputs.unused is not None:
        readings = readings.select(~inputs.unused)
        md = None if md is None else md[~inputs.unused]
    return interference(inputs.calibration, readings, assumed, md)


LARGEST_GAP = 0.1
"""Distance, m, by which the tie-in station of a run may differ from the end of the run before."""


def tie_in_differs(stated: TieIn, end: object) -> list[Finding]:
    """The finding that the tie-in station of a run is not where the run before ended."""
    if not isinstance(end, PathEnd):
        return []
    off = float(np.linalg.norm(stated.place - end.sums.position))
    deeper = stated.md - float(end.md[-1])
    if off <= LARGEST_GAP and abs(deeper) <= LARGEST_GAP:
        return []
    text = (
        f"the tie-in station lies {off:.2f} m from the end of the run before, {deeper:+.2f} m along the hole: the path "
        "goes on from that end."
    )
    return [Finding(id="tie-in-differs", text=text)]


def survey_well(
    inputs: WellInputs,
    analysis: Interference | None = None,
    *,
    tie_in: tuple[float, float, float] | TieIn | None = None,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
    follows: Before | None = None,
    axial: bool = False,
) -> SurveyedWell:
    """The surveys of a well, corrected for interference where there is an `analysis`; else as of `well`.

    `axial`: also correct each survey by itself for interference along the tool.
    """
    surveys = inputs.surveys
    stated = next(iter(inputs.tie_ins.values()), None)
    about = [] if follows is None or stated is None else tie_in_differs(stated, follows.path)
    tie_in = stated if tie_in is None and follows is None else tie_in
    fitted = analysis.calibration if analysis else inputs.calibration
    result = well(
        fitted, surveys.readings, inputs.limits, surveys.north, surveys.md, tie_in, switch, outside,
        model=inputs.model, follows=follows, walk=inputs.walk,
    )  # fmt: skip
    alone = axial_correction(result) if axial else None
    said = alone.findings(result.readings.labels, result.north.name) if alone else []
    used = surveys.readings if inputs.unused is None else surveys.readings.select(~inputs.unused)
    exchanged = exchanged_axes(inputs.calibration, used)
    others = with_stated_unit(result.findings, surveys.depth)
    findings = [*inputs.findings, *about, *exchanged, *others, *said]
    findings = _with_depths_of(findings, inputs.table, surveys.readings.unused)
    result = replace(
        result, findings=findings, sources=surveys.sources, length_unit=inputs.length_unit
    )
    return SurveyedWell(inputs, result, result.counts, analysis, axial=alone)
