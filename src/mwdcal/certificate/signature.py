"""Signatures of documents: Ed25519 (RFC 8032) over their canonical JSON.

A signed file has one form, `signed_form`: whatever differs from it was altered, were it a blank.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

import msgspec

from mwdcal.calibration.canonical import Signature, SignatureCheck, canonical, signed_form
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.certificate.document import SourceFile
from mwdcal.certificate.keys import PrivateKey, TrustedKey, available, moment, now
from mwdcal.digests import sha256_of
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents
from mwdcal.files.formats.members import Member

SIGNATURE_KEY = "signature"
"""Key of a document under which its signature stands."""


class CheckedFile(msgspec.Struct, frozen=True, kw_only=True):
    """A file that a certificate lists, and whether it is as it was: `missing` where it was not at hand."""

    id: str
    name: str
    path: str | None
    state: Literal["unchanged", "changed", "missing"]


STATES = {
    "unsigned": "the {document} is unsigned: nothing shows who made it and that it was not changed since.",
    "intact": "the {document} is as {key} signed it on {time}.",
    "altered": "the {document} was altered after it was signed{by}. Use the file as it was signed.",
    "unknown": "the {document} is signed by {key}, which is not among the trusted keys: give its public key by "
    "`key`, if you have it from its owner.",
    "revoked": "the {document} is signed by {key}, which was revoked on {revoked}{reason}. Ask for one "
    "that a valid key has signed.",
    "retired": "the {document} was signed on {time} by {key}, which was retired on {retired}. Have it signed with "
    "the key that followed.",
    "unchecked": "the {document} is signed by {key}, and not checked: cryptography is not installed. Install "
    'mwdcal[certificate]: pip install "mwdcal[certificate]"',
}
"""The statements about each state."""
CLOCKS_APART = timedelta(minutes=5)
"""By how much clocks of two computers may differ."""
FLEET_TABLE = re.compile(r"(?i)(\.parquet)#.*")
"""The end of a name of a tool in the table of a fleet."""
FINDING_OF_STATE = {
    state: "changed" if state == "altered" else f"signature-{state}" for state in STATES
}
"""Ids of the findings that say so: an altered document is found by its hash as well."""
DOCUMENT_NAMES = {
    "calibrate": "calibration",
    "verify": "verification",
    "certificate": "certificate",
}
"""Names of documents, by the commands that made them."""


# ------------------------------------------------------------------------------ signing


def signed(file: Member, key: PrivateKey, replacing: bool = False) -> bytes:
    """The file of a document, signed; `replacing` the signature that it has.

    Raises:
        InputError: it is not a document of mwdcal, or is signed already.
        FitError: it was altered since the signature that would be replaced, or since it was calibrated.
    """
    data, name = file.record, file.name
    fields = document_of(data, name)
    if SIGNATURE_KEY in fields and not replacing:
        who = check(data, {}).key
        raise InputError(
            f"{name} is signed already{f', by key {who}' if who else ''}. Keep that, or sign it anew: `replace`."
        )
    broken = check(data, {key.public.key: key.public}).state == "altered"
    if broken or (fields["command"] == "calibrate" and documents.decoded(file).changed):
        raise FitError(f"{name} was altered after it was made. Sign the file as it was.")
    kept = {name: value for name, value in fields.items() if name != SIGNATURE_KEY}
    unsigned = Signature(key=key.public.key, time=now(), value="")
    value = base64.b64encode(key.sign(message(kept, unsigned))).decode()
    signature = msgspec.structs.replace(unsigned, value=value)
    return signed_form({**kept, SIGNATURE_KEY: msgspec.to_builtins(signature)})


def message(fields: Mapping[str, Any], signature: Signature) -> bytes:
    """The signed bytes: the canonical JSON of a document with its signature, but for the `value` of that."""
    stated = msgspec.to_builtins(signature)
    return canonical({**fields, SIGNATURE_KEY: {k: v for k, v in stated.items() if k != "value"}})


def document_of(data: bytes, name: str) -> dict[str, Any]:
    """The fields of a document.

    Raises:
        InputError: it is not JSON, or not a document of mwdcal.
    """
    fields = fields_of(data)
    if fields is None or not {"schema_version", "command"} <= {*fields}:
        raise InputError(
            f"{name} is not a document of mwdcal. Name a calibration file, or the JSON of a "
            "verification or certificate."
        )
    return fields


def fields_of(data: bytes) -> dict[str, Any] | None:
    """The object in a file; None where there is none, or it has a key twice, or a number that is not finite."""
    try:
        fields = json.loads(
            data, parse_constant=_finite, parse_float=_finite, object_pairs_hook=_object
        )
    except (ValueError, RecursionError):
        return None
    return fields if isinstance(fields, dict) else None


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not finite")
    return number


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a key stands twice")
    return fields


# ----------------------------------------------------------------------------- checking


def check(data: bytes, trusted: Mapping[str, TrustedKey]) -> SignatureCheck:
    """The state of the signature of the document in a file, by the keys that are trusted.

    A file that can no longer be read as JSON, but names a signature, is altered.
    """
    fields = fields_of(data)
    if fields is None:
        named = SIGNATURE_KEY.encode() in data.replace(b"\0", b"")
        return _said("altered" if named else "unsigned", {})
    if SIGNATURE_KEY not in fields:
        return _said("unsigned", fields)
    try:
        signature = msgspec.convert(fields.pop(SIGNATURE_KEY), Signature)
        value = base64.b64decode(signature.value, validate=True)
    except ValueError:
        return _said("altered", fields)
    key = trusted.get(signature.key)
    if (
        not _has_the_form(data, fields, signature)
        or base64.b64encode(value) != signature.value.encode()
    ):
        return _said("altered", fields, signature, key)
    if key is None:
        return _said("unknown", fields, signature)
    if not available():
        return _said("unchecked", fields, signature, key)
    intact = key.verifies(value, message(fields, signature))
    return _said(_standing(key, signature) if intact else "altered", fields, signature, key)


def signature_doubts(
    checked: SignatureCheck, calibration: Calibration, wanted: bool
) -> list[Finding]:
    """Findings of the signature of a calibration file; that it is missing is one only where it is `wanted`."""
    sound = checked.state == "intact" or (checked.state == "unsigned" and not wanted)
    if sound or (checked.state == "altered" and calibration.changed):  # which is a finding itself
        return []
    return [Finding(id=FINDING_OF_STATE[checked.state], text=checked.text)]


def _has_the_form(data: bytes, fields: Mapping[str, Any], signature: Signature) -> bool:
    """Whether a file is as `signed` writes it, byte by byte."""
    try:
        return data == signed_form({**fields, SIGNATURE_KEY: msgspec.to_builtins(signature)})
    except RecursionError:
        return False


def _standing(key: TrustedKey, signature: Signature) -> str:
    """The value of an intact signature: a revoked key has none, a retired one signed before."""
    if key.revoked:
        return "revoked"
    if not key.retired:
        return "intact"
    try:
        return "intact" if moment(signature.time) <= moment(key.retired) else "retired"
    except ValueError:
        return "retired"


def _said(
    state: Any,
    fields: Mapping[str, Any],
    signature: Signature | None = None,
    key: TrustedKey | None = None,
) -> SignatureCheck:
    """The state with its sentence."""
    words = {
        "document": DOCUMENT_NAMES.get(str(fields.get("command")), "document"),
        "key": (who := f"key {key.name if key else signature.key}" if signature else ""),
        "time": signature.time if signature else "",
        "by": f" by {who}" if who else "",
        "revoked": key.revoked if key else "",
        "reason": f": {key.reason}" if key and key.reason else "",
        "retired": key.retired if key else "",
    }
    return SignatureCheck(
        state=state,
        key=signature.key if signature else None,
        owner=(key.owner or None) if key else None,
        time=signature.time if signature else None,
        text=STATES[state].format(**words) + (_clock(key, signature) if state == "intact" else ""),
    )


def _clock(key: TrustedKey | None, signature: Signature | None) -> str:
    """The oddity of the date of an intact signature, which is a claim of the signer; empty if it has none."""
    if key is None or signature is None:
        return ""
    try:
        signed_at = moment(signature.time)
        created = moment(key.created) if key.created else signed_at
    except ValueError:
        return " One of the dates of key and signature cannot be read."
    if signed_at - moment(now()) > CLOCKS_APART:
        return " That is in the future: a clock is wrong, or the date."
    if created - signed_at > CLOCKS_APART:
        return f" That is before the key was created, {key.created}: a clock is wrong, or the date."
    return ""


# ---------------------------------------------------------------- the files of a certificate


def check_files(
    fields: Mapping[str, Any], folder: Path, named: Iterable[Path] = ()
) -> list[CheckedFile]:
    """The files that a certificate lists, by their SHA-256.

    Each is one of the `named` files with its content or else its name, or lies where the certificate says, seen
    from its `folder`, or beside it.
    """
    try:
        listed = msgspec.convert(fields.get("files", []), list[SourceFile])
    except msgspec.ValidationError as error:
        raise InputError(f"'files' of the certificate cannot be read: {error}.") from None
    digests = {path: _sha256(path) for path in named}
    unlisted = [
        path.name
        for path, digest in digests.items()
        if not any(_is(file, path, digest, listed) for file in listed)
    ]
    if unlisted:
        raise InputError(
            f"{', '.join(unlisted)}: not among the files of the certificate. Leave it out."
        )
    return [
        _checked(file, [p for p, digest in digests.items() if _is(file, p, digest, listed)], folder)
        for file in listed
    ]


def _is(file: SourceFile, path: Path, digest: str | None, listed: Iterable[SourceFile]) -> bool:
    """Whether a path on the command line is meant to be a file that is listed: by content, or else by name."""
    namesakes = {each.sha256 for each in listed if _base(each.name) == _base(file.name)}
    called = path.name in (_base(file.name), _base(_table(file.name)))
    return digest == file.sha256 or (called and digest not in namesakes)


def _table(name: str) -> str:
    """The table of a fleet in a name such as `cals.parquet#SERIAL`, whose SHA-256 is listed; others as they are."""
    return FLEET_TABLE.sub(r"\1", name)


def _base(name: str) -> str:
    """The last part of a path as any system writes it."""
    return name.replace("\\", "/").rpartition("/")[2]


def _checked(file: SourceFile, given: Sequence[Path], folder: Path) -> CheckedFile:
    """Compare a listed file with those `given`; a folder in its place does not count."""
    names = dict.fromkeys((file.name, _table(file.name)))
    beside = [p for name in names for p in (*_stated_places(name, folder), folder / _base(name))]
    places = given or [place for place in beside if _exists(place)][:1]
    if not places:
        return CheckedFile(id=file.id, name=file.name, path=None, state="missing")
    changed = [place for place in places if _sha256(place) != file.sha256]
    return CheckedFile(
        id=file.id,
        name=file.name,
        path=str((changed or places)[0]),
        state="changed" if changed else "unchanged",
    )


def _stated_places(name: str, folder: Path) -> list[Path]:
    """Where a certificate says that a file is; nowhere on another machine: Windows would log in there to look."""
    place = name.replace("\\", "/")
    return [] if place.startswith("//") else [folder / place]


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # such as a name that is too long
        return False


def _sha256(path: Path) -> str | None:
    """The SHA-256 of a file; None where it cannot be read."""
    try:
        if not path.is_file():
            return None
        return sha256_of(path)
    except (OSError, ValueError):
        return None
