"""A tool profile proposed for a table as it was exported."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations, groupby, permutations, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.findings import (
    MARKED_ROWS,
    is_left_handed,
    left_handed,
    magnetometer_absent,
    references_not_taken,
    unused_columns,
)
from mwdcal.calibration.diagnosis.flags import listed
from mwdcal.calibration.diagnosis.refusals import MOTION_RANGE
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Finding
from mwdcal.errors import Answer, FitError, InputError, QuestionError, QuestionsError
from mwdcal.estimation.problem import ANGLES
from mwdcal.files.contract import (
    CHANNELS,
    MAPPED,
    RANGES,
    RAW,
    REFERENCE_VECTORS,
    REFERENCES,
    units_of,
)
from mwdcal.files.depths import is_depth
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, WORKBOOKS, looks_numeric, shown
from mwdcal.files.formats.figures import is_figure
from mwdcal.files.formats.layout import NO_READING, WITHOUT_VALUE, Layout, warmth_in
from mwdcal.files.formats.table import Table, cell_error, labels, numbers
from mwdcal.files.formats.table import labels as labels_of
from mwdcal.files.formats.text import is_preamble
from mwdcal.files.formats.title_references import references_in, sensitivity_in
from mwdcal.files.marks import (
    MARKS_NAMED,
    UNMARKED,
    by_legend,
    is_disturbance,
    is_the_repeat,
    marks_in,
    place,
    second_run,
    without_rejected,
)
from mwdcal.files.metadata import toml
from mwdcal.files.profiles import CHOICE_OF_AXES
from mwdcal.files.repeats import Repeats, means, repeats, station_by_angles, tools_in_turn
from mwdcal.files.runs import (
    ANGLES_OF_STAND,
    STATED_REFERENCES,
    check_run,
    filled_down,
    renamed,
    stated_numbers,
    to_readings,
)
from mwdcal.files.statements import stated_table
from mwdcal.files.synonyms import ABOVE, ANTICLOCKWISE, BELOW, FACTORS, OURS, WARMTH
from mwdcal.geometry.circle import resultant
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, Ints, tool_from_earth
from mwdcal.identification.beside import findings_beside, has_roll_test, roll_tests_beside
from mwdcal.identification.columns import (
    MEASURED_BY_TOOL,
    OF_SEVERAL_TOOLS,
    answers_of_north,
    in_units,
    is_computed,
    is_filler,
    is_near,
    is_not_of_tool,
    is_of_surroundings,
    is_of_tool,
    meaning,
    meanings_of,
    none_of,
    north_of,
    proposed,
    shown_beside_set,
    warm_unit,
)
from mwdcal.sensor.profile import ColumnSource, Profile, TableFormat, TriadProfile

# --------------------------------------------------------------------------
# Questions on rows of a table: marked ones, and those with a cell that is no number.


FAR_OUT = 4.0
"""By how much a single reading lies farther out than all others that was mistyped."""
_FEW_ROWS, _FEW_SHARE = 2, 0.15
"""Rows at most that are asked about, and their share."""
_BEYOND = 0.1
"""How far a number of nines lies beyond all others that stands for none, as a share of their range."""
_OFF_NORM = 0.15
"""By how much the norm of its row differs from the others' where it lies among them, as a share."""
_IS_REJECTED = "Is that a rejected station?"
"""The question on a row with a remark."""
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
        f"{table.source}: {place(table, rows[0])}{more}: {shown(name)} says {shown(cell)}. {_IS_REJECTED}",
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


def _question_on_warmth(table: Table, name: str, count: int, cells: Sequence[str]) -> QuestionError:
    """Ask whether a run of which many stations have no temperature does without; their `cells` say what is there."""
    out = tuple(("leave_out", f"{name}={cell}") for cell in cells)
    return QuestionError(
        f"{table.source}: {shown(name)} is blank or no temperature at {count} of {table.count} stations. Is the run to "
        "do without temperature?",
        [none_of(WARMTH), Answer("leave those stations out", out)],
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
        filler = is_filler(values)
        if filler.any():
            filler &= _is_unlike_others(values) | _is_off_norm(raw, column)
        wrong = filler | RANGES[column].outside(values * factor + offset)
        if column in (*RAW, WARMTH) and not np.isnan(values).all():
            wrong |= np.isnan(values)
        if column in RAW:
            wrong |= _far_out(raw, column)
        few = wrong.sum() <= max(_FEW_ROWS, _FEW_SHARE * wrong.size)
        if not wrong.any() or not (few or (column == WARMTH and not wrong.all())):
            continue
        name, rows = columns[column].name, np.flatnonzero(wrong).tolist()
        cells = labels(table, name)
        each = [*dict.fromkeys(cells[row] for row in rows)]
        questions.append(
            question_on_cells(table, name, rows[0], each)
            if few
            else _question_on_warmth(table, name, len(rows), each)
        )
    if questions:
        raise QuestionsError(table.source, questions)


def _is_unlike_others(values: Array) -> Bools:
    """Which values (n,) lie far outside the range of those that do not stand for none, or have more digits."""
    others = values[np.isfinite(values) & ~is_filler(values)]
    if not others.size:
        return np.ones(values.size, bool)
    beyond = _BEYOND * np.ptp(others)
    digits = max(len(f"{value:.12g}".partition(".")[2]) for value in others)
    outside = (values < others.min() - beyond) | (values > others.max() + beyond)
    return np.asarray(outside | (np.round(values, digits) != values))


@np.errstate(over="ignore", invalid="ignore")
def _is_off_norm(values: Mapping[str, Array], column: str) -> Bools:
    """Rows (n,) whose norm is not that of the others, by the triad of a channel; all of any other column."""
    triad = next((t for t in CHANNELS.values() if column in t and {*t} <= {*values}), None)
    if triad is None:
        return np.ones(values[column].size, bool)
    norms = np.linalg.norm([values[name] for name in triad], axis=0)
    usual = np.median(norms[np.isfinite(norms)]) if np.isfinite(norms).any() else np.nan
    return np.asarray(~(np.abs(norms - usual) <= _OFF_NORM * usual))


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


# --------------------------------------------------------------------------
# Which tool axis each channel measures, and its nominal scale, from readings at known attitudes.
#
# Each channel is a straight line of the component of the field along its tool axis, but for misalignment:
# raw = scale · component + offset. Of all 48 signed permutations of a triad the right one leaves a few
# per cent of the channels' variation, any other most of it, unless the attitudes do not tell them apart.

EXPLAINED = 0.3
"""Largest share of the channels' variation that the right axes leave: misalignment, noise, bias."""
ALTERNATIVE = 0.2
"""By how much less they leave than any others."""
LEAST_WITHOUT, LEAST_RATIO = 0.1, 2.0
"""A sign is told where without the component that tells it this share would be left, and so many times as much."""
LEAST_STATIONS = 5


class Wiring(NamedTuple):
    """The axes and scale of a triad, the share that they leave, and others that fit about as well.

    `apart` is the largest scale of a channel as a multiple of the smallest.
    """

    axes: tuple[str, ...]
    scale: float
    unexplained: float
    next_best: float
    alternatives: list[tuple[str, ...]]
    apart: float = 1.0


def wiring(raw: Array, *parts: Array) -> Wiring:
    """The axes of a triad by its raw readings (n, 3) and the field along the tool axes.

    `parts` (n, 3) each: components of the field at right angles to each other, which may come in unknown
    shares; the sign of the first is known. The scale is in raw units per unit of the field.
    Singular: a channel or a component that hardly varies explains nothing; its axis and sign stay open. So does the
    sign where the other component explains the readings as well, as at two inclinations and one azimuth.
    """
    shares, sizes = np.ones((2, 3, 3)), np.zeros((3, 3))
    moved = raw - raw.mean(0)
    spread = np.sqrt(np.mean(moved**2, 0))
    for axis in range(3):
        design = np.stack([part[:, axis] - part[:, axis].mean() for part in parts], -1)
        size = np.sqrt(np.mean(design**2, 0))
        seen = size > 0.02 * np.sqrt(np.mean(np.square(parts), (1, 2)))
        if not seen[0]:
            continue
        columns = design[:, seen]
        slope, share = _line(columns, moved)
        sizes[:, axis] = np.linalg.norm(slope, axis=0)
        alive = spread > 0.02 * spread.max()
        bare = _line(columns[:, 1:], moved)[1]
        signed = (bare > np.maximum(LEAST_WITHOUT, LEAST_RATIO * share)) | (columns.shape[1] == 1)
        for sign in (0, 1):
            right = slope[0] > 0 if sign == 0 else slope[0] < 0
            shares[sign, :, axis] = np.where(alive & (right | ~signed), share, 1.0)
    ranked = sorted(
        (float(np.sqrt(np.mean(shares[signs, range(3), order] ** 2))), order, signs)
        for order in permutations(range(3))
        for signs in product((0, 1), repeat=3)
    )
    if len(parts) == 2 and sum(each[0] < ranked[0][0] + ALTERNATIVE for each in ranked) > 1:
        ranked = sorted((_joint(moved, parts, *each[1:]), *each[1:]) for each in ranked)
    best, order, signs = ranked[0]
    near = [each for each in ranked if each[0] < best + ALTERNATIVE]
    each = sizes[range(3), order]
    apart = float(each.max() / each.min()) if each.min() > 0 else 1.0
    alternatives = [_named(*each[1:]) for each in near]
    return Wiring(
        _named(order, signs), float(np.median(each)), best, ranked[1][0], alternatives, apart
    )


def _joint(
    moved: Array, parts: Sequence[Array], order: tuple[int, ...], signs: tuple[int, ...]
) -> float:
    """The share of all channels' variation that is left with one scale and one share of both components for all.

    Of an unknown dip the components come in the same shares on every axis; the first counts along itself.
    """
    axes, senses = list(order), 1.0 - 2.0 * np.array(signs)
    columns = np.stack([((part - part.mean(0))[:, axes] * senses).ravel() for part in parts], -1)
    slope, share = _line(columns, moved.reshape(-1, 1))
    return float(share[0]) if slope[0, 0] > 0 else 1.0


def _line(columns: Array, moved: Array) -> tuple[Array, Array]:
    """Slopes (K, 3) of the channels on columns (n, K), and the share of their variation that is left (3,).

    Per degree of freedom: few stations do not seem explained by many columns.
    """
    count, width = columns.shape
    slope, *_ = np.linalg.lstsq(columns, moved, rcond=1e-9)
    spread = np.sqrt(np.sum(moved**2, 0) / (count - 1))
    left = np.sqrt(np.sum((moved - columns @ slope) ** 2, 0) / (count - 1 - width))
    return np.asarray(slope), np.asarray(np.minimum(left / np.maximum(spread, 1e-300), 1.0))


def _named(order: tuple[int, ...], signs: tuple[int, ...]) -> tuple[str, ...]:
    return tuple("+-"[sign] + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))


def is_clear(result: Wiring) -> bool:
    """Whether the readings leave no choice of axes."""
    return len(result.alternatives) == 1 and result.unexplained < EXPLAINED


NEEDED = {
    "accelerometer": ("inclination", "toolface"),
    "magnetometer": ("inclination", "azimuth", "toolface"),
}
"""References that tell the axes of a triad."""
UNRELATED = 0.9
"""Readings of which even the best axes leave more than this share have nothing to do with the references."""
SAME_ANGLE = np.radians(1e-4)
"""Inclinations of a stand never agree with raw readings to this, radians."""
LAST_PLACES = (0.1, 0.01, 0.001)
"""Units in the last place of angles, degrees."""
SAME_GRAVITY = 2e-4
"""A local gravity does not differ by more between stations, g; what tools measure does."""
_SELDOM = ("ignore", "azimuth_reference", "declination_deg", "convergence_deg", "leave_out", "keep")
MOST_NAMED = 6
"""Alternatives that a message names."""
MOST_APART = 1.5
"""How many times the smallest scale of a channel the largest of its triad is at most, in a sound tool."""
OFF_UNIT = 0.05
"""By how much the scale of a sound tool in a unit differs from that unit at most, as a logarithm."""


class OpenAxes(NamedTuple):
    """Why the axes of a triad are open, those that fit about as well, and its nominal scale."""

    reason: str
    alternatives: Sequence[tuple[str, ...]]
    scale: float | None


class Proposal(NamedTuple):
    """A profile, how the axes of each triad in it were told, and the run that told.

    `unused` are columns of the table that are nothing of a run file, in words, and `others` their names; `remarks`
    sentences on rows that are left out, `by_value` columns of a run file whose unit no name states; `metadata` what
    the table says of itself; `where` the table was, if it was looked for; `open_axes` the triads of which the run does
    not tell the axes, `ignored` columns that are called as references but hold no references, each with the reason;
    `by_readings` what the names leave open and the readings answer; `source` the name of the file; `all_fit`: no
    station is far from what the others tell; `level`: the least and the largest inclination, degrees, where they are
    too close for a calibration; `said` what the user says of columns and settings, by name.
    """

    profile: Profile
    wirings: dict[str, Wiring]
    stations: int
    unused: tuple[str, ...]
    remarks: tuple[str, ...]
    by_value: set[str]
    metadata: Mapping[str, object]
    run_sha256: str
    where: Layout | None = None
    open_axes: Mapping[str, OpenAxes] = {}
    ignored: Mapping[str, str] = {}
    by_readings: tuple[str, ...] = ()
    source: str = ""
    all_fit: bool = False
    level: tuple[float, float] | None = None
    said: Collection[str] = ()
    others: tuple[str, ...] = ()


def propose(
    path: str | os.PathLike[str] | Table,
    *,
    sheet: str = "",
    header_row: int = 0,
    decimal: str = "",
    answers: Mapping[str, str] | None = None,
    stated: Mapping[str, object] | None = None,
    north: Mapping[str, object] | None = None,
    leave_out: Mapping[str, Sequence[str]] | None = None,
    keep: Mapping[str, Sequence[str]] | None = None,
) -> Proposal:
    """The profile with which a table of stations at known attitudes, a file or one in memory, is a calibration run.

    `sheet`, `header_row` and `decimal` say where the table is and how its numbers are written, `answers` which
    column holds what, or the number of a reference,
    `stated` what the table does not say of the tool, as metadata, `north` what its azimuths count
    from, as metadata too; `leave_out` and `keep` which rows are rejected by the texts of a column, and which are not.

    Raises:
        InputError: the file cannot be read, or is no table of stations.
        FitError: columns and units that names and readings leave open, or readings that no axes explain.
    """
    where, table, form = _table_of(path, sheet, header_row, decimal)
    given = stated_numbers(answers or {}, table.columns)
    names = {column: name for column, name in (answers or {}).items() if column not in given}
    stated = {**(stated or {}), **given}
    table = replace(table, metadata={**table.metadata, **stated, **(north or {})})
    check_columns_of_rows(table, {**(leave_out or {}), **(keep or {})})
    place = {"header_line": header_row} if header_row else {}
    said = {**place, **(north or {}), "leave_out": leave_out or {}, "keep": keep or {}}
    form = _with(form, {key: value for key, value in said.items() if value not in ({}, None)})
    name = table.source if isinstance(path, Table) else Path(path).stem
    with_answers = partial(_proposal, name, where, table, form, stated)
    again = partial(
        propose, path, sheet=sheet, header_row=header_row, decimal=decimal, answers=answers, stated=stated, north=north
    )  # fmt: skip
    try:
        return with_answers(names)
    except (QuestionError, QuestionsError) as error:
        if blank := _cells_without_reading(error, leave_out or {}):
            return again(leave_out=blank, keep=keep)
        if doubtful := _doubtful_rows(error):
            with suppress(InputError, FitError):
                proposal = again(leave_out=leave_out, keep=_with_rows(keep or {}, doubtful))
                if proposal.all_fit and all(is_disturbance(t.partition("=")[2]) for t in doubtful):
                    remarks = (*proposal.remarks, _sentence_on_kept(doubtful))
                    return proposal._replace(remarks=remarks)
                others = again(leave_out=_with_rows(leave_out or {}, doubtful), keep=keep)
                if others.all_fit and not proposal.all_fit:
                    return others
        if by_readings := _answer_by_readings(error, with_answers, names, table):
            return by_readings
        raise


def _table_of(
    source: str | os.PathLike[str] | Table, sheet: str, header_row: int, decimal: str
) -> tuple[Layout | None, Table, TableFormat | None]:
    """Where the table of a file is, the table, and how it is written; the profile of one in memory looks for it."""
    if isinstance(source, Table):
        return None, source, TableFormat(find=True)
    where = tables.laid_out(source, sheet=sheet, header_row=header_row, decimal=decimal)
    return where, *as_written(source, where, bool(sheet or header_row or decimal))


def _questions_of(error: QuestionError | QuestionsError) -> Sequence[QuestionError]:
    return error.questions if isinstance(error, QuestionsError) else (error,)


def _doubtful_rows(error: QuestionError | QuestionsError) -> dict[str, str]:
    """Rows with a remark that may reject them: the words of each question, by COLUMN=TEXT."""
    return {
        text: each.text.partition(": ")[2].partition(f". {_IS_REJECTED}")[0]
        for each in _questions_of(error)
        if _IS_REJECTED in each.text
        for answer in each.answers
        for option, text in answer.arguments
        if option == "keep"
    }


def _with_rows(rows: Mapping[str, Sequence[str]], texts: Iterable[str]) -> dict[str, list[str]]:
    """Rows to keep, or to leave out, by the texts of a column, and those of COLUMN=TEXT besides."""
    every = {name: [*cells] for name, cells in rows.items()}
    for text in texts:
        name, _, cell = text.partition("=")
        every.setdefault(name, []).append(cell)
    return every


def _sentence_on_kept(disturbed: Mapping[str, str]) -> str:
    """The sentence on rows with remarks whose readings fit those of the others."""
    return (
        f"used, as the readings fit those of the others: {'; '.join(disturbed.values())}. If it is to be left out, say "
        f"so by `leave_out` {', '.join(map(repr, disturbed))}."
    )


def _cells_without_reading(
    error: QuestionError | QuestionsError, leave_out: Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Rows to leave out besides, by column, for cells that are blank or say that there is no reading."""
    only = (each.answers[0].arguments for each in _questions_of(error) if len(each.answers) == 1)
    out = list[str]()
    for arguments in only:
        texts = [text for option, text in arguments if option == "leave_out"]
        cells = [text.partition("=")[2] for text in texts]
        if len(texts) == len(arguments) and all(map(_says_no_reading, cells)):
            out += texts
    return _with_rows(leave_out, out) if out else {}


def _says_no_reading(cell: str) -> bool:
    """Whether a cell is blank, says that there is no reading, or is a number of nines that stands for none.

    >>> [_says_no_reading(cell) for cell in ("", "n/a", "S/L", "-999,25", "-9999.00")]
    [True, True, True, True, True]
    >>> [_says_no_reading(cell) for cell in ("#N/A", "0.98x", "991", "see note")]
    [False, False, False, False]
    """
    if WITHOUT_VALUE.fullmatch(cell) or _NINES.fullmatch(cell):
        return True
    return cell[:1] != "#" and bool(NO_READING.fullmatch(cell) or _TWO_LETTERS.fullmatch(cell))


_NINES = re.compile(r"[-−]?9{3,}([.,](0+|9+|25))?")
"""A number that loggers write for a missing reading."""
_TWO_LETTERS = re.compile(r"(?!(?i:[nsewo]\W[nsewo]))[^\W\d_]\W[^\W\d_]\W?")
"""Two letters in place of a number, that are no points of the compass: S/L, k.A."""
_OF_THE_PLACE = tuple(REFERENCES[name].column for name in STATED_REFERENCES)
_WITHOUT_RESULT = "its formulas have no value, as no spreadsheet program has saved them"


def _proposal(
    name: str,
    where: Layout | None,
    table: Table,
    form: TableFormat | None,
    stated: Mapping[str, object],
    answers: Mapping[str, str],
) -> Proposal:
    """The proposal for a table that was read, with what the user says of its columns."""
    whole = table
    table, form, columns, by_value, ignored = named_columns(table, form, where, answers)
    if filled := _with_angles_filled(name, where, (table, whole), columns, form, stated, answers):
        return filled
    _check_serials(where, {*columns, *stated}, table.source)
    _check_choices(where, {*columns, *table.metadata, *answers}, table.source)
    check_cells(table, columns)
    blank = _blank_references(table, columns)
    table, form = with_north(table, form, columns, where.above if where else ())
    denied = [c for c, name in answers.items() if not name and c in table.metadata]
    form = _with(form, {"ignore": (*ignored, *denied)} if ignored or denied else {})
    columns |= _stacked_tools(table, columns, stated, answers)
    table = _of_one_tool(table, columns, stated)
    table = replace(table, remarks=(*table.remarks, *second_run(table)))
    columns |= station_column(table, columns, answers)
    columns |= {c: ColumnSource(name=f"{stated[c]}") for c in _OF_THE_PLACE if c in stated}
    sets = repeats(table, columns)
    if sets and not sets.numbered:
        _check_tools(table, columns, sets, form)
        table = means(table, columns, sets)
        if "group" in columns and len({*labels_of(table, columns["group"].name)}) < 2:
            del columns["group"]  # it tells the readings of a station apart
    profile = Profile(name=name, table=form or msgspec.UNSET, columns=columns)
    said = {*answers, *stated}
    profile, readings, wirings, open_axes = _wired_and_checked(table, profile, by_value, said)
    name, triads = str(readings.metadata.get("serial", name)), _triads(readings, wirings)
    profile = msgspec.structs.replace(profile, name=name, **triads)
    remarks = [*readings.remarks, *blank]
    if sets:
        scales = {kind: triad.scale for kind, triad in triads.items()}
        remarks.append(sets.advice() if sets.numbered else sets.sentence(scales))
    if not sets or sets.labelled:  # a run file's rows without labels are stations each
        profile = _without_the_usual(profile)
    return Proposal(
        profile, wirings, readings.count, readings.unused, tuple(remarks), by_value,
        readings.metadata, readings.run_sha256, where, open_axes, ignored, source=table.source,
        all_fit=_all_fit(readings, wirings), level=_level(readings), said=said,
        others=tuple(n for n in table.columns if n not in {*OURS, *ignored, *(c.name for c in columns.values())}),
    )  # fmt: skip


def _level(readings: Readings) -> tuple[float, float] | None:
    """The ends of inclinations, degrees, that are too close to calibrate the accelerometer along the tool."""
    known = readings.reference("inclination")
    if np.isnan(known).any() or np.ptp(np.cos(known)) >= MOTION_RANGE[0]:
        return None
    return float(np.degrees(known.min())), float(np.degrees(known.max()))


def _check_serials(where: Layout | None, known: Collection[str], source: str) -> None:
    """Ask which serial is that of the tool where sheets of a file state different ones."""
    serials = where.titles.choices.get("serial", ()) if where and "serial" not in known else ()
    if serials:
        every = [str(serial) for serial in serials]
        raise QuestionError(
            f"{source}: its sheets state the serials {' and '.join(map(shown, every))}. Which one is that of the tool?",
            [Answer(serial, (("serial", serial),)) for serial in every],
        )


def _check_choices(where: Layout | None, known: Collection[str], source: str) -> None:
    """Ask about references of which lines beside the table state different values, where nothing else states them."""
    choices = where.titles.choices if where else {}
    magnetic = not {*RAW[3:]}.isdisjoint(known)
    questions = [
        QuestionError(
            f"{source}: lines beside the table state {' and '.join(f'{v:.7g}' for v in values)} as '{column}'. Which "
            "one is that of the stand?",
            [
                *(Answer(f"{v:.7g}", (("column", f"{column}={v!r}"),)) for v in values),
                Answer("none of them: the calibration does without", (("column", f"{column}="),)),
            ],
        )
        for column, values in choices.items()
        if column in _OF_THE_PLACE
        and column not in known
        and (magnetic or column == REFERENCES["gravity"].column)
    ]
    if questions:
        raise QuestionsError(source, questions)


class Named(NamedTuple):
    """A table with the rows that count, how it is written, and its columns by the names of a run file.

    `by_value` and `ignored` as of `Proposal`.
    """

    table: Table
    form: TableFormat | None
    columns: dict[str, ColumnSource]
    by_value: set[str]
    ignored: dict[str, str]


def named_columns(
    table: Table,
    form: TableFormat | None,
    where: Layout | None,
    answers: Mapping[str, str],
    of_run: bool = True,
) -> Named:
    """The columns of a table by their names, units and values; raises as `columns.proposed`.

    Unless the table is `of_run`, rows count of which it is doubtful whether they are rejected; a remark names them.
    """
    formulas = [name for name in table.columns if _is_formulas(labels_of(table, name))]
    table = replace(table, columns={n: c for n, c in table.columns.items() if n not in formulas})
    units_by_name = dict(zip(where.names, where.units, strict=True)) if where else table.units
    names = [*table.columns]
    units = [units_by_name.get(name, "") for name in names]
    above = where.above if where else ()
    table, form, open_rows = _without_rejected(table, form, names, units, above)
    problems: dict[str, QuestionError] = {}
    values = partial(_numbers_of, table, problems)
    columns, by_value, ignored = proposed(
        names, units, values, table.source, above, table.metadata, answers, problems,
        open_rows if of_run else (), of_run,
    )  # fmt: skip
    ignored |= dict.fromkeys(formulas, _WITHOUT_RESULT)
    return Named(table, form, columns, by_value, ignored)


def _with_angles_filled(
    name: str,
    where: Layout | None,
    pair: tuple[Table, Table],
    columns: Mapping[str, ColumnSource],
    form: TableFormat | None,
    stated: Mapping[str, object],
    answers: Mapping[str, str],
) -> Proposal | None:
    """The proposal for a table whose angles are written once filled down, if readings confirm it.

    `pair`: the table as it is judged, and as it was read.
    """
    table, whole = pair
    if once := once_for_setting(table, columns) or written_once(table, columns):
        form = _with(form, {"fill_down": once})
        with suppress(InputError, FitError):
            proposal = _proposal(name, where, filled_down(whole, once), form, stated, answers)
            if _is_confirmed(proposal):
                return proposal
    return None


def _wired_and_checked(
    table: Table, profile: Profile, by_value: Collection[str], answers: Collection[str]
) -> tuple[Profile, Readings, dict[str, Wiring], dict[str, OpenAxes]]:
    """The profile with the axes that readings tell, once nothing that they contradict is left to ask about."""
    assert not isinstance(profile.columns, msgspec.UnsetType)
    columns = profile.columns
    try:
        profile, readings, wirings, open_axes = _wired_by_elevation(table, profile)
    except InputError as error:
        _check_exchanged(table, profile, answers, error)
        raise
    except FitError:
        _ask_gons(table, {c: columns[c] for c in ANGLES_OF_STAND if c in by_value})
        _check_dip(table, profile, answers)
        raise
    _check_dip(table, profile, answers)
    angles = _open_angles(profile, answers)
    _check_gons(table, angles, readings, wirings)
    _check_twins(table, angles, columns, readings, wirings)
    _check_magnetic(table, readings, wirings, columns)
    _check_repeats(table, columns, profile.form)
    return profile, readings, wirings, open_axes


_FIT_EXCHANGED = "The readings fit with"
"""The first words of the question on two angles that are exchanged."""


def _check_exchanged(
    table: Table, profile: Profile, answers: Collection[str], error: InputError
) -> None:
    """Ask whether the inclination is exchanged with another angle, where an error is gone and gravity fits then."""
    columns = profile.columns or {}
    inclination, *others = ANGLES_OF_STAND
    for other in others:
        if not {inclination, other} <= {*columns} - {*answers}:
            continue
        pair = {inclination: columns[other], other: columns[inclination]}
        exchanged = msgspec.structs.replace(profile, columns={**columns, **pair})
        result = None
        with suppress(FitError, InputError):
            result = _wired(table, exchanged)[2].get("accelerometer")
        if result and result.unexplained < _CONFIRMED:
            names = " and ".join(shown(columns[column].name) for column in pair)
            said = tuple(("column", f"{column}={each.name}") for column, each in pair.items())
            answer = Answer("they are exchanged", said)
            raise QuestionError(f"{error} {_FIT_EXCHANGED} {names} exchanged.", [answer])


def _is_formulas(cells: Sequence[str]) -> bool:
    """Whether all cells that are filled in are formulas without a value."""
    filled = [*filter(None, cells)]
    return bool(filled) and all(cell.startswith("=") and len(cell) > 1 for cell in filled)


# An answer that the readings give: at known attitudes the right columns and units of angles and channels leave a few
# per cent of the channels' variation unexplained, wrong ones most of it.

_OF_READINGS = (*RAW, *(REFERENCES[name].column for name in ("inclination", "azimuth", "toolface")))
"""Columns that readings tell."""
_LONGEST_LETTER = 2
"""Characters of the letter or number of a series of rolls."""
_MOST_TRIES, _MOST_COMBINED = 40, 100_000
"""Answers to open questions, in combinations that name no column twice, that are tried, and those looked at."""
_CONFIRMED = 0.1
"""Largest share of the channels' variation that answers leave which readings confirm."""
_ANGLE_UNITS = (180 / np.pi, 0.9)
"""Degrees of a radian and of a gon."""
_SPREAD = 0.97
"""Length of the mean direction of a column above which it hardly turns: 14° of scatter."""
_ONE_ANGLE = 0.999
"""Length of the mean direction of differences of two columns above which they tell one angle: 2.6° of scatter."""


def _answer_by_readings(
    error: QuestionError | QuestionsError,
    propose_with: Callable[[Mapping[str, str]], Proposal],
    said: Mapping[str, str],
    table: Table,
) -> Proposal | None:
    """The proposal by the only answers to open questions that the readings fit; None where others fit, or none do.

    None too where another answer is a column of the same angle, in whatever unit, sense or zero: it may be that of
    the stand, and the one that fits that of the tool.
    """
    questions = _questions_of(error)
    choices = [
        [answer for answer in each.answers if _is_of_readings(answer, each)] for each in questions
    ]
    if not all(choices) or prod(map(len, choices)) > _MOST_COMBINED:
        return None
    fits, tries = [], [*filter(_is_of_different_columns, product(*choices))]
    for chosen in tries if len(tries) <= _MOST_TRIES else ():
        answers = dict(said) | dict(_columns_of(chosen))
        with suppress(InputError, FitError):
            proposal = propose_with(answers)
            if _is_confirmed(proposal):
                fits.append((proposal, chosen))
    if len(fits) != 1:
        return None
    proposal, chosen = fits[0]
    columns = proposal.profile.columns or {}
    sensed = {each.name for column, each in columns.items() if column in RAW}
    nominal = {name for name, _, _ in shown_beside_set([*table.columns])}
    aside = sensed | nominal | {name for name in table.columns if is_computed(name)}
    beside = [name for name in table.columns if name not in aside]
    if any(_has_twin(table, text, beside) for answer in chosen for _, text in answer.arguments):
        return None
    texts = [", ".join(text for _, text in answer.arguments) for answer in chosen]
    return proposal._replace(by_readings=tuple(texts))


def _is_confirmed(proposal: Proposal) -> bool:
    """Whether the readings tell the axes of all triads, and leave little of their variation."""
    unexplained = [each.unexplained for each in proposal.wirings.values()]
    return not proposal.open_axes and max(unexplained, default=1.0) < _CONFIRMED


def written_once(table: Table, columns: Mapping[str, ColumnSource]) -> tuple[str, ...]:
    """Angles of the stand that may be written once for a series of rolls: filled in above blanks, beside toolfaces."""
    *directions, roll = ANGLES_OF_STAND
    rolls = labels_of(table, columns[roll].name) if roll in columns else [""]
    names = [columns[each].name for each in directions if each in columns]
    cells = {name: labels_of(table, name) for name in names}
    return tuple(
        name
        for name, each in cells.items()
        if all(rolls) and each[0] and each.count("") > _FEW_SHARE * len(each)
    )


def once_for_setting(table: Table, columns: Mapping[str, ColumnSource]) -> tuple[str, ...]:
    """Angles and labels that are written once for all readings of a setting: the rows below, filled, are such."""
    names = [columns[c].name for c in ("station", *ANGLES_OF_STAND) if c in columns]
    blank = {name: np.array([not cell for cell in labels_of(table, name)]) for name in names}
    once = {n: each for n, each in blank.items() if not each[0] and each.mean() > _FEW_SHARE}
    last = next((each for n in (names[-1:] + names[:1]) if (each := once.get(n)) is not None), None)
    if last is None or any((last & ~each).any() for each in once.values()):
        return ()
    sets = repeats(filled_down(table, once), columns)
    return tuple(once) if sets and np.array_equal(sets.starts, np.flatnonzero(~last)) else ()


def station_column(
    table: Table, columns: Mapping[str, ColumnSource], answers: Mapping[str, str]
) -> dict[str, ColumnSource]:
    """The column of stations that the angles of the stand tell, where none has a name that tells those apart."""
    named = columns["station"].name if "station" in columns else ""
    cells = labels_of(table, named)
    if "station" in answers or len({*cells}) < len(cells):
        return {}
    name = station_by_angles(table, columns)
    return {"station": ColumnSource(name=name)} if name else {}


def _columns_of(answers: Iterable[Answer]) -> Iterator[tuple[str, str]]:
    """Columns of a run file with the column of the table that answers say."""
    for _, text in (argument for answer in answers for argument in answer.arguments):
        column, _, name = text.partition("=")
        yield column, name


def _is_of_different_columns(answers: Sequence[Answer]) -> bool:
    """Whether answers name no column of the table twice."""
    names = [name for _, name in _columns_of(answers)]
    return len({*names}) == len(names)


def _has_twin(table: Table, answer: str, names: Collection[str]) -> bool:
    """Whether another of some columns follows the angle of an answer but for unit, sense and zero."""
    column, _, name = answer.partition("=")
    if column not in ANGLES_OF_STAND:
        return False
    columns = {}
    for each in names:
        with suppress(InputError):  # of text
            columns[each] = numbers(table, each)
    taken = max((each for each in columns if name.startswith(each)), key=len, default=None)
    if taken is None:
        return False
    turns = [unit * columns[taken] for unit in (1.0, *_ANGLE_UNITS)]
    return any(
        _alike(turned - factor * values) > _ONE_ANGLE
        for turned in turns
        if _alike(turned) < _SPREAD
        for other, values in columns.items()
        for unit in (1.0, *_ANGLE_UNITS)
        for factor in (unit, -unit)
        if other != taken and np.isfinite(values).any()
    )


def _alike(angles: Array) -> float:
    """Length of the mean direction of angles in degrees: 1 where all are one."""
    return float(abs(resultant(np.radians(angles[np.isfinite(angles)]))))


def _is_of_readings(answer: Answer, question: QuestionError) -> bool:
    """Whether an answer names columns that the readings tell; of azimuths they tell the north as well.

    Angles that the tool itself may have measured fit its readings whatever the stand shows, and the channels of each
    of several tools fit.
    """
    if any(
        words in question.text for words in (MEASURED_BY_TOOL, OF_SEVERAL_TOOLS, _FIT_EXCHANGED)
    ):
        return False
    pairs = [text.partition("=") for argument, text in answer.arguments if argument == "column"]
    return len(pairs) == len(answer.arguments) and all(
        name and column in _OF_READINGS for column, _, name in pairs
    )


def _blank_references(table: Table, columns: Mapping[str, ColumnSource]) -> list[str]:
    """A sentence on angles of the stand that are blank at some stations, which are used without them."""
    cells, many = [], []
    for column in ANGLES_OF_STAND:
        if column in columns:
            values = numbers(table, columns[column].name)
            rows = np.flatnonzero(np.isnan(values)).tolist()
            few = len(rows) <= _FEW_SHARE * values.size
            cells += [f"{place(table, row)} ({shown(columns[column].name)})" for row in rows if few]
            many += [
                f"{len(rows)} of {values.size} stations have no {shown(columns[column].name)}: it is unknown there."
            ] * (not few)
    if cells:
        many.append(
            f"blank angles of the stand are unknown at their stations: {listed(cells, MARKS_NAMED)}."
        )
    return many


def _with(form: TableFormat | None, fields: Mapping[str, Any]) -> TableFormat | None:
    """How tables are written, with more of it; without it as documented."""
    return msgspec.structs.replace(form or TableFormat(find=True), **fields) if fields else form


def with_north(
    table: Table,
    form: TableFormat | None,
    columns: Mapping[str, ColumnSource],
    above: Sequence[str],
) -> tuple[Table, TableFormat | None]:
    """The table and its form with the north of its azimuths, where names and a declination above it tell it."""
    azimuth = columns.get(REFERENCES["azimuth"].column)
    if azimuth is None or "azimuth_reference" in table.metadata:
        return table, form
    north = north_of(azimuth.name, above, table.metadata)
    if not north:
        return table, form
    metadata = {**table.metadata, "azimuth_reference": north}
    return replace(table, metadata=metadata), _with(form, {"azimuth_reference": north})


_WORDS_OF_TOOLS = re.compile(
    r"s[eé]rie|serial|s/?n\b|tool|probe|sond[ea]|ger[äa]t|instrument|equip|ferram|herram|verkt(ø|oe?)y|matr[ií]c|"
    r"\balat\b|\balet\b|\bcihaz|прибор|зонд|зав|仪器|探管|编号",
    re.IGNORECASE,
)
"""Words of a column that may tell several tools apart."""


def _stacked_tools(
    table: Table,
    columns: Mapping[str, ColumnSource],
    stated: Mapping[str, object],
    answers: Collection[str],
) -> dict[str, ColumnSource]:
    """The column of serials in whatever words: of which one is stated; of several tools it is asked."""
    if "serial" in columns or "serial" in answers:
        return {}
    used = {each.name for each in columns.values()}
    for name in (each for each in table.columns if each not in used):
        cells = [*filter(None, labels_of(table, name))]
        tools = Counter(cells)
        if len(tools) < 2 or len(cells) < table.count:
            continue
        if stated.get("serial") in tools:
            return {"serial": ColumnSource(name=name)}
        many = min(tools.values()) >= LEAST_STATIONS and _WORDS_OF_TOOLS.search(name)
        if "serial" in table.metadata and max(map(len, tools)) <= _LONGEST_LETTER:
            continue  # series of one tool
        stacked = len([*groupby(cells)]) == len(tools)
        numbered = _numbers_of(table, {}, name) is not None
        anew = stacked and not meaning(name) and _begins_again(table, cells)
        if many and (anew or not numbered):
            raise QuestionError(
                f"{table.source}: {shown(name)} has {', '.join(map(shown, [*tools][:MOST_NAMED]))}. Are these tools, "
                "and which one is meant?",
                [
                    *(Answer(tool, (("serial", tool),)) for tool in tools),
                    Answer("it is one tool", (("column", "serial="),)),
                ],
            )
    return {}


def _begins_again(table: Table, tools: Sequence[str]) -> bool:
    """Whether a column numbers the stations of each of some tools, one below the other, from the same number on."""
    starts = [k for k, tool in enumerate(tools) if k == 0 or tool != tools[k - 1]]
    for name in table.columns:
        numbers = _numbers_of(table, {}, name)
        if numbers is not None and np.isfinite(numbers).all():
            blocks = np.split(numbers, starts[1:])
            if all(np.array_equal(b, blocks[0][0] + np.arange(len(b))) for b in blocks):
                return True
    return False


def _of_one_tool(
    table: Table, columns: Mapping[str, ColumnSource], stated: Mapping[str, object]
) -> Table:
    """The rows of one tool, by the serial that the user says where there are several."""
    column = columns["serial"].name if "serial" in columns else "serial"
    tools = [*dict.fromkeys(filter(None, labels_of(table, column)))]
    serial = str(stated.get("serial", ""))
    if len(tools) > 1 and not serial:
        raise QuestionError(
            f"{table.source} has rows of {len(tools)} tools ({', '.join(map(shown, tools[:MOST_NAMED]))}). Which one "
            "is meant?",
            [Answer(tool, (("serial", tool),)) for tool in tools],
        )
    return stated_table(table, {"serial": serial} if len(tools) > 1 else {}, column)


def _without_rejected(
    table: Table,
    form: TableFormat | None,
    names: Sequence[str],
    units: Sequence[str],
    above: Sequence[str],
) -> tuple[Table, TableFormat | None, list[QuestionError]]:
    """The rows of a table that are not marked as rejected, its form, and a question on each mark that is not plain."""
    meanings = meanings_of(names, units)
    used = [n for n, m in meanings.items() if m.column in UNMARKED]
    form = by_legend(table, form, used, above) if form else form
    marks = marks_in(table, form or TableFormat(), used)
    questions = [
        question_on_mark(table, name, cell, rows)
        for (name, cell), rows in marks.doubtful.items()
        if not all(is_the_repeat(table, row, cell) for row in rows)
    ]
    return without_rejected(table, form or msgspec.UNSET, used), form, questions


def _numbers_of(table: Table, problems: dict[str, QuestionError], name: str) -> Array | None:
    """The numbers of a column; None where it has none, with the problem where most of its cells are numbers."""
    try:
        return tables.numbers(table, name)
    except InputError:
        cells = labels_of(table, name)
        wrong = [
            cell for cell in dict.fromkeys(cells) if cell and not looks_numeric(cell, table.decimal)
        ]
        if wrong and 2 * sum(map(is_figure, cells)) > table.count:
            problems[name] = question_on_cells(table, name, cells.index(wrong[0]), wrong)
        elif wrong and 2 * sum(any(map(str.isdecimal, cell)) for cell in cells) > table.count:
            called = meaning(name)
            if called and called.column in _OF_READINGS:
                problems[name] = QuestionError(
                    f"{table.source}: {shown(name)} is called '{called.column}', and its cells, such as "
                    f"{shown(wrong[0])}, are no numbers that are understood. Write them as numbers in another column.",
                    [none_of(called.column)],
                )
        return None


def _triads(readings: Readings, wirings: Mapping[str, Wiring]) -> dict[str, TriadProfile]:
    """The triads of a profile: axes, and scales but for that of a magnetometer without a field strength."""
    scales = {kind: _rounded(result.scale) for kind, result in wirings.items()}
    if readings.relative:
        scales["magnetometer"] = None
    return {
        kind: TriadProfile(axes=result.axes, scale=scales[kind])  # type: ignore[arg-type]
        for kind, result in wirings.items()
    }


def _wired(
    table: Table, profile: Profile
) -> tuple[Profile, Readings, dict[str, Wiring], dict[str, OpenAxes]]:
    """The readings of a table by a profile, the axes of its triads, and the triads whose axes are open.

    An elevation may count upwards or downwards: the sense is the one by which the channels are a right-handed set.
    """
    run = renamed(table, profile)
    check_run(run)
    readings, scaled = to_readings(run, profile)
    columns = profile.columns
    assert not isinstance(columns, msgspec.UnsetType)
    _check_gravity(readings, columns)
    _check_half_turns(run, readings, columns)
    wirings, open_axes = _wirings(run, readings, scaled)
    if "magnetometer" in open_axes:
        _check_sense(run, readings, scaled, columns)
    inclination = columns.get(REFERENCES["inclination"].column)
    elevated = bool(wirings and inclination and inclination.unit == ABOVE)
    if inclination and elevated and all(is_left_handed(each.axes) for each in wirings.values()):
        below = {
            **columns,
            REFERENCES["inclination"].column: ColumnSource(name=inclination.name, unit=BELOW),
        }
        return _wired(table, msgspec.structs.replace(profile, columns=below))
    return profile, readings, wirings, open_axes


def _wired_by_elevation(
    table: Table, profile: Profile
) -> tuple[Profile, Readings, dict[str, Wiring], dict[str, OpenAxes]]:
    """The same, with an elevation that counts downwards where the readings fit no other."""
    columns, name = profile.columns, REFERENCES["inclination"].column
    assert not isinstance(columns, msgspec.UnsetType)
    elevated = name in columns and columns[name].unit == ABOVE
    try:
        result = _wired(table, profile)
        if not elevated or not result[3]:
            return result
    except FitError:
        if not elevated:
            raise
    below = {**columns, name: ColumnSource(name=columns[name].name, unit=BELOW)}
    return _wired(table, msgspec.structs.replace(profile, columns=below))


def _open_angles(profile: Profile, answers: Collection[str]) -> dict[str, ColumnSource]:
    """The angles of the stand in degrees or gons, but for those that the user has named."""
    columns = profile.columns
    assert not isinstance(columns, msgspec.UnsetType)
    return {
        column: source
        for column in ANGLES_OF_STAND
        if column not in answers
        and (source := columns.get(column))
        and source.unit in ("", "°", "gon")
    }


def _check_gons(
    table: Table,
    of_stand: Mapping[str, ColumnSource],
    readings: Readings,
    wirings: Mapping[str, Wiring],
) -> None:
    """Ask about an angle of the stand in degrees that the readings fit far better in gons, or the other way."""
    for column, source in of_stand.items():
        units = ["°", "gon"] if source.unit == "gon" else ["gon", "°"]
        angles = numbers(table, source.name)
        left = [
            _left(readings, wirings, {column: angles * FACTORS.get(unit, (1.0,))[0]})
            for unit in units
        ]
        if left[0] < _FAR_BETTER * left[1]:
            raise QuestionError(
                f"{table.source}: the readings fit {shown(source.name)} far better in {units[0]} than in {units[1]}. "
                "Which unit holds?",
                in_units(source.name, column, units),
            )


def _ask_gons(table: Table, of_stand: Mapping[str, ColumnSource]) -> None:
    """Ask about angles that are in gons by a line above the table, where the readings do not fit them."""
    if questions := [
        QuestionError(
            f"{table.source}: {shown(source.name)} is in gons by a line above the table, and the readings do not fit "
            "it. Which unit holds?",
            in_units(source.name, column, ("°", "gon")),
        )
        for column, source in of_stand.items()
        if source.unit == "gon"
    ]:
        raise QuestionsError(table.source, questions)


_FAR_BETTER = 0.5
"""Share of what an angle leaves of the readings that the right one, or the right unit, leaves at most."""


def _check_twins(
    table: Table,
    of_stand: Mapping[str, ColumnSource],
    columns: Mapping[str, ColumnSource],
    readings: Readings,
    wirings: Mapping[str, Wiring],
) -> None:
    """Ask about an angle of the stand beside which another column tells the same and fits the readings far better.

    One may be what the stand was set to, the other what it shows. A column that is called measured or computed is
    the tool's.
    """
    used = {source.name for source in columns.values()}
    numbered = {n: v for n in table.columns if (v := _plain_numbers(table, n)) is not None}
    tried: dict[str, list[str]] = {}
    for column, source in of_stand.items():
        if source.unit == "gon" or source.name not in numbered:
            continue
        twins = [
            n
            for n, v in numbered.items()
            if n not in used
            and not is_of_tool(n)
            and _alike(v - numbered[source.name]) > _ONE_ANGLE
        ]
        tried[column] = [source.name, *twins][:_MOST_TWINS]
    if not wirings or all(len(each) < 2 for each in tried.values()):
        return
    left = {
        names: _left(readings, wirings, {c: numbered[n] for c, n in zip(tried, names, strict=True)})
        for names in product(*tried.values())
    }
    stand, best = next(iter(left)), min(left, key=lambda names: left[names])
    if left[best] < _FAR_BETTER * left[stand]:
        questions = [
            QuestionError(
                f"{table.source}: {shown(one)} and {shown(other)} tell one angle, and the readings fit the former far "
                "better. Which one does the stand show?",
                [Answer(n, (("column", f"{column}={n}"),)) for n in (one, other)],
            )
            for column, one, other in zip(tried, best, stand, strict=True)
            if one != other
        ]
        raise QuestionsError(table.source, questions)


_MOST_TWINS = 3
"""Columns of one angle that are compared."""


def _plain_numbers(table: Table, name: str) -> Array | None:
    """The numbers of a column; None where a cell has none."""
    with suppress(InputError):
        values = numbers(table, name)
        return values if np.isfinite(values).all() else None
    return None


def _left(readings: Readings, wirings: Mapping[str, Wiring], angles: Mapping[str, Array]) -> float:
    """The share of a triad's readings that angles of the stand leave, with any offsets and gains of its axes.

    Offsets and gains may change with temperature.
    """
    kind = "magnetometer" if REFERENCES["azimuth"].column in angles else "accelerometer"
    if kind not in wirings:
        return 1.0
    known = {c.removeprefix("ref_").removesuffix("_deg"): np.radians(v) for c, v in angles.items()}
    turned = replace(readings, known={**readings.known, **known})
    parts, raw = _regressors(turned, kind)
    if len(raw) < _MOST_COLUMNS * parts.shape[-1]:
        return 1.0
    return float(np.sqrt(np.mean(_line(parts - parts.mean(0), raw - raw.mean(0))[1] ** 2)))


def _regressors(readings: Readings, kind: str, warm: bool = True) -> tuple[Array, Array]:
    """Regressors (n, K) of the readings of a triad at stations of known attitude, and the readings (n, 3).

    `warm`: on temperature too.
    """
    whole = np.all([~np.isnan(readings.reference(n)) for n in NEEDED[kind]], 0)
    parts = np.concatenate(_parts(kind, readings, whole), -1)
    if warm and readings.temperature is not None:
        warmth = readings.temperature[whole, None]
        if np.ptp(warmth) > 0 and np.isfinite(warmth).all():
            parts = np.concatenate([parts, warmth, (warmth - warmth.mean()) * parts], -1)
    return parts, getattr(readings, kind)[whole]


def _all_fit(readings: Readings, wirings: Mapping[str, Wiring]) -> bool:
    """Whether no reading lies far from the line of all, by the median of the distances, and all stations tell.

    The distances are those of each reading from the line, divided by how much less they scatter as it pulls the line.
    """
    for kind in wirings:
        parts, raw = _regressors(readings, kind)
        if len(raw) < _MOST_COLUMNS * (parts.shape[-1] + 1):
            parts, raw = _regressors(readings, kind, warm=False)
        design = np.column_stack([parts - parts.mean(0), np.ones(len(parts))])
        if len(raw) < readings.count or len(raw) < _MOST_COLUMNS * design.shape[-1]:
            return False
        basis = np.linalg.qr(design)[0]
        left = raw - basis @ (basis.T @ raw)
        free = np.sqrt(np.maximum(1 - np.sum(basis**2, -1), 1e-9))[:, None]
        usual = np.median(np.abs(left / free), 0) / _MEDIAN_OF_NORMAL
        if np.any(np.abs(left / free) > _FAR_OFF * usual):
            return False
    return bool(wirings)


_MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a normal variable of variance 1."""
_FAR_OFF = 5.0
"""Standard deviations beyond which a reading does not fit the others."""


_MOST_COLUMNS = 2
"""Stations for each column that is fitted, at least."""
_ANOTHER_NORTH = 2.0
"""By how much the north of azimuths differs from that of the readings where it is another, degrees."""


def field_direction(readings: Readings, wirings: Mapping[str, Wiring]) -> tuple[float, float]:
    """Magnetic north and dip by the readings: azimuth from where the azimuths of the stand count, and dip, in degrees.

    Definition: direction of the field fitted to the magnetometers, each with an offset and a gain of its own. NaN where
    the attitudes do not tell its parts on any axis.
    """
    if "magnetometer" not in wirings or readings.magnetometer is None:
        return np.nan, np.nan
    angles = [readings.reference(name) for name in NEEDED["magnetometer"]]
    whole = np.all([~np.isnan(angle) for angle in angles], 0)
    permutation = TriadProfile(axes=wirings["magnetometer"].axes).permutation  # type: ignore[arg-type]
    field = (readings.magnetometer @ permutation.transpose())[whole]
    turn = tool_from_earth(*(angle[whole] for angle in angles))
    field, turn = field - field.mean(0), turn - turn.mean(0)
    seen = [axis for axis in range(3) if np.linalg.cond(turn[:, axis]) < _SINGULAR]
    if not seen:
        return np.nan, np.nan
    parts = [np.linalg.lstsq(turn[:, axis], field[:, axis], rcond=None)[0] for axis in seen]
    north, east, down = np.sum(parts, 0)
    azimuth, dip = np.arctan2(east, north), np.arctan2(down, np.hypot(north, east))
    return float(np.degrees(azimuth)), float(np.degrees(dip))


_SINGULAR = 20.0
"""Ratio of the best to the least determined part of a field above which attitudes do not tell it."""


def _check_magnetic(
    table: Table,
    readings: Readings,
    wirings: Mapping[str, Wiring],
    columns: Mapping[str, ColumnSource],
) -> None:
    """Ask about azimuths that by the readings count from another north than magnetic, where no one says which."""
    azimuth = columns.get(REFERENCES["azimuth"].column)
    seen, _ = field_direction(readings, wirings) if azimuth else (0.0, 0.0)
    if not azimuth or "azimuth_reference" in table.metadata or not abs(seen) > _ANOTHER_NORTH:
        return
    raise QuestionError(
        f"{table.source}: by the readings magnetic north is at {seen:.1f}° of {shown(azimuth.name)}. From which north "
        "does it count, and what is the declination, degrees east?",
        answers_of_north(),
    )


_ANOTHER_DIP = 3.0
"""By how much a dip that is stated differs from that of the readings where it is of another place, degrees."""
_OPPOSITE_DIP = "Either all azimuths of the stand are 180° off, or the sign of the dip is wrong."


def _check_dip(table: Table, profile: Profile, answers: Collection[str]) -> None:
    """Ask about a dip that differs from the one by the readings, with axes found without it."""
    column, columns = REFERENCES["dip"].column, profile.columns
    assert not isinstance(columns, msgspec.UnsetType)
    named = columns.get(column)
    if column in answers or not (named or column in table.metadata):
        return
    form = profile.form
    without = msgspec.structs.replace(
        profile,
        columns={c: source for c, source in columns.items() if c != column},
        table=_with(form, {"ignore": (*form.ignore, named.name if named else column)}),
    )
    dips = numbers(renamed(table, profile), column)
    if np.isnan(dips).all():
        return
    seen, stated = np.nan, float(np.nanmedian(dips))
    with suppress(FitError, InputError):
        _, readings, wirings, open_axes = _wired_by_elevation(table, without)
        _, seen = field_direction(readings, {} if open_axes else wirings)
    if abs(seen - stated) > _ANOTHER_DIP:
        where = shown(named.name) if named else "a line above the table"
        turned = abs(seen + stated) < _ANOTHER_DIP
        question = _OPPOSITE_DIP if turned else "Is the latter that of another place or sign?"
        raise QuestionError(
            f"{table.source}: by the readings the dip is {seen:.1f}°, and by {where} {stated:.1f}°. {question} Correct "
            f"{'the wrong one' if turned else 'a wrong sign'} in the table; a blank answer leaves the dip out, and the "
            "calibration finds it.",
            [
                Answer(
                    "yes, leave it out: the calibration finds the dip", (("column", f"{column}="),)
                )
            ],
        )


_APART, _WARMER = 0.005, 3.0
"""By how much readings at one attitude differ of which one is bad, as a share, and temperatures that explain it, °C."""


def _check_repeats(table: Table, columns: Mapping[str, ColumnSource], form: TableFormat) -> None:
    """Ask which of two rows counts that follow each other at one attitude and differ by more than noise.

    Where more rows are repeated, all count. Rows are told apart by a column of labels or times.
    """
    angles = [columns[c].name for c in ANGLES_OF_STAND if c in columns]
    channels = [columns[c].name for c in CHANNELS["accelerometer"] if c in columns]
    if len(angles) < 2 or REFERENCES["toolface"].column not in columns or len(channels) < 3:
        return
    stand, raw = (np.stack([numbers(table, n) for n in names], -1) for names in (angles, channels))
    same = np.all(stand[1:] == stand[:-1], -1)
    if WARMTH in columns:
        same &= np.abs(np.diff(numbers(table, columns[WARMTH].name))) <= _WARMER
    apart = np.linalg.norm(np.diff(raw, axis=0), axis=-1)
    apart /= np.linalg.norm(raw - raw.mean(0), axis=-1).max()
    rows = np.flatnonzero(same & (apart > _APART)).tolist()
    if not rows or same.sum() > _FEW_ROWS:
        return
    row, measured = rows[0], {s.name for c, s in columns.items() if c not in LABELS}
    texts = {n: labels_of(table, n) for n in table.columns if n not in measured}
    labels = (n for n, each in texts.items() if len({*each}) == len(each))
    name = next(labels, "")
    one, two = (texts[name][k] if name else "" for k in (row, row + 1))
    if not name or {one, two} & {*form.keep.get(name, ())}:
        return
    raise QuestionError(
        f"{table.source}: {place(table, row)} and {place(table, row + 1)} are at one attitude, and their readings "
        f"differ by {apart[row]:.1%}. Which counts?",
        [
            Answer("the second", (("leave_out", f"{name}={one}"),)),
            Answer("the first", (("leave_out", f"{name}={two}"),)),
            Answer("both", (("keep", f"{name}={one}"),)),
        ],
    )


def _check_tools(
    table: Table, columns: Mapping[str, ColumnSource], sets: Repeats, form: TableFormat | None
) -> None:
    """Ask which tool is meant where the readings at each setting are of several by a column."""
    apart = tools_in_turn(table, columns, sets)
    if not apart or (form and apart[0] in form.keep):
        return
    name, texts = apart
    tools = [
        Answer(text, tuple(("leave_out", f"{name}={other}") for other in texts if other != text))
        for text in texts
    ]
    raise QuestionError(
        f"{table.source}: the readings at each setting of the stand differ by {shown(name)} "
        f"({listed(texts, len(texts))}) as those of several tools do. Which one is meant?",
        [*tools, Answer("all are of one tool", (("keep", f"{name}={texts[0]}"),))],
    )


def as_written(
    path: str | os.PathLike[str], where: Layout | None, placed: bool
) -> tuple[Table, TableFormat | None]:
    """The table of a file, and how a profile says it is written: not at all where it is written as documented.

    Where neither that nor a fixed place gives the table of the layout, it is to be looked for whenever it is read, and
    so is that of a workbook.
    """
    if where is None:
        return tables.read(path), None
    labels = {
        name for name, m in meanings_of(where.names, where.units).items() if m.column in LABELS
    }
    table = tables.of_layout(where, path, labels)
    workbook = Path(path).suffix.lower() in WORKBOOKS
    forms = [None] if workbook else [None, where.form]
    if placed or where.parts or (workbook and not {*CHANNELS["accelerometer"]} <= {*where.names}):
        forms = []  # a workbook is read twice, which takes seconds, only where it may be a run file
    for form in forms:
        if form or _is_documented(path, where):
            with suppress(InputError):
                plain = tables.read(path, export=form)
                if _same(plain, table):
                    return plain, form
    form = TableFormat(find=True)
    if placed:
        form = msgspec.structs.replace(form, sheet=where.sheet, decimal=where.form.decimal)
    return table, form


def _is_documented(path: str | os.PathLike[str], where: Layout) -> bool:
    """Whether a table, but for the names of its columns, may be written as a run file is."""
    form = where.form
    usual = {".csv": ",", ".tsv": "\t"}.get(Path(path).suffix.lower(), form.delimiter)
    below = form.first_line == form.header_line + 1
    return (
        below
        and form.delimiter == usual
        and form.decimal == "."
        and all(map(is_preamble, where.above))
    )


def _same(one: Table, other: Table) -> bool:
    """Whether two tables have the same columns, rows and metadata."""
    if [*one.columns] != [*other.columns] or [*one.lines] != [*other.lines]:
        return False
    if not set(other.metadata) <= set(one.metadata):
        return False
    return all(_cells(one, name) == _cells(other, name) for name in one.columns)


def _cells(table: Table, name: str) -> tuple[bool, list[str]]:
    """Whether a column is of numbers, and its cells, numbers in their shortest form."""
    try:
        return True, [repr(value) for value in tables.numbers(table, name).tolist()]
    except InputError:
        return False, labels_of(table, name)


def _rounded(scale: float) -> float | None:
    """Four digits: a nominal scale says no more."""
    return float(f"{scale:.4g}")


def _without_the_usual(profile: Profile) -> Profile:
    """The profile without what it would say of a table that is a run file already."""
    columns = profile.columns
    assert not isinstance(columns, msgspec.UnsetType)
    usual = all(
        c == each.name and each.unit in ("", *units_of(c)[:1]) for c, each in columns.items()
    )
    is_run_file = usual and isinstance(profile.table, msgspec.UnsetType)
    return msgspec.structs.replace(profile, columns=msgspec.UNSET) if is_run_file else profile


def _wirings(
    run: Table, readings: Readings, scaled: Profile
) -> tuple[dict[str, Wiring], dict[str, OpenAxes]]:
    """The axes of the triads that the run has, and why those of others are open; `scaled` has their scales."""
    known = {name: readings.reference(name) for name in NEEDED["magnetometer"]}
    if readings.count < LEAST_STATIONS:
        raise FitError(
            f"{run.source}: a profile is proposed for at least {LEAST_STATIONS} stations whose readings vary; got "
            f"{readings.count}. Measure more stations."
        )
    still = [n for n in CHANNELS["accelerometer"] if not np.ptp(tables.numbers(run, n))]
    if still:
        raise FitError(
            f"{run.source}: no change in {' and '.join(still)} of the accelerometer: the same value at all "
            f"{readings.count} stations. A dead sensor, a wrong column, or one attitude: check wiring and columns."
        )
    results: dict[str, Wiring] = {}
    open_axes: dict[str, OpenAxes] = {}
    for kind in TRIADS:
        if getattr(readings, kind) is None:
            continue
        scale = (
            _rounded(getattr(scaled, kind).scale)
            if kind != "magnetometer" or not readings.relative
            else None
        )
        absent = [name for name in NEEDED[kind] if np.isnan(known[name]).all()]
        whole = np.all([~np.isnan(known[name]) for name in NEEDED[kind]], 0)
        if absent or whole.sum() < LEAST_STATIONS:
            open_axes[kind] = OpenAxes(_lacking(kind, absent, int(whole.sum())), (), scale)
            continue
        raw = np.stack([tables.numbers(run, name) for name in CHANNELS[kind]], -1)[whole]
        result = wiring(raw, *_parts(kind, readings, whole))
        if is_clear(result):
            results[kind] = result
            _check_independent(readings, results)
            continue
        pair = " and ".join(_exchanged_angles(kind, raw, readings, whole))
        remedy = f" They fit with {pair} exchanged: exchange them by `column`." if pair else ""
        if len(result.alternatives) == 1 or result.unexplained > UNRELATED:
            raise FitError(f"{run.source}: {_unexplained(kind, result)}{remedy}")
        reason = f"the stations do not tell the axes apart.{remedy}".removesuffix(".")
        open_axes[kind] = OpenAxes(reason, [] if pair else result.alternatives, scale)
    return results, open_axes


def _exchanged_angles(kind: str, raw: Array, readings: Readings, whole: Bools) -> tuple[str, ...]:
    """The columns of two angles of the stand that would tell the axes of a triad if they were exchanged; else none."""
    pairs = []
    for one, other in combinations(ANGLES, 2):
        known = {one: readings.reference(other), other: readings.reference(one)}
        exchanged = replace(readings, known={**readings.known, **known})
        if is_clear(wiring(raw, *_parts(kind, exchanged, whole))):
            pairs.append((REFERENCES[one].column, REFERENCES[other].column))
    return pairs[0] if len(pairs) == 1 else ()


def _check_gravity(readings: Readings, columns: Mapping[str, ColumnSource]) -> None:
    """Refuse a gravity that differs from station to station: the tool has measured it."""
    gravity = readings.reference("gravity")
    if np.ptp(gravity) <= SAME_GRAVITY:
        return
    column, apart = REFERENCES["gravity"].column, 1000 * np.ptp(gravity)
    parts = [c for c in REFERENCE_VECTORS if c in columns and column not in columns]
    names = ", ".join(shown(columns[c].name) for c in parts[:3] or [column])
    raise QuestionError(
        f"{readings.source}: {'the gravity of ' if parts else ''}{names} differs between stations by {apart:.2g} mg, "
        f"as no local gravity does: {'a' if parts else 'the'} tool has measured it, and it is no reference.",
        [Answer("leave it out", tuple(("column", f"{c}=") for c in parts or [column]))],
    )


_LEAST_TURNED = 3
"""Consecutive stations from which on an angle that is half a turn off is no single slip."""


def _check_half_turns(run: Table, readings: Readings, columns: Mapping[str, ColumnSource]) -> None:
    """Refuse an angle that is half a turn off at consecutive stations, where the readings fit it at all others."""
    for kind, name in (("accelerometer", "toolface"), ("magnetometer", "azimuth")):
        column = REFERENCES[name].column
        if column not in columns or getattr(readings, kind) is None:
            continue
        rows = _half_turned(readings, kind, name)
        if len(rows) < _LEAST_TURNED:
            continue
        raise FitError(
            f"{run.source}: by the readings {shown(columns[column].name)} is 180° off from {place(run, rows[0])} to "
            f"{place(run, rows[-1])}, and fits at all other stations. Correct it there, or leave these rows out."
        )


def _half_turned(readings: Readings, kind: str, name: str) -> Ints:
    """The stations, one behind the other, at which the readings of a triad fit an angle turned by 180° alone.

    Each station counts as it fits the line of all better, until no more change. None where others lie between them,
    where they are half of all, or where readings are left that neither angle explains.
    """
    none = np.empty(0, int)
    turned = {**readings.known, name: readings.reference(name) + np.pi}
    both = [
        _regressors(each, kind, warm=False) for each in (readings, replace(readings, known=turned))
    ]
    raw = both[0][1]
    designs = np.stack([np.column_stack([parts, np.ones(len(parts))]) for parts, _ in both])
    count, width = designs.shape[1:]
    if count < max(readings.count, 2 * _MOST_COLUMNS * width):
        return none
    chosen, off = np.zeros(count, int), np.zeros((2, count))
    for _ in range(_MOST_ROUNDS):
        slope, *_ = np.linalg.lstsq(designs[chosen, range(count)], raw, rcond=1e-9)
        off = np.linalg.norm(raw - designs @ slope, axis=-1)
        before, chosen = chosen, off.argmin(0)
        if np.array_equal(before, chosen):
            break
    rows = np.flatnonzero(off[1] < _FAR_BETTER * off[0])
    left = np.sqrt(np.mean(off.min(0) ** 2) / np.sum(raw.var(0)))
    between = slice(rows.min(initial=count), rows.max(initial=-1) + 1)
    apart = np.any(off[0, between] < _FAR_BETTER * off[1, between])
    return none if apart or 2 * len(rows) >= count or left > _CONFIRMED else rows


_MOST_ROUNDS = 20
"""Times that stations are assigned to an angle or the one half a turn from it."""


def _check_independent(readings: Readings, results: dict[str, Wiring]) -> None:
    """Refuse inclinations that were computed from the readings: they are no reference."""
    if "accelerometer" not in results:
        return
    result = results["accelerometer"]
    permutation = TriadProfile(axes=result.axes).permutation  # type: ignore[arg-type]
    vectors = readings.accelerometer @ permutation.transpose()
    computed = OBSERVABLES["inclination"].value(vectors, vectors)
    stated = readings.reference("inclination")
    same = SAME_ANGLE + _last_place(stated[~np.isnan(stated)]) / 2
    if np.nanmax(np.abs(computed - stated)) < same:
        raise FitError(
            f"{readings.source}: the inclinations are those that the readings themselves give, to "
            f"{np.degrees(same):.1g}°: they were computed from them. A calibration needs the angles of the "
            "stand: name their columns as references, such as 'Ref Inc'."
        )


def _last_place(angles: Array) -> float:
    """The unit in the last place, radians, of angles given to a hundredth or thousandth of a degree, else zero.

    Stands that are read to a tenth or less agree with a sound tool by chance.
    """
    steps = {place: np.degrees(angles) / place for place in LAST_PLACES}
    fine = (p for p, step in steps.items() if np.allclose(step, np.round(step), rtol=0, atol=1e-6))
    place = next(fine, LAST_PLACES[0])
    return 0.0 if place == LAST_PLACES[0] else float(np.radians(place))


def _check_sense(
    run: Table, readings: Readings, scaled: Profile, columns: Mapping[str, ColumnSource]
) -> None:
    """Ask whether the toolface counts anticlockwise, where both triads are told then and not otherwise."""
    toolface = REFERENCES["toolface"].column
    source = columns.get(toolface)
    if not source or source.unit not in ("", "°") or "toolface" not in readings.known:
        return
    turned = replace(
        readings, known={**readings.known, "toolface": -np.asarray(readings.known["toolface"])}
    )
    try:
        wirings, open_axes = _wirings(run, turned, scaled)
    except FitError:
        return
    sound = len(wirings) == len(TRIADS) and not open_axes
    if sound and not all(
        is_left_handed(each.axes) for each in wirings.values()
    ):  # else another angle is turned
        raise QuestionError(
            f"{run.source}: the readings fit only if {shown(source.name)} counts anticlockwise looking down the hole. "
            "Does it?",
            [
                Answer(
                    "yes, anticlockwise",
                    (("column", f"{toolface}={source.name} ({ANTICLOCKWISE})"),),
                )
            ],
        )


def _lacking(kind: str, absent: list[str], stations: int) -> str:
    """Why a run does not tell the axes of a triad."""
    if absent:
        return f"there is no column of the stand's {' and '.join(absent)}"
    needed = f"{LEAST_STATIONS} stations with known {', '.join(NEEDED[kind])} are needed"
    return f"{needed}, and there are {stations}"


def _parts(kind: str, readings: Readings, whole: Bools) -> list[Array]:
    """Components of the field along the tool axes (n, 3), in g or nT; of an unknown dip, both of them."""
    angles = [
        np.nan_to_num(readings.reference(name)[whole])
        for name in ("inclination", "azimuth", "toolface")
    ]
    turn = tool_from_earth(*angles)
    north, down = turn[..., 0], turn[..., 2]
    if kind == "accelerometer":
        return [down]
    dip, field = (readings.reference(name)[whole] for name in ("dip", "field"))
    strength = np.where(np.isnan(field), 1.0, field)[:, None]
    if np.isnan(dip).any():
        return [north * strength, down * strength]
    return [strength * (north * np.cos(dip)[:, None] + down * np.sin(dip)[:, None])]


def _unexplained(kind: str, result: Wiring) -> str:
    """The sentence on readings that no axes explain."""
    return (
        f"no axes of the {kind} explain its readings: the best, {toml(result.axes)}, leave "
        f"{result.unexplained:.0%} of their variation. Check the reference angles, their units, and whether "
        "the columns are the raw channels."
    )


def axes_open(proposal: Proposal) -> list[Finding]:
    """A finding on each triad of which the table does not tell the axes."""
    return [
        Finding(
            id="axes-open",
            text=f"{kind}: the axes are open, as {each.reason}. Fill in the line `axes` of [{kind}] in the profile"
            f"{_alternatives(each)}.",
        )
        for kind, each in proposal.open_axes.items()
    ]


_HALF_A_TURN = ("-x", "-y", "+z")
"""Axes of channels x, y and z of a tool that is half a turn off about z; a quarter of a turn is a usual wiring."""


def turned_about_z(proposal: Proposal) -> list[Finding]:
    """A finding on triads whose channels, called x, y and z, all read as turned by 180° about z."""
    columns = proposal.profile.columns or {}
    names = {
        c: columns[c].name if c in columns else c
        for kind in proposal.wirings
        for c in CHANNELS[kind]
    }
    plain = all(re.search(rf"(?i:{c[1]})(?![^\W\d_])", name) for c, name in names.items())
    if {each.axes for each in proposal.wirings.values()} != {_HALF_A_TURN} or not plain:
        return []
    text = (
        f"the channels X and Y of {' and '.join(proposal.wirings)} read as turned by 180° about Z. Either the tool "
        "is wired so, or the toolface zero of the stand is 180° off (mark down?): then survey toolfaces are, too."
    )
    return [Finding(id="turned-about-z", text=text)]


def one_inclination(proposal: Proposal) -> list[Finding]:
    """A finding on a table whose inclinations are too close to each other for a calibration."""
    if proposal.level is None:
        return []
    ends = " to ".join(dict.fromkeys(f"{end:.0f}°" for end in proposal.level))
    text = (
        f"all stations are at inclination {ends}: mwdcal calibrate will refuse this run. Add stations at other "
        "inclinations: at least three, well apart, up and down, with six or more toolfaces each."
    )
    return [Finding(id="one-inclination", text=text)]


def _alternatives(axes: OpenAxes) -> str:
    """Axes that fit about as well, in words; empty where all are open."""
    if not axes.alternatives:
        return ""
    named = " or ".join(toml(each) for each in axes.alternatives[:MOST_NAMED])
    more = len(axes.alternatives) - MOST_NAMED
    return f": {named}{f' or {more} others' if more > 0 else ''}"


_FACT = re.compile(r"\D{3,40}\d+([.,]\d+)*\W*([^\W\d_]\S{0,5})?\W*")
"""A line of a few words, a number and perhaps its unit."""
_STATED_COLUMNS = tuple(REFERENCES[name].column for name in STATED_REFERENCES)


def lines_not_taken(proposal: Proposal) -> list[Finding]:
    """A finding on each reference beside the table that is nominal or unclear, where the run has no other, or another.

    Another one is of a place or a day that the table says not to be those of the run.
    """
    columns = proposal.profile.columns
    named = {} if isinstance(columns, msgspec.UnsetType) else columns
    if proposal.where is None:
        return []
    block, stated = proposal.where.titles, proposal.metadata
    others = [
        Finding(
            id="reference-not-taken",
            text=f"{column}: {stated[column]:.8g} is taken, by the words beside it, and not {other:.8g} of the line "
            f"{shown(line)}. If that one holds, state it in a column.",
        )
        for column, (line, other) in block.others.items()
        if column in stated and not (column in named and named[column].name in proposal.where.names)
    ]
    facts = [t for t in proposal.where.above if _FACT.fullmatch(t) and not references_in([[t]])]
    near = {c: t for t in facts for c in _STATED_COLUMNS if is_near(c, t)}
    lines = {c: shown(t)[1:-1] for c, t in (near | {**block.not_taken}).items()}
    return others + references_not_taken(
        {c: t for c, t in lines.items() if c not in {*named, *stated}}
    )


def read_as_thousands(proposal: Proposal) -> list[Finding]:
    """A finding on each reference whose decimal sign in the table is read as one of thousands: 50.612 nT."""
    sign = "," if proposal.profile.form.decimal == "," else "."
    number = re.compile(rf"(?<![\d.,])(\d{{1,3}})\{sign}(\d{{3}})(?![\d.,])")
    lines = proposal.where.above if proposal.where else ()
    return [
        Finding(
            id="reference-rescaled",
            text=f"{column}: {match[0]} of the line {shown(line)} is taken as {value:.8g} {RANGES[column].unit}. "
            "Correct the number or its unit in the table.",
        )
        for column, value in stated_references(proposal).items()
        for line in lines
        for match in number.finditer(line)
        if references_in([[line.replace(match[0], match[1] + match[2])]]).get(column) == value
    ]


def answers_by_readings(proposal: Proposal) -> list[Finding]:
    """A finding on what the names of a table leave open and the readings answer."""
    return [
        Finding(
            id="told-by-readings",
            text=f"The names leave it open, and the readings fit one answer alone: {text}. If it is another, say so by "
            "`column`.",
        )
        for text in proposal.by_readings
    ]


def units_contradicted(proposal: Proposal) -> list[Finding]:
    """A finding on channels of which the readings contradict the unit: they are used in the scale that is found."""
    columns = proposal.profile.columns
    named = {} if isinstance(columns, msgspec.UnsetType) else columns
    findings = []
    for kind, base in (("accelerometer", "g"), ("magnetometer", "nT")):
        channel = named.get(CHANNELS[kind][0])
        if kind in proposal.wirings and proposal.wirings[kind].apart > MOST_APART:
            text = (
                f"{kind}: by the readings the scale of one channel is {proposal.wirings[kind].apart:.3g} times that of "
                "another. Is a column in another unit?"
            )
            findings.append(Finding(id="unit-contradicted", text=text))
        scale = getattr(proposal.profile, kind).scale if kind in proposal.wirings else None
        nominal = _nominal_scale(proposal, channel, base) if channel else None
        if nominal and scale and abs(np.log(scale / nominal[0])) > OFF_UNIT:
            strength = stated_references(proposal).get("ref_field_nt" if base == "nT" else "", 0.0)
            text = (
                f"{kind}: {nominal[1]}; by readings and references {scale:g} do. It is used in the scale of the "
                f"readings. Check the unit and the references{f': is the field {strength:g} nT?' if strength else '.'}"
            )
            findings.append(Finding(id="unit-contradicted", text=text))
    return findings


def _nominal_scale(
    proposal: Proposal, channel: ColumnSource, base: str
) -> tuple[float, str] | None:
    """The scale that the unit of a channel is, or a line above the names states, per g or nT, and where it is from."""
    unit = "mg" if (base, channel.unit) == ("g", "mG") else channel.unit
    if unit in (base, *FACTORS):
        scale = 1 / FACTORS.get(unit, (1.0, 0.0))[0]
        return scale, f"by its names {unit}, of which {scale:g} make a {base}"
    lines = proposal.where.above if proposal.where else ()
    stated = {s.scale for s in map(sensitivity_in, lines) if s and (s.raw, s.base) == (unit, base)}
    if len(stated) != 1:
        return None
    scale = stated.pop()
    return scale, f"by a line above the names {scale:g} {unit} make a {base}"


def warmth_by_unit(proposal: Proposal) -> list[Finding]:
    """A finding on a column that its unit alone makes the temperature of the tool, or may make it."""
    if WARMTH in proposal.said:
        return []
    where, source = proposal.where, (proposal.profile.columns or {}).get(WARMTH)
    units = dict(zip(where.names, where.units, strict=True)) if where else {}
    names = [source.name] if source else proposal.others
    warm = [
        n
        for n in names
        if warm_unit(n, u := units.get(n, ""))
        and not is_not_of_tool(n)
        and not meaning(n.replace("°", ""), u.replace("°", ""))
    ]
    text = (
        "{} is taken as the temperature of the tool, as the only column in a unit of temperatures. If it is not, say "
        'so: `column` "temperature_c=".'
        if source
        else "no column is called a temperature, and {} is in a unit of temperatures. If it is the tool's, say so: "
        '`column` "temperature_c={}".'
    )
    return [Finding(id="temperature-by-unit", text=text.format(shown(n), n)) for n in warm]


def warmth_around(proposal: Proposal) -> list[Finding]:
    """A finding on a temperature by its unit, of the oven or the room by its name, or above the names alone."""
    columns = proposal.profile.columns or {}
    lines = proposal.where.above if proposal.where else ()
    stated = next(filter(warmth_in, lines), "")
    if stated and WARMTH not in columns:
        text = f"{shown(stated)} is not used: the temperature of a run is read from a column alone."
        return [Finding(id="not-used", text=text)]
    source = columns.get(WARMTH)
    if source is None or not is_of_surroundings(source.name):
        return warmth_by_unit(proposal)
    text = (
        f"{shown(source.name)} is taken as the temperature of the tool, of which there is no other column. It lags "
        "behind the sensors: wait until it is steady, or state the tool's own."
    )
    return [Finding(id="oven-temperature", text=text)]


def findings_on(proposal: Proposal) -> list[Finding]:
    """All that the reader of a proposal should know."""
    ignored = [
        Finding(id="not-used", text=f"{shown(name)} is not used: {reason}.")
        for name, reason in proposal.ignored.items()
    ]
    marked = [Finding(id=MARKED_ROWS, text=text) for text in proposal.remarks]
    known = (
        of_surveys(proposal)
        + one_inclination(proposal)
        + axes_open(proposal)
        + left_handed({kind: each.axes for kind, each in proposal.wirings.items()})
        + turned_about_z(proposal)
        + lines_not_taken(proposal)
        + read_as_thousands(proposal)
        + marked
    )
    if proposal.profile.columns is not msgspec.UNSET and RAW[3] not in proposal.profile.columns:
        stated = {*proposal.profile.columns, *proposal.metadata}
        known += magnetometer_absent(n for n in STATED_REFERENCES if REFERENCES[n].column in stated)
    known += answers_by_readings(proposal) + warmth_around(proposal) + units_contradicted(proposal)
    known += tables_beside(proposal)
    return known + ignored + unused_columns(proposal.unused)


def depths_of_surveys(proposal: Proposal) -> str:
    """The column of measured depths in a table without the angles that a calibration needs; empty without one."""
    return next(filter(is_depth, proposal.others if proposal.open_axes else ()), "")


def of_surveys(proposal: Proposal) -> list[Finding]:
    """A finding on a table of surveys, of which no profile is made."""
    depths = depths_of_surveys(proposal)
    if not depths:
        return []
    text = (
        f"{proposal.source} has measured depths ({shown(depths)}) and no angles of a stand: it looks like surveys of a "
        "well, not a calibration run. Survey it by the calibration of its tool: mwdcal survey."
    )
    return [Finding(id="looks-like-surveys", text=text)]


def tables_beside(proposal: Proposal) -> list[Finding]:
    """The other tables of readings in the file, and the roll test that may be among them."""
    if proposal.where is None:
        return []
    serial = proposal.metadata.get("serial", "")
    return findings_beside(proposal.where, proposal.profile, serial, proposal.source)


def has_test_beside(proposal: Proposal) -> bool:
    """Whether the file has the roll test of the run in another table."""
    where, serial = proposal.where, proposal.metadata.get("serial", "")
    return where is not None and has_roll_test(roll_tests_beside(where, proposal.profile, serial))


def as_toml(proposal: Proposal, source: str) -> str:
    """The text of the profile, with how its entries were told."""
    profile = proposal.profile
    lines = [
        f"# Proposed by mwdcal profile from {source}, {proposal.stations} stations. Check and complete it.",
        f"name = {toml(profile.name)}",
    ]
    for kind, unit in (("accelerometer", "g"), ("magnetometer", "nT")):
        if kind in proposal.wirings:
            result = proposal.wirings[kind]
            lines += [
                "",
                f"[{kind}]",
                f"# {_sureness(result)}",
                f"axes = {toml(result.axes)}",
            ]
            if scale := getattr(profile, kind).scale:
                lines.append(f"scale = {scale!r}   # raw units per {unit}")
            lines.append(
                "# noise =    # raw units, 1σ of a station's mean; without it the fit estimates it"
            )
        elif kind in proposal.open_axes:
            lines += _open_section(kind, proposal.open_axes[kind], unit)
    lines += _STAND if has_angles(proposal) else []
    if not isinstance(profile.table, msgspec.UnsetType):
        lines += ["", "[table]"]
        fields = msgspec.structs.asdict(profile.table)
        usual = msgspec.structs.asdict(TableFormat())
        if profile.table.find:
            fields = {key: value for key, value in fields.items() if value != usual[key]}
        elif source.lower().endswith(".xlsx"):
            fields = {key: fields[key] for key in ("header_line", "first_line")}
        else:
            fields = {key: fields[key] for key in fields if key not in ("find", "sheet")}
        fields = {
            key: each for key, each in fields.items() if key not in _SELDOM or each != usual[key]
        }
        lines += [f"{key} = {toml(value)}" for key, value in fields.items()]
    if not isinstance(profile.columns, msgspec.UnsetType):
        lines += _columns_section(profile.columns, proposal.by_value)
    return "\n".join(lines) + "\n"


def _columns_section(columns: dict[str, ColumnSource], by_value: Collection[str]) -> list[str]:
    """The section of the columns, and whose unit only the values tell."""
    lines = [
        "",
        "[columns]   # of a run file = of this table; ref_ are angles of the stand, not the tool's",
    ]
    for column, each in in_order(columns):
        guess = "   # unit by its values" if column in by_value else ""
        lines.append(f"{column} = {toml(_stated(each))}{guess}")
    return lines


_STAND = [
    "",
    "# [stand]   # 1σ of one setting, degrees, by the stand's certificate; until stated its angles count as exact",
    *(f"# {name} =" for name in ("inclination_deg", "azimuth_deg", "toolface_deg")),
    '# Stations share the error of one setting. If you set the stand again at every station, write "per-station":',
    '# settings = "per-direction"   # set once, then the tool is rolled; assumed until stated',
]
"""Lines to fill in: uncertainty and practice of the stand, which no table states."""


def has_angles(proposal: Proposal) -> bool:
    """Whether the table states angles of a stand."""
    columns = proposal.profile.columns
    return not isinstance(columns, msgspec.UnsetType) and not {*columns}.isdisjoint(ANGLES_OF_STAND)


def _open_section(kind: str, axes: OpenAxes, unit: str) -> list[str]:
    """The section of a triad whose axes are to be filled in."""
    few = [f"#   {toml(each)}" for each in axes.alternatives[:MOST_NAMED]]
    scale = (
        [f"scale = {axes.scale!r}   # raw units per {unit}, by the readings"] if axes.scale else []
    )
    return [
        "",
        f"[{kind}]",
        f"# Open: {axes.reason}. The tool axis that each channel measures, with its sign, such as:",
        *(few or ['#   ["+x", "+y", "+z"]']),
        *(f"# {line}" for line in CHOICE_OF_AXES[kind]),
        "axes = []",
        *scale,
    ]


def stated_references(proposal: Proposal) -> dict[str, float]:
    """The references that the table states once for all stations, in units of a run file."""
    columns = proposal.profile.columns
    named = {} if isinstance(columns, msgspec.UnsetType) else columns
    return {
        column: float(str(proposal.metadata[column]))
        for column in (REFERENCES[name].column for name in STATED_REFERENCES)
        if column in proposal.metadata and column not in named
    }


def in_order(columns: dict[str, ColumnSource]) -> list[tuple[str, ColumnSource]]:
    """The columns in the order of a run file."""
    return sorted(columns.items(), key=lambda each: MAPPED.index(each[0]))


def _stated(each: ColumnSource) -> dict[str, str]:
    return {key: value for key, value in msgspec.structs.asdict(each).items() if value}


def _sureness(result: Wiring) -> str:
    return (
        f"these axes leave {result.unexplained:.1%} of the readings' variation, the next best "
        f"{result.next_best:.0%}"
    )
