"""What is decided for each tool of a fleet by itself: prior, temperature orders, own-axis terms.

As `mwdcal calibrate` decides it for a run; orders are tried for many tools in one fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from mwdcal.calibration.automatic.nonlinearity import declared, with_chosen_curves
from mwdcal.calibration.automatic.order_selection import choose_orders, judged_soaks
from mwdcal.calibration.diagnosis.flags import Alone
from mwdcal.calibration.diagnosis.refusals import check_curves, check_options, check_readings
from mwdcal.calibration.estimate import temperature_ranges
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import from_datasheet
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.estimation.batch import take
from mwdcal.geometry.vectors import Ints
from mwdcal.sensor.profile import Profile

CHUNK = 320
"""Tools fitted in one call: few enough for the cache, many enough for NumPy."""
_T = TypeVar("_T")


@dataclass(frozen=True)
class PerTool:
    """What the options leave to each tool.

    `order`: its temperature orders, by the terms that noise does not explain. `nonlinearity`:
    triads whose own-axis terms are tried, by what the run says of them. `datasheet`: the prior is
    the profile's tolerances, in the unit of the tool's field.
    """

    order: bool = False
    nonlinearity: tuple[str, ...] = ()
    datasheet: bool = False

    def orders(self, options: Options, triad: int) -> tuple[int, ...]:
        """Orders that a triad may come to have."""
        tried = self.order and options.method != "swarm"
        return tuple(range(HIGHEST + 1)) if tried else (options.orders[triad],)

    def curved(self, options: Options, triad: int) -> bool:
        """Whether a triad may come to have own-axis terms."""
        return TRIADS[triad] in (*self.nonlinearity, *(options.nonlinearity or {}))

    def known(self, options: Options, readings: Readings, profile: Profile) -> Options:
        """The options with the prior of a whole batch."""
        if not self.datasheet:
            return options
        return replace(options, prior=from_datasheet(profile, readings.relative))

    def before(self, options: Options) -> Options:
        """The options that a tool must meet before its order is chosen."""
        if not self.order:
            return options
        return replace(options, model=options.model or "polynomial", nonlinearity={})


def with_orders(
    readings: Readings, tools: Ints, options: Options, per_tool: PerTool
) -> Iterator[tuple[Ints, Options | Exception]]:
    """Those of the given tools that have orders, and a range of temperatures, in common.

    An exception where one of a tool's trials failed.
    """
    if not per_tool.order and not max(options.orders):
        yield tools, options
        return
    for each in _alike(readings, tools):
        if not per_tool.order:
            yield each, options
            continue
        orders = np.full((len(readings.accelerometer), 2), -1)
        for which, found in _tried_orders(readings, each, options):
            if isinstance(found, Exception):
                yield which, found
            else:
                orders[which] = found
        for pair in np.unique(orders[each], axis=0):
            if pair.min() >= 0:
                chosen = replace(options, order=(int(pair[0]), int(pair[1])))
                yield each[(orders[each] == pair).all(-1)], chosen


def _alike(readings: Readings, tools: Ints) -> list[Ints]:
    """The given tools by range of temperatures: a model is conditioned for one."""
    if readings.temperature is None:
        return [tools]
    ranges = temperature_ranges(readings.temperature[tools])
    _, number = np.unique(ranges, axis=0, return_inverse=True)
    return [tools[number == k] for k in range(number.max(initial=-1) + 1)]


def _tried_orders(
    readings: Readings, tools: Ints, options: Options
) -> Iterator[tuple[Ints, Ints | Exception]]:
    """Orders (B, 2) of the given tools, many in one call."""
    trial = replace(options, nonlinearity={})
    for first in range(0, len(tools), CHUNK):
        part = tools[first : first + CHUNK]
        for some, levels in halved(readings, part, lambda r: judged_soaks(r, trial)):
            if isinstance(levels, Exception):
                yield some, levels
                continue
            for count in np.unique(levels):
                yield from _of_soaks(readings, some[levels == count], trial, int(count))


def _of_soaks(
    readings: Readings, tools: Ints, options: Options, levels: int
) -> Iterator[tuple[Ints, Ints | Exception]]:
    """The same for tools that are judged by one number of soaks."""
    size = max(CHUNK // levels, 1)
    for first in range(0, len(tools), size):
        part = tools[first : first + size]
        yield from halved(readings, part, lambda r: choose_orders(r, options, levels))


def with_curves(
    tools: Ints, options: Options, readings: Readings, per_tool: PerTool, alone: Alone
) -> Iterator[tuple[Ints, Options | Exception]]:
    """The given tools by the own-axis terms that their runs speak for."""
    if not per_tool.nonlinearity or options.prior:
        try:
            check_curves(readings, tuple(options.nonlinearity or {}))
            check_options(options)
        except Exception as error:
            yield tools, error
            return
        yield tools, options
        return
    groups: dict[tuple[bool, tuple[tuple[str, float], ...]], list[int]] = {}
    for tool in tools.tolist():
        try:
            own, profile = alone(tool)
            offered = declared(profile, options)
            if offered:
                check_readings(own, options)
            found = with_chosen_curves(own, options, offered)[0]
        except Exception as error:
            yield np.array([tool]), error
            continue
        terms = tuple((found.nonlinearity or {}).items())
        groups.setdefault((found.scatter, terms), []).append(tool)
    for (scatter, terms), members in groups.items():
        yield np.array(members), replace(options, nonlinearity=dict(terms), scatter=scatter)


def halved(
    readings: Readings, tools: Ints, work: Callable[[Readings], _T]
) -> Iterator[tuple[Ints, _T | Exception]]:
    """The work on given members of a batch, done in halves where one member stops the whole."""
    try:
        yield tools, work(take(readings, tools))
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        if len(tools) == 1:
            yield tools, error
            return
        middle = len(tools) // 2
        for part in (tools[:middle], tools[middle:]):
            yield from halved(readings, part, work)
