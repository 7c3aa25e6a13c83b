"""Lines of a stream, and the channels that they hold: as the tool profile's `[stream]` says, or learned from the first lines."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from mwdcal.errors import InputError
from mwdcal.files.contract import RAW
from mwdcal.files.synonyms import FACTORS
from mwdcal.sensor.profile import StreamForm

TEMPERATURE, TIME, LABEL = "temperature_c", "time_s", "skip"
LONGEST = 4000
"""Characters of a line that are read; a longer line is garbage."""
LEARNED = 5
"""Lines of numbers that agree, from which their number of columns is learned."""
ORDERS = {
    6: RAW,
    7: (*RAW, TEMPERATURE),
    8: (TIME, *RAW, TEMPERATURE),
    3: RAW[:3],
    4: (*RAW[:3], TEMPERATURE),
}
"""Columns of a line of so many numbers, where nothing says what they are."""


@dataclass(frozen=True)
class Sample:
    """The channels of one line, raw, in the order of `Stream.channels`; its own time in seconds, if it has one."""

    values: tuple[float, ...]
    time: float | None = None


class Stream:
    """Reads lines; counts those that it cannot read."""

    def __init__(self, form: StreamForm | None = None) -> None:
        self.form = form
        self.garbage = 0
        self._seen: list[int] = []
        self._pattern = None if form is None or not form.pattern else re.compile(form.pattern)
        if self.form is not None and not self.form.columns and self._pattern is None:
            raise InputError(
                '[stream] of the tool profile names no columns. Add columns = ["ax", …], or pattern.'
            )

    @property
    def channels(self) -> tuple[str, ...]:
        """Raw channels and temperature of a sample, in their order; empty until they are known."""
        if self.form is None:
            return ()
        names = self.form.columns or tuple((self._pattern or re.compile("")).groupindex)
        return tuple(name for name in (*RAW, TEMPERATURE) if name in names)

    def take(self, line: str) -> Sample | None:
        """The sample of a line; None where it holds none, which is counted unless it is blank."""
        if not line.strip():
            return None
        try:
            return self._read(line) if len(line) <= LONGEST else self._garbage()
        except (ValueError, OverflowError):
            return self._garbage()

    def _garbage(self) -> None:
        self.garbage += 1

    def _read(self, line: str) -> Sample | None:
        if self.form is None:
            return self._learn(line)
        if self._pattern is not None:
            found = self._pattern.search(line)
            cells: Mapping[str, str] = found.groupdict() if found else {}
        else:
            parts = line.split(self.form.separator or None)
            if len(parts) != len(self.form.columns):
                return self._garbage()
            cells = dict(zip(self.form.columns, parts, strict=True))
        values = tuple(self._number(cells, name) for name in self.channels)
        time = self._number(cells, TIME) if TIME in cells else None
        if not all(map(isfinite, values)) or (time is not None and not isfinite(time)):
            return self._garbage()
        return Sample(values, time)

    def _number(self, cells: Mapping[str, str], name: str) -> float:
        unit = self.form.units.get(name, "") if self.form else ""
        factor, offset = FACTORS.get(unit, (1.0, 0.0))
        return float(cells[name]) * factor + offset

    def _learn(self, line: str) -> Sample | None:
        """Take note of a line before the form is known: a line of names, or the number of its columns."""
        separator = next((sign for sign in (";", "\t", ",") if sign in line), "")
        parts = [part.strip() for part in line.split(separator or None)]
        if named := _named(parts):
            self.form = StreamForm(columns=named, separator=separator)
            return None
        for part in parts:
            float(part)
        self._seen = [*self._seen[-LEARNED + 1 :], len(parts)]
        if len(self._seen) == LEARNED and len({*self._seen}) == 1:
            if len(parts) not in ORDERS:
                return self._garbage()
            self.form = StreamForm(columns=ORDERS[len(parts)], separator=separator)
            return self._read(line)
        return None


def _named(parts: Sequence[str]) -> tuple[str, ...]:
    """Columns of a line of names; empty where it is no such line."""
    lower = [part.strip().strip('"').lower() for part in parts]
    known = [name for name in lower if name in (*RAW, TEMPERATURE, TIME)]
    if not {"ax", "ay", "az"} <= {*known}:
        return ()
    return tuple(
        name if name in (*RAW, TEMPERATURE, TIME) else f"{LABEL}_{i}"
        for i, name in enumerate(lower)
    )
