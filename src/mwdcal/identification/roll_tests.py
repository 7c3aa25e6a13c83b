"""A roll test in a file: of its own or beside the run, under the names of the run's profile or its own."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn
from unicodedata import normalize

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.findings import OF_ROLL_TEST
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import (
    Answer,
    FitError,
    InputError,
    QuestionError,
    QuestionsError,
    UnreadableFileError,
)
from mwdcal.files import runs
from mwdcal.files.contract import AZIMUTH_KEYS, CHANNELS, RAW, REFERENCES, units_of
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, shown
from mwdcal.files.formats.layout import ROLL_TEST, Layout, is_part_of
from mwdcal.files.formats.table import Table
from mwdcal.files.parting import parted, roll_test_marks
from mwdcal.files.statements import Said, stated_table
from mwdcal.files.synonyms import ABOVE, BELOW, FACTORS, unit_of
from mwdcal.identification.beside import has_channels, of_roll_tests, without_channels
from mwdcal.identification.columns import meanings_of
from mwdcal.identification.proposal import (
    as_written,
    named_columns,
    once_for_setting,
    station_column,
    with_north,
    written_once,
)
from mwdcal.sensor.profile import ColumnSource, Profile, TriadProfile

_STRENGTHS = {"accelerometer": (1 / 3, 3.0), "magnetometer": (7_000.0, 210_000.0)}
"""Strengths, g and nT, outside which readings are in another unit than the scale of a triad."""
_PLACE = tuple(REFERENCES[name].column for name in runs.STATED_REFERENCES)
_OF_RUN = (*AZIMUTH_KEYS, *_PLACE, "date")
"""Statements of a run that hold for its roll test too."""
_AZIMUTH_REFERENCE = AZIMUTH_KEYS[0]
_CALLED_MAGNETIC = re.compile(r"\bmag|missweisend|магн|磁", re.IGNORECASE)
"""Words of azimuths that count from magnetic north."""
_ANSWERED = ("sheet", "column")
"""Arguments that answer questions about a roll test."""


def read_later(
    path: str | os.PathLike[str],
    calibration: Calibration,
    said: Said | None = None,
    is_test: bool = True,
) -> Readings:
    """The readings after a calibration in a file; of that of its own run the roll test in it, if there is one.

    Unless it surely `is_test`, angles under other names than the run's may be the tool's own: they are no references
    beside channels of the run's names.

    Raises:
        InputError: the file cannot be read, or has no table of readings.
        FitError: it leaves something open.
    """
    said, profile = replace(said or Said(), of_run=_north_of(calibration)), calibration.profile
    if said.columns or (said.sheet and Path(path).name != calibration.run):
        return read_roll_test(path, profile, said)
    try:
        table = runs.read_export(
            path, profile, decimal=said.decimal, rows=runs.MOST_ROWS, statements=said.statements
        )
    except UnreadableFileError:
        raise
    except (InputError, FitError) as error:
        return _of_other_table(path, profile, said, error)
    if not _has_names(table.columns, {}, profile, is_test):
        return read_roll_test(path, profile, said)
    angles = {k: v for k, v in said.of_run.items() if is_test and k != _AZIMUTH_REFERENCE}
    table = replace(table, metadata={**angles, **table.metadata})
    readings = runs.read_run(table, profile)[0]
    if not any(calibration.used(readings.digest)):
        return read_roll_test(path, profile, said) if said.sheet else readings
    others = _others(path, table, profile, said)
    named = any(t.kind == ROLL_TEST for t in others) or _tests_among(others, table, profile)
    if named or said.sheet or roll_test_marks(table):
        return parted_run(path, table, profile, said)[1].readings(profile)
    return readings


def _north_of(calibration: Calibration) -> dict[str, object]:
    """The north of the azimuths of a calibration's run, as metadata state it; empty where it is magnetic."""
    tool = calibration.tool
    return {
        k: tool[k] if k == _AZIMUTH_REFERENCE else float(tool[k]) for k in AZIMUTH_KEYS if k in tool
    }


def _of_other_table(
    path: str | os.PathLike[str], profile: Profile, said: Said, problem: InputError | FitError
) -> Readings:
    """The readings of a file without the table of a profile; the problem where it holds no other table."""
    try:
        every = tables.every_table(path, decimal=sign_of(profile, said))
    except InputError:
        raise problem from None
    if not any(has_channels(each, profile) for each in every):
        raise problem from None
    return read_roll_test(path, profile, said)


@dataclass(frozen=True)
class RollTestTable:
    """A roll test that is to be read once its run has given the scales: rows of the run's table, or a file.

    `tables` of the file that may be meant.
    """

    path: str | os.PathLike[str]
    said: Said
    rows: Table | None = None
    tables: Sequence[Layout] | None = None

    def readings(self, profile: Profile) -> Readings:
        """The readings, by the profile with the scales of the run; errors as of `read_later`."""
        if self.rows is not None:
            return runs.read_run(self.rows, profile)[0]
        return read_roll_test(self.path, profile, self.said, self.tables)


def parted_run(
    path: str | os.PathLike[str], table: Table, profile: Profile, said: Said
) -> tuple[Table, RollTestTable]:
    """The rows of the run in a file, and the roll test beside them: a table that is called so, rows, or the only other.

    Raises:
        InputError: the file has neither another table nor rows that one column marks.
    """
    others = _others(path, table, profile, said)
    tests = _tests_among(others, table, profile)
    said = replace(said, of_run=table.metadata)
    if said.sheet or (tests and (tests[0].kind == ROLL_TEST or not roll_test_marks(table))):
        return table, RollTestTable(path, said, tables=None if said.sheet else tests)
    bare = [t for t in others if t.kind == ROLL_TEST]
    if bare and not roll_test_marks(table):
        raise InputError(f"{table.source}: {without_channels(bare[0])}")
    run, rows = parted(table)
    return run, RollTestTable(path, said, rows=rows)


def beside(
    path: str | os.PathLike[str], run: Table, profile: Profile, said: Said | None = None
) -> list[Layout]:
    """The tables in the file of a run that may be its roll test: those that are called so, or all other readings."""
    return _tests_among(_others(path, run, profile, said or Said()), run, profile)


def _tests_among(others: Sequence[Layout], run: Table, profile: Profile) -> list[Layout]:
    """The tables beside a run that may be its roll test."""
    serial = run.metadata.get("serial", "")
    return of_roll_tests([t for t in others if has_channels(t, profile)], serial)


def _others(path: str | os.PathLike[str], run: Table, profile: Profile, said: Said) -> list[Layout]:
    """The tables in the file of a run beside it."""
    every = tables.every_table(path, decimal=sign_of(profile, said))
    sheet = run.sheet or next((each.sheet for each in every), "")
    rows = (sheet, run.parts, run.lines, run.places.values())
    return [t for t in every if not is_part_of(t, *rows)]


def sign_of(profile: Profile, said: Said) -> str:
    """The decimal sign of text where it is known to be the comma."""
    return "," if "," in (profile.form.decimal, said.decimal) else ""


def read_roll_test(
    path: str | os.PathLike[str],
    profile: Profile,
    said: Said,
    meant: Sequence[Layout] | None = None,
) -> Readings:
    """The readings of a roll test by the axes and scales of a profile; `meant`: tables of the file that may be it.

    Raises:
        InputError: there is no such sheet, or no table of readings, or a channel is missing.
        FitError: which table, or which columns, are meant is open.
    """
    where = _chosen(path, profile, said, meant)
    try:
        if (
            where is not None
            and not said.columns
            and _has_names(where.names, _units(where), profile)
        ):
            return _under_names_of_run(path, where, profile, said)
        return _by_meaning(path, where, profile, said)
    except (QuestionError, QuestionsError) as error:
        raise_answerable(error, "Correct the cell, or take the row out of the table.")


def raise_answerable(error: QuestionError | QuestionsError, remedy: str) -> NoReturn:
    """Raise questions with the answers that a later table takes; the `remedy` where rows are to be left out."""
    every = error.questions if isinstance(error, QuestionsError) else (error,)
    questions = []
    for each in every:
        taken = [a for a in each.answers if all(name in _ANSWERED for name, _ in a.arguments)]
        rows = any(name == "leave_out" for a in each.answers for name, _ in a.arguments)
        questions.append(QuestionError(f"{each.text} {remedy}" if rows else each.text, taken))
    raise (
        QuestionsError(error.source, questions)
        if isinstance(error, QuestionsError)
        else questions[0]
    ) from None


def _chosen(
    path: str | os.PathLike[str], profile: Profile, said: Said, meant: Sequence[Layout] | None
) -> Layout | None:
    """The table of the roll test in a file; None of a format that has but one table."""
    if meant is None:
        on_sheet = tables_on_sheet(path, profile, said)
        tests = [t for t in on_sheet if has_channels(t, profile)]
        meant = of_roll_tests(tests) or tests or sorted(on_sheet, key=lambda t: t.size)[-1:]
    return one_of(meant, f"{Path(path).name}: which one is the roll test")


def one_of(meant: Sequence[Layout], question: str) -> Layout | None:
    """The only one of tables that may be meant, the largest of one sheet; None of no tables.

    Raises:
        QuestionError: they are on several sheets.
    """
    if len({t.sheet for t in meant}) > 1:
        places = ", ".join(f"sheet {shown(t.sheet)} ({len(t.lines)} rows)" for t in meant)
        answers = [Answer(shown(t.sheet), (("sheet", t.sheet),)) for t in meant]
        raise QuestionError(
            f"{question}: {places}? If it is not among them, name another file.", answers
        )
    return max(meant, key=lambda t: t.size, default=None)


def tables_on_sheet(path: str | os.PathLike[str], profile: Profile, said: Said) -> Sequence[Layout]:
    """The tables of a file, those on the sheet that the user says; none of a format that has but one."""
    every = tables.every_table(path, decimal=sign_of(profile, said))
    on_sheet = [t for t in every if said.sheet in ("", t.sheet)]
    if said.sheet and not on_sheet:
        names = ", ".join(dict.fromkeys(shown(t.sheet) for t in every))
        raise InputError(
            f"{Path(path).name}: there is no table on a sheet {shown(said.sheet)}; found {names or 'none'}."
        )
    return on_sheet


def _units(where: Layout) -> dict[str, str]:
    """The units that a table states apart from the names of its columns."""
    return dict(zip(where.names, map(unit_of, where.units), strict=True))


def _has_names(
    names: Iterable[str], units: Mapping[str, str], profile: Profile, by_meaning: bool = True
) -> bool:
    """Whether columns are called as by a profile, in its units, and none under another name is one that it names.

    One is that by its name alone, or `by_meaning`.
    """
    names, sources = [*names], runs.sources_of(profile)
    if {*CHANNELS["accelerometer"]} <= {*names} and not runs.is_export(names, profile):
        return True
    theirs = {each.name for each in sources.values()}
    if not sources or not {*runs.channels_of(profile)} <= {*names}:
        return False
    others = [n for n in names if n not in theirs]
    absent = {c for c, each in sources.items() if each.name not in names}
    meant = set[str]()
    if by_meaning:
        meant = {m.column for m in meanings_of(others, [""] * len(others)).values()}
    meant |= {c for c in absent for n in others if _plain(n) == _plain(sources[c].name)}
    return not absent & meant and all(
        not units.get(s.name) or not s.unit or runs.alike_units(units[s.name], s.unit)
        for s in sources.values()
    )


def _plain(name: str) -> str:
    """A name without case, accents, blanks and brackets.

    >>> _plain("Inclinación (°)") == _plain("INCLINACION °"), _plain("Gx (g)") == _plain("Gx (mg)")
    (True, False)
    """
    return re.sub(r"[^\w°µ/²%]|_|[\u0300-\u036f]", "", normalize("NFD", name)).casefold()


def _under_names_of_run(
    path: str | os.PathLike[str], where: Layout, profile: Profile, said: Said
) -> Readings:
    """The readings of a table under the names of the run's profile."""
    table = runs.filled_down(runs.of_layout(where, path, profile), profile.form.fill_down)
    sources = runs.sources_of(profile).items()
    columns = {*table.columns, *(c for c, each in sources if each.name in table.columns)}
    table = _with_remark(_with_run(table, profile, said), table.metadata, columns)
    table = stated_table(table, said.statements, runs.serial_column(table, profile))
    return runs.read_run(table, profile)[0]


def _by_meaning(
    path: str | os.PathLike[str], where: Layout | None, profile: Profile, said: Said
) -> Readings:
    """The readings of a table by the names that it has, as a profile would be proposed for it."""
    table, form = as_written(path, where, True)
    of_table = table.metadata
    table = _with_run(table, profile, said)
    answers = {**known_columns(table, where, profile), **said.columns}
    table, form, columns, _, ignored = named_columns(table, form, where, answers, False)
    check_channels(table, columns, profile, CHANNELS["accelerometer"], OF_ROLL_TEST)
    if once := once_for_setting(table, columns) or written_once(table, columns):
        table = runs.filled_down(table, once)
    if _AZIMUTH_REFERENCE not in of_table and (
        (azimuth := columns.get(REFERENCES["azimuth"].column))
        and _CALLED_MAGNETIC.search(azimuth.name)
    ):
        table = replace(table, metadata={**table.metadata, _AZIMUTH_REFERENCE: "magnetic"})
    table, form = with_north(table, form, columns, where.above if where else ())
    columns |= station_column(table, columns, answers)
    columns = _with_sense(columns, profile)
    if form is not None:
        form = msgspec.structs.replace(form, ignore=tuple(ignored))
    theirs = scaled(
        msgspec.structs.replace(profile, table=form or msgspec.UNSET, columns=columns),
        runs.sources_of(profile),
    )
    table = replace(table, remarks=(*table.remarks, *_sentences(where, columns, profile)))
    table = _with_remark(table, of_table, columns)
    table = stated_table(table, said.statements, runs.serial_column(table, theirs))
    readings = runs.read_run(table, theirs)[0]
    _check_strengths(readings, columns, runs.sources_of(profile))
    return readings


def _with_run(table: Table, profile: Profile, said: Said) -> Table:
    """A roll test with the north, the place and the day of its run where its own table does not state them."""
    of_run = {**profile.form.north, **said.of_run}
    taken = {key: of_run[key] for key in _OF_RUN if key in of_run}
    return replace(table, metadata={**taken, **table.metadata})


def _with_remark(table: Table, of_table: Mapping[str, object], columns: Collection[str]) -> Table:
    """The roll test with a remark on what it takes from its run, beyond what is `of_table`: metadata, and columns."""
    north = table.metadata.get(_AZIMUTH_REFERENCE, "magnetic")
    turned = REFERENCES["azimuth"].column in columns and north != "magnetic"
    wanted = (*(AZIMUTH_KEYS if turned else ()), *(c for c in _PLACE if c not in columns))
    taken = [
        f"{k} {table.metadata[k]}" for k in wanted if k in table.metadata and k not in of_table
    ]
    text = (
        f"{OF_ROLL_TEST} takes from its run what its own table does not state: {', '.join(taken)}."
    )
    return replace(table, remarks=(*table.remarks, *[text] * bool(taken)))


def known_columns(table: Table, where: Layout | None, profile: Profile) -> dict[str, str]:
    """The columns that are called as by the run's profile but for blanks, brackets, case and accents."""
    names = {_plain(name): name for name in table.columns}
    units = _units(where) if where else {}
    known = {}
    for column, each in runs.sources_of(profile).items():
        name = names.get(_plain(each.name))
        if name is not None:
            unit = "" if column in LABELS else units.get(name) or each.unit
            known[column] = f"{name} ({unit})" if unit else name
    return known


def check_channels(
    table: Table,
    columns: Mapping[str, ColumnSource],
    profile: Profile,
    usual: Collection[str],
    word: str,
) -> None:
    """Refuse a table, called by a word, without channels of the run; the `usual` ones where its profile names none."""
    theirs = runs.sources_of(profile)
    wanted = [c for c in theirs if c in RAW] or usual
    absent = [column for column in wanted if column not in columns]
    if absent:
        names = ", ".join(shown(theirs[c].name) for c in absent if c in theirs)
        used = {each.name for each in columns.values()}
        others = [shown(name) for name in table.columns if name not in used]
        problem = f"{table.source}: {word} has no column for {', '.join(absent)}"
        problem += f" (in the run {names})" if names else ""
        if len(others) < len(absent):
            raise InputError(f"{problem}. Add what is missing.")
        raise QuestionError(
            f"{problem}; its others are {', '.join(others[:12])}. Which are they?",
            [Answer("", tuple(("column", f"{column}=NAME") for column in absent))],
        )


def _with_sense(columns: Mapping[str, ColumnSource], profile: Profile) -> dict[str, ColumnSource]:
    """The columns; an elevation counts as that of the run, whose readings told its sense."""
    name = REFERENCES["inclination"].column
    run, test = runs.sources_of(profile).get(name), columns.get(name)
    if run and test and (run.unit, test.unit) == (BELOW, ABOVE):
        return {**columns, name: ColumnSource(name=test.name, unit=BELOW)}
    return {**columns}


def scaled(profile: Profile, run: Mapping[str, ColumnSource]) -> Profile:
    """The profile of a later table with the scales of its run in the units of the table's channels."""
    triads, known = {}, {*units_of("ref_gravity_g"), *units_of("ref_field_nt")}
    unlike: dict[str, tuple[str, str]] = {}
    for kind in TRIADS:
        theirs, ours = (_unit(kind, each) for each in (run, runs.sources_of(profile)))
        factors = [FACTORS.get(unit, (1.0, 0.0))[0] for unit in (theirs, ours)]
        if theirs and ours and theirs != ours:
            if not {theirs, ours} <= known:
                unlike[kind] = ours, theirs
            triads[kind] = _times(getattr(profile, kind), factors[0] / factors[1])
    if unlike:
        raise InputError(_of_other_units(unlike))
    return msgspec.structs.replace(profile, **triads)


def _of_other_units(unlike: Mapping[str, tuple[str, str]]) -> str:
    """Triads whose unit in a table cannot be converted to that of the run, and what to do."""
    reads = " and ".join(f"the {kind} reads in {ours}" for kind, (ours, _) in unlike.items())
    theirs = " and ".join(dict.fromkeys(unit for _, unit in unlike.values()))
    units = " and ".join(
        f'unit = "{ours}" for {", ".join(CHANNELS[kind])}' for kind, (ours, _) in unlike.items()
    )
    return (
        f"{reads} in this table, and in {theirs} in the run. If the run was in the table's units too, write {units} "
        "under [columns] of the tool profile and calibrate again. Else convert one of them."
    )


def _unit(kind: str, columns: Mapping[str, ColumnSource]) -> str:
    """The unit of the channels of a triad; empty where none is stated."""
    return next((columns[c].unit for c in CHANNELS[kind] if c in columns), "")


def _times(triad: TriadProfile, factor: float) -> TriadProfile:
    """A triad whose raw readings are so many times as large."""
    return msgspec.structs.replace(
        triad,
        scale=triad.scale and triad.scale * factor,
        noise=triad.noise and triad.noise * factor,
        repeatability=triad.repeatability * factor,
        drift=triad.drift * factor,
    )


def _check_strengths(
    readings: Readings, ours: Mapping[str, ColumnSource], run: Mapping[str, ColumnSource]
) -> None:
    """Refuse readings that cannot be in the unit of the run, where one of the two is not stated."""
    for kind in TRIADS:
        values = getattr(readings, kind)
        if values is None or (_unit(kind, ours) and _unit(kind, run)):
            continue
        strength = float(np.median(np.linalg.norm(values, axis=-1)))
        low, high = _STRENGTHS[kind]
        if not low <= strength <= high:
            word = "g" if kind == "accelerometer" else "nT"
            raise InputError(
                f"{readings.source}: by the scale of the run the {kind} reads {strength:.3g} {word}: the roll test is "
                "in another unit. State the unit in its names and in [columns] of the run's tool profile."
            )


def _sentences(
    where: Layout | None, columns: Mapping[str, ColumnSource], profile: Profile
) -> list[str]:
    """The names by which a roll test was read, and the references of the run that it has not."""
    place = f" from sheet {shown(where.sheet)}" if where and where.sheet else ""
    listed = ", ".join(f"{column} = {shown(each.name)}" for column, each in columns.items())
    absent = _lacking(columns, profile)
    return [
        f"{OF_ROLL_TEST} was read{place} by its own names: {listed}.",
        *([f"{OF_ROLL_TEST} has no column for {', '.join(absent)}."] if absent else []),
    ]


def _lacking(columns: Collection[str], profile: Profile) -> list[str]:
    """Angles of the stand and the temperature that the run has a column of, and its roll test has not."""
    wanted = (*runs.ANGLES_OF_STAND, "temperature_c")
    return [c for c in wanted if c in runs.sources_of(profile) and c not in columns]
