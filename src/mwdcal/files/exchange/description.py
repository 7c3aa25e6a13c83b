"""Remarks of a file in another program's format on the table it was written from.

Lines `# key = value` hold the metadata, as above a text table. One more line names the columns in
their order, and those that are text: the format itself has other names, and no place for some.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import msgspec

from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.formats.columns import Column, at_most

DESCRIBED = "mwdcal_table"
MAX_VALUES = 5_000_000
"""Values of a table that are in memory at once: such files are read as a whole."""
UNITS = {"accelerometer": "accelerometer_unit", "magnetometer": "magnetometer_unit"}
"""Metadata that state the unit of raw channels."""

_BEYOND_ASCII = re.compile(r"[^\x20-\x7e]")
_SURROGATES = re.compile("[\ud800-\udfff]")


class TableDescription(msgspec.Struct, frozen=True, kw_only=True):
    """The columns of a table in their order, and what became of them.

    Attributes:
        columns: names of all columns.
        texts: names of those that are text.
        cells: cells of text columns, where the format holds numbers alone.
        labelled: whether the labels of stations stand in the format's own place for them.
    """

    columns: list[str]
    texts: list[str] = []
    cells: dict[str, list[str]] = {}
    labelled: bool = False


def texts(columns: Mapping[str, Column]) -> list[str]:
    """Names of the columns that are text."""
    return [name for name, column in columns.items() if isinstance(column, list)]


def lines(
    metadata: Mapping[str, object], description: TableDescription, source: str
) -> Sequence[str]:
    """The lines that `read` turns back into metadata and description, in ASCII."""
    whole = meta.render({**metadata, DESCRIBED: msgspec.to_builtins(description)})
    if any(map(_SURROGATES.search, whole)):
        raise InputError(
            f"{source}: text must be valid Unicode; got half of a character. Correct the metadata or cells."
        )
    return [_BEYOND_ASCII.sub(_escaped, line) for line in whole]


def _escaped(character: re.Match[str]) -> str:
    code = ord(character[0])
    return f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"


def read(
    stated: Iterable[tuple[int, str]], source: str
) -> tuple[dict[str, object], TableDescription | None]:
    """Metadata of numbered lines, and the description among them, or None."""
    metadata = meta.parse(stated, source)
    described = metadata.pop(DESCRIBED, None)
    if described is None:
        return metadata, None
    try:
        return metadata, msgspec.convert(described, TableDescription)
    except msgspec.ValidationError:
        raise unfit(source) from None


def unfit(source: str) -> InputError:
    """The refusal of a file that was changed after it was written from a table."""
    return InputError(
        f"{source}: '{DESCRIBED}' does not describe the columns of the file, which another program has changed. "
        "Write the file again, or remove that entry."
    )


def check_size(columns: int, rows: int, source: str) -> None:
    """Refuse a table that takes more memory than any survey needs."""
    at_most(columns * rows, MAX_VALUES, source, "a table", "values", "Split the file.")
