"""What a stated uncertainty of surveys holds, and what it leaves out: one sentence, one place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mwdcal.calibration.record import Finding

CORRECTED = "interference-corrected"
"""The finding of a calibration from which multi-station analysis has taken interference."""
DRIFTED = "sensor-drift-allowed"
"""The finding of one whose covariance allows for what the sensors have moved since the laboratory."""
INTERFERENCE = "interference of the drill string"
DRIFT = "drift of the sensors since the calibration"
NEVER = ("sag", "misalignment in the hole", "measured depth")
"""Errors that no calibration and no survey of its own knows."""


@dataclass(frozen=True)
class ErrorTerms:
    """Sources of error in a standard uncertainty, and those that are not in it."""

    included: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Both, as they stand beside every 1σ."""
        return f"1σ: {', '.join(self.included)}. Not in it: {', '.join(self.left_out)}."


def error_terms(findings: Iterable[Finding], declination: bool) -> ErrorTerms:
    """Those of surveys by a calibration with these findings; `declination`: azimuths count from another north."""
    there = {finding.id for finding in findings}
    optional = [
        ("declination", declination),
        (INTERFERENCE, CORRECTED in there),
        (DRIFT, DRIFTED in there),
    ]
    included = [name for name, known in optional if known]
    left_out = [name for name, known in optional[1:] if not known]
    return ErrorTerms(("calibration", "noise", *included), (*left_out, *NEVER))
