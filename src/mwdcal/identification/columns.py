"""Which column of a table is which of the run file, and in which unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mwdcal.errors import FitError
from mwdcal.files.contract import CHANNELS, MAPPED, RAW, REFERENCES, forms, units_of
from mwdcal.files.formats.columns import shown
from mwdcal.files.synonyms import WARMTH, Resemblance, begins_as, resembled, unit_of
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import ColumnSource

_TRANSLATIONS = (
    ("grav(?=axial|tran)", "acc "),
    ("axial", "Z "),
    ("tran(s|sverse|sversal)?[ _]*1", "X "),
    ("tran(s|sverse|sversal)?[ _]*2", "Y "),
    ("neigung|inklination|inclinaison|inclinacion", "inclination"),
    ("azimut(?!h)|acimut", "azimuth"),
    ("rollwinkel|roll angle|werkzeugwinkel", "toolface"),
    ("beschleunigung", "acc"),
    ("magnetfeld(?=[ _]*[xyz])", "mag"),
    ("feldstarke|gesamtfeld|champ total", "total field"),
    ("schwere|gravitation", "gravity"),
    ("temperature?n?", "temperature"),
    ("sollwert|soll|referenz|stand", "ref"),
    ("seriennummer|seriennr", "serial"),
    ("gerat|sonde", "tool"),
    (r"magn\b\.?|magnetisch", "magnetic"),
)
"""Words of other languages and of WITSML, and the word of the field for each."""
_LABELS = {
    "station": "station stn stationnr stationno stationnumber position pos posnr messpunkt punkt point shot nr no",
    "group": "group gruppe set rollset",
}
"""Names of columns of labels; a column is one only where no other is."""
_CALLED_REFERENCE = re.compile(r"\b(ref|reference|nominal|target|set)\b", re.IGNORECASE)
_MEASURED = re.compile(
    r"\b(measured|meas|calc|calculated|computed|corr|corrected|gemessen|berechnet|ist|mwd|survey)\b",
    re.IGNORECASE,
)
"""Words of angles that the tool itself has measured: no references."""
_OTHER_NORTH = re.compile(r"true|grid|geogra|wahr|gitter|rechtweisend", re.IGNORECASE)
_OF_NORTH = re.compile(r"north|nord|azi|azm|heading", re.IGNORECASE)
"""Words of the north that azimuths count from."""
_IN_BRACKETS = re.compile(r"[(\[]([^)\]]*)[)\]]\s*$")
_BY_VALUE: dict[str, tuple[tuple[str, float, float], ...]] = {
    "ref_gravity_g": (("g", 0.9, 1.1), ("m/s²", 9.0, 10.5), ("mg", 990.0, 1010.0)),
    "ref_field_nt": (
        ("nT", 15_000.0, 80_000.0), ("µT", 15.0, 80.0), ("gauss", 0.15, 0.8), ("mT", 0.015, 0.08),
    ),
}  # fmt: skip
"""Units of quantities of which the Earth has but one range of values; 980 may be milli-g or gal."""
COOLEST_FAHRENHEIT = 45.0
"""Numbers below it are degrees Celsius: no tool is calibrated below 7 °C alone."""
HOTTEST_CELSIUS = 200.0
"""Numbers above it may be degrees Fahrenheit: hardly a tool works above 200 °C."""

Values = Callable[[str], Array | None]
"""The numbers of a column by its name; None where it holds no numbers."""


def spelled(name: str) -> str:
    """A name in plain letters, with the words of the field.

    >>> spelled("Neigung Soll (°)"), spelled("gravTran1Raw")
    ('inclination ref (°)', 'acc X Raw')
    """
    text = name.replace("°", "\0").replace("²", "\1")
    text = unicodedata.normalize("NFKD", text)
    text = "".join(c for c in text if not unicodedata.combining(c))
    for pattern, word in _TRANSLATIONS:
        text = re.sub(pattern, word, text, flags=re.IGNORECASE)
    return text.replace("\0", "°").replace("\1", "²").strip()


def meaning(name: str, unit: str = "") -> Resemblance | None:
    """What a column holds by its name, and its unit, stated beside the name or in it."""
    if name in MAPPED:
        return Resemblance(name, unit_of(unit) or "".join(units_of(name)[:1]))
    plain = spelled(f"{name} ({unit})" if unit else name)
    alike = resembled(plain)
    if _MEASURED.search(plain) and not (alike and alike.column == WARMTH):
        return None
    near = {form: column for column in MAPPED for form in forms(column)}
    spelt = next((near[form] for form in forms(plain) if form in near), None)
    stated = _IN_BRACKETS.search(plain)
    return alike or (Resemblance(spelt, unit_of(stated[1]) if stated else "") if spelt else None)


def proposed(
    names: Sequence[str],
    units: Sequence[str],
    values: Values,
    source: str,
    above: Sequence[str] = (),
    north_is_stated: bool = False,
) -> tuple[dict[str, ColumnSource], set[str]]:
    """The columns of a table by the name that they have in a run file, and those with a unit by their values.

    `above`: lines above the names. `north_is_stated`: the table's metadata say what azimuths count from.

    Raises:
        FitError: two columns of which each may be one of the run file's, a unit that neither name nor
            values tell, azimuths from true or grid north, or no accelerometer.
    """
    meanings = {
        name: m for name, unit in zip(names, units, strict=True) if (m := meaning(name, unit))
    }
    chosen: dict[str, ColumnSource] = {}
    for column in dict.fromkeys(m.column for m in meanings.values()):
        candidates = [name for name, m in meanings.items() if m.column == column]
        candidates = [n for n in candidates if column == "serial" or values(n) is not None]
        if candidates:
            name = _one(column, candidates, source)
            chosen[column] = ColumnSource(
                name=name, unit=_unit(column, name, meanings[name].unit, values(name), source)
            )
    azimuth = chosen.get(REFERENCES["azimuth"].column)
    if azimuth and not north_is_stated:
        _check_north(azimuth.name, above, source)
    for triad, channels in CHANNELS.items():
        if not {*channels} & {*chosen}:
            _check_hidden(triad, channels, [n for n in names if n not in meanings], source)
    absent = [name for name in RAW[:3] if name not in chosen]
    if absent:
        raise FitError(
            f"{source}: no column says by its name that it is {', '.join(absent)}; the names are "
            f"{', '.join(map(shown, names[:20]))}. Name the accelerometers such as Gx, Gy, Gz or ax, ay, az."
        )
    if 0 < sum(name in chosen for name in RAW[3:]) < 3:
        raise FitError(
            f"{source}: of the magnetometers only {', '.join(n for n in RAW[3:] if n in chosen)} can be told by "
            "name. Name all three such as Bx, By, Bz or mx, my, mz."
        )
    _check_units_of_triads(chosen, source)
    by_value = {c for c, each in chosen.items() if each.unit and not meanings[each.name].unit}
    return _labels(names, chosen) | chosen, by_value


def _check_hidden(triad: str, channels: Sequence[str], others: Sequence[str], source: str) -> None:
    """Refuse a table without a triad of which columns that are not understood begin as its channels do."""
    hidden = [name for name in others if begins_as(name) in channels]
    if hidden:
        raise FitError(
            f"{source}: {', '.join(map(shown, hidden[:6]))} begin as channels of the {triad} do, and end in what is "
            "no known unit. If they are the channels, put the unit in brackets, as in 'Bx (counts)'; if they are "
            "something else, give them names that say so."
        )


def _check_units_of_triads(chosen: Mapping[str, ColumnSource], source: str) -> None:
    """Refuse channels of a triad, or their standard uncertainties, of which two state different units."""
    for names in CHANNELS.values():
        columns = [*names, *(f"sd_{name}" for name in names)]
        stated = [chosen[c] for c in columns if c in chosen and chosen[c].unit]
        other = next((each for each in stated if each.unit != stated[0].unit), None)
        if other:
            raise FitError(
                f"{source}: {shown(stated[0].name)} is in {stated[0].unit}, {shown(other.name)} in {other.unit}. "
                "Give the channels of a triad in one unit: their scale is one."
            )


def _check_north(name: str, above: Sequence[str], source: str) -> None:
    """Refuse azimuths that by their name, or by a line above the table, count from true or grid north."""
    line = next(
        (each for each in above if _OTHER_NORTH.search(each) and _OF_NORTH.search(each)), ""
    )
    if not line and not _OTHER_NORTH.search(name):
        return
    said = f"by the line {shown(line)}" if line else "by its name"
    raise FitError(
        f"{source}: {shown(name)} counts from true or grid north {said}. Put the lines "
        '# azimuth_reference = "true" and # declination_deg = … above the table (east is positive), or '
        '# azimuth_reference = "magnetic" where it is magnetic.'
    )


def _one(column: str, candidates: Sequence[str], source: str) -> str:
    """The only candidate for a column: of its very name, or the only one that is called a reference."""
    if column in candidates:
        return column
    if column == WARMTH and len(candidates) > 1:
        raise FitError(
            f"{source}: {' and '.join(map(shown, candidates))} may each be the temperature of the tool. Rename the "
            f"one nearest to the sensors to '{column}', or remove the others."
        )
    stated = [name for name in candidates if _CALLED_REFERENCE.search(spelled(name))]
    if len(candidates) == 1 or len(stated) == 1:
        return (stated or candidates)[0]
    raise FitError(
        f"{source}: {' and '.join(map(shown, candidates))} may each be '{column}'. Call the one that the stand "
        "shows a reference, such as 'Ref " + candidates[0] + "', or remove the other."
    )


def _unit(column: str, name: str, stated: str, values: Array | None, source: str) -> str:
    """The unit of a column: as stated, or the only one that its values can be in."""
    allowed = units_of(column)
    if not allowed or values is None:
        return stated
    if stated:
        if stated in allowed:
            return stated
        raise FitError(
            f"{source}: {shown(name)} is '{column}' by its name, and in {stated}, which is not one of "
            f"{', '.join(allowed)}. Correct its name or its unit."
        )
    known = values[np.isfinite(values)]
    if column in _BY_VALUE and known.size:
        for unit, low, high in _BY_VALUE[column]:
            if low <= known.min() and known.max() <= high:
                return unit
        raise _open(name, column, allowed, source)
    both = {"°": _maybe_radians, "°C": _maybe_fahrenheit}.get(allowed[0])
    if both and known.size and both(known):
        raise _open(name, column, allowed, source)
    return allowed[0]


def _maybe_radians(angles: Array) -> bool:
    return bool(np.abs(angles).max() <= 2 * np.pi and np.any(angles != np.round(angles)))


def _maybe_fahrenheit(temperatures: Array) -> bool:
    return bool(temperatures.min() >= COOLEST_FAHRENHEIT or temperatures.max() > HOTTEST_CELSIUS)


def _open(name: str, column: str, allowed: Sequence[str], source: str) -> FitError:
    return FitError(
        f"{source}: {shown(name)} is '{column}', and neither its name nor its values say whether it is in "
        f"{' or '.join(allowed)}. Write the unit behind the name, such as '{name} ({allowed[0]})'."
    )


def _labels(names: Sequence[str], chosen: Mapping[str, ColumnSource]) -> dict[str, ColumnSource]:
    """Columns of labels, of those that are nothing else."""
    taken = {source.name for source in chosen.values()}
    labels = {}
    for column, words in _LABELS.items():
        forms = {name: re.sub(r"[^a-z]", "", name.lower()) for name in names if name not in taken}
        matching = [name for name, form in forms.items() if form in words.split()]
        if len(matching) == 1 and column not in chosen:
            labels[column] = ColumnSource(name=matching[0])
    return labels
