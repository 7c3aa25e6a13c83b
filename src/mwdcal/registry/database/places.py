"""Whether a file lies on a network drive, whose locks and shared memory SQLite cannot rely on."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
from pathlib import Path

_NETWORK = re.compile(
    "nfs4?|cifs|smb[23]?|smbfs|ncpfs|afs|ceph|glusterfs|lustre|beegfs|davfs|"
    r"fuse\.(davfs2|sshfs|rclone|s3fs)"
)
"""File systems that several machines may write to, by Linux's names."""
_REMOTE_DRIVE = 4
_MOUNTS = Path("/proc/self/mounts")


def on_network(path: Path) -> bool:
    """Whether a file, or the folder where it is to be, is on a network drive; no where that cannot be known."""
    with contextlib.suppress(OSError, ValueError):
        place = path.resolve()
        if os.name == "nt":
            return _remote_drive(place)
        kind = file_system(place, _MOUNTS.read_text("utf-8", "replace"))
        return _NETWORK.fullmatch(kind) is not None
    return False


def file_system(place: Path, mounts: str) -> str:
    """The file system that holds a place, from Linux's list of mounts; the last of the longest that fit."""
    result, length = "", -1
    for line in mounts.splitlines():
        _, point, kind, *_ = line.split(" ")
        folder = Path(point.encode("latin-1", "replace").decode("unicode_escape"))
        if len(folder.parts) >= length and place.is_relative_to(folder):
            result, length = kind, len(folder.parts)
    return result


def _remote_drive(place: Path) -> bool:
    """Whether Windows counts the drive of a path as remote, or has it as a share."""
    if place.drive.startswith("\\\\"):
        return True
    kernel = getattr(ctypes, "windll").kernel32  # noqa: B009 - only Windows has it
    return int(kernel.GetDriveTypeW(place.anchor)) == _REMOTE_DRIVE
