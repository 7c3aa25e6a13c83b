"""The folder of a session: every reading that counts and every decision, written and flushed before anybody sees it.

`session.jsonl` is only ever added to, one event a line. All other files can be made of it again.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mwdcal.errors import InputError
from mwdcal.files.formats import atomic

Event = dict[str, Any]
JOURNAL_NAME = "session.jsonl"


class Journal:
    """Events of a session; those that a former server wrote first."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL_NAME
        self.events: list[Event] = [*self._past()]
        self._stream = self.path.open("ab")

    def _past(self) -> Iterator[Event]:
        """Events of the file. A last line that was cut off when the power went is taken away: nobody has seen it."""
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return
        *lines, rest = data.split(b"\n")
        if rest:
            atomic.write(self.path, data[: len(data) - len(rest)])
        for number, line in enumerate(lines, 1):
            try:
                event = json.loads(line)
                if not isinstance(event["event"], str):
                    raise TypeError
            except (ValueError, TypeError, KeyError):
                raise InputError(
                    f"{self.path}, line {number}: is not an event of a session. Take the line from a copy, or name "
                    "another folder."
                ) from None
            yield event

    def add(self, event: Event) -> None:
        """Write an event and wait until it is on the disk.

        Raises:
            InputError: the disk is full, or gone; the event is not in the file then.
        """
        line = json.dumps(event, ensure_ascii=False, allow_nan=False).encode() + b"\n"
        before = self._stream.tell()
        try:
            self._stream.write(line)
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError as error:
            self._take_back(before)
            raise InputError(
                f"cannot write '{self.path}': {error.strerror}. Make room, and do it again: nothing was accepted."
            ) from error
        self.events.append(event)

    def _take_back(self, size: int) -> None:
        """Cut a line that was written in part."""
        path = os.fspath(self.path)
        with contextlib.suppress(OSError):
            self._stream.close()
        os.truncate(path, size)
        self._stream = self.path.open("ab")

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
