"""Statements of a user about a run beside its table: serial, day, operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from mwdcal.calibration.readings import IN_TABLE
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table, labels
from mwdcal.files.formats.titles import dated


@dataclass(frozen=True)
class Said:
    """Statements of the user on a later table: as of `runs.read_export`, its sheet, and its columns.

    `of_run`: metadata of the run, for a roll test.
    """

    decimal: str = "."
    statements: Mapping[str, str] = field(default_factory=dict)
    sheet: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    of_run: Mapping[str, object] = field(default_factory=dict)

    @property
    def answers(self) -> bool:
        """Whether it says which sheet or columns are meant."""
        return bool(self.sheet or self.columns)


@dataclass(frozen=True)
class SurveyTable:
    """A table of readings, and the calibration with the profile that reads it; `findings` on names that it took."""

    table: Table
    calibration: Calibration
    findings: list[Finding] = field(default_factory=list)


def with_statements(
    metadata: Mapping[str, object], statements: Mapping[str, str]
) -> dict[str, object]:
    """Metadata with what the user says, which comes first; what they stated otherwise stays beside it."""
    others = {
        f"{key}{IN_TABLE}": str(metadata[key])
        for key, value in statements.items()
        if metadata.get(key) not in (None, "", value)
    }
    return {**metadata, **statements, **others}


def stated_table(table: Table, statements: Mapping[str, str], column: str = "serial") -> Table:
    """A table with what the user says of it; of several tools in it, the rows of the one that is named.

    `column`: that of the serials.

    Raises:
        InputError: the table has serials, and none of them is the one named.
    """
    cells, serial = labels(table, column), statements.get("serial")
    if serial and any(cells):
        rows = [row for row, cell in enumerate(cells) if cell == serial]
        if not rows:
            known = ", ".join(map(shown, [*dict.fromkeys(filter(None, cells))][:8]))
            raise InputError(
                f"{table.source}: no row is of the serial {shown(serial)}; the column {shown(column)} has {known}. "
                "Name one of these by `serial`."
            )
        table = rows_of(table, rows)
    return replace(table, metadata=with_statements(table.metadata, statements))


def rows_of(table: Table, rows: list[int]) -> Table:
    """Some rows of a table, dated by the day that they share."""
    columns = {
        name: [cells[row] for row in rows] if isinstance(cells, list) else cells[rows]
        for name, cells in table.columns.items()
    }
    lines = [table.lines[row] for row in rows] if len(table.lines) else table.lines
    parts = [table.parts[row] for row in rows] if table.parts else table.parts
    metadata = dated(table.metadata, columns.items())
    return replace(table, columns=columns, metadata=metadata, lines=lines, parts=parts)
