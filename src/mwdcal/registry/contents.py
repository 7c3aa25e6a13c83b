"""What a file is that the registry takes: its kind, tool, date and what it rests on, from its bytes."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from mwdcal.calibration.readings import is_simulated, serial_of
from mwdcal.calibration.record import Calibration
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import dialect
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import serials

TABLES = (*tables.SUFFIXES, *tables.EXCHANGED)
"""Suffixes of files of runs, whose columns decide."""
UNKNOWN = (
    "it is none of the files that a registry keeps: calibrations, verifications and certificates of mwdcal, runs, "
    "profiles, limits, laboratories and public keys"
)


class Content(NamedTuple):
    """A file as the registry keeps it: its bytes as they are, and what they say of themselves.

    `date` is the day of the measurement, ISO 8601, empty where the file states none; `links` are the SHA-256 of
    the files that it rests on, by what they are to it.
    """

    kind: str
    data: bytes
    name: str
    serial: str = ""
    date: str = ""
    simulated: bool = False
    links: Mapping[str, str] = {}
    title: str = ""


class _Verification(msgspec.Struct):
    """What the registry reads of the document of a roll test."""

    serial: str | None
    simulated: bool
    passed: bool
    limits: str
    rows: list[dict[str, Any]]
    calibration_sha256: str | None
    run_sha256: str | None
    limits_sha256: str | None


class _Item(msgspec.Struct):
    serial: str


class _File(msgspec.Struct):
    id: str
    sha256: str


class _Certificate(msgspec.Struct):
    """What the registry reads of a certificate."""

    number: str
    issued: str
    simulated: bool
    item: _Item
    files: list[_File]


def content(data: bytes, name: str) -> Content:
    """What the bytes of a file are; its name counts only for tables, whose format is in the suffix.

    Raises:
        InputError: it is nothing that a registry keeps, or damaged.
    """
    head = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    if head.startswith(b"{"):
        return _document(data, name)
    if b"PRIVATE KEY" in data[:200]:
        raise InputError(
            f"{name} is a private key, which is kept by its owner alone. Add the public one."
        )
    if b"-----BEGIN PUBLIC KEY-----" in data[:200]:
        return Content("public-key", data, name)
    if Path(name).suffix.lower() in TABLES:
        return _run(data, name)
    return _toml(data, name)


# ------------------------------------------------------------------ JSON


def _document(data: bytes, name: str) -> Content:
    """A JSON document of mwdcal."""
    try:
        command = msgspec.json.decode(data, type=dict[str, Any]).get("command")
        read = _DOCUMENTS.get(str(command))
        if read is None:
            raise InputError(f"{name}: {UNKNOWN}. Leave it out.")
        return read(data, name)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"{name} is not a document of mwdcal as it was written: {error}. Write it again."
        ) from None


def calibration(data: bytes, name: str) -> Content:
    """A calibration file; also what `mwdcal calibrate` prints, which is none, is refused here."""
    record = documents.decoded(data, name)
    return Content(
        "calibration",
        data,
        name,
        serial_of(record.tool) or "",
        measured(record),
        is_simulated(record.tool),
        _known(
            run=record.run_sha256, profile=record.profile_sha256, prior=record.prior_sha256 or ""
        ),
        record.profile.name,
    )


def measured(record: Calibration) -> str:
    """The day of the measurement: as the run states it, else the day on which it was calibrated."""
    return _day(record.tool.get("date")) or _day(record.time)


def _verification(data: bytes, name: str) -> Content:
    """What `mwdcal verify` prints with `--json`."""
    record = msgspec.json.decode(data, type=_Verification)
    links = _known(
        calibration=record.calibration_sha256, run=record.run_sha256, limits=record.limits_sha256
    )
    verdict = "passed" if record.passed else "failed"
    return Content(
        "verification", data, name, record.serial or "", "", record.simulated, links,
        f"{record.limits}: {verdict}",
    )  # fmt: skip


def _certificate(data: bytes, name: str) -> Content:
    """A certificate as JSON, signed or not."""
    record = msgspec.json.decode(data, type=_Certificate)
    links = {each.id: each.sha256 for each in record.files}
    return Content(
        "certificate", data, name, record.item.serial, _day(record.issued), record.simulated,
        links, record.number,
    )  # fmt: skip


_DOCUMENTS: dict[str, Callable[[bytes, str], Content]] = {
    "calibrate": calibration,
    "verify": _verification,
    "certificate": _certificate,
}


def _known(**links: str | None) -> dict[str, str]:
    """The links that are stated."""
    return {name: digest for name, digest in links.items() if digest}


def _day(stated: object) -> str:
    """The day in a date or time as ISO 8601 has it; empty where it is none."""
    with suppress(ValueError):
        return date.fromisoformat(str(stated)[:10]).isoformat()
    return ""
