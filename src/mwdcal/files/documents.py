"""Calibration files: JSON with a published schema, written atomically; and what `verify` printed, read back."""

from __future__ import annotations

import codecs
import hashlib
import json
import os
from collections import Counter
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.canonical import Signature, document_sha256, signed_form
from mwdcal.calibration.diagnosis.soundness import check
from mwdcal.calibration.record import DOCUMENT_VERSION, SCHEMA_VERSION, Calibration, sealed
from mwdcal.errors import InputError, reason
from mwdcal.files.formats import atomic, members
from mwdcal.files.profiles import check_profile
from mwdcal.use.verification import RULES, Verdict, guard

_DIGITS = 30
"""Digits of the longest whole number that a calibration file may have."""
_AS_WRITTEN = "The file was changed by hand or damaged: use it as mwdcal calibrate wrote it, or calibrate again."
_AS_PRINTED = "Use it as mwdcal verify printed as JSON it, or verify again."
_UNREADABLE = "No command would read such a file: calibrate again, or correct the record."


class Verification(Verdict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The document that `mwdcal verify` prints as JSON: a verdict, and what it rests on.

    `calibration_signature` is what it said of the signature of the calibration, `signature` its own.
    """

    schema_version: int
    command: str
    software: str
    serial: str | None
    simulated: bool
    calibration_sha256: str
    run_sha256: str | None
    limits_sha256: str | None
    calibration_signature: dict[str, str | None] | msgspec.UnsetType = msgspec.UNSET
    signature: Signature | msgspec.UnsetType = msgspec.UNSET


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
        raise InputError(
            f"{file.name} is not a calibration file: {error}. Use a file that mwdcal calibrate wrote."
        ) from None
    check(calibration, file.name, _AS_WRITTEN)
    check_profile(calibration.profile, file.name)
    return calibration


def whole_file(path: Path) -> members.Member:
    """The bytes of a file, its name and its digest."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}). Check the path.") from None
    return members.Member(data, path.name, hashlib.sha256(data).hexdigest())


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
    _check_json(data, name, _AS_WRITTEN)
    calibration = msgspec.json.decode(data, type=Calibration)
    other_fields = calibration.changed and calibration.sha256 == document_sha256(json.loads(data))
    return sealed(calibration) if other_fields else calibration  # those of another version


def load_verification(path: str | os.PathLike[str]) -> tuple[Verification, str]:
    """What `mwdcal verify` printed as JSON, from the file that it was saved in, and the file's SHA-256.

    Raises:
        InputError: the file holds something else, or decisions that do not follow from its values.
    """
    data, name, digest = whole_file(Path(path))
    try:
        data = in_utf8(data)
        head = msgspec.json.decode(data, type=dict[str, Any])
        if head.get("command") != "verify":
            raise msgspec.ValidationError("it is not of that command")
        if head.get("schema_version") != DOCUMENT_VERSION:
            version = (
                f"'schema_version' must be {DOCUMENT_VERSION}; got {head.get('schema_version')!r}"
            )
            raise msgspec.ValidationError(version)
        _check_json(data, name, _AS_PRINTED)
        verification = msgspec.json.decode(data, type=Verification)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{name} is not a verification: {error}. {_AS_PRINTED}") from None
    if problem := _contradiction(verification):
        raise InputError(f"{name}: {problem}. {_AS_PRINTED}")
    return verification, digest


def _contradiction(verification: Verification) -> str:
    """What cannot be in a document of `verify`; empty where nothing contradicts."""
    if verification.rule not in RULES.values():
        return (
            f"the decision rule must be one of {', '.join(RULES)}; got {verification.rule[:80]!r}"
        )
    guarded = verification.rule == RULES["guarded"]
    for row in verification.rows:
        value, sd = row.value, row.uncertainty
        if row.limit <= 0 or (sd is not None and (sd < 0 or value is None)):
            return f"the limit of {row.name!r} must be positive, and an uncertainty needs a value"
        within = False
        if value is not None and sd is not None:
            within = value + guard(guarded, row.freedom) * sd <= row.limit
        if row.passed != within:
            return f"the decision on {row.name!r} does not follow from its value and limit"
    if not verification.rows or verification.passed != all(r.passed for r in verification.rows):
        return "its verdict does not follow from its decisions"
    return ""


def _check_json(data: bytes, name: str, advice: str) -> None:
    """Refuse an object that has a key twice, and a whole number too long for any field."""
    unique, whole = partial(_unique, name, advice), partial(_whole, name, advice)
    json.loads(data, object_pairs_hook=unique, parse_int=whole)


def _whole(name: str, advice: str, digits: str) -> None:
    if len(digits) > _DIGITS:
        raise InputError(f"{name}: a number has {len(digits)} digits. {advice}")


def _unique(name: str, advice: str, pairs: list[tuple[str, Any]]) -> None:
    for key, count in Counter(key for key, _ in pairs).items():
        if count > 1:
            raise InputError(
                f"{name}: the key {key!r} stands {count} times in one object. {advice}"
            )


def published_schema(command: str = "") -> dict[str, Any]:
    """The schema of a calibration file, or of the document of a command, as shipped with the package."""
    place = (
        ("schemas", f"{command.replace(' ', '-')}.schema.json")
        if command
        else ("calibration.schema.json",)
    )
    text = resources.files("mwdcal").joinpath(*place).read_text("utf-8")
    return msgspec.json.decode(text, type=dict[str, Any])
