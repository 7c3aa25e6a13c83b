"""The printed output of a registry, for people and for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.diagnosis.identity import FROM_THE_FUTURE, UNIDENTIFIED
from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Finding
from mwdcal.files.formats.columns import shown
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import number
from mwdcal.presentation.text import UNCUT, one_line, plural, table
from mwdcal.registry.checking import Discrepancy
from mwdcal.registry.imports import Adding, FileResult
from mwdcal.registry.lookup import ListedRecord, ListedTool, Listing, alike
from mwdcal.registry.store import Registry

KEYS = ("number", "kind", "sha256", "name")
"""The key that names a record in a document."""
ACCURACIES = ("inclination", "toolface", "azimuth")
MOST_REFUSED = 20
"""Most findings of a kind."""
SHOWN_DIGITS = 12
"""Digits of a SHA-256 on the screen."""


class RegistryCreated(msgspec.Struct, frozen=True, kw_only=True):
    """A new registry, and the hash of its first event."""

    registry: str
    head: str


class RegistryUpgraded(msgspec.Struct, frozen=True, kw_only=True):
    """The versions of a registry's schema before and after."""

    before: str
    after: str


class RegistryAdded(msgspec.Struct, frozen=True, kw_only=True):
    """The additions: new records by kind, how many were known or refused, each file; the newest event."""

    registry: str
    new: dict[str, int]
    known: int
    refused: int
    files: list[FileResult]
    events: int
    head: str
    findings: list[Finding]


class RegistryWithdrawn(msgspec.Struct, frozen=True, kw_only=True):
    """A record that no longer counts, and why."""

    number: int
    kind: str
    sha256: str
    name: str
    reason: str
    head: str


class RegistryDocument(msgspec.Struct, frozen=True, kw_only=True):
    """A document of a registry, and the file that it was written to."""

    number: int
    kind: str
    sha256: str
    name: str
    output: str


class RegistryExported(msgspec.Struct, frozen=True, kw_only=True):
    """A folder with all documents of a registry; how many events it had, and the hash of the newest."""

    folder: str
    files: int
    events: int
    head: str


class RegistryCopied(msgspec.Struct, frozen=True, kw_only=True):
    """A backup, and the hash of its newest event."""

    file: str
    head: str


class RegistryProblem(msgspec.Struct, frozen=True, kw_only=True):
    """Something in a registry that the program did not write; `number` of its event or record."""

    id: str
    text: str
    number: int | None


class RegistryChecked(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a registry is sound, and what is not; how many events it has, and the hash of the newest."""

    registry: str
    sound: bool
    discrepancies: list[RegistryProblem]
    events: int | None
    head: str | None


def document(command: str, content: object, *metadata: Mapping[str, object]) -> dict[str, Any]:
    """A result for machines."""
    return json_document(command, content, *metadata)


def added(registry: Registry, adding: Adding) -> RegistryAdded:
    """The outcome for all files."""
    results = adding.results
    findings = [*_refusals(results), *_doubts(registry, adding)]
    events, head = registry.head()
    return RegistryAdded(
        registry=registry.name,
        new=dict(adding.new),
        known=sum(each.known for each in results),
        refused=sum(each.refused for each in results),
        files=results,
        events=events,
        head=head,
        findings=findings,
    )


def _refusals(results: Sequence[FileResult]) -> list[Finding]:
    """Why files, or parts of them, were not added: each reason once, with a file that has it."""
    groups: dict[tuple[str, ...], list[FileResult]] = {}
    for each in results:
        if each.refused:
            part = each.new or each.known or each.refused > 1
            why = each.message.removeprefix(f"{Path(each.file).name}: ")
            groups.setdefault((why, each.file) if part else (why,), []).append(each)
    some = [*groups.values()][:MOST_REFUSED]
    findings = [Finding(id="refused-file", text=_refusal(group)) for group in some]
    if more := sum(map(len, groups.values())) - sum(map(len, some)):
        text = f"{more} more files were not added, or not all of them."
        findings.append(Finding(id="refused-file", text=text))
    return findings


def _refusal(group: Sequence[FileResult]) -> str:
    """Why files that have it in common were not added, or a part of one."""
    first = group[0]
    if len(group) > 1:
        return f"not added, {len(group)} files, such as {first.message}"
    if first.new or first.known or first.refused > 1:
        return (
            f"{first.file}: {plural(first.refused, 'record')} not added, such as: {first.message}"
        )
    return f"not added: {first.message}"


def _doubts(registry: Registry, adding: Adding) -> list[Finding]:
    """Additions that may not be as they were meant."""
    findings = []
    if adding.unidentified:
        text = (
            f"{plural(len(adding.unidentified), 'record')} without a serial, such as {adding.unidentified[0]}: nothing "
            "shows of which tool, and no tool lists them. State it in the run (--serial), calibrate "
            "again, and withdraw these."
        )
        findings.append(Finding(id=UNIDENTIFIED, text=text))
    if adding.future:
        text = (
            f"{plural(len(adding.future), 'record')} of a day that is still to come, such as {adding.future[0]}: "
            "correct the date in the run, or the clock of this computer."
        )
        findings.append(Finding(id=FROM_THE_FUTURE, text=text))
    if adding.undated:
        text = (
            f"{plural(len(adding.undated), 'calibration')} without a day of the measurement, such as "
            f'{adding.undated[0]}: that of the fit counts. State it in the run, as # date = "2026-01-31", and '
            "calibrate again."
        )
        findings.append(Finding(id="no-date", text=text))
    if adding.changed:
        text = (
            f"{plural(len(adding.changed), 'calibration')} changed after mwdcal calibrate made it, such as "
            f"{adding.changed[0]}: if that was not meant, withdraw it, and add the file as it was written."
        )
        findings.append(Finding(id="changed", text=text))
    for group in alike(registry, adding.serials)[:MOST_REFUSED]:
        text = (
            f"the serials {' and '.join(map(shown, group))} are of different tools, and differ in case, spaces or "
            "the form of characters alone. If they mean one tool, correct the files, and withdraw the others."
        )
        findings.append(Finding(id="similar-serials", text=text))
    return findings


def added_text(result: RegistryAdded, simulated: bool) -> str:
    """The same for people."""
    new = [plural(count, kind.replace("-", " ")) for kind, count in result.new.items()]
    parts = [result.registry, f"added {', '.join(new)}" if new else "nothing new"]
    if result.known:
        parts.append(f"{plural(result.known, 'record')} there already")
    if result.refused:
        parts.append(f"{result.refused} refused")
    return one_line("   ".join([*parts, *[SIMULATED] * simulated])) + _newest(
        result.events, result.head
    )


def _newest(events: int | None, head: str | None) -> str:
    """How long the history is, and the hash to note of it."""
    return f"\n{plural(events or 0, 'event')}, the newest {head}"


def withdrawn(registry: Registry, row: Mapping[str, Any], reason: str) -> RegistryWithdrawn:
    """A record that was withdrawn."""
    about = {key: row[key] for key in KEYS}
    return RegistryWithdrawn(**about, reason=reason, head=registry.head()[1])


def withdrawn_text(result: RegistryWithdrawn) -> str:
    """The same for people."""
    return one_line(
        f"withdrew record {result.number}, {result.kind} {result.name}: {result.reason}"
    )


def got_text(result: RegistryDocument) -> str:
    """A document that was written to a file."""
    return one_line(
        f"wrote {result.output}   {result.kind} {result.name}   SHA-256 {result.sha256}"
    )


def exported_text(result: RegistryExported) -> str:
    """How many documents were written."""
    said = f"wrote {plural(result.files, 'document')} to {result.folder}"
    return one_line(f"{said}   newest event {result.head}")


def copied_text(result: RegistryCopied) -> str:
    """A backup, and the hash to note of it."""
    return one_line(f"wrote {result.file}   newest event {result.head}")


def problems_of(result: RegistryChecked) -> list[Finding]:
    """The discrepancies of a check, as findings."""
    return [Finding(id=each.id, text=f"{each.text}.") for each in result.discrepancies]


def checked(registry: Registry, discrepancies: Sequence[Discrepancy]) -> RegistryChecked:
    """The outcome of a check."""
    problems = [RegistryProblem(id=d.id, text=d.text, number=d.number) for d in discrepancies]
    events, head = (None, None) if problems else registry.head()
    return RegistryChecked(
        registry=registry.name,
        sound=not problems,
        discrepancies=problems,
        events=events,
        head=head,
    )


def check_text(result: RegistryChecked) -> str:
    """The outcome of a check for people."""
    if result.sound:
        return one_line(f"PASS   {result.registry}: sound") + _newest(result.events, result.head)
    count = len(result.discrepancies)
    failed = one_line(f"FAIL   {result.registry}: altered in {plural(count, 'place')}")
    return f"{failed}\nnext: mwdcal registry restore BACKUP --registry NEW   (the last backup that is sound)"


def list_text(listing: Listing) -> str:
    """Tools, or records of a kind."""
    blocks = [_heading(listing, listing.kind)]
    if listing.tools:
        head = ["serial", "type", "calibrated", "n", *ACCURACIES, "due", "verdict"]
        blocks.append(table([_tool_cells(t) for t in listing.tools], head, UNCUT))
        blocks.append(f"{', '.join(ACCURACIES)}: 1σ to expect of the last calibration, degrees")
    if listing.records and listing.kind == "tool":
        blocks.append(f"{plural(len(listing.records), 'measurement standard')} due")
    if listing.records:
        blocks.append(_records_table(listing.records, serials=True))
    return "\n\n".join(blocks)


def history_text(listing: Listing) -> str:
    """The past of a tool."""
    return "\n\n".join(
        [_heading(listing, "record"), _records_table(listing.records, serials=False)]
    )


def _heading(listing: Listing, noun: str) -> str:
    """How many there are, and which of them are shown."""
    simulated = any(t.simulated for t in listing.tools) or any(r.simulated for r in listing.records)
    shown_rows = len(listing.tools) or len(listing.records)
    part = (
        f"   {listing.offset + 1} to {listing.offset + shown_rows}"
        if 0 < shown_rows < listing.total
        else ""
    )
    words = [f"{plural(listing.total, noun)}{part}", *[SIMULATED] * simulated]
    return "   ".join(words)


def _tool_cells(tool: ListedTool) -> list[str]:
    angles = [number(getattr(tool, f"{angle}_deg"), 2) for angle in ACCURACIES]
    facts = [tool.serial, tool.type or "", day(tool.calibrated), str(tool.calibrations)]
    return [*facts, *angles, day(tool.next_due), tool.status or ""]


def _records_table(records: Sequence[ListedRecord], serials: bool) -> str:
    """Records, with the serial of each or without."""
    head = ["record", "kind", *["serial"] * serials, "of", "what", "SHA-256", "added", "by"]
    rows = []
    for each in records:
        what = [each.label or each.type or each.name, each.status or ""]
        what += [f"due {day(each.next_due)}"] * bool(each.next_due)
        what += [f"withdrawn: {each.reason}"] * bool(each.reason)
        cells = [str(each.number), each.kind, *[each.serial or ""] * serials, day(each.time)]
        described = ", ".join(filter(None, what))
        rows.append(
            [
                *cells,
                described,
                each.sha256[:SHOWN_DIGITS],
                each.added[: len("2026-01-31")],
                each.actor,
            ]
        )
    return table(rows, head, UNCUT)


def day(time: str | None) -> str:
    """The day of a time."""
    return (time or "")[: len("2026-01-31")]
