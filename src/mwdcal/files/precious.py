"""Files that no output replaces: keys, calibrations, and those on which a certificate rests."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec

from mwdcal.errors import InputError
from mwdcal.files.documents import in_utf8
from mwdcal.files.formats import atomic, members

LARGEST_DOCUMENT = 50_000_000
"""Bytes of the largest file in which a document is looked for."""
_KEYS = b"PRIVATE KEY-----", b"-----BEGIN PUBLIC KEY-----"


class _Listed(msgspec.Struct):
    name: str


class _Document(msgspec.Struct):
    """The statements of a JSON document about itself: the command that wrote it, and the files that it lists."""

    command: str = ""
    files: list[_Listed] = []


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


def _content(file: Path) -> bytes:
    """The bytes of a file that may be a key or a document; none of another."""
    with suppress(OSError):
        if file.is_file() and file.stat().st_size <= LARGEST_DOCUMENT:
            return file.read_bytes()
    return b""


def _document(data: bytes) -> _Document:
    """The document in the bytes of a file; an empty one where they are none."""
    with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return msgspec.json.decode(in_utf8(data), type=_Document)
    return _Document()


def _is_calibration(file: Path, data: bytes) -> bool:
    """Whether a file is a calibration, or a table of them."""
    with suppress(InputError):
        return _document(data).command == "calibrate" or members.is_fleet(file)
    return False
