"""Run files of a fleet: CSV, TSV and XLSX as `mwdcal calibrate` reads them, with the serial of each.

A file holds the run of one tool, or those of many, told apart by a column `serial`. Which tool one
run belongs to says its metadata, else its column `serial`, else its folder (`serial=…`) or its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files import runs, synonyms
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, labels
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import Profile

SERIAL = "serial"
RUN_FILE = "#file"
"""Column of the path of the run file that a row comes from."""
FAULT = "#fault"
"""Column of what is wrong with a run file that cannot be read: it has one row."""


def read(path: Path, profile: Profile) -> Table:
    """The rows of a run file that its laboratory has not rejected, under the names of the run file's columns."""
    return runs.run_table(runs.read_export(path, profile, rows=runs.MOST_ROWS), profile)


def serials(table: Table, otherwise: str) -> list[str]:
    """The serials of a table: many of its column, or one; `otherwise` where it states none.

    Raises:
        InputError: the metadata name another tool than the column, or a row of many tools names none.
    """
    stated = _stated(table)
    cells = labels(table, SERIAL)
    named = list(dict.fromkeys(filter(None, cells)))
    if stated and named and named != [stated.strip()]:
        raise InputError(
            f"{table.source}: the metadata state the serial {shown(stated)}, the column '{SERIAL}' "
            f"{', '.join(map(shown, named[:2]))}{' …' if len(named) > 2 else ''}. Correct one of them."
        )
    if len(named) > 1 and "" in cells:
        problem = "must be filled in; got a blank cell. Say which tool the station belongs to."
        raise tables.cell_error(table, SERIAL, cells.index(""), problem)
    if not stated and not named:
        _check_near_misses(table)
    return named or [stated or otherwise]


def _check_near_misses(table: Table) -> None:
    """Refuse a table that seems to tell several tools apart by a column of another name."""
    for name in table.columns:
        if synonyms.resembled(name) == (SERIAL, "") and len(set(labels(table, name)) - {""}) > 1:
            raise InputError(
                f"{table.source}: the column {shown(name)} names several tools. Rename it to '{SERIAL}', or name it "
                "under [columns] of the tool profile."
            )


def run_of(table: Table, serial: str) -> Table:
    """The run of one tool, which states its serial; refuses what is not a run."""
    cells = labels(table, SERIAL)
    if len(set(filter(None, cells))) > 1:
        rows = [row for row, cell in enumerate(cells) if cell == serial]
        table = _rows(table, rows, f"{SERIAL} {serial} of {table.source}")
    runs.check_run(table)
    return replace(table, metadata={**table.metadata, SERIAL: _stated(table) or serial})


def _stated(table: Table) -> str:
    """The serial in the metadata of a table, empty where there is none."""
    stated = table.metadata.get(SERIAL)
    return "" if stated is None or not str(stated).strip() else str(stated)


def _rows(table: Table, rows: Sequence[int], source: str) -> Table:
    """Some rows of a table."""
    columns = {
        name: [cells[row] for row in rows] if isinstance(cells, list) else cells[list(rows)]
        for name, cells in table.columns.items()
    }
    lines = [table.lines[row] for row in rows]
    return replace(table, columns=columns, source=source, lines=lines)


def numbers(table: Table, name: str) -> Array:
    """A column as numbers, NaN where blank; infinite where a cell is not a number.

    That is out of every range: its tool is refused, in the words of its run.
    """
    try:
        return tables.numbers(table, name)
    except InputError:
        return np.array([_number(table, name, row) for row in range(table.count)])


def _number(table: Table, name: str, row: int) -> float:
    cells = table.columns[name][row : row + 1]
    try:
        return float(tables.numbers(replace(table, columns={name: cells}), name)[0])
    except InputError:
        return np.inf
