"""Where a stream comes from: a serial port, a socket, a file that grows, or the operator's hand.

A source gives lines with the time of their arrival, in seconds, for as long as it is not stopped. Losing the connection ends
nothing: it is said in `note`, counted in `drops`, and tried again.
"""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, Queue
from threading import Event
from typing import Any, Protocol

from mwdcal.bench.stream import LONGEST
from mwdcal.errors import InputError

AGAIN = 1.0
"""Seconds before a lost connection is tried again."""
WAIT = 0.2
"""Seconds that a source waits for bytes before it looks whether it is stopped."""
BAUD = 115_200
CHUNK = 1 << 16
_SERIAL = re.compile(r"serial:(?P<port>[^@]+?)(?:@(?P<baud>\d{2,8}))?")
_TCP = re.compile(r"tcp:(?P<host>.+):(?P<port>\d{1,5})")


class Source(Protocol):
    """Lines with their times; `note` is blank while all is well."""

    note: str
    drops: int

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """The lines until `stop` is set."""


class Lines:
    """Bytes cut into lines; one longer than any line of a stream comes as its beginning."""

    def __init__(self) -> None:
        self.rest = b""

    def take(self, data: bytes) -> list[str]:
        """The lines that these bytes complete."""
        *whole, self.rest = re.split(rb"\r\n|\n|\r(?!$)", self.rest + data)
        self.rest = self.rest[: LONGEST + 1]
        return [line.decode("utf-8", "replace").strip("\r\x00 ") for line in whole]


class Connection:
    """A source of bytes that may be lost, and is opened again."""

    def __init__(self, what: str) -> None:
        self.what, self.note, self.drops = what, "", 0

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
                stop.wait(AGAIN)
                continue
            self.note, before, buffer = "", True, Lines()
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
        self.note = f"{self.what}: {error.strerror or error}. Trying again every second."


class SerialPort(Connection):
    """A serial port."""

    def __init__(self, port: str, baud: int) -> None:
        super().__init__(port)
        try:
            import serial
        except ImportError:
            raise InputError(
                'a serial port needs pyserial, which is not installed. Install mwdcal[bench]: pip install "mwdcal[bench]"'
            ) from None
        self._library, self._place = serial, (port, baud)

    def open(self) -> Any:
        """The open port."""
        port, baud = self._place
        return self._library.Serial(port, baud, timeout=WAIT)

    def read(self, opened: Any) -> bytes:
        """What has come, at least one byte or nothing within the waiting time."""
        return bytes(opened.read(max(1, opened.in_waiting)))


class Socket(Connection):
    """A TCP connection to a server that sends lines."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(f"{host}:{port}")
        self._place = (host, port)

    def open(self) -> socket.socket:
        """The open connection."""
        opened = socket.create_connection(self._place, timeout=5)
        opened.settimeout(WAIT)
        return opened

    def read(self, opened: Any) -> bytes:
        """What has come within the waiting time."""
        try:
            data = bytes(opened.recv(CHUNK))
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError(None, "the other side has closed the connection")
        return data


class GrowingFile(Connection):
    """A file that another program writes line by line; one that became shorter is read from its start."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path

    def open(self) -> Any:
        """The open file."""
        return self.path.open("rb")

    def read(self, opened: Any) -> bytes:
        """What was added; waits where nothing was."""
        data = bytes(opened.read(CHUNK))
        if not data:
            if self.path.stat().st_size < opened.tell():
                opened.seek(0)
            time.sleep(WAIT / 2)
        return data


class ByHand:
    """Lines that the operator types or pastes."""

    def __init__(self) -> None:
        self.note, self.drops = "", 0
        self.typed: Queue[str] = Queue()

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """The lines as they are typed."""
        while not stop.is_set():
            try:
                yield time.monotonic(), self.typed.get(timeout=WAIT)
            except Empty:
                continue


def source_of(text: str) -> Source:
    """The source that `--source` names; the simulated stand is made elsewhere.

    Raises:
        InputError: it is none of them.
    """
    if text == "manual":
        return ByHand()
    if found := _SERIAL.fullmatch(text):
        return SerialPort(found["port"], int(found["baud"] or BAUD))
    if found := _TCP.fullmatch(text):
        if not 0 < int(found["port"]) < 65536:
            raise InputError(f"--source '{text}': a port is between 1 and 65535. Correct it.")
        return Socket(found["host"].strip("[]"), int(found["port"]))
    if text.startswith("tail:") and text[5:]:
        return GrowingFile(Path(text[5:]))
    raise InputError(
        f"--source '{text}': must be demo, manual, serial:PORT@BAUD, tcp:HOST:PORT or tail:FILE. Correct it."
    )
