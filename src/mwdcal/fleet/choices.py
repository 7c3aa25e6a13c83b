"""Tools of a fleet by what is chosen for each: temperature orders, then own-axis terms.

As for a single run; many tools are tried in one fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from mwdcal.calibration.automatic.nonlinearity import MOST_PARTS, compare_curves, offered, scattered
from mwdcal.calibration.automatic.order_selection import choose_orders
from mwdcal.calibration.diagnosis.refusals import check_curves, check_options
from mwdcal.calibration.estimate import temperature_ranges
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import Readings
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.geometry.vectors import Ints
from mwdcal.sensor.profile import Profile

TOOLS_PER_FIT = 320
"""Tools fitted in one call: few enough for the cache, many enough for NumPy."""
_T = TypeVar("_T")


def with_orders(
    readings: Readings, tools: Ints, options: Options
) -> Iterator[tuple[Ints, Options | Exception]]:
    """Those of the given tools that have orders, and a range of temperatures, in common.

    An exception where one of a tool's trials failed.
    """
    if not max(options.orders) and options.order != AUTO:
        yield tools, options
        return
    for alike in _alike(readings, tools):
        if options.order == AUTO:
            yield from _by_order(readings, alike, options)
        else:
            yield alike, options


def _alike(readings: Readings, tools: Ints) -> list[Ints]:
    """The given tools by range of temperatures: a model is conditioned for one."""
    if readings.temperature is None:
        return [tools]
    ranges = temperature_ranges(readings.temperature[tools])
    _, number = np.unique(ranges, axis=0, return_inverse=True)
    return [tools[number == k] for k in range(number.max(initial=-1) + 1)]


def _by_order(
    readings: Readings, tools: Ints, options: Options
) -> Iterator[tuple[Ints, Options | Exception]]:
    """The given tools by the orders that are chosen for them."""
    trial = replace(options, nonlinearity={})
    orders = np.full((len(readings.accelerometer), 2), -1)
    for part, chosen in in_chunks(readings, tools, lambda r: choose_orders(r, trial)):
        if isinstance(chosen, Exception):
            yield part, chosen
        else:
            orders[part] = chosen
    for pair in np.unique(orders[tools], axis=0):
        if pair.min() >= 0:
            order = (int(pair[0]), int(pair[1]))
            yield tools[(orders[tools] == pair).all(-1)], replace(options, order=order)


def with_curves(
    readings: Readings, tools: Ints, options: Options, profile: Profile
) -> Iterator[tuple[Ints, Options | Exception]]:
    """The given tools by the own-axis terms that their runs show."""
    terms = offered(profile, options)
    if not terms:
        options = replace(options, nonlinearity=options.curved)
        try:
            check_curves(readings, tuple(options.curved))
            check_options(options)
        except MwdcalError as error:
            yield tools, error
        else:
            yield tools, options
        return
    options = scattered(readings, options)
    groups: dict[tuple[str, ...], list[Ints]] = {}
    trials = in_chunks(
        readings, tools, lambda r: compare_curves(r, options, terms), TOOLS_PER_FIT // MOST_PARTS
    )
    for part, curves in trials:
        if isinstance(curves, Exception):
            yield part, curves
            continue
        for place in np.unique(curves.chosen):
            groups.setdefault(curves.choices[place], []).append(part[curves.chosen == place])
    for names, parts in groups.items():
        chosen = {name: terms[name] for name in names}
        yield np.concatenate(parts), replace(options, nonlinearity=chosen)


def in_chunks(
    readings: Readings, tools: Ints, work: Callable[[Readings], _T], size: int = TOOLS_PER_FIT
) -> Iterator[tuple[Ints, _T | Exception]]:
    """The work on given members of a batch, `size` at a time; in halves where one stops the whole."""
    for start in range(0, len(tools), size):
        yield from _halved(readings, tools[start : start + size], work)


def _halved(
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
            yield from _halved(readings, part, work)
