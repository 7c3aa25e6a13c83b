"""Where a stream comes from: a serial port, a socket, a file that grows, or the operator's hand.

A source gives lines with the time of their arrival, in seconds, until it is stopped. A lost connection ends nothing:
`note` says so, `drops` counts it, and the source tries again.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any, Protocol

from mwdcal import extras
from mwdcal.bench.stream import LINE_CHARACTERS
from mwdcal.errors import InputError

RETRY_SECONDS = 1.0
"""Seconds before a lost connection is tried again."""
WAIT = 0.2
"""Seconds that a source waits for bytes before it looks whether it is stopped."""
BAUD = 115_200
RECEIVED = 1 << 16
"""Bytes that are read at once."""
_SERIAL_SPEC = re.compile(r"serial:(?P<port>[^@]+?)(?:@(?P<baud>\d{2,8}))?")
_TCP_SPEC = re.compile(r"tcp:(?P<host>.+):(?P<port>\d{1,5})")


class LineSource(Protocol):
    """Lines with their times; `note` is blank while all is well."""

    note: str
    drops: int

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """The lines until `stop` is set."""


class Lines:
    """Bytes cut into lines; one longer than any line of a stream comes as its beginning.

    `midway`: the bytes begin somewhere within a line, which is not taken.
    """

    def __init__(self, midway: bool = False) -> None:
        self.rest, self.midway = b"", midway

    def take(self, data: bytes) -> list[str]:
        """The lines that these bytes complete."""
        *whole, self.rest = re.split(rb"\r\n|\n|\r(?!$)", self.rest + data)
        self.rest = self.rest[: LINE_CHARACTERS + 1]
        if self.midway and whole:
            whole, self.midway = whole[1:], False
        return [line.decode("utf-8", "replace").strip("\r\x00 ") for line in whole]


class Connection:
    """A source of bytes that may be lost, and is opened again; `place` names it in messages."""

    def __init__(self, place: str) -> None:
        self.place, self.note, self.drops = place, "", 0
        self.midway = False

    def open(self) -> Any:
        """The open connection."""
        raise NotImplementedError

    def read(self, opened: Any) -> bytes:
        """Bytes, none where there are none yet; raises OSError where the connection is lost."""
        raise NotImplementedError

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """The lines until `stop` is set."""
        before = False
        while not stop.is_set():
            try:
                opened = self.open()
            except OSError as error:
                self._lost(error, before)
                before = False
                stop.wait(RETRY_SECONDS)
                continue
            self.note, before, buffer = "", True, Lines(self.midway)
            try:
                while not stop.is_set():
                    for line in buffer.take(self.read(opened)):
                        yield time.monotonic(), line
            except OSError as error:
                self._lost(error, before)
                before = False
            finally:
                opened.close()

    def _lost(self, error: OSError, before: bool) -> None:
        self.drops += before
        self.note = f"{self.place}: {error.strerror or error}. Trying again every second."


class SerialPort(Connection):
    """A serial port."""

    def __init__(self, port: str, baud: int) -> None:
        super().__init__(port)
        serial = extras.load("serial", "a serial port", "bench")
        self._library, self._port, self.midway = serial, (port, baud), True

    def open(self) -> Any:
        """The open port."""
        port, baud = self._port
        try:
            return self._library.Serial(port, baud, timeout=WAIT)
        except Exception as error:  # of termios too, which are no OSError
            raise OSError(None, str(error)) from error

    def read(self, opened: Any) -> bytes:
        """What has come, at least one byte or nothing within the waiting time."""
        return bytes(opened.read(max(1, opened.in_waiting)))


class Socket(Connection):
    """A TCP connection to a server that sends lines."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(f"{host}:{port}")
        self._address = (host, port)

    def open(self) -> socket.socket:
        """The open connection."""
        opened = socket.create_connection(self._address, timeout=5)
        opened.settimeout(WAIT)
        return opened

    def read(self, opened: Any) -> bytes:
        """What has come within the waiting time."""
        try:
            data = bytes(opened.recv(RECEIVED))
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError(None, "the other side has closed the connection")
        return data


class GrowingFile(Connection):
    """A file that another program writes line by line. A file that was replaced, or cut, is read from its start."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path

    def open(self) -> Any:
        """The open file."""
        return self.path.open("rb")

    def read(self, opened: Any) -> bytes:
        """The bytes that were added; waits if there are none."""
        data = bytes(opened.read(RECEIVED))
        if not data:
            now, before = self.path.stat(), os.fstat(opened.fileno())
            if (now.st_ino, now.st_dev) != (before.st_ino, before.st_dev):
                raise FileNotFoundError(None, "another file has this name now")
            if now.st_size < opened.tell():
                opened.seek(0)
            time.sleep(WAIT / 2)
        return data


class ByHand:
    """No stream: the operator types readings into the page."""

    def __init__(self) -> None:
        self.note, self.drops = "", 0

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """No lines."""
        stop.wait()
        yield from ()


def source_of(text: str) -> LineSource:
    """The source of a text such as "tcp:HOST:PORT"; the simulated stand is not one of them.

    Raises:
        InputError: it names no source.
    """
    if text == "manual":
        return ByHand()
    if match := _SERIAL_SPEC.fullmatch(text):
        return SerialPort(match["port"], int(match["baud"] or BAUD))
    if match := _TCP_SPEC.fullmatch(text):
        if not 0 < int(match["port"]) < 65536:
            raise InputError(f"source '{text}': a port is between 1 and 65535. Correct it.")
        return Socket(match["host"].strip("[]"), int(match["port"]))
    if text.startswith("tail:") and text[5:]:
        return GrowingFile(Path(text[5:]))
    raise InputError(
        f"source '{text}': must be demo, manual, serial:PORT@BAUD, tcp:HOST:PORT or tail:FILE. Correct it."
    )
