"""One tool out of many, as `cals.parquet#SERIAL` names it in the table of a fleet."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files.formats import parquet
from mwdcal.files.formats.atomic import SQLITE
from mwdcal.files.formats.columns import as_text, shown

RECORD = "calibration"
"""Column of the calibration file of each sound tool, without line breaks."""
MARK = "#"
"""What stands between the file of a fleet's table and a serial."""
SUFFIX = ".parquet"
_NEARLY_URL = re.compile(
    r"postgres\w*(\+\w+)?(:|//)|://|\bpassword *=|[/\\][^/\\]*:.*@|^[^/\\:]{2,}:.*@", re.IGNORECASE
)
"""A mark of a database's URL, however mistyped, and hardly a file's name: it may hold a password."""
_FILE_URL = "sqlite:///"
_SHOWN = 5
"""Most serials that a message names."""
_HEAD = ["serial", "status", "message"]


class Member(NamedTuple):
    """The calibration of a tool as it stands in the table, what to call it, and the table's SHA-256."""

    record: bytes
    name: str
    digest: str


def is_nearly_url(text: str) -> bool:
    """Whether a text that names no file looks like a URL, however mistyped, and may hold a password."""
    if text.startswith(_FILE_URL) or not _NEARLY_URL.search(text):
        return False
    parts = (text, text.partition(MARK)[0])
    return not any(os.path.exists(part) for part in parts)  # noqa: PTH110 - any text, also too long a one


def files_of(inputs: Iterable[str | os.PathLike[str] | None]) -> list[Path]:
    """The files that inputs name, without serials; a database on a server has no file."""
    texts = [os.fspath(each) for each in inputs if each]
    return [split(t.removeprefix(_FILE_URL))[0] for t in texts if not is_nearly_url(t)]


def split(path: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """The file that a path names, and the serial behind it, or None.

    A file that has the whole name is meant by it.

    Raises:
        InputError: the path is the URL of a database.
    """
    text = os.fspath(path)
    if is_nearly_url(text):
        raise InputError(
            "a calibration must be a file, and this looks like the URL of a database. Write the calibration to a "
            "file: mwdcal registry get."
        )
    places = [place for place, character in enumerate(text) if character == MARK]
    for place in [] if Path(text).exists() else places:
        file = Path(text[:place])
        if (file.suffix.lower() == SUFFIX and file.is_file()) or is_database(file):
            return file, text[place + 1 :]
    return Path(text), None


def is_fleet(file: Path) -> bool:
    """Whether a file is a table of calibrations, as `mwdcal fleet` writes it."""
    if file.suffix.lower() != SUFFIX:
        return False
    return RECORD in parquet.opened(file, file.name)[1].names


def without_records(source: str) -> InputError:
    """The refusal of a fleet's table that has figures alone."""
    return InputError(
        f"{source} has no column '{RECORD}', which holds the whole calibration of each tool. Calibrate the fleet "
        "again with it (mwdcal fleet, `records`)."
    )


def is_database(file: Path) -> bool:
    """Whether a file is a database, as a registry is."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(SQLITE)) == SQLITE
    except (OSError, ValueError):
        return False


def name_of(path: str | os.PathLike[str]) -> str:
    """The name of a calibration in messages and documents: its file, with the serial of a tool in it."""
    file, serial = split(path)
    return file.name if serial is None else f"{file.name}{MARK}{serial}"


def read(path: str | os.PathLike[str]) -> Member:
    """The calibration of one tool; of the only one where the path names none.

    Raises:
        InputError: the file is not the table of a fleet, or has no calibration of such a tool.
    """
    file, serial = split(path)
    try:
        with file.open("rb") as stream:
            digest = sha256_of(stream)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({reason(error)}). Check the path.") from None
    table, schema = parquet.opened(file, file.name)
    missing = [name for name in _HEAD if name not in schema.names]
    if missing:
        raise InputError(
            f"{file.name} is not a table of calibrations: the column '{missing[0]}' is missing. Use a calibration "
            "file, or a table that mwdcal fleet wrote."
        )
    group, row, cells = _tool(table, file, serial)
    if cells.status != "ok":
        raise InputError(
            f"{file.name}: the tool {shown(cells.serial)} was not calibrated, status {cells.status}: {cells.message}"
        )
    name = f"{file.name}{MARK}{cells.serial}"
    return Member(_record(table, file.name, group, row, name), name, digest)


def groups(path: Path) -> range:
    """The row groups of the table of a fleet."""
    return range(parquet.opened(path, path.name)[0].num_row_groups)


def records(path: Path, some: Iterable[int] | None = None) -> Iterator[tuple[str, bytes]]:
    """Serial and calibration of each tool in the table of a fleet that has one; of some row groups alone."""
    table, _ = parquet.opened(path, path.name)
    for group in range(table.num_row_groups) if some is None else some:
        serials, cells = (_cells(table, path.name, group, n) for n in (_HEAD[0], RECORD))
        yield from ((s, cell.encode()) for s, cell in zip(serials, cells, strict=True) if cell)


class _Row(NamedTuple):
    """Remarks of the table on a tool besides its results."""

    serial: str
    status: str
    message: str


def _tool(table: Any, file: Path, serial: str | None) -> tuple[int, int, _Row]:
    """Where the only tool, or that of a serial, is: row group, row, and its entries.

    A path does not keep every character of a serial, such as a slash at its end: one that makes the same
    path will do.
    """
    named = [_cells(table, file.name, group, _HEAD[0]) for group in range(table.num_row_groups)]
    serials = [each for group in named for each in group]
    if serial is None and len(serials) == 1:
        serial = serials[0]
    if serial is None:
        raise InputError(
            f"{file.name} has the calibrations of {len(serials)} tools. Name one of them behind a {MARK}, such as "
            f"'{file.name}{MARK}{serials[0]}'."
        )
    meant = Path(f"{file}{MARK}{serial}")
    alike = [each for each in serials if Path(f"{file}{MARK}{each}") == meant]
    if serial not in serials and not alike:
        raise InputError(f"{file.name} has no tool {shown(serial)}. {_advice(serial, serials)}")
    serial = serial if serial in serials else alike[0]
    group = next(place for place, each in enumerate(named) if serial in each)
    row = named[group].index(serial)
    status, message = (_cells(table, file.name, group, n)[row] for n in _HEAD[1:])
    return group, row, _Row(serial, status, message)


def _advice(serial: str, serials: list[str]) -> str:
    """The serials that look like one, or else the first."""
    near = get_close_matches(serial, serials)
    first = [shown(each) for each in (near or serials)[:_SHOWN]]
    if near:
        return f"Is it {' or '.join(first)}? Correct the serial."
    more = " …" if len(serials) > _SHOWN else ""
    return f"Its tools are {', '.join(first)}{more}: correct the serial."


def _cells(table: Any, source: str, group: int, name: str) -> list[str]:
    """A column of a row group as text."""
    arrow, _ = parquet.modules(source)
    with parquet.reading(source):
        column = table.read_row_group(group, [name]).column(name)
        if arrow.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        return [as_text(cell) for cell in column.to_pylist()]


def _record(table: Any, source: str, group: int, row: int, name: str) -> bytes:
    """The calibration in a row."""
    if RECORD not in table.schema_arrow.names:
        raise without_records(source)
    record = _cells(table, source, group, RECORD)[row]
    if not record:
        raise InputError(
            f"{name}: the table has no whole calibration of this tool. Calibrate it alone: mwdcal calibrate."
        )
    return record.encode()
