"""Numbers, units and names as screens and pages write them.

An estimate and its uncertainty have two significant digits of the latter (`measured`, `estimate`), an uncertainty by
itself has two (`uncertainty`), and what adds less than a thousandth to it is 0 (`contribution`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

import msgspec
import numpy as np

from mwdcal.calibration.record import TriadCalibration
from mwdcal.files.contract import AZIMUTH_KEYS, CHANNELS
from mwdcal.geometry.vectors import Array
from mwdcal.presentation.text import one_line, raised, superscript
from mwdcal.sensor.profile import Profile
from mwdcal.use.notation import VALUE_AXES, powers

HELD = "held"
"""In place of the uncertainty of a parameter that a model of 9 or 6 keeps at zero."""
LEAST_CONTRIBUTION = 1e-3
"""Share of a combined uncertainty below which a contribution is 0."""
MOST_DECIMALS = 7
"""Decimals of a number by its uncertainty; smaller ones have a power of ten."""
RAW_UNIT = "raw"
"""The unit of readings of which the profile does not name it…"""
RAW_MEANING = "raw: the unit of the readings in the run"
"""…and its meaning."""
UNDETERMINED = "undetermined"
"""In place of an uncertainty that no reading determines."""


def number(value: float | None, digits: int | None = None) -> str:
    """A number to some significant digits, by default at most three, without E notation; a dash where there is none.

    >>> [number(0.1), number(0.1, 3), number(12345.6), number(9.92e-5), number(None)]
    ['0.1', '0.100', '12346', '9.92×10⁻⁵', '–']
    """
    if digits is None:
        plain, times, raised_power = number(value, 3).partition("×")
        stripped = plain.rstrip("0").rstrip(".") if "." in plain else plain
        return stripped + times + raised_power
    if value is None or not np.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    mantissa, _, digits_of_power = f"{value:.{digits - 1}e}".partition("e")
    power = int(digits_of_power)
    if not -5 < power < 7:
        return f"{mantissa}×10{superscript(power)}".replace("-", "−")
    return fixed(value, max(digits - 1 - power, 0))


def fixed(value: float | None, decimals: int) -> str:
    """A number to some decimals, with a true minus sign; a dash where there is none."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}".replace("-", "−")


def quantity(
    value: float | None, symbol: str, digits: int | None = None, uncertainty: float | None = None
) -> str:
    """A number with its unit, which is apart from a power of ten; to two digits of an uncertainty, if there is one.

    >>> [quantity(0.25, "°"), quantity(3, "nT"), quantity(0.03, "°", 2), quantity(1e-9, "°", 2), quantity(None, "nT")]
    ['0.25°', '3 nT', '0.030°', '1.0×10⁻⁹\xa0°', '–']
    >>> [quantity(each, "°", uncertainty=0.0042) for each in (0.00888, 0.009)]
    ['0.0089°', '0.0090°']
    """
    shown = number(value, digits)
    if value is None:
        return shown
    if uncertainty and 0 < uncertainty < np.inf:
        decimals = 1 - int(f"{uncertainty:.1e}".partition("e")[2])
        shown = fixed(value, decimals) if decimals <= MOST_DECIMALS else shown
    return f"{shown}\u00a0°" if symbol == "°" and "×" in shown else shown + unit(symbol)


def signed(value: float | None, decimals: int) -> str:
    """As `fixed`, with a plus sign too."""
    text = fixed(value, decimals)
    return text if text[0] in "−–" or not float(text) else f"+{text}"


def norths(
    stated: Mapping[str, object], profile: Mapping[str, object]
) -> list[tuple[str, str, str]]:
    """Declination and convergence of azimuths that are not magnetic: name, angle, and which one of both states it."""
    if stated.get(AZIMUTH_KEYS[0], "magnetic") == "magnetic":
        return []
    angles = {key: float(str(stated[key])) for key in AZIMUTH_KEYS[1:] if key in stated}
    return [
        (
            key.removesuffix("_deg"),
            f"{abs(angle):g}° {'W' if angle < 0 else 'E'}",
            "tool profile" if profile.get(key) == angle else "run",
        )
        for key, angle in angles.items()
    ]


def measured(value: float, uncertainty: float | None) -> tuple[str, str]:
    """Value and standard uncertainty as text, both to two significant digits of the latter."""
    if uncertainty is None or not np.isfinite(uncertainty):
        return number(value, 6), UNDETERMINED
    if uncertainty == 0:
        return number(value, 9), "0"
    decimals = 1 - exponent(uncertainty)
    power = exponent(max(abs(value), uncertainty))
    if power == 0 or (decimals <= MOST_DECIMALS and power < 7):
        return fixed(value, decimals), fixed(uncertainty, decimals)
    scaled = (fixed(v * 10.0**-power, decimals + power) for v in (value, uncertainty))
    first, second = (f"{text}×10{superscript(power)}" for text in scaled)
    return first, second


def estimate(value: float, uncertainty: float | None, symbol: str = "") -> str:
    """An estimate with its standard uncertainty and unit.

    >>> [estimate(-4.5e-21, 2e-05, "g"), estimate(0.05216, 0.0034, "°"), estimate(3.2, None, "nT")]
    ['0.000000 ± 0.000020 g', '0.0522 ± 0.0034°', '3.20000 nT, undetermined']
    """
    shown, sd = measured(value, uncertainty)
    if sd == UNDETERMINED:
        return f"{shown}{unit(symbol)}, {sd}"
    return f"{shown} ± {sd}{unit(symbol)}"


def contribution(value: float | None, combined: float | None) -> str:
    """The contribution of one source to a combined uncertainty, to two digits; 0 below a thousandth of it.

    >>> [contribution(v, 0.013) for v in (0.00402, 1.4e-05, 1.2e-05, 3.5e-17, None)]
    ['0.0040', '0.000014', '0', '0', 'undetermined']
    """
    if value is None or combined is None:
        return uncertainty(value)
    if not value or abs(value) < LEAST_CONTRIBUTION * combined:
        return "0"
    plain_numbers = number(combined, 2) == fixed(combined, 1 - exponent(combined))
    return fixed(value, 1 - exponent(value)) if plain_numbers else number(value, 2)


def root_sum_of_squares(parts: Iterable[float | None]) -> float | None:
    """The combined uncertainty of independent contributions; None where one is undetermined."""
    values = [*parts]
    known = [value for value in values if value is not None]
    return float(np.linalg.norm(known)) if len(known) == len(values) else None


def exponent(value: float) -> int:
    """The power of ten of a number rounded to two digits."""
    return int(f"{value:.1e}".split("e")[1])


def raw_unit(profile: Profile, triad: str) -> str:
    """The unit of a triad's channels, such as mV, where the profile names it for all three; else "raw"."""
    columns = {} if isinstance(profile.columns, msgspec.UnsetType) else profile.columns
    units = {columns[name].unit if name in columns else "" for name in CHANNELS[triad]}
    return (len(units) == 1 and units.pop()) or RAW_UNIT


def strength_unit(triad: TriadCalibration) -> str:
    """The unit of a triad's field, empty if it has none."""
    return triad.unit if triad.unit in ("g", "nT") else ""


def value_places(
    values: Mapping[str, Array], raw: str, strength: str, one: str = ""
) -> Iterator[tuple[str, tuple[int, ...], str, int, str]]:
    """Name, index, axes, power of τ and unit of each value of a notation; the diagonal of m is not one.

    `raw` is the unit of the readings, `strength` that of the field, empty if it has none; `one` stands for no unit.
    """
    scale = f"{raw}/{strength}" if strength else raw
    units = {
        "SF": scale, "B": strength or one, "m": "rad", "S": scale, "o": raw,
        "M": f"{strength or '1'}/{raw}", "b": strength or one,
    }  # fmt: skip
    for name, value in values.items():
        for at, power in np.ndenumerate(powers(name, value)):
            place = at[:1] if name in ("SF", "B") else at[-VALUE_AXES[name] :]
            if name != "m" or at[0] != at[1]:
                axes = "".join("xyz"[axis] for axis in place)
                yield name, at, axes, int(power), units[name] + raised("/°C", int(power))


def uncertainty(value: float | None) -> str:
    """A standard uncertainty to two digits, or that it is undetermined."""
    return UNDETERMINED if value is None or np.isnan(value) else number(value, 2)


def degrees_of_freedom(value: float) -> str:
    """Degrees of freedom in words; they need not be whole.

    >>> [degrees_of_freedom(value) for value in (0.0, 1.0, 3.2, 132.4)]
    ['0 degrees of freedom', '1 degree of freedom', '3.2 degrees of freedom', '132 degrees of freedom']
    """
    shown = number(value, 2 if value < 10 else 3).removesuffix(".0")
    return f"{shown} degree{'' if shown == '1' else 's'} of freedom"


def channels_of(names: Collection[str]) -> dict[str, list[str]]:
    """The channels among some names, by triad."""
    triads = {kind: [n for n in channels if n in names] for kind, channels in CHANNELS.items()}
    return {kind: channels for kind, channels in triads.items() if channels}


def capital(text: str) -> str:
    """Text as the start of a sentence."""
    return text[:1].upper() + text[1:]


def files_written(**files: Path | str | None) -> str:
    """The files that were written, each with what it is."""
    return one_line("wrote " + "   ".join(f"{p} ({what})" for what, p in files.items() if p))


def unit(symbol: str) -> str:
    """A unit as it follows a number: the degree sign without a space."""
    return symbol if symbol in ("", "°") else f" {symbol}"
