"""From the words of the command line to a run, its tool profile, and the options of a calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

from mwdcal.app.commands.options import Typed
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.calibration.readings import HIGHEST, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.files import documents, profiles, runs
from mwdcal.sensor.profile import Profile


def load_run(
    run: Path,
    tool: str | None,
    decimal: str,
    prior: Calibration | Literal["datasheet"] | None = None,
) -> tuple[Readings, Profile]:
    """A run, with the digests of its files, and its tool profile."""
    profile, digest = profiles.load_profile(tool)
    readings, profile = runs.read_run(run, profile_for(prior, profile), decimal=decimal)
    return replace(readings, profile_sha256=digest), profile


def options_of(
    typed: Typed,
    prior: Calibration | Literal["datasheet"] | None = None,
    exclude: tuple[str, ...] = (),
) -> Options:
    """The options as typed, with the prior that `prior_of` has read."""
    read: dict[str, Any] = {
        "order": order_of(typed["order"]),
        "parameters": int(typed["parameters"] or 12),
        "nonlinearity": _nonlinearity(typed["nonlinearity"]),
        "estimate": names(typed["estimate"]),
        "ignore": names(typed["ignore"]),
        "prior": prior,
    }
    return Options(**{**typed, **read}, exclude=exclude)


def prior_of(word: str | None) -> Calibration | Literal["datasheet"] | None:
    """The prior that a word names: a calibration file, or the tolerances of the profile."""
    if not word:
        return None
    return DATASHEET if word == DATASHEET else documents.read(Path(word))


def order_of(word: str) -> int | Literal["auto"]:
    """An order as a number; what is none is left for `Options` to refuse."""
    orders = {str(order): order for order in range(HIGHEST + 1)}
    return orders.get(word, cast('Literal["auto"]', word))


def _nonlinearity(word: str) -> tuple[str, ...] | Literal["auto"]:
    """Triads by name, `auto`, or no triad for `none`."""
    if word == "none":
        return ()
    return AUTO if word == AUTO else names(word) or (word,)


def names(text: str) -> tuple[str, ...]:
    """The words of a list with commas."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
