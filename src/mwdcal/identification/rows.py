"""Questions on rows of a table: marked ones, and those with a cell that is no number."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from mwdcal.errors import Answer, InputError, QuestionError
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, cell_error
from mwdcal.files.marks import place

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
    problem = f"expected a number; got {shown(cells[0]) if cells[0] else 'a blank cell'}. Is its row to be left out?"
    return QuestionError(
        str(cell_error(table, name, row, problem)),
        [Answer("leave such rows out", tuple(("leave_out", f"{name}={cell}") for cell in cells))],
    )


def check_columns_of_rows(table: Table, names: Collection[str]) -> None:
    """Refuse rules on rows by a column that the table has not."""
    absent = [name for name in names if name not in table.columns]
    if absent:
        raise InputError(
            f"{table.source}: there is no column {shown(absent[0])} by whose texts rows are left out; found "
            f"{', '.join(map(shown, [*table.columns][:24]))}."
        )
