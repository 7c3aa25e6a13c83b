"""The files of a calibration for firmware, and what is stated of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from mwdcal.calibration.readings import is_simulated
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.firmware import c_source
from mwdcal.firmware.c_source import (
    comment,
    double_initialiser,
    fixed_initialiser,
    initialiser,
    literal,
    order,
    source,
)
from mwdcal.firmware.quantisation import (
    FixedCalibration,
    WorkingRange,
    angle_errors,
    quantised,
    rounding_errors,
    working_range,
)
from mwdcal.geometry.observables import VERTICAL
from mwdcal.geometry.vectors import Array

FIXED_POINT = "fixed-point"
FORMS = ("c-header", FIXED_POINT)
DEFAULT_BITS = 32
_DOUBLE_ROUNDING = 4e-12
"""Share of the largest terms, and radians, by which results in double precision differ from `apply`."""
_ERROR_DIGITS = 3
"""Significant digits of a stated error, rounded up."""


class FirmwareSources(NamedTuple):
    """Files by name, and the stated errors: vectors in g and the field's unit, angles in degrees.

    Angles are multiplied by the shares of `angle_errors`. `fractions`: powers of two of the words by
    quantity, of fixed-point numbers.
    """

    files: dict[str, str]
    errors: dict[str, float]
    work: WorkingRange
    fractions: dict[str, int]


def export(
    calibration: Calibration, form: str, sha256: str = "", word_bits: int = DEFAULT_BITS
) -> FirmwareSources:
    """The C sources of a calibration, with test vectors; `sha256` is of the calibration file.

    Raises:
        InputError: the form is unknown, or fixed-point numbers cannot carry the calibration.
    """
    if form not in FORMS:
        raise InputError(f"`form` must be one of {', '.join(FORMS)}; got {form!r}.")
    if form == FIXED_POINT:
        return _fixed(calibration, sha256, word_bits)
    return _double(calibration, sha256)


def _double(calibration: Calibration, sha256: str) -> FirmwareSources:
    work = working_range(calibration)
    off = rounding_errors(calibration, work, _DOUBLE_ROUNDING)
    errors = _errors(calibration, off, angle_errors(calibration, off, _DOUBLE_ROUNDING, 0.0))
    lowest, highest = work.temperatures
    header = source(
        "mwdcal_double.h",
        **_common(calibration, sha256, work, errors, "DOUBLE"),
        reference=f"({initialiser(calibration.reference_temperature)})",
        lowest=f"({initialiser(lowest)})",
        highest=f"({initialiser(highest)})",
        coefficients=double_initialiser(calibration),
        field_unit=c_source.field_unit(calibration),
    )
    weak = VERTICAL, VERTICAL * calibration.earth.get("field", 1.0)
    return FirmwareSources(
        _files("double", header, calibration, sha256, weak, {}), errors, work, {}
    )


def _fixed(calibration: Calibration, sha256: str, bits: int) -> FirmwareSources:
    fixed = quantised(calibration, bits)
    errors = _errors(calibration, [t.error for t in fixed.triads], fixed.angles)
    fractions, weak = _fractions(fixed), [*fixed.weak, 1][:2]
    header = source(
        "mwdcal_fixed.h",
        **_common(calibration, sha256, fixed.work, errors, "FIXED"),
        bits=bits,
        storage=16 if bits <= 16 else 32,
        formats=comment(c_source.formats(calibration, fractions, bits)),
        fractions=c_source.fraction_macros(fractions),
        reference=f"({fixed.reference})",
        lowest=f"({fixed.lowest})",
        highest=f"({fixed.highest})",
        tau=fixed.temperature + fixed.form.half,
        weak_gravity=weak[0],
        weak_field=weak[1],
        coefficients=fixed_initialiser(fixed, order(calibration)),
    )
    steps = fixed.triads[0].field, fixed.triads[-1].field
    limits = math.ldexp(weak[0], -steps[0]), math.ldexp(weak[1], -steps[1])
    _check_north(calibration, bits, limits[1])
    files = _files("fixed", header, calibration, sha256, limits, fractions)
    return FirmwareSources(files, errors, fixed.work, fractions)


def _check_north(calibration: Calibration, bits: int, weak: float) -> None:
    """Refuse words in which the horizontal field of the calibration's place has no direction."""
    if not calibration.has_field:
        return
    level = calibration.earth["field"] * math.cos(math.radians(calibration.earth["dip_deg"]))
    if level <= c_source.CLEARLY * weak:
        unit = c_source.field_unit(calibration)
        raise InputError(
            f"in words of {bits} bits a field below {weak:.3g} {unit} has no direction, so that the horizontal one, "
            f"{level:.3g} {unit}, has no azimuth. Use more `word_bits`, or form c-header."
        )


def _common(
    calibration: Calibration,
    sha256: str,
    work: WorkingRange,
    errors: Mapping[str, float],
    kind: str,
) -> dict[str, object]:
    """The common words of both headers."""
    return {
        "about": comment(c_source.head(calibration, sha256, work, errors)),
        "serial": literal(calibration.tool.get("serial", "")),
        "sha256": literal(sha256),
        "triads": len(calibration.triads),
        "order": order(calibration),
        "status": c_source.status_macros(saturates=kind == "FIXED"),
        "errors": c_source.error_macros(kind, errors),
    }


def _fractions(fixed: FixedCalibration) -> dict[str, int]:
    """Powers of two of the words that go in and come out."""
    inputs = {triad.name: triad.raw for triad in fixed.triads}
    outputs = zip(c_source.VECTOR_NAMES, (triad.field for triad in fixed.triads), strict=False)
    return {**inputs, "temperature": fixed.temperature, **dict(outputs)}


def _errors(
    calibration: Calibration, off: Iterable[Array], angles: Mapping[str, float]
) -> dict[str, float]:
    """Errors by quantity, with that of the decimals of the test vectors, rounded up."""
    names = zip(c_source.VECTOR_NAMES, (float(np.max(each)) for each in off), strict=False)
    return {
        name: _rounded_up(value + 0.5 * 10.0 ** -c_source.decimals(calibration, name))
        for name, value in (*names, *angles.items())
    }


def _rounded_up(value: float) -> float:
    places = _ERROR_DIGITS - 1 - math.floor(math.log10(value))
    return float(f"{math.ceil(value * 10.0**places) / 10.0**places:.{_ERROR_DIGITS}g}")


def _files(
    kind: str,
    header: str,
    calibration: Calibration,
    sha256: str,
    weak: tuple[float, float],
    fractions: Mapping[str, int],
) -> dict[str, str]:
    """The sources and the test vectors, by file name; with `fractions` these are in words too."""
    columns, stem = c_source.expected(calibration), f"mwdcal_{kind}"
    clear = c_source.status(columns, weak) >= 0
    columns = {name: column[clear] for name, column in columns.items()}
    codes, words = c_source.status(columns, weak), c_source.words(columns, fractions)
    metadata = {
        "serial": calibration.tool.get("serial"),
        "calibration_sha256": sha256 or None,
        "simulated": is_simulated(calibration.tool) or None,
    }
    return {
        f"{stem}.h": header,
        f"{stem}.c": source(f"{stem}.c"),
        f"{stem}_vectors.h": source(
            f"{stem}_vectors.h",
            about=comment(c_source.origin(calibration, sha256)),
            vectors=c_source.initialisers(columns, words, codes),
        ),
        f"{stem}_test.c": source(f"{stem}_test.c"),
        f"{stem}_vectors.csv": c_source.table(columns, words, codes, metadata),
    }
