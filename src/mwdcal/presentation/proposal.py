"""A proposed tool profile on the screen and for machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import asdict

from mwdcal.calibration.readings import TRIADS, simulated
from mwdcal.calibration.record import Finding
from mwdcal.errors import shell_word
from mwdcal.files.contract import RANGES
from mwdcal.files.formats.columns import WORKBOOKS
from mwdcal.files.formats.layout import Layout
from mwdcal.files.profiles import stand_in_settings
from mwdcal.identification.proposal import (
    Proposal,
    depths_of_surveys,
    findings_on,
    has_angles,
    in_order,
    stated_references,
)
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import RAW_UNIT, files_written, norths, raw_unit
from mwdcal.presentation.text import one_line, page_option, plural, table
from mwdcal.presentation.typed import findings_with_option_names
from mwdcal.sensor.profile import Axis, Profile, TableFormat, TriadProfile

MOST_LEFT_OUT = 4
"""Rows that the screen names."""
SCALE_UNITS = {"accelerometer": "g", "magnetometer": "nT"}


class ProposedTriad(TriadProfile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A triad of the profile, and what its axes leave of the readings' variation, where there are any.

    `axes` are empty where the table does not tell them.
    """

    axes: list[Axis]  # type: ignore[assignment]
    unexplained: float | None = None
    next_best: float | None = None


class ProposalSummary(Profile, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The output of `profile`: the profile, how sure its axes are, and its file."""

    run: str
    stations: int
    accelerometer: ProposedTriad
    magnetometer: ProposedTriad
    unit_by_values: list[str]
    findings: list[Finding]
    profile: str


def summary(proposal: Proposal, run: Path, output: Path | None) -> dict[str, Any]:
    """The result for machines."""
    content = ProposalSummary(
        **{**asdict(proposal.profile), **{kind: _triad(proposal, kind) for kind in TRIADS}},
        run=run.name,
        stations=proposal.stations,
        unit_by_values=sorted(proposal.by_value),
        findings=findings_with_option_names(findings_on(proposal)),
        profile=str(output or ""),
    )
    return json_document("profile", content, proposal.metadata, run=proposal.run_sha256)


def _triad(proposal: Proposal, kind: str) -> ProposedTriad:
    """A triad as the profile has it, and how sure its axes are."""
    triad, result = asdict(getattr(proposal.profile, kind)), proposal.wirings.get(kind)
    axes = [] if kind in proposal.open_axes else [*triad.pop("axes")]
    each = {**triad, "axes": axes}
    if result is None:
        return ProposedTriad(**each)
    return ProposedTriad(**each, unexplained=result.unexplained, next_best=result.next_best)


def screen(proposal: Proposal, run: Path, output: Path | None, has_roll_test: bool = False) -> str:
    """The result for people; `has_roll_test`: whether the file of the run has one beside it."""
    profile = proposal.profile
    head = [run.name, profile.name, plural(proposal.stations, "station")]
    blocks = ["   ".join(map(one_line, [*head, *simulated(proposal.metadata)]))]
    form = profile.table
    if not isinstance(form, msgspec.UnsetType) and (proposal.where or not form.find):
        blocks[0] += "\n" + _layout(proposal, form, run)
    if not isinstance(profile.columns, msgspec.UnsetType):
        guesses = dict.fromkeys(proposal.by_value, ", by its values")
        rows = [
            [c, each.name, (each.unit or "–") + guesses.get(c, "")]
            for c, each in in_order(profile.columns)
        ]
        rows += _of_place(proposal)
        blocks.append(table(rows, ["column of a run file", "column here", "unit here"]))
    rows = [
        [
            kind,
            " ".join(result.axes),
            _scale(getattr(profile, kind).scale, profile, kind),
            f"{result.unexplained:.1%}",
            f"{result.next_best:.0%}",
        ]
        for kind, result in proposal.wirings.items()
    ]
    rows += [
        [kind, "open: fill in", _scale(each.scale, profile, kind), "–", "–"]
        for kind, each in proposal.open_axes.items()
    ]
    blocks.append(
        table(rows, ["triad", "axes", "nominal scale", "variation left", "by the next best axes"])
    )
    blocks += [_next(proposal, run, output, has_roll_test)] if output else []
    return "\n\n".join(blocks)


def _next(proposal: Proposal, run: Path, output: Path, has_roll_test: bool) -> str:
    """The file that was written, and the command that takes it."""
    table_file, tool, result = map(shell_word, map(str, (run, output, output.with_suffix(".json"))))
    command = f"mwdcal calibrate {table_file} --tool {tool} -o {result}"
    command += f" --rolltest {table_file}" if has_roll_test else ""
    command += page_option(output.with_suffix(".html"))
    if depths_of_surveys(proposal):
        command = f"mwdcal survey TOOL.json {table_file} -o well.csv"
        command += page_option("well.html")
    else:
        first = ["add stations at other inclinations"] if proposal.level else []
        first += [f"fill in the axes in {one_line(output)}"] if proposal.open_axes else []
        command = f"{', '.join(first)}, then {command}" if first else command
    exact = (
        f"The angles of the stand count as exact until [stand] in {one_line(output)} states their 1σ.\n"
        if has_angles(proposal) and not stand_in_settings()
        else ""
    )
    return f"{exact}{files_written(profile=output)}   next: {one_line(command)}"


def _of_place(proposal: Proposal) -> list[list[str]]:
    """Rows of what is stated once for all stations: references, and what turns azimuths magnetic."""
    given = proposal.profile.form.north
    words = {"tool profile": "given", "run": "above the names"}
    return [
        *(
            [column, "above the names", f"{value:.8g} {RANGES[column].unit}"]
            for column, value in stated_references(proposal).items()
        ),
        *(
            [f"{name}_deg", words[source], angle]
            for name, angle, source in norths({**given, **proposal.metadata}, given)
        ),
    ]


def _scale(scale: float | None, profile: Profile, kind: str) -> str:
    if not scale:
        return "left open: no field strength"
    unit = raw_unit(profile, kind)
    return f"{scale:g} {'raw units' if unit == RAW_UNIT else unit} per {SCALE_UNITS[kind]}"


def _layout(proposal: Proposal, form: TableFormat, run: Path) -> str:
    """Where a table is and how it is written."""
    where = proposal.where
    written_so = where.form if where and form.find else form
    workbook = run.suffix.lower() in WORKBOOKS
    word = "row" if workbook else "line"
    place = (
        f"names in {word} {written_so.header_line}, readings from {word} {written_so.first_line}"
    )
    if where and where.across:
        place = f"stations in columns, the first names in {word} {written_so.header_line}"
    if form.find:
        place += "; looked for by its names whenever it is read"
    if where and where.left_out:
        place += f"\nleft out: {_left_out(where.left_out, word)}"
    place += "".join(_aside(t, where, word) for t in where.aside) if where else ""
    if workbook:
        return f"{_sheets(where)}, {place}" if where else place
    sign = "tab" if written_so.delimiter == "\t" else f"'{written_so.delimiter}'"
    return f"{written_so.encoding}, delimiter {sign}, decimal sign '{written_so.decimal}', {place}"


def _sheets(where: Layout) -> str:
    """The sheet of a table, or those that are joined."""
    sheets = [f"'{one_line(each)}'" for each in dict.fromkeys(where.parts or [where.sheet])]
    if len(sheets) == 1:
        return f"sheet {sheets[0]}"
    return f"sheets {', '.join(sheets[:-1])} and {sheets[-1]} joined as one run"


def _aside(table: Layout, run: Layout, word: str) -> str:
    """A line on a roll test, or a void run, in the file of a run."""
    sheet = f"sheet '{one_line(table.sheet)}', " if table.sheet != run.sheet else ""
    rows = f"{len(table.lines)} rows below {word} {table.form.header_line}"
    return f"\n{table.kind}: {sheet}{rows}; not part of the run"


def _left_out(rows: Sequence[tuple[int, str]], word: str) -> str:
    """The rows below the names that are no readings, the first few by what they say."""
    named = [f"{word} {line} ({one_line(text)})" for line, text in rows[:MOST_LEFT_OUT]]
    more = len(rows) - MOST_LEFT_OUT
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")
