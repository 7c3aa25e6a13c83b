"""Settings of the stand that stand beside the columns: in lines between the rows, names of sheets, codes of stations.

A technician who turns a tool at one inclination after the other writes the inclination once, in a line above its rows,
or as the name of the sheet. `with_settings_of_lines` gives such words columns of their own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from mwdcal.files.formats.columns import as_text
from mwdcal.files.synonyms import resembled
from mwdcal.files.words import spelled

_ANGLES = {
    "ref_inclination_deg": "Inclination",
    "ref_azimuth_deg": "Azimuth",
    "ref_toolface_deg": "Toolface",
}
_WORDS = r"(?P<words>[^\W\d_](?:[^\W\d_]|[ ./_-])*{more})"
_NUMBER = (
    r"(?P<number>(?<![\d.,/-])[+−-]?\d+(?:[.,]\d+)?)(?![\d.,]*\d)(?![/-]\d)\s*"
    r"(?P<unit>(?:°|º|deg\w*|grad\w*|gon|rad|град\w*|度)(?![^\W\d_]))?"
)
_FORMS = (
    re.compile(
        rf"(?<![^\W\d_]){_WORDS.format(more='?')}\.?\s*(?:[=:：]\s*)?{_NUMBER}(?![^\W\d_]*\d*[^\W\d_])",
        re.IGNORECASE,
    ),
    re.compile(rf"{_NUMBER}\s*{_WORDS.format(more='')}", re.IGNORECASE),
)
"""A number with its unit behind words, and before them: Inclination 30°, 30° inclination."""
_TO = re.compile(r"\s*(?:to|bis|til|до|[-–…]|\.\.)\s*[\d+]", re.IGNORECASE)
"""The end of a range behind a number."""
_CODE = re.compile(r"(?:[^\W\d_]{1,3}[ ._=-]?-?\d{1,3}(?:\.\d+)?[°]?[ _,;/-]?){2,4}")
"""A code of a station that states its setting: I30A090T180."""
_PART_OF_CODE = re.compile(r"([^\W\d_]{1,3})[ ._=-]?(-?\d{1,3}(?:\.\d+)?)")
_LETTERS = {"i": "inclination", "a": "azimuth", "t": "toolface", "r": "toolface", "n": "inclination"}
"""What a letter in such a code is short for; n of Neigung."""


def _angle(words: str) -> str:
    """The angle of the stand that words say, or the last of them; empty of others."""
    each = words.split()
    if each and each[-1].lower() == "az":
        return "ref_azimuth_deg"
    alike = (resembled(spelled(" ".join(each[k:]))) for k in range(len(each)))
    return next((a.column for a in alike if a and a.column in _ANGLES), "")


def settings_in(text: str) -> dict[str, tuple[str, str]]:
    """The settings of the stand that a line states: by the angle, its words with a unit, and its number.

    >>> settings_in("Set 2: Neigung 30,0 deg, Az = 90°")
    {'ref_inclination_deg': ('Neigung (deg)', '30.0'), 'ref_azimuth_deg': ('Azimuth (°)', '90')}
    >>> settings_in("Inclination 10 to 30, roll 0-360, probe 17"), settings_in("Rolls at 30° inclination")
    ({}, {'ref_inclination_deg': ('inclination (°)', '30')})
    """
    settings: dict[str, tuple[str, str]] = {}
    for form in _FORMS:
        each = [(match, _angle(match["words"])) for match in form.finditer(text)]
        each = [(m, angle) for m, angle in each if angle and not _TO.match(text, m.end("number"))]
        if len({angle for _, angle in each}) < len(each):
            return {}
        for match, angle in each:
            words = " ".join(match["words"].split())
            alike = resembled(spelled(words))
            name = words if alike and alike.column == angle else _ANGLES[angle]
            unit = f" ({match['unit']})" if match["unit"] else ""
            settings.setdefault(angle, (f"{name}{unit}", _pointed(match["number"])))
    return settings


def _pointed(number: str) -> str:
    return number.replace(",", ".").replace("−", "-").lstrip("+")


def angles_among(names: Iterable[str]) -> set[str]:
    """The angles of the stand that columns of these names are."""
    return {alike.column for name in names if (alike := resembled(spelled(name)))} & _ANGLES.keys()


def columns_of_lines(
    texts: Mapping[int, str], lines: Sequence[int], names: Sequence[str]
) -> dict[str, list[str]]:
    """Columns of the settings that lines between rows state, where no column of `names` is one.

    `texts` of these lines by number, those right above the names too; `lines` of the rows. Every row is below a line
    that states each, and some of these differ.
    """
    present = angles_among(names)
    stated = {n: each for n, text in texts.items() if (each := settings_in(text))}
    columns: dict[str, list[str]] = {}
    for angle in (each for each in _ANGLES if each not in present):
        cells = {n: each[angle] for n, each in stated.items() if angle in each}
        above = [max((n for n in cells if n < line), default=-1) for line in lines]
        if -1 not in above and len({cells[n][1] for n in above}) > 1:
            columns[cells[above[0]][0]] = [cells[n][1] for n in above]
    return columns


def columns_of_codes(
    names: Sequence[str], columns: Sequence[Sequence[str]]
) -> dict[str, list[str]]:
    """Columns of the settings that the codes of stations state, where no column of `names` is an angle of the stand."""
    if angles_among(names):
        return {}
    for cells in columns:
        texts = [as_text(cell) for cell in cells]
        if not all(map(_CODE.fullmatch, texts)):
            continue
        parts = [_PART_OF_CODE.findall(text) for text in texts]
        words = [word for word, _ in parts[0]]
        angles = [_LETTERS.get(word.lower(), word) for word in words]
        meant = [_angle(each) for each in angles]
        alike = all([word for word, _ in each] == words for each in parts)
        if alike and all(meant) and len({*meant}) == len(meant):
            return {
                f"{angle.capitalize()} (°)": [each[k][1] for each in parts]
                for k, angle in enumerate(angles)
            }
    return {}
