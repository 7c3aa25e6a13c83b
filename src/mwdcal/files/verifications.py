"""Documents of `mwdcal verify`, read back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration.record import DOCUMENT_VERSION, Signature
from mwdcal.errors import InputError
from mwdcal.files.documents import check_json, in_utf8, whole_file
from mwdcal.use.verification import RULES, Verdict, guard

_AS_PRINTED = "Use the file as `mwdcal verify` printed it as JSON, or verify again."


class Verification(Verdict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The document that `mwdcal verify` prints as JSON: a verdict, and what it rests on.

    `calibration_signature` is what it said of the signature of the calibration, `signature` its own; `settings_file`
    and `settings_sha256` are of the laboratory's settings, where there were any.
    """

    schema_version: int
    command: str
    software: str
    serial: str | None
    simulated: bool
    calibration_sha256: str
    run_sha256: str | None
    limits_sha256: str | None
    settings_file: str | msgspec.UnsetType = msgspec.UNSET
    settings_sha256: str | msgspec.UnsetType = msgspec.UNSET
    calibration_signature: dict[str, str | None] | msgspec.UnsetType = msgspec.UNSET
    signature: Signature | msgspec.UnsetType = msgspec.UNSET


def load_verification(path: str | os.PathLike[str]) -> tuple[Verification, str]:
    """The document that `mwdcal verify` printed as JSON, from its file, and the SHA-256 of the file.

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
        check_json(data, name, _AS_PRINTED)
        verification = msgspec.json.decode(data, type=Verification)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{name} is not a verification: {error}. {_AS_PRINTED}") from None
    if problem := _contradiction(verification):
        raise InputError(f"{name}: {problem}. {_AS_PRINTED}")
    return verification, digest


def _contradiction(verification: Verification) -> str:
    """A contradiction in a document of `verify`, or empty."""
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
