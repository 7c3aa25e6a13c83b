"""WITSML trajectories: stations with raw readings, read in versions 1.3.1.1 and 1.4.1.1, written in 1.4.1.1.

Raw axial is az and mz, transverse 1 is ax and mx, transverse 2 is ay and my. A column that is an
element of a station is written as that element, any other one as an extension (name and value), so
that nothing is lost. Elements of another program beyond md, raw readings and references are
kept under the name of its element, verbatim.
"""

from __future__ import annotations

import html
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.exchange import description, xml
from mwdcal.files.exchange.description import TableDescription
from mwdcal.files.exchange.witsml_reader import MOST_ELEMENTS, Station, Trajectory, read_trajectory
from mwdcal.files.exchange.witsml_schema import (
    NAMESPACE,
    OF_STATION,
    OF_TRAJECTORY,
    UOM_OF_LENGTH,
    UOM_OF_UNIT,
    Leaf,
    converted,
)
from mwdcal.files.formats.columns import MAX_COLUMNS, Column, Parts, at_most, no_stations, number

_LENGTHS = {
    "md": "md",
    "tvd": "tvd",
    "north": "dispNs",
    "east": "dispEw",
    "vertical_section": "vertSect",
}
"""Beginnings of columns of lengths that are elements of a station."""
_AXES = {"n": "N", "e": "E", "v": "Vert"}
_STATUSES = {"definitive": "position", "rejected": "rejected", "superseded": "open"}
"""Words of the column `status`, and of the element; a column keeps the word itself, in an extension."""
_OURS = {
    **{f"{n}_{u}": (e, UOM_OF_LENGTH[u]) for n, e in _LENGTHS.items() for u in UOM_OF_LENGTH},
    **{
        f"covariance_{a}{b}_{u}2": (
            f"matrixCov/variance{_AXES[a]}{_AXES[b]}",
            f"{UOM_OF_LENGTH[u]}2",
        )
        for a, b in ("nn", "ne", "nv", "ee", "ev", "vv")
        for u in ("m", "ft")
    },
    "inclination_deg": ("incl", "dega"),
    "magnetic_toolface_deg": ("mtf", "dega"),
    "toolface_deg": ("gtf", "dega"),
    "sd_gravity_g": ("gravTotalUncert", "gn"),
    "sd_dip_deg": ("dipAngleUncert", "dega"),
    "sd_field_nt": ("magTotalUncert", "nT"),
    "ref_gravity_g": ("gravTotalFieldReference", "gn"),
    "ref_field_nt": ("magTotalFieldReference", "nT"),
    "ref_dip_deg": ("magDipAngleReference", "dega"),
    "field_nt": ("valid/magTotalFieldCalc", "nT"),
    "dip_deg": ("valid/magDipAngleCalc", "dega"),
    "gravity_g": ("valid/gravTotalFieldCalc", "gn"),
}
"""Columns that are elements of a station: path and unit of measure."""
_RAW_ELEMENTS = {
    "accelerometer": ("g", ("gravTran1Raw", "gravTran2Raw", "gravAxialRaw"), ("ax", "ay", "az")),
    "magnetometer": ("nT", ("magTran1Raw", "magTran2Raw", "magAxialRaw"), ("mx", "my", "mz")),
}
"""Raw readings of a triad: the unit they are read in, elements, columns."""
_AZIMUTHS = {
    "azimuth_grid_deg": "grid north",
    "azimuth_true_deg": "true north",
    "azimuth_magnetic_deg": "magnetic north",
    "azimuth_deg": "magnetic north",
}
"""Columns of azimuth, and the north that each counts from; the first one present is the element."""
_READ = ("md_m", "ref_gravity_g", "ref_field_nt", "ref_dip_deg")
"""Columns beside the raw readings that a file of another program gives."""
_NAMES = {"nameWell": "well", "nameWellbore": "wellbore", "name": "trajectory"}
"""Metadata that are names; attributes of the trajectory go by `_UIDS`."""
_UIDS = {"uidWell": "uid_well", "uidWellbore": "uid_wellbore", "uid": "uid_trajectory"}
_CARRIED = re.compile(r"witsml ([A-Za-z0-9/]+)(?: \((\S+)\))?")
_EXTENSION = "mwdcal metadata"
_LONGEST_UID = 64
_KIND, _NEAR_VERTICAL = "toolface_kind", "magnetic"
"""The column that says which kind of toolface a station has, and one of its words."""
_TYPE = "typeTrajStation"
_NO_TYPE = ("unknown", "")


class _Place(NamedTuple):
    """Where a column stands in a station: an element with its unit of measure.

    Attributes:
        magnetic: the element of stations whose toolface is magnetic, where that may be another one.
    """

    path: str
    uom: str = ""
    magnetic: str = ""

    def of(self, kind: str) -> str:
        """The element at a station with a toolface of this kind."""
        return self.magnetic if self.magnetic and kind == _NEAR_VERTICAL else self.path

    def leaf(self, station: Station) -> Leaf | None:
        """The element in a station that has been read."""
        return station.leaves.get(self.path) or station.leaves.get(self.magnetic)


def parse(data: bytes, source: str) -> Parts:
    """The stations of the trajectory in the bytes of a WITSML file."""
    trajectory = read_trajectory(data, source)
    if not trajectory.stations:
        raise no_stations(source)
    stated = [(leaf.line, leaf.text.strip()) for leaf in trajectory.extensions.get(_EXTENSION, ())]
    metadata, described = description.read(stated, source)
    if described is None:
        metadata = _metadata(trajectory)
        columns = _foreign(trajectory.stations, source)
    else:
        columns = _described(trajectory.stations, described, metadata, source)
    return Parts(columns, metadata, [station.line for station in trajectory.stations])


def _metadata(trajectory: Trajectory) -> dict[str, object]:
    """Remarks of another program's file on its trajectory, in the words of the file but for names."""
    leaves = {path: leaf for path, leaf in trajectory.leaves.items() if leaf.text.strip()}
    named = {_NAMES[path]: leaf.text.strip() for path, leaf in leaves.items() if path in _NAMES}
    uids = {_UIDS[name]: uid for name, uid in trajectory.uids.items() if name in _UIDS}
    others = {
        _name(path, leaf.uom): leaf.text.strip()
        for path, leaf in leaves.items()
        if path not in _NAMES
    }
    units = {description.UNITS[kind]: unit for kind, (unit, _, _) in _RAW_ELEMENTS.items()}
    return {**named, **uids, **others, **units}


def _name(path: str, uom: str) -> str:
    return f"witsml {path} ({uom})" if uom else f"witsml {path}"


def _foreign(stations: Sequence[Station], source: str) -> dict[str, Column]:
    """Columns of a file of another program: ours where we know the element, else the file's words."""
    known = {place.path: (name, place.uom) for name, place in _places(_READ, {}).items()}
    for unit, elements, names in _RAW_ELEMENTS.values():
        uom = UOM_OF_UNIT[unit]
        known |= {f"rawData/{e}": (n, uom) for e, n in zip(elements, names, strict=True)}
    columns: dict[str, Column] = {}
    if any(station.uid for station in stations):
        columns["station"] = [station.uid for station in stations]
    for path, (name, uom) in known.items():
        leaves = [station.leaves.get(path) for station in stations]
        if any(leaves):
            columns[name] = np.array([_value(leaf, uom, source) for leaf in leaves])
    others = [dict(_verbatim(station, known)) for station in stations]
    carried = dict.fromkeys(name for cells in others for name in cells)
    _check(len(columns) + len(carried), len(stations), source)
    return {**columns, **{name: [cells.get(name, "") for cells in others] for name in carried}}


def _verbatim(station: Station, known: Container[str]) -> Iterator[tuple[str, str]]:
    """Columns and cells of what a station says in elements that are not known."""
    extensions = {f"extension {name}": leaf for name, leaf in station.extensions.items()}
    for path, leaf in {**station.leaves, **extensions}.items():
        if path not in known and leaf.text.strip():
            yield _name(path, leaf.uom), leaf.text.strip()


def _check(columns: int, rows: int, source: str) -> None:
    at_most(columns, MAX_COLUMNS, source, "a table", "columns", "Is this a trajectory?")
    description.check_size(columns, rows, source)


def _value(leaf: Leaf | None, uom: str, source: str) -> float:
    """The number of an element in a unit of measure; NaN where there is no element."""
    return np.nan if leaf is None or not leaf.text.strip() else converted(leaf, uom, source)


def _described(
    stations: Sequence[Station],
    described: TableDescription,
    metadata: Mapping[str, object],
    source: str,
) -> dict[str, Column]:
    """Columns of a file that was written from a table."""
    names = described.columns
    if len(set(names)) < len(names):
        raise description.unfit(source)
    _check(len(names), len(stations), source)
    places = _places(names, metadata)
    columns: dict[str, Column] = {}
    for name in names:
        if name == "station" and described.labelled:
            columns[name] = [station.uid for station in stations]
            continue
        place = places.get(name)
        leaves = [
            place.leaf(station) if place else station.extensions.get(name) for station in stations
        ]
        if name in described.texts:
            columns[name] = [leaf.text if leaf else "" for leaf in leaves]
        else:
            columns[name] = np.array(
                [_value(leaf, place.uom if place else "", source) for leaf in leaves]
            )
    return columns


def _places(names: Sequence[str], metadata: Mapping[str, object]) -> dict[str, _Place]:
    """The elements that columns are written to; a column without one is an extension."""
    magnetic = metadata.get("field_unit", "nT") == "nT"
    first = {_OURS[name][0]: name for name in reversed(names) if name in _OURS}
    places = {
        name: _Place(*_OURS[name])
        for name in names
        if name in first.values()
        and (magnetic or _OURS[name][1] != "nT" or name.startswith("ref_"))
    }
    if _KIND in names and "toolface_deg" in places:
        places["toolface_deg"] = _Place(*_OURS["toolface_deg"], _OURS["magnetic_toolface_deg"][0])
        if "magnetic_toolface_deg" in names:  # the element is taken
            del places["toolface_deg"]
    if azimuth := _azimuth(names):
        places[azimuth] = _Place("azi", "dega")
    for kind, (_, elements, channels) in _RAW_ELEMENTS.items():
        uom = UOM_OF_UNIT.get(str(metadata.get(description.UNITS[kind])))
        if uom and set(channels) <= set(names):
            places |= {
                c: _Place(f"rawData/{e}", uom) for c, e in zip(channels, elements, strict=True)
            }
    taken = {path for place in places.values() for path in (place.path, place.magnetic)}
    for name in names:
        carried = _CARRIED.fullmatch(name)
        if carried and carried[1] in OF_STATION and carried[1] not in taken:
            places[name] = _Place(carried[1], carried[2] or "")
            taken.add(carried[1])
    return places


def _azimuth(names: Sequence[str]) -> str:
    return next((name for name in _AZIMUTHS if name in names), "")


def render(columns: Mapping[str, Column], metadata: Mapping[str, object], source: str) -> bytes:
    """The bytes that `parse` turns back into the same columns and metadata."""
    names = list(columns)
    _check_writable(columns, source)
    labels = columns.get("station", [])
    labelled = isinstance(labels, list) and _are_uids(labels)
    described = TableDescription(
        columns=names, texts=description.texts(columns), labelled=labelled and "station" in columns
    )
    places = _places(names, metadata)
    cells = {name: _cells(column) for name, column in columns.items()}
    count = len(next(iter(cells.values())))
    uids = labels if described.labelled else [str(row) for row in range(1, count + 1)]
    if described.labelled:
        del cells["station"]
    body = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<trajectorys xmlns="{NAMESPACE}" version="1.4.1.1">',
        *_head(metadata, _azimuth(names), source),
    ]
    for row, uid in enumerate(uids):
        body += _station(
            str(uid), {name: each[row] for name, each in cells.items()}, places, columns
        )
    body.append("<commonData>")
    for place, line in enumerate(description.lines(metadata, described, source), 1):
        body.append(_extension(f"metadata-{place}", _EXTENSION, line, "string"))
    body += ["</commonData>", "</trajectory>", "</trajectorys>", ""]
    text = "\n".join(body)
    advice = "Write CSV or Parquet."
    at_most(text.count("</"), MOST_ELEMENTS, source, "a trajectory", "elements", advice)
    return text.encode()


def _check_writable(columns: Mapping[str, Column], source: str) -> None:
    """Refuse a table without depths, and text and numbers that XML cannot hold."""
    depths = next(
        (columns[n] for n, (path, _) in _OURS.items() if path == "md" and n in columns), None
    )
    if depths is None or isinstance(depths, list) or np.isnan(depths).any():
        raise InputError(
            f"{source}: every station of a WITSML trajectory must have a measured depth in the column 'md_m'. "
            "Add it, or write CSV or Parquet."
        )
    for name, column in columns.items():
        texts = [name, *column] if isinstance(column, list) else [name]
        bad = next(filter(xml.UNWRITABLE.search, texts), None)
        if bad is not None:
            raise InputError(
                f"{source}, column {name[:40]!r}: XML has no control characters; got {bad[:40]!r}. Remove them, "
                "or write Parquet."
            )
        if not isinstance(column, list) and np.isinf(column).any():
            raise InputError(f"{source}, column {name[:40]!r}: every number must be finite.")


def _are_uids(labels: Sequence[str]) -> bool:
    """Whether labels can be identifiers: short, without outer blanks, all different."""
    plain = all(
        label and len(label) <= _LONGEST_UID and label == " ".join(label.split())
        for label in labels
    )
    return plain and len(set(labels)) == len(labels)


def _cells(column: Column) -> list[str]:
    return column if isinstance(column, list) else [number(value) for value in column]


def _head(metadata: Mapping[str, object], azimuth: str, source: str) -> Iterator[str]:
    """The opening of the trajectory, its names and what is known of all of its stations."""
    uids = {name: xml.one_line(metadata[key]) for name, key in _UIDS.items() if key in metadata}
    yield "<trajectory" + "".join(f" {n}={_quoted(uid)}" for n, uid in uids.items()) + ">"
    for element, key in _NAMES.items():
        yield _element(element, xml.one_line(metadata.get(key, "unknown")))
    carried = {
        m[1]: (str(v), m[2] or "") for k, v in metadata.items() if (m := _CARRIED.fullmatch(k))
    }
    if azimuth:
        carried["aziRef"] = (_AZIMUTHS[azimuth], "")
    for element in OF_TRAJECTORY:
        if element in carried:
            text, uom = carried[element]
            yield _element(element, xml.one_line(text), uom)


def _station(
    uid: str,
    cells: Mapping[str, str],
    places: Mapping[str, _Place],
    columns: Mapping[str, Column],
) -> Iterator[str]:
    """The lines of a station; a blank cell has no element."""
    yield f"<trajectoryStation uid={_quoted(uid)}>"
    typed = any(place.path == _TYPE for place in places.values())
    elements = {} if typed else {_TYPE: _NO_TYPE}
    status = _STATUSES.get(cells.get("status", "").strip().lower())
    if status:
        elements["statusTrajStation"] = (status, "")
    elements |= {
        place.of(cells.get(_KIND, "")): (cells[name], place.uom)
        for name, place in places.items()
        if cells[name]
    }
    present = [path for path in OF_STATION if path in elements]
    for container, paths in groupby(present, lambda path: path.rpartition("/")[0]):
        lines = [_element(path.rpartition("/")[2], *elements[path]) for path in paths]
        yield from [f"<{container}>", *lines, f"</{container}>"] if container else lines
    for place, (name, cell) in enumerate(cells.items(), 1):
        if name not in places and cell:
            kind = "string" if isinstance(columns[name], list) else "double"
            yield _extension(f"column-{place}", name, cell, kind)
    yield "</trajectoryStation>"


def _element(name: str, text: str, uom: str = "") -> str:
    unit = f" uom={_quoted(uom)}" if uom else ""
    return f"<{name}{unit}>{_escaped(text)}</{name}>"


def _extension(uid: str, name: str, value: str, kind: str) -> str:
    parts = _element("name", name) + _element("value", value) + _element("dataType", kind)
    return f"<extensionNameValue uid={_quoted(uid)}>{parts}</extensionNameValue>"


def _escaped(text: str) -> str:
    return html.escape(text, quote=False).replace("\r", "&#13;")


def _quoted(text: str) -> str:
    return f'"{html.escape(text)}"'
