"""A run file with its tool profile."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from mwdcal.calibration.prior import profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.files import profiles, runs
from mwdcal.files.formats import table
from mwdcal.sensor.profile import Profile


class Digests(TypedDict):
    """What the calibration file says about its sources."""

    profile_sha256: str
    run_sha256: str


def load_run(
    run: Path,
    tool: str | None,
    decimal: str,
    prior: Calibration | Literal["datasheet"] | None = None,
) -> tuple[Readings, Profile, Digests]:
    """A run with its tool profile, and the digests of both files."""
    profile, profile_sha256 = profiles.load_profile(tool)
    profile = profile_for(prior, profile)
    read = table.read(run, decimal=decimal)
    runs.check_run(read)
    readings, profile = runs.to_readings(read, profile)
    digests = Digests(profile_sha256=profile_sha256, run_sha256=read.digest)
    return readings, profile, digests
