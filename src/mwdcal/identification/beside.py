"""The other tables in the file of a run: which of them may be its roll test."""

from __future__ import annotations

from collections.abc import Sequence

from mwdcal.calibration.record import Finding
from mwdcal.errors import shell_word
from mwdcal.files import runs
from mwdcal.files.contract import RAW
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.layout import ROLL_TEST, Layout
from mwdcal.identification.columns import meanings_of
from mwdcal.sensor.profile import Profile

NOT_READ = "tables-not-read"
"""The id of findings on the tables beside that of a run."""
LEAST_CHANNELS = 3
"""Channels from which on a table is one of readings of a tool."""


def has_channels(table: Layout, profile: Profile) -> bool:
    """Whether a table has three channels or more, by the names of a profile or its own."""
    if len({*RAW, *runs.channels_of(profile)} & {*table.names}) >= LEAST_CHANNELS:
        return True
    meant = {m.column for m in meanings_of(table.names, table.units, table.above).values()}
    return len(meant & {*RAW}) >= LEAST_CHANNELS


def of_roll_tests(every: Sequence[Layout], serial: object = "") -> list[Layout]:
    """The tables that are called roll tests; else those that are called nothing else, and are of no other serial."""
    return [t for t in every if t.kind == ROLL_TEST] or [
        t for t in every if not t.kind and t.titles.metadata.get("serial", serial) == serial
    ]


def has_roll_test(tables: Sequence[Layout]) -> bool:
    """Whether it is clear which of some tables is a roll test: it is called so, or the only one."""
    return len(tables) == 1 or any(t.kind == ROLL_TEST for t in tables)


def roll_tests_beside(where: Layout, profile: Profile, serial: object) -> list[Layout]:
    """The tables beside that of a run which may be its roll test."""
    return of_roll_tests([t for t in where.beside if has_channels(t, profile)], serial)


def findings_beside(where: Layout, profile: Profile, serial: object, file: str) -> list[Finding]:
    """A sentence on each other table of readings in the `file` of a run, but for those that its layout names."""
    every = [t for t in where.beside if has_channels(t, profile)]
    tests = of_roll_tests(every, serial)
    clear = has_roll_test(tests)
    named = {(t.form.header_line, t.kind) for t in where.aside}
    bare = [t for t in where.beside if t not in every and t.kind == ROLL_TEST]
    return [
        Finding(id=NOT_READ, text=_sentence(t, clear and t in tests, where.sheet, file))
        for t in every
        if (t.form.header_line, t.kind) not in named
    ] + [Finding(id=NOT_READ, text=without_channels(t)) for t in bare]


def without_channels(table: Layout) -> str:
    """A sentence on a roll test that has no readings of the tool."""
    place = f"sheet {shown(table.sheet)}" if table.sheet else f"line {table.form.header_line}"
    return (
        f"the roll test of {place} has no columns called as channels: mwdcal judges readings of the tool, not angles "
        "that were computed from them."
    )


def _sentence(table: Layout, is_test: bool, sheet: str, file: str) -> str:
    """A sentence on a table beside that of a run on a `sheet`."""
    line = f"below line {table.form.header_line}"
    place = f"on sheet {shown(table.sheet)}" if table.sheet != sheet else line
    what = f"{table.kind or 'other readings'} {place}, {len(table.lines)} rows"
    option = f"`rolltest` {shell_word(file)}"
    if is_test:
        return f"{what}: mwdcal calibrate judges by it with {option}."
    if table.kind and table.kind != ROLL_TEST:
        return f"{what}: not read."
    if table.sheet == sheet:
        return f"{what}: not read. If it is the roll test, write it to a file of its own."
    option += f" `rolltest_sheet` {shell_word(table.sheet)}"
    return f"{what}: not read. If it is the roll test, mwdcal calibrate takes it with {option}."
