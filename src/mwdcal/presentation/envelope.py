"""The statements of every document for machines about itself: its form, who wrote it, and from which files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from mwdcal.calibration.readings import head
from mwdcal.calibration.record import DOCUMENT_VERSION, SOFTWARE, Signature, SignatureCheck
from mwdcal.files.profiles import LaboratorySettings, source_of_settings

INPUTS = {
    "apply": ("calibration", "readings"),
    "calibrate": ("run", "profile", "prior"),
    "certificate": (),
    **{f"certificate key {name}": () for name in ("create", "list", "retire", "revoke", "trust")},
    "certificate sign": ("document",),
    "certificate verify": ("document",),
    "compare": ("run", "profile"),
    "convert": ("calibration", "run"),
    "diagnose": ("calibration", "readings"),
    "example": (),
    "fleet": ("runs", "profile"),
    "init": (),
    "list": (),
    "noise": ("log", "profile"),
    "plan": ("profile", "measured"),
    "profile": ("run",),
    "reference": ("run",),
    "registry add": (),
    "registry backup": (),
    "registry check": (),
    "registry drift": (),
    "registry export": (),
    "registry get": (),
    "registry history": (),
    "registry init": (),
    "registry list": (),
    "registry restore": (),
    "registry upgrade": (),
    "registry withdraw": (),
    "simulate": ("plan", "profile", "calibration", "effects", "rolltest", "limits"),
    "stations": ("log",),
    "survey": ("calibration", "readings", "reference", "limits", "error_model"),
    "verify": ("calibration", "run", "limits"),
}
"""The files behind the document of each command, whose digests are its keys `…_sha256`.

A certificate is its own document, and lists them under `files`.
"""


class Envelope(msgspec.Struct, frozen=True, kw_only=True):
    """The head of a document.

    `software` is name and version; `serial` that of the tool, None where no input states one;
    `simulated`: some input says that it is. `calibration_signature`: of the calibration that was used;
    `signature`: of this document, once it is signed. `settings_file` and `settings_sha256`: of the laboratory's
    settings, where the command has used any.
    """

    schema_version: int
    command: str
    software: str
    serial: str | None
    simulated: bool
    calibration_signature: SignatureCheck | msgspec.UnsetType = msgspec.UNSET
    signature: Signature | msgspec.UnsetType = msgspec.UNSET
    settings_file: str | msgspec.UnsetType = msgspec.UNSET
    settings_sha256: str | msgspec.UnsetType = msgspec.UNSET


class ExampleDocument(msgspec.Struct, frozen=True, kw_only=True):
    """The files that `example` has written, and their folder."""

    folder: str
    files: list[str]


class WrittenSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The settings that `init` has written, and their file."""

    file: str
    settings: LaboratorySettings


def json_document(
    command: str, content: object, *metadata: Mapping[str, object], **sha256: str
) -> dict[str, Any]:
    """The document of a command: its head, the SHA-256 of its input files, and the content.

    `metadata` are what the inputs say of themselves, `sha256` the digests by name; one that was not
    computed, or of a file that was not given, is None. Keys of the content override equal ones.
    """
    settings, settings_sha256 = source_of_settings()
    envelope = Envelope(
        schema_version=DOCUMENT_VERSION,
        command=command,
        software=SOFTWARE,
        **head(*metadata),
        settings_file=settings or msgspec.UNSET,
        settings_sha256=settings_sha256 or msgspec.UNSET,
    )
    digests = {f"{name}_sha256": sha256.pop(name, "") or None for name in INPUTS[command]}
    if sha256:
        raise ValueError(f"{command} has no input {', '.join(sha256)}")
    return {**msgspec.to_builtins(envelope), **digests, **msgspec.to_builtins(content)}


def with_signature(document: dict[str, Any], calibration: SignatureCheck) -> dict[str, Any]:
    """The document of a command, with what the signature of its calibration says."""
    return {**document, "calibration_signature": msgspec.to_builtins(calibration)}
