"""All that is built in, by the names that options take, for people and for machines."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import msgspec

from mwdcal.files.profiles import PACKAGE, built_in
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.text import one_line

FOLDERS = {
    "plans": {"plans": "mwdcal plan --plan NAME"},
    "profiles": {"profiles": "mwdcal calibrate RUN --tool NAME"},
    "limits": {
        "limits": "mwdcal verify CAL ROLLTEST --limits NAME",
        "survey_limits": "mwdcal survey CAL READINGS --limits NAME",
    },
}
"""Folders of the package with what is built in, and how it is asked for."""
METHODS_USED = {
    "joint": "all evidence of all stations, weighted by its uncertainty",
    "least-squares": "reference vectors taken as exact (Moradi and Izadi 2019)",
    "newton": "strength and inclination by Newton's method, then the magnetometer (Ivanov)",
    "swarm": "reference vectors by particle swarm",
    "toolface-inclination": "the angles of the accelerometer alone (Moosavi 2014)",
    "scalar": "strengths alone",
}
"""The evidence that each method of `calibrate` uses."""


class BuiltIn(msgspec.Struct, frozen=True, kw_only=True):
    """Something built in: its name, what it is, and the command that takes it."""

    name: str
    what: str
    used: str


class BuiltInSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `list`."""

    kind: str
    entries: list[BuiltIn]


def entries(kind: str) -> list[BuiltIn]:
    """All that is built in of a kind."""
    if kind == "methods":
        used = "mwdcal calibrate RUN --method NAME"
        return [BuiltIn(name=name, what=what, used=used) for name, what in METHODS_USED.items()]
    return [
        BuiltIn(name=name, what=_what(folder, name), used=used)
        for folder, used in FOLDERS[kind].items()
        for name in built_in(folder)
    ]


def _what(folder: str, name: str) -> str:
    """The comment at the head of a file as one sentence, or the source that it states."""
    text = PACKAGE.joinpath(folder, f"{name}.toml").read_text("utf-8")
    lines = text.splitlines()
    head = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    comment = " ".join(line.lstrip("# ") for line in lines[:head])
    first = re.split(r"(?<! al)\. ", comment)[0].rstrip(".")
    return first or str(tomllib.loads(text).get("source", ""))


def document(kind: str, built: list[BuiltIn]) -> dict[str, Any]:
    """The list for machines."""
    return json_document("list", BuiltInSummary(kind=kind, entries=built))


def screen(built: list[BuiltIn]) -> str:
    """The list for people: names below the command that takes them."""
    lines, width = [], max(len(each.name) for each in built)
    for used in dict.fromkeys(each.used for each in built):
        of_command = [each for each in built if each.used == used]
        lines += [used, *(f"  {e.name:{width}}  {one_line(e.what)}" for e in of_command), ""]
    return "\n".join(lines).rstrip()
