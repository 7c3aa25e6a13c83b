"""Atomic writing: an interrupted command leaves the old file or none, never half of one."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mwdcal.errors import InputError


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
    temporary = file.with_name(f".mwdcal-{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            if durable:
                os.fsync(stream.fileno())  # wait until it is on the disk
        temporary.replace(file)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        _remove(temporary)


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


def _remove(path: Path) -> None:
    """Remove what an error or an interruption left; nothing is left after a success."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _refusal(path: str | os.PathLike[str], error: Exception) -> InputError:
    """The error of the operating system in our form."""
    if isinstance(error, PermissionError):
        advice = "Close the program that has it open, or choose a folder you may write to."
    else:
        advice = "Choose another place, or make room on this one."
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(f"cannot write '{path}': {reason}. {advice}")
