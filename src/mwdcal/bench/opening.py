"""The start of a session: the tool and its past, its profile, and the plan."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

import mwdcal
from mwdcal.bench.positions import SessionPlan, planned_columns
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.formats import atomic
from mwdcal.files.metadata import toml
from mwdcal.files.profiles import completed, decoded_profile, read_toml
from mwdcal.library.planning import plan_table
from mwdcal.library.results import arrays_of

if TYPE_CHECKING:
    from mwdcal.sensor.profile import Profile

TOOL_FILE = "tool.toml"
PREVIOUS_FILE = "previous.json"
"""The latest calibration of the tool before this session."""
FROM_REGISTRY = "registry"
"""Stands for the profile of the latest calibration, where a tool profile is chosen."""
PLANNED_ANGLES = ("inclination_deg", "toolface_deg", "azimuth_deg")
PLAN_SUFFIXES = (".toml", ".csv", ".tsv", ".txt")
"""Suffixes of a plan that is given on the page."""


@dataclass(frozen=True)
class ToolPast:
    """The past of a tool in a registry: its records, newest first, when it is due, and its latest profile, if any."""

    serial: str
    records: Sequence[Any]
    next_due: str | None
    profile: Profile | None


def is_there(registry: str | None) -> bool:
    """Whether a registry is named, and begun."""
    return registry is not None and ("://" in registry or Path(registry).exists())


def tools_in(registry: str | None) -> Sequence[Any]:
    """The tools of a registry, those that are due first; none where there is no registry yet."""
    if registry is None or not is_there(registry):
        return ()
    with mwdcal.registry(registry) as tools:
        return sorted(tools.list().rows, key=lambda tool: tool.next_due or "9")


def past_of(registry: str | None, serial: str) -> ToolPast:
    """The past of a tool.

    Raises:
        InputError: the registry does not hold it.
    """
    if registry is None or not is_there(registry):
        raise InputError("no registry is named, so no tool has a past. Type the serial.")
    with mwdcal.registry(registry) as tools:
        records = tools.history(serial, limit=1000).rows[::-1]
        listed = [tool for tool in tools.list(search=serial).rows if tool.serial == serial]
        try:
            profile = tools.latest(serial).profile
        except MwdcalError:
            profile = None
    return ToolPast(serial, records, listed[0].next_due if listed else None, profile)


def keep_previous(folder: Path, registry: str | None, serial: str, simulated: bool) -> None:
    """Copy the latest calibration of a tool from the registry, if there is one: the roll test as pairs needs it.

    Simulated and real readings do not mix: one of the other kind stays where it is.
    """
    if registry is None or not is_there(registry):
        return
    with mwdcal.registry(registry) as tools:
        try:
            latest = tools.latest(serial)
        except MwdcalError:
            return
        if latest.simulated == simulated:
            tools.get(serial, folder / PREVIOUS_FILE)


def chosen_profile(
    folder: Path, name: str, text: str, past: ToolPast | None, stand: Mapping[str, float]
) -> tuple[Profile, bytes]:
    """A tool profile with its text: that of a `text`, else of the registry, else of a name, else of the session.

    `stand` are other 1σ of the stand, by their names in a profile.
    """
    if text:
        data = text.encode()
    elif name == FROM_REGISTRY:
        if past is None or past.profile is None:
            raise InputError(
                "the registry has no calibration of this tool. Choose another profile."
            )
        data = profile_text(past.profile).encode()
    else:
        data, _ = read_toml(name or str(folder / TOOL_FILE), "profiles", "tool profile")
    profile = decoded_profile(data, TOOL_FILE)
    if stand:
        changed = msgspec.structs.replace(profile.stand, **stand)
        data = profile_text(msgspec.structs.replace(profile, stand=changed)).encode()
        profile = decoded_profile(data, TOOL_FILE)
    return completed(profile), data


def profile_text(profile: Profile) -> str:
    """A tool profile as TOML."""
    fields = _stated(msgspec.to_builtins(profile))
    return "".join(f"{name} = {toml(value)}\n" for name, value in fields.items())


def _stated(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields without those that are None: TOML has no such value."""
    pairs = ((k, _stated(v) if isinstance(v, Mapping) else v) for k, v in fields.items())
    return {name: value for name, value in pairs if value is not None}


def plan_of_text(folder: Path, name: str, text: str, profile: Profile) -> SessionPlan:
    """A plan that is given on the page, as a file of the session."""
    suffix = Path(name).suffix.lower()
    if suffix not in PLAN_SUFFIXES:
        raise InputError(
            f"plan '{name[:40]}': expected a file with {', '.join(PLAN_SUFFIXES)}. Save it as one of them."
        )
    path = folder / f"plan{suffix}"
    atomic.write(path, text.encode())
    plan = session_plan(profile, str(path))
    return SessionPlan(Path(name).stem[:60], plan.columns, plan.accuracy_deg)


def session_plan(profile: Profile, name: str) -> SessionPlan:
    """The plan of a name or file.

    "best-24" are the best so many stations for the tool, "azimuth_deg=0.05" the fewest for an accuracy (1σ).
    """
    best = re.fullmatch(r"best-(\d{1,3})", name)
    wanted = _accuracy(name)
    choice: dict[str, Any] = {"plan": name}
    if best:
        choice = {"stations": int(best[1])}
    if wanted:
        choice = {"accuracy_deg": wanted}
    try:
        result = mwdcal.plan(profile, **choice)
    except MwdcalError:
        if best or wanted:
            raise
        return SessionPlan(name, planned_columns(arrays_of(plan_table(name))))
    assumed = any(each.id == "noise-assumed" for each in result.findings)
    accuracy = {} if assumed else result.accuracy_deg  # the page cannot say what is assumed
    return SessionPlan(name, planned_columns(result.columns), accuracy)


def _accuracy(name: str) -> dict[str, float]:
    """The accuracies in a name such as "azimuth_deg=0.05,inclination_deg=0.1"; none if it is another."""
    pairs = re.findall(r"([a-z_]+)=(\d*\.?\d+)(?:,|$)", name)
    is_one = pairs and name == ",".join(f"{key}={value}" for key, value in pairs)
    if not is_one or not {key for key, _ in pairs} <= {*PLANNED_ANGLES}:
        return {}
    return {key.removesuffix("_deg"): float(value) for key, value in pairs}


def rolltest_plan() -> SessionPlan:
    """The positions of the roll test: one roll at 45°, at azimuth 0."""
    return SessionPlan("roll-test", planned_columns(arrays_of(plan_table("roll-test"))))
