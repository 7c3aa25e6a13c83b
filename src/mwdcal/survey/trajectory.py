"""Statements of a trajectory that surveys use: its norths, its tie-in station, and surveys that are not to be used.

A trajectory of another program has them in columns and metadata by the names of its elements (`witsml incl (dega)`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.exchange.witsml_schema import Leaf, converted
from mwdcal.files.formats.columns import as_text
from mwdcal.files.formats.table import Table, cell_error, labels
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.survey.path import TieIn

STATUS_COLUMN = "status"
"""The column that says whether a survey is definitive, rejected or superseded."""
DEFINITIVE, REJECTED, SUPERSEDED = "definitive", "rejected", "superseded"
_ELEMENT = re.compile(r"witsml (\S+)(?: \((\S+)\))?")
_TIE_IN = "tie in point"
_SAG = "corUsed/sagIncCor"
_NORTH_ELEMENTS = {
    "declination_deg": ("magDeclUsed",),
    "convergence_deg": ("gridConUsed", "gridCorUsed"),
}
"""Metadata of ours, and elements of a trajectory: added to magnetic, and taken from true azimuths."""
_TIE_IN_ELEMENTS = {"incl": "dega", "azi": "dega", "dispNs": "m", "dispEw": "m", "tvd": "m"}
"""Elements of a tie-in station beside its measured depth, and their units of measure."""
_VARIANCES = {
    "NN": (0, 0), "NE": (0, 1), "NVert": (0, 2), "EE": (1, 1), "EVert": (1, 2), "VertVert": (2, 2),
}  # fmt: skip


@dataclass(frozen=True)
class TrajectoryFacts:
    """A table with its norths as metadata, the tie-in it states and its row, and which rows (n,) are not to be used."""

    table: Table
    tie_in: TieIn | None
    tie_row: int | None
    unused: Bools
    findings: list[Finding]


def trajectory(table: Table, md: Array | None, without: Bools) -> TrajectoryFacts:
    """The statements of a table with measured depths (n,), m; rows `without` readings may be a tie-in station.

    Raises:
        InputError: an unknown status, or a number of the tie-in station that cannot be read.
    """
    stated, findings = _norths(table)
    table = replace(table, metadata={**stated, **table.metadata})
    tie_in, row, about = _tie_in(table, md, without)
    findings += _sag(table)
    status = _status(table)
    unused = np.isin(status, (REJECTED, SUPERSEDED))
    if unused.any():
        counts = [
            f"{np.sum(status == word)} {word}" for word in (REJECTED, SUPERSEDED) if word in status
        ]
        text = f"{' and '.join(counts)} of {len(status)} surveys are left out of the path, by their status."
        about = [*about, Finding(id="status-left-out", text=text)]
    return TrajectoryFacts(table, tie_in, row, unused, [*findings, *about])


def has_stations(table: Table) -> bool:
    """Whether a table has the types of stations of a trajectory, such as a tie-in station."""
    return "typeTrajStation" in _elements(table.columns)


def _norths(table: Table) -> tuple[dict[str, object], list[Finding]]:
    """Declination and convergence of the trajectory, where its metadata do not state them in our words."""
    there = _elements(table.metadata)
    stated: dict[str, object] = {}
    for key, names in _NORTH_ELEMENTS.items():
        name = next((n for n in names if n in there), "")
        if name and key not in table.metadata:
            uom, full = there[name]
            leaf = Leaf(name, str(table.metadata[full]), uom, 0)
            stated[key] = converted(leaf, "dega", table.source)
    if not stated:
        return {}, []
    words = [f"{key.removesuffix('_deg')} {value:+.4g}°" for key, value in stated.items()]
    text = f"{table.source}: the trajectory's {' and '.join(words)} count; grid azimuths are true less convergence."
    return stated, [Finding(id="norths-of-trajectory", text=text)]


def _sag(table: Table) -> list[Finding]:
    """The finding that a trajectory corrected its inclinations for sag, which results of its raw readings are not."""
    there = _elements(table.columns)
    if _SAG not in there:
        return []
    corrections = [_cell(table, there, _SAG, row, "dega") or 0.0 for row in range(table.count)]
    largest = max(corrections, key=abs, default=0.0)
    if not largest:
        return []
    text = (
        f"{table.source}: the trajectory corrects inclinations for sag, by up to {largest:+.2f}°. mwdcal corrects no "
        "sag: its inclinations are those of the tool."
    )
    return [Finding(id="sag-not-corrected", text=text)]


def _elements(names: Mapping[str, object]) -> dict[str, tuple[str, str]]:
    """Unit of measure and full name of each column or metadata that is an element."""
    matches = ((name, _ELEMENT.fullmatch(name)) for name in names)
    return {match[1]: (match[2] or "", name) for name, match in matches if match}


def _tie_in(
    table: Table, md: Array | None, without: Bools
) -> tuple[TieIn | None, int | None, list[Finding]]:
    """The tie-in station: the first one of that type without readings."""
    there = _elements(table.columns)
    if "typeTrajStation" not in there or md is None:
        return None, None, []
    types = np.array([cell.strip() for cell in _texts(table, there["typeTrajStation"][1])])
    rows = np.flatnonzero((types == _TIE_IN) & without)
    if not rows.size:
        return None, None, []
    row = int(rows[0])
    values = {name: _cell(table, there, name, row, uom) for name, uom in _TIE_IN_ELEMENTS.items()}
    lacking = [name for name, value in values.items() if value is None]
    if lacking or np.isnan(md[row]):
        text = f"{table.source}: the tie-in station lacks {', '.join(lacking) or 'md'}: it is not used. Give `tie_in`."
        return None, row, [Finding(id="tie-in-incomplete", text=text)]
    known = {name: float(value) for name, value in values.items() if value is not None}
    place = np.array([known[name] for name in ("dispNs", "dispEw", "tvd")])
    angles = np.radians([known["incl"], known["azi"]]).tolist()
    covariance = np.zeros((3, 3))
    for name, (i, j) in _VARIANCES.items():
        value = _cell(table, there, f"matrixCov/variance{name}", row, "m2") or 0.0
        covariance[i, j] = covariance[j, i] = value
    if np.linalg.eigvalsh(covariance)[0] < -1e-9 * np.trace(covariance):
        problem = (
            "the covariance of the tie-in station must not be negative. Correct it, or remove it."
        )
        raise InputError(f"{table.source}: {problem}")
    return TieIn(float(md[row]), angles[0], angles[1], place, covariance), row, []


def _texts(table: Table, name: str) -> list[str]:
    cells = table.columns[name]
    return cells if isinstance(cells, list) else [as_text(cell) for cell in cells.tolist()]


def _cell(
    table: Table, there: Mapping[str, tuple[str, str]], name: str, row: int, uom: str
) -> float | None:
    """The number of an element at a row in a unit of measure; None where it is blank."""
    if name not in there:
        return None
    stated, column = there[name]
    text = _texts(table, column)[row].strip()
    return converted(Leaf(name, text, stated, 0), uom, table.source) if text else None


def north_of_tie_in(table: Table) -> str:
    """The north that azimuths of a trajectory count from: magnetic, true or grid; blank where it states none."""
    there = _elements(table.metadata)
    stated = str(table.metadata[there["aziRef"][1]]) if "aziRef" in there else ""
    return stated.removesuffix(" north") if stated.endswith(" north") else ""


def _status(table: Table) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
    """The status (n,) of each survey, blank where it states none."""
    element = _elements(table.columns).get("statusTrajStation")
    if STATUS_COLUMN not in table.columns:
        words = _texts(table, element[1]) if element else [""] * table.count
        return np.array([REJECTED if word.strip() == REJECTED else "" for word in words], str)
    words = [label.lower() for label in labels(table, STATUS_COLUMN)] or [""] * table.count
    for row, word in enumerate(words):
        if word not in ("", DEFINITIVE, REJECTED, SUPERSEDED):
            problem = (
                f"must be {DEFINITIVE}, {REJECTED} or {SUPERSEDED}, or blank; got {word[:40]!r}."
            )
            raise cell_error(table, STATUS_COLUMN, row, problem)
    return np.array(words, str)
