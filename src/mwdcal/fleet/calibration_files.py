"""The calibration file of each tool of a fleet, named by its serial, in a folder of their own."""

from __future__ import annotations

from pathlib import Path

from mwdcal.files import documents
from mwdcal.files.formats import members
from mwdcal.files.formats.folders import file_name, mark_of, whole


def write(table: Path, folder: Path) -> int:
    """Write the calibration file of each tool of a fleet's table, all or none, and count them."""
    taken: set[str] = set()
    with whole(folder) as unfinished:
        for serial, record in members.records(table):
            name = file_name(serial)
            if name.casefold() in taken:
                name = f"{name}{mark_of(serial)}"
            taken.add(name.casefold())
            (unfinished / f"{name}.json").write_bytes(documents.laid_out(record))
    return len(taken)
