"""Rows that are readings of one station: their means are the station.

Readings at one setting of the stand share its error. As stations of their own they would count it again and again, and
their residuals, alike from row to row, would look like a drift. Rows that follow each other are readings of one
station where label and stand are the same. In a table that is read through a tool profile rows without labels are too,
where most of them come in sets at equal angles; in a documented run file each of these is a station.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.readings import EQUAL, ONE_SETTING, SOAK_GAP
from mwdcal.estimation.problem import ANGLES
from mwdcal.files import synonyms
from mwdcal.files.contract import CHANNELS, MAPPED, RAW, REFERENCES, is_angle
from mwdcal.files.formats.columns import LABELS, Column
from mwdcal.files.formats.table import Table, labels, numbers
from mwdcal.files.statements import rows_of
from mwdcal.geometry import circle
from mwdcal.geometry.vectors import Array, Bools, Ints, centred
from mwdcal.sensor.profile import ColumnSource

_ONE_READING = 0.03
"""Share of a triad's range by which readings of one station depart from their mean at most."""
_OF_ANOTHER_TOOL, _SURE = 0.002, 8.0
"""Share of a triad's range from which a departure may be that of another tool; and as a multiple of its scatter."""
_FEW_LABELS = 8
"""Rows to each label, of labels that change from row to row, from which these are of readings or tools."""
_MOSTLY = 0.75
"""Share of rows in sets at equal angles from which these are stations of several readings."""
_OF_READING = re.compile(r"(.*\d)(?:[ ._/-]?[A-Za-z]|[ ._/-]\d{1,2})")
"""The label of a reading at a station: 1a, 1b, 2.1, 2.2."""
_MILLI = {"accelerometer": (1e3, "mg"), "magnetometer": (1.0, "nT")}


@dataclass(frozen=True)
class Repeats:
    """Rows of a table that are readings of stations: `starts` (m,) is the first row of each, of `rows`.

    `labelled`: by their label; otherwise only by the angles of the stand. `numbered`: each row has a label of its own.
    `scatter`: standard deviation of one reading about its station, raw, by triad.
    """

    starts: Ints
    rows: int
    labelled: bool
    numbered: bool
    scatter: Mapping[str, float]

    @property
    def sizes(self) -> Ints:
        """Readings (m,) of each station."""
        return np.diff(self.starts, append=self.rows)

    def counted(self) -> str:
        """How many stations have how many readings.

        >>> Repeats(np.array([0, 5]), 10, True, False, {}).counted()
        '2 stations of 5 readings each'
        """
        least, most = int(self.sizes.min()), int(self.sizes.max())
        each = f"{most} readings each" if least == most else f"{least} to {most} readings"
        return f"{len(self.starts)} stations of {each}"

    def sentence(self, scales: Mapping[str, float | None]) -> str:
        """The stations and the scatter of their readings; `scales` are raw units per g and nT, where known."""
        sizes = [
            f"{float(f'{sd / scale * _MILLI[kind][0]:.2g}'):g} {_MILLI[kind][1]}"
            for kind, sd in self.scatter.items()
            if (scale := scales.get(kind)) and np.isfinite(sd)
        ]
        scatter = f"; scatter of a reading {', '.join(sizes)}" if sizes else ""
        by_angles = (
            ""
            if self.labelled
            else " Equal angles of the stand alone say so: if it was set anew for each row, number the rows in a "
            "column `station`."
        )
        return f"{self.counted()}: their means are taken{scatter}.{by_angles}"

    def advice(self) -> str:
        """The advice where the rows stay stations."""
        return (
            f"every row counts as a station, and the stand angles are those of {self.counted()}. Readings of one "
            "setting share its error and look like a drift. If they are such, average them: give the readings of a "
            "station one label in the column `station`."
        )


@np.errstate(over="ignore", invalid="ignore")  # of numbers that are refused later
def repeats(table: Table, sources: Mapping[str, ColumnSource]) -> Repeats | None:
    """The rows that are readings of one station; None where every row is a station of its own.

    `sources`: columns of the run file that the table has under other names.
    """
    names = {c: sources[c].name if c in sources else c for c in (*LABELS, *_NUMBERS)}
    names = {c: name for c, name in names.items() if name in table.columns}
    if table.count < 2 or not {*CHANNELS["accelerometer"]} <= {*names}:
        return None
    station = np.array(labels(table, names.get("station", "station")) or [""] * table.count)
    angles = {
        n: numbers(table, names[c]) * _factor(sources, c)
        for n in ANGLES
        if (c := REFERENCES[n].column) in names
    }
    same = np.ones(table.count - 1, bool)
    station = _without_readings(station, angles)
    if _FEW_LABELS * len({*station.tolist()}) <= table.count and not _equal(station).any():
        station = np.full(table.count, "")  # labels in turn number no stations
    alike = _equal(station) & (station[1:] != "")
    for name in ("group", "serial"):
        if name in names:
            equal = _equal(np.array(labels(table, names[name])))
            of_readings = name == "group" and alike.any() and not (alike & equal).any()
            same &= equal | of_readings  # A and B are the readings of each station
    labelled = bool(alike.any())
    numbered = len({*station.tolist()}) == table.count
    if labelled:
        same = _at_one_setting(angles, same & alike)
    elif {"inclination", "toolface"} <= {*angles} and (numbered or not station.any()):
        same &= np.all([_equal(each) for each in angles.values()], 0)
    else:
        return None
    if not same.any():
        return None
    # Without toolfaces labels may be of directions, about which a tool is rolled.
    partly = labelled and "toolface" in angles
    starts = _without_differing(table, names, sources, _starts(same), partly)
    sizes = np.diff(starts, append=table.count)
    if sizes.max() < 2 or (not labelled and not _are_most(sizes)):
        return None
    return Repeats(starts, table.count, labelled, numbered, _scatters(table, names, starts))


_NUMBERS = (*RAW, synonyms.WARMTH, *(REFERENCES[name].column for name in ANGLES))


def station_by_angles(table: Table, columns: Mapping[str, ColumnSource]) -> str:
    """The column, not used yet, of labels that change exactly where the angles of the stand do; empty without one.

    Most rows come in sets of several at equal angles, each of which has a label of its own.
    """
    angles = [columns[c].name for n in ANGLES if (c := REFERENCES[n].column) in columns]
    if len(angles) < len(ANGLES) - 1 or table.count < 2:
        return ""
    same = np.all([_equal(numbers(table, name)) for name in angles], 0)
    starts, used = _starts(same), {each.name for each in columns.values()}
    if not _are_most(np.diff(starts, append=table.count)):
        return ""
    for name in (each for each in table.columns if each not in used):
        cells = np.array(labels(table, name))
        firsts = {*cells[starts].tolist()}
        if np.array_equal(_equal(cells), same) and len(firsts) == len(starts) and "" not in firsts:
            return name
    return ""


def _without_readings(station: np.ndarray, angles: Mapping[str, Array]) -> np.ndarray:
    """Labels (n,) without the letter or number of a reading behind, where the rest changes as the angles do."""
    parts = [_OF_READING.fullmatch(label) for label in station.tolist()]
    rest = np.array([part[1] for part in parts if part])
    if len(rest) < len(station) or len({*station.tolist()}) < len(station) or not angles:
        return station
    same = np.all([_equal(each) for each in angles.values()], 0)
    return rest if np.array_equal(_equal(rest), same) else station


def _are_most(sizes: Ints) -> bool:
    """Whether most rows are in sets of several, and there are several sets (m,)."""
    return len(sizes) > 1 and float(sizes[sizes > 1].sum()) >= _MOSTLY * float(sizes.sum())


def _factor(sources: Mapping[str, ColumnSource], column: str) -> float:
    """The factor from the unit of a column to that of the run file."""
    unit = sources[column].unit if column in sources else ""
    return abs(synonyms.FACTORS.get(unit, (1.0, 0.0))[0])


def _equal(values: np.ndarray) -> Bools:
    """Whether each value (n,) but the first is equal to the one before."""
    return np.asarray(values[1:] == values[:-1])


def _at_one_setting(angles: Mapping[str, Array], same: Bools) -> Bools:
    """Whether (n - 1,) rows that go with the one before are at its setting; a blank angle is that of the others.

    All angles of a setting lie within `ONE_SETTING` of their middle; where rows go further, each is a setting.
    """
    most, around = np.degrees(2 * ONE_SETTING + EQUAL), circle.WHOLE_TURN
    for each in angles.values():
        same = same & ~(np.abs(centred(np.diff(each), around)) > most)
    starts = _starts(same)
    sizes = np.diff(starts, append=len(same) + 1)
    for each in angles.values():
        away = centred(each - np.repeat(each[starts], sizes), around)
        span = np.fmax.reduceat(away, starts) - np.fmin.reduceat(away, starts)
        same = same & ~np.repeat(span > most, sizes)[1:]
    return same


def _starts(same: Bools) -> Ints:
    """First rows of the sets that follow each other; `same` (n - 1,): a row goes with the one before."""
    return np.flatnonzero(np.r_[True, ~same])


def _without_differing(
    table: Table,
    names: Mapping[str, str],
    sources: Mapping[str, ColumnSource],
    starts: Ints,
    partly: bool,
) -> Ints:
    """The sets without those whose readings or temperatures differ by too much: their rows are stations each.

    Unless `partly`, one such set splits all.
    """
    sizes = np.diff(starts, append=table.count)
    differ = np.zeros(len(starts), bool)
    for raw in _triads(table, names).values():
        radius = np.linalg.norm(raw - (raw.max(0) + raw.min(0)) / 2, axis=-1).max()
        apart = np.linalg.norm(_departures(raw, starts), axis=-1)
        differ |= np.maximum.reduceat(apart, starts) > _ONE_READING * radius
    if synonyms.WARMTH in names:
        warmth = numbers(table, names[synonyms.WARMTH]) * _factor(sources, synonyms.WARMTH)
        span = np.maximum.reduceat(warmth, starts) - np.minimum.reduceat(warmth, starts)
        differ |= span > SOAK_GAP
    if differ.any() and not partly:
        return np.arange(table.count)
    goes_on = ~np.isin(np.arange(table.count), starts) & ~np.repeat(differ, sizes)
    return _starts(goes_on[1:])


def _triads(table: Table, names: Mapping[str, str]) -> dict[str, Array]:
    """Raw readings (n, 3) by triad."""
    return {
        kind: np.stack([numbers(table, names[c]) for c in channels], -1)
        for kind, channels in CHANNELS.items()
        if {*channels} <= {*names}
    }


def _means(values: Array, starts: Ints) -> Array:
    """Means (m, ...) of sets of values (n, ...)."""
    sizes = np.diff(starts, append=len(values))
    return np.asarray(
        np.add.reduceat(values, starts, 0) / sizes.reshape(-1, *[1] * (values[0].size > 1))
    )


def _departures(values: Array, starts: Ints) -> Array:
    """Values (n, ...) less the means of their sets."""
    sizes = np.diff(starts, append=len(values))
    return np.asarray(values - np.repeat(_means(values, starts), sizes, axis=0))


def _scatters(table: Table, names: Mapping[str, str], starts: Ints) -> dict[str, float]:
    """Standard deviation of one reading of a channel about the mean of its station, by triad."""
    freedom = 3 * (table.count - len(starts))
    return {
        kind: float(np.sqrt((_departures(raw, starts) ** 2).sum() / freedom))
        for kind, raw in _triads(table, names).items()
    }


def tools_in_turn(
    table: Table, sources: Mapping[str, ColumnSource], sets: Repeats
) -> tuple[str, list[str]] | None:
    """The unused column, and its texts, by which the readings at one setting differ as those of several tools do.

    Each text stands at most once in a set. The departures of its readings from the means of their sets are a line of
    these means, far beyond what is left, and a share of the range of the triad.
    """
    names = {c: sources[c].name for c in RAW if c in sources}
    used = {each.name for column, each in sources.items() if column not in LABELS}
    place = np.repeat(np.arange(len(sets.starts)), sets.sizes)
    for name in (each for each in table.columns if each not in used):
        texts, which = np.unique(labels(table, name), return_inverse=True)
        once = len({*zip(place.tolist(), which.tolist(), strict=True)}) == sets.rows
        if 1 < len(texts) <= sets.sizes.max() and once:
            for raw in _triads(table, names).values():
                apart = _departures(raw, sets.starts)
                each = (which == k for k in range(len(texts)))
                if any(_are_of_another(raw[rows], apart[rows]) for rows in each):
                    return name, texts.tolist()
    return None


def _are_of_another(raw: Array, apart: Array) -> bool:
    """Whether readings (n, 3) depart from those of their sets by `apart` (n, 3) as those of another tool do."""
    design = np.column_stack([raw - apart, np.ones(len(raw))])
    if len(raw) <= 2 * design.shape[-1]:
        return False
    line = design @ np.linalg.lstsq(design, apart, rcond=None)[0]
    size, left = np.sqrt(np.mean(line**2)), np.sqrt(np.mean((apart - line) ** 2))
    sure = _SURE * left * np.sqrt(design.shape[-1] / len(raw))
    return bool(size > max(sure, _OF_ANOTHER_TOOL * np.ptp(raw, axis=0).max() / 2))


def means(table: Table, sources: Mapping[str, ColumnSource], sets: Repeats) -> Table:
    """The table with one row for each station: means of its numbers, the first of its texts.

    The uncertainty of a raw mean is that of independent readings.
    """
    ours = {each.name: column for column, each in sources.items()}
    first = rows_of(table, sets.starts.tolist())
    columns: dict[str, Column] = dict(first.columns)
    for name, cells in table.columns.items():
        column = ours.get(name, name)
        if column in LABELS or (isinstance(cells, list) and column not in MAPPED):
            continue
        columns[name] = _mean_column(column, numbers(table, name), sources, sets)
    return replace(first, columns=columns)


def _mean_column(
    column: str, values: Array, sources: Mapping[str, ColumnSource], sets: Repeats
) -> Array:
    """The values (m,) of stations, of a column (n,) of their readings."""
    starts, sizes = sets.starts, sets.sizes
    if column.removeprefix("sd_") in RAW and column not in RAW:
        return np.asarray(np.sqrt(np.add.reduceat(values**2, starts)) / sizes)
    if column.startswith("sd_ref_"):
        return np.asarray(np.fmax.reduceat(values, starts))
    if column in RAW or not column.startswith("ref_"):
        return _means(values, starts)
    first = np.repeat(values[starts], sizes)
    filled = np.where(np.isnan(values), first, values)
    if is_angle(column):
        return circle.means(filled, circle.WHOLE_TURN / _factor(sources, column), starts)
    return np.asarray(values[starts] + _means(filled - first, starts))
