"""Cells that a run may not have, in rows of one tool or of many.

The rows of T tools stand one tool after the other: `starts` (T + 1,) are the first row of each,
and the number of rows. A run file is one tool. What must be filled in where other cells of a tool
are is judged tool by tool.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS, RANGES, RAW, REFERENCES
from mwdcal.files.formats.table import Table, cell_error, numbers, shown
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
from mwdcal.sensor.profile import Profile

Cells = Callable[[str], Array | None]
"""The numbers (R,) of a column by its name, NaN where blank; None where there is no such column."""


LEAVE_OUT = "leave such rows out by leave_out in [table] of the tool profile"
"""The remedy for rows without a reading in a table that stays as it is."""
OPTIONAL = {
    CHANNELS["magnetometer"]: f"Fill it in, or {LEAVE_OUT}.",
    ("temperature_c",): f"Fill it in, {LEAVE_OUT}, or leave the whole column blank.",
}
"""Columns that are blank on all rows or on none, and what to do where they are neither."""


class BlankReadingError(InputError):
    """A blank cell among readings or temperatures: `apply` may leave the results of its row blank."""


class Fault(NamedTuple):
    """Cells that break one rule: where `cells` (k, R) is true, of the `columns` (k).

    `must_be` is the rule, `advice` what to do. `missing_reading`: the rule is that readings and
    temperatures may not be blank.
    """

    columns: tuple[str, ...]
    cells: Bools
    must_be: str
    advice: str
    missing_reading: bool = False


def faults(cells: Cells, starts: Ints, profile: Profile) -> Iterator[Fault]:
    """The rules that are broken, in the order in which they are reported.

    A column is not read before its turn.
    """
    readings = [(names, f"Fill it in, or {LEAVE_OUT}.") for names in CHANNELS.values()]
    warmth = (("temperature_c",), f"Fill it in, {LEAVE_OUT}, or leave the whole column blank.")
    for names, advice in (*readings, warmth):
        for name in names:
            yield from range_faults(cells, name)
        blank = _blank_faults(cells, starts, names, advice, True)
        optional = names != CHANNELS["accelerometer"]
        yield from _where_filled(cells, starts, names, blank) if optional else blank
    yield from faults_beside_readings(cells, starts, profile, TRIADS)


def faults_beside_readings(
    cells: Cells, starts: Ints, profile: Profile, kinds: Iterable[str]
) -> Iterator[Fault]:
    """The same of references, and of uncertainties of these and of the triads `kinds`."""
    for reference in REFERENCES.values():
        yield from range_faults(cells, reference.column)
    for kind in kinds:
        noise = _noise_faults(cells, starts, profile, kind)
        yield from _where_filled(cells, starts, CHANNELS[kind], noise)
    for name, reference in REFERENCES.items():
        sd = range_faults(cells, f"sd_{reference.column}")
        optional = name != "gravity"
        yield from _where_filled(cells, starts, (reference.column,), sd) if optional else sd


def columns_of(table: Table) -> Cells:
    """The columns of numbers of a table, each read when it is asked for the first time."""
    return cache(lambda name: numbers(table, name) if name in table.columns else None)


def refuse(table: Table, rules: Iterable[Fault]) -> None:
    """Refuse the first cell that breaks a rule."""
    for fault in rules:
        row = int(np.argmax(fault.cells.any(0)))
        name = fault.columns[int(np.argmax(fault.cells[:, row]))]
        problem = f"must be {fault.must_be}; got {_content(table, name, row)}. {fault.advice}"
        error = cell_error(table, name, row, problem)
        raise BlankReadingError(str(error)) if fault.missing_reading else error


def _content(table: Table, name: str, row: int) -> str:
    """The content of a cell, for messages."""
    if name not in table.columns:
        return "no such column"
    value = float(numbers(table, name)[row])
    return "a blank cell" if np.isnan(value) else f"{shown(value)} {RANGES[name].unit}".rstrip()


def _noise_faults(cells: Cells, starts: Ints, profile: Profile, kind: str) -> Iterator[Fault]:
    """Noise of a triad out of range, stated for some cells of a tool and not for others, or zero."""
    names, triad = tuple(f"sd_{name}" for name in CHANNELS[kind]), getattr(profile, kind)
    if all(cells(name) is None for name in names):
        return
    for name in names:
        yield from range_faults(cells, name)
    if triad.noise is None:
        advice = (
            f"Other sd_ cells of the {kind} are filled. Fill it in, or state `noise` under [{kind}] in the "
            "tool profile."
        )
        blank = _blank_faults(cells, starts, names, advice)
        yield from _where_filled(cells, starts, names, blank)
    zero = _stacked(cells, names, starts) == 0.0
    if triad.repeatability == 0.0 and zero.any():
        advice = f"State the noise of the {kind}, or leave it blank."
        yield Fault(names, zero, "above 0", advice)


def range_faults(cells: Cells, name: str) -> Iterator[Fault]:
    """Values that the column may not have."""
    values, limits = cells(name), RANGES[name]
    if values is not None and (outside := limits.outside(values)).any():
        advice = "Check the cell, and the unit of the column."
        yield Fault((name,), outside[None], str(limits), advice)


def _blank_faults(
    cells: Cells, starts: Ints, names: tuple[str, ...], advice: str, missing_reading: bool = False
) -> Iterator[Fault]:
    """Cells that are blank."""
    blank = np.isnan(_stacked(cells, names, starts))
    if blank.any():
        yield Fault(names, blank, "filled in", advice, missing_reading)


def _where_filled(
    cells: Cells, starts: Ints, names: tuple[str, ...], rules: Iterator[Fault]
) -> Iterator[Fault]:
    """What is broken of the rules in tools that have any cell of the columns filled in."""
    filled = ~np.isnan(_stacked(cells, names, starts)).all(0)
    if not filled.any():
        return
    for fault in rules:
        tools = np.logical_or.reduceat(filled, starts[:-1])
        wrong = fault.cells & np.repeat(tools, np.diff(starts))
        if wrong.any():
            yield fault._replace(cells=wrong)


def _stacked(cells: Cells, names: tuple[str, ...], starts: Ints) -> Array:
    """The columns (k, R); those that are not there are blank."""
    columns = (cells(name) for name in names)
    return np.stack([np.full(starts[-1], np.nan) if c is None else c for c in columns])


def wholly_blank(tables: Iterable[Table]) -> tuple[tuple[str, ...], ...]:
    """Groups of optional columns that are blank on every row of all tables; looks no further than needed."""
    left = [*OPTIONAL]
    for table in tables:
        left = [g for g in left if g[0] in table.columns and all(is_blank(table, n) for n in g)]
        if not left:
            break
    return tuple(left)


def blank_cell(table: Table, names: tuple[str, ...]) -> InputError:
    """The refusal of a column that is blank on some rows and not on others."""
    problem = f"must be filled in; got a blank cell. {OPTIONAL[names]}"
    return BlankReadingError(str(cell_error(table, names[0], 0, problem)))


def is_blank(table: Table, name: str) -> bool:
    """Whether a column has no cell that is filled in."""
    column = table.columns[name]
    if isinstance(column, list):
        return not any(cell.strip() for cell in column)
    return bool(np.isnan(column).all())


def without_reading(table: Table, absent: Sequence[tuple[str, ...]]) -> Bools:
    """Rows (n,) with a blank reading or temperature; columns `absent` on all rows do not count."""
    without = [name for group in absent for name in group]
    names = [n for n in (*RAW, "temperature_c") if n in table.columns and n not in without]
    return np.asarray(np.isnan([_cells(table, name) for name in names]).any(axis=0))


def chosen(table: Table, rows: Bools) -> Table:
    """Some rows of a table, with their places."""
    picked = np.flatnonzero(rows).tolist()
    columns = {
        name: [column[i] for i in picked] if isinstance(column, list) else column[rows]
        for name, column in table.columns.items()
    }
    return replace(table, columns=columns, lines=[table.lines[i] for i in picked])


def spread(values: AnyArray, rows: Bools) -> AnyArray:
    """Values of the chosen rows, at their places among all; others are NaN, False or blank."""
    blank = {"b": False, "U": "", "O": ""}.get(values.dtype.kind, np.nan)
    out = np.full(rows.shape, blank, values.dtype)
    out[rows] = values
    return out


def _cells(table: Table, name: str) -> Array:
    """The column as numbers; what they may be is checked with all the rest."""
    column = table.columns[name]
    return numbers(table, name) if isinstance(column, list) else column


def nothing(source: str) -> InputError:
    """A table of which no row can be corrected."""
    return InputError(
        f"{source}: every row lacks a reading, so that there is nothing to correct. Check the "
        "columns of the raw channels and temperature_c."
    )
