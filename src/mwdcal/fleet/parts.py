"""One partition of a fleet: the same two steps for every worker, on this machine or another."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.calibration.diagnosis.refusals import BAD_INPUT
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import HIGHEST, TRIADS
from mwdcal.errors import InputError
from mwdcal.files.contract import AZIMUTH_KEYS, CHANNELS
from mwdcal.files.formats import parquet
from mwdcal.fleet.calibrate import OK, BatchOutcome, calibrate_batch, names
from mwdcal.fleet.runs import Batch, Rows, batches, refused_tools
from mwdcal.fleet.sources import SERIAL, FleetTable
from mwdcal.fleet.tables import Partition, read
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.sensor.profile import Profile

LISTS = ("findings", "reshoot")
"""Columns of lists: ids of findings, and labels of stations to take again."""
WHOLE_NUMBERS = ("rank", "size", "order", "stations")
"""Ends of the names of columns of whole numbers."""


@dataclass(frozen=True)
class Plan:
    """What is to be done to every partition."""

    source: str
    metadata: Mapping[str, object]
    columns: tuple[str, ...]
    profile: Profile
    options: Options
    version: str = __version__

    @classmethod
    def of(cls, source: FleetTable, profile: Profile, options: Options) -> Plan:
        """For a table: of its columns those that a run file has; which north is one of them."""
        metadata = {k: v for k, v in source.metadata.items() if k not in AZIMUTH_KEYS}
        return cls(source.name, metadata, source.used, profile, options)

    @property
    def triads(self) -> tuple[str, ...]:
        """The triads that the table has columns for."""
        return TRIADS[: 1 + (CHANNELS["magnetometer"][0] in self.columns)]

    @property
    def noise_estimated(self) -> tuple[str, ...]:
        """Triads of which neither the profile nor the table states the noise."""
        stated = {t for t in self.triads if any(f"sd_{n}" in self.columns for n in CHANNELS[t])}
        return tuple(
            t for t in self.triads if t not in stated and getattr(self.profile, t).noise is None
        )

    def key(self, partition: Partition) -> str:
        """Name of the partition's result: another input, option or version has another."""
        return hashlib.sha256(msgspec.json.encode([self, partition])).hexdigest()[:32]


def load(plan: Plan, partition: Partition) -> bytes:
    """The rows of a partition, in Arrow's stream format."""
    return packed(read(partition, plan.columns))


def solve(plan: Plan, loaded: bytes) -> bytes:
    """Calibrate the tools of loaded rows: a table in Arrow's stream format, one row per tool."""
    if plan.version != __version__:
        raise InputError(
            f"the worker runs mwdcal {__version__}, the command {plan.version}. Install the "
            "same version everywhere."
        )
    arrow, _ = parquet.modules(plan.source)
    table = arrow.ipc.open_stream(loaded).read_all()
    rows = Rows.of(table, plan.source, plan.metadata, plan.profile)
    return packed(_result(rows, plan))


def packed(table: Any) -> bytes:
    """A table in Arrow's stream format; measured first, as memory that grows costs most of the time."""
    arrow, _ = parquet.modules("fleet")
    size = arrow.MockOutputStream()
    with arrow.ipc.new_stream(size, table.schema) as writer:
        writer.write_table(table)
    buffer = bytearray(size.size())
    stream = arrow.FixedSizeBufferWriter(arrow.py_buffer(buffer))
    with arrow.ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)
    return bytes(buffer)


def _result(rows: Rows, plan: Plan) -> Any:
    """The result table of some tools."""
    count = len(rows.counts)
    status, message = np.full(count, OK, object), np.full(count, "", object)
    unit = np.full(count, None, object)
    filled = {
        name: np.full(count, np.nan) for name in names(plan.options, plan.profile, plan.triads)
    }
    ids = (*LISTS, *(f"{triad}_undetermined" for triad in plan.triads))
    lists = {name: np.full(count, None, object) for name in ids}
    for tool, text in refused_tools(rows).items():
        status[tool], message[tool] = BAD_INPUT, text
    for batch in batches(rows, np.flatnonzero(status == OK)):
        outcome = _calibrated(rows, batch, plan)
        status[batch.tools], message[batch.tools] = outcome.status, outcome.message
        if batch.readings.magnetometer is not None:
            unit[batch.tools] = batch.readings.field_unit
        for name, values in filled.items():
            values[batch.tools] = outcome.columns[name]
        for i in np.flatnonzero(outcome.status == OK):
            tool = int(batch.tools[i])
            labels = [rows.label(tool, station) for station in outcome.reshoot[i]]
            for name, entry in zip(
                ids, (outcome.findings[i], labels, *outcome.free[i]), strict=False
            ):
                lists[name][tool] = entry
    unit[status != OK] = None
    return _table(rows, plan, (status, message, unit), filled, lists)


def _calibrated(rows: Rows, batch: Batch, plan: Plan) -> BatchOutcome:
    return calibrate_batch(
        batch.readings, plan.options, plan.profile, lambda i: rows.alone(int(batch.tools[i]))
    )


def _table(
    rows: Rows,
    plan: Plan,
    texts: tuple[AnyArray, AnyArray, AnyArray],
    filled: dict[str, Array],
    lists: dict[str, AnyArray],
) -> Any:
    """The Arrow table of results, in the order of the columns."""
    arrow, _ = parquet.modules(plan.source)
    text, of_text = arrow.string(), arrow.list_(arrow.string())
    status, message, unit = (arrow.array(each, text) for each in texts)
    low, high = _temperatures(rows)
    columns = {
        SERIAL: rows.serials,
        "status": status,
        "message": message,
        "stations": arrow.array(rows.counts, arrow.int32()),
        "temperature_min_c": arrow.array(low, mask=np.isnan(low)),
        "temperature_max_c": arrow.array(high, mask=np.isnan(high)),
    }
    columns |= {name: arrow.array(lists[name], of_text) for name in LISTS}
    for name, values in filled.items():
        whole = name.rpartition("_")[2] in WHOLE_NUMBERS
        numbers = np.nan_to_num(values).astype(np.int32) if whole else values
        columns[name] = arrow.array(numbers, mask=np.isnan(values))
    columns |= {name: arrow.array(lists[name], of_text) for name in lists if name not in LISTS}
    columns["field_unit"] = unit
    columns["method"] = arrow.array([plan.options.method] * len(rows.counts), text)
    order = np.fmax.reduce([filled[f"{triad}_order"] for triad in plan.triads])
    if plan.options.order != AUTO:
        order = np.full(len(order), float(max(plan.options.orders)))
    kinds = np.array([None, *(plan.options.kind(k) for k in range(HIGHEST + 1))], object)
    columns["model"] = arrow.array(kinds[np.nan_to_num(order + 1).astype(int)], text)
    columns["order"] = arrow.array(np.nan_to_num(order).astype(np.int32), mask=np.isnan(order))
    return arrow.table(columns)


def _temperatures(rows: Rows) -> tuple[Array, Array]:
    """Coldest and hottest station (T,) of each tool; NaN where there is no temperature."""
    values = rows.numbers.get("temperature_c")
    if values is None:
        none = np.full(len(rows.counts), np.nan)
        return none, none
    values = np.where(np.isfinite(values), values, np.nan)  # of a tool that is refused
    first = rows.starts[:-1]
    return np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
