"""Atomic writing: an interrupted command leaves the old file or none, never half of one.

A file grows under a temporary name beside its target, locked as long as its writer lives. What a
killed command left under such a name is removed by the next one that writes into the folder.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
import zlib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from mwdcal.errors import InputError, reason

try:
    fcntl: Any = import_module("fcntl")
except ImportError:  # Windows, where an open file can be neither removed nor renamed
    fcntl = None

_PATTERN = ".mwdcal-*.tmp"
_DAY = 86_400.0
"""Seconds after which a file of another machine counts as left behind: its locks may not reach here."""


def write(path: str | os.PathLike[str], data: bytes | str, durable: bool = True) -> None:
    """Write `data` (text as UTF-8) to `path`, which is replaced as a whole or not at all.

    Not `durable`: a loss of power may leave a part of the new file; a killed program does not.
    """
    content = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    with replacing(path, durable) as stream:
        stream.write(content)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], durable: bool = True) -> Iterator[IO[bytes]]:
    """A new file to write to, which replaces `path` when the block ends without an error."""
    file = target(path)
    sweep(file.parent)
    temporary = file.with_name(f".mwdcal-{_machine()}-{secrets.token_hex(8)}.tmp")
    try:
        with _begun(temporary) as stream:
            yield stream
            stream.flush()
            if durable:
                os.fsync(stream.fileno())  # wait until it is on the disk
            if fcntl:
                temporary.replace(file)  # still locked: no sweep comes between
        if not fcntl:
            temporary.replace(file)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def target(path: str | os.PathLike[str]) -> Path:
    """The file behind `path`, links followed; refuses folders and devices."""
    try:
        file = Path(os.path.realpath(path))
        special = file.exists() and not file.is_file()
    except (OSError, ValueError) as error:
        raise _refusal(path, error) from error
    if special:
        kind = "a folder" if file.is_dir() else "not a regular file"
        raise InputError(f"cannot write '{path}': it is {kind}. Name a file to write.")
    if not file.parent.is_dir():
        raise InputError(
            f"cannot write '{path}': the folder '{file.parent}' does not exist. "
            "Create it, or name another folder."
        )
    return file


@contextlib.contextmanager
def holding(path: Path) -> Iterator[bool]:
    """Whether this process holds the file, whose folder is made if need be.

    Both are removed afterwards, the folder if it is empty.
    """
    try:
        stream = _held(path)
    except OSError as error:
        raise _refusal(path, error) from error
    try:
        yield stream is not None
    finally:
        if stream is not None:
            if fcntl is None:
                stream.close()
            with contextlib.suppress(OSError):
                path.unlink()
                path.parent.rmdir()
            stream.close()


def _held(path: Path) -> IO[bytes] | None:
    """The file, locked until it is closed or its process ends; None where another has it."""
    while True:
        with contextlib.suppress(FileExistsError):
            path.parent.mkdir()
        try:
            stream = path.open("ab")
        except FileNotFoundError:
            continue  # its last holder came between, and has removed the folder
        if fcntl is None:
            return stream
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            return None
        except OSError:
            return stream  # no locks on this disk
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(stream.fileno())):
                return stream
        stream.close()  # the last holder has removed it


def _begun(temporary: Path) -> IO[bytes]:
    """The new file, locked until it is closed or its process ends, however it does."""
    while True:
        stream = temporary.open("xb")
        if fcntl is None:
            return stream
        with contextlib.suppress(OSError):  # no locks on this disk: then nobody can sweep either
            fcntl.flock(stream, fcntl.LOCK_EX)
        if temporary.exists():
            return stream
        stream.close()  # a sweep came between the two


@cache
def sweep(folder: Path) -> None:
    """Remove, once per process, temporary files whose writer was killed."""
    with contextlib.suppress(OSError):
        for path in folder.glob(_PATTERN):
            with contextlib.suppress(OSError):
                _remove_if_left(path)


def _remove_if_left(path: Path) -> None:
    """Remove a temporary file that nobody holds; raises OSError where one does, or may."""
    if path.is_symlink() or not path.is_file():
        return
    if fcntl is None:
        path.unlink()  # refused by the system while it is open
        return
    near = path.name.startswith(f".mwdcal-{_machine()}-")
    with path.open("rb+") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if near or time.time() - os.fstat(stream.fileno()).st_mtime > _DAY:
            path.unlink()


@cache
def _machine() -> str:
    """Eight digits for the machine."""
    name = os.uname().nodename if hasattr(os, "uname") else ""
    return f"{zlib.crc32(name.encode()):08x}"


def _refusal(path: str | os.PathLike[str], error: Exception) -> InputError:
    """An error of the operating system, with advice."""
    if isinstance(error, PermissionError):
        advice = "Close the program that has it open, or choose a folder you may write to."
    else:
        advice = "Choose another place, or make room on this one."
    return InputError(f"cannot write '{path}': {reason(error)}. {advice}")
