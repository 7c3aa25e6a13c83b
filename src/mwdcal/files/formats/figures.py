"""Numbers as people and programs write them in the cells of a table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, time, timedelta

from mwdcal.errors import Answer, InputError, QuestionError
from mwdcal.files.formats.columns import as_text, looks_numeric
from mwdcal.files.synonyms import unit_of

_SPACES = re.compile(r"(?<=\d)[ '’\u00a0\u202f\u2009](?=\d{3}(\D|$))")
"""What separates thousands and is never a decimal sign."""
_WRITTEN = r"[+\-−]?(?:\d+(?:[.,]\d+)*[.,]?|[.,]\d+)(?:[eE][+\-−]?\d+)?"
_FIGURE = re.compile(rf"({_WRITTEN})\s*([°º%]?\s?[A-Za-zа-яА-Яµμ²/°º]{{0,6}})")
_BARE_FIGURE = re.compile(_WRITTEN)
_DEGREES = re.compile(
    r"([+\-−]?)(\d+)\s*[°º度]\s*(\d+(?:[.,]\d+)?)\s*['′’分]\s*(?:(\d+(?:[.,]\d+)?)\s*(?:[\"″”秒]|''))?"
)
"""Degrees, minutes and seconds."""
_PARTS_OF_DEGREES = re.compile(
    r"([+\-−]?)(\d{1,3})(?:\s*[°ºdD:\-–]\s*|\s+)([0-5]?\d(?:[.,]\d+)?)(?:(?:\s*['′’mM:\-–]\s*|\s+)([0-5]?\d(?:[.,]\d+)?)\s*"
    r"(?:[\"″”sS]|'')?|\s*['′’mM])?"
)
"""The same with other signs, or none: 30-15-36, 30:15:36, 30 15 36, 30d15m."""
_PACKED = re.compile(r"(?<![^\W\d_])[dg]{1,3}[.,]mm(ss)?(?![^\W\d_])", re.IGNORECASE)
"""The notation D.MMSS: minutes and seconds written as decimals of degrees."""
_FIRST_DAY = datetime(1899, 12, 31)
"""The day 0 of workbooks."""
_BEARING = re.compile(r"([NS])\s*(\d+(?:[.,]\d+)?)\s*°?\s*([EWO])", re.IGNORECASE)
"""A bearing by quadrants, such as N45E."""
_SIDE = re.compile(r"(\d+(?:[.,]\d+)?)\s*°?\s*([RL])", re.IGNORECASE)
"""A toolface to the right or the left of the high side, such as 45R."""
_POINTS = {
    point: f"{45 * k}" for k, point in enumerate(("N", "NE", "E", "SE", "S", "SW", "W", "NW"))
}
"""Points of the compass, and their azimuths; O is west in Spanish, and east in German."""
_POINTED_DAY = re.compile(r"\s*\d{1,2}\.\d{1,2}\.(\d{4}|\d{2})([ T].*)?")
"""A day as in Germany or Russia, which is no number."""
_GROUPED = re.compile(r"[+\-−]?[1-9]\d{0,2}([.,]\d{3})+")
_USUAL = 0.9
"""Share of numbers of one decimal sign from which on the others are mistyped."""
_POINTED = {
    ".": re.compile(r"[+\-−]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?"),
    ",": re.compile(r"[+\-−]?[1-9]\d{0,2}(\.\d{3})+(,\d*)?"),
}
"""Numbers with separators of thousands, by their decimal sign."""


def is_figure(cell: object) -> bool:
    """Whether a cell is a number, with separators or a unit behind it, or an angle in degrees and minutes.

    >>> [is_figure(cell) for cell in (1.5, "1.234,5", "23.4 mV", "45°30'", "P1", "", True)]
    [True, True, True, True, False, False, False]
    """
    if not isinstance(cell, str):
        return type(cell) is float or (isinstance(cell, int | float) and type(cell) is not bool)
    if _POINTED_DAY.fullmatch(cell):
        return False
    text = _SPACES.sub("", cell)
    return any(form.fullmatch(text) for form in (_FIGURE, _DEGREES, _BEARING))


def decimal_sign(cells: Sequence[object], source: str) -> str:
    """The decimal sign of the numbers in cells of text; the point where there are none.

    Raises:
        InputError: both signs are in use, and neither separates thousands.
        FitError: the sign in all numbers may be either.
    """
    texts = [_SPACES.sub("", cell) for cell in cells if isinstance(cell, str) and is_figure(cell)]
    figures = [match[1] for match in map(_FIGURE.fullmatch, texts) if match]
    commas = [cell for cell in figures if "," in cell]
    points = [cell for cell in figures if "." in cell]
    if not commas and not points:
        return "."
    fits = {
        sign: all(
            looks_numeric(c.replace("−", "-"), sign) or _POINTED[sign].fullmatch(c) for c in figures
        )
        for sign in ".,"
    }
    if fits["."] != fits[","]:
        return "." if fits["."] else ","
    if not fits["."]:
        usual = max(fits, key=lambda sign: _of_sign(figures, sign))
        if _of_sign(figures, usual) >= _USUAL * len(commas + points):
            return usual
        raise InputError(
            f"{source}: numbers with a comma ({(commas or figures)[0]}) and a point ({(points or figures)[0]}) are "
            "mixed. Say which one is the decimal sign by `decimal`."
        )
    if all(map(_GROUPED.fullmatch, commas + points)):
        sign, marked = ("comma", commas) if commas else ("point", points)
        written = "," if commas else "."
        raise QuestionError(
            f"{source}: the {sign} in {marked[0]} may be a decimal sign or separate thousands.",
            [
                Answer("a decimal sign", (("decimal", written),)),
                Answer("it separates thousands", (("decimal", "." if commas else ","),)),
            ],
        )
    return "," if commas else "."


def _of_sign(cells: Sequence[str], sign: str) -> int:
    """How many of some numbers with a comma or a point have that decimal sign."""
    marked = [cell.replace("−", "-") for cell in cells if "," in cell or "." in cell]
    return sum(looks_numeric(c, sign) or bool(_POINTED[sign].fullmatch(c)) for c in marked)


def as_they_stand(cells: Sequence[object]) -> list[str]:
    """The cells of a column as text, without blanks around."""
    return [cell.strip() if isinstance(cell, str) else as_text(cell) for cell in cells]


def column(cells: Sequence[object], texts: Sequence[str], sign: str) -> tuple[list[str], str]:
    """The cells as text whose numbers have a decimal point, and the unit that stands behind all of them.

    A column of which any cell is no number stays as its `texts` are, except where numbers stand in it.
    """
    if not any(isinstance(cell, str) and cell for cell in cells):
        return [*texts], ""
    filled = [_SPACES.sub("", text) for text in texts if text]
    if filled and all(map(_DEGREES.fullmatch, filled)):
        return [_degrees(text, sign) for text in texts], "°"
    if filled and all(map(_BEARING.fullmatch, filled)):
        return [_azimuth(text, sign) for text in texts], "°"
    sides = [m for text in filled if (m := _SIDE.fullmatch(text))]
    if len(sides) == len(filled) and {m[2].upper() for m in sides} == {"R", "L"}:
        return [_toolface(text, sign) for text in texts], "°"
    if {*filled} <= {*_POINTS} and len({*filled}) > 2:
        return [_POINTS.get(text, text) for text in texts], "°"
    units = {match[2].strip() for match in map(_FIGURE.fullmatch, filled) if match}
    alike = len(units) == 1 and all(map(_FIGURE.fullmatch, filled))
    unit = units.pop() if alike else ""
    return [
        _pointed(text, sign, unit) if isinstance(cell, str) else text
        for cell, text in zip(cells, texts, strict=True)
    ], unit


def sexagesimal(cells: Sequence[object], said: str) -> list[object]:
    """The cells of a column of angles in degrees, where they are degrees, minutes and seconds; else as they are.

    A workbook keeps 30:15:36 as a time. `said`: what the table says of these angles, which may be D.MMSS.

    >>> sexagesimal(["30-15-36", ""], ""), sexagesimal([30.1536], "Inc (D.MMSS)"), sexagesimal([30.15], "Inc")
    ([30.26, ''], [30.26], [30.15])
    """
    packed = _PACKED.search(said)
    values = [
        cell
        if cell == ""
        else _unpacked(as_text(cell), 4 if packed[1] else 2)
        if packed
        else _of_parts(cell)
        for cell in cells
    ]
    return [*cells] if None in values or all(value == "" for value in values) else [*values]


def _of_parts(cell: object) -> float | None:
    """Degrees, minutes and seconds, or the time that a workbook keeps of them, in degrees; None of other cells."""
    if isinstance(cell, datetime):
        cell = cell - _FIRST_DAY
    if isinstance(cell, time):
        cell = timedelta(hours=cell.hour, minutes=cell.minute, seconds=cell.second)
    if isinstance(cell, timedelta):
        return cell.total_seconds() / 3600
    match = _PARTS_OF_DEGREES.fullmatch(cell.strip()) if isinstance(cell, str) else None
    return _in_degrees(match, ",") if match else None


def _unpacked(text: str, digits: int) -> float | None:
    """Degrees of D.MMSS, or of D.MM; None where minutes or seconds are 60 or more."""
    whole, _, decimals = text.replace(",", ".").partition(".")
    packed = decimals.ljust(digits, "0")
    parts = f"{whole} {packed[:2]} {packed[2:digits] or 0}.{packed[digits:] or 0}"
    match = _PARTS_OF_DEGREES.fullmatch(parts)
    return _in_degrees(match, ".") if match else None


_OF_AXES = re.compile(r"(.*?)[\s_(\[]*x\W*y\W*z[)\]]*(?![^\W\d_])(.*)", re.IGNORECASE)
"""A name of all three axes: G xyz (g), B (x, y, z)."""
_UNIT_LAST = re.compile(r"(.*?)\s*([(\[][^()\[\]]*[)\]])?\s*")
_SEPARATORS = ("/", ";", "|", ", ", " ")
_PARTED_BY_BLANKS = re.compile(r"[+\-−]?[1-9]\d{0,2}(?:\s\d{3})+(?:[.,]\d+)?")
"""One number whose thousands blanks separate: -32 011."""


def apart(name: str, cells: Sequence[object]) -> tuple[list[str], list[list[str]]]:
    """Names and cells of a column of which each cell has two or three numbers, and its name as many parts.

    Any other column has one name, and no cells here.

    >>> apart("Inc/Azi (deg)", ["30/90", "45/180"]), apart("G xyz", ["(0.1, 0.2, 0.9)"])[0], apart("Day", ["1/2"])
    ((['Inc (deg)', 'Azi (deg)'], [['30', '45'], ['90', '180']]), ['G x', 'G y', 'G z'], (['Day'], []))
    >>> apart("Stand (inc/azi), °", ["30/90"])
    (['inc °', 'azi °'], [['30'], ['90']])
    """
    if not any(_names_apart(name, count) for count in (2, 3)):
        return [name], []
    texts = [
        re.sub(r"[\[\](){}°º]", "", cell).strip() if isinstance(cell, str) else "" for cell in cells
    ]
    thousands = all(_PARTED_BY_BLANKS.fullmatch(text) for text in texts)
    for separator in (_SEPARATORS[:-1] if thousands else _SEPARATORS) if all(texts) else ():
        parts = [[part.strip() for part in text.split(separator)] for text in texts]
        parts = [[*filter(None, each)] for each in parts] if separator == " " else parts
        names = _names_apart(name, len(parts[0])) if 1 < len(parts[0]) < 4 else []
        whole = all(
            len(each) == len(names) and all(map(_BARE_FIGURE.fullmatch, each)) for each in parts
        )
        if names and whole:
            return names, [list(column) for column in zip(*parts, strict=True)]
    return [name], []


def _names_apart(name: str, count: int) -> list[str]:
    """The names of so many columns that one name says; none where it does not."""
    if count == 3 and (axes := _OF_AXES.fullmatch(name)):
        return [f"{axes[1]} {axis}{axes[2]}".strip() for axis in "xyz"]
    head, unit = _UNIT_LAST.fullmatch(name).groups("")  # type: ignore[union-attr]
    if inner := re.fullmatch(
        r"[^()\[\]]*[(\[]([^()\[\]]*[/;|][^()\[\]]*)[)\]],?\s*(\S{0,4})", name
    ):
        head, unit = inner.groups()
    each = [part.strip() for part in re.split(r"[/;|,]", head)]
    named = len(each) == count and all(each) and not any(map(unit_of, each))
    return [f"{part} {unit}".strip() for part in each] if named else []


def signs_of(columns: Sequence[Sequence[object]], sign: str) -> list[str]:
    """The decimal sign of each column: the other one where it cannot separate thousands in each of its numbers.

    Where a column has the other one, so have all columns with that sign alone.

    >>> signs_of([["19,9"], ["-2.248", "0.254"], ["52.003"]], ","), signs_of([["19,9"], ["52.003"]], ",")
    ([',', '.', '.'], [',', ','])
    """
    other = "." if sign == "," else ","
    signs, sure = [], False
    for cells in columns:
        texts = [_SPACES.sub("", cell) for cell in cells if isinstance(cell, str) and cell]
        plain = [m[1].replace("−", "-") for m in map(_FIGURE.fullmatch, texts) if m]
        marked = [each for each in plain if other in each]
        alone = bool(marked) and all(looks_numeric(each, other) for each in plain)
        sure |= alone and not all(map(_POINTED[sign].fullmatch, marked))
        signs.append(other if alone else sign)
    return signs if sure else [sign] * len(signs)


def _pointed(text: str, sign: str, unit: str) -> str:
    """A cell with the decimal point, without separators and its unit, if it is a number; else as it is."""
    bare = _SPACES.sub("", text).replace("−", "-")
    if unit:
        bare = bare.removesuffix(unit).strip()
    if not _BARE_FIGURE.fullmatch(bare) or (looks_numeric(bare) and sign == "."):
        return bare if _BARE_FIGURE.fullmatch(bare) else text
    if _POINTED[sign].fullmatch(bare) and not looks_numeric(bare, sign):
        bare = bare.replace("." if sign == "," else ",", "")
    return bare.replace(",", ".") if looks_numeric(bare, sign) else text


def _azimuth(text: str, sign: str) -> str:
    """A bearing by quadrants as an azimuth; blank stays blank."""
    match = _BEARING.fullmatch(text)
    if not match:
        return text
    pole, angle, side = match.groups()
    east = float(angle.replace(sign, ".")) * (1 if side.upper() == "E" else -1)
    return repr((east if pole.upper() == "N" else 180 - east) % 360)


def _toolface(text: str, sign: str) -> str:
    """A toolface to the right or the left as one that counts clockwise; blank stays blank."""
    match = _SIDE.fullmatch(_SPACES.sub("", text))
    if not match:
        return text
    angle = float(match[1].replace(sign, "."))
    return repr((angle if match[2].upper() == "R" else -angle) % 360)


def _degrees(text: str, sign: str) -> str:
    """Degrees, minutes and seconds in degrees; blank stays blank."""
    match = _DEGREES.fullmatch(text)
    return repr(_in_degrees(match, sign)) if match else text


def _in_degrees(match: re.Match[str], sign: str) -> float:
    """Sign, degrees, minutes and seconds as a number."""
    minus, *parts = match.groups()
    degrees, minutes, seconds = (float((part or "0").replace(sign, ".")) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    return -value if minus in ("-", "−") else value
