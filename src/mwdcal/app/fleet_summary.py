"""What came of a fleet: counts, spreads and undetermined directions, for people and machines.

The table of calibrations is read column by column, whatever its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal.app.fleet_asked import Asked
from mwdcal.app.text import number, table
from mwdcal.core.vectors import Array
from mwdcal.files import parquet
from mwdcal.files.fleet_sources import SERIAL
from mwdcal.files.fleet_tables import one_chunk
from mwdcal.fleet import OK
from mwdcal.readings import TRIADS

SHOWN = 5
"""Most serials that a line names."""
DOUBTS = ("no-redundancy", "repeated-readings", "prior-conflict")
"""Findings of a doubtful fit, besides residuals beyond the declared noise."""
SPAN = 10.0
"""A run that spans more without temperature terms is mentioned, °C."""


@dataclass(frozen=True)
class Kind:
    """Tools of one status: how many, the first serials, and one message."""

    status: str
    tools: int
    serials: list[Any]
    message: str


@dataclass(frozen=True)
class Said:
    """Sound tools with one finding: how many, and the first serials."""

    id: str
    tools: int
    serials: list[Any]


@dataclass(frozen=True)
class Summary:
    """What came of a fleet. `spread` has the 1 %, 50 % and 99 % point of columns of sound tools."""

    runs: str
    output: str
    tools: int
    stations: int
    method: str
    order: int | str
    orders: dict[str, int]
    statuses: list[Kind]
    findings: list[Said]
    spread: dict[str, list[float]]
    undetermined: dict[str, int]
    parts: int
    parts_done_before: int
    seconds: float
    notes: list[str]

    @property
    def sound(self) -> int:
        """Number of calibrated tools."""
        return sum(kind.tools for kind in self.statuses if kind.status == OK)


def summarise(
    asked: Asked,
    target: Path,
    stations: int,
    parts: int,
    before: int,
    seconds: float,
    notes: list[str],
) -> Summary:
    """What the output says, read column by column."""
    _, pq = parquet.modules(target.name)
    whole = pq.ParquetFile(target)
    head = whole.read([SERIAL, "status", "message", "findings"])
    names = whole.schema_arrow.names
    ends = ("_sd_deg", "_variance_factor")
    spread = {n: _quantiles(numbers(whole, n)) for n in names if n.endswith(ends)}
    if asked["order"] == "0":
        span = numbers(whole, "temperature_max_c") - numbers(whole, "temperature_min_c")
        wide = int(np.sum(span > SPAN))
        if wide:
            notes.append(
                f"{wide} tools span more than {SPAN:g} °C, and --order 0 has no temperature terms."
            )
    return Summary(
        runs=asked["runs"].name,
        output=str(asked["output"]),
        tools=head.num_rows,
        stations=stations,
        method=asked["method"],
        order=asked["order"] if asked["order"] == "auto" else int(asked["order"]),
        orders=_orders(whole, names) if asked["order"] == "auto" else {},
        statuses=_kinds(head),
        findings=_findings(head),
        spread=spread,
        undetermined=_undetermined(whole, names),
        parts=parts,
        parts_done_before=before,
        seconds=round(seconds, 3),
        notes=notes,
    )


def column(path: Path, name: str) -> Array:
    """One column of numbers of a table of calibrations, NaN where there is none."""
    _, pq = parquet.modules(path.name)
    return numbers(pq.ParquetFile(path), name)


def numbers(whole: Any, name: str) -> Array:
    """One column of numbers of an opened Parquet file, NaN where there is none."""
    arrow, _ = parquet.modules(name)
    cells = whole.read([name]).column(0)
    return np.asarray(cells.cast(arrow.float64()).to_numpy(), float)


def _quantiles(values: Array) -> list[float]:
    if np.isnan(values).all():
        return []
    return [float(v) for v in np.nanquantile(values, (0.01, 0.5, 0.99))]


def _kinds(head: Any) -> list[Kind]:
    """Statuses with their tools, sound ones first, then by number."""
    counted = head.column("status").value_counts().to_pylist()
    found = []
    for each in sorted(counted, key=lambda c: (c["values"] != OK, -c["counts"])):
        own = head.filter(_equal(head.column("status"), each["values"])).slice(0, SHOWN).to_pydict()
        found.append(Kind(each["values"], each["counts"], own[SERIAL], own["message"][0]))
    return found


def _findings(head: Any) -> list[Said]:
    """Findings with their tools: doubts of the fit first, then by number."""
    arrow, _ = parquet.modules("findings")
    column = one_chunk(head.column("findings"))
    ids = column.flatten().dictionary_encode()
    tool = np.repeat(np.arange(len(column)), column.value_lengths().fill_null(0).to_numpy())
    found = []
    for code, name in enumerate(ids.dictionary.to_pylist()):
        own = tool[ids.indices.to_numpy() == code]
        serials = head.column(SERIAL).take(arrow.array(own[:SHOWN])).to_pylist()
        found.append(Said(name, len(own), serials))
    return sorted(found, key=lambda said: (not is_doubt(said.id), -said.tools, said.id))


def is_doubt(finding: str) -> bool:
    """Whether a finding says that a fit is doubtful, not only that something was chosen or looks odd."""
    return finding.endswith("-residuals") or finding in DOUBTS


def _orders(whole: Any, names: list[str]) -> dict[str, int]:
    """Tools by triad and the order that was chosen."""
    found: dict[str, int] = {}
    for triad in TRIADS:
        if f"{triad}_order" in names:
            values = numbers(whole, f"{triad}_order")
            orders, counts = np.unique(values[~np.isnan(values)], return_counts=True)
            pairs = zip(orders, counts, strict=True)
            found |= {f"{triad}: order {order:.0f}": int(count) for order, count in pairs}
    return found


def _equal(cells: Any, value: str) -> Any:
    from pyarrow import compute

    return compute.equal(cells, value)


def _undetermined(whole: Any, names: list[str]) -> dict[str, int]:
    """Tools by triad and direction that nothing determines."""
    found: dict[str, int] = {}
    for name in names:
        if name.endswith("_undetermined"):
            cells = whole.read([name]).column(0)
            for each in cells.combine_chunks().flatten().value_counts().to_pylist():
                value, count = each["values"], each["counts"]
                found[f"{name.removesuffix('_undetermined')}: {value}"] = count
    return found


def document(summary: Summary, report: Path | None) -> dict[str, Any]:
    """The summary for machines."""
    found: dict[str, Any] = msgspec.to_builtins(summary)
    found["tools_per_second"] = round(summary.tools / summary.seconds, 1)
    return {**found, "calibrated": summary.sound, "report": str(report or "")}


def text(summary: Summary, report: Path | None) -> str:
    """The summary for people: about one screen."""
    heading = (
        f"{summary.runs}   {summary.tools} tools   {summary.stations} stations   "
        f"method {summary.method}   order {summary.order}"
    )
    rows = [[k.status, str(k.tools), _serials(k)] for k in summary.statuses]
    lines = [heading, "", table(rows, ["status", "tools", "serials"])]
    refused = [kind for kind in summary.statuses if kind.status != OK]
    lines += [f"! {kind.status}, for example: {kind.message}" for kind in refused]
    lines += [f"! {said.id} in {_count(said)}" for said in summary.findings]
    spread = [
        [_title(name), *(number(v) for v in values)]
        for name, values in summary.spread.items()
        if values
    ]
    if spread:
        lines += ["", table(spread, ["of sound tools", "1 %", "median", "99 %"])]
    for name, count in summary.orders.items():
        lines.append(f"chosen for {count} tools: {name}")
    for name, count in summary.undetermined.items():
        lines.append(f"undetermined in {count} tools: {name}")
    lines += [f"! {note}" for note in summary.notes]
    rate = summary.tools / summary.seconds
    wrote = f"wrote {summary.output} (calibrations)" + (f"   {report} (report)" if report else "")
    return "\n".join([*lines, "", f"{wrote}   {summary.seconds:.1f} s, {rate:.0f} tools/s"])


def _count(said: Said) -> str:
    """How many tools have a finding, and which."""
    return f"{said.tools} {'tool' if said.tools == 1 else 'tools'}: {_first(said)}"


def _serials(kind: Kind) -> str:
    return "" if kind.status == OK else _first(kind)


def _first(some: Kind | Said) -> str:
    """The first serials of some tools."""
    return ", ".join(map(str, some.serials)) + (" …" if some.tools > len(some.serials) else "")


def _title(name: str) -> str:
    """A column as people call it."""
    if name.endswith("_variance_factor"):
        return f"{name.removesuffix('_variance_factor')} s²"
    return f"1σ {name.removesuffix('_sd_deg')} at 45°, °"
