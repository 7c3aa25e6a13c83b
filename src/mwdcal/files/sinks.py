"""Where parts of a table go: Parquet or text, written as they come, metadata at the end.

`render` may be called by several threads at once, `write` takes what it gave, in order.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from typing import IO, Any, Protocol

import msgspec

from mwdcal.core.vectors import AnyArray
from mwdcal.files import metadata as meta
from mwdcal.files import parquet, text
from mwdcal.files.columns import as_text

_ARROW_SCHEMA = b"ARROW:schema"


class Sink(Protocol):
    """A table being written: `carried` columns, then results beside them."""

    def render(self, carried: Any, results: Sequence[AnyArray], blank: bool) -> Any:
        """What is written of a part; without `blank` no result is NaN."""

    def write(self, rendered: Any) -> None:
        """Append a part."""

    def finish(self, findings: Sequence[str]) -> None:
        """Complete the table; `findings` are known only now."""


class ParquetSink:
    """A Parquet file; results are neither compressed nor searched for repetitions: there are none."""

    def __init__(
        self, stream: IO[bytes], schema: Any, results: Any, metadata: Mapping[str, object]
    ) -> None:
        self._arrow, parquets = parquet.modules(stream.name)
        self._metadata = dict(metadata)
        self._names = names = results.names
        numeric = {f.name for f in schema if self._arrow.types.is_floating(f.type)}
        self._schema = schema = self._arrow.schema([*schema, *results])
        schema = schema.with_metadata({parquet.KEY: self._described([])})
        self._writer = parquets.ParquetWriter(
            stream.name,
            schema,
            use_dictionary=[f.name for f in schema if f.name not in numeric.union(names)],
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

    def finish(self, findings: Sequence[str]) -> None:
        """Write the findings and the end of the file."""
        if findings:  # also in Arrow's copy of the schema, whose metadata readers take
            described = {parquet.KEY: self._described(findings)}
            stored = base64.b64encode(self._schema.with_metadata(described).serialize())
            self._writer.add_key_value_metadata({**described, _ARROW_SCHEMA: stored})
        self._writer.close()

    def _described(self, findings: Sequence[str]) -> bytes:
        metadata = {**self._metadata, "findings": list(findings)} if findings else self._metadata
        return msgspec.json.encode(metadata, enc_hook=str)


class TextSink:
    """A text table; the findings are above its header.

    From the second part on room is kept for them there, as a comment line of blanks.
    """

    def __init__(
        self,
        stream: IO[bytes],
        schema: Any,
        results: Any,
        metadata: Mapping[str, object],
        longest: Sequence[str],
        delimiter: str,
    ) -> None:
        self._arrow, _ = parquet.modules(stream.name)
        self._stream = stream
        self._delimiter = delimiter
        self._names = results.names
        stream.write("".join(f"{line}\n" for line in meta.render(metadata)).encode())
        self._place = stream.tell()
        self._room = len(_line(longest)) if longest else 0
        header = csv.writer(buffer := io.StringIO(), delimiter=self._delimiter, lineterminator="\n")
        header.writerow([*schema.names, *results.names])
        self._header = buffer.getvalue().encode()
        self._first: bytes | None = None

    def render(self, carried: Any, results: Sequence[AnyArray], blank: bool) -> bytes:
        """The lines of the part."""
        from pyarrow import csv as arrow_csv

        plain = {
            n: self._spelt(c) for n, c in zip(carried.column_names, carried.columns, strict=True)
        }
        plain |= {
            name: self._arrow.array(values, from_pandas=blank)
            for name, values in zip(self._names, results, strict=True)
        }
        stream = self._arrow.BufferOutputStream()
        options = arrow_csv.WriteOptions(
            include_header=False, delimiter=self._delimiter, quoting_style="none"
        )
        try:
            arrow_csv.write_csv(self._arrow.table(plain), stream, options)
        except self._arrow.ArrowInvalid:  # a cell needs quotes
            columns = {n: [as_text(v) for v in c.to_pylist()] for n, c in plain.items()}
            return text.render(columns, {}, self._delimiter).partition("\n")[2].encode()
        return bytes(stream.getvalue())

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


def _line(findings: Sequence[str]) -> bytes:
    return meta.render({"findings": list(findings)})[0].encode()
