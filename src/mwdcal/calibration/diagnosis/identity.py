"""Checks, for every command, that data belong to one tool and state a possible date."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime

from msgspec import UnsetType

from mwdcal.calibration.readings import (
    IN_TABLE,
    WORDS,
    Readings,
    future_day,
    serial_of,
    stated_day,
    unread_day,
)
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.sensor.profile import MeasurementStandard

UNIDENTIFIED, FROM_THE_FUTURE, UNREAD_DAY = "no-serial", "future-date", "unreadable-date"
"""Findings on the identity of data: ids."""


def unidentified(serials: Mapping[str, str | None]) -> list[Finding]:
    """A finding if one of the things that are to be of one tool, by name, states no serial."""
    lacking = [name for name, serial in serials.items() if serial is None]
    if not lacking:
        return []
    every = "both" if len(serials) == 2 else f"all {len(serials)}"
    unknown = (
        f"cannot check that {every} are of the same tool"
        if len(serials) > 1
        else "does not know which tool it is of"
    )
    text = (
        f"no serial in {' and '.join(lacking)}: mwdcal {unknown}. State it in each run: in a line above the "
        """names, '# serial = "MWD-17"', in a column serial, or in Python by metadata={"serial": "MWD-17"}."""
    )
    return [Finding(id=UNIDENTIFIED, text=text)]


def stated_otherwise(metadata: Mapping[str, object], name: str) -> list[Finding]:
    """A finding on what a table states otherwise than the user says."""
    return [
        Finding(
            id="stated-otherwise",
            text=f"{name} states the {key} {other}; {metadata[key]}, as given, is used.",
        )
        for key in WORDS
        if (other := metadata.get(f"{key}{IN_TABLE}"))
    ]


def dated(metadata: Mapping[str, object], name: str) -> list[Finding]:
    """Findings on a day that cannot be read or is still to come, and on what the user says otherwise."""
    others = stated_otherwise(metadata, name)
    if problem := unread_day(metadata, name):
        return [Finding(id=UNREAD_DAY, text=problem), *others]
    if (day := future_day(metadata)) is None:
        return others
    text = f"{name} states the date {day}, which is still to come. Correct it, or the clock of this computer."
    return [Finding(id=FROM_THE_FUTURE, text=text), *others]


def overdue(
    standards: tuple[MeasurementStandard, ...] | UnsetType, metadata: Mapping[str, object]
) -> list[Finding]:
    """A finding for each standard whose calibration was due before the day of a run, else before today."""
    day = stated_day(metadata) or datetime.now(UTC).date()
    late = [s for s in standards if s.due and s.due < day] if isinstance(standards, tuple) else []
    return [
        Finding(
            id="standard-overdue",
            text=f"the calibration of the {s.quantity} standard {s.name} was due on {s.due}, before {day}. Have it "
            "calibrated, or enter its new certificate.",
        )
        for s in late
    ]


def other_tool(calibration: Calibration, readings: Readings) -> tuple[str, str] | None:
    """Serials of a calibration and of readings, if both state one and they differ."""
    ours, theirs = serial_of(calibration.tool), serial_of(readings.metadata)
    return None if ours is None or theirs is None or ours == theirs else (ours, theirs)


def doubts(calibration: Calibration, readings: Readings) -> list[Finding]:
    """Findings on the identity of readings beside a calibration, and on their day."""
    serials = {
        "the calibration": serial_of(calibration.tool),
        readings.run_name: serial_of(readings.metadata),
    }
    return unidentified(serials) + dated(readings.metadata, readings.name)
