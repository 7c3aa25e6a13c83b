"""The drift of the tools of a registry: its calibrations and roll tests, compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, date, datetime
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.readings import TRIADS, serial_of
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.calibration.results import STATED_ANGLES
from mwdcal.drift.document import ToolDrift
from mwdcal.drift.histories import ServiceTest
from mwdcal.drift.tool import (
    MeasuredTool,
    ToolRecords,
    TypeRates,
    all_measured,
    fleet_drift,
    measured,
    predicted,
)
from mwdcal.drift.walk import CHANGE_LEVEL, WALK_GROUPS
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files import documents
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.members import Member
from mwdcal.files.limits import load_limits
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.presentation.drift import RegistryDrift
from mwdcal.registry import lookup
from mwdcal.registry.store import Registry, open_registry
from mwdcal.survey.acceptance import SensorTerms
from mwdcal.survey.surveying import WellInputs
from mwdcal.use.verification import Bounds, Verdict

_Document = tuple[lookup.Row, bytes]
Advance = Callable[[int, int], None]
"""Hears how many tools are done, and of how many."""
PEERS_READ = 200
"""Most other tools of its type that a single tool is compared with."""
PAGE = 500
"""Rows of a registry that are read at once."""
TOOLS_READ = 50
"""Tools whose calibrations are read at once, and are in memory together."""


def limits_of(typed: Iterable[str]) -> dict[str, float]:
    """Limits by angle, degrees, as typed: `inclination_deg=0.1`; by default those of the profile roll-test.

    Raises:
        InputError: what was typed is no angle with a positive number.
    """
    limits: dict[str, float] = {}
    for text in typed:
        name, _, value = text.partition("=")
        angle = name.removesuffix("_deg")
        try:
            limits[angle] = float(value)
        except ValueError:
            limits[angle] = -1.0
        if angle not in STATED_ANGLES or not 0 < limits[angle] < 180:
            names = ", ".join(f"{angle}_deg" for angle in STATED_ANGLES)
            raise InputError(
                f"`limit` must be one of {names} with a positive number, such as inclination_deg=0.1; got "
                f"{shown(text)}."
            )
    return limits or default_limits(load_limits()[0].error)


def default_limits(errors: Bounds) -> dict[str, float]:
    """The limits on errors of the angles."""
    return {name: value for name, value in errors.items() if name in STATED_ANGLES}


def of_registry(
    registry: Registry, serial: str | None, limits: dict[str, float], level: float, today: date,
    advance: Advance = lambda done, total: None,
) -> RegistryDrift:  # fmt: skip
    """The drift of a tool with its peers, or without a serial of all tools; `advance` hears how many are done.

    Raises:
        InputError: there is no calibration of such a tool.
    """
    whole = partial(RegistryDrift, registry=registry.name, limits_deg=limits)
    if serial is not None:
        return whole(tool=_of_tool(registry, serial, limits, level, today, advance))
    tools: list[MeasuredTool] = []
    refused: dict[str, str] = {}
    serials = [row["serial"] for row in _tools(registry)]
    pasts = enumerate(_pasts(registry, serials))
    while some := [*islice(pasts, TOOLS_READ)]:
        read = []
        for done, past in some:
            advance(done, len(serials))
            try:
                if (records := past.records()).calibrations:
                    read.append(records)
            except MwdcalError as error:
                refused[past.serial] = str(error)
        tools += _measured(read, level, refused)
    if not tools:
        raise InputError(
            f"{registry.name}: there is no calibration to compare. Add some: mwdcal registry add."
        )
    fleet, _ = fleet_drift(tools, limits, today, refused, level)
    return whole(fleet=fleet)


def with_walk(inputs: WellInputs, database: str) -> WellInputs:
    """The inputs of surveys with the random walk of their tool, as the calibrations in a registry show it.

    The movement of a parameter in a year is the median of its rate. Misalignments act as scales of the other axes.

    Raises:
        InputError: the calibration has no serial, or the registry no calibration of its tool.
    """
    serial = serial_of(inputs.calibration.tool)
    if not serial:
        raise InputError("the calibration has no serial: `registry` cannot find its tool.")
    with open_registry(database) as registry:
        tool = of_registry(registry, serial, {}, CHANGE_LEVEL, datetime.now(UTC).date()).tool
    rates = {} if tool is None else {(r.triad, r.kind): r.per_root_year for r in tool.rates}
    if not set(WALK_GROUPS) <= set(rates) or inputs.calibration.relative:
        text = (
            f"the registry shows no random walk of tool {serial} in g and nT, as of several calibrations: the drift is "
            "that of the error model."
        )
        return replace(inputs, findings=[*inputs.findings, Finding(id="no-random-walk", text=text)])
    scale = {
        triad: float(
            np.hypot(rates[triad, "scale"], np.sqrt(2) * np.radians(rates[triad, "misalignment"]))
        )
        for triad in TRIADS
    }
    walk = SensorTerms(
        accelerometer_bias_ms2=rates["accelerometer", "bias"] * STANDARD_GRAVITY,
        accelerometer_scale=scale["accelerometer"],
        magnetometer_bias_nt=rates["magnetometer", "bias"], magnetometer_scale=scale["magnetometer"],
    )  # fmt: skip
    return replace(inputs, walk=walk)


def _measured(read: list[ToolRecords], level: float, refused: dict[str, str]) -> list[MeasuredTool]:
    """Tools measured together; if one cannot be, each by itself, and why it cannot."""
    try:
        return all_measured(read, level)
    except MwdcalError as error:
        if len(read) > 1:
            return [tool for one in read for tool in _measured([one], level, refused)]
        refused[read[0].serial] = str(error)
        return []


def drift_of(
    registry: Registry, calibration: Calibration, sha256: str, today: date
) -> ToolDrift | None:
    """The drift of a tool up to a calibration, which the registry need not have yet.

    None where the tool has no serial, or the registry no earlier calibration of it.
    """
    serial = calibration.tool.get("serial")
    if serial is None:
        return None
    past = _past(registry, serial)
    calibrations, digests = past.calibrations()
    known = [c for c in calibrations if c.sha256 != calibration.sha256]
    day = calibration.day
    earlier = [c for c in known if c.day <= day]
    if not earlier:
        return None
    digests |= {str(calibration.sha256): sha256}
    tool = measured(serial, [*earlier, calibration], past.tests(), digests=digests)
    rates = TypeRates.of([tool, *_peers(registry, serial, tool.drift.type)])
    return predicted(tool, rates, default_limits(load_limits()[0].error), today)


def _of_tool(
    registry: Registry, serial: str, limits: dict[str, float], level: float, today: date, advance: Advance,
) -> ToolDrift:  # fmt: skip
    records = _past(registry, serial).records()
    if not records.calibrations:
        raise InputError(
            f"{registry.name} has no calibration of a tool {shown(serial)}. mwdcal registry list shows its tools."
        )
    tool = all_measured([records], level)[0]
    peers = [tool, *_peers(registry, serial, tool.drift.type, advance)]
    return predicted(tool, TypeRates.of(peers), limits, today)


def _peers(
    registry: Registry, serial: str, kind: str, advance: Advance = lambda done, total: None
) -> Iterator[MeasuredTool]:
    """Other tools of a type, at most `PEERS_READ`, spread evenly; those that cannot be read are left out."""
    serials = [row["serial"] for row in _tools(registry, type=kind) if row["serial"] != serial]
    some = serials[:: -(-len(serials) // PEERS_READ) or 1]
    for done, past in enumerate(_pasts(registry, some)):
        advance(done, len(some))
        try:
            calibrations, _ = past.calibrations()
        except MwdcalError:
            continue
        if len(calibrations) > 1:
            yield measured(past.serial, calibrations, tested=False)


def _tools(registry: Registry, **where: object) -> Iterator[lookup.Row]:
    """All tools of a registry whose columns equal these."""
    return _rows(partial(lookup.tools_page, registry, where=where))


class _Past(NamedTuple):
    """The documents of a tool in a registry: rows with bytes of calibrations and of roll tests, and rows of runs."""

    serial: str
    files: list[_Document]
    verdicts: list[_Document]
    runs: list[lookup.Row]

    def records(self) -> ToolRecords:
        """The calibrations and roll tests of the tool, if any."""
        calibrations, digests = self.calibrations()
        return ToolRecords(self.serial, calibrations, self.tests(), digests)

    def calibrations(self) -> tuple[list[Calibration], dict[str, str]]:
        """The calibrations of the tool, and the SHA-256 of each file by that of its content."""
        read, digests = [], {}
        for row, data in self.files:
            calibration = documents.proved(Member(data, row["name"], row["sha256"]))
            read.append(calibration)
            digests[str(calibration.sha256)] = row["sha256"]
        return read, digests

    def tests(self) -> list[ServiceTest]:
        """The roll tests of the tool, each on the day of its run or, unknown, when it was added."""
        days, result = {row["sha256"]: row["time"] for row in self.runs}, []
        for row, data in self.verdicts:
            day = row["time"] or days.get(row["run"]) or row["added"]
            document = msgspec.json.decode(documents.in_utf8(data), type=dict[str, Any])
            verdict = msgspec.convert(document, Verdict)
            named = row["calibration"] or ""
            result.append(ServiceTest(date.fromisoformat(day[:10]), named, verdict))
        return result


def _past(registry: Registry, serial: str) -> _Past:
    """The documents of one tool."""
    return next(_pasts(registry, [serial]))


def _pasts(registry: Registry, serials: Sequence[str]) -> Iterator[_Past]:
    """The documents of tools that were not withdrawn, those of some tools read at once.

    Raises:
        AlteredError: one of them is not what was added.
    """
    for first in range(0, len(serials), TOOLS_READ):
        some = [*serials[first : first + TOOLS_READ]]
        pasts = {serial: _Past(serial, [], [], []) for serial in some}
        for row, data in lookup.calibrations(registry, *some):
            pasts[row["serial"]].files.append((row, data))
        where: dict[str, object] = {"serial": some}
        verdicts = list(_records(registry, "verification", where))
        for row in verdicts:
            _, data = lookup.numbered(registry, row["number"])
            pasts[row["serial"]].verdicts.append((row, data))
        for row in _records(registry, "run", where) if verdicts else ():
            pasts[row["serial"]].runs.append(row)
        yield from pasts.values()


def _records(registry: Registry, kind: str, where: dict[str, object]) -> Iterator[lookup.Row]:
    """The records of a kind that were not withdrawn."""
    pages = partial(lookup.records_page, registry, kind, where, newest_first=False)
    return (row for row in _rows(pages) if row["withdrawn"] is None)


def _rows(page: Callable[..., lookup.Page]) -> Iterator[lookup.Row]:
    """All rows of a query that gives them in pages."""
    start, total = 0, 1
    while start < total:
        total, rows = page(offset=start, limit=PAGE)
        yield from rows
        start += PAGE
