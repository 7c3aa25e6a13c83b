"""Rows of a run that its laboratory has marked as rejected, in a column of remarks or of a status.

A mark that is plain leaves its row out of the run, and is named. What may be one is asked about when a profile is
proposed, and named where the row is used. `leave_out` and `keep` of a tool profile decide.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date
from functools import cache
from itertools import pairwise
from textwrap import shorten
from typing import NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.flags import listed
from mwdcal.errors import Answer, InputError, QuestionError
from mwdcal.files.depths import counts_stations
from mwdcal.files.formats.columns import Column, looks_numeric, shown
from mwdcal.files.formats.table import Table, labels, numbers, row_word
from mwdcal.files.formats.titles import ADJUSTED, NOT_TO_USE, OF_REFUSAL, day_of
from mwdcal.files.parting import check_rows, is_check, marked_rows
from mwdcal.files.statements import rows_of
from mwdcal.files.synonyms import OURS
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import TableFormat

_REJECTED = re.compile(
    rf"\W*({OF_REFUSAL}|deleted?|removed?|no ?data|keine daten|ingen data|s[ei][nm] d(at|ad)os|нет данных|无数据)\W*|"
    rf"\W*({OF_REFUSAL})\s*[-–—:;,.(/!].*",
    re.DOTALL,
)
"""A cell that rejects its row, whatever reason follows."""
_DOES_NOT_COUNT = re.compile(rf"(\D*[,;:–(/-]\s*)?({NOT_TO_USE})\W*")
"""A cell that says so, behind a reason without the number of another row: warm-up, not used."""
_REJECTS_BEHIND = re.compile(
    rf"(?P<reason>\D*[,;:–(/!.，；：。！（-]\s*)({OF_REFUSAL})\W*"
    r"(?P<then>[-–—,;(，；（]\s*(re-?\w+|repeat\w*|omt\w+|wiederh\w*|repet\w*|повтор\w*|重\w*)\D*)?"
)
"""A cell that does so behind a reason, and may add that the row was measured again: bumped, rejected - retaken."""
_OF_OTHERS = re.compile(
    r"(?<![^\W\d_])(ok|okay|good|fine|stable|steady|gut|bra|bien|bom|before|above|below|previous|prior|earlier|old|"
    r"older|first|last|next|second|one|replaces?|instead|attempt|davor|vorher\w*|oben|alte[rns]?|erste[rns]?|forrige|"
    r"over|gammel|forste|anterior|primer[oa]?|arriba|acima|primeir[oa]|precedent\w*|предыдущ\w*|выше|перв\w*|стар\w*|"
    r"хорошо|норма)(?![^\W\d_])|上|前|旧|正常|合格"
)
"""Words of a reason that speaks of another row, or finds nothing wrong with its own."""
_OF_COPIES = re.compile(r"(duplicate|duplikat|duplicad[oa]|doublon|дубл\w*|重复).*")
"""A meaning in a legend that is that of copies of rows."""
_SUPERSEDED = re.compile(
    r"\W*(superseded.*|(replaced|ersetzt|erstattet|reemplazad[oa]|sustituid[oa]|substituid[oa]|remplacee?|"
    r"замен[еи]н[оаы]?) (by|with|durch|av|por|pel[oa]|par|на)\D{0,15}\d{1,3}\W*)"
)
"""A cell that names the row instead of its own: superseded by line 12."""
_DISTURBED = re.compile(
    r"(?<![^\W\d_])(moved|bumped|disturbed|slipped|knocked|bewegt|verrutscht|gestossen|flyttet|movi(o|do)|mexeu|bouge|"
    r"сдвин\w*|толкн\w*|vibrat\w*)(?![^\W\d_])|移动|碰到"
)
"""Words of a disturbance."""
_MAY_REJECT = re.compile(
    rf"{_DISTURBED.pattern}|(?<![^\W\d_])({OF_REFUSAL}|{NOT_TO_USE}|fail(ed)?|error|ng|gestort|unstable|instabil|perturbad[oa]|forstyrret|помех\w*|"
    r"outlier|suspect|questionable|doubtful|ausreißer|ausreisser|fehler|avvik|nicht bestanden|falha|fallo|выброс|сбой)"
    r"(?![^\W\d_])|异常|可疑|干扰"
)
"""A cell that may reject its row, or speak of another one."""
_MEASURED_AGAIN = re.compile(
    r"(?<!row )(?<!line )repeat(ed)?(?! (row|line))|re-?(taken|shot|shoot|read|done|measured|run)|again|"
    r"(?<!zeile )wiederh\w*|gjentatt|omm[aå]lt|(?<!linha )(?<!fila )(?<!ligne )repet\w*|"
    r"повтор\w*|重测|重新"
)
"""Words of a row that was measured again, not written again: it counts where no row beside it is of its setting."""
_REFUSED = re.compile(rf"(?<![^\W\d_])({OF_REFUSAL}|fail(ed)?|outlier)(?![^\W\d_])")
"""Words that reject a row whatever was done then."""
_REJECTS_PREVIOUS = re.compile(
    r"(?<![^\W\d_])(previous|prior|last|vorige\w*|vorherige\w*|forrige|anterior|precedent\w*|предыдущ\w*)(?![^\W\d_])\W*"
    rf"(?:\w+\W+){{0,2}}({OF_REFUSAL})(?![^\W\d_])|(上|前)一?[个点行次]\w{{0,2}}(作废|无效|剔除|不合格|坏)",
)
"""A cell that rejects the row before its own: repeated, the previous one is bad."""
_ACCEPTED = re.compile(
    r"(re-?test(ed)? |repeat(ed)? )?ok(ay)?|good|valid|accept(ed)?|pass(ed)?|use(d)?|i\.? ?o\.?|"
    r"gut|gultig|bestanden|godkjent|gyldig|bra|bien|bueno|"
    r"buena|aceptad[oa]|valid[oa]|bom|boa|aceit[oa]|bon(ne)?|годен|годна|хорошо|норма|да|ок|合格|正常|有效|良好?"
)
_REMARK_BEHIND = re.compile(r"\s*[(\[][^)\]]*[)\]]$|\s*[,;–-]\s+.*$")
"""A remark behind a judgement: ok (repeated)."""
_OF_ORDER = re.compile(
    r"\W*(start|begin(ning)?|end|anfang|beginn|ende|begynnelse|slutt|inicio|comienzo|fin(al)?|fim|debut|начало|конец|"
    r"mulai|selesai|baslang[ıi]c|bitis|开始|结束)\W*"
)
"""Words for the first or the last row, which say nothing of its worth."""
_OF_ACCEPTANCE = re.compile(
    r"(is )?(ok|valid|use|used|accept|accepted|good|gultig|gyldig|valid[oa]|годен|有效|io)\W*"
)
_OF_REJECTION = re.compile(
    r"(is )?(reject|rejected|bad|exclude|excluded|invalid|verworfen|forkastet|брак|剔除)\W*"
)
_OF_STATUS = re.compile(
    r"(status|state|flag|flags|quality|qual|qc|qa|check|result|bewertung|qualitat|kvalitet|estado|calidad|qualidade|"
    r"statut|etat|статус|качество|оценка|状态|质量|判定|结果)\W*(flag|code)?\W*"
)
_OF_JUDGEMENT = (_OF_ACCEPTANCE, _OF_REJECTION, _OF_STATUS)
"""Names of columns whose values judge rows, one by one."""
_AFFIRMED = {"y", "yes", "true", "1", "x", "ja", "j", "si", "s", "sim", "oui", "o", "да", "д", "是"}
_DENIED = {"n", "no", "false", "0", "nein", "nei", "nao", "non", "нет", "н", "否"}
_ENTRIES = re.compile(r"[,;|]\s*(?=\w{1,6}\s*=)")
"""The separator before the next entry of a legend."""
MARKS_NAMED = 8
"""Rows that a sentence names."""
_LONGEST_REMARK = 60
"""Letters of a remark that a sentence quotes."""
_MARK_NUMBERS = frozenset("0123456789+-−–—eE.,:;/ ")
_MOST_STATIONS = 2000
"""Stations of a run beyond which no copies, and no second run, are looked for."""
_MOST_VALUES = 5
"""Values of a column of a status at most; one of more tells something else."""


_NEAR, _RARE = 0.005, 0.2
"""A share of the range of a column within which numbers are near, and of rows that are near the next seldom."""
_PAUSE = 30
"""Days between two rows of a run at most."""
UNMARKED = ("group", "serial", *OURS)
"""Columns of a run file that mark no row."""


class Marks(NamedTuple):
    """Rows that are left out, by number, with what says so; and rows that are used, by column and cell.

    Their cells may reject them, or are remarks in words that are not understood.
    """

    left_out: dict[int, str]
    doubtful: dict[tuple[str, str], list[int]]
    remarked: dict[tuple[str, str], list[int]]


def marks_in(table: Table, form: TableFormat, used: Collection[str]) -> Marks:
    """The marks in the columns of a table that are not `used`, and what the form says of any column."""
    left_out: dict[int, str] = {}
    doubtful: dict[tuple[str, str], list[int]] = {}
    remarked: dict[tuple[str, str], list[int]] = {}
    for name in table.columns:
        chosen, kept = ({*map(_plain, each.get(name, ()))} for each in (form.leave_out, form.keep))
        judged = name not in used and name not in form.ignore and not name.startswith("witsml ")
        judged = judged and (
            _holds_words(table.columns[name])
            or any(each.fullmatch(_plain(name)) for each in _OF_JUDGEMENT)
        )
        checks = {*check_rows(table, name)} if judged else set[int]()
        judged = judged and checks == {*marked_rows(table, name)}
        cells = labels(table, name) if chosen or kept or judged else []
        left_out |= {
            r: f"{shown(name)}: {cells[r]}"
            for r in checks
            if judged and _plain(cells[r]) not in kept
        }
        spelt = {cell: _plain(cell) for cell in {*cells}}
        plain = ["" if r in checks else spelt[cell] for r, cell in enumerate(cells)]
        verdicts = _verdicts(_plain(name), plain) if judged else {}
        verdicts = {c: v for c, v in verdicts.items() if c not in kept} | dict.fromkeys(
            chosen, True
        )
        for row, cell in enumerate(plain):
            if judged and row and cell not in kept and _REJECTS_PREVIOUS.search(cell):
                left_out.setdefault(row - 1, f"the next row, {shown(name)}: {cells[row]}")
            elif verdicts.get(cell):
                left_out.setdefault(row, f"{shown(name)}: {cells[row] or 'blank'}")
            elif cell in verdicts:
                others = remarked if verdicts[cell] is None else doubtful
                others.setdefault((name, cells[row]), []).append(row)
    used_rows = (
        {
            key: left
            for key, rows in each.items()
            if (left := [r for r in rows if r not in left_out])
        }
        for each in (doubtful, remarked)
    )
    return Marks(left_out, *used_rows)


def is_the_repeat(table: Table, row: int, cell: str) -> bool:
    """Whether a cell says that its row was measured again, and no row beside it is another one of its setting.

    Such a row would be near it in a column, such as the rolls, in which neighbours seldom are.
    """
    if not _MEASURED_AGAIN.search(_plain(cell)) or _REFUSED.search(_plain(cell)):
        return False
    for name in table.columns:
        with suppress(InputError):
            values = numbers(table, name)
            near = np.abs(np.diff(values)) <= _NEAR * np.ptp(values)
            if near.mean() < _RARE and near[max(0, row - 1) : row + 1].any():
                return False
    return True


def is_disturbance(text: str) -> bool:
    """Whether a remark tells of a disturbance, and rejects no row, be it its own or another one.

    >>> is_disturbance("repeat of rejected 6"), is_disturbance("stand bumped, waited")
    (False, True)
    """
    plain = _plain(text)
    others = _REFUSED.search(plain) or _MEASURED_AGAIN.search(plain)
    return bool(_DISTURBED.search(plain)) and not others


def _verdicts(name: str, cells: Sequence[str]) -> dict[str, bool | None]:
    """The cells of a column that reject their rows (true), or may do so (false), and remarks on a few rows (None)."""
    different = {*cells}
    filled = different - {""}
    if len(filled) > _MOST_VALUES:
        filled = {c for c in filled if not looks_numeric(c)}
    if filled and all(map(ADJUSTED.search, filled)):
        return {}
    judges = len(different) > 1 and len(filled) <= _MOST_VALUES
    if judges and _OF_ACCEPTANCE.fullmatch(name) and filled <= _AFFIRMED | _DENIED:
        return dict.fromkeys(filled & _DENIED, True)
    if judges and _OF_REJECTION.fullmatch(name) and filled <= _AFFIRMED | _DENIED:
        return dict.fromkeys(filled & _AFFIRMED, True)
    verdicts: dict[str, bool | None] = {
        c: True for c in filled if _rejects(c) or _SUPERSEDED.fullmatch(c)
    }
    verdicts |= {c: False for c in filled if c not in verdicts and _MAY_REJECT.search(c)}
    accepted = {c for c in filled if _ACCEPTED.fullmatch(_REMARK_BEHIND.sub("", c))}
    if 2 * sum(map(accepted.__contains__, cells)) < len(cells):
        accepted = set()
    named = _OF_STATUS.fullmatch(name) or _OF_ACCEPTANCE.fullmatch(name)
    if judges and (accepted or named):
        usual = accepted or {max(sorted(different), key=cells.count)}
        verdicts |= dict.fromkeys(filled - usual - {*verdicts}, False)
    others = filled - accepted - {*verdicts}
    remarks = {c for c in others if not set(c) <= _MARK_NUMBERS and not _OF_ORDER.fullmatch(c)}
    few = 2 * sum(c in filled and c not in accepted for c in cells) < len(cells)
    return verdicts | (dict.fromkeys(remarks) if few else {})


def _rejects(text: str) -> bool:
    """Whether a text rejects its row: at once, or behind a reason that speaks of nothing else.

    >>> [_rejects(text) for text in ("bad; door open", "bumped, rejected", "truck passed, rejected - retaken")]
    [True, True, True]
    >>> [_rejects(text) for text in ("row before: bad", "ok; skip", "retake (bad clamp fixed)", "opened (removed cap)")]
    [False, False, False, False]
    """
    behind = _REJECTS_BEHIND.fullmatch(text)
    others = behind and (
        _MEASURED_AGAIN.search(behind["reason"]) or _OF_OTHERS.search(behind["reason"])
    )
    if _REJECTED.fullmatch(text) or (behind and not others):
        return True
    return bool(_DOES_NOT_COUNT.fullmatch(text)) and not _MEASURED_AGAIN.search(text)


def by_legend(
    table: Table, form: TableFormat, used: Collection[str], lines: Collection[str]
) -> TableFormat:
    """The form with the cells left out of which a legend in `lines` says that they do not count.

    Of cells that may reject their rows, one is meant by a line such as "M = stand moving, not for calibration".
    """
    leave_out, keep = ({n: [*c] for n, c in each.items()} for each in (form.leave_out, form.keep))
    doubtful = marks_in(table, form, used).doubtful if lines else {}
    coded = [n for n in table.columns if n not in used and _holds_words(table.columns[n])]
    for name in dict.fromkeys([*(name for name, _ in doubtful), *(coded if lines else ())]):
        cells = labels(table, name)
        codes = {*cells} - {""}
        meanings = {c: _meaning(c, lines) for c in codes if len(codes) <= _MOST_VALUES}
        out = [
            c
            for c, m in meanings.items()
            if (_rejects(m) or _OF_COPIES.fullmatch(m))
            or (is_check(_REMARK_BEHIND.sub("", m)) and 2 * cells.count(c) < table.count)
        ]
        if out:
            leave_out.setdefault(name, []).extend(sorted(out))
            keep.setdefault(name, []).extend(c for c in sorted({*meanings} - {*out}) if meanings[c])
    return msgspec.structs.replace(
        form,
        leave_out={name: tuple(cells) for name, cells in leave_out.items()},
        keep={name: tuple(cells) for name, cells in keep.items() if cells},
    )


def _meaning(cell: str, lines: Collection[str]) -> str:
    """The meaning of a cell by a legend in one of some lines, in small letters; empty where none or several have it.

    >>> _meaning("M", ["S = stable", "State M = moving, not used"]), _meaning("M", ["M = a, S = b"])
    ('moving, not used', 'a')
    """
    mark = re.compile(rf"(?<!\w){re.escape(cell)}\s*[=:]\s*([^;|=:]*)(?![^;|]*[=:])")
    entries = [entry for line in lines for entry in _ENTRIES.split(line)]
    meanings = [_plain(m[1]) for m in map(mark.search, entries) if m]
    return meanings[0] if len(meanings) == 1 else ""


def _holds_words(column: Column) -> bool:
    """Whether a column has a cell with more than the signs of numbers."""
    return isinstance(column, list) and not set("".join(column)) <= _MARK_NUMBERS


def _copies(table: Table) -> dict[int, str]:
    """Rows that repeat another one in every cell, its label too, and where that one stands.

    Some column must tell all other rows apart; without one, rows alike may be measurements of their own.
    """
    if table.count > _MOST_STATIONS:
        return {}
    columns = [labels(table, name) for name in table.columns]
    first: dict[tuple[str, ...], int] = {}
    copies = {}
    for row, cells in enumerate(zip(*columns, strict=True)):
        if first.setdefault(cells, row) != row:
            copies[row] = f"every cell as in {place(table, first[cells])}"
    different = table.count - len(copies)
    return copies if any(len({*cells}) == different for cells in columns) else {}


def _plain(text: str) -> str:
    """Small letters without marks, and blanks around."""
    plain = unicodedata.normalize("NFKD", text.replace("ø", "o").replace("й", "\0").casefold())
    bare = "".join(c for c in plain if not unicodedata.combining(c)).replace("\0", "й")
    return " ".join(bare.split())


def without_rejected(
    table: Table, form: TableFormat | msgspec.UnsetType, used: Collection[str]
) -> Table:
    """The table without the rows that its laboratory rejected; `remarks` of it name these, and those that are doubtful.

    Raises:
        InputError: no row is left.
    """
    form = TableFormat() if isinstance(form, msgspec.UnsetType) else form
    _check_one_run(table, form)
    marks = marks_in(table, form, used)
    copies = _copies(table)
    if not any(marks) and not copies:
        return table
    marks = marks._replace(left_out={**copies, **marks.left_out})
    rows = [row for row in range(table.count) if row not in marks.left_out]
    if not rows:
        raise InputError(
            f"{table.source}: every row is marked as rejected ({next(iter(marks.left_out.values()))}). If they count, "
            "say so by keep = {NAME = [TEXT]} in [table] of the tool profile."
        )
    return replace(rows_of(table, rows), remarks=(*table.remarks, *_remarks(table, marks)))


def _check_one_run(table: Table, form: TableFormat) -> None:
    """Ask which run is meant where a column says that rows are from before and after an adjustment."""
    for name, column in table.columns.items():
        texts = (
            [*dict.fromkeys(filter(None, labels(table, name)))] if isinstance(column, list) else []
        )
        if not texts or not all(map(ADJUSTED.search, texts[: _MOST_VALUES + 1])):
            continue
        left = [text for text in texts if text not in form.leave_out.get(name, ())]
        if len(left) > 1 and not {*left} <= {*form.keep.get(name, ())}:
            pairs = [
                tuple(("leave_out", f"{name}={t}") for t in left if t != text) for text in left
            ]
            raise QuestionError(
                f"{table.source} holds {len(left)} runs, of which {shown(name)} says {', '.join(map(shown, left))}. "
                "Which one is meant? The rows of the others are left out by leave_out in [table] of the tool profile.",
                [Answer(text, arguments) for text, arguments in zip(left, pairs, strict=True)],
            )


def second_run(table: Table) -> list[str]:
    """A sentence on the row at which a run may end and another begin, if there is one.

    There is a pause of more than a month, and the numbers of the stations begin again with the first one; without such
    numbers any others do.
    """
    days = next(filter(None, (_days(table, name) for name in table.columns)), [])
    starts = [k + 1 for k, (a, b) in enumerate(pairwise(days)) if abs(b - a).days > _PAUSE]
    columns: dict[str, Array] = {}
    for name in table.columns if starts else ():
        with suppress(InputError):  # of text
            columns[name] = numbers(table, name)
    counts = {name: each for name, each in columns.items() if counts_stations(each)}
    again = [
        name
        for name, each in (counts or columns).items()
        if all(each[k - 1] != each[k] == each[0] for k in starts)
    ]
    if not again or (counts and len(again) < len(counts)):
        return []
    row = starts[0]
    return [
        f"{shown(again[0])} begins again at {place(table, row)}, and the date goes from {days[row - 1]} to "
        f"{days[row]}. If these are two runs, write each to a file of its own, or leave the rows of one out by "
        "leave_out in [table] of the tool profile."
    ]


def _days(table: Table, name: str) -> list[date]:
    """The days of all rows in a column of dates, which may be written once for many rows; empty for any other."""
    of_text = isinstance(table.columns[name], list) and table.count <= _MOST_STATIONS
    cells = labels(table, name) if of_text else [""]
    known, days = cache(day_of), list[str]()
    for cell in cells:
        days.append(known(cell) if cell or not days else days[-1])
        if not days[-1]:
            return []
    return [*map(date.fromisoformat, days)]


def _remarks(table: Table, marks: Marks) -> Iterator[str]:
    """A sentence on the rows that are left out, and one on those that may have to be."""
    if marks.left_out:
        each = [f"{place(table, row)} ({said})" for row, said in sorted(marks.left_out.items())]
        why = "rejected, without a reading, for a check, or copies of others"
        yield f"rows that are {why}, are left out: {listed(each, MARKS_NAMED)}."
    for what, cells in (
        ("that may be marked as rejected", marks.doubtful),
        ("with remarks that mwdcal does not understand", marks.remarked),
    ):
        said = {
            row: f"{shown(name)}: {shorten(cell, _LONGEST_REMARK, placeholder='…')}"
            for (name, cell), rows in cells.items()
            for row in rows
            if row not in marks.left_out
        }
        if said:
            each = [f"{place(table, row)} ({text})" for row, text in sorted(said.items())]
            yield (
                f"rows {what} are used: {listed(each, MARKS_NAMED)}. To leave them out, or to keep them without "
                "this line, use leave_out or keep in [table] of the tool profile."
            )


def place(table: Table, row: int) -> str:
    """The line of a row in its file."""
    number = table.lines[row] if row < len(table.lines) else row + 1
    sheet = f"sheet {shown(table.parts[row])}, " if row < len(table.parts) else ""
    return f"{sheet}{row_word(table)} {number}"
