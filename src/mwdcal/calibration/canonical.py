"""Documents as they are hashed and signed: one form for all that say the same."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import msgspec

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError

Record = TypeVar("Record", bound=msgspec.Struct)
DIGITS = 12
"""Significant digits of every number in a calibration file."""
UNHASHED = ("time", "sha256", "signature")
"""Fields of a calibration that its `sha256` is not of."""


class Signature(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A signature of the document that it stands in: of its `canonical` JSON, all but `value`.

    `key` is the SHA-256 of the raw public key, hexadecimal, its first 16 digits; `time` (UTC) is part
    of what is signed; `value` in base64.
    """

    algorithm: Literal["Ed25519"] = "Ed25519"
    key: str
    time: str
    value: str


SignatureState = Literal[
    "unsigned", "intact", "altered", "unknown", "revoked", "retired", "unchecked"
]
"""State of a document's signature: `mwdcal.certificate.signature.STATES` has a sentence for each."""


class SignatureCheck(msgspec.Struct, frozen=True, kw_only=True):
    """State of a document's signature: `state` for machines, `text` for people.

    `key`, `owner` and `time` (the signer's, UTC) as far as they are known. Only `intact` shows that the document is
    as it was signed, with a key that is trusted; `unchecked`: cryptography is not installed.
    """

    state: SignatureState
    key: str | None = None
    owner: str | None = None
    time: str | None = None
    text: str


def canonical(fields: Mapping[str, Any]) -> bytes:
    """The one form in which fields are hashed and signed: compact JSON in ASCII with sorted keys.

    Raises:
        InputError: a number is infinite or none.
    """
    try:
        text = json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:
        raise InputError(
            "a number of the document is infinite, or none: values of extreme size make it so. Check the units and "
            "uncertainties of the input."
        ) from error
    return text.encode()


def signed_form(fields: Mapping[str, Any]) -> bytes:
    """The only form that the file of a signed document may have: `canonical` with two spaces of indent."""
    return json.dumps(fields, sort_keys=True, indent=2, allow_nan=False).encode() + b"\n"


def document_sha256(fields: Mapping[str, Any]) -> str:
    """The `content_sha256` of a calibration file, whose fields are these."""
    kept = {name: value for name, value in fields.items() if name not in UNHASHED}
    return sha256_of(canonical(kept))


def rounded(record: Record) -> Record:
    """The same record with every number at 12 significant digits, as files keep it.

    More digits would differ from machine to machine with the threads of its linear algebra.
    """
    return msgspec.convert(_rounded(msgspec.to_builtins(record)), type(record))


def _rounded(value: Any) -> Any:
    """Numbers are rounded where they stand: a record has thousands, and a call for each would double the time."""
    if isinstance(value, dict):
        return dict(zip(value, _rounded([*value.values()]), strict=True))
    if not isinstance(value, list | tuple):
        return value
    return [
        float(f"{item:.{DIGITS - 1}e}") if isinstance(item, float) else _rounded(item)
        for item in value
    ]
