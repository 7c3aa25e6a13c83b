"""Settings of the stand that have no column: in lines between the rows, names of sheets, codes of stations.

A technician who turns a tool at one inclination after the other writes the inclination once, in a line above its rows,
or as the name of the sheet. `columns_of_lines` gives such words columns of their own.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from mwdcal.files.formats.columns import as_text
from mwdcal.files.synonyms import resembled
from mwdcal.files.words import spelled

_ANGLES_OF_STAND = {
    "ref_inclination_deg": "Inclination",
    "ref_azimuth_deg": "Azimuth",
    "ref_toolface_deg": "Toolface",
}
_WORDS_BEFORE = r"(?P<words>[^\W\d_](?:[^\W\d_]|[ ./_-])*{more})"
_NUMBER_OF_SETTING = (
    r"(?P<number>(?<![\d.,/-])[+−-]?\d+(?:[.,]\d+)?)(?![\d.,]*\d)(?![/-]\d)\s*"
    r"(?P<unit>(?:°|º|deg\w*|grad\w*|gon|rad|град\w*|度)(?![^\W\d_]))?"
)
_STATEMENTS = (
    re.compile(
        rf"(?<![^\W\d_]){_WORDS_BEFORE.format(more='?')}\.?\s*(?:[=:：]\s*)?{_NUMBER_OF_SETTING}(?![^\W\d_]*\d*[^\W\d_])",
        re.IGNORECASE,
    ),
    re.compile(rf"{_NUMBER_OF_SETTING}\s*{_WORDS_BEFORE.format(more='')}", re.IGNORECASE),
)
"""A number with its unit behind words, and before them: Inclination 30°, 30° inclination."""
LONGEST_STATEMENT = 2000
"""Characters of a line that may state something; a longer one would take minutes."""
_TO = re.compile(r"\s*(?:to|bis|til|до|[-–…]|\.\.)\s*[\d+]", re.IGNORECASE)
"""The end of a range behind a number."""
_CODE_OF_STATION = re.compile(r"(?:[^\W\d_]{1,3}[ ._=-]?-?\d{1,3}(?:\.\d+)?[°]?[ _,;/-]?){2,4}")
"""A code of a station that states its setting: I30A090T180."""
_PART_OF_CODE = re.compile(r"([^\W\d_]{1,3})[ ._=-]?(-?\d{1,3}(?:\.\d+)?)")
_SHORT_FOR = {
    "i": "inclination",
    "a": "azimuth",
    "t": "toolface",
    "r": "toolface",
    "n": "inclination",
}
"""Angles by their letter in such a code; n of Neigung."""


def _angle(words: str, first: bool = False) -> str:
    """The angle of the stand that words say, or the last of them, or the `first`; empty of others."""
    each = words.split()
    if each and each[-1].lower() == "az":
        return "ref_azimuth_deg"
    parts = [each[: k + 1] if first else each[k:] for k in range(len(each))]
    alike = (resembled(spelled(" ".join(part))) for part in parts)
    return next((a.column for a in alike if a and a.column in _ANGLES_OF_STAND), "")


def settings_in(text: str) -> dict[str, tuple[str, str]]:
    """The settings of the stand that a line states: by the angle, its words with a unit, and its number.

    >>> settings_in("Set 2: Neigung 30,0 deg, Az = 90°")
    {'ref_inclination_deg': ('Neigung (deg)', '30.0'), 'ref_azimuth_deg': ('Azimuth (°)', '90')}
    >>> settings_in("Inclination 10 to 30, roll 0-360, probe 17"), settings_in("Rolls at 30° inclination")
    ({}, {'ref_inclination_deg': ('inclination (°)', '30')})
    """
    settings: dict[str, tuple[str, str]] = {}
    for form in _STATEMENTS if len(text) <= LONGEST_STATEMENT else ():
        behind = form is _STATEMENTS[1]
        each = [(match, _angle(match["words"], behind)) for match in form.finditer(text)]
        each = [(m, angle) for m, angle in each if angle and not _TO.match(text, m.end("number"))]
        if len({angle for _, angle in each}) < len(each):
            return {}
        for match, angle in each:
            words = " ".join(match["words"].split())
            alike = resembled(spelled(words))
            name = words if alike and alike.column == angle else _ANGLES_OF_STAND[angle]
            unit = f" ({match['unit']})" if match["unit"] else ""
            settings.setdefault(angle, (f"{name}{unit}", pointed(match["number"])))
    return settings


def pointed(number: str) -> str:
    """A number as it is typed, with a decimal point and a plain minus."""
    return number.replace(",", ".").replace("−", "-").lstrip("+")


def angles_among(names: Iterable[str]) -> set[str]:
    """The angles of the stand that columns of these names are."""
    return {
        alike.column for name in names if (alike := resembled(spelled(name)))
    } & _ANGLES_OF_STAND.keys()


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
    for angle in (each for each in _ANGLES_OF_STAND if each not in present):
        cells = {n: each[angle] for n, each in stated.items() if angle in each}
        above = [max((n for n in cells if n < line), default=-1) for line in lines]
        if -1 not in above and len({cells[n][1] for n in above}) > 1:
            columns[cells[above[0]][0]] = [cells[n][1] for n in above]
    return columns


_IN_HEADING = re.compile(
    r"(?:(?<![\w.,])|(?<=_)|(?<=[a-z@]))(?P<number>[+-]?\d{1,3})(?P<unit>\s?(?:°\s?[CF]?|℃|deg|[CF](?=\b)))?(?![\w.,])"
)
"""The setting that a heading of a group of columns states: TF 90, 180°, Gx_270, 60 °C."""
_LEAST_SPAN = 90.0
"""By how much the angles of such headings differ at least, degrees."""


class Headings(NamedTuple):
    """Groups of columns for each setting of a stand or an oven: of each channel the place of its column by setting."""

    name: str
    places: dict[str, dict[str, int]]

    @property
    def settings(self) -> list[str]:
        """The numbers of the settings, in the order of the columns."""
        return [*next(iter(self.places.values()))]


def headings_in(names: Sequence[str]) -> Headings | None:
    """The settings that the headings of equal groups of columns state; None where there are no such groups.

    Words of them say that it is an angle of the stand, or none is there and numbers are of a turn; no other column is
    the same angle.

    >>> headings_in(["Inc", *(f"TF {t} {axis}" for t in (0, 90, 180) for axis in ("Gx", "Gy", "Gz"))])
    Headings(name='TF (°)', places={'Gx': {'0': 1, '90': 4, '180': 7}, 'Gy': {'0': 2, '90': 5, '180': 8}, \
'Gz': {'0': 3, '90': 6, '180': 9}})
    >>> headings_in([f"Tool 0{n} {axis}" for n in (71, 74) for axis in ("Gx", "Gy", "Gz")])
    """
    marks = {k: m for k, name in enumerate(names) if (m := _IN_HEADING.search(name))}
    bare = {
        k: f"{names[k][: m.start()].rstrip('_@')} {names[k][m.end() :]}".split()
        for k, m in marks.items()
    }
    counts = Counter(tuple(each) for each in bare.values())
    grouped = {k: words for k, words in bare.items() if counts[tuple(words)] > 1}
    common = [
        word
        for word in next(iter(grouped.values()), [])
        if not re.search(r"[(\[]", word) and all(word in each for each in grouped.values())
    ]
    places: dict[str, dict[str, int]] = {}
    for k, words in grouped.items():
        channel = " ".join(word for word in words if word not in common)
        places.setdefault(channel, {})[marks[k]["number"].lstrip("+")] = k
    settings = [*next(iter(places.values()), ())]
    units = {"".join((marks[k]["unit"] or "").split()) for k in grouped}
    if len(settings) < 2 or any([*each] != settings for each in places.values()) or len(units) > 1:
        return None
    name = _name_of_headings(" ".join(common), units.pop(), [*map(float, settings)])
    others = [n for k, n in enumerate(names) if k not in grouped]
    if not name or angles_among([name]) & angles_among(others):
        return None
    return Headings(name, places)


def _name_of_headings(words: str, unit: str, numbers: Sequence[float]) -> str:
    """The name of the column of the settings that headings state; empty where they may be something else."""
    if unit[-1:] in ("C", "F", "℃"):
        return f"Temperature (°{'F' if unit.endswith('F') else 'C'})"
    turn = max(numbers) - min(numbers) >= _LEAST_SPAN and all(-180 <= n <= 360 for n in numbers)
    if _angle(words):
        return f"{words} (°)"
    return "Setting of the heading (°)" if turn and not words and (unit or len(numbers) > 2) else ""


def columns_of_codes(
    names: Sequence[str], columns: Sequence[Sequence[str]]
) -> dict[str, list[str]]:
    """Columns of the settings that the codes of stations state, where no column of `names` is an angle of the stand."""
    if angles_among(names):
        return {}
    for cells in columns:
        texts = [as_text(cell) for cell in cells]
        if not all(map(_CODE_OF_STATION.fullmatch, texts)):
            continue
        parts = [_PART_OF_CODE.findall(text) for text in texts]
        words = [word for word, _ in parts[0]]
        angles = [_SHORT_FOR.get(word.lower(), word) for word in words]
        meant = [_angle(each) for each in angles]
        alike = all([word for word, _ in each] == words for each in parts)
        if alike and all(meant) and len({*meant}) == len(meant):
            return {
                f"{angle.capitalize()} (°)": [each[k][1] for each in parts]
                for k, angle in enumerate(angles)
            }
    return {}
