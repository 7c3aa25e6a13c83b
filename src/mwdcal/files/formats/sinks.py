"""Where parts of a table go: Parquet or text, written as they come, metadata at the end.

`render` may be called by several threads at once, `write` takes what it gave, in order.
"""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import IO, Any

import msgspec
import numpy as np

from mwdcal.files import metadata as meta
from mwdcal.files.formats import parquet, text
from mwdcal.files.formats.columns import Column
from mwdcal.geometry.vectors import AnyArray, Bools

_ARROW_SCHEMA = b"ARROW:schema"


class ParquetSink:
    """A Parquet file; results are neither compressed nor searched for repetitions: there are none.

    Attributes:
        formulas: columns with cells that would be run as formulas: none in this format.
    """

    formulas: Collection[str] = ()

    def __init__(
        self, stream: IO[bytes], schema: Any, results: Any, metadata: Mapping[str, object]
    ) -> None:
        self._arrow, parquets = parquet.modules(stream.name)
        self._metadata = dict(metadata)
        self._names = names = results.names
        words = [f.name for f in schema if not self._arrow.types.is_floating(f.type)]
        self._schema = schema = self._arrow.schema([*schema, *results])
        schema = schema.with_metadata({parquet.KEY: self._described([])})
        self._writer = parquets.ParquetWriter(
            stream.name,
            schema,
            use_dictionary=words,
            compression={f.name: "none" if f.name in names else "snappy" for f in schema},
        )

    def render(self, carried: Any, results: Sequence[AnyArray], blank: bool) -> Any:
        """The Arrow table of the part; numbers are not copied where nothing is blank."""
        for name, values in zip(self._names, results, strict=True):
            carried = carried.append_column(name, self._arrow.array(values, from_pandas=blank))
        return carried

    def write(self, rendered: Any) -> None:
        """Append a row group."""
        self._writer.write_table(rendered)

    def finish(self, findings: Sequence[str], metadata: Mapping[str, object] | None = None) -> None:
        """Write the findings, `metadata` that were not known before, and the end of the file."""
        self._metadata = dict(metadata or self._metadata)
        if findings or metadata:  # also in Arrow's copy of the schema, whose metadata readers take
            described = {parquet.KEY: self._described(findings)}
            stored = base64.b64encode(self._schema.with_metadata(described).serialize())
            self._writer.add_key_value_metadata({**described, _ARROW_SCHEMA: stored})
        parquet.close(self._writer)

    def close(self) -> None:
        """Close the file, finished or not."""
        with suppress(OSError):
            parquet.close(self._writer)

    def _described(self, findings: Sequence[str]) -> bytes:
        metadata = {**self._metadata, "findings": list(findings)} if findings else self._metadata
        return msgspec.json.encode(metadata, enc_hook=str)


class TextSink:
    """A text table; the findings are above its header.

    From the second part on room is kept for them there, as a comment line of blanks.

    Attributes:
        formulas: columns with cells that spreadsheet programs would run; `numeric` ones have none.
    """

    def __init__(
        self,
        stream: IO[bytes],
        schema: Any,
        results: Any,
        metadata: Mapping[str, object],
        longest: Sequence[str],
        delimiter: str,
        numeric: Collection[str] = (),
    ) -> None:
        self._arrow, _ = parquet.modules(stream.name)
        self._stream = stream
        self._delimiter = delimiter
        self._names = results.names
        stream.write("".join(f"{line}\n" for line in meta.render(metadata)).encode())
        self._place = stream.tell()
        self._room = len(_line(longest)) if longest else 0
        self._header = text.header([*schema.names, *results.names], delimiter).encode()
        self._first: bytes | None = None
        self._texts = [name for name in schema.names if name not in numeric]
        self.formulas = {name for name in self._texts if text.is_formula(name)}

    def render(self, carried: Any, results: Sequence[AnyArray], blank: bool) -> bytes:
        """The lines of the part."""
        plain = {name: self._spelt(carried.column(name)) for name in carried.column_names}
        self.formulas.update(n for n in self._texts if self._has_formula(plain[n]))
        plain |= {
            name: self._arrow.array(values, from_pandas=blank)
            for name, values in zip(self._names, results, strict=True)
        }
        rows = self._arrow.table(plain)
        try:
            return self._lines(rows)
        except self._arrow.ArrowInvalid:  # a cell needs quotes
            return self._quoted(rows)

    def _has_formula(self, cells: Any) -> bool:
        """Whether spreadsheet programs would run a cell of the column."""
        import pyarrow.compute as compute

        if not self._arrow.types.is_string(cells.type):
            return False
        begun = (cells.filter(compute.starts_with(cells, sign)) for sign in text.FORMULA)
        return any(text.is_formula(cell) for some in begun for cell in some.to_pylist())

    def _lines(self, rows: Any) -> bytes:
        """Rows of which no cell needs quotes or is refused."""
        from pyarrow import csv as arrow_csv

        stream = self._arrow.BufferOutputStream()
        options = arrow_csv.WriteOptions(
            include_header=False, delimiter=self._delimiter, quoting_style="none"
        )
        arrow_csv.write_csv(rows, stream, options)
        lines = bytes(stream.getvalue())
        if b"\0" in lines:
            raise self._arrow.ArrowInvalid("NUL")
        return lines

    def _quoted(self, rows: Any) -> bytes:
        """Rows of which some have such cells: these by the writer of short tables, numbers alike."""
        odd = self._odd(rows)
        words = [cells.cast(self._arrow.string()) for cells in rows.filter(odd).columns]
        cells = [[word or "" for word in column.to_pylist()] for column in words]
        columns = dict(zip(rows.column_names, cells, strict=True))
        few = text.render(columns, {}, self._delimiter).encode().split(b"\n")
        lines = np.empty(len(odd), object)
        lines[odd] = few[-1 - int(odd.sum()) : -1]
        lines[~odd] = self._lines(rows.filter(~odd)).split(b"\n")[:-1]
        return b"\n".join([*lines, b""])

    def _odd(self, rows: Any) -> Bools:
        """Which rows (n,) have a cell that needs quotes."""
        import pyarrow.compute as compute

        odd = np.zeros(len(rows), bool)
        for cells in rows.columns:
            if self._arrow.types.is_string(cells.type):
                quoted = compute.match_substring_regex(cells, f'["\r\n\\x00{self._delimiter}]')
                odd |= quoted.fill_null(False).to_numpy()
        return odd

    def write(self, rendered: bytes) -> None:
        """Append lines; the first ones wait, as a table of one part needs no room."""
        if self._first is None:
            self._first = rendered
            return
        if self._header:
            self._begin(b"#".ljust(self._room) + b"\n" if self._room else b"")
        self._stream.write(rendered)

    def _begin(self, comment: bytes) -> None:
        self._stream.write(comment + self._header + (self._first or b""))
        self._header = self._first = b""

    def finish(self, findings: Sequence[str]) -> None:
        """Put the findings where they belong."""
        if self._header:
            self._begin(_line(findings) + b"\n" if findings else b"")
        elif findings:
            self._stream.seek(self._place)
            self._stream.write(_line(findings).ljust(self._room))

    def close(self) -> None:
        """Leave the stream to what opened it."""

    def _spelt(self, cells: Any) -> Any:
        """A column of numbers (blank: null) or of text, as text tables have them."""
        import pyarrow.compute as compute

        types, kind = self._arrow.types, cells.type
        if types.is_integer(kind) or types.is_string(kind):
            return cells
        if types.is_floating(kind) or types.is_decimal(kind):
            values = cells.cast(self._arrow.float64(), safe=False)
            return compute.if_else(compute.is_nan(values), None, values)
        return self._arrow.array(parquet.texts(cells, self._arrow), self._arrow.string())


class SpooledSink:
    """A text table whose head is known at the end: until then its rows are in a file without a name, beside it."""

    def __init__(self, stream: IO[bytes], delimiter: str) -> None:
        self._arrow, _ = parquet.modules(stream.name)
        self._stream, self._delimiter = stream, delimiter
        self._rows = TemporaryFile(dir=Path(stream.name).parent)  # noqa: SIM115, closed by `close`
        self._names: list[str] = []

    def write(self, columns: Mapping[str, Column | Any]) -> None:
        """Append rows of columns as in memory, or as Arrow has texts; each cell as `formats.text` spells it."""
        self._names = [*columns]
        cells = [self._spelt(name, column) for name, column in columns.items()]
        lines = text.joined(cells, self._delimiter, self._arrow)
        self._rows.write(lines)

    def _spelt(self, name: str, column: Column | Any) -> Any:
        if isinstance(column, np.ndarray):
            return text.spelt(column, self._arrow)
        if isinstance(column, list):
            column = self._arrow.array(text.one_line(name, column), self._arrow.string())
        return text.quoted(column, self._delimiter)

    def finish(self, metadata: Mapping[str, object]) -> None:
        """Write the head, and the rows behind it."""
        head = "".join(f"{line}\n" for line in meta.render(metadata))
        self._stream.write((head + text.header(self._names, self._delimiter)).encode())
        self._rows.seek(0)
        copyfileobj(self._rows, self._stream, 1 << 20)

    def close(self) -> None:
        """Remove the rows that waited."""
        self._rows.close()


Sink = ParquetSink | TextSink
"""A table being written: the columns of the input, then results beside them."""


def _line(findings: Sequence[str]) -> bytes:
    return meta.render({"findings": list(findings)})[0].encode()
