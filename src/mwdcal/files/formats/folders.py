"""Folders of files: those that are meant by one, names that every system takes, and folders that appear whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unicodedata import normalize
from urllib.parse import quote

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files.formats import atomic

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
        atomic.rename(unfinished, folder)
    except OSError as error:
        raise InputError(
            f"cannot write to '{folder}': {reason(error)}. Make room there, or name another folder."
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
