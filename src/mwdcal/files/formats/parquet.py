"""Parquet: typed columns; metadata as JSON under the schema key `mwdcal`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files import metadata as meta
from mwdcal.files.formats.columns import (
    LABELS,
    Column,
    Parts,
    as_text,
    at_most,
    check_names,
    damaged_unless_read,
    no_stations,
    shown,
)

KEY = b"mwdcal"
_MAX_CELLS = 100_000_000
MAX_TEXT = 100_000_000
"""Bytes of texts that are in memory at once."""
_MAX_NESTED = 1_000_000
_LONGEST_FIXED = 1000
_UNPACKED = 100_000_000
_DENSEST = 100
_TEXTS = ("string", "large_string", "binary", "large_binary")
"""Types of columns that hold bytes of any length."""
_UNSPELT = re.compile(r"<value out of range: (-?\d+)>")
_PANDAS_INDEX = re.compile(r"__index_level_\d+__")


def parse(data: bytes, source: str, most: int = 0) -> Parts:
    """The table in the bytes of a Parquet file; with `most`, of at most so many rows."""
    arrow, _ = modules(source)
    file, schema = opened(arrow.BufferReader(data), source)
    rows, names = file.metadata.num_rows, list(schema.names)
    advice = "Split it. The rows of a run are stations; mwdcal stations finds those of a log."
    at_most(rows, most or rows, source, "a table that is read as a whole", "rows", advice)
    if rows * len(names) > _MAX_CELLS:
        raise InputError(
            f"{source}: a table must have at most {_MAX_CELLS} cells; got {rows} rows of "
            f"{len(names)} columns. Split the file."
        )
    with reading(source):
        floats = {field.name for field in schema if arrow.types.is_floating(field.type)}
        others = [name for name in names if name not in floats]
        table = dense(file.read(others, use_pandas_metadata=False), schema, source, arrow)
        columns = {}
        for name in (name for name in names if not is_index(name)):
            # numbers one column at a time: a long table is not in memory twice
            held = file.read([name], use_pandas_metadata=False) if name in floats else table
            columns[name] = as_column(name, held.column(name), arrow)
        if any(len(column) != rows for column in columns.values()):
            raise ValueError("columns of different lengths")
    return Parts(columns, metadata_of(schema.metadata, source), range(1, rows + 1))


def opened(source: Any, name: str, **options: Any) -> tuple[Any, Any]:
    """A Parquet file with rows, no part of which unpacks to more than memory bears, and its schema.

    Its columns of text are read as numbers of different texts, which `dense` turns into text.
    """
    _, parquet = modules(name)
    with reading(name):
        file = parquet.ParquetFile(source, **options)
        schema = file.schema_arrow
    check_names(list(schema.names), name)
    if file.metadata.num_rows == 0:
        raise no_stations(name)
    with reading(name):
        stored = source.stat().st_size if isinstance(source, Path) else source.size()
        _check_sizes(file, stored, name)
        texts = [field.name for field in schema if str(field.type) in _TEXTS]
        options = {**options, "metadata": file.metadata, "read_dictionary": texts}
        return parquet.ParquetFile(source, **options), schema


def close(writer: Any) -> None:
    """Close a file that a writer opened by its path, once: where the disk is full another attempt fails as well."""
    if writer is not None and writer.is_open:
        writer.is_open = False
        try:
            writer.writer.close()
        finally:
            writer.file_handle.close()


def _check_sizes(file: Any, stored: int, source: str) -> None:
    """Refuse a file of `stored` bytes of which a part would unpack to far more than that.

    PyArrow ends the process where the description of a column chunk is damaged: only those of lists
    and structures are asked for, whose size nothing else tells.
    """
    groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
    unpacked = max(group.total_byte_size for group in groups)
    if unpacked > max(_UNPACKED, _DENSEST * stored):
        raise InputError(
            f"{source}: a row group must unpack to at most {_UNPACKED} bytes, or {_DENSEST} times "
            f"the size of the file; got {unpacked} from {stored}. Write it in smaller row groups."
        )
    for index in range(len(file.schema)):
        leaf = file.schema.column(index)
        nested = leaf.path != leaf.name or leaf.max_repetition_level
        held = max(_held(leaf, group.column(index)) for group in groups) if nested else 0
        if held > _MAX_NESTED or leaf.length > _LONGEST_FIXED:
            raise InputError(
                f"{source}, column {shown(leaf.path.partition('.')[0])}: expected one value in "
                f"each cell, or lists of at most {_MAX_NESTED} values in all; got more. Remove the "
                "column, or store it in a file of its own."
            )


def _held(leaf: Any, chunk: Any) -> int:
    """Values that a nested column holds, of text as many as memory must be ready for."""
    if leaf.physical_type == "BYTE_ARRAY":
        return int(chunk.num_values * chunk.total_uncompressed_size) >> 8
    return int(chunk.num_values) if leaf.max_repetition_level else 0


def row_size(metadata: Any) -> int:
    """Mean bytes of a row as it is stored, before compression."""
    groups = range(metadata.num_row_groups)
    size = sum(int(metadata.row_group(i).total_byte_size) for i in groups)
    return size // int(metadata.num_rows)


def dense(table: Any, schema: Any, source: str, arrow: Any, most: int = MAX_TEXT) -> Any:
    """Columns of a table as read, of the types of the schema; refuses more than `most` bytes of text."""
    size = sum(
        _size_of(chunk)
        for column in table.columns
        if arrow.types.is_dictionary(column.type)
        for chunk in column.chunks
    )
    if size > most:
        raise InputError(
            f"{source}: texts of rows that are read at once must have at most {most} bytes; "
            f"got {size}. Shorten or remove the columns with long texts."
        )
    wanted = arrow.schema([schema.field(name) for name in table.column_names])
    if table.schema.equals(wanted):  # a cast loads `pyarrow.compute`
        return arrow.Table.from_arrays(table.columns, schema=wanted)
    return table.cast(wanted)


def _size_of(cells: Any) -> int:
    """Bytes of texts that are stored as numbers of different ones; refuses what is not UTF-8."""
    import pyarrow.compute as compute

    if str(cells.type.value_type) not in _TEXTS:
        return 0
    cells.dictionary.validate(full=True)
    lengths = compute.binary_length(cells.dictionary)
    return compute.sum(lengths.take(cells.indices)).as_py() or 0


def render(columns: Mapping[str, Column], metadata: Mapping[str, object], source: str) -> bytes:
    """The bytes that `parse` turns back into the same columns and metadata."""
    arrow, parquet = modules(source)
    arrays = {name: array_of(column, arrow) for name, column in columns.items()}
    described = {KEY: msgspec.json.encode(metadata, enc_hook=str)}
    table = arrow.table(arrays).replace_schema_metadata(described)
    stream = arrow.BufferOutputStream()
    parquet.write_table(table, stream)
    return bytes(stream.getvalue())


def modules(source: str) -> tuple[Any, Any]:
    """PyArrow and its Parquet module, or what to install."""
    parquet = extras.load("pyarrow.parquet", f"{source}: a Parquet file", "parquet")
    return import_module("pyarrow"), parquet


reading = partial(
    damaged_unless_read, expected="a complete Parquet file", advice="Copy or export it again."
)
"""Whatever PyArrow raises in the block, the file is foreign or damaged."""


def is_index(name: str) -> bool:
    """Whether a column is the numbering of rows that pandas adds."""
    return _PANDAS_INDEX.fullmatch(name) is not None


def as_column(name: str, cells: Any, arrow: Any) -> Column:
    """A column as floats (blank: NaN) where it is numeric, else as text; so labels and long whole numbers.

    Serials that are numbers with decimals stay numbers: their spelling is lost.
    """
    if arrow.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    types, kind = arrow.types, cells.type
    numeric = types.is_floating(kind) or types.is_decimal(kind)
    whole = types.is_integer(kind) and not _is_code(cells)
    if (name in LABELS and not (name == "serial" and numeric)) or not (numeric or whole):
        return texts(cells, arrow)
    if not types.is_float64(kind):
        cells = cells.cast(arrow.float64(), safe=False)
    return np.array(cells.to_numpy(), float)


def _is_code(cells: Any) -> bool:
    """Whether whole numbers have more digits than a double holds."""
    import pyarrow.compute as compute

    ends = compute.min_max(cells).as_py()
    return any(abs(end) >= 10**15 for end in ends.values() if end is not None)


def texts(cells: Any, arrow: Any) -> list[str]:
    """Cells of any type as text tables have them."""
    if arrow.types.is_string(cells.type) or arrow.types.is_large_string(cells.type):
        return list(cells.fill_null("").to_pylist())
    try:
        values = _in_microseconds(cells, arrow).to_pylist()
    except (ValueError, OverflowError, KeyError):  # nanoseconds, years or time zones Python lacks
        spelt = (_UNSPELT.sub(r"\1", as_text(v)) for v in _spelt(cells, arrow).to_pylist())
        return [value.replace(" ", "T", 1) for value in spelt]
    return [as_text(value) for value in values]


def _spelt(cells: Any, arrow: Any) -> Any:
    """Times as PyArrow spells them; in UTC where their time zone is not known."""
    try:
        return cells.cast(arrow.string())
    except arrow.ArrowInvalid:
        return cells.cast(arrow.timestamp(cells.type.unit)).cast(arrow.string())


def _in_microseconds(cells: Any, arrow: Any) -> Any:
    """Times in nanoseconds as times in microseconds: else PyArrow makes them pandas' own, if it can.

    Raises `ValueError` where that would lose digits.
    """
    kind = cells.type
    if getattr(kind, "unit", "") != "ns":
        return cells
    if arrow.types.is_timestamp(kind):
        return cells.cast(arrow.timestamp("us", kind.tz))
    return cells.cast(arrow.duration("us") if arrow.types.is_duration(kind) else arrow.time64("us"))


def array_of(column: Column, arrow: Any) -> Any:
    """A column as an Arrow array; what is blank is null."""
    if isinstance(column, list):
        return arrow.array([cell or None for cell in column], arrow.string())
    kind = None if column.dtype == bool else arrow.float64()
    return arrow.array(column, kind, from_pandas=True)


def metadata_of(schema: Mapping[bytes, bytes] | None, source: str) -> dict[str, object]:
    """Metadata in a file's schema."""
    try:
        stated = msgspec.json.decode((schema or {}).get(KEY, b"{}"), type=dict[str, object])
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{source}: the metadata under the schema key 'mwdcal' must be a JSON object "
            f"({error}). Write the file again."
        ) from None
    return meta.plain(stated, source)
