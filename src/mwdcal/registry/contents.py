"""A file as a registry sees it: the records that are made of it, by its content."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.canonical import canonical
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError, reason
from mwdcal.files import documents, runs
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import members
from mwdcal.files.formats import table as tables
from mwdcal.files.metadata import load_toml
from mwdcal.files.profiles import decoded_profile
from mwdcal.registry.store import Entry
from mwdcal.registry.stored import LARGEST_OBJECT
from mwdcal.sensor.profile import MeasurementStandard, Person

TABLE_SUFFIXES = (*tables.SUFFIXES, *tables.EXCHANGED, *tables.LAID_OUT)
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
    "laboratories and public keys, and it is none of them. Leave it out."
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
    return _of_toml(data, name)


def checked(entry: Entry) -> Calibration | None:
    """The calibration that an entry is, one that every command accepts; None where it is another document."""
    if entry.kind == "calibration":
        return documents.decoded(members.Member(entry.data, entry.name, ""))
    return None


def _json_text(data: bytes) -> bytes:
    """The file in UTF-8 without what stands before its text; as it is where it is no text."""
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
