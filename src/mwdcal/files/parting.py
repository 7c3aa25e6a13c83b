"""A table that holds a calibration run and its roll test, told apart by a column that marks the roll test."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mwdcal.errors import InputError
from mwdcal.files.contract import COLUMNS
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, labels
from mwdcal.files.statements import rows_of

_TESTS = re.compile(
    r"ver(if(y|ication|iziert)?)?|verifikation|verifisering|check|validation|control|kontrolle|pr(ue|ü)fung|kontroll|"
    r"verificaci[oó]n|verifica[cç][aã]o|проверка|поверка|контроль|验证|检验|检查|test"
)
_ROLLS = re.compile(
    r"roll(ing)?|rotation|dreh(ung)?|rull(e|ering)?|giro|rotaci[oó]n|rola(gem|mento)|rota[cç][aã]o|roulis|вращени[ея]|"
    r"滚转|滚动|旋转|转动"
)
_ROLL_TEST = re.compile(
    rf"\W*((roll|rull|rollen)[\s_-]*(over|set|serie)|rt|rollpr(ue|ü)fung|prueba|"
    rf"({_ROLLS.pattern})?[\s_-]*({_TESTS.pattern})([\s_-]*(d[aeo] )?({_ROLLS.pattern}))?|"
    rf"(prueba|prova|ensaio|teste|essai)[\s_-]*d[aeo] ({_ROLLS.pattern}))"
    r"[\s_-]*(run|shot|station|row|point|rows?|点|\d*)\W*",
    re.IGNORECASE,
)
"""Names of what checks a calibration and is no part of it, in a cell or as the name of a column."""
_ROLLS_ALONE = re.compile(rf"\W*({_ROLLS.pattern})[\s_-]*\d*\W*", re.IGNORECASE)
_CALIBRATION = re.compile(
    r"\W*([ck]al(ib\w*)?|calibra[cç][aã]o|calibraci[oó]n|калибр\w*|标定|校准)\W*\d*\W*",
    re.IGNORECASE,
)
"""Cells of rows of rolls, beside those of the calibration."""
_YES = re.compile(r"(x|yes|y|ja|si|sí|sim|да|是|true|1|1\.0|✓|✔|√)", re.IGNORECASE)
_NO = re.compile(r"(|no|n|nei|nein|não|нет|否|false|0|0\.0|-|–)", re.IGNORECASE)


def parted(table: Table) -> tuple[Table, Table]:
    """The rows of the calibration run and those of the roll test.

    A column marks the roll test by its name, with yes at its rows, or by its cells, as 'cal' and 'roll test'.

    Raises:
        InputError: no column marks it, or several do and differ.
    """
    marks = roll_test_marks(table)
    if not marks:
        raise InputError(
            f"{table.source} has one table of readings, and no column marks a roll test in it: all its stations are of "
            f"the run. {HOW_TO_MARK}"
        )
    if len({tuple(rows) for rows in marks.values()}) > 1:
        raise InputError(
            f"{table.source} holds both run and roll test, and {' and '.join(map(shown, marks))} mark different rows. "
            "Correct one of them."
        )
    rows = next(iter(marks.values()))
    others = [row for row in range(table.count) if row not in {*rows}]
    return rows_of(table, others), rows_of(table, rows)


HOW_TO_MARK = (
    "Mark a roll test in one column, such as 'Roll test' with yes at its rows, put it on a sheet of its own, or name "
    "its file by `rolltest`."
)
"""The remark on a roll test in the file of the run."""


def roll_test_marks(table: Table) -> dict[str, list[int]]:
    """The rows that columns mark as roll test, by the name of the column."""
    marks = {name: marked_rows(table, name) for name in table.columns if name not in COLUMNS}
    return {name: rows for name, rows in marks.items() if rows}


def marked_rows(table: Table, name: str) -> list[int]:
    """The rows that a column marks as roll test; none where it marks nothing or all of them."""
    cells = labels(table, name)
    called = _ROLL_TEST.fullmatch(name.strip())
    if called and all(_YES.fullmatch(cell) or _NO.fullmatch(cell) for cell in cells):
        rows = [row for row, cell in enumerate(cells) if _YES.fullmatch(cell)]
    else:
        rows = _named_in(cells)
    return rows if len(rows) < len(cells) else []


def check_rows(table: Table, name: str) -> list[int]:
    """The rows that a cell in a column calls a check of the calibration; none where they are half of all or more."""
    rows = _named_in(labels(table, name))
    return rows if 2 * len(rows) < table.count else []


def is_check(text: str) -> bool:
    """Whether a text calls something a roll test or another check of a calibration.

    >>> is_check("Rolltest"), is_check("rotation")
    (True, False)
    """
    return bool(_ROLL_TEST.fullmatch(re.sub(r"[()\[\]]", " ", text)))


def _named_in(cells: Sequence[str]) -> list[int]:
    beside = any(map(_CALIBRATION.fullmatch, cells))
    return [
        row
        for row, cell in enumerate(cells)
        if is_check(cell) or (beside and _ROLLS_ALONE.fullmatch(cell))
    ]
