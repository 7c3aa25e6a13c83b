"""References that the title block of a table states for all its stations: field strength, dip and gravity.

A value counts where its word comes first, its unit is known or its value allows one unit alone, and it is one that
the Earth has. A line with a strength of the field and a gravity is that of a place: its inclination, or its only
angle by the units, is the dip. A nominal or approximate value, a range and an uncertainty are no reference.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from mwdcal.files.formats.columns import as_text, looks_numeric
from mwdcal.files.formats.titles import Titles, titles
from mwdcal.files.synonyms import FACTORS, unit_of


class _Quantity(NamedTuple):
    """Words of a quantity, letters for it, its units with the first as in the run file, and the Earth's values."""

    column: str
    words: str
    letters: str
    units: tuple[str, ...]
    low: float
    high: float


_OF_PLACES = (
    _Quantity(
        "ref_field_nt",
        r"(total|mag\w*|local|earth'?s?) field|field( strength| intensity| total)?|[bfht] ?total|[bfht](tot|ref)|bt|"
        r"(total|erd|gesamt|stand)?feld|feldstarke|"
        r"felt|totalintensitat|erdmagnetfeld|magnetfeld|flussdichte|totalfelt\w*|feltstyrke|magnetfelt|"
        r"campo( (magn\w+|totale?|local))*|totaalveld|pole calkow\w*|(teljes )?terero|toplam alan|medan total|全磁力|"
        r"magnetfalt|"
        r"intensidade?( total)?|champ( magn\w*)?( total| local)?|"
        r"(магн\w* )?поле|полн\w* (вектор|поле)|модуль( магн\w*)?( поля)?|индукци\w+|напряженност\w+( поля)?|"
        r"(环境|当地|地|总)?磁(总)?场(总)?(强度)?|总场(强度)?|\|b\||tmf|tmi|betrag|natezenie pola",
        "bfhtт",
        ("nT", "µT", "mT", "gauss", "mG"),
        15_000.0,
        80_000.0,
    ),
    _Quantity(
        "ref_dip_deg",
        r"(mag\w*|local|field) (dip|inclination)( angle)?|dip( angle)?|dipref|manyetik egim|magn\w* inklinacio|伏角|"
        r"inklinacja( pola)?|inclinazione magn\w*|magn\w* inclinatie|"
        r"(feld|feld-|magn\w* ?)?inklination|"
        r"(felt|magn\w* ?)?inklinasjon|mergulho( magn\w*)?|inclinaca?o (magn?\w*|do campo)|"
        r"inclinacion (magn\w*|del campo)|echado|buzamiento|inclinaison( magn\w*| du champ)?|"
        r"(магн\w* )?наклонени[ея]|(地)?磁倾角",
        "i",
        ("°", "rad", "gon"),
        -90.0,
        90.0,
    ),
    _Quantity(
        "ref_gravity_g",
        r"(local )?gravity( field| acceleration)?|g ?total|gtot|gref|gt|zwaartekracht|yercekimi|nehezsegi gyorsulas|"
        r"gravita|gravitasi|tyngdkraft|重力(加速度)?|ускорение силы тяжести|"
        r"przyspieszenie ziemskie|"
        r"(local|site) g|g[ -]?(locale?|lokal|ref|tot(al)?)|\|g\||"
        r"(lokale )?(schwere(beschleunigung)?|fallbeschleunigung|erdbeschleunigung|ortsschwere)|"
        r"tyngde(akselerasjon|kraft)?\w*|(aceleracion de la )?gravedad|(aceleraca?o da )?gravidade|pesanteur|"
        r"ускорение свободного падения|сил\w тяжести|(当地)?重力(加速度)?",
        "g",
        ("g", "mg", "m/s²", "gal", "mGal"),
        0.97,
        1.03,
    ),
)
_WRITTEN_UNIT = (
    r"n\s?t\b|[uµμ]\s?t\b|m\s?t\b|milli ?gauss|m\s?g(al|auss)?\b|gauss|gal\b|gons?\b|нтл|мктл|мтл|мгал|м/с²?|м/с2|"
    r"m\s?/\s?s\s?(?:²|\^?2)?|[gг]\b(?!\s*[=:(\[]?\s*(?:[+-]?\d|m\s?/))|°|deg\w*|gra[ud]\w*|rad\b|град\w*|"
    r"fok|derece|stopni|度"
)
_WRITTEN_NUMBER = (
    r"[+\-−]?\d{1,3}(?:[ '’.,\u00a0\u202f]\d{3})+(?:[.,]\d+)?(?!\d)|[+\-−]?\d+(?:[.,]\d+)?"
)
_MINUTES = r"(?:\s*°\s*(?P<minutes>\d+(?:[.,]\d+)?)\s*['′’])?"
_ROUGH = re.compile(
    r"nomin\w*|approx\w*|about|circa|\bca\b|\bcca\b|≈|~|\bnenn|ungefahr|omtrent|aprox\w*|environ|пример\w*|около|"
    r"номин\w*|约|标称",
    re.IGNORECASE,
)
"""Words of a value that is a reference but for them."""
_UNSURE = re.compile(
    rf"{_ROUGH.pattern}|"
    r"uncert|\bunc\b|unsicher|usikker|incert|погреш|不确定|toler|limit|grenz|range|bereich|диапазон|范围|量程|"
    r"\bmin\b|\bmax\b|\bstd|\bsd\b|sigma|σ|±|spec|resol|offset|drift|gradient|noise|toolface|survey|tool face",
    re.IGNORECASE,
)
"""Words by which a value is no reference."""
_BEFORE = 8
"""Characters before a quantity in which a word may stand by which its value is no reference."""
_BETWEEN = r"(?P<between>[^\d+\-−;]{0,30}?)"
_REFERRING = re.compile(
    r"(?<![^\W\d_])(ref|reference|local|lokal|value|wert|t|f|i|g|т)(?![^\W\d_])"
)
"""Words and letters behind the word of a quantity that say nothing more."""
_CHINESE = r"[\u4e00-\u9fff]"
_BEGINNING = rf"(?:(?<![^\W\d_])|(?<={_CHINESE})(?={_CHINESE}))"
_WITH_NUMBER = (
    rf"(?P<number>{_WRITTEN_NUMBER}){_MINUTES}\s*(?P<unit>{_WRITTEN_UNIT})?"
    r"(?P<behind>[^\d;]{0,12})(?P<next>\d?)"
)


def _statement(head: str) -> re.Pattern[str]:
    return re.compile(rf"{_BEGINNING}{head}(?![^\W\d_]){_BETWEEN}{_WITH_NUMBER}", re.IGNORECASE)


_STATEMENTS = [
    (q, _statement(head))
    for q in _OF_PLACES
    for head in (
        rf"(?P<word>{q.words})",
        rf"(?P<letter>[{q.letters}])(?=\W*(?:{_WRITTEN_UNIT}|ref\w*|lo[ck]al\w*)?\W*\d)",
    )
]
_INCLINATION = (_OF_PLACES[1], _statement(r"(?P<word>inc|incl\w*|ink|inkl\w*|наклон)"))
"""An inclination in the line of a place, which is the dip."""
_NUMBER_IN_UNIT = re.compile(
    rf"(?<![\w.,±+-])(?P<number>[-−]?{_WRITTEN_NUMBER})\s*(?P<unit>{_WRITTEN_UNIT})", re.IGNORECASE
)
_OTHER_ANGLE = re.compile(
    r"decl|deklin|misvis|conv|konv|azi|asim|tool|roll|tf\b|склон|азим|磁偏|方位|±", re.IGNORECASE
)
"""Words of angles that are no dip."""
_UPWARDS = re.compile(
    r"(?<![^\W\d_])(up|upwards?|para cima|hacia arriba|nach oben|aufwarts|oppover|vers le haut|verso l'?alto|"
    r"вверх)(?![^\W\d_])|向上|朝上",
    re.IGNORECASE,
)
"""Words of a dip whose number is that of a field that points up."""
_SPELT = {
    "нтл": "nT", "мктл": "µT", "мтл": "mT", "м/с": "m/s²", "м/с²": "m/s²", "м/с2": "m/s²", "m/s": "m/s²", "г": "g",
    "град": "°", "度": "°", "fok": "°", "derece": "°", "stopni": "°", "gal": "gal",
    "mgal": "mGal", "мгал": "mGal", "mg": "mg", "mgauss": "mG", "milligauss": "mG",
}  # fmt: skip
"""Units in small letters, where `unit_of` does not know them or goes by capitals."""


def stated_above(rows: Sequence[Sequence[object]]) -> Titles:
    """What rows above a table say of the tool, the day and the place, as metadata."""
    block = titles(rows)
    references = references_in(rows)
    rough = {c: text for c, text in doubtful_in(rows).items() if c not in references}
    return block._replace(metadata={**references, **block.metadata}, not_taken=rough)


def references_in(rows: Iterable[Sequence[object]]) -> dict[str, float]:
    """The references that rows above a table state, by column of a run file, in its unit; none that is stated twice.

    >>> references_in([["Local field:", "48 912 nT", "Dip", "66,2°"], ["g (m/s²)", 9.80665]])
    {'ref_field_nt': 48912.0, 'ref_dip_deg': 66.2, 'ref_gravity_g': 1.0}
    >>> references_in([["local field 46.8 uT nominal"], ["field uncertainty 50 nT"]])
    {}
    """
    values: dict[str, dict[float, None]] = {}
    of_places: dict[str, dict[float, None]] = {}
    for row in rows:
        text = _plain(_line(row))
        here = {column for s in _STATEMENTS for column, _ in _stated(text, *s)}
        of_place = {"ref_field_nt", "ref_gravity_g"} <= here and "ref_dip_deg" not in here
        for statement in [*_STATEMENTS, _INCLINATION] if of_place else _STATEMENTS:
            for column, value in _stated(text, *statement):
                values.setdefault(column, {})[value] = None
        for column, value in _of_a_place(text).items():
            of_places.setdefault(column, {})[value] = None
    every = of_places | values
    return {column: next(iter(each)) for column, each in every.items() if len(each) == 1}


def _stated(
    text: str, quantity: _Quantity, pattern: re.Pattern[str]
) -> Iterator[tuple[str, float]]:
    """The values of a quantity that a line states, with its column."""
    for match in pattern.finditer(text):
        if not _UNSURE.search(text[max(match.start() - _BEFORE, 0) : match.start()]):
            yield from ((quantity.column, value) for value in _values(quantity, match))


def _line(row: Sequence[object]) -> str:
    return " ".join(filter(None, (as_text(cell).strip() for cell in row)))


def _of_a_place(text: str) -> dict[str, float]:
    """Field, dip and gravity in a line of all three, by their units; empty where one is absent.

    >>> _of_a_place("ref 50400 nt 70.00 deg 9.8170 m/s²")
    {'ref_field_nt': 50400.0, 'ref_gravity_g': 1.0010554062804322, 'ref_dip_deg': 70.0}
    """
    if _UNSURE.search(text):
        return {}
    numbers = [*_NUMBER_IN_UNIT.finditer(text)]
    references: dict[str, float] = {}
    for quantity in (_OF_PLACES[0], _OF_PLACES[2]):
        inside = _in_unit(quantity, numbers) - {1.0}
        if len(inside) != 1:
            return {}
        references[quantity.column] = inside.pop()
    angles = _in_unit(_OF_PLACES[1], numbers)
    if len(angles) == 1 and not _OTHER_ANGLE.search(text):
        angle = angles.pop()
        references[_OF_PLACES[1].column] = -abs(angle) if _UPWARDS.search(text) else angle
    return references


def _in_unit(quantity: _Quantity, numbers: Iterable[re.Match[str]]) -> set[float]:
    """The different values that numbers with units of a quantity are, in the unit of the run file."""
    every = ((m["number"], _stated_unit(quantity, m["unit"])) for m in numbers)
    values = (
        _converted(number, unit)
        for text, unit in every
        if unit in quantity.units
        for number in _numbers(text, None)
    )
    return {v for v in values if quantity.low <= v <= quantity.high}


def doubtful_in(rows: Iterable[Sequence[object]]) -> dict[str, str]:
    """The lines above a table that may state a reference, by column of a run file.

    They state a nominal or approximate one, or a number in a unit and of a size that the Earth's field or gravity has.

    >>> doubtful_in([["Nominal field", "48 500 nT"], ["Field uncertainty 50 nT"], ["here", "9.81 m/s2"]])
    {'ref_field_nt': 'Nominal field 48 500 nT', 'ref_gravity_g': 'here 9.81 m/s2'}
    """
    lines: dict[str, str] = {}
    for row in rows:
        line = _line(row)
        plain = _plain(line)
        bare = _ROUGH.sub(" ", plain)
        for column in references_in([[bare]]) if bare != plain else ():
            lines.setdefault(column, line)
        numbers = [*_NUMBER_IN_UNIT.finditer(plain)]
        for quantity in (_OF_PLACES[0], _OF_PLACES[2]):
            if _in_unit(quantity, numbers) - {1.0}:
                lines.setdefault(quantity.column, line)
    return lines


def _plain(text: str) -> str:
    """Small letters without marks; the signs of units stay."""
    kept = text.replace("°", "\0").replace("º", "\0").replace("²", "\1").replace("й", "\2")
    plain = unicodedata.normalize("NFKD", kept.lower().translate({ord("ø"): "o", ord("ß"): "ss"}))
    bare = "".join(c for c in plain if not unicodedata.combining(c))
    bare = re.sub(r"(?<=[\u4e00-\u9fff])(?=[a-zµμ])", " ", bare)
    signs = bare.replace("\0", "°").replace("\1", "²").replace("\2", "й")
    return re.sub(r"m\s?/\s?s\s?\^?2(?!\d)", "m/s²", signs)


def _values(quantity: _Quantity, match: re.Match[str]) -> Iterator[float]:
    """The value that a text states, in the unit of the run file, if it is one."""
    between, behind = match["between"], match["behind"]
    rough = re.match(r"\W*(nomin|номин|标称|nenn)", behind) and not match["next"]
    letter = "letter" in match.groupdict()
    if rough or _UNSURE.search(between if letter else f"{match['word']} {between}"):
        return
    inner = re.search(rf"(?<![^\W\d_])({_WRITTEN_UNIT})(?![^\W\d_])", between)
    written = match["unit"] or (inner[1] if inner else "") or ("°" if match["minutes"] else "")
    stated = _stated_unit(quantity, written)
    bare = _REFERRING.sub("", between.replace(inner[0], "") if inner else between)
    bare = re.sub(rf"\((?:{quantity.words})\)", "", bare)
    direct = not re.search(r"[^\W_]", bare)
    decimals = len(re.sub(r".*?(?:[.,]|$)", "", match["number"], count=1))
    sure = (
        stated
        or ("=" in bare and decimals)
        or (quantity.column == "ref_gravity_g" and decimals > 2)
    )
    if (letter and not (direct and sure)) or not (direct or stated):
        return
    if stated and stated not in quantity.units:
        return
    numbers = [*_numbers(match["number"], match["minutes"])]
    if quantity.low < 0 and _UPWARDS.search(f"{between} {behind}"):
        numbers = [-abs(number) for number in numbers]
    units = (stated,) if stated else [unit for unit in quantity.units if unit != "gon"]
    values = {_converted(number, unit) for number in numbers for unit in units}
    inside = [v for v in values if quantity.low <= v <= quantity.high and v]
    if len(inside) == 1:
        yield inside[0]


def _stated_unit(quantity: _Quantity, text: str) -> str:
    """The unit that a text beside a quantity is: g is Gauss beside a strength of the field."""
    unit = _unit(text)
    return {"g": "gauss", "mg": "mG"}.get(unit, unit) if "gauss" in quantity.units else unit


def _unit(text: str) -> str:
    """The unit that a text in small letters is; empty if it is not a unit."""
    bare = text.replace(" ", "").replace("^", "")
    if re.fullmatch(r"(deg|gra[ud]|град)\w*", bare):
        return "°"
    if bare in _SPELT:
        return _SPELT[bare]
    cased = {"nt": "nT", "ut": "µT", "µt": "µT", "μt": "µT", "mt": "mT"}
    return cased.get(bare) or unit_of("m/s2" if bare.startswith("m/s") else bare)


def _numbers(text: str, minutes: str | None) -> Iterator[float]:
    """The numbers that digits may be: a point or a comma may be the decimal sign, or separate thousands."""
    plain = re.sub(r"[ '’\u00a0\u202f](?=\d{3})", "", text.replace("−", "-"))
    part = float(minutes.replace(",", ".")) / 60 if minutes else 0.0
    for sign, other in (".,", ",."):
        bare = plain.replace(other, "") if re.search(rf"\{other}\d{{3}}(?!\d)", plain) else plain
        if looks_numeric(bare, sign):
            number = float(bare.replace(sign, "."))
            yield number - part if plain.startswith("-") else number + part


def _converted(number: float, unit: str) -> float:
    """A number in the unit of the run file."""
    factor, _ = FACTORS.get(unit, (1.0, 0.0))
    return number * factor
