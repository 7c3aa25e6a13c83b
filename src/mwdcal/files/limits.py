"""Limits profiles: TOML files, built in by name and others by path."""

from __future__ import annotations

import os

from mwdcal.errors import InputError
from mwdcal.files.profiles import decoded_toml
from mwdcal.use.verification import Limits


def load_limits(name_or_path: str | os.PathLike[str] = "roll-test") -> tuple[Limits, str]:
    """A limits profile and the SHA-256 of its bytes: built in by name, or a TOML file by path."""
    name = os.fspath(name_or_path)
    limits, digest = decoded_toml(name, Limits, "limits", "limits profile", "Files")
    bounds = [*limits.spread.items(), *limits.error.items()]
    if not bounds:
        raise InputError(f"{name} sets no limit: fill in [spread] or [error].")
    for observable, value in bounds:
        if not 0 < value < float("inf"):
            raise InputError(f"{name}: the limit of {observable} must be positive; got {value}.")
    return limits, digest
