"""Questions on rows of a table: marked ones, and those with a cell that is no number."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from mwdcal.errors import Answer, InputError, QuestionError, QuestionsError
from mwdcal.files.contract import CHANNELS, RANGES, RAW, units_of
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, cell_error, labels, numbers
from mwdcal.files.marks import place
from mwdcal.files.synonyms import FACTORS, WARMTH
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.identification.answers import is_filler
from mwdcal.identification.wiring import LEAST_STATIONS
from mwdcal.sensor.profile import ColumnSource

FAR_OUT = 4.0
"""By how much a single reading lies farther out than all others that was mistyped."""
_FEW_ROWS, _FEW_SHARE = 2, 0.15
"""Rows at most that are asked about, and their share."""
_FEW_WORDS = 2
"""Words of a mark at most; more are a remark, which may speak of another row."""


def question_on_mark(table: Table, name: str, cell: str, rows: Sequence[int]) -> QuestionError:
    """Ask whether rows with a text in a column are rejected."""
    answers = [
        Answer("they are rejected: leave them out", (("leave_out", f"{name}={cell}"),)),
        Answer("they count", (("keep", f"{name}={cell}"),)),
    ]
    few = len(cell.split()) <= _FEW_WORDS
    more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
    return QuestionError(
        f"{table.source}: {place(table, rows[0])}{more}: {shown(name)} says {shown(cell)}. Is that a rejected station?",
        answers if few else answers[::-1],
    )


def question_on_cells(table: Table, name: str, row: int, cells: Sequence[str]) -> QuestionError:
    """Ask whether the rows with some cells that are no numbers are left out; `row` is the first of them."""
    got = shown(cells[0]) if cells[0] else "a blank cell"
    problem = f"expected a reading; got {got}. Is its row to be left out?"
    return QuestionError(
        str(cell_error(table, name, row, problem)),
        [Answer("leave such rows out", tuple(("leave_out", f"{name}={cell}") for cell in cells))],
    )


def check_cells(table: Table, columns: Mapping[str, ColumnSource]) -> None:
    """Ask whether rows are left out that have no reading, a number that stands for none, or one that cannot be.

    Cells of which there are many are of another unit or column: they are refused when they are read.
    """
    raw = {
        column: numbers(table, source.name)
        for column, source in columns.items()
        if column in RANGES
    }
    questions = []
    for column, values in raw.items():
        factor, offset = (
            FACTORS.get(columns[column].unit, (1.0, 0.0)) if units_of(column) else (1.0, 0.0)
        )
        wrong = is_filler(values) | RANGES[column].outside(values * factor + offset)
        if column in (*RAW, WARMTH) and not np.isnan(values).all():
            wrong |= np.isnan(values)
        if column in RAW:
            wrong |= _far_out(raw, column)
        if 0 < wrong.sum() <= max(_FEW_ROWS, _FEW_SHARE * wrong.size):
            rows = np.flatnonzero(wrong).tolist()
            cells = labels(table, columns[column].name)
            each = [*dict.fromkeys(cells[row] for row in rows)]
            questions.append(question_on_cells(table, columns[column].name, rows[0], each))
    if questions:
        raise QuestionsError(table.source, questions)


def _far_out(values: Mapping[str, Array], column: str) -> Bools:
    """Whether a row (n,) is the one of a triad that lies far outside all others, by this channel."""
    triad = next(names for names in CHANNELS.values() if column in names)
    if values[column].size < LEAST_STATIONS or not all(name in values for name in triad):
        return np.zeros(values[column].size, bool)
    channels = np.stack([values[name] for name in triad], -1)
    if np.isnan(channels).all(0).any():
        return np.zeros(len(channels), bool)
    off = np.nan_to_num(np.abs(channels - np.nanmedian(channels, 0)))
    *_, second, largest = np.sort(off.max(-1))
    far = off.max(-1) > FAR_OUT * second
    return np.asarray(far & (largest > 0) & (off[:, triad.index(column)] == off.max(-1)))


def check_columns_of_rows(table: Table, names: Collection[str]) -> None:
    """Refuse rules on rows by a column that the table has not."""
    absent = [name for name in names if name not in table.columns]
    if absent:
        raise InputError(
            f"{table.source}: there is no column {shown(absent[0])} by whose texts rows are left out; found "
            f"{', '.join(map(shown, [*table.columns][:24]))}."
        )
