"""Columns of measured depths: how they are called in the field, and their units of length."""

from __future__ import annotations

import re

import numpy as np

from mwdcal.files.formats.columns import without_marks
from mwdcal.geometry.units import LENGTH_UNITS
from mwdcal.geometry.vectors import Array

MEASURED_DEPTHS = {f"md_{unit}": unit for unit in LENGTH_UNITS}
"""The columns of measured depths, with their unit."""
_ALONG = (
    r"(md|measured|meas|bit|survey|station|along|ah|(bore ?)?hole|tool|sensor|drilled|"
    r"gemessene?|malt|medida|med|mesuree?|mes|misurata|del?|d[aou]|la|pozo|sondeo|barrena|poco|broca|forage|puits|"
    r"по|стволу?|измер\w*|замера|скважины|долота)"
)
"""Words beside depth that leave it a measured one, as `_plain` spells them."""
_NOUN = (
    r"(md|m d|md ?(b?rt|r?kb|df)|dept|ahd|depth|(mess|bohr|bohrloch|meissel)?(tiefe|teufe)|"
    r"((bore)?hull?s?|bit|borekrone|male)?(dybde|dyp)|prof(undidade?|ondeur|ondita)?|глуб(ина)?|"
    r"(测量?|斜|井眼?|孔|测点|钻头)+深度?|深度)"
)
_WORDS_OF_LENGTH = {
    "usft": r"us ?ft|ft ?us|us survey (foot|feet)|s ?ft",
    "ft": r"ft|feet|foot|fuss|fot|pies?|pes|pieds?|фут\w*|英尺",
    "m": r"m|met(re|er|ro)s?|м|米",
}
"""Words for each unit of length."""
_UNIT_OF_DEPTH = rf"({'|'.join(_WORDS_OF_LENGTH.values())})( ?(md|rt|rkb))?"
_LENGTH = re.compile(
    rf"((bore ?)?hole|well( ?bore)?|drilled|along hole|ah) length ?{_UNIT_OF_DEPTH}"
)
_DEPTH = re.compile(rf"({_ALONG} )*{_NOUN}( {_ALONG})*( ?{_UNIT_OF_DEPTH})?")
_AT_END = {
    unit: re.compile(rf"(?<![a-zа-я])({words})( ?(md|rt|rkb))?$")
    for unit, words in _WORDS_OF_LENGTH.items()
}
_OTHER_UNIT = re.compile(
    r"(?<![a-zа-я])([kcdm]m|(kilo|[cz]enti|de[cz]i|mill?i)met(re|er|ro)s?|k ?ft|inch(es)?|yd|yards?|fathoms?|[ксдм]м|"
    r"[千公分厘毫]米|公里)( ?(md|rt|rkb))?$"
)
"""Units of length at the end of a name in which mwdcal reads no measured depth."""
_NO_DEPTH = re.compile(
    r"tvd|msl|verti[ck]al|cable|kabel|elev|altit|water|wasser|hohe|høyde|\b(vann|vatn|meer|sjø|вод|мор|кабел|"
    r"вертикал|высот|отметк|альтитуд)|\b((sub ?)?sea(bed|floor| ?level)?|hav(et)?|agua|acqua|eau|cabo|cavo|mare?|mer|"
    r"cot[ae]|quota|altura|hauteur|altezza)\b|[垂水海高缆]"
)
"""Words of vertical depths, of depths of water, lengths of cable and heights, as `_plain` spells them."""


def _plain(text: str) -> str:
    """A text in small letters without accents, its words with single blanks between them."""
    return " ".join(re.findall(r"[^\W_]+", without_marks(text).casefold()))


def is_depth(name: str) -> bool:
    """Whether a column has measured depths by its name.

    >>> [is_depth(n) for n in ("MD [m]", "Bit depth", "md_usft", "Prof. medida", "Глубина по стволу, м")]
    [True, True, True, True, True]
    >>> [is_depth(n) for n in ("Immersion depth", "Depth TVD", "TVD (m)")]
    [False, False, False]
    """
    return bool(_DEPTH.fullmatch(_plain(name)))


def is_length(name: str, unit: str = "") -> bool:
    """Whether a column is called a length of hole, in a unit of length; a bare length may be that of anything.

    >>> is_length("Hole length (m)"), is_length("Well length", "ft"), is_length("Hole length"), is_length("Length (m)")
    (True, True, False, False)
    """
    return bool(_LENGTH.fullmatch(_plain(f"{name} {unit}")))


def is_other_length(name: str, unit: str = "") -> bool:
    """Whether a column is another length than a measured depth by its name, or in a unit that no depth has.

    >>> [is_other_length(n) for n in ("TVD (m)", "Depth (m) MSL", "Seekabel, m", "Depth (km)", "Length (m)")]
    [True, True, True, True, False]
    """
    return bool(_NO_DEPTH.search(_plain(name)) or other_unit_of_length(name, unit))


def other_unit_of_length(*texts: str) -> str:
    """The first unit of length at the end of texts in which no measured depth is read, else blank.

    >>> other_unit_of_length("Pos (km)"), other_unit_of_length("Pos", "[mm]"), other_unit_of_length("Pos (m)")
    ('km', 'mm', '')
    """
    ends = (_OTHER_UNIT.search(_plain(text)) for text in texts)
    return next((end[1] for end in ends if end), "")


def counts_stations(values: Array) -> bool:
    """Whether most of some numbers (n,) go on by one from whole number to whole number, as those of stations do.

    >>> counts_stations(np.array([1.0, 2, 3, 5])), counts_stations(np.array([0.0, 30, 60]))
    (True, False)
    """
    there = values[~np.isnan(values)]
    whole = there.size > 1 and bool((there == np.round(there)).all())
    return whole and float(np.mean(np.diff(there) == 1)) > 0.5


def unit_of_length(*texts: str) -> str:
    """The unit of length at the end of the first text that has one, else blank.

    >>> unit_of_length("Hole depth (ft)"), unit_of_length("MD", "[м]"), unit_of_length("Tiefe")
    ('ft', 'm', '')
    """
    plain = map(_plain, texts)
    return next((u for text in plain for u, words in _AT_END.items() if words.search(text)), "")


def chosen_length(stated: str, chosen: str) -> str:
    """The unit of depths that state one, or none; feet without more words are those that were chosen.

    >>> chosen_length("ft", "usft"), chosen_length("", "ft"), chosen_length("m", "ft")
    ('usft', 'ft', 'm')
    """
    return chosen if not stated or (stated, chosen) == ("ft", "usft") else stated
