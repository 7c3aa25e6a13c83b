"""SHA-256 of files and documents."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from io import BufferedIOBase


def sha256_of(content: bytes | BinaryIO | BufferedIOBase | Path) -> str:
    """The SHA-256 of bytes, of a stream that is open for reading, or of a file, in hexadecimal digits."""
    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    if isinstance(content, Path):
        with content.open("rb") as stream:
            return sha256_of(stream)
    digest = hashlib.sha256()
    while block := content.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()
