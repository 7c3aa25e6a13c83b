"""Files and folders into a registry: portions of work for any worker, and what became of each file."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from mwdcal import pool
from mwdcal.calibration.readings import future_day, stated_day
from mwdcal.calibration.record import Calibration, canonical
from mwdcal.errors import InputError, MwdcalError, reason
from mwdcal.files import documents, runs
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import members
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.atomic import HIDDEN_BY_SYSTEMS, visible_files
from mwdcal.files.metadata import load_toml
from mwdcal.files.profiles import decoded_profile
from mwdcal.registry.database.schema import TOOL_KINDS
from mwdcal.registry.exports import read_manifest
from mwdcal.registry.lookup import records_page
from mwdcal.registry.store import Draft, Entry, Registry, rows_to_insert
from mwdcal.registry.stored import LARGEST_OBJECT, content_address
from mwdcal.sensor.profile import MeasurementStandard, Person

# --------------------------------------------------------------------------
# A file as a registry sees it: the records that are made of it, by its content.

TABLE_SUFFIXES = (*tables.SUFFIXES, *tables.EXCHANGED)
"""Suffixes of files with tables."""
COMMANDS_KEPT = {"calibrate": "calibration", "verify": "verification", "certificate": "certificate"}
"""Kinds of documents by the command that writes them."""
LABORATORY_KEYS = ("laboratory", "customer", "measured_by", "authorised_by", "number")
"""Of which a laboratory file has one at least."""
PEOPLE = LABORATORY_KEYS[2:4]
_BOM = b"\xef\xbb\xbf"
_PRIVATE, _PUBLIC = b"PRIVATE KEY-----", b"-----BEGIN PUBLIC KEY-----"
_NOT_KEPT = (
    "a registry keeps calibrations, verifications and certificates of mwdcal, runs, tool profiles, limits, "
    "laboratories and public keys, and this is something else. Leave it out."
)


class UnlikeRunError(InputError):
    """A table that is a run only if some calibration was made of it: `entry`."""

    def __init__(self, message: str, entry: Entry) -> None:
        super().__init__(f"{message} Add it together with a calibration that was made of it.")
        self.entry = entry


def of_fleet(file: Path, group: int) -> Iterator[Entry]:
    """The calibrations in a row group of a fleet's table, each as the file that `mwdcal fleet` writes of it."""
    for serial, record in members.records(file, [group]):
        yield Entry("calibration", documents.laid_out(record), f"{serial}.json")


def content(file: Path) -> bytes:
    """The bytes of a file, of at most `LARGEST_OBJECT`."""
    tables.check_file(file)
    try:
        size = file.stat().st_size
        if size <= LARGEST_OBJECT:
            return file.read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({reason(error)}). Check its rights.") from None
    raise InputError(
        f"{file.name}: a registry takes files of at most {LARGEST_OBJECT:,} bytes; got {size:,}."
    )


def of_bytes(data: bytes, name: str) -> list[Entry]:
    """The records that a file is, and what it names: people and standards.

    The name of the file counts for tables, whose format is its suffix.

    Raises:
        UnlikeRunError: a table that may be a run whose columns have names of their own.
        InputError: it is nothing that a registry keeps, or damaged.
    """
    if _PRIVATE in data:
        raise InputError(
            f"{name}: a private key is for its owner alone; a registry keeps the public one. Add that."
        )
    if _PUBLIC in data:
        return [Entry("public-key", data, name)]
    if (text := _json_text(data)).startswith(b"{"):
        return [Entry(_json_kind(text, name), data, name)]
    if Path(name).suffix.lower() in TABLE_SUFFIXES:
        return [_run(data, name)]
    try:
        return _of_toml(data, name)
    except InputError as error:
        if (
            Path(name).suffix.lower() in tables.LAID_OUT
        ):  # of a laboratory, if a calibration was made of it
            raise UnlikeRunError(str(error), Entry("run", data, name)) from None
        raise


def checked(entry: Entry) -> Calibration | None:
    """The calibration that an entry is, one that every command accepts; None where it is another document."""
    if entry.kind == "calibration":
        return documents.decoded(members.Member(entry.data, entry.name, ""))
    return None


def _json_text(data: bytes) -> bytes:
    """The file in UTF-8 without the mark at its beginning; as it is where it is no text."""
    with suppress(UnicodeDecodeError):
        return documents.in_utf8(data).lstrip()
    return data


def _json_kind(data: bytes, name: str) -> str:
    """The kind of a JSON document."""
    try:
        fields = msgspec.json.decode(data, type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{name}: it is damaged ({error}). Write it again.") from None
    kinds = {"quantity": "standard", "function": "person"}
    kind = COMMANDS_KEPT.get(str(fields.get("command"))) or next(
        (kind for key, kind in kinds.items() if key in fields), ""
    )
    if not kind:
        raise InputError(f"{name}: {_NOT_KEPT}")
    return kind


def _run(data: bytes, name: str) -> Entry:
    """A table of readings, and whose they are where it says so."""
    try:
        table = tables.parsed(data, name)
    except InputError as error:
        raise UnlikeRunError(str(error), Entry("run", data, name)) from None
    if table.metadata.get("command") == "fleet":
        raise members.without_records(name)
    serials = runs.serials(table.metadata, tables.labels(table, "serial"))
    entry = Entry("run", data, name, serials[0] if len(serials) == 1 else None)
    if missing := {*CHANNELS["accelerometer"]} - {*table.columns}:
        columns = ", ".join(sorted(missing))
        raise UnlikeRunError(f"{name}: the columns of a run are missing ({columns}).", entry)
    return entry


def _of_toml(data: bytes, name: str) -> list[Entry]:
    """A tool profile, limits or a laboratory, with the people and standards that it names."""
    try:
        fields = load_toml(data.removeprefix(_BOM).decode())
    except (ValueError, RecursionError):
        raise InputError(f"{name}: {_NOT_KEPT}") from None
    try:
        kind = _toml_kind(fields, data, name)
        people = [msgspec.convert(fields[key], Person) for key in PEOPLE if key in fields]
        standards = msgspec.convert(fields.get("standards", []), list[MeasurementStandard])
    except (msgspec.ValidationError, TypeError) as error:
        raise InputError(f"{name}: {error}. Correct the file.") from None
    derived = [("person", msgspec.to_builtins(each)) for each in people]
    derived += [("standard", msgspec.to_builtins(each)) for each in standards]
    return [
        Entry(kind, data, name),
        *(Entry(kind, canonical(about), f"{about['name']}.json") for kind, about in derived),
    ]


def _toml_kind(fields: Mapping[str, Any], data: bytes, name: str) -> str:
    if {"spread", "error"} & {*fields}:
        return "limits"
    if {*LABORATORY_KEYS} & {*fields}:
        return "laboratory"
    if {"accelerometer", "magnetometer"} & {*fields}:
        decoded_profile(data.removeprefix(_BOM), name)
        return "profile"
    raise InputError(f"{name}: {_NOT_KEPT}")


FILES_AT_ONCE = 50
"""Files of a portion."""
FEWEST_PORTIONS = 3
"""Portions of work from which workers of their own are worth their start."""
RECORDS_AT_ONCE = 1000
"""Records that are added in one transaction."""
COUNTS = ("new", "known", "refused")


class Source(NamedTuple):
    """A file to add, or a row group of the table of a fleet; of an export, what its manifest says of it.

    `data`: the bytes of a file that is in memory alone, and has no path but a name.
    """

    path: Path
    group: int | None = None
    kind: str = ""
    name: str = ""
    serial: str | None = None
    sha256: str = ""
    reason: str | None = None
    data: bytes = b""


@dataclass
class Prepared:
    """The contents of a source: drafts of records, or a `doubtful` one of a table that may be a run.

    `problems` say what is wrong. SHA-256 of calibrations: `undated` of those that state no day of measurement,
    `changed` of those whose contents are not those that were written.
    """

    source: Source
    drafts: list[Draft] = field(default_factory=list)
    doubtful: Draft | None = None
    problems: list[str] = field(default_factory=list)
    undated: set[str] = field(default_factory=set)
    changed: set[str] = field(default_factory=set)


class FileResult(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome for a file: how many records are new, known already, or refused; and why."""

    file: str
    kind: str
    new: int = 0
    known: int = 0
    refused: int = 0
    message: str = ""


def sources(paths: Iterable[Path]) -> list[Source]:
    """The sources to add at some paths: files, and all files of folders; row groups of fleets by themselves.

    Raises:
        InputError: a path at which there is nothing, or an export with a damaged manifest.
    """
    result: dict[tuple[Path, int | None], Source] = {}
    for path in paths:
        for source in _of_folder(path) if path.is_dir() else _of_file(path):
            result.setdefault((source.path.resolve(), source.group), source)
    return [*result.values()]


def _of_folder(folder: Path) -> Iterator[Source]:
    """The files of an export by its manifest, or all that no system hides."""
    manifest = read_manifest(folder)
    if manifest is None:
        for file in visible_files(folder, HIDDEN_BY_SYSTEMS):
            yield from _of_file(file)
        return
    for each in manifest.files:
        about = each.kind, each.name, each.serial, each.sha256, each.reason
        yield Source(folder / each.path, None, *about)


def _of_file(file: Path) -> Iterator[Source]:
    """A file, or the row groups of the table of a fleet."""
    if not file.exists():
        raise InputError(f"'{file}': no such file. Check the name and the folder.")
    groups: Iterable[int | None] = [None]
    with suppress(InputError):  # what cannot be read is reported where it is read
        groups = members.groups(file) if members.is_fleet(file) else groups
    yield from (Source(file, group) for group in groups)


def portions(whole: Sequence[Source]) -> list[Sequence[Source]]:
    """Sources in parts that are worth a worker: row groups alone, files some at a time."""
    groups = [[source] for source in whole if source.group is not None]
    files = [source for source in whole if source.group is None]
    some = [files[i : i + FILES_AT_ONCE] for i in range(0, len(files), FILES_AT_ONCE)]
    return [*groups, *some]


def solve(portion: Sequence[Source]) -> bytes:
    """The contents of a portion, for another process: a list of `Prepared`."""
    return pickle.dumps([prepared(source) for source in portion])


def prepared(source: Source) -> Prepared:
    """The contents of a source; what is wrong with it is data."""
    result = Prepared(source)
    try:
        entries = _entries(source)
    except UnlikeRunError as error:
        result.doubtful = rows_to_insert(error.entry)
        result.problems.append(str(error))
        return result
    except MwdcalError as error:
        result.problems.append(str(error))
        return result
    for entry in entries:
        try:
            calibration, one = checked(entry), rows_to_insert(entry)
            result.drafts.append(one)
            if calibration and not stated_day(calibration.tool):
                result.undated.add(one["sha256"])
            if calibration and source.group is None and calibration.changed:
                result.changed.add(one["sha256"])
        except MwdcalError as error:
            result.problems.append(str(error))
    return result


def _entries(source: Source) -> Iterable[Entry]:
    """The records that a source is by its declaration or content."""
    if source.group is not None:
        return of_fleet(source.path, source.group)
    data = source.data or content(source.path)
    if not source.kind:
        return of_bytes(data, source.path.name)
    if content_address(data) != source.sha256:
        raise InputError(f"{source.path.name}: it was changed since it was exported. Export again.")
    return [Entry(source.kind, data, source.name, source.serial)]


class Adding:
    """Files on their way into a registry, some hundred records in a transaction.

    `results` say what became of each file, `new` how many records of each kind are new, `serials` of which tools,
    `unidentified` the names of new records of tools that state no serial, `future` of those of a day that is still
    to come, `undated` of new calibrations whose runs state no date, `changed` of those that were changed after they
    were made, `simulated` whether one of the files rests on simulated data.
    """

    def __init__(self, registry: Registry, actor: str) -> None:
        self._registry, self._actor = registry, actor
        self._waiting: list[tuple[Source, Draft]] = []
        self._doubtful: list[Prepared] = []
        self._runs: set[str] = set()
        self._undated: set[str] = set()
        self._changed: set[str] = set()
        self._files: dict[Path, FileResult] = {}
        self.new: Counter[str] = Counter()
        self.serials: set[str] = set()
        self.unidentified: list[str] = []
        self.future: list[str] = []
        self.undated: list[str] = []
        self.changed: list[str] = []
        self.simulated = False

    @property
    def results(self) -> list[FileResult]:
        """The outcome for each file."""
        return [*self._files.values()]

    def take(self, each: Prepared) -> None:
        """Add what a source holds, soon."""
        if each.doubtful:
            self._doubtful.append(each)
            return
        self._undated |= each.undated
        self._changed |= each.changed
        for message in each.problems:
            self._count(each.source, refused=1, message=message)
        for one in each.drafts:
            self._waiting.append((each.source, one))
            self.simulated = self.simulated or bool(one["simulated"])
            if one["run"]:
                self._runs.add(one["run"])
            if len(self._waiting) == RECORDS_AT_ONCE:
                self._add()

    def finish(self) -> None:
        """Add what waits, and tables that turned out to be runs."""
        for each in self._doubtful:
            if each.doubtful and self._is_run(each.doubtful["sha256"]):
                self._waiting.append((each.source, each.doubtful))
            else:
                self._count(each.source, refused=1, message=each.problems[0])
        self._add()

    def _is_run(self, sha256: str) -> bool:
        """Whether a calibration was made of a file."""
        return sha256 in self._runs or bool(
            records_page(self._registry, "calibration", {"run": sha256}, limit=1).rows
        )

    def _add(self) -> None:
        drafts = [one for _, one in self._waiting]
        reasons = [source.reason for source, _ in self._waiting]
        all_added = self._registry.insert(drafts, self._actor, reasons=reasons)
        for (source, one), added in zip(self._waiting, all_added, strict=True):
            self._count(source, added.kind, new=int(added.new), known=int(not added.new))
            if added.new:
                self.new[added.kind] += 1
                self._note(one)
        self._waiting = []

    def _note(self, new: Draft) -> None:
        """Remember the serial of a new record, and whether it is a calibration of an unknown day, or was changed."""
        if new["kind"] in TOOL_KINDS:
            if new["serial"]:
                self.serials.add(new["serial"])
            else:
                self.unidentified.append(new["name"])
            if future_day({"date": new["time"]}):
                self.future.append(new["name"])
        if new["sha256"] in self._undated:
            self.undated.append(new["name"])
        if new["sha256"] in self._changed:
            self.changed.append(new["name"])

    def _count(self, source: Source, kind: str = "", message: str = "", **more: int) -> None:
        file = str(source.path)
        before = self._files.get(source.path) or FileResult(file=file, kind=kind)
        counts = {name: getattr(before, name) + more.get(name, 0) for name in COUNTS}
        self._files[source.path] = replace(
            before, kind=before.kind or kind, message=before.message or message, **counts
        )


def add_all(
    adding: Adding,
    portions: Sequence[Sequence[Source]],
    workers: int,
    advance: Callable[[int, int], None],
) -> None:
    """Add portions in their order, by workers if there are enough of them; `advance` hears how many are done."""
    steps, ready, following = pool.Steps(list, solve), {}, 0
    for index, result in pool.results(
        steps, portions, workers if len(portions) >= FEWEST_PORTIONS else 1, None
    ):
        ready[index] = result
        while following in ready:
            for each in pickle.loads(ready.pop(following)):  # of our own workers
                adding.take(each)
            following += 1
        advance(following, len(portions))
    adding.finish()
