"""The calibration that a task is given, from wherever it is kept, and what its signature says."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mwdcal.calibration.canonical import SignatureCheck
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.certificate.keys import trusted
from mwdcal.certificate.signature import check, signature_doubts
from mwdcal.files import documents
from mwdcal.files.formats.members import Member
from mwdcal.registry.calibration_source import calibration_file


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
