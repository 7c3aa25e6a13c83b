"""Signatures and keys, on the screen and for machines.

The calibration that a task is given, from wherever it is kept, and what its signature says.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from mwdcal.calibration.readings import simulated
from mwdcal.calibration.record import Calibration, Finding, Signature, SignatureCheck
from mwdcal.certificate.signature import (
    FINDING_OF_STATE,
    SIGNATURE_KEY,
    CheckedFile,
    TrustedKey,
    check,
    check_files,
    document_of,
    fields_of,
    signature_doubts,
    trusted,
)
from mwdcal.certificate.signature import check as check_signature
from mwdcal.errors import InputError, shell_word
from mwdcal.files import documents
from mwdcal.files.formats.members import Member
from mwdcal.presentation.calibration_source import calibration_file
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import files_written
from mwdcal.presentation.text import one_line, table

IN_SHORT = {
    "intact": "signature intact, key {key}",
    "altered": "signature ALTERED",
    "unknown": "signed by unknown key {key}",
    "revoked": "signed by REVOKED key {key}",
    "retired": "signed by RETIRED key {key}",
    "unchecked": "signature not checked, key {key}",
}
"""The states of a calibration's signature, as part of a line; an unsigned one is a finding where keys are named."""
PDF_UNSIGNED = (
    "{name} carries no signature that can be checked: nothing shows that the pages are those of the JSON in it. "
    "Issue it with the private key: mwdcal certificate … --private-key."
)
PDF_ALTERED = "{name} was altered after it was signed. Use the PDF as it was issued."
PDF_OTHER_KEY = "{name} and the JSON in it are not signed by one key. Use the PDF as it was issued."
"""Messages about a PDF whose signature does not cover the JSON attached to it."""
FILE_STATES = {"unchanged": "unchanged", "changed": "CHANGED", "missing": "not checked: not found"}
"""The statements about the files of a certificate."""


class SignedDocument(msgspec.Struct, frozen=True, kw_only=True):
    """A document that was signed: its file, and the key."""

    file: str
    document: str
    key: str
    time: str
    findings: list[Finding]


class CheckedDocument(msgspec.Struct, frozen=True, kw_only=True):
    """A document whose signature was checked: `passed` where it is intact and no file of it has changed."""

    passed: bool
    file: str
    document: str
    check: SignatureCheck
    files: list[CheckedFile]
    findings: list[Finding]


class KeysDocument(msgspec.Struct, frozen=True, kw_only=True):
    """The public keys in a file, after the command."""

    file: str
    keys: list[TrustedKey]


def signature_status(check: SignatureCheck) -> list[str]:
    """The state of a calibration's signature as a part of a line, if it has one."""
    name = f"{check.key} ({check.owner})" if check.owner else check.key
    words = IN_SHORT.get(check.state)
    return [one_line(words.format(key=name))] if words else []


def signed_document(data: bytes, path: Path, folder: Path) -> tuple[SignedDocument, dict[str, Any]]:
    """The signed bytes, and the fields of the document.

    `folder`: where the files of a certificate are looked for, of which one may have changed.
    """
    fields = document_of(data, path.name)
    signature = msgspec.convert(fields[SIGNATURE_KEY], Signature)
    result = SignedDocument(
        file=str(path),
        document=str(fields["command"]),
        key=signature.key,
        time=signature.time,
        findings=_changed_files(_files_of(fields, folder, ())),
    )
    return result, fields


def signed(result: SignedDocument, fields: Mapping[str, Any]) -> str:
    """By which key a document was signed, and where it is."""
    said = [f"signed by key {result.key}", f"wrote {one_line(result.file)}"]
    return "   ".join([*said, *simulated(_stated(fields))])


def checked_document(
    file: Member, path: Path, keys: Mapping[str, TrustedKey], named: Sequence[Path]
) -> tuple[CheckedDocument, dict[str, Any]]:
    """The state of the signature in a file, and the fields of the document.

    The files of a certificate are looked up only where it is intact: a stranger's may name any.
    """
    check = check_signature(file.record, keys)
    altered = check.state == "altered"
    fields = fields_of(file.record) or {} if altered else document_of(file.record, file.name)
    if named and fields.get("command", "certificate") != "certificate":
        raise InputError("FILES go with a certificate, which lists its own. Leave them out.")
    intact = check.state == "intact"
    files = _files_of(fields, path.parent, named) if intact else []
    findings = [] if intact else [Finding(id=FINDING_OF_STATE[check.state], text=check.text)]
    findings += _changed_files(files)
    result = CheckedDocument(
        passed=not findings,
        file=str(path),
        document=str(fields.get("command", "")),
        check=check,
        files=files,
        findings=findings,
    )
    return result, fields


def checked_pdf(
    file: Member, path: Path, keys: Mapping[str, TrustedKey], named: Sequence[Path]
) -> tuple[CheckedDocument, dict[str, Any]]:
    """The state of both signatures of a PDF: its own, and that of the JSON attached to it, by one key."""
    from mwdcal.certificate.pdf_signature import read_pdf

    parts = read_pdf(file.record, path.name, keys)
    attached = Member(parts.attached, path.name, file.digest)
    result, fields = checked_document(attached, path, keys, named)
    if parts.intact and parts.key and parts.key.key == result.check.key:
        return result, fields
    if parts.key is None:
        state, text = "unsigned", PDF_UNSIGNED
    else:
        state, text = "altered", PDF_ALTERED if not parts.intact else PDF_OTHER_KEY
    finding = Finding(id=FINDING_OF_STATE[state], text=text.format(name=path.name))
    check = replace(result.check, state=state, text=finding.text)
    return replace(result, passed=False, check=check, findings=[finding, *result.findings]), fields


def for_machines(
    command: str, result: object, fields: Mapping[str, Any], digest: str
) -> dict[str, Any]:
    """The result, of a document with these fields, whose file had that SHA-256."""
    return json_document(f"certificate {command}", result, _stated(fields), document=digest)


def _stated(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The statements of a document about its tool, and whether it is simulated."""
    return {name: fields[name] for name in ("serial", "simulated") if name in fields}


def _files_of(fields: Mapping[str, Any], folder: Path, named: Sequence[Path]) -> list[CheckedFile]:
    """The files of a certificate; other documents list none."""
    return check_files(fields, folder, named) if fields["command"] == "certificate" else []


def _changed_files(files: Sequence[CheckedFile]) -> list[Finding]:
    changed = [file.name for file in files if file.state == "changed"]
    text = f"changed since the certificate was issued: {', '.join(changed)}."
    return [Finding(id="changed-file", text=text)] if changed else []


def checked(result: CheckedDocument, fields: Mapping[str, Any]) -> str:
    """The outcome, and each file."""
    outcome = "PASS" if result.passed else "FAIL"
    first = [outcome, one_line(result.file), *simulated(_stated(fields))]
    lines = ["   ".join(first), *[one_line(result.check.text)] * (result.check.state == "intact")]
    if not result.passed:
        file = one_line(shell_word(result.file))
        lines.append(
            f"next: mwdcal certificate verify {file} --key K.pub   (the file as its owner issued it)"
        )
    if not result.files:
        return "\n".join(lines)
    rows = [[file.name, file.id, FILE_STATES[file.state]] for file in result.files]
    return "\n".join(lines) + "\n\n" + table(rows, ["file of the certificate", "", ""])


def keys(result: KeysDocument, **files: Path) -> str:
    """One row for each key, and the files that were written."""
    rows = [[key.key, key.owner, key.created[:10], _standing(key)] for key in result.keys]
    shown = table(rows, ["key", "owner", "created", ""])
    return f"{shown}\n\n{files_written(**files)}" if files else shown


def _standing(key: TrustedKey) -> str:
    if key.revoked:
        return f"revoked {key.revoked[:10]}" + (f": {key.reason}" if key.reason else "")
    return f"retired {key.retired[:10]}" if key.retired else "valid"


class LoadedCalibration(NamedTuple):
    """A calibration, the SHA-256 of its file, what its signature says, and what of that is a finding.

    The digest is empty for a calibration in memory.
    """

    calibration: Calibration
    digest: str
    signature: SignatureCheck
    findings: list[Finding]


def load_calibration(
    source: Calibration | str | os.PathLike[str], keys: Sequence[Path] = ()
) -> LoadedCalibration:
    """A calibration, from memory or a file, and what its signature says by the keys that are trusted.

    Where there are keys, an unsigned calibration is a finding too.
    """
    trust = trusted(keys)
    if isinstance(source, Calibration):
        file, calibration = Member(documents.encode(source), "", ""), source
    else:
        file = calibration_file(Path(source))
        calibration = documents.decoded(file)
    checked = check(file.record, trust)
    findings = signature_doubts(checked, calibration, bool(keys))
    return LoadedCalibration(calibration, file.digest, checked, findings)
