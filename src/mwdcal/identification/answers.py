"""Answers to what a table leaves open: columns, units and triads that may be meant, what is believed first."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from functools import cache

import numpy as np

from mwdcal.errors import Answer
from mwdcal.files.contract import RAW, REFERENCES
from mwdcal.files.synonyms import synonyms_of, unit_of
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.identification.words import spelled, translated

BOTH_UNITS = " and "
"""What stands between two units of one column, of which one is wrong."""
IN_BRACKETS = re.compile(r"[(\[]([^)\]]*)[)\]]\s*$")
RANGES_BY_UNIT: dict[str, tuple[tuple[str, float, float], ...]] = {
    "ref_gravity_g": (
        ("g", 0.9, 1.1), ("m/s²", 9.0, 10.5), ("mg", 990.0, 1010.0), ("mGal", 970_000.0, 990_000.0),
    ),
    "ref_field_nt": (
        ("nT", 15_000.0, 80_000.0), ("µT", 15.0, 80.0), ("gauss", 0.15, 0.8), ("mT", 0.015, 0.08),
    ),
}  # fmt: skip
"""Units of quantities of which the Earth has but one range of values; 980 may be milli-g or gal."""
LEAST_ROLLS = 5
"""Toolfaces from which on their unit is told by their range."""
_FILLER = re.compile(r"-?9{3,}(\.9+|\.25)?")
_REGULAR = 0.8
"""Share of equal steps of numbered rows."""
_FEW = 4
"""Values of a column that a question shows."""
_STEADY_DIP, _STEADY_FIELD = 3.0, 0.1
"""A dip varies by less at one place, degrees, and a field by a smaller share."""
STEADY_NORM = 0.15
"""By how much the norm of a triad varies at most, as a share of the range of its channels."""
_LEAST_TURN = 20.0
"""By how much an angle of the stand varies at least, degrees."""
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
    return np.asarray([_FILLER.fullmatch(f"{value:.12g}") is not None for value in values], bool)


def is_numbering(values: Array) -> bool:
    """Whether numbers go on in equal steps but for a few, as those of rows and times do.

    >>> is_numbering(np.array([1.0, 2, 3, 3, 4, 5, 6])), is_numbering(np.array([0.0, 90, 180, 270, 0, 90]))
    (True, False)
    """
    steps = np.diff(values)
    usual = float(np.median(steps)) if steps.size else 0.0
    return usual != 0.0 and float(np.isclose(steps, usual).mean()) > _REGULAR


def first_values(values: Array) -> str:
    """The first few of some values."""
    return ", ".join(f"{value:.6g}" for value in values[:_FEW].tolist())


def candidates_for(column: str, names: Sequence[str], values: Values) -> list[Answer]:
    """Each of the names as the answer to which one a column is, and that none is."""
    each = [Answer(with_values(n, values, n), (("column", f"{column}={n}"),)) for n in names]
    return [*each, none_of(column)]


def channels_for(column: str, names: Sequence[str], values: Values) -> list[Answer]:
    """Columns of numbers that may be a channel."""
    numbers = [n for n in names if values(n) is not None]
    return [Answer(with_values(n, values, n), (("column", f"{column}={n}"),)) for n in numbers]


def triples_for(
    channels: Sequence[str], names: Sequence[str], values: Values, most: float = np.inf
) -> list[Answer]:
    """Neighbouring columns that may be a triad, first those of which the norm varies least.

    A sound triad has the same norm at every attitude, but for its biases and scales, while each channel varies.
    `most`: by how much it may vary, as a share of the channels' range.
    """
    numbers = {n: v for n in names if (v := values(n)) is not None and np.isfinite(v).all()}
    triples = []
    for place in range(len(numbers) - 2):
        three = [*numbers][place : place + 3]
        columns = np.stack([numbers[n] for n in three], -1)
        spread = np.ptp(columns, axis=0)
        if spread.min() > 0:
            triples.append((_variation(columns) / float(spread.max()), three))
    return [
        Answer(
            with_values(", ".join(three), values, *three),
            tuple(("column", f"{c}={n}") for c, n in zip(channels, three, strict=True)),
        )
        for variation, three in sorted(triples, key=lambda each: each[0])[:_MOST_TRIPLES]
        if variation <= most
    ]


def _variation(columns: Array) -> float:
    """The standard deviation of the distance (n,) of vectors (n, 3) from the centre of the sphere nearest to them."""
    centred = columns - columns.mean(0)
    design = np.column_stack([2 * centred, np.ones(len(centred))])
    squares = np.sum(centred**2, -1)
    middle, *_ = np.linalg.lstsq(design, squares, rcond=1e-9)
    return float(np.std(np.linalg.norm(centred - middle[:3], axis=-1)))


def in_units(name: str, column: str, allowed: Sequence[str]) -> list[Answer]:
    """Each of the units as the answer to the one that a column is in."""
    return [Answer(unit, (("column", f"{column}={name} ({unit})"),)) for unit in allowed]


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
    return any(_is_mistyped(word, each) for word in words for each in _words_of(column))


@cache
def _words_of(column: str) -> frozenset[str]:
    """Words of three letters or more that say of a column that it is one of a run file's."""
    return frozenset(synonyms_of(column)) | translated(column)


def _is_mistyped(word: str, meant: str) -> bool:
    """Whether a word is another one with one letter too many, too few or wrong, or two exchanged."""
    if word == meant or abs(len(word) - len(meant)) > 1:
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
    plain = spelled(name)
    bracketed = IN_BRACKETS.search(plain)
    stated = unit_of(spelled(unit)) or unit_of(
        bracketed[1] if bracketed else plain.rpartition(" ")[2]
    )
    foreign = bool(unit or bracketed) and not stated
    low, high = float(known.min()), float(known.max())
    if column == REFERENCES["dip"].column:
        steep = min(abs(low), abs(high)) > 5 and max(abs(low), abs(high)) < 90
        return stated == "°" and high - low < _STEADY_DIP and steep
    if column == REFERENCES["field"].column:
        ranges = {unit: (least, most) for unit, least, most in RANGES_BY_UNIT[column]}
        least, most = ranges.get("nT" if not stated and not foreign else stated, (np.inf, -np.inf))
        return least <= low and high <= most and high - low < _STEADY_FIELD * high
    if foreign or stated not in ("", "°", "rad", "gon") or high - low < _LEAST_TURN:
        return False
    inside = 0 <= low <= high <= 180 if "inclination" in column else -360 <= low <= high <= 360
    return inside and not is_numbering(known)
