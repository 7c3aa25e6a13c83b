"""Atomic writing: an interrupted command leaves the old file or none, never half of one.

A file grows under a temporary name beside its target, locked as long as its writer lives. The next
command that writes into the folder removes such a file of a killed one, if it writes into the folder. A link
stays, and the file behind it is replaced; a replaced file keeps its group and its permissions.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any
from unicodedata import normalize
from urllib.parse import quote

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason

# --------------------------------------------------------------------------
# Folders of files: those that are meant by one, names that every system takes, and folders that appear whole.


HIDDEN_BY_SYSTEMS = (".", "~$")
"""How names begin of files and folders that systems and programs hide."""
HIDDEN = ("_", *HIDDEN_BY_SYSTEMS)
"""How names begin of those that are no part of a table in many files: writers of such tables keep notes in them."""
PLAIN = " ._-+,=@()"
"""Characters besides letters and digits that stay as they are in the name of a file."""
LONGEST_FILE_NAME = 120
"""Bytes of the name of a file, without its suffix."""
RESERVED = {
    "con",
    "prn",
    "aux",
    "nul",
    *(f"{port}{n}" for port in ("com", "lpt") for n in range(10)),
}
"""Names that Windows keeps for devices, whatever their suffix."""


def visible_files(folder: Path, hidden: tuple[str, ...] = HIDDEN) -> list[Path]:
    """All files in a folder and in those below it, by name; hidden and temporary ones are left out."""
    return sorted(
        file
        for file in folder.rglob("*")
        if file.is_file()
        and not any(part.startswith(hidden) for part in file.relative_to(folder).parts)
    )


def file_name(serial: str) -> str:
    r"""A serial or another text as the name of a file on any system, without suffix; others differ, but for case.

    >>> [file_name(serial) for serial in ("MWD-17", "Süd 3", "A/B#1", "con", "..", "50%")]
    ['MWD-17', 'Süd 3', 'A%2FB%231', '%63on', '%2E%2E', '50%25']
    """
    kept = normalize("NFC", serial)
    name = "".join(c if c.isalnum() or c in PLAIN else quote(c, safe="") for c in kept)
    inner = name.strip(" .")
    place = name.find(inner) if inner else len(name)
    name = _escaped(name[:place]) + inner + _escaped(name[place + len(inner) :])
    if name.partition(".")[0].strip().casefold() in RESERVED:
        name = _escaped(name[0]) + name[1:]
    if len(name.encode()) <= LONGEST_FILE_NAME:
        return name
    return name.encode()[: LONGEST_FILE_NAME - 10].decode(errors="ignore") + mark_of(serial)


def _escaped(text: str) -> str:
    return "".join(f"%{ord(c):02X}" for c in text)


def mark_of(serial: str) -> str:
    """What tells a serial from those that share its name; no name has this sign otherwise."""
    return f"~{sha256_of(serial.encode())[:8]}"


def check_new(folder: Path) -> None:
    """Refuse a folder that cannot be made, or in which there is something."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write to '{folder}': it is not a folder. Name another.")
    if not folder.resolve().parent.is_dir():
        raise InputError(
            f"cannot write to '{folder}': the folder it is in does not exist. Create that."
        )
    if folder.exists() and any(folder.iterdir()):
        raise InputError(
            f"cannot write to '{folder}': there are files in it, which are not replaced. Name a new folder."
        )


@contextmanager
def whole(folder: Path) -> Iterator[Path]:
    """A folder to fill, which has its name when the block ends without an error."""
    folder = folder.resolve()
    unfinished = folder.with_name(f".mwdcal-{folder.name}.tmp")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)  # of a command that was killed
        unfinished.mkdir()
        yield unfinished
        check_new(folder)
        if folder.exists():
            folder.rmdir()
        rename(unfinished, folder)
    except OSError as error:
        raise InputError(
            f"cannot write to '{folder}': {reason(error)}. Make room there, or name another folder."
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


try:
    fcntl: Any = import_module("fcntl")
except ImportError:  # Windows, where an open file can be neither removed nor renamed
    fcntl = None
    msvcrt: Any = import_module("msvcrt")

SQLITE = b"SQLite format 3\0"
"""How the file of a registry begins."""
_WRITTEN_AHEAD = 18, 2
"""Where such a file says so, and how, if it is shared: a registry in use, and no backup of one."""
_PATTERN = ".mwdcal-*.tmp"
_DAY_SECONDS = 86_400.0
"""Seconds after which a file of another machine counts as left behind: its locks may not reach here."""
_RENAME_SECONDS = 5.0
"""Seconds after which a file that is not open counts as left behind on Windows: its writer may yet rename it."""
_PAUSES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Seconds between attempts to rename a file that a virus scanner or an indexer holds open for a moment."""


def write_all(files: Iterable[tuple[Path | None, bytes | str | Iterable[str]]]) -> None:
    """Write several files, or none of them where one cannot be written; no path, no file.

    Text in pieces is made while it is written.
    """
    with contextlib.ExitStack() as stack:
        for path, data in files:
            if path:
                stream = stack.enter_context(replacing(path, durable=False))
                for piece in [data] if isinstance(data, bytes | str) else data:
                    stream.write(_encoded(piece))
                stream.flush()
                os.fsync(stream.fileno())  # all are on the disk before the first is replaced


def write(path: str | os.PathLike[str], data: bytes | str, durable: bool = True) -> None:
    """Write `data` (text as UTF-8) to `path`, which is replaced as a whole or not at all.

    Not `durable`: a loss of power may leave a part of the new file; a killed program does not.
    """
    with replacing(path, durable) as stream:
        stream.write(_encoded(data))


def _encoded(data: bytes | str) -> bytes:
    return data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data


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
            _keep_permissions(file, temporary)
            if durable:
                os.fsync(stream.fileno())  # wait until it is on the disk
            if fcntl:
                rename(temporary, file)  # still locked: no sweep comes between
        if not fcntl:
            rename(temporary, file)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def rename(old: Path, new: Path) -> None:
    """Give a file or a folder another name, that of a file which it replaces, or a free one."""
    for pause in () if fcntl else _PAUSES:
        with contextlib.suppress(PermissionError):
            old.replace(new)
            return
        time.sleep(pause)
    old.replace(new)


def target(path: str | os.PathLike[str]) -> Path:
    """The file behind `path`, links followed; refuses folders, devices and what is write-protected."""
    try:
        file = Path(os.path.realpath(path))
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            file.lstat()  # raises for a name that no file can have
        why = _hindrance(file)
    except (OSError, ValueError) as error:
        raise _refusal(path, error) from error
    if why:
        raise InputError(f"cannot write '{path}': {why}")
    return file


def _hindrance(file: Path) -> str:
    """Why a file may not be written, and what to do; empty where nothing hinders."""
    if file.is_dir():
        return "it is a folder. Name a file to write."
    if file.is_symlink() or (file.exists() and not file.is_file()):
        return "it is not a regular file. Name a file to write."
    if not file.parent.is_dir():
        return _missing(file.parent)
    if fcntl is None and ":" in file.name:
        return "behind the colon is the name of a stream inside the file. Name a file without."
    writable = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH  # for the superuser anything else is
    if file.exists() and not (file.stat().st_mode & writable and os.access(file, os.W_OK)):
        return "it is write-protected. Name another file, or remove the protection."
    if file.exists() and _is_registry_in_use(file):
        return "it is a registry, which would be lost. Name another file."
    return ""


def _is_registry_in_use(file: Path) -> bool:
    """Whether a file is a database that is not a mere backup."""
    place, mark = _WRITTEN_AHEAD
    with contextlib.suppress(OSError), file.open("rb") as stream:
        head = stream.read(place + 1)
        return head.startswith(SQLITE) and head[place:] == bytes([mark])
    return False


def _missing(folder: Path) -> str:
    return f"the folder '{folder}' does not exist. Create it, or name another folder."


def identity(file: Path | int) -> tuple[int, int] | None:
    """Identity of a file under all its names: links, hard links, spellings; None for others.

    An integer is an open file.
    """
    try:
        status = os.fstat(file) if isinstance(file, int) else file.stat()
    except (OSError, ValueError):
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISREG(status.st_mode) else None


def _keep_permissions(old: Path, new: Path) -> None:
    """Give the new file the group and the permissions of the one that it replaces, if there is one."""
    with contextlib.suppress(FileNotFoundError):
        kept = old.stat()
        with contextlib.suppress(OSError, AttributeError):  # Windows, or a group of others
            os.chown(new, -1, kept.st_gid)
        new.chmod(stat.S_IMODE(kept.st_mode) & 0o777)


@contextlib.contextmanager
def folder(path: Path) -> Iterator[None]:
    """A folder for files, made if need be; one that was made goes again when the block fails."""
    try:
        path.mkdir()
    except FileExistsError:
        if not path.is_dir():
            raise InputError(f"cannot write '{path}': it is not a folder. Name another.") from None
        yield
        return
    except FileNotFoundError:
        raise InputError(f"cannot write '{path}': {_missing(path.parent)}") from None
    except (OSError, ValueError) as error:
        raise _refusal(path, error) from error
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            path.rmdir()
        raise


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
        try:
            _lock(stream)
        except BlockingIOError:
            stream.close()
            return None
        except OSError:
            return stream  # no locks on this disk
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(stream.fileno())):
                return stream
        stream.close()  # the last holder has removed it


def _lock(stream: IO[bytes]) -> None:
    """Lock a file until it is closed or its process ends; raises BlockingIOError where another has it."""
    if fcntl:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    try:
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
    except PermissionError as error:
        raise BlockingIOError(*error.args) from error


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
    age = time.time() - path.stat().st_mtime
    if fcntl is None:
        if age > _RENAME_SECONDS:
            path.unlink()  # refused by the system while it is open
        return
    near = path.name.startswith(f".mwdcal-{_machine()}-")
    with path.open("rb+") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if near or age > _DAY_SECONDS:
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
