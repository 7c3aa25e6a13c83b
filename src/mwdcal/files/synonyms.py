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
from itertools import pairwise
from typing import NamedTuple

from mwdcal.errors import InputError
from mwdcal.files.depths import MEASURED_DEPTHS
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.titles import UNITS_BY_SIGN
from mwdcal.geometry.observables import EXTRAPOLATED, RESULTS, UNCERTAINTIES
from mwdcal.geometry.units import FOOT, STANDARD_GRAVITY

_SPELLINGS = {
    "°": "deg degree degrees grad",
    "rad": "rad radian radians",
    "°C": "c celsius degc gradc",
    "°F": "f fahrenheit degf",
    "K": "k kelvin",
    "g": "g",
    "mg": "millig mg",
    "m/s²": "mss mps",
    "gal": "gal gals",
    "mGal": "mgal",
    "ft/s²": "ftss",
    "nT": "nt gamma",
    "µT": "ut",
    "mT": "millit",
    "gauss": "gauss gs oersted",
    "mG": "milligauss mgs",
    "A/m": "apm",
    "gon": "gon gons",
    "V": "v volt volts",
    "mV": "mv millivolt millivolts",
    "counts": "lsb counts count cnt cnts adc digits digit bits bit cuentas cuenta contagens contagem ink inkremente "
    "zahlwert zahlwerte tellinger",
    "raw": "raw",
}
_UNITS = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
"""Units by the words of names, as `_words` leaves them."""
ABOVE, BELOW, ANTICLOCKWISE = "° above horizontal", "° below horizontal", "° anticlockwise"
FROM_LOW_SIDE, ANTICLOCKWISE_FROM_LOW_SIDE = "° from low side", "° anticlockwise from low side"
"""Units of angles that count otherwise: an elevation upwards or downwards from the horizontal, a toolface."""
OF_TOOLFACES = (ANTICLOCKWISE, FROM_LOW_SIDE, ANTICLOCKWISE_FROM_LOW_SIDE)
CONVERSIONS = {
    "°F": "°C = (°F - 32) · 5/9",
    "K": "°C = K - 273.15",
    "rad": "° = rad · 180/π",
    "mg": "g = mg / 1000",
    "m/s²": "g = m/s² / 9.80665",
    "gal": "g = gal / 980.665",
    "mGal": "g = mGal / 980665",
    "ft/s²": f"g = ft/s² · {FOOT} / {STANDARD_GRAVITY}",
    "µT": "nT = µT · 1000",
    "mT": "nT = mT · 1e6",
    "gauss": "nT = gauss · 1e5",
    "mG": "nT = mG · 100",
    "A/m": "nT = A/m · 400 · π",
    "gon": "° = gon · 0.9",
    ABOVE: f"° = {ABOVE} + 90",
    BELOW: f"° = 90 - {BELOW}",
    ANTICLOCKWISE: f"° = -{ANTICLOCKWISE}",
    FROM_LOW_SIDE: f"° = {FROM_LOW_SIDE} - 180",
    ANTICLOCKWISE_FROM_LOW_SIDE: f"° = 180 - {ANTICLOCKWISE_FROM_LOW_SIDE}",
}
"""How another unit is converted into that of the contract."""
FACTORS = {
    "°F": (5 / 9, -160 / 9),
    "K": (1.0, -273.15),
    "rad": (180 / math.pi, 0.0),
    "mg": (1e-3, 0.0),
    "m/s²": (1 / STANDARD_GRAVITY, 0.0),
    "gal": (1e-2 / STANDARD_GRAVITY, 0.0),
    "mGal": (1e-5 / STANDARD_GRAVITY, 0.0),
    "ft/s²": (FOOT / STANDARD_GRAVITY, 0.0),
    "µT": (1e3, 0.0),
    "mT": (1e6, 0.0),
    "gauss": (1e5, 0.0),
    "mG": (1e2, 0.0),
    "A/m": (400 * math.pi, 0.0),
    "gon": (0.9, 0.0),
    ABOVE: (1.0, 90.0),
    BELOW: (-1.0, 90.0),
    ANTICLOCKWISE: (-1.0, 0.0),
    FROM_LOW_SIDE: (1.0, -180.0),
    ANTICLOCKWISE_FROM_LOW_SIDE: (-1.0, 180.0),
}
"""The same in numbers: factor, and what is added to the product."""
_WARM = ("°C", "°F", "K")
_MAGNETIC_UNITS = ("nT", "µT", "mT", "gauss", "mG", "A/m")
_GRAVITY_UNITS = ("g", "mg", "m/s²", "gal", "mGal", "ft/s²")
_CHANNEL_UNITS = (*_MAGNETIC_UNITS, *_GRAVITY_UNITS)
_TESLAS = {"nt", "ut"}
"""Units that no temperature has, and those of them that are no other word within a name."""
WARMTH = "temperature_c"
_STATED = {"ref", "reference", "local", "model", "igrf", "bggm", "wmm"}
"""Words of columns that are known, not measured."""
_BYWORDS = _STATED | {
    *("true", "grid", "mag", "magnetic", "stand", "nominal", "target", "given", "set", "angle"),
    *("winkel", "vinkel"),
    *("value", "tool", "mwd", "survey", "measured", "meas", "calc", "calculated", "computed"),
    *("corr", "corrected", "avg", "mean", "median", "sensor", "board", "internal", "electronics"),
    *(
        "probe",
        "chip",
        "adc",
        "cnt",
        "cnts",
        "count",
        "counts",
        "digits",
        "output",
        "out",
        "channel",
        "ch",
        "axis",
    ),
    *(
        "sens",
        "reading",
        "actual",
        "stated",
        "applied",
        "ist",
        "obs",
        "observatory",
        "table",
        "ring",
        "dial",
    ),
}
"""Words that do not change what a column resembles."""
_CALLED_G = ("ref_field_nt", "mx", "my", "mz")
"""Columns beside whose names G is Gauss, no unit of gravity."""
_MEANS = {"mean", "avg", "median"}
_SPREADS = {"sd", "sigma", "std", "stdev", "unc", "uncertainty"}
_ACCELEROMETERS = "acc accel acceleration accelerometer accelerometers g a gravity grav"
_MAGNETOMETERS = "mag magnetometer magnetometers b h flux fluxgate m magfield magneticfield magn fg"
_INSTEAD = {
    "ref_inclination_deg": "inc incl incli inclin inclination",
    "ref_azimuth_deg": "azi azm azim azimut azimuth hdg heading bearing",
    "ref_toolface_deg": "tf gtf hs hstf tface toolface highside highsidetoolface highsidetf "
    "gravitytoolface roll rollangle hsg rotation",
    "ref_gravity_g": "gravity gtotal gtot totalg totalgravity gravitytotal gravityfield tgf gt gref localg "
    "localgravity",
    "ref_field_nt": "btotal btot totalb htotal htot totalh bt tmf tfield bfield hfield totalfield "
    "fieldtotal fieldstrength magtotal totalmag tmi bref href fref",
    "ref_dip_deg": "dip magdip mdip",
    "temperature_c": "temp temperature temperatur tmp tempc tempf temperaturec temperaturef degc degf",
    "serial": "serial sn serialno serialnumber serialnr tool toolid toolserial toolsn",
    "group": "rollset",
    **{f"a{i}": " ".join(f"{w}{i} {i}{w}" for w in _ACCELEROMETERS.split()) for i in "xyz"},
    **{f"m{i}": " ".join(f"{w}{i} {i}{w}" for w in _MAGNETOMETERS.split()) for i in "xyz"},
}
_SYNONYMS = {word: column for column, words in _INSTEAD.items() for word in words.split()}
_CHANNELS = tuple(f"{letter}{axis}" for letter in "am" for axis in "xyz")
_WARMTH = {
    *(
        "temp",
        "temps",
        "temperature",
        "temperatur",
        "tmp",
        "thermometer",
        "thermistor",
        "thermocouple",
        "rtd",
        "bht",
    ),
    *("ntc", "degc", "degf", "celsius", "fahrenheit"),
}
"""Words that make a column a temperature, whatever it is the temperature of."""
_PLACES = {
    *("tool", "sonde", "degc", "degf"),
    *(
        "sens",
        "sensor",
        "oven",
        "chamber",
        "board",
        "pcb",
        "case",
        "housing",
        "ambient",
        "amb",
        "air",
        "room",
    ),
    *(
        "int",
        "internal",
        "probe",
        "chip",
        "cpu",
        "mcu",
        "bath",
        "ofen",
        "kammer",
        "platine",
        "umgebung",
    ),
}
"""Temperatures that a `t` may mean: T_sens, Chamber T."""
_OF_TEMPERATURES = {
    *(
        "note",
        "notes",
        "comment",
        "comments",
        "remark",
        "remarks",
        "id",
        "name",
        "type",
        "status",
        "flag",
        "ok",
    ),
    *(
        "rate",
        "drift",
        "delta",
        "diff",
        "gradient",
        "error",
        "coef",
        "coeff",
        "coefficient",
        "time",
        "no",
        "count",
    ),
    *("ppm", "per"),
}
"""Words of columns that say something about temperatures, but not their values."""
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
OURS = (
    "time_s",
    "start_s",
    "end_s",
    "samples",
    "drifting",
    "serial",
    "simulated",
    *MEASURED_DEPTHS,
)
"""Columns beyond the contract that mwdcal itself reads or writes in run files."""
_COPIED = ("drift_", "witsml ")
"""What columns begin with that mwdcal writes of a log, and that a WITSML file has beyond a run's."""
_CALCULATED = re.compile(
    r"(?<![A-Za-z])(calc|calculated|computed|berechnet)(?![A-Za-z])", re.IGNORECASE
)
"""Words of columns that a program has computed from the readings: no evidence."""
_BRACKETED = re.compile(r"(.*\S)\s*[(\[{]([^(\[{]*)[)\]}](\s+\S+)?", re.DOTALL)
OF_TIME = re.compile(r"\s*temps\W+(ms|s(ec\w*)?|min\w*|h+(\W.*)?)\W*", re.IGNORECASE)
"""The French name of a time."""
_CASED = {
    "mV": " mv ",
    "nT": " nt ",
    "uT": " ut ",
    "mT": " millit ",
    "mG": " milligauss ",
    "mGs": " milligauss ",
    "mGal": " mgal ",
    "mg": " millig ",
}


class Resemblance(NamedTuple):
    """The contract's column that a name resembles, and the unit that the name states, if any."""

    column: str
    unit: str = ""


def resembled(name: str) -> Resemblance | None:
    """The column that a name resembles, with a unit behind it that is known or, in brackets, is not.

    Brackets may say the same again, at the end or before the unit.

    >>> [resembled(n) for n in ("Azi (°)", "Temp (°F)", "comment")]
    [Resemblance(column='ref_azimuth_deg', unit='°'), Resemblance(column='temperature_c', unit='°F'), None]
    >>> resembled("HX [steps]"), resembled("Roll (toolface) deg")
    (Resemblance(column='mx', unit='steps'), Resemblance(column='ref_toolface_deg', unit='°'))
    """
    if name in _CHANNELS or OF_TIME.fullmatch(name):
        return None
    whole, bracketed = _resembled(name), _BRACKETED.fullmatch(name.strip())
    behind = (bracketed and bracketed[3]) or ""
    if whole or not bracketed or not (bare := resembled(bracketed[1] + behind)):
        return whole
    again = _resembled(bracketed[2])  # Roll angle (TF): no unit
    if again and again.column == bare.column:
        return bare
    unit = unit_of(bracketed[2]) or bracketed[2].strip()
    of_channel = bare.column == WARMTH and unit in _CHANNEL_UNITS  # Gx temp comp (g)
    return None if behind or of_channel else bare._replace(unit=unit)


def _resembled(name: str) -> Resemblance | None:
    """The column that a name resembles; nothing where it has words from elsewhere."""
    every = _words(name)
    spread = not _SPREADS.isdisjoint(every)
    aside = _SPREADS | _MEANS
    words, unit = _without_unit([word for word in every if word not in aside] or every)
    whole = "".join(words)
    bare = "".join(word for word in words if word not in _BYWORDS)
    column = _column(whole, bare, set(words), unit)
    if column is None and _is_warmth(every, whole):
        column = WARMTH
    if column == WARMTH and (unit in _CHANNEL_UNITS or not _TESLAS.isdisjoint(every)):
        return None
    if column is None or (unit == "counts" and column not in _CHANNELS):
        return None
    if column in _CALLED_G and unit == "g" and name.rstrip(" )]").endswith("G"):
        unit = "gauss"
    if (
        column in ("ax", "ay", "az")
        and unit == "gauss"
        and name.rstrip(" )]").lower().endswith("gs")
    ):
        unit = "g"
    if column in _CALLED_G and unit == "mg":
        unit = "mG"
    if not spread:
        implied = "°F" if "f" in (whole[-1:], bare[-1:]) and column == "temperature_c" else ""
        return Resemblance(column, unit or implied)
    return Resemblance(f"sd_{column}", unit) if column.startswith(("ref_", "a", "m")) else None


def _column(whole: str, bare: str, words: set[str], unit: str) -> str | None:
    """The contract's column of a name's words, all of them joined and without bywords."""
    if {whole, bare} & _NEVER:
        return None
    stated = bool(words & _STATED)
    magnetic = stated or unit in _MAGNETIC_UNITS or words & {"mag", "magnetic"}
    rules = {
        "ref_field_nt": (bare == "field" and magnetic)
        or (bare in ("b", "h") and stated)
        or (bare == "t" and unit in _MAGNETIC_UNITS),
        "ref_azimuth_deg": bare == "az" and (stated or unit in ("°", "rad", "gon")),
        "temperature_c": bare in ("t", "ts", "deg", "") and unit in _WARM,
        "ref_gravity_g": bare == "g" and stated,
    }
    short = (s.removeprefix("ref").removesuffix("deg") for s in (whole, bare))
    if bare in ("tx", "ty", "tz", "fx", "fy", "fz") and unit in _MAGNETIC_UNITS:
        return f"m{bare[1]}"
    if bare in ("x", "y", "z") and words & {"mag", "magnetic"}:
        return f"m{bare}"
    if whole in ("x", "y", "z") and unit in (*_MAGNETIC_UNITS, *_GRAVITY_UNITS):
        return f"{'m' if unit in _MAGNETIC_UNITS else 'a'}{whole}"
    known = [_SYNONYMS[stem] for stem in (whole, bare, *short) if stem in _SYNONYMS]
    return next(iter([column for column, fits in rules.items() if fits] + known), None)


def _is_warmth(words: Sequence[str], whole: str) -> bool:
    """Whether a column is a temperature by its words, or by all of them `whole`: Oven temp, T_sens, boardtemp."""
    if not _OF_TEMPERATURES.isdisjoint(words):
        return False
    degrees = any(word.startswith("deg") and unit in ("c", "f") for word, unit in pairwise(words))
    return (
        degrees
        or not _WARMTH.isdisjoint(words)
        or whole.endswith("temp")
        or "temperat" in whole
        or (whole.startswith("t") and whole[1:] in _PLACES)
        or ("t" in words and whole.removesuffix("t") in _PLACES)
    )


def _words(name: str) -> list[str]:
    """The words of a name in lower case, its units spelled without signs."""
    text = unicodedata.normalize("NFKC", name.replace("º", "°"))
    text = re.sub(r"ft\s*/\s*s\s*(\^\s*)?2", " ftss ", text)
    text = re.sub(r"m\s*/\s*s\s*(\^\s*)?2|(?<![A-Za-z])mp?s\^?-?2", " mss ", text)
    for sign, word in UNITS_BY_SIGN.items():
        text = text.replace(sign, word if len(word) == 1 else f" {word} ")
    for cased, word in _CASED.items():
        text = re.sub(rf"(?<![A-Za-z]){cased}(?![A-Za-z])", word, text)
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)]


def synonyms_of(column: str) -> list[str]:
    """Words of three letters or more that a column is called by."""
    return [word for word in _INSTEAD.get(column, "").split() if len(word) > 2]


def begins_as(name: str) -> str:
    """The raw channel that a name begins as, before words that are no unit; empty if it begins as none.

    >>> begins_as("HX_adc"), begins_as("Mag Y digits"), begins_as("note")
    ('mx', 'my', '')
    """
    words = _words(name)
    stems = ["".join(words[:count]) for count in range(len(words) - 1, 0, -1)]
    known = (stem if stem in _CHANNELS else _SYNONYMS.get(stem, "") for stem in stems)
    return next((column for column in known if column in _CHANNELS), "")


_OF_MINUTES = re.compile(r"[°º]\s*['′’]\s*([\"″”]|'')?")
"""The unit of angles in degrees, minutes and seconds."""


def unit_of(text: str) -> str:
    """The unit that a text is, empty if it is not a unit.

    >>> [unit_of(text) for text in ("deg", "°F", "m/s²", "ft/s^2", "мg", "A/m", "x")]
    ['°', '°F', 'm/s²', 'ft/s²', 'mg', 'A/m', '']
    """
    if _OF_MINUTES.fullmatch(text):
        return "°"
    words = _words(text)
    return _UNITS[words[-1]] if words and set(words) <= {*_UNITS} else ""


def _without_unit(words: list[str]) -> tuple[list[str], str]:
    """The words before a unit, and the unit; a single word is not a unit."""
    left, unit = list(words), ""
    while len(left) > 1 and left[-1] in _UNITS and not set(left[:-1]) <= _STATED | {"total"}:
        unit = unit or _UNITS[left[-1]]
        left.pop()
    return left, unit


def unused(names: Sequence[str], used: Collection[str]) -> tuple[str, ...]:
    """Columns that are not used, each with what it resembles; those that resemble something first."""
    others = [n for n in names if n not in (*used, *OURS) and not n.startswith(_COPIED)]
    alike = {name: resembled(name) for name in others}
    notes = {name: f" (resembles '{each.column}')" for name, each in alike.items() if each}
    notes |= dict.fromkeys(_results(names), " (a result of mwdcal apply)")
    ordered = sorted(others, key=lambda name: alike[name] is None)
    return tuple(shown(name) + notes.get(name, "") for name in ordered)


def _results(names: Collection[str]) -> set[str]:
    """The columns that are results of `mwdcal apply`: where all of them are there."""
    return {*RESULTS, *UNCERTAINTIES, EXTRAPOLATED} if set(RESULTS) <= set(names) else set()


def check_evidence(
    names: Sequence[str], source: str, noticed: Collection[str] = tuple(NOTICED)
) -> None:
    """Refuse a column that resembles one of those to be noticed, where that itself is absent."""
    results, absent = _results(names), {*noticed}.difference(names)
    alike = {n: resembled(n) for n in names if n not in results and not _CALCULATED.search(n)}
    meant = [(name, each) for name, each in alike.items() if each and each.column in absent]
    if not meant:
        return
    name, resemblance = meant[0]
    rivals = [shown(n) for n, other in meant[1:] if other.column == resemblance.column]
    others = [
        f"{shown(n)} ({o.column}, {NOTICED[o.column]})"
        for n, o in meant[1:6]
        if shown(n) not in rivals
    ]
    likewise = f" Likewise {', '.join(others)}." if others else ""
    which = ""
    if rivals and resemblance.column == WARMTH:
        which = f" So does {' and '.join(rivals)}: take the one nearest to the sensors."
    how = remedy(resemblance)
    if resemblance.column == WARMTH:
        how += ", or name it under [columns] of the tool profile"
    raise InputError(
        f"{source}: the column {shown(name)} resembles '{resemblance.column}', which is absent, and would not "
        f"be used.{which} {how}; if it is something else, name it under ignore in [table] of the tool profile, "
        f"or give it a name that says so.{likewise}"
    )


def remedy(resemblance: Resemblance) -> str:
    """What to do with a column that is one of the contract under another name or in another unit.

    >>> remedy(Resemblance("temperature_c", "°F"))
    "Convert it (°C = (°F - 32) · 5/9) and name it 'temperature_c' (°C)"
    """
    unit = f" ({NOTICED[resemblance.column]})" if resemblance.column in NOTICED else ""
    how = "Rename it to"
    if resemblance.unit in CONVERSIONS:
        how = f"Convert it ({CONVERSIONS[resemblance.unit]}) and name it"
    return f"{how} '{resemblance.column}'{unit}"
