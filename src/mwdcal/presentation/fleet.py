"""The results of a fleet: counts, spreads and undetermined directions, for people and machines.

The table of calibrations is read column by column, whatever its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration import fit_options
from mwdcal.calibration.diagnosis.findings import MISFIT_BY_COLUMN
from mwdcal.calibration.fit_options import FIT_OPTIONS, FitArguments
from mwdcal.calibration.readings import HIGHEST, TRIADS
from mwdcal.calibration.record import Finding, FitSettings
from mwdcal.files.formats import parquet
from mwdcal.fleet.calibrate import OK, STAND_COLUMNS
from mwdcal.fleet.sources import SERIAL
from mwdcal.fleet.tables import one_chunk
from mwdcal.geometry.vectors import Array
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import files_written, number
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.presentation.typed import with_option_names

SERIALS_SHOWN = 5
"""Most serials that a line names."""
DOUBTFUL_FITS = ("no-redundancy", "repeated-readings", "prior-conflict", MISFIT_BY_COLUMN)
"""Findings of a doubtful fit, besides residuals beyond the declared noise."""
ERRORS = [name for columns in STAND_COLUMNS.values() for name in columns]
"""Columns of errors of the stand."""
SPAN = 10.0
"""A run that spans more without temperature terms is mentioned, °C."""


@dataclass(frozen=True)
class StatusCount:
    """Tools of one status: how many, the first serials, and one message."""

    status: str
    tools: int
    serials: list[Any]
    message: str


class FleetFinding(msgspec.Struct, frozen=True, kw_only=True):
    """Tools with one finding: how many, and the first serials; of the whole table also its text."""

    id: str
    tools: int
    serials: list[Any]
    text: str | msgspec.UnsetType = msgspec.UNSET
    station: str | msgspec.UnsetType | None = msgspec.UNSET


class FleetCounts(msgspec.Struct, frozen=True, kw_only=True):
    """The results of a fleet. `spread` has the 1 %, 50 % and 99 % point of columns of sound tools.

    `orders` and `nonlinear`: tools by triad and chosen order, and by triad with own-axis terms.
    """

    runs: str
    output: str
    tools: int
    stations: int
    method: str
    order: int | str
    options: dict[str, Any]
    orders: dict[str, dict[str, int]]
    nonlinear: dict[str, int]
    statuses: list[StatusCount]
    findings: list[FleetFinding]
    spread: dict[str, list[float | None]]
    undetermined: dict[str, int]
    parts: int
    parts_done_before: int
    seconds: float
    notes: list[str]


class FleetSummary(FleetCounts, frozen=True, kw_only=True):
    """The content of screens and pages: columns of all tools that are not used, and the table's metadata too."""

    unused: list[Finding]
    metadata: dict[str, Any]

    @property
    def sound(self) -> int:
        """Number of calibrated tools."""
        return sum(kind.tools for kind in self.statuses if kind.status == OK)


class FleetDocument(FleetCounts, frozen=True, kw_only=True):
    """The output of `fleet`: the fields of `FleetSummary`, the number of calibrated tools, and the page."""

    tools_per_second: float
    calibrated: int
    report: str


def summarise(target: Path, typed: FitArguments, notes: list[str], **facts: Any) -> FleetSummary:
    """Summary of the table of calibrations `target`, read column by column, beside other `facts`."""
    _, pq = parquet.modules(target.name)
    whole = pq.ParquetFile(target)
    head = whole.read([SERIAL, "status", "message", "findings"])
    columns, options = whole.schema_arrow.names, fit_options.stated_arguments(typed)
    shown = [n for n in columns if n.endswith(("_sd_deg", "_variance_factor")) or n in ERRORS]
    return FleetSummary(
        **facts,
        metadata=parquet.metadata_of(whole.schema_arrow.metadata, target.name),
        tools=head.num_rows,
        method=typed["method"],
        order=options["order"],
        options=options,
        orders=_orders(whole, columns) if typed["order"] == "auto" else {},
        nonlinear=_nonlinear(whole, columns),
        statuses=_kinds(head),
        findings=_findings(head),
        spread={name: [*quantiles(numbers(whole, name))] for name in shown},
        undetermined=_undetermined(whole, columns),
        notes=notes + (_wide(whole) if typed["order"] == "0" else []),
    )


def _wide(whole: Any) -> list[str]:
    """What to say of tools whose temperatures differ, where there are no temperature terms."""
    span = numbers(whole, "temperature_max_c") - numbers(whole, "temperature_min_c")
    wide = int(np.sum(span > SPAN))
    spans = f"{plural(wide, 'tool')} {'spans' if wide == 1 else 'span'} more than {SPAN:g} °C"
    return [f"{spans}, and --order 0 has no temperature terms."] if wide else []


def unusual(options: dict[str, Any]) -> list[str]:
    """The options beyond method and order that are not the usual ones, in words."""
    usual: dict[str, Any] = {"model": None, "nonlinearity": "none", "estimate": [], "seed": None}
    before = {
        name: FIT_OPTIONS[name].heading.format(
            " and ".join(value) if isinstance(value, list) else value
        )
        for name, default in usual.items()
        if (value := options[name]) != default and value != 0
    }
    seed = [before.pop("seed")] if "seed" in before else []
    settings = msgspec.convert(options, FitSettings)
    return [*before.values(), *fit_options.unusual(settings, "heading"), *seed]


def numbers(whole: Any, name: str) -> Array:
    """One column of numbers of an opened Parquet file, or NaN."""
    cells = whole.read([name]).column(0)
    return np.asarray(cells.cast("float64").to_numpy(), float)


def quantiles(values: Array) -> list[float]:
    """The 1 %, 50 % and 99 % point of values, none where all are NaN."""
    return [] if np.isnan(values).all() else np.nanquantile(values, (0.01, 0.5, 0.99)).tolist()


def _kinds(head: Any) -> list[StatusCount]:
    """Statuses with their tools, sound ones first, then by number."""
    from pyarrow import compute

    status = head.column("status")
    counts = dict(each.values() for each in status.value_counts().to_pylist())
    kinds = []
    for name, count in sorted(counts.items(), key=lambda kind: (kind[0] != OK, -kind[1])):
        tools = head.filter(compute.equal(status, name)).slice(0, SERIALS_SHOWN).to_pydict()
        kinds.append(
            StatusCount(name, count, tools[SERIAL], with_option_names(tools["message"][0]))
        )
    return kinds


def _findings(head: Any) -> list[FleetFinding]:
    """Findings with their tools: doubts of the fit first, then by number."""
    column = one_chunk(head.column("findings"))
    ids = column.flatten().dictionary_encode()
    tool = np.repeat(np.arange(len(column)), column.value_lengths().fill_null(0).to_numpy())
    findings = []
    for code, name in enumerate(ids.dictionary.to_pylist()):
        tools = tool[ids.indices.to_numpy() == code]
        serials = head.column(SERIAL).take(tools[:SERIALS_SHOWN]).to_pylist()
        findings.append(FleetFinding(id=name, tools=len(tools), serials=serials))
    return sorted(findings, key=lambda f: (not is_doubt(f.id), -f.tools, f.id))


def is_doubt(finding: str) -> bool:
    """Whether a finding says that a fit is doubtful, not only that something was chosen or looks odd."""
    return finding.endswith("-residuals") or finding in DOUBTFUL_FITS


def _orders(whole: Any, columns: list[str]) -> dict[str, dict[str, int]]:
    """Tools by triad and the order that was chosen."""
    orders: dict[str, dict[str, int]] = {}
    for triad in TRIADS:
        if f"{triad}_order" in columns:
            values = numbers(whole, f"{triad}_order")
            orders[triad] = {str(k): int(np.sum(values == k)) for k in range(HIGHEST + 1)}
    return {triad: counts for triad, counts in orders.items() if any(counts.values())}


def _nonlinear(whole: Any, columns: list[str]) -> dict[str, int]:
    """Tools by triad that have own-axis terms, where they may."""
    return {
        triad: int(np.sum(~np.isnan(numbers(whole, f"{triad}_radius"))))
        for triad in TRIADS
        if f"{triad}_radius" in columns
    }


def _undetermined(whole: Any, columns: list[str]) -> dict[str, int]:
    """Tools by triad and direction that nothing determines."""
    counts: dict[str, int] = {}
    for name in columns:
        if name.endswith("_undetermined"):
            cells = whole.read([name]).column(0).combine_chunks().flatten()
            for each in cells.value_counts().to_pylist():
                direction = f"{name.removesuffix('_undetermined')}: {each['values']}"
                counts[direction] = each["counts"]
    return counts


def document(summary: FleetSummary, report: Path | None) -> dict[str, Any]:
    """The summary for machines."""
    counts = {name: getattr(summary, name) for name in FleetCounts.__struct_fields__}
    unused = [
        FleetFinding(**msgspec.to_builtins(each), tools=summary.tools, serials=[])
        for each in summary.unused
    ]
    content = FleetDocument(
        **{**counts, "findings": [*summary.findings, *unused]},
        tools_per_second=round(summary.tools / summary.seconds, 1),
        calibrated=summary.sound,
        report=str(report or ""),
    )
    stated = summary.metadata
    return json_document("fleet", content, stated, profile=stated["profile_sha256"])


def text(summary: FleetSummary, report: Path | None) -> str:
    """The summary for people: about one screen."""
    rows = [[k.status, str(k.tools), "" if k.status == OK else _first(k)] for k in summary.statuses]
    spread = [
        [
            _title(name),
            *(number(value, 2 if name.endswith("_sd_deg") else None) for value in values),
        ]
        for name, values in summary.spread.items()
        if values
    ]
    blocks = [_heading(summary), table(rows, ["status", "tools", "serials"])]
    if spread:
        blocks.append(table(spread, ["of sound tools", "1 %", "median", "99 %"]))
    if summary.orders:
        orders = [[triad, *map(str, counts.values())] for triad, counts in summary.orders.items()]
        blocks.append(table(orders, ["tools of order", *map(str, range(HIGHEST + 1))]))
    rate = f"{summary.seconds:.1f} s, {summary.tools / summary.seconds:.0f} tools/s"
    files = "in memory"
    if summary.output or report:
        files = files_written(calibrations=summary.output, report=report)
    return "\n".join(["\n\n".join(blocks), *_remarks(summary), "", f"{files}   {rate}"])


def _heading(summary: FleetSummary) -> str:
    """The subject and the method of the calibration."""
    counts = [plural(summary.tools, "tool"), plural(summary.stations, "station")]
    how = [f"method {summary.method}", f"order {summary.order}"]
    also = unusual(summary.options)
    options = f"\noptions: {', '.join(also)}" if also else ""
    return one_line("   ".join([summary.runs, *counts, *how])) + options


def findings(summary: FleetSummary) -> list[Finding]:
    """Why tools were refused, findings of the others, columns that are not used, and notes."""
    refused = [kind for kind in summary.statuses if kind.status != OK]
    texts = [
        *((k.status, f"{k.status}, for example: {one_line(k.message)}") for k in refused),
        *((f.id, f"{f.id} in {plural(f.tools, 'tool')}: {_first(f)}") for f in summary.findings),
        *(("fleet", note) for note in summary.notes),
    ]
    return [*(Finding(id=name, text=text) for name, text in texts), *summary.unused]


def _remarks(summary: FleetSummary) -> list[str]:
    """Own-axis terms, and what is undetermined."""
    nonlinear, undetermined = summary.nonlinear.items(), summary.undetermined.items()
    return [
        *(f"own-axis terms in {plural(count, 'tool')}: {name}" for name, count in nonlinear),
        *(f"undetermined in {plural(count, 'tool')}: {name}" for name, count in undetermined),
    ]


def _first(some: StatusCount | FleetFinding) -> str:
    """The first serials of some tools."""
    return ", ".join(map(one_line, some.serials)) + (" …" if some.tools > len(some.serials) else "")


def _title(name: str) -> str:
    """A column as people call it."""
    if name.endswith("_variance_factor"):
        return f"{name.removesuffix('_variance_factor')} s²"
    if name in ERRORS:
        return f"stand: {name.removesuffix('_deg').replace('_', ' ')}, °"
    return f"1σ {name.removesuffix('_sd_deg')} at 45°, °"
