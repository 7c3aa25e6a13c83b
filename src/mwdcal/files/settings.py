"""Settings of a laboratory for all its commands, in `mwdcal.toml`, and those that the running command has used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import date
from typing import Literal

import msgspec

from mwdcal.files.metadata import toml
from mwdcal.sensor.profile import MeasurementStandard, Profile, StandProfile


class LaboratorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The content of `mwdcal.toml`: nothing in it is mandatory.

    `tool` and `limits` are names or files, `registry` a file or URL, `keys` public keys to trust, `laboratory` the
    laboratory file of certificates; files as seen from the folder of `mwdcal.toml`. `decision` is the rule for limits
    that state none. The units are those of columns whose unit nothing else tells. `stand` and `standards` complete
    tool profiles that do not state them.
    """

    tool: str = ""
    limits: str = ""
    decision: Literal["", "simple", "guarded"] = ""
    registry: str = ""
    keys: tuple[str, ...] = ()
    laboratory: str = ""
    length_unit: Literal["", "m", "ft", "usft"] = ""
    temperature_unit: Literal["", "°C", "°F", "K"] = ""
    stand: StandProfile = StandProfile()
    standards: tuple[MeasurementStandard, ...] = ()


@dataclass
class SettingsInUse:
    """Settings of a file, and what the command has taken from it, or has not as something else comes first."""

    file: str
    sha256: str
    settings: LaboratorySettings
    taken: list[str] = field(default_factory=list)
    passed_over: dict[str, list[str]] = field(default_factory=dict)

    def take(self, name: str) -> None:
        """Note that a setting is used."""
        self.taken += [] if name in self.taken else [name]

    def pass_over(self, name: str, reason: str) -> None:
        """Note that a setting is not used, and what comes first."""
        names = self.passed_over.setdefault(reason, [])
        names += [] if name in names else [name]


_IN_USE: ContextVar[SettingsInUse | None] = ContextVar("settings in use", default=None)


@contextmanager
def using(used: SettingsInUse | None) -> Iterator[None]:
    """Use settings for what is done inside."""
    before = _IN_USE.set(used)
    try:
        yield
    finally:
        _IN_USE.reset(before)


def in_use() -> SettingsInUse | None:
    """The settings of the running command; None where there are none, and always outside of commands."""
    return _IN_USE.get()


def source_of_settings() -> tuple[str, str]:
    """Path and SHA-256 of the settings, where the running command has used any; else empty."""
    used = in_use()
    return (used.file, used.sha256) if used and used.taken else ("", "")


def setting(name: str) -> str:
    """A setting of the running command, which counts as used; empty where it is not stated."""
    used = in_use()
    value = str(getattr(used.settings, name)) if used else ""
    if used and value:
        used.take(name)
    return value


def standards_of(profile: Profile) -> tuple[MeasurementStandard, ...] | msgspec.UnsetType:
    """The standards that a roll test rests on: the laboratory's of today, else those of the tool profile."""
    used = in_use()
    if used and used.settings.standards:
        used.take("standards")
        return used.settings.standards
    return profile.standards


def completed(profile: Profile) -> Profile:
    """A tool profile with the stand and the standards of the laboratory, where it states none itself."""
    used = in_use()
    if not used:
        return profile
    usual, changed = StandProfile(), {}
    for name in StandProfile.__struct_fields__:
        theirs, stated = getattr(used.settings.stand, name), getattr(profile.stand, name)
        if theirs == getattr(usual, name):
            continue
        if stated == getattr(usual, name):
            used.take(f"stand.{name}")
            changed[name] = theirs
        elif stated != theirs:
            used.pass_over(f"stand.{name}", "the tool profile's own")
    profile = msgspec.structs.replace(
        profile, stand=msgspec.structs.replace(profile.stand, **changed)
    )
    if not used.settings.standards:
        return profile
    if isinstance(profile.standards, tuple):
        used.pass_over("standards", "the tool profile's own")
        return profile
    used.take("standards")
    return msgspec.structs.replace(profile, standards=used.settings.standards)


def settings_toml(settings: LaboratorySettings) -> str:
    """The text of a settings file; what is not stated stands in it as a comment."""
    plain = {
        k: v for k, v in msgspec.structs.asdict(settings).items() if k not in ("stand", "standards")
    }
    lines = ["# Settings of the laboratory, for every mwdcal command in this folder and below.", ""]
    for name, value in plain.items():
        written = toml(value)
        lines.append(f"{name} = {written}" if value else f"# {name} = {written}")
    usual = msgspec.structs.asdict(StandProfile())
    stand = {k: v for k, v in msgspec.structs.asdict(settings.stand).items() if v != usual[k]}
    sections = [("[stand]   # 1σ of one setting, as in a tool profile", stand)]
    sections += [("[[standards]]", _stated_of(each)) for each in settings.standards]
    for head, values in sections:
        lines += ["", head, *(f"{name} = {_entry(value)}" for name, value in values.items())]
    return "\n".join(lines) + "\n"


def _stated_of(standard: MeasurementStandard) -> dict[str, object]:
    return {name: value for name, value in msgspec.structs.asdict(standard).items() if value}


def _entry(value: object) -> str:
    return value.isoformat() if isinstance(value, date) else toml(value)
