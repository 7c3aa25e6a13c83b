"""A table of readings in the well, under the names of the run's profile or its own."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as replace_struct

from mwdcal.calibration.diagnosis.findings import COLUMNS_READ
from mwdcal.calibration.record import Calibration, Finding, with_checksum
from mwdcal.errors import FitError, InputError, QuestionError, QuestionsError
from mwdcal.files import runs
from mwdcal.files.contract import CHANNELS, MAPPED, RAW
from mwdcal.files.depths import (
    MEASURED_DEPTHS,
    chosen_length,
    is_depth,
    other_unit_of_length,
    unit_of_length,
)
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.layout import Layout
from mwdcal.files.formats.table import Table
from mwdcal.files.statements import Said, SurveyTable, stated_table
from mwdcal.files.synonyms import WARMTH
from mwdcal.identification.beside import has_channels
from mwdcal.identification.columns import column_said, meanings_of
from mwdcal.identification.proposal import as_written, named_columns
from mwdcal.identification.roll_tests import (
    check_channels,
    known_columns,
    one_of,
    raise_answerable,
    scaled,
    tables_on_sheet,
)
from mwdcal.sensor.profile import ColumnSource, Profile, TableFormat

_TAKEN = (*RAW, WARMTH, "station", "serial")
"""Columns that surveys take by the meaning of their names: angles and totals may be the tool's own."""
_LEFT_BLANK = (
    "Correct the cell. Or empty it: `missing` blank then leaves the results of its row blank."
)
"""The remedy for a row with a cell that is no reading."""


def table_of_other_names(
    source: str | os.PathLike[str] | Table,
    table: Table | None,
    problem: InputError | FitError | None,
    calibration: Calibration,
    said: Said,
) -> SurveyTable:
    """The readings in a file, or in a `table`, by names that are not those of the calibration's run.

    `table`: as it was read by the run's profile, if there was no `problem`.

    Raises:
        InputError: there is no table of readings.
        FitError: which table, or which columns, are meant is open.
    """
    form = where = None
    try:
        if not isinstance(source, Table):
            where = _table_in(source, calibration.profile, said, problem)
        if where is not None and not isinstance(source, Table):
            table, form = as_written(source, where, True)
        assert table is not None
        return _by_meaning(table, form, where, calibration, said)
    except (QuestionError, QuestionsError) as error:
        raise_answerable(error, _LEFT_BLANK)


def _table_in(
    path: str | os.PathLike[str], profile: Profile, said: Said, problem: Exception | None
) -> Layout | None:
    """The table of readings in a file; None of a format with one table only. Raises the problem if there is none."""
    try:
        every = tables_on_sheet(path, profile, said)
    except InputError as error:
        raise error if said.sheet or problem is None else problem from None
    meant = [t for t in every if has_channels(t, profile)]
    meant = [t for t in meant if not t.kind] or meant or sorted(every, key=lambda t: t.size)[-1:]
    if problem and not meant:
        raise problem
    return one_of(meant, f"{Path(path).name}: which one has the surveys")


def _by_meaning(
    table: Table,
    form: TableFormat | None,
    where: Layout | None,
    calibration: Calibration,
    said: Said,
) -> SurveyTable:
    """The readings of a table by the names that it has, in the units that it states."""
    profile = calibration.profile
    answers = {
        column: name
        for column, name in known_columns(table, where, profile).items()
        if column not in runs.ANGLES_OF_STAND
    }
    answers |= {c: name for c, name in said.columns.items() if c not in MEASURED_DEPTHS}
    depth, not_depth = _depth(table, said.columns)
    taken = {each.name for each in depth.values()}
    rest = replace(table, columns={n: c for n, c in table.columns.items() if n not in taken})
    columns, others = _channels(rest, form, where, answers)
    columns, others = columns | depth, [*others, *not_depth]
    magnetic = CHANNELS["magnetometer"] if {*RAW[3:]} & {*columns} else ()
    check_channels(table, columns, profile, (*CHANNELS["accelerometer"], *magnetic), "this table")
    form = replace_struct(form or TableFormat(), ignore=tuple(others))
    theirs = replace_struct(profile, table=form, columns=columns)
    theirs = scaled(theirs, runs.sources_of(profile))
    table = stated_table(table, said.statements, runs.serial_column(table, theirs))
    place = f", sheet {shown(where.sheet)}" if where and where.sheet else ""
    listed = ", ".join(f"{column} = {shown(each.name)}" for column, each in columns.items())
    text = f"{table.source}{place}: read by the names of this table: {listed}."
    reads = replace_struct(calibration, profile=theirs)
    reads = reads if calibration.changed else with_checksum(reads)
    return SurveyTable(table, reads, [Finding(id=COLUMNS_READ, text=text)])


def _depth(table: Table, answers: Mapping[str, str]) -> tuple[dict[str, ColumnSource], list[str]]:
    """The measured depth where the user names its column, and the columns that are called so and are not it.

    The column counts in the unit that it states, else in that of the answer: md_m, md_ft, md_usft.

    Raises:
        InputError: there is no such column, or it is in no unit of length.
    """
    said = next((column for column in MEASURED_DEPTHS if column in answers), "")
    if not said:
        return {}, []
    name, unit = column_said(answers[said], table.columns, table.source)
    beside = table.units.get(name, "")
    stated = unit_of_length(unit, name, beside)
    other = other_unit_of_length(*([unit] if unit else [name, beside]))
    if other or (unit and not unit_of_length(unit)):
        raise InputError(
            f"`column` {said}: the unit must be m, ft or usft; got {shown(other or unit)}."
        )
    others = [each for each in table.columns if is_depth(each) and each != name]
    column = f"md_{chosen_length(stated, MEASURED_DEPTHS[said])}"
    return ({column: ColumnSource(name=name)} if name else {}), others


def _channels(
    table: Table, form: TableFormat | None, where: Layout | None, answers: Mapping[str, str]
) -> tuple[dict[str, ColumnSource], list[str]]:
    """The columns of channels, temperature, labels and answers by their names in a run file, and those of others."""
    names = [*table.columns]
    units = [table.units.get(name, "") for name in names]
    meanings = meanings_of(names, units, where.above if where else ())
    said = {
        name for name in names for a in answers.values() if a == name or a.startswith(f"{name} (")
    }
    candidates = said | {name for name, m in meanings.items() if m.column in _TAKEN}
    some = replace(table, columns={n: c for n, c in table.columns.items() if n in candidates})
    columns = {}
    if {*RAW} & {*answers, *(meanings[name].column for name in candidates - said)}:
        columns = named_columns(some, form, where, answers, False).columns
    columns = {c: each for c, each in columns.items() if c in _TAKEN or c in answers}
    used = {each.name for each in columns.values()}
    return columns, [name for name in meanings if name not in used and name not in MAPPED]
