"""Inputs that a command line names: a run with its tool profile, and what is known before the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from mwdcal.calibration.fit_options import Prior
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.files import profiles, runs
from mwdcal.files.parting import parted
from mwdcal.files.settings import source_of_settings
from mwdcal.presentation.calibration_source import calibration_of
from mwdcal.sensor.profile import Profile


def load_run(
    run: Path,
    tool: str | None,
    decimal: str,
    prior: Prior = None,
    statements: Mapping[str, str] | None = None,
) -> tuple[Readings, Profile]:
    """A run, with the digests of its files, and its tool profile; `statements` as of `runs.read_run`."""
    profile, digest = profiles.load_profile(tool)
    readings, profile = runs.read_run(
        run, profile_for(prior, profile), decimal=decimal, statements=statements
    )
    return replace(readings, profile_sha256=digest, settings_source=source_of_settings()), profile


def load_runs(
    run: Path,
    rolltest: Path | None,
    tool: str | None,
    decimal: str,
    prior: Prior,
    statements: Mapping[str, str],
) -> tuple[Readings, Readings | None, Profile]:
    """A run and its roll test, if there is one, and the tool profile: see `load_run`.

    Both may be in one table, with a column that marks the roll test.
    """
    if rolltest is None or not (rolltest.exists() and run.exists() and run.samefile(rolltest)):
        readings, profile = load_run(run, tool, decimal, prior, statements)
        test = (
            runs.read_run(rolltest, profile, decimal=decimal, statements=statements)[0]
            if rolltest
            else None
        )
        return readings, test, profile
    stated, digest = profiles.load_profile(tool)
    stated = profile_for(prior, stated)
    whole = runs.read_export(
        run, stated, decimal=decimal, rows=runs.MOST_ROWS, statements=statements
    )
    first, second = parted(whole)
    readings, profile = runs.read_run(first, stated)
    source = source_of_settings()
    readings = replace(readings, profile_sha256=digest, settings_source=source)
    return readings, runs.read_run(second, profile)[0], profile


def prior_of(word: str | None) -> tuple[Prior, str]:
    """The prior that a word names, and the SHA-256 of its file.

    A calibration file; or the tolerances of the profile, or nothing, which have no file.
    """
    if not word:
        return None, ""
    return (DATASHEET, "") if word == DATASHEET else calibration_of(Path(word))
