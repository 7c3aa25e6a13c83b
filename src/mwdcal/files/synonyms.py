"""Columns that are not of the contract, and which column of the contract each resembles.

A name is taken apart into words and a unit: `Azi (deg)`, `ref_azm`, `AZIMUTH_TRUE` all resemble
`ref_azimuth_deg`. A column that resembles a reference or the temperature would be ignored silently, and is
refused where the contract's own column is absent. A column is never used under the name it resembles.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Collection, Sequence
from typing import NamedTuple

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import shown
from mwdcal.geometry.observables import EXTRAPOLATED, RESULTS

UNITS = {
    "deg": "°",
    "degree": "°",
    "degrees": "°",
    "rad": "rad",
    "radian": "rad",
    "radians": "rad",
    "c": "°C",
    "celsius": "°C",
    "f": "°F",
    "fahrenheit": "°F",
    "k": "K",
    "kelvin": "K",
    "g": "g",
    "millig": "mg",
    "mss": "m/s²",
    "nt": "nT",
    "gamma": "nT",
    "ut": "µT",
    "millit": "mT",
    "gauss": "gauss",
    "v": "V",
    "mv": "mV",
    "lsb": "counts",
    "counts": "counts",
    "raw": "raw",
}
"""Units by the words of names, as `_words` leaves them."""
CONVERSIONS = {
    "°F": "°C = (°F - 32) · 5/9",
    "K": "°C = K - 273.15",
    "rad": "° = rad · 180/π",
    "mg": "g = mg / 1000",
    "m/s²": "g = m/s² / 9.80665",
    "µT": "nT = µT · 1000",
    "mT": "nT = mT · 1e6",
    "gauss": "nT = gauss · 1e5",
}
"""How another unit is converted into that of the contract."""
FACTORS = {
    "°F": (5 / 9, -160 / 9),
    "K": (1.0, -273.15),
    "rad": (180 / math.pi, 0.0),
    "mg": (1e-3, 0.0),
    "m/s²": (1 / 9.80665, 0.0),
    "µT": (1e3, 0.0),
    "mT": (1e6, 0.0),
    "gauss": (1e5, 0.0),
}
"""The same in numbers: factor, and what is added to the product."""
_WARM = ("°C", "°F", "K")
_MAGNETIC_UNITS = ("nT", "µT", "mT", "gauss")
_STATED = {"ref", "reference", "local"}
"""Words of columns that are known, not measured."""
_BYWORDS = _STATED | {
    *("true", "grid", "mag", "magnetic", "stand", "nominal", "target", "given", "set", "angle"),
    *("value", "tool", "mwd", "survey", "measured", "meas", "calc", "calculated", "computed"),
    *("corr", "corrected", "avg", "mean", "median", "sensor", "board", "internal", "electronics"),
    *("probe", "chip"),
}
"""Words that do not change what a column resembles."""
_SPREADS = {"sd", "sigma", "std", "stdev", "unc", "uncertainty"}
_INSTEAD = {
    "ref_inclination_deg": "inc incl incli inclin inclination",
    "ref_azimuth_deg": "azi azm azim azimut azimuth hdg heading bearing",
    "ref_toolface_deg": "tf gtf hs hstf tface toolface highside highsidetoolface gravitytoolface",
    "ref_gravity_g": "gravity gtotal gtot totalg totalgravity gravitytotal gravityfield tgf gt",
    "ref_field_nt": "btotal btot totalb htotal htot totalh bt tmf tfield bfield hfield totalfield "
    "fieldtotal fieldstrength magtotal totalmag",
    "ref_dip_deg": "dip magdip mdip",
    "temperature_c": "temp temperature temperatur tmp tempc tempf temperaturec temperaturef degc degf",
    "serial": "serial sn serialno serialnumber serialnr tool toolid toolserial toolsn",
    "group": "rollset",
    **{f"a{i}": f"acc{i} accel{i} acceleration{i} accelerometer{i} g{i}" for i in "xyz"},
    **{f"m{i}": f"mag{i} magnetometer{i} b{i} h{i} flux{i}" for i in "xyz"},
}
_SYNONYMS = {word: column for column, words in _INSTEAD.items() for word in words.split()}
_NEVER = {"mtf", "magnetictoolface", "magtoolface"}
"""A magnetic toolface is not a reference of the contract."""
NOTICED = {
    "ref_inclination_deg": "°",
    "ref_azimuth_deg": "° from magnetic north, or from what the metadata azimuth_reference says",
    "ref_toolface_deg": "°",
    "ref_gravity_g": "g",
    "ref_field_nt": "nT",
    "ref_dip_deg": "°",
    "temperature_c": "°C",
}
"""Columns that must not be overlooked, with their units."""
OURS = ("time_s", "start_s", "end_s", "samples", "drifting", "serial")
"""Columns beyond the contract that mwdcal itself reads or writes in run files."""
_CASED = {"nT": " nt ", "uT": " ut ", "mT": " millit ", "mG": " milligauss ", "mg": " millig "}


class Resemblance(NamedTuple):
    """The contract's column that a name resembles, and the unit that the name states, if any."""

    column: str
    unit: str = ""


def resembled(name: str) -> Resemblance | None:
    """What a name resembles.

    >>> [resembled(n) for n in ("Azi (°)", "Temp (°F)", "comment")]
    [Resemblance(column='ref_azimuth_deg', unit='°'), Resemblance(column='temperature_c', unit='°F'), None]
    """
    spelled = _words(name)
    words, unit = _without_unit([word for word in spelled if not word.isdigit()])
    spread = any(word in _SPREADS for word in words)
    words = [word for word in words if word not in _SPREADS]
    whole = "".join(words)
    bare = "".join(word for word in words if word not in _BYWORDS)
    column = _column(whole, bare, set(words), unit)
    if column is None:
        return None
    if not spread:
        implied = "°F" if "f" in (whole[-1:], bare[-1:]) and column == "temperature_c" else ""
        return Resemblance(column, unit or implied)
    return Resemblance(f"sd_{column}", unit) if column.startswith(("ref_", "a", "m")) else None


def _column(whole: str, bare: str, words: set[str], unit: str) -> str | None:
    """The contract's column of a name's words, all of them joined and without bywords."""
    stated = bool(words & _STATED)
    if {whole, bare} & _NEVER:
        return None
    if bare == "field" and (stated or unit in _MAGNETIC_UNITS or words & {"mag", "magnetic"}):
        return "ref_field_nt"
    if bare == "az" and (stated or unit in ("°", "rad")):
        return "ref_azimuth_deg"
    if bare in ("t", "deg", "") and unit in _WARM:
        return "temperature_c"
    if stated and bare in ("g", "b", "h"):
        return "ref_gravity_g" if bare == "g" else "ref_field_nt"
    for stem in (whole, bare, *(s.removeprefix("ref").removesuffix("deg") for s in (whole, bare))):
        if stem in _SYNONYMS:
            return _SYNONYMS[stem]
    return None


def _words(name: str) -> list[str]:
    """The words of a name in lower case, its units spelled without signs."""
    text = unicodedata.normalize("NFKC", name.replace("º", "°"))
    text = re.sub(r"m\s*/\s*s\s*(\^\s*)?2|ms-2", " mss ", text)
    for sign, word in (("°", " deg "), ("μ", "u"), ("µ", "u")):
        text = text.replace(sign, word)
    for cased, word in _CASED.items():
        text = re.sub(rf"(?<![A-Za-z]){cased}(?![A-Za-z])", word, text)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)
    return [word.lower() for word in words]


def unit_of(text: str) -> str:
    """The unit that a text is, empty if it is none.

    >>> [unit_of(text) for text in ("deg", "°F", "m/s²", "mg", "x")]
    ['°', '°F', 'm/s²', 'mg', '']
    """
    words = _words(text)
    return UNITS[words[-1]] if words and set(words) <= {*UNITS} else ""


def _without_unit(words: list[str]) -> tuple[list[str], str]:
    """The words before a unit, and the unit; a single word is not a unit."""
    left, unit = list(words), ""
    while len(left) > 1 and left[-1] in UNITS and not set(left[:-1]) <= _STATED | {"total"}:
        unit = unit or UNITS[left[-1]]
        left.pop()
    return left, unit


def unused(names: Sequence[str], used: Collection[str]) -> tuple[str, ...]:
    """Columns that are not used, each with what it resembles; those that resemble something first."""
    results = _results(names)
    entries = []
    for name in names:
        if name in used or name in OURS or name.startswith("drift_"):
            continue
        resemblance = resembled(name)
        entry = shown(name)
        if name in results:
            entry += " (a result of mwdcal apply)"
        elif resemblance is not None:
            entry += f" (resembles '{resemblance.column}')"
        entries.append((resemblance is None, entry))
    return tuple(entry for _, entry in sorted(entries, key=lambda each: each[0]))


def _results(names: Collection[str]) -> set[str]:
    """The columns that are results of `mwdcal apply`: where all of them are there."""
    return {*RESULTS, EXTRAPOLATED} if set(RESULTS) <= set(names) else set()


def check_evidence(names: Sequence[str], source: str) -> None:
    """Refuse a column that resembles a reference or the temperature, where that itself is absent."""
    results = _results(names)
    _refuse([n for n in names if n not in results], [n for n in NOTICED if n not in names], source)


def check_temperature(names: Sequence[str], source: str) -> None:
    """Refuse a column that resembles the temperature, where that itself is absent."""
    _refuse(names, [n for n in ("temperature_c",) if n not in names], source)


def _refuse(names: Sequence[str], absent: Collection[str], source: str) -> None:
    resembling = {name: resembled(name) for name in names}
    meant = [(name, each) for name, each in resembling.items() if each and each.column in absent]
    if not meant:
        return
    name, resemblance = meant[0]
    others = [f"{shown(n)} ({other.column}, {NOTICED[other.column]})" for n, other in meant[1:6]]
    likewise = f" Likewise {', '.join(others)}." if others else ""
    raise InputError(
        f"{source}: the column {shown(name)} resembles '{resemblance.column}', which is absent, and would not "
        f"be used. {remedy(resemblance)}; if it is something else, give it a name that says so, or remove it."
        f"{likewise}"
    )


def remedy(resemblance: Resemblance) -> str:
    """What to do with a column that is one of the contract under another name or in another unit.

    >>> remedy(Resemblance("temperature_c", "°F"))
    "Convert it (°C = (°F - 32) · 5/9) and name it 'temperature_c' (°C)"
    """
    unit = f" ({NOTICED[resemblance.column]})" if resemblance.column in NOTICED else ""
    if resemblance.unit in CONVERSIONS:
        return (
            f"Convert it ({CONVERSIONS[resemblance.unit]}) and name it '{resemblance.column}'{unit}"
        )
    return f"Rename it to '{resemblance.column}'{unit}"
