"""Arrays, lists and table columns to `Readings`: converted once, checked once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypedDict, Unpack

import numpy as np

from mwdcal.calibration.readings import TRIADS, Readings, fingerprints, group_numbers
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES, WALKS
from mwdcal.files import metadata as meta
from mwdcal.files.contract import (
    RAW_SPREAD,
    REFERENCES,
    TEMPERATURE,
    Range,
    is_angle,
    magnetic_offset,
)
from mwdcal.files.runs import north_of, stated_references
from mwdcal.geometry.vectors import Array, ArrayLike, Bools, wrap
from mwdcal.sensor.profile import COMMON, PRACTICES

DEGREES_SUFFIX = "_deg"
"""Ending of the keyword twins that take degrees."""
TURNING = ("azimuth", "toolface")
"""Angles that come as -360…360° and are kept as 0…360°."""
_NAME = "the readings"
"""Arrays in a message, where a file has its name."""


class References(TypedDict, total=False):
    """Reference values at each station; NaN where unknown."""

    inclination: ArrayLike
    inclination_deg: ArrayLike
    azimuth: ArrayLike
    azimuth_deg: ArrayLike
    toolface: ArrayLike
    toolface_deg: ArrayLike
    gravity: ArrayLike
    field: ArrayLike
    dip: ArrayLike
    dip_deg: ArrayLike


def readings(
    accelerometer: ArrayLike,
    magnetometer: ArrayLike | None = None,
    *,
    temperature: ArrayLike | None = None,
    sd: Mapping[str, ArrayLike] | None = None,
    group: Sequence[object] | None = None,
    settings: Literal["", "per-direction", "per-station"] = "",
    station: Sequence[object] | None = None,
    metadata: Mapping[str, object] | None = None,
    md_m: ArrayLike | None = None,
    **references: Unpack[References],
) -> Readings:
    """Readings of one tool from arrays, lists, or columns of a pandas or polars table.

    Shapes: `accelerometer` and `magnetometer` (n, 3), stations by axes x, y, z; everything else (n,)
    or a scalar for all stations. Leading axes (repetitions) are kept.

    NaN, None and what a mask hides are missing.

    Units: nominal g and nT along the tool axes (raw over the `scale` of the profile), °C, radians;
    `inclination_deg`, `azimuth_deg`, `toolface_deg` and `dip_deg` take degrees instead. Azimuths are magnetic unless
    `metadata` state another north, as in a run file: the readings then hold magnetic ones.

    Args:
        accelerometer: gravity, positive along an axis that points down.
        magnetometer: magnetic field.
        temperature: needed for models with temperature terms.
        sd: standard uncertainties by name, in the same units: of `accelerometer` and `magnetometer`
            (scalar, (3,) per axis or (n, 3)), of references, and of errors that all stations share:
            `azimuth_zero`, `toolface_zero`, `inclination_zero`, `tilt` and `tool_axis`. Angles are in radians;
            names that end in `_deg`, such as `inclination_deg`, take degrees.
            `accelerometer_drift`, `magnetometer_drift` and `field_drift`: of the change from the first station
            to the last, of an axis.
            The noise of a triad that is not named is estimated from the residuals.
        group: numbers or names; stations of one group share a direction of the tool axis. Blank, None,
            NaN or negative: no group.
        settings: whether the stand's direction is set once for stations that follow each other with
            equal inclination and azimuth ("per-direction"), or at every station ("per-station").
            Blank: not stated, once is assumed.
        station: labels, for messages and tables.
        metadata: `serial` as text, `date` as 2026-01-31, `operator`, …; `simulated` marks data of no real tool. Those
            that a run file takes for its numbers count here too: `azimuth_reference` with `declination_deg` and
            `convergence_deg`, and `ref_gravity_g`, `ref_field_nt` and `ref_dip_deg` of all stations. The azimuths in
            `Readings.known` are magnetic already: give them without these keys of the north.
        md_m: measured depths, m, which `survey` needs for a well path.
        references: `inclination`, `azimuth`, `toolface`, `gravity`, `field` and `dip`, where known.

    Raises:
        InputError: an unknown name, a shape that does not fit, a value out of range, or a missing
            reading; the message says which station. A serial that is a number with a point, or a `date` that is
            not an ISO date.
    """
    stated = meta.plain(metadata or {}, _NAME)
    g = _vectors("accelerometer", accelerometer)
    b = None if magnetometer is None else _vectors("magnetometer", magnetometer)
    if b is not None and b.shape != g.shape:
        raise InputError(
            f"`magnetometer` must have the shape of `accelerometer`, {g.shape}; got {b.shape}. Give "
            "both at the same stations."
        )
    if settings not in ("", *PRACTICES):
        raise InputError(
            f"`settings` must be {' or '.join(PRACTICES)}; got {settings!r}. Leave it out where it is not known."
        )
    shape, triads = g.shape[:-1], [g] if b is None else [g, b]
    known = _as_stated(_known(references, shape), stated, shape)
    return Readings(
        accelerometer=g,
        magnetometer=b,
        temperature=None if temperature is None else _temperature(temperature, shape),
        known=known,
        sd=_uncertainties(sd or {}, shape),
        in_radians=tuple(name for name in ANGLES if name in (sd or {})),
        group=None if group is None else group_numbers(_labels("group", group, shape)),
        settings=settings,
        station=() if station is None else tuple(_labels("station", station, shape)),
        digest=fingerprints(triads) if len(shape) == 1 else (),
        metadata=stated,
        north=north_of(stated) if "azimuth" in known else {},
        others={} if md_m is None else {"md_m": _broadcast("md_m", md_m, shape)},
    )


def _numbers(name: str, values: ArrayLike) -> Array:
    """Values as a new array; NaN where a table has a null, or an array a mask."""
    try:
        if np.asarray(values).dtype.kind in "bcmM":
            raise TypeError(f"got {np.asarray(values).dtype}")
        return without_mask(np.ma.array(values, dtype=float, copy=True))
    except (TypeError, ValueError) as error:
        raise InputError(f"`{name}` must be numbers; {error}. Use NaN where unknown.") from None


def without_mask(values: Any) -> Array:
    """Numbers as a plain array, NaN where they are masked: what is below a mask is not a reading."""
    return np.asarray(np.ma.filled(values, np.nan), float)


def _vectors(name: str, values: ArrayLike) -> Array:
    """Readings (..., n, 3) of a triad, all of them finite."""
    vectors = _numbers(name, values)
    if vectors.shape[-1:] != (3,) or vectors.ndim < 2 or not vectors.size:
        advice = "Put the axes last: np.stack([x, y, z], axis=-1)."
        raise InputError(f"`{name}` must have the shape (n, 3); got {vectors.shape}. {advice}")
    advice = "Leave such a station out of every argument."
    _refuse(~np.isfinite(vectors), name, vectors, "finite", advice, axis=-2)
    return vectors


def _refuse(bad: Bools, name: str, values: Array, expected: str, advice: str, axis: int) -> None:
    """Refuse the first bad value, if there is one; `axis` is that of stations."""
    if bad.any():
        place = tuple(np.argwhere(bad)[0])
        raise InputError(
            f"`{name}` must be {expected}; got {values[place]:g} at station {place[axis] + 1}. {advice}"
        )


def _broadcast(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Values, or one for all, in a shape."""
    array = _numbers(name, values)
    try:
        return np.array(np.broadcast_to(array, shape))
    except ValueError:
        advice = "Give one value for each station."
        raise InputError(
            f"`{name}` must be a scalar or have the shape {shape}; got {array.shape}. {advice}"
        ) from None


def _within(name: str, values: Array, limits: Range, advice: str, axis: int = -1) -> Array:
    """Values that are all within limits, or NaN."""
    _refuse(limits.outside(values), name, values, str(limits), advice, axis)
    return values


def _temperature(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Temperatures (..., n), °C, none of them unknown."""
    name, array = "temperature", _broadcast("temperature", values, shape)
    advice = "Leave such a station out of every argument, or `temperature` out altogether."
    _refuse(np.isnan(array), name, array, "a number", advice, axis=-1)
    return _within(name, array, TEMPERATURE, "Give degrees Celsius.")


def nearest(name: str, names: Iterable[str]) -> str:
    """The question whether the nearest of the names was meant; empty where none is near."""
    near = difflib.get_close_matches(name, list(names), 1)
    return f" Did you mean '{near[0]}'?" if near else ""


def _by_name(values: Mapping[str, ArrayLike], limits: Mapping[str, Range]) -> dict[str, str]:
    """For each quantity the name that it is given by: that of the quantity, or of its twin in degrees."""
    spelled = {name.replace("-", "_"): name for name in limits}
    angles = [key for key, name in spelled.items() if limits[name].unit == "°"]
    spelled |= {f"{key}{DEGREES_SUFFIX}": spelled[key] for key in angles}
    if not hasattr(values, "keys"):
        names = " or ".join(f"'{name}'" for name in TRIADS)
        raise InputError(f"`sd` must be a mapping, with names such as {names}; got {values!r}.")
    given: dict[str, str] = {}
    for key in values:
        if key not in spelled:
            names = ", ".join(name for name in spelled if not name.endswith(DEGREES_SUFFIX))
            raise InputError(
                f"unknown name '{key}'; expected one of {names}, or of an angle with _deg.{nearest(key, spelled)}"
            )
        if spelled[key] in given:
            raise InputError(
                f"`{given[spelled[key]]}` and `{key}` are the same quantity. Give one of them."
            )
        given[spelled[key]] = key
    return given


def _converted(
    name: str, values: Array, limits: Range, advice: str, turning: bool = False
) -> Array:
    """Values within limits; angles in radians, from degrees where the name says so, `turning` ones in 0…360°."""
    if limits.unit != "°":
        return _within(name, values, limits, advice)
    advice, factor, whole = "Check the value.", float(np.radians(1)), 360.0
    if not name.endswith(DEGREES_SUFFIX):
        low, high = np.radians((limits.low, limits.high)).tolist()
        limits, factor, whole = Range(low, high, "rad"), 1.0, 2 * np.pi
        advice = f"Degrees go to `{name}{DEGREES_SUFFIX}`."
    values = _within(name, values, limits, advice)
    outside = (values < 0) | (values >= whole)
    return np.where(outside, wrap(values, whole), values) * factor if turning else values * factor


def _known(references: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, Array]:
    """Reference values by name in inside units, without those that are unknown everywhere."""
    given = {key: value for key, value in references.items() if value is not None}
    limits, known = {name: reference.values for name, reference in REFERENCES.items()}, {}
    for name, key in _by_name(given, limits).items():
        values, turning = _broadcast(key, given[key], shape), name in TURNING
        values = _converted(key, values, limits[name], "Check the unit.", turning)
        if not np.isnan(values).all():
            known[name] = values
    return known


def _as_stated(
    known: dict[str, Array], metadata: Mapping[str, object], shape: tuple[int, ...]
) -> dict[str, Array]:
    """References (..., n) as of a file with these metadata: magnetic azimuths, and values for all stations."""
    once = stated_references(metadata, [REFERENCES[name].column for name in known], _NAME)
    names = {each.column: name for name, each in REFERENCES.items()}
    values = {names[c] + DEGREES_SUFFIX * is_angle(c): value for c, value in once.items()}
    if "azimuth" in known and (offset := magnetic_offset(metadata, _NAME)):
        known["azimuth"] = wrap(known["azimuth"] - np.radians(offset), 2 * np.pi)
    return known | _known(values, shape)


def _uncertainties(sd: Mapping[str, ArrayLike], shape: tuple[int, ...]) -> dict[str, Array]:
    """Standard uncertainties by name in inside units; unknown ones of references are zero."""
    limits = {name: RAW_SPREAD._replace(positive=True) for name in TRIADS}
    limits |= {name: reference.uncertainty for name, reference in REFERENCES.items()}
    limits |= dict.fromkeys(COMMON, Range(0.0, 180.0, "°"))
    limits |= dict.fromkeys(WALKS, RAW_SPREAD)
    uncertainties = {}
    for name, key in _by_name(sd, limits).items():
        label, advice = f"sd {key}", "State one standard uncertainty."
        if name in TRIADS:
            values = _broadcast(label, sd[key], (*shape, 3))
            _refuse(np.isnan(values), label, values, "a number", advice, axis=-2)
            uncertainties[name] = _within(label, values, limits[name], advice, axis=-2)
            continue
        values = np.nan_to_num(_broadcast(label, sd[key], shape))
        uncertainties[name] = _converted(label, values, limits[name], advice)
    return uncertainties


def _labels(name: str, values: Sequence[object], shape: tuple[int, ...]) -> list[str]:
    """One label for each station; blank for None and NaN, and for a negative number of a group."""
    cells = [] if isinstance(values, str) or not isinstance(values, Iterable) else list(values)
    if len(cells) != shape[-1]:
        got = len(cells) or repr(values)
        raise InputError(
            f"`{name}` must have one value for each of {shape[-1]} stations; got {got}."
        )
    least = 0 if name == "group" else -np.inf
    return [_label(cell, least) for cell in cells]


def _label(cell: Any, least: float) -> str:
    """A label as text; blank for None, what is masked, NaN and numbers below `least`; whole numbers without a point."""
    if cell is None or cell is np.ma.masked:
        return ""
    if not isinstance(cell, int | float | np.number):
        return str(cell)
    return f"{cell:.15g}" if cell >= least else ""
