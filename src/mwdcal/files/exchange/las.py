"""LAS 2.0 (and 1.2): raw channels by depth, one curve for each column of numbers.

Headers are read and files are written by lasio, which gets an open file and so never fetches what a
name may point to; the values are read here, as those of a text table. Metadata and text stand in the
section ~Other, in lines as above a text table, as LAS has no place for them.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.exchange import description
from mwdcal.files.exchange.description import TableDescription
from mwdcal.files.formats import text as text_tables
from mwdcal.files.formats.columns import (
    Column,
    Parts,
    at_most,
    check_names,
    damaged_unless_read,
    no_stations,
    shown,
)
from mwdcal.files.synonyms import FACTORS, unit_of
from mwdcal.geometry.units import FOOT

_DEPTHS = ("DEPT", "DEPTH", "MD")
_DEPTH_FACTORS = {"M": 1.0, "METER": 1.0, "METRE": 1.0, "FT": FOOT, "F": FOOT, "FEET": FOOT}
_TEMPERATURES = ("TEMP", "TEMPERATURE", "TEMPERATURE_C")
_FAMILIES = {
    "accelerometer": (("ax", "ay", "az"), ("A", "G"), ("g", "mg", "m/s²")),
    "magnetometer": (("mx", "my", "mz"), ("M", "B", "H"), ("nT", "µT", "mT", "gauss")),
}
"""Columns of a triad, letters that its curves begin with (AX, GX), units that the header may state."""
_UNITS_BY_ENDING = {"_m": "M", "_deg": "DEG", "_g": "G", "_nt": "NT", "_c": "DEGC", "_s": "S"}
_NULLS = (
    *(-999.25, -9999.0, -999999.0, -987654321.0),
    *(float(f"-1.{digits}e300") for digits in range(1001, 1100)),
)
"""What may stand for a blank cell: the first one that is not a value."""
_PARSED = "VWCP"
"""Sections of the header that lasio reads."""
_MOST_LINES_OF_HEADER = 4000
_LONGEST_LINE_OF_HEADER = 2000
_MOST_REPEATS = 50
"""Entries of a section whose mnemonic stands there already: lasio takes time as the cube of these."""
_LEFT_OUT = ("STRT", "STOP", "STEP", "NULL")
_NUMERIC = frozenset("0123456789+-eE.")


class _Sections(NamedTuple):
    """The lines of a file with their numbers: header for lasio, ~Other, values."""

    header: list[str]
    other: list[tuple[int, str]]
    values: list[tuple[int, str]]


class _Curve(NamedTuple):
    name: str
    unit: str


class _Header(NamedTuple):
    """Contents of the header: curves, how values are wrapped, what is blank, and the other entries."""

    curves: list[_Curve]
    wrapped: bool
    null: float
    entries: dict[str, object]


def parse(data: bytes, source: str) -> Parts:
    """The table in the bytes of a LAS file."""
    text_tables.refuse_foreign(data, source)
    sections = _sections(_decoded(data, source), source)
    header = _header(sections.header, source)
    rows, lines = _rows(sections.values, len(header.curves), header.wrapped, source)
    if not rows:
        raise no_stations(source)
    columns = [_column(cells, header.null) for cells in zip(*rows, strict=True)]
    stated = [(line, text) for line, text in sections.other if text.startswith("#")]
    marked = any(description.DESCRIBED in text for _, text in stated)
    metadata, described = description.read(stated if marked else (), source)
    if described is None:
        named, units = _foreign(header.curves, columns, source)
        return Parts(named, {**header.entries, **units}, lines)
    return Parts(_described(described, header.curves, columns, source), metadata, lines)


def _decoded(data: bytes, source: str) -> str:
    if b"\0" in data:
        raise InputError(f"{source}: expected a LAS file, which is text; got a NUL byte.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:  # names in the header, by older programs
        return data.decode("latin-1")


def _sections(text: str, source: str) -> _Sections:
    """The lines of the file by section."""
    result = _Sections([], [], [])
    kind, seen, repeats = "", set[tuple[str, str]](), 0
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        line = line.strip()
        if line.startswith("~"):
            kind = line[1:2].upper()
            if kind in _PARSED:
                result.header.append(line)
        elif kind == "A" and line and not line.startswith("#"):
            result.values.append((number, line))
        elif kind == "O":
            result.other.append((number, line))
        elif kind and kind in _PARSED:
            what = f"{source}, line {number}"
            advice = "Is this a LAS file?"
            at_most(len(line), _LONGEST_LINE_OF_HEADER, what, "the line", "characters", advice)
            entry = kind, re.split("[.:]", line, maxsplit=1)[0].strip()
            repeats += entry in seen and not line.startswith("#") and line != ""
            at_most(
                repeats,
                _MOST_REPEATS,
                what,
                "the header",
                "repeated mnemonics",
                "Give each its own.",
            )
            seen.add(entry)
            result.header.append(line)
    advice = "Remove sections that are not needed."
    at_most(len(result.header), _MOST_LINES_OF_HEADER, source, "the header", "lines", advice)
    if not any(line[1:2].upper() == "C" for line in result.header if line.startswith("~")):
        raise InputError(
            f"{source}: expected a LAS file with the sections ~Version, ~Well, ~Curve and ~ASCII; it has no "
            "section ~Curve. Export the log as LAS 2.0."
        )
    return result


def _module(source: str) -> Any:
    lasio = extras.load("lasio", f"{source}: a LAS file", "survey")
    logging.getLogger("lasio").addHandler(logging.NullHandler())
    return lasio


def _header(lines: Sequence[str], source: str) -> _Header:
    """The header as lasio reads it."""
    lasio = _module(source)
    with damaged_unless_read(source, "the header of a LAS 2.0 file", "Export the log again."):
        file = lasio.read(
            io.StringIO("\n".join(lines) + "\n"), ignore_data=True, mnemonic_case="preserve"
        )
        version = file.version.VERS.value if "VERS" in file.version else None
        wrapped = "WRAP" in file.version and str(file.version.WRAP.value).upper() == "YES"
        null = file.well.NULL.value if "NULL" in file.well else None
        curves = [_Curve(curve.original_mnemonic.strip(), curve.unit) for curve in file.curves]
        items = [item for section in (file.well, file.params) for item in section]
        entries = _entries(items) | _serial(lines, lasio)
    if version not in (1.2, 2.0):
        raise InputError(
            f"{source}: the file must be LAS 2.0 or 1.2; got version {shown(str(version))}. Export the log as "
            "LAS 2.0."
        )
    names = [curve.name for curve in curves]
    check_names(names, f"{source}, section ~Curve")
    number = float(null) if isinstance(null, int | float | np.number) else np.nan
    return _Header(curves, wrapped, number, meta.plain(entries, source))


def _entries(items: Sequence[Any]) -> dict[str, object]:
    """The sections ~Well and ~Parameter as metadata."""
    entries: dict[str, object] = {}
    for item in items:
        value = item.value.item() if isinstance(item.value, np.generic) else item.value
        if item.original_mnemonic in (*_LEFT_OUT, "SERIAL") or value is None or value == "":
            continue
        unit = f" ({item.unit})" if item.unit else ""
        entries[f"las {item.mnemonic}{unit}"] = value
    renamed = {"las WELL": "well"}
    return {renamed.get(key, key): value for key, value in entries.items()}


def _serial(lines: Sequence[str], lasio: Any) -> dict[str, object]:
    """The serial as the header writes it: lasio makes a number of 12.10."""
    stated = [line for line in lines if re.match(r"SERIAL *\.", line)]
    values = [lasio.reader.read_header_line(line)["value"] for line in stated]
    return {"serial": values[-1]} if any(values) else {}


def _rows(
    values: Sequence[tuple[int, str]], width: int, wrapped: bool, source: str
) -> tuple[list[list[str]], list[int]]:
    """Rows of cells, and the number of the line in which each begins."""
    if wrapped:
        cells = [(number, cell) for number, line in values for cell in line.split()]
        if len(cells) % width:
            raise InputError(
                f"{source}: the section ~ASCII must have {width} values for each depth; got {len(cells)} in all. "
                "Is the file complete?"
            )
        description.check_size(width, len(cells) // width, source)
        starts = range(0, len(cells), width)
        return [[c for _, c in cells[i : i + width]] for i in starts], [cells[i][0] for i in starts]
    description.check_size(width, len(values), source)
    rows = []
    for number, line in values:
        row = line.split(maxsplit=width)
        if len(row) != width:
            raise InputError(
                f"{source}, line {number}: expected {width} values, one for each curve; got "
                f"{len(line.split())}. Correct the line, or the section ~Curve."
            )
        rows.append(row)
    return rows, [number for number, _ in values]


def _column(cells: Sequence[str], null: float) -> Column:
    """The cells as numbers, blank where they are the header's NULL; as text if one is no plain number."""
    if set(chain.from_iterable(cells)) <= _NUMERIC:
        try:
            values = np.array(cells).astype(float)
        except ValueError:
            return list(cells)
        return np.where(values == null, np.nan, values)
    return ["" if cell == f"{null:g}" else cell for cell in cells]


def _described(
    described: TableDescription, curves: Sequence[_Curve], columns: Sequence[Column], source: str
) -> dict[str, Column]:
    """The columns of a file that was written from a table."""
    names = _in_order([name for name in described.columns if name not in described.texts])
    lengths = {len(cells) for cells in described.cells.values()}
    stated = [(_mnemonic(name), name == "md_m") for name in names]
    if (
        stated
        != [(curve.name, curve.unit == "M") for curve in curves[:1]]
        + [(curve.name, False) for curve in curves[1:]]
        or {*described.texts} != {*described.cells}
        or lengths - {len(columns[0])}
        or len({*described.columns}) < len(described.columns)
    ):
        raise description.unfit(source)
    numbers = dict(zip(names, columns, strict=True))
    return {name: described.cells.get(name, numbers.get(name, [])) for name in described.columns}


def _in_order(names: Sequence[str]) -> list[str]:
    """Columns of numbers as curves: depth is the first."""
    return sorted(names, key=lambda name: name != "md_m")


def _mnemonic(name: str) -> str:
    return "DEPT" if name == "md_m" else re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"


def _foreign(
    curves: Sequence[_Curve], columns: Sequence[Column], source: str
) -> tuple[dict[str, Column], dict[str, str]]:
    """The columns of another program's file under our names where they have one, and units of raw channels."""
    theirs = dict(zip(curves, columns, strict=True))
    by_name = {curve.name.upper(): curve for curve in curves}
    renamed: dict[str, str] = {}
    units: dict[str, str] = {}
    for kind, (ours, letters, allowed) in _FAMILIES.items():
        families = ([f"{letter}{axis}" for axis in "XYZ"] for letter in letters)
        family = next((f for f in families if {*f} <= {*by_name}), None)
        if family is None:
            continue
        members = [by_name[name] for name in family]
        renamed |= {curve.name: name for curve, name in zip(members, ours, strict=True)}
        stated = {unit_of(curve.unit.lower()) for curve in members}
        if len(stated) == 1 and stated <= {*allowed}:
            units[description.UNITS[kind]] = stated.pop()
    result: dict[str, Column] = {}
    for place, (curve, column) in enumerate(theirs.items()):
        name = renamed.get(curve.name, curve.name)
        if place == 0 and curve.name.upper() in _DEPTHS:
            name, column = "md_m", _depths(curve, column, source)
        elif curve.name.upper() in _TEMPERATURES and not isinstance(column, list):
            name, column = _temperature(curve, column)
        result[name] = column
    check_names([*result], source)
    return result, units


def _depths(curve: _Curve, column: Column, source: str) -> Column:
    """Depths in metres."""
    if curve.unit.upper() not in _DEPTH_FACTORS:
        raise InputError(
            f"{source}, section ~Curve: the unit of {shown(curve.name)} must be M or FT; got {shown(curve.unit)}. "
            "State it, as in DEPT.M."
        )
    factor = _DEPTH_FACTORS[curve.unit.upper()]
    return column if isinstance(column, list) or factor == 1.0 else column * factor


def _temperature(curve: _Curve, column: Any) -> tuple[str, Column]:
    """Temperatures in °C; under their own name where the header states no unit of temperature."""
    unit = unit_of(curve.unit.lower().replace("deg", "°")) or unit_of(curve.unit)
    if unit == "°C":
        return "temperature_c", column
    if unit in ("°F", "K"):
        factor, offset = FACTORS[unit]
        return "temperature_c", column * factor + offset
    return curve.name, column


def render(columns: Mapping[str, Column], metadata: Mapping[str, object], source: str) -> bytes:
    """The bytes that `parse` turns back into the same columns and metadata."""
    lasio = _module(source)
    texts = description.texts(columns)
    cells = {name: [*map(str, columns[name])] for name in texts}
    described = TableDescription(columns=list(columns), texts=texts, cells=cells)
    names = _in_order([name for name in columns if name not in texts])
    curves = {name: np.asarray(columns[name], float) for name in names}
    _check_depths(curves, source)
    file = lasio.LASFile()
    _fill_header(file, curves, metadata, source)
    for name, values in curves.items():
        file.append_curve(_mnemonic(name), values, _unit(name, metadata), descr=_plain(name))
    file.other = "\n".join(description.lines(metadata, described, source))
    depths = curves["md_m"]
    steps = np.diff(depths)
    even = len(steps) and (steps == steps[0]).all()
    stream = io.StringIO()
    file.write(
        stream, version=2, wrap=False, fmt="%s", len_numeric_field=-1,
        STRT=float(depths[0]), STOP=float(depths[-1]), STEP=float(steps[0]) if even else 0.0,
    )  # fmt: skip
    return stream.getvalue().encode()


def _check_depths(curves: Mapping[str, Any], source: str) -> None:
    """Refuse a table without depths, and numbers that LAS cannot hold."""
    if "md_m" not in curves or np.isnan(curves["md_m"]).any():
        raise InputError(
            f"{source}: every row of a LAS file must have a measured depth in the column 'md_m'. Add it, or write "
            "CSV or Parquet."
        )
    for name, values in curves.items():
        if np.isinf(values).any():
            raise InputError(f"{source}, column {shown(name)}: every number must be finite.")


def _fill_header(
    file: Any, curves: Mapping[str, Any], metadata: Mapping[str, object], source: str
) -> None:
    """What other programs look for: the well, the tool, and what stands for a blank cell."""
    present = np.concatenate(list(curves.values()))
    free = [null for null in _NULLS if not (present == null).any()]
    if not free:
        raise InputError(
            f"{source}: every value that may stand for a blank cell is a reading. Write Parquet."
        )
    file.well["NULL"].value = free[0]
    file.well["WELL"].value = _plain(metadata.get("well", ""))
    if "serial" in metadata:
        lasio = _module(source)
        file.params["SERIAL"] = lasio.HeaderItem("SERIAL", value=_plain(metadata["serial"]))


def _unit(name: str, metadata: Mapping[str, object]) -> str:
    """The unit of a column for the header; of a raw channel where the metadata state it."""
    for kind, (ours, _, allowed) in _FAMILIES.items():
        stated = str(metadata.get(description.UNITS[kind], ""))
        if name in ours and stated in allowed:
            return {"m/s²": "M/S2", "µT": "UT"}.get(stated, stated)
    return next((unit for end, unit in _UNITS_BY_ENDING.items() if name.endswith(end)), "")


def _plain(value: object) -> str:
    """Text that a line of the header can hold."""
    return " ".join(re.sub(r"[^\x21-\x39\x3b-\x7e]", " ", str(value)).split())[:100]
