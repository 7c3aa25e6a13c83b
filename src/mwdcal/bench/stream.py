"""The lines of a stream and their channels: as `[stream]` of the tool profile says, or learned from the first lines."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mwdcal.files.contract import RAW
from mwdcal.files.synonyms import FACTORS
from mwdcal.sensor.profile import StreamForm

TEMPERATURE_COLUMN, TIME_COLUMN = "temperature_c", "time_s"
LINE_CHARACTERS = 4000
"""Characters of a line that are read; a longer line is garbage."""
LARGEST_VALUE = 1e12
"""No reading is larger, nor a time."""
LEARNED = 5
"""Lines of numbers that agree, from which their number of columns is learned."""
COLUMNS_BY_NUMBER = {
    3: RAW[:3],
    4: (*RAW[:3], TEMPERATURE_COLUMN),
    6: RAW,
    7: (*RAW, TEMPERATURE_COLUMN),
    8: (TIME_COLUMN, *RAW, TEMPERATURE_COLUMN),
}
"""Columns of a line of so many numbers, where nothing says what they are."""


@dataclass(frozen=True)
class Sample:
    """The channels of one line, raw, in the order of `Stream.channels`; its time in seconds, if it has one."""

    values: tuple[float, ...]
    time: float | None = None


class Stream:
    """Reads lines; counts those that it can read, and those that it cannot."""

    def __init__(self, form: StreamForm | None = None) -> None:
        self.form = form
        self.good = self.garbage = 0
        self._seen: list[int] = []
        self._pattern = re.compile(form.pattern) if form and form.pattern else None
        self.channels = self._channels()

    def _channels(self) -> tuple[str, ...]:
        """Raw channels and temperature of a sample, in their order; empty until they are known."""
        names = self.form.columns if self.form else ()
        names = names or (tuple(self._pattern.groupindex) if self._pattern else ())
        return tuple(name for name in (*RAW, TEMPERATURE_COLUMN) if name in names)

    def take(self, line: str) -> Sample | None:
        """The sample of a line, or None; a line that is neither blank nor a header then counts as garbage."""
        if not line.strip():
            return None
        try:
            if len(line) > LINE_CHARACTERS:
                raise ValueError("too long")
            sample = self._learn(line) if self.form is None else self._read(line, self.form)
        except (ValueError, OverflowError):
            if not _header(_parts(line, _separator(line))):
                self.garbage += 1
            return None
        self.good += sample is not None
        return sample

    def _read(self, line: str, form: StreamForm) -> Sample:
        if self._pattern is not None:
            match = self._pattern.search(line)
            cells: Mapping[str, str | None] = match.groupdict() if match else {}
        else:
            cells = dict(zip(form.columns, _parts(line, form.separator), strict=True))
        values = tuple(_number(cells, name, form) for name in self.channels)
        return Sample(values, _number(cells, TIME_COLUMN, form) if TIME_COLUMN in cells else None)

    def _learn(self, line: str) -> Sample | None:
        """Take note of a line before the form is known: a line of names, or the number of its columns."""
        separator = _separator(line)
        parts = _parts(line, separator)
        columns = _header(parts)
        if not columns:
            for part in parts:
                float(part)
            self._seen = [*self._seen[-LEARNED + 1 :], len(parts)]
            if len(self._seen) < LEARNED or len({*self._seen}) > 1:
                return None
            if len(parts) not in COLUMNS_BY_NUMBER:
                raise ValueError("columns of a number that means nothing")
            columns = COLUMNS_BY_NUMBER[len(parts)]
        self.form = StreamForm(columns=columns, separator=separator)
        self.channels = self._channels()
        return None


def _separator(line: str) -> str:
    """The sign between the columns of a line; empty for white space."""
    return next((sign for sign in (";", "\t", ",") if sign in line), "")


def _parts(line: str, separator: str) -> list[str]:
    return [part.strip() for part in line.split(separator or None)]


def _header(parts: Sequence[str]) -> tuple[str, ...]:
    """Columns of a line of names; empty if it is no such line."""
    names = [part.strip('"').lower() for part in parts]
    if not {*RAW[:3]} <= {*names}:
        return ()
    known = (*RAW, TEMPERATURE_COLUMN, TIME_COLUMN)
    return tuple(name if name in known else f"skip_{i}" for i, name in enumerate(names))


def _number(cells: Mapping[str, str | None], name: str, form: StreamForm) -> float:
    """A cell as a number; a value without size, or beyond all reason, is a ValueError."""
    factor, offset = FACTORS.get(form.units.get(name, ""), (1.0, 0.0))
    value = float(cells.get(name) or "") * factor + offset
    if abs(value) < LARGEST_VALUE:
        return value
    raise ValueError("no reading is so large")
