"""One partition of a fleet: the same two steps for every worker, on this machine or another.

A worker writes its own part: nothing of it passes through the command, which reads it when it puts the table together.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.calibration.diagnosis.flags import Alone
from mwdcal.calibration.diagnosis.refusals import BAD_INPUT
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings
from mwdcal.errors import InputError
from mwdcal.estimation.batch import put
from mwdcal.files.contract import AZIMUTH_KEYS, CHANNELS
from mwdcal.files.formats import parquet
from mwdcal.files.formats.members import RECORD
from mwdcal.fleet import kept
from mwdcal.fleet.calibrate import LISTS, OK, Outcome, calibrate_batch, names
from mwdcal.fleet.runs import Rows, batches, refused_tools
from mwdcal.fleet.sources import SERIAL, FleetTable, check_unchanged
from mwdcal.fleet.tables import Partition, read
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.sensor.profile import Profile

WHOLE_NUMBERS = ("rank", "size", "order")
"""Ends of the names of columns of whole numbers."""


@dataclass(frozen=True)
class Plan:
    """The work on every partition.

    `records`: the table gets the calibration file of each tool, with the digests of the profile and, where
    it is one file, of the runs.
    """

    source: str
    metadata: Mapping[str, object]
    columns: tuple[str, ...]
    profile: Profile
    options: Options
    version: str = __version__
    records: bool = False
    profile_sha256: str = ""
    runs_sha256: str = ""

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
        return tuple(
            triad
            for triad in self.triads
            if getattr(self.profile, triad).noise is None
            and not {f"sd_{name}" for name in CHANNELS[triad]} & {*self.columns}
        )

    def key(self, partition: Partition) -> str:
        """Name of the partition's result: another input, option or version has another."""
        return hashlib.sha256(msgspec.json.encode([self, partition])).hexdigest()[:32]


@dataclass(frozen=True)
class Task:
    """A partition, and the file that keeps what becomes of it, where every worker sees it."""

    partition: Partition
    path: Path


def load(plan: Plan, task: Task) -> tuple[Task, bytes]:
    """The task with its rows, in Arrow's stream format."""
    return task, packed(read(task.partition, plan.columns))


def solve(plan: Plan, loaded: tuple[Task, bytes]) -> None:
    """Calibrate the tools of loaded rows, and keep their table, one row per tool, where the task says."""
    task, rows = loaded
    table = calibrations(plan, rows)
    check_unchanged(task.partition.pieces)
    kept.write_part(task.path, packed(table))


def calibrations(plan: Plan, loaded: bytes) -> Any:
    """The Arrow table of the tools of loaded rows."""
    if plan.version != __version__:
        raise InputError(
            f"the worker runs mwdcal {__version__}, the command {plan.version}. Install the "
            "same version everywhere."
        )
    arrow, _ = parquet.modules(plan.source)
    table = arrow.ipc.open_stream(loaded).read_all()
    rows = Rows(table, plan.source, plan.metadata, plan.profile, plan.runs_sha256)
    return _result(rows, plan)


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
    whole = Outcome.blank(len(rows.counts), names(plan.options, plan.profile, plan.triads))
    for tool, text in refused_tools(rows).items():
        whole.status[tool], whole.message[tool] = BAD_INPUT, text
    for tools, readings in batches(rows, np.flatnonzero(whole.status == OK)):
        outcome = calibrate_batch(
            readings, plan.options, plan.profile, _alone(rows, tools, plan), plan.records
        )
        whole = put(whole, tools, outcome)
    again = whole.lists["reshoot"]
    for tool in np.flatnonzero(whole.status == OK).tolist():
        again[tool] = [rows.label(tool, station) for station in again[tool]]
    return _table(rows, plan, whole)


def _alone(rows: Rows, tools: Ints, plan: Plan) -> Alone:
    """One of some tools as a single run, which states the profile that the fleet has."""
    members = rows.members(tools)

    def alone(place: int) -> tuple[Readings, Profile]:
        readings, profile = members(place)
        return replace(readings, profile_sha256=plan.profile_sha256), profile

    return alone


def _table(rows: Rows, plan: Plan, whole: Outcome) -> Any:
    """The Arrow table of results, in the order of the columns."""
    arrow, _ = parquet.modules(plan.source)
    text, of_text = arrow.string(), arrow.list_(arrow.string())
    low, high = _temperatures(rows)
    lists = {name: arrow.array(values, of_text) for name, values in whole.lists.items()}
    order = np.fmax.reduce([whole.numbers[f"{triad}_order"] for triad in plan.triads])
    if plan.options.order != AUTO:
        order = np.full(len(order), float(max(plan.options.orders)))
    kinds = np.array([None, *(plan.options.kind(k) for k in range(HIGHEST + 1))], object)
    return arrow.table(
        {
            SERIAL: rows.serials,
            "status": arrow.array(whole.status, text),
            "message": arrow.array(whole.message, text),
            "stations": arrow.array(
                np.where(rows.unread, 0, rows.counts - whole.copies), arrow.int32()
            ),
            "temperature_min_c": arrow.array(low, mask=np.isnan(low)),
            "temperature_max_c": arrow.array(high, mask=np.isnan(high)),
            **{name: lists[name] for name in LISTS[:2]},
            **{name: _numbers(name, values) for name, values in whole.numbers.items()},
            **{name: lists[name] for name in LISTS[2 : 2 + len(plan.triads)]},
            "field_unit": arrow.array(whole.unit, text),
            "method": arrow.repeat(plan.options.method, len(rows.counts)),
            "model": arrow.array(kinds[np.nan_to_num(order + 1).astype(int)], text),
            "order": _numbers("order", order),
            **({RECORD: arrow.array(whole.records, text)} if plan.records else {}),
        }
    )


def _numbers(name: str, values: Array) -> Any:
    """A column of numbers, whole ones where the name says so; blank for NaN."""
    arrow, _ = parquet.modules(name)
    whole = name.rpartition("_")[2] in WHOLE_NUMBERS
    numbers = np.nan_to_num(values).astype(np.int32) if whole else values
    return arrow.array(numbers, mask=np.isnan(values))


def _temperatures(rows: Rows) -> tuple[Array, Array]:
    """Coldest and hottest station (T,) of each tool; NaN where there is no temperature."""
    values = rows.numbers.get("temperature_c", np.full(rows.starts[-1], np.nan))
    values = np.where(np.isfinite(values), values, np.nan)  # of a tool that is refused
    first = rows.starts[:-1]
    return np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
