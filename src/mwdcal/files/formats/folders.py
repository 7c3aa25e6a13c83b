"""The files in a folder that are meant by it: not those that systems and programs keep there for themselves."""

from __future__ import annotations

from pathlib import Path

HIDDEN = ("_", ".", "~$")
"""How names begin of files and folders that are left alone: notes of systems and programs."""


def visible_files(folder: Path) -> list[Path]:
    """All files in a folder and in those below it, by name; hidden and temporary ones are left out."""
    return sorted(
        file
        for file in folder.rglob("*")
        if file.is_file()
        and not any(part.startswith(HIDDEN) for part in file.relative_to(folder).parts)
    )
