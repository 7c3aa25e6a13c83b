"""Files that a fleet keeps beside its output until it is done, and how they differ from what others put there.

A part is with_checksum: its mark, length and checksum precede its content. Rows that were dealt into
files of whole tools have a manifest beside them. Damaged parts are not used; they are made again.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from zlib import crc32

import msgspec

from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.files.formats import atomic, members
from mwdcal.files.formats.atomic import file_name, mark_of, whole

# --------------------------------------------------------------------------
# The calibration file of each tool of a fleet, named by its serial, in a folder of their own.


def write(table: Path, folder: Path) -> int:
    """Write the calibration file of each tool of a fleet's table, all or none, and count them."""
    taken: set[str] = set()
    with whole(folder) as unfinished:
        for serial, record in members.records(table):
            name = file_name(serial)
            if name.casefold() in taken:
                name = f"{name}{mark_of(serial)}"
            taken.add(name.casefold())
            (unfinished / f"{name}.json").write_bytes(documents.laid_out(record))
    return len(taken)


SEAL = b"mwdcal fleet part "
HEAD = 64
"""Bytes before the content of a part."""
LOCK = "lock"
MANIFEST = "manifest.json"
_PART = re.compile(r"[0-9a-f]{32}\.arrow")
_DEALT = re.compile(r"sorted-[0-9a-f]{16}(\.tmp)?")
_DEALT_FILE = re.compile(r"\d{4}\.parquet|manifest\.json")
_BEGINNINGS = {".arrow": (SEAL, b"\xff\xff\xff\xff"), ".parquet": (b"PAR1",), ".json": (b"",)}
"""How our files begin, by their suffix; parts of mwdcal before they were with_checksum as Arrow's streams do."""


def with_checksum(content: bytes, name: str) -> bytes:
    """A part with its seal, which also holds its name."""
    return _head(content, name) + content


def _head(content: bytes | memoryview, name: str) -> bytes:
    """The seal of a part."""
    check = crc32(content, crc32(name.encode()))
    return (SEAL + b"%016x %08x" % (len(content), check)).ljust(HEAD - 1) + b"\n"


def write_part(path: Path, content: bytes) -> None:
    """Keep a finished part: whole, or not at all; a loss of power may damage it until it is `to_disk`."""
    if not path.parent.is_dir():
        raise InputError(
            f"'{path.parent}': no such folder on this machine. Workers on other machines must see the table, "
            "and the folder of the output, under the same paths."
        )
    atomic.write(path, with_checksum(content, path.name), durable=False)


def unsealed(data: bytes, name: str) -> memoryview | None:
    """The content of a with_checksum part; None where it is damaged."""
    content = memoryview(data)[HEAD:]
    return content if data[:HEAD] == _head(content, name) else None


def read_part(path: Path) -> memoryview | None:
    """The content of a finished part; None where it is missing or damaged."""
    with contextlib.suppress(OSError):
        return unsealed(path.read_bytes(), path.name)
    return None


def finished(paths: Iterable[Path]) -> tuple[set[Path], int]:
    """Which parts are there, whole; and how many are there, but damaged."""
    there = [path for path in paths if path.exists()]
    whole = {path for path in there if read_part(path) is not None}
    return whole, len(there) - len(whole)


def to_disk(path: Path) -> None:
    """Wait until a file and its name are on the disk, where the system can say so."""
    for each, mode in ((path, os.O_RDWR), (path.parent, os.O_RDONLY)):
        with contextlib.suppress(OSError):
            descriptor = os.open(each, mode)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def check_folder(folder: Path) -> None:
    """Refuse a path that is no folder, or in which a name of ours stands for something else."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        kind = "a link" if folder.is_symlink() else "not a folder"
        raise InputError(
            f"cannot write to '{folder}', where finished parts are kept: it is {kind}. Remove or rename "
            "it, or choose another `output`."
        )
    for path in folder.iterdir() if folder.exists() else ():
        name, link = path.name, path.is_symlink()
        ours = name == LOCK or _PART.fullmatch(name) or _DEALT.fullmatch(name)
        if (ours and link) or (name == LOCK and not (path.is_file() and path.stat().st_size == 0)):
            raise InputError(
                f"cannot write to '{folder}', where finished parts are kept: '{name}' there is not "
                "a file of mwdcal. Remove it, or choose another `output`."
            )


def remove(folder: Path) -> None:
    """Remove parts and dealt rows from a folder, and nothing that is not ours."""
    for path in list(folder.iterdir()):
        if is_dealt(path):
            shutil.rmtree(path)
        elif _is_ours(path, _PART):
            path.unlink()


def is_dealt(folder: Path) -> bool:
    """Whether a folder has nothing but dealt rows, finished or not."""
    ours = folder.is_dir() and not folder.is_symlink() and _DEALT.fullmatch(folder.name)
    return bool(ours) and all(_is_ours(path, _DEALT_FILE) for path in folder.iterdir())


def _is_ours(path: Path, names: re.Pattern[str]) -> bool:
    """Whether a file has such a name, and begins as it says or with what a loss of power leaves of that."""
    if path.is_symlink() or not path.is_file() or not names.fullmatch(path.name):
        return False
    with path.open("rb") as stream:
        head = stream.read(HEAD)
    return head.startswith(_BEGINNINGS[path.suffix]) or not head.strip(b"\0")


def make_room(folder: Path) -> None:
    """Remove a folder of dealt rows that is damaged or was not finished; refuse one of others."""
    if not folder.exists():
        return
    if not is_dealt(folder):
        raise InputError(
            f"cannot write to '{folder}': there is something in it that is not mwdcal's. Move it away, or "
            "choose another `output`."
        )
    shutil.rmtree(folder)


def write_manifest(folder: Path) -> None:
    """State the files of a folder of dealt rows, each with its checksum."""
    (folder / MANIFEST).write_bytes(msgspec.json.encode(_checksums(folder)))


def is_whole(folder: Path) -> bool:
    """Whether dealt rows are there, as their manifest states."""
    try:
        stated = msgspec.json.decode((folder / MANIFEST).read_bytes())
        return is_dealt(folder) and bool(stated == _checksums(folder))
    except (OSError, msgspec.MsgspecError, ValueError, RecursionError):
        return False


def _checksums(folder: Path) -> dict[str, str]:
    """Length and checksum of each file of dealt rows, by its name."""
    paths = sorted(path for path in folder.iterdir() if path.name != MANIFEST)
    with ThreadPoolExecutor() as pool:
        return dict(zip((path.name for path in paths), pool.map(_checksum, paths), strict=True))


def _checksum(path: Path) -> str:
    length, check = 0, 0
    with path.open("rb") as stream:
        while piece := stream.read(1 << 20):
            length, check = length + len(piece), crc32(piece, check)
    return f"{length} {check:08x}"
