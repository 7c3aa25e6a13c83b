"""A table and a tool profile to `Readings`, and back: every conversion of unit and axis.

Raw channels become nominal g and nT along the tool axes, nominal = P (raw / scale); degrees
become radians; true and grid azimuths become magnetic ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings, fingerprints, group_numbers
from mwdcal.errors import InputError
from mwdcal.files import synonyms
from mwdcal.files.azimuths import magnetic_offset
from mwdcal.files.contract import (
    CHANNELS,
    COLUMNS,
    RAW_RANGE,
    RAW_SPREAD,
    REFERENCES,
    TEMPERATURE,
    Range,
    check_columns,
)
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table, cell_error, labels, numbers, shown
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.sensor.profile import Profile, TriadProfile


class BlankReadingError(InputError):
    """A blank cell among readings or temperatures: `apply` may leave the results of its row blank."""


MANY = 1000
"""Rows of a table with times from which it is a log."""
_TURN = 360.0


def read_run(
    path: str | os.PathLike[str], profile: Profile, *, decimal: str = "."
) -> tuple[Readings, Profile]:
    """The readings of a run file, and the profile with its nominal scales filled in."""
    table = tables.read(path, decimal=decimal)
    check_run(table)
    return to_readings(table, profile)


def check_run(table: Table) -> None:
    """Refuse a table of several tools, a continuous log, and references under other names."""
    names = list(table.columns)
    check_columns(names, table.source)
    synonyms.check_evidence(names, table.source)
    found = serials(table.metadata, _serial_cells(table))
    if len(found) > 1:
        raise InputError(
            f"{table.source} has rows of more than one tool (serial {', '.join(found)}). Take the "
            "rows of one, or use mwdcal fleet."
        )
    if table.count > MANY and ("time_s" in table.columns or "sampling_hz" in table.metadata):
        raise InputError(
            f"{table.source} is a continuous log ({table.count} rows): its rows are no stations. Find "
            f"the standstills first: mwdcal stations {table.source} -o run.csv. If each row is a "
            "station, remove time_s and sampling_hz."
        )


def serials(metadata: Mapping[str, object], cells: Iterable[str]) -> list[str]:
    """Serials of the tools, that of the metadata first; behind two of them '…' stands for the rest."""
    stated = metadata.get("serial")
    known = dict.fromkeys([*([] if stated is None else [str(stated)]), *filter(None, cells)])
    return [*[*known][:2], *["…"] * (len(known) > 2)]


def identified(metadata: Mapping[str, object], cells: Sequence[str]) -> Mapping[str, object]:
    """The metadata, with the serials that cells state beside their own."""
    found = serials(metadata, cells) if cells else []
    return {**metadata, "serial": ", ".join(found)} if found else metadata


def _serial_cells(table: Table) -> list[str]:
    return labels(table, "serial") if "serial" in table.columns else []


def write_run(
    path: str | os.PathLike[str],
    readings: Readings,
    profile: Profile,
    metadata: Mapping[str, object] | None = None,
) -> None:
    """Write readings of one tool as the run file that `read_run` turns back into them."""
    tables.write(path, from_readings(readings, profile, metadata))


def to_readings(table: Table, profile: Profile) -> tuple[Readings, Profile]:
    """The readings of a table, and the profile with its nominal scales filled in.

    Uncertainties of stations and angles that the table leaves blank are the profile's.
    Azimuths are taken as magnetic unless the metadata `azimuth_reference` says otherwise,
    also where the metadata state a declination.
    """
    check_columns(list(table.columns), table.source)
    raw = {kind: _raw(table, kind) for kind in CHANNELS}
    known = _known(table)
    profile = _with_scales(profile, raw, known)
    triads = {kind: values for kind, values in raw.items() if values is not None}
    nominal = {kind: to_nominal(triads[kind], _triad(profile, kind)) for kind in triads}
    temperature = _temperature(table)
    readings = Readings(
        accelerometer=nominal["accelerometer"],
        magnetometer=nominal.get("magnetometer"),
        temperature=temperature,
        known=known,
        sd=_uncertainties(table, profile, list(triads), list(known)),
        group=group_numbers(labels(table, "group") if "group" in table.columns else []),
        station=_stations(table),
        digest=fingerprints([*triads.values()]),
        metadata=identified(table.metadata, _serial_cells(table)),
        source=table.source,
        unused=synonyms.unused(list(table.columns), COLUMNS),
    )
    return readings, profile


def check_references(table: Table, profile: Profile, kinds: list[str]) -> dict[str, Array]:
    """The references of a table; refuses what `to_readings` refuses in them and in triads `kinds`."""
    known = _known(table)
    _uncertainties(table, profile, kinds, list(known))
    return known


def from_readings(
    readings: Readings, profile: Profile, metadata: Mapping[str, object] | None = None
) -> Table:
    """The table of a run of one tool: raw channels and degrees, the inverse of `to_readings`.

    Uncertainties that the profile would fill in on reading are left to it. Without
    `metadata` it is that of the readings.
    """
    metadata = readings.metadata if metadata is None else metadata
    source = readings.source or "run"
    offset = magnetic_offset(metadata, source) if "azimuth" in readings.known else 0.0
    columns: dict[str, Column] = {"station": list(readings.labels)}
    if readings.group is not None:
        columns["group"] = ["" if g < 0 else str(g) for g in readings.group.tolist()]
    if readings.temperature is not None:
        columns["temperature_c"] = np.asarray(readings.temperature, float)
    for kind in CHANNELS:
        columns |= _raw_columns(readings, profile, kind)
    for name in REFERENCES:
        columns |= _reference_columns(readings, profile, name, offset)
    return Table(columns, dict(metadata), source, range(1, readings.count + 1))


def _triad(profile: Profile, kind: str) -> TriadProfile:
    return profile.accelerometer if kind == "accelerometer" else profile.magnetometer


def _ranged(table: Table, name: str, limits: Range) -> Array:
    """A column of numbers, every one within `limits` or blank."""
    values = numbers(table, name)
    low = values <= limits.low if limits.positive else values < limits.low
    outside = np.flatnonzero(low | (values > limits.high))
    if outside.size:
        row = int(outside[0])
        unit = f" {limits.unit}" if limits.unit else ""
        got = f"{shown(float(values[row]))}{unit}"
        problem = f"must be {limits}; got {got}. Check the cell, and the unit of the column."
        raise cell_error(table, name, row, problem)
    return values


def _raw(table: Table, kind: str) -> Array | None:
    """Raw readings of a triad (n, 3) in channel order; None where there is no magnetometer."""
    names = CHANNELS[kind]
    if names[0] not in table.columns:
        return None
    values = np.stack([_ranged(table, name, RAW_RANGE) for name in names], axis=-1)
    blank = np.isnan(values)
    if kind == "magnetometer" and blank.all():
        return None
    _refuse_blank(table, names, blank, "Fill it in, or remove the station.", BlankReadingError)
    return values


def _refuse_blank(
    table: Table,
    names: tuple[str, ...],
    blank: Bools,
    advice: str,
    kind: type[InputError] = InputError,
) -> None:
    """Refuse the first blank cell of the columns `names`; `blank` is (n, columns)."""
    for row, column in np.argwhere(blank)[:1]:
        got = "a blank cell" if names[column] in table.columns else "no such column"
        problem = f"must be filled in; got {got}. {advice}"
        raise kind(str(cell_error(table, names[column], int(row), problem)))


def _temperature(table: Table) -> Array | None:
    name = "temperature_c"
    if name not in table.columns:
        return None
    values = _ranged(table, name, TEMPERATURE)
    blank = np.isnan(values)
    if blank.all():
        return None
    advice = "Fill it in, or leave the whole column blank."
    _refuse_blank(table, (name,), blank[:, None], advice, BlankReadingError)
    return values


def _known(table: Table) -> dict[str, Array]:
    """Reference values by name, in radians, g and nT; a wholly blank column is no reference."""
    known = {}
    for name, reference in REFERENCES.items():
        if reference.column not in table.columns:
            continue
        values = _ranged(table, reference.column, reference.values)
        if name == "azimuth":
            values = values - magnetic_offset(table.metadata, table.source)
        if name in ("azimuth", "toolface"):
            values = _turned(values)
        if not np.isnan(values).all():
            known[name] = values * reference.factor
    return known


def _turned(angle: Array) -> Array:
    """The angle in 0..360 degrees; those already there keep every digit."""
    outside = (angle < 0.0) | (angle >= _TURN)
    return np.where(outside, np.mod(angle, _TURN), angle)


def to_nominal(raw: Array, triad: TriadProfile) -> Array:
    """Nominal field along the tool axes (n, 3) of raw channels (n, 3)."""
    return (raw / (triad.scale or 1.0)) @ triad.permutation.T


def _with_scales(
    profile: Profile, raw: Mapping[str, Array | None], known: Mapping[str, Array]
) -> Profile:
    """The profile with the scales it does not state estimated from the readings."""
    strength = {
        "accelerometer": np.nan_to_num(known.get("gravity", np.ones(1)), nan=1.0).mean(),
        "magnetometer": np.nanmean(known.get("field", np.ones(1))),
    }
    filled = {}
    for kind, values in raw.items():
        triad = _triad(profile, kind)
        if triad.scale is None and values is not None:
            scale = _radius(values) / float(strength[kind])
            filled[kind] = msgspec.structs.replace(triad, scale=scale)
    return msgspec.structs.replace(profile, **filled)


def _radius(raw: Array) -> float:
    """Median distance from the midpoint of the channels' ranges.

    Where nothing moves (a single station) it is the distance from zero; readings that are
    all zero count as one: whether the channels are alive is decided where they are fitted.
    """
    midpoint = (raw.min(axis=0) + raw.max(axis=0)) / 2.0
    for origin in (midpoint, 0.0):
        distance = float(np.median(np.linalg.norm(raw - origin, axis=-1)))
        if distance > 0.0:
            return distance
    return 1.0


def _uncertainties(
    table: Table, profile: Profile, kinds: list[str], known: list[str]
) -> dict[str, Array]:
    """Standard uncertainties: of the triads, and of the references the run has."""
    sd = {}
    for kind in kinds:
        spread = _triad_spread(table, kind, _triad(profile, kind))
        if spread is not None:
            sd[kind] = spread
    for name in dict.fromkeys([*known, "gravity"]):
        spread = _reference_spread(table, profile, name, name in known or name == "gravity")
        if spread.any():
            sd[name] = spread
    return sd | common_errors(profile, (table.count,))


def common_errors(profile: Profile, shape: tuple[int, ...]) -> dict[str, Array]:
    """Standard uncertainties of errors that all stations of the stand share, radians."""
    return {name: np.full(shape, np.radians(sd)) for name, sd in profile.stand.common().items()}


def _triad_spread(table: Table, kind: str, triad: TriadProfile) -> Array | None:
    """Nominal standard uncertainty along the tool axes (n, 3); None where nothing is stated."""
    names = tuple(f"sd_{name}" for name in CHANNELS[kind])
    noise = np.stack([_spread(table, name, RAW_SPREAD) for name in names], axis=-1)
    if triad.noise is not None:
        noise = np.where(np.isnan(noise), triad.noise, noise)
    blank = np.isnan(noise)
    if blank.all():
        return None
    advice = f"Fill it in, or state `noise` under [{kind}] in the tool profile."
    _refuse_blank(table, names, blank, f"Other sd_ cells of the {kind} are filled. {advice}")
    total = np.hypot(noise, triad.repeatability)
    for row, column in np.argwhere(total == 0.0)[:1]:
        problem = f"must be above 0; got 0. State the noise of the {kind}, or leave it blank."
        raise cell_error(table, names[column], int(row), problem)
    return (total / (triad.scale or 1.0)) @ np.abs(triad.permutation.T)


def _spread(table: Table, name: str, limits: Range) -> Array:
    """A column of standard uncertainties; blank where the table has none."""
    if name not in table.columns:
        return np.full(table.count, np.nan)
    return _ranged(table, name, limits)


def _reference_spread(table: Table, profile: Profile, name: str, given: bool) -> Array:
    """Standard uncertainty (n,) of a reference: the table's, else the stand's, else zero."""
    values = _spread(table, f"sd_{REFERENCES[name].column}", REFERENCES[name].spread)
    return reference_spread(profile, name, values, given)


def reference_spread(profile: Profile, name: str, stated: Array, given: bool) -> Array:
    """Standard uncertainty of a reference: as `stated`, NaN taking the stand's if it is `given`.

    With the repeatability of the stand added. Units inside.
    """
    factor, quantity = REFERENCES[name].factor, _quantity(name)
    stand = profile.stand.of(quantity) if given else 0.0
    sd = np.where(np.isnan(stated), stand, stated)
    return np.hypot(sd, profile.stand.repeatability(quantity)) * factor


def _quantity(name: str) -> str:
    """A reference with its unit, as in `azimuth_deg`."""
    return REFERENCES[name].column.removeprefix("ref_")


def _stations(table: Table) -> tuple[str, ...]:
    """Labels of the stations; a blank one is the number of its row."""
    given = labels(table, "station") if "station" in table.columns else [""] * table.count
    return tuple(label or str(i) for i, label in enumerate(given, 1))


def _raw_columns(readings: Readings, profile: Profile, kind: str) -> dict[str, Column]:
    """The three channels of a triad, and their noise where the profile does not state it."""
    nominal = getattr(readings, kind)
    if nominal is None:
        return {}
    triad = _triad(profile, kind)
    scale = triad.scale or 1.0
    raw = nominal @ triad.permutation * scale
    columns: dict[str, Column] = dict(zip(CHANNELS[kind], raw.T, strict=True))
    if kind in readings.sd:
        total = readings.sd[kind] @ np.abs(triad.permutation) * scale
        if triad.noise is None or not np.allclose(
            total, np.hypot(triad.noise, triad.repeatability), rtol=1e-12, atol=0.0
        ):
            noise = np.sqrt(np.maximum(total**2 - triad.repeatability**2, 0.0))
            names = (f"sd_{name}" for name in CHANNELS[kind])
            columns |= dict(zip(names, np.broadcast_to(noise, raw.shape).T, strict=True))
    return columns


def _reference_columns(
    readings: Readings, profile: Profile, name: str, offset: float
) -> dict[str, Column]:
    """A reference and its uncertainty, where the profile does not state the same one."""
    reference = REFERENCES[name]
    columns: dict[str, Column] = {}
    if name in readings.known:
        known = np.broadcast_to(readings.known[name], (readings.count,))
        values = known / reference.factor + (offset if name == "azimuth" else 0.0)
        columns[reference.column] = (
            _turned(values) if name == "azimuth" else _trimmed(values, reference.values)
        )
    if name in readings.sd and (columns or name == "gravity"):
        spread = readings.uncertainty(name)
        given = bool(columns) or name == "gravity"
        usual = reference_spread(profile, name, np.array(np.nan), given)
        if not np.allclose(spread, usual, rtol=1e-12, atol=0.0):
            repeated = profile.stand.repeatability(_quantity(name))
            own = (spread / reference.factor) ** 2 - repeated**2
            columns[f"sd_{reference.column}"] = np.sqrt(np.maximum(own, 0.0))
    return columns


def _trimmed(values: Array, limits: Range) -> Array:
    """The values without what rounding carried over the ends of the accepted range."""
    inside = np.clip(values, limits.low, limits.high)
    return np.where(np.isclose(values, inside, rtol=0.0, atol=1e-9), inside, values)
