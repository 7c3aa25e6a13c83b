"""Parquet: typed columns; metadata as JSON under the schema key `mwdcal`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import (
    LABELS,
    Column,
    Parts,
    as_text,
    check_names,
    damaged_unless_read,
    no_stations,
)

KEY = b"mwdcal"
_MAX_CELLS = 100_000_000
_PANDAS_INDEX = re.compile(r"__index_level_\d+__")


def parse(data: bytes, source: str) -> Parts:
    """The table in the bytes of a Parquet file."""
    arrow, parquet = modules(source)
    with reading(source):
        file = parquet.ParquetFile(arrow.BufferReader(data))
        rows, names = file.metadata.num_rows, list(file.schema_arrow.names)
    check_names(names, source)
    if rows == 0:
        raise no_stations(source)
    if rows * len(names) > _MAX_CELLS:
        raise InputError(
            f"{source}: a table must have at most {_MAX_CELLS} cells; got {rows} rows of "
            f"{len(names)} columns. Split the file."
        )
    with reading(source):
        table = file.read(use_pandas_metadata=False)
        columns = {
            name: as_column(name, table.column(name), arrow) for name in names if not is_index(name)
        }
    return Parts(columns, metadata_of(table.schema.metadata, source), range(1, rows + 1))


def render(columns: Mapping[str, Column], metadata: Mapping[str, object], source: str) -> bytes:
    """The bytes that `parse` turns back into the same columns and metadata."""
    arrow, parquet = modules(source)
    arrays = {name: _array(column, arrow) for name, column in columns.items()}
    described = {KEY: msgspec.json.encode(metadata, enc_hook=str)}
    table = arrow.table(arrays).replace_schema_metadata(described)
    stream = arrow.BufferOutputStream()
    parquet.write_table(table, stream)
    return bytes(stream.getvalue())


def modules(source: str) -> tuple[Any, Any]:
    """PyArrow and its Parquet module, or what to install."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            f"{source}: Parquet files need the extra 'parquet'. "
            "Install it with: pip install 'mwdcal[parquet]'"
        ) from None
    return pyarrow, pyarrow.parquet


@contextmanager
def reading(source: str) -> Iterator[None]:
    """Whatever PyArrow raises in the block, the file is foreign or damaged."""
    with damaged_unless_read(source, "a complete Parquet file", "Copy or export it again."):
        yield


def is_index(name: str) -> bool:
    """Whether a column is the numbering of rows that pandas adds."""
    return _PANDAS_INDEX.fullmatch(name) is not None


def as_column(name: str, cells: Any, arrow: Any) -> Column:
    """A column as floats (blank: NaN) where it is numeric, else as text; so long whole numbers."""
    if arrow.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    kinds = arrow.types
    numeric = kinds.is_floating(cells.type) or kinds.is_integer(cells.type)
    if kinds.is_integer(cells.type) and _is_code(cells):
        return texts(cells, arrow)
    if name not in LABELS and (numeric or kinds.is_decimal(cells.type)):
        values = cells.cast(arrow.float64(), safe=False).to_numpy()
        return np.array(values, float)
    return texts(cells, arrow)


def _is_code(cells: Any) -> bool:
    """Whether whole numbers have more digits than a double holds."""
    import pyarrow.compute as compute

    ends = compute.min_max(cells).as_py()
    return any(abs(end) >= 10**15 for end in ends.values() if end is not None)


def texts(cells: Any, arrow: Any) -> list[str]:
    """Cells of any type as text tables have them."""
    try:
        values = _in_microseconds(cells, arrow).to_pylist()
    except ValueError:  # nanoseconds, which times of Python do not have
        return [as_text(v).replace(" ", "T", 1) for v in cells.cast(arrow.string()).to_pylist()]
    return [as_text(value) for value in values]


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


def _array(column: Column, arrow: Any) -> Any:
    if isinstance(column, list):
        return arrow.array([cell or None for cell in column], arrow.string())
    if column.dtype == bool:
        return arrow.array(column)
    return arrow.array(column, arrow.float64(), from_pandas=True)


def metadata_of(schema: Mapping[bytes, bytes] | None, source: str) -> dict[str, object]:
    """What a file's schema says of it."""
    try:
        return msgspec.json.decode((schema or {}).get(KEY, b"{}"), type=dict[str, object])
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{source}: the metadata under the schema key 'mwdcal' must be a JSON object "
            f"({error}). Write the file again."
        ) from None
