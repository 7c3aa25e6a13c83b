"""Files of public keys whose signatures are trusted, and which of them are retired or revoked."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec
from msgspec.structs import replace

from mwdcal.certificate.keys import (
    PUBLIC_SUFFIX,
    TrustedKey,
    now,
    public_key,
    read_file,
    read_public,
)
from mwdcal.errors import InputError
from mwdcal.files.formats import atomic

_LAST_TIME = "9999-12-31"
_LEAST_DIGITS = 4
"""Digits of a key that must be typed to name it."""


class TrustedKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file of public keys."""

    schema_version: Literal[1] = 1
    command: Literal["certificate key"] = "certificate key"
    keys: list[TrustedKey] = []


def trusted(paths: Iterable[Path]) -> dict[str, TrustedKey]:
    """The keys of some files, each a public key or a file of keys, by their names.

    A key that stands in several is revoked, or retired, where one of them says so.
    """
    keys: dict[str, TrustedKey] = {}
    for path in paths:
        for key in read_trusted(path):
            both = (key, keys.get(key.key, key))
            keys[key.key] = min(
                both, key=lambda k: (not k.revoked, moment(k.retired or _LAST_TIME), not k.owner)
            )
    return keys


def read_trusted(path: Path) -> list[TrustedKey]:
    """The keys of a file: a public key, or a file of keys."""
    if path.suffix == PUBLIC_SUFFIX and not path.exists():  # lab.pub for lab.key.pub
        other = path.with_suffix(f".key{PUBLIC_SUFFIX}")
        path = other if other.exists() else path
    data = read_file(path)
    return _decoded(data, path.name).keys if data.lstrip().startswith(b"{") else [read_public(path)]


def _decoded(data: bytes, name: str) -> TrustedKeys:
    """A file of keys, or what is wrong with it."""
    try:
        keys = msgspec.json.decode(data, type=TrustedKeys)
        for key in keys.keys:
            if public_key(base64.b64decode(key.public, validate=True)).key != key.key:
                raise ValueError(f"the key {key.key!r} is not that of its bytes")
            for time in filter(None, (key.retired, key.revoked)):
                moment(time)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise InputError(
            f"{name} is not a file of keys: {error}. Use one that `certificate key trust` wrote."
        ) from None
    return keys


def moment(text: str) -> datetime:
    """A time in ISO 8601; without an offset it is UTC. Raises ValueError."""
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def trust(file: Path, key: TrustedKey) -> TrustedKeys:
    """Add a key to a file of keys, which is made if need be.

    Raises:
        InputError: the key is in it already.
    """
    keys = _decoded(read_file(file), file.name).keys if file.exists() else []
    if any(each.key == key.key for each in keys):
        raise InputError(f"{file.name} has the key {key.name} already. Leave it, or revoke it.")
    return _written(file, [*keys, key])


def retire(file: Path, name: str, time: str = "") -> TrustedKeys:
    """End the time in which a key signs: of its signatures those up to now, or a `time`, stay valid."""
    keys, key = _named(file, name)
    return _exchanged(file, keys, key, replace(key, retired=key.retired or _stated(time)))


def revoke(file: Path, name: str, why: str) -> TrustedKeys:
    """Withdraw the trust in a key: none of its signatures is valid any more."""
    keys, key = _named(file, name)
    return _exchanged(file, keys, key, replace(key, revoked=key.revoked or now(), reason=why))


def _stated(time: str) -> str:
    """A time as typed, in the one form of files; now where none was."""
    try:
        return moment(time).astimezone(UTC).isoformat(timespec="seconds") if time else now()
    except (ValueError, OverflowError):
        raise InputError(
            f"`at` must be a date or time such as 2026-07-01 or 2026-07-01T12:00:00Z; got {time!r}."
        ) from None


def _named(file: Path, name: str) -> tuple[list[TrustedKey], TrustedKey]:
    """All keys of a file, and the one that is named by its first digits or by the file of its public key."""
    keys = _decoded(read_file(file), file.name).keys
    digits = read_public(Path(name)).key if Path(name).is_file() else name.lower()
    named = [key for key in keys if len(digits) >= _LEAST_DIGITS and key.key.startswith(digits)]
    if len(named) != 1:
        listed = ", ".join(key.name for key in keys) or "none"
        raise InputError(
            f"{file.name}: {'several keys begin' if named else 'no key begins'} with {name!r}; its keys are {listed}. "
            "Name one by its digits, or by the file of the public key."
        )
    return keys, named[0]


def _exchanged(file: Path, keys: list[TrustedKey], old: TrustedKey, new: TrustedKey) -> TrustedKeys:
    return _written(file, [new if key is old else key for key in keys])


def _written(file: Path, keys: list[TrustedKey]) -> TrustedKeys:
    from mwdcal.files.documents import laid_out  # a check alone does without

    written = TrustedKeys(keys=keys)
    atomic.write(file, laid_out(msgspec.json.encode(written)))
    return written
