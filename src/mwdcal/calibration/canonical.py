"""Documents as they are hashed and signed: one form for all that say the same."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array

Record = TypeVar("Record", bound=msgspec.Struct)
DIGITS = 12
"""Significant digits of every number in a calibration file."""
POWERS = np.array([10**power for power in range(23)], float)
"""The powers of ten that are doubles."""
HALFWAY = 1e-3
"""What rounding may do to a whole number of that many digits, and more."""
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
    fields = msgspec.to_builtins(record)
    return msgspec.convert(_with(iter(figures(numbers(fields))), fields), type(record))


def numbers(document: Any) -> Array:
    """All numbers with a fraction in a document, in their order."""
    values: list[float] = []
    _collect(document, values)
    return np.array(values)


def _collect(value: Any, values: list[float]) -> None:
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, float):
            values.append(item)
        elif isinstance(item, dict | list | tuple):
            _collect(item, values)


def _with(new: Iterator[float], value: Any) -> Any:
    """A document with other `numbers`."""
    items = [
        next(new)
        if isinstance(item, float)
        else _with(new, item)
        if isinstance(item, dict | list | tuple)
        else item
        for item in (value.values() if isinstance(value, dict) else value)
    ]
    return dict(zip(value, items, strict=True)) if isinstance(value, dict) else items


@np.errstate(all="ignore")
def figures(values: Array) -> Any:
    """Numbers (...) at so many significant digits as a file has, each the double nearest to its decimal, as lists.

    A whole number of that many digits over a power of ten, both exact doubles, is that nearest double. What is too
    small or too large for this, or so near to halfway that the product may have crossed it, is spelled.
    """
    size = np.abs(values)
    power = DIGITS - 1 - np.floor(np.log10(size))
    known = np.abs(power) < len(POWERS)
    scale = POWERS[np.where(known, np.abs(power), 0.0).astype(int)]
    scaled = np.where(power >= 0, size * scale, size / scale)
    whole = np.rint(scaled)
    known &= (whole >= POWERS[DIGITS - 1]) & (whole < POWERS[DIGITS])
    known &= np.abs(np.abs(scaled - whole) - 0.5) > HALFWAY
    rounded = np.array(np.copysign(np.where(power >= 0, whole / scale, whole * scale), values))
    spelled = [float(f"{value:.{DIGITS - 1}e}") for value in values[~known].tolist()]
    rounded[~known] = spelled
    return rounded.tolist()
