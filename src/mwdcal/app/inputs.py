"""A run file with its tool profile, and the stations of it that are used."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

import numpy as np

from mwdcal.app.commands.choices import prior_profile
from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError
from mwdcal.files import profiles, runs
from mwdcal.files.formats import table
from mwdcal.sensor.profile import Profile


class Digests(TypedDict):
    """What the calibration file says about its sources."""

    profile_sha256: str
    run_sha256: str


def load_run(
    run: Path, tool: str | None, decimal: str, prior: str | None = None
) -> tuple[Readings, Profile, Digests]:
    """A run with its tool profile, and the digests of both files."""
    profile, profile_sha256 = profiles.load_profile(tool)
    profile = prior_profile(prior, profile)
    read = table.read(run, decimal=decimal)
    runs.check_run(read)
    readings, profile = runs.to_readings(read, profile)
    digests = Digests(profile_sha256=profile_sha256, run_sha256=read.digest)
    return readings, profile, digests


def without(readings: Readings, exclude: tuple[str, ...]) -> Readings:
    """The readings less the stations of these labels."""
    twice = [label for label in exclude if readings.station.count(label) > 1]
    if twice:
        raise InputError(
            f"`exclude` {twice[0]}: {readings.station.count(twice[0])} stations of {readings.source} "
            "have this label. Give each its own in the column 'station'."
        )
    missing = [label for label in exclude if label not in readings.station]
    if missing:
        raise InputError(
            f"`exclude` {missing[0]}: no such station in {readings.source}; "
            f"stations are {readings.station[0]} … {readings.station[-1]}."
        )
    return readings.select(np.array([label not in exclude for label in readings.station]))
