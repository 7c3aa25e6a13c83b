"""A simulated run and its truth, on the screen and for machines."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.app.envelope import enveloped
from mwdcal.app.screens.numbers import number, written
from mwdcal.app.text import one_line, plural, table
from mwdcal.calibration.readings import SIMULATED
from mwdcal.files.formats.table import Table
from mwdcal.planning.effects import Effects
from mwdcal.planning.session import Session

SIZES = {
    "inclination_zero_deg": ("inclination zero", "°"),
    "azimuth_zero_deg": ("azimuth zero", "°"),
    "toolface_zero_deg": ("toolface zero", "°"),
    "tilt_deg": ("tilt", "°"),
    "tilt_azimuth_deg": ("tilt towards azimuth", "°"),
}
"""Errors of the stand in words, and their unit."""


class TrueAttitude(msgspec.Struct, frozen=True, kw_only=True):
    """What is true of a station: angles that the stand has turned to, and the temperature of the sensors."""

    station: str
    inclination_deg: float
    azimuth_deg: float
    toolface_deg: float
    temperature_c: float


class TruthSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `simulate` writes of the truth behind a run, and prints.

    Parameters by triad in raw units, as `convert --notation factors` prints them (SF, B, m; of a calibration that
    is linear in its parameters above order 0: M, b). `stand`: errors common to the session, such that reading =
    value + zero. `turn_on`: bias of the channels along the tool axes, g or nT.
    """

    seed: int
    plan: str
    tool: str
    order: int
    reference_temperature_c: float
    accelerometer: dict[str, Any]
    magnetometer: dict[str, Any] | None
    earth: dict[str, float]
    stand: dict[str, float]
    turn_on: dict[str, list[float]]
    effects: Effects
    stations: list[TrueAttitude]
    output: str
    truth: str


def truth(
    session: Session,
    run: Table,
    facts: Mapping[str, Any],
    digests: Mapping[str, str],
    **files: Path | None,
) -> dict[str, Any]:
    """The truth file, which is also the result for machines."""
    named = {name: str(path or "") for name, path in files.items()}
    fields = {"plan": session.plan.source, "tool": session.profile.name, "effects": session.effects}
    content = msgspec.convert(
        {"magnetometer": None, **msgspec.to_builtins(fields), **facts, **named}, TruthSummary
    )
    return enveloped("simulate", content, run.metadata, **digests)


def screen(document: Mapping[str, Any]) -> str:
    """The result for people, of the truth file."""
    head = [
        document["tool"], document["serial"], document["plan"], plural(len(document["stations"]), "station"),
        f"order {document['order']}", f"seed {document['seed']}", SIMULATED,
    ]  # fmt: skip
    rows = [
        [words, f"{number(document['stand'][name])}{unit}"]
        for name, (words, unit) in SIZES.items()
        if name in document["stand"]
    ]
    errors = (
        table(rows, ["error of the stand", "true"])
        if rows
        else "no error common to the stations of the stand"
    )
    follow = f"next: mwdcal calibrate {document['output']} -o CAL.json"
    files = written(run=document["output"], truth=document["truth"])
    return "\n\n".join([one_line("   ".join(head)), errors, f"{files}   {one_line(follow)}"])
