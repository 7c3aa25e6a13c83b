"""Signatures of documents: Ed25519 (RFC 8032) over their canonical JSON.

A signed file has one form, `signed_form`: whatever differs from it was altered, were it a blank.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from msgspec.structs import replace

from mwdcal import extras
from mwdcal.calibration.record import (
    Calibration,
    Finding,
    Signature,
    SignatureCheck,
    canonical,
    signed_form,
)
from mwdcal.certificate.document import SourceFile
from mwdcal.digests import sha256_of
from mwdcal.errors import FitError, InputError, reason
from mwdcal.files import documents
from mwdcal.files.formats import atomic
from mwdcal.files.formats.members import Member

# --------------------------------------------------------------------------
# Keys of signatures: private ones in files that only their owner may read, and public ones that are trusted.
#
# Private keys are PKCS #8, public ones SubjectPublicKeyInfo, both PEM (RFC 5958, RFC 8410): as OpenSSL writes them.
#
# Files of public keys whose signatures are trusted, and which of them are retired or revoked.

PASSPHRASE = "MWDCAL_KEY_PASSPHRASE"
"""Variable with the passphrase of a private key."""
PUBLIC_SUFFIX = ".pub"
_KEY_DIGITS = 16
_MOST_BYTES = 1_000_000
"""Bytes of the largest file of keys."""
_PREFIX = bytes.fromhex("302a300506032b6570032100")
"""The bytes before the 32 bytes of an Ed25519 key in its SubjectPublicKeyInfo (RFC 8410, section 4)."""
_PEM = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----\s(.*?)-----END \1-----", re.DOTALL)
_PUBLIC_HEADS = {
    name: re.compile(rb"^%b: ([^\r\n]*)" % name.encode(), re.MULTILINE)
    for name in ("Owner", "Created")
}
"""Lines before a public key in its file."""


class TrustedKey(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A public key whose signatures are trusted: from when on no more, or, if revoked, never.

    `key` as in a `Signature`; `public` its 32 bytes in base64; times in UTC, or empty.
    """

    key: str
    public: str
    owner: str = ""
    created: str = ""
    retired: str = ""
    revoked: str = ""
    reason: str = ""

    @property
    def name(self) -> str:
        """The key and its owner, in words."""
        return f"{self.key} ({self.owner})" if self.owner else self.key

    def verifies(self, value: bytes, message: bytes) -> bool:
        """Whether the signature `value` of a message was made with the private key that belongs to this one."""
        key = ed25519().Ed25519PublicKey.from_public_bytes(base64.b64decode(self.public))
        try:
            key.verify(value, message)
        except import_module("cryptography.exceptions").InvalidSignature:
            return False
        return True


class PrivateKey(NamedTuple):
    """A key that signs, the public one that belongs to it, and the key of cryptography."""

    sign: Callable[[bytes], bytes]
    public: TrustedKey
    secret: Any = None


def ed25519() -> Any:
    """The Ed25519 of cryptography, or what to install."""
    module = "cryptography.hazmat.primitives.asymmetric.ed25519"
    return extras.load(module, "a signature", "certificate")


def available() -> bool:
    """Whether signatures can be made and checked here."""
    try:
        ed25519()
    except InputError:
        return False
    return True


def now() -> str:
    """The time, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def public_key(raw: bytes, owner: str = "", created: str = "") -> TrustedKey:
    """The key of 32 bytes."""
    identity = sha256_of(raw)[:_KEY_DIGITS]
    public = base64.b64encode(raw).decode()
    return TrustedKey(key=identity, public=public, owner=owner, created=created)


# ------------------------------------------------------------------------------- files


def read_file(path: Path) -> bytes:
    """The bytes of a file of keys."""
    try:
        if not path.is_file():
            raise InputError(
                f"{path}: {'not a file' if path.exists() else 'no such file'}. Name a file of keys."
            )
        with path.open("rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}). Check the path.") from None
    if len(data) > _MOST_BYTES:
        raise InputError(f"{path.name} is too large for a file of keys. Name the file of a key.")
    return data


def _block(data: bytes, name: str) -> tuple[str, bytes]:
    """The label and the content of the only PEM block of a file."""
    blocks = _PEM.findall(data)
    if len(blocks) != 1:
        many = "several keys" if blocks else "no key"
        raise InputError(
            f"{name} has {many} in PEM form. Use a file that `certificate key create` wrote."
        )
    try:
        content = base64.b64decode(b"".join(blocks[0][1].split()), validate=True)
    except binascii.Error:
        content = b""
    return blocks[0][0].decode(), content


def read_public(path: Path) -> TrustedKey:
    """A public key, with the owner and the time that its file states.

    Raises:
        InputError: the file cannot be read, or is not a public key of Ed25519.
    """
    data = read_file(path)
    label, content = _block(data, path.name)
    if "PRIVATE" in label:
        raise InputError(
            f"{path.name} is a private key, which nobody but its owner should have. Name the public key: "
            f"{path.name}{PUBLIC_SUFFIX}."
        )
    if (
        label != "PUBLIC KEY"
        or not content.startswith(_PREFIX)
        or len(content) != len(_PREFIX) + 32
    ):
        raise InputError(
            f"{path.name} is not a public key of Ed25519, or is damaged. Name another file."
        )
    stated = {name: pattern.findall(data)[:1] for name, pattern in _PUBLIC_HEADS.items()}
    words = {
        name.lower(): b"".join(lines).decode("utf-8", "replace") for name, lines in stated.items()
    }
    return public_key(content[len(_PREFIX) :], **words)


def is_encrypted(path: Path) -> bool:
    """Whether the private key in a file needs a passphrase.

    Raises:
        InputError: the file cannot be read, or is not a key.
    """
    return _block(read_file(path), path.name)[0].startswith("ENCRYPTED")


def read_private(path: Path, passphrase: Callable[[], str]) -> PrivateKey:
    """A private key; `passphrase` is asked for that of an encrypted one.

    Raises:
        InputError: the file cannot be read, may be read by others, or is not a private key of Ed25519.
    """
    curve = ed25519()
    data = read_file(path)
    label, _ = _block(data, path.name)
    if label not in ("PRIVATE KEY", "ENCRYPTED PRIVATE KEY"):
        advice = (
            "a private key signs, and the public one checks"
            if label == "PUBLIC KEY"
            else "use PKCS #8"
        )
        raise InputError(
            f"{path.name} is a {label.lower()}: {advice}. Name a file that `certificate key create` wrote."
        )
    _check_private(path)
    word = passphrase().encode() if label.startswith("ENCRYPTED") else None
    try:
        key = import_module("cryptography.hazmat.primitives.serialization").load_pem_private_key(
            data, word
        )
    except Exception as error:  # many kinds, by the version of cryptography
        why = (
            "the passphrase is wrong, or the file is damaged"
            if word is not None
            else "the file is damaged"
        )
        raise InputError(f"{path.name}: {why}. Check both, or use another key.") from error
    if not isinstance(key, curve.Ed25519PrivateKey):
        raise InputError(
            f"{path.name} is a private key of another kind than Ed25519. Use another key."
        )
    return PrivateKey(key.sign, public_key(key.public_key().public_bytes_raw()), key)


def _check_private(path: Path) -> None:
    """Refuse a private key that others may read; where there are no permissions, as on Windows, none."""
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise InputError(
            f"{path}: others may read this private key. Make it yours alone: chmod 600 {path.name}"
        )


def create(path: Path, owner: str, passphrase: str) -> tuple[TrustedKey, Path]:
    """Write a new private key, and beside it the public one, whose path is returned too.

    The private key is encrypted where there is a passphrase. Neither file is ever overwritten.
    """
    if not owner.isprintable():
        raise InputError(
            f"`owner` must be one line of text; got {owner!r}. Leave out what is not text."
        )
    curve, forms = ed25519(), import_module("cryptography.hazmat.primitives.serialization")
    key = curve.Ed25519PrivateKey.generate()
    encryption = (
        forms.BestAvailableEncryption(passphrase.encode()) if passphrase else forms.NoEncryption()
    )
    private = key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, encryption)
    public = public_key(key.public_key().public_bytes_raw(), owner, now())
    beside = path.with_name(path.name + PUBLIC_SUFFIX)
    if beside.exists():
        raise _key_is_there(beside)
    _write_new(path, private, 0o600)
    try:
        _write_new(beside, as_pem(public), 0o644)
    except BaseException:
        path.unlink()
        raise
    return public, beside


def as_pem(key: TrustedKey) -> bytes:
    """The file of a public key: its owner and time as text, and the key in PEM form."""
    heads = {"Owner": key.owner, "Key": key.key, "Created": key.created}
    lines = [f"{name}: {value}" for name, value in heads.items() if value]
    body = base64.b64encode(_PREFIX + base64.b64decode(key.public)).decode()
    lines += ["-----BEGIN PUBLIC KEY-----", body, "-----END PUBLIC KEY-----", ""]
    return "\n".join(lines).encode()


def _key_is_there(path: Path) -> InputError:
    return InputError(
        f"cannot write '{path}': there is a file, and keys are never overwritten. Name another."
    )


def _write_new(path: Path, data: bytes, mode: int) -> None:
    """Write a file that did not exist, with permissions that it has from its first byte on."""
    atomic.target(path)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags, mode)
    except FileExistsError:
        raise _key_is_there(path) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write '{path}': {reason(error)}. Choose another place.") from None
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(descriptor)
    except BaseException:
        with contextlib.suppress(OSError):
            path.unlink()
        raise


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
    "unchecked": "the {document} is signed by {key}, and not checked: cryptography is not installed. Install it "
    "with: {install}",
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
    """The object in a file; None without one, with a repeated key, or with a number that is not finite."""
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
        "install": extras.command("certificate") if state == "unchecked" else "",
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
