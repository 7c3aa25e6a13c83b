"""Calibration files: JSON with a published schema, written atomically."""

from __future__ import annotations

import codecs
import json
import os
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.diagnosis.plausibility import check
from mwdcal.calibration.readings import serial_of
from mwdcal.calibration.record import (
    SCHEMA_VERSION,
    Calibration,
    document_sha256,
    signed_form,
    with_checksum,
)
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files.formats import atomic, members
from mwdcal.files.formats.table import EXCHANGED, LAID_OUT
from mwdcal.files.profiles import PACKAGE, check_profile

# --------------------------------------------------------------------------
# Files that no output replaces: keys, calibrations, and those on which a certificate rests.


PARQUET_START = b"PAR1"
"""How a table begins that is no document, and need not be read to see that."""
LARGEST_DOCUMENT = 50_000_000
"""Bytes of the largest file in which a document is looked for."""
_KEYS = b"PRIVATE KEY-----", b"-----BEGIN PUBLIC KEY-----"


class _Listed(msgspec.Struct):
    name: str


class _Document(msgspec.Struct):
    """The statements of a JSON document about itself: the command that wrote it, and the files that it lists."""

    command: str = ""
    files: list[_Listed] = []
    tool: Any = None


def why_kept(file: Path, inputs: Iterable[Path], calibration: bool) -> str:
    """Why an output may not replace a file that exists; empty where it may.

    Certificates are looked for beside it and among the inputs. A `calibration` may replace another.
    """
    data = _content(file)
    if any(mark in data for mark in _KEYS) or _document(data).command == "certificate key":
        return "it is a key, which would be lost"
    if not calibration and _is_calibration(file, data):
        return "it is a calibration, which would be lost"
    identity = atomic.identity(file)
    for path in {*inputs, *file.parent.glob("*.[jJ][sS][oO][nN]")}:
        document = _document(_content(path))
        listed = document.files if document.command == "certificate" else []
        for each in listed:
            if atomic.identity(members.split(path.parent / each.name)[0]) == identity:
                return f"the certificate '{path.name}' lists it, and would no longer hold"
    return ""


def serial_in(file: Path) -> str | None:
    """Serial of the tool in a calibration file; None where it states none, or the file is something else."""
    document = _document(_content(file))
    is_one = document.command == "calibrate" and isinstance(document.tool, dict)
    return serial_of(document.tool) if is_one else None


def _content(file: Path) -> bytes:
    """The bytes of a file that may be a key or a document; none of another."""
    with suppress(OSError):
        if file.is_file() and file.stat().st_size <= LARGEST_DOCUMENT:
            with file.open("rb") as stream:
                start = stream.read(len(PARQUET_START))
                return b"" if start == PARQUET_START else start + stream.read()
    return b""


def _document(data: bytes) -> _Document:
    """The document in the bytes of a file; an empty one if they are not JSON."""
    with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return msgspec.json.decode(in_utf8(data), type=_Document)
    return _Document()


def _is_calibration(file: Path, data: bytes) -> bool:
    """Whether a file is a calibration, or a table of them."""
    with suppress(InputError):
        return _document(data).command == "calibrate" or members.is_fleet(file)
    return False


_DIGITS = 30
"""Digits of the longest whole number that a calibration file may have."""
_AS_WRITTEN = "The file was changed by hand or damaged: use it as mwdcal calibrate wrote it, or calibrate again."
_UNREADABLE = "No command would read such a file: calibrate again, or correct the record."


def encode(calibration: Calibration) -> bytes:
    """The bytes of a calibration file."""
    if calibration.signature is not msgspec.UNSET:
        return signed_form(msgspec.to_builtins(calibration))
    return laid_out(msgspec.json.encode(calibration))


def laid_out(record: bytes) -> bytes:
    """JSON as a calibration file has it: two spaces of indent, one newline at the end."""
    return msgspec.json.format(record, indent=2) + b"\n"


def write(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration file: the old one or the new one exists at any moment, never a part.

    Raises `InputError` for a calibration that `read` would refuse.
    """
    check(calibration, Path(path).name, _UNREADABLE)
    atomic.write(path, encode(calibration))


def read(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file, or say what is wrong with it."""
    return load(path)[0]


def load(path: str | os.PathLike[str]) -> tuple[Calibration, str]:
    """A calibration file, and the SHA-256 of its bytes.

    `cals.parquet#SERIAL` is the calibration of one tool in the table of a fleet; the SHA-256 is that of the table.
    """
    file = contents(path)
    return decoded(file), file.digest


def contents(path: str | os.PathLike[str]) -> members.Member:
    """The bytes that `decoded` takes, the name of their file, and its SHA-256."""
    file, _ = members.split(path)
    return members.read(path) if file.suffix.lower() == members.SUFFIX else whole_file(file)


def decoded(file: members.Member) -> Calibration:
    """The calibration in a file, or what is wrong with it."""
    try:
        calibration = _decoded(file.record, file.name)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        is_table = Path(file.name).suffix.lower() in (*LAID_OUT, *EXCHANGED)
        order = " CALIBRATION comes first: are the two files exchanged?" if is_table else ""
        if Path(file.name).suffix.lower() == ".toml":
            raise InputError(
                f"{file.name} is a tool profile by its name, and no calibration. Calibrate a run with it first: mwdcal "
                "calibrate."
            ) from None
        raise InputError(
            f"{file.name} is not a calibration file: {error}. Use a file that mwdcal calibrate wrote.{order}"
        ) from None
    check(calibration, file.name, _AS_WRITTEN)
    check_profile(calibration.profile, file.name)
    return calibration


def proved(file: members.Member) -> Calibration:
    """The calibration in a file that `decoded` has taken before, as its SHA-256 shows: not proved once more."""
    try:
        calibration = msgspec.json.decode(file.record, type=Calibration)
    except msgspec.DecodeError:
        return decoded(file)
    return calibration if calibration.schema_version == SCHEMA_VERSION else decoded(file)


def whole_file(path: Path) -> members.Member:
    """The bytes of a file, its name and its digest."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}). Check the path.") from None
    return members.Member(data, path.name, sha256_of(data))


def in_utf8(data: bytes) -> bytes:
    """JSON in UTF-8 without a mark; Windows PowerShell saves in UTF-16 what a command prints.

    Raises `UnicodeDecodeError` where the mark of UTF-16 is wrong.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def _decoded(data: bytes, name: str) -> Calibration:
    """The calibration in the bytes of a file."""
    version = msgspec.json.decode(data, type=dict[str, Any]).get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{name}: 'schema_version' must be {SCHEMA_VERSION}; got {version!r}. It is not "
            "a calibration file, or another version of mwdcal wrote it: calibrate again."
        )
    check_json(data, name, _AS_WRITTEN)
    calibration = msgspec.json.decode(data, type=Calibration)
    other_fields = calibration.changed and calibration.sha256 == document_sha256(json.loads(data))
    return with_checksum(calibration) if other_fields else calibration  # those of another version


def check_json(data: bytes, name: str, advice: str) -> None:
    """Refuse an object that has a key twice, and a whole number too long for any field."""
    unique, whole = partial(_unique, name, advice), partial(_whole, name, advice)
    json.loads(data, object_pairs_hook=unique, parse_int=whole)


def _whole(name: str, advice: str, digits: str) -> None:
    if len(digits) > _DIGITS:
        raise InputError(f"{name}: a number has {len(digits)} digits. {advice}")


def _unique(name: str, advice: str, pairs: list[tuple[str, Any]]) -> None:
    if len(dict(pairs)) < len(pairs):
        key, count = Counter(key for key, _ in pairs).most_common(1)[0]
        raise InputError(f"{name}: the key {key!r} stands {count} times in one object. {advice}")


def published_schema(command: str = "") -> dict[str, Any]:
    """The schema of a calibration file, or of the document of a command, as shipped with the package."""
    place = (
        ("schemas", f"{command.replace(' ', '-')}.schema.json")
        if command
        else ("calibration.schema.json",)
    )
    text = PACKAGE.joinpath(*place).read_text("utf-8")
    return msgspec.json.decode(text, type=dict[str, Any])
