"""Which column of a table is which of the run file, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np

from mwdcal.calibration.readings import EARTH_GRAVITY
from mwdcal.errors import Answer, InputError, QuestionError, QuestionsError
from mwdcal.files.contract import (
    CHANNELS,
    MAPPED,
    RAW,
    REFERENCE_VECTORS,
    REFERENCES,
    forms,
    of_vectors,
    units_of,
)
from mwdcal.files.formats.columns import LABELS, shown
from mwdcal.files.formats.layout import OF_CHECKS, OF_ROLLS
from mwdcal.files.formats.title_references import EARTH_FIELD
from mwdcal.files.formats.titles import titles, unread_declination
from mwdcal.files.profiles import setting
from mwdcal.files.synonyms import (
    ABOVE,
    ANTICLOCKWISE,
    ANTICLOCKWISE_FROM_LOW_SIDE,
    BELOW,
    FACTORS,
    FROM_LOW_SIDE,
    OF_TIME,
    WARMTH,
    Resemblance,
    begins_as,
    resembled,
    synonyms_of,
    unit_of,
)
from mwdcal.files.words import LATIN_AXES, STATIONS_ELSEWHERE, letters, spelled, translated
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.sensor.profile import ColumnSource

# --------------------------------------------------------------------------
# Answers to what a table leaves open: columns, units and triads that may be meant, what is believed first.

MEASURED_BY_TOOL = "the tool has measured"
"""In questions on angles that fit the readings whatever the stand shows."""
SIDE_BY_SIDE = "stand side by side"
OF_SEVERAL_TOOLS = f"tools {SIDE_BY_SIDE}"
"""In questions on channels below several titles, and on those of several tools, whatever the readings fit."""
BOTH_UNITS = " and "
"""What stands between two units of one column, of which one is wrong."""
IN_BRACKETS = re.compile(r"[(\[]([^)\]]*)[)\]]\s*$")
RANGES_BY_UNIT: dict[str, tuple[tuple[str, float, float], ...]] = {
    "ref_gravity_g": (
        ("g", *EARTH_GRAVITY), ("m/s²", 9.757, 9.846), ("mg", 995.0, 1004.0), ("mGal", 975_700.0, 984_600.0),
        ("ft/s²", 32.01, 32.30),
    ),
    "ref_field_nt": (
        ("nT", *EARTH_FIELD), ("µT", 15.0, 80.0), ("gauss", 0.15, 0.8), ("mT", 0.015, 0.08),
        ("mG", 150.0, 800.0),
    ),
}  # fmt: skip
"""Units of quantities of which the Earth has but one range of values; 980 may be milli-g or gal."""
LEAST_ROLLS = 5
"""Toolfaces from which on their range decides the unit."""
_FILLER = re.compile(r"-?9{3,}(\.9+|\.25)?")
_LEAST_FILLER = 999.0
_REGULAR = 0.8
"""Share of equal steps of numbered rows."""
_FEW = 4
"""Values of a column that a question shows."""
_OF_PLACE = 0.01
"""By how much the field or gravity of a place varies at most, as a share."""
_SAME_DIP = 0.2
"""By how much the dip of a place varies at most, degrees."""
_FOLLOWS = 0.9
"""Correlation from which on a column follows what is computed."""
_COPIES = 0.99
"""Correlation from which on a column is another one, corrected: fields near the vertical follow gravity to 0.95."""
_STEADY_DIP, _STEADY_FIELD = 3.0, 0.1
"""A dip varies by less at one place, degrees, and a field by a smaller share."""
STEADY_NORM = 0.15
"""By how much the norm of a triad varies at most, as a share of the range of its channels."""
OF_ONE_SPHERE = 0.05
"""The same of three channels that belong together by their readings alone."""
_OFF_SPHERE = 0.05
"""By how much the squares of norms of a triad differ from a sphere's, as a share of the channels' range squared."""
_LEAST_RANGE = 0.2
"""Least range of a channel of a tool that is turned about every axis, as a share of the largest."""
_LEAST_TURN = 20.0
"""By how much an angle of the stand varies at least, degrees."""
_MOST_SUMMED = 24
"""First columns of numbers among which the three of a total are looked for."""
_MOST_TRIPLES = 6
"""Neighbouring columns that a question offers as a triad."""

Values = Callable[[str], Array | None]
"""The numbers of a column by its name; None where it holds no numbers."""


def none_of(*columns: str) -> Answer:
    """The answer that no column of a table holds these."""
    return Answer("none of them", tuple(("column", f"{column}=") for column in columns))


def with_values(words: str, values: Values, *names: str) -> str:
    """An answer with a few values of each of its columns."""
    few = []
    for name in names:
        cells = values(name)
        known = cells[np.isfinite(cells)] if cells is not None else np.empty(0)
        few.append(first_values(known) or "no numbers")
    return f"{words}:  {'  |  '.join(few)}"


def is_filler(values: Array) -> Bools:
    """Which values (n,) are numbers that programs write where there is none: 9999.99, -999.25.

    >>> is_filler(np.array([9999.99, -999.25, 99.0, 1000.0])).tolist()
    [True, True, False, False]
    """
    fills = np.abs(values) >= _LEAST_FILLER
    fills[fills] = [_FILLER.fullmatch(f"{value:.12g}") is not None for value in values[fills]]
    return np.asarray(fills)


def is_of_tool(name: str) -> bool:
    """Whether a column is called what the tool has measured, or a program computed."""
    return bool(_MEASURED.search(spelled(name)))


def _is_nominal(name: str) -> bool:
    """Whether a column is called what a stand was to be set to."""
    return bool(_NOMINAL.search(name.replace("_", " ")))


def _is_shown(name: str) -> bool:
    """Whether a column is called what a stand shows."""
    return bool(_ACTUAL.search(name.replace("_", " ")))


def is_computed(name: str) -> bool:
    """Whether a column is called what the tool has measured, and not what its stand shows.

    >>> is_computed("Inc calc"), is_computed("Ist Inc")
    (True, False)
    """
    return is_of_tool(name) and not _is_shown(name)


def is_of_surroundings(name: str) -> bool:
    """Whether a column is called the temperature of an oven, a room or the stand.

    >>> [is_of_surroundings(name) for name in ("Oven temp", "Turntable temp", "Temp", "Tool in stand")]
    [True, True, False, False]
    """
    text = f"{name}, {spelled(name)}"
    of_stand = _BY_STAND.search(text) and not _BY_TOOL.search(text)
    return bool(_SURROUNDINGS.search(name) or of_stand)


def is_not_of_tool(name: str) -> bool:
    """Whether a column is called the temperature of other equipment, or one that was set.

    >>> [is_not_of_tool(n) for n in ("Stand electronics", "Oven set point", "PTemp", "Tool in stand", "Electronics")]
    [True, True, True, False, False]
    """
    text = f"{name}, {spelled(name)}"
    of_stand = _BY_STAND.search(text) and "electronic" in text
    other = of_stand or _OTHER_EQUIPMENT.search(text) or _is_nominal(name)
    return bool(other) and not _BY_TOOL.search(text)


def warm_unit(name: str, unit: str) -> str:
    """The unit of temperatures in brackets in a name or in the row of units; empty if the name says another thing.

    >>> [warm_unit(name, "") for name in ("Probe heat (C)", "Probe heat SD (C)", "Gauge C", "Heat (mV)")]
    ['°C', '', '', '']
    """
    bracketed = IN_BRACKETS.search(spelled(name))
    stated = unit_of(spelled(unit)) or (unit_of(bracketed[1]) if bracketed else "")
    other = _is_nominal(name) or any(
        words.search(name) for words in (_SCATTER, _OF_RESIDUALS, _OF_OTHER_WARMTH)
    )
    return stated if stated in units_of(WARMTH) and not other else ""


def is_numbering(values: Array) -> bool:
    """Whether numbers go on in equal steps but for a few, as those of rows and times do, and do not run round a turn.

    >>> is_numbering(np.array([1.0, 2, 3, 3, 4, 5, 6])), is_numbering(np.array([*range(0, 360, 45)] * 2))
    (True, False)
    >>> is_numbering(np.array([*range(0, 360, 45), *range(15, 360, 45)]))
    False
    """
    steps = np.diff(values)
    usual = float(np.median(steps)) if steps.size else 0.0
    back = steps * usual < 0
    turns = back.any() and abs(usual) != 1  # numbers that begin anew count by ones
    return usual != 0.0 and not turns and float(np.isclose(steps, usual).mean()) > _REGULAR


def first_values(values: Array) -> str:
    """The first few of some values."""
    return ", ".join(f"{value:.6g}" for value in values[:_FEW].tolist())


def candidates_for(column: str, names: Iterable[str], values: Values) -> list[Answer]:
    """Each of the names as the answer to which one a column is, and that none is."""
    each = [Answer(with_values(n, values, n), (("column", f"{column}={n}"),)) for n in names]
    return [*each, none_of(column)]


def channels_for(
    column: str, names: Sequence[str], values: Values, others: Sequence[str]
) -> list[Answer]:
    """Columns of numbers that may be a channel: with the `others` of its triad, where both are known, on one sphere."""
    numbers = {n: v for n in names if (v := values(n)) is not None and not is_numbering(v)}
    fits = [n for n in numbers if len(others) < 2 or is_of_one_sphere([*others, n], values)]
    return [Answer(with_values(n, values, n), (("column", f"{column}={n}"),)) for n in fits]


def is_of_one_sphere(names: Sequence[str], values: Values) -> bool:
    """Whether three columns are vectors on a sphere, as channels of a sound triad are but for biases and scales.

    The centre lies no farther from their mean than their range, or any smooth numbers would do: a centre far away
    makes of the sphere a plane.
    """
    columns = np.stack([np.full(0, np.nan) if (v := values(n)) is None else v for n in names], -1)
    columns = columns[np.isfinite(columns).all(-1)]
    if len(columns) <= LEAST_ROLLS:
        return True
    centred, largest = columns - columns.mean(0), float(np.ptp(columns, axis=0).max())
    middle, squares = _sphere(centred)
    left = np.sum(centred**2, -1) - squares
    return bool(np.abs(middle).max() <= largest and np.std(left) <= _OFF_SPHERE * largest**2)


def triples_for(
    channels: Sequence[str], names: Sequence[str], values: Values, most: float = np.inf
) -> list[Answer]:
    """Neighbouring columns that may be a triad, first those of which the norm varies least beside each channel.

    A sound triad has the same norm at every attitude, but for its biases and scales, while each channel varies.
    `most`: by how much it may vary, as a share of the channels' range.
    """
    numbers = {n: v for n in names if (v := values(n)) is not None and np.isfinite(v).all()}
    triples = [each for step in (1, 2) for each in _triples(numbers, step, most)]
    return [
        Answer(
            with_values(", ".join(three), values, *three),
            tuple(("column", f"{c}={n}") for c, n in zip(channels, three, strict=True)),
        )
        for _, three in sorted(triples, key=lambda each: each[0])[:_MOST_TRIPLES]
    ]


def _triples(
    numbers: Mapping[str, Array], step: int, most: float
) -> Iterator[tuple[float, Sequence[str]]]:
    """Three columns, each a `step` behind the one before, with how far their norm varies beside a channel.

    By steps of two, Acc, Mag, Acc, Mag, only those whose names differ in the letters of their axes alone.
    """
    names = [*numbers]
    for place in range(len(names) - 2 * step):
        beside = names[place : place + 2 * step + 1 : step]
        three = _in_order_of_axes(beside) or (beside if step == 1 else [])
        if not three:
            continue
        columns = np.stack([numbers[n] for n in three], -1)
        spread, variation = np.ptp(columns, axis=0), _variation(columns)
        if spread.min() > 0 and variation <= most * spread.max():
            yield variation / float(spread.min()), three


def _in_order_of_axes(names: Sequence[str]) -> Sequence[str]:
    """Three names in the order x, y, z of the letters in which alone they differ; none where they differ otherwise.

    >>> _in_order_of_axes(["Fy (V)", "Fx (V)", "Fz (V)"]), _in_order_of_axes(["B3", "B1", "B2"])
    (['Fx (V)', 'Fy (V)', 'Fz (V)'], [])
    """
    whole = _but_for_axes((name, name) for name in names)
    return next(([each[axis] for axis in "xyz"] for each in whole.values()), [])


def _but_for_axes(texts: Iterable[tuple[str, str]]) -> dict[str, dict[str, str]]:
    """What three texts have in common that differ in the letter of an axis alone, with the name of each by its axis.

    `texts`: each with its name.
    """
    stems: dict[str, list[tuple[str, str]]] = {}
    for text, name in texts:
        for place, letter in enumerate(text):
            if (axis := letter.lower().translate(LATIN_AXES)) in "xyz":
                stem = f"{text[:place]} {text[place + 1 :]}"
                stems.setdefault(stem, []).append((axis, name))
    return {
        stem: dict(each)
        for stem, each in stems.items()
        if sorted(axis for axis, _ in each) == [*"xyz"]  # of two triads neither is meant
    }


def _variation(columns: Array) -> float:
    """The standard deviation of the distance (n,) of vectors (n, 3) from the centre of the sphere nearest to them."""
    centred = columns - columns.mean(0)
    middle, _ = _sphere(centred)
    return float(np.std(np.linalg.norm(centred - middle, axis=-1)))


def _sphere(centred: Array) -> tuple[Array, Array]:
    """The centre (3,) of the sphere nearest to vectors (n, 3), and the squares of their norms on it (n,)."""
    design = np.column_stack([2 * centred, np.ones(len(centred))])
    solution, *_ = np.linalg.lstsq(design, np.sum(centred**2, -1), rcond=1e-9)
    return solution[:3], design @ solution


def in_units(name: str, column: str, allowed: Sequence[str]) -> list[Answer]:
    """Each of the units as the answer to the one that a column is in; no reading tells a low side from a high side."""
    others = [unit for unit in allowed if unit not in (FROM_LOW_SIDE, ANTICLOCKWISE_FROM_LOW_SIDE)]
    return [Answer(unit, (("column", f"{column}={name} ({unit})"),)) for unit in others]


def lacking_references(present: Collection[str]) -> list[str]:
    """References of a run that a table should have, and has none of, beside its channels."""
    magnetic = () if {*present}.isdisjoint(RAW[3:]) else ("azimuth", "field", "dip")
    names = (REFERENCES[name].column for name in ("inclination", "toolface", *magnetic))
    return [column for column in names if column not in present]


def is_near(column: str, name: str) -> bool:
    """Whether a word of a name is one of a column's but for a letter, or two that are exchanged.

    >>> [is_near("ref_dip_deg", n) for n in ("Dpi (°)", "Inklinatoin des Feldes", "Pos")]
    [True, True, False]
    """
    words = re.findall(r"[^\W\d_]{3,}", spelled(IN_BRACKETS.sub("", name)).lower())
    return not OF_TIME.fullmatch(name) and any(
        _is_mistyped(word, each) for word in words for each in _words_of(column)
    )


@cache
def _words_of(column: str) -> frozenset[str]:
    """Words of three letters or more that say of a column that it is one of a run file's."""
    return frozenset(synonyms_of(column)) | translated(column)


def _is_mistyped(word: str, meant: str) -> bool:
    """Whether a word is another one with a later letter too many, missing or wrong, or two exchanged."""
    if word == meant or word[0] != meant[0] or abs(len(word) - len(meant)) > 1:
        return False
    first = next(
        (k for k, (a, b) in enumerate(zip(word, meant, strict=False)) if a != b),
        min(len(word), len(meant)),
    )
    one, two = word[first:], meant[first:]
    exchanged = one[1::-1] + one[2:] == two and len(one) > 1
    return exchanged or one[1:] == two or one == two[1:] or (len(word) > 3 and one[1:] == two[1:])


def may_be(column: str, name: str, unit: str, values: Array | None) -> bool:
    """Whether a column whose name says nothing may be a reference by its unit and its values.

    An angle of the stand varies; dip and field hardly do, and state their unit.
    """
    known = values[np.isfinite(values)] if values is not None else np.empty(0)
    if known.size < LEAST_ROLLS:
        return False
    stated = _unit_beside(name, unit)
    foreign = bool(unit or IN_BRACKETS.search(spelled(name))) and not stated
    low, high = float(known.min()), float(known.max())
    if column == REFERENCES["dip"].column:
        steep = min(abs(low), abs(high)) > 5 and max(abs(low), abs(high)) < 90
        return stated == "°" and high - low < _STEADY_DIP and steep
    if column == REFERENCES["field"].column:
        least, most = _range_in(column, "nT" if not stated and not foreign else stated)
        return least <= low and high <= most and high - low < _STEADY_FIELD * high
    if stated not in ("", "°", "rad", "gon") or high - low < _LEAST_TURN:
        return False
    inside = 0 <= low <= high <= 180 if "inclination" in column else -360 <= low <= high <= 360
    return inside and not is_numbering(known)


_LABELS = {
    "station": "station stn sta stationnr stationno stationnumber position pos posnr messpunkt messpunktnr punkt "
    "punktnr pkt point shot setting nr no stasjon posisjon stellung estacion posicion punto estacao posicao ponto lage "
    "row id " + STATIONS_ELSEWHERE,
    "group": "group gruppe set rollset",
}
"""Names of columns of labels; a column is one only where no other is."""
_CALLED_REFERENCE = re.compile(r"\b(ref|reference|nominal|target|set)\b", re.IGNORECASE)
_REFERRED = re.compile(
    r"\b(ref|iref|reference|referenz|referanse|referencia|obs|observatory|эт|эталон\w*|опорн\w*)\b|基准|参考|\bref(?=[a-z]\b)",
    re.IGNORECASE,
)
_OF_RESIDUALS = re.compile(
    r"residu|restfehler|restabw|abweichung|(?<![^\W\d_])(err|error|fehler|feil|avvik)|остат|невяз|погрешн|残差|误差",
    re.IGNORECASE,
)
"""Words of what a fit has left of a channel."""
_OF_FIELD = re.compile(
    r"^[FBT][\s_(\[]+([nuµ]T|gauss)\b|field|fel[dt]|base ?mag|campo|champ|поле|磁场|proton|overhauser",
    re.IGNORECASE,
)
_MEASURED = re.compile(
    r"\b(measured|meas|calc|calculated|computed|corr|corrected|gemessen|m[åa]lt|sum|ist|mwd|survey|"
    r"(be|er)rechnet\w*|beregnet|berekend\w*|calculad[oa]|computad[oa]|calcul[ée]e?|calcolat[oa]|расч|расч[её]?т\w*|"
    r"рассчит\w*|вычисл\w*)\b|计算|解算|(?<=[^\W\d_])calc\b",
    re.IGNORECASE,
)
"""Words of angles that the tool itself has measured: no references."""
_NO_STAND = re.compile(
    rf"({_MEASURED.pattern})|\b(err\w*|delta|diff\w*|dev\w*|res\w*|sd|std\w*|unc\w*|sigma|rate|last|previous|old|"
    r"check|fehler|abw\w*|feil|avvik|desv\w*|erro\w*|ecart|погрешн\w*|откл\w*)\b|误差|偏差",
    re.IGNORECASE,
)
"""Words of columns of angles that do not belong to the stand."""
_NOMINAL = re.compile(
    r"\b(nominale?|target|set( ?-?point)?|sett?punkt\w*|dese[aj]ad[oa]|gew[üu]nscht\w*|[øo]nske[dt]|"
    r"soll\w*|eingestellt\w*|vorgabe|satt|innstilt|innst|ajustad[oa]|"
    r"fijad[oa]|"
    r"definid[oa]|programad[oa]|desired|intended|planned|requested|te[óo]ric[oa]|th[ée]orique|r[ée]gl[ée]e?|vis[ée]e?|установ(ка|лен\w*)|уставк\w*|cmd|command(ed)?|demand(ed)?|required|nom|consign[ea]|comandad[oa]|"
    r"зад|zadan\w*|b[öo]rv[äa]rde|задан\w*|номинал\w*)\b|[设给]定|设置|理论|名义|目标|指令値?|目標値?|設定値?",
    re.IGNORECASE,
)
_ACTUAL = re.compile(
    r"\b(actual|act|achieved|as read|read ?back|read ?out|observed|(ab)?gelesen\w*|avlest|odczyt\w*|"
    r"le[íi]d[oa]|lid[oa]|lue?|"
    r"relev[ée]e?|r[ée]el(le)?|efetiv[oa]|efectiv[oa]|отсч[её]т\w*|read|reading|encoders?|ist|istwerte?|effettiv[oa]|mesur[ée]e?s?|medid[oa]|zmierzon\w*|"
    r"[äa]rv[äa]rde|действит\w*|факт|фактич\w*|измер\w*|real|faktisk)\b|实际|实测|测得|读数|编码器|実測値?|実際",
    re.IGNORECASE,
)
"""Words of angles to which a stand was to be set, and of those that it shows."""
_BY_STAND = re.compile(
    r"\b(stand|bench|fixture|rig|cradle|turn ?table|encoder|enc|pr(ü|ue)fstand|drehtisch|benk|banco|mesa|banc|"
    r"banchetto|стенд\w*|стол\w*|установк\w*|энкодер\w*)\b|台架|转台|校验台|编码器",
    re.IGNORECASE,
)
_BY_TOOL = re.compile(
    r"\b(tool(?! ?face)|probe|sonde|sonda|mwd|instrument\w*|ger(ä|ae)t\w*|verkt(ø|oe?)y|ferramenta|herramienta|outil|"
    r"прибор\w*|зонд\w*|инклинометр\w*)\b|探管|仪器|探头",
    re.IGNORECASE,
)
"""Words of an angle that a stand shows, and of one that the tool tells."""
_OF_CHANNELS = re.compile(r"\b(measured|meas|gemessen|m[åa]lt|ist)\b", re.IGNORECASE)
"""Those that say nothing more of a channel."""
_CORRECTION = re.compile(
    r"(corr|korr|[ck]alib|[ck]ompens|[ée]talonn|скорр|откорр|корр|исправ|поправ|калибр|компенс|обработ)[^\W\d_]*|"
    r"cal(?![^\W\d_])|校正|修正|标定|校准|补偿"
)
_CORRECTED = re.compile(
    rf"(?<![^\W\d_])({_CORRECTION.pattern})|校正|修正|标定|校准|补偿", re.IGNORECASE
)
_UNCORRECTED = re.compile(
    r"((leituras?|lecturas?|avlesning|ablesung|valor(es)?|valeurs?|показания?|значения?)[ _]+)?"
    r"(?<![^\W\d_])((raw|roh|rå)(werte?|daten|data|signale?|verdi(er)?|v[æä]rd[^\W\d_]*)?|crud[oa]s?|brut[oae]?s?|"
    r"сыр[^\W\d_]*|исходн[^\W\d_]*|(un|u|o|не|(not|nicht|ikke|icke|inte|no|n[ãa]o|non|sin|sem|sans|without|ohne|uten|"
    rf"utan|без|до|before|vor|f[øö]r|antes d[ea]|avant)( (the|der|la|a))? )({_CORRECTION.pattern}))(?![^\W\d_])|"
    rf"原始(数据|值)?|未经?({_CORRECTION.pattern})|({_CORRECTION.pattern})前",
    re.IGNORECASE,
)
"""Words of channels that the tool or a laboratory has corrected, and of those beside them that are as measured."""
_OTHER_NORTH = re.compile(
    r"true|grid|geogr|wahr|gitter|rechtweisend|[qc]uadr[ií]cula|verdadero|verdadeiro|istinn|kartnord|истин|сетк|географ|géogr|真|坐标北|网格",
    re.IGNORECASE,
)
_GRID_NORTH = re.compile(r"grid|gitter|[qc]uadr[ií]cula|kartnord|сетк|坐标北|网格", re.IGNORECASE)
_OF_NORTH = re.compile(r"north|nord|norte|azi|azm|heading|азим|север|北|方位", re.IGNORECASE)
"""Words of the north that azimuths count from."""
_CALLED_NORTH = re.compile(
    r"(?<![^\W\d_])([tmg]|true|mag\w*|grid|geogr\w*|wahr|ист\w*|магн\w*)(?![^\W\d_])|[真磁]",
    re.IGNORECASE,
)
_IN_DOUBT = re.compile(r"[^\W\d_]\s*[)\]]?\s*[?？](?![^\W\d_])")
"""A question mark behind a word; behind a number, alone or within a word it is a letter that was lost."""
_TWICE = re.compile(r" \(\d+\)$")
"""The end of a name that stands in a table more than once."""
_LONE_AXIS = re.compile(r"(?<![^\W_])([xyzXYZ])(?![^\W_])")
"""An axis that stands alone in a name."""
_NUMBERED = re.compile(r"(.*?[^\W\d_])[ _\-\[]*([0-3])\]?((?:\W.*|_[A-Za-z]+)?)")
_ANGLES_AND_WARMTH = (
    *(REFERENCES[name].column for name in ("inclination", "azimuth", "toolface")),
    WARMTH,
)
"""Columns of which values tell the unit beside a word that is not a unit, such as deg of a temperature."""
BY_NAME_ALONE = (WARMTH, REFERENCES["gravity"].column)
"""Columns that a run may lack, and that values alone do not tell."""
_OF_PLACE_ALONE = tuple(REFERENCES[name].column for name in ("gravity", "field", "dip"))
"""Columns of what a place has, and no setting of the stand changes."""
_OF_TOOL = re.compile(
    r"(?<![^\W\d_])(tool|probe|sonde|sonda|mwd|firmware|fw)(?![^\W\d_])", re.IGNORECASE
)
_TITLE = re.compile(
    r"(?:(?P<a>acc|accelerometers?|grav\w*)|(?P<m>mag\w*|(total )?field))?(?:s|ref| ?sensors?)? +",
    re.IGNORECASE,
)
"""The title of a group of columns before the name of one."""
_BARE_AZ = re.compile(r"az\W*(deg|°)?\W*(mag(netic)?|true|grid)?\W*", re.IGNORECASE)
_BARE_AX = re.compile(r"a[xy]\b.*", re.IGNORECASE)
_OF_LOGGER = re.compile(
    r"\s*(?:channel|chan|ch|input|ai|kanal|eingang|canal|voie|канал|通道)\W*\d*\s*[(\[:]\s*"
    r"([^()\[\]]+?)\s*[)\]]?(\s*[(\[].*)?",
    re.IGNORECASE,
)
"""A channel of a logger, with what it is in brackets or behind a colon."""
_NUMBER_OF_CHANNEL = re.compile(r"^(k|ch|ai|kanal|canal) ?\d{1,2}[\s_]+(?=\S{2})", re.IGNORECASE)
"""The number of a channel of a logger before its name: K1 AccX."""
_SCATTER = re.compile(r"s (?=[gabhm][xyz]\b)|[sσ] ?\(|σ|ско\b", re.IGNORECASE)
"""How the name of the scatter of the samples of a channel begins, which is no channel."""
_OF_SAMPLES = re.compile(
    r"(of|over|from|aus|von|av|de|из|по) (the )?(last )?\d+ (samples|readings|scans|messwerte\w*|m[åa]linger|muestras|"
    r"lecturas|amostras|leituras|mesures|отсч[её]т\w*|измерени\w*)|^\W*n_?(avg|samples|smp)\W*$|"
    r"\b(num(ber)?|no|count)\W*(of)?\W*samples\b",
    re.IGNORECASE,
)
"""How many samples a mean is of, in a line or as the name of a column."""
_SPREADS_OF_CHANNELS = tuple(f"sd_{name}" for name in RAW)
_IN_UNIT = re.compile(r"(.*[\w)\]]) (?:in|en|i|w|в) (\S+)", re.IGNORECASE)
"""A name with its unit behind a preposition: Gx in mg."""
_BARE_T = re.compile(r"t\W*(°|deg)?\W*", re.IGNORECASE)
_CCW = re.compile(
    r"\(?\b((in|sens|sentido|senso|im) )*((counter|anti)[ -]?clockwise\)?|ccw\b|a/?cw\b|gegen (den )?uhrzeiger\w*|"
    r"против (хода )?час\w*( стрелк\w*)?|mot(urs| ?(klok|urvis)\w*)|anti-? ?hor[aá]ri[oa]s?|anti-? ?horaires?|"
    r"antiorari\w*|trigonom[ée]tri(que|co)|inverse des aiguilles( d'une montre)?|tegen de klok( in)?|"
    r"contrari\w+ a(l reloj| las (agujas|manecillas)( del reloj)?)|contr[aá]rio ao(s ponteiros)?( do)? rel[oó]gio|"
    r"przeciwn\w* do (ruchu )?wskaz[oó]wek( zegara)?|linksom\b|linksherum\b|linksdrehend\w*|"
    r"lev[oó]gir[oa]s?|sinistrors[oia]|venstredreid\w*)|逆时针(方向)?|反時計(回り|方向)?",
    re.IGNORECASE,
)
"""Words of angles that count anticlockwise."""
_OF_TOOLFACE = re.compile(r"toolface|\broll?\b|\broll|\btf\b|angle de rotation", re.IGNORECASE)
_ZERO = re.compile(
    r"(?:(?<![\d.,])0(?:[.,]0+)?\s*(?:°|deg\w*|gra[du]\w*)?(?![\d.,]*\d)|zero|null(?:punkt)?|cero|ноль|нуль|零)"
).pattern
_LOW_SIDE = re.compile(
    r"(?:low[- ]?side|lavside\w*|l[aå]gside\w*|tiefseite|unterseite|lage zijde|onderzijde|"
    r"lado (?:de )?(?:abajo|bajo|baixo)|c[oô]t[eé] bas|lato (?:basso|inferiore)|"
    r"нижн\w+ сторон\w+|нижн\w+ стенк\w+|doln\w+ stron\w+|低边|下侧|"
    r"(?:scribe|mark(?:e|er|ierung)?|key(?:way)?|notch|slot|kerbe|nut|merket?|riss|marca|ranura|rasgo|rep[eè]re|encoche|"
    r"tacca|ritslijn|merkteken|znak|ryska|риск\w*|метк\w*|标记|刻线|键槽)(?: line)?[^\d,;.]{0,20}?"
    r"(?<![^\W\d_])(?:down(?:wards?)?|at (?:the )?bottom|unten|ned(?:over)?|nere?|nedåt|onder|beneden|(?:hacia )?abajo|"
    r"(?:para )?baixo|(?:vers le|en) bas|in basso|w dół|na dole|вниз\w*|снизу)(?![^\W\d_])|(?:标记|刻线|键槽)[朝向]?下)"
).pattern
_HIGH_SIDE = re.compile(
    r"(?:high[- ]?side|h[øo]yside|h[öo]gside|oberseite|hochseite|hoge zijde|bovenzijde|lado (?:de )?alto|"
    r"lado (?:de )?(?:arriba|cima)|c[oô]t[eé] haut|lato alto|верхн\w+ сторон|верхн\w+ стенк|g[óo]rn\w+ stron|高边|上侧)"
).pattern
_FROM_LOW = re.compile(
    rf"(?:^|[,;.])(?:(?!{_HIGH_SIDE})[^,;.])*?"
    rf"(?:{_ZERO}|(?<![^\W\d_])(?:from|von|ab|desde|a partir d[eo]|fra|från|depuis|vanaf|dal?|от|od)(?![^\W\d_])|从|自)"
    rf"(?:(?!{_HIGH_SIDE})[^\d,;.]|,(?=\s*(?:wenn|когда|если|коли|da|gdy)\b)){{0,30}}?{_LOW_SIDE}|"
    rf"{_LOW_SIDE}\s*[)\]]?\s*(?:[=:：]|is|at|bei|ist|ved|en|is op|为)\s*{_ZERO}",
    re.IGNORECASE,
)
"""Words of toolfaces that count from the low side, or that are zero where the mark of the tool is down.

Behind words for the high side they say where the angle goes, and not where it begins.
"""
_UPHOLE = re.compile(
    r"look\w* up|up ?hole|from (the )?(below|bottom)|von unten|nedenfra|desde abajo|visto de baixo|d'en bas|du bas|"
    r"z dołu|od dołu|снизу|向上看|从下",
    re.IGNORECASE,
)
"""Words of one who looks up the hole, to whom a clockwise angle is an anticlockwise one."""
_FROM_HORIZONTAL = re.compile(
    r"hori[sz]|orizz|горизонт|обрі|waag\w*recht|v(a|å|aa)n+ret|vaaka|poziom|vodorovn|vizszint|yatay|水平",
    re.IGNORECASE,
)
"""Words of angles that count from the horizontal."""
_ANGLE_ALONE = re.compile(
    r"\W*(angle|winkel|vinkel|[áâ]ngulo|угол)( ([^\W\d_]{1,4}|with|par|rapport))*\W*", re.IGNORECASE
)
"""The word for an angle and none of which, before that of the horizontal."""
_DOWNWARDS = re.compile(
    r"below|abaixo|\b((por )?debajo|unter(halb)?|under|sous|poni[żz]ej|ниже)\b|下方|以下|"
    r"\b(down(wards?)?|nach unten|abwärts|ned(over)?|hacia abajo|para baixo|vers le bas|вниз)\b|向下|俯角",
    re.IGNORECASE,
)
"""Words of angles from the horizontal that count downwards."""
_SPOKEN = {
    "rad": re.compile(r"radian|радиан|(?<!\d)(?<!\d )\brad\b", re.IGNORECASE),
    "gon": re.compile(
        r"(?<!\d)(?<!\d )\bgon\b|\b400 ?g(on|r|rad\w*)?\b|\ben grades\b|\bneugrad|\bnygrader|\bgra[ud]\w+ cent[eé]s\w*",
        re.IGNORECASE,
    ),
}
"""Units of angles in a line above a table, not those of a number."""
_SPOKEN_WARMTH = {
    unit: re.compile(
        rf"(?<![\d.,])(?<![\d.,] )(°\s*{letter}|\bdeg(rees)? ?{letter}|(\b(in|en|em|i|в) |为\s?){letter}|"
        rf"{word})(?![^\W\d_])",
        re.IGNORECASE,
    )
    for unit, letter, word in (
        ("°C", "C", "celsius"),
        ("°F", "F", "fahrenheit"),
        ("K", "K", "kelvins?"),
    )
}
"""Units of temperatures in a line above a table, not those of a number."""
_SURROUNDINGS = re.compile(
    r"oven|chamber|ambient|thermostat|kamer\b|(?<![a-z])(air|aire|ar|luft|room|bath|lab(or\w*)?)(?![a-z])|ofen|kammer|sala|habitaci|oficina|umgebung|raum|ovn|rom|horno|ambiente|"
    r"камер|печ|термостат|воздух|空气|环境|烘箱|室温",
    re.IGNORECASE,
)
"""Surroundings of the tool, with a temperature of their own."""
_OTHER_EQUIPMENT = re.compile(
    r"(?<![^\W\d_])(power|suppl(y|ies)|psu|netz(teil|ger(ä|ae)t)\w*|str(om|øm)(versorgung|forsyning)|fuente|fonte|alimenta\w*|"
    r"питани\w*|rack|cabinet|panel|p_?temp|logger|daq|dmm|multimeter|pc|computer|rechner|ordenador|компьютер\w*|"
    r"controller|regler|steuerung|контроллер\w*|motor|amplifier|heat ?sink|outside|outdoors?|exterior|au(ß|ss)en\w*|"
    r"наружн\w*|observatory|coils?|helmholtz\w*|check standard|golden|dummy)(?![^\W\d_])|电源|控制器|室外",
    re.IGNORECASE,
)
"""Equipment with a temperature of its own, beside the tool or elsewhere."""
_OF_OTHER_WARMTH = re.compile(
    r"(?<![^\W\d_])(sd|std|stdev|dev|sigma|unc|delta|diff|dew|rate|grad\w*|min|max|limit|range|offset|coeff\w*)(?![^\W\d_])",
    re.IGNORECASE,
)
"""Words of a column in a unit of temperatures that has no temperature of the tool."""
COOLEST_FAHRENHEIT = 45.0
"""Numbers below it are degrees Celsius: no tool is calibrated below 7 °C alone."""
COLDEST_KELVIN = 200.0
"""Numbers below it are no kelvins: hardly a tool works below -73 °C."""
OVER_CELSIUS = 260.0
"""Numbers above it, beside some that are no kelvins, are degrees Fahrenheit."""
HOTTEST_CELSIUS = 200.0
"""Numbers above it may be degrees Fahrenheit: hardly a tool works above 200 °C."""


def meaning(name: str, unit: str = "") -> Resemblance | None:
    """Content of a column by its name, and its unit, stated beside the name or in it."""
    if name in MAPPED:
        return Resemblance(name, unit_of(unit) or "".join(units_of(name)[:1]))
    if both := _two_units(name, unit):
        once = meaning(name)
        return once and once._replace(unit=both if units_of(once.column) else unit)
    if _SCATTER.match(name) or _OF_RESIDUALS.search(name):
        return None
    name = _bracketed(name)
    plain = spelled(f"{name} ({unit})" if unit else name)
    if elevation := _elevation(name, plain, unit):
        return elevation
    if _CCW.search(plain):
        turned = resembled(_CCW.sub("", plain))
        return turned and (
            turned._replace(unit=ANTICLOCKWISE) if turned.column == "ref_toolface_deg" else turned
        )
    alike = (
        resembled(plain) or _without_title(plain) or resembled(f"{name} ({unit})" if unit else name)
    )
    alike = alike or _twice(plain) or _at_stand(plain) or _abbreviated(plain)
    if alike and alike.column in RAW and _CALLED_REFERENCE.search(plain):
        return alike._replace(column=REFERENCE_VECTORS[RAW.index(alike.column)])
    if _MEASURED.search(plain) and not (alike and alike.column == WARMTH):
        return _measured_channel(plain)
    near = {form: column for column in MAPPED for form in forms(column)}
    spelt = next((near[form] for form in forms(plain) if form in near), None)
    stated = IN_BRACKETS.search(plain)
    if alike and alike.column == REFERENCES["azimuth"].column and alike.unit.startswith("mag"):
        return alike._replace(unit="")
    if not alike and not spelt:
        read = _measured_channel(plain)
        return read or _by_axis_and_unit(name, unit or (stated[1] if stated else ""))
    return alike or Resemblance(spelt or "", unit_of(stated[1]) if stated else "")


def _bracketed(name: str) -> str:
    """A name without what a logger writes before it, and with its unit in brackets."""
    name = _NUMBER_OF_CHANNEL.sub("", name)
    logged = _OF_LOGGER.fullmatch(name)
    name = f"{logged[1]}{logged[2] or ''}" if logged else name
    worded = _IN_UNIT.fullmatch(name)
    if not worded or not unit_of(spelled(worded[2])):
        return name
    words = re.sub(r"[()\[\]]", "", worded[1])
    return f"{words} ({worded[2]})"


def _elevation(name: str, plain: str, unit: str) -> Resemblance | None:
    """The inclination that a name says to count from the horizontal, in whatever words."""
    sense = BELOW if _DOWNWARDS.search(plain) else ABOVE
    if "elevation" in plain:
        return Resemblance(REFERENCES["inclination"].column, sense)
    level = _FROM_HORIZONTAL.search(name)
    if level and _ANGLE_ALONE.fullmatch(name[: level.start()]):
        return Resemblance(REFERENCES["inclination"].column, sense)
    bare = level and (resembled(plain) or meaning(_bare(name, level), unit))
    inclined = bare and bare.column == REFERENCES["inclination"].column
    return bare._replace(unit=sense) if bare and inclined else None


def _by_axis_and_unit(name: str, unit: str) -> Resemblance | None:
    """The channel that a name in whatever words is by its axis and a unit that one triad alone has."""
    axes = _LONE_AXIS.findall(IN_BRACKETS.sub("", name))
    known = unit_of(spelled(unit))
    if (
        len(axes) != 1
        or known not in _OF_UNITS
        or unit.strip() in ("G", "mG")
        or _CALLED_REFERENCE.search(spelled(name))
    ):
        return None
    return Resemblance(f"{_OF_UNITS[known]}{axes[0].lower()}", known)


def _bare(name: str, level: re.Match[str]) -> str:
    """A name without its words from one such as "from" before the horizontal on, but with its unit."""
    head = re.sub(r"\W+[^\W\d_]{1,4}\W*$", "", name[: level.start()])
    unit = IN_BRACKETS.search(name)
    return f"{head} {unit[0] if unit and level.start() < unit.start() else ''}".strip()


def _measured_channel(name: str) -> Resemblance | None:
    """The channel that a name is but for a word that says so: meas_gx, Gx read."""
    bare = _ACTUAL.sub("", _OF_CHANNELS.sub("", name))
    alike = resembled(bare) if bare != name else None
    return alike if alike and alike.column in RAW else None


def _twice(name: str) -> Resemblance | None:
    """The column that a name says in words and in short, Inclination Inc (°), or by its symbol, Azimuth A (°)."""
    words, unit = name.split(), ""
    if len(words) > 2 and IN_BRACKETS.search(words[-1]):
        unit = words.pop()
    if len(words) < 2:
        return None
    one, two = (resembled(f"{text} {unit}".strip()) for text in (" ".join(words[:-1]), words[-1]))
    same = one and two and one.column == two.column
    return one if same or (one and _is_symbol(words[-1], one.column)) else None


def _at_stand(name: str) -> Resemblance | None:
    """The angle that a name says beside a word of the stand, or of a part in brackets: Inc mesa, Roll (disc)."""
    if _BY_TOOL.search(name) or _NO_STAND.search(name) or _is_nominal(name):
        return None
    aside = re.search(r"\s*\(([^()]*)\)(?=\s*\S)", name)
    part = aside[0] if aside and not unit_of(aside[1]) and not resembled(aside[1]) else ""
    bare = " ".join(_BY_STAND.sub(" ", name.replace(part, " ") if part else name).split())
    alike = resembled(bare) if bare not in ("", name) else None
    return alike if alike and alike.column in _ANGLES_AND_WARMTH[:3] else None


def _abbreviated(name: str) -> Resemblance | None:
    """The angle or temperature of which words alone a name is the beginning, with a point behind it: Verdr. (°)."""
    short = re.fullmatch(r"([^\W\d_]{3,})\.\s*(?:[(\[]?([^()\[\]]*)[)\]]?)", name.lower())
    if not short or unit_of(short[1]) or _NO_STAND.search(name):
        return None
    meant = [
        column
        for column in (*_ANGLES_AND_WARMTH, REFERENCES["dip"].column)
        if any(word.startswith(short[1]) for word in _words_of(column))
    ]
    return Resemblance(meant[0], unit_of(short[2])) if len(meant) == 1 else None


def _is_symbol(word: str, column: str) -> bool:
    """Whether a word is a letter, of no axis and no north, behind the name of a reference or a temperature."""
    others = "xyz" + ("mtg" if column == REFERENCES["azimuth"].column else "")
    referred = column in (WARMTH, *(each.column for each in REFERENCES.values()))
    return referred and len(word) == 1 and word.isalpha() and word.lower() not in others


def _two_units(name: str, unit: str) -> str:
    """The units by a name, by the row below it and by its cells in words, if two of them differ; else empty."""
    bracketed = IN_BRACKETS.search(spelled(name))
    by_name = unit_of(bracketed[1]) if bracketed else ""
    every = dict.fromkeys(filter(None, [by_name, *map(unit_of, spelled(unit).split(BOTH_UNITS))]))
    return BOTH_UNITS.join(every) if len(every) > 1 and {*every} != {"g", "gauss"} else ""


def _without_title(name: str) -> Resemblance | None:
    """Column that a name resembles behind the title of its group, which says no other triad: Accelerometers Gx (V)."""
    title = _TITLE.match(name)
    alike = resembled(name[title.end() :]) if title else None
    if not title or not alike:
        return None
    triad = title.lastgroup
    return None if triad and alike.column[0] != triad else alike


def meanings_of(
    names: Sequence[str], units: Sequence[str], above: Sequence[str] = ()
) -> dict[str, Resemblance]:
    """The meaning of each column, by its name, the names of the others and the lines above them.

    Channels may be numbered: G1, G2, G3. `AZ` without `AX` and `AY` is the azimuth. Inklination is the dip where
    there is a Neigung.
    """
    numbered = _numbered(names, _axes_of_numbers(above))
    bare = {name: _TWICE.sub("", name) for name in names}
    once = {
        name: numbered.get(name, base if base in names else name) for name, base in bare.items()
    }
    results = {
        name: m
        for name, unit in zip(names, units, strict=True)
        if (m := meaning(once[name], unit))
        and not (m.column in RAW and m.unit in ("°", "rad", "gon"))
        and not (m.column == WARMTH and m.unit in _OF_UNITS)
    }
    results = _by_legend(names, above) | results | _explained(names, above)
    results |= _behind_titles(names, units, results)
    results |= _beside_nominal(names, units, results)
    results |= _beside_others(names, units, results)
    results |= _by_axes(names, units, results)
    results = _without_roll_test(_with_raw_channels(once, units, results))
    every = [n for n, m in results.items() if m.column == "az"]
    lone = [n for n in every if _BARE_AZ.fullmatch(n)]
    triad = [n for n in every if n not in lone[:1]] or any(_BARE_AX.fullmatch(n) for n in names)
    if lone and (not triad or (len(every) == 2 and _follows(names, every, lone[0], results))):
        results[lone[0]] = Resemblance("ref_azimuth_deg", "°")
    inclined = [n for n, m in results.items() if m.column == "ref_inclination_deg"]
    dips = [n for n in inclined if re.search("inklination", n, re.IGNORECASE)]
    if len(dips) == 1 and any(re.search("neigung", n, re.IGNORECASE) for n in inclined):
        results[dips[0]] = results[dips[0]]._replace(column="ref_dip_deg")
    return results | _toolfaces_by_words(results, above)


def _toolfaces_by_words(
    meanings: Mapping[str, Resemblance], above: Sequence[str]
) -> dict[str, Resemblance]:
    """The toolfaces that a line, or their name, says to count anticlockwise or from the low side."""
    results = {}
    every_turned, every_low = (
        any(map(says, above)) for says in (_says_anticlockwise, _says_from_low_side)
    )
    for name, each in meanings.items():
        known = unit_of(each.unit) in ("", "°", ANTICLOCKWISE)
        if each.column != REFERENCES["toolface"].column or not known:
            continue
        turned = every_turned or each.unit == ANTICLOCKWISE
        if every_low or _FROM_LOW.search(name):
            unit = ANTICLOCKWISE_FROM_LOW_SIDE if turned else FROM_LOW_SIDE
        else:
            unit = ANTICLOCKWISE if turned else each.unit
        results[name] = each._replace(unit=unit)
    return results


def _with_raw_channels(
    names: Mapping[str, str], units: Sequence[str], meanings: Mapping[str, Resemblance]
) -> dict[str, Resemblance]:
    """The meanings with channels that are called raw, and without those called corrected beside them."""
    called = {
        n: meaning(_without(_UNCORRECTED, text), unit)
        for (n, text), unit in zip(names.items(), units, strict=True)
        if _UNCORRECTED.search(text)
    }
    raw = {n: meanings.get(n, m) for n, m in called.items() if m and m.column in RAW}
    measured = {m.column for m in raw.values()}
    others = {
        n: m
        for n, m in meanings.items()
        if not (n not in called and m.column in measured and _CORRECTED.search(n))
    }
    return others | raw


def _without_roll_test(meanings: Mapping[str, Resemblance]) -> dict[str, Resemblance]:
    """The meanings without columns below the title of a roll test, where another column has what each has."""
    tests = {n for n in meanings if OF_CHECKS.search(n) and OF_ROLLS.search(n)}
    of_run = {m.column for n, m in meanings.items() if n not in tests}
    return {n: m for n, m in meanings.items() if n not in tests or m.column not in of_run}


def _explained(names: Sequence[str], above: Sequence[str]) -> dict[str, Resemblance]:
    """Angles that a line says to be the tool axis's from the vertical or the horizontal: theta: axis from vertical."""
    bare = {_UNIT_BEHIND_NAME.sub("", name).lower(): name for name in names}
    results = {}
    for line in above:
        match = re.match(r"\W*([^\W\d_]+)\s*[:：=]\s*([^;(]+)", line)
        name = bare.get(match[1].lower()) if match else None
        if not match or not name or not _TOOL_AXIS.search(match[2]):
            continue
        if _FROM_HORIZONTAL.search(match[2]):
            sense = BELOW if _DOWNWARDS.search(match[2]) else ABOVE
            results[name] = Resemblance(REFERENCES["inclination"].column, sense)
        elif _OF_VERTICAL.search(match[2]):
            results[name] = Resemblance(REFERENCES["inclination"].column)
    return results


def _beside_others(
    names: Sequence[str], units: Sequence[str], meanings: Mapping[str, Resemblance]
) -> dict[str, Resemblance]:
    """Columns whose names say an angle of the stand only where no other column is this angle: Face, Desvio."""
    called = {m.column for m in meanings.values()}
    results: dict[str, Resemblance] = {}
    for angle, words in _LONE_ANGLES.items():
        column = REFERENCES[angle].column
        bare = {n: " ".join(_UNIT_BEHIND_NAME.sub("", spelled(n)).split()) for n in names}
        fits = [n for n, text in bare.items() if n not in meanings and words.fullmatch(text)]
        if len(fits) == 1 and column not in called:
            stated = IN_BRACKETS.search(spelled(fits[0]))
            unit = units[names.index(fits[0])] or (stated[1] if stated else "")
            results[fits[0]] = Resemblance(column, unit_of(spelled(unit)))
    return results


def _by_axes(
    names: Sequence[str], units: Sequence[str], meanings: Mapping[str, Resemblance]
) -> dict[str, Resemblance]:
    """Channels by three names that differ in the letter of their axis alone.

    Their unit is one that one triad alone has, or their first letter says which: Akx, Aky, Akz.
    """
    called = {m.column for m in meanings.values()}
    texts: dict[str, list[tuple[str, str]]] = {}
    for name, unit in zip(names, units, strict=True):
        plain = spelled(name)
        behind = _WITH_UNIT.fullmatch(plain)
        stated = unit_of(spelled(unit)) or (unit_of(behind[2]) if behind else "")
        bare = (behind[1] if behind and not unit else plain).lower()
        if not (name in meanings or _NO_STAND.search(plain) or is_of_tool(name)):
            texts.setdefault(stated, []).append((bare, name))
    whole = [
        (stem, unit, each)
        for unit, pairs in texts.items()
        for stem, each in _but_for_axes(pairs).items()
    ]
    kinds = [_OF_UNITS.get(unit) or _OF_LETTERS.get(stem[0], "") for stem, unit, _ in whole]
    return {
        name: Resemblance(f"{kind}{axis}", unit)
        for kind, (_, unit, each) in zip(kinds, whole, strict=True)
        if kind and kinds.count(kind) == 1 and f"{kind}x" not in called
        for axis, name in each.items()
    }


def _says_anticlockwise(line: str) -> bool:
    """Whether a line says that toolfaces count anticlockwise, looking down the hole."""
    text = spelled(line)
    return bool(_OF_TOOLFACE.search(text) and _CCW.search(text)) and not _UPHOLE.search(text)


def _says_from_low_side(line: str) -> bool:
    """Whether a line says that toolfaces count from the low side.

    >>> lines = "Toolface 0 = mark down", "TF 0 at high side, 180 at low side", "Rollwinkel ab Tiefseite"
    >>> [_says_from_low_side(line) for line in lines]
    [True, False, True]
    """
    return bool(_OF_TOOLFACE.search(spelled(line)) and _FROM_LOW.search(line))


_TOOL_AXIS = re.compile(
    r"axis|achse|\bakse|\baxe\b|\beje\b|\beixo\b|asse\b|\bos(i|ią)?\b|ось|оси|轴|軸", re.IGNORECASE
)
"""Words of the axis of the tool."""
_OF_VERTICAL = re.compile(r"vert[iy][kc]al|lot\b|lodd|вертикал|铅垂|垂直", re.IGNORECASE)
_LONE_ANGLES = {
    "inclination": re.compile(
        r"(ref )?(desvio|desv\.?|dev\.?( angle)?|drift|devia(tion|zione|cao|tie|si)|afwijking|odklon)(,? deg)?",
        re.IGNORECASE,
    ),
    "azimuth": re.compile(
        r"(ref )?(kompass|brujula|bussola|boussole|компас|phi m(ag)?)(,? deg)?", re.IGNORECASE
    ),
    "toolface": re.compile(r"(ref )?(face|cara|lado|(kat )?przechyl\w*)(,? deg)?", re.IGNORECASE),
}
"""Names that say an angle where no other column is this angle, as `spelled` gives them without their unit."""
_OF_UNITS = {"g": "a", "mg": "a", "m/s²": "a", "nT": "m", "µT": "m", "gauss": "m", "mG": "m"}
"""The triad that alone has a unit, by its letter."""
_OF_LETTERS = {"a": "a", "g": "a", "m": "m", "h": "m", "b": "m", "f": "m"}
"""The triad whose names begin with a letter."""
_WITH_UNIT = re.compile(r"(.*\S)[\s(\[]+([^\s()\[\]]+)[)\]]?")
"""A name and the unit behind it, in brackets or not."""
_UNIT_BEHIND_NAME = re.compile(r"\s*[(\[][^)\]]*[)\]]\s*$")
"""The unit behind the name of a channel."""
_VOLTAGE = re.compile(r"[uv](?=[abghm]$)", re.IGNORECASE)
_SENSITIVITY = re.compile(r"[(\[][^)\]]*\d[^)\]]*[)\]]")
"""Brackets with a number in a legend: the sensitivity of a channel."""


def _by_legend(names: Sequence[str], above: Sequence[str]) -> dict[str, Resemblance]:
    """The meaning of columns by a legend of three or more in one line: CH1 = Gx; CH2 = Gy; CH3 = Gz, mg."""
    bare = {_UNIT_BEHIND_NAME.sub("", name): name for name in names} | {n: n for n in names}
    every = "|".join(map(re.escape, sorted(filter(None, bare), key=len, reverse=True)))
    results: dict[str, Resemblance] = {}
    for line in above:
        _, *parts = re.split(rf"(?<!\w)({every})(?:\s*=|(?<=\d)\s*[:：])\s*", line)
        for name, text in zip(parts[::2], parts[1::2], strict=True):
            plain = _SENSITIVITY.sub("", text)
            words, _, unit = plain.strip(' ,;"').rpartition(", ")
            alike = meaning(words, unit) if words and unit_of(unit) else meaning(words or unit)
            if alike:
                results[bare[name]] = alike
    for channels in CHANNELS.values():
        triad = {name: m for name, m in results.items() if m.column in channels}
        stated = {m.unit for m in triad.values() if m.unit}
        if len(stated) == 1:
            results |= {name: m._replace(unit=min(stated)) for name, m in triad.items()}
    return results if len(results) > 2 else {}


def _beside_nominal(
    names: Sequence[str], units: Sequence[str], meanings: Mapping[str, Resemblance]
) -> dict[str, Resemblance]:
    """Angles that the stand shows, each beside one to which it was to be set: Ist beside Soll.

    An inclination that a stand was set to is not the dip, whatever its name.
    """
    dip, inclination = (REFERENCES[name].column for name in ("dip", "inclination"))
    nominal, shown_ones = set[str](), dict[str, dict[str, Resemblance]]()
    stems = {shown: stem for _, shown, stem in shown_beside_set(names)}
    for name, unit in zip(names, units, strict=True):
        is_nominal = _is_nominal(name)
        words = _NOMINAL if is_nominal else _ACTUAL
        bare = " ".join(words.sub(" ", name.replace("_", " ")).split())
        bare = _OF_CHANNELS.sub("", bare).strip()
        bare = re.sub(r"^\([^)]*\)\s*", "", bare)
        if is_nominal or name in stems:
            bare = stems.get(name, bare).strip("() ")
        alike = meaning(bare, unit) if bare not in ("", name) else None
        if alike and alike.column == dip:
            alike = alike._replace(column=inclination)
        if alike and alike.column in _ANGLES_AND_WARMTH[:3]:
            if is_nominal:
                nominal.add(alike.column)
            else:
                shown_ones.setdefault(alike.column, {})[name] = alike
    return {
        name: alike
        for column, each in shown_ones.items()
        if column in nominal and len(each) == 1
        for name, alike in each.items()
        if name not in meanings or meanings[name].column == dip
    }


def _without(words: re.Pattern[str], name: str) -> str:
    """A name without some words, and the points behind them."""
    return " ".join(re.sub(rf"({words.pattern})\.?", " ", name, flags=words.flags).split()).strip(
        "-_ ,"
    )


def shown_beside_set(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Columns of what a stand was to be set to, each with that of what it shows, and the end of both names.

    >>> shown_beside_set(["Set (Inc)", "Read on cradle (Inc)", "Azi"])
    [('Set (Inc)', 'Read on cradle (Inc)', '(Inc)')]
    """
    spaced = {name: name.replace("_", " ") for name in names}
    shown_ones = {
        n: _without(_ACTUAL, text)
        for n, text in spaced.items()
        if _is_shown(n) and not _is_nominal(n)
    }
    pairs = []
    for name, text in spaced.items():
        stem = _without(_NOMINAL, text)
        for other, bare in shown_ones.items():
            ends = re.search(rf"[^\W\d_].*(?<!\w){re.escape(bare)}$", text) if bare else None
            apart = other != name and not is_computed(name) and not _BY_TOOL.search(text)
            behind = re.search(rf"(?<!\w){re.escape(stem)}$", spaced[other])
            if stem not in ("", text) and (bare == stem or behind):
                pairs.append((name, other, stem))
            elif apart and ends and name not in shown_ones:
                pairs.append((name, other, bare))
    return pairs


def _behind_titles(
    names: Sequence[str], units: Sequence[str], meanings: Mapping[str, Resemblance]
) -> dict[str, Resemblance]:
    """Angles of the stand behind an unknown title that two of them share, where no other column is one: Cradle Inc."""
    angles = {REFERENCES[name].column for name in ("inclination", "azimuth", "toolface")}
    if angles & {m.column for m in meanings.values()}:
        return {}
    by_title: dict[str, dict[str, Resemblance]] = {}
    for name, unit in zip(names, units, strict=True):
        words = name.split() if name not in meanings else []
        for place in range(1, len(words)):
            title, rest = " ".join(words[:place]), " ".join(words[place:])
            alike = (
                Resemblance("ref_azimuth_deg", "°")
                if _BARE_AZ.fullmatch(rest)
                else meaning(rest, unit)
            )
            if alike and alike.column in angles and not _NO_STAND.search(spelled(title)):
                by_title.setdefault(title, {})[name] = alike
                break
    groups = [each for each in by_title.values() if len({m.column for m in each.values()}) > 1]
    return groups[0] if len(groups) == 1 else {}


def _follows(
    names: Sequence[str], every: Sequence[str], lone: str, meanings: Mapping[str, Resemblance]
) -> bool:
    """Whether of two columns that may be az the other one stands behind ax and ay, and the `lone` one does not."""
    known = [n for n in names if n in meanings]
    behind = {
        name: [meanings[n].column for n in known[max(k - 2, 0) : k]] == ["ax", "ay"]
        for k, name in enumerate(known)
    }
    return not behind[lone] and all(behind[name] for name in every if name != lone)


def _axes_of_numbers(above: Sequence[str]) -> str:
    """The axes that a line says 1, 2 and 3 to be, or 0, 1 and 2: 1 = X, 2 = Y, 3 = Z; empty where none does."""
    for line in above:
        axes = "".join(
            re.findall(r"(?<![\w.])[0-3]\s*[=:]\s*([xyz])\b", line, re.IGNORECASE)
        ).lower()
        if sorted(axes) == [*"xyz"]:
            return axes
    return ""


def _numbered(names: Sequence[str], axes: str = "") -> dict[str, str]:
    """Names that end in 1, 2 and 3, or 0, 1 and 2, where all three are there, with x, y and z instead.

    Where a line says the `axes` of the numbers, Va and Vb are the voltages of both triads.
    """
    parts = {name: match for name in names if (match := _NUMBERED.fullmatch(name))}
    stems = {(m[1], m[3]) for m in parts.values()}
    numbers = {s: "".join(sorted(m[2] for m in parts.values() if (m[1], m[3]) == s)) for s in stems}
    whole = {name: m for name, m in parts.items() if numbers[m[1], m[3]] in ("123", "012")}
    axis = {name: (axes or "xyz")[numbers[m[1], m[3]].index(m[2])] for name, m in whole.items()}
    return {
        name: f"{_VOLTAGE.sub('', m[1]) if axes else m[1]} {axis[name]} {m[3]}".strip()
        for name, m in whole.items()
    }


def column_said(theirs: str, names: Collection[str], source: str) -> tuple[str, str]:
    """The column that an answer names, and the unit in brackets behind its name; both empty of an empty answer.

    Raises:
        InputError: there is no such column.
    """
    name, unit = theirs, ""
    match = IN_BRACKETS.search(theirs)
    if theirs not in names and match:
        name, unit = theirs[: match.start()].strip(), match[1].strip()
    if name and name not in names:
        raise InputError(
            f"{source}: there is no column {shown(name)}; found {', '.join(map(shown, [*names][:24]))}."
        )
    return name, unit


def _answered(
    answers: Mapping[str, str],
    units: Mapping[str, str],
    meanings: dict[str, Resemblance],
    source: str,
) -> None:
    """Replace what columns hold by what the user says: the name of a column, with its unit in brackets behind it.

    Without brackets it is in the unit that the table states: `units` by name.
    """
    for ours, theirs in answers.items():
        if ours not in MAPPED:
            raise InputError(
                f"`column` {shown(ours)}: expected one of {', '.join(MAPPED[:14])} and their sd_…, and of surveys md_m."
            )
        name, unit = column_said(theirs, units, source)
        stated = meanings[name].unit if name in meanings else ""
        for other in [n for n, m in meanings.items() if m.column == ours or n == name]:
            del meanings[other]
        if name:
            beside = units[name] or "".join(IN_BRACKETS.findall(name))
            stated = stated or unit_of(spelled(beside))
            meanings[name] = Resemblance(ours, unit_of(unit) or unit or stated)


def _columns_of(answer: Answer) -> set[str]:
    """The columns of a run file of which an answer speaks; all of what it says where that is no column."""
    return {value.partition("=")[0] for _, value in answer.arguments}


def _names_of(answer: Answer) -> list[str]:
    """The columns of the table that an answer takes."""
    return [value.partition("=")[2] for _, value in answer.arguments]


class Questions(list[QuestionError]):
    """Open questions about names and readings, each with the option that answers it."""

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function; None where it has a question."""
        try:
            return function(*arguments)
        except QuestionError as question:
            self.append(question)
            return None

    def believed(self) -> set[str]:
        """The columns of a table that the first answers to open questions take."""
        return {name for each in self if each.answers for name in _names_of(each.answers[0])}

    def hold(self, *texts: str) -> bool:
        """Whether there is a question with one of some texts in it."""
        return any(text in each.text for each in self for text in texts)

    def settle(self, words: str) -> None:
        """Leave out questions on columns that each answer to a question of these words takes."""
        question = next((each for each in self if words in each.text), None)
        taken = [_columns_of(each) for each in question.answers] if question else []
        self[:] = [
            each
            for each in self
            if each is question
            or not (taken and each.answers)
            or not set[str]().union(*map(_columns_of, each.answers)) <= set.intersection(*taken)
        ]

    def raise_any(self, source: str) -> None:
        """Raise all questions together, of channels side by side the one that answers others."""
        self.settle(SIDE_BY_SIDE)
        if self:
            raise QuestionsError(source, [*{str(each): each for each in self}.values()])


def proposed(
    names: Sequence[str],
    units: Sequence[str],
    values: Values,
    source: str,
    above: Sequence[str] = (),
    stated: Mapping[str, object] | None = None,
    answers: Mapping[str, str] | None = None,
    problems: Mapping[str, QuestionError] | None = None,
    besides: Sequence[QuestionError] = (),
    of_run: bool = True,
) -> tuple[dict[str, ColumnSource], set[str], dict[str, str]]:
    """The columns of a table by the name that they have in a run file, and those with a unit by their values.

    And columns that are no evidence although they are called so, each with the reason.

    `above`: lines above the names. `stated`: what the table says of itself, as metadata. `answers`: columns of the
    table by the name of the run file, as the user says. `problems`: what is wrong with columns of which `values` gave
    none although most of their cells are numbers. `besides`: questions that are open as well. Channels of a table that
    is not `of_run` may be missing or unsound.

    Raises:
        InputError: an answer that names no column.
        FitError: columns of which each may be one of the run file's, a unit that neither name nor
            values tell, azimuths from true or grid north, no accelerometer: all that is open.
    """
    meanings = _with_whole_vectors(meanings_of(names, units, above))
    _tell_by_values(meanings, names, units, values)
    said, known, every = answers or {}, stated or {}, dict(zip(names, units, strict=True))
    _tell_numbers(meanings, values, said)
    ignored = _no_evidence(meanings, values, said, known, above, every)
    _answered(said, every, meanings, source)
    questions = Questions(besides)
    damaged = {} if problems is None else problems  # filled while values are read
    spoken = _spoken(meanings, values, above)
    chosen = _chosen(meanings, values, damaged, spoken, above, ignored, said, questions, source)
    azimuth = chosen.get(REFERENCES["azimuth"].column)
    if azimuth and "azimuth_reference" not in known and not north_of(azimuth.name, above, known):
        questions.ask(_check_north, azimuth.name, above, source)
    for triad, channels in CHANNELS.items():
        if not {*channels} & {*chosen, *said}:
            others = [n for n in names if n not in meanings]
            questions.ask(_check_hidden, triad, channels, others, values, source)
    hidden = questions.hold("channels of the accelerometer")
    if not hidden and not any(n in damaged for n, m in meanings.items() if m.column in RAW):
        questions.ask(_check_triads, names, values, chosen, said, source, of_run)
    questions.ask(_check_units_of_triads, chosen, source)
    angles = {c: chosen[c].name for c in _ANGLES_AND_WARMTH[:3] if c in chosen and c not in said}
    for column in angles:
        questions.ask(_check_nominal, column, angles, names, values, source)
    beside = questions.hold(SIDE_BY_SIDE, "channels of the magnetometer")
    if not beside and not {*RAW[3:]} & {*chosen, *said}:
        # Without accelerometers either triad may be either.
        believed = questions.believed() if {*RAW[:3]} & {*chosen} else ()
        others = [n for n in names if n not in meanings and n not in believed]
        questions.ask(_check_nameless, others, values, chosen, known, source)
    present = {*chosen, *said, *known, *of_vectors(chosen)}
    _ask_lacking(present, every, meanings, values, questions, source)
    questions.raise_any(source)
    by_value = {c for c, each in chosen.items() if each.unit and not meanings[each.name].unit}
    used = {each.name for each in chosen.values()}
    ignored = {name: reason for name, reason in ignored.items() if name not in used}
    chosen = _with_wrong_units(chosen, said, every)
    return _labels(names, chosen) | chosen, by_value, ignored


def _with_wrong_units(
    chosen: Mapping[str, ColumnSource], said: Collection[str], units: Mapping[str, str]
) -> dict[str, ColumnSource]:
    """The columns that the user says with the unit that the table states for each, where it is another."""
    wrong = {c: unit_of(units[each.name]) for c, each in chosen.items() if c in said}
    return {
        c: ColumnSource(name=each.name, unit=each.unit, instead_of=wrong[c])
        if wrong.get(c) and each.unit and wrong[c] != each.unit
        else each
        for c, each in chosen.items()
    }


def _ask_lacking(
    present: Collection[str],
    units: Mapping[str, str],
    meanings: Collection[str],
    values: Values,
    questions: Questions,
    source: str,
) -> None:
    """Questions on references and a temperature that are absent, among columns that are not understood."""
    others = {n: u for n, u in units.items() if n not in meanings}
    magnetic = questions.hold("Are these the magnetometers", "channels of the magnetometer")
    lacking = [*lacking_references({*present, *(RAW[3:] if magnetic else ())}), *BY_NAME_ALONE]
    for column in (each for each in lacking if each not in present):
        questions.ask(_check_lacking, column, others, [*units], values, source)


def _with_whole_vectors(meanings: dict[str, Resemblance]) -> dict[str, Resemblance]:
    """Columns by what they hold, without components of a vector of which others are absent."""
    called = {m.column for m in meanings.values()}
    whole = [
        c
        for part in (REFERENCE_VECTORS[:3], REFERENCE_VECTORS[3:])
        if {*part} <= called
        for c in part
    ]
    return {
        n: m for n, m in meanings.items() if m.column not in REFERENCE_VECTORS or m.column in whole
    }


def _chosen(
    meanings: Mapping[str, Resemblance],
    values: Values,
    problems: Mapping[str, QuestionError],
    spoken: str,
    above: Sequence[str],
    ignored: Collection[str],
    said: Collection[str],
    questions: Questions,
    source: str,
) -> dict[str, ColumnSource]:
    """The columns of a run file that the names of a table are, each with its unit; questions where they may be two."""
    chosen: dict[str, ColumnSource] = {}
    warmth = _spoken_warmth(above)
    for column in dict.fromkeys(m.column for m in meanings.values()):
        alike = [name for name, m in meanings.items() if m.column == column]
        candidates = [n for n in alike if column in LABELS or values(n) is not None]
        candidates = [n for n in candidates if n not in ignored]
        damaged = [problems[n] for n in alike if n in problems]
        if damaged and not _stated_among(candidates):
            questions += damaged
        answered = candidates[0] if candidates and column in said else ""
        if not answered and candidates:
            answered = questions.ask(_one, column, candidates, values, source)
        if name := answered:
            stated = _angles(column, meanings[name].unit, spoken)
            stated = stated or (warmth if column == WARMTH else "")
            cells = values(name)
            unit = questions.ask(_unit, column, name, stated, cells, source)
            if unit and stated and column not in said:
                questions.ask(_check_range, column, name, unit, cells, source)
            chosen[column] = ColumnSource(name=name, unit=unit or "")
    return chosen


def _no_evidence(
    meanings: Mapping[str, Resemblance],
    values: Values,
    answers: Mapping[str, str],
    stated: Collection[str],
    lines: Sequence[str],
    units: Mapping[str, str],
) -> dict[str, str]:
    """Columns that are named like references but hold no references, each with the reason.

    That is what the user excludes; totals computed from the channels, and those that vary beside the one `stated`
    for the place; and rolls in whole degrees beside no other angle of the stand, which are nominal; columns that are
    not understood, of `units` by name, may be such angles. Neither is a spread of the samples of which `lines` or names
    speak the uncertainty of their mean.
    """
    ignored = {}
    sampled = any(map(_OF_SAMPLES.search, [*units, *lines]))
    called = {m.column for m in meanings.values()}
    beside = [REFERENCES[name].column for name in ("inclination", "azimuth")]
    lone = called.isdisjoint(beside) and not any(map(answers.get, beside))
    unclear = [(n, unit) for n, unit in units.items() if n not in meanings]
    lone &= not any(may_be(c, n, unit, values(n)) for c in beside for n, unit in unclear)
    for name, m in meanings.items():
        if answers.get(m.column) == "":
            ignored[name] = "as you say"
        elif m.column in answers:
            continue
        elif sampled and m.column in _SPREADS_OF_CHANNELS and name != m.column:
            ignored[name] = "it is the spread of samples, not the uncertainty of their mean"
        elif _is_total(m.column, values(name), m.unit, [*units], values) or _is_dip_of(
            m.column, name, meanings, values
        ):
            ignored[name] = "it is computed from the channels"
        elif m.column in _OF_PLACE_ALONE and _OF_TOOL.search(name):
            ignored[name] = "by its name the tool has measured it"
        elif m.column in stated and _varies(m.column, name, values(name)):
            ignored[name] = (
                "it varies from station to station, and the title states that of the place"
            )
        elif m.column == REFERENCES["toolface"].column and lone and _is_whole(values(name)):
            ignored[name] = (
                f"its rolls are nominal, in whole degrees without other angles of the stand; if they were set, say so "
                f"by `column` {f'{m.column}={name}'!r}"
            )
    return ignored


def _varies(column: str, name: str, values: Array | None) -> bool:
    """Whether a strength that is not called a reference varies by more than that of a place does."""
    if values is None or column not in _OF_PLACE_ALONE or _CALLED_REFERENCE.search(spelled(name)):
        return False
    if column not in RANGES_BY_UNIT:
        return bool(np.nanmax(values) - np.nanmin(values) > _SAME_DIP)
    return bool(np.nanmax(values) - np.nanmin(values) > _OF_PLACE * np.nanmax(np.abs(values)))


def _is_whole(values: Array | None) -> bool:
    return values is not None and bool(np.all(np.isnan(values) | (values == np.round(values))))


def _tell_by_values(
    meanings: dict[str, Resemblance], names: Sequence[str], units: Sequence[str], values: Values
) -> None:
    """Add the dip, the temperature and references of each row that values show where names do not."""
    _tell_dip(meanings, values)
    _tell_temperature(meanings, names, units, values)
    _tell_references(meanings, names, units, values)


def _tell_dip(meanings: dict[str, Resemblance], values: Values) -> None:
    """Of several inclinations the one that hardly varies is the dip, where no column is called so.

    And a dip that turns, beside no inclination, is that of the hole: from the horizontal, unless its word is a
    language's own for an inclination: Inklinacja, Inklinasi.
    """
    inclined = [n for n, m in meanings.items() if m.column == REFERENCES["inclination"].column]
    for name in [n for n, m in meanings.items() if m.column == REFERENCES["dip"].column]:
        cells = values(name)
        known = cells[np.isfinite(cells)] if cells is not None else np.empty(0)
        if not inclined and known.size and np.ptp(known) > _LEAST_TURN:
            unit = meanings[name].unit if re.search("in[ck]l", name, re.IGNORECASE) else ABOVE
            meanings[name] = Resemblance(REFERENCES["inclination"].column, unit)
    if len(inclined) < 2 or any(m.column == REFERENCES["dip"].column for m in meanings.values()):
        return
    steady = [
        n
        for n in inclined
        if may_be(REFERENCES["dip"].column, n, meanings[n].unit or "°", values(n))
    ]
    if len(steady) == 1 and not _CALLED_REFERENCE.search(spelled(steady[0])):
        meanings[steady[0]] = Resemblance(REFERENCES["dip"].column, "°")


def _tell_numbers(
    meanings: dict[str, Resemblance], values: Values, answers: Collection[str]
) -> None:
    """A column of serials that number the rows is one of stations: S/N 1, 2, 3."""
    for name, m in meanings.items():
        cells = values(name) if m.column == "serial" and "serial" not in answers else None
        if cells is not None and cells.size > LEAST_ROLLS and is_numbering(cells):
            meanings[name] = Resemblance("station")


def _tell_temperature(
    meanings: dict[str, Resemblance], names: Sequence[str], units: Sequence[str], values: Values
) -> None:
    """A column T is the temperature by its values, or the only one in °C, where no other is called so."""
    if any(m.column == WARMTH for m in meanings.values()):
        return
    others = {n: unit for n, unit in zip(names, units, strict=True) if n not in meanings}
    lone = [n for n, unit in others.items() if _BARE_T.fullmatch(f"{n} {unit}".strip())]
    warm = {} if lone else {n: w for n, unit in others.items() if (w := warm_unit(n, unit))}
    of_tool = {n: unit for n, unit in warm.items() if not is_not_of_tool(n)}
    lone += [n for n, unit in of_tool.items() if unit == "°C" and not is_of_surroundings(n)]
    clear = len(lone) == 1 >= len(of_tool)
    for name in lone if clear else () if of_tool else warm:  # of which it is asked
        cells = values(name)
        if cells is None or (warm and not np.isfinite(cells).all()):
            continue
        known = cells[np.isfinite(cells) & ~is_filler(cells)]
        if known.size and np.all((known >= -60) & (known <= 500)) and not is_numbering(known):
            meanings[name] = Resemblance(WARMTH, warm.get(name, ""))


def _tell_references(
    meanings: dict[str, Resemblance], names: Sequence[str], units: Sequence[str], values: Values
) -> None:
    """A column in whatever words is gravity, field or dip by its unit and its steady values.

    It is called a reference, or the field; or it is of one value throughout, as nothing that a tool measures is.
    """
    for column in _OF_PLACE_ALONE:
        named = [
            (n, unit)
            for n, unit in zip(names, units, strict=True)
            if n not in meanings
            and not is_of_tool(n)
            and not _NO_STAND.search(spelled(n))
            and not _is_nominal(n)
            and _is_steady(column, n, unit, values(n), names, values)
        ]
        called = [n for n, m in meanings.items() if m.column == column]
        if len(named) == 1 and all(
            _is_total(column, values(n), meanings[n].unit, names, values) for n in called
        ):
            ((name, unit),) = named
            meanings[name] = Resemblance(column, _unit_beside(name, unit))


def _is_steady(
    column: str,
    name: str,
    unit: str,
    cells: Array | None,
    names: Sequence[str],
    values: Values,
) -> bool:
    """Whether a column may be what a place has, called so or of one value throughout."""
    if cells is None or not cells.size or not np.isfinite(cells).all():
        return False
    referred = bool(_REFERRED.search(spelled(name)))
    if column == REFERENCES["dip"].column:
        return may_be(column, name, unit, cells) and (referred or _is_behind_title(name, column))
    of_field = column == REFERENCES["field"].column
    if of_field and referred:
        return may_be(column, name, unit, cells)
    low, high = _range_in(column, _unit_beside(name, unit))
    if not (low <= cells.min() and cells.max() <= high):
        return False
    varies = float(np.ptp(cells))
    steady = varies == 0 or (
        of_field
        and varies < _OF_PLACE * high
        and bool(_OF_FIELD.search(name) or _is_behind_title(name, column))
    )
    return steady and not _is_total(column, cells, "", names, values)


def _is_behind_title(name: str, column: str) -> bool:
    """Whether a name ends as that of a column, behind a title that does not speak of a tool."""
    return _ends_as(name, column) and not _BY_TOOL.search(spelled(name))


def _range_in(column: str, unit: str) -> tuple[float, float]:
    """The least and the largest value that gravity or field have on the Earth in a unit; none of another unit."""
    ranges = {
        REFERENCES["gravity"].column: EARTH_GRAVITY,
        REFERENCES["field"].column: EARTH_FIELD,
    }
    if column not in ranges or unit not in units_of(column):
        return np.inf, -np.inf
    low, high = (value / FACTORS.get(unit, (1.0, 0.0))[0] for value in ranges[column])
    return low, high


def _unit_beside(name: str, unit: str) -> str:
    """The unit that is stated beside a name or ends it, in brackets, behind a blank or a slash, or tesla within it."""
    plain = spelled(name)
    bracketed = IN_BRACKETS.search(plain)
    behind = bracketed[1] if bracketed else plain.split(" ")[-1]
    ends = unit_of(spelled(unit)) or unit_of(behind) or unit_of(behind.partition("/")[2])
    within = re.search(r"(?<![^\W_])([nµu]T|[Gg]auss)(?![^\W_])", plain)
    return ends or (unit_of(within[0]) if within else "")


def _is_total(
    column: str, total: Array | None, unit: str, names: Sequence[str], values: Values
) -> bool:
    """Whether values of a strength are computed from the channels: in their raw unit, or the norms of three columns."""
    if total is None or column not in (REFERENCES[name].column for name in ("gravity", "field")):
        return False
    if unit in ("V", "mV", "counts", "raw"):
        return True
    numbers = [
        cells
        for n in names
        if (cells := values(n)) is not None and not np.array_equal(cells, total)
    ]
    triples = combinations(numbers[:_MOST_SUMMED], 3)
    return any(_turn(three) and _are_norms(total, three) for three in triples)


def _turn(columns: Sequence[Array]) -> bool:
    """Whether two of three columns or more change their sign, and a second one is of some size beside the largest."""
    sizes = sorted(float(np.abs(cells).max()) for cells in columns)
    return sum(cells.min() < 0 < cells.max() for cells in columns) > 1 and sizes[1] > 0.1 * sizes[2]


def _are_norms(total: Array, columns: Sequence[Array]) -> bool:
    """Whether values (n,) are the norms of three columns (n,) but for a factor."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(columns, axis=0)
    if not np.all((norm > 0) & (norm < np.inf)) or not np.ptp(norm):
        return False
    in_its_unit = norm * np.median(total / norm)
    return bool(np.abs(in_its_unit - total).max() < 0.02 * np.ptp(in_its_unit))


def _is_dip_of(column: str, name: str, meanings: Mapping[str, Resemblance], values: Values) -> bool:
    """Whether a dip varies as the one that the channels give, whose biases turn it from station to station."""
    dip = values(name) if column == REFERENCES["dip"].column else None
    called = {m.column: n for n, m in meanings.items()}
    if dip is None or not {*RAW} <= {*called} or not np.isfinite(dip).all() or np.ptp(dip) == 0:
        return False
    triads = [[values(called[each]) for each in names] for names in CHANNELS.values()]
    if any(cells is None for triad in triads for cells in triad):
        return False
    g, b = (np.array(triad, float) for triad in triads)
    with np.errstate(all="ignore"):
        computed = np.degrees(
            np.arcsin(np.sum(g * b, 0) / (np.linalg.norm(g, axis=0) * np.linalg.norm(b, axis=0)))
        )
        alike = np.corrcoef(dip, computed)[0, 1]
    return bool(alike > _FOLLOWS)


def _may_hold(column: str, values: Array) -> bool:
    """Whether values may be those of a reference, whatever they are called: of a place they hardly vary.

    >>> turning, steady = np.arange(0.0, 360, 30), np.full(12, 66.2)
    >>> _may_hold("ref_dip_deg", turning), _may_hold("ref_dip_deg", steady)
    (False, True)
    """
    known = values[np.isfinite(values)]
    if not known.size or np.ptp(known) == 0:
        return True
    if column == REFERENCES["dip"].column:
        return bool(np.ptp(known) < _STEADY_DIP)
    if column in _OF_PLACE_ALONE:
        return bool(np.ptp(known) < _STEADY_FIELD * np.abs(known).max())
    return column == WARMTH or not is_numbering(known)


def _may_be_in_a_unit(column: str, values: Array) -> bool:
    """Whether values are those that gravity or field have on the Earth in some unit; any others may be any."""
    known = values[np.isfinite(values)]
    ranges = [(low, high) for _, low, high in RANGES_BY_UNIT.get(column, ())]
    inside = (low <= known.min() and known.max() <= high for low, high in ranges if known.size)
    return any(inside) or not ranges


def _check_lacking(
    column: str, others: Mapping[str, str], names: Sequence[str], values: Values, source: str
) -> None:
    """Ask whether columns that are not understood are one that is absent, by a mistyped name or by unit and values."""
    pairs = shown_beside_set([*others])
    nominal, shows = {n for n, _, _ in pairs}, {n for _, n, _ in pairs}
    every = {n: cells for n in others if (cells := values(n)) is not None}
    numbers = {
        n: cells
        for n, cells in every.items()
        if n not in nominal
        and (n in shows or not is_of_tool(n) or _is_whole(cells))
        and _may_be_in_a_unit(column, cells)
        and _may_hold(column, cells)
        and not (column == WARMTH and _unit_beside(n, others[n]) in _OF_UNITS)
        and not _is_total(column, cells, "", names, values)
    }
    named = [n for n in numbers if _ends_as(n, column)]
    if named:
        raise QuestionError(
            f"{source}: {' and '.join(map(shown, named))} may be '{column}' by the end of the name, behind a title "
            "that is not understood. Which one does the stand show?",
            candidates_for(column, named, values),
        )
    near = [n for n in numbers if is_near(column, n)]
    by_values = column not in BY_NAME_ALONE
    fits = near + [
        n
        for n, cells in numbers.items()
        if by_values and n not in near and may_be(column, n, others[n], cells)
    ]
    if fits:
        raise QuestionError(
            f"{source}: no column is '{column}' by its name. Is it one of these?",
            candidates_for(column, fits, values),
        )
    of_tool = [n for n in every if n not in numbers and _is_but(_MEASURED, n, column)]
    if of_tool and column in _ANGLES_AND_WARMTH[:3]:
        *taken, none = candidates_for(column, of_tool, values)
        raise QuestionError(
            f"{source}: by its name {MEASURED_BY_TOOL} {' and '.join(map(shown, of_tool))}, and no column states "
            f"'{column}'. Does the stand show it after all?",
            [none, *taken],
        )


def _ends_as(name: str, column: str) -> bool:
    """Whether a name ends as that of a column, behind a title that says of no other: Cradle Inc."""
    words = name.split()
    ends = ((" ".join(words[:k]), meaning(" ".join(words[k:]))) for k in range(1, len(words)))
    return any(
        m is not None and m.column == column and not _NO_STAND.search(spelled(title))
        for title, m in ends
    )


def _stated_among(names: Sequence[str]) -> bool:
    """Whether one of the columns is called a reference, beside which damaged ones do not matter."""
    return any(_CALLED_REFERENCE.search(spelled(name)) for name in names)


def _spoken(meanings: Mapping[str, Resemblance], values: Values, above: Sequence[str]) -> str:
    """The unit of angles that a line above the table states or another angle has, or that toolfaces can only have.

    A run needs rolls: toolfaces that are all below 6.3 are in radians, and others are not, whatever a line states.
    """
    text = " ".join(above)
    stated = next((unit for unit, words in _SPOKEN.items() if words.search(text)), "")
    of_angles = {m.unit for m in meanings.values() if m.column in _ANGLES_AND_WARMTH[:3]}
    stated = stated or ("gon" if "gon" in of_angles and "°" not in of_angles else "")
    rolls = [
        values(n) for n, m in meanings.items() if m.column == "ref_toolface_deg" and not m.unit
    ]
    known = [roll[np.isfinite(roll)] for roll in rolls if roll is not None]
    radians = [_maybe_radians(r) for r in known if r.size > LEAST_ROLLS]
    if stated == "rad":
        return stated if all(radians) else ""
    return stated or ("rad" if any(radians) else "")


def _spoken_warmth(above: Sequence[str]) -> str:
    """The unit of temperatures that lines above a table state, not that of a number; empty where they state two.

    >>> _spoken_warmth(["All temperatures in degrees F"]), _spoken_warmth(["Room temperature 72 °F"])
    ('°F', '')
    """
    text = " ".join(line for line in above if re.search(r"\btemp", spelled(line), re.IGNORECASE))
    units = [unit for unit, words in _SPOKEN_WARMTH.items() if words.search(spelled(text))]
    return units[0] if len(units) == 1 else ""


def _angles(column: str, unit: str, spoken: str) -> str:
    """The unit beside a name or, for angles of the stand without one that is known, such as gr, that of their table."""
    known = unit in units_of(column) or unit_of(unit.partition(",")[0]) or BOTH_UNITS in unit
    return spoken if spoken and not known and column in _ANGLES_AND_WARMTH[:3] else unit


def _check_triads(
    names: Sequence[str],
    values: Values,
    chosen: Mapping[str, ColumnSource],
    said: Collection[str],
    source: str,
    of_run: bool,
) -> None:
    """Refuse a table without accelerometers; of a run with a part of the magnetometers, or a wrong channel said."""
    others = [n for n in names if n not in {each.name for each in chosen.values()}]
    listed = f"the names are {', '.join(map(shown, names[:20]))}"
    if {*RAW[:3]}.isdisjoint(chosen):
        _check_side_by_side(names, values, source)
        raise QuestionError(
            f"{source}: could not tell which columns are the accelerometers ({', '.join(RAW[:3])}); {listed}.",
            triples_for(RAW[:3], others, values, OF_ONE_SPHERE)
            or triples_for(RAW[:3], others, values),
        )
    for triad, channels in CHANNELS.items() if of_run else ():
        names_of = {c: chosen[c].name for c in channels if c in chosen}
        absent = [c for c in channels if c not in names_of]
        if names_of and absent:
            answers = channels_for(absent[0], others, values, [*names_of.values()])
            missing = "" if answers else f" No column can be {absent[0]}: the channel is missing."
            raise QuestionError(
                f"{source}: could not tell which columns are the {triad}s ({', '.join(absent)}); {listed}.{missing}",
                answers,
            )
        theirs = [c for c in names_of if c in said]
        if theirs and not is_of_one_sphere([*names_of.values()], values):
            raise QuestionError(
                f"{source}: {' and '.join(shown(names_of[c]) for c in theirs)} as {', '.join(theirs)} cannot be: the "
                f"three columns of the {triad} are far from one strength at all stations. Which column is it?"
            )


def _check_side_by_side(names: Sequence[str], values: Values, source: str) -> None:
    """Ask which of several tools is meant whose channels stand side by side, each under the tool's own title.

    An answer takes the tool's temperature too; of a tool without one, beside another that has one, none. A run beside
    its roll test is of one tool.
    """
    tools: dict[str, dict[str, str]] = {}
    for name in names:
        words = name.split()
        for place in range(len(words) - 1, 0, -1):
            alike = meaning(" ".join(words[place:]))
            if alike and alike.column in RAW:
                tools.setdefault(" ".join(words[:place]), {})[alike.column] = name
                break
    whole = {title: each for title, each in tools.items() if {*RAW[:3]} <= {*each}}
    of_one = any(OF_CHECKS.search(title) and OF_ROLLS.search(title) for title in whole)
    warm = {} if of_one else {title: _warmth_below(title, names) for title in whole}
    beside = f"a run and its test {SIDE_BY_SIDE}" if of_one else f"{len(whole)} {OF_SEVERAL_TOOLS}"
    if len(whole) > 1:
        answers = [
            Answer(
                with_values(title, values, each["ax"]),
                (
                    *(("column", f"{column}={name}") for column, name in each.items()),
                    *([("column", f"{WARMTH}={warm[title]}")] if any(warm.values()) else []),
                    *(("serial", str(s)) for s in [titles([[title]]).metadata.get("serial")] if s),
                ),
            )
            for title, each in whole.items()
        ]
        raise QuestionError(
            f"{source}: the channels of {beside}: {', '.join(map(shown, whole))}. Which one is meant?",
            answers,
        )


def _warmth_below(title: str, names: Sequence[str]) -> str:
    """The one column that is called a temperature behind the title of a tool; empty where none or several are."""
    behind = {n: n[len(title) :].strip() for n in names if n.startswith(f"{title} ")}
    warm = [
        n
        for n, text in behind.items()
        if _BARE_T.fullmatch(text) or ((alike := meaning(text)) and alike.column == WARMTH)
    ]
    return warm[0] if len(warm) == 1 else ""


def _check_hidden(
    triad: str, channels: Sequence[str], others: Sequence[str], values: Values, source: str
) -> None:
    """Refuse a table without a triad of which columns that are not understood begin as its channels do."""
    hidden = [[n for n in others if begins_as(n) == channel] for channel in channels]
    if any(hidden):
        whole = zip(*hidden, strict=True) if len({*map(len, hidden)}) == 1 else ()
        taken = [
            Answer(
                with_values(", ".join(each), values, *each),
                tuple(("column", f"{c}={n}") for c, n in zip(channels, each, strict=True)),
            )
            for each in whole
        ]
        every = ", ".join(shown(n) for each in hidden for n in each[:2])
        raise QuestionError(
            f"{source}: {every} begin as channels of the {triad} do, and end in what is no known unit. Are they the "
            "channels?",
            [*taken, none_of(*channels)],
        )


def _check_nameless(
    unused: Sequence[str],
    values: Values,
    chosen: Mapping[str, ColumnSource],
    known: Collection[str],
    source: str,
) -> None:
    """Ask whether three unused columns are magnetometers.

    Those of a steady norm in a table with references of a field, or in any table that turn as no other triad does.
    """
    of_field = {REFERENCES[name].column for name in ("field", "dip", "azimuth")}
    why = "the table states the field"
    triples = triples_for(RAW[3:], unused, values, OF_ONE_SPHERE)
    if of_field.isdisjoint({*chosen, *known}):
        sensed = [
            cells for c in RAW[:3] if c in chosen and (cells := values(chosen[c].name)) is not None
        ]
        triples = [each for each in triples if _is_another_triad(_names_of(each), sensed, values)]
        why = "three columns turn as one would"
    else:
        triples = triples or triples_for(RAW[3:], unused, values, STEADY_NORM)
    if triples:
        raise QuestionError(
            f"{source}: no column is a magnetometer by its name, and {why}. Are these the magnetometers?",
            [*triples, none_of(*RAW[3:])],
        )


def _is_another_triad(names: Sequence[str], others: Sequence[Array], values: Values) -> bool:
    """Whether three columns are vectors that turn about every axis, and none follows one of the others."""
    columns = [cells for n in names if not is_of_tool(n) and (cells := values(n)) is not None]
    if len(columns) < len(names) or not is_of_one_sphere(names, values):
        return False
    spread = np.ptp(columns, axis=-1)
    alike = [abs(np.corrcoef(one, other)[0, 1]) for one in columns for other in others]
    return bool(spread.min() > _LEAST_RANGE * spread.max() and max(alike, default=0.0) < _COPIES)


def _check_units_of_triads(chosen: Mapping[str, ColumnSource], source: str) -> None:
    """Refuse channels of a triad, or their standard uncertainties, of which two state different units."""
    for names in CHANNELS.values():
        columns = [*names, *(f"sd_{name}" for name in names)]
        stated = {c: chosen[c] for c in columns if c in chosen and chosen[c].unit}
        units = [*dict.fromkeys(each.unit for each in stated.values())]
        if len(units) > 1:
            first, other = (next(e for e in stated.values() if e.unit == u) for u in units[:2])
            raise QuestionError(
                f"{source}: {shown(first.name)} is in {first.unit}, {shown(other.name)} in {other.unit}. The channels "
                "of a triad have one scale. Which unit are all of them in?",
                [
                    Answer(u, tuple(("column", f"{c}={e.name} ({u})") for c, e in stated.items()))
                    for u in units
                ],
            )


def _check_nominal(
    column: str, angles: Mapping[str, str], names: Sequence[str], values: Values, source: str
) -> None:
    """Ask about an angle that the stand was to be set to, among others that it shows or beside one that is measured.

    `angles`: the names of all angles of the stand.
    """
    name = angles[column]
    shows = [n for n in angles.values() if _is_shown(n) and not _is_nominal(n)]
    if shows and _is_nominal(name) and not _is_shown(name):
        raise QuestionError(
            f"{source}: {shown(name)} is what the stand was to be set to, and {shown(shows[0])} what it shows. Is "
            f"there no column of what it shows as '{column}'?",
            candidates_for(column, [name], values),
        )
    nominal = [n for n in names if _is_nominal(n) and _is_but(_NOMINAL, n, column)]
    measured = [n for n in names if _is_but(_OF_CHANNELS, n, column)]
    unclear = name in measured and not _is_shown(name)
    if nominal and measured and (name in nominal or unclear):
        raise QuestionError(
            f"{source}: {shown(nominal[0])} is what the stand was to be set to. Did the stand measure "
            f"{shown(measured[0])}, or the tool? Which one is '{column}'?",
            candidates_for(column, dict.fromkeys([name, *nominal, *measured]), values),
        )


def _is_but(words: re.Pattern[str], name: str, column: str) -> bool:
    """Whether a name is one of a column's but for some words: Measured Inc."""
    bare = " ".join(words.sub(" ", name).split())
    alike = meaning(bare, "") if bare != name else None
    return alike is not None and alike.column == column


def _check_north(name: str, above: Sequence[str], source: str) -> None:
    """Refuse azimuths that by their name, or by a line above the table, count from true or grid north, or may do so."""
    if doubt := _doubt_of_north(name, above):
        raise QuestionError(
            f"{source}: {'its name' if doubt == name else f'the line {shown(doubt)}'} leaves open which north "
            f"{shown(name)} counts from. Which is it, and what is the declination, degrees east?",
            answers_of_north(),
        )
    line = next(
        (each for each in above if _OTHER_NORTH.search(each) and _OF_NORTH.search(each)), ""
    )
    if not line and not _OTHER_NORTH.search(f"{name} {spelled(name)}"):
        return
    said = f"by the line {shown(line)}" if line else "by its name"
    grid = bool(_GRID_NORTH.search(f"{line or name} {spelled(name)}"))
    raise QuestionError(
        f"{source}: {shown(name)} counts from true or grid north {said}, and the readings from magnetic north. "
        "Which is it, and what is the declination, degrees east?",
        answers_of_north(grid),
    )


def _doubt_of_north(name: str, above: Sequence[str]) -> str:
    """The name of azimuths, or a line on north or declination, that ends a word in a question mark; else empty.

    >>> _doubt_of_north("AZI (T/M?)", ()), _doubt_of_north("Azi (?)", ["Declination 1.2? W"])
    ('AZI (T/M?)', '')
    """
    if _IN_DOUBT.search(name) and _CALLED_NORTH.search(name):
        return name
    norths = (a for a in above if _OF_NORTH.search(a) or unread_declination(a))
    return next((a for a in norths if _IN_DOUBT.search(a)), "")


def answers_of_north(grid: bool = False) -> list[Answer]:
    """The norths that azimuths may count from, where it is not magnetic by its name or the readings; `grid` first."""
    norths = [
        Answer("true north", (("north", "true"),), ("declination_deg",)),
        Answer("grid north", (("north", "grid"),), ("declination_deg", "convergence_deg")),
    ]
    norths = norths[::-1] if grid else norths
    return [*norths, Answer("magnetic north after all", (("north", "magnetic"),))]


def north_of(name: str, above: Sequence[str], stated: Mapping[str, object]) -> str:
    """The north that azimuths count from where their name or a line says it, and all that it takes is stated."""
    if _doubt_of_north(name, above):
        return ""
    line = next((a for a in above if _OTHER_NORTH.search(a) and _OF_NORTH.search(a)), "")
    text = f"{line} {name} {spelled(name)}"
    if not _OTHER_NORTH.search(text):
        return ""
    north = "grid" if _GRID_NORTH.search(text) else "true"
    needed = ("declination_deg",) if north == "true" else ("declination_deg", "convergence_deg")
    return north if {*needed} <= {*stated} else ""


def _one(column: str, candidates: Sequence[str], values: Values, source: str) -> str:
    """The only candidate for a column: of its very name, or the only one that is called a reference."""
    if column in candidates:
        return column
    if column == WARMTH:
        candidates = _nearest(candidates, values, source)
    stated = [name for name in candidates if _CALLED_REFERENCE.search(spelled(name))]
    shows = [name for name in candidates if _is_shown(name) and not _is_nominal(name)]
    others = [name for name in candidates if name not in shows]
    if len(shows) == 1 and all(map(_is_nominal, others)):
        return shows[0]
    by_tool = [name for name in candidates if _BY_TOOL.search(spelled(name))]
    by_stand = [n for n in candidates if n not in by_tool and _BY_STAND.search(spelled(n))]
    if column in _ANGLES_AND_WARMTH[:3] and len(by_stand) == 1 == len(candidates) - len(by_tool):
        return by_stand[0]
    if len(candidates) == 1 or len(stated) == 1:
        return (stated or candidates)[0]
    of = "the temperature of the tool" if column == WARMTH else f"'{column}'"
    advice = (
        "Which is nearest to the sensors?" if column == WARMTH else "Which one does the stand show?"
    )
    raise QuestionError(
        f"{source}: {' and '.join(map(shown, candidates))} may each be {of}. {advice}",
        candidates_for(column, candidates, values),
    )


def _nearest(candidates: Sequence[str], values: Values, source: str) -> Sequence[str]:
    """Of temperatures those of the tool, else those around it; a question where all are of something else."""
    beside = [n for n in candidates if not is_not_of_tool(n)]
    if not beside:
        raise QuestionError(
            f"{source}: {' and '.join(map(shown, candidates))} by the name is not the temperature of the tool, and no "
            "other column is. Is the run to do without temperature?",
            [none_of(WARMTH), *candidates_for(WARMTH, candidates, values)[:-1]],
        )
    of_tool = [n for n in beside if not is_of_surroundings(n)] or beside
    return [n for n in of_tool if not _CALLED_REFERENCE.search(spelled(n))] or of_tool


def _unit(column: str, name: str, stated: str, values: Array | None, source: str) -> str:
    """The unit of a column: as declared, or the only one that its values can be in."""
    allowed = units_of(column)
    if not allowed or values is None:
        return stated
    if stated:
        stated = _before_comment(column, stated) or stated
        if stated in allowed:
            return ABOVE if stated == "°" and _is_elevation(column, values) else stated
        if (
            column in _ANGLES_AND_WARMTH
            and unit_of(stated) in ("", "°")
            and BOTH_UNITS not in stated
        ):
            return _unit_by_values(column, name, values[np.isfinite(values)], source)
        if BOTH_UNITS in stated:
            raise QuestionError(
                f"{source}: {shown(name)} is in {stated}: its name, the row below it and its cells say different "
                "units. Which one holds?",
                in_units(name, column, [u for u in allowed if u in stated.split(BOTH_UNITS)]),
            )
        raise QuestionError(
            f"{source}: {shown(name)} is '{column}' by its name, and in {stated}, which is not one of "
            f"{', '.join(allowed)}.",
            [*in_units(name, column, allowed), none_of(column)],
        )
    return _unit_by_values(column, name, values[np.isfinite(values)], source)


def _is_elevation(column: str, values: Array) -> bool:
    """Whether an inclination has values that only an angle from the horizontal has."""
    if column != REFERENCES["inclination"].column or not np.isfinite(values).any():
        return False
    return bool(-90 <= np.nanmin(values) < 0 and np.nanmax(values) <= 90)


def _before_comment(column: str, stated: str) -> str:
    """The unit before a comma, if what follows says the same as the column's name: deg, highside."""
    unit, _, comment = stated.partition(",")
    alike = resembled(spelled(comment)) if comment else None
    return unit_of(unit) if alike and alike.column == column else ""


def _unit_by_values(column: str, name: str, known: Array, source: str) -> str:
    """The only unit that values of a column can be in."""
    allowed = units_of(column)
    if column in RANGES_BY_UNIT and known.size:
        for unit, low, high in RANGES_BY_UNIT[column]:
            if low <= known.min() and known.max() <= high:
                return unit
        raise _open(name, column, allowed, known, source)
    if allowed[0] == "°" and 360 < np.abs(known).max(initial=0) <= 400:
        raise _open(name, column, ("gon", "°"), known, source)
    if known.size and _is_elevation(column, known):
        return ABOVE
    if (
        allowed[0] == "°C"
        and known.size
        and known.min() < COLDEST_KELVIN
        and known.max() > OVER_CELSIUS
    ):
        return "°F"
    both = {"°": _maybe_radians, "°C": _maybe_fahrenheit}.get(allowed[0])
    if both and known.size and both(known):
        if allowed[0] == "°C" and (usual := setting("temperature_unit")):
            return usual
        raise _open(name, column, allowed, known, source)
    return allowed[0]


def _check_range(column: str, name: str, unit: str, values: Array | None, source: str) -> None:
    """Ask about values that cannot be in the unit stated, and can be in another."""
    known = values[np.isfinite(values)] if values is not None else np.empty(0)
    if not known.size:
        return
    ranges = {u: (low, high) for u, low, high in RANGES_BY_UNIT.get(column, ())}
    fits = [u for u, (low, high) in ranges.items() if low <= known.min() and known.max() <= high]
    low, high = _range_in(column, unit)
    if low <= known.min() and known.max() <= high:
        return
    turns = column in (REFERENCES["azimuth"].column, REFERENCES["toolface"].column)
    if unit == "°" and turns and known.size > LEAST_ROLLS and _maybe_radians(known):
        fits = ["rad"] if np.ptp(known) > 3 else []
    if unit == "°C" and known.min() > HOTTEST_CELSIUS:
        fits = ["K"]
    if unit == "K" and known.max() < COLDEST_KELVIN:
        fits = ["°C", "°F"]
    if fits and unit not in fits:
        raise QuestionError(
            f"{source}: {shown(name)} is in {unit}, and its values ({first_values(known)}) are those of "
            f"{' or '.join(fits)}. Which unit holds?",
            in_units(name, column, [*fits, unit]),
        )


def _maybe_radians(angles: Array) -> bool:
    return bool(np.abs(angles).max() <= 2 * np.pi and np.any(angles != np.round(angles)))


def _maybe_fahrenheit(temperatures: Array) -> bool:
    return bool(temperatures.min() >= COOLEST_FAHRENHEIT or temperatures.max() > HOTTEST_CELSIUS)


def _open(
    name: str, column: str, allowed: Sequence[str], known: Array, source: str
) -> QuestionError:
    return QuestionError(
        f"{source}: {shown(name)} is '{column}', and neither its name nor its values ({first_values(known)}) say "
        f"whether it is in {' or '.join(allowed)}.",
        in_units(name, column, allowed),
    )


def _labels(names: Sequence[str], chosen: Mapping[str, ColumnSource]) -> dict[str, ColumnSource]:
    """Columns of labels, of those that are nothing else."""
    taken = {source.name for source in chosen.values()}
    labels = {}
    for column, words in _LABELS.items():
        matching = [n for n in names if n not in taken and letters(n) in words.split()]
        if len(matching) == 1 and column not in chosen:
            labels[column] = ColumnSource(name=matching[0])
    return labels
