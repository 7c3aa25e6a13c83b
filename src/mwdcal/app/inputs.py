"""Inputs that a command line names: a run with its tool profile, and what is known before the fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mwdcal.calibration.fit_options import Prior
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.files import profiles, runs
from mwdcal.registry.calibration_source import calibration_of
from mwdcal.sensor.profile import Profile


def load_run(
    run: Path, tool: str | None, decimal: str, prior: Prior = None
) -> tuple[Readings, Profile]:
    """A run, with the digests of its files, and its tool profile."""
    profile, digest = profiles.load_profile(tool)
    readings, profile = runs.read_run(run, profile_for(prior, profile), decimal=decimal)
    return replace(readings, profile_sha256=digest), profile


def prior_of(word: str | None) -> tuple[Prior, str]:
    """The prior that a word names, and the SHA-256 of its file.

    A calibration file; or the tolerances of the profile, or nothing, which have no file.
    """
    if not word:
        return None, ""
    return (DATASHEET, "") if word == DATASHEET else calibration_of(Path(word))
