"""Tools of a fleet by what is chosen for each: temperature orders, then own-axis terms.

As for a single run; many tools are tried in one fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import compress
from typing import TypeVar

import numpy as np

from mwdcal.calibration.automatic.auto import choose_orders, compare_curves, offered, scattered
from mwdcal.calibration.diagnosis.refusals import check_curves, check_options
from mwdcal.calibration.estimate import temperature_ranges
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import Readings
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.geometry.vectors import AnyArray, Bools, Ints
from mwdcal.sensor.profile import Profile

TOOLS_PER_FIT = 640
"""Tools fitted in one call: few enough for the memory, many enough for NumPy…"""
USUAL_STATIONS = 48
"""…and fewer if they have more stations than these: long runs take no more memory."""
_T = TypeVar("_T")
Fail = Callable[[Ints, Exception], None]
"""What becomes of tools that an exception stops."""


def with_orders(
    readings: Readings, tools: Ints, options: Options, fail: Fail
) -> Iterator[tuple[Ints, Options]]:
    """Those of the given tools that have orders, and a range of temperatures, in common."""
    groups = [tools]
    if readings.temperature is not None and (options.order == AUTO or max(options.orders)):
        ranges = temperature_ranges(readings.temperature[tools])
        groups = [group for _, group in alike(tools, ranges)]
    trial = replace(options, nonlinearity={})
    for group in groups:
        if options.order != AUTO:
            yield group, options
            continue
        trials = in_chunks(readings, group, lambda r: choose_orders(r, trial), fail)
        for orders, some in _by_choice(trials):
            yield some, replace(options, order=(int(orders[0]), int(orders[1])))


def with_curves(
    readings: Readings, tools: Ints, options: Options, profile: Profile, fail: Fail
) -> Iterator[tuple[Ints, Options]]:
    """The given tools by the own-axis terms that their runs show."""
    options, terms = scattered(readings, options), offered(profile, options)
    if not terms:
        options = replace(options, nonlinearity=options.curved)
        try:
            check_curves(readings, tuple(options.curved))
            check_options(options)
        except MwdcalError as error:
            fail(tools, error)
        else:
            yield tools, options
        return
    options = replace(options, nonlinearity={})

    def shown(some: Readings) -> Bools:
        curves = compare_curves(some, options, terms)
        return np.array([[n in names for n in terms] for names in curves.choices])[curves.chosen]

    trials = in_chunks(readings, tools, shown, fail)
    for chosen, some in _by_choice(trials):
        yield some, replace(options, nonlinearity=dict(compress(terms.items(), chosen)))


def tools_per_fit(readings: Readings) -> int:
    """How many tools of a batch are fitted in one call."""
    return max(1, TOOLS_PER_FIT * USUAL_STATIONS // max(readings.count, USUAL_STATIONS))


def alike(tools: Ints, keys: AnyArray) -> list[tuple[AnyArray, Ints]]:
    """The given tools by their keys (T, k), and each key once."""
    if (keys == keys[:1]).all():
        return [(keys[0], tools)] if len(tools) else []
    kinds, number = np.unique(keys, axis=0, return_inverse=True)
    return [(kind, tools[number == place]) for place, kind in enumerate(kinds)]


def _by_choice(trials: Iterable[tuple[Ints, AnyArray]]) -> list[tuple[AnyArray, Ints]]:
    """Tools by what is chosen for them: a row (k,) each."""
    parts = list(zip(*trials, strict=True))
    return alike(*map(np.concatenate, parts)) if parts else []


def in_chunks(
    readings: Readings,
    tools: Ints,
    work: Callable[[Readings], _T],
    fail: Fail,
) -> Iterator[tuple[Ints, _T]]:
    """The work on given members of a batch, some at a time; in halves where one stops the whole."""
    count = max(1, int(len(tools) / tools_per_fit(readings) + 2 / 3))
    size = max(1, -(-len(tools) // count))
    for start in range(0, len(tools), size):
        part = tools[start : start + size]
        try:
            result = work(take(readings, part))
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            if len(part) == 1:
                fail(part, error)
                continue
            middle = len(part) // 2
            for half in (part[:middle], part[middle:]):
                yield from in_chunks(readings, half, work, fail)
        else:
            yield part, result
