"""Where the table is in a file as a laboratory keeps it, and what it says above and below.

A sheet may begin with a title block; names of columns stand in up to three rows, units in or below them; rows
of means, remarks and signatures follow. `laid_out` finds the readings among them and says what it left out.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, pairwise, takewhile, zip_longest
from operator import eq
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.errors import Answer, FitError, InputError, QuestionError, UnreadableFileError
from mwdcal.files.formats import figures
from mwdcal.files.formats.columns import (
    Merged,
    as_text,
    letters_of,
    looks_numeric,
    plain_headings,
    shown,
    without_marks,
)
from mwdcal.files.formats.settings import (
    angles_among,
    columns_of_codes,
    columns_of_lines,
    headings_in,
    pointed,
    settings_in,
)
from mwdcal.files.formats.title_references import stated_above
from mwdcal.files.formats.titles import (
    ADJUSTED,
    NOT_TO_USE,
    OF_REFUSAL,
    Titles,
    dated,
    day_of,
    titles,
    tool_in,
)
from mwdcal.files.synonyms import resembled, unit_of
from mwdcal.files.words import LATIN_AXES, spelled
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import TableFormat

LEAST_COLUMNS = 4
"""Columns that a table with three channels and a reference has at least."""
_MOST_HEADER_ROWS = 3
_BESIDES = 8
"""Rows of readings from which another table in the file is one to be asked about."""
_MOST_DIFFERENT = 2
"""Columns of one name, such as times or temperatures, in which two sheets of the same stations differ at most."""
_SHARED = 0.6
"""Share of columns that two tables have in common if each may be meant."""
_SUMMARY = re.compile(
    r"\W*(mean|av[ae]r[ae]ge|avg|median|std\w*|st\.?\s?dev\w*|standard deviation|rms|min(imum)?|max(imum)?|sum|total|"
    r"range|span|mittel(wert)?|mw|durchschnitt|stabw\w*|standardabw\w*\.?|summe|snitt|gjennomsnitt|standardavvik|media|"
    r"promedio|desv\w*( est\w*)?|m[eé]d(ia|\.)|prom\.|moy\.|gj\.? ?snitt|ср\.?|desvio( padr[aã]o)?|"
    r"moyenne|[eé]cart[- ]type|среднее|ско|мин|макс|сумма|"
    r"平均(值)?|均值|标准差|最大值?|最小值?|合计|spread|σ|µ)\W*",
    re.IGNORECASE,
)
"""The name of a row of statistics, in its first cell or the place of the number of a reading."""
_READING = re.compile(r"[^\W\d]{0,12}[ ._#-]*\d{1,2}\W*")
"""The number of a reading at a station."""
_OF_LOGGERS = re.compile(
    r"(avg|smp|min|max|std|tot|float|double|int\d*|real|string|-+|=+)", re.IGNORECASE
)
"""What loggers write below names and units: how a value was sampled, of what type it is, rules."""
_UNIT_BEHIND = re.compile(
    r"(.*?)\s*([(\[][^)\]]*[)\]]|,\s*([^\s,]{1,5}|grader|gra[du]os|degrees)|(?<=[^\d\s]\s)(mV|mg|nT|[uµμ]T|mG|m/s[2²]))"
)
_AXIS = re.compile(r"\W*([xyz123ху])\W*([(\[].*)?", re.IGNORECASE)
"""A name that is an axis alone, and says nothing without the title above it."""
_OF_AXIS = re.compile(
    r"\W*(\w{0,6}|[^()\[\]]*[\W_](?=[xyzху]))(?P<axis>[xyz123ху])\W*([(\[].*|(?<=,)\s*(?![xyz]\b)[^\s,]{1,5})?",
    re.IGNORECASE,
)
"""A name that ends in an axis, but for its unit."""
_AXIS_FIRST = re.compile(r"(?P<axis>[xyz])[abghm]", re.IGNORECASE)
"""A name of two letters, of its axis and its triad."""
_WORD_AXIS = re.compile("轴$")
"""The word for an axis behind its letter."""
_SYMBOL = re.compile(r"[^\W\d_]")
"""A name that is the symbol of a quantity."""
_DEGREES_OF = re.compile(
    r"(?P<of>.*?)(?:^|[\s,(\[_]+)(?:(?P<d>deg(r[eé]e?s?)?|gra[du]s?|grad(er|en|os|us|i)|гр|град(ус\w*)?|[°º]|度)|"
    r"(?P<s>(arc[- ]?)?sec(onds?|ondes)?|sek(unden|under)?|seg(undos)?|s|сек(унд\w*)?|\"|″|”|''|′′|’’|秒)|"
    r"(?P<m>(arc[- ]?)?min(utes?|uten|utter|utos)?|мин(ут\w*)?|['′’]|分)|(?P<largest>max|макс))[\s.,)\]°º'′’\"″]*",
    re.IGNORECASE,
)
"""The name of a column of degrees, of minutes or of seconds of an angle, or of a largest value beside the least."""
_PART_OF_ANGLE = (
    re.compile(r"(?P<part>deg|min|sec|[dms])[._ ]+(?P<of>[^\W\d_][^()\[\]]*)", re.IGNORECASE),
    re.compile(
        r"(?P<of>[^\W\d_][^()\[\]]*?)[._ ]+\(?(?P<part>[dgms])\)?(?P<sign>\s*[(\[]?[°º'′\"″]+[)\]]?)?",
        re.IGNORECASE,
    ),
)
"""The name of a part of an angle: deg Inc, Inc_D."""
_PARTS_OF_ANGLE = {"d": "deg", "g": "deg", "m": "min", "s": "sec"}
WITHOUT_VALUE = re.compile(r"n/?a|n\.a\.?|nan|null|none|[\W_]*", re.IGNORECASE)
"""A cell that says that there is no value."""
NO_READING = re.compile(
    r"n/?a|n\.a\.?|#n/?a|nan|-?1\.#\w+|null|none|-+|[–—]+|#+|err(or)?|#err|fault|fail(ed)?|overrange|ovr|ovl|ol|"
    r"inval(id)?|bad|timeout|no ?data|feil|fehler",
    re.IGNORECASE,
)
"""Words of a logger in place of a number that it lacks."""
_BRACKETS = re.compile(r"[(\[][^)\]]*[)\]]")

_OF_VOID_RUN = re.compile(
    rf"(?<![^\W\d_])({OF_REFUSAL}|abort(ed)?|cancell?ed|abgebrochen|ungültig|avbrutt|abortad[oa]|abandonn[eé]e?|"
    r"прерван\w*)(?![^\W\d_])|作废|无效|中止|废弃",
    re.IGNORECASE,
)
"""Words of the name of a sheet, or of the line above a table, of a run that does not count."""
_OF_PAST_RUN = re.compile(
    r"(?<![^\W\d_])(superseded|obsolete|outdated|replaced by|veraltet|überholt|ersetzt durch|utgått|erstattet av|"
    r"reemplazad[oa] por|sustituid[oa]|substitu[ií]d[oa]|périmé|remplacée? par|устарел\w*|заменен\w* на)(?![^\W\d_])|"
    r"已作废|已取代|旧版",
    re.IGNORECASE,
)
"""Words of a run that another one superseded."""
OF_CHECKS = re.compile(
    r"(?<![^\W\d_])(roll[\s_-]*(test|over|check)|rt|verif\w*|check|valid\w*|(roll)?pr(ue|ü)fung|"
    r"[ck]ontrol\w*[- ]?(run|shot|test|roll|messung|dreh|måling|rull)\w*|rull(e|ings)test|rulleprøve|prueba|"
    r"ролл-?тест\w*|nachkontrolle|"
    r"(essai|teste?|ensa[iy]o|prova)s? (en|de|di) (roulis|rotation|rota[cç][aã]o|rotaci[oó]n|rotazione|giro|rolagem)|"
    r"провер\w*|повер\w*|контрольн\w* (вращ|замер|измер)\w*|тест\w* вращ\w*|"
    r"айналдыру сына\w*)(?![^\W\d_])|验证|检验|複測|复测|复核|滚转|回転試験|"
    r"(滚动|旋转)(测试|试验)",
    re.IGNORECASE,
)
"""Words of a sheet whose rows are to check a calibration."""
OF_ROLLS = re.compile(
    r"roll|rull|rola[gm]|roul|ролл|rot|dreh|giro|вращ|回転|滚|旋转|(calib|kalib|калиб|标定)",
    re.IGNORECASE,
)
_OF_DONE = re.compile(
    r"(check|verifi|validat|kontrollier)ed|verificad|validad|gepr(ü|ue)ft|kontrollert|sjekket|провер(ен|или|ил\b)",
    re.IGNORECASE,
)
"""Words of what was done between two rows."""
_OF_ENTRY = re.compile(
    rf"{_OF_DONE.pattern}|[:：=]|(?<![^\W\d_])(due|next|until|expir\w*|validity|fällig\w*|bis|neste|pr[oó]xim\w*|до)(?![^\W\d_])",
    re.IGNORECASE,
)
"""Words of a line that is no title of a check: of who has done it, or of the day of the next one."""
_CALLED_RUN = re.compile(
    r"(?<![^\W\d_])([ck]al|[ck]alib\w*|run|tumbl\w*|калибр\w*)(?![^\W\d_])|标定|校准", re.IGNORECASE
)
"""Words of the title of a calibration run."""
_WORD_OF_RUN = re.compile(
    r"(?:runs?|series?|sets?|pass|trial|repeat|corridas?|pruebas?|ensay?i?os?|serien?|messreihe|messung|lauf|durchgang|"
    r"essais?|s[eé]rie|mesure|passe|m[aå]ling|m[aä]tning|ajo|meting|pomiar|seria|misura|prova|medi(?:da|[cç][aã]o|ci[oó]n)|"
    r"rodada|m[eě][rř]en[ií]|m[eé]r[eé]s|m[aă]sur[aă]toare|[oö]l[cç][uü]m|seri|pengukuran|l[aầ]n(?: đo)?|"
    r"сери[яи]|замер|прогон|измерение|вимірювання)"
).pattern
_ORDINAL = re.compile(
    r"(?:\d{1,2}|[ivx]{1,4}|[ab]|first|second|third|erster?|zweiter?|dritter?|primer[ao]?|primeir[ao]|segund[ao]|"
    r"premi[eè]re?|deuxi[eè]me|f[oø]rste|andre|перв\w+|втор\w+)"
).pattern
_NUMBER_OF_RUN = re.compile(
    rf"\W*(?:{_WORD_OF_RUN}\W*(?:(?:no|nr|n[°º]|№)\W*)?(?P<behind>{_ORDINAL})(?![\w.,/-]*\d)(?![^\W\d_])|"
    rf"(?P<before>{_ORDINAL})(?:st|nd|rd|th|-?[йяе]|[.ªº°])*\s*{_WORD_OF_RUN}(?![^\W\d_])|"
    r"第?\s*(?P<cjk>\d{1,2}|[一二三])\s*(?:次|回|组|차))",
    re.IGNORECASE,
)
"""The beginning of a line that numbers a run: Run 2, 2. Messung, 第2次."""
ROLL_TEST = "roll test"
"""The kind of such a table."""
_OF_SETTING = re.compile(
    r"(?!(19|20)\d\d\W*$)([+−-]?\d+([.,]\d+)?|[\W_]|(?<![^\W\d_])(°?[cf]|deg\w*|grad\w*|°|k|t|temp\w*|oven|ofen|ovn|horno|soak|"
    r"inc\w*|incl\w*|inkl\w*|az\w*|dip|neigung|helning|hold|pos\w*|lage|plus|minus|cold|kalt|kald|fr[ií]o|froid|warm|"
    r"varm|hot|hei(ß|ss)|caliente|chaud|room|ambient\w*|raum\w*|rom\w*|ambiente|холод\w*|тепл\w*|гор\w*|комн\w*)"
    r"(?![^\W\d_])|[低常高]?温|℃|度)+",
    re.IGNORECASE,
)
"""The name of a sheet that is a setting of the stand or the oven: 77F, Inc 45, Cold."""
_OF_PAGE = re.compile(
    r"(?<![^\W\d_])((page|pg|part|seite|teil|side|del|p[áa]g(ina)?|parte|partie|стр(аница)?|часть|st(atio)?ns?|punkte?|puntos?|pontos?|точки)\W*\d|"
    r"(cont(inued|d|inuaci[óo]n|inua[çc][ãa]o)?|forts(etzung|att|ettelse)?|suite|продолж\w*)(?![^\W\d_]))|[页頁续續]",
    re.IGNORECASE,
)
"""Words of a sheet that continues another one, in its name or in a line above its table."""
_OF_CHANGE = re.compile(
    r"(?<![^\W\d_])(after|swap\w*|new|other|replac\w*|nach|neue?r?|getauscht|etter|ny|byttet|despu[eé]s|nuev[oa]|"
    r"depois|nov[oa]|trocad\w*|apr[eè]s|nouve\w*|после|нов\w*|замен\w*)(?![^\W\d_])|后|换|新"
)
"""Words of what is no longer the same."""
_OF_WARMTH = re.compile(r"\W*?([+−-]?\d+(?:[.,]\d+)?)\s*(?:°|deg)?\s*[cf℃]\W*", re.IGNORECASE)
"""The name of a sheet that is a temperature with its unit."""
_WARMTH_IN_WORDS = re.compile(
    r"(?<![^\W\d_])(t(?![^\W\d_])|temp\w*|temperat\w*|oven|ofen|ovn|horno|forno|four|темп\w*|т-ра|термо\w*|печ\w*)|"
    r"t[eé]mp[eé]rat|sıcaklık|温",
    re.IGNORECASE,
)
"""Words of a temperature, in a line between rows or in the name of a column."""
_WARMTH_IN_LINE = re.compile(
    r"(?P<number>(?<![\d.,])[+−-]?\d+(?:[.,]\d+)?)(?:\s*(?:±|\+/?-)\s*\d+(?:[.,]\d+)?)?\s*"
    r"(?:(?:°|º|deg\w*\.?)\s*(?P<unit>[cfсCFС])(?![^\W\d_])|(?P<sign>[℃℉])|(?P<bare>[CFС])(?![^\W\d_]))"
)
"""A temperature in a line: its number, a tolerance, and its unit, which is a bare letter only behind a word."""
_FAHRENHEIT = re.compile("[fF℉]")
"""A letter of degrees Fahrenheit."""
_RANGE_BEFORE = re.compile(r"(?:to|bis|til|до|[-–…])\s*$")
"""The end of a text before the upper end of a range."""
_WARMTH_OF_LINES = "Temperature of the line above"
"""The name of a column of temperatures that stand in lines between the rows."""
_SAME_WARMTH = 10.0
"""By how much a temperature differs at most from the one that its sheet is named by."""

Cells = Sequence[object]
Block = list[tuple[int, Cells]]
"""The rows of a title block, by number."""


class Sheet(NamedTuple):
    """The rows of a sheet that are not blank, by number, each without blank cells at its end.

    `form`: encoding and delimiter of a text; `number` of the sheet in its file, and `first_column` of its rows, from 0;
    `merged` cells.
    """

    name: str
    rows: list[tuple[int, Cells]]
    form: TableFormat = TableFormat()
    number: int = 0
    first_column: int = 0
    merged: Merged = ()
    hidden: bool = False


@dataclass(frozen=True)
class Layout:
    """A table in a sheet: names and units of its columns, their cells, and what was not read.

    `form` says how the table is written, `cells` are text, numbers in it with a decimal point, and `texts` the same
    as they stand there; `fractions` are columns of a workbook with numbers that are not whole. `left_out` are lines
    below the names that are no readings, `above` the texts above them,
    `block` those of its own title block, and `title` the one that says what it is;
    `parts` the sheet of each row where several are one table; `heading` the text right above the names;
    `titles` what the title block says of the tool, the day and the place; `places` letters of the columns in a
    workbook; `remarks` are sentences on what is taken from other places than the columns. Of a table that goes `across`
    the stations stand in columns, and `lines` are these. `beside` are the other tables of its file,
    `aside` void runs and roll tests with the columns of this run.
    """

    sheet: str
    form: TableFormat
    names: list[str]
    units: list[str]
    cells: list[list[str]]
    texts: list[list[str]]
    lines: list[int]
    number: int = 0
    fractions: tuple[str, ...] = ()
    above: tuple[str, ...] = ()
    titles: Titles = field(default_factory=lambda: Titles({}))
    left_out: tuple[tuple[int, str], ...] = ()
    places: Mapping[str, str] = field(default_factory=dict)
    parts: tuple[str, ...] = ()
    block: tuple[str, ...] = ()
    title: str = ""
    heading: str = ""
    remarks: tuple[str, ...] = ()
    across: bool = False
    beside: tuple[Layout, ...] = ()
    aside: tuple[Layout, ...] = ()

    @property
    def kind(self) -> str:
        """Whether it is called a void or superseded run, a run before or after an adjustment, or a roll test."""
        words = f"{self.sheet} {self.heading}"
        return _kind_of(self) or (ADJUSTED.search(words) and "adjusted run") or ""

    @property
    def size(self) -> int:
        """Cells of readings."""
        return len(self.lines) * len(self.names)


def laid_out(
    sheets: Sequence[Sheet],
    source: str,
    *,
    sheet: str = "",
    header_line: int = 0,
    wanted: Collection[str] = (),
    decimal: str = "",
    kind: str = "",
) -> Layout:
    """The table of readings in the sheets of a file.

    `sheet` and `header_line` say where it is, `wanted` what columns it has; otherwise the largest one is meant, or of
    those of a `kind`, such as `ROLL_TEST`, the largest.

    Raises:
        InputError: no such sheet, row or columns, or no table.
        FitError: two tables that may both be meant, or a decimal sign that the numbers leave open.
    """
    every, covers, unread = _every(sheets, source, sheet, header_line, decimal, wanted)
    tables = [t for t in every if {*wanted} <= {*t.names}]
    tables = [t for t in tables if kind in ("", _kind_of(t))]
    if not tables:
        raise _no_table(source, header_line, wanted, every)
    best = max(tables, key=lambda layout: layout.size)
    if not kind and not header_line:
        _check_renamed(best, [t for t in every if t not in tables], source, wanted)
    alike = _alike_among(tables, best)
    if len(alike) > 1 and not header_line and not kind:
        run = _the_run(alike)
        if run is None:
            raise _several(alike, source, sheet)
        best = run
    rows = (best.sheet, best.parts, best.lines, best.places.values())
    beside = [t for t in every if not is_part_of(t, *rows)]
    if sheet:
        best, others = _beside_other_sheets(
            best, [s for s in sheets if s.name != sheet], source, decimal
        )
        beside += others
    if wanted and not sheet and not kind:
        unread += _under_other_names(beside, wanted)
    best = replace(best, beside=tuple(beside), remarks=(*best.remarks, *unread))
    return _with_covers(best, covers)


def every_table(sheets: Sequence[Sheet], source: str, decimal: str = "") -> list[Layout]:
    """All tables in the sheets of a file, those of the same stations joined; errors as of `laid_out`."""
    return _every(sheets, source, "", 0, decimal)[0]


def is_part_of(
    table: Layout,
    sheet: str,
    parts: Sequence[str],
    lines: Sequence[int],
    places: Collection[str],
) -> bool:
    """Whether a table is that of a run in some lines and columns of a sheet, or one of its `parts` on sheets."""
    rows = {*zip(parts or [sheet] * len(lines), lines, strict=True)}
    apart = places and table.places and {*table.places.values()}.isdisjoint(places)
    return (table.sheet, table.lines[0]) in rows and not apart


def _every(
    sheets: Sequence[Sheet],
    source: str,
    sheet: str,
    header_line: int,
    decimal: str,
    wanted: Collection[str] = (),
) -> tuple[list[Layout], list[Sheet], list[str]]:
    """The tables of all sheets or of one, of all header lines or of one; sheets without numbers; remarks."""
    candidates = [each for each in sheets if each.name == sheet] if sheet else list(sheets)
    if not candidates:
        names = ", ".join(shown(each.name) for each in sheets)
        raise InputError(f"{source}: there is no sheet {shown(sheet)}. The sheets are {names}.")
    tables, covers = [], []
    for each in sheets:
        parts = _side_by_side_parts(each) if each in candidates else []
        layouts = [t for part in parts for t in _tables(part, source, decimal)]
        across = not any(_has_axes(t.names) for t in layouts)
        if each in candidates and across and (turned := _turned(each)):
            layouts = [
                replace(t, across=True, places={}, remarks=(*t.remarks, _STATIONS_IN_COLUMNS))
                for t in _tables(turned, source, decimal)
            ]
        covers += [] if layouts or any(_is_reading(row) for _, row in each.rows) else [each]
        tables += [t for t in layouts if header_line in (0, t.form.header_line)]
    tables, unread = _of_shown_sheets(tables, {s.name for s in candidates if s.hidden})
    return _with_same_stations(tables, wanted), covers, unread


def _of_shown_sheets(
    tables: list[Layout], hidden: Collection[str]
) -> tuple[list[Layout], list[str]]:
    """The tables of sheets that are not hidden, where there are such, and a remark on the others."""
    shown_ones = [t for t in tables if t.sheet not in hidden]
    unread = [shown(t.sheet) for t in tables if t.sheet in hidden]
    if not shown_ones or not unread:
        return tables, []
    return shown_ones, [f"the tables on hidden sheets are not read: {', '.join(unread)}."]


def _with_same_stations(tables: Sequence[Layout], wanted: Collection[str]) -> list[Layout]:
    """Tables, each with the channels that another sheet has of the same stations: of two triads on two sheets.

    A remark says where the columns that are `wanted` are all on one of them.
    """
    joined: list[Layout] = []
    for table in _with_stand(tables):
        place = next((k for k, t in enumerate(joined) if _have_same_stations(t, table)), None)
        if place is None:
            joined.append(table)
        else:
            joined[place] = _side_by_side(joined[place], table, wanted)
    return joined


def _with_stand(tables: Sequence[Layout]) -> list[Layout]:
    """Tables, each of channels alone with the angles of the one other that has the same stations.

    It has no channels, or those of another triad alone. A column of one name in which no two rows are alike tells the
    stations of both.
    """
    angled = [t for t in tables if angles_among(t.names)]
    tools = [t for t in tables if _has_axes(t.names) and not angles_among(t.names)]
    axes = {name for t in tools for name in t.names if _axis(name)}
    one_triad = [t for t in angled if sum(map(bool, map(_axis, t.names))) == len("xyz")]
    stands = [t for t in angled if not _has_axes(t.names)] or [
        t for t in one_triad if axes.isdisjoint(t.names)
    ]
    if len(stands) != 1 or not tools:
        return [*tables]
    (stand,) = stands
    joined = {id(tool): pair for tool in tools if (pair := _of_stations(tool, stand))}
    if len(joined) != len(tools):
        return [*tables]
    return [joined.get(id(t), t) for t in tables if t is not stand]


def _of_stations(tool: Layout, stand: Layout) -> Layout | None:
    """The table of a tool with the columns of the stand at the same stations; None where none tells these."""
    for name in (each for each in tool.names if each in stand.names):
        ours, theirs = (t.texts[t.names.index(name)] for t in (tool, stand))
        places = {station: row for row, station in enumerate(theirs)}
        if len(places) == len(theirs) and {*ours} <= {*places} and len({*ours}) == len(ours):
            rows = [places[station] for station in ours]
            more = [k for k, other in enumerate(stand.names) if other not in tool.names]
            what = "the other columns" if _has_axes(stand.names) else "the angles of the stand"
            where = shown(stand.sheet or stand.heading)
            said = f"{what} are those of {where} at the same {shown(name)}."
            return replace(
                tool,
                names=plain_headings([*tool.names, *(stand.names[k] for k in more)]),
                units=[*tool.units, *(stand.units[k] for k in more)],
                cells=[*tool.cells, *([stand.cells[k][row] for row in rows] for k in more)],
                texts=[*tool.texts, *([stand.texts[k][row] for row in rows] for k in more)],
                titles=_titles_of_both(tool, stand),
                remarks=(*tool.remarks, said),
            )
    return None


def _titles_of_both(one: Layout, other: Layout) -> Titles:
    """The title block of the first of two joined tables, completed by that of the other."""
    return one.titles._replace(metadata={**other.titles.metadata, **one.titles.metadata})


def _shared(one: Layout, other: Layout) -> tuple[set[str], set[str]]:
    """The names that two tables share, and those of them with equal cells."""
    ours, theirs = (dict(zip(t.names, t.cells, strict=True)) for t in (one, other))
    shared = {*ours} & {*theirs}
    return shared, {name for name in shared if ours[name] == theirs[name]}


def _have_same_stations(one: Layout, other: Layout) -> bool:
    """Whether sheets have the same stations, by three columns or more that vary, and each a triad of its own."""
    if len(one.lines) != len(other.lines):
        return False
    shared, equal = _shared(one, other)
    varied = [n for n, c in zip(one.names, one.cells, strict=True) if n in equal and len({*c}) > 1]
    ours, theirs = (dict(zip(t.names, t.cells, strict=True)) for t in (one, other))
    alike = [sum(map(eq, ours[n], theirs[n])) for n in shared - equal]  # else another station
    few = len(alike) <= _MOST_DIFFERENT and all(2 * n < len(one.lines) for n in alike)
    return len(varied) >= LEAST_COLUMNS - 1 and few and _are_of_one_triad_each(one, other)


def _are_of_one_triad_each(one: Layout, other: Layout) -> bool:
    """Whether two tables share three columns or more by name, and each has three of axes that the other has not."""
    names = {*one.names}, {*other.names}
    triads = [sum(map(bool, map(_axis, a - b))) for a, b in (names, names[::-1])]
    return min(len(names[0] & names[1]), *triads) >= LEAST_COLUMNS - 1


_NO_PART = "are no part of this run. If they are the run, propose a tool profile for their sheet: mwdcal profile."
"""The end of a remark on readings that are not taken as those of the profile."""


def _side_by_side(one: Layout, other: Layout, wanted: Collection[str]) -> Layout:
    """A table with the columns of another sheet that it does not have; the one with all `wanted` comes first."""
    if wanted and {*wanted} <= {*other.names}:
        one, other = other, one
    _, equal = _shared(one, other)
    more = [k for k, name in enumerate(other.names) if name not in equal]
    names = plain_headings([*one.names, *(other.names[k] for k in more)])
    places = [shown(t.sheet if one.sheet != other.sheet else t.heading) for t in (one, other)]
    said = (
        f"{' and '.join(places)} are one table: in all {len(one.lines)} rows they have "
        f"the same {', '.join(n for n in one.names if n in equal)}."
    )
    if wanted and {*wanted} <= {*one.names}:
        said = f"the channels are those of {places[0]}; those of {places[1]} at the same stations {_NO_PART}"
    return replace(
        one,
        names=names,
        units=[*one.units, *(other.units[k] for k in more)],
        cells=[*one.cells, *(other.cells[k] for k in more)],
        texts=[*one.texts, *(other.texts[k] for k in more)],
        fractions=tuple(dict.fromkeys([*one.fractions, *other.fractions])),
        titles=_titles_of_both(one, other),
        left_out=(*one.left_out, *other.left_out),
        remarks=(*one.remarks, *other.remarks, said),
    )


def _beside_other_sheets(
    table: Layout, others: Sequence[Sheet], source: str, decimal: str
) -> tuple[Layout, list[Layout]]:
    """A table of the sheet that is named, with a remark on those of the same stations, and the tables of others."""
    unread, beside = [], []
    for each in others:
        with suppress(InputError, FitError):
            layouts = list(_tables(each, source, decimal))
            same = [t for t in layouts if _have_same_stations(table, t)]
            unread += [shown(each.name)] * bool(same)
            beside += [t for t in layouts if t not in same]
    said = f"channels of the same stations on {', '.join(unread)} are not read: without `sheet` they are joined."
    return (replace(table, remarks=(*table.remarks, said)) if unread else table), beside


def _the_run(tables: Sequence[Layout]) -> Layout | None:
    """The run among alike tables: their sheets joined, or the one beside which the others are void or roll tests."""
    if _is_one_run(tables):
        return _joined_sheets(tables)
    kinds = [*map(_kind_of, tables)]
    runs = [t for t, kind in zip(tables, kinds, strict=True) if not kind]
    if 1 < len(runs) < len(tables) and _is_one_run(runs):
        runs = [_joined_sheets(runs)]
    if len(runs) != 1 or ADJUSTED.search(runs[0].heading):
        return None
    aside = tuple(t for t, kind in zip(tables, kinds, strict=True) if kind)
    return replace(runs[0], aside=aside)


def _kind_of(table: Layout) -> str:
    """A void run or a roll test, by the sheet of a table and the title of its block; empty for a run.

    The block of a table before it does not say so of one that is called a run.
    """
    above = table.block if _CALLED_RUN.search(table.title) else table.above
    return _kind(f"{table.sheet} {table.title}", above)


def _kind(words: str, above: Sequence[str] = ()) -> str:
    """The kind that words say; of the lines `above` one that begins as a title of rolls says it too.

    A run is one of the past where any line `above` says that another superseded it.
    """
    if any(map(_OF_PAST_RUN.search, above)):
        return "superseded run"
    if any(OF_CHECKS.match(line) and OF_ROLLS.search(line.partition("(")[0]) for line in above):
        return ROLL_TEST
    kinds = (("void run", _OF_VOID_RUN), (ROLL_TEST, OF_CHECKS))
    return next((kind for kind, pattern in kinds if pattern.search(words)), "")


def _is_one_run(tables: Sequence[Layout]) -> bool:
    """Whether tables of different sheets are parts of one run: alike in names, units and what stands above them.

    Their rows are numbered on from sheet to sheet, or their names are settings of the stand or the oven. A sheet that
    continues another one may lack its title block. A sheet of a roll test, or of a run after an adjustment, is no part.
    """
    sheets = [table.sheet for table in tables]
    first = tables[0]
    same = all(
        (t.names, t.units, t.form.decimal) == (first.names, first.units, first.form.decimal)
        for t in tables
    )
    stated = [{**t.titles.metadata, "date": ""} for t in tables]
    words = [" ".join([t.sheet, *t.above]) for t in tables]
    past = any(_kind("", t.above) for t in tables)
    apart = past or any(ADJUSTED.search(each) or _kind(each) for each in words)
    rows = [row for t in tables for row in zip(*t.texts, strict=True)]
    if not same or apart or len({*sheets}) < len(sheets) or len({*rows}) < len(rows):
        return False
    if not all(map(_has_its_warmth, tables)) and not _is_warmth_above(tables):
        return False
    if stated.count(stated[0]) < len(stated):
        return _are_numbered_on(tables) and all(_continues(t, first) for t in tables[1:])
    return all(map(_OF_SETTING.fullmatch, sheets)) or _are_numbered_on(tables)


def _continues(table: Layout, first: Layout) -> bool:
    """Whether a sheet calls itself a further page, and states nothing that the first one does not."""
    lines = [x for x in table.above if x not in first.above and not titles([[x]]).metadata]
    less = table.titles.metadata.items() <= first.titles.metadata.items()
    changed = any(map(_OF_CHANGE.search, map(str.lower, [table.sheet, *lines])))
    return less and not changed and all(map(_OF_PAGE.search, lines or [table.sheet]))


def _has_its_warmth(table: Layout) -> bool:
    """Whether a table on a sheet that is named as a temperature has a column of about that number."""
    match = _OF_WARMTH.fullmatch(table.sheet)
    if not match:
        return True
    stated = float(match[1].replace(",", ".").replace("−", "-"))
    columns = [[float(c) for c in cells] for cells in table.cells if all(map(looks_numeric, cells))]
    return any(max(abs(value - stated) for value in cells) < _SAME_WARMTH for cells in columns)


def _is_warmth_above(tables: Sequence[Layout]) -> bool:
    """Whether the temperatures that sheets are named as stand above their tables, and in no column."""
    return all(map(_states_its_warmth, tables)) and not any(map(_has_its_warmth, tables))


def _states_its_warmth(table: Layout) -> bool:
    """Whether a line above a table states the temperature that its sheet is named as."""
    match = _OF_WARMTH.fullmatch(table.sheet)
    number = re.escape(match[1].lstrip("+")) if match else ""
    stated = re.compile(
        rf"°\s*[cf℃]\W+{number}(?![\d.,])|(?<![\d.,]){number}\s*°\s*[cf℃]", re.IGNORECASE
    )
    return bool(match) and any(map(stated.search, table.above))


def _with_stated_warmth(table: Layout) -> Layout:
    """A table with the temperature that its sheet is named as in a column of its own."""
    match = _OF_WARMTH.fullmatch(table.sheet)
    assert match
    unit = "°F" if "f" in table.sheet.lower() else "°C"
    return _with_more_columns(
        table, {f"Temperature of sheet ({unit})": [pointed(match[1])] * len(table.lines)}
    )


def _with_settings_of_sheets(tables: Sequence[Layout]) -> Sequence[Layout]:
    """Tables with the settings of the stand that their sheets are named as, where no column states them."""
    stated = [settings_in(t.sheet) for t in tables]
    present = angles_among(tables[0].names)
    angles = [a for a in stated[0] if a not in present and all(a in each for each in stated)]
    if not angles:
        return tables
    return [
        _with_columns(
            t,
            {stated[0][a][0]: [each[a][1]] * len(t.lines) for a in angles},
            "sheets by their names",
        )
        for t, each in zip(tables, stated, strict=True)
    ]


def _are_numbered_on(tables: Sequence[Layout]) -> bool:
    """Whether a column numbers the rows of all tables, from each to the next."""
    columns = (
        [cell for cells in each for cell in cells]
        for each in zip(*(t.texts for t in tables), strict=True)
    )
    return any(map(_number_on, columns))


def _number_on(cells: Sequence[str]) -> bool:
    """Whether cells are whole numbers that go on by one."""
    return all(map(str.isdecimal, cells)) and all(int(b) == int(a) + 1 for a, b in pairwise(cells))


def _joined_sheets(tables: Sequence[Layout]) -> Layout:
    """Tables of several sheets as one, in the order of the sheets."""
    if _is_warmth_above(tables):
        tables = [*map(_with_stated_warmth, tables)]
    tables = _with_settings_of_sheets(tables)
    first = tables[0]
    return replace(
        first,
        cells=[
            [c for part in each for c in part]
            for each in zip(*(t.cells for t in tables), strict=True)
        ],
        texts=[
            [c for part in each for c in part]
            for each in zip(*(t.texts for t in tables), strict=True)
        ],
        lines=[line for t in tables for line in t.lines],
        parts=tuple(t.sheet for t in tables for _ in t.lines),
        fractions=tuple({f: None for t in tables for f in t.fractions}),
        left_out=tuple(each for t in tables for each in t.left_out),
    )


def _with_covers(layout: Layout, covers: Sequence[Sheet]) -> Layout:
    """A table with what sheets without readings say, where its own title block does not."""
    words = " ".join([*layout.above, *(_text(row) for each in covers for _, row in each.rows[:1])])
    blocks = [stated_above([row for _, row in sheet.rows], (), words) for sheet in covers]
    ours = str(layout.titles.metadata.get("serial", ""))
    theirs = {str(each.metadata["serial"]): None for each in blocks if "serial" in each.metadata}
    others = [each for each in theirs if ours and not _is_same_serial(each, ours)]
    titles_of_all = _completed(layout.titles, blocks)
    if not others:
        return replace(layout, titles=titles_of_all)
    said = (
        f"the table states the serial {shown(ours)}, another sheet {shown(others[0])}: {shown(ours)} is taken unless "
        "`serial` says otherwise."
    )
    choices = {**titles_of_all.choices, "serial": (ours, *others)}
    return replace(
        layout, titles=titles_of_all._replace(choices=choices), remarks=(*layout.remarks, said)
    )


def _is_same_serial(one: str, other: str) -> bool:
    """Whether two serials are one, but for signs, capitals and whole words or numbers around it.

    >>> [_is_same_serial("MWD-17", each) for each in ("mwd 17", "MWD17", "BHX / 17", "MWD-1", "17")]
    [True, True, False, False, True]
    """
    words = [re.findall(r"[^\W_]+", each.casefold()) for each in (one, other)]
    places = [combinations(range(len(each) + 1), 2) for each in words]
    parts = [{"".join(w[i:k]) for i, k in p} for w, p in zip(words, places, strict=True)]
    return "".join(words[0]) in parts[1] or "".join(words[1]) in parts[0]


def _completed(block: Titles, others: Iterable[Titles]) -> Titles:
    """A title block with what others state of that which it leaves open, the nearest first."""
    for other in others:
        stated = {*block.metadata, *block.choices}
        metadata = {k: v for k, v in other.metadata.items() if k not in stated} | {**block.metadata}
        day = "" if "date" in metadata else block.unclear_day or other.unclear_day
        whole: list[dict[str, Any]] = [
            {k: v for k, v in theirs.items() if k not in stated} | {**ours}
            for theirs, ours in zip(other[2:], block[2:], strict=True)
        ]
        block = Titles(metadata, day, *whole)
    return block


def _alike_among(tables: Sequence[Layout], best: Layout) -> list[Layout]:
    """The tables that may be meant as well as the largest, `best`: those of some size, or all that are one run."""
    alike = [
        t for t in tables if t is best or _share_columns(t, best) or _are_of_one_triad_each(t, best)
    ]
    runs = [t for t in alike if not _kind_of(t)]
    if len(runs) > 1 and _is_one_run(runs):
        return alike
    return [t for t in alike if t is best or len(t.lines) >= _BESIDES]


def _share_columns(one: Layout, other: Layout) -> bool:
    """Whether two tables share most of their columns, in whatever spelling."""
    ours, theirs = ({*_spelling(each.names)} for each in (one, other))
    return len(ours & theirs) >= _SHARED * max(len(ours), len(theirs))


def _no_table(
    source: str, header_line: int, wanted: Collection[str], tables: Sequence[Layout]
) -> InputError:
    nearest = max(tables, key=lambda t: len({*wanted} & {*t.names}), default=None)
    absent = [name for name in wanted if nearest and name not in nearest.names]
    if nearest and 0 < len(absent) < len(wanted):
        others = [name for name in nearest.names if name not in wanted]
        listed = f"; its others are {', '.join(map(shown, others[:8]))}" if others else ""
        columns = "column" if len(absent) == 1 else "columns"
        return InputError(
            f"{source}: the table has no {columns} {', '.join(map(shown, absent))}{listed}."
        )
    if wanted:
        names = ", ".join(shown(name) for name in [*wanted][:8])
        return InputError(f"{source}: no table with the columns {names} was found.")
    where = f" with column names in row {header_line}" if header_line else ""
    return InputError(
        f"{source}: no rows of numbers under column names were found{where}. A table needs one row per station, "
        f"at least {LEAST_COLUMNS} columns, and names above them."
    )


def _check_renamed(
    table: Layout, others: Sequence[Layout], source: str, wanted: Collection[str]
) -> None:
    """Refuse a table as the run where one of the `others` is like it but for names of columns that are `wanted`."""
    for other in (t for t in others if not _kind_of(t) and len(t.lines) >= _BESIDES):
        if not _share_columns(other, table) and not _are_of_one_triad_each(other, table):
            continue
        absent = [shown(name) for name in wanted if name not in other.names]
        columns = "column" if len(absent) == 1 else "columns"
        on_sheets = other.sheet != table.sheet
        here, there = (
            f"sheet {shown(t.sheet)}" if on_sheets else f"the table in row {t.form.header_line}"
            for t in (other, table)
        )
        problem = f"{source}: {here} has no {columns} {', '.join(absent)}"
        advice = "correct its names in the table or in [columns] of the tool profile"
        if kind := _kind_of(table):
            raise InputError(f"{problem}; {there} has, and is a {kind}.")
        key = f'sheet = "{table.sheet}"' if on_sheets else f"header_line = {table.form.header_line}"
        text = f"{problem}; {there} has. If {here} is the run, {advice}; if {there} is, put {key} into its [table]."
        raise QuestionError(text, [])


def _under_other_names(tables: Sequence[Layout], wanted: Collection[str]) -> list[str]:
    """A remark on each of some tables that looks like a run, and has none of the channels that are `wanted`."""
    return [
        f"the {len(t.lines)} readings under other names on sheet {shown(t.sheet)} {_NO_PART}"
        for t in tables
        if t.sheet and not t.kind and len(t.lines) >= _BESIDES and {*wanted}.isdisjoint(t.names)
        if _has_axes(t.names) and angles_among(t.names)
    ]


def _several(tables: Sequence[Layout], source: str, sheet: str) -> QuestionError:
    places = [
        f"{f'sheet {shown(t.sheet)}, ' if t.sheet else ''}row {t.form.header_line} ({len(t.lines)} rows)"
        for t in sorted(tables, key=lambda t: (t.sheet, t.form.header_line))
    ]
    counts = Counter(t.sheet for t in tables)
    answers = [
        Answer(
            f"{shown(t.sheet) if t.sheet else 'row'} {t.form.header_line}, {len(t.lines)} rows",
            (
                *[("sheet", t.sheet)] * (len(counts) > 1 and not sheet),
                *[("header_row", str(t.form.header_line))] * (counts[t.sheet] > 1),
            ),
        )
        for t in tables
    ]
    return QuestionError(
        f"{source} holds {len(tables)} tables of like columns: {'; '.join(places)}. Which one is meant?",
        answers,
    )


def _tables(sheet: Sheet, source: str, decimal: str) -> Iterator[Layout]:
    """The tables of a sheet, one below the other: a head is no row of readings, and the next row is one."""
    rows = _without_dittos([row for row in sheet.rows if not _is_ruler(row[1])])
    rows = _with_side_blocks_above(rows)
    remarks = [row for k, row in enumerate(rows) if _is_remark_below_names(rows, k)]
    names = next((k for k, (_, row) in enumerate(rows) if _is_of_texts(row)), len(rows))
    without = [row for row in rows[names:] if _is_without_reading(row[1])]
    aside = {line for line, _ in [*remarks, *without]}
    stated = [row for row in remarks if titles([row[1]]).metadata]
    rows = _with_legend([row for row in rows if row[0] not in aside])
    sheet = sheet._replace(rows=rows)
    readings = [_is_reading(row) for _, row in rows]
    heads = [
        k
        for k, (now, below) in enumerate(pairwise(readings))
        if below and not now and (_texts(rows[k][1]) >= LEAST_COLUMNS or _is_below_names(rows, k))
    ]
    heads = [k for n, k in enumerate(heads) if n == 0 or _begins_anew(rows, heads[:n], k)]
    blocks: list[list[Block]] = [[]]
    for head in heads:
        blocks.append(_blocks_above(sheet, head, stated, blocks[-1]))
    spans = pairwise([*heads, len(rows)])
    behind = [*blocks[2:], list[Block]([[]])]
    for (head, end), above, below in zip(spans, blocks[1:], behind, strict=False):
        if layout := _table(sheet, _Span(head, end, above, below[0]), source, decimal):
            last = rows[end][0] if end < len(rows) else math.inf
            under = [row for row in remarks if rows[head][0] < row[0] < layout.lines[0]]
            void = [(n, _words(row)) for n, row in without if rows[head][0] < n < last]
            layout = replace(
                layout,
                left_out=tuple(sorted([*layout.left_out, *void])),
                above=(*layout.above, *(_line(row) for _, row in under)),
                block=tuple(_line(row) for _, row in [*above[0], *under]),
                title=_title(above[0]),
            )
            between = [*under, *rows[head + 1 : end]]
            near = [*rows[max(0, head - 4) : head], *between]
            layout = _with_settings(_with_warmth_of_lines(layout, between), near)
            layout = _with_serials(layout, near)
            yield _with_triads_beside(_with_triad_above(_with_rows_of_headings(layout)))


def _side_by_side_parts(sheet: Sheet) -> list[Sheet]:
    """A run and its check side by side in a workbook, in columns apart by a blank one; else the whole sheet.

    All begin with a column of the same name, and the title of one is that of a check. Facts of the tool above one of
    them hold for those without.
    """
    rows = sheet.rows
    heads = (k for k, (a, b) in enumerate(pairwise(rows)) if _is_reading(b[1]) > _is_reading(a[1]))
    head = next(heads, 0) if sheet.name else 0
    names = _spelling(rows[head - is_units(rows[head][1])][1]) if head else []
    blank = {
        k
        for k in range(len(names))
        if not any(as_text(c) for _, row in rows for c in row[k : k + 1])
    }
    first = next(filter(None, names), "")
    starts = [k for k, name in enumerate(names) if name == first and k - 1 in blank]
    if not starts or names.index(first) in starts[:1]:
        return [sheet]
    ends = pairwise([0, *starts, max(len(row) for _, row in rows)])
    parts = [_in_columns(sheet, *each) for each in ends]
    blocks = [[row for row in part.rows if row[0] < rows[head][0]] for part in parts]
    checks = [bool(OF_CHECKS.search(_title(block))) for block in blocks]
    if not any(checks) or all(checks):
        return [sheet]
    stated = [row for block in blocks for row in block if _facts([row])]
    stated = [row for row in stated if not _is_of_check(_line(row[1]))]
    return [
        part if _facts(block) else part._replace(rows=[*stated, *part.rows])
        for part, block in zip(parts, blocks, strict=True)
    ]


def _in_columns(sheet: Sheet, start: int, end: int) -> Sheet:
    """The part of a sheet in some columns."""
    rows = [(line, row[start:end]) for line, row in sheet.rows]
    merged = [
        ((top, one - start), (bottom, other - start))
        for (top, one), (bottom, other) in sheet.merged
        if start <= one and other < end
    ]
    return sheet._replace(
        rows=[row for row in rows if any(cell != "" for cell in row[1])],
        merged=merged,
        first_column=sheet.first_column + start,
    )


def _with_side_blocks_above(rows: list[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    """The rows, in which a title block to the left or right of a table is moved above it.

    Such a block is of two columns or more behind or before a blank one, each filled in beside less than half of the
    readings, and says something of the tool, the day or the place.
    """
    readings = [k for k, (_, row) in enumerate(rows) if _is_reading(row)]
    first = max(readings[0] - 1, 0) if readings else len(rows)
    inside = [row for _, row in rows[first : readings[-1] + 1]] if readings else []
    counts = [sum(c != "" for c in column) for column in zip_longest(*inside, fillvalue="")]
    starts = _starts(rows, readings)
    above: dict[int, Block] = {start: [] for start in starts}
    for filled, each in groupby(range(len(counts)), key=lambda k: counts[k] > 0):
        block = [*each]
        if not filled or len(block) < 2 or 2 * max(counts[k] for k in block) >= len(readings):
            continue
        stated = [[row[k] for k in block if k < len(row)] for _, row in rows[first:]]
        if not any(map(_is_reading, stated)) and stated_above(stated).metadata:
            for place, row in enumerate(stated, first):
                above[max(s for s in starts if s <= place)] += [(-1, row)] * any(row)
            rows = rows[:first] + [
                (n, ["" if k in block else c for k, c in enumerate(row)]) for n, row in rows[first:]
            ]
    parts = pairwise([*starts, len(rows)])
    whole = [row for start, end in parts for row in [*above[start], *rows[start:end]]]
    return [row for row in whole if any(cell != "" for cell in row[1])]


def _starts(rows: Sequence[tuple[int, Cells]], readings: Sequence[int]) -> list[int]:
    """The places right below each table with names below it, and the first place of all."""
    return [0] + [
        one + 1
        for one, other in pairwise(readings)
        if any(_is_of_texts(row) for _, row in rows[one + 1 : other])
    ]


_DITTO = re.compile(
    r"[-–—\s]*(\"|″|”|“|„|''|〃|,,|»)[-–—\s]*|ditto|do\.|dto\.?|idem|id\.|то же|同上", re.IGNORECASE
)
"""A cell that says that it is as the one above."""


def _without_dittos(rows: Sequence[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    """The rows with the cell above in place of a ditto mark, among readings.

    >>> _without_dittos([(1, [30, 90, 0.1, 0.9]), (2, ['"', "〃", 0.2, 0.8])])[1]
    (2, [30, 90, 0.2, 0.8])
    """
    whole: list[tuple[int, Cells]] = []
    for line, row in rows:
        above = whole[-1][1] if whole else ()
        marks = [isinstance(c, str) and bool(_DITTO.fullmatch(c)) for c in row]
        known = all(k < len(above) and above[k] != "" for k, mark in enumerate(marks) if mark)
        if any(marks) and known and any(map(figures.is_figure, row)):
            row = [
                above[k] if mark else cell
                for k, (cell, mark) in enumerate(zip(row, marks, strict=True))
            ]
        whole.append((line, row))
    return whole


def _is_below_names(rows: Sequence[tuple[int, Cells]], place: int) -> bool:
    """Whether a row is one of units, of a few columns alone, below names."""
    above = rows[place - 1][1] if place else ()
    row = rows[place][1]
    units = is_units(row) or _are_parts_of_degrees(map(as_text, row))
    return units and _is_of_texts(above) and not _is_reading(above)


_STATIONS_IN_COLUMNS = (
    "the stations stand in columns, with the names in the first one: the table is read so."
)


def _turned(sheet: Sheet) -> Sheet | None:
    """A sheet whose stations stand in columns, with a row for each of these; None of any other.

    Names stand in the first column, three of them of axes, and numbers alone behind them or behind their units.
    """
    rows = sheet.rows
    block = [k for k, (_, row) in enumerate(rows) if _is_reading(row[1:]) and _is_name(row[0])]
    if len(block) <= LEAST_COLUMNS or not block[-1] - block[0] < 2 * len(block):
        return None
    inside = [row for _, row in rows[block[0] : block[-1] + 1]]
    width = max(map(len, inside))
    padded = [[*row, *[""] * (width - len(row))] for row in inside]
    names, *columns = (list(column) for column in zip(*padded, strict=True))
    if not _has_axes(names):
        return None
    units = columns[:1] if all(not figures.is_figure(cell) for cell in columns[0]) else []
    line = rows[block[0]][0]
    stations = [(k, column) for k, column in enumerate(columns, 2 + sheet.first_column)]
    head = [(line, names), *((line, each) for each in units)]
    others = [*rows[: block[0]], *rows[block[-1] + 1 :]]
    return sheet._replace(rows=[*others, *head, *stations[len(units) :]], merged=())


def _has_axes(names: Iterable[object]) -> bool:
    """Whether names of all three axes are among some."""
    return {*"xyz"} <= {*map(_axis, names)}


def _axis(name: object) -> str:
    """The axis that a name ends in, but for its unit, in lower case; empty where it ends in none.

    >>> _axis("Gx (g)"), _axis("X nT"), _axis("Gx max")
    ('x', 'x', '')
    """
    words = as_text(name).rsplit(maxsplit=1)
    bare = words[0] if len(words) > 1 and unit_of(words[1]) else " ".join(words)
    match = (
        _OF_AXIS.fullmatch(as_text(name))
        or _OF_AXIS.fullmatch(_WORD_AXIS.sub("", bare))
        or _AXIS_FIRST.fullmatch(bare)
    )
    return match["axis"].lower().translate(LATIN_AXES) if match else ""


def _is_name(cell: object) -> bool:
    return isinstance(cell, str) and cell != "" and not figures.is_figure(cell)


def _is_ruler(row: Cells) -> bool:
    """Whether a row is a line of dashes or the like, or numbers the columns.

    >>> _is_ruler(["----", ""]), _is_ruler([1, 2, 3, 4, 5, 6, 7]), _is_ruler([1, 2, 3, 4, 5, 6, 8])
    (True, True, False)
    """
    if all(isinstance(cell, str) and re.fullmatch(r"[-=_*+|\s]*", cell) for cell in row):
        return True
    filled = [cell for cell in row if cell != ""]
    numbered = (as_text(cell).strip("()[] ") == str(k) for k, cell in enumerate(filled, 1))
    return len(filled) > 2 * len("xyz") and all(numbered)


_NUMBER_OF_COLUMN = re.compile(r"(?<![\w.,])(\d{1,2})(?:\s*[-–]\s*(\d{1,2}))?[\s:=.)]+(?=[^\W\d_])")
"""The number of a column in a line that says what each is, or the first and the last of several: 4-6 acc x y z."""
_LINE_OF_COLUMN = re.compile(
    r"\W*(?:(?:columns?|cols?|field|colonnes?|columnas?|colunas?|colonn[ae]|spalten?|kolonner?|kolumn\w*|kolom|"
    r"столб\w*|колонк\w*|列|第)\W*)?(\d{1,2})(?:\s*(?:[-–…]|\.\.|to|bis|à|a|al?|til|до|至|到)\s*(\d{1,2}))?\s*列?\s*"
    r"[:：=.)–-]\s*(?=[^\W\d_])",
    re.IGNORECASE,
)
"""The beginning of a line that says what one column is, or several."""
_BETWEEN_AXES = re.compile(r"[,;/、]|\b(and|et|und|og|e|i|и|和)\b|(?<=[yY])\s+y(?=\s+[zZ])")
"""Signs and words between the axes that a line lists."""


def _with_legend(rows: list[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    """The rows with names above the first readings, where a line above numbers all columns and says what each is.

    >>> rows = [(1, ["# 1 inc(deg) 2 tf(deg) 3-5 acc x y z (g)"]), (2, [10, 0, 0.1, 0.1, 1])]
    >>> _with_legend(rows)[0]
    (1, ['inc (deg)', 'tf (deg)', 'acc x (g)', 'acc y (g)', 'acc z (g)'])
    """
    first = next((k for k, (_, row) in enumerate(rows) if _is_reading(row)), 0)
    for k in range(first - 1, -1, -1):
        text = " ".join(map(as_text, rows[k][1]))
        names = _legend(text) or _listed(text)
        before = rows[first][1][: -len(names) or None]
        if names and not any(map(figures.is_figure, before)):  # such as the time of a line of a log
            names = [*(f"Text {k}" for k in range(1, 1 + len(before))), *names]
        if len(names) == len(rows[first][1]):
            return [*rows[:k], *rows[k + 1 : first], (rows[k][0], names), *rows[first:]]
    return _with_lines_of_columns(rows, first)


def _with_lines_of_columns(rows: list[tuple[int, Cells]], first: int) -> list[tuple[int, Cells]]:
    """The rows with names above the first readings, where a line for each column says what it is, and no row does."""
    texts = {k: " ".join(map(as_text, rows[k][1])) for k in range(first)}
    marks = {k: mark for k, text in texts.items() if (mark := _LINE_OF_COLUMN.match(text))}
    names: list[str] = []
    for k, mark in marks.items():
        names += _named(mark, texts[k][mark.end() :], len(names))
    if len(names) < LEAST_COLUMNS or len(names) != len(rows[first][1]):
        return rows
    if first - 1 not in marks and _texts(rows[first - 1][1]) >= LEAST_COLUMNS:
        return rows
    above = [row for k, row in enumerate(rows[:first]) if k not in marks]
    return [*above, (rows[max(marks)][0], names), *rows[first:]]


def _legend(text: str) -> list[str]:
    """The names of columns that a line numbers from 1 on without a gap; empty where it does not."""
    names: list[str] = []
    marks = [*_NUMBER_OF_COLUMN.finditer(text)]
    for mark, behind in zip_longest(marks, marks[1:]):
        end = behind.start() if behind else len(text)
        named = _named(mark, text[mark.end() : end], len(names))
        if not named:
            return []
        names += named
    return names


def _named(mark: re.Match[str], text: str, before: int) -> list[str]:
    """The names of columns that a text lists behind its number, or the first and last; empty out of order.

    >>> _named(re.match("(.)-(.)", "5-7"), "fluxgates x, y and z (V)", 4)
    ['fluxgates x (V)', 'fluxgates y (V)', 'fluxgates z (V)']
    """
    head, bracket, unit = text.strip(" ,;").partition("(")
    count = int(mark[2] or mark[1]) - int(mark[1]) + 1
    words = (head if count == 1 else _BETWEEN_AXES.sub(" ", head)).split()
    if int(mark[1]) != before + 1 or not 0 < count <= len(words):
        return []
    return [" ".join([*words[:-count], each, bracket + unit]).strip() for each in words[-count:]]


_LIST_OF_COLUMNS = re.compile(
    r"(?:^[\W\d]*|\]\s*)(columns?|cols?|fields?|header|spalten?|kolonner?|kolumner|columnas?|colunas?|campos|colonnes?|colonne|kolumny|"
    r"столбцы|колонки|列|字段)\W*[:：=]\s*",
    re.IGNORECASE,
)
"""The word before the names of all columns in one line."""


def _listed(text: str) -> list[str]:
    """The names of columns behind a word for these, apart by blanks or commas; a unit in brackets belongs to its name.

    >>> _listed("% columns: stn inc(deg) tf (deg)")
    ['stn', 'inc(deg)', 'tf (deg)']
    """
    match = _LIST_OF_COLUMNS.search(text)
    bare = re.sub(r"\s+(?=[(\[])", "\0", text[match.end() :]) if match else ""
    return [name.replace("\0", " ") for name in re.split(r"[\s,;|]+", bare.strip()) if name]


def _is_remark_below_names(rows: Sequence[tuple[int, Cells]], place: int) -> bool:
    """Whether a row is a remark, or one of a few, between the names of a table and its readings."""
    first, last = place, place
    lowest, highest = place - _MOST_HEADER_ROWS, place + _MOST_HEADER_ROWS
    while first > max(0, lowest) and _is_short(rows[first][1]):
        first -= 1
    while last < min(len(rows) - 1, highest) and _is_short(rows[last][1]):
        last += 1
    if not first < place < last or last - first > _MOST_HEADER_ROWS:
        return False
    above, below = rows[first][1], rows[last][1]
    return _texts(above) >= LEAST_COLUMNS and not _is_reading(above) and _is_reading(below)


def _is_short(row: Cells) -> bool:
    """Whether a row has too few cells for readings or their names."""
    return sum(cell != "" for cell in row) < LEAST_COLUMNS - 1


def _begins_anew(rows: Sequence[tuple[int, Cells]], heads: Sequence[int], place: int) -> bool:
    """Whether a head is that of another table: of other names, or below another triad or the serial of another tool."""
    if not _repeats(rows[place][1], rows, heads[0]):
        return True
    between = [
        " ".join(map(as_text, row)) for _, row in rows[heads[-1] : place] if not _is_reading(row)
    ]
    if _is_below_check(rows[: heads[-1]]) and (between[1:] or not _go_on(rows, place)):
        return True
    if any(ADJUSTED.search(text) or OF_CHECKS.search(text) for text in between[1:]):
        return True
    first = _triads_in(" ".join(_text(row) for _, row in rows[max(0, heads[-1] - 1) : heads[-1]]))
    if first and _triads_in(" ".join(between[1:])) - first:
        return True
    block = [row for row in rows[heads[-1] : place] if not _is_reading(row[1])]
    facts = _facts(block)
    day = _facts([row for row in rows[: heads[-1]] if not _is_reading(row[1])]).get("date")
    if "serial" in facts and facts.get("date", day) != day and not _go_on(rows, place):
        return True
    stated = [_tools_in(rows[start:end]) for start, end in pairwise([0, *heads])]
    ours = next(filter(None, stated[::-1]), set())
    return bool(_tools_in(block) - ours) or _is_next_run(rows, heads[-1], place)


def _is_next_run(rows: Sequence[tuple[int, Cells]], before: int, place: int) -> bool:
    """Whether the lines above two heads number runs, the second of which repeats settings of the first.

    Series of a thermal run, at another temperature by their columns or titles, and stations numbered on are one run.
    """
    titles_of = [_numbered_run(rows[:head]) for head in (before, place)]
    numbers = [match and next(filter(None, match.groups())).casefold() for match in titles_of]
    if None in numbers or numbers[0] == numbers[1] or _go_on(rows, place):
        return False
    if any(match and warmth_in(match.string) for match in titles_of):
        return False
    heads = (map(as_text, row) for _, row in rows[max(0, before - 2) : before + 1])
    names = max(map(list, heads), key=lambda each: len(angles_among(each)))
    ours, theirs = rows[before + 1 : place], rows[place + 1 :]
    both = [
        [row for _, row in ours if _is_reading(row)],
        [*takewhile(_is_reading, (row for _, row in theirs))],
    ]
    warm = [k for k, name in enumerate(names) if _WARMTH_IN_WORDS.search(name)]
    if any(
        abs(b - a) > _SAME_WARMTH for a, b in zip(*(_means_of(r, warm) for r in both), strict=True)
    ):
        return False
    angles = [k for k, name in enumerate(names) if angles_among([name])]
    first, second = (
        [[as_text(row[k]) for k in angles if k < len(row)] for row in each] for each in both
    )
    return 2 * sum(each in first for each in second) > len(second)


def _numbered_run(above: Sequence[tuple[int, Cells]]) -> re.Match[str] | None:
    """The last line above a head, below other readings, that numbers a run."""
    lines = takewhile(lambda row: not _is_reading(row[1]), reversed(above))
    return next(filter(None, (_NUMBER_OF_RUN.match(_line(row)) for _, row in lines)), None)


def _means_of(rows: Sequence[Cells], places: Iterable[int]) -> list[float]:
    """The means of the numbers of columns; 0 of none."""
    columns = ([_number(row[k]) for row in rows if k < len(row)] for k in places)
    numbers = [[n for n in column if n is not None] for column in columns]
    return [float(np.mean(each)) if each else 0.0 for each in numbers]


def _is_below_check(rows: Sequence[tuple[int, Cells]]) -> bool:
    """Whether the last of some rows, or the title block that ends with it, has the title of a check."""
    block = [*takewhile(lambda row: not _is_reading(row[1]), reversed(rows))][::-1]
    return bool((block and OF_CHECKS.search(_text(block[-1][1]))) or _is_of_check(_title(block)))


def _go_on(rows: Sequence[tuple[int, Cells]], place: int) -> bool:
    """Whether the readings on both sides of a place are numbered on in their first cells."""
    last = next((row for _, row in reversed(rows[:place]) if _is_reading(row)), [""])
    first = next((row for _, row in rows[place:] if _is_reading(row)), [""])
    return _number_on([as_text(row[0]).strip() for row in (last, first)])


def _tools_in(rows: Sequence[tuple[int, Cells]]) -> set[str]:
    """The tools that lines among readings state."""
    return {tool for _, row in rows if not _is_reading(row) and (tool := tool_in(row))}


def _repeats(row: Cells, rows: Sequence[tuple[int, Cells]], head: int) -> bool:
    """Whether a row repeats the names, or the units, above the first readings, in whatever spelling."""
    return any(_spelling(row) == _spelling(each) for _, each in rows[max(0, head - 2) : head + 1])


def _spelling(row: Cells) -> list[str]:
    """The letters and digits of cells, in lower case."""
    cells = [re.sub(r"[\W_]+", "", as_text(cell).casefold()) for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _texts(row: Cells) -> int:
    """Texts of a row but for dashes and other signs that say that there is no value."""
    texts = (cell for cell in row if isinstance(cell, str) and re.search(r"[^\s–—-]", cell))
    return sum(not figures.is_figure(cell) for cell in texts)


def _is_reading(row: Cells) -> bool:
    """Whether a row has numbers in at least half of its cells that are filled in, and in at least four."""
    numbers = sum(map(figures.is_figure, row))
    return numbers >= LEAST_COLUMNS and 2 * numbers >= sum(cell != "" for cell in row)


def _is_of_texts(row: Cells) -> bool:
    """Whether a row may be names: it has as many texts as a table has columns, and is no row without a reading."""
    return _texts(row) >= LEAST_COLUMNS and not _is_without_reading(row)


def _is_without_reading(row: Cells) -> bool:
    """Whether a row is a station whose channels have no value: besides words for that, numbers, times and one text.

    >>> _is_without_reading(["09:28:00", 19, 4.93, 120.2, "NaN", "NaN", "NaN"])
    True
    >>> _is_without_reading(["Stn", "Inc", "-", "-", "-", "Ax", "Ay"])
    False
    >>> _is_without_reading(["-", "-", "-", "–", "power cut"]), _is_without_reading(["-", "-", "-", "°C"])
    (True, False)
    """
    if _is_reading(row):
        return False
    cells = [as_text(cell).strip() for cell in row]
    filled = [cell for cell in cells if cell and not NO_READING.fullmatch(cell)]
    lacking = sum(map(bool, cells)) - len(filled)
    worded = sum(not re.search(r"\d", cell) for cell in filled)
    alone = worded == 0 or (worded == 1 and (len(filled) > 1 or not unit_of(filled[0])))
    return lacking >= LEAST_COLUMNS - 1 and alone


def _blocks_above(sheet: Sheet, head: int, stated: Block, before: Sequence[Block]) -> list[Block]:
    """The title blocks of the table whose last row of names, or of units, is at a place, its own first.

    That is what stands between the table before it and its names, with what is `stated` below these. The blocks
    `before` hold for it too; of another tool, only the cover of all tables does.
    """
    rows = sheet.rows
    top = _head(rows, head, sheet.merged)[2]
    first = 0
    if before:
        first = next((k for k in range(top, 0, -1) if _is_reading(rows[k - 1][1])), 0)
    start, end = (rows[first - 1][0] if first else -math.inf), rows[head + 1][0]
    above = _without_footer(rows[first:top], start)
    block = [*(row for row in stated if start < row[0] < end), *above]
    serial, known = (
        next(filter(None, (_facts(each).get("serial") for each in every)), None)
        for every in ([block], before)
    )
    return [block, *([_cover(before[-1])] if before and serial not in (None, known) else before)]


def _facts(block: Block) -> Mapping[str, object]:
    """Facts of a title block on the tool and the day; a day that may be read in two ways as it stands."""
    facts = titles([row for _, row in block])
    return {**({"date": facts.unclear_day} if facts.unclear_day else {}), **facts.metadata}


def _in_paragraphs(block: Block) -> list[Block]:
    """The rows of a title block, apart where a blank row is between them."""
    parts: list[Block] = []
    for row in block:
        if parts and row[0] - parts[-1][-1][0] <= 1:
            parts[-1].append(row)
        else:
            parts.append([row])
    return parts


def _cover(block: Block) -> Block:
    """The paragraphs above a first table that hold for all: those before the first that states a tool or a day."""
    cover: Block = []
    for part in _in_paragraphs(block)[:-1]:
        if {"serial", "date"} & {*_facts(part)}:
            break
        cover += part
    return cover


class _Span(NamedTuple):
    """A table among rows: the places of its head and its end, its title blocks, its own first, and that of the next."""

    head: int
    end: int
    blocks: Sequence[Block]
    next_block: Block


def _titles_of(span: _Span, columns: Sequence[Cells], others: Block) -> Titles:
    """Facts of the title blocks of a table, and of the lines beside and below that are not the next one's.

    A block that states a day or a tool has no day of another one.
    """
    first, *above = ([row for _, row in block] for block in span.blocks)
    following = span.next_block if _facts(span.next_block) else []
    apart = {line for line, _ in following}
    stated = stated_above(first, _beside(columns, [row for row in others if row[0] not in apart]))
    day, alone = _day_of_check(_title(span.blocks[0]))
    if day and (alone or "date" not in stated.metadata):
        stated = stated._replace(metadata={**stated.metadata, "date": day}, unclear_day="")
    every = [*map(stated_above, above)]
    if stated.unclear_day or "serial" in stated.metadata:
        every = [
            t._replace(
                metadata={k: v for k, v in t.metadata.items() if k != "date"}, unclear_day=""
            )
            for t in every
        ]
    return _completed(stated, every)


def _without_footer(block: Block, line: float) -> Block:
    """The rows below a table without the paragraph right below its last `line`, where a later one states as much."""
    foot = next(iter(_in_paragraphs(block)), [])
    if not foot or foot[0][0] != line + 1:
        return block
    rest = block[len(foot) :]
    ours, theirs = ({"serial", "date"} & {*_facts(each)} for each in (foot, rest))
    return block if not theirs or ours - theirs == {"serial"} else rest


def _table(sheet: Sheet, span: _Span, source: str, decimal: str) -> Layout | None:
    """The table whose last row of names, or of units, is at the head of a span, down to the row before its end."""
    rows, (head, end, blocks, _) = sheet.rows, span
    names, units, _ = _head(rows, head, sheet.merged)
    above = [row for block in blocks[::-1] for _, row in block]
    below = rows[_another_part(rows, head, end) : end]
    end -= len(below)
    kept = _without_summary([row for row in rows[head + 1 : end] if _is_reading(row[1])])
    lines = {line for line, _ in kept}
    others = [row for row in rows[head + 1 : end] if row[0] not in lines]
    _check_cut(kept, others, source)
    if not kept or max(len(names), *(len(row) for _, row in kept)) < LEAST_COLUMNS:
        return None
    used = _used(kept, names, units, sheet.first_column)
    (names, units, columns, letters), said = _without_copies(used, blocks[0], sheet.first_column)
    names, units, columns = _in_degrees(names, units, columns, " ".join(map(_text, above)))
    sign = decimal or figures.decimal_sign([c for column in columns for c in column], source)
    block = _titles_of(span, columns, others)
    texts = [figures.as_they_stand(column) for column in columns]
    names, read = _read(names, columns, texts, sign)
    whole, joined = _with_minutes(names, [cells for cells, _ in read])
    stated = {n: _both(unit, c) for n, unit, (_, c) in zip(names, units, read, strict=True)}
    return Layout(
        sheet=sheet.name,
        form=msgspec.structs.replace(
            sheet.form,
            decimal=sign,
            header_line=rows[head - any(units)][0],
            first_line=kept[0][0],
        ),
        names=whole,
        units=[stated.get(name, "") for name in whole],
        cells=joined,
        texts=[
            texts[names.index(n)] if n in names else c for n, c in zip(whole, joined, strict=True)
        ],
        lines=[line for line, _ in kept],
        number=sheet.number,
        fractions=tuple(
            n for n, column in zip(names, columns, strict=True) if any(map(_is_fraction, column))
        ),
        above=tuple(map(_line, above)),
        heading=_words(blocks[0][-1][1]) if blocks[0] and not _is_reading(above[-1]) else "",
        titles=block._replace(metadata=dated(block.metadata, zip(names, texts, strict=True))),
        left_out=tuple(
            (line, _words(row)) for line, row in [*others, *below] if not _repeats(row, rows, head)
        ),
        places=dict(zip(names, letters, strict=True)) if sheet.name else {},
        remarks=said,
    )


def _title(block: Block) -> str:
    """The line of a title block that says what its table is: the last one, or above facts of the tool the first one."""
    if not block:
        return ""
    first, last = (_line(block[k][1]) for k in (0, -1))
    is_title = _is_of_check(first) or _CALLED_RUN.match(first)
    is_entry = len([*filter(None, block[-1][1])]) > 1
    return first if is_entry and is_title and not OF_CHECKS.search(last) else last


def _is_of_check(line: str) -> bool:
    """Whether a line begins as the title of a check, and is no entry of a title block, such as Verified by: AB."""
    return bool(OF_CHECKS.match(line) and not _OF_ENTRY.search(line))


def _day_of_check(title: str) -> tuple[str, bool]:
    """The day behind the title of a check, in ISO form, or empty; and whether nothing stands between them.

    >>> _day_of_check("Roll test 13.03.2026"), _day_of_check("Check due 13.03.2026")
    (('2026-03-13', True), ('', False))
    """
    words = re.sub(r"[(),;]", " ", title).split() if _is_of_check(title) else []
    places = (k for k in range(1, len(words)) if day_of(" ".join(words[k:])))
    k = next(places, len(words))
    return day_of(" ".join(words[k:])), bool(OF_CHECKS.fullmatch(" ".join(words[:k]).rstrip(" –-")))


def _line(row: Cells) -> str:
    """The text of a row."""
    return " ".join(map(as_text, row)).strip()


def _with_warmth_of_lines(layout: Layout, lines: Sequence[tuple[int, Cells]]) -> Layout:
    """A table with the temperatures that stand in lines between its rows, and above all, where it has no others."""
    readings = {*layout.lines}
    texts = {n: " ".join(map(as_text, row)) for n, row in lines if n not in readings}
    texts = {0: layout.heading} | texts
    stated = {n: each for n, text in texts.items() if (each := warmth_in(text))}
    above = [max((n for n in stated if n < line), default=-1) for line in layout.lines]
    if (
        -1 in above
        or len({stated[n] for n in above}) < 2
        or any(map(_WARMTH_IN_WORDS.search, layout.names))
    ):
        return layout
    units = {unit for _, unit in stated.values()}
    cells = [stated[n][0] for n in above]
    if len(units) > 1 or any(_are_near(column, cells) for column in layout.cells):
        return layout
    counts = Counter(f"{number} {unit}" for number, unit in (stated[n] for n in above))
    listed = ", ".join(f"{text} ({count} rows)" for text, count in counts.items())
    said = f"the temperatures are those of the lines above the rows: {listed}."
    left_out = tuple(each for each in layout.left_out if each[0] not in stated)
    warmth = {f"{_WARMTH_OF_LINES} ({min(units)})": cells}
    return replace(
        _with_more_columns(layout, warmth), left_out=left_out, remarks=(*layout.remarks, said)
    )


def _with_settings(layout: Layout, rows: Sequence[tuple[int, Cells]]) -> Layout:
    """A table with the settings of the stand that lines between its rows, or codes of stations, state.

    A line above the names is one of these if it is like one below.
    """
    readings = {*layout.lines}
    texts = {n: _text(row) for n, row in rows if n not in readings}
    first = layout.lines[0]
    between = {_form(text) for n, text in texts.items() if n > first}
    texts = {n: text for n, text in texts.items() if n > first or _form(text) in between}
    columns = columns_of_lines(texts, layout.lines, layout.names)
    source = "lines above the rows"
    if not columns:
        columns, source = columns_of_codes(layout.names, layout.cells), "codes of the stations"
    return _with_columns(layout, columns, source)


def _with_serials(layout: Layout, lines: Sequence[tuple[int, Cells]]) -> Layout:
    """A table with the serials that lines above and between its rows state, where these are of several tools."""
    readings = {*layout.lines}
    stated = {n: tool_in(row) for n, row in lines if n not in readings}
    every = {n: serial for n, serial in stated.items() if serial}
    above = [max((n for n in every if n < line), default=-1) for line in layout.lines]
    if -1 in above or len({every[n] for n in above}) < 2:
        return layout
    metadata = {k: v for k, v in layout.titles.metadata.items() if k != "serial"}
    layout = replace(layout, titles=layout.titles._replace(metadata=metadata))
    return _with_columns(layout, {"Serial": [every[n] for n in above]}, "lines above the rows")


def _with_rows_of_headings(layout: Layout) -> Layout:
    """A table with a row for each setting of the stand that headings of groups of columns state: TF 0, TF 90."""
    headings = headings_in(layout.names)
    if not headings or not _has_axes(headings.places):
        return layout
    channels = {k for each in headings.places.values() for k in each.values()}
    others = [k for k in range(len(layout.names)) if k not in channels]
    places = {s: [each[s] for each in headings.places.values()] for s in headings.settings}
    rows = [
        (row, setting)
        for row in range(len(layout.lines))
        for setting in places
        if any(layout.cells[k][row] for k in places[setting])
    ]

    def below(columns: Sequence[Sequence[str]]) -> list[list[str]]:
        each = [[columns[k][row] for row, _ in rows] for k in others]
        each += [[columns[p[s]][row] for row, s in rows] for p in headings.places.values()]
        return [*each, [setting for _, setting in rows]]

    units = [next(iter(each.values())) for each in headings.places.values()]
    said = f"the groups of columns of {', '.join(places)} are rows, with {shown(headings.name)} by their headings."
    return replace(
        layout,
        names=plain_headings([*(layout.names[k] for k in others), *headings.places, headings.name]),
        units=[*(layout.units[k] for k in [*others, *units]), ""],
        cells=below(layout.cells),
        texts=below(layout.texts),
        lines=[layout.lines[row] for row, _ in rows],
        remarks=(*layout.remarks, said),
    )


_OF_TRIAD = re.compile(
    r"(?<![^\W\d_])(acc|mag)(elerometers?|netometers?)?(?![^\W\d_])", re.IGNORECASE
)


def _triads_in(text: str) -> set[str]:
    """The triads of which a line speaks, in short: acc, mag."""
    return {match[1].lower() for match in _OF_TRIAD.finditer(spelled(text))}


def _with_triad_above(layout: Layout) -> Layout:
    """A table whose names of axes alone have the triad and the unit of the line above the names."""
    triads = _triads_in(layout.heading)
    axes = [k for k, name in enumerate(layout.names) if _AXIS.fullmatch(name)]
    if len(triads) != 1 or len(axes) != len("xyz"):
        return layout
    title = triads.pop().title()
    stated = [
        unit
        for text in _BRACKETS.findall(layout.heading)
        if (unit := text[1:-1].strip()) and unit_of(unit)
    ]
    units = [
        unit or (stated[0] if stated and k in axes else "") for k, unit in enumerate(layout.units)
    ]
    names = [_with_title(title, n) if k in axes else n for k, n in enumerate(layout.names)]
    return replace(layout, names=plain_headings(names), units=units)


def _with_triads_beside(layout: Layout) -> Layout:
    """A table with a column for each channel, of one with a row for each triad of a station: Acc, Mag, Acc, Mag.

    A column of two texts names the triads, as many rows each in the same order of stations, by three columns or more.
    """
    axes = [k for k, name in enumerate(layout.names) if _AXIS.fullmatch(name)]
    for place, column in enumerate(layout.texts if len(axes) == LEAST_COLUMNS - 1 else ()):
        one, *others = dict.fromkeys(column)
        if len(others) != 1 or place in axes or figures.is_figure(one):
            continue
        ours, theirs = ([k for k, c in enumerate(column) if c == v] for v in (one, *others))
        pairs = [([c[k] for k in ours], [c[k] for k in theirs[: len(ours)]]) for c in layout.texts]
        shared = [k for k, pair in enumerate(pairs) if pair[0] == pair[1]]
        if len(ours) == len(theirs) and len(shared) >= LEAST_COLUMNS - 2:
            return _pivoted(layout, place, shared, {one: ours, others[0]: theirs})
    return layout


def _pivoted(
    layout: Layout, place: int, shared: Sequence[int], rows: Mapping[str, Sequence[int]]
) -> Layout:
    """A table with the `rows` of each text in the column at a place side by side; `shared` columns stand once."""
    first, *_ = rows.values()
    more = [(k, v) for v in rows for k in range(len(layout.names)) if k not in (*shared, place)]

    def beside(columns: Sequence[Sequence[str]]) -> list[list[str]]:
        once = [[columns[k][row] for row in first] for k in shared]
        return once + [[columns[k][row] for row in rows[v]] for k, v in more]

    said = f"the rows of {' and '.join(map(shown, rows))} in {shown(layout.names[place])} are those of one station."
    names = [_with_title(value, layout.names[k]) for k, value in more]
    return replace(
        layout,
        names=plain_headings([*(layout.names[k] for k in shared), *names]),
        units=[layout.units[k] for k in (*shared, *(k for k, _ in more))],
        cells=beside(layout.cells),
        texts=beside(layout.texts),
        lines=[layout.lines[row] for row in first],
        remarks=(*layout.remarks, said),
    )


def _text(row: Cells) -> str:
    return " ".join(filter(None, map(as_text, row)))


def _with_columns(layout: Layout, columns: Mapping[str, list[str]], source: str) -> Layout:
    """A table with columns of settings that stand elsewhere, and a remark on where they are from."""
    if not columns:
        return layout
    said = f"{', '.join(map(shown, columns))} of each row is that of the {source}."
    return replace(_with_more_columns(layout, columns), remarks=(*layout.remarks, said))


def _with_more_columns(layout: Layout, columns: Mapping[str, list[str]]) -> Layout:
    """A table with more columns, by their names, beside its own."""
    return replace(
        layout,
        names=[*layout.names, *columns],
        units=[*layout.units, *[""] * len(columns)],
        cells=[*layout.cells, *columns.values()],
        texts=[*layout.texts, *columns.values()],
    )


def _are_near(column: Cells, stated: Sequence[str]) -> bool:
    """Whether the numbers of a column are all near the temperatures that lines state."""
    pairs = ((_number(cell), float(number)) for cell, number in zip(column, stated, strict=True))
    return all(value is not None and abs(value - number) < _SAME_WARMTH for value, number in pairs)


def warmth_in(text: str) -> tuple[str, str] | None:
    """The one temperature that a line states, and its unit.

    >>> [warmth_in(t) for t in ("温度点：80℃", "Set 2: T = 20,5 ± 0.5 °C", "Oven 176 F", "20 to 80 °C", "Run C")]
    [('80', '°C'), ('20.5', '°C'), ('176', '°F'), None, None]
    """
    word = _WARMTH_IN_WORDS.search(text)
    every = [m for m in _WARMTH_IN_LINE.finditer(text) if word or not m["bare"]]
    if len(every) != 1 or _RANGE_BEFORE.search(text[: every[0].start()]):
        return None
    letter = every[0]["unit"] or every[0]["sign"] or every[0]["bare"]
    number = every[0]["number"].replace(",", ".").replace("−", "-").lstrip("+")
    return number, "°F" if _FAHRENHEIT.match(letter) else "°C"


def _beside(
    columns: Sequence[Sequence[object]], others: Sequence[tuple[int, Cells]]
) -> list[Cells]:
    """Remarks in columns with few cells that are filled in, and `others` of the rows without numbers."""
    rare = [c for c in columns if 2 * sum(cell != "" for cell in c) < len(c)]
    rows = [[cell for cell in row if cell != ""] for row in zip(*rare, strict=True)]
    remarks = [row for row in rows if any(isinstance(cell, str) for cell in row)]
    return [*remarks, *(r for _, r in others if sum(map(figures.is_figure, r)) < LEAST_COLUMNS)]


def _another_part(rows: Sequence[tuple[int, Cells]], head: int, end: int) -> int:
    """The place of a line below the names, above rows of a check; else the end."""
    for place in range(head + 1, end - 1):
        between = _is_reading(rows[place + 1][1]) and not _is_reading(rows[place][1])
        if between and _stands_over_check(rows[head + 1 : place], *rows[place : place + 2]):
            return place
    return end


def _stands_over_check(
    above: Sequence[tuple[int, Cells]], line: tuple[int, Cells], below: tuple[int, Cells]
) -> bool:
    """Whether a line without names begins the rows of a check: it says so, and no row above is numbered on below.

    A remark does not: it says what was done, or is longer, such as check of the bubble; but for one that says that
    they do not count.
    """
    text = _text(line[1])
    if not OF_CHECKS.search(text) or _OF_DONE.search(text):
        return False
    if re.search(NOT_TO_USE, text, re.IGNORECASE):
        return True
    last = next((row for _, row in reversed(above) if _is_reading(row)), ())
    pairs = zip(map(_number, last), map(_number, below[1]), strict=False)
    steps = [b - a for a, b in pairs if a is not None and b is not None][:2]
    return 1.0 not in steps and bool(OF_ROLLS.search(text) or len(text.split()) <= 2)


def _both(unit: str, by_cells: str) -> str:
    """The unit by the row of units, or by the cells; both where they differ."""
    if unit_of(unit) and unit_of(by_cells) and unit_of(unit) != unit_of(by_cells):
        return f"{unit} and {by_cells}"
    return unit or by_cells


def _used(
    rows: Sequence[tuple[int, Cells]], names: Sequence[str], units: Sequence[str], first: int
) -> tuple[list[str], list[str], list[list[object]], list[str]]:
    """Names, units, cells and letters of the columns that have a name or a cell that is filled in."""
    width = max(len(names), *(len(row) for _, row in rows))
    names, units = ([*each, *[""] * (width - len(each))] for each in (names, units))
    columns = [[row[k] if k < len(row) else "" for _, row in rows] for k in range(width)]
    used = [k for k in range(width) if names[k] or any(cell != "" for cell in columns[k])]
    return (
        plain_headings([names[k] for k in used]),
        [units[k] for k in used],
        [columns[k] for k in used],
        [letters_of(first + k) for k in used],
    )


_Columns = tuple[list[str], list[str], list[list[object]], list[str]]
"""Names, units, cells and letters of columns."""


def _without_copies(each: _Columns, above: Block, first: int) -> tuple[_Columns, tuple[str, ...]]:
    """The columns, as `_apart`, before those whose title says that they do not count, and a remark on these.

    All of these have names of columns before them.
    """
    title = {letters_of(first + k): as_text(c) for k, c in enumerate(above[-1][1] if above else ())}
    names, *_, letters = each
    for place in range(LEAST_COLUMNS, len(names)):
        text = title.get(letters[place], "")
        plain = without_marks(text.lower())
        if not (re.search(NOT_TO_USE, plain) or _OF_PAST_RUN.search(text)):
            continue
        if {re.sub(r" \(\d+\)$", "", name) for name in names[place:]} <= {*names[:place]}:
            where = f"{letters[place]} to {letters[-1]}"
            said = f"the columns {where} below {shown(text)} are not read: those before them have the same names."
            return _apart(*(part[:place] for part in each)), (said,)  # type: ignore[arg-type]
    return _apart(*each), ()


def _apart(
    names: Sequence[str],
    units: Sequence[str],
    columns: Sequence[list[object]],
    letters: Sequence[str],
) -> tuple[list[str], list[str], list[list[object]], list[str]]:
    """The same with a column for each number of cells that have several: Inc/Azi/TF, G xyz."""
    whole: list[tuple[str, str, list[object], str]] = []
    for name, unit, column, letter in zip(names, units, columns, letters, strict=True):
        each, cells = figures.apart(name, column)
        parts: Iterable[Cells] = cells or [column]
        whole += [(part, unit, [*c], letter) for part, c in zip(each, parts, strict=True)]
    return (
        plain_headings([each[0] for each in whole]),
        [each[1] for each in whole],
        [each[2] for each in whole],
        [each[3] for each in whole],
    )


_GREEK_ANGLE = re.compile(r"[ΘθϑΦφϕΨψΑαΒβΓγΙι](?![\u0370-\u03ffA-Za-z])")
"""A letter that is an angle, and what says more of it in words of other alphabets or in brackets."""


def _in_degrees(
    names: Sequence[str], units: Sequence[str], columns: Sequence[list[object]], said: str
) -> tuple[list[str], list[str], list[list[object]]]:
    """The same with degrees, minutes and seconds of angles as degrees; lines `said` above may tell how they stand.

    Greek letters of angles do not say which; brackets behind them that do so stay.
    """
    whole = [*zip(names, units, columns, strict=True)]
    for place, (name, unit, column) in enumerate(whole):
        greek = bool(_GREEK_ANGLE.match(name))
        whole_name = greek and resembled(spelled(name))
        plain = name if whole_name else _BRACKETS.sub("", name).strip()
        meant = resembled(spelled(plain))
        if greek or (meant and (meant.column.endswith("_deg") or plain.lower() == "az")):
            cells = figures.sexagesimal(column, f"{name} {unit} {said}")
            if cells != column:
                whole[place] = (f"{plain} (°)", "", cells)
    return tuple(map(list, zip(*whole, strict=True)))  # type: ignore[return-value]


def _check_cut(
    kept: Sequence[tuple[int, Cells]], others: Sequence[tuple[int, Cells]], source: str
) -> None:
    """Refuse a row that begins as a station does and ends before the numbers that all others have."""
    if len(kept) <= LEAST_COLUMNS:
        return
    form = _form(kept[0][1][0])
    cut = [
        r
        for r in others
        if r[1]
        and form
        and _form(r[1][0]) == form
        and any(map(figures.is_figure, r[1][1:]))
        and not any(_SUMMARY.fullmatch(as_text(cell).strip()) for cell in r[1])
        and _texts(r[1]) <= max(_texts(cells) for _, cells in kept)
    ]
    *before, (last, row) = kept
    width = min(len(cells) for _, cells in before)
    numbered = all(figures.is_figure(cells[width - 1]) for _, cells in before)
    if len(row) < width and numbered and _form(row[0]) == form:
        cut.append((last, row))
    if cut:
        line, row = cut[0]
        raise UnreadableFileError(
            f"{source}, row {line}: '{_words(row)}' begins as a station and ends before the numbers of the other "
            "rows. Was the file cut? Export the whole of it."
        )


def _form(cell: object) -> str:
    """A cell with 9 for every number in it; empty for a blank one."""
    return re.sub(r"\d+([.,]\d+)?", "9", as_text(cell))


def _is_fraction(cell: object) -> bool:
    return isinstance(cell, float) and not cell.is_integer()


_SEXAGESIMAL = re.compile(
    r"[+\-−]?(\d{1,3})\s*(?P<mark>[-: ])\s*([0-5]?\d)(?:\s*(?P=mark)\s*([0-5]?\d(?:[.,]\d+)?))?"
)
"""Degrees, minutes and seconds without their signs: 30-15-20, 30 15 20, 30:15."""


def _read(
    names: Sequence[str], columns: Sequence[Cells], texts: Sequence[list[str]], sign: str
) -> tuple[list[str], list[tuple[list[str], str]]]:
    """Names, and cells with a decimal point and the unit in all of them.

    An angle of the stand in degrees, minutes and seconds without their signs is one in degrees.

    >>> _read(["Inc (d m s)", "Time"], [["30 15 36"], ["08:15"]], [["30 15 36"], ["08:15"]], ".")
    (['Inc (°)', 'Time'], [(['30.26'], '°'), (['08:15'], '')])
    """
    whole = [*names]
    read = [*map(figures.column, columns, texts, figures.signs_of(columns, sign))]
    for place, (name, cells) in enumerate(zip(names, texts, strict=True)):
        bare = _BRACKETS.sub("", name).strip()
        if (bare.lower() == "az" or angles_among([bare])) and _are_sexagesimal(cells):
            whole[place] = f"{bare} (°)"
            read[place] = [_of_sexagesimal(cell) for cell in cells], "°"
    return whole, read


def _are_sexagesimal(cells: Iterable[str]) -> bool:
    """Whether all cells that are filled in are of two parts, or of three, with the same sign between them."""
    parts = [_SEXAGESIMAL.fullmatch(cell) for cell in cells if cell]
    counts = {part and (part["mark"], part[4] is None) for part in parts}
    return len(counts) == 1 and None not in counts


def _of_sexagesimal(cell: str) -> str:
    """Degrees of such a cell; blank stays blank."""
    match = _SEXAGESIMAL.fullmatch(cell)
    if not match:
        return cell
    sign = "-" if cell[0] in "-−" else ""
    return _sum(*(part.replace(",", ".") for part in (sign + match[1], match[3], match[4] or "0")))


def _with_minutes(
    names: Sequence[str], cells: Sequence[list[str]]
) -> tuple[list[str], list[list[str]]]:
    """Names and cells; degrees, minutes and seconds in columns of one name become one column of degrees.

    >>> _with_minutes(["Inc deg", "Inc min", "Inc sec", "T"], [["30"], ["15"], ["36"], ["20"]])
    (['Inc (°)', 'T'], [['30.26'], ['20']])
    """
    angles: dict[str, dict[str, int]] = {}
    angle, certain = "", set[str]()
    for place, (name, match) in enumerate(
        zip(names, map(_DEGREES_OF.fullmatch, _with_part_last(names)), strict=True)
    ):
        if match:
            angle = match["of"] or ("" if match["d"] else angle)
            part = str(match.lastgroup)
        else:
            meant = resembled(spelled(name))
            angle, part = name if meant and meant.column.endswith("_deg") else "", "d"
        if angle:
            angles.setdefault(angle, {}).setdefault(part, place)
        if match and match["m"] and (match["of"] or not name.isalpha()):
            certain.add(angle)  # a lone "min" may be the time
    whole, joined = [*names], [*cells]
    for angle, places in angles.items():
        if (
            {"d", "m"} <= {*places}
            and "largest" not in places
            and (angle in certain or "s" in places)
        ):
            every = [places[part] for part in "dms" if part in places]
            first = every[0]
            whole[first] = f"{angle} (°)"
            joined[first] = [_sum(*each) for each in zip(*(cells[k] for k in every), strict=True)]
            for place in every[1:]:
                whole[place] = ""
    kept = [place for place, name in enumerate(whole) if name]
    return [whole[k] for k in kept], [joined[k] for k in kept]


def _with_part_last(names: Sequence[str]) -> list[str]:
    """Names with the part of an angle behind it: deg Inc, Inc_D, where the same angle has another part.

    >>> _with_part_last(["deg Inc", "min Inc", "Az_D", "Az_M", "M_x", "deg"])
    ['Inc deg', 'Inc min', 'Az deg', 'Az min', 'M_x', 'deg']
    """
    forms = ([form.fullmatch(name) for form in _PART_OF_ANGLE] for name in names)
    parts = {k: m for k, each in enumerate(forms) if (m := next(filter(None, each), None))}
    counts = Counter(m["of"].lower() for m in parts.values())
    whole = [*names]
    for place, match in parts.items():
        angle = match["of"]
        signed = match.groupdict().get("sign")
        known = signed or angle.lower() in ("az", "a", "i") or angles_among([angle])
        if known and counts[angle.lower()] in (2, 3):
            whole[place] = f"{angle} {_PARTS_OF_ANGLE[match['part'][0].lower()]}"
    return whole


def _sum(degrees: str, *parts: str) -> str:
    """Degrees, minutes and seconds in degrees; as they stand where one is no number."""
    texts = [degrees, *parts]
    if not all(map(looks_numeric, texts)):
        return " ".join(texts).strip()
    size = sum(abs(float(text)) / 60**power for power, text in enumerate(texts))
    return repr(-size if any(text.startswith("-") for text in texts) else size)


def _words(row: Cells) -> str:
    return " ".join(filter(None, map(as_text, row)))[:60]


def _head(
    rows: Sequence[tuple[int, Cells]], place: int, merged: Merged
) -> tuple[list[str], list[str], int]:
    """Names and units of the columns above the readings, and the place of the first row of them."""
    units: list[str] = []
    readings = rows[place + 1][1] if place + 1 < len(rows) else ()
    if place and all(_OF_LOGGERS.fullmatch(as_text(c)) for c in rows[place][1] if c != ""):
        place -= 1
    if place and is_units(rows[place][1]) and _texts(rows[place - 1][1]) >= LEAST_COLUMNS:
        units = [as_text(cell).strip(" []()") for cell in rows[place][1]]
        place -= 1
    names = [" ".join(as_text(cell).split()) for cell in rows[place][1]]
    units = ["" if unit == name else unit for unit, name in zip_longest(units, names, fillvalue="")]
    top = place
    while (
        top
        and place - top < _MOST_HEADER_ROWS - 1
        and rows[top - 1][0] == rows[top][0] - 1
        and _is_title(rows[top - 1][1])
    ):
        line, row = rows[top - 1]
        spans = {k: end - k for (at, k), (_, end) in merged if at == line and end > k}
        if not _is_of_names(row, names, readings, spans):
            break
        top -= 1
        names = _joined(row, names, spans)
    return names, [*units, *[""] * len(names)][: len(names)], top


def _is_of_names(
    row: Cells, names: Sequence[str], readings: Cells, spans: Mapping[int, int]
) -> bool:
    """Whether a row above names is one of them too: they need its titles, or it names what they leave open.

    That is a column of readings without a name, a symbol, or the units; and a title that is merged over columns is
    one of their group.
    """
    marked = re.match(r"#+\s*\w", as_text(row[0])) and not as_text(names[0]).startswith("#")
    if marked or _is_of_facts(row):
        return False
    if _need_titles(names) or _stands_over_units(row, names):
        return True
    if titles([row]).metadata:
        return False
    each = zip_longest(row, names, readings, fillvalue="")
    lone = any(isinstance(c, str) and c and not name and r != "" for c, name, r in each)
    symbols = any(map(_SYMBOL.fullmatch, names))
    stated = [m[2] for c in row if (m := _UNIT_BEHIND.fullmatch(as_text(c))) and unit_of(m[2])]
    return len(spans) > 1 or len(stated) > 1 or (_texts(row) >= LEAST_COLUMNS and (lone or symbols))


def _is_of_facts(row: Cells) -> bool:
    """Whether a row says something of the tool in its first three cells alone, or of a key and a value in one cell.

    >>> _is_of_facts(["Tool S/N", "A-17"]), _is_of_facts(["# units: deg", "g"]), _is_of_facts(["", "Accel", "Mag"])
    (True, True, False)
    """
    first = as_text(next(filter(None, row), ""))
    few = not any(cell != "" for cell in row[LEAST_COLUMNS - 1 :])
    return bool(re.match(r"\W*[^\W\d_][^:：=]*[:：=]\s*[^\W\d_]", first)) or (
        few and bool(titles([row]).metadata)
    )


def _need_titles(names: Sequence[str]) -> bool:
    """Whether names say nothing alone: axes only, or one name for several columns."""
    bare = [_BRACKETS.sub("", name).strip().lower() for name in names if name]
    axes = any(_AXIS.fullmatch(name) for name in names)
    return axes or max(Counter(bare).values(), default=0) > 1 or _are_parts_of_degrees(names)


def _is_unit(name: str) -> bool:
    """Whether a name is a unit and nothing else."""
    text = name.strip(" []()")
    return bool(unit_of(text)) and not re.search(r"[\s,]", text)


def _stands_over_units(row: Cells, names: Sequence[str]) -> bool:
    """Whether a row has a text over each name that is nothing but a unit, of which there are some."""
    bare = [k for k, name in enumerate(names) if _is_unit(name)]
    return bool(bare) and all(k < len(row) and isinstance(row[k], str) and row[k] for k in bare)


def _is_title(row: Cells) -> bool:
    """Whether a row may be titles of groups of columns: two texts or more, and no numbers."""
    return _texts(row) >= 2 and not any(map(figures.is_figure, row))


def _joined(row: Cells, names: Sequence[str], spans: Mapping[int, int]) -> list[str]:
    """Names with the title above each: that of the column, or of the nearest column to the left that has one.

    A title goes on over names of axes, or over any until a blank one; where cells of its row are merged, by `spans`
    of columns, over these alone.
    """
    above = [" ".join(as_text(cell).split()) for cell in row]
    above += [""] * (len(names) - len(above))
    title, of_axes, end, joined = "", False, 0, []
    for place, (upper, name) in enumerate(zip(above, [*names, *[""] * len(above)], strict=False)):
        of_axis = bool(_axis(name))
        if upper:
            title, of_axes, end = upper, of_axis, place + spans.get(place, 0)
        elif (
            (spans and place > end)
            or not name
            or (of_axes and not of_axis and names.count(name) == 1)
        ):
            title = ""
        joined.append(_with_title(title, name) if title != name else name)
    return joined[: max(len(names), len(above))]


def _with_title(title: str, name: str) -> str:
    """A name behind its title; a unit behind the title comes last, and so does a name that is a unit."""
    if _is_unit(name):
        return f"{title} ({name.strip(' []()')})"
    bracketed = any(unit_of(text.strip("()[]")) for text in _BRACKETS.findall(name))
    match = _UNIT_BEHIND.fullmatch(title) if not bracketed else None
    serial = match and re.search(r"\d{2}", match[2])
    if not match or serial or _DEGREES_OF.fullmatch(name):
        return f"{title} {name}".strip()
    return f"{match[1]} {name}".strip() + f" {match[2]}".replace(" ,", ",")


def is_units(row: Cells) -> bool:
    """Whether a row holds units: of its cells that are filled in two or more are known, and all are short."""
    cells = [as_text(cell).strip() for cell in row if cell != ""]
    bare = [cell.strip("[]()").strip() for cell in cells]
    if _are_parts_of_degrees(bare):
        return False
    known = [cell for cell in bare if unit_of(cell)]
    short = all(len(cell) <= 8 and not re.search(r"[xyz]\b", cell, re.I) for cell in bare)
    return len(known) >= 2 and short and 2 * len(known) >= len([c for c in bare if c.strip("-–")])


def _are_parts_of_degrees(names: Iterable[str]) -> bool:
    """Whether names are of degrees and of minutes right behind them, without the angle whose they are.

    >>> _are_parts_of_degrees(["deg", "min", "sec", "g"]), _are_parts_of_degrees(["deg", "g"])
    (True, False)
    """
    each = (_DEGREES_OF.fullmatch(name.strip("[]()")) for name in names)
    parts = [str(m.lastgroup) if m and not m["of"] else " " for m in each]
    return "dm" in "".join(parts)


def _without_summary(rows: Sequence[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    """Rows of readings without those of statistics: called so, or equal to the means of those above."""
    widths = Counter(sum(cell != "" for cell in row) for _, row in rows)
    usual = max(widths, key=lambda width: widths[width], default=0)
    kept = [row for row in rows if not _is_summary(row[1], usual)]
    statistics = _rows_among_readings([row for _, row in kept])
    kept = [row for place, row in enumerate(kept) if place not in statistics]
    numbered = sum(bool(row) and figures.is_figure(row[0]) for _, row in kept)
    if numbered >= 0.8 * len(kept):  # rows are numbered: one with a word instead is none of them
        kept = [(n, row) for n, row in kept if _is_blank(row[0]) or figures.is_figure(row[0])]
    while len(kept) > LEAST_COLUMNS and _is_mean(kept[-1][1], [row for _, row in kept[:-1]]):
        kept.pop()
    return kept


def _rows_among_readings(rows: Sequence[Cells]) -> set[int]:
    """Rows of statistics by a column that numbers the readings of a station: 1, 2, 3, mean."""
    statistics = set[int]()
    for column in zip_longest(*rows, fillvalue=""):
        texts = ((k, cell.strip()) for k, cell in enumerate(column) if isinstance(cell, str))
        places = {k for k, text in texts if _SUMMARY.fullmatch(text)}
        others = (as_text(cell).strip() for k, cell in enumerate(column) if k not in places)
        if 0 < 2 * len(places) <= len(column) and all(map(_READING.fullmatch, others)):
            statistics |= places
    return statistics


def _is_blank(cell: object) -> bool:
    """Whether a cell is blank or says that there is no value: ---, n/a."""
    return isinstance(cell, str) and bool(WITHOUT_VALUE.fullmatch(cell))


def _is_summary(row: Cells, width: int) -> bool:
    """Whether a row is one of statistics: its name is in front, or anywhere in a row of fewer cells than most."""
    looked_at = row if sum(cell != "" for cell in row) < width else row[:3]
    texts = [cell for cell in looked_at if isinstance(cell, str) and not figures.is_figure(cell)]
    return any(_SUMMARY.fullmatch(text) for text in texts if text)


@np.errstate(over="ignore", invalid="ignore")  # of numbers too large for a mean
def _is_mean(row: Cells, above: Sequence[Cells]) -> bool:
    """Whether numbers of a row are the means of the columns above, in four columns that vary or more."""
    equal = varied = 0
    for place, cell in enumerate(row):
        numbers = (_number(r[place]) for r in above if place < len(r))
        column: Array = np.array([n for n in numbers if n is not None], float)
        value = _number(cell)
        if value is not None and len(column) > 2 and np.ptp(column) > 0:
            varied += 1
            last = 10.0 ** -len(f"{cell}".replace(",", ".").partition(".")[2]) / 2
            near = max(1e-6 * np.ptp(column), min(last, 1e-3 * np.ptp(column)))
            equal += bool(abs(value - column.mean()) <= 1.01 * near)
    return varied >= LEAST_COLUMNS and equal >= varied - 1


def _number(cell: object) -> float | None:
    """The number that a cell is, with either decimal sign; None of one with separators of thousands or with a unit."""
    if isinstance(cell, float | int):
        return float(cell)
    text = as_text(cell).replace(",", ".")
    return float(text) if looks_numeric(text) else None


def as_columns(layout: Layout, labels: Collection[str] = ()) -> dict[str, list[str]]:
    """The cells by the names of the columns; `labels` are columns whose cells are kept as they stand."""
    for name in {*labels}.intersection(layout.fractions):
        raise InputError(
            f"the column {shown(name)}: a serial or label must be text; it has numbers, of which a workbook keeps no "
            "last zero. Say that it is not a serial by `column` serial= or station=, and state the serial by `serial`."
        )
    each = zip(layout.names, layout.cells, layout.texts, strict=True)
    return {name: texts if name in labels else cells for name, cells, texts in each}
