"""References that the title block of a table states for all its stations: field strength, dip and gravity.

A value counts where its word comes first, its unit is known or its value allows one unit alone, and it is one that
the Earth has. In whatever words, the only number in a unit and of a size that the Earth's field or gravity alone has is
that of the place, and the only inclination beside it is the dip. A nominal or approximate value, a range, a component,
an uncertainty and what was measured are no reference.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise, product, zip_longest
from typing import NamedTuple

from mwdcal.calibration.readings import EARTH_GRAVITY, EARTH_RANGES
from mwdcal.files.formats.columns import as_text, looks_numeric, without_marks
from mwdcal.files.formats.settings import LONGEST_STATEMENT, settings_in
from mwdcal.files.formats.titles import Titles, titles, unread_declination
from mwdcal.files.synonyms import FACTORS, unit_of

EARTH_FIELD = EARTH_RANGES["field"]
"""The least and the largest strength of the Earth's field, nT, with room for what is built around a stand."""


Rows = Sequence[Sequence[object]]


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
        r"(local|site|ref\w*) [bf]|mag(?=\W*\d)|(total|mag\w*|local|earth'?s?) field|field( strength| intensity|"
        r" total)?|[bfht] ?total|[bfht](tot|ref)|bt|"
        r"(total|erd|gesamt|stand)?feld|feldstarke|"
        r"felt|totalintensitat|erdmagnetfeld|magnetfeld|flussdichte|totalfelt\w*|feltstyrke|magnetfelt|"
        r"campo( (magn\w+|totale?|local))*|totaalveld|pole calkow\w*|(teljes )?terero|toplam alan|medan total|全磁力|"
        r"magnetfalt|kokonaiskentta|magneettikentta|celkove pole|(전|총)?자기장|전자력|camp( magn\w*)? total|"
        r"intensidade?( total)?|champ( magn\w*)?( total| local)?|"
        r"(магн\w* )?поле|полн\w* (вектор|поле)|модуль( магн\w*)?( поля| мпз)?|индукци\w+( мпз)?|"
        r"напряженност\w+( поля)?|"
        r"(环境|当地|地|总)?磁(总)?场(总)?(强度)?|总场(强度)?|\|b\||tmf|tmi|betrag|natezenie pola",
        "bfhtт",
        ("nT", "µT", "mT", "gauss", "mG", "A/m"),
        *EARTH_FIELD,
    ),
    _Quantity(
        "ref_dip_deg",
        r"(mag\w*|local|field) (dips?|inclination)( angle)?|dip( angle)?|dipref|복각|magn\w* kaltevuus|inklinaatio|"
        r"magn\w* inklinace|manyetik egim|magn\w* inklinacio|伏角|"
        r"inklinacja( pola)?|inclinazione (magn\w*|del campo)|plongement|pendage|magn\w* inclinatie|"
        r"(feld|feld-|magn\w* ?)?inklination|(feld-?|magn\w* )neigung|"
        r"(felt|magn\w* ?)?inklinasjon|(felt|magn\w* ?)helning|mergulho( magn\w*)?|inclinaca?o (magn?\w*|do campo)|"
        r"inclinarea? (magn\w*|campului)|(goc )?(do )?tu khuynh|"
        r"inclinacion (magn\w*|del campo)|echado|buzamiento|inclinaison( magn\w*| du champ)?|"
        r"(магн\w* |угол )?накл(онени[ея])?\.?( мпз)?|(地)?磁倾角",
        "i",
        ("°", "rad", "gon"),
        -90.0,
        90.0,
    ),
    _Quantity(
        "ref_gravity_g",
        r"(local )?gravity( field| acceleration)?|grav(?=\W*\d)|g ?total|gtot|gref|gt|중력(가속도)?|painovoima\w*|"
        r"tihove zrychleni|"
        r"zwaartekracht|yercekimi|nehezsegi gyorsulas|"
        r"gravita|gravitasi|tyngdkraft|重力(加速度)?|ускорение силы тяжести|"
        r"przyspieszenie ziemskie|"
        r"(local|site) g|g[ -]?(locale?|lokal|ref|tot(al)?)|\|g\||"
        r"(lokale )?(schwere(beschleunigung)?|fallbeschleunigung|erdbeschleunigung|ortsschwere)|"
        r"tyngde(akselerasjon|kraft)?\w*|(aceleracion de la )?gravedad|(aceleraca?o da )?gravidade|pesanteur|"
        r"ускорение свободного падения|сил\w тяжести|(当地)?重力(加速度)?",
        "g",
        ("g", "mg", "m/s²", "gal", "mGal", "ft/s²"),
        *EARTH_GRAVITY,
    ),
)
_WRITTEN_UNIT = (
    r"ft\s?/\s?s\s?(?:²|\^?2)|мгс\b|см/с[²2]?|k?γ|(?:(?<=\d)|(?<=\d )|(?<=[(\[]))k?gammas?\b(?! ?ray)|"
    r"n\s?t\b|[uµμ]\s?t\b|m\s?t\b|milli ?gauss|m\s?g(al|auss|s)?\b|gauss|gs\b|oe\b|a\s?/\s?m\b|gals?\b|gons?\b|"
    r"nano ?teslas?\b|micro ?teslas?\b|нтл|мктл|мтл|м?гал|гс\b|э\b|м/с²?|м/с2|"
    r"m\s?/\s?s\s?(?:²|\^?2)?|[gг]\b(?!\s*[=:(\[]?\s*(?:[+-]?\d|m\s?/))|°|deg\w*|gra[ud]\w*|rad\b|град\w*|"
    r"fok|derece|stopni|度|도\b"
)
_WRITTEN_NUMBER = (
    r"[+\-−]?\d{1,3}(?:[ '’.,\u00a0\u202f]\d{3})+(?:[.,]\d+)?(?!\d)|[+\-−]?\d+(?:[.,]\d+)?"
)
_MINUTES = (
    r"(?:\s*(?:°|deg\w*|grad\w*)\s*(?P<minutes>\d+(?:[.,]\d+)?)\s*(?:['′’](?!['′’])|min\w*)"
    r"(?:\s*(?P<seconds>\d+(?:[.,]\d+)?)\s*(?:[\"″”]|''|sec\w*))?)?"
)
_ROUGH = re.compile(
    r"nomin\w*|approx\w*|about|[cz]irka|circa|\bca\b|\bcca\b|≈|~|\bnenn|ungefahr|\betwa\b|\brund\b|omtrent|omkring|"
    r"aprox\w*|alrededor|\bcerca\b|environ\b|пример\w*|приблиз\w*|ориентир\w*|около|okolo|номин\w*|约|左右|标称",
)
"""Words of a value that is a reference but for them."""
_ROUGH_VALUES = re.compile(
    rf"({_ROUGH.pattern})\W*(values?|werte?n?|verdi\w*|valeurs?|valor\w*|значен\w*|wartos\w*|值)|"
    rf"(values?|valeurs?|valor\w*|wartos\w*)\W*({_ROUGH.pattern})"
)
"""Words that say it of all values of a line."""
_OF_MEANS = re.compile(
    r"(?<![^\W\d_])(mean|average|avg|mittelwert|moyenne|promedio|media|medio)(?![^\W\d_])|средн\w*|平均"
)
"""Words of the mean of a run, which may be that of a place."""
_UNSURE = re.compile(
    rf"{_ROUGH.pattern}|{_OF_MEANS.pattern}|"
    r"uncert|\bunc\b|unsicher|usikker|incert|погреш|不确定|toler|limit|grenz|range|\bspan|bereich|rango|faixa|\bgama\b|omrade|plage|alcance|escala|portata|диапазон|范围|量程|"
    r"\bmin\b|\bmax\b|\bstd|\bsd\b|sigma|σ|±|spec|resol|correct(?!ed)|korrek|offset|drift|gradient|noise|"
    r"toolface|survey|tool face",
)
"""Words by which a value is no reference."""
_BEFORE = re.compile(r"[^\W\d_]*[^\w/|]{0,2}[^\W\d_]*[^\w/|]*$")
"""The two words before a quantity, of which one may say that its value is no reference."""
_OF_COMPONENT = re.compile(
    r"horizont\w*|vertical\w*|vertik\w*|compon\w*|kompon\w*|poziom\w*|pionow\w*|skladow\w*|горизонт\w*|верти\w*|"
    r"компон\w*|水平|垂直|分量"
)
"""Words of a part of a field between its word and a number."""
_BETWEEN = r"(?P<between>[^\d+\-−;]{0,30}?)"
_REFERRING = re.compile(
    r"(?<![^\W\d_])(ref|reference|local|lokal|here|hier|her|aqui|aca|value|wert|t|f|i|g|т)(?![^\W\d_])"
)
"""Words and letters behind the word of a quantity that say nothing more."""
_CHINESE = r"[\u4e00-\u9fff]"
_BEGINNING = rf"(?:(?<![^\W\d_])|(?<={_CHINESE})(?={_CHINESE}))"
_WITH_NUMBER = (
    rf"(?P<number>{_WRITTEN_NUMBER}){_MINUTES}\s*(?P<unit>{_WRITTEN_UNIT})?"
    r"(?P<behind>[^\d;]{0,16})(?P<next>\d?)"
)


_RANGE = re.compile(
    rf"(?<![\w.,])(?:{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT})?(?:[-–]|\s[-–…]\s|\s?\.\.\.?\s?|\s(?:to|bis)\s)"
    rf"(?:{_WRITTEN_NUMBER})\s*(?={_WRITTEN_UNIT})"
)
"""A range in a unit: 48,000-58,000 nT."""
_WITH_SPREAD = re.compile(
    rf"({_WRITTEN_NUMBER})\s*(±|\+/-|\+-)\s*({_WRITTEN_NUMBER})\s*({_WRITTEN_UNIT})"
)
"""A value whose unit stands behind its uncertainty alone: 56870 +/- 45 nT."""

_GROUPED_DECIMALS = re.compile(r"(?<=(?<![\d.,])\d[.,]\d{3}) (?=\d{1,3}(?![\d.,])\s*(?:[^\d\s]|$))")
"""A blank that groups digits behind a decimal sign: 9.814 52 m/s²."""
_INSTRUMENT = re.compile(
    r"proton\w*|overhauser|gsm|scintrex|gravimet\w*|theodol\w*|variomet\w*|observator\w*|c(a)?esium|absolut\w*|"
    r"igrf|wmm|bggm|hdgm|wgs|grs|model\w*|modell\w*|modele|map\b|formula|модел\w*|карт[аеы]|模型|计算值|"
    r"dim\b|протон\w*|гравиметр\w*|оверхауз\w*|质子|重力仪|绝对"
)
"""Words of instruments and models by which the references of a place are known."""
_OF_INSTRUMENT = re.compile(
    r"calculated|computed|calc\.?|berechnet\w*|beregnet|calculad[oa]s?|calcule?e?s?|calcolat\w*|рассчит\w*|"
    r"расчет\w*|计算值?|"
    r"measured|\bmeas\b|mean|gemessen|mittel\w*|malt|medid\w*|mesur\w*|misurat\w*|moyen\w*|измер\w*|测得|平均|"
    r"(?<![^\W\d_])[a-z]{2,6}-?\d{1,3}\w*(?![\w.,])"
)
"""Words that do not make such a value that of the tool: measured, calculated, and the type of an instrument."""
_DAY_OR_MODEL = re.compile(
    r"(?<![\w.,/-])(?:\d{1,2}([./-])\d{1,2}\1(?:\d{4}|\d\d)|\d{4}([-./])\d{1,2}\2\d{1,2}|"
    r"\d{1,2}[-. ]{1,2}[^\W\d_]{3,9}\.?[-. ,]{1,2}\d{4})(?![\w/-])|"
    r"(?<=igrf|bggm|hdgm)[- ]?(?:\d{1,2}(?![\d.,])|\d{4}(?:\.\d+)?)|(?<=wmm|ifr)[- ]?\d{1,4}(?![\d.,])"
)
"""A day, and the number of a model of the field."""
_YEAR = re.compile(
    rf"(?<=[^\W\d_][ ,.(])\s*(?:19[89]|20[0-3])\d(?![\d.,]|\s*(?:{_WRITTEN_UNIT})|[^\W\d_])"
)
"""A year behind a word, which is no number of a reference: May 2023."""
_TOKEN_OF_LETTERS_AND_DIGITS = re.compile(r"(?<![^\W\d_])[a-z]{1,6}-\d{3,}(?![\d.,])")
"""Letters and a number of a tool, a form or an order: MG-0417."""
_TOTAL = re.compile(
    r"(?<![^\W\d_])f\s*[=:]?\s*\d{2}.*(?<![^\W\d_])[hxyz]\s*[=:]?\s*[-−]?\d|"
    r"(?<![^\W\d_])[hxyz]\s*[=:]?\s*[-−]?\d.*(?<![^\W\d_])f\s*[=:]?\s*\d{2}"
)
"""The strength of a field beside its components by their letters, as models give them."""
_TOTAL_ALONE = re.compile(r"f(?![^\W\d_])[^\d;]*\d")
_COMPONENT_ALONE = re.compile(r"[hxyz](?![^\W\d_])[^\d;]*\d")
"""The same in lines of their own."""
_COMPONENT = re.compile(
    rf"(?<![^\W\d_])[hxyz]\s*[=:]?\s*(?:[-−]?{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT})?,?"
)
_UNCERTAIN = re.compile(
    rf"(?P<value>(?:{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT})?)[\s,;]*[(\[]?\s*"
    r"(?:±|\+/-|\+-|(?<![^\W\d_])(?:expanded |std |standard |erw\w* )?(?:uncert\w*|unc|u|u95|incert\w*|"
    r"mess?unsicher\w*|"
    r"unsicher\w*|usikker\w*|погрешн\w*|неопред\w*)(?![^\W\d_])|不确定度|测量误差)"
    rf"[^\w+\-−]*(?:\([^)]*\)|[+\-−±]*)\W*(?:{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT}|"
    rf"%)?\s*(?:\(?k\s*=\s*\d[.,]?\d*\)?)?"
)
"""A value and its uncertainty: 56870 nT ± 45 nT, 9.8112 m/s² (uncertainty 0.0001)."""

_OF_UNCERTAINTY = re.compile(
    r"\W*(?:expanded |std |standard |erw\w* )?(?:uncert\w*|unc|u(?:95)?|incert\w*|mess?unsicher\w*|unsicher\w*|"
    r"usikker\w*|"
    r"погрешн\w*|неопред\w*|不确定度|±)(?![^\W\d_])(?!\s*[=:]?\s*\d+ ?v)"
)
"""The beginning of a line of uncertainties."""

_COUNTED = (
    r"(?:m?v(?:olts?)?|в|мв|lsb|cnts?|counts?|digits?|bits?|cuentas?|contage[mn]s?|zahlwert\w*|inkr\w*|tell\w*|"
    r"отсч\w*|код\w*|ед\w*|码\w?|计数)"
)
"""Volts and counts, of which a channel has so many to a unit, or a unit so many."""
_OF_A_UNIT = re.compile(
    r"(?:(?:^|[(\[,;:])\s*1|(?<![^\W\d_])(?:unit\w*|unidade?|einheit|enhet|enhed|eenheid|jednostka|единиц\w*)|单位)"
    rf"\s*(?:{_WRITTEN_UNIT}|[gг])\s*[=≙≈]\s*(?:{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT})|"
    rf"(?<![\w.,])(?:1\s*{_COUNTED}\.?\s*[=≙≈:]|(?:{_WRITTEN_NUMBER})\s*{_COUNTED}\.?\s*[=≙≈])\s*"
    rf"(?:{_WRITTEN_NUMBER})\s*(?:{_WRITTEN_UNIT})|"
    r"(?:(?<=\dg)|(?<=\d g)|(?<=\d; g))\s*[(\[]\W*9[.,]80665\s*m/s²\W*[)\]]"
)
"""Definition of a unit: 1 g = 9.80665 m/s², 1.0016 g (9.80665 m/s²); the size of a volt or a count: 1 V = 20 µT."""
_IN_OTHER_UNIT = re.compile(
    rf"(?P<value>(?P<number>{_WRITTEN_NUMBER})\s*(?P<unit>{_WRITTEN_UNIT}|g\b))[\s;]*"
    rf"(?:[(\[]\s*(?:=|i\.?e\.?|or)?|"
    rf"=)\s*(?P<again>{_WRITTEN_NUMBER})\s*(?P<other>{_WRITTEN_UNIT})(?:[^()\[\]\d;]*[)\]]|(?![^\W\d_]))"
)
"""A value, and in brackets the same in another unit."""
_FOR_EACH = r"\s*(?:/|per|pro|par|por|na|на|每)\s*"
_RATIO = (
    rf"(?:{_COUNTED}\.?{_FOR_EACH}(?:{_WRITTEN_UNIT})|"
    rf"(?:{_WRITTEN_UNIT}){_FOR_EACH}{_COUNTED}(?![^\W\d_]))"
)
_OF_SENSITIVITY = re.compile(
    rf"(?:(?:{_ROUGH.pattern})\W*)?(?:{_WRITTEN_NUMBER})\s*[(\[]?\s*{_RATIO}|{_RATIO}\W*(?:{_WRITTEN_NUMBER})?"
)
"""A sensitivity or its inverse: 16384 LSB/g, 0.5 counts per nT, µT/V = 50."""
_SENSITIVITY_RATIO = re.compile(
    rf"(?<![^\W\d_])(?P<counted>{_COUNTED})\.?{_FOR_EACH}(?P<unit>{_WRITTEN_UNIT}|[gг])(?![^\W\d_])|"
    rf"(?<![^\W\d_])(?P<per>{_WRITTEN_UNIT}){_FOR_EACH}(?P<counts>{_COUNTED})(?![^\W\d_])"
)
_OF_MAGNETS = re.compile(r"mag|flux|fel[dt]|field|champ|campo|маг|磁")
_OF_ANOTHER = re.compile(
    rf"\s*(?:{_COUNTED}|-?bits?|[km]?hz|k?sps|ppm|%|m?a|[mkh]?pa|[kmc]?m|kg|k?ohm)(?![^\W\d_])|"
    r"\W*(?:fs|f\.s|full[ -]?scale|span|range)(?![^\W\d_])"
)
"""Units of something else behind a number, and words of a range: 24 bit, 50 µT FS."""
_OF_ROUNDING = 1e-9
"""By how much a standard gravity in another unit differs from 1 g by rounding."""
_ROUNDED = 5e-4
"""By how much these differ at most, as a share: half a digit in the third place."""
_ANOTHER_UNIT = re.compile(r"\s*[^\W\d_]{1,3}(?![^\W\d_])(?!\W*\d)")
"""Letters behind a number that are a unit of something else, or not known: 50 Hz."""
_ANOTHER = re.compile(
    rf"[\s;,/|)]*(?:[^\W\d_]{{3,}}[,;/]\s*(?={_WRITTEN_NUMBER}\W{{0,2}}\s[^\W\d_]{{3,}}))?(?:(?:and|or|und|oder|bzw|"
    rf"og|eller|y|o|e|ou|et|и|или|resp)(?![^\W\d_])\s*)?"
    rf"(?P<number>{_WRITTEN_NUMBER})(?![./-]?\d)\s*(?P<unit>{_WRITTEN_UNIT}|(?!°|[^\W\d_]))"
)
"""A second value right behind one, or behind a name as the first is: 70.5 / 66.0, 70.5 Aberdeen, 58.1 Houston."""


def _statement(head: str) -> re.Pattern[str]:
    return re.compile(rf"{_BEGINNING}{head}(?![^\W\d_]){_BETWEEN}{_WITH_NUMBER}")


@cache
def _statements() -> list[tuple[_Quantity, re.Pattern[str]]]:
    """The forms in which a line states each quantity; made when they are needed, as that takes a while."""
    return [
        (q, _statement(head))
        for q in _OF_PLACES
        for head in (
            rf"(?P<word>{q.words})",
            rf"(?P<letter>[{q.letters}]0?)(?=\W*(?:{_WRITTEN_UNIT}|ref\w*|lo[ck]al\w*|here|hier|her|aqui|aca)?\W*\d)",
        )
    ]


@cache
def _inclination() -> tuple[_Quantity, re.Pattern[str]]:
    """An inclination in the line of a place, which is the dip."""
    return _OF_PLACES[1], _statement(r"(?P<word>inc|incl\w*|ink|inkl\w*|наклон)")


_NUMBER_IN_UNIT = re.compile(
    rf"(?<![\w.,±+-])(?P<number>[-−]?{_WRITTEN_NUMBER})\s*(?P<unit>{_WRITTEN_UNIT})(?!\s*\d+(?:[.,]\d+)?\s*(?:['′’]|"
    rf"min))",
)
_NUMBER_ANYWHERE = re.compile(
    rf"(?<![\w.,])(?P<number>[+\-−]?{_WRITTEN_NUMBER}){_MINUTES}\s*(?P<unit>(?:{_WRITTEN_UNIT})(?![^\W\d_]))?",
)
_UNIT_ALONE = re.compile(rf"(?<![^\W\d_])({_WRITTEN_UNIT})(?![^\W\d_])")
_NO_PLACE = re.compile(
    rf"{_UNSURE.pattern}|"
    r"horizont\w*|poziom\w*|pionow\w*|skladow\w*|slozk\w*|vertical\w*|vertik\w*|compon\w*|kompon\w*|north|nord|"
    r"south|sud(?!ut)|coil\w*|spule\w*|scale|scaling|sens\w*|full|skal\w*|empfind\w*|escala|følsom\w*|folsom\w*|"
    r"масштаб\w*|чувств\w*|коэфф\w*|比例|"
    r"measured|\bmeas\b|mean|average|\bavg|mittel|gemessen|malt|medid\w*|mesur\w*|media|medio|moyen\w*|средн\w*|"
    r"измер\w*|"
    r"vibr\w*|shock|\brms\b|"
    r"calc\w*|comput\w*|\bper (volt|m?v|count|cnt|bit|lsb|digit|div|deg\w*)\b|\bto\s*$|\bbis\s*$|change|variation|"
    r"shift|bias|previous|last|old|"
    r"(?<![^\W\d_])(?!by\s+[^\W\d_])[hbfg][xyz](?![^\W\d_])|fluxgate|\bfs\b|\btype|satur\w*|overload|capacity|"
    r"thermo\w*|"
    r"горизонт\w*|верти\w*|компон\w*|水平|垂直|分量|平均|测得|灵敏度|\d\s*m?v\b|[<>]",
)
"""Words of a strength that is not that of the place."""
_PER = re.compile(
    r"\s*/\s*(?:k?[mu]?[vah]|lsb|count|cnt|bit|digit|div|k?m|°\s?c?|k|c|deg\w*|min|s|h|day)(?![^\W\d_])"
)
"""A unit behind a slash: of a sensitivity, a gradient or a drift."""
_STANDARD = re.compile(
    r"(?<![^\W\d_])(g[0n]|standard\w*|std|norm\w*|unit\w*|einheit\w*|enhet\w*|unidade?s?|unite\w*|estandar|padrao|"
    r"стандарт\w*|норм\w*|единиц\w*)(?![^\W\d_])|标准|单位"
)
"""Words of the standard gravity, which is a unit."""
_AT = re.compile(
    r"\bat\b(?! (the )?(test |calibration )?(site|stand|lab\w*|bench|hut|place|pillar|pier|yard))|\bbei\b"
)
"""Words before a strength at which something was checked, unless it is one of several places."""
_INCLINED = re.compile(
    r"dip|(?<![^\W\d_])[iеe]n[ck]l\w*|inklin\w*|inclin\w*|наклон\w*|нахил\w*|倾|伏角|傾|egim|duzalimi|sklon\w*|"
    r"nachyleni\w*|dal[ıi]m\w*|көлбеу\w*|"
    r"(?<![^\W\d_])fall(?:vinkel)?(?![^\W\d_])|hajlas\w*|lutning|kallistuma|helling|mergulho|buzamiento|echado",
)
"""Words of an inclination, which is the field's in a line about a place."""
_OF_TABLE = re.compile(r"\bof (the )?(table|rig|cradle|fixture|tool|hole|well)\b")
_OF_STAND = re.compile(
    r"cradle|stand|rig|table|tool|bench|fixture|setting|setup|hole|well|plat|banco|banc\b|mesa|cuna|stativ|sonde|probe|"
    r"стенд|стол|скваж|зенит|转台|台|井|(?<![^\W\d_])azi\w*|decl\w*|error|acc?uracy|genau\w*|resid\w*",
)
"""Words of an inclination that is not the field's."""
_OTHER_ANGLE = re.compile(
    r"decl|deklin|misvis|conv|konv|(?<![^\W\d_])azi|asim|tool|roll|tf\b|склон|азим|磁偏|方位|±"
)
"""Words of angles that are no dip."""
_UPWARDS = re.compile(
    r"(?<![^\W\d_])(up|upwards?|para cima|hacia arriba|nach oben|aufwarts|oppover|vers le haut|verso l'?alto|"
    r"вверх)(?![^\W\d_])|向上|朝上|南|[(\[]s[)\]]|"
    r"(\d|[°'′\"″]|(?:deg|gra[du])\w*(?!\w))\W{0,3}"
    r"(s(?! ?/)|south\w*|sud|sul|sur|syd|sor|zuid|юг|ю|южн\w*)(?![^\W\d_])",
)
"""Words of a dip whose number is that of a field that points up, and behind it those of the south, where it does."""
_ALWAYS_WRITTEN = ("gon", "A/m", "mT", "gauss", "mG")
"""Units in which no bare number is read: 0.5 may be any factor."""
_SPELT = {
    "нтл": "nT", "мктл": "µT", "мтл": "mT", "м/с": "m/s²", "м/с²": "m/s²", "м/с2": "m/s²", "m/s": "m/s²", "г": "g",
    "град": "°", "度": "°", "도": "°", "fok": "°", "derece": "°", "stopni": "°", "gal": "gal",
    "γ": "nT", "gammas": "nT", "kγ": "µT", "kgamma": "µT",
    "nanotesla": "nT", "nanoteslas": "nT", "microtesla": "µT", "microteslas": "µT",
    "a/m": "A/m", "oe": "gauss", "э": "gauss", "гс": "gauss", "мгс": "mG",
    "см/с": "gal", "см/с²": "gal", "см/с2": "gal",
    "gs": "gauss", "gals": "gal", "гал": "gal",
    "ft/s": "ft/s²", "ft/s²": "ft/s²", "ft/s2": "ft/s²",
    "mgal": "mGal", "мгал": "mGal", "mg": "mg", "mgauss": "mG", "mgs": "mG", "milligauss": "mG",
}  # fmt: skip
"""Units in small letters, where `unit_of` does not know them or goes by capitals."""


_NO_LONGER = re.compile(
    r"(?<![^\W\d_])(prev(ious)?|former(ly)?|old|obsolete|superseded|no longer|last (cal\w*|site|year)|factory|fabrica|"
    r"usine|завод\w*|hos kunde\w*|(at|of) (the )?(customer|client|well ?site|rig ?site)|"
    r"customer('s)? (base|site|place)|"
    r"(beim|des) kunden|kundenort|(del?|no|do|en el|chez le|du) client[e]?|заказчик\w*|gammel\w*|gamle|"
    r"utgatt|tidligere|forrige|alte[rsn]?|ehemalig\w*|vorherig\w*|fruher\w*|antigu[oa]|antig[oa]|anterior|ancien\w*|"
    r"precedent\w*|vecchi[oa]|precedente|dawn\w*|poprzedni\w*|stary|stara|стар\w*|прежн\w*|прошл\w*|"
    r"предыдущ\w*)(?![^\W\d_])|"
    r"旧|以前|上次|出厂|客户",
)
"""Words of a place or a calibration whose references no longer hold."""
_OF_LIMITS = re.compile(
    r"\W*(\w+ )?(limits?|tolerances?|acceptance( criteria| limits)?|criteria|grenzwerte?|toleranz(en)?|grenser?|"
    r"toleranser?|limites?|tolerancias?|limiti|tolleranze|допуск\w*|пределы|限差|公差)\W*"
)
"""A line above limits, which are no references."""
_LIMITS_STATED = re.compile(rf"(specs?|specifications?|{_OF_LIMITS.pattern})\s*[:=]")


def stated_above(
    rows: Sequence[Sequence[object]], besides: Rows = (), elsewhere: str = ""
) -> Titles:
    """Metadata on tool, day and place from the rows above a table, and on the place from the lines `besides` it.

    Words `elsewhere` in the file may name the place, of a list of several.
    """
    rows, besides = (
        [row for row in each if len(_line(row)) <= LONGEST_STATEMENT] for each in (rows, besides)
    )
    rows = [_unsplit(row) for row in rows]
    block = titles(rows)
    above, beside = ([r for r in each if not _is_of_settings(r)] for each in (rows, besides))
    here = _of_this_place(_without_limits(above), elsewhere)
    values = _values_in(here, _without_limits(beside))
    for column in [c for c, each in values.items() if len(each) > 1]:
        values[column] = _of_the_stand(column, values[column], here)
    references = _only(values)
    rough = {c: text for c, text in doubtful_in(rows, besides).items() if c not in references}
    unread = next(filter(unread_declination, map(_line, above)), "")
    if unread and "declination_deg" not in block.metadata:
        rough["declination_deg"] = unread
    choices = {c: tuple(each) for c, each in values.items() if len(each) > 1}
    metadata, others = {**references, **block.metadata}, _with_other_values(above, references)
    return block._replace(metadata=metadata, not_taken=rough, choices=choices, others=others)


def _with_other_values(rows: Rows, references: Mapping[str, float]) -> dict[str, tuple[str, float]]:
    """The first line that states another value of each of some references, and it: of another place, or another day.

    >>> rows = [["Field at the observatory 50210 nT"], ["Field here 50123 nT"], ["50.12 uT in the mean"]]
    >>> _with_other_values(rows, {"ref_field_nt": 50123.0})
    {'ref_field_nt': ('Field at the observatory 50210 nT', 50210.0)}
    """
    lines: dict[str, tuple[str, float]] = {}
    stating = [
        row
        for row in _without_limits(rows)
        if not (_OF_UNCERTAINTY.match(_plain(_line(row))) or _COMPONENT_ALONE.match(_clauses(row)))
    ]
    for row in stating if references else ():
        for column, each in _values_in([row]).items():
            taken = references.get(column, 1.0)  # a standard gravity is no place's
            apart = [v for v in each if abs(v - taken) > _SAME_VALUE * abs(taken)]
            if taken != 1.0 and 1.0 not in each and apart and len(apart) == len(each):
                lines.setdefault(column, (_line(row), apart[0]))
    return lines


def _of_the_stand(column: str, values: dict[float, None], rows: Rows) -> dict[float, None]:
    """Of different values of a reference the one of here or today; or of the place that another line names."""
    every = {_plain(_line(row)): _values_in([row]) for row in rows}
    stating = {line: each[column] for line, each in every.items() if each.get(column)}
    beside = [line for line, each in every.items() if not any(each.values())]
    places = [line[match.end() :] for line in beside if (match := _OF_SITE.search(line))]
    first = beside[:1] if rows and beside[:1] == [_plain(_line(rows[0]))] else []
    others = {*re.findall(_LONG_WORD, " ".join([*first, *places]))}
    named = {line: {word for word in others if word in line} for line in stating}
    shared = set[str].intersection(*named.values()) if named else set()
    of_dip = [_CALLED_DIP] if column == _OF_PLACES[1].column else []
    for marked in (
        *([line for line in stating if words.search(line)] for words in (*of_dip, _OF_HERE)),
        [line for line, each in named.items() if each - shared],
    ):
        here = {v: None for line in marked for v in stating[line] if v in values}
        if len(here) == 1:
            return here
    return values


_SAME_VALUE = 5e-4
"""By how much a reference is rounded at most, as a share: 66.12° and 66.1° are one dip."""
_CALLED_DIP = re.compile(r"\bdip\b|magn|fel[dt]|campo|磁")
"""Words of a dip, beside an inclination that may be the stand's."""
_LONG_WORD = rf"{_CHINESE}{{2,}}|(?:(?!{_CHINESE})[^\W\d_]){{4,}}"
_OF_SITE = re.compile(
    r"(?<![^\W\d_])(site|place|location|calibrated (at|in)|ort|pruf ?ort|messort|standort|sted|lugar|local|"
    r"ciudad|cidade|lieu|luogo|место|город)(?![^\W\d_])|地点|地址|地區"
)
"""Words before the name of the place of a calibration."""
_OF_HERE = re.compile(
    r"(?<![^\W\d_])(lab\w*|kalibrier(raum|halle|labor)|"
    r"here|(this|test) (site|place)|stand|bench|banco|bancada|today|hier|messplatz|prufstand|"
    r"heute|her|i ?dag|aqui|hoy|hoje|здесь|сегодня|стенд\w*)(?![^\W\d_])|本地|本站|今天|实验室",
)
"""Words of the place and the day of a calibration."""


def _without_limits(rows: Rows) -> list[Sequence[object]]:
    """The rows without those below a line that says that limits follow, each with a number."""
    kept, limits = list[Sequence[object]](), False
    for row in rows:
        text = _plain(_line(row)).strip()
        numbered = bool(re.search(r"\d", text))
        limits = bool(_OF_LIMITS.fullmatch(text)) or (limits and numbered)
        kept += [] if limits or _LIMITS_STATED.match(text) else [row]
    return kept


def _is_of_settings(row: Sequence[object]) -> bool:
    """Whether a row states settings of the stand: an inclination beside an azimuth or a toolface, and no field."""
    settings = settings_in(_line(row))
    inclined = len(settings) > 1 and "ref_inclination_deg" in settings
    return inclined and references_in([row]).keys() <= {"ref_dip_deg"}


def _of_this_place(rows: Rows, elsewhere: str = "") -> list[Sequence[object]]:
    """The rows without those of other places: of a list of places below names, and lines on what no longer holds.

    Of a list the row counts whose place is named in another row of the title block too, or the only one that is not
    said to hold no longer. Where none does, or several do, the list stays, and its values differ.
    """
    valid = [
        row
        for row in map(_without_asides, rows)
        if not _NO_LONGER.search(_plain(_line(row)))
        and not _OF_UNCERTAINTY.match(_plain(_line(row)))
    ]
    kept = [*valid]
    lists = [k for k, row in enumerate(valid) if k and _is_of_place(row)]
    for first in (k for k in lists if not _is_of_place(valid[k - 1])):
        block = [valid[k] for k in range(first, len(valid)) if {*range(first, k + 1)} <= {*lists}]
        others = " ".join([elsewhere, *(_line(row) for row in valid if row not in block)])
        named = [row for row in block if re.search(rf"(?<!\w){_first_word(row)}(?!\w)", others)]
        if len(block) > 1 and len(named) == 1:
            kept = [row for row in kept if row not in block or row in named]
    return kept


def _without_asides(row: Sequence[object]) -> Sequence[object]:
    """A row without the cells behind its first that state by themselves what no longer holds, or of another place."""
    first, *cells = row or [""]
    plain = [_plain(as_text(cell)) for cell in cells]
    aside = [bool(re.search(r"\d", text) and _NO_LONGER.search(text)) for text in plain]
    return [first, *(cell for cell, out in zip(cells, aside, strict=True) if not out)]


def _first_word(row: Sequence[object]) -> str:
    """The first word of a row."""
    match = re.match(r"[^\W\d_]+", _line(row))
    return match[0] if match else ""


def _is_of_place(row: Sequence[object]) -> bool:
    """Whether a row is a name with two numbers or more behind it, and nothing else."""
    first, *cells = [as_text(cell).strip() for cell in row] or [""]
    filled = [*filter(None, cells)]
    numbers = all(re.fullmatch(rf"{_WRITTEN_NUMBER}", cell) for cell in filled)
    return bool(re.match(r"[^\W\d_]", first)) and len(filled) > 1 and numbers


_SPLIT_BEFORE = re.compile(r"(?P<words>.*?)(?P<digits>(?<![\w.,])\d+)$")
_SPLIT_BEHIND = re.compile(r"(?P<digits>\d+)(?P<point>\.\d+)?(?!\d)(?P<text>.*)")


def _unsplit(row: Sequence[object]) -> list[object]:
    """A row of texts whose numbers a comma has split, as they were written: Field: 56 | 870 nT, Dip: 70 | 5 deg.

    Words before or a unit behind tell; of bare numbers, three digits behind one to three. Cells of a workbook are
    never split.

    >>> _unsplit(["Total field: 56", "870 nT", "Dip", "70.5"])
    ['Total field: 56,870 nT', 'Dip', '70.5']
    >>> _unsplit(["Field, dip", "50000", "65"])
    ['Field, dip', '50000', '65']
    """
    whole: list[object] = []
    pointed = any(re.fullmatch(r"\d+\.\d+", as_text(cell).strip()) for cell in row)
    for cell in row:
        before = whole and isinstance(whole[-1], str) and _SPLIT_BEFORE.fullmatch(whole[-1])
        behind = isinstance(cell, str) and _SPLIT_BEHIND.fullmatch(cell)
        if before and behind and _belong_together(before, behind, len(whole) > 1, pointed):
            whole[-1] = f"{whole[-1]},{cell}"
        else:
            whole.append(cell)
    return whole


def _belong_together(
    before: re.Match[str], behind: re.Match[str], labelled: bool, pointed: bool
) -> bool:
    """Whether the ends of two cells are one number, in a row of numbers with a decimal point or without."""
    thousands = len(before["digits"]) <= 3 and len(behind["digits"]) == 3
    if (behind["point"] or pointed) and not thousands:
        return False
    labels = re.search(r"[^\W\d_]", before["words"]) or re.match(
        rf"\s*(?:{_WRITTEN_UNIT})", _plain(behind["text"])
    )
    return bool(labels) or (thousands and labelled)


class Sensitivity(NamedTuple):
    """A scale that a line states: raw units in a g or nT, the raw unit (mV, V, or counts), and the base: g or nT."""

    scale: float
    raw: str
    base: str


def sensitivity_in(line: str) -> Sensitivity | None:
    """The sensitivity of a triad that a line states, or its inverse.

    >>> sensitivity_in("Nominell følsomhet magnetometer (mV/µT) 40")
    Sensitivity(scale=0.04, raw='mV', base='nT')
    >>> sensitivity_in("accelerometers 16384 LSB/g").scale, sensitivity_in("Field 50612 nT")
    (16384.0, None)
    """
    text = _plain(line)
    match = _SENSITIVITY_RATIO.search(text)
    if not match:
        return None
    before = re.search(rf"(?P<number>{_WRITTEN_NUMBER})\s*[(\[]?\s*$", text[: match.start()])
    number = before or re.match(rf"\W*(?P<number>{_WRITTEN_NUMBER})", text[match.end() :])
    values = {*_numbers(number["number"])} - {0.0} if number else set()
    quantity = _OF_PLACES[0 if _OF_MAGNETS.search(text) else 2]
    unit = _stated_unit(quantity, match["unit"] or match["per"])
    base = next((q.units[0] for q in _OF_PLACES[::2] if unit in q.units), "")
    if len(values) != 1 or not base:
        return None
    scale = values.pop() if match["unit"] else 1 / values.pop()
    counted = match["counted"] or match["counts"]
    raw = "counts" if counted[-1:] not in "vв" else "mV" if len(counted) > 1 else "V"
    return Sensitivity(scale / FACTORS.get(unit, (1.0, 0.0))[0], raw, base)


def references_in(rows: Rows, besides: Rows = ()) -> dict[str, float]:
    """The references that rows above a table state, and lines `besides`, by column of a run file, in its unit.

    None that is stated twice.

    >>> references_in([["Local field:", "48 912 nT", "Dip", "66,2°"], ["g (m/s²)", 9.80665]])
    {'ref_field_nt': 48912.0, 'ref_dip_deg': 66.2, 'ref_gravity_g': 1.0}
    >>> references_in([["B at site / inclination"], ["Geomagnet [µT]", "Incl."], [48.9, 66.2]])
    {'ref_field_nt': 48900.0, 'ref_dip_deg': 66.2}
    >>> references_in([["local field 46.8 uT nominal"], ["field uncertainty 50 nT"]])
    {}
    """
    return _only(_values_in(rows, besides))


def _only(values: Mapping[str, Collection[float]]) -> dict[str, float]:
    """The references of one value."""
    return {column: next(iter(each)) for column, each in values.items() if len(each) == 1}


def _values_in(rows: Rows, besides: Rows = ()) -> dict[str, dict[float, None]]:
    """The different values of each reference that rows above a table and lines `besides` state."""
    every_text = map(_clauses, [*_with_columns(rows), *besides])
    texts = [text for text in every_text if not _ROUGH_VALUES.search(text)]
    if any(map(_TOTAL_ALONE.match, texts)):
        texts = [text for text in texts if not _COMPONENT_ALONE.match(text)]
    by_word, of_places, by_unit = (dict[str, dict[float, None]]() for _ in range(3))
    for text in texts:
        here = {column for s in _statements() for column, _ in _stated(text, *s)}
        of_place = {"ref_field_nt", "ref_gravity_g"} <= here and "ref_dip_deg" not in here
        for statement in [*_statements(), _inclination()] if of_place else _statements():
            for column, value in _stated(text, *statement):
                by_word.setdefault(column, {})[value] = None
        for column, value in _of_a_place(text).items():
            of_places.setdefault(column, {})[value] = None
        for column, value in _by_unit(text, here):
            by_unit.setdefault(column, {})[value] = None
    every = by_unit | of_places | {c: each | by_unit.get(c, {}) for c, each in by_word.items()}
    if {"ref_field_nt", "ref_dip_deg"}.isdisjoint(every):
        every |= {column: {value: None} for column, value in _by_components(texts).items()}
    if "ref_field_nt" in every and "ref_dip_deg" not in every:
        inclinations = [v for text in texts for v in _inclinations(text)]
        every["ref_dip_deg"] = dict.fromkeys(
            inclinations or [v for text in texts for v in _beside_field(text)]
        )
    return every


def _with_columns(rows: Rows) -> list[Sequence[object]]:
    """The rows, with each value below a row of words as a row of both."""
    every = [*rows]
    paired: list[Sequence[object]] = []
    words: list[str] = []
    for above, below in pairwise(every):
        texts = [as_text(cell).strip() for cell in above]
        if words and sum(map(_is_a_unit, texts)) > 1:
            words = [
                f"{word} {text}" if _is_a_unit(text) else word
                for word, text in zip_longest(words, texts, fillvalue="")
            ]
        elif not (words and _is_of_place(above)):
            words = texts
        cells = [as_text(cell).strip() for cell in below]
        if (
            not any(re.match(r"[-−+]?\d|.*(\d{3}|:)", word) for word in words)
            and len([*filter(None, words)]) > 1
        ):
            paired += [
                [f"{word} {cell}"]
                for word, cell in zip(words, cells, strict=False)
                if word and re.match(r"[-−+]?\d", cell)
            ]
    return [*every, *paired]


def _is_a_unit(text: str) -> bool:
    """Whether a text is a unit in brackets or without: [nT], deg."""
    return bool(re.fullmatch(_WRITTEN_UNIT, _plain(text).strip("[]() ")))


class _Figure(NamedTuple):
    """A number of a line with the words before it, its unit, and what follows up to the next number."""

    words: str
    number: str
    minutes: float
    unit: str
    behind: str


_HORIZONTAL = re.compile(r"horizont\w*|poziom\w*|гориз\w*|vodorovn\w*|水平|\bh\b")
_VERTICAL = re.compile(r"vertik\w*|vertical\w*|pionow\w*|верти\w*|svisl\w*|垂直|竖直|\b[zv]\b")
_COMPONENTS = re.compile(
    r"compon\w*|kompon\w*|komp\b|skladow\w*|состав\w*|компон\w*|slozk\w*|intensit\w*|分量|part\b|anteil"
)
"""Words of the two components of a field, of which strength and dip follow."""


def _by_components(texts: Sequence[str]) -> dict[str, float]:
    """Field and dip of the horizontal and the vertical component that lines state, the latter positive downwards.

    >>> _by_components(["field, horizontal component 3.0 ut; vertical component 4.0 ut"])["ref_field_nt"]
    5000.0
    """
    parts: dict[bool, set[float]] = {True: set(), False: set()}
    for text in (t for t in texts if _COMPONENTS.search(t)):
        for figure in _figures(text):
            unit = _stated_unit(_OF_PLACES[0], figure.unit)
            flat, steep = _HORIZONTAL.search(figure.words), _VERTICAL.search(figure.words)
            if unit in _OF_PLACES[0].units and bool(flat) != bool(steep):
                parts[bool(flat)] |= {_converted(n, unit) for n in _numbers(figure.number)}
    if any(len(each) != 1 for each in parts.values()):
        return {}
    (horizontal,), (vertical,) = parts[True], parts[False]
    return {
        "ref_field_nt": math.hypot(horizontal, vertical),
        "ref_dip_deg": math.degrees(math.atan2(vertical, horizontal)),
    }


def _figures(text: str) -> Iterator[_Figure]:
    """The numbers of a line of clauses; the words before each reach back to the number or semicolon before."""
    matches = [*_NUMBER_ANYWHERE.finditer(text)]
    for before, match, after in zip([None, *matches], matches, [*matches[1:], None], strict=False):
        words = text[before.end() if before else 0 : match.start()].rpartition(";")[2]
        inner = [each[1] for each in _UNIT_ALONE.finditer(words)]
        behind = text[match.end() : after.start() if after else None].partition(";")[0]
        yield _Figure(
            words,
            match["number"],
            _minutes(match),
            match["unit"] or (inner[-1] if inner else ""),
            behind,
        )


def _beside_field(text: str) -> Iterator[float]:
    """The angle right behind the strength of a field in a line of both: 51.23 µT @ 72.9°, field/dip 49812 nT / 70°."""
    figures = [*_figures(text)]
    named = any(re.search(rf"(?:{_OF_PLACES[1].words})", f"{f.words} {f.behind}") for f in figures)
    for one, other in pairwise(figures):
        strength = _stated_unit(_OF_PLACES[0], one.unit) in _OF_PLACES[0].units
        behind = re.fullmatch(r"\W*(?:@|/|at)\W*" if not named else r"\W*", other.words)
        if strength and behind and _unit(other.unit) == "°" and not _OTHER_ANGLE.search(text):
            inside = {n for n in _numbers(other.number, other.minutes) if 0 < abs(n) < 90}
            up = _UPWARDS.search(f"{other.number} {other.behind}")
            yield from (-abs(n) if up else n for n in inside if len(inside) == 1)


def _by_unit(text: str, here: Collection[str]) -> Iterator[tuple[str, float]]:
    """Strengths of field and gravity that a line states in whatever words, by their units and sizes.

    `here`: columns of those that it states by their words, beside which any other is of another place.
    """
    for figure in _figures(text):
        said = figure.words if re.search(r"[^\W\d_]", figure.words) else text
        if _NO_PLACE.search(f"{said} {figure.behind}") or _PER.match(figure.behind):
            continue
        for quantity in (_OF_PLACES[0], _OF_PLACES[2]):
            unit = _stated_unit(quantity, figure.unit)
            values = (
                {_converted(n, unit) for n in _numbers(figure.number)}
                if unit in quantity.units
                else set()
            )
            inside = {v for v in values if quantity.low <= v <= quantity.high} - {1.0}
            if len(inside) == 1 and (quantity.column in here or not _AT.search(said)):
                yield quantity.column, inside.pop()


def _inclinations(text: str) -> Iterator[float]:
    """The angles that a line calls an inclination in some language, and not that of a stand or a hole."""
    for figure in _figures(text):
        word = _INCLINED.search(figure.words) or re.match(
            r"\W*(?:mag\w* )?dip(?![^\W\d_])", figure.behind
        )
        if (
            not word
            or _OF_STAND.search(figure.words)
            or _NO_PLACE.search(f"{figure.words} {figure.behind}")
        ):
            continue
        if _stated_unit(_OF_PLACES[1], figure.unit) in ("", "°"):
            inside = {n for n in _numbers(figure.number, figure.minutes) if 0 < abs(n) < 90}
            up = _UPWARDS.search(f"{figure.words} {figure.number} {figure.behind}")
            yield from (-abs(n) if up else n for n in inside if len(inside) == 1)


def _stated(
    text: str, quantity: _Quantity, pattern: re.Pattern[str]
) -> Iterator[tuple[str, float]]:
    """The values of a quantity that a line states, with its column."""
    for match in pattern.finditer(text):
        before = _BEFORE.search(text, 0, match.start())
        if not (before and _NO_PLACE.search(before[0])):
            values = _values(quantity, match)
            standard = _STANDARD.search(text)
            yield from ((quantity.column, v) for v in values if not (standard and v == 1.0))


def _line(row: Sequence[object]) -> str:
    return " ".join(filter(None, (as_text(cell).strip() for cell in row)))


def _clauses(row: Sequence[object]) -> str:
    """The cells of a row in small letters, a semicolon behind each that ends a statement: a number with its unit."""
    text, ends = "", False
    each = (_IN_SIXTIETHS.sub(_with_signs, _SENTENCE.sub("; ", as_text(cell))) for cell in row)
    cells = [*filter(None, (_without_names(_plain(text)).strip() for text in each))]
    if len(cells) == 2 and re.fullmatch(r"[fbi]", cells[0]):
        cells.insert(1, "=")
    for cell in cells:
        unit = re.fullmatch(rf"[(\[]?({_WRITTEN_UNIT}|[ns])[)\]]?[;,.]?", cell)
        text += f"; {cell}" if ends and not unit else f" {cell}"
        ends = not unit and bool(re.search(r"(?<![\w.,])[+\-−]?\d[^;]*$", cell))
    text = _GROUPED_DECIMALS.sub("", text)
    if _INSTRUMENT.search(text):
        text = _OF_INSTRUMENT.sub(" ", text)
    if _TOTAL.search(text):
        text = _COMPONENT.sub(" ", text)
    text = _IN_OTHER_UNIT.sub(_said_once, _OF_A_UNIT.sub("", _OF_SENSITIVITY.sub(" ", text)))
    text = _WITH_SPREAD.sub(r"\1 \4 \2 \3 \4", text)
    return _RANGE.sub("range ", _UNCERTAIN.sub(r"\g<value> ", text)).strip()


def _without_names(text: str) -> str:
    """A text without numbers that are part of a name: of days, years, models, tools and forms."""
    for pattern in (_DAY_OR_MODEL, _YEAR, _TOKEN_OF_LETTERS_AND_DIGITS):
        text = pattern.sub(" ", text)
    return text


_SENTENCE = re.compile(
    r"(?:(?<=[^\W\d_]{5})|(?<=\d)|(?<=\d [^\W\d_]{2}))\.\s+(?=[^\W\d_a-zа-яß-ÿ])"
)
"""The end of a sentence: a point behind a whole word or a number with its unit, and a capital letter."""


_IN_SIXTIETHS = re.compile(
    r"(?<![\w.,+-])(?=\d\d[-:](?:1[3-9]|[2-5]\d)|(?:3[2-9]|[4-8]\d)[-:]\d\d)"
    r"(?P<d>[0-8]\d)[-:](?P<m>[0-5]\d)(?:[-:](?P<s>[0-5]\d(?:[.,]\d+)?))?(?![\w:-])"
)
"""Degrees, minutes and seconds between dashes, which are no day: 70-24-00."""


def _with_signs(match: re.Match[str]) -> str:
    return f"{match['d']}° {match['m']}' {match['s'] or '00'}\""


def _said_once(match: re.Match[str]) -> str:
    """A value without the brackets behind it that say the same in another unit; all of it where they do not."""
    one, other = (
        [_converted(number, _unit(match[unit])) for number in _numbers(match[text])]
        for text, unit in (("number", "unit"), ("again", "other"))
    )
    same = any(abs(b - a) <= _ROUNDED * abs(a) for a, b in product(one, other))
    return f"{match['value']};" if same and match["unit"] != match["other"] else match[0]


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
        for number in _numbers(text)
    )
    return {v for v in values if quantity.low <= v <= quantity.high}


def doubtful_in(rows: Rows, besides: Rows = ()) -> dict[str, str]:
    """The lines above a table that may state a reference, by column of a run file.

    They state a nominal or approximate one, two, a number in a unit and of a size that the Earth's field or gravity
    has, or one that no place has.

    >>> doubtful_in([["Nominal field", "48 500 nT"], ["Field uncertainty 50 nT"], ["here", "9.81 m/s2"]])
    {'ref_field_nt': 'Nominal field 48 500 nT', 'ref_gravity_g': 'here 9.81 m/s2'}
    """
    lines: dict[str, str] = {}
    for row in [*_with_columns(rows), *besides]:
        line, plain = _line(row), _clauses(row)
        bare = _OF_MEANS.sub(" ", _ROUGH.sub(" ", plain))
        for column in references_in([[bare]]) if bare != plain else ():
            lines.setdefault(column, line)
        for column, each in _values_in([row]).items():
            if len(each) > 1:
                lines.setdefault(column, line)
        numbers = [*_NUMBER_IN_UNIT.finditer(plain)]
        for quantity in (_OF_PLACES[0], _OF_PLACES[2]):
            if _in_unit(quantity, numbers) - {1.0}:
                lines.setdefault(quantity.column, line)
        for quantity, figure in product(_OF_PLACES, _figures(plain)):
            if _is_called(quantity, figure) and not _UNSURE.search(
                f"{figure.words} {figure.behind}"
            ):
                lines.setdefault(quantity.column, line)
    return lines


def _is_called(quantity: _Quantity, figure: _Figure) -> bool:
    """Whether words right before a number are those of a quantity, and the number is no count: dip 97.2."""
    words = _UNIT_ALONE.sub("", figure.words)
    called = re.search(rf"{_BEGINNING}({quantity.words})\W*(?:{_REFERRING.pattern}\W*)*$", words)
    return bool(called) and bool(figure.unit or len(figure.number) > 2)


def _plain(text: str) -> str:
    """Small letters without marks; the signs of units stay."""
    apart = re.sub(r"(?<=[a-z]{2})(?=[A-Z][a-z]{2})", " ", text)
    kept = (
        re.sub(r"\bref(erence)?\.? std\b", "reference", apart, flags=re.IGNORECASE)
        .replace("_", " ")
        .replace("°", "\0")
        .replace("º", "\0")
        .replace("²", "\1")
        .replace("й", "\2")
    )
    bare = without_marks(kept.lower().translate({ord("ø"): "o", ord("ß"): "ss", ord("ł"): "l"}))
    bare = re.sub(r"(?<=[\u4e00-\u9fff])(?=[a-zµμ])", " ", bare)
    signs = bare.replace("\0", "°").replace("\1", "²").replace("\2", "й")
    signs = re.sub(r"(?<![a-z])cm\s?/\s?s\s?(?:\^?2|²)(?!\d)", "gal", signs).replace("n/kg", "m/s²")
    return re.sub(
        r"(?<![a-zа-я])(?:[mм]\s?/\s?[sс]\s?(?:\^?2|²)|m\s?[.·∙⋅*]?\s?s\s?\^?[-−⁻][2²]|m ?s2|mps2?|"
        r"met(?:er|re)s?\s?(?:/|per )\s?s(?:ec(?:ond)?)?\s?(?:\^?2|²|squared)|m\s?/\s?sec\s?(?:\^?2|²)|"
        r"m\s?/\s?s\s?/\s?s)(?!\d)",
        "m/s²",
        signs,
    )


def _values(quantity: _Quantity, match: re.Match[str]) -> Iterator[float]:
    """The value that a text states, in the unit of the run file, if it is one, and another right behind it."""
    between, behind = match["between"], match["behind"]
    rough = bool(re.match(rf"\W*({_ROUGH.pattern}|k\s?g\b)", behind)) and not match["next"]
    counted = _OF_ANOTHER.match(behind) or re.match(r"\s*=\s*[^\W\d_]", behind)
    letter = "letter" in match.groupdict()
    if (
        rough
        or counted
        or _OF_COMPONENT.search(between)
        or _OF_TABLE.search(between)
        or _UNSURE.search(between if letter else f"{match['word']} {between}")
    ):
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
        or ("=" in bare and (decimals or len(match["number"]) > 4))
        or (quantity.column == "ref_gravity_g" and decimals > 2)
    )
    alone = not re.search(r"dip|grav|in[ck]l", match.string)
    short = letter or (alone and match["word"] == "mag")
    if (short and not (direct and sure)) or not (direct or stated):
        return
    if letter and not stated and _ANOTHER_UNIT.match(match.string, match.end("number")):
        return
    if stated and stated not in quantity.units:
        return
    numbers = [*_numbers(match["number"], _minutes(match))]
    if quantity.low < 0 and _UPWARDS.search(match[0]):
        numbers = [-abs(number) for number in numbers]
    units = (
        (stated,) if stated else [unit for unit in quantity.units if unit not in _ALWAYS_WRITTEN]
    )
    units = units[:1] if letter and not stated and quantity.low > EARTH_FIELD[0] - 1 else units
    inside = [*_inside(quantity, numbers, units)]
    other = _ANOTHER.match(match.string, match.end("unit" if match["unit"] else "number"))
    same = other and _stated_unit(quantity, other["unit"]) in ("", *quantity.units)
    others = _inside(quantity, _numbers(other["number"]), units) if other and same else ()
    if len(inside) == 1:
        yield inside[0]
        yield from (v for v in others if abs(v - inside[0]) < abs(inside[0]) / 2)


def _inside(quantity: _Quantity, numbers: Iterable[float], units: Sequence[str]) -> Iterator[float]:
    """The different values, in the unit of the run file, that numbers in some units are and that the Earth has."""
    values = {_converted(number, unit) for number, unit in product(numbers, units)}
    return (v for v in values if quantity.low <= v <= quantity.high and v)


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


def _minutes(match: re.Match[str]) -> float:
    """The minutes and seconds behind degrees, in minutes."""
    one, two = (float((match[name] or "0").replace(",", ".")) for name in ("minutes", "seconds"))
    return one + two / 60


def _numbers(text: str, minutes: float = 0.0) -> Iterator[float]:
    """The numbers that digits may be: a point or a comma may be the decimal sign, or separate thousands."""
    plain = re.sub(r"[ '’\u00a0\u202f](?=\d{3})", "", text.replace("−", "-"))
    part = minutes / 60
    for sign, other in (".,", ",."):
        bare = plain.replace(other, "") if re.search(rf"\{other}\d{{3}}(?!\d)", plain) else plain
        if looks_numeric(bare, sign):
            number = float(bare.replace(sign, "."))
            yield number - part if plain.startswith("-") else number + part


def _converted(number: float, unit: str) -> float:
    """A number in the unit of the run file; the standard gravity is 1 g in any unit."""
    factor, _ = FACTORS.get(unit, (1.0, 0.0))
    value = number * factor
    return 1.0 if abs(value - 1) < _OF_ROUNDING else value
