"""Limits profiles: TOML files, shipped ones by name and others by path."""

from __future__ import annotations

import difflib
import os
import tomllib
from importlib import resources
from pathlib import Path

import msgspec

from mwdcal.errors import InputError
from mwdcal.use.verification import Limits


def list_limits() -> list[str]:
    """Names of the limits profiles that come with the package."""
    folder = resources.files("mwdcal").joinpath("limits")
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in folder.iterdir()
        if entry.name.endswith(".toml")
    )


def load_limits(name_or_path: str | os.PathLike[str] = "roll-test") -> Limits:
    """A limits profile by name or path, or an error that says what is wrong with it."""
    name = os.fspath(name_or_path)
    try:
        data = _content(name)
        return _checked(msgspec.convert(tomllib.loads(data.decode("utf-8")), Limits), name)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise InputError(
            f"{name} is not a limits profile: {error}. Compare it with the shipped ones: "
            f"{', '.join(list_limits())} (docs, 'Files')."
        ) from None


def _content(name: str) -> bytes:
    if name in list_limits():
        return resources.files("mwdcal").joinpath("limits", f"{name}.toml").read_bytes()
    path = Path(name)
    try:
        return path.read_bytes()
    except OSError as error:
        near = difflib.get_close_matches(name, list_limits(), 1)
        hint = f" Did you mean '{near[0]}'?" if near else f" Shipped: {', '.join(list_limits())}."
        raise InputError(f"--limits {name}: {error.strerror or error}.{hint}") from None


def _checked(limits: Limits, name: str) -> Limits:
    bounds = [*limits.spread.items(), *limits.error.items()]
    if not bounds:
        raise InputError(f"{name} sets no limit: fill in [spread] or [error].")
    for observable, value in bounds:
        if not 0 < value < float("inf"):
            raise InputError(f"{name}: the limit of {observable} must be positive; got {value}.")
    return limits
