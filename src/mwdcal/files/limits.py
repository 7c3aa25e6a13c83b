"""Limits profiles: TOML files, built in by name and others by path."""

from __future__ import annotations

import os

from msgspec.structs import replace

from mwdcal.errors import InputError
from mwdcal.files.metadata import load_toml
from mwdcal.files.profiles import built_in, decoded_toml, in_use, read_toml
from mwdcal.use.verification import Limits


def load_limits(name_or_path: str | os.PathLike[str] = "roll-test") -> tuple[Limits, str]:
    """A limits profile and the SHA-256 of its bytes: built in by name, or a TOML file by path.

    In a command with settings of the laboratory their rule of decision counts, unless a limits file states another.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        raise InputError(
            f"`limits` must be the name of a limits profile, its file, or Limits; got {type(name_or_path).__name__}. "
            "Leave it out for the roll test's limits: no tool profile is needed, the calibration has it."
        )
    name = os.fspath(name_or_path)
    limits, digest = decoded_toml(name, Limits, "limits", "limits profile", "Files")
    bounds = [*limits.spread.items(), *limits.error.items()]
    if not bounds:
        raise InputError(f"{name} sets no limit: fill in [spread] or [error].")
    for observable, value in bounds:
        if not 0 < value < float("inf"):
            raise InputError(f"{name}: the limit of {observable} must be positive; got {value}.")
    return _decided(limits, name), digest


def _decided(limits: Limits, name: str) -> Limits:
    """Limits with the rule of the laboratory's settings, unless a file of its own states another."""
    used = in_use()
    if not used:
        return limits
    if used.settings.limits == name:
        used.take("limits")
    rule = used.settings.decision
    if not rule or rule == limits.rule:
        return limits
    stated = load_toml(read_toml(name, "limits", "limits profile")[0].decode())
    if "rule" in stated and name not in built_in("limits"):
        used.pass_over("decision", "the limits profile's own")
        return limits
    used.take("decision")
    return replace(limits, rule=rule)
